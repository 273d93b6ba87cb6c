"""Hysteresis of the body's material: many elements of dry friction in parallel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from fastrod.effects.base import Parameter, effect
from fastrod.effects.laws.body_friction import BodyFriction
from fastrod.kernels.operators import SLIDERS
from fastrod.types import Floats


@effect
class BodyHysteresis(BodyFriction):
    """Hysteresis of the body's material: many elements of dry friction in parallel.

    Equation: u* -> u* - a mean z_j / l, z_j = (theta - p_j) / w_j, w_j over w e^(-+s)
    Symbols: a bend, w width, s spread, theta the solved bend of a segment and l its length
    Source: Iwan 1966, Prandtl and Ishlinskii (elements in parallel); rounded loops as Bouc 1967 and Wen 1976
    Residual signature: as friction of the body, with loops that are round and nested
    """

    order = 36.0
    elements = SLIDERS
    parameters = (
        *BodyFriction.parameters,
        Parameter("spread", "", neutral=0.5, bounds=(0.0, 2.5), typical=0.5, starts=(1.0,), shape=True),
    )
    confounded_with = ("body_friction", "creep")
    refines = "body_friction"
    synonyms = ("bouc_wen", "material_hysteresis")
    nests: ClassVar[Mapping[str, Mapping[str, str | float]]] = {"body_friction": {"spread": 0.0}}
    separated_by: ClassVar[Mapping[str, str]] = {
        "body_friction": "reversals of many sizes: with many elements small loops are thin and closed"
    }

    def split(self, values: Floats, n_segments: int) -> tuple[Floats, Floats, Floats]:
        size, width, spread = np.split(values, [n_segments, n_segments + 1], axis=1)
        return size, width, spread
