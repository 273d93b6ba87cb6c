"""Contact points on the nodes of a pass: their forces go in, and how they move comes out.

A force F on the point `arm` away from the centreline is F and the moment arm x F on the node: what is before
the node carries them, what is beyond does not. Each probe brings three columns, a unit force along each world
axis.
"""

from __future__ import annotations

from fastrod.types import Layout, Memory, Params, PointLoads

from ..jit import LANES, inline, kernel
from ..vec import Vec, add, cross, mul, mul_t, sub
from . import columns as col
from . import shape as sh
from .gather import pick
from .shape import Lanes

W = LANES


@inline
def row_of(first_row: int, count: int, w: int) -> int:
    """Row of lane w; the lanes beyond the last robot repeat it."""
    return first_row + min(w, count - 1)


@inline
def _three(a: Lanes) -> Vec:
    return a[0], a[1], a[2]


@inline
def _axis(a: int) -> Vec:
    return 1.0 if a == 0 else 0.0, 1.0 if a == 1 else 0.0, 1.0 if a == 2 else 0.0


@kernel
def load_base(probes: PointLoads, first_row: int, count: int, node: Lanes) -> None:
    """All contact forces lie beyond the base."""
    for w in range(W):
        r = row_of(first_row, count, w)
        for q in range(probes.node.shape[1]):
            if probes.node[r, q] >= 0:
                for a in range(3):
                    node[(sh.N_N + a) * W + w] += probes.force[r, q, a]


@kernel
def load_column(
    c: int, at: int, node: Lanes, probes: PointLoads, first_row: int, count: int, given: Lanes
) -> None:
    """The unit force of contact column c in the frame of the step that starts at node `at`: none beyond its
    own node."""
    q, a = c // 3, c % 3
    for w in range(W):
        acts = 1.0 if probes.node[row_of(first_row, count, w), q] > at else 0.0
        for b in range(3):
            given[b * W + w] = acts * node[(sh.N_R + 3 * a + b) * W + w]


@kernel
def leave(
    at: int, probes: PointLoads, first_row: int, count: int, node: Lanes, columns: Lanes, n_x: int, n_col: int
) -> None:
    """Beyond node `at` the loads on it no longer act: internal force, moment and their columns jump."""
    for w in range(W):
        r = row_of(first_row, count, w)
        for q in range(probes.node.shape[1]):
            if probes.node[r, q] != at:
                continue
            rotation = sh.get_mat(node, sh.N_R, w)
            force, arm = _three(probes.force[r, q]), _three(probes.arm[r, q])
            moment = mul_t(rotation, cross(arm, force))
            sh.put(node, sh.N_N, w, sub(sh.get(node, sh.N_N, w), force))
            sh.put(node, sh.N_M, w, sub(sh.get(node, sh.N_M, w), moment))
            for c in range(n_col):
                o = c * col.COLUMN
                turn = cross(moment, sh.get(columns, o + col.C_PHI, w))
                sh.put(columns, o + col.C_M, w, sub(sh.get(columns, o + col.C_M, w), turn))
            for a in range(3):
                o = (n_x + 3 * q + a) * col.COLUMN
                own = mul_t(rotation, cross(arm, _axis(a)))
                sh.put(columns, o + col.C_M, w, sub(sh.get(columns, o + col.C_M, w), own))


@kernel
def arrive(
    at: int,
    probes: PointLoads,
    first_row: int,
    count: int,
    node: Lanes,
    columns: Lanes,
    n_col: int,
    moves: Lanes,
) -> None:
    """Motion of the contact points on node `at`, one number for each column: moves[(3 q + axis) n_col +
    column]."""
    for w in range(W):
        r = row_of(first_row, count, w)
        for q in range(probes.node.shape[1]):
            if probes.node[r, q] != at:
                continue
            rotation, arm = sh.get_mat(node, sh.N_R, w), _three(probes.arm[r, q])
            for c in range(n_col):
                o = c * col.COLUMN
                turn = mul(rotation, sh.get(columns, o + col.C_PHI, w))
                v = add(sh.get(columns, o + col.C_POS, w), cross(turn, arm))
                for a in range(3):
                    moves[((3 * q + a) * n_col + c) * W + w] = v[a]


@kernel
def respond(
    robots: Lanes,
    count: int,
    params: Params,
    memory: Memory,
    layout: Layout,
    x: Lanes,
    error: Lanes,
    gamma: Lanes,
    G: Lanes,
    units: Lanes,
    n_col: int,
    n_e: int,
    n_p: int,
    moves: Lanes,
    probes: PointLoads,
    first_row: int,
) -> None:
    """Close the boundary: motion of unknowns and contact points by the residual (column 0) and by each unit
    force."""
    n_x, n_free = memory.x.shape[1], len(layout.free_tendon)
    n_f = 3 * probes.node.shape[1]
    for w in range(count):
        i, r = robots[w], first_row + w
        unilateral = params.unilateral[pick(i, len(params.unilateral))]
        for f in range(n_free if not layout.paper else 0):  # a slack wire's unknown moves nothing (`loosen`)
            if unilateral[layout.free_tendon[f]] and x[(3 + f) * W + w] < 0.0:
                for q in range(n_f):
                    moves[(q * n_col + 3 + f) * W + w] = 0.0
        for a in range(n_x):
            for c in range(n_f + 1):
                value = 0.0
                for e in range(n_e):
                    value += G[(e * n_p + a) * W + w] * (
                        error[e * W + w] if c == 0 else gamma[(e * n_col + n_x + c - 1) * W + w]
                    )
                probes.unknown[r, a, c] = -units[a * W + w] * value
        for q in range(n_f):
            for c in range(n_f + 1):
                value = moves[(q * n_col + n_x + c - 1) * W + w] if c > 0 else 0.0
                for a in range(n_x):
                    value += moves[(q * n_col + a) * W + w] * probes.unknown[r, a, c]
                probes.motion[r, q, c] = value
