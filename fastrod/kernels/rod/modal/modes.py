"""Curvature modes of a piece of rod, and the points at which it is evaluated.

A piece has N intervals between the N + 1 Gauss-Lobatto points of [0, 1], where positions, masses and loads
are, and two Gauss points in each interval, where curvature and strain of the tendons are. Modes are Legendre
polynomials of degree m on [0, 1]: int_0^1 B_m B_n = 1 / (2 m + 1) for m = n, else 0.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre

from fastrod.types import Floats, Ints

N_INTERVALS = 8
GAUSS = (0.5 - np.sqrt(3.0) / 6.0, 0.5 + np.sqrt(3.0) / 6.0)


class ModalBasis(NamedTuple):
    """Tables of the points and modes of a piece."""

    node: Floats
    """(N + 1,) xi of the Gauss-Lobatto points, 0 and 1 among them."""
    width: Floats
    """(N,) of the intervals between them."""
    integral: Floats
    """(N + 1, N + 1) S[k, j]: integral from 0 to xi_k of the Lagrange polynomial of node j; the last row
    holds the quadrature weights."""
    inertia: Floats
    """(N + 1, N + 1) S^T diag(w) S: from the acceleration of the tangents to the force on them."""
    at_gauss: Floats
    """(N, 2, n_degrees) Legendre polynomials at the Gauss points of each interval."""
    at_node: Floats
    """(N + 1, n_degrees) and at the nodes."""
    component: Ints
    """(n_modes,) of each mode: 0, 1, 2 curvature about d1, d2, d3; 3, 4 shear along d1, d2; 5 stretch."""
    degree: Ints
    """(n_modes,)"""


def legendre_at(x: Floats | float, n_degrees: int) -> Floats:
    """(..., n_degrees) Legendre polynomials of [0, 1] at x."""
    x = np.asarray(x, dtype=np.float64)
    values = np.asarray(legendre.legvander(2.0 * x - 1.0, n_degrees - 1), dtype=np.float64)
    # contiguous, as it comes out of a pickle: kernels would be compiled anew for another layout
    return np.ascontiguousarray(values.reshape(*x.shape, n_degrees))


@cache
def _points(n: int) -> tuple[Floats, Floats, Floats]:
    """Gauss-Lobatto points of [0, 1], and Legendre coefficients of their Lagrange polynomials and of the
    integrals from 0 of these."""
    inner = legendre.Legendre.basis(n).deriv().roots()
    x = np.concatenate([[0.0], 0.5 * (1.0 + np.sort(inner.real)), [1.0]])
    values = legendre.legvander(2.0 * x - 1.0, n)
    coefficients = np.asarray(np.linalg.inv(values), dtype=np.float64)  # column j: polynomial of node j
    return x, coefficients, np.asarray(0.5 * legendre.legint(coefficients, lbnd=-1, axis=0))


def _times(values: Floats, table: Floats) -> Floats:
    """`values` @ `table`, of each row alone: BLAS rounds by how many there are."""
    return np.asarray(np.einsum("...k,kj->...j", values, table))


def integral_row(x: Floats | float, n: int = N_INTERVALS) -> Floats:
    """(..., N + 1) row of S for a place that is no node: position there is r_0 + l sum of row_j t_j."""
    return _times(legendre_at(x, n + 2), _points(n)[2])


def row_tables(n: int = N_INTERVALS) -> tuple[Floats, Floats]:
    """Legendre coefficients (n_degrees, N + 1) of the Lagrange polynomials of the nodes, and of the integrals
    from 0 of these."""
    return _points(n)[1:]


def rows_at(x: Floats | float, n: int = N_INTERVALS) -> tuple[Floats, Floats]:
    """That row, and (..., N + 1) Lagrange polynomials of the nodes at x."""
    values, (lagrange, integral) = legendre_at(x, n + 2), row_tables(n)
    return _times(values, integral), _times(values[..., :-1], lagrange)


@cache
def modal_basis(
    bending: int, torsion: int, shear: int = 0, stretch: int = 0, n: int = N_INTERVALS
) -> ModalBasis:
    """Tables for so many modes of each kind."""
    x = _points(n)[0]
    integral = integral_row(x, n)
    width, weight = np.diff(x), integral[-1]
    gauss = x[:-1, None] + width[:, None] * np.array(GAUSS)
    counts = (bending, bending, torsion, shear, shear, stretch)
    most = max(counts)
    return ModalBasis(
        node=x,
        width=width,
        integral=integral,
        inertia=integral.T @ (weight[:, None] * integral),
        at_gauss=legendre_at(gauss, most),
        at_node=legendre_at(x, most),
        component=np.repeat(np.arange(6), counts).astype(np.int64),
        degree=np.concatenate([np.arange(c) for c in counts]).astype(np.int64),
    )


def hat_row(x: Floats, n: int = N_INTERVALS) -> Floats:
    """(..., N + 1) how the nodes share what is at x: linear between the nearest two."""
    nodes = _points(n)[0]
    interval, width = interval_of(x, n)
    fraction = width / np.diff(nodes)[interval]
    row = np.zeros((*np.shape(x), n + 1))
    np.put_along_axis(row, interval[..., None], 1.0 - fraction[..., None], -1)
    np.put_along_axis(row, interval[..., None] + 1, fraction[..., None], -1)
    return row


def interval_of(x: Floats, n: int = N_INTERVALS) -> tuple[Ints, Floats]:
    """The interval in which each place lies, and its distance from the node before it."""
    nodes = _points(n)[0]
    interval = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, n - 1).astype(np.int64)
    return interval, x - nodes[interval]


def gauss_points(interval: Ints, width: Floats, n: int = N_INTERVALS) -> Floats:
    """(..., 2) Gauss points of the stretch of this width behind the first node of each interval."""
    return np.asarray(_points(n)[0][interval][..., None] + width[..., None] * np.array(GAUSS))
