"""A data set in shards: whole or not there, once each, whatever is killed on the way."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pyarrow.parquet as parquet
import pytest
from generation_folders import bits, rows_of, small

from fastrod.commands import cli
from fastrod.errors import HostError, InputError
from fastrod.generation import Plan, generate, here, read_plan, shards
from fastrod.generation.plan import PLAN

WORDS = "generate shapes --robot prototype --count 600 --shard-rows 50 --seed 3"


def shard(number: int) -> str:
    """Its path in a folder."""
    return f"shards/shapes-{number:06d}.parquet"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small plan, made by one process without trouble."""
    folder = tmp_path_factory.mktemp("whole")
    generate(small(), folder, workers=1)
    return folder


@pytest.fixture
def copy(whole: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(whole, tmp_path / "copy"))


def no_space(*_: Any) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def no_shape(*_: Any) -> None:
    raise InputError("no such shape.")


@pytest.mark.study
def test_what_is_made_is_reported_and_read_back(whole: Path) -> None:
    again = generate(small(), whole, workers=1)
    found = (again.count, again.rows, again.failed, again.shards, again.made, again.rate)
    assert found == (600, 600, 0, 12, 0, 0.0)
    assert rows_of(whole) == list(range(600))
    assert read_plan(whole) == small()
    metadata = {field.name: field.metadata for field in parquet.read_table(whole / "shards").schema}
    assert metadata["tip_x"] == {b"unit": b"m", b"about": b"tip, base frame"}
    assert all(set(entry) == {b"unit", b"about"} for entry in metadata.values())
    first = parquet.read_metadata(whole / shard(0)).metadata
    assert first is not None
    assert first[b"fastrod_plan"].decode() == small().hash


@pytest.mark.study
def test_two_processes_make_the_same_bits(whole: Path, tmp_path: Path) -> None:
    steps: list[tuple[str, int, int]] = []
    summary = generate(small(), tmp_path, workers=2, progress=lambda *step: steps.append(step))
    assert bits(tmp_path) == bits(whole)
    assert summary.made == 12
    assert steps[0] == ("shapes", 0, 600)
    assert steps[-1] == ("shapes", 600, 600)


@pytest.mark.study
def test_a_killed_worker_loses_and_doubles_nothing(whole: Path, tmp_path: Path) -> None:
    killed: list[int] = []

    def kill_one(_: str, done: int, __: int) -> None:
        if done >= 200 and not killed:
            children = psutil.Process().children()
            worker = next(c for c in children if any("spawn_main" in word for word in c.cmdline()))
            worker.send_signal(signal.SIGKILL)
            killed.append(worker.pid)

    summary = generate(small(), tmp_path, workers=2, progress=kill_one)
    assert killed
    assert not psutil.pid_exists(killed[0])
    assert rows_of(tmp_path) == list(range(600))
    assert (summary.rows, summary.made) == (600, 12)
    assert bits(tmp_path) == bits(whole)


KILLED = """
import os, signal, sys
import psutil
from generation_folders import small
from fastrod.generation import generate

def die(_, done, __):
    if done >= 100:
        print(*(child.pid for child in psutil.Process().children(recursive=True)), flush=True)
        os.kill(os.getpid(), signal.SIGKILL)

generate(small(), sys.argv[1], workers=2, progress=die)
"""
"""A command that is killed after its second shard: its workers are but a few shards ahead."""


@pytest.mark.study
def test_a_killed_command_is_finished_by_the_same_command(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    paths = os.pathsep.join(filter(None, [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH")]))
    kill = [sys.executable, "-c", KILLED, str(out)]
    environment = {**os.environ, "PYTHONPATH": paths}
    first = subprocess.run(kill, check=False, stdout=subprocess.PIPE, text=True, env=environment)
    assert first.returncode == -signal.SIGKILL
    workers = [int(pid) for pid in first.stdout.split()]
    assert len(workers) >= 2
    alive = [psutil.Process(pid) for pid in workers if psutil.pid_exists(pid)]
    assert not psutil.wait_procs(alive, timeout=60.0)[1], "workers outlive the command"
    assert 2 <= len([name for name in bits(out) if name.endswith(".parquet")]) < 12
    line = f"-m fastrod.commands.cli {WORDS} --out {out} --workers 2 --json"
    second = subprocess.run([sys.executable, *line.split()], check=True, capture_output=True, text=True)
    report = json.loads(second.stdout)
    assert 0 < report["made"] < 12
    assert report["rows"] == 600
    assert rows_of(out) == list(range(600))
    assert bits(out) == bits(whole)


def test_torn_and_half_written_files_are_made_again(whole: Path, copy: Path) -> None:
    (copy / shard(3)).unlink()
    torn = copy / shard(7)
    torn.write_bytes(torn.read_bytes()[:-100])
    (copy / "shards" / ".shapes-000005.0123.part").write_bytes(b"half")
    summary = generate(small(), copy, workers=1)
    assert (summary.made, summary.made_count, summary.rows) == (2, 100, 600)
    assert bits(copy) == bits(whole)


def test_a_shard_with_a_broken_page_is_made_again(whole: Path, copy: Path) -> None:
    broken = copy / shard(4)
    good = broken.read_bytes()
    broken.write_bytes(good[:4] + b"\xff" * 60 + good[64:])  # the first pages; the footer stays
    assert parquet.read_metadata(broken).num_rows == 50
    sentence = r"shapes-000004.parquet' cannot be read; remove it, and generate again\.$"
    with pytest.raises(InputError, match=sentence):
        shards.counted(small(), copy / "shards")
    assert generate(small(), copy, workers=1).made == 1
    assert bits(copy) == bits(whole)


@pytest.mark.study
def test_a_data_set_grows_with_its_count(whole: Path, tmp_path: Path) -> None:
    assert generate(small(count=575), tmp_path, workers=1).made == 12
    for name in ("row", "chain", "dl_1", "tip_x"):  # rows that are there stay what they are
        folders = (folder / "shards" for folder in (tmp_path, whole))
        mine, all_ = (parquet.read_table(folder, columns=[name])[name].to_pylist() for folder in folders)
        assert mine == all_[:575]
    summary = generate(small(count=600), tmp_path, workers=1)
    assert summary.made == 1  # the last one was short
    assert bits(tmp_path) == bits(whole)
    assert read_plan(tmp_path) == small()


def of_another_robot() -> Plan:
    work = small().work
    return replace(small(), work=replace(work, robot=work.robot.replace("0.0022", "0.0023")))


@pytest.mark.parametrize(
    ("plan", "difference"),
    [
        (lambda: small(seed=4), "its seed is 3, not 4"),
        (lambda: small(bend=0.5), "its bend is 1.0, not 0.5"),
        (lambda: small(shard_rows=60), "its shard_rows is 50, not 60"),
        (lambda: small(count=599), "its count is 600, not 599"),
        (lambda: replace(small(), version="0.0.1"), "its version is"),
        (of_another_robot, "another robot"),
    ],
    ids=["seed", "bend", "shard_rows", "count", "version", "robot"],
)
def test_a_folder_of_another_plan_is_refused(whole: Path, plan: Callable[[], Plan], difference: str) -> None:
    before = bits(whole)
    with pytest.raises(InputError) as error:
        generate(plan(), whole, workers=1)
    assert str(error.value).startswith(f"folder {str(whole)!r} holds another plan: {difference}")
    assert str(error.value).endswith("; give --out another folder.")
    assert bits(whole) == before


def test_a_plan_without_shards_is_replaced(tmp_path: Path) -> None:
    generate(small(count=50), tmp_path, workers=1)
    (tmp_path / "shards" / "shapes-000000.parquet").unlink()
    assert generate(small(count=40, seed=8), tmp_path, workers=1).rows == 40
    assert read_plan(tmp_path) == small(count=40, seed=8)


STRANGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "of another seed": (
        lambda folder: shutil.copy(made_with_seed_9(folder), folder / shard(4)),
        "shapes-000004.parquet' is a shard of another plan; give --out a folder of its own.",
    ),
    "beyond the count": (
        lambda folder: shutil.copy(folder / shard(0), folder / shard(12)),
        "shapes-000012.parquet' is a shard of another plan",
    ),
    "of another name": (
        lambda folder: (folder / "shards" / "mine.parquet").write_bytes(b""),
        "mine.parquet' is no shard of this plan",
    ),
    "without a plan": (lambda folder: (folder / PLAN).unlink(), "holds Parquet files and no plan.json"),
    "with a broken plan": (
        lambda folder: (folder / PLAN).write_text('{"kind": "shapes"}'),
        "plan.json' is no plan of fastrod generate",
    ),
}


def made_with_seed_9(folder: Path) -> Path:
    generate(small(seed=9, count=50), folder.parent / "nine", workers=1)
    return folder.parent / "nine" / shard(0)


@pytest.mark.parametrize("case", STRANGE)
def test_strange_files_are_refused(case: str, copy: Path) -> None:
    spoil, sentence = STRANGE[case]
    spoil(copy)
    with pytest.raises(InputError) as error:
        generate(small(), copy, workers=1)
    assert sentence in str(error.value)


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError) as error:
        generate(small(), tmp_path / "file", workers=1)
    assert str(error.value) == f"folder {str(tmp_path / 'file')!r} cannot be written: it is a file."


def test_a_shard_in_the_place_of_another_is_made_again(whole: Path, copy: Path) -> None:
    shutil.copy(copy / shard(1), copy / shard(2))
    assert generate(small(), copy, workers=1).made == 1
    assert bits(copy) == bits(whole)


def test_rows_that_are_doubled_are_found(copy: Path) -> None:
    table = parquet.read_table(copy / shard(2))
    doubled = table.take([0, *range(49)]).replace_schema_metadata(table.schema.metadata)
    parquet.write_table(doubled, copy / shard(2))
    sentence = r"shapes-000002.parquet' does not hold each row from 100 to 149 once; remove it"
    with pytest.raises(InputError, match=sentence):
        generate(small(), copy, workers=1)


@pytest.mark.study
def test_an_interrupt_leaves_whole_shards_alone(whole: Path, tmp_path: Path) -> None:
    def interrupt(_: str, done: int, __: int) -> None:
        if done >= 150:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(small(), tmp_path, workers=2, progress=interrupt)
    there = bits(tmp_path)
    assert 3 <= len(there) < 12
    assert there.items() <= bits(whole).items()
    assert generate(small(), tmp_path, workers=1).made == 12 - len(there)
    assert bits(tmp_path) == bits(whole)


@pytest.mark.study
def test_a_full_disk_leaves_nothing_half(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flushed = os.fsync
    calls: list[int] = []

    def full(descriptor: int) -> None:
        calls.append(descriptor)
        (no_space if len(calls) > 3 else flushed)(descriptor)  # the plan and two shards

    monkeypatch.setattr(os, "fsync", full)
    assert cli.main(f"{WORDS} --out {tmp_path} --workers 1".split()) == 1
    assert capsys.readouterr().err == f"{tmp_path / shard(2)}: No space left on device.\n"
    assert sorted(bits(tmp_path)) == ["shapes-000000.parquet", "shapes-000001.parquet"]
    monkeypatch.undo()
    assert generate(small(), tmp_path, workers=1).made == 10
    assert bits(tmp_path) == bits(whole)


def test_two_commands_do_not_write_into_one_folder(tmp_path: Path) -> None:
    seen: list[str] = []

    def second(_: str, done: int, __: int) -> None:
        if done == 50:
            with pytest.raises(InputError) as error:
                generate(small(), tmp_path, workers=1)
            seen.append(str(error.value))

    generate(small(count=100), tmp_path, workers=1, progress=second)
    assert seen == [
        f"another fastrod generate writes into {str(tmp_path)!r}; wait for it, or give --out another folder."
    ]


def test_work_that_kills_every_worker_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pools: list[int] = []

    def dying(*given: Any) -> Any:
        pools.append(len(given[2]))
        raise BrokenProcessPool
        yield

    monkeypatch.setattr(here, "_pool", dying)
    sentence = r"the workers died 3 times without a shard; is there memory enough for 2\?"
    with pytest.raises(HostError, match=sentence):
        generate(small(), tmp_path, workers=2)
    assert pools == [12, 12, 12]


def test_an_error_of_a_task_is_the_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shards, "write", no_shape)
    monkeypatch.setattr("fastrod.generation.tasks.write", no_shape)
    with pytest.raises(InputError, match=r"no such shape\."):
        generate(small(), tmp_path, workers=1)
    assert not list(tmp_path.iterdir())


def test_a_disk_that_is_full_for_the_plan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "fsync", no_space)
    assert cli.main(f"{WORDS} --out {tmp_path / 'out'} --workers 1".split()) == 1
    assert capsys.readouterr().err == f"{tmp_path / 'out' / PLAN}: No space left on device.\n"
    assert not list(tmp_path.iterdir())


def test_leftovers_of_a_plan_are_no_hindrance(copy: Path) -> None:
    (copy / f"{PLAN}.12.part").write_text("{")
    (copy / PLAN).write_bytes(b"")
    assert read_plan(copy) is None
    with pytest.raises(InputError, match="is a shard of another plan"):
        generate(small(seed=9), copy, workers=1)
    assert generate(small(), copy, workers=1).made == 0
    assert read_plan(copy) == small()
    assert sorted(path.name for path in copy.iterdir()) == [".lock", PLAN, "shards"]


def test_deaths_are_counted_from_the_last_shard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pools: list[int] = []

    def dying(_: Plan, __: Path, todo: list[int], ___: int) -> Any:
        pools.append(len(todo))
        if len(pools) <= 2:
            yield shards.Shard(todo[0], 50, 50, 0)
        raise BrokenProcessPool

    monkeypatch.setattr(here, "_pool", dying)
    with pytest.raises(HostError, match="died 3 times without a shard"):
        list(here.run_here(small(), tmp_path, range(12), 2))
    assert pools == [12, 11, 10, 10, 10]


def state(folder: Path) -> dict[str, bytes]:
    """Every path below a folder, and what the files hold."""
    paths = {str(path.relative_to(folder)): path for path in folder.rglob("*")}
    return {name: path.read_bytes() if path.is_file() else b"" for name, path in paths.items()}


def test_a_run_that_makes_nothing_leaves_the_folder_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grown = tmp_path / "grown"
    generate(small(count=100), grown, workers=1)
    before = state(grown)
    monkeypatch.setattr("fastrod.generation.tasks.write", no_shape)
    for folder in (tmp_path / "new" / "deep", grown):
        with pytest.raises(InputError, match=r"no such shape\."):
            generate(small(count=200), folder, workers=1)
    assert not (tmp_path / "new").exists()
    assert state(grown) == before
    monkeypatch.undo()
    assert generate(small(count=100), grown, workers=1).made == 0


def test_a_count_may_have_an_exponent(tmp_path: Path) -> None:
    assert cli.main(f"{WORDS} --out {tmp_path / 'out'} --workers 1 --count 1.5e2".split()) == 0
    assert rows_of(tmp_path / "out") == list(range(150))


def test_shards_that_are_a_file_are_refused(tmp_path: Path) -> None:
    (tmp_path / "shards").write_text("")
    sentence = r"shards' is a file; it must be a folder: remove it, or give --out another folder\.$"
    with pytest.raises(InputError, match=sentence):
        generate(small(), tmp_path, workers=1)
    assert [path.name for path in tmp_path.iterdir()] == ["shards"]


@pytest.mark.parametrize(
    ("missing", "words", "sentence"),
    [
        ("pyarrow", "", "fastrod generate needs pyarrow: pip install 'fastrod[parquet]'.\n"),
        ("ray", "--ray local", "fastrod generate --ray needs ray: pip install 'fastrod[ray]'.\n"),
    ],
)
def test_what_is_not_installed_is_named(
    missing: str, words: str, sentence: str, tmp_path: Path, monkeypatch: Any, capsys: Any
) -> None:
    from importlib import util

    find = util.find_spec
    monkeypatch.setattr(util, "find_spec", lambda name: None if name == missing else find(name))
    assert cli.main(f"{WORDS} --out {tmp_path / 'out'} {words}".split()) == 2
    assert capsys.readouterr().err == sentence
    assert not (tmp_path / "out").exists()


def test_the_command_prints_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = f"generate shapes --robot prototype --count 64 --out {tmp_path / 'out'}"
    assert cli.main(f"{line} --workers 1 --line-density 0.1".split()) == 0
    out, err = capsys.readouterr()
    assert "64, each once" in out
    assert "rows/s" in out
    assert err == ""
    plan = read_plan(tmp_path / "out")
    assert plan is not None
    assert "line_density = 0.1" in plan.work.robot
    values = parquet.read_table(tmp_path / "out" / "shards").column("base_fz").to_numpy()
    assert np.isfinite(values).all()
