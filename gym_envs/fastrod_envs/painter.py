"""The pieces of a `Backdrop` (`pieces`), and a small painter: what it looks like, in some milliseconds,
without a window or a graphics card.

Everything becomes triangles. Of one layer the nearest triangle at every pixel is found, at twice the
picture's resolution, and only then shaded. See-through solids are layers of their own, laid over what is
opaque.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fastrod.kernels.jit import entry, kernel
from fastrod.types import Floats, Ints
from fastrod_envs.task import Backdrop, DrawnLine

_FIELD_OF_VIEW = math.radians(36.0)  # from bottom to top
_NEAR = 0.02  # m before the eye: nothing nearer is drawn
_FINE = 2  # fragments a pixel, each way
_SIDES = 24  # of a tube
_LIGHT = np.array([0.35, -0.25, 0.9]) / np.linalg.norm([0.35, -0.25, 0.9])
_SKY, _HORIZON, _FLOOR, _GRID = (
    np.array(c) for c in ((0.80, 0.86, 0.93), (0.96, 0.97, 0.98), (0.87, 0.89, 0.91), (0.71, 0.74, 0.78))
)
_MOUNT = (0.30, 0.33, 0.38)
_SQUARE, _FOG = 0.1, 1.6  # m: of the grid; where the floor fades into the horizon
_Vector: TypeAlias = tuple[float, float, float]
_NONE: _Vector = (0.0, 0.0, 0.0)


class PaintedMesh(NamedTuple):
    """Triangles over shared vertices."""

    vertices: Floats
    """(n, 3) world [m]."""
    faces: Ints
    """(m, 3) counter-clockwise from outside."""


class DrawnPiece(NamedTuple):
    """A mesh with its looks."""

    name: str
    """The same from picture to picture."""
    vertices: Floats
    """(n, 3) world [m]."""
    faces: Ints
    """(m, 3)"""
    color: tuple[float, float, float]
    opacity: float = 1.0
    flat: bool = False
    """Its edges show."""


class Layer(NamedTuple):
    """Triangles of a picture."""

    corners: Floats
    """(m, 3, 3) world [m]."""
    normals: Floats
    """(m, 3, 3) of the surface at each corner, outward."""
    color: Floats
    """(m, 3)"""
    shade: Floats
    """(m,) 1 where light falls on it, 0 where it shows its bare colour."""


class PainterCamera(NamedTuple):
    """Position of the eye, and the size of a pixel in the world."""

    eye: Floats
    """(3,) world [m]."""
    axes: Floats
    """(3, 3) rows right, down, forward."""
    width: int
    height: int

    @property
    def focus(self) -> float:
        """Focal length, in pixels."""
        return 0.5 * self.height / math.tan(0.5 * _FIELD_OF_VIEW)

    def rays(self, x: Floats, y: Floats) -> Floats:
        """(n, 3) of unit depth, world, through pixels."""
        aside, down = (x - 0.5 * self.width) / self.focus, (y - 0.5 * self.height) / self.focus
        right, below, ahead = self.axes.astype(x.dtype)
        return np.asarray(aside[:, None] * right + down[:, None] * below + ahead)


def paint(backdrop: Backdrop, width: int, height: int) -> np.ndarray:
    """(height, width, 3) uint8 of an environment."""
    heights = [tube.points[:, 2] for tube in backdrop.tubes] + [
        solid.vertices[:, 2] for solid in backdrop.solids
    ]
    heights += [ball.position[2:] for ball in backdrop.balls]
    lowest = min((float(z.min()) for z in heights if len(z)), default=0.0)
    # a step at a time, so that it stays under what moves
    floor = 0.0 if lowest > -0.02 else 0.25 * math.floor(4.0 * lowest)
    camera = _camera(backdrop.eye, backdrop.target, width, height)
    drawn = list(pieces(backdrop))
    solid = _joined([_lit(piece) for piece in drawn if piece.opacity >= 1.0])
    picture = (
        _ground(backdrop.eye, backdrop.target, width, height, floor)
        * _shadow(solid, camera, floor)[:, :, None]
    )
    ribbons = [_ribbon(line, camera) for line in backdrop.lines if len(line.points) > 1]
    clear = [piece for piece in drawn if piece.opacity < 1.0]
    clear.sort(key=lambda piece: -float(np.linalg.norm(piece.vertices.mean(0) - camera.eye)))
    layers = [(_joined([solid, *ribbons]), 1.0), *((_lit(piece), piece.opacity) for piece in clear)]
    _lay(picture, layers, camera)
    return np.asarray(np.clip(255.0 * picture + 0.5, 0.0, 255.0).astype(np.uint8))


def pieces(backdrop: Backdrop, sides: int = _SIDES, n_points: int = 50) -> Iterator[DrawnPiece]:
    """Everything but the lines: rods of at least `n_points`, the plates that they stand on, balls, solids."""
    for i, tube in enumerate(backdrop.tubes):
        points = _smooth(np.asarray(tube.points, float), n_points)
        if len(points) > 1 and np.isfinite(points).all():
            yield DrawnPiece(f"tube{i}", *tube_mesh(points, tube.radius, sides), tube.color)
            yield DrawnPiece(f"plate{i}", *_plate(points, tube.radius), _MOUNT, flat=True)
    for i, ball in enumerate(backdrop.balls):
        mesh = ball_mesh()
        at = np.asarray(ball.position) + ball.radius * mesh.vertices
        yield DrawnPiece(f"ball{i}", at, mesh.faces, ball.color)
    for i, solid in enumerate(backdrop.solids):
        yield DrawnPiece(f"solid{i}", np.array(solid.vertices, float), *solid[1:], flat=True)


def tube_mesh(points: Floats, radius: float, sides: int = _SIDES) -> PaintedMesh:
    """A tube around (n, 3) points, rounded at its end, n > 1."""
    points = np.asarray(points, float)
    tangents = np.gradient(points, axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
    side = np.cross(tangents[0], np.eye(3)[np.argmin(np.abs(tangents[0]))])
    sides_of = [side / np.linalg.norm(side)]
    for t in tangents[1:]:  # carried along, so that the mesh does not twist
        side = sides_of[-1] - t * (t @ sides_of[-1])
        sides_of.append(side / max(float(np.linalg.norm(side)), 1e-12))
    u = np.array(sides_of)
    v = np.cross(tangents, u)
    cap = np.linspace(0.0, 0.5 * np.pi, 6)[1:]
    centre = np.concatenate([points, points[-1] + radius * np.sin(cap)[:, None] * tangents[-1]])
    radii = np.concatenate([np.full(len(points), radius), radius * np.cos(cap)])
    u, v = (np.concatenate([a, np.repeat(a[-1:], len(cap), axis=0)]) for a in (u, v))
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    ring = u[:, None] * np.cos(angle)[:, None] + v[:, None] * np.sin(angle)[:, None]
    return PaintedMesh(
        (centre[:, None] + radii[:, None, None] * ring).reshape(-1, 3), _grid_faces(len(centre), sides)
    )


@lru_cache(maxsize=4)
def ball_mesh(sides: int = 16) -> PaintedMesh:
    """A ball of radius 1."""
    polar = np.linspace(0.0, np.pi, sides // 2 + 1)
    around = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    z = np.broadcast_to(-np.cos(polar)[:, None], (len(polar), sides))
    points = np.stack(
        [np.sin(polar)[:, None] * np.cos(around), np.sin(polar)[:, None] * np.sin(around), z], axis=2
    )
    return PaintedMesh(points.reshape(-1, 3), _grid_faces(len(polar), sides))


@lru_cache(maxsize=64)
def _grid_faces(n_rings: int, sides: int) -> Ints:
    """(m, 3) of rings of vertices, each joined with the next, counter-clockwise where the second is in
    front."""
    i, j = np.meshgrid(np.arange(n_rings - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    quads = np.stack([a, b, b + sides, a, b + sides, a + sides], axis=2)
    return np.asarray(quads.reshape(-1, 3))


def _camera(eye: tuple[float, ...], target: tuple[float, ...], width: int, height: int) -> PainterCamera:
    forward = np.subtract(target, eye)
    forward = forward / max(float(np.linalg.norm(forward)), 1e-9)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:  # looks straight down: y is up in the picture
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    return PainterCamera(
        np.array(eye, float), np.array([right, np.cross(forward, right), forward]), width, height
    )


@lru_cache(maxsize=32)
def _ground(
    eye: tuple[float, ...], target: tuple[float, ...], width: int, height: int, floor: float
) -> Floats:
    """(height, width, 3) what is behind everything: the floor's grid, which fades into the sky."""
    fine = 3
    camera = _camera(eye, target, fine * width, fine * height)
    y, x = np.divmod(np.arange(fine * width * fine * height), fine * width)
    rays = camera.rays(x + 0.5, y + 0.5)
    up = np.clip(0.5 + 0.9 * rays[:, 2] / np.linalg.norm(rays, axis=1), 0.0, 1.0)
    color = _HORIZON + (_SKY - _HORIZON) * np.clip(2.0 * up - 0.7, 0.0, 1.0)[:, None]
    depth = (floor - eye[2]) / np.where(rays[:, 2] < -1e-6, rays[:, 2], np.inf)
    depth = np.where((rays[:, 2] < -1e-6) & (depth > 0.0), depth, np.inf)
    hit = np.isfinite(depth)
    at = np.asarray(eye)[:2] + depth[hit, None] * rays[hit, :2]
    pixel = depth[hit, None] / camera.focus
    off = np.abs(at - _SQUARE * np.round(at / _SQUARE))
    strong = np.abs(at - 5 * _SQUARE * np.round(at / (5 * _SQUARE))) < 0.002 + pixel
    line = np.where(strong, 1.0, 0.55) * (off < 0.001 + pixel)
    far = np.exp(-((np.linalg.norm(at - np.asarray(target)[:2], axis=1) / _FOG) ** 2))[:, None]
    color[hit] += far * (_FLOOR + (_GRID - _FLOOR) * line.max(1, keepdims=True) - color[hit])
    picture: Floats = color.reshape(height, fine, width, fine, 3).mean((1, 3))
    picture.flags.writeable = False
    return picture


def _shadow(layer: Layer, camera: PainterCamera, floor: float) -> Floats:
    """(height, width) how bright the floor is under what stands between it and the light: soft at the
    edges."""
    light = np.ones((camera.height, camera.width))
    if not len(layer.corners) or camera.eye[2] <= floor:
        return light
    corners = layer.corners - ((layer.corners[:, :, 2:] - floor) / _LIGHT[2]) * _LIGHT
    dark = (_nearest(*_projected(corners, camera), camera)[1] >= 0).astype(float)
    rows, columns = np.flatnonzero(dark.any(1)), np.flatnonzero(dark.any(0))
    if not len(rows):
        return light
    margin = 8
    window = (
        slice(max(rows[0] - margin, 0), rows[-1] + margin + 1),
        slice(max(columns[0] - margin, 0), columns[-1] + margin + 1),
    )
    soft = dark[window]
    for radii in (1, 2, 3):
        for axis in (0, 1):
            soft = (np.roll(soft, radii, axis) + 2.0 * soft + np.roll(soft, -radii, axis)) / 4.0
    light[window] = 1.0 - 0.3 * soft
    return light


def _plate(points: Floats, radius: float) -> PaintedMesh:
    """Return what a rod along these points stands on."""
    along = (points[1] - points[0]) / max(float(np.linalg.norm(points[1] - points[0])), 1e-12)
    ends, n = np.array([points[0] - 0.7 * radius * along, points[0]]), 2 * _SIDES
    rim = tube_mesh(ends, 2.2 * radius, n).vertices[: 2 * n].reshape(2, n, 3)
    middle = np.repeat(ends[:, None], n, axis=1)
    rings = np.stack([middle[0], rim[0], *rim, rim[1], middle[1]])  # below, around, above: edges show
    return PaintedMesh(
        rings.reshape(-1, 3), np.concatenate([_grid_faces(2, n) + 2 * n * k for k in range(3)])
    )


def _smooth(points: Floats, n_points: int) -> Floats:
    """A curve with points between points, where there are fewer (Catmull and Rom)."""
    while 2 < len(points) < n_points:
        slope = np.gradient(points, axis=0)
        between = 0.5 * (points[:-1] + points[1:]) + 0.125 * (slope[:-1] - slope[1:])
        merged = np.empty((2 * len(points) - 1, 3))
        merged[::2], merged[1::2] = points, between
        points = merged
    return points


def _lit(piece: DrawnPiece) -> Layer:
    """Triangles under the light: smooth where neighbours are nearly in one plane, so that only edges show."""
    faces = piece.faces
    corners = piece.vertices[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-18)
    normals, n = np.repeat(flat[:, None], 3, axis=1), len(piece.vertices)
    mean = np.stack([np.bincount(faces.ravel(), np.repeat(area[:, k], 3), n) for k in range(3)], axis=1)
    mean = (mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-18))[faces]
    normals = np.where(((mean * normals).sum(2) > 0.9)[:, :, None], mean, normals)
    return Layer(
        corners, normals, np.tile(np.array(piece.color, float), (len(faces), 1)), np.ones(len(faces))
    )


def _ribbon(line: DrawnLine, camera: PainterCamera) -> Layer:
    """A path as wide as two pixels, wherever it is."""
    p = np.asarray(line.points, float)
    view = p - camera.eye
    side = np.cross(np.gradient(p, axis=0), view)
    side *= (view @ camera.axes[2] / camera.focus)[:, None] / np.maximum(
        np.linalg.norm(side, axis=1, keepdims=True), 1e-18
    )
    i = np.arange(len(p) - 1)
    faces = np.concatenate(
        [np.stack([i, i + 1, i + len(p)], 1), np.stack([i + 1, i + len(p) + 1, i + len(p)], 1)]
    )
    color = np.tile(np.array(line.color, float), (len(faces), 1))
    corners = np.concatenate([p - side, p + side])[faces]
    return Layer(corners, np.zeros_like(corners), color, np.zeros(len(faces)))


def _joined(layers: list[Layer]) -> Layer:
    empty = Layer(np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0))
    return Layer(*(np.concatenate(arrays) for arrays in zip(empty, *layers, strict=True)))


def _projected(corners: Floats, camera: PainterCamera) -> tuple[Floats, Floats]:
    """Pixels (m, 3, 2) of triangles and (m, 3) one over their depth [1/m], which is linear in a picture; 0:
    before the near plane."""
    seen = (corners - camera.eye) @ camera.axes.T
    depth = seen[:, :, 2]
    visible = (depth > _NEAR).all(1, keepdims=True)
    inverse = 1.0 / np.where(visible, depth, 1.0)
    middle = np.array([0.5 * camera.width, 0.5 * camera.height])
    return middle + camera.focus * seen[:, :, :2] * inverse[:, :, None], np.where(visible, inverse, 0.0)


def _lay(picture: Floats, layers: list[tuple[Layer, float]], camera: PainterCamera) -> None:
    """Lay triangles over a picture (height, width, 3), each layer over those before it where it is nearer
    than the first."""
    fine = camera._replace(width=_FINE * camera.width, height=_FINE * camera.height)
    color = picture.repeat(_FINE, axis=0).repeat(_FINE, axis=1)
    first = np.zeros((fine.height, fine.width), np.float32)
    for k, (layer, opacity) in enumerate(layers):
        at, inverse = _projected(layer.corners, fine)
        depth, which = _nearest(at, inverse, fine)
        _shade((depth, which, first), (at, inverse), layer, fine, opacity, (color, picture))
        first = depth if k == 0 else first


def _nearest(at: Floats, inverse: Floats, camera: PainterCamera) -> tuple[NDArray[np.float32], Ints]:
    """One over the depth of the nearest triangle at every pixel's centre, 0 where there is none, and which it
    is; both (height, width)."""
    depth = np.zeros((camera.height, camera.width), np.float32)
    which = np.full(depth.shape, -1, np.int64)
    _cover(at, inverse, depth, which)
    return depth, which


@kernel
def _dot(a: Floats | _Vector, b: Floats | _Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def _plus(a: Floats | _Vector, k: float, b: Floats | _Vector) -> _Vector:
    """a + k b."""
    return a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]


@kernel
def _weights(at: Floats, t: int, x: int, y: int) -> _Vector:
    """Barycentric coordinates of a pixel's centre in triangle t."""
    x0, y0 = at[t, 0, 0], at[t, 0, 1]
    ex, ey, fx, fy = at[t, 1, 0] - x0, at[t, 1, 1] - y0, at[t, 2, 0] - x0, at[t, 2, 1] - y0
    px, py, whole = x + 0.5 - x0, y + 0.5 - y0, ex * fy - ey * fx
    v, w = (px * fy - py * fx) / whole, (ex * py - ey * px) / whole
    return 1.0 - v - w, v, w


@entry
def _cover(at: Floats, inverse: Floats, depth: NDArray[np.float32], which: Ints) -> None:
    height, width = depth.shape
    for t in range(len(at)):
        x, y = at[t, :, 0], at[t, :, 1]
        if inverse[t, 0] <= 0.0 or abs((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])) < 1e-9:
            continue
        left, right = max(math.ceil(x.min() - 0.5), 0), min(math.floor(x.max() - 0.5), width - 1)
        for j in range(max(math.ceil(y.min() - 0.5), 0), min(math.floor(y.max() - 0.5), height - 1) + 1):
            for i in range(left, right + 1):
                w = _weights(at, t, i, j)
                if min(w[0], w[1], w[2]) > -1e-9:
                    near = np.float32(_dot(w, inverse[t]))
                    if near >= depth[j, i]:
                        depth[j, i], which[j, i] = near, t


@entry
def _shade(
    seen: tuple[NDArray[np.float32], Ints, NDArray[np.float32]],
    projected: tuple[Floats, Floats],
    layer: Layer,
    camera: PainterCamera,
    opacity: float,
    canvas: tuple[Floats, Floats],
) -> None:
    """Lay a layer's colour over a canvas, fine and coarse, where it is no farther than the first layer."""
    (depth, which, first), (at, inverse), (color, picture) = seen, projected, canvas
    axes, light = camera.axes, _LIGHT
    focus = 0.5 * camera.height / math.tan(0.5 * _FIELD_OF_VIEW)
    for j in range(depth.shape[0]):
        for i in range(depth.shape[1]):
            t = which[j, i]
            if t < 0 or depth[j, i] < first[j, i]:
                continue
            # a normal over its depth is linear in the picture, as one over depth is
            w, n, view = _weights(at, t, i, j), _NONE, _plus(_NONE, -1.0, axes[2])
            for k in range(3):
                n = _plus(n, w[k] * inverse[t, k], layer.normals[t, k])
            aside, down = (i + 0.5 - 0.5 * camera.width) / focus, (j + 0.5 - 0.5 * camera.height) / focus
            view = _plus(view, -aside, axes[0])
            view = _plus(view, -down, axes[1])
            view = _plus(_NONE, 1.0 / math.sqrt(_dot(view, view)), view)
            size = math.sqrt(max(_dot(n, n), 1e-18))
            n = _plus(_NONE, -1.0 / size if _dot(n, view) < 0.0 else 1.0 / size, n)
            half = _plus(view, 1.0, light)
            glance = max(_dot(n, half) / math.sqrt(_dot(half, half)), 0.0)
            shade = layer.shade[t]
            bright = 1.0 + shade * (0.14 * n[2] + 0.46 * max(_dot(n, light), 0.0) - 0.48)
            gleam = 0.28 * shade * glance**48
            for k in range(3):
                change = opacity * (layer.color[t, k] * bright + gleam - color[j, i, k])
                color[j, i, k] += change
                picture[j // _FINE, i // _FINE, k] += change / _FINE**2
