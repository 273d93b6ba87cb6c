"""Nearest points of a rod and the obstacles: local minima of the signed distance along its centreline.

phi(s) is the signed distance of the centreline, with slope n . r'. It changes by at most 1 per metre, so that
what was measured once rules out whole stretches, along the rod and over time (`Clearance`). Where phi may
fall below the rod's radius and the margin, its minimum in an interval is found on the slope; every minimum is
a candidate for contact (`CANDIDATE`).

An interval can hold several minima. It is halved until no half of it can hide a dip below the rod's radius
that is deeper than `UNSEEN` (`_may_hide`), so that the whole rod is searched and not its nodes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fastrod.types import SAMPLE, Floats, Records, SearchWork, Surfaces

from ..jit import inline, kernel
from ..vec import Vec, dot, sub
from .bvh import FAR, STACK, Record
from .centreline import Curve, point_at, tangent_at
from .surface import signed_distance

UNSEEN = 1e-5
"""A dip below the rod's radius that is shallower may stay unseen [m]: a tenth of the depth at which a rest is
none."""
_ITERATIONS = 40
# |dr/ds| of the interpolated curve is below it: 1 at the nodes, and to fourth order between them
_STEEP = 1.01
_DEEPEST = 20  # halvings of an interval: to 1e-6 of it, far below UNSEEN
# of an interval: no finer where the rod is deep already, for there all that matters is known
_COARSE = 1.0 / 16.0
_FLAT = 1e-9  # a slope below it is none
# of the rod's length: how far beyond what is needed a first search goes, so that later ones are spared
_RELAY = 0.25


class ProximityOptions(NamedTuple):
    """Options of a search."""

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
    """Not every dip below the rod's radius is wanted, but the smallest gap, wherever it is."""


class ProximitySearch(NamedTuple):
    """One robot among the obstacles."""

    curve: Curve
    options: ProximityOptions
    surfaces: Surfaces
    frames: Floats
    """(n_obstacles, 12)"""
    distance: Floats
    measured_at: Floats
    """The robot's rows of `Clearance`: (n_points,) and (n_points, 3), to be kept up to date."""
    work: SearchWork
    found: Records
    """(n_most,) of `CANDIDATE`, to be written."""


def search_work(n_threads: int, n_points: int) -> SearchWork:
    """Room for the searches of so many threads."""
    known, least, phi, slope = (np.empty((n_threads, n_points)) for _ in range(4))
    return SearchWork(
        known,
        least,
        phi,
        slope,
        np.empty((n_threads, _DEEPEST + 2), SAMPLE),
        np.empty((n_threads, 2 * STACK)),
    )


@inline
def task_search_work(work: SearchWork, i: int) -> SearchWork:
    """The room of one thread."""
    return SearchWork(work.known[i], work.least[i], work.phi[i], work.slope[i], work.sample[i], work.stack[i])


@inline
def _node_place(curve: Curve, j: int, start: int, fraction: float) -> tuple[int, float]:
    """Interval of node j and the fraction of it; for the first one those where contact begins."""
    return (j, fraction if j == start else 0.0) if j < len(curve.arclength) - 1 else (j - 1, 1.0)


@inline
def node_point(curve: Curve, j: int, start: int, fraction: float) -> Vec:
    """Node j; for the first one the point where contact begins."""
    return point_at(curve, *_node_place(curve, j, start, fraction))


@inline
def radius_after(options: ProximityOptions, j: int) -> float:
    """Return the radius of the interval after node j."""
    return float(options.radius[min(j // options.n_steps, len(options.radius) - 1)])


@inline
def _put(sample: Record, fraction: float, distance: float, slope: float) -> None:
    sample.fraction, sample.distance, sample.slope = fraction, distance, slope


@kernel
def minimum(
    search: ProximitySearch,
    k: int,
    j: int,
    low: float,
    high: float,
    slope_low: float,
    slope_high: float,
    phi_high: float,
) -> tuple[float, float, Vec]:
    """Fraction, signed distance and normal of the minimum in the interval after node j: phi falls at `low`,
    and at `high` it rises or is higher. Secants on the slope where both ends have one, an end that stays
    counting by half (Dowell and Jarratt 1971), else bisection."""
    curve, frame, stack = search.curve, search.frames[k], search.work.stack
    fraction, d, n, stays = high, phi_high, (0.0, 0.0, 1.0), 0
    for _ in range(_ITERATIONS):
        split = slope_low / (slope_low - slope_high) if slope_low < 0.0 < slope_high else 0.5
        fraction = low + min(max(split, 0.01), 0.99) * (high - low)
        d, n, _ = signed_distance(k, frame, point_at(curve, j, fraction), FAR, search.surfaces, stack)
        slope = dot(n, tangent_at(curve, j, fraction))
        if abs(slope) < _FLAT or high - low < 1e-7:
            break
        if slope < 0.0 and d <= phi_high:
            low, slope_low, slope_high = fraction, slope, slope_high * (0.5 if stays > 0 else 1.0)
            stays = 1
        else:
            high, slope_high, phi_high = fraction, slope, max(d, phi_high) if slope > 0.0 else d
            slope_low, stays = slope_low * (0.5 if stays < 0 else 1.0), -1
    return fraction, d, n


@kernel
def _note(search: ProximitySearch, k: int, s: float, gap: float, n: Vec, n_found: int) -> int:
    """Write a candidate, in place of a near or (where full) of the widest one that is wider; returns how many
    there are."""
    found = search.found
    at, widest = n_found, -FAR
    for c in range(n_found):
        if found[c].obstacle == k and abs(found[c].arclength - s) < search.options.spacing:
            if found[c].gap <= gap:
                return n_found
            at, widest = c, FAR
            break
        if n_found == len(found) and found[c].gap > widest:
            at, widest = c, found[c].gap
    if at < n_found and widest <= gap:
        return n_found
    candidate = found[at]
    candidate.obstacle, candidate.arclength, candidate.gap = k, s, gap
    candidate.normal[0], candidate.normal[1], candidate.normal[2] = n
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


@kernel
def _may_dip(
    f0: float, f1: float, g0: float, g1: float, length: float, curvature: float, level: float
) -> bool:
    """The same beside a convex obstacle, by the slopes g0 and g1 at the ends: along a straight line its
    distance is convex, so that here phi'' >= -|r''|, and phi lies above both tangents less so much."""
    bend = curvature * length
    opens = g1 - g0 + bend
    if opens <= 0.0:
        return False
    s = min(max((f0 - f1 + (g1 + 0.5 * bend) * length) / opens, 0.0), length)
    return f0 + (g0 - 0.5 * curvature * s) * s < min(level, min(f0, f1) - UNSEEN)


@inline
def _curvature(curve: Curve, j: int) -> float:
    """Curvature of the centreline at node j [1/m]."""
    u = curve.curvature[j]
    return math.sqrt(u[0] * u[0] + u[1] * u[1])


@kernel
def _search_interval(
    search: ProximitySearch, k: int, j: int, smallest: float, n_found: int
) -> tuple[int, float]:
    """Minima of the interval after node j; returns how many candidates there are, and the smallest gap.

    The first samples are the ends of the interval; there is room for `_DEEPEST` more of them.
    """
    curve, options, sample = search.curve, search.options, search.work.sample
    frame, surfaces, stack = search.frames[k], search.surfaces, search.work.stack
    h = curve.arclength[j + 1] - curve.arclength[j]
    rho, curvature = radius_after(options, j), 1.1 * max(_curvature(curve, j), _curvature(curve, j + 1))
    x0, f0, g0, m = sample[0].fraction, sample[0].distance, sample[0].slope, 1
    smallest = min(smallest, min(f0, sample[1].distance) - rho)
    while m > 0:
        x1, f1, g1 = sample[m].fraction, sample[m].distance, sample[m].slope
        length = (x1 - x0) * h
        least = 0.5 * (f0 + f1 - _STEEP * length) - rho
        if least <= options.margin:
            deep = min(f0, f1) < rho - 2.0 * UNSEEN
            fine = length > 2.0 * UNSEEN and m <= _DEEPEST and (x1 - x0 > _COARSE or not deep)
            level = rho + (smallest if options.nearest else 0.0) - UNSEEN
            hides = fine and least < level - rho and _may_hide(f0, f1, length, curvature, level)
            # (a node that was not measured has no slope)
            if hides and surfaces.convex[k] and g0 != 0.0 and g1 != 0.0:
                hides = _may_dip(f0, f1, g0, g1, length, curvature, level)
            if hides:
                x = 0.5 * (x0 + x1)
                phi, normal, _ = signed_distance(k, frame, point_at(curve, j, x), FAR, surfaces, stack)
                _put(sample[m + 1], x, phi, dot(normal, tangent_at(curve, j, x)))
                smallest = min(smallest, phi - rho)
                m += 1
                continue
            falls, rises = g0 < _FLAT, g1 > -_FLAT
            place, d, normal = -1.0, FAR, (0.0, 0.0, 1.0)
            if falls and rises and (abs(g0) < _FLAT or abs(g1) < _FLAT):
                place = x0 if f0 <= f1 else x1  # an end is the minimum, or the rod lies along the surface
                d, normal, _ = signed_distance(k, frame, point_at(curve, j, place), FAR, surfaces, stack)
            elif (falls and (rises or f1 > f0)) or (rises and f0 > f1):
                place, d, normal = minimum(search, k, j, x0, x1, g0, g1, max(f0, f1))
            smallest = min(smallest, d - rho)
            if d - rho < options.margin:
                s = max(options.first, curve.arclength[j] + place * h)
                n_found = _note(search, k, s, d - rho, normal, n_found)
        x0, f0, g0, m = x1, f1, g1, m - 1
    return n_found, smallest


@kernel
def _search_nodes(
    search: ProximitySearch, k: int, start: int, smallest: float, n_found: int
) -> tuple[int, float]:
    """Signed distance of obstacle k at each node, or a lower bound where that will do; the ends of the rod
    are candidates if the distance falls toward them. Returns as `_search_interval`."""
    curve, options, work = search.curve, search.options, search.work
    n, fraction = len(curve.arclength), _fraction_of_first(search, start)
    for j in range(start, n):
        h = max(
            curve.arclength[min(j + 1, n - 1)] - curve.arclength[j],
            curve.arclength[j] - curve.arclength[max(j - 1, start)],
        )
        thick = max(radius_after(options, max(j - 1, 0)), radius_after(options, j))
        need = thick + options.margin + h
        if work.known[j] > need:
            work.phi[j], work.slope[j] = work.known[j], 0.0
            continue
        p = node_point(curve, j, start, fraction)
        bound = FAR if work.known[j] < 0.0 else need + _RELAY * curve.arclength[n - 1]
        phi, normal, near = signed_distance(k, search.frames[k], p, bound, search.surfaces, work.stack)
        slope = dot(normal, tangent_at(curve, *_node_place(curve, j, start, fraction))) if near else 0.0
        work.phi[j], work.slope[j], work.least[j] = phi, slope, min(work.least[j], phi)
        if not near:
            continue
        if j > start:
            smallest = min(smallest, phi - radius_after(options, j - 1))
        gap = phi - radius_after(options, j if j == start else j - 1)
        rises, falls = j == start and slope > 0.0, j == n - 1 and slope < 0.0
        if (rises or falls) and gap < options.margin:
            n_found = _note(search, k, max(options.first, curve.arclength[j]), gap, normal, n_found)
    return n_found, smallest


@inline
def _fraction_of_first(search: ProximitySearch, start: int) -> float:
    """Return the fraction, of the interval after node `start`, at which contact begins."""
    s, first = search.curve.arclength, search.options.first
    return float(max(0.0, (first - s[start]) / (s[start + 1] - s[start])))


@kernel
def search_obstacles(search: ProximitySearch) -> tuple[int, float]:
    """Number of candidates, written to `search.found`, and the smallest gap (a lower bound where it is beyond
    the margin)."""
    curve, work, options = search.curve, search.work, search.options
    distance, position, n = search.distance, search.measured_at, len(curve.arclength)
    start = 0
    while start < n - 2 and curve.arclength[start + 1] <= options.first:
        start += 1
    fraction = _fraction_of_first(search, start)
    for j in range(start, n):
        p = node_point(curve, j, start, fraction)
        e = sub(p, (position[j, 0], position[j, 1], position[j, 2]))
        work.known[j] = distance[j] - math.sqrt(dot(e, e)) if distance[j] > -FAR else -FAR
        work.least[j] = FAR
    n_found, smallest = 0, FAR
    for k in range(len(search.frames)):
        n_found, smallest = _search_nodes(search, k, start, smallest, n_found)
        for j in range(start, n - 1):
            _put(work.sample[0], fraction if j == start else 0.0, work.phi[j], work.slope[j])
            _put(work.sample[1], 1.0, work.phi[j + 1], work.slope[j + 1])
            n_found, smallest = _search_interval(search, k, j, smallest, n_found)
    for j in range(start, n):
        if work.least[j] < FAR:
            distance[j] = work.least[j]
            position[j, 0], position[j, 1], position[j, 2] = node_point(curve, j, start, fraction)
    return n_found, smallest
