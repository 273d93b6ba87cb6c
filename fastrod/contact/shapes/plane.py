"""A half-space, solid where z <= 0 of its own frame: no size."""

from __future__ import annotations

import math
from collections.abc import Sequence

from fastrod.contact.closest import Signed, Triple
from fastrod.contact.geometry import Obstacle, finite_numbers, obstacle
from fastrod.contact.primitive import Primitive, register
from fastrod.errors import InputError
from fastrod.kernels.vec import Vec

_SQUARE = [(-0.5, -0.5, 0.0), (0.5, -0.5, 0.0), (0.5, 0.5, 0.0), (-0.5, 0.5, 0.0)]


def plane(
    point: Sequence[float] = (0.0, 0.0, 0.0),
    normal: Sequence[float] = (0.0, 0.0, 1.0),
    *,
    name: str | None = None,
    friction: float = 0.0,
    stiffness: float = math.inf,
) -> Obstacle:
    """The half-space behind `point` [m]: solid opposite to `normal` (any length), both world frame at rest;
    see `Obstacle`.

    >>> plane(normal=(0.0, 0.0, -2.0)).quaternion
    (0.0, 1.0, 0.0, 0.0)
    """
    n = finite_numbers("plane normal", normal, 3, "1")
    length = math.hypot(*n)
    if length < 1e-12:
        raise InputError(f"plane normal is {list(n)!r}; it must have a direction, for example (0, 0, 1).")
    x, y, z = (v / length for v in n)
    w = math.sqrt(max(0.0, (1.0 + z) / 2.0))
    facing = (w, -y / (2.0 * w), x / (2.0 * w), 0.0) if w > 1e-6 else (0.0, 1.0, 0.0, 0.0)
    at = finite_numbers("plane point", point, 3, "m")
    return obstacle(
        "plane", name=name, position=at, quaternion=facing, friction=friction, stiffness=stiffness
    )


def _distance(size: Vec, p: Vec) -> tuple[float, Vec]:  # noqa: ARG001
    return p[2], (0.0, 0.0, 1.0)


def _curvature(size: Vec, p: Vec) -> tuple[float, float, Vec]:  # noqa: ARG001
    return 0.0, 0.0, (0.0, 0.0, 1.0)


def _twin(size: Triple, p: Triple) -> Signed:  # noqa: ARG001
    return p[2], (0.0, 0.0, 1.0)


register(
    Primitive(
        name="plane",
        n_sizes=0,
        distance=_distance,
        curvature=_curvature,
        radius=lambda _: math.inf,
        width=lambda _: math.inf,
        drawing=lambda lib, _: lib.Trimesh(_SQUARE, [(0, 1, 2), (0, 2, 3)], process=False),
        twin=_twin,
    )
)
