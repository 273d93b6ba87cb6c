"""An ellipsoid: its three radii, along x, y and z."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Unpack

from fastrod.contact.geometry import Obstacle, Placement, obstacle
from fastrod.contact.primitive import Primitive, register
from fastrod.kernels.jit import inline
from fastrod.kernels.vec import Vec, cross, dot, scale, sub, unit


def ellipsoid(radii: Sequence[float], **options: Unpack[Placement]) -> Obstacle:
    """An ellipsoid with these radii along x, y and z [m], centred; `Obstacle` says what the options are, and
    what raises `InputError`."""
    return obstacle("ellipsoid", radii, **options)


@inline
def _over_squares(size: Vec, x: Vec) -> Vec:
    return x[0] / (size[0] * size[0]), x[1] / (size[1] * size[1]), x[2] / (size[2] * size[2])


@inline
def _closest(size: Vec, p: Vec) -> Vec:
    """The point of the surface that is closest to p.

    It is x_i = r_i^2 p_i / (r_i^2 + t), which leaves t >= -(smallest r)^2, counted from there: s. With
    v_i = r_i p_i / (s + r_i^2 - r_min^2) the surface is |v| = 1. 1 / |v| is concave and rises with s (it is
    the secular equation of trust regions, Moré and Sorensen 1983), so that Newton's method on it comes to the
    root from below, in one step for a sphere and in fewer than ten otherwise.
    """
    least = min(size[0], min(size[1], size[2])) ** 2
    # a point on a plane of symmetry, deep inside, has two closest points: the one on the positive side
    c = (
        size[0] * max(abs(p[0]), 1e-15 * size[0]),
        size[1] * max(abs(p[1]), 1e-15 * size[1]),
        size[2] * max(abs(p[2]), 1e-15 * size[2]),
    )
    e = (size[0] * size[0] - least, size[1] * size[1] - least, size[2] * size[2] - least)
    s = max(c[0] - e[0], max(c[1] - e[1], c[2] - e[2]))
    v = (c[0] / (s + e[0]), c[1] / (s + e[1]), c[2] / (s + e[2]))
    for _ in range(60):
        square = dot(v, v)
        slope = v[0] * v[0] / (s + e[0]) + v[1] * v[1] / (s + e[1]) + v[2] * v[2] / (s + e[2])
        further = s + (math.sqrt(square) - 1.0) * square / slope
        if not further > s * (1.0 + 1e-15):
            break
        s = further
        v = (c[0] / (s + e[0]), c[1] / (s + e[1]), c[2] / (s + e[2]))
    return (
        math.copysign(size[0] * v[0], p[0]),
        math.copysign(size[1] * v[1], p[1]),
        math.copysign(size[2] * v[2], p[2]),
    )


def _distance(size: Vec, p: Vec) -> tuple[float, Vec]:
    x = _closest(size, p)
    n = unit(_over_squares(size, x), (0.0, 0.0, 1.0))[1]
    return dot(sub(p, x), n), n


def _curvature(size: Vec, p: Vec) -> tuple[float, float, Vec]:
    x = _closest(size, p)
    gradient, n = unit(_over_squares(size, x), (0.0, 0.0, 1.0))
    d = dot(sub(p, x), n)
    u = unit(cross(n, (1.0, 0.0, 0.0) if abs(n[0]) < 0.6 else (0.0, 1.0, 0.0)), (0.0, 0.0, 1.0))[1]
    w = cross(n, u)
    # the second derivative of sum (x / r)^2, half of it, in the tangent plane
    uu = dot(u, _over_squares(size, u))
    uw = dot(u, _over_squares(size, w))
    ww = dot(w, _over_squares(size, w))
    middle, half = 0.5 * (uu + ww), math.sqrt(0.25 * (uu - ww) ** 2 + uw * uw)
    first, second = (middle + half) / gradient, (middle - half) / gradient
    angle = 0.5 * math.atan2(2.0 * uw, uu - ww)  # of the direction of the first, from u
    a, b = scale(-math.sin(angle), u), scale(math.cos(angle), w)
    along = (a[0] + b[0], a[1] + b[1], a[2] + b[2])
    return first / (1.0 + d * first), second / (1.0 + d * second), along


register(
    Primitive(
        name="ellipsoid",
        n_sizes=3,
        distance=_distance,
        curvature=_curvature,
        radius=max,
        width=lambda size: 2.0 * max(size),
        drawing=lambda lib, size: lib.creation.icosphere(subdivisions=3).apply_scale(size),
    )
)
