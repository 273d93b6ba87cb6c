"""Dynamixel servos as drives of the prototype: packets, the bus and its faults, on an emulated serial
port."""

import os
import struct
import sys
import threading
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from benches import BENT, Springs, started

from fastrod.errors import FastrodError, InputError, UnknownNameError
from fastrod.logs.link import RobotLink
from fastrod_device.can.clock import SteppedClock, WallClock
from fastrod_device.drives import BusSpec, Drives, drive_kinds
from fastrod_device.dynamixel.drives import DynamixelBus
from fastrod_device.dynamixel.line import CURRENT_LIMIT, GOAL_POSITION
from fastrod_device.dynamixel.packets import EVERYBODY, PING, STATUS, SYNC_WRITE, WRITE, Packet, PacketReader
from fastrod_device.emulator.dynamixel import EmulatedDynamixels
from fastrod_device.emulator.emulator import Emulator
from fastrod_device.emulator.seal import seal
from fastrod_device.errors import DeviceError
from fastrod_device.hardware import SHIPPED, load_hardware
from fastrod_device.prototype import Prototype
from fastrod_device.safety import SafetyState
from fastrod_device.units import DriveSpec

COUNT = 2.0 * np.pi * 0.008 / 4096  # m, of a servo without a gear


def hardware_text():
    """The shipped hardware file with servos in place of its drives."""
    head, *_ = SHIPPED.read_text().partition("[[drive]]")
    motor = "drum_radius = 0.008\ngear = 10.0\ntorque_constant = 0.04\nrated_torque = 0.04\n"
    drives = [f"[[drive]]\nnode = {11 + k}\ndirection = {1 if k < 2 else -1}\n{motor}" for k in range(4)]
    return head + '[bus]\nkind = "dynamixel"\nbitrate = 2_000_000\n' + "".join(drives)


@pytest.fixture(scope="module")
def hardware(tmp_path_factory):
    path = tmp_path_factory.mktemp("bench") / "servos.toml"
    path.write_text(hardware_text())
    return load_hardware(path)


@pytest.fixture
def bench(hardware):
    with started(hardware, camera=False) as made:
        yield made


# packets


def test_packets_are_those_of_the_specification():
    """The examples of the public page on protocol 2.0: ping, and a write of 512 to address 116."""
    assert Packet(1, PING).encoded() == bytes.fromhex("FFFFFD00 01 0300 01 194E")
    write = Packet(1, WRITE, struct.pack("<HI", 116, 512)).encoded()
    assert write == bytes.fromhex("FFFFFD00 01 0900 03 7400 00020000 CA89")


@pytest.mark.parametrize(
    "data", [b"", b"\xff\xff\xfd", b"\xff\xff\xfd\xfd\x00", b"\xff" * 9, b"\x00\xff\xff\xfd\x00"]
)
def test_a_header_within_the_data_is_none(data):
    packets = [Packet(7, WRITE, data), Packet(8, STATUS, data)]
    line = b"noise\xff\xff" + b"".join(packet.encoded() for packet in packets)
    assert PacketReader().take(line) == packets
    reader = PacketReader()
    assert [found for k in range(len(line)) for found in reader.take(line[k : k + 1])] == packets


def test_damaged_packets_are_passed_over():
    good = Packet(3, STATUS, b"\x00abc")
    whole = good.encoded()
    for k in range(len(whole)):
        hurt = bytearray(whole)
        hurt[k] ^= 0x10
        found = PacketReader().take(bytes(hurt) + whole * 3 + b"\x00" * 70_000)
        assert good in found
        assert all(packet == good for packet in found)


# through the prototype


def goes_to(prototype, dl):
    """It is moved there, and reads so."""
    prototype.command(dl)
    prototype.wait(0.5)
    np.testing.assert_allclose(prototype.read().dl, dl, atol=COUNT)


def stays(prototype, cycles, why):
    for _ in range(cycles):
        with pytest.raises(DeviceError, match=why):
            prototype.wait(0.01)


def test_it_connects_moves_and_reads_back(bench):
    prototype, emulator = bench
    assert isinstance(prototype, RobotLink)
    assert isinstance(prototype.drives, DynamixelBus)
    assert len(prototype.drives.notices) == 4
    goes_to(prototype, BENT)
    np.testing.assert_allclose(-emulator.drives.true_pulled, BENT, atol=2 * COUNT)
    tension = prototype.read().tension
    np.testing.assert_allclose(tension, emulator.plant.tension(), atol=0.2)  # a step of current is 0.11 N
    assert prototype.read().problem == ""
    prototype.close()
    assert not emulator.drives.moving.any()


@pytest.mark.study
def test_homing_finds_the_tendons_taut(hardware):
    with started(hardware, camera=False, home=True) as (prototype, emulator):
        prototype.wait(0.05)
        np.testing.assert_allclose(prototype.read().dl, 0.0, atol=2 * COUNT)
        np.testing.assert_allclose(emulator.plant.tension(), 1.0, atol=0.3)
        assert all(tendon.pretension > 0.0 for tendon in prototype.robot.segments[0].tendons)
        goes_to(prototype, BENT)


def test_a_quick_stop_holds_within_the_limits_until_it_is_released(bench, hardware):
    (prototype, emulator), limits = bench, hardware.limits
    prototype.command(3.0 * BENT)
    prototype.wait(0.1)
    assert emulator.drives.moving.any()
    before = emulator.drives.true_pulled
    prototype.stop()
    stays(prototype, 5, "emergency stop")
    assert not emulator.drives.moving.any()
    after = emulator.drives.true_pulled
    # a ramp of 15 ms from the greatest rate, begun one cycle after the shaft was last heard
    longest = limits.rate * (0.5 * 0.015 + 1.0 / hardware.rate) + 2 * COUNT
    assert np.abs(after - before).max() <= longest
    assert np.abs(after).max() < limits.displacement
    stays(prototype, 30, "emergency stop")
    np.testing.assert_array_equal(emulator.drives.true_pulled, after)
    prototype.release()
    prototype.wait(0.05)
    assert prototype.supervisor.state is SafetyState.READY
    goes_to(prototype, np.zeros(4))


def test_an_overload_is_a_fault_and_a_reboot_forgets_no_rotation(bench):
    prototype, emulator = bench
    prototype.command(BENT)
    prototype.wait(0.4)
    emulator.drives.overload(1)  # below 0 counts: its reboot forgets a rotation
    with pytest.raises(DeviceError, match=r"node 12\) sent an emergency: 0x2310.*over-current"):
        prototype.wait(0.1)
    assert "over-current" in prototype.read().problem
    assert not emulator.drives.moving.any()
    prototype.release()
    prototype.wait(0.1)
    assert prototype.supervisor.state is SafetyState.READY
    np.testing.assert_allclose(prototype.read().dl, BENT, atol=2 * COUNT)
    goes_to(prototype, -BENT)


def test_a_servo_that_falls_silent_stops_the_robot(bench):
    prototype, emulator = bench
    prototype.command(BENT)
    prototype.wait(0.05)
    emulator.drives.silent.add(12)
    with pytest.raises(DeviceError, match=r"drive 2 \(node 12\)"):
        prototype.wait(0.5)
    emulator.drives.silent.update({11, 13, 14})
    stays(prototype, 20, "Stopped")
    assert "no servo has answered" in prototype.drives.newest.lost


# the bus alone

LARGEST = {"position_limit": 10_000, "velocity_limit": 4000, "following_error": 100, "torque_limit": 500}
LIMITS = {name: np.full(2, most) for name, most in (LARGEST | {"deceleration": 200_000}).items()}
MOTOR = {"drum_radius": 0.008, "gear": 1.0, "torque_constant": 1.78, "rated_torque": 1.0}
SPECS = tuple(DriveSpec(node=node, **MOTOR) for node in (1, 2))


@pytest.fixture
def servos():
    """Bus, servos and clock, not yet connected."""
    clock = SteppedClock()
    emulated = EmulatedDynamixels(SPECS, None, clock=clock, tendons=Springs())
    bus = DynamixelBus(SPECS, emulated, clock=clock)
    yield bus, emulated, clock
    bus.close()


@pytest.fixture
def ready(servos):
    """Connected and enabled."""
    servos[0].connect(**LIMITS)
    servos[0].enable()
    return servos


def test_it_is_a_driver_by_the_protocol(ready):
    drives: Drives = ready[0]
    assert drives.newest.statusword.tolist() == [0x27, 0x27]


def test_the_watchdog_stops_servos_that_nobody_talks_to(ready):
    bus, emulated, clock = ready
    bus.exchange(np.array([4000, -4000]))
    clock.sleep_until(clock.now() + 0.15)
    stopped = emulated.true_pulled
    clock.sleep_until(clock.now() + 0.5)
    np.testing.assert_array_equal(emulated.true_pulled, stopped)
    assert 0.0 < stopped[0] < 4000 * COUNT
    assert bus.exchange().statusword.tolist() == [0x07, 0x07]
    bus.exchange(np.array([0, 0]))
    clock.sleep_until(clock.now() + 0.1)
    np.testing.assert_array_equal(emulated.true_pulled, stopped)
    bus.enable()
    assert bus.exchange().statusword.tolist() == [0x27, 0x27]


def test_targets_with_a_header_in_them_arrive(ready):
    """-131073 counts are FF FF FD FF on the line."""
    bus, emulated, _ = ready
    bus.exchange(np.array([-131_073, 0]))
    assert emulated._servos[1].get(GOAL_POSITION) == -131_073


def test_a_stop_lasts_until_it_is_acknowledged(ready):
    bus, emulated, clock = ready
    assert bus.quick_stop("somebody said so") == ""
    assert bus.stop_reason == "somebody said so"
    bus.exchange(np.array([400, 400]))
    clock.sleep_until(clock.now() + 0.1)
    np.testing.assert_array_equal(emulated.true_pulled, 0.0)
    with pytest.raises(DeviceError, match=r"stopped \(somebody said so\); acknowledge\(\) before"):
        bus.enable()
    bus.acknowledge()
    bus.enable()
    assert bus.stop_reason == ""


def test_a_port_that_is_gone_is_said_and_raises_nothing_in_a_cycle(ready, monkeypatch):
    def write(data):
        raise OSError("the device is gone")  # its adapter was pulled out

    bus = ready[0]
    monkeypatch.setattr(bus._line, "port", SimpleNamespace(write=write, read=lambda timeout: b""))
    assert bus.exchange(np.zeros(2, int)).lost == "the serial port carries nothing: the device is gone"
    assert "the device is gone" in bus.quick_stop()
    with pytest.raises(DeviceError, match="the device is gone"):
        bus.connect(**LIMITS)


@pytest.mark.parametrize(
    ("do", "sentence"),
    [
        (lambda bus, it: (it.silent.add(2), bus.connect(**LIMITS)), "the servo 2 does not answer"),
        (lambda bus, _: bus.enable(), r"not connected; connect\(\) first"),
        (lambda bus, _: bus.exchange(np.array([1])), r"it must be \(2,\) whole counts"),
        (lambda bus, _: bus.exchange(np.array([0.5, 1.0])), r"it must be \(2,\) whole counts"),
        (
            lambda bus, it: (bus.connect(**LIMITS), it.overload(0), bus.enable()),
            r"the servo 1 is in fault: over-current \(0x2310\)",
        ),
    ],
    ids=["silent", "not connected", "one target", "no counts", "in fault"],
)
def test_a_bus_that_cannot_do_it_says_so_in_a_sentence(do, sentence, servos):
    bus, emulated, _ = servos
    with pytest.raises(FastrodError, match=sentence) as caught:
        do(bus, emulated)
    assert "\n" not in str(caught.value)


def test_a_current_beyond_the_servos_own_limit_is_that_limit(servos):
    bus, emulated, _ = servos
    bus.connect(**{**LIMITS, "torque_limit": np.full(2, 3000)})
    assert emulated._servos[1].get(CURRENT_LIMIT) == 1193
    assert int.from_bytes(emulated._servos[1].table[102:104], "little") == round(3.0 / 1.78 / 2.69e-3)


# the hardware file, and drivers of other packages


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ('kind = "dynamixle"', r"\[bus\]: no kind of drives 'dynamixle'; did you mean 'dynamixel'"),
        ('kind = "dynamixel"\nbaud = 9', r"\[bus\] has an unknown key 'baud'; "),
        ("bitrate = 5", r"\[bus\]: bitrate is 5; it must be from 9600 to 10000000 bit/s"),
    ],
    ids=["kind", "key", "bitrate"],
)
def test_a_bus_that_cannot_be_is_refused(line, sentence, tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(SHIPPED.read_text() + f"\n[bus]\n{line}\n")
    with pytest.raises(InputError if "bitrate" in line else UnknownNameError, match=sentence) as caught:
        load_hardware(path)
    assert "\n" not in str(caught.value)
    assert load_hardware().bus == BusSpec(kind="epos4", bitrate=1_000_000)


def test_a_port_that_is_not_there_is_said(hardware):
    nowhere = partial(Prototype, hardware, "virtual:nowhere", None, clock=SteppedClock())
    with pytest.raises(DeviceError, match="there is no port 'virtual:nowhere' in this process"):
        nowhere()
    with pytest.raises(InputError, match="drives of the kind 'dynamixel' have none"):
        nowhere(eds="mine.eds")


DRIVER = """from fastrod_device.dynamixel.drives import DynamixelBus
def bus(specs, bus, *, clock, rate, bitrate):
    port = bus.replace('mine', 'virtual')
    return DynamixelBus(specs, port, clock=clock, rate=rate, bitrate=bitrate)
"""


def test_a_driver_of_another_package_is_taken_up(tmp_path, monkeypatch):
    (tmp_path / "mymotors.py").write_text(DRIVER)
    known = tmp_path / "mymotors-1.0.dist-info"
    known.mkdir()
    (known / "METADATA").write_text("Metadata-Version: 2.1\nName: mymotors\nVersion: 1.0\n")
    (known / "entry_points.txt").write_text("[fastrod.drives]\nmine = mymotors:bus\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert drive_kinds() == ("epos4", "dynamixel", "mine")
    path = tmp_path / "bench.toml"
    path.write_text(hardware_text().replace('"dynamixel"', '"mine"'))
    hardware, clock = load_hardware(path), SteppedClock()
    given = {"clock": clock, "seal": seal(5, "none")}
    none = "drives of the kind 'mine' have no emulator; those of epos4, dynamixel do"
    with pytest.raises(InputError, match=none):
        Emulator(hardware, "virtual:other", **given)
    emulator = Emulator(replace(hardware, bus=BusSpec(kind="dynamixel")), "virtual:other", taut=True, **given)
    with Prototype(hardware, "mine:other", None, clock=clock) as prototype:
        prototype.start(home=False)
        goes_to(prototype, BENT)
    emulator.close()


@pytest.mark.skipif(sys.platform == "win32", reason="there are no pseudo terminals")
def test_a_serial_device_carries_it_too(monkeypatch):
    """The emulator's bytes over a pseudo terminal, read by pyserial in real time; a busy machine's pauses are
    no fault here."""
    pytest.importorskip("serial", reason="pyserial is not installed: pip install 'fastrod[device]'")
    import tty

    patience = {"line._PATIENCE": 20.0, "drives._CYCLE": 20.0, "drives._SILENCE": 60.0, "drives._WATCHED": 0}
    for name, value in patience.items():
        monkeypatch.setattr(f"fastrod_device.dynamixel.{name}", value)
    master, slave = os.openpty()
    tty.setraw(slave)
    clock, done = WallClock(), threading.Event()
    emulated = EmulatedDynamixels(SPECS, None, clock=clock, tendons=Springs())

    def serve():
        while not done.is_set():
            emulated.write(os.read(master, 4096))
            if answer := emulated.read(0.0):
                os.write(master, answer)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    bus = DynamixelBus(SPECS, os.ttyname(slave), clock=clock, rate=1.0)
    try:
        bus.connect(**LIMITS)
        bus.enable()
        bus.exchange(np.array([50, -50]))
        for _ in range(200):
            if (bus.exchange().position == [50, -50]).all():
                break
        assert (bus.newest.position.tolist(), bus.newest.lost) == ([50, -50], "")
    finally:
        bus.close()
        done.set()
        os.write(slave, Packet(EVERYBODY, SYNC_WRITE, b"\0\0\0\0").encoded())
        thread.join(2.0)
        os.close(master)
        os.close(slave)
