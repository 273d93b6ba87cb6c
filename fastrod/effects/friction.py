"""Dry friction of the wires along the backbone, growing with the bend as a capstan."""

from __future__ import annotations

import numpy as np

from fastrod.effect import Operator, Parameter, Seam, effect
from fastrod.kernels.operators import dahl
from fastrod.types import Floats
from fastrod.wiring import Wiring


@effect
class Friction(Operator):
    """Dry friction of the wires along the backbone, growing with the bend as a capstan.

    Equation: z' = |l'| / r (sgn l' - z), l -> l - a (1 + k |l| / d) z
    Source: Dahl 1968; capstan T_out = T_in exp(-mu theta), Kato et al. 2015, Palli and Melchiorri
    Residual signature: sign of the last direction of motion, saturating with travel; loops that grow with the bend, blind to speed
    """

    seam = Seam.ACTUATION
    order = 40.0
    parameters = (
        Parameter("half_width", "m", bounds=(0.0, 0.6), typical=0.04, starts=(0.02, 0.08), per="segment", of="reach"),
        Parameter("presliding", "m", neutral=0.1, bounds=(0.002, 1.5), typical=0.1, starts=(0.04, 0.25), of="reach", shape=True),
        Parameter("growth", "1/rad", bounds=(0.0, 5.0), typical=0.5, starts=(0.3,), shape=True),
    )
    excited_by = "nested loops of decreasing amplitude at two speeds, with holds"
    confounded_with = ("backlash", "plastic_set", "creep")
    synonyms = ("hysteresis", "coulomb_friction", "capstan")

    def memory(self, n_robots: int, n_tendons: int) -> Floats:
        return np.full((n_robots, 2 * n_tendons), np.nan)

    def sweep(self, values: Floats, memory: Floats, dl: Floats, dt: Floats, wiring: Wiring) -> Floats:  # noqa: ARG002
        out = dl.copy()
        n = wiring.n_segments
        presliding = np.repeat(values[:, n : n + 1], wiring.n_tendons, axis=1)
        growth = values[:, n + 1 : n + 2] / wiring.reach
        dahl(out, memory, wiring.by_end(values[:, :n]), presliding, growth)
        return out
