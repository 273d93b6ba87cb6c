"""The same data set as Ray tasks, on a cluster of this machine's own."""

from __future__ import annotations

import os
import signal
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest
from generation_folders import bits, moving, rows_of, small

from fastrod.errors import HostError, InputError
from fastrod.generation import Plan, generate
from fastrod.generation.tasks import make_shard

ray = pytest.importorskip("ray", reason="ray is not installed: pip install 'fastrod[ray]'")


@pytest.fixture(scope="module", autouse=True)
def _cluster() -> Iterator[None]:
    """One for the module: its start is most of the time."""
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="error")
    yield
    ray.shutdown()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small plan, made here by one process."""
    folder = tmp_path_factory.mktemp("whole")
    generate(small(), folder, workers=1)
    return folder


@pytest.mark.study
@pytest.mark.parametrize("written", [False, True])
def test_a_killed_ray_worker_loses_and_doubles_nothing(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written: bool
) -> None:
    """A worker that kills itself in its sixth shard, before or after writing it."""
    from fastrod.generation import on_ray

    mark = tmp_path / "killed"

    def die_once(plan: Plan, folder: str, index: int) -> tuple[int, ...]:
        made = make_shard(plan, folder, index) if written else None
        if index == 5 and not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return tuple(made or make_shard(plan, folder, index))

    monkeypatch.setattr(on_ray, "_make", die_once)
    summary = generate(small(), tmp_path / "out", ray="auto")
    assert mark.exists()
    assert (summary.rows, summary.made) == (600, 12)
    assert rows_of(tmp_path / "out") == list(range(600))
    assert bits(tmp_path / "out") == bits(whole)
    assert ray.is_initialized()


@pytest.mark.study
def test_ray_goes_on_with_what_processes_began(whole: Path, tmp_path: Path) -> None:
    generate(small(count=200), tmp_path, workers=1)
    summary = generate(small(), tmp_path, ray="auto", workers=1)
    assert (summary.made, summary.rows) == (8, 600)
    assert bits(tmp_path) == bits(whole)


def test_a_moving_rod_is_the_same_on_ray(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    generate(moving(), here, workers=1)
    assert generate(moving(), there, ray="auto").failed == 0
    assert bits(there) == bits(here)


def test_an_error_on_a_worker_is_the_drivers(tmp_path: Path) -> None:
    def gone(_: str, done: int, __: int) -> None:
        if done == 50:
            (tmp_path / "shards").rename(tmp_path / "away")

    with pytest.raises(OSError, match="No such file or directory"):
        generate(small(), tmp_path, ray="auto", workers=1, progress=gone)
    assert not list(tmp_path.glob("*/.*.part"))


def test_a_machine_that_does_not_see_the_folder_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fastrod.generation import on_ray

    elsewhere = str(tmp_path / "elsewhere")

    def write_probe(path: str) -> str:
        return "" if elsewhere else path

    monkeypatch.setattr(on_ray, "_write_probe", write_probe)
    with pytest.raises(
        InputError,
        match=r"machine .* does not see folder .*shards'; give --out a folder that all machines see\.",
    ):
        generate(small(), tmp_path, ray="auto")
    assert bits(tmp_path) == {}


def test_a_folder_that_a_machine_cannot_write_is_named(tmp_path: Path) -> None:
    from fastrod.generation.on_ray import _write_probe

    assert _write_probe(str(tmp_path / "probe")) == ""
    assert _write_probe(str(tmp_path / "missing" / "probe")) == "No such file or directory"
    assert stat.S_ISREG((tmp_path / "probe").stat().st_mode)


@pytest.mark.study
def test_a_cluster_that_does_not_answer_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(**_: object) -> None:
        raise ConnectionError(
            "Could not find any running Ray instance.\nPlease specify the one to connect to."
        )

    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", refuse)
    with pytest.raises(HostError) as error:
        generate(small(), tmp_path, ray="auto")
    assert str(error.value) == (
        "no Ray cluster answers at 'auto': Please specify the one to connect to. Start one with `ray start "
        "--head`, or give --ray local."
    )
    assert not list(tmp_path.iterdir())
    with socket.socket() as taken:  # bound, and nobody listens
        taken.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(HostError, match=rf"no Ray cluster answers at '{address}': .*refused\. Start one"):
            generate(small(), tmp_path / "new", ray=address)
    assert not list(tmp_path.iterdir())
