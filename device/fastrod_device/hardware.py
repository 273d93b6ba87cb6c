"""`Hardware`: what stands on the bench, as a TOML file: drives, limits, camera, marker, and the robot that they move."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, fields
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec

from fastrod.errors import InputError, nearest
from fastrod.robot import Robot
from fastrod.robotfile import load_robot
from fastrod_device.camera import Camera, Marker
from fastrod_device.safety import Limits
from fastrod_device.units import DriveSpec

_SLOWEST, _QUICKEST = 50.0, 500.0  # Hz


@dataclass(frozen=True, kw_only=True)
class Hardware:
    """A robot, one drive for each of its wires in the robot file's order, and what watches it. Raises `InputError`."""

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
    """Of every wire when it is homed [N]."""
    homing_speed: float = 0.005
    """Of a wire [m/s]."""

    def __post_init__(self) -> None:
        if len(self.drives) != self.robot.n_tendons:
            raise InputError(f"there are {len(self.drives)} drives and robot {self.robot.name!r} has {self.robot.n_tendons} tendons.")
        for name, low, high, unit in (
            ("rate", _SLOWEST, _QUICKEST, "Hz"), ("pretension", 0.01, self.limits.tension, "N"), ("homing_speed", 1e-4, 0.1, "m/s"),
        ):  # fmt: skip
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
                raise InputError(f"{name} is {value!r}; it must be from {low:g} to {high:g} {unit}.")


def load_hardware(path: str | Path | None = None, robot: Robot | None = None) -> Hardware:
    """The hardware in a .toml, by default the one that ships: the paper's prototype. `robot` takes the place of the file's model, as
    `identify` has made it. Raises `InputError` with the key that is wrong, `RobotError` for its robot."""
    where = "prototype.toml" if path is None else str(path)
    try:
        text = (files("fastrod_device") / "prototype.toml" if path is None else Path(path)).read_text(encoding="utf-8")
        data = tomllib.loads(text)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"hardware file {where!r} cannot be read: {getattr(error, 'strerror', None) or error}.") from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"hardware file {where!r} is not TOML: {error}.") from error
    known = {"robot": str, "drive": list[DriveSpec], "limits": Limits, "camera": Camera, "marker": Marker}
    known |= dict.fromkeys(("rate", "pretension", "homing_speed"), float)
    made: dict[str, Any] = {}
    for key, value in data.items():
        if key not in known:
            raise InputError(f"hardware file {where!r} has an unknown key {key!r}; {nearest(key, known)}")
        made[key] = _made(key, value, known[key], where)
    if missing := [name for name in ("robot", "drive", "camera", "marker") if name not in made]:
        raise InputError(f"hardware file {where!r} lacks {missing[0]!r}.")
    own = made.pop("robot")
    model = load_robot(own if path is None or not (beside := Path(path).parent / own).is_file() else beside) if robot is None else robot
    return Hardware(robot=model, drives=tuple(made.pop("drive")), limits=made.pop("limits", Limits()), **made)


def _made(key: str, value: Any, kind: Any, where: str) -> Any:
    tables = value if isinstance(value, list) else [value]
    for table in tables if key != "robot" else []:
        if isinstance(table, dict) and (bad := [name for name in table if name not in {f.name for f in fields(_class(kind))}]):
            raise InputError(f"hardware file {where!r}: {key} has an unknown key {bad[0]!r}; {nearest(bad[0], _names(kind))}")
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise InputError(f"hardware file {where!r}: {key}: {error}") from error


def _class(kind: Any) -> Any:
    return kind.__args__[0] if hasattr(kind, "__args__") else kind


def _names(kind: Any) -> list[str]:
    return [f.name for f in fields(_class(kind))]
