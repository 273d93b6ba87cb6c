"""Where one rod comes nearest to the obstacles: local minima of the signed distance along its centreline.

phi(s) is the signed distance of the centreline, with slope n . r'. It changes by at most 1 per metre, so that what was
measured once rules out whole stretches, along the rod and over time (`Clearance`). Where phi may fall below the rod's
radius and the margin, its minimum in an interval is found on the slope; every minimum is a candidate for contact:
obstacle, arclength, gap and normal.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fastrod.types import Floats, Surfaces

from .bvh import FAR, Numbers
from .centreline import Curve, interval_of, point_at, tangent_at
from .jit import inline, kernel
from .surface import ray_hit, signed_distance
from .vec import Vec, axpy, dot, sub

CANDIDATE = 6  # numbers of one: obstacle, arclength, gap, normal
_ITERATIONS = 40
_FLAT = 1e-9  # a slope below it is none
_RELAY = 0.25  # of the rod's length: how far beyond what is needed a first look goes, so that later ones are spared


class Sweep(NamedTuple):
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


@inline
def node_point(curve: Curve, j: int, start: int, part: float) -> Vec:
    """Node j; for the first one the point where contact begins."""
    return point_at(curve, j, part if j == start else 0.0) if j < len(curve.arclength) - 1 else point_at(curve, j - 1, 1.0)


@inline
def node_tangent(curve: Curve, j: int, start: int, part: float) -> Vec:
    """dr/ds at node j; for the first one at the point where contact begins."""
    return tangent_at(curve, j, part if j == start else 0.0) if j < len(curve.arclength) - 1 else tangent_at(curve, j - 1, 1.0)


@inline
def radius_after(sweep: Sweep, j: int) -> float:
    """Of the interval after node j."""
    return float(sweep.radius[min(j // sweep.n_steps, len(sweep.radius) - 1)])


@kernel
def minimum(
    k: int, frame: Floats, curve: Curve, j: int, low: float, high: float, phi_high: float, surfaces: Surfaces, stack: Numbers
) -> tuple[float, float, Vec]:
    """Fraction, signed distance and normal of the minimum in the interval after node j: phi falls at `low`, and at `high`
    it rises or is higher. Bisection on the slope, with a secant once both ends have one."""
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
    """Write a candidate, in place of a near or (where full) of the widest one that is wider; returns how many there are."""
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
def search_obstacles(
    curve: Curve, sweep: Sweep, surfaces: Surfaces, frames: Floats, distance: Floats, position: Floats, work: Numbers, found: Floats
) -> tuple[int, float]:
    """Candidates of one robot, written to `found` (n_most, CANDIDATE), and the smallest gap (a lower bound where it is
    beyond the margin).

    `distance` (n_points,) and `position` (n_points, 3) are the robot's rows of `Clearance`, kept up to date; `work` holds
    4 n_points + 2 STACK numbers.
    """
    n, n_obstacles = len(curve.arclength), len(frames)
    phi, slope, least, known = work[:n], work[n : 2 * n], work[2 * n : 3 * n], work[3 * n : 4 * n]
    stack = work[4 * n :]
    start = 0
    while start < n - 2 and curve.arclength[start + 1] <= sweep.first:
        start += 1
    part = max(0.0, (sweep.first - curve.arclength[start]) / (curve.arclength[start + 1] - curve.arclength[start]))
    for j in range(start, n):
        p = node_point(curve, j, start, part)
        e = sub(p, (position[j, 0], position[j, 1], position[j, 2]))
        known[j] = distance[j] - math.sqrt(dot(e, e)) if distance[j] > -FAR else -FAR
        least[j] = FAR
    n_found, smallest = 0, FAR
    for k in range(n_obstacles):
        frame = frames[k]
        for j in range(start, n):
            h = max(curve.arclength[min(j + 1, n - 1)] - curve.arclength[j], curve.arclength[j] - curve.arclength[max(j - 1, start)])
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
            if near and j == start and slope[j] > 0.0 and phi[j] - radius_after(sweep, j) < sweep.margin:
                n_found = _note(
                    k, max(sweep.first, curve.arclength[j]), phi[j] - radius_after(sweep, j), normal, sweep.spacing, found, n_found
                )
            if near and j == n - 1 and slope[j] < 0.0 and phi[j] - radius_after(sweep, j - 1) < sweep.margin:
                n_found = _note(k, curve.arclength[j], phi[j] - radius_after(sweep, j - 1), normal, sweep.spacing, found, n_found)
        for j in range(start, n - 1):
            low = part if j == start else 0.0
            rho = radius_after(sweep, j)
            h = curve.arclength[j + 1] - curve.arclength[j]
            smallest = min(smallest, min(phi[j], phi[j + 1]) - rho)
            if 0.5 * (phi[j] + phi[j + 1] - h) - rho > sweep.margin:
                continue
            falls, rises = slope[j] < _FLAT, slope[j + 1] > -_FLAT
            if falls and rises and (abs(slope[j]) < _FLAT or abs(slope[j + 1]) < _FLAT):
                at = j if phi[j] <= phi[j + 1] else j + 1  # a node is the minimum, or the rod lies along the surface
                d, normal, near = signed_distance(k, frame, node_point(curve, at, start, part), FAR, surfaces, stack)
                where = curve.arclength[at] if at > start else max(sweep.first, curve.arclength[at])
            elif (falls and (rises or phi[j + 1] > phi[j])) or (rises and phi[j] > phi[j + 1]):
                place, d, normal = minimum(k, frame, curve, j, low, 1.0, max(phi[j], phi[j + 1]), surfaces, stack)
                where = curve.arclength[j] + place * h
            else:
                continue
            smallest = min(smallest, d - rho)
            if d - rho < sweep.margin:
                n_found = _note(k, where, d - rho, normal, sweep.spacing, found, n_found)
    for j in range(start, n):
        if least[j] < FAR:
            distance[j] = least[j]
            position[j, 0], position[j, 1], position[j, 2] = node_point(curve, j, start, part)
    return n_found, smallest


@kernel
def crosses(before: Curve, after: Curve, frames_before: Floats, frames: Floats, sweep: Sweep, surfaces: Surfaces, stack: Numbers) -> bool:
    """A node went through an obstacle on its straight way from `before` to `after`, seen from the obstacle.

    Both ends are outside, and the way between enters: through a body if the surfaces at both ends face different ways or
    the way runs deep; sliding along a convex surface is neither.
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
                return True
            middle = signed_distance(k, frames[k], axpy(0.5 * (t + length), direction, p), FAR, surfaces, stack)[0]
            if middle < -deep:
                return True
    return False


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
