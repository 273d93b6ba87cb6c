"""Unit meshes, and instances of them: all that moves is drawn as these, moved, rotated and stretched."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fastrod.types import Floats
from fastrod_viewer.picture.palette import Color, Colors

Singles = NDArray[np.float32]


class DrawnMesh(NamedTuple):
    """Triangles, counterclockwise seen from outside."""

    vertices: Singles
    """(n, 3)"""
    faces: NDArray[np.uint32]
    """(m, 3)"""


class Instances(NamedTuple):
    """Copies of one unit mesh; those that are not there have scale 0."""

    shape: str
    """Its name in `SHAPES`."""
    position: Singles
    """(n, 3) world [m]."""
    wxyz: Singles
    """(n, 4) unit quaternion, world_from_mesh."""
    scale: Singles
    """(n, 3) along the mesh's own axes [m]."""
    color: Colors
    """(n, 3)"""


def instances(shape: str, position: Floats, wxyz: Floats, scale: Floats, color: Colors | Color) -> Instances:
    """Build instances of arrays with any leading axes (..., 3), (..., 4), (..., 3); `color` (..., 3), or one
    for all."""
    position = position.reshape(-1, 3)
    n = len(position)
    colors = np.asarray(color, np.uint8)
    colors = np.broadcast_to(colors, (n, 3)) if colors.ndim == 1 else colors.reshape(-1, 3)
    return Instances(
        shape,
        position.astype(np.float32),
        wxyz.reshape(-1, 4).astype(np.float32),
        scale.reshape(-1, 3).astype(np.float32),
        np.ascontiguousarray(colors),
    )


def ball(position: Floats, radius: float, color: Color) -> Instances:
    """A ball at `position` (3,), or balls at (n, 3), world [m]; none where that is not finite."""
    centre = np.asarray(position, dtype=np.float64).reshape(-1, 3)
    there = np.isfinite(centre).all(1, keepdims=True)
    orientation = np.broadcast_to([1.0, 0.0, 0.0, 0.0], (len(centre), 4))
    return instances(
        "ball",
        np.where(there, centre, 0.0),
        orientation,
        np.where(there, np.full(centre.shape, radius), 0.0),
        color,
    )


def _lathe(profile: list[tuple[float, float]], n_sides: int) -> DrawnMesh:
    """The surface that a profile of (radius, z), from the lower end up, sweeps around z; a radius of 0 closes
    it in a point."""
    angle = np.linspace(0.0, 2.0 * np.pi, n_sides, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vertices: list[Floats] = []
    rings: list[NDArray[np.int64]] = []
    count = 0
    for radius, z in profile:
        n = n_sides if radius > 0.0 else 1
        vertices.append(np.column_stack([radius * around[:n], np.full(n, z)]))
        rings.append(count + np.arange(n_sides) % n)
        count += n
    faces: list[NDArray[np.int64]] = []
    for (low, _), lower, (high, _), upper in zip(profile, rings, profile[1:], rings[1:], strict=False):
        if low > 0.0:
            faces.append(np.stack([lower, np.roll(lower, -1), upper], axis=1))
        if high > 0.0:
            faces.append(np.stack([np.roll(lower, -1), np.roll(upper, -1), upper], axis=1))
    return DrawnMesh(np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.uint32))


def _arc(first: float, last: float, n: int) -> list[tuple[float, float]]:
    """(radius, z) on the unit circle between two latitudes [rad]; the poles are points."""
    latitude = np.linspace(first, last, n)
    return [(0.0 if abs(a) > np.pi / 2 - 1e-9 else float(np.cos(a)), float(np.sin(a))) for a in latitude]


SHAPES: Mapping[str, DrawnMesh] = MappingProxyType(
    {
        "tube": _lathe([(1.0, -0.5), (1.0, 0.5)], 24),
        "thin_tube": _lathe([(1.0, -0.5), (1.0, 0.5)], 8),
        "bar": _lathe([(0.0, -0.5), (1.0, -0.5), (1.0, 0.5), (0.0, 0.5)], 16),
        "disc": _lathe([(0.0, -0.5), (0.95, -0.5), (1.0, -0.3), (1.0, 0.3), (0.95, 0.5), (0.0, 0.5)], 32),
        "ball": _lathe(_arc(-np.pi / 2, np.pi / 2, 13), 24),
        "cone": _lathe([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)], 24),
        "cap": _lathe(_arc(0.0, np.pi / 2, 8), 24),
    }
)
"""Meshes of radius 1 around z. `tube` and `thin_tube`: open, from z = -1/2 to 1/2; `bar` and `disc`: the
same, closed, `disc` with a slight bevel; `ball`; `cone`: closed, base at z = 0, apex at z = 1; `cap`: the
half of a ball above z = 0, open below."""
