"""Time: every scheme as one residual, a = alpha (r - r~) and dq/dt = g (q - q~).

r~ and q~ come from what is remembered of the last steps alone. BDF1 and BDF2: Hairer and Wanner 1996, V.1;
generalized-alpha: Arnold and Bruels 2007. Positions, directors and their velocities are remembered in the
world frame, so that Coriolis and centrifugal forces need not be written.
"""

from __future__ import annotations

from typing import NamedTuple

from fastrod.types import Floats, Ints

from ...jit import inline, kernel
from ...vec import cross, unit
from ..lanes import Lanes, W, put_mat, read, write
from .fields import H_POS, I_HISTORY, N_POS, N_R, S_HISTORY, S_POS, ModalWork
from .modes import ModalBasis

REST, BDF1, BDF2, GENERALIZED_ALPHA = 0, 1, 2, 3
NODE_VECTORS = 12
"""Numbers of a node that have inertia: position and directors."""


class ModalMotion(NamedTuple):
    """Memory of robots in motion from one step to the next. `n` numbers have inertia: those of the nodes,
    piece after piece, then the positions of the stations."""

    q: Floats
    """(n_robots, n_q)"""
    rate: Floats
    """(n_robots, n_q) dq/dt."""
    q_other: Floats
    """(n_robots, n_q) BDF2: q one step before; generalized-alpha: its auxiliary acceleration."""
    place: Floats
    """(n_robots, n) world [m], directors."""
    velocity: Floats
    """(n_robots, n)"""
    place_other: Floats
    """(n_robots, n) BDF2: place one step before; generalized-alpha: its auxiliary acceleration."""
    velocity_other: Floats
    """(n_robots, n) BDF2: velocity one step before; generalized-alpha: the acceleration."""
    lead: Floats
    """(n_robots,) how much of its rate the last step followed, 1 if it was more than half: the next one is
    looked for there. Of inputs with noise, which the rate multiplies by 3.4 (BDF2) and no step repeats, it is
    near 0."""


class Scheme(NamedTuple):
    """One time step of a kind."""

    kind: int
    dt: float
    rho: float
    """Spectral radius at infinite frequency of generalized-alpha, below 1."""


@inline
def alpha_weights(rho: float) -> tuple[float, float, float, float]:
    """alpha_m, alpha_f, gamma, beta of generalized-alpha: second order, with damping rho at high
    frequencies."""
    am, af = (2.0 * rho - 1.0) / (rho + 1.0), rho / (rho + 1.0)
    gamma = 0.5 + af - am
    return am, af, gamma, 0.25 * (gamma + 0.5) ** 2


@inline
def factors(s: Scheme) -> tuple[float, float]:
    """alpha [1/s^2] and g [1/s]."""
    if s.kind == REST:
        return 0.0, 0.0
    if s.kind == GENERALIZED_ALPHA:
        am, af, gamma, beta = alpha_weights(s.rho)
        return (1.0 - am) / ((1.0 - af) * beta * s.dt * s.dt), gamma / (beta * s.dt)
    c0 = (1.0 if s.kind == BDF1 else 1.5) / s.dt
    return c0 * c0, c0


@inline
def counted_from(s: Scheme, x: float, v: float, x_other: float, v_other: float) -> float:
    """r~ of one number."""
    alpha, _ = factors(s)
    if s.kind == BDF1:
        return x + s.dt * v
    if s.kind == BDF2:
        c0, c1, c2 = 1.5 / s.dt, -2.0 / s.dt, 0.5 / s.dt
        return -(c0 * (c1 * x + c2 * x_other) + c1 * v + c2 * v_other) / (c0 * c0)
    am, af, _, beta = alpha_weights(s.rho)
    ahead = x + s.dt * v + s.dt * s.dt * (0.5 - beta) * x_other
    return ahead - (am * x_other - af * v_other) / ((1.0 - af) * alpha)


@inline
def rate_counted_from(s: Scheme, q: float, rate: float, q_other: float) -> float:
    """q~ of one unknown."""
    if s.kind == BDF1:
        return q
    if s.kind == BDF2:
        return (2.0 * q - 0.5 * q_other) / 1.5
    _, _, gamma, beta = alpha_weights(s.rho)
    ahead = q + s.dt * rate + s.dt * s.dt * (0.5 - beta) * q_other
    return ahead - (rate + s.dt * (1.0 - gamma) * q_other) * beta * s.dt / gamma


@inline
def moved_on(s: Scheme, new: float, x: float, v: float, x_other: float, v_other: float) -> tuple[float, ...]:
    """place, velocity, place_other, velocity_other after the step."""
    if s.kind == BDF1:
        return new, (new - x) / s.dt, x, v
    if s.kind == BDF2:
        return new, (1.5 * new - 2.0 * x + 0.5 * x_other) / s.dt, x, v
    alpha, _ = factors(s)
    _, _, gamma, beta = alpha_weights(s.rho)
    ahead = x + s.dt * v + s.dt * s.dt * (0.5 - beta) * x_other
    auxiliary = (new - ahead) / (beta * s.dt * s.dt)
    velocity = v + s.dt * ((1.0 - gamma) * x_other + gamma * auxiliary)
    return new, velocity, auxiliary, alpha * (new - counted_from(s, x, v, x_other, v_other))


@inline
def scheme_of(s: Scheme, jump: float) -> Scheme:
    """That of a robot: where its inputs have jumped a step of generalized-alpha, which begins with the
    acceleration after the jump."""
    return Scheme(GENERALIZED_ALPHA, s.dt, s.rho) if jump > 0.0 else s


@kernel
def begin_step(robots: Ints, motion: ModalMotion, each: Scheme, jump: Lanes, work: ModalWork) -> None:
    """r~, q~ and the scheme's factors into the buffers, and q as it would be if the robot kept on as it did
    in the last step. `jump` (W,)."""
    n_q, n_nodes = motion.q.shape[1], work.node.shape[1]
    for w in range(W):
        i, s = robots[w], scheme_of(each, jump[w])
        work.scheme[w], work.scheme[W + w] = factors(s)
        for a in range(n_q):
            q, rate = motion.q[i, a], motion.rate[i, a]
            write(work.q, a, w, q + motion.lead[i] * s.dt * rate)
            write(work.q_history, a, w, rate_counted_from(s, q, rate, motion.q_other[i, a]))
        m = 0
        for p in range(work.node.shape[0]):
            for j in range(n_nodes):
                for f in range(NODE_VECTORS):
                    write(work.history[p, j], H_POS + f, w, _counted(s, motion, i, m))
                    m += 1
        for p in range(work.station.shape[0]):
            for k in range(n_lumps(motion, work)):
                for f in range(3):
                    write(work.station[p, k], S_HISTORY + f, w, _counted(s, motion, i, m))
                    m += 1


@inline
def n_lumps(motion: ModalMotion, work: ModalWork) -> int:
    """Stations of a piece that have inertia; those of point forces follow them."""
    n_pieces, n_nodes = work.node.shape[0], work.node.shape[1]
    return int((motion.place.shape[1] // n_pieces - NODE_VECTORS * n_nodes) // 3)


@kernel
def curvature_counted_from(b: ModalBasis, work: ModalWork) -> None:
    """Set the origin of the rate of u - u* at the Gauss points."""
    n_modes = b.component.shape[0]
    for p in range(work.piece.shape[0]):
        for i in range(b.width.shape[0]):
            here = work.interval[p, i]
            for f in range(6 * W):
                here[I_HISTORY * W + f] = 0.0
            for a in range(n_modes):
                for g in range(2 if b.component[a] < 3 else 0):
                    f, value = I_HISTORY + 3 * g + b.component[a], b.at_gauss[i, g, b.degree[a]]
                    for w in range(W):
                        grown = read(here, f, w) + value * read(work.q_history, p * n_modes + a, w)
                        write(here, f, w, grown)


@inline
def _counted(s: Scheme, motion: ModalMotion, i: int, m: int) -> float:
    x, v = motion.place[i, m], motion.velocity[i, m]
    return counted_from(s, x, v, motion.place_other[i, m], motion.velocity_other[i, m])


@inline
def _move(kind: int, s: Scheme, motion: ModalMotion, i: int, m: int, new: float) -> None:
    x0, v0 = motion.place[i, m], motion.velocity[i, m]
    x, v, a, c = moved_on(s, new, x0, v0, motion.place_other[i, m], motion.velocity_other[i, m])
    motion.place[i, m], motion.velocity[i, m] = x, v
    backward = kind != GENERALIZED_ALPHA
    motion.place_other[i, m] = x0 if backward else a
    motion.velocity_other[i, m] = v0 if backward else c


@inline
def node_number(node: Lanes, f: int, w: int) -> float:
    """Number f of those of a node that have inertia."""
    if f < 3:
        return read(node, N_POS + f, w)
    column, row = (f - 3) // 3, (f - 3) % 3
    return read(node, N_R + 3 * row + column, w)


@kernel
def end_step(w: int, i: int, motion: ModalMotion, each: Scheme, jump: float, work: ModalWork) -> None:
    """Remember the shape of lane w, robot i, as that of the new time."""
    m, s, along, whole = 0, scheme_of(each, jump), 1e-300, 1e-300
    for a in range(motion.q.shape[1]):
        before = motion.q[i, a]
        q, rate, other, _ = moved_on(
            s, read(work.q, a, w), before, motion.rate[i, a], motion.q_other[i, a], 0.0
        )
        motion.q[i, a], motion.rate[i, a] = q, rate
        motion.q_other[i, a] = other if each.kind == GENERALIZED_ALPHA else before
    for p in range(work.node.shape[0]):
        for j in range(work.node.shape[1]):
            for f in range(NODE_VECTORS):
                if f < 3:
                    ahead = s.dt * motion.velocity[i, m]
                    along += ahead * (node_number(work.node[p, j], f, w) - motion.place[i, m])
                    whole += ahead * ahead
                _move(each.kind, s, motion, i, m, node_number(work.node[p, j], f, w))
                m += 1
    for p in range(work.station.shape[0]):
        for k in range(n_lumps(motion, work)):
            for f in range(3):
                _move(each.kind, s, motion, i, m, read(work.station[p, k], S_POS + f, w))
                m += 1
    motion.lead[i] = 1.0 if along > 0.5 * whole else max(along / whole, 0.0)


@kernel
def start_from_rest(w: int, i: int, motion: ModalMotion, kind: int, work: ModalWork) -> None:
    """Remember the shape of lane w, robot i, as one at rest."""
    was, m = 0.0 if kind == GENERALIZED_ALPHA else 1.0, 0
    motion.lead[i] = 1.0
    for a in range(motion.q.shape[1]):
        q = read(work.q, a, w)
        motion.q[i, a], motion.rate[i, a], motion.q_other[i, a] = q, 0.0, was * q
    for p in range(work.node.shape[0]):
        for j in range(work.node.shape[1]):
            for f in range(NODE_VECTORS):
                _rest(motion, i, m, was, node_number(work.node[p, j], f, w))
                m += 1
    for p in range(work.station.shape[0]):
        for k in range(n_lumps(motion, work)):
            for f in range(3):
                _rest(motion, i, m, was, read(work.station[p, k], S_POS + f, w))
                m += 1


@inline
def _rest(motion: ModalMotion, i: int, m: int, was: float, here: float) -> None:
    motion.place[i, m], motion.velocity[i, m] = here, 0.0
    motion.place_other[i, m], motion.velocity_other[i, m] = was * here, 0.0


@kernel
def base_soon(robots: Ints, motion: ModalMotion, s: Scheme, dt: float, base: Lanes) -> None:
    """Replace the base after `dt` by the one after the short step of `s`, on the way of constant acceleration
    (as BDF1 counts it: x + h v + h^2 a)."""
    h, k = s.dt, 2.0 * (s.dt / dt) ** 2
    for w in range(W):
        i = robots[w]
        for f in range(3):
            x, v = motion.place[i, f], motion.velocity[i, f]
            write(base, 9 + f, w, x + h * v + k * (read(base, 9 + f, w) - x - dt * v))
        for column in range(2):
            for row in range(3):
                f = 3 + 3 * column + row
                x, v = motion.place[i, f], motion.velocity[i, f]
                there = read(base, 3 * row + column, w)
                write(base, 3 * row + column, w, x + h * v + k * (there - x - dt * v))
        d1 = unit((base[w], base[3 * W + w], base[6 * W + w]), (1.0, 0.0, 0.0))[1]
        aside = (base[W + w], base[4 * W + w], base[7 * W + w])
        d3 = unit(cross(d1, aside), (0.0, 0.0, 1.0))[1]
        d2 = cross(d3, d1)
        put_mat(base, 0, w, (d1[0], d2[0], d3[0], d1[1], d2[1], d3[1], d1[2], d2[2], d3[2]))


@kernel
def note_accelerations(
    robots: Ints, n_robots: int, motion: ModalMotion, s: Scheme, jump: Lanes, work: ModalWork
) -> None:
    """Note the accelerations of robots that have jumped: the accelerations by a step of BDF1 that was too
    short to move them, as those with which generalized-alpha begins."""
    for w in range(n_robots):
        if jump[w] <= 0.0:
            continue
        i, m = robots[w], 0
        for a in range(motion.q.shape[1]):
            gone = motion.q[i, a] + s.dt * motion.rate[i, a]
            motion.q_other[i, a] = (read(work.q, a, w) - gone) / (s.dt * s.dt)
        for p in range(work.node.shape[0]):
            for j in range(work.node.shape[1]):
                for f in range(NODE_VECTORS):
                    _accelerate(s, motion, i, m, node_number(work.node[p, j], f, w))
                    m += 1
        for p in range(work.station.shape[0]):
            for k in range(n_lumps(motion, work)):
                for f in range(3):
                    _accelerate(s, motion, i, m, read(work.station[p, k], S_POS + f, w))
                    m += 1


@inline
def _accelerate(s: Scheme, motion: ModalMotion, i: int, m: int, new: float) -> None:
    a = (new - motion.place[i, m] - s.dt * motion.velocity[i, m]) / (s.dt * s.dt)
    motion.place_other[i, m], motion.velocity_other[i, m] = a, a
