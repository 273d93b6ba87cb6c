"""One emulated drive as the bus sees it: its objects, its process data, whom it listens to."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, final

import numpy as np

from fastrod_device.bus import guest
from fastrod_device.dictionary import Key, object_dictionary
from fastrod_device.motor import Motor
from fastrod_device.objects import Objects, ProcessData
from fastrod_device.units import DriveSpec

BOOT, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0, 4, 5, 127
"""NMT states."""
LIFE, LENGTH = 0x8130, 0x8210
"""Emergency codes: no heartbeat of the master, PDO too short."""


@final
class Node:
    """One drive as the bus sees it."""

    def __init__(self, spec: DriveSpec, period: float, eds: str | Path | None = None) -> None:
        """`period` [s] of set-points until the master sets another; `eds`: its dictionary's file."""
        self.id = spec.node
        self.objects = Objects(object_dictionary(eds), spec.node)
        self.objects.preset = {
            (0x1018, 4): 1000 + spec.node,
            (0x3001, 1): round(1e3 * spec.rated_torque / spec.torque_constant),
            (0x3001, 5): round(1e6 * spec.torque_constant),
            (0x6076, 0): round(1e6 * spec.rated_torque),
            (0x60C2, 1): max(1, min(255, round(1e3 * period))),
        }
        self.objects.reset()
        self.motor = Motor(spec, self.objects)
        self.server: Any = guest("canopen.sdo").SdoServer(0x600 + spec.node, 0x580 + spec.node, self.objects)
        self.nmt = BOOT
        self.beat_due = 0.0
        self.watched: dict[int, float] = {}
        """Node id -> time of its last heartbeat [s]."""
        self.received: dict[int, tuple[ProcessData, bytes]] = {}
        self.rpdos: dict[int, ProcessData] = {}
        self.tpdos: list[tuple[ProcessData, list[Callable[[], int]]]] = []
        self.missed_at = np.nan
        """When it missed one last [s]."""
        self.syncs = 0
        self.fresh = False
        self.no_heartbeat = self.silent = False

    def map(self) -> None:
        """Process data as mapped now."""
        self.objects.remapped = False
        get, live = self.objects.get, self.objects.live

        def source(key: Key) -> Callable[[], int]:
            return live[key] if key in live else lambda: get(*key)

        self.rpdos = {pdo.cob_id: pdo for pdo in self.objects.process_data(0x1400)}
        self.tpdos = [(pdo, [source(key) for key in pdo.keys]) for pdo in self.objects.process_data(0x1800)]

    def take(self, pdo: ProcessData, data: bytes) -> None:
        """Set the objects of an RPDO."""
        if len(data) < pdo.layout.size:
            self.motor.emergency(LENGTH)
            return
        for key, value in zip(pdo.keys, pdo.layout.unpack_from(data), strict=True):
            self.motor.written(key, value)
            self.objects.values[key] = value
            self.fresh = self.fresh or key == (0x607A, 0)

    def deadline(self) -> float:
        """When it will miss somebody's heartbeat [s]; inf where it watches nobody."""
        return min((t + self._patience(who) for who, t in self.watched.items()), default=np.inf)

    def _patience(self, who: int) -> float:
        for sub in (1, 2):
            value = self.objects.get(0x1016, sub)
            if (value >> 16) & 0x7F == who and value & 0xFFFF:
                return 1e-3 * (value & 0xFFFF)
        return float(np.inf)
