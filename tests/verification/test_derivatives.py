"""Jacobian, compliance and dense output against central differences of the settled answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rods import bend, rod

from fastrod import Robot, Simulator, load_robot


def difference(sim: Simulator, base: dict[str, np.ndarray], name: str, axis: int, delta: float) -> np.ndarray:
    """(6,) central difference of the settled tip pose by one entry of an input, the next order taken off."""
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


def moved(
    robot: Robot, *bends: tuple[float, float], **inputs: list[float]
) -> tuple[Robot, dict[str, np.ndarray]]:
    """A robot and its inputs: lengths that bend its segments so, and others."""
    if bends:
        lengths = sum(bend(robot, *by, k) for k, by in enumerate(bends))
        inputs["tendon_length"] = lengths - (len(bends) - 1) * robot.rest_tendon_length
    return robot, {name: np.array(value) for name, value in inputs.items()}


SIDE, TIP = [0.1, 0.2, -0.1], [0.0, 0.1, 0.0]
REACHER = load_robot("five_segment_reacher")
CASES = {
    "three tendons": moved(rod(n_tendons=3, line_density=0.2), (1.1, -0.6), tip_force=SIDE),
    "four tendons": moved(rod(n_tendons=4, line_density=0.2), (1.1, -0.6), tip_force=SIDE),
    "anisotropic and precurved, with a moment on its tip": moved(
        rod(bending_stiffness=(0.0022, 0.003), precurvature=(1.0, -2.0, 3.0)),
        (0.5, 0.6),
        tip_force=[0.1, 0.0, -0.1],
        tip_moment=[1e-3, 2e-3, -1e-3],
    ),
    "passive": moved(rod("passive"), tip_force=SIDE),
    "paper mode": moved(rod("paper"), (0.8, 0.3), tip_force=SIDE),
    "chain with extension": moved(
        replace(REACHER, segments=REACHER.segments[2:]),
        (0.3, 0.2),
        (-0.2, 0.3),
        (0.1, 0.4),
        tip_force=[0.02, -0.03, 0.01],
        extension=[0.0, 0.0, 0.01],
    ),
    "beside a follower force": moved(rod(), (0.6, 0.1), tip_force=TIP, follower_tip_force=[0.1, 0.0, 0.1]),
}


@pytest.mark.parametrize("case", CASES)
def test_jacobian_and_compliance_are_differences(case: str) -> None:
    robot, base = CASES[case]
    sim = Simulator(robot, points_per_segment=6)
    sim.settle(**base, tolerance=1e-13)
    jacobian, compliance = sim.jacobian()[0], sim.compliance(moments=True)[0]
    columns = [("tendon_length", i, i, 1e-6) for i in range(robot.n_tendons)]
    growing = [k for k, segment in enumerate(robot.segments) if segment.extension[1] > 0.0]
    columns += [("extension", k, robot.n_tendons + k, 1e-5) for k in growing]
    for name, i, column, delta in columns:
        expected = difference(sim, base, name, i, delta)
        assert_allclose(jacobian[:, column], expected, atol=1e-6 * np.abs(expected).max())
    loads = {"tip_force": np.zeros(3), "tip_moment": np.zeros(3)} | base
    for end, name, step in ((3, "tip_force", 1e-4), (6, "tip_moment", 1e-6)):
        off = 1e-6 * np.abs(compliance[:, :end]).max()
        for a in range(3):
            assert_allclose(compliance[:, end - 3 + a], difference(sim, loads, name, a, step), atol=off)


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


def test_extension_under_a_point_force_that_stays_at_its_arclength() -> None:
    sim = Simulator(rod("passive", extension=(0.0, 0.05)), points_per_segment=8)
    line = np.array([[[0.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 1.0]]])

    def tip(extension: float) -> np.ndarray:
        loads = {"point_force": [(0.04, (0.0, 0.2, 0.0))], "line_force": line}
        return sim.settle(extension=[extension], tolerance=1e-13, **loads).tip_position[0]

    tip(0.02)
    jacobian = sim.jacobian()[0, :3, 0]
    expected = (tip(0.02 + 1e-5) - tip(0.02 - 1e-5)) / 2e-5
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
