"""Measured data of four real robots, each as a `RunLog` and the `Robot` that it was measured on.

Every adapter turns a published table into SI units and into the robot's base frame: z along the straight rod
away from the base, right-handed. What the authors publish is used as published; what they do not is
*nominal*: a round number of the right size, never fitted to the log. A replay with nominal geometry is
therefore the error before any identification.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fastrod.errors import InputError, LogError, nearest
from fastrod.logs.reader import read_log
from fastrod.logs.runlog import RunLog
from fastrod.logs.table import Table, numbers, read_table
from fastrod.model.robot import Robot, Segment, Tendon
from fastrod.model.robotfile import load_robot

_UPSIDE_DOWN = (0.0, 1.0, 0.0, 0.0)
"""world_from_base of a robot that hangs: rotated by 180 degrees about x, so that z of the base points
down."""

ASL_DISKS = (0.106, 0.202, 0.320)
"""Distance of the three disks below the base at rest [m], published."""
ASL_MOTORS = ((3, 5), (1, 6), (2, 4))
"""Motors whose tendons end at disk 1, 2, 3, published."""
ASL_DIRECTION = {1: -45.0, 2: -105.0, 3: 195.0, 4: 165.0, 5: 105.0, 6: 45.0}
"""Pull direction of each motor in the mocap x-z plane, from x toward z [deg], published."""
ASL_BASE = (0.1034, 0.1082)
"""Base [m], mocap x and z, where a run begins in motion: the mean of the disk centres where perlin_0g begins,
nominal."""
_ASL_NEAR_REST = 4.0
"""Asymmetry near rest of a motor [deg]: the pose of a run that begins so near to rest is that of rest."""
ASL_SPOOL_RADIUS = 0.03
"""Nominal [m]. Without loads the shape knows only its ratio to the pitch radius; here that ratio is 1."""
ASL_PITCH_RADIUS = 0.03
"""Nominal [m]."""

ASL_NOISE = 5e-6
"""Noise of the tip at rest, per axis, published [m]."""
ASL_COMPLIANCE = 1e-3
"""Nominal [m/N]: the tendons are kept tight by springs."""
ASL_PRETENSION = 5.0
"""Nominal [N], of every tendon at rest."""
ASL_AXIAL_STIFFNESS = (300.0, 400.0, 500.0)
"""Nominal [N], by segment: a hose that the tendons shorten."""

OPENCR_SERVOS = (4, 3, 9, 5, 2, 8, 6, 1, 7)
"""The servo of each tendon, published."""
OPENCR_STIFFNESS = 0.0098
"""Stiffness of a steel core of 1 mm at 200 GPa [N m^2]."""
OPENCR_COMPLIANCE = 4e-5
"""Nominal [m/N]."""
OPENCR_PRETENSION = 4.0
"""Nominal [N]; the authors' fits are 0 to 4 N by segment."""
OPENCR_AXIAL_STIFFNESS = 2e4
"""Nominal [N], of the core with its disks between tendons."""

ARMLAB_LENGTH = 0.108
"""Nominal [m]: the middle of the published fits, 0.096 to 0.119 m."""
ARMLAB_PITCH_RADIUS = 0.0045
"""Nominal [m]: the middle of the published fits, 0.0038 to 0.0051 m."""
ARMLAB_COMPLIANCE = 1e-4
"""Nominal [m/N]: all three tendons pulled by 10 mm then draw 100 N each, on a body that cannot shorten."""
ARMLAB_NOISE = 6e-5
"""Noise of the tip, per axis, published as 0.03 to 0.06 mm [m]."""
ARMLAB_CELL = 0.0025
"""Edge of the cells of the cube of shortenings that label the rows: regions to hold out [m]."""
ARMLAB_DIRECTION = (205.0, 85.0, 325.0)
"""Pull direction of each tendon in the mocap x-z plane, from x toward z [deg]: nominal, see `armlab_tdcr`."""


def asl_trunk(path: str | Path, run: str | None = None) -> tuple[RunLog, Robot]:
    """Three-segment trunk of Stanford ASL, hanging: one run, or all of them.

    Frame: base x = mocap x, base y = mocap z, base z = -mocap y (down), at the height y = 0 of the mocap
    frame. The base point is not published: in each run it lies over the mean of the three disk centres in the
    run's first row, where the motors are within 4 deg of rest there, else at `ASL_BASE`. Rest pose and motor
    zeros change between sessions: the perlin runs with payloads are one, those that begin at one pose to
    0.01 mm, of June, are another, every other recording is its own.

    Published: disk heights, which motor ends where, pull directions, payload. A motor pulls one tendon and
    pays out its antagonist, and both can only pull: twelve tendons, in the order of motors 3 5 | 1 6 | 2 4,
    the one that the motor pulls first. `dl` = -spool radius times the *commanded* motor angle u, for that is
    what a user has beforehand, and its negative for the antagonist; `pos` is the same of the measured angles
    phi (up to 5 rows stale). Tip = disk 3; points p1, p2 = disks 1 and 2. Nominal: spool radius, pitch
    radius, tendon compliance and pretension, axial stiffness, bending stiffness 0.05, torsional stiffness 0.5
    N m^2 (a corrugated hose bends but hardly twists), a weightless body. Only `payload` loads the rod, and
    how far it sags rests on the nominal stiffness.
    """
    table, where = _table(path, "asl_trunk"), Path(path).name
    disks = [
        _metres(table, (f"x{k}_mm", f"z{k}_mm", f"y{k}_mm"), where) * (1.0, 1.0, -1.0) for k in (1, 2, 3)
    ]
    labels = np.array(table["run"])
    for label in dict.fromkeys(labels.tolist()):
        rows = labels == label
        begun = max(abs(numbers(table, f"u{k}_deg", where)[rows][0]) for k in range(1, 7))
        base = np.mean([disk[rows][0] for disk in disks], axis=0) * (1.0, 1.0, 0.0)
        base = base if begun < _ASL_NEAR_REST else np.array([*ASL_BASE, 0.0])
        for disk in disks:
            disk[rows] -= base

    def by_tendon(angle: str) -> NDArray[np.float64]:
        order = [motor for pair in ASL_MOTORS for motor in pair]
        rad = [np.radians(numbers(table, f"{angle}{motor}_deg", where)) for motor in order]
        return np.stack([sign * ASL_SPOOL_RADIUS * each for each in rad for sign in (-1.0, 1.0)], axis=1)

    pos = by_tendon("phi")
    log = RunLog(
        name=Path(path).stem,
        t=numbers(table, "t_s", where),
        run=labels,
        dl=by_tendon("u"),
        tip_position=disks[2],
        pos=pos if np.isfinite(pos).any() else None,
        session=np.array([_asl_session(label) for label in labels.tolist()]),
        points=np.stack(disks[:2], axis=1),
        payload=numbers(table, "payload_g", where) / 1000.0,
    )
    return log if run is None else log.only(run), _asl_robot()


def _asl_session(run: str) -> str:
    if re.fullmatch(r"perlin_\d+g", run):
        return "perlin"
    return "june" if run.startswith(("strokes", "hops_june")) else re.sub(r"_[a-z]$", "", run)


def _asl_robot() -> Robot:
    starts = (0.0, *ASL_DISKS[:-1])
    segments = [
        Segment(
            length=end - start,
            bending_stiffness=(0.05, 0.05),
            torsional_stiffness=0.5,
            axial_stiffness=axial,
            body_radius=0.04,
            tendons=tuple(
                Tendon(
                    offset=ASL_PITCH_RADIUS,
                    angle=math.radians(math.remainder(ASL_DIRECTION[motor] + opposite, 360.0)),
                    compliance=ASL_COMPLIANCE,
                    pretension=ASL_PRETENSION,
                    unilateral=True,
                )
                for motor in motors
                for opposite in (0.0, 180.0)
            ),
        )
        for start, end, axial, motors in zip(starts, ASL_DISKS, ASL_AXIAL_STIFFNESS, ASL_MOTORS, strict=True)
    ]
    return Robot(
        name="asl_trunk",
        segments=tuple(segments),
        base_quaternion=_UPSIDE_DOWN,
        log_points=ASL_DISKS[:2],
        fit={
            "tendon.*.gain": {"sd": 0.5},
            "tendon.*.zero": {"sd": 0.01},
            "segment.*.length": {"sd": 0.005},
            "segment.*.bending_stiffness": {"sd": 0.03},
            "segment.*.axial_stiffness": {"sd": 300.0},
            "tendon.*.compliance": {"sd": 1e-3},
            "tendon.*.pretension": {"sd": 4.0},
        },
        sensor={"registration_sd": (0.01, 0.05), "noise": ASL_NOISE, "latency_sd": 0.15},
    )


def ethz_beam(
    path: str | Path, run: str | None = None, *, settled: float | None = 1.0
) -> tuple[RunLog, Robot]:
    """Clamped silicone beam of ETH Zurich, let go from straight under a known tip load: one run, or all of
    them.

    Frame: axes as measured (gravity -x, beam axis +z), origin such that the mean of the three tip markers
    starts at (0, 0, length). The clamp's markers move between sessions and the start is held straight by hand
    (scatter 0.4 mm in x, more in y and z), so no better origin is known: only the drop along x since the own
    start is a clean measurement.

    Published: dimensions, density, modulus (the shipped robot `ethz_beam` has them), tip load, gravity. The
    load hangs from the upper edge of the tip face; here it acts at the centre. `tip_force` = the load along
    -x, constant; of whole runs, in which it swings too, `payload` = its mass.
    `settled`: the tip counts as measured in the last so many seconds of a run; what comes before, held by
    hand and then ringing at 4 to 8 Hz, is given as missing, for a static model says nothing about it. None
    gives the whole run.
    """
    robot = load_robot("ethz_beam")
    table, where = _table(path, "ethz_beam"), Path(path).name
    tip = np.mean([_metres(table, [f"tip{k}_{axis}_mm" for axis in "xyz"], where) for k in (1, 2, 3)], axis=0)
    labels, t = np.array(table["run"]), numbers(table, "t_s", where)
    load = numbers(table, "tip_load_N", where)
    for label in dict.fromkeys(labels.tolist()):
        rows = labels == label
        tip[rows] += (0.0, 0.0, robot.length) - tip[rows][0]
        if settled is not None:
            tip[rows & (t < t[rows][-1] - settled)] = np.nan
    log = RunLog(
        name=Path(path).stem,
        t=t,
        run=labels,
        dl=np.zeros((len(t), 0)),
        tip_position=tip,
        tip_force=None if settled is None else load[:, None] * (-1.0, 0.0, 0.0),
        payload=load / 9.81 if settled is None else None,
    )
    return log if run is None else log.only(run), robot


def armlab_tdcr(path: str | Path) -> tuple[RunLog, Robot]:
    """One segment with three tendons of ARM-Lab, hanging, static: the whole grid of shortenings as one run.

    Frame: base x = mocap x, base y = mocap z, base z = -mocap y (down); the rest tip, the mean of the three
    rows with at most 0.1 mm of pull, lies at (0, 0, length). There is no clock: `t` counts the rows as
    acquired, 1 s each.

    Published: three tendons 120 deg apart, their shortening (`dl` = -l_mm / 1000), tip position. Every sweep
    only loads. Rows with glitch = 1 are given as missing. Nominal: length and pitch radius in the middle of
    the published fits; stiffness as the paper's prototype; weightless; angles 205, 85, 325 deg, which is
    where the tip went when one tendon was pulled alone (-155, 86, -37 deg), rounded to 5 deg and 120 deg
    apart. The grid pulls all three tendons together too. The real body shortens then; this rod cannot, so the
    common component of the pull stretches the tendons and only the differences bend: the tensions mean
    nothing here.
    """
    table, where = _table(path, "armlab_tdcr"), Path(path).name
    pull = _metres(table, ("l1_mm", "l2_mm", "l3_mm"), where)
    tip = _metres(table, ("x_mm", "z_mm", "y_mm"), where) * (1.0, 1.0, -1.0)
    glitch = numbers(table, "glitch", where) == 1.0
    rest = (pull.sum(axis=1) < 1.5e-4) & ~glitch
    if not rest.any():
        raise LogError(f"{where} has no row at rest (at most 0.1 mm of pull in all), which places the base.")
    tip += (0.0, 0.0, ARMLAB_LENGTH) - tip[rest].mean(axis=0)
    tip[glitch] = np.nan
    t = numbers(table, "row", where)
    cells = np.minimum(np.nan_to_num(pull) // ARMLAB_CELL, 9).astype(int)
    run = np.array(["cell_" + "".join(map(str, cell)) for cell in cells.tolist()])
    log = RunLog(name=Path(path).stem, t=t, run=run, dl=-pull, tip_position=tip)
    return log, _armlab_robot()


def _armlab_robot() -> Robot:
    tendons = tuple(
        Tendon(offset=ARMLAB_PITCH_RADIUS, angle=math.radians(angle), compliance=ARMLAB_COMPLIANCE)
        for angle in ARMLAB_DIRECTION
    )
    rod = Segment(
        length=ARMLAB_LENGTH,
        bending_stiffness=(0.0022, 0.0022),
        torsional_stiffness=0.001,
        body_radius=0.008,
        tendons=tendons,
    )
    return Robot(
        name="armlab_tdcr",
        segments=(rod,),
        base_quaternion=_UPSIDE_DOWN,
        fit={
            "segment.1.length": {"sd": 0.01},
            "tendon.*.offset": {"sd": 0.001, "shared": True},
            "tendon.*.gain": {"sd": 0.1},
            "tendon.*.angle": {"sd": 0.15},
        },
        sensor={"registration_sd": (0.01, 0.05), "noise": ARMLAB_NOISE},
    )


def opencr_ftv4(path: str | Path) -> tuple[RunLog, Robot]:
    """Three segments with nine tendons of the Continuum Robotics Lab, Toronto: single pulls, circles, pairs.

    Frame: as published, z along the straight robot, up to 10 mm and a turn about z off. `t` counts from the
    first row; rows that repeat were dropped by the authors, so that a hold is a gap in time.

    Published: segment lengths, the tendons' place 4.5 mm off a steel core of 1 mm, which servo pulls which
    (the columns are in tendon order, three a segment); `dl` = -servo_mm / 1000, measured, each tendon on a
    servo of its own that can only pull. Read from the first pulls of single tendons and rounded to 30 deg:
    the tendons' angles. Nominal: bending stiffness of the core (200 GPa), tendon compliance, pretension,
    axial stiffness; weightless.
    """
    table, where = _table(path, "opencr_ftv4"), Path(path).name
    t = numbers(table, "timestamp", where)
    log = RunLog(
        name=Path(path).stem,
        t=t - t[0],
        run=np.full(len(t), ""),
        dl=-_metres(table, [f"servo_{k}_mm" for k in OPENCR_SERVOS], where),
        tip_position=_metres(table, [f"tip_{axis}" for axis in "xyz"], where),
    )
    return log, _opencr_robot()


def _opencr_robot() -> Robot:
    segments = tuple(
        Segment(
            length=length,
            bending_stiffness=(OPENCR_STIFFNESS, OPENCR_STIFFNESS),
            torsional_stiffness=0.77 * OPENCR_STIFFNESS,
            axial_stiffness=OPENCR_AXIAL_STIFFNESS,
            body_radius=0.006,
            tendons=tuple(
                Tendon(
                    offset=0.0045,
                    angle=math.radians(math.remainder(first + 120.0 * i, 360.0)),
                    compliance=OPENCR_COMPLIANCE,
                    pretension=OPENCR_PRETENSION,
                    unilateral=True,
                )
                for i in range(3)
            ),
        )
        for length, first in zip((0.06, 0.0625, 0.064), (180.0, 210.0, 240.0), strict=True)
    )
    return Robot(
        name="opencr_ftv4",
        segments=segments,
        fit={
            "tendon.*.gain": {"sd": 0.1},
            "tendon.*.angle": {"sd": 0.1},
            "segment.*.length": {"sd": 0.003},
            "segment.*.bending_stiffness": {"sd": 0.3 * OPENCR_STIFFNESS},
            "segment.*.axial_stiffness": {"sd": OPENCR_AXIAL_STIFFNESS},
            "tendon.*.compliance": {"sd": OPENCR_COMPLIANCE, "shared": True},
            "tendon.*.pretension": {"sd": 2.0 * OPENCR_PRETENSION},
        },
        sensor={"registration_sd": (0.01, 0.1)},
    )


_HEADERS = {
    "asl_trunk": (
        *("run", "payload_g", "t_s"),
        *(f"{angle}{k}_deg" for angle in ("u", "phi") for k in range(1, 7)),
        *(f"{axis}{k}_mm" for k in (1, 2, 3) for axis in "xyz"),
    ),
    "ethz_beam": ("run", "tip_load_N", "t_s", *(f"tip{k}_{axis}_mm" for k in (1, 2, 3) for axis in "xyz")),
    "opencr_ftv4": ("timestamp", *(f"servo_{k}_mm" for k in OPENCR_SERVOS), "tip_x", "tip_y", "tip_z"),
    "armlab_tdcr": ("l1_mm", "l2_mm", "l3_mm", "x_mm", "y_mm", "z_mm", "glitch"),
}
_ADAPTERS: dict[str, Callable[[str | Path], tuple[RunLog, Robot]]] = {
    "asl_trunk": asl_trunk,
    "ethz_beam": ethz_beam,
    "armlab_tdcr": armlab_tdcr,
    "opencr_ftv4": opencr_ftv4,
}


def detect(path: str | Path) -> Callable[[str | Path], tuple[RunLog, Robot]] | None:
    """The adapter of the measured set whose raw file `path` is, known by its header; None for any other
    file."""
    if not Path(path).is_file():
        return None  # a pipe would wait for whoever writes into it
    try:
        with Path(path).open(encoding="utf-8-sig") as file:
            header = {name.strip() for name in file.readline(4096).split(",")}
    except (OSError, UnicodeDecodeError):
        return None  # the reader of the file says what is wrong with it
    return next((_ADAPTERS[name] for name, columns in _HEADERS.items() if header.issuperset(columns)), None)


def read(path: str | Path, given: Robot | None) -> tuple[RunLog, Robot]:
    """A run log of the robot `given`, or a raw file of a measured set, which brings its own, with that robot.

    Raises `InputError` where a run log comes without its robot, or the robot given has other tendons than the
    set's; `LogError` as the readers.
    """
    path = Path(path)
    own = given is not None and bool(given.log.columns)
    if not own and (adapter := detect(path)):
        log, robot = adapter(path)
        if given is not None and given.n_tendons != robot.n_tendons:
            raise InputError(
                f"robot {given.name!r} has {given.n_tendons} tendons, the one of {path.name} has "
                f"{robot.n_tendons}; "
                "leave --robot out to take its own."
            )
        return log, given or robot
    if given is None:
        raise InputError(f"{path.name} is a run log and does not say whose; name its robot with --robot.")
    return read_log(path, given), given


def _table(path: str | Path, name: str) -> Table:
    table = read_table(path)
    if missing := [column for column in _HEADERS[name] if column not in table]:
        raise LogError(
            f"{Path(path).name} is not the raw file of {name}: it lacks column {missing[0]}; "
            f"{nearest(missing[0], table)}"
        )
    return table


def _metres(table: Table, names: Sequence[str], where: str) -> NDArray[np.float64]:
    """(n, len(names)) columns given in mm, in m."""
    return np.stack([numbers(table, name, where) for name in names], axis=1) / 1000.0
