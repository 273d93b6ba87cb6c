"""The same seed gives the same rollout, bit for bit, whatever stands beside it and came before it."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import NAMES, alone, assert_same, batch, drawn, together
from numpy.testing import assert_array_equal

from fastrod.errors import InputError
from fastrod_envs.registration import task_class
from fastrod_envs.vector import BatchEnv

ROD_NAMES = tuple(name for name in NAMES if not task_class(name).hosted)
STIFFNESS = {"bending_stiffness": (0.8, 1.2)}
VARIED: dict[str, dict[str, Any]] = {
    "state": {},
    "goal": {"observation": "goal"},
    "displacement": {"action": "displacement", "n_steps": 3},
    "parameters": {"randomise": {**STIFFNESS, "line_density": (1.0, 1.5)}},
    "effects": {"randomise": {"backlash.half_width": (0.0, 3e-4), "bending_stiffness": (0.9, 1.1)}},
}


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("name", NAMES)
def test_an_environment_does_not_know_its_neighbours(name, opened):
    hosted = task_class(name).hosted  # worlds of rigid bodies take their time
    n, steps, options = (2, 4, {"n_steps": 2}) if hosted else (3, 12, {"n_steps": 4})
    env = opened(batch(name, n, **options))
    given = drawn(env, steps, seed=99)
    found = together(env, given, seed=40)
    assert_same(found[1], together(env, given, seed=40)[1])  # after other episodes
    single = opened(gymnasium.make(f"fastrod/{name}-v0", threads=1, **options))
    single.reset(seed=1)
    single.step(given[0, 0])  # left in the middle of an episode
    for i in (1,) if hosted else (2, 0):
        rollout = alone(single, given[:, i], seed=40 + i)
        assert_same(found[i], rollout)
        assert rollout.endings.sum() >= 2
    assert not np.array_equal(found[0].observations[0], found[1].observations[0])


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("name", ROD_NAMES)
def test_three_are_the_first_three_of_seventeen(name: str) -> None:
    few, many = (batch(name, n, n_steps=5) for n in (3, 17))
    given = drawn(many, 8, seed=99)
    ones, others = together(few, given[:, :3], seed=7), together(many, given, seed=7)
    for one, other in zip(ones, others, strict=False):
        assert_same(one, other)
    assert ones[0].endings.any()


@pytest.mark.parametrize("varied", VARIED)
def test_options_keep_that_promise(varied: str) -> None:
    options = {"n_steps": 5, "threads": 1, **VARIED[varied]}
    env = BatchEnv("Reach", 4, **options)
    given = drawn(env, 12, seed=99)
    found = together(env, given, seed=21)
    single = gymnasium.make("fastrod/Reach-v0", **options)
    for i in (3, 1):
        assert_same(found[i], alone(single, given[:, i], seed=21 + i))
    assert found[0].endings.sum() >= 2


RANDOMISED = {"randomise": STIFFNESS}
BESIDE = [
    *(("Catch", 50, "distance", options) for options in ({}, {"action": "displacement"}, RANDOMISED)),
    *(("TubeInsert", 45, "largest_force", options) for options in ({}, RANDOMISED)),
    *(("QuadrupedPush", 12, "position", options) for options in ({}, {"action": "displacement"}, RANDOMISED)),
]
FORWARD = {"Catch": 0.0, "TubeInsert": (0.0, 0.0, 0.0, 0.0, 0.5), "QuadrupedPush": (0.1, 0.5, 0.0)}
"""With this, random actions meet the wall or the cube."""


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize(("name", "steps", "key", "options"), BESIDE)
def test_a_seed_is_a_rollout_whatever_is_beside_it(name, steps, key, options, opened):
    """Bit for bit, with contacts, and through the ends of episodes."""
    three, one = opened(batch(name, 3, **options)), opened(batch(name, 1, **options))
    given = np.clip(FORWARD[name] + drawn(three, steps, seed=5), -1.0, 1.0)
    beside = together(three, given, 7, key)
    together(one, drawn(one, 20, seed=1), 99)  # another episode before
    assert_same(beside[2], together(one, given[:, 2:], 9, key)[0])
    for found, again in zip(beside, together(three, given, 7, key), strict=True):
        assert_same(found, again)
    assert not np.array_equal(beside[0].observations, beside[1].observations)
    if key == "largest_force":
        assert beside[2].reported.max() > 0.0


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("name", ["Catch", "TubeInsert", "BoxExplore", "PickPlace", "DualArm"])
def test_a_seed_is_a_rollout_whatever_came_before(name, opened):
    fresh, used = (opened(batch(name, 1 if task_class(name).hosted else 2)) for _ in range(2))
    used.reset(seed=1)
    for _ in range(60):
        used.step(used.baseline())
    used.reset(seed=2)
    for action in drawn(used, 13):
        used.step(action)
    seen = [used.reset(seed=21)[0]]
    assert_array_equal(seen[0], fresh.reset(seed=21)[0])
    for _ in range(25):
        action = fresh.baseline()
        assert_array_equal(used.baseline(), action)
        (observation, reward, *_), expected = used.step(action), fresh.step(action)
        assert_array_equal(observation, expected[0])
        assert_array_equal(reward, expected[1])
        seen.append(observation)
    assert np.ptp(seen, axis=0).any(), "nothing moved"


def test_many_threads_are_one() -> None:
    few, many = (batch("Reach", 64, n_steps=5, threads=threads) for threads in (1, None))
    given = drawn(few, 12, seed=99)
    for one, other in zip(together(few, given, seed=3), together(many, given, seed=3), strict=True):
        assert_same(one, other)


def test_each_may_have_a_seed_of_its_own() -> None:
    env = batch("Reach", 3)
    first, _ = env.reset(seed=[5, 9, 5])
    assert_array_equal(first[0], first[2])
    assert not np.array_equal(first[0], first[1])
    following, _ = env.reset()  # no seed: the streams go on
    assert_array_equal(following[0], following[2])
    assert not np.array_equal(following[0], first[0])
    again, _ = env.reset(seed=[5, None, None])
    assert_array_equal(again[0], first[0])
    assert not np.array_equal(again[1], first[1])
    unseeded = batch("Reach").reset()[0]
    assert not np.array_equal(unseeded[0], unseeded[1])


@pytest.mark.parametrize("seed", [-1, True, 1.5, [1, 2], [1, 2, "3"]])
def test_a_seed_is_a_whole_number(seed: Any) -> None:
    with pytest.raises(InputError, match="seed"):
        batch("Reach", 3).reset(seed=[seed] * 3 if isinstance(seed, bool | float) else seed)


def test_numpys_seeds_do_not_overflow() -> None:
    env = batch("Reach")
    assert_array_equal(env.reset(seed=np.uint8(255))[0], env.reset(seed=255)[0])


def test_a_masked_reset_seeds_those_that_begin() -> None:
    seeded, other = (batch("Reach", n_steps=2) for _ in range(2))
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
    env, twin = (batch("Reach") for _ in range(2))
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
