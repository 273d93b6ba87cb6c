"""A camera that is fixed to the robot's base, the marker on its tip, and where frames come from."""

from __future__ import annotations

import math
import threading
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeAlias, TypeVar, final

import msgspec
import numpy as np
import tomli_w
from numpy.typing import ArrayLike, NDArray

from fastrod.checks import Bound, check_number
from fastrod.errors import InputError, UnknownNameError, nearest, shown
from fastrod.reading import parse, read_text
from fastrod.rotation import matrix_from_quaternion, product
from fastrod.types import Floats
from fastrod_device.can.clock import Clock, WallClock
from fastrod_device.errors import DeviceError

if TYPE_CHECKING:
    import cv2
    from _typeshed import DataclassInstance

Picture: TypeAlias = NDArray[np.uint8]
"""(h, w) grey levels."""
Pose: TypeAlias = tuple[Floats, Floats]
"""a_from_b: position (3,) of b in a [m], and quaternion (4,) w x y z."""
Described = TypeVar("Described", bound="DataclassInstance")
Row: TypeAlias = tuple[float, float, float]
"""Three numbers."""

_MOST = 1e6  # of any number of a camera or marker; squares and products of such still fit a float
_PIXELS = (16, 20_000)
_STILL = 100  # failed reads in a row after which a camera is lost


def rotation(quaternion: Floats) -> Floats:
    """(3, 3) matrix of one unit quaternion (4,)."""
    return np.asarray(matrix_from_quaternion(quaternion[None])[0])


def compose(a_from_b: Pose, b_from_c: Pose) -> Pose:
    """a_from_c."""
    return a_from_b[0] + rotation(a_from_b[1]) @ b_from_c[0], product(a_from_b[1], b_from_c[1])


def inverse(a_from_b: Pose) -> Pose:
    """b_from_a."""
    quaternion = a_from_b[1] * np.array([1.0, -1.0, -1.0, -1.0])
    return -rotation(quaternion) @ a_from_b[0], quaternion


def _numbers(value: ArrayLike, name: str, shape: tuple[int, ...]) -> Floats:
    """Finite numbers."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name} is {shown(value)}; it must be numbers of shape {shape}.") from error
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(
            f"{name} is {shown(np.asarray(value).tolist())}; it must be finite numbers of shape {shape}."
        )
    if (np.abs(array) > _MOST).any():
        raise InputError(
            f"{name} is {shown(array.tolist())}; its numbers must be between {-_MOST:g} and {_MOST:g}."
        )
    return array


def _tuple(value: ArrayLike, name: str, n: int) -> tuple[float, ...]:
    return tuple(_numbers(value, name, (n,)).tolist())


def _unit(value: ArrayLike, name: str) -> tuple[float, ...]:
    """A unit quaternion."""
    array = _numbers(value, name, (4,))
    norm = float(np.linalg.norm(array))
    if not math.isclose(norm, 1.0, abs_tol=1e-4):
        raise InputError(
            f"{name} is {array.tolist()!r}; it must have norm 1, not {norm:.6g} (order w x y z)."
        )
    return tuple((array if abs(norm - 1.0) < 1e-12 else array / norm).tolist())


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A camera: its lens and its pose. Raises `InputError` for what no camera can be.

    Axes as in OpenCV: x right, y down, z forward; the centre of the first pixel is (0, 0).
    """

    matrix: tuple[Row, Row, Row]
    """(3, 3) intrinsics [px]."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """(5,) k1, k2, p1, p2, k3 of OpenCV."""
    size: tuple[int, int]
    """Width and height [px]."""
    position: Row = (0.0, 0.0, 0.0)
    """(3,) of base_from_camera [m]."""
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """(4,) of base_from_camera, w x y z."""
    rate: float = 30.0
    """Frames per second [Hz]."""
    latency: float = 0.0
    """Time from exposure to the frame's arrival [s]: what a time stamp on arrival is late."""

    def __post_init__(self) -> None:
        put = object.__setattr__
        m = _numbers(self.matrix, "Camera.matrix", (3, 3))
        put(self, "matrix", tuple(tuple(row) for row in m.tolist()))
        put(self, "distortion", _tuple(self.distortion, "Camera.distortion", 5))
        put(self, "position", _tuple(self.position, "Camera.position", 3))
        put(self, "quaternion", _unit(self.quaternion, "Camera.quaternion"))
        if (
            not (m[0, 0] >= 1e-3 and m[1, 1] >= 1e-3)
            or m[0, 1] != 0.0
            or m[1, 0] != 0.0
            or m[2].tolist() != [0.0, 0.0, 1.0]
        ):
            raise InputError(
                f"Camera.matrix is {m.tolist()!r}; it must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], fx and "
                "fy positive, from 0.001."
            )
        size = tuple(self.size)
        low, high = _PIXELS
        if len(size) != 2 or any(
            isinstance(n, bool) or not isinstance(n, (int, np.integer)) or not low <= n <= high for n in size
        ):
            raise InputError(
                f"Camera.size is {shown(self.size)}; it must be width and height, whole "
                f"numbers from {low} to {high} [px]."
            )
        put(self, "size", (int(size[0]), int(size[1])))
        check_number("Camera.rate", self.rate, Bound(least=0.01, most=1e5, unit="Hz"))
        late = Bound(least=0.0, below=10.0, unit="s", hint="Was it given in ms?")
        check_number("Camera.latency", self.latency, late)

    @property
    def intrinsics(self) -> Floats:
        """(3, 3) `matrix` as an array [px]."""
        return np.array(self.matrix)

    @property
    def lens(self) -> Floats:
        """(5,) `distortion` as an array."""
        return np.array(self.distortion)

    @property
    def base_from_camera(self) -> Pose:
        """Return where it stands."""
        return np.array(self.position), np.array(self.quaternion)


def load_camera(path: str | Path) -> Camera:
    """The camera of a .toml file. Raises `InputError` for a file that is not one, `UnknownNameError` for a
    field that no camera has."""
    where = f"camera file {str(path)!r}"
    data = parse(read_text(Path(path), where, InputError), where, InputError, "camera")
    return from_table(Camera, data, where)


def from_table(kind: type[Described], table: object, where: str) -> Described:
    """A dataclass of a TOML file's table; `where`, file and table, begins every sentence.

    Raises `InputError` for what is no such table, `UnknownNameError` for a key or a name in it that is not
    known.
    """
    if not isinstance(table, dict):
        raise InputError(f"{where} is {shown(table)}; it must be a table.")
    known = {f.name: f.default is MISSING for f in fields(kind)}
    for key in table:
        if key not in known:
            raise UnknownNameError(f"{where} has an unknown key {key!r}; {nearest(key, known)}")
    if missing := [name for name, needed in known.items() if needed and name not in table]:
        raise InputError(f"{where} lacks {', '.join(missing)}.")
    try:
        return msgspec.convert(table, kind)
    except UnknownNameError as error:
        raise UnknownNameError(f"{where}: {error}") from error
    except msgspec.ValidationError as error:
        sentence, _, place = str(error).replace("`", "'").partition(" - at '$")
        key = place.rstrip("'").lstrip(".")
        raise InputError(
            f"{where}: {f'{key}: ' if key else ''}{sentence}{'' if sentence.endswith(('.', '?')) else '.'}"
        ) from error


def save_camera(camera: Camera, path: str | Path) -> None:
    """Write a .toml that `load_camera` reads, whole or not at all. Raises `InputError` where it cannot be
    written."""
    target = Path(path)
    if target.suffix != ".toml":
        raise InputError(f"{str(path)!r} does not end in .toml; a camera file does.")
    data = {f.name: getattr(camera, f.name) for f in fields(Camera)}
    unfinished = target.with_suffix(".toml.part")
    try:
        unfinished.write_text(tomli_w.dumps(data), encoding="utf-8")
        unfinished.replace(target)
    except OSError as error:
        unfinished.unlink(missing_ok=True)
        raise InputError(f"{str(path)!r} cannot be written: {error.strerror}.") from error


def dictionary_named(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of markers. Raises `UnknownNameError`."""
    import cv2

    known = [key for key in dir(cv2.aruco) if key.startswith("DICT_")]
    if name not in known:
        raise UnknownNameError(f"no marker dictionary {name!r}; {nearest(str(name), known)}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


@dataclass(frozen=True, kw_only=True)
class Marker:
    """A square marker on the tip. Its axes: x right and y up on the print, z out of it, origin in the middle.

    Raises `InputError`, and `UnknownNameError` for the dictionary.
    """

    size: float
    """Side of the black square [m]."""
    id: int = 0
    """Number in the dictionary."""
    dictionary: str = "DICT_4X4_50"
    """OpenCV's name of the dictionary: DICT_4X4_50, DICT_APRILTAG_16h5, ..."""
    position: Row = (0.0, 0.0, 0.0)
    """(3,) of tip_from_marker [m]."""
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """(4,) of tip_from_marker, w x y z."""

    def __post_init__(self) -> None:
        check_number(
            "Marker.size", self.size, Bound(least=1e-4, most=1.0, unit="m", hint="Was it given in mm?")
        )
        n = len(dictionary_named(self.dictionary).bytesList)
        check_number("Marker.id", self.id, Bound(least=0, most=n - 1), whole=True)
        object.__setattr__(self, "position", _tuple(self.position, "Marker.position", 3))
        object.__setattr__(self, "quaternion", _unit(self.quaternion, "Marker.quaternion"))

    @property
    def tip_from_marker(self) -> Pose:
        """Return where it sits on the tip."""
        return np.array(self.position), np.array(self.quaternion)


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraFrame:
    """One picture."""

    image: Picture
    """(h, w) grey levels."""
    t: float
    """The clock's time of exposure, as far as the source knows it [s]."""
    number: int
    """Counts up; a frozen camera repeats it, or the image."""


class FrameSource(Protocol):
    """Source of frames: a camera, an emulator, a file."""

    def read(self) -> CameraFrame | None:
        """The newest frame that was not read yet, None where there is none; never waits. Raises `DeviceError`
        where the source is lost."""

    def close(self) -> None:
        """Give the camera back. A second call does nothing."""


@final
class VideoCamera:
    """A camera that OpenCV can open, read in a thread of its own; frames are stamped on arrival, less the
    camera's latency."""

    def __init__(self, camera: Camera, device: int | str = 0, *, clock: Clock | None = None) -> None:
        """`device` is the system's number of the camera, or what else OpenCV opens: a path, an address.

        Raises `DeviceError` where it cannot be opened, gives no picture, or pictures of another size than the
        camera's.
        """
        import cv2

        self.camera, self._clock = camera, clock or WallClock()
        self._capture = cv2.VideoCapture(device)
        if not self._capture.isOpened():
            raise DeviceError(
                f"camera {device!r} cannot be opened; is it plugged in, and does nobody else use it?"
            )
        for key, value in (
            (cv2.CAP_PROP_FRAME_WIDTH, camera.size[0]),
            (cv2.CAP_PROP_FRAME_HEIGHT, camera.size[1]),
        ):
            self._capture.set(key, value)
        self._capture.set(cv2.CAP_PROP_FPS, camera.rate)
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self._lock, self._stop, self._lost = threading.Lock(), threading.Event(), ""
        self._number = 0
        self._newest = self._grab()
        if self._newest is None or self._newest.image.shape != camera.size[::-1]:
            got = (
                "no picture"
                if self._newest is None
                else "pictures of {1} x {0} px".format(*self._newest.image.shape)
            )
            self._capture.release()
            raise DeviceError(
                f"camera {device!r} gives {got}; it must give {camera.size[0]} x {camera.size[1]} px."
            )
        self._thread = threading.Thread(target=self._run, name="fastrod camera", daemon=True)
        self._thread.start()

    def read(self) -> CameraFrame | None:
        """The newest frame that was not read yet. Raises `DeviceError` where no more come."""
        with self._lock:
            newest, self._newest = self._newest, None
            if newest is None and self._lost:
                raise DeviceError(self._lost)
        return newest

    def close(self) -> None:
        """Stop the thread, and give the camera back."""
        self._stop.set()
        self._thread.join(timeout=2.0)
        if not self._thread.is_alive():  # to release under a thread that still reads would crash
            self._capture.release()

    def _grab(self) -> CameraFrame | None:
        import cv2

        good, image = self._capture.read()
        t = self._clock.now() - self.camera.latency
        if not good:
            return None
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        self._number += 1
        return CameraFrame(image=np.asarray(grey, dtype=np.uint8), t=t, number=self._number)

    def _run(self) -> None:
        failed = 0
        while not self._stop.is_set() and failed < _STILL:
            frame = self._grab()
            if frame is None:
                failed += 1
                self._stop.wait(0.005)
                continue
            failed = 0
            with self._lock:
                self._newest = frame
        if failed:
            with self._lock:
                self._lost = f"the camera has given no picture {failed} times in a row; is it unplugged?"
