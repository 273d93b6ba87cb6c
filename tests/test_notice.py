"""Notices around a compilation: a line on stderr before the large kernels, once a process and not where
they are cached, and no garbage collection."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fastrod.kernels import batch, contact_batch, jit, modal_batch, press_batch

SCRIPT = """
import numpy as np
from fastrod.kernels import jit
from fastrod.kernels.operators import play, relaxation
jit.SECONDS["play"] = "backlash", 1
one = np.zeros((1, 1))
play(np.zeros((1, 1, 1)), np.zeros((1, 3)), one, one)
relaxation(np.zeros((1, 1, 1)), np.zeros((1, 2)), one, one + 1.0, np.ones(1))
print("done")
"""
"""Two small kernels, one of which counts as large."""
LINE = "Compiling the kernels of backlash, about 1 s, "


def said(folder: Path | str, **environment: str) -> str:
    """Stderr of the script with its cache in `folder`."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("FASTROD_", "XDG_"))}
    there = kept | {"FASTROD_CACHE_DIR": str(folder), **environment}
    words = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(words, env=there, check=True, capture_output=True, text=True)
    assert done.stdout == "done\n"
    return done.stderr


@pytest.mark.study
def test_a_compilation_says_so_once_and_a_cached_kernel_says_nothing(tmp_path: Path) -> None:
    assert said(tmp_path) == f"{LINE}once.\n"
    assert said(tmp_path) == ""


@pytest.mark.study
def test_it_is_silent_on_request(tmp_path: Path) -> None:
    assert said(tmp_path, FASTROD_QUIET="1") == ""


class Compilation:
    """Record of one compilation by numba."""

    def __init__(self, function: object) -> None:
        self.data = {"dispatcher": self}
        self.py_func = function


@pytest.fixture
def listener(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[jit._Around]:
    monkeypatch.delenv("FASTROD_QUIET", raising=False)
    yield jit._Around(getattr(request, "param", True))
    gc.enable()


@pytest.mark.parametrize(
    ("listener", "how_often"),
    [
        (True, "once"),
        (False, "in each process, for no cache folder can be written (FASTROD_CACHE_DIR names one)"),
    ],
    indirect=["listener"],
)
def test_each_group_of_large_kernels_has_one_line(
    listener: jit._Around, how_often: str, capsys: pytest.CaptureFixture[str]
) -> None:
    contact = contact_batch.search_some, press_batch.press_some
    for kernel in (*contact, batch.pass_some, batch.place_all, modal_batch.pass_modes):
        listener.on_start(Compilation(kernel.py_func))  # type: ignore[union-attr]
        listener.on_end(None)
    listener.on_start(Compilation(os.getenv))  # somebody else's
    groups = (jit.SECONDS[name] for name in ("press_some", "pass_some", "pass_modes"))
    lines = [f"Compiling the kernels of {what}, about {seconds} s, {how_often}." for what, seconds in groups]
    assert capsys.readouterr().err.splitlines() == lines


def test_garbage_is_not_collected_until_the_outermost_compilation_ends(listener: jit._Around) -> None:
    for _ in range(2):
        listener.on_start(Compilation(os.getenv))
        assert not gc.isenabled()
    listener.on_end(None)
    assert not gc.isenabled()
    listener.on_end(None)
    assert gc.isenabled()


def test_garbage_is_left_alone_where_the_user_collects_none(listener: jit._Around) -> None:
    gc.disable()
    listener.on_start(Compilation(os.getenv))
    listener.on_end(None)
    assert not gc.isenabled()
