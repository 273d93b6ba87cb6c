"""One integration step of the rod along arclength, LANES robots side by side.

The step is the fourth-order Runge-Kutta-Munthe-Kaas method on SO(3) with two commutators (Munthe-Kaas and
Owren 1999), for R' = R [u]x with u from the total moment. The moment is carried in the frame R_n of the
step's start, M' = -(C e3) x n with R = R_n C, so that arcs and helices (constant M) cost no truncation error
and a joint, where the total moment is continuous but u jumps, needs no special case. Lengths and position use
the same four stages.

The equations of a cross-section (Rucker and Webster 2011, IEEE T-RO 27(6), with the paper's letters):
  u  curvature, material frame [1/m]          m  total internal moment of rod and tendons, material [N m]
  K  diag(EI_x, EI_y, GJ) [N m^2]             u* precurvature [1/m]
  d  tendon position (d_x, d_y) [m]           T  tendon tension [N], positive pulls
  q = e3 + u x d,  t = q/|q|,  c = d x t      l' = |q| growth of the tendon's path along the backbone
  A = K + sum T grad^2|q|                     the stiffness of rod and tendons together

The tendons' share of the energy is sum T |q(u)|, its gradient T c the moment T d x t of the tendon, its
Hessian (|d|^2 I - d d^T - c c^T) T / |q|. In closed form d x q = (d_y p, -d_x p, |d|^2 u_z), |q|^2 = p^2 +
|d|^2 u_z^2 with p = 1 + u_x d_y - u_y d_x.

The offsets below name the fields of the buffers (`lanes`).
"""

from __future__ import annotations

import math

from ..jit import inline, kernel
from ..vec import Sym, Vec, add, axpy, cross, exp_map, matmul, mul, mul_t, scale, sub, sym_inv, sym_mul
from .lanes import Lanes, W, get, get_mat, put, put_mat, read, write


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


# node: the cross-section where a step starts
# rotation, position, moment (material), internal force (world), curvature
N_R, N_POS, N_M, N_N, N_U = 0, 9, 12, 15, 18
# line force at both ends, step length, K and u* at start, middle, end
N_F0, N_F1, N_H, N_K, N_USTAR = 21, 24, 27, 28, 37
NODE = 46
# stage: one of the four evaluations of a step, and (fifth) its end
# vector of C, its variation, C, m, n (start frame), u, A^-1
S_O, S_VAR, S_C, S_M, S_N, S_U, S_INV = 0, 3, 6, 15, 18, 21, 24
# moment in the start frame, its slope, sums over tendons (moment, then Hessian)
S_MM, S_DM, S_SUM = 30, 33, 36
STAGE = 45
# tendon: position and tension; path: what a tendon does at a stage
T_DX, T_DY, T_T, TENDON = 0, 1, 2, 3
P_C, P_Q, PATH = 0, 3, 4
PATHS = 4 * PATH  # of one tendon, stage after stage
GROUP = 4  # tendons that one loop takes together: fewer loads and stores of the sums


@kernel
def start_step(node: Lanes, stages: Lanes) -> None:
    """Loads of the step in its start frame, and stage 1: there C = I."""
    for w in range(W):
        rotation = get_mat(node, N_R, w)
        h = read(node, N_H, w)
        n = mul_t(rotation, get(node, N_N, w))
        f0 = mul_t(rotation, get(node, N_F0, w))
        f1 = mul_t(rotation, get(node, N_F1, w))
        middle = axpy(-0.125 * h, axpy(3.0, f0, f1), n)
        put(stages, S_N, w, n)
        put(stages, STAGE + S_N, w, middle)
        put(stages, 2 * STAGE + S_N, w, middle)
        put(stages, 3 * STAGE + S_N, w, axpy(-0.5 * h, add(f0, f1), n))
        m = get(node, N_M, w)
        put(stages, S_M, w, m)
        put(stages, S_MM, w, m)
        put(stages, S_U, w, get(node, N_U, w))
        put_mat(stages, S_C, w, (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))
        put(stages, S_DM, w, (n[1], -n[0], 0.0))


@inline
def torsion_slope(stages: Lanes, k: int, w: int) -> float:
    """m_z' = -(u x m)_z, the axial part of m' = -u x m - e3 x n: zero where bending is isotropic."""
    u, m = get(stages, k * STAGE + S_U, w), get(stages, k * STAGE + S_M, w)
    return u[1] * m[0] - u[0] * m[1]


@inline
def _enter(stages: Lanes, k: int, w: int, o: Vec, moment: Vec, torsion: float, guess: Vec) -> None:
    """Frame, moment and moment slope of stage k from its rotation vector o."""
    rotation, a, b, c = exp_map(o)
    put(stages, k * STAGE + S_O, w, o)
    put(stages, k * STAGE + S_VAR, w, (a, b, c))
    put_mat(stages, k * STAGE + S_C, w, rotation)
    put(stages, k * STAGE + S_MM, w, moment)
    m = mul_t(rotation, moment)
    put(stages, k * STAGE + S_M, w, (m[0], m[1], torsion))
    put(stages, k * STAGE + S_U, w, guess)
    put(
        stages,
        k * STAGE + S_DM,
        w,
        cross(get(stages, k * STAGE + S_N, w), (rotation[2], rotation[5], rotation[8])),
    )


@kernel
def second_stage(node: Lanes, stages: Lanes) -> None:
    """Stage 2, half a step on: o = h/2 u1 and M = M1 + h/2 M1'; u is guessed by its slope, A u' = -u x m - e3
    x n."""
    for w in range(W):
        h = read(node, N_H, w)
        u1, m = get(stages, S_U, w), get(stages, S_M, w)
        n = get(stages, S_N, w)
        inverse = get(stages, S_INV, w)[0:3] + get(stages, S_INV + 3, w)
        gyration = cross(u1, m)
        slope = sym_mul(inverse, (n[1] - gyration[0], -n[0] - gyration[1], -gyration[2]))
        _enter(
            stages,
            1,
            w,
            scale(0.5 * h, u1),
            axpy(0.5 * h, get(stages, S_DM, w), m),
            m[2] + 0.5 * h * torsion_slope(stages, 0, w),
            axpy(0.5 * h, slope, u1),
        )
        # stage 1 needs no rotation vector; its place keeps du/ds for the fourth stage's guess
        put(stages, S_O, w, slope)


@kernel
def third_stage(node: Lanes, stages: Lanes) -> None:
    """Stage 3, half a step on: o = h/2 u2 + h^2/8 u1 x u2 and M = M1 + h/2 M2'; u is guessed as u2."""
    for w in range(W):
        h = read(node, N_H, w)
        u1, u2 = get(stages, S_U, w), get(stages, STAGE + S_U, w)
        o = axpy(0.5 * h, u2, scale(0.125 * h * h, cross(u1, u2)))
        m = get(stages, S_M, w)
        _enter(
            stages,
            2,
            w,
            o,
            axpy(0.5 * h, get(stages, STAGE + S_DM, w), m),
            m[2] + 0.5 * h * torsion_slope(stages, 1, w),
            u2,
        )


@kernel
def fourth_stage(node: Lanes, stages: Lanes) -> None:
    """Stage 4, a step on: o = h u3 and M = M1 + h M3'; u is guessed by the parabola through u1, its slope,
    and u3: 4 u3 - 3 u1 - h u1'."""
    for w in range(W):
        h = read(node, N_H, w)
        u1, u3 = get(stages, S_U, w), get(stages, 2 * STAGE + S_U, w)
        guess = axpy(4.0, u3, axpy(-3.0, u1, scale(-h, get(stages, S_O, w))))
        m = get(stages, S_M, w)
        _enter(
            stages,
            3,
            w,
            scale(h, u3),
            axpy(h, get(stages, 2 * STAGE + S_DM, w), m),
            m[2] + h * torsion_slope(stages, 2, w),
            guess,
        )


@kernel
def end_step(node: Lanes, stages: Lanes) -> None:
    """Rotation vector and moment over the whole step: the fifth entry of `stages`."""
    for w in range(W):
        h = read(node, N_H, w)
        u1, u4 = get(stages, S_U, w), get(stages, 3 * STAGE + S_U, w)
        u23 = add(get(stages, STAGE + S_U, w), get(stages, 2 * STAGE + S_U, w))
        o = axpy(h / 6.0, axpy(2.0, u23, add(u1, u4)), scale(h * h / 12.0, cross(u1, u4)))
        k23 = add(get(stages, STAGE + S_DM, w), get(stages, 2 * STAGE + S_DM, w))
        slope = axpy(2.0, k23, add(get(stages, S_DM, w), get(stages, 3 * STAGE + S_DM, w)))
        put(stages, 4 * STAGE + S_N, w, get(stages, 3 * STAGE + S_N, w))
        m = get(stages, S_M, w)
        torsion = (
            torsion_slope(stages, 0, w)
            + 2.0 * (torsion_slope(stages, 1, w) + torsion_slope(stages, 2, w))
            + torsion_slope(stages, 3, w)
        )
        _enter(stages, 4, w, o, axpy(h / 6.0, slope, m), m[2] + h / 6.0 * torsion, u4)


@kernel
def advance(node: Lanes, stages: Lanes) -> None:
    """Move the node to the end of the step."""
    for w in range(W):
        h = read(node, N_H, w)
        rotation = get_mat(node, N_R, w)
        c2 = get_mat(stages, STAGE + S_C, w)
        c3 = get_mat(stages, 2 * STAGE + S_C, w)
        c4 = get_mat(stages, 3 * STAGE + S_C, w)
        tangent = axpy(2.0, (c2[2] + c3[2], c2[5] + c3[5], c2[8] + c3[8]), (c4[2], c4[5], 1.0 + c4[8]))
        put(node, N_POS, w, axpy(h / 6.0, mul(rotation, tangent), get(node, N_POS, w)))
        put_mat(node, N_R, w, matmul(rotation, get_mat(stages, 4 * STAGE + S_C, w)))
        put(node, N_M, w, get(stages, 4 * STAGE + S_M, w))
        put(node, N_U, w, get(stages, 4 * STAGE + S_U, w))
        put(node, N_N, w, axpy(-0.5 * h, add(get(node, N_F0, w), get(node, N_F1, w)), get(node, N_N, w)))


@kernel
def curvature_without_tendons(stage: Lanes, stiffness: Lanes, rest: Lanes) -> None:
    """u = u* + K^-1 m: a passive rod, and the paper's reduced model."""
    for w in range(W):
        k, m = get(stiffness, 0, w), get(stage, S_M, w)
        inverse = (1.0 / k[0], 1.0 / k[1], 1.0 / k[2])
        put(stage, S_U, w, add(get(rest, 0, w), (inverse[0] * m[0], inverse[1] * m[1], inverse[2] * m[2])))
        put(stage, S_INV, w, (inverse[0], 0.0, 0.0))
        put(stage, S_INV + 3, w, (inverse[1], 0.0, inverse[2]))


@kernel
def clear_sums(stage: Lanes) -> None:
    """Zero for the moment (3) and the Hessian (6) that `tendon_sums` adds up."""
    for i in range(S_SUM * W, (S_SUM + 9) * W):
        stage[i] = 0.0


@kernel
def tendon_sums(stage: Lanes, tendon: Lanes, path: Lanes) -> None:
    """Path of GROUP tendons at the stage's u, and their moment and Hessian added to the stage's sums."""
    for w in range(W):
        u = get(stage, S_U, w)
        sum_m = get(stage, S_SUM, w)
        sum_a, sum_b = get(stage, S_SUM + 3, w), get(stage, S_SUM + 6, w)
        for i in range(GROUP):
            dx, dy, t = get(tendon, i * TENDON, w)
            q, c, inverse = tendon_path(u, dx, dy)
            put(path, i * PATHS + P_C, w, c)
            write(path, i * PATHS + P_Q, w, q)
            a = tendon_stiffness(dx, dy, c, t * inverse)
            sum_m = axpy(t, c, sum_m)
            sum_a = add((a[0], a[1], a[2]), sum_a)
            sum_b = add((a[3], a[4], a[5]), sum_b)
        put(stage, S_SUM, w, sum_m)
        put(stage, S_SUM + 3, w, sum_a)
        put(stage, S_SUM + 6, w, sum_b)


@kernel
def tendon_paths(stage: Lanes, tendon: Lanes, path: Lanes) -> None:
    """Path of GROUP tendons at the stage's u, where they do not load the rod (paper mode)."""
    for w in range(W):
        u = get(stage, S_U, w)
        for i in range(GROUP):
            dx, dy, _ = get(tendon, i * TENDON, w)
            q, c, _ = tendon_path(u, dx, dy)
            put(path, i * PATHS + P_C, w, c)
            write(path, i * PATHS + P_Q, w, q)


@kernel
def correct_curvature(stage: Lanes, stiffness: Lanes, rest: Lanes) -> None:
    """One Newton step of the stage's u on the sums of all tendons."""
    for w in range(W):
        hessian = get(stage, S_SUM + 3, w) + get(stage, S_SUM + 6, w)
        u, inverse = curvature_correction(
            get(stage, S_U, w),
            get(stage, S_M, w),
            get(stiffness, 0, w),
            get(rest, 0, w),
            get(stage, S_SUM, w),
            hessian,
        )
        put(stage, S_U, w, u)
        put(stage, S_INV, w, inverse[0:3])
        put(stage, S_INV + 3, w, inverse[3:6])


@kernel
def add_lengths(length: Lanes, node: Lanes, path: Lanes) -> None:
    """Path length of GROUP tendons over the step."""
    for w in range(W):
        h = read(node, N_H, w) / 6.0
        for i in range(GROUP):
            q = i * PATHS + P_Q
            half = read(path, q + PATH, w) + read(path, q + 2 * PATH, w)
            grown = h * (read(path, q, w) + 2.0 * half + read(path, q + 3 * PATH, w))
            write(length, i, w, read(length, i, w) + grown)
