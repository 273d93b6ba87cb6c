"""The prototype as a robot link: what it is commanded, what homing finds, how it starts and ends."""

from __future__ import annotations

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
from fastrod.types import Floats
from fastrod_device.bench.workbench import emulated
from fastrod_device.can.clock import Clock, SteppedClock, WallClock
from fastrod_device.emulator.emulator import Emulator
from fastrod_device.errors import DeviceError, RefusedError
from fastrod_device.hardware import load_hardware
from fastrod_device.prototype import Prototype
from fastrod_device.safety import SafetyState

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
    """See `benches.started`, of the prototype's own hardware."""
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


@pytest.mark.study(beyond=1)
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


# starting and ending


@pytest.mark.study
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
@pytest.mark.study(beyond=1)
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


@pytest.mark.study
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


@pytest.mark.study
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
