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
from fastrod.rotation import displaced, quaternion_from_matrix

RADIUS, LENGTH, EI, DENSITY = 0.004, 0.1, 0.01, 0.05
ALONG_X = (0.5**0.5, 0.0, 0.5**0.5, 0.0)
ACROSS = (0.5**0.5, 0.5**0.5, 0.0, 0.0)
WEIGHTLESS = (0.0, 0.0, 0.0)
SHIFTS = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])


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


def crossing(dynamics: bool) -> Simulator:
    """Two rods that cross, the second a little aside."""
    first = rod(line_density=DENSITY if dynamics else 0.0)
    across = replace(
        first, base_position=(0.0085, -0.05, 0.07), base_quaternion=(0.5**0.5, -(0.5**0.5), 0, 0)
    )
    scene = ContactScene(worlds=[0, 0], rod_radius=RADIUS)
    given: Any = Modal(dynamics=True, modes=Modes(6, 4, pieces=2)) if dynamics else None
    return Simulator([first, across], dt=1e-3, solver=given, contact=scene)


@pytest.mark.study
def test_two_rods_press_on_each_other_in_motion_as_at_rest() -> None:
    force = np.array([[0.3, 0.0, 0.0], [0.0, 0.0, 0.0]])
    found = []
    for sim in (crossing(False), crossing(True)):
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
        sim.set_free("ball", dt * dt / mass * SHIFTS, ahead, body=2026)  # any number
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


def test_a_rod_that_touches_is_bent_as_a_free_one_by_the_same_forces() -> None:
    """Free ones are the observer's, those that touch are rods of modes."""
    robot = rod(line_density=0.0)
    scene = ContactScene(obstacles=[replace(BALL, friction=0.0)], rod_radius=RADIUS)
    touching, free = Simulator(robot, contact=scene), Simulator(robot)
    for part in np.linspace(0.0, 1.0, 9):
        state = touching.step(tip_force=(0.4 * part, 0.05 * part, 0.0))
        assert state.ok.all(), state.problems
        contacts = state.contacts
        loads = list(zip(contacts.arclength[0], contacts.force[0], strict=True))
        alone = free.settle(tip_force=(0.4 * part, 0.05 * part, 0.0), point_force=loads or None)
        assert_allclose(state.tip_position, alone.tip_position, atol=1e-5)
    assert contacts.in_contact().all()
    touching.step(tip_force=(0.0, 0.0, 0.0))
    state = touching.step(tip_force=(0.0, 0.0, 0.0))
    assert not state.contacts.in_contact().any()
    assert_allclose(state.tip_position, free.settle().tip_position, atol=1e-9)


def coiled(turn: float) -> dict[str, Any]:
    """Tendons that bend the third segment most, so that its tip comes to the first from the side [rad]."""
    share = np.cumsum([0.0, 1.0, 3.0]) / 4.0
    return {"tendon_length": REST + np.tile([-1.0, 0.0, 1.0, 0.0], 3) * np.repeat(share, 4) * 0.004 * turn}


REST = np.repeat([0.1, 0.2, 0.3], 4)


@pytest.mark.parametrize("dynamics", [False, pytest.param(True, marks=pytest.mark.study)])
def test_a_rod_that_coils_feels_itself(dynamics: bool) -> None:
    tendons = tuple(
        Tendon(offset=0.004, angle=a, compliance=1e-5) for a in (0.0, np.pi / 2, np.pi, 1.5 * np.pi)
    )
    (segment,) = rod(
        mode="tendon_length", tendons=tendons, line_density=DENSITY if dynamics else 0.0
    ).segments
    robot = Robot(name="coil", segments=(segment, segment, segment), gravity=WEIGHTLESS)
    scene = ContactScene(self_contact=True, rod_radius=0.005)
    sim = Simulator(robot, dt=2e-3, points_per_segment=20, contact=scene, dynamics=dynamics)
    sim.settle(**coiled(np.radians(400.0)))
    for turn in np.radians(np.arange(400.0, 444.0, 1.8)):
        state = sim.step(**coiled(turn))
        assert state.ok.all(), state.problems
    assert state.contacts.count[0] >= 2
    assert_allclose(state.contacts.total_force[0], 0.0, atol=1e-9)
    s = np.linspace(0.0075, 0.3, 400)
    place = sim.shape(s).position[0]
    apart = np.linalg.norm(place[:, None] - place, axis=2)[np.abs(s[:, None] - s) > 0.05].min()
    assert apart > 0.01 - 2e-5


@pytest.mark.parametrize("ratio", [0.2, 20.0])
def test_a_body_and_its_rod_lose_no_momentum_when_the_rod_hits_a_wall(ratio: float) -> None:
    """The engine's part is done here: the body flies, and feels the mean wrench of the rod."""
    dt, robot = 1e-3, rod()
    wall = plane(point=(0.0, 0.0, LENGTH + 0.004), normal=(0.3, 0.0, -1.0), name="wall", friction=0.4)
    sim = simulator(robot, wall)
    sim.settle()
    mass = ratio * DENSITY * LENGTH
    inverse = np.diag(1.0 / np.repeat([mass, mass * 0.02**2], 3))
    twist, pose = np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    sim.set_in_motion(twist)
    before, touched = sim.momentum()[0], 0
    for _ in range(40):
        state = sim.step(base_pose=displaced(pose[None], dt * twist[None])[0], inverse_inertia=inverse)
        assert state.ok.all(), state.problems
        now, force = sim.momentum()[0], state.contacts.total_force[0]
        assert_allclose((now - before)[:3] + dt * state.mean_wrench[0, :3], dt * force, atol=1e-15)
        twist, before = twist + dt * inverse @ state.mean_wrench[0], now
        pose = np.concatenate([state.position[0, 0], quaternion_from_matrix(state.rotation[:1, 0])[0]])
        touched += force.any()
    assert touched > 0
    assert state.contacts.clearance[0] > -1e-5
    assert 0.5 * mass * twist[:3] @ twist[:3] < 0.5 * mass * 0.5**2


@pytest.mark.parametrize("moving", [True, False])
@pytest.mark.parametrize(("larger", "stiffer"), [(10.0, 1e4), (10.0, 1e6), (0.1, 1e-4), (1.0, 1e5)])
def test_similar_rods_do_the_same_however_large_and_stiff(
    moving: bool, larger: float, stiffer: float
) -> None:
    """A ball that comes at 2 m/s: all lengths go by one number, all forces by another."""

    def struck(size: float, stiff: float) -> Any:
        bends = {"bending_stiffness": (stiff * EI,) * 2, "torsional_stiffness": stiff * EI}
        lengths = {"length": size * LENGTH, "body_radius": size * RADIUS}
        robot = rod(**bends, **lengths, line_density=DENSITY * stiff / size**4)
        scene = ContactScene(obstacles=[sphere(0.02 * size, name="ball")], rod_radius=size * RADIUS)
        sim = Simulator(robot, dt=2e-3, solver=Modal(dynamics=moving, modes=Modes(4, 2)), contact=scene)
        rows = []
        for k in range(8):
            x = size * (0.0285 - 0.004 * min(k, 3))
            state = sim.step(obstacle_pose={"ball": (x, 0.0, 0.06 * size, 1.0, 0.0, 0.0, 0.0)})
            assert state.ok.all()
            rows.append((state.position[0] / size, state.contacts.total_force[0] * size**2 / stiff))
        return tuple(map(np.array, zip(*rows, strict=True)))

    (here, force), (there, other) = struck(1.0, 1.0), struck(larger, stiffer)
    assert np.abs(force).max() > 1.0
    assert_allclose(there, here, atol=1e-4 * LENGTH)
    assert_allclose(other, force, rtol=1e-2, atol=1e-2)


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
    assert state.problems[0] == (
        "contact with 'block' at arclength 0.006 m, where the rod is mounted and cannot yield: keep it clear "
        "of there."
    )
    assert_array_equal(state.tip_position, before.tip_position)
    state = aside.step(obstacle_pose={"block": (0.3, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)}, tip_force=(0.01, 0, 0))
    assert state.ok.all()
    assert state.velocity[0, -1, 0] == pytest.approx(before.velocity[0, -1, 0], rel=0.2)  # it goes on
    jaws = [box((0.02, 0.3, 0.03), name=n, position=(x, 0.0, 0.1)) for n, x in (("l", -0.02), ("r", 0.02))]
    squeezed = simulator(rod(), *jaws)
    squeezed.settle()
    state = squeezed.step(obstacle_pose={"l": (-0.012, 0, 0.1, 1, 0, 0, 0), "r": (0.012, 0, 0.1, 1, 0, 0, 0)})
    assert "' at arclength 0.0" in state.problems[0]
    assert "come there in smaller steps." in state.problems[0]
