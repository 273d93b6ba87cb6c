"""Play of gears and of tendons in their holes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from fastrod.effects.base import Operator, Parameter, Seam, effect
from fastrod.kernels.operators import play
from fastrod.model.routing import Routing
from fastrod.types import Floats


@effect
class Backlash(Operator):
    """Play of gears and of tendons in their holes.

    Equation: p = max(l - w, min(l + w, p)), at first l + w start; rounded corners are the mean over half
    widths w (1 - c), w, w (1 + c)
    Symbols: w half_width, c rounding, l a tendon's commanded change of length, p what it ends at
    Source: play operator (Visintin 1994); backlash of tendon drives (Palli and Melchiorri)
    Residual signature: flat spot after every reversal, as wide at small as at large bends, the same at every
    speed
    """

    seam = Seam.ACTUATION
    order = 30.0
    parameters = (
        Parameter(
            "half_width",
            "m",
            bounds=(0.0, 0.6),
            typical=0.03,
            starts=(0.012, 0.04),
            per="drive",
            of="offset",
            shared=True,
        ),
        Parameter("rounding", "", bounds=(0.0, 0.4), typical=0.15, starts=(0.15,), shape=True),
        # where in its gap a drive stands at first: after homing at a flank
        Parameter("start", "", bounds=(-1.0, 1.0), typical=0.5, starts=(0.0,), per="drive", shape=True),
    )
    excited_by = "slow reversals of many sizes"
    confounded_with = ("friction", "slack")
    synonyms = ("gear_play", "play")
    separated_by: ClassVar[Mapping[str, str]] = {
        "slack": "reversals away from neutral: backlash shows there, slack only around neutral"
    }
    frequent = True

    def memory(self, n_robots: int, n_tendons: int) -> Floats:
        return np.full((n_robots, 3 * n_tendons), np.nan)

    def sweep(self, values: Floats, memory: Floats, dl: Floats, dt: Floats, routing: Routing) -> Floats:
        out, n = dl.copy(), routing.n_drives
        gap, rounding = routing.by_tendon(values[:, :n]), np.repeat(values[:, n : n + 1], dl.shape[2], axis=1)
        if (first := np.isnan(memory)).any():
            begin = routing.drive_sign * routing.by_tendon(values[:, n + 1 :]) * gap
            ahead = (begin * (1.0 - rounding), begin, begin * (1.0 + rounding))
            memory[first] = np.concatenate([dl[:, 0] + each for each in ahead], axis=1)[first]
        play(out, memory, gap, rounding)
        return out
