"""The contact set of one robot: contacts to keep, to move and to add, from what the search has found.

A contact (`CONTACT`) holds at one arclength, against one wall of one obstacle. A superset does no harm, for
the law opens those that are not needed; so contacts that carry a force stay, move along the rod to the
minimum of the gap near them, and new ones come where the gap is violated (an exchange method for the
constraint gap(s) >= 0 at every s).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fastrod.types import Floats, Records, Surfaces

from ..jit import inline, kernel
from ..vec import Vec, dot, mul
from .bvh import FAR, Numbers, Record, normal_of
from .surface import ray_hit, rotation_of, signed_distance, to_obstacle, walls

_SAME_WALL = 0.99999  # cosine: normals 0.26 degrees apart, far less than two faces of a corner
_SAME_GAP = 1e-9  # m; a contact does not move for less
_ALIKE = 0.5  # cosine of normals that may be of one contact
_TURNED, _FASTER = 0.02, 10.0  # rad, and times that: a normal that turns by more jumps
# of a step: the least that two contacts of one obstacle are apart; with friction, where both would share the
# load of one place in any proportion
_CLOSE, _BESIDE = 1e-3, 1e-2


NEW = -1.0  # m: slip of a contact that is not known yet


class ContactRules(NamedTuple):
    """Parameters of one robot's choice of contacts, beside the contacts."""

    surfaces: Surfaces
    n_obstacles: int
    radius: Floats
    """(n_segments,) [m]."""
    n_steps: int
    arclength: Floats
    """(n_points,) [m]."""
    spacing: float
    """Length of an integration step [m]."""
    tolerance: float
    """Violation that counts as none [m]."""
    keep: float
    """Gap below which an idle contact is kept [m]."""
    still: bool
    """Contacts stay where they are, and none is dropped: more come where the gap is violated."""


@inline
def force_of(contact: Record) -> Vec:
    """On the rod, world [N]."""
    f = contact.force
    return f[0], f[1], f[2]


@inline
def carries(contact: Record) -> bool:
    """F . F > 0: the contact presses."""
    f = force_of(contact)
    return dot(f, f) > 0.0


@inline
def set_normal(contact: Record, n: Vec) -> None:
    """Unit vector toward the rod, world."""
    contact.normal[0], contact.normal[1], contact.normal[2] = n


@inline
def open_contact(contact: Record, obstacle: int, s: float, n: Vec, gap: float, radius: float) -> None:
    """Write a contact that carries nothing yet: normal n, world, `gap` and `radius` [m]."""
    contact.obstacle, contact.partner = obstacle, -1
    contact.arclength, contact.gap, contact.radius = s, gap, radius
    set_normal(contact, n)
    contact.force[0], contact.force[1], contact.force[2] = 0.0, 0.0, 0.0
    contact.held[0], contact.held[1], contact.held[2] = 0.0, 0.0, 0.0
    contact.slid = NEW
    contact.place[0], contact.place[1], contact.place[2] = FAR, FAR, FAR
    contact.matched = False


@kernel
def wall_at(
    k: int, frame: Floats, p: Vec, old: Vec, margin: float, surfaces: Surfaces, stack: Numbers, found: Records
) -> tuple[float, Vec]:
    """Signed distance of the centreline point p to that wall of obstacle k which faces as `old` does, and its
    normal.

    Where the centreline has gone through the surface, the nearest side may be the wrong one: what counts is
    the side on which the contact was, found by going back along its normal. A convex obstacle has no other
    wall in front of p than the nearest.
    """
    d, n, _ = signed_distance(k, frame, p, FAR, surfaces, stack)
    if d < 0.0:
        if dot(n, old) < 0.2:
            t, wall = ray_hit(k, frame, p, old, FAR, surfaces, stack)
            facing = dot(wall, old)
            if t < FAR and facing > 0.0:
                return -t * facing, wall
        return d, n
    if surfaces.convex[k]:
        return d, n
    best, alike = -1, dot(n, old) + 1e-6
    count = walls(k, frame, p, d + margin, d, surfaces, stack, found)
    for j in range(count):
        facing = dot(normal_of(found[j]), old)
        if facing > alike:
            best, alike = j, facing
    if best >= 0:
        return found[best].distance, normal_of(found[best])
    return d, n


@inline
def _jumps(n: Vec, old: Vec, moved: Vec, d: float) -> bool:
    """A normal has turned by more than a place at this distance from an edge turns it as it moves."""
    turned = math.sqrt(max(2.0 - 2.0 * dot(n, old), 0.0))
    return turned > _TURNED and turned * max(d, 0.0) > _FASTER * math.sqrt(dot(moved, moved))


@kernel
def measure(
    contact: Record, frame: Floats, p: Vec, margin: float, surfaces: Surfaces, stack: Numbers, found: Records
) -> float:
    """Gap and normal of a contact whose centreline is at p now, kept in it; returns the distance of p [m], 0
    where the contact is with another wall than the nearest."""
    old, last, local = normal_of(contact), contact.place, to_obstacle(frame, p)
    moved = mul(rotation_of(frame), (local[0] - last[0], local[1] - last[1], local[2] - last[2]))
    d, n = wall_at(contact.obstacle, frame, p, old, margin, surfaces, stack, found)
    contact.place[0], contact.place[1], contact.place[2] = local
    if carries(contact) and _jumps(n, old, moved, d):
        # in a crease: what it presses on is beside what is nearest now, which is another contact's matter
        contact.gap += dot(old, moved)
        return 0.0
    contact.gap = d - contact.radius
    set_normal(contact, n)
    return d


@inline
def compliant(k: int, surfaces: Surfaces) -> bool:
    """A rod may be deep in obstacle k: it is soft, or free to move."""
    return bool(surfaces.compliance[k] > 0.0 or surfaces.mobility[k, 0, 0] > 0.0)


@kernel
def _held_depth(k: int, s: float, count: int, contacts: Records, spacing: float) -> float:
    """The smallest gap of the contacts with obstacle k beside arclength s, at most 0 [m]."""
    level = 0.0
    for c in range(count):
        if contacts[c].obstacle == k and abs(contacts[c].arclength - s) < spacing:
            level = min(level, contacts[c].gap)
    return level


@kernel
def violation(
    n_found: int, found: Records, count: int, contacts: Records, spacing: float, surfaces: Surfaces
) -> tuple[float, int]:
    """Return how far the gap falls below what the present contacts can close [m], and the candidate where
    it falls deepest. Only where an obstacle is compliant may a contact be deep."""
    worst, where = 0.0, -1
    for f in range(n_found):
        k = found[f].obstacle
        level = 0.0
        if compliant(k, surfaces):
            level = _held_depth(k, found[f].arclength, count, contacts, spacing)
        if level - found[f].gap > worst:
            worst, where = level - found[f].gap, f
    return worst, where


@inline
def segment_at(arclength: Floats, n_steps: int, s: float) -> int:
    """Segment of the arclength s, `n_steps` intervals each: at a joint the distal one, beyond the tip the
    last."""
    n_segments = (len(arclength) - 1) // n_steps
    k = 0
    while k < n_segments - 1 and arclength[(k + 1) * n_steps] <= s:
        k += 1
    return k


@kernel
def presses_beside(c: int, count: int, contacts: Records, within: float) -> bool:
    """Another contact of the rod with the obstacle of contact c presses, so near along the rod [m]."""
    for e in range(count):
        beside = e != c and abs(contacts[e].arclength - contacts[c].arclength) < within
        if beside and contacts[e].obstacle == contacts[c].obstacle and carries(contacts[e]):
            return True
    return False


@inline
def _other_wall(contact: Record, gap: float, away: float, tolerance: float) -> bool:
    """The contact holds another wall than the one with this gap, so far away along the rod: the gap to one
    changes by at most 1 per metre. Moving it there would close nothing."""
    return bool(contact.gap - gap > away + tolerance)


@kernel
def _keep_wanted(count: int, contacts: Records, rules: ContactRules) -> int:
    """Drop the contacts that neither press nor may be wanted next; returns how many are left."""
    n, room = 0, count <= len(contacts) - 4
    for c in range(count):
        contact = contacts[c]
        idle = contact.gap < (rules.keep if contact.obstacle < rules.n_obstacles else 0.0)
        spare = contact.gap >= 10.0 * rules.tolerance and presses_beside(c, count, contacts, rules.spacing)
        if rules.still or carries(contact) or (idle and room and not spare):
            if n != c:
                contacts[n] = contacts[c]
            contacts[n].matched = False
            n += 1
    return n


@kernel
def _nearest(candidate: Record, n: int, contacts: Records, rules: ContactRules) -> int:
    """The contact that a candidate belongs to, nearer than a step and not matched yet; -1 if none."""
    normal = normal_of(candidate)
    near, nearest = -1, rules.spacing
    for c in range(n):
        contact = contacts[c]
        away = abs(contact.arclength - candidate.arclength)
        if (
            contact.obstacle == candidate.obstacle
            and not contact.matched
            and away < nearest
            and dot(normal_of(contact), normal) > _ALIKE
            and not _other_wall(contact, candidate.gap, away, rules.tolerance)
        ):
            near, nearest = c, away
    return near


@kernel
def _follow(contact: Record, candidate: Record, alone: bool, rules: ContactRules) -> bool:
    """Move a contact to the minimum of the gap near it; False where it should stay, and another be put beside
    it."""
    rubs = rules.surfaces.friction[candidate.obstacle] > 0.0
    closer = 0.5 * rules.tolerance if rules.still else _SAME_GAP if rubs else 0.0
    if candidate.gap >= contact.gap - closer:
        return True
    if rules.still:
        return False
    beside = (_BESIDE if rubs else _CLOSE) * rules.spacing
    near = abs(contact.arclength - candidate.arclength) < beside
    follows = near or (alone and not rubs) or not carries(contact)
    if follows:
        contact.arclength = candidate.arclength
    return follows


@kernel
def _add(candidate: Record, n: int, contacts: Records, apart: float, rules: ContactRules) -> int:
    """Open a contact for a candidate, unless one with its normal is nearer than `apart`, or there is no room;
    returns how many there are."""
    s, gap, normal = candidate.arclength, candidate.gap, normal_of(candidate)
    alike = _SAME_WALL if gap < -0.5 * rules.tolerance else _ALIKE
    for c in range(n):
        away = abs(contacts[c].arclength - s)
        if (
            contacts[c].obstacle == candidate.obstacle
            and away < apart
            and dot(normal_of(contacts[c]), normal) > alike
            and not _other_wall(contacts[c], gap, away, rules.tolerance)
        ):
            return n
    at, widest = n, gap
    for c in range(n if n == len(contacts) and gap < -rules.tolerance else 0):  # in place of an idle one
        if contacts[c].partner < 0 and contacts[c].gap > widest and not carries(contacts[c]):
            at, widest = c, contacts[c].gap
    if at == len(contacts):
        return n
    radius = rules.radius[segment_at(rules.arclength, rules.n_steps, s)]
    open_contact(contacts[at], candidate.obstacle, s, normal, gap, radius)
    contacts[at].matched = True
    return max(n, at + 1)


@kernel
def choose(n_found: int, found: Records, count: int, contacts: Records, rules: ContactRules) -> int:
    """Contacts for the next pass, in place; returns how many. Those that press stay, and idle ones whose gap
    is below `rules.keep`: they may be wanted next. A contact alone follows the least gap; where
    there are several (a rod that hugs a curved surface), or friction, another is put beside it, and the law
    shares the force out."""
    n = _keep_wanted(count, contacts, rules)
    for f in range(n_found):
        candidate = found[f]
        k = candidate.obstacle
        apart = _CLOSE * rules.spacing if candidate.gap < -0.5 * rules.tolerance else rules.spacing
        near = _nearest(candidate, n, contacts, rules)
        if near >= 0:
            contacts[near].matched = True
            if _follow(contacts[near], candidate, not presses_beside(near, n, contacts, FAR), rules):
                continue
            apart = _CLOSE * rules.spacing
        if k < rules.n_obstacles and compliant(k, rules.surfaces):
            held = _held_depth(k, candidate.arclength, n, contacts, rules.spacing)
            if candidate.gap >= held - rules.tolerance:
                continue  # a contact more would only stiffen the obstacle
        n = _add(candidate, n, contacts, apart, rules)
    return n


@kernel
def add_walls(
    count: int,
    contacts: Records,
    centre: Floats,
    frames: Floats,
    margin: float,
    surfaces: Surfaces,
    stack: Numbers,
    found: Records,
) -> int:
    """Give every further wall of a concave corner a contact of its own; `centre` (max_contacts, 3) is the
    centreline at each."""
    n = count
    for c in range(count):
        contact = contacts[c]
        k = contact.obstacle
        if k >= len(frames) or surfaces.convex[k]:
            continue
        p = (centre[c, 0], centre[c, 1], centre[c, 2])
        d, _, _ = signed_distance(k, frames[k], p, FAR, surfaces, stack)
        limit = contact.radius + margin
        n_walls = walls(k, frames[k], p, limit, d, surfaces, stack, found) if 0.0 <= d < limit else 0
        for j in range(n_walls):
            normal = normal_of(found[j])
            known = n >= len(contacts)
            for e in range(n):
                same = contacts[e].obstacle == k and abs(contacts[e].arclength - contact.arclength) < 1e-9
                known = known or (same and dot(normal_of(contacts[e]), normal) > _SAME_WALL)
            if not known:
                gap = found[j].distance - contact.radius
                open_contact(contacts[n], k, contact.arclength, normal, gap, contact.radius)
                n += 1
    return n


@kernel
def merge(count: int, contacts: Records, spacing: float) -> int:
    """Contacts of one obstacle at one place with one normal become one."""
    n = 0
    for c in range(count):
        contact = contacts[c]
        into = -1
        for e in range(n):
            other = contacts[e]
            if (
                other.obstacle == contact.obstacle
                and other.partner < 0
                and contact.partner < 0
                and abs(other.arclength - contact.arclength) < 1e-4 * spacing
                and dot(normal_of(other), normal_of(contact)) > _SAME_WALL
            ):
                into = e
        if into >= 0:
            for a in range(3):
                contacts[into].force[a] += contact.force[a]
                contacts[into].held[a] += contact.held[a]
            continue
        if n != c:
            contacts[n] = contacts[c]
        n += 1
    return n
