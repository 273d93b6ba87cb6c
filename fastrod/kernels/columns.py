"""Sensitivities along the rod: the exact derivative of the discrete step, one column for each boundary unknown.

A column is (phi, dm, dr): the rotation as a vector in the material frame (dR = R [phi]x), the change of the total
moment in the material frame, and the change of position in the world frame. The steps below differentiate
`shape` term by term, so a column is the derivative of the computed shape, not only of the rod.
"""

from __future__ import annotations

from fastrod.kernels.jit import inline, kernel
from fastrod.kernels.shape import (
    GROUP,
    N_H,
    N_R,
    P_C,
    PATH,
    S_C,
    S_INV,
    S_M,
    S_MM,
    S_N,
    S_O,
    S_U,
    S_VAR,
    STAGE,
    Lanes,
    W,
    get,
    get_mat,
    put,
)
from fastrod.kernels.vec import Mat, Vec, add, axpy, cross, exp_map_variation, mul, mul_t, scale, sub, sym_mul

C_PHI, C_M, C_POS, COLUMN = 0, 3, 6, 9
D_U = 12  # the weighted change of u at the four stages


@inline
def _turned(stages: Lanes, k: int, w: int, do: Vec, dmm: Vec, dtorsion: float) -> tuple[Mat, Vec, Vec]:
    """C, psi and the change of m of stage k."""
    rotation = get_mat(stages, k * STAGE + S_C, w)
    psi = exp_map_variation(get(stages, k * STAGE + S_O, w), get(stages, k * STAGE + S_VAR, w), do)
    # m_x and m_y are turned by the whole C, not by the torsion-corrected m: their share of psi needs the z of C^T M
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


@inline
def _step(column: Lanes, du: Lanes, node: Lanes, stages: Lanes, paths: tuple[Lanes, Lanes, Lanes, Lanes], dn: Vec, forced: bool, loaded: bool, placed: bool) -> None:
    for w in range(W):
        h = node[N_H * W + w]
        phi, dm1 = get(column, C_PHI, w), get(column, C_M, w)
        n1, n2, n4 = get(stages, S_N, w), get(stages, STAGE + S_N, w), get(stages, 3 * STAGE + S_N, w)
        dn1, dn2, dn4 = cross(n1, phi), cross(n2, phi), cross(n4, phi)
        if loaded:
            load = mul_t(get_mat(node, N_R, w), dn)
            dn1, dn2, dn4 = add(dn1, load), add(dn2, load), add(dn4, load)
        u1, u2, u4 = get(stages, S_U, w), get(stages, STAGE + S_U, w), get(stages, 3 * STAGE + S_U, w)

        pull = get(paths[0], P_C, w) if forced else (0.0, 0.0, 0.0)
        du1 = _curvature(stages, 0, w, sub(dm1, pull))
        k1 = (dn1[1], -dn1[0], 0.0)
        w1 = _torsion_slope(stages, 0, w, du1, dm1)

        rotation, psi, dm = _turned(stages, 1, w, scale(0.5 * h, du1), axpy(0.5 * h, k1, dm1), dm1[2] + 0.5 * h * w1)
        pull = get(paths[1], P_C, w) if forced else (0.0, 0.0, 0.0)
        du2 = _curvature(stages, 1, w, sub(dm, pull))
        w2 = _torsion_slope(stages, 1, w, du2, dm)
        t2 = _tangent(rotation, psi)
        k2 = add(cross(n2, t2), cross(dn2, (rotation[2], rotation[5], rotation[8])))

        turn = add(cross(du1, u2), cross(u1, du2))
        rotation, psi, dm = _turned(stages, 2, w, axpy(0.5 * h, du2, scale(0.125 * h * h, turn)), axpy(0.5 * h, k2, dm1), dm1[2] + 0.5 * h * w2)
        pull = get(paths[2], P_C, w) if forced else (0.0, 0.0, 0.0)
        du3 = _curvature(stages, 2, w, sub(dm, pull))
        w3 = _torsion_slope(stages, 2, w, du3, dm)
        t3 = _tangent(rotation, psi)
        k3 = add(cross(n2, t3), cross(dn2, (rotation[2], rotation[5], rotation[8])))

        rotation, psi, dm = _turned(stages, 3, w, scale(h, du3), axpy(h, k3, dm1), dm1[2] + h * w3)
        pull = get(paths[3], P_C, w) if forced else (0.0, 0.0, 0.0)
        du4 = _curvature(stages, 3, w, sub(dm, pull))
        w4 = _torsion_slope(stages, 3, w, du4, dm)
        t4 = _tangent(rotation, psi)
        k4 = add(cross(n4, t4), cross(dn4, (rotation[2], rotation[5], rotation[8])))

        turn = add(cross(du1, u4), cross(u1, du4))
        do = axpy(h / 6.0, axpy(2.0, add(du2, du3), add(du1, du4)), scale(h * h / 12.0, turn))
        dmm = axpy(h / 6.0, axpy(2.0, add(k2, k3), add(k1, k4)), dm1)
        rotation, psi, dm = _turned(stages, 4, w, do, dmm, dm1[2] + h / 6.0 * (w1 + 2.0 * (w2 + w3) + w4))
        if placed:
            start = get_mat(node, N_R, w)
            c2, c3, c4 = get_mat(stages, STAGE + S_C, w), get_mat(stages, 2 * STAGE + S_C, w), get_mat(stages, 3 * STAGE + S_C, w)
            tangent = axpy(2.0, (c2[2] + c3[2], c2[5] + c3[5], c2[8] + c3[8]), (c4[2], c4[5], 1.0 + c4[8]))
            change = add(cross(phi, tangent), axpy(2.0, add(t2, t3), t4))
            put(column, C_POS, w, axpy(h / 6.0, mul(start, change), get(column, C_POS, w)))
        put(column, C_PHI, w, add(mul_t(rotation, phi), psi))
        put(column, C_M, w, dm)
        put(du, 0, w, scale(h / 6.0, du1))
        put(du, 3, w, scale(h / 3.0, du2))
        put(du, 6, w, scale(h / 3.0, du3))
        put(du, 9, w, scale(h / 6.0, du4))


@kernel
def free_column(column: Lanes, du: Lanes, node: Lanes, stages: Lanes) -> None:
    """A column that nothing drives within this step."""
    _step(column, du, node, stages, (node, node, node, node), (0.0, 0.0, 0.0), False, False, False)


@kernel
def tendon_column(column: Lanes, du: Lanes, node: Lanes, stages: Lanes, p1: Lanes, p2: Lanes, p3: Lanes, p4: Lanes) -> None:
    """The column of the tension of a tendon that crosses this step."""
    _step(column, du, node, stages, (p1, p2, p3, p4), (0.0, 0.0, 0.0), True, False, False)


@kernel
def force_column(column: Lanes, du: Lanes, node: Lanes, stages: Lanes, nx: float, ny: float, nz: float) -> None:
    """The column of a force that acts beyond this step, in the world direction (nx, ny, nz)."""
    _step(column, du, node, stages, (node, node, node, node), (nx, ny, nz), False, True, False)


@kernel
def placed_column(column: Lanes, du: Lanes, node: Lanes, stages: Lanes, p1: Lanes, p2: Lanes, p3: Lanes, p4: Lanes, forced: bool, nx: float, ny: float, nz: float) -> None:
    """Any column, with the change of position too: for Jacobian and compliance, not for the observer."""
    if forced:
        _step(column, du, node, stages, (p1, p2, p3, p4), (0.0, 0.0, 0.0), True, False, True)
    else:
        _step(column, du, node, stages, (node, node, node, node), (nx, ny, nz), False, True, True)


@kernel
def add_length_changes(change: Lanes, du: Lanes, p1: Lanes, p2: Lanes, p3: Lanes, p4: Lanes) -> None:
    """Change of the path length of GROUP tendons over the step, for one column."""
    for w in range(W):
        du1, du2, du3, du4 = get(du, 0, w), get(du, 3, w), get(du, 6, w), get(du, 9, w)
        for i in range(GROUP):
            c1, c2, c3, c4 = get(p1, i * PATH, w), get(p2, i * PATH, w), get(p3, i * PATH, w), get(p4, i * PATH, w)
            change[i * W + w] += (
                c1[0] * du1[0] + c1[1] * du1[1] + c1[2] * du1[2]
                + c2[0] * du2[0] + c2[1] * du2[1] + c2[2] * du2[2]
                + c3[0] * du3[0] + c3[1] * du3[1] + c3[2] * du3[2]
                + c4[0] * du4[0] + c4[1] * du4[1] + c4[2] * du4[2]
            )  # fmt: skip
