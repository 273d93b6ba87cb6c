"""Output of a chunk of modes: cross-sections at even arclengths, energies, the wrench on the base."""

from __future__ import annotations

from typing import NamedTuple

from fastrod.types import Floats, Ints, RodShape

from ...jit import inline, kernel
from ...vec import Vec, add, axpy, cross, matmul, scale, sub
from ..gather import pick, scatter
from ..lanes import Lanes, W, get, get_mat, read
from .balance import balance_of_piece, pass_on, start_at_tip
from .fields import (
    B_F,
    B_M,
    BEYOND,
    H_J,
    N_F,
    N_POS,
    N_R,
    N_T,
    P_K,
    P_L,
    P_RHO,
    S_F,
    S_MASS,
    S_ROW,
    ModalWork,
)
from .gather import ModalBatch, along
from .host import hosted, show_exchange
from .modes import ModalBasis
from .motion import NODE_VECTORS, ModalMotion, n_lumps
from .sweep import MAGNUS, exp_series, rotation_of
from .tendons import path


class ModalSamples(NamedTuple):
    """Positions of the cross-sections that are shown: the same fractions of every robot."""

    piece: Ints
    """(n_points,)"""
    interval: Ints
    """(n_points,) of the piece in which it lies."""
    width: Floats
    """(n_points,) from the node before it, as a fraction of the piece."""
    at_gauss: Floats
    """(n_points, 2, n_degrees) modes at the Gauss points of that stretch."""
    here: Floats
    """(n_points, n_degrees) modes at the point."""
    place: Floats
    """(n_points, 3) of those two Gauss points and of the point, as fractions of its segment."""
    row: Floats
    """(n_points, N + 1) integration to the point."""
    lagrange: Floats
    """(n_points, N + 1) interpolation at the point."""


class MotionShape(NamedTuple):
    """Shape data of a rod in motion beside its shape at rest; arrays of length 0 are not wanted."""

    velocity: Floats
    """(n_robots, n_points, 3) world [m/s]."""
    strain: Floats
    """(n_robots, n_points, 3) shear along d1 and d2, stretch."""
    kinetic_energy: Floats
    """(n_robots,) [J]"""
    strain_energy: Floats
    """(n_robots,) of the backbone [J]."""


class ModalOutput(NamedTuple):
    """Output of a pass; arrays of length 0 are not wanted."""

    samples: ModalSamples
    shape: RodShape
    motion: MotionShape


@inline
def modes_at(p: int, table: Floats, b: ModalBasis, work: ModalWork, w: int) -> tuple[Vec, Vec]:
    """u - u* and v - e3 where the degrees have these values."""
    n_modes = b.component.shape[0]
    u0, u1, u2, v0, v1, v2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(n_modes):
        c, value = b.component[a], table[b.degree[a]] * read(work.q, p * n_modes + a, w)
        u0 += value if c == 0 else 0.0
        u1 += value if c == 1 else 0.0
        u2 += value if c == 2 else 0.0
        v0 += value if c == 3 else 0.0
        v1 += value if c == 4 else 0.0
        v2 += value if c == 5 else 0.0
    return (u0, u1, u2), (v0, v1, v2)


@kernel
def show_point(
    m: int, w: int, i: int, samples: ModalSamples, batch: ModalBatch, work: ModalWork, shape: RodShape
) -> None:
    """Pose, curvature and total internal moment of cross-section m of lane w, robot i."""
    p, j, b, ports = samples.piece[m], samples.interval[m], batch.basis, batch.ports
    piece, node, k = work.piece[p], work.node[p], batch.pieces.segment[p]
    table = ports.precurvature[pick(i, len(ports.precurvature)), k]
    stiffness = along(ports.stiffness[pick(i, len(ports.stiffness)), k], samples.place[m, 2])
    u_star = along(table, samples.place[m, 2])
    h = samples.width[m] * read(piece, P_L, w)
    first = add(along(table, samples.place[m, 0]), modes_at(p, samples.at_gauss[m, 0], b, work, w)[0])
    second = add(along(table, samples.place[m, 1]), modes_at(p, samples.at_gauss[m, 1], b, work, w)[0])
    o = axpy(MAGNUS * h * h, cross(first, second), scale(0.5 * h, add(first, second)))
    series, _ = exp_series(o)
    r = matmul(get_mat(node[j], N_R, w), rotation_of(o, series))
    place = get(node[0], N_POS, w)
    for k in range(b.node.shape[0]):
        place = axpy(samples.row[m, k] * read(piece, P_L, w), get(node[k], N_T, w), place)
    bent, strain = modes_at(p, samples.here[m], b, work, w)
    v = (strain[0], strain[1], 1.0 + strain[2])
    moment = (stiffness[0] * bent[0], stiffness[1] * bent[1], stiffness[2] * bent[2])
    u = add(u_star, bent)
    for t in range(len(work.tension) // W):
        x, y = read(work.offset[p], 2 * t, w), read(work.offset[p], 2 * t + 1, w)
        if x != 0.0 or y != 0.0:
            _, d, _ = path(u, v, x, y)
            moment = axpy(read(work.tension, t, w), (y * d[2], -x * d[2], x * d[1] - y * d[0]), moment)
    scatter(shape.position[i, m], place)
    scatter(shape.curvature[i, m], u)
    scatter(shape.moment[i, m], moment)
    for a in range(3):
        scatter(shape.rotation[i, m, a], (r[3 * a], r[3 * a + 1], r[3 * a + 2]))


@kernel
def show_motion(
    m: int, w: int, i: int, samples: ModalSamples, b: ModalBasis, motion: ModalMotion, work: ModalWork
) -> tuple[Vec, Vec]:
    """Velocity, and the strains, of cross-section m."""
    p, n = samples.piece[m], b.node.shape[0]
    velocity = (0.0, 0.0, 0.0)
    for k in range(n):
        at = (p * n + k) * NODE_VECTORS
        here = (motion.velocity[i, at], motion.velocity[i, at + 1], motion.velocity[i, at + 2])
        velocity = axpy(samples.lagrange[m, k], here, velocity)
    return velocity, modes_at(p, samples.here[m], b, work, w)[1]


@kernel
def show_forces(
    robots: Ints, n_robots: int, samples: ModalSamples, b: ModalBasis, work: ModalWork, shape: RodShape
) -> None:
    """Total internal force along the rod and the wrench on the base, from the balance of the last shape."""
    n_pieces, n = work.piece.shape[0], b.width.shape[0]
    start_at_tip(work)
    for step in range(n_pieces):
        p = n_pieces - 1 - step
        balance_of_piece(p, b, work)
        for m in range(len(samples.piece)):
            if samples.piece[m] == p:
                for w in range(n_robots):
                    force = scale(-1.0, get(work.beyond[0], B_F, w))
                    for k in range(n + 1):
                        beyond = 1.0 - samples.row[m, k] / b.integral[n, k]
                        force = axpy(-beyond, get(work.node[p, k], N_F, w), force)
                    for k in range(work.station.shape[1]):
                        station = work.station[p, k]
                        # a station's last weight is that of its place
                        if _beyond(station, samples, m, b, w):
                            force = sub(force, get(station, S_F, w))
                    scatter(shape.force[robots[w], m], force)
        pass_on(p, b, work)
        for f in range(BEYOND * W):
            work.beyond[0, f] = work.beyond[1, f]
    for w in range(n_robots):
        force, moment = get(work.beyond[0], B_F, w), get(work.beyond[0], B_M, w)
        scatter(shape.base_wrench[robots[w], :3], scale(-1.0, force))
        scatter(shape.base_wrench[robots[w], 3:], scale(-1.0, moment))


@inline
def _beyond(station: Lanes, samples: ModalSamples, m: int, b: ModalBasis, w: int) -> bool:
    """A station lies beyond cross-section m: the integrals of 1 to both places, which are their places."""
    there, here = 0.0, 0.0
    for k in range(b.node.shape[0]):
        there += read(station, S_ROW + k, w)
        here += samples.row[m, k]
    return there > here


@kernel
def energies(w: int, i: int, b: ModalBasis, motion: ModalMotion, work: ModalWork) -> tuple[float, float]:
    """Kinetic energy, and strain energy of the backbone."""
    n, n_modes = b.width.shape[0], b.component.shape[0]
    kinetic, strain = 0.0, 0.0
    for p in range(work.piece.shape[0]):
        piece = work.piece[p]
        for k in range(n + 1):
            at, mass = (p * (n + 1) + k) * NODE_VECTORS, b.integral[n, k] * read(piece, P_L, w)
            mass *= read(piece, P_RHO, w)
            for f in range(NODE_VECTORS):
                spin = read(work.history[p, k], H_J + max(f - 3, 0) // 3, w)
                kinetic += 0.5 * (mass if f < 3 else spin) * motion.velocity[i, at + f] ** 2
        for k in range(n_lumps(motion, work)):
            at = work.piece.shape[0] * (n + 1) * NODE_VECTORS + 3 * (p * n_lumps(motion, work) + k)
            for f in range(3):
                kinetic += 0.5 * read(work.station[p, k], S_MASS, w) * motion.velocity[i, at + f] ** 2
        for a in range(n_modes):
            q = read(work.q, p * n_modes + a, w)
            gram = 0.5 / (2.0 * b.degree[a] + 1.0)
            strain += gram * read(piece, P_L, w) * read(piece, P_K + b.component[a], w) * q * q
    return kinetic, strain


@kernel
def show_tip(robots: Ints, n_robots: int, b: ModalBasis, work: ModalWork, shape: RodShape) -> None:
    """Pose of the tip."""
    tip = work.node[work.piece.shape[0] - 1, b.width.shape[0]]
    for w in range(n_robots):
        i, r = robots[w], get_mat(tip, N_R, w)
        scatter(shape.tip_position[i], get(tip, N_POS, w))
        for a in range(3):
            scatter(shape.tip_rotation[i, a], (r[3 * a], r[3 * a + 1], r[3 * a + 2]))


@kernel
def show_chunk(robots: Ints, n_robots: int, batch: ModalBatch, output: ModalOutput, work: ModalWork) -> None:
    """Everything that is wanted of a chunk."""
    b, samples, motion = batch.basis, output.samples, batch.motion
    shape, moving = output.shape, output.motion
    show_tip(robots, n_robots, b, work, shape)
    for w in range(n_robots if len(moving.kinetic_energy) > 0 else 0):
        i = robots[w]
        moving.kinetic_energy[i], moving.strain_energy[i] = energies(w, i, b, motion, work)
    if len(shape.position) == 0:
        return
    for m in range(len(samples.piece)):
        for w in range(n_robots):
            i = robots[w]
            show_point(m, w, i, samples, batch, work, shape)
            velocity, strain = show_motion(m, w, i, samples, b, motion, work)
            scatter(moving.velocity[i, m], velocity)
            scatter(moving.strain[i, m], strain)
            shape.arclength[i, m] = arclength(m, w, samples, batch, work)
    show_forces(robots, n_robots, samples, b, work, shape)
    if hosted(work):
        show_exchange(robots, n_robots, batch.host, b, motion, work)
    for w in range(n_robots):
        for t in range(len(work.tension) // W):
            shape.tension[robots[w], t] = read(work.tension, t, w)
            shape.path_length[robots[w], t] = read(work.path_length, t, w)


@inline
def arclength(m: int, w: int, samples: ModalSamples, batch: ModalBatch, work: ModalWork) -> float:
    """Arclength of cross-section m [m], without stretch."""
    pieces, before = batch.pieces, 0.0
    for p in range(samples.piece[m]):
        before += read(work.piece[p], P_L, w)
    p = samples.piece[m]
    first, last = pieces.bound[p, 0], pieces.bound[p, 1]
    return float(before + (samples.place[m, 2] - first) / (last - first) * read(work.piece[p], P_L, w))
