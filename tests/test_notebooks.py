"""The notebooks run from start to end."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent.parent / "scenes" / "notebooks"
NOTEBOOKS = sorted(path.stem for path in FOLDER.glob("*.py"))


def test_five_notebooks_are_there() -> None:
    assert NOTEBOOKS == ["contact", "mujoco_rod", "own_log", "own_task", "simulate"]


@pytest.mark.study
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebook_runs(name: str, tmp_path: Path) -> None:
    environment = {**os.environ, "MPLBACKEND": "agg", "FASTROD_QUIET": "1"}
    command = [sys.executable, str(FOLDER / f"{name}.py")]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
