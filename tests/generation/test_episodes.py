"""Rollouts, trajectories and sweeps: rows that anybody can make again from what they say."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fastrod
from fastrod.commands import cli
from fastrod.effects.base import get_effect
from fastrod.errors import InputError
from fastrod.generation import Plan, Rollouts, Sweep, Trajectories, read_plan
from fastrod.generation.draws import in_ball, with_effects
from fastrod.generation.plan import Kind
from fastrod.generation.tasks import columns_of
from fastrod.model.robotfile import dumps
from fastrod.model.routing import route
from fastrod_envs.randomisation import Randomisation
from fastrod_envs.vector import BatchEnv

ROBOT, REACHER = fastrod.load_robot("prototype"), fastrod.load_robot("five_segment_reacher")
PLAIN = dumps(ROBOT)


def made(work: Kind, count: int) -> dict[str, np.ndarray]:
    columns = columns_of(Plan(work=work, count=count, shard_rows=count), 0)
    return {column.name: np.asarray(column.values) for column in columns}


def group(table: dict[str, np.ndarray], prefix: str) -> np.ndarray:
    names = [name for name in table if name.removeprefix(f"{prefix}_").isdigit()]
    return np.stack([table[name] for name in names], axis=1)


@pytest.fixture
def no_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    """An identification that tells nothing."""

    def nothing(*_: Any, **__: Any) -> None:
        raise InputError("the log tells nothing.")

    monkeypatch.setattr("fastrod.identification.attribution.identify", nothing)


@pytest.mark.parametrize("policy", ["random", "baseline", "shipped"])
def test_an_episode_is_played_again_from_its_seed(policy: str) -> None:
    table = made(Rollouts(env="Reach", policy=policy, options=(("n_steps", 6),)), 3)
    observed, acted = group(table, "obs"), group(table, "action")
    for episode in range(3):
        rows = np.flatnonzero(table["episode"] == episode)
        assert table["step"][rows].tolist() == list(range(len(rows)))
        env = BatchEnv("Reach", num_envs=1, n_steps=6)
        observation, _ = env.reset(seed=int(table["seed"][rows[0]]))
        for row in rows[:-1]:
            np.testing.assert_array_equal(observed[row], observation[0])
            observation, reward, terminated, truncated, info = env.step(acted[row : row + 1])
            assert table["reward"][row] == reward[0]
            assert table["distance"][row] == info["distance"][0]
            assert (table["terminated"][row], table["truncated"][row]) == (terminated[0], truncated[0])
        assert table["terminated"][rows[-2]] or table["truncated"][rows[-2]]
        np.testing.assert_array_equal(observed[rows[-1]], info["final_obs"][0])
        assert np.isnan(acted[rows[-1]]).all()
        assert np.isnan(table["reward"][rows[-1]])
    assert len(set(table["seed"])) == 3
    assert table["seed"].min() >= 0
    assert table["seed"].max() > 2**40  # 32 bits would hold doubles from some ten thousand episodes on


@pytest.mark.study(beyond=2)
@pytest.mark.parametrize(
    "work",
    [
        Rollouts(env="Reach", options=(("n_steps", 3),)),
        Trajectories(robot=PLAIN, effects=("backlash",), steps=3, force=0.01),
        Sweep(robot=PLAIN, rate=1.0),
    ],
    ids=lambda work: type(work).__name__,
)
@pytest.mark.usefixtures("no_verdict")
def test_a_row_does_not_hang_on_the_count(work: Kind) -> None:
    few, many = (columns_of(Plan(work=work, count=count, shard_rows=3), 0) for count in (1, 3))
    assert set(np.asarray(few[0].values)) == {0}
    for one, other in zip(few, many, strict=True):
        assert len(one.values) < len(other.values)
        np.testing.assert_array_equal(np.asarray(one.values), np.asarray(other.values)[: len(one.values)])


def test_a_robots_own_motion_keeps_its_limits() -> None:
    robot = REACHER
    work = Trajectories(robot=dumps(robot), steps=120, dt=0.05, bend=0.7, speed=0.8, force=0.01)
    table = made(work, 6)
    ext = group(table, "ext").reshape(6, 120, 5)
    dl = group(table, "dl") - np.cumsum(group(table, "ext"), axis=1)[:, robot.tendon_segment]
    bend = route(robot).bend(dl).reshape(6, 120, 5, 2)
    assert np.linalg.norm(bend, axis=-1).max() <= 0.7 + 1e-9
    assert np.linalg.norm(np.diff(bend, axis=1), axis=-1).max() <= 0.8 * 0.05 + 1e-9
    assert np.linalg.norm(np.diff(bend, axis=1), axis=-1).max() > 0.9 * 0.8 * 0.05
    assert ext.min() >= 0.0
    assert ext.max() <= 0.05
    assert np.ptp(ext[..., 4], axis=1).min() > 0.0
    force = np.stack([table[name] for name in ("tip_fx", "tip_fy", "tip_fz")], axis=1).reshape(6, 120, 3)
    assert (force == force[:, :1]).all()
    assert 0.0 < np.linalg.norm(force, axis=2).max() <= 0.01
    assert table["ok"].all()
    np.testing.assert_allclose(table["t"], 0.05 * table["step"])


def test_the_measured_tip_is_that_of_the_stated_effects() -> None:
    table = made(Trajectories(robot=PLAIN, effects=("backlash", "gravity"), steps=40), 3)
    for episode in range(3):
        rows = table["episode"] == episode
        effects: dict[str, dict[str, Any]] = {}
        for name in (name for name in table if "." in name):
            effect, _, parameter = name.partition(".")
            value, table_of = float(table[name][rows][0]), effects.setdefault(effect, {"name": effect})
            kind, _, number = parameter.rpartition("_")
            if number.isdigit():  # one per drive
                table_of.setdefault(kind, []).append(value)
            else:
                table_of[parameter] = value
        robot = fastrod.Robot(name="one", segments=ROBOT.segments, effects=tuple(effects.values()))
        sim = fastrod.Simulator(robot, 1, dt=0.02, points_per_segment=8, threads=1)
        for step, dl in enumerate(group(table, "dl")[rows]):
            (sim.step if step else sim.settle)(ROBOT.rest_tendon_length + dl)
            seen = sim.measure().tip_position[0]
            np.testing.assert_allclose([table[f"tip_{a}"][rows][step] for a in "xyz"], seen, atol=1e-9)


def test_values_of_effects_are_of_their_typical_size() -> None:
    rng = np.random.default_rng(5)
    drawn = [with_effects(ROBOT, ["backlash", "frame_misalignment"], rng) for _ in range(50)]
    for made_robot, info in drawn:
        assert [table["name"] for table in made_robot.effects] == ["backlash", "frame_misalignment"]
        for name, value in info.items():
            effect, _, key = name.partition(".")
            kind = key.rstrip("_12")  # of a drive
            parameter = next(p.on(route(ROBOT)) for p in get_effect(effect).parameters if p.name == kind)
            assert parameter.bounds[0] <= value <= parameter.bounds[1]
            assert 0.49 * parameter.scale <= abs(value) <= 1.51 * parameter.scale
    assert len({info["backlash.half_width"] for _, info in drawn}) == 50
    ball = np.linalg.norm(in_ball(rng, 20000, 3), axis=1)
    assert np.mean(ball**3) == pytest.approx(0.5, abs=0.01)


@pytest.mark.study
def test_a_sweep_names_what_it_sealed() -> None:
    table = made(Sweep(robot=PLAIN, effects=("backlash",), rate=4.0), 1)
    sealed, found = json.loads(table["sealed"][0]), json.loads(table["found"][0])
    assert table["problem"][0] == ""
    assert table["named"][0].split()[0] == "backlash"
    assert table["first"][0]
    assert found["backlash.half_width"] == pytest.approx(sealed["backlash.half_width"], rel=0.2)
    assert table["after"][0] < 0.7 * table["before"][0]
    assert table["floor"][0] == pytest.approx(3e-4 * np.sqrt(3.0), rel=0.3)


@pytest.mark.study
@pytest.mark.usefixtures("no_verdict")
def test_effects_alternate_and_a_log_without_a_verdict_is_kept() -> None:
    work = Sweep(robot=PLAIN, effects=("creep", "backlash"), rate=1.0)
    columns = columns_of(Plan(work=work, count=3), 0)
    table = {column.name: list(column.values) for column in columns}
    assert table["effect"] == ["backlash", "creep", "backlash"]
    assert table["problem"] == ["the log tells nothing."] * 3
    assert work.failed(columns) == 3
    assert len({json.dumps(sealed) for sealed in table["sealed"]}) == 3


def test_a_robot_file_named_by_an_option_is_in_the_plan(tmp_path: Path) -> None:
    mine, out = tmp_path / "mine.toml", tmp_path / "out"
    line = f"generate rollouts --env Reach --option randomise={mine} --option n_steps=3"
    line += f" --shard-rows 2 --out {out}"

    def write(half_width: float) -> None:
        worn = replace(REACHER, effects=({"name": "backlash", "half_width": half_width},))
        mine.write_text(dumps(worn))

    write(1e-4)
    assert cli.main(f"{line} --count 2 --workers 1".split()) == 0
    plan = read_plan(out)
    assert plan is not None
    assert str(mine) not in (out / "plan.json").read_text()
    before = columns_of(plan, 0)
    assert plan.work._given()["randomise"].effects[0]["half_width"] == 1e-4
    write(2e-4)
    for one, other in zip(before, columns_of(plan, 0), strict=True):
        np.testing.assert_array_equal(np.asarray(one.values), np.asarray(other.values))
    assert cli.main(f"{line} --count 4 --workers 1".split()) == 2
    mine.unlink()
    assert read_plan(out) == plan


def test_all_forms_of_a_robot_make_one_plan(tmp_path: Path) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text(dumps(REACHER))
    forms: list[Any] = [str(mine), mine, REACHER, dumps(REACHER)]
    whole = {"spread": 0.1, "bending_stiffness": (0.9, 1.1)}
    for each in (forms, [{"robot": form, **whole} for form in forms]):
        work = [Rollouts(env="Reach", options=(("randomise", form),)) for form in each]
        assert len({Plan(work=one, count=1).hash for one in work}) == 1
    given = Randomisation(robot=REACHER, spread=0.1, parameters={"bending_stiffness": (0.9, 1.1)})
    assert Rollouts(env="Reach", options=(("randomise", given),))._given()["randomise"]["robot"] == REACHER
