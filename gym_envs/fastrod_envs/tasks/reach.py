"""Reach: bring the tip of a hanging five-segment robot to a point."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal, final

import numpy as np

from fastrod.errors import InputError, RobotError, shown
from fastrod.model.robot import Robot
from fastrod.model.robotfile import load_robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.simulator import Simulator
from fastrod.types import Floats, Ints
from fastrod_envs.options import EnvOptions
from fastrod_envs.rodtask import RodTask
from fastrod_envs.task import Backdrop, Ball, Field, Outcome, length, shortened

Reward = Literal["paper", "precise"]
Point = tuple[float, ...]
BASE = (0.0, 0.0, 0.5)
"""Base of the robot, which hangs from there, world [m]."""
LEAST, LARGEST = (-0.2, -0.2, 0.1), (0.2, 0.2, 0.25)
"""Corners of the box of goals, world [m]."""
LOWEST, HIGHEST = 0.07, 0.28
"""Between these heights the tip is not punished [m]."""
NEAR = 0.05
"""Errors are observed up to this length [m]."""
LENGTH = 0.5
"""Length of the robot [m]: what distances of another robot's Reach are scaled by."""
BEND = 1.6
"""Largest bend of a segment of another robot, toward d1 and d2 [rad]: that of the paper's, 12 mm of
tendons at 7.5 mm."""
_N_GOALS = 512  # postures whose tips are another robot's goals
_HALF = 0.5  # of the limits: from anywhere within them the baseline finds all goals of the shipped robots


@dataclass(frozen=True, kw_only=True)
class ReachRewardOptions(EnvOptions):
    """Reward options of ReachObstacle, and of Reach among others."""

    reward: Reward = "paper"
    """`paper`: its formula; `precise`: with exp(-d / 0.01 m) on top, which still rises within the last
    centimetre."""


@dataclass(frozen=True, kw_only=True)
class ReachOptions(ReachRewardOptions):
    """Options of Reach."""

    robot: Robot | str | Path | None = None
    """None: the paper's, hanging. A robot, a shipped robot's name or a robot file: yours, where its file has
    its base, driven by the bends of all its segments and the extensions that its file allows."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.robot, (Robot, str, Path, type(None))):
            raise InputError(
                f"robot is {shown(self.robot)}; give a robot file, a shipped robot's name, or None."
            )


def hanging_robot() -> Robot:
    """`five_segment_reacher`, from `BASE` down."""
    return replace(
        load_robot("five_segment_reacher"), base_position=BASE, base_quaternion=(0.0, 1.0, 0.0, 0.0)
    )


class ReachTask(RodTask):
    """Base of Reach and ReachObstacle: robot, goals, observation."""

    n_steps: ClassVar[int] = 40
    n_draws: ClassVar[int] = 3
    accuracy: float = 0.01
    options_class: ClassVar[type[EnvOptions]] = ReachRewardOptions
    points_per_segment = 2
    kept_jacobian_tolerance = 1e-4
    dt = 0.05
    size = 1.0
    """Size of the robot against the paper's: what distances are divided by."""

    def prepare(self, least: Point = LEAST, largest: Point = LARGEST, longer: float = 0.05) -> None:
        """Parts of observations, by the corners of the box of goals, world [m], and how much longer than at
        rest the robot may be [m]."""
        span, near = self.base_robot.length + longer, NEAR * self.size
        base, n = self.base_robot.base_position, len(self.driven)
        low, high = tuple(p - span for p in base), tuple(p + span for p in base)
        self.goals = (Field("goal", "m", least, largest, "where the tip is to be, world"),)
        self.states = (
            *self.goals,
            Field("tip", "m", low, high, "where it is measured, world"),
            Field("direction", "", (-1.0,) * 3, (1.0,) * 3, "of the tip's tangent, world"),
            Field("error", "m", (-near,) * 3, (near,) * 3, f"from tip to goal, at most {near:g} m of it"),
            Field("posture", "", (-1.0,) * n, (1.0,) * n, "displacements, from their least to their largest"),
        )
        self.desired: Floats = np.zeros((self.n_envs, 3))
        """(n_envs, 3) goals, world [m]."""

    def begin(self, rows: Ints, draws: Floats) -> None:
        self.start(rows, draws)
        low, high = np.array(LEAST), np.array(LARGEST)
        self.desired[rows] = 0.5 * (low + high) + self.difficulty * (draws[:, :3] - 0.5) * (high - low)

    def state(self) -> Floats:
        seen = self.measured()
        error = shortened(self.desired - seen, NEAR * self.size)
        return np.concatenate([self.desired, seen, self.direction, error, self.posture()], axis=1)

    def goal(self) -> Floats:
        return self.desired

    def rewards(self, distance: Floats) -> dict[str, Floats]:
        """The terms of both tasks, each (n_envs,), by the distances (n_envs,) from tip to goal [m]."""
        far = distance / self.size
        terms = {"reach": np.exp(-50.0 * far**2)} | self.penalties()
        if getattr(self.options, "reward", "paper") == "precise":
            terms["precise"] = np.exp(-far / 0.01)
        return terms

    def penalties(self) -> dict[str, Floats]:
        """Terms that the tip's place alone decides, each (n_envs,)."""
        z = self.tip[:, 2]
        return {"height": np.where((z < LOWEST) | (z > HIGHEST), -0.5, 0.0)}


@final
class Reach(ReachTask):
    """Bring the tip of a five-segment robot to a goal: x, y from -0.2 to 0.2 m, z from 0.1 to 0.25 m.

    The robot is 0.5 m long and hangs from (0, 0, 0.5) m. Ten bends and the extension of the last segment are
    driven. Reward (the paper's): exp(-50 d^2), and -0.5 while the tip's z is not within 0.07 and 0.28 m; d is
    the tip's distance from the goal [m]. `reward="precise"` adds exp(-d / 0.01 m). Success: d below 10 mm. An
    episode has 40 steps of 50 ms and does not end before. Baseline: damped resolved rates with the
    simulator's Jacobian.

    `robot="mine.toml"` puts your robot in its place. Its segments bend by 1.6 rad at most, in a second from
    straight; goals are where its tip is in 512 postures within half of these limits, the nearest to its rest
    alone at difficulty 0. Reward and success go by d times 0.5 m / its length, and no height is punished.
    """

    name = "Reach"
    options_class: ClassVar[type[EnvOptions]] = ReachOptions

    def __init__(self, n_envs: int, options: EnvOptions) -> None:
        given = getattr(options, "robot", None)
        self._places: Floats | None = None
        if given is None:
            driven, limit, rate = drives()
            super().__init__(n_envs, options, hanging_robot(), driven=driven, limit=limit, rate=rate)
            self.prepare()
            return
        robot = given if isinstance(given, Robot) else load_robot(given)
        driven, limit, rate = drives_of(robot)
        self.size = robot.length / LENGTH
        self.accuracy = self.size * ReachTask.accuracy
        self.kept_jacobian_tolerance = self.size * ReachTask.kept_jacobian_tolerance
        self.points_per_segment = 4
        home = np.clip(0.0, *limit.T)
        super().__init__(n_envs, options, robot, driven=driven, limit=limit, rate=rate, home=home)
        self._places = places(self.base_robot, driven, limit, home)
        edge = 0.02 * robot.length  # a surface that lies flat still has a box around it
        least, largest = self._places.min(0) - edge, self._places.max(0) + edge
        longer = sum(max(segment.extension[1], 0.0) for segment in robot.segments) + edge
        self.prepare(tuple(least.tolist()), tuple(largest.tolist()), longer)

    def begin(self, rows: Ints, draws: Floats) -> None:
        super().begin(rows, draws)
        if self._places is not None:
            known = max(1.0, self.difficulty * len(self._places))
            self.desired[rows] = self._places[np.minimum(draws[:, 0] * known, known - 1.0).astype(int)]

    def penalties(self) -> dict[str, Floats]:
        return {} if self._places is not None else super().penalties()

    def outcome(self) -> Outcome:
        distance = length(self.tip - self.desired)
        never = np.zeros(self.n_envs, bool)
        return Outcome(
            terms=self.rewards(distance),
            distance=distance,
            success=(distance < self.accuracy) & ~self.lost,
            position=self.tip,
            desired=self.desired.copy(),
            terminated=never,
            contact=never,
            lost=self.lost,
        )

    def baseline(self) -> Floats:
        return self.toward((self.desired - self.measured()) / (2.0 * self.dt))

    def backdrop(self, i: int) -> Backdrop:
        ball = Ball(self.desired[i], 0.012 * self.size, (0.85, 0.2, 0.15))
        if self._places is None:
            return Backdrop(tubes=(self.tube(i),), balls=(ball,))
        middle = 0.5 * (np.array(self.base_robot.base_position) + self._places.mean(0))
        eye = middle + self.size * np.array([0.9, 0.9, 0.35])
        return Backdrop(
            tubes=(self.tube(i),), balls=(ball,), eye=tuple(eye.tolist()), target=tuple(middle.tolist())
        )


def drives() -> tuple[Ints, Floats, Floats]:
    """Which (11,) of the reacher's fifteen numbers are driven, all bends and the last extension; their ranges
    (11, 2) [m] and largest rates (11,) [m/s]."""
    driven = np.array([k for k in range(15) if k % 3 or k == 12])
    bend, extension = (-0.012, 0.012), (0.0, 0.05)
    limit = np.array([extension if k == 12 else bend for k in driven])
    rate = np.array([0.04 if k == 12 else 0.012 for k in driven])
    return driven, limit, rate


def drives_of(robot: Robot) -> tuple[Ints, Floats, Floats]:
    """See `drives`, of any robot whose segments are driven by the lengths of tendons, or passive: all
    bends that these make, up to `BEND`, and the extensions that its file allows. Raises `InputError` for
    another robot."""
    try:
        actions = SegmentActions(robot)
    except RobotError as error:
        raise InputError(f"robot {robot.name!r} does not suit Reach: {error}") from error
    driven: list[int] = []
    limit: list[tuple[float, float]] = []
    for k, segment in enumerate(robot.segments):
        if segment.extension[0] < segment.extension[1]:
            driven, limit = [*driven, 3 * k], [*limit, segment.extension]
        bend, own = BEND * float(actions.offset[k]), [j for j in (3 * k + 1, 3 * k + 2) if actions.bends[j]]
        driven, limit = [*driven, *own], [*limit, *[(-bend, bend)] * len(own)]
    rate = [0.8 * (high - low) if j % 3 == 0 else high for j, (low, high) in zip(driven, limit, strict=True)]
    return np.array(driven), np.array(limit), np.array(rate)


def places(robot: Robot, driven: Ints, limit: Floats, home: Floats) -> Floats:
    """(n, 3) where a robot's tip is without its effects, in postures drawn once and for all within half of
    `limit`, nearest to its tip at `home` first, world [m]. Raises `InputError` where it has no shape in most
    of them."""
    plain = replace(robot, effects=())
    action = np.zeros((_N_GOALS + 1, 3 * robot.n_segments))
    action[0, driven] = home
    middle = limit.mean(1)
    edges = middle + _HALF * (limit.T - middle)
    action[1:, driven] = np.random.default_rng(0).uniform(edges[0], edges[1], (_N_GOALS, len(driven)))
    given = SegmentActions(plain).inputs(action)
    state = Simulator(plain, n_robots=len(action), points_per_segment=4, outputs="tip").settle(**given)
    tips = state.tip_position[1:][state.ok[1:]]
    if not state.ok[0] or len(tips) < _N_GOALS // 2:
        raise InputError(
            f"robot {robot.name!r} does not suit Reach: it has a shape in {len(tips)} of {_N_GOALS} postures "
            f"within {BEND:g} rad a segment{'' if state.ok[0] else ', and none at rest'}."
        )
    return np.asarray(tips[np.argsort(length(tips - state.tip_position[0]), kind="stable")])
