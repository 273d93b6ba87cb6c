"""Rods of the observer that feel contact: `ContactObserver`, and its passes as contact calls them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fastrod.contact.engine import Engine
from fastrod.contact.frames import blended
from fastrod.contact.step import COLD_ITERATIONS, ContactStep, empty_loads
from fastrod.errors import Problem
from fastrod.solver.boundary import BoundarySolver
from fastrod.solver.observer import DIVERGED, ObserverSolver
from fastrod.solver.protocol import Acting, How, Last, LinearResponse, Solved
from fastrod.solver.recovery import TOLERANCE, Boundary, overloaded, sentence_of
from fastrod.solver.response import Linear, stretch
from fastrod.solver.settle import LOST, frozen_noise, frozen_pass, settle, unloaded
from fastrod.types import Flags, Floats, Ints, PointLoads, Ports, RodShape

_AT_REST = 1e-6  # m: contact and boundary of a step, where `settle` has a tolerance of its own


class ContactObserver(ObserverSolver):
    """The observer's rods, bent by what they touch; they take as many passes a step as bring contact and
    boundary to rest."""

    def __init__(self, engine: Engine, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self.engine = engine

    def step(self, rows: Ints, acting: Acting, last: Last, how: How) -> Solved:
        """One step of these robots, in passes until contact is at rest."""
        return self._run(rows, acting, last, None)

    def settle(self, rows: Ints, acting: Acting, last: Last, tolerance: float) -> Solved:
        """Bring these robots to rest, contact included."""
        return self._run(rows, acting, last, tolerance)

    def _run(self, rows: Ints, acting: Acting, last: Last, tolerance: float | None) -> Solved:
        engine, passes, ports, start = self.engine, self.passes, acting.ports, last.ports
        passes.params = acting.params
        if start is not None:
            stretch(passes, rows, ports.extension - start.extension)
        engine.given_arclength, engine.given_force = acting.points
        process, noise = self.noise
        solver = RodSolver(
            boundary=passes,
            warm=last.warm,
            tolerance=tolerance,
            recovery=Boundary(passes) if self.recover else None,
            process=process,
            noise=noise,
            used=np.zeros(len(self._all), np.int64),
        )
        shape = self.new_shape("full", True)
        ok, done = ContactStep(
            engine=engine,
            solver=solver,
            shape=shape,
            end=ports,
            tolerance=tolerance or _AT_REST,
            most=engine.scene.max_iterations if tolerance is None else COLD_ITERATIONS,
        ).run(rows, last.warm, start, unloaded(ports, passes.layout, passes.params))
        problems = {}
        for i in map(int, rows[~ok[rows]]):
            problems[i] = (
                engine.why(i, float(done[i]))
                if engine.continued[i] and not overloaded(passes.params, ports, i)
                else sentence_of(DIVERGED, Problem.DIVERGED, passes.params, ports, shape, i)
            )
        # a cold robot has no last inputs to go on from: it begins anew
        gone = np.isin(self._all, rows) & ~ok
        held = gone & (engine.continued | self.recover) & engine.tracked & ~engine.whole_worlds(~last.warm)
        if held.any() and start is not None:
            ports = blended(start, ports, done)
        passes.arrive_at(np.flatnonzero(held | (ok & engine.continued)), ports)
        lost = np.flatnonzero(gone & ~(held & engine.continued))
        used = np.where(ok, solver.used, -1)
        return Solved(shape, ok, used, ports, "contact", Problem.CONTACT_STUCK, problems, lost, held)

    def response(self, acting: Acting, warm: Flags) -> LinearResponse:
        """Return the linear response of the last shape, contact forces held."""
        self.passes.params = acting.params
        rows = np.flatnonzero(warm)
        most = int(self.engine.contact_set.used[rows].max(initial=0))
        loads = empty_loads(len(rows), most + 1, self.passes.n_x)
        return Linear(self.passes, rows, self.engine.held(rows, acting.ports, loads), loads)

    def unstable(self, acting: Acting, shape: RodShape, rows: Ints) -> Ints:
        """Those of `rows` that touch nothing that would hold them, as without contact."""
        return super().unstable(acting, shape, rows[~self.engine.continued[rows]])

    def _learn_force(self, rows: Ints, ports: Ports) -> None:
        """Contact learns anew in every step."""


@dataclass(frozen=True, kw_only=True)
class RodSolver:
    """The passes of one step, or `settle`, of a simulator with contact."""

    boundary: BoundarySolver
    warm: Flags
    tolerance: float | None
    """Tolerance of `settle` [m]; None in a step."""
    recovery: Boundary | None
    process: float
    noise: float
    """Process and measurement noise of the observer's correction after a pass."""
    used: Ints
    """(n_robots,) passes that each robot has taken."""

    @property
    def x(self) -> Floats:
        """(n_robots, n_x) boundary unknowns."""
        return self.boundary.memory.x

    def run_free(self, rows: Ints, ports: Ports, into: RodShape, *, settle: bool = False) -> Flags:
        """A step without contact, or with `settle` (and where that is what was called) from the cold guess
        until at rest; (n_robots,) which of these rows are well."""
        if settle or self.tolerance is not None:
            return self._settle(rows, ports, into)
        boundary = self.boundary
        boundary.run(
            rows,
            ports,
            into,
            predict=True,
            propagate=boundary.propagate,
            process=self.process,
            noise=self.noise,
        )
        self.used[rows] += 1
        well = boundary.finite & (into.residual < LOST * boundary.params.rod_length)
        well &= np.isin(np.arange(len(self.used)), rows)
        lost = rows[~well[rows]]
        if self.recovery is not None and len(lost):
            used = self.recovery.recover(lost, self.warm, ports, frozen_pass(boundary, into))
            self.used[lost] += np.abs(used[lost])
            well[lost] = used[lost] > 0
        return np.asarray(well)

    def run_loaded(self, rows: Ints, ports: Ports, into: RodShape, loads: PointLoads) -> None:
        """One pass with these point loads, and how contact points and unknowns move with them."""
        noise = frozen_noise(self.boundary)
        self.boundary.run(rows, ports, into, loads=loads, update=False, noise=noise)
        self.used[rows] += 1

    def _settle(self, rows: Ints, ports: Ports, into: RodShape) -> Flags:
        run = frozen_pass(self.boundary, into)
        used = settle(rows, self.warm, self.boundary, ports, self.tolerance or TOLERANCE, run)
        self.used[rows] += np.abs(used[rows])
        return np.asarray(used > 0)
