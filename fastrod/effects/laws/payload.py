"""A mass at the tip that nobody declared, or more of it than declared."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class Payload(Static):
    """A mass at the tip that nobody declared, or more of it than declared.

    Equation: F += m g at the tip, world frame
    Symbols: m mass, F force at the tip
    Source: Rucker and Webster 2011, tip load
    Residual signature: as self-weight, with the lever of the tip; torsion when bent sideways
    """

    seam = Seam.LOAD
    order = 20.0
    parameters = (Parameter("mass", "kg", bounds=(0.0, 5.0), typical=0.02, starts=(0.01,)),)
    excited_by = "a known mass on and off, two base orientations"
    confounded_with = ("gravity", "tip_force")
    synonyms = ("tip_mass",)
    separated_by: ClassVar[Mapping[str, str]] = {
        "tip_force": "a second base orientation, turned by 90 degrees"
    }
    frequent = True

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        ports.tip_force += values * ports.gravity
