"""Tendons of one segment bend its neighbour too."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class Coupling(Static):
    """Tendons of one segment bend its neighbour too.

    Equation: theta_k -> theta_k + c theta_(k+1) + d theta_(k-1)
    Symbols: c from_distal, d from_proximal, theta_k the bend of segment k
    Source: Camarillo, Carlson and Salisbury 2009; Roy, Wang and Simaan 2017
    Residual signature: in proportion to the neighbour's command
    """

    seam = Seam.ACTUATION
    order = 45.0
    parameters = (
        Parameter("from_distal", "", bounds=(-1.0, 1.0), typical=0.1, starts=(0.08,)),
        Parameter("from_proximal", "", bounds=(-1.0, 1.0), typical=0.1, starts=(0.08,)),
    )
    excited_by = "one segment moved at a time, then both"
    confounded_with = ("encoder_offset",)
    synonyms = ("inter_segment_coupling",)
    separated_by: ClassVar[Mapping[str, str]] = {"encoder_offset": "one segment moved alone, then the other"}
    least_segments = 2

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        if ports.routing.n_segments < 2:
            return
        bend = ports.bend()
        change = np.zeros_like(bend)
        change[:, :-1] += values[:, 0, None, None] * bend[:, 1:]
        change[:, 1:] += values[:, 1, None, None] * bend[:, :-1]
        ports.shift_bend(change)
