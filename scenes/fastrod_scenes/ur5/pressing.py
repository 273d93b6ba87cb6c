"""A UR5 in MuJoCo carries a soft robot, which bends and presses a sprung plate aside."""

from __future__ import annotations

import math
from typing import final

import numpy as np

from fastrod.hosts.mujoco import MujocoRod, add_capsules
from fastrod.hosts.mujoco_body import mujoco
from fastrod.model.segment_actions import SegmentActions
from fastrod.types import Floats
from fastrod_scenes.scene import MujocoScene, MujocoStage
from fastrod_scenes.ur5.carried import OFFSET, eased, soft_robot
from fastrod_scenes.ur5.mujoco_arm import MujocoArm, arm_spec

START = (0.0, -1.2, 1.4, -1.77, -1.57, 0.0)
"""Joints of the arm: the flange looks down [rad]."""
SWING = 0.04
"""Rotation of the first joint to the plate, and back [rad]."""
BEND = 0.9
"""Bend of the soft robot, both segments together [rad]."""
ADAPTER = 0.03
"""Between flange and soft robot [m]."""
SPRING, DAMPER, MASS = 8.0, 4.0, 0.2
"""Constants of the plate: [N/m], [N s/m], [kg]."""
_THICK, _GAP = 0.01, 0.04  # of the plate, and between it and the straight robot [m]


class Pressing(MujocoStage):
    """The arm, its soft robot, and the plate, which slides along y against its spring."""

    def __init__(self, dt: float) -> None:
        lib = mujoco()
        robot = soft_robot("presser", 2)
        spec = arm_spec(dt)
        tip = _tip(robot.length)
        spec.worldbody.add_geom(
            name="floor", type=lib.mjtGeom.mjGEOM_PLANE, size=[1.0, 1.0, 0.1], rgba=[0.8, 0.8, 0.8, 1.0]
        )
        plate = spec.worldbody.add_body(
            name="plate", pos=[tip[0], tip[1] + _GAP + 0.5 * _THICK, tip[2] + 0.03], gravcomp=1.0
        )
        plate.add_joint(
            name="plate",
            type=lib.mjtJoint.mjJNT_SLIDE,
            axis=[0.0, 1.0, 0.0],
            stiffness=SPRING,
            damping=DAMPER,
        )
        plate.add_geom(
            type=lib.mjtGeom.mjGEOM_BOX, size=[0.06, 0.5 * _THICK, 0.06], mass=MASS, rgba=[0.9, 0.6, 0.2, 1.0]
        )
        add_capsules(spec, robot, "tool0", contact_bodies=["plate"])
        self.model = spec.compile()
        self.data = lib.MjData(self.model)
        self.arm = MujocoArm(self.model, self.data)
        self.arm.place(START)
        self.rod = MujocoRod(
            robot,
            self.model,
            self.data,
            "tool0",
            position=(0.0, 0.0, ADAPTER),
            contact_bodies=["plate"],
            friction=0.1,
        )
        self._actions = SegmentActions(robot)
        self._toward = self._plate_side()
        self.rod.settle()

    @property
    def displaced(self) -> float:
        """The plate, along y [m]."""
        return float(self.data.joint("plate").qpos[0])

    def advance(self, t: float) -> None:
        """Bend within a second, hold, swing the arm a little to the plate and back, hold."""
        bend = BEND * eased(t) * self._toward / 2.0
        action = np.concatenate([[0.0], OFFSET * bend] * 2)
        swing = SWING * math.sin(math.pi * (t - 2.0)) ** 2 if 2.0 < t < 3.0 else 0.0
        self.arm.drive([START[0] + swing, *START[1:]])
        self.rod.step(**self._actions.inputs(action))

    def _plate_side(self) -> Floats:
        """(2,) bend of a segment by 1 rad that leads the tip to +y, world, in the rod's d1 and d2."""
        axes = self.rod.settle().rotation[0, 0]
        return np.asarray(axes[1, :2] / np.linalg.norm(axes[1, :2]))


@final
class UR5Mujoco(MujocoScene):
    """At rest the plate's spring is what the soft robot presses with, and what the arm's base feels
    sideways."""

    name = "ur5_mujoco"
    about = (
        "A UR5 in MuJoCo carries a soft robot that bends and presses a sprung plate aside, and feels "
        "the spring in its joints."
    )
    dt = 0.01
    duration = 4.0

    def stage(self) -> Pressing:
        """A new model: the arm at `START`, the soft robot settled, the plate `_GAP` beside it."""
        return Pressing(self.dt)

    def check(self) -> dict[str, float]:
        """At the end the plate's spring, the rod's base force and the first servo's torque must agree to 2 %,
        and the swing must have moved the plate on."""
        stage = self.stage()
        pressed, most, lost = 0.0, 0.0, 0
        for t in self.play(stage):
            lost += not stage.rod.rod.state.ok[0]
            most = max(most, stage.displaced)
            if t < 2.0:
                pressed = stage.displaced
        spring = SPRING * stage.displaced
        felt = -float(stage.rod.wrench[1])
        torque = float(stage.arm.torque()[0])  # about the world's z
        moment = stage.rod.wrench[3:] + np.cross(stage.rod.rod.base[:3], stage.rod.wrench[:3])
        self.expect(lost == 0, f"{lost} steps could not be solved.")
        self.expect(
            pressed > 0.005, f"the plate has gone {pressed:.4f} m; the soft robot bends farther than the gap."
        )
        self.expect(
            most > pressed + 0.005,
            f"the arm's swing moved the plate from {pressed:.4f} m to {most:.4f} m only.",
        )
        self.expect(
            abs(felt - spring) < 0.02 * spring, f"the base feels {felt:.4f} N, the spring has {spring:.4f} N."
        )
        self.expect(
            abs(torque + moment[2]) < 0.02 * abs(moment[2]),
            f"the first servo holds {torque:.4f} N m against {moment[2]:.4f} N m.",
        )
        return {
            "plate_displaced_m": stage.displaced,
            "plate_displaced_by_the_swing_m": most - pressed,
            "spring_N": spring,
            "felt_N": felt,
            "first_servo_Nm": torque,
        }


def _tip(length: float) -> Floats:
    """(3,) of the straight soft robot at the start, world [m]."""
    lib = mujoco()
    model = arm_spec(0.01).compile()
    data = lib.MjData(model)
    MujocoArm(model, data).place(START)
    lib.mj_kinematics(model, data)
    flange = data.body("tool0")
    return np.asarray(flange.xpos + (ADAPTER + length) * flange.xmat.reshape(3, 3)[:, 2])
