"""Catch: arcs against the simulator, the target's path, the load that nobody sees, and seeds."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from environments import batch, drawn
from numpy.testing import assert_allclose, assert_array_equal

import fastrod
from fastrod.model.segment_actions import SegmentActions
from fastrod_envs.tasks import catch
from fastrod_envs.tasks.catch import Catch, arcs_jacobian, arcs_tip, directions, standing_robot
from fastrod_envs.vector import BatchEnv


def begun(n: int, seed: int = 0, **options: Any) -> tuple[BatchEnv, Catch]:
    """Environments at the start of an episode, and their task."""
    env = batch("Catch", n, **options)
    env.reset(seed=seed)
    assert isinstance(env.task, Catch)
    return env, env.task


def test_arcs_are_the_unloaded_robot():
    robot = standing_robot()
    tendons = [tuple(replace(t, compliance=1e-9) for t in s.tendons) for s in robot.segments]
    segments = (replace(s, tendons=own) for s, own in zip(robot.segments, tendons, strict=True))
    stiff = replace(robot, segments=tuple(segments))
    displacement = np.random.default_rng(0).uniform(-0.8, 0.8, (6, 5)) * [0.012, 0.012, 0.012, 0.012, 0.02]
    actions = np.zeros((6, 6))
    actions[:, [1, 2, 4, 5, 3]] = displacement
    state = fastrod.Simulator(stiff, 6, points_per_segment=40).settle(**SegmentActions(robot).inputs(actions))
    assert_allclose(arcs_tip(displacement), state.tip_position, rtol=0, atol=1e-7)


def test_jacobian_is_that_of_the_arcs():
    displacement = np.random.default_rng(1).uniform(-0.01, 0.01, (4, 5))
    step = np.random.default_rng(2).uniform(-1e-5, 1e-5, (4, 5))
    change = arcs_tip(displacement + step) - arcs_tip(displacement - step)
    slopes = np.einsum("nij,nj->ni", arcs_jacobian(displacement), 2.0 * step)
    assert_allclose(slopes, change, rtol=0, atol=1e-10)


def test_directions_are_even_over_the_sphere():
    d = directions(np.random.default_rng(0).random((20000, 2)))
    assert_allclose((d**2).sum(1), 1.0, rtol=1e-12)
    # standard deviation of a component's mean is 1 / sqrt(3 n), of the second moments less
    assert_allclose(d.mean(0), 0.0, atol=5.0 / np.sqrt(3 * 20000))
    assert_allclose(d.T @ d / len(d), np.eye(3) / 3.0, atol=5.0 / np.sqrt(5 * 20000))


def test_target_moves_in_a_straight_line_through_the_workspace():
    _, task = begun(50)
    start, velocity = task.desired.copy(), task.velocity.copy()
    closest = np.full(50, np.inf)
    for k in range(1, 21):
        task.act(np.zeros((50, 5)))
        assert_allclose(task.desired, start + k * task.dt * velocity, rtol=0, atol=1e-12)
        closest = np.minimum(closest, np.abs(task.desired).max(1))
    speed = np.linalg.norm(velocity, axis=1)
    assert speed.min() >= catch.SLOWEST
    assert speed.max() <= catch.FASTEST
    assert closest.max() < standing_robot().length + 0.1


def test_the_load_bends_the_robot_and_is_not_observed():
    env, task = begun(40)
    observation, _ = env.reset(seed=3)
    load = np.linalg.norm(task.force, axis=1)
    assert 0.5 * catch.LARGEST_LOAD < load.max() <= catch.LARGEST_LOAD
    bent = task.tip - [0.0, 0.0, standing_robot().length]
    side = task.force[:, :2]
    assert (np.einsum("ni,ni->n", bent[:, :2], side)[np.linalg.norm(side, axis=1) > 0.01] > 0.0).all()
    assert 0.003 < np.linalg.norm(bent, axis=1).max() < 0.03
    task.force[:] = -task.force  # what is seen now has nothing to do with it
    assert_array_equal(task.state().astype(np.float32), observation)


def test_the_load_is_there_all_the_while():
    _, task = begun(3)
    tip = task.tip.copy()
    for _ in range(5):
        task.act(np.zeros((3, 5)))
    assert_allclose(task.tip, tip, rtol=0, atol=1e-5)


def test_reward_is_its_formula_and_distance_the_least():
    env, task = begun(20, seed=1)
    least = np.linalg.norm(task.desired - task.tip, axis=1)
    for action in drawn(env, 30):
        _, reward, terminated, _, info = env.step(action)
        d = np.linalg.norm(info["desired"] - info["position"], axis=1)
        least = np.minimum(least, d)
        assert_allclose(info["distance"], least, rtol=0, atol=1e-12)
        assert_allclose(reward, -np.minimum(d, 0.2) / 0.2 + 10.0 * (d <= 0.01), rtol=0, atol=1e-12)
        assert_array_equal(terminated, (d <= 0.01) | info["lost"])
        least = np.where(terminated, np.linalg.norm(task.desired - task.tip, axis=1), least)


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("action", ["rate", "displacement"])
def test_baseline_catches(action):
    env, _ = begun(60, seed=100, action=action)
    over, caught = np.zeros(60, bool), np.zeros(60, bool)
    for _ in range(env.n_steps):
        _, _, terminated, truncated, info = env.step(env.baseline())
        caught |= info["success"] & ~over
        over |= terminated | truncated
    assert over.all()
    assert caught.mean() > 0.85


def test_difficulty_0_has_no_load_and_a_target_that_comes_to_the_tip():
    env, task = begun(8, difficulty=0.0)
    assert_array_equal(task.force, 0.0)
    assert_allclose(np.linalg.norm(task.velocity, axis=1), catch.SLOWEST)
    for _ in range(env.n_steps):
        env.step(np.zeros((8, 5)))
        assert (task.least < 0.2).all()
        if (task.least <= 0.01).all():
            break
    assert task.least.max() < 0.05


def test_effects_are_randomised_and_felt():
    env, task = begun(20, randomise={"bending_stiffness": (0.8, 1.2), "camera_scale.scale": (0.05, 0.1)})
    assert (np.linalg.norm(task.measured() - task.tip, axis=1) > 0.005).all()
    for _ in range(5):
        observation, *_ = env.step(env.baseline())
    assert np.isfinite(observation).all()
