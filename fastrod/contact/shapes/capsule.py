"""A cylinder with round ends: radius and length of the straight part; centred, axis z."""

from __future__ import annotations

import math
from typing import Unpack

from fastrod.contact.closest import Signed, Triple
from fastrod.contact.geometry import Obstacle, Placement, obstacle
from fastrod.contact.primitive import Primitive, register
from fastrod.kernels.vec import Vec, unit


def capsule(radius: float, length: float, **options: Unpack[Placement]) -> Obstacle:
    """A cylinder of `length` with round ends [m], centred, axis z; `Obstacle` says what the options are, and
    what raises `InputError`."""
    return obstacle("capsule", (radius, length), **options)


def _distance(size: Vec, p: Vec) -> tuple[float, Vec]:
    axial = p[2] - min(max(p[2], -0.5 * size[1]), 0.5 * size[1])
    length, n = unit((p[0], p[1], axial), (1.0, 0.0, 0.0))
    return length - size[0], n


def _curvature(size: Vec, p: Vec) -> tuple[float, float, Vec]:
    radial = max(math.sqrt(p[0] * p[0] + p[1] * p[1]), 1e-12)
    over = abs(p[2]) - 0.5 * size[1]
    first = 1.0 / max(math.sqrt(radial * radial + max(over, 0.0) ** 2), 1e-12)
    return first, first if over > 0.0 else 0.0, (0.0, 0.0, 1.0)


def _twin(size: Triple, p: Triple) -> Signed:
    half = 0.5 * size[1]
    v = (p[0], p[1], p[2] - min(max(p[2], -half), half))
    r = math.hypot(*v)
    return r - size[0], ((v[0] / r, v[1] / r, v[2] / r) if r > 0.0 else (1.0, 0.0, 0.0))


register(
    Primitive(
        name="capsule",
        n_sizes=2,
        distance=_distance,
        curvature=_curvature,
        radius=lambda size: size[0] + 0.5 * size[1],
        width=lambda size: 2.0 * size[0] + size[1],
        drawing=lambda lib, size: lib.creation.capsule(radius=size[0], height=size[1]),
        twin=_twin,
    )
)
