"""Shapes along chains of neighbouring inputs: the last solutions predict the next (continuation).

The boundary unknowns x of a robot whose inputs move along a smooth curve are a smooth function of arclength
on it. A polynomial through the last four solutions is then so good a guess that one Newton pass, and one more
with the gain of the first, which is a quarter of the work, bring the residual below the tolerance. Where they
do not, `fastrod.solver.settle` solves it, from the same guess or cold.
"""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np

from fastrod.model.compile import compile_robots
from fastrod.model.robot import Robot
from fastrod.solver.boundary import BoundarySolver, new_shape
from fastrod.solver.inputs import Inputs, Reader
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

    def settle(self, given: Inputs, tolerance: float) -> Settled:
        """The next shapes of all chains: inputs as for `Simulator.settle`, each robot's own, boundary
        residual within `tolerance` [m].

        Raises `InputError` for inputs that no robot can have; a row that does not converge is not ok.
        """
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
