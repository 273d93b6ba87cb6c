"""The shared reference answers, row by row; what reads them skips where they are missing."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

TRUTH = Path(__file__).parents[2] / "shared" / "truth"


def rows(name: str) -> list[dict[str, str]]:
    """The rows of a truth file, columns by name."""
    path = TRUTH / name
    if not path.is_file():
        pytest.skip(f"{name} is not beside the project, at ../shared/truth")
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def numbers(row: dict[str, str], *names: str) -> np.ndarray:
    """(n_names,) columns of one row."""
    return np.array([float(row[name]) for name in names])
