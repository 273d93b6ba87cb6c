"""Symmetric positive definite systems, LANES of them side by side."""

from __future__ import annotations

import math

from ...jit import kernel
from ..lanes import LaneMatrix, Lanes, W

PIVOT = 1e-9
"""Smallest pivot, as a fraction of a diagonal entry: a pivot below it is none, and the diagonal stands for
it. Without that, heavy upright five-segment robots ended in NaN one step after an impact (BDF2 and
generalized-alpha at 1 ms)."""


@kernel
def subtract_products(to: Lanes, x: Lanes, y: Lanes, n: int) -> None:
    """to -= sum of x_k y_k, four at a time: `to` is read and written a quarter as often."""
    for k in range(0, n - 3, 4):
        u, v = x[k * W : (k + 4) * W], y[k * W : (k + 4) * W]
        for w in range(len(to)):  # W of them (`lanes.add_two`)
            four = u[w] * v[w] + u[W + w] * v[W + w]
            four += u[2 * W + w] * v[2 * W + w] + u[3 * W + w] * v[3 * W + w]
            to[w] -= four
    for k in range(n - n % 4, n):
        u, v = x[k * W :], y[k * W :]
        for w in range(len(to)):
            to[w] -= u[w] * v[w]


@kernel
def factor(m: LaneMatrix, replaced: Lanes) -> None:
    """L of M = L L^T in place of the lower triangle, the inverse of its diagonal on the diagonal; `replaced`
    (2,) counts the pivots for which a diagonal entry had to stand; its second row is room for one."""
    a, n = m.entries, m.n_columns
    row = n * W
    for w in range(W):
        replaced[w] = 0.0
    for j in range(n):
        pivot = a[j * row + j * W : j * row + (j + 1) * W]
        for w in range(W):
            replaced[W + w] = abs(pivot[w])
        subtract_products(pivot, a[j * row :], a[j * row :], j)
        for w in range(W):
            whole, left = replaced[W + w], pivot[w]
            bad = not left > PIVOT * whole
            replaced[w] += 1.0 if bad else 0.0
            pivot[w] = 1.0 / math.sqrt(max(whole, 1e-300) if bad else left)
        for i in range(j + 1, n):
            to = a[i * row + j * W : i * row + (j + 1) * W]
            subtract_products(to, a[i * row :], a[j * row :], j)
            for w in range(len(to)):
                to[w] *= pivot[w]


@kernel
def solve(m: LaneMatrix, x: Lanes) -> None:
    """x = M^-1 x, M by `factor`."""
    forward(m, x)
    backward(m, x)


@kernel
def forward(m: LaneMatrix, x: Lanes) -> None:
    """x = L^-1 x."""
    a, n = m.entries, m.n_columns
    row = n * W
    for i in range(n):
        to = x[i * W : (i + 1) * W]
        for k in range(i):
            left, right = a[i * row + k * W :], x[k * W :]
            for w in range(len(to)):
                to[w] -= left[w] * right[w]
        for w in range(W):
            to[w] *= a[i * row + i * W + w]


@kernel
def backward(m: LaneMatrix, x: Lanes) -> None:
    """x = L^-T x."""
    a, n = m.entries, m.n_columns
    row = n * W
    for step in range(n):
        i = n - 1 - step
        to = x[i * W : (i + 1) * W]
        for k in range(i + 1, n):
            left, right = a[k * row + i * W :], x[k * W :]
            for w in range(len(to)):
                to[w] -= left[w] * right[w]
        for w in range(W):
            to[w] *= a[i * row + i * W + w]
