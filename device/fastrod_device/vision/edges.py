"""The four sides of a marker in a picture, to a few hundredths of a pixel: a blurred step fitted to the grey
levels along each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from fastrod.types import Floats
from fastrod_device.vision.camera import Camera, Picture

_STRIP = 3.0  # of the strip that is fitted, to either side of an edge [px]
_LEAST_STEP = 15.0  # least contrast of a side [grey levels]
_SHARP = 0.28  # of a picture without blur: the standard deviation of a pixel [px]
_FARTHEST = 4.0  # that a fit may move a corner [px]
# weak beliefs for tiny markers: blur [px], and how much it and the first levels weigh
_BLUR, _BLUR_WEIGHT, _LEVEL_WEIGHT = 0.8, 60.0, 0.1


@dataclass(frozen=True, kw_only=True, eq=False)
class Sides:
    """A quad, in pixels of the same camera without distortion."""

    corners: Floats
    """(4, 2) clockwise from the marker's top left [px]."""
    lines: Floats
    """(4, 3) of line k, from corner k to the next: n_x, n_y, c with n . p = c; n is of length 1 and points
    outward."""
    weights: Floats
    """(4,) a longer side has more pixels: root of its part of the mean length."""
    fitted: bool
    """False where a side could not be fitted (covered, cut off, tiny, without contrast): then these are the
    corners that were given."""


@final
class SideFit:
    """Fits the sides of quads in the pictures of one camera."""

    def __init__(self, camera: Camera) -> None:
        import cv2
        from scipy.special import ndtr

        self._camera, self._ndtr = camera, ndtr
        width, height = camera.size
        grid = np.stack(
            np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)), axis=-1
        )
        self._matrix, self._lens = camera.intrinsics, camera.lens
        self._straight = not self._lens.any()
        if not self._straight:
            many = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 20, 1e-9)
            points = cv2.undistortPoints(
                grid.reshape(-1, 1, 2), self._matrix, self._lens, P=self._matrix, criteria=many
            )
            grid = np.asarray(points, dtype=np.float64).reshape(height, width, 2)
        self._ideal = grid

    def __call__(self, image: Picture, corners: Floats, cells: int) -> Sides:
        """Sides from corners (4, 2) in the picture that are right to about a pixel; `cells`: along a side,
        border and all."""
        start = ideal = self.undistorted(corners)
        raw, lines = corners, _lines(start)
        shortest = float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).min())
        # first from some rows of pixels only, to lay the strips right; then from all, or half of very many
        rough, fine = int(np.clip(shortest / 20.0, 1.0, 4.0)), int(np.clip(shortest / 45.0, 1.0, 3.0))
        for spacing, enough in ((rough, 0.1), (fine, 5e-3)):
            found = self._lines(image, raw, ideal, cells, spacing, enough)
            if found is None:
                return _sides(start, _lines(start), fitted=False)
            lines, ideal = found, _crossings(found)
            if np.abs(ideal - start).max() > _FARTHEST:
                return _sides(start, _lines(start), fitted=False)
            raw = self.distorted(ideal)
        return _sides(ideal, lines, fitted=True)

    def undistorted(self, pixels: Floats) -> Floats:
        """(n, 2) where the camera would see these without distortion [px]."""
        import cv2

        if self._straight:
            return pixels
        many = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 20, 1e-9)
        found = cv2.undistortPoints(
            pixels.reshape(-1, 1, 2), self._matrix, self._lens, P=self._matrix, criteria=many
        )
        return np.asarray(found, dtype=np.float64).reshape(-1, 2)

    def distorted(self, pixels: Floats) -> Floats:
        """(n, 2) where the camera sees what is here without distortion [px]."""
        import cv2

        if self._straight:
            return pixels
        k = self._matrix
        rays = np.column_stack([(pixels - k[:2, 2]) / (k[0, 0], k[1, 1]), np.ones(len(pixels))])
        return np.asarray(
            cv2.projectPoints(rays, np.zeros(3), np.zeros(3), k, self._lens)[0], dtype=np.float64
        ).reshape(-1, 2)

    def _lines(
        self, image: Picture, raw: Floats, ideal: Floats, cells: int, spacing: int, enough: float
    ) -> Floats | None:
        """(4, 3) better lines, or None. Grey = b + (a - b) Phi(d / s): d distance outward, a outside, b
        inside, s the blur.

        Every `spacing`-th row of pixels across a side takes part, until it moves by less than `enough` [px].
        """
        ahead = np.roll(ideal, -1, axis=0)
        middle, length = 0.5 * (ideal + ahead), np.linalg.norm(ahead - ideal, axis=1)
        along = (ahead - ideal) / length[:, None]
        out = np.stack([along[:, 1], -along[:, 0]], axis=1)
        depth = -((np.roll(ideal, -2, axis=0) + np.roll(ideal, -3, axis=0)) / 2.0 - middle) @ out.T
        half_width = np.clip(0.6 * np.diagonal(depth) / cells, 1.0, _STRIP)
        x, y, inside = self._strips(
            raw, int(np.ceil((half_width / np.abs(along).max(1)).max() + 0.5)), spacing
        )
        p = self._ideal[y, x] - middle[:, None]  # (4, n, 2)
        d0 = (p * out[:, None]).sum(-1)
        u = (p * along[:, None]).sum(-1) * (2.0 / length)[:, None]
        end = 1.0 - 2.0 * np.minimum((half_width + 1.0) / length, 0.3)
        inside &= (np.abs(d0) <= half_width[:, None]) & (np.abs(u) <= end[:, None])
        n = inside.sum(1)
        if (n < 12).any():
            return None
        grey = image[y, x].astype(np.float64)
        use = inside.astype(np.float64)
        far = [inside & (sign * d0 > 0.4 * half_width[:, None]) for sign in (1.0, -1.0)]
        if any((side.sum(1) < 3).any() for side in far):
            return None
        high, low = ((grey * side).sum(1) / side.sum(1) for side in far)
        first_high, first_low = high, low
        offset, tilt, blur = np.zeros(4), np.zeros(4), np.full(4, _BLUR)
        belief = np.array([1e-6, 1e-6, _BLUR_WEIGHT, _LEVEL_WEIGHT, _LEVEL_WEIGHT])
        for k in range(8):
            z = (d0 - offset[:, None] - tilt[:, None] * u) / blur[:, None]
            phi, bell = self._ndtr(z), np.exp(-0.5 * z * z) * 0.3989422804014327
            step = (high - low)[:, None]
            slope = -step * bell / blur[:, None]
            J = np.stack([slope, slope * u, slope * z, phi, 1.0 - phi], axis=1) * use[:, None]  # (4, 5, n)
            r = (grey - low[:, None] - step * phi) * use
            H = J @ J.transpose(0, 2, 1)
            H += np.diag(belief)
            g = (J @ r[..., None])[..., 0]
            g[:, 2:] += belief[2:] * np.stack([_BLUR - blur, first_high - high, first_low - low], axis=1)
            change = np.linalg.solve(H, g[..., None])[..., 0]
            largest = 0.8**k  # [px]
            move = np.clip(change[:, :2], -largest, largest)
            offset, tilt = offset + move[:, 0], tilt + move[:, 1]
            blur = np.clip(blur + np.clip(change[:, 2], -0.3, 0.3), _SHARP, 2.5)
            high, low = high + change[:, 3], low + change[:, 4]
            if np.abs(move).max() < enough:
                break
        if np.abs(move).max() > max(enough, 0.1):
            return None
        if (high - low < _LEAST_STEP).any() or ((r * r).sum(1) > n * (0.25 * (high - low)) ** 2).any():
            return None
        normal = out - (2.0 * tilt / length)[:, None] * along
        scale = np.linalg.norm(normal, axis=1)
        return np.column_stack([normal / scale[:, None], ((normal * middle).sum(1) + offset) / scale])

    def _strips(
        self, raw: Floats, half: int, spacing: int
    ) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.int64]], ...]:
        """Pixels along the four sides: columns and rows (4, n), and which of them count; a side is walked
        along its longer axis."""
        ahead = np.roll(raw, -1, axis=0)
        width, height = self._camera.size
        edge = ahead - raw
        steep = np.abs(edge[:, 1]) > np.abs(edge[:, 0])
        major = np.where(steep[:, None], raw[:, ::-1], raw)  # (4, 2) walked, crossed
        edge = np.where(steep[:, None], edge[:, ::-1], edge)
        sign = np.where(edge[:, 0] < 0.0, -1, 1)
        n = np.floor(np.abs(edge[:, 0])).astype(np.int64)
        k = np.arange(0, n.max() + 1, spacing)
        walked = np.rint(major[:, 0]).astype(np.int64)[:, None] + sign[:, None] * k
        crossed = major[:, 1, None] + (edge[:, 1] / edge[:, 0])[:, None] * (walked - major[:, 0, None])
        across = np.rint(crossed).astype(np.int64)[:, :, None] + np.arange(-half, half + 1)
        walked = np.broadcast_to(walked[:, :, None], across.shape)
        counts = np.broadcast_to((k <= n[:, None])[:, :, None], across.shape)
        x = np.where(steep[:, None, None], across, walked).reshape(4, -1)
        y = np.where(steep[:, None, None], walked, across).reshape(4, -1)
        inside = counts.reshape(4, -1) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        return np.clip(x, 0, width - 1), np.clip(y, 0, height - 1), inside  # type: ignore[return-value]


def _lines(corners: Floats) -> Floats:
    """(4, 3) of the sides of a clockwise quad, normals outward."""
    edge = np.roll(corners, -1, axis=0) - corners
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1)[:, None]
    return np.column_stack([normal, (normal * corners).sum(1)])


def _crossings(lines: Floats) -> Floats:
    """(4, 2) corners: of the line before with the own one."""
    before = np.roll(lines, 1, axis=0)
    return np.asarray(
        np.linalg.solve(
            np.stack([before[:, :2], lines[:, :2]], axis=1),
            np.stack([before[:, 2], lines[:, 2]], axis=1)[..., None],
        )[..., 0]
    )


def _sides(corners: Floats, lines: Floats, *, fitted: bool) -> Sides:
    length = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    return Sides(
        corners=corners, lines=lines, weights=np.asarray(np.sqrt(length / length.mean())), fitted=fitted
    )
