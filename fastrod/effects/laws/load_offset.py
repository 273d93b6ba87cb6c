"""The load at the tip acts beside its centre: a payload hangs off the axis."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.rotation import matrix_from_quaternion, product, quaternion_from_vector
from fastrod.types import Floats


@effect
class LoadOffset(Static):
    """The load at the tip acts beside its centre: a payload hangs off the axis.

    The tip's rotation is that of the solved bends, one segment after the other; what twists a segment is
    left out of it.

    Equation: M += (R o) x F at the tip
    Symbols: o x, y and z in the tip's frame, R its rotation, F the declared load and that of `payload`
    Source: moment of a force about a point; a payload's centre of mass
    Residual signature: none without the load; it bends the tip to the side on which the load hangs
    """

    seam = Seam.LOAD
    order = 25.0
    parameters = tuple(
        Parameter(axis, "m", bounds=(-1.0, 1.0), typical=0.05, starts=(0.03,), of="length") for axis in "xyz"
    )
    excited_by = "a known load on and off, wide bends in every direction"
    confounded_with = ("tip_force", "payload", "precurvature", "marker_offset")
    separated_by: ClassVar[Mapping[str, str]] = {
        "tip_force": "the load on and off",
        "payload": "the load on and off, wide bends in every direction",
        "precurvature": "the load on and off",
        "marker_offset": "the load on and off",
    }
    reads_bend = True

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        turned = np.zeros((*ports.solved_bend.shape[:2], 3))
        turned[..., :2] = ports.solved_bend
        tip = quaternion_from_vector(turned[:, 0])
        for k in range(1, turned.shape[1]):
            tip = product(tip, quaternion_from_vector(turned[:, k]))
        arm = np.einsum("nij,njk,nk->ni", ports.base_rotation, matrix_from_quaternion(tip), values)
        ports.tip_moment += np.cross(arm, ports.tip_force)
