"""Each drive pays out more or less than it reports: a drum's radius, layers, or the tendons' offset."""

from __future__ import annotations

from typing import Any

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.types import Floats


@effect
class DrumGain(Static):
    """Each drive pays out more or less than it reports: a drum's radius, layers, or the tendons' offset.

    Equation: dl_i -> (1 + g_i) dl_i, antagonists alike (the part that bends)
    Symbols: g_i gain of drive i, dl_i its commanded change of length
    Source: definition; multi-layer winding of a drum
    Residual signature: in proportion to the bend, per drive, blind to speed and load
    """

    seam = Seam.ACTUATION
    order = 20.0
    parameters = (Parameter("gain", "", bounds=(-0.8, 4.0), typical=0.03, per="drive"),)
    excited_by = "bends of many amplitudes in every direction"
    confounded_with = ("tendon_stretch", "stiffness_taper", "stiffening")
    on_forces = True
    synonyms = ("spool_radius", "actuation_gain")

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        gain = ports.routing.by_tendon(values)
        ports.shift_tendons(gain * ports.dl)
