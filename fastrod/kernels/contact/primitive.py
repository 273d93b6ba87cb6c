"""Signed distance to a simple shape, its curvature and the first hit of a ray on it; everything in the
shape's own frame.

No shape is known here: an obstacle brings the addresses of its shape's two compiled functions
(`fastrod.contact.primitive`), so that a new shape compiles these and none of the kernels.
"""

from __future__ import annotations

from numba import types

from ..jit import caller, kernel
from ..vec import Vec, axpy, dot
from .bvh import FAR

_VEC = types.UniTuple(types.float64, 3)  # type: ignore[no-untyped-call]
DISTANCE = types.Tuple((types.float64, _VEC))(_VEC, _VEC)  # type: ignore[no-untyped-call]
"""(size, p) -> signed distance of p and its gradient, the outward unit normal."""
CURVATURE = types.Tuple((types.float64, types.float64, _VEC))(_VEC, _VEC)  # type: ignore[no-untyped-call]
"""(size, p) -> what `surface_curvature` returns of p, in the frame of the shape."""

signed_at = caller(DISTANCE)
"""(address, size, p) -> signed distance of p and its gradient."""
curvature_at = caller(CURVATURE)
"""(address, size, p) -> principal curvatures of the distance at p, and the direction of the second."""


@kernel
def ray_primitive(signed: int, size: Vec, p: Vec, direction: Vec, longest: float) -> float:
    """Length to the surface along a unit direction, by stepping to tangent planes; FAR where it is not met up
    to `longest`. `signed`: address of the shape's distance."""
    if signed_at(signed, size, p)[0] < 0.0:
        return _exit_length(signed, size, p, direction, longest)
    t = 0.0
    for _ in range(512):
        d, n = signed_at(signed, size, axpy(t, direction, p))
        away = dot(n, direction)
        if abs(d) < 1e-10:
            return t
        if away >= 0.0:
            return FAR  # every shape here is convex: what moves away stays away
        # the tangent plane lies between a convex shape and what is outside it: a step to it is safe
        t += d / -away
        if t > longest:
            return FAR
    return FAR


@kernel
def _exit_length(signed: int, size: Vec, p: Vec, direction: Vec, longest: float) -> float:
    """Return the exit length of a ray from inside: the distance is convex along the ray, so it has one
    root there; by doubling, then bisection."""
    low, high = 0.0, 1e-3
    while signed_at(signed, size, axpy(high, direction, p))[0] < 0.0:
        low, high = high, 2.0 * high
        if low > longest or low > 1e9:
            return FAR
    for _ in range(60):
        middle = 0.5 * (low + high)
        if signed_at(signed, size, axpy(middle, direction, p))[0] < 0.0:
            low = middle
        else:
            high = middle
    return high if high <= longest else FAR
