"""Rod-rod proximity: minima of the distance between two centrelines, or of one from itself.

Pairs of intervals that cannot be near are skipped by as many intervals as their distance allows. From the
closest points of two chords a Newton iteration finds the minimum on the curves. Both rods get a contact; the
same number in `partner` links them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fastrod.types import ContactMotion, ContactRods, ContactSet, Ints

from ..jit import inline, kernel
from ..vec import Vec, axpy, dot, scale, sub
from .bvh import FAR
from .centreline import Curve, curve_of, interval_of, point_at, tangent_at
from .contact_set import open_contact, segment_at

_ROUNDS = 12  # of Newton's method, which doubles the digits of the chords' answer at each
_SIDE_BY_SIDE = 1e-3  # sine of the angle between, squared


class RodSearch(NamedTuple):
    """The rods of a batch and their contacts."""

    motion: ContactMotion
    rods: ContactRods
    contacts: ContactSet
    n_obstacles: int
    margin: float
    """Gap below which a minimum is a contact, as a fraction of the rod's length."""
    closer: float
    """By how much the gap must be smaller for a contact to move there [m]."""


class Nearest(NamedTuple):
    """A minimum of the distance between two centrelines."""

    s: float
    """Arclength on the first [m]."""
    t: float
    """Arclength on the other [m]."""
    distance: float
    normal: Vec
    """Normal from the other to the first, world."""


@kernel
def partner_of(contacts: ContactSet, n_obstacles: int, robot: int, q: int) -> int:
    """Number of the contact on the other rod that belongs to contact q of `robot`."""
    contact = contacts.contact[robot, q]
    other = contact.obstacle - n_obstacles
    for p in range(contacts.used[other]):
        partner = contacts.contact[other, p]
        if (
            partner.partner == contact.partner
            and partner.obstacle == n_obstacles + robot
            and not (other == robot and p == q)
        ):
            return p
    return -1


@inline
def _clamp(x: float) -> float:
    return min(max(x, 0.0), 1.0)


@kernel
def _closest_on_chords(p: Vec, u: Vec, q: Vec, v: Vec, still: float) -> tuple[float, float]:
    """Fractions of the closest points of p + s u and q + t v (Ericson, Real-Time Collision Detection, 5.1.9);
    of chords that are side by side, where any pair is as near, that at s = `still`."""
    e = sub(p, q)
    a, b, c, d, f = dot(u, u), dot(u, v), dot(v, v), dot(u, e), dot(v, e)
    det = a * c - b * b
    s = _clamp((b * f - c * d) / det) if det > _SIDE_BY_SIDE * a * c else still
    t = (b * s + f) / c
    if t < 0.0:
        s, t = _clamp(-d / a), 0.0
    elif t > 1.0:
        s, t = _clamp((b - d) / a), 1.0
    return s, t


@kernel
def _nearest_on_curves(a: Curve, b: Curve, s: float, t: float, low_a: float, low_b: float) -> Nearest:
    """The minimum near the arclengths s and t."""
    end_a, end_b = a.arclength[len(a.arclength) - 1], b.arclength[len(b.arclength) - 1]
    e = (0.0, 0.0, 1.0)
    for _ in range(_ROUNDS):
        i, x = interval_of(a, s, 0)
        j, y = interval_of(b, t, 0)
        e = sub(point_at(a, i, x), point_at(b, j, y))
        u, v = scale(end_a - low_a, tangent_at(a, i, x)), scale(end_b - low_b, tangent_at(b, j, y))
        x, y = (s - low_a) / (end_a - low_a), (t - low_b) / (end_b - low_b)
        x, y = _closest_on_chords(axpy(-x, u, e), u, scale(-y, v), v, x)  # of the tangents
        new_s, new_t = low_a + x * (end_a - low_a), low_b + y * (end_b - low_b)
        moved = abs(new_s - s) + abs(new_t - t)
        s, t = new_s, new_t
        if moved < 1e-12:
            break
    length = math.sqrt(dot(e, e))
    return Nearest(s, t, length, scale(1.0 / length, e) if length > 1e-12 else (1.0, 0.0, 0.0))


@kernel
def _known(robot: int, other: int, near: Nearest, search: RodSearch) -> int:
    """Contact of `robot` that holds this minimum with `other` already; -1 if none does."""
    contacts, spacing = search.contacts, search.rods.spacing[robot]
    for q in range(contacts.used[robot]):
        contact = contacts.contact[robot, q]
        if contact.obstacle == search.n_obstacles + other and abs(contact.arclength - near.s) < spacing:
            p = partner_of(contacts, search.n_obstacles, robot, q)
            if p >= 0 and abs(contacts.contact[other, p].arclength - near.t) < spacing:
                return q
    return -1


@inline
def _radius_at(i: int, s: float, search: RodSearch) -> float:
    """Return the radius of robot i at arclength s [m]."""
    return float(search.rods.radius[i, segment_at(search.motion.arclength[i], search.rods.n_steps, s)])


@kernel
def _add_pair(robot: int, other: int, near: Nearest, gap: float, search: RodSearch) -> bool:
    """A contact on both rods, linked by a number that neither has used; False where one of them is full."""
    used, contact = search.contacts.used, search.contacts.contact
    need = 2 if robot == other else 1
    most = contact.shape[1]
    if used[robot] + need > most or used[other] + need > most:
        return False
    link = 0
    for i in range(2):
        which = robot if i == 0 else other
        for q in range(used[which]):
            link = max(link, contact[which, q].partner + 1)
    for i in range(2):
        which, touched = (robot, other) if i == 0 else (other, robot)
        s, n = (near.s, near.normal) if i == 0 else (near.t, scale(-1.0, near.normal))
        new = contact[which, used[which]]
        radius = _radius_at(which, s, search)
        open_contact(new, search.n_obstacles + touched, s, n, gap, radius)
        new.partner = link
        used[which] += 1
    return True


@kernel
def _gap_between(robot: int, s: float, other: int, t: float, search: RodSearch) -> float:
    """Gap between two places of these robots [m]."""
    a, b = curve_of(search.motion, robot), curve_of(search.motion, other)
    i, x = interval_of(a, s, 0)
    j, y = interval_of(b, t, 0)
    e = sub(point_at(a, i, x), point_at(b, j, y))
    return math.sqrt(dot(e, e)) - (_radius_at(robot, s, search) + _radius_at(other, t, search))


@kernel
def _hold_nearest(robot: int, other: int, near: Nearest, search: RodSearch, add: bool) -> float:
    """Lower both gaps to this minimum; with `add` a contact of the two moves there, or is opened. Returns the
    violation [m]."""
    gap = near.distance - (_radius_at(robot, near.s, search) + _radius_at(other, near.t, search))
    least = search.motion.gap
    least[robot], least[other] = min(least[robot], gap), min(least[other], gap)
    known = _known(robot, other, near, search)
    if known >= 0:
        contact = search.contacts.contact[robot, known]
        partner = search.contacts.contact[
            other, partner_of(search.contacts, search.n_obstacles, robot, known)
        ]
        there = _gap_between(robot, contact.arclength, other, partner.arclength, search)
        if add and gap < there - search.closer:
            contact.arclength, partner.arclength = near.s, near.t
        return min(0.0, there) - gap
    if not gap < search.margin * search.rods.length[robot]:
        return 0.0
    if add:
        _add_pair(robot, other, near, gap, search)
    return float(-gap)


@kernel
def _search_pair(robot: int, other: int, search: RodSearch, add: bool) -> float:
    """Violation of the contacts between two robots, or of one with itself [m]."""
    rods = search.rods
    a, b = curve_of(search.motion, robot), curve_of(search.motion, other)
    n = len(a.arclength)
    worst, length, thickest = 0.0, rods.length[robot], 0.0
    for k in range(rods.radius.shape[1]):
        thickest = max(thickest, rods.radius[robot, k] + rods.radius[other, k])
    # along one rod, nearer is no contact
    apart = 0.5 * math.pi * thickest + 2.0 * rods.spacing[robot] if robot == other else -FAR
    for i in range(n - 1):
        if a.arclength[i + 1] <= rods.first[robot]:
            continue
        p = point_at(a, i, 0.0)
        u = sub(point_at(a, i, 1.0), p)
        h_a = a.arclength[i + 1] - a.arclength[i]
        j = 0
        while j < n - 1:
            h_b = b.arclength[j + 1] - b.arclength[j]
            if b.arclength[j + 1] <= rods.first[other] or (
                robot == other and b.arclength[j] - a.arclength[i + 1] < apart
            ):
                j += 1
                continue
            q = point_at(b, j, 0.0)
            v = sub(point_at(b, j, 1.0), q)
            between = sub(axpy(0.5, u, p), axpy(0.5, v, q))
            spare = math.sqrt(dot(between, between)) - 0.5 * (h_a + h_b) - thickest - search.margin * length
            if spare > 0.0:
                s = b.arclength[j] + max(spare, 0.0)
                j += 1
                while j < n - 1 and b.arclength[j + 1] < s:
                    j += 1
                continue
            x, y = _closest_on_chords(p, u, q, v, 0.5)
            s_chord, t_chord = a.arclength[i] + x * h_a, b.arclength[j] + y * h_b
            near = _nearest_on_curves(a, b, s_chord, t_chord, rods.first[robot], rods.first[other])
            here = abs(near.s - s_chord) < 2.0 * h_a and abs(near.t - t_chord) < 2.0 * h_b
            if here and not (robot == other and near.t - near.s < apart):
                worst = max(worst, _hold_nearest(robot, other, near, search, add))
            j += 1
    return worst


@kernel
def search_rods(first: int, last: int, rows: Ints, search: RodSearch, add: bool) -> float:
    """Violation of the contacts between the robots of one world, the `rows` from `first` to `last` [m]; with
    `add` they are also moved and new ones added."""
    worst = 0.0
    for r in range(first, last):
        for other in range(r if search.rods.own else r + 1, last):
            worst = max(worst, _search_pair(rows[r], rows[other], search, add))
    return worst
