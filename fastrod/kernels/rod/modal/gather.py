"""Between the arrays of a batch (robot axis first) and the buffers of one chunk of modes (lanes last)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fastrod.types import Floats, Ints, Layout, Params, Ports

from ...jit import entry, inline, kernel
from ...vec import Vec, axpy, from_quaternion, scale, sub
from ..gather import pick
from ..lanes import Lanes, W, get, put, put_mat, write
from . import fields as fd
from .fields import ModalWork
from .host import ModalHost
from .modes import GAUSS, ModalBasis
from .motion import ModalMotion


class ModalPieces(NamedTuple):
    """Pieces into which the segments of a batch are cut, and further data of robots for modes. The robot
    axis is 1 or n_robots."""

    segment: Ints
    """(n_pieces,) that a piece is extent of."""
    first_tendon: Ints
    """(n_pieces,) first tendon that crosses it."""
    bound: Floats
    """(n_pieces, 2) where it begins and ends, as fractions of its segment."""
    density: Floats
    """(n_robots, n_segments, 3) mass per length [kg/m], and its second moments about d2 and d1 [kg m]."""
    axial: Floats
    """(n_robots, n_segments, 3) GA along d1 and d2, EA [N]; any number where the basis has no such modes."""
    damping_time: Floats
    """(n_robots, n_segments) [s]."""
    lump: Floats
    """(n_robots, n_lumps) mass [kg]."""
    lump_spin: Floats
    """(n_robots, n_lumps, 3) masses of the directors that stand for its inertia [kg m^2]."""
    lump_weight: Floats
    """(n_robots, n_lumps, N + 1) how the nodes of its piece share that: linear between the nearest two."""
    lump_piece: Ints
    """(n_lumps,) the piece that each is on."""
    lump_station: Ints
    """(n_lumps,) its number among the stations of that piece."""
    lump_row: Floats
    """(n_robots, n_lumps, N + 1) rows of the integration there."""
    gravity: Floats
    """(n_robots, 3) world [m/s^2]."""


class ModalPoints(NamedTuple):
    """Point forces at given arclengths."""

    piece: Ints
    """(n_robots, n_points)"""
    row: Floats
    """(n_robots, n_points, N + 1) rows of the integration there."""
    slope: Floats
    """(n_robots, n_points, N + 1) Lagrange polynomials of the nodes there: how they share a moment."""
    force: Floats
    """(n_robots, n_points, 3) world [N]."""
    moment: Floats
    """(n_robots, n_points, 3) world [N m]."""


@entry
def place_points(
    ends: Floats, arclength: Floats, per_segment: int, tables: tuple[Floats, Floats], points: ModalPoints
) -> None:
    """Piece and rows of point forces at `arclength` (1 or n_robots, n_points) of robots whose segments end at
    `ends` (1 or n_robots, n_segments) [m]; `tables` as `row_tables`."""
    lagrange, integral = tables
    value = np.ones(len(integral))
    for i in range(points.piece.shape[0]):
        end, places = ends[pick(i, len(ends))], arclength[pick(i, len(arclength))]
        for q in range(points.piece.shape[1]):
            k = 0
            while k < len(end) - 1 and places[q] > end[k]:
                k += 1
            first = end[k - 1] if k > 0 else 0.0
            x = per_segment * min(max((places[q] - first) / (end[k] - first), 0.0), 1.0)
            inside = min(int(x), per_segment - 1)
            points.piece[i, q] = k * per_segment + inside
            value[1] = z = 2.0 * (x - inside) - 1.0
            for d in range(2, len(value)):
                value[d] = (value[d - 1] * z * (2 * d - 1) - value[d - 2] * (d - 1)) / d
            for j in range(points.row.shape[2]):
                row, slope = 0.0, 0.0
                for d in range(len(integral)):
                    row += value[d] * integral[d, j]
                for d in range(len(lagrange)):
                    slope += value[d] * lagrange[d, j]
                points.row[i, q, j], points.slope[i, q, j] = row, slope


class ModalBatch(NamedTuple):
    """The robots of a batch, what acts on them, and what they remember."""

    params: Params
    ports: Ports
    layout: Layout
    pieces: ModalPieces
    points: ModalPoints
    basis: ModalBasis
    motion: ModalMotion
    host: ModalHost


@inline
def _vec(a: Floats) -> Vec:
    return a[0], a[1], a[2]


@kernel
def gather_pieces(
    robots: Ints, params: Params, ports: Ports, pieces: ModalPieces, b: ModalBasis, work: ModalWork
) -> None:
    """Length, density and damping of every piece, and where its tendons run."""
    for p in range(len(pieces.segment)):
        k, piece = pieces.segment[p], work.piece[p]
        fraction = pieces.bound[p, 1] - pieces.bound[p, 0]
        for w in range(W):
            i = robots[w]
            length = params.length[pick(i, len(params.length)), k]
            length += ports.extension[pick(i, len(ports.extension)), k]
            axial = pieces.axial[pick(i, len(pieces.axial)), k]
            density = pieces.density[pick(i, len(pieces.density)), k]
            write(piece, fd.P_L, w, fraction * length)
            put(piece, fd.P_K + 3, w, _vec(axial))
            write(piece, fd.P_TAU, w, pieces.damping_time[pick(i, len(pieces.damping_time)), k])
            write(piece, fd.P_RHO, w, density[0])
            for j in range(b.node.shape[0]):
                extent = b.integral[-1, j] * fraction * length
                put(work.history[p, j], fd.H_J, w, (extent * density[1], extent * density[2], 0.0))
            offset = params.offset[pick(i, len(params.offset)), k]
            for t in range(pieces.first_tendon[p], offset.shape[0]):
                write(work.offset[p], 2 * t, w, offset[t, 0])
                write(work.offset[p], 2 * t + 1, w, offset[t, 1])


@inline
def along(table: Floats, x: float) -> Vec:
    """At a fraction of a segment, of (n_k, 3) as `Ports.stiffness` has it: quadratic over each step."""
    if table.shape[0] == 1:
        return _vec(table[0])
    n_steps = table.shape[0] // 2
    j = min(int(x * n_steps), n_steps - 1)
    t = x * n_steps - j
    a, b, c = table[2 * j], table[2 * j + 1], table[2 * j + 2]
    fa, fb, fc = (1.0 - t) * (1.0 - 2.0 * t), 4.0 * t * (1.0 - t), t * (2.0 * t - 1.0)
    return axpy(fc, _vec(c), axpy(fb, _vec(b), scale(fa, _vec(a))))


@kernel
def gather_material(robots: Ints, ports: Ports, pieces: ModalPieces, b: ModalBasis, work: ModalWork) -> None:
    """Precurvature and stiffness at the Gauss points of every interval, and the mean stiffness of a piece."""
    uneven = 1.0 if ports.stiffness.shape[2] > 1 else 0.0
    for p in range(len(pieces.segment)):
        k, piece = pieces.segment[p], work.piece[p]
        first, fraction = pieces.bound[p, 0], pieces.bound[p, 1] - pieces.bound[p, 0]
        for w in range(W):
            i = robots[w]
            stiffness = ports.stiffness[pick(i, len(ports.stiffness)), k]
            precurvature = ports.precurvature[pick(i, len(ports.precurvature)), k]
            mean = _vec(stiffness[0]) if uneven == 0.0 else (0.0, 0.0, 0.0)
            for j in range(b.width.shape[0]):
                here = work.interval[p, j]
                for g in range(2):
                    x = first + fraction * (b.node[j] + b.width[j] * GAUSS[g])
                    put(here, fd.I_STAR + 3 * g, w, along(precurvature, x))
                    if uneven > 0.0:
                        there = along(stiffness, x)
                        put(here, fd.I_DK + 3 * g, w, there)
                        mean = axpy(0.5 * b.width[j], there, mean)
            write(piece, fd.P_UNEVEN, w, uneven)
            put(piece, fd.P_K, w, mean)
            for j in range(b.width.shape[0] if uneven > 0.0 else 0):
                for g in range(2):
                    there = get(work.interval[p, j], fd.I_DK + 3 * g, w)
                    put(work.interval[p, j], fd.I_DK + 3 * g, w, sub(there, mean))


@inline
def _line_force(line: Floats, grids: Floats, x: float) -> Vec:
    """At a fraction of a segment, of (n_f, 3) as `Ports.line_force` has it; `grids` (1, n_steps + 1), of
    length 0 where its nodes are even."""
    if line.shape[0] == 1:
        return _vec(line[0])
    n_steps = line.shape[0] // 2
    j = min(int(x * n_steps), n_steps - 1)
    t = x * n_steps - j
    if len(grids) > 0:
        j, grid = 0, grids[0]
        while j < n_steps - 1 and grid[j + 1] < x:
            j += 1
        t = (x - grid[j]) / (grid[j + 1] - grid[j])
    a, b = line[2 * j], line[2 * j + 1]
    return a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), a[2] + t * (b[2] - a[2])


@kernel
def gather_loads(robots: Ints, ports: Ports, pieces: ModalPieces, b: ModalBasis, work: ModalWork) -> None:
    """Base, loads on the tip, and the line force at every node."""
    for w in range(W):
        i = robots[w]
        pose = ports.base_pose[pick(i, len(ports.base_pose))]
        put_mat(work.base, 0, w, from_quaternion((pose[3], pose[4], pose[5], pose[6])))
        put(work.base, 9, w, _vec(pose))
        force = _vec(ports.tip_force[pick(i, len(ports.tip_force))])
        put(work.outside, 0, w, force)
        put(work.outside, 9, w, force)
        put(work.outside, 12, w, (0.0, 0.0, 0.0))
        if len(ports.follower_force) > 0:
            put(work.outside, 12, w, _vec(ports.follower_force[pick(i, len(ports.follower_force))]))
        put(work.outside, 3, w, _vec(ports.tip_moment[pick(i, len(ports.tip_moment))]))
        put(work.outside, 6, w, _vec(pieces.gravity[pick(i, len(pieces.gravity))]))
        for p in range(len(pieces.segment)):
            line = ports.line_force[pick(i, len(ports.line_force)), pieces.segment[p]]
            own = pick(i, len(ports.grid)) if len(ports.grid) > 0 else 0
            grids = ports.grid[own : own + 1, pieces.segment[p]]
            first, last = pieces.bound[p]
            for j in range(b.node.shape[0]):
                x = first + b.node[j] * (last - first)
                put(work.history[p, j], fd.H_LINE, w, _line_force(line, grids, x))
            followed = len(ports.follower_line) > 0
            write(work.piece[p], fd.P_FOLLOWED, w, 1.0 if followed else 0.0)
            if followed:
                own_line = ports.follower_line[pick(i, len(ports.follower_line)), pieces.segment[p]]
                for j in range(b.node.shape[0]):
                    x, history = first + b.node[j] * (last - first), work.history[p, j]
                    put(history, fd.H_DEAD, w, get(history, fd.H_LINE, w))
                    put(history, fd.H_FOLLOW, w, _line_force(own_line, grids, x))


@kernel
def gather_command(robots: Ints, layout: Layout, params: Params, ports: Ports, command: Lanes) -> None:
    """`command` (4, n_tendons * LANES) of `tensions`: length, compliance, pretension and slack of the tendons
    that are commanded by length; tension alone of the others."""
    for t in range(len(layout.tendon_segment)):
        for w in range(W):
            i = robots[w]
            write(command[0], t, w, ports.tendon_length[pick(i, len(ports.tendon_length)), t])
            write(command[1], t, w, 0.0)
            write(command[2], t, w, ports.tension[pick(i, len(ports.tension)), t])
            write(command[3], t, w, 0.0)
    for f in range(len(layout.free_tendon)):
        t = layout.free_tendon[f]
        for w in range(W):
            i = robots[w]
            write(command[1], t, w, params.compliance[pick(i, len(params.compliance)), t])
            write(command[2], t, w, params.pretension[pick(i, len(params.pretension)), t])
            slack = params.unilateral[pick(i, len(params.unilateral)), t]
            write(command[3], t, w, 1.0 if slack else 0.0)


@kernel
def gather_lumps(robots: Ints, pieces: ModalPieces, work: ModalWork) -> None:
    """Mass, inertia and row of every lump."""
    for q in range(len(pieces.lump_piece)):
        to = work.station[pieces.lump_piece[q], pieces.lump_station[q]]
        for w in range(W):
            i = robots[w]
            row = pieces.lump_row[pick(i, len(pieces.lump_row)), q]
            write(to, fd.S_MASS, w, pieces.lump[pick(i, len(pieces.lump)), q])
            put(to, fd.S_GIVEN, w, (0.0, 0.0, 0.0))
            spin = pieces.lump_spin[pick(i, len(pieces.lump_spin)), q]
            weight = pieces.lump_weight[pick(i, len(pieces.lump_weight)), q]
            for j in range(row.shape[0]):
                write(to, fd.S_ROW + j, w, row[j])
                node = work.history[pieces.lump_piece[q], j]
                put(node, fd.H_J, w, axpy(weight[j], _vec(spin), get(node, fd.H_J, w)))


@kernel
def gather_points(robots: Ints, points: ModalPoints, work: ModalWork) -> None:
    """Force and row of every point force, into the last stations of its piece; its moment to the nodes."""
    n = points.piece.shape[1]
    for p in range(work.station.shape[0]):
        for j in range(work.node.shape[1]):
            for w in range(W):
                put(work.history[p, j], fd.H_MOMENT, w, (0.0, 0.0, 0.0))
    for q in range(n):
        for w in range(W):
            i = robots[w]
            moment = _vec(points.moment[i, q])
            for j in range(work.node.shape[1]):
                node = work.history[points.piece[i, q], j]
                put(node, fd.H_MOMENT, w, axpy(points.slope[i, q, j], moment, get(node, fd.H_MOMENT, w)))
    first = work.station.shape[1] - n
    for q in range(n):
        for p in range(work.station.shape[0]):
            to = work.station[p, first + q]
            for w in range(W):
                i = robots[w]
                here = points.piece[i, q] == p
                write(to, fd.S_MASS, w, 0.0)
                put(to, fd.S_GIVEN, w, _vec(points.force[i, q]) if here else (0.0, 0.0, 0.0))
                for j in range(points.row.shape[2]):
                    write(to, fd.S_ROW + j, w, points.row[i, q, j] if here else 0.0)
