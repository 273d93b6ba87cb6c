"""Emulated drives as frames on the bus: what a real drive would answer, whoever asks."""

from __future__ import annotations

import itertools
import struct
import threading

import numpy as np
import pytest

from fastrod.errors import InputError
from fastrod.types import Floats
from fastrod_device.bus import open_bus
from fastrod_device.clock import SteppedClock, WallClock
from fastrod_device.dictionary import object_dictionary
from fastrod_device.errors import DeviceError
from fastrod_device.motor import Motor
from fastrod_device.nodes import EmulatedDrives
from fastrod_device.objects import Objects
from fastrod_device.units import DriveSpec

pytest.importorskip("canopen", reason="canopen is not installed: pip install 'fastrod[device]'")

SPEC = DriveSpec(node=5, drum_radius=0.008)
_names = itertools.count()


class Loose:
    """Tendons fastened to nothing."""

    def move(self, t: float, pulled: Floats) -> Floats:
        return np.zeros_like(pulled)


class Wire:
    """One emulated drive and a bare bus to talk to it."""

    def __init__(self, clock: SteppedClock | WallClock | None = None) -> None:
        name = f"virtual:nodes-{next(_names)}"
        self.clock = SteppedClock() if clock is None else clock
        self.bus = open_bus(name)
        self.nodes = EmulatedDrives([SPEC], name, clock=self.clock, tendons=Loose(), torque_noise=0.0)

    def send(self, cob_id: int, data: bytes = b"") -> None:
        import can

        self.bus.send(can.Message(arbitration_id=cob_id, is_extended_id=False, data=data))

    def hear(self, cob_id: int, timeout: float = 1.0) -> bytes:
        """The next frame of this COB-ID; empty where none comes."""
        import time

        end = time.monotonic() + timeout
        while (left := end - time.monotonic()) > 0.0:
            message = self.bus.recv(left)
            if message is not None and message.arbitration_id == cob_id:
                return bytes(message.data)
        return b""

    def ask(self, index: int, sub: int = 0) -> bytes:
        self.send(0x605, struct.pack("<BHB4x", 0x40, index, sub))
        return self.hear(0x585)

    def write(self, index: int, sub: int, value: int, size: int) -> int:
        """Abort code of an expedited download, 0 where it was taken."""
        self.send(0x605, struct.pack("<BHBI", 0x23 | (4 - size) << 2, index, sub, value & 0xFFFFFFFF))
        answer = self.hear(0x585)
        return struct.unpack_from("<I", answer, 4)[0] if answer[0] == 0x80 else 0

    def sync(self, dt: float = 0.01) -> None:
        assert isinstance(self.clock, SteppedClock)
        self.clock.sleep_until(self.clock.now() + dt)
        self.send(0x80)

    def map(self, kind: int = 1) -> None:
        """Controlword and target in, statusword and position out; operational."""
        for communication, cob_id, entries in (
            (0x1400, 0x205, (0x60400010, 0x607A0020)),
            (0x1800, 0x40000185, (0x60410010, 0x60640020)),
        ):
            assert self.write(communication, 1, cob_id | 0x80000000, 4) == 0
            assert self.write(communication, 2, kind, 1) == 0
            assert self.write(communication + 0x200, 0, 0, 1) == 0
            for sub, entry in enumerate(entries, start=1):
                assert self.write(communication + 0x200, sub, entry, 4) == 0
            assert self.write(communication + 0x200, 0, len(entries), 1) == 0
            assert self.write(communication, 1, cob_id, 4) == 0
        self.send(0, bytes([1, 5]))

    def cycle(self, word: int, target: int = 0) -> tuple[int, int]:
        self.send(0x205, struct.pack("<Hi", word, target))
        self.sync()
        status, position = struct.unpack("<Hi", self.hear(0x185))
        return status, position

    def enable(self) -> None:
        assert self.write(0x6060, 0, 8, 1) == 0
        for word in (0x06, 0x07, 0x0F):
            status, _ = self.cycle(word)
        assert status & 0x6F == 0x27

    def __enter__(self) -> Wire:
        return self

    def __exit__(self, *_: object) -> None:
        self.nodes.close()
        self.bus.shutdown()


@pytest.fixture
def wire():
    with Wire() as made:
        yield made


def test_it_says_that_it_has_booted(wire):
    assert wire.hear(0x705) == b"\x00"


def test_it_says_who_it_is(wire):
    assert struct.unpack_from("<I", wire.ask(0x1000), 4)[0] & 0xFFFF == 402
    assert struct.unpack_from("<I", wire.ask(0x6502), 4)[0] >> 7 & 1  # cyclic synchronous position
    assert struct.unpack_from("<I", wire.ask(0x6076), 4)[0] == 54_000  # rated torque [uN m]
    assert wire.nodes.sdo_served == 3


@pytest.mark.parametrize(
    ("index", "sub", "value", "size", "abort"),
    [
        (0x5FFF, 0, 1, 4, 0x06020000),  # no such object
        (0x607D, 9, 1, 4, 0x06090011),  # no such subindex
        (0x6041, 0, 1, 2, 0x06010002),  # read only
        (0x6040, 0, 1, 4, 0x06070010),  # another length
        (0x6072, 0, 1000, 2, 0x06020000),  # an EPOS4 limits the current instead
        (0x3001, 2, 1000, 4, 0),
        (0x3001, 2, 1000, 2, 0x06070010),  # [mA], 32 bits
        (0x6080, 0, 1000, 4, 0),
        (0x605D, 0, 1, 2, 0x06020000),
        (0x6073, 0, 1000, 2, 0x06020000),
        (0x6075, 0, 1000, 4, 0x06020000),
        (0x607C, 0, 0, 4, 0x06020000),
        (0x1005, 0, 0x81, 4, 0x06010002),  # a constant
        (0x1014, 0, 0x86, 4, 0x06010002),
        (0x30D1, 1, 0, 4, 0x06010002),
        (0x30D2, 1, 0, 2, 0x06010002),
        (0x607A, 1, 0, 4, 0x06090011),  # it has no subindices
        (0x60E4, 4, 0, 4, 0x06090011),  # an array of three
        (0x6060, 0, 4, 1, 0x06090030),  # no such mode
        (0x1A00, 1, 0x60410010, 4, 0),  # while the PDO is invalid
        (0x1A00, 1, 0x60400010 + 1, 4, 0x06040041),  # another length than the object's
        (0x1A00, 1, 0x60760020, 4, 0x06040041),  # cannot be mapped
        (0x1600, 1, 0x60410010, 4, 0x06040041),  # read only into an RPDO
        (0x1800, 2, 250, 1, 0x06090030),  # reserved transmission type
        (0x1800, 1, 0x185, 4, 0x06090030),  # a TPDO that could be asked for by RTR, existing
        (0x1801, 1, 0x80000285, 4, 0x06090030),  # and invalid
        (0x1801, 1, 0xC0000285, 4, 0),
        (0x1400, 1, 0x205, 4, 0),  # an RPDO has no such bit
    ],
)
def test_sdo_refuses_what_cannot_be(wire, index, sub, value, size, abort):
    assert wire.write(0x1400, 1, 0x80000205, 4) == wire.write(0x1800, 1, 0xC0000185, 4) == 0
    assert wire.write(0x1600, 0, 0, 1) == wire.write(0x1A00, 0, 0, 1) == 0
    assert wire.write(index, sub, value, size) == abort


def test_a_mapping_is_refused_while_its_pdo_exists_and_when_it_is_too_long(wire):
    assert wire.write(0x1A00, 0, 0, 1) == 0x08000022
    assert wire.write(0x1800, 1, 0xC0000185, 4) == wire.write(0x1A00, 0, 0, 1) == 0
    for sub in (1, 2, 3):
        assert wire.write(0x1A00, sub, 0x60640020, 4) == 0
    assert wire.write(0x1A00, 0, 3, 1) == 0x06040042  # 12 bytes
    assert wire.write(0x1A00, 0, 2, 1) == 0
    assert wire.write(0x1800, 1, 0x40000185, 4) == 0
    assert wire.write(0x1A00, 0, 0, 1) == 0x08000022


def test_process_data_is_laid_out_as_mapped(wire):
    wire.map()
    assert wire.cycle(0x00) == (0x0250, 0)
    wire.enable()
    for k in range(20):
        _, position = wire.cycle(0x0F, 50 * k)
    assert 800 < position <= 950


def test_nothing_is_sent_before_it_is_operational(wire):
    wire.map()
    wire.send(0, bytes([128, 5]))
    wire.sync()
    assert wire.hear(0x185, 0.05) == b""


def test_every_third_sync_where_that_was_asked(wire):
    wire.map(kind=3)
    heard = 0
    for _ in range(9):
        wire.sync()
        heard += wire.hear(0x185, 0.02) != b""
    assert heard == 3


@pytest.mark.parametrize(
    ("words", "ends"),
    [
        ((0x0F,), 0x40),  # not from "switch on disabled"
        ((0x06,), 0x21),
        ((0x06, 0x07), 0x23),
        ((0x06, 0x0F), 0x27),  # at once
        ((0x06, 0x07, 0x0F, 0x07), 0x23),
        ((0x06, 0x07, 0x0F, 0x06), 0x21),
        ((0x06, 0x07, 0x0F, 0x00), 0x40),
        ((0x06, 0x02), 0x40),
        ((0x06, 0x80), 0x40),
    ],
)
def test_transitions_of_cia_402(words, ends):
    motor = Motor(SPEC, Objects(object_dictionary(), 5))
    for word in words:
        motor.control(word)
    mask = 0x4F if ends == 0x40 else 0x6F
    assert motor.statusword() & mask == ends


@pytest.mark.parametrize(("option", "after"), [(2, "switch on disabled"), (6, "operation enabled")])
def test_only_a_drive_that_holds_after_a_quick_stop_goes_on_from_it(option, after):
    motor = Motor(SPEC, Objects(object_dictionary(), 5))
    motor.objects.values[(0x605A, 0)] = option
    for word in (0x06, 0x0F, 0x02):
        motor.control(word)
    motor.advance(0.01)
    motor.control(0x0F)
    assert motor.state == after


@pytest.mark.parametrize("way", [1, -1])
def test_a_motor_pulls_no_harder_than_its_greatest_torque(way):
    def pulled(most: int) -> Motor:
        motor = Motor(SPEC, Objects(object_dictionary(), 5))
        motor.objects.values[(0x3001, 2)] = round(most * SPEC.rated_torque / SPEC.torque_constant)  # mA
        for word in (0x06, 0x0F):
            motor.control(word)
        motor.written((0x6060, 0), 8)
        for k in range(60):
            motor.written((0x607A, 0), way * 20 * k)
            motor.setpoint()
            motor.advance(0.01)
            motor.torque = 0.5 * motor.x  # a tendon as a spring
        return motor

    free, held = pulled(3000), pulled(200)
    assert free.reported_torque() == pytest.approx(way * 0.5 * 20 * 59, abs=12)
    assert held.reported_torque() == way * 200
    assert 400 <= way * held.x < 425  # 200 / 0.5, and one step until the torque is known
    assert way * held.following_error() > 700
    held.written((0x607A, 0), 0)
    for _ in range(20):  # the other way it goes
        held.setpoint()
        held.advance(0.01)
        held.torque = 0.5 * held.x
    assert abs(held.x) < 1.0


def test_a_fault_is_reset_by_the_edge_of_bit_7_only():
    motor = Motor(SPEC, Objects(object_dictionary(), 5))
    for word in (0x06, 0x0F, 0x8F):  # bit 7 is set already when the fault comes
        motor.control(word)
    motor.fault(0x2310)
    motor.control(0x8F)
    assert motor.state == "fault"
    motor.control(0x00)
    motor.control(0x80)
    assert motor.state == "switch on disabled"
    assert motor.emergencies == [(0x2310, 0x03), (0, 0)]


def test_currents_are_in_milliamperes_and_torques_in_thousandths_of_the_rated_one(wire):
    wire.map()
    wire.enable()
    wire.nodes._nodes[0].motor.torque = 400.0
    # 0.4 x 54 mN m / 25.1 mN m/A
    assert wire.ask(0x30D1, 1)[:1] + wire.ask(0x30D1, 1)[4:] == b"\x43" + struct.pack("<i", 861)
    assert wire.ask(0x30D2, 1)[:1] + wire.ask(0x30D2, 1)[4:6] == b"\x4b" + struct.pack("<h", 400)
    assert struct.unpack_from("<I", wire.ask(0x3001, 1), 4)[0] == 2151
    assert struct.unpack_from("<I", wire.ask(0x3001, 5), 4)[0] == 25_100


@pytest.mark.parametrize(("mode", "fastest"), [(8, 20_000), (1, 10_000)])
def test_the_motors_speed_is_limited_in_every_mode_the_profiles_where_the_drive_plans(mode, fastest):
    motor = Motor(SPEC, Objects(object_dictionary(), 5))
    per_rpm = SPEC.counts_per_turn / 60
    motor.objects.values |= {(0x6080, 0): round(20_000 / per_rpm), (0x607F, 0): round(10_000 / per_rpm)}
    motor.objects.values |= {(0x6081, 0): 50_000, (0x6065, 0): 0xFFFFFFFF}
    motor.written((0x6060, 0), mode)
    for word in (0x06, 0x0F):
        motor.control(word)
    motor.written((0x607A, 0), 100_000)
    motor.control(0x1F)
    motor.setpoint()
    motor.advance(0.2)
    assert motor.v == pytest.approx(fastest, rel=0.01)


LACKED = [0x1003, 0x1016, 0x1017, 0x3001, 0x605A, 0x6065, 0x6066, 0x607D, 0x607F, 0x6080, 0x6081, 0x6085]


@pytest.mark.parametrize("index", [*LACKED, 0x60A9, 0x60C2, 0x6502])
def test_a_motor_runs_without_an_object_that_its_drive_lacks(wire, index):
    wire.nodes.drop(0, index)
    wire.map()
    wire.enable()
    for k in range(20):
        status, position = wire.cycle(0x0F, 20 * k)
    assert (status & 0x6F, position > 200) == (0x27, True)
    wire.nodes.emergency(0, 0x2310)
    wire.sync()
    assert struct.unpack_from("<H", wire.hear(0x085))[0] == 0x2310
    assert struct.unpack_from("<I", wire.ask(index), 4)[0] == 0x06020000


def test_what_can_only_be_written_is_not_read(wire):
    assert struct.unpack_from("<I", wire.ask(0x1F50, 1), 4)[0] == 0x06010001


def test_process_data_mapped_by_sdo_counts_at_once(wire):
    wire.map()
    assert wire.cycle(0x00) == (0x0250, 0)
    assert wire.write(0x1800, 1, 0xC0000185, 4) == 0  # away with it, while it is operational
    wire.sync()
    assert wire.hear(0x185, 0.05) == b""
    assert wire.write(0x1A00, 0, 0, 1) == wire.write(0x1A00, 1, 0x60640020, 4) == 0
    assert wire.write(0x1A00, 0, 1, 1) == 0
    assert wire.write(0x1800, 1, 0x40000185, 4) == 0
    wire.sync()
    assert wire.hear(0x185) == bytes(4)
    assert wire.write(0x1400, 1, 0x80000205, 4) == 0
    wire.send(0x205, struct.pack("<Hi", 0x06, 0))
    wire.sync()
    assert wire.nodes.states == ("switch on disabled",)


@pytest.mark.parametrize("cob_id", [0x000, 0x080, 0x205, 0x605, 0x77F, 0x705])
@pytest.mark.parametrize("length", range(9))
def test_frames_of_any_length_harm_nothing(wire, cob_id, length):
    wire.map()
    wire.enable()
    wire.send(cob_id, bytes([0x81, 0x05, 0x60, 0x00, 0xFF, 0xFF, 0xFF, 0xFF][:length]))
    assert struct.unpack_from("<I", wire.ask(0x6502), 4)[0] == 0x3A5
    assert wire.nodes._wrong is None


def test_without_heartbeats_it_stops_at_the_moment_it_must(wire):
    wire.map()
    assert wire.write(0x6007, 0, 3, 2) == 0
    assert wire.write(0x605A, 0, 6, 2) == 0
    assert wire.write(0x1016, 1, 127 << 16 | 150, 4) == 0
    assert wire.write(0x60C2, 1, 10, 1) == 0  # ms: the shaft turns all the time
    wire.send(0x77F, b"\x05")
    wire.enable()
    for k in range(12):
        wire.cycle(0x0F, 100 * k)
    assert wire.nodes.moving.all()
    wire.clock.sleep_until(wire.clock.now() + 0.3)
    wire.sync(0.0)
    assert struct.unpack_from("<HB", wire.hear(0x085)) == (0x8130, 0x11)
    assert wire.nodes.states == ("quick stop active",)
    assert not wire.nodes.moving.any()
    # the heartbeat came at 0; the ramp from 10,000 counts/s by 10,000 rpm/s = 682,667 counts/s2 takes 15 ms;
    # the shaft lags by some ms
    assert 0.165 < wire.nodes.stopped_at[0] < 0.19


def test_a_target_beyond_the_software_limit_is_clipped(wire):
    wire.map()
    assert wire.write(0x607D, 1, -100, 4) == 0
    assert wire.write(0x607D, 2, 100, 4) == 0
    wire.enable()
    for _ in range(10):
        status, position = wire.cycle(0x0F, 1000)
    assert position == 100
    assert status & 0x0800


def test_a_set_point_that_does_not_come_is_counted(wire):
    wire.map()
    wire.enable()
    for _ in range(3):
        wire.sync()
        wire.hear(0x185)
    assert wire.nodes.missed_setpoints == 3


def test_a_short_rpdo_is_an_emergency_and_changes_nothing(wire):
    wire.map()
    wire.enable()
    wire.send(0x205, b"\x00\x00")
    wire.sync()
    assert struct.unpack_from("<H", wire.hear(0x085))[0] == 0x8210
    assert wire.nodes.states == ("operation enabled",)


def test_a_reboot_forgets_its_mapping_and_may_keep_its_counter(wire):
    wire.map()
    wire.enable()
    for k in range(10):
        wire.cycle(0x0F, 10 * k)
    wire.nodes.reboot(0, keep_position=True)
    assert wire.hear(0x705) == b"\x00"
    assert struct.unpack_from("<i", wire.ask(0x6064), 4)[0] > 50
    wire.nodes.reboot(0)
    assert struct.unpack_from("<i", wire.ask(0x6064), 4)[0] == 0
    wire.send(0, bytes([1, 5]))
    wire.sync()
    assert wire.hear(0x185, 0.05) == b""
    assert wire.nodes.true_pulled[0] > 50 * SPEC.metres_per_count


@pytest.mark.real_time
def test_in_real_time_heartbeats_come_without_sync():
    with Wire(WallClock()) as wire:
        assert wire.hear(0x705) == b"\x00"
        assert wire.write(0x1017, 0, 20, 2) == 0
        assert [wire.hear(0x705) for _ in range(3)] == [b"\x7f"] * 3


def test_a_request_is_deaf_ears_while_the_bus_is_off(wire):
    wire.nodes.bus_off()
    wire.send(0x605, struct.pack("<BHB4x", 0x40, 0x1000, 0))
    assert wire.hear(0x585, 0.05) == b""
    wire.nodes.restore()
    assert len(wire.ask(0x1000)) == 8


def test_wires_that_fail_are_told_when_it_is_closed():
    class Broken:
        def move(self, t: float, pulled: Floats) -> Floats:
            raise RuntimeError("the rod snapped")

    name = f"virtual:nodes-{next(_names)}"
    bus, clock = open_bus(name), SteppedClock()
    nodes = EmulatedDrives([SPEC], name, clock=clock, tendons=Broken())
    import can

    clock.sleep_until(0.1)
    bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
    for _ in range(100):
        if nodes._wrong is not None:
            break
        threading.Event().wait(0.01)
    with pytest.raises(DeviceError, match="RuntimeError: the rod snapped"):
        nodes.close()
    bus.shutdown()


def test_bad_input():
    with pytest.raises(InputError, match="rate is 0"):
        EmulatedDrives([SPEC], "virtual:none", clock=SteppedClock(), tendons=Loose(), rate=0)
    with pytest.raises(InputError, match="each once"):
        EmulatedDrives([SPEC, SPEC], "virtual:none", clock=SteppedClock(), tendons=Loose())
    with Wire() as wire, pytest.raises(InputError, match="there is no drive 1"):
        wire.nodes.block(1)


def test_serve_returns_when_it_is_told_to():
    stop = threading.Event()
    with Wire() as wire:
        thread = threading.Thread(target=wire.nodes.serve, args=(stop,))
        thread.start()
        assert thread.is_alive()
        stop.set()
        thread.join(2.0)
        assert not thread.is_alive()
