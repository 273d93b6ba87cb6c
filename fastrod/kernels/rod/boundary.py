"""The boundary of a robot: its residuals with their derivatives, and the observer's update of the unknowns
(the paper's eqs. 5 and 12 corrected), LANES robots side by side.

Residuals e are lengths in metres: tendon lengths as they are, moments times l^2/EI, forces times l^3/EI.

    P- = P + Q dt;  G = P- Gamma^T (Gamma P- Gamma^T + V^-1/dt)^-1;  x -= G e;  P = (I - G Gamma) P-

The rows of Gamma are taken one after the other, as a Kalman filter takes measurements with independent noise:
the same G and P to rounding, with divisions by a number in place of a matrix, and sound where Gamma has more
rows than rank (four tendons on two unknowns in paper mode) or a nearly singular direction (tendons that
hardly stretch).

Vectors over unknowns are padded with zeros to a multiple of BLOCK entries, so that one loop over lanes does
BLOCK multiply-adds.
"""

from __future__ import annotations

from fastrod.types import Params

from ..jit import inline, kernel
from ..vec import cross, mul, mul_t, sub
from . import columns as col
from . import shape as sh
from .gather import Batch, Chunk, Mode, PassWorkspace, pick, unknown_unit
from .lanes import BLOCK, LaneMatrix, Lanes, W, at, clear, get, get_mat, read, write, write_at


@inline
def slack_slope(params: Params, i: int, t: int) -> float:
    """Residual per unknown of a slack tendon of robot i: the unknown is then no tension but a measure of how
    loose it hangs, and d/T is about a taut one's slope."""
    s = pick(i, len(params.rod_length))
    slope = params.moment_scale[s] / (params.tension_scale[s] * params.tension_scale[s])
    return float(max(params.compliance[pick(i, len(params.compliance)), t], slope))


@kernel
def close_lengths(chunk: Chunk, batch: Batch, work: PassWorkspace) -> None:
    """l_i - L_i - c_i (T_i - T0_i) and its derivatives, one row for each commanded tendon."""
    params, ports, layout, _ = batch
    n_base = 2 * len(layout.first_tendon) if layout.paper else 3
    for r in range(len(layout.row_tendon)):
        t = layout.row_tendon[r]
        for w in range(W):
            i = chunk.robots[w]
            given = ports.tendon_length[pick(i, len(ports.tendon_length)), t]
            write(work.error, r, w, read(work.length, t, w) - given)
        for c in range(work.size.col):
            for w in range(W):
                write_at(work.gamma, r, c, w, at(work.sens.change, c, t, w))
    for f in range(len(layout.free_tendon)):
        t = layout.free_tendon[f]
        for w in range(W):
            i = chunk.robots[w]
            compliance = params.compliance[pick(i, len(params.compliance)), t]
            value = read(work.x, n_base + f, w)
            slack = value < 0.0 and params.unilateral[pick(i, len(params.unilateral)), t]
            slope = slack_slope(params, i, t)
            stretch = slope if slack else compliance
            own = stretch * value - compliance * params.pretension[pick(i, len(params.pretension)), t]
            write(work.error, f, w, read(work.error, f, w) - own)
            if work.size.col > 0:
                write_at(work.gamma, f, n_base + f, w, at(work.gamma, f, n_base + f, w) - stretch)


@kernel
def close_tip(chunk: Chunk, batch: Batch, work: PassWorkspace) -> None:
    """m - R^T M_tip, and with a follower force F - R F_material, as lengths, with their derivatives."""
    params, ports, layout, _ = batch
    row, node, columns = len(layout.row_tendon), work.rod.node, work.sens.columns
    follower = len(ports.follower_force) > 0
    for w in range(W):
        i = chunk.robots[w]
        s = pick(i, len(params.rod_length))
        to_length = params.rod_length[s] / params.moment_scale[s]
        rotation = get_mat(node, sh.N_R, w)
        tip_moment = ports.tip_moment[pick(i, len(ports.tip_moment))]
        target = mul_t(rotation, (tip_moment[0], tip_moment[1], tip_moment[2]))
        m = get(node, sh.N_M, w)
        for a in range(3):
            write(work.error, row + a, w, to_length * (m[a] - target[a]))
        for c in range(work.size.col):
            o = c * col.COLUMN
            v = sub(get(columns, o + col.C_M, w), cross(target, get(columns, o + col.C_PHI, w)))
            for a in range(3):
                write_at(work.gamma, row + a, c, w, to_length * v[a])
        if follower:
            g = ports.follower_force[pick(i, len(ports.follower_force))]
            given = (g[0], g[1], g[2])
            world = mul(rotation, given)
            to_length *= params.rod_length[s]
            own = work.size.x - 3
            for a in range(3):
                write(work.error, row + 3 + a, w, to_length * (read(work.x, own + a, w) - world[a]))
            for c in range(work.size.col):
                v = mul(rotation, cross(get(columns, c * col.COLUMN + col.C_PHI, w), given))
                for a in range(3):
                    unit = 1.0 if c == own + a else 0.0
                    write_at(work.gamma, row + 3 + a, c, w, to_length * (unit - v[a]))


@kernel
def release_slack_tendons(chunk: Chunk, batch: Batch, work: PassWorkspace) -> None:
    """A slack tendon carries nothing: its unknown moves no residual but its own, and not the tip."""
    params, layout = batch.params, batch.layout
    for f in range(len(layout.free_tendon) if work.size.col > 0 else 0):
        t = layout.free_tendon[f]
        for w in range(W):
            i = chunk.robots[w]
            if params.unilateral[pick(i, len(params.unilateral)), t] and read(work.x, 3 + f, w) < 0.0:
                for r in range(work.size.e):
                    write_at(work.gamma, r, 3 + f, w, 0.0)
                for k in range(col.COLUMN):
                    write(work.sens.columns, (3 + f) * col.COLUMN + k, w, 0.0)
                write_at(work.gamma, f, 3 + f, w, -slack_slope(params, i, t))


@kernel
def dot_block(out: Lanes, a: Lanes, b: Lanes) -> None:
    """out += a . b over one block."""
    for w in range(W):
        out[w] += (
            a[w] * b[w] + a[W + w] * b[W + w] + a[2 * W + w] * b[2 * W + w] + a[3 * W + w] * b[3 * W + w]
        )


@kernel
def subtract_block(a: Lanes, b: Lanes, k: Lanes) -> None:
    """a -= b k over one block; k is a number for each lane."""
    for w in range(W):
        a[w] -= b[w] * k[w]
        a[W + w] -= b[W + w] * k[w]
        a[2 * W + w] -= b[2 * W + w] * k[w]
        a[3 * W + w] -= b[3 * W + w] * k[w]


@kernel
def scale_block(a: Lanes, b: Lanes, k: Lanes) -> None:
    """a = b k over one block."""
    for w in range(W):
        a[w] = b[w] * k[w]
        a[W + w] = b[W + w] * k[w]
        a[2 * W + w] = b[2 * W + w] * k[w]
        a[3 * W + w] = b[3 * W + w] * k[w]


@kernel
def gain(
    P: LaneMatrix, G: LaneMatrix, gamma: LaneMatrix, vector: Lanes, n_x: int, n_e: int, noise: float
) -> None:
    """P- to P in place, and G (transposed), from the rows of Gamma and the variance V^-1/dt of one residual.

    All three matrices have n_p columns; `vector` holds n_p + 2 numbers a lane.
    """
    n_p, p, g, rows = P.n_columns, P.entries, G.entries, gamma.entries
    row, block = n_p * W, BLOCK * W
    number, inverse = vector[row : row + W], vector[row + W : row + 2 * W]
    for i in range(n_e):
        g_i = rows[i * row : (i + 1) * row]
        for a in range(n_x):
            out = vector[a * W : (a + 1) * W]
            for w in range(W):
                out[w] = 0.0
            for b in range(0, row, block):
                dot_block(out, p[a * row + b : a * row + b + block], g_i[b : b + block])
        for w in range(W):
            number[w] = noise
        for b in range(0, row, block):
            dot_block(number, vector[b : b + block], g_i[b : b + block])
        for w in range(W):
            # rounding may take P a little below zero where nothing is left to learn
            inverse[w] = 1.0 / max(number[w], noise)
        k_i = g[i * row : (i + 1) * row]
        for b in range(0, row, block):
            scale_block(k_i[b : b + block], vector[b : b + block], inverse)
        for a in range(n_x):
            for b in range(0, row, block):
                subtract_block(
                    p[a * row + b : a * row + b + block], vector[b : b + block], k_i[a * W : (a + 1) * W]
                )
        for j in range(i):
            k_j = g[j * row : (j + 1) * row]
            for w in range(W):
                number[w] = 0.0
            for b in range(0, row, block):
                dot_block(number, k_j[b : b + block], g_i[b : b + block])
            for b in range(0, row, block):
                subtract_block(k_j[b : b + block], k_i[b : b + block], number)


@kernel
def form_gain(chunk: Chunk, batch: Batch, work: PassWorkspace, mode: Mode) -> None:
    """G of the scaled unknowns from the derivatives of the residuals, and the unknowns' units."""
    n_x, n_e, P = work.size.x, work.size.e, work.covariance
    for w in range(W):
        s = pick(chunk.robots[w], len(batch.params.rod_length))
        for a in range(n_x):
            write(work.units, a, w, unknown_unit(a, s, batch.params, batch.layout))
    clear(P.entries)
    clear(work.scaled.entries)
    clear(work.gain.entries)
    clear(work.vector)
    for r in range(n_e):
        for a in range(n_x):
            for w in range(W):
                write_at(work.scaled, r, a, w, at(work.gamma, r, a, w) * read(work.units, a, w))
    for a in range(n_x):
        if mode.propagate:
            for b in range(a + 1):
                for w in range(W):
                    value = float(batch.memory.covariance[chunk.robots[w], a * (a + 1) // 2 + b])
                    write_at(P, a, b, w, value)
                    write_at(P, b, a, w, value)
        for w in range(W):
            write_at(P, a, a, w, at(P, a, a, w) + mode.process)
    gain(P, work.gain, work.scaled, work.vector, n_x, n_e, mode.noise)


@kernel
def update_boundary(chunk: Chunk, batch: Batch, work: PassWorkspace, mode: Mode) -> None:
    """The observer's update of x and P, and the gain kept for the next inputs."""
    form_gain(chunk, batch, work, mode)
    memory, n_x, n_e, defect = batch.memory, work.size.x, work.size.e, work.vector
    for a in range(n_x):
        for w in range(W):
            write(defect, a, w, 0.0)
        for r in range(n_e):
            for w in range(W):
                closed = at(work.gain, r, a, w) * read(work.error, r, w)
                write(defect, a, w, read(defect, a, w) - closed)
    for w in range(chunk.n_robots):
        i = chunk.robots[w]
        for a in range(n_x):
            unit = read(work.units, a, w)
            memory.x[i, a] = read(work.x, a, w) + unit * read(defect, a, w)
            memory.defect[i, a] += read(defect, a, w)
            for r in range(n_e):
                memory.gain[i, a, r] = unit * at(work.gain, r, a, w)
            if mode.propagate:
                for b in range(a + 1):
                    memory.covariance[i, a * (a + 1) // 2 + b] = at(work.covariance, a, b, w)
    if len(memory.force_before) > 0:
        _keep_force_gain(chunk, batch, work)


@kernel
def _keep_force_gain(chunk: Chunk, batch: Batch, work: PassWorkspace) -> None:
    """Keep the response of x to a tip force, beside the gain."""
    params, memory, n_x, n_e, n_col = batch.params, batch.memory, work.size.x, work.size.e, work.size.col
    for w in range(chunk.n_robots):
        i = chunk.robots[w]
        s = pick(i, len(params.rod_length))
        for a in range(n_x):
            for b in range(3):
                moved = 0.0
                for r in range(n_e):
                    moved += at(work.gain, r, a, w) * at(work.gamma, r, n_col - 3 + b, w)
                # the force columns are the follower force's; a dead force does not enter its own row
                if n_col == n_x:
                    own = at(work.gain, n_e - 3 + b, a, w)
                    moved -= own * params.rod_length[s] * params.rod_length[s] / params.moment_scale[s]
                memory.gain[i, a, n_e + b] = -read(work.units, a, w) * moved


@kernel
def correct_with_kept_gain(chunk: Chunk, batch: Batch, work: PassWorkspace) -> None:
    """The update of x by the gain of an earlier pass: Newton's method with a kept Jacobian (chord Newton)."""
    memory = batch.memory
    for w in range(chunk.n_robots):
        i = chunk.robots[w]
        s = pick(i, len(batch.params.rod_length))
        for a in range(work.size.x):
            correction = 0.0
            for r in range(work.size.e):
                correction -= memory.gain[i, a, r] * read(work.error, r, w)
            memory.x[i, a] = read(work.x, a, w) + correction
            memory.defect[i, a] += correction / unknown_unit(a, s, batch.params, batch.layout)


@kernel
def note_inputs(chunk: Chunk, batch: Batch) -> None:
    """The inputs that x belongs to from now on."""
    ports, memory, rows = batch.ports, batch.memory, batch.layout.row_tendon
    for w in range(chunk.n_robots):
        i = chunk.robots[w]
        length = ports.tendon_length[pick(i, len(ports.tendon_length))]
        for r in range(len(rows)):
            memory.length_before[i, r] = length[rows[r]]
        if len(memory.force_before) > 0:
            for a in range(3):
                memory.force_before[i, a] = ports.tip_force[pick(i, len(ports.tip_force)), a]
