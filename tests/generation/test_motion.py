"""Rollouts of a rod that moves: reproducible, with the velocity of its tip, and refused without a mass."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as parquet
import pytest
from generation_folders import bits, moving

import fastrod
from fastrod.commands import cli
from fastrod.errors import InputError
from fastrod.generation import Plan, Trajectories, generate, read_plan
from fastrod.generation.tasks import columns_of
from fastrod.loading import with_line_density
from fastrod.model.robotfile import dumps

LIGHT = fastrod.load_robot("prototype")
HEAVY = with_line_density(LIGHT, 0.1)  # as the plans of `moving` have it
VELOCITY = ("tip_vx", "tip_vy", "tip_vz")


def made(plan: Plan) -> dict[str, np.ndarray]:
    return {column.name: np.asarray(column.values) for column in columns_of(plan, 0)}


def test_rows_of_a_moving_rod_are_those_of_at_rest_with_the_tips_velocity() -> None:
    table, at_rest = made(moving()), made(moving(dynamics=False))
    assert set(table) - set(at_rest) == set(VELOCITY)
    assert table["ok"].all()
    for name in ("episode", "step", "t", "tip_fx", *(f"dl_{k}" for k in range(1, 5))):
        np.testing.assert_array_equal(table[name], at_rest[name])
    assert np.abs(table["tip_x"] - at_rest["tip_x"]).max() > 1e-5  # inertia: it is elsewhere


def test_the_velocity_is_that_with_which_the_tip_moves() -> None:
    # rows at every step of the simulator: v dt is the tip's way to within the step's second order
    dt, length = 5e-4, 0.07
    table = made(moving(1, steps=80, dt=dt, force=0.02, bend=0.5))
    tip = np.stack([table[f"tip_{a}"] for a in "xyz"], axis=1)
    velocity = np.stack([table[name] for name in VELOCITY], axis=1)
    assert not velocity[0].any()  # it begins at rest
    central = (tip[2:] - tip[:-2]) / (2.0 * dt)
    assert np.abs(velocity).max() > 0.02 * length
    np.testing.assert_allclose(velocity[1:-1], central, atol=0.05 * np.abs(velocity).max())


def test_a_base_that_is_rotated_changes_nothing_in_the_base_frame() -> None:
    half = np.sqrt(0.5)
    level = replace(HEAVY, gravity=(0.0, 0.0, 0.0))
    tilted = replace(level, base_quaternion=(half, half, 0.0, 0.0), base_position=(0.1, 0.2, 0.3))
    one, other = (made(moving(1, robot=dumps(robot), force=0.02)) for robot in (level, tilted))
    for name in VELOCITY:
        np.testing.assert_allclose(one[name], other[name], atol=1e-7)


def test_a_row_is_that_of_small_steps_along_even_commands() -> None:
    plan = moving(1, steps=3, dt=0.004)
    table = made(plan)
    sim = fastrod.Simulator(HEAVY, 1, 1e-3, 8, threads=1, dynamics=True)
    dl = np.stack([table[f"dl_{k}"] for k in range(1, 5)], axis=1)
    rest = LIGHT.rest_tendon_length
    state = sim.settle(rest + dl[0])
    for row in (1, 2):
        for k in range(1, 5):
            state = sim.step(rest + dl[row - 1] + k / 4 * (dl[row] - dl[row - 1]))
        seen = [table[f"tip_{a}"][row] for a in "xyz"]
        np.testing.assert_allclose(seen, state.tip_position[0], atol=1e-9)
        np.testing.assert_allclose([table[name][row] for name in VELOCITY], state.velocity[0, -1], atol=1e-6)


def test_the_same_seed_makes_the_same_bits_and_the_files_say_that_it_moved(tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("one", "again", "other")]
    for folder, seed in zip(folders, (4, 4, 5), strict=True):
        generate(moving(seed=seed, effects=("backlash",)), folder, workers=1)
    assert bits(folders[0]) == bits(folders[1])
    assert bits(folders[0]) != bits(folders[2])
    plan = read_plan(folders[0])
    assert plan is not None
    assert isinstance(plan.work, Trajectories)
    assert plan.work.dynamics
    assert json.loads((folders[0] / "plan.json").read_text())["work"]["dynamics"] is True
    schema = parquet.read_schema(next((folders[0] / "shards").iterdir()))
    assert schema.metadata[b"fastrod_dynamics"] == b"true"
    assert schema.field("tip_vx").metadata[b"unit"] == b"m/s"


def test_the_command_gives_a_robot_its_mass(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = f"generate rollouts --robot prototype --dynamics --steps 4 --count 2 --workers 1 --out {tmp_path}"
    assert cli.main(line.split()) == 2
    said = capsys.readouterr().err
    assert said.strip() == (
        "segment 1 of 'prototype' has line_density 0 kg/m, and dynamics=True needs a mass; give it one, or a "
        "damping_time [s] to move without."
    )
    assert not list(tmp_path.iterdir())
    assert cli.main([*line.split(), "--line-density", "0.1"]) == 0
    table = parquet.read_table(tmp_path / "shards")
    assert table.num_rows == 8
    assert np.abs(table.column("tip_vx").to_numpy()).max() > 0.0


@pytest.mark.parametrize("words", ["--dynamics", "--line-density 0.1"])
def test_an_environment_takes_none_of_it(
    words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = f"generate rollouts --env Reach --count 1 --out {tmp_path / 'out'} {words}"
    assert cli.main(line.split()) == 2
    assert f"{words.split()[0]} is of a robot's own motion" in capsys.readouterr().err


@pytest.mark.parametrize("given", [1, "yes", None])
def test_dynamics_is_true_or_false(given: object) -> None:
    with pytest.raises(InputError, match=r"dynamics is .*; it must be True or False"):
        moving(dynamics=given)
