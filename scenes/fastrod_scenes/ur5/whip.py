"""A UR5 in MuJoCo cracks a soft robot of five segments like a whip: rod and arm in motion together."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, final

import numpy as np

from fastrod.hosts.mujoco import MujocoRod, add_capsules
from fastrod.hosts.mujoco_body import mujoco
from fastrod.loading import load_robot
from fastrod.model.robot import Robot
from fastrod.types import Floats
from fastrod_scenes.scene import MujocoScene, MujocoStage
from fastrod_scenes.ur5.carried import eased
from fastrod_scenes.ur5.mujoco_arm import MujocoArm, arm_spec

START = (-0.6, -1.2, 1.4, -1.77, -1.57, 0.0)
"""Joints of the arm: the flange looks down [rad]."""
SWING, LASTS = 1.2, 0.45
"""Rotation of the first joint, and back [rad]; how long either takes [s]."""
ADAPTER = 0.03
"""Between flange and soft robot [m]."""
FINER = 4
"""Steps of the reference in one of the scene."""


def whip_robot() -> Robot:
    """Five segments of 0.1 m, 0.1 kg/m, that lose their swing in some hundredths of a second."""
    robot = load_robot("five_segment_reacher")
    segments = tuple(
        replace(
            s, line_density=0.1, bending_stiffness=(0.01, 0.01), torsional_stiffness=0.008, damping_time=4e-3
        )
        for s in robot.segments
    )
    return replace(robot, name="whip", segments=segments)


class Cracking(MujocoStage):
    """The arm, its soft robot, and nothing else."""

    def __init__(self, dt: float) -> None:
        lib = mujoco()
        robot, spec = whip_robot(), arm_spec(dt)
        add_capsules(spec, robot, "tool0")
        self.model = spec.compile()
        self.data = lib.MjData(self.model)
        self.arm = MujocoArm(self.model, self.data)
        self.arm.place(START)
        self.rod = MujocoRod(robot, self.model, self.data, "tool0", position=(0.0, 0.0, ADAPTER))
        self.rod.settle()

    def advance(self, t: float) -> None:
        """Swing the first joint there and back, then hold."""
        there = eased(min(t / LASTS, 1.0)) - eased(min(max(t / LASTS - 1.0, 0.0), 1.0))
        self.arm.drive([START[0] + SWING * there, *START[1:]])
        self.rod.step()


class Crack(NamedTuple):
    """Measurements at each step of the scene."""

    speed: Floats
    """(n,) of the tip, world [m/s]."""
    force: Floats
    """(n, 3) that the flange feels, mean over the step, world [N]."""
    momentum: Floats
    """(n, 3) of the rod [kg m/s]."""
    lost: int


@final
class UR5Whip(MujocoScene):
    """The tip is faster than the flange; tip and wrench are those of a reference at a quarter of the step."""

    name = "whip"
    about = (
        "A UR5 in MuJoCo cracks a soft robot of five segments like a whip: its joints feel the rod's inertia."
    )
    dt = 0.004
    duration = 1.6

    def stage(self) -> Cracking:
        """A new model: the arm at `START`, the rod hanging from it at rest."""
        return Cracking(self.dt)

    def crack(self, finer: int) -> Crack:
        """The scene in steps of dt / `finer`, seen once a dt."""
        stage, dt = Cracking(self.dt / finer), self.dt / finer
        speed, force, momentum, lost, felt = [], [], [], 0, np.zeros(3)
        for k in range(round(self.duration / self.dt) * finer):
            stage.advance(k * dt)
            state = stage.rod.rod.state
            lost += not state.ok[0]
            felt = felt + stage.rod.wrench[:3] / finer
            if (k + 1) % finer == 0:
                assert state.velocity is not None
                speed.append(float(np.linalg.norm(state.velocity[0, -1])))
                force.append(felt)
                momentum.append(stage.rod.simulator.momentum()[0, :3])
                felt = np.zeros(3)
        return Crack(np.array(speed), np.array(force), np.array(momentum), lost)

    def check(self) -> dict[str, float]:
        """Every step must be solved, the tip be faster than the flange by half, speed and force agree with a
        step of a quarter to 5 % of their largest, and the flange feel the change of the rod's momentum."""
        found, fine = self.crack(1), self.crack(FINER)
        radius = float(np.hypot(*self.stage().rod.rod.settle().position[0, 0, :2]))
        flange = SWING / LASTS * 1.5 * radius  # about: the fastest of an eased swing
        speed = float(np.abs(found.speed - fine.speed).max() / fine.speed.max())
        force = float(
            np.sqrt(((found.force - fine.force) ** 2).sum(1).mean() / (fine.force**2).sum(1).mean())
        )
        robot = whip_robot()
        weight = np.array([0.0, 0.0, -9.81 * sum(s.line_density * s.length for s in robot.segments)])
        gained = np.diff(found.momentum, axis=0) / self.dt
        off = float(np.abs(weight - gained - found.force[1:]).max() / np.abs(found.force).max())
        self.expect(found.lost + fine.lost == 0, f"{found.lost + fine.lost} steps could not be solved.")
        self.expect(
            fine.speed.max() > 1.5 * flange,
            f"the tip goes {fine.speed.max():.2f} m/s, the flange {flange:.2f} m/s.",
        )
        self.expect(speed < 0.05, f"the tip's speed is {100 * speed:.1f} % off the reference; at most 5 %.")
        self.expect(force < 0.05, f"the force is {100 * force:.1f} % off the reference; at most 5 %.")
        self.expect(off < 1e-6, f"the flange feels {off:.1e} more than the rod's change of momentum.")
        return {
            "tip_speed_m_s": float(fine.speed.max()),
            "largest_force_n": float(np.abs(fine.force).max()),
            "speed_off_the_reference": speed,
            "force_off_the_reference": force,
            "force_off_the_momentum": off,
        }
