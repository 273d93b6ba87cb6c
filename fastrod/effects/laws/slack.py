"""Dead zone at neutral: an antagonistic pair that hangs loose before either tendon pulls."""

from __future__ import annotations

from typing import Any

import numpy as np

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class Slack(Static):
    """Dead zone at neutral: an antagonistic pair that hangs loose before either tendon pulls.

    Equation: dl -> sgn(dl) max(|dl| - w, 0) (the part that bends)
    Symbols: w half_width, dl the tendons' commanded changes of length
    Source: dead zone of slack tendons, T = max(0, k lambda)
    Residual signature: static, odd, only around neutral of each pair; no loop
    """

    seam = Seam.ACTUATION
    order = 50.0
    parameters = (
        Parameter(
            "half_width",
            "m",
            bounds=(0.0, 0.6),
            typical=0.04,
            starts=(0.015, 0.05),
            per="drive",
            of="offset",
            shared=True,
        ),
    )
    excited_by = "slow crossings of neutral, large bends"
    confounded_with = ("stiffening", "drum_gain")
    synonyms = ("dead_zone",)

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        dl, gap = ports.dl, ports.routing.by_tendon(values)
        ports.shift_tendons(-np.clip(dl, -gap, gap))
