"""Replay: physics of the inputs, frames, the figures, the files; and the log that the demo ships."""

from __future__ import annotations

import csv
import math
from dataclasses import replace as changed
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from truth import plant

from fastrod.errors import LogError
from fastrod.identification.log.inputs import inputs, tendon_length
from fastrod.identification.log.replay import Replay, replay
from fastrod.identification.log.replay_output import DENSE, draw, table, write
from fastrod.logs.reader import read_log
from fastrod.logs.runlog import RunLog, write_log
from fastrod.model.robot import Robot
from fastrod.model.robotfile import load_robot

DEMO_LOG = Path(__file__).parents[1] / "fastrod" / "data" / "demo_log.csv"
DEMO_COMMENT = """\
A prototype moved by `fastrod excite`, simulated by another solver with an effect that this file does not \
name, and 0.3 mm of noise.
Written by tests/truth/plant.py, seed 2026."""
DEMO_SEED = 2026
UPSIDE_DOWN = (0.0, 1.0, 0.0, 0.0)


def shipped_log() -> RunLog:
    """The log that the package ships: the designed run of the prototype, its tip by the plant, with friction
    sealed into it."""
    from fastrod.identification.excite import excitation

    log = excitation(load_robot("prototype")).log
    inputs = plant.Inputs(log.t, log.dl, log.payload, log.base_quaternion)
    tip = plant.measure(inputs, plant.draw(DEMO_SEED, "friction"), noise=3e-4)
    return changed(log, t=np.round(log.t, 4), dl=np.round(log.dl, 7), tip_position=np.round(tip, 6))


def other_robot() -> Robot:
    """A prototype that is a little different from the shipped one."""
    robot = load_robot("prototype")
    two = math.radians(2.0)
    tendons = tuple(changed(t, offset=0.0078, angle=float(t.angle) + two) for t in robot.tendons)
    return changed(robot, segments=(changed(robot.segments[0], length=0.0706, tendons=tendons),))


def log_of_the_other(n: int = 8) -> RunLog:
    """Return what shooting makes of `other_robot`: two runs along a spiral of bends, the second one under
    a load."""
    from fastrod.reference import shoot

    fraction = np.tile(np.arange(1, n + 1) / n, 2)
    bend, turn = 0.9 * np.sin(np.pi * fraction), 4.0 * np.pi * fraction
    nominal, real = load_robot("prototype"), other_robot()
    places = np.array([tendon.position(1)[0] for tendon in nominal.tendons])
    dl = -np.stack([bend * np.cos(turn), bend * np.sin(turn)], axis=1) @ places.T
    force = np.where(np.arange(2 * n)[:, None] < n, 0.0, (0.1, -0.05, 0.05))
    rest, pairs = real.rest_tendon_length, zip(dl, force, strict=True)
    tip = np.array([shoot(real, rest + d, tip_force=f).tip_position for d, f in pairs])
    run = np.repeat(["free", "loaded"], n)
    return RunLog(name="other", t=8.0 * fraction, run=run, dl=dl, tip_position=tip, tip_force=force)


class Arc:
    """A stand-in for the simulator: constant curvature, no loads; it remembers its inputs."""

    seen: dict[str, Any]
    refuse: tuple[int, ...] = ()

    def __init__(self, robot: Robot, n_robots: int) -> None:
        self.robot, self.n_robots = robot, n_robots

    def settle(self, **given: Any) -> SimpleNamespace:
        type(self).seen = given
        tip = np.zeros((self.n_robots, 3))
        tip[:, 2] = self.robot.length
        if "tendon_length" in given:
            places = np.array([tendon.position(1)[0] for tendon in self.robot.tendons])
            bend = -(given["tendon_length"] - self.robot.rest_tendon_length) @ np.linalg.pinv(places).T
            angle = np.linalg.norm(bend, axis=1)[:, None] + 1e-12
            aside = bend / angle * (1.0 - np.cos(angle)) / angle
            tip = self.robot.length * np.hstack([aside, np.sin(angle) / angle])
        ok = np.ones(self.n_robots, dtype=bool)
        ok[[row for row in self.refuse if row < self.n_robots]] = False
        return SimpleNamespace(tip_position=tip, ok=ok)


def small_log(n: int = 6, **more: Any) -> RunLog:
    dl = np.outer(np.linspace(-1.0, 1.0, n), (0.002, 0.0, -0.002, 0.0))
    t, run, tip = np.arange(n) / 10.0, np.repeat(["a", "b"], n // 2), np.tile((0.0, 0.0, 0.07), (n, 1))
    return RunLog(name="small", t=t, run=run, dl=dl, tip_position=tip, **more)


@pytest.fixture
def prototype() -> Robot:
    return load_robot("prototype")


def test_figures_follow_from_the_residual(prototype: Robot) -> None:
    log = small_log()
    exact = replay(log, prototype, simulator=Arc)
    measured = exact.tip_position + np.array([0.003, 0.0, -0.004])
    measured[0] += 0.003, 0.0, -0.004  # row 0 is off by twice as much
    result = replay(changed(log, tip_position=measured), prototype, simulator=Arc)
    assert_allclose(result.residual[1], [0.003, 0.0, -0.004], atol=1e-15)
    assert result.rms == pytest.approx(math.sqrt((4.0 + 5.0) / 6.0) * 0.005)
    assert result.max == pytest.approx(0.010)
    assert_allclose(result.axis_rms, math.sqrt(9.0 / 6.0) * np.array([0.003, 0.0, 0.004]), atol=1e-15)
    assert result.run_rms == pytest.approx({"a": math.sqrt(6.0 / 3.0) * 0.005, "b": 0.005})
    assert result.excursion_rms == pytest.approx(math.sqrt(np.var(measured, axis=0).sum()))
    straight = replay(small_log(), prototype, simulator=Arc)
    assert straight.baseline_rms == 0.0


def test_rows_that_miss_or_fail_are_left_out(prototype: Robot) -> None:
    log = small_log()
    tip, dl = log.tip_position.copy(), log.dl.copy()
    tip[1], dl[2] = np.nan, np.nan

    class Stubborn(Arc):
        refuse = (3,)  # of the driven rows: row 4 of the log

    result = replay(changed(log, tip_position=tip, dl=dl), prototype, simulator=Stubborn)
    assert np.flatnonzero(result.compared).tolist() == [0, 3, 5]
    assert np.isfinite(result.tip_position[1]).all()  # predicted, though nothing was measured
    assert np.isnan(result.tip_position[[2, 4]]).all()
    with pytest.raises(LogError, match="nothing to compare"):
        replay(changed(log, tip_position=np.full((6, 3), np.nan)), prototype, simulator=Arc)


def test_tendon_lengths_count_from_the_straight_rest_robot_whatever_the_extension() -> None:
    robot = load_robot("five_segment_reacher")
    more = {"tip_position": np.zeros((1, 3)), "ext": np.array([[0.0, 0.0, 0.0, 0.0, 0.02]])}
    log = RunLog(name="x", t=np.zeros(1), run=np.array([""]), dl=np.full((1, 15), -0.001), **more)
    assert_allclose(tendon_length(log, robot)[0] - robot.rest_tendon_length, -0.001)


def test_loads_turn_with_the_base_and_weight_does_not(prototype: Robot) -> None:
    q = np.tile(UPSIDE_DOWN, (6, 1))
    log = small_log(base_quaternion=q, tip_force=np.tile((0.1, 0.2, 0.3), (6, 1)), payload=np.full(6, 0.01))
    given = inputs(log, prototype)
    assert_allclose(given["base_pose"][0], (0.0, 0.0, 0.0, *UPSIDE_DOWN))
    assert_allclose(given["tip_force"][0], [0.1, -0.2, -0.3 - 0.0981], atol=1e-15)


def test_prediction_is_given_in_the_base_frame(prototype: Robot) -> None:
    class World(Arc):
        def settle(self, **given: Any) -> SimpleNamespace:
            state = super().settle(**given)
            # hung up at (1, 2, 3)
            state.tip_position = state.tip_position * (1.0, -1.0, -1.0) + (1.0, 2.0, 3.0)
            return state

    hung = changed(prototype, base_position=(1.0, 2.0, 3.0), base_quaternion=UPSIDE_DOWN)
    upright = replay(small_log(), prototype, simulator=Arc)
    assert_allclose(replay(small_log(), hung, simulator=World).tip_position, upright.tip_position, atol=1e-15)


def test_files_are_whole(prototype: Robot, tmp_path: Path) -> None:
    result, out = replay(small_log(), prototype, simulator=Arc), tmp_path / "deep" / "out"
    paths = write(result, out)
    assert sorted(out.iterdir()) == sorted(paths) == [out / "replay.png", out / "residuals.csv"]
    rows = list(csv.DictReader((out / "residuals.csv").read_text().splitlines()))
    assert len(rows) == 6
    norm = float(np.linalg.norm(result.residual[0]))
    assert float(rows[0]["residual_norm"]) == pytest.approx(norm, rel=1e-8)
    assert (rows[0]["run"], rows[0]["converged"]) == ("a", "1")


def axes_of(result: Replay) -> list[Any]:
    """The panels: x, y, z and distance over time, the two paths, the histogram."""
    figure = draw(result)
    figure.draw_without_rendering()
    return [axes for half in figure.subfigs for axes in half.axes]


def long_log(n: int) -> RunLog:
    """Rows at 10 Hz of a tip that swings 20 mm along x."""
    tip = np.stack([0.02 * np.sin(0.1 * np.arange(n)), np.zeros(n), np.full(n, 0.07)], axis=1)
    t, run = np.arange(n) / 10.0, np.full(n, "")
    return RunLog(name="long", t=t, run=run, dl=np.zeros((n, 4)), tip_position=tip)


def test_picture_leaves_out_what_was_not_measured(prototype: Robot) -> None:
    log = small_log(20)
    tip = log.tip_position.copy()
    tip[:6], tip[10:16] = np.nan, np.nan  # 4 rows are left of each run
    panels = axes_of(replay(changed(log, tip_position=tip), prototype, simulator=Arc))
    predicted, measured = panels[0].lines[:2]
    assert np.isfinite(predicted.get_ydata()).sum() == np.isfinite(measured.get_ydata()).sum() == 8
    assert_allclose(np.nanmax(predicted.get_xdata()), 0.6)  # two runs of 0.3 s, from 0
    assert [text.get_text().strip() for text in panels[0].texts] == ["a", "b"]


@pytest.mark.study
def test_picture_of_a_dense_log_shows_envelopes_and_points_of_both(prototype: Robot) -> None:
    result = replay(long_log(2 * DENSE + 1), prototype, simulator=Arc)
    panels = axes_of(result)
    assert [band.get_label() for band in panels[0].collections] == ["predicted", "measured"]
    low, high = panels[0].collections[1].get_datalim(panels[0].transData).intervaly
    assert_allclose([low, high], [-20.0, 20.0], atol=1e-3)
    points = panels[4].collections[0]
    assert len(points.get_offsets()) == 2 * math.ceil(len(result.log) / 3)
    assert len({tuple(colour) for colour in points.get_facecolors()}) == 2
    assert sum(bar.get_height() for bar in panels[6].patches) == len(result.log)


def test_progress_is_told(prototype: Robot) -> None:
    steps: list[tuple[int, ...]] = []
    replay(small_log(), prototype, simulator=Arc, progress=lambda *step: steps.append(step))
    assert steps == [(6, 6)]


def test_table_has_a_line_for_each_run_and_for_all(prototype: Robot) -> None:
    assert table(replay(small_log(), prototype, simulator=Arc)).row_count == 3


def test_table_shows_no_excursion_of_a_run_that_stands_still(prototype: Robot) -> None:
    tip = small_log().tip_position + np.array([0.0, 0.001, 0.0])
    still = changed(small_log(), dl=np.zeros((6, 4)), tip_position=tip)
    assert "excursion" not in draw(replay(still, prototype, simulator=Arc)).get_suptitle()
    moving = tip.copy()
    moving[3:, 0] += (-0.05, 0.0, 0.05)  # run b moves
    grid = table(replay(changed(still, tip_position=moving), prototype, simulator=Arc))
    assert next(iter(grid.columns[6].cells)) == "–"
    assert "measured - predicted" in str(grid.caption)
    assert "quasi-static" in str(grid.caption)


def test_shipped_log_is_what_the_plant_makes() -> None:
    made, shipped = shipped_log(), read_log(DEMO_LOG, load_robot("prototype"))
    assert shipped.runs == [""]
    assert_array_equal(made.t, shipped.t)
    assert_array_equal(made.dl, shipped.dl)
    assert_array_equal(made.payload, shipped.payload)
    assert_allclose(made.base_quaternion, shipped.base_quaternion, rtol=0, atol=1e-15)
    # rounded to 1 um, which may fall either way
    assert_allclose(made.tip_position, shipped.tip_position, rtol=0, atol=1.01e-6)


def test_shipped_log_does_not_say_what_is_in_it() -> None:
    head = [line for line in DEMO_LOG.read_text().splitlines() if line.startswith("#")]
    assert [line.removeprefix("# ") for line in head] == DEMO_COMMENT.splitlines()
    assert not any(name in " ".join(head) for name in plant.LIBRARY)


@pytest.mark.study
def test_right_model_leaves_nothing_and_the_nominal_one_its_difference() -> None:
    """A log by another solver: the robot that it was made on leaves the solvers' steps alone."""
    log = log_of_the_other()
    nominal = replay(log, load_robot("prototype"))
    assert nominal.converged.all()
    assert nominal.rms > 1e-3  # offset, routing and length that are off by 4 %, 2 deg and 1 %
    truth = replay(log, other_robot())  # the log's dl are against the rest length of either robot
    assert truth.max < 5e-6


@pytest.mark.parametrize("orientation", [(1.0, 0.0, 0.0, 0.0), UPSIDE_DOWN, (0.5, 0.5, 0.5, 0.5)])
def test_replay_of_the_simulators_own_run_leaves_nothing(
    prototype: Robot, orientation: tuple[float, ...]
) -> None:
    from fastrod import simulator

    rod = changed(prototype.segments[0], line_density=0.2)
    heavy = changed(prototype, segments=(rod,), base_position=(0.1, 0.2, 0.3), log_points=(0.02, 0.05))
    given = {"base_quaternion": np.tile(orientation, (8, 1)), "payload": np.full(8, 0.005)}
    log = small_log(8, **given, points=np.zeros((8, 2, 3)))
    first = replay(log, heavy)
    assert first.converged.all()
    assert first.points is not None
    again = replay(changed(log, tip_position=first.tip_position, points=first.points), heavy)
    assert again.rms == 0.0
    # hanging or standing, the upright and the hung robot differ only through weight
    one = simulator.Simulator(heavy, n_robots=1)
    pose = np.array([[0.0, 0.0, 0.0, *orientation]])
    weight = 0.005 * np.array([[0.0, 0.0, -9.81]])
    state = one.settle(heavy.rest_tendon_length + log.dl[:1], tip_force=weight, base_pose=pose)
    far = float(np.linalg.norm(first.tip_position[0]))
    assert np.linalg.norm(state.tip_position[0]) == pytest.approx(far, abs=1e-9)


def test_points_of_the_straight_robot_lie_on_its_axis(prototype: Robot) -> None:
    marked = changed(prototype, log_points=(0.02, 0.05))
    straight = changed(small_log(2, points=np.zeros((2, 2, 3))), dl=np.zeros((2, 4)))
    result = replay(straight, marked)
    assert result.points is not None
    assert_allclose(result.points[0], [[0.0, 0.0, 0.02], [0.0, 0.0, 0.05]], atol=1e-9)
    assert isinstance(result, Replay)


if __name__ == "__main__":
    write_log(shipped_log(), DEMO_LOG, comment=DEMO_COMMENT)
