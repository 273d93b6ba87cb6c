"""Sensitivities along the rod: the exact derivative of the discrete step, one column for each boundary
unknown.

A column is (phi, dm, dr): the rotation as a vector in the material frame (dR = R [phi]x), the change of the
total moment in the material frame, and the change of position in the world frame. The steps below
differentiate `shape` term by term, so a column is the derivative of the computed shape, not only of the rod.
"""

from __future__ import annotations

from ..jit import inline, kernel
from ..vec import Mat, Vec, add, axpy, cross, dot, exp_map_variation, mul, mul_t, scale, sub, sym_mul
from .lanes import Lanes, W, get, get_mat, put, read, write
from .shape import GROUP, N_H, N_R, P_C, PATH, PATHS, S_C, S_INV, S_M, S_MM, S_N, S_O, S_U, S_VAR, STAGE

C_PHI, C_M, C_POS, COLUMN = 0, 3, 6, 27
# of the last step: weighted changes of u at the stages, phi at its start, of the tangents
C_U, C_PHI_BEFORE, C_TANGENT = 9, 21, 24


@inline
def _rotated(stages: Lanes, k: int, w: int, do: Vec, dmm: Vec, dtorsion: float) -> tuple[Mat, Vec, Vec]:
    """C, psi and the change of m of stage k."""
    rotation = get_mat(stages, k * STAGE + S_C, w)
    psi = exp_map_variation(get(stages, k * STAGE + S_O, w), get(stages, k * STAGE + S_VAR, w), do)
    # m_x and m_y rotate with the whole C, not with the torsion-corrected m: their part of psi needs the z of
    # C^T M
    moment = get(stages, k * STAGE + S_MM, w)
    axial = rotation[2] * moment[0] + rotation[5] * moment[1] + rotation[8] * moment[2]
    m = get(stages, k * STAGE + S_M, w)
    dm = add(mul_t(rotation, dmm), cross((m[0], m[1], axial), psi))
    return rotation, psi, (dm[0], dm[1], dtorsion)


@inline
def _torsion_slope(stages: Lanes, k: int, w: int, du: Vec, dm: Vec) -> float:
    u, m = get(stages, k * STAGE + S_U, w), get(stages, k * STAGE + S_M, w)
    return du[1] * m[0] + u[1] * dm[0] - du[0] * m[1] - u[0] * dm[1]


@inline
def _curvature(stages: Lanes, k: int, w: int, dm: Vec) -> Vec:
    return sym_mul(get(stages, k * STAGE + S_INV, w) + get(stages, k * STAGE + S_INV + 3, w), dm)


@inline
def _tangent(rotation: Mat, psi: Vec) -> Vec:
    """Change of C e3."""
    return (
        rotation[0] * psi[1] - rotation[1] * psi[0],
        rotation[3] * psi[1] - rotation[4] * psi[0],
        rotation[6] * psi[1] - rotation[7] * psi[0],
    )


@kernel
def step_column(column: Lanes, node: Lanes, stages: Lanes, path: Lanes, load: Lanes) -> None:
    """Move one column over the step. `path`: of the tendon whose tension the column is, or zeros; `load`:
    the tip force that it is, in the frame of the start, or zeros. One body for all columns: a second one
    would compile for seconds."""
    for w in range(W):
        h = read(node, N_H, w)
        phi, dm1 = get(column, C_PHI, w), get(column, C_M, w)
        n1, n2, n4 = get(stages, S_N, w), get(stages, STAGE + S_N, w), get(stages, 3 * STAGE + S_N, w)
        dn1, dn2, dn4 = cross(n1, phi), cross(n2, phi), cross(n4, phi)
        dn = get(load, 0, w)
        dn1, dn2, dn4 = add(dn1, dn), add(dn2, dn), add(dn4, dn)
        u1, u2, u4 = get(stages, S_U, w), get(stages, STAGE + S_U, w), get(stages, 3 * STAGE + S_U, w)

        du1 = _curvature(stages, 0, w, sub(dm1, get(path, P_C, w)))
        k1 = (dn1[1], -dn1[0], 0.0)
        w1 = _torsion_slope(stages, 0, w, du1, dm1)

        rotation, psi, dm = _rotated(
            stages, 1, w, scale(0.5 * h, du1), axpy(0.5 * h, k1, dm1), dm1[2] + 0.5 * h * w1
        )
        du2 = _curvature(stages, 1, w, sub(dm, get(path, 1 * PATH + P_C, w)))
        w2 = _torsion_slope(stages, 1, w, du2, dm)
        t2 = _tangent(rotation, psi)
        k2 = add(cross(n2, t2), cross(dn2, (rotation[2], rotation[5], rotation[8])))

        twist = add(cross(du1, u2), cross(u1, du2))
        rotation, psi, dm = _rotated(
            stages,
            2,
            w,
            axpy(0.5 * h, du2, scale(0.125 * h * h, twist)),
            axpy(0.5 * h, k2, dm1),
            dm1[2] + 0.5 * h * w2,
        )
        du3 = _curvature(stages, 2, w, sub(dm, get(path, 2 * PATH + P_C, w)))
        w3 = _torsion_slope(stages, 2, w, du3, dm)
        t3 = _tangent(rotation, psi)
        k3 = add(cross(n2, t3), cross(dn2, (rotation[2], rotation[5], rotation[8])))

        rotation, psi, dm = _rotated(stages, 3, w, scale(h, du3), axpy(h, k3, dm1), dm1[2] + h * w3)
        du4 = _curvature(stages, 3, w, sub(dm, get(path, 3 * PATH + P_C, w)))
        w4 = _torsion_slope(stages, 3, w, du4, dm)
        t4 = _tangent(rotation, psi)
        k4 = add(cross(n4, t4), cross(dn4, (rotation[2], rotation[5], rotation[8])))

        twist = add(cross(du1, u4), cross(u1, du4))
        do = axpy(h / 6.0, axpy(2.0, add(du2, du3), add(du1, du4)), scale(h * h / 12.0, twist))
        dmm = axpy(h / 6.0, axpy(2.0, add(k2, k3), add(k1, k4)), dm1)
        rotation, psi, dm = _rotated(stages, 4, w, do, dmm, dm1[2] + h / 6.0 * (w1 + 2.0 * (w2 + w3) + w4))
        put(column, C_PHI_BEFORE, w, phi)
        put(column, C_TANGENT, w, axpy(2.0, add(t2, t3), t4))
        put(column, C_PHI, w, add(mul_t(rotation, phi), psi))
        put(column, C_M, w, dm)
        put(column, C_U, w, scale(h / 6.0, du1))
        put(column, C_U + 3, w, scale(h / 3.0, du2))
        put(column, C_U + 6, w, scale(h / 3.0, du3))
        put(column, C_U + 9, w, scale(h / 6.0, du4))


@kernel
def column_position(column: Lanes, node: Lanes, stages: Lanes) -> None:
    """The change of position over the step that `step_column` has just done: Jacobians want it, the observer
    does not."""
    for w in range(W):
        c2 = get_mat(stages, STAGE + S_C, w)
        c3 = get_mat(stages, 2 * STAGE + S_C, w)
        c4 = get_mat(stages, 3 * STAGE + S_C, w)
        tangent = axpy(2.0, (c2[2] + c3[2], c2[5] + c3[5], c2[8] + c3[8]), (c4[2], c4[5], 1.0 + c4[8]))
        change = add(cross(get(column, C_PHI_BEFORE, w), tangent), get(column, C_TANGENT, w))
        put(
            column,
            C_POS,
            w,
            axpy(read(node, N_H, w) / 6.0, mul(get_mat(node, N_R, w), change), get(column, C_POS, w)),
        )


@kernel
def add_length_changes(change: Lanes, column: Lanes, path: Lanes) -> None:
    """Change of the path length of GROUP tendons over the step, for one column."""
    for w in range(W):
        du1 = get(column, C_U, w)
        du2 = get(column, C_U + 3, w)
        du3 = get(column, C_U + 6, w)
        du4 = get(column, C_U + 9, w)
        for i in range(GROUP):
            p = i * PATHS + P_C
            c1 = get(path, p, w)
            c2 = get(path, p + PATH, w)
            c3 = get(path, p + 2 * PATH, w)
            c4 = get(path, p + 3 * PATH, w)
            longer = dot(c1, du1) + dot(c2, du2) + dot(c3, du3) + dot(c4, du4)
            write(change, i, w, read(change, i, w) + longer)
