"""The same seed gives the same rollout, bit for bit: whatever stands beside an environment, and whatever
happened in it before."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import fastrod_envs
from fastrod.errors import InputError
from fastrod_envs.registration import task_class
from fastrod_envs.vector import BatchEnv

NAMES = fastrod_envs.names()
ROD_NAMES = tuple(name for name in NAMES if not task_class(name).hosted)
VARIED: dict[str, dict[str, Any]] = {
    "state": {},
    "goal": {"observation": "goal"},
    "displacement": {"action": "displacement", "n_steps": 3},
    "parameters": {"randomise": {"bending_stiffness": (0.8, 1.2), "line_density": (1.0, 1.5)}},
    "effects": {"randomise": {"backlash.half_width": (0.0, 3e-4), "bending_stiffness": (0.9, 1.1)}},
}


class Rollout(NamedTuple):
    """What one environment did."""

    observations: np.ndarray
    """(n + 1, n_obs) with the first; where an episode ended its first, not its last one."""
    rewards: np.ndarray
    """(n,)"""
    endings: np.ndarray
    """(n,) bool"""
    positions: np.ndarray
    """(n, 3) what info says of every step, the last of an episode included."""


def actions(env: BatchEnv, n: int) -> np.ndarray:
    """(n, num_envs, n_actions)."""
    return np.random.default_rng(99).uniform(-1.0, 1.0, (n, *env.action_space.shape))


def alone(env: gymnasium.Env[Any, Any], given: np.ndarray, seed: int) -> Rollout:
    """An environment by itself through several episodes."""
    observation, _ = env.reset(seed=seed)
    observations, rewards, endings, positions = [observation], [], [], []
    for action in given:
        observation, reward, terminated, truncated, info = env.step(action)
        positions.append(info["position"])
        if terminated or truncated:
            observation, _ = env.reset()
        observations.append(observation)
        rewards.append(reward)
        endings.append(terminated or truncated)
    return Rollout(*map(np.array, (observations, rewards, endings, positions)))


def together(env: BatchEnv, given: np.ndarray, seed: int) -> list[Rollout]:
    """Environments beside each other; `given` (n, num_envs, n_actions)."""
    observation, _ = env.reset(seed=seed)
    observations, rewards, endings, positions = [observation], [], [], []
    for action in given:
        observation, reward, terminated, truncated, info = env.step(action)
        positions.append(info["position"])
        observations.append(observation)
        rewards.append(reward)
        endings.append(terminated | truncated)
    columns = zip(
        *(np.swapaxes(np.array(a), 0, 1) for a in (observations, rewards, endings, positions)), strict=True
    )
    return [Rollout(*column) for column in columns]


def assert_same(one: Rollout, other: Rollout) -> None:
    for a, b in zip(one, other, strict=True):
        assert_array_equal(a, b)


@pytest.mark.parametrize("name", NAMES)
def test_an_environment_does_not_know_its_neighbours(name: str) -> None:
    hosted = task_class(name).hosted
    if hosted:
        pytest.importorskip("pybullet", reason="pybullet is not installed: pip install 'fastrod[hosts]'")
    # worlds of rigid bodies take their time
    n, steps, options = (2, 4, {"n_steps": 2}) if hosted else (3, 12, {"n_steps": 4})
    options["threads"] = 1
    env = BatchEnv(name, n, **options)
    given = actions(env, steps)
    found = together(env, given, seed=40)
    assert_same(found[1], together(env, given, seed=40)[1])  # after other episodes
    env.close()
    single = gymnasium.make(f"fastrod/{name}-v0", **options)
    single.reset(seed=1)
    single.step(given[0, 0])  # left in the middle of an episode
    for i in (1,) if hosted else (2, 0):
        rollout = alone(single, given[:, i], seed=40 + i)
        assert_same(found[i], rollout)
        assert rollout.endings.sum() >= 2
    assert not np.array_equal(found[0].observations[0], found[1].observations[0])
    single.close()


@pytest.mark.parametrize("name", ROD_NAMES)
def test_three_are_the_first_three_of_seventeen(name: str) -> None:
    few, many = (BatchEnv(name, n, n_steps=5, threads=1) for n in (3, 17))
    given = actions(many, 8)
    ones, others = together(few, given[:, :3], seed=7), together(many, given, seed=7)
    for one, other in zip(ones, others, strict=False):
        assert_same(one, other)
    assert ones[0].endings.any()


@pytest.mark.parametrize("varied", VARIED)
def test_options_keep_that_promise(varied: str) -> None:
    options = {"n_steps": 5, "threads": 1, **VARIED[varied]}
    env = BatchEnv("Reach", 4, **options)
    given = actions(env, 12)
    found = together(env, given, seed=21)
    single = gymnasium.make("fastrod/Reach-v0", **options)
    for i in (3, 1):
        assert_same(found[i], alone(single, given[:, i], seed=21 + i))
    assert found[0].endings.sum() >= 2


def test_many_threads_are_one() -> None:
    few, many = (BatchEnv("Reach", 64, n_steps=5, threads=threads) for threads in (1, None))
    given = actions(few, 12)
    for one, other in zip(together(few, given, seed=3), together(many, given, seed=3), strict=True):
        assert_same(one, other)


def test_each_may_have_a_seed_of_its_own() -> None:
    env = BatchEnv("Reach", 3, threads=1)
    first, _ = env.reset(seed=[5, 9, 5])
    assert_array_equal(first[0], first[2])
    assert not np.array_equal(first[0], first[1])
    following, _ = env.reset()  # no seed: the streams go on
    assert_array_equal(following[0], following[2])
    assert not np.array_equal(following[0], first[0])
    again, _ = env.reset(seed=[5, None, None])
    assert_array_equal(again[0], first[0])
    assert not np.array_equal(again[1], first[1])
    unseeded = BatchEnv("Reach", 2, threads=1).reset()[0]
    assert not np.array_equal(unseeded[0], unseeded[1])


@pytest.mark.parametrize("seed", [-1, True, 1.5, [1, 2], [1, 2, "3"]])
def test_a_seed_is_a_whole_number(seed: Any) -> None:
    with pytest.raises(InputError, match="seed"):
        BatchEnv("Reach", 3, threads=1).reset(seed=[seed] * 3 if isinstance(seed, bool | float) else seed)


def test_numpys_seeds_do_not_overflow() -> None:
    env = BatchEnv("Reach", 2, threads=1)
    assert_array_equal(env.reset(seed=np.uint8(255))[0], env.reset(seed=255)[0])


def test_a_masked_reset_seeds_those_that_begin() -> None:
    seeded, other = (BatchEnv("Reach", 2, n_steps=2, threads=1) for _ in range(2))
    mask = np.array([True, False])
    for env, seed in ((seeded, 7), (other, None)):
        env.reset(seed=0)
        env.reset(seed=seed, options={"reset_mask": mask})
    given = np.zeros(seeded.action_space.shape)
    for _ in range(2):
        one, two = seeded.step(given)[0], other.step(given)[0]
    assert_array_equal(one[1], two[1])
    assert not np.array_equal(one[0], two[0])


def test_a_refused_reset_changes_nothing() -> None:
    env, twin = (BatchEnv("Reach", 2, threads=1) for _ in range(2))
    for one in (env, twin):
        one.reset(seed=0, options={"difficulty": 0.5})
    for wrong in (
        {"options": {"difficulty": 0.1, "level": 1}},
        {"seed": [1, -1]},
        {"seed": 3, "options": {"difficulty": 2.0}},
    ):
        with pytest.raises(InputError):
            env.reset(**wrong)
    assert env.task.difficulty == 0.5
    assert_array_equal(env.reset()[0], twin.reset()[0])


def test_a_robot_lost_from_the_start_knows_no_earlier_episode() -> None:
    # too heavy for its first shape to be found
    heavy = {"randomise": {"gravity.line_density": (1.0, 1.0)}, "threads": 1}
    fresh, used = (BatchEnv("Reach", 1, **heavy) for _ in range(2))
    used.reset(seed=1)
    used.task.tip[:] += 0.1  # as if it had been elsewhere
    assert_array_equal(used.reset(seed=3)[0], fresh.reset(seed=3)[0])
    assert_array_equal(used.task.direction, fresh.task.direction)
    assert_array_equal(used.task.tip, fresh.task.tip)
