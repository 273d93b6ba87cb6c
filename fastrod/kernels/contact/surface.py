"""One obstacle of a scene, seen from the world: signed distance, walls of a corner, first hit."""

from __future__ import annotations

import math

from fastrod.types import Records, Surfaces

from ..jit import inline, kernel
from ..vec import Mat, Vec, dot, mul, mul_t, sub
from .bvh import FAR, Numbers, corner, facing_planes, first_hit, nearest_triangle, normal_of, signed_triangle
from .primitive import curvature_at, ray_primitive, signed_at

MOST_PLANES = 4
"""Walls that a point is given at once: three make a corner, one more is to spare."""


@inline
def rotation_of(frame: Numbers) -> Mat:
    """world_from_obstacle rotation; a frame is that, row by row, then the position."""
    return frame[0], frame[1], frame[2], frame[3], frame[4], frame[5], frame[6], frame[7], frame[8]


@inline
def to_obstacle(frame: Numbers, p: Vec) -> Vec:
    """R^T (p - o): the world point p in the obstacle's frame."""
    return mul_t(rotation_of(frame), (p[0] - frame[9], p[1] - frame[10], p[2] - frame[11]))


@inline
def _size(k: int, surfaces: Surfaces) -> Vec:
    row = surfaces.size[k]
    return row[0], row[1], row[2]


@kernel
def signed_distance(
    k: int, frame: Numbers, p: Vec, bound: float, surfaces: Surfaces, stack: Numbers
) -> tuple[float, Vec, bool]:
    """Signed distance of the world point p to obstacle k and its gradient, the outward normal, world.

    Beyond `bound` a lower bound of the distance, a zero normal and False.
    """
    local = to_obstacle(frame, p)
    nothing = (0.0, 0.0, 0.0)
    ball = surfaces.sphere[k]
    e = sub(local, (ball[0], ball[1], ball[2]))
    lower = math.sqrt(dot(e, e)) - ball[3]
    if lower > bound:
        return lower, nothing, False
    signed = max(surfaces.primitive[k, 0], surfaces.primitive[k, 2])
    if signed != 0:
        d, n = signed_at(signed, _size(k, surfaces), local)
        return d, mul(rotation_of(frame), n), True
    d, n, triangle = signed_triangle(local, bound, surfaces.root[k], surfaces, stack)
    if triangle < 0:
        return bound, nothing, False
    return d, mul(rotation_of(frame), n), True


@kernel
def walls(
    k: int,
    frame: Numbers,
    p: Vec,
    limit: float,
    nearest: float,
    surfaces: Surfaces,
    stack: Numbers,
    found: Records,
) -> int:
    """Faces of obstacle k around the world point p, nearer than `limit` (`facing_planes`), normals in the
    world; `nearest` is its distance."""
    if surfaces.primitive[k, 0] != 0:
        return 0
    n = facing_planes(to_obstacle(frame, p), limit, nearest, surfaces.root[k], surfaces, stack, found)
    for j in range(n):
        normal = found[j].normal
        normal[0], normal[1], normal[2] = mul(rotation_of(frame), normal_of(found[j]))
    return n


@kernel
def ray_hit(
    k: int, frame: Numbers, p: Vec, direction: Vec, longest: float, surfaces: Surfaces, stack: Numbers
) -> tuple[float, Vec]:
    """Length to obstacle k along a unit direction, up to `longest`, and the outward normal there; FAR where
    it is not met."""
    local, along = to_obstacle(frame, p), mul_t(rotation_of(frame), direction)
    signed = surfaces.primitive[k, 0]
    if signed == 0:
        t, triangle = first_hit(local, along, longest, surfaces.root[k], surfaces, stack)
        if triangle < 0:
            return FAR, (0.0, 0.0, 0.0)
        row = surfaces.normal[triangle, 0]
        return t, mul(rotation_of(frame), (row[0], row[1], row[2]))
    t = ray_primitive(signed, _size(k, surfaces), local, along, longest)
    if t >= FAR:
        return FAR, (0.0, 0.0, 0.0)
    at = (local[0] + t * along[0], local[1] + t * along[1], local[2] + t * along[2])
    return t, mul(rotation_of(frame), signed_at(signed, _size(k, surfaces), at)[1])


@kernel
def surface_curvature(
    k: int, frame: Numbers, p: Vec, d: float, surfaces: Surfaces, stack: Numbers
) -> tuple[float, float, Vec]:
    """Principal curvatures of the distance from obstacle k at the world point p, outside and no farther than
    d from it: rotation of the normal per length as p moves across the unit direction that is returned, and
    along it [1/m]. (The second derivative of the distance.)"""
    local = to_obstacle(frame, p)
    first, second, along = 0.0, 0.0, (0.0, 0.0, 1.0)
    if surfaces.primitive[k, 1] != 0:
        first, second, along = curvature_at(surfaces.primitive[k, 1], _size(k, surfaces), local)
    else:
        square, _, t, feature = nearest_triangle(local, d + 1e-8, surfaces.root[k], surfaces, stack)
        if feature > 0 and square > 0.0:
            first = 1.0 / math.sqrt(square)
            second = first
            if feature < 4:
                a, b = corner(surfaces, t, feature - 1), corner(surfaces, t, feature % 3)
                edge = sub(b, a)
                length = math.sqrt(dot(edge, edge))
                second, along = 0.0, (edge[0] / length, edge[1] / length, edge[2] / length)
    return first, second, mul(rotation_of(frame), along)
