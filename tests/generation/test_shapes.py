"""Shapes of a data set: at rest, in balance, evenly drawn, and the same whoever makes them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import kstest

import fastrod
from fastrod.generation import Plan, Shapes
from fastrod.generation.shapes import LONGEST_CHAIN, STEP_ANGLE, ChainSolver, Draw
from fastrod.generation.tasks import columns_of
from fastrod.model.robot import Robot
from fastrod.model.robotfile import dumps
from fastrod.model.routing import route
from fastrod.solver.inputs import Inputs

DENSITY = 0.004  # kg/m


def heavy(name: str = "five_segment_reacher") -> Robot:
    robot = fastrod.load_robot(name)
    return replace(robot, segments=tuple(replace(s, line_density=DENSITY) for s in robot.segments))


def made(robot: Robot, count: int, shard: int = 0, seed: int = 0, **words: Any) -> dict[str, np.ndarray]:
    work = Shapes(robot=dumps(robot), **words)
    plan = Plan(work=work, count=(shard + 1) * count, shard_rows=count, seed=seed)
    return {column.name: np.asarray(column.values) for column in columns_of(plan, shard)}


def group(table: dict[str, np.ndarray], *names: str) -> np.ndarray:
    return np.stack([table[name] for name in names], axis=1).astype(float)


def tip(table: dict[str, np.ndarray]) -> np.ndarray:
    return group(table, "tip_x", "tip_y", "tip_z")


def inputs(table: dict[str, np.ndarray], robot: Robot) -> dict[str, np.ndarray]:
    """Inputs of `Simulator.settle`."""
    dl = group(table, *(f"dl_{k + 1}" for k in range(robot.n_tendons)))
    return {
        "tendon_length": robot.rest_tendon_length + dl,
        "extension": group(table, *(f"ext_{k + 1}" for k in range(robot.n_segments))),
        "tip_force": group(table, "tip_fx", "tip_fy", "tip_fz"),
    }


@pytest.mark.parametrize("name", ["five_segment_reacher", "prototype", "tdcr_b", "prototype that stretches"])
def test_a_row_is_what_a_cold_simulator_finds(name: str) -> None:
    robot = heavy(name.split()[0])
    if "stretches" in name:
        robot = replace(robot, segments=(replace(robot.segments[0], axial_stiffness=40.0),))
    table = made(robot, 320, tolerance=1e-6)
    sim = fastrod.Simulator(robot, 320, points_per_segment=6)
    state = sim.settle(**inputs(table, robot), tolerance=1e-10)
    assert table["ok"].all()
    assert state.ok.all()
    assert (table["residual"] <= 1e-6).all()
    # the boundary is within the tolerance; the tip, further out, is by a few times that
    np.testing.assert_allclose(tip(table), state.tip_position, rtol=0.0, atol=5e-6)
    tension = group(table, *(f"tension_{k + 1}" for k in range(robot.n_tendons)))
    np.testing.assert_allclose(tension, state.tension, rtol=0.0, atol=1e-4 * np.abs(state.tension).max())


def test_six_steps_a_segment_are_within_the_tolerance_of_sixty() -> None:
    robot = heavy()
    table = made(robot, 128)
    sim = fastrod.Simulator(robot, 128, points_per_segment=60, outputs="tip")
    state = sim.settle(**inputs(table, robot), tolerance=1e-10)
    error = np.linalg.norm(tip(table) - state.tip_position, axis=1)
    assert np.median(error) < 1e-6
    assert error.max() < 5e-6


def test_the_base_bears_tip_force_and_weight() -> None:
    robot = heavy()
    table = made(robot, 192)
    # a segment that grows keeps its mass per length
    length = robot.length + table["ext_5"]
    weight = DENSITY * length[:, None] * np.array(robot.gravity)
    expected = group(table, "tip_fx", "tip_fy", "tip_fz") + weight
    np.testing.assert_allclose(group(table, "base_fx", "base_fy", "base_fz"), expected, atol=1e-8)


def test_the_last_point_is_the_tip_and_frames_are_the_bases() -> None:
    plain = heavy("prototype")
    # about gravity
    quarter = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    rotated = replace(plain, base_position=(0.3, -0.2, 0.1), base_quaternion=quarter)
    one, other = (made(robot, 64, points=3) for robot in (plain, rotated))
    np.testing.assert_allclose(group(one, "p3_x", "p3_y", "p3_z"), tip(one), atol=1e-8)
    for name, values in one.items():
        np.testing.assert_allclose(other[name], values, atol=2e-6, err_msg=name)


@pytest.mark.parametrize("step", [0, 1, 29, 63])
def test_every_step_of_a_chain_is_drawn_evenly(step: int) -> None:
    robot = fastrod.load_robot("five_segment_reacher")
    work = Shapes(robot=dumps(robot), bend=1.2, force=0.03)
    drawn = Draw(work, robot, 5000, np.random.default_rng(11)).at(step)
    dl = drawn.dl - np.cumsum(drawn.extension, axis=1)[:, robot.tendon_segment]
    bend = route(robot).bend(dl)
    for k in range(robot.n_segments):
        # in a disc the square of the radius is even, and so is the angle
        assert kstest((np.linalg.norm(bend[:, k], axis=1) / 1.2) ** 2, "uniform").pvalue > 1e-3
        assert kstest(np.arctan2(bend[:, k, 1], bend[:, k, 0]) / (2.0 * np.pi) + 0.5, "uniform").pvalue > 1e-3
    assert kstest(drawn.extension[:, 4] / 0.05, "uniform").pvalue > 1e-3
    # in a ball the cube of the radius is even, and by Archimedes the cosine of every angle
    radius = np.linalg.norm(drawn.force, axis=1)
    assert kstest((radius / 0.03) ** 3, "uniform").pvalue > 1e-3
    assert kstest(0.5 + 0.5 * drawn.force[:, 2] / radius, "uniform").pvalue > 1e-3
    # and none is tied to another
    inputs = np.column_stack([bend.reshape(5000, -1), drawn.extension[:, 4], drawn.force])
    correlation = np.corrcoef(inputs.T) - np.eye(inputs.shape[1])
    assert np.abs(correlation).max() < 5.0 / np.sqrt(5000)


def test_neighbours_are_near_and_chains_are_numbered() -> None:
    robot = fastrod.load_robot("prototype")
    work = Shapes(robot=dumps(robot))
    draw = Draw(work, robot, 50, np.random.default_rng(2))
    one, other = (route(robot).bend(draw.at(step).dl) for step in (7, 8))
    assert np.linalg.norm(one - other, axis=-1).max() <= 2.0 * np.sin(0.5 * STEP_ANGLE) + 1e-12
    assert 2.0 * np.pi > LONGEST_CHAIN * STEP_ANGLE
    chains = [made(robot, 128, shard)["chain"] for shard in (0, 1)]
    assert all(np.unique(chain, return_counts=True)[1].tolist() == [64, 64] for chain in chains)
    assert not set(chains[0]) & set(chains[1])


def test_a_shard_is_a_pure_function_of_plan_and_number() -> None:
    robot = heavy("prototype")
    one, again, next_, seeded = (made(robot, 100, **given) for given in ({}, {}, {"shard": 1}, {"seed": 1}))
    for name, values in one.items():
        np.testing.assert_array_equal(again[name], values)
    assert one["row"].tolist() == list(range(100))
    assert next_["row"].tolist() == list(range(100, 200))
    assert not set(one["tip_x"]) & set(next_["tip_x"])
    assert not set(one["tip_x"]) & set(seeded["tip_x"])


def test_rows_of_their_own_are_settled_cold() -> None:
    robot = heavy("prototype")
    table = made(robot, 40, chain=1)
    state = fastrod.Simulator(robot, 40, points_per_segment=6).settle(**inputs(table, robot), tolerance=1e-6)
    assert len(set(table["chain"])) == 40
    np.testing.assert_allclose(tip(table), state.tip_position, rtol=0.0, atol=5e-6)


def test_a_row_that_does_not_converge_is_kept_and_marked(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = heavy("prototype")
    good = made(robot, 64)
    whole = ChainSolver.settle

    def lame(self: ChainSolver, given: Inputs, tolerance: float) -> Any:
        settled = whole(self, given, tolerance)
        return settled._replace(ok=settled.ok & (np.asarray(given.tip_force)[:, 2] > 0.0))

    monkeypatch.setattr(ChainSolver, "settle", lame)
    table = made(robot, 64)
    lost = table["tip_fz"] <= 0.0
    assert 0 < lost.sum() < 64
    np.testing.assert_array_equal(table["ok"], ~lost)
    np.testing.assert_array_equal(table["row"], np.arange(64))
    assert np.isnan(group(table, "tip_x", "tip_qw", "tension_1", "base_fx")[lost]).all()
    np.testing.assert_array_equal(table["tip_x"][~lost], good["tip_x"][~lost])
    np.testing.assert_array_equal(table["dl_1"], good["dl_1"])


def test_chains_that_loads_tear_apart_are_settled_all_the_same() -> None:
    robot = heavy("prototype")
    table = made(robot, 256, force=4.0)  # F l^2/EI of nine: extrapolation fails now and then
    assert table["ok"].mean() > 0.95
    assert (table["residual"][table["ok"]] <= 1e-6).all()
