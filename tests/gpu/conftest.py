"""These tests need a GPU, or numba's simulator of one, which numba chooses when it is imported."""

from __future__ import annotations

import pytest
from numba import cuda


@pytest.fixture(autouse=True)
def _device() -> None:
    if not cuda.is_available():
        pytest.skip("no CUDA GPU here; NUMBA_ENABLE_CUDASIM=1 (python tests/check.py gpu) simulates one")
