"""Any bytes at all as a robot file: a robot that works, or one sentence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fuzz.strategies import broken_texts, good_tables, mutated_tables, one_sentence, tried, written
from hypothesis import given
from hypothesis import strategies as st

from fastrod import Robot, Simulator
from fastrod.errors import FastrodError
from fastrod.model.robotfile import dumps, load_robot, save_robot


def loaded(path: Path) -> Robot | None:
    """The robot of a file, or None where it was refused in one sentence that names the file."""
    try:
        return load_robot(path)
    except FastrodError as error:
        one_sentence(error, path.name)
        return None


def simulated(robot: Robot, path: Path) -> None:
    """Settle a robot at rest, and step it: finite where ok, a reason where not; no other error."""
    modes = {segment.mode for segment in robot.segments}
    inputs: dict[str, Any] = {"tendon_length": robot.rest_tendon_length}
    if "tendon_tension" in modes:
        inputs["tension"] = np.full(robot.n_tendons, 0.1)
    try:
        sim = Simulator(robot, points_per_segment=4)
        states = [sim.settle(**inputs), sim.step(**inputs)]
        measured = sim.measure()
    except FastrodError as error:
        one_sentence(error)
        return
    for state in states:
        for name in (
            "position",
            "rotation",
            "curvature",
            "moment",
            "force",
            "tip_position",
            "tension",
            "base_wrench",
            "residual",
        ):
            assert np.isfinite(getattr(state, name)[state.ok]).all(), name
        assert set(state.problems) == set(np.flatnonzero(~state.ok).tolist())
    if states[-1].ok.all():
        assert np.isfinite(measured.tip_position).all()


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("robots") / "odd robot.toml"


@tried(40)
@given(table=good_tables())
@pytest.mark.study
def test_a_good_robot_is_read_written_and_simulated(path: Path, table: dict[str, Any]) -> None:
    path.write_text(written(table), encoding="utf-8")
    robot = loaded(path)
    if robot is None:  # the tendons of a made-up robot may not fit its segments
        return
    save_robot(robot, path)
    assert dumps(load_robot(path)) == dumps(robot)
    simulated(robot, path)


@pytest.mark.study
@tried(120)
@given(table=mutated_tables())
def test_a_changed_table_is_a_robot_or_a_sentence(path: Path, table: dict[str, Any]) -> None:
    path.write_text(written(table), encoding="utf-8")
    robot = loaded(path)
    if robot is None:
        return
    save_robot(robot, path)
    assert dumps(load_robot(path)) == dumps(robot)
    simulated(robot, path)


@tried(60)
@given(data=st.data())
def test_broken_bytes_are_a_robot_or_a_sentence(path: Path, data: st.DataObject) -> None:
    path.write_bytes(data.draw(broken_texts(written(data.draw(mutated_tables())))))
    robot = loaded(path)
    assert robot is None or robot.segments
    if robot is not None:
        simulated(robot, path)


@tried(30)
@given(raw=st.binary(max_size=200))
def test_random_bytes_are_a_sentence(path: Path, raw: bytes) -> None:
    path.write_bytes(raw)
    assert loaded(path) is None
