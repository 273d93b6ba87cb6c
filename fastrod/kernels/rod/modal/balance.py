"""Balance from tip to base: what every node must be given, what the rod carries, and the work on the
modes."""

from __future__ import annotations

from ...jit import kernel
from ...vec import add, axpy, cross, dot, scale, sub
from ..lanes import W, at, get, put, read, write
from . import fields as fd
from .fields import ModalWork, path_change
from .modes import ModalBasis


@kernel
def start_at_tip(work: ModalWork) -> None:
    """Beyond the last piece there are the loads on the tip alone."""
    beyond = work.beyond[0]
    for i in range(len(beyond)):
        beyond[i] = 0.0
    for w in range(W):
        put(beyond, fd.B_F, w, scale(-1.0, get(work.outside, 0, w)))
        put(beyond, fd.B_M, w, scale(-1.0, get(work.outside, 3, w)))


@kernel
def demands_of_nodes(p: int, b: ModalBasis, work: ModalWork) -> None:
    """Force and moment that every node must be given: its inertia, less what acts on it from outside.

    Inertia of a node: m alpha (r - r~). Of what turns there: its directors d as points of mass J, each with
    the moment d x alpha J (d - d~) = - alpha J d x d~.
    """
    piece, n = work.piece[p], b.width.shape[0]
    for j in range(n + 1):
        node, history, weight = work.node[p, j], work.history[p, j], b.integral[n, j]
        for w in range(W):
            extent, alpha = weight * read(piece, fd.P_L, w), work.scheme[w]
            moved = sub(get(node, fd.N_POS, w), get(history, fd.H_POS, w))
            inertia = scale(extent * read(piece, fd.P_RHO, w) * alpha, moved)
            put(node, fd.N_F, w, axpy(-extent, get(history, fd.H_LINE, w), inertia))
            put(node, fd.N_C, w, scale(-1.0, get(history, fd.H_MOMENT, w)))
        for k in range(3):
            for w in range(W):
                d = (read(node, fd.N_R + k, w), read(node, fd.N_R + 3 + k, w), read(node, fd.N_R + 6 + k, w))
                inertia = cross(d, get(history, fd.H_D + 3 * k, w))
                factor = -work.scheme[w] * read(history, fd.H_J + k, w)
                put(node, fd.N_C, w, axpy(factor, inertia, get(node, fd.N_C, w)))


@kernel
def demands_of_stations(p: int, b: ModalBasis, work: ModalWork) -> None:
    """Place of the lumps and point forces of a piece, and the force that each must be given."""
    start, length = work.node[p, 0], work.piece[p]
    for k in range(work.station.shape[1]):
        station = work.station[p, k]
        for w in range(W):
            put(station, fd.S_POS, w, (0.0, 0.0, 0.0))
        for j in range(b.node.shape[0]):
            node = work.node[p, j]
            for w in range(W):
                grown = axpy(read(station, fd.S_ROW + j, w), get(node, fd.N_T, w), get(station, fd.S_POS, w))
                put(station, fd.S_POS, w, grown)
        for w in range(W):
            position = axpy(read(length, fd.P_L, w), get(station, fd.S_POS, w), get(start, fd.N_POS, w))
            mass = read(station, fd.S_MASS, w)
            inertia = scale(mass * work.scheme[w], sub(position, get(station, fd.S_HISTORY, w)))
            weight = axpy(mass, get(work.outside, 6, w), get(station, fd.S_GIVEN, w))
            put(station, fd.S_POS, w, position)
            put(station, fd.S_F, w, sub(inertia, weight))


@kernel
def forces_on_tangents(p: int, b: ModalBasis, work: ModalWork) -> None:
    """N_j = l (sum_k S[k, j] f_k + w_j F): what a change of the tangent at node j works against."""
    node, beyond, n = work.node[p], work.beyond[0], b.width.shape[0]
    for j in range(n + 1):
        to, weight = node[j], b.integral[n, j]
        for w in range(W):
            put(to, fd.N_N, w, scale(weight, get(beyond, fd.B_F, w)))
        for k in range(n + 1):
            s, at_k = b.integral[k, j], node[k]
            for w in range(W):
                put(to, fd.N_N, w, axpy(s, get(at_k, fd.N_F, w), get(to, fd.N_N, w)))
        for k in range(work.station.shape[1]):
            station = work.station[p, k]
            for w in range(W):
                put(
                    to,
                    fd.N_N,
                    w,
                    axpy(read(station, fd.S_ROW + j, w), get(station, fd.S_F, w), get(to, fd.N_N, w)),
                )
        for w in range(W):
            force = scale(read(work.piece[p], fd.P_L, w), get(to, fd.N_N, w))
            put(to, fd.N_N, w, force)
            put(to, fd.N_MU, w, add(cross(get(to, fd.N_T, w), force), get(to, fd.N_C, w)))


@kernel
def moments_of_intervals(p: int, b: ModalBasis, work: ModalWork) -> None:
    """M_i = M + sum_{j > i} mu_j, and its work on the rotation of every interval."""
    beyond, n = work.beyond[0], b.width.shape[0]
    for step in range(n):
        i = n - 1 - step
        here, node = work.interval[p, i], work.node[p, i + 1]
        for w in range(W):
            carried = (
                get(beyond, fd.B_M, w) if step == 0 else get(work.interval[p, min(i + 1, n - 1)], fd.I_M, w)
            )
            moment = add(carried, get(node, fd.N_MU, w))
            put(here, fd.I_M, w, moment)
            for f in range(6):
                write(here, fd.I_WORK + f, w, dot(get(here, fd.I_W + 3 * f, w), moment))
    if work.piece[p, fd.P_UNEVEN * W] > 0.0:
        add_uneven(p, b, work)


@kernel
def add_uneven(p: int, b: ModalBasis, work: ModalWork) -> None:
    """Add what the stiffness at the Gauss points has beyond that of the piece."""
    piece = work.piece[p]
    for i in range(b.width.shape[0]):
        here = work.interval[p, i]
        for f in range(6):
            for w in range(W):
                strain = read(here, fd.I_U + f, w) - read(here, fd.I_STAR + f, w)
                rate = work.scheme[W + w] * (strain - read(here, fd.I_HISTORY + f, w))
                k = 0.5 * b.width[i] * read(piece, fd.P_L, w) * read(here, fd.I_DK + f, w)
                more = k * (strain + read(piece, fd.P_TAU, w) * rate)
                write(here, fd.I_WORK + f, w, read(here, fd.I_WORK + f, w) + more)


@kernel
def work_on_mode(p: int, a: int, b: ModalBasis, work: ModalWork) -> None:
    """Derivative of the energy by one mode of a piece: work of the moments, elasticity with its damping,
    tendons."""
    n_modes, c, m, n = b.component.shape[0], b.component[a], b.degree[a], b.width.shape[0]
    row = p * n_modes + a
    piece, gram, to = work.piece[p], 1.0 / (2.0 * m + 1.0), work.gradient[row * W :]
    for w in range(W):
        q = read(work.q, row, w)
        rate = work.scheme[W + w] * (q - read(work.q_history, row, w))
        k = gram * read(piece, fd.P_L, w) * read(piece, fd.P_K + c, w)
        to[w] = k * (q + read(piece, fd.P_TAU, w) * rate)
    if c < 3:
        for i in range(n):
            here, b1, b2 = work.interval[p, i], b.at_gauss[i, 0, m], b.at_gauss[i, 1, m]
            for w in range(W):
                to[w] += b1 * read(here, fd.I_WORK + c, w) + b2 * read(here, fd.I_WORK + 3 + c, w)
    else:
        for j in range(n + 1):
            node, value = work.node[p, j], b.at_node[j, m]
            for w in range(W):
                e = (read(node, fd.N_R + c - 3, w), read(node, fd.N_R + c, w), read(node, fd.N_R + c + 3, w))
                to[w] += value * dot(e, get(node, fd.N_N, w))
    for t in range(len(work.tension) // W):
        for w in range(W):
            to[w] += work.tension[t * W + w] * at(path_change(work), t, row, w)


@kernel
def balance_of_piece(p: int, b: ModalBasis, work: ModalWork) -> None:
    """Demands, forces and moments of a piece, and the gradient by its modes."""
    demands_of_nodes(p, b, work)
    demands_of_stations(p, b, work)
    forces_on_tangents(p, b, work)
    moments_of_intervals(p, b, work)
    for a in range(b.component.shape[0]):
        work_on_mode(p, a, b, work)


@kernel
def pass_on(p: int, b: ModalBasis, work: ModalWork) -> None:
    """Force and moment beyond the piece before this one, into the second row of `beyond`."""
    beyond, before, n = work.beyond[0], work.beyond[1], b.width.shape[0]
    for w in range(W):
        put(before, fd.B_F, w, get(beyond, fd.B_F, w))
        put(before, fd.B_M, w, add(get(work.interval[p, 0], fd.I_M, w), get(work.node[p, 0], fd.N_MU, w)))
    for j in range(n + 1):
        node = work.node[p, j]
        for w in range(W):
            put(before, fd.B_F, w, add(get(before, fd.B_F, w), get(node, fd.N_F, w)))
    for k in range(work.station.shape[1]):
        station = work.station[p, k]
        for w in range(W):
            put(before, fd.B_F, w, add(get(before, fd.B_F, w), get(station, fd.S_F, w)))
