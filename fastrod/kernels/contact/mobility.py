"""Obstacles that are free: how a rod's forces move them within the step, beside how they move the rod."""

from __future__ import annotations

from fastrod.types import Floats, Ints

from ..jit import inline, kernel
from ..vec import Vec, axpy, cross, dot, scale, sub
from .bvh import Numbers


@inline
def axis_of(axes: Numbers, a: int) -> Vec:
    """Axis a (normal, two tangents) of a contact, world."""
    return axes[3 * a], axes[3 * a + 1], axes[3 * a + 2]


@inline
def given_way(give: Numbers, here: Vec, there: Vec, force: Vec) -> Vec:
    """Motion of a body at `here` under a force at `there`: f t + (W (r x f)) x q, r and q from its centre of
    mass."""
    centre = (give[10], give[11], give[12])
    moment = cross(sub(there, centre), force)
    turn = (
        give[1] * moment[0] + give[2] * moment[1] + give[3] * moment[2],
        give[4] * moment[0] + give[5] * moment[1] + give[6] * moment[2],
        give[7] * moment[0] + give[8] * moment[1] + give[9] * moment[2],
    )
    return axpy(1.0, cross(turn, sub(here, centre)), scale(give[0], force))


@kernel
def add_mobility(
    m: int, touched: Numbers, place: Numbers, axes: Numbers, body: Ints, give: Floats, W: Floats
) -> None:
    """Add to the compliance W of m contacts what the bodies of the obstacles `touched` (-1: a rod) give way,
    both sides being pushed apart by the same force at `place` (3 each, world)."""
    for c in range(m):
        k = int(touched[c])
        if k < 0 or not give[k, 0] > 0.0:
            continue
        here = (place[3 * c], place[3 * c + 1], place[3 * c + 2])
        for e in range(m):
            h = int(touched[e])
            if h < 0 or body[h] != body[k]:
                continue
            there = (place[3 * e], place[3 * e + 1], place[3 * e + 2])
            for d in range(3):
                moved = given_way(give[k], here, there, axis_of(axes[9 * e :], d))
                for a in range(3):
                    W[3 * c + a, 3 * e + d] += dot(axis_of(axes[9 * c :], a), moved)
