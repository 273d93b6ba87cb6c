"""Clocks: what the prototype takes for time; the machine's own, or one that an emulator steps as fast as the
machine computes."""

from __future__ import annotations

import threading
import time
from typing import Protocol, final


class Clock(Protocol):
    """Seconds that never run back."""

    @property
    def stepped(self) -> bool:
        """Time passes in `sleep_until` alone."""

    def now(self) -> float:
        """[s]."""

    def sleep_until(self, t: float) -> None:
        """Return when it is `t` [s] or later; at once where it is."""


@final
class WallClock:
    """The machine's monotonic clock."""

    stepped = False

    def now(self) -> float:
        """[s] since some moment of the machine's."""
        return time.monotonic()

    def sleep_until(self, t: float) -> None:
        """Asleep until `t` [s]."""
        left = t - time.monotonic()
        if left > 0.0:
            time.sleep(left)


@final
class SteppedClock:
    """Time that passes when somebody sleeps: an emulated robot then runs as fast as the machine computes. For
    one thread that sleeps."""

    stepped = True

    def __init__(self) -> None:
        self._t = 0.0
        self._lock = threading.Lock()

    def now(self) -> float:
        """[s] since it was made."""
        return self._t

    def sleep_until(self, t: float) -> None:
        """It is `t` [s], unless it is later."""
        with self._lock:
            self._t = max(self._t, t)
