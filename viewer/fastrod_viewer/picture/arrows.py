"""Arrows, axes, ghosts and trails, as instances."""

from __future__ import annotations

from typing import final

import numpy as np

from fastrod.errors import InputError
from fastrod.rotation import product
from fastrod.types import Floats
from fastrod_viewer.picture.curves import aim, tangents
from fastrod_viewer.picture.palette import AXES, Color, blend
from fastrod_viewer.picture.shapes import Instances, instances

_AXIS_ORIENTATIONS = np.array(
    [[np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0], [np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]
)
"""Rotations of z to x, y and z."""
_PAPER: Color = (255, 255, 255)


def arrows(
    start: Floats, direction: Floats, length: Floats, radius: float, color: Color
) -> tuple[Instances, Instances]:
    """Shafts and heads from `start` (n, 3), world [m], along unit vectors `direction` (n, 3), `length` (n,)
    [m] in all.

    `radius` [m] of the shaft; short arrows are thinner. Where the length is 0 there is none.
    """
    head = np.minimum(6.0 * radius, 0.5 * length)
    thick = 0.4 * head
    thin = np.minimum(radius, 0.5 * thick)
    orientation = aim(direction)
    shaft = length - head
    return (
        instances(
            "bar",
            start + direction * (0.5 * shaft)[:, None],
            orientation,
            np.stack([thin, thin, shaft], axis=1),
            color,
        ),
        instances(
            "cone",
            start + direction * shaft[:, None],
            orientation,
            np.stack([thick, thick, head], axis=1),
            color,
        ),
    )


def frames(position: Floats, quaternion: Floats, length: float) -> Instances:
    """Red, green and blue axes of frames at `position` (n, 3) [m], `quaternion` (n, 4) world_from_frame,
    `length` [m] long."""
    orientations = product(
        quaternion[:, None, :], np.broadcast_to(_AXIS_ORIENTATIONS, (len(quaternion), 3, 4))
    )
    ends = position[:, None, :] + 0.5 * length * tangents(orientations)
    scale = np.broadcast_to([0.04 * length, 0.04 * length, length], (*orientations.shape[:2], 3))
    return instances(
        "bar", ends, orientations, scale, np.broadcast_to(np.array(AXES, np.uint8), (len(position), 3, 3))
    )


def ghost(points: Floats, radius: float, color: Color) -> Instances:
    """A thin chain through points (n, 3), world [m]: n - 1 pieces, without those to points that are not
    finite. Raises `InputError` on fewer than two points."""
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
        raise InputError(
            f"points has shape {points.shape}; a ghost needs (n, 3) with two or more points [m]."
        )
    return _polyline(points, np.full(len(points) - 1, radius), color)


def _polyline(points: Floats, radius: Floats, color: Color) -> Instances:
    there = np.asarray(np.isfinite(points[1:] + points[:-1]).all(axis=1))
    points = np.where(np.isfinite(points), points, 0.0)
    chord = points[1:] - points[:-1]
    length = np.where(there, np.linalg.norm(chord, axis=1), 0.0)
    thick = np.where(there, radius, 0.0)
    orientation = aim(np.where(there[:, None], chord, 0.0) / np.maximum(length, 1e-30)[:, None])
    return instances(
        "thin_tube",
        0.5 * (points[1:] + points[:-1]),
        orientation,
        np.stack([thick, thick, length], axis=1),
        color,
    )


@final
class Trail:
    """Trail of a point: a line that fades toward its old end."""

    def __init__(self, capacity: int, min_step: float) -> None:
        """Make a trail of `capacity` pieces, each at least `min_step` [m] long. Raises `InputError`."""
        if capacity < 1 or not min_step >= 0.0:
            raise InputError(
                f"a trail of {capacity} pieces of {min_step} m cannot be; give one piece or "
                "more, of 0 m or more."
            )
        self.capacity, self.min_step = capacity, min_step
        self._points = np.full((capacity + 1, 3), np.nan)
        self._drawn: tuple[float, Color, Instances] | None = None

    def __len__(self) -> int:
        """Positions that are kept, at most `capacity` + 1."""
        return int(np.isfinite(self._points[:, 0]).sum())

    def add(self, position: Floats) -> None:
        """The point is now at `position` (3,), world [m]; left out where it has hardly moved or is not
        finite."""
        step = np.linalg.norm(np.asarray(position) - self._points[-1])
        if np.isfinite(position).all() and not step < self.min_step:
            self._points[:-1] = self._points[1:]
            self._points[-1] = position
            self._drawn = None

    def instances(self, radius: float, color: Color) -> Instances:
        """`capacity` pieces, oldest first; the newest has the full `radius` [m] and colour."""
        if self._drawn is None or self._drawn[:2] != (radius, color):
            age = np.linspace(0.0, 1.0, self.capacity + 1)[1:]
            line = _polyline(self._points, radius * (0.3 + 0.7 * age), color)
            self._drawn = (
                radius,
                color,
                line._replace(color=blend(color, _PAPER, 0.85 * (1.0 - age)[:, None])),
            )
        return self._drawn[2]

    def clear(self) -> None:
        """Forget all."""
        self._points[:] = np.nan
        self._drawn = None
