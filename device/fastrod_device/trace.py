"""`Trace`: where the tendons were lately, for frames that come late."""

from __future__ import annotations

from collections import deque
from typing import final

import numpy as np

from fastrod.types import Floats


@final
class Trace:
    """What encoders said and what was commanded, of the newest cycles. Its caller has a lock."""

    def __init__(self, n_tendons: int, n_cycles: int) -> None:
        """Empty."""
        self._nowhere: Floats = np.full(n_tendons, np.nan)
        self._past: deque[tuple[float, Floats, Floats]] = deque(maxlen=n_cycles)

    def add(self, t: float, dl: Floats, commanded: Floats) -> None:
        """(n_wires,) by the encoders at `t` [s], and the set-points then [m]."""
        self._past.append((t, dl, commanded))

    def clear(self) -> None:
        """Forget all of it."""
        self._past.clear()

    def at(self, t: float) -> tuple[Floats, Floats]:
        """(n_wires,) and (n_wires,) [m] at `t` [s], by a straight line between two cycles; nan where nothing
        is known."""
        past = self._past
        if not past:
            return self._nowhere, self._nowhere
        k = next((k for k in range(len(past) - 1, -1, -1) if past[k][0] <= t), 0)
        if k == len(past) - 1 or t <= past[0][0]:
            return past[k][1], past[k][2]
        (t0, dl0, commanded0), (t1, dl1, commanded1) = past[k], past[k + 1]
        fraction = (t - t0) / (t1 - t0)
        return dl0 + fraction * (dl1 - dl0), commanded0 + fraction * (commanded1 - commanded0)
