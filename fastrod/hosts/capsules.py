"""A rod as rigid bodies: `Capsules`, one along each chord of its backbone, for engines that know no rods."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fastrod.rotation import cross, matrix_from_quaternion, quaternion_from_matrix, rotation_between
from fastrod.types import Floats


class Capsules(NamedTuple):
    """World frame; base first. Rods of a batch have a robot axis before the capsules' (`Rod`)."""

    center: Floats
    """(n, 3) [m]."""
    quaternion: Floats
    """(n, 4) w x y z: z along the capsule, x as near as can be to the material's d1."""
    half_length: Floats
    """(n,) of the cylinder, without the half spheres [m]."""
    radius: Floats
    """(n,) [m]."""
    velocity: Floats
    """(n, 6) of the centre [m/s], then angular [rad/s]: the mean of the last step, zero where the rod was
    only put."""

    @property
    def ends(self) -> Floats:
        """(n, 2, 3) centres of the half spheres [m], the one nearer to the base first."""
        shape = self.center.shape
        z = (
            matrix_from_quaternion(self.quaternion.reshape(-1, 4))[:, :, 2].reshape(shape)
            * self.half_length[..., None]
        )
        return np.stack([self.center - z, self.center + z], axis=-2)


def chords(position: Floats, rotation: Floats) -> tuple[Floats, Floats]:
    """Middle (..., n, 3) and quaternion (..., n, 4) w x y z of each capsule between nodes (..., n + 1, 3)
    with frames (..., n + 1, 3, 3): z along the chord, x as near as can be to the material's d1."""
    chord = np.diff(position, axis=-2)
    z = chord / np.linalg.norm(chord, axis=-1, keepdims=True)
    x = 0.5 * (rotation[..., :-1, :, 0] + rotation[..., 1:, :, 0])
    x = x - (x * z).sum(-1, keepdims=True) * z
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    frames = np.stack([x, cross(z, x), z], axis=-1)
    return 0.5 * (position[..., :-1, :] + position[..., 1:, :]), quaternion_from_matrix(frames)


def along(position: Floats, rotation: Floats, radius: Floats) -> Capsules:
    """Capsules at rest between the nodes, as `chords` has them; `radius` (n,) [m]."""
    center, quaternion = chords(position, rotation)
    half = 0.5 * np.linalg.norm(np.diff(position, axis=-2), axis=-1)
    return Capsules(center, quaternion, half, np.broadcast_to(radius, half.shape), np.zeros((*half.shape, 6)))


def moved(before: Capsules, after: Capsules, time: float) -> Capsules:
    """`after` with the velocity that leads there from `before` within a time [s]."""
    linear = (after.center - before.center) / time
    return after._replace(
        velocity=np.concatenate(
            [linear, rotation_between(before.quaternion, after.quaternion) / time], axis=-1
        )
    )
