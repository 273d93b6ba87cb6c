"""Whether a contact iteration comes closer to rest, and how much it is damped where it does not."""

from __future__ import annotations

import numpy as np

from fastrod.types import Floats, Ints

_CLOSER = 0.8  # of the smallest distance to rest so far: what counts as closer
# to begin with; a second try begins stiffer and eases more slowly, and comes through where the first does not
_DAMPING = 1.5
_EASES, _STIFFENS = (
    0.7,
    2.5,
)  # of the damping, after a pass that did not move much farther than the last, and after one that did
_GROWN = 1.6  # of the last motion: a little more than what easing alone brings
_LEAST, _MOST = 1e-4, 6.0
_REFUSED = 4.0  # of the damping, after a pass that was taken back


class Progress:
    """How far robots are from rest, pass by pass."""

    def __init__(self, n: int) -> None:
        self.nearest = np.full(n, np.inf)
        self.idle = np.zeros(n, np.int64)
        """(n_robots,) passes since a robot came closer."""

    def note(self, rows: Ints, far: Floats) -> None:
        """How `far` these robots are from rest now [m]."""
        closer = far < _CLOSER * self.nearest[rows]
        self.idle[rows] = np.where(closer, 0, self.idle[rows] + 1)
        self.nearest[rows] = np.where(closer, far, self.nearest[rows])


class Damping:
    """The damping of an iteration that goes downhill (after Levenberg 1944 and Marquardt 1963): it eases with
    every pass that moves little more than the last, and stiffens with one that moves much more or has to be
    taken back."""

    def __init__(self, amount: Floats, rows: Ints, tries: Ints) -> None:
        """`amount` (n_robots,) is written to; `tries` (n_robots,) counts from 1."""
        first = tries % 2 == 1
        self.amount, self.eases = amount, np.where(first, _EASES, np.sqrt(_EASES))
        self.refused = np.zeros(len(amount), np.int64)
        """(n_robots,) passes that were taken back."""
        self._last = np.full(len(amount), np.inf)
        amount[rows] = np.where(first[rows], _DAMPING, _MOST)

    def note(self, rows: Ints, far: Floats) -> None:
        """These robots went on, and are so `far` from rest now [m]."""
        eased = np.maximum(self.eases[rows] * self.amount[rows], _LEAST)
        stiffer = np.minimum(_STIFFENS * self.amount[rows], _MOST)
        self.amount[rows] = np.where(far < _GROWN * self._last[rows], eased, stiffer)
        self._last[rows] = far

    def refuse(self, rows: Ints) -> None:
        """The last pass of these robots was taken back."""
        self.amount[rows] *= _REFUSED
        self.refused[rows] += 1
