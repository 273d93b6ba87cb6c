"""Robot files: TOML to `Robot` and back, and the robots that ship with the package."""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import fields
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, TypedDict

import msgspec
import tomli_w

from fastrod.errors import RobotError, UnknownNameError, nearest, shown
from fastrod.model.logformat import LogFormat
from fastrod.model.robot import MODES, Lump, Robot, Segment, Tendon
from fastrod.model.taper import in_pieces
from fastrod.reading import parse, read_text

_LOG = tuple(f.name for f in fields(LogFormat))
_MODULI = ("youngs_modulus", "shear_modulus", "second_moment", "polar_moment")
_MATERIAL = ("youngs_modulus", "poisson", "density")
SENSOR = {
    "noise": "standard deviation of the measured tip, one number or one an axis [m]",
    "registration_sd": "prior of the camera's place against the base: shift [m] and rotation [rad]",
    "marker_offset_sd": "prior of the marker's place against the tip [m]",
    "latency_sd": "prior of a delay between commands and camera [s]",
}
"""Keys of `[sensor]`. A prior of 0, or none, stands for what is known."""


def robot_names() -> list[str]:
    """Names of the robots that ship with the package, for `load_robot`."""
    names = [entry.name for entry in files("fastrod").joinpath("robots").iterdir()]
    return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))


def load_robot(source: str | Path) -> Robot:
    """The robot of a shipped name, or of a path to a .toml (contracts: robot file).

    Raises `UnknownNameError` for a name that is not shipped, `RobotError` for a file that is not a robot.
    """
    if not isinstance(source, (str, Path)):
        raise UnknownNameError(
            f"robot is {source!r}; give the name of a shipped robot or the path of a .toml."
        )
    text = str(source)
    if text in robot_names():
        return _shipped(text)
    path = Path(source)
    try:
        unknown = path.suffix != ".toml" and not path.is_file()
    except (OSError, ValueError) as error:  # ValueError: a path that no file can have
        raise RobotError(
            f"robot file {shown(text)} cannot be read: {getattr(error, 'strerror', None) or error}."
        ) from error
    if unknown:
        raise UnknownNameError(
            f"no robot {shown(text)}; {nearest(text, robot_names())} A path must end in .toml."
        )
    content = read_text(path, f"robot file {shown(text)}", RobotError)
    return loads(content, text)


@cache
def _shipped(name: str) -> Robot:
    return loads(files("fastrod").joinpath("robots").joinpath(f"{name}.toml").read_text("utf-8"), name)


def loads(text: str, where: str = "robot file") -> Robot:
    """The robot of a TOML text; `where` names it in errors."""
    data = parse(text, where, RobotError, "robot")
    _check_keys(data, ("name", "segment", "base", "world", "effect", "log", "fit", "sensor"), where)
    segments = data.get("segment", [])
    if not isinstance(segments, list):
        raise RobotError(f"{where}: segment is one table; write [[segment]], in double brackets.")
    base = _section(data, "base", ("position", "quaternion"), where)
    world = _section(data, "world", ("gravity",), where)
    log = _section(data, "log", ("points", "point_offsets", *_LOG), where)
    points, offsets = log.pop("points", None), log.pop("point_offsets", None)
    optional = {
        "base_position": base.get("position"),
        "base_quaternion": base.get("quaternion"),
        "gravity": world.get("gravity"),
        "states_gravity": True if "gravity" in world else None,
        "log_points": points,
        "log_offsets": offsets,
        "log": log or None,
        "effects": data.get("effect"),
        "fit": data.get("fit"),
        "sensor": _section(data, "sensor", SENSOR, where) or None,
    }
    if "name" not in data:
        raise RobotError(f'{where} has no name; add name = "...".')
    try:
        return Robot(
            name=msgspec.convert(data["name"], str),
            segments=tuple(
                _segment(table, f"{where}: segment {k}")
                for k, table in enumerate(in_pieces(segments, where), 1)
            ),
            **{key: _convert(value, key, where) for key, value in optional.items() if value is not None},
        )
    except msgspec.ValidationError as error:
        raise RobotError(f"{where}: {_plain(error)}") from error
    except RobotError as error:
        raise error if str(error).startswith(where) else RobotError(f"{where}: {error}") from error


def dumps(robot: Robot) -> str:
    """The TOML text of `robot`; `loads` of it gives an equal robot."""
    data: dict[str, Any] = {"name": robot.name}
    data["segment"] = [_written(segment) for segment in robot.segments]
    data["base"] = {"position": list(robot.base_position), "quaternion": list(robot.base_quaternion)}
    if robot.states_gravity:
        data["world"] = {"gravity": list(robot.gravity)}
    if robot.effects:
        data["effect"] = [dict(effect) for effect in robot.effects]
    log: dict[str, Any] = {"points": list(robot.log_points)} if robot.log_points else {}
    if robot.log_offsets:
        log["point_offsets"] = [list(pair) for pair in robot.log_offsets]
    default = LogFormat()
    own = {key: getattr(robot.log, key) for key in _LOG if getattr(robot.log, key) != getattr(default, key)}
    if log | own:
        data["log"] = log | _listed(own)
    for section in ("fit", "sensor"):
        if content := getattr(robot, section):
            data[section] = _listed(content)
    return tomli_w.dumps(data)


def save_robot(robot: Robot, path: str | Path) -> None:
    """Write `robot` to a .toml, whole or not at all. Raises `RobotError` where it cannot be written."""
    target = Path(path)
    if target.suffix != ".toml":
        raise RobotError(f"{str(path)!r} does not end in .toml; a robot file does.")
    unfinished = target.with_suffix(".toml.part")
    try:
        text = dumps(robot).encode()
        unfinished.write_bytes(text)
        unfinished.replace(target)
    except ValueError as error:  # a name that is no text, or a path that no file can have
        raise RobotError(f"{str(path)!r} cannot be written: {error}.") from error
    except OSError as error:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)
        raise RobotError(f"{str(path)!r} cannot be written: {error.strerror}.") from error


def _segment(table: Any, where: str) -> Segment:
    known = [f.name for f in fields(Segment)]
    _check_keys(table, (*known, *_MODULI, *_MATERIAL), where)
    table = dict(table)
    given = [key for key in _MODULI if key in table]
    if given == ["youngs_modulus"] and "bending_stiffness" not in table and "body_radius" in table:
        table = _of_material(table, where)
    elif odd := [key for key in _MATERIAL[1:] if key in table]:
        raise RobotError(f"{where} has {odd[0]}, which goes with youngs_modulus and body_radius alone.")
    elif given:
        stiff = [key for key in ("bending_stiffness", "torsional_stiffness") if key in table]
        missing = [key for key in _MODULI if key not in table]
        if stiff or missing:
            raise RobotError(
                f"{where}: give bending_stiffness and torsional_stiffness, or all of {', '.join(_MODULI)}; "
                f"it has {', '.join(given + stiff)}."
            )
        e, g, i, j = (_convert(table.pop(key), key, where, float) for key in _MODULI)
        table |= {"bending_stiffness": [e * i, e * i], "torsional_stiffness": g * j}
    tendons = table.get("tendons", [])
    if not isinstance(tendons, list):
        raise RobotError(
            f"{where}: tendons must be a list of tables, [ {{offset = ..., angle = ...}}, ... ]."
        )
    _check_needed(table, ("length", "bending_stiffness", "torsional_stiffness"), where)
    if table.get("mode", MODES[0]) not in MODES:
        raise RobotError(f"{where}: mode is {table['mode']!r}; {nearest(str(table['mode']), MODES)}")
    for k, tendon in enumerate(tendons, 1):
        _check_keys(tendon, [f.name for f in fields(Tendon)], f"{where}, tendon {k}")
        _check_needed(tendon, ("offset", "angle"), f"{where}, tendon {k}")
    lumps = table.get("lumps", [])
    if not isinstance(lumps, list):
        raise RobotError(f"{where}: lumps must be a list of tables, [ {{at = ..., mass = ...}}, ... ].")
    for k, lump in enumerate(lumps, 1):
        _check_keys(lump, [f.name for f in fields(Lump)], f"{where}, lump {k}")
        _check_needed(lump, ("at", "mass"), f"{where}, lump {k}")
    try:
        return msgspec.convert(table, Segment)
    except msgspec.ValidationError as error:
        raise RobotError(f"{where}: {_plain(error)}") from error


def _of_material(table: dict[str, Any], where: str) -> dict[str, Any]:
    """The table of a round segment of one material with its stiffness and mass, as `Segment.from_material`;
    what it says itself stands."""
    _check_needed(table, ("length",), where)
    moduli = {key: _convert(table.pop(key), key, where, float) for key in _MATERIAL if key in table}
    given, length = table.pop("body_radius"), _convert(table["length"], "length", where, float)
    kind: Any = tuple[float, float] if isinstance(given, list) else float
    radius = _convert(given, "body_radius", where, kind)
    made = Segment.from_material(length=length, radius=radius, mode="passive", **moduli)
    found = ("bending_stiffness", "torsional_stiffness", "axial_stiffness", "shear_stiffness", "line_density")
    return {**{key: getattr(made, key) for key in found}, "body_radius": made.body_radius, **table}


def _written(segment: Segment) -> dict[str, Any]:
    data = _plain_table(segment)
    for name in ("axial_stiffness", "shear_stiffness"):
        if math.isinf(data[name]):
            del data[name]
    for name in ("tendons", "lumps"):
        data[name] = [_plain_table(each) for each in getattr(segment, name)]
        if not data[name]:
            del data[name]
    return data


def _listed(value: Any) -> Any:
    """Tables and tuples as TOML has them."""
    if isinstance(value, Mapping):
        return {key: _listed(each) for key, each in value.items()}
    return list(value) if isinstance(value, tuple) else value


def _plain_table(each: Segment | Tendon | Lump) -> dict[str, Any]:
    values = {f.name: getattr(each, f.name) for f in fields(each)}
    return {key: _listed(value) for key, value in values.items()}


def _section(data: Mapping[str, Any], name: str, known: Iterable[str], where: str) -> dict[str, Any]:
    table = data.get(name, {})
    _check_keys(table, known, f"{where}: [{name}]")
    return dict(table)


class _Effect(TypedDict):
    name: str


_TYPES: dict[str, Any] = {
    "base_position": tuple[float, float, float],
    "base_quaternion": tuple[float, float, float, float],
    "gravity": tuple[float, float, float],
    "states_gravity": bool,
    "log_points": tuple[float, ...],
    "log_offsets": tuple[tuple[float, float], ...],
    "log": LogFormat,
    "fit": dict[str, dict[str, float | bool]],
    "sensor": dict[str, float | tuple[float, ...]],
}


def _convert(value: Any, key: str, where: str, kind: Any = None) -> Any:
    try:
        if key == "effects":
            msgspec.convert(value, list[_Effect])
            return tuple(value)
        made = msgspec.convert(value, kind or _TYPES[key])
    except msgspec.ValidationError as error:
        sentence = _plain(error)
        named = "" if sentence.startswith("[") else "[log] " if key == "log" else f"{key}: "
        raise RobotError(f"{where}: {named}{sentence}") from error
    if isinstance(made, float) and not math.isfinite(made):
        raise RobotError(f"{where}: {key} is {made}; it must be finite.")
    return made


def _check_keys(table: Any, known: Iterable[str], where: str) -> None:
    if not isinstance(table, Mapping):
        raise RobotError(f"{where} is {shown(table)}; it must be a table.")
    names = list(known)
    for key in table:
        if key not in names:
            raise RobotError(f"{where} has an unknown key {key!r}; {nearest(key, names)}")


def _check_needed(table: Mapping[str, Any], needed: Iterable[str], where: str) -> None:
    if missing := [name for name in needed if name not in table]:
        raise RobotError(f"{where} lacks {', '.join(missing)}.")


def _plain(error: msgspec.ValidationError) -> str:
    """One of our own sentences as it is; one of msgspec's with the place in front."""
    sentence, _, place = str(error).replace("`", "'").partition(" - at '$")
    place = place.rstrip("'").replace("[...]", "").removeprefix(".")
    numbered = re.sub(r"\[(\d+)\]", lambda m: f" {int(m[1]) + 1}", place).strip()  # robot files count from 1
    end = "" if sentence.endswith((".", "?")) else "."
    return f"{numbered}: {sentence}{end}" if numbered else sentence + end
