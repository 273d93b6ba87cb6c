"""Dry friction of the tendons along the backbone, growing with the bend as a capstan."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from fastrod.effects.base import Operator, Parameter, Seam, effect
from fastrod.kernels.operators import SLIDERS, elastoplastic
from fastrod.model.routing import Routing
from fastrod.types import Floats


@effect
class Friction(Operator):
    """Dry friction of the tendons along the backbone, growing with the bend as a capstan.

    Equation: l -> l - a (1 + k phi) mean z_j, z_j = clip(z_j + l' / r_j, -1, 1), at first -start, phi the
    angle that the tendon wraps, r_j over r e^(-+s)
    Symbols: a half_width, r presliding, k growth, s spread, z_j how far slider j is drawn, l a tendon's
    commanded change of length
    Source: Iwan 1966, Prandtl and Ishlinskii (sliders in parallel); capstan, Kato et al. 2015, Palli and
    Melchiorri
    Residual signature: sign of the last direction of motion, saturating with travel; loops that grow with the
    bend, blind to speed
    """

    seam = Seam.ACTUATION
    order = 40.0
    parameters = (
        Parameter(
            "half_width",
            "m",
            bounds=(0.0, 0.6),
            typical=0.04,
            starts=(0.02, 0.08),
            per="drive",
            of="offset",
            shared=True,
        ),
        Parameter(
            "presliding",
            "m",
            neutral=0.15,
            bounds=(0.004, 1.5),
            typical=0.15,
            starts=(0.05, 0.2),
            of="offset",
            shape=True,
        ),
        Parameter("growth", "1/rad", bounds=(0.0, 5.0), typical=0.4, starts=(0.4,), shape=True),
        Parameter("spread", "", neutral=0.5, bounds=(0.0, 1.6), typical=0.5, starts=(0.5,), shape=True),
        # how far a drive's tendons are held ahead or back at first
        Parameter("start", "", bounds=(-1.0, 1.0), typical=0.5, starts=(0.0,), per="drive", shape=True),
    )
    excited_by = "nested loops of decreasing amplitude at two speeds, with holds"
    confounded_with = ("backlash", "plastic_set", "creep")
    nests: ClassVar[Mapping[str, Mapping[str, str | float]]] = {
        "backlash": {"presliding": "half_width", "growth": 0.0}
    }
    synonyms = ("hysteresis", "coulomb_friction", "capstan")
    separated_by: ClassVar[Mapping[str, str]] = {
        "backlash": "slow reversals of many sizes, the smallest under three times the backlash: backlash has "
        "the same width everywhere, friction does not",
        "creep": "holds of 4 s and more after steps, and the same loop at two speeds: friction stays, "
        "creep decays",
        "plastic_set": "small loops after a large one: friction shows in each, a set only after a new "
        "extreme",
    }
    frequent = True

    def memory(self, n_robots: int, n_tendons: int) -> Floats:
        return np.full((n_robots, (1 + SLIDERS) * n_tendons), np.nan)

    def sweep(self, values: Floats, memory: Floats, dl: Floats, dt: Floats, routing: Routing) -> Floats:
        out, n = dl.copy(), routing.n_drives
        wrapped = np.cumsum(np.linalg.norm(routing.bend(dl), axis=-1), axis=-1)
        presliding, growth, spread = (
            np.repeat(values[:, k : k + 1], routing.n_tendons, axis=1) for k in (n, n + 1, n + 2)
        )
        if (first := np.isnan(memory)).any():
            held = -routing.drive_sign * routing.by_tendon(values[:, n + 3 :])
            memory[first] = np.concatenate([dl[:, 0], *[held] * SLIDERS], axis=1)[first]
        elastoplastic(
            out, memory, routing.by_tendon(values[:, :n]), presliding, spread, growth, routing.by_end(wrapped)
        )
        return out
