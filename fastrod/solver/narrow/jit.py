"""Compilation of kernels for few robots, or for large ones: four lanes in place of sixteen.

A chunk of modes takes as long for one robot as for all its lanes, and sixteen robots of five segments do not
fit into the cache of a core.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from fastrod.kernels import jit

LANES = 4
"""Robots side by side."""

# numba's cache knows functions by their files, which are those of many lanes
entry = partial(jit.entry, folder=jit.own_folder(__file__))


def __getattr__(name: str) -> Any:
    """All else is compiled as for many lanes."""
    return getattr(jit, name)
