"""A small painter in numpy: what a `Backdrop` looks like, in some milliseconds, without a window or a
graphics card.

Everything becomes triangles. Those of one layer are cut into rows of pixels, and rows into fragments, at
twice the picture's resolution; the nearest fragment of every pixel is kept and only then shaded. See-through
solids are layers of their own, laid over what is opaque.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fastrod.types import Floats, Ints
from fastrod_envs.task import Backdrop, Ball, DrawnLine, Solid, Tube

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


class PaintedMesh(NamedTuple):
    """Triangles over shared vertices."""

    vertices: Floats
    """(n, 3) world [m]."""
    faces: Ints
    """(m, 3) counter-clockwise from outside."""


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
    """Where the eye is, and what of the world a pixel is."""

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
    opaque = [
        _lit(PaintedMesh(s.vertices, s.faces), s.color, True) for s in backdrop.solids if s.opacity >= 1.0
    ]
    opaque += [layer for tube in backdrop.tubes for layer in _tube_layers(tube)]
    opaque += [_ball_layer(ball) for ball in backdrop.balls]
    solid = _joined([layer for layer in opaque if len(layer.corners)])
    picture = (
        _ground(backdrop.eye, backdrop.target, width, height, floor)
        * _shadow(solid, camera, floor)[:, :, None]
    )
    ribbons = [_ribbon(line, camera) for line in backdrop.lines if len(line.points) > 1]
    layers = [(_joined([solid, *ribbons]), 1.0)] + [
        (_lit(PaintedMesh(s.vertices, s.faces), s.color, True), s.opacity)
        for s in _far_to_near(backdrop, camera)
    ]
    _lay(picture.reshape(-1, 3), layers, camera)
    return np.asarray(np.clip(255.0 * picture + 0.5, 0.0, 255.0).astype(np.uint8))


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
    polar, around = (
        np.linspace(0.0, np.pi, sides // 2 + 1),
        np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False),
    )
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
    pixel, _, _ = _fragments(*_projected(corners, camera), camera.width, camera.height)
    dark = np.zeros((camera.height, camera.width))
    dark.reshape(-1)[pixel] = 1.0
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


def _tube_layers(tube: Tube) -> list[Layer]:
    """The rod, and the plate that it stands on."""
    points = _smooth(np.asarray(tube.points, float))
    if len(points) < 2 or not np.isfinite(points).all():
        return []
    body = tube_mesh(points, tube.radius)
    centre = np.concatenate([points, np.repeat(points[-1:], 5, axis=0)]).repeat(_SIDES, axis=0)
    normals = (body.vertices - centre) / tube.radius
    color = np.broadcast_to(np.array(tube.color, float), (len(body.faces), 3))
    along = (points[1] - points[0]) / max(float(np.linalg.norm(points[1] - points[0])), 1e-12)
    return [
        Layer(body.vertices[body.faces], normals[body.faces], color, np.ones(len(body.faces))),
        _plate(points[0], along, tube.radius),
    ]


def _plate(bottom: Floats, along: Floats, radius: float) -> Layer:
    """What a rod of this radius stands on."""
    ends = np.array([bottom - 0.7 * radius * along, bottom])
    rim = tube_mesh(ends, 2.2 * radius, 2 * _SIDES).vertices[: 4 * _SIDES].reshape(2, 2 * _SIDES, 3)
    outward = (rim[1] - bottom) / (2.2 * radius)
    rings = np.concatenate(
        [np.broadcast_to(ends[:1, None], rim[:1].shape), rim, np.broadcast_to(ends[1:, None], rim[:1].shape)]
    )
    faces = _grid_faces(4, 2 * _SIDES)
    # lower side, rim, upper side
    normals = np.broadcast_to(-along, (*faces.shape, 3)).reshape(3, -1, 3, 3).copy()
    normals[1] = outward[faces.reshape(3, -1, 3)[1] % (2 * _SIDES)]
    normals[2] = along
    color = np.broadcast_to(np.array(_MOUNT), (len(faces), 3))
    return Layer(rings.reshape(-1, 3)[faces], normals.reshape(-1, 3, 3), color, np.ones(len(faces)))


def _smooth(points: Floats) -> Floats:
    """A curve with points between points, where there are few (Catmull and Rom)."""
    while 2 < len(points) < 50:
        slope = np.gradient(points, axis=0)
        between = 0.5 * (points[:-1] + points[1:]) + 0.125 * (slope[:-1] - slope[1:])
        merged = np.empty((2 * len(points) - 1, 3))
        merged[::2], merged[1::2] = points, between
        points = merged
    return points


def _ball_layer(ball: Ball) -> Layer:
    mesh = ball_mesh()
    corners = mesh.vertices[mesh.faces]
    color = np.broadcast_to(np.array(ball.color, float), (len(corners), 3))
    return Layer(np.asarray(ball.position) + ball.radius * corners, corners, color, np.ones(len(corners)))


def _lit(mesh: PaintedMesh, color: tuple[float, ...], rounded: bool) -> Layer:
    """Triangles under the light; `rounded`: smooth where neighbours are nearly in one plane, so that only
    edges show."""
    corners = np.asarray(mesh.vertices, float)[mesh.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-18)
    normals = np.repeat(flat[:, None], 3, axis=1)
    if rounded:
        n, corner = len(mesh.vertices), mesh.faces.ravel()
        mean = np.stack([np.bincount(corner, np.repeat(area[:, k], 3), n) for k in range(3)], axis=1)
        mean = (mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-18))[mesh.faces]
        normals = np.where(((mean * normals).sum(2) > 0.9)[:, :, None], mean, normals)
    return Layer(
        corners, normals, np.broadcast_to(np.array(color, float), (len(corners), 3)), np.ones(len(corners))
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
    layer = _lit(PaintedMesh(np.concatenate([p - side, p + side]), faces), line.color, False)
    return layer._replace(shade=np.zeros(len(faces)))


def _joined(layers: list[Layer]) -> Layer:
    empty = Layer(np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0))
    return Layer(*(np.concatenate(arrays) for arrays in zip(empty, *layers, strict=True)))


def _far_to_near(backdrop: Backdrop, camera: PainterCamera) -> list[Solid]:
    """Solids that one sees through."""
    clear = [solid for solid in backdrop.solids if solid.opacity < 1.0]
    return sorted(
        clear, key=lambda solid: -float(np.linalg.norm(np.asarray(solid.vertices).mean(0) - camera.eye))
    )


def _projected(corners: Floats, camera: PainterCamera) -> tuple[Floats, Floats]:
    """Pixels (m, 3, 2) of triangles and (m, 3) one over their depth [1/m], which is linear in a picture; 0:
    before the near plane."""
    seen = (corners - camera.eye) @ camera.axes.T
    depth = seen[:, :, 2]
    visible = (depth > _NEAR).all(1, keepdims=True)
    inverse = 1.0 / np.where(visible, depth, 1.0)
    middle = np.array([0.5 * camera.width, 0.5 * camera.height])
    return middle + camera.focus * seen[:, :, :2] * inverse[:, :, None], np.where(visible, inverse, 0.0)


def _fragments(at: Floats, inverse: Floats, width: int, height: int) -> tuple[Ints, Ints, Floats]:
    """Pixel, triangle and one over depth of every pixel centre within every triangle."""
    a, b = at[:, [1, 2, 0], 1] - at[:, :, 1], at[:, :, 0] - at[:, [1, 2, 0], 0]
    double = a[:, 0] * (at[:, 2, 0] - at[:, 0, 0]) + b[:, 0] * (at[:, 2, 1] - at[:, 0, 1])
    top = np.maximum(np.ceil(at[:, :, 1].min(1) - 0.5), 0.0)
    rows = np.minimum(np.floor(at[:, :, 1].max(1) - 0.5), height - 1.0) - top + 1.0
    rows = np.where((np.abs(double) > 1e-9) & (inverse[:, 0] > 0.0), np.maximum(rows, 0.0), 0.0).astype(
        np.int64
    )
    triangle, y = _counted(rows)
    y += top[triangle].astype(np.int64)
    sign = np.sign(double)[:, None]
    a, b = sign * a, sign * b
    c = -(a * at[:, :, 0] + b * at[:, :, 1])
    with np.errstate(divide="ignore", invalid="ignore"):  # a row crosses no edge that is level
        crossing = -(b[triangle] * (y[:, None] + 0.5) + c[triangle]) / a[triangle]
    enters, leaves = (
        np.where(a[triangle] > 0.0, crossing, 0.0),
        np.where(a[triangle] < 0.0, crossing, float(width)),
    )
    left = np.maximum(np.maximum(enters[:, 0], enters[:, 1]), np.maximum(enters[:, 2], 0.0))
    right = np.minimum(np.minimum(leaves[:, 0], leaves[:, 1]), leaves[:, 2])
    first = np.ceil(left - 0.5)
    row, x = _counted(
        np.maximum(np.minimum(np.floor(right - 0.5), width - 1.0) - first + 1.0, 0.0).astype(np.int64)
    )
    x += first[row].astype(np.int64)
    triangle, y = triangle[row], y[row]
    e, f = at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]
    de, df = inverse[:, 1] - inverse[:, 0], inverse[:, 2] - inverse[:, 0]
    whole = e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]
    whole = np.where(whole == 0.0, 1.0, whole)
    slope_x, slope_y = (de * f[:, 1] - df * e[:, 1]) / whole, (df * e[:, 0] - de * f[:, 0]) / whole
    start = inverse[:, 0] - slope_x * (at[:, 0, 0] - 0.5) - slope_y * (at[:, 0, 1] - 0.5)
    return y * width + x, triangle, start[triangle] + slope_x[triangle] * x + slope_y[triangle] * y


def _counted(counts: Ints) -> tuple[Ints, Ints]:
    """Each index so often as its count says, and which of its times it is."""
    index = np.repeat(np.arange(len(counts)), counts)
    return index, np.arange(len(index)) - (np.cumsum(counts) - counts)[index]


def _nearest(pixel: Ints, inverse: Floats, size: int) -> tuple[Ints, Ints]:
    """The pixels that are covered, and the nearest fragment of each."""
    key = (inverse.astype(np.float32).view(np.uint32).astype(np.uint64) << np.uint64(32)) | np.arange(
        len(pixel), dtype=np.uint64
    )
    best = np.zeros(size, np.uint64)
    np.maximum.at(best, pixel, key)
    covered = np.flatnonzero(best)
    return covered, (best[covered] & np.uint64(0xFFFFFFFF)).astype(np.int64)


def _lay(picture: Floats, layers: list[tuple[Layer, float]], camera: PainterCamera) -> None:
    """Lay triangles over a picture (height * width, 3), each layer over those before it where it is nearer
    than the first."""
    fine = camera._replace(width=_FINE * camera.width, height=_FINE * camera.height)
    found = []
    for layer, opacity in layers:
        at, inverse = _projected(layer.corners, fine)
        pixel, triangle, depth = _fragments(at, inverse, fine.width, fine.height)
        covered, which = _nearest(pixel, depth, fine.width * fine.height)
        triangle = triangle[which]
        # the left one of two neighbours within a pixel and a triangle is shaded for both
        alone = np.ones(len(covered), np.bool_)
        alone[1:] = (
            (triangle[1:] != triangle[:-1]) | (covered[1:] != covered[:-1] + 1) | (covered[1:] % _FINE == 0)
        )
        shaded = _shaded(layer, covered[alone], triangle[alone], at, inverse, fine)[np.cumsum(alone) - 1]
        found.append((covered, depth[which], shaded, opacity))
    mark = np.zeros(fine.width * fine.height, np.bool_)
    for covered, *_ in found:
        mark[covered] = True
    touched = np.flatnonzero(mark)
    places = np.empty(len(mark), np.int32)
    places[touched] = np.arange(len(touched))
    parent = (touched // fine.width // _FINE) * camera.width + touched % fine.width // _FINE
    behind = picture[parent].astype(np.float32)
    color, depth_of = behind.copy(), np.zeros(len(touched))
    for k, (covered, depth, shaded, opacity) in enumerate(found):
        place = places[covered]
        if k == 0:
            depth_of[place] = depth
            color[place] = shaded
            continue
        seen = depth >= depth_of[place]
        place = place[seen]
        color[place] += opacity * (shaded[seen] - color[place])
    color -= behind
    for k in range(3):
        picture[:, k] += np.bincount(parent, color[:, k], len(picture)) / _FINE**2


def _shaded(
    layer: Layer, pixel: Ints, triangle: Ints, at: Floats, inverse: Floats, camera: PainterCamera
) -> NDArray[np.float32]:
    """(n, 3) colour of the triangles at these pixels."""
    y, x = np.divmod(pixel, camera.width)
    e, f, start = at[:, 1] - at[:, 0], at[:, 2] - at[:, 0], at[:, 0] - 0.5
    whole = e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]
    whole = np.where(whole == 0.0, 1.0, whole)[:, None, None]
    # a normal over its depth is linear in the picture, as one over depth is
    n = layer.normals * inverse[:, :, None]
    dn = np.stack([n[:, 1] - n[:, 0], n[:, 2] - n[:, 0]], axis=1)
    by_x = (dn[:, 0] * f[:, 1:] - dn[:, 1] * e[:, 1:]) / whole[:, 0]
    by_y = (dn[:, 1] * e[:, :1] - dn[:, 0] * f[:, :1]) / whole[:, 0]
    single = np.concatenate([n[:, 0], by_x, by_y, start, layer.color, layer.shade[:, None]], axis=1).astype(
        np.float32
    )[triangle]
    x, y = x.astype(np.float32), y.astype(np.float32)
    normal = (
        single[:, :3]
        + single[:, 3:6] * (x - single[:, 9])[:, None]
        + single[:, 6:9] * (y - single[:, 10])[:, None]
    )
    view = -camera.rays(x + np.float32(0.5), y + np.float32(0.5)).astype(np.float32)
    light = _LIGHT.astype(np.float32)
    size, far, facing = _dot(normal, normal), _dot(view, view), _dot(normal, view)
    scale = np.where(facing < 0.0, np.float32(-1.0), np.float32(1.0)) / np.sqrt(
        np.maximum(size, np.float32(1e-18))
    )
    view /= np.sqrt(far)[:, None]
    toward = scale * (normal @ light)
    half = view + light
    glance = scale * _dot(normal, half) / np.sqrt(_dot(half, half))
    shade = single[:, 14]
    bright = 1.0 + shade * (0.14 * scale * normal[:, 2] + 0.46 * np.maximum(toward, 0.0) - 0.48)
    gleam = 0.28 * shade * np.maximum(glance, 0.0) ** 48
    return np.asarray(single[:, 11:14] * bright[:, None] + gleam[:, None], np.float32)


def _dot(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(np.einsum("nk,nk->n", a, b))
