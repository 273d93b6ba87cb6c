"""A tendon slips on its drum, or a drive loses steps: its zero jumps at a time and stays there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from fastrod.effects.base import Parameter, Seam, Signal, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class Slip(Static):
    """A tendon slips on its drum, or a drive loses steps: its zero jumps at a time and stays there.

    Equation: l -> l + s from t = at on, t since the start of the run, for the first tendon of a drive, - s
    for its antagonist (the part that bends)
    Symbols: s step, at its time, l a tendon's commanded change of length
    Source: definition; lost steps and slipping clamps of tendon drives
    Residual signature: none, then at one time and from there on that of a zero that is off
    """

    seam = Seam.ACTUATION
    order = 21.0
    parameters = (
        Parameter(
            "step",
            "m",
            bounds=(-2.0, 2.0),
            typical=0.05,
            starts=(0.05,),
            per="drive",
            of="offset",
            shared=True,
        ),
        # a scan finds it between two rows; no fit moves it, for nothing changes until it crosses one
        Parameter("at", "s", bounds=(0.0, 1e6), typical=0.02, shape=True),
    )
    excited_by = "the first block of motion repeated at the end; rest poses revisited"
    confounded_with = ("encoder_offset", "time_drift", "plastic_set")
    synonyms = ("tendon_slip", "lost_steps")
    separated_by: ClassVar[Mapping[str, str]] = {
        "encoder_offset": "the first block of motion once more at the end: a zero was off from the start"
    }
    signal = Signal.TIME
    by_pattern = True

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        slipped = np.where(ports.time[:, None] >= values[:, -1:], values[:, :-1], 0.0)
        ports.shift_tendons(ports.routing.drive_sign * ports.routing.by_tendon(slipped))
