"""`Hardware`: what stands on the bench, as a TOML file: drives, limits, camera, marker, and the robot that
they move."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

import numpy as np

from fastrod.checks import Bound, check_number
from fastrod.errors import InputError, UnknownNameError, nearest
from fastrod.loading import load_robot
from fastrod.model.robot import Robot
from fastrod.reading import parse, read_text
from fastrod_device.drives import BusSpec
from fastrod_device.safety import Limits
from fastrod_device.units import DriveSpec, Transmission
from fastrod_device.vision.camera import Camera, Marker, from_table, load_camera

SHIPPED = Path(str(files("fastrod_device") / "prototype.toml"))
"""The hardware file that ships: the paper's prototype."""
_NEEDED = ("robot", "camera", "marker", "drive")
_NUMBERS = ("rate", "pretension", "homing_speed")
_SLOWEST, _QUICKEST = 50.0, 500.0  # Hz


@dataclass(frozen=True, kw_only=True)
class Hardware:
    """A robot, one drive for each of its tendons in the robot file's order, and what watches it. Raises
    `InputError`."""

    robot: Robot
    """Its model."""
    drives: tuple[DriveSpec, ...]
    """(n_tendons,)."""
    limits: Limits
    camera: Camera
    marker: Marker
    rate: float = 100.0
    """Control cycles a second, each with one SYNC [Hz]."""
    pretension: float = 1.0
    """Pretension of every tendon when it is homed [N]."""
    homing_speed: float = 0.005
    """Homing speed of a tendon [m/s]."""
    bus: BusSpec = field(default_factory=BusSpec)
    """Kind of the drives, and bitrate."""

    def __post_init__(self) -> None:
        nodes = [spec.node for spec in self.drives]
        if any(s.mode == "tendon_tension" for s in self.robot.segments if s.tendons):
            raise InputError(
                f"robot {self.robot.name!r} is driven by forces, mode 'tendon_tension'; drives are commanded "
                "lengths: give a robot of mode 'tendon_length'."
            )
        if len(nodes) != self.robot.n_tendons:
            raise InputError(
                f"there are {len(nodes)} drives and robot {self.robot.name!r} has "
                f"{self.robot.n_tendons} tendons."
            )
        if len(set(nodes)) != len(nodes):
            raise InputError(f"the drives have node ids {nodes}; each must be there once.")
        for name, low, high, unit in (
            ("rate", _SLOWEST, _QUICKEST, "Hz"),
            ("pretension", 0.01, self.limits.tension, "N"),
            ("homing_speed", 1e-4, 0.1, "m/s"),
        ):
            check_number(name, getattr(self, name), Bound(least=low, most=high, unit=unit))
        steps = np.abs(Transmission(self.drives).tension(np.ones(len(nodes), dtype=np.int64)))
        if self.pretension < (1.0 - 1e-9) * steps.max():
            k, least = int(steps.argmax()), math.ceil(1e3 * steps.max()) / 1e3
            raise InputError(
                f"pretension is {self.pretension!r} N; the drive at node {nodes[k]} tells torque in steps "
                f"of {steps[k]:.3g} N of its tendon, "
                f"so it must be at least {least:g} N."
            )


def load_hardware(path: str | Path | None = None, robot: Robot | None = None) -> Hardware:
    """The hardware in a .toml, by default the one that ships, `SHIPPED`.

    `camera` is a table, or the name of a camera file beside the hardware file; `robot` a shipped one's name,
    or a file beside it. The argument `robot` takes the place of the file's model, as `identify` has made it.
    Raises, with file, table and key, `InputError` for what is wrong, `UnknownNameError` for what is not
    known, `RobotError` for the robot.
    """
    source = SHIPPED if path is None else Path(path)
    where = f"hardware file {(source.name if path is None else str(path))!r}"
    data = parse(read_text(source, where, InputError), where, InputError, "hardware file")
    known = (*_NEEDED, "limits", "bus", *_NUMBERS)
    for key in data:
        if key not in known:
            raise UnknownNameError(f"{where} has an unknown key {key!r}; {nearest(key, known)}")
    if missing := [name for name in _NEEDED if name not in data]:
        raise InputError(f"{where} lacks {', '.join(missing)}.")
    if not isinstance(data["drive"], list):
        raise InputError(
            f"{where}: drive is one table; write [[drive]], in double brackets, one for each tendon."
        )
    drives = tuple(
        from_table(DriveSpec, table, f"{where}: drive {k}") for k, table in enumerate(data["drive"], 1)
    )
    limits = from_table(Limits, data.get("limits", {}), f"{where}: [limits]")
    bus = from_table(BusSpec, data.get("bus", {}), f"{where}: [bus]")
    marker = from_table(Marker, data["marker"], f"{where}: [marker]")
    camera = _camera(data["camera"], source, where)
    model = _robot(data["robot"], source, where) if robot is None else robot
    numbers = {name: data[name] for name in _NUMBERS if name in data}
    try:
        return Hardware(
            robot=model, drives=drives, limits=limits, camera=camera, marker=marker, bus=bus, **numbers
        )
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _camera(given: object, hardware_file: Path, where: str) -> Camera:
    """Return the camera of a table, or of a file that is named in its place."""
    if not isinstance(given, str):
        return from_table(Camera, given, f"{where}: [camera]")
    if not (beside := hardware_file.parent / given).is_file():
        raise InputError(
            f"{where}: camera is {given!r}, and there is no file {str(beside)!r}; give a "
            "camera file, or a table [camera]."
        )
    return load_camera(beside)


def _robot(given: object, hardware_file: Path, where: str) -> Robot:
    """Return the robot of a file beside the hardware file, or one that ships."""
    if not isinstance(given, str):
        raise InputError(
            f"{where}: robot is {given!r}; give a shipped robot's name, or a robot file's in quotes."
        )
    beside = hardware_file.parent / given
    return load_robot(beside if beside.is_file() else given)
