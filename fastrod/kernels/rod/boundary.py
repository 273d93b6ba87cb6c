"""The boundary of a chain: its residuals with their derivatives, and the observer's update of the unknowns.

Residuals are lengths in metres: tendon lengths as they are, moments times l^2/EI, forces times l^3/EI.
"""

from __future__ import annotations

from fastrod.types import Layout, Memory, Params, Ports

from ..jit import LANES, inline, kernel
from ..vec import cross, mul, mul_t, sub
from . import columns as col
from . import shape as sh
from .gather import pick, unknown_unit
from .observer import BLOCK, gain
from .shape import Lanes

W = LANES


@inline
def padded(n: int, block: int) -> int:
    """n rounded up to a multiple of `block`."""
    return block * ((n + block - 1) // block)


@kernel
def close_lengths(
    robots: Lanes,
    ports: Ports,
    params: Params,
    layout: Layout,
    x: Lanes,
    length: Lanes,
    change: Lanes,
    n_col: int,
    error: Lanes,
    gamma: Lanes,
) -> None:
    """l_i - L_i - c_i (T_i - T0_i) and its derivatives, one row for each commanded tendon."""
    n_t, n_rows, n_free = (
        len(layout.tendon_segment) + sh.GROUP,
        len(layout.row_tendon),
        len(layout.free_tendon),
    )
    n_base = 2 * len(layout.first_tendon) if layout.paper else 3
    for r in range(n_rows):
        t = layout.row_tendon[r]
        for w in range(W):
            i = robots[w]
            error[r * W + w] = length[t * W + w] - ports.tendon_length[pick(i, len(ports.tendon_length)), t]
        for c in range(n_col):
            for w in range(W):
                gamma[(r * n_col + c) * W + w] = change[(c * n_t + t) * W + w]
    for f in range(n_free):
        t = layout.free_tendon[f]
        for w in range(W):
            i = robots[w]
            compliance = params.compliance[pick(i, len(params.compliance)), t]
            value = x[(n_base + f) * W + w]
            # a slack wire's unknown is no tension but a measure of how loose it hangs; d/T as slope is about
            # a taut wire's
            s = pick(i, len(params.reach))
            slope = max(
                compliance, params.moment_scale[s] / (params.tension_scale[s] * params.tension_scale[s])
            )
            stretch = (
                slope if value < 0.0 and params.unilateral[pick(i, len(params.unilateral)), t] else compliance
            )
            error[f * W + w] -= (
                stretch * value - compliance * params.pretension[pick(i, len(params.pretension)), t]
            )
            if n_col > 0:
                gamma[(f * n_col + n_base + f) * W + w] -= stretch


@kernel
def close_tip(
    robots: Lanes,
    ports: Ports,
    params: Params,
    node: Lanes,
    x: Lanes,
    columns: Lanes,
    n_x: int,
    n_col: int,
    row: int,
    error: Lanes,
    gamma: Lanes,
) -> None:
    """m - R^T M_tip, and with a follower force F - R F_material, as lengths, with their derivatives."""
    follower = len(ports.follower_force) > 0
    for w in range(W):
        i = robots[w]
        s = pick(i, len(params.reach))
        to_length = params.reach[s] / params.moment_scale[s]
        rotation = sh.get_mat(node, sh.N_R, w)
        tip_moment = ports.tip_moment[pick(i, len(ports.tip_moment))]
        target = mul_t(rotation, (tip_moment[0], tip_moment[1], tip_moment[2]))
        m = sh.get(node, sh.N_M, w)
        for a in range(3):
            error[(row + a) * W + w] = to_length * (m[a] - target[a])
        for c in range(n_col):
            o = c * col.COLUMN
            v = sub(sh.get(columns, o + col.C_M, w), cross(target, sh.get(columns, o + col.C_PHI, w)))
            for a in range(3):
                gamma[((row + a) * n_col + c) * W + w] = to_length * v[a]
        if follower:
            g = ports.follower_force[pick(i, len(ports.follower_force))]
            given = (g[0], g[1], g[2])
            world = mul(rotation, given)
            to_length *= params.reach[s]
            for a in range(3):
                error[(row + 3 + a) * W + w] = to_length * (x[(n_x - 3 + a) * W + w] - world[a])
            for c in range(n_col):
                v = mul(rotation, cross(sh.get(columns, c * col.COLUMN + col.C_PHI, w), given))
                for a in range(3):
                    unit = 1.0 if c == n_x - 3 + a else 0.0
                    gamma[((row + 3 + a) * n_col + c) * W + w] = to_length * (unit - v[a])


@kernel
def loosen(
    robots: Lanes,
    params: Params,
    layout: Layout,
    x: Lanes,
    columns: Lanes,
    n_col: int,
    n_e: int,
    gamma: Lanes,
) -> None:
    """A slack wire carries nothing: its unknown moves no residual but its own, and not the tip."""
    for f in range(len(layout.free_tendon) if n_col > 0 else 0):
        t = layout.free_tendon[f]
        for w in range(W):
            if params.unilateral[pick(robots[w], len(params.unilateral)), t] and x[(3 + f) * W + w] < 0.0:
                for r in range(n_e):
                    gamma[(r * n_col + 3 + f) * W + w] = 0.0
                for k in range(col.COLUMN):
                    columns[((3 + f) * col.COLUMN + k) * W + w] = 0.0
                s = pick(robots[w], len(params.reach))
                slope = params.moment_scale[s] / (params.tension_scale[s] * params.tension_scale[s])
                gamma[(f * n_col + 3 + f) * W + w] = -max(
                    params.compliance[pick(robots[w], len(params.compliance)), t], slope
                )


@kernel
def form_gain(
    robots: Lanes,
    params: Params,
    memory: Memory,
    layout: Layout,
    gamma: Lanes,
    n_col: int,
    n_e: int,
    P: Lanes,
    G: Lanes,
    scaled: Lanes,
    work: Lanes,
    process: float,
    noise: float,
    carry: bool,
) -> None:
    """G of the scaled unknowns from the derivatives of the residuals; their units stay in `work` after its
    first n_p + 2 fields."""
    n_x = memory.x.shape[1]
    n_p = padded(n_x, BLOCK)
    units = work[(n_p + 2) * W :]
    for w in range(W):
        s = pick(robots[w], len(params.reach))
        for a in range(n_x):
            units[a * W + w] = unknown_unit(a, s, params, layout)
    for i in range(n_p * n_p * W):
        P[i] = 0.0
    for i in range(n_e * n_p * W):
        scaled[i] = 0.0
        G[i] = 0.0
    for i in range((n_p + 2) * W):
        work[i] = 0.0
    for r in range(n_e):
        for a in range(n_x):
            for w in range(W):
                scaled[(r * n_p + a) * W + w] = gamma[(r * n_col + a) * W + w] * units[a * W + w]
    for a in range(n_x):
        if carry:
            for b in range(a + 1):
                for w in range(W):
                    value = float(memory.covariance[robots[w], a * (a + 1) // 2 + b])
                    P[(a * n_p + b) * W + w] = value
                    P[(b * n_p + a) * W + w] = value
        for w in range(W):
            P[(a * n_p + a) * W + w] += process
    gain(P, G, scaled, work, n_x, n_e, noise)


@kernel
def update_boundary(
    robots: Lanes,
    count: int,
    params: Params,
    memory: Memory,
    layout: Layout,
    x: Lanes,
    error: Lanes,
    gamma: Lanes,
    n_col: int,
    n_e: int,
    P: Lanes,
    G: Lanes,
    scaled: Lanes,
    work: Lanes,
    process: float,
    noise: float,
    carry: bool,
) -> None:
    """The observer's update of x and P, and the gain kept for the next inputs."""
    n_x = memory.x.shape[1]
    n_p = padded(n_x, BLOCK)
    units = work[(n_p + 2) * W :]
    form_gain(robots, params, memory, layout, gamma, n_col, n_e, P, G, scaled, work, process, noise, carry)
    defect = work[: n_x * W]
    for a in range(n_x):
        for w in range(W):
            defect[a * W + w] = 0.0
        for r in range(n_e):
            for w in range(W):
                defect[a * W + w] -= G[(r * n_p + a) * W + w] * error[r * W + w]
    for w in range(count):
        i = robots[w]
        for a in range(n_x):
            unit = units[a * W + w]
            memory.x[i, a] = x[a * W + w] + unit * defect[a * W + w]
            memory.defect[i, a] += defect[a * W + w]
            for r in range(n_e):
                memory.gain[i, a, r] = unit * G[(r * n_p + a) * W + w]
            if len(memory.force_before) > 0:
                for b in range(3):
                    moved = 0.0
                    for r in range(n_e):
                        moved += G[(r * n_p + a) * W + w] * gamma[(r * n_col + n_col - 3 + b) * W + w]
                    # the force columns are the follower force's; a dead force does not enter its own row
                    if n_col == n_x:
                        s = pick(i, len(params.reach))
                        moved -= (
                            G[((n_e - 3 + b) * n_p + a) * W + w]
                            * params.reach[s]
                            * params.reach[s]
                            / params.moment_scale[s]
                        )
                    memory.gain[i, a, n_e + b] = -unit * moved
            if carry:
                for b in range(a + 1):
                    memory.covariance[i, a * (a + 1) // 2 + b] = P[(a * n_p + b) * W + w]


@kernel
def hold_boundary(
    robots: Lanes,
    count: int,
    params: Params,
    memory: Memory,
    layout: Layout,
    x: Lanes,
    error: Lanes,
    n_e: int,
) -> None:
    """The update of x by the gain of an earlier pass: Newton's method with a held derivative."""
    for w in range(count):
        i = robots[w]
        s = pick(i, len(params.reach))
        for a in range(memory.x.shape[1]):
            correction = 0.0
            for r in range(n_e):
                correction -= memory.gain[i, a, r] * error[r * W + w]
            memory.x[i, a] = x[a * W + w] + correction
            memory.defect[i, a] += correction / unknown_unit(a, s, params, layout)
