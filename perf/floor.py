"""The arithmetic floor: fused multiply-adds in registers, lanes side by side, compiled as the kernels are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from fastrod.kernels.jit import LANES, entry
from report import best

CHAINS = 8  # independent sums of a lane, enough to hide the latency of an addition
ADDS, DIVISIONS = 16, 2  # of a chain between load and store


@entry
def _multiply_add(y: Any, repeats: int) -> None:
    for _ in range(repeats):
        for w in range(LANES):
            a, b, p, q, r, s = y[8, w], y[9, w], y[0, w], y[1, w], y[2, w], y[3, w]
            t, u, v, x = y[4, w], y[5, w], y[6, w], y[7, w]
            for _ in range(ADDS):
                p, q, r, s = a * p + b, a * q + b, a * r + b, a * s + b
                t, u, v, x = a * t + b, a * u + b, a * v + b, a * x + b
            y[0, w], y[1, w], y[2, w], y[3, w], y[4, w], y[5, w], y[6, w], y[7, w] = p, q, r, s, t, u, v, x


@entry
def _divide(y: Any, repeats: int) -> None:
    for _ in range(repeats):
        for w in range(LANES):
            a, p, q, r, s = y[8, w], y[0, w], y[1, w], y[2, w], y[3, w]
            t, u, v, x = y[4, w], y[5, w], y[6, w], y[7, w]
            for _ in range(DIVISIONS):
                p, q, r, s, t, u, v, x = a / p, a / q, a / r, a / s, a / t, a / u, a / v, a / x
            y[0, w], y[1, w], y[2, w], y[3, w], y[4, w], y[5, w], y[6, w], y[7, w] = p, q, r, s, t, u, v, x


def fused_multiply_adds() -> float:
    """Fused multiply-adds of one number each a second, double precision, on one thread."""
    return _rate(_multiply_add, CHAINS * ADDS)


def divisions() -> float:
    """Divisions of one number each a second, double precision, on one thread."""
    return _rate(_divide, CHAINS * DIVISIONS)


def _rate(run: Callable[[Any, int], None], operations: int, repeats: int = 2_000, rounds: int = 40) -> float:
    """Operations a second of a kernel that does `operations` a lane and repeat; best of `rounds`."""
    buffer = np.full((CHAINS + 2, LANES), 0.5)
    run(buffer, 1)
    return repeats * LANES * operations / best(lambda: run(buffer, repeats), rounds)
