"""A field of robots in one simulator; waves run over it."""

from __future__ import annotations

import math
from typing import Any, final

import numpy as np

from fastrod.model.robotfile import load_robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.simulator import Simulator
from fastrod.types import Floats
from fastrod_scenes.scene import RodScene

SIDE = 8
"""Robots along each side of the field."""
APART = 0.3
"""Distance of neighbours [m]."""
PERIOD = 4.0
"""Period of the motion of each robot [s]."""
WAVELENGTH = 1.5
"""Between robots in step, along a row [m]."""
LAG = 0.6
"""Phase of a segment behind the one before [rad]."""
BENDS = (0.25, 0.3, 0.35, 0.4, 0.45)
"""Largest of each segment, base first [rad]."""
TWIST = 0.5
"""Bend across over bend along: the tips go round, not to and fro."""
RESIDUAL = 1e-3
"""Largest of a step's boundary [m]."""
DISPLACEMENT = 0.1
"""Least that each tip covers, corner to corner of the box around its path [m]."""
DIFFERENT = 0.01
"""Least distance of two neighbours' tips in their own frames, at every time [m]."""
PERIODIC = 1e-4
"""Largest distance of a tip from where it was a period before [m]."""


def bases() -> Floats:
    """(SIDE^2, 7) poses, a square field about the origin: position [m] and quaternion w x y z."""
    line = APART * (np.arange(SIDE) - 0.5 * (SIDE - 1))
    x, y = (a.ravel() for a in np.meshgrid(line, line, indexing="ij"))
    still = np.ones_like(x), np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
    return np.stack([x, y, np.zeros_like(x), *still], axis=1)


@final
class Grid(RodScene):
    """64 five-segment reachers, each in a world of its own. The crests run along the field's diagonal and bow
    toward its middle."""

    name = "grid"
    about = "Sixty-four five-segment reachers sway in waves, each with a phase of its own, in one simulator."
    dt = 1.0 / 30.0
    duration = 3.0 * PERIOD

    def __init__(self) -> None:
        self.actions = SegmentActions(load_robot("five_segment_reacher"))
        self.bases = bases()
        x, y = self.bases[:, 0], self.bases[:, 1]
        self.phase: Floats = 2.0 * math.pi * (0.8 * x + 0.6 * y + 0.5 * np.hypot(x, y)) / WAVELENGTH
        """(64,) of each robot behind one at the middle [rad]."""

    def simulator(self) -> Simulator:
        """64 robots, 10 points a segment, without contact."""
        return Simulator(self.actions.robot, n_robots=len(self.bases), dt=self.dt, points_per_segment=10)

    def action(self, t: float) -> Floats:
        """(64, 15) at time t [s]: [m]."""
        n = self.actions.robot.n_segments
        angle = 2.0 * math.pi * t / PERIOD - self.phase[:, None] - LAG * np.arange(n)
        bend = np.array(BENDS) * self.actions.offset
        longest = np.array([segment.extension[1] for segment in self.actions.robot.segments])
        extension = longest * (0.5 - 0.5 * np.cos(angle))
        return np.stack([extension, bend * np.sin(angle), TWIST * bend * np.cos(angle)], axis=2).reshape(
            len(angle), 3 * n
        )

    def inputs(self, t: float) -> dict[str, Any]:
        """`action` at time t [s], and the robots' places as `base_pose`."""
        return {**self.actions.inputs(self.action(t)), "base_pose": self.bases}

    def check(self) -> dict[str, float]:
        """The waves must be solved to `RESIDUAL`, move every tip by `DISPLACEMENT`, differ between
        neighbours, and come back after a period."""
        tips: list[Floats] = []
        residual = 0.0
        for t, state in self.run():
            self.expect(
                bool(state.ok.all()),
                f"at {t:.3g} s {int((~state.ok).sum())} robots are not ok: {dict(state.problems)}",
            )
            residual = max(residual, float(state.residual.max()))
            tips.append(state.tip_position - self.bases[:, :3])
        path, steps = np.array(tips), round(PERIOD / self.dt)
        displacement = float(np.linalg.norm(np.ptp(path, axis=0), axis=1).min())
        field = path.reshape(len(path), SIDE, SIDE, 3)
        apart = min(float(np.linalg.norm(np.diff(field, axis=axis), axis=3).min()) for axis in (1, 2))
        off = float(np.linalg.norm(path[2 * steps :] - path[steps : len(path) - steps], axis=2).max())
        self.expect(residual < RESIDUAL, f"a boundary is {residual:.3g} m off.")
        self.expect(
            displacement > DISPLACEMENT,
            f"the tip's displacement is {displacement:.3g} m; it must be {DISPLACEMENT:g} m.",
        )
        self.expect(
            apart > DIFFERENT,
            f"two neighbours are {apart:.3g} m from being alike; each must have a phase of its own.",
        )
        self.expect(off < PERIODIC, f"a tip is {off:.3g} m from where it was a period before.")
        return {
            "boundary residual, m": residual,
            "displacement of a tip, least, m": displacement,
            "neighbours from being alike, m": apart,
            "tip after a period, m": off,
        }
