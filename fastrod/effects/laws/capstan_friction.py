"""Dry friction of the tendons along the backbone by the capstan equation, with their tension."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from fastrod.effects.base import Operator, Parameter, Seam, effect
from fastrod.effects.ports import EffectPorts
from fastrod.kernels.operators import SLIDERS, elastoplastic
from fastrod.model.routing import Routing
from fastrod.types import Floats


@effect
class CapstanFriction(Operator):
    """Dry friction of the tendons along the backbone by the capstan equation, with their tension.

    A tendon that is pulled has T e^(mu phi) at its drive where the rod feels T, one that is released
    T e^(-mu phi), and stretches by that: tendons that do not stretch (compliance zero) show nothing.

    Equation: l -> l + c |T| (e^(-mu phi z) - 1), z the mean of sliders z_j = clip(z_j + l' / r_j, -1, 1), phi
    the angle that the tendon wraps, c its compliance, r_j over r e^(-+s)
    Symbols: mu as named, r presliding, s spread, T tension, l a tendon's commanded change of length
    Source: capstan equation, Kaneko 1991, Palli and Melchiorri; sliders in parallel, Iwan 1966
    Residual signature: loops as those of friction, but wider under load and hardly open where a tendon is
    loose
    """

    seam = Seam.ACTUATION
    order = 86.0
    parameters = (
        Parameter("mu", "", bounds=(0.0, 2.0), typical=0.1, starts=(0.08, 0.25), per="drive", shared=True),
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
        Parameter("spread", "", neutral=0.5, bounds=(0.0, 1.6), typical=0.5, starts=(0.5,), shape=True),
    )
    excited_by = "nested loops of decreasing amplitude, with a known load on and off"
    confounded_with = ("friction", "backlash")
    refines = "friction"
    reads_tension = True
    separated_by: ClassVar[Mapping[str, str]] = {
        "friction": "the same loops with and without a known load: only by the capstan it rubs more under it"
    }

    def memory(self, n_robots: int, n_tendons: int) -> Floats:
        return np.full((n_robots, (1 + SLIDERS) * n_tendons), np.nan)

    def sweep(self, values: Floats, memory: Floats, dl: Floats, dt: Floats, routing: Routing) -> Floats:
        """`dl` less the mean of the sliders, as if each held 1 m back; `change` has what they hold."""
        out, ones = dl.copy(), np.ones((len(dl), routing.n_tendons))
        presliding, spread = (np.repeat(values[:, k, None], routing.n_tendons, axis=1) for k in (-2, -1))
        elastoplastic(out, memory, ones, presliding, spread, 0.0 * ones, np.zeros_like(dl))
        return out

    def change(self, values: Floats, swept: Floats, ports: EffectPorts) -> Floats:
        routing = ports.routing
        wrapped = routing.by_end(np.cumsum(np.linalg.norm(ports.bend(), axis=-1), axis=-1))
        loss = np.expm1(routing.by_tendon(values[:, :-2]) * wrapped * swept)
        return np.asarray(ports.compliance * np.abs(ports.solved_tension) * loss)
