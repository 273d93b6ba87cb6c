"""Hysteresis of the body's material: many elements of dry friction in parallel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from fastrod.effects.base import BodyOperator, Parameter, effect
from fastrod.kernels.operators import SLIDERS


@effect
class BodyHysteresis(BodyOperator):
    """Hysteresis of the body's material: many elements of dry friction in parallel.

    Equation: u* -> u* - a mean z_j / l, z_j = (theta - p_j) / w_j, p_j dragged along once |theta - p_j| >
    w_j, w_j over w e^(-+s)
    Symbols: a bend, w width, s spread, theta (about d1 and d2) the solved bend of a segment and l its length
    Source: Iwan 1966, Prandtl and Ishlinskii (elements in parallel)
    Residual signature: as friction of the body, with loops that are round and nested
    """

    order = 36.0
    elements = SLIDERS
    parameters = (
        Parameter(
            "bend", "rad", bounds=(0.0, 1.0), typical=0.02, starts=(0.01, 0.04), per="segment", apart=True
        ),
        Parameter(
            "width", "rad", neutral=0.06, bounds=(0.003, 1.0), typical=0.06, starts=(0.03, 0.12), shape=True
        ),
        Parameter("spread", "", neutral=0.5, bounds=(0.0, 2.5), typical=0.5, starts=(1.0,), shape=True),
    )
    excited_by = "reversals of many sizes, with elastic tendons or tendons that go slack"
    confounded_with = ("body_friction", "creep")
    refines = "body_friction"
    synonyms = ("material_hysteresis",)
    nests: ClassVar[Mapping[str, Mapping[str, str | float]]] = {"body_friction": {"spread": 0.0}}
    separated_by: ClassVar[Mapping[str, str]] = {
        "body_friction": "reversals of many sizes: with many elements small loops are thin and closed"
    }
