"""Faults put into a prototype that moves: it stops, says why, keeps every line and row, and moves again only
when a person says so."""

from __future__ import annotations

import itertools
import math
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fastrod.logs.recording import recover
from fastrod.types import Floats
from fastrod_device.can.bus import BusLine
from fastrod_device.can.clock import SteppedClock, WallClock
from fastrod_device.can.faultcodes import ENABLED
from fastrod_device.emulator.emulator import Emulator
from fastrod_device.emulator.seal import seal
from fastrod_device.errors import DeviceError, RefusedError
from fastrod_device.hardware import load_hardware
from fastrod_device.journal import Journal
from fastrod_device.prototype import Prototype
from fastrod_device.safety import SafetyState

pytest.importorskip("canopen", reason="canopen is not installed: pip install 'fastrod[device]'")
pytest.importorskip("cv2", reason="opencv-python-headless is not installed: pip install 'fastrod[device]'")

SAFE = 0.05  # s
RADIUS, TURN = 0.0025, 1.0  # m of tendon, s
_names = itertools.count()


class Rig:
    """An emulated prototype in stepped time, going round in a circle by commands at 30 Hz, recorded."""

    def __init__(self, folder: Path, *, rate: float, following_error: float) -> None:
        hardware = load_hardware()
        hardware = replace(
            hardware, limits=replace(hardware.limits, rate=rate, following_error=following_error)
        )
        self.bus = f"virtual:faults-{next(_names)}"
        self.clock, self.radius, self.jump = SteppedClock(), RADIUS, 0.0
        self.emulator = Emulator(
            hardware, self.bus, clock=self.clock, seal=seal(3, "none"), seed=3, taut=True
        )
        self.drives = self.emulator.drives
        self.events, self.log = folder / "events.csv", folder / "log.csv"
        self.prototype = Prototype(
            hardware,
            self.bus,
            self.emulator,
            clock=self.clock,
            journal=Journal(self.events),
            wall=lambda: self.clock.now() + self.jump,
        )
        self.supervisor = self.prototype.supervisor
        self.prototype.start(home=False)
        self.recorder = self.prototype.recorder_for(self.log)
        self.recorder.start(self.prototype.elapsed)
        self.prototype.record(self.recorder)
        self._due, self.storm = 0.0, 0
        self.other = BusLine(self.bus)
        self.began = self.clock.now()

    def circle(self) -> Floats:
        t = self.clock.now() - self.began
        angle = 2.0 * math.pi * t / TURN
        bend = self.radius * min(1.0, 2.0 * t) * np.array([math.cos(angle), math.sin(angle)])
        return np.concatenate([bend, -bend])

    def go_on(self, seconds: float, until: Callable[[], object] = lambda: False) -> None:
        """Time passes and commands come, stopped or not."""
        end = self.clock.now() + seconds - 1e-9
        while self.clock.now() < end and not until():
            if self.clock.now() >= self._due:
                self._due = self.clock.now() + 1.0 / 30.0
                with suppress(RefusedError):
                    self.prototype.command(self.circle())
            for _ in range(self.storm):
                self.other.send(0x080, b"")
            with suppress(DeviceError):
                self.prototype.wait(0.01)

    @property
    def stopped(self) -> bool:
        return self.supervisor.state is SafetyState.STOPPED

    @property
    def enabled(self) -> list[bool]:
        return [state == ENABLED for state in self.drives.states]

    def repair(self) -> None:
        self.drives.restore()
        self.emulator.frozen = self.emulator.hidden = False
        self.storm = 0


@contextmanager
def moving(
    folder: Path, moment: float, *, rate: float = 0.02, following_error: float = 2.5e-4
) -> Iterator[Rig]:
    """With a following error of 1 mm a tendon that stalls is found by its tension before."""
    rig = Rig(folder, rate=rate, following_error=following_error)
    try:
        rig.go_on(moment)
        assert not rig.stopped, rig.supervisor.status
        assert rig.drives.moving.all()
        yield rig
    finally:
        rig.repair()
        if rig.recorder.recording:
            rig.recorder.stop()
        rig.prototype.close()
        rig.other.close()
        rig.emulator.close()


def block(rig: Rig) -> None:
    readings = rig.prototype.readings
    assert readings is not None
    rig.drives.block(int(np.argmin(readings.rate)))


def freeze(rig: Rig) -> None:
    rig.emulator.frozen = True


def hide(rig: Rig) -> None:
    rig.emulator.hidden = True


def jump(rig: Rig) -> None:
    rig.jump += 3600.0


def storm(rig: Rig) -> None:
    rig.storm = 5


FAULTS: dict[str, tuple[Callable[[Rig], None], tuple[str, ...]]] = {
    "heartbeat lost": (
        lambda rig: rig.drives.lose_heartbeat(1),
        ("drive 2 (node 2)", "sent its last heartbeat"),
    ),
    "emergency message": (
        lambda rig: rig.drives.emergency(2, 0x2310, lasting=True),
        ("drive 3 (node 3)", "0x2310", "over-current"),
    ),
    "following error": (block, ("(node ", "ollowing error")),
    "bus off": (lambda rig: rig.drives.bus_off(), ("the bus carries nothing",)),
    "node reboot": (lambda rig: rig.drives.reboot(3), ("drive 4 (node 4)", "0 (booting)")),
    "camera frozen": (freeze, ("the camera repeats its frames",)),
    "marker lost": (hide, ("the marker was last seen", "the limit is 500 ms")),
    "clock jump": (jump, ("the wall clock jumped by 3.6e+06 ms",)),
    "encoder jump": (
        lambda rig: rig.drives.encoder_jump(0, 2500),
        ("drive 1 (node 1)", "moved its tendon by -1."),
    ),
    "foreign SYNC": (storm, ("another node sends SYNC (5 since the last cycle)",)),
}
ONCE = ("following error", "clock jump")  # nothing tells that they are still there


@pytest.mark.study
@pytest.mark.parametrize("moment", [0.75, 1.32])
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_stops_the_robot_is_named_and_nothing_is_lost_or_starts_again(
    name: str, moment: float, tmp_path: Path
) -> None:
    inject, words = FAULTS[name]
    with moving(tmp_path, moment) as rig:
        inject(rig)
        rig.go_on(2.0, lambda: rig.stopped)
        fault = rig.supervisor.first
        assert fault is not None
        assert all(word in fault.sentence for word in words), fault.sentence
        assert fault.kind == name or name == "following error"
        rig.go_on(0.25)
        assert not rig.drives.moving.any()
        assert np.nanmax(rig.drives.stopped_at) - fault.t <= SAFE
        assert not any(rig.enabled)
        where, rows = rig.drives.true_pulled, len(rig.recorder)
        for _ in range(20):
            rig.go_on(0.05)
            assert not any(rig.enabled)
        np.testing.assert_array_equal(rig.drives.true_pulled, where)
        assert rig.stopped
        assert fault.sentence.rstrip(".") in rig.prototype.read().problem
        assert fault.sentence in rig.events.read_text(encoding="utf-8").replace('""', '"')
        assert [line[1:] for line in rig.prototype.journal.lines][:1] == [(fault.kind, fault.sentence)]
        assert len(rig.recorder) > rows  # what a camera sees of a stopped robot is recorded too
        rows = len(rig.recorder)
        assert (tmp_path / "log.csv.part").read_text(encoding="utf-8").count("\n") == rows + 2
        rig.prototype.record(None)
        assert len(rig.recorder.stop().t) == rows


@pytest.mark.study
@pytest.mark.parametrize("name", FAULTS)
def test_a_release_waits_for_the_end_of_the_cause(name: str, tmp_path: Path) -> None:
    inject, _ = FAULTS[name]
    # a stall that is found early leaves no tension that keeps the robot stopped
    slow = {"rate": 0.005, "following_error": 1e-4} if name == "following error" else {}
    with moving(tmp_path, 0.75, **slow) as rig:
        inject(rig)
        rig.go_on(2.0, lambda: rig.stopped)
        rig.go_on(0.5)
        if name not in ONCE:
            rig.prototype.release()
            assert rig.stopped
            assert not any(rig.enabled)
        rig.repair()
        rig.go_on(0.6)
        assert rig.stopped  # no cause is there any more, and still it waits for a person
        assert not any(rig.enabled)
        where = rig.drives.true_pulled
        rig.prototype.release()
        # its counter is lost: only a new start, with its homing, helps
        if name in ("node reboot", "encoder jump"):
            assert rig.stopped
            assert "where its tendon is may be lost" in rig.prototype.read().problem
            return
        assert rig.supervisor.state is SafetyState.READY
        assert all(rig.enabled)
        np.testing.assert_allclose(rig.drives.true_pulled, where, atol=2e-6)  # nothing moves by it
        assert rig.prototype.journal.lines[-1][1] == "release"
        rig.radius = 0.001
        rig.go_on(0.5)
        assert not rig.stopped, rig.supervisor.status
        assert rig.drives.moving.all()


def test_the_stop_is_in_time_at_the_largest_rate_too(tmp_path: Path) -> None:
    with moving(tmp_path, 0.3, rate=0.03, following_error=1e-3) as rig:
        limits = rig.prototype.hardware.limits
        rig.radius = 0.0058
        rig.prototype.command(np.array([0.0058, 0.0058, -0.0058, -0.0058]))
        rig.prototype.wait(0.1)
        assert rig.prototype.readings is not None
        assert np.abs(rig.prototype.readings.rate).max() > 0.98 * limits.rate
        rig.prototype.stop()
        t = rig.clock.now()
        with suppress(DeviceError):
            rig.prototype.wait(0.01)
        rig.go_on(0.2)
        assert not rig.drives.moving.any()
        assert np.nanmax(rig.drives.stopped_at) - t <= SAFE


def test_a_jump_beyond_the_drives_own_window_is_named_as_a_jump(tmp_path: Path) -> None:
    with moving(tmp_path, 0.75) as rig:
        rig.drives.encoder_jump(2, 5000)
        rig.go_on(0.5, lambda: rig.stopped)
        assert rig.supervisor.first is not None
        assert rig.supervisor.first.kind == "encoder jump"
        # the drive's own following error
        assert "emergency message" in [fault.kind for fault in rig.supervisor.faults]
        assert [line[1] for line in rig.prototype.journal.lines] == [
            fault.kind for fault in rig.supervisor.faults
        ]


def test_a_controller_that_pauses_is_stopped_when_it_comes_back(tmp_path: Path) -> None:
    with moving(tmp_path, 0.75) as rig:
        rig.clock.sleep_until(rig.clock.now() + 0.08)
        rig.go_on(0.1, lambda: rig.stopped)
        assert rig.supervisor.first is not None
        assert rig.supervisor.first.kind == "controller stalled"
        rig.go_on(0.2)
        assert not rig.drives.moving.any()
        assert not any(rig.enabled)


def test_drives_whose_controller_is_gone_stop_by_themselves(tmp_path: Path) -> None:
    import can

    with moving(tmp_path, 0.75) as rig, can.Bus(interface="virtual", channel=rig.bus.split(":")[1]) as other:
        rows, t = len(rig.recorder), rig.clock.now()
        # another SYNC goes on, by which the drives keep time; targets and heartbeats do not come any more
        for _ in range(100):
            rig.clock.sleep_until(rig.clock.now() + 0.01)
            other.send(can.Message(arbitration_id=0x80, is_extended_id=False))
            _heard(other, 8)
        assert not any(rig.enabled)
        assert not rig.drives.moving.any()
        assert (rig.drives.missed_at - t < 0.151).all()
        assert (rig.drives.stopped_at - rig.drives.missed_at <= SAFE).all()
        assert (tmp_path / "log.csv.part").read_text(encoding="utf-8").count("\n") == rows + 2


def _heard(bus: object, frames: int) -> None:
    """All have answered."""
    import can

    assert isinstance(bus, can.BusABC)
    got = 0
    while got < frames:
        message = bus.recv(2.0)
        assert message is not None
        got += 0x180 < message.arbitration_id < 0x300


CHILD = """
import sys, time
import numpy as np
from fastrod_device.vision.camera import CameraFrame
from fastrod_device.vision.drawing import Eye
from fastrod_device.hardware import load_hardware
from fastrod_device.prototype import Prototype
from dataclasses import replace
import fastrod_device.can.configuring, fastrod_device.can.cycle
fastrod_device.can.configuring.PATIENCE, fastrod_device.can.cycle._PAUSE = 1.0, 0.8
hardware = load_hardware()
limits = replace(hardware.limits, sighting_age=None, feedback_age=0.5, heartbeat_age=2.0, cycle=0.5)
hardware = replace(hardware, limits=limits)
class Still:
    eye, number, due = Eye(hardware.camera, hardware.marker, seed=1), 0, 0.0
    def read(self):
        now = time.monotonic()
        if now < self.due:
            return None
        self.due, self.number = now + 1.0 / hardware.camera.rate, self.number + 1
        image = self.eye.draw(np.array([0.0, 0.0, 0.07]), np.array([1.0, 0.0, 0.0, 0.0]))
        return CameraFrame(image=image, t=now - 0.03, number=self.number)
    def close(self):
        pass
with Prototype(hardware, sys.argv[1], Still()) as prototype:
    prototype.start(home=False)
    recorder = prototype.recorder_for(sys.argv[2])
    recorder.start(prototype.elapsed)
    prototype.record(recorder)
    k = 0
    while True:
        k += 1
        prototype.command(0.002 * np.array([1, 1, -1, -1]) * np.sin(0.1 * k))
        print(len(recorder), flush=True)
        time.sleep(0.03)
"""


@pytest.mark.study
@pytest.mark.real_time
def test_a_killed_process_leaves_its_drives_stopped_and_its_rows_on_disk(tmp_path: Path) -> None:
    bus, log = "udp_multicast:239.74.163.7:43183", tmp_path / "log.csv"
    emulator = Emulator(load_hardware(), bus, clock=WallClock(), seal=seal(1, "none"), seed=1, taut=True)
    child = subprocess.Popen([sys.executable, "-c", CHILD, bus, str(log)], stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout is not None
        reported = list(itertools.takewhile(lambda line: int(line) < 8, child.stdout))
        assert len(reported) > 1
        assert all(state == ENABLED for state in emulator.drives.states)
        child.send_signal(signal.SIGKILL)
        rest = [line for line in child.stdout if line.endswith("\n")]
        child.wait(10.0)
        WallClock().sleep_until(WallClock().now() + 2.0)
        assert emulator.drives.states == ("quick stop active",) * 4
        assert not emulator.drives.moving.any()
        assert np.isfinite(emulator.drives.missed_at).all()
        assert len(recover(log).t) >= max(8, *(int(line) for line in rest), 8)
    finally:
        child.kill()
        child.wait()
        if child.stdout is not None:
            child.stdout.close()
        emulator.close()
