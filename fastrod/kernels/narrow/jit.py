"""Compilation of kernels for few robots, or for large ones: four lanes in place of sixteen.

A chunk of modes takes as long for one robot as for all its lanes, and sixteen robots of five segments do not
fit into the cache of a core.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from fastrod.kernels import jit
from fastrod.kernels.jit import inline as inline
from fastrod.kernels.jit import kernel as kernel

LANES = 4
"""Robots side by side."""


def _cache_dir() -> str | None:
    """A folder of its own: numba's cache knows functions by their file."""
    if jit.CACHE_DIR is None:
        return None
    folder = Path(jit.CACHE_DIR) / "narrow"
    try:
        folder.mkdir(exist_ok=True)
    except OSError:
        return None
    return str(folder)


entry = partial(jit.entry, folder=_cache_dir())
