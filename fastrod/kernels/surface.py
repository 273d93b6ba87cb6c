"""One obstacle of a scene, seen from the world: signed distance, walls of a corner, first hit."""

from __future__ import annotations

import math

from fastrod.kernels.bvh import FAR, Numbers, facing_planes, first_hit, signed_triangle
from fastrod.kernels.jit import inline, kernel
from fastrod.kernels.primitive import MESH, ray_primitive, signed_primitive
from fastrod.kernels.vec import Mat, Vec, dot, mul, mul_t, sub
from fastrod.types import Surfaces

MOST_PLANES = 4


@inline
def turn_of(frame: Numbers) -> Mat:
    """world_from_obstacle rotation; a frame is that, row by row, then the position."""
    return frame[0], frame[1], frame[2], frame[3], frame[4], frame[5], frame[6], frame[7], frame[8]


@inline
def to_obstacle(frame: Numbers, p: Vec) -> Vec:
    return mul_t(turn_of(frame), (p[0] - frame[9], p[1] - frame[10], p[2] - frame[11]))


@inline
def to_world(frame: Numbers, p: Vec) -> Vec:
    q = mul(turn_of(frame), p)
    return q[0] + frame[9], q[1] + frame[10], q[2] + frame[11]


@inline
def _size(k: int, surfaces: Surfaces) -> Vec:
    row = surfaces.size[k]
    return row[0], row[1], row[2]


@kernel
def signed_distance(k: int, frame: Numbers, p: Vec, bound: float, surfaces: Surfaces, stack: Numbers) -> tuple[float, Vec, bool]:
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
        return d, mul(turn_of(frame), n), True
    d, n, triangle = signed_triangle(local, bound, surfaces.root[k], surfaces, stack)
    if triangle < 0:
        return bound, nothing, False
    return d, mul(turn_of(frame), n), True


@kernel
def walls(k: int, frame: Numbers, p: Vec, reach: float, surfaces: Surfaces, stack: Numbers, found: Numbers) -> int:
    """Faces of obstacle k around the world point p, nearer than `reach` (`facing_planes`), normals in the world."""
    if surfaces.kind[k] != MESH:
        return 0
    n = facing_planes(to_obstacle(frame, p), reach, surfaces.root[k], surfaces, stack, found, MOST_PLANES)
    for j in range(n):
        normal = mul(turn_of(frame), (found[5 * j + 1], found[5 * j + 2], found[5 * j + 3]))
        found[5 * j + 1], found[5 * j + 2], found[5 * j + 3] = normal
    return n


@kernel
def ray_hit(k: int, frame: Numbers, p: Vec, direction: Vec, longest: float, surfaces: Surfaces, stack: Numbers) -> tuple[float, Vec]:
    """Length to obstacle k along a unit direction, up to `longest`, and the outward normal there; FAR where it is not met."""
    local, along = to_obstacle(frame, p), mul_t(turn_of(frame), direction)
    if surfaces.kind[k] == MESH:
        t, triangle = first_hit(local, along, longest, surfaces.root[k], surfaces, stack)
        if triangle < 0:
            return FAR, (0.0, 0.0, 0.0)
        row = surfaces.normal[triangle, 0]
        return t, mul(turn_of(frame), (row[0], row[1], row[2]))
    t = ray_primitive(surfaces.kind[k], _size(k, surfaces), local, along, longest)
    if t >= FAR:
        return FAR, (0.0, 0.0, 0.0)
    at = (local[0] + t * along[0], local[1] + t * along[1], local[2] + t * along[2])
    return t, mul(turn_of(frame), signed_primitive(surfaces.kind[k], _size(k, surfaces), at)[1])
