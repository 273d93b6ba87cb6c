"""Self-weight of the body."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class Gravity(Static):
    """Self-weight of the body.

    Equation: f(s) += rho g, world frame
    Symbols: rho line_density, f force per length
    Source: Rucker and Webster 2011, distributed load of the rod equations
    Residual signature: fixed to gravity: turns against the base; an S, which moves the tip and hardly turns
    it
    """

    seam = Seam.LOAD
    order = 10.0
    parameters = (
        Parameter("line_density", "kg/m", bounds=(0.0, 20.0), typical=0.3, starts=(0.2,), per="segment"),
    )
    excited_by = "two base orientations"
    confounded_with = ("payload", "precurvature", "frame_misalignment", "tip_force")
    synonyms = ("self_weight", "sag")
    separated_by: ClassVar[Mapping[str, str]] = {
        "payload": "a known mass of 50 g at the tip on and off; or weigh what hangs there",
        "precurvature": "a second base orientation, turned by 90 degrees",
        "frame_misalignment": "a second base orientation, turned by 90 degrees",
        "tip_force": "a second base orientation, turned by 90 degrees",
    }
    frequent = True

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        ports.add_line_force(values[:, :, None] * ports.gravity[:, None, :])
