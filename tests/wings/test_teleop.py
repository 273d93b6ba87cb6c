"""Goals become motion within limits; sessions run, stop and record; all without a browser."""

import time
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pages import until
from rods import behind_a_passive_one

import fastrod
from fastrod.errors import InputError
from fastrod.logs.link import Measurement, RobotLink
from fastrod.logs.recording import Recorder
from fastrod.logs.simulated import SimulatedRobot
from fastrod_viewer.drive.controls import drive_controls, largest_force, load_controls, nice
from fastrod_viewer.drive.session import Session
from fastrod_viewer.drive.teleop import LARGEST_BEND, Speeds, Teleop
from fastrod_viewer.worlds.simulated import FreeWorld
from fastrod_viewer.worlds.world import ManualCommand, measure

DT = 1.0 / 30.0


def piloted(name: str = "five_segment_reacher") -> tuple[FreeWorld, Teleop]:
    robot = fastrod.load_robot("prototype" if name == "catheter" else name)
    world = FreeWorld(behind_a_passive_one(robot) if name == "catheter" else robot)
    return world, Teleop(world)


def begun(world: FreeWorld, teleop: Teleop, draw: Any = lambda frame: None, **options: Any) -> Session:
    """A session that runs."""
    session = Session(world, teleop, draw=draw, **options)
    session.start()
    return session


def bent(teleop: Teleop, session: Session, x: float, y: float = 0.0) -> None:
    """Segment 1 is commanded to bend."""
    teleop.bend(0, x, y)
    session.wake()


def test_a_bend_arrives_at_its_speed_and_bends_an_arc() -> None:
    world, teleop = piloted("prototype")
    teleop.speeds = Speeds(bend=1.0)
    teleop.bend(0, 0.5, 0.0)
    before = teleop.step(0.1).tendon_length
    # 0.1 rad of the 0.5 in a tenth of a second, times the tendons' 7.5 mm
    assert_allclose(before - 0.07, [-0.00075, 0.0, 0.00075, 0.0], atol=1e-12)
    for _ in range(30):
        world.drive(teleop.step(DT))
    assert teleop.arrived
    length, angle = 0.07, 0.5
    tip = world.rods[0].state.tip_position[0]
    arc = length / angle * np.array([1.0 - np.cos(angle), 0.0, np.sin(angle)])
    assert_allclose(tip, arc, atol=3e-4)  # the tendons stretch by 1e-5 m/N


def test_bends_and_extensions_stay_within_their_ranges() -> None:
    _, teleop = piloted()
    teleop.bend(2, 9.0, -9.0)
    assert teleop.bent(2) == pytest.approx((LARGEST_BEND, -LARGEST_BEND))
    teleop.extend(2, 0.1)
    assert teleop.goals.action[6] == 0.0  # this robot does not extend


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("goal", [(0.10, 0.05, 0.40), (-0.15, 0.0, 0.35), (0.0, 0.2, 0.3)])
def test_a_drag_brings_the_tip_there(goal: tuple[float, float, float]) -> None:
    world, teleop = piloted()
    world.drive(teleop.step(DT))
    teleop.drag(goal)
    away = []
    for _ in range(120):
        world.drive(teleop.step(DT))
        away.append(float(np.linalg.norm(world.rods[0].state.tip_position[0] - goal)))
    assert away[-1] < 1e-4
    assert max(np.diff(away)) < 1e-3  # nearly straight there
    teleop.drag(None)
    assert teleop.arrived


def test_a_drag_beyond_the_workspace_ends_near_it_and_within_the_limits() -> None:
    world, teleop = piloted()
    world.drive(teleop.step(DT))
    teleop.drag((2.0, 0.0, 0.3))
    for _ in range(150):
        world.drive(teleop.step(DT))
    state = world.rods[0].state
    assert np.isfinite(state.tip_position).all()
    assert np.abs(teleop.goals.action.reshape(-1, 3)[:, 1:]).max() <= LARGEST_BEND * 0.0075 + 1e-12
    assert state.tip_position[0, 0] > 0.35  # as far toward it as half a metre of robot goes


def test_one_tendon_moves_alone() -> None:
    _, teleop = piloted("tdcr_a")
    teleop.bend(0, 0.3, 0.1)
    before = teleop.change
    teleop.change_tendon(4, -0.002)
    expected = before.copy()
    expected[4] = -0.002
    assert_allclose(teleop.change, expected, atol=1e-15)
    assert teleop.bent(0) == pytest.approx((0.3, 0.1))


def test_taking_over_moves_nothing() -> None:
    world, teleop = piloted()
    for _ in range(40):
        world.play()
    tip = world.rods[0].state.tip_position[0].copy()
    now = measure(world, None)
    teleop.adopt(now.dl, now.ext)
    for _ in range(3):
        world.drive(teleop.step(DT))
    assert_allclose(world.rods[0].state.tip_position[0], tip, atol=1e-5)


@pytest.mark.parametrize("name", [*fastrod.robot_names(), "catheter"])
def test_every_control_reads_what_it_was_put_to(name: str) -> None:
    world, teleop = piloted(name)
    groups = (*drive_controls(world, teleop), load_controls(world.robot, teleop))
    for control in (control for group in groups for control in group.controls):
        assert control.low < control.high
        assert control.label.endswith("]")
        wanted = control.low + 0.7 * (control.high - control.low)
        control.put(wanted)
        assert control.get() == pytest.approx(wanted, abs=1e-9), control.label
        assert abs(control.value - wanted) <= 0.11 * control.step
        teleop.reset()


def test_ranges_are_round_numbers_that_suit_the_robot() -> None:
    assert [nice(v) for v in (0.011, 0.2, 3.0, 51.0)] == [0.02, 0.2, 5.0, 100.0]
    # twice EI / l^2 = 0.898 N for the prototype
    assert largest_force(fastrod.load_robot("prototype")) == 1.0


@pytest.mark.real_time
def test_a_session_moves_in_real_time_and_stops_at_once() -> None:
    world, teleop = piloted("prototype")
    drawn: list[float] = []
    session = begun(world, teleop, lambda frame: drawn.append(frame.world.t))
    teleop.speeds = Speeds(bend=0.2)
    session.take_over()
    bent(teleop, session, 1.0)
    assert until(lambda: teleop.now.action[1] > 1e-4)
    session.stop()
    there = teleop.now.action.copy()
    time.sleep(0.2)
    assert_array_equal(teleop.now.action, there)
    assert there[1] < 0.9 * 0.0075
    session.release()
    bent(teleop, session, 0.0)
    assert until(lambda: teleop.arrived)
    session.close()
    assert len(drawn) > 5


def test_what_cannot_be_done_is_said_and_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """A world that refuses bends beyond 0.5 rad: the robot stands before them, and the session continues."""
    world, teleop = piloted("prototype")
    drive = FreeWorld.drive

    def refuse(self: FreeWorld, command: ManualCommand) -> None:
        if command.tendon_length[0] < 0.07 - 0.5 * 0.0075:
            raise InputError("robot 0 cannot be brought there: a wall.")
        drive(self, command)

    monkeypatch.setattr(FreeWorld, "drive", refuse)
    problems: list[str] = []
    session = begun(world, teleop, lambda frame: problems.append(frame.problem))
    bent(teleop, session, 1.0)
    assert until(lambda: "robot 0 cannot be brought there: a wall." in problems)
    assert until(lambda: teleop.arrived)
    assert teleop.bent(0)[0] < 0.5
    teleop.all_zero()
    session.wake()
    assert until(lambda: bool(np.linalg.norm(world.rods[0].state.tip_position[0] - [0.0, 0.0, 0.07]) < 1e-6))
    session.close()


def test_a_paused_session_steps_one_picture_at_a_time() -> None:
    world, teleop = piloted("prototype")
    session = Session(world, teleop, draw=lambda frame: None, script=True)
    session.paused = True
    session.start()
    time.sleep(0.2)
    before = world.t
    session.step()
    assert until(lambda: world.t > before)
    time.sleep(0.2)
    assert world.t - before == pytest.approx(DT, abs=1e-9)
    session.close()


def test_a_real_robot_stops_when_nobody_watches_and_a_simulated_one_holds() -> None:
    robot = fastrod.load_robot("prototype")
    for real in (True, False):
        link = SimulatedRobot(robot, real=real)
        assert isinstance(link, RobotLink)
        world = FreeWorld(robot)
        teleop = Teleop(world, Speeds(bend=0.1))
        session = begun(world, teleop, link=link)
        bent(teleop, session, 1.0)
        assert until(lambda link=link: bool(link.read().dl[0] < -1e-5))
        session.nobody()
        there = teleop.now.action[1]
        time.sleep(0.3)
        assert teleop.now.action[1] == pytest.approx(there, abs=1e-4)
        assert link.stopped is real
        session.close()
        assert link.stopped


def test_a_linked_robot_is_taken_over_where_it_stands_and_never_jumps() -> None:
    robot = fastrod.load_robot("prototype")
    link = SimulatedRobot(robot, real=True)
    link.command([-0.006, 0.0, 0.006, 0.0])
    held: list[np.ndarray] = []
    command = link.command

    class Heard:
        """The link, and the commands that it gets."""

        robot, real = link.robot, link.real
        read, stop, release, close = link.read, link.stop, link.release, link.close

        def command(self, dl: np.ndarray, ext: np.ndarray | None = None) -> None:
            held.append(np.array(dl))
            command(dl, ext)

    world = FreeWorld(robot)
    teleop = Teleop(world, Speeds(bend=0.5))
    session = begun(world, teleop, link=Heard())
    assert until(lambda: len(held) > 3)
    assert_allclose(held[0], [-0.006, 0.0, 0.006, 0.0], atol=1e-9)
    session.reset()
    assert until(lambda: bool(np.abs(held[-1]).max() < 1e-9))
    session.stop()
    time.sleep(1.1)  # sooner it is ignored
    n = len(held)
    session.release()
    assert until(lambda: len(held) > n)
    session.close()
    steps = np.abs(np.diff(held, axis=0)).max()
    assert steps <= 0.5 * 0.0075 * DT * 1.001


def test_a_reset_while_recording_begins_another_run() -> None:
    world, teleop = piloted("prototype")
    session = Session(world, teleop, draw=lambda frame: None, script=True)
    recorder = Recorder(world.robot)
    recorder.start(0.0, "by script")
    session.recorder = recorder
    session.start()
    assert until(lambda: len(recorder) > 20)
    session.reset()
    n = len(recorder)
    assert until(lambda: len(recorder) > n + 20)
    session.recorder = None
    session.close()
    log = recorder.stop()
    assert log.runs == ["by script", "again 1"]
    for run in log.runs:
        assert (np.diff(log.only(run).t) >= 0.0).all()


def test_a_measured_robot_that_differs_shows_its_residual() -> None:
    """The link's robot has softer tendons than its model; what is measured is the link's."""
    robot = fastrod.load_robot("prototype")
    world = FreeWorld(robot)
    teleop = Teleop(world)
    seen: list[Any] = []
    link = SimulatedRobot(robot)
    session = Session(world, teleop, draw=lambda frame: seen.append(frame.measured), link=link)
    recorder = Recorder(robot)
    recorder.start(0.0, "by hand")
    session.recorder = recorder
    session.start()
    bent(teleop, session, 0.5)
    assert until(lambda: teleop.arrived and len(seen) > 20)
    session.close()
    assert_allclose(seen[-1].tip_position, world.rods[0].state.tip_position[0], atol=1e-6)
    assert len(recorder) > 10


def test_a_simulated_robot_refuses_what_it_cannot_do() -> None:
    link = SimulatedRobot(fastrod.load_robot("prototype"))
    with pytest.raises(InputError, match=r"dl has shape \(1,\); it must be \(4,\)"):
        link.command([0.0])
    with pytest.raises(InputError, match="finite"):
        link.command([np.nan, 0.0, 0.0, 0.0])
    link.command([-0.004, 0.0, 0.004, 0.0])
    link.stop()
    link.command([0.0, 0.0, 0.0, 0.0])
    assert_array_equal(link.read().dl, [-0.004, 0.0, 0.004, 0.0])
    link.release()
    link.command([0.0, 0.0, 0.0, 0.0])
    assert not link.read().dl.any()


def test_a_measurement_has_the_shapes_of_a_log() -> None:
    good = {"t": 0.0, "dl": np.zeros(4), "ext": np.zeros(1), "tension": np.zeros(4)}
    good |= {"tip_position": np.zeros(3), "tip_quaternion": [1, 0, 0, 0]}
    assert Measurement(**good).problem == ""
    with pytest.raises(InputError, match=r"Measurement.tip_position has shape \(2,\); it must be \(3,\)"):
        Measurement(**(good | {"tip_position": np.zeros(2)}))
