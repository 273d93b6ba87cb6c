"""Jacobian, compliance and dense output against central differences of the settled answer: exact for the
discrete rod."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rods import bend, rod

from fastrod import Robot, Simulator, load_robot


def difference(sim: Simulator, base: dict[str, np.ndarray], name: str, axis: int, delta: float) -> np.ndarray:
    """(6,) central difference of the settled tip pose by one entry of one input, with the next order taken
    off."""
    fine, coarse = (_central(sim, base, name, axis, k * delta) for k in (1.0, 2.0))
    return (4.0 * fine - coarse) / 3.0


def _central(sim: Simulator, base: dict[str, np.ndarray], name: str, axis: int, delta: float) -> np.ndarray:
    ends = []
    for sign in (1.0, -1.0):
        moved = {key: value.copy() for key, value in base.items()}
        moved[name][axis] += sign * delta
        state = sim.settle(**moved, tolerance=1e-13)
        ends.append((state.tip_position[0], state.tip_rotation[0]))
    (p1, r1), (p0, r0) = ends
    turn = r1 @ r0.T
    skew = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return np.concatenate([p1 - p0, skew]) / (2.0 * delta)


def check(robot: Robot, base: dict[str, np.ndarray], points: int = 6) -> None:
    sim = Simulator(robot, points_per_segment=points)
    sim.settle(**base, tolerance=1e-13)
    jacobian, compliance = sim.jacobian()[0], sim.compliance()[0]
    columns = (
        [("tendon_length", i, 1e-6) for i in range(robot.n_tendons)]
        if robot.segments[0].mode != "tendon_tension"
        else []
    )
    for name, i, delta in columns:
        expected = difference(sim, base, name, i, delta)
        assert_allclose(jacobian[:, i], expected, atol=1e-6 * np.abs(expected).max())
    for k in range(robot.n_segments):
        if robot.segments[k].extension[1] > 0.0:
            expected = difference(sim, base, "extension", k, 1e-5)
            assert_allclose(jacobian[:, robot.n_tendons + k], expected, atol=1e-6 * np.abs(expected).max())
    for a in range(3):
        expected = difference(sim, base, "tip_force", a, 1e-4)
        assert_allclose(compliance[:, a], expected, atol=1e-6 * np.abs(compliance).max())


@pytest.mark.parametrize("n_tendons", [3, 4])
def test_one_segment(n_tendons: int) -> None:
    robot = rod(n_tendons=n_tendons, line_density=0.2)
    check(robot, {"tendon_length": bend(robot, 1.1, -0.6), "tip_force": np.array([0.1, 0.2, -0.1])})


def test_anisotropic_precurved_rod_with_a_moment_on_its_tip() -> None:
    robot = rod(bending_stiffness=(0.0022, 0.003), precurvature=(1.0, -2.0, 3.0))
    base = {
        "tendon_length": bend(robot, 0.5, 0.6),
        "tip_force": np.array([0.1, 0.0, -0.1]),
        "tip_moment": np.array([1e-3, 2e-3, -1e-3]),
    }
    check(robot, base)


def test_passive_rod_and_paper_mode() -> None:
    check(rod("passive"), {"tip_force": np.array([0.1, 0.2, -0.1])})
    robot = rod("paper")
    check(robot, {"tendon_length": bend(robot, 0.8, 0.3), "tip_force": np.array([0.1, 0.2, -0.1])})


def test_chain_with_extension() -> None:
    robot = load_robot("five_segment_reacher")
    robot = replace(robot, segments=robot.segments[2:])
    lengths = (
        bend(robot, 0.3, 0.2)
        + bend(robot, -0.2, 0.3, 1)
        + bend(robot, 0.1, 0.4, 2)
        - 2.0 * robot.rest_tendon_length
    )
    check(
        robot,
        {
            "tendon_length": lengths,
            "tip_force": np.array([0.02, -0.03, 0.01]),
            "extension": np.array([0.0, 0.0, 0.01]),
        },
    )


def test_tensions_as_inputs() -> None:
    robot = load_robot("tdcr_b")
    robot = replace(robot, segments=tuple(replace(s, mode="tendon_tension") for s in robot.segments))
    base = {"tension": np.array([2.0, 0.5, 0.0, 1.0, 0.0, 0.3]), "tip_force": np.array([0.1, 0.0, 0.2])}
    sim = Simulator(robot, points_per_segment=8)
    sim.settle(**base, tolerance=1e-13)
    jacobian = sim.jacobian()[0]
    for i in range(6):
        expected = difference(sim, base, "tension", i, 1e-4)
        assert_allclose(jacobian[:, i], expected, atol=1e-6 * np.abs(expected).max())


def test_compliance_beside_a_follower_force() -> None:
    robot = rod()
    base = {
        "tendon_length": bend(robot, 0.6, 0.1),
        "tip_force": np.array([0.0, 0.1, 0.0]),
        "follower_tip_force": np.array([0.1, 0.0, 0.1]),
    }
    check(robot, base)


def test_extension_under_a_point_force_that_stays_at_its_arclength() -> None:
    robot = rod("passive", extension=(0.0, 0.05))
    sim = Simulator(robot, points_per_segment=8)
    loads = {
        "point_force": [(0.04, (0.0, 0.2, 0.0))],
        "line_force": np.array([[[0.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 1.0]]]),
    }
    sim.settle(extension=[0.02], tolerance=1e-13, **loads)
    jacobian = sim.jacobian()[0, :3, 0]
    ends = [sim.settle(extension=[0.02 + d], tolerance=1e-13, **loads).tip_position[0] for d in (1e-5, -1e-5)]
    expected = (ends[0] - ends[1]) / 2e-5
    assert_allclose(jacobian, expected, atol=1e-6 * np.abs(expected).max())


def test_shape_between_nodes_is_as_good_as_at_nodes() -> None:
    robot = load_robot("tdcr_a")
    lengths = bend(robot, 0.9, 0.2) + bend(robot, -0.5, 0.7, 1) - robot.rest_tendon_length
    loads = {"tip_force": (0.2, -0.1, 0.1), "line_force": (0.1, 0.2, 0.0)}
    coarse, fine = Simulator(robot, points_per_segment=10), Simulator(robot, points_per_segment=80)
    state = coarse.settle(lengths, **loads)
    fine.settle(lengths, **loads)
    s = np.linspace(0.0, 0.4, 57)
    one, two = coarse.shape(s), fine.shape(s)
    at_nodes = np.abs(state.position - fine.shape(state.arclength[0]).position).max()
    assert np.abs(one.position - two.position).max() < 1.5 * at_nodes < 1e-6
    assert_allclose(one.rotation, two.rotation, atol=1e-5)
    away = np.abs(s - 0.2) > 1e-3  # at the joint the curvature jumps
    assert_allclose(one.curvature[:, away], two.curvature[:, away], atol=2e-3)
    # at a joint the distal side, as in the state
    assert_allclose(coarse.shape(0.2).curvature[0, 0], state.curvature[0, 10], atol=1e-12)
    again = coarse.shape(state.arclength[0])
    assert_allclose(again.position, state.position, atol=1e-15)
    assert_allclose(again.curvature[:, :-1], state.curvature[:, :-1], atol=1e-7)
