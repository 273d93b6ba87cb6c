"""Base, camera or clock creep away: the measured tip moves steadily with time."""

from __future__ import annotations

from typing import Any

from fastrod.effects.base import Parameter, Seam, Signal, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class TimeDrift(Static):
    """Base, camera or clock creep away: the measured tip moves steadily with time.

    Equation: y = r + v t, t since the start of the run
    Symbols: v x, y and z, r tip, y what the camera sees
    Source: definition; slow drift of a sensor
    Residual signature: slow, in time alone
    """

    seam = Seam.SENSING
    order = 50.0
    parameters = (
        Parameter("x", "m/s", bounds=(-1e-3, 1e-3), typical=1e-5),
        Parameter("y", "m/s", bounds=(-1e-3, 1e-3), typical=1e-5),
        Parameter("z", "m/s", bounds=(-1e-3, 1e-3), typical=1e-5),
    )
    excited_by = "the first block of motion repeated at the end; rest poses revisited"
    confounded_with = ("creep", "temperature", "plastic_set")
    synonyms = ("drift",)
    signal = Signal.TIME

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        shift = values * ports.time[:, None]
        ports.tip_position += shift
        ports.points += shift[:, None]
