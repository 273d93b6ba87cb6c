"""The camera's scale is off (a marker's size, a focal length), or the robot's length in its file."""

from __future__ import annotations

from typing import Any

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class CameraScale(Static):
    """The camera's scale is off (a marker's size, a focal length), or the robot's length in its file.

    Equation: y = (1 + k) r
    Symbols: k scale, r tip, y what the camera sees
    Source: scale of a monocular camera
    Residual signature: away from the camera's origin, in proportion to the distance
    """

    seam = Seam.SENSING
    order = 30.0
    parameters = (Parameter("scale", "", bounds=(-0.3, 0.3), typical=0.01),)
    excited_by = "the whole workspace; a known distance"
    confounded_with = ("axial_compression", "marker_offset")

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        ports.tip_position += values * ports.tip_position
        ports.points += values[:, None] * ports.points
