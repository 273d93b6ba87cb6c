"""The shared truth as a fixture."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path

import numba
import pytest
from cost import Cost, Once
from rods import Table
from truthfiles import rows


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--quick", action="store_true", help="leave out the functions in tests/costs.json")


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Cost(config, Once()), "cost")


# commands that tests run compile at any time, and their stderr is read
os.environ.setdefault("FASTROD_QUIET", "1")


@pytest.fixture(scope="session")
def truth() -> Callable[[str], Table]:
    return lambda name: Table(rows(name))


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of its own with room for 1 MB."""
    if not sys.platform.startswith("linux") or os.geteuid() != 0:
        pytest.skip("a disk that runs full is mounted for this test, which takes Linux and root")
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", disk]
    made = subprocess.run(command, capture_output=True, text=True)
    if made.returncode:
        pytest.skip(f"a disk that runs full cannot be mounted here: {made.stderr.strip()}")
    try:
        yield disk
    finally:
        subprocess.run(["umount", "-l", disk], check=True)


@pytest.fixture(scope="session", autouse=True)
def one_compilation() -> Iterator[None]:
    """Whatever the tests did, the big kernels were compiled once: an array of another layout, or a read-only
    one, costs a user half a minute more."""
    yield
    if numba.config.DISABLE_JIT:
        return
    from fastrod.kernels import batch, contact_batch, press_batch
    from fastrod.kernels.jit import OnThreads
    from fastrod.kernels.rod import cold

    loops = {**vars(batch), **vars(contact_batch)}
    large = {name: loop.one for name, loop in loops.items() if isinstance(loop, OnThreads)}
    large |= {"move_to_inputs": batch.move_to_inputs, "begin": cold.begin}
    for lanes in ("kernels", "solver.narrow"):
        modal = vars(import_module(f"fastrod.{lanes}.modal_batch"))
        large |= {f"{lanes}.{name}": modal[name] for name in ("pass_modes", "derive_modes")}
    large |= {"press_some": press_batch.press_some}
    assert {name: len(one.signatures) for name, one in large.items() if len(one.signatures) > 1} == {}
