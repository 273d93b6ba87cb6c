"""Rods that ring in the viewer's worlds: by their natural frequency, until they rest; without a browser."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pages import until
from rods import rod

import fastrod
from fastrod.commands.cli import main
from fastrod.errors import InputError, RobotError
from fastrod.loading import with_line_density
from fastrod.logs.simulated import SimulatedRobot
from fastrod_viewer.app import App, found_in_motion, view
from fastrod_viewer.drive.session import Session, ViewFrame
from fastrod_viewer.drive.teleop import Teleop
from fastrod_viewer.worlds.simulated import FreeWorld
from fastrod_viewer.worlds.world import ManualCommand

LENGTH, STIFFNESS, DENSITY = 0.3, 0.01, 0.05
# Clamped, free at its end: f = 1.8751^2 / (2 pi l^2) sqrt(EI / rho)
FREQUENCY = 1.87510407**2 / (2.0 * np.pi * LENGTH**2) * np.sqrt(STIFFNESS / DENSITY)


def elastic(damping_time: float = 0.0) -> fastrod.Robot:
    """A rod of 2.8 Hz without weight."""
    material = {"bending_stiffness": (STIFFNESS, STIFFNESS), "torsional_stiffness": 0.008}
    made = rod("passive", length=LENGTH, line_density=DENSITY, damping_time=damping_time, **material)
    return replace(made, gravity=(0.0, 0.0, 0.0))


def begun(robot: fastrod.Robot, **options: float) -> tuple[FreeWorld, Teleop]:
    world = FreeWorld(robot, dynamics=True, **options)
    return world, Teleop(world)


def tip(world: FreeWorld) -> np.ndarray:
    return world.rods[0].state.tip_position[0].copy()


def energies(world: FreeWorld) -> tuple[float, float]:
    """Kinetic and strain energy [J]."""
    state = world.rods[0].state
    return float(state.kinetic_energy[0]), float(state.strain_energy[0])


def run(world: FreeWorld, teleop: Teleop, seconds: float) -> np.ndarray:
    """The tip's displacement (n, 3) [m], step by step."""
    start, found = tip(world), []
    for _ in range(round(seconds / world.dt)):
        world.drive(teleop.step(world.dt))
        found.append(tip(world) - start)
    return np.array(found)


def pulled(world: FreeWorld, teleop: Teleop, fraction: float) -> None:
    """Its tip is dragged aside by a fraction of the length, and held until it is still."""
    aside = world.rods[0].state.rotation[0, 0][:, 0]
    teleop.drag(tip(world) + fraction * world.robot.length * aside)
    run(world, teleop, 12.0 / world.ringing.frequency)


def frequency_of(signal: np.ndarray, dt: float) -> float:
    """Return the frequency from its zero crossings upward [Hz]."""
    signal = signal - 0.5 * (signal.max() + signal.min())
    up = np.flatnonzero((signal[:-1] < 0.0) & (signal[1:] >= 0.0))
    at = up + signal[up] / (signal[up] - signal[up + 1])
    assert len(at) >= 4
    return (len(at) - 1) / ((at[-1] - at[0]) * dt)


@pytest.fixture
def session() -> Iterator[Callable[..., Session]]:
    """Starts sessions, which end with the test."""
    opened: list[Session] = []

    def start(
        world: FreeWorld, teleop: Teleop, draw: Callable[[ViewFrame], None] = lambda frame: None
    ) -> Session:
        opened.append(Session(world, teleop, draw=draw))
        opened[-1].start()
        return opened[-1]

    yield start
    for one in opened:
        one.close()


@pytest.mark.study
def test_a_cantilever_let_go_rings_at_its_closed_form() -> None:
    world, teleop = begun(elastic(), dt=2e-3)
    assert world.ringing.frequency == pytest.approx(FREQUENCY, rel=2e-3)
    pulled(world, teleop, 0.05)
    teleop.drag(None)
    seen = run(world, teleop, 5.0 / FREQUENCY)[:, 0]
    assert frequency_of(seen, world.dt) == pytest.approx(FREQUENCY, rel=0.02)
    assert np.ptp(seen) > 0.06 * LENGTH


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("name", ["prototype", "tdcr_b", "ethz_beam"])
def test_a_shipped_robot_rings_at_its_natural_frequency(name: str) -> None:
    robot = fastrod.load_robot(name)
    world, teleop = begun(robot if name == "ethz_beam" else with_line_density(robot, 0.1))
    # the twist's and both bends' modes are near each other: only what is dragged along is looked at
    aside = world.rods[0].state.rotation[0, 0][:, 0]
    natural = world.simulator.frequencies(1)[0, 0]
    pulled(world, teleop, 0.02)
    teleop.drag(None)
    seen = run(world, teleop, 6.0 / natural) @ aside
    assert frequency_of(seen, world.dt) == pytest.approx(natural, rel=0.03)


@pytest.mark.study
def test_a_drag_is_a_spring_that_gives_way() -> None:
    world, teleop = begun(elastic(damping_time=5e-3), dt=5e-3)
    start, small = tip(world), 0.01 * LENGTH
    pulled(world, teleop, 0.01)
    run(world, teleop, 2.0)
    stiffness = 3.0 * STIFFNESS / LENGTH**3  # of a cantilever's tip; the spring has ten times that
    command = teleop.step(world.dt)
    assert tip(world)[0] - start[0] == pytest.approx(10.0 / 11.0 * small, rel=1e-3)
    assert command.tip_force[0] == pytest.approx(10.0 / 11.0 * small * stiffness, rel=2e-3)
    # far away it pulls no more than at a quarter of the length
    teleop.drag(start + np.array([10.0 * LENGTH, 0.0, 0.0]))
    farthest = world.ringing.stiffness * (0.25 * LENGTH)
    assert np.linalg.norm(teleop.step(world.dt).tip_force) == pytest.approx(farthest, rel=1e-6)


@pytest.mark.study
@pytest.mark.parametrize("dt", [2e-3, 1e-2, 0.03])
def test_a_held_rod_calms_down_and_a_released_one_gains_nothing(dt: float) -> None:
    world, teleop = begun(elastic(), dt=dt)
    teleop.drag(tip(world) + np.array([0.2 * LENGTH, 0.1 * LENGTH, -0.02 * LENGTH]))
    kinetic = []
    for _ in range(round(12.0 / FREQUENCY / dt)):
        world.drive(teleop.step(dt))
        kinetic.append(energies(world)[0])
    assert max(kinetic[-len(kinetic) // 4 :]) < 1e-3 * max(kinetic)  # the hand's damper takes it
    teleop.drag(None)
    stored = sum(energies(world))
    for _ in range(round(4.0 / FREQUENCY / dt)):
        world.drive(teleop.step(dt))
        assert sum(energies(world)) < 1.001 * stored
    assert teleop.arrived


def test_drives_go_on_while_the_tip_is_let_go() -> None:
    world, teleop = begun(with_line_density(fastrod.load_robot("prototype"), 0.1))
    teleop.drag(tip(world) + np.array([0.005, 0.0, 0.0]))
    run(world, teleop, 0.05)
    assert teleop.goals.action.any() == 0  # a spring, not the drives
    teleop.drag(None)
    teleop.bend(0, 0.3, 0.0)
    assert not teleop.arrived
    run(world, teleop, 0.3)
    assert teleop.arrived
    assert teleop.bent(0)[0] == pytest.approx(0.3)


@pytest.mark.study
def test_it_rests_when_it_is_still_and_not_at_a_turning_point() -> None:
    world, teleop = begun(elastic(damping_time=5e-3), dt=5e-3)
    assert energies(world)[0] == 0.0
    pulled(world, teleop, 0.1)
    teleop.drag(None)
    # far more slow moments than rests: the kinetic energy vanishes twice a period
    at, slow = [], 0
    while not world.ringing.rests and world.t < 120.0:
        world.drive(teleop.step(world.dt))
        at.append(tip(world)[0])
        slow += energies(world)[0] < 1e-3 * sum(energies(world))
    assert slow > 20
    left = np.array(at[-round(1.0 / FREQUENCY / world.dt) :])
    assert 1e-7 * LENGTH < np.ptp(left) < 1e-4 * LENGTH
    teleop.load(tip_force=[1e-4, 0.0, 0.0])
    world.drive(teleop.step(world.dt))
    assert not world.ringing.rests


@pytest.mark.study
def test_a_session_goes_on_until_it_rests(session: Callable[..., Session]) -> None:
    world, teleop = begun(elastic(damping_time=0.02), dt=2e-3)
    one = session(world, teleop)
    assert until(lambda: world.ringing.rests)
    time.sleep(0.6)
    there = world.t
    time.sleep(0.3)
    assert world.t == there
    teleop.drag(tip(world) + np.array([0.05, 0.0, 0.0]))
    one.wake()
    assert until(lambda: world.t > there + 0.2)
    teleop.drag(None)
    one.wake()
    let_go = world.t
    assert until(lambda: not one._moves())
    assert world.ringing.rests
    # amplitudes fall by exp(-zeta w t), zeta = damping_time w / 2, from about 1e-1 to 1e-5 of the length
    rate = 0.5 * 0.02 * (2.0 * np.pi * FREQUENCY) ** 2
    assert world.t - let_go > 0.5 * np.log(1e4) / rate
    assert energies(world)[0] < 1e-9


@pytest.mark.study
def test_without_damping_it_goes_on(session: Callable[..., Session]) -> None:
    world, teleop = begun(elastic(), dt=5e-3)
    pulled(world, teleop, 0.1)
    teleop.drag(None)
    stored = sum(energies(world))
    session(world, teleop)
    began = world.t
    assert until(lambda: world.t > began + 3.0)
    assert sum(energies(world)) > 0.9 * stored


@pytest.mark.study
def test_pause_holds_it_in_the_air(session: Callable[..., Session]) -> None:
    world, teleop = begun(elastic(), dt=5e-3)
    pulled(world, teleop, 0.1)
    teleop.drag(None)
    run(world, teleop, 0.25 / FREQUENCY)
    one = session(world, teleop)
    one.paused = True
    time.sleep(0.3)
    there, t, before = tip(world), world.t, energies(world)
    time.sleep(0.4)
    assert_array_equal(tip(world), there)
    assert (world.t, energies(world)) == (t, before)
    one.step()
    picture = round(1.0 / 30.0 / 5e-3) * 5e-3  # of 1/30 s, to a whole number of steps
    assert until(lambda: world.t > t + picture - 1e-6)
    time.sleep(0.2)
    assert world.t - t == pytest.approx(picture)
    one.paused = False
    assert until(lambda: world.t > t + 1.0)
    assert sum(energies(world)) == pytest.approx(sum(before), rel=0.05)


@pytest.mark.study
@pytest.mark.real_time
def test_slow_motion_slows_it(session: Callable[..., Session]) -> None:
    world, teleop = begun(elastic(), dt=5e-3)
    pulled(world, teleop, 0.1)
    teleop.drag(None)
    paces: list[float] = []
    one = session(world, teleop, lambda frame: paces.append(frame.pace))
    one.speed = 0.1
    time.sleep(0.3)
    wall, began = time.perf_counter(), world.t
    seen: list[tuple[float, float]] = []
    while time.perf_counter() - wall < 5.0:
        one.wake()  # as many commands as a person gives: they do not hurry it
        time.sleep(0.005)
        seen.append((time.perf_counter() - wall, tip(world)[0]))
    passed, elapsed = world.t - began, time.perf_counter() - wall
    assert 0.3 * elapsed * 0.1 < passed < 1.02 * elapsed * 0.1 + 2.0 * world.dt  # never faster, whatever else
    assert 0.0 < paces[-1] < 0.11
    # slowed, not changed: 5 s of the wall are 0.5 s of the rod, 1.4 periods of its own
    assert passed * FREQUENCY < 1.5
    one.paused = True
    time.sleep(0.2)  # a step that it is in is done to its end
    before = world.t
    one.step()
    assert until(lambda: world.t > before)
    time.sleep(0.2)
    assert world.t - before == pytest.approx(world.dt)  # a tenth of a picture's worth is less than a step


@pytest.mark.parametrize("speed", [0.0, -0.5, 2.0, float("nan"), "1/2"])
def test_a_speed_that_cannot_be(speed: object) -> None:
    world, teleop = begun(elastic())
    one = Session(world, teleop, draw=lambda frame: None)
    with pytest.raises(InputError, match="give a number above 0 and at most 1, real time"):
        one.speed = speed


@pytest.mark.real_time
def test_a_machine_that_is_too_slow_says_so_and_keeps_its_pictures(
    session: Callable[..., Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    drive = FreeWorld.drive

    def slow(self: FreeWorld, command: ManualCommand) -> None:
        time.sleep(0.05)  # for a step of 5 ms
        drive(self, command)

    world, teleop = begun(elastic(), dt=5e-3)
    pulled(world, teleop, 0.1)
    teleop.drag(None)
    monkeypatch.setattr(FreeWorld, "drive", slow)
    frames: list[tuple[float, float]] = []
    session(world, teleop, lambda frame: frames.append((time.perf_counter(), frame.pace)))
    time.sleep(3.0)
    assert 0.0 < frames[-1][1] < 0.11
    assert np.median(np.diff([at for at, _ in frames])) < 0.1  # not a quarter of a second's steps at once


@pytest.mark.study
def test_many_ring_alike_and_a_reset_begins_at_rest() -> None:
    world = FreeWorld(elastic(), 3, 5e-3, dynamics=True)
    teleop = Teleop(world)
    pulled(world, teleop, 0.1)
    teleop.drag(None)
    run(world, teleop, 0.1)
    tips = world.rods[0].state.tip_position
    assert_allclose(tips, tips[:1].repeat(3, 0), atol=1e-9)
    world.reset()
    assert world.t == 0.0
    assert not world.rods[0].state.kinetic_energy.any()
    assert_allclose(tip(world), [0.0, 0.0, LENGTH], atol=1e-9)


def test_steps_are_as_short_as_it_rings_fast() -> None:
    light = with_line_density(fastrod.load_robot("prototype"), 0.002)  # 188 Hz
    world, _ = begun(light)
    assert world.dt == pytest.approx(2e-4)
    assert world.ringing.frequency * world.dt < 0.05
    with pytest.raises(
        InputError, match=r"dt is 0.001 s, and 'prototype' rings at 188 Hz; give 0.0002 s or less"
    ):
        begun(light, dt=1e-3)
    assert begun(elastic())[0].dt == 1e-3


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["prototype", "--dynamics"], "segment 1 of 'prototype' has line_density 0 kg/m, and dynamics=True"),
        (["wall", "--dynamics"], "'wall' is no robot, and --dynamics goes with one, such as ethz_beam."),
        (["nope.csv", "--dynamics"], "'nope.csv' is no robot, and --dynamics goes with one"),
        (["prototyp", "--dynamics"], "did you mean 'prototype'"),
        (["ethz_beam", "--dynamics", "--dt", "0"], "dt is 0.0 s; it must be a number, positive"),
        (["ethz_beam", "--dynamics", "--line-density", "-1"], "line_density"),
        (["ethz_beam", "--dynamics", "--robots", "5000"], "n_robots is 5000; a browser draws up to 1024."),
        (["ethz_beam", "--dynamics", "--robot", "tdcr_a"], "--robot goes with a run log"),
        (["ethz_beam", "--line-density", "0.1"], "--line-density goes with --dynamics"),
        (["ethz_beam", "--dt", "0.01"], "--dt goes with --dynamics"),
    ],
)
def test_what_cannot_ring_is_one_sentence(
    words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", "--no-open", *words]) == 2
    said = capsys.readouterr()
    assert sentence in said.err
    assert len(said.err.strip().splitlines()) == 1


def test_a_command_opens_a_robot_that_rings(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[FreeWorld] = []
    monkeypatch.setattr(App, "wait", lambda app: opened.append(app.page.world))
    view("prototype", port=0, open_browser=False, dynamics=True, line_density=0.1, dt=2e-3)
    assert opened[0].dt == 2e-3
    assert opened[0].robot.segments[0].line_density == 0.1
    assert opened[0].ringing is not None


def test_a_link_is_of_a_world_without_inertia(tmp_path: Path) -> None:
    robot = with_line_density(fastrod.load_robot("prototype"), 0.1)
    with (
        App(port=0, folder=tmp_path, say=lambda _: None) as app,
        pytest.raises(InputError, match="a robot link goes with a world without inertia"),
    ):
        app.open(FreeWorld(robot, dynamics=True), link=SimulatedRobot(robot))


def test_a_density_that_cannot_be() -> None:
    with pytest.raises(RobotError, match="line_density"):
        found_in_motion("prototype", line_density=float("nan"))
