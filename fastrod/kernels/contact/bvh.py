"""Closest point and first hit on the triangles of a mesh, through a bounding-volume hierarchy; everything in
the mesh's own frame.

A node of the hierarchy holds the boxes of its two children and two links: the index of a child node, or,
below zero, a leaf's triangles as -1 - (LEAF_CODE first + count). The closest feature of a triangle a, b, c is
0 its face, 1 to 3 the edges ab, bc, ca, 4 to 6 the corners: the pseudonormal of the feature gives the sign
(Baerentzen and Aanaes 2005).
"""

from __future__ import annotations

import math
from typing import Any

from fastrod.types import Floats, Records, Surfaces

from ..jit import inline, kernel
from ..vec import Vec, axpy, cross, dot, sub

LEAF_CODE = 8
STACK = 64  # links that wait: one for each level of the hierarchy
FAR = 1e300
Numbers = Any  # one-dimensional float64 scratch; numba's types are not mypy's
Record = Any  # one element of a record array: its fields are attributes


@inline
def normal_of(record: Record) -> Vec:
    """Unit normal of a contact, a candidate or a wall."""
    n = record.normal
    return n[0], n[1], n[2]


@inline
def corner(surfaces: Surfaces, t: int, c: int) -> Vec:
    """Corner c (0 to 2: a, b, c) of triangle t, mesh frame [m]."""
    row = surfaces.corner[t]
    return row[3 * c], row[3 * c + 1], row[3 * c + 2]


@inline
def closest_on_triangle(p: Vec, a: Vec, b: Vec, c: Vec) -> tuple[Vec, int]:
    """Closest point of a triangle and its feature (Ericson, Real-Time Collision Detection, 5.1.5)."""
    ab, ac, ap = sub(b, a), sub(c, a), sub(p, a)
    d1, d2 = dot(ab, ap), dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return a, 4
    bp = sub(p, b)
    d3, d4 = dot(ab, bp), dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return b, 5
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return axpy(d1 / (d1 - d3), ab, a), 1
    cp = sub(p, c)
    d5, d6 = dot(ab, cp), dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return c, 6
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return axpy(d2 / (d2 - d6), ac, a), 3
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        return axpy((d4 - d3) / ((d4 - d3) + (d5 - d6)), sub(c, b), b), 2
    k = 1.0 / (va + vb + vc)
    return axpy(vb * k, ab, axpy(vc * k, ac, a)), 0


@inline
def _box_distance(p: Vec, box: Floats, o: int) -> float:
    """Squared distance to a box (lower corner, upper corner)."""
    x = max(max(box[o] - p[0], p[0] - box[o + 3]), 0.0)
    y = max(max(box[o + 1] - p[1], p[1] - box[o + 4]), 0.0)
    z = max(max(box[o + 2] - p[2], p[2] - box[o + 5]), 0.0)
    return float(x * x + y * y + z * z)


@kernel
def nearest_triangle(
    p: Vec, bound: float, root: int, surfaces: Surfaces, stack: Numbers
) -> tuple[float, Vec, int, int]:
    """Squared distance, closest point, triangle and feature; triangle -1 where nothing is closer than `bound`
    [m]."""
    best = bound * bound
    found, triangle, feature = p, -1, 0
    stack[0], stack[1] = float(root), 0.0
    n = 1
    while n > 0:
        n -= 1
        if stack[2 * n + 1] >= best:
            continue
        link = int(stack[2 * n])
        if link >= 0:
            box = surfaces.box[link]
            d0, d1 = _box_distance(p, box, 0), _box_distance(p, box, 6)
            near = 0 if d0 <= d1 else 1
            far_d, near_d = max(d0, d1), min(d0, d1)
            if far_d < best:
                stack[2 * n], stack[2 * n + 1] = float(surfaces.link[link, 1 - near]), far_d
                n += 1
            if near_d < best:
                stack[2 * n], stack[2 * n + 1] = float(surfaces.link[link, near]), near_d
                n += 1
            continue
        code = -1 - link
        for t in range(code // LEAF_CODE, code // LEAF_CODE + code % LEAF_CODE):
            q, which = closest_on_triangle(
                p, corner(surfaces, t, 0), corner(surfaces, t, 1), corner(surfaces, t, 2)
            )
            e = sub(p, q)
            d = dot(e, e)
            if d < best:
                best, found, triangle, feature = d, q, t, which
    return best, found, triangle, feature


@kernel
def signed_triangle(
    p: Vec, bound: float, root: int, surfaces: Surfaces, stack: Numbers
) -> tuple[float, Vec, int]:
    """Signed distance, its gradient (the outward unit normal) and the triangle; FAR where the surface is
    beyond `bound`."""
    square, q, t, feature = nearest_triangle(p, bound, root, surfaces, stack)
    if t < 0:
        return FAR, (0.0, 0.0, 0.0), -1
    row = surfaces.normal[t, feature]
    normal = (row[0], row[1], row[2])
    e = sub(p, q)
    sign = 1.0 if dot(e, normal) >= 0.0 else -1.0
    d = math.sqrt(square)
    if d > 1e-9:
        k = sign / d
        normal = (k * e[0], k * e[1], k * e[2])
    return sign * d, normal, t


@kernel
def _keep_plane(d: float, normal: Vec, t: int, found: Records, n_found: int) -> int:
    """Note a plane, in place of one with the same normal or of the farthest that is farther; returns how many
    there are."""
    at, farthest = n_found, -1.0
    for j in range(n_found):
        if dot(normal, normal_of(found[j])) > 0.99999:
            at, farthest = j, found[j].distance
            break
        if n_found == len(found) and found[j].distance > farthest:
            at, farthest = j, found[j].distance
    if at < n_found and farthest <= d:
        return n_found
    wall = found[at]
    wall.distance, wall.triangle = d, t
    wall.normal[0], wall.normal[1], wall.normal[2] = normal
    return max(n_found, at + 1)


@kernel
def facing_planes(
    p: Vec, limit: float, nearest: float, root: int, surfaces: Surfaces, stack: Numbers, found: Records
) -> int:
    """Faces that p is in front of, closer than `limit`: the walls of a concave corner.

    p projects inside them, or their planes are no nearer than the surface itself, which is `nearest`: around
    a concave edge each plane bounds the free side on both, around a convex one p beyond a face is nearer to
    its plane.

    Writes the nearest with different normals, as many as there is room for, to `found`; returns how many.
    """
    n_found = 0
    square = limit * limit
    stack[0] = float(root)
    n = 1
    while n > 0:
        n -= 1
        link = int(stack[n])
        if link >= 0:
            box = surfaces.box[link]
            for side in range(2):
                if _box_distance(p, box, 6 * side) < square:
                    stack[n] = float(surfaces.link[link, side])
                    n += 1
            continue
        code = -1 - link
        for t in range(code // LEAF_CODE, code // LEAF_CODE + code % LEAF_CODE):
            a = corner(surfaces, t, 0)
            row = surfaces.normal[t, 0]
            normal = (row[0], row[1], row[2])
            d = dot(sub(p, a), normal)
            if d < 0.0 or d >= limit:
                continue
            q, feature = closest_on_triangle(p, a, corner(surfaces, t, 1), corner(surfaces, t, 2))
            e = sub(p, q)
            if dot(e, e) >= square or (feature != 0 and d < nearest - 1e-9):
                continue
            n_found = _keep_plane(d, normal, t, found, n_found)
    return n_found


@inline
def _enters_box(p: Vec, inverse: Vec, longest: float, box: Numbers, o: int) -> bool:
    """The ray p + t / inverse, 0 <= t <= longest, meets the box."""
    x0, x1 = (box[o] - p[0]) * inverse[0], (box[o + 3] - p[0]) * inverse[0]
    y0, y1 = (box[o + 1] - p[1]) * inverse[1], (box[o + 4] - p[1]) * inverse[1]
    z0, z1 = (box[o + 2] - p[2]) * inverse[2], (box[o + 5] - p[2]) * inverse[2]
    low = max(max(min(x0, x1), min(y0, y1)), max(min(z0, z1), 0.0))
    high = min(min(max(x0, x1), max(y0, y1)), min(max(z0, z1), longest))
    return bool(low <= high * (1.0 + 1e-12))


@inline
def _safe_inverse(x: float) -> float:
    return 1.0 / (x if abs(x) > 1e-30 else math.copysign(1e-30, x))


@kernel
def first_hit(
    p: Vec, direction: Vec, longest: float, root: int, surfaces: Surfaces, stack: Numbers
) -> tuple[float, int]:
    """Parameter t of the first triangle that p + t direction meets, 0 <= t <= longest, and the triangle; FAR
    and -1 if none.

    Two-sided, with edges included (Moeller and Trumbore 1997, with a tolerance of 1e-9 on the barycentric
    coordinates).
    """
    best, triangle = longest, -1
    inverse = (_safe_inverse(direction[0]), _safe_inverse(direction[1]), _safe_inverse(direction[2]))
    stack[0] = float(root)
    n = 1
    while n > 0:
        n -= 1
        link = int(stack[n])
        if link >= 0:
            box = surfaces.box[link]
            for side in range(2):
                if _enters_box(p, inverse, best, box, 6 * side):
                    stack[n] = float(surfaces.link[link, side])
                    n += 1
            continue
        code = -1 - link
        for t in range(code // LEAF_CODE, code // LEAF_CODE + code % LEAF_CODE):
            a = corner(surfaces, t, 0)
            ab, ac = sub(corner(surfaces, t, 1), a), sub(corner(surfaces, t, 2), a)
            h = cross(direction, ac)
            det = dot(ab, h)
            if det == 0.0:
                continue
            ap = sub(p, a)
            u = dot(ap, h) / det
            q = cross(ap, ab)
            v = dot(direction, q) / det
            if u < -1e-9 or v < -1e-9 or u + v > 1.0 + 1e-9:
                continue
            at = dot(ac, q) / det
            if 0.0 <= at <= best:
                best, triangle = at, t
    return (best, triangle) if triangle >= 0 else (FAR, -1)
