"""Dry friction in the body: a moment that opposes the last change of its curvature."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from fastrod.effects.base import BodyOperator, Parameter, effect


@effect
class BodyFriction(BodyOperator):
    """Dry friction in the body: a moment that opposes the last change of its curvature.

    Tendons that rub in their holes, layers that rub on each other: the body stays behind where it comes from,
    whatever the tendons do. A step of a simulator goes by the bend of the last state; `settle` and a log
    solve bend and friction together.

    Equation: u* -> u* - a z / l, z = (theta - p) / w, p dragged along once |theta - p| > w, in each segment
    Symbols: a bend, w width, theta (about d1 and d2) the solved bend of a segment and l its length
    Source: elastoplastic element (Prandtl), on the curvature of the body: Iwan 1966
    Residual signature: sign of the last direction of motion, also where the tendons have come back to their
    zeros; blind to speed
    """

    order = 35.0
    parameters = (
        Parameter(
            "bend", "rad", bounds=(0.0, 1.0), typical=0.02, starts=(0.01, 0.04), per="segment", apart=True
        ),
        Parameter(
            "width", "rad", neutral=0.06, bounds=(0.003, 1.0), typical=0.06, starts=(0.03, 0.12), shape=True
        ),
    )
    excited_by = "the same poses from several sides, with elastic tendons or tendons that go slack"
    confounded_with = ("friction", "backlash", "creep", "plastic_set")
    synonyms = ("internal_friction",)
    separated_by: ClassVar[Mapping[str, str]] = {
        "friction": "a segment bent by others' tendons while its own hold still: only friction of the body "
        "shows there",
        "backlash": "tendons brought back to their zeros from several sides",
        "creep": "holds of 10 s and more: friction stays, creep decays",
    }
