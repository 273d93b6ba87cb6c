"""A constant force on the tip, fixed to the base: a cable that drags, a spring."""

from __future__ import annotations

from typing import Any

import numpy as np

from fastrod.effects.base import Parameter, Seam, Signal, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class TipForce(Static):
    """A constant force on the tip, fixed to the base: a cable that drags, a spring.

    Equation: F += R_base f
    Symbols: f x, y and z in the base frame, F force at the tip
    Source: Rucker and Webster 2011, tip load
    Residual signature: static; does not turn when the base is turned against gravity
    """

    seam = Seam.LOAD
    order = 30.0
    parameters = (
        Parameter("x", "N", bounds=(-20.0, 20.0), typical=0.1, starts=(0.05,)),
        Parameter("y", "N", bounds=(-20.0, 20.0), typical=0.1, starts=(0.05,)),
        Parameter("z", "N", bounds=(-20.0, 20.0), typical=0.1, starts=(0.05,)),
    )
    excited_by = "wide bends in two base orientations"
    confounded_with = ("gravity", "payload", "stiffness_taper", "frame_misalignment")
    synonyms = ("external_force",)
    signal = Signal.FORCE

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        ports.tip_force += np.einsum("nij,nj->ni", ports.base_rotation, values)
