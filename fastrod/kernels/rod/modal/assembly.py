"""Second derivatives of the energy by all modes, piece by piece from tip to base.

A column is the motion of a piece's nodes by one unknown: rotation th and change v of the tangents. It changes
the forces on the tangents by dN and the moments by dM; its work on mode a is
  sum_i W_a . (dM_i + M_i x th at the middle of interval i), and the intervals' own (`interval`).
A mode of a piece nearer to the base moves this one as a rigid body; so does, in turn, whatever is beyond.
"""

from __future__ import annotations

from fastrod.types import Ints

from ...jit import kernel
from ...vec import add, axpy, cross, dot, mul, scale, sub
from ..lanes import Lanes, W, add_two, at, clear, get, get_mat, put, read, weighted_sum, write, write_at
from . import fields as fd
from .balance import balance_of_piece, pass_on, start_at_tip
from .fields import ModalWork, hessian
from .host import couple_piece, hosted
from .interval import add_elasticity, add_local, local_of_piece
from .modes import ModalBasis
from .tendons import add_tendons, tendon_stiffness_of_piece


@kernel
def forces_by_column(p: int, column: Lanes, b: ModalBasis, work: ModalWork, moment: Lanes) -> None:
    """Change of the forces on the tangents by a column (N + 1, COLUMN), into `work.force`, and of the moment
    beyond the piece, into `moment` (3,)."""
    n, beyond, piece, total = b.width.shape[0], work.beyond[0], work.piece[p], work.scratch
    weighted_sum(total, b.integral[n], column, fd.C_V, 3)
    for w in range(W):
        displacement = scale(read(piece, fd.P_L, w), get(total, 0, w))
        th, first = get(column[n], fd.C_TH, w), get(beyond, fd.B_FIRST, w)
        force = axpy(read(beyond, fd.B_MASS, w), displacement, cross(th, first))
        put(total, 3, w, force)
        put(moment, 0, w, add(cross(first, displacement), mul(get_mat(beyond, fd.B_BACK, w), th)))
    for j in range(n + 1):
        to, weight = work.force[j], b.integral[n, j]
        weighted_sum(to, b.inertia[j], column, fd.C_V, 3)
        for w in range(W):
            l = read(piece, fd.P_L, w)  # noqa: E741
            inertia = scale(work.scheme[w] * read(piece, fd.P_RHO, w) * l * l * l, get(to, 0, w))
            put(to, 0, w, axpy(weight * l, get(total, 3, w), inertia))


@kernel
def stations_by_column(p: int, column: Lanes, b: ModalBasis, work: ModalWork) -> None:
    """Add to `work.force` the inertia of the lumps of a piece."""
    n, length, moved = b.width.shape[0], work.piece[p], work.scratch
    for k in range(work.station.shape[1]):
        station = work.station[p, k]
        for w in range(W):
            put(moved, 0, w, (0.0, 0.0, 0.0))
        for j in range(n + 1):
            for w in range(W):
                put(
                    moved,
                    0,
                    w,
                    axpy(read(station, fd.S_ROW + j, w), get(column[j], fd.C_V, w), get(moved, 0, w)),
                )
        for j in range(n + 1):
            to = work.force[j]
            for w in range(W):
                l = read(length, fd.P_L, w)  # noqa: E741
                factor = l * l * work.scheme[w] * read(station, fd.S_MASS, w) * read(station, fd.S_ROW + j, w)
                put(to, 0, w, axpy(factor, get(moved, 0, w), get(to, 0, w)))


@kernel
def moments_by_column(p: int, column: Lanes, b: ModalBasis, work: ModalWork, moment: Lanes) -> None:
    """Work of a column on the rotation of every interval (I_WORK); `moment` goes on to the start of the
    piece."""
    n = b.width.shape[0]
    for step in range(n + 1):
        j = n - step
        node, here = work.node[p, j], column[j]
        if j < n:
            interval, later = work.interval[p, j], column[j + 1]
            for w in range(W):
                carried = get(interval, fd.I_M, w)
                middle = scale(0.5, add(get(here, fd.C_TH, w), get(later, fd.C_TH, w)))
                y = add(get(moment, 0, w), cross(carried, middle))
                for f in range(6):
                    write(interval, fd.I_WORK + f, w, dot(get(interval, fd.I_W + 3 * f, w), y))
        force = work.force[j]
        for w in range(W):
            grown = cross(get(here, fd.C_V, w), get(node, fd.N_N, w))
            grown = add(grown, cross(get(node, fd.N_T, w), get(force, 0, w)))
            grown = add(grown, mul(get_mat(node, fd.N_ROTARY, w), get(here, fd.C_TH, w)))
            put(moment, 0, w, add(get(moment, 0, w), grown))


@kernel
def rotary_of_piece(p: int, b: ModalBasis, work: ModalWork) -> None:
    """Change of - alpha J d x d~ at the nodes by a rotation th: (th x d) x d~ = d (th . d~) - th (d . d~)."""
    for j in range(b.node.shape[0]):
        node, history = work.node[p, j], work.history[p, j]
        for w in range(W):
            for f in range(9):
                write(node, fd.N_ROTARY + f, w, 0.0)
        for k in range(3):
            for w in range(W):
                factor, h = -work.scheme[w] * read(history, fd.H_J + k, w), get(history, fd.H_D + 3 * k, w)
                d = (read(node, fd.N_R + k, w), read(node, fd.N_R + 3 + k, w), read(node, fd.N_R + 6 + k, w))
                both = factor * dot(d, h)
                for r in range(3):
                    moved = axpy(factor * d[r], h, get(node, fd.N_ROTARY + 3 * r, w))
                    put(node, fd.N_ROTARY + 3 * r, w, moved)
                    diagonal = fd.N_ROTARY + 4 * r
                    write(node, diagonal, w, read(node, diagonal, w) - both)


@kernel
def work_of_column(p: int, a: int, column: Lanes, b: ModalBasis, work: ModalWork, out: Lanes) -> None:
    """Work of the column in I_WORK and `work.force` on mode a of the piece, into `out` (1,)."""
    c, m = b.component[a], b.degree[a]
    for w in range(W):
        out[w] = 0.0
    if c < 3:
        for i in range(b.width.shape[0]):
            here, b1, b2 = work.interval[p, i], b.at_gauss[i, 0, m], b.at_gauss[i, 1, m]
            add_two(out, 0, b1, here[(fd.I_WORK + c) * W :], b2, here[(fd.I_WORK + 3 + c) * W :])
        return
    for j in range(b.node.shape[0]):
        node, value, force = work.node[p, j], b.at_node[j, m], work.force[j]
        for w in range(W):
            e = (read(node, fd.N_R + c - 3, w), read(node, fd.N_R + c, w), read(node, fd.N_R + c + 3, w))
            turned = cross(get(node, fd.N_N, w), get(column[j], fd.C_TH, w))
            out[w] += value * dot(e, add(get(force, 0, w), turned))


@kernel
def column_of_piece(p: int, column: Lanes, b: ModalBasis, work: ModalWork, moment: Lanes) -> None:
    """Change of forces and moments of a piece by a column."""
    forces_by_column(p, column, b, work, moment)
    stations_by_column(p, column, b, work)
    moments_by_column(p, column, b, work, moment)


@kernel
def own_block(p: int, b: ModalBasis, work: ModalWork, moment: Lanes, out: Lanes) -> None:
    """Hessian by two modes of one piece."""
    n_modes = b.component.shape[0]
    for c in range(n_modes):
        column_of_piece(p, work.column[p, c], b, work, moment)
        if b.component[c] < 3:
            add_local(p, c, b, work)
        for a in range(c, n_modes):
            work_of_column(p, a, work.column[p, c], b, work, out)
            row, col = p * n_modes + a, p * n_modes + c
            for w in range(W):
                write_at(hessian(work), row, col, w, at(hessian(work), row, col, w) + out[w])


@kernel
def rotations_of_piece(p: int, b: ModalBasis, work: ModalWork, moment: Lanes, out: Lanes) -> None:
    """A rotation of the whole piece and of what is beyond it: its work on every mode, and the moment at the
    start that it changes."""
    n, before = b.width.shape[0], work.beyond[1]
    for e in range(3):
        axis = (1.0 if e == 0 else 0.0, 1.0 if e == 1 else 0.0, 1.0 if e == 2 else 0.0)
        for j in range(n + 1):
            node = work.node[p, j]
            for w in range(W):
                put(work.rigid[j], fd.C_TH, w, axis)
                put(work.rigid[j], fd.C_V, w, cross(axis, get(node, fd.N_T, w)))
        column_of_piece(p, work.rigid, b, work, moment)
        for a in range(b.component.shape[0]):
            work_of_column(p, a, work.rigid, b, work, out)
            for w in range(W):
                write(work.coupling[a], 3 + e, w, out[w])
        for w in range(W):
            for r in range(3):
                write(before, fd.B_BACK + 3 * r + e, w, read(moment, r, w))


@kernel
def displacements_of_piece(p: int, b: ModalBasis, work: ModalWork) -> None:
    """A displacement e of the whole piece and of what is beyond it. The tangent at node j is then worked
    against with n_j e, an interval with P_i x e: P_i goes for all three at once."""
    n, beyond, before, first = b.width.shape[0], work.beyond[0], work.beyond[1], work.scratch
    for a in range(b.component.shape[0]):
        for w in range(W):
            put(work.coupling[a], 0, w, (0.0, 0.0, 0.0))
    for w in range(W):
        put(first, 0, w, get(beyond, fd.B_FIRST, w))
        l = read(work.piece[p], fd.P_L, w)  # noqa: E741
        mass = work.scheme[w] * read(work.piece[p], fd.P_RHO, w) * l
        for k in range(work.station.shape[1]):
            mass += work.scheme[w] * read(work.station[p, k], fd.S_MASS, w)
        write(before, fd.B_MASS, w, read(beyond, fd.B_MASS, w) + mass)
    for step in range(n + 1):
        j = n - step
        node = work.node[p, j]
        if j < n:
            interval = work.interval[p, j]
            for a in range(b.component.shape[0]):
                c, m, to = b.component[a], b.degree[a], work.coupling[a]
                if c < 3:
                    b1, b2 = b.at_gauss[j, 0, m], b.at_gauss[j, 1, m]
                    for w in range(W):
                        turned = scale(b1, get(interval, fd.I_W + 3 * c, w))
                        turned = axpy(b2, get(interval, fd.I_W + 9 + 3 * c, w), turned)
                        put(to, 0, w, add(get(to, 0, w), cross(turned, get(first, 0, w))))
        for w in range(W):
            l, alpha = read(work.piece[p], fd.P_L, w), work.scheme[w]  # noqa: E741
            weight = 0.0
            for k in range(n + 1):
                weight += b.integral[n, k] * b.integral[k, j]
            inertia = alpha * read(work.piece[p], fd.P_RHO, w) * l * weight
            inertia += b.integral[n, j] * read(beyond, fd.B_MASS, w)
            for k in range(work.station.shape[1]):
                station = work.station[p, k]
                inertia += alpha * read(station, fd.S_MASS, w) * read(station, fd.S_ROW + j, w)
            write(first, 3, w, l * inertia)
            put(first, 0, w, axpy(l * inertia, get(node, fd.N_T, w), get(first, 0, w)))
        for a in range(b.component.shape[0]):
            c, to = b.component[a], work.coupling[a]
            if c >= 3:
                value = b.at_node[j, b.degree[a]]
                for w in range(W):
                    e = (
                        read(node, fd.N_R + c - 3, w),
                        read(node, fd.N_R + c, w),
                        read(node, fd.N_R + c + 3, w),
                    )
                    put(to, 0, w, axpy(value * read(first, 3, w), e, get(to, 0, w)))
    for w in range(W):
        put(before, fd.B_FIRST, w, get(first, 0, w))


@kernel
def coupling_of_piece(p: int, b: ModalBasis, work: ModalWork) -> None:
    """Hessian by a mode of this piece and one of a piece nearer to the base, which moves this piece's
    start."""
    n, n_modes, start = b.width.shape[0], b.component.shape[0], work.node[p, 0]
    for before in range(p):
        last = work.node[before, n]
        for c in range(n_modes):
            end = work.end[before, c]
            for a in range(n_modes):
                gamma, row, col = work.coupling[a], p * n_modes + a, before * n_modes + c
                for w in range(W):
                    th = get(end, 3, w)
                    arm = sub(get(start, fd.N_POS, w), get(last, fd.N_POS, w))
                    moved = add(get(end, 0, w), cross(th, arm))
                    both = dot(get(gamma, 0, w), moved) + dot(get(gamma, 3, w), th)
                    write_at(hessian(work), row, col, w, both)


@kernel
def assemble(b: ModalBasis, first_tendon: Ints, work: ModalWork) -> None:
    """Gradient and Hessian (lower triangle) of the energy at the shape of `sweep_piece`."""
    moment, out = work.scratch[6 * W : 9 * W], work.scratch[9 * W : 10 * W]
    clear(work.hessian)
    start_at_tip(work)
    n_pieces = work.piece.shape[0]
    for step in range(n_pieces):
        p = n_pieces - 1 - step
        balance_of_piece(p, b, work)
        local_of_piece(p, b, work)
        rotary_of_piece(p, b, work)
        tendon_stiffness_of_piece(p, first_tendon[p], b, work)
        own_block(p, b, work, moment, out)
        if p > 0 or hosted(work):  # else nothing that moves is nearer to the base
            rotations_of_piece(p, b, work, moment, out)
            displacements_of_piece(p, b, work)
            coupling_of_piece(p, b, work)
        if hosted(work):
            couple_piece(p, b, work)
        pass_on(p, b, work)
        for i in range(fd.BEYOND * W):
            work.beyond[0, i] = work.beyond[1, i]
        add_elasticity(p, b, work)
    add_tendons(first_tendon, work, out)
