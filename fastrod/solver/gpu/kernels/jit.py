"""Compilation of kernels for a GPU: as functions of the device, pasted into the one kernel that Python
launches."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba import cuda

from fastrod.kernels.jit import CACHE_DIR

_Function = TypeVar("_Function", bound=Callable[..., Any])
_cuda: Any = cuda
_config: Any = numba.config
SIMULATED = bool(_config.ENABLE_CUDASIM)
"""numba's simulator runs the launched kernel as Python, thread by thread (NUMBA_ENABLE_CUDASIM=1)."""

LANES = 1
"""Robots of a thread."""


def kernel(function: _Function) -> _Function:
    """Compile `function` as part of the kernel that calls it. IEEE numbers, with fused multiply-add: NaN is
    how a lost robot is seen."""
    return function if SIMULATED else cast(_Function, _cuda.jit(device=True)(function))


def inline(function: _Function) -> _Function:
    """A helper that is always pasted into its caller: its tuples stay in registers."""
    return function if SIMULATED else cast(_Function, _cuda.jit(device=True, forceinline=True)(function))


def launched(function: _Function) -> Any:
    """Compile what Python launches, on first launch, and keep it across processes where a folder is
    writable."""
    if SIMULATED:
        return _cuda.jit()(function)
    folder, before = _cache_dir(), _config.CACHE_DIR
    _config.CACHE_DIR = folder or before
    try:
        return _cuda.jit(cache=folder is not None)(function)
    finally:
        _config.CACHE_DIR = before


def _cache_dir() -> str | None:
    """Within the folder of the CPU's kernels, which is named after their sources: one for this file and this
    numba.cuda."""
    if CACHE_DIR is None:
        return None
    digest = hashlib.sha256(str(_cuda.__file__).encode() + Path(__file__).read_bytes()).hexdigest()[:16]
    folder = Path(CACHE_DIR) / f"cuda-{digest}"
    try:
        folder.mkdir(exist_ok=True)
    except OSError:
        return None
    return str(folder)
