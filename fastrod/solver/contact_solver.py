"""The rods' solver as contact calls it (`fastrod.contact.step.ContactSolver`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fastrod.solver.boundary import BoundarySolver
from fastrod.solver.recovery import TOLERANCE, Boundary
from fastrod.solver.settle import LOST, frozen_noise, frozen_pass, settle
from fastrod.types import Flags, Floats, Ints, PointLoads, Ports, RodShape


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
