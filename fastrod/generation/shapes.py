"""Shapes at rest: random commands and tip forces of one robot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, final

import numpy as np

from fastrod.checks import Bound, check_number
from fastrod.errors import InputError
from fastrod.generation.columns import Column, numbered, several
from fastrod.generation.draws import robot_of
from fastrod.model.compile import compile_robots
from fastrod.model.robot import Robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.rotation import matrix_from_quaternion, quaternion_from_matrix
from fastrod.simulator import Simulator
from fastrod.solver.boundary import BoundarySolver, new_shape
from fastrod.solver.inputs import Inputs, Reader
from fastrod.solver.options import Modal, solver_of
from fastrod.solver.settle import settle
from fastrod.types import Flags, Floats, Ints, Ports, RodShape

_EXTRAPOLATION = ((1.0,), (2.0, -1.0), (3.0, -3.0, 1.0), (4.0, -6.0, 4.0, -1.0))
"""Weights of the last solutions, newest first, by how many there are."""
_NEAR = 0.06  # of the robot's length: a guess with a larger residual is left to damped Newton
_ROUNDS = 5  # passes with the gain of a full one
_ANEW = (2, 4)  # rounds before which that is taken anew
_STILL = 1e-6  # of EI/(d l): tensions that move by more are not there yet, as `settle` has it
_NOISE = 1e-20


class Settled(NamedTuple):
    """A batch of shapes at rest; new arrays, robot axis first, world frame."""

    shape: RodShape
    ok: Flags
    """(n,) the residual is within the tolerance."""


@final
class ChainSolver:
    """A batch of one robot, without effects and contact, that goes along `n` chains side by side."""

    def __init__(self, robot: Robot, n: int, points_per_segment: int, threads: int = 1) -> None:
        """`points_per_segment` as for `Simulator`. With `threads` more than one a process of its own is the
        better use of a core (perf/bench_generate.py)."""
        self.layout, self.params, rest = compile_robots((robot,), points_per_segment)
        self._reader = Reader(self.layout, self.params, rest, n)
        self._passes = BoundarySolver(self.layout, self.params, n, threads, propagate=False)
        self._rows = np.arange(n)
        self._past: list[Floats] = []
        self._near = _NEAR * float(self.params.rod_length[0])
        self._rods: Simulator | None = None  # of a robot that the observer does not solve
        if isinstance(solver_of([robot]), Modal):
            self._rods = Simulator(robot, n, points_per_segment=points_per_segment, threads=threads)

    def settle(self, given: Inputs, tolerance: float) -> Settled:
        """The next shapes of all chains: inputs as for `Simulator.settle`, each robot's own, boundary
        residual within `tolerance` [m].

        Raises `InputError` for inputs that no robot can have; a row that does not converge is not ok.
        """
        if self._rods is not None:
            state = self._rods.settle(**given._asdict(), tolerance=tolerance)
            return Settled(state.as_shape(), state.ok)
        ports = self._reader.ports(given)
        shape = new_shape(self.layout, self._passes.n_robots, "full", holes=True)
        left = self._rows if not self._past else self._follow(ports, shape, tolerance)
        ok = np.ones(len(self._rows), bool)
        if len(left):

            def run(which: Ints, at: Ports) -> Floats:
                self._passes.run(which, at, shape, noise=_NOISE)
                return np.asarray(shape.residual[which])

            warm = np.full(len(self._rows), bool(self._past))
            used = settle(left, warm, self._passes, ports, tolerance, run)
            ok[left] = used[left] > 0
        ok &= shape.residual <= tolerance
        self._past = [self._passes.memory.x.copy(), *self._past[: len(_EXTRAPOLATION) - 1]]
        return Settled(shape, ok)

    def _follow(self, ports: Ports, shape: RodShape, tolerance: float) -> Ints:
        """Guess by the past and correct; the robots that are not there yet, back at their guess."""
        memory, weights = self._passes.memory, _EXTRAPOLATION[len(self._past) - 1]
        guess = weights[0] * self._past[0]
        for weight, x in zip(weights[1:], self._past[1:], strict=True):
            guess += weight * x
        memory.x[:] = guess
        self._passes.run(self._rows, ports, shape, noise=_NOISE)
        near = shape.residual < self._near
        left, far = np.flatnonzero(near), np.flatnonzero(~near)
        n_free = len(self.layout.free_tendon)
        for attempt in range(_ROUNDS):
            if not len(left):
                break
            if attempt in _ANEW:
                self._passes.run(left, ports, shape, noise=_NOISE)
            before = memory.x[left, 3 : 3 + n_free]
            self._passes.run(left, ports, shape, n_col=0)
            moved = np.abs(memory.x[left, 3 : 3 + n_free] - before).max(1, initial=0.0)
            there = (shape.residual[left] <= tolerance) & (moved <= _STILL * self.params.tension_scale[0])
            left = left[~there]
        left = np.sort(np.concatenate([left, far]))
        memory.x[left] = guess[left]
        # `settle` starts from this guess, and does not move it to the new inputs
        self._passes.arrive_at(left, ports)
        return left


STEP_ANGLE = 0.0625
"""Rad on each great circle between neighbours of a chain."""
LONGEST_CHAIN = 100
"""Rows: so that no circle closes, 100 * 0.0625 rad < 2 pi."""
_LOAD = 2.0  # tip force by default, in EI/l^2: bends every robot well, and has one equilibrium


@final
@dataclass(frozen=True, kw_only=True)
class Shapes:
    """Commands drawn evenly: each segment's bend from a disc, its extension from its range, the tip force
    from a ball.

    A row is a point on a great circle of a sphere for each of these. By Archimedes, two coordinates of a
    point even on the sphere of four dimensions are even in the disc, three of five even in the ball, one of
    three even in the interval: each row by itself is distributed exactly so, and neighbours of a chain,
    `STEP_ANGLE` apart on every circle, are near each other. Chains are independent.
    """

    robot: str = field(repr=False)
    """A robot file's text."""
    bend: float = 1.0
    """Radius of the disc of a segment's bend [rad]."""
    force: float = -1.0
    """Radius of the ball of tip forces [N]; below zero stands for 2 EI/l^2 of the softest segment and the
    whole length."""
    tolerance: float = 1e-6
    """Largest boundary residual of a row that is ok [m]."""
    points_per_segment: int = 6
    """Integration steps of a segment."""
    points: int = 0
    """Backbone positions in a row, evenly by nodes, the last at the tip."""
    chain: int = 64
    """Rows of a chain; 1 draws every row on its own, and settles it cold."""

    def __post_init__(self) -> None:
        check_number("bend", self.bend, Bound(above=0.0, most=3.0, unit="rad"))
        check_number("tolerance", self.tolerance, Bound(least=1e-12, most=1e-2, unit="m"))
        check_number("points_per_segment", self.points_per_segment, Bound(least=2, most=200), whole=True)
        check_number("chain", self.chain, Bound(least=1, most=LONGEST_CHAIN), whole=True)
        robot = robot_of(self.robot)
        if robot.effects:
            raise InputError(
                f"robot {robot.name!r} has effects; a shape is that of the plain rod: take them out, or "
                "generate rollouts, which have them."
            )
        SegmentActions(robot)
        if isinstance(self.force, (int, float)) and self.force < 0.0:
            softest = min(min(segment.bending_stiffness) for segment in robot.segments)
            object.__setattr__(self, "force", float(f"{_LOAD * softest / robot.length**2:.3g}"))
        check_number("force", self.force, Bound(least=0.0, unit="N"))
        nodes = robot.n_segments * self.points_per_segment
        check_number("points", self.points, Bound(least=0, most=nodes), whole=True)
        if self.points and nodes % self.points:
            near = min((k for k in range(1, nodes + 1) if nodes % k == 0), key=lambda k: abs(k - self.points))
            raise InputError(
                f"points is {self.points}; the rod has {nodes} steps, of which they must be an "
                f"even fraction, such as {near}."
            )

    @property
    def index(self) -> str:
        """Rows are counted."""
        return "row"

    @property
    def usual(self) -> int:
        """Rows of a shard."""
        return 32768

    def make(self, first: int, count: int, seed: Sequence[int]) -> list[Column]:
        """`count` shapes, those of a chain scattered over the shard."""
        rng = np.random.default_rng(seed)
        robot = robot_of(self.robot)
        lanes = -(-count // self.chain)
        draw = Draw(self, robot, lanes, rng)
        solver = ChainSolver(robot, lanes, self.points_per_segment)
        rows = [
            self._rows(robot, at, solver.settle(self._inputs(robot, at), self.tolerance))
            for at in map(draw.at, range(self.chain))
        ]
        order = rng.permutation(count)
        columns = [Column("row", np.arange(first, first + count), "", "counts over the whole data set")]
        chain = np.tile(np.arange(lanes), self.chain)[:count][order] + first
        columns.append(
            Column("chain", chain, "", "rows of a chain are neighbours: keep them on one side of a split")
        )
        for same in zip(*rows, strict=True):
            values = np.concatenate([column.values for column in same])[:count][order]
            columns.append(Column(same[0].name, values, same[0].unit, same[0].about))
        return columns

    def failed(self, columns: Sequence[Column]) -> int:
        """Rows that did not converge."""
        return sum(int((~np.asarray(column.values)).sum()) for column in columns if column.name == "ok")

    def _inputs(self, robot: Robot, drawn: Drawn) -> Inputs:
        rotation = matrix_from_quaternion(np.array(robot.base_quaternion))
        return Inputs(
            tendon_length=robot.rest_tendon_length + drawn.dl,
            extension=drawn.extension,
            tip_force=drawn.force @ rotation.T,
        )

    def _rows(self, robot: Robot, drawn: Drawn, settled: Settled) -> list[Column]:
        """One row of each lane; base frame, as in a run log."""
        shape, ok = settled
        rotation = matrix_from_quaternion(np.array(robot.base_quaternion))
        origin = np.array(robot.base_position)
        lost = ~ok[:, None]

        def seen(a: Floats, kind: type = np.float32) -> np.ndarray:
            """Return the columns of the outputs; nan in a row that did not converge."""
            return np.where(lost, np.nan, a).astype(kind)

        tip = (shape.tip_position - origin) @ rotation
        quaternion = quaternion_from_matrix(
            rotation.T @ np.where(lost[:, :, None], np.eye(3), shape.tip_rotation)
        )
        wrench = np.concatenate(
            [shape.base_wrench[:, :3] @ rotation, shape.base_wrench[:, 3:] @ rotation], axis=1
        )
        columns = numbered(
            "dl",
            drawn.dl,
            "m",
            "change of a tendon's length against the straight rest robot; negative is pulled",
        )
        columns += numbered("ext", drawn.extension, "m", "change of a segment's length")
        columns += several(("tip_fx", "tip_fy", "tip_fz"), drawn.force, "N", "force on the tip, base frame")
        columns += several(("tip_x", "tip_y", "tip_z"), seen(tip, np.float64), "m", "tip, base frame")
        columns += several(("tip_qw", "tip_qx", "tip_qy", "tip_qz"), seen(quaternion), "", "base_from_tip")
        columns += numbered("tension", seen(shape.tension), "N", "tension of a tendon")
        names = ("base_fx", "base_fy", "base_fz")
        columns += several(names, seen(wrench[:, :3]), "N", "force of the rod on its base, base frame")
        columns += several(
            ("base_mx", "base_my", "base_mz"),
            seen(wrench[:, 3:]),
            "N m",
            "moment of the rod on its base, base frame",
        )
        if self.points:
            every = (shape.position.shape[1] - 1) // self.points
            nodes = (shape.position[:, every::every] - origin) @ rotation
            for k in range(self.points):
                names = (f"p{k + 1}_x", f"p{k + 1}_y", f"p{k + 1}_z")
                columns += several(
                    names,
                    seen(nodes[:, k]),
                    "m",
                    f"backbone after {k + 1} of {self.points} sections, base frame",
                )
        columns.append(
            Column("residual", shape.residual.astype(np.float32), "m", "largest boundary residual")
        )
        columns.append(Column("ok", ok.copy(), "", f"the residual is within {self.tolerance:g} m"))
        return columns


class Drawn(NamedTuple):
    """Inputs of a row of each lane."""

    dl: Floats
    """(n, n_tendons) [m]."""
    extension: Floats
    """(n, n_segments) [m]."""
    force: Floats
    """(n, 3) base frame [N]."""


@final
class Draw:
    """Great circles of `n` chains."""

    def __init__(self, work: Shapes, robot: Robot, n: int, rng: np.random.Generator) -> None:
        self._work, self._actions = work, SegmentActions(robot)
        self._range = np.array([segment.extension for segment in robot.segments])
        self._bend = _circle(rng, (n, robot.n_segments, 4))
        self._extension = _circle(rng, (n, robot.n_segments, 3))
        self._force = _circle(rng, (n, 5))

    def at(self, step: int) -> Drawn:
        """The rows number `step` of the chains."""
        work, actions = self._work, self._actions
        bend = work.bend * _on(self._bend, step)[..., :2]
        low, high = self._range.T
        extension = low + (high - low) * 0.5 * (1.0 + _on(self._extension, step)[..., 0])
        extension = np.clip(extension, low, high)  # a rounding below the end is none
        action = np.concatenate([extension[..., None], bend * actions.offset[:, None]], axis=-1).reshape(
            len(bend), -1
        )
        dl = np.zeros((len(bend), actions.robot.n_tendons))
        # in one order: a batch is its rows bit by bit
        for k, row in enumerate(actions.matrix[: actions.robot.n_tendons].T):
            dl += action[:, k, None] * row
        return Drawn(dl, extension, work.force * _on(self._force, step)[:, :3])


def _circle(rng: np.random.Generator, shape: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Two orthogonal unit vectors, even over all great circles of the sphere in the last axis."""
    a, b = rng.normal(size=shape), rng.normal(size=shape)
    a /= np.linalg.norm(a, axis=-1, keepdims=True)
    b -= (a * b).sum(-1, keepdims=True) * a
    return a, b / np.linalg.norm(b, axis=-1, keepdims=True)


def _on(circle: tuple[Floats, Floats], step: int) -> Floats:
    return np.asarray(math.cos(step * STEP_ANGLE) * circle[0] + math.sin(step * STEP_ANGLE) * circle[1])
