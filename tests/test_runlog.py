"""Run logs: what is read, and one sentence with row and column for what cannot be."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fastrod.errors import LogError, UnknownNameError
from fastrod.logs.reader import read_log
from fastrod.logs.runlog import RunLog, write_log
from fastrod.model.robotfile import load_robot
from fastrod.model.routing import route

GOOD = """t,run,dl_1,dl_2,dl_3,dl_4,tip_x,tip_y,tip_z
0.0,a,0,0,0,0,0,0,0.07
0.1,a,-0.001,0,0.001,0,0.004,0,0.069
0.0,b,0,0,0,0,0,0,0.07
"""
ROBOT = load_robot("prototype")


@pytest.fixture
def read(tmp_path):
    """The log of this text."""

    def read(text, robot=ROBOT):
        path = tmp_path / "log.csv"
        path.write_text(text, encoding="utf-8")
        return read_log(path, robot)

    return read


def with_column(name, values):
    return "\n".join(f"{line},{cell}" for line, cell in zip(GOOD.split(), [name, *values], strict=True))


def test_log_is_read_by_name_and_run(read):
    log = read("# a comment\n" + GOOD)
    assert (len(log), log.runs, log.dl.shape, log.dl[1, 0]) == (3, ["a", "b"], (3, 4), -0.001)
    assert_array_equal(log.only("b").t, [0.0])
    assert log.measured.all()
    assert log.ext is None
    with pytest.raises(ValueError, match="read-only"):
        log.t[0] = 1.0


def test_missing_values_drop_only_their_own_row(read):
    log = read(GOOD.replace("0.004,0,0.069", ",nan,0.069").replace("0.0,b,0", "0.0,b,"))
    assert_array_equal(log.measured, [True, False, False])
    assert_array_equal(log.driven, [True, True, False])


def test_unknown_columns_are_kept_and_ignored(read):
    log = read(with_column("note", ["x", "2", ""]))
    assert list(log.extra) == ["note"]
    assert list(log.rows(np.array([True, False, True])).extra["note"]) == ["x", ""]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_log_comes_back_bit_for_bit(tmp_path, suffix):
    if suffix == ".parquet":
        pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'fastrod[parquet]'")
    rng = np.random.default_rng(3)
    q = rng.normal(size=(5, 4))
    q /= np.linalg.norm(q, axis=1)[:, None]
    tip = rng.normal(0.0, 0.03, (5, 3))
    tip[2] = np.nan
    exact = {
        "t": np.arange(5) / 3.0,
        "run": np.array(list("aabbb")),
        "dl": rng.normal(0.0, 1e-3, (5, 4)),
        "tip_position": tip,
        "ext": np.zeros((5, 1)),
        "points": rng.normal(0.0, 0.02, (5, 2, 3)),
        "tip_force": rng.normal(size=(5, 3)),
        "payload": np.full(5, 0.01),
    }
    extra = {"note": list("vwxyz"), "current": rng.normal(size=5)}
    log = RunLog(name="log", tip_quaternion=q, base_quaternion=q, extra=extra, **exact)
    path = tmp_path / f"log{suffix}"
    write_log(log, path)
    back = read_log(path, replace(ROBOT, log_points=(0.02, 0.05)))
    for name, values in exact.items():
        assert_array_equal(getattr(back, name), values, err_msg=name)
    for name in ("tip_quaternion", "base_quaternion"):  # scaled to norm 1 again: the last bit may move
        assert_allclose(getattr(back, name), getattr(log, name), atol=1e-15)
    assert list(back.extra) == ["note", "current"]
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize(("delimiter", "point"), [(";", ","), (";", "."), ("\t", ".")])
def test_spreadsheet_of_other_delimiters_is_the_same_log(tmp_path, delimiter, point):
    plain, other = tmp_path / "plain.csv", tmp_path / "other.csv"
    plain.write_text(GOOD)
    other.write_text("# by a spreadsheet\n\n" + GOOD.replace(",", delimiter).replace(".", point))
    one, two = read_log(plain, ROBOT), read_log(other, ROBOT)
    assert_array_equal(two.dl, one.dl)
    assert_array_equal(two.tip_position, one.tip_position)


def test_parquet_without_pyarrow_says_so(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(LogError, match="needs the package pyarrow"):
        read_log(tmp_path / "log.parquet", ROBOT)


NO_TIP = "lacks column tip_z that every run log has; did you mean 'tip_Z'"
NO_DL = "lacks columns dl_1, .* that robot 'prototype' needs for its 4 tendons; did you mean 'dl1'"
FEW = r"3 dl_ columns \(dl_1 to dl_3\); robot 'prototype' has 4 tendons and needs dl_1 to dl_4"
BACK = "row 3, column t is 0 s after 0.1 s inside run 'a'; time must not run back"
TIP_MM = r"row 2, the tip's distance from the base is 69 m; more than 3 lengths .* in mm, or in cm\?"
REST = r"median of 0\.07\d* m in column dl_1, .* 0\.07 m at rest: these look like absolute lengths\."
LENGTHS = GOOD.replace(",0,0,0,0,", ",0.07,0.07,0.07,0.07,")
BASE = "base_qw,base_qx,base_qy,base_qz"
BAD = {
    "empty": ("", "log.csv is empty"),
    "no rows": (GOOD.split("\n")[0], "has a header but no rows"),
    "no tip": (GOOD.replace("tip_z", "tip_Z"), NO_TIP),
    "misspelt dl": (GOOD.replace("dl_", "dl"), NO_DL),
    "too few dl": (GOOD.replace("dl_4", "other"), FEW),
    "half a group": (GOOD.replace("run", "tip_fx"), "lacks columns tip_fy, tip_fz to go with 'tip_fx'"),
    "not a number": (GOOD.replace("0.069", "0.0b9"), "row 2, column tip_z is '0.0b9'; it must be a number"),
    "infinite": (GOOD.replace("0.069", "inf"), "row 2, column tip_z is inf; it must be finite"),
    "short row": (GOOD.replace(",0.069", ""), "row 2 has 8 values; the header names 9 columns"),
    "column twice": (GOOD.replace("tip_y", "tip_x"), "has column 'tip_x' more than once"),
    "time back": (GOOD.replace("0.0,b", "0.0,a"), BACK),
    "tip in mm": (GOOD.replace("0.069", "69"), TIP_MM),
    "absolute lengths": (
        LENGTHS.replace("-0.001,0,0.001,0", "0.069,0.07,0.071,0.07"),
        f"{REST} The log takes changes",
    ),
    "dl in mm": (GOOD.replace("-0.001", "-1.0"), r"row 2, column dl_1 is -1 m; .* Was it given in mm\?"),
    "points": (
        GOOD.replace("run", "p1_x"),
        "has points p1 to p1; robot 'prototype' names the arclengths of 0",
    ),
    "ext": (GOOD.replace("run", "ext_2"), "has column 'ext_2'; robot 'prototype' has 1 segments"),
    "mass in grams": (
        with_column("payload", ["0", "50", ""]),
        r"row 2, column payload is 50 kg; more than 10 kg. Was it given in g\?",
    ),
    "negative mass": (
        with_column("payload", ["-1", "0", ""]),
        "row 1, column payload is -1 kg; a mass is not negative",
    ),
    "quaternion": (
        with_column(BASE, ["1,0,0,0", "0,2,0,0", "1,0,0,0"]),
        "row 2, columns base_qw to base_qz have norm 2",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_log_answers_with_one_sentence(read, case):
    text, sentence = BAD[case]
    if "run" not in text.split("\n")[0]:  # the label column was renamed to something that holds numbers
        text = text.replace(",a,", ",0,").replace(",b,", ",0,")
    with pytest.raises(LogError, match=sentence) as caught:
        read(text)
    assert "\n" not in str(caught.value)


def test_quaternions_are_scaled_to_norm_1(read):
    log = read(with_column(BASE, ["1,0,0,0", "0.7071,0.7071,0,0", "0.5,0.5,0.5,0.5"]))
    assert_allclose(np.linalg.norm(log.base_quaternion, axis=1), 1.0, rtol=1e-15)


def test_extension_beyond_the_segment_is_refused(read):
    robot = load_robot("five_segment_reacher")
    header = ",".join(["t", *(f"dl_{k}" for k in range(1, 16)), "tip_x", "tip_y", "tip_z", "ext_5"])
    row = header + "\n0," + "0," * 15 + "0,0,0.52,{}\n"
    with pytest.raises(LogError, match=r"row 1, column ext_5 is 20 m; segment 5 .* allows 0 to 0.05 m"):
        read(row.format("20"), robot)
    assert_array_equal(read(row.format("0.02"), robot).ext, [[0.0, 0.0, 0.0, 0.0, 0.02]])


def test_unreadable_files(tmp_path):
    with pytest.raises(LogError, match="cannot be read: No such file or directory"):
        read_log(tmp_path / "none.csv", ROBOT)
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"\x7f\x00\xfe\x80" * 20)
    with pytest.raises(LogError, match="cannot be read: it is not text"):
        read_log(binary, ROBOT)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (GOOD, "no run 'c' in log 'log'; known: a, b"),
        (GOOD.replace(",a,", ",,").replace("0.0,b,", "0.2,,"), r"no run 'c'; log 'log' names no runs\."),
        (GOOD.replace(",b,", ',"two\nlines",'), "known: a, two lines"),
    ],
    ids=["two runs", "no runs", "two lines"],
)
def test_unknown_run_answers_with_the_nearest(text, sentence, read):
    with pytest.raises(UnknownNameError, match=sentence) as caught:
        read(text).only("c")
    assert "\n" not in str(caught.value)


def test_shapes_are_checked_once():
    rows = {"t": np.zeros(2), "run": np.array(["", ""]), "dl": np.zeros((2, 4))}
    with pytest.raises(LogError, match=r"RunLog.tip_position has shape \(2, 2\); it must be \(2, 3\)"):
        RunLog(name="x", tip_position=np.zeros((2, 2)), **rows)


def test_antagonists_that_can_only_pull_may_share_a_column(read) -> None:
    """A motor that winds one tendon up and pays the other out is one column."""
    (segment,) = ROBOT.segments
    tendons = tuple(replace(t, unilateral=True, pretension=1.0) for t in segment.tendons)
    robot = replace(ROBOT, segments=(replace(segment, tendons=tendons),))
    text = "t,dl_1,dl_2,tip_x,tip_y,tip_z\n0,-0.001,0.002,0,0,0.06\n1,0.0005,0,0,0,0.06\n"
    wiring, given = route(robot), np.array([[-0.001, 0.002], [0.0005, 0.0]])
    assert_array_equal(read(text, robot).dl, given[:, wiring.drive] * wiring.drive_sign)
    with pytest.raises(LogError, match="has 2 dl_ columns"):
        read(text)
