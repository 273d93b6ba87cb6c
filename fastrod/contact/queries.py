"""Queries of the last state: clearance, also on the way to it, overlap, and rays of a distance sensor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fastrod.checks import Bound, check_number
from fastrod.contact.engine import Engine, motion_of, unknown_clearance
from fastrod.contact.frames import between, frames_of
from fastrod.errors import InputError, refuse_masked
from fastrod.kernels.contact.candidates import MOST_FOUND
from fastrod.kernels.contact.proximity import search_work
from fastrod.kernels.contact_batch import cast_rays, search_gaps
from fastrod.types import CANDIDATE, Flags, Floats, Ints, Records, RodShape

_EVERYTHING = 1e6  # of the rod's length: a margin within which all is near
_MOST_SPLITS = 400  # of the way between two states: a bound on time


class Hits(NamedTuple):
    """Hits of rays on obstacles."""

    distance: Floats
    """(n_robots, n_rays) from the origin to the nearest surface; inf where none is met [m]."""
    obstacle: Ints
    """(n_robots, n_rays) index of the obstacle; -1 where none is met."""
    normal: Floats
    """(n_robots, n_rays, 3) outward normal there, world; nan where none is met."""


def clearance(engine: Engine, shape: RodShape, name: str | None = None) -> Floats:
    """(n_robots,) smallest gap between a robot's surface, mounting excepted, and the obstacle of this name,
    or all obstacles and, where they may touch, rods [m]. Negative by the depth where they overlap; inf where
    there is nothing; nan where there is no shape.
    """
    only = None if name is None else engine.scene.index(name)
    return _search(engine, shape, engine.poses, only=only)[0]


def overlap(engine: Engine, shape: RodShape, poses: Floats) -> Floats:
    """(n_robots, n_obstacles, 3) shortest displacement of each obstacle, at these `poses`, out of each robot,
    mounting excepted, world [m]; 0 where they are apart, or where there is no shape."""
    _, found, n_found = _search(engine, shape, poses, margin=0.0)
    there = np.flatnonzero(np.isfinite(shape.position).all((1, 2)))
    out = np.zeros((len(shape.position), poses.shape[1], 3))
    for i, candidates, n in zip(there, found, n_found, strict=True):
        for one in np.sort(candidates[:n], order="gap")[::-1]:  # the deepest of each obstacle last
            out[i, one["obstacle"]] = min(one["gap"], 0.0) * one["normal"]
    return out


def _search(
    engine: Engine,
    shape: RodShape,
    poses: Floats,
    *,
    only: int | None = None,
    rows: Flags | None = None,
    margin: float = _EVERYTHING,
) -> tuple[Floats, Records, Ints]:
    """Smallest gap of each robot (n_robots,), nan but for `rows`, where they are given; and of those that
    have a shape the candidates for contact within `margin` of the rod's length, and how many they are."""
    n, n_points = shape.arclength.shape
    surfaces, which = engine.surfaces, slice(None) if only is None else [only]
    surfaces = surfaces._replace(
        primitive=surfaces.primitive[which],
        size=surfaces.size[which],
        sphere=surfaces.sphere[which],
        friction=surfaces.friction[which],
        compliance=surfaces.compliance[which],
        body=surfaces.body[which],
        mobility=surfaces.mobility[which],
        center=surfaces.center[which],
        ahead=surfaces.ahead[which],
        root=surfaces.root[which],
    )
    frames = np.ascontiguousarray(frames_of(poses)[:, which])
    nobody = np.zeros(n, bool)
    known = unknown_clearance(n, n_points)
    motion = motion_of(
        (frames, frames, frames),
        (shape, shape, shape),
        known,
        tracked=nobody,
        slides=nobody,
        tolerance=1e-9,
        margin=margin,
    )
    finite = np.isfinite(shape.position).all((1, 2))
    some = np.flatnonzero(finite if rows is None else finite & rows)
    found, n_found = np.empty((len(some), MOST_FOUND), CANDIDATE), np.zeros(len(some), np.int64)
    if len(surfaces.primitive):
        search_gaps(1, some, engine.rods, surfaces, motion, found, n_found, search_work(1, n_points))
    if only is None and engine.rods_meet:
        engine.lower_gaps(some, motion)
    gap = np.full(n, np.nan)
    gap[some] = known.gap[some]
    return gap, found, n_found


def swept_clearance(
    engine: Engine,
    before: RodShape,
    poses_before: Floats,
    after: RodShape,
    tolerance: float,
    rows: Flags | None = None,
) -> Floats:
    """(n_robots,) smallest gap on the way from one shape to another, to `tolerance` [m]: robots and obstacles
    move in straight lines at even speed. The gap changes by no more than they move, so intervals that cannot
    hold the minimum are left out. nan but for
    `rows`, where they are given."""
    n = len(after.arclength)
    moved = np.linalg.norm(after.position - before.position, axis=2).max(1) + _obstacles_move(
        engine, poses_before
    )

    def gap_at(t: Floats, some: Flags) -> Floats:
        fraction = t[:, None, None]
        tangent = (1.0 - fraction[..., None]) * before.rotation + fraction[..., None] * after.rotation
        there = after._replace(
            position=(1.0 - fraction) * before.position + fraction * after.position, rotation=tangent
        )
        gap = _search(engine, there, between(poses_before, engine.poses, t), rows=some)[0]
        return np.where(np.isnan(gap), np.inf, gap)

    wanted = np.isfinite(after.position).all((1, 2)) & (np.ones(n, bool) if rows is None else rows)
    each = np.arange(n)
    times = np.tile([0.0, 1.0], (n, 1))
    gaps = np.stack([gap_at(np.zeros(n), wanted), gap_at(np.ones(n), wanted)], axis=1)
    for _ in range(_MOST_SPLITS):
        bound = 0.5 * (gaps[:, 1:] + gaps[:, :-1] - np.nan_to_num(moved)[:, None] * np.diff(times, axis=1))
        worst = bound.argmin(1)
        still = wanted & (bound[each, worst] < gaps.min(1) - tolerance)
        if not still.any():
            break
        middle = 0.5 * (times[each, worst] + times[each, worst + 1])
        times, gaps = np.column_stack([times, middle]), np.column_stack([gaps, gap_at(middle, still)])
        order = np.argsort(times, axis=1)
        times, gaps = np.take_along_axis(times, order, 1), np.take_along_axis(gaps, order, 1)
    return np.where(wanted, gaps.min(1), np.nan)


def _obstacles_move(engine: Engine, poses_before: Floats) -> Floats:
    """(1 or n,) a bound of how far a point of an obstacle near the rods has moved; for a plane, of one within
    ten lengths."""
    ball = engine.surfaces.sphere.copy()
    ball[~np.isfinite(ball[:, 3]), 3] = 10.0 * float(engine.rods.length.max())
    shift = np.linalg.norm(engine.poses[..., :3] - poses_before[..., :3], axis=-1)
    rotation = np.linalg.norm(np.abs(engine.poses[..., 3:]) - np.abs(poses_before[..., 3:]), axis=-1)
    return np.asarray(
        (shift + 2.0 * rotation * (np.linalg.norm(ball[:, :3], axis=1) + ball[:, 3])).max(-1, initial=0.0)
    )


def ray_cast(engine: Engine, origin: ArrayLike, direction: ArrayLike, longest: float) -> Hits:
    """Rays (n_robots, n_rays, 3) or (n_rays, 3), world, against the obstacles where they are now; directions
    need not be unit."""
    n = len(engine.tracked)
    refuse_masked("origin", origin)
    refuse_masked("direction", direction)
    try:
        o, v = (np.asarray(a, dtype=np.float64) for a in (origin, direction))
        o, v = (np.broadcast_to(a, (n, a.shape[-2] if a.ndim > 1 else 1, 3)) for a in (o, v))
        o, v = np.broadcast_arrays(o, v)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"rays have origins of shape {np.shape(origin)} and directions of shape {np.shape(direction)}; "
            f"give (n_rays, 3) or ({n}, n_rays, 3) of both."
        ) from error
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    if not (np.isfinite(o).all() and np.isfinite(v).all() and (length > 0.0).all()):
        raise InputError("a ray has an origin or direction that is not finite, or a direction of length 0.")
    check_number("longest", longest, Bound(above=0.0, unit="m", infinite=True))
    shape = o.shape[:2]
    hits = Hits(np.full(shape, np.inf), np.full(shape, -1), np.full((*shape, 3), np.nan))
    cast_rays(
        np.ascontiguousarray(o),
        np.ascontiguousarray(v / length),
        float(min(longest, 1e12)),
        engine.surfaces,
        frames_of(engine.poses),
        *hits,
    )
    return hits
