"""Tendons sit at other angles around the backbone than drawn."""

from __future__ import annotations

from typing import Any

import numpy as np

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class RoutingAngle(Static):
    """Tendons sit at other angles around the backbone than drawn.

    Equation: d_i -> rotation by beta_i about the tangent
    Symbols: beta_i angle of drive i, d_i its tendons' places in the cross-section
    Source: definition; d_i = offset (cos b_i, sin b_i)
    Residual signature: across the bend, in proportion to it
    """

    seam = Seam.ACTUATION
    order = 80.0
    parameters = (Parameter("angle", "rad", bounds=(-1.0, 1.0), typical=0.04, per="drive"),)
    excited_by = "circles"
    confounded_with = ("stiffness_anisotropy", "frame_misalignment")
    synonyms = ("mis_routing",)

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        angle = ports.routing.by_tendon(values)[:, None]
        c, s = np.cos(angle), np.sin(angle)
        x, y = ports.offset[..., 0].copy(), ports.offset[..., 1].copy()
        ports.offset[..., 0] = c * x - s * y
        ports.offset[..., 1] = s * x + c * y
