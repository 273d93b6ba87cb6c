"""`RestingRods`: rods among obstacles, free ones by the observer, those that touch as rods of modes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from fastrod.contact.engine import Engine
from fastrod.errors import InputError
from fastrod.model.robot import Robot
from fastrod.solver.inputs import Inputs
from fastrod.solver.motion import ModalMemory
from fastrod.solver.observer import ObserverSolver
from fastrod.solver.options import Modal, Observer
from fastrod.solver.protocol import Acting, How, Last, LinearResponse, Solved
from fastrod.solver.response import Relocate
from fastrod.solver.touching import AT_REST, TouchingRods
from fastrod.types import Flags, Floats, Ints, Layout, Memory, Params, Ports, RodShape


class RestingMemory(NamedTuple):
    """Memory of both solvers, and whose last shape is one of modes."""

    boundary: Memory
    modes: ModalMemory
    by_modes: Flags


class Either(NamedTuple):
    """The linear response of robots of both kinds (`LinearResponse`)."""

    free: LinearResponse
    pressed: LinearResponse
    by_modes: Flags

    def jacobian(self, relocate: Relocate | None = None, turning: bool = False) -> Floats:
        """(n_robots, 6, n_inputs) of the tip."""
        both = (each.jacobian(relocate, turning) for each in (self.pressed, self.free))
        return np.where(self.by_modes[:, None, None], *both)

    def by_load(self) -> Floats:
        """(n_robots, 6, 6) of the tip, by force and moment on it."""
        return np.where(self.by_modes[:, None, None], self.pressed.by_load(), self.free.by_load())


class RestingRods:
    """Robots of one layout at rest among obstacles (`Solver`). One that begins to touch, or lets go, goes on
    from the shape in which the other solver left it."""

    def __init__(
        self,
        engine: Engine,
        options: Observer,
        robots: tuple[Robot, ...],
        layout: Layout,
        params: Params,
        n_robots: int,
        *,
        threads: int,
        dt: float,
        **named: Any,
    ) -> None:
        """Raises `InputError` for robots of mode `paper`."""
        if layout.paper:
            raise InputError(
                "contact was given with mode 'paper', which has no energy, and so no contact; give segments "
                "of tendon_length, or feel_contact=False."
            )
        self.engine, self.threads = engine, threads
        shared: Any = {"dt": dt, "outputs": "full", "threads": threads}
        self.free = ObserverSolver(options, layout, params, n_robots, **{**named, **shared})
        self.pressed = TouchingRods(engine, Modal(), robots, layout, params, n_robots, **shared)
        self._by_modes = np.zeros(n_robots, bool)  # whose last shape is one of modes

    def accept(self, given: Inputs, how: How | None) -> None:
        """Raise `InputError` for what the observer does not take."""
        self.free.accept(given, how)

    def new_shape(self, outputs: Literal["full", "tip"], holes: bool) -> RodShape:
        """Return room for a shape."""
        return self.free.new_shape(outputs, holes)

    def remember(self, ports: Ports, pulled: bool, last: Last) -> None:
        """Make room for what the observer must know of these inputs."""
        self.free.remember(ports, pulled, last)

    def step(self, rows: Ints, acting: Acting, last: Last, how: How) -> Solved:
        """One pass of the observer; robots that touch something come to rest."""
        return self._solved(rows, acting, last, AT_REST, lambda free: self.free.step(free, acting, last, how))

    def settle(self, rows: Ints, acting: Acting, last: Last, tolerance: float) -> Solved:
        """Bring these robots to rest, to `tolerance` [m]."""
        given = acting, last, tolerance
        return self._solved(rows, *given, lambda free: self.free.settle(free, *given))

    def _solved(
        self, rows: Ints, acting: Acting, last: Last, tolerance: float, by_observer: Callable[[Ints], Solved]
    ) -> Solved:
        engine, by_modes = self.engine, self._by_modes
        cold = engine.whole_worlds(self._mask(rows) & ~last.warm)
        engine.begin_anew(cold)
        by_modes[cold] = False
        pressed = engine.pressed()
        free = rows[~pressed[rows]]
        self._resume(free[by_modes[free]], last)
        solved = by_observer(free)
        shape, ok = solved.shape, solved.ok.copy()
        meets = pressed | engine.overlap(free[ok[free]], shape)
        if len(some := rows[meets[rows]]):
            found = self.pressed.begin(acting)
            if engine.before is not None and last.ports is not None:
                self.pressed.take_over(some[~(by_modes | cold)[some]], engine.before, last.ports, found)
            ok[some] = self.pressed.rest_pressed(some, cold, acting, last, found, tolerance)[some]
            for ours, theirs in zip(shape, found.shape, strict=True):
                ours[some] = theirs[some]
            more = self.pressed.end(some, ok, found, acting, last)
            by_modes[some] = True
            passes = np.where(meets, more.passes, solved.passes)
            solved = solved._replace(
                ok=ok, passes=passes, problems=more.problems, held=more.held, jacobian=None
            )
        else:
            engine.end_step(np.ones(len(ok)))
        engine.accept(rows[ok[rows]], shape)
        return solved

    def _resume(self, rows: Ints, last: Last) -> None:
        """Let the observer go on from the last shape of these robots, and learn the gain there."""
        shape, ports, passes = self.engine.before, last.ports, self.free.passes
        self._by_modes[rows] = False
        if not len(rows) or shape is None or ports is None:
            return
        memory, n_free = passes.memory, len(passes.layout.free_tendon)
        memory.x[rows, :3] = shape.moment[rows, 0]
        memory.x[rows, 3 : 3 + n_free] = shape.tension[rows][:, passes.layout.free_tendon]
        if len(ports.follower_force):
            force = np.broadcast_to(ports.follower_force, (len(self._by_modes), 3))[rows]
            memory.x[rows, -3:] = np.einsum("nij,nj->ni", shape.tip_rotation[rows], force)
        memory.curvature_guess[rows] = shape.curvature[rows, 0]
        passes.arrive_at(rows, ports)
        self.free.learn(rows, ports)

    def _mask(self, rows: Ints) -> Flags:
        return np.isin(np.arange(len(self._by_modes)), rows)

    def response(self, acting: Acting, warm: Flags) -> LinearResponse:
        """Return the linear response of the last shape, contact forces held."""
        free = self.free.response(acting, warm & ~self._by_modes)
        if not (by_modes := self._by_modes & warm).any():
            return free
        return Either(free, self.pressed.linear(acting, by_modes), by_modes)

    def tip_compliance(self, acting: Acting, warm: Flags, *, in_step: bool) -> Floats:
        """(n_robots, 3, 3) by how much the tip gives to a force [m/N]."""
        free = self.free.tip_compliance(acting, warm & ~self._by_modes, in_step=in_step)
        if not (by_modes := self._by_modes & warm).any():
            return free
        pressed = self.pressed.tip_compliance(acting, by_modes, in_step=in_step)
        return np.where(by_modes[:, None, None], pressed, free)

    def unstable(self, acting: Acting, shape: RodShape, rows: Ints) -> Ints:
        """Those of `rows` that touch nothing, and whose shape balances its loads but would not stay."""
        return self.free.unstable(acting, shape, rows[~self._by_modes[rows]])

    def replace(self, robots: Sequence[Robot]) -> None:
        """Take other robots of the same layout, one for all or one each."""
        self.pressed.replace(robots)

    def snapshot(self) -> RestingMemory:
        """Return a copy of what is remembered."""
        return RestingMemory(self.free.snapshot(), self.pressed.snapshot(), self._by_modes.copy())

    def check(self, kept: object) -> None:
        """Raise `InputError` where this is no snapshot of such rods."""
        if not isinstance(kept, RestingMemory):
            raise InputError(
                "the snapshot is of another simulator; its solver differs, or its contact scene."
            )
        self.free.check(kept.boundary)
        self.pressed.check(kept.modes)

    def restore(self, kept: RestingMemory, rows: Flags | None, acting: Acting | None, then: Last) -> None:
        """Go back to a snapshot, or in these robots alone."""
        self.free.restore(kept.boundary, rows, acting, then)
        self.pressed.restore(kept.modes, rows, acting, then)
        self._by_modes = (
            kept.by_modes.copy() if rows is None else np.where(rows, kept.by_modes, self._by_modes)
        )
