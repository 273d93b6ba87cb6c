"""The line on stderr before kernels are compiled: once a process, and not where they are cached."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fastrod.kernels import batch, notice

SCRIPT = """
import numpy as np
from fastrod.kernels.operators import play, relaxation
one = np.zeros((1, 1))
play(np.zeros((1, 1, 1)), np.zeros((1, 3)), one, one)
relaxation(np.zeros((1, 1, 1)), np.zeros((1, 2)), one, one + 1.0, np.ones(1))
print("done")
"""
"""Two small kernels."""
LINE = "Compiling kernels, about 30 s, "


def said(folder: Path | str, **environment: str) -> str:
    """Stderr of the script with its cache in `folder`."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("FASTROD_", "XDG_"))}
    there = kept | {"FASTROD_CACHE_DIR": str(folder), **environment}
    words = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(words, env=there, check=True, capture_output=True, text=True)
    assert done.stdout == "done\n"
    return done.stderr


def test_a_compilation_says_so_once_and_a_cached_kernel_says_nothing(tmp_path: Path) -> None:
    assert said(tmp_path) == f"{LINE}once.\n"
    assert said(tmp_path) == ""


def test_it_is_silent_on_request(tmp_path: Path) -> None:
    assert said(tmp_path, FASTROD_QUIET="1") == ""


class Compilation:
    """What numba says of one."""

    def __init__(self, function: object) -> None:
        self.data = {"dispatcher": self}
        self.py_func = function


@pytest.mark.parametrize(
    ("cached", "how_often"),
    [
        (True, "once"),
        (False, "in each process, for no cache folder can be written (FASTROD_CACHE_DIR names one)"),
    ],
)
def test_the_kernels_of_contact_have_a_line_of_their_own(
    cached: bool, how_often: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FASTROD_QUIET", raising=False)
    listener = notice._Notice(cached)
    for name in (*notice._CONTACT, "pass_serial", "iterate_serial"):
        listener.on_start(Compilation(getattr(batch, name).py_func))
    listener.on_start(Compilation(os.getenv))  # somebody else's
    lines = (f"Compiling contact kernels, about two minutes, {how_often}.", f"{LINE}{how_often}.")
    assert capsys.readouterr().err.splitlines() == list(lines)
