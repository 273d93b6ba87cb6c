"""The body gets longer as it bends."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class BendExtension(Static):
    """The body gets longer as it bends.

    Perhaps the neutral axis moves to the inner side, where what is pressed gives way less than what is
    pulled. It goes by the bend of the solved rod, as `body_friction` does.

    Equation: l_k -> l_k + a_k theta_k^2, in each segment
    Symbols: a extension, theta_k the solved bend of segment k, l_k its length
    Source: the first even term in the bend; found on a measured trunk, its cause is a guess
    Residual signature: along the tangent, even in the bend; tendons that stretch let it show
    """

    seam = Seam.MATERIAL
    order = 40.0
    parameters = (
        Parameter(
            "extension",
            "m/rad^2",
            bounds=(-0.3, 0.3),
            typical=0.02,
            starts=(0.02,),
            per="segment",
            of="length",
            apart=True,
        ),
    )
    excited_by = "wide bends in every direction"
    confounded_with = ("axial_compression", "stiffening", "marker_offset")
    separated_by: ClassVar[Mapping[str, str]] = {
        "axial_compression": "all tendons pulled together: only compression shows there",
        "stiffening": "a marker at half length, or the tip's orientation",
    }
    reads_bend = True

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        ports.extension += values * (ports.solved_bend**2).sum(-1)
