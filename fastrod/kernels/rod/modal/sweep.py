"""Sweep from base to tip: the rod of given curvature modes, and the motion of its nodes by each mode.

Over an interval of length h with curvature u_1, u_2 at its Gauss points the rotation grows by exp of
o = h/2 (u_1 + u_2) + k u_1 x u_2, k = sqrt(3)/12 h^2: Magnus' series for R' = R [u]x to fourth order
(Iserles and Norsett 1999). Positions are the spectral integrals of the tangents t = R v at the nodes.
"""

from __future__ import annotations

import math

from ...jit import inline, kernel
from ...vec import Mat, Vec, add, axpy, cross, dot, matmul, mul, scale
from ..lanes import W, get, get_mat, put, put_mat, read, weighted_sum, write
from .fields import C_TH, C_V, I_O, I_STAR, I_U, I_V, I_W, N_POS, N_R, N_T, P_L, ModalWork
from .modes import ModalBasis

MAGNUS = math.sqrt(3.0) / 12.0


@inline
def exp_series(o: Vec) -> tuple[Vec, Vec]:
    """sin x / x, (x - sin x) / x^3, (1 - cos x) / x^2 with x = |o|, and their derivatives by x^2.

    Series to x^12: exact to rounding up to x = 1, where an interval is bent by a radian.
    """
    t = dot(o, o)
    tail = 1.0 - t / 72.0 * (1.0 - t / 110.0 * (1.0 - t / 156.0))
    b = (1.0 - t / 20.0 * (1.0 - t / 42.0 * tail)) / 6.0
    a = 1.0 - t * b
    c = 1.0 - t / 56.0 * (1.0 - t / 90.0 * (1.0 - t / 132.0 * (1.0 - t / 182.0)))
    c = 0.5 - t / 24.0 * (1.0 - t / 30.0 * c)
    da = 1.0 / 60.0 + t * (-1.0 / 1680.0 + t * (1.0 / 90720.0 + t * (-1.0 / 7983360.0 + t / 1037836800.0)))
    da = -1.0 / 6.0 + t * da
    db = 1.0 / 2520.0 + t * (-1.0 / 120960.0 + t * (1.0 / 9979200.0 - t / 1245404160.0))
    db = -1.0 / 120.0 + t * db
    dc = 1.0 / 907200.0 + t * (-1.0 / 95800320.0 + t / 14529715200.0)
    dc = -1.0 / 24.0 + t * (1.0 / 360.0 + t * (-1.0 / 13440.0 + t * dc))
    return (a, b, c), (da, db, dc)


@inline
def rotation_of(o: Vec, series: Vec) -> Mat:
    """exp([o]x)."""
    a, c = series[0], series[2]
    x, y, z = a * o[0], a * o[1], a * o[2]
    xx, xy, xz = c * o[0] * o[0], c * o[0] * o[1], c * o[0] * o[2]
    yy, yz, zz = c * o[1] * o[1], c * o[1] * o[2], c * o[2] * o[2]
    return (1.0 - yy - zz, xy - z, xz + y, xy + z, 1.0 - xx - zz, yz - x, xz - y, yz + x, 1.0 - xx - yy)


@inline
def left_jacobian(o: Vec, series: Vec, d: Vec) -> Vec:
    """V(o) d: rotation vector, in the frame before exp([o]x), by a change d of o."""
    along, across = series[1] * dot(o, d), cross(o, d)
    return (
        series[0] * d[0] + along * o[0] + series[2] * across[0],
        series[0] * d[1] + along * o[1] + series[2] * across[1],
        series[0] * d[2] + along * o[2] + series[2] * across[2],
    )


@inline
def rotation_vector_changes(u: Vec, half: float, k: float) -> tuple[Vec, Vec, Vec]:
    """Change of o by each component of the curvature at one Gauss point; u that at the other one. `k` is
    negative for the second: k u_1 x e = -k e x u_1."""
    return (half, -k * u[2], k * u[1]), (k * u[2], half, -k * u[0]), (-k * u[1], k * u[0], half)


@kernel
def curvature_of_piece(p: int, b: ModalBasis, work: ModalWork) -> None:
    """u and v at the Gauss points, v at the nodes (in N_T, until the rotation is known)."""
    n, n_modes = b.width.shape[0], b.component.shape[0]
    interval, node = work.interval[p], work.node[p]
    for j in range(n + 1):
        for w in range(W):
            put(node[j], N_T, w, (0.0, 0.0, 1.0))
    for i in range(n):
        for g in range(2):
            for w in range(W):
                put(interval[i], I_U + 3 * g, w, get(interval[i], I_STAR + 3 * g, w))
                put(interval[i], I_V + 3 * g, w, (0.0, 0.0, 1.0))
    for a in range(n_modes):
        c, m = b.component[a], b.degree[a]
        q = work.q[(p * n_modes + a) * W :]
        for i in range(n):
            at = interval[i]
            for g in range(2):
                field, value = (I_U + c if c < 3 else I_V + c - 3) + 3 * g, b.at_gauss[i, g, m]
                for w in range(W):
                    write(at, field, w, read(at, field, w) + value * q[w])
        if c >= 3:
            for j in range(n + 1):
                value = b.at_node[j, m]
                for w in range(W):
                    write(node[j], N_T + c - 3, w, read(node[j], N_T + c - 3, w) + value * q[w])


@kernel
def march_piece(p: int, b: ModalBasis, work: ModalWork, with_columns: bool) -> None:
    """Rotation and tangent of the nodes, and `with_columns` the rotation of each interval's end by its
    curvatures."""
    node, piece = work.node[p], work.piece[p]
    start = node[0]
    for w in range(W):
        put(start, N_T, w, mul(get_mat(start, N_R, w), get(start, N_T, w)))
    for i in range(b.width.shape[0]):
        at, here, to, width = work.interval[p, i], node[i], node[i + 1], b.width[i]
        for w in range(W):
            h = width * read(piece, P_L, w)
            half, k = 0.5 * h, MAGNUS * h * h
            u1, u2 = get(at, I_U, w), get(at, I_U + 3, w)
            o = axpy(k, cross(u1, u2), scale(half, add(u1, u2)))
            series, _ = exp_series(o)
            r = get_mat(here, N_R, w)
            put(at, I_O, w, o)
            new = matmul(r, rotation_of(o, series))
            put_mat(to, N_R, w, new)
            put(to, N_T, w, mul(new, get(to, N_T, w)))
        for w in range(W if with_columns else 0):
            h = width * read(piece, P_L, w)
            half, k = 0.5 * h, MAGNUS * h * h
            u1, u2, o = get(at, I_U, w), get(at, I_U + 3, w), get(at, I_O, w)
            r, series = get_mat(here, N_R, w), exp_series(o)[0]
            x, y, z = rotation_vector_changes(u2, half, k)
            put(at, I_W, w, mul(r, left_jacobian(o, series, x)))
            put(at, I_W + 3, w, mul(r, left_jacobian(o, series, y)))
            put(at, I_W + 6, w, mul(r, left_jacobian(o, series, z)))
            x, y, z = rotation_vector_changes(u1, half, -k)
            put(at, I_W + 9, w, mul(r, left_jacobian(o, series, x)))
            put(at, I_W + 12, w, mul(r, left_jacobian(o, series, y)))
            put(at, I_W + 15, w, mul(r, left_jacobian(o, series, z)))


@kernel
def positions_of_piece(p: int, b: ModalBasis, work: ModalWork) -> None:
    """r_k = r_0 + l sum_j S[k, j] t_j."""
    node, length, start = work.node[p], work.piece[p], work.node[p, 0]
    n = b.width.shape[0]
    for k in range(1, n + 1):
        to = node[k]
        weighted_sum(to[N_POS * W :], b.integral[k], node, N_T, 3)
        for w in range(W):
            put(to, N_POS, w, axpy(read(length, P_L, w), get(to, N_POS, w), get(start, N_POS, w)))


@kernel
def curvature_column(p: int, a: int, b: ModalBasis, work: ModalWork) -> None:
    """Rotation and tangent of the nodes by a mode of curvature."""
    column, c, m = work.column[p, a], b.component[a], b.degree[a]
    for w in range(W):
        put(column[0], C_TH, w, (0.0, 0.0, 0.0))
        put(column[0], C_V, w, (0.0, 0.0, 0.0))
    for i in range(b.width.shape[0]):
        b1, b2 = b.at_gauss[i, 0, m], b.at_gauss[i, 1, m]
        first = work.interval[p, i, (I_W + 3 * c) * W :]
        second = work.interval[p, i, (I_W + 9 + 3 * c) * W :]
        here, to, node = column[i], column[i + 1], work.node[p, i + 1]
        for w in range(W):
            th = axpy(b1, get(first, 0, w), axpy(b2, get(second, 0, w), get(here, C_TH, w)))
            put(to, C_TH, w, th)
            put(to, C_V, w, cross(th, get(node, N_T, w)))


@kernel
def strain_column(p: int, a: int, b: ModalBasis, work: ModalWork) -> None:
    """Tangent of the nodes by a mode of shear or stretch."""
    column, axis, m = work.column[p, a], b.component[a] - 3, b.degree[a]
    for j in range(b.node.shape[0]):
        value, to, node = b.at_node[j, m], column[j], work.node[p, j]
        for w in range(W):
            put(to, C_TH, w, (0.0, 0.0, 0.0))
            e = (read(node, N_R + axis, w), read(node, N_R + 3 + axis, w), read(node, N_R + 6 + axis, w))
            put(to, C_V, w, scale(value, e))


@kernel
def end_motion(p: int, a: int, b: ModalBasis, work: ModalWork) -> None:
    """Motion of the piece's end by a mode."""
    column, end, length = work.column[p, a], work.end[p, a], work.piece[p]
    n = b.width.shape[0]
    weighted_sum(end, b.integral[n], column, C_V, 3)
    for w in range(W):
        put(end, 0, w, scale(read(length, P_L, w), get(end, 0, w)))
        put(end, 3, w, get(column[n], C_TH, w))


@kernel
def start_piece(p: int, b: ModalBasis, work: ModalWork) -> None:
    """The piece begins at the base, or where the one before it ends."""
    start = work.node[p, 0]
    for w in range(W):
        if p == 0:
            put_mat(start, N_R, w, get_mat(work.base, 0, w))
            put(start, N_POS, w, get(work.base, 9, w))
        else:
            last = work.node[p - 1, b.width.shape[0]]
            put_mat(start, N_R, w, get_mat(last, N_R, w))
            put(start, N_POS, w, get(last, N_POS, w))


@kernel
def sweep_piece(p: int, b: ModalBasis, work: ModalWork, with_columns: bool) -> None:
    """Shape of a piece, and with `with_columns` its motion by every mode."""
    start_piece(p, b, work)
    curvature_of_piece(p, b, work)
    march_piece(p, b, work, with_columns)
    positions_of_piece(p, b, work)
    if with_columns:
        for a in range(b.component.shape[0]):
            if b.component[a] < 3:
                curvature_column(p, a, b, work)
            else:
                strain_column(p, a, b, work)
            end_motion(p, a, b, work)
