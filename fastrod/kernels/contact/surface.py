"""One obstacle of a scene, seen from the world: signed distance, walls of a corner, first hit."""

from __future__ import annotations

import math

from fastrod.types import Records, Surfaces

from ..jit import inline, kernel
from ..vec import Mat, Vec, dot, mul, mul_t, sub
from .bvh import FAR, Numbers, corner, facing_planes, first_hit, nearest_triangle, normal_of, signed_triangle
from .primitive import BOX, CAPSULE, MESH, PLANE, SPHERE, ray_primitive, signed_primitive

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
    if surfaces.kind[k] != MESH:
        d, n = signed_primitive(surfaces.kind[k], _size(k, surfaces), local)
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
    if surfaces.kind[k] != MESH:
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
    if surfaces.kind[k] == MESH:
        t, triangle = first_hit(local, along, longest, surfaces.root[k], surfaces, stack)
        if triangle < 0:
            return FAR, (0.0, 0.0, 0.0)
        row = surfaces.normal[triangle, 0]
        return t, mul(rotation_of(frame), (row[0], row[1], row[2]))
    t = ray_primitive(surfaces.kind[k], _size(k, surfaces), local, along, longest)
    if t >= FAR:
        return FAR, (0.0, 0.0, 0.0)
    at = (local[0] + t * along[0], local[1] + t * along[1], local[2] + t * along[2])
    return t, mul(rotation_of(frame), signed_primitive(surfaces.kind[k], _size(k, surfaces), at)[1])


@kernel
def surface_curvature(
    k: int, frame: Numbers, p: Vec, surfaces: Surfaces, stack: Numbers
) -> tuple[float, float, Vec]:
    """Principal curvatures of the distance from obstacle k at the world point p, outside: rotation of the
    normal per length as p moves across the unit direction that is returned, and along it [1/m]. (The second
    derivative of the distance.)"""
    local = to_obstacle(frame, p)
    kind, size = surfaces.kind[k], _size(k, surfaces)
    first, second, along = 0.0, 0.0, (0.0, 0.0, 1.0)
    if kind == MESH:
        square, _, t, feature = nearest_triangle(local, FAR, surfaces.root[k], surfaces, stack)
        if feature > 0 and square > 0.0:
            first = 1.0 / math.sqrt(square)
            second = first
            if feature < 4:
                a, b = corner(surfaces, t, feature - 1), corner(surfaces, t, feature % 3)
                edge = sub(b, a)
                length = math.sqrt(dot(edge, edge))
                second, along = 0.0, (edge[0] / length, edge[1] / length, edge[2] / length)
    elif kind == BOX:
        x, y, z = abs(local[0]) - 0.5 * size[0], abs(local[1]) - 0.5 * size[1], abs(local[2]) - 0.5 * size[2]
        beyond = (max(x, 0.0), max(y, 0.0), max(z, 0.0))
        sides = (1.0 if x > 0.0 else 0.0) + (1.0 if y > 0.0 else 0.0) + (1.0 if z > 0.0 else 0.0)
        if sides > 1.5:
            first = 1.0 / math.sqrt(dot(beyond, beyond))
            second = first if sides > 2.5 else 0.0
            along = (
                (0.0 if x > 0.0 else 1.0, 0.0 if y > 0.0 else 1.0, 0.0 if z > 0.0 else 1.0)
                if sides < 2.5
                else along
            )
    elif kind == SPHERE:
        first = 1.0 / max(math.sqrt(dot(local, local)), 1e-12)
        second = first
    elif kind != PLANE:
        radial = max(math.sqrt(local[0] * local[0] + local[1] * local[1]), 1e-12)
        over = abs(local[2]) - 0.5 * size[1]
        if kind == CAPSULE:
            first = 1.0 / max(math.sqrt(radial * radial + max(over, 0.0) ** 2), 1e-12)
            second = first if over > 0.0 else 0.0
        elif radial > size[0] and over > 0.0:  # the rim
            d = math.sqrt((radial - size[0]) ** 2 + over * over)
            first, second = 1.0 / d, (radial - size[0]) / d / radial
            along = (-local[1] / radial, local[0] / radial, 0.0)
        elif over <= 0.0 and radial - size[0] >= over:
            first = 1.0 / radial
    return first, second, mul(rotation_of(frame), along)
