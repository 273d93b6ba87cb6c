"""The shared truth as a fixture."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from rods import Table
from truthfiles import rows


@pytest.fixture(scope="session")
def truth() -> Callable[[str], Table]:
    return lambda name: Table(rows(name))
