"""No episode ends as lost while `settle` can solve the robot."""

from typing import Any

import pytest
from environments import NAMES, needed

import bench_lost
from fastrod_envs.learning.policies import Policy, find
from fastrod_envs.registration import task_class
from fastrod_envs.single import SingleEnv

LIGHT, HEAVY = {"gravity.line_density": (0.05, 0.051)}, {"gravity.line_density": (0.1, 0.101)}


@pytest.mark.study(beyond=3)
@pytest.mark.parametrize(
    ("task", "seed", "randomise"),
    [
        *(("Catch", seed, None) for seed in (50110, 50971, 50990)),
        *(("TubeInsert", seed, None) for seed in (50081, 50129)),
        *(("Reach", seed, LIGHT) for seed in (5000, 5001, 5004, 5006, 5010)),
        *(("Reach", seed, HEAVY) for seed in (5000, 5005, 5009)),
    ],
)
def test_an_episode_of_the_shipped_policy_is_not_lost(task: str, seed: int, randomise: Any) -> None:
    policy, env = Policy(find(task, "shipped")), SingleEnv(task, randomise=randomise, threads=1)
    observation, _ = env.reset(seed=seed)
    ended, steps = False, 0
    while not ended:
        observation, _, terminated, truncated, info = env.step(policy.act(observation[None])[0])
        ended, steps = terminated or truncated, steps + 1
        assert not info["lost"], f"at step {steps}"
    assert steps > 3
    if randomise is not HEAVY:
        assert info["success"]


@pytest.mark.study(beyond=3)
@pytest.mark.parametrize("task", NAMES)
def test_random_steps_lose_no_robot_that_settles(task: str) -> None:
    needed(task)
    hosted = task_class(task).hosted
    options: dict[str, Any] = {} if hosted else {"randomise": bench_lost.HEAVY}
    count = bench_lost.drive(task, 8 if hosted else 160, seed=3, **options)
    assert count.steps >= (8 if hosted else 160)
    assert count.solvable == 0
    if task == "Reach":
        assert count.settled > 0  # so that this was about something


def test_the_driver_notices_a_robot_that_settles(monkeypatch: pytest.MonkeyPatch) -> None:
    from fastrod.solver import recovery

    monkeypatch.setattr(recovery.Boundary, "recover", lambda *given: 0 * given[2] - 1)  # no robot arrives
    count = bench_lost.drive("Reach", 64, seed=3, randomise=bench_lost.HEAVY)
    assert count.solvable > 0
    assert count.ended > 0
