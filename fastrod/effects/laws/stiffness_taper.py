"""The body is stiffer at one end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class StiffnessTaper(Static):
    """The body is stiffer at one end.

    Equation: K(s) = K (1 + a (1 - 2 s / l)) in each segment
    Symbols: a slope, K stiffness, s from 0 to the segment's length l
    Source: Kirchhoff rod with K(s); Rucker and Webster 2011, IEEE T-RO 27(6)
    Residual signature: along the normal, in proportion to the bend; the tip's angle stays
    """

    seam = Seam.MATERIAL
    order = 10.0
    parameters = (Parameter("slope", "", bounds=(-0.9, 0.9), typical=0.3, starts=(0.2,), per="segment"),)
    excited_by = "large bends; a marker at half length"
    confounded_with = ("drum_gain", "tendon_stretch", "marker_offset")
    synonyms = ("taper",)
    separated_by: ClassVar[Mapping[str, str]] = {
        "drum_gain": "bends to 50 degrees and more, or a marker at half length"
    }

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        ports.resolve()
        ports.stiffness *= 1.0 + values[:, :, None, None] * (1.0 - 2.0 * ports.fraction)[:, None]
