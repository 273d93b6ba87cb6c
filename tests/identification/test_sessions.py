"""Robots on another day, and drives that do not follow their commands."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from identification.logs import displacement_of, log_of, one_segment, one_sided, wave

from fastrod.commands.cli import main
from fastrod.errors import LogError
from fastrod.identification.attribution import identify
from fastrod.identification.log.replay import replay
from fastrod.identification.log.samples import sample
from fastrod.identification.report.report import write
from fastrod.identification.search.solve import Estimate
from fastrod.logs.drives import moved, sentences
from fastrod.logs.reader import read_log
from fastrod.logs.runlog import RunLog, write_log
from fastrod.model.robotfile import load_robot, save_robot

NOISE, N, DT = 1e-4, 240, 0.05
WORN = {"name": "backlash", "half_width": 4e-4}
ANOTHER_DAY: tuple[dict[str, Any], ...] = (
    {"name": "encoder_offset", "offset": [8e-4, -5e-4]},
    {"name": "frame_misalignment", "rotation_z": 0.04, "shift_x": 3e-3, "shift_y": -2e-3},
    {"name": "latency", "delay": 0.12},
)


def day(*effects: dict[str, Any], session: str, seed: int) -> RunLog:
    """Return what a worn robot does on a day."""
    robot = one_segment(effects=(WORN, *effects))
    log = log_of(robot, wave(robot, N, DT, seed=seed), DT, name=session, session=np.full(N, session))
    tip = replay(log, robot).tip_position + NOISE * np.random.default_rng(seed).normal(size=(N, 3))
    return replace(log, tip_position=tip)


def logs() -> list[RunLog]:
    """Two days; the first has more rows."""
    may = day(session="may", seed=1)
    june = day(*ANOTHER_DAY, session="june", seed=2)
    return [may, june.rows(slice(0, N - 20))]


def check_numbers(found: Mapping[str, Estimate], prefix: str = "") -> None:
    """That zeros, registration and delay of the other day are within their standard errors; of one segment
    only the tip is seen, and a zero looks much like a shift and a turn of the camera."""
    zeros, camera, latency = ANOTHER_DAY
    one, two = zeros["offset"]
    true = {"tendon.1.zero": one, "tendon.2.zero": two, "latency.delay": latency["delay"]}
    true |= {
        f"frame_misalignment.{key}": camera.get(key, 0.0) for key in ("rotation_z", "shift_x", "shift_y")
    }
    for name, value in true.items():
        estimate = found[prefix + name]
        assert estimate.value == pytest.approx(value, abs=4.0 * estimate.stderr)
    assert found[prefix + "latency.delay"].stderr < 0.01


@pytest.mark.study
def test_days_share_the_robot_and_have_zeros_camera_and_clock_of_their_own() -> None:
    result = identify(logs(), one_segment())
    assert [found.name for found in result.effects] == ["backlash"]
    assert result.effects[0].parameters["half_width"].value == pytest.approx(4e-4, rel=0.1)
    assert result.verdict == "explained"
    assert result.test.after < 1.1 * np.sqrt(3.0) * NOISE
    assert list(result.sessions) == ["june"]
    check_numbers(result.base_parameters, "session june.")
    own = {str(table["name"]): table for table in result.identified.effects}
    assert own["encoder_offset"]["offset"] == pytest.approx(0.0, abs=1e-12)  # the first day's are the file's
    assert any("session 'june' has its camera" in note for note in result.notes)


@pytest.mark.study
def test_another_day_alone_is_fitted_to_a_robot_that_is_known() -> None:
    june = logs()[1]
    result = identify(june, one_segment(effects=(WORN,)), only_session=True, held_out=["@6:"])
    assert result.as_given_rms is not None
    assert result.as_given_rms[1] > 10.0 * result.test.after
    assert result.test.after < 1.1 * np.sqrt(3.0) * NOISE
    assert not result.effects
    assert set(result.base_parameters) >= {"tendon.1.zero", "latency.delay", "frame_misalignment.shift_x"}
    check_numbers(result.base_parameters)


def test_a_run_is_of_one_session() -> None:
    both = np.repeat(["may", "june"], [40, N - 40])
    with pytest.raises(LogError, match="sessions 'june' and 'may'; a run is of one session"):
        identify(replace(logs()[0], session=both), one_segment())


def test_sessions_and_positions_are_read_as_they_were_written(tmp_path: Path) -> None:
    may = logs()[0]
    log = replace(may, pos=0.9 * may.dl)
    for suffix in (".csv", ".parquet"):
        write_log(log, path := tmp_path / f"log{suffix}")
        again = read_log(path, one_segment())
        for one, other in ((again.pos, log.pos), (again.session, log.session)):
            assert np.array_equal(np.asarray(one), np.asarray(other))


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("gain", [1.0, 0.75])
def test_a_robot_is_moved_by_what_its_drives_did_and_not_by_their_commands(gain: float) -> None:
    """Positions are read 0.2 s late, whatever the model's own delay."""
    robot = one_segment()
    t = DT * np.arange(N)
    way = np.stack([np.sin(1.3 * t), np.cos(0.9 * t)], axis=1)[:, None]
    commanded = displacement_of(robot, 0.6 * way)
    creeps = 0.1 * np.cos(0.21 * t)[:, None, None]
    done = displacement_of(robot, 0.6 * gain * way + creeps)
    late = np.stack([np.interp(t - 0.2, t, column) for column in done.T], axis=1)
    log = replay(log_of(robot, done, DT), robot)
    measured = replace(log.log, dl=commanded, pos=late, tip_position=log.tip_position)
    assert replay(measured, robot).rms < 0.2 * replay(replace(measured, pos=None), robot).rms
    assert (
        np.abs(moved(measured).dl - done)[10:-10].max() < 0.25 * np.abs(done - commanded)[10:-10].max() + 1e-4
    )
    (said,) = sentences(measured)
    lag, first = re.findall(r"(\d+) ms earlier|tendon 1 (\d\.\d+) of its command", said)
    assert float(lag[0]) == pytest.approx(200.0, abs=10.0)
    assert float(first[1]) == pytest.approx(gain, abs=0.05)


def test_rows_without_a_position_are_not_driven_and_a_run_without_any_goes_by_its_commands() -> None:
    robot = one_segment()
    log = log_of(robot, wave(robot, N, DT), DT, run=np.repeat(["a", "b"], N // 2))
    pos = 0.5 * np.asarray(log.dl)
    pos[10], pos[N // 2 :] = np.nan, np.nan
    samples = sample(replace(log, pos=pos))
    assert len(samples.log) == N - 1
    assert np.array_equal(samples.log.dl[-N // 2 :], log.dl[N // 2 :])
    assert np.abs(samples.log.dl[:50]).max() < 0.6 * np.abs(log.dl[:50]).max()


@pytest.mark.study
def test_another_day_has_tighter_tendons_and_its_load_hangs_elsewhere() -> None:
    robot = one_sided()
    moved = wave(robot, N, DT, size=0.9, seed=5)
    tighter, beside = {"name": "tightening", "fraction": 0.4}, {"name": "load_offset", "x": 6e-3, "y": -4e-3}
    log = log_of(robot, moved, DT, payload=np.full(N, 0.02))
    tip = replay(log, replace(robot, effects=(tighter, beside))).tip_position
    log = replace(log, tip_position=tip + NOISE * np.random.default_rng(5).normal(size=(N, 3)))
    result = identify(log, robot, only_session=True, held_out=["@9:"])
    assert result.as_given_rms is not None
    assert result.test.after < 1.1 * np.sqrt(3.0) * NOISE < 0.2 * result.as_given_rms[1]
    for table in (tighter, beside):
        for key in table.keys() - {"name"}:
            found = result.base_parameters[f"{table['name']}.{key}"]
            assert found.value == pytest.approx(table[key], abs=4.0 * found.stderr)
    assert result.base_parameters["tightening.fraction"].stderr < 0.05


@pytest.mark.study
def test_another_day_by_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_robot(one_segment(effects=(WORN,)), tmp_path / "worn.toml")
    write_log(logs()[1], tmp_path / "june.csv")
    words = [
        str(tmp_path / "june.csv"),
        "--robot",
        str(tmp_path / "worn.toml"),
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(["identify", *words, "--only-session", "--held-out", "june@6:"]) == 2  # its run has no name
    assert main(["identify", *words, "--only-session", "--held-out", "@6:"]) == 0
    assert "base fit" in capsys.readouterr().out
    found = load_robot(tmp_path / "out" / "identified.toml")
    names = {str(table["name"]) for table in found.effects}
    assert names == {"latency", "encoder_offset", "backlash", "frame_misalignment"}


@pytest.mark.study
def test_each_day_has_its_own_robot_file(tmp_path: Path) -> None:
    result = identify(logs(), one_segment(effects=(WORN,)), max_effects=0)
    names = [path.name for path in write(result, tmp_path)]
    assert names[-2:] == ["identified.toml", "identified_june.toml"]
    june = load_robot(tmp_path / names[-1])
    log = logs()[1]
    assert replay(log, june).rms < 0.2 * replay(log, load_robot(tmp_path / names[-2])).rms
