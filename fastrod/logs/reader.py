"""A file as a run log, checked against its robot: columns, units, time."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fastrod.errors import LogError, nearest, shown
from fastrod.logs.runlog import BASE_QUATERNION, TIP, TIP_FORCE, TIP_QUATERNION, RunLog, on_one_clock
from fastrod.logs.table import Table, numbers, read_table
from fastrod.model.logformat import LogFormat
from fastrod.model.robot import Robot
from fastrod.model.robotfile import load_robot, robot_names
from fastrod.model.routing import route
from fastrod.types import Floats

_LONGEST_MOVE = 3.0  # robot lengths; nothing on the robot moves further, so the unit is wrong
_FAR = 30.0  # robot lengths; no camera that sees the robot is further off
_COUNTED_FROM = 0.25  # of the robot's length, by all tendons alike: no robot is pulled or paid out so far
_LIKE_REST = 0.2  # of the rest length: tendon lengths that stay so near to it are no changes
_PUSHED = 0.05  # of the largest force; a load cell has a zero
_HEAVIEST = 10.0  # kg; a heavier payload was given in g
_QUATERNION_SLACK = 1e-2  # trackers write three or four digits


def translated(table: Table, log: LogFormat, where: str) -> Table:
    """The columns of a run log, SI, from those of a file; the table itself where the file has none of the
    columns that `[log]` names. Raises `LogError` where it has only some of them."""
    sources = log.sources
    found = [source for source in sources.values() if source in table]
    if not found:
        return table
    if missing := [source for source in sources.values() if source not in table]:
        raise LogError(
            f"{where} lacks column {missing[0]!r}, which [log] columns of the robot file names; "
            f"{nearest(missing[0], table)}"
        )
    made: Table = {name: cells for name, cells in table.items() if name not in sources.values()}
    for name, source in sources.items():
        made[name] = table[source]
    for name in list(made):
        factor = log.factor(name)
        if np.isnan(factor):
            made[name] = _dates(made, name, where)
        elif name not in ("run", "session") and (factor != 1.0 or re.fullmatch(r"(dl|pos)_\d+", name)):
            made[name] = _lengths(name, factor * numbers(made, name, where), log, where)
    return made


def _lengths(name: str, values: Floats, log: LogFormat, where: str) -> Floats:
    """A column in SI; of a tendon or its drive, as a change of length, negative = pulled."""
    group, _, number = name.partition("_")
    if group not in ("dl", "pos"):
        return values
    k = int(number) - 1

    def of(key: str) -> float:
        value = getattr(log, key)
        if not isinstance(value, tuple):
            return float(value)
        if k >= len(value):
            raise LogError(
                f"{where} has column {name}; [log] {key} of the robot file lists {len(value)} numbers."
            )
        return float(value[k])

    angular = log.drum_radius is not None
    return of("sign") * (values * (of("drum_radius") if angular else 1.0) - of("offset"))


def _dates(table: Table, name: str, where: str) -> Floats:
    """Seconds since the first row of dates and times of day."""
    cells = [str(cell).strip().removesuffix("Z") for cell in table[name]]
    try:
        stamps = np.array([cell or "NaT" for cell in cells], dtype="datetime64[ns]")
    except ValueError as error:
        raise LogError(
            f"{where}, column of {name}: {error}; units time = 'iso' takes dates such as "
            "2026-05-12T09:30:00.125."
        ) from error
    seconds = (stamps - stamps[0]) / np.timedelta64(1, "ns") * 1e-9
    return np.asarray(seconds, dtype=np.float64)


def read_log(path: str | Path, robot: Robot | str | Path) -> RunLog:
    """The run log at `path` (.csv, .parquet or .mat) for `robot`, checked against it.

    A file with columns of its own is translated as `[log]` of the robot file says.

    Lines of a CSV that start with # are comments. Rows count from 1 after the header.
    Raises `LogError`, one sentence with row and column, for a file that cannot be read or that does not fit
    the robot.
    """
    path = Path(path)
    robot = robot if isinstance(robot, Robot) else load_robot(robot)
    where = path.name
    table = translated(read_table(path), robot.log, where)
    n = len(next(iter(table.values())))
    if n == 0:
        raise LogError(f"{where} has a header but no rows.")
    known: set[str] = set()

    def group(names: Sequence[str]) -> Floats | None:
        """(n, len(names)) columns that come together, or None where the log has none of them."""
        given = [name for name in names if name in table]
        if not given:
            return None
        _need(table, names, where, f"to go with {given[0]!r}")
        known.update(names)
        return np.stack([numbers(table, name, where) for name in names], axis=1)

    points = _points(table, robot, where, group)
    without_tip = points is not None and points.shape[1] > 0 and not set(TIP) & set(table)
    _need(table, ("t",) if without_tip else ("t", *TIP), where, "that every run log has")
    t, tip = group(("t",)), group(TIP)
    assert t is not None
    if without_tip and points is not None:
        points, tip = points[:, :-1], points[:, -1]
    assert tip is not None
    forces = any(re.fullmatch(r"tension_\d+", name) for name in table)
    if forces and not any(re.fullmatch(r"dl_\d+", name) for name in table) and not robot.by_tension:
        raise LogError(
            f"{where} gives tendon forces, tension_1 and so on, and robot {robot.name!r} is driven by "
            'lengths; give its segments mode = "tendon_tension".'
        )
    dl = _of_tendons(table, "tension" if robot.by_tension else "dl", robot, where, group)
    pos = _of_tendons(table, "pos", robot, where, group)
    payload = group(("payload",))
    log = RunLog(
        name=path.stem,
        t=t[:, 0],
        run=_labels(table, n, "run"),
        dl=np.zeros((n, robot.n_tendons)) if dl is None or robot.by_tension else dl,
        tip_position=tip,
        tension=dl if robot.by_tension else None,
        without_tip=without_tip,
        pos=pos,
        session=_labels(table, n, "session") if "session" in table else None,
        ext=_extension(table, robot, where, known),
        tip_quaternion=_unit(group(TIP_QUATERNION), TIP_QUATERNION, where),
        points=points,
        tip_force=group(TIP_FORCE),
        payload=None if payload is None else payload[:, 0],
        base_quaternion=_unit(group(BASE_QUATERNION), BASE_QUATERNION, where),
        extra={name: cells for name, cells in table.items() if name not in known | {"run", "session"}},
    )
    _check_time(log, where)
    log = on_one_clock(log, robot.log.clock)
    _check_units(log, robot, where)
    return log


def log_of(given: RunLog | str | Path, robot: Robot) -> RunLog:
    """A run log, or the one of a file of `robot`. Raises what `read_log` does, `LogError` for what is
    neither."""
    if isinstance(given, RunLog):
        return given
    if not isinstance(given, (str, Path)):
        raise LogError(f"the log is {shown(given)}; give a RunLog, or the path of a file.")
    return read_log(given, robot)


def _need(table: Table, names: Sequence[str], where: str, why: str) -> None:
    missing = [name for name in names if name not in table]
    if missing:
        plural = "columns" if len(missing) > 1 else "column"
        raise LogError(
            f"{where} lacks {plural} {', '.join(missing)} {why}; {_nearest_column(missing[0], table)}"
        )


def _nearest_column(name: str, table: Table) -> str:
    if same := [column for column in table if column.lower() == name.lower()]:
        return f"did you mean {same[0]!r}?"
    near = nearest(name, table)
    return (
        near
        if near.startswith("did")
        else (f"its columns are {', '.join(' '.join(column.split()) for column in table)}.")
    )


def _of_tendons(
    table: Table, kind: str, robot: Robot, where: str, group: Callable[[Sequence[str]], Floats | None]
) -> Floats | None:
    """(n, n_tendons) the columns of each tendon of a `kind`, "dl", which a log must have, or "pos"."""
    if kind == "pos" and not any(re.fullmatch(rf"{kind}_\d+", name) for name in table):
        return None
    names, by_drive = _tendon_columns(table, kind, robot, where)
    values = group(names)
    if values is None or by_drive is None:
        return values
    return values @ by_drive if kind != "tension" else np.maximum(values @ by_drive, 0.0)


def _tendon_columns(table: Table, kind: str, robot: Robot, where: str) -> tuple[list[str], Floats | None]:
    """dl_1 ... dl_n of the robot, or another `kind`, after a check that the log has these and no others. Of
    tendons that can only pull, two on a drive, the log may have one column for each drive: then also
    (n_drives, n_tendons) what a drive makes of its tendons."""
    names = [f"{kind}_{k}" for k in range(1, robot.n_tendons + 1)]
    given = [name for name in table if re.fullmatch(rf"{kind}_\d+", name)]
    wiring = route(robot)
    if len(given) == wiring.n_drives < len(names) and all(t.unilateral for t in robot.tendons):
        by_drive = np.eye(wiring.n_drives)[wiring.drive].T * wiring.drive_sign
        return [f"{kind}_{k}" for k in range(1, wiring.n_drives + 1)], by_drive
    too_many = [name for name in given if name not in names]
    if too_many or (len(given) < len(names) and given):
        twins = [name for name in robot_names() if load_robot(name).n_tendons == len(given)]
        hint = f" Shipped robots with {len(given)}: {', '.join(twins)}." if twins else ""
        raise LogError(
            f"{where} has {len(given)} {kind}_ columns ({given[0]} to {given[-1]}); robot {robot.name!r} has "
            f"{robot.n_tendons} tendons "
            f"and needs {f'{names[0]} to {names[-1]}' if names else 'none'}.{hint}"
        )
    _need(table, names, where, f"that robot {robot.name!r} needs for its {robot.n_tendons} tendons")
    return names, None


def _extension(table: Table, robot: Robot, where: str, known: set[str]) -> Floats | None:
    """(n, n_segments) from the ext_ columns that the log has; a segment without one keeps its length."""
    given = [name for name in table if re.fullmatch(r"ext_\d+", name)]
    if not given:
        return None
    names = [f"ext_{k}" for k in range(1, robot.n_segments + 1)]
    if wrong := [name for name in given if name not in names]:
        raise LogError(
            f"{where} has column {wrong[0]!r}; robot {robot.name!r} has {robot.n_segments} "
            f"segments, ext_1 to {names[-1]}."
        )
    known.update(given)
    n = len(table[given[0]])
    return np.stack([numbers(table, name, where) if name in given else np.zeros(n) for name in names], axis=1)


def _points(
    table: Table, robot: Robot, where: str, group: Callable[[Sequence[str]], Floats | None]
) -> Floats | None:
    """(n, k, 3) of p1_x ... pk_z, where k is the number of the robot's [log] points."""
    numbers = {int(m[1]) for name in table if (m := re.fullmatch(r"p(\d+)_[xyz]", name))}
    if not numbers:
        return None
    k = len(robot.log_points)
    if numbers != set(range(1, k + 1)):
        raise LogError(
            f"{where} has points p{min(numbers)} to p{max(numbers)}; robot {robot.name!r} names the "
            f"arclengths of {k}. "
            "Give one arclength for each in its robot file: [log] points = [...]."
        )
    columns = group([f"p{i}_{axis}" for i in range(1, k + 1) for axis in "xyz"])
    return None if columns is None else columns.reshape(-1, k, 3)


def _labels(table: Table, n: int, name: str) -> NDArray[np.str_]:
    cells = table.get(name, [""] * n)
    if isinstance(cells, np.ndarray):
        cells = [f"{cell:g}" for cell in cells]  # labels that a Parquet file numbers
    return np.array([str(cell).strip() for cell in cells])


def _unit(quaternion: Floats | None, names: Sequence[str], where: str) -> Floats | None:
    """`quaternion` (n, 4) scaled to norm 1, after a check that it was near."""
    if quaternion is None:
        return None
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(quaternion, axis=1)
    if (off := np.abs(norm - 1.0) > _QUATERNION_SLACK).any():
        row = int(np.argmax(off))
        columns = f"columns {names[0]} to {names[-1]}"
        raise LogError(
            f"{where} row {row + 1}, {columns} have norm {norm[row]:.6g}; a quaternion w x y z has norm 1."
        )
    return np.asarray(quaternion / norm[:, None], dtype=np.float64)


def _check_time(log: RunLog, where: str) -> None:
    for label in log.runs:
        rows = np.flatnonzero((log.run == label) & np.isfinite(log.t))
        back = np.flatnonzero(np.diff(log.t[rows]) < 0.0)
        if back.size:
            row, before = rows[back[0] + 1], rows[back[0]]
            inside = f" inside run {label!r}" if label else ""
            raise LogError(
                f"{where} row {row + 1}, column t is {log.t[row]:g} s after {log.t[before]:g} s{inside}; "
                "time must not run back. "
                "Name several runs in a column run."
            )


def _check_units(log: RunLog, robot: Robot, where: str) -> None:
    """Lengths in mm and masses in g: values that no robot of this size can have."""
    length = robot.length + float(sum(segment.extension[1] for segment in robot.segments))

    def refuse(bad: NDArray[np.bool_], column: str, value: NDArray[np.floating], unit: str, why: str) -> None:
        if bad.any():
            row = int(np.argmax(bad))
            raise LogError(f"{where} row {row + 1}, {column} is {value[row]:.6g} {unit}; {why}")

    def norm(points: Floats) -> Floats:
        with np.errstate(over="ignore"):  # of 1e300, which is too far then
            return np.asarray(np.linalg.norm(points, axis=1))

    far = (
        f"more than {_LONGEST_MOVE:g} lengths of robot {robot.name!r} ({robot.length:g} m). "
        "Was it given in mm, or in cm?"
    )
    for name, places in _measured(log):
        away = norm(places)
        refuse(away > _FAR * length, f"{name} from the base", away, "m", far)
        if not np.isfinite(away).any():
            continue
        moved = norm(places - np.nanmedian(places, axis=0))  # wherever the camera stands
        refuse(
            (moved > _LONGEST_MOVE * length) & (away > _LONGEST_MOVE * length),
            f"{name} from the base",
            away,
            "m",
            far,
        )
    _check_changes(log, robot, where)
    if log.tension is not None:
        pushed = -log.tension.min(axis=1) if robot.n_tendons else np.zeros(len(log))
        most = float(np.nanmax(np.abs(log.tension), initial=0.0))
        why = "a tendon does not push. Give positive forces [N]."
        if all(tendon.unilateral for tendon in robot.tendons):
            refuse(pushed > _PUSHED * most, "the least of columns tension_", -pushed, "N", why)
    for kind, values in (("dl", log.dl), ("pos", log.pos)):
        for k in range(log.dl.shape[1] if values is not None else 0):
            assert values is not None
            long = f"more than robot {robot.name!r} is long ({robot.length:g} m). Was it given in mm?"
            refuse(np.abs(values[:, k]) > length, f"column {kind}_{k + 1}", values[:, k], "m", long)
    for k in range(0 if log.ext is None else log.ext.shape[1]):
        assert log.ext is not None
        low, high = robot.segments[k].extension
        slack = 0.05 * (high - low) + 1e-9  # a measured extension overshoots a little
        outside = (log.ext[:, k] < low - slack) | (log.ext[:, k] > high + slack)
        why = f"segment {k + 1} of robot {robot.name!r} allows {low:g} to {high:g} m. Was it given in mm?"
        refuse(outside, f"column ext_{k + 1}", log.ext[:, k], "m", why)
    if log.payload is not None:
        refuse(log.payload < 0.0, "column payload", log.payload, "kg", "a mass is not negative.")
        refuse(
            log.payload > _HEAVIEST,
            "column payload",
            log.payload,
            "kg",
            f"more than {_HEAVIEST:g} kg. Was it given in g?",
        )


def _measured(log: RunLog) -> Iterator[tuple[str, Floats]]:
    """The measured places (n, 3) [m], and what their distance from the base is called."""
    yield "the tip's distance", log.tip_position
    for k in range(0 if log.points is None else log.points.shape[1]):
        assert log.points is not None
        yield f"the distance of point p{k + 1}", log.points[:, k]


def _check_changes(log: RunLog, robot: Robot, where: str) -> None:
    """Refuse lengths that are no changes against the straight robot, on a robot that cannot grow so far:
    absolute ones, about as long as at rest, and those that are counted from elsewhere."""
    rest = np.asarray(robot.rest_tendon_length)
    grows = sum(segment.extension[1] for segment in robot.segments)
    if not rest.size or not np.isfinite(log.dl).all(axis=1).any() or grows >= 0.5 * robot.length:
        return
    usual = np.nanmedian(log.dl, axis=0)
    common = float(usual.mean())
    if (np.abs(usual - rest) < _LIKE_REST * rest).all():
        raise LogError(
            f"{where} has a median of {usual[0]:.4g} m in column dl_1, where robot {robot.name!r} has a "
            f"tendon of {rest[0]:.4g} m at rest: "
            "these look like absolute lengths. The log takes changes against the straight robot, negative = "
            "pulled."
        )
    if abs(common) > _COUNTED_FROM * robot.length and np.ptp(usual) < 0.5 * abs(common):
        raise LogError(
            f"{where} has about {common:.4g} m in every dl_ column: are they counted from another length "
            f"than that of the straight robot? [log] columns and offset = {common:.4g} in the file of robot "
            f"{robot.name!r} take it off."
        )
