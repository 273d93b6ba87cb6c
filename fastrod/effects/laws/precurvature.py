"""The body is not straight without moments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class Precurvature(Static):
    """The body is not straight without moments.

    Equation: u*(s) -> u*(s) + b (1 - 2 s / l) + u_0: a bow, which stiff tendons do not straighten, and a
    uniform part, which they do
    Symbols: b bow, u_0 uniform, u* curvature at rest, s from 0 to the segment's length l
    Source: paper eq. 1c, m = K (u - u*)
    Residual signature: constant in the body frame: the tip moves and does not turn
    """

    seam = Seam.MATERIAL
    order = 30.0
    parameters = (
        Parameter("bow_x", "1/m", bounds=(-30.0, 30.0), typical=2.0, starts=(1.0,), per="segment"),
        Parameter("bow_y", "1/m", bounds=(-30.0, 30.0), typical=2.0, starts=(1.0,), per="segment"),
        Parameter("uniform_x", "1/m", bounds=(-30.0, 30.0), typical=2.0, starts=(0.0,), per="segment"),
        Parameter("uniform_y", "1/m", bounds=(-30.0, 30.0), typical=2.0, starts=(0.0,), per="segment"),
    )
    excited_by = "wide bends with tip orientation; the free shape with slack tendons"
    confounded_with = ("frame_misalignment", "encoder_offset", "marker_offset")
    synonyms = ("pre_curvature", "initial_curvature")
    separated_by: ClassVar[Mapping[str, str]] = {
        "frame_misalignment": "the free shape with slack tendons, or a marker at half length: the tip cannot "
        "tell",
        "encoder_offset": "wide bends with the tip's orientation measured",
        "marker_offset": "wide bends with the tip's orientation measured",
    }

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        n = ports.routing.n_segments
        ports.resolve()
        for axis in (0, 1):
            bow, uniform = values[:, axis * n : (axis + 1) * n], values[:, (2 + axis) * n : (3 + axis) * n]
            ports.precurvature[..., axis] += (
                bow[..., None] * (1.0 - 2.0 * ports.fraction) + uniform[..., None]
            )
