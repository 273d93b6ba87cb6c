"""The backbone shortens under the pull of its tendons."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class AxialCompression(Static):
    """The backbone shortens under the pull of its tendons.

    Equation: l_k -> l_k (1 - e |theta_k|) + p c_k, with c_k what the tendons of segment k pull in common, and
    p the body's share of it
    Symbols: e per_bend, p common_share, l_k length of segment k, theta_k its bend
    Source: v_z = 1 - sum T / EA, Rucker and Webster 2011, with T from tendons that pull only
    Residual signature: along the tangent of the tip, even in the bend; in proportion to common pull
    """

    seam = Seam.ACTUATION
    order = 90.0
    parameters = (
        Parameter("per_bend", "1/rad", bounds=(0.0, 0.5), typical=0.03, starts=(0.02,), per="segment"),
        Parameter("common_share", "", bounds=(0.0, 1.5), typical=0.5, starts=(0.5,), per="segment"),
    )
    excited_by = "large bends; all tendons pulled together"
    confounded_with = ("marker_offset", "stiffening")
    synonyms = ("backbone_compression",)
    separated_by: ClassVar[Mapping[str, str]] = {
        "marker_offset": "bends to 50 degrees and more, or all tendons pulled together",
        "stiffening": "bends to 50 degrees and more, or all tendons pulled together",
    }

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        routing = ports.routing
        n = routing.n_segments
        bend = np.linalg.norm(ports.bend(), axis=-1)
        pulled = -routing.length * values[:, :n] * bend
        ports.extension += pulled + values[:, n:] * ports.common()
        # The tendons follow what the bend takes from the body; of a common pull they keep what the body does
        # not follow.
        ports.tendon_length += np.cumsum(pulled, axis=1)[:, routing.tendon_segment]
