"""The rod's equations, one cross-section at a time.

Key (Rucker and Webster 2011, IEEE T-RO 27(6), with the paper's letters):
  u  curvature, material frame [1/m]          m  total internal moment of rod and tendons, material frame [N
  m] K  diag(EI_x, EI_y, GJ) [N m^2]             u* precurvature [1/m]
  d  tendon position (d_x, d_y) [m]           T  tendon tension [N], positive pulls
  q = e3 + u x d,  t = q/|q|,  c = d x t      l' = |q| growth of the tendon's path along the backbone
  A = K + sum T grad^2|q|                     the stiffness of rod and tendons together

The tendons' share of the energy is sum T |q(u)|, its gradient T c the moment T d x t of the tendon, its
Hessian (|d|^2 I - d d^T - c c^T) T / |q|. In closed form d x q = (d_y p, -d_x p, |d|^2 u_z), |q|^2 = p^2 +
|d|^2 u_z^2 with p = 1 + u_x d_y - u_y d_x.
"""

from __future__ import annotations

import math

from ..jit import inline
from ..vec import Sym, Vec, sub, sym_inv, sym_mul


@inline
def tendon_path(u: Vec, dx: float, dy: float) -> tuple[float, Vec, float]:
    """|q|, c = d x t = d|q|/du, and 1/|q| of one tendon."""
    p = 1.0 + u[0] * dy - u[1] * dx
    b = (dx * dx + dy * dy) * u[2]
    square = p * p + b * u[2]
    inverse = 1.0 / math.sqrt(square)
    return square * inverse, (dy * p * inverse, -dx * p * inverse, b * inverse), inverse


@inline
def tendon_stiffness(dx: float, dy: float, c: Vec, k: float) -> Sym:
    """k (|d|^2 I - d d^T - c c^T), with k = T/|q|: what one tendon adds to A."""
    return (
        k * (dy * dy - c[0] * c[0]),
        -k * (dx * dy + c[0] * c[1]),
        -k * c[0] * c[2],
        k * (dx * dx - c[1] * c[1]),
        -k * c[1] * c[2],
        k * (dx * dx + dy * dy - c[2] * c[2]),
    )


@inline
def curvature_correction(
    u: Vec, m: Vec, K: Vec, u_star: Vec, tendon_moment: Vec, tendon_hessian: Sym
) -> tuple[Vec, Sym]:
    """One Newton step on K (u - u*) + sum T c(u) = m: the new u and A^-1 at the old one."""
    a = tendon_hessian
    inverse = sym_inv((K[0] + a[0], a[1], a[2], K[1] + a[3], a[4], K[2] + a[5]))
    excess = (
        K[0] * (u[0] - u_star[0]) + tendon_moment[0] - m[0],
        K[1] * (u[1] - u_star[1]) + tendon_moment[1] - m[1],
        K[2] * (u[2] - u_star[2]) + tendon_moment[2] - m[2],
    )
    return sub(u, sym_mul(inverse, excess)), inverse
