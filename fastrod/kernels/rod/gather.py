"""Arguments and buffers of a pass by name, and what goes between the arrays of a batch (robot axis first) and
the buffers of one chunk (lanes last)."""

from __future__ import annotations

from typing import NamedTuple

from fastrod.types import Floats, Layout, Memory, Params, Ports, Response, RodShape

from ..jit import LANES, inline, kernel
from ..vec import Vec, from_quaternion
from . import columns as col
from . import shape as sh
from .lanes import BLOCK, LaneMatrix, Lanes, W, clear, get, get_mat, put, put_mat, read, take, write


class Batch(NamedTuple):
    """The robots of a batch: what they are, what acts on them, and what they remember."""

    params: Params
    ports: Ports
    layout: Layout
    memory: Memory


class Chunk(NamedTuple):
    """The robots of one pass of the lanes."""

    robots: Lanes
    """(LANES,) index of each lane's robot; the lanes beyond the last robot repeat it."""
    n_robots: int
    """At most LANES."""


class Output(NamedTuple):
    """Output of a pass; arrays of length 0 are not wanted."""

    shape: RodShape
    response: Response


class Mode(NamedTuple):
    """Mode of a pass."""

    n_col: int
    """Columns of sensitivities. Without columns the update is by the gain that the robot has."""
    predict: bool
    """Move x to first order to the new inputs before the pass."""
    propagate: bool
    """Keep the covariance between passes."""
    update: bool
    """Correct x after the pass, with P- = P + `process` and the residual variance `noise` [m^2]."""
    process: float
    noise: float


class Run(NamedTuple):
    """Robots, scratch and mode of one call, flat: numba hands no tuple of tuples to threads."""

    robots: Lanes
    """(n_rows,) indices."""
    scratch: Lanes
    """(n_tasks, scratch_size): so many tasks share the chunks. Which of them does a chunk changes no bit of
    it."""
    n_col: int
    predict: bool
    propagate: bool
    update: bool
    process: float
    noise: float


class Size(NamedTuple):
    """Counts of a pass."""

    tendons: int
    x: int
    """Unknowns."""
    e: int
    """Residuals."""
    col: int
    """Columns."""
    p: int
    """Unknowns, rounded up to whole blocks."""


class RodLanes(NamedTuple):
    """State of the march (the offsets of `shape` name the fields)."""

    node: Lanes
    stages: Lanes
    tendon: Lanes
    paths: Lanes


class Sensitivities(NamedTuple):
    """Sensitivities that are integrated along with the rod, for every column."""

    n_col: int
    columns: Lanes
    """(n_col, COLUMN) fields (`columns`)."""
    change: LaneMatrix
    """(n_col, n_tendons + GROUP) change of the tendons' lengths."""


class PassWorkspace(NamedTuple):
    """The buffers of a pass."""

    size: Size
    rod: RodLanes
    sens: Sensitivities
    length: Lanes
    """(n_tendons + GROUP,) of the tendons' paths so far."""
    x: Lanes
    error: Lanes
    """(n_e,) residuals."""
    wrench: Lanes
    """(6,) at the base."""
    s: Lanes
    """(1,) arclength."""
    gamma: LaneMatrix
    """(n_e, n_col) derivatives of the residuals."""
    covariance: LaneMatrix
    """(n_p, n_p) P of the scaled unknowns."""
    gain: LaneMatrix
    """(n_e, n_p) G, transposed."""
    scaled: LaneMatrix
    """(n_e, n_p) gamma of the scaled unknowns."""
    units: Lanes
    """(n_x,) natural size of each unknown."""
    vector: Lanes
    """(n_p + 2,) for `boundary.gain`."""


@inline
def padded(n: int, block: int) -> int:
    """n rounded up to a multiple of `block`."""
    return block * ((n + block - 1) // block)


def scratch_size(n_tendons: int, n_x: int, n_col: int, n_e: int) -> int:
    """Numbers of scratch that `pass_chunk` needs."""
    n_t, n_p = n_tendons + sh.GROUP, BLOCK * -(-n_x // BLOCK)
    march = sh.NODE + 5 * sh.STAGE + n_t * (sh.TENDON + sh.PATHS + 1) + n_col * (col.COLUMN + n_t)
    return LANES * (march + 7 + n_e + n_e * n_col + n_p * n_p + 2 * n_e * n_p + n_p + 2 + 2 * n_x)


@inline
def sizes(batch: Batch, n_col: int) -> Size:
    """Counts of this pass."""
    layout, n_x = batch.layout, batch.memory.x.shape[1]
    n_e = len(layout.row_tendon) + (0 if layout.paper else 3)
    n_e += 3 if len(batch.ports.follower_force) > 0 else 0
    return Size(len(layout.tendon_segment), n_x, n_e, n_col, padded(n_x, BLOCK))


@inline
def carve(scratch: Lanes, size: Size) -> PassWorkspace:
    """The buffers, one after the other in `scratch`; those that sums or unused tendons are read from are
    cleared."""
    n_t, n_p, n_e, n_col = size.tendons + sh.GROUP, size.p, size.e, size.col
    node, o = take(scratch, 0, sh.NODE)
    stages, o = take(scratch, o, 5 * sh.STAGE)
    tendon, o = take(scratch, o, n_t * sh.TENDON)
    paths, o = take(scratch, o, n_t * sh.PATHS)
    length, o = take(scratch, o, n_t)
    columns, o = take(scratch, o, n_col * col.COLUMN)
    change, o = take(scratch, o, n_col * n_t)
    x, o = take(scratch, o, size.x)
    error, o = take(scratch, o, n_e)
    wrench, o = take(scratch, o, 6)
    s, o = take(scratch, o, 1)
    gamma, o = take(scratch, o, n_e * n_col)
    covariance, o = take(scratch, o, n_p * n_p)
    gain, o = take(scratch, o, n_e * n_p)
    scaled, o = take(scratch, o, n_e * n_p)
    vector, o = take(scratch, o, n_p + 2)
    units, o = take(scratch, o, size.x)
    clear(length)
    clear(columns)
    clear(change)
    clear(paths)
    clear(tendon)
    return PassWorkspace(
        size,
        RodLanes(node, stages, tendon, paths),
        Sensitivities(n_col, columns, LaneMatrix(change, n_t)),
        length,
        x,
        error,
        wrench,
        s,
        LaneMatrix(gamma, n_col),
        LaneMatrix(covariance, n_p),
        LaneMatrix(gain, n_p),
        LaneMatrix(scaled, n_p),
        units,
        vector,
    )


@inline
def pick(i: int, n: int) -> int:
    """Row of robot i in an array whose robot axis has length n, or 1 for all robots."""
    return i if n > 1 else 0


@inline
def _vec(a: Floats) -> Vec:
    return a[0], a[1], a[2]


@inline
def unknown_unit(a: int, s: int, params: Params, layout: Layout) -> float:
    """Natural size of unknown a: a moment, a tension, or with a follower force a force."""
    n_base = 2 * len(layout.first_tendon) if layout.paper else 3
    if a < n_base:
        return float(params.moment_scale[s])
    if a < n_base + len(layout.free_tendon):
        return float(params.tension_scale[s])
    return float(params.moment_scale[s] / params.rod_length[s])


@kernel
def predict(
    robots: Lanes, n_robots: int, ports: Ports, params: Params, memory: Memory, layout: Layout
) -> None:
    """Move x from the inputs of the last pass to the new ones, to second order where the motion goes on.

    First order: x += v, v = G (L - L_before) - G (de/dF) (F - F_before). What the last pass then had to
    correct is the second-order term of the last move; a move along the same line by the ratio k needs k^2 of
    it again.
    """
    n_rows, n_x = len(layout.row_tendon), memory.x.shape[1]
    n_e = memory.gain.shape[2] - (3 if len(memory.force_before) > 0 else 0)
    for w in range(n_robots):
        i = robots[w]
        s = pick(i, len(params.rod_length))
        length = ports.tendon_length[pick(i, len(ports.tendon_length))]
        force = ports.tip_force[pick(i, len(ports.tip_force))]
        along, old, new = 0.0, 0.0, 0.0
        for a in range(n_x):
            v = 0.0
            for r in range(n_rows):
                v += memory.gain[i, a, r] * (length[layout.row_tendon[r]] - memory.length_before[i, r])
            if len(memory.force_before) > 0:
                for b in range(3):
                    v += memory.gain[i, a, n_e + b] * (force[b] - memory.force_before[i, b])
            unit = unknown_unit(a, s, params, layout)
            v /= unit
            before = memory.move[i, a]
            along += v * before
            old += before * before
            new += v * v
            memory.x[i, a] += unit * v
            memory.move[i, a] = v
        again = min((along / old) ** 2, 4.0) if old > 0.0 and along * along > 0.8 * old * new else 0.0
        for a in range(n_x):
            memory.defect[i, a] *= again
            memory.x[i, a] += unknown_unit(a, s, params, layout) * memory.defect[i, a]
        for r in range(n_rows):
            memory.length_before[i, r] = length[layout.row_tendon[r]]
        if len(memory.force_before) > 0:
            for b in range(3):
                memory.force_before[i, b] = force[b]


@kernel
def gather_base(
    robots: Lanes, ports: Ports, params: Params, memory: Memory, layout: Layout, node: Lanes, x: Lanes
) -> None:
    """Base frame and total internal force at the base: all the loads beyond it."""
    n_segments, n_steps, n_f = params.length.shape[1], layout.n_steps, ports.line_force.shape[2]
    for w in range(W):
        i = robots[w]
        p = ports.base_pose[pick(i, len(ports.base_pose))]
        put_mat(node, sh.N_R, w, from_quaternion((p[3], p[4], p[5], p[6])))
        force = ports.tip_force[pick(i, len(ports.tip_force))]
        line = ports.line_force[pick(i, len(ports.line_force))]
        length = params.length[pick(i, len(params.length))]
        extension = ports.extension[pick(i, len(ports.extension))]
        for a in range(3):
            write(node, sh.N_POS + a, w, p[a])
            write(node, sh.N_U + a, w, memory.curvature_guess[i, a])
            total = force[a]
            for k in range(n_segments):
                l_k = length[k] + extension[k]
                if n_f == 1:
                    total += l_k * line[k, 0, a]
                elif len(ports.grid) == 0:
                    for j in range(n_steps):
                        total += 0.5 * l_k / n_steps * (line[k, 2 * j, a] + line[k, 2 * j + 1, a])
                else:
                    grid = ports.grid[pick(i, len(ports.grid)), k]
                    for j in range(n_steps):
                        total += (
                            0.5 * l_k * (grid[j + 1] - grid[j]) * (line[k, 2 * j, a] + line[k, 2 * j + 1, a])
                        )
            if len(ports.node_force) > 0:
                for j in range(n_segments * n_steps + 1):
                    total += ports.node_force[pick(i, len(ports.node_force)), j, a]
            if len(ports.follower_force) > 0:
                total += read(x, memory.x.shape[1] - 3 + a, w)
            write(node, sh.N_N + a, w, total)


@kernel
def gather_segment(k: int, robots: Lanes, params: Params, layout: Layout, tendon: Lanes) -> None:
    """Positions of the tendons that cross segment k."""
    for w in range(W):
        offset = params.offset[pick(robots[w], len(params.offset)), k]
        for i in range(layout.first_tendon[k], len(layout.tendon_segment)):
            write(tendon, i * sh.TENDON + sh.T_DX, w, offset[i, 0])
            write(tendon, i * sh.TENDON + sh.T_DY, w, offset[i, 1])


@kernel
def gather_step(
    k: int, j: int, robots: Lanes, ports: Ports, params: Params, layout: Layout, node: Lanes
) -> None:
    """Step length, line force, stiffness and point force of step j of segment k."""
    n_k, n_f = ports.stiffness.shape[2], ports.line_force.shape[2]
    for w in range(W):
        i = robots[w]
        h = params.length[pick(i, len(params.length)), k] + ports.extension[pick(i, len(ports.extension)), k]
        if len(ports.grid) == 0:
            h /= layout.n_steps
        else:
            g = pick(i, len(ports.grid))
            h *= ports.grid[g, k, j + 1] - ports.grid[g, k, j]
        write(node, sh.N_H, w, h)
        if j == 0 or n_f > 1:
            line = ports.line_force[pick(i, len(ports.line_force)), k]
            put(node, sh.N_F0, w, _vec(line[2 * j if n_f > 1 else 0]))
            put(node, sh.N_F1, w, _vec(line[2 * j + 1 if n_f > 1 else 0]))
        if j == 0 or n_k > 1:
            stiffness = ports.stiffness[pick(i, len(ports.stiffness)), k]
            rest = ports.precurvature[pick(i, len(ports.precurvature)), k]
            for half in range(3):
                h_j = 2 * j + half if n_k > 1 else 0
                put(node, sh.N_K + 3 * half, w, _vec(stiffness[h_j]))
                put(node, sh.N_USTAR + 3 * half, w, _vec(rest[h_j]))
        if len(ports.node_force) > 0:  # a force on the node itself acts on what is before it, not beyond
            force = ports.node_force[pick(i, len(ports.node_force)), k * layout.n_steps + j]
            for a in range(3):
                write(node, sh.N_N + a, w, read(node, sh.N_N + a, w) - force[a])


@inline
def scatter(a: Floats, v: Vec) -> None:
    """a[:] = v."""
    a[0], a[1], a[2] = v


@kernel
def scatter_node(n: int, n_robots: int, robots: Lanes, node: Lanes, s: Lanes, shape: RodShape) -> None:
    """Write the cross-section where the lanes stand: node n of the rod."""
    for w in range(n_robots):
        i = robots[w]
        shape.arclength[i, n] = s[w]
        scatter(shape.position[i, n], get(node, sh.N_POS, w))
        scatter(shape.curvature[i, n], get(node, sh.N_U, w))
        scatter(shape.moment[i, n], get(node, sh.N_M, w))
        scatter(shape.force[i, n], get(node, sh.N_N, w))
        m = get_mat(node, sh.N_R, w)
        for a in range(3):
            scatter(shape.rotation[i, n, a], (m[3 * a], m[3 * a + 1], m[3 * a + 2]))
