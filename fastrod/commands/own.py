"""`fastrod new`, `import` and `check`: a robot of one's own, and its log."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fastrod.errors import InputError, LogError, nearest
from fastrod.logs.table import Table, read_table
from fastrod.model.logformat import UNITS
from fastrod.model.robotfile import loads

_UNIT = re.compile(r"[_\s\[(]+(ms|us|ns|sec|s|mm|cm|um|m|deg|rad|rev)[\])]?$", re.IGNORECASE)
_DRIVES = {"pull": True, "push-pull": False}


@dataclass(frozen=True)
class _Question:
    """One number or word that `fastrod new` asks for."""

    name: str
    text: str
    default: str
    read: Callable[[str], Any]


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.replace(",", " ").split()]


def _positive(text: str) -> list[float]:
    values = _numbers(text)
    if not values or not all(math.isfinite(v) and v > 0.0 for v in values):
        raise ValueError("give a positive number, or one for each segment")
    return values


def _count(text: str) -> list[int]:
    values = [int(word) for word in text.replace(",", " ").split()]
    if not values or not all(1 <= v <= 64 for v in values):
        raise ValueError("give a whole number from 1 on, or one for each segment")
    return values


def _one_of(known: Sequence[str]) -> Callable[[str], str]:
    def read(text: str) -> str:
        if text not in known:
            raise ValueError(nearest(text, known))
        return text

    return read


_ROBOT = (
    _Question("segments", "number of segments", "1", lambda text: _count(text)[0]),
    _Question("tendons", "tendons that end at each segment", "3", _count),
    _Question("length", "length of each segment [mm]", "100", _positive),
    _Question("offset", "distance of the tendons from the axis [mm]", "8", _positive),
    _Question("angle", "direction of each segment's first tendon, from x toward y [deg]", "0", _numbers),
    _Question(
        "drive", "do drives pull only, or push too (pull, push-pull)?", "push-pull", _one_of([*_DRIVES])
    ),
)
_FILE = (
    _Question("time-unit", "unit of time", "s", _one_of([*UNITS["time"]])),
    _Question("tip-unit", "unit of the measured tip", "m", _one_of([*UNITS["length"]])),
    _Question("motor-unit", "unit of the motors", "m", _one_of([*UNITS["length"], *UNITS["angle"]])),
    _Question("drum-radius", "radius of the drums [mm]", "10", _positive),
    _Question(
        "positive", "a positive motor value pulls, or pays out?", "pays-out", _one_of(["pulls", "pays-out"])
    ),
)
_COMMANDS = 10, 3  # that are compared with the rod, of one segment or two, and of more
_COLUMNS = ("time-column", "motor-columns", "tip-columns")


def add_commands(commands: argparse._SubParsersAction[Any]) -> None:
    """The arguments of these commands."""
    new = commands.add_parser("new", help="write a robot file of your own: asks, or takes options")
    new.add_argument("file", type=Path, metavar="FILE", help="robot file to write, .toml")
    new.add_argument("--log", type=Path, metavar="LOG", help="your log: its columns and units are guessed")
    for question in (*_ROBOT, *_FILE):
        new.add_argument(
            f"--{question.name}", metavar="V", help=f"{question.text} (default: {question.default})"
        )
    for name in _COLUMNS:
        new.add_argument(
            f"--{name}", metavar="NAMES", help="of the log, separated by commas (default: guessed)"
        )
    new.add_argument("--force", action="store_true", help="write over a file that is there")

    export = commands.add_parser("export", help="a robot as a chain of joints with tendons, for MuJoCo")
    export.add_argument("robot", metavar="ROBOT", help="a shipped robot's name or a path to a .toml")
    export.add_argument("--mjcf", type=Path, required=True, metavar="FILE", help="file to write, .xml")
    export.add_argument(
        "--pieces", type=int, metavar="N", help="of a segment (default: 16, 24 of three and more)"
    )

    brings = commands.add_parser("import", help="your own log file as a run log: CSV, Parquet, MATLAB")
    check = commands.add_parser("check", help="is this a log of this robot, and what can it reveal?")
    for command in (brings, check):
        command.add_argument("log", type=Path, metavar="LOG", help="a file that [log] of the robot describes")
        command.add_argument("--robot", required=True, metavar="R", help="a shipped robot's name or a .toml")
    brings.add_argument(
        "--out", type=Path, metavar="FILE", help="run log, .csv or .parquet (default: LOG_run.csv)"
    )
    check.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="write the robot with the columns and angles as matched, .toml",
    )


def new(arguments: argparse.Namespace) -> int:
    """Write a robot file; what is not given as an option is asked for on a terminal, else its default."""
    path: Path = arguments.file
    if path.suffix != ".toml":
        raise InputError(f"{str(path)!r} does not end in .toml; a robot file does.")
    if path.exists() and not arguments.force:
        raise InputError(f"{str(path)!r} is there already; --force writes over it.")
    ask = sys.stdin.isatty()
    given = {question.name: _answer(question, arguments, ask) for question in _ROBOT}
    segments = given["segments"]
    for name in ("tendons", "length", "offset", "angle"):
        values = given[name]
        if len(values) not in (1, segments):
            raise InputError(
                f"--{name} has {len(values)} numbers; give one, or one for each of {segments} segments."
            )
        given[name] = values * segments if len(values) == 1 else values
    text = _robot_text(path.stem, given)
    if arguments.log is not None:
        text += _log_text(read_table(arguments.log), arguments, given, ask)
    loads(text, str(path))  # what is written can be read
    path.write_text(text, encoding="utf-8")
    log = arguments.log or "LOG"
    print(f"wrote {path}; now: fastrod check {log} --robot {path}")
    return 0


def bring(arguments: argparse.Namespace) -> int:
    """Write a run log from a user's own file."""
    from fastrod.loading import load_robot
    from fastrod.logs.runlog import read_log, write_log

    robot = load_robot(arguments.robot)
    if not robot.log.columns:
        raise InputError(
            f"robot {robot.name!r} has no [log] columns, which say what stands where in "
            f"{arguments.log.name}; fastrod new --log writes them."
        )
    path: Path = arguments.out or Path(f"{arguments.log.stem}_run.csv")
    if path.suffix not in (".csv", ".parquet"):
        raise InputError(f"{str(path)!r} does not end in .csv or .parquet; a run log does.")
    # a clock is the robot's, and applies to its run logs too
    log = read_log(arguments.log, replace(robot, log=replace(robot.log, clock=0.0)))
    write_log(log, path)
    print(f"wrote {path}: {len(log)} rows, {log.dl.shape[1]} tendons")
    return 0


def export(arguments: argparse.Namespace) -> int:
    """Write a robot as MJCF, with its static error against the rod."""
    from importlib.util import find_spec

    from fastrod.hosts.mjcf import mjcf, static_error
    from fastrod.loading import load_robot

    robot, pieces = load_robot(arguments.robot), arguments.pieces
    if arguments.mjcf.suffix != ".xml":
        raise InputError(f"{str(arguments.mjcf)!r} does not end in .xml; a file of MuJoCo does.")
    if pieces is not None and not 4 <= pieces <= 200:
        raise InputError(f"--pieces is {pieces}; give a whole number from 4 to 200.")
    mjcf(robot, pieces=pieces)  # refuses before anything is computed
    said = "static error not measured: MuJoCo is not installed"
    if find_spec("mujoco") is not None:
        count = _COMMANDS[robot.n_segments > 2]
        error = static_error(robot, pieces=pieces, count=count)
        said = (
            f"at rest the tip is within {100.0 * error:.2g} % of the length of where fastrod has it, the "
            f"worst of {count} random commands"
        )
    arguments.mjcf.write_text(mjcf(robot, pieces=pieces, comment=f"robot {robot.name} by fastrod; {said}"))
    print(f"wrote {arguments.mjcf}; {said}")
    return 0


def check(arguments: argparse.Namespace) -> int:
    """Print what a first look says; 2 where nothing can be identified."""
    from rich.console import Console

    from fastrod.identification.log.check import LogCheck
    from fastrod.identification.log.check import check as look
    from fastrod.loading import load_robot
    from fastrod.logs.runlog import read_log
    from fastrod.model.robotfile import save_robot

    robot = load_robot(arguments.robot)
    found: LogCheck = look(read_log(arguments.log, robot), robot)
    console = Console()

    def line(name: str, text: str) -> None:
        console.print(f"{name:<9}{text}", soft_wrap=True, highlight=False, markup=False)

    for name, text in found.facts.items():
        line(name, text)
    for label, lines in (("shows", found.shows), ("lacks", found.lacks), ("asks", found.questions)):
        for text in lines:
            line(label, text)
    if found.columns is not None:
        console.print(_mapping(found), highlight=False)
    if arguments.out is not None:
        save_robot(found.robot, arguments.out)
        line("wrote", str(arguments.out))
    if found.refusal and arguments.out is None:
        raise LogError(found.refusal)
    if not found.refusal and found.columns is None:
        line("ok", "units, signs, order, clock and time fit the robot")
    return 0


def _mapping(found: Any) -> Any:
    """Which column moves which tendon, and where it pulls the tip, as a table."""
    from rich import box
    from rich.table import Table as Grid

    robot, columns = found.robot, found.columns
    grid = Grid(box=box.SIMPLE_HEAD, title="columns as they fit best", title_justify="left", pad_edge=False)
    for name in ("segment", "tendon", "column", "positive", "angle deg", "tip mm per mm"):
        grid.add_column(name, justify="left" if name in ("column", "positive") else "right")
    for k, tendon in enumerate(robot.tendons):
        first = tendon.angle[0] if isinstance(tendon.angle, tuple) else tendon.angle
        sign = robot.log.sign[k] if isinstance(robot.log.sign, tuple) else robot.log.sign
        grid.add_row(
            str(int(robot.tendon_segment[k]) + 1),
            str(k + 1),
            robot.log.sources[f"dl_{k + 1}"],
            "pulls" if sign < 0 else "pays out",
            f"{math.degrees(first):.0f}",
            f"{np.linalg.norm(columns.answer[columns.order[k]]):.2g}",
        )
    return grid


def _answer(question: _Question, arguments: argparse.Namespace, ask: bool, guess: str = "") -> Any:
    """The value of a question: given as an option, typed, or its default."""
    given = getattr(arguments, question.name.replace("-", "_"))
    default = guess or question.default
    while True:
        typed = given
        if given is None:
            typed = _typed(f"{question.text} [{default}]: ") if ask else ""
        try:
            return question.read(str(typed or default))
        except ValueError as error:
            if given is not None or not ask:
                raise InputError(f"--{question.name} is {typed or default!r}; {error}.") from None
            print(error, file=sys.stderr)


def _typed(prompt: str) -> str:
    """A line from the terminal; empty at its end."""
    try:
        return input(prompt).strip()
    except EOFError:
        return ""


def _robot_text(name: str, given: dict[str, Any]) -> str:
    """The segments of a robot file, with units."""
    lines = [
        f'name = "{name}"',
        "",
        "# Lengths in m, angles in rad, forces in N; z of the base points along the straight robot.",
    ]
    pulls = _DRIVES[given["drive"]]
    for k in range(given["segments"]):
        offset, count = 1e-3 * given["offset"][k], given["tendons"][k]
        lines += [
            "",
            "[[segment]]",
            f"length = {1e-3 * given['length'][k]:.6g}",
            "bending_stiffness = [0.01, 0.01]  # EI about d1, d2, N m^2: seen where loads bend the robot",
            "torsional_stiffness = 0.0077      # GJ, N m^2",
            f"body_radius = {1.2 * max(given['offset'][k:]) * 1e-3:.6g}",
        ]
        if pulls:
            lines.append("axial_stiffness = 1e4             # EA, N: tendons that pull shorten the body")
        extra = ", compliance = 4e-5, pretension = 2.0, unilateral = true" if pulls else ""
        lines.append("tendons = [  # angle: from x toward y; compliance in m/N")
        for i in range(count):
            angle = math.remainder(math.radians(given["angle"][k]) + 2.0 * math.pi * i / count, 2.0 * math.pi)
            lines.append(f"    {{ offset = {offset:.6g}, angle = {angle:.6g}{extra} }},")
        lines.append("]")
    lines += ["", "[fit]  # what is not known exactly: standard deviations of priors"]
    lines += ['"tendon.*.angle" = { sd = 0.1 }', '"tendon.*.gain" = { sd = 0.1 }'] if pulls else []
    if pulls:
        lines += [
            '"tendon.*.compliance" = { sd = 4e-5, shared = true }',
            '"tendon.*.pretension" = { sd = 4.0 }',
        ]
        lines += ['"segment.*.axial_stiffness" = { sd = 1e4 }']
    lines += [
        "",
        "[sensor]  # of the camera: shift in m and rotation in rad",
        "registration_sd = [0.01, 0.1]",
        "",
    ]
    return "\n".join(lines)


def _log_text(table: Table, arguments: argparse.Namespace, given: dict[str, Any], ask: bool) -> str:
    """`[log]` for the columns of a user's file, guessed where they are not given."""
    count = sum(given["tendons"])
    guess = dict(zip(_COLUMNS, guess_columns([*table], count), strict=True))
    names: dict[str, list[str]] = {}
    for key, wanted in zip(_COLUMNS, (1, count, 3), strict=True):
        question = _Question(key, f"{key.replace('-', ' ')} of the log", ",".join(guess[key]), str)
        found = [word.strip() for word in _answer(question, arguments, ask).split(",") if word.strip()]
        if len(found) != wanted:
            how = " (guessed)" if found == guess[key] else ""
            raise InputError(f"--{key} has {len(found)} names{how}; it needs {wanted} of {', '.join(table)}.")
        if missing := [word for word in found if word not in table]:
            raise InputError(f"the log has no column {missing[0]!r}; {nearest(missing[0], table)}")
        names[key] = found
    units = {}
    for question, key in zip(_FILE[:3], ("time-column", "tip-columns", "motor-columns"), strict=True):
        said = _UNIT.search(names[key][0])
        unit = (
            said[1].lower().replace("sec", "s") if said else _by_size(question.name, table, names[key], given)
        )
        units[question.name] = _answer(question, arguments, ask, unit)
    angular = units["motor-unit"] in UNITS["angle"]
    quoted = {key: ", ".join(f'"{name}"' for name in found) for key, found in names.items()}
    lines = [
        "",
        "[log]  # your own log files",
        f"columns.t = {quoted['time-column']}",
        f"columns.dl = [{quoted['motor-columns']}]  # in the order of the tendons above",
        f"columns.tip = [{quoted['tip-columns']}]",
        f'units.time = "{units["time-unit"]}"',
        f'units.tip = "{units["tip-unit"]}"',
        f'units.{"angle" if angular else "dl"} = "{units["motor-unit"]}"',
    ]
    if angular:
        radii = _answer(_FILE[3], arguments, ask)
        lines.append(f"drum_radius = {1e-3 * radii[0]:.6g}  # m")
    pulls = _answer(_FILE[4], arguments, ask) == "pulls"
    lines.append(f"sign = {-1 if pulls else 1}  # -1: a positive value pulls")
    return "\n".join([*lines, ""])


def guess_columns(names: Sequence[str], n_tendons: int) -> tuple[list[str], list[str], list[str]]:
    """Time, motors and tip among the columns of a log, by their names; empty where none is like it.

    >>> guess_columns(["stamp_ms", "m2_deg", "m1_deg", "cam_X", "cam_Y", "cam_Z"], 2)
    (['stamp_ms'], ['m1_deg', 'm2_deg'], ['cam_X', 'cam_Y', 'cam_Z'])
    """
    timed = [name for name in names if re.search(r"time|stamp|clock|^t$|^t[_\s\[(]|^sec", name.lower())]
    triples: dict[str, dict[str, str]] = {}
    for name in names:
        if match := re.fullmatch(r"(.*?)([xyz])((?:[_\s\[(]+(?:m|mm|cm|um)[\])]?)?)", name, re.IGNORECASE):
            triples.setdefault(f"{match[1]}|{match[3]}".lower(), {})[match[2].lower()] = name
    tips = [three for three in triples.values() if len(three) == 3]
    tips.sort(key=lambda three: not re.search(r"tip|marker|end|ee", three["x"].lower()))
    tip = [tips[0][axis] for axis in "xyz"] if tips else []
    alike: dict[str, list[str]] = {}
    for name in names:
        if name not in (*timed[:1], *tip):
            alike.setdefault(
                re.sub(r"\d+|(?<![A-Za-z])[A-Z](?![A-Za-z])|(?<=[a-z])[A-Z](?=_|$)", "#", name), []
            ).append(name)
    motors = [group for template, group in alike.items() if "#" in template and len(group) == n_tendons]
    motors.sort(
        key=lambda group: not re.search(r"motor|servo|drive|tendon|dl|cmd|cable|wire", group[0].lower())
    )
    first = (
        sorted(motors[0], key=lambda name: [int(d) for d in re.findall(r"\d+", name)] or [0])
        if motors
        else []
    )
    return timed[:1], first, tip


def _by_size(question: str, table: Table, names: Sequence[str], given: dict[str, Any]) -> str:
    """A unit whose name says none, by the size of its values beside the robot's length."""
    from fastrod.logs.table import numbers

    values = np.stack([numbers(table, name, "the log") for name in names])
    if question == "time-unit":
        step = float(np.nanmedian(np.diff(values[0]))) if values.shape[1] > 1 else 0.0
        return "ms" if 1.0 <= step < 1e4 else "ns" if step >= 1e5 else "s"
    length = 1e-3 * sum(given["length"])
    return "mm" if float(np.nanmax(np.abs(values))) > 4.0 * length else "m"
