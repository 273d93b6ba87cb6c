"""`RunLog`, the one format of measured and simulated runs, and its files in CSV and Parquet (`reader`)."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from io import TextIOWrapper
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fastrod.errors import LogError, UnknownNameError, nearest
from fastrod.logs.table import Table, arrow
from fastrod.types import Floats

TIP = ("tip_x", "tip_y", "tip_z")
TIP_QUATERNION = ("tip_qw", "tip_qx", "tip_qy", "tip_qz")
TIP_FORCE = ("tip_fx", "tip_fy", "tip_fz")
BASE_QUATERNION = ("base_qw", "base_qx", "base_qy", "base_qz")
"""Columns of a file that come together."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RunLog:
    """Samples of one or more runs of a robot: what was commanded, and what was measured.

    The sample axis comes first. A missing value is nan; the arrays are read-only.
    """

    name: str
    """Name of the log in tables: its file's name without suffix."""
    t: Floats
    """(n,) time [s], non-decreasing inside a run."""
    run: NDArray[np.str_]
    """(n,) label of the run that the sample belongs to; '' where the log names none."""
    dl: Floats
    """(n, n_tendons) change of each tendon's length against the straight rest robot [m], negative =
    pulled; 0 of tendons that are driven by force."""
    tip_position: Floats
    """(n, 3) measured tip, base frame [m]; of a log `without_tip` the last of the robot's `log_points`."""
    tension: Floats | None = None
    """(n, n_tendons) force on each tendon, of a robot that is driven by forces [N]."""
    without_tip: bool = False
    """No tip was measured: the last of the robot's `log_points` stands for it; `points` are the others."""
    pos: Floats | None = None
    """(n, n_tendons) measured positions of the drives, counted as `dl` [m]: what moved the tendons, where
    `dl` was asked for."""
    session: NDArray[np.str_] | None = None
    """(n,) label of the session of each sample: zeros, registration and latency are of a session, all else is
    of the robot."""
    ext: Floats | None = None
    """(n, n_segments) change of each segment's backbone length [m]."""
    tip_quaternion: Floats | None = None
    """(n, 4) measured base_from_tip, w x y z."""
    points: Floats | None = None
    """(n, k, 3) further measured points at the robot's `log_points`, base frame [m]."""
    tip_force: Floats | None = None
    """(n, 3) known force on the tip, base frame [N]."""
    payload: Floats | None = None
    """(n,) known mass at the tip [kg]."""
    base_quaternion: Floats | None = None
    """(n, 4) world_from_base, w x y z: the direction of gravity."""
    extra: Mapping[str, Sequence[str] | Floats] = field(default_factory=dict)
    """Columns that fastrod does not know, kept as they were read."""

    def __post_init__(self) -> None:
        n = len(self.t)
        shapes: dict[str, tuple[int | None, ...]] = {
            "t": (n,),
            "run": (n,),
            "dl": (n, None),
            "pos": np.shape(self.dl),
            "tension": np.shape(self.dl),
            "session": (n,),
            "tip_position": (n, 3),
            "ext": (n, None),
            "tip_quaternion": (n, 4),
            "points": (n, None, 3),
            "tip_force": (n, 3),
            "payload": (n,),
            "base_quaternion": (n, 4),
        }
        for name, shape in shapes.items():
            if (value := getattr(self, name)) is None:
                continue
            array = np.array(value, dtype=np.str_ if name in ("run", "session") else np.float64)
            if array.ndim != len(shape) or any(
                want not in (None, got) for want, got in zip(shape, array.shape, strict=True)
            ):
                wanted = ", ".join("any" if size is None else str(size) for size in shape)
                raise LogError(f"RunLog.{name} has shape {array.shape}; it must be ({wanted}).")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if n == 0:
            raise LogError(f"log {self.name!r} has no rows.")

    def __len__(self) -> int:
        return len(self.t)

    @property
    def runs(self) -> list[str]:
        """Labels of the runs, in the order of their first sample."""
        return list(dict.fromkeys(self.run.tolist()))

    @property
    def commands(self) -> Floats:
        """(n, n_tendons) what drives the tendons: `dl` [m], or `tension` [N]."""
        return self.dl if self.tension is None else self.tension

    @property
    def pulls(self) -> Floats:
        """(n, n_tendons) the same, negative = pulled: lengths [m], or forces [N]."""
        return self.dl if self.tension is None else -self.tension

    def with_pulls(self, pulls: Floats) -> RunLog:
        """The log with other `pulls`."""
        return replace(self, dl=pulls) if self.tension is None else replace(self, tension=-pulls)

    @property
    def inputs(self) -> Floats:
        """(n, n_inputs) all that is given: commands, extension, known loads, base orientation."""
        given = (self.commands, self.ext, self.tip_force, self.payload, self.base_quaternion)
        return np.concatenate([a.reshape(len(self), -1) for a in given if a is not None], axis=1)

    @property
    def driven(self) -> NDArray[np.bool_]:
        """(n,) rows whose inputs are all there."""
        return np.asarray(np.isfinite(self.inputs).all(axis=1), dtype=np.bool_)

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(n,) rows that a model can be compared with: time, every input and the tip are there."""
        return np.asarray(
            self.driven & np.isfinite(self.t) & np.isfinite(self.tip_position).all(axis=1), dtype=np.bool_
        )

    def rows(self, which: NDArray[np.bool_] | NDArray[np.int64] | slice) -> RunLog:
        """The samples `which`: a mask (n,), indices or a slice."""
        index = np.arange(len(self))[which]
        cut = {
            f.name: value[index]
            for f in fields(self)
            if f.name not in ("name", "extra", "without_tip") and (value := getattr(self, f.name)) is not None
        }
        extra = {key: _taken(value, index) for key, value in self.extra.items()}
        return replace(self, extra=extra, **cut)

    def only(self, *runs: str) -> RunLog:
        """The samples of one run, or of several. Raises `UnknownNameError` with the nearest label, or saying
        that the log names none."""
        for run in map(str, runs):  # numpy's words quote as np.str_(...)
            if run not in self.runs:
                if not (named := [" ".join(label.split()) for label in self.runs if label]):
                    raise UnknownNameError(f"no run {run!r}; log {self.name!r} names no runs.")
                raise UnknownNameError(f"no run {run!r} in log {self.name!r}; {nearest(run, named)}")
        return self.rows(np.isin(self.run, runs))


def on_one_clock(log: RunLog, clock: float) -> RunLog:
    """The log with its commands laid on the clock of what was measured: those of time t stand in the row of
    t + `clock` [s]. Rows for which no command is known miss it."""
    return with_commands_at(log, log.t + clock) if clock else log


def with_commands_at(log: RunLog, t: Floats) -> RunLog:
    """The log with the commands of the times `t` (n,) [s] in its rows, linear between rows of a run; nan
    where none is known. Rows at their own time keep theirs."""
    names = [name for name in ("dl", "tension", "pos", "ext") if getattr(log, name) is not None]
    made = {name: getattr(log, name).copy() for name in names}
    for label in log.runs:
        own = (log.run == label) & np.isfinite(log.t)
        apart = own & (t != log.t)
        for values in made.values():
            for column in values.T:
                rows = own & np.isfinite(column)
                if rows.any():
                    column[apart] = np.interp(t[apart], log.t[rows], column[rows], left=np.nan, right=np.nan)
    return replace(log, **made)


def write_log(log: RunLog, path: str | Path, *, comment: str = "") -> None:
    """Write `log` to a .csv or .parquet, whole or not at all; `comment` heads a CSV, each line behind a #.

    `read_log` of the file gives the same numbers, bit for bit.
    """
    path = Path(path)
    columns = _columns(log)
    partial = path.with_name(path.name + ".part")
    table = None
    if path.suffix == ".parquet":
        table = arrow("pyarrow").table({name: np.asarray(cells) for name, cells in columns.items()})
        write_table = arrow("pyarrow.parquet").write_table
    file = partial.open("wb")
    try:
        with file, TextIOWrapper(file, encoding="utf-8", newline="") as text:
            if table is not None:
                write_table(table, file)
            else:
                text.writelines(f"# {line}\n" for line in comment.splitlines())
                writer = csv.writer(text, lineterminator="\n")
                writer.writerow(columns)
                writer.writerows(zip(*(_texts(cells) for cells in columns.values()), strict=True))
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)  # it takes room on a disk that is full
        raise


def _columns(log: RunLog) -> Table:
    columns: Table = {"t": log.t}
    if log.runs != [""]:
        columns["run"] = log.run.tolist()
    if log.session is not None:
        columns["session"] = log.session.tolist()
    points = np.zeros((len(log), 0, 3)) if log.points is None else log.points
    if log.without_tip:
        points = np.concatenate([points, log.tip_position[:, None]], axis=1)
    point_names = [f"p{k}_{axis}" for k in range(1, points.shape[1] + 1) for axis in "xyz"]
    groups: list[tuple[Sequence[str], Floats | None]] = [
        (
            [f"{'dl' if log.tension is None else 'tension'}_{k}" for k in range(1, log.dl.shape[1] + 1)],
            log.commands,
        ),
        ([f"pos_{k}" for k in range(1, log.dl.shape[1] + 1)], log.pos),
        ([f"ext_{k}" for k in range(1, 1 + (0 if log.ext is None else log.ext.shape[1]))], log.ext),
        (TIP, None if log.without_tip else log.tip_position),
        (TIP_QUATERNION, log.tip_quaternion),
        (point_names, points.reshape(len(log), len(point_names))),
        (TIP_FORCE, log.tip_force),
        (("payload",), None if log.payload is None else log.payload[:, None]),
        (BASE_QUATERNION, log.base_quaternion),
    ]
    for names, values in groups:
        if values is not None:
            columns |= {name: values[:, k] for k, name in enumerate(names)}
    return columns | dict(log.extra)


def _texts(cells: Sequence[str] | Floats) -> Sequence[str]:
    if isinstance(cells, np.ndarray):
        return ["" if value != value else repr(value) for value in cells.tolist()]
    return cells


def _taken(cells: Sequence[str] | Floats, index: NDArray[np.int64]) -> Sequence[str] | Floats:
    return cells[index] if isinstance(cells, np.ndarray) else [cells[i] for i in index]
