"""Findings of the fuzz tests, each once: odd files, paths and inputs that now are a result or one
sentence."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from rods import rod

from fastrod import Simulator
from fastrod.contact import ContactScene, sphere
from fastrod.effects.base import Parameter, Seam, Static, effect, unregister
from fastrod.errors import EffectError, InputError, LogError, RobotError, shown
from fastrod.logs.reader import read_log
from fastrod.logs.recording import recover
from fastrod.model.robotfile import dumps, load_robot, save_robot
from fastrod.solver.merge import merge_rows


def test_a_robot_that_cannot_be_written_leaves_no_file(tmp_path: Path) -> None:
    robot = load_robot("prototype")
    with pytest.raises(RobotError, match=r"cannot be written: embedded null byte\."):
        save_robot(robot, tmp_path / "a\0.toml")
    with pytest.raises(RobotError, match=r"cannot be written: .*surrogates not allowed"):
        save_robot(replace(robot, name="a\ud800"), tmp_path / "a.toml")
    assert not list(tmp_path.iterdir())


def test_a_robot_file_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(dumps(load_robot("prototype")), encoding="utf-8-sig")
    assert load_robot(path) == load_robot("prototype")


def test_an_effect_without_bounds_still_needs_a_number_that_is_finite() -> None:
    @effect
    class Boundless(Static):
        """Nothing.

        Equation: none
        Source: none
        Residual signature: none
        """

        seam = Seam.LOAD
        parameters = (Parameter("size", "N"),)

        def apply(self, values: Any, memory: Any, ports: Any, state: Any, dt: float) -> None:
            """Nothing."""

    try:
        for value in (np.inf, 10**400, "x"):
            with pytest.raises(
                EffectError, match=r"size of effect 'boundless' is .* N; it must be a number from"
            ) as caught:
                Simulator(replace(rod(), effects=({"name": "boundless", "size": value},)))
            assert len(str(caught.value)) < 400
    finally:
        unregister("boundless")


def test_a_passive_robot_takes_its_own_rest_lengths() -> None:
    """There are none."""
    assert Simulator(rod("passive")).settle(rod("passive").rest_tendon_length).ok.all()


def pair(**given: Any) -> tuple[Simulator, Simulator, np.ndarray]:
    """Two simulators that have settled, and lengths."""
    robot = rod(extension=(-0.005, 0.02))
    one, other = (Simulator(robot, 3, points_per_segment=5, **given) for _ in range(2))
    pull = np.outer([1.0, 2.0, -1.0], [0.001, 0.0, -0.001, 0.0])
    return one, other, robot.rest_tendon_length + pull


@pytest.mark.parametrize("name", ["tip_force", "extension", "base_pose", "tip_moment", "line_force"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
@pytest.mark.parametrize("cold", [True, False])
def test_a_bad_row_changes_no_bit_of_its_neighbours(name: str, value: float, cold: bool) -> None:
    sim, twin, lengths = pair()
    others = {"extension": np.zeros((3, 1)), "base_pose": np.tile([0.0, 0, 0, 1, 0, 0, 0], (3, 1))}
    usual = others.get(name, np.zeros((3, 3)))
    bad = usual.copy()
    bad[1, -1] = value
    if not cold:
        for one in (sim, twin):
            one.settle(lengths, **{name: usual})
    for given in (bad, bad, usual):
        state, wanted = sim.step(lengths, **{name: given}), twin.step(lengths, **{name: usual})
        assert_array_equal(state.position[[0, 2]], wanted.position[[0, 2]])
        assert_array_equal(state.residual[[0, 2]], wanted.residual[[0, 2]])
        assert state.ok[1] == (given is usual)
        assert all("\n" not in sentence for sentence in state.problems.values())


def test_no_point_forces_are_none() -> None:
    sim, _, lengths = pair()
    assert sim.step(lengths, point_force={}).ok.all()


def test_a_refused_step_leaves_the_obstacles_where_they_were() -> None:
    scene = ContactScene(obstacles=[sphere(0.01, name="ball")])
    sim, twin, lengths = pair(contact=scene, feel_contact=False)
    for one in (sim, twin):
        one.settle(lengths)
    moved = {"ball": (0.0, 0.0, -0.02, 1.0, 0.0, 0.0, 0.0)}
    for call in (sim.step, sim.settle):
        with pytest.raises(InputError, match="tip_force has shape"):
            call(lengths, tip_force=np.zeros(5), obstacle_pose=moved)
    for one in (sim, twin):
        one.step(lengths)
    assert_array_equal(sim.clearance("ball"), twin.clearance("ball"))
    assert_array_equal(sim.swept_clearance(), twin.swept_clearance())


def test_rows_of_no_robot() -> None:
    sim, _, lengths = pair()
    sim.settle(lengths)
    bad: list[Any] = [[0.5], [[0, 1]], True, [True, False], "x", 2**63, 10**30, [[0], [1, 2]], {"a": 1}, 3]
    for rows in bad:
        with pytest.raises(InputError, match=r"rows is .*; give indices of robots from 0 to 2, or a mask\."):
            sim.reset(rows)
    sim.reset([])
    assert sim.step(lengths).ok.all()


def test_merged_rows_keep_the_order_that_kernels_are_compiled_for() -> None:
    """Another order of axes is another type to numba: a first call would wait for its compilation."""
    now, then = np.zeros((1, 2, 3, 4)), np.ones((3, 2, 3, 4))
    merged = merge_rows(now, then, np.array([True, False, False]))
    assert merged.flags.c_contiguous
    assert_array_equal(merged[:, 0, 0, 0], [1.0, 0.0, 0.0])


def test_a_part_without_a_recorders_columns_is_no_recording(tmp_path: Path) -> None:
    part = tmp_path / "session.csv.part"
    part.write_text("t,run,tip_x,tip_y,tip_z\n0.0,,0,0,0.07\n")
    with pytest.raises(LogError, match=r"session.csv.part is no recording: it lacks column tip_qw"):
        recover(part)
    assert part.exists()


@pytest.mark.parametrize("kind", ["list", "span", "bytes", "struct"])
def test_a_parquet_column_of_something_else(tmp_path: Path, kind: str) -> None:
    why = "pyarrow is not installed: pip install 'fastrod[parquet]'"
    arrow, parquet = (pytest.importorskip(name, reason=why) for name in ("pyarrow", "pyarrow.parquet"))
    cells = {
        "list": arrow.array([[1.0, 2.0]]),
        "span": arrow.array([5], arrow.duration("s")),
        "bytes": arrow.array([b"\xff"]),
        "struct": arrow.array([{"a": 1}]),
    }[kind]
    names = ("t", "dl_1", "dl_2", "dl_3", "dl_4", "tip_x", "tip_y", "tip_z")
    table = {name: arrow.array([0.0]) for name in names}
    parquet.write_table(arrow.table(table | {"note": cells}), tmp_path / "log.parquet")
    assert len(read_log(tmp_path / "log.parquet", load_robot("prototype")).extra["note"]) == 1
    parquet.write_table(arrow.table(table | {"tip_y": cells}), tmp_path / "log.parquet")
    with pytest.raises(LogError, match=r"log.parquet row 1, column tip_y is .*; it must be a number"):
        read_log(tmp_path / "log.parquet", load_robot("prototype"))


def test_what_is_shown_is_short() -> None:
    assert shown([1, 2]) == "[1, 2]"
    assert len(shown("x" * 10_000)) == 200
