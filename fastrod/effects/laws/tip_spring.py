"""A spring between the tip and a point that is fixed to the base: an elastic cable, a tether."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from fastrod.effects.base import Parameter, Seam, Signal, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class TipSpring(Static):
    """A spring between the tip and a point that is fixed to the base: an elastic cable, a tether.

    Equation: F += R_base k (p - r), r the tip and p the point in the base frame
    Symbols: k stiffness, p x, y and z, F force at the tip
    Source: Hooke's law, a spring without a length of its own
    Residual signature: static; grows with the distance from a point, and pulls the tip there from all sides
    """

    seam = Seam.LOAD
    order = 35.0
    parameters = (
        Parameter("stiffness", "N/m", bounds=(0.0, 1e4), typical=2.0, starts=(2.0,)),
        Parameter("x", "m", bounds=(-10.0, 10.0), typical=0.5, starts=(0.4, -0.4), of="length", shape=True),
        Parameter("y", "m", bounds=(-10.0, 10.0), typical=0.5, starts=(0.41, -0.41), of="length", shape=True),
        Parameter("z", "m", bounds=(-10.0, 10.0), typical=0.5, starts=(0.6,), of="length", shape=True),
    )
    excited_by = "wide bends to all sides"
    confounded_with = ("tip_force", "gravity", "payload", "stiffening")
    synonyms = ("spring", "tether")
    separated_by: ClassVar[Mapping[str, str]] = {
        "tip_force": "wide bends to all sides: only a spring pulls more the further the tip is from its end",
        "gravity": "the same path in another base orientation",
    }
    signal = Signal.TIP
    feels_tip = True

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        pull = values[:, :1] * (values[:, 1:] - ports.tip_position)
        ports.tip_force += np.einsum("nij,nj->ni", ports.base_rotation, pull)
