"""Closest points by FCL and by closed forms: one query at a time, exact, and no search shared with the fast
path.

FCL only names the closest face; distance and points then come from that face by a closed form. How FCL is
asked follows from measurements against brute force (python-fcl 0.7):

- a point is a sphere of radius 0 against the mesh: face and distance right to 1e-17 m; 11-33 us a query, 12
  to 20 000 faces;
- a segment a-b is the one-triangle mesh (a, a, b), given first; 20-45 us a question. Where it is exactly
  parallel to a face FCL's triangle distance misses by up to 6 mm: in 1 of 100 such cases with the obstacle
  first, 1 of 5000 with the segment first, none of 10 000 once its end is moved by 1e-12 to 1e-9 of its
  length. So it is asked twice, as it is and with its end moved, and the nearer face counts;
- a capsule is never asked: libccd's iteration is off by up to 5e-5 m (radius 1e-6), and slower, 100-130 us;
- FCL drops the inside of a triangle whose doubled area squared is below 1e-15, in its own unit, so that a
  mesh of 0.2 mm triangles in metres is wrong by 0.02 mm: here the BVH is in units that are small enough, a
  power of two.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, NamedTuple, TypeAlias
from weakref import WeakKeyDictionary

import numpy as np

from fastrod.contact.geometry import Obstacle, Triple
from fastrod.contact.normals import (
    EDGE_AB,
    EDGE_BC,
    EDGE_CA,
    FACE,
    VERTEX_A,
    VERTEX_B,
    VERTEX_C,
    pseudonormals,
)
from fastrod.errors import InputError
from fastrod.rotation import matrix_from_quaternion
from fastrod.types import Floats

Signed: TypeAlias = tuple[float, Triple]
"""Signed distance [m] and its gradient, in the frame of the obstacle."""

_AT_SURFACE = 1e-9  # m; nearer than this the direction from the surface is the feature's normal
_NUDGE: Floats = 1e-11 * np.array([0.31, 0.57, 0.76])
"""Per length, in a direction that no face is likely to have: takes a segment out of being exactly parallel to
one."""
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


class Closest(NamedTuple):
    """The closest point of an obstacle's surface to a point."""

    distance: float
    """Signed, negative inside [m]."""
    normal: Floats
    """(3,) gradient of the signed distance: unit, outward, world."""
    point: Floats
    """(3,) on the surface, world [m]."""
    face: int
    """Index of the face in `Obstacle.faces`, -1 for a primitive."""


class SegmentClosest(NamedTuple):
    """The closest points of an obstacle and a segment a-b."""

    distance: float
    """A mesh: to its surface, unsigned, 0 where the segment crosses it. A primitive: the smallest signed
    distance along it [m]."""
    point: Floats
    """(3,) on the surface, world [m]; one of them where the segment crosses more than once."""
    on_segment: Floats
    """(3,) on the segment, world [m]."""
    fraction: float
    """Where `on_segment` is: 0 at a, 1 at b."""
    face: int
    """Index of the face in `Obstacle.faces`, -1 for a primitive."""


class _Mesh:
    """What a mesh needs for its queries, in the obstacle frame: shared by all scenes."""

    def __init__(self, obstacle: Obstacle) -> None:
        corner = obstacle.vertices[obstacle.faces]
        double_area = np.linalg.norm(
            np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
        )
        extent = float(np.ptp(obstacle.vertices, axis=0).max())
        smallest = max(float(double_area.min()), 1e-18 * extent**2)
        # doubled area squared above 1e-9 in units of the BVH, and the mesh at least 1000 of them wide
        self.scale = 2.0 ** math.ceil(math.log2(max(1e3 / extent, math.sqrt(3.2e-5 / smallest))))
        self.body = _bvh(obstacle.vertices * self.scale, obstacle.faces)
        self.corners: list[tuple[Triple, Triple, Triple]] = [
            (tuple(a), tuple(b), tuple(c)) for a, b, c in corner.tolist()
        ]
        self.normals = pseudonormals(obstacle.vertices, obstacle.faces)

    def face_near(self, p: Floats, q: Floats) -> int:
        """The face that FCL calls closest to the segment p-q, obstacle frame [m]."""
        fcl = _fcl()
        answer = fcl.DistanceResult()
        line = _bvh(np.stack([p, p, q]) * self.scale, np.array([[0, 1, 2]]))
        fcl.distance(line, self.body, fcl.DistanceRequest(), answer)
        return int(answer.b2)


_MESHES: WeakKeyDictionary[Obstacle, _Mesh] = WeakKeyDictionary()


def _fcl() -> Any:
    try:
        return import_module("fcl")
    except ImportError as error:
        raise InputError(
            "the direct contact path needs the package python-fcl, which is not installed; install it."
        ) from error


def _bvh(vertices: Floats, faces: Any) -> Any:
    fcl = _fcl()
    model = fcl.BVHModel()
    model.beginModel(len(vertices), len(faces))
    model.addSubModel(vertices, faces)
    model.endModel()
    return fcl.CollisionObject(model, fcl.Transform())


class DirectScene:
    """Closest points by FCL, one BVH per mesh (built once, shared between scenes of the same Obstacle
    object).

    Obstacles stand at their rest pose until `place` moves them. `point` and `segment` raise `InputError` for
    an obstacle that the scene does not have and for coordinates that are not three finite numbers.
    """

    def __init__(self, obstacles: Sequence[Obstacle]) -> None:
        self.obstacles = tuple(obstacles)
        self._meshes: list[_Mesh | None] = []
        self._position: list[Floats] = [np.zeros(3)] * len(self.obstacles)
        self._rotation: list[Floats] = [np.eye(3)] * len(self.obstacles)
        for k, obstacle in enumerate(self.obstacles):
            if obstacle.shape == "mesh" and obstacle not in _MESHES:
                _MESHES[obstacle] = _Mesh(obstacle)
            self._meshes.append(_MESHES[obstacle] if obstacle.shape == "mesh" else None)
            self.place(k, obstacle.position, obstacle.quaternion)

    def place(self, k: int, position: Sequence[float] | Floats, quaternion: Sequence[float] | Floats) -> None:
        """Stand obstacle `k` at world_from_obstacle: position [m], quaternion w x y z, its norm 1 within
        1e-6."""
        self._check(k)
        at, rotation = _finite("position", position, 3), _finite("quaternion", quaternion, 4)
        norm = float(np.linalg.norm(rotation))
        if abs(norm - 1.0) > 1e-6:
            raise InputError(
                f"quaternion of obstacle {self.obstacles[k].name!r} has norm {norm:.6g}; it must be 1."
            )
        self._position[k] = at
        self._rotation[k] = matrix_from_quaternion(rotation[None] / norm)[0]

    def point(self, k: int, p: Sequence[float] | Floats) -> Closest:
        """Signed distance of the world point `p` (3,) [m] to the surface of obstacle `k`, and where that
        is."""
        self._check(k)
        at, rotation = self._position[k], self._rotation[k]
        world = _finite("point", p, 3)
        local = rotation.T @ (world - at)
        mesh = self._meshes[k]
        if mesh is None:
            obstacle = self.obstacles[k]
            distance, gradient = _SIGNED[obstacle.shape](_triple(local), obstacle.size)
            normal = rotation @ np.array(gradient)
            return Closest(distance, normal, world - distance * normal, -1)
        fcl = _fcl()
        answer = fcl.DistanceResult()
        dot = fcl.CollisionObject(fcl.Sphere(0.0), fcl.Transform(local * mesh.scale))
        fcl.distance(mesh.body, dot, fcl.DistanceRequest(), answer)
        face = int(answer.b1)
        nearest, feature = _on_triangle(_triple(local), *mesh.corners[face])
        away = local - np.array(nearest)
        outward = mesh.normals[face, feature]
        distance = math.copysign(math.hypot(*away), float(away @ outward))
        normal = rotation @ (away / distance if abs(distance) > _AT_SURFACE else outward)
        return Closest(distance, normal, rotation @ np.array(nearest) + at, face)

    def segment(self, k: int, a: Sequence[float] | Floats, b: Sequence[float] | Floats) -> SegmentClosest:
        """Distance of the world segment from `a` to `b`, each (3,) [m], to obstacle `k`, and where that
        is."""
        self._check(k)
        at, rotation = self._position[k], self._rotation[k]
        start, end = _finite("segment start", a, 3), _finite("segment end", b, 3)
        p, q = rotation.T @ (start - at), rotation.T @ (end - at)
        mesh = self._meshes[k]
        if mesh is None:
            obstacle = self.obstacles[k]
            signed, size = _SIGNED[obstacle.shape], obstacle.size
            fraction = _lowest(obstacle, p, q)
            distance, gradient = signed(_triple(p + fraction * (q - p)), size)
            on_segment = start + fraction * (end - start)
            return SegmentClosest(
                distance, on_segment - distance * (rotation @ np.array(gradient)), on_segment, fraction, -1
            )
        found = []
        for face in {mesh.face_near(p, q), mesh.face_near(p, q + math.dist(p, q) * _NUDGE)}:
            fraction, nearest = _segment_triangle(_triple(p), _triple(q), *mesh.corners[face])
            found.append((math.dist(p + fraction * (q - p), nearest), face, fraction, nearest))
        distance, face, fraction, nearest = min(found)
        return SegmentClosest(
            distance, rotation @ np.array(nearest) + at, start + fraction * (end - start), fraction, face
        )

    def _check(self, k: int) -> None:
        if not 0 <= k < len(self.obstacles):
            raise InputError(
                f"there is no obstacle {k!r}; the scene has {len(self.obstacles)}, numbered from 0."
            )


def _finite(what: str, values: Sequence[float] | Floats, count: int) -> Floats:
    array = np.array(values, dtype=np.float64)
    if array.shape != (count,) or not np.isfinite(array).all():
        raise InputError(f"{what} is {values!r}; it must be {count} finite numbers.")
    return array


def _triple(v: Floats) -> Triple:
    x, y, z = v.tolist()
    return x, y, z


def _dot(a: Triple, b: Triple) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _sub(a: Triple, b: Triple) -> Triple:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _cross(a: Triple, b: Triple) -> Triple:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _along(a: Triple, d: Triple, t: float) -> Triple:
    return a[0] + t * d[0], a[1] + t * d[1], a[2] + t * d[2]


def _on_triangle(p: Triple, a: Triple, b: Triple, c: Triple) -> tuple[Triple, int]:
    """The point of a triangle closest to p, and the feature that it lies on, counted as in `pseudonormals`.

    The weights of the corners (barycentric coordinates) of p's projection tell the region (Ericson 2005,
    5.1.5).
    """
    ab, ac, ap = _sub(b, a), _sub(c, a), _sub(p, a)
    bp, cp = _sub(p, b), _sub(p, c)
    d1, d2 = _dot(ab, ap), _dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return a, VERTEX_A
    d3, d4 = _dot(ab, bp), _dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return b, VERTEX_B
    d5, d6 = _dot(ab, cp), _dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return c, VERTEX_C
    # areas by cross products with an edge: d1 d4 - d3 d2 and its like lose digits far from the triangle
    n = _cross(ab, ac)
    wc = _dot(n, _cross(ab, ap))
    if wc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return _along(a, ab, d1 / (d1 - d3)), EDGE_AB
    wb = _dot(n, _cross(ap, ac))
    if wb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return _along(a, ac, d2 / (d2 - d6)), EDGE_CA
    wa = _dot(n, _cross(_sub(c, b), bp))
    if wa <= 0.0 and d4 >= d3 and d5 >= d6:
        return _along(b, _sub(c, b), (d4 - d3) / ((d4 - d3) + (d5 - d6))), EDGE_BC
    total = wa + wb + wc
    if total <= 0.0:  # a face without area
        edges = ((a, ab, EDGE_AB), (b, _sub(c, b), EDGE_BC), (c, _sub(a, c), EDGE_CA))
        near = [(_along(u, d, _on_segment(p, u, d)), feature) for u, d, feature in edges]
        return min(near, key=lambda pair: math.dist(p, pair[0]))
    return _along(_along(a, ab, wb / total), ac, wc / total), FACE


def _on_segment(p: Triple, a: Triple, d: Triple) -> float:
    """Fraction of the segment from a to a + d that is closest to p."""
    square = _dot(d, d)
    return min(max(_dot(_sub(p, a), d) / square, 0.0), 1.0) if square > 0.0 else 0.0


def _segments(a: Triple, d: Triple, b: Triple, e: Triple) -> tuple[float, float]:
    """Fractions of the segments a, a + d and b, b + e that are closest to each other (Ericson 2005,
    5.1.9)."""
    dd, de, ee, r = _dot(d, d), _dot(d, e), _dot(e, e), _sub(a, b)
    det = dd * ee - de * de
    s = min(max((de * _dot(e, r) - ee * _dot(d, r)) / det, 0.0), 1.0) if det > 0.0 else 0.0
    t = _on_segment(_along(a, d, s), b, e)
    return _on_segment(_along(b, e, t), a, d), t


def _segment_triangle(p: Triple, q: Triple, a: Triple, b: Triple, c: Triple) -> tuple[float, Triple]:
    """Fraction of the segment p-q and point of the triangle closest to each other; where it crosses, the
    crossing."""
    d = _sub(q, p)
    n = _cross(_sub(b, a), _sub(c, a))
    hp, hq = _dot(n, _sub(p, a)), _dot(n, _sub(q, a))
    if hp * hq <= 0.0 and hp != hq:
        t = hp / (hp - hq)
        x = _along(p, d, t)
        sides = (_dot(n, _cross(_sub(v, u), _sub(x, u))) for u, v in ((a, b), (b, c), (c, a)))
        if all(side >= 0.0 for side in sides):
            return t, x
    near = [(0.0, _on_triangle(p, a, b, c)[0]), (1.0, _on_triangle(q, a, b, c)[0])]
    for u, v in ((a, b), (b, c), (c, a)):
        near.append((_on_segment(u, p, d), u))
        s, t = _segments(p, d, u, _sub(v, u))
        near.append((s, _along(u, _sub(v, u), t)))
    return min(near, key=lambda pair: math.dist(_along(p, d, pair[0]), pair[1]))


def _sphere(p: Triple, size: Triple) -> Signed:
    r = math.hypot(*p)
    return r - size[0], ((p[0] / r, p[1] / r, p[2] / r) if r > 0.0 else (0.0, 0.0, 1.0))


def _capsule(p: Triple, size: Triple) -> Signed:
    half = 0.5 * size[1]
    v = (p[0], p[1], p[2] - min(max(p[2], -half), half))
    r = math.hypot(*v)
    return r - size[0], ((v[0] / r, v[1] / r, v[2] / r) if r > 0.0 else (1.0, 0.0, 0.0))


def _corner(depth: tuple[float, ...], outward: tuple[Triple, ...]) -> Signed:
    """Signed distance to a convex corner of walls at right angles, from that to each wall and the wall's
    outward normal."""
    out = [max(v, 0.0) for v in depth]
    r = math.hypot(*out)
    if r <= 0.0:
        k = max(range(len(depth)), key=lambda i: depth[i])
        return depth[k], outward[k]
    x, y, z = (sum(v * n[i] for v, n in zip(out, outward, strict=True)) / r for i in range(3))
    return r, (x, y, z)


def _box(p: Triple, size: Triple) -> Signed:
    x, y, z = (math.copysign(1.0, v) for v in p)
    depth = tuple(abs(v) - 0.5 * edge for v, edge in zip(p, size, strict=True))
    return _corner(depth, ((x, 0.0, 0.0), (0.0, y, 0.0), (0.0, 0.0, z)))


def _cylinder(p: Triple, size: Triple) -> Signed:
    r = math.hypot(p[0], p[1])
    side = (p[0] / r, p[1] / r, 0.0) if r > 0.0 else (1.0, 0.0, 0.0)
    return _corner((r - size[0], abs(p[2]) - 0.5 * size[1]), (side, (0.0, 0.0, math.copysign(1.0, p[2]))))


def _plane(p: Triple, size: Triple) -> Signed:  # noqa: ARG001
    return p[2], (0.0, 0.0, 1.0)


_SIGNED: dict[str, Callable[[Triple, Triple], Signed]] = {
    "sphere": _sphere,
    "capsule": _capsule,
    "box": _box,
    "cylinder": _cylinder,
    "plane": _plane,
}


def _lowest(obstacle: Obstacle, p: Floats, q: Floats) -> float:
    """Fraction of the segment p-q, obstacle frame, where the signed distance to a primitive is least; it is
    convex along it."""
    a, d = _triple(p), _triple(q - p)
    if obstacle.shape == "plane":
        return 1.0 if d[2] < 0.0 else 0.0
    if obstacle.shape == "sphere":
        return _on_segment((0.0, 0.0, 0.0), a, d)
    if obstacle.shape == "capsule":
        axis = (0.0, 0.0, obstacle.size[1])
        crossing = _segments(a, d, (0.0, 0.0, -0.5 * obstacle.size[1]), axis)[0]
        near = [
            crossing,
            0.0,
            1.0,
            *(_on_segment((0.0, 0.0, z * obstacle.size[1]), a, d) for z in (-0.5, 0.5)),
        ]
        return min(near, key=lambda t: _capsule(_along(a, d, t), obstacle.size)[0])
    signed, size = _SIGNED[obstacle.shape], obstacle.size

    def at(t: float) -> float:
        return signed(_along(a, d, t), size)[0]

    low, high = 0.0, 1.0
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    f_left, f_right = at(left), at(right)
    while high - low > 1e-12:
        if f_left <= f_right:
            high, right, f_right = right, left, f_left
            left = high - _GOLDEN * (high - low)
            f_left = at(left)
        else:
            low, left, f_left = left, right, f_right
            right = low + _GOLDEN * (high - low)
            f_right = at(right)
    return min((0.0, 1.0, 0.5 * (low + high)), key=at)
