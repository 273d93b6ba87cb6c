"""The observer: gain and boundary update, LANES robots side by side (the paper's eqs. 5 and 12 corrected).

    P- = P + Q dt;  G = P- Gamma^T (Gamma P- Gamma^T + V^-1/dt)^-1;  x -= G e;  P = (I - G Gamma) P-

The rows of Gamma are taken one after the other, as a Kalman filter takes measurements with independent noise:
the same G and P to rounding, with divisions by a number in place of a matrix, and sound where Gamma has more
rows than rank (four tendons on two unknowns in paper mode) or a nearly singular direction (tendons that
hardly stretch).

Vectors over unknowns are padded with zeros to a multiple of BLOCK entries, so that one loop over lanes does
BLOCK multiply-adds.
"""

from __future__ import annotations

from ..jit import kernel
from .lanes import LaneMatrix, Lanes, W

BLOCK = 4


@kernel
def dot_block(out: Lanes, a: Lanes, b: Lanes) -> None:
    """out += a . b over one block."""
    for w in range(W):
        out[w] += (
            a[w] * b[w] + a[W + w] * b[W + w] + a[2 * W + w] * b[2 * W + w] + a[3 * W + w] * b[3 * W + w]
        )


@kernel
def subtract_block(a: Lanes, b: Lanes, k: Lanes) -> None:
    """a -= b k over one block; k is a number for each lane."""
    for w in range(W):
        a[w] -= b[w] * k[w]
        a[W + w] -= b[W + w] * k[w]
        a[2 * W + w] -= b[2 * W + w] * k[w]
        a[3 * W + w] -= b[3 * W + w] * k[w]


@kernel
def scale_block(a: Lanes, b: Lanes, k: Lanes) -> None:
    """a = b k over one block."""
    for w in range(W):
        a[w] = b[w] * k[w]
        a[W + w] = b[W + w] * k[w]
        a[2 * W + w] = b[2 * W + w] * k[w]
        a[3 * W + w] = b[3 * W + w] * k[w]


@kernel
def gain(
    P: LaneMatrix, G: LaneMatrix, gamma: LaneMatrix, vector: Lanes, n_x: int, n_e: int, noise: float
) -> None:
    """P- to P in place, and G (transposed), from the rows of Gamma and the variance V^-1/dt of one residual.

    All three matrices have n_p columns; `vector` holds n_p + 2 numbers a lane.
    """
    n_p, p, g, rows = P.n_columns, P.entries, G.entries, gamma.entries
    row, block = n_p * W, BLOCK * W
    number, inverse = vector[row : row + W], vector[row + W : row + 2 * W]
    for i in range(n_e):
        g_i = rows[i * row : (i + 1) * row]
        for a in range(n_x):
            out = vector[a * W : (a + 1) * W]
            for w in range(W):
                out[w] = 0.0
            for b in range(0, row, block):
                dot_block(out, p[a * row + b : a * row + b + block], g_i[b : b + block])
        for w in range(W):
            number[w] = noise
        for b in range(0, row, block):
            dot_block(number, vector[b : b + block], g_i[b : b + block])
        for w in range(W):
            # rounding may take P a little below zero where nothing is left to learn
            inverse[w] = 1.0 / max(number[w], noise)
        k_i = g[i * row : (i + 1) * row]
        for b in range(0, row, block):
            scale_block(k_i[b : b + block], vector[b : b + block], inverse)
        for a in range(n_x):
            for b in range(0, row, block):
                subtract_block(
                    p[a * row + b : a * row + b + block], vector[b : b + block], k_i[a * W : (a + 1) * W]
                )
        for j in range(i):
            k_j = g[j * row : (j + 1) * row]
            for w in range(W):
                number[w] = 0.0
            for b in range(0, row, block):
                dot_block(number, k_j[b : b + block], g_i[b : b + block])
            for b in range(0, row, block):
                subtract_block(k_j[b : b + block], k_i[b : b + block], number)
