"""Viscoelastic body or tendons: part of the bend comes late."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from fastrod.effects.base import Operator, Parameter, Seam, Signal, effect
from fastrod.kernels.operators import relaxation
from fastrod.model.routing import Routing
from fastrod.types import Floats


@effect
class Creep(Operator):
    """Viscoelastic body or tendons: part of the bend comes late.

    Equation: l -> l - c (l - x), tau x' = l - x
    Symbols: c share, tau time_constant, l a tendon's commanded change of length, x its slow part
    Source: standard linear solid (Zener); creep of polymer tendons and silicone bodies
    Residual signature: after a step it decays with time whatever the direction; loops that depend on speed
    """

    seam = Seam.ACTUATION
    order = 55.0
    parameters = (
        Parameter("share", "", bounds=(0.0, 1.0), typical=0.08, starts=(0.08,), per="drive", shared=True),
        Parameter(
            "time_constant",
            "s",
            neutral=5.0,
            bounds=(0.05, 300.0),
            typical=5.0,
            starts=(0.5, 3.0, 15.0, 60.0),
            shape=True,
        ),
    )
    excited_by = "steps and holds of several time constants, the same path at two speeds"
    confounded_with = ("friction", "time_drift", "second_order_lag")
    synonyms = ("relaxation", "viscoelasticity")
    separated_by: ClassVar[Mapping[str, str]] = {
        "second_order_lag": "holds of 4 s and more",
        "time_drift": "the first block of motion once more at the end",
    }
    signal = Signal.LAG
    frequent = True

    def memory(self, n_robots: int, n_tendons: int) -> Floats:
        return np.full((n_robots, 2 * n_tendons), np.nan)

    def sweep(self, values: Floats, memory: Floats, dl: Floats, dt: Floats, routing: Routing) -> Floats:
        out = dl.copy()
        tau = np.repeat(values[:, -1:], routing.n_tendons, axis=1)
        relaxation(out, memory, routing.by_tendon(values[:, :-1]), tau, dt)
        return out
