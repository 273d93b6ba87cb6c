"""Cross-sections between the nodes: one shortened step from the node before, LANES queries side by side."""

from __future__ import annotations

import numpy as np

from fastrod.types import Floats, Layout, Params, Ports, RodShape

from ..jit import entry, kernel
from . import shape as sh
from .chunk import FIRST_ITERATIONS, finish_stages, solve_section
from .gather import RodLanes, pick, scatter
from .lanes import Lanes, W, get, get_mat, write


@kernel
def _node_before(
    lane: int, i: int, s: float, layout: Layout, shape: RodShape, rod: RodLanes
) -> tuple[int, float]:
    """Put the node before arclength s of robot i, and the step from there to s, into a lane; its number, and
    the fraction of the whole step."""
    n_points, node = shape.arclength.shape[1], rod.node
    past = int(np.searchsorted(shape.arclength[i], s * (1.0 + 1e-13), side="right"))
    at = min(max(past - 1, 0), n_points - 2)
    whole, h = shape.arclength[i, at + 1] - shape.arclength[i, at], s - shape.arclength[i, at]
    write(node, sh.N_H, lane, h)
    for a in range(3):
        write(node, sh.N_POS + a, lane, shape.position[i, at, a])
        write(node, sh.N_M + a, lane, shape.moment[i, at, a])
        write(node, sh.N_N + a, lane, shape.force[i, at, a])
        write(node, sh.N_U + a, lane, shape.curvature[i, at, a])
        for b in range(3):
            write(node, sh.N_R + 3 * a + b, lane, shape.rotation[i, at, a, b])
    for t in range(len(layout.tendon_segment)):
        crosses = t >= layout.first_tendon[at // layout.n_steps]
        write(rod.tendon, t * sh.TENDON + sh.T_T, lane, shape.tension[i, t] if crosses else 0.0)
    return at, h / whole


@kernel
def _loads_of_step(
    lane: int, i: int, at: int, fraction: float, params: Params, ports: Ports, layout: Layout, rod: RodLanes
) -> None:
    """Put the loads and stiffness of the step from node `at`, shortened to a fraction, into a lane."""
    node, k, j = rod.node, at // layout.n_steps, at % layout.n_steps
    line = ports.line_force[pick(i, len(ports.line_force)), k]
    stiffness = ports.stiffness[pick(i, len(ports.stiffness)), k]
    rest = ports.precurvature[pick(i, len(ports.precurvature)), k]
    many, sampled = line.shape[0] > 1, stiffness.shape[0] > 1
    for a in range(3):
        f0, f1 = line[2 * j if many else 0, a], line[2 * j + 1 if many else 0, a]
        write(node, sh.N_F0 + a, lane, f0)
        write(node, sh.N_F1 + a, lane, f0 + fraction * (f1 - f0))
        for half in range(3):
            where = fraction * half  # in half steps from the node
            low = min(int(where), 1) if sampled else 0
            base = 2 * j + low if sampled else 0
            up = base + 1 if sampled else 0
            K = stiffness[base, a] + (where - low) * (stiffness[up, a] - stiffness[base, a])
            u_star = rest[base, a] + (where - low) * (rest[up, a] - rest[base, a])
            write(node, sh.N_K + 3 * half + a, lane, K)
            write(node, sh.N_USTAR + 3 * half + a, lane, u_star)
    offset = params.offset[pick(i, len(params.offset)), k]
    for t in range(len(layout.tendon_segment)):
        crosses = t >= layout.first_tendon[k]
        write(rod.tendon, t * sh.TENDON + sh.T_DX, lane, offset[t, 0] if crosses else 0.0)
        write(rod.tendon, t * sh.TENDON + sh.T_DY, lane, offset[t, 1] if crosses else 0.0)


@entry
def between_nodes(
    robots: Lanes,
    queries: Lanes,
    s: Floats,
    params: Params,
    ports: Ports,
    layout: Layout,
    shape: RodShape,
    found: tuple[Floats, Floats, Floats],
) -> None:
    """Pose and curvature of query `queries[q]` of robot `robots[q]`, at arclength s[robot, query]."""
    n = len(layout.tendon_segment)
    n_t = n + sh.GROUP
    node, stages = np.zeros(sh.NODE * W), np.zeros(5 * sh.STAGE * W)
    tendon, path = np.zeros(n_t * sh.TENDON * W), np.zeros(n_t * sh.PATHS * W)
    rod = RodLanes(node, stages, tendon, path)
    loaded = n > 0 and not layout.paper
    begin, end = node[sh.N_K * W :], node[(sh.N_K + 6) * W :]
    for start in range(0, len(robots), W):
        count = min(W, len(robots) - start)
        for w in range(W):
            q = start + min(w, count - 1)
            at, fraction = _node_before(w, robots[q], s[robots[q], queries[q]], layout, shape, rod)
            _loads_of_step(w, robots[q], at, fraction, params, ports, layout, rod)
        sh.start_step(node, stages)
        solve_section(begin, stages, tendon, path, 0, n, loaded, FIRST_ITERATIONS)
        finish_stages(rod, 0, n, loaded, FIRST_ITERATIONS)
        sh.advance(node, stages)
        sh.start_step(node, stages)
        solve_section(end, stages, tendon, path, 0, n, loaded, FIRST_ITERATIONS)
        for w in range(count):
            i, q = robots[start + w], queries[start + w]
            scatter(found[0][i, q], get(node, sh.N_POS, w))
            scatter(found[2][i, q], get(stages, sh.S_U, w))
            m = get_mat(node, sh.N_R, w)
            for a in range(3):
                scatter(found[1][i, q, a], (m[3 * a], m[3 * a + 1], m[3 * a + 2]))
