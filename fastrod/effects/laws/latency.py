"""Delay between command and measured tip, of the drives, the bus and the camera together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from fastrod.effects.base import Operator, Parameter, Seam, Signal, effect
from fastrod.kernels.operators import BUFFER, delay
from fastrod.model.routing import Routing
from fastrod.types import Floats


@effect
class Latency(Operator):
    """Delay between command and measured tip, of the drives, the bus and the camera together.

    Equation: l(t) = l_cmd(t - d), a cubic between samples; d is cut to the last 128 samples
    Symbols: d delay, l_cmd the command, l what the rod gets
    Source: transport delay; sensor delay as a parameter, as in MATLAB System Identification (delay of a
    process model)
    Residual signature: along the velocity of the predicted tip and in proportion to it, zero at rest
    """

    seam = Seam.ACTUATION
    order = 10.0
    parameters = (Parameter("delay", "s", bounds=(0.0, 1.0), typical=0.1, starts=(0.06, 0.15)),)
    excited_by = "motion at two speeds, with stops"
    confounded_with = ("second_order_lag", "creep")
    on_forces = True
    synonyms = ("delay", "time_delay")
    separated_by: ClassVar[Mapping[str, str]] = {
        "second_order_lag": "fast and slow motion with sudden stops, beyond 50 degrees: a delay rings not",
        "creep": "stops and holds: a delay is over after the delay",
    }
    signal = Signal.MOTION
    frequent = True

    def memory(self, n_robots: int, n_tendons: int) -> Floats:
        return np.full((n_robots, 1 + BUFFER * (1 + n_tendons)), np.nan)

    def sweep(self, values: Floats, memory: Floats, dl: Floats, dt: Floats, routing: Routing) -> Floats:
        out = dl.copy()
        delay(out, memory, np.ascontiguousarray(values[:, 0]), dt)
        return out
