"""Lag of second order: the tendons follow their command as a damped oscillator does."""

from __future__ import annotations

import numpy as np

from fastrod.effects.base import Operator, Parameter, Seam, Signal, effect
from fastrod.kernels.operators import second_order
from fastrod.model.routing import Routing
from fastrod.types import Floats


@effect
class SecondOrderLag(Operator):
    """Lag of second order: the tendons follow their command as a damped oscillator does.

    A filter on the tendons, with no mass in it: it rings with the command and not with a load. A rod with
    inertia is `Simulator(dynamics=True)`.

    Equation: T^2 y'' + 2 z T y' + y = theta
    Symbols: T period, z damping, theta the commanded lengths, y what they follow
    Source: second-order lag of linear control, T^2 s^2 + 2 z T s + 1 in the denominator
    Residual signature: ringing after stops, lag that grows with speed
    """

    seam = Seam.ACTUATION
    order = 70.0
    parameters = (
        Parameter("period", "s", bounds=(0.0, 1.0), typical=0.08, starts=(0.03, 0.08, 0.16)),
        Parameter(
            "damping", "", neutral=0.3, bounds=(0.02, 0.98), typical=0.3, starts=(0.1, 0.6), shape=True
        ),
    )
    excited_by = "steps and fast reversals, sampled at ten times the frequency"
    on_forces = True
    confounded_with = ("latency", "creep")
    signal = Signal.MOTION

    def memory(self, n_robots: int, n_tendons: int) -> Floats:
        return np.full((n_robots, 3 * n_tendons), np.nan)

    def sweep(self, values: Floats, memory: Floats, dl: Floats, dt: Floats, routing: Routing) -> Floats:
        out = dl.copy()
        period, damping = (np.repeat(values[:, k : k + 1], routing.n_tendons, axis=1) for k in (0, 1))
        second_order(out, memory, period, damping, dt)
        return out
