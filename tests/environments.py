"""Record of one environment, alone or beside others."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import fastrod_envs
from fastrod_envs.registration import task_class
from fastrod_envs.vector import BatchEnv

NAMES = fastrod_envs.names()


def needed(name: str) -> None:
    """Skip where the task's host is not installed."""
    if task_class(name).hosted:
        pytest.importorskip("pybullet", reason="pybullet is not installed: pip install 'fastrod[hosts]'")


def batch(name: str, n: int = 2, **options: Any) -> BatchEnv:
    """Environments on one thread."""
    needed(name)
    return BatchEnv(name, n, **{"threads": 1, **options})


def drawn(env: Any, n: int, seed: int = 0) -> np.ndarray:
    """Actions at random from -1 to 1, n of the shape that the environment takes."""
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (n, *env.action_space.shape))


class Rollout(NamedTuple):
    observations: np.ndarray
    """(n + 1, n_obs) with the first; where an episode ended its first, not its last one."""
    rewards: np.ndarray
    """(n,)"""
    endings: np.ndarray
    """(n,) bool"""
    reported: np.ndarray
    """(n, ...) what info says of every step under some key, the last of an episode included."""


def together(env: BatchEnv, given: Iterable[np.ndarray], seed: int, key: str = "position") -> list[Rollout]:
    """Environments beside each other; `given` (n, num_envs, n_actions)."""
    seen, steps = [env.reset(seed=seed)[0]], []
    for action in given:
        observation, reward, terminated, truncated, info = env.step(action)
        seen.append(observation)
        steps.append((reward, terminated | truncated, info[key]))
    columns = (np.swapaxes(np.array(each), 0, 1) for each in (seen, *zip(*steps, strict=True)))
    return [Rollout(*column) for column in zip(*columns, strict=True)]


def alone(env: Any, given: Iterable[np.ndarray], seed: int) -> Rollout:
    """An environment by itself through several episodes; `given` (n, n_actions)."""
    seen, steps = [env.reset(seed=seed)[0]], []
    for action in given:
        observation, reward, terminated, truncated, info = env.step(action)
        ended = terminated or truncated
        seen.append(env.reset()[0] if ended else observation)
        steps.append((reward, ended, info["position"]))
    return Rollout(np.array(seen), *map(np.array, zip(*steps, strict=True)))


def assert_same(one: Rollout, other: Rollout) -> None:
    for a, b in zip(one, other, strict=True):
        assert_array_equal(a, b)


def to_the_end(env: Any) -> Any:
    """The last step of an episode of the baseline; of several environments, the first that ends."""
    while True:
        step = env.step(env.baseline())
        if np.any(step[2] | step[3]):
            return step
