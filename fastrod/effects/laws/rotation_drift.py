"""Base or camera rotate slowly: the whole picture of the robot goes about its base."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from fastrod.effects.base import Parameter, Seam, Signal, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.rotation import matrix_from_quaternion, quaternion_from_vector
from fastrod.types import Floats


@effect
class RotationDrift(Static):
    """Base or camera rotate slowly: the whole picture of the robot goes about its base.

    Equation: y = exp[w t] r, t since the start of the run
    Symbols: w rate of rotation, r tip, y what the camera sees
    Source: definition; a mount that gives way, a base that unscrews
    Residual signature: slow in time, in proportion to the distance from the base and across it
    """

    seam = Seam.SENSING
    order = 52.0
    parameters = (
        Parameter("x", "rad/s", bounds=(-1e-2, 1e-2), typical=1e-4, starts=(1e-4,)),
        Parameter("y", "rad/s", bounds=(-1e-2, 1e-2), typical=1e-4, starts=(1e-4,)),
        Parameter("z", "rad/s", bounds=(-1e-2, 1e-2), typical=1e-4, starts=(1e-4,)),
    )
    excited_by = "bent poses in several directions, revisited at the end"
    confounded_with = ("time_drift", "temperature", "creep")
    refines = "time_drift"
    separated_by: ClassVar[Mapping[str, str]] = {
        "time_drift": "poses bent to both sides, revisited at the end"
    }
    signal = Signal.TIME

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        rotation = matrix_from_quaternion(quaternion_from_vector(values * ports.time[:, None]))
        ports.tip_position[:] = np.einsum("nij,nj->ni", rotation, ports.tip_position)
        ports.tip_rotation[:] = rotation @ ports.tip_rotation
        ports.points[:] = np.einsum("nij,nkj->nki", rotation, ports.points)
