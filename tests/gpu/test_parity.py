"""Both machines give the same numbers: the same source, other compilers and another order of robots."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gpu.pairs import PAPER_STEP, assert_same, assert_same_memory, chain, inputs, pair
from numpy.testing import assert_allclose, assert_array_equal
from rods import bend, rod

from fastrod import Observer, Robot, load_robot

ROBOTS = [rod(), rod("tendon_tension"), rod("passive"), rod("paper"), chain()]


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
def test_a_rollout_is_the_same_in_every_mode(robot: Robot) -> None:
    here, there = pair(robot)
    assert_same(here.settle(**inputs(robot, 0)), there.settle(**inputs(robot, 0)))
    for k in range(1, 4):
        a, b = here.step(**inputs(robot, k)), there.step(**inputs(robot, k))
        assert a.ok.all()
        assert_same(a, b, only=PAPER_STEP if robot.name == "paper" else None)
    assert_same_memory(here, there)
    assert_allclose(there.jacobian(turning=True), here.jacobian(turning=True), rtol=1e-6, atol=1e-7)
    assert_allclose(there.compliance(), here.compliance(), rtol=1e-9, atol=1e-9)
    assert_allclose(there.shape([0.01, 0.05]).position, here.shape([0.01, 0.05]).position, atol=1e-12)
    assert_same(here.settle(**inputs(robot, 5)), there.settle(**inputs(robot, 5)))


def test_a_jacobian_of_lengths_is_the_same_to_rounding() -> None:
    robot = rod()
    here, there = pair(robot)
    for sim in (here, there):
        sim.settle(**inputs(robot, 0))
    assert_allclose(there.jacobian()[:, :, :4], here.jacobian()[:, :, :4], rtol=1e-9, atol=1e-9)


def test_every_input_is_the_same() -> None:
    robot = chain()
    # the last step diverges, and what settles it begins elsewhere on a GPU
    here, there = pair(robot, recover=False)
    lengths = bend(robot, 0.3, 0.1) + np.where(robot.tendon_segment == 1, 0.01, 0.0)
    lengths[5] += 0.004
    given: dict[str, Any] = {
        "extension": (0.0, 0.01),
        "tip_moment": (1e-3, 0.0, 0.0),
        "line_force": np.full((2, 4, 3), 0.05),
        "point_force": [(0.07, (0.02, 0.0, 0.01))],
        "follower_tip_force": (0.01, 0.02, 0.0),
        "base_pose": (0.1, 0.2, 0.3, 0.6, 0.8, 0.0, 0.0),
    }
    force = np.array([[0.0, 0.02, 0.0], [0.01, 0.0, 0.0], [0.0, 0.0, -0.02]])
    assert_same(*(sim.settle(lengths, tip_force=force, **given) for sim in (here, there)))
    for size in (1.02, 1.04):
        assert_same(*(sim.step(lengths, tip_force=size * force, **given) for sim in (here, there)))
    assert_allclose(there.compliance(), here.compliance(), rtol=1e-8, atol=1e-8)
    del given["follower_tip_force"]
    given["extension"] = (0.0, 0.012)
    assert_same(*(sim.step(lengths, tip_force=force, **given) for sim in (here, there)))


def test_robots_that_differ_keep_their_own_numbers() -> None:
    robots = [rod(bending_stiffness=(k * 0.001, k * 0.0012), compliance=k * 1e-5) for k in (1, 2, 3, 4, 5)]
    here, there = pair(robots, None)
    for k in range(3):
        given = inputs(robots[0], k, 5)
        a, b = (sim.step(**given) for sim in (here, there))
    assert_same(a, b)
    assert np.ptp(a.tip_position[:, 1]) > 1e-3
    assert_same_memory(here, there)


def test_effects_in_the_robot_file() -> None:
    effects = {"name": "backlash", "half_width": 2e-4}, {"name": "gravity", "line_density": 0.05}
    here, there = pair(replace(rod(), effects=effects))
    for k in range(3):
        a, b = (sim.step(**inputs(rod(), k)) for sim in (here, there))
        assert_same(a, b)
        assert b.ok.all()


# of numpy, where the simulator runs the lost robot's pass
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_lost_robot_beside_good_ones() -> None:
    here, there = pair(rod())
    rest = rod().rest_tendon_length
    wild = np.array([[0.0, 0.01, 0.0], [0.0, 1e6, 0.0], [0.0, 0.02, 0.0]])
    for sim in (here, there):
        sim.settle(rest)
    for _ in range(3):
        a, b = (sim.step(rest, tip_force=wild) for sim in (here, there))
    assert_array_equal(b.ok, [True, False, True])
    assert_array_equal(a.ok, b.ok)
    assert "diverged" in b.problems[1]
    assert_allclose(b.tip_position[[0, 2]], a.tip_position[[0, 2]], atol=1e-11)
    for _ in range(4):
        a, b = (sim.step(rest, tip_force=0.0 * wild) for sim in (here, there))
    assert b.ok.all()
    assert_allclose(b.tip_position[1], [0.0, 0.0, 0.07], atol=1e-9)


def test_bad_input_leaves_a_robot_out() -> None:
    here, there = pair(rod())
    good = inputs(rod(), 1)["tendon_length"]
    assert_same(*(sim.settle(good) for sim in (here, there)))
    bad = good.copy()
    bad[1, 2] = np.nan
    a, b = (sim.step(bad) for sim in (here, there))
    assert_same(a, b)
    assert "finite" in b.problems[1]
    assert np.isnan(b.tip_position[1]).all()
    assert_same(*(sim.step(good) for sim in (here, there)))


def test_steep_loads_take_the_same_way() -> None:
    here, there = pair(rod("passive"))
    force = np.array([[0.0, 8.0, 0.0], [0.0, 1.0, -1.0], [3.0, 0.0, -4.0]])
    a, b = (sim.settle(tip_force=force) for sim in (here, there))
    assert a.ok.all()
    assert a.passes.max() > 10
    assert_allclose(b.tip_position, a.tip_position, atol=1e-10)
    assert b.ok.all()


def test_an_observer_that_carries_its_covariance() -> None:
    here, there = pair(rod(), solver=Observer(process_noise=1.0, measurement_noise=1e-10))
    for k in range(4):
        a, b = (sim.step(**inputs(rod(), k)) for sim in (here, there))
    assert_allclose(b.tip_position, a.tip_position, atol=1e-9)
    assert np.abs(here.snapshot().memory.covariance).max() > 0.0
    assert_same_memory(here, there)


def test_a_held_gain() -> None:
    here, there = pair(rod(), solver=Observer(kept_jacobian_tolerance=1e-3), outputs="tip")
    for k in range(4):
        a, b = (sim.step(inputs(rod(), k)["tendon_length"]) for sim in (here, there))
    assert_allclose(b.tip_position, a.tip_position, atol=1e-11)
    assert_same_memory(here, there)


def test_a_jacobian_that_comes_with_the_step() -> None:
    here, there = pair(rod(), 1)
    for sim in (here, there):
        sim.settle(**inputs(rod(), 0, 1))
    assert_same(*(sim.step(inputs(rod(), 1, 1)["tendon_length"], derive=True) for sim in (here, there)))
    assert_allclose(there.jacobian(turning=True), here.jacobian(turning=True), rtol=1e-6, atol=1e-7)
    assert_same(*(sim.step(inputs(rod(), 2, 1)["tendon_length"]) for sim in (here, there)))


def test_settled_rows_leave_the_others_as_they_are() -> None:
    here, there = pair(rod())
    assert_same(*(sim.settle(**inputs(rod(), 0)) for sim in (here, there)))
    before = there.state
    a, b = (sim.settle(**inputs(rod(), 3), rows=[2]) for sim in (here, there))
    assert_same(a, b)
    assert_array_equal(b.position[:2], before.position[:2])
    assert_same(*(sim.step(**inputs(rod(), 4)) for sim in (here, there)))


def test_a_step_that_diverges_settles_on_both_machines() -> None:
    robot = load_robot("five_segment_reacher")
    here, there = pair(robot, points_per_segment=2, outputs="tip")
    force = np.array([(0.0, 0.001, 0.0), (0.0, 0.05, 0.0), (0.0, 0.001, 0.0)])
    for sim in (here, there):
        sim.settle(robot.rest_tendon_length)
        state = sim.step(robot.rest_tendon_length + 0.002 * np.eye(15)[0], tip_force=force)
        assert state.ok.all()
        assert state.passes[1] > state.passes[0]
    # from where it stood here, from the cold guess there: the same shape
    assert_allclose(there.state.tip_position[1], here.state.tip_position[1], atol=1e-8)
