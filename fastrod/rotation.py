"""Rotations outside the kernels."""

from __future__ import annotations

import numpy as np

from fastrod.types import Floats


def matrix_from_quaternion(quaternion: Floats) -> Floats:
    """(n, 3, 3) rotation matrices of unit quaternions (n, 4), w x y z."""
    w, x, y, z = quaternion.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def product(a: Floats, b: Floats) -> Floats:
    """(..., 4) quaternion of first b, then a, each w x y z."""
    w, v = a[..., :1], a[..., 1:]
    x, u = b[..., :1], b[..., 1:]
    return np.concatenate([w * x - (v * u).sum(-1, keepdims=True), w * u + x * v + np.cross(v, u)], axis=-1)
