"""A drift that settles: base, mount or camera warm up and come to rest elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from fastrod.effects.base import Parameter, Seam, Signal, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class SettlingDrift(Static):
    """A drift that settles: base, mount or camera warm up and come to rest elsewhere.

    Equation: y = r + d (1 - exp(-t / tau)), t since the start of the run
    Symbols: d x, y and z, tau time_constant, r tip, y what the camera sees
    Source: first-order thermal warm-up of a mount
    Residual signature: fast at first, then less and less, in time alone
    """

    seam = Seam.SENSING
    order = 51.0
    parameters = (
        Parameter("x", "m", bounds=(-0.1, 0.1), typical=1e-3),
        Parameter("y", "m", bounds=(-0.1, 0.1), typical=1e-3),
        Parameter("z", "m", bounds=(-0.1, 0.1), typical=1e-3),
        Parameter(
            "time_constant",
            "s",
            neutral=100.0,
            bounds=(2.0, 5000.0),
            typical=100.0,
            starts=(5.0, 20.0, 80.0, 300.0),
            shape=True,
        ),
    )
    excited_by = "rest poses revisited, soon after the start and long after it"
    confounded_with = ("time_drift", "creep", "temperature")
    refines = "time_drift"
    separated_by: ClassVar[Mapping[str, str]] = {
        "time_drift": "a rest pose revisited until it no longer moves"
    }
    signal = Signal.TIME

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        warm = -np.expm1(-ports.time / values[:, 3])
        shift = values[:, :3] * warm[:, None]
        ports.tip_position += shift
        ports.points += shift[:, None]
