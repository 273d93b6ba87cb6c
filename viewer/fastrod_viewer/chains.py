"""Rods between their nodes, and chains of short straight pieces along curves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fastrod.rotation import quaternion_from_matrix
from fastrod.types import Floats, Ints


class Nodes(NamedTuple):
    """Rods as their integrator leaves them: robot axis first, `n_segments * n_steps + 1` nodes each."""

    position: Floats
    """(n_robots, n_points, 3) [m]."""
    tangent: Floats
    """(n_robots, n_points, 3) d3."""
    quaternion: Floats
    """(n_robots, n_points, 4) world_from_material; its sign does not jump along the rod."""
    arclength: Floats
    """(n_robots, n_points) [m]."""


class Samples(NamedTuple):
    """Cross-sections between the nodes."""

    position: Floats
    """(n_robots, m, 3) [m]."""
    quaternion: Floats
    """(n_robots, m, 4) world_from_material; its sign does not jump along the rod."""
    interval: Ints
    """(n_robots, m) the node before."""
    part: Floats
    """(n_robots, m) of the way to the next node, 0 to 1."""


class Pieces(NamedTuple):
    """Straight pieces of a chain."""

    centre: Floats
    """(..., 3) [m]."""
    quaternion: Floats
    """(..., 4), z along the piece."""
    length: Floats
    """(...) from end to end [m]."""


def nodes(position: Floats, rotation: Floats, arclength: Floats) -> Nodes:
    """Of positions (n_robots, n_points, 3), rotations (n_robots, n_points, 3, 3) and arclengths (n_robots, n_points), finite."""
    quaternion = quaternion_from_matrix(rotation)
    turned = np.where((quaternion[:, 1:] * quaternion[:, :-1]).sum(-1) < 0.0, -1.0, 1.0)
    quaternion[:, 1:] *= np.cumprod(turned, axis=1)[..., None]
    return Nodes(position, rotation[..., 2], quaternion, arclength)


class Sampler:
    """Cross-sections at fixed fractions of the segments: positions by cubic Hermite polynomials, rotations by normalised lerp."""

    def __init__(self, n_segments: int, n_steps: int, segment: Ints, fraction: Floats) -> None:
        """`segment` (m,) and `fraction` (m,) of its length, 0 to 1."""
        self.n_steps, self.segment, self.fraction = n_steps, segment, fraction
        inner = np.arange(n_segments)[:, None] * n_steps + np.arange(1, n_steps)
        self._inner = inner[segment]  # (m, n_steps - 1) the nodes inside the segment

    def __call__(self, rods: Nodes) -> Samples:
        s = rods.arclength
        joints = s[:, :: self.n_steps]
        start, end = joints[:, self.segment], joints[:, self.segment + 1]
        wanted = start + self.fraction * (end - start)
        # where forces act on points, nodes stand at them, and are not even
        interval = self.segment * self.n_steps + (s[:, self._inner] <= wanted[..., None]).sum(-1)
        flat = interval + np.arange(len(s))[:, None] * s.shape[1]

        def at(a: Floats) -> tuple[Floats, Floats]:
            rows = a.reshape(-1, a.shape[-1])
            return rows[flat], rows[flat + 1]

        s0, s1 = s.ravel()[flat], s.ravel()[flat + 1]
        h = np.maximum(s1 - s0, 1e-12)
        t = np.clip((wanted - s0) / h, 0.0, 1.0)
        (p0, p1), (d0, d1), (q0, q1) = at(rods.position), at(rods.tangent), at(rods.quaternion)
        r, u, v = 1.0 - t, t[..., None], (t * (1.0 - t))[..., None]
        weight = (t * t * (3.0 - 2.0 * t))[..., None]
        position = p0 + weight * (p1 - p0) + v * h[..., None] * (r[..., None] * d0 - u * d1)
        quaternion = q0 + u * (q1 - q0)
        quaternion /= np.sqrt(np.einsum("...i,...i->...", quaternion, quaternion))[..., None]
        return Samples(position, quaternion, interval, t)


def along(between: tuple[Floats, Floats], samples: Samples) -> Floats:
    """(n_robots, m) linear between the values (n_robots, n_points - 1) at the start and the end of each interval."""
    start, end = (np.take_along_axis(a, samples.interval, axis=1) for a in between)
    return np.asarray(start + samples.part * (end - start))


def axes(quaternion: Floats) -> tuple[Floats, Floats, Floats]:
    """d1, d2, d3, each (..., 3), of quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    xx, yy, zz, xy, xz, yz, wx, wy, wz = x * x, y * y, z * z, x * y, x * z, y * z, w * x, w * y, w * z
    return (
        np.stack([1.0 - 2.0 * (yy + zz), 2.0 * (xy + wz), 2.0 * (xz - wy)], axis=-1),
        np.stack([2.0 * (xy - wz), 1.0 - 2.0 * (xx + zz), 2.0 * (yz + wx)], axis=-1),
        np.stack([2.0 * (xz + wy), 2.0 * (yz - wx), 1.0 - 2.0 * (xx + yy)], axis=-1),
    )


def tangents(quaternion: Floats) -> Floats:
    """(..., 3) d3 of quaternions (..., 4): where they take z."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.stack([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)], axis=-1)


def aim(direction: Floats) -> Floats:
    """(..., 4) shortest rotation of z to unit vectors (..., 3); none for a vector of length 0."""
    x, y, z = np.moveaxis(direction, -1, 0)
    back = z < -1.0 + 1e-12
    found = np.stack([1.0 + z, np.where(back, 1.0, -y), np.where(back, 0.0, x), np.zeros_like(z)], axis=-1)
    return np.asarray(found / np.linalg.norm(found, axis=-1, keepdims=True))


def middles(quaternion: Floats) -> Floats:
    """(..., n - 1, 4) half way between neighbours (..., n, 4) of a chain."""
    q = quaternion[..., 1:, :] + quaternion[..., :-1, :]
    return np.asarray(q / np.sqrt(np.einsum("...i,...i->...", q, q))[..., None])


def backbone_pieces(position: Floats, quaternion: Floats) -> Pieces:
    """Between neighbouring cross-sections (..., n, 3), (..., n, 4): the half-way tangent is parallel to the chord of an arc."""
    chord = position[..., 1:, :] - position[..., :-1, :]
    return Pieces(
        0.5 * (position[..., 1:, :] + position[..., :-1, :]),
        middles(quaternion),
        np.sqrt(np.einsum("...i,...i->...", chord, chord)),
    )


def strand_pieces(position: Floats, quaternion: Floats) -> Pieces:
    """Between neighbouring points (..., n, 3) of a strand that runs beside a rod; (..., n, 4) are the rod's cross-sections there, from
    which it departs by less than a right angle."""
    chord = position[..., 1:, :] - position[..., :-1, :]
    length = np.sqrt(np.einsum("...i,...i->...", chord, chord))
    q = middles(quaternion)
    unit = chord / np.maximum(length, 1e-30)[..., None]
    lx, ly, lz = (np.einsum("...i,...i->...", unit, axis) for axis in axes(q))
    a, b, c = 1.0 + lz, -ly, lx  # in the rod's frame: from d3 to the chord
    size = np.maximum(np.sqrt(a * a + b * b + c * c), 1e-30)
    a, b, c = a / size, b / size, c / size
    w, x, y, z = np.moveaxis(q, -1, 0)
    turned = np.stack([w * a - x * b - y * c, w * b + x * a - z * c, w * c + y * a + z * b, z * a + x * c - y * b], axis=-1)
    return Pieces(0.5 * (position[..., 1:, :] + position[..., :-1, :]), turned, length)
