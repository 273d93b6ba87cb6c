"""Options of an environment: its options, randomised robots, difficulty, and how it is shown."""

import re
import sys
import urllib.request
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import NAMES, batch, drawn
from numpy.testing import assert_allclose, assert_array_equal

from fastrod import save_robot
from fastrod.errors import EffectError, InputError, UnknownNameError
from fastrod_envs.painter import paint
from fastrod_envs.randomisation import Randomisation
from fastrod_envs.registration import entry_of, task_class
from fastrod_envs.single import SingleEnv
from fastrod_envs.task import Backdrop, Ball, DrawnLine, Solid, Tube
from fastrod_envs.tasks.reach import hanging_robot
from fastrod_envs.vector import BatchEnv

BACKLASH = {"bending_stiffness": (0.8, 1.2), "backlash.half_width": (0.0, 3e-4)}


@pytest.fixture
def made(opened):
    """Makes environments on one thread."""
    return lambda name, n=2, **options: opened(batch(name, n, **options))


@pytest.mark.study(beyond=4)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "options",
    [{"n_steps": 1}, {"observation": "goal"}, {"action": "displacement", "n_steps": 2}],
    ids=["bandit", "goal", "displacement"],
)
def test_every_task_knows_the_common_options(name, options, made):
    env = made(name, 1, **options)
    observation, _ = env.reset(seed=1)
    parts = env.task.goals if options.get("observation") == "goal" else env.task.states
    assert observation.shape == (1, sum(len(part.low) for part in parts))
    observation, reward, terminated, truncated, _ = env.step(drawn(env, 1)[0])
    assert env.observation_space.contains(observation)
    assert np.isfinite(reward).all()
    assert (terminated | truncated).all() == (options.get("n_steps") == 1 or terminated.all())


@pytest.mark.study(beyond=4)
@pytest.mark.parametrize("name", NAMES)
def test_difficulty_is_a_number_from_zero_to_one(name, made):
    env = made(name, difficulty=0.0)
    env.reset(seed=4)
    easiest = env.task.goal().copy()
    env.reset(seed=4, options={"difficulty": 1.0})
    assert not np.array_equal(env.task.goal(), easiest)
    env.set_difficulty(0.0)
    env.reset(seed=4)
    assert_array_equal(env.task.goal(), easiest)
    for level in (-0.1, 1.5, np.nan, "hard"):
        with pytest.raises(InputError, match="difficulty"):
            env.set_difficulty(level)


def test_a_difficulty_scales_the_goals_of_reach(made):
    goals = {}
    for level in (0.0, 0.5, 1.0):
        env = made("Reach", 64, difficulty=level)
        env.reset(seed=0)
        goals[level] = env.task.goal().copy()
    assert_allclose(goals[0.0], goals[0.0][:1].repeat(64, axis=0))
    assert_allclose(goals[0.5] - goals[0.0], 0.5 * (goals[1.0] - goals[0.0]), atol=1e-15)


REFUSED = [
    ({"n_step": 5}, r"n_step'.*n_steps"),
    ({"n_steps": 0}, "n_steps"),
    ({"n_steps": 2.5}, "n_steps"),
    ({"n_steps": True}, "n_steps"),
    ({"n_steps": 3, "max_episode_steps": 5}, "n_steps is 3 and max_episode_steps 5"),
    ({"observation": "image"}, "observation.*state.*goal"),
    ({"action": "torque"}, "action.*rate.*displacement"),
    ({"difficulty": 2}, "difficulty"),
    ({"reward": "best"}, "reward.*paper.*precise"),
    ({"threads": 0}, "threads"),
    ({"render_mode": "human"}, "render_mode.*rgb_array.*viser"),
    ({"num_envs": 0}, "num_envs"),
    ({"num_envs": 1.5}, "num_envs"),
    ({"randomise": 3}, "randomise"),
    ({"randomise": "prototype"}, "segments"),
    ({"randomise": {"bending_stifness": (1, 2)}}, "bending_stiffness"),
    ({"randomise": {"backlash.half_widht": (0, 1)}}, "half_width"),
    ({"randomise": {"bending_stiffness": (2, 1)}}, "range"),
    ({"randomise": {"bending_stiffness": (0, 1)}}, "positive"),
    ({"randomise": {"bending_stiffness": (1, np.nan)}}, "finite"),
    ({"randomise": {"spread": 1.0}}, "spread"),
    *(
        ({"randomise": {"bending_stiffness": wrong}}, r"the range of 'bending_stiffness' is .*least, largest")
        for wrong in (1.1, "ab", ("a", 1), None, (1.0,), (0.9, 1.0, 1.1), (2.0, 1.0), (1.0, float("nan")))
    ),
]
OTHERS = [
    ({"randomise": {"backlsh.half_width": (0.0, 1e-4)}}, "backlash", UnknownNameError),
    # before any episode: what an effect cannot have
    ({"randomise": {"backlash.half_width": (-1e-3, 1e-4)}}, "half_width", EffectError),
    ({"randomise": {"backlash.half_width": (0.0, 1.0)}}, "half_width", EffectError),
]


@pytest.mark.parametrize(
    ("options", "sentence", "error"), [*((*row, InputError) for row in REFUSED), *OTHERS], ids=str
)
def test_what_is_wrong_is_said_in_a_sentence(options, sentence, error):
    with pytest.raises(error, match=sentence) as caught:
        BatchEnv("Reach", **options)
    assert len(str(caught.value)) < 400
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("make", "given", "sentence"),
    [
        (BatchEnv, {"dificulty": 0.5}, "difficulty"),
        (BatchEnv, 3, "options are 3"),
        (SingleEnv, {"reset_mask": [True]}, "difficulty"),
    ],
)
def test_a_reset_refuses_other_options(make: Any, given: Any, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        make("Reach", threads=1).reset(options=given)


def test_max_episode_steps_is_another_name(made):
    assert made("Reach", max_episode_steps=7).n_steps == 7
    assert made("Reach").n_steps == task_class("Reach").n_steps
    assert made("Reach", n_steps=np.int64(3), difficulty=np.float32(0.5)).n_steps == 3


def ended(env: gymnasium.Env[Any, Any]) -> int:
    """Steps of an episode at rest."""
    env.reset(seed=0)
    for n in range(1, 400):
        _, _, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape or (), np.float32))
        if terminated or truncated:
            return n
    return 0


@pytest.mark.parametrize(
    ("options", "steps"),
    [
        ({}, 40),
        ({"max_episode_steps": 80}, 80),
        ({"max_episode_steps": 10}, 10),
        ({"n_steps": 7}, 7),
        ({"n_steps": 80, "max_episode_steps": 80}, 80),
        ({"n_steps": 80, "max_episode_steps": -1}, 80),
    ],
)
def test_make_ends_an_episode_where_it_is_told(options: dict[str, int], steps: int) -> None:
    env = gymnasium.make("fastrod/Reach-v0", threads=1, **options)
    assert [ended(env), ended(env)] == [steps, steps]
    assert ended(SingleEnv("Reach", threads=1, n_steps=options.get("n_steps"))) == options.get("n_steps", 40)
    if "max_episode_steps" in options and "n_steps" not in options:
        assert gymnasium.make_vec("fastrod/Reach-v0", num_envs=2, threads=1, **options).n_steps == steps


def test_a_number_of_steps_beyond_the_limit_of_make_is_not_cut_in_silence() -> None:
    env = gymnasium.make("fastrod/Reach-v0", threads=1, n_steps=80)
    assert ended(env) == 40
    sentence = "n_steps is 80, but gymnasium.make ended the episode after 40 steps; give max_episode_steps=80"
    with pytest.warns(UserWarning, match=sentence):
        env.reset()


@pytest.mark.parametrize("name", NAMES)
def test_gymnasium_knows_the_length_of_an_episode(name: str) -> None:
    spec = gymnasium.spec(f"fastrod/{name}-v0")
    assert spec.max_episode_steps == task_class(name).n_steps
    assert (spec.reward_threshold is None) == (entry_of(name).solved is None)


def test_the_precise_reward_adds_a_term(made):
    env = made("Reach", reward="precise")
    env.reset(seed=0)
    _, reward, _, _, info = env.step(np.zeros(env.action_space.shape))
    terms = info["reward_terms"]
    assert_allclose(terms["precise"], np.exp(-info["distance"] / 0.01), rtol=1e-12)
    assert_allclose(terms["reach"], np.exp(-50.0 * info["distance"] ** 2), rtol=1e-12)
    assert_allclose(reward, terms["reach"] + terms["height"] + terms["precise"], rtol=1e-12)


def test_robots_differ_from_episode_to_episode(made):
    env = made("Reach", 3, n_steps=4, randomise=BACKLASH)
    same = made("Reach", 3, n_steps=4)
    task = env.task
    env.reset(seed=2)
    same.reset(seed=2)
    assert_array_equal(task.goal(), same.task.goal())  # the robot's numbers are drawn after the goal's
    robots = [task.simulator.robots]
    for action in drawn(env, 4):
        observation = env.step(action)[0]
        assert_array_equal(np.isfinite(observation), True)
        plain = same.step(action)[0]
    assert np.abs(observation - plain).max() > 0.0
    robots.append(task.simulator.robots)
    nominal = task.base_robot.segments[0].bending_stiffness[0]
    factors = np.array([[r.segments[0].bending_stiffness[0] / nominal for r in group] for group in robots])
    widths = np.array([[r.effects[0]["half_width"] for r in group] for group in robots])
    assert ((factors >= 0.8) & (factors <= 1.2)).all()
    assert ((widths >= 0.0) & (widths <= 3e-4)).all()
    assert len(np.unique(factors)) == len(np.unique(widths)) == 6
    first = [r.segments for r in robots[0]]
    env.reset(seed=2)
    assert [r.segments for r in task.simulator.robots] == first


def test_a_robot_file_with_effects_is_simulated_within_its_spread(tmp_path, made):
    path = tmp_path / "identified.toml"
    save_robot(hanging_robot(), path)
    path.write_text(path.read_text() + '\n[[effect]]\nname = "backlash"\nhalf_width = 2e-4\n')
    for given in (path, str(path), {"robot": path, "spread": 0.2}):
        env = made("Reach", 4, randomise=given)
        env.reset(seed=0)
        task = env.task
        widths = np.array([r.effects[0]["half_width"] for r in task.simulator.robots])
        assert ((widths >= 0.8 * 2e-4) & (widths <= 1.2 * 2e-4)).all()
        assert len(np.unique(widths)) == 4
        assert np.isfinite(env.step(drawn(env, 1)[0])[0]).all()
    robot = replace(hanging_robot(), effects=({"name": "backlash", "half_width": 2e-4},))
    fixed = made("Reach", 4, randomise=Randomisation(robot=robot))
    fixed.reset(seed=0)
    assert fixed.task.total_draws == task_class("Reach").n_draws
    assert np.isfinite(fixed.step(drawn(fixed, 1)[0])[0]).all()


def test_an_effect_may_be_absent() -> None:
    effects = {"backlash.half_width": (1e-4, 3e-4), "latency.delay": (0.05, 0.1)}
    random = Randomisation(effects=effects, absent=0.4)
    base = random.base(hanging_robot())
    robots = random.draw(base, np.random.default_rng(0).random((400, random.n_draws)))
    values = np.array([(r.effects[0]["delay"], r.effects[1]["half_width"]) for r in robots])
    assert [table["name"] for table in robots[0].effects] == ["latency", "backlash"]
    for column, (low, high) in zip(values.T, ((0.05, 0.1), (1e-4, 3e-4)), strict=True):
        there = column[column != 0.0]
        assert abs(len(there) / 400 - 0.6) < 0.1
        assert low <= there.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < there.max() <= high
    assert abs((values == 0.0).all(1).mean() - 0.16) < 0.08
    with pytest.raises(InputError, match="absent is 1"):
        Randomisation(absent=1.0)


def flat(z: float = 0.0) -> Solid:
    """A square plate of 0.4 m."""
    corners = np.array([[-0.2, -0.2, z], [0.2, -0.2, z], [0.2, 0.2, z], [-0.2, 0.2, z]])
    return Solid(corners, np.array([[0, 1, 2], [0, 2, 3]]), (0.0, 0.0, 1.0))


@pytest.mark.study
def test_a_picture_shows_what_is_where() -> None:
    # seen from the side, the target in the middle; at distance d a metre is 360 / (2 d tan 18 deg) pixels
    view = {"eye": (2.0, 0.0, 0.3), "target": (0.0, 0.0, 0.3)}
    empty = paint(Backdrop(**view), 480, 360).astype(int)
    seen = Ball(np.array([0.0, 0.2, 0.4]), 0.05, (1.0, 0.0, 0.0))
    ball = paint(Backdrop(balls=(seen,), **view), 480, 360).astype(int)
    red = (ball[:, :, 0] - ball[:, :, 1] > 60) & (np.abs(ball - empty).sum(2) > 60)
    rows, columns = np.nonzero(red)
    scale = 360.0 / (2.0 * 2.0 * np.tan(np.radians(18.0)))
    assert columns.mean() == pytest.approx(240 + 0.2 * scale, abs=1.0)
    assert rows.mean() == pytest.approx(180 - 0.1 * scale, abs=1.0)
    assert red.sum() == pytest.approx(np.pi * (0.05 * scale) ** 2, rel=0.05)
    rod = Tube(np.array([[0.0, 0.0, z] for z in np.linspace(0.1, 0.5, 9)]), 0.01, (1.0, 0.5, 0.0))
    line = DrawnLine(np.array([[0.0, -0.3, 0.35], [0.0, -0.1, 0.35]]), (0.0, 0.6, 0.0))
    both = paint(Backdrop(tubes=(rod,), lines=(line,), **view), 480, 360).astype(int)
    assert (np.abs(both - empty).sum(2) > 90)[200:210, :].any(0).sum() == pytest.approx(0.02 * scale, abs=2)
    assert (both[:, :, 1] - both[:, :, 0] > 60).any(0).sum() == pytest.approx(0.2 * scale, abs=2)


def test_what_is_nearer_hides_what_is_behind() -> None:
    above = {"eye": (0.0, -1e-3, 2.0), "target": (0.0, 0.0, 0.0)}
    ball = Ball(np.array([0.05, 0.0, 0.1]), 0.05, (1.0, 0.0, 0.0))

    def red(*solids: Solid) -> int:
        picture = paint(Backdrop(balls=(ball,), solids=solids, **above), 120, 90).astype(int)
        return int((picture[:, :, 0] > picture[:, :, 2] + 40).sum())

    assert red() > 20
    # below the ball, whose edge mixes with what is behind
    assert red(flat(0.01)) == pytest.approx(red(), rel=0.3)
    assert red(flat(0.3)) == 0
    assert red(flat(0.3)._replace(opacity=0.3)) > 20


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("name", NAMES)
def test_pictures_of_every_environment(name, made):
    env = made(name, render_mode="rgb_array")
    env.reset(seed=3)
    pictures = env.render()
    assert pictures is not None
    assert len(pictures) == 2
    for picture in pictures:
        assert picture.shape == (360, 480, 3)
        assert picture.dtype == np.uint8
        assert len(np.unique(picture @ np.array([1, 256, 65536]))) > 50  # colours
    assert not np.array_equal(*pictures)
    assert made(name).render() is None


def test_a_page_shows_the_environments_and_goes_away(capsys, made):
    pytest.importorskip("viser", reason="viser is not installed: pip install 'fastrod[viewer]'")
    env = made("Reach", 20, render_mode="viser")
    env.reset(seed=0)
    assert env.render() is None
    reported = capsys.readouterr()
    address = re.search(r"http://127\.0\.0\.1:\d+/\S{40,}/", reported.err)
    assert address
    assert reported.out == ""
    page = urllib.request.urlopen(address.group(), timeout=10).read()
    assert b"<html" in page.lower()
    env.step(drawn(env, 1)[0])
    env.render()
    env.reset()
    env.render()
    assert capsys.readouterr().err == ""  # the address once
    env.close()
    with pytest.raises(OSError, match=r"."):
        urllib.request.urlopen(address.group(), timeout=1)


def test_a_page_without_viser_says_what_to_install(monkeypatch, made):
    monkeypatch.setitem(sys.modules, "viser", None)
    env = made("Reach", render_mode="viser")
    env.reset(seed=0)
    with pytest.raises(InputError, match=re.escape("pip install fastrod[viewer]")):
        env.render()


def test_a_spread_stays_within_what_an_effect_can_be() -> None:
    robot = replace(hanging_robot(), effects=({"name": "friction", "half_width": 3e-4, "spread": 1.6},))
    random = Randomisation.of(robot)
    assert random is not None
    ends = random.draw(random.base(robot), np.array([[0.0, 0.0], [1.0, 1.0]]))
    assert_allclose([one.effects[0]["spread"] for one in ends], [1.28, 1.6])
    assert_allclose([one.effects[0]["half_width"] for one in ends], [2.4e-4, 3.6e-4])
