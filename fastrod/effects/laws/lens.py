"""Radial distortion of the camera's lens, looking along the base's axis."""

from __future__ import annotations

from typing import Any

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class Lens(Static):
    """Radial distortion of the camera's lens, looking along the base's axis.

    Equation: (x, y) -> (x, y) (1 + k (x^2 + y^2) / L^2)
    Symbols: k radial, L the robot's length
    Source: Brown 1971, first radial term
    Residual signature: radial in the image, static and cubic
    """

    seam = Seam.SENSING
    order = 40.0
    parameters = (Parameter("radial", "", bounds=(-0.3, 0.3), typical=0.02),)
    excited_by = "the edges of the workspace"
    confounded_with = ("stiffening", "axial_compression")
    synonyms = ("lens_distortion",)

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        square = (ports.routing.length.sum()) ** 2
        for place in (ports.tip_position[:, None], ports.points):
            place[..., :2] += (
                values[:, :, None] * (place[..., :2] ** 2).sum(-1, keepdims=True) / square * place[..., :2]
            )
