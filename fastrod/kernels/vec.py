"""3-vectors, rotations and symmetric 3x3 matrices as tuples of floats: they stay in registers, so a helper
costs nothing.

A rotation or matrix is its nine entries row by row; a symmetric matrix its xx, xy, xz, yy, yz, zz.
"""

from __future__ import annotations

import math
from typing import TypeAlias

from .jit import inline

Vec: TypeAlias = tuple[float, float, float]
Sym: TypeAlias = tuple[float, float, float, float, float, float]
Mat: TypeAlias = tuple[float, float, float, float, float, float, float, float, float]


@inline
def add(a: Vec, b: Vec) -> Vec:
    """a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inline
def sub(a: Vec, b: Vec) -> Vec:
    """a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inline
def scale(k: float, a: Vec) -> Vec:
    """k a."""
    return k * a[0], k * a[1], k * a[2]


@inline
def axpy(k: float, a: Vec, b: Vec) -> Vec:
    """k a + b."""
    return k * a[0] + b[0], k * a[1] + b[1], k * a[2] + b[2]


@inline
def dot(a: Vec, b: Vec) -> float:
    """a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inline
def unit(a: Vec, otherwise: Vec) -> tuple[float, Vec]:
    """|a| and a / |a|, or `otherwise` where a has no direction."""
    length = math.sqrt(dot(a, a))
    return (length, scale(1.0 / length, a)) if length > 1e-15 else (0.0, otherwise)


@inline
def cross(a: Vec, b: Vec) -> Vec:
    """a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inline
def mul(m: Mat, a: Vec) -> Vec:
    """M a."""
    return (
        m[0] * a[0] + m[1] * a[1] + m[2] * a[2],
        m[3] * a[0] + m[4] * a[1] + m[5] * a[2],
        m[6] * a[0] + m[7] * a[1] + m[8] * a[2],
    )


@inline
def mul_t(m: Mat, a: Vec) -> Vec:
    """M^T a."""
    return (
        m[0] * a[0] + m[3] * a[1] + m[6] * a[2],
        m[1] * a[0] + m[4] * a[1] + m[7] * a[2],
        m[2] * a[0] + m[5] * a[1] + m[8] * a[2],
    )


@inline
def matmul(m: Mat, k: Mat) -> Mat:
    """M K."""
    return (
        m[0] * k[0] + m[1] * k[3] + m[2] * k[6],
        m[0] * k[1] + m[1] * k[4] + m[2] * k[7],
        m[0] * k[2] + m[1] * k[5] + m[2] * k[8],
        m[3] * k[0] + m[4] * k[3] + m[5] * k[6],
        m[3] * k[1] + m[4] * k[4] + m[5] * k[7],
        m[3] * k[2] + m[4] * k[5] + m[5] * k[8],
        m[6] * k[0] + m[7] * k[3] + m[8] * k[6],
        m[6] * k[1] + m[7] * k[4] + m[8] * k[7],
        m[6] * k[2] + m[7] * k[5] + m[8] * k[8],
    )


@inline
def from_quaternion(q: tuple[float, float, float, float]) -> Mat:
    """Rotation of a unit quaternion w x y z."""
    w, x, y, z = q
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@inline
def sym_mul(s: Sym, a: Vec) -> Vec:
    """S a for symmetric S."""
    return (
        s[0] * a[0] + s[1] * a[1] + s[2] * a[2],
        s[1] * a[0] + s[3] * a[1] + s[4] * a[2],
        s[2] * a[0] + s[4] * a[1] + s[5] * a[2],
    )


@inline
def sym_inv(s: Sym) -> Sym:
    """S^-1 for symmetric S."""
    xx = s[3] * s[5] - s[4] * s[4]
    xy = s[2] * s[4] - s[1] * s[5]
    xz = s[1] * s[4] - s[2] * s[3]
    k = 1.0 / (s[0] * xx + s[1] * xy + s[2] * xz)
    return (
        k * xx,
        k * xy,
        k * xz,
        k * (s[0] * s[5] - s[2] * s[2]),
        k * (s[1] * s[2] - s[0] * s[4]),
        k * (s[0] * s[3] - s[1] * s[1]),
    )


@inline
def exp_map(o: Vec) -> tuple[Mat, float, float, float]:
    """Rotation exp([o]x), and (a, b, c) of its derivative: psi = a do + b (o.do) o - c o x do, with dC = C
    [psi]x.

    Taken through the Cayley vector p = g o, g = 2 tan(|o|/2)/|o| as a series in |o|^2: exactly a rotation for
    any o, and no sine, for which these machines have no SIMD code. The series' first neglected term is 31
    |o|^8 / 362880.
    """
    t = dot(o, o)
    g = 1.0 + t * (1.0 / 12.0 + t * (1.0 / 120.0 + t * (17.0 / 20160.0)))
    dg = 1.0 / 6.0 + t * (1.0 / 30.0 + t * (17.0 / 3360.0))
    k = 1.0 / (1.0 + 0.25 * g * g * t)
    a = k * g
    c = 0.5 * a * g
    xx = c * o[0] * o[0]
    xy = c * o[0] * o[1]
    xz = c * o[0] * o[2]
    yy = c * o[1] * o[1]
    yz = c * o[1] * o[2]
    zz = c * o[2] * o[2]
    x, y, z = a * o[0], a * o[1], a * o[2]
    rotation = (1.0 - yy - zz, xy - z, xz + y, xy + z, 1.0 - xx - zz, yz - x, xz - y, yz + x, 1.0 - xx - yy)
    return rotation, a, k * dg, c


@inline
def exp_map_variation(o: Vec, coefficients: Vec, do: Vec) -> Vec:
    """psi of a change do of the vector o, from `exp_map`'s coefficients."""
    a, b, c = coefficients
    along = b * dot(o, do)
    across = cross(o, do)
    return (
        a * do[0] + along * o[0] - c * across[0],
        a * do[1] + along * o[1] - c * across[1],
        a * do[2] + along * o[2] - c * across[2],
    )
