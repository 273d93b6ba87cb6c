"""Catch: meet a moving target while a load that nobody declares bends the robot."""

from __future__ import annotations

import math
from typing import Any, ClassVar, final

import numpy as np

from fastrod.model.robot import Robot, Segment, Tendon
from fastrod.types import Floats, Ints
from fastrod_envs.options import EnvOptions
from fastrod_envs.rodtask import RodTask
from fastrod_envs.task import Backdrop, Ball, DrawnLine, Field, Outcome, length, shortened

SEGMENT = 0.1
"""Length of each of the two segments [m]."""
STIFFNESS = 0.0022
"""EI [N m^2]."""
OFFSET = 0.01
"""Offset of the tendons from the backbone [m]."""
BEND, EXTENSION = 0.012, (-0.02, 0.02)
"""Ranges of a bend, plus and minus, and of the last segment's extension [m]."""
LARGEST_LOAD = 0.15
"""Largest load of the undeclared tip force [N]."""
SLOWEST, FASTEST = 0.02, 0.08
"""Speeds of the target [m/s]."""
NEAR = 0.05
"""Errors are observed up to this length [m]."""
PACE = 0.2
"""Speed at which the baseline expects the tip to go [m/s]."""
_DRIVEN = (1, 2, 4, 5, 3)  # both bends of both segments, then the extension of the second
_INNER = 0.7  # of the ranges: where crossing points lie
_STEP = 1e-6  # m, of the arcs' Jacobian


def standing_robot() -> Robot:
    """Two weightless segments that stand upright on the origin, three tendons each."""
    segments = tuple(
        Segment(
            length=SEGMENT,
            bending_stiffness=(STIFFNESS, STIFFNESS),
            torsional_stiffness=STIFFNESS,
            body_radius=0.012,
            extension=EXTENSION if k else (0.0, 0.0),
            tendons=tuple(
                Tendon(offset=OFFSET, angle=2.0 * math.pi * (j / 3 + k / 6), compliance=1e-4)
                for j in range(3)
            ),
        )
        for k in range(2)
    )
    return Robot(name="catcher", segments=segments)


@final
class Catch(RodTask):
    """Catch a target with the tip of a robot that an unknown load bends.

    The robot stands upright: two segments of 0.1 m, four bends and the extension of the second. A target
    crosses its workspace in a straight line at 0.02 to 0.08 m/s; where and when it crosses, its direction and
    its speed are drawn for every episode. So is a force at the tip, of any direction and up to 0.15 N, which
    stays all the while and is not observed: it bends the robot by up to some 12 mm. Observed are the measured
    tip, the target's position and its velocity.

    Caught: the tip within 10 mm of the target at the end of a step; this ends the episode with success. Else
    it ends after 40 steps of 50 ms. Reward: -min(d, 0.2 m) / 0.2 m a step, d the tip's distance from the
    target [m], and 10 for the catch.
    `distance`, by which the task is judged, is the least d of the episode so far. With difficulty 0 there is
    no load, and a slow target passes the tip's place at home. Baseline: resolved rates with the Jacobian of
    unloaded arcs, from the measured tip to where a tip of 0.2 m/s can first meet the target; what is at its
    limit is left out.
    """

    name = "Catch"
    n_steps: ClassVar[int] = 40
    n_draws: ClassVar[int] = 12
    accuracy: float = 0.01
    points_per_segment = 4
    loaded = True
    dt = 0.05

    def __init__(self, n_envs: int, options: EnvOptions) -> None:
        self.force: Floats = np.full((n_envs, 3), 1e-3)
        """(n_envs, 3) the undeclared load on the tip, world [N]."""
        limit = np.array([(-BEND, BEND)] * 4 + [EXTENSION])
        rate = np.array([0.018] * 4 + [0.025])
        super().__init__(n_envs, options, standing_robot(), driven=_DRIVEN, limit=limit, rate=rate)
        # a load that moves: from now on the simulator knows the gain for it, whatever comes first
        self.force[:] = 0.0
        self.simulator.settle(**self._inputs())
        self._home = self.simulator.snapshot()
        self._limit = limit
        self.desired: Floats = np.zeros((n_envs, 3))
        """(n_envs, 3) where the target is, world [m]."""
        self.velocity: Floats = np.zeros((n_envs, 3))
        """(n_envs, 3) of the target, world [m/s]."""
        self.least: Floats = np.full(n_envs, np.inf)
        """(n_envs,) the least distance of the episode [m]."""
        self._path: Floats = np.zeros((n_envs, 2, 3))
        span = self.base_robot.length + EXTENSION[1] + 0.05
        self._time = self.dt * (options.n_steps or self.n_steps)
        far = span + FASTEST * self._time
        self.goals = (
            Field("target", "m", (-far,) * 3, (far,) * 3, "where it is, world"),
            Field("velocity", "m/s", (-FASTEST,) * 3, (FASTEST,) * 3, "of the target, world"),
        )
        self.states = (
            *self.goals,
            Field("tip", "m", (-span,) * 3, (span,) * 3, "where it is measured, world"),
            Field("direction", "", (-1.0,) * 3, (1.0,) * 3, "of the tip's tangent, world"),
            Field("error", "m", (-NEAR,) * 3, (NEAR,) * 3, f"from tip to target, at most {NEAR:g} m of it"),
            Field("posture", "", (-1.0,) * 5, (1.0,) * 5, "displacements, from their least to their largest"),
        )

    def loads(self) -> dict[str, Any]:
        return {"tip_force": self.force}

    def begin(self, rows: Ints, draws: Floats) -> None:
        ease = self.difficulty
        self.force[rows] = (
            ease * LARGEST_LOAD * np.cbrt(draws[:, 0].copy())[:, None] * directions(draws[:, 1:3])
        )
        self.start(rows, draws)
        low, high = self._limit.T
        posture = ease * _INNER * (0.5 * (low + high) + (draws[:, 3:8] - 0.5) * (high - low))
        speed = SLOWEST + ease * draws[:, 8:9] * (FASTEST - SLOWEST)
        self.velocity[rows] = speed * directions(draws[:, 9:11])
        when = np.maximum(self.dt, (0.4 + 0.4 * draws[:, 11:12]) * self._time)
        self.desired[rows] = arcs_tip(posture) - when * self.velocity[rows]
        self.least[rows] = length(self.desired - self.tip)[rows]
        self._path[rows] = np.stack([self.desired, self.desired + self._time * self.velocity], axis=1)[rows]

    def moved(self) -> None:
        self.desired = self.desired + self.dt * self.velocity
        self.least = np.minimum(self.least, length(self.desired - self.tip))

    def outcome(self) -> Outcome:
        d = length(self.desired - self.tip)
        caught = (d <= self.accuracy) & ~self.lost
        terms = {"distance": -np.minimum(d, 0.2) / 0.2, "catch": np.where(caught, 10.0, 0.0)}
        return Outcome(
            terms=terms,
            distance=self.least.copy(),
            success=caught,
            position=self.tip,
            desired=self.desired.copy(),
            terminated=caught,
            contact=np.zeros(self.n_envs, bool),
            lost=self.lost,
            facts={"load": self.force.copy()},
        )

    def state(self) -> Floats:
        seen = self.measured()
        error = shortened(self.desired - seen, NEAR)
        return np.concatenate(
            [self.desired, self.velocity, seen, self.direction, error, self.posture()], axis=1
        )

    def goal(self) -> Floats:
        return np.concatenate([self.desired, self.velocity], axis=1)

    def baseline(self) -> Floats:
        seen, v = self.measured(), self.velocity
        away = self.desired - seen
        # |away + v t| = PACE t: the first time at which a tip of this pace can be where the target then is
        square, along, lead = dot(away, away), dot(away, v), PACE**2 - dot(v, v)
        soon = (along + np.sqrt(along**2 + lead * square)) / lead
        velocity = (away + soon[:, None] * v) / np.maximum(soon, 2.0 * self.dt)[:, None]
        jacobian, posture = arcs_jacobian(self.displacement), self.posture()
        wanted = self.toward(velocity, jacobian)
        pushes = wanted if self.options.action == "rate" else wanted - posture
        stuck = (np.abs(posture) > 0.999) & (posture * pushes > 0.0)
        return self.toward(velocity, np.where(stuck[:, None, :], 0.0, jacobian))

    def backdrop(self, i: int) -> Backdrop:
        return Backdrop(
            tubes=(self.tube(i),),
            balls=(Ball(self.desired[i], self.accuracy, (0.85, 0.2, 0.15)),),
            lines=(DrawnLine(self._path[i], (0.85, 0.5, 0.45)),),
            eye=(0.45, 0.45, 0.35),
            target=(0.0, 0.0, 0.12),
        )


def dot(a: Floats, b: Floats) -> Floats:
    """(n,) of vectors (n, 3), the same bits whatever n is."""
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def directions(draws: Floats) -> Floats:
    """(n, 3) unit vectors, evenly over the sphere, from (n, 2) numbers from 0 to 1."""
    z, angle = 2.0 * draws[:, 0] - 1.0, 2.0 * math.pi * draws[:, 1]
    across = np.sqrt(1.0 - z**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def arcs_tip(displacement: Floats) -> Floats:
    """(n, 3) tip [m] of the unloaded robot, two arcs, by its driven displacements (n, 5) [m]."""
    x, y, z = _arc(displacement[:, 2] / OFFSET, displacement[:, 3] / OFFSET, SEGMENT + displacement[:, 4])
    a, b = displacement[:, 0] / OFFSET, displacement[:, 1] / OFFSET
    bend = np.hypot(a, b)
    sine, versine = np.sinc(bend / np.pi), 0.5 * np.sinc(0.5 * bend / np.pi) ** 2
    along = a * x + b * y  # turned about (-b, a, 0) by the bend (Rodrigues)
    rotated = (
        x + a * (sine * z - versine * along),
        y + b * (sine * z - versine * along),
        z * np.cos(bend) - sine * along,
    )
    return np.stack(
        [p + q for p, q in zip(_arc(a, b, np.full(len(a), SEGMENT)), rotated, strict=True)], axis=1
    )


def arcs_jacobian(displacement: Floats) -> Floats:
    """(n, 3, 5) d(tip)/d(displacement) of the unloaded arcs, by central differences."""
    columns = []
    for k in range(displacement.shape[1]):
        step = np.zeros(displacement.shape[1])
        step[k] = _STEP
        columns.append((arcs_tip(displacement + step) - arcs_tip(displacement - step)) / (2.0 * _STEP))
    return np.stack(columns, axis=2)


def _arc(a: Floats, b: Floats, long: Floats) -> tuple[Floats, Floats, Floats]:
    """End of an arc of this length [m] that bends by a toward d1 and b toward d2 [rad], in the frame of its
    beginning."""
    bend = np.hypot(a, b)
    aside = 0.5 * long * np.sinc(0.5 * bend / np.pi) ** 2
    return a * aside, b * aside, long * np.sinc(bend / np.pi)
