"""What links offer beyond driving and reading, found and used; and what a link without it is driven like."""

from __future__ import annotations

import time
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import ArrayLike

import fastrod
from fastrod.errors import InputError
from fastrod.logs.recording import Recorder
from fastrod.logs.runlog import read_log
from fastrod.logs.simulated import SimulatedRobot
from fastrod_viewer.drive_page import far_rows, fitted
from fastrod_viewer.knobs import drive_knobs
from fastrod_viewer.linked import Linked, TendonLimits
from fastrod_viewer.pilot import Speeds, Teleop
from fastrod_viewer.session import Session
from fastrod_viewer.worlds import FreeWorld

DT = 1.0 / 30.0


class State(Enum):
    """Of a guard."""

    OFF = "off"
    RUNNING = "running"
    STOPPED = "stopped"


class Watched:
    """A simulated prototype with a guard, a camera, set-points, and a release that takes until `settle`."""

    real = True

    def __init__(self) -> None:
        self.inner = SimulatedRobot(fastrod.load_robot("prototype"), real=True)
        self.robot, self.read, self.close = self.inner.robot, self.inner.read, self.inner.close
        self.supervisor = SimpleNamespace(
            limits=SimpleNamespace(displacement=0.005, rate=0.004),
            state=State.RUNNING,
            status="It runs.",
            first=None,
            client_lost=lambda now: self.halt(f"nobody, at {now:g} s"),
        )
        self.clock = SimpleNamespace(now=lambda: 7.0)
        self.source: object | None = object()
        self.sighting = SimpleNamespace(t=6.96, flag="")
        self.readings = SimpleNamespace(dl=np.zeros(4), tension=np.array([1.0, 2.0, 3.0, 4.0]))
        self.glides: list[tuple[np.ndarray, float]] = []
        self.asked = 0
        self.rows = 0

    @property
    def commanded(self) -> np.ndarray:
        return np.array(self.readings.dl)

    def halt(self, why: str) -> None:
        self.inner.stop()
        self.supervisor.state, self.supervisor.first, self.supervisor.status = (
            State.STOPPED,
            why,
            f"Stopped: {why}.",
        )

    def stop(self) -> None:
        self.halt("a button")

    def release(self) -> None:
        self.asked += 1

    def settle(self) -> None:
        self.inner.release()
        self.supervisor.state, self.supervisor.first, self.supervisor.status = State.RUNNING, None, "It runs."

    def command(self, dl: ArrayLike, ext: ArrayLike | None = None) -> None:
        raise AssertionError("it glides")

    def glide(self, dl: ArrayLike, seconds: float) -> None:
        self.glides.append((np.array(dl), seconds))
        self.inner.command(dl)
        if not self.inner.stopped:
            self.readings.dl = np.array(dl)


def until(holds: Callable[[], bool], seconds: float = 30.0) -> bool:
    end = time.monotonic() + seconds
    while not holds() and time.monotonic() < end:
        time.sleep(0.01)
    return holds()


def driven(link: object) -> Session:
    world = FreeWorld(fastrod.load_robot("prototype"))
    return Session(world, Teleop(world, reach=Linked(link).reach), draw=lambda frame: None, link=link)


def test_wires_keep_to_the_rate_of_the_link_and_go_straight() -> None:
    world = FreeWorld(fastrod.load_robot("prototype"))
    pilot = Teleop(world, Speeds(bend=20.0), reach=TendonLimits(rate=0.004))
    pilot.bend(0, 0.4, 0.2)
    pilot.wire(0, -0.004)
    told = [world.robot.rest_tendon_length]
    while not pilot.arrived:
        told.append(pilot.step(DT).tendon_length)
    steps = np.diff(told, axis=0)
    assert np.abs(steps).max() <= 0.004 * DT * (1.0 + 1e-9)
    assert np.abs(steps).max(axis=1)[:-1] == pytest.approx(0.004 * DT, rel=1e-9)  # as fast as it may
    np.testing.assert_allclose(told[-1] - told[0], pilot.change, atol=1e-15)


def test_bends_and_knobs_end_where_the_wires_do() -> None:
    world = FreeWorld(fastrod.load_robot("prototype"))
    pilot = Teleop(world, reach=TendonLimits(displacement=0.005))
    pilot.bend(0, 9.0, -9.0)
    assert np.abs(pilot.change).max() < 0.005
    groups = {group.title: group for group in drive_knobs(world, pilot)}
    assert groups["Segment 1"].knobs[0].high == np.floor(np.degrees(0.005 / 0.0075))
    assert groups["Wires"].knobs[0].high < 5.0
    assert "Base" not in groups  # nothing moves the base of a robot at the other end


@pytest.mark.parametrize("name", ["displacement", "rate"])
def test_a_reach_is_positive(name: str) -> None:
    with pytest.raises(InputError, match=f"Reach.{name} is 0.0; it must be positive"):
        TendonLimits(**{name: 0.0})


def test_a_link_that_offers_nothing_is_driven_all_the_same() -> None:
    link = SimulatedRobot(fastrod.load_robot("prototype"))
    far = Linked(link)
    assert far.reach == TendonLimits()
    assert far.ready
    assert not far.stopped
    assert (far.status, far.camera(), far.picture(), far.sees) == ("", "", None, False)
    far.command(np.array([-0.001, 0.0, 0.001, 0.0]), np.zeros(1), DT)
    np.testing.assert_array_equal(far.told()[0], [-0.001, 0.0, 0.001, 0.0])
    np.testing.assert_array_equal(far.standing()[0], far.told()[0])


def test_a_link_that_glides_is_told_for_how_long() -> None:
    link = Watched()
    session = driven(link)
    session.start()
    session.pilot.bend(0, 0.3, 0.0)
    session.touch()
    assert until(lambda: session.pilot.arrived and len(link.glides) > 20)
    session.close()
    told = np.array([dl for dl, _ in link.glides])
    seconds = np.array([s for _, s in link.glides])
    assert (np.abs(np.diff(told, axis=0)).max(axis=1) <= 0.004 * seconds[1:] + 1e-12).all()
    assert told[-1][0] == pytest.approx(-0.3 * 0.0075)


def test_a_fault_stops_the_session_which_waits_until_the_link_is_ready() -> None:
    link = Watched()
    session = driven(link)
    session.start()
    session.pilot.bend(0, 0.5, 0.0)
    session.touch()
    assert until(lambda: link.readings.dl[0] < -3e-4)
    link.halt("a wire broke")
    assert until(lambda: session.stopped)
    link.readings.dl = np.array([-0.001, 0.0, 0.001, 0.0])  # where it came to rest
    n = len(link.glides)
    session.pilot.bend(0, 0.6, 0.0)
    # the model stands as the encoders say
    assert until(lambda: session.pilot.bent(0)[0] == pytest.approx(0.001 / 0.0075))
    time.sleep(1.1)  # sooner it is ignored
    session.release()
    assert link.asked == 1
    time.sleep(0.2)
    assert session.stopped
    assert session.releasing
    assert len(link.glides) == n
    link.settle()
    assert until(lambda: not session.stopped)
    assert until(lambda: len(link.glides) > n)
    np.testing.assert_allclose(link.glides[n][0], [-0.001, 0.0, 0.001, 0.0], atol=1e-9)
    session.close()


def test_a_real_robot_is_not_released_within_a_second_of_a_stop() -> None:
    link = Watched()
    session = driven(link)
    session.release()
    assert link.asked == 0  # nothing is stopped
    session.stop()
    for _ in range(2):
        session.release()
    assert (session.stopped, session.releasing, session.hasty, link.asked) == (True, False, True, 0)
    time.sleep(0.9)
    session.stop()
    time.sleep(0.2)
    session.release()
    assert link.asked == 0  # it counts from the last stop
    time.sleep(0.9)
    session.release()
    session.release()
    assert (session.releasing, session.hasty, link.asked) == (True, False, 1)  # one release at a time
    session.stop()
    assert (session.stopped, session.releasing) == (True, False)
    session.close()


def test_a_simulated_robot_is_released_at_once() -> None:
    link = SimulatedRobot(fastrod.load_robot("prototype"))
    session = driven(link)
    session.start()
    session.stop()
    session.stop()
    assert session.stopped
    assert link.stopped
    session.release()
    assert until(lambda: not session.stopped)
    assert not link.stopped
    session.close()


def test_when_nobody_watches_the_guard_is_told_so() -> None:
    link = Watched()
    session = driven(link)
    session.nobody()
    assert link.supervisor.first == "nobody, at 7 s"
    assert session.stopped
    session.close()


def test_figures_of_a_link() -> None:
    link = Watched()
    far, now = Linked(link), link.read()
    assert far_rows(far, now) == [
        ("Wires pull", "1.00 · 2.00 · 3.00 · 4.00 N"),
        ("Camera", "marker seen 40 ms ago"),
    ]
    link.sighting = SimpleNamespace(t=6.99, flag="no marker")
    assert far.camera() == "no marker, last trusted 0.0 s ago"
    link.sighting = SimpleNamespace(t=5.0, flag="")
    assert far.camera() == "no picture for 2.0 s"
    link.source = None
    assert Linked(link).camera() == ""


def test_a_recording_of_a_link_begins_by_its_clock(tmp_path: Path) -> None:
    """The world's time runs from another zero: a log that began by it would lack its first seconds."""
    link = SimulatedRobot(fastrod.load_robot("prototype"))
    world = FreeWorld(link.robot)
    for _ in range(60):
        world.play()
    session = Session(world, Teleop(world), draw=lambda frame: None, link=link)
    session.ask(lambda: session.record(tmp_path / "a.csv"))
    session.start()
    assert until(lambda: session.recorder is not None and len(session.recorder) > 5)
    session.close()
    log = read_log(tmp_path / "a.csv", link.robot)
    assert 0.0 <= log.t[0] < 1.0
    assert len(log) > 5


def test_a_link_that_records_fills_the_log_by_itself(tmp_path: Path) -> None:
    class Own(Watched):
        """It records, too."""

        elapsed = 100.0
        to: Recorder | None = None

        def recorder_for(self, path: str) -> Recorder:
            return Recorder(self.robot, path, extra=("current_1",))

        def record(self, recorder: Recorder | None) -> None:
            self.to = recorder

    link = Own()
    session = driven(link)
    session.ask(lambda: session.record(tmp_path / "a.csv"))
    session.start()
    assert until(lambda: link.to is not None)
    assert link.to is not None
    time.sleep(0.2)
    assert len(link.to) == 0  # the session adds none of its own
    for k in range(3):
        now = link.read()
        link.to.add(type(now)(**{**vars(now), "t": 100.0 + 0.1 * k}), extra={"current_1": 0.5})
    session.close()
    assert link.to is None
    log = read_log(tmp_path / "a.csv", link.robot)
    np.testing.assert_allclose(log.t, [0.0, 0.1, 0.2], atol=1e-12)
    assert set(log.extra) >= {"current_1"}


def test_pictures_are_as_wide_as_their_window() -> None:
    assert fitted(np.zeros((480, 640, 3), np.uint8)).shape == (240, 320, 3)
    assert fitted(np.zeros((24, 32, 3), np.uint8)).shape == (240, 320, 3)
    assert fitted(np.zeros((1080, 1920, 3), np.uint8)).shape == (180, 320, 3)
