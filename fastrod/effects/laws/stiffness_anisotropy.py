"""The body is stiffer about one axis than about the other."""

from __future__ import annotations

from typing import Any

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class StiffnessAnisotropy(Static):
    """The body is stiffer about one axis than about the other.

    Equation: EI_x -> EI_x (1 + e), EI_y -> EI_y (1 - e)
    Symbols: e ratio, EI_x and EI_y bending stiffness about the two axes
    Source: Kirchhoff rod, u_z' = (EI_x - EI_y) u_x u_y / GJ
    Residual signature: twist in proportion to u_x u_y: on diagonals, even in amplitude
    """

    seam = Seam.MATERIAL
    order = 20.0
    parameters = (Parameter("ratio", "", bounds=(-0.9, 0.9), typical=0.15, starts=(0.1,), per="segment"),)
    excited_by = "circles and diagonals; a load in two directions"
    confounded_with = ("routing_angle", "frame_misalignment")
    synonyms = ("anisotropy",)

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        ports.stiffness[..., 0] *= 1.0 + values[:, :, None]
        ports.stiffness[..., 1] *= 1.0 - values[:, :, None]
