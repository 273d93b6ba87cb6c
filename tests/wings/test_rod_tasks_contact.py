"""TubeInsert: the tube's geometry, forces on its wall, what ends an episode, and seeds."""

from typing import Any

import numpy as np
import pytest
from environments import batch, to_the_end
from numpy.testing import assert_allclose, assert_array_equal

from fastrod.errors import InputError
from fastrod.model.robotfile import load_robot
from fastrod_envs.single import SingleEnv
from fastrod_envs.tasks import tube_insert
from fastrod_envs.tasks.tube_insert import TubeInsert, middle, place, thin_robot, tube_mesh
from fastrod_envs.vector import BatchEnv

LENGTH = tube_insert.STRAIGHT + tube_insert.BEND_RADIUS * tube_insert.ANGLE


def begun(n: int, seed: int = 0, **options: Any) -> tuple[BatchEnv, TubeInsert]:
    """Environments at the start of an episode, and their task."""
    env = batch("TubeInsert", n, **options)
    env.reset(seed=seed)
    assert isinstance(env.task, TubeInsert)
    return env, env.task


def pushing(n: int) -> np.ndarray:
    """Straight ahead."""
    return np.tile([0.0, 0.0, 0.0, 0.0, 1.0], (n, 1))


def test_tube_is_closed_and_of_its_radius():
    import trimesh

    vertices, faces = tube_mesh()
    wall = trimesh.Trimesh(vertices, faces, process=False)
    assert wall.is_watertight
    assert wall.euler_number == 0  # a torus
    outside = tube_insert.LUMEN + tube_insert.FLARE + tube_insert.WALL
    # Pappus: the wall's section times the way of its centre, less what the mouth's rounding and facets take
    section = np.pi * (outside**2 - tube_insert.LUMEN**2)
    assert 0.93 * section * LENGTH < wall.volume < section * LENGTH
    depth, out, across = place(vertices)
    lumen = np.hypot(out, across) < 0.5 * (tube_insert.LUMEN + outside)
    deep = lumen & (depth > tube_insert.MOUTH)
    assert_allclose(np.hypot(out, across)[deep], tube_insert.LUMEN, rtol=1e-9)


def test_place_undoes_middle():
    depth = np.linspace(-0.01, LENGTH + 0.02, 60)
    station, out, across = place(middle(depth)[depth > 0.0])
    assert_allclose(station, depth[depth > 0.0], rtol=0, atol=1e-12)
    assert_allclose(out, 0.0, atol=1e-12)
    assert_allclose(across, 0.0, atol=1e-12)
    steps = np.linalg.norm(np.diff(middle(depth[depth > 0.0]), axis=0), axis=1)
    assert_allclose(steps, np.diff(depth[depth > 0.0]), rtol=1e-3)


def test_an_episode_begins_in_front_of_the_mouth_and_touches_nothing():
    _, task = begun(12)
    tip, direction = task.tip.copy(), task.direction.copy()
    task.act(np.r_[np.zeros(4), -1.0] * np.ones((12, 1)))
    assert_allclose(task.tip, tip, rtol=0, atol=1e-8)  # what `begin` says is what the simulator finds
    assert_allclose(task.direction, direction, rtol=0, atol=1e-7)
    assert_array_equal(task.force, 0.0)
    assert_allclose(tip[:, 2], -tube_insert.OUTSIDE)
    assert np.abs(tip[:, :2]).max() <= tube_insert.ASIDE


def test_a_rolled_robot_sees_and_does_the_same_as_one_that_is_not():
    """Roll is a turn of the frame: with the tube's own direction rolled along, nothing else changes."""
    _, task = begun(2)
    angle = 0.5 * np.pi
    task.roll[:] = [[1.0, 0.0], [np.cos(angle), np.sin(angle)]]
    task.aside[:], task.depth[:] = [0.001, 0.0], 0.06
    task.tip[:, :2] = task.aside
    for _ in range(35):
        task.act(task.baseline())
    assert task.tip[0, 0] > 0.01
    # three tendons are not the same from every side
    assert_allclose(task.tip[1], task.tip[0], rtol=0, atol=2e-4)
    first, second = task.state()
    assert_allclose(second[1:3], [np.cos(angle), -np.sin(angle)], atol=1e-12)
    assert_allclose(second[5:7], [first[6], -first[5]], rtol=0, atol=2e-4)


def test_pushing_straight_ahead_presses_on_the_wall_and_ends_the_episode():
    env, _ = begun(2)
    forces = []
    for _ in range(env.n_steps):
        _, reward, terminated, _, info = env.step(pushing(2))
        forces.append(info["force"])
        d, force = info["distance"], info["force"]
        beyond = np.clip(force / tube_insert.FORCE - 1.0, 0.0, 1.0)
        assert_allclose(reward, np.exp(-d / 0.02) - beyond - 10.0 * (force > 0.6), rtol=0, atol=1e-12)
        if terminated.any():
            break
    assert terminated.any()
    i = int(np.flatnonzero(terminated)[0])
    assert info["force"][i] > 2.0 * tube_insert.FORCE
    assert info["contact"][i]
    assert not info["success"][i]
    assert forces[0][i] == 0.0


def test_the_base_feels_what_the_wall_takes():
    """The rod weighs nothing: the wrench at the base is that of the contacts."""
    _, task = begun(2)
    while task.force.min() < 0.05:
        task.act(pushing(2))
        assert (task.failed == 0).all()
    contacts = task.simulator.state.contacts
    assert contacts is not None
    assert_allclose(task.wrench[:, :3], contacts.total_force, rtol=0, atol=1e-5)
    assert (task.force >= np.linalg.norm(contacts.total_force, axis=1) - 1e-9).all()
    own = task.state()[:, -11:-8]
    assert_allclose(np.linalg.norm(own, axis=1), np.linalg.norm(task.wrench[:, :3], axis=1), rtol=1e-12)


def test_baseline_reaches_the_goal_without_force():
    env, _ = begun(24, seed=100)
    _, _, _, truncated, info = to_the_end(env)
    assert truncated.mean() > 0.9
    assert info["success"].mean() > 0.9
    assert info["largest_force"][info["success"]].max() <= tube_insert.FORCE


def test_difficulty_0_is_shallow_and_straight():
    observation, _ = batch("TubeInsert", 4, difficulty=0.0).reset(seed=0)
    assert_array_equal(observation, np.broadcast_to(observation[:1], observation.shape))
    assert_allclose(observation[0, :5], [tube_insert.SHALLOWEST, 1.0, 0.0, 0.0, 0.0], atol=1e-7)


def test_displacement_goes_there_in_parts():
    env = SingleEnv("TubeInsert", n_steps=1, action="displacement", difficulty=0.0, threads=1)
    env.reset(seed=0)
    feed = tube_insert.SHALLOWEST + tube_insert.OUTSIDE
    ahead = 2.0 * feed / tube_insert.LIMIT[4, 1] - 1.0
    _, _, terminated, truncated, info = env.step([0.0, 0.0, 0.0, 0.0, ahead])
    assert truncated
    assert not terminated
    assert info["success"]
    expected = np.linalg.norm(middle(np.array([0.03]))[0] - [0, 0, 0.03])
    assert info["distance"] == pytest.approx(expected, abs=1e-3)


def test_who_is_not_solved_stays_and_is_lost_in_the_end():
    _, task = begun(2)
    task.act(pushing(2))
    tip, there = task.tip.copy(), task.displacement.copy()
    for k in range(1, tube_insert.PATIENCE + 1):
        task.displacement[1] = np.nan  # no simulator finds a shape for that
        task.act(np.zeros((2, 5)))
        assert_array_equal(task.failed, [0, k])
        assert_array_equal(task.tip[1], tip[1])
        assert_array_equal(task.lost, [False, k == tube_insert.PATIENCE])
    assert_array_equal(task.displacement[0], there[0])


def test_effects_and_other_robots():
    effects = {"backlash.half_width": (0.0, 1e-4), "camera_scale.scale": (0.02, 0.03)}
    env, task = begun(2, randomise=effects)
    for _ in range(12):
        observation, *_ = env.step(env.baseline())
    assert np.isfinite(observation).all()
    assert (np.linalg.norm(task.measured() - task.tip, axis=1) > 1e-4).all()
    assert thin_robot().n_tendons == 6
    with pytest.raises(InputError, match="segments"):
        BatchEnv("TubeInsert", num_envs=1, randomise=load_robot("prototype"))
