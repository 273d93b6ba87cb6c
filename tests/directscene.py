"""Slow twin of the distance queries: closest points by FCL and by closed forms, one query at a time.

A segment a-b is the one-triangle mesh (a, a, b), given first; 20-45 us a question. Where it is exactly
  parallel to a face FCL's triangle distance misses by up to 6 mm: in 1 of 100 such cases with the obstacle
  first, 1 of 5000 with the segment first, none of 10 000 once its end is moved by 1e-12 to 1e-9 of its
  length. So it is asked twice, as it is and with its end moved, and the nearer face counts;
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from fastrod.contact.closest import Triple, _cross, _dot, _sub, along, on_segment, on_triangle
from fastrod.contact.direct import _MESHES, _bvh, _fcl, _Mesh, _triple
from fastrod.contact.geometry import Obstacle
from fastrod.contact.primitive import primitive_of
from fastrod.rotation import matrix_from_quaternion
from fastrod.types import Floats

_NUDGE: Floats = 1e-11 * np.array([0.31, 0.57, 0.76])
"""Per length, in a direction that no face is likely to have: takes a segment out of being exactly parallel to
one."""
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)


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


class DirectScene:
    """Closest points by FCL, one BVH per mesh (built once, shared between scenes of the same Obstacle
    object).

    Obstacles stand at their rest pose until `place` moves them.
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
        """Stand obstacle `k` at world_from_obstacle: position [m], unit quaternion w x y z."""
        self._position[k] = np.array(position, dtype=float)
        self._rotation[k] = matrix_from_quaternion(np.array(quaternion, dtype=float)[None])[0]

    def point(self, k: int, p: Sequence[float] | Floats) -> Closest:
        """Signed distance of the world point `p` (3,) [m] to the surface of obstacle `k`, and where that
        is."""
        at, rotation = self._position[k], self._rotation[k]
        world = np.array(p, dtype=float)
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
        at, rotation = self._position[k], self._rotation[k]
        start, end = np.array(a, dtype=float), np.array(b, dtype=float)
        p, q = rotation.T @ (start - at), rotation.T @ (end - at)
        mesh = self._meshes[k]
        if mesh is None:
            size, signed = self.obstacles[k].size, primitive_of(self.obstacles[k].shape).plain
            first, change = _triple(p), _triple(q - p)
            fraction = lowest(lambda t: signed(size, along(first, change, t))[0])
            distance, gradient = signed(size, _triple(p + fraction * (q - p)))
            on_segment = start + fraction * (end - start)
            return SegmentClosest(
                distance, on_segment - distance * (rotation @ np.array(gradient)), on_segment, fraction, -1
            )
        found = []
        for face in {_face_near(mesh, p, q), _face_near(mesh, p, q + math.dist(p, q) * _NUDGE)}:
            fraction, nearest = segment_triangle(_triple(p), _triple(q), *mesh.corners[face])
            found.append((math.dist(p + fraction * (q - p), nearest), face, fraction, nearest))
        distance, face, fraction, nearest = min(found)
        return SegmentClosest(
            distance, rotation @ np.array(nearest) + at, start + fraction * (end - start), fraction, face
        )


def _face_near(mesh: _Mesh, p: Floats, q: Floats) -> int:
    """The face that FCL calls closest to the segment p-q, obstacle frame [m]."""
    fcl = _fcl()
    answer = fcl.DistanceResult()
    line = _bvh(np.stack([p, p, q]) * mesh.scale, np.array([[0, 1, 2]]))
    fcl.distance(line, mesh.body, fcl.DistanceRequest(), answer)
    return int(answer.b2)


def segments(a: Triple, d: Triple, b: Triple, e: Triple) -> tuple[float, float]:
    """Fractions of the segments a, a + d and b, b + e that are closest to each other (Ericson 2005,
    5.1.9)."""
    dd, de, ee, r = _dot(d, d), _dot(d, e), _dot(e, e), _sub(a, b)
    det = dd * ee - de * de
    s = min(max((de * _dot(e, r) - ee * _dot(d, r)) / det, 0.0), 1.0) if det > 0.0 else 0.0
    t = on_segment(along(a, d, s), b, e)
    return on_segment(along(b, e, t), a, d), t


def segment_triangle(p: Triple, q: Triple, a: Triple, b: Triple, c: Triple) -> tuple[float, Triple]:
    """Fraction of the segment p-q and point of the triangle closest to each other; where it crosses, the
    crossing."""
    d = _sub(q, p)
    n = _cross(_sub(b, a), _sub(c, a))
    hp, hq = _dot(n, _sub(p, a)), _dot(n, _sub(q, a))
    if hp * hq <= 0.0 and hp != hq:
        t = hp / (hp - hq)
        x = along(p, d, t)
        sides = (_dot(n, _cross(_sub(v, u), _sub(x, u))) for u, v in ((a, b), (b, c), (c, a)))
        if all(side >= 0.0 for side in sides):
            return t, x
    near = [(0.0, on_triangle(p, a, b, c)[0]), (1.0, on_triangle(q, a, b, c)[0])]
    for u, v in ((a, b), (b, c), (c, a)):
        near.append((on_segment(u, p, d), u))
        s, t = segments(p, d, u, _sub(v, u))
        near.append((s, along(u, _sub(v, u), t)))
    return min(near, key=lambda pair: math.dist(along(p, d, pair[0]), pair[1]))


def lowest(at: Callable[[float], float]) -> float:
    """Return where a convex function is least between 0 and 1, by golden section."""
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
