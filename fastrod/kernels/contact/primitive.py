"""Signed distance to the simple shapes and the first hit of a ray on them, in closed form; everything in the
shape's own frame.

Sphere (radius), box (edge lengths), cylinder and capsule (radius, length of the straight part, axis z), plane
(solid where z <= 0). The gradient of the signed distance is the outward unit normal.
"""

from __future__ import annotations

import math

from ..jit import inline, kernel
from ..vec import Vec, axpy, dot, scale
from .bvh import FAR

MESH, SPHERE, BOX, CYLINDER, CAPSULE, PLANE = range(6)


@inline
def _unit(v: Vec, otherwise: Vec) -> tuple[float, Vec]:
    """Length and direction."""
    length = math.sqrt(dot(v, v))
    return (length, scale(1.0 / length, v)) if length > 1e-15 else (0.0, otherwise)


@kernel
def signed_primitive(kind: int, size: Vec, p: Vec) -> tuple[float, Vec]:
    """Signed distance of p and its gradient."""
    if kind == PLANE:
        return p[2], (0.0, 0.0, 1.0)
    if kind == SPHERE:
        length, n = _unit(p, (0.0, 0.0, 1.0))
        return length - size[0], n
    if kind == CAPSULE:
        axial = p[2] - min(max(p[2], -0.5 * size[1]), 0.5 * size[1])
        length, n = _unit((p[0], p[1], axial), (1.0, 0.0, 0.0))
        return length - size[0], n
    if kind == CYLINDER:
        radial, out = _unit((p[0], p[1], 0.0), (1.0, 0.0, 0.0))
        side, cap = radial - size[0], abs(p[2]) - 0.5 * size[1]
        up = 1.0 if p[2] >= 0.0 else -1.0
        if side > 0.0 and cap > 0.0:
            length = math.sqrt(side * side + cap * cap)
            return length, (side / length * out[0], side / length * out[1], cap / length * up)
        return (side, out) if side >= cap else (cap, (0.0, 0.0, up))
    x, y, z = abs(p[0]) - 0.5 * size[0], abs(p[1]) - 0.5 * size[1], abs(p[2]) - 0.5 * size[2]
    sx, sy, sz = math.copysign(1.0, p[0]), math.copysign(1.0, p[1]), math.copysign(1.0, p[2])
    if max(x, max(y, z)) > 0.0:
        length, n = _unit((max(x, 0.0), max(y, 0.0), max(z, 0.0)), (0.0, 0.0, 1.0))
        return length, (n[0] * sx, n[1] * sy, n[2] * sz)
    if x >= y and x >= z:
        return x, (sx, 0.0, 0.0)
    return (y, (0.0, sy, 0.0)) if y >= z else (z, (0.0, 0.0, sz))


@kernel
def ray_primitive(kind: int, size: Vec, p: Vec, direction: Vec, longest: float) -> float:
    """Length to the surface along a unit direction, by stepping to tangent planes; FAR where it is not met up
    to `longest`."""
    if signed_primitive(kind, size, p)[0] < 0.0:
        return _exit_length(kind, size, p, direction, longest)
    t = 0.0
    for _ in range(512):
        d, n = signed_primitive(kind, size, axpy(t, direction, p))
        away = dot(n, direction)
        if abs(d) < 1e-10:
            return t
        if away >= 0.0:
            return FAR  # every shape here is convex: what moves away stays away
        # the tangent plane lies between a convex shape and what is outside it: a step to it is safe
        t += d / -away
        if t > longest:
            return FAR
    return FAR


@kernel
def _exit_length(kind: int, size: Vec, p: Vec, direction: Vec, longest: float) -> float:
    """From inside: the distance is convex along the ray, so it has one root there; by doubling, then
    bisection."""
    low, high = 0.0, 1e-3
    while signed_primitive(kind, size, axpy(high, direction, p))[0] < 0.0:
        low, high = high, 2.0 * high
        if low > longest or low > 1e9:
            return FAR
    for _ in range(60):
        middle = 0.5 * (low + high)
        if signed_primitive(kind, size, axpy(middle, direction, p))[0] < 0.0:
            low = middle
        else:
            high = middle
    return high if high <= longest else FAR
