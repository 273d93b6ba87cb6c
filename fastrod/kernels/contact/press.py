"""Contact of one rod of modes, as a convex potential in its Newton's method.

Of every candidate the motion of its point is linear in the unknowns, u = (gap, slip since the step's start)
+ J dq. Its potential is R/2 |lambda|^2 with
  lambda = P_K(y),   y_n = -(u_n + mu s) / R,   y_t = t - u_t / R,
K the cone |lambda_t| <= mu lambda_n, P_K the nearest point in it, t the force along the surface with which
the last step ended (so that what sticks does not creep), s how far the point slips (the shift of De Saxce
and Feng 1998, by which a point that slips does not lift). Its derivatives by u are -lambda and D / R,
D = P_K'. With the rod's own g and H the step minimises dq.H.dq / 2 + g.dq + sum of potentials: a semi-smooth
Newton method whose steps end where the slope along them does (Castro and others 2022). To H belongs what the
forces turn with a curved surface, - lambda_n times the second derivative of the gap, where H with it is
still positive.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fastrod.types import ContactMotion, Floats, Records, Surfaces

from ..jit import inline, kernel
from ..rod.gather import pick
from ..vec import Vec, dot, scale, sub
from .assemble import tangents
from .bvh import Numbers, Record, normal_of
from .centreline import curve_of, curve_slip, interval_of, point_at
from .contact_set import set_normal, wall_at
from .surface import surface_curvature
from .tunnelling import carried

SOFT = 1e-8
"""R [m/N]: from 1e-5 to 1e-9 it changes the number of iterations alone."""
_ROUNDS, _HALVINGS = 40, 40
_SMALL = 1e-13  # of the unknowns: a step below it is the last one
_SHALLOW = 0.1  # of the slope along a step at its start: where it is as small, the step is long enough
_PIVOT = 1e-12  # of a diagonal entry
_RENEWED = 5e-6  # m: a slip that changes by less is not told to the next pass


class Pressing(NamedTuple):
    """The rod of one robot near its present unknowns, and room for its contacts."""

    hessian: Floats
    """(n_q, n_q) of the rod, the forces of its contacts as dead loads."""
    gradient: Floats
    """(n_q,) with these."""
    change: Floats
    """(n_contacts, 3, n_q) motion of the contact points by the unknowns, world."""
    axes: Floats
    """(n_contacts, 3, 3) normal and two tangents."""
    along: Floats
    """(n_contacts, 3, n_q) J: motion along these."""
    free: Floats
    """(n_contacts, 3) gap and slip without a step [m]."""
    law: Floats
    """(n_contacts, 5) mu, R, t (2), s."""
    curved: Floats
    """(n_contacts, 3, 3) second derivative of the gap by the place, world [1/m]."""
    matrix: Floats
    """(n_q, n_q)"""
    step: Floats
    """(n_q,) out: change of the unknowns."""
    room: Floats
    """(3, n_q)"""


@inline
def _axis(axes: Floats, a: int) -> Vec:
    return axes[a, 0], axes[a, 1], axes[a, 2]


@kernel
def measure_contact(
    i: int,
    contact: Record,
    motion: ContactMotion,
    surfaces: Surfaces,
    margin: float,
    stack: Numbers,
    wall: Records,
    room: tuple[Floats, Floats, Floats, Floats],
) -> None:
    """Gap and normal of a contact on the present shape, kept in it; and its `axes`, `free`, `law` and
    `curved` (`Pressing`) into `room`."""
    axes, free, law, curved = room
    curve, k = curve_of(motion, i), contact.obstacle
    j, fraction = interval_of(curve, contact.arclength, 0)
    p = point_at(curve, j, fraction)
    frame = motion.frames[pick(i, len(motion.frames)), k]
    d, n = wall_at(k, frame, p, normal_of(contact), margin, surfaces, stack, wall)
    contact.gap = d - contact.radius
    set_normal(contact, n)
    t1, t2 = tangents(n)
    for a in range(3):
        axes[0, a], axes[1, a], axes[2, a] = n[a], t1[a], t2[a]
    slip, slides = (0.0, 0.0, 0.0), motion.slides[i]
    if slides:
        before = curve_slip(motion, i)
        ground = carried(frame, motion.frames_slip[pick(i, len(motion.frames_slip)), k], p)
        j, fraction = interval_of(before, contact.arclength, j)
        slip = sub(ground, point_at(before, j, fraction))
    held = (contact.held[0], contact.held[1], contact.held[2])
    free[0], free[1], free[2] = contact.gap, dot(slip, t1), dot(slip, t2)
    law[0] = surfaces.friction[k] if slides else 0.0
    law[1] = SOFT + surfaces.compliance[k]
    law[2], law[3], law[4] = dot(held, t1), dot(held, t2), contact.slid
    first, second, e = 0.0, 0.0, (0.0, 0.0, 1.0)
    if d > 0.0:
        first, second, e = surface_curvature(k, frame, p, surfaces, stack)
    for a in range(3):
        for b in range(3):
            across = (1.0 if a == b else 0.0) - n[a] * n[b]
            curved[a, b] = first * across + (second - first) * e[a] * e[b]


@inline
def _moved(along: Floats, free: Floats, step: Floats) -> Vec:
    """u after a step."""
    u, v, w = free[0], free[1], free[2]
    for a in range(len(step)):
        u += along[0, a] * step[a]
        v += along[1, a] * step[a]
        w += along[2, a] * step[a]
    return u, v, w


@inline
def _asked(law: Floats, u: Vec) -> Vec:
    """y"""
    return -(u[0] + law[0] * law[4]) / law[1], law[2] - u[1] / law[1], law[3] - u[2] / law[1]


@inline
def in_cone(mu: float, y: Vec) -> tuple[Vec, float]:
    """The nearest point of the cone, and how large y is along the surface."""
    size = math.sqrt(y[1] * y[1] + y[2] * y[2])
    if size <= mu * y[0]:
        return y, size
    normal = (y[0] + mu * size) / (1.0 + mu * mu)
    if normal <= 0.0:
        return (0.0, 0.0, 0.0), size
    part = mu * normal / size if size > 0.0 else 0.0
    return (normal, part * y[1], part * y[2]), size


@inline
def _slope(mu: float, y: Vec, r: int, c: int) -> float:
    """Entry (r, c) of D."""
    force, size = in_cone(mu, y)
    if size <= mu * y[0]:
        return 1.0 if r == c and (r == 0 or mu > 0.0) else 0.0
    if force[0] <= 0.0:
        return 0.0
    e = (0.0, y[1] / size, y[2] / size) if size > 0.0 else (0.0, 0.0, 0.0)
    one = 1.0 if r == 0 else mu * e[r]
    other = 1.0 if c == 0 else mu * e[c]
    value = one * other / (1.0 + mu * mu)
    if r > 0 and c > 0 and size > 0.0:
        value += mu * force[0] / size * ((1.0 if r == c else 0.0) - e[r] * e[c])
    return value


@kernel
def _slope_along(n: int, pressing: Pressing, at: Floats, step: Floats) -> float:
    """Slope of the potential along a step, where the unknowns have changed by `at`."""
    total, n_q = 0.0, len(step)
    for a in range(n_q):
        value = pressing.room[2, a]
        for c in range(n_q):
            value += pressing.hessian[a, c] * at[c]
        total += value * step[a]
    for k in range(n):
        along, law = pressing.along[k], pressing.law[k]
        force, _ = in_cone(law[0], _asked(law, _moved(along, pressing.free[k], at)))
        for r in range(3):
            if force[r] != 0.0:
                moved = 0.0
                for a in range(n_q):
                    moved += along[r, a] * step[a]
                total -= force[r] * moved
    return total


@kernel
def _newton_step(n: int, pressing: Pressing, to: Floats) -> bool:
    """A Newton step from `pressing.step`, into `to`, and whether all pivots were positive; the diagonal
    stands for one that is not."""
    m, n_q, step, good = pressing.matrix, len(to), pressing.step, True
    for a in range(n_q):
        value = pressing.room[2, a]
        for c in range(n_q):
            m[a, c] = pressing.hessian[a, c]
            value += m[a, c] * step[c]
        to[a] = -value
    for k in range(n):
        along, law = pressing.along[k], pressing.law[k]
        y = _asked(law, _moved(along, pressing.free[k], step))
        force, _ = in_cone(law[0], y)
        for r in range(3):
            for a in range(n_q if force[r] != 0.0 else 0):
                to[a] += along[r, a] * force[r]
            for s in range(3):
                d = _slope(law[0], y, r, s) / law[1]
                if d != 0.0:
                    for a in range(n_q):
                        part = d * along[r, a]
                        for c in range(a + 1):
                            m[a, c] += part * along[s, c]
    for j in range(n_q):
        pivot = m[j, j]
        for k in range(j):
            pivot -= m[j, k] * m[j, k]
        if not pivot > _PIVOT * abs(m[j, j]):
            pivot, good = abs(m[j, j]) + 1e-300, False
        inverse = 1.0 / math.sqrt(pivot)
        m[j, j] = inverse
        for a in range(j + 1, n_q):
            value = m[a, j]
            for k in range(j):
                value -= m[a, k] * m[j, k]
            m[a, j] = value * inverse
    for a in range(n_q):
        for k in range(a):
            to[a] -= m[a, k] * to[k]
        to[a] *= m[a, a]
    for b in range(n_q):
        a = n_q - 1 - b
        for k in range(a + 1, n_q):
            to[a] -= m[k, a] * to[k]
        to[a] *= m[a, a]
    return good


@kernel
def _turn_forces(n: int, contacts: Records, pressing: Pressing, sign: float) -> bool:
    """Take from the Hessian what the forces turn with their surfaces (`sign` 1), or give it back; whether
    there is any."""
    n_q, some = len(pressing.step), False
    for k in range(n):
        axes, c, change = pressing.axes[k], pressing.curved[k], pressing.change[k]
        force = contacts[k].force
        pressed = force[0] * axes[0, 0] + force[1] * axes[0, 1] + force[2] * axes[0, 2]
        if not pressed > 0.0 or c[0, 0] + c[1, 1] + c[2, 2] == 0.0:
            continue
        some = True
        for a in range(n_q):
            for r in range(3):
                turned = c[r, 0] * change[0, a] + c[r, 1] * change[1, a] + c[r, 2] * change[2, a]
                turned *= sign * pressed
                for b in range(n_q):
                    pressing.hessian[a, b] -= turned * change[r, b]
    return some


@kernel
def press(n: int, contacts: Records, pressing: Pressing, renew: bool) -> tuple[float, bool]:
    """Step and forces of one robot with n contacts, which hold its `law` and `free`; the largest change of
    an unknown, and whether a slip that the step was led by has changed, if it may be told anew."""
    n_q, step, rest, trial = (len(pressing.step), pressing.step, pressing.room[2], pressing.room[1])
    for a in range(n_q):
        rest[a], step[a] = pressing.gradient[a], 0.0
    for k in range(n):
        axes, force = pressing.axes[k], contacts[k].force
        for a in range(n_q):
            x, y, z = pressing.change[k, 0, a], pressing.change[k, 1, a], pressing.change[k, 2, a]
            rest[a] += x * force[0] + y * force[1] + z * force[2]
            for r in range(3):
                pressing.along[k, r, a] = axes[r, 0] * x + axes[r, 1] * y + axes[r, 2] * z
    to, turned = pressing.room[0], _turn_forces(n, contacts, pressing, 1.0)
    for _ in range(_ROUNDS):
        if not _newton_step(n, pressing, to) and turned:
            _turn_forces(n, contacts, pressing, -1.0)
            turned = False
            _newton_step(n, pressing, to)
        low, high, fraction = 0.0, 1.0, 1.0
        first = abs(_slope_along(n, pressing, step, to))
        for _ in range(_HALVINGS):
            for a in range(n_q):
                trial[a] = step[a] + fraction * to[a]
            slope = _slope_along(n, pressing, trial, to)
            if abs(slope) <= _SHALLOW * first or (fraction == 1.0 and slope < 0.0):
                break
            low, high = (fraction, high) if slope < 0.0 else (low, fraction)
            fraction = 0.5 * (low + high)
        size = 0.0
        for a in range(n_q):
            step[a] += fraction * to[a]
            size = max(size, abs(fraction * to[a]))
        largest = 0.0
        for a in range(n_q):
            largest = max(largest, abs(step[a]))
        if not size > _SMALL * max(1.0, largest):
            break
    changed = False
    for k in range(n):
        contact, axes, law = contacts[k], pressing.axes[k], pressing.law[k]
        u = _moved(pressing.along[k], pressing.free[k], step)
        y = _asked(law, u)
        force, _ = in_cone(law[0], y)
        slid = law[1] * math.sqrt((y[1] - force[1]) ** 2 + (y[2] - force[2]) ** 2) if law[0] > 0.0 else 0.0
        if renew and law[0] * abs(slid - contact.slid) > _RENEWED:
            contact.slid, changed = slid, True
        for a in range(3):
            contact.force[a] = force[0] * axes[0, a] + force[1] * axes[1, a] + force[2] * axes[2, a]
    return largest, changed


@kernel
def end_contacts(n: int, contacts: Records) -> int:
    """Keep the contacts that press for the next step, and the force along the surface with which each ends;
    returns how many there are."""
    left = 0
    for c in range(n):
        contact = contacts[c]
        force = (contact.force[0], contact.force[1], contact.force[2])
        if not dot(force, force) > 0.0:
            continue
        along = sub(force, scale(dot(force, normal_of(contact)), normal_of(contact)))
        contact.held[0], contact.held[1], contact.held[2] = along
        if left != c:
            contacts[left] = contact
        left += 1
    return left
