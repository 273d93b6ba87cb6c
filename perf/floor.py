"""The arithmetic floor: fused multiply-adds in registers, lanes side by side, compiled as the kernels are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from fastrod.kernels.jit import LANES, entry, inline
from report import best

W = LANES
CHAINS, LINKS = 8, 16
"""Independent sums of a lane, enough to hide the latency of an addition; multiply-adds between load and
store."""


@inline
def _link(a: Any, b: Any, x: Any) -> Any:
    y = a * x[0] + b, a * x[1] + b, a * x[2] + b, a * x[3] + b
    return (*y, a * x[4] + b, a * x[5] + b, a * x[6] + b, a * x[7] + b)


@inline
def _four(a: Any, b: Any, x: Any) -> Any:
    return _link(a, b, _link(a, b, _link(a, b, _link(a, b, x))))


@inline
def _over(a: Any, x: Any) -> Any:
    return a / x[0], a / x[1], a / x[2], a / x[3], a / x[4], a / x[5], a / x[6], a / x[7]


@inline
def _load(y: Any, w: int) -> Any:
    x = y[w], y[W + w], y[2 * W + w], y[3 * W + w]
    return (*x, y[4 * W + w], y[5 * W + w], y[6 * W + w], y[7 * W + w])


@inline
def _store(y: Any, w: int, x: Any) -> None:
    y[w], y[W + w], y[2 * W + w], y[3 * W + w] = x[0], x[1], x[2], x[3]
    y[4 * W + w], y[5 * W + w], y[6 * W + w], y[7 * W + w] = x[4], x[5], x[6], x[7]


@entry
def _multiply_add(y: Any, repeats: int) -> None:
    for _ in range(repeats):
        for w in range(W):
            a, b = y[8 * W + w], y[9 * W + w]
            _store(y, w, _four(a, b, _four(a, b, _four(a, b, _four(a, b, _load(y, w))))))


@entry
def _divide(y: Any, repeats: int) -> None:
    for _ in range(repeats):
        for w in range(W):
            a = y[8 * W + w]
            _store(y, w, _over(a, _over(a, _load(y, w))))


def fused_multiply_adds() -> float:
    """Fused multiply-adds of one number each a second, double precision, on one thread."""
    return _rate(_multiply_add, CHAINS * LINKS)


def divisions() -> float:
    """Divisions of one number each a second, double precision, on one thread."""
    return _rate(_divide, CHAINS * 2)


def _rate(run: Callable[[Any, int], None], operations: int, repeats: int = 2_000, rounds: int = 40) -> float:
    """Operations a second of a kernel that does `operations` a lane and repeat; best of `rounds`."""
    buffer = np.full((CHAINS + 2) * W, 0.5)
    run(buffer, 1)
    return repeats * W * operations / best(lambda: run(buffer, repeats), rounds)
