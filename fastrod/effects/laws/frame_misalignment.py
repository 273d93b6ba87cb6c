"""The camera's frame is not the base's."""

from __future__ import annotations

from typing import Any

import numpy as np

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.rotation import matrix_from_quaternion, quaternion_from_vector
from fastrod.types import Floats

_REVOLUTION = 2.0 * np.pi  # rad: any rotation, and a fit may pass half a turn
_FAR = 30.0  # robot lengths: as far as a run log's tips may be


@effect
class FrameMisalignment(Static):
    """The camera's frame is not the base's.

    Equation: y = exp[w] r + t
    Symbols: w rotation, t shift, r tip, y what the camera sees
    Source: rigid registration (Horn 1987)
    Residual signature: affine in the measured position; the same for every load and orientation
    """

    seam = Seam.SENSING
    order = 20.0
    parameters = (
        Parameter("rotation_x", "rad", bounds=(-_REVOLUTION, _REVOLUTION), typical=0.03, starts=(0.01,)),
        Parameter("rotation_y", "rad", bounds=(-_REVOLUTION, _REVOLUTION), typical=0.03, starts=(0.01,)),
        Parameter("rotation_z", "rad", bounds=(-_REVOLUTION, _REVOLUTION), typical=0.03, starts=(0.01,)),
        Parameter("shift_x", "m", bounds=(-_FAR, _FAR), typical=0.03, starts=(0.01,), of="length"),
        Parameter("shift_y", "m", bounds=(-_FAR, _FAR), typical=0.03, starts=(0.01,), of="length"),
        Parameter("shift_z", "m", bounds=(-_FAR, _FAR), typical=0.03, starts=(0.01,), of="length"),
    )
    excited_by = "the whole workspace; a calibration of its own"
    confounded_with = ("precurvature", "encoder_offset", "gravity")
    synonyms = ("registration",)

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        rotation = matrix_from_quaternion(quaternion_from_vector(values[:, :3]))
        ports.tip_position[:] = np.einsum("nij,nj->ni", rotation, ports.tip_position) + values[:, 3:]
        ports.tip_rotation[:] = rotation @ ports.tip_rotation
        ports.points[:] = np.einsum("nij,nkj->nki", rotation, ports.points) + values[:, None, 3:]
