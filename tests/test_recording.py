"""The recorder: what is recorded is what is read back, and what a killed session has left is not lost."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import fastrod
from fastrod.errors import InputError, LogError
from fastrod.logs.link import Measurement
from fastrod.logs.reader import read_log
from fastrod.logs.recording import Recorder, free_path, recover

ROBOT = fastrod.load_robot("prototype")
GROUPS = "t run dl tip_position ext tip_quaternion points tip_force payload base_quaternion"


def measured(t, **given):
    """A straight robot at this time, unless given."""
    pose = {"tip_position": (0.0, 0.0, 0.07), "tip_quaternion": (1.0, 0.0, 0.0, 0.0)}
    return Measurement(**({"t": t, "dl": np.zeros(4), "ext": [0.0], "tension": np.zeros(4)} | pose | given))


def reading(t, rng):
    quaternion = rng.normal(size=4)
    return measured(
        t,
        dl=rng.uniform(-0.005, 0.005, ROBOT.n_tendons),
        tip_position=rng.uniform(-0.05, 0.05, 3),
        tip_quaternion=quaternion / np.linalg.norm(quaternion),
        tension=rng.uniform(0.0, 3.0, ROBOT.n_tendons),
    )


def started(path=None, **options):
    """A recorder at work."""
    recorder = Recorder(ROBOT, path, **options)
    recorder.start(0.0)
    return recorder


def filled(recorder, n=200, seed=3):
    """Two runs of `n` rows, the second with a payload."""
    rng = np.random.default_rng(seed)
    for run, payload in (("free", 0.0), ("loaded", 0.02)):
        recorder.start(10.0, run)
        for k in range(n):
            now, commanded = reading(10.0 + 0.02 * k, rng), rng.uniform(-0.005, 0.005, ROBOT.n_tendons)
            recorder.add(now, payload=payload, commanded_dl=commanded)
    return recorder


def assert_same(a, b):
    for name in GROUPS.split():
        one, other = getattr(a, name), getattr(b, name)
        assert (one is None) == (other is None), name
        if one is not None:
            assert_array_equal(one, other, err_msg=name)
    assert sorted(a.extra) == sorted(b.extra)
    for name, cells in a.extra.items():
        assert_array_equal(numbers(cells), numbers(b.extra[name]), err_msg=name)


def numbers(cells):
    """A column of numbers, or of what a CSV has in their place."""
    return np.array([float(cell or "nan") if isinstance(cell, str) else cell for cell in cells])


def names(folder):
    return sorted(file.name for file in folder.iterdir())


@pytest.fixture
def kept(tmp_path):
    """A folder for what a killed session would leave."""
    folder = tmp_path / "kept"
    folder.mkdir()
    return folder


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_recording_reads_back_bit_for_bit(tmp_path, suffix):
    path = tmp_path / f"session{suffix}"
    recorder = filled(Recorder(ROBOT, path))
    assert (recorder.recording, len(recorder)) == (True, 400)
    log = recorder.stop()
    assert not recorder.recording
    assert_same(log, read_log(path, ROBOT))
    assert names(tmp_path) == [path.name]
    assert log.runs == ["free", "loaded"]
    assert log.measured.all()
    assert log.payload is not None
    assert log.tip_force is None  # none was ever given
    assert log.ext is None  # this robot does not extend
    assert_array_equal(log.t[:2], [0.0, 10.02 - 10.0])
    assert sorted(log.extra) == [f"{what}_{k}" for what in ("cmd_dl", "tension") for k in range(1, 5)]


def test_what_is_missing_stays_missing(tmp_path):
    path = tmp_path / "session.csv"
    recorder, none = started(path), {"tip_quaternion": [np.nan] * 4, "tension": [np.inf] * 4}
    for k in range(3):
        tip = [np.nan] * 3 if k == 1 else [0.0, 0.0, 0.07]
        force = (0.1, 0.0, 0.0) if k == 2 else None
        recorder.add(measured(k, tip_position=tip, **none), tip_force=force)
    log = recorder.stop()
    assert_same(log, read_log(path, ROBOT))
    assert log.measured.tolist() == [True, False, True]
    assert log.tip_quaternion is None
    assert log.extra == {}  # no tension was finite and nothing was commanded
    assert_array_equal(log.tip_force, [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    assert log.runs == [""]


def test_a_robot_that_extends_has_its_extension_recorded(tmp_path):
    longer = replace(ROBOT, segments=(replace(ROBOT.segments[0], extension=(0.0, 0.02)),))
    recorder = Recorder(longer, tmp_path / "session.csv")
    recorder.start(0.0)
    recorder.add(measured(0.0, ext=[0.01], tip_position=[0.0, 0.0, 0.08]))
    log = recorder.stop()
    assert_array_equal(log.ext, [[0.01]])
    assert_same(log, read_log(tmp_path / "session.csv", longer))


def test_a_killed_session_is_recovered_row_by_row(tmp_path, kept):
    recorder = filled(Recorder(ROBOT, tmp_path / "session.csv"))
    shutil.copy(tmp_path / "session.csv.part", kept)  # as it lies there while rows still come
    whole = recorder.stop()
    log = recover(kept / "session.csv")
    assert_same(log, whole)
    assert_same(log, read_log(kept / "session.csv", ROBOT))
    assert not (kept / "session.csv.part").exists()


def test_a_row_cut_short_is_left_out(tmp_path, kept):
    recorder = filled(Recorder(ROBOT, tmp_path / "session.csv"), n=5)
    (kept / "session.csv.part").write_text((tmp_path / "session.csv.part").read_text()[:-9])
    whole = recorder.stop()
    assert_same(recover(kept / "session.csv.part"), whole.rows(slice(0, 9)))


HEAD = """
import sys
from pathlib import Path
import numpy as np
import fastrod
from fastrod.errors import InputError
from fastrod.logs.link import Measurement
from fastrod.logs.recording import Recorder

recorder = Recorder(fastrod.load_robot("prototype"), Path(sys.argv[1]), extra=["current_1"])
recorder.start(0.0)
def add(k, tip):
    moved = dict(dl=[1e-3 / 3] * 4, ext=[0.0], tension=[1.0] * 4)
    seen = Measurement(t=k, tip_position=tip, tip_quaternion=[1.0, 0.0, 0.0, 0.0], **moved)
    recorder.add(seen, extra={"current_1": float(k)})
"""
KILLED = """
while True:
    k = len(recorder)
    add(k, [np.nan] * 3 if k % 7 == 3 else [1e-6 * k, 0.0, 0.07])
    print(len(recorder), flush=True)
"""
FULL = """
import resource
hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
for k in range(10):
    if k in (4, 5):
        resource.setrlimit(resource.RLIMIT_FSIZE, (Path(sys.argv[1] + ".part").stat().st_size + 40, hard))
        try:
            add(k, [0.1 / 3] * 3)
        except InputError as error:
            print(error)
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    else:
        add(k, [0.1 / 3] * 3)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL")
def test_a_process_that_is_killed_loses_no_row(tmp_path):
    path = tmp_path / "session.csv"
    command = [sys.executable, "-c", HEAD + KILLED, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        while int(child.stdout.readline()) < 100:
            pass
        os.kill(child.pid, signal.SIGKILL)
        said = child.stdout.read().splitlines(keepends=True)
    added = max([100, *(int(line) for line in said if line.endswith("\n"))])
    assert child.returncode == -signal.SIGKILL
    log = recover(path)
    assert len(log) >= added
    k = np.arange(len(log))
    assert_array_equal(log.extra["current_1"], k.astype(float))
    assert_array_equal(log.measured, k % 7 != 3)
    assert_array_equal(log.tip_position[log.measured, 0], 1e-6 * k[log.measured])
    assert_same(log, read_log(path, ROBOT))


@pytest.mark.skipif(sys.platform == "win32", reason="resource limits")
def test_a_disk_that_was_full_leaves_whole_rows(tmp_path):
    path = tmp_path / "session.csv"
    command = [sys.executable, "-c", HEAD + FULL, str(path)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    why, where = "session.csv.part cannot be written: File too large", "are in session.csv.part."
    assert said.splitlines() == [f"{why}; {rows} {where}" for rows in ("4 of its 5 rows", "4 of its 6 rows")]
    assert recover(path).t.tolist() == [0.0, 1.0, 2.0, 3.0, 6.0, 7.0, 8.0, 9.0]


def test_each_row_is_one_write(tmp_path, monkeypatch):
    rng, further, written = np.random.default_rng(7), [f"further_{k}" for k in range(900)], []
    recorder, partial = started(tmp_path / "session.csv", extra=further), tmp_path / "session.csv.part"
    file = recorder._file

    class Counted:
        """The file, counting."""

        def __getattr__(self, name):
            return getattr(file, name)

        def write(self, data):
            written.append(len(data))
            return file.write(data)

    monkeypatch.setattr(recorder, "_file", Counted())
    for k in range(5):
        recorder.add(reading(0.1 * k, rng), extra={name: rng.normal() for name in further})
        assert len(written) == k + 1
        assert partial.stat().st_size > sum(written)  # and the head
        assert partial.read_bytes().endswith(b"\n")
    assert min(written) > 8192  # a row beyond any buffer
    assert len(recorder.stop()) == 5


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_further_columns_and_the_bases_orientation_are_kept(tmp_path, kept, suffix):
    path, rng = tmp_path / f"session{suffix}", np.random.default_rng(11)
    recorder = started(path, extra=["following error [m]", "never"])
    errors, bases = rng.normal(size=6), rng.normal(size=(6, 4))
    bases /= np.linalg.norm(bases, axis=1)[:, None]
    for k in range(6):
        given = None if k == 2 else {"following error [m]": np.inf if k == 4 else errors[k]}
        recorder.add(reading(0.1 * k, rng), base_quaternion=None if k == 3 else bases[k], extra=given)
    shutil.copy(tmp_path / f"{path.name}.part", kept)
    log = recorder.stop()
    expected = np.where(np.isin(np.arange(6), (2, 4)), np.nan, errors)
    assert_array_equal(numbers(log.extra["following error [m]"]), expected)
    assert np.isnan(numbers(log.extra["never"])).all()
    bases[3] = np.nan
    assert_allclose(log.base_quaternion, bases, rtol=0.0, atol=1e-15)
    assert_same(log, read_log(path, ROBOT))
    assert_same(recover(kept / path.name), log)


def test_an_orientation_that_nobody_gave_is_none(tmp_path):
    log = filled(Recorder(ROBOT, tmp_path / "session.csv", extra=("temperature",)), n=3).stop()
    assert log.base_quaternion is None
    assert np.isnan(numbers(log.extra["temperature"])).all()
    assert "base_qw" not in (tmp_path / "session.csv").read_text()


NO_COLUMNS = [
    (["a", "a"], "'a' is named twice"),
    (["tension_9"], "'tension_9' is a name that run logs have"),
    *(([name], "for something else") for name in ("dl_12", "base_qx", "p3_z", "t")),
    *(([name], "is no name") for name in ("a,b", "a\nb", " a", "", 3)),
    ("current", "give a list of names"),
]


@pytest.mark.parametrize(("columns", "sentence"), NO_COLUMNS)
def test_a_further_column_that_cannot_be_one_is_refused(columns, sentence):
    with pytest.raises(InputError, match=sentence):
        Recorder(ROBOT, extra=columns)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"extra": {"curent_1": 1.0}}, r"no column 'curent_1' is recorded; did you mean 'current_1'\?"),
        ({"extra": {"current_1": "much"}}, r"extra of the reading is .*it must be numbers"),
        ({"base_quaternion": (1.0, 0.0, 0.0)}, r"base_quaternion of the reading has shape \(3,\)"),
        ({"base_quaternion": (2.0, 0.0, 0.0, 0.0)}, "of norm 2; it must be 1"),
    ],
)
def test_a_number_that_cannot_be_kept_is_refused(given, sentence):
    recorder = started(extra=["current_1", "current_2"])
    with pytest.raises(InputError, match=sentence):
        recorder.add(measured(0.0), **given)
    assert len(recorder) == 0


def test_nothing_to_recover_is_said(tmp_path):
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


def test_a_failed_end_keeps_the_partial_file(tmp_path):
    path = tmp_path / "session.csv"
    recorder = filled(Recorder(ROBOT, path), n=5)
    path.mkdir()  # somebody takes the name meanwhile
    with pytest.raises(InputError, match=r"its 10 rows are in session.csv.part"):
        recorder.stop()
    path.rmdir()
    assert len(recover(path)) == 10


def unlink(folder):
    (folder / "session.csv.part").unlink()


def replace_partial(folder):
    unlink(folder)
    (folder / "session.csv.part").write_text("another's\n")


def block(folder):
    shutil.rmtree(folder)
    folder.write_text("a file has its name now")


CHANGES = {
    "removed": (shutil.rmtree, "logs/session.csv"),
    "renamed": (lambda folder: folder.rename(folder.with_name("renamed")), "logs/session.csv"),
    "file removed": (unlink, "logs/session.csv"),
    "file replaced": (replace_partial, "logs/session-2.csv"),
    "blocked": (block, "temporary/session.csv"),
}


@pytest.mark.parametrize("at_the_end", [False, True], ids=["while rows come", "before the end"])
@pytest.mark.parametrize("change", CHANGES)
def test_a_log_that_was_removed_or_renamed_is_written_again_with_every_row(
    change, at_the_end, tmp_path, monkeypatch
):
    (do, name), folder, said = CHANGES[change], tmp_path / "logs", []
    for made in (folder, tmp_path / "temporary"):
        made.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    rng, partial = np.random.default_rng(1), tmp_path / f"{name}.part"
    recorder = Recorder(ROBOT, folder / "session.csv", on_move=said.append)
    recorder.start(0.0, "one")
    for k in range(20):
        recorder.add(reading(0.1 * k, rng))
    do(folder)
    if not at_the_end:
        recorder.add(reading(2.0, rng))  # the first row after it notices
        assert (recorder.path, said) == (tmp_path / name, [recorder.moved])
        assert "was removed or renamed while it was recorded; all 21 rows are in" in said[0]
        assert repr(str(partial)) in said[0]
        assert partial.read_text().count("\n") == 23  # with comment and header
        recorder.add(reading(2.1, rng))
        assert partial.read_text().count("\n") == 24
        assert len(said) == 1
    log = recorder.stop()
    assert len(log) == (20 if at_the_end else 22)
    assert_same(read_log(tmp_path / name, ROBOT), log)
    assert len(said) == 1
    assert not partial.exists()
    if change == "file replaced":
        assert (folder / "session.csv.part").read_text() == "another's\n"


def test_rows_that_no_place_takes_are_in_no_file(tmp_path, monkeypatch):
    folder = tmp_path / "logs"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder / "none"))
    recorder = started(folder / "session.csv")
    recorder.add(measured(0.0))
    block(folder)
    for k in (1, 2):
        with pytest.raises(InputError, match=rf"was removed .* written: .*; its {k + 1} rows are in no file"):
            recorder.add(measured(float(k)))
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
def test_a_full_disk_keeps_what_it_took_and_nothing_half_written(small_disk, suffix):
    path, rng = small_disk / f"session{suffix}", np.random.default_rng(2)
    recorder = started(path)
    recorder.add(reading(0.0, rng))
    filler = small_disk / "filler"  # takes all room but about 20 kB
    with filler.open("wb", buffering=0) as file, suppress(OSError):
        while True:
            file.write(bytes(4096))
    os.truncate(filler, filler.stat().st_size - 20_000)
    with pytest.raises(InputError, match="No space left on device") as refused:  # noqa: PT012 - how many fit?
        for k in range(1, 1000):
            recorder.add(reading(0.1 * k, rng))
    n = len(recorder)
    assert 10 < n < 100
    sentence = f"; {n - 1} of its {n} rows are in session{suffix}.part"
    assert f"{sentence}." in str(refused.value)
    with pytest.raises(InputError, match=f"No space left on device{sentence}, see `recover`"):
        recorder.stop()
    assert names(small_disk) == ["filler", f"session{suffix}.part"]
    filler.unlink()
    assert len(recover(path)) == n - 1


def test_without_a_path_rows_stay_in_memory(tmp_path):
    first, second = (filled(Recorder(ROBOT, path)).stop() for path in (None, tmp_path / "session.csv"))
    assert_same(first, second)
    assert first.name == "session"


def test_no_file_is_overwritten_unrequested(tmp_path):
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


@pytest.mark.parametrize(
    ("name", "sentence"),
    [("a.txt", "does not end in .csv or .parquet"), ("none/a.csv", "is not there; make it")],
)
def test_a_path_that_cannot_be_one_is_refused(tmp_path, name, sentence):
    with pytest.raises(InputError, match=sentence):
        Recorder(ROBOT, tmp_path / name)


def test_times_never_run_back_and_no_reading_counts_twice():
    recorder = Recorder(ROBOT)
    recorder.start(1.0)
    # the robot's newest reading, from before the start, and the same reading twice
    assert [recorder.add(measured(t)) for t in (0.9, 1.1, 1.1)] == [False, True, False]
    with pytest.raises(InputError, match="clock ran back"):
        recorder.add(measured(1.05))
    assert recorder.stop().t.tolist() == [1.1 - 1.0]


def test_wrong_use_is_said_in_a_sentence(tmp_path):
    recorder = Recorder(ROBOT, tmp_path / "a.csv")
    with pytest.raises(InputError, match="start first"):
        recorder.stop()
    with pytest.raises(InputError, match="start first"):
        recorder.add(measured(0.0))
    recorder.start(0.0, "one")
    eight = measured(0, dl=np.zeros(8), tension=np.zeros(8), tip_position=np.zeros(3))
    wrong = [
        (lambda: recorder.start(0.0, "one"), "'one' is recorded already"),
        (lambda: recorder.start(0.0, "a\nb"), "one line"),
        (lambda: recorder.add(eight), r"dl of the reading has shape \(8,\); robot 'prototype' needs \(4,\)"),
        (
            lambda: recorder.add(measured(0.0), tip_force=(0.0, 0.0)),
            r"tip_force of the reading has shape \(2,\)",
        ),
        (recorder.stop, "no reading came in"),
    ]
    for call, sentence in wrong:
        with pytest.raises(InputError, match=sentence):
            call()
    assert list(tmp_path.iterdir()) == []
