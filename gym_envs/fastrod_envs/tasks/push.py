"""Push: a hanging soft robot pushes a cube over the floor to its goal."""

from __future__ import annotations

from dataclasses import replace
from typing import final

from fastrod_envs.options import EnvOptions
from fastrod_envs.push_course import Course, longer
from fastrod_envs.pushing import PushTask
from fastrod_scenes.a1.quadruped import neck

HEIGHT = 0.5
"""Height from which the robot hangs [m]."""


def course() -> Course:
    """Robot, cube and goals."""
    robot = replace(
        longer(neck(3), 0.165, (-0.03, 0.05)),
        name="pusher",
        base_position=(0.0, 0.0, HEIGHT),
        base_quaternion=(0.0, 1.0, 0.0, 0.0),
    )
    return Course(robot=robot, place=(0.1, 0.0), least=(0.22, -0.1), largest=(0.34, 0.1), steepness=50.0)


@final
class Push(PushTask):
    """Push a cube over the floor to a goal with a soft robot that hangs from (0, 0, 0.5) m: goals x 0.22 to
    0.34 m, y -0.1 to 0.1 m.

    The robot has three segments of 0.165 m, which become 30 mm shorter or 50 mm longer, and a bar across its
    tip, 80 mm wide. Three numbers drive all segments alike: extension and bends toward d1 (+x) and d2 (-y).
    The cube, 80 mm and 50 g, begins within 1 cm of (0.1, 0) m and turned by up to 0.1 rad. It slides with
    friction 0.25 on the floor and 1 on the bar.

    Reward: exp(-50 d^2), and 0.5 once the robot has touched the cube in this episode; d is the distance of
    the cube's middle from its goal in the plane [m]. Success: d below 20 mm. An episode has 40 steps of 0.1 s
    and does not end before.
    Baseline: as in QuadrupedPush.

    The paper's goals (x 0.1 to 0.2 m, y -0.3 to 0.3 m) lie mostly beside the cube, where a robot that stands
    behind it cannot push it in an episode; here they lie in front of it, and the bar is new: it bends its
    robot as in QuadrupedPush.
    """

    name = "Push"

    def __init__(self, n_envs: int, options: EnvOptions) -> None:
        super().__init__(n_envs, options, course())
