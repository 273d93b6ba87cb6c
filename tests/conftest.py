"""Where the shared truth lies."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import pytest
from rods import Table

TRUTH = Path(__file__).parents[2] / "shared" / "truth"


@pytest.fixture(scope="session")
def truth() -> Callable[[str], Table]:
    def read(name: str) -> Table:
        path = TRUTH / name
        if not path.is_file():
            pytest.skip(f"{name} is not beside the project, at ../shared/truth")
        with path.open(newline="") as file:
            return Table(list(csv.DictReader(file)))

    return read
