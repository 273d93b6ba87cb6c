"""Vector environments whose robots move on a GPU."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fastrod_envs.vector import BatchEnv


@pytest.mark.parametrize("name", ["Reach", "ReachObstacle", "Track", "Catch"])
def test_an_episode_is_the_same(name: str) -> None:
    envs = [BatchEnv(name, 2, threads=1, n_steps=3, device=device) for device in ("cpu", "cuda")]
    first = [env.reset(seed=4)[0] for env in envs]
    assert_allclose(first[1], first[0], atol=1e-6)
    rng = np.random.default_rng(0)
    for _ in range(4):  # through the end of an episode
        action = rng.uniform(-1.0, 1.0, envs[0].action_space.shape).astype(np.float32)
        a, b = (env.step(action) for env in envs)
        assert_allclose(b[0], a[0], atol=1e-6)
        assert_allclose(b[1], a[1], atol=1e-6)
        assert_array_equal(b[3], a[3])
