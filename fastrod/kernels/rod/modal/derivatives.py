"""A chunk of modes at given unknowns: gradient and Hessian of its energy, mass, and motion of its tip."""

from __future__ import annotations

from typing import NamedTuple

from fastrod.types import Floats, Ints

from ...jit import entry, inline, kernel
from ...vec import Vec, add, axpy, cross, scale, sub
from ..gather import scatter
from ..lanes import W, at, get, get_mat, put, read, write
from . import fields as fd
from .assembly import assemble
from .chunk import ModalRun, gather_all
from .fields import ModalWork, hessian, one_task
from .follower import follow, tip_motion
from .gather import ModalBatch
from .host import demand_of_base, hosted, no_host, put_base, rigid_stiffness, start_host
from .modes import ModalBasis
from .motion import (
    BDF1,
    NODE_VECTORS,
    REST,
    Scheme,
    base_soon,
    begin_step,
    counted_from,
    curvature_counted_from,
    factors,
    moved_on,
    n_lumps,
    node_number,
    rate_counted_from,
)
from .newton import sweep

AFTER_JUMP = 4
"""Kind of a run: the step of BDF1 that measures the accelerations after a jump (`pass_of_modes`)."""


class ModalDerivatives(NamedTuple):
    """Derivatives of robots near a shape; arrays of length 0 are not wanted."""

    gradient: Floats
    """(n_robots, n_q) of the energy by the unknowns; without what follows the rod it vanishes at rest."""
    hessian: Floats
    """(n_robots, n_q, n_q) symmetric: without the rotation of forces that follow the rod."""
    mass: Floats
    """(n_robots, n_q, n_q) 2 T = dq/dt . M dq/dt."""
    tip: Floats
    """(n_robots, 6, n_q) displacement and rotation of the tip by the unknowns, world."""
    position: Floats
    """(n_robots, 3) of the tip, world [m]."""
    rotation: Floats
    """(n_robots, 3, 3) of the tip, world_from_material."""
    force: Floats
    """(n_robots, 3) that follows the tip, as it is in the world now [N]."""
    line: Floats
    """(n_robots, n_nodes, 3) line force that follows the rod, material, times the extent of its node [N]."""
    damping: Floats
    """(n_robots, n_q, n_q) of a step: derivative of the gradient by what the unknowns' rates are counted
    from, with the other sign."""
    number: Floats
    """(n_robots, n) what has inertia, in the order of `ModalMotion`: positions [m], directors."""
    number_change: Floats
    """(n_robots, n, n_q) its derivatives by the unknowns."""
    inertia: Floats
    """(n_robots, n) masses [kg], and those of the directors [kg m^2]."""
    point: Floats
    """(n_robots, n_points, 3) place of every point force, world [m]."""
    point_change: Floats
    """(n_robots, n_points, 3, n_q) its derivatives by the unknowns."""
    point_rotation: Floats
    """(n_robots, n_points, 3, n_q) rotation of the cross-section there by the unknowns."""


@kernel
def count_from_here(work: ModalWork) -> None:
    """No inertia forces: what moves is where it is counted from."""
    for p in range(work.node.shape[0]):
        for j in range(work.node.shape[1]):
            node, history = work.node[p, j], work.history[p, j]
            for w in range(W):
                put(history, fd.H_POS, w, get(node, fd.N_POS, w))
                for k in range(3):
                    d = (
                        read(node, fd.N_R + k, w),
                        read(node, fd.N_R + 3 + k, w),
                        read(node, fd.N_R + 6 + k, w),
                    )
                    put(history, fd.H_D + 3 * k, w, d)
        for k in range(work.station.shape[1]):
            for w in range(W):
                put(work.station[p, k], fd.S_HISTORY, w, get(work.station[p, k], fd.S_POS, w))


@kernel
def write_matrix(robots: Ints, n_robots: int, work: ModalWork, sign: float, out: Floats) -> None:
    """Add the Hessian, or take it away, both halves."""
    n = len(work.q) // W
    for w in range(n_robots):
        i = robots[w]
        for a in range(n):
            for c in range(a + 1):
                value = sign * at(hessian(work), a, c, w)
                out[i, a, c] += value
                if c < a:
                    out[i, c, a] += value


@kernel
def write_tip(robots: Ints, n_robots: int, work: ModalWork, out: ModalDerivatives) -> None:
    """Gradient, and pose and motion of the tip."""
    n_modes, node = work.end.shape[1], work.node[-1, work.node.shape[1] - 1]
    for w in range(n_robots):
        i, r = robots[w], get_mat(node, fd.N_R, w)
        scatter(out.position[i], get(node, fd.N_POS, w))
        force, dead = get(work.outside, 0, w), get(work.outside, 9, w)
        scatter(out.force[i], (force[0] - dead[0], force[1] - dead[1], force[2] - dead[2]))
        for k in range(3):
            scatter(out.rotation[i, k], (r[3 * k], r[3 * k + 1], r[3 * k + 2]))
        for a in range(len(work.q) // W):
            out.gradient[i, a] = read(work.gradient, a, w)
            moved, th = tip_motion(a // n_modes, a % n_modes, w, work)
            for k in range(3):
                out.tip[i, k, a], out.tip[i, 3 + k, a] = moved[k], th[k]


@inline
def displaced(p: int, c: int, row: Floats, w: int, b: ModalBasis, work: ModalWork) -> Vec:
    """Displacement of a place of piece p, whose row of the integration this is, by mode c of the piece."""
    moved = (0.0, 0.0, 0.0)
    for j in range(b.node.shape[0]):
        moved = axpy(row[j], get(work.column[p, c, j], fd.C_V, w), moved)
    return scale(read(work.piece[p], fd.P_L, w), moved)


@inline
def carried(p: int, c: int, place: Vec, w: int, work: ModalWork) -> tuple[Vec, Vec]:
    """Displacement and rotation of a place beyond piece p by its mode c."""
    th = get(work.end[p, c], 3, w)
    arm = sub(place, get(work.node[p, work.node.shape[1] - 1], fd.N_POS, w))
    return add(get(work.end[p, c], 0, w), cross(th, arm)), th


@kernel
def write_nodes(robots: Ints, n_robots: int, b: ModalBasis, work: ModalWork, out: ModalDerivatives) -> None:
    """Numbers of the nodes that have inertia, and their change by the unknowns."""
    n_pieces, n_nodes, n_modes = work.node.shape[0], work.node.shape[1], work.end.shape[1]
    for w in range(n_robots):
        i, m = robots[w], 0
        for p in range(n_pieces):
            mass = read(work.piece[p], fd.P_L, w) * read(work.piece[p], fd.P_RHO, w)
            for j in range(n_nodes):
                if out.line.shape[1] > 0:
                    extent = b.integral[-1, j] * read(work.piece[p], fd.P_L, w)
                    scatter(
                        out.line[i, p * n_nodes + j], scale(extent, get(work.history[p, j], fd.H_FOLLOW, w))
                    )
                node, place = work.node[p, j], get(work.node[p, j], fd.N_POS, w)
                for f in range(NODE_VECTORS):
                    out.number[i, m + f] = node_number(node, f, w)
                    spin = read(work.history[p, j], fd.H_J + max(f - 3, 0) // 3, w)
                    out.inertia[i, m + f] = b.integral[-1, j] * mass if f < 3 else spin
                for a in range((p + 1) * n_modes):
                    before, c = a // n_modes, a % n_modes
                    if before < p:
                        moved, th = carried(before, c, place, w, work)
                    else:
                        th = get(work.column[p, c, j], fd.C_TH, w)
                        moved = displaced(p, c, b.integral[j], w, b, work)
                    for k in range(3):
                        out.number_change[i, m + k, a] = moved[k]
                        d = (
                            read(node, fd.N_R + k, w),
                            read(node, fd.N_R + 3 + k, w),
                            read(node, fd.N_R + 6 + k, w),
                        )
                        turned = cross(th, d)
                        for f in range(3):
                            out.number_change[i, m + 3 + 3 * k + f, a] = turned[f]
                m += NODE_VECTORS


@inline
def _moved_by(a: int, p: int, place: Vec, row: Floats, w: int, batch: ModalBatch, work: ModalWork) -> Vec:
    """Displacement of a place of piece p, whose row of the integration this is, by unknown a."""
    before, c = a // work.end.shape[1], a % work.end.shape[1]
    if before < p:
        moved, _ = carried(before, c, place, w, work)
        return moved
    return displaced(p, c, row, w, batch.basis, work)


@kernel
def write_lumps(
    robots: Ints, n_robots: int, batch: ModalBatch, work: ModalWork, out: ModalDerivatives
) -> None:
    """See `write_nodes`, of the lumps."""
    row = work.scratch
    n_pieces, n_nodes, n_modes = work.node.shape[0], work.node.shape[1], work.end.shape[1]
    n = n_lumps(batch.motion, work)
    for w in range(n_robots):
        i, m = robots[w], NODE_VECTORS * n_pieces * n_nodes
        for p in range(n_pieces):
            for k in range(n):
                station = work.station[p, k]
                place = get(station, fd.S_POS, w)
                for j in range(n_nodes):
                    row[j] = read(station, fd.S_ROW + j, w)
                scatter(out.number[i, m : m + 3], place)
                mass = read(station, fd.S_MASS, w)
                scatter(out.inertia[i, m : m + 3], (mass, mass, mass))
                for a in range((p + 1) * n_modes):
                    moved = _moved_by(a, p, place, row, w, batch, work)
                    for f in range(3):
                        out.number_change[i, m + f, a] = moved[f]
                m += 3


@kernel
def write_points(
    robots: Ints, n_robots: int, batch: ModalBatch, work: ModalWork, out: ModalDerivatives
) -> None:
    """Place of the point forces, and its motion and rotation by the unknowns."""
    row, n_points, n_modes = work.scratch, batch.points.piece.shape[1], work.end.shape[1]
    for w in range(n_robots):
        i = robots[w]
        for q in range(n_points):
            p = batch.points.piece[i, q]
            station = work.station[p, work.station.shape[1] - n_points + q]
            place = get(station, fd.S_POS, w)
            for j in range(work.node.shape[1]):
                row[j] = read(station, fd.S_ROW + j, w)
            scatter(out.point[i, q], place)
            slope = batch.points.slope[i, q]
            for a in range((p + 1) * n_modes):
                moved, turned = _moved_by(a, p, place, row, w, batch, work), (0.0, 0.0, 0.0)
                if a < p * n_modes:
                    turned = get(work.end[a // n_modes, a % n_modes], 3, w)
                else:
                    for j in range(work.node.shape[1]):
                        turned = axpy(slope[j], get(work.column[p, a % n_modes, j], fd.C_TH, w), turned)
                for f in range(3):
                    out.point_change[i, q, f, a] = moved[f]
                    out.point_rotation[i, q, f, a] = turned[f]


@kernel
def write_base(
    robots: Ints, n_robots: int, batch: ModalBatch, work: ModalWork, out: ModalDerivatives
) -> None:
    """Six unknowns more of a base that gives way, its displacement and rotation: gradient, Hessian, and the
    motion of the point forces."""
    n_q, n_points = len(work.q) // W, out.point_change.shape[1]
    demand_of_base(robots, batch.basis, batch.motion, work, work.scratch)
    for w in range(n_robots):
        i, base, on = robots[w], get(work.base, 9, w), read(work.host, fd.G_ON, w) > 0.0
        for r in range(6):
            a = n_q + r
            if not on:
                out.hessian[i, a, a] = 1.0
                continue
            out.gradient[i, a] = read(work.scratch, r, w)
            for c in range(r + 1):
                stiffness = rigid_stiffness(work, r, c, w) + read(work.host, fd.G_P + 6 * r + c, w)
                out.hessian[i, a, n_q + c] = out.hessian[i, n_q + c, a] = stiffness
            for c in range(n_q):
                coupled = read(work.host_change, r * n_q + c, w)
                out.hessian[i, a, c] = out.hessian[i, c, a] = coupled
            axis = (1.0 if r % 3 == 0 else 0.0, 1.0 if r % 3 == 1 else 0.0, 1.0 if r % 3 == 2 else 0.0)
            for q in range(n_points):
                place = (out.point[i, q, 0], out.point[i, q, 1], out.point[i, q, 2])
                moved = cross(axis, sub(place, base)) if r >= 3 else axis
                for f in range(3):
                    out.point_change[i, q, f, a] = moved[f]
                    out.point_rotation[i, q, f, a] = axis[f] if r >= 3 else 0.0


@kernel
def derivatives_of_modes(
    robots: Ints,
    n_robots: int,
    run: ModalRun,
    batch: ModalBatch,
    unknowns: Floats,
    every: ModalWork,
    out: ModalDerivatives,
) -> None:
    """Derivatives of a chunk at `unknowns` (n_robots, n_q, six more where bases give way): at rest, or in a
    step of `run` from the motion in `batch`."""
    work, command, jump = one_task(every, 0), run.command[0], run.lanes[0, 0]
    gather_all(robots, batch, command, work)
    for w in range(W):
        jump[w] = 0.0 if run.kind == AFTER_JUMP else run.jump[robots[w]]
        work.scheme[w], work.scheme[W + w] = 0.0, 0.0
    if run.kind != REST:
        scheme = Scheme(BDF1 if run.kind == AFTER_JUMP else run.kind, run.dt, run.rho)
        begin_step(robots, batch.motion, scheme, jump, work)
        if run.kind == AFTER_JUMP:
            base_soon(robots, batch.motion, scheme, run.dt, work.base)
        if work.piece[0, fd.P_UNEVEN * W] > 0.0:
            curvature_counted_from(batch.basis, work)
    if run.kind == REST or run.kind == AFTER_JUMP:
        no_host(work)
    else:
        start_host(robots, batch.host, batch.motion, Scheme(run.kind, run.dt, run.rho), jump, work)
    for w in range(W):
        for a in range(len(work.q) // W):
            write(work.q, a, w, unknowns[robots[w], a])
    if hosted(work):
        put_base(robots, unknowns, work)
    sweep(batch.basis, batch.pieces.first_tendon, command, work, True)
    follow(work)
    assemble(batch.basis, batch.pieces.first_tendon, work)
    write_tip(robots, n_robots, work, out)
    if len(out.number) > 0:
        write_nodes(robots, n_robots, batch.basis, work, out)
        write_lumps(robots, n_robots, batch, work, out)
    if len(out.point) > 0:
        write_points(robots, n_robots, batch, work, out)
    if len(out.hessian) > 0:
        write_matrix(robots, n_robots, work, 1.0, out.hessian)
        if hosted(work):
            write_base(robots, n_robots, batch, work, out)
    if len(out.damping) > 0:
        write_matrix(robots, n_robots, work, 1.0, out.damping)
        for w in range(W):
            work.scheme[W + w] = 0.0
        assemble(batch.basis, batch.pieces.first_tendon, work)
        write_matrix(robots, n_robots, work, -1.0, out.damping)
    if len(out.mass) > 0:
        write_matrix(robots, n_robots, work, -1.0, out.mass)
        count_from_here(work)
        for w in range(W):
            work.scheme[w], work.scheme[W + w] = 1.0, 0.0
        assemble(batch.basis, batch.pieces.first_tendon, work)
        write_matrix(robots, n_robots, work, 1.0, out.mass)


@entry
def scheme_table(kind: int, dt: float, rho: float, counted: Floats, rate: Floats, moved: Floats) -> float:
    """alpha of a scheme, and its linear maps: `counted` (4,) r~ by place, velocity and the two others, `rate`
    (3,) q~ by q, rate and other, `moved` (4, 5) those four after the step by them and the new place."""
    s = Scheme(kind, dt, rho)
    for k in range(5):
        x, v, x_other = 1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0
        v_other, new = 1.0 if k == 3 else 0.0, 1.0 if k == 4 else 0.0
        if k < 4:
            counted[k] = counted_from(s, x, v, x_other, v_other)
        if k < 3:
            rate[k] = rate_counted_from(s, x, v, x_other)
        moved[0, k], moved[1, k], moved[2, k], moved[3, k] = moved_on(s, new, x, v, x_other, v_other)
    return factors(s)[0]
