"""Reach: bring the tip of a hanging five-segment robot to a point."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal, final, get_args

import numpy as np

from fastrod.errors import InputError
from fastrod.model.robot import Robot
from fastrod.model.robotfile import load_robot
from fastrod.types import Floats, Ints
from fastrod_envs.options import EnvOptions
from fastrod_envs.rodtask import RodTask
from fastrod_envs.task import Backdrop, Ball, Field, Outcome, length, shortened

Reward = Literal["paper", "precise"]
BASE = (0.0, 0.0, 0.5)
"""Of the robot, which hangs from there, world [m]."""
LEAST, LARGEST = (-0.2, -0.2, 0.1), (0.2, 0.2, 0.25)
"""Corners of the box of goals, world [m]."""
LOWEST, HIGHEST = 0.07, 0.28
"""Between these heights the tip is not punished [m]."""
NEAR = 0.05
"""Errors are observed up to this length [m]."""


@dataclass(frozen=True, kw_only=True)
class ReachOptions(EnvOptions):
    """Of Reach and ReachObstacle."""

    reward: Reward = "paper"
    """`paper`: its formula; `precise`: with exp(-d / 0.01 m) on top, which still rises within the last
    centimetre."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.reward not in get_args(Reward):
            raise InputError(
                f"reward is {self.reward!r}; it must be {' or '.join(map(repr, get_args(Reward)))}."
            )


def hanging_robot() -> Robot:
    """`five_segment_reacher`, from `BASE` down."""
    return replace(
        load_robot("five_segment_reacher"), base_position=BASE, base_quaternion=(0.0, 1.0, 0.0, 0.0)
    )


class ReachTask(RodTask):
    """What Reach and ReachObstacle share: robot, goals, observation."""

    n_steps: ClassVar[int] = 40
    n_draws: ClassVar[int] = 3
    accuracy: ClassVar[float] = 0.01
    options_class: ClassVar[type[EnvOptions]] = ReachOptions
    points_per_segment = 2
    kept_jacobian_tolerance: ClassVar[float] = 1e-4
    dt = 0.05

    def prepare(self) -> None:
        """Parts of observations."""
        reach = self.base_robot.length + 0.05
        low, high = tuple(p - reach for p in BASE), tuple(p + reach for p in BASE)
        n = len(self.driven)
        self.goals = (Field("goal", "m", LEAST, LARGEST, "where the tip is to be, world"),)
        self.states = (
            *self.goals,
            Field("tip", "m", low, high, "where it is measured, world"),
            Field("direction", "", (-1.0,) * 3, (1.0,) * 3, "of the tip's tangent, world"),
            Field("error", "m", (-NEAR,) * 3, (NEAR,) * 3, f"from tip to goal, at most {NEAR:g} m of it"),
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
        error = shortened(self.desired - seen, NEAR)
        return np.concatenate([self.desired, seen, self.direction, error, self.posture()], axis=1)

    def goal(self) -> Floats:
        return self.desired

    def rewards(self, distance: Floats) -> dict[str, Floats]:
        """The terms of both tasks, each (n_envs,), by the distances (n_envs,) from tip to goal [m]."""
        z = self.tip[:, 2]
        terms = {
            "reach": np.exp(-50.0 * distance**2),
            "height": np.where((z < LOWEST) | (z > HIGHEST), -0.5, 0.0),
        }
        if getattr(self.options, "reward", "paper") == "precise":
            terms["precise"] = np.exp(-distance / 0.01)
        return terms


@final
class Reach(ReachTask):
    """Bring the tip of a five-segment robot to a goal: x, y from -0.2 to 0.2 m, z from 0.1 to 0.25 m.

    The robot is 0.5 m long and hangs from (0, 0, 0.5) m. Ten bends and the extension of the last segment are
    driven. Reward (the paper's): exp(-50 d^2), and -0.5 while the tip's z is not within 0.07 and 0.28 m; d is
    the tip's distance from the goal [m]. `reward="precise"` adds exp(-d / 0.01 m). Success: d below 10 mm. An
    episode has 40 steps of 50 ms and does not end before. Baseline: damped resolved rates with the
    simulator's Jacobian.
    """

    name = "Reach"

    def __init__(self, n_envs: int, options: EnvOptions) -> None:
        driven, limit, rate = drives()
        super().__init__(n_envs, options, hanging_robot(), driven=driven, limit=limit, rate=rate)
        self.prepare()

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

    def scenery(self, i: int) -> Backdrop:
        return Backdrop(tubes=(self.tube(i),), balls=(Ball(self.desired[i], 0.012, (0.85, 0.2, 0.15)),))


def drives() -> tuple[Ints, Floats, Floats]:
    """Which (11,) of the reacher's fifteen numbers are driven, all bends and the last extension; their ranges
    (11, 2) [m] and largest rates (11,) [m/s]."""
    driven = np.array([k for k in range(15) if k % 3 or k == 12])
    bend, extension = (-0.012, 0.012), (0.0, 0.05)
    limit = np.array([extension if k == 12 else bend for k in driven])
    rate = np.array([0.04 if k == 12 else 0.012 for k in driven])
    return driven, limit, rate
