"""The README's first screen does what it says."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def test_the_example_prints_its_output() -> None:
    code, output = re.findall(r"```(?:python)?\n(.*?)```", README, flags=re.S)[:2]
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, "README.md", "exec"), {})
    assert printed.getvalue() == output


def test_ci_runs_the_test_line() -> None:
    lines = re.findall(r"^python3 -m venv.*$", README, flags=re.M)
    assert len(lines) == 2
    ci = (Path(__file__).parents[1] / ".ci" / "run").read_text(encoding="utf-8")
    assert lines[1].replace("pip install", "pip install -q") in ci
