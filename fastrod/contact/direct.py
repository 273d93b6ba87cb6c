"""Closest points by FCL and by closed forms: one query at a time, exact, and no search shared with the fast
path. With `ContactScene(collision="fcl")` the kernels of contact ask here for every distance to a mesh.

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
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numba import objmode

from fastrod.contact.closest import Triple, along, lowest, on_triangle, segment_triangle
from fastrod.contact.geometry import Obstacle
from fastrod.contact.normals import pseudonormals
from fastrod.contact.primitive import primitive_of
from fastrod.errors import InputError
from fastrod.kernels.contact.primitive import DISTANCE
from fastrod.kernels.jit import pointed
from fastrod.rotation import matrix_from_quaternion
from fastrod.types import Flags, Floats

_AT_SURFACE = 1e-9  # m; nearer than this the direction from the surface is the feature's normal
_NUDGE: Floats = 1e-11 * np.array([0.31, 0.57, 0.76])
"""Per length, in a direction that no face is likely to have: takes a segment out of being exactly parallel to
one."""


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
    """Fraction along the segment at which `on_segment` lies: 0 at a, 1 at b."""
    face: int
    """Index of the face in `Obstacle.faces`, -1 for a primitive."""


class _Mesh:
    """A mesh prepared for queries, in the obstacle frame: shared by all scenes."""

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

    def at(self, p: Floats) -> tuple[float, Floats, Triple, int]:
        """Signed distance of a point, its gradient, the closest point of the surface and its face, obstacle
        frame."""
        fcl = _fcl()
        answer = fcl.DistanceResult()
        dot = fcl.CollisionObject(fcl.Sphere(0.0), fcl.Transform(p * self.scale))
        fcl.distance(self.body, dot, fcl.DistanceRequest(), answer)
        face = int(answer.b1)
        on_surface, feature = on_triangle(_triple(p), *self.corners[face])
        away, outward = p - np.array(on_surface), self.normals[face, feature]
        distance = math.copysign(math.hypot(*away), float(away @ outward))
        return distance, away / distance if abs(distance) > _AT_SURFACE else outward, on_surface, face

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


_NUMBERED: list[_Mesh] = []


def number_of(obstacle: Obstacle) -> int:
    """By which kernels ask for the distance of a mesh."""
    if obstacle not in _MESHES:
        _MESHES[obstacle] = _Mesh(obstacle)
    if (mesh := _MESHES[obstacle]) not in _NUMBERED:
        _NUMBERED.append(mesh)
    return _NUMBERED.index(mesh)


def _ask(number: float, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Signed distance of a point in the frame of a mesh, and its gradient."""
    mesh, p = _NUMBERED[int(number)], np.array([x, y, z])
    distance, normal, _, _ = mesh.at(p)
    return (distance, *normal.tolist())


def _distance_by_fcl(size: Triple, p: Triple) -> tuple[float, Triple]:
    with objmode(d="float64", x="float64", y="float64", z="float64"):
        d, x, y, z = _ask(size[0], p[0], p[1], p[2])
    return d, (x, y, z)


@cache
def address() -> int:
    """Address of the distance by FCL for kernels (`Surfaces.primitive`); `size[0]` is `number_of` the
    mesh."""
    return pointed(_distance_by_fcl, DISTANCE, nogil=False)[1]


class BroadPhase:
    """Which rods may touch an obstacle: FCL's dynamic tree over boxes of the obstacles, which moves with
    them, asked with the box of every rod."""

    def __init__(self, obstacles: Sequence[Obstacle], sphere: Floats) -> None:
        """`sphere` (n_obstacles, 4): balls that hold them (`Surfaces`)."""
        fcl, self._centres = _fcl(), []
        self._tree, self._bodies = fcl.DynamicAABBTreeCollisionManager(), []
        self._poses = np.empty(0)
        for o, ball in zip(obstacles, sphere, strict=True):
            low, high = ball[:3] - ball[3], ball[:3] + ball[3]
            if o.shape == "mesh":
                low, high = o.vertices.min(0), o.vertices.max(0)
            self._centres.append(0.5 * (low + high) if np.isfinite(high).all() else None)
            size = np.minimum(high - low, 1.0) if self._centres[-1] is None else high - low
            self._bodies.append(fcl.CollisionObject(fcl.Box(*size), fcl.Transform()))
        self._tree.registerObjects(self._bodies)
        self._tree.setup()

    def near(self, low: Floats, high: Floats, poses: Floats) -> Flags:
        """(n,) whether the box from `low` to `high` (n, 3) of a rod meets that of an obstacle at `poses`
        (1 or n, n_obstacles, 7), world. One without end is always met."""
        if any(centre is None for centre in self._centres):
            return np.ones(len(low), bool)
        fcl, found = _fcl(), np.zeros(len(low), bool)
        for i, (a, b) in enumerate(zip(low, high, strict=True)):
            self._place(poses[i if len(poses) > 1 else 0])
            rod, met = fcl.CollisionObject(fcl.Box(*(b - a)), fcl.Transform(0.5 * (a + b))), list[bool]()
            self._tree.collide(rod, met, _note)
            found[i] = bool(met)
        return found

    def _place(self, poses: Floats) -> None:
        if np.array_equal(poses, self._poses):
            return
        fcl, rotations = _fcl(), matrix_from_quaternion(poses[:, 3:])
        for body, centre, r, pose in zip(self._bodies, self._centres, rotations, poses, strict=True):
            body.setTransform(fcl.Transform(r, pose[:3] + r @ centre))
            self._tree.update(body)
        self._poses = poses.copy()


def _note(_one: Any, _other: Any, met: list[bool]) -> bool:
    met.append(True)
    return True  # one is enough


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
            distance, gradient = primitive_of(obstacle.shape).plain(obstacle.size, _triple(local))
            normal = rotation @ np.array(gradient)
            return Closest(distance, normal, world - distance * normal, -1)
        distance, normal, on_surface, face = mesh.at(local)
        return Closest(distance, rotation @ normal, rotation @ np.array(on_surface) + at, face)

    def segment(self, k: int, a: Sequence[float] | Floats, b: Sequence[float] | Floats) -> SegmentClosest:
        """Distance of the world segment from `a` to `b`, each (3,) [m], to obstacle `k`, and where that
        is."""
        self._check(k)
        at, rotation = self._position[k], self._rotation[k]
        start, end = _finite("segment start", a, 3), _finite("segment end", b, 3)
        p, q = rotation.T @ (start - at), rotation.T @ (end - at)
        mesh = self._meshes[k]
        if mesh is None:
            fraction = _lowest(self.obstacles[k], p, q)
            size, signed = self.obstacles[k].size, primitive_of(self.obstacles[k].shape).plain
            distance, gradient = signed(size, _triple(p + fraction * (q - p)))
            on_segment = start + fraction * (end - start)
            return SegmentClosest(
                distance, on_segment - distance * (rotation @ np.array(gradient)), on_segment, fraction, -1
            )
        found = []
        for face in {mesh.face_near(p, q), mesh.face_near(p, q + math.dist(p, q) * _NUDGE)}:
            fraction, nearest = segment_triangle(_triple(p), _triple(q), *mesh.corners[face])
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


def _lowest(obstacle: Obstacle, p: Floats, q: Floats) -> float:
    """Fraction of the segment p-q, obstacle frame, where the signed distance to a primitive is least; it is
    convex along it."""
    primitive, a, d = primitive_of(obstacle.shape), _triple(p), _triple(q - p)
    if primitive.lowest is not None:
        return primitive.lowest(obstacle.size, a, d)
    return lowest(lambda t: primitive.plain(obstacle.size, along(a, d, t))[0])
