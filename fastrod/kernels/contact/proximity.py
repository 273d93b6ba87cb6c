"""Where one rod comes nearest to the obstacles: local minima of the signed distance along its centreline.

phi(s) is the signed distance of the centreline, with slope n . r'. It changes by at most 1 per metre, so that
what was measured once rules out whole stretches, along the rod and over time (`Clearance`). Where phi may
fall below the rod's radius and the margin, its minimum in an interval is found on the slope; every minimum is
a candidate for contact:
obstacle, arclength, gap and normal.

An interval can hold several minima. It is halved until no part of it can hide a dip below the rod's radius
that is deeper than
`UNSEEN` (`_may_hide`), so that the whole rod is searched and not its nodes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fastrod.types import Floats, Surfaces

from ..jit import inline, kernel
from ..vec import Vec, axpy, dot, sub
from .bvh import FAR, STACK, Numbers
from .centreline import Curve, interval_of, point_at, tangent_at
from .surface import ray_hit, signed_distance

CANDIDATE = 6  # numbers of one: obstacle, arclength, gap, normal
UNSEEN = 1e-5
"""A dip below the rod's radius that is shallower may stay unseen [m]: a tenth of the depth at which a rest is
none."""
_ITERATIONS = 40
# |dr/ds| of the interpolated curve is below it: 1 at the nodes, and to fourth order between them
_STEEP = 1.01
_DEEPEST = 20  # halvings of an interval
# of an interval: no finer where the rod is deep already, for there all that matters is known
_COARSE = 1.0 / 16.0
_FLAT = 1e-9  # a slope below it is none
# of the rod's length: how far beyond what is needed a first look goes, so that later ones are spared
_RELAY = 0.25


class ProximityOptions(NamedTuple):
    """How a search is to be done."""

    radius: Floats
    """(n_segments,) of the rod [m]."""
    n_steps: int
    first: float
    """Arclength where contact begins: what is nearer to the base belongs to its mounting [m]."""
    margin: float
    """Gap below which a minimum is a candidate [m]."""
    spacing: float
    """Two candidates of one obstacle nearer than this are one [m]."""
    nearest: bool
    """Not every dip below the rod's radius is asked for, but the smallest gap, wherever it is."""


@inline
def node_point(curve: Curve, j: int, start: int, part: float) -> Vec:
    """Node j; for the first one the point where contact begins."""
    return (
        point_at(curve, j, part if j == start else 0.0)
        if j < len(curve.arclength) - 1
        else point_at(curve, j - 1, 1.0)
    )


@inline
def node_tangent(curve: Curve, j: int, start: int, part: float) -> Vec:
    """dr/ds at node j; for the first one at the point where contact begins."""
    return (
        tangent_at(curve, j, part if j == start else 0.0)
        if j < len(curve.arclength) - 1
        else tangent_at(curve, j - 1, 1.0)
    )


@inline
def radius_after(sweep: ProximityOptions, j: int) -> float:
    """Of the interval after node j."""
    return float(sweep.radius[min(j // sweep.n_steps, len(sweep.radius) - 1)])


@kernel
def minimum(
    k: int,
    frame: Floats,
    curve: Curve,
    j: int,
    low: float,
    high: float,
    phi_high: float,
    surfaces: Surfaces,
    stack: Numbers,
) -> tuple[float, float, Vec]:
    """Fraction, signed distance and normal of the minimum in the interval after node j: phi falls at `low`,
    and at `high` it rises or is higher. Bisection on the slope, with a secant once both ends have one."""
    slope_low, slope_high = 0.0, 0.0
    part, d, n = high, phi_high, (0.0, 0.0, 1.0)
    for count in range(_ITERATIONS):
        share = slope_low / (slope_low - slope_high) if slope_low < 0.0 < slope_high and count % 3 else 0.5
        part = low + min(max(share, 0.01), 0.99) * (high - low)
        d, n, _ = signed_distance(k, frame, point_at(curve, j, part), FAR, surfaces, stack)
        slope = dot(n, tangent_at(curve, j, part))
        if abs(slope) < _FLAT or high - low < 1e-7:
            break
        if slope < 0.0 and d <= phi_high:
            low, slope_low = part, slope
        else:
            high, slope_high, phi_high = part, slope, max(d, phi_high) if slope > 0.0 else d
    return part, d, n


@kernel
def _note(k: int, s: float, gap: float, n: Vec, spacing: float, found: Floats, n_found: int) -> int:
    """Write a candidate, in place of a near or (where full) of the widest one that is wider; returns how many
    there are."""
    at, widest = n_found, -FAR
    for c in range(n_found):
        if int(found[c, 0]) == k and abs(found[c, 1] - s) < spacing:
            if found[c, 2] <= gap:
                return n_found
            at, widest = c, FAR
            break
        if n_found == len(found) and found[c, 2] > widest:
            at, widest = c, found[c, 2]
    if at < n_found and widest <= gap:
        return n_found
    found[at, 0], found[at, 1], found[at, 2] = float(k), s, gap
    found[at, 3], found[at, 4], found[at, 5] = n
    return max(n_found, at + 1)


@kernel
def _may_hide(f0: float, f1: float, length: float, curvature: float, level: float) -> bool:
    """Whether phi may fall below `level` in a stretch of this length with phi = f0 and f1 at its ends.

    The square of the distance to a fixed point has a second derivative of at most 2 (r' . r' + phi |r''|)
    along the curve; so phi^2, the least of them, lies above the parabola of that second derivative through
    the ends. It falls by length^2 / 8 phi, where phi by itself might fall by length / 2. Without a radius, or
    inside of an obstacle, that slope is all that is known.
    """
    level = min(level, min(f0, f1) - UNSEEN)
    if level <= 0.0:
        return 0.5 * (f0 + f1 - _STEEP * length) < level
    fall = (_STEEP * _STEEP + max(f0, f1) * curvature) * length * length
    a, b = f0 * f0, f1 * f1
    if abs(b - a) >= fall:
        return False
    return 0.5 * (a + b) - 0.25 * fall - 0.25 * (b - a) * (b - a) / fall < level * level


@inline
def _bend(curve: Curve, j: int) -> float:
    """Curvature at node j [1/m]."""
    u = curve.curvature[j]
    return math.sqrt(u[0] * u[0] + u[1] * u[1])


@kernel
def _search_interval(
    k: int,
    frame: Floats,
    curve: Curve,
    j: int,
    low: float,
    ends: Numbers,
    sweep: ProximityOptions,
    smallest: float,
    surfaces: Surfaces,
    stack: Numbers,
    found: Floats,
    n_found: int,
) -> tuple[int, float]:
    """Minima of the interval after node j from its fraction `low` on; returns how many candidates there are,
    and the smallest gap.

    `ends` begins with phi and slope at `low`, then fraction, phi and slope at the end; there is room for
    `_DEEPEST` more of these.
    """
    h = curve.arclength[j + 1] - curve.arclength[j]
    rho, curvature = radius_after(sweep, j), 1.1 * max(_bend(curve, j), _bend(curve, j + 1))
    x0, f0, g0, m = low, ends[0], ends[1], 1
    smallest = min(smallest, min(f0, ends[3]) - rho)
    while m > 0:
        o = 3 * m - 1
        x1, f1, g1 = ends[o], ends[o + 1], ends[o + 2]
        length = (x1 - x0) * h
        least = 0.5 * (f0 + f1 - _STEEP * length) - rho
        if least <= sweep.margin:
            deep = min(f0, f1) < rho - 2.0 * UNSEEN
            fine = length > 2.0 * UNSEEN and m <= _DEEPEST and (x1 - x0 > _COARSE or not deep)
            level = rho + (smallest if sweep.nearest else 0.0) - UNSEEN
            if fine and least < level - rho and _may_hide(f0, f1, length, curvature, level):
                x = 0.5 * (x0 + x1)
                ends[o + 3] = x
                ends[o + 4], normal, _ = signed_distance(
                    k, frame, point_at(curve, j, x), FAR, surfaces, stack
                )
                ends[o + 5] = dot(normal, tangent_at(curve, j, x))
                smallest = min(smallest, ends[o + 4] - rho)
                m += 1
                continue
            falls, rises = g0 < _FLAT, g1 > -_FLAT
            place, d, normal = -1.0, FAR, (0.0, 0.0, 1.0)
            if falls and rises and (abs(g0) < _FLAT or abs(g1) < _FLAT):
                place = x0 if f0 <= f1 else x1  # an end is the minimum, or the rod lies along the surface
                d, normal, _ = signed_distance(k, frame, point_at(curve, j, place), FAR, surfaces, stack)
            elif (falls and (rises or f1 > f0)) or (rises and f0 > f1):
                place, d, normal = minimum(k, frame, curve, j, x0, x1, max(f0, f1), surfaces, stack)
            smallest = min(smallest, d - rho)
            if d - rho < sweep.margin:
                s = max(sweep.first, curve.arclength[j] + place * h)
                n_found = _note(k, s, d - rho, normal, sweep.spacing, found, n_found)
        x0, f0, g0, m = x1, f1, g1, m - 1
    return n_found, smallest


@kernel
def search_obstacles(
    curve: Curve,
    sweep: ProximityOptions,
    surfaces: Surfaces,
    frames: Floats,
    distance: Floats,
    position: Floats,
    work: Numbers,
    found: Floats,
) -> tuple[int, float]:
    """Candidates of one robot, written to `found` (n_most, CANDIDATE), and the smallest gap (a lower bound
    where it is beyond the margin).

    `distance` (n_points,) and `position` (n_points, 3) are the robot's rows of `Clearance`, kept up to date;
    `work` holds
    4 n_points + 4 STACK numbers.
    """
    n, n_obstacles = len(curve.arclength), len(frames)
    phi, slope, least, known = work[:n], work[n : 2 * n], work[2 * n : 3 * n], work[3 * n : 4 * n]
    stack, ends = work[4 * n : 4 * n + 2 * STACK], work[4 * n + 2 * STACK :]
    start = 0
    while start < n - 2 and curve.arclength[start + 1] <= sweep.first:
        start += 1
    part = max(
        0.0, (sweep.first - curve.arclength[start]) / (curve.arclength[start + 1] - curve.arclength[start])
    )
    for j in range(start, n):
        p = node_point(curve, j, start, part)
        e = sub(p, (position[j, 0], position[j, 1], position[j, 2]))
        known[j] = distance[j] - math.sqrt(dot(e, e)) if distance[j] > -FAR else -FAR
        least[j] = FAR
    n_found, smallest = 0, FAR
    for k in range(n_obstacles):
        frame = frames[k]
        for j in range(start, n):
            h = max(
                curve.arclength[min(j + 1, n - 1)] - curve.arclength[j],
                curve.arclength[j] - curve.arclength[max(j - 1, start)],
            )
            thick = max(radius_after(sweep, max(j - 1, 0)), radius_after(sweep, j))
            need = thick + sweep.margin + h
            if known[j] > need:
                phi[j], slope[j] = known[j], 0.0
                continue
            p = node_point(curve, j, start, part)
            bound = FAR if known[j] < 0.0 else need + _RELAY * curve.arclength[n - 1]
            phi[j], normal, near = signed_distance(k, frame, p, bound, surfaces, stack)
            slope[j] = dot(normal, node_tangent(curve, j, start, part)) if near else 0.0
            least[j] = min(least[j], phi[j])
            if near and j > start:
                smallest = min(smallest, phi[j] - radius_after(sweep, j - 1))
            if near and j == start and slope[j] > 0.0 and phi[j] - radius_after(sweep, j) < sweep.margin:
                n_found = _note(
                    k,
                    max(sweep.first, curve.arclength[j]),
                    phi[j] - radius_after(sweep, j),
                    normal,
                    sweep.spacing,
                    found,
                    n_found,
                )
            if near and j == n - 1 and slope[j] < 0.0 and phi[j] - radius_after(sweep, j - 1) < sweep.margin:
                n_found = _note(
                    k,
                    curve.arclength[j],
                    phi[j] - radius_after(sweep, j - 1),
                    normal,
                    sweep.spacing,
                    found,
                    n_found,
                )
        for j in range(start, n - 1):
            low = part if j == start else 0.0
            ends[0], ends[1], ends[2], ends[3], ends[4] = phi[j], slope[j], 1.0, phi[j + 1], slope[j + 1]
            n_found, smallest = _search_interval(
                k, frame, curve, j, low, ends, sweep, smallest, surfaces, stack, found, n_found
            )
    for j in range(start, n):
        if least[j] < FAR:
            distance[j] = least[j]
            position[j, 0], position[j, 1], position[j, 2] = node_point(curve, j, start, part)
    return n_found, smallest


@kernel
def crosses(
    before: Curve,
    after: Curve,
    frames_before: Floats,
    frames: Floats,
    sweep: ProximityOptions,
    surfaces: Surfaces,
    stack: Numbers,
) -> tuple[int, float]:
    """The obstacle that a node went through on its straight way from `before` to `after`, seen from the
    obstacle, and the node's arclength; -1 where there is none.

    Both ends are outside, and the way between enters: through a body if the surfaces at both ends face
    different ways or the way runs deep; sliding along a convex surface is neither.
    """
    n, j = len(after.arclength), 0
    deep = 0.02 * after.arclength[n - 1]
    for i in range(n):
        s = after.arclength[i]
        if s <= sweep.first:
            continue
        q = point_at(after, min(i, n - 2), 1.0 if i == n - 1 else 0.0)
        j, part = interval_of(before, s, j)
        old = point_at(before, j, part)
        for k in range(len(frames)):
            p = carried(frames_before[k], frames[k], old)
            way = sub(q, p)
            length = math.sqrt(dot(way, way))
            if length < 1e-9:
                continue
            d, n_p, near = signed_distance(k, frames[k], p, length, surfaces, stack)
            if not near or d >= length or d < 0.0:
                continue
            direction = (way[0] / length, way[1] / length, way[2] / length)
            t, _ = ray_hit(k, frames[k], p, direction, length, surfaces, stack)
            if t >= length:
                continue
            end, n_q, _ = signed_distance(k, frames[k], q, FAR, surfaces, stack)
            if end < 0.0:
                continue
            if dot(n_p, n_q) < 0.2:
                return k, s
            middle = signed_distance(
                k, frames[k], axpy(0.5 * (t + length), direction, p), FAR, surfaces, stack
            )[0]
            if middle < -deep:
                return k, s
    return -1, 0.0


@kernel
def entered(
    k: int,
    before: Curve,
    after: Curve,
    s: float,
    frame_before: Floats,
    frame: Floats,
    surfaces: Surfaces,
    stack: Numbers,
) -> tuple[float, Vec]:
    """Signed distance of the centreline at s to the side of obstacle k by which it came in since `before`,
    and that side's normal; FAR where it came in by none. The nearest side of a thin plate may be the other
    one."""
    i, share = interval_of(before, s, 0)
    j, part = interval_of(after, s, 0)
    p, q = carried(frame_before, frame, point_at(before, i, share)), point_at(after, j, part)
    way = sub(q, p)
    length = math.sqrt(dot(way, way))
    nothing = (0.0, 0.0, 0.0)
    if length < 1e-9 or signed_distance(k, frame, q, FAR, surfaces, stack)[0] >= 0.0:
        return FAR, nothing
    if signed_distance(k, frame, p, FAR, surfaces, stack)[0] <= 0.0:
        return FAR, nothing
    t, n = ray_hit(k, frame, p, (way[0] / length, way[1] / length, way[2] / length), length, surfaces, stack)
    if t >= length or dot(way, n) >= 0.0:
        return FAR, nothing
    return dot(way, n) * (1.0 - t / length), n


@inline
def carried(before: Floats, after: Floats, p: Vec) -> Vec:
    """Where a world point is after it has moved with a frame."""
    x, y, z = p[0] - before[9], p[1] - before[10], p[2] - before[11]
    a = before[0] * x + before[3] * y + before[6] * z
    b = before[1] * x + before[4] * y + before[7] * z
    c = before[2] * x + before[5] * y + before[8] * z
    return (
        after[0] * a + after[1] * b + after[2] * c + after[9],
        after[3] * a + after[4] * b + after[5] * c + after[10],
        after[6] * a + after[7] * b + after[8] * c + after[11],
    )
