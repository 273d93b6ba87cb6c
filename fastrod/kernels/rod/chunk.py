"""One forward pass of up to LANES robots: gather, march along the chain, form the residuals, update the
boundary, scatter.

Unknowns x: the total base moment m(0) (3, material frame), the tension of every free tendon, and with a
follower force its world value (3). Residuals e: tendon lengths, the tip moment (3) and the follower force
(3), all in metres: moments times l^2/EI, forces times l^3/EI. In paper mode the unknowns are (m_x, m_y) at
the base of each segment, with u_z = 0 there, and the residuals are the lengths alone (the paper's eqs. 2b and
3b).
"""

from __future__ import annotations

from fastrod.types import Layout, Memory, Params, PointLoads, Ports, Response, RodShape

from ..jit import LANES, kernel
from ..vec import mul
from . import columns as col
from . import shape as sh
from .boundary import close_lengths, close_tip, form_gain, hold_boundary, loosen, padded, update_boundary
from .gather import feed_forward, gather_base, gather_segment, gather_step, pick, scatter_node
from .observer import BLOCK
from .point_loads import arrive, leave, load_base, load_column, respond
from .shape import Lanes

W = LANES
CUTS = 2  # Newton steps on u at each stage; the guess is of second order, so little is left after the second
RESPONSE_CUTS = 5  # where derivatives are asked for: then they are those of the converged u
FIRST_CUTS = 6  # at the base, where the guess is the last pass's curvature


def scratch_size(n_tendons: int, n_x: int, n_col: int, n_e: int, n_probes: int = 0) -> int:
    """Numbers of scratch that `pass_chunk` needs."""
    n_t, n_p = n_tendons + sh.GROUP, BLOCK * -(-n_x // BLOCK)
    march = sh.NODE + 5 * sh.STAGE + n_t * (sh.TENDON + sh.PATHS + 1) + n_col * (col.COLUMN + n_t)
    touch = 3 + 3 * n_probes * (n_col + 1)
    return W * (march + 8 + n_e + n_e * n_col + n_p * n_p + 2 * n_e * n_p + n_p + 2 + 2 * n_x + touch)


@kernel
def solve_section(
    half: Lanes, stage: Lanes, tendon: Lanes, path: Lanes, first: int, n: int, loaded: bool, cuts: int
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
    for _ in range(cuts):
        sh.clear_sums(stage)
        for g in range(first, n, sh.GROUP):
            sh.tendon_sums(stage, tendon[g * sh.TENDON * W :], path[g * sh.PATHS * W :])
        sh.correct_curvature(stage, half, rest)


@kernel
def march_columns(
    k: int,
    j: int,
    n_col: int,
    n_x: int,
    placed: bool,
    layout: Layout,
    node: Lanes,
    stages: Lanes,
    paths: Lanes,
    columns: Lanes,
    change: Lanes,
    probes: PointLoads,
    first_row: int,
    count: int,
    given: Lanes,
) -> None:
    """Carry every column over step j of segment k and add its share of the tendon lengths."""
    n, first = len(layout.tendon_segment), layout.first_tendon[k]
    n_t = n + sh.GROUP
    n_base = 2 * len(layout.first_tendon) if layout.paper else 3
    n_free = len(layout.free_tendon)
    for c in range(n_col):
        if layout.paper and c < n_base and c // 2 > k:
            continue  # its segment has not begun
        tendon = layout.free_tendon[c - n_base] if n_base <= c < n_base + n_free else n
        # after the last tendon all is zero
        drive = paths[(tendon if tendon >= first else n) * sh.PATHS * W :]
        axis = c - n_base - n_free
        # R^T e_axis is a row of R
        load = node[(sh.N_R + 3 * axis) * W :] if 0 <= axis < 3 else paths[n * sh.PATHS * W :]
        if probes.node.shape[1] > 0 and c >= n_x:
            load_column(c - n_x, k * layout.n_steps + j, node, probes, first_row, count, given)
            load = given
        column = columns[c * col.COLUMN * W : (c + 1) * col.COLUMN * W]
        col.step_column(column, node, stages, drive, load)
        if placed:
            col.place_column(column, node, stages)
        for g in range(first, n, sh.GROUP):
            col.add_length_changes(change[(c * n_t + g) * W :], column, paths[g * sh.PATHS * W :])


@kernel
def load_unknowns(
    robots: Lanes, ports: Ports, params: Params, memory: Memory, layout: Layout, x: Lanes, tendon: Lanes
) -> None:
    """x of each lane, and the tensions that it means."""
    n_x = memory.x.shape[1]
    n_base = 2 * len(layout.first_tendon) if layout.paper else 3
    for w in range(W):
        i = robots[w]
        for a in range(n_x):
            x[a * W + w] = memory.x[i, a]
        given = ports.tension[pick(i, len(ports.tension))]
        for t in range(len(layout.tendon_segment)):
            tendon[(t * sh.TENDON + sh.T_T) * W + w] = 0.0 if layout.paper else given[t]
        unilateral = params.unilateral[pick(i, len(params.unilateral))]
        for f in range(len(layout.free_tendon)):
            t = layout.free_tendon[f]
            value = x[(n_base + f) * W + w]
            tendon[(t * sh.TENDON + sh.T_T) * W + w] = max(value, 0.0) if unilateral[t] else value


@kernel
def start_segment(k: int, layout: Layout, node: Lanes, x: Lanes, columns: Lanes, n_col: int) -> None:
    """The moment with which segment k begins, where it is an unknown, and its columns."""
    n_base = 2 * len(layout.first_tendon) if layout.paper else 3
    if layout.paper:
        for c in range(n_col):
            for i in range((c * col.COLUMN + col.C_M) * W, (c * col.COLUMN + col.C_M + 3) * W):
                columns[i] = 0.0
        for w in range(W):  # u_z = 0: the paper's eq. 2b
            node[sh.N_M * W + w] = x[2 * k * W + w]
            node[(sh.N_M + 1) * W + w] = x[(2 * k + 1) * W + w]
            node[(sh.N_M + 2) * W + w] = -node[(sh.N_K + 2) * W + w] * node[(sh.N_USTAR + 2) * W + w]
    elif k == 0:
        for i in range(3 * W):
            node[sh.N_M * W + i] = x[i]
    begin, end = (2 * k, 2 * k + 2) if layout.paper else (0, n_base if k == 0 else 0)
    for c in range(begin, min(end, n_col)):
        for w in range(W):
            columns[(c * col.COLUMN + col.C_M + c - begin) * W + w] = 1.0


@kernel
def write_summary(
    robots: Lanes,
    count: int,
    layout: Layout,
    node: Lanes,
    tendon: Lanes,
    length: Lanes,
    error: Lanes,
    n_e: int,
    wrench: Lanes,
    shape: RodShape,
) -> None:
    """Tip, tensions, path lengths, base wrench and the largest residual of each robot."""
    for w in range(count):
        i = robots[w]
        largest = 0.0
        for r in range(n_e):
            e = abs(error[r * W + w])
            largest = e if not e <= largest else largest  # NaN wins
        shape.residual[i] = largest
        for a in range(3):
            shape.tip_position[i, a] = node[(sh.N_POS + a) * W + w]
            for b in range(3):
                shape.tip_rotation[i, a, b] = node[(sh.N_R + 3 * a + b) * W + w]
        if len(shape.base_wrench) > 0:
            for a in range(6):
                shape.base_wrench[i, a] = wrench[a * W + w]
        if len(shape.tension) > 0:
            for t in range(len(layout.tendon_segment)):
                shape.tension[i, t] = tendon[(t * sh.TENDON + sh.T_T) * W + w]
                shape.path_length[i, t] = length[t * W + w]


@kernel
def write_response(
    robots: Lanes,
    count: int,
    node: Lanes,
    columns: Lanes,
    error: Lanes,
    gamma: Lanes,
    n_col: int,
    n_e: int,
    response: Response,
) -> None:
    """Residuals, and the change of residuals and tip by each column; a column has the tip's turn in the tip's
    frame, `response` in the world's."""
    for w in range(count):
        i = robots[w]
        rotation = sh.get_mat(node, sh.N_R, w)
        for c in range(n_col):
            turn = mul(rotation, sh.get(columns, c * col.COLUMN + col.C_PHI, w))
            for r in range(n_e):
                response.residual[i, r, c] = gamma[(r * n_col + c) * W + w]
            for a in range(3):
                response.tip[i, a, c] = columns[(c * col.COLUMN + col.C_POS + a) * W + w]
                response.tip[i, 3 + a, c] = turn[a]
        for r in range(n_e):
            response.error[i, r] = error[r * W + w]


@kernel
def add_base_moment(node: Lanes, wrench: Lanes, sign: float) -> None:
    """Moment at the node, world frame, added to the base moment."""
    for w in range(W):
        m = mul(sh.get_mat(node, sh.N_R, w), sh.get(node, sh.N_M, w))
        for a in range(3):
            wrench[(3 + a) * W + w] += sign * m[a]


@kernel
def pass_chunk(
    robots: Lanes,
    count: int,
    params: Params,
    ports: Ports,
    layout: Layout,
    memory: Memory,
    shape: RodShape,
    response: Response,
    probes: PointLoads,
    first_row: int,
    scratch: Lanes,
    n_col: int,
    feed: bool,
    carry: bool,
    update: bool,
    process: float,
    noise: float,
) -> None:
    """One observer pass of the robots whose indices are the first `count` of `robots` (the rest repeat the
    last one).

    Without columns (`n_col` 0) the update is by the gain that the robot has. With probes (the rows from
    `first_row` on are these robots') the boundary is not updated: how it would be, and how the contact points
    then move, is written to the probes.
    """
    n, n_x, n_rows = len(layout.tendon_segment), memory.x.shape[1], len(layout.row_tendon)
    n_segments, n_steps = params.length.shape[1], layout.n_steps
    n_e = n_rows + (0 if layout.paper else 3) + (3 if len(ports.follower_force) > 0 else 0)
    n_t, n_p = n + sh.GROUP, padded(n_x, BLOCK)
    dense, placed = len(shape.position) > 0, len(response.tip) > 0

    o = 0
    node, o = scratch[o : o + sh.NODE * W], o + sh.NODE * W
    stages, o = scratch[o : o + 5 * sh.STAGE * W], o + 5 * sh.STAGE * W
    tendon, o = scratch[o : o + n_t * sh.TENDON * W], o + n_t * sh.TENDON * W
    paths, o = scratch[o : o + n_t * sh.PATHS * W], o + n_t * sh.PATHS * W
    length, o = scratch[o : o + n_t * W], o + n_t * W
    columns, o = scratch[o : o + n_col * col.COLUMN * W], o + n_col * col.COLUMN * W
    change, o = scratch[o : o + n_col * n_t * W], o + n_col * n_t * W
    x, o = scratch[o : o + n_x * W], o + n_x * W
    error, o = scratch[o : o + n_e * W], o + n_e * W
    wrench, o = scratch[o : o + 6 * W], o + 6 * W
    s, o = scratch[o : o + W], o + W
    gamma, o = scratch[o : o + n_e * n_col * W], o + n_e * n_col * W
    P, o = scratch[o : o + n_p * n_p * W], o + n_p * n_p * W
    G, o = scratch[o : o + n_e * n_p * W], o + n_e * n_p * W
    scaled, o = scratch[o : o + n_e * n_p * W], o + n_e * n_p * W
    n_probes = probes.node.shape[1]
    given, o = scratch[o : o + 3 * W], o + 3 * W
    moves, o = scratch[o : o + 3 * n_probes * n_col * W], o + 3 * n_probes * n_col * W
    work = scratch[o:]

    at_start, at_middle, at_end = node[sh.N_K * W :], node[(sh.N_K + 3) * W :], node[(sh.N_K + 6) * W :]
    varied = (
        ports.stiffness.shape[2] > 1
        or ports.line_force.shape[2] > 1
        or len(ports.grid) > 0
        or len(ports.node_force) > 0
    )
    first_cuts, cuts = FIRST_CUTS, RESPONSE_CUTS if placed else CUTS
    for i in range(len(length)):
        length[i] = 0.0
    for i in range(len(columns)):
        columns[i] = 0.0
    for i in range(len(change)):
        change[i] = 0.0
    for i in range(len(paths)):
        paths[i] = 0.0
    for i in range(len(tendon)):
        tendon[i] = 0.0
    for i in range(len(moves)):
        moves[i] = 0.0
    if feed:
        feed_forward(robots, count, ports, params, memory, layout)
    load_unknowns(robots, ports, params, memory, layout, x, tendon)
    gather_base(robots, ports, params, memory, layout, node, x)
    if n_probes > 0:
        load_base(probes, first_row, count, node)
    for w in range(W):
        s[w] = 0.0
        for a in range(3):
            wrench[a * W + w] = node[(sh.N_N + a) * W + w]
            wrench[(3 + a) * W + w] = 0.0

    for k in range(n_segments):
        first = layout.first_tendon[k]
        loaded = first < n and not layout.paper
        gather_segment(k, robots, params, layout, tendon)
        for j in range(n_steps):
            if j == 0 or varied:
                gather_step(k, j, robots, ports, params, layout, node)
            if j == 0:
                start_segment(k, layout, node, x, columns, n_col)
                if k == 0 or layout.paper:
                    add_base_moment(node, wrench, 1.0)
            if n_probes > 0:
                leave(k * n_steps + j, probes, first_row, count, node, columns, n_x, n_col)
            sh.start_step(node, stages)
            solve_section(at_start, stages, tendon, paths, first, n, loaded, first_cuts if j == 0 else cuts)
            if j == 0 or dense:
                for i in range(3 * W):
                    node[sh.N_U * W + i] = stages[sh.S_U * W + i]
            if j == 0 and k == 0:
                for w in range(count):
                    for a in range(3):
                        memory.curvature_guess[robots[w], a] = node[(sh.N_U + a) * W + w]
            if dense:
                scatter_node(k * n_steps + j, count, robots, node, s, shape)
            sh.second_stage(node, stages)
            solve_section(
                at_middle, stages[sh.STAGE * W :], tendon, paths[sh.PATH * W :], first, n, loaded, cuts
            )
            sh.third_stage(node, stages)
            solve_section(
                at_middle,
                stages[2 * sh.STAGE * W :],
                tendon,
                paths[2 * sh.PATH * W :],
                first,
                n,
                loaded,
                cuts,
            )
            sh.fourth_stage(node, stages)
            solve_section(
                at_end, stages[3 * sh.STAGE * W :], tendon, paths[3 * sh.PATH * W :], first, n, loaded, cuts
            )
            sh.end_step(node, stages)
            for g in range(first, n, sh.GROUP):
                sh.add_lengths(length[g * W :], node, paths[g * sh.PATHS * W :])
            if update or placed or n_probes > 0:
                march_columns(
                    k,
                    j,
                    n_col,
                    n_x,
                    placed or n_probes > 0,
                    layout,
                    node,
                    stages,
                    paths,
                    columns,
                    change,
                    probes,
                    first_row,
                    count,
                    given,
                )
            sh.advance(node, stages)
            if n_probes > 0:
                arrive(k * n_steps + j + 1, probes, first_row, count, node, columns, n_col, moves)
            for w in range(W):
                s[w] += node[sh.N_H * W + w]
        if layout.paper:
            add_base_moment(node, wrench, -1.0)
    if n_probes > 0:
        leave(n_segments * n_steps, probes, first_row, count, node, columns, n_x, n_col)
    if dense:
        sh.start_step(node, stages)
        first = layout.first_tendon[n_segments - 1]
        solve_section(
            at_end, stages, tendon, paths, first, n, first < n and not layout.paper, first_cuts + cuts
        )
        for i in range(3 * W):
            node[sh.N_U * W + i] = stages[sh.S_U * W + i]
        scatter_node(n_segments * n_steps, count, robots, node, s, shape)

    close_lengths(robots, ports, params, layout, x, length, change, n_col, error, gamma)
    if not layout.paper:
        close_tip(robots, ports, params, node, x, columns, n_x, n_col, n_rows, error, gamma)
        loosen(robots, params, layout, x, columns, n_col, n_e, gamma)
    if layout.paper:
        for w in range(W):
            tip_moment = ports.tip_moment[pick(robots[w], len(ports.tip_moment))]
            for a in range(3):
                wrench[(3 + a) * W + w] += tip_moment[a]
    write_summary(robots, count, layout, node, tendon, length, error, n_e, wrench, shape)
    if placed:
        write_response(robots, count, node, columns, error, gamma, n_col, n_e, response)
    if n_probes > 0:
        form_gain(
            robots, params, memory, layout, gamma, n_col, n_e, P, G, scaled, work, process, noise, carry
        )
        respond(
            robots,
            count,
            params,
            memory,
            layout,
            x,
            error,
            gamma,
            G,
            work[(n_p + 2) * W :],
            n_col,
            n_e,
            n_p,
            moves,
            probes,
            first_row,
        )
    elif update:
        if n_col > 0:
            update_boundary(
                robots,
                count,
                params,
                memory,
                layout,
                x,
                error,
                gamma,
                n_col,
                n_e,
                P,
                G,
                scaled,
                work,
                process,
                noise,
                carry,
            )
        else:
            hold_boundary(robots, count, params, memory, layout, x, error, n_e)
        for w in range(count):
            i = robots[w]
            for r in range(n_rows):
                memory.length_before[i, r] = ports.tendon_length[
                    pick(i, len(ports.tendon_length)), layout.row_tendon[r]
                ]
            if len(memory.force_before) > 0:
                for a in range(3):
                    memory.force_before[i, a] = ports.tip_force[pick(i, len(ports.tip_force)), a]
