"""Closest points by FCL and by closed forms: one query at a time, exact, and no search shared with the fast
path. With `ContactScene(collision="fcl")` the kernels of contact ask here for every distance to a mesh.

FCL only names the closest face; distance and points then come from that face by a closed form. How FCL is
asked follows from measurements against brute force (python-fcl 0.7):

- a point is a sphere of radius 0 against the mesh: face and distance right to 1e-17 m; 11-33 us a query, 12
  to 20 000 faces;
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
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numba import objmode

from fastrod.contact.closest import Triple, on_triangle
from fastrod.contact.geometry import Obstacle
from fastrod.contact.normals import pseudonormals
from fastrod.errors import InputError
from fastrod.kernels.contact.primitive import DISTANCE
from fastrod.kernels.jit import pointed
from fastrod.rotation import matrix_from_quaternion
from fastrod.types import Flags, Floats

_AT_SURFACE = 1e-9  # m; nearer than this the direction from the surface is the feature's normal


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


def _triple(v: Floats) -> Triple:
    x, y, z = v.tolist()
    return x, y, z
