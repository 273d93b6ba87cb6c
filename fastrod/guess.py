"""Where a cold start begins: arcs from the tendon lengths, and on them the moments and tensions that statics asks for.

From here Newton's method takes four to six passes; from zero it diverges (model.md).
"""

from __future__ import annotations

import numpy as np

from fastrod.rotation import matrix_from_quaternion
from fastrod.types import Floats, Ints, Layout, Memory, Params, Ports

_BLOCK = 4096  # robots at a time
_SAMPLES = 8  # arcs are sampled this often per segment; the guess needs no more


def cold_start(rows: Ints, layout: Layout, params: Params, ports: Ports, memory: Memory) -> None:
    """Fill x and the curvature guess of the robots `rows` from their inputs alone, and forget what was learned before."""
    for start in range(0, len(rows), _BLOCK):  # the arrays on the way are ten times what a robot keeps
        block = rows[start : start + _BLOCK]
        _fill(block, _Rows(block), layout, params, ports, memory)
        _rounded(block, layout, params, memory)
    for learned in (memory.gain, memory.move, memory.defect, memory.covariance):
        if len(learned):
            learned[rows] = 0.0


def _rounded(rows: Ints, layout: Layout, params: Params, memory: Memory) -> None:
    """Put the guess on a coarse grid: numpy's sums differ in their last bits with the size of the batch, a batch must not."""
    unit = _grid(rows, layout, params, memory.x.shape[1])
    memory.x[rows] = np.round(memory.x[rows] / unit) * unit
    memory.curvature_guess[rows] = np.round(memory.curvature_guess[rows] * 2.0**20) / 2.0**20


def _grid(rows: Ints, layout: Layout, params: Params, n_x: int) -> Floats:
    """(n, n_x) a millionth of the natural size of each unknown."""
    take = _Rows(rows)
    moment, tension, reach = (take(a)[:, None] for a in (params.moment_scale, params.tension_scale, params.reach))
    n_base = 2 * len(layout.first_tendon) if layout.paper else 3
    n_free = len(layout.free_tendon)
    sizes = [np.repeat(moment, n_base, 1), np.repeat(tension, n_free, 1), np.repeat(moment / reach, n_x - n_base - n_free, 1)]
    return np.asarray(np.concatenate(sizes, axis=1) * 2.0**-20)


def _fill(rows: Ints, take: _Rows, layout: Layout, params: Params, ports: Ports, memory: Memory) -> None:
    curvature = _arc_curvature(layout, take, params, ports)
    rotation, position, weights = _arcs(curvature, take, params, ports)
    at_base, mean = _load_moment(rotation, position, weights, take, ports)
    stiffness = take(ports.stiffness)[:, :, 0]
    elastic = stiffness * (curvature - take(ports.precurvature)[:, :, 0])
    n_segments = curvature.shape[1]
    memory.curvature_guess[rows] = curvature[:, 0]
    if layout.paper:
        moment = elastic + at_base - mean  # the tip couple makes the mean curvature the arc's
        for k in range(n_segments):
            memory.x[rows, 2 * k : 2 * k + 2] = moment[:, k, :2]
        return
    memory.x[rows, :3] = at_base[:, 0]
    tension = _tensions(layout, take, params, ports, mean - elastic)
    memory.x[np.ix_(rows, 3 + np.arange(len(layout.free_tendon)))] = tension[:, layout.free_tendon]
    if len(ports.follower_force):
        memory.x[rows, -3:] = np.einsum("rij,rj->ri", rotation[:, -1, -1], take(ports.follower_force))


class _Rows:
    """Rows of a port whose robot axis may have length 1."""

    def __init__(self, rows: np.ndarray) -> None:
        self.rows = rows

    def __call__(self, a: np.ndarray) -> np.ndarray:
        return np.broadcast_to(a, (len(self.rows), *a.shape[1:])) if len(a) == 1 else a[self.rows]


def _arc_curvature(layout: Layout, take: _Rows, params: Params, ports: Ports) -> Floats:
    """(n, n_segments, 3) constant curvature of each segment: l (1 + u_x d_y - u_y d_x) is what a tendon has left there."""
    length, offset = take(params.length) + take(ports.extension), take(params.offset)
    left = take(ports.tendon_length).copy()
    curvature = take(ports.precurvature)[:, :, 0].copy()
    for k in range(length.shape[1]):
        ends = np.flatnonzero(layout.tendon_segment == k)
        if len(ends) and np.isin(ends, layout.row_tendon).all():
            across = np.stack([offset[:, k, ends, 1], -offset[:, k, ends, 0]], axis=-1) * length[:, k, None, None]
            curvature[:, k, :2] = np.einsum("rat,rt->ra", np.linalg.pinv(across), left[:, ends] - length[:, k, None])
        u = curvature[:, k]
        used = length[:, k, None] * (1.0 + u[:, :1] * offset[:, k, :, 1] - u[:, 1:2] * offset[:, k, :, 0])
        left -= np.where(layout.tendon_segment >= k, used, 0.0)
    return curvature


def _arcs(curvature: Floats, take: _Rows, params: Params, ports: Ports) -> tuple[Floats, Floats, Floats]:
    """Rotation (n, n_segments, samples + 1, 3, 3), position of the samples, and the arclength that each node stands for."""
    length = take(params.length) + take(ports.extension)
    pose = take(ports.base_pose)
    turn, place = matrix_from_quaternion(pose[:, 3:]), pose[:, :3].copy()
    rotations, positions = [], []
    for k in range(curvature.shape[1]):
        h = length[:, k, None] / _SAMPLES
        step = _exp(curvature[:, k] * h)
        half = _exp(0.5 * curvature[:, k] * h)
        rows_r, rows_p = [turn], [place]
        for _ in range(_SAMPLES):
            middle = turn @ half
            chord = (turn[:, :, 2] + 4.0 * middle[:, :, 2] + (turn @ step)[:, :, 2]) / 6.0
            place, turn = place + h * chord, turn @ step
            rows_r.append(turn)
            rows_p.append(place)
        rotations.append(np.stack(rows_r, 1))
        positions.append(np.stack(rows_p, 1))
    weights = np.full(_SAMPLES + 1, 1.0)
    weights[[0, -1]] = 0.5
    return np.stack(rotations, 1), np.stack(positions, 1), length[:, :, None] / _SAMPLES * weights


def _load_moment(rotation: Floats, position: Floats, weights: Floats, take: _Rows, ports: Ports) -> tuple[Floats, Floats]:
    """Moment of the loads beyond, material frame: (n, n_segments, 3) at each segment's base, and its mean over the segment."""
    n, n_segments, n_nodes = position.shape[:3]
    force = take(ports.tip_force).copy()
    if len(ports.follower_force):
        force += np.einsum("rij,rj->ri", rotation[:, -1, -1], take(ports.follower_force))
    line = take(ports.line_force)
    at = np.linspace(0, line.shape[2] - 1, n_nodes).round().astype(int)
    loads = weights[..., None] * line[:, :, at]  # a force for each sample
    if len(ports.node_force):
        nodes = take(ports.node_force)
        n_steps = (nodes.shape[1] - 1) // n_segments
        for j in range(nodes.shape[1]):
            k = min(j // n_steps, n_segments - 1)
            loads[:, k, round((j - k * n_steps) / n_steps * _SAMPLES)] += nodes[:, j]
    loads = loads.reshape(n, -1, 3)
    arm = position.reshape(n, -1, 3)
    beyond_force = np.cumsum(loads[:, ::-1], axis=1)[:, ::-1] - 0.5 * loads
    own = np.cross(arm, loads)
    beyond_moment = np.cumsum(own[:, ::-1], axis=1)[:, ::-1] - 0.5 * own
    moment = beyond_moment - np.cross(arm, beyond_force) + np.cross(arm[:, -1:] - arm, force[:, None]) + take(ports.tip_moment)[:, None]
    local = np.einsum("rsij,rsi->rsj", rotation.reshape(n, -1, 3, 3), moment).reshape(n, n_segments, n_nodes, 3)
    mean = (local * (weights / weights.sum(-1, keepdims=True))[..., None]).sum(2)
    return local[:, :, 0], mean


def _tensions(layout: Layout, take: _Rows, params: Params, ports: Ports, wanted: Floats) -> Floats:
    """Least-norm tensions around the pretension that give each segment the mean tendon moment `wanted`, tip first."""
    offset = take(params.offset)
    tension = take(ports.tension).copy()
    free = np.zeros(tension.shape[1], bool)
    free[layout.free_tendon] = True
    tension[:, free] = take(params.pretension)[:, free]
    for k in reversed(range(wanted.shape[1])):
        ends = np.flatnonzero((layout.tendon_segment == k) & free)
        if len(ends):
            arms = np.stack([offset[:, k, :, 1], -offset[:, k, :, 0]], axis=1)  # (n, 2, n_tendons): moment of a unit tension
            missing = wanted[:, k, :2] - np.einsum("rat,rt->ra", arms, tension)
            tension[:, ends] += np.einsum("rta,ra->rt", np.linalg.pinv(arms[:, :, ends]), missing)
    # A wire that can go slack starts taut: from there Newton finds which ones let go; from slack it would not see them.
    taut = take(params.unilateral) & free
    return np.where(taut, np.maximum(tension, 0.01 * take(params.tension_scale)[:, None]), tension)


def _exp(vector: Floats) -> Floats:
    """Rotation matrices of rotation vectors (n, 3)."""
    angle = np.linalg.norm(vector, axis=1)
    half = 0.5 * angle
    return matrix_from_quaternion(np.column_stack([np.cos(half), 0.5 * np.sinc(half / np.pi)[:, None] * vector]))
