"""Robots whose observer pass diverged are settled on the same inputs; the others keep every bit."""

from __future__ import annotations

import numpy as np

from fastrod.solver.boundary import BoundarySolver
from fastrod.solver.settle import Pass, load_parameter, settle
from fastrod.types import Flags, Floats, Ints, Ports

TOLERANCE = 1e-9  # m: that of `Simulator.settle`
# of F l^2/EI: on three shipped robots `settle` solves all of 180 random tip forces of 20, 8 to 100 % of those
# of
# 50, and at most 2 % of those of 200
_HOPELESS = 30.0


class Boundary:
    """The boundary before a step, kept until it is known that nobody diverged: 21 numbers of a five-segment
    robot."""

    def __init__(self, passes: BoundarySolver) -> None:
        self._passes = passes
        # on a GPU a copy would have to come here at every step; its robots begin from the cold guess instead
        on_gpu = passes.device == "cuda"
        self._kept = None if on_gpu else (passes.x.copy(), passes.memory.curvature_guess.copy())

    def put_back(self, rows: Ints, ports: Ports) -> None:
        """These robots stand where they stood before the step, on the inputs `ports`; what the pass learned
        is forgotten."""
        memory = self._passes.memory
        if self._kept is not None:
            memory.x[rows], memory.curvature_guess[rows] = self._kept[0][rows], self._kept[1][rows]
        memory.gain[rows] = 0.0
        if len(memory.covariance):
            memory.covariance[rows] = 0.0
        self._passes.arrive_at(rows, ports)

    def recover(self, lost: Ints, warm: Flags, ports: Ports, run: Pass) -> Ints:
        """`settle` these robots on `ports`: from where they stood, then from the cold guess, then by their
        loads.

        (n_robots,) passes that each took, -1 where none of these ended below `TOLERANCE`: they stand where
        they stood.
        """
        self.put_back(lost, ports)
        known = warm if self._kept is not None else np.zeros_like(warm)
        used = settle(lost, known, self._passes, ports, TOLERANCE, run)
        if len(failed := lost[used[lost] < 0]):
            self.put_back(failed, ports)
        if len(self._passes.memory.covariance):
            self._passes.memory.covariance[lost] = 0.0
        return used


def overloaded(passes: BoundarySolver, ports: Ports, row: int) -> float:
    """F l^2/EI of a robot's loads where that is beyond what a rod can hold, else 0."""
    size = float(load_parameter(np.array([row]), passes.params, ports)[0])
    return size if size > _HOPELESS else 0.0


def what_to_do(passes: BoundarySolver, ports: Ports, row: int) -> str:
    """The end of a sentence about a robot without a shape: what to change."""
    if size := overloaded(passes, ports, row):
        force = _of(passes.params.moment_scale, row) / _of(passes.params.reach, row)
        return f"its loads are {size:.3g} times what bends it, EI/l^2 = {force:.3g} N: give less load"
    return "give inputs that a rod of this length can follow, or come there in smaller changes"


def _of(a: Floats, row: int) -> float:
    return float(a[row if len(a) > 1 else 0])
