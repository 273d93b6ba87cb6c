"""One cycle of the drives: a word to each, one SYNC, a word from each; and the latch that keeps them
stopped."""

from __future__ import annotations

import contextlib
import math
import struct
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import final

import numpy as np

from fastrod.errors import InputError
from fastrod.types import Ints
from fastrod_device.can.bus import BusLine
from fastrod_device.can.clock import Clock
from fastrod_device.can.configuring import BEAT, COMMAND, MASTER, PATIENCE
from fastrod_device.can.faultcodes import ENABLED, FAULT, in_words, state_in_words
from fastrod_device.can.inbox import SILENCE, Inbox
from fastrod_device.can.pacer import Pacer
from fastrod_device.errors import DeviceError
from fastrod_device.readings import DriveFeedback
from fastrod_device.units import DriveSpec

OFF, STOP, RUN, START, RESET = 0x0000, 0x0002, 0x000F, 0x001F, 0x0080
"""Controlwords: no voltage, quick stop, operation, operation with bit 4 (a move begins), fault reset."""
_WAITED = 0.6  # of a cycle that is waited for answers
_STEPPED_WAIT = 3.0  # s, the same where time is stepped
# s; beyond it the drives may have stopped by themselves, and must not be commanded to go on
_PAUSE = 0.8 * PATIENCE
_COMMAND = struct.Struct("<Hi")


@final
class Cycle:
    """One cycle of the bus: the frames sent and received. Lists have one entry for each drive."""

    def __init__(self, line: BusLine, specs: Sequence[DriveSpec], clock: Clock, rate: float) -> None:
        """Subscribes at `line`, which is started afterwards; `rate` [1/s]."""
        n = len(specs)
        self.line, self.clock, self.rate = line, clock, rate
        self.ids = [spec.node for spec in specs]
        """Node ids."""
        self.words = [OFF] * n
        """Controlwords."""
        self.hold = [0] * n
        """Targets [counts]."""
        self.enabled = [False] * n
        """Switched on by us, and still so."""
        self.configured = [False] * n
        """Connected, and not rebooted since."""
        self._gate = threading.Lock()
        self.stopping = self.acknowledged = False  # both under the gate
        self.reason = self._unsent = ""
        self._beaten = -math.inf
        self.syncs: deque[float] = deque(maxlen=200_000)
        """When SYNCs were sent [s]."""
        self.inbox = Inbox(line, specs, clock, self.forget)
        self.newest = self.gather()
        """Feedback of the last exchange."""

    @property
    def n_drives(self) -> int:
        """Number of drives."""
        return len(self.ids)

    def exchange(self, target: Ints | None = None) -> DriveFeedback:
        """See `DriveBus.exchange`."""
        if target is not None:
            self.hold = whole(self.n_drives, target, "target")
        now = self.clock.now()
        try:
            with self.line.lock:
                self.beat(now)
                for i, node in enumerate(self.ids):
                    word = self.words[i]
                    if self.stopping and word & RUN > STOP:
                        word = STOP
                    self.line.send(COMMAND + node, _COMMAND.pack(word, self.hold[i]))
                self.syncs.append(self.clock.now())
                self._sync()
        except (self.line.error, OSError) as error:
            self._unsent = f"nothing can be sent: {error}"
        else:
            self._unsent = ""
            self.inbox.wait(_STEPPED_WAIT if self.clock.stepped else _WAITED / self.rate)
        self.newest = feedback = self.gather()
        self._let_go(feedback)
        return feedback

    def quick_stop(self, reason: str = "quick stop was asked for") -> str:
        """See `DriveBus.quick_stop`."""
        self.latch(reason)
        unsent = ""
        held = self.line.lock.acquire(timeout=0.02)  # rather two frames out of order than none
        try:
            for i, node in enumerate(self.ids):
                try:
                    self.line.send(COMMAND + node, _COMMAND.pack(STOP, self.hold[i]))
                except Exception as error:  # the others must hear of it all the same
                    unsent = unsent or f"{type(error).__name__}: {error}"
            try:
                self._sync()
            except Exception as error:
                unsent = unsent or f"{type(error).__name__}: {error}"
        finally:
            if held:
                self.line.lock.release()
        return unsent

    def until(
        self,
        seconds: float,
        done: Callable[[DriveFeedback], bool],
        what: str,
        *,
        stoppable: bool = True,
        running: bool = False,
    ) -> DriveFeedback:
        """Exchange in time until `done`; `what`: that the drives are waited for to do. `running`: all must
        stay enabled."""
        pacer = Pacer(self.clock, self.rate)
        end = self.clock.now() + seconds
        while True:
            feedback = self.exchange()
            pacer.wait()
            if stoppable and self.stopping:
                raise DeviceError(f"the drives were stopped ({self.reason}) while they were to {what}.")
            if running:
                self.refuse_faults(feedback)
                self.require_enabled()
            if done(feedback):
                return feedback
            if self.clock.now() >= end:
                states = ", ".join(
                    f"node {node}: "
                    f"{state_in_words(int(word)) if math.isfinite(age) and age < SILENCE else 'silent'}"
                    for node, word, age in zip(self.ids, feedback.statusword, feedback.age, strict=True)
                )
                raise DeviceError(
                    f"the drives did not {what} within {seconds:g} s ({feedback.lost or states})."
                )

    def _sync(self) -> None:
        self.inbox.expect()
        self.line.send(0x80, b"")

    def gather(self) -> DriveFeedback:
        """Everything that is known now."""
        return self.inbox.gather(self._unsent, any(self.configured))

    def forget(self, i: int) -> None:
        """A drive has rebooted: it knows nothing any more."""
        self.configured[i], self.enabled[i], self.words[i] = False, False, OFF

    def _let_go(self, now: DriveFeedback) -> None:
        """A drive that stopped by itself, or may have because the bus failed, is commanded to stay stopped
        when it hears us again."""
        deaf = {e.drive for e in now.emergencies if e.code >> 8 == 0x81}
        for i, word in enumerate(now.statusword):
            if self.enabled[i] and (
                state_in_words(int(word)) != ENABLED or now.age[i] > SILENCE or i in deaf
            ):
                self.enabled[i], self.words[i] = False, STOP

    def latch(self, reason: str) -> None:
        """Keep them stopped."""
        with self._gate:
            if not self.stopping or self.acknowledged:
                self.reason = reason
            self.acknowledged, self.stopping = False, True

    def beat(self, now: float | None = None) -> None:
        """The controller's heartbeat, when it is due."""
        t = self.clock.now() if now is None else now
        if t - self._beaten > _PAUSE and any(self.enabled) and not self.stopping:
            self.latch(f"the controller paused for {t - self._beaten:.2f} s")
        if t - self._beaten >= BEAT - 1e-6:
            self._beaten = t
            with contextlib.suppress(self.line.error):
                self.line.send(0x700 + MASTER, b"\x05")

    def command(self, code: int, node: int) -> None:
        """An NMT command. Raises `DeviceError` where nothing can be sent."""
        try:
            self.line.send(0x000, bytes([code, node]))
        except (self.line.error, OSError) as error:
            raise DeviceError(f"nothing can be sent to node {node}: {error}.") from error

    def refuse_faults(self, now: DriveFeedback, what: str = "is in fault") -> None:
        """Raises `DeviceError` for the first drive in fault."""
        for i, word in enumerate(now.statusword):
            if state_in_words(int(word)) == FAULT:
                code = self.inbox.last_code(i)
                why = "it says no reason" if code is None else in_words(code)
                raise DeviceError(f"the drive at node {self.ids[i]} {what}: {why}.")

    def require_connected(self) -> None:
        """Raises `DeviceError` otherwise."""
        missing = [node for node, known in zip(self.ids, self.configured, strict=True) if not known]
        if missing:
            raise DeviceError(
                f"the drives at nodes {missing} are not connected, or have rebooted; connect() first."
            )

    def require_enabled(self) -> None:
        """Raises `DeviceError` otherwise."""
        for i, node in enumerate(self.ids):
            if not self.enabled[i]:
                raise DeviceError(
                    f"the drive at node {node} is not enabled but in the state "
                    f"{state_in_words(self.inbox.status[i])!r}."
                )

    def acknowledge(self) -> None:
        """Somebody has seen that they were stopped."""
        with self._gate:
            self.acknowledged = self.stopping

    def release(self) -> None:
        """Go on, unless somebody has stopped them again since `acknowledge`."""
        with self._gate:
            if not self.stopping or self.acknowledged:
                self.stopping = self.acknowledged = False


def whole(n_drives: int, values: Ints, name: str) -> list[int]:
    """(n_drives,) counts as numbers. Raises `InputError` where they are not that."""
    given = np.asarray(values)
    if given.shape != (n_drives,) or given.dtype.kind not in "iu":
        raise InputError(f"{name} is {values!r}; it must be ({n_drives},) whole counts.")
    if not np.all((given >= -(2**31)) & (given < 2**31)):
        raise InputError(
            f"{name} is {given.tolist()} counts; a drive counts in 32 bits. Was it given in another unit?"
        )
    return [int(value) for value in given]
