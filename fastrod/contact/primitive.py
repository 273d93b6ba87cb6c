"""`Primitive`: a simple shape as one record, and the registry of them.

A shape is a file: its two functions for numba, its record, `register`. Contact knows shapes by the addresses
of their compiled functions alone, so that a shape of one's own compiles in about a second and the kernels of
contact not again.
"""

from __future__ import annotations

import inspect
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import entry_points
from typing import Any, TypeAlias, TypeVar

from numba.core.errors import NumbaError

from fastrod.contact.closest import Signed, Triple
from fastrod.errors import InputError, nearest, shown
from fastrod.kernels.contact.primitive import CURVATURE, DISTANCE
from fastrod.kernels.jit import pointed

GROUP = "fastrod.primitives"
"""Entry points of installed packages: the name of a primitive, and the module that registers it."""

Distance: TypeAlias = Callable[[Triple, Triple], Signed]
_Function = TypeVar("_Function", bound=Callable[..., Any])

_TRIED = [p for p in itertools.product((-1.1, -0.4, 0.3, 1.2), repeat=3) if math.hypot(*p) > 1.0]
"""Points, in radii of the shape, at which a record is tried."""
_CLOSE = 1e-6  # of a radius: an iteration that ends has 1e-12, a distance that is none has 1e-2


@dataclass(frozen=True, kw_only=True, eq=False)
class Primitive:
    """A convex shape that rods can touch, in its own frame: everything that is known of it, in one place.

    `size` is three lengths [m], 0 beyond the `n_sizes` that the shape has. `distance` and `curvature` are
    plain functions (size, p) of tuples of floats that numba compiles: without arrays, calling nothing but
    `math` and what `fastrod.kernels.jit.inline` decorates. Raises `InputError` where a field cannot be.
    """

    name: str
    """One word: `Obstacle.shape`."""
    n_sizes: int
    """Lengths that it has, at most 3."""
    distance: Distance
    """Signed distance of p, negative inside [m], and its gradient, the outward unit normal."""
    curvature: Callable[[Triple, Triple], tuple[float, float, Triple]]
    """Principal curvatures of the distance at a point outside: rotation of the normal per length as p moves
    across the unit direction that is returned, and along it [1/m]."""
    radius: Callable[[Triple], float]
    """Radius of the ball about its origin that holds a shape of this size; inf where none does [m]."""
    width: Callable[[Triple], float]
    """The longest edge of its box [m]."""
    drawing: Callable[[Any, Triple], Any]
    """(trimesh, size) -> a new trimesh.Trimesh."""
    twin: Distance | None = None
    """`distance` once more, written another way in plain Python, for the direct path; None: itself."""

    def __post_init__(self) -> None:
        if not (isinstance(self.name, str) and self.name.isidentifier() and self.name != "mesh"):
            raise InputError(f"Primitive.name is {shown(self.name)}; give one word of letters, not 'mesh'.")
        if type(self.n_sizes) is not int or self.n_sizes not in range(4):
            raise InputError(f"primitive {self.name!r} has n_sizes {shown(self.n_sizes)}; give 0, 1, 2 or 3.")
        for field in ("distance", "curvature", "radius", "width", "drawing"):
            given = getattr(self, field)
            compiled = field in ("distance", "curvature")
            if not (inspect.isfunction(getattr(given, "py_func", given)) if compiled else callable(given)):
                raise InputError(f"{field} of primitive {self.name!r} is {shown(given)}; give a function.")

    @cached_property
    def _distance(self) -> tuple[Distance, int]:
        return self._compiled("distance", self.distance, DISTANCE)

    @cached_property
    def addresses(self) -> tuple[int, int]:
        """Addresses of the compiled distance and curvature in this process, for the kernels."""
        return self._distance[1], self._compiled("curvature", self.curvature, CURVATURE)[1]

    @property
    def plain(self) -> Distance:
        """The twin; where there is none, the compiled distance."""
        return self._distance[0] if self.twin is None else self.twin

    def check(self, size: Triple) -> None:
        """Raise `InputError` where a shape of this size has no distance, or is not convex."""
        signed, radius = self._distance[0], self.radius(size)
        scale = radius if math.isfinite(radius) else 1.0
        where = f"primitive {self.name!r} of size {_rounded(size)} m"
        first: Triple | None = None
        for x, y, z in _TRIED:
            p = (scale * x, scale * y, scale * z)
            d, n = signed(size, p)
            if d <= 0.0 and scale < radius:
                continue
            q = (p[0] - d * n[0], p[1] - d * n[1], p[2] - d * n[2])
            unit = abs(math.hypot(*n) - 1.0) < _CLOSE
            if not (d > 0.0 and unit and abs(signed(size, q)[0]) < _CLOSE * scale):
                raise InputError(
                    f"{where} has the distance {d:.6g} m and the normal {_rounded(n)} at {_rounded(p)} m; "
                    "beyond its radius a distance is positive, a normal has length 1, and the point one "
                    "distance back along it is on the surface."
                )
            first = first or q
            middle = (0.5 * (q[0] + first[0]), 0.5 * (q[1] + first[1]), 0.5 * (q[2] + first[2]))
            if signed(size, middle)[0] > _CLOSE * scale:
                raise InputError(
                    f"{where} is not convex: {_rounded(middle)} m is outside, between two points of its "
                    "surface; make a mesh of it."
                )

    def _compiled(self, field: str, function: _Function, signature: Any) -> tuple[_Function, int]:
        try:
            return pointed(function, signature)
        except NumbaError as error:
            why = " ".join(str(error).split())[:300]
            raise InputError(
                f"{field} of primitive {self.name!r} cannot be compiled by numba: {why}"
            ) from error


def _rounded(v: Triple) -> str:
    return f"({v[0]:.6g}, {v[1]:.6g}, {v[2]:.6g})"


_REGISTRY: dict[str, Primitive] = {}


def register(primitive: Primitive) -> Primitive:
    """Make a shape known by its name, and return it. Raises `InputError` where another has the name."""
    if not isinstance(primitive, Primitive):
        raise InputError(f"the primitive is {shown(primitive)}; give a fastrod.contact.Primitive.")
    taken = _REGISTRY.get(primitive.name, primitive).distance.__module__
    if taken != primitive.distance.__module__:
        raise InputError(f"a primitive named {primitive.name!r} is already registered by {taken}.")
    _REGISTRY[primitive.name] = primitive
    return primitive


def primitive_of(name: str) -> Primitive:
    """The shape of this name: a registered one, or one that an installed package brings. Raises `InputError`
    with the nearest name, or where a package cannot be loaded."""
    for plug_in in () if name in _REGISTRY else entry_points(group=GROUP, name=name):
        try:
            plug_in.load()
        except Exception as error:  # a stranger's module raises what it likes
            where = f"the primitive {name!r} of {plug_in.value!r}"
            raise InputError(f"{where} cannot be loaded: {shown(error)}") from error
    if name not in _REGISTRY:
        known = {"mesh", *_REGISTRY, *(found.name for found in entry_points(group=GROUP))}
        raise InputError(f"Obstacle.shape is {name!r}; {nearest(str(name), known)}")
    return _REGISTRY[name]
