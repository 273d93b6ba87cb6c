"""Cross-sections between the nodes: one shortened step from the node before, LANES queries side by side."""

from __future__ import annotations

import numpy as np

from fastrod.types import Floats, Layout, Params, Ports, RodShape

from ..jit import LANES, entry, kernel
from . import shape as sh
from .chunk import FIRST_CUTS, solve_section
from .gather import pick
from .shape import Lanes

W = LANES


@kernel
def _fill(
    lane: int,
    i: int,
    s: float,
    params: Params,
    ports: Ports,
    layout: Layout,
    shape: RodShape,
    node: Lanes,
    tendon: Lanes,
) -> None:
    """Put the node before arclength s of robot i, and the step from there to s, into a lane."""
    arclength, position, rotation, tension = shape.arclength, shape.position, shape.rotation, shape.tension
    moment, force, curvature = shape.moment, shape.force, shape.curvature
    n_steps, n_points = layout.n_steps, arclength.shape[1]
    at = min(max(np.searchsorted(arclength[i], s * (1.0 + 1e-13), side="right") - 1, 0), n_points - 2)
    k, j = at // n_steps, at % n_steps
    whole, h = arclength[i, at + 1] - arclength[i, at], s - arclength[i, at]
    part = h / whole
    node[sh.N_H * W + lane] = h
    for a in range(3):
        node[(sh.N_POS + a) * W + lane] = position[i, at, a]
        node[(sh.N_M + a) * W + lane] = moment[i, at, a]
        node[(sh.N_N + a) * W + lane] = force[i, at, a]
        node[(sh.N_U + a) * W + lane] = curvature[i, at, a]
        for b in range(3):
            node[(sh.N_R + 3 * a + b) * W + lane] = rotation[i, at, a, b]
        line = ports.line_force[pick(i, len(ports.line_force)), k]
        many = line.shape[0] > 1
        f0, f1 = line[2 * j if many else 0, a], line[2 * j + 1 if many else 0, a]
        node[(sh.N_F0 + a) * W + lane] = f0
        node[(sh.N_F1 + a) * W + lane] = f0 + part * (f1 - f0)
        stiffness = ports.stiffness[pick(i, len(ports.stiffness)), k]
        rest = ports.precurvature[pick(i, len(ports.precurvature)), k]
        for half in range(3):
            where = part * half  # in half steps from the node
            low = min(int(where), 1) if stiffness.shape[0] > 1 else 0
            base = 2 * j + low if stiffness.shape[0] > 1 else 0
            up = base + 1 if stiffness.shape[0] > 1 else 0
            node[(sh.N_K + 3 * half + a) * W + lane] = stiffness[base, a] + (where - low) * (
                stiffness[up, a] - stiffness[base, a]
            )
            node[(sh.N_USTAR + 3 * half + a) * W + lane] = rest[base, a] + (where - low) * (
                rest[up, a] - rest[base, a]
            )
    offset = params.offset[pick(i, len(params.offset)), k]
    for t in range(len(layout.tendon_segment)):
        crosses = t >= layout.first_tendon[k]
        tendon[(t * sh.TENDON + sh.T_DX) * W + lane] = offset[t, 0] if crosses else 0.0
        tendon[(t * sh.TENDON + sh.T_DY) * W + lane] = offset[t, 1] if crosses else 0.0
        tendon[(t * sh.TENDON + sh.T_T) * W + lane] = tension[i, t] if crosses else 0.0


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
    loaded = n > 0 and not layout.paper
    at_start, at_middle, at_end = node[sh.N_K * W :], node[(sh.N_K + 3) * W :], node[(sh.N_K + 6) * W :]
    for start in range(0, len(robots), W):
        count = min(W, len(robots) - start)
        for w in range(W):
            q = start + min(w, count - 1)
            _fill(w, robots[q], s[robots[q], queries[q]], params, ports, layout, shape, node, tendon)
        sh.start_step(node, stages)
        solve_section(at_start, stages, tendon, path, 0, n, loaded, FIRST_CUTS)
        sh.second_stage(node, stages)
        solve_section(at_middle, stages[sh.STAGE * W :], tendon, path, 0, n, loaded, FIRST_CUTS)
        sh.third_stage(node, stages)
        solve_section(at_middle, stages[2 * sh.STAGE * W :], tendon, path, 0, n, loaded, FIRST_CUTS)
        sh.fourth_stage(node, stages)
        solve_section(at_end, stages[3 * sh.STAGE * W :], tendon, path, 0, n, loaded, FIRST_CUTS)
        sh.end_step(node, stages)
        sh.advance(node, stages)
        sh.start_step(node, stages)
        solve_section(at_end, stages, tendon, path, 0, n, loaded, FIRST_CUTS)
        for w in range(count):
            i, q = robots[start + w], queries[start + w]
            for a in range(3):
                found[0][i, q, a] = node[(sh.N_POS + a) * W + w]
                found[2][i, q, a] = stages[(sh.S_U + a) * W + w]
                for b in range(3):
                    found[1][i, q, a, b] = node[(sh.N_R + 3 * a + b) * W + w]
