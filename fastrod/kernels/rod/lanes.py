"""Numbers of LANES robots side by side, by name.

A buffer is one-dimensional, field f of lane w at f * LANES + w; the offsets that name fields stand where a
buffer's meaning does. A `LaneMatrix` holds a matrix for each lane.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fastrod.types import Floats

from ..jit import LANES, inline, kernel
from ..vec import Mat, Vec

W = LANES
BLOCK = 4
"""Entries of a vector over unknowns that one loop over lanes takes together."""
Lanes = Any  # a one-dimensional float64 array; numba's types are not mypy's


index = np.uint64
"""A place that is never negative: numba asks of a signed one whether it counts from the end, and a loop over
lanes with that question in it does not become SIMD code."""


class LaneMatrix(NamedTuple):
    """A matrix of every lane, row by row."""

    entries: Lanes
    n_columns: int


@inline
def read(a: Lanes, field: int, w: int) -> float:
    """The number of lane w in a field."""
    return a[index(field * W + w)]  # type: ignore[no-any-return]


@inline
def write(a: Lanes, field: int, w: int, value: float) -> None:
    """a[field] = value in lane w."""
    a[index(field * W + w)] = value


@inline
def at(m: LaneMatrix, r: int, c: int, w: int) -> float:
    """Entry (r, c) of lane w."""
    return m.entries[index((r * m.n_columns + c) * W + w)]  # type: ignore[no-any-return]


@inline
def write_at(m: LaneMatrix, r: int, c: int, w: int, value: float) -> None:
    """m[r, c] = value in lane w."""
    m.entries[index((r * m.n_columns + c) * W + w)] = value


@inline
def take(a: Lanes, first: int, n: int) -> tuple[Lanes, int]:
    """n fields of a buffer, and the field behind them."""
    return a[first * W : (first + n) * W], first + n


@inline
def get(a: Lanes, field: int, w: int) -> Vec:
    """The vector of lane w that begins at a field."""
    return a[index(field * W + w)], a[index((field + 1) * W + w)], a[index((field + 2) * W + w)]


@inline
def put(a: Lanes, field: int, w: int, v: Vec) -> None:
    """a[field : field + 3] = v in lane w."""
    a[index(field * W + w)] = v[0]
    a[index((field + 1) * W + w)] = v[1]
    a[index((field + 2) * W + w)] = v[2]


@inline
def get_mat(a: Lanes, field: int, w: int) -> Mat:
    """The matrix of lane w that begins at a field, row by row."""
    x, y, z = get(a, field, w), get(a, field + 3, w), get(a, field + 6, w)
    return x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]


@inline
def put_mat(a: Lanes, field: int, w: int, m: Mat) -> None:
    """a[field : field + 9] = M in lane w, row by row."""
    put(a, field, w, (m[0], m[1], m[2]))
    put(a, field + 3, w, (m[3], m[4], m[5]))
    put(a, field + 6, w, (m[6], m[7], m[8]))


@kernel
def clear(a: Lanes) -> None:
    """Zero everywhere."""
    for i in range(len(a)):
        a[i] = 0.0


@kernel
def add_two(to: Lanes, field: int, a: float, x: Lanes, b: float, y: Lanes) -> None:
    """to[field] += a x + b y, of one field."""
    out = to[field * W : (field + 1) * W]
    for w in range(len(out)):  # were their number known here, LLVM would unroll them, and lose the SIMD code
        out[w] += a * x[w] + b * y[w]


@kernel
def add_product(to: Lanes, field: int, x: Lanes, y: Lanes) -> None:
    """to[field] += x y, of one field."""
    out = to[field * W : (field + 1) * W]
    for w in range(len(out)):
        out[w] += x[w] * y[w]


@kernel
def weighted_sum(to: Lanes, weights: Floats, rows: Lanes, field: int, n: int) -> None:
    """The first n fields of `to` become sum_k weights[k] rows[k] of `weights` (n_rows,) and `rows` (n_rows,
    n_fields * W), of whose fields it takes n from `field` on.

    One long loop: of three fields at once LLVM would unroll sixteen lanes, and lose the SIMD code.
    """
    for i in range(n * W):
        to[i] = 0.0
    for k in range(len(weights)):
        weight, row = weights[k], rows[k, field * W : (field + n) * W]
        for i in range(n * W):
            to[i] += weight * row[i]
