"""Warm-up: the gain of bending settles over minutes while motors and body get warm."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from fastrod.effects.base import Parameter, Seam, Signal, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class Temperature(Static):
    """Warm-up: the gain of bending settles over minutes while motors and body get warm.

    Equation: dl -> (1 + g (1 - exp(-t / tau))) dl, t since the start of the run (the part that bends)
    Symbols: g gain, tau time_constant, dl the tendons' commanded changes of length
    Source: first-order thermal warm-up; softening of TPU with temperature
    Residual signature: slow, in proportion to the bend, the same whatever was commanded before
    """

    seam = Seam.ACTUATION
    order = 25.0
    parameters = (
        Parameter("gain", "", bounds=(-0.5, 0.5), typical=0.05, starts=(0.05, -0.05)),
        Parameter(
            "time_constant",
            "s",
            neutral=100.0,
            bounds=(20.0, 5000.0),
            typical=100.0,
            starts=(30.0, 150.0),
            shape=True,
        ),
    )
    excited_by = "the first block of motion repeated at the end"
    confounded_with = ("time_drift", "creep", "drum_gain")
    synonyms = ("warm_up",)
    separated_by: ClassVar[Mapping[str, str]] = {
        "drum_gain": "the first block of motion once more after some minutes",
        "time_drift": "the first block of motion and a rest once more after some minutes",
    }
    signal = Signal.TIME

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        warm = values[:, 0] * (1.0 - np.exp(-ports.time / values[:, 1]))
        ports.shift_tendons(warm[:, None] * ports.dl)
