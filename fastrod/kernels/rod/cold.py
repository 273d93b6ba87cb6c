"""The guess that a cold start begins from, one robot at a time.

    u of least norm in each segment:   l (1 + u_x d_y - u_y d_x) = what is left of each tendon that ends there
    m(s) on these arcs, material:      M + (r_tip - r) x F + sum of (r_j - r) x f_j over the loads beyond
    T of least norm about pretension:  sum of T (d_y, -d_x) = mean of m - K (u - u*) of a segment, tip first

A tendon's (d_y, -d_x), the moment of its unit tension, is called its arm.
"""

from __future__ import annotations

from math import atan2, cos, sin, sqrt
from typing import NamedTuple, TypeAlias

import numpy as np

from fastrod.types import Flags, Floats, Ints, Layout, Memory, Params, Ports

from ..jit import entry, inline, kernel
from ..vec import Mat, Vec, add, axpy, cross, dot, from_quaternion, matmul, mul, mul_t, scale, sub
from .gather import pick

SAMPLES = 8
"""Steps in which a segment's arc is sampled; the guess needs no more."""

_RANK = 1e-3
"""Fraction of the larger singular value below which the smaller counts as none: tendons that leave a plane by
less, as two at 0 and 3.1416 do, say nothing about the bend across it, and a micrometre of their lengths would
ask for curvatures beyond all bounds."""

Axes: TypeAlias = tuple[float, float, float, float, float]


class ColdWorkspace(NamedTuple):
    """Memory of one robot during a cold start; a segment's samples follow each other, SAMPLES + 1 of them."""

    free: Flags
    """(n_tendons,) the tension is unknown."""
    left: Floats
    """(n_tendons,) length of the tendon beyond the segments done [m]."""
    tension: Floats
    """(n_tendons,) [N]."""
    curvature: Floats
    """(n_segments, 3) [1/m]."""
    elastic: Floats
    """(n_segments, 3) K (u - u*) [N m]."""
    place: Floats
    """(n_samples, 3) from the base, world axes [m]."""
    rotation: Floats
    """(n_samples, 9) row by row."""
    load: Floats
    """(n_samples, 3) world [N]."""
    at_base: Floats
    """(n_segments, 3) moment of the loads at the segment's base, material [N m]."""
    mean: Floats
    """(n_segments, 3) its mean over the segment."""


@inline
def _vec(a: Floats, row: int) -> Vec:
    return a[row, 0], a[row, 1], a[row, 2]


@inline
def _put(a: Floats, row: int, v: Vec) -> None:
    a[row, 0], a[row, 1], a[row, 2] = v


@inline
def _mat(a: Floats, row: int) -> Mat:
    return a[row, 0], a[row, 1], a[row, 2], a[row, 3], a[row, 4], a[row, 5], a[row, 6], a[row, 7], a[row, 8]


@inline
def _tangent(m: Mat) -> Vec:
    """d3 of a frame."""
    return m[2], m[5], m[8]


@inline
def _exp(o: Vec) -> Mat:
    """Rotation of a rotation vector that may be long."""
    half = 0.5 * sqrt(dot(o, o))
    sine = 0.5 * sin(half) / half if half > 0.0 else 0.5
    return from_quaternion((cos(half), sine * o[0], sine * o[1], sine * o[2]))


@inline
def _fraction(j: int) -> float:
    """Fraction of its segment that sample j stands for."""
    return (0.5 if j == 0 or j == SAMPLES else 1.0) / SAMPLES


@inline
def _last(k: int, layout: Layout) -> int:
    """One past the last tendon that ends with segment k; its first is `first_tendon[k]`."""
    return int(layout.first_tendon[k + 1]) if k + 1 < len(layout.first_tendon) else len(layout.tendon_segment)


@inline
def _along(axes: Axes, dx: float, dy: float) -> tuple[float, float]:
    """A tendon's arm along both principal axes: over the tendons these two columns are orthogonal."""
    c, s, lean = axes[0], axes[1], axes[2]
    p = c * dy - s * dx
    return p, -c * dx - s * dy - lean * p


@kernel
def _principal(offset: Floats, first: int, last: int) -> Axes:
    """Principal axes of the arms of tendons first ... last - 1: cosine and sine of the major one, `lean`, and
    1 / sigma^2 of both.

    They diagonalise the 2 x 2 normal matrix, whose own smaller eigenvalue would drown in rounding where the
    tendons are nearly in one plane. The columns along the axes keep it: `lean` times the major one is what
    rounding left of it in the minor one. A singular value that counts as none has 0 for 1 / sigma^2, which
    makes the inverse a pseudo-inverse.
    """
    xx, xy, yy = 0.0, 0.0, 0.0
    for t in range(first, last):
        x, y = offset[t, 1], -offset[t, 0]
        xx += x * x
        xy += x * y
        yy += y * y
    angle = 0.5 * atan2(2.0 * xy, xx - yy)
    axes = (cos(angle), sin(angle), 0.0, 0.0, 0.0)
    major, both, minor = 0.0, 0.0, 0.0
    for t in range(first, last):
        p, q = _along(axes, offset[t, 0], offset[t, 1])
        major += p * p
        both += p * q
    if not major > 0.0:
        return axes
    axes = (axes[0], axes[1], both / major, 1.0 / major, 0.0)
    for t in range(first, last):
        _, q = _along(axes, offset[t, 0], offset[t, 1])
        minor += q * q
    return axes[0], axes[1], axes[2], axes[3], 1.0 / minor if minor > _RANK * _RANK * major else 0.0


@kernel
def _bend(i: int, layout: Layout, params: Params, ports: Ports, work: ColdWorkspace) -> None:
    """Constant curvature of each segment, its own where no length is prescribed, and the moment that it
    takes."""
    n_tendons = len(layout.tendon_segment)
    rest = ports.precurvature[pick(i, len(ports.precurvature))]
    offsets = params.offset[pick(i, len(params.offset))]
    for t in range(n_tendons):
        work.left[t] = ports.tendon_length[pick(i, len(ports.tendon_length)), t]
    for k in range(len(layout.first_tendon)):
        length = (
            params.length[pick(i, len(params.length)), k] + ports.extension[pick(i, len(ports.extension)), k]
        )
        offset, first, last = offsets[k], layout.first_tendon[k], _last(k, layout)
        u = _vec(rest[k], 0)
        if first < last and (layout.paper or work.free[first]):
            axes = _principal(offset, first, last)
            a, b = 0.0, 0.0
            for t in range(first, last):
                p, q = _along(axes, offset[t, 0], offset[t, 1])
                longer = work.left[t] / length - 1.0
                a += axes[3] * p * longer
                b += axes[4] * q * longer
            u = (axes[0] * a - axes[1] * b, axes[1] * a + axes[0] * b, u[2])
        stiffness, bent = _vec(ports.stiffness[pick(i, len(ports.stiffness)), k], 0), sub(u, _vec(rest[k], 0))
        _put(work.curvature, k, u)
        _put(work.elastic, k, (stiffness[0] * bent[0], stiffness[1] * bent[1], stiffness[2] * bent[2]))
        for t in range(first, n_tendons):
            work.left[t] -= length * (1.0 + u[0] * offset[t, 1] - u[1] * offset[t, 0])


@kernel
def _sample(i: int, layout: Layout, params: Params, ports: Ports, work: ColdWorkspace) -> None:
    """Frames along the arcs, and the line force and the point forces on the sample nearest to each."""
    pose = ports.base_pose[pick(i, len(ports.base_pose))]
    line = ports.line_force[pick(i, len(ports.line_force))]
    rotation, place = from_quaternion((pose[3], pose[4], pose[5], pose[6])), (0.0, 0.0, 0.0)
    n_segments, n_f, n_steps = len(layout.first_tendon), line.shape[1], layout.n_steps
    for k in range(n_segments):
        length = (
            params.length[pick(i, len(params.length)), k] + ports.extension[pick(i, len(ports.extension)), k]
        )
        h = length / SAMPLES
        u = _vec(work.curvature, k)
        half, whole = _exp(scale(0.5 * h, u)), _exp(scale(h, u))
        chord = scale(h / 6.0, add((0.0, 0.0, 1.0), axpy(4.0, _tangent(half), _tangent(whole))))
        for j in range(SAMPLES + 1):
            at = k * (SAMPLES + 1) + j
            _put(work.place, at, place)
            for a in range(9):
                work.rotation[at, a] = rotation[a]
            _put(work.load, at, scale(length * _fraction(j), _vec(line[k], round(j * (n_f - 1) / SAMPLES))))
            if j < SAMPLES:
                place, rotation = add(place, mul(rotation, chord)), matmul(rotation, whole)
    if len(ports.node_force) > 0:
        force = ports.node_force[pick(i, len(ports.node_force))]
        for j in range(n_segments * n_steps + 1):
            k = min(j // n_steps, n_segments - 1)
            at = k * (SAMPLES + 1) + round((j - k * n_steps) / n_steps * SAMPLES)
            _put(work.load, at, add(_vec(work.load, at), _vec(force, j)))


@kernel
def _balance(i: int, layout: Layout, ports: Ports, follower: Vec, work: ColdWorkspace) -> None:
    """Moment of the loads, from the tip down."""
    at = len(work.place) - 1
    force = add(_vec(ports.tip_force, pick(i, len(ports.tip_force))), follower)
    # about the base
    moment = add(_vec(ports.tip_moment, pick(i, len(ports.tip_moment))), cross(_vec(work.place, at), force))
    for k in range(len(layout.first_tendon) - 1, -1, -1):
        local, mean = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        for j in range(SAMPLES, -1, -1):
            place, own = _vec(work.place, at), _vec(work.load, at)
            local = mul_t(_mat(work.rotation, at), sub(moment, cross(place, force)))
            mean = axpy(_fraction(j), local, mean)
            force, moment = add(force, own), add(moment, cross(place, own))
            at -= 1
        _put(work.at_base, k, local)
        _put(work.mean, k, mean)


@kernel
def _pull(i: int, layout: Layout, params: Params, ports: Ports, work: ColdWorkspace) -> None:
    """Tensions that give each segment the mean moment that its arc wants."""
    tension, n_tendons = work.tension, len(layout.tendon_segment)
    offsets = params.offset[pick(i, len(params.offset))]
    for t in range(n_tendons):
        given = ports.tension[pick(i, len(ports.tension)), t]
        tension[t] = params.pretension[pick(i, len(params.pretension)), t] if work.free[t] else given
    for k in range(len(layout.first_tendon) - 1, -1, -1):
        offset, first, last = offsets[k], layout.first_tendon[k], _last(k, layout)
        if first == last or not work.free[first]:
            continue
        missing = sub(_vec(work.mean, k), _vec(work.elastic, k))
        x, y = missing[0], missing[1]
        for t in range(first, n_tendons):
            x -= offset[t, 1] * tension[t]
            y += offset[t, 0] * tension[t]
        axes = _principal(offset, first, last)
        a, b = axes[3] * (axes[0] * x + axes[1] * y), axes[4] * (axes[0] * y - axes[1] * x)
        for t in range(first, last):
            p, q = _along(axes, offset[t, 0], offset[t, 1])
            tension[t] += a * p + b * q
    # A tendon that can go slack starts taut: from there Newton finds which ones let go; from slack it would
    # not see them.
    taut = 0.01 * params.tension_scale[pick(i, len(params.tension_scale))]
    for t in range(n_tendons):
        if params.unilateral[pick(i, len(params.unilateral)), t]:
            tension[t] = max(tension[t], taut)


@kernel
def _keep(i: int, layout: Layout, ports: Ports, follower: Vec, memory: Memory, work: ColdWorkspace) -> None:
    """The guess into the robot's memory, and what was learned before out of it."""
    x = memory.x[i]
    for a in range(3):
        memory.curvature_guess[i, a] = work.curvature[0, a]
    if layout.paper:
        for k in range(len(layout.first_tendon)):  # the tip couple makes the mean curvature the arc's
            moment = add(_vec(work.elastic, k), sub(_vec(work.at_base, k), _vec(work.mean, k)))
            x[2 * k], x[2 * k + 1] = moment[0], moment[1]
    else:
        for a in range(3):
            x[a] = work.at_base[0, a]
        for j in range(len(layout.free_tendon)):
            x[3 + j] = work.tension[layout.free_tendon[j]]
        if len(ports.follower_force) > 0:
            for a in range(3):
                x[len(x) - 3 + a] = follower[a]
    for a in range(len(x)):
        memory.move[i, a], memory.defect[i, a] = 0.0, 0.0
        for b in range(memory.gain.shape[2]):
            memory.gain[i, a, b] = 0.0
    if len(memory.covariance) > 0:
        for b in range(memory.covariance.shape[1]):
            memory.covariance[i, b] = 0.0


@entry
def begin(rows: Ints, layout: Layout, params: Params, ports: Ports, memory: Memory) -> None:
    """Fill x and the curvature guess of the robots `rows` from their inputs alone, and forget what was
    learned before."""
    n_segments, n_tendons = len(layout.first_tendon), len(layout.tendon_segment)
    n = n_segments * (SAMPLES + 1)
    free = np.zeros(n_tendons, np.bool_)
    for j in range(len(layout.free_tendon)):
        free[layout.free_tendon[j]] = True
    work = ColdWorkspace(
        free,
        np.empty(n_tendons),
        np.empty(n_tendons),
        np.empty((n_segments, 3)),
        np.empty((n_segments, 3)),
        np.empty((n, 3)),
        np.empty((n, 9)),
        np.empty((n, 3)),
        np.empty((n_segments, 3)),
        np.empty((n_segments, 3)),
    )
    for r in range(len(rows)):
        i = rows[r]
        _bend(i, layout, params, ports, work)
        _sample(i, layout, params, ports, work)
        follower = (0.0, 0.0, 0.0)
        if len(ports.follower_force) > 0:
            follower = mul(
                _mat(work.rotation, n - 1), _vec(ports.follower_force, pick(i, len(ports.follower_force)))
            )
        _balance(i, layout, ports, follower, work)
        if not layout.paper:
            _pull(i, layout, params, ports, work)
        _keep(i, layout, ports, follower, memory, work)
