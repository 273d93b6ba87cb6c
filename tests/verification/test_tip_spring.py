"""A spring on the tip: its force where the tip is, in `settle`, in steps, over a log, and in the slopes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from identification.logs import log_of, two_segments, wave
from numpy.testing import assert_allclose
from rods import bend, rod
from scipy.spatial.transform import Rotation
from verification.test_derivatives import difference

from fastrod import Robot, Simulator
from fastrod.identification.log.replay import replay

POINT = np.array([0.04, -0.02, 0.05])
"""Beside a rod of 70 mm; of the longer robots, 90 mm further out: a stiff spring must not press them flat."""
BASE = np.array([0.1, 0.2, 0.3, *Rotation.from_rotvec([0.4, -0.8, 0.3]).as_quat(scalar_first=True)])


def tied(robot: Robot, stiffness: float, *more: dict[str, Any]) -> Robot:
    """The robot with a spring to `POINT` of its base frame."""
    point = POINT + np.array([0.0, 0.0, 0.09 * (robot.n_segments > 1)])
    spring = {"name": "tip_spring", "stiffness": stiffness, **dict(zip("xyz", point.tolist(), strict=True))}
    return replace(robot, effects=(spring, *more))


def pull(tip: np.ndarray, stiffness: float) -> np.ndarray:
    """World force of the spring at a world tip on `BASE`."""
    rotation = Rotation.from_quat(BASE[3:], scalar_first=True)
    return stiffness * (BASE[:3] + rotation.apply(POINT) - tip)


@pytest.mark.parametrize("stiffness", [1.0, 20.0, 400.0])
def test_a_settled_rod_is_in_balance_with_the_spring(stiffness: float) -> None:
    """The same rod under the force that the spring has where its tip is; 400 N/m is twenty times what bends
    the rod."""
    robot = rod()
    given: dict[str, Any] = {"tendon_length": bend(robot, 0.5, -0.3), "base_pose": BASE}
    sim = Simulator(tied(robot, stiffness), points_per_segment=8)
    state = sim.settle(**given, tolerance=1e-11)
    assert state.ok.all()
    force = pull(state.tip_position[0], stiffness)
    alone = Simulator(robot, points_per_segment=8).settle(**given, tip_force=force, tolerance=1e-12)
    assert_allclose(state.tip_position, alone.tip_position, atol=2e-10)
    assert np.linalg.norm(force) > 0.02
    again = sim.settle(**given, tolerance=1e-11)
    assert_allclose(again.tip_position, state.tip_position, atol=2e-10)


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("stiffness", [5.0, 400.0])
def test_steps_come_to_where_settle_is(stiffness: float) -> None:
    robot = tied(two_segments(), stiffness)
    lengths = bend(robot, 0.4, 0.2) + bend(robot, -0.3, 0.4, 1) - robot.rest_tendon_length
    settled = Simulator(robot, points_per_segment=6).settle(lengths, tolerance=1e-11)
    sim = Simulator(robot, points_per_segment=6)
    for _ in range(12):
        state = sim.step(lengths)
    assert_allclose(state.tip_position, settled.tip_position, atol=1e-8)


def test_robots_of_a_batch_and_left_out_ones_keep_their_own_springs() -> None:
    robots = [tied(rod(), stiffness) for stiffness in (0.0, 3.0, 30.0)]
    lengths = bend(robots[0], 0.5, -0.3)
    every = Simulator(robots, points_per_segment=6)
    together = every.settle(lengths)
    for i, robot in enumerate(robots):
        alone = Simulator(robot, points_per_segment=6).settle(lengths)
        assert_allclose(together.tip_position[i], alone.tip_position[0], atol=1e-9)
    other = bend(robots[0], -0.2, 0.4)
    some = every.settle(np.tile(other, (3, 1)), rows=[1])
    assert_allclose(some.tip_position[[0, 2]], together.tip_position[[0, 2]], atol=0.0)
    alone = Simulator(robots[1], points_per_segment=6).settle(other)
    assert_allclose(some.tip_position[1], alone.tip_position[0], atol=1e-8)


@pytest.mark.parametrize("stiffness", [5.0, 30.0])
@pytest.mark.study(beyond=1)
def test_slopes_are_those_of_rod_and_spring_together(stiffness: float) -> None:
    robot = tied(two_segments(), stiffness)
    lengths = bend(robot, 0.4, 0.2) + bend(robot, -0.3, 0.4, 1) - robot.rest_tendon_length
    base = {"tendon_length": lengths, "tip_force": np.array([0.01, 0.02, 0.0]), "base_pose": BASE}
    # sensitivities are of the fourth order in the step: 7e-5 at four points and 100 N/m, 1.7e-6 at ten
    sim = Simulator(robot, points_per_segment=12)
    sim.settle(**base, tolerance=1e-13)
    jacobian, compliance = sim.jacobian(turning=True)[0], sim.compliance()[0]
    for i in range(3):
        expected = difference(sim, base, "tendon_length", i, 1e-6)
        assert_allclose(jacobian[:, i], expected, atol=2e-6 * np.abs(expected).max())
        expected = difference(sim, base, "tip_force", i, 1e-5)
        assert_allclose(compliance[:, i], expected, atol=2e-6 * np.abs(expected).max())
    for j, axis in enumerate(np.eye(3)):
        ends = []
        for sign in (1.0, -1.0):
            turned = Rotation.from_rotvec(sign * 1e-5 * axis) * Rotation.from_quat(
                BASE[3:], scalar_first=True
            )
            pose = np.concatenate([BASE[:3], turned.as_quat(scalar_first=True)])
            ends.append(sim.settle(**{**base, "base_pose": pose}, tolerance=1e-13).tip_position[0])
        expected = (ends[0] - ends[1]) / 2e-5
        assert_allclose(jacobian[:3, -3 + j], expected, atol=2e-6 * np.abs(expected).max())


@pytest.mark.study
@pytest.mark.parametrize("stiffness", [5.0, 30.0])
def test_a_log_is_a_simulator_settled_at_every_row(stiffness: float) -> None:
    """At 100 N/m two rows have two balances each, 0.4 and 4 mm apart."""
    nominal = two_segments()
    robot = tied(nominal, stiffness, {"name": "backlash", "half_width": 3e-4})
    log = log_of(nominal, wave(nominal, 25))
    shown = replay(log, robot)
    assert shown.converged.all()
    sim = Simulator(robot, points_per_segment=6)
    for i in range(len(log)):
        tip = sim.settle(robot.rest_tendon_length + log.dl[i], tolerance=1e-11).tip_position[0]
        assert_allclose(shown.tip_position[i], tip, atol=2e-8)


@pytest.mark.study
def test_a_released_tip_swings_as_its_spring_and_its_modes_say() -> None:
    """In motion the spring is a step behind: with small steps the rod rings faster by sqrt(1 + k C)."""
    heavy = rod("passive", line_density=0.05)
    spring = {"name": "tip_spring", "stiffness": 10.0, "x": 0.0, "y": 0.0, "z": 0.07}
    tip = []
    for robot in (heavy, replace(heavy, effects=(spring,))):
        sim = Simulator(robot, dt=2e-4, points_per_segment=4, dynamics=True)
        sim.settle(tip_force=(0.02, 0.0, 0.0))
        tip.append([sim.step().tip_position[0, 0] for _ in range(1200)])
    crossings = [np.flatnonzero(np.diff(np.sign(one))) for one in np.array(tip)]
    slow, fast = (np.diff(where).mean() for where in crossings)
    compliance = 0.07**3 / (3.0 * 0.0022)
    # by the tip of its first mode a cantilever is 3.09 EI / l^3 stiff, by a force there 3 EI / l^3
    assert (slow / fast) ** 2 == pytest.approx(1.0 + 3.0 / 3.09 * 10.0 * compliance, rel=0.01)
