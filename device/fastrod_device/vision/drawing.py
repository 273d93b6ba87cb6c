"""The emulator's eye: what a camera sees of a marker or a board, by exact area coverage of every pixel. It
shares no code with the tracker.

A print is rectangles in a plane. Each edge is projected, lens included, in pieces shorter than a pixel, and
every piece adds the area between it and the picture's right end: a sum along the rows gives the part of each
pixel that ink covers, without sampling.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, final

import numpy as np

from fastrod.checks import Bound, check
from fastrod.errors import InputError
from fastrod.types import Floats, Singles
from fastrod_device.vision.calibration import CharucoBoard
from fastrod_device.vision.camera import (
    Camera,
    Marker,
    Picture,
    Pose,
    compose,
    dictionary_named,
    inverse,
    rotation,
)

_NEAR = 1e-3  # nothing nearer to the camera is drawn [m]
_POOL, _SLACK = 4, 128  # noise pictures that are kept, and by how much one may be shifted [px]


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnScene:
    """Look of the drawn picture. Raises `InputError`."""

    white: float = 210.0
    """Grey level of paper."""
    black: float = 40.0
    """Grey level of ink."""
    background: float | Picture = 110.0
    """Grey level around it, or a picture of the camera's size."""
    blur: Annotated[float, Bound(least=0.0, most=50.0)] = 0.7
    """Standard deviation of the lens's blur [px]."""
    noise: Annotated[float, Bound(least=0.0, most=50.0)] = 2.0
    """Standard deviation of a pixel [grey levels]."""
    gradient: tuple[float, float] = (0.1, 0.05)
    """Change of the light across the picture, to the right and down, as a part of it."""
    vignetting: Annotated[float, Bound(least=0.0, most=50.0)] = 0.08
    """Light that is lost in the corners, as a part of it."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.black < self.white <= 255.0:
            raise InputError(
                f"Scene.black is {self.black!r} and white {self.white!r}; 0 <= black < white "
                "<= 255 would be right."
            )
        check(self, "Scene.")


@dataclass(frozen=True, eq=False)
class _Print:
    """Rectangles in a plane: left, top, right, bottom (n, 4) [m]; the first is the paper."""

    box: Floats
    ink: Floats
    """(n,) 1 where a rectangle is printed black, -1 where it is left white in a black one; 0 for the
    paper."""


def project(camera: Camera, points: Floats) -> Floats:
    """(n, 2) pixels of points (n, 3) in the camera's frame [m], by OpenCV's lens model."""
    k1, k2, p1, p2, k3 = camera.distortion
    xy = points[:, :2] / points[:, 2:]
    r2 = (xy * xy).sum(1)
    limit = _fold(float(k1), float(k2), float(k3))
    if limit < np.inf:  # beyond it the polynomial would fold the picture back
        xy = xy * np.minimum(1.0, limit / np.sqrt(np.maximum(r2, 1e-30)))[:, None]
        r2 = (xy * xy).sum(1)
    x, y = xy.T
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    m = camera.intrinsics
    return np.stack([m[0, 0] * u + m[0, 2], m[1, 1] * v + m[1, 2]], axis=1)


@lru_cache(maxsize=8)
def _fold(k1: float, k2: float, k3: float) -> float:
    """Radius from which a larger one is seen no farther out; inf where there is none up to 4."""
    r = np.linspace(0.0, 4.0, 4001)
    falling = 1.0 + 3.0 * k1 * r**2 + 5.0 * k2 * r**4 + 7.0 * k3 * r**6 <= 0.0
    return float(r[np.argmax(falling)]) if falling.any() else np.inf


PLAIN = DrawnScene()
"""The scene where none is given."""


@final
class Eye:
    """A camera that looks at a marker: pictures one after the other, their noise drawn by a seed."""

    def __init__(
        self, camera: Camera, marker: Marker, *, seed: int = 0, scene: DrawnScene | None = None
    ) -> None:
        self.camera, self.marker, self.scene = camera, marker, scene or PLAIN
        self._rng = np.random.default_rng(seed)

    def draw(self, position: Floats, quaternion: Floats, *, marker: bool = True) -> Picture:
        """(h, w) picture of the marker on a tip at base_from_tip, position (3,) [m] and quaternion (4,);
        without `marker` it is covered."""
        sheet = _marker_print(self.marker) if marker else None
        return _picture(
            self.camera,
            sheet,
            _in_camera(self.camera, self.marker, position, quaternion),
            self._rng,
            self.scene,
        )


def draw(
    camera: Camera,
    marker: Marker,
    position: Floats,
    quaternion: Floats,
    *,
    rng: np.random.Generator,
    scene: DrawnScene | None = None,
) -> Picture:
    """(h, w) picture of the marker on a tip at base_from_tip, position (3,) [m] and quaternion (4,); from
    behind it is not seen."""
    return _picture(
        camera, _marker_print(marker), _in_camera(camera, marker, position, quaternion), rng, scene or PLAIN
    )


def draw_board(
    camera: Camera,
    board: CharucoBoard,
    position: Floats,
    quaternion: Floats,
    *,
    rng: np.random.Generator,
    scene: DrawnScene | None = None,
) -> Picture:
    """(h, w) picture of a board at base_from_board, position (3,) [m] and quaternion (4,)."""
    camera_from_board = compose(inverse(camera.base_from_camera), (position, quaternion))
    return _picture(camera, _board_print(board), camera_from_board, rng, scene or PLAIN)


def _in_camera(camera: Camera, marker: Marker, position: Floats, quaternion: Floats) -> Pose:
    """Camera_from_marker of a tip."""
    return compose(inverse(camera.base_from_camera), compose((position, quaternion), marker.tip_from_marker))


@lru_cache(maxsize=16)
def _marker_print(marker: Marker) -> _Print:
    """The marker with a quiet zone of one cell; y up."""
    bits = _bits(marker.dictionary, marker.id)
    half, cell = marker.size / 2.0, marker.size / len(bits)
    boxes = [(-half - cell, half + cell, half + cell, -half - cell), (-half, half, half, -half)]
    boxes += [
        (-half + cell * a, half - cell * j, -half + cell * b, half - cell * (j + 1))
        for j, a, b in _runs(bits)
    ]
    return _Print(np.array(boxes), np.array([0.0, 1.0] + [-1.0] * (len(boxes) - 2)))


@lru_cache(maxsize=4)
def _board_print(board: CharucoBoard) -> _Print:
    """The board with a white border of half a square; y down."""
    side, edge = board.square, 0.5 * board.square
    boxes = [(-edge, -edge, board.columns * side + edge, board.rows * side + edge)]
    ink = [0.0]
    number = 0
    for j in range(board.rows):
        for i in range(board.columns):
            left, top = i * side, j * side
            if (i + j) % 2 == 0:
                boxes.append((left, top, left + side, top + side))
                ink.append(1.0)
                continue
            bits, margin = _bits(board.dictionary, number), (side - board.marker) / 2.0
            number += 1
            left, top, cell = left + margin, top + margin, board.marker / len(bits)
            boxes.append((left, top, left + board.marker, top + board.marker))
            runs = _runs(bits)
            boxes += [
                (left + cell * a, top + cell * k, left + cell * b, top + cell * (k + 1)) for k, a, b in runs
            ]
            ink += [1.0] + [-1.0] * len(runs)
    return _Print(np.array(boxes), np.array(ink))


def _bits(dictionary: str, number: int) -> Picture:
    """(n, n) cells of a marker with its black border; 0 is black."""
    import cv2

    found = dictionary_named(dictionary)
    return np.asarray(cv2.aruco.generateImageMarker(found, number, found.markerSize + 2), dtype=np.uint8)


def _runs(bits: Picture) -> list[tuple[int, int, int]]:
    """White cells in a row: row, first column, column after the last."""
    runs = []
    for j, row in enumerate(bits):
        ends = np.flatnonzero(np.diff(np.concatenate([[0], row > 0, [0]]).astype(int)))
        runs += [(j, int(a), int(b)) for a, b in ends.reshape(-1, 2)]
    return runs


@lru_cache(maxsize=4)
def _backdrop(size: tuple[int, int], scene: DrawnScene) -> tuple[Singles, Singles, list[Singles]]:
    """Light (h, w), the lit background (h, w), and noise pictures that are a little larger; single precision,
    for speed."""
    width, height = size
    x, y = np.linspace(-1.0, 1.0, width), np.linspace(-1.0, 1.0, height)[:, None]
    light = (
        1.0 + 0.5 * (scene.gradient[0] * x + scene.gradient[1] * y) - scene.vignetting * 0.5 * (x * x + y * y)
    )
    background = np.asarray(scene.background, dtype=np.float64)
    if background.ndim and background.shape != (height, width):
        raise InputError(
            f"Scene.background has shape {background.shape}; a picture of the camera has {(height, width)}."
        )
    rng = np.random.default_rng(0)
    pool = [
        scene.noise * rng.standard_normal((height + _SLACK, width + _SLACK), dtype=np.float32)
        for _ in range(_POOL)
    ]
    return (
        light.astype(np.float32),
        (light * background).astype(np.float32),
        [noise.astype(np.float32) for noise in pool],
    )


def _picture(
    camera: Camera, sheet: _Print | None, camera_from_print: Pose, rng: np.random.Generator, scene: DrawnScene
) -> Picture:
    import cv2

    light, backdrop, pool = _backdrop(camera.size, scene)
    picture = backdrop.copy()
    margin = int(np.ceil(4.0 * scene.blur)) + 2
    found = None if sheet is None else _edges(camera, sheet, camera_from_print)
    if found is not None:
        start, end, weight = found
        low = np.maximum(np.floor(start.min(0)).astype(int) - margin, -margin)
        high = np.minimum(np.ceil(start.max(0)).astype(int) + margin + 1, np.array(camera.size) + margin)
        if (high > low).all() and (high > 0).all() and (low < camera.size).all():
            paper, ink = _cover(
                start - low, end - low, weight, (int(high[0] - low[0]), int(high[1] - low[1]))
            )
            print_ = scene.white * paper - (scene.white - scene.black) * ink
            if scene.blur > 0.0:
                n = 2 * margin + 1
                paper, print_ = (_blurred(a, n, scene.blur) for a in (paper, print_))
            a, b = np.maximum(low, 0), np.minimum(high, camera.size)
            seen = np.s_[a[1] : b[1], a[0] : b[0]]
            cut = np.s_[a[1] - low[1] : b[1] - low[1], a[0] - low[0] : b[0] - low[0]]
            picture[seen] = picture[seen] * (1.0 - paper[cut]) + light[seen] * print_[cut]
    which, down, right = rng.integers(0, (_POOL, _SLACK, _SLACK))
    height, width = picture.shape
    noise = pool[which][down : down + height, right : right + width]
    return np.asarray(cv2.add(picture, noise, dtype=cv2.CV_8U), dtype=np.uint8)


def _blurred(fraction: Singles, n: int, sigma: float) -> Singles:
    """By a Gaussian of n x n pixels."""
    import cv2

    return np.asarray(
        cv2.GaussianBlur(fraction, (n, n), sigma, borderType=cv2.BORDER_REPLICATE), dtype=np.float32
    )


def _edges(camera: Camera, sheet: _Print, camera_from_print: Pose) -> tuple[Floats, Floats, Floats] | None:
    """Pieces of all edges, each shorter than a pixel: start (n, 2), end (n, 2) [px], what is left of it (n,
    2): paper and ink.

    None where the print is seen from behind, or reaches behind the camera.
    """
    left, top, right, bottom = sheet.box.T
    # clockwise
    corner = np.stack(
        [np.stack([left, right, right, left], 1), np.stack([top, top, bottom, bottom], 1)], axis=2
    )
    frame = rotation(camera_from_print[1])
    space = corner @ frame[:, :2].T + camera_from_print[0]  # (n, 4, 3)
    if space[..., 2].min() < _NEAR:
        return None
    flat = space[0, :, :2] / space[0, :, 2:]
    ahead = np.roll(flat, -1, axis=0)
    if (flat[:, 0] * ahead[:, 1] - flat[:, 1] * ahead[:, 0]).sum() <= 0.0:
        return None
    a, b = space.reshape(-1, 3), np.roll(space, -1, axis=1).reshape(-1, 3)
    pixels = project(camera, a).reshape(-1, 4, 2)
    length = np.abs(np.roll(pixels, -1, axis=1) - pixels).max(2).ravel()
    # equal steps in space are longer in the picture where the edge is nearer; a lens adds a few per cent
    uneven = (np.maximum(a[:, 2], b[:, 2]) / np.minimum(a[:, 2], b[:, 2])) ** 2
    n = np.minimum(np.ceil(1.2 * length * uneven) + 1, 20000).astype(int)
    edge = np.repeat(np.arange(len(n)), n + 1)
    first = np.cumsum(n + 1) - (n + 1)
    fraction = ((np.arange(len(edge)) - first[edge]) / n[edge])[:, None]
    points = project(camera, a[edge] * (1.0 - fraction) + b[edge] * fraction)
    whole = edge[1:] == edge[:-1]
    paper = np.zeros(len(sheet.ink))
    paper[0] = 1.0
    weight = np.stack([paper, sheet.ink], axis=1)[edge[1:][whole] // 4]
    return points[:-1][whole], points[1:][whole], weight


def _cover(start: Floats, end: Floats, weight: Floats, size: tuple[int, int]) -> tuple[Singles, Singles]:
    """(h, w) parts of each pixel that paper and ink cover; a piece crosses at most one row and one column of
    pixels."""
    width, height = size
    start, end = start + 0.5, end + 0.5  # the first pixel is 0 to 1
    a, b = np.floor(start), np.floor(end)
    with np.errstate(divide="ignore", invalid="ignore"):
        cut = np.where(a != b, (np.maximum(a, b) - start) / (end - start), 1.0)
    at = np.stack([np.zeros(len(cut)), cut.min(1), cut.max(1), np.ones(len(cut))])  # (4, n)
    point = start + at[:, :, None] * (end - start)
    middle = 0.5 * (point[1:] + point[:-1])
    fall = point[1:, :, 1] - point[:-1, :, 1]
    column, row = np.floor(middle[..., 0]).astype(int), np.floor(middle[..., 1]).astype(int)
    inside = (row >= 0) & (row < height) & (column < width) & (fall != 0.0)
    fraction = np.where(column < 0, 0.0, middle[..., 0] - column)[inside]
    place = (row * (width + 1) + np.maximum(column, 0))[inside]
    fall, which = fall[inside], np.broadcast_to(np.arange(len(start)), column.shape)[inside]
    covers = []
    for channel in range(2):
        moved = -weight[which, channel] * fall
        n = height * (width + 1)
        area = (
            np.bincount(place, moved * (1.0 - fraction), n)[:n]
            + np.bincount(place + 1, moved * fraction, n + 1)[:n]
        )
        covers.append(area.reshape(height, width + 1).cumsum(1)[:, :width].astype(np.float32))
    return covers[0], covers[1]
