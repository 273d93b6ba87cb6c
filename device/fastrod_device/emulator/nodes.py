"""Emulated drives: nodes of CiA 402 on a bus, as the drives of the prototype would be seen there."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, final

import numpy as np
import numpy.typing as npt

from fastrod.checks import Bound, check_number
from fastrod.errors import InputError
from fastrod.types import Floats
from fastrod_device.can.bus import BusLine, guest
from fastrod_device.can.clock import Clock
from fastrod_device.can.dictionary import Key, object_dictionary
from fastrod_device.can.faultcodes import ENABLED
from fastrod_device.can.pacer import urgently
from fastrod_device.emulator.motor import CYCLIC, Motor
from fastrod_device.emulator.objects import Objects, ProcessData
from fastrod_device.errors import DeviceError
from fastrod_device.units import DriveSpec, Transmission

if TYPE_CHECKING:
    import can


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


_NMT, _SDO = 2, 8
"""Bytes of a frame of each service; a drive hears no other."""
_TICK = 5e-3  # s, of the thread that keeps time where nobody steps it
_CHUNK = 0.02  # s; longer gaps are gone through in pieces


class Tendons(Protocol):
    """Interface of what the tendons are fastened to: the emulated robot."""

    def move(self, t: float, pulled: Floats) -> Floats:
        """(n,) tensions [N] at time `t` [s], when `pulled` (n,) [m] of each tendon has been wound since
        power-on (+ = pulled)."""


@final
class EmulatedDrives:
    """Drives on a bus, alive from construction to `close`; also a context.

    One network and one thread for all of them. Where time is stepped they live by the SYNCs that come;
    otherwise a thread of theirs keeps time as well. Faults on demand: one method each, and `restore`. A drive
    holds its tendon by friction while it is switched off.

    `moving`, `true_pulled` and `stopped_at` are what a test may know and a master never does.
    """

    def __init__(
        self,
        specs: Sequence[DriveSpec],
        bus: str | can.BusABC,
        *,
        clock: Clock,
        tendons: Tendons,
        rate: float = 200.0,
        seed: int = 0,
        torque_noise: float = 1.0,
        eds: str | Path | None = None,
    ) -> None:
        """`rate` [1/s]: of the set-points until the master sets another; `torque_noise` [thousandths of the
        rated torque], 1 sigma; `eds`: the file that lists their objects, by default an EPOS4's.

        Raises `InputError` for drives that cannot be and for the file, `DeviceError` for the bus.
        """
        check_number("EmulatedDrives.rate", rate, Bound(above=0.0, unit="1/s"))
        self._transmission = Transmission(specs)
        self._clock, self._tendons = clock, tendons
        self._rng, self._noise = np.random.default_rng(seed), torque_noise
        self._nodes = [Node(spec, 1.0 / rate, eds) for spec in specs]
        self._motors = [node.motor for node in self._nodes]
        self._wind: Floats = np.array([spec.direction * spec.metres_per_count for spec in specs])
        self._per_newton: Floats = np.array(
            [spec.direction / spec.newtons_per_torque / (1e-3 * spec.rated_torque) for spec in specs]
        )
        self._lock = threading.RLock()
        self._t = self._synced = clock.now()
        self._off = False
        self._wrong: Exception | None = None
        self.missed_setpoints = 0
        """SYNCs in the cyclic mode, operation enabled, before which no set-point had come."""
        self.sdo_served = 0
        """SDO requests so far."""
        self._line = BusLine(bus)
        self._done = threading.Event()
        self._subscribe()
        self._thread = (
            None
            if clock.stepped
            else threading.Thread(target=self._keep_time, name="emulated drives", daemon=True)
        )
        with urgently(self._thread is not None):  # a drive has a processor of its own
            self._line.start()
            with self._lock:
                for node in self._nodes:
                    self._boot(node)
            if self._thread is not None:
                self._thread.start()

    # what a test may know

    @property
    def n_drives(self) -> int:
        """Number of drives."""
        return len(self._nodes)

    @property
    def moving(self) -> npt.NDArray[np.bool_]:
        """(n,) whose shaft turns."""
        with self._lock:
            return np.array([motor.v != 0.0 for motor in self._motors])

    @property
    def true_pulled(self) -> Floats:
        """(n,) tendon wound since power-on [m], + = pulled."""
        with self._lock:
            return self._pulled()

    @property
    def stopped_at(self) -> Floats:
        """(n,) when each shaft came to rest last [s]; nan while it turns and before it ever did."""
        with self._lock:
            return np.array([motor.stopped_at for motor in self._motors])

    @property
    def missed_at(self) -> Floats:
        """(n,) when each drive missed the heartbeat of its master last [s]; nan where it never did."""
        with self._lock:
            return np.array([node.missed_at for node in self._nodes])

    @property
    def states(self) -> tuple[str, ...]:
        """State of each drive (CiA 402)."""
        with self._lock:
            return tuple(motor.state for motor in self._motors)

    # faults on demand

    def lose_heartbeat(self, drive: int) -> None:
        """It tells no heartbeat any more."""
        self._node(drive).no_heartbeat = True

    def emergency(self, drive: int, code: int, *, lasting: bool = False) -> None:
        """It tells an error and goes to its fault state; a lasting one cannot be reset before `restore`."""
        with self._lock:
            motor = self._node(drive).motor
            motor.lasting = code if lasting else 0
            motor.fault(code)

    def block(self, drive: int) -> None:
        """Its shaft stalls."""
        self._node(drive).motor.blocked = True

    def bus_off(self) -> None:
        """Nothing is received or delivered any more."""
        self._off = True

    def reboot(self, drive: int, *, keep_position: bool = False) -> None:
        """It loses power for a moment: switched off, pre-operational, mapping and parameters of power-on, its
        counter at 0 or kept."""
        with self._lock:
            self._boot(self._node(drive), keep_position=keep_position)

    def encoder_jump(self, drive: int, counts: int) -> None:
        """Its counter jumps while the shaft stands."""
        with self._lock:
            self._node(drive).motor.offset += counts

    def silent(self, drive: int) -> None:
        """It sends no process data any more."""
        self._node(drive).silent = True

    def drop(self, drive: int, index: int) -> None:
        """It lacks an object that its dictionary lists, as other firmware may."""
        with self._lock:
            self._node(drive).objects.drop(index)

    def restore(self) -> None:
        """The causes of all faults are gone; what they did to the drives stays."""
        with self._lock:
            self._off = False
            for node in self._nodes:
                node.no_heartbeat = node.silent = node.motor.blocked = False
                node.motor.lasting = 0

    def _node(self, drive: int) -> Node:
        if isinstance(drive, bool) or not 0 <= drive < len(self._nodes):
            raise InputError(f"there is no drive {drive!r}; they count from 0 to {len(self._nodes) - 1}.")
        return self._nodes[drive]

    # life

    def serve(self, stop: threading.Event | None = None) -> None:
        """Stay alive until `stop` is set or `close` is called, for a process of its own."""
        while not self._done.wait(0.05) and not (stop is not None and stop.is_set()):
            pass

    def close(self) -> None:
        """Leave the bus. Raises `DeviceError` with its cause where the tendons failed meanwhile."""
        if self._done.is_set():
            return
        self._done.set()
        if self._thread is not None:
            self._thread.join(2.0)
        self._line.close()
        if self._wrong is not None:
            raise DeviceError(
                f"the emulated drives had to stop: {type(self._wrong).__name__}: {self._wrong}"
            ) from self._wrong

    def __enter__(self) -> EmulatedDrives:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # the bus

    def _subscribe(self) -> None:
        subscribe = self._line.network.subscribe
        subscribe(0x000, self._on(self._on_nmt))
        subscribe(0x080, self._on(self._on_sync))
        heartbeat, process_data = self._on(self._on_heartbeat), self._on(self._on_process_data)
        for who in range(1, 128):
            subscribe(0x700 + who, heartbeat)
        for cob_id in range(0x181, 0x580):
            subscribe(cob_id, process_data)
        for node in self._nodes:
            node.server.network = self._line.network
            node.objects.written = self._written(node)
            subscribe(0x600 + node.id, self._on(self._on_sdo))

    def _on(self, handle: Callable[[int, bytes], None]) -> Callable[[int, bytearray, float], None]:
        """A handler that is deaf while the bus is off, and keeps what goes wrong."""

        def receive(cob_id: int, data: bytearray, timestamp: float) -> None:  # noqa: ARG001
            with self._lock:
                if self._wrong is not None or self._done.is_set():
                    return
                try:
                    if not self._off:
                        handle(cob_id, bytes(data))
                    elif self._clock.stepped:  # deaf, but alive
                        self._advance(self._clock.now())
                except Exception as error:  # of the tendons; canopen would only log it
                    self._wrong, self._off = error, True

        return receive

    def _send(self, cob_id: int, data: bytes) -> None:
        if not self._off:
            self._line.send(cob_id, data)

    def _on_sdo(self, cob_id: int, data: bytes) -> None:
        node = next(node for node in self._nodes if node.id == cob_id - 0x600)
        if node.nmt == STOPPED or len(data) != _SDO:
            return
        self.sdo_served += 1
        self._advance(self._clock.now())
        node.server.on_request(cob_id, bytearray(data), 0.0)
        if node.nmt == OPERATIONAL and node.objects.remapped:
            node.map()

    def _written(self, node: Node) -> Callable[[Key, int], None]:
        def written(key: Key, value: int) -> None:
            node.motor.written(key, value)
            if key == (0x1017, 0):
                node.beat_due = self._clock.now() if value else np.inf
            elif key[0] == 0x1016:
                node.watched = {}  # a node is watched from its first heartbeat on

        return written

    def _on_heartbeat(self, cob_id: int, data: bytes) -> None:  # noqa: ARG002
        who, now = cob_id - 0x700, self._clock.now()
        self._advance(now)
        for node in self._nodes:
            if any((node.objects.get(0x1016, sub) >> 16) & 0x7F == who for sub in (1, 2)):
                node.watched[who] = now

    def _on_nmt(self, cob_id: int, data: bytes) -> None:  # noqa: ARG002
        if len(data) != _NMT:
            return
        command, who = data
        for node in [node for node in self._nodes if who in (0, node.id)]:
            if command in (129, 130):
                self._boot(node, keep_position=True)
            elif command in (1, 2, 128):
                node.nmt = {1: OPERATIONAL, 2: STOPPED, 128: PRE_OPERATIONAL}[command]
                if command == 1:
                    node.map()
                else:
                    node.motor.quick_stop()
                node.beat_due = min(node.beat_due, self._clock.now())  # the new state is reported at once

    def _on_process_data(self, cob_id: int, data: bytes) -> None:
        for node in self._nodes:
            pdo = node.rpdos.get(cob_id) if node.nmt == OPERATIONAL else None
            if pdo is None:
                continue
            if pdo.kind <= 240:
                node.received[cob_id] = (pdo, data)
            else:
                node.take(pdo, data)

    def _on_sync(self, cob_id: int, data: bytes) -> None:  # noqa: ARG002
        now = self._clock.now()
        self._advance(now)
        self._synced = now
        noise = self._rng.normal(0.0, self._noise, len(self._nodes))
        for node, wobble in zip(self._nodes, noise, strict=True):
            if node.nmt != OPERATIONAL:
                continue
            node.fresh = False
            for pdo, latched in node.received.values():
                node.take(pdo, latched)
            node.received.clear()
            if node.fresh:
                node.motor.setpoint()
            elif node.motor.state == ENABLED and node.motor.mode == CYCLIC:
                self.missed_setpoints += 1
            node.motor.noise = float(wobble)
            node.syncs += 1
        self._speak(now)
        for k in range(4):  # as the bus would have it: the lower COB-ID first
            for node in self._nodes:
                if node.nmt == OPERATIONAL and not node.silent and k < len(node.tpdos):
                    pdo, sources = node.tpdos[k]
                    if pdo.kind <= 240 and node.syncs % pdo.kind == 0:
                        self._send(pdo.cob_id, pdo.layout.pack(*[source() for source in sources]))

    def _speak(self, now: float) -> None:
        """Emergencies that wait, heartbeats that are due."""
        for node in self._nodes:
            for code, register in node.motor.emergencies:
                self._send(0x80 + node.id, struct.pack("<HB5x", code, register))
            node.motor.emergencies.clear()
            if now >= node.beat_due:
                period = 1e-3 * node.objects.get(0x1017)
                node.beat_due = max(node.beat_due + period, now + 0.5 * period) if period else np.inf
                if period and not node.no_heartbeat:
                    self._send(0x700 + node.id, bytes([node.nmt]))

    def _boot(self, node: Node, *, keep_position: bool = False) -> None:
        if not keep_position:
            node.motor.offset = -node.motor.x
        node.objects.reset()
        if node.motor.v != 0.0:
            node.motor.v, node.motor.stopped_at = 0.0, self._t
        node.motor.restart()
        node.rpdos, node.tpdos, node.received, node.watched = {}, [], {}, {}
        node.beat_due = np.inf
        node.nmt = PRE_OPERATIONAL
        self._send(0x700 + node.id, bytes([BOOT]))

    # time

    def _keep_time(self) -> None:
        last = self._clock.now()
        while not self._done.wait(_TICK):
            with self._lock:
                try:
                    now = self._clock.now()
                    if now - last > 4.0 * _TICK:  # it is this machine that paused, and no drive would have
                        for node in self._nodes:
                            node.watched = {who: t + now - last for who, t in node.watched.items()}
                    last = now
                    if now - self._synced > 2.0 * _TICK or any(now > node.deadline() for node in self._nodes):
                        self._advance(now)
                    self._speak(now)
                except Exception as error:  # of the tendons or of the bus
                    self._wrong, self._off = error, True
                    return

    def _pulled(self) -> Floats:
        return np.array([motor.x for motor in self._motors]) * self._wind

    def _advance(self, now: float) -> None:
        """Move all shafts until `now` [s], stopping where a heartbeat is missed on the way."""
        while self._t < now:
            to = min(now, self._t + _CHUNK)
            late = [node for node in self._nodes if node.watched and node.deadline() < to]
            if late:
                to = max(self._t, min(node.deadline() for node in late))
            for motor in self._motors:
                moved = motor.v != 0.0
                motor.advance(to - self._t)
                if motor.v != 0.0:
                    motor.stopped_at = np.nan
                elif moved:
                    motor.stopped_at = self._t + motor.rested
            self._t = to
            torque = self._tendons.move(to, self._pulled()) * self._per_newton
            for motor, value in zip(self._motors, torque, strict=True):
                motor.torque = float(value)
            for node in [node for node in late if node.deadline() <= to]:
                node.watched = {}
                self._miss(node)

    def _miss(self, node: Node) -> None:
        """The master's heartbeat did not come: as object 0x6007 says."""
        node.missed_at = self._t
        option = node.objects.get(0x6007)
        if option == 1:
            node.motor.fault(LIFE)
            return
        node.motor.emergency(LIFE)
        if option == 2:
            node.motor.control(0x0000)
        elif option == 3:
            node.motor.quick_stop()
