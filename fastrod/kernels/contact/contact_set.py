"""The contacts of one robot: which to keep, to move and to add, from what the search has found.

A contact holds at one arclength, against one wall of one obstacle. A superset does no harm, for the law opens
those that are not needed; so contacts that carry a force stay, move along the rod to the minimum of the gap
near them, and new ones come where the gap is violated (an exchange method for the constraint gap(s) >= 0 at
every s).
"""

from __future__ import annotations

from fastrod.types import Floats, Surfaces

from ..jit import inline, kernel
from ..vec import Vec, dot, scale
from .bvh import FAR, Numbers
from .surface import ray_hit, signed_distance, walls

T_OBSTACLE, T_S, T_TWIN, T_N, T_GAP, T_FORCE, T_RADIUS, T_ARM, T_TAKEN, T_SHIFT, T_HOLD, SLOT = (
    0,
    1,
    2,
    3,
    6,
    7,
    10,
    11,
    12,
    13,
    14,
    15,
)
"""Obstacle (from n_obstacles on: rods), arclength, number that links both sides of a contact between rods or
-1, normal toward the rod, gap, force on the rod (world), radius of the rod there; arm: how far below the
centreline the force acts, the radius where there is friction, else 0, for a normal force has no moment;
taken: scratch of `choose`; shift: how far it moved along the rod the last time; hold: stiffness that damping
took last [N/m]."""
_SAME_WALL = 0.99999
_CLOSE = 1e-3  # of a step: the least that two contacts of one obstacle are apart


@inline
def slot_normal(slot: Numbers) -> Vec:
    """Unit vector toward the rod, world."""
    return slot[T_N], slot[T_N + 1], slot[T_N + 2]


@inline
def slot_force(slot: Numbers) -> Vec:
    """On the rod, world [N]."""
    return slot[T_FORCE], slot[T_FORCE + 1], slot[T_FORCE + 2]


@inline
def carries(slot: Numbers) -> bool:
    """F . F > 0: the contact presses."""
    f = slot_force(slot)
    return dot(f, f) > 0.0


@inline
def open_slot(
    slot: Numbers, obstacle: int, s: float, twin: int, n: Vec, gap: float, radius: float, friction: float
) -> None:
    """Write a contact that carries nothing yet: normal n, world, `gap` and `radius` [m]. Only friction gives
    its force an arm."""
    slot[T_OBSTACLE], slot[T_S], slot[T_TWIN], slot[T_GAP], slot[T_RADIUS] = (
        float(obstacle),
        s,
        float(twin),
        gap,
        radius,
    )
    slot[T_N], slot[T_N + 1], slot[T_N + 2] = n
    slot[T_ARM], slot[T_SHIFT], slot[T_HOLD] = radius if friction > 0.0 else 0.0, FAR, 0.0
    slot[T_FORCE], slot[T_FORCE + 1], slot[T_FORCE + 2], slot[T_TAKEN] = 0.0, 0.0, 0.0, 0.0


@kernel
def wall_at(
    k: int, frame: Floats, p: Vec, old: Vec, margin: float, surfaces: Surfaces, stack: Numbers, found: Numbers
) -> tuple[float, Vec]:
    """Signed distance of the centreline point p to that wall of obstacle k which faces as `old` does, and its
    normal.

    Where the centreline has gone through the surface, the nearest side may be the wrong one: what counts is
    the side on which the contact was, found by going back along its normal.
    """
    d, n, _ = signed_distance(k, frame, p, FAR, surfaces, stack)
    if d < 0.0:
        if dot(n, old) < 0.2:
            t, wall = ray_hit(k, frame, p, old, FAR, surfaces, stack)
            facing = dot(wall, old)
            if t < FAR and facing > 0.0:
                return -t * facing, wall
        return d, n
    best, alike = -1, dot(n, old) + 1e-6
    count = walls(k, frame, p, d + margin, d, surfaces, stack, found)
    for j in range(count):
        facing = dot((found[5 * j + 1], found[5 * j + 2], found[5 * j + 3]), old)
        if facing > alike:
            best, alike = j, facing
    if best >= 0:
        return found[5 * best], (found[5 * best + 1], found[5 * best + 2], found[5 * best + 3])
    return d, n


@inline
def gives_way(k: int, surfaces: Surfaces) -> bool:
    """A rod may be deep in obstacle k: it is soft, or free to move."""
    return bool(surfaces.compliance[k] > 0.0 or surfaces.give[k, 0] > 0.0)


@kernel
def _held_depth(k: int, s: float, count: int, slot: Floats, spacing: float) -> float:
    """The smallest gap of the contacts with obstacle k beside arclength s, at most 0 [m]."""
    level = 0.0
    for c in range(count):
        if int(slot[c, T_OBSTACLE]) == k and abs(slot[c, T_S] - s) < spacing:
            level = min(level, slot[c, T_GAP])
    return level


@kernel
def violation(
    n_found: int, found: Floats, count: int, slot: Floats, spacing: float, surfaces: Surfaces
) -> tuple[float, int]:
    """How far the gap falls below what the contacts that there are can mend [m], and the candidate where it
    falls deepest. Only where an obstacle gives way may a contact be deep."""
    worst, where = 0.0, -1
    for f in range(n_found):
        k = int(found[f, 0])
        level = _held_depth(k, found[f, 1], count, slot, spacing) if gives_way(k, surfaces) else 0.0
        if level - found[f, 2] > worst:
            worst, where = level - found[f, 2], f
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
def _segment_is_full(s: float, count: int, slot: Floats, arclength: Floats, n_steps: int) -> bool:
    """As many contacts on this segment as it has nodes inside to put them on."""
    k = segment_at(arclength, n_steps, s)
    members = 0
    for c in range(count):
        members += segment_at(arclength, n_steps, slot[c, T_S]) == k
    return members >= n_steps - 1


@kernel
def _spare(c: int, count: int, slot: Floats, spacing: float, tolerance: float) -> bool:
    """An idle contact, open and beside one that presses: it is not wanted next, and its node is better spread
    out."""
    if slot[c, T_GAP] < 10.0 * tolerance:
        return False
    for e in range(count):
        if (
            slot[e, T_OBSTACLE] == slot[c, T_OBSTACLE]
            and abs(slot[e, T_S] - slot[c, T_S]) < spacing
            and carries(slot[e])
        ):
            return True
    return False


@kernel
def _least_wanted(
    s: float, gap: float, count: int, slot: Floats, arclength: Floats, n_steps: int, anywhere: bool
) -> int:
    """Of the idle contacts on the segment of s, or `anywhere`, the one with the widest gap, if it is wider
    than `gap`; -1 if none is."""
    k, widest, at = segment_at(arclength, n_steps, s), gap, -1
    for c in range(count):
        here = anywhere or segment_at(arclength, n_steps, slot[c, T_S]) == k
        if here and slot[c, T_TWIN] < 0.0 and slot[c, T_GAP] > widest and not carries(slot[c]):
            widest, at = slot[c, T_GAP], c
    return at


@inline
def _other_wall(slot: Numbers, gap: float, away: float, tolerance: float) -> bool:
    """The contact holds another wall than the one with this gap, so far away along the rod: the gap to one
    changes by at most 1 per metre. To move it there would mend nothing."""
    return bool(slot[T_GAP] - gap > away + tolerance)


@kernel
def choose(
    n_found: int,
    found: Floats,
    count: int,
    slot: Floats,
    n_obstacles: int,
    radius: Floats,
    surfaces: Surfaces,
    n_steps: int,
    arclength: Floats,
    spacing: float,
    tolerance: float,
    keep: float,
) -> int:
    """Contacts for the next pass, in place; returns how many. Those that press stay, and idle ones whose gap
    is below `keep`:
    they may be wanted next. A contact follows the minimum of the gap as long as its shifts shrink; where they
    do not (a rod that hugs a curved surface), another is put beside it, and the law shares the force out."""
    n = 0
    room = count <= len(slot) - 4
    for c in range(count):
        idle = slot[c, T_GAP] < (keep if int(slot[c, T_OBSTACLE]) < n_obstacles else 0.0)
        if carries(slot[c]) or (idle and room and not _spare(c, count, slot, spacing, tolerance)):
            if n != c:
                for a in range(SLOT):
                    slot[n, a] = slot[c, a]
            slot[n, T_TAKEN] = 0.0
            n += 1
    for f in range(n_found):
        k, s, gap = int(found[f, 0]), found[f, 1], found[f, 2]
        normal = (found[f, 3], found[f, 4], found[f, 5])
        near, nearest, lonely = -1, FAR, spacing
        for c in range(n):
            away = abs(slot[c, T_S] - s)
            if int(slot[c, T_OBSTACLE]) != k:
                continue
            free = (
                slot[c, T_TAKEN] == 0.0
                and dot(slot_normal(slot[c]), normal) > 0.5
                and not _other_wall(slot[c], gap, away, tolerance)
            )
            if free and away < spacing and away < nearest:
                near, nearest = c, away
        if gap < -tolerance:
            lonely = _CLOSE * spacing
        if near >= 0:
            slot[near, T_TAKEN] = 1.0
            if gap >= slot[near, T_GAP] - (1e-10 if slot[near, T_ARM] > 0.0 else 0.0):
                continue
            settles = nearest < max(0.5 * slot[near, T_SHIFT], _CLOSE * spacing)
            if settles or not carries(slot[near]) or slot[near, T_ARM] > 0.0:
                slot[near, T_S], slot[near, T_SHIFT] = s, nearest if carries(slot[near]) else FAR
                continue
            lonely = _CLOSE * spacing
        if (
            k < n_obstacles
            and gives_way(k, surfaces)
            and gap >= _held_depth(k, s, n, slot, spacing) - tolerance
        ):
            continue  # a contact more would only stiffen the obstacle
        crowded, full = False, n >= len(slot) or _segment_is_full(s, n, slot, arclength, n_steps)
        for c in range(n):
            away = abs(slot[c, T_S] - s)
            if int(slot[c, T_OBSTACLE]) == k and away < lonely and dot(slot_normal(slot[c]), normal) > 0.5:
                crowded = crowded or not _other_wall(slot[c], gap, away, tolerance)
        at = n
        if full and not crowded and gap < -tolerance:
            at = _least_wanted(
                s, gap, n, slot, arclength, n_steps, not _segment_is_full(s, n, slot, arclength, n_steps)
            )
        if not crowded and (not full or at >= 0) and at < len(slot):
            open_slot(
                slot[at],
                k,
                s,
                -1,
                normal,
                gap,
                radius[segment_at(arclength, n_steps, s)],
                surfaces.friction[k],
            )
            slot[at, T_TAKEN] = 1.0
            n = max(n, at + 1)
    return n


@kernel
def stands(count: int, slot: Floats, tolerance: float) -> bool:
    """Contacts without friction that the law need not be asked about: none is deeper than `tolerance`, none
    presses that is open by more, none pulls."""
    for c in range(count):
        press = dot(slot_force(slot[c]), slot_normal(slot[c]))
        if (
            slot[c, T_ARM] > 0.0
            or slot[c, T_GAP] < -tolerance
            or press < 0.0
            or (carries(slot[c]) and slot[c, T_GAP] > tolerance)
        ):
            return False
    return True


@kernel
def pressed_only(count: int, slot: Floats) -> int:
    """Drop the contacts that carry nothing; returns how many are left."""
    n = 0
    for c in range(count):
        if carries(slot[c]):
            for a in range(SLOT if n != c else 0):
                slot[n, a] = slot[c, a]
            n += 1
    return n


@kernel
def add_walls(
    count: int,
    slot: Floats,
    points: Floats,
    frames: Floats,
    margin: float,
    surfaces: Surfaces,
    stack: Numbers,
    found: Numbers,
) -> int:
    """Give every further wall of a concave corner a contact of its own; `points` (n_slots, 3) are the
    centreline at each."""
    n = count
    for c in range(count):
        k = int(slot[c, T_OBSTACLE])
        if k >= len(frames):
            continue
        p = (points[c, 0], points[c, 1], points[c, 2])
        d, _, _ = signed_distance(k, frames[k], p, FAR, surfaces, stack)
        reach = slot[c, T_RADIUS] + margin
        n_walls = walls(k, frames[k], p, reach, d, surfaces, stack, found) if 0.0 <= d < reach else 0
        for j in range(n_walls):
            normal = (found[5 * j + 1], found[5 * j + 2], found[5 * j + 3])
            known = n >= len(slot)
            for e in range(n):
                same = int(slot[e, T_OBSTACLE]) == k and abs(slot[e, T_S] - slot[c, T_S]) < 1e-9
                known = known or (same and dot(slot_normal(slot[e]), normal) > _SAME_WALL)
            if not known:
                open_slot(
                    slot[n],
                    k,
                    slot[c, T_S],
                    -1,
                    normal,
                    found[5 * j] - slot[c, T_RADIUS],
                    slot[c, T_RADIUS],
                    surfaces.friction[k],
                )
                n += 1
    return n


@kernel
def merge(count: int, slot: Floats, spacing: float) -> int:
    """Contacts of one obstacle at one place with one normal become one."""
    n = 0
    for c in range(count):
        into = -1
        for e in range(n):
            same = (
                slot[e, T_OBSTACLE] == slot[c, T_OBSTACLE] and slot[e, T_TWIN] < 0.0 and slot[c, T_TWIN] < 0.0
            )
            if (
                same
                and abs(slot[e, T_S] - slot[c, T_S]) < 1e-4 * spacing
                and dot(slot_normal(slot[e]), slot_normal(slot[c])) > _SAME_WALL
            ):
                into = e
        if into >= 0:
            for a in range(3):
                slot[into, T_FORCE + a] += slot[c, T_FORCE + a]
            continue
        if n != c:
            for a in range(SLOT):
                slot[n, a] = slot[c, a]
        n += 1
    return n


@kernel
def arm_of(slot: Numbers) -> Vec:
    """From the centreline to where the force acts."""
    return scale(-slot[T_ARM], slot_normal(slot))
