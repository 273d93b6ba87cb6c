"""Obstacles that give way with a body's own inertia."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rods import rod

from fastrod.contact import ContactScene, box, plane
from fastrod.model.robotfile import load_robot
from fastrod.simulator import Simulator

SHIFTS = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
PULL = np.array([-0.009, 0.0, 0.009, 0.0])


def wall_and_rod(**wall):
    robot = load_robot("prototype")
    scene = ContactScene(
        obstacles=[plane(point=(0.02, 0.0, 0.0), normal=(-1.0, 0.0, 0.0), name="wall", **wall)]
    )
    return robot.rest_tendon_length, Simulator(robot, points_per_segment=10, contact=scene)


def pressed(rest, sim, most=1.0):
    for part in np.linspace(0.0, most, 20):
        state = sim.step(rest + part * PULL)
    assert state.ok[0]
    return state.contacts


@pytest.mark.study(beyond=2)
@pytest.mark.parametrize("give", [1e-5, 1e-2, 1e-3])
def test_body_that_only_shifts_is_a_spring(give):
    rest, sim = wall_and_rod()
    sim.set_free("wall", give * SHIFTS, np.zeros(3))
    free = pressed(rest, sim)
    spring = pressed(*wall_and_rod(stiffness=1.0 / give))
    np.testing.assert_allclose(free.force[0, 0], spring.force[0, 0], rtol=1e-4)  # a step is at rest to 1e-6 m
    assert -free.gap[0, 0] == pytest.approx(give * np.linalg.norm(free.force[0, 0]), rel=1e-2, abs=1e-6)


@pytest.mark.parametrize("give", [1e-5, 1e-2])
def test_where_a_body_that_is_touched_is_expected_does_not_matter(give):
    place, dt = np.array([0.06, 0.0, 0.05]), 0.005
    scene = ContactScene(obstacles=[box((0.08, 0.2, 0.2), name="wall", position=place, friction=0.2)])
    sims = [Simulator(rod(damping_time=0.02), dynamics=True, dt=dt, contact=scene) for _ in range(2)]
    length = np.array(sims[0].robots[0].rest_tendon_length)
    for sim in sims:
        sim.settle(length)
    ahead, largest = np.zeros(6), 0.0
    for k in range(60):
        change = 0.003 * np.sin(k / 12.0) * np.resize([-1.0, 0.0, 1.0, 0.0], len(length))
        sims[0].set_free("wall", give * SHIFTS, np.zeros(3))
        plain = sims[0].step(length + change, obstacle_velocity={"wall": np.zeros(6)})
        sims[1].set_free("wall", give * SHIFTS, np.zeros(3), ahead=ahead)
        poses = {"wall": (*(place + ahead[:3]), 1.0, 0.0, 0.0, 0.0)}
        moved = sims[1].step(length + change, obstacle_pose=poses, obstacle_velocity={"wall": ahead / dt})
        force = plain.contacts.wrench[0, 0, :3]
        assert_allclose(moved.contacts.wrench[0, 0, :3], force, atol=1e-6 * np.abs(force).max())
        ahead[:3], largest = give * force, max(largest, np.abs(force).max())
    assert largest > 0.05


def test_friction_moves_a_free_body_along():
    # what gives way in every direction feels less friction than what is held: it goes with the rod
    held = pressed(*wall_and_rod(friction=0.1), most=0.6)
    rest, sim = wall_and_rod(friction=0.1)
    sim.set_free("wall", 0.05 * SHIFTS, np.zeros(3))
    free = pressed(rest, sim, most=0.6)
    assert abs(free.force[0, 0, 2]) < abs(held.force[0, 0, 2])


def test_body_that_is_hit_off_its_middle_gives_way_by_turning():
    robot = load_robot("prototype")
    center, size = np.array([0.05, 0.0, 0.1]), (0.06, 0.2, 0.2)
    scene = ContactScene(obstacles=[box(size, name="box", position=center)])
    depth = {}
    for turn in (0.0, 2.0):
        sim = Simulator(robot, points_per_segment=10, contact=scene)
        sim.set_free("box", np.diag(np.repeat([1e-4, turn], 3)), center)
        contacts = pressed(robot.rest_tendon_length, sim)
        lever = np.cross(contacts.point[0, 0] - center, contacts.normal[0, 0])
        expected = (1e-4 + turn * lever @ lever) * (contacts.force[0, 0] @ contacts.normal[0, 0])
        depth[turn] = -contacts.gap[0, 0]
        assert depth[turn] == pytest.approx(expected, rel=1e-2, abs=2e-6)
    assert depth[2.0] > 10.0 * depth[0.0]


@pytest.mark.parametrize("stiffness", [10.0, 1e3, 1e5])
def test_straight_rod_pressed_along_its_axis_on_something_soft(stiffness):
    # it cannot give way, so the obstacle does: force = stiffness x depth
    robot = load_robot("prototype")
    wall = plane(point=(0, 0, 0.0835), normal=(0, 0, -1), name="wall", stiffness=stiffness)
    sim = Simulator(robot, points_per_segment=8, contact=ContactScene(obstacles=[wall]))
    for z in (0.0, 0.001, 0.002):
        state = sim.step(robot.rest_tendon_length, base_pose=(0, 0, z, 1, 0, 0, 0))
    assert state.ok[0]
    assert state.contacts.in_contact("wall")[0]
    if stiffness < 1e4:  # below the load under which the straight rod buckles
        np.testing.assert_allclose(
            state.contacts.total_force[0], [0, 0, -stiffness * 0.0005], atol=1e-6 * stiffness
        )
