"""The prototype as a robot link: what it is commanded, what it records, what homing finds, how it starts and
ends."""

from __future__ import annotations

import csv
import shutil
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from benches import started

from fastrod.errors import InputError
from fastrod.logs.link import RobotLink
from fastrod.logs.recording import recover
from fastrod.logs.runlog import read_log
from fastrod.types import Floats
from fastrod_device.camera import CameraFrame, Picture
from fastrod_device.clock import Clock, SteppedClock, WallClock
from fastrod_device.columns import EXTRA, FLAGS
from fastrod_device.drawing import DrawnScene, Eye
from fastrod_device.emulator import Emulator
from fastrod_device.errors import DeviceError, RefusedError
from fastrod_device.hardware import load_hardware
from fastrod_device.journal import Journal
from fastrod_device.prototype import Prototype
from fastrod_device.readings import Trace
from fastrod_device.safety import SafetyState
from fastrod_device.workbench import emulated

pytest.importorskip("canopen", reason="canopen is not installed: pip install 'fastrod[device]'")
pytest.importorskip("cv2", reason="opencv-python-headless is not installed: pip install 'fastrod[device]'")

HARDWARE = load_hardware()
# in real time a busy machine is no fault
_YOUNG = {
    "feedback_age": 5.0,
    "heartbeat_age": 9.0,
    "cycle": 5.0,
    "command_age": 9.0,
    "clock_jump": 9.0,
    "sighting_age": None,
}
PATIENT = replace(
    HARDWARE, limits=replace(HARDWARE.limits, encoder_jump=0.05, following_error=0.05, **_YOUNG)
)
BENT = np.array([-0.002, 0.001, 0.002, -0.001])


def bench(clock: Clock | None = None, *, hardware: Any = HARDWARE, **how: Any) -> Any:
    """As `benches.started`, of the prototype's own hardware."""
    return started(hardware, clock, **how)


@contextmanager
def overheard(prototype: Prototype, emulator: Emulator) -> Iterator[list[tuple[int, ...]]]:
    """Targets [counts] as they pass on the bus, a row for each cycle."""
    rows: list[tuple[int, ...]] = []
    lock, row = threading.Lock(), [0] * 4
    network = emulator.drives._line.network

    def hear(cob_id: int, data: bytearray, _: float) -> None:
        with lock:
            row[cob_id - 0x201] = struct.unpack("<Hi", data)[1]
            if cob_id == 0x204:
                rows.append(tuple(row))

    for cob_id in range(0x201, 0x205):
        network.subscribe(cob_id, hear)
    yield rows
    for cob_id in range(0x201, 0x205):
        network.unsubscribe(cob_id, hear)
    assert prototype.drives.n_drives == 4


# a link


def test_it_is_a_robot_link_and_goes_where_it_is_told() -> None:
    with bench() as (prototype, _):
        assert isinstance(prototype, RobotLink)
        assert prototype.real
        prototype.command(BENT)
        prototype.wait(0.5)
        np.testing.assert_allclose(prototype.read().dl, BENT, atol=2e-6)
        np.testing.assert_allclose(prototype.commanded, BENT, atol=1e-12)
        assert prototype.read().problem == ""
        assert np.linalg.norm(prototype.read().tip_position) > 0.06


def test_stop_holds_it_and_release_lets_it_go_on_from_where_it_stands() -> None:
    with bench() as (prototype, emulator):
        prototype.command(BENT)
        prototype.wait(0.03)
        prototype.stop()
        prototype.stop()
        for _ in range(30):
            with pytest.raises(DeviceError, match="emergency stop"):
                prototype.wait(0.01)
        where = emulator.drives.true_pulled
        prototype.command(np.zeros(4))  # ignored
        assert "emergency stop" in prototype.read().problem
        prototype.release()
        prototype.wait(0.3)
        np.testing.assert_allclose(emulator.drives.true_pulled, where, atol=2e-6)
        prototype.command(BENT)
        prototype.wait(0.4)
        np.testing.assert_allclose(-emulator.drives.true_pulled, BENT, atol=3e-6)


def test_a_release_of_what_is_not_stopped_does_nothing() -> None:
    with bench() as (prototype, _):
        prototype.release()
        assert prototype.supervisor.state is SafetyState.READY


# what it refuses


@pytest.mark.parametrize(
    ("reported", "words"),
    [
        ({"dl": [-0.0081, 0.0, 0.0081, 0.0]}, "the limit is|limit is 8 mm"),
        ({"dl": [0.0, np.nan, 0.0, 0.0]}, "tendon 2 was commanded nan m"),
        ({"dl": [0.0, 0.0, np.inf, 0.0]}, "tendon 3 was commanded inf m"),
        ({"dl": [0.0, 0.0, 0.0]}, "shape"),
        ({"dl": ["a", 0.0, 0.0, 0.0]}, "4 numbers"),
        ({"dl": BENT, "ext": [0.001]}, "extend"),
        ({"dl": BENT, "age": 0.6}, "meant 600 ms ago"),
        ({"dl": BENT, "age": -0.6}, "meant -600 ms ago"),
    ],
)
def test_what_is_refused_never_reaches_the_bus(reported: dict[str, Any], words: str) -> None:
    with bench() as (prototype, emulator):
        prototype.wait(0.1)
        stamp = prototype.clock.now() - reported["age"] if "age" in reported else None
        with overheard(prototype, emulator) as rows:
            with pytest.raises(RefusedError, match=words):
                prototype.command(reported["dl"], reported.get("ext"), stamp=stamp)
            prototype.wait(0.2)
        assert len(rows) >= 20
        assert len(set(rows)) == 1
        assert prototype.supervisor.state is SafetyState.READY  # and it does not stop by it


def test_set_points_keep_to_the_rate_however_far_the_command_is() -> None:
    with bench() as (prototype, emulator), overheard(prototype, emulator) as rows:
        prototype.command([-0.007, 0.0, 0.007, 0.0])
        prototype.wait(0.4)
        steps = np.abs(np.diff(np.array(rows), axis=0)) * HARDWARE.drives[0].metres_per_count
        assert steps.max() <= HARDWARE.limits.rate / HARDWARE.rate + 1e-6
        assert steps.max() > 0.99 * HARDWARE.limits.rate / HARDWARE.rate


def test_a_command_that_nobody_renews_while_the_robot_moves_stops_it() -> None:
    slow = replace(HARDWARE, limits=replace(HARDWARE.limits, rate=0.01, command_age=0.2))
    with bench(hardware=slow) as (prototype, _):
        prototype.command([-0.006, 0.0, 0.006, 0.0])
        with pytest.raises(DeviceError, match=r"command that is 2\d\d ms old"):
            prototype.wait(1.0)


# plans


def test_an_exception_in_a_plan_stops_the_drives() -> None:
    def plan(t: float) -> Floats:
        if t > 0.2:
            raise KeyError("no such place")
        return 4.0 * t * BENT

    with bench() as (prototype, emulator):
        with pytest.raises(KeyError):
            prototype.follow(plan, 1.0)
        assert prototype.supervisor.state is SafetyState.STOPPED
        for _ in range(30):
            with pytest.raises(DeviceError, match="KeyError"):
                prototype.wait(0.01)
        assert not emulator.drives.moving.any()
        assert prototype.journal.lines[0][1] == "exception"


def test_a_plan_that_leads_beyond_a_limit_is_refused_and_stops_the_drives() -> None:
    with bench() as (prototype, _):
        with pytest.raises(RefusedError, match="limit is 8 mm"):
            prototype.follow(lambda t: np.array([-0.02, 0.0, 0.02, 0.0]) * t, 1.0)
        assert prototype.supervisor.state is SafetyState.STOPPED
        assert np.abs(prototype.commanded).max() <= 0.008


def test_a_recording_that_cannot_go_on_stops_the_drives_in_stepped_time_too(tmp_path: Any) -> None:
    with bench() as (prototype, _):
        recorder = prototype.recorder_for(tmp_path / "log.csv")
        recorder.start(prototype.elapsed)
        prototype.record(recorder)
        prototype.payload = np.ones(2)  # no number: the row cannot be made
        with pytest.raises((InputError, ValueError)):
            prototype.wait(1.0)
        assert prototype.supervisor.state is SafetyState.STOPPED


# what it records


def test_rows_have_the_wires_of_the_moment_of_exposure(tmp_path: Any) -> None:
    with bench() as (prototype, emulator):
        true: list[tuple[float, Floats]] = []
        recorder = prototype.recorder_for(tmp_path / "log.csv")
        recorder.start(prototype.elapsed)
        prototype.record(recorder)
        prototype.payload = 0.01
        began = prototype.clock.now()
        while prototype.clock.now() < began + 2.0:
            angle = 3.0 * (prototype.clock.now() - began)
            prototype.command(0.003 * np.sin(angle) * np.array([1.0, -0.5, -1.0, 0.5]))
            prototype.wait(0.01)
            assert prototype.readings is not None
            true.append((prototype.readings.t - prototype._zero, -emulator.drives.true_pulled))
        prototype.record(None)
        rows = len(recorder)
        log = recorder.stop()
        times, lengths = np.array([t for t, _ in true]), np.array([dl for _, dl in true])
        offset = began - prototype._zero
        expected = np.stack([np.interp(log.t + offset, times, lengths[:, k]) for k in range(4)], axis=1)
        late = log.t > 0.1
        # the plant lives between two cycles by the same straight lines; a count is 0.6 um, a cycle of lag
        # would be 90 um
        np.testing.assert_allclose(log.dl[late], expected[late], atol=4e-6)
        assert rows == len(log.t) >= 28
        assert {*EXTRA, "current_1", "current_4"} <= set(log.extra)
        assert {"cmd_dl_1", "tension_4"} <= set(log.extra)
        np.testing.assert_array_equal(log.extra["marker_flag"], 0.0)
        assert log.payload is not None
        np.testing.assert_array_equal(log.payload, 0.01)
        np.testing.assert_array_equal(log.extra["seen_z"], log.tip_position[:, 2])
        again = read_log(tmp_path / "log.csv", prototype.robot)
        np.testing.assert_array_equal(again.dl, log.dl)


def test_a_covered_marker_is_recorded_as_such_and_not_as_a_tip(tmp_path: Any) -> None:
    with bench() as (prototype, emulator):
        prototype.wait(0.3)
        emulator.hidden = True
        recorder = prototype.recorder_for(tmp_path / "log.csv")
        recorder.start(prototype.elapsed)
        prototype.record(recorder)
        prototype.wait(0.3)
        assert np.isnan(prototype.read().tip_position).all()
        log = recorder.stop()
        assert log.extra["marker_flag"][-1] == 1.0
        assert np.isnan(log.tip_position[-1]).all()


def test_a_recording_that_is_ended_while_frames_come_stops_nothing(tmp_path: Any) -> None:
    with bench() as (prototype, _):
        recorder = prototype.recorder_for(tmp_path / "log.csv")
        recorder.start(prototype.elapsed)
        prototype.record(recorder)
        prototype.wait(0.3)
        recorder.stop()
        prototype.wait(0.3)
        assert prototype.supervisor.state is SafetyState.READY


def test_a_trace_goes_straight_between_its_points() -> None:
    trace = Trace(2, 3)
    assert np.isnan(trace.at(1.0)[0]).all()
    for t in range(5):  # the oldest two are forgotten
        trace.add(float(t), np.array([t, 2.0 * t]), np.array([-t, 0.0]))
    np.testing.assert_allclose(trace.at(2.5), [[2.5, 5.0], [-2.5, 0.0]])
    np.testing.assert_allclose(trace.at(0.0)[0], [2.0, 4.0])  # before the first: the first
    np.testing.assert_allclose(trace.at(9.0)[0], [4.0, 8.0])
    trace.clear()
    assert np.isnan(trace.at(3.0)[1]).all()


def test_a_journal_writes_its_lines_at_once(tmp_path: Any) -> None:
    journal = Journal(tmp_path / "events.csv")
    journal.write(1.5, "tension", 'drive 1 says "too much", and more.')
    assert (tmp_path / "events.csv").read_text() == '1.5000,tension,"drive 1 says ""too much"", and more."\n'
    journal.close()
    journal.close()
    with pytest.raises(InputError, match="cannot be written"):
        Journal(tmp_path / "nowhere" / "events.csv")


# what its camera may do to it


class Attack:
    """Does nothing to frames until it is `on`; then keeps them, and changes each."""

    def __init__(self) -> None:
        self.eye = Eye(HARDWARE.camera, HARDWARE.marker, seed=1, scene=DrawnScene(blur=1.0, noise=5.0))
        self.on, self.n, self.bad, self.frames = False, 0, 0, list[CameraFrame]()

    def __call__(self, frame: CameraFrame) -> CameraFrame:
        self.frames.append(frame)
        self.n += self.on
        made = self.changed(frame) if self.on else frame
        self.bad += made is not frame
        return made

    def changed(self, frame: CameraFrame) -> CameraFrame:
        return frame

    def old(self) -> CameraFrame:
        """From when the robot stood elsewhere."""
        return self.frames[self.n // 2]

    def corner(self) -> Picture:
        return self.eye.draw(np.array([0.07, -0.05, -0.008]), np.array([1.0, 0.0, 0.0, 0.0]))


class Corner(Attack):
    """The marker is covered; one of its number lies in the picture's corner, 114 mm off."""

    def changed(self, frame: CameraFrame) -> CameraFrame:
        return replace(frame, image=self.corner())


class Two(Attack):
    """Both are seen."""

    def changed(self, frame: CameraFrame) -> CameraFrame:
        other = self.corner()
        return replace(frame, image=np.where(np.arange(other.shape[1]) < 180, other, frame.image))


class Alternating(Attack):
    """Every second frame is an old picture, stamped anew."""

    def changed(self, frame: CameraFrame) -> CameraFrame:
        return replace(frame, image=self.old().image) if self.n % 2 else frame


class Back(Attack):
    """Every second frame is an old one."""

    def changed(self, frame: CameraFrame) -> CameraFrame:
        return replace(self.old(), number=frame.number) if self.n % 2 else frame


class Future(Attack):
    """One frame is stamped in the future."""

    def changed(self, frame: CameraFrame) -> CameraFrame:
        return replace(frame, t=frame.t + 1e3) if self.n == 1 else frame


@pytest.mark.parametrize("recorded", [True, False])
@pytest.mark.parametrize(
    ("attack", "flag", "goes_on"),
    [
        (Corner, "outside the workspace", False),
        (Two, "two markers", False),
        (Alternating, "repeated", True),
        (Back, "out of order", True),
        (Future, "from the future", True),
    ],
)
def test_a_camera_that_cannot_be_believed_is_flagged_and_marker_lost_stays_armed(
    attack: type[Attack], flag: str, goes_on: bool, recorded: bool, tmp_path: Any
) -> None:
    made = attack()
    with bench(change=made) as (prototype, emulator):
        recorder = prototype.recorder_for(tmp_path / "log.csv")
        if recorded:
            recorder.start(prototype.elapsed)
            prototype.record(recorder)
        began = prototype.clock.now()
        prototype.command(BENT)
        prototype.wait(1.0)
        prototype.command(-BENT)
        prototype.wait(0.5)
        made.on = True
        with suppress(DeviceError):
            prototype.wait(2.0)
        assert (prototype.supervisor.state is not SafetyState.STOPPED) == goes_on, prototype.supervisor.status
        emulator.hidden = True
        hidden = prototype.clock.now()
        with pytest.raises(DeviceError):
            prototype.wait(1.0)
        fault = prototype.supervisor.first
        assert fault is not None
        assert (fault.kind, fault.t - hidden < HARDWARE.limits.sighting_age + 0.02) == ("marker lost", True)
        assert goes_on or f"the newest picture is flagged {flag!r}" in fault.sentence
        if not recorded:
            return
        rows = len(recorder)
        log = recorder.stop()
        flags = np.array([FLAGS[int(value)] for value in log.extra["marker_flag"]])
        assert rows == len(log) == sum(frame.t >= began for frame in made.frames)
        assert set(flags) <= {"", flag, "no marker", "ambiguous"}
        assert (flags == flag).sum() == made.bad >= (1 if attack is Future else 7)
        assert np.isnan(log.tip_position[flags != ""]).all()
        seen = np.stack([log.extra[f"seen_{axis}"] for axis in "xyz"], axis=1)
        if flag == "outside the workspace":  # what was refused is in the log
            assert np.linalg.norm(seen[flags == flag] - (0.07, -0.05, -0.008), axis=1).max() < 3e-3
        assert np.linalg.norm(log.tip_position[flags == ""], axis=1).max() < 0.0705


@pytest.mark.parametrize("raising", ["quick_stop", "close", "camera"])
def test_an_adapter_that_raises_as_it_closes_keeps_nothing_open(
    raising: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise ValueError("the handle\nis invalid")

    closed = []
    with bench(change=lambda frame: frame) as (prototype, _):
        assert prototype.source is not None
        shut = broken if raising == "camera" else lambda: closed.append("camera")
        monkeypatch.setattr(prototype.source, "close", shut)
        if raising != "camera":
            ends = getattr(prototype.drives, raising)
            monkeypatch.setattr(prototype.drives, raising, broken)
        prototype.close()
        sentence = "closing failed: ValueError: the handle is invalid."
        assert prototype.journal.lines[-1][1:] == ("exception", sentence)
        assert isinstance(prototype.broken, ValueError)
        assert closed == ([] if raising == "camera" else ["camera"])
        if raising != "camera":
            ends()


# what happens to its logs


@pytest.mark.parametrize("renamed", [False, True])
def test_logs_whose_folder_goes_away_go_on_in_a_new_one(renamed: bool, tmp_path: Any) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with bench(journal=Journal(folder / "events.csv")) as (prototype, _):
        prototype.journal.write(0.0, "release", "a person released the robot.")
        recorder = prototype.recorder_for(folder / "log.csv")
        recorder.start(prototype.elapsed)
        prototype.record(recorder)
        prototype.wait(0.5)
        if renamed:
            folder.rename(tmp_path / "elsewhere")
        else:
            shutil.rmtree(folder)
        gone, rows = prototype.clock.now(), len(recorder)
        prototype.wait(0.5)
        assert prototype.supervisor.state is SafetyState.READY
        (t, kind, sentence) = prototype.journal.lines[-1]
        assert kind == "recording"
        assert t - gone < 0.1  # with the next frame
        assert f"all {rows + 1} rows are in {str(folder / 'log.csv.part')!r} now" in sentence
        with (folder / "events.csv").open(newline="") as file:
            assert [line[1] for line in csv.reader(file)] == ["release", "recording"]
        prototype.record(None)
        rows = len(recorder)
        log = recorder.stop()
        assert rows == len(log) == len(read_log(folder / "log.csv", prototype.robot))


def test_a_full_disk_stops_the_robot_and_both_logs_say_so(small_disk: Any) -> None:
    log, events = small_disk / "log.csv", small_disk / "events.csv"
    with bench(journal=Journal(events)) as (prototype, _):
        recorder = prototype.recorder_for(log)
        recorder.start(prototype.elapsed)
        prototype.record(recorder)
        prototype.wait(0.5)
        with (small_disk / "filler").open("wb", buffering=0) as filler, suppress(OSError):
            while True:
                filler.write(bytes(512))
        with pytest.raises(InputError, match="No space left on device"):
            prototype.wait(5.0)
        assert prototype.supervisor.state is SafetyState.STOPPED
        n = len(recorder)
        why = "log.csv.part cannot be written: No space left on device"
        words = f"{why}; {n - 1} of its {n} rows are in log.csv.part."
        with events.open(newline="") as file:
            assert [line[1:] for line in csv.reader(file)] == [["exception", f"the program failed: {words}"]]
        prototype.record(None)
        with pytest.raises(InputError, match="No space left on device"):
            recorder.stop()
    (small_disk / "filler").unlink()
    assert len(recover(log)) == n - 1


@pytest.mark.parametrize("unseen", [True, False], ids=["behind the file's end", "spare file"])
def test_a_journals_room_is_reserved_unseen_and_given_back(
    unseen: bool, small_disk: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not unseen:
        monkeypatch.setattr("fastrod_device.journal._reserved", lambda *_: False)
    path = small_disk / "events.csv"
    journal = Journal(path)
    assert path.read_bytes() == b""
    with (small_disk / "filler").open("wb", buffering=0) as filler:
        with suppress(OSError):
            while True:
                filler.write(bytes(512))
        for k in range(100):
            journal.write(float(k), "exception", f"line {k} of a disk that is full.")
            with suppress(OSError):  # another program wants the room too
                filler.write(bytes(64))
    text = "".join(f"{k}.0000,exception,line {k} of a disk that is full.\n" for k in range(100))
    assert path.read_text() == text
    journal.close()
    assert path.read_text() == text
    assert sorted(file.name for file in small_disk.iterdir()) == ["events.csv", "filler"]
    assert path.stat().st_blocks * 512 - len(text) < 4096
    with (small_disk / "filler").open("ab", buffering=0) as filler, suppress(OSError):
        while True:
            filler.write(bytes(512))
    with pytest.raises(InputError, match="No space left on device"):  # no session begins on a full disk
        Journal(small_disk / "more.csv")
    assert sorted(file.name for file in small_disk.iterdir()) == ["events.csv", "filler"]


def test_a_journal_that_an_editor_has_replaced_is_added_to(tmp_path: Any) -> None:
    path = tmp_path / "events.csv"
    journal = Journal(path)
    journal.write(1.0, "tension", "a.")
    (tmp_path / "saved").write_text("1.0000,tension,a.  # my note\n")
    (tmp_path / "saved").replace(path)
    journal.write(2.0, "release", "b.")
    journal.close()
    assert path.read_text() == "1.0000,tension,a.  # my note\n2.0000,release,b.\n"


# starting and ending


@pytest.mark.parametrize("effect", ["none", "friction"])
def test_homing_finds_where_the_robot_is_straight(effect: str) -> None:
    with emulated(HARDWARE, seed=2, effect=effect) as made:
        prototype, emulator = made.prototype, made.emulator
        assert emulator is not None
        true = -(emulator.drives.true_pulled - emulator._slack)  # tendon beyond the slack
        bending = 0.5 * (true[:2] - true[2:])
        assert np.abs(bending).max() < 3e-5  # m
        assert (true < 0.0).all()  # every tendon is pulled
        assert np.abs(prototype.readings.dl if prototype.readings is not None else np.zeros(4)).max() < 1e-6
        assert [tendon.pretension for tendon in prototype.robot.segments[0].tendons] == pytest.approx(
            [1.0] * 4, abs=0.35
        )


def test_it_works_without_a_camera() -> None:
    with bench(camera=False) as (prototype, _):
        prototype.command(BENT)
        prototype.wait(1.0)
        reading = prototype.read()
        np.testing.assert_allclose(reading.dl, BENT, atol=2e-6)
        assert np.isnan(reading.tip_position).all()
        assert np.isfinite(reading.tension).all()


@pytest.mark.parametrize("stepped", [True, False])
def test_drives_that_are_not_there_are_one_sentence(stepped: bool) -> None:
    with Prototype(
        HARDWARE, "virtual:nobody", None, clock=SteppedClock() if stepped else WallClock()
    ) as prototype:
        with pytest.raises(DeviceError, match="node 1 does not answer") as error:
            prototype.start()
        assert "\n" not in str(error.value)
        with pytest.raises(DeviceError, match="call start first"):
            Prototype(HARDWARE, "virtual:nobody", None, clock=SteppedClock()).wait(1.0)


def test_a_bus_that_is_not_there_is_one_sentence() -> None:
    with pytest.raises(DeviceError, match="no CAN interface 'soketcan'"):
        Prototype(HARDWARE, "soketcan:can0", None)


def test_close_is_idempotent_and_switches_the_drives_off() -> None:
    with bench(camera=False) as (prototype, emulator):
        prototype.command(BENT)
        prototype.wait(0.05)
        prototype.close()
        prototype.close()
        assert set(emulator.drives.states) == {"switch on disabled"}
        assert not emulator.drives.moving.any()
        prototype.stop()  # never raises


def test_an_error_in_the_block_closes_it() -> None:
    def fails() -> None:
        with bench(camera=False) as (prototype, emulator):
            made.append(emulator)
            prototype.command(BENT)
            prototype.wait(0.05)
            raise ZeroDivisionError

    made: list[Emulator] = []
    with pytest.raises(ZeroDivisionError):
        fails()
    (emulator,) = made
    assert set(emulator.drives.states) == {"switch on disabled"}


# in real time


def _until(true: Any, seconds: float = 20.0) -> bool:
    end = time.monotonic() + seconds
    while not true() and time.monotonic() < end:
        time.sleep(0.01)
    return bool(true())


@pytest.mark.real_time
def test_a_story_in_real_time(tmp_path: Any) -> None:
    before = threading.active_count()
    with bench(WallClock(), hardware=PATIENT) as (prototype, emulator):
        recorder = prototype.recorder_for(tmp_path / "log.csv")
        recorder.start(prototype.elapsed)
        prototype.record(recorder)
        prototype.command(BENT)
        reached = _until(lambda: np.allclose(prototype.read().dl, BENT, atol=5e-6) and len(recorder) > 3)
        assert reached, prototype.supervisor.status
        prototype.follow(lambda t: BENT * np.cos(2.0 * t), 0.5)
        prototype.stop()
        with pytest.raises(DeviceError, match="emergency stop was pressed"):
            prototype.wait(1.0)
        assert _until(lambda: not emulator.drives.moving.any())
        prototype.command(np.zeros(4))  # ignored
        prototype.release()
        assert _until(lambda: prototype.supervisor.state is SafetyState.READY)
        prototype.command(np.zeros(4))
        assert _until(lambda: np.allclose(prototype.read().dl, 0.0, atol=5e-6))
        assert prototype.broken is None
        prototype.record(None)
        assert len(recorder.stop().t) > 3
        kinds = [line[1] for line in prototype.journal.lines]
        assert (kinds[0], kinds[-1]) == ("emergency stop", "release")
    assert _until(lambda: threading.active_count() <= before)


@pytest.mark.real_time
def test_follow_in_real_time_tells_what_stopped_it() -> None:
    with bench(WallClock(), hardware=PATIENT) as (prototype, emulator):
        with pytest.raises(RefusedError, match="limit is 8 mm"):
            prototype.follow(lambda t: np.array([-0.1, 0.0, 0.1, 0.0]) * t, 30.0)
        prototype.release()
        assert _until(lambda: prototype.supervisor.state is SafetyState.READY)
        with pytest.raises(DeviceError, match="ZeroDivisionError"):
            prototype.follow(lambda t: np.zeros(4) / (0 if t > 0.1 else 1) if t < 0.1 else 1 // 0, 30.0)
        prototype.release()
        assert _until(lambda: prototype.supervisor.state is SafetyState.READY)
        threading.Timer(0.2, lambda: emulator.drives.emergency(1, 0x3210)).start()
        with pytest.raises(DeviceError, match=r"node 2.*0x3210"):
            prototype.follow(lambda t: BENT * np.sin(t), 30.0)
        assert _until(lambda: not emulator.drives.moving.any())


@pytest.mark.real_time
def test_a_plan_that_hangs_is_found_by_the_watchdog_and_the_drives_stop() -> None:
    over, quick = threading.Event(), replace(PATIENT, limits=replace(PATIENT.limits, cycle=0.4))

    def plan(t: float) -> Floats:
        if t > 0.1:
            over.wait(20.0)
        return BENT * np.sin(t)

    with bench(WallClock(), hardware=quick) as (prototype, emulator):
        with pytest.raises(DeviceError, match="the controller stood still for"):
            prototype.follow(plan, 30.0)
        assert not over.is_set()  # the thread that drives still hangs
        assert prototype.journal.lines[0][1] == "controller stalled"
        assert _until(lambda: set(emulator.drives.states) == {"quick stop active"})
        with suppress(RefusedError):
            prototype.command(BENT)
        prototype.read()
        over.set()
        assert _until(lambda: not emulator.drives.moving.any())
        assert prototype.supervisor.state is SafetyState.STOPPED
        assert set(emulator.drives.states) == {"quick stop active"}


def test_a_glide_spreads_a_command_evenly() -> None:
    with bench() as (robot, _):
        robot.glide(BENT, 0.4)
        reported = []
        for _ in range(60):
            robot.wait(0.01)
            reported.append(robot.commanded)
        steps = np.abs(np.diff(reported, axis=0)).max(axis=1)
        even = np.abs(BENT).max() / 0.4 * 0.01
        np.testing.assert_allclose(steps[:38], even, rtol=1e-6)
        np.testing.assert_allclose(reported[-1], BENT, rtol=0, atol=1e-9)
        with pytest.raises(RefusedError, match="positive time"):
            robot.glide(np.zeros(4), 0.0)


def test_the_picture_shows_the_marker_in_its_outline() -> None:
    with bench() as (robot, _):
        assert robot.picture() is None
        robot.wait(0.5)
        shown = robot.picture()
        assert shown is not None
        assert shown.shape == (*HARDWARE.camera.size[::-1], 3)
        red, green, blue = (shown[:, :, k].astype(int) for k in range(3))
        outline = (green > red + 60) & (green > blue + 40)
        assert robot.sighting is not None
        where = np.argwhere(outline)[:, ::-1]
        np.testing.assert_allclose(where.min(axis=0), robot.sighting.corners.min(axis=0), atol=3.0)
        np.testing.assert_allclose(where.max(axis=0), robot.sighting.corners.max(axis=0), atol=3.0)


def test_a_release_that_is_older_than_a_stop_releases_nothing() -> None:
    with bench() as (robot, emulator):
        robot.stop()
        with suppress(DeviceError):
            robot.wait(0.1)
        # as by release(), in a thread that comes to it late
        robot._jobs.put(lambda stops=robot._stops: robot._release(stops))
        robot.stop()
        with suppress(DeviceError):
            robot.wait(0.1)
        assert robot.supervisor.state is SafetyState.STOPPED
        assert not emulator.drives.moving.any()
        robot.release()
        robot.wait(0.05)
        assert robot.supervisor.state is SafetyState.READY


def test_hands_may_cover_the_marker_while_it_rests() -> None:
    with bench() as (robot, emulator):
        robot.wait(0.5)
        with robot.resting():
            emulator.hidden = True
            robot.wait(2.0)  # four times as long as a marker may be lost in motion
            emulator.hidden = False
        assert robot.supervisor.state in (SafetyState.READY, SafetyState.RUNNING)
        assert robot.sighting is not None
        assert robot.sighting.ok


def test_a_marker_that_stays_covered_stops_the_robot() -> None:
    with bench() as (robot, emulator):
        robot.wait(0.5)
        with pytest.raises(DeviceError, match="was not seen for 20 s"), robot.resting():
            emulator.hidden = True
        with pytest.raises(DeviceError, match="marker lost"):
            robot.wait(1.0)


def test_a_stop_that_cannot_be_sent_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    with bench() as (robot, _):

        def broken(*_: object) -> None:
            raise OSError("the adapter is gone")

        with monkeypatch.context() as patch:
            patch.setattr(robot.drives._line, "send", broken)
            robot.stop()
        assert "THE STOP COULD NOT BE SENT" in robot.supervisor.status
        assert "the adapter is gone" in robot.supervisor.status
