"""A camera's lens and pose, from pictures of a printed board."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from fastrod.errors import InputError
from fastrod.rotation import matrix_from_quaternion, product, quaternion_from_matrix, quaternion_from_vector
from fastrod.types import Floats
from fastrod_device.errors import CalibrationError
from fastrod_device.vision.camera import Camera, Picture, Pose, compose, dictionary_named, inverse, rotation

if TYPE_CHECKING:
    import cv2

_LEAST_VIEWS, _LEAST_CORNERS = 5, 8
_LEAST_TILT = math.radians(12.0)
_LARGEST_SPREAD = 0.03  # standard error of the focal length, as a part of it
_SCATTER_VIEWS = 4  # from so many views on their scatter says something


@final
@dataclass(frozen=True, kw_only=True)
class CharucoBoard:
    """A chessboard with a marker in every white square. Its axes: x right and y down on the print, z into it,
    origin at the top left.

    Raises `InputError` for what cannot be printed, `UnknownNameError` for the dictionary.
    """

    columns: int
    """Squares side by side."""
    rows: int
    """Squares one below the other."""
    square: float
    """Side of a square [m]."""
    marker: float
    """Side of a marker [m]."""
    dictionary: str = "DICT_5X5_100"
    """OpenCV's name of the dictionary; markers are numbered from 0."""

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3:
            raise InputError(
                f"CharucoBoard has {self.columns} x {self.rows} squares; it must have 3 x 3 or more."
            )
        if not 0.0 < self.marker < self.square <= 1.0:
            raise InputError(
                f"CharucoBoard.marker is {self.marker!r} m, square {self.square!r} m; 0 < marker < square "
                "<= 1 would be right."
            )
        needed, there = self.columns * self.rows // 2, len(dictionary_named(self.dictionary).bytesList)
        if needed > there:
            raise InputError(f"CharucoBoard needs {needed} markers; {self.dictionary} has {there}.")

    def draw(self, pixels_per_square: int) -> Picture:
        """(h, w) picture to print, with a white border of half a square."""
        if pixels_per_square < 16:
            raise InputError(f"pixels_per_square is {pixels_per_square!r}; it must be 16 or more.")
        size = (self.columns * pixels_per_square, self.rows * pixels_per_square)
        inner = self.opencv().generateImage(size, marginSize=0)
        return np.pad(np.asarray(inner, dtype=np.uint8), pixels_per_square // 2, constant_values=255)

    def opencv(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's object of it."""
        import cv2

        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square, self.marker, dictionary_named(self.dictionary)
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class BoardView:
    """Corners of a board in one picture."""

    points: Floats
    """(n, 3) on the board [m]."""
    pixels: Floats
    """(n, 2) in the picture [px]."""
    why: str
    """Why it cannot be used; empty where it can."""


@final
class BoardFinder:
    """Finds the inner corners of a board."""

    def __init__(self, board: CharucoBoard) -> None:
        import cv2

        self.board = board
        shape = board.opencv()
        self._places: Floats = np.asarray(shape.getChessboardCorners(), dtype=np.float64)
        self._detector = cv2.aruco.CharucoDetector(shape)

    def find(self, image: Picture) -> BoardView:
        """Return what a picture (h, w) shows of it; the board may stick out of it."""
        corners, ids, _, _ = self._detector.detectBoard(image)
        numbers = np.ravel(ids).astype(int) if ids is not None else np.zeros(0, dtype=int)
        points, n = self._places[numbers], len(numbers)
        if n < _LEAST_CORNERS:
            why = f"{n} corners seen, {_LEAST_CORNERS} are needed" if n else "no board seen"
            return BoardView(
                points=points,
                pixels=np.asarray(corners if n else [], dtype=np.float64).reshape(-1, 2),
                why=why,
            )
        pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        if min(np.ptp(points[:, 0]), np.ptp(points[:, 1])) < 0.5 * self.board.square:
            return BoardView(points=points, pixels=pixels, why="its corners lie on one line")
        return BoardView(points=points, pixels=_sharpened(image, pixels, self.board), why="")


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraCalibration:
    """Intrinsics of a camera, and how well they are known."""

    matrix: Floats
    """(3, 3) [px]."""
    distortion: Floats
    """(5,) k1, k2, p1, p2, k3."""
    size: tuple[int, int]
    """Width and height [px]."""
    error: float
    """Root mean square distance of the corners [px]."""
    stderr: Floats
    """(9,) of fx, fy, cx, cy [px], k1, k2, p1, p2, k3; 0 for what was not fitted."""
    used: tuple[int, ...]
    """Views that took part, by their index."""
    refused: tuple[tuple[int, str], ...]
    """Views that did not, and why."""

    def camera(self, *, rate: float = 30.0, latency: float = 0.0) -> Camera:
        """A camera with these intrinsics, at the origin until `MarkerRegistration.camera` says where."""
        rows = (_three(row) for row in self.matrix)
        k1, k2, p1, p2, k3 = self.distortion.tolist()
        return Camera(
            matrix=(next(rows), next(rows), next(rows)),
            distortion=(k1, k2, p1, p2, k3),
            size=self.size,
            rate=rate,
            latency=latency,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class MarkerRegistration:
    """Pose of a camera, and how well it is known."""

    position: Floats
    """(3,) of base_from_camera [m]."""
    quaternion: Floats
    """(4,) of base_from_camera, w x y z."""
    position_stderr: Floats
    """(3,) along the base's axes [m]."""
    rotation_stderr: Floats
    """(3,) about the camera's axes [rad]."""
    error: float
    """Root mean square distance of the corners [px]."""
    used: tuple[int, ...]
    """Views that took part, by their index."""
    refused: tuple[tuple[int, str], ...]
    """Views that did not, and why."""

    def camera(self, camera: Camera) -> Camera:
        """The same camera, standing here."""
        w, x, y, z = self.quaternion.tolist()
        return replace(camera, position=_three(self.position), quaternion=(w, x, y, z))


def calibrate(
    images: Sequence[Picture], board: CharucoBoard, *, third_radial: bool = False
) -> CameraCalibration:
    """Intrinsics from pictures (h, w) of a board, near and far, tilted to all sides, also in the picture's
    corners.

    `third_radial`: fit k3 too; few lenses need it, and it is poorly determined. Raises `CalibrationError`
    where the views do not tell.
    """
    import cv2

    size = _size(images)
    used, refused, points, pixels = _corners(images, board)
    if len(used) < _LEAST_VIEWS:
        raise CalibrationError(
            f"{len(used)} of {len(images)} views show the board well enough{_why(refused)}; {_LEAST_VIEWS} "
            "or more are needed."
        )
    flags = 0 if third_radial else cv2.CALIB_FIX_K3
    start = np.array(
        [[max(size), 0.0, (size[0] - 1) / 2.0], [0.0, max(size), (size[1] - 1) / 2.0], [0.0, 0.0, 1.0]]
    )
    flags |= cv2.CALIB_USE_INTRINSIC_GUESS
    points_32, pixels_32 = [p.astype(np.float32) for p in points], [p.astype(np.float32) for p in pixels]
    try:
        error, matrix, distortion, orientations, _, spread, _, _ = cv2.calibrateCameraExtended(
            points_32, pixels_32, size, start, np.zeros(5), flags=flags
        )
    except cv2.error as problem:
        raise CalibrationError(
            "the views do not determine a camera; show the board tilted to all sides, near and far."
        ) from problem
    normals = np.stack([cv2.Rodrigues(orientation)[0][:, 2] for orientation in orientations])
    apart = float(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0)).max())
    if apart < _LEAST_TILT:
        raise CalibrationError(
            f"the views are all alike: their tilts differ by {math.degrees(apart):.0f} deg at most; tilt "
            "the board by 30 deg to all sides."
        )
    stderr = np.ravel(spread)[:9]
    if not stderr[:2].max() < _LARGEST_SPREAD * matrix[0, 0]:
        known = f"{matrix[0, 0]:.0f} px uncertain by {stderr[:2].max():.0f} px"
        raise CalibrationError(
            f"the views leave the focal length {known}; show the board tilted, near and far."
        )
    return CameraCalibration(
        matrix=np.asarray(matrix, dtype=np.float64),
        distortion=np.ravel(distortion)[:5].astype(np.float64),
        size=size,
        error=float(error),
        stderr=stderr.astype(np.float64),
        used=tuple(used),
        refused=tuple(refused),
    )


def register_base(
    images: Sequence[Picture], board: CharucoBoard, camera: Camera, *, position: Floats, quaternion: Floats
) -> MarkerRegistration:
    """Return where the camera stands, from pictures of a board at known places: base_from_board, one for all
    images or one each.

    `position` (3,) or (n, 3) [m], `quaternion` (4,) or (n, 4). Standard errors are the larger of two: from
    the corners' misfit, and from the scatter of single views, where there are 4 or more; an error that all
    views share (a board that is fixed askew) is in neither. Raises `CalibrationError` where no view tells,
    `InputError` for wrong shapes.
    """
    if _size(images) != camera.size:
        raise InputError(f"the pictures are {_size(images)} px; those of the camera are {camera.size} px.")
    try:
        places = np.broadcast_to(np.asarray(position, dtype=np.float64), (len(images), 3))
        orientations = np.broadcast_to(np.asarray(quaternion, dtype=np.float64), (len(images), 4))
    except ValueError as error:
        shapes = f"{np.shape(position)} and {np.shape(quaternion)}"
        raise InputError(
            f"position and quaternion have shapes {shapes}; (3,) and (4,), or a row for each picture, would "
            "be right."
        ) from error
    if not (np.isfinite(places).all() and np.allclose(np.linalg.norm(orientations, axis=1), 1.0, atol=1e-4)):
        raise InputError(
            "a place of the board is not finite, or its quaternion not of norm 1 (order w x y z)."
        )
    used, refused, points, pixels = _corners(images, board)
    if not used:
        raise CalibrationError(f"none of {len(images)} views shows the board well enough{_why(refused)}.")
    space = [p @ rotation(orientations[k]).T + places[k] for k, p in zip(used, points, strict=True)]
    singles = []
    for k, p, seen in zip(used, points, pixels, strict=True):
        camera_from_board = _board_pose(p, seen, camera)
        singles.append(compose((places[k], orientations[k]), inverse(camera_from_board)))
    found, misfit, spread = _stand(singles[0], np.concatenate(space), np.concatenate(pixels), camera)
    if len(used) >= _SCATTER_VIEWS:
        one = [
            _stand(start, p, seen, camera)[0] for start, p, seen in zip(singles, space, pixels, strict=True)
        ]
        spread = np.maximum(spread, _scatter(one, found))
    return MarkerRegistration(
        position=found[0],
        quaternion=found[1],
        position_stderr=spread[:3],
        rotation_stderr=spread[3:],
        error=misfit,
        used=tuple(used),
        refused=tuple(refused),
    )


def _three(row: Floats) -> tuple[float, float, float]:
    a, b, c = row.tolist()
    return a, b, c


def _size(images: Sequence[Picture]) -> tuple[int, int]:
    if not images:
        raise CalibrationError("no pictures were given; some of the board would be right.")
    shapes = sorted({image.shape for image in images})
    if len(shapes) > 1 or len(shapes[0]) != 2 or any(image.dtype != np.uint8 for image in images):
        raise InputError(
            f"the pictures have shapes {shapes}; all must be (h, w), one size, uint8 grey levels."
        )
    return int(shapes[0][1]), int(shapes[0][0])


def _corners(
    images: Sequence[Picture], board: CharucoBoard
) -> tuple[list[int], list[tuple[int, str]], list[Floats], list[Floats]]:
    """Index of each good view, each other one and why; corners on the board (n, 3) [m] and in the picture (n,
    2) [px] of the good ones."""
    finder = BoardFinder(board)
    views = [finder.find(image) for image in images]
    used = [k for k, view in enumerate(views) if not view.why]
    refused = [(k, view.why) for k, view in enumerate(views) if view.why]
    return used, refused, [views[k].points for k in used], [views[k].pixels for k in used]


def _sharpened(image: Picture, corners: Floats, board: CharucoBoard) -> Floats:
    """(n, 2) the corners once more, in windows that reach to no marker: a quarter less scatter than OpenCV's
    own choice leaves."""
    import cv2

    apart = np.linalg.norm(corners[:, None] - corners, axis=2)
    square = float((apart + 1e9 * np.eye(len(corners))).min())
    half = int(np.clip(0.4 * square * (1.0 - board.marker / board.square), 2, 5))
    until = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    found = cv2.cornerSubPix(
        image, corners.astype(np.float32).reshape(-1, 1, 2), (half, half), (-1, -1), until
    )
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)


def _why(refused: Sequence[tuple[int, str]]) -> str:
    """In brackets, the reasons."""
    return f" ({'; '.join(sorted({why for _, why in refused}))})" if refused else ""


def _board_pose(points: Floats, pixels: Floats, camera: Camera) -> Pose:
    """Camera_from_board of one view."""
    import cv2

    good, orientation, shift = cv2.solvePnP(
        points, pixels, camera.intrinsics, camera.lens, flags=cv2.SOLVEPNP_IPPE
    )
    if not good:
        raise CalibrationError("a view of the board gives no pose; is the camera's matrix right?")
    return np.ravel(shift).astype(np.float64), quaternion_from_matrix(
        np.asarray(cv2.Rodrigues(orientation)[0], dtype=np.float64)
    )


def _stand(start: Pose, points: Floats, pixels: Floats, camera: Camera) -> tuple[Pose, float, Floats]:
    """Base_from_camera of least misfit to points (n, 3) of the base [m], rms misfit [px], standard errors
    (6,) [m, rad]."""
    import cv2

    place, orientation = start
    for _ in range(20):
        R = rotation(orientation)
        y = (points - place) @ R
        seen, by = cv2.projectPoints(y, np.zeros(3), np.zeros(3), camera.intrinsics, camera.lens)
        by_y = np.asarray(by[:, 3:6], dtype=np.float64).reshape(-1, 2, 3)
        r = pixels - seen.reshape(-1, 2)
        # y = exp(-phi) R^T (x - p): by p it is -R^T, by phi y x
        J = np.concatenate([-by_y @ R.T, np.cross(by_y, y[:, None])], axis=2).reshape(-1, 6)
        step = np.linalg.lstsq(J, r.ravel(), rcond=None)[0]
        place, orientation = place + step[:3], product(orientation, quaternion_from_vector(step[3:]))
        if np.abs(step).max() < 1e-10:
            break
    orientation = orientation / np.linalg.norm(orientation)
    variance = float((r * r).sum()) / max(r.size - 6, 1)
    spread = np.sqrt(variance * np.diagonal(np.linalg.inv(J.T @ J)))
    return (place, orientation), math.sqrt(float((r * r).sum(1).mean())), spread


def _scatter(ones: Sequence[Pose], mean: Pose) -> Floats:
    """(6,) standard errors [m, rad] of a mean from single values."""
    moved = np.stack([place - mean[0] for place, _ in ones])
    orientation = matrix_from_quaternion(
        np.stack([product(inverse(mean)[1], quaternion) for _, quaternion in ones])
    )
    rotated = 0.5 * np.stack(
        [
            orientation[:, 2, 1] - orientation[:, 1, 2],
            orientation[:, 0, 2] - orientation[:, 2, 0],
            orientation[:, 1, 0] - orientation[:, 0, 1],
        ],
        axis=1,
    )
    return np.asarray(np.concatenate([moved, rotated], axis=1).std(0, ddof=1) / math.sqrt(len(ones)))
