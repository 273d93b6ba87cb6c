"""Any bytes at all as a run log: a log that comes back the same, or one sentence."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pytest
from fuzz.strategies import broken_texts, odd_numbers, odd_words, one_sentence, tried
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from fastrod.commands import cli
from fastrod.errors import FastrodError
from fastrod.logs.reader import read_log
from fastrod.logs.recording import recover
from fastrod.logs.runlog import RunLog, write_log
from fastrod.model.robotfile import load_robot

ROBOT = load_robot("prototype")
INPUTS = ["dl_1", "dl_2", "dl_3", "dl_4"]
TIP = ["tip_x", "tip_y", "tip_z"]
FURTHER = [
    ["run"],
    ["ext_1"],
    ["tip_qw", "tip_qx", "tip_qy", "tip_qz"],
    ["tip_fx", "tip_fy", "tip_fz"],
    ["payload"],
    ["base_qw", "base_qx", "base_qy", "base_qz"],
    ["note"],
    ["p1_x", "p1_y", "p1_z"],
]
CELLS = '|nan|NaN|inf|-inf|x|1e400|1e308|-1e308|1_0|0x1p-3|1,5| 0.01 |"|\0|٣|1e-320|70|b|--|True'
NAMES = "t|run|dl_1|dl_5|dl_01|tip_x|Tip_x|p1_x|p2_x|ext_2|ext_0|| |t |payload|a,b|a\nb|é|#|dl_١"
CHANGES = "cell cell number name drop twice row short long swap"


def cells(draw: st.DrawFn, name: str, row: int) -> str:
    """A good cell of a column."""
    if name == "t":
        return repr(0.1 * row)
    if name == "run":
        return "ab"[row > 2]
    if name == "note":
        return draw(odd_words)
    if name in ("tip_qw", "base_qw"):
        return "1"
    if name.startswith(("tip_q", "base_q", "ext")):
        return "0"
    return repr(draw(st.floats(-0.005, 0.005))) if name.startswith("dl") else repr(draw(st.floats(0.0, 0.05)))


@st.composite
def grids(draw: st.DrawFn) -> list[list[str]]:
    """A header and rows of a run log with up to three things changed."""
    further = draw(st.lists(st.sampled_from(FURTHER), max_size=3, unique_by=tuple))
    header = ["t", *INPUTS, *TIP, *(name for group in further for name in group)]
    grid = [header, *([cells(draw, name, row) for name in header] for row in range(draw(st.integers(0, 5))))]
    for _ in range(draw(st.integers(0, 3))):
        i, j = draw(st.integers(0, len(grid) - 1)), draw(st.integers(0, max(0, len(grid[0]) - 1)))
        change = draw(st.sampled_from(CHANGES.split()))
        if change == "row":
            grid.insert(i, list(grid[i]))
        elif change == "short":
            grid[i] = grid[i][:-1]
        elif change == "long":
            grid[i].append("1")
        elif change == "swap":
            k = draw(st.integers(0, len(grid) - 1))
            grid[i], grid[k] = grid[k], grid[i]
        elif change == "name" and j < len(grid[0]):
            grid[0][j] = draw(st.sampled_from(NAMES.split("|")) | odd_words)
        elif change in ("drop", "twice"):
            for row in grid:
                if j < len(row):
                    row[j : j + 1] = [] if change == "drop" else [row[j]] * 2
        elif j < len(grid[i]) and i:
            number = odd_numbers.filter(lambda n: abs(n) < 1e300 or n != n).map(repr)
            grid[i][j] = draw(st.sampled_from(CELLS.split("|")) if change == "cell" else number)
    return grid


@st.composite
def texts(draw: st.DrawFn) -> str:
    """A run log's text, in one of many ways of writing CSV."""
    made = io.StringIO()
    writer = csv.writer(
        made,
        lineterminator=draw(st.sampled_from(["\n", "\n", "\r\n", "\r"])),
        delimiter=draw(st.sampled_from([",", ",", ",", ";", "\t"])),
        quoting=draw(st.sampled_from([csv.QUOTE_MINIMAL, csv.QUOTE_ALL])),
    )
    writer.writerows(draw(grids()))
    head = draw(st.sampled_from(["", "", "\ufeff", "# a comment\n", "\n\n", "\ufeff# with, commas\n"]))
    return head + made.getvalue()


COLUMNS = "t run dl tip_position ext tip_quaternion points tip_force payload base_quaternion"


def same(one: RunLog, other: RunLog) -> None:
    """Two logs have the same numbers and texts."""
    for name in COLUMNS.split():
        a, b = getattr(one, name), getattr(other, name)
        assert (a is None) == (b is None), name
        if a is not None:
            if "quaternion" in name:  # scaled to norm 1 once more
                np.testing.assert_allclose(a, b, rtol=1e-15, atol=1e-16, err_msg=name)
            else:
                assert_array_equal(a, b, err_msg=name)
    assert list(one.extra) == list(other.extra)
    for name, column in one.extra.items():
        assert_array_equal(np.asarray(column), np.asarray(other.extra[name]), err_msg=name)


def read(path: Path) -> RunLog | None:
    """The log of a file, or None where it was refused in one sentence that names the file."""
    try:
        return read_log(path, ROBOT)
    except FastrodError as error:
        one_sentence(error, path.name)
        return None


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("logs")


@pytest.mark.study
@tried(200)
@given(text=texts())
def test_an_odd_csv_is_a_log_or_a_sentence(folder: Path, text: str) -> None:
    path = folder / "odd.csv"
    path.write_text(text, encoding="utf-8", newline="")
    if (log := read(path)) is not None:
        for suffix in (".csv", ".parquet"):
            again = folder / f"again{suffix}"
            write_log(log, again, comment="one\ntwo")
            same(log, read_log(again, ROBOT))
    assert not list(folder.glob("*.part"))


@tried(100)
@given(data=st.data())
def test_broken_bytes_are_a_log_or_a_sentence(folder: Path, data: st.DataObject) -> None:
    path = folder / "broken.csv"
    path.write_bytes(data.draw(broken_texts(data.draw(texts()))))
    log = read(path)
    assert log is None or len(log) > 0


@tried(30)
@given(raw=st.binary(max_size=100))
def test_random_bytes_are_a_sentence(folder: Path, raw: bytes) -> None:
    for name in ("random.csv", "random.parquet"):
        (folder / name).write_bytes(raw)
        assert read(folder / name) is None


@st.composite
def columns(draw: st.DrawFn) -> dict[str, object]:
    """Columns of a Parquet file, of any type."""
    import pyarrow as pa

    n = draw(st.integers(0, 4))
    made: dict[str, object] = {name: pa.array([0.01 * k for k in range(n)]) for name in ("t", *INPUTS, *TIP)}
    kinds = {
        "int": pa.array([1] * n),
        "bool": pa.array([True] * n),
        "text": pa.array(["x"] * n),
        "digits": pa.array(["0.01"] * n),
        "none": pa.nulls(n),
        "bytes": pa.array([b"\xff"] * n),
        "list": pa.array([[1.0, 2.0]] * n),
        "struct": pa.array([{"a": 1}] * n),
        "time": pa.array([5] * n, pa.timestamp("ns")),
        "span": pa.array([5] * n, pa.duration("s")),
        "date": pa.array([5] * n, pa.date32()),
        "decimal": pa.array([1] * n).cast(pa.decimal128(30, 2)),
        "f16": pa.array(np.zeros(n, np.float16)),
        "inf": pa.array([np.inf] * n),
        "huge": pa.array([2**63 - 1] * n),
        "map": pa.array([[("a", 1)]] * n, pa.map_(pa.string(), pa.int64())),
        "some": pa.array([None] * min(n, 1) + ["x"] * (n - 1)),
        "category": pa.array(["a"] * n).dictionary_encode(),
    }
    for _ in range(draw(st.integers(0, 3))):
        name = draw(
            st.sampled_from(["t", "run", "dl_2", "tip_x", "note", "payload", "ext_1", "dl_5", "p1_x", "é"])
        )
        made[name] = kinds[draw(st.sampled_from(sorted(kinds)))]
    for name in draw(st.lists(st.sampled_from([*made]), max_size=1)):
        del made[name]
    return made


@tried(80)
@given(data=st.data())
def test_an_odd_parquet_is_a_log_or_a_sentence(folder: Path, data: st.DataObject) -> None:
    import pyarrow as pa
    import pyarrow.parquet as parquet

    made = data.draw(columns())
    path = folder / "odd.parquet"
    parquet.write_table(pa.table(made), path)
    if (log := read(path)) is not None:
        write_log(log, folder / "again.parquet")
        same(log, read_log(folder / "again.parquet", ROBOT))
    raw = path.read_bytes()
    path.write_bytes(raw[: data.draw(st.integers(0, len(raw) - 1))])
    assert read(path) is None


@pytest.mark.study
@tried(8)
@given(text=texts())
def test_replay_of_an_odd_log_answers(folder: Path, text: str) -> None:
    path, out = folder / "replayed.csv", folder / "replayed"
    path.write_text(text, encoding="utf-8", newline="")
    code, printed = run("replay", str(path), "--robot", "prototype", "--out", str(out))
    assert code in (0, 1, 2)
    if code:
        assert printed.count("\n") == 1, printed
        assert not out.exists()
    else:
        assert sorted(file.name for file in out.iterdir()) == ["replay.png", "residuals.csv"]
        for file in out.iterdir():
            file.unlink()
        out.rmdir()


@tried(4)
@given(text=texts())
def test_identify_of_an_odd_log_answers(folder: Path, text: str) -> None:
    path, out = folder / "identified.csv", folder / "identified"
    path.write_text(text, encoding="utf-8", newline="")
    code, printed = run(*f"identify {path} --robot prototype --max-effects 0 --out {out}".split())
    assert code == 2  # none is long enough
    assert printed.count("\n") == 1, printed
    assert not out.exists()


def run(*words: str) -> tuple[int, str]:
    """A command line's exit code, and what it said on stderr."""
    from contextlib import redirect_stderr, redirect_stdout

    err = io.StringIO()
    with redirect_stderr(err), redirect_stdout(io.StringIO()):
        code = cli.main(words)
    return code, err.getvalue()


HEADER = (
    f"t,run,{','.join(INPUTS)},tip_x,tip_y,tip_z,tip_qw,tip_qx,tip_qy,tip_qz,tip_fx,tip_fy,tip_fz,payload"
)
HEADER += ",base_qw,base_qx,base_qy,base_qz"
ROWS = [f"{0.02 * k!r},free,0,0,0,0,0.0,{1e-3 * k!r},0.07,1,0,0,0,0,0,0,0.0,,,," for k in range(4)]
PARTIAL = "\n".join(["# Recorded on robot prototype.", HEADER, *ROWS, ""])


@tried(100)
@given(data=st.data())
def test_a_torn_partial_file_is_recovered_or_kept(folder: Path, data: st.DataObject) -> None:
    """A killed session left a cut and broken file: whole rows come back, or nothing is taken away."""
    at = data.draw(st.integers(0, len(PARTIAL)))
    raw = data.draw(st.just(PARTIAL[:at].encode()) | broken_texts(PARTIAL))
    target, partial = folder / "torn.csv", folder / "torn.csv.part"
    target.unlink(missing_ok=True)
    partial.write_bytes(raw)
    try:
        log = recover(partial)
    except FastrodError as error:
        one_sentence(error, partial.name)
        assert partial.exists()
        assert not target.exists()
    else:
        assert not partial.exists()
        assert len(log) > 0
        if raw == PARTIAL[:at].encode():
            assert_array_equal(log.t, [0.02 * k for k in range(PARTIAL[:at].count("\n") - 2)])
            same(log, read_log(target, ROBOT))
    left = [file.name for file in folder.glob("torn*")]
    assert left == ["torn.csv" if target.exists() else "torn.csv.part"]
