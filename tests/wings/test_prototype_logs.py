"""The prototype as a robot link: what it records, and what happens to its logs."""

from __future__ import annotations

import csv
import shutil
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from benches import started

from fastrod.errors import InputError
from fastrod.logs.reader import read_log
from fastrod.logs.recording import recover
from fastrod.types import Floats
from fastrod_device.can.clock import Clock
from fastrod_device.hardware import load_hardware
from fastrod_device.journal import Journal
from fastrod_device.prototype import EXTRA
from fastrod_device.readings import Trace
from fastrod_device.safety import SafetyState

pytest.importorskip("canopen", reason="canopen is not installed: pip install 'fastrod[device]'")
pytest.importorskip("cv2", reason="opencv-python-headless is not installed: pip install 'fastrod[device]'")

HARDWARE = load_hardware()


def bench(clock: Clock | None = None, *, hardware: Any = HARDWARE, **how: Any) -> Any:
    """See `benches.started`, of the prototype's own hardware."""
    return started(hardware, clock, **how)


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
