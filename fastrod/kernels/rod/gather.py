"""Between the arrays of a batch (robot axis first) and the buffers of one chunk (lanes last)."""

from __future__ import annotations

from fastrod.types import Floats, Layout, Memory, Params, Ports, RodShape

from ..jit import inline, kernel
from ..vec import Vec, from_quaternion
from . import shape as sh
from .lanes import Lanes, W, get, get_mat, put, put_mat, read, write


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
