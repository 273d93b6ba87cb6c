"""Whether a contact iteration comes closer to rest, and how much it is damped where it does not."""

from __future__ import annotations

import numpy as np

from fastrod.types import Floats, Ints

_CLOSER = 0.8  # of the smallest distance to rest so far: what counts as closer
# The damping to begin with. Every second try begins with the most and eases more slowly: with it 49 of 248
# steps of perf/contact_scenes.py were left unsolved, 66 without (passes without forces refused in both).
_DAMPING = 1.5
_EASES = 0.7  # of the damping, after a pass that left the robot about as far from rest as the last
_STIFFENS = 2.5  # of the damping, after one that left it much farther
_GROWN = 1.6  # of the last distance: a little more than what easing alone brings, 1 / 0.7
_LEAST, _MOST = 1e-4, 6.0  # of the damping
_REFUSED = 4.0  # of the damping, after a pass that was taken back


class Progress:
    """Distance of robots from rest, iteration by iteration."""

    def __init__(self, n: int) -> None:
        self.nearest = np.full(n, np.inf)
        """(n_robots,) the least distance from rest so far [m]."""
        self.idle = np.zeros(n, np.int64)
        """(n_robots,) passes since a robot came closer."""

    def note(self, rows: Ints, far: Floats) -> None:
        """Note how `far` these robots are from rest now [m]."""
        closer = far < _CLOSER * self.nearest[rows]
        self.idle[rows] = np.where(closer, 0, self.idle[rows] + 1)
        self.nearest[rows] = np.where(closer, far, self.nearest[rows])


class Damping:
    """The damping of an iteration that goes downhill (after Levenberg 1944 and Marquardt 1963).

    It eases with every pass after which a robot is about as far from rest as before, or nearer, and stiffens
    with one after which it is much farther, or which has to be taken back.
    """

    def __init__(self, amount: Floats, rows: Ints, tries: Ints) -> None:
        """`amount` (n_robots,) is `ContactMotion.damping` and written to; `rows` begin; `tries` (n_robots,)
        counts from 1."""
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
