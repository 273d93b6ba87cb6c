"""The body bends more easily while all its tendons pull."""

from __future__ import annotations

from typing import Any

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class CompressionSoftening(Static):
    """The body bends more easily while all its tendons pull.

    Equation: theta_k -> theta_k (1 - g c_k), with c_k < 0 what the tendons of segment k pull in common
    Symbols: g gain, theta_k the bend of segment k
    Source: column under axial load, EI (1 - P / P_cr) (Timoshenko and Gere 1961), against tendons that
    stretch
    Residual signature: in proportion to bend times common pull; nothing where one pair moves alone
    """

    seam = Seam.ACTUATION
    order = 66.0
    parameters = (Parameter("gain", "1/m", bounds=(-500.0, 500.0), typical=20.0, starts=(15.0,)),)
    excited_by = "all tendons pulled together, at several bends"
    confounded_with = ("axial_compression", "stiffening")
    synonyms = ("pull_dependent_gain",)

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        ports.shift_bend(-values[:, :, None] * ports.common()[..., None] * ports.bend())
