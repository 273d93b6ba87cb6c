"""The marker is not at the tip's centre."""

from __future__ import annotations

from typing import Any

import numpy as np

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class MarkerOffset(Static):
    """The marker is not at the tip's centre.

    Equation: y = r + R m
    Symbols: m x, y and z in the tip's frame, r tip, R its rotation, y what the camera sees
    Source: hand-eye registration of a marker
    Residual signature: turns with the tip
    """

    seam = Seam.SENSING
    order = 10.0
    parameters = (
        Parameter("x", "m", bounds=(-1.0, 1.0), typical=0.1, starts=(0.05,), of="length"),
        Parameter("y", "m", bounds=(-1.0, 1.0), typical=0.1, starts=(0.05,), of="length"),
        Parameter("z", "m", bounds=(-1.0, 1.0), typical=0.1, starts=(0.05,), of="length"),
    )
    excited_by = "wide bends with tip orientation"
    confounded_with = ("axial_compression", "stiffness_taper", "precurvature")

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        ports.tip_position += np.einsum("nij,nj->ni", ports.tip_rotation, values)
