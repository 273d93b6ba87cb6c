"""Rotations outside the kernels."""

from __future__ import annotations

import numpy as np

from fastrod.types import Floats

_NEXT = np.array([1, 2, 0])


def cross(a: Floats, b: Floats) -> Floats:
    """(..., 3) a x b. Of a few vectors numpy's takes ten times as long."""
    return np.asarray((a * b.take(_NEXT, -1) - a.take(_NEXT, -1) * b).take(_NEXT, -1))


def matrix_from_quaternion(quaternion: Floats) -> Floats:
    """(..., 3, 3) rotation matrices of unit quaternions (..., 4), w x y z."""
    w, x, y, z = (quaternion[..., k] for k in range(4))
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    wx, wy, wz, out = w * x, w * y, w * z, np.empty((*quaternion.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = 1 - 2 * (yy + zz), 2 * (xy - wz), 2 * (xz + wy)
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = 2 * (xy + wz), 1 - 2 * (xx + zz), 2 * (yz - wx)
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = 2 * (xz - wy), 2 * (yz + wx), 1 - 2 * (xx + yy)
    return out


def product(a: Floats, b: Floats) -> Floats:
    """(..., 4) quaternion of first b, then a, each w x y z."""
    w, v = a[..., :1], a[..., 1:]
    x, u = b[..., :1], b[..., 1:]
    return np.concatenate([w * x - (v * u).sum(-1, keepdims=True), w * u + x * v + cross(v, u)], axis=-1)


def quaternion_from_matrix(rotation: Floats) -> Floats:
    """(..., 4) unit quaternions w x y z, w not negative, of rotation matrices (..., 3, 3)."""
    r, rows = rotation, np.empty((*rotation.shape[:-2], 4, 4))
    # four times the quaternion's largest component times the quaternion (Shepperd 1978): never a small
    # divisor
    x, y, z = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    rows[..., 0, 0], rows[..., 1, 1] = 1 + x + y + z, 1 + x - y - z
    rows[..., 2, 2], rows[..., 3, 3] = 1 - x + y - z, 1 - x - y + z
    for i, j, k in ((1, 2, 3), (2, 3, 1), (3, 1, 2)):
        rows[..., 0, i] = rows[..., i, 0] = r[..., k - 1, j - 1] - r[..., j - 1, k - 1]
        rows[..., j, k] = rows[..., k, j] = r[..., k - 1, j - 1] + r[..., j - 1, k - 1]
    best = np.diagonal(rows, axis1=-2, axis2=-1).argmax(-1)
    found = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    found = found / np.linalg.norm(found, axis=-1, keepdims=True)
    return np.asarray(np.where(found[..., :1] < 0.0, -found, found))


def quaternion_from_vector(vector: Floats) -> Floats:
    """(..., 4) quaternion w x y z of a rotation vector (..., 3) [rad]."""
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2.0), 0.5 * np.sinc(angle / (2.0 * np.pi)) * vector], axis=-1)


def vector_from_quaternion(quaternion: Floats) -> Floats:
    """(..., 3) rotation vector [rad], no longer than pi, of a quaternion w x y z (..., 4)."""
    turned = np.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)
    sine = np.linalg.norm(turned[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, turned[..., :1])
    return np.asarray(turned[..., 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0))


def rotation_between(before: Floats, after: Floats) -> Floats:
    """(..., 3) rotation vector, world, from one set of quaternions (..., 4) to the next."""
    return vector_from_quaternion(product(after, before * np.array([1.0, -1.0, -1.0, -1.0])))


def displaced(pose: Floats, by: Floats) -> Floats:
    """(..., 7) pose after a displacement and a rotation vector (..., 6), world."""
    position = pose[..., :3] + by[..., :3]
    return np.concatenate([position, product(quaternion_from_vector(by[..., 3:]), pose[..., 3:])], axis=-1)


def displacement(start: Floats, end: Floats) -> Floats:
    """(..., 6) displacement and rotation vector from one pose to another, world."""
    turned = rotation_between(start[..., 3:], end[..., 3:])
    return np.concatenate([end[..., :3] - start[..., :3], turned], axis=-1)


def segment_bends(rotation: Floats, n_segments: int) -> Floats:
    """(n, n_segments, 2) integral of the curvature about d1 and d2 over each segment [rad], from
    world_from_material (n, n_points, 3, 3) at points that share the segments' length evenly."""
    turned = quaternion_from_matrix(np.swapaxes(rotation[:, :-1], -1, -2) @ rotation[:, 1:])
    vectors = vector_from_quaternion(turned)[..., :2]
    return np.asarray(vectors.reshape(len(rotation), n_segments, -1, 2).sum(2))
