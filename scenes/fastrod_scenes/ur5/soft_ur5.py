"""A UR5 that carries a soft robot of two segments, tip down, and moves its tip by resolved rates."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple, TypeAlias, final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.control import ResolvedRate, SoftTip
from fastrod.hosts import BulletArm, BulletLink, MountedRod, connect
from fastrod.model.robot import Robot
from fastrod.rotation import matrix_from_quaternion, quaternion_from_matrix
from fastrod.solver.state import State
from fastrod.types import Floats
from fastrod_scenes.robots import ur5_path
from fastrod_scenes.ur5.carried import OFFSET, Bracket, soft_robot

Movers: TypeAlias = Literal["both", "arm", "soft"]
"""Choice of what moves: arm and soft robot, or one while the other is held."""
ADAPTER = 0.03
"""Size of the bracket between flange and soft robot [m]."""
EXTENSION = 0.03
"""Largest of a segment; the least is none [m]."""
LARGEST_BEND = 2.0
"""Largest bend of a segment toward d1, and toward d2 [rad]."""
STRAIGHT = (0.5 * EXTENSION, 0.0, 0.0) * 2
"""Actions at the start: straight, extended by half of what is possible [m]."""
DEPTH = 0.2 + EXTENSION
"""Depth of the tip below the base then [m]."""
DOWN = (0.0, 1.0, 0.0, 0.0)
"""Orientation of the flange at the start, w x y z: z down, x along the world's."""
ELBOW_UP = (0.0, -1.57, 1.57, -1.57, -1.57, 0.0)
"""Joints of the UR5 near which the flange looks down from above [rad]."""
GAIN = 10.0
"""Gain of the tip's error [1/s]."""
ERROR_LIMIT = 0.1
"""A longer error counts as this one [m]."""
POSTURE_GAIN = 2.0
"""[1/s]"""
BEND_WEIGHT, EXTENSION_WEIGHT = 0.02, 0.05
"""Cost of a segment's bend by 1 rad, and of its extension by `EXTENSION`, where that of a joint's 1 rad is
1."""
JOINT_RATE, BEND_RATE, EXTENSION_RATE = 1.0, 2.0, 0.06
"""Largest of a joint and of a bend [rad/s], and of an extension [m/s]."""


class ArmStep(NamedTuple):
    """Effect of one step on the tip, world."""

    tip: Floats
    """(3,) at its end [m]."""
    by_soft: Floats
    """(3,) displacement of the tip by the soft robot's actions: the tip's Jacobian before the step times
    their change [m]."""
    by_arm: Floats
    """(3,) the same by the arm's joints, as measured [m]."""


def track_robot() -> Robot:
    """Two segments of 0.1 m that extend by up to `EXTENSION`, 0.1 kg/m."""
    robot = soft_robot("tracker", 2, line_density=0.1)
    return replace(
        robot, segments=tuple(replace(segment, extension=(0.0, EXTENSION)) for segment in robot.segments)
    )


@final
class SoftUR5:
    """The UR5 at the world's origin, the soft robot below its flange, and a controller of both, in a world of
    its own.

    Coordinates q (12,): the joints [rad], then extension and two displacements for each segment [m]
    (`SoftTip`).

    The task leaves q nine degrees of freedom. In these it goes toward the posture in which it began, in the
    metric of the weights: where the tip is slow, q comes to rest where the weighted square of its
    displacement from that posture is least. So the weights alone divide the motion: bends are cheap, and the
    arm takes over where the soft robot would bend too much.
    """

    def __init__(self, *, dt: float, tip: ArrayLike, depth: float = DEPTH, movers: Movers = "both") -> None:
        """The soft robot's base begins `depth` [m] above the point `tip` (3,) [m], world, which is its tip's
        by default."""
        self.dt, self.movers = dt, movers
        self.world = b = connect(dt=dt)
        self.arm = BulletArm.load(b, ur5_path(), tip="tool0")
        flange = np.asarray(tip, float) + np.array([0.0, 0.0, depth + ADAPTER])
        joints = self.arm.solve(np.concatenate([flange, DOWN]), ELBOW_UP)
        self.arm.place(joints)
        host = BulletLink(b, self.arm.body, self.arm.tip, position=(0.0, 0.0, ADAPTER))
        self.bracket = Bracket(
            BulletLink(b, self.arm.body, self.arm.tip), [(np.zeros(3), np.array([0.0, 0.0, ADAPTER]))], 0.015
        )
        self.rod = MountedRod(track_robot(), host, capsules_per_segment=5, dynamics=False)
        self.kinematics = SoftTip(
            self.rod.simulator, self.arm, flange_from_base=(0.0, 0.0, ADAPTER, 1.0, 0.0, 0.0, 0.0)
        )
        start = np.concatenate([joints, STRAIGHT])
        low, high = self.kinematics.limits(LARGEST_BEND)
        self.lower: Floats = np.concatenate([self.arm.lower, low])
        """(12,) least q."""
        self.upper: Floats = np.concatenate([self.arm.upper, high])
        """(12,) largest q."""
        n = self.arm.n_joints
        self.moving = {"both": slice(None), "arm": slice(n), "soft": slice(n, None)}[movers]
        """Coordinates that move."""
        bend = BEND_WEIGHT / OFFSET**2
        weight = np.concatenate([np.ones(n), [EXTENSION_WEIGHT / EXTENSION**2, bend, bend] * 2])
        rate = np.concatenate(
            [np.full(n, JOINT_RATE), [EXTENSION_RATE, BEND_RATE * OFFSET, BEND_RATE * OFFSET] * 2]
        )
        moving = self.moving
        self.control = ResolvedRate(
            gain=GAIN,
            lower=self.lower[moving],
            upper=self.upper[moving],
            rate=rate[moving],
            weight=weight[moving],
            error_limit=ERROR_LIMIT,
            damping=1e-3,
            posture=start[moving],
            posture_gain=POSTURE_GAIN,
        )
        self.action: Floats = start[n:]
        """(6,) of the soft robot [m]."""
        self._state = self.rod.settle(**self.kinematics.actions.inputs(self.action))
        self._base = host.motion().pose

    def q(self) -> Floats:
        """(12,) joints as measured, and actions."""
        return np.concatenate([self.arm.position(), self.action])

    def tip(self) -> Floats:
        """(3,) world [m], on the base as it stands after the step, which the rod could only expect."""
        return self._carried(self._state)

    def rest(self) -> Floats:
        """(3,) where the tip would come to rest with these joints and actions, world [m]."""
        simulator, before = self.rod.simulator, self.rod.simulator.snapshot()
        pose = np.concatenate(
            [self._state.position[0, 0], quaternion_from_matrix(self._state.rotation[0, :1])[0]]
        )
        still = self._carried(simulator.settle(base_pose=pose, **self.kinematics.actions.inputs(self.action)))
        simulator.restore(before)
        return still

    def advance(self, error: Floats, velocity: Floats) -> ArmStep:
        """One step: the tip makes up for its `error` (3,) [m], as fast as the gain has it, and continues with
        `velocity` (3,) [m/s]."""
        q, n, moving = self.q(), self.arm.n_joints, self.moving
        self.kinematics.follow(q, self._state, self._base)
        jacobian = self.kinematics.jacobian()
        to = q.copy()
        to[moving] += self.dt * self.control.rates(q[moving], jacobian[:, moving], error, velocity, self.dt)
        if self.movers != "soft":
            self.arm.drive(to[:n])
        self.action = to[n:]
        self._state = self.rod.step(**self.kinematics.actions.inputs(self.action))
        self._base = self.rod.host.motion().pose
        self.bracket.follow()
        displacement = self.q() - q
        return ArmStep(self.tip(), jacobian[:, n:] @ displacement[n:], jacobian[:, :n] @ displacement[:n])

    def clearance(self, within: float = 0.1) -> float:
        """Clearance of the soft robot from the arm's links, at most `within` [m]; negative inside one."""
        near = (self.world.getClosestPoints(own, self.arm.body, within) for own in self.rod.bodies.ids)
        return min((float(p[8]) for points in near for p in points), default=within)

    def _carried(self, state: State) -> Floats:
        orientation = matrix_from_quaternion(self._base[None, 3:])[0] @ state.rotation[0, 0].T
        return np.asarray(self._base[:3] + orientation @ (state.tip_position[0] - state.position[0, 0]))
