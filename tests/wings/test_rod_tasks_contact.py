"""TubeInsert: the tube's geometry, forces on its wall, what ends an episode, and seeds."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fastrod.errors import InputError
from fastrod.model.robotfile import load_robot
from fastrod_envs.single import SingleEnv
from fastrod_envs.tasks import tube_insert
from fastrod_envs.tasks.tube_insert import TubeInsert, middle, place, thin_robot, tube_mesh
from fastrod_envs.vector import BatchEnv

LENGTH = tube_insert.STRAIGHT + tube_insert.BEND_RADIUS * tube_insert.ANGLE


def task_of(env: BatchEnv | SingleEnv) -> TubeInsert:
    assert isinstance(env.task, TubeInsert)
    return env.task


def pushing(task: TubeInsert) -> np.ndarray:
    """Straight ahead."""
    action = np.zeros((task.n_envs, 5))
    action[:, 4] = 1.0
    return action


def rollout(n: int, seed: int, row: int, steps: int, **options) -> list[np.ndarray]:
    """Observations and rewards of environment `row`: ahead, with bends at random that are the same whatever
    the others do."""
    env = BatchEnv("TubeInsert", num_envs=n, threads=1, **options)
    own, others = np.random.default_rng(5), np.random.default_rng(n)
    env.reset(seed=seed)
    seen = []
    for _ in range(steps):
        action = others.uniform(-1, 1, (n, 5))
        action[row] = own.uniform(-1, 1, 5)
        action[:, 4] = np.abs(action[:, 4])
        observation, reward, _, _, info = env.step(action)
        seen += [observation[row].copy(), np.array(reward[row]), np.array(info["largest_force"][row])]
    return seen


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
    env = BatchEnv("TubeInsert", num_envs=12, threads=1)
    env.reset(seed=0)
    task = task_of(env)
    tip, direction = task.tip.copy(), task.direction.copy()
    task.act(np.r_[np.zeros(4), -1.0] * np.ones((12, 1)))
    assert_allclose(task.tip, tip, rtol=0, atol=1e-8)  # what `begin` says is what the simulator finds
    assert_allclose(task.direction, direction, rtol=0, atol=1e-7)
    assert_array_equal(task.force, 0.0)
    assert_allclose(tip[:, 2], -tube_insert.OUTSIDE)
    assert np.abs(tip[:, :2]).max() <= tube_insert.ASIDE


def test_a_rolled_robot_sees_and_does_the_same_as_one_that_is_not():
    """Roll is a turn of the frame: with the tube's own direction rolled along, nothing else changes."""
    env = BatchEnv("TubeInsert", num_envs=2, threads=1)
    env.reset(seed=0)
    task = task_of(env)
    angle = 0.5 * np.pi
    task.roll[:] = [[1.0, 0.0], [np.cos(angle), np.sin(angle)]]
    task.aside[:], task.depth[:] = [0.001, 0.0], 0.06
    task.tip[:, :2] = task.aside
    for _ in range(35):
        task.act(task.baseline())
    assert task.tip[0, 0] > 0.01
    # three wires are not the same from every side
    assert_allclose(task.tip[1], task.tip[0], rtol=0, atol=2e-4)
    first, second = task.state()
    assert_allclose(second[1:3], [np.cos(angle), -np.sin(angle)], atol=1e-12)
    assert_allclose(second[5:7], [first[6], -first[5]], rtol=0, atol=2e-4)


def test_pushing_straight_ahead_presses_on_the_wall_and_ends_the_episode():
    env = BatchEnv("TubeInsert", num_envs=2, threads=1)
    env.reset(seed=0)
    task = task_of(env)
    forces = []
    for _ in range(env.n_steps):
        _, reward, terminated, _, info = env.step(pushing(task))
        forces.append(info["force"])
        d = info["distance"]
        expected = (
            np.exp(-d / 0.02)
            - np.clip(info["force"] / tube_insert.FORCE - 1.0, 0.0, 1.0)
            - 10.0 * (info["force"] > 0.6)
        )
        assert_allclose(reward, expected, rtol=0, atol=1e-12)
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
    env = BatchEnv("TubeInsert", num_envs=2, threads=1)
    env.reset(seed=0)
    task = task_of(env)
    while task.force.min() < 0.05:
        task.act(pushing(task))
        assert (task.failed == 0).all()
    contacts = task.simulator.state.contacts
    assert contacts is not None
    assert_allclose(task.wrench[:, :3], contacts.total_force, rtol=0, atol=1e-5)
    assert (task.force >= np.linalg.norm(contacts.total_force, axis=1) - 1e-9).all()
    own = task.state()[:, -11:-8]
    assert_allclose(np.linalg.norm(own, axis=1), np.linalg.norm(task.wrench[:, :3], axis=1), rtol=1e-12)


def test_baseline_reaches_the_goal_without_force():
    env = BatchEnv("TubeInsert", num_envs=24, threads=1)
    env.reset(seed=100)
    for _ in range(env.n_steps):
        _, _, terminated, truncated, info = env.step(env.baseline())
        if truncated.any() or terminated.any():
            break
    assert truncated.mean() > 0.9
    assert info["success"].mean() > 0.9
    assert info["largest_force"][info["success"]].max() <= tube_insert.FORCE


def test_difficulty_0_is_shallow_and_straight():
    env = BatchEnv("TubeInsert", num_envs=4, difficulty=0.0, threads=1)
    observation, _ = env.reset(seed=0)
    assert_array_equal(observation, np.broadcast_to(observation[:1], observation.shape))
    assert_allclose(observation[0, :5], [tube_insert.SHALLOWEST, 1.0, 0.0, 0.0, 0.0], atol=1e-7)


@pytest.mark.parametrize("options", [{}, {"randomise": {"bending_stiffness": (0.8, 1.2)}}])
def test_a_seed_is_a_rollout_whatever_is_beside_it(options):
    """Bit for bit, with contacts, and through the ends of episodes."""
    three, one = rollout(3, 7, 2, 45, **options), rollout(1, 9, 0, 45, **options)
    for a, b in zip(three, one, strict=True):
        assert_array_equal(a, b)
    assert max(float(a) for a in three[2::3]) > 0.0


def test_a_seed_is_a_rollout_whatever_came_before():
    env, fresh = BatchEnv("TubeInsert", num_envs=2, threads=1), BatchEnv("TubeInsert", num_envs=2, threads=1)
    env.reset(seed=0)
    for _ in range(25):
        env.step(pushing(task_of(env)))
    assert_array_equal(env.reset(seed=21)[0], fresh.reset(seed=21)[0])
    for _ in range(25):
        a, b = env.step(pushing(task_of(env))), fresh.step(pushing(task_of(fresh)))
        assert_array_equal(a[0], b[0])
        assert_array_equal(a[4]["force"], b[4]["force"])


def test_displacement_goes_there_in_parts():
    env = SingleEnv("TubeInsert", n_steps=1, action="displacement", difficulty=0.0, threads=1)
    env.reset(seed=0)
    feed = tube_insert.SHALLOWEST + tube_insert.OUTSIDE
    _, _, terminated, truncated, info = env.step(
        [0.0, 0.0, 0.0, 0.0, 2.0 * feed / tube_insert.LIMIT[4, 1] - 1.0]
    )
    assert truncated
    assert not terminated
    assert info["success"]
    assert info["distance"] == pytest.approx(
        np.linalg.norm(middle(np.array([0.03]))[0] - [0, 0, 0.03]), abs=1e-3
    )


@pytest.mark.parametrize("options", [{}, {"observation": "goal"}, {"n_steps": 3}])
def test_random_actions_stay_within_the_bounds(options):
    env = BatchEnv("TubeInsert", num_envs=8, threads=1, **options)
    rng = np.random.default_rng(0)
    observation, _ = env.reset(seed=0)
    assert observation.shape == (8, 5 if "observation" in options else 28)
    for _ in range(25):
        observation, reward, *_ = env.step(rng.uniform(-1, 1, (8, 5)))
        assert np.isfinite(observation).all()
        assert np.isfinite(reward).all()
        assert env.observation_space.contains(observation)


def test_who_is_not_solved_stays_and_is_lost_in_the_end():
    env = BatchEnv("TubeInsert", num_envs=2, threads=1)
    env.reset(seed=0)
    task = task_of(env)
    task.act(pushing(task))
    tip, there = task.tip.copy(), task.displacement.copy()
    for k in range(1, tube_insert.PATIENCE + 1):
        task.displacement[1] = np.nan  # no simulator finds a shape for that
        task.act(np.zeros((2, 5)))
        assert_array_equal(task.failed, [0, k])
        assert_array_equal(task.tip[1], tip[1])
        assert_array_equal(task.lost, [False, k == tube_insert.PATIENCE])
    assert_array_equal(task.displacement[0], there[0])


def test_effects_and_other_robots():
    env = BatchEnv(
        "TubeInsert",
        num_envs=2,
        threads=1,
        randomise={"backlash.half_width": (0.0, 1e-4), "camera_scale.scale": (0.02, 0.03)},
    )
    env.reset(seed=0)
    for _ in range(12):
        observation, *_ = env.step(env.baseline())
    task = task_of(env)
    assert np.isfinite(observation).all()
    assert (np.linalg.norm(task.measured() - task.tip, axis=1) > 1e-4).all()
    assert thin_robot().n_tendons == 6
    with pytest.raises(InputError, match="segments"):
        BatchEnv("TubeInsert", num_envs=1, randomise=load_robot("prototype"))
