"""Closest points of points, segments and triangles as tuples of floats, in plain Python: what the direct path
and the plain twins of the shapes stand on, and the kernels do not."""

from __future__ import annotations

import math
from typing import TypeAlias

from fastrod.contact.normals import EDGE_AB, EDGE_BC, EDGE_CA, FACE, VERTEX_A, VERTEX_B, VERTEX_C

Triple: TypeAlias = tuple[float, float, float]
Signed: TypeAlias = tuple[float, Triple]
"""Signed distance [m] and its gradient, in the frame of the obstacle."""


def _dot(a: Triple, b: Triple) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _sub(a: Triple, b: Triple) -> Triple:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _cross(a: Triple, b: Triple) -> Triple:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def along(a: Triple, d: Triple, t: float) -> Triple:
    """a + t d."""
    return a[0] + t * d[0], a[1] + t * d[1], a[2] + t * d[2]


def on_triangle(p: Triple, a: Triple, b: Triple, c: Triple) -> tuple[Triple, int]:
    """The point of a triangle closest to p, and the feature that it lies on, counted as in `pseudonormals`.

    The weights of the corners (barycentric coordinates) of p's projection tell the region (Ericson 2005,
    5.1.5).
    """
    ab, ac, ap = _sub(b, a), _sub(c, a), _sub(p, a)
    bp, cp = _sub(p, b), _sub(p, c)
    d1, d2 = _dot(ab, ap), _dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return a, VERTEX_A
    d3, d4 = _dot(ab, bp), _dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return b, VERTEX_B
    d5, d6 = _dot(ab, cp), _dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return c, VERTEX_C
    # areas by cross products with an edge: d1 d4 - d3 d2 and its like lose digits far from the triangle
    n = _cross(ab, ac)
    wc = _dot(n, _cross(ab, ap))
    if wc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return along(a, ab, d1 / (d1 - d3)), EDGE_AB
    wb = _dot(n, _cross(ap, ac))
    if wb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return along(a, ac, d2 / (d2 - d6)), EDGE_CA
    wa = _dot(n, _cross(_sub(c, b), bp))
    if wa <= 0.0 and d4 >= d3 and d5 >= d6:
        return along(b, _sub(c, b), (d4 - d3) / ((d4 - d3) + (d5 - d6))), EDGE_BC
    total = wa + wb + wc
    if total <= 0.0:  # a face without area
        edges = ((a, ab, EDGE_AB), (b, _sub(c, b), EDGE_BC), (c, _sub(a, c), EDGE_CA))
        near = [(along(u, d, on_segment(p, u, d)), feature) for u, d, feature in edges]
        return min(near, key=lambda pair: math.dist(p, pair[0]))
    return along(along(a, ab, wb / total), ac, wc / total), FACE


def on_segment(p: Triple, a: Triple, d: Triple) -> float:
    """Fraction of the segment from a to a + d that is closest to p."""
    square = _dot(d, d)
    return min(max(_dot(_sub(p, a), d) / square, 0.0), 1.0) if square > 0.0 else 0.0


def corner(depth: tuple[float, ...], outward: tuple[Triple, ...]) -> Signed:
    """Signed distance to a convex corner of walls at right angles, from that to each wall and the wall's
    outward normal."""
    out = [max(v, 0.0) for v in depth]
    r = math.hypot(*out)
    if r <= 0.0:
        k = max(range(len(depth)), key=lambda i: depth[i])
        return depth[k], outward[k]
    x, y, z = (sum(v * n[i] for v, n in zip(out, outward, strict=True)) / r for i in range(3))
    return r, (x, y, z)
