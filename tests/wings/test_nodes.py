"""Emulated drives as frames on the bus: what a real drive would answer, whoever asks."""

import struct
import threading
import time

import pytest
from benches import Springs, own_bus

from fastrod_device.can.bus import open_bus
from fastrod_device.can.clock import SteppedClock, WallClock
from fastrod_device.can.dictionary import object_dictionary
from fastrod_device.emulator.motor import Motor
from fastrod_device.emulator.nodes import EmulatedDrives
from fastrod_device.emulator.objects import Objects
from fastrod_device.errors import DeviceError
from fastrod_device.units import DriveSpec

pytest.importorskip("canopen", reason="canopen is not installed: pip install 'fastrod[device]'")

SPEC = DriveSpec(node=5, drum_radius=0.008)


class Line:
    """One emulated drive and a bare bus to talk to it."""

    def __init__(self, clock=None):
        name, self.clock = own_bus(), SteppedClock() if clock is None else clock
        self.bus, self.mapped = open_bus(name), False
        self.nodes = EmulatedDrives([SPEC], name, clock=self.clock, tendons=Springs(), torque_noise=0.0)

    def send(self, cob_id, data=b""):
        import can

        self.bus.send(can.Message(arbitration_id=cob_id, is_extended_id=False, data=data))

    def hear(self, cob_id, timeout=1.0):
        """The next frame of this COB-ID; empty where none comes."""
        end = time.monotonic() + timeout
        while (left := end - time.monotonic()) > 0.0:
            message = self.bus.recv(left)
            if message is not None and message.arbitration_id == cob_id:
                return bytes(message.data)
        return b""

    def upload(self, index, sub=0):
        """The answer of an expedited upload, eight bytes."""
        self.send(0x605, struct.pack("<BHB4x", 0x40, index, sub))
        return self.hear(0x585)

    def read(self, index, sub=0, kind="<I"):
        """The value of an object, or the abort code."""
        return struct.unpack_from(kind, self.upload(index, sub), 4)[0]

    def emergency(self):
        """The error code of the next emergency."""
        return struct.unpack_from("<H", self.hear(0x085))[0]

    def write(self, index, sub, value, size):
        """Abort code of an expedited download, 0 where it was taken."""
        self.send(0x605, struct.pack("<BHBI", 0x23 | (4 - size) << 2, index, sub, value & 0xFFFFFFFF))
        answer = self.hear(0x585)
        return struct.unpack_from("<I", answer, 4)[0] if answer[0] == 0x80 else 0

    def takes(self, *rows):
        for row in rows:
            assert self.write(*row) == 0

    def sync(self, dt=0.01):
        self.clock.sleep_until(self.clock.now() + dt)
        self.send(0x80)

    def map(self, kind=1):
        """Controlword and target in, statusword and position out; operational."""
        rows = (0x1400, 0x205, 0x60400010, 0x607A0020), (0x1800, 0x40000185, 0x60410010, 0x60640020)
        for pdo, cob_id, *entries in rows:
            written = [(pdo, 1, cob_id | 0x80000000, 4), (pdo, 2, kind, 1), (pdo + 0x200, 0, 0, 1)]
            written += [(pdo + 0x200, sub, entry, 4) for sub, entry in enumerate(entries, start=1)]
            self.takes(*written, (pdo + 0x200, 0, len(entries), 1), (pdo, 1, cob_id, 4))
        self.send(0, bytes([1, 5]))
        self.mapped = True

    def cycle(self, word, target=0):
        self.send(0x205, struct.pack("<Hi", word, target))
        self.sync()
        status, position = struct.unpack("<Hi", self.hear(0x185))
        return status, position

    def enable(self):
        """See `map`, where that was not done, and enabled."""
        if not self.mapped:
            self.map()
        self.takes((0x6060, 0, 8, 1))
        for word in (0x06, 0x07, 0x0F):
            status, _ = self.cycle(word)
        assert status & 0x6F == 0x27

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.nodes.close()
        self.bus.shutdown()


@pytest.fixture
def line():
    with Line() as made:
        yield made


def motor(*words):
    """Its drive went through these controlwords."""
    made = Motor(SPEC, Objects(object_dictionary(), 5))
    for word in words:
        made.control(word)
    return made


def test_it_says_that_it_has_booted_and_who_it_is(line):
    assert line.hear(0x705) == b"\x00"
    assert line.read(0x1000) & 0xFFFF == 402
    assert line.read(0x6502) >> 7 & 1  # cyclic synchronous position
    assert line.read(0x6076) == 54_000  # rated torque [uN m]
    assert line.nodes.sdo_served == 3


SDO = [  # abort code, why, and writes of (index, sub, value, size)
    (0, "is taken", (0x3001, 2, 1000, 4), (0x6080, 0, 1000, 4)),
    (0, "while the PDO is invalid", (0x1A00, 1, 0x60410010, 4)),
    (0, "bit of RTR", (0x1801, 1, 0xC0000285, 4), (0x1400, 1, 0x205, 4)),  # an RPDO has no such bit
    (0x06020000, "no such object", (0x5FFF, 0, 1, 4), (0x605D, 0, 1, 2), (0x6073, 0, 1000, 2)),
    (0x06020000, "no such object", (0x6075, 0, 1000, 4), (0x607C, 0, 0, 4)),
    (0x06020000, "an EPOS4 limits the current instead", (0x6072, 0, 1000, 2)),
    (0x06090011, "no such subindex", (0x607D, 9, 1, 4), (0x607A, 1, 0, 4), (0x60E4, 4, 0, 4)),
    (0x06010002, "read only", (0x6041, 0, 1, 2), (0x30D1, 1, 0, 4), (0x30D2, 1, 0, 2)),
    (0x06010002, "a constant", (0x1005, 0, 0x81, 4), (0x1014, 0, 0x86, 4)),
    (0x06070010, "another length", (0x6040, 0, 1, 4), (0x3001, 2, 1000, 2)),  # [mA] has 32 bits
    (0x06090030, "no such mode", (0x6060, 0, 4, 1)),
    (0x06090030, "reserved transmission type", (0x1800, 2, 250, 1)),
    (0x06090030, "TPDO read by RTR, existing or invalid", (0x1800, 1, 0x185, 4), (0x1801, 1, 0x80000285, 4)),
    (0x06040041, "another length than the object's", (0x1A00, 1, 0x60400010 + 1, 4)),
    (0x06040041, "cannot be mapped", (0x1A00, 1, 0x60760020, 4)),
    (0x06040041, "read only into an RPDO", (0x1600, 1, 0x60410010, 4)),
]


@pytest.mark.parametrize(
    ("row", "abort"),
    [pytest.param(row, code, id=f"{row[0]:X} {why}") for code, why, *rows in SDO for row in rows],
)
def test_sdo_refuses_what_cannot_be(line, row, abort):
    line.takes((0x1400, 1, 0x80000205, 4), (0x1800, 1, 0xC0000185, 4), (0x1600, 0, 0, 1), (0x1A00, 0, 0, 1))
    assert line.write(*row) == abort


def test_a_mapping_is_refused_while_its_pdo_exists_and_when_it_is_too_long(line):
    assert line.write(0x1A00, 0, 0, 1) == 0x08000022
    line.takes((0x1800, 1, 0xC0000185, 4), (0x1A00, 0, 0, 1))
    line.takes(*((0x1A00, sub, 0x60640020, 4) for sub in (1, 2, 3)))
    assert line.write(0x1A00, 0, 3, 1) == 0x06040042  # 12 bytes
    line.takes((0x1A00, 0, 2, 1), (0x1800, 1, 0x40000185, 4))
    assert line.write(0x1A00, 0, 0, 1) == 0x08000022


def test_process_data_is_laid_out_as_mapped(line):
    line.map()
    assert line.cycle(0x00) == (0x0250, 0)
    line.enable()
    for k in range(20):
        _, position = line.cycle(0x0F, 50 * k)
    assert 800 < position <= 950


def test_nothing_is_sent_before_it_is_operational(line):
    line.map()
    line.send(0, bytes([128, 5]))
    line.sync()
    assert line.hear(0x185, 0.05) == b""


def test_every_third_sync_where_that_was_requested(line):
    line.map(kind=3)
    heard = []
    for _ in range(9):
        line.sync()
        heard.append(line.hear(0x185, 0.02) != b"")
    assert sum(heard) == 3


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
    assert motor(*words).statusword() & (0x4F if ends == 0x40 else 0x6F) == ends


@pytest.mark.parametrize(("option", "after"), [(2, "switch on disabled"), (6, "operation enabled")])
def test_only_a_drive_that_holds_after_a_quick_stop_goes_on_from_it(option, after):
    made = motor()
    made.objects.values[(0x605A, 0)] = option
    for word in (0x06, 0x0F, 0x02):
        made.control(word)
    made.advance(0.01)
    made.control(0x0F)
    assert made.state == after


@pytest.mark.parametrize("sign", [1, -1])
def test_a_motor_pulls_no_harder_than_its_greatest_torque(sign):
    def moved(made, targets):
        for target in targets:
            made.written((0x607A, 0), target)
            made.setpoint()
            made.advance(0.01)
            made.torque = 0.5 * made.x  # a tendon as a spring
        return made

    def pulled(most):
        made = motor()
        made.objects.values[(0x3001, 2)] = round(most * SPEC.rated_torque / SPEC.torque_constant)  # mA
        for word in (0x06, 0x0F):
            made.control(word)
        made.written((0x6060, 0), 8)
        return moved(made, [sign * 20 * k for k in range(60)])

    held = pulled(200)
    assert pulled(3000).reported_torque() == pytest.approx(sign * 0.5 * 20 * 59, abs=12)
    assert held.reported_torque() == sign * 200
    assert 400 <= sign * held.x < 425  # 200 / 0.5, and one step until the torque is known
    assert sign * held.following_error() > 700
    assert abs(moved(held, [0] * 20).x) < 1.0  # back it goes


def test_a_fault_is_reset_by_the_edge_of_bit_7_only():
    made = motor(0x06, 0x0F, 0x8F)  # bit 7 is set already when the fault comes
    made.fault(0x2310)
    made.control(0x8F)
    assert made.state == "fault"
    made.control(0x00)
    made.control(0x80)
    assert (made.state, made.emergencies) == ("switch on disabled", [(0x2310, 0x03), (0, 0)])


def test_currents_are_in_milliamperes_and_torques_in_thousandths_of_the_rated_one(line):
    line.enable()
    line.nodes._nodes[0].motor.torque = 400.0
    # 0.4 x 54 mN m / 25.1 mN m/A
    assert line.upload(0x30D1, 1)[:1] + line.upload(0x30D1, 1)[4:] == b"\x43" + struct.pack("<i", 861)
    assert line.upload(0x30D2, 1)[:1] + line.upload(0x30D2, 1)[4:6] == b"\x4b" + struct.pack("<h", 400)
    assert (line.read(0x3001, 1), line.read(0x3001, 5)) == (2151, 25_100)


@pytest.mark.parametrize(("mode", "fastest"), [(8, 20_000), (1, 10_000)])
def test_the_motors_speed_is_limited_in_every_mode_the_profiles_where_the_drive_plans(mode, fastest):
    made, per_rpm = motor(), SPEC.counts_per_turn / 60
    made.objects.values |= {(0x6080, 0): round(20_000 / per_rpm), (0x607F, 0): round(10_000 / per_rpm)}
    made.objects.values |= {(0x6081, 0): 50_000, (0x6065, 0): 0xFFFFFFFF}
    made.written((0x6060, 0), mode)
    for word in (0x06, 0x0F):
        made.control(word)
    made.written((0x607A, 0), 100_000)
    made.control(0x1F)
    made.setpoint()
    made.advance(0.2)
    assert made.v == pytest.approx(fastest, rel=0.01)


LACKED = [0x1003, 0x1016, 0x1017, 0x3001, 0x605A, 0x6065, 0x6066, 0x607D, 0x607F, 0x6080, 0x6081, 0x6085]


@pytest.mark.parametrize("index", [*LACKED, 0x60A9, 0x60C2, 0x6502])
def test_a_motor_runs_without_an_object_that_its_drive_lacks(line, index):
    line.nodes.drop(0, index)
    line.enable()
    for k in range(20):
        status, position = line.cycle(0x0F, 20 * k)
    assert (status & 0x6F, position > 200) == (0x27, True)
    line.nodes.emergency(0, 0x2310)
    line.sync()
    assert line.emergency() == 0x2310
    assert line.read(index) == 0x06020000


def test_what_can_only_be_written_is_not_read(line):
    assert line.read(0x1F50, 1) == 0x06010001


def test_process_data_mapped_by_sdo_counts_at_once(line):
    line.map()
    assert line.cycle(0x00) == (0x0250, 0)
    line.takes((0x1800, 1, 0xC0000185, 4))  # away with it, while it is operational
    line.sync()
    assert line.hear(0x185, 0.05) == b""
    line.takes((0x1A00, 0, 0, 1), (0x1A00, 1, 0x60640020, 4), (0x1A00, 0, 1, 1), (0x1800, 1, 0x40000185, 4))
    line.sync()
    assert line.hear(0x185) == bytes(4)
    line.takes((0x1400, 1, 0x80000205, 4))
    line.send(0x205, struct.pack("<Hi", 0x06, 0))
    line.sync()
    assert line.nodes.states == ("switch on disabled",)


@pytest.mark.parametrize("cob_id", [0x000, 0x080, 0x205, 0x605, 0x77F, 0x705])
@pytest.mark.parametrize("length", range(9))
def test_frames_of_any_length_harm_nothing(line, cob_id, length):
    line.enable()
    line.send(cob_id, bytes([0x81, 0x05, 0x60, 0x00, 0xFF, 0xFF, 0xFF, 0xFF][:length]))
    assert line.read(0x6502) == 0x3A5
    assert line.nodes._wrong is None


def test_without_heartbeats_it_stops_at_the_moment_it_must(line):
    line.map()
    line.takes((0x6007, 0, 3, 2), (0x605A, 0, 6, 2), (0x1016, 1, 127 << 16 | 150, 4))
    line.takes((0x60C2, 1, 10, 1))  # ms: the shaft turns all the time
    line.send(0x77F, b"\x05")
    line.enable()
    for k in range(12):
        line.cycle(0x0F, 100 * k)
    assert line.nodes.moving.all()
    line.clock.sleep_until(line.clock.now() + 0.3)
    line.sync(0.0)
    assert struct.unpack_from("<HB", line.hear(0x085)) == (0x8130, 0x11)
    assert line.nodes.states == ("quick stop active",)
    assert not line.nodes.moving.any()
    # the heartbeat came at 0; the ramp from 10,000 counts/s by 10,000 rpm/s = 682,667 counts/s2 takes 15 ms;
    # the shaft lags by some ms
    assert 0.165 < line.nodes.stopped_at[0] < 0.19


def test_a_target_beyond_the_software_limit_is_clipped(line):
    line.map()
    line.takes((0x607D, 1, -100, 4), (0x607D, 2, 100, 4))
    line.enable()
    for _ in range(10):
        status, position = line.cycle(0x0F, 1000)
    assert (position, status & 0x0800) == (100, 0x0800)


def test_a_set_point_that_does_not_come_is_counted(line):
    line.enable()
    for _ in range(3):
        line.sync()
        line.hear(0x185)
    assert line.nodes.missed_setpoints == 3


def test_a_short_rpdo_is_an_emergency_and_changes_nothing(line):
    line.enable()
    line.send(0x205, b"\x00\x00")
    line.sync()
    assert line.emergency() == 0x8210
    assert line.nodes.states == ("operation enabled",)


def test_a_reboot_forgets_its_mapping_and_may_keep_its_counter(line):
    line.enable()
    for k in range(10):
        line.cycle(0x0F, 10 * k)
    line.nodes.reboot(0, keep_position=True)
    assert line.hear(0x705) == b"\x00"
    assert line.read(0x6064, kind="<i") > 50
    line.nodes.reboot(0)
    assert line.read(0x6064, kind="<i") == 0
    line.send(0, bytes([1, 5]))
    line.sync()
    assert line.hear(0x185, 0.05) == b""
    assert line.nodes.true_pulled[0] > 50 * SPEC.metres_per_count


@pytest.mark.real_time
def test_in_real_time_heartbeats_come_without_sync():
    with Line(WallClock()) as line:
        assert line.hear(0x705) == b"\x00"
        line.takes((0x1017, 0, 20, 2))
        assert [line.hear(0x705) for _ in range(3)] == [b"\x7f"] * 3


def test_a_request_is_deaf_ears_while_the_bus_is_off(line):
    line.nodes.bus_off()
    line.send(0x605, struct.pack("<BHB4x", 0x40, 0x1000, 0))
    assert line.hear(0x585, 0.05) == b""
    line.nodes.restore()
    assert len(line.upload(0x1000)) == 8


def test_tendons_that_fail_are_reported_when_it_is_closed():
    import can

    class Broken:
        def move(self, t, pulled):
            raise RuntimeError("the rod snapped")

    name = own_bus()
    bus, clock = open_bus(name), SteppedClock()
    nodes = EmulatedDrives([SPEC], name, clock=clock, tendons=Broken())
    clock.sleep_until(0.1)
    bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
    for _ in range(100):
        if nodes._wrong is not None:
            break
        threading.Event().wait(0.01)
    with pytest.raises(DeviceError, match="RuntimeError: the rod snapped"):
        nodes.close()
    bus.shutdown()


def test_serve_returns_when_it_is_stopped(line):
    stop = threading.Event()
    thread = threading.Thread(target=line.nodes.serve, args=(stop,))
    thread.start()
    assert thread.is_alive()
    stop.set()
    thread.join(2.0)
    assert not thread.is_alive()
