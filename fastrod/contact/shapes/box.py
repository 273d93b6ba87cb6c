"""A cuboid: full edge lengths."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Unpack

from fastrod.contact.closest import Signed, Triple, corner
from fastrod.contact.geometry import Obstacle, Placement, obstacle
from fastrod.contact.primitive import Primitive, register
from fastrod.kernels.vec import Vec, dot, unit


def box(size: Sequence[float], **options: Unpack[Placement]) -> Obstacle:
    """A cuboid with full edge lengths `size` [m], centred; `Obstacle` says what the options are, and what
    raises `InputError`."""
    return obstacle("box", size, **options)


def _distance(size: Vec, p: Vec) -> tuple[float, Vec]:
    x, y, z = abs(p[0]) - 0.5 * size[0], abs(p[1]) - 0.5 * size[1], abs(p[2]) - 0.5 * size[2]
    sx, sy, sz = math.copysign(1.0, p[0]), math.copysign(1.0, p[1]), math.copysign(1.0, p[2])
    if max(x, max(y, z)) > 0.0:
        length, n = unit((max(x, 0.0), max(y, 0.0), max(z, 0.0)), (0.0, 0.0, 1.0))
        return length, (n[0] * sx, n[1] * sy, n[2] * sz)
    if x >= y and x >= z:
        return x, (sx, 0.0, 0.0)
    return (y, (0.0, sy, 0.0)) if y >= z else (z, (0.0, 0.0, sz))


def _curvature(size: Vec, p: Vec) -> tuple[float, float, Vec]:
    first, second, along = 0.0, 0.0, (0.0, 0.0, 1.0)
    x, y, z = abs(p[0]) - 0.5 * size[0], abs(p[1]) - 0.5 * size[1], abs(p[2]) - 0.5 * size[2]
    beyond = (max(x, 0.0), max(y, 0.0), max(z, 0.0))
    sides = (1.0 if x > 0.0 else 0.0) + (1.0 if y > 0.0 else 0.0) + (1.0 if z > 0.0 else 0.0)
    if sides > 1.5:
        first = 1.0 / math.sqrt(dot(beyond, beyond))
        second = first if sides > 2.5 else 0.0
        if sides < 2.5:
            along = (0.0 if x > 0.0 else 1.0, 0.0 if y > 0.0 else 1.0, 0.0 if z > 0.0 else 1.0)
    return first, second, along


def _twin(size: Triple, p: Triple) -> Signed:
    x, y, z = (math.copysign(1.0, v) for v in p)
    depth = tuple(abs(v) - 0.5 * edge for v, edge in zip(p, size, strict=True))
    return corner(depth, ((x, 0.0, 0.0), (0.0, y, 0.0), (0.0, 0.0, z)))


register(
    Primitive(
        name="box",
        n_sizes=3,
        distance=_distance,
        curvature=_curvature,
        radius=lambda size: 0.5 * math.hypot(*size),
        width=max,
        drawing=lambda lib, size: lib.creation.box(extents=size),
        twin=_twin,
    )
)
