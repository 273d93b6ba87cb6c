"""The body gets stiffer (or softer) as it bends, and its tendons stretch for it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class Stiffening(Static):
    """The body gets stiffer (or softer) as it bends, and its tendons stretch for it.

    Equation: theta -> theta (1 - c min(|theta|^2, 2)) in each segment
    Symbols: c cubic, theta the bend that a segment's lengths ask for
    Source: Yeoh 1993, cubic term of a hyperelastic bending moment against tendons in series
    Residual signature: odd and cubic in the bend, static
    """

    seam = Seam.ACTUATION
    order = 65.0
    parameters = (
        Parameter("cubic", "1/rad^2", bounds=(-0.5, 0.5), typical=0.08, starts=(0.06,), per="segment"),
    )
    excited_by = "bends of many amplitudes up to 60 degrees and more"
    confounded_with = ("drum_gain", "slack", "lens")
    synonyms = ("nonlinear_material",)
    separated_by: ClassVar[Mapping[str, str]] = {
        "drum_gain": "bends of many amplitudes, to 50 degrees and more",
        "slack": "bends of many amplitudes, slowly through neutral",
    }

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        bend = ports.bend()
        square = np.minimum((bend**2).sum(-1, keepdims=True), 2.0)
        ports.shift_bend(-values[:, :, None] * square * bend)
