"""The kernels against their obvious twin. Small enough to run without the compiler, and with every index
checked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from plain.naive import march
from rods import bend, rod

from fastrod import Robot, Simulator, load_robot


def chain() -> Robot:
    robot = load_robot("tdcr_b")
    first, last = robot.segments
    return replace(
        robot,
        segments=(first, replace(last, bending_stiffness=(0.002, 0.003), precurvature=(1.0, -2.0, 0.5))),
    )


@pytest.mark.study
@pytest.mark.parametrize(
    "robot",
    [rod(), rod("passive"), rod(n_tendons=3, bending_stiffness=(0.002, 0.003)), chain()],
    ids=range(4),
)
def test_settled_boundary_closes_in_the_twin_too(robot: Robot) -> None:
    n_steps, force, line = 3, np.array([0.05, -0.04, 0.02]), np.array([0.1, 0.0, -0.2])
    lengths = bend(robot, 0.4, -0.3) if robot.n_tendons else None
    sim = Simulator(robot, points_per_segment=n_steps)
    state = sim.settle(lengths, tip_force=force, line_force=line)
    assert state.ok.all()
    twin = march(robot, n_steps, state.moment[0, 0], state.tension[0], force, line)
    # the kernels stop Newton on u after two steps and take exp as a series: 1e-9 of a radian
    assert_allclose(state.tip_position[0], twin["position"], atol=1e-10)
    assert_allclose(state.tip_rotation[0], twin["rotation"], atol=1e-8)
    assert_allclose(twin["moment"], 0.0, atol=1e-9)
    assert_allclose(state.path_length[0], twin["length"], atol=1e-10)


def test_every_input_and_output_once() -> None:
    """Follower force, point force, extension, sampled load, slack tendon, Jacobian, compliance and dense
    shape, with indices checked."""
    robot = chain()
    first, last = robot.segments
    slack = tuple(replace(t, unilateral=True, pretension=0.1) for t in last.tendons)
    robot = replace(robot, segments=(first, replace(last, tendons=slack, extension=(0.0, 0.02))))
    sim = Simulator(robot, n_robots=3, points_per_segment=3)
    lengths = bend(robot, 0.3, 0.1) + np.where(robot.tendon_segment == 1, 0.01, 0.0)
    lengths[5] += 0.004
    given = {
        "extension": (0.0, 0.01),
        "tip_moment": (1e-3, 0.0, 0.0),
        "line_force": np.full((2, 4, 3), 0.05),
        "point_force": [(0.07, (0.02, 0.0, 0.01))],
        "follower_tip_force": (0.01, 0.02, 0.0),
        "base_pose": (0.1, 0.2, 0.3, 0.6, 0.8, 0.0, 0.0),
    }
    force = np.array([[0.0, 0.02, 0.0], [0.01, 0.0, 0.0], [0.0, 0.0, -0.02]])
    state = sim.settle(lengths, tip_force=force, **given)
    assert state.ok.all(), state.problems
    assert (state.tension[:, 5] == 0.0).all()
    at_rest = sim.step(lengths, tip_force=force, **given)
    loaded = sim.step(lengths, tip_force=1.02 * force, **given)
    assert loaded.passes.tolist() == [2, 2, 2]  # the first time the force moves its gain is learned
    moved = np.linalg.norm(loaded.tip_position - at_rest.tip_position, axis=1)
    # and a change of 2 % is then an error of less than 2 % of what it does
    assert (loaded.residual < 0.02 * moved).all()
    # the compliance predicts the tip of a nearby load
    moved = sim.settle(lengths, tip_force=1.05 * force, **given)
    near = sim.settle(lengths, tip_force=1.04 * force, **given)
    predicted = near.tip_position + np.einsum("rij,rj->ri", sim.compliance()[:, :3], 0.01 * force)
    assert_allclose(moved.tip_position, predicted, atol=1e-7)
    assert np.isfinite(sim.jacobian()).all()
    assert_allclose(sim.shape(near.arclength[0]).position, near.position, atol=1e-14)


def test_tension_and_paper_modes() -> None:
    robot = replace(chain(), segments=tuple(replace(s, mode="tendon_tension") for s in chain().segments))
    tension = np.array([0.5, 0.0, 0.2, 0.3, 0.0, 0.0])
    state = Simulator(robot, points_per_segment=3).settle(tension=tension)
    twin = march(robot, 3, state.moment[0, 0], tension, np.zeros(3), np.zeros(3))
    assert_allclose(state.tip_position[0], twin["position"], atol=1e-10)
    assert_allclose(twin["moment"], 0.0, atol=1e-8)
    paper = replace(
        chain(),
        segments=tuple(
            replace(s, mode="paper", precurvature=(0.0, 0.0, 0.0), bending_stiffness=(0.002, 0.002))
            for s in chain().segments
        ),
    )
    lengths = bend(paper, 0.4, 0.2) + bend(paper, -0.2, 0.3, 1) - paper.rest_tendon_length
    state = Simulator(paper, points_per_segment=3).settle(lengths, tip_force=(0.05, 0.0, 0.02))
    assert state.ok.all()
    assert_allclose(state.path_length[0], lengths, atol=1e-9)


def test_a_batch_is_its_robots_bit_by_bit() -> None:
    robots = [rod(line_density=0.1 * i, offset=0.007 + 0.0002 * i) for i in range(5)]
    lengths = np.stack([bend(robot, 0.2 * i, -0.1) for i, robot in enumerate(robots)])
    together = Simulator(robots, points_per_segment=3)
    alone = [Simulator(robot, points_per_segment=3) for robot in robots]
    for scale in (1.0, 1.001):
        state = together.step(scale * lengths)
        for i, sim in enumerate(alone):
            one = sim.step(scale * lengths[i])
            assert_array_equal(one.position[0], state.position[i])
            assert_array_equal(one.tension[0], state.tension[i])
