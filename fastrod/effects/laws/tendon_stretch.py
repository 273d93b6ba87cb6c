"""Tendons stretch under tension."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class TendonStretch(Static):
    """Tendons stretch under tension.

    Equation: l_i = L_i + (c_i + c) T_i
    Symbols: c compliance, c_i that of tendon i in the robot file, T_i its tension, L_i its path, l_i its
    commanded length
    Source: Oliver-Butler, Till and Rucker 2019
    Residual signature: loss of gain, in proportion to the moment; the tip turns under load
    """

    seam = Seam.ACTUATION
    order = 85.0
    parameters = (
        Parameter("compliance", "m/N", bounds=(0.0, 0.02), typical=3e-4, starts=(2e-4,), per="segment"),
    )
    excited_by = "a known load of 50 to 100 g on and off"
    confounded_with = ("drum_gain", "stiffness_taper")
    synonyms = ("tendon_compliance", "wire_stretch")
    separated_by: ClassVar[Mapping[str, str]] = {
        "drum_gain": "a known mass of 50 to 100 g at the tip on and off: only stretch gives way to it",
        "stiffness_taper": "a known mass of 50 to 100 g at the tip on and off",
    }

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        ports.compliance += ports.routing.by_end(values)
