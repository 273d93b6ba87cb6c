"""Closed forms, convergence, conservation, symmetry, limits."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rods import bend, rod
from truth.energy import minimise

from fastrod import Robot, Simulator, load_robot
from fastrod.reference import shoot

# P l^2/EI -> w/l
ELASTICA = {1.0: 0.301720773800, 2.0: 0.493457480397, 5.0: 0.713791523612, 10.0: 0.810609024880}


def test_no_load_and_equal_bends_give_an_arc() -> None:
    # r(l) of an arc of angle b about d1 is (0, -(1 - cos b), sin b) l/b: exact for constant moment
    for angle in (0.3, 1.0, 2.5):
        state = Simulator(rod()).settle(bend(rod(), angle, 0.0))
        u = state.curvature[0, 0, 0]
        b = u * 0.07
        assert_allclose(state.tip_position[0], np.array([0.0, -(1 - np.cos(b)), np.sin(b)]) / u, atol=1e-12)
        assert_allclose(state.curvature[0], np.tile(state.curvature[0, 0], (21, 1)), atol=1e-9)


def test_a_precurved_twisted_rod_is_a_helix() -> None:
    # with u* and no moment R = exp(s [u*]x): radius k/(k^2 + t^2) around the axis u*
    u = np.array([12.0, 0.0, 30.0])
    state = Simulator(rod("passive", precurvature=tuple(u))).settle()
    axis = u / np.linalg.norm(u)
    across = np.eye(3) - np.outer(axis, axis)
    # the axis passes at distance k/(k^2+t^2) from the base, toward the first normal
    centre = np.cross(u, [0.0, 0.0, 1.0]) / (u @ u)
    radius = np.linalg.norm((state.position[0] - centre) @ across, axis=1)
    assert_allclose(radius, 12.0 / (u @ u), rtol=1e-6)


@pytest.mark.parametrize(("load", "deflection"), ELASTICA.items())
def test_elastica(load: float, deflection: float) -> None:
    force = load * 0.0022 / 0.07**2
    state = Simulator(rod("passive"), points_per_segment=40).settle(tip_force=(0.0, force, 0.0))
    assert_allclose(state.tip_position[0, 1] / 0.07, deflection, atol=2e-7)


@pytest.mark.parametrize("mode", ["passive", "tendon_length"])
def test_shape_is_fourth_order_in_the_step(mode: str) -> None:
    robot = rod(mode)
    lengths = bend(robot, 0.8, -0.5) if mode != "passive" else None

    def tip(n: int) -> np.ndarray:
        sim = Simulator(robot, points_per_segment=n)
        return sim.settle(lengths, tip_force=(0.1, 0.3, -0.1), tolerance=1e-12).tip_position[0]

    exact, steps = tip(320), np.array([8, 16, 32])
    slope = np.polyfit(np.log(steps), np.log([np.linalg.norm(tip(n) - exact) for n in steps]), 1)[0]
    assert slope == pytest.approx(-4.0, abs=0.25)


def test_the_observer_converges_quadratically() -> None:
    robot = rod()
    sim = Simulator(robot)
    lengths = bend(robot, 0.9, 0.4)
    sim.settle(lengths, tip_force=(0.02, -0.05, 0.03))
    residual = [sim.step(lengths, tip_force=(0.1, -0.25, 0.15)).residual[0] for _ in range(4)]
    # each digit count doubles until rounding
    assert residual[1] < 3.0 * residual[0] ** 2 / 0.0075
    assert residual[3] < 1e-12


def test_out_of_plane_loads_against_the_energy_minimum() -> None:
    robot = rod(compliance=1e-4)
    lengths = bend(robot, 0.9, -0.5)
    force, line = np.array([0.2, -0.15, 0.25]), np.array([0.5, 1.0, -0.7])
    state = Simulator(robot, points_per_segment=40).settle(lengths, tip_force=force, line_force=line)
    offsets = np.array([tendon.position(1)[0] for tendon in robot.tendons])
    found = minimise(0.07, np.array([0.0022, 0.0022, 0.001]), offsets, lengths, 1e-4, force, line)
    assert_allclose(state.tip_position[0], found.tip_position, rtol=0, atol=1e-8)
    assert_allclose(state.tension[0], found.tension, rtol=1e-5)


def test_rotating_the_world_rotates_the_answer() -> None:
    robot = replace(rod(line_density=0.3), gravity=(0.0, 0.0, 0.0))
    half = np.pi / 7
    quaternion = np.array([np.cos(half), *(np.sin(half) * np.array([1, 2, -2]) / 3)])
    rotated = Simulator(replace(robot, base_quaternion=tuple(quaternion)))
    rotation = rotated.settle(robot.rest_tendon_length).tip_rotation[0]
    force, lengths = np.array([0.1, -0.2, 0.05]), bend(robot, 0.6, 0.7)
    one = Simulator(robot).settle(lengths, tip_force=force)
    two = Simulator(robot).settle(lengths, tip_force=rotation @ force, base_pose=[1.0, 2.0, 3.0, *quaternion])
    assert_allclose(two.tip_position[0], rotation @ one.tip_position[0] + [1, 2, 3], atol=1e-9)
    assert_allclose(two.tension, one.tension, atol=1e-6)
    for part in (slice(0, 3), slice(3, 6)):  # force and moment
        assert_allclose(two.base_wrench[0, part], rotation @ one.base_wrench[0, part], atol=1e-9)


def test_the_base_carries_all_loads() -> None:
    robot = replace(load_robot("tdcr_a"), gravity=(0.0, 0.0, -9.81))
    robot = replace(robot, segments=tuple(replace(s, line_density=0.05) for s in robot.segments))
    force, moment, point = np.array([0.3, -0.1, 0.2]), np.array([0.01, 0.0, -0.02]), np.array([0.0, 0.4, 0.0])
    lengths = bend(robot, 0.5, 0.2) + bend(robot, -0.3, 0.4, 1) - robot.rest_tendon_length
    sim = Simulator(robot, points_per_segment=40)
    state = sim.settle(lengths, tip_force=force, tip_moment=moment, point_force=[(0.13, point)])
    weight = np.array([0.0, 0.0, -9.81 * 0.05])
    assert_allclose(state.base_wrench[0, :3], force + point + 0.4 * weight, atol=1e-12)
    s, r = state.arclength[0], state.position[0]
    step = np.diff(s)[:, None]
    middle = sim.shape(0.5 * (s[1:] + s[:-1])).position[0]
    centroid = (step * (r[1:] + 4 * middle + r[:-1]) / 6).sum(0)  # integral of r: Simpson, fourth order
    at = sim.shape([0.13]).position[0, 0]
    whole = np.cross(r[-1], force) + moment + np.cross(at, point) + np.cross(centroid, weight)
    assert_allclose(state.base_wrench[0, 3:], whole, atol=1e-8)


def test_inextensible_tendons_lock_the_twist_and_loose_ones_let_the_rod_go() -> None:
    force = (0.25, 0.1, 0.0)
    lengths = bend(rod(), 1.2, 0.0)
    twist, tip = [], []
    for compliance in (1e-3, 1e-5, 1e-7, 1e-9, 0.0):
        state = Simulator(rod(compliance=compliance)).settle(lengths, tip_force=force)
        assert state.ok.all(), state.problems
        twist.append(np.abs(state.curvature[0, :, 2]).max())
        tip.append(state.tip_position[0])
    assert twist[0] > twist[1] > twist[2] > 0.0
    # as the cube root of the compliance, down to the stiffest tendon there is
    assert twist[2] > twist[3] == twist[4]
    assert twist[3] < 0.1 * twist[1]
    loose = Simulator(rod(compliance=1e6)).settle(lengths, tip_force=force)
    free = Simulator(rod("passive")).settle(tip_force=force)
    assert_allclose(loose.tip_position, free.tip_position, atol=1e-7)


@pytest.mark.study
def test_a_slack_tendon_carries_nothing() -> None:
    robot = one_sided(rod(), pretension=0.2)
    # pulled by one, the opposite one paid out far
    lengths = robot.rest_tendon_length + np.array([-0.004, 0.0, 0.01, 0.0])
    state = Simulator(robot).settle(lengths)
    assert state.ok.all()
    assert state.tension[0, 2] == 0.0
    assert (state.tension >= 0.0).all()
    assert state.path_length[0, 2] < lengths[2]  # it hangs loose
    assert_allclose(state.tip_position[0], shoot(robot, lengths).tip_position, atol=1e-7)


def test_a_follower_force_keeps_its_place_on_the_tip() -> None:
    robot = rod("passive")
    given = np.array([0.0, 0.15, 0.05])
    state = Simulator(robot, points_per_segment=40).settle(follower_tip_force=given)
    assert state.passes[0] <= 8
    world = state.tip_rotation[0] @ given
    dead = Simulator(robot, points_per_segment=40).settle(tip_force=world)
    assert_allclose(state.tip_position, dead.tip_position, atol=1e-9)
    assert_allclose(state.base_wrench[0, :3], world, atol=1e-8)


@pytest.mark.study
def test_point_force_anywhere_matches_the_twin_and_keeps_the_order() -> None:
    lengths = bend(rod(), 0.7, 0.2)
    points = [(0.0313, (0.2, 0.1, 0.0)), (0.0521, (-0.1, 0.0, 0.3))]
    loads = {"point_force": points, "tip_force": (0.0, 0.1, 0.0)}
    twin = shoot(rod(), lengths, **loads)

    def error(n: int) -> float:
        state = Simulator(rod(), points_per_segment=n).settle(lengths, **loads)
        return np.linalg.norm(state.tip_position[0] - twin.tip_position)

    assert error(24) < 1e-7
    assert error(24) < error(6) / 50.0  # fourth order: 256; a kink inside a step would leave first or second


@pytest.mark.study
def test_sampled_line_force_and_extension_match_the_twin() -> None:
    robot = load_robot("five_segment_reacher")
    robot = replace(robot, segments=robot.segments[3:])
    lengths = bend(robot, 0.2, 0.1) + np.where(robot.tendon_segment == 1, 0.03, 0.0)
    line = np.array([[[0.1, 0.0, -0.2], [0.0, 0.2, -0.1]], [[0.0, 0.0, -0.1], [0.1, 0.1, 0.0]]])
    loads = {"extension": (0.0, 0.03), "line_force": line}
    state = Simulator(robot, points_per_segment=20).settle(lengths, **loads)
    twin = shoot(robot, lengths, **loads)
    assert_allclose(state.tip_position[0], twin.tip_position, atol=1e-7)
    assert_allclose(state.tension[0], twin.tension, atol=1e-4)
    assert state.arclength[0, -1] == pytest.approx(0.23)


def test_stiffness_and_precurvature_that_vary_along_the_rod() -> None:
    """The port for K(s) and u*(s), at every half step: the effects of a later day change it in place."""
    n, length, force = 10, 0.07, 1e-6
    sim = Simulator(rod("passive"), points_per_segment=n)
    s = np.linspace(0.0, length, 2 * n + 1)
    stiffness = np.array([0.0022, 0.0022, 0.001]) * (1.0 + 0.5 * (1.0 - 2.0 * s / length))[:, None]
    bare, rest = sim._reader.rest, np.zeros((1, 1, 2 * n + 1, 3))
    sim._reader.rest = bare._replace(stiffness=stiffness[None, None], precurvature=rest)
    state = sim.settle(tip_force=(0.0, force, 0.0))
    # so small a force bends as the linear beam does: w = integral of F (l - s)^2 / EI(s)
    fine = np.linspace(0.0, length, 20001)
    w = np.trapezoid((length - fine) ** 2 / (0.0022 * (1.0 + 0.5 * (1.0 - 2.0 * fine / length))), fine)
    assert_allclose(state.tip_position[0, 1], force * w, rtol=1e-5)
    between = np.interp(0.033, state.arclength[0], state.position[0, :, 1])
    assert_allclose(sim.shape([0.033]).position[0, 0, 1], between, rtol=2e-2)
    # and a plane u*(s) without load turns the tip by its integral
    rest[0, 0, :, 0] = 8.0 * np.cos(20.0 * s)
    sim._reader.rest = bare._replace(stiffness=stiffness[None, None], precurvature=rest)
    rotation = sim.settle().tip_rotation[0]
    angle = 8.0 / 20.0 * np.sin(20.0 * length)
    assert_allclose(np.arctan2(-rotation[1, 2], rotation[2, 2]), angle, atol=1e-6)


def one_sided(robot: Robot, **changes: Any) -> Robot:
    """The robot with tendons that can only pull."""
    segments = (
        replace(s, tendons=tuple(replace(t, unilateral=True, **changes) for t in s.tendons))
        for s in robot.segments
    )
    return replace(robot, segments=tuple(segments))


@pytest.mark.study
@pytest.mark.parametrize("pull", [0.0, 3e-4, -1e-3])
def test_cable_robots_taut_and_loose_match_the_twin(pull: float) -> None:
    """Tendons that can only pull: pulled together, let go together, and at the edge where some hang loose."""
    rng = np.random.default_rng(4)
    for robot in (one_sided(rod()), one_sided(load_robot("tdcr_a"))):
        angles = rng.uniform(-0.6, 0.6, (40, 2 * robot.n_segments))
        each = range(robot.n_segments)
        lengths = np.stack([sum(bend(robot, *a[2 * k : 2 * k + 2], k) for k in each) for a in angles])
        lengths -= (robot.n_segments - 1) * robot.rest_tendon_length + pull * (1 + robot.tendon_segment)
        force = rng.uniform(-0.1, 0.1, (40, 3))
        state = Simulator(robot, n_robots=40).settle(lengths, tip_force=force)
        assert state.ok.all(), state.problems
        assert (state.tension >= 0.0).all()
        # a tendon is never shorter than its path
        assert (state.path_length <= lengths + 1e-5 * state.tension + 1e-8).all()
        assert np.abs(state.moment[:, -1]).max() < 1e-9  # and the tip is free of moment
        # the twin takes minutes on a chain with slack tendons
        for i in (0, 1) if robot.n_segments == 1 else ():
            twin = shoot(robot, lengths[i], tip_force=force[i])
            assert twin.success
            assert_allclose(state.tip_position[i], twin.tip_position, atol=1e-7)


@pytest.mark.study
def test_any_sampling_of_a_line_force_keeps_its_force_and_moment() -> None:
    rng = np.random.default_rng(6)
    for points in (2, 4, 7, 31, 200):
        line = rng.uniform(-1.0, 1.0, (1, points, 3))
        loads = {"line_force": line, "point_force": [(0.0237, (0.0, 1e-9, 0.0))]}  # which moves the nodes
        state = Simulator(rod("passive")).settle(**loads)
        whole = np.trapezoid(line[0], dx=0.07 / (points - 1), axis=0)
        assert_allclose(state.base_wrench[0, :3], whole, atol=2e-9)
        twin = shoot(rod("passive"), **loads)
        # a polyline that bends inside a step is met in force and moment there: what is left is of third order
        assert_allclose(state.tip_position[0], twin.tip_position, atol=2e-6)
