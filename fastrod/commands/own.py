"""`fastrod new`, `import`, `check` and `export`: a robot of one's own, and its log."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fastrod.checks import Bound, check_number
from fastrod.errors import InputError, LogError, nearest
from fastrod.logs.table import DATE, Table, read_table
from fastrod.model.logformat import UNITS
from fastrod.model.robotfile import loads

_UNIT = re.compile(r"[_\s\[(]+(ms|us|ns|sec|s|mm|cm|um|m|deg|rad|rev|n|mn|kgf|gf)[\])]?$", re.IGNORECASE)
_BASES = {"stands": [1, 0, 0, 0], "hangs": [0, 1, 0, 0]}
_DRIVES = ("pull", "push-pull", "force")


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


def _ends(text: str) -> list[float]:
    values = _positive(text)
    if len(values) > 2:
        raise ValueError("give one radius, or two: at base and tip")
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
        "drive",
        "drives move tendons that pull, push too, or give forces (pull, push-pull, force)?",
        "push-pull",
        _one_of(_DRIVES),
    ),
)
_MATERIAL = (
    _Question("base", "how is it mounted (stands, hangs)?", "stands", _one_of([*_BASES])),
    _Question("radius", "radius of the body [mm], or at base and tip; tendons keep their share", "12", _ends),
    _Question("youngs-modulus", "Young's modulus [kPa]", "100", _positive),
    _Question("density", "density [kg/m^3]", "1070", _positive),
)
_FILE = (
    _Question("time-unit", "unit of time", "s", _one_of([*UNITS["time"]])),
    _Question("tip-unit", "unit of the measured tip", "m", _one_of([*UNITS["length"]])),
    _Question(
        "motor-unit", "unit of the motors", "m", _one_of([*UNITS["length"], *UNITS["angle"], *UNITS["force"]])
    ),
    _Question("drum-radius", "radius of the drums [mm]", "10", _positive),
    _Question(
        "positive", "a positive motor value pulls, or pays out?", "pays-out", _one_of(["pulls", "pays-out"])
    ),
)
_COMMANDS = 10, 3  # that are compared with the rod, of one segment or two, and of more
_COLUMNS = ("time-column", "motor-columns", "tip-columns")


QUESTIONS = {
    **{one.name: f"{one.text} (default: {one.default})" for one in (*_ROBOT, *_MATERIAL, *_FILE)},
    **dict.fromkeys(_COLUMNS, "of the log, separated by commas (default: guessed)"),
}
"""Options of `fastrod new` beside those of its function."""


def new(
    file: Path,
    *,
    log: Path | None = None,
    markers: str | None = None,
    marker_offset: str = "0",
    force: bool = False,
    **answers: str | None,
) -> int:
    """Write a robot file of your own: asks, or takes options.

    FILE: robot file to write, .toml
    --log LOG: your log: its columns and units are guessed
    --markers V: arclengths of markers on the body, in place of the tip [mm]; columns as --tip-columns
    --marker-offset V: of the markers from the axis, along x [mm]
    --force: write over a file that is there
    """
    path = file
    if path.suffix != ".toml":
        raise InputError(f"{str(path)!r} does not end in .toml; a robot file does.")
    if path.exists() and not force:
        raise InputError(f"{str(path)!r} is there already; --force writes over it.")
    ask = sys.stdin.isatty()
    given = {question.name: _answer(question, answers, ask) for question in _ROBOT}
    segments = given["segments"]
    for name in ("tendons", "length", "offset", "angle"):
        values = given[name]
        if len(values) not in (1, segments):
            raise InputError(
                f"--{name} has {len(values)} numbers; give one, or one for each of {segments} segments."
            )
        given[name] = values * segments if len(values) == 1 else values
    given["markers"] = _positive(markers) if markers else []
    beside = _numbers(marker_offset)
    given["beside"] = beside * len(given["markers"]) if len(beside) == 1 else beside
    said = [name for name in QUESTIONS if answers.get(name.replace("-", "_")) is not None]
    if given["drive"] == "force" or any(question.name in said for question in _MATERIAL):
        given |= {question.name: _answer(question, answers, ask) for question in _MATERIAL}
    if given["drive"] != "force" and len(set(given.get("radius", [0.0]))) > 1:
        raise InputError(
            "--radius has a base's and a tip's; a body tapers only with --drive force: give one radius."
        )
    of_log = [name for name in said if name in _COLUMNS or name in [question.name for question in _FILE]]
    if log is None and (of_log or markers):
        raise InputError(f"--{(*of_log, 'markers')[0]} says how a log is read; give --log FILE, too.")
    text = _robot_text(path.stem, given)
    if log is not None:
        text += _log_text(read_table(log), answers, given, ask)
    loads(text, str(path))  # what is written can be read
    path.write_text(text, encoding="utf-8")
    print(f"wrote {path}; now: fastrod check {log or 'LOG'} --robot {path}")
    return 0


def bring(
    log: Path, *, robot: str, out: Path | None = None, lerobot: Path | None = None, fps: int = 30
) -> int:
    """Your own log file as a run log: CSV, Parquet, MATLAB, ROS 2 bag.

    LOG: a file that [log] of the robot describes
    --robot R: a shipped robot's name or a .toml
    --out FILE: run log, .csv or .parquet (default: LOG_run.csv)
    --lerobot DIR: write a data set of LeRobot (v2.1), an episode a run
    --fps N: with it, its rate
    """
    from fastrod.loading import load_robot
    from fastrod.logs.reader import read_log
    from fastrod.logs.runlog import write_log

    its = load_robot(robot)
    if lerobot is not None:
        from fastrod.logs.lerobot import write_lerobot

        read, task = read_log(log, its), f"move {its.name}"
        made = write_lerobot(read, lerobot, robot=its.name, fps=fps, task=task)
        print(f"wrote {lerobot}: {made[0]} episodes, {made[1]} frames")
        return 0
    if not its.log.columns:
        raise InputError(
            f"robot {its.name!r} has no [log] columns, which say what stands where in "
            f"{log.name}; fastrod new --log writes them."
        )
    path = out or Path(f"{log.stem}_run.csv")
    if path.suffix not in (".csv", ".parquet"):
        raise InputError(f"{str(path)!r} does not end in .csv or .parquet; a run log does.")
    # a clock is the robot's, and applies to its run logs too
    read = read_log(log, replace(its, log=replace(its.log, clock=0.0)))
    write_log(read, path)
    print(f"wrote {path}: {len(read)} rows, {its.n_tendons} tendons")
    return 0


def export(robot: str, *, mjcf: Path, pieces: int | None = None) -> int:
    """A robot as a chain of joints with tendons, for MuJoCo.

    ROBOT: a shipped robot's name or a path to a .toml
    --mjcf FILE: file to write, .xml; it says the static error against the rod
    --pieces N: of a segment (default: 16, 24 of three and more)
    """
    from importlib.util import find_spec

    from fastrod.hosts.mjcf import mjcf as written
    from fastrod.hosts.mjcf import static_error
    from fastrod.loading import load_robot

    its = load_robot(robot)
    if mjcf.suffix != ".xml":
        raise InputError(f"{str(mjcf)!r} does not end in .xml; a file of MuJoCo does.")
    check_number("--pieces", 4 if pieces is None else pieces, Bound(least=4, most=200), whole=True)
    written(its, pieces=pieces)  # refuses before anything is computed
    said = "static error not measured: MuJoCo is not installed"
    if find_spec("mujoco") is not None:
        count = _COMMANDS[its.n_segments > 2]
        error = static_error(its, pieces=pieces, count=count)
        said = (
            f"at rest the tip is within {100.0 * error:.2g} % of the length of where fastrod has it, the "
            f"worst of {count} random commands"
        )
    mjcf.write_text(written(its, pieces=pieces, comment=f"robot {its.name} by fastrod; {said}"))
    print(f"wrote {mjcf}; {said}")
    return 0


def check(log: Path, *, robot: str, out: Path | None = None) -> int:
    """Is this a log of this robot, and what can it reveal?

    LOG: a file that [log] of the robot describes
    --robot R: a shipped robot's name or a .toml
    --out FILE: write the robot with the columns and angles as matched, .toml
    """
    from rich.console import Console

    from fastrod.identification.log.check import check as look
    from fastrod.loading import load_robot
    from fastrod.logs.reader import read_log
    from fastrod.model.robotfile import save_robot

    its = load_robot(robot)
    found = look(read_log(log, its), its)
    console = Console()

    def line(name: str, text: str) -> None:
        console.print(f"{name:<9}{text}", soft_wrap=True, highlight=False, markup=False)

    for name, text in found.facts.items():
        line(name, text)
    for label, texts in (("shows", found.shows), ("lacks", found.lacks), ("asks", found.questions)):
        for text in texts:
            line(label, text)
    if found.columns is not None:
        console.print(_mapping(found), highlight=False)
    if out is not None:
        save_robot(found.robot, out)
        line("wrote", str(out))
    if found.refusal and out is None:
        raise LogError(found.refusal)
    if not found.refusal and not found.questions and found.columns is None:
        line("ok", "units, signs, order, clock and time fit the robot")
    return 0


def _mapping(found: Any) -> Any:
    """Which column moves which tendon, and where it pulls the tip, as a table."""
    from rich import box
    from rich.table import Table as Grid

    robot, columns, forces = found.robot, found.columns, found.robot.by_tension
    grid = Grid(box=box.SIMPLE_HEAD, title="columns as they fit best", title_justify="left", pad_edge=False)
    for name in (
        "segment",
        "tendon",
        "column",
        "positive",
        "angle deg",
        f"tip mm per {'N' if forces else 'mm'}",
    ):
        grid.add_column(name, justify="left" if name in ("column", "positive") else "right")
    for k, tendon in enumerate(robot.tendons):
        first = tendon.angle[0] if isinstance(tendon.angle, tuple) else tendon.angle
        sign = robot.log.sign[k] if isinstance(robot.log.sign, tuple) else robot.log.sign
        grid.add_row(
            str(int(robot.tendon_segment[k]) + 1),
            str(k + 1),
            robot.log.sources[f"{'tension' if forces else 'dl'}_{k + 1}"],
            "pulls" if sign < 0 or forces else "pays out",
            f"{math.degrees(first):.0f}",
            f"{(1e3 if forces else 1.0) * np.linalg.norm(columns.answer[columns.order[k]]):.2g}",
        )
    return grid


def _answer(question: _Question, answers: Mapping[str, str | None], ask: bool, guess: str = "") -> Any:
    """The value of a question: given as an option, typed, or its default."""
    given = answers.get(question.name.replace("-", "_"))
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
    pulls, forces = given["drive"] == "pull", given["drive"] == "force"
    ends = np.cumsum([0.0, *given["length"]]) / sum(given["length"])
    for k in range(given["segments"]):
        offset, count = f"{1e-3 * given['offset'][k]:.6g}", given["tendons"][k]
        lines += ["", "[[segment]]", f"length = {1e-3 * given['length'][k]:.6g}"]
        if weighs := "radius" in given:
            base, tip = given["radius"][0], given["radius"][-1]
            radius = [round(1e-3 * (base + (tip - base) * float(s)), 7) for s in ends]
            even, modulus, density = base == tip, 1e3 * given["youngs-modulus"][0], given["density"][0]
            area, bending = math.pi * radius[0] ** 2, modulus * 0.25 * math.pi * radius[0] ** 4
            if not even:
                offset = str([round(given["offset"][k] * r / base, 7) for r in radius[: k + 2]])
        if forces:
            lines += [
                f"body_radius = {radius[k] if even else radius[k : k + 2]}",
                f"youngs_modulus = {modulus:.6g}  # Pa",
                "poisson = 0.5",
                f"density = {density:.6g}",
                'mode = "tendon_tension"  # a log gives the force on each tendon',
            ]
        elif weighs:
            lines += [
                f"bending_stiffness = [{bending:.6g}, {bending:.6g}]  # EI, N m^2, of {modulus / 1e3:g} kPa",
                f"torsional_stiffness = {2.0 / 3.0 * bending:.6g}  # GJ, N m^2, at Poisson's ratio 0.5",
                f"body_radius = {radius[0]:.6g}",
                f"line_density = {density * area:.6g}  # kg/m, of {density:g} kg/m^3",
            ]
        else:
            lines += [
                "bending_stiffness = [0.01, 0.01]  # EI about d1, d2, N m^2: seen where loads bend the robot",
                "torsional_stiffness = 0.0077      # GJ, N m^2",
                f"body_radius = {1.2 * max(given['offset'][k:]) * 1e-3:.6g}",
            ]
        if pulls:
            lines.append("axial_stiffness = 1e4             # EA, N: tendons that pull shorten the body")
        extra = ", compliance = 4e-5, pretension = 2.0" if pulls else ""
        extra += ", unilateral = true" if pulls or forces else ""
        lines.append("tendons = [  # angle: from x toward y; compliance in m/N")
        for i in range(count):
            angle = math.remainder(math.radians(given["angle"][k]) + 2.0 * math.pi * i / count, 2.0 * math.pi)
            lines.append(f"    {{ offset = {offset}, angle = {angle:.6g}{extra} }},")
        lines.append("]")
    lines += ["", "[fit]  # what is not known exactly: standard deviations of priors"]
    lines += ['"tendon.*.angle" = { sd = 0.1 }', '"tendon.*.gain" = { sd = 0.1 }'] if pulls else []
    if pulls:
        lines += [
            '"tendon.*.compliance" = { sd = 4e-5, shared = true }',
            '"tendon.*.pretension" = { sd = 4.0 }',
        ]
        lines += ['"segment.*.axial_stiffness" = { sd = 1e4 }']
    if weighs:
        lines[3:3] = ["", "[base]", f"quaternion = {_BASES[given['base']]}  # world_from_base, w x y z"]
    if forces:
        lines += ['"material.youngs_modulus" = { sd = 0.5 }', '"material.density" = { sd = 0.1 }']
        lines += ['"material.taper" = { sd = 0.1 }']
    lines += [
        "",
        "[sensor]  # of the camera: shift in m and rotation in rad",
        "registration_sd = [0.01, 0.1]",
        "",
    ]
    return "\n".join(lines)


def _log_text(table: Table, answers: Mapping[str, str | None], given: dict[str, Any], ask: bool) -> str:
    """`[log]` for the columns of a user's file, guessed where they are not given."""
    count = sum(given["tendons"])
    n_markers = len(given["markers"])
    guess = dict(zip(_COLUMNS, guess_columns([*table], count, n_markers), strict=True))
    names: dict[str, list[str]] = {}
    for key, wanted in zip(_COLUMNS, (1, count, 3 * max(n_markers, 1)), strict=True):
        question = _Question(key, f"{key.replace('-', ' ')} of the log", ",".join(guess[key]), str)
        found = [word.strip() for word in _answer(question, answers, ask).split(",") if word.strip()]
        if len(found) != wanted:
            how = " (guessed)" if found == guess[key] else ""
            raise InputError(f"--{key} has {len(found)} names{how}; it needs {wanted} of {', '.join(table)}.")
        if missing := [word for word in found if word not in table]:
            raise InputError(f"the log has no column {missing[0]!r}; {nearest(missing[0], table)}")
        names[key] = found
    units = {}
    for question, key in zip(_FILE[:3], ("time-column", "tip-columns", "motor-columns"), strict=True):
        said = _UNIT.search(names[key][0])
        unit = _spelt(said[1]) if said else ""
        if DATE.match(str(next(iter(table[names[key][0]]), ""))):
            unit = "iso"
        unit = unit or _by_size(question.name, table, names[key], given)
        units[question.name] = _answer(question, answers, ask, unit)
    angular, forces = units["motor-unit"] in UNITS["angle"], given["drive"] == "force"
    if forces != (units["motor-unit"] in UNITS["force"]):
        raise InputError(
            f"--motor-unit is {units['motor-unit']!r}; with --drive {given['drive']} it is one of "
            f"{', '.join(UNITS['force'] if forces else [*UNITS['length'], *UNITS['angle']])}."
        )
    quoted = {key: ", ".join(f'"{name}"' for name in found) for key, found in names.items()}
    kind = "tension" if forces else "dl"
    places = [f"columns.tip = [{quoted['tip-columns']}]", f'units.tip = "{units["tip-unit"]}"']
    if n_markers:
        listed, seen = names["tip-columns"], [round(1e-3 * s, 7) for s in given["markers"]]
        places = [f"columns.p{k + 1} = {listed[3 * k : 3 * k + 3]}" for k in range(n_markers)]
        places += [f'units.points = "{units["tip-unit"]}"', f"points = {seen}  # arclengths, m"]
        places += [
            f"point_offsets = {[[round(1e-3 * x, 7), 0.0] for x in given['beside']]}  # along d1, d2, m"
        ]
    lines = [
        "",
        "[log]  # your own log files",
        f"columns.t = {quoted['time-column']}",
        f"columns.{kind} = [{quoted['motor-columns']}]  # in the order of the tendons above",
        f'units.time = "{units["time-unit"]}"',
        f'units.{"angle" if angular else "force" if forces else "dl"} = "{units["motor-unit"]}"',
        *places,
    ]
    if forces:
        return "\n".join([*lines, ""])
    if angular:
        radii = _answer(_FILE[3], answers, ask)
        lines.append(f"drum_radius = {1e-3 * radii[0]:.6g}  # m")
    pulls = _answer(_FILE[4], answers, ask) == "pulls"
    lines.append(f"sign = {-1 if pulls else 1}  # -1: a positive value pulls")
    return "\n".join([*lines, ""])


def _spelt(unit: str) -> str:
    """A unit as it ends a column's name, as `UNITS` has it."""
    every = {name.lower(): name for known in UNITS.values() for name in known}
    return every[unit.lower().replace("sec", "s")]


def guess_columns(
    names: Sequence[str], n_tendons: int, n_markers: int = 0
) -> tuple[list[str], list[str], list[str]]:
    """Time, motors and tip, or markers, among the columns of a log, by their names; empty where none is like
    it.

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
    if n_markers:  # base first, as they are numbered
        tips.sort(key=lambda three: [int(d) for d in re.findall(r"\d+", three["x"])])
    tip = [three[axis] for three in tips[: max(n_markers, 1)] for axis in "xyz"]
    alike: dict[str, list[str]] = {}
    for name in names:
        if name not in (*timed[:1], *tip):
            alike.setdefault(
                re.sub(r"\d+|(?<![A-Za-z])[A-Z](?![A-Za-z])|(?<=[a-z])[A-Z](?=_|$)", "#", name), []
            ).append(name)
    motors = [group for template, group in alike.items() if "#" in template and len(group) == n_tendons]
    motors.sort(
        key=lambda group: (
            not re.search(r"motor|servo|drive|tendon|tension|force|dl|cmd|cable|wire", group[0].lower())
        )
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
    if question == "motor-unit" and given["drive"] == "force":
        return "N"
    if question == "time-unit":
        step = float(np.nanmedian(np.diff(values[0]))) if values.shape[1] > 1 else 0.0
        return "ms" if 1.0 <= step < 1e4 else "ns" if step >= 1e5 else "s"
    length = 1e-3 * sum(given["length"])
    return "mm" if float(np.nanmax(np.abs(values))) > 4.0 * length else "m"
