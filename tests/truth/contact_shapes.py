"""Obstacles as signed distances with gradient and second derivative: numpy only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


class Distance(NamedTuple):
    """Signed distance to a solid at points, positive outside; curvature for Newton's method."""

    value: Floats
    """(p,) [m]."""
    normal: Floats
    """(p, 3) gradient: unit, away from the solid."""
    hessian: Floats
    """(p, 3, 3) [1/m]."""


@dataclass(frozen=True)
class HalfSpace:
    """All points with (p - point) . normal <= 0 are solid."""

    point: ArrayLike
    normal: ArrayLike

    def distance(self, p: Floats) -> Distance:
        """Signed distance of points (p, 3)."""
        n = _unit(self.normal)
        depth = (p - np.asarray(self.point)) @ n
        return Distance(depth, np.broadcast_to(n, p.shape), np.zeros((*p.shape, 3)))


@dataclass(frozen=True)
class Sphere:
    """A ball of `radius` [m]."""

    centre: ArrayLike
    radius: float

    def distance(self, p: Floats) -> Distance:
        """Signed distance of points (p, 3)."""
        d, n = _length_and_direction(p - np.asarray(self.centre))
        return Distance(d - self.radius, n, (np.eye(3) - outer(n, n)) / d[:, None, None])


@dataclass(frozen=True)
class Cylinder:
    """A bar of `radius` [m] about the line through `point` along `axis`, of twice `half_length` [m]."""

    point: ArrayLike
    axis: ArrayLike
    radius: float
    half_length: float = np.inf

    def distance(self, p: Floats) -> Distance:
        """Signed distance of points (p, 3)."""
        a = _unit(self.axis)
        along = (p - np.asarray(self.point)) @ a
        d, n = _length_and_direction(p - np.asarray(self.point) - along[:, None] * a)
        round_ = (np.eye(3) - np.outer(a, a) - outer(n, n)) / d[:, None, None]
        side, end = d - self.radius, np.abs(along) - self.half_length
        cap = np.sign(along)[:, None] * a
        out, up = np.maximum(side, 0.0), np.maximum(end, 0.0)
        corner, c = _length_and_direction(out[:, None] * n + up[:, None] * cap)
        on_side, on_end = (end <= 0.0) & (side >= end), (side <= 0.0) & (end > side)
        value = np.where(on_side, side, np.where(on_end, end, corner))
        normal = np.where(on_side[:, None], n, np.where(on_end[:, None], cap, c))
        rim = outer(n, n) + np.outer(a, a) - outer(c, c) + out[:, None, None] * round_
        rim = rim / corner[:, None, None]
        hessian = np.where(on_side[:, None, None], round_, np.where(on_end[:, None, None], 0.0, rim))
        return Distance(value, normal, hessian)


@dataclass(frozen=True)
class Box:
    """A box with half edges `half` (3,) [m] about `centre`; its directions are the columns of `axes`."""

    centre: ArrayLike
    half: ArrayLike
    axes: ArrayLike = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

    def distance(self, p: Floats) -> Distance:
        """Signed distance of points (p, 3)."""
        axes = np.asarray(self.axes, dtype=float)
        local = (p - np.asarray(self.centre)) @ axes
        over = np.abs(local) - np.asarray(self.half)
        out = np.maximum(over, 0.0)
        d, n = _length_and_direction(np.sign(local) * out)
        inside = over.max(axis=1) <= 0.0
        face = np.sign(local) * np.eye(3)[np.argmax(over, axis=1)]
        curved = ((out > 0.0)[:, :, None] * np.eye(3) - outer(n, n)) / d[:, None, None]
        value = np.where(inside, over.max(axis=1), d)
        normal = np.where(inside[:, None], face, n)
        hessian = np.where(inside[:, None, None], 0.0, curved)
        return Distance(value, normal @ axes.T, axes @ hessian @ axes.T)


@dataclass(frozen=True)
class Tube:
    """All points further than `radius` [m] from the line through `point` along `axis`: the rod is inside."""

    point: ArrayLike
    axis: ArrayLike
    radius: float

    def distance(self, p: Floats) -> Distance:
        """Signed distance of points (p, 3)."""
        bar = Cylinder(self.point, self.axis, self.radius).distance(p)
        return Distance(-bar.value, -bar.normal, -bar.hessian)


Obstacle = HalfSpace | Sphere | Cylinder | Box | Tube
_KINDS = {"half_space": HalfSpace, "sphere": Sphere, "cylinder": Cylinder, "box": Box, "tube": Tube}


def obstacle(description: dict[str, Any]) -> Obstacle:
    """The obstacle of a plain dict: its `kind` and the fields of that class."""
    fields = dict(description)
    made: Obstacle = _KINDS[fields.pop("kind")](**fields)
    return made


def _unit(a: ArrayLike) -> Floats:
    v = np.asarray(a, dtype=float)
    return v / np.linalg.norm(v)


def _length_and_direction(v: Floats) -> tuple[Floats, Floats]:
    """Return length and direction of (p, 3); on the point itself a zero vector, and a length that can
    divide."""
    d = np.linalg.norm(v, axis=1)
    some = np.maximum(d, 1e-12)
    return some, v / some[:, None]


def outer(a: Floats, b: Floats) -> Floats:
    return a[..., :, None] * b[..., None, :]
