"""Where rods come near each other, or one rod near itself: minima of the distance between two centrelines.

Pairs of intervals that cannot be near are skipped by as many intervals as their distance allows. From the
closest points of two chords a Newton iteration finds the minimum on the curves. Both rods get a slot; the
same number in T_TWIN links them.
"""

from __future__ import annotations

import math

from fastrod.types import ContactRods, ContactSet, Floats, Ints, RodShape

from ..jit import inline, kernel
from ..vec import Vec, axpy, dot, scale, sub
from .bvh import FAR
from .centreline import Curve, curve_of, interval_of, point_at, tangent_at
from .contact_set import T_GAP, T_OBSTACLE, T_S, T_TWIN, open_slot, segment_at

_ROUNDS = 12


@kernel
def twin_of(touching: ContactSet, n_obstacles: int, robot: int, q: int) -> int:
    """Slot on the other rod that belongs to slot q of `robot`."""
    slot = touching.slot[robot, q]
    other = int(slot[T_OBSTACLE]) - n_obstacles
    for p in range(touching.used[other]):
        twin = touching.slot[other, p]
        if (
            twin[T_TWIN] == slot[T_TWIN]
            and int(twin[T_OBSTACLE]) == n_obstacles + robot
            and not (other == robot and p == q)
        ):
            return p
    return -1


@inline
def _clamp(x: float) -> float:
    return min(max(x, 0.0), 1.0)


@kernel
def _closest_on_chords(p: Vec, u: Vec, q: Vec, v: Vec) -> tuple[float, float]:
    """Fractions of the closest points of p + s u and q + t v (Ericson, Real-Time Collision Detection,
    5.1.9)."""
    e = sub(p, q)
    a, b, c, d, f = dot(u, u), dot(u, v), dot(v, v), dot(u, e), dot(v, e)
    det = a * c - b * b
    s = _clamp((b * f - c * d) / det) if det > 1e-14 * a * c else 0.5
    t = (b * s + f) / c
    if t < 0.0:
        s, t = _clamp(-d / a), 0.0
    elif t > 1.0:
        s, t = _clamp((b - d) / a), 1.0
    return s, t


@kernel
def _nearest_on_curves(
    a: Curve, b: Curve, s: float, t: float, low_a: float, low_b: float
) -> tuple[float, float, float, Vec]:
    """Arclengths of the minimum near s and t, the distance there and the direction from b to a."""
    end_a, end_b = a.arclength[len(a.arclength) - 1], b.arclength[len(b.arclength) - 1]
    e = (0.0, 0.0, 1.0)
    for _ in range(_ROUNDS):
        i, x = interval_of(a, s, 0)
        j, y = interval_of(b, t, 0)
        e = sub(point_at(a, i, x), point_at(b, j, y))
        u, v = tangent_at(a, i, x), tangent_at(b, j, y)
        ga, gb, w = dot(e, u), -dot(e, v), dot(u, v)
        det = 1.0 - w * w
        if det > 1e-3:
            ds, dt = -(ga + w * gb) / det, -(gb + w * ga) / det
        else:  # side by side: any pair along them is as near
            ds, dt = -0.5 * ga, -0.5 * gb
        new_s, new_t = min(max(s + ds, low_a), end_a), min(max(t + dt, low_b), end_b)
        moved = abs(new_s - s) + abs(new_t - t)
        s, t = new_s, new_t
        if moved < 1e-12:
            break
    length = math.sqrt(dot(e, e))
    return s, t, length, scale(1.0 / length, e) if length > 1e-12 else (1.0, 0.0, 0.0)


@kernel
def _known(
    touching: ContactSet, n_obstacles: int, robot: int, other: int, s: float, t: float, spacing: float
) -> int:
    """Slot of `robot` that holds this contact with `other` already; -1 if none does."""
    for q in range(touching.used[robot]):
        slot = touching.slot[robot, q]
        if int(slot[T_OBSTACLE]) == n_obstacles + other and abs(slot[T_S] - s) < spacing:
            p = twin_of(touching, n_obstacles, robot, q)
            if p >= 0 and abs(touching.slot[other, p][T_S] - t) < spacing:
                return q
    return -1


@kernel
def _add_pair(
    touching: ContactSet,
    n_obstacles: int,
    robot: int,
    other: int,
    s: float,
    t: float,
    n: Vec,
    gap: float,
    rods: ContactRods,
    a: Curve,
    b: Curve,
) -> bool:
    """A slot on both rods, linked by a number that neither has used; False where one of them is full."""
    need = 2 if robot == other else 1
    most = touching.slot.shape[1]
    if touching.used[robot] + need > most or touching.used[other] + need > most:
        return False
    link = 0.0
    for i in range(2):
        which = robot if i == 0 else other
        for q in range(touching.used[which]):
            link = max(link, touching.slot[which, q, T_TWIN] + 1.0)
    r_a = rods.radius[robot, segment_at(a.arclength, rods.n_steps, s)]
    r_b = rods.radius[other, segment_at(b.arclength, rods.n_steps, t)]
    open_slot(
        touching.slot[robot, touching.used[robot]],
        n_obstacles + other,
        s,
        int(link),
        n,
        gap,
        r_a,
        rods.friction,
    )
    touching.used[robot] += 1
    open_slot(
        touching.slot[other, touching.used[other]],
        n_obstacles + robot,
        t,
        int(link),
        scale(-1.0, n),
        gap,
        r_b,
        rods.friction,
    )
    touching.used[other] += 1
    return True


@kernel
def _search_pair(
    robot: int,
    other: int,
    shape: RodShape,
    rods: ContactRods,
    touching: ContactSet,
    n_obstacles: int,
    margin: float,
    gap: Floats,
    add: bool,
) -> float:
    a, b = curve_of(shape, robot), curve_of(shape, other)
    n = len(a.arclength)
    worst, length = 0.0, rods.reach[robot]
    thickest = 0.0
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
            spare = math.sqrt(dot(between, between)) - 0.5 * (h_a + h_b) - thickest - margin * length
            if spare > 0.0:
                s = b.arclength[j] + max(spare, 0.0)
                j += 1
                while j < n - 1 and b.arclength[j + 1] < s:
                    j += 1
                continue
            x, y = _closest_on_chords(p, u, q, v)
            s, t, distance, normal = _nearest_on_curves(
                a, b, a.arclength[i] + x * h_a, b.arclength[j] + y * h_b, rods.first[robot], rods.first[other]
            )
            here = (
                abs(s - a.arclength[i] - x * h_a) < 2.0 * h_a
                and abs(t - b.arclength[j] - y * h_b) < 2.0 * h_b
            )
            if here and not (robot == other and t - s < apart):
                thick = (
                    rods.radius[robot, segment_at(a.arclength, rods.n_steps, s)]
                    + rods.radius[other, segment_at(b.arclength, rods.n_steps, t)]
                )
                open_gap = distance - thick
                gap[robot], gap[other] = min(gap[robot], open_gap), min(gap[other], open_gap)
                known = _known(touching, n_obstacles, robot, other, s, t, rods.spacing[robot])
                if known >= 0:
                    slot = touching.slot[robot, known]
                    worst = max(worst, min(0.0, slot[T_GAP]) - open_gap)
                    if add and open_gap < slot[T_GAP] - 1e-10:
                        slot[T_S] = s
                        touching.slot[other, twin_of(touching, n_obstacles, robot, known)][T_S] = t
                elif open_gap < margin * length:
                    worst = max(worst, -open_gap)
                    if add:
                        _add_pair(touching, n_obstacles, robot, other, s, t, normal, open_gap, rods, a, b)
            j += 1
    return worst


@kernel
def search_rods(
    first: int,
    last: int,
    rows: Ints,
    shape: RodShape,
    rods: ContactRods,
    touching: ContactSet,
    n_obstacles: int,
    margin: float,
    gap: Floats,
    add: bool,
) -> float:
    """Violation of the contacts between the robots of one world [m]; with `add` they are also moved and new
    ones added."""
    worst = 0.0
    for r in range(first, last):
        for other in range(r if rods.own else r + 1, last):
            worst = max(
                worst,
                _search_pair(rows[r], rows[other], shape, rods, touching, n_obstacles, margin, gap, add),
            )
    return worst
