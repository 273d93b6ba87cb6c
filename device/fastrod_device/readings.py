"""Readings of the drives in one cycle, in their units and in ours; `Trace`: what they said lately."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import final

import numpy as np

from fastrod.types import Floats, Ints


@dataclass(frozen=True)
class Emergency:
    """An EMCY message (CiA 301)."""

    drive: int
    """Index of the drive, from 0."""
    code: int
    """Error code."""
    register: int
    """Error register, object 0x1001."""
    t: float
    """When it came [s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DriveFeedback:
    """The newest words of all drives, in the drives' units; drive axis first."""

    t: float
    """When they were gathered [s]."""
    position: Ints
    """(n_drives,) object 0x6064 [counts]."""
    velocity: Ints
    """(n_drives,) object 0x606C [counts/s]."""
    torque: Ints
    """(n_drives,) object 0x6077 [thousandths of the rated torque]."""
    following_error: Ints
    """(n_drives,) object 0x60F4, target minus actual position [counts]."""
    statusword: Ints
    """(n_drives,) object 0x6041."""
    age: Floats
    """(n_drives,) since the last process data [s]; inf before the first."""
    heartbeat_age: Floats
    """(n_drives,) since the last heartbeat [s]; inf before the first."""
    nmt: Ints
    """(n_drives,) NMT state of the last heartbeat: 0 booting, 4 stopped, 5 operational, 127 pre-operational,
    -1 none yet."""
    emergencies: tuple[Emergency, ...]
    """That came since the last feedback."""
    lost: str
    """Why the bus carries nothing, one sentence; empty while it does."""
    foreign_syncs: int = 0
    """SYNCs of other nodes that came since the last feedback."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Readings:
    """The same in SI units; drive axis first."""

    t: float
    """[s]."""
    dl: Floats
    """(n_drives,) change of tendon length [m], negative = pulled."""
    rate: Floats
    """(n_drives,) of it [m/s]."""
    tension: Floats
    """(n_drives,) from the motors' torque [N]."""
    current: Floats
    """(n_drives,) of the motors [A]."""
    following_error: Floats
    """(n_drives,) commanded minus done [m]."""
    statusword: Ints
    """(n_drives,) object 0x6041."""
    age: Floats
    """(n_drives,) since the last process data [s]."""
    heartbeat_age: Floats
    """(n_drives,) since the last heartbeat [s]."""
    nmt: Ints
    """(n_drives,) NMT state of the last heartbeat."""
    emergencies: tuple[Emergency, ...]
    """That came since the last cycle."""
    lost: str
    """Why the bus carries nothing; empty while it does."""
    foreign_syncs: int = 0
    """SYNCs of other nodes that came since the last cycle."""


@final
class Trace:
    """Encoder readings and commands of the newest cycles, for frames that come late. Its caller has a
    lock."""

    def __init__(self, n_tendons: int, n_cycles: int) -> None:
        """Empty."""
        self._nowhere: Floats = np.full(n_tendons, np.nan)
        self._past: deque[tuple[float, Floats, Floats]] = deque(maxlen=n_cycles)

    def add(self, t: float, dl: Floats, commanded: Floats) -> None:
        """(n_tendons,) by the encoders at `t` [s], and the set-points then [m]."""
        self._past.append((t, dl, commanded))

    def clear(self) -> None:
        """Forget all of it."""
        self._past.clear()

    def at(self, t: float) -> tuple[Floats, Floats]:
        """(n_tendons,) of either [m] at `t` [s], by a straight line between two cycles; nan where nothing is
        known."""
        past = self._past
        if not past:
            return self._nowhere, self._nowhere
        k = next((k for k in range(len(past) - 1, -1, -1) if past[k][0] <= t), 0)
        if k == len(past) - 1 or t <= past[0][0]:
            return past[k][1], past[k][2]
        (t0, dl0, commanded0), (t1, dl1, commanded1) = past[k], past[k + 1]
        fraction = (t - t0) / (t1 - t0)
        return dl0 + fraction * (dl1 - dl0), commanded0 + fraction * (commanded1 - commanded0)
