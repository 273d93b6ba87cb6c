"""Dry friction in the body: a moment that opposes the last change of its curvature."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from fastrod.effects.base import BodyOperator, Parameter, Signal, effect
from fastrod.kernels.operators import yielding
from fastrod.types import Floats


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
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(
            "bend", "rad", bounds=(0.0, 1.0), typical=0.02, starts=(0.01, 0.04), per="segment", apart=True
        ),
        Parameter(
            "width", "rad", neutral=0.06, bounds=(0.003, 1.0), typical=0.06, starts=(0.03, 0.12), shape=True
        ),
    )
    excited_by = "the same poses from several sides, with elastic tendons or tendons that go slack"
    confounded_with: ClassVar[tuple[str, ...]] = ("friction", "backlash", "creep", "plastic_set")
    synonyms: ClassVar[tuple[str, ...]] = ("internal_friction",)
    separated_by: ClassVar[Mapping[str, str]] = {
        "friction": "a segment bent by others' tendons while its own hold still: only friction of the body "
        "shows there",
        "backlash": "tendons brought back to their zeros from several sides",
        "creep": "holds of 10 s and more: friction stays, creep decays",
    }
    signal = Signal.LOOP
    frequent = True

    elements: ClassVar[int] = 1

    def memory(self, n_robots: int, n_bends: int) -> Floats:
        return np.full((n_robots, self.elements * n_bends), np.nan)

    def sweep(self, values: Floats, memory: Floats, bend: Floats) -> Floats:
        size, width, spread = self.split(values, bend.shape[2])
        places, back = memory.reshape(len(bend), self.elements, -1), np.zeros_like(bend)
        all_of_it = -np.ones(size.shape)
        for j, at in enumerate(np.linspace(-1.0, 1.0, self.elements) if self.elements > 1 else [0.0]):
            own = width * np.exp(at * spread)
            place = places[:, j].copy()
            place[np.isnan(place)] = bend[:, 0].reshape(len(bend), -1)[np.isnan(place)]
            off = bend.copy()  # from what is dragged along
            yielding(off, place, all_of_it, own * np.ones(size.shape))
            places[:, j] = place
            back += off / own[:, None, :, None]
        return np.asarray(-size[:, None, :, None] * back / self.elements)

    def stiffening(self, values: Floats, n_segments: int) -> Floats:
        size, width, spread = self.split(values, n_segments)
        return np.asarray((size * np.exp(spread) / width).max(1))

    def split(self, values: Floats, n_segments: int) -> tuple[Floats, Floats, Floats]:
        """Size (n_robots, n_segments) [rad], and width [rad] and spread (n_robots, 1) of the elements."""
        return values[:, :n_segments], values[:, n_segments : n_segments + 1], np.zeros((len(values), 1))
