"""Poses of obstacles and inputs of robots between one step and the next."""

from __future__ import annotations

import numpy as np

from fastrod.rotation import matrix_from_quaternion, product
from fastrod.types import Floats, Ports


def frames_of(poses: Floats) -> Floats:
    """(n, n_obstacles, 7) position and quaternion to (n, n_obstacles, 12): rotation row by row, then
    position."""
    rotation = matrix_from_quaternion(poses[..., 3:].reshape(-1, 4)).reshape(*poses.shape[:2], 9)
    return np.ascontiguousarray(np.concatenate([rotation, poses[..., :3]], axis=-1))


def between(start: Floats, end: Floats, fraction: Floats) -> Floats:
    """Poses (..., 7) a fraction (n,) from `start` to `end`: positions in a straight line, quaternions along
    the shorter arc."""
    n = max(len(start), len(end), len(fraction))
    a, b = (np.broadcast_to(p, (n, *p.shape[1:])) for p in (start, end))
    t = fraction.reshape(-1, *[1] * (a.ndim - 1))
    sign = np.where((a[..., 3:] * b[..., 3:]).sum(-1, keepdims=True) < 0.0, -1.0, 1.0)
    rotation = (1.0 - t) * a[..., 3:] + t * sign * b[..., 3:]
    rotation /= np.linalg.norm(rotation, axis=-1, keepdims=True)
    return np.concatenate([(1.0 - t) * a[..., :3] + t * b[..., :3], rotation], axis=-1)


def back_by(poses: Floats, velocity: Floats, time: Floats) -> Floats:
    """Poses (n, 7) a while (n,) ago, at a velocity (1 or n, 6) [m/s, rad/s]."""
    n = max(len(poses), len(velocity), len(time))
    pose, v, t = (np.broadcast_to(a, (n, *a.shape[1:])) for a in (poses, velocity, time))
    angle = -np.linalg.norm(v[:, 3:], axis=1) * t
    unit = v[:, 3:] / np.maximum(np.linalg.norm(v[:, 3:], axis=1, keepdims=True), 1e-300)
    rotation = np.column_stack([np.cos(0.5 * angle), np.sin(0.5 * angle)[:, None] * unit])
    return np.column_stack([pose[:, :3] - t[:, None] * v[:, :3], product(rotation, pose[:, 3:])])


def longest_move(start: Floats, end: Floats, ball: Floats) -> Floats:
    """(n,) how far a point of any obstacle has moved at most; `ball` (n_obstacles, 4) holds each. A plane
    that turns or moves counts as unbounded."""
    if start.shape == end.shape and np.array_equal(start, end):
        return np.zeros(1)
    shift = np.linalg.norm(end[..., :3] - start[..., :3], axis=-1)
    rotation = np.minimum(
        np.linalg.norm(end[..., 3:] - start[..., 3:], axis=-1),
        np.linalg.norm(end[..., 3:] + start[..., 3:], axis=-1),
    )
    radius = np.linalg.norm(ball[:, :3], axis=1) + ball[:, 3]
    with np.errstate(invalid="ignore"):
        # |dq| is half the angle, to first order and from above
        far = np.where(rotation > 0.0, 2.0 * rotation * radius, 0.0)
    return np.asarray((shift + far).max(-1, initial=0.0))


def blended(start: Ports, end: Ports, fraction: Floats) -> Ports:
    """The inputs a fraction (n,) of the way from `start` to `end`; what has another number of points, or
    was not there, comes at once."""
    fields = {}
    for name in Ports._fields:
        a, b = getattr(start, name), getattr(end, name)
        alike = a.shape[1:] == b.shape[1:] and 0 not in (len(a), len(b))
        if name in ("grid", "node_force", "follower_force") or not alike or a is b:
            continue
        if name == "base_pose":
            fields[name] = np.ascontiguousarray(between(a, b, fraction))
            continue
        t = fraction.reshape(-1, *[1] * (a.ndim - 1))
        fields[name] = np.ascontiguousarray((1.0 - t) * a + t * b)
    return end._replace(**fields)
