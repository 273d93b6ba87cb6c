"""Packets of Dynamixel's protocol 2.0, and the serial port that carries them.

Written from the public specification (ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0"). `dynamixel-sdk` 4.1.0 is
no base for a control loop: its txPacket sends a header inside the data as it is, unstuffed (-131073 counts
end in FF FF FD), a sync read ends at the first silent drive, and it waits for answers without sleeping."""

from __future__ import annotations

import threading
from typing import Any, NamedTuple, Protocol, final

from fastrod_device.can.bus import guest
from fastrod_device.errors import DeviceError

PING, READ, WRITE, REBOOT, STATUS, SYNC_READ, SYNC_WRITE = 0x01, 0x02, 0x03, 0x08, 0x55, 0x82, 0x83
"""Instructions; `STATUS` is an answer."""
EVERYBODY = 0xFE
"""Id of a broadcast."""
_HEADER, _RESERVED = b"\xff\xff\xfd", b"\x00"
_OVERHEAD = 7  # bytes before the instruction: header, reserved, id, length


def _table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
        table.append(crc)
    return tuple(table)


_CRC = _table()


def crc16(data: bytes) -> int:
    """CRC-16 of the polynomial 0x8005, from 0.

    >>> hex(crc16(bytes.fromhex("FF FF FD 00 01 03 00 01")))
    '0x4e19'
    """
    crc = 0
    for byte in data:
        crc = (crc << 8 ^ _CRC[(crc >> 8 ^ byte) & 0xFF]) & 0xFFFF
    return crc


class Packet(NamedTuple):
    """An instruction, or an answer, whose first byte of data is its error."""

    node: int
    instruction: int
    data: bytes = b""

    def encoded(self) -> bytes:
        """Return the packet's bytes on the line.

        >>> Packet(1, PING).encoded().hex(" ")
        'ff ff fd 00 01 03 00 01 19 4e'
        """
        body = (bytes([self.instruction]) + self.data).replace(_HEADER, _HEADER + b"\xfd")
        head = _HEADER + _RESERVED + bytes([self.node]) + (len(body) + 2).to_bytes(2, "little")
        return head + body + crc16(head + body).to_bytes(2, "little")


@final
class PacketReader:
    """Finds packets in bytes as they come; what is damaged is passed over."""

    def __init__(self) -> None:
        self._held = bytearray()

    def take(self, data: bytes) -> list[Packet]:
        """The packets that these bytes complete."""
        self._held += data
        found = []
        while (start := self._held.find(_HEADER + _RESERVED)) >= 0:
            del self._held[:start]
            if len(self._held) < _OVERHEAD:
                break
            end = _OVERHEAD + int.from_bytes(self._held[5:7], "little")
            if len(self._held) < end:
                break
            whole = bytes(self._held[:end])
            if end < _OVERHEAD + 3 or crc16(whole[:-2]) != int.from_bytes(whole[-2:], "little"):
                del self._held[: len(_HEADER)]
                continue
            body = whole[_OVERHEAD:-2].replace(_HEADER + b"\xfd", _HEADER)
            found.append(Packet(whole[4], body[0], body[1:]))
            del self._held[:end]
        return found


class SerialPort(Protocol):
    """A line of bytes."""

    def write(self, data: bytes) -> None:
        """Send. Raises `OSError` where the port is gone."""

    def read(self, timeout: float) -> bytes:
        """Return what has come, waited for so long [s]; empty where nothing has. Raises `OSError`."""

    def close(self) -> None:
        """Let go of it."""


_VIRTUAL: dict[str, SerialPort] = {}
_VIRTUAL_LOCK = threading.Lock()


def offer(name: str, port: SerialPort | None) -> None:
    """Make `port` what `virtual:NAME` opens in this process; None: nothing any more."""
    with _VIRTUAL_LOCK:
        if port is None:
            _VIRTUAL.pop(name, None)
        else:
            _VIRTUAL[name] = port


def open_port(name: str, bitrate: int) -> SerialPort:
    """A port by name: a serial device ("/dev/ttyUSB0", "COM3"), or `virtual:NAME` of this process. Raises
    `DeviceError`."""
    if name.startswith("virtual:"):
        if (port := _VIRTUAL.get(name)) is None:
            raise DeviceError(f"there is no port {name!r} in this process; start its emulator first.")
        return port
    serial = guest("serial", "a serial port")
    try:
        return _Device(serial.Serial(name, bitrate, timeout=0.0, write_timeout=0.1))
    except (OSError, ValueError) as error:
        raise DeviceError(
            f"the serial port {name!r} cannot be opened: {str(error).rstrip('.')}. Is the adapter plugged in?"
        ) from error


@final
class _Device:
    """A serial device, by pyserial."""

    def __init__(self, serial: Any) -> None:
        self._serial = serial

    def write(self, data: bytes) -> None:
        self._serial.write(data)

    def read(self, timeout: float) -> bytes:
        # what has come at once, else one byte as soon as it does: pyserial waits asleep
        if not self._serial.in_waiting:
            self._serial.timeout = max(timeout, 0.0)
            if not (first := self._serial.read(1)):
                return b""
            return bytes(first) + bytes(self._serial.read(self._serial.in_waiting))
        return bytes(self._serial.read(self._serial.in_waiting))

    def close(self) -> None:
        self._serial.close()
