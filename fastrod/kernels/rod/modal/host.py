"""The base as six more unknowns: a body that gives way to the rod within the step.

The body's engine moves it to x_free without the rod, the semi-implicit way of rigid-body engines: velocity
from the forces, then position from the velocity. With the rod it comes to x_free + d, and momentum says
  P d = w,   P = Lambda / dt^2,
Lambda the body's inertia at the base point, w the mean over the step of the wrench that the rod exerts: what
acts on the rod from outside, less its change of momentum, so that rod and body exchange momentum and lose
none. Of the acceleration at the end the mean has kappa = g / (dt alpha). Divided by it this is one system
with the balance of the modes, symmetric but for what a step leaves out; the modes are eliminated by the
factor that is there. What Newton's method leaves moves the body by P^-1 of it: a light one needs more steps.
"""

from __future__ import annotations

from typing import NamedTuple

from fastrod.types import Floats, Ints

from ...jit import inline, kernel
from ...vec import Vec, add, axpy, cross, dot, exp_map, matmul, scale, sub
from ..gather import scatter
from ..lanes import LaneMatrix, Lanes, W, at, clear, get, get_mat, put, put_mat, read, write, write_at
from . import fields as fd
from .cholesky import factor, forward, solve
from .fields import ModalWork, hessian
from .modes import ModalBasis
from .motion import ModalMotion, Scheme, factors, moved_on, n_lumps, node_number, scheme_of


class ModalHost(NamedTuple):
    """Bodies that carry the bases; arrays of length 0 where the motion of every base is prescribed."""

    inertia: Floats
    """(n_robots, 6, 6) about the base point, world: force [N] and moment [N m] by linear and angular
    acceleration; 0 where the motion of the base is prescribed."""
    mobility: Floats
    """(n_robots, 6, 6) its inverse [1/kg, 1/(kg m^2)], singular where the base is held in some
    directions."""
    moved: Floats
    """(n_robots, 6) out: displacement [m] and rotation vector of the base from `Ports.base_pose`, world."""
    wrench: Floats
    """(n_robots, 6) out: mean over the step, about where the base point was at its start, world."""
    stiffness: Floats
    """(n_robots, 6, 6) out: what the base must give the rod at the end of the step by its displacement and
    rotation [N/m, N, N m]; of the shape before the last Newton step."""


NEAR = 0.3
"""rad, and of the first piece's length: a base that is further off was put elsewhere."""


@inline
def _three(a: Floats, m: int) -> Vec:
    return a[m], a[m + 1], a[m + 2]


@inline
def hosted(work: ModalWork) -> bool:
    """A base of the chunk gives way."""
    return bool(work.host[fd.G_ANY * W] > 0.0)


@inline
def _soon(s: Scheme, motion: ModalMotion, i: int, m: int) -> Vec:
    """Three numbers a step later, at their velocity."""
    return axpy(s.dt, _three(motion.velocity[i], m), _three(motion.place[i], m))


@kernel
def no_host(work: ModalWork) -> None:
    """Every base is at its prescribed pose."""
    clear(work.host)


@kernel
def start_host(
    robots: Ints, host: ModalHost, motion: ModalMotion, each: Scheme, jump: Lanes, work: ModalWork
) -> None:
    """After `begin_step`: the bodies' inertia, and where they would be."""
    to = work.host
    clear(to)
    if len(host.inertia) == 0:
        return
    for w in range(W):
        i, s = robots[w], scheme_of(each, jump[w])
        on = host.inertia[i, 0, 0] > 0.0
        alpha, g = factors(s)
        kappa = g / (s.dt * alpha)
        write(to, fd.G_ON, w, 1.0 if on else 0.0)
        write(to, fd.G_ANY, 0, max(read(to, fd.G_ANY, 0), 1.0 if on else 0.0))
        write(to, fd.G_KAPPA, w, kappa)
        write(to, fd.G_SCHEME, w, float(s.kind))
        write(to, fd.G_SCHEME + 1, w, s.dt)
        write(to, fd.G_SCHEME + 2, w, s.rho)
        put(to, fd.G_START, w, _three(motion.place[i], 0))
        for k in range(36):
            write(to, fd.G_P + k, w, host.inertia[i, k // 6, k % 6] / (kappa * s.dt * s.dt))
        put_mat(to, fd.G_FREE, w, get_mat(work.base, 0, w))
        put(to, fd.G_FREE + 9, w, get(work.base, 9, w))
        if not on:
            continue
        start_near(w, i, s, motion, work)


@inline
def start_near(w: int, i: int, s: Scheme, motion: ModalMotion, work: ModalWork) -> None:
    """Newton's method begins with the base where the rod was leading it, as with the modes: a body that is
    held is always elsewhere than the rod alone would have it."""
    r, turned = get_mat(work.host, fd.G_FREE, w), (0.0, 0.0, 0.0)
    for k in range(3):
        d = (r[k], r[3 + k], r[6 + k])
        turned = axpy(0.5, cross(d, _soon(s, motion, i, 3 + 3 * k)), turned)
    moved = sub(_soon(s, motion, i, 0), get(work.host, fd.G_FREE + 9, w))
    near = (
        dot(turned, turned) < NEAR * NEAR and dot(moved, moved) < (NEAR * read(work.piece[0], fd.P_L, w)) ** 2
    )
    put(work.host, fd.G_D, w, moved if near else (0.0, 0.0, 0.0))
    put(work.host, fd.G_D + 3, w, turned if near else (0.0, 0.0, 0.0))


@kernel
def place_base(work: ModalWork) -> None:
    """The base where its body has come to."""
    for w in range(W):
        turned, _, _, _ = exp_map(get(work.host, fd.G_D + 3, w))
        put_mat(work.base, 0, w, matmul(turned, get_mat(work.host, fd.G_FREE, w)))
        put(work.base, 9, w, add(get(work.host, fd.G_FREE + 9, w), get(work.host, fd.G_D, w)))


@inline
def put_base(robots: Ints, given: Floats, work: ModalWork) -> None:
    """The displacement of the bases, behind the unknowns of the rods (n_robots, n_q + 6)."""
    n_q = len(work.q) // W
    for k in range(6):
        for w in range(W):
            write(work.host, fd.G_D + k, w, given[robots[w], n_q + k])


@kernel
def couple_piece(p: int, b: ModalBasis, work: ModalWork) -> None:
    """Work of a displacement and a rotation of the base on the modes of a piece, from `work.coupling` about
    the start of the piece."""
    n_modes, n_q = b.component.shape[0], len(work.q) // W
    for w in range(W):
        arm = sub(get(work.node[p, 0], fd.N_POS, w), get(work.base, 9, w))
        for a in range(n_modes):
            pushed = get(work.coupling[a], 0, w)
            turned = add(get(work.coupling[a], 3, w), cross(arm, pushed))
            for k in range(3):
                write(work.host_change, k * n_q + p * n_modes + a, w, pushed[k])
                write(work.host_change, (3 + k) * n_q + p * n_modes + a, w, turned[k])


@inline
def inertia_about_base(w: int, b: ModalBasis, motion: ModalMotion, work: ModalWork) -> tuple[Vec, Vec]:
    """Force and moment about the base point that the accelerations at the end of the step need."""
    base, alpha, n = get(work.base, 9, w), work.scheme[w], b.width.shape[0]
    force, moment = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for p in range(work.node.shape[0]):
        piece = work.piece[p]
        for j in range(n + 1):
            node, mass = work.node[p, j], b.integral[n, j] * read(piece, fd.P_L, w) * read(piece, fd.P_RHO, w)
            moved = sub(get(node, fd.N_POS, w), get(work.history[p, j], fd.H_POS, w))
            f = scale(mass * alpha, moved)
            force, moment = add(force, f), add(moment, get(node, fd.N_C, w))
            moment = add(moment, cross(sub(get(node, fd.N_POS, w), base), f))
        for k in range(n_lumps(motion, work)):
            station = work.station[p, k]
            moved = sub(get(station, fd.S_POS, w), get(station, fd.S_HISTORY, w))
            f = scale(read(station, fd.S_MASS, w) * alpha, moved)
            force = add(force, f)
            moment = add(moment, cross(sub(get(station, fd.S_POS, w), base), f))
    return force, moment


@inline
def rigid_stiffness(work: ModalWork, r: int, c: int, w: int) -> float:
    """Entry (r >= c) of H_bb: what the base must give by its own displacement and rotation, the modes
    held."""
    beyond = work.beyond[0]
    if r < 3:
        return read(beyond, fd.B_MASS, w) if r == c else 0.0
    if c < 3:  # [c]x of the first moment
        x, y, z = get(beyond, fd.B_FIRST, w)
        row, first = r - 3, (0.0, -z, y)
        if row == 1:
            first = (z, 0.0, -x)
        elif row == 2:
            first = (-y, x, 0.0)
        return first[c]
    one, other = (
        read(beyond, fd.B_BACK + 3 * (r - 3) + c - 3, w),
        read(beyond, fd.B_BACK + 3 * (c - 3) + r - 3, w),
    )
    return 0.5 * (one + other)


@inline
def _from_outside(w: int, b: ModalBasis, motion: ModalMotion, work: ModalWork) -> tuple[Vec, Vec]:
    """Force and moment, about where the base point was, that act on the rod at the end of the step: what its
    inertia needs, less what the base gives it."""
    force, moment = inertia_about_base(w, b, motion, work)
    force = sub(force, get(work.beyond[0], fd.B_F, w))
    moment = sub(moment, get(work.beyond[0], fd.B_M, w))
    arm = sub(get(work.base, 9, w), get(work.host, fd.G_START, w))
    return force, add(moment, cross(arm, force))


@inline
def _gained(w: int, i: int, b: ModalBasis, motion: ModalMotion, work: ModalWork) -> tuple[Vec, Vec]:
    """Change of momentum of robot i over the step, over dt, about where the base point was."""
    start = get(work.host, fd.G_START, w)
    n, m, force, moment = b.width.shape[0], 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for p in range(work.node.shape[0]):
        piece = work.piece[p]
        for j in range(n + 1):
            node, mass = work.node[p, j], b.integral[n, j] * read(piece, fd.P_L, w) * read(piece, fd.P_RHO, w)
            for k in range(4):
                new = (
                    node_number(node, 3 * k, w),
                    node_number(node, 3 * k + 1, w),
                    node_number(node, 3 * k + 2, w),
                )
                weight = mass if k == 0 else read(work.history[p, j], fd.H_J + k - 1, w)
                f, turning = _momentum(w, motion, i, m, new, start if k == 0 else (0.0, 0.0, 0.0), work)
                force = axpy(weight, f, force) if k == 0 else force
                moment = axpy(weight, turning, moment)
                m += 3
    for p in range(work.station.shape[0]):
        for k in range(n_lumps(motion, work)):
            weight = read(work.station[p, k], fd.S_MASS, w)
            f, turning = _momentum(w, motion, i, m, get(work.station[p, k], fd.S_POS, w), start, work)
            force, moment = axpy(weight, f, force), axpy(weight, turning, moment)
            m += 3
    return force, moment


@inline
def _momentum(
    w: int, motion: ModalMotion, i: int, m: int, new: Vec, about: Vec, work: ModalWork
) -> tuple[Vec, Vec]:
    """Change over the step of the velocity of three numbers, and of its moment, over dt."""
    to = work.host
    s = Scheme(int(read(to, fd.G_SCHEME, w)), read(to, fd.G_SCHEME + 1, w), read(to, fd.G_SCHEME + 2, w))
    x, v, a, c = motion.place[i], motion.velocity[i], motion.place_other[i], motion.velocity_other[i]
    v0 = moved_on(s, new[0], x[m], v[m], a[m], c[m])[1]
    v1 = moved_on(s, new[1], x[m + 1], v[m + 1], a[m + 1], c[m + 1])[1]
    after = (v0, v1, moved_on(s, new[2], x[m + 2], v[m + 2], a[m + 2], c[m + 2])[1])
    before = _three(v, m)
    turning = sub(cross(sub(new, about), after), cross(sub(_three(x, m), about), before))
    return scale(1.0 / s.dt, sub(after, before)), scale(1.0 / s.dt, turning)


@kernel
def demand_of_base(robots: Ints, b: ModalBasis, motion: ModalMotion, work: ModalWork, right: Lanes) -> None:
    """Derivative of the energy by displacement and rotation of the bases, which is zero where P d = w, into
    `right` (6,), and G_PULL."""
    to = work.host
    for w in range(W):
        force, moment = _from_outside(w, b, motion, work)
        gained, turning = _gained(w, robots[w], b, motion, work)
        force, moment = sub(force, gained), sub(moment, turning)
        for k in range(6):
            needed, mean = read(work.beyond[0], fd.B_F + k, w), force[k] if k < 3 else moment[k - 3]
            write(to, fd.G_PULL + k, w, -mean / read(to, fd.G_KAPPA, w) - needed)
            write(right, k, w, -mean / read(to, fd.G_KAPPA, w))
    for r in range(6):
        for c in range(6):
            for w in range(W):
                spring = read(to, fd.G_P + 6 * r + c, w)
                write(right, r, w, read(right, r, w) + spring * read(to, fd.G_D + c, w))


@kernel
def base_step(robots: Ints, host: ModalHost, b: ModalBasis, motion: ModalMotion, work: ModalWork) -> None:
    """The Newton step of the bases into G_STEP, and its part in `work.gradient`, which is L^-1 g: between the
    two halves of its solution. `work.host_change` becomes L^-1 H_qb."""
    n_q, to = len(work.q) // W, work.host
    matrix, right = LaneMatrix(work.host_matrix, 6), work.scratch
    for k in range(6):
        forward(hessian(work), work.host_change[k * n_q * W : (k + 1) * n_q * W])
    demand_of_base(robots, b, motion, work, right)
    for w in range(W):
        write(to, fd.G_LIGHT, w, 0.0)
    for r in range(6):
        for c in range(r + 1):
            for w in range(W):
                write_at(matrix, r, c, w, rigid_stiffness(work, r, c, w))
            for a in range(n_q):
                for w in range(W):
                    one = read(work.host_change, r * n_q + a, w)
                    other = read(work.host_change, c * n_q + a, w)
                    write_at(matrix, r, c, w, at(matrix, r, c, w) - one * other)
            for w in range(W):
                stiffness, i = at(matrix, r, c, w), robots[w]
                if read(to, fd.G_ON, w) > 0.0:
                    host.stiffness[i, r, c] = host.stiffness[i, c, r] = stiffness
                    gives = (1.0 if r == c else 2.0) * stiffness * host.mobility[i, r, c]
                    write(to, fd.G_LIGHT, w, read(to, fd.G_LIGHT, w) + gives)
                write_at(matrix, r, c, w, stiffness + read(to, fd.G_P + 6 * r + c, w))
        for a in range(n_q):
            for w in range(W):
                less = read(work.host_change, r * n_q + a, w) * read(work.gradient, a, w)
                write(right, r, w, read(right, r, w) - less)
    for w in range(W):
        on, dt = read(to, fd.G_ON, w) > 0.0, read(to, fd.G_SCHEME + 1, w)
        write(to, fd.G_LIGHT, w, read(to, fd.G_KAPPA, w) * dt * dt * read(to, fd.G_LIGHT, w))
        for r in range(6):
            if not on:  # a base whose motion is prescribed
                write(right, r, w, 0.0)
                write_at(matrix, r, r, w, 1e300)
    factor(matrix, work.scratch[6 * W : 8 * W])
    solve(matrix, right)
    for k in range(6):
        for w in range(W):
            write(to, fd.G_STEP + k, w, read(right, k, w))
        for a in range(n_q):
            for w in range(W):
                less = read(work.host_change, k * n_q + a, w) * read(right, k, w)
                write(work.gradient, a, w, read(work.gradient, a, w) - less)


@kernel
def move_base(work: ModalWork, fraction: Lanes) -> None:
    """d -= `fraction` (1,) of the step, which is then the one that was taken."""
    for k in range(6):
        for w in range(W):
            step = fraction[w] * read(work.host, fd.G_STEP + k, w) if fraction[w] > 0.0 else 0.0
            write(work.host, fd.G_STEP + k, w, step)
            write(work.host, fd.G_D + k, w, read(work.host, fd.G_D + k, w) - step)


@kernel
def add_energy_of_base(work: ModalWork, energy: Lanes) -> None:
    """Add d . P d / 2 kappa, and what the mean over the step has beyond the end."""
    for r in range(6):
        for w in range(W):
            moved, half = read(work.host, fd.G_D + r, w), 0.0
            for c in range(6):
                half += 0.5 * read(work.host, fd.G_P + 6 * r + c, w) * read(work.host, fd.G_D + c, w)
            energy[w] += moved * (half + read(work.host, fd.G_PULL + r, w))


@kernel
def note_momentum(
    w: int, i: int, host: ModalHost, b: ModalBasis, motion: ModalMotion, work: ModalWork
) -> None:
    """Before `end_step`: where the body of robot i has come to, and what of its mean wrench is the rod's
    change of momentum."""
    force, moment = _gained(w, i, b, motion, work)
    scatter(host.wrench[i, :3], scale(-1.0, force))
    scatter(host.wrench[i, 3:], scale(-1.0, moment))
    for k in range(6):
        host.moved[i, k] = read(work.host, fd.G_D + k, w)


@kernel
def show_exchange(
    robots: Ints, n_robots: int, host: ModalHost, b: ModalBasis, motion: ModalMotion, work: ModalWork
) -> None:
    """Add to the mean wrench what acts on the rod from outside. To be called with the balance of the last
    shape in `work.beyond`."""
    for w in range(n_robots):
        if read(work.host, fd.G_ON, w) <= 0.0:
            continue
        force, moment = _from_outside(w, b, motion, work)
        for k in range(3):
            host.wrench[robots[w], k] += force[k]
            host.wrench[robots[w], 3 + k] += moment[k]
