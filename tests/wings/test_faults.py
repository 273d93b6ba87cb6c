"""Faults put into a prototype that moves: it stops, says why, keeps every line and row, and moves again only
when a person says so."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("canopen", reason="canopen is not installed: pip install 'fastrod[device]'")
pytest.importorskip("cv2", reason="opencv-python-headless is not installed: pip install 'fastrod[device]'")

from bench_faults import INJECTIONS, SAFE, Rig, kill
from fastrod_device.can.faultcodes import ENABLED
from fastrod_device.errors import DeviceError
from fastrod_device.safety import SafetyState

ONCE = ("following error", "clock jump")  # nothing tells that they are still there
SAID = {
    "heartbeat lost": ("drive 4 (node 4)",),
    "emergency message": ("drive 4 (node 4)", "0x2310", "over-current"),
    "following error": ("(node ",),
    "node reboot": ("drive 4 (node 4)",),
    "marker lost": ("the limit is 500 ms",),
    "clock jump": ("by 3.6e+06 ms",),
    "encoder jump": ("drive 4 (node 4)", "by -2."),
    "foreign SYNC": ("(10 since the last cycle)",),
}
"""What the third kind of each fault says, beside what every kind does."""


@contextmanager
def moving(folder: Path, moment: float, **limits: float) -> Iterator[Rig]:
    with closing(Rig(folder, 3, **{"rate": 0.02} | limits)) as rig:
        rig.wait(moment)
        assert not rig.stopped(), rig.prototype.supervisor.status
        assert rig.drives.moving.all()
        yield rig


def enabled(rig: Rig) -> list[bool]:
    return [state == ENABLED for state in rig.drives.states]


def rows_on_disk(rig: Rig) -> int:
    return rig.log.with_name(rig.log.name + ".part").read_text(encoding="utf-8").count("\n") - 2


@pytest.mark.study
@pytest.mark.parametrize("moment", [0.75, 1.32])
@pytest.mark.parametrize("name", INJECTIONS)
def test_a_fault_stops_the_robot_is_named_and_nothing_is_lost_or_starts_again(
    name: str, moment: float, tmp_path: Path
) -> None:
    inject, words = INJECTIONS[name]
    with moving(tmp_path, moment) as rig:
        inject(rig, 3)
        rig.wait(2.0, rig.stopped)
        fault = rig.prototype.supervisor.first
        assert fault is not None
        assert all(word in fault.sentence for word in (words, *SAID.get(name, ()))), fault.sentence
        assert fault.kind == name or name == "following error"
        rig.wait(0.25)
        assert not rig.drives.moving.any()
        assert np.nanmax(rig.drives.stopped_at) - fault.t <= SAFE
        assert not any(enabled(rig))
        where, rows = rig.drives.true_pulled, len(rig.recorder)
        for _ in range(20):
            rig.wait(0.05)
            assert not any(enabled(rig))
        np.testing.assert_array_equal(rig.drives.true_pulled, where)
        assert rig.stopped()
        assert fault.sentence.rstrip(".") in rig.prototype.read().problem
        assert fault.sentence in rig.journal.read_text(encoding="utf-8").replace('""', '"')
        assert [line[1:] for line in rig.prototype.journal.lines][:1] == [(fault.kind, fault.sentence)]
        assert len(rig.recorder) > rows  # what a camera sees of a stopped robot is recorded too
        rows = len(rig.recorder)
        assert rows_on_disk(rig) == rows
        rig.prototype.record(None)
        assert len(rig.recorder.stop().t) == rows


@pytest.mark.study
@pytest.mark.parametrize("name", INJECTIONS)
def test_a_release_waits_for_the_end_of_the_cause(name: str, tmp_path: Path) -> None:
    inject, _ = INJECTIONS[name]
    # a stall that is found early leaves no tension that keeps the robot stopped
    slow = {"rate": 0.005, "following_error": 1e-4} if name == "following error" else {}
    with moving(tmp_path, 0.75, **slow) as rig:
        inject(rig, 3)
        rig.wait(2.0, rig.stopped)
        rig.wait(0.5)
        if name not in ONCE:
            rig.prototype.release()
            assert rig.stopped()
            assert not any(enabled(rig))
        rig.repair()
        rig.wait(0.6)
        assert rig.stopped()  # no cause is there any more, and still it waits for a person
        assert not any(enabled(rig))
        where = rig.drives.true_pulled
        rig.prototype.release()
        # its counter is lost: only a new start, with its homing, helps
        if name in ("node reboot", "encoder jump"):
            assert rig.stopped()
            assert "where its tendon is may be lost" in rig.prototype.read().problem
            return
        assert rig.prototype.supervisor.state is SafetyState.READY
        assert all(enabled(rig))
        np.testing.assert_allclose(rig.drives.true_pulled, where, atol=2e-6)  # nothing moves by it
        assert rig.prototype.journal.lines[-1][1] == "release"
        rig.radius = 0.001
        # on so small a circle drives stand between two commands: all at once are not always seen moving
        seen = [rig.drives.moving]
        rig.wait(0.5, lambda: seen.append(rig.drives.moving) is not None)
        assert not rig.stopped(), rig.prototype.supervisor.status
        assert np.any(seen, axis=0).all()


def test_the_stop_is_in_time_at_the_largest_rate_too(tmp_path: Path) -> None:
    with moving(tmp_path, 0.3, rate=0.03, following_error=1e-3) as rig:
        rig.radius = 0.0058
        rig.prototype.command(np.array([0.0058, 0.0058, -0.0058, -0.0058]))
        rig.prototype.wait(0.1)
        assert rig.prototype.readings is not None
        assert np.abs(rig.prototype.readings.rate).max() > 0.98 * rig.prototype.hardware.limits.rate
        rig.prototype.stop()
        t = rig.clock.now()
        with suppress(DeviceError):
            rig.prototype.wait(0.01)
        rig.wait(0.2)
        assert not rig.drives.moving.any()
        assert np.nanmax(rig.drives.stopped_at) - t <= SAFE


def test_a_jump_beyond_the_drives_own_window_is_named_as_a_jump(tmp_path: Path) -> None:
    with moving(tmp_path, 0.75) as rig:
        rig.drives.encoder_jump(2, 5000)
        rig.wait(0.5, rig.stopped)
        faults = [fault.kind for fault in rig.prototype.supervisor.faults]
        assert faults[:1] == ["encoder jump"]
        assert "emergency message" in faults  # the drive's own following error
        assert [line[1] for line in rig.prototype.journal.lines] == faults


def test_a_controller_that_pauses_is_stopped_when_it_comes_back(tmp_path: Path) -> None:
    with moving(tmp_path, 0.75) as rig:
        rig.clock.sleep_until(rig.clock.now() + 0.08)
        rig.wait(0.1, rig.stopped)
        fault = rig.prototype.supervisor.first
        assert fault is not None
        assert fault.kind == "controller stalled"
        rig.wait(0.2)
        assert not rig.drives.moving.any()
        assert not any(enabled(rig))


def test_drives_whose_controller_is_gone_stop_by_themselves(tmp_path: Path) -> None:
    import can

    with moving(tmp_path, 0.75) as rig:
        rows, t = len(rig.recorder), rig.clock.now()
        with can.Bus(interface="virtual", channel=rig.bus.split(":")[1]) as other:
            # another SYNC goes on, by which the drives keep time; targets and heartbeats do not come any more
            for _ in range(100):
                rig.clock.sleep_until(rig.clock.now() + 0.01)
                other.send(can.Message(arbitration_id=0x80, is_extended_id=False))
                _heard(other, 8)
        assert not any(enabled(rig))
        assert not rig.drives.moving.any()
        assert (rig.drives.missed_at - t < 0.151).all()
        assert (rig.drives.stopped_at - rig.drives.missed_at <= SAFE).all()
        assert rows_on_disk(rig) == rows


def _heard(bus: object, frames: int) -> None:
    """All have answered."""
    import can

    assert isinstance(bus, can.BusABC)
    got = 0
    while got < frames:
        message = bus.recv(2.0)
        assert message is not None
        got += 0x180 < message.arbitration_id < 0x300


@pytest.mark.study
@pytest.mark.real_time
def test_a_killed_process_leaves_its_drives_stopped_and_its_rows_on_disk(tmp_path: Path) -> None:
    trial = kill(1, tmp_path)
    assert trial.named, trial.sentence
    assert trial.rows >= 8
    assert trial.lost == 0
    assert trial.rest <= SAFE
    assert not trial.again
