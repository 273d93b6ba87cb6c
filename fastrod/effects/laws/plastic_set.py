"""The body yields at large bends and keeps a set."""

from __future__ import annotations

import numpy as np

from fastrod.effects.base import Operator, Parameter, Seam, effect
from fastrod.kernels.operators import yielding
from fastrod.model.routing import Routing
from fastrod.types import Floats


@effect
class PlasticSet(Operator):
    """The body yields at large bends and keeps a set.

    Equation: theta -> theta + c p, p dragged along once |theta - p| > y; it begins at the straight rod
    Symbols: c share, y yield_at, theta the bend that a segment's lengths ask for, p what has set
    Source: elasto-plastic stop with an isotropic yield surface (Visintin 1994)
    Residual signature: nothing until a new extreme, then it stays: the rod does not return to zero
    """

    seam = Seam.ACTUATION
    order = 60.0
    parameters = (
        Parameter("share", "", bounds=(-0.5, 1.0), typical=0.08, starts=(0.08,)),
        Parameter(
            "yield_at",
            "rad",
            neutral=0.7,
            bounds=(0.1, 2.0),
            typical=0.7,
            starts=(0.45, 0.65, 0.85),
            shape=True,
        ),
    )
    excited_by = "growing amplitudes with a return to zero after each"
    confounded_with = ("friction", "time_drift")
    synonyms = ("set", "permanent_set")

    def memory(self, n_robots: int, n_tendons: int) -> Floats:
        return np.full((n_robots, 2 * n_tendons), np.nan)

    def sweep(self, values: Floats, memory: Floats, dl: Floats, dt: Floats, routing: Routing) -> Floats:
        change = routing.bend(dl)
        # where no tendon ends nothing is commanded, and `memory` has no room
        driven = np.unique(routing.tendon_segment)
        bend = np.ascontiguousarray(change[:, :, driven])
        fraction, at = (np.repeat(values[:, k : k + 1], len(driven), axis=1) for k in (0, 1))
        yielding(bend, memory, fraction, at)
        bend -= change[:, :, driven]
        change[:] = 0.0
        change[:, :, driven] = bend
        return dl + routing.tendon_change(change)
