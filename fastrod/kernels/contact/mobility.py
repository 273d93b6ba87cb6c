"""Mobility of free bodies: motion of obstacles within the step under the forces of rods."""

from __future__ import annotations

from fastrod.types import Floats, Ints

from ..jit import inline, kernel
from ..vec import Vec, axpy, cross, dot, scale, sub
from .bvh import Numbers


@inline
def axis_of(axes: Floats, a: int) -> Vec:
    """Axis a (normal, two tangents) of a contact, world."""
    return axes[a, 0], axes[a, 1], axes[a, 2]


@inline
def point_of(rows: Floats, i: int) -> Vec:
    """Row i as a vector."""
    row = rows[i]
    return row[0], row[1], row[2]


@inline
def motion_under(mobility: Numbers, here: Vec, there: Vec, force: Vec) -> Vec:
    """Motion of a body at `here` under a force at `there`: f t + (W (r x f)) x q, r and q from its centre of
    mass."""
    centre = (mobility[10], mobility[11], mobility[12])
    moment = cross(sub(there, centre), force)
    rotation = (
        mobility[1] * moment[0] + mobility[2] * moment[1] + mobility[3] * moment[2],
        mobility[4] * moment[0] + mobility[5] * moment[1] + mobility[6] * moment[2],
        mobility[7] * moment[0] + mobility[8] * moment[1] + mobility[9] * moment[2],
    )
    return axpy(1.0, cross(rotation, sub(here, centre)), scale(mobility[0], force))


@kernel
def add_mobility(
    m: int, obstacle: Ints, place: Floats, axes: Floats, body: Ints, mobility: Floats, W: Floats
) -> None:
    """Add the motion of free bodies to the compliance W (3 m, 3 m) of m contacts with these obstacles (-1: a
    rod): rod and body are pushed apart by the same force at `place` (m, 3), world; `axes` (m, 3, 3)."""
    for c in range(m):
        k = obstacle[c]
        if k < 0 or not mobility[k, 0] > 0.0:
            continue
        here = point_of(place, c)
        for e in range(m):
            h = obstacle[e]
            if h < 0 or body[h] != body[k]:
                continue
            there = point_of(place, e)
            for d in range(3):
                moved = motion_under(mobility[k], here, there, axis_of(axes[e], d))
                for a in range(3):
                    W[3 * c + a, 3 * e + d] += dot(axis_of(axes[c], a), moved)
