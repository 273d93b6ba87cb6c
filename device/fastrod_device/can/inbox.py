"""Inbox of the drives' frames: filled by the bus's thread, read by the loop's."""

from __future__ import annotations

import math
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import final

import numpy as np

from fastrod_device.can.bus import BusLine
from fastrod_device.can.clock import Clock
from fastrod_device.can.configuring import MOTION, STATUS
from fastrod_device.readings import DriveFeedback, Emergency
from fastrod_device.units import DriveSpec

SILENCE = 0.1
"""Without any drive's word for so long, the bus is lost [s]."""
_GRACE = 1e-3  # s for drives that did not answer the last time
_STATUS, _MOTION = struct.Struct("<Hih"), struct.Struct("<ii")


@final
class Inbox:
    """The newest words of all drives, and who has answered the last SYNC."""

    def __init__(
        self, line: BusLine, specs: Sequence[DriveSpec], clock: Clock, booted: Callable[[int], None]
    ) -> None:
        """Subscribes; `booted` is called by the bus's thread with the index of a drive that says it has
        booted."""
        n = len(specs)
        self._line, self._clock, self._booted = line, clock, booted
        self._index = {spec.node: i for i, spec in enumerate(specs)}
        self._per_unit = [spec.counts_per_turn / 60_000.0 for spec in specs]  # counts/s of 1/1000 rpm
        self._lock = threading.Lock()
        self.status = [0] * n
        """Statuswords."""
        self._position, self._torque, self._velocity, self._error = [0] * n, [0] * n, [0] * n, [0] * n
        self._t, self._t_beat, self._nmt = [-math.inf] * n, [-math.inf] * n, [-1] * n
        # answers that are expected; below 0 where one is heard before another node's SYNC that it answers
        self._pending, self._live, self._answered = ([0] * n, [0] * n), [False] * n, [False] * n
        self._waiting = 0
        self._all_in = threading.Event()
        self._mail: list[Emergency] = []
        self.log: deque[Emergency] = deque(maxlen=1000)
        """Emergency messages that were gathered."""
        self.missed = 0
        """SYNCs that not every drive answered in time."""
        self._foreign = self._echoes = 0
        line.network.subscribe(0x080, self._on_sync)
        for node in self._index:
            line.network.subscribe(STATUS + node, self._on_status)
            line.network.subscribe(MOTION + node, self._on_motion)
            line.network.subscribe(0x700 + node, self._on_heartbeat)
            line.network.subscribe(0x080 + node, self._on_emergency)

    def expect(self) -> None:
        """A SYNC is about to be sent."""
        with self._lock:
            self._echoes += self._line.echoes
            for pending in self._pending:
                pending[:] = [max(n, 0) for n in pending]  # others came late, from a cycle that is over
            self._expect()

    def _expect(self) -> None:
        """One answer more of each kind from every drive."""
        for pending in self._pending:
            pending[:] = [n + 1 for n in pending]
        answers = zip(*self._pending, self._live, strict=True)
        self._waiting = sum(max(first, 0) + max(second, 0) for first, second, live in answers if live)
        self._all_in.clear()

    def _on_sync(self, cob_id: int, data: bytearray, timestamp: float) -> None:  # noqa: ARG002
        """The drives answer another node's SYNC as well: its answers must not pass for those to ours."""
        with self._lock:
            if self._echoes:
                self._echoes -= 1
                return
            self._foreign += 1
            self._expect()

    def wait(self, bound: float) -> None:
        """Until all have answered what was expected, `bound` [s] at most; those that were silent before get
        little time."""
        if self._waiting:
            self._all_in.wait(bound)
        if not all(self._live):
            time.sleep(_GRACE)
        with self._lock:
            missing = [max(pair) > 0 for pair in zip(*self._pending, strict=True)]
            self.missed += any(missing)
            for i, lacks in enumerate(missing):
                self._live[i] = self._answered[i] or not lacks
                self._pending[0][i] = self._pending[1][i] = 0
                self._answered[i] = False
            self._waiting = 0

    def gather(self, unsent: str, connected: bool) -> DriveFeedback:
        """Everything, now. `unsent`: why nothing could be sent, or empty."""
        now = self._clock.now()
        with self._lock:
            mail, self._mail = tuple(self._mail), []
            foreign, self._foreign = self._foreign, 0
            if any(self._live):
                self._line.trouble = ""
            silence = now - max(self._t)
            lost = unsent or self._line.trouble
            if not lost and connected and silence > SILENCE:
                lost = (
                    f"no drive has said anything for {silence:.2f} s; is the cable plugged in and the "
                    "power on?"
                )
            feedback = DriveFeedback(
                t=now,
                position=np.array(self._position, dtype=np.int64),
                velocity=np.array(self._velocity, dtype=np.int64),
                torque=np.array(self._torque, dtype=np.int64),
                following_error=np.array(self._error, dtype=np.int64),
                statusword=np.array(self.status, dtype=np.int64),
                age=now - np.array(self._t),
                heartbeat_age=now - np.array(self._t_beat),
                nmt=np.array(self._nmt, dtype=np.int64),
                emergencies=mail,
                lost=lost,
                foreign_syncs=foreign,
            )
        self.log.extend(mail)
        return feedback

    def last_code(self, drive: int) -> int | None:
        """Return the code of the last emergency of a drive that was an error."""
        return next((e.code for e in reversed(self.log) if e.drive == drive and e.code), None)

    def _on_status(self, cob_id: int, data: bytearray, timestamp: float) -> None:  # noqa: ARG002
        i = self._index[cob_id - STATUS]
        if len(data) != _STATUS.size:
            return
        with self._lock:
            self.status[i], self._position[i], self._torque[i] = _STATUS.unpack(data)
            self._t[i] = self._clock.now()
            self._arrived(0, i)

    def _on_motion(self, cob_id: int, data: bytearray, timestamp: float) -> None:  # noqa: ARG002
        i = self._index[cob_id - MOTION]
        if len(data) != _MOTION.size:
            return
        velocity, error = _MOTION.unpack(data)
        with self._lock:
            self._velocity[i], self._error[i] = round(velocity * self._per_unit[i]), error
            self._answered[i] = True
            self._arrived(1, i)

    def _arrived(self, which: int, i: int) -> None:
        self._pending[which][i] -= 1
        if self._live[i] and self._pending[which][i] >= 0:
            self._waiting -= 1
            if self._waiting == 0:
                self._all_in.set()

    def _on_heartbeat(self, cob_id: int, data: bytearray, timestamp: float) -> None:  # noqa: ARG002
        if not data:
            return
        i = self._index[cob_id - 0x700]
        with self._lock:
            self._nmt[i], self._t_beat[i] = data[0] & 0x7F, self._clock.now()
        if self._nmt[i] == 0:
            self._booted(i)

    def _on_emergency(self, cob_id: int, data: bytearray, timestamp: float) -> None:  # noqa: ARG002
        if len(data) < 3:
            return
        code, register = struct.unpack_from("<HB", data)
        with self._lock:
            self._mail.append(Emergency(self._index[cob_id - 0x80], code, register, self._clock.now()))
