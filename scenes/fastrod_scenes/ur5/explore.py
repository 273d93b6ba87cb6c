"""A soft robot on a UR5 enters a box and, the UR5 held still, looks at each of its corners."""

from __future__ import annotations

from typing import final

import numpy as np

from fastrod.types import Floats
from fastrod_scenes.scene import HostedScene
from fastrod_scenes.ur5.box import CORNERS, Box
from fastrod_scenes.ur5.exploration import END, Exploration

LEAST_PIXELS = 20
"""Least number of pixels of a corner's cube in the picture of it, for the corner to be seen."""
DEPTH_ERROR = 0.003
"""Largest of those pixels [m]: half of a pixel beside an edge."""
MISS = 0.002
"""Largest of the line of sight from a cube's middle [m]."""
CLEARANCE = 0.005
"""Least of either robot from the box [m]."""
STILL = 1e-4
"""Largest motion of a joint that is held [rad]."""
_EVERY = 2  # steps between two looks at the distances


@final
class Explore(HostedScene):
    """The start of both robots follows from the seed: flange, wrist and bends.

    The box is no obstacle to the rod: where the rod meets a wall, the run has failed.
    """

    name = "explore"
    about = "A soft robot on a UR5 enters a box and, the UR5 held still, looks at each of its eight corners."
    dt = 0.01
    duration = END

    def __init__(self, *, seed: int = 0, runs: int = 2, box: Box | None = None) -> None:
        """`check` does so many `runs`, from `seed` on; `stage` and `run` are those of `seed`."""
        self.seed, self.runs, self.box = seed, runs, box or Box()

    def stage(self) -> Exploration:
        """A new world whose robots start as the seed has it."""
        return Exploration(self.box, self.seed, self.dt)

    def check(self) -> dict[str, float]:
        """The worst of each figure of `measure` over all `runs`, of seeds one after the other."""
        every = [Explore(seed=self.seed + k, box=self.box).measure() for k in range(self.runs)]
        smallest = (
            "corners seen",
            "pixels of a cube, least",
            "distance of the UR5 from the box, m",
            "clearance of the soft robot, m",
        )
        return {name: (min if name in smallest else max)(run[name] for run in every) for name in every[0]}

    def measure(self) -> dict[str, float]:
        """Figures of one run; `SceneError` as soon as one is not as it must be."""
        stage = self.stage()
        arm = soft = np.inf
        collisions, moved, seen = 0, 0.0, 0
        off: list[float] = []
        depth: list[float] = []
        pixels: list[int] = []
        held: Floats | None = None
        for k, t in enumerate(self.play(stage)):
            collisions += stage.arm_in_contact()
            self.expect(collisions == 0, f"at {t:.3g} s the UR5 touches the box.")
            if k % _EVERY == 0:
                arm, soft = min(arm, stage.arm_distance()), min(soft, stage.soft_clearance())
                self.expect(
                    soft > CLEARANCE,
                    f"at {t:.3g} s the soft robot is {soft:.3g} m from a wall; it must "
                    f"stay {CLEARANCE:g} m away.",
                )
                self.expect(
                    arm > CLEARANCE,
                    f"at {t:.3g} s the UR5 is {arm:.3g} m from the box; it must stay {CLEARANCE:g} m away.",
                )
            if stage.frozen:
                held = stage.arm.position() if held is None else held
                moved = max(moved, float(np.abs(stage.arm.position() - held).max()))
            if len(stage.looks) > seen:
                name, look = CORNERS[seen], stage.looks[seen]
                count, error = stage.seen(seen)
                self.expect(
                    count >= LEAST_PIXELS,
                    f"the corner {name} shows in {count} pixels; it takes {LEAST_PIXELS} to be seen.",
                )
                self.expect(
                    error < DEPTH_ERROR,
                    f"by its depth, a pixel of the corner {name} is {error:.3g} m off the cube.",
                )
                self.expect(
                    look.miss < MISS, f"the line of sight misses the corner {name} by {look.miss:.3g} m."
                )
                off.append(look.miss)
                depth.append(error)
                pixels.append(count)
                seen += 1
        self.expect(seen == len(CORNERS), f"{seen} corners were looked at.")
        self.expect(moved < STILL, f"a joint that is held moves by {moved:.3g} rad.")
        return {
            "corners seen": float(seen),
            "collisions of the UR5": float(collisions),
            "distance of the UR5 from the box, m": arm,
            "clearance of the soft robot, m": soft,
            "pixels of a cube, least": float(min(pixels)),
            "error of depth, m": max(depth),
            "miss of the line of sight, m": max(off),
            "motion of held joints, rad": moved,
        }


def explore_all(runs: int = 10) -> dict[str, float]:
    """Figures of the worst of so many runs, each from a start of its own; `SceneError` where one fails.

    python -c "from fastrod_scenes.ur5.explore import explore_all; print(explore_all(10))"
    """
    return Explore(runs=runs).check()
