"""The emulated prototype in a real browser: driven, stopped, released, left alone, recorded."""

import contextlib
import queue
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from subprocess import PIPE, Popen

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from pages import DRIVE
from windows import PATIENCE, Window

from fastrod.logs.reader import read_log
from fastrod_device.bench.workbench import EmulatedBench, emulated
from fastrod_device.errors import DeviceError
from fastrod_device.hardware import load_hardware
from fastrod_viewer.app import App
from fastrod_viewer.drive.page import DrivePage
from fastrod_viewer.worlds.simulated import FreeWorld

Windows = Callable[..., Window]
FREEZE = "() => { setTimeout(() => { const end = Date.now() + 9000; while (Date.now() < end); }, 0); }"
CYCLE = 0.01
STANDS = 2e-5  # m of a tendon: what noise of the plant and the drives' regulators leave


class Paced:
    """The emulated prototype in stepped time: on the busiest machine no cycle of its own is late."""

    real = True

    def __init__(self, setup: EmulatedBench) -> None:
        self.prototype = made = setup.prototype
        self.robot, self.supervisor = made.robot, made.supervisor
        self.clock, self.source = made.clock, made.source
        self.command, self.read, self.stop = made.command, made.read, made.stop
        self.recorder_for, self.record = made.recorder_for, made.record
        self.requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    commanded = property(lambda self: self.prototype.commanded)
    readings = property(lambda self: self.prototype.readings)
    sighting = property(lambda self: self.prototype.sighting)
    elapsed = property(lambda self: self.prototype.elapsed)

    def release(self) -> None:
        self.requests.put(self.prototype.release)

    def picture(self) -> NDArray[np.uint8] | None:
        return np.full((480, 640, 3), (20, 200, 40), dtype=np.uint8)

    def close(self) -> None:
        self.ended.set()
        if self.thread is not threading.current_thread():
            self.thread.join(timeout=10.0)
        self.prototype.close()

    def _run(self) -> None:
        while not self.ended.is_set():
            began = time.perf_counter()
            with contextlib.suppress(queue.Empty):
                self.requests.get_nowait()()
            with contextlib.suppress(DeviceError):  # it has stopped; its page says so
                self.prototype.wait(CYCLE)
            self.ended.wait(max(CYCLE - (time.perf_counter() - began), 0.0))

    def change(self) -> np.ndarray:
        """(4,) where the drives say they are [m]."""
        assert self.readings is not None
        return np.array(self.readings.dl)


class Bed:
    """A prototype, its page, and a window."""

    def __init__(self, setup: EmulatedBench, app: App) -> None:
        assert setup.emulator is not None
        self.app, self.emulator, self.link = app, setup.emulator, Paced(setup)
        app.open(FreeWorld(setup.prototype.robot), link=self.link)
        assert isinstance(app.page, DrivePage)
        self.page = app.page

    def bend(self, seen: Window, key: str) -> None:
        seen.slide("Bend x [°]", key)

    def slowly(self, seen: Window) -> None:
        """Bend far at 5 degrees a second, so that it moves for long; it has begun."""
        seen.slide("Speed [°/s]", "Home")
        self.bend(seen, "End")
        assert seen.until(lambda: bool(self.link.change()[0] < -3e-4))

    def stands(self, seen: Window) -> bool:
        """The drives stand, for so many cycles."""
        until = self.link.elapsed + 0.2
        assert seen.until(lambda: self.link.elapsed > until)  # a ramp has ended
        before, until = self.link.change(), self.link.elapsed + 0.5
        assert seen.until(lambda: self.link.elapsed > until)
        return bool(np.abs(self.link.change() - before).max() < STANDS)

    def go_on(self, seen: Window) -> None:
        """When a person has had time to see why it stopped."""
        seen.page.wait_for_timeout(1100)
        seen.button("Resume").click()

    def says(self, seen: Window, words: str) -> bool:
        return seen.shows(re.compile(words))


@pytest.fixture
def bed(app: App) -> Iterator[Bed]:
    with emulated(load_hardware(), seed=3, effect="none", home=False) as setup:
        made = Bed(setup, app)
        yield made
        app.close()


@pytest.mark.study
def test_a_person_drives_it_and_the_page_shows_what_it_says(bed: Bed, window: Windows) -> None:
    seen = window(bed.app.address)
    bed.bend(seen, "End")
    assert seen.until(lambda: bed.page.teleop.arrived and bool(bed.link.change()[0] < -7.9e-3))
    # 61 degrees are the most whole ones that 8 mm of tendon are good for, at 7.5 mm from the backbone
    assert_allclose(bed.link.change(), 0.0075 * np.radians([-61.0, 0.0, 61.0, 0.0]), atol=1e-4)
    for words in (
        "The robot follows commands.",
        "marker seen",
        "Tendons pull",
        "Measured tip",
        "as measured",
    ):
        assert bed.says(seen, words), words
    measured = bed.link.read().tip_position
    assert seen.until(lambda: "measured" in bed.page.drawing.canvas.names)
    assert measured[0] > 0.025  # (1 - cos a) l / a is 34 mm; friction and stretched tendons take some of it
    green = (np.abs(seen.pixels().astype(int) - (20, 200, 40)).max(axis=2) < 25)[:400, 800:].sum()
    assert green > 10_000  # the camera's picture
    assert seen.errors == []


@pytest.mark.study
def test_what_is_beyond_a_limit_is_said_and_not_done(app: App, window: Windows) -> None:
    hardware = load_hardware()
    # 0.56 rad; the slider goes to 61 degrees by its tendons
    tight = replace(hardware, limits=replace(hardware.limits, curvature=8.0))
    with emulated(tight, seed=3, effect="none", home=False) as setup:
        bed = Bed(setup, app)
        seen = window(app.address)
        bed.bend(seen, "End")
        assert bed.says(seen, "segment 1 was commanded to bend with 8.* 1/m; this robot's limit is 8 1/m.")
        assert 0.52 < bed.page.teleop.bent(0)[0] <= 8.0 * 0.07
        assert bed.stands(seen)
        assert not bed.page.session.stopped
        bed.bend(seen, "Home")
        assert seen.until(lambda: bool(bed.link.change()[0] > 1e-3))
        assert seen.errors == []
        app.close()


@pytest.mark.study
def test_stop_stands_at_once_and_go_on_moves_nothing(bed: Bed, window: Windows) -> None:
    seen = window(bed.app.address)
    bed.slowly(seen)
    seen.button("STOP").click()
    assert seen.until(lambda: bed.page.session.stopped)
    assert bed.stands(seen)
    assert "emergency stop was pressed" in bed.link.supervisor.status  # nothing had stopped it before
    there = bed.link.change()
    bed.bend(seen, "End")
    assert bed.stands(seen)
    assert bed.says(seen, "emergency stop was pressed"), bed.link.supervisor.status
    bed.go_on(seen)
    assert seen.until(lambda: not bed.page.session.stopped)
    assert bed.stands(seen)
    assert_allclose(bed.link.change(), there, atol=5e-5)
    assert bed.page.teleop.bent(0)[0] == pytest.approx(-there[0] / 0.0075, abs=0.01)
    bed.bend(seen, "Home")
    assert seen.until(lambda: bool(bed.link.change()[0] > there[0] + 2e-4))


@pytest.mark.study
def test_stop_only_stops_however_often_it_is_pressed(bed, window, monkeypatch):
    seen, other = window(bed.app.address), window(bed.app.address)
    for each in (seen, other):
        assert each.button("Resume").is_disabled()
    bed.slowly(seen)
    with monkeypatch.context() as patch:
        patch.setattr("fastrod_viewer.drive.session._HASTY", PATIENCE)  # a click may need a second
        seen.button("STOP").dblclick()
        assert seen.until(lambda: bed.page.session.stopped)
        seen.button("Resume").click()
        assert bed.says(seen, "Resume within a second of a stop is ignored; press it again.")
        assert bed.stands(seen)
    for press in (other.button("STOP").click, lambda: other.page.keyboard.press("Escape")):
        press()
        other.page.wait_for_timeout(1100)
        assert bed.page.session.stopped
        assert bed.link.prototype.supervisor.first is not None
        assert bed.stands(other)
    bed.go_on(other)  # not for the page that only watches
    assert bed.says(other, "Another page has the controls. Request them")
    assert bed.page.session.stopped
    bed.go_on(seen)
    assert other.until(lambda: not bed.page.session.stopped)
    for each in (seen, other):
        assert each.until(each.button("Resume").is_disabled)
        assert each.errors == []


@pytest.mark.study
def test_after_a_fault_the_page_says_why_and_releases_when_the_cause_is_gone(bed, window):
    seen = window(bed.app.address)
    assert bed.says(seen, "marker seen")
    bed.emulator.hidden = True
    assert bed.says(seen, "the marker was last seen")
    assert bed.page.session.stopped
    assert bed.says(seen, "no marker")
    bed.go_on(seen)
    assert bed.says(seen, "not released, as")
    bed.emulator.hidden = False
    assert bed.says(seen, "marker seen")
    assert seen.until(lambda: not bed.page.session.releasing)
    bed.go_on(seen)
    assert seen.until(lambda: not bed.page.session.stopped)
    assert bed.says(seen, "The robot follows commands.")


@pytest.mark.study
@pytest.mark.parametrize("how", ["closed", "frozen"])
def test_nothing_moves_when_nobody_watches(bed, window, how, monkeypatch):
    seen, other = window(bed.app.address), window()
    bed.slowly(seen)
    if how == "closed":
        seen.close()
    else:
        monkeypatch.setattr("fastrod_viewer.watch._PATIENCE", 3.0)
        seen.page.wait_for_timeout(2000)  # for whoever is asked with more
        seen.page.evaluate(FREEZE)
    assert other.until(lambda: bed.link.prototype.supervisor.first is not None)
    assert bed.stands(other)
    there = bed.link.change()
    assert there[0] > 0.0075 * np.radians(-60.0)  # it had not arrived
    other.go(bed.app.address)
    assert bed.says(other, "no page is open, or none answers")
    bed.bend(other, "End")
    assert bed.stands(other)
    assert_allclose(bed.link.change(), there, atol=STANDS)
    bed.go_on(other)
    assert other.until(lambda: not bed.page.session.stopped)


@pytest.mark.study
def test_a_recording_has_the_cameras_sightings_by_the_robots_clock(bed, window, tmp_path):
    seen = window(bed.app.address)
    seen.tab("Save")
    seen.page.get_by_role("button", name="Record a run log").click()
    assert seen.until(lambda: bed.page.session.recorder is not None)
    for _ in range(4):
        seen.page.keyboard.press("l")
    assert seen.until(lambda: bool(bed.link.change()[0] < -0.0075 * np.radians(19.0)))
    until = bed.link.elapsed + 0.5
    assert seen.until(lambda: bed.link.elapsed > until)
    seen.page.get_by_role("button", name="Stop and save").click()
    path = tmp_path / "prototype-session.csv"
    assert seen.until(path.is_file)
    log = read_log(path, bed.link.robot)
    rate = load_hardware().camera.rate
    assert len(log) > 8
    # each frame once, by the clock that cycles count
    assert_allclose(np.diff(log.t), 1.0 / rate, atol=0.011)
    assert 0.0 <= log.t[0] < 0.2
    assert log.dl[-1, 0] == pytest.approx(-0.0075 * np.radians(20.0), abs=1e-4)
    # an arc of 20 degrees and 70 mm ends 12 mm beside its base
    assert 0.008 < log.tip_position[-1, 0] < 0.014
    assert {"marker_flag", "marker_error", "current_1", "cmd_dl_1"} <= set(log.extra)
    assert seen.errors == []


@pytest.mark.study
def test_sigterm_saves_the_recording_and_switches_off(tmp_path: Path, window: Windows) -> None:
    with Popen(DRIVE, cwd=tmp_path, stdout=PIPE, stderr=PIPE, text=True) as process:
        line = process.stdout.readline()
        assert "http://127.0.0.1:" in line, process.communicate()
        seen = window(line.split()[1])
        seen.tab("Save")
        seen.page.get_by_role("button", name="Record a run log").click()
        assert seen.until(lambda: any(p.stat().st_size > 2000 for p in tmp_path.glob("*.part")))
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 0, said
    assert "The drives are switched off." in said
    assert "Traceback" not in said
    log = read_log(tmp_path / "prototype-session.csv", load_hardware().robot)
    assert len(log) > 3
    assert np.isfinite(log.tip_position).any()
    assert "emergency stop" in (tmp_path / "drive.events.csv").read_text()  # closing is a stop, too
