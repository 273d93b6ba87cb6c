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

from fastrod import load_robot
from fastrod.commands import cli
from fastrod.errors import HostError, InputError
from fastrod.generation import Plan, Shapes, Sweep, Trajectories, generate, here, read_plan, shards
from fastrod.generation.plan import PLAN

WORDS = ("generate", "shapes", "--robot", "prototype", "--count", "600", "--shard-rows", "50", "--seed", "3")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small plan, made by one process without trouble."""
    folder = tmp_path_factory.mktemp("whole")
    generate(small(), folder, workers=1)
    return folder


def test_what_is_made_is_reported_and_read_back(whole: Path) -> None:
    again = generate(small(), whole, workers=1)
    assert (again.count, again.rows, again.failed, again.shards, again.made, again.rate) == (
        600,
        600,
        0,
        12,
        0,
        0.0,
    )
    assert rows_of(whole) == list(range(600))
    assert read_plan(whole) == small()
    table = parquet.read_table(whole / "shards")
    metadata = {field.name: field.metadata for field in table.schema}
    assert metadata["tip_x"] == {b"unit": b"m", b"about": b"tip, base frame"}
    assert all(set(entry) == {b"unit", b"about"} for entry in metadata.values())
    first = parquet.read_metadata(whole / "shards" / "shapes-000000.parquet").metadata
    assert first is not None
    assert first[b"fastrod_plan"].decode() == small().hash


def test_two_processes_make_the_same_bits(whole: Path, tmp_path: Path) -> None:
    steps: list[tuple[str, int, int]] = []
    summary = generate(small(), tmp_path, workers=2, progress=lambda *step: steps.append(step))
    assert bits(tmp_path) == bits(whole)
    assert summary.made == 12
    assert steps[0] == ("shapes", 0, 600)
    assert steps[-1] == ("shapes", 600, 600)


def test_a_killed_worker_loses_and_doubles_nothing(whole: Path, tmp_path: Path) -> None:
    killed: list[int] = []

    def kill_one(_: str, done: int, __: int) -> None:
        if done >= 200 and not killed:
            workers = [
                child
                for child in psutil.Process().children()
                if any("spawn_main" in word for word in child.cmdline())
            ]
            workers[0].send_signal(signal.SIGKILL)
            killed.append(workers[0].pid)

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
"""A command that is killed after its second shard, however fast its workers are: it lets them run no more
than a few shards ahead."""


def test_a_killed_command_is_finished_by_the_same_command(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    paths = os.pathsep.join(filter(None, [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH")]))
    words = [sys.executable, "-c", KILLED, str(out)]
    first = subprocess.run(
        words, check=False, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": paths}
    )
    assert first.returncode == -signal.SIGKILL
    workers = [int(pid) for pid in first.stdout.split()]
    assert len(workers) >= 2
    alive = [psutil.Process(pid) for pid in workers if psutil.pid_exists(pid)]
    assert not psutil.wait_procs(alive, timeout=60.0)[1], "workers outlive the command"
    before = set(bits(out))
    assert 2 <= len([name for name in before if name.endswith(".parquet")]) < 12
    command = [sys.executable, "-m", "fastrod.commands.cli", *WORDS, "--out", str(out), "--workers", "2"]
    second = subprocess.run([*command, "--json"], check=True, capture_output=True, text=True)
    report = json.loads(second.stdout)
    assert 0 < report["made"] < 12
    assert report["rows"] == 600
    assert rows_of(out) == list(range(600))
    assert bits(out) == bits(whole)


def test_torn_and_half_written_files_are_made_again(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    files = tmp_path / "shards"
    (files / "shapes-000003.parquet").unlink()
    torn = files / "shapes-000007.parquet"
    torn.write_bytes(torn.read_bytes()[:-100])
    (files / ".shapes-000005.0123.part").write_bytes(b"half")
    summary = generate(small(), tmp_path, workers=1)
    assert (summary.made, summary.made_count, summary.rows) == (2, 100, 600)
    assert bits(tmp_path) == bits(whole)


def test_a_shard_with_a_broken_page_is_made_again(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    broken = tmp_path / "shards" / "shapes-000004.parquet"
    good = broken.read_bytes()
    broken.write_bytes(good[:4] + b"\xff" * 60 + good[64:])  # the first pages; the footer stays
    assert parquet.read_metadata(broken).num_rows == 50
    with pytest.raises(
        InputError,
        match=r"shapes-000004.parquet' cannot be read; remove it, and generate "
        r"again\.$",
    ):
        shards.counted(small(), tmp_path / "shards")
    assert generate(small(), tmp_path, workers=1).made == 1
    assert bits(tmp_path) == bits(whole)


def test_a_data_set_grows_with_its_count(whole: Path, tmp_path: Path) -> None:
    assert generate(small(count=575), tmp_path, workers=1).made == 12
    for name in ("row", "chain", "dl_1", "tip_x"):  # rows that are there stay what they are
        values = [
            parquet.read_table(folder / "shards", columns=[name]).column(name).to_pylist()
            for folder in (tmp_path, whole)
        ]
        assert values[0] == values[1][:575]
    summary = generate(small(count=600), tmp_path, workers=1)
    assert summary.made == 1  # the last one was short
    assert bits(tmp_path) == bits(whole)
    assert read_plan(tmp_path) == small()


@pytest.mark.parametrize(
    ("plan", "difference"),
    [
        (lambda: small(seed=4), "its seed is 3, not 4"),
        (lambda: small(bend=0.5), "its bend is 1.0, not 0.5"),
        (lambda: small(shard_rows=60), "its shard_rows is 50, not 60"),
        (lambda: small(count=599), "its count is 600, not 599"),
        (lambda: replace(small(), version="0.0.1"), "its version is"),
        (
            lambda: replace(
                small(), work=replace(small().work, robot=small().work.robot.replace("0.0022", "0.0023"))
            ),
            "another robot",
        ),
    ],
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


def test_strange_files_are_refused(whole: Path, tmp_path: Path) -> None:
    def refused(name: str) -> str:
        with pytest.raises(InputError) as error:
            generate(small(), tmp_path / name, workers=1)
        return str(error.value)

    for name in ("foreign", "beyond", "other", "planless", "broken"):
        shutil.copytree(whole, tmp_path / name)
    generate(small(seed=9, count=50), tmp_path / "nine", workers=1)
    shutil.copy(
        tmp_path / "nine" / "shards" / "shapes-000000.parquet",
        tmp_path / "foreign" / "shards" / "shapes-000004.parquet",
    )
    shutil.copy(
        whole / "shards" / "shapes-000000.parquet", tmp_path / "beyond" / "shards" / "shapes-000012.parquet"
    )
    (tmp_path / "other" / "shards" / "mine.parquet").write_bytes(b"")
    (tmp_path / "planless" / PLAN).unlink()
    (tmp_path / "broken" / PLAN).write_text('{"kind": "shapes"}')
    assert "shapes-000004.parquet' is a shard of another plan; give --out a folder of its own." in refused(
        "foreign"
    )
    assert "shapes-000012.parquet' is a shard of another plan" in refused("beyond")
    assert "mine.parquet' is no shard of this plan" in refused("other")
    assert "holds Parquet files and no plan.json" in refused("planless")
    assert "plan.json' is no plan of fastrod generate" in refused("broken")
    (tmp_path / "file").write_text("")
    assert refused("file") == f"folder {str(tmp_path / 'file')!r} cannot be written: it is a file."


def test_a_shard_in_the_place_of_another_is_made_again(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    shutil.copy(tmp_path / "shards" / "shapes-000001.parquet", tmp_path / "shards" / "shapes-000002.parquet")
    assert generate(small(), tmp_path, workers=1).made == 1
    assert bits(tmp_path) == bits(whole)


def test_rows_that_are_doubled_are_found(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "shards" / "shapes-000002.parquet"
    table = parquet.read_table(path)
    parquet.write_table(table.take([0, *range(49)]).replace_schema_metadata(table.schema.metadata), path)
    with pytest.raises(
        InputError,
        match=r"shapes-000002.parquet' does not hold each row from 100 to 149 "
        r"once; remove it",
    ):
        generate(small(), tmp_path, workers=1)


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


def test_a_full_disk_leaves_nothing_half(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flushed = os.fsync
    calls: list[int] = []

    def full(descriptor: int) -> None:
        calls.append(descriptor)
        if len(calls) > 3:  # the plan and two shards
            raise OSError(errno.ENOSPC, "No space left on device")
        flushed(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    assert cli.main([*WORDS, "--out", str(tmp_path), "--workers", "1"]) == 1
    path = tmp_path / "shards" / "shapes-000002.parquet"
    assert capsys.readouterr().err == f"{path}: No space left on device.\n"
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
    with pytest.raises(
        HostError,
        match=r"the workers died 3 times without a shard; is there memory enough "
        r"for 2\?",
    ):
        generate(small(), tmp_path, workers=2)
    assert pools == [12, 12, 12]


def test_an_error_of_a_task_is_the_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(*_: Any) -> Any:
        raise InputError("no such shape.")

    monkeypatch.setattr(shards, "write", wrong)
    monkeypatch.setattr("fastrod.generation.tasks.write", wrong)
    with pytest.raises(InputError, match=r"no such shape\."):
        generate(small(), tmp_path, workers=1)
    assert not list(tmp_path.iterdir())


def test_a_disk_that_is_full_for_the_plan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert cli.main([*WORDS, "--out", str(tmp_path / "out"), "--workers", "1"]) == 1
    assert capsys.readouterr().err == f"{tmp_path / 'out' / PLAN}: No space left on device.\n"
    assert not list(tmp_path.iterdir())


def test_leftovers_of_a_plan_are_no_hindrance(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    (tmp_path / f"{PLAN}.12.part").write_text("{")
    (tmp_path / PLAN).write_bytes(b"")
    assert read_plan(tmp_path) is None
    with pytest.raises(InputError, match="is a shard of another plan"):
        generate(small(seed=9), tmp_path, workers=1)
    assert generate(small(), tmp_path, workers=1).made == 0
    assert read_plan(tmp_path) == small()
    assert sorted(path.name for path in tmp_path.iterdir()) == [".lock", PLAN, "shards"]


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


def test_a_run_that_makes_nothing_leaves_the_folder_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wrong(*_: Any) -> Any:
        raise InputError("no such shape.")

    def state(folder: Path) -> dict[str, bytes]:
        return {
            str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b""
            for path in folder.rglob("*")
        }

    grown = tmp_path / "grown"
    generate(small(count=100), grown, workers=1)
    before = state(grown)
    monkeypatch.setattr("fastrod.generation.tasks.write", wrong)
    for folder in (tmp_path / "new" / "deep", grown):
        with pytest.raises(InputError, match=r"no such shape\."):
            generate(small(count=200), folder, workers=1)
    assert not (tmp_path / "new").exists()
    assert state(grown) == before
    monkeypatch.undo()
    assert generate(small(count=100), grown, workers=1).made == 0


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ("--count", "1e6.5"),
            "argument --count: '1e6.5' is not a whole number, such as 1000000 or 1e6; "
            "`fastrod generate shapes --help` says how it is used.\n",
        ),
        (
            ("--count", "0.5"),
            "argument --count: '0.5' is not a whole number, such as 1000000 or 1e6; "
            "`fastrod generate shapes --help` says how it is used.\n",
        ),
        (
            ("--foo",),
            "fastrod generate shapes does not know '--foo'; `fastrod generate shapes --help` lists them.\n",
        ),
        (("--count", "0"), "count is 0; it must be a whole number at least 1 and at most 1e+12.\n"),
        (("--seed", "-1"), "seed is -1; it must be a whole number at least 0 and at most 9.22337e+18.\n"),
        (("--shard-rows", "0"), "--shard-rows is 0; it must be at least 1.\n"),
        (("--workers", "0"), "workers is 0; it must be a whole number at least 1 and at most 4096.\n"),
        (("--force", "-1"), "--force is -1.0 N; it must be zero or positive.\n"),
        (
            ("--robot", "protoype"),
            "no robot 'protoype'; did you mean 'prototype'? A path must end in .toml.\n",
        ),
    ],
)
def test_wrong_words_are_one_sentence(
    words: tuple[str, ...], sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([*WORDS, "--out", str(tmp_path / "out"), *words]) == 2
    assert capsys.readouterr() == ("", sentence)
    assert not list(tmp_path.glob("out/shards/*"))


def test_a_kind_that_is_none_is_answered_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["generate", "shape", *WORDS[2:]]) == 2
    assert capsys.readouterr() == ("", "no data set 'shape' to generate; did you mean 'shapes'?\n")
    assert cli.main(["generate", "xyz"]) == 2
    assert capsys.readouterr() == ("", "no data set 'xyz' to generate; known: rollouts, shapes, sweep.\n")


def test_a_count_may_have_an_exponent(tmp_path: Path) -> None:
    assert cli.main([*WORDS, "--out", str(tmp_path / "out"), "--workers", "1", "--count", "1.5e2"]) == 0
    assert rows_of(tmp_path / "out") == list(range(150))


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda _: Plan(work=3, count=1), "work is 3; give Shapes, Rollouts, Trajectories, Sweep."),
        (
            lambda _: Shapes(robot=5),
            "robot is 5; give the text of a robot file, such as fastrod.model.robotfile.dumps(robot).",
        ),
        (lambda _: Shapes(robot=load_robot("prototype")), "robot is Robot("),
        (
            lambda _: Sweep(robot=small().work.robot, effects="backlash"),
            "effects are 'backlash'; give a tuple of names, such as (",
        ),
        (
            lambda _: Trajectories(robot=small().work.robot, effects=(3,)),
            "effects are (3,); give a tuple of names, such as (",
        ),
        (lambda path: generate(3, path), "plan is 3; give a fastrod.generation.Plan."),
        (lambda _: generate(small(), None), "folder is None; give a path."),
        (
            lambda path: generate(small(), path, ray=True),
            "ray is True; give the address of a cluster, 'auto' for the one here, or",
        ),
    ],
)
def test_wrong_things_are_one_sentence(call: Callable[[Path], Any], sentence: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        call(tmp_path / "out")
    assert str(error.value).startswith(sentence)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


def test_shards_that_are_a_file_are_refused(tmp_path: Path) -> None:
    (tmp_path / "shards").write_text("")
    with pytest.raises(
        InputError,
        match=r"shards' is a file; it must be a folder: remove it, or give --out "
        r"another folder\.$",
    ):
        generate(small(), tmp_path, workers=1)
    assert [path.name for path in tmp_path.iterdir()] == ["shards"]


def test_what_is_not_installed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from importlib import util

    find = util.find_spec
    for missing, words, sentence in (
        ("pyarrow", (), "fastrod generate needs pyarrow: pip install 'fastrod[parquet]'.\n"),
        ("ray", ("--ray", "local"), "fastrod generate --ray needs ray: pip install 'fastrod[ray]'.\n"),
    ):
        monkeypatch.setattr(
            util, "find_spec", lambda name, missing=missing: None if name == missing else find(name)
        )
        assert cli.main([*WORDS, "--out", str(tmp_path / "out"), *words]) == 2
        assert capsys.readouterr().err == sentence
    assert not (tmp_path / "out").exists()


def test_the_command_prints_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        cli.main(
            [
                *WORDS[:4],
                "--count",
                "64",
                "--out",
                str(tmp_path / "out"),
                "--workers",
                "1",
                "--line-density",
                "0.1",
            ]
        )
        == 0
    )
    out, err = capsys.readouterr()
    assert "64, each once" in out
    assert "rows/s" in out
    assert err == ""
    plan = read_plan(tmp_path / "out")
    assert plan is not None
    assert "line_density = 0.1" in plan.work.robot
    values = parquet.read_table(tmp_path / "out" / "shards").column("base_fz").to_numpy()
    assert np.isfinite(values).all()
