"""Between the nodes of one robot's shape: cubic Hermite curves through positions and tangents, and through
rotations.

`Curve` is one robot's rows of a shape. The error is of fourth order in the spacing, as the integrator's.
"""

from __future__ import annotations

from typing import NamedTuple

from fastrod.types import ContactMotion, Floats

from ..jit import inline, kernel
from ..vec import Mat, Vec


class Curve(NamedTuple):
    """One robot's nodes: position (n_points, 3) world [m], rotation (n_points, 3, 3) world_from_material,
    curvature (n_points, 3) material [1/m], arclength (n_points,) [m]."""

    position: Floats
    rotation: Floats
    curvature: Floats
    arclength: Floats


@inline
def curve_of(motion: ContactMotion, i: int) -> Curve:
    """Robot i, now."""
    return Curve(motion.position[i], motion.rotation[i], motion.curvature[i], motion.arclength[i])


@inline
def curve_before(motion: ContactMotion, i: int) -> Curve:
    """Robot i where it came from."""
    return Curve(
        motion.position_before[i],
        motion.rotation_before[i],
        motion.curvature_before[i],
        motion.arclength_before[i],
    )


@inline
def curve_slip(motion: ContactMotion, i: int) -> Curve:
    """Robot i at the last step."""
    return Curve(
        motion.position_slip[i], motion.rotation_slip[i], motion.curvature_slip[i], motion.arclength_slip[i]
    )


@inline
def _weights(fraction: float, h: float) -> tuple[float, float, float, float]:
    """Return the weights of the value at the start, the slope there, the value at the end and the slope
    there."""
    t, u = fraction, 1.0 - fraction
    return (1.0 + 2.0 * t) * u * u, h * t * u * u, t * t * (3.0 - 2.0 * t), -h * t * t * u


@inline
def point_at(curve: Curve, j: int, fraction: float) -> Vec:
    """Centreline at a fraction of the interval after node j."""
    if fraction == 0.0:
        return curve.position[j, 0], curve.position[j, 1], curve.position[j, 2]
    if fraction == 1.0:
        return curve.position[j + 1, 0], curve.position[j + 1, 1], curve.position[j + 1, 2]
    a, b, c, d = _weights(fraction, curve.arclength[j + 1] - curve.arclength[j])
    p, q, r, s = curve.position[j], curve.rotation[j], curve.position[j + 1], curve.rotation[j + 1]
    return (
        a * p[0] + b * q[0, 2] + c * r[0] + d * s[0, 2],
        a * p[1] + b * q[1, 2] + c * r[1] + d * s[1, 2],
        a * p[2] + b * q[2, 2] + c * r[2] + d * s[2, 2],
    )


@inline
def tangent_at(curve: Curve, j: int, fraction: float) -> Vec:
    """Slope of that curve; a unit vector at the nodes."""
    t, h = fraction, curve.arclength[j + 1] - curve.arclength[j]
    a = 6.0 * t * (t - 1.0) / h
    b, d = (1.0 - t) * (1.0 - 3.0 * t), t * (3.0 * t - 2.0)
    p, q, r, s = curve.position[j], curve.rotation[j], curve.position[j + 1], curve.rotation[j + 1]
    return (
        a * (p[0] - r[0]) + b * q[0, 2] + d * s[0, 2],
        a * (p[1] - r[1]) + b * q[1, 2] + d * s[1, 2],
        a * (p[2] - r[2]) + b * q[2, 2] + d * s[2, 2],
    )


@inline
def bend_at(curve: Curve, j: int, fraction: float) -> Vec:
    """Second derivative of that curve."""
    t, h = fraction, curve.arclength[j + 1] - curve.arclength[j]
    a, b, d = (12.0 * t - 6.0) / (h * h), (6.0 * t - 4.0) / h, (6.0 * t - 2.0) / h
    p, q, r, s = curve.position[j], curve.rotation[j], curve.position[j + 1], curve.rotation[j + 1]
    return (
        a * (p[0] - r[0]) + b * q[0, 2] + d * s[0, 2],
        a * (p[1] - r[1]) + b * q[1, 2] + d * s[1, 2],
        a * (p[2] - r[2]) + b * q[2, 2] + d * s[2, 2],
    )


@kernel
def interval_of(curve: Curve, s: float, j: int) -> tuple[int, float]:
    """Node before arclength s and the fraction of the interval, searching from node j."""
    last = len(curve.arclength) - 2
    j = min(max(j, 0), last)
    while j > 0 and curve.arclength[j] > s:
        j -= 1
    while j < last and curve.arclength[j + 1] <= s:
        j += 1
    h = curve.arclength[j + 1] - curve.arclength[j]
    fraction = min(max((s - curve.arclength[j]) / h, 0.0), 1.0)
    return (j, fraction) if fraction < 1.0 - 1e-12 else (j, 1.0)


@kernel
def rotation_at(curve: Curve, j: int, fraction: float) -> Mat:
    """world_from_material between two nodes; orthonormal to fourth order."""
    if fraction == 0.0 or fraction == 1.0:
        m = curve.rotation[j if fraction == 0.0 else j + 1]
        return m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2], m[2, 0], m[2, 1], m[2, 2]
    a, b, c, d = _weights(fraction, curve.arclength[j + 1] - curve.arclength[j])
    m, k, u, v = curve.rotation[j], curve.rotation[j + 1], curve.curvature[j], curve.curvature[j + 1]
    x = _row(a, b, c, d, m[0], k[0], u, v)
    y = _row(a, b, c, d, m[1], k[1], u, v)
    z = _row(a, b, c, d, m[2], k[2], u, v)
    return x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]


@inline
def _row(a: float, b: float, c: float, d: float, m: Floats, k: Floats, u: Floats, v: Floats) -> Vec:
    """One row of R: its slope is the row times [u]x."""
    return (
        a * m[0] + b * (m[1] * u[2] - m[2] * u[1]) + c * k[0] + d * (k[1] * v[2] - k[2] * v[1]),
        a * m[1] + b * (m[2] * u[0] - m[0] * u[2]) + c * k[1] + d * (k[2] * v[0] - k[0] * v[2]),
        a * m[2] + b * (m[0] * u[1] - m[1] * u[0]) + c * k[2] + d * (k[0] * v[1] - k[1] * v[0]),
    )
