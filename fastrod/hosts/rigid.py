"""A rod that keeps its shape, as a rigid body."""

from __future__ import annotations

import numpy as np

from fastrod.model.robot import Robot
from fastrod.types import Floats


def rigid_inertia(robot: Robot, position: Floats) -> Floats:
    """(n_robots, 6, 6) inertia about its base point of a rod that keeps its shape (n_robots, n_points, 3):
    force and moment by linear and angular acceleration, world."""
    n_steps = (position.shape[1] - 1) // robot.n_segments
    mass = np.zeros(position.shape[1])
    for k, segment in enumerate(robot.segments):
        each = segment.line_density * segment.length / n_steps
        mass[k * n_steps : (k + 1) * n_steps + 1] += each * np.r_[0.5, np.ones(n_steps - 1), 0.5]
        for lump in segment.lumps:
            x = lump.at / segment.length * n_steps
            i = min(int(x), n_steps - 1)
            mass[k * n_steps + i : k * n_steps + i + 2] += lump.mass * np.array([1.0 - x + i, x - i])
    arm = position - position[:, :1]
    across = np.cross(np.eye(3), arm[:, :, None])  # [arm]x
    inertia = np.zeros((len(position), 6, 6))
    inertia[:, :3, :3] = mass.sum() * np.eye(3)
    inertia[:, 3:, :3] = np.einsum("j,njkl->nkl", mass, across)
    inertia[:, :3, 3:] = -inertia[:, 3:, :3]
    inertia[:, 3:, 3:] = -np.einsum("j,njkl,njlm->nkm", mass, across, across)
    return inertia


def rigid_exchange(
    inertia: Floats, mobility: Floats, wrench: Floats, velocity: Floats, by: Floats, dt: float
) -> Floats:
    """(n, 6) mean wrench on the base over a step, by momentum:
        (1 + M Lambda^-1) w = wrench of the shape - M (what the base would gain without w) - what turning
        needs,
    M the `inertia` (n, 6, 6) of the rod, Lambda^-1 the `mobility` of its base, which moves at `velocity` (n,
    6) and would be displaced `by` (n, 6). As of the rod in motion (`kernels/rod/modal/host.py`): a base that
    is held is always elsewhere than it would be, and bears no more than the weight."""
    spin = velocity[:, 3:]
    momentum = (inertia @ np.concatenate([np.zeros_like(spin), spin], axis=1)[..., None])[..., 0]
    turning = np.concatenate([np.cross(spin, momentum[:, :3]), np.cross(spin, momentum[:, 3:])], axis=1)
    gained = (by / dt - velocity) / dt
    needed = wrench - turning - np.einsum("nij,nj->ni", inertia, gained)
    return np.asarray(np.linalg.solve(np.eye(6) + inertia @ mobility, needed[..., None])[..., 0])
