"""A robot of one's own and its log: any columns, units, signs and order in, the same run log out."""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from identification.logs import displacement_of, log_of, two_segments, wave
from numpy.testing import assert_allclose
from refusals import refusals
from scipy.io import savemat

from fastrod import Robot, Segment, Tendon, load_robot
from fastrod.commands.cli import main
from fastrod.errors import LogError, RobotError
from fastrod.identification.attribution import identify
from fastrod.identification.log.check import check
from fastrod.identification.log.clock import clock_offset
from fastrod.identification.log.order import column_order
from fastrod.identification.log.replay import replay
from fastrod.identification.log.samples import sample
from fastrod.logs.reader import read_log
from fastrod.logs.runlog import RunLog, write_log
from fastrod.logs.table import read_table
from fastrod.model.logformat import LogFormat
from fastrod.model.robotfile import dumps, loads

Captured = pytest.CaptureFixture[str]
NAMES = {"t": "time", "tip_x": "X", "tip_y": "Y", "tip_z": "Z"}


def lab() -> Robot:
    """Two segments, three tendons each, those of the second between those of the first."""
    return Robot(
        name="lab",
        segments=tuple(
            Segment(
                length=length,
                bending_stiffness=(0.004, 0.004),
                torsional_stiffness=0.003,
                tendons=tuple(Tendon(offset=0.009, angle=first + 2.0944 * i) for i in range(3)),
            )
            for length, first in ((0.1, 0.0), (0.09, 1.0472))
        ),
    )


def measured(robot: Robot, n: int = 600, dt: float = 0.05, **effects: dict[str, float]) -> RunLog:
    """A run of `robot` with effects, and 0.1 mm of noise."""
    t, rng = dt * np.arange(n), np.random.default_rng(3)
    rate, phase, size = (rng.uniform(a, b, (2, 2, 3, 1)) for a, b in ((0.2, 1.5), (0.0, 6.3), (0.1, 0.3)))
    bends = (size * (np.sin(rate * t + phase) - np.sin(phase))).sum(axis=2).transpose(2, 0, 1)
    bends[int(0.6 * n) : int(0.7 * n)] = bends[int(0.6 * n)]
    log = log_of(robot, displacement_of(robot, bends), dt)
    tables = tuple({"name": name, **values} for name, values in effects.items())
    tip = replay(log, replace(robot, effects=tables)).tip_position
    return replace(log, tip_position=tip + np.random.default_rng(1).normal(0.0, 1e-4, tip.shape))


def raw(log: RunLog, path: Path, log_format: LogFormat) -> None:
    """The log as a user's file that `log_format` describes."""
    columns = {"t": log.t, **{f"dl_{k + 1}": c for k, c in enumerate(log.dl.T)}}
    columns |= {f"tip_{axis}": c for axis, c in zip("xyz", log.tip_position.T, strict=True)}
    table = {}
    for name, source in log_format.sources.items():
        values = columns[name]
        if name.startswith("dl"):
            k = int(name[3:]) - 1
            sign, offset, radius = (
                np.resize(1.0 if a is None else a, log.dl.shape[1])[k]
                for a in (log_format.sign, log_format.offset, log_format.drum_radius)
            )
            values = (sign * values + offset) / radius
        factor = log_format.factor(name)
        if np.isnan(factor):
            stamps = np.datetime64("2026-05-12T09:30:00") + (1e9 * values).astype("timedelta64[ns]")
            table[source] = stamps.astype(str)
        else:
            table[source] = values / factor
    if path.suffix == ".mat":
        savemat(path, {name: np.asarray(values)[:, None] for name, values in table.items()})
    else:
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(table)
            writer.writerows(zip(*(np.asarray(v).tolist() for v in table.values()), strict=True))


DL = tuple(f"motor{letter}" for letter in "ABCDEFGH")
FORMATS = {
    "degrees and mm": LogFormat(
        columns=NAMES | {"dl": DL},
        units={"time": "ms", "length": "mm", "angle": "deg"},
        drum_radius=0.012,
        sign=-1,
    ),
    "lengths of their own": LogFormat(
        columns={"t": "time", "dl": DL, "tip": ("X", "Y", "Z")},
        units={"time": "iso", "dl": "cm", "tip": "in"},
        offset=tuple(0.05 + 0.001 * k for k in range(8)),
        sign=(1, -1, 1, 1, -1, 1, 1, 1),
    ),
    "counts of an encoder": LogFormat(
        columns=NAMES | {f"dl_{k + 1}": name for k, name in enumerate(DL)},
        units={"time": "us", "angle": 0.00153, "tip": 0.01},
        drum_radius=tuple(0.01 + 0.001 * k for k in range(8)),
    ),
}


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("suffix", [".csv", ".mat"])
def test_any_format_reads_as_the_same_log(name: str, suffix: str, tmp_path: Path) -> None:
    robot = replace(two_segments(), log=FORMATS[name])
    if suffix == ".mat" and robot.log.units["time"] == "iso":
        robot = replace(robot, log=replace(robot.log, units=robot.log.units | {"time": "min"}))
    log = log_of(robot, wave(robot, 50), tip_position=np.random.default_rng(0).uniform(0.0, 0.1, (50, 3)))
    raw(log, tmp_path / f"a{suffix}", robot.log)
    found = read_log(tmp_path / f"a{suffix}", loads(dumps(robot)))
    for one, other in ((found.t, log.t), (found.dl, log.dl), (found.tip_position, log.tip_position)):
        assert_allclose(one, other, atol=1e-9)
    write_log(found, tmp_path / "run.csv")  # which is read as it stands
    assert_allclose(read_log(tmp_path / "run.csv", robot).dl, log.dl, atol=1e-9)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "cp1252"])
def test_a_spreadsheet_is_read_in_the_encoding_that_it_has(encoding: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t;Länge\n0;1,5\n", encoding)
    assert read_table(tmp_path / "a.csv") == {"t": ("0",), "Länge": ("1.5",)}


def test_matrices_and_structs_of_matlab_become_columns(tmp_path: Path) -> None:
    savemat(
        tmp_path / "a.mat", {"q": np.ones((9, 2)), "cam": {"xyz": np.ones((3, 9))}, "fs": 3.0, "who": "me"}
    )
    assert list(read_table(tmp_path / "a.mat")) == ["q_1", "q_2", "cam_xyz_1", "cam_xyz_2", "cam_xyz_3"]


FILE = dumps(load_robot("prototype")) + "\n[log]\n"


@refusals(
    {
        RobotError: {
            r"\[log\] has an unknown key 'column'; did you mean 'columns'": lambda: loads(
                FILE + "column = {}"
            ),
            r"\[log\] columns has 'tipp'; did you mean 'tip'": lambda: loads(FILE + 'columns = {tipp = "x"}'),
            r"columns tip is 'x'; it is several columns": lambda: loads(FILE + 'columns = {tip = "x"}'),
            r"columns tip lists 2 names; it needs 3": lambda: loads(FILE + 'columns = {tip = ["x", "y"]}'),
            r"columns names 'x' twice": lambda: loads(FILE + 'columns = {tip = ["x", "y", "x"]}'),
            r"units length is 'mmm'; did you mean 'mm'": lambda: loads(FILE + 'units = {length = "mmm"}'),
            r"units has 'lenght'; did you mean 'length'": lambda: loads(FILE + 'units = {lenght = "mm"}'),
            r"sign is 2; it must be 1, or -1": lambda: loads(FILE + "sign = 2"),
            r"drum_radius is -1.0 m; it must be positive": lambda: loads(FILE + "drum_radius = -1"),
        }
    }
)
def test_a_wrong_format_is_one_sentence(error: type[Exception], sentence: str, call: Any) -> None:
    with pytest.raises(error, match=sentence):
        call()


def test_a_column_that_is_named_and_not_there_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,mA,mB,mC,mD,X,Y,zed\n" + "0,0,0,0,0,0,0,0\n" * 3)
    robot = loads(FILE + 'columns = {t = "time", dl = ["mA", "mB", "mC", "mD"], tip = ["X", "Y", "Z"]}')
    with pytest.raises(LogError, match=r"lacks column 'Z', which \[log\] columns of the robot file names"):
        read_log(tmp_path / "a.csv", robot)


ORDERS = {
    "two of one segment": ([1, 0, 2, 3, 4, 5], 1.0),
    "two of both": ([3, 1, 2, 0, 4, 5], 1.0),
    "all": ([4, 2, 0, 5, 1, 3], 1.0),
    "signs": ([0, 1, 2, 3, 4, 5], -1.0),
    "both": ([5, 4, 3, 2, 1, 0], -1.0),
}


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("name", ORDERS)
def test_the_order_of_columns_is_found_and_another_one_refused(name: str) -> None:
    robot, (order, sign) = lab(), ORDERS[name]
    log = measured(robot, backlash={"half_width": 2.7e-4})
    spoiled = replace(log, dl=sign * log.dl[:, order])
    found = column_order(sample(spoiled), robot)
    assert found is not None
    assert_allclose(found.of(spoiled.dl), log.dl)
    with pytest.raises(LogError, match=r"times as closely with (dl_\d and|the dl_ columns|the sign)"):
        identify(spoiled, robot)
    assert check(log, robot).refusal == ""


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("late", [0.3, -0.3])
def test_commands_that_come_after_the_motion_show_two_clocks(late: float) -> None:
    """Commands that come before it are late drives, or a late camera: an effect."""
    robot = lab()
    log = measured(robot, backlash={"half_width": 2.7e-4})
    shifted = np.stack([np.interp(log.t - late, log.t, column) for column in log.dl.T], axis=1)
    offset = clock_offset(sample(replace(log, dl=shifted)), robot)
    assert offset == pytest.approx(max(late, 0.0), abs=0.15)


@pytest.mark.study
def test_two_clocks_are_fitted_and_the_effect_beside_them_is_found(tmp_path: Path) -> None:
    robot = lab()
    log = measured(robot, n=2000, dt=0.02, backlash={"half_width": 2.7e-4})
    late = replace(log, dl=np.stack([np.interp(log.t - 0.3, log.t, column) for column in log.dl.T], axis=1))
    result = identify(late, robot)
    assert result.clock is not None
    assert result.clock.value == pytest.approx(0.3, abs=5e-3)
    assert "two clocks" in result.summary
    assert result.effects[0].name in ("backlash", "friction")
    assert result.test.after < 1.15 * result.noise.floor
    write_log(late, tmp_path / "late.csv")
    again = replay(read_log(tmp_path / "late.csv", result.identified), result.identified)
    assert again.rms < 1.3 * result.noise.floor  # the first 0.2 s of the fit know no command


@pytest.mark.study
def test_three_commands_from_a_file_of_ones_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    """Milliseconds, degrees, millimetres, positive pulls, an order of their own: no converter."""
    monkeypatch.chdir(tmp_path)
    log = measured(lab())
    order = [4, 2, 0, 5, 1, 3]
    names = tuple(f"motor{c}_deg" for c in "ABCDEF")
    theirs = LogFormat(
        columns={"t": "time_ms", "dl": names, "tip": ("X_mm", "Y_mm", "Z_mm")},
        units={"time": "ms", "length": "mm", "angle": "deg"},
        drum_radius=0.012,
        sign=-1,
    )
    raw(replace(log, dl=log.dl[:, order]), tmp_path / "a.csv", theirs)
    words = (
        "--segments 2 --tendons 3 --length 100,90 --offset 9 --angle 0,60 --drum-radius 12 --positive pulls"
    )
    assert main(["new", "mine.toml", "--log", "a.csv", *words.split()]) == 0
    assert main(["check", "a.csv", "--robot", "mine.toml"]) == 2
    assert "times as closely with the dl_ columns in the order 3, 5, 2, 6, 1, 4" in capsys.readouterr().err
    assert main(["check", "a.csv", "--robot", "mine.toml", "--out", "found.toml"]) == 0
    assert re.search(r"2 +4 +motorF_deg +pulls +60", capsys.readouterr().out)
    raw(log, tmp_path / "dated.csv", replace(theirs, units=theirs.units | {"time": "iso"}))
    assert main(["new", "dated.toml", "--log", "dated.csv", *words.split()]) == 0
    assert load_robot("dated.toml").log.units["time"] == "iso"
    assert main(["import", "a.csv", "--robot", "found.toml", "--out", "run.csv"]) == 0
    assert_allclose(read_log("run.csv", load_robot("found.toml")).dl, log.dl, atol=1e-8)
    assert main(["check", "run.csv", "--robot", "found.toml"]) == 0
    assert "units, signs, order, clock and time fit the robot" in capsys.readouterr().out
    assert main(["new", "mine.toml"]) == 2
    assert "is there already" in capsys.readouterr().err
    assert main(["new", "b.toml", "--segments", "two"]) == 2
    assert "--segments is 'two'" in capsys.readouterr().err
    assert main(["new", "c.toml", "--drum-radius", "3"]) == 2
    assert "--drum-radius says how a log is read; give --log FILE" in capsys.readouterr().err
    assert main(["new", "c.toml", "--radius", "10", "--youngs-modulus", "200"]) == 0
    (segment,) = load_robot("c.toml").segments
    bending, weight = 2e5 * np.pi / 4.0 * 0.01**4, 1070.0 * np.pi * 0.01**2
    assert_allclose([*segment.bending_stiffness, segment.line_density], [bending, bending, weight], rtol=1e-5)
