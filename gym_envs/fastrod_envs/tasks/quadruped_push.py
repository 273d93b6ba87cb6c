"""QuadrupedPush: a quadruped's soft neck pushes a cube over the floor to its goal."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import final

import numpy as np

from fastrod.hosts.bullet import Bullet
from fastrod.rotation import quaternion_from_matrix
from fastrod_envs.options import EnvOptions
from fastrod_envs.push_course import Course, longer
from fastrod_envs.pushing import PushTask
from fastrod_scenes.a1.quadruped import neck, standing

PITCH = -0.9
"""Pitch of the neck's mount [rad]."""


@functools.cache
def course() -> Course:
    """Neck, cube and goals; the neck's base is where an A1 that stands has it."""
    world, mount = standing(0.005, PITCH)
    pose = mount.motion().pose
    world.disconnect()
    c, s = math.cos(PITCH), math.sin(PITCH)
    quaternion = quaternion_from_matrix(np.array([[-s, 0.0, c], [0.0, -1.0, 0.0], [c, 0.0, s]]))
    robot = longer(neck(3), 0.14, (-0.04, 0.05))
    robot = replace(
        robot, base_position=(float(pose[0]), 0.0, float(pose[2])), base_quaternion=tuple(quaternion.tolist())
    )
    return Course(robot=robot, place=(0.42, 0.0), least=(0.55, -0.1), largest=(0.7, 0.1), steepness=300.0)


@final
class QuadrupedPush(PushTask):
    """Push a cube over the floor to a goal with the soft neck of a Unitree A1 that stands: goals x 0.55 to
    0.7 m, y -0.1 to 0.1 m.

    The neck has three segments of 0.14 m, which become 40 mm shorter or 50 mm longer, and a bar across
    its tip, 80 mm wide; the paper's has none. Three numbers drive all segments alike: extension and bends
    toward d1 (up) and d2 (right). The cube, 80 mm and 50 g, begins within 1 cm of (0.42, 0) m in x and in
    y, turned by up to 0.1 rad. It slides with friction 0.25 on the floor and 1 on the bar.

    Reward: exp(-300 d^2), and 0.5 once the neck has touched the cube in this episode; d is the distance of
    the cube's middle from its goal in the plane [m]. Success: d below 20 mm. An episode has 40 steps of 0.1 s
    and does not end before.
    Baseline: straight to the cube, then the tip goes straight along the way that the cube has to go, by
    damped resolved rates with the simulator's Jacobian. The cube stays on the bar.

    The bar is a body of 20 g at the tip of the neck, which is its spring: it bends in the step in which the
    cube, or the floor, pushes the bar. The bar has no weight. The trunk stands still (a push of 0.12 N does
    not move 12 kg), so the legs are drawn only. A round tip does not steer a cube. A controller keeps the bar
    off the floor.
    """

    name = "QuadrupedPush"

    def __init__(self, n_envs: int, options: EnvOptions) -> None:
        super().__init__(n_envs, options, course())

    @staticmethod
    def picture_world() -> Bullet:
        return standing(0.005, PITCH)[0]
