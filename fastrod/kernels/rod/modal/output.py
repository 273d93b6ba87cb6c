"""Output of a chunk of modes: cross-sections at even arclengths, energies, the wrench on the base."""

from __future__ import annotations

from typing import NamedTuple

from fastrod.types import Floats, Ints, RodShape

from ...jit import inline, kernel
from ...vec import Vec, add, axpy, cross, matmul, scale, sub
from ..gather import pick, scatter
from ..lanes import Lanes, W, get, get_mat, put, put_mat, read, write
from . import fields as fd
from .balance import balance_of_piece, pass_on, start_at_tip
from .fields import ModalWork
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


_FIRST, _SECOND, _BENT, _STRAIN, _PLACE, _ROTATION, _SHOWN = 0, 3, 6, 9, 12, 15, 24
"""Fields of one cross-section: u at the two Gauss points before it; u - u*, v - e3, position and rotation
there."""


@kernel
def place_section(m: int, robots: Ints, samples: ModalSamples, batch: ModalBatch, work: ModalWork) -> None:
    """Cross-section m of every lane, into `work.scratch`."""
    p, j, b, at, ports = samples.piece[m], samples.interval[m], batch.basis, work.scratch, batch.ports
    n_modes, piece, node, k = b.component.shape[0], work.piece[p], work.node[p], batch.pieces.segment[p]
    for i in range(_ROTATION * W):
        at[i] = 0.0
    for a in range(n_modes):
        c, degree, q = b.component[a], b.degree[a], work.q[(p * n_modes + a) * W :]
        here = samples.here[m, degree]
        for w in range(W):
            write(at, _BENT + c, w, read(at, _BENT + c, w) + here * q[w])
        for g in range(2 if c < 3 else 0):
            field, value = _FIRST + 3 * g + c, samples.at_gauss[m, g, degree]
            for w in range(W):
                write(at, field, w, read(at, field, w) + value * q[w])
    for n in range(b.node.shape[0]):
        for w in range(W):
            tangent = axpy(samples.row[m, n], get(node[n], fd.N_T, w), get(at, _PLACE, w))
            put(at, _PLACE, w, tangent)
    for w in range(W):
        i = robots[w]
        table = ports.precurvature[pick(i, len(ports.precurvature)), k]
        put(at, _FIRST, w, add(along(table, samples.place[m, 0]), get(at, _FIRST, w)))
        put(at, _SECOND, w, add(along(table, samples.place[m, 1]), get(at, _SECOND, w)))
    for w in range(W):
        length, first, second = read(piece, fd.P_L, w), get(at, _FIRST, w), get(at, _SECOND, w)
        h = samples.width[m] * length
        o = axpy(MAGNUS * h * h, cross(first, second), scale(0.5 * h, add(first, second)))
        series, _ = exp_series(o)
        put_mat(at, _ROTATION, w, matmul(get_mat(node[j], fd.N_R, w), rotation_of(o, series)))
        put(at, _PLACE, w, axpy(length, get(at, _PLACE, w), get(node[0], fd.N_POS, w)))


@kernel
def moment_at(
    m: int, w: int, i: int, u: Vec, samples: ModalSamples, batch: ModalBatch, work: ModalWork
) -> Vec:
    """Total internal moment at cross-section m, which bends by u and is in `work.scratch`."""
    p, ports, at = samples.piece[m], batch.ports, work.scratch
    table = ports.stiffness[pick(i, len(ports.stiffness)), batch.pieces.segment[p]]
    k, bent = along(table, samples.place[m, 2]), get(at, _BENT, w)
    v = add((0.0, 0.0, 1.0), get(at, _STRAIN, w))
    moment = (k[0] * bent[0], k[1] * bent[1], k[2] * bent[2])
    for t in range(len(work.tension) // W):
        x, y = read(work.offset[p], 2 * t, w), read(work.offset[p], 2 * t + 1, w)
        if x != 0.0 or y != 0.0:
            _, d, _ = path(u, v, x, y)
            moment = axpy(read(work.tension, t, w), (y * d[2], -x * d[2], x * d[1] - y * d[0]), moment)
    return moment


@kernel
def velocity_at(m: int, i: int, samples: ModalSamples, b: ModalBasis, motion: ModalMotion) -> Vec:
    """Velocity of cross-section m of robot i."""
    p, n = samples.piece[m], b.node.shape[0]
    velocity = (0.0, 0.0, 0.0)
    for k in range(n):
        at = (p * n + k) * NODE_VECTORS
        here = (motion.velocity[i, at], motion.velocity[i, at + 1], motion.velocity[i, at + 2])
        velocity = axpy(samples.lagrange[m, k], here, velocity)
    return velocity


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
                    force = scale(-1.0, get(work.beyond[0], fd.B_F, w))
                    for k in range(n + 1):
                        beyond = 1.0 - samples.row[m, k] / b.integral[n, k]
                        force = axpy(-beyond, get(work.node[p, k], fd.N_F, w), force)
                    for k in range(work.station.shape[1]):
                        station = work.station[p, k]
                        # a station's last weight is that of its place
                        if _beyond(station, samples, m, b, w):
                            force = sub(force, get(station, fd.S_F, w))
                    scatter(shape.force[robots[w], m], force)
        pass_on(p, b, work)
        for f in range(fd.BEYOND * W):
            work.beyond[0, f] = work.beyond[1, f]
    for w in range(n_robots):
        force, moment = get(work.beyond[0], fd.B_F, w), get(work.beyond[0], fd.B_M, w)
        scatter(shape.base_wrench[robots[w], :3], scale(-1.0, force))
        scatter(shape.base_wrench[robots[w], 3:], scale(-1.0, moment))


@inline
def _beyond(station: Lanes, samples: ModalSamples, m: int, b: ModalBasis, w: int) -> bool:
    """A station lies beyond cross-section m: the integrals of 1 to both places, which are their places."""
    there, here = 0.0, 0.0
    for k in range(b.node.shape[0]):
        there += read(station, fd.S_ROW + k, w)
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
            at, mass = (p * (n + 1) + k) * NODE_VECTORS, b.integral[n, k] * read(piece, fd.P_L, w)
            mass *= read(piece, fd.P_RHO, w)
            for f in range(NODE_VECTORS):
                spin = read(work.history[p, k], fd.H_J + max(f - 3, 0) // 3, w)
                kinetic += 0.5 * (mass if f < 3 else spin) * motion.velocity[i, at + f] ** 2
        for k in range(n_lumps(motion, work)):
            at = work.piece.shape[0] * (n + 1) * NODE_VECTORS + 3 * (p * n_lumps(motion, work) + k)
            for f in range(3):
                kinetic += 0.5 * read(work.station[p, k], fd.S_MASS, w) * motion.velocity[i, at + f] ** 2
        for a in range(n_modes):
            q = read(work.q, p * n_modes + a, w)
            gram = 0.5 / (2.0 * b.degree[a] + 1.0)
            strain += gram * read(piece, fd.P_L, w) * read(piece, fd.P_K + b.component[a], w) * q * q
    return kinetic, strain


@kernel
def show_tip(robots: Ints, n_robots: int, b: ModalBasis, work: ModalWork, shape: RodShape) -> None:
    """Pose of the tip."""
    tip = work.node[work.piece.shape[0] - 1, b.width.shape[0]]
    for w in range(n_robots):
        i, r = robots[w], get_mat(tip, fd.N_R, w)
        scatter(shape.tip_position[i], get(tip, fd.N_POS, w))
        for a in range(3):
            scatter(shape.tip_rotation[i, a], (r[3 * a], r[3 * a + 1], r[3 * a + 2]))


@kernel
def show_places(
    robots: Ints, n_robots: int, batch: ModalBatch, output: ModalOutput, work: ModalWork, whole: bool
) -> None:
    """Cross-sections of a chunk: places and curvature; on the `whole` what else is known there."""
    samples, shape, at, ports = output.samples, output.shape, work.scratch, batch.ports
    for m in range(len(samples.piece)):
        place_section(m, robots, samples, batch, work)
        k = batch.pieces.segment[samples.piece[m]]
        for w in range(n_robots):
            i, r = robots[w], get_mat(at, _ROTATION, w)
            table = ports.precurvature[pick(i, len(ports.precurvature)), k]
            u = add(along(table, samples.place[m, 2]), get(at, _BENT, w))
            scatter(shape.position[i, m], get(at, _PLACE, w))
            scatter(shape.curvature[i, m], u)
            for a in range(3):
                scatter(shape.rotation[i, m, a], (r[3 * a], r[3 * a + 1], r[3 * a + 2]))
            shape.arclength[i, m] = arclength(m, w, samples, batch, work)
            if whole:
                scatter(shape.moment[i, m], moment_at(m, w, i, u, samples, batch, work))
                velocity = velocity_at(m, i, samples, batch.basis, batch.motion)
                scatter(output.motion.velocity[i, m], velocity)
                scatter(output.motion.strain[i, m], get(at, _STRAIN, w))


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
    show_places(robots, n_robots, batch, output, work, True)
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
        before += read(work.piece[p], fd.P_L, w)
    p = samples.piece[m]
    first, last = pieces.bound[p, 0], pieces.bound[p, 1]
    return float(before + (samples.place[m, 2] - first) / (last - first) * read(work.piece[p], fd.P_L, w))
