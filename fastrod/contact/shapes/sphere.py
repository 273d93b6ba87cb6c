"""A ball: radius."""

from __future__ import annotations

import math
from typing import Unpack

from fastrod.contact.closest import Signed, Triple
from fastrod.contact.geometry import Obstacle, Placement, obstacle
from fastrod.contact.primitive import Primitive, register
from fastrod.kernels.vec import Vec, dot, unit


def sphere(radius: float, **options: Unpack[Placement]) -> Obstacle:
    """A ball of `radius` [m]; `Obstacle` says what the options are, and what raises `InputError`."""
    return obstacle("sphere", (radius,), **options)


def _distance(size: Vec, p: Vec) -> tuple[float, Vec]:
    length, n = unit(p, (0.0, 0.0, 1.0))
    return length - size[0], n


def _curvature(size: Vec, p: Vec) -> tuple[float, float, Vec]:  # noqa: ARG001
    first = 1.0 / max(math.sqrt(dot(p, p)), 1e-12)
    return first, first, (0.0, 0.0, 1.0)


def _twin(size: Triple, p: Triple) -> Signed:
    r = math.hypot(*p)
    return r - size[0], ((p[0] / r, p[1] / r, p[2] / r) if r > 0.0 else (0.0, 0.0, 1.0))


register(
    Primitive(
        name="sphere",
        n_sizes=1,
        distance=_distance,
        curvature=_curvature,
        radius=lambda size: size[0],
        width=lambda size: 2.0 * size[0],
        drawing=lambda lib, size: lib.creation.icosphere(subdivisions=3, radius=size[0]),
        twin=_twin,
    )
)
