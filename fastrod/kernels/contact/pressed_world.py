"""One world of rods of modes that touch, gathered for a Newton step: the Hessian and gradient of its
unknowns, and of every contact its axes, its gap and slip, and how they change with the unknowns.

To a rod's unknowns belong those of a free body that it touches, the force on it and the moment: six more.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fastrod.types import ContactMotion, ContactRods, ContactSet, Floats, Ints, Records, Surfaces

from ..jit import inline, kernel
from ..rod.gather import pick, scatter
from ..vec import Vec, add, axpy, cross, dot, mul, mul_t, scale, sub
from .bvh import Numbers, Record, normal_of
from .centreline import bend_at, curve_of, curve_slip, interval_of, point_at, rotation_at, tangent_at
from .contact_set import measure, set_normal
from .rod_proximity import partner_of
from .surface import surface_curvature
from .tunnelling import carried

SOFT = 1e-8
"""R of a rigid contact, at most [m/N]: under 100 N it is a micrometre deep."""
_AT_LEAST = 0.01  # of a step: a place that is farther from the least gap is none where it is least


class PressedWorld(NamedTuple):
    """The rods and free bodies of one world near their present unknowns, and room for its contacts."""

    hessian: Floats
    """(n, n) of the rods, the forces of their contacts as dead loads."""
    gradient: Floats
    """(n,) without these forces."""
    side: Ints
    """(n_contacts, 4) robot and number of a contact, and of its other side, or -1."""
    axes: Floats
    """(n_contacts, 3, 3) normal and two tangents."""
    along: Floats
    """(n_contacts, 3, n) J: motion along these."""
    centre: Floats
    """(n_contacts, 3, n) motion of the centreline along these, without the arm on which friction acts."""
    free: Floats
    """(n_contacts, 3) gap and slip without a step [m]."""
    law: Floats
    """(n_contacts, 5) mu, R, t (2), s."""
    curved: Floats
    """(n_contacts, 3, 3) second derivative of the gap by the place, along the axes [1/m]."""
    shift: Floats
    """(n_contacts, 2, n) change by the unknowns of the gap's slope along the rod, and along the other."""
    yields: Floats
    """(n_contacts, 3) inverse of the second derivative of the gap along both, (1, 1), (1, 2), (2, 2): how far
    the place where it is least moves; 0 where it does not [m]."""
    matrix: Floats
    """(n, n)"""
    step: Floats
    """(n,) out: change of the unknowns."""
    room: Floats
    """(3, n) a step, a trial, and the Hessian times the step."""


class Touching(NamedTuple):
    """All rods of a batch among the obstacles, and how they are to be pressed."""

    rods: ContactRods
    surfaces: Surfaces
    motion: ContactMotion
    contacts: ContactSet
    hessian: Floats
    """(n_robots, n_q, n_q) of each rod, its contacts' forces as dead loads."""
    gradient: Floats
    """(n_robots, n_q) with these."""
    change: Floats
    """(n_robots, n_points, 3, n_q) motion of points by the unknowns, world."""
    spin: Floats
    """(n_robots, n_points, 3, n_q) and rotation of the cross-sections there."""
    first: int
    """Number of the first contact among these points."""
    yielding: float
    """Fraction of their mobility that free bodies have in this step: it goes by the square of its length."""
    soft: Floats
    """(n_robots,) R of their rigid contacts in this step [m/N]."""


@kernel
def add_scaled(k: float, x: Floats, to: Floats) -> None:
    """to += k x."""
    for a in range(len(to)):
        to[a] += k * x[a]


@inline
def tangents(n: Vec) -> tuple[Vec, Vec]:
    """Two directions that make a right-handed frame with n."""
    helper = (1.0, 0.0, 0.0) if abs(n[0]) < 0.6 else (0.0, 1.0, 0.0)
    t = cross(n, helper)
    t = scale(1.0 / math.sqrt(dot(t, t)), t)
    return t, cross(n, t)


@inline
def _axis(axes: Floats, a: int) -> Vec:
    return axes[a, 0], axes[a, 1], axes[a, 2]


@inline
def _place(i: int, s: float, motion: ContactMotion) -> Vec:
    curve = curve_of(motion, i)
    j, fraction = interval_of(curve, s, 0)
    return point_at(curve, j, fraction)


@inline
def _surface_before(i: int, s: float, arm: Vec, motion: ContactMotion) -> Vec:
    """Place at the step's start of what is now `arm` away from the centreline."""
    now, before = curve_of(motion, i), curve_slip(motion, i)
    j, fraction = interval_of(now, s, 0)
    rotation = rotation_at(now, j, fraction)
    local = mul_t(rotation, arm)
    j, fraction = interval_of(before, s, j)
    # orthonormal to fourth order only: what has not turned is to be where it is to the last digit
    turned = sub(mul(rotation_at(before, j, fraction), local), mul(rotation, local))
    return add(point_at(before, j, fraction), add(arm, turned))


@kernel
def _measure_obstacle(
    i: int, contact: Record, all_of_it: Touching, stack: Numbers, wall: Records, curved: Floats
) -> Vec:
    """Gap and normal of a contact with an obstacle, kept in it, the second derivative of the gap, and the
    slip since the last step (world)."""
    motion, surfaces, k = all_of_it.motion, all_of_it.surfaces, contact.obstacle
    p = _place(i, contact.arclength, motion)
    frame = motion.frames[pick(i, len(motion.frames)), k]
    d = measure(contact, frame, p, motion.margin * all_of_it.rods.length[i], surfaces, stack, wall)
    n, first, second, e = normal_of(contact), 0.0, 0.0, (0.0, 0.0, 1.0)
    if d > 0.0:
        first, second, e = surface_curvature(k, frame, p, d, surfaces, stack)
    for a in range(3):
        for b in range(3):
            across = (1.0 if a == b else 0.0) - n[a] * n[b]
            curved[a, b] = first * across + (second - first) * e[a] * e[b]
    if not motion.slides[i]:
        return 0.0, 0.0, 0.0
    arm = scale(-contact.radius, n)
    ground = carried(frame, motion.frames_slip[pick(i, len(motion.frames_slip)), k], add(p, arm))
    return sub(ground, _surface_before(i, contact.arclength, arm, motion))


@kernel
def _measure_rods(
    i: int, contact: Record, other: int, partner: Record, motion: ContactMotion, curved: Floats
) -> Vec:
    """The same of a contact between two rods, kept in both its sides."""
    p, r = _place(i, contact.arclength, motion), _place(other, partner.arclength, motion)
    e, old, thick = sub(p, r), normal_of(contact), contact.radius + partner.radius
    length, along = math.sqrt(dot(e, e)), dot(e, old)
    n, gap = old, along - thick
    if along > 0.2 * length and length > 1e-12:
        n, gap = scale(1.0 / length, e), length - thick
    set_normal(contact, n)
    set_normal(partner, scale(-1.0, n))
    contact.gap, partner.gap = gap, gap
    for a in range(3):
        for b in range(3):
            across = (1.0 if a == b else 0.0) - n[a] * n[b]
            curved[a, b] = across / length if length > 1e-12 else 0.0
    if not (motion.slides[i] and motion.slides[other]):
        return 0.0, 0.0, 0.0
    arm, other_arm = scale(-contact.radius, n), scale(partner.radius, n)
    before = sub(
        _surface_before(i, contact.arclength, arm, motion),
        _surface_before(other, partner.arclength, other_arm, motion),
    )
    return sub(add(e, sub(arm, other_arm)), before)


@kernel
def _add_motion(
    m: int, row: int, i: int, q: int, sign: float, all_of_it: Touching, pressing: PressedWorld
) -> None:
    """Add the motion of point q of robot i, in this row of its world, to that of contact m."""
    change, axes, n_q = all_of_it.change[i, all_of_it.first + q], pressing.axes[m], all_of_it.change.shape[3]
    for a in range(n_q):
        for r in range(3):
            moved = axes[r, 0] * change[0, a] + axes[r, 1] * change[1, a] + axes[r, 2] * change[2, a]
            pressing.along[m, r, row * n_q + a] += sign * moved


@inline
def _slides_along(i: int, s: float, all_of_it: Touching) -> bool:
    """The place of a contact may move both ways along rod i."""
    curve, some = curve_of(all_of_it.motion, i), 1e-6 * all_of_it.rods.length[i]
    return bool(all_of_it.rods.first[i] + some < s < curve.arclength[len(curve.arclength) - 1] - some)


@kernel
def _note_shift(
    m: int, side: int, row: int, i: int, q: int, n: int, all_of_it: Touching, pressing: PressedWorld
) -> Vec:
    """Row `side` of the shift of contact m, point q of rod i; its tangent there along the axes."""
    axes, curved, out = pressing.axes[m], pressing.curved[m], pressing.shift[m, side]
    curve, sign = curve_of(all_of_it.motion, i), 1.0 if side == 0 else -1.0
    j, x = interval_of(curve, all_of_it.contacts.contact[i, q].arclength, 0)
    along = tangent_at(curve, j, x)
    t = (dot(along, _axis(axes, 0)), dot(along, _axis(axes, 1)), dot(along, _axis(axes, 2)))
    across = cross(along, _axis(axes, 0))
    n_q, spin = all_of_it.change.shape[3], all_of_it.spin[i, all_of_it.first + q]
    for a in range(n):
        value = 0.0
        for r in range(1, 3):
            for c in range(1, 3):
                value += t[r] * curved[r, c] * pressing.along[m, c, a]
        out[a] = sign * value
    for a in range(n_q):
        turned = across[0] * spin[0, a] + across[1] * spin[1, a] + across[2] * spin[2, a]
        out[row * n_q + a] += sign * turned
    return t


@kernel
def _second_along(t: Vec, other: Vec, m: int, pressing: PressedWorld) -> float:
    """t . C other, tangents along the axes of contact m."""
    curved, value = pressing.curved[m], 0.0
    for r in range(1, 3):
        for c in range(1, 3):
            value += t[r] * curved[r, c] * other[c]
    return value


@kernel
def _bend_across(i: int, q: int, m: int, all_of_it: Touching, pressing: PressedWorld) -> float:
    """n . d2r/ds2 at point q of rod i."""
    curve = curve_of(all_of_it.motion, i)
    j, x = interval_of(curve, all_of_it.contacts.contact[i, q].arclength, 0)
    return dot(bend_at(curve, j, x), _axis(pressing.axes[m], 0))


@kernel
def _let_slide(
    m: int,
    row: tuple[int, int],
    i: int,
    q: int,
    other: int,
    partner: int,
    n: int,
    all_of_it: Touching,
    pressing: PressedWorld,
) -> None:
    """Note how the place of contact m moves along the rods with the unknowns: where the gap is least, its
    slopes along them are 0. Not where that is nearly everywhere: on what is as curved as the rod."""
    contact, yields, least = all_of_it.contacts.contact, pressing.yields[m], 1.0 / all_of_it.rods.length[i]
    yields[0], yields[1], yields[2] = 0.0, 0.0, 0.0
    here = _slides_along(i, contact[i, q].arclength, all_of_it)
    t = _note_shift(m, 0, row[0], i, q, n, all_of_it, pressing)
    first = _bend_across(i, q, m, all_of_it, pressing) + _second_along(t, t, m, pressing)
    near = _AT_LEAST * all_of_it.rods.spacing[i]
    here = here and first > least and abs(t[0]) < near * first
    if here:
        yields[0] = 1.0 / first
    if other < 0:
        return
    there = _slides_along(other, contact[other, partner].arclength, all_of_it)
    u = _note_shift(m, 1, row[1], other, partner, n, all_of_it, pressing)
    second = _second_along(u, u, m, pressing) - _bend_across(other, partner, m, all_of_it, pressing)
    mixed = -_second_along(t, u, m, pressing)
    if not (there and second > least and abs(u[0]) < near * second):
        return
    if not here:
        yields[2] = 1.0 / second
        return
    det = first * second - mixed * mixed
    if det > least * max(first, second):
        yields[0], yields[1], yields[2] = second / det, -mixed / det, first / det


@kernel
def add_slides(m: int, n: int, contacts: ContactSet, pressing: PressedWorld) -> None:
    """Add to the Hessian that the least gap is less than that at a place which stays."""
    for k in range(m):
        axes, yields, shift = pressing.axes[k], pressing.yields[k], pressing.shift[k]
        force = contacts.contact[pressing.side[k, 0], pressing.side[k, 1]].force
        pressed = force[0] * axes[0, 0] + force[1] * axes[0, 1] + force[2] * axes[0, 2]
        rubs = pressing.law[k, 0] > 0.0  # what sticks stays where it is
        if not pressed > 0.0 or rubs or yields[0] + yields[2] == 0.0:
            continue
        for a in range(n):
            one = pressed * (yields[0] * shift[0, a] + yields[1] * shift[1, a])
            other = pressed * (yields[1] * shift[0, a] + yields[2] * shift[1, a])
            add_scaled(one, shift[0, :n], pressing.hessian[a, :n])
            add_scaled(other, shift[1, :n], pressing.hessian[a, :n])


@kernel
def _add_arm(
    m: int, row: int, i: int, q: int, sign: float, all_of_it: Touching, pressing: PressedWorld
) -> None:
    """Friction acts on the surface: add to the motion of contact m along it that of the arm from the
    centreline there, A = - radius n, which turns with the rod."""
    axes, contact, n_q = pressing.axes[m], all_of_it.contacts.contact[i, q], all_of_it.change.shape[3]
    spin, n = all_of_it.spin[i, all_of_it.first + q], normal_of(contact)
    arm, force = scale(-contact.radius, n), (contact.force[0], contact.force[1], contact.force[2])
    rubs = axpy(-dot(force, n), n, force)
    for r in range(1, 3):
        across = cross(arm, _axis(axes, r))
        for a in range(n_q):
            turned = across[0] * spin[0, a] + across[1] * spin[1, a] + across[2] * spin[2, a]
            pressing.along[m, r, row * n_q + a] += sign * turned
    if dot(rubs, rubs) > 0.0:
        _add_arm_stiffness(row, n_q, spin, arm, rubs, pressing)


@kernel
def _add_arm_stiffness(row: int, n_q: int, spin: Floats, arm: Vec, rubs: Vec, pressing: PressedWorld) -> None:
    """Add to the Hessian the second derivatives of a force on an arm that turns with the rod, beyond those of
    its moment M as a dead load, which the rod has: - f . sym (th_a x (th_b x A)), and, for rotations do not
    commute and the rod takes th_a by the unknowns in one order, M . (th_b x th_a) / 2."""
    moment = cross(arm, rubs)
    for a in range(n_q):
        one = (spin[0, a], spin[1, a], spin[2, a])
        by_force, by_arm = dot(rubs, one), dot(arm, one)
        for b in range(a + 1):
            other = (spin[0, b], spin[1, b], spin[2, b])
            more = 0.5 * (
                dot(moment, cross(other, one)) - by_force * dot(arm, other) - by_arm * dot(rubs, other)
            )
            pressing.hessian[row * n_q + a, row * n_q + b] += more
            if b < a:
                pressing.hessian[row * n_q + b, row * n_q + a] += more


@kernel
def _add_body(m: int, at: int, k: int, place: Vec, surfaces: Surfaces, pressing: PressedWorld) -> None:
    """Take the motion of the free body of obstacle k there, by the force and the moment on it, from that of
    contact m: unknowns `at` on."""
    mobility, center = surfaces.mobility[k], surfaces.center[k]
    arm = sub(place, (center[0], center[1], center[2]))
    for r in range(3):
        axis = _axis(pressing.axes[m], r)
        turned = cross(arm, axis)
        for a in range(6):
            moved = 0.0
            for b in range(3):
                moved += mobility[b, a] * axis[b] + mobility[3 + b, a] * turned[b]
            pressing.along[m, r, at + a] -= moved


@kernel
def _body_of(k: int, surfaces: Surfaces) -> int:
    """Number of the first obstacle of the body that obstacle k belongs to: the numbers of bodies are the
    user's."""
    first = k
    for other in range(k - 1, -1, -1):
        first = other if surfaces.body[other] == surfaces.body[k] else first
    return first


@kernel
def gather_world(
    first: int,
    last: int,
    robot: Ints,
    all_of_it: Touching,
    pressing: PressedWorld,
    stack: Numbers,
    wall: Records,
) -> tuple[int, int]:
    """The world in the rows `first` to `last` into `pressing`; how many contacts and unknowns it has."""
    n_q, surfaces, contacts = all_of_it.gradient.shape[1], all_of_it.surfaces, all_of_it.contacts
    n_obstacles, n, m = len(surfaces.primitive), (last - first) * all_of_it.gradient.shape[1], 0
    most = n
    for k in range(n_obstacles):
        most = n + 6 * n_obstacles if surfaces.mobility[k, 0, 0] > 0.0 else most
    for a in range(most):
        pressing.gradient[a] = 0.0
        for b in range(most):
            pressing.hessian[a, b] = 0.0
    for o in range(last - first):
        i = robot[first + o]
        for a in range(n_q):
            pressing.gradient[o * n_q + a] = all_of_it.gradient[i, a]
            for b in range(n_q):
                pressing.hessian[o * n_q + a, o * n_q + b] = all_of_it.hessian[i, a, b]
    for o in range(last - first):
        i = robot[first + o]
        for q in range(contacts.used[i]):
            contact, k, other, partner = contacts.contact[i, q], contacts.contact[i, q].obstacle, -1, -1
            row = -1
            if k >= n_obstacles:
                other = k - n_obstacles
                partner = partner_of(contacts, n_obstacles, i, q)
                for r in range(last - first):
                    row = r if robot[first + r] == other else row
                if partner < 0 or row < o or (row == o and partner < q):
                    continue  # counted from its other side
            pressing.side[m, 0], pressing.side[m, 1] = i, q
            pressing.side[m, 2], pressing.side[m, 3] = other, partner
            if other < 0:
                slip = _measure_obstacle(i, contact, all_of_it, stack, wall, pressing.curved[m])
                mu, soft, slides = surfaces.friction[k], surfaces.compliance[k], all_of_it.motion.slides[i]
            else:
                slip = _measure_rods(
                    i, contact, other, contacts.contact[other, partner], all_of_it.motion, pressing.curved[m]
                )
                mu, soft = all_of_it.rods.friction, all_of_it.rods.compliance
                slides = all_of_it.motion.slides[i] and all_of_it.motion.slides[other]
            n_axis = normal_of(contact)
            t1, t2 = tangents(n_axis)
            axes, law = pressing.axes[m], pressing.law[m]
            held = (contact.held[0], contact.held[1], contact.held[2])
            for a in range(3):
                axes[0, a], axes[1, a], axes[2, a] = n_axis[a], t1[a], t2[a]
            scatter(pressing.free[m], (contact.gap, dot(slip, t1), dot(slip, t2)))
            law[0], law[1] = mu if slides else 0.0, all_of_it.soft[i] + soft
            law[2], law[3], law[4] = dot(held, t1), dot(held, t2), contact.slid
            if law[4] < 0.0:  # of a new contact: as far as its place has come
                law[4] = math.sqrt(pressing.free[m, 1] ** 2 + pressing.free[m, 2] ** 2)
            _along_axes(axes, pressing.curved[m])
            for r in range(3):
                for a in range(most):
                    pressing.along[m, r, a] = 0.0
            _add_motion(m, o, i, q, 1.0, all_of_it, pressing)
            if other >= 0:
                _add_motion(m, row, other, partner, -1.0, all_of_it, pressing)
            elif surfaces.mobility[k, 0, 0] > 0.0:
                at = n + 6 * _body_of(k, surfaces)
                place = _place(i, contact.arclength, all_of_it.motion)
                _add_body(m, at, k, axpy(-contact.radius, n_axis, place), surfaces, pressing)
            for a in range(most):
                pressing.shift[m, 0, a], pressing.shift[m, 1, a] = 0.0, 0.0
            _let_slide(m, (o, row), i, q, other, partner, most, all_of_it, pressing)
            for r in range(3):
                for a in range(most):
                    pressing.centre[m, r, a] = pressing.along[m, r, a]
            if law[0] > 0.0:
                _add_arm(m, o, i, q, 1.0, all_of_it, pressing)
                if other >= 0:
                    _add_arm(m, row, other, partner, -1.0, all_of_it, pressing)
            force = contact.force
            for r in range(3):
                pressed = axes[r, 0] * force[0] + axes[r, 1] * force[1] + axes[r, 2] * force[2]
                for a in range(n):
                    pressing.gradient[a] += pressed * pressing.along[m, r, a]
            m += 1
    for k in range(n_obstacles if most > n else 0):
        mobility, at = surfaces.mobility[k], n + 6 * _body_of(k, surfaces)
        if mobility[0, 0] > 0.0:
            for a in range(6):
                pressing.gradient[at + a] = surfaces.ahead[k, a]
                for b in range(6):
                    pressing.hessian[at + a, at + b] = mobility[a, b] / all_of_it.yielding
    for a in range(n, most):
        if pressing.hessian[a, a] == 0.0:  # what cannot move
            pressing.hessian[a, a] = 1.0
    return m, most


@kernel
def _along_axes(axes: Floats, curved: Floats) -> None:
    """A symmetric matrix of the world becomes one along the axes."""
    one, two, three = _axis(axes, 0), _axis(axes, 1), _axis(axes, 2)
    for r in range(3):
        row = (curved[r, 0], curved[r, 1], curved[r, 2])
        curved[r, 0], curved[r, 1], curved[r, 2] = dot(row, one), dot(row, two), dot(row, three)
    for c in range(3):
        column = (curved[0, c], curved[1, c], curved[2, c])
        curved[0, c], curved[1, c], curved[2, c] = dot(column, one), dot(column, two), dot(column, three)
