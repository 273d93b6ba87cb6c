"""A solid cylinder: radius and length; centred, axis z."""

from __future__ import annotations

import math
from typing import Unpack

from fastrod.contact.closest import Signed, Triple, corner
from fastrod.contact.geometry import Obstacle, Placement, obstacle
from fastrod.contact.primitive import Primitive, register
from fastrod.kernels.vec import Vec, unit


def cylinder(radius: float, length: float, **options: Unpack[Placement]) -> Obstacle:
    """A solid cylinder with flat caps [m], centred, axis z; `Obstacle` says what the options are, and what
    raises `InputError`."""
    return obstacle("cylinder", (radius, length), **options)


def _distance(size: Vec, p: Vec) -> tuple[float, Vec]:
    radial, out = unit((p[0], p[1], 0.0), (1.0, 0.0, 0.0))
    side, cap = radial - size[0], abs(p[2]) - 0.5 * size[1]
    up = 1.0 if p[2] >= 0.0 else -1.0
    if side > 0.0 and cap > 0.0:
        length = math.sqrt(side * side + cap * cap)
        return length, (side / length * out[0], side / length * out[1], cap / length * up)
    return (side, out) if side >= cap else (cap, (0.0, 0.0, up))


def _curvature(size: Vec, p: Vec) -> tuple[float, float, Vec]:
    radial = max(math.sqrt(p[0] * p[0] + p[1] * p[1]), 1e-12)
    over = abs(p[2]) - 0.5 * size[1]
    if radial > size[0] and over > 0.0:  # the rim
        d = math.sqrt((radial - size[0]) ** 2 + over * over)
        return 1.0 / d, (radial - size[0]) / d / radial, (-p[1] / radial, p[0] / radial, 0.0)
    return (1.0 / radial if over <= 0.0 and radial - size[0] >= over else 0.0), 0.0, (0.0, 0.0, 1.0)


def _twin(size: Triple, p: Triple) -> Signed:
    r = math.hypot(p[0], p[1])
    side = (p[0] / r, p[1] / r, 0.0) if r > 0.0 else (1.0, 0.0, 0.0)
    return corner((r - size[0], abs(p[2]) - 0.5 * size[1]), (side, (0.0, 0.0, math.copysign(1.0, p[2]))))


register(
    Primitive(
        name="cylinder",
        n_sizes=2,
        distance=_distance,
        curvature=_curvature,
        radius=lambda size: math.hypot(size[0], 0.5 * size[1]),
        width=lambda size: max(2.0 * size[0], size[1]),
        drawing=lambda lib, size: lib.creation.cylinder(radius=size[0], height=size[1]),
        twin=_twin,
    )
)
