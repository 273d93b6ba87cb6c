"""A line of Dynamixel servos: the control table of the X series (ROBOTIS e-Manual, XM430-W350), and questions
and answers about it."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Mapping
from typing import NamedTuple, final

from fastrod_device.dynamixel.packets import (
    EVERYBODY,
    READ,
    STATUS,
    SYNC_READ,
    SYNC_WRITE,
    WRITE,
    Packet,
    PacketReader,
    SerialPort,
)
from fastrod_device.errors import DeviceError


class Register(NamedTuple):
    """A number of the control table."""

    address: int
    size: int


OPERATING_MODE, CURRENT_LIMIT, TORQUE_ENABLE = Register(11, 1), Register(38, 2), Register(64, 1)
HARDWARE_ERROR, BUS_WATCHDOG, GOAL_CURRENT = Register(70, 1), Register(98, 1), Register(102, 2)
PROFILE_ACCELERATION, PROFILE_VELOCITY = Register(108, 4), Register(112, 4)
GOAL_POSITION, PRESENT_CURRENT = Register(116, 4), Register(126, 2)
PRESENT_VELOCITY, PRESENT_POSITION = Register(128, 4), Register(132, 4)
INDIRECT_ADDRESS, INDIRECT_DATA = 168, 224
READ_BACK = (TORQUE_ENABLE, HARDWARE_ERROR, BUS_WATCHDOG, PRESENT_CURRENT, PRESENT_VELOCITY, PRESENT_POSITION)
"""Contents of the indirect data, one after another: one sync read brings all of it."""
CURRENT_POSITION_MODE, WATCHDOG_TRIPPED = 5, 0xFF
CURRENT_UNIT = 2.69e-3  # A
VELOCITY_UNIT = 0.229 / 60.0 * 4096  # counts/s
REVOLUTION = 4096
"""Counts of a turn; a reboot forgets whole ones."""
_ERRORS = {
    1: "it could not be done",
    2: "it does not know the instruction",
    3: "the packet came damaged",
    4: "the value is out of range",
    5: "the data have a wrong length",
    6: "the value is beyond a limit",
    7: "the register cannot be written now",
}
_PATIENCE, _TRIES = 0.05, 3  # s for a question while setting up, which is repeated


class ServoReport(NamedTuple):
    """Report of one servo in a cycle: `READ_BACK`, in its units."""

    torque_enabled: int = 0
    error: int = 0
    watchdog: int = 0
    current: int = 0
    velocity: int = 0
    position: int = 0


_REPORT = struct.Struct("<BBBhii")


@final
class ServoLine:
    """Servos on a port, one conversation at a time. What cannot be sent is an `OSError` in `reports` and
    `aim`, which a cycle calls, and a `DeviceError` elsewhere."""

    def __init__(self, port: SerialPort) -> None:
        self.port = port
        self.lock = threading.RLock()
        """Held over a question and its answers."""

    def request(self, node: int, instruction: int, data: bytes, what: str) -> bytes:
        """The data of a servo's answer to what it is to do. Raises `DeviceError` where it is silent or
        refuses."""
        for _ in range(_TRIES):
            try:
                answer = self._answers(Packet(node, instruction, data), (node,), _PATIENCE).get(node)
            except OSError as error:
                raise DeviceError(f"the serial port carries nothing: {error}.") from error
            if answer is None or answer[0] & 0x7F == 3:  # damaged on the way: once more
                continue
            if error_number := answer[0] & 0x7F:
                why = _ERRORS.get(error_number, f"error {error_number}")
                raise DeviceError(f"the servo {node} was to {what}, but {why}.")
            return answer[1:]
        raise DeviceError(
            f"the servo {node} does not answer; it was to {what}. Are its id and bitrate right?"
        )

    def write(self, node: int, register: Register, value: int) -> None:
        """Set a number of one servo. Raises `DeviceError`."""
        data = struct.pack("<H", register.address) + value.to_bytes(register.size, "little", signed=value < 0)
        self.request(node, WRITE, data, f"take {value} in register {register.address}")

    def read(self, node: int, register: Register) -> int:
        """A number of one servo. Raises `DeviceError`."""
        data = self.request(node, READ, struct.pack("<HH", *register), f"report register {register.address}")
        if len(data) != register.size:
            raise DeviceError(f"the servo {node} answers register {register.address} with {len(data)} bytes.")
        return int.from_bytes(data, "little", signed=register in (PRESENT_POSITION, PRESENT_VELOCITY))

    def reports(self, nodes: tuple[int, ...], patience: float) -> dict[int, ServoReport]:
        """Return what these servos report, waited for so long [s]; one that is silent is missing. Raises
        `OSError`."""
        data = struct.pack("<HH", INDIRECT_DATA, _REPORT.size) + bytes(nodes)
        answers = self._answers(Packet(EVERYBODY, SYNC_READ, data), nodes, patience)
        size = _REPORT.size + 1
        return {node: ServoReport(*_REPORT.unpack(a[1:])) for node, a in answers.items() if len(a) == size}

    def aim(self, targets: Mapping[int, int], wait: float = -1.0) -> None:
        """Targets of servos by id [counts]; at once after `wait` [s], even amid a conversation. Raises
        `OSError`."""
        goals = b"".join(struct.pack("<Bi", node, target) for node, target in targets.items())
        packet = Packet(EVERYBODY, SYNC_WRITE, struct.pack("<HH", *GOAL_POSITION) + goals)
        held = self.lock.acquire(timeout=wait)
        try:
            self.port.write(packet.encoded())
        finally:
            if held:
                self.lock.release()

    def _answers(self, question: Packet, nodes: tuple[int, ...], patience: float) -> dict[int, bytes]:
        """Error and data that each of these nodes answers."""
        answers: dict[int, bytes] = {}
        with self.lock:
            reader = PacketReader()
            while self.port.read(0.0):  # what came too late for the question before
                pass
            self.port.write(question.encoded())
            end = time.monotonic() + patience
            while len(answers) < len(nodes):
                data = self.port.read(max(end - time.monotonic(), 0.0))
                for packet in reader.take(data):
                    if packet.instruction == STATUS and packet.node in nodes and packet.data:
                        answers[packet.node] = packet.data
                if not data and time.monotonic() >= end:
                    break
        return answers
