"""Emulated Dynamixel servos on a serial port: protocol 2.0 answered from a control table, and a shaft behind
each."""

from __future__ import annotations

import math
import struct
import threading
from collections.abc import Sequence
from typing import Any, final

import numpy as np
import numpy.typing as npt

from fastrod.types import Floats
from fastrod_device.can.clock import Clock
from fastrod_device.dynamixel.line import (
    BUS_WATCHDOG,
    CURRENT_LIMIT,
    CURRENT_UNIT,
    GOAL_CURRENT,
    GOAL_POSITION,
    HARDWARE_ERROR,
    INDIRECT_ADDRESS,
    INDIRECT_DATA,
    OPERATING_MODE,
    PRESENT_CURRENT,
    PRESENT_POSITION,
    PRESENT_VELOCITY,
    PROFILE_ACCELERATION,
    PROFILE_VELOCITY,
    REVOLUTION,
    TORQUE_ENABLE,
    VELOCITY_UNIT,
    WATCHDOG_TRIPPED,
    Register,
)
from fastrod_device.dynamixel.packets import (
    EVERYBODY,
    PING,
    READ,
    REBOOT,
    STATUS,
    SYNC_READ,
    SYNC_WRITE,
    WRITE,
    Packet,
    PacketReader,
    SerialPort,
    offer,
)
from fastrod_device.emulator.nodes import Tendons
from fastrod_device.units import DriveSpec, Transmission

OVERLOAD = 0x20
"""Bit of the hardware error."""
_STEP = 1e-3  # s, of a shaft
_TABLE = 512  # bytes
_N_INDIRECT = 28
_MODEL = 1020  # XM430-W350
_WATCHDOG_UNIT = 0.02  # s
_ACCELERATION_UNIT = 214.577 / 3600.0 * REVOLUTION  # counts/s2
_INSTRUCTION_ERROR, _RANGE_ERROR, _ACCESS_ERROR, _ALERT = 2, 4, 7, 0x80


@final
class _Servo:
    """One servo: its control table, and its shaft [counts]."""

    def __init__(self, spec: DriveSpec) -> None:
        self.spec = spec
        self.x = self.v = self.base = 0.0
        self.errors = 0
        self.reboot()

    def reboot(self) -> None:
        """Power-on: torque off, no error, whole turns forgotten."""
        self.table = bytearray(_TABLE)
        self.base = REVOLUTION * math.floor(self.x / REVOLUTION)
        self.heard = 0.0
        self.errors = 0
        self.set(CURRENT_LIMIT, 1193)
        self.set(GOAL_CURRENT, 1193)
        self.set(OPERATING_MODE, 3)
        for k in range(_N_INDIRECT):
            self.set(Register(INDIRECT_ADDRESS + 2 * k, 2), INDIRECT_DATA + k)
        for register in (GOAL_POSITION, PRESENT_POSITION):
            self.set(register, round(self.x - self.base))

    def get(self, register: Register, *, signed: bool = True) -> int:
        data = self.table[register.address : register.address + register.size]
        return int.from_bytes(data, "little", signed=signed)

    def set(self, register: Register, value: int) -> None:
        size = register.size
        value %= 256**size
        self.table[register.address : register.address + size] = value.to_bytes(size, "little")

    def advance(self, dt: float, force: float) -> None:
        """Time passes; `force` [N] pulls at the tendon."""
        on, target = bool(self.get(TORQUE_ENABLE)), self.get(GOAL_POSITION) + self.base
        fastest = (self.get(PROFILE_VELOCITY) or 32767) * VELOCITY_UNIT
        brake = (self.get(PROFILE_ACCELERATION) or 32767) * _ACCELERATION_UNIT
        far = target - self.x
        wanted = (
            math.copysign(min(fastest, abs(far) / dt, math.sqrt(2.0 * brake * abs(far))), far) if on else 0.0
        )
        self.v += max(-brake * dt, min(brake * dt, wanted - self.v)) if on else -self.v
        current = self.spec.direction * force / self.spec.newtons_per_torque / self.spec.torque_constant
        if abs(current) >= self.get(GOAL_CURRENT) * CURRENT_UNIT and self.v * current > 0.0:
            self.v = 0.0  # it pulls with all it has
        self.x += self.v * dt
        self.set(PRESENT_CURRENT, round(current / CURRENT_UNIT) if on else 0)
        self.set(PRESENT_VELOCITY, round(self.v / VELOCITY_UNIT))
        self.set(PRESENT_POSITION, round(self.x - self.base))

    def watch(self, now: float) -> None:
        """Trip where nothing has come for too long."""
        periods = self.get(BUS_WATCHDOG, signed=False)
        late = now - self.heard > periods * _WATCHDOG_UNIT
        if self.get(TORQUE_ENABLE) and 0 < periods < WATCHDOG_TRIPPED and late:
            self.set(BUS_WATCHDOG, WATCHDOG_TRIPPED)
            self.set(GOAL_POSITION, round(self.x - self.base))

    def fail(self, bit: int) -> None:
        """A hardware error: the torque is switched off."""
        self.errors |= bit
        self.set(HARDWARE_ERROR, self.errors)
        self.set(TORQUE_ENABLE, 0)

    def place(self, address: int) -> int:
        """Return where an address leads, through the indirect ones."""
        k = address - INDIRECT_DATA
        return self.get(Register(INDIRECT_ADDRESS + 2 * k, 2)) if 0 <= k < _N_INDIRECT else address

    def read(self, address: int, size: int) -> bytes:
        return bytes(self.table[self.place(address + k)] for k in range(size))

    def write(self, address: int, data: bytes) -> int:
        """The error of a write; 0 where it was done."""
        if address < TORQUE_ENABLE.address and self.get(TORQUE_ENABLE):
            return _ACCESS_ERROR  # of the EEPROM, while the torque is on
        tripped = self.get(BUS_WATCHDOG, signed=False) == WATCHDOG_TRIPPED
        if tripped and GOAL_CURRENT.address <= address < PRESENT_CURRENT.address:
            return _RANGE_ERROR
        if address == TORQUE_ENABLE.address and data != b"\0" and self.errors:
            return _ACCESS_ERROR
        for k, byte in enumerate(data):
            self.table[self.place(address + k)] = byte
        return 0


@final
class EmulatedDynamixels:
    """Servos on a port, a `SerialPort` itself. They live by the packets that come: time passes for them when
    one does. `moving` and `true_pulled` are what a test may know and a master never does."""

    def __init__(
        self, specs: Sequence[DriveSpec], bus: str | None, *, clock: Clock, tendons: Tendons, **_: Any
    ) -> None:
        """`bus` is what `virtual:NAME` then opens in this process; None: a test serves the bytes itself."""
        specs = Transmission(specs).specs
        self._servos = {spec.node: _Servo(spec) for spec in specs}
        self._wind: Floats = np.array([spec.direction * spec.metres_per_count for spec in specs])
        self._clock, self._tendons, self._t = clock, tendons, clock.now()
        self._bus, self._reader, self._out = bus, PacketReader(), bytearray()
        self._force = np.zeros(len(specs))
        self._lock = threading.RLock()
        self.silent: set[int] = set()
        """Ids of servos that answer nothing."""
        if bus is not None:
            port: SerialPort = self
            offer(bus, port)

    @property
    def moving(self) -> npt.NDArray[np.bool_]:
        """(n,) whose shaft turns."""
        with self._lock:
            self._advance()
            return np.array([abs(servo.v) > VELOCITY_UNIT for servo in self._servos.values()])

    @property
    def true_pulled(self) -> Floats:
        """(n,) tendon wound since power-on [m], + = pulled."""
        with self._lock:
            self._advance()
            return self._pulled()

    def overload(self, drive: int) -> None:
        """The servo's own protection switches it off."""
        with self._lock:
            list(self._servos.values())[drive].fail(OVERLOAD)

    def write(self, data: bytes) -> None:
        """Bytes from the controller."""
        with self._lock:
            self._advance()
            for packet in self._reader.take(data):
                self._serve(packet)

    def read(self, timeout: float) -> bytes:  # noqa: ARG002
        """Return what they have answered; they answer at once."""
        with self._lock:
            data = bytes(self._out)
            self._out.clear()
            return data

    def close(self) -> None:
        """Off: the name opens nothing any more."""
        if self._bus is not None:
            offer(self._bus, None)

    def _pulled(self) -> Floats:
        return np.array([servo.x for servo in self._servos.values()]) * self._wind

    def _advance(self) -> None:
        now = self._clock.now()
        while self._t < now - 1e-9:
            dt = min(_STEP, now - self._t)
            self._t += dt
            for servo, force in zip(self._servos.values(), self._force, strict=True):
                servo.watch(self._t)
                servo.advance(dt, float(force))
            self._force = self._tendons.move(self._t, self._pulled())

    def _serve(self, packet: Packet) -> None:
        for servo in self._servos.values():
            servo.heard = self._t
        data = packet.data
        if packet.node == EVERYBODY and packet.instruction == SYNC_WRITE:
            address, size = struct.unpack_from("<HH", data)
            for k in range(4, len(data), size + 1):
                if data[k] in self._servos:
                    self._servos[data[k]].write(address, data[k + 1 : k + 1 + size])
        elif packet.node == EVERYBODY and packet.instruction == SYNC_READ:
            address, size = struct.unpack_from("<HH", data)
            for node in data[4:]:
                if node in self._servos:
                    self._answer(node, 0, self._servos[node].read(address, size))
        elif packet.node in self._servos:
            self._answer(packet.node, *self._done(self._servos[packet.node], packet))

    def _done(self, servo: _Servo, packet: Packet) -> tuple[int, bytes]:
        """Error and data that one servo answers."""
        data = packet.data
        if packet.instruction == PING:
            return 0, struct.pack("<HB", _MODEL, 48)
        if packet.instruction == READ:
            return 0, servo.read(*struct.unpack("<HH", data))
        if packet.instruction == WRITE:
            return servo.write(int.from_bytes(data[:2], "little"), data[2:]), b""
        if packet.instruction == REBOOT:
            servo.reboot()
            return 0, b""
        return _INSTRUCTION_ERROR, b""

    def _answer(self, node: int, error: int, data: bytes) -> None:
        if node not in self.silent:
            alert = _ALERT if self._servos[node].errors else 0
            self._out += Packet(node, STATUS, bytes([error | alert]) + data).encoded()
