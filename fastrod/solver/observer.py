"""`ObserverSolver`: rods at rest by one forward integration a step, from the boundary that they remember."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from fastrod.errors import InputError, Problem, shown
from fastrod.model.robot import Robot
from fastrod.solver.boundary import BoundarySolver, new_shape
from fastrod.solver.gpu.device import Device
from fastrod.solver.inputs import Inputs
from fastrod.solver.options import Observer
from fastrod.solver.protocol import Acting, How, Last, LinearResponse, Solved
from fastrod.solver.recovery import HOPELESS, Boundary, unstable
from fastrod.solver.response import Linear
from fastrod.solver.settle import LOST, cold_start, frozen_pass, settle
from fastrod.types import Flags, Floats, Ints, Layout, Memory, Params, Ports, RodShape

DIVERGED = "the observer diverged, and no shape was found on these inputs"
_HIGH = 100.0  # 1/s: process noise at which a step is a Gauss-Newton step


class ObserverSolver:
    """Robots of one layout, and the boundary that they carry from step to step (`Solver`)."""

    def __init__(
        self,
        options: Observer,
        layout: Layout,
        params: Params,
        n_robots: int,
        *,
        dt: float,
        outputs: Literal["full", "tip"],
        threads: int,
        device: Device,
        recover: bool,
    ) -> None:
        """`recover`: robots whose pass diverges are settled."""
        self.options, self.dt, self.outputs, self.threads = options, dt, outputs, threads
        self.recover = recover
        self.passes = BoundarySolver(
            layout, params, n_robots, threads, options.process_noise is not None, device
        )
        self._all = np.arange(n_robots)
        self._learns = False  # the gain is to know a tip force that has begun to move

    def accept(self, given: Inputs, how: How | None) -> None:
        """Raise `InputError` for what only rods of modes take."""
        if given.follower_line_force is not None:
            raise InputError(
                "follower_line_force was given, but the observer has line forces of the world only; take "
                "solver='modal'."
            )
        if how is None:
            return
        if how.estimate_error:
            raise InputError("estimate_error is of steps in time; give Simulator(robot, dynamics=True).")
        if how.passes != 1:
            raise InputError(
                f"passes is {shown(how.passes)}; the observer takes one a step, as settle takes many."
            )
        if how.inverse_inertia is not None:
            raise InputError("inverse_inertia needs rods with inertia; give Simulator(robot, dynamics=True).")
        self.dt = how.dt

    def new_shape(self, outputs: Literal["full", "tip"], holes: bool) -> RodShape:
        """Return room for a shape."""
        return new_shape(self.passes.layout, len(self._all), outputs, holes)

    def remember(self, ports: Ports, pulled: bool, last: Last) -> None:
        """Widen the memory for a follower force, and for a tip force that moves."""
        tracked, force = self.passes.tracks_force, None if last.ports is None else last.ports.tip_force
        track = tracked or pulled or _moves(force, ports.tip_force, last.warm)
        self.passes.remember(len(ports.follower_force) > 0, track, force)
        self._learns = force is not None and self.passes.tracks_force and not tracked

    def step(self, rows: Ints, acting: Acting, last: Last, how: How) -> Solved:
        """One pass of these robots; those that diverge are settled."""
        passes, ports, before, n = self.passes, acting.ports, last.ports, len(self._all)
        passes.params = acting.params
        kept = passes.kept if self.recover else None
        if before is not None:
            if self._learns and _alike(before, ports):
                self.learn(rows[last.warm[rows]], before)
            passes.stretch(rows, ports.extension - before.extension)
        if len(cold := rows[~last.warm[rows]]):
            cold_start(cold, passes.layout, passes.params, ports, passes.memory)
        jacobian, (process, noise) = None, self.noise
        if how.derive and len(rows) == n and (linear := Linear(passes, rows, ports)).fits(turning=True):
            shape, jacobian = linear.step(how.relocate, True, self.outputs, process=process, noise=noise)
        else:
            shape = self.new_shape(self.outputs, len(rows) < n)
            cheap = self._keeps_jacobian(last)[rows]
            if cheap.any():
                passes.run(rows[cheap], ports, shape, predict=True, n_col=0)
            if not cheap.all():
                propagate = passes.propagate
                passes.run(
                    rows[~cheap],
                    ports,
                    shape,
                    predict=True,
                    propagate=propagate,
                    process=process,
                    noise=noise,
                )
            passes.collect(shape)
        ok = passes.finite & (shape.residual < LOST * passes.params.rod_length)
        used: Ints = np.broadcast_to(np.int64(1 + self._learns), n)
        if len(rows) < n:
            read = np.isin(self._all, rows)
            ok, used = ok & read, np.where(read, used, 0)
        if self.recover and not ok[rows].all():
            lost, jacobian = rows[~ok[rows]], None
            more = Boundary(passes, kept).recover(lost, last.warm, ports, frozen_pass(passes, shape))
            passes.collect(shape)
            ok |= (more > 0) & (shape.residual < LOST * passes.params.rod_length)
            used = np.where(more < 0, -1, used + more)
        return Solved(shape, ok, used, ports, DIVERGED, Problem.DIVERGED, jacobian=jacobian)

    def settle(self, rows: Ints, acting: Acting, last: Last, tolerance: float) -> Solved:
        """Repeat the pass on frozen inputs until every residual is below `tolerance` [m]."""
        passes, ports = self.passes, acting.ports
        passes.params = acting.params
        shape = self.new_shape(self.outputs, len(rows) < len(self._all))
        used = settle(rows, last.warm, passes, ports, tolerance, frozen_pass(passes, shape))
        passes.collect(shape)
        if passes.propagate:
            passes.memory.covariance[rows] = 0.0
        ok = np.zeros(len(self._all), bool)
        ok[rows] = used[rows] > 0
        reason = f"settle did not bring the boundary residual below {tolerance:g} m"
        if not ok[rows].all() and (shape.residual[rows[~ok[rows]]] <= tolerance).any():
            reason = f"settle found no boundary that rests with a residual below {tolerance:g} m"
        return Solved(shape, ok, used, ports, reason, Problem.NOT_CONVERGED)

    @property
    def noise(self) -> tuple[float, float]:
        """Process and measurement noise of one step."""
        return (self.options.process_noise or _HIGH) * self.dt, self.options.measurement_noise / self.dt

    def learn(self, rows: Ints, ports: Ports) -> None:
        """A pass on the inputs at which these robots are: it changes little but the gain."""
        process, noise = self.noise
        shape, propagate = self.new_shape("tip", True), self.passes.propagate
        self.passes.run(rows, ports, shape, propagate=propagate, process=process, noise=noise)

    def _keeps_jacobian(self, last: Last) -> Flags:
        """(n_robots,) these correct the boundary by the gain that they have."""
        tolerance = self.options.kept_jacobian_tolerance
        if not tolerance or self._learns or last.state is None or self.passes.propagate:
            return np.zeros(len(self._all), bool)
        return np.asarray(last.warm & (last.state.residual < tolerance))

    def response(self, acting: Acting, warm: Flags) -> LinearResponse:
        """Return the linear response of the last shape."""
        self.passes.params = acting.params
        return Linear(self.passes, np.flatnonzero(warm), acting.ports)

    def tip_compliance(self, acting: Acting, warm: Flags, *, in_step: bool) -> Floats:
        """(n_robots, 3, 3) by how much the tip gives to a force [m/N]: a step goes on as if nobody had
        looked."""
        kept = self.snapshot()
        by_force = np.asarray(self.response(acting, warm).by_load())[:, :3, :3]
        self.passes.memory = kept
        return by_force

    def unstable(self, acting: Acting, shape: RodShape, rows: Ints) -> Ints:
        """Those of `rows` whose shape balances its loads, but would not stay."""
        if not len(rows) or _largest_load(acting.params, acting.ports) <= HOPELESS:
            return rows[:0]
        return unstable(acting.params, acting.ports, shape, rows)

    def replace(self, robots: Sequence[Robot]) -> None:
        """The numbers of the robots come with every call."""

    def snapshot(self) -> Memory:
        """Return a copy of the memory."""
        return _copied(self.passes.peek())

    def check(self, kept: object) -> None:
        """Raise `InputError` where this is the memory of other rods."""
        if not isinstance(kept, Memory):
            raise InputError(
                "the snapshot is of another simulator; its solver differs, or its contact scene."
            )
        n_rows = len(self.passes.layout.row_tendon)
        if (len(kept.x), kept.length_before.shape[1]) != (len(self._all), n_rows):
            raise InputError(
                "the snapshot is of another simulator; its robots, tendons or their number differ."
            )

    def restore(self, kept: Memory, rows: Flags | None, acting: Acting | None, then: Last) -> None:
        """Go back to a memory, or in these robots alone."""
        passes = self.passes
        if rows is None or acting is None or then.ports is None:
            passes.memory = _copied(kept)
            return
        passes.params = acting.params
        passes.put(
            np.flatnonzero(rows),
            passes.refit(kept, len(acting.ports.follower_force) > 0, then.ports.tip_force),
        )
        if passes.tracks_force and not len(kept.force_before) and _alike(acting.ports, then.ports):
            # their gain knows no tip force yet, which moves by now: learned as `step` does
            self.learn(np.flatnonzero(rows & then.warm), acting.ports)


def _moves(before: Floats | None, force: Floats, warm: Flags) -> bool:
    """The tip force of a running robot changes: from now on the gain for it is worth its three columns."""
    if before is None or not warm.any():
        return False
    same = force.shape == before.shape and np.array_equal(force, before, equal_nan=True)
    every = slice(None) if max(len(force), len(before)) == 1 else warm
    return not same and bool((force != before)[every].any())


def _largest_load(params: Params, ports: Ports) -> float:
    """A cheap upper bound of the load parameter of all robots: a step asks for it every time. nan, where one
    of many robots has an input that cannot be used."""
    length, segments = _largest(params.rod_length), params.length.shape[1]
    shortest = length if len(params.rod_length) == 1 else float(params.rod_length.min())
    force = _largest(ports.tip_force) + _largest(ports.tip_moment) / shortest + _largest(ports.follower_force)
    force += _largest(ports.line_force) * (length + segments * _largest(ports.extension))
    force += _largest(ports.node_force) * ports.node_force.shape[1]
    return float(math.sqrt(3.0) * force * length / params.moment_scale.min())


def _largest(a: Floats) -> float:
    """|a|, of one robot in a third of numpy's time."""
    if a.size <= 16:
        return float(max(map(abs, a.ravel().tolist()), default=0.0))
    return float(np.abs(a).max())


def _alike(one: Ports, other: Ports) -> bool:
    """Both have a follower force, or neither has."""
    return bool(len(one.follower_force)) == bool(len(other.follower_force))


def _copied(memory: Memory) -> Memory:
    """A memory with arrays of its own."""
    return Memory._make(a.copy() for a in memory)
