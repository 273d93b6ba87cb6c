"""How kernels are compiled: one set of flags, and a cache that never goes stale.

numba keys its cache on the one file of the cached function, so an edit in a helper module would give stale
results. The cache directory is therefore named after a hash of every kernel source, of the arrays' names and
of numba's version.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

from .notice import announce

_Function = TypeVar("_Function", bound=Callable[..., Any])
_config: Any = numba.config
_njit: Any = numba.njit  # its type does not know _nrt

LANES = 16
"""Robots that one pass of a kernel's inner loop holds side by side; the loop over them becomes SIMD code."""

# contract: fused multiply-add. arcp: x / 6 is x times 1/6. nsz: x + 0 is x. None of them may assume that NaN
# is absent:
# NaN is how a lost robot is seen.
_FAST = {"arcp", "contract", "nsz"}


def _cache_dir() -> str | None:
    """A writable folder for compiled kernels, or None."""
    digest = hashlib.sha256(numba.__version__.encode())
    here = Path(__file__).parent
    for source in (*sorted(here.rglob("*.py")), here.parent / "types.py"):
        digest.update(source.name.encode() + source.read_bytes())
    name = digest.hexdigest()[:16]
    homes = [
        os.environ.get("FASTROD_CACHE_DIR"),
        os.environ.get("XDG_CACHE_HOME"),
        Path.home() / ".cache",
        tempfile.gettempdir(),
    ]
    for home in homes:
        if not home:
            continue
        folder = Path(home) / "fastrod" / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return str(folder)
        except OSError:
            continue
    return None


CACHE_DIR = _cache_dir()
"""Where compiled kernels are kept, or None."""
announce(cached=CACHE_DIR is not None)


def kernel(function: _Function) -> _Function:
    """Compile `function` as part of the `entry` that calls it.

    Without numba's reference counts: an atomic increment for each array of a NamedTuple at each call cost as
    much as the arithmetic. A kernel may therefore slice arrays but not make them.
    """
    return cast(_Function, _njit(error_model="numpy", fastmath=_FAST, nogil=True, _nrt=False)(function))


def entry(function: _Function) -> _Function:
    """Compile what Python calls, on first call, and keep it across processes where a folder is writable. It
    may make arrays."""
    return _compile(function)


def parallel_entry(function: _Function) -> _Function:
    """As `entry`, with `prange` spread over threads."""
    return _compile(function, parallel=True)


def inline(function: _Function) -> _Function:
    """A helper that LLVM pastes into its caller: a call left in a loop over lanes would keep it from becoming
    SIMD code.

    numba's own inline="always" pastes before typing and compiles three times as long.
    """
    return cast(_Function, _njit(forceinline=True, error_model="numpy", fastmath=_FAST, _nrt=False)(function))


def _compile(function: _Function, **options: bool) -> _Function:
    before = _config.CACHE_DIR
    _config.CACHE_DIR = CACHE_DIR or before
    try:
        made = _njit(cache=CACHE_DIR is not None, error_model="numpy", fastmath=_FAST, nogil=True, **options)(
            function
        )
    finally:
        _config.CACHE_DIR = before
    return cast(_Function, made)
