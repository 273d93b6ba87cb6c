"""The cold start once more, one robot at a time in plain numpy: pseudo-inverses by SVD, sums over the loads
beyond as they are written."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fastrod.types import Layout, Params, Ports

SAMPLES = 8
RANK = 1e-3  # singular values below this part of the largest are left out


def guess(i: int, layout: Layout, params: Params, ports: Ports) -> tuple[np.ndarray, np.ndarray]:
    """Boundary unknowns x and curvature at the base of robot i."""
    params, ports = (
        type(group)(*(a[min(i, len(a) - 1)] if len(a) else None for a in group)) for group in (params, ports)
    )
    n_segments = len(layout.first_tendon)
    length = params.length + ports.extension
    u = curvature(layout, length, params.offset, ports)
    place, turn = arcs(u, length, ports.base_pose)
    force = ports.tip_force.copy()
    if ports.follower_force is not None:
        force += turn[-1, -1] @ ports.follower_force
    load = loads(layout, length, ports)
    moment = np.empty(place.shape)
    for k, j in np.ndindex(place.shape[:2]):
        world = ports.tip_moment + np.cross(place[-1, -1] - place[k, j], force)
        world = world + np.cross(place[k, j:] - place[k, j], load[k, j:]).sum(0)
        for m in range(k + 1, n_segments):
            world = world + np.cross(place[m] - place[k, j], load[m]).sum(0)
        moment[k, j] = turn[k, j].T @ world
    mean = np.einsum("j,kja->ka", trapezoid() / SAMPLES, moment)
    elastic = ports.stiffness[:, 0] * (u - ports.precurvature[:, 0])
    if layout.paper:
        return (elastic + moment[:, 0] - mean)[:, :2].ravel(), u[0]
    tension = tensions(layout, params, ports, mean - elastic)
    own = [] if ports.follower_force is None else turn[-1, -1] @ ports.follower_force
    return np.concatenate([moment[0, 0], tension[layout.free_tendon], own]), u[0]


def trapezoid() -> np.ndarray:
    weights = np.ones(SAMPLES + 1)
    weights[[0, -1]] = 0.5
    return weights


def arms(offset: np.ndarray) -> np.ndarray:
    """(n, 2) moment of a unit tension of each tendon."""
    return np.column_stack([offset[:, 1], -offset[:, 0]])


def curvature(layout: Layout, length: np.ndarray, offset: np.ndarray, ports: Ports) -> np.ndarray:
    left, u = ports.tendon_length.copy(), ports.precurvature[:, 0].copy()
    for k, l_k in enumerate(length):
        ends = np.flatnonzero(layout.tendon_segment == k)
        if len(ends) and np.isin(ends, layout.row_tendon).all():
            u[k, :2] = np.linalg.pinv(l_k * arms(offset[k, ends]), rcond=RANK) @ (left[ends] - l_k)
        crossing = layout.tendon_segment >= k
        left[crossing] -= l_k * (1.0 + arms(offset[k]) @ u[k, :2])[crossing]
    return u


def arcs(u: np.ndarray, length: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position (n_segments, SAMPLES + 1, 3) and rotation of the samples."""
    R, r = Rotation.from_quat(pose[[4, 5, 6, 3]]).as_matrix(), pose[:3]
    place, turn = np.empty((len(u), SAMPLES + 1, 3)), np.empty((len(u), SAMPLES + 1, 3, 3))
    for k, l_k in enumerate(length):
        h = l_k / SAMPLES
        place[k, 0], turn[k, 0] = r, R
        for j in range(1, SAMPLES + 1):
            half, whole = (R @ Rotation.from_rotvec(part * h * u[k]).as_matrix() for part in (0.5, 1.0))
            r = r + h / 6.0 * (R[:, 2] + 4.0 * half[:, 2] + whole[:, 2])
            R = whole
            place[k, j], turn[k, j] = r, R
    return place, turn


def loads(layout: Layout, length: np.ndarray, ports: Ports) -> np.ndarray:
    """(n_segments, SAMPLES + 1, 3) force for each sample, world [N]."""
    n_segments, n_f = ports.line_force.shape[:2]
    nearest = np.linspace(0, n_f - 1, SAMPLES + 1).round().astype(int)
    load = (length[:, None] / SAMPLES * trapezoid())[..., None] * ports.line_force[:, nearest]
    for j, force in enumerate([] if ports.node_force is None else ports.node_force):
        k = min(j // layout.n_steps, n_segments - 1)
        load[k, round((j - k * layout.n_steps) / layout.n_steps * SAMPLES)] += force
    return np.asarray(load)


def tensions(layout: Layout, params: Params, ports: Ports, wanted: np.ndarray) -> np.ndarray:
    """(n_tendons,) that give each segment the mean tendon moment `wanted`, tip first."""
    free = np.isin(np.arange(len(layout.tendon_segment)), layout.free_tendon)
    tension = np.where(free, params.pretension, ports.tension)
    for k in reversed(range(len(wanted))):
        ends = np.flatnonzero((layout.tendon_segment == k) & free)
        if len(ends):
            missing = wanted[k, :2] - tension @ arms(params.offset[k])
            tension[ends] += np.linalg.pinv(arms(params.offset[k, ends]).T, rcond=RANK) @ missing
    return np.where(params.unilateral & free, np.maximum(tension, 0.01 * params.tension_scale), tension)
