"""Boards before a camera: who waves them, which pictures are taken, and the numbers that come out as
tables."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, final

import numpy as np

from fastrod.checks import COUNT, check_number
from fastrod.rotation import product, quaternion_from_vector
from fastrod.types import Floats
from fastrod_device.can.clock import Clock
from fastrod_device.errors import CalibrationError
from fastrod_device.vision.calibration import (
    BoardFinder,
    BoardView,
    CameraCalibration,
    CharucoBoard,
    MarkerRegistration,
)
from fastrod_device.vision.camera import (
    Camera,
    CameraFrame,
    FrameSource,
    Picture,
    Pose,
    compose,
    inverse,
    rotation,
)
from fastrod_device.vision.drawing import DrawnScene, draw_board

if TYPE_CHECKING:
    from rich.table import Table

APART = 0.06
"""Least distance of a corner of the board from where it was in every picture that was taken, as a fraction
of the picture's diagonal."""
PATIENCE = 60.0
"""Time in which no picture can be taken, after which there will be no more [s]."""
_STILL = 0.004  # of the diagonal: a corner that moves farther from frame to frame is blurred
_POLL = 0.005  # s between two looks for a frame
_SCENE = DrawnScene(blur=1.0, noise=5.0)
_SHAKE = 1e-4  # m per axis, of a board that somebody holds or a fixture
_MOVING, _AT_REST = 0.2, 0.25  # s of an emulated hand from place to place, and there
_FOCUS, _ASPECT, _CENTRE = 0.04, 0.005, 0.012  # of an emulated lens: off by these parts at most
_BENT, _TANGENT = (-0.25, -0.1), 5e-4  # of its k1, from and to, and of its p1 and p2
_MOVED, _ROTATED = 0.005, math.radians(2.0)  # of where an emulated camera stands, at most


class BoardMover(Protocol):
    """Interface of whoever moves the calibration board."""

    def wave(self) -> None:
        """Show the board near and far from now on, tilted to all sides, now and then at rest."""

    def place(self, position: Floats, quaternion: Floats) -> None:
        """It is at base_from_board, position (3,) [m] and quaternion (4,), when this returns, and stays."""


@final
class BoardPrompts:
    """A person at the terminal."""

    def wave(self) -> None:
        """Say what to do."""
        print(
            "Show the board to the camera, near and far, tilted by some 30 deg to all sides, also in the "
            "picture's corners; "
            "hold it still for a moment at each place."
        )

    def place(self, position: Floats, quaternion: Floats) -> None:
        """Ask for it, and wait for the Enter key."""
        where = f"x y z = {np.round(position, 4).tolist()} m, w x y z = {np.round(quaternion, 4).tolist()}"
        input(f"Please fix the board at base_from_board {where}, then press Enter: ")


@final
class BoardEye:
    """An emulated camera and the hands that hold a board before it; frames are drawn."""

    def __init__(self, camera: Camera, board: CharucoBoard, *, clock: Clock, seed: int = 0) -> None:
        """`camera` is the true one; `seed` draws noise and where hands go."""
        self.camera, self.board, self.clock = camera, board, clock
        self._rng, self._path_rng = np.random.default_rng([seed, 0]), np.random.default_rng([seed, 1])
        self._next, self._number = clock.now(), 0
        self._still: Pose | None = None
        self._began, self._places = clock.now(), [self._somewhere()]

    def wave(self) -> None:
        """The board goes from place to place before the camera, and rests at each."""
        self._still, self._began = None, self.clock.now()
        self._places = [self._somewhere()]

    def place(self, position: Floats, quaternion: Floats) -> None:
        """The board is at base_from_board, position (3,) [m] and quaternion (4,) w x y z, until `wave`."""
        self._still = position, quaternion

    def read(self) -> CameraFrame | None:
        """The newest frame, where one is due."""
        now = self.clock.now()
        if now < self._next:
            return None
        self._next = max(self._next + 1.0 / self.camera.rate, now)
        self._number += 1
        position, quaternion = self._waved(now - self._began) if self._still is None else self._still
        position = position + _SHAKE * self._rng.normal(size=3)
        image = draw_board(self.camera, self.board, position, quaternion, rng=self._rng, scene=_SCENE)
        return CameraFrame(image=image, t=now, number=self._number)

    def close(self) -> None:
        """Nothing is held."""

    def _somewhere(self) -> Pose:
        """Base_from_board where a hand might hold it: before the camera, most of it in the picture."""
        rng, camera = self._path_rng, self.camera
        azimuth, tilt, roll = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(0.1, 0.65), rng.uniform(-0.5, 0.5)
        aside = rng.uniform(-0.2, 0.2, 2) * np.array(camera.size)
        return compose(
            camera.base_from_camera,
            _before(camera, self.board, rng.uniform(0.35, 0.75), azimuth, tilt, roll, aside),
        )

    def _waved(self, t: float) -> Pose:
        each = _MOVING + _AT_REST
        k = int(t / each)
        while len(self._places) < k + 2:
            self._places.append(self._somewhere())
        fraction = min((t - k * each) / _MOVING, 1.0)
        (p, q), (ahead, orientation) = self._places[k], self._places[k + 1]
        between = (1.0 - fraction) * q + fraction * math.copysign(1.0, float(q @ orientation)) * orientation
        return p + fraction * (ahead - p), between / np.linalg.norm(between)


def bent(camera: Camera, seed: int) -> Camera:
    """Return what an emulated camera truly is, where a file says `camera`: another focal length by some
    per cent, and a bent lens."""
    rng = np.random.default_rng([seed, 2])
    (fx, _, cx), (_, fy, cy), _ = camera.matrix
    scale = 1.0 + rng.uniform(0.01, _FOCUS) * rng.choice([-1.0, 1.0])
    aspect = 1.0 + rng.uniform(-_ASPECT, _ASPECT)
    dx, dy = _CENTRE * max(camera.size) * rng.uniform(-1.0, 1.0, 2)
    k1, (p1, p2) = float(rng.uniform(*_BENT)), _TANGENT * rng.uniform(-1.0, 1.0, 2)
    matrix = ((fx * scale, 0.0, float(cx + dx)), (0.0, fy * scale * aspect, float(cy + dy)), (0.0, 0.0, 1.0))
    return replace(
        camera, matrix=matrix, distortion=(k1, float(rng.uniform(0.02, 0.1)), float(p1), float(p2), 0.0)
    )


def moved(camera: Camera, seed: int) -> Camera:
    """Return where an emulated camera truly stands, where a file says `camera`: off by some millimetres
    and degrees."""
    rng = np.random.default_rng([seed, 3])
    position = np.array(camera.position) + _MOVED * rng.uniform(-1.0, 1.0, 3)
    quaternion = product(
        np.array(camera.quaternion), quaternion_from_vector(_ROTATED * rng.uniform(-1.0, 1.0, 3))
    )
    x, y, z = position.tolist()
    w, a, b, c = (quaternion / np.linalg.norm(quaternion)).tolist()
    return replace(camera, position=(x, y, z), quaternion=(w, a, b, c))


def fixtures(camera: Camera, board: CharucoBoard) -> tuple[Pose, ...]:
    """Four places base_from_board that `camera` sees well, tilted to four sides: where an emulated bench
    fixes the board."""
    views = [_before(camera, board, 0.5, azimuth, 0.4, 0.0, np.zeros(2)) for azimuth in (0.0, 1.6, 3.1, 4.7)]
    return tuple(compose(camera.base_from_camera, there) for there in views)


def _before(
    camera: Camera, board: CharucoBoard, fill: float, azimuth: float, tilt: float, roll: float, aside: Floats
) -> Pose:
    """Camera_from_board with its middle `aside` (2,) of the picture's [px], filling this part of it."""
    width, height = board.columns * board.square, board.rows * board.square
    m = camera.intrinsics
    distance = max(m[0, 0] * width / camera.size[0], m[1, 1] * height / camera.size[1]) / fill
    lean = quaternion_from_vector(tilt * np.array([math.cos(azimuth), math.sin(azimuth), 0.0]))
    quaternion = product(lean, quaternion_from_vector(np.array([0.0, 0.0, roll])))
    middle = distance * np.array([aside[0] / m[0, 0], aside[1] / m[1, 1], 1.0])
    return middle - rotation(quaternion) @ np.array([0.5 * width, 0.5 * height, 0.0]), quaternion


@dataclass(frozen=True, kw_only=True, eq=False)
class Collected:
    """Pictures of a board, and what was passed over."""

    pictures: tuple[Picture, ...]
    passed: Mapping[str, int]
    """Why a frame was not taken -> how many."""

    @property
    def counted(self) -> str:
        """The frames passed over, in words."""
        return (
            ", ".join(f"{n} {why}" for why, n in sorted(self.passed.items(), key=lambda item: -item[1]))
            or "none"
        )


def collect(
    source: FrameSource,
    board: CharucoBoard,
    n: int,
    clock: Clock,
    *,
    apart: float = APART,
    patience: float = PATIENCE,
    progress: Callable[[str, int, int], None] | None = None,
) -> Collected:
    """Up to `n` pictures of a board at rest, each with a corner of the board `apart` (a part of the diagonal)
    from those taken before.

    It ends earlier where none could be taken for `patience` [s]. Raises `CalibrationError` where there is
    then none at all, `InputError` for a number of pictures that is none, and what the source raises.
    """
    check_number("number of pictures", n, COUNT, whole=True)
    finder, report = BoardFinder(board), progress or (lambda *_: None)
    pictures: list[Picture] = []
    quads: list[Floats] = []
    passed: Counter[str] = Counter()
    last: Floats | None = None
    source.read()  # it may be older than the board's place
    until = clock.now() + patience
    while len(pictures) < n and clock.now() < until:
        clock.sleep_until(clock.now() + _POLL)
        frame = source.read()
        if frame is None:
            continue
        view = finder.find(frame.image)
        quad = None if view.why else _quad(view, board)
        before, last = last, quad
        if quad is None:
            passed[view.why] += 1
            continue
        diagonal = math.hypot(*frame.image.shape)
        if before is None or _farthest(quad, before) > _STILL * diagonal:
            passed["not at rest"] += 1
        elif any(_farthest(quad, other) < apart * diagonal for other in quads):
            passed["like one that was taken"] += 1
        else:
            pictures.append(frame.image)
            quads.append(quad)
            until = clock.now() + patience
            report("views", len(pictures), n)
    made = Collected(pictures=tuple(pictures), passed=dict(passed))
    if not pictures:
        raise CalibrationError(
            f"no picture of the board could be taken in {patience:g} s; frames passed over: {made.counted}."
        )
    return made


def _quad(view: BoardView, board: CharucoBoard) -> Floats:
    """(4, 2) where the board's outer corners are in the picture, or beyond it [px]."""
    import cv2

    width, height = board.columns * board.square, board.rows * board.square
    to_pixels, _ = cv2.findHomography(view.points[:, :2], view.pixels)
    outer = (
        np.array([[0.0, 0.0, 1.0], [width, 0.0, 1.0], [width, height, 1.0], [0.0, height, 1.0]])
        @ np.asarray(to_pixels).T
    )
    return np.asarray(outer[:, :2] / outer[:, 2:], dtype=np.float64)


def _farthest(a: Floats, b: Floats) -> float:
    return float(np.linalg.norm(a - b, axis=1).max())


def lens_table(found: CameraCalibration, file: Camera, truth: Camera | None) -> Table:
    """Intrinsics found, their standard errors, those of the file; and the true ones of an emulated camera."""
    table = _table("intrinsics", truth)
    cameras = (found.camera(), file) if truth is None else (found.camera(), file, truth)
    numbers = [
        [c.matrix[0][0], c.matrix[1][1], c.matrix[0][2], c.matrix[1][2], *c.distortion] for c in cameras
    ]
    names = ("fx, px", "fy, px", "cx, px", "cy, px", "k1", "k2", "p1", "p2", "k3")
    for k, name in enumerate(names):
        digits = 2 if k < 4 else 5
        error = f"{found.stderr[k]:.{digits}f}" if found.stderr[k] else "not fitted"
        mine, *others = (f"{row[k]:.{digits}f}" for row in numbers)
        table.add_row(name, mine, error, *others)
    return table


def place_table(found: MarkerRegistration, file: Camera, truth: Camera | None) -> Table:
    """Return where the camera stands: position, and how it is turned from where the file has it, each with
    standard errors."""
    table = _table("base_from_camera", truth)
    poses = [(found.position, found.quaternion), file.base_from_camera] + (
        [] if truth is None else [truth.base_from_camera]
    )
    rows = [
        np.concatenate([1e3 * position, np.degrees(_rotation_between(file.quaternion, quaternion))])
        for position, quaternion in poses
    ]
    errors = np.concatenate([1e3 * found.position_stderr, np.degrees(found.rotation_stderr)])
    names = [f"{axis}, mm" for axis in "xyz"] + [f"turned about the camera's {axis}, deg" for axis in "xyz"]
    for k, name in enumerate(names):
        mine, *others = (f"{row[k]:.3f}" for row in rows)
        table.add_row(name, mine, f"{errors[k]:.3f}", *others)
    return table


def _rotation_between(start: tuple[float, float, float, float], end: Floats) -> Floats:
    """(3,) rotation vector from one orientation to the other, about the axes of the first [rad]."""
    w, *v = product(inverse((np.zeros(3), np.array(start)))[1], end).tolist()
    vector = math.copysign(1.0, w) * np.array(v)
    sine = float(np.linalg.norm(vector))
    return np.asarray(vector * (2.0 * math.atan2(sine, abs(w)) / sine if sine > 1e-12 else 2.0))


def _table(title: str, truth: Camera | None) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column(title)
    for name in ("found", "std. error", "file") if truth is None else ("found", "std. error", "file", "true"):
        table.add_column(name, justify="right")
    return table
