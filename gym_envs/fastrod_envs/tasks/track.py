"""Track: the prototype's tip follows a planar path that its surface of reach does not hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal, final, get_args

import numpy as np

from fastrod.control import references
from fastrod.model.robot import Robot
from fastrod.model.robotfile import load_robot
from fastrod.types import Floats, Ints
from fastrod_envs.options import EnvOptions
from fastrod_envs.rodtask import RodTask
from fastrod_envs.surface import ReachableSurface
from fastrod_envs.task import Backdrop, Ball, DrawnLine, Field, Outcome, length, shortened

Shape = Literal["triangle", "square", "circle"]
Reward = Literal["paper", "precise"]
PERIOD, APPROACH = 9.0, 1.0
"""Time of a turn, and time before the error counts, as the tip begins at rest [s]; before the error
counts, as the tip begins at rest [s]."""
AHEAD = (0.1, 0.2, 0.4)
"""The path is observed so far ahead of now [s]."""
NEAR = 0.01
"""Errors are observed up to this length [m]."""
MEMORY = 0.5
"""Time constant of the error's mean that is observed [s]: what integral action would go by."""
DT = 0.05
"""Time of a step [s]."""
DRIVEN, LIMIT, RATE = (1, 2), ((-0.008, 0.008), (-0.008, 0.008)), (0.01, 0.01)
"""Numbers of the robot's action (`SegmentActions`) that are driven; their least and largest [m]; their
largest rate [m/s]."""
RADIUS = 0.03
"""The surface of reach is known so far from the axis [m]."""


@dataclass(frozen=True, kw_only=True)
class TrackOptions(EnvOptions):
    """Options of Track."""

    path: Shape | Literal["any"] = "any"
    """Which path; `any` draws one for each episode."""
    reward: Reward = "paper"
    """`paper`: exp(-500 d^2) of the distance from the path; `precise`: exp(-e / 0.5 mm) on top, e from the
    nearest point in reach."""


def fields(robot: Robot) -> tuple[tuple[Field, ...], tuple[Field, ...]]:
    """Parts of the goal, and of the state, as they are observed."""
    span = 1.2 * robot.length
    box = (-span,) * 3, (span,) * 3
    goals = (
        Field(
            "path", "m", box[0] * 4, box[1] * 4, f"now and {', '.join(map(str, AHEAD))} s ahead, base frame"
        ),
    )
    states = (
        *goals,
        Field("tip", "m", *box, "where it is measured"),
        Field(
            "error",
            "m",
            (-NEAR,) * 3,
            (NEAR,) * 3,
            f"from the tip to the nearest point in reach of the path's, at most {NEAR:g} m",
        ),
        Field("before", "m", (-NEAR,) * 3, (NEAR,) * 3, "the error one step ago"),
        Field("mean", "m", (-NEAR,) * 3, (NEAR,) * 3, f"of the error, over the last {MEMORY:g} s or so"),
        Field("posture", "", (-1.0,) * 2, (1.0,) * 2, "displacements, from their least to their largest"),
        Field("last", "", (-1.0,) * 2, (1.0,) * 2, "the last action"),
    )
    return goals, states


def coming(path: Callable[[float], Floats]) -> Floats:
    """(n, 12) a path (n, 3), of the seconds from now, as it is observed [m]."""
    return np.concatenate([path(ahead) for ahead in (0.0, *AHEAD)], axis=1)


@final
class TrackSight:
    """Memory of n robots' errors, and the state that they observe."""

    def __init__(self, n: int) -> None:
        self._last = np.zeros((n, 2))
        self._error, self._before, self._mean = np.zeros((3, n, 3))

    def begin(self, rows: Ints, wanted: Floats, seen: Floats) -> None:
        """These robots begin; `wanted` points in reach and `seen` tips are (n, 3) of all [m]."""
        self._last[rows] = 0.0
        self._error[rows] = _off(wanted, seen)[rows]
        self._before[rows], self._mean[rows] = self._error[rows], 0.0

    def note(self, action: Floats, wanted: Floats, seen: Floats) -> None:
        """A step was done: actions (n, 2), then points in reach that are wanted and measured tips (n, 3)
        [m]."""
        self._last = action
        self._before, self._error = self._error, _off(wanted, seen)
        self._mean = self._mean + DT / MEMORY * (self._error - self._mean)

    def state(self, goal: Floats, seen: Floats, posture: Floats) -> Floats:
        """(n, size of the states) with the path that comes (n, 12), measured tips (n, 3) [m] and postures (n,
        2)."""
        return np.concatenate(
            [goal, seen, self._error, self._before, self._mean, posture, self._last], axis=1
        )


def _off(wanted: Floats, seen: Floats) -> Floats:
    """(n, 3) from measured tips to points in reach, at most `NEAR` of it [m]."""
    return shortened(wanted - seen, NEAR)


@final
class Track(RodTask):
    """Follow a triangle of 40 mm, a square of 25 mm or a circle of 20 mm radius with the tip of the
    prototype, one turn in 9 s.

    Two tendon pairs and no extension reach a surface only; the paths lie in the plane of the straight robot's
    tip, millimetres off it. Judged is what the camera measures, effects of sensing included, from 1 s on:
    `distance` is the mean distance of the tip from the nearest point to the path that the robot can reach;
    `error` from the path itself, `floor` that of the nearest points, `mae` and
    `mae_floor` (3,) the same axis by axis [m].
    Reward (the paper's): exp(-500 d^2), d from the path [m]. Success: mean distance below 0.5 mm. 200 steps
    of 50 ms. Path, where on it the episode begins, and which way round are drawn. With
    `randomise="identified.toml"` the effects of an identified robot act. Baseline: resolved rates to the
    nearest point in reach, with its velocity.
    """

    name = "Track"
    n_steps: ClassVar[int] = 200
    n_draws: ClassVar[int] = 3
    accuracy: float = 5e-4
    options_class: ClassVar[type[EnvOptions]] = TrackOptions
    points_per_segment: int = 6
    dt = DT

    def __init__(self, n_envs: int, options: EnvOptions) -> None:
        super().__init__(n_envs, options, load_robot("prototype"), driven=DRIVEN, limit=LIMIT, rate=RATE)
        assert isinstance(options, TrackOptions)
        self._known = references(self.base_robot.length, PERIOD)
        self._names = [options.path] if options.path != "any" else list(get_args(Shape))
        self._sharp = options.reward == "precise"
        self._surface = ReachableSurface(self.base_robot, height=self.base_robot.length, radius=RADIUS)
        self.goals, self.states = fields(self.base_robot)
        n = n_envs
        self._which = np.zeros(n, np.int64)
        self._phase = np.zeros(n)
        self._sense = np.ones(n)
        self._size = np.ones(n)
        self._t = np.zeros(n)
        self._sight = TrackSight(n)
        self._sums, self._counted = np.zeros((n, 9)), np.zeros(n)

    def begin(self, rows: Ints, draws: Floats) -> None:
        self.start(rows, draws)
        self._which[rows] = np.minimum(
            (draws[:, 0] * len(self._names)).astype(np.int64), len(self._names) - 1
        )
        self._phase[rows] = PERIOD * draws[:, 1]
        self._sense[rows] = np.where(draws[:, 2] < 0.5, 1.0, -1.0)
        self._size[rows] = self.difficulty
        self._t[rows], self._sums[rows], self._counted[rows] = 0.0, 0.0, 0.0
        self._sight.begin(rows, self._surface.nearest(self.path(0.0)), self.measured())

    def path(self, ahead: float) -> Floats:
        """(n_envs, 3) the path so many seconds from now, base frame [m]."""
        t = self._phase + self._sense * (self._t + ahead)
        found = np.zeros((self.n_envs, 3))
        for k, name in enumerate(self._names):
            on = self._which == k
            if on.any():
                found[on] = self._known[name].position(t[on])
        found[:, :2] *= self._size[:, None]
        return found

    def act(self, action: Floats) -> None:
        super().act(action)
        self._t += self.dt
        wanted, seen = self.path(0.0), self.measured()
        nearest = self._surface.nearest(wanted)
        self._sight.note(action, nearest, seen)
        off, floor = np.abs(seen - wanted), np.abs(nearest - wanted)
        row = np.column_stack([length(seen - nearest), length(off), length(floor), off, floor])
        counts = self._t > APPROACH
        self._sums += np.where(counts[:, None], row, 0.0)
        self._counted += counts

    def outcome(self) -> Outcome:
        wanted, seen = self.path(0.0), self.measured()
        nearest = self._surface.nearest(wanted)
        terms = {"path": np.exp(-500.0 * length(seen - wanted) ** 2)}
        if self._sharp:
            terms["precise"] = np.exp(-length(seen - nearest) / 5e-4)
        now = np.column_stack([length(seen - nearest), length(seen - wanted), length(nearest - wanted)])
        now = np.column_stack([now, np.abs(seen - wanted), np.abs(nearest - wanted)])
        mean = np.where(self._counted[:, None] > 0, self._sums / np.maximum(self._counted, 1)[:, None], now)
        never = np.zeros(self.n_envs, bool)
        return Outcome(
            terms=terms,
            distance=mean[:, 0],
            success=(mean[:, 0] < self.accuracy) & ~self.lost,
            position=seen.copy(),
            desired=wanted,
            terminated=never,
            contact=never,
            lost=self.lost,
            facts={"error": mean[:, 1], "floor": mean[:, 2], "mae": mean[:, 3:6], "mae_floor": mean[:, 6:]},
        )

    def state(self) -> Floats:
        return self._sight.state(self.goal(), self.measured(), self.posture())

    def goal(self) -> Floats:
        return coming(self.path)

    def baseline(self) -> Floats:
        ahead = self._surface.nearest(self.path(self.dt)) - self._surface.nearest(self.path(0.0))
        error = self._surface.nearest(self.path(0.0)) - self.measured()
        return self.toward(ahead / self.dt + error / (2.0 * self.dt))

    def backdrop(self, i: int) -> Backdrop:
        t = np.linspace(0.0, PERIOD, 90)
        line = self._known[self._names[self._which[i]]].position(t) * [self._size[i], self._size[i], 1.0]
        now = Ball(self.path(0.0)[i], 0.0015, (0.85, 0.2, 0.15))
        return Backdrop(
            tubes=(self.tube(i),),
            balls=(now,),
            lines=(DrawnLine(line, (0.2, 0.35, 0.8)),),
            eye=(0.13, 0.13, 0.12),
            target=(0.0, 0.0, 0.04),
        )
