"""The tendons are tighter than the robot file says, or looser: wound up anew on another day."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class Tightening(Static):
    """The tendons are tighter than the robot file says, or looser: wound up anew on another day.

    It shows where tendons can only pull, or the body gets shorter; other tendons take it up themselves.

    Equation: T0_i -> (1 + f) T0_i, as each tendon shorter by f c_i T0_i
    Symbols: f fraction, T0_i pretension and c_i compliance of tendon i
    Source: definition; pretension of tendons in series with springs (Rucker and Webster 2011)
    Residual signature: the body shorter at rest, and slack tendons later, on all sides alike
    """

    seam = Seam.ACTUATION
    order = 24.0
    parameters = (Parameter("fraction", "", bounds=(-1.0, 5.0), typical=0.3, starts=(0.3,)),)
    excited_by = "wide bends, at which antagonists go slack"
    confounded_with = ("axial_compression", "marker_offset", "slack")
    separated_by: ClassVar[Mapping[str, str]] = {
        "marker_offset": "bends so wide that antagonists go slack",
        "axial_compression": "all tendons pulled together: compression grows there",
    }

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        if not ports.routing.by_tension:
            ports.tendon_length -= values * ports.compliance * ports.pretension
