"""The configuration of a drive, written once by SDO before it moves: who it is, its limits, its process
data."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from fastrod.errors import InputError
from fastrod.types import Ints
from fastrod_device.can.bus import BusLine, guest
from fastrod_device.can.dictionary import find, titled
from fastrod_device.errors import DeviceError
from fastrod_device.units import DriveSpec

MASTER = 127
"""Node id of the controller."""
BEAT = 0.05
"""Period of heartbeats, of the drives and of the controller [s]."""
PATIENCE = 0.15
"""Without the controller's heartbeat for so long, a drive stops by itself [s]."""
STATUS, MOTION, COMMAND = 0x180, 0x280, 0x200
"""COB-IDs, less the node id: TPDO 1 (statusword, position, torque), TPDO 2 (velocity, following error), RPDO
1 (controlword, target)."""
_MILLI_RPM = 0xFDB44700  # unit of velocity; whole rpm would be 70 counts/s
_MAPPING = {
    0x1600: (0x6040_0010, 0x607A_0020),
    0x1A00: (0x6041_0010, 0x6064_0020, 0x6077_0010),
    0x1A01: (0x606C_0020, 0x60F4_0020),
}
_UNUSED = (0x1401, 0x1402, 0x1403, 0x1802, 0x1803)  # PDOs that a drive may have kept from somebody else
# bits of a COB-ID; some drives refuse a TPDO that could be asked for by RTR
_INVALID, _NO_RTR = 0x8000_0000, 0x4000_0000
_NO_SUCH_OBJECT = (0x06020000, 0x06090011)
_MODES = {
    1: "profile position",
    2: "velocity",
    3: "profile velocity",
    4: "profile torque",
    6: "homing",
    7: "interpolated position",
    8: "cyclic synchronous position",
    9: "cyclic synchronous velocity",
    10: "cyclic synchronous torque",
}
"""Bits of object 0x6502, counted from 1, in words."""
_CYCLIC = 8
_WITHOUT = {
    0x3001: "the current of its motor is not limited",
    0x605A: "after a quick stop it does what it was set to do before",
    0x6065: "the following error is not limited by the drive",
    0x6076: "its rated torque is not compared with DriveSpec.rated_torque",
    0x607D: "the target position is not limited by the drive",
    0x607F: "the profile velocity is not limited",
    0x6080: "the speed of its motor is not limited by the drive",
    0x6085: "the deceleration of a quick stop is the drive's own",
    0x60C2: "how long it interpolates set-points is the drive's own",
}
"""Consequence of an object that a drive lacks."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DriveLimits:
    """Limits that drives enforce by themselves, in counts; one number for all drives, or (n_drives,)."""

    position_limit: Ints | int
    """Greatest target position, either way [counts]."""
    velocity_limit: Ints | int
    """Greatest speed [counts/s]."""
    following_error: Ints | int
    """Beyond it a drive faults [counts]."""
    deceleration: Ints | int
    """Deceleration of a quick stop [counts/s2]."""
    torque_limit: Ints | int
    """Greatest torque, either way [thousandths of the rated one]."""
    hold: bool
    """After a quick stop the motor holds the tendon; otherwise it is switched off."""

    def of(self, name: str, n_drives: int) -> list[int]:
        """One of them for each drive. Raises `InputError` where it is of another shape or cannot be."""
        given = np.asarray(getattr(self, name))
        if given.shape not in ((), (n_drives,)) or given.dtype.kind not in "iu":
            raise InputError(
                f"{name} is {getattr(self, name)!r}; it must be a whole number, or one for "
                f"each of {n_drives} drives."
            )
        values = [int(value) for value in np.broadcast_to(given, (n_drives,))]
        bits = 16 if name == "torque_limit" else 31
        if not all(0 < value < 2**bits for value in values):
            raise InputError(
                f"{name} is {values}; it must be positive and below 2^{bits}, the most that a "
                "drive counts to."
            )
        return values


@final
class Configurator:
    """Reads and writes objects of drives; never in the loop. `beat` is called with every request, as drives
    expect heartbeats meanwhile."""

    def __init__(
        self, line: BusLine, dictionary: Any, specs: Sequence[DriveSpec], beat: Callable[[], None]
    ) -> None:
        """Subscribes to the answers."""
        self._dictionary, self._specs, self._beat = dictionary, specs, beat
        self._sdo = guest("canopen.sdo")
        self._clients = []
        for spec in specs:
            client = self._sdo.SdoClient(0x600 + spec.node, 0x580 + spec.node, dictionary)
            client.network, client.RESPONSE_TIMEOUT, client.MAX_RETRIES = line.network, 0.4, 2
            line.network.subscribe(0x580 + spec.node, client.on_response)
            self._clients.append(client)
        self._error = line.error
        self.requests = 0
        """SDO requests so far."""
        self.notices: list[str] = []
        """Limits that the drives do not enforce, for want of an object: a sentence each."""
        self._modes = [0] * len(specs)

    def read(self, drive: int, index: int, sub: int = 0) -> int:
        """A number. Raises `DeviceError`: no answer, no such object, or refused."""
        value = self._read(drive, index, sub)
        if value is None:
            raise self._lacks(drive, index, sub)
        return value

    def write(self, drive: int, index: int, sub: int, value: int) -> None:
        """Write a number. Raises `DeviceError`: no answer, no such object, or refused."""
        if not self._write(drive, index, sub, value):
            raise self._lacks(drive, index, sub)

    def offer(self, drive: int, index: int, sub: int, value: int) -> None:
        """Write a number to an object that the drive may lack; `notices` then has what follows.

        Raises `DeviceError`: no answer, or refused.
        """
        if not self._write(drive, index, sub, value):
            self._note(drive, index, sub)

    def _note(self, drive: int, index: int, sub: int) -> None:
        number = f"0x{index:04X}:{sub:02X}" if sub else f"0x{index:04X}"
        sentence = f"Node {self._specs[drive].node} has no object {number}: {_WITHOUT[index]}."
        if sentence not in self.notices:
            self.notices.append(sentence)

    def _lacks(self, drive: int, index: int, sub: int) -> DeviceError:
        node = self._specs[drive].node
        return DeviceError(f"the drive at node {node} has no object {titled(index, sub)}, which is needed.")

    def _read(self, drive: int, index: int, sub: int) -> int | None:
        """None where there is no such object, in the dictionary or in the drive."""
        var = find(self._dictionary, index, sub)
        data = None if var is None else self._request(drive, index, sub, None)
        if var is None or data is None:
            return None
        if 8 * len(data) != len(var):
            raise DeviceError(
                f"node {self._specs[drive].node} answers {len(data)} bytes for object {titled(index, sub)};"
                f" its dictionary says {len(var) // 8}. Is the EDS file that of this drive?"
            )
        return int(var.decode_raw(data))

    def _write(self, drive: int, index: int, sub: int, value: int) -> bool:
        """Whether there is such an object."""
        var = find(self._dictionary, index, sub)
        if var is None:
            return False
        try:
            data = bytes(var.encode_raw(value))
        except (ValueError, TypeError) as error:  # an EDS file may give it another type
            raise DeviceError(
                f"{value} does not fit object {titled(index, sub)} of node {self._specs[drive].node},"
                f" whose data type is 0x{var.data_type:02X} in its dictionary."
            ) from error
        return self._request(drive, index, sub, data) is not None

    def _request(self, drive: int, index: int, sub: int, data: bytes | None) -> bytes | None:
        """Return what was read, or nothing after a write; None where the drive has no such object."""
        node, what = self._specs[drive].node, f"0x{index:04X}:{sub:02X}"
        self._beat()
        self.requests += 1
        try:
            if data is None:
                return bytes(self._clients[drive].upload(index, sub))
            self._clients[drive].download(index, sub, data)
        except self._sdo.SdoAbortedError as error:
            if error.code in _NO_SUCH_OBJECT:
                return None
            raise DeviceError(f"the drive at node {node} refuses object {what}: {error}.") from error
        except self._sdo.SdoCommunicationError as error:
            raise DeviceError(
                f"the drive at node {node} does not answer (object {what}); are its power, its node id and "
                "the bit rate right?"
            ) from error
        except self._error as error:
            raise DeviceError(f"nothing can be sent to node {node}: {error}.") from error
        return b""

    def identify(self, drive: int) -> None:
        """Raise `DeviceError` unless it is a CiA 402 drive with the cyclic mode and the motor of the spec."""
        spec = self._specs[drive]
        kind = self.read(drive, 0x1000)
        if kind & 0xFFFF != 402:
            raise DeviceError(
                f"node {spec.node} is no drive: its device type is {kind & 0xFFFF}, that of CiA 402 is 402."
            )
        self._modes[drive] = self.read(drive, 0x6502)
        if not self._modes[drive] >> (_CYCLIC - 1) & 1:
            has = [words for mode, words in _MODES.items() if self._modes[drive] >> (mode - 1) & 1]
            raise DeviceError(
                f"the drive at node {spec.node} has no {_MODES[_CYCLIC]} mode, which is needed;"
                f" it supports {', '.join(has) or 'none'} (object 0x6502 is 0x{self._modes[drive]:X})."
            )
        measured = self._read(drive, 0x6076, 0)
        if measured is None:
            self._note(drive, 0x6076, 0)
            return
        rated = 1e-6 * measured
        if not math.isclose(rated, spec.rated_torque, rel_tol=0.02):
            raise DeviceError(
                f"the drive at node {spec.node} says its motor's rated torque is {rated:.4g} N m, "
                "DriveSpec.rated_torque is"
                f" {spec.rated_torque:.4g} N m; tensions would be wrong by that ratio."
            )

    def set_mode(self, drive: int, mode: int) -> None:
        """Mode of operation, confirmed. Raises `DeviceError` where the drive does not have it."""
        node = self._specs[drive].node
        if not self._modes[drive] >> (mode - 1) & 1:
            raise DeviceError(
                f"the drive at node {node} has no {_MODES[mode]} mode (object 0x6502 is "
                f"0x{self._modes[drive]:08X})."
            )
        self.write(drive, 0x6060, 0, mode)
        if self.read(drive, 0x6061) != mode:
            raise DeviceError(
                f"the drive at node {node} does not change to its {_MODES[mode]} mode; is it moving?"
            )

    def limit(self, drive: int, limits: DriveLimits, rate: float) -> None:
        """Limits, units and what it does when the bus fails."""
        n = len(self._specs)

        def own(name: str) -> int:
            return limits.of(name, n)[drive]

        self.write(drive, 0x60A9, 0, _MILLI_RPM)
        fastest = self.speed(drive, own("velocity_limit"))
        self.offer(drive, 0x6080, 0, fastest)  # in every mode; what it held was in another unit
        self.offer(drive, 0x607F, 0, fastest)  # perhaps only in modes whose way the drive plans
        self.offer(drive, 0x6085, 0, self.acceleration(drive, own("deceleration")))
        self.offer(drive, 0x607D, 1, -own("position_limit"))
        self.offer(drive, 0x607D, 2, own("position_limit"))
        self.offer(drive, 0x6065, 0, own("following_error"))
        self._write(drive, 0x6066, 0, 0)
        self.offer(drive, 0x3001, 2, self.current(drive, own("torque_limit")))
        self.offer(drive, 0x605A, 0, 6 if limits.hold else 2)
        self.write(drive, 0x6007, 0, 3)  # connection lost: quick stop
        self.offer(drive, 0x60C2, 1, round(1e3 / rate))
        self._write(drive, 0x60C2, 2, -3)

    def map(self, drive: int) -> None:
        """Process data: what is exchanged with every SYNC. The node must be pre-operational."""
        node = self._specs[drive].node
        for mapping, entries in _MAPPING.items():
            communication = mapping - 0x200
            cob_id = {0x1600: COMMAND, 0x1A00: STATUS | _NO_RTR, 0x1A01: MOTION | _NO_RTR}[mapping] + node
            self.write(drive, communication, 1, cob_id | _INVALID)
            self.write(drive, communication, 2, 1)
            self.write(drive, mapping, 0, 0)
            for sub, entry in enumerate(entries, start=1):
                self.write(drive, mapping, sub, entry)
            self.write(drive, mapping, 0, len(entries))
            self.write(drive, communication, 1, cob_id)
        for index in _UNUSED:
            held = self._read(drive, index, 1)
            if held is not None:
                self.write(drive, index, 1, held | _INVALID | (_NO_RTR if index >= 0x1800 else 0))

    def watch(self, drive: int, on: bool) -> None:
        """Heartbeats of the drive, and the controller's watched by it, on or off."""
        self.write(drive, 0x1017, 0, round(1e3 * BEAT) if on else 0)
        self.write(drive, 0x1016, 1, (MASTER << 16 | round(1e3 * PATIENCE)) if on else 0)

    def speed(self, drive: int, counts: float) -> int:
        """Counts/s in the drive's unit of velocity."""
        return max(1, round(counts * 60_000.0 / self._specs[drive].counts_per_turn))

    def current(self, drive: int, torque: float) -> int:
        """Milliamperes of the motor that give thousandths of its rated torque."""
        spec = self._specs[drive]
        return max(1, round(torque * spec.rated_torque / spec.torque_constant))

    def acceleration(self, drive: int, counts: float) -> int:
        """Counts/s2 in the drive's unit of acceleration, rpm/s."""
        return max(1, round(counts * 60.0 / self._specs[drive].counts_per_turn))
