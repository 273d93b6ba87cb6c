"""The drives' zeros do not belong to the straight rod."""

from __future__ import annotations

from typing import Any

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class EncoderOffset(Static):
    """The drives' zeros do not belong to the straight rod.

    Equation: dl_i -> dl_i + o_i, antagonists opposite (the part that bends)
    Symbols: o_i offset of drive i, dl_i its commanded change of length
    Source: definition; joint offset of robot calibration (Hollerbach and Wampler 1996)
    Residual signature: the whole arc is turned by a constant bend: tip and tip orientation together
    """

    seam = Seam.ACTUATION
    order = 22.0
    parameters = (Parameter("offset", "m", bounds=(-1.0, 1.0), typical=0.02, per="drive", of="offset"),)
    excited_by = "wide bends in every direction"
    confounded_with = ("precurvature", "frame_misalignment", "marker_offset")
    synonyms = ("zero_offset", "motor_zero")

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        ports.shift_tendons(ports.routing.by_tendon(values) * ports.routing.drive_sign)
