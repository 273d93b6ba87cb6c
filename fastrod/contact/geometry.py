"""Geometry that a rod can touch: `Obstacle`, checked once, and `mesh` and `obstacle`, which make one.

>>> ball = obstacle("sphere", (0.02,), position=(0.0, 0.0, 0.1), friction=0.3)
>>> ball.name, ball.shape, ball.size
('sphere', 'sphere', (0.02, 0.0, 0.0))
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypedDict, Unpack

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fastrod.contact.closest import Triple
from fastrod.contact.meshfile import FORMATS, MeshLimits, read_mesh
from fastrod.contact.primitive import primitive_of
from fastrod.errors import InputError, nearest
from fastrod.types import Floats, Ints

if TYPE_CHECKING:
    import trimesh

Quadruple: TypeAlias = tuple[float, float, float, float]

_LARGEST = 10.0  # m; a larger obstacle was given in mm, unless who gives it says `widest`
_FARTHEST = 1e6  # m; of any vertex, used or not: beyond it squares and products leave what a float can hold
_SMALLEST = 1e-4  # m; a smaller one was scaled twice
# height of a face over its longest edge; a float32 file cannot say which way a flatter one points
_SLIVER = 1e-7
_MOST_SLIVERS = 100_000  # a mesh of more was not made to be a solid, and joining them takes a minute
_USUAL_FRICTION, _LARGEST_FRICTION = 5.0, 10.0


def finite_numbers(where: str, values: object, count: int, unit: str) -> tuple[float, ...]:
    """`values` as floats. Raises `InputError` where they are not `count` finite numbers [`unit`]."""
    try:
        numbers = tuple(float(v) for v in values)  # type: ignore[attr-defined]
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != count or not all(math.isfinite(v) for v in numbers):
        raise InputError(f"{where} is {values!r}; it must be {count} finite numbers [{unit}].")
    return numbers


def _number(where: str, value: object, unit: str) -> float:
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise InputError(f"{where} is {value!r}; it must be a number [{unit}].") from None


def _check_extent(where: str, extent: float, widest: float, remedy: str) -> None:
    if not extent <= widest:
        raise InputError(
            f"{where} is {extent:.6g} m wide; more than {widest:g} m. Was it given in mm? "
            f"{remedy}=0.001 fixes that. If it is so large, widest={1.01 * extent:.3g} lets it be."
        )
    if extent < _SMALLEST:
        raise InputError(
            f"{where} is {extent:.3g} m wide; tiny, less than {_SMALLEST:g} m. Was it scaled from mm twice?"
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Obstacle:
    """A rigid or springy body that rods can touch, in its own frame, and where it stands at rest.

    Make one with `mesh`, with `sphere`, `box` and the like, or by the name of its shape with `obstacle`. Two
    obstacles are equal only where they are the same object. Raises `InputError` where a number is out of
    range.
    """

    name: str
    shape: str
    """ "mesh", or the name of a `Primitive`."""
    size: Triple
    """Lengths of the shape, as its own function says, and 0 for those that it does not have; all 0 of a mesh
    [m]."""
    vertices: Floats
    """(n_vertices, 3) obstacle frame [m]; (0, 3) for anything but a mesh."""
    faces: Ints
    """(n_faces, 3) vertices of each face, counter-clockwise seen from outside; (0, 3) for anything but a
    mesh."""
    position: Triple
    """world_from_obstacle at rest [m]."""
    quaternion: Quadruple
    """world_from_obstacle at rest, w x y z."""
    friction: float
    """Coulomb coefficient; 0 is frictionless."""
    stiffness: float
    """Force per depth [N/m]; inf is rigid."""
    closed: bool
    """The surface has no open edge, so every point of space is inside or outside."""

    def __post_init__(self) -> None:
        where = f"{self.shape} {self.name!r}"
        primitive = None if self.shape == "mesh" else primitive_of(self.shape)
        size: Any = finite_numbers(f"size of {where}", self.size, 3, "m")
        used = 0 if primitive is None else primitive.n_sizes
        if any(v <= 0.0 for v in size[:used]) or any(size[used:]):
            need = f"{used} positive and {3 - used} zero" if used < 3 else "3 positive"
            raise InputError(f"size of {where} is {list(size)!r} m; a {self.shape} needs {need} numbers.")
        vertices, faces = _arrays(where, self.vertices, self.faces)
        if (self.shape == "mesh") != (len(faces) > 0):
            raise InputError(
                f"{where} has {len(faces)} faces; a mesh needs some, and any other shape has none."
            )
        position = finite_numbers(f"position of {where}", self.position, 3, "m")
        quaternion = finite_numbers(f"quaternion of {where}", self.quaternion, 4, "w x y z")
        if abs(math.hypot(*quaternion) - 1.0) > 1e-6:
            raise InputError(
                f"quaternion of {where} is {list(quaternion)!r} with norm "
                f"{math.hypot(*quaternion):.6g}; it must be 1."
            )
        friction = _number(f"friction of {where}", self.friction, "1")
        if not 0.0 <= friction <= _LARGEST_FRICTION:
            raise InputError(
                f"friction of {where} is {friction!r}; a Coulomb coefficient is between 0 and "
                f"{_LARGEST_FRICTION:g}."
            )
        if friction > _USUAL_FRICTION:
            warnings.warn(
                f"friction of {where} is {friction!r}; unusual: most pairs have less than 1.", stacklevel=4
            )
        stiffness = _number(f"stiffness of {where}", self.stiffness, "N/m")
        if not stiffness > 0.0:
            raise InputError(
                f"stiffness of {where} is {stiffness!r} N/m; it must be positive, or inf for a rigid one."
            )
        checked = (size, vertices, faces, position, quaternion, friction, stiffness)
        for name, value in zip(
            ("size", "vertices", "faces", "position", "quaternion", "friction", "stiffness"),
            checked,
            strict=True,
        ):
            object.__setattr__(self, name, value)

    def as_trimesh(self) -> trimesh.Trimesh:
        """A new trimesh.Trimesh in the obstacle frame [m], for drawing; a plane is a square of 1 m. Needs
        trimesh."""
        lib = _trimesh()
        if self.shape != "mesh":
            made = primitive_of(self.shape).drawing(lib, self.size)
        else:
            made = lib.Trimesh(vertices=self.vertices.copy(), faces=self.faces.copy(), process=False)
        return made  # type: ignore[no-any-return]


class Placement(TypedDict, total=False):
    """The options of every obstacle; `Obstacle` says what each is."""

    name: str | None
    position: Sequence[float]
    quaternion: Sequence[float]
    friction: float
    stiffness: float
    widest: float
    """[m], beyond which lengths are taken for millimetres."""


def obstacle(shape: str, size: Sequence[float] = (), **given: Unpack[Placement]) -> Obstacle:
    """A simple shape by its name (`Primitive.name`), with the lengths that it has [m]; `Obstacle` says what
    the options are, and what raises `InputError`."""
    primitive = primitive_of(shape)
    n_sizes = primitive.n_sizes
    options: dict[str, Any] = {
        "widest": _LARGEST,
        "position": (0.0, 0.0, 0.0),
        "quaternion": (1.0, 0.0, 0.0, 0.0),
        "friction": 0.0,
        "stiffness": math.inf,
    }
    known = Placement.__annotations__
    for option, value in given.items():
        if option not in known:
            raise InputError(f"a {shape} has no option {option!r}; {nearest(option, known)}")
        options[option] = value
    options["name"] = options.get("name") or shape
    full = finite_numbers(f"size of {shape} {options['name']!r}", size, n_sizes, "m") + (0.0,) * (3 - n_sizes)
    none, nothing = np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)
    fields: dict[str, Any] = {"size": full, "vertices": none, "faces": nothing, "closed": True}
    widest = options.pop("widest")
    made = Obstacle(shape=shape, **fields, **options)
    if n_sizes:
        _check_extent(f"{shape} {made.name!r}", primitive.width(made.size), widest, "a factor")
    return made


def mesh(
    source: object,
    *,
    name: str | None = None,
    position: Sequence[float] = (0.0, 0.0, 0.0),
    quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
    scale: float = 1.0,
    friction: float = 0.0,
    stiffness: float = math.inf,
    open_surface: bool = False,
    limits: MeshLimits | None = None,
    widest: float = _LARGEST,
) -> Obstacle:
    """A triangle mesh: a file (.stl, .obj, .ply, .off, .glb), a trimesh.Trimesh (left untouched), or
    (vertices, faces).

    Vertices times `scale` are metres in the obstacle frame. A file of several bodies becomes one mesh.
    Duplicate vertices are merged and degenerate faces dropped. The mesh must be watertight with its faces
    counter-clockwise seen from outside; an inverted body inside another is a cavity. `open_surface` takes a
    surface with open edges, or a closed one that faces inwards, as one-sided: the solid lies behind its
    normals. `limits`, by default those of `MeshLimits()`, are what reading a file may cost; materials and
    whatever else a file refers to are not opened. A mesh beyond `widest` [m] is taken for one in millimetres.

    Raises `InputError` where there is no such mesh, or where it is empty, broken, open, inverted, of a wrong
    scale or beyond `limits`.
    """
    given, corners, triangles = _read(source, MeshLimits() if limits is None else limits)
    name = name or given or "mesh"
    where = f"mesh {name!r}"
    vertices, faces = _arrays(where, corners, triangles)
    factor = _number(f"scale of {where}", scale, "1")
    if not (math.isfinite(factor) and factor > 0.0):
        raise InputError(
            f"scale of {where} is {factor!r}; it must be positive and finite, for example "
            "0.001 for a file in mm."
        )
    if len(vertices) and (far := float(np.abs(vertices).max()) * factor) > _FARTHEST:
        raise InputError(
            f"{where} has a vertex {far:.6g} m from its origin; more than {_FARTHEST:g} m. Was it given in "
            "mm? scale=0.001 fixes that."
        )
    vertices, faces = _merged(vertices * factor, faces)
    faces = _without_slivers(where, vertices, faces)
    if not len(faces) or not (_heights(vertices, faces)[0] > 1e-14).any():
        raise InputError(
            f"{where} is empty: it has {len(triangles)} faces and none with an area; give a "
            "surface of triangles."
        )
    _check_extent(where, float(np.ptp(vertices, axis=0).max()), widest, "scale")
    closed = _check_surface(where, vertices, faces, open_surface)
    pose: dict[str, Any] = {"position": position, "quaternion": quaternion}  # `Obstacle` checks them
    return Obstacle(
        name=name,
        shape="mesh",
        size=(0.0, 0.0, 0.0),
        vertices=vertices,
        faces=faces,
        closed=closed,
        friction=friction,
        stiffness=stiffness,
        **pose,
    )


def _trimesh() -> Any:
    try:
        import trimesh
    except ImportError as error:
        raise InputError(
            "meshes need the package trimesh, which is not installed; install it, or give (vertices, faces)."
        ) from error
    return trimesh


def _read(source: object, limits: MeshLimits) -> tuple[str | None, Any, Any]:
    """A name where the source has one, its vertices and its faces."""
    if isinstance(source, (str, os.PathLike)):
        path = Path(source)
        if not path.is_file():
            near = (
                [p.name for p in path.parent.iterdir() if p.suffix[1:].lower() in FORMATS]
                if path.parent.is_dir()
                else []
            )
            raise InputError(f"there is no mesh file {str(path)!r}; {nearest(path.name, near)}")
        return path.stem, *read_mesh(path, limits)
    if isinstance(source, (tuple, list)) and len(source) == 2:
        return None, source[0], source[1]
    lib = None if isinstance(source, (tuple, list)) else _trimesh()
    if lib is not None and isinstance(source, lib.Trimesh):
        return None, np.array(source.vertices), np.array(source.faces)
    raise InputError(
        f"mesh source is a {type(source).__name__}; give a file, a trimesh.Trimesh, or (vertices, faces)."
    )


def _arrays(where: str, vertices: Any, faces: Any) -> tuple[Floats, Ints]:
    """Copies as (n_vertices, 3) floats and (n_faces, 3) integers, all finite and in range."""
    try:
        v, f = np.array(vertices, dtype=np.float64), np.array(faces)
    except (TypeError, ValueError):
        raise InputError(
            f"{where} has vertices or faces that are no table of numbers; give (n, 3) "
            "positions and (m, 3) indices."
        ) from None
    f = f.reshape(0, 3) if f.size == 0 else f
    v = v.reshape(0, 3) if v.size == 0 else v
    if v.ndim != 2 or v.shape[1] != 3:
        raise InputError(f"{where} has vertices of shape {v.shape}; they must be (n_vertices, 3).")
    if f.ndim != 2 or f.shape[1] != 3 or (f.size and not np.issubdtype(f.dtype, np.integer)):
        raise InputError(
            f"{where} has faces of shape {f.shape} and type {f.dtype}; they must be (n_faces, "
            "3) integers: triangles only."
        )
    broken = np.flatnonzero(~np.isfinite(v).all(axis=1))
    if len(broken):
        row = broken[0]
        raise InputError(
            f"vertex {row} of {where} is {v[row].tolist()!r}; all must be finite "
            f"({len(broken)} of {len(v)} are not)."
        )
    wrong = np.flatnonzero(((f < 0) | (f >= len(v))).any(axis=1))
    if len(wrong):
        row = wrong[0]
        raise InputError(
            f"face {row} of {where} is {f[row].tolist()!r}; its numbers must be between 0 and "
            f"{len(v) - 1}, the last vertex."
        )
    return np.ascontiguousarray(v), np.ascontiguousarray(f, dtype=np.int64)


def _merged(vertices: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """Each position once, faces with a corner twice dropped, vertices without a face dropped."""
    if not len(faces):
        return vertices, faces
    step = 1e-9 * max(float(np.ptp(vertices, axis=0).max()), 1e-300)
    grid = np.round((vertices - vertices.min(axis=0)) / step).astype(np.int64)
    _, first, to = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    faces = to.reshape(-1)[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    used, renamed = np.unique(faces, return_inverse=True)
    return vertices[first[used]], renamed.reshape(-1, 3).astype(np.int64)


def _heights(vertices: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """(n_faces,) height of each face over its longest edge, and (n_faces,) which edge that is."""
    corner = vertices[faces]
    edge = np.roll(corner, -1, axis=1) - corner
    square = (edge**2).sum(-1)
    area = np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=1)
    return area / np.maximum(square.max(axis=1), 1e-300), square.argmax(axis=1)


def _without_slivers(where: str, vertices: Floats, faces: Ints) -> Ints:
    """Faces without area joined into the neighbour at their longest edge, so that the surface stays
    closed."""
    n = len(vertices)
    for _ in range(20):
        height, longest = _heights(vertices, faces)
        flat = np.flatnonzero(height < _SLIVER)
        if not len(flat) or len(flat) == len(faces):
            break
        if len(flat) > _MOST_SLIVERS:
            raise InputError(
                f"{where} has {len(flat)} faces without area, of {len(faces)}; fix it first, "
                "in the program that made it."
            )
        keys = faces.ravel() * n + np.roll(faces, -1, axis=1).ravel()  # one for each directed edge
        order = np.argsort(keys, kind="stable")
        ordered = keys[order]

        def owner(start: Ints, end: Ints, order: Ints = order, ordered: Ints = ordered) -> Ints:
            """The last face that has each edge; -1 where none has."""
            found = np.searchsorted(ordered, start * n + end, side="right") - 1
            return np.where((found >= 0) & (ordered[found] == start * n + end), order[found] // 3, -1)

        p, q, r = (faces[flat, (longest[flat] + m) % 3] for m in range(3))
        beside = owner(q, p)
        d = faces[beside].sum(axis=1) - p - q
        there = (owner(r, d) >= 0) | (owner(d, r) >= 0)
        touched: set[int] = set()
        made: set[tuple[int, int]] = set()
        gone = []
        for i, k, *corners, is_there in zip(
            *(a.tolist() for a in (flat, beside, p, q, r, d, there)), strict=True
        ):
            if i in touched:
                continue
            if k < 0:  # at an open edge: nothing is lost with it
                gone.append(i)
                continue
            a, b, c, e = corners
            if k in touched or is_there or (min(c, e), max(c, e)) in made:
                continue
            faces[i], faces[k] = (c, a, e), (e, b, c)
            made.add((min(c, e), max(c, e)))
            touched |= {i, k}
        if not touched and not gone:
            break
        faces = np.delete(faces, gone, axis=0)
    return faces


def _check_surface(where: str, vertices: Floats, faces: Ints, open_surface: bool) -> bool:
    """True where no edge is open; raises where the winding is broken, the surface open against its word, or a
    body inside out."""
    n = len(vertices)
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    _, index, count = np.unique(
        np.minimum(start, end) * n + np.maximum(start, end), return_inverse=True, return_counts=True
    )
    net = np.abs(np.bincount(index, weights=np.where(start < end, 1.0, -1.0)))
    turned = int(((count == 2) & (net > 0)).sum())
    if turned:
        raise InputError(
            f"{where} has {turned} edges whose two faces wind in opposite ways; fix it, e.g. "
            "by trimesh.repair.fix_winding."
        )
    n_open = int((count == 1).sum())
    if open_surface:
        return n_open == 0
    if n_open:
        raise InputError(
            f"{where} is not watertight: it has {n_open} open edges; close it, or open_surface=True takes "
            "it as a one-sided "
            "surface whose solid lies behind its normals."
        )
    crowded = int((count > 2).sum())
    if crowded:
        raise InputError(
            f"{where} has {crowded} edges with more than two faces, where bodies touch; unite "
            "the bodies, or set them apart."
        )
    corner = vertices[faces] - vertices.mean(axis=0)
    volume = (corner[:, 0] * np.cross(corner[:, 1], corner[:, 2])).sum(axis=1) / 6.0
    n_bodies, body = connected_components(
        coo_array((np.ones(len(start)), (start, end)), shape=(n, n)), directed=False
    )
    each = np.bincount(body[faces[:, 0]], weights=volume, minlength=n_bodies)
    low, high = np.full((n_bodies, 3), np.inf), np.full((n_bodies, 3), -np.inf)
    np.minimum.at(low, body, vertices)
    np.maximum.at(high, body, vertices)
    total = float(each.sum())
    if abs(total) <= 1e-12 * float(np.ptp(vertices, axis=0).max()) ** 3:
        raise InputError(
            f"{where} encloses no volume ({total:.3g} m^3); give a solid, or open_surface=True for a surface."
        )
    outer = [k for k in range(n_bodies) if each[k] > 0.0]
    lost = [
        k
        for k in range(n_bodies)
        if each[k] < 0.0 and not any((low[m] <= low[k]).all() and (high[k] <= high[m]).all() for m in outer)
    ]
    if total < 0.0 or lost:
        which = f"{len(lost)} of its {n_bodies} bodies have" if n_bodies > 1 else "it has"
        raise InputError(
            f"{where} is inverted: {which} a negative volume, so faces point inwards; turn them, e.g. by "
            "mesh.invert() of trimesh, "
            "or open_surface=True if the rod moves inside of it."
        )
    return True
