"""Tendons along the rod of modes: their path, its derivatives, and their tensions.

At a Gauss point the path grows by |q|, q = v + u x d: d|q|/du = d x t, d|q|/dv = t with t = q / |q|, and the
second derivative by (u, v) is J^T (I - t t^T) J / |q| with dq = J d(u, v). Where the rod is bent about the
tendon itself |q| has a kink, on which Newton's method does not end: it is rounded, sqrt(q^2 + e^2).
"""

from __future__ import annotations

import math

from fastrod.types import Floats, Ints

from ...jit import inline, kernel
from ...vec import Vec, dot, scale
from ..lanes import Lanes, W, add_product, add_two, at, clear, get, put, read, write, write_at
from .fields import I_LOCAL, I_U, I_V, P_L, ModalWork, hessian, path_change
from .modes import ModalBasis

ROUNDED = 5e-4
"""e. At a bend of 0.15 per offset the path is wrong by 2e-8 of its length, a straight one not at all."""


@inline
def growth(u: Vec, v: Vec, x: float, y: float) -> tuple[Vec, float]:
    """q of a tendon at d = (x, y), and |q|^2 + e^2."""
    q = (v[0] - u[2] * y, v[1] + u[2] * x, v[2] + u[0] * y - u[1] * x)
    return q, dot(q, q) + ROUNDED * ROUNDED


@inline
def path(u: Vec, v: Vec, x: float, y: float) -> tuple[float, Vec, float]:
    """|q|, t and 1 / |q|."""
    q, square = growth(u, v, x, y)
    inverse = 1.0 / math.sqrt(square)
    return square * inverse - 0.5 * ROUNDED * ROUNDED, scale(inverse, q), inverse


@inline
def entry(r: int, c: int) -> int:
    """Place of entry (r, c) of a symmetric matrix whose lower triangle is kept row by row."""
    low, high = min(r, c), max(r, c)
    return high * (high + 1) // 2 + low


@kernel
def add_paths(p: int, t: int, b: ModalBasis, work: ModalWork, with_columns: bool) -> None:
    """Add to the length of tendon t, and to its derivatives, what lies in piece p."""
    n_modes, change, offset = b.component.shape[0], work.scratch, work.offset[p, 2 * t * W :]
    n_q = len(work.q) // W
    row = work.path_change[t * n_q * W : (t + 1) * n_q * W]
    for i in range(b.width.shape[0]):
        here, width = work.interval[p, i], 0.5 * b.width[i]
        for g in range(2):
            for w in range(0 if with_columns else W):  # without a division
                half, x, y = width * read(work.piece[p], P_L, w), read(offset, 0, w), read(offset, 1, w)
                _, square = growth(get(here, I_U + 3 * g, w), get(here, I_V + 3 * g, w), x, y)
                size = math.sqrt(square) - 0.5 * ROUNDED * ROUNDED
                write(work.path_length, t, w, read(work.path_length, t, w) + half * size)
            for w in range(W if with_columns else 0):
                half, x, y = width * read(work.piece[p], P_L, w), read(offset, 0, w), read(offset, 1, w)
                size, d, _ = path(get(here, I_U + 3 * g, w), get(here, I_V + 3 * g, w), x, y)
                write(work.path_length, t, w, read(work.path_length, t, w) + half * size)
                put(change, 6 * g, w, scale(half, (y * d[2], -x * d[2], x * d[1] - y * d[0])))
                put(change, 6 * g + 3, w, scale(half, d))
        for a in range(n_modes if with_columns else 0):
            m, c = b.degree[a], b.component[a]
            first, second = change[c * W :], change[(6 + c) * W :]
            add_two(row, p * n_modes + a, b.at_gauss[i, 0, m], first, b.at_gauss[i, 1, m], second)


@kernel
def tendon_paths(b: ModalBasis, first_tendon: Ints, work: ModalWork, with_columns: bool) -> None:
    """Length of every tendon, base to where it ends, and with `with_columns` its derivatives."""
    clear(work.path_length)
    if with_columns:
        clear(work.path_change)
    for p in range(work.piece.shape[0]):
        for t in range(first_tendon[p], len(work.path_length) // W):
            add_paths(p, t, b, work, with_columns)


@inline
def _add(sums: Lanes, f: int, w: int, value: float) -> None:
    write(sums, f, w, read(sums, f, w) + value)


@kernel
def add_second_derivatives(
    here: Lanes, half: Lanes, offset: Lanes, tension: Lanes, g: int, sums: Lanes, strained: bool
) -> None:
    """Add T h/2 times the second derivative of one tendon's |q| by u, and if `strained` by v, at Gauss point
    g: (6, 6), lower triangle. `half` (1,)."""
    for w in range(W):
        x, y = read(offset, 0, w), read(offset, 1, w)
        _, d, inverse = path(get(here, I_U + 3 * g, w), get(here, I_V + 3 * g, w), x, y)
        k = half[w] * tension[w] * inverse
        # J^T t, its first half: t by u
        a, e, f = y * d[2], -x * d[2], x * d[1] - y * d[0]
        _add(sums, 0, w, k * (y * y - a * a))
        _add(sums, 1, w, -k * (x * y + a * e))
        _add(sums, 2, w, k * (x * x - e * e))
        _add(sums, 3, w, -k * a * f)
        _add(sums, 4, w, -k * e * f)
        _add(sums, 5, w, k * (x * x + y * y - f * f))
    for w in range(W if strained else 0):
        x, y = read(offset, 0, w), read(offset, 1, w)
        _, d, inverse = path(get(here, I_U + 3 * g, w), get(here, I_V + 3 * g, w), x, y)
        k = half[w] * tension[w] * inverse
        a, e, f = y * d[2], -x * d[2], x * d[1] - y * d[0]
        _add(sums, 6, w, -k * a * d[0])
        _add(sums, 7, w, -k * e * d[0])
        _add(sums, 8, w, -k * (y + f * d[0]))
        _add(sums, 9, w, k * (1.0 - d[0] * d[0]))
        _add(sums, 10, w, -k * a * d[1])
        _add(sums, 11, w, -k * e * d[1])
        _add(sums, 12, w, k * (x - f * d[1]))
        _add(sums, 13, w, -k * d[0] * d[1])
        _add(sums, 14, w, k * (1.0 - d[1] * d[1]))
        _add(sums, 15, w, k * (y - a * d[2]))
        _add(sums, 16, w, -k * (x + e * d[2]))
        _add(sums, 17, w, -k * f * d[2])
        _add(sums, 18, w, -k * d[0] * d[2])
        _add(sums, 19, w, -k * d[1] * d[2])
        _add(sums, 20, w, k * (1.0 - d[2] * d[2]))


@kernel
def tendon_stiffness_of_piece(p: int, first: int, b: ModalBasis, work: ModalWork) -> None:
    """Add T times the second derivatives of the tendons' paths: by curvatures to the intervals' own, by a
    strain to the Hessian."""
    n_modes, sums, half = b.component.shape[0], work.scratch[: 21 * W], work.scratch[21 * W :]
    n_bent = 0
    while n_bent < n_modes and b.component[n_bent] < 3:
        n_bent += 1
    for i in range(b.width.shape[0]):
        here = work.interval[p, i]
        for w in range(W):
            half[w] = 0.5 * b.width[i] * read(work.piece[p], P_L, w)
        for g in range(2):
            clear(sums)
            for t in range(first, len(work.path_length) // W):
                offset, tension = work.offset[p, 2 * t * W :], work.tension[t * W :]
                add_second_derivatives(here, half, offset, tension, g, sums, n_bent < n_modes)
            for r in range(3):
                for c in range(r + 1):
                    field = I_LOCAL + entry(3 * g + r, 3 * g + c)
                    for w in range(W):
                        _add(here, field, w, read(sums, entry(r, c), w))
            for a in range(n_bent, n_modes):
                for c in range(a + 1):
                    k = b.at_gauss[i, g, b.degree[a]] * b.at_gauss[i, g, b.degree[c]]
                    place = entry(b.component[a], b.component[c])
                    row, col = p * n_modes + a, p * n_modes + c
                    for w in range(W):
                        grown = at(hessian(work), row, col, w) + k * read(sums, place, w)
                        write_at(hessian(work), row, col, w, grown)


@kernel
def add_tendons(first_tendon: Ints, work: ModalWork, pull: Lanes) -> None:
    """Add (1 / c) dl dl^T of every tendon that is taut; those before `first_tendon` of a piece end before
    it."""
    n_q = len(work.q) // W
    n_modes = n_q // work.piece.shape[0]
    for a in range(n_q):
        row = hessian(work).entries[a * n_q * W : (a * n_q + a + 1) * W]
        for t in range(first_tendon[a // n_modes], len(work.tension) // W):
            change = path_change(work).entries[t * n_q * W : (t * n_q + a + 1) * W]
            for w in range(W):
                pull[w] = work.stiffness[t * W + w] * read(change, a, w)
            for c in range(a + 1):
                add_product(row, c, pull, change[c * W :])


@kernel
def tensions(length: Floats, compliance: Floats, pretension: Floats, slack: Floats, work: ModalWork) -> None:
    """T = T0 + (path - L) / c of tendons that are commanded by length, 0 where one that can is slack.

    `length`, `compliance`, `pretension`, `slack` (n_tendons * LANES,): compliance 0 where the tension itself
    is commanded (`pretension`), slack 1 where a tendon carries no thrust.
    """
    for i in range(len(work.tension)):
        c = compliance[i]
        stiffness = 1.0 / c if c > 0.0 else 0.0
        t = pretension[i] + stiffness * (work.path_length[i] - length[i])
        loose = slack[i] > 0.0 and t < 0.0
        work.tension[i] = 0.0 if loose else t
        work.stiffness[i] = 0.0 if loose else stiffness
