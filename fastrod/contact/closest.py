"""Closest points of points, segments and triangles as tuples of floats, in plain Python: what the direct path
and the plain twins of the shapes stand on, and the kernels do not."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

from fastrod.contact.normals import EDGE_AB, EDGE_BC, EDGE_CA, FACE, VERTEX_A, VERTEX_B, VERTEX_C

Triple: TypeAlias = tuple[float, float, float]
Signed: TypeAlias = tuple[float, Triple]
"""Signed distance [m] and its gradient, in the frame of the obstacle."""

_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


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


def segments(a: Triple, d: Triple, b: Triple, e: Triple) -> tuple[float, float]:
    """Fractions of the segments a, a + d and b, b + e that are closest to each other (Ericson 2005,
    5.1.9)."""
    dd, de, ee, r = _dot(d, d), _dot(d, e), _dot(e, e), _sub(a, b)
    det = dd * ee - de * de
    s = min(max((de * _dot(e, r) - ee * _dot(d, r)) / det, 0.0), 1.0) if det > 0.0 else 0.0
    t = on_segment(along(a, d, s), b, e)
    return on_segment(along(b, e, t), a, d), t


def segment_triangle(p: Triple, q: Triple, a: Triple, b: Triple, c: Triple) -> tuple[float, Triple]:
    """Fraction of the segment p-q and point of the triangle closest to each other; where it crosses, the
    crossing."""
    d = _sub(q, p)
    n = _cross(_sub(b, a), _sub(c, a))
    hp, hq = _dot(n, _sub(p, a)), _dot(n, _sub(q, a))
    if hp * hq <= 0.0 and hp != hq:
        t = hp / (hp - hq)
        x = along(p, d, t)
        sides = (_dot(n, _cross(_sub(v, u), _sub(x, u))) for u, v in ((a, b), (b, c), (c, a)))
        if all(side >= 0.0 for side in sides):
            return t, x
    near = [(0.0, on_triangle(p, a, b, c)[0]), (1.0, on_triangle(q, a, b, c)[0])]
    for u, v in ((a, b), (b, c), (c, a)):
        near.append((on_segment(u, p, d), u))
        s, t = segments(p, d, u, _sub(v, u))
        near.append((s, along(u, _sub(v, u), t)))
    return min(near, key=lambda pair: math.dist(along(p, d, pair[0]), pair[1]))


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


def lowest(at: Callable[[float], float]) -> float:
    """Return where a convex function is least between 0 and 1, by golden section."""
    low, high = 0.0, 1.0
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    f_left, f_right = at(left), at(right)
    while high - low > 1e-12:
        if f_left <= f_right:
            high, right, f_right = right, left, f_left
            left = high - _GOLDEN * (high - low)
            f_left = at(left)
        else:
            low, left, f_left = left, right, f_right
            right = low + _GOLDEN * (high - low)
            f_right = at(right)
    return min((0.0, 1.0, 0.5 * (low + high)), key=at)
