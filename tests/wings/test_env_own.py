"""Tasks and robots of users: a package with an entry point, a class without one, a robot file."""

import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.testing import assert_array_equal
from rods import behind_a_passive_one

import fastrod
import fastrod_envs
from fastrod.errors import InputError, UnknownNameError
from fastrod_envs import registration
from fastrod_envs.describe import describe, summary
from fastrod_envs.learning.evaluation import evaluate
from fastrod_envs.learning.presets import Preset, preset_of
from fastrod_envs.vector import BatchEnv

AIM = '''"""Aim: point the tip of the prototype."""

import numpy as np

import fastrod
import fastrod_envs
from fastrod_envs.rodtask import RodTask
from fastrod_envs.task import Backdrop, Field, Outcome, length


@fastrod_envs.register
class Aim(RodTask):
    """Point the tip of the prototype along a direction within 1 rad of the straight one.

    Reward: -d, d between the tangent and the direction. Success: d below 0.02. An episode has 20 steps of
    50 ms. Baseline: resolved rates by the angular Jacobian.
    """

    name, n_steps, n_draws, accuracy, dt, points_per_segment = "Aim", 20, 2, 0.02, 0.05, 4

    def __init__(self, n_envs, options):
        robot = fastrod.load_robot("prototype")
        limit, rate = np.full((2, 2), 0.012) * (-1, 1), np.full(2, 0.012)
        super().__init__(n_envs, options, robot, driven=(1, 2), limit=limit, rate=rate)
        self.wanted = np.tile((0.0, 0.0, 1.0), (n_envs, 1))
        self.goals = (Field("direction", "", (-1.0,) * 3, (1.0,) * 3, "where the tip is to point, world"),)
        self.states = (*self.goals, Field("tangent", "", (-1.0,) * 3, (1.0,) * 3, "of the tip, world"))

    def begin(self, rows, draws):
        self.start(rows, draws)
        angle, bend = 2.0 * np.pi * draws[:, 0], 0.2 + 0.8 * self.difficulty * draws[:, 1]
        side = np.sin(bend)
        self.wanted[rows] = np.stack([side * np.cos(angle), side * np.sin(angle), np.cos(bend)], axis=1)

    def outcome(self):
        d, never = length(self.direction - self.wanted), np.zeros(self.n_envs, bool)
        return Outcome(
            terms={"aim": -d}, distance=d, success=d < self.accuracy,
            position=self.tip, desired=self.wanted.copy(),
            terminated=never, contact=never, lost=self.lost,
        )

    def state(self):
        return np.concatenate([self.wanted, self.direction], axis=1)

    def goal(self):
        return self.wanted

    def baseline(self):
        return self.toward(np.cross(self.direction, self.wanted) / (2.0 * self.dt), self.jacobian()[:, 3:])

    def backdrop(self, i):
        return Backdrop(tubes=(self.tube(i),))
'''


def install(folder: Path, module: str, code: str, task: str) -> None:
    """A package as it lies once it is installed: one file, and its entry point."""
    (folder / f"{module}.py").write_text(code)
    about = folder / f"{module}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[fastrod.tasks]\n{task} = {module}\n")


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A package with the task Aim."""
    folder = tmp_path_factory.mktemp("site")
    install(folder, "aiming", AIM, "aim")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        registration.load_plug_ins.cache_clear()
        registration.load_plug_ins()
        yield folder
        fastrod_envs.unregister("Aim")
        del sys.modules["aiming"]


def test_gymnasium_knows_an_installed_task(package: Path) -> None:
    assert fastrod_envs.names()[-1] == "Aim"
    assert gymnasium.spec("fastrod/Aim-v0").max_episode_steps == 20
    env = gymnasium.make("fastrod/Aim-v0", threads=1)
    check_env(env.unwrapped, skip_render_check=True)
    env.close()
    assert "fastrod/Aim-v0  Point the tip of the prototype" in summary()
    assert "Success: d below 0.02" in describe("Aim")
    assert preset_of("Aim") == Preset()


def test_a_seed_is_the_same_episode_in_a_batch_of_any_size(package: Path) -> None:
    batch = gymnasium.make_vec("fastrod/Aim-v0", num_envs=3, threads=1)
    observation, _ = batch.reset(seed=5)
    again, _ = BatchEnv("Aim", 3, threads=1).reset(seed=5)
    assert_array_equal(observation, again)
    env = gymnasium.make("fastrod/Aim-v0", threads=1)
    for i in range(3):
        alone, _ = env.reset(seed=5 + i)
        assert_array_equal(alone, observation[i])
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (4, 3, 2))
    env.reset(seed=7)
    for action in actions:
        rows, reward, *_ = batch.step(action)
        row, own, *_ = env.step(action[2])
        assert_array_equal(row, rows[2])
        assert own == reward[2]
    assert not np.array_equal(batch.reset(seed=6)[0], observation)


def test_a_baseline_by_the_angular_jacobian_succeeds(package: Path) -> None:
    trials = evaluate("Aim", None, episodes=8).trials
    assert trials["baseline"].success.all()
    assert not trials["still"].success.any()


def test_bad_input_of_an_own_task_is_refused_as_any(package: Path) -> None:
    batch = BatchEnv("Aim", 2, threads=1)
    batch.reset(seed=0)
    with pytest.raises(InputError, match=r"actions have shape \(2, 3\); they must be \(2, 2\)"):
        batch.step(np.zeros((2, 3)))
    with pytest.raises(InputError, match="the action of environment 0 is not finite"):
        batch.step(np.full((2, 2), np.nan))
    with pytest.raises(InputError, match="no option 'stepz'"):
        BatchEnv("Aim", 2, stepz=3)
    with pytest.raises(UnknownNameError, match="no environment 'Aimm'; did you mean 'Aim'"):
        BatchEnv("Aimm")


def test_a_class_needs_no_registration(package: Path) -> None:
    fields = {"name": "Closer", "accuracy": 0.001, "__doc__": "."}
    kind = type("Closer", (registration.task_class("Aim"),), fields)
    batch = BatchEnv(kind, 2, threads=1)
    observation, _ = batch.reset(seed=3)
    assert_array_equal(observation, BatchEnv("Aim", 2, threads=1).reset(seed=3)[0])
    assert batch.task.accuracy == 0.001
    assert "Closer" not in fastrod_envs.names()
    # registered again, it is replaced
    assert fastrod_envs.register(kind) is fastrod_envs.register(kind) is kind
    assert gymnasium.make("fastrod/Closer-v0", threads=1).unwrapped.task.accuracy == 0.001
    fastrod_envs.unregister("Closer")
    assert "fastrod/Closer-v0" not in gymnasium.registry


def variant(**given: Any) -> Any:
    return type("Other", (registration.task_class("Aim"),), {"name": "Other", **given})


GIVE = "give a name, or a class derived from fastrod_envs.task.Task."
NO_TASKS = {
    f"the task is 3; {GIVE}": lambda: 3,
    f"the task is <class 'int'>; {GIVE}": lambda: int,
    "a task named 'Reach' is already registered, fastrod_envs.tasks.reach:Reach": lambda: variant(
        name="Reach"
    ),
    "Other.name is 'my task'; it must be one word": lambda: variant(name="my task"),
    "Other has n_steps 0 and n_draws 2; an episode has at least one step": lambda: variant(n_steps=0),
    "Other.n_draws is 'two'; it must be of type int.": lambda: variant(n_draws="two"),
    "task RodTask is not complete; it lacks backdrop, baseline, begin": lambda: registration.task_class(
        "Aim"
    ).__mro__[1],
}


@pytest.mark.parametrize("sentence", NO_TASKS)
def test_what_is_no_task_is_refused_in_a_sentence(package: Path, sentence: str) -> None:
    before = fastrod_envs.names()
    with pytest.raises(InputError, match=re.escape(sentence)) as caught:
        fastrod_envs.register(NO_TASKS[sentence]())
    assert "\n" not in str(caught.value)
    assert fastrod_envs.names() == before


def test_a_package_that_cannot_be_imported_takes_nothing_else_away(tmp_path, monkeypatch):
    install(tmp_path, "broken", "raise ValueError('no such camera')\n", "mine")
    monkeypatch.syspath_prepend(str(tmp_path))
    registration.load_plug_ins.cache_clear()
    sentence = r"the tasks of 'broken' are missing: ValueError\('no such camera'\)"
    with pytest.warns(UserWarning, match=sentence):
        registration.load_plug_ins()
    assert "Reach" in fastrod_envs.names()


# Reach with another robot


@pytest.mark.parametrize("name", ["prototype", "tdcr_a", "five_segment_reacher"])
def test_reach_takes_a_robot_file(name: str, tmp_path: Path) -> None:
    robot = replace(fastrod.load_robot(name), base_position=(0.1, -0.2, 0.3))
    fastrod.save_robot(robot, tmp_path / "mine.toml")
    batch = BatchEnv("Reach", 8, threads=1, robot=str(tmp_path / "mine.toml"))
    observation, _ = batch.reset(seed=0)
    assert_array_equal(BatchEnv("Reach", 8, threads=1, robot=robot).reset(seed=0)[0], observation)
    assert batch.task.n_actions == sum(2 + (s.extension[0] < s.extension[1]) for s in robot.segments)
    assert batch.task.accuracy == pytest.approx(0.02 * robot.length)
    for _ in range(40):
        observation, reward, _, truncated, info = batch.step(batch.baseline())
        assert batch.observation_space.contains(observation)
        assert np.isfinite(reward).all()
    assert truncated.all()
    assert info["final_info"]["success"].all()
    assert info["final_info"]["reward_terms"].keys() >= {"reach"}
    assert "height" not in info["final_info"]["reward_terms"]


@pytest.mark.study
def test_reach_with_a_robot_file_is_a_gymnasium_environment(tmp_path: Path) -> None:
    robot = replace(fastrod.load_robot("tdcr_b"), effects=({"name": "backlash", "half_width": 1e-4},))
    fastrod.save_robot(robot, tmp_path / "mine.toml")
    given = {"robot": tmp_path / "mine.toml", "threads": 1}
    env = gymnasium.make("fastrod/Reach-v0", reward="precise", **given)
    check_env(env.unwrapped, skip_render_check=True)
    picture = gymnasium.make("fastrod/Reach-v0", render_mode="rgb_array", **given)
    picture.reset(seed=0)
    assert np.ptp(picture.render()) > 0
    easiest = {tuple(env.reset(seed=s, options={"difficulty": 0.0})[0][:3]) for s in range(4)}
    assert len(easiest) == 1
    assert len({tuple(env.reset(seed=s, options={"difficulty": 1.0})[0][:3]) for s in range(4)}) == 4


def test_reach_drives_the_segments_that_are_not_passive(tmp_path: Path) -> None:
    fastrod.save_robot(behind_a_passive_one(fastrod.load_robot("prototype")), tmp_path / "catheter.toml")
    assert BatchEnv("Reach", 2, robot=tmp_path / "catheter.toml").task.driven.tolist() == [4, 5]


@pytest.mark.parametrize(
    ("robot", "sentence"),
    [
        ("ethz_beam", "robot 'ethz_beam' does not suit Reach: segment 1 of robot 'ethz_beam' is passive; "),
        ("prototyp", "did you mean 'prototype'"),
        (3, "robot is 3; give a robot file, a shipped robot's name, or None."),
    ],
)
def test_a_robot_that_does_not_suit_is_refused_in_a_sentence(robot: Any, sentence: str) -> None:
    with pytest.raises(fastrod.errors.FastrodError, match=re.escape(sentence)) as caught:
        gymnasium.make("fastrod/Reach-v0", robot=robot)
    assert "\n" not in str(caught.value)


def test_no_other_task_takes_a_robot() -> None:
    with pytest.raises(InputError, match="no option 'robot'"):
        BatchEnv("ReachObstacle", 1, robot="prototype")


def test_a_task_in_a_file_is_known_by_its_path(tmp_path: Path) -> None:
    """To the commands and to a batch, and by its id afterwards; what cannot be run is one sentence."""
    file = tmp_path / "aiming.py"
    file.write_text(AIM.replace("Aim", "Aiming"))
    try:
        batch = BatchEnv(f"{file}:Aiming", 2)
        assert batch.reset(seed=0)[0].shape[0] == 2
        assert BatchEnv("fastrod/Aiming-v0").task.name == "Aiming"
        with pytest.raises(UnknownNameError, match=r"no task 'Aimin' in .*did you mean 'Aiming'"):
            registration.name_of(f"{file}:Aimin")
    finally:
        registration.unregister("Aiming")
    with pytest.raises(InputError, match=r"task file '.*none.py' cannot be read"):
        registration.name_of(f"{tmp_path / 'none.py'}:Aim")
    (tmp_path / "broken.py").write_text("1 / 0")
    with pytest.raises(InputError, match=r"cannot be run: ZeroDivisionError"):
        registration.name_of(f"{tmp_path / 'broken.py'}:Aim")
