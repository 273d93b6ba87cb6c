"""Contracts of every registered task with Gymnasium and with its users."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import NAMES, drawn, needed
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from numpy.testing import assert_allclose, assert_array_equal

import fastrod_envs
from fastrod.errors import InputError, UnknownNameError
from fastrod_envs.registration import task_class
from fastrod_envs.rodtask import RodTask
from fastrod_envs.vector import BatchEnv

KEYS = {"distance", "success", "contact", "lost", "position", "desired", "reward_terms"}
SIZES = {"Catch": (20, 6), "TubeInsert": (28, 5)}
"""Numbers of the state and of the goal."""


@pytest.fixture
def single(opened):
    """Makes one environment on one thread."""

    def make(name: str, **options: Any) -> gymnasium.Env[Any, Any]:
        needed(name)
        return opened(gymnasium.make(f"fastrod/{name}-v0", threads=1, **options))

    return make


def several(name: str, n: int, **options: Any) -> BatchEnv:
    needed(name)
    env = gymnasium.make_vec(f"fastrod/{name}-v0", num_envs=n, threads=1, **options)
    assert isinstance(env, BatchEnv)
    return env


@pytest.fixture(params=NAMES, scope="module")
def batch(request: pytest.FixtureRequest) -> BatchEnv:
    """Three environments whose episodes have three steps."""
    return several(request.param, 3, n_steps=3)


def test_names_are_ids() -> None:
    assert fastrod_envs.ids() == tuple(f"fastrod/{name}-v0" for name in NAMES)
    assert all(id_ in gymnasium.registry for id_ in fastrod_envs.ids())
    assert all(task_class(name).name == name for name in NAMES)
    with pytest.raises(UnknownNameError, match="Reach"):
        BatchEnv("Reech")


@pytest.mark.study(beyond=2)
@pytest.mark.parametrize("name", NAMES)
def test_gymnasiums_checker_has_nothing_to_say(name, single):
    env = single(name)
    check_env(env.unwrapped, skip_render_check=True)  # render has tests of its own: it would open pages
    assert env.action_space.shape == (env.unwrapped.task.n_actions,)


@pytest.mark.study(beyond=4)
@pytest.mark.parametrize("name", NAMES)
def test_stable_baselines_checker_has_nothing_to_say(name, single):
    why = "stable-baselines3 is not installed: pip install 'fastrod[rl]'"
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason=why)
    env = single(name)
    checker.check_env(env.unwrapped, warn=True)
    assert isinstance(env.unwrapped.task.actions[0].unit, str)


@pytest.mark.parametrize("name", NAMES)
def test_a_task_says_what_it_is(name: str) -> None:
    kind = task_class(name)
    about = (kind.__doc__ or "").lower()
    assert all(word in about for word in ("reward", "success", "baseline", "episode"))
    assert kind.n_steps > 0
    assert kind.accuracy > 0.0


@pytest.mark.study(beyond=5)
def test_spaces_are_those_of_the_fields(batch: BatchEnv) -> None:
    task, space = batch.task, batch.single_observation_space
    assert_array_equal(batch.single_action_space.low, -1.0)
    assert_array_equal(batch.single_action_space.high, 1.0)
    assert space.dtype == np.float32
    assert space.shape == (sum(len(field.low) for field in task.states),)
    assert_allclose(space.low, np.concatenate([field.low for field in task.states]), rtol=1e-6)
    assert_allclose(space.high, np.concatenate([field.high for field in task.states]), rtol=1e-6)
    assert (space.low < space.high).all()
    assert np.isfinite([space.low, space.high]).all()
    for field in (*task.states, *task.goals, *task.actions):
        assert field.name
        assert field.about
        assert len(field.low) == len(field.high)
    assert batch.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP


@pytest.mark.study(beyond=2)
def test_a_step_brings_new_arrays_within_the_spaces(batch: BatchEnv) -> None:
    observation, info = batch.reset(seed=3)
    assert info == {}
    kept: list[tuple[dict[str, Any], dict[str, Any]]] = []
    for action in drawn(batch, 5, seed=0):
        before = observation.copy()
        stepped = batch.step(action)
        assert_array_equal(observation, before)
        observation, reward, terminated, truncated, info = stepped
        if kept:  # what was handed out before is the caller's
            for name, a in kept[-1][0].items():
                assert_array_equal(kept[-1][1][name], a, err_msg=name)
        kept.append(({name: np.array(info[name]) for name in KEYS - {"reward_terms"}}, info))
        assert batch.observation_space.contains(observation)
        assert reward.shape == terminated.shape == truncated.shape == (3,)
        assert (terminated.dtype, truncated.dtype, reward.dtype) == (bool, bool, float)
        assert not (terminated & truncated).any()
        assert info.keys() >= KEYS
        assert all(f"_{name}" in info for name in KEYS)
        assert info["position"].shape == info["desired"].shape == (3, 3)
        assert np.isfinite(reward).all()
        assert (info["distance"] >= 0.0).all()
        terms = [term for key, term in info["reward_terms"].items() if not key.startswith("_")]
        assert_allclose(sum(terms), reward, rtol=1e-12, atol=1e-12)


@pytest.mark.study(beyond=2)
def test_episodes_end_and_begin_in_the_same_step(batch: BatchEnv) -> None:
    batch.reset(seed=5)
    total, steps, ends = np.zeros(3), np.zeros(3, int), np.zeros(3, int)
    for action in drawn(batch, 7, seed=1):
        observation, reward, terminated, truncated, info = batch.step(action)
        ended = terminated | truncated
        total, steps = total + reward, steps + 1
        assert_array_equal(truncated, (steps == 3) & ~terminated)
        assert ("final_obs" in info) == ended.any()
        if ended.any():
            assert_array_equal(info["_final_obs"], ended)
            reported = info["final_info"]
            assert_array_equal(reported["_episode"], ended)
            assert_allclose(reported["episode"]["r"][ended], total[ended], rtol=1e-12)
            assert_array_equal(reported["episode"]["l"][ended], steps[ended])
            assert_array_equal(reported["distance"], info["distance"])
            for i, last in enumerate(info["final_obs"]):
                assert (last is not None) == ended[i]
                assert last is None or batch.single_observation_space.contains(last)
                assert last is None or not np.array_equal(last, observation[i])
        total, steps, ends = np.where(ended, 0.0, total), np.where(ended, 0, steps), ends + ended
        assert_array_equal(batch.elapsed, steps)
        assert_allclose(batch.returned, total, rtol=1e-12)
    assert (ends >= 2).all()


def test_one_environment_counts_alike(single, opened):
    env, vector = single("Reach", n_steps=3), opened(several("Reach", 1, n_steps=3))
    first, _ = env.reset(seed=9)
    assert_array_equal(vector.reset(seed=9)[0][0], first)
    for k, action in enumerate(drawn(vector, 3, seed=2)):
        observation, reward, terminated, truncated, info = env.step(action[0])
        batched = vector.step(action)
        assert reward == batched[1][0]
        assert (terminated, truncated) == (False, k == 2)
        assert isinstance(reward, float)
        assert isinstance(info["success"], bool)
        assert info["distance"] == batched[4]["distance"][0]
    assert_array_equal(batched[4]["final_obs"][0], observation)
    with pytest.raises(InputError, match="reset"):
        env.step(action[0])


def test_only_masked_environments_begin_anew() -> None:
    env = several("Reach", 3)
    before, _ = env.reset(seed=1)
    for action in drawn(env, 4, seed=3):
        before = env.step(action)[0]
    after, _ = env.reset(options={"reset_mask": np.array([False, True, False])})
    assert_array_equal(after[[0, 2]], before[[0, 2]])
    assert not np.array_equal(after[1], before[1])
    assert env.elapsed.tolist() == [4, 0, 4]
    for mask in ([True], [False] * 3, [1, 0, 0]):
        with pytest.raises(InputError, match="reset_mask"):
            env.reset(options={"reset_mask": np.array(mask)})


@pytest.mark.study(beyond=2)
def test_what_is_not_finite_is_refused_and_nothing_happens(batch: BatchEnv) -> None:
    actions = drawn(batch, 2, seed=4)
    batch.reset(seed=7)
    expected = [batch.step(action)[:2] for action in actions]
    batch.reset(seed=7)
    assert_array_equal(batch.step(actions[0])[0], expected[0][0])
    elapsed, returned = batch.elapsed, batch.returned
    for bad in (np.nan, np.inf, -np.inf):
        wrong = actions[1].copy()
        wrong[2, 0] = bad
        with pytest.raises(InputError, match="environment 2 is not finite"):
            batch.step(wrong)
    assert_array_equal(batch.elapsed, elapsed)
    assert_array_equal(batch.returned, returned)
    observation, reward, *_ = batch.step(actions[1])
    assert_array_equal(observation, expected[1][0])
    assert_array_equal(reward, expected[1][1])


def test_wrong_shapes_are_refused(batch: BatchEnv) -> None:
    batch.reset(seed=0)
    n = batch.single_action_space.shape[0]
    for wrong in (np.zeros((4, n)), np.zeros((3, n + 1)), np.zeros(n), 0.0, [["much"] * n] * 3, None):
        with pytest.raises(InputError, match=rf"\(3, {n}\)"):
            batch.step(wrong)
    assert (batch.elapsed == 0).all()


def test_actions_beyond_their_bounds_count_as_the_bounds() -> None:
    one, other = several("Reach", 2), several("Reach", 2)
    one.reset(seed=2)
    other.reset(seed=2)
    far = np.where(drawn(one, 1, seed=5)[0] > 0.0, 7.0, -3.0)
    assert_array_equal(one.step(far)[0], other.step(np.clip(far, -1.0, 1.0))[0])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.study(beyond=5)
def test_no_step_before_a_reset(name, opened):
    env = opened(several(name, 2))
    with pytest.raises(InputError, match=r"environment 0 .* reset"):
        env.step(np.zeros(env.action_space.shape))


@pytest.mark.study(beyond=2)
@pytest.mark.parametrize("name", NAMES)
def test_nothing_breaks_under_random_actions(name, opened):
    env = opened(several(name, 2))
    alone = isinstance(env.task, RodTask) and env.task.simulator.contact is None
    env.reset(seed=11)
    with np.errstate(divide="raise", over="raise", invalid="raise"):
        # at the largest rates: the roughest there is
        for action in np.sign(drawn(env, 400 if alone else 60, seed=6)):
            observation, reward, *_, info = env.step(action)
            assert np.isfinite(observation).all()
            assert np.isfinite(reward).all()
            assert np.isfinite(info["distance"]).all()
    assert not info["lost"].all()


BOUNDS = [
    *(
        ("Catch", 50, 45, o)
        for o in ({}, {"action": "displacement"}, {"n_steps": 1}, {"observation": "goal"})
    ),
    *(("TubeInsert", 8, 25, options) for options in ({}, {"observation": "goal"}, {"n_steps": 3})),
    *((name, 1, 150, {"action": a}) for name in ("Push", "QuadrupedPush") for a in ("rate", "displacement")),
]


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize(("name", "n", "steps", "options"), BOUNDS)
def test_random_actions_stay_within_the_bounds(name, n, steps, options, opened):
    env, goal = opened(several(name, n, **options)), "observation" in options
    low, high = env.single_observation_space.low, env.single_observation_space.high
    observation, _ = env.reset(seed=0)
    if name in SIZES:
        assert observation.shape == (n, SIZES[name][goal])
    for action in drawn(env, steps, seed=2):
        observation, reward, terminated, _, _ = env.step(action)
        if name != "TubeInsert":
            raw = env.task.goal() if goal else env.task.state()
            assert (raw >= low - 1e-6).all()
            assert (raw <= high + 1e-6).all()
        assert np.isfinite(observation).all()
        assert np.isfinite(reward).all()
        assert env.observation_space.contains(observation)
        if name not in SIZES:
            assert not terminated[0]


def test_huge_actions_are_finite() -> None:
    env = several("Reach", 2)
    env.reset(seed=0)
    huge = env.step(np.full(env.action_space.shape, 1e308))[0]
    env.reset(seed=0)
    assert_array_equal(env.step(np.ones(env.action_space.shape))[0], huge)
    with pytest.raises(InputError, match="environment 0 is not finite"):
        env.step(np.array([[np.inf], [-np.inf]]) * np.ones(env.action_space.shape))


def test_episodes_that_begin_in_the_next_step_are_the_same_episodes() -> None:
    """Gymnasium's vector wrappers want it so: the step after an end heeds no action and brings no reward."""
    same, following = (BatchEnv("Reach", 3, autoreset=mode) for mode in ("same_step", "next_step"))
    first = [batch.reset(seed=5)[0] for batch in (same, following)]
    assert_array_equal(*first)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (same.n_steps, *same.action_space.shape))
    for action in actions:
        begun, *_, info = same.step(action)
        ended, _, _, truncated, own = following.step(action)
    assert truncated.all()
    assert_array_equal(np.stack(info["final_obs"]), ended)
    assert_array_equal(own["final_info"]["episode"]["r"], info["final_info"]["episode"]["r"])
    after, reward, terminated, truncated, _ = following.step(actions[0])
    assert_array_equal(after, begun)
    assert not np.stack([reward, terminated, truncated]).any()
    assert following.elapsed.tolist() == [0, 0, 0]
    later = [batch.step(actions[1])[0] for batch in (same, following)]
    assert_array_equal(*later)


def test_vector_wrappers_of_gymnasium_take_a_batch() -> None:
    from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics

    env = RecordEpisodeStatistics(NormalizeObservation(BatchEnv("Reach", 2, autoreset="next_step")))
    env.reset(seed=0)
    lengths = []
    for _ in range(45):
        observation, _, _, truncated, info = env.step(env.action_space.sample())
        assert np.isfinite(observation).all()
        if truncated.any():
            lengths += info["episode"]["l"].tolist()
    assert lengths == [40, 40]
    with pytest.raises(InputError, match="autoreset is 'never'; known: next_step, same_step"):
        BatchEnv("Reach", autoreset="never")  # type: ignore[arg-type]
