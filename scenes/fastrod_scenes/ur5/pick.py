"""A UR5 with a soft robot picks a cube from a table and puts it on a spot: by suction, and by the friction of
two fingers."""

from __future__ import annotations

import math
from typing import ClassVar, final

import numpy as np

from fastrod_scenes.scene import HostedScene
from fastrod_scenes.ur5.picking import SPOT, Cube, Picking, duration

LIFTED = 0.1
"""Least height of the cube above where it was, all the time that it is carried [m]."""
CARRIED = 0.2
"""Least displacement of the cube sideways at that height [m]."""
LEAST_DISPLACEMENT = 0.05
"""Least displacement by each of the two, arm and soft robot [m]."""
BENT = 0.5
"""Least change of the soft robot's bend meanwhile [rad]."""
SPEED = 0.6
"""Largest of the cube [m/s]."""
DEPTH = 0.001
"""Largest of cube, soft robot and arm in the table [m]."""
OFF_FLANGE = 0.001
"""Largest distance of the soft robot's base from its mount [m]."""
LEAN = 0.01
"""Largest of the cube at the end [rad]."""
REST = 0.002
"""Largest speed of the cube at the end [m/s]."""
AWAY = 0.03
"""Least distance of the soft robot, gripper included, from the cube at the end [m]."""


class _Pick(HostedScene):
    """Pick and place, with either way of holding."""

    fingers: ClassVar[bool]
    """That hold by friction; otherwise suction."""
    accuracy: ClassVar[float]
    """Largest distance of the cube from the spot at the end [m]."""
    slip: ClassVar[float]
    """Largest motion of the held cube as seen from the tip [m]."""
    dt = 0.01
    default: ClassVar[Cube] = Cube()

    def __init__(self, cube: Cube = default) -> None:
        self.cube = cube

    @final
    def stage(self) -> Picking:
        return Picking(self.cube, self.fingers, self.dt)

    @final
    def check(self) -> dict[str, float]:
        stage = self.stage()
        start, mass, held = stage.cube_pose()[0], stage.mass, np.zeros(3)
        before, slip, fastest, depth, off_flange = "", 0.0, 0.0, 0.0, 0.0
        away = speed = gap = math.inf
        # height of the cube, sideways place of cube and of the soft robot's base, bend
        carried: list[tuple[float, ...]] = []
        for t in self.play(stage):
            at, phase, seen = f"at {t:.3g} s", stage.phase.name, stage.cube_from_tip()
            position, rotation = stage.cube_pose()
            if phase in ("lift", "carry", "lower"):
                held = seen if phase == "lift" != before else held
                slip = max(slip, float(np.linalg.norm(seen - held)))
                self.expect(
                    slip < self.slip,
                    f"{at} the cube is {slip:.3g} m from where it was held: not lifted, or dropped.",
                )
            if phase == "carry":
                carried.append((position[2] - start[2], position[1], float(stage.points[0, 1]), stage.bend))
            before, speed = phase, stage.cube_speed()
            fastest = max(fastest, speed)
            self.expect(fastest < SPEED, f"{at} the cube moves at {fastest:.3g} m/s.")
            depth = max(depth, -stage.clearance([stage.cube, *stage.soft, stage.arm.body], stage.table, 0.01))
            self.expect(depth < DEPTH, f"{at} something is {depth:.3g} m deep in the table.")
            off_flange = max(off_flange, stage.off_flange())
            self.expect(
                off_flange < OFF_FLANGE,
                f"{at} the soft robot's base is {off_flange:.3g} m off its mount on the flange.",
            )
            self.expect(stage.mass == mass, f"{at} the cube has {stage.mass:.3g} kg; it had {mass:.3g} kg.")
            if phase == "rest":
                away = stage.clearance(stage.soft, stage.cube)
                gap = stage.clearance([stage.cube], stage.table)
        height, sideways, base, bend = np.array(carried).T
        lifted, displacement, by_arm, bent = height.min(), np.ptp(sideways), np.ptp(base), np.ptp(bend)
        self.expect(
            lifted > LIFTED,
            f"the cube is carried {lifted:.3g} m above the table; it must be {LIFTED:g} m or more.",
        )
        self.expect(
            displacement > CARRIED,
            f"the cube is carried {displacement:.3g} m sideways; it must be {CARRIED:g} m or more.",
        )
        self.expect(
            min(by_arm, displacement - by_arm) > LEAST_DISPLACEMENT,
            f"of {displacement:.3g} m sideways, {by_arm:.3g} m are by the arm; both must contribute.",
        )
        self.expect(
            bent > BENT, f"the soft robot bends by {bent:.3g} rad meanwhile; it must be {BENT:g} rad or more."
        )
        off, lean = float(np.linalg.norm(position[:2] - SPOT)), math.acos(min(1.0, rotation[2, 2]))
        self.expect(
            off < self.accuracy,
            f"the cube ends {off:.3g} m from the spot; it must be within {self.accuracy:g} m.",
        )
        self.expect(lean < LEAN, f"the cube ends {lean:.3g} rad from upright.")
        self.expect(speed < REST, f"the cube still moves at {speed:.3g} m/s at the end.")
        self.expect(gap < 1e-3, f"the cube is {gap:.3g} m above the table at the end.")
        self.expect(
            away > AWAY,
            f"the soft robot ends {away:.3g} m from the cube; it must have left it by {AWAY:g} m.",
        )
        return {
            "height of the lift, m": float(lifted),
            "displacement sideways, m": float(displacement),
            "displacement sideways by the arm, m": float(by_arm),
            "change of bend meanwhile, rad": float(bent),
            "slip, m": slip,
            "speed of the cube, most, m/s": fastest,
            "depth in the table, m": depth,
            "base off the flange, m": off_flange,
            "off the spot, m": off,
            "lean, rad": lean,
            "speed at the end, m/s": speed,
            "distance at the end, m": away,
        }


@final
class PickSuction(_Pick):
    """The head attaches the cube that it touches, and lets it go."""

    name = "pick_suction"
    about = (
        "A soft robot on a UR5 takes a cube from a table by suction, carries it sideways and puts it on "
        "a spot."
    )
    duration = duration(fingers=False)
    fingers = False
    accuracy = 0.005
    slip = 0.001


@final
class PickGripper(_Pick):
    """The fingers squeeze the cube, and friction alone holds it."""

    name = "pick_gripper"
    about = (
        "A soft robot on a UR5 takes a cube from a table with two fingers, carries it sideways and puts "
        "it on a spot."
    )
    duration = duration(fingers=True)
    fingers = True
    accuracy = 0.01
    slip = 0.002
