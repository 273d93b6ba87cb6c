"""Rods in motion that touch: closed forms of friction, energy, a hug, and what stays as it was."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fastrod import Modal, Modes, Robot, Segment, Simulator, Tendon
from fastrod.contact import ContactScene, Obstacle, box, cylinder, mesh, plane, sphere
from fastrod.errors import InputError

RADIUS, LENGTH, EI, DENSITY = 0.004, 0.1, 0.01, 0.05
ALONG_X = (0.5**0.5, 0.0, 0.5**0.5, 0.0)
ACROSS = (0.5**0.5, 0.5**0.5, 0.0, 0.0)
WEIGHTLESS = (0.0, 0.0, 0.0)


def rod(**more: Any) -> Robot:
    """One passive segment."""
    usual = {"bending_stiffness": (EI, EI), "torsional_stiffness": 0.8 * EI, "line_density": DENSITY}
    usual |= {"length": LENGTH, "damping_time": 2e-3, "mode": "passive", "body_radius": RADIUS}
    return Robot(name="rod", segments=(Segment(**usual | more),), gravity=WEIGHTLESS)


def simulator(robot: Robot, *obstacles: Obstacle, n: int = 1, dt: float = 1e-3, **more: Any) -> Simulator:
    modes = more.pop("modes", Modes(4, 2))
    scene = ContactScene(obstacles=list(obstacles), rod_radius=RADIUS, max_contacts=48, **more)
    return Simulator(robot, n, dt=dt, solver=Modal(dynamics=True, modes=modes), contact=scene)


def above_floor(friction: float, height: float = 0.0005) -> tuple[Robot, Obstacle]:
    """A rod along x above a floor, and that."""
    lying = replace(rod(), base_quaternion=ALONG_X, base_position=(0.0, 0.0, RADIUS + height))
    return lying, plane(name="floor", friction=friction)


def pressed(sim: Simulator, aside: float, press: float = -0.5) -> Any:
    return sim.step(tip_force=(0.0, aside, press))


def test_what_sticks_does_not_creep_and_what_slips_bears_all_of_its_friction() -> None:
    mu = 0.4
    sim = simulator(*above_floor(mu))
    assert sim.settle(tip_force=(0.0, 0.0, -0.5)).ok.all()
    places = []
    for k in range(160):
        state = pressed(sim, 0.001 * min(k, 60))
        assert state.ok.all()
        force = state.contacts.total_force[0]
        assert np.hypot(force[0], force[1]) <= mu * force[2] * (1.0 + 1e-9)
        places.append(state.tip_position[0, 1])
    assert abs(places[-1] - places[100]) < 1e-12  # once its torsion is at rest
    for k in range(60):
        state = pressed(sim, 0.06 + 0.005 * k)
    force, slip = state.contacts.total_force[0], state.velocity[0, -1]
    assert slip[1] > 0.02
    assert_allclose(np.hypot(force[0], force[1]), mu * force[2], rtol=1e-6)
    assert_allclose(force[:2] / (mu * force[2]), -slip[:2] / np.hypot(slip[0], slip[1]), atol=2e-3)
    assert -1e-7 < state.contacts.clearance[0] < 3e-6


def test_energy_never_grows_as_a_rod_falls_onto_a_floor() -> None:
    robot, floor = above_floor(0.3, height=0.003)
    (soft,) = rod(bending_stiffness=(0.05 * EI, 0.05 * EI)).segments
    robot = replace(robot, segments=(soft,), gravity=(0.0, 0.0, -9.81))
    sim = simulator(robot, floor)
    state = sim.settle(gravity=WEIGHTLESS)
    s = np.linspace(0.0, LENGTH, 81)
    before, touched = np.inf, False
    for _ in range(200):
        state = sim.step()
        assert state.ok.all()
        height = np.trapezoid(sim.shape(s).position[0, :, 2], s)
        energy = state.kinetic_energy[0] + state.strain_energy[0] + 9.81 * DENSITY * height
        assert energy <= before + 1e-9
        before, touched = energy, touched or bool(state.contacts.in_contact()[0])
        assert state.contacts.clearance[0] > -1e-5
    assert touched


def test_a_bar_that_moves_takes_the_rod_along() -> None:
    """Slowly enough: a cantilever that is bent a little by a force at s gives 3 EI / s^3."""
    bar, at = cylinder(0.005, 0.2, name="bar", quaternion=ACROSS), 0.9 * LENGTH
    sim = simulator(rod(), bar)

    def pose(x: float) -> dict[str, Any]:
        return {"bar": (x, 0.0, at, *ACROSS)}

    assert sim.settle(obstacle_pose=pose(-0.01)).ok.all()
    for k in range(220):
        state = sim.step(obstacle_pose=pose(-0.01 + 3e-5 * min(k, 100)))
        assert state.ok.all()
    bend = -0.007 + 0.005 + RADIUS
    where = state.contacts.arclength[0, 0]
    assert_allclose(sim.shape([where]).position[0, 0, 0], bend, atol=1e-5)
    assert_allclose(state.contacts.total_force[0, 0], 3.0 * EI / where**3 * bend, rtol=3e-3)


def hugging(friction: float) -> tuple[Robot, Simulator]:
    """Two segments beside a bar of 30 mm, tendons inside of the rod."""
    tendons = tuple(Tendon(offset=0.003, angle=a, compliance=1e-5) for a in (0.0, np.pi))
    (segment,) = rod(length=0.06, mode="tendon_length", tendons=tendons).segments
    robot = Robot(name="hug", segments=(segment, segment), gravity=WEIGHTLESS)
    bar = cylinder(0.015, 0.4, name="bar", position=(0.0195, 0.0, 0.02), quaternion=ACROSS, friction=friction)
    return robot, simulator(robot, bar, modes=Modes(4, 2, pieces=3))


@pytest.mark.study
@pytest.mark.parametrize("friction", [0.0, 0.3, 0.6])
def test_a_rod_hugs_a_bar_to_400_degrees(friction: float) -> None:
    robot, sim = hugging(friction)
    state, passes = sim.settle(robot.rest_tendon_length), []
    for k in range(222):
        pull = 0.003 * np.radians(1.8 * (k + 1)) * np.array([-0.5, 0.5, -1.0, 1.0])
        state = sim.step(robot.rest_tendon_length + pull)
        assert state.ok.all(), state.problems
        assert state.contacts.clearance[0] > -1e-5
        force, normal = state.contacts.force[0], state.contacts.normal[0]
        press = (force * normal).sum(1)
        along = np.linalg.norm(force - press[:, None] * normal, axis=1)
        assert (along <= friction * press + 1e-6).all()
        passes.append(state.passes[0])
    assert np.mean(passes) < 4.5


def lengthened(k: int) -> dict[str, Any]:
    return {"tip_force": np.outer([0.3, 0.25, 0.0, 0.2], (0.01 * k, 0.004 * k, 0.0))}


BALL = sphere(0.02, name="ball", position=(0.026, 0.0, 0.09), friction=0.3)
FIELDS = ("position", "velocity", "base_wrench", "ok", "passes")


def assert_same(one: Any, two: Any, rows: Any = slice(None), rows_two: Any = slice(None)) -> None:
    for name in FIELDS:
        assert_array_equal(getattr(one, name)[rows], getattr(two, name)[rows_two], err_msg=name)
    assert_array_equal(one.contacts.total_force[rows], two.contacts.total_force[rows_two])


def test_snapshots_restore_every_bit_and_neighbours_do_not_matter() -> None:
    sim = simulator(rod(), BALL, n=4)
    sim.settle()
    for k in range(60):
        state = sim.step(**lengthened(k))
    assert state.contacts.in_contact().tolist() == [True, True, False, True]
    kept = sim.snapshot()
    first = [sim.step(**lengthened(60 + k)) for k in range(5)]
    sim.restore(kept)
    for k, one in enumerate(first):
        assert_same(sim.step(**lengthened(60 + k)), one)
    alone = simulator(rod(), BALL)
    alone.settle()
    for k in range(65):
        state = alone.step(tip_force=lengthened(k)["tip_force"][1])
    assert_allclose(state.position[0], first[-1].position[1], atol=1e-9)


def test_the_tip_answers_with_its_contacts_held() -> None:
    sim = simulator(rod(), BALL)
    sim.settle()
    for k in range(60):
        sim.step(tip_force=(0.3 * 0.01 * k, 0.0, 0.0))
    free = simulator(rod(), BALL)
    free.settle()
    assert np.abs(sim.compliance()[:, :3] - free.compliance()[:, :3]).max() > 1e-6
    assert np.isfinite(sim.compliance()).all()


@pytest.mark.study
@pytest.mark.parametrize("dt", [1e-3, 1e-2])
def test_distances_by_fcl_give_the_same_motion(dt: float) -> None:
    import trimesh

    solid = mesh(
        trimesh.creation.icosphere(subdivisions=3, radius=0.02), name="ball", position=(0.026, 0, 0.09)
    )
    found = []
    for collision in ("bvh", "fcl"):
        sim = simulator(rod(), solid, dt=dt, collision=collision)
        sim.settle()
        for k in range(40):
            state = sim.step(tip_force=(0.02 * k, 0.005 * k, 0.0))
        assert state.contacts.in_contact()[0]
        found.append((state.position, state.contacts.total_force))
    for one, other in zip(*found, strict=True):
        assert_allclose(one, other, atol=1e-9)


def crossing(solver: str, dynamics: bool) -> Simulator:
    """Two rods that cross, the second a little aside."""
    density = DENSITY if dynamics else 0.0
    first = rod(line_density=density)
    across = replace(
        first, base_position=(0.0085, -0.05, 0.07), base_quaternion=(0.5**0.5, -(0.5**0.5), 0, 0)
    )
    scene = ContactScene(worlds=[0, 0], rod_radius=RADIUS)
    given: Any = Modal(dynamics=True, modes=Modes(6, 4, pieces=2)) if dynamics else solver
    return Simulator([first, across], dt=1e-3, solver=given, contact=scene)


@pytest.mark.study
@pytest.mark.parametrize("dynamics", [True, False])
def test_two_rods_press_on_each_other_as_those_of_the_observer_do(dynamics: bool) -> None:
    force = np.array([[0.3, 0.0, 0.0], [0.0, 0.0, 0.0]])
    found = []
    for sim in (crossing("observer", False), crossing("modal", dynamics)):
        for part in np.linspace(0.0, 1.0, 12):
            state = sim.settle(tip_force=part * force)
            assert state.ok.all(), state.problems
        assert state.contacts.in_contact().all()
        assert_allclose(state.contacts.total_force.sum(0), 0.0, atol=1e-9)
        found.append((state.contacts.total_force, state.tip_position))
    (one, tip), (other, tip_other) = found
    assert_allclose(one, other, atol=2e-3 * np.abs(one).max())
    assert_allclose(tip, tip_other, atol=2e-5)


def struck(dt: float, mass: float = 0.01) -> float:
    """Velocity of a free ball after the tip of a rod has hit it [m/s]."""
    ball = sphere(0.01, name="ball", position=(0.02, 0.0, 0.095))
    sim = simulator(rod(damping_time=5e-4), ball, dt=dt)
    sim.settle(tip_force=(-0.4, 0.0, 0.0))
    place, velocity = np.array([0.02, 0.0, 0.095]), np.zeros(3)
    for _ in range(round(0.05 / dt)):
        ahead = place + dt * velocity
        sim.set_free("ball", dt * dt / mass, np.zeros((3, 3)), ahead, body=2026)  # any number
        state = sim.step(obstacle_pose={"ball": (*ahead, 1.0, 0.0, 0.0, 0.0)})
        assert state.ok.all(), state.problems
        velocity = velocity + dt / mass * state.contacts.wrench[0, 0, :3]
        place = place + dt * velocity
    return float(velocity[0])


@pytest.mark.study
def test_a_rod_that_is_let_go_throws_a_free_ball_to_first_order_in_the_step() -> None:
    thrown = np.array([struck(dt) for dt in (1e-3, 5e-4, 2.5e-4)])
    gained = np.diff(thrown)
    assert 0.1 < thrown[-1] < 0.2
    assert 1.5 < gained[0] / gained[1] < 2.6


@pytest.mark.study
def test_at_rest_modes_and_observer_bear_alike() -> None:
    found = []
    for solver in ("observer", "modal"):
        robot = rod(line_density=0.0)
        scene = ContactScene(obstacles=[replace(BALL, friction=0.0)], rod_radius=RADIUS)
        sim = Simulator(robot, solver=solver, contact=scene)  # type: ignore[arg-type]
        for part in np.linspace(0.0, 1.0, 9):
            state = sim.step(tip_force=(0.4 * part, 0.05 * part, 0.0))
            assert state.ok.all(), state.problems
        found.append((state.tip_position, state.contacts.total_force))
    (tip, force), (tip_other, force_other) = found
    assert_allclose(tip, tip_other, atol=1e-5)
    assert_allclose(force, force_other, atol=2e-3 * np.abs(force).max())


def test_what_goes_with_no_contact_is_refused() -> None:
    sim = simulator(rod(), BALL)
    sim.settle()
    with pytest.raises(InputError, match="estimate_error was given with a contact scene"):
        sim.step(estimate_error=True)


def test_what_stops_a_rod_is_said() -> None:
    inside = simulator(rod(), box((0.05, 0.05, 0.05), name="block", position=(0.0, 0.0, 0.07)))
    state = inside.settle()
    assert state.problems[0] == (
        "contact: neither the rod's rest nor its straight shape is clear; begin where it is."
    )
    aside = simulator(rod(), box((0.4, 0.4, 0.4), name="block", position=(0.3, 0.0, 0.0)))
    aside.settle()
    for _ in range(10):
        before = aside.step(tip_force=(0.01, 0.0, 0.0))
    state = aside.step(obstacle_pose={"block": (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)})
    assert not state.ok[0]
    assert "contact with 'block' at arclength" in state.problems[0]
    assert "come there in smaller steps." in state.problems[0]
    assert_array_equal(state.tip_position, before.tip_position)
    state = aside.step(obstacle_pose={"block": (0.3, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)}, tip_force=(0.01, 0, 0))
    assert state.ok.all()
    assert state.velocity[0, -1, 0] == pytest.approx(before.velocity[0, -1, 0], rel=0.2)  # it goes on
