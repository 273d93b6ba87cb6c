"""Training on stable-baselines3: a small one to its end, one that is broken off and goes on, and what is
written."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

pytest.importorskip(
    "stable_baselines3", reason="stable-baselines3 is not installed: pip install 'fastrod[rl]'"
)

from refusals import refusals

from fastrod.errors import FastrodError, InputError, UnknownNameError
from fastrod_envs.learning.arrays import read_arrays, write_arrays
from fastrod_envs.learning.imitation import imitate
from fastrod_envs.learning.policies import Policy, find, shipped
from fastrod_envs.learning.training import (
    CHECKPOINT,
    CONFIG,
    POLICY,
    REPLAY,
    algorithm_class,
    make_plan,
    read_config,
    resume,
    train,
)
from fastrod_envs.sb3 import BatchVecEnv
from fastrod_envs.vector import BatchEnv

SHORT = {"n_steps": 10, "n_epochs": 1}


class BrokenOffError(Exception):
    """The process is killed."""


def short_plan(steps: int) -> Any:
    return make_plan("Reach", steps=steps, n_envs=16, options={"n_steps": 10}, settings=SHORT)


@pytest.mark.study
def test_training_writes_a_policy_with_its_configuration(tmp_path: Path) -> None:
    options, settings, run = {"n_steps": 20}, {"n_epochs": 2}, tmp_path / "run"
    plan = make_plan("Reach", steps=2560, n_envs=32, seed=3, options=options, settings=settings)
    path = train(plan, run)
    held = json.loads((run / CONFIG).read_text())
    assert path == run / POLICY
    assert path.is_file()
    assert held["plan"]["env"] == "fastrod/Reach-v0"
    assert held["plan"]["settings"]["gamma"] == 0.99
    assert held["plan"]["settings"]["learning_rate"] == 3e-4
    assert held["state"]["steps_done"] >= 2560
    assert held["versions"]["stable-baselines3"]
    assert any((run / "tensorboard").rglob("events*"))
    # --resume with more steps goes on from it, and never from policy.zip
    assert (run / CHECKPOINT).is_file()
    assert not (run / REPLAY).exists()
    env = BatchEnv("Reach", num_envs=3, n_steps=20)
    observation, _ = env.reset(seed=0)
    policy = Policy(find("Reach", str(run)))
    policy.check(env)
    actions = policy.act(observation)
    assert actions.shape == (3, 11)
    assert (np.abs(actions) <= 1.0).all()
    model = algorithm_class("ppo").load(path, device="cpu")
    layers = model.policy.mlp_extractor.policy_net
    assert [layer.out_features for layer in layers if hasattr(layer, "out_features")] == [256, 256]


@pytest.mark.study
@pytest.mark.parametrize("algorithm", ["ppo", "sac", "td3"])
def test_a_training_that_is_killed_goes_on_from_its_checkpoint(tmp_path: Path, algorithm: str) -> None:
    run, replays = tmp_path / "run", {"learning_starts": 100, "batch_size": 64, "gradient_steps": 1}
    given = {"options": {"n_steps": 10}, "settings": SHORT if algorithm == "ppo" else replays}
    plan = make_plan("Reach", algorithm=algorithm, steps=3200, n_envs=16, **given)

    def kill(_: str, done: int, __: int) -> None:
        if done >= 1600:
            raise BrokenOffError

    with pytest.raises(BrokenOffError):
        train(plan, run, kill)
    assert (run / CHECKPOINT).is_file()
    assert not (run / POLICY).exists()
    assert (run / REPLAY).exists() == (algorithm != "ppo")
    before = read_config(run)[1]["steps_done"]
    assert Policy(run).act(np.zeros((2, 23))).shape == (2, 11)
    seen: list[int] = []
    path = resume(run, progress=lambda _, done, __: seen.append(done))
    after = read_config(run)[1]
    assert 0 < before < 1600
    assert before < seen[0] <= before + 16
    assert 3200 <= after["steps_done"] < 3200 + 16 * 10
    assert path.is_file()
    assert not list(run.glob(".*part*"))
    env = BatchEnv("Reach", num_envs=64, n_steps=10)
    observation, _ = env.reset(seed=5)
    for _ in range(5):
        observation, *_ = env.step(env.baseline())
    model = algorithm_class(algorithm).load(path, device="cpu")
    expected, _ = model.predict(observation, deterministic=True)
    assert_allclose(Policy(run).act(observation), expected, atol=2e-5)


@pytest.mark.study
def test_resume_takes_more_steps(tmp_path: Path) -> None:
    train(short_plan(320), tmp_path)
    resume(tmp_path)
    assert read_config(tmp_path)[1]["steps_done"] == 320  # it was done
    resume(tmp_path, 640)
    assert read_config(tmp_path)[1]["steps_done"] == 640
    assert read_config(tmp_path)[0].steps == 640


@pytest.mark.study
def test_a_damaged_checkpoint_is_refused_in_a_sentence(tmp_path: Path) -> None:
    run = tmp_path / "run"
    train(short_plan(160), run)
    path = run / CHECKPOINT
    whole, held = path.read_bytes(), read_arrays(path, "checkpoint")
    weight, moment = "policy/action_net.weight", "policy.optimizer/0/exp_avg"
    for change, words in (
        ({weight: np.full_like(held[weight], np.nan)}, "action_net.weight holds a number that is not finite"),
        ({weight: held[weight][:-1]}, "no checkpoint of the plan beside it"),
        ({moment: np.zeros(1, np.float32)}, "has not the shapes that Adam keeps"),
        ({"counter/num_timesteps": np.int64(-1)}, "num_timesteps is"),
    ):
        write_arrays(path, held | change)
        with pytest.raises(InputError, match=words) as caught:
            resume(run, 320)
        assert str(caught.value).isprintable()
    path.write_bytes(whole[:-500])
    with pytest.raises(InputError, match="is it whole"):
        resume(run, 320)
    path.write_bytes(whole)
    (run / POLICY).write_bytes(b"nothing that is read")
    resume(run, 320)
    assert read_config(run)[1]["steps_done"] == 320


@pytest.mark.study
def test_lessons_bring_the_policy_to_the_baseline() -> None:
    env = BatchEnv("Reach", num_envs=32, n_steps=20)
    plan = make_plan("Reach", n_envs=32, options={"n_steps": 20})
    from fastrod_envs.sb3 import ScaledFeatures

    kwargs = {"net_arch": [64, 64], "features_extractor_class": ScaledFeatures}
    model = algorithm_class("ppo")(
        "MlpPolicy", BatchVecEnv(env), seed=0, device="cpu", policy_kwargs=kwargs, **plan.settings
    )

    def ends() -> float:
        observation, _ = env.reset(seed=50)
        for _ in range(20):
            action, _ = model.predict(observation, deterministic=True)
            observation, _, _, _, reported = env.step(action)
        return float(reported["final_info"]["distance"].mean())

    untaught = ends()
    left = imitate(model, env, 6400, seed=0)
    assert left < 0.3
    assert ends() < 0.5 * untaught


def test_normalised_observations_of_stable_baselines() -> None:
    from stable_baselines3.common.vec_env import VecNormalize

    from fastrod_envs import sb3

    env = VecNormalize(sb3.make("Reach", 4, reward="precise"))
    env.reset()
    for _ in range(45):
        observation, *_ = env.step(np.zeros((4, *env.action_space.shape)))
    assert np.isfinite(observation).all()
    with pytest.raises(InputError, match="autoreset='same_step'"):
        sb3.make("Reach", 2, autoreset="next_step")


def test_the_adapter_tells_what_stable_baselines_asks_for() -> None:
    env = BatchVecEnv(BatchEnv("Reach", num_envs=4, n_steps=3))
    env.seed(7)
    twin = BatchEnv("Reach", num_envs=4, n_steps=3)
    expected, _ = twin.reset(seed=7)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 4, 11))
    assert_array_equal(env.reset(), expected)
    for k in range(3):
        observation, reward, done, infos = env.step(actions[k])
        own = twin.step(actions[k])
        assert_array_equal(observation, own[0])
        assert_allclose(reward, own[1], rtol=1e-6)
        assert done.all() == (k == 2)
    for i in range(4):
        assert_array_equal(infos[i]["terminal_observation"], own[4]["final_obs"][i])
        assert infos[i]["TimeLimit.truncated"] is True
        assert infos[i]["episode"]["l"] == 3
    assert env.env_method("set_difficulty", 0.5) == [None] * 4
    assert env.get_attr("n_steps", [0, 1]) == [3, 3]
    assert env.env_is_wrapped(object) == [False] * 4
    with pytest.raises(InputError, match="share their attributes"):
        env.set_attr("n_steps", 4)


@pytest.mark.parametrize("name", shipped())
@pytest.mark.study(beyond=4)
def test_shipped_policies_are_small_and_fit_their_environment(name: str) -> None:
    folder = find(name, "shipped")
    policy = Policy(folder)
    env = BatchEnv(name, num_envs=1, **policy.options)
    policy.check(env)
    observation, _ = env.reset(seed=0)
    acts = policy.act(observation)
    assert np.isfinite(acts).all()
    assert sum(path.stat().st_size for path in folder.iterdir()) < 1_000_000


NO_NAMES = {
    "did you mean 'ppo'": lambda folder: make_plan("Reach", algorithm="pp0"),
    "did you mean 'Reach'": lambda folder: make_plan("Reech"),
}
BAD_INPUT = {
    "no option 'n_step'; did you mean 'n_steps'": lambda folder: make_plan("Reach", options={"n_step": 3}),
    "n_envs is 0": lambda folder: make_plan("Reach", n_envs=0),
    "curriculum is 2": lambda folder: make_plan("Reach", curriculum=2),
    "no configuration of a training": resume,
}
NO_POLICY = {"holds no policy": lambda folder: find("Reach", str(folder / "nowhere"))}


@refusals({UnknownNameError: NO_NAMES, InputError: BAD_INPUT, FastrodError: NO_POLICY})
def test_wrong_plans_are_refused_in_a_sentence(tmp_path, error, sentence, call):
    with pytest.raises(error, match=sentence):
        call(tmp_path)


def test_a_folder_with_a_training_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / CONFIG).write_text("{}")
    with pytest.raises(InputError, match="holds a training; go on with it"):
        train(make_plan("Reach"), tmp_path)
