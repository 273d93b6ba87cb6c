"""The README's first screen does what it says."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import pytest

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


EXAMPLES = re.findall(r"```python\n(.*?)```\n\n```\n(.*?)```", README, flags=re.S)


@pytest.mark.parametrize(("code", "output"), EXAMPLES, ids=["first screen", "contact", "host", "gymnasium"])
def test_the_example_prints_its_output(code: str, output: str) -> None:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, "README.md", "exec"), {})
    assert printed.getvalue() == output


def test_ci_runs_the_test_line() -> None:
    lines = re.findall(r"^python3 -m venv.*$", README, flags=re.M)
    assert len(lines) == 2
    ci = (Path(__file__).parents[1] / ".ci" / "run").read_text(encoding="utf-8")
    assert lines[1].replace("pip install", "pip install -q") in ci
