"""One forward pass of up to LANES robots: gather, march along the rod, form the residuals, update the
boundary, scatter.

Unknowns x: the total base moment m(0) (3, material frame), the tension of every free tendon, and with a
follower force its world value (3). Residuals e: tendon lengths, the tip moment (3) and the follower force
(3), all in metres: moments times l^2/EI, forces times l^3/EI. In paper mode the unknowns are (m_x, m_y) at
the base of each segment, with u_z = 0 there, and the residuals are the lengths alone (the paper's eqs. 2b and
3b).
"""

from __future__ import annotations

from fastrod.types import Layout, Ports

from ..jit import inline, kernel
from ..vec import mul
from . import columns as col
from . import shape as sh
from .boundary import (
    close_lengths,
    close_tip,
    correct_with_kept_gain,
    note_inputs,
    release_slack_tendons,
    update_boundary,
)
from .gather import (
    Batch,
    Chunk,
    Mode,
    Output,
    PassWorkspace,
    RodLanes,
    Sensitivities,
    carve,
    gather_base,
    gather_segment,
    gather_step,
    pick,
    predict,
    scatter,
    scatter_node,
    scratch_size,
    sizes,
)
from .lanes import Lanes, W, at, clear, get, get_mat, put, read, write

__all__ = ["Batch", "Chunk", "Mode", "Output", "pass_chunk", "scratch_size"]
ITERATIONS = (
    2  # Newton steps on u at each stage; the guess is of second order, so little is left after the second
)
RESPONSE_ITERATIONS = 5  # where derivatives are wanted: then they are those of the converged u
FIRST_ITERATIONS = 6  # at the base, where the guess is the last pass's curvature


@kernel
def solve_section(
    half: Lanes, stage: Lanes, tendon: Lanes, path: Lanes, first: int, n: int, loaded: bool, iterations: int
) -> None:
    """Curvature of a stage from its moment, and the paths of the tendons that cross it.

    `half`: K there, and u* three half steps further on, a view into the node.
    """
    rest = half[(sh.N_USTAR - sh.N_K) * W :]
    if not loaded:
        sh.curvature_without_tendons(stage, half, rest)
        for g in range(first, n, sh.GROUP):
            sh.tendon_paths(stage, tendon[g * sh.TENDON * W :], path[g * sh.PATHS * W :])
        return
    for _ in range(iterations):
        sh.clear_sums(stage)
        for g in range(first, n, sh.GROUP):
            sh.tendon_sums(stage, tendon[g * sh.TENDON * W :], path[g * sh.PATHS * W :])
        sh.correct_curvature(stage, half, rest)


@inline
def finish_stages(rod: RodLanes, first: int, n: int, loaded: bool, iterations: int) -> None:
    """Stages two to four of a step whose first one is solved, and its end."""
    node, stages, tendon, paths = rod
    middle, end = node[(sh.N_K + 3) * W :], node[(sh.N_K + 6) * W :]
    sh.second_stage(node, stages)
    solve_section(middle, stages[sh.STAGE * W :], tendon, paths[sh.PATH * W :], first, n, loaded, iterations)
    sh.third_stage(node, stages)
    solve_section(
        middle, stages[2 * sh.STAGE * W :], tendon, paths[2 * sh.PATH * W :], first, n, loaded, iterations
    )
    sh.fourth_stage(node, stages)
    solve_section(
        end, stages[3 * sh.STAGE * W :], tendon, paths[3 * sh.PATH * W :], first, n, loaded, iterations
    )
    sh.end_step(node, stages)


@kernel
def march_columns(k: int, with_positions: bool, layout: Layout, rod: RodLanes, sens: Sensitivities) -> None:
    """Move every column over step j of segment k and add its part of the tendon lengths."""
    node, stages, _, paths = rod
    change = sens.change
    n, first = len(layout.tendon_segment), layout.first_tendon[k]
    n_base = 2 * len(layout.first_tendon) if layout.paper else 3
    n_free = len(layout.free_tendon)
    nothing = paths[n * sh.PATHS * W :]  # after the last tendon all is zero
    for c in range(sens.n_col):
        if layout.paper and c < n_base and c // 2 > k:
            continue  # its segment has not begun
        tendon = layout.free_tendon[c - n_base] if n_base <= c < n_base + n_free else n
        drive = paths[((tendon if tendon >= first else n) * sh.PATHS) * W :]
        axis = c - n_base - n_free
        # R^T e_axis is a row of R
        load = node[(sh.N_R + 3 * axis) * W :] if 0 <= axis < 3 else nothing
        column = sens.columns[c * col.COLUMN * W :]
        col.step_column(column, node, stages, drive, load)
        if with_positions:
            col.column_position(column, node, stages)
        for g in range(first, n, sh.GROUP):
            col.add_length_changes(
                change.entries[(c * change.n_columns + g) * W :], column, paths[g * sh.PATHS * W :]
            )


@kernel
def load_unknowns(chunk: Chunk, batch: Batch, x: Lanes, tendon: Lanes) -> None:
    """x of each lane, and the tensions that it means."""
    params, ports, layout, memory = batch
    n_base = 2 * len(layout.first_tendon) if layout.paper else 3
    for w in range(W):
        i = chunk.robots[w]
        for a in range(memory.x.shape[1]):
            write(x, a, w, memory.x[i, a])
        given = ports.tension[pick(i, len(ports.tension))]
        for t in range(len(layout.tendon_segment)):
            write(tendon, t * sh.TENDON + sh.T_T, w, 0.0 if layout.paper else given[t])
        unilateral = params.unilateral[pick(i, len(params.unilateral))]
        for f in range(len(layout.free_tendon)):
            t = layout.free_tendon[f]
            value = read(x, n_base + f, w)
            write(tendon, t * sh.TENDON + sh.T_T, w, max(value, 0.0) if unilateral[t] else value)


@kernel
def start_segment(k: int, layout: Layout, node: Lanes, x: Lanes, columns: Lanes, n_col: int) -> None:
    """The moment with which segment k begins, where it is an unknown, and its columns."""
    n_base = 2 * len(layout.first_tendon) if layout.paper else 3
    if layout.paper:
        for c in range(n_col):
            for w in range(W):
                put(columns, c * col.COLUMN + col.C_M, w, (0.0, 0.0, 0.0))
        for w in range(W):  # u_z = 0: the paper's eq. 2b
            axial = -read(node, sh.N_K + 2, w) * read(node, sh.N_USTAR + 2, w)
            put(node, sh.N_M, w, (read(x, 2 * k, w), read(x, 2 * k + 1, w), axial))
    elif k == 0:
        for w in range(W):
            put(node, sh.N_M, w, get(x, 0, w))
    begin, end = (2 * k, 2 * k + 2) if layout.paper else (0, n_base if k == 0 else 0)
    for c in range(begin, min(end, n_col)):
        for w in range(W):
            write(columns, c * col.COLUMN + col.C_M + c - begin, w, 1.0)


@inline
def _is_varied(ports: Ports) -> bool:
    """Every step has numbers of its own."""
    varied = ports.stiffness.shape[2] > 1 or ports.line_force.shape[2] > 1
    return varied or len(ports.grid) > 0 or len(ports.node_force) > 0


@kernel
def _keep_curvature(rod: RodLanes) -> None:
    """u at the start of the step into the node."""
    for w in range(W):
        put(rod.node, sh.N_U, w, get(rod.stages, sh.S_U, w))


@kernel
def add_base_moment(node: Lanes, wrench: Lanes, sign: float) -> None:
    """Moment at the node, world frame, added to the base moment."""
    for w in range(W):
        m = mul(get_mat(node, sh.N_R, w), get(node, sh.N_M, w))
        for a in range(3):
            write(wrench, 3 + a, w, read(wrench, 3 + a, w) + sign * m[a])


@inline
def march(chunk: Chunk, batch: Batch, output: Output, work: PassWorkspace, mode: Mode) -> None:
    """Integrate from base to tip: the rod, the tendons' lengths and the columns."""
    params, ports, layout, memory = batch
    rod, sens, n = work.rod, work.sens, work.size.tendons
    node, start = rod.node, rod.node[sh.N_K * W :]
    dense, differentiated = len(output.shape.position) > 0, len(output.response.tip) > 0
    varied, iterations = _is_varied(ports), RESPONSE_ITERATIONS if differentiated else ITERATIONS
    for k in range(params.length.shape[1]):
        first = layout.first_tendon[k]
        pulled = first < n and not layout.paper
        gather_segment(k, chunk.robots, params, layout, rod.tendon)
        for j in range(layout.n_steps):
            at_node = k * layout.n_steps + j
            if j == 0 or varied:
                gather_step(k, j, chunk.robots, ports, params, layout, node)
            if j == 0:
                start_segment(k, layout, node, work.x, sens.columns, mode.n_col)
                if k == 0 or layout.paper:
                    add_base_moment(node, work.wrench, 1.0)
            sh.start_step(node, rod.stages)
            own = FIRST_ITERATIONS if j == 0 else iterations
            solve_section(start, rod.stages, rod.tendon, rod.paths, first, n, pulled, own)
            if j == 0 or dense:
                _keep_curvature(rod)
            if j == 0 and k == 0:
                for w in range(chunk.n_robots):
                    scatter(memory.curvature_guess[chunk.robots[w]], get(node, sh.N_U, w))
            if dense:
                scatter_node(at_node, chunk.n_robots, chunk.robots, node, work.s, output.shape)
            finish_stages(rod, first, n, pulled, iterations)
            for g in range(first, n, sh.GROUP):
                sh.add_lengths(work.length[g * W :], node, rod.paths[g * sh.PATHS * W :])
            if mode.update or differentiated:
                march_columns(k, differentiated, layout, rod, sens)
            sh.advance(node, rod.stages)
            for w in range(W):
                write(work.s, 0, w, read(work.s, 0, w) + read(node, sh.N_H, w))
        if layout.paper:
            add_base_moment(node, work.wrench, -1.0)


@inline
def finish_tip(chunk: Chunk, batch: Batch, output: Output, work: PassWorkspace) -> None:
    """Add what lies beyond the last step: loads on the tip, and the cross-section there."""
    params, layout, rod = batch.params, batch.layout, work.rod
    n, n_segments = work.size.tendons, params.length.shape[1]
    tip = n_segments * layout.n_steps
    if len(output.shape.position) > 0:
        first, end = layout.first_tendon[n_segments - 1], rod.node[(sh.N_K + 6) * W :]
        iterations = RESPONSE_ITERATIONS if len(output.response.tip) > 0 else ITERATIONS
        sh.start_step(rod.node, rod.stages)
        pulled = first < n and not layout.paper
        solve_section(end, rod.stages, rod.tendon, rod.paths, first, n, pulled, FIRST_ITERATIONS + iterations)
        _keep_curvature(rod)
        scatter_node(tip, chunk.n_robots, chunk.robots, rod.node, work.s, output.shape)


@kernel
def close(chunk: Chunk, batch: Batch, work: PassWorkspace) -> None:
    """The residuals with their derivatives, and the wrench on the base."""
    ports = batch.ports
    close_lengths(chunk, batch, work)
    if not batch.layout.paper:
        close_tip(chunk, batch, work)
        release_slack_tendons(chunk, batch, work)
    else:
        for w in range(W):
            tip_moment = ports.tip_moment[pick(chunk.robots[w], len(ports.tip_moment))]
            for a in range(3):
                write(work.wrench, 3 + a, w, read(work.wrench, 3 + a, w) + tip_moment[a])


@kernel
def write_summary(chunk: Chunk, output: Output, work: PassWorkspace) -> None:
    """Tip, tensions, path lengths, base wrench and the largest residual of each robot."""
    shape, node = output.shape, work.rod.node
    for w in range(chunk.n_robots):
        i = chunk.robots[w]
        largest = 0.0
        for r in range(work.size.e):
            e = abs(read(work.error, r, w))
            largest = e if not e <= largest else largest  # NaN wins
        shape.residual[i] = largest
        for a in range(3):
            shape.tip_position[i, a] = read(node, sh.N_POS + a, w)
            for b in range(3):
                shape.tip_rotation[i, a, b] = read(node, sh.N_R + 3 * a + b, w)
        if len(shape.base_wrench) > 0:
            for a in range(6):
                shape.base_wrench[i, a] = read(work.wrench, a, w)
        if len(shape.tension) > 0:
            for t in range(work.size.tendons):
                shape.tension[i, t] = read(work.rod.tendon, t * sh.TENDON + sh.T_T, w)
                shape.path_length[i, t] = read(work.length, t, w)


@kernel
def write_response(chunk: Chunk, output: Output, work: PassWorkspace) -> None:
    """Residuals, and the change of residuals and tip by each column; a column has the tip's rotation in the
    tip's frame, `response` in the world's."""
    response, columns = output.response, work.sens.columns
    for w in range(chunk.n_robots):
        i = chunk.robots[w]
        rotation = get_mat(work.rod.node, sh.N_R, w)
        for c in range(work.size.col):
            angle = mul(rotation, get(columns, c * col.COLUMN + col.C_PHI, w))
            for r in range(work.size.e):
                response.residual[i, r, c] = at(work.gamma, r, c, w)
            for a in range(3):
                response.tip[i, a, c] = read(columns, c * col.COLUMN + col.C_POS + a, w)
                response.tip[i, 3 + a, c] = angle[a]
        for r in range(work.size.e):
            response.error[i, r] = read(work.error, r, w)


@kernel
def pass_chunk(chunk: Chunk, batch: Batch, output: Output, scratch: Lanes, mode: Mode) -> None:
    """One observer pass of the robots of a chunk."""
    params, ports, layout, memory = batch
    work = carve(scratch, sizes(batch, mode.n_col))
    if mode.predict:
        predict(chunk.robots, chunk.n_robots, ports, params, memory, layout)
    load_unknowns(chunk, batch, work.x, work.rod.tendon)
    gather_base(chunk.robots, ports, params, memory, layout, work.rod.node, work.x)
    clear(work.s)
    clear(work.wrench)
    for w in range(W):
        put(work.wrench, 0, w, get(work.rod.node, sh.N_N, w))
    march(chunk, batch, output, work, mode)
    finish_tip(chunk, batch, output, work)
    close(chunk, batch, work)
    write_summary(chunk, output, work)
    if len(output.response.tip) > 0:
        write_response(chunk, output, work)
    if mode.update:
        if mode.n_col > 0:
            update_boundary(chunk, batch, work, mode)
        else:
            correct_with_kept_gain(chunk, batch, work)
        note_inputs(chunk, batch)
