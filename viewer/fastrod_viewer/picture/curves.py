"""Rods between their nodes, and curves as series of short straight pieces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fastrod.types import Floats, Ints
from fastrod_viewer.picture import curve_kernels as kernels


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


class CurveSamples(NamedTuple):
    """Cross-sections between the nodes."""

    position: Floats
    """(n_robots, m, 3) [m]."""
    quaternion: Floats
    """(n_robots, m, 4) world_from_material; its sign does not jump along the rod."""
    interval: Ints
    """(n_robots, m) the node before."""
    interval_fraction: Floats
    """(n_robots, m) fraction of the interval to the next node, 0 to 1."""


class Pieces(NamedTuple):
    """Straight pieces of lines along rods: (n_robots, n_lines, n_pieces, ...)."""

    centre: Floats
    """(..., 3) [m]."""
    quaternion: Floats
    """(..., 4), z along the piece."""
    length: Floats
    """(...) from end to end [m]."""
    bend: Floats
    """(...) change of the rod's tangent over the piece."""


def nodes(position: Floats, rotation: Floats, arclength: Floats) -> Nodes:
    """Build nodes of positions (n_robots, n_points, 3), rotations (n_robots, n_points, 3, 3) and arclengths
    (n_robots, n_points), finite."""
    quaternion = np.empty((*rotation.shape[:2], 4))
    kernels.quaternions(rotation, quaternion)
    return Nodes(
        np.ascontiguousarray(position),
        np.ascontiguousarray(rotation[..., 2]),
        quaternion,
        np.ascontiguousarray(arclength),
    )


class Sampler:
    """Cross-sections at fixed fractions of the segments: positions by cubic Hermite polynomials, rotations by
    normalised lerp."""

    def __init__(self, n_steps: int, segment: Ints, fraction: Floats) -> None:
        """`segment` (m,) and `fraction` (m,) of its length, 0 to 1; a segment has `n_steps` intervals between
        nodes."""
        self.n_steps, self.segment, self.fraction = n_steps, segment, fraction

    def __call__(self, rods: Nodes) -> CurveSamples:
        """(n_robots, m, ...) at the m cross-sections of these rods."""
        n, m = len(rods.position), len(self.segment)
        found = CurveSamples(
            np.empty((n, m, 3)), np.empty((n, m, 4)), np.empty((n, m), np.int64), np.empty((n, m))
        )
        kernels.sample(
            rods.position,
            rods.tangent,
            rods.quaternion,
            rods.arclength,
            self.n_steps,
            self.segment,
            self.fraction,
            found.position,
            found.quaternion,
            found.interval,
            found.interval_fraction,
        )
        return found


def along(between: tuple[Floats, Floats], samples: CurveSamples) -> Floats:
    """(n_robots, m) linear between the values (n_robots, n_points - 1) at the start and the end of each
    interval."""
    start, end = (np.take_along_axis(a, samples.interval, axis=1) for a in between)
    return np.asarray(start + samples.interval_fraction * (end - start))


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


def pieces(samples: CurveSamples, n_strips: int, source: Ints, offset: Floats) -> Pieces:
    """Return the pieces of lines through segments: `samples` are those of `n_strips` segments, as many of
    each; line c runs through those of `source[c]` (n_lines,) at `offset` (1 or n_robots, n_lines, 2) along d1
    and d2 [m]."""
    n, count = samples.interval_fraction.shape
    ends = count // n_strips
    shape = n, len(source), ends - 1
    made = Pieces(np.empty((*shape, 3)), np.empty((*shape, 4)), np.empty(shape), np.empty(shape))
    at, orientation = (a.reshape(n, n_strips, ends, -1) for a in (samples.position, samples.quaternion))
    kernels.offset_pieces(at, orientation, source, offset, ends - 1, *made)
    return made
