"""DualArm: two soft robots that face each other pass a ball from one to the other."""

from __future__ import annotations

import math
from typing import ClassVar, final

import numpy as np

from fastrod.control import scaled_rates
from fastrod.errors import HostError
from fastrod.hosts import Bullet, connect
from fastrod.hosts.gripper import Gripper
from fastrod.model.robot import Robot
from fastrod.types import Floats
from fastrod_envs.arms import SoftArm, short
from fastrod_envs.hosted import Cell, HostedResult, HostedTask
from fastrod_envs.options import EnvOptions
from fastrod_envs.task import Backdrop, Ball, Field, Tube, solid_box
from fastrod_envs.tip import NOTHING
from fastrod_scenes.ur5.carried import RADIUS, soft_robot

HEIGHT = 0.3
"""Height of both bases, world [m]."""
BASE = 0.27
"""Base of either base from the middle, along x [m]; the first robot's is at -x, and they look at each
other."""
BALL = 0.018
"""Radius of what is passed [m]."""
GOAL, SPREAD = (0.06, 0.0, HEIGHT), (0.02, 0.06, 0.05)
"""Middle of the goals, and how far they are from there at most, world [m]."""
START_BEND = 0.2
"""Largest bend of each segment at the start, either way [rad]."""
SPEED = 0.1
"""Largest of a tip along x, y and z [m/s]."""
WORKSPACE = ((-0.11, -0.1, HEIGHT - 0.1), (-0.01, 0.1, HEIGHT + 0.1))
"""Box in which the first tip may be sent, world [m]; the second's range is its mirror image."""
EXTENSION, LARGEST_BEND = 0.03, 1.2
"""Largest extension [m] and bend [rad] of a segment, either way."""
EXTENSION_RATE, BEND_RATE = 0.08, 2.0
"""Largest of a segment [m/s], [rad/s]."""
SUCTION = 0.5
"""A head that is pulled at harder lets go [N]."""
NEAR = 0.05
"""Errors are observed up to this length [m]."""
_HEAD = RADIUS + 0.0025  # m
_HOLD = _HEAD + BALL  # m, from a tip to the middle of a ball that it touches
_FALLEN = 0.15  # m, below the bases
_SUBSTEP, _DT = 0.05, 0.01  # s, longest step of the soft robots, of the world
_MASS, _HEAD_MASS = 0.005, 0.02  # kg
_MOUNT = 0.5 * HEIGHT + 0.01  # m, half the height of what a robot stands out from
_POINTS = 5
_SIDES = (-1.0, 1.0)
_COLORS = ((0.5, 0.0, 0.6), (0.0, 0.45, 0.5))
# w x y z: d3 along x, against x
_FACING = ((math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0), (math.sqrt(0.5), 0.0, -math.sqrt(0.5), 0.0))
_YELLOW, _GREEN, _GREY = (0.95, 0.75, 0.1), (0.1, 0.55, 0.25), (0.45, 0.47, 0.5)


@final
class DualArm(HostedTask):
    """Pass a ball from one soft robot to the other, which brings it to a goal that the first one cannot
    reach.

    Two robots of two segments look at each other along x. The head of the first holds the ball at the
    start, by suction; that of the second takes hold of it where it touches it and its grip is on. An
    action is the velocity of both tips along x, y, z (up to 0.1 m/s, by damped resolved rates) and both
    grips, on above 0. A head that is pulled at with more than 0.5 N lets go. Start, 0.2 rad of each
    segment either way, and goal, 20 x 60 x 50 mm either way around (60, 0, 300) mm, differ from episode
    to episode; `difficulty` scales both.

    Distance: from ball to goal [m]. Success: below 10 mm, with the second robot alone holding it. Reward,
    each step: 0.2 exp(-g / 0.05 m), g from the second head to the ball; 0.3 while the second alone holds it;
    0.5 exp(-d / 0.05 m) meanwhile, d the distance; 1 for success; -1 where the ball falls or the robots touch
    each other, which end the episode. Otherwise it has 40 steps of 0.1 s. What a head holds and meets bends
    its robot at once. Baseline: both to the middle, the second from its side; then on, off, to the goal.
    """

    name = "DualArm"
    n_steps: ClassVar[int] = 40
    n_draws: ClassVar[int] = 11
    accuracy: float = 0.01
    duration: ClassVar[float] = 4.0

    def __init__(self, n_envs: int, options: EnvOptions) -> None:
        grasps = Field("grips", "", (-1.0, -1.0), (1.0, 1.0), "of both heads, on above 0")
        low, high = tips_range()
        if options.action == "rate":
            moves = Field(
                "velocity", "m/s", (-SPEED,) * 6, (SPEED,) * 6, "of the first tip and of the second, world"
            )
        else:
            moves = Field(
                "tips",
                "m",
                tuple(low.ravel()),
                tuple(high.ravel()),
                f"where both go, at most with {SPEED:g} m/s, world",
            )
        far = tuple(np.tile([-BASE, -0.3, HEIGHT - 0.3], 2)), tuple(np.tile([BASE, 0.3, HEIGHT + 0.3], 2))
        near = (-NEAR,) * 3, (NEAR,) * 3
        goals = (
            Field(
                "goal",
                "m",
                tuple(np.subtract(GOAL, SPREAD)),
                tuple(np.add(GOAL, SPREAD)),
                "where the ball is to be, world",
            ),
        )
        states = (
            *goals,
            Field("ball", "m", far[0][:3], far[1][:3], "its middle, world"),
            Field("tips", "m", *far, "of the first robot and of the second, world"),
            Field("directions", "", (-1.0,) * 6, (1.0,) * 6, "of both tips' tangents, world"),
            Field(
                "to_ball", "m", *near, f"from the second tip to the ball's middle, at most {NEAR:g} m of it"
            ),
            Field("to_goal", "m", *near, f"from ball to goal, at most {NEAR:g} m of it"),
            Field("gap", "m", (-NEAR,), (NEAR,), f"between the second head and the ball, at most {NEAR:g} m"),
            Field(
                "grips",
                "",
                (0.0,) * 4,
                (1.0,) * 4,
                "the first and the second commanded to hold; the first and the second hold the ball",
            ),
            Field(
                "posture",
                "",
                (-1.0,) * 12,
                (1.0,) * 12,
                "extensions and displacements of both, from their least to their largest",
            ),
        )
        robot = soft_robot("passer", 2, extension=EXTENSION, line_density=0.03)
        super().__init__(n_envs, options, robot, (moves, grasps), states, goals)

    def cell(self) -> Cell:
        return _Pair(self)


def tips_range() -> tuple[Floats, Floats]:
    """(2, 3) least and largest places of both tips, world [m]."""
    (x, y, z), (a, b, c) = WORKSPACE
    return np.array([(x, y, z), (-a, y, z)]), np.array([(a, b, c), (-x, b, c)])


class _Pair(Cell):
    """A world of heads and ball, made anew for every episode."""

    def __init__(self, task: DualArm) -> None:
        self.at_once, self.accuracy = task.options.action == "displacement", task.accuracy
        self.n_substeps = max(1, math.ceil(task.dt / _SUBSTEP - 1e-9))
        self.n_steps = max(1, math.ceil(task.dt / self.n_substeps / _DT - 1e-9))
        self.step = task.dt / (self.n_substeps * self.n_steps)
        self.low, self.high = tips_range()
        self.world = connect(dt=self.step)
        robot = task.base_robot
        self.softs = [
            SoftArm(
                robot,
                dt=task.dt / self.n_substeps,
                points_per_segment=_POINTS,
                largest_bend=LARGEST_BEND,
                bend_rate=BEND_RATE,
                extension_rate=EXTENSION_RATE,
            )
            for _ in _SIDES
        ]
        self.bases = [
            np.array([side * BASE, 0.0, HEIGHT, *facing])
            for side, facing in zip(_SIDES, _FACING, strict=True)
        ]

    def begin(self, draws: Floats, difficulty: float, robot: Robot | None) -> None:
        self.goal_at = np.array(GOAL) + difficulty * (2.0 * draws[:3] - 1.0) * SPREAD
        bends = difficulty * START_BEND * (2.0 * draws[3:11].reshape(2, 2, 2) - 1.0)
        for soft, base, bend in zip(self.softs, self.bases, bends, strict=True):
            start = np.zeros((2, 3))
            start[:, 1:] = bend * soft.actions.offset[:, None]
            soft.begin(robot, base, start.ravel())
        b = self.world
        b.resetSimulation()
        b.setGravity(0.0, 0.0, -9.81)
        b.setTimeStep(self.step)
        self.ball, self.heads = _furnish(b)
        self.commanded, self.held = [False, False], [False, False]
        weight = np.array([0.0, 0.0, -9.81 * _MASS])
        load = np.concatenate([weight, np.cross(_HOLD * self.softs[0].tip_rotation[:, 2], weight)])
        self._springs = [
            soft.hold(b, head.body, self.step, own)
            for soft, head, own in zip(self.softs, self.heads, (load, NOTHING), strict=True)
        ]
        first = self.softs[0]
        place = first.tip + (_HOLD + 2e-4) * first.tip_rotation[:, 2]
        b.resetBasePositionAndOrientation(self.ball, place.tolist(), [0.0, 0.0, 0.0, 1.0])
        self.commanded[0] = True
        self._take()
        self._look()
        if not self.held[0]:
            raise HostError("the first robot does not hold the ball at the start of the episode.")

    def act(self, action: Floats, duration: float) -> None:
        moves, substep = action[:6].reshape(2, 3), duration / self.n_substeps
        for k, head in enumerate(self.heads):
            self.commanded[k] = bool(action[6 + k] > 0.0)
            if not self.commanded[k] and self.held[k]:
                head.release()
                self.held[k] = False
        for _ in range(self.n_substeps):
            for k, soft in enumerate(self.softs):
                velocity = SPEED * moves[k]
                if self.at_once:
                    to = 0.5 * (self.low[k] + self.high[k]) + 0.5 * (self.high[k] - self.low[k]) * moves[k]
                    velocity = np.clip((to - soft.aim) / substep, -SPEED, SPEED)
                jacobian = soft.jacobian()[:3] * soft.rate
                rates = scaled_rates(jacobian[None], velocity[None], -soft.posture()[None])[0]
                soft.drive(soft.action + substep * soft.rate * rates)
            self._advance()
            self._look()
            self._slip()
            if self._over():
                break

    def result(self) -> HostedResult:
        distance = float(np.linalg.norm(self.place - self.goal_at))
        passed, contact, fell = self.held[1] and not self.held[0], self._apart < 0.0, self._fell()
        success = passed and distance < self.accuracy and not contact
        return HostedResult(
            terms={
                "meet": 0.2 * math.exp(-max(self._gap, 0.0) / 0.05),
                "pass": 0.3 if passed else 0.0,
                "goal": 0.5 * math.exp(-distance / 0.05) if passed else 0.0,
                "success": 1.0 if success else 0.0,
                "failure": -1.0 if contact or fell else 0.0,
            },
            distance=distance,
            success=success,
            position=self.place.copy(),
            desired=self.goal_at.copy(),
            terminated=contact or fell,
            contact=contact,
            facts={
                "first_holds": float(self.held[0]),
                "second_holds": float(self.held[1]),
                "apart": self._apart,
            },
        )

    def state(self) -> Floats:
        first, second = self.softs
        low, high = np.array([-BASE, -0.3, HEIGHT - 0.3]), np.array([BASE, 0.3, HEIGHT + 0.3])
        return np.concatenate(
            [
                self.goal_at,
                np.clip(self.place, low, high),
                np.clip(first.tip, low, high),
                np.clip(second.tip, low, high),
                first.tip_rotation[:, 2],
                second.tip_rotation[:, 2],
                short(self.place - second.tip, NEAR),
                short(self.goal_at - self.place, NEAR),
                [min(max(self._gap, -NEAR), NEAR)],
                self.commanded,
                self.held,
                first.posture(),
                second.posture(),
            ]
        )

    def goal(self) -> Floats:
        return self.goal_at

    def baseline(self) -> Floats:
        grasps = [0.0 if self.held[1] else 1.0, 1.0]
        if self.held[1]:
            velocity = np.zeros((2, 3))
            if not self.held[0]:
                velocity[0, 0] = -SPEED * min(1.0, max(0.0, (self.softs[0].tip[0] - self.low[0, 0]) / 0.02))
                velocity[1] = 4.0 * (self.goal_at - self.place)
        else:
            to_meet = 3.0 * (np.array([0.0, 0.0, HEIGHT]) - self.place)
            to_place = self.place - self.softs[1].tip
            aside = float(np.hypot(to_place[1], to_place[2]))
            to_place[0] += _HOLD - 0.002 + min(0.03, max(0.0, 2.0 * (aside - 0.004)))
            velocity = np.stack([to_meet, to_meet + 4.0 * to_place])
        velocity = np.clip(velocity, -SPEED, SPEED)
        if not self.at_once:
            moves = velocity / SPEED
        else:
            to = np.stack([soft.aim for soft in self.softs]) + 0.1 * velocity
            moves = (2.0 * to - self.low - self.high) / (self.high - self.low)
        return np.array([*moves.ravel(), *(2.0 * np.array(grasps) - 1.0)])

    def backdrop(self) -> Backdrop:
        return Backdrop(
            tubes=tuple(
                Tube(soft.nodes, RADIUS, color) for soft, color in zip(self.softs, _COLORS, strict=True)
            ),
            balls=(
                Ball(self.goal_at, 0.006, _GREEN),
                Ball(self.place, BALL, _YELLOW),
                *(Ball(soft.tip, _HEAD, (0.0, 0.0, 0.75)) for soft in self.softs),
            ),
            solids=tuple(
                solid_box([side * (BASE + 0.02), 0.0, _MOUNT], [0.02, 0.04, _MOUNT], _GREY) for side in _SIDES
            ),
            eye=(0.1, -0.75, 0.5),
            target=(0.0, 0.0, 0.28),
        )

    def close(self) -> None:
        self.world.disconnect()

    def _advance(self) -> None:
        """The world's steps while the heads move as the soft robots hold them."""
        for spring in self._springs:
            spring.follow(self.n_steps)
        for _ in range(self.n_steps):
            for spring in self._springs:
                spring.pull()
            self.world.stepSimulation()
            self._take()

    def _take(self) -> None:
        """Heads that are commanded to hold, and touch the ball, hold it."""
        for k, head in enumerate(self.heads):
            if self.commanded[k] and not self.held[k] and head.attach(()) is not None:
                self.held[k] = True

    def _slip(self) -> None:
        """A head that is pulled at too hard lets go."""
        pull = [float(np.linalg.norm(spring.wrench[:3])) for spring in self._springs]
        worst = int(np.argmax(np.multiply(pull, self.held)))
        if self.held[worst] and pull[worst] > SUCTION:
            self.heads[worst].release()
            self.held[worst] = False

    def _look(self) -> None:
        """Update the ball's position, and the distance of the robots from each other."""
        self.place = np.array(self.world.getBasePositionAndOrientation(self.ball)[0])
        self._gap = float(np.linalg.norm(self.place - self.softs[1].tip)) - _HOLD
        between = (
            np.linalg.norm(self.softs[0].nodes[:, None] - self.softs[1].nodes[None], axis=2) - 2.0 * RADIUS
        )
        between[-1] -= _HEAD - RADIUS
        between[:, -1] -= _HEAD - RADIUS
        self._apart = float(between.min())

    def _fell(self) -> bool:
        return (
            bool(self.place[2] < HEIGHT - _FALLEN)
            or float(np.abs(self.place - [0.0, 0.0, HEIGHT]).max()) > BASE
        )

    def _over(self) -> bool:
        return self._apart < 0.0 or self._fell()


def _furnish(b: Bullet) -> tuple[int, list[Gripper]]:
    """The ball, and the heads of both robots."""
    shape = b.createCollisionShape(b.GEOM_SPHERE, radius=BALL)
    seen = b.createVisualShape(b.GEOM_SPHERE, radius=BALL, rgbaColor=[*_YELLOW, 1.0])
    ball: int = b.createMultiBody(_MASS, shape, seen, [0.0, 0.0, HEIGHT])
    b.changeDynamics(ball, -1, linearDamping=0.0, angularDamping=0.0)
    return ball, [Gripper(b, _HEAD, 0.0, (0.0, 0.0, 0.75, 1.0), _HEAD_MASS) for _ in _SIDES]
