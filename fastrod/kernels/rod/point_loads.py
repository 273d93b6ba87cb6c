"""Point loads (contact forces) on the nodes of a pass: their forces go in, and how they move comes out.

A force F on the point `arm` away from the centreline is F and the moment arm x F on the node: what is before
the node carries them, what is beyond does not. Each load brings three columns, a unit force along each world
axis.
"""

from __future__ import annotations

from fastrod.types import PointLoads

from ..jit import inline, kernel
from ..vec import Vec, add, cross, mul, mul_t, sub
from . import columns as col
from . import shape as sh
from .gather import pick
from .lanes import Lanes, W, at, get, get_mat, put, read, write, write_at
from .workspace import Batch, Chunk, Output, PassWorkspace, Sensitivities


@inline
def row_of(chunk: Chunk, w: int) -> int:
    """Row of lane w; the lanes beyond the last robot repeat it."""
    return chunk.first_row + min(w, chunk.n_robots - 1)


@inline
def _three(a: Lanes) -> Vec:
    return a[0], a[1], a[2]


@inline
def _axis(a: int) -> Vec:
    return 1.0 if a == 0 else 0.0, 1.0 if a == 1 else 0.0, 1.0 if a == 2 else 0.0


@kernel
def load_base(loads: PointLoads, chunk: Chunk, node: Lanes) -> None:
    """All contact forces lie beyond the base."""
    for w in range(W):
        r = row_of(chunk, w)
        for q in range(loads.node.shape[1]):
            if loads.node[r, q] >= 0:
                for a in range(3):
                    write(node, sh.N_N + a, w, read(node, sh.N_N + a, w) + loads.force[r, q, a])


@kernel
def load_column(c: int, n: int, node: Lanes, loads: PointLoads, chunk: Chunk, unit_force: Lanes) -> None:
    """The unit force of contact column c in the frame of the step that starts at node n: none beyond its own
    node."""
    q, a = c // 3, c % 3
    for w in range(W):
        acts = 1.0 if loads.node[row_of(chunk, w), q] > n else 0.0
        for b in range(3):
            write(unit_force, b, w, acts * read(node, sh.N_R + 3 * a + b, w))


@kernel
def leave(n: int, loads: PointLoads, chunk: Chunk, node: Lanes, columns: Lanes, n_x: int, n_col: int) -> None:
    """Beyond node n the loads on it no longer act: internal force, moment and their columns jump."""
    for w in range(W):
        r = row_of(chunk, w)
        for q in range(loads.node.shape[1]):
            if loads.node[r, q] != n:
                continue
            rotation = get_mat(node, sh.N_R, w)
            force, arm = _three(loads.force[r, q]), _three(loads.arm[r, q])
            moment = mul_t(rotation, cross(arm, force))
            put(node, sh.N_N, w, sub(get(node, sh.N_N, w), force))
            put(node, sh.N_M, w, sub(get(node, sh.N_M, w), moment))
            for c in range(n_col):
                o = c * col.COLUMN
                change = cross(moment, get(columns, o + col.C_PHI, w))
                put(columns, o + col.C_M, w, sub(get(columns, o + col.C_M, w), change))
            for a in range(3):
                o = (n_x + 3 * q + a) * col.COLUMN
                own = mul_t(rotation, cross(arm, _axis(a)))
                put(columns, o + col.C_M, w, sub(get(columns, o + col.C_M, w), own))


@kernel
def arrive(n: int, loads: PointLoads, chunk: Chunk, node: Lanes, sens: Sensitivities) -> None:
    """Motion of the contact points on node n, one number for each column: moves[3 q + axis, column]."""
    columns, moves = sens.columns, sens.moves
    for w in range(W):
        r = row_of(chunk, w)
        for q in range(loads.node.shape[1]):
            if loads.node[r, q] != n:
                continue
            rotation, arm = get_mat(node, sh.N_R, w), _three(loads.arm[r, q])
            for c in range(moves.n_columns):
                o = c * col.COLUMN
                angle = mul(rotation, get(columns, o + col.C_PHI, w))
                v = add(get(columns, o + col.C_POS, w), cross(angle, arm))
                for a in range(3):
                    write_at(moves, 3 * q + a, c, w, v[a])


@kernel
def respond(chunk: Chunk, batch: Batch, output: Output, work: PassWorkspace) -> None:
    """Close the boundary: motion of unknowns and contact points by the residual (column 0) and by each unit
    force."""
    params, layout, loads, moves = batch.params, batch.layout, output.loads, work.sens.moves
    n_x, n_e, n_f = work.size.x, work.size.e, 3 * loads.node.shape[1]
    for w in range(chunk.n_robots):
        i, r = chunk.robots[w], chunk.first_row + w
        unilateral = params.unilateral[pick(i, len(params.unilateral))]
        # a slack tendon's unknown moves nothing (`release_slack_tendons`)
        for f in range(len(layout.free_tendon) if not layout.paper else 0):
            if unilateral[layout.free_tendon[f]] and read(work.x, 3 + f, w) < 0.0:
                for q in range(n_f):
                    write_at(moves, q, 3 + f, w, 0.0)
        for a in range(n_x):
            for c in range(n_f + 1):
                value = 0.0
                for e in range(n_e):
                    open_by = read(work.error, e, w) if c == 0 else at(work.gamma, e, n_x + c - 1, w)
                    value += at(work.gain, e, a, w) * open_by
                loads.unknown[r, a, c] = -read(work.units, a, w) * value
        for q in range(n_f):
            for c in range(n_f + 1):
                value = at(moves, q, n_x + c - 1, w) if c > 0 else 0.0
                for a in range(n_x):
                    value += at(moves, q, a, w) * loads.unknown[r, a, c]
                loads.motion[r, q, c] = value
