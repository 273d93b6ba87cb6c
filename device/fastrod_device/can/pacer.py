"""When the next cycle is: multiples of a period, without drift."""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import final

from fastrod.checks import Bound, check_number
from fastrod_device.can.clock import Clock

_SPIN = 3e-4  # s before the moment that are waited awake: a sleeping thread is woken some 0.1 ms late


def urgent(priority: int = 10) -> bool:
    """Ask that this thread, and those that it starts from now on, come before other programs; whether that
    was granted.

    It needs a right (CAP_SYS_NICE, or rtprio in limits.conf) and Linux. Ask before the bus is opened, so that
    its thread has it too.
    """
    if sys.platform != "linux":
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:
        return False
    return True


def ordinary() -> None:
    """Take back what `urgent` was granted, for this thread."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@contextmanager
def urgently(wanted: bool = True) -> Iterator[None]:
    """Threads that are started in this block are `urgent`; the thread that starts them is what it was again.
    Nothing unless `wanted`."""
    if not (wanted and sys.platform == "linux"):
        yield
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    urgent()
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, *before)


@final
class Pacer:
    """Waits for multiples of 1/rate since its first `wait`.

    A cycle that comes late runs at once, and the next one at its multiple again; periods that passed whole
    are left out. As a context it keeps the collector of garbage out of the loop (it may pause for tens of
    ms); the loop's own garbage is freed by reference counts.
    """

    def __init__(self, clock: Clock, rate: float) -> None:
        """`rate` [1/s], positive; `InputError` otherwise."""
        check_number("Pacer.rate", rate, Bound(above=0.0, unit="1/s"))
        self._clock = clock
        self.period = 1.0 / rate
        """[s]."""
        self._start = clock.now()
        self._k = 0
        self._collected = False
        self.slipped = 0
        """Cycles that were left out because the loop was late."""

    def wait(self) -> float:
        """Return at the next multiple, or at once where it is past; how late that is [s]."""
        now = self._clock.now()
        self._k += 1
        behind = now - (self._start + self._k * self.period)
        if behind > self.period:  # late by a cycle or more
            skipped = int(behind / self.period)
            self.slipped += skipped
            self._k += skipped
        t = self._start + self._k * self.period
        if self._clock.stepped:
            self._clock.sleep_until(t)
            return max(0.0, self._clock.now() - t)
        self._clock.sleep_until(t - _SPIN)
        while self._clock.now() < t:
            time.sleep(0.0)  # lets other threads have the interpreter
        return self._clock.now() - t

    def restart(self) -> None:
        """Multiples count from now."""
        self._start, self._k = self._clock.now(), 0

    def __enter__(self) -> Pacer:
        gc.collect()
        gc.freeze()
        self._collected = gc.isenabled()
        gc.disable()
        self.restart()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._collected:
            gc.enable()
        gc.unfreeze()
