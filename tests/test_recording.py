"""The recorder: what is recorded is what is read back, and what a killed session has left is not lost."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import fastrod
from fastrod.errors import InputError, LogError
from fastrod.link import Measurement
from fastrod.recording import Recorder, free_path, recover
from fastrod.robot import Robot
from fastrod.runlog import RunLog, read_log
from fastrod.types import Floats

ROBOT = fastrod.load_robot("prototype")


def reading(t: float, rng: np.random.Generator, robot: Robot = ROBOT) -> Measurement:
    quaternion = rng.normal(size=4)
    return Measurement(
        t=t,
        dl=rng.uniform(-0.005, 0.005, robot.n_tendons),
        ext=np.zeros(robot.n_segments),
        tip_position=rng.uniform(-0.05, 0.05, 3),
        tip_quaternion=quaternion / np.linalg.norm(quaternion),
        tension=rng.uniform(0.0, 3.0, robot.n_tendons),
    )


def filled(recorder: Recorder, n: int = 200, seed: int = 3) -> Recorder:
    """Two runs of `n` rows, the second with a payload."""
    rng = np.random.default_rng(seed)
    for run, payload in (("free", 0.0), ("loaded", 0.02)):
        recorder.start(10.0, run)
        for k in range(n):
            recorder.add(reading(10.0 + 0.02 * k, rng), payload=payload, commanded_dl=rng.uniform(-0.005, 0.005, ROBOT.n_tendons))
    return recorder


def assert_same(a: RunLog, b: RunLog) -> None:
    for name in ("t", "run", "dl", "tip_position", "ext", "tip_quaternion", "points", "tip_force", "payload", "base_quaternion"):
        one, other = getattr(a, name), getattr(b, name)
        assert (one is None) == (other is None), name
        if one is not None:
            assert_array_equal(one, other, err_msg=name)
    assert sorted(a.extra) == sorted(b.extra)
    for name, cells in a.extra.items():
        assert_array_equal(numbers(cells), numbers(b.extra[name]), err_msg=name)


def numbers(cells: object) -> Floats:
    """A column of numbers, or of what a CSV has in their place."""
    return np.array([float(cell or "nan") if isinstance(cell, str) else cell for cell in cells])  # type: ignore[attr-defined]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_recording_reads_back_bit_for_bit(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"session{suffix}"
    recorder = filled(Recorder(ROBOT, path))
    assert recorder.recording
    assert len(recorder) == 400
    log = recorder.stop()
    assert not recorder.recording
    assert_same(log, read_log(path, ROBOT))
    assert sorted(file.name for file in tmp_path.iterdir()) == [path.name]
    assert log.runs == ["free", "loaded"]
    assert log.measured.all()
    assert log.payload is not None
    assert log.tip_force is None  # none was ever given
    assert log.ext is None  # this robot does not extend
    assert_array_equal(log.t[:2], [0.0, 10.02 - 10.0])
    assert sorted(log.extra) == [f"{what}_{k}" for what in ("cmd_dl", "tension") for k in range(1, 5)]


def test_what_is_missing_stays_missing(tmp_path: Path) -> None:
    path = tmp_path / "session.csv"
    recorder = Recorder(ROBOT, path)
    recorder.start(0.0)
    unknown = np.full(3, np.nan)
    for k in range(3):
        tip = unknown if k == 1 else np.array([0.0, 0.0, 0.07])
        force = (0.1, 0.0, 0.0) if k == 2 else None
        given = Measurement(t=k, dl=np.zeros(4), ext=np.zeros(1), tip_position=tip, tip_quaternion=np.full(4, np.nan), tension=[np.inf] * 4)
        recorder.add(given, tip_force=force)
    log = recorder.stop()
    assert_same(log, read_log(path, ROBOT))
    assert log.measured.tolist() == [True, False, True]
    assert log.tip_quaternion is None
    assert log.extra == {}  # no tension was finite and nothing was commanded
    assert log.tip_force is not None
    assert_array_equal(log.tip_force, [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    assert log.runs == [""]


def test_a_robot_that_extends_has_its_extension_recorded(tmp_path: Path) -> None:
    from dataclasses import replace

    longer = replace(ROBOT, segments=tuple(replace(segment, extension=(0.0, 0.02)) for segment in ROBOT.segments))
    recorder = Recorder(longer, tmp_path / "session.csv")
    recorder.start(0.0)
    recorder.add(
        Measurement(t=0.0, dl=np.zeros(4), ext=[0.01], tip_position=[0, 0, 0.08], tip_quaternion=[1, 0, 0, 0], tension=np.zeros(4))
    )
    log = recorder.stop()
    assert log.ext is not None
    assert_array_equal(log.ext, [[0.01]])
    assert_same(log, read_log(tmp_path / "session.csv", longer))


def test_a_killed_session_is_recovered_row_by_row(tmp_path: Path) -> None:
    path, kept = tmp_path / "session.csv", tmp_path / "kept"
    kept.mkdir()
    recorder = filled(Recorder(ROBOT, path))
    (kept / "session.csv.part").write_bytes((tmp_path / "session.csv.part").read_bytes())  # as it lies there while rows still come
    whole = recorder.stop()
    log = recover(kept / "session.csv")
    assert_same(log, whole)
    assert_same(log, read_log(kept / "session.csv", ROBOT))
    assert not (kept / "session.csv.part").exists()


def test_a_row_cut_short_is_left_out(tmp_path: Path) -> None:
    path, kept = tmp_path / "session.csv", tmp_path / "kept"
    kept.mkdir()
    recorder = filled(Recorder(ROBOT, path), n=5)
    text = (tmp_path / "session.csv.part").read_text()
    (kept / "session.csv.part").write_text(text[:-9])
    whole = recorder.stop()
    assert_same(recover(kept / "session.csv.part"), whole.rows(slice(0, 9)))


CHILD = """
import sys
from pathlib import Path
import numpy as np
import fastrod
from fastrod.link import Measurement
from fastrod.recording import Recorder

recorder = Recorder(fastrod.load_robot("prototype"), Path(sys.argv[1]), extra=["current_1"])
recorder.start(0.0, "killed")
while True:
    k = len(recorder)
    tip = [np.nan] * 3 if k % 7 == 3 else [1e-6 * k, 0.0, 0.07]
    seen = Measurement(t=0.02 * k, dl=[0.0] * 4, ext=[0.0], tip_position=tip, tip_quaternion=[1.0, 0.0, 0.0, 0.0], tension=[1.0] * 4)
    recorder.add(seen, extra={"current_1": float(k)})
    print(len(recorder), flush=True)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL")
def test_a_process_that_is_killed_loses_no_row(tmp_path: Path) -> None:
    path = tmp_path / "session.csv"
    child = subprocess.Popen([sys.executable, "-c", CHILD, str(path)], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    with child:
        while int(child.stdout.readline()) < 100:
            pass
        os.kill(child.pid, signal.SIGKILL)
        told = child.stdout.read().splitlines(keepends=True)
    added = max([100, *(int(line) for line in told if line.endswith("\n"))])
    assert child.returncode == -signal.SIGKILL
    log = recover(path)
    assert len(log) >= added
    k = np.arange(len(log))
    assert_array_equal(log.extra["current_1"], k.astype(float))
    assert_array_equal(log.measured, k % 7 != 3)
    assert_array_equal(log.tip_position[log.measured, 0], 1e-6 * k[log.measured])
    assert_same(log, read_log(path, ROBOT))


def test_each_row_is_one_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(7)
    recorder = Recorder(ROBOT, tmp_path / "session.csv", extra=[f"further_{k}" for k in range(900)])  # a row beyond any buffer
    recorder.start(0.0)
    written: list[int] = []

    class Counted:
        """The file, counting."""

        def __init__(self, file: object) -> None:
            self.file = file

        def __getattr__(self, name: str) -> object:
            return getattr(self.file, name)

        def write(self, data: bytes) -> int:
            written.append(len(data))
            return self.file.write(data)  # type: ignore[attr-defined,no-any-return]

    monkeypatch.setattr(recorder, "_file", Counted(recorder._file))
    for k in range(5):
        recorder.add(reading(0.1 * k, rng), extra={f"further_{j}": rng.normal() for j in range(900)})
        assert len(written) == k + 1
        assert (tmp_path / "session.csv.part").stat().st_size > sum(written)  # and the head
        assert (tmp_path / "session.csv.part").read_bytes().endswith(b"\n")
    assert min(written) > 8192
    assert len(recorder.stop()) == 5


FULL = """
import resource, sys
from pathlib import Path
import fastrod
from fastrod.errors import InputError
from fastrod.link import Measurement
from fastrod.recording import Recorder

recorder = Recorder(fastrod.load_robot("prototype"), Path(sys.argv[1]))
recorder.start(0.0)
def add(k):
    recorder.add(Measurement(t=k, dl=[1e-3 / 3] * 4, ext=[0], tip_position=[0.1 / 3] * 3, tip_quaternion=[1, 0, 0, 0], tension=[1] * 4))
hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
for k in range(10):
    if k in (4, 5):
        resource.setrlimit(resource.RLIMIT_FSIZE, (Path(sys.argv[1] + ".part").stat().st_size + 40, hard))
        try:
            add(k)
        except InputError as error:
            print(error)
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    else:
        add(k)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="resource limits")
def test_a_disk_that_was_full_leaves_whole_rows(tmp_path: Path) -> None:
    path = tmp_path / "session.csv"
    told = subprocess.run([sys.executable, "-c", FULL, str(path)], capture_output=True, text=True, check=True).stdout
    why, where = "session.csv.part cannot be written: File too large", "are in session.csv.part."
    assert told.splitlines() == [f"{why}; {rows} {where}" for rows in ("4 of its 5 rows", "4 of its 6 rows")]
    assert recover(path).t.tolist() == [0.0, 1.0, 2.0, 3.0, 6.0, 7.0, 8.0, 9.0]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_further_columns_and_the_bases_orientation_are_kept(tmp_path: Path, suffix: str) -> None:
    path, kept = tmp_path / f"session{suffix}", tmp_path / "kept"
    kept.mkdir()
    rng = np.random.default_rng(11)
    recorder = Recorder(ROBOT, path, extra=["following error [m]", "never"])
    recorder.start(0.0)
    errors, bases = rng.normal(size=6), rng.normal(size=(6, 4))
    bases /= np.linalg.norm(bases, axis=1)[:, None]
    for k in range(6):
        given = None if k == 2 else {"following error [m]": np.inf if k == 4 else errors[k]}
        recorder.add(reading(0.1 * k, rng), base_quaternion=None if k == 3 else bases[k], extra=given)
    part = (tmp_path / f"{path.name}.part").read_bytes()
    (kept / f"{path.name}.part").write_bytes(part)
    log = recorder.stop()
    expected = np.where(np.isin(np.arange(6), (2, 4)), np.nan, errors)
    assert_array_equal(numbers(log.extra["following error [m]"]), expected)
    assert np.isnan(numbers(log.extra["never"])).all()
    assert log.base_quaternion is not None
    np.testing.assert_allclose(log.base_quaternion[[0, 1, 2, 4, 5]], bases[[0, 1, 2, 4, 5]], rtol=0.0, atol=1e-15)
    assert np.isnan(log.base_quaternion[3]).all()
    assert_same(log, read_log(path, ROBOT))
    assert_same(recover(kept / path.name), log)


def test_an_orientation_that_nobody_gave_is_none(tmp_path: Path) -> None:
    recorder = filled(Recorder(ROBOT, tmp_path / "session.csv", extra=("temperature",)), n=3)
    log = recorder.stop()
    assert log.base_quaternion is None
    assert np.isnan(numbers(log.extra["temperature"])).all()
    assert "base_qw" not in (tmp_path / "session.csv").read_text()


@pytest.mark.parametrize(
    ("names", "sentence"),
    [
        (["a", "a"], "'a' is named twice"),
        (["tension_9"], "'tension_9' is a name that run logs have"),
        (["dl_12"], "for something else"),
        (["base_qx"], "for something else"),
        (["p3_z"], "for something else"),
        (["t"], "for something else"),
        (["a,b"], "is no name"),
        (["a\nb"], "is no name"),
        ([" a"], "is no name"),
        ([""], "is no name"),
        ([3], "is no name"),
        ("current", "give a list of names"),
    ],
)
def test_a_further_column_that_cannot_be_one_is_refused(names: list[str], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        Recorder(ROBOT, extra=names)


def test_a_number_that_cannot_be_kept_is_refused() -> None:
    rng = np.random.default_rng(5)
    recorder = Recorder(ROBOT, extra=["current_1", "current_2"])
    recorder.start(0.0)
    with pytest.raises(InputError, match=r"no column 'curent_1' is recorded; did you mean 'current_1'\?"):
        recorder.add(reading(0.0, rng), extra={"curent_1": 1.0})
    with pytest.raises(InputError, match=r"extra of the reading is .*it must be numbers"):
        recorder.add(reading(0.0, rng), extra={"current_1": "much"})  # type: ignore[dict-item]
    with pytest.raises(InputError, match=r"base_quaternion of the reading has shape \(3,\)"):
        recorder.add(reading(0.0, rng), base_quaternion=(1.0, 0.0, 0.0))
    with pytest.raises(InputError, match="of norm 2; it must be 1"):
        recorder.add(reading(0.0, rng), base_quaternion=(2.0, 0.0, 0.0, 0.0))
    assert len(recorder) == 0


def test_nothing_to_recover_is_said(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"session.csv.part' cannot be recovered: No such file"):
        recover(tmp_path / "session.csv")
    (tmp_path / "empty.csv.part").write_text("t,run,dl_1,tip_x,tip_y,tip_z\n")
    with pytest.raises(LogError, match="no whole row"):
        recover(tmp_path / "empty.csv")
    (tmp_path / "other.csv.part").write_text("a,b\n1,2\n")
    with pytest.raises(LogError, match="no recording: it lacks column t"):
        recover(tmp_path / "other.csv")
    (tmp_path / "other.csv").write_text("t\n")
    with pytest.raises(InputError, match="is there already"):
        recover(tmp_path / "other.csv")


def test_a_failed_end_keeps_the_part(tmp_path: Path) -> None:
    path = tmp_path / "session.csv"
    recorder = filled(Recorder(ROBOT, path), n=5)
    path.mkdir()  # somebody takes the name meanwhile
    with pytest.raises(InputError, match=r"its 10 rows are in session.csv.part"):
        recorder.stop()
    path.rmdir()
    assert len(recover(path)) == 10


def leave(folder: Path) -> None:
    shutil.rmtree(folder)


def rename(folder: Path) -> None:
    folder.rename(folder.with_name("renamed"))


def unlink(folder: Path) -> None:
    (folder / "session.csv.part").unlink()


def replace_part(folder: Path) -> None:
    unlink(folder)
    (folder / "session.csv.part").write_text("another's\n")


def block(folder: Path) -> None:
    leave(folder)
    folder.write_text("a file has its name now")


@pytest.mark.parametrize("at_the_end", [False, True], ids=["while rows come", "before the end"])
@pytest.mark.parametrize(
    ("change", "name"),
    [
        (leave, "logs/session.csv"),
        (rename, "logs/session.csv"),
        (unlink, "logs/session.csv"),
        (replace_part, "logs/session-2.csv"),
        (block, "temporary/session.csv"),
    ],
)
def test_a_log_that_was_removed_or_renamed_is_written_again_with_every_row(
    change: Callable[[Path], None],
    name: str,
    at_the_end: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder, said = tmp_path / "logs", []
    for made in (folder, tmp_path / "temporary"):
        made.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    rng = np.random.default_rng(1)
    recorder = Recorder(ROBOT, folder / "session.csv", on_move=said.append)
    recorder.start(0.0, "one")
    for k in range(20):
        recorder.add(reading(0.1 * k, rng))
    change(folder)
    if not at_the_end:
        recorder.add(reading(2.0, rng))  # the first row after it notices
        part = tmp_path / f"{name}.part"
        assert recorder.path == tmp_path / name
        assert said == [recorder.moved]
        assert "was removed or renamed while it was recorded; all 21 rows are in" in said[0]
        assert repr(str(part)) in said[0]
        assert part.read_text().count("\n") == 23  # with comment and header
        recorder.add(reading(2.1, rng))
        assert part.read_text().count("\n") == 24
        assert len(said) == 1
    log = recorder.stop()
    assert len(log) == (20 if at_the_end else 22)
    assert_same(read_log(tmp_path / name, ROBOT), log)
    assert len(said) == 1
    assert not (tmp_path / f"{name}.part").exists()
    if change is replace_part:
        assert (folder / "session.csv.part").read_text() == "another's\n"


def test_rows_that_no_place_takes_are_in_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "logs"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder / "none"))
    rng = np.random.default_rng(1)
    recorder = Recorder(ROBOT, folder / "session.csv")
    recorder.start(0.0)
    recorder.add(reading(0.0, rng))
    block(folder)
    for k in (1, 2):
        with pytest.raises(InputError, match=rf"was removed .* written: .*; its {k + 1} rows are in no file"):
            recorder.add(reading(float(k), rng))
    with pytest.raises(InputError, match=r"its 3 rows are in no file\."):
        recorder.stop()
    assert not recorder.recording
    folder.unlink()  # there is room for it again
    log = recorder.stop()
    assert len(log) == 3
    assert_same(read_log(folder / "session.csv", ROBOT), log)
    with pytest.raises(InputError, match="nothing is being recorded"):
        recorder.stop()


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_full_disk_keeps_what_it_took_and_nothing_half_written(small_disk: Path, suffix: str) -> None:
    path = small_disk / f"session{suffix}"
    rng = np.random.default_rng(2)
    recorder = Recorder(ROBOT, path)
    recorder.start(0.0)
    recorder.add(reading(0.0, rng))
    fill(small_disk, leave=20_000)
    with pytest.raises(InputError, match="No space left on device") as refused:  # noqa: PT012 - how many fit?
        for k in range(1, 1000):
            recorder.add(reading(0.1 * k, rng))
    n = len(recorder)
    assert 10 < n < 100
    sentence = f"; {n - 1} of its {n} rows are in session{suffix}.part"
    assert f"{sentence}." in str(refused.value)
    with pytest.raises(InputError, match=f"No space left on device{sentence}, see `recover`"):
        recorder.stop()
    assert sorted(file.name for file in small_disk.iterdir()) == ["filler", f"session{suffix}.part"]
    (small_disk / "filler").unlink()
    assert len(recover(path)) == n - 1


def fill(disk: Path, leave: int) -> None:
    """Take all room but about so many bytes."""
    with (disk / "filler").open("wb", buffering=0) as file, suppress(OSError):
        while True:
            file.write(bytes(4096))
    os.truncate(disk / "filler", (disk / "filler").stat().st_size - leave)


def test_without_a_path_rows_stay_in_memory(tmp_path: Path) -> None:
    first, second = (filled(recorder).stop() for recorder in (Recorder(ROBOT), Recorder(ROBOT, tmp_path / "session.csv")))
    assert_same(first, second)
    assert first.name == "session"


def test_no_file_is_overwritten_unasked(tmp_path: Path) -> None:
    path = tmp_path / "session.csv"
    assert free_path(path) == path
    filled(Recorder(ROBOT, path), n=2).stop()
    with pytest.raises(InputError, match=r"is there already, or record to 'session-2.csv'"):
        Recorder(ROBOT, path)
    assert free_path(path) == tmp_path / "session-2.csv"
    (tmp_path / "session-2.csv.part").touch()
    assert free_path(path) == tmp_path / "session-3.csv"
    with pytest.raises(InputError, match="recover it"):
        Recorder(ROBOT, tmp_path / "session-2.csv")
    assert len(filled(Recorder(ROBOT, path, overwrite=True), n=3).stop()) == 6
    assert len(read_log(path, ROBOT)) == 6


@pytest.mark.parametrize(("name", "sentence"), [("a.txt", "does not end in .csv or .parquet"), ("none/a.csv", "is not there; make it")])
def test_a_path_that_cannot_be_one_is_refused(tmp_path: Path, name: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        Recorder(ROBOT, tmp_path / name)


def test_times_never_run_back_and_no_reading_counts_twice() -> None:
    rng = np.random.default_rng(5)
    recorder = Recorder(ROBOT)
    recorder.start(1.0)
    assert not recorder.add(reading(0.9, rng))  # the robot's newest reading, from before the start
    assert recorder.add(reading(1.1, rng))
    assert not recorder.add(reading(1.1, rng))
    with pytest.raises(InputError, match="clock ran back"):
        recorder.add(reading(1.05, rng))
    assert recorder.stop().t.tolist() == [1.1 - 1.0]


def test_wrong_use_is_said_in_a_sentence(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    recorder = Recorder(ROBOT, tmp_path / "a.csv")
    with pytest.raises(InputError, match="start first"):
        recorder.stop()
    with pytest.raises(InputError, match="start first"):
        recorder.add(reading(0.0, rng))
    recorder.start(0.0, "one")
    with pytest.raises(InputError, match="'one' is recorded already"):
        recorder.start(0.0, "one")
    with pytest.raises(InputError, match="one line"):
        recorder.start(0.0, "a\nb")
    with pytest.raises(InputError, match=r"dl of the reading has shape \(8,\); robot 'prototype' needs \(4,\)"):
        recorder.add(Measurement(t=0, dl=np.zeros(8), ext=[0], tip_position=np.zeros(3), tip_quaternion=[1, 0, 0, 0], tension=np.zeros(8)))
    with pytest.raises(InputError, match=r"tip_force of the reading has shape \(2,\)"):
        recorder.add(reading(0.0, rng), tip_force=(0.0, 0.0))
    with pytest.raises(InputError, match="no reading came in"):
        recorder.stop()
    assert list(tmp_path.iterdir()) == []
