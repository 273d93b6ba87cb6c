"""Optional offers of links are found and used; a link without it is driven all the same."""

import time
from enum import Enum
from types import SimpleNamespace

import numpy as np
import pytest

import fastrod
from fastrod.logs.reader import read_log
from fastrod.logs.recording import Recorder
from fastrod.logs.simulated import SimulatedRobot
from fastrod_viewer.drive.controls import drive_controls
from fastrod_viewer.drive.linked import Linked, TendonLimits
from fastrod_viewer.drive.page import far_rows, fitted
from fastrod_viewer.drive.session import Session
from fastrod_viewer.drive.teleop import Speeds, Teleop
from fastrod_viewer.worlds.simulated import FreeWorld

DT = 1.0 / 30.0
ROBOT = fastrod.load_robot("prototype")
AT_REST = np.array([-0.001, 0.0, 0.001, 0.0])
State = Enum("State", {"OFF": "off", "RUNNING": "running", "STOPPED": "stopped"})  # of a guard


class Watched:
    """A simulated prototype with a guard, a camera, set-points, and a release that takes until `settle`."""

    real = True

    def __init__(self):
        self.inner = SimulatedRobot(ROBOT, real=True)
        self.robot, self.read, self.close = self.inner.robot, self.inner.read, self.inner.close
        limits = SimpleNamespace(displacement=0.005, rate=0.004)
        client_lost = lambda now: self.halt(f"nobody, at {now:g} s")  # noqa: E731
        self.supervisor = SimpleNamespace(limits=limits, client_lost=client_lost)
        self.run()
        self.clock = SimpleNamespace(now=lambda: 7.0)
        self.source, self.sighting = object(), SimpleNamespace(t=6.96, flag="")
        self.readings = SimpleNamespace(dl=np.zeros(4), tension=np.array([1.0, 2.0, 3.0, 4.0]))
        self.glides, self.requested, self.rows = [], 0, 0

    def run(self):
        self.supervisor.state, self.supervisor.first, self.supervisor.status = State.RUNNING, None, "It runs."

    @property
    def commanded(self):
        return np.array(self.readings.dl)

    def halt(self, why):
        self.inner.stop()
        guard = self.supervisor
        guard.state, guard.first, guard.status = State.STOPPED, why, f"Stopped: {why}."

    def stop(self):
        self.halt("a button")

    def release(self):
        self.requested += 1

    def settle(self):
        self.inner.release()
        self.run()

    def command(self, dl, ext=None):
        raise AssertionError("it glides")

    def glide(self, dl, seconds):
        self.glides.append((np.array(dl), seconds))
        self.inner.command(dl)
        if not self.inner.stopped:
            self.readings.dl = np.array(dl)


def until(holds, seconds=30.0):
    end = time.monotonic() + seconds
    while not holds() and time.monotonic() < end:
        time.sleep(0.01)
    return holds()


def driven(link, start=False, record=None):
    """A session that drives it; `start` runs it, `record` records to this path."""
    world = FreeWorld(ROBOT)
    session = Session(world, Teleop(world, limits=Linked(link).limits), draw=lambda frame: None, link=link)
    if record is not None:
        session.submit(lambda: session.record(record))
    if start:
        session.start()
    return session


def test_tendons_keep_to_the_rate_of_the_link_and_go_straight():
    world = FreeWorld(ROBOT)
    teleop = Teleop(world, Speeds(bend=20.0), limits=TendonLimits(rate=0.004))
    teleop.bend(0, 0.4, 0.2)
    teleop.change_tendon(0, -0.004)
    held = [world.robot.rest_tendon_length]
    while not teleop.arrived:
        held.append(teleop.step(DT).tendon_length)
    steps = np.diff(held, axis=0)
    assert np.abs(steps).max() <= 0.004 * DT * (1.0 + 1e-9)
    assert np.abs(steps).max(axis=1)[:-1] == pytest.approx(0.004 * DT, rel=1e-9)  # as fast as it may
    np.testing.assert_allclose(held[-1] - held[0], teleop.change, atol=1e-15)


def test_bends_and_controls_end_where_the_tendons_do():
    world = FreeWorld(ROBOT)
    teleop = Teleop(world, limits=TendonLimits(displacement=0.005))
    teleop.bend(0, 9.0, -9.0)
    assert np.abs(teleop.change).max() < 0.005
    groups = {group.title: group for group in drive_controls(world, teleop)}
    assert groups["Segment 1"].controls[0].high == np.floor(np.degrees(0.005 / 0.0075))
    assert groups["Tendons"].controls[0].high < 5.0
    assert "Base" not in groups  # nothing moves the base of a robot at the other end


def test_a_link_that_offers_nothing_is_driven_all_the_same():
    link = SimulatedRobot(ROBOT)
    far = Linked(link)
    assert far.limits == TendonLimits()
    assert (far.ready, far.stopped, far.status) == (True, False, "")
    assert (far.camera(), far.picture(), far.sees) == ("", None, False)
    far.command(AT_REST, np.zeros(1), DT)
    np.testing.assert_array_equal([far.held()[0], far.standing()[0]], [AT_REST, AT_REST])


def test_a_link_that_glides_knows_for_how_long():
    link = Watched()
    session = driven(link, start=True)
    session.teleop.bend(0, 0.3, 0.0)
    session.wake()
    assert until(lambda: session.teleop.arrived and len(link.glides) > 20)
    session.close()
    held, seconds = (np.array(values) for values in zip(*link.glides, strict=True))
    assert (np.abs(np.diff(held, axis=0)).max(axis=1) <= 0.004 * seconds[1:] + 1e-12).all()
    assert held[-1][0] == pytest.approx(-0.3 * 0.0075)


def test_a_fault_stops_the_session_which_waits_until_the_link_is_ready():
    link = Watched()
    session = driven(link, start=True)
    session.teleop.bend(0, 0.5, 0.0)
    session.wake()
    assert until(lambda: link.readings.dl[0] < -3e-4)
    link.halt("a tendon broke")
    assert until(lambda: session.stopped)
    link.readings.dl = AT_REST.copy()  # where it came to rest
    n = len(link.glides)
    session.teleop.bend(0, 0.6, 0.0)
    # the model stands as the encoders say
    assert until(lambda: session.teleop.bent(0)[0] == pytest.approx(0.001 / 0.0075))
    time.sleep(1.1)  # sooner it is ignored
    session.release()
    assert link.requested == 1
    time.sleep(0.2)
    assert (session.stopped, session.releasing, len(link.glides)) == (True, True, n)
    link.settle()
    assert until(lambda: not session.stopped)
    assert until(lambda: len(link.glides) > n)
    np.testing.assert_allclose(link.glides[n][0], AT_REST, atol=1e-9)
    session.close()


def test_a_real_robot_is_not_released_within_a_second_of_a_stop():
    link = Watched()
    session = driven(link)
    session.release()
    assert link.requested == 0  # nothing is stopped
    session.stop()
    for _ in range(2):
        session.release()
    assert (session.stopped, session.releasing, session.hasty, link.requested) == (True, False, True, 0)
    time.sleep(0.9)
    session.stop()
    time.sleep(0.2)
    session.release()
    assert link.requested == 0  # it counts from the last stop
    time.sleep(0.9)
    session.release()
    session.release()
    assert (session.releasing, session.hasty, link.requested) == (True, False, 1)  # one release at a time
    session.stop()
    assert (session.stopped, session.releasing) == (True, False)
    session.close()


def test_a_simulated_robot_is_released_at_once():
    link = SimulatedRobot(ROBOT)
    session = driven(link, start=True)
    session.stop()
    session.stop()
    assert (session.stopped, link.stopped) == (True, True)
    session.release()
    assert until(lambda: not session.stopped)
    assert not link.stopped
    session.close()


def test_when_nobody_watches_the_guard_hears_so():
    link = Watched()
    session = driven(link)
    session.nobody()
    assert (link.supervisor.first, session.stopped) == ("nobody, at 7 s", True)
    session.close()


def test_figures_of_a_link():
    link = Watched()
    far, now = Linked(link), link.read()
    rows = [("Tendons pull", "1.00 · 2.00 · 3.00 · 4.00 N"), ("Camera", "marker seen 40 ms ago")]
    assert far_rows(far, now) == rows
    link.sighting = SimpleNamespace(t=6.99, flag="no marker")
    assert far.camera() == "no marker, last trusted 0.0 s ago"
    link.sighting = SimpleNamespace(t=5.0, flag="")
    assert far.camera() == "no picture for 2.0 s"
    link.source = None
    assert Linked(link).camera() == ""


def test_a_recording_of_a_link_begins_by_its_clock(tmp_path):
    """The world's time runs from another zero: a log that began by it would lack its first seconds."""
    link = SimulatedRobot(ROBOT)
    world = FreeWorld(link.robot)
    for _ in range(60):
        world.play()
    session = Session(world, Teleop(world), draw=lambda frame: None, link=link)
    session.submit(lambda: session.record(tmp_path / "a.csv"))
    session.start()
    assert until(lambda: session.recorder is not None and len(session.recorder) > 5)
    session.close()
    log = read_log(tmp_path / "a.csv", link.robot)
    assert 0.0 <= log.t[0] < 1.0
    assert len(log) > 5


def test_a_link_that_records_fills_the_log_by_itself(tmp_path):
    class Own(Watched):
        """It records, too."""

        elapsed = 100.0
        to = None

        def recorder_for(self, path):
            return Recorder(self.robot, path, extra=("current_1",))

        def record(self, recorder):
            self.to = recorder

    link = Own()
    session = driven(link, start=True, record=tmp_path / "a.csv")
    assert until(lambda: link.to is not None)
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


def test_pictures_are_as_wide_as_their_window():
    for size, height in (((480, 640), 240), ((24, 32), 240), ((1080, 1920), 180)):
        assert fitted(np.zeros((*size, 3), np.uint8)).shape == (height, 320, 3)
