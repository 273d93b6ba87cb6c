"""Recording: the readings of a session as a run log, on disk row by row, so that a killed session loses
nothing."""

from __future__ import annotations

import csv
import io
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from io import FileIO
from pathlib import Path
from threading import Lock
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.errors import InputError, LogError, nearest
from fastrod.logs.linefile import append_lines, is_at, made_again
from fastrod.logs.link import Measurement
from fastrod.logs.runlog import RunLog, write_log
from fastrod.logs.table import numbers, read_table
from fastrod.model.robot import Robot
from fastrod.types import Floats

_TIP = ("tip_x", "tip_y", "tip_z")
_TIP_QUATERNION = ("tip_qw", "tip_qx", "tip_qy", "tip_qz")
_TIP_FORCE = ("tip_fx", "tip_fy", "tip_fz")
_BASE_QUATERNION = ("base_qw", "base_qx", "base_qy", "base_qz")
_ALWAYS = ("t", "run", *_TIP, *_TIP_QUATERNION, *_TIP_FORCE, "payload", *_BASE_QUATERNION)
"""Columns of every recording."""
_KNOWN = r"t|run|payload|tip_(q?[xyz]|qw|f[xyz])|base_q[wxyz]|(dl|ext|cmd_dl|tension)_\d+|p\d+_[xyz]"
"""Names of columns that are a recorder's own, or a run log's."""
_QUATERNION_SLACK = 1e-2  # what `read_log` allows
# last places of one component: dividing by the norm alone need not end at norm 1
_NUDGES = (1, -1, 2, -2, 3, -3, 4, -4)


@final
class Recorder:
    """Readings as the rows of a `RunLog`.

    Each row goes to PATH.part at once, in one write to the operating system: a process that is killed loses
    none. Rows are not forced onto the disk itself (fsync), so a machine that loses power may lose the last
    seconds. `stop` writes the finished log to PATH and removes PATH.part; what a killed session leaves,
    `recover` makes a log of. Where PATH.part is removed or renamed, or its folder is, the next row notices:
    all rows are written again at PATH, or, where that cannot be, in the system's temporary folder. Rows
    without a measured tip are kept. Commands (cmd_dl_1 ...), tensions (tension_1 ...) and `extra` are kept as
    further columns. May be used from several threads.
    """

    def __init__(
        self,
        robot: Robot,
        path: str | Path | None = None,
        *,
        overwrite: bool = False,
        extra: Sequence[str] = (),
        on_move: Callable[[str], None] | None = None,
    ) -> None:
        """Record `robot` to the .csv or .parquet at `path`, or, where it is None, in memory alone; `extra`
        names further columns of numbers. `on_move` is called where rows had to be written again, with a
        sentence: where they are, how many.

        Raises `InputError` where the path cannot be one, or, but for `overwrite`, where a file or a left-over
        PATH.part is there; where a name of `extra` is taken, given twice, or none.
        """
        self.robot = robot
        self.extra = _names(extra)
        """Names of the further columns."""
        self.path = None if path is None else _checked(Path(path), overwrite)
        """Path of the log; another than was given where that could not be kept."""
        self.moved = ""
        """Why rows were written again, and where they are, one sentence; empty where that was not needed."""
        self._on_move = on_move
        n = range(1, robot.n_tendons + 1)
        extends = any(segment.extension != (0.0, 0.0) for segment in robot.segments)
        self._ext = robot.n_segments if extends else 0
        self._columns = [
            "t",
            "run",
            *(f"dl_{k}" for k in n),
            *(f"ext_{k}" for k in range(1, self._ext + 1)),
            *_TIP,
            *_TIP_QUATERNION,
            *_TIP_FORCE,
            "payload",
            *_BASE_QUATERNION,
            *(f"cmd_dl_{k}" for k in n),
            *(f"tension_{k}" for k in n),
            *self.extra,
        ]
        self._rows: list[list[float]] = []
        self._labels: list[str] = []
        self._lock = Lock()
        self._file: FileIO | None = None
        self._on_disk = 0
        self._run = ""
        self._runs: list[str] = []
        self._start = self._last = 0.0
        self._recording = self._done = False

    @property
    def recording(self) -> bool:
        """Between `start` and `stop`."""
        return self._recording

    def __len__(self) -> int:
        """Rows so far."""
        return len(self._rows)

    def start(self, t: float, run: str = "") -> None:
        """Begin at the robot's time `t` [s], which is 0 in the log; or, while recording, begin another run,
        labelled `run`.

        Raises `InputError` for a label that is taken, for a log that is written already, and where PATH.part
        cannot be made.
        """
        label = run.strip()
        with self._lock:
            if self._done and self.path is not None:
                raise InputError(f"{self.path.name} is written; record the next session to another file.")
            if self._recording and label in self._runs:
                raise InputError(f"run {label!r} is recorded already; give the next one another name.")
            if not np.isfinite(t):
                raise InputError(f"a recording begins at t = {t!r}; it must be a finite time [s].")
            if re.search(r"[\r\n]", label):
                raise InputError(f"run {label!r} has a line break; a label is one line.")
            if not self._recording:
                self._rows, self._labels, self._runs = [], [], []
                self._open()
            self._run, self._start, self._last = label, float(t), -np.inf
            self._runs.append(label)
            self._recording = True

    def add(
        self,
        measurement: Measurement,
        *,
        tip_force: ArrayLike | None = None,
        payload: float = 0.0,
        commanded_dl: ArrayLike | None = None,
        base_quaternion: ArrayLike | None = None,
        extra: Mapping[str, float] | None = None,
    ) -> bool:
        """Append a reading and return whether it was new: one from before the start, or the same one again,
        is left out.

        `tip_force` (3,) known force on the tip, base frame [N], None for none; `payload` known mass at the
        tip [kg]; nan where a load is not known. `commanded_dl` (n_tendons,) [m], None where nothing was
        commanded. `base_quaternion` (4,) world_from_base, w x y z, None where it is not needed: a log keeps
        it if any row has it. `extra` numbers of the further columns; what is not given is nan. Raises
        `InputError` for a reading of another robot, for an `extra` that was not named before, for a clock
        that runs back, and where the row cannot be written.
        """
        n = self.robot.n_tendons
        more = {} if extra is None else extra
        for name in more:
            if name not in self.extra:
                raise InputError(f"no column {name!r} is recorded; {nearest(str(name), self.extra)}")
        groups: list[tuple[str, Any, int]] = [
            ("dl", measurement.dl, n),
            ("ext", measurement.ext if self._ext else [], self._ext),
            ("tip", measurement.tip_position, 3),
            ("tip quaternion", measurement.tip_quaternion, 4),
            ("tip_force", np.zeros(3) if tip_force is None else tip_force, 3),
            ("payload", [payload], 1),
            ("base_quaternion", np.full(4, np.nan) if base_quaternion is None else base_quaternion, 4),
            ("commanded_dl", np.full(n, np.nan) if commanded_dl is None else commanded_dl, n),
            ("tension", measurement.tension, n),
            ("extra", [more.get(name, np.nan) for name in self.extra], len(self.extra)),
        ]
        values = []
        for name, given, size in groups:
            try:
                row = np.asarray(given, dtype=np.float64)
            except (TypeError, ValueError, OverflowError) as error:
                raise InputError(f"{name} of the reading is {given!r}; it must be numbers.") from error
            if row.shape != (size,):
                raise InputError(
                    f"{name} of the reading has shape {row.shape}; robot {self.robot.name!r} needs ({size},)."
                )
            if name == "base_quaternion" and abs(np.linalg.norm(row) - 1.0) > _QUATERNION_SLACK:
                raise InputError(
                    f"base_quaternion of the reading is {row.tolist()}, of norm "
                    f"{np.linalg.norm(row):.6g}; it must be 1."
                )
            values.append(np.where(np.isfinite(row), row, np.nan))
        with self._lock:
            if not self._recording:
                raise InputError("nothing is being recorded; start first.")
            t = float(measurement.t) - self._start
            if not np.isfinite(t):
                raise InputError(f"the reading has t = {measurement.t!r}; a row needs a finite time [s].")
            if t < self._last:
                raise InputError(
                    f"the robot's clock ran back, from {self._last:g} s to {t:g} s of the "
                    "recording; start another run."
                )
            if t < 0.0 or t == self._last:
                return False
            self._last = t
            self._rows.append([t, *np.concatenate(values).tolist()])
            self._labels.append(self._run)
            if self._file is not None and self.path is not None:
                try:
                    append_lines(self._file, self._row(-1))
                    self._on_disk += 1
                except OSError as error:
                    if is_at(self._file, _partial(self.path)):
                        why = f"{self.path.name}.part cannot be written: {error.strerror or error}"
                        raise InputError(f"{why}; {self._kept()}.") from error
                self._stay()
            return True

    def stop(self) -> RunLog:
        """End the recording and return the log, written to the path where there is one.

        Raises `InputError` where nothing is recorded, or where the log cannot be written; it says how many
        rows are in PATH.part then. Where they are in no file, it may be called again.
        """
        with self._lock:
            # an open file that nothing is recorded to: no place took its rows when it was stopped before
            if not self._recording and (self._file is None or not self._rows):
                raise InputError("nothing is being recorded; start first.")
            self._recording = False
            self._stay()
            kept = self._kept()
            self._close()
            if not self._rows:
                if self.path is not None:
                    _partial(self.path).unlink(missing_ok=True)
                raise InputError("no reading came in while recording; there is nothing to keep.")
            log = _log(
                self._columns,
                self._labels,
                np.array(self._rows),
                "session" if self.path is None else self.path.stem,
            )
            if self.path is not None:
                _finish(log, self.path, f"Recorded on robot {self.robot.name}.", kept)
                self._done = True
            return log

    def _open(self) -> None:
        self._close()
        if self.path is None:
            return
        try:
            self._file = _partial(self.path).open("wb", buffering=0)
            append_lines(self._file, self._head())
        except OSError as error:
            raise InputError(f"{str(self.path)!r} cannot be written: {error.strerror or error}.") from error
        self._on_disk = 0

    def _head(self) -> str:
        return f"# Recorded on robot {' '.join(self.robot.name.split())}.\n" + _line(self._columns)

    def _row(self, k: int) -> str:
        return _line([_text(self._rows[k][0]), self._labels[k], *map(_text, self._rows[k][1:])])

    def _stay(self) -> None:
        """Write all rows again if the file is no longer at its path. Raises `InputError`."""
        if (
            not self._rows
            or self._file is None
            or self.path is None
            or is_at(self._file, _partial(self.path))
        ):
            return
        lost, why = f"{self.path.name}.part was removed or renamed while it was recorded", ""
        for path in (self.path, Path(tempfile.gettempdir()) / self.path.name):
            try:
                target = free_path(path) if _partial(path).exists() or path is not self.path else path
                rows = "".join(map(self._row, range(len(self._rows))))
                file = made_again(_partial(target), self._head() + rows)
            except OSError as error:
                why = why or f"{str(path)!r} cannot be written: {error.strerror or error}"
                continue
            self._file.close()
            self._file, self.path, self._on_disk = file, target, len(self._rows)
            where = f"all {len(self._rows)} rows are in {str(_partial(target))!r} now"
            self.moved = f"{lost}; {where}, and more go there."
            if self._on_move is not None:
                self._on_move(self.moved)
            return
        self._on_disk = 0
        raise InputError(f"{lost}, and {why}; {self._kept()}.")

    def _kept(self) -> str:
        """Return a clause that says where the rows are, without a full stop."""
        if self.path is None or self._file is None or not is_at(self._file, _partial(self.path)):
            return f"its {len(self._rows)} rows are in no file"
        some = "" if self._on_disk == len(self._rows) else f"{self._on_disk} of "
        return f"{some}its {len(self._rows)} rows are in {_partial(self.path).name}"

    def _close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None


def recover(path: str | Path) -> RunLog:
    """Recover the log of a session that was killed: PATH, made of the PATH.part that it left (either may be
    given), which is then removed.

    A last row that was cut short is left out. Raises `LogError` where there is no PATH.part, or no whole row
    in it; `InputError` where PATH is there already or cannot be written.
    """
    path = Path(path)
    target = path.with_name(path.name.removesuffix(".part"))
    partial = _partial(target)
    if target.exists():
        raise InputError(f"{str(target)!r} is there already; rename it, then recover {partial.name}.")
    try:
        lines = partial.read_text(encoding="utf-8").splitlines(keepends=True)
    except (OSError, UnicodeDecodeError) as error:
        raise LogError(
            f"{str(partial)!r} cannot be recovered: {getattr(error, 'strerror', None) or error}."
        ) from error
    whole = lines if lines and lines[-1].endswith("\n") else lines[:-1]
    table = read_table(_rewritten(partial, whole)) if len(whole) != len(lines) else read_table(partial)
    if not table.get("t", ("",)):
        raise LogError(f"{partial.name} has no whole row; there is nothing to recover.")
    if missing := [name for name in _ALWAYS if name not in table]:
        raise LogError(f"{partial.name} is no recording: it lacks column {missing[0]}.")
    names = list(table)
    rows = np.stack([numbers(table, name, partial.name) for name in names if name != "run"], axis=1)
    log = _log(names, [str(label) for label in table["run"]], rows, target.stem)
    _finish(log, target, "Recovered from a session that did not end.", f"its rows are in {partial.name}")
    return log


def free_path(path: str | Path) -> Path:
    """Return `path`, or where it or its partial file is there already, the next free name: session.csv,
    session-2.csv, session-3.csv ..."""
    path = Path(path)
    stem, number, found = path.stem, 2, path
    while found.exists() or _partial(found).exists():
        found = path.with_name(f"{stem}-{number}{path.suffix}")
        number += 1
    return found


def _checked(path: Path, overwrite: bool) -> Path:
    if path.suffix not in (".csv", ".parquet"):
        raise InputError(f"{str(path)!r} does not end in .csv or .parquet; a run log does.")
    if not path.parent.is_dir():
        raise InputError(f"folder {str(path.parent)!r} is not there; make it, or record somewhere else.")
    if path.is_dir():
        raise InputError(f"{str(path)!r} is a folder; give the file to record to.")
    for taken, what in (
        (path, "is there already"),
        (_partial(path), "is what a session that did not end has left: recover it"),
    ):
        if taken.exists() and not overwrite:
            raise InputError(f"{str(taken)!r} {what}, or record to {free_path(path).name!r}.")
    return path


def _names(extra: Sequence[str]) -> tuple[str, ...]:
    if isinstance(extra, str):
        raise InputError(f"extra is {extra!r}; give a list of names of columns.")
    names = tuple(extra)
    for name in names:
        if not isinstance(name, str) or not name or name != name.strip() or re.search(r"[,\r\n]", name):
            raise InputError(
                f"extra column {name!r} is no name; give one line of text without commas, no space around it."
            )
        if re.fullmatch(_KNOWN, name):
            raise InputError(
                f"extra column {name!r} is a name that run logs have for something else; give another."
            )
        if names.count(name) > 1:
            raise InputError(f"extra column {name!r} is named twice; each name stands for one column.")
    return names


def _partial(path: Path) -> Path:
    return path.with_name(path.name + ".part")


def _rewritten(partial: Path, lines: Sequence[str]) -> Path:
    """`partial` with these lines alone, whole or not at all."""
    beside = partial.with_name(partial.name + ".whole")
    beside.write_text("".join(lines), encoding="utf-8")
    return beside.replace(partial)


def _finish(log: RunLog, path: Path, comment: str, kept: str) -> None:
    """Write `log` to `path` and remove the partial file; `kept` says where the rows are if that fails.

    `write_log` would begin by emptying PATH.part, which still holds the only copy.
    """
    beside = path.with_name(f"{path.stem}.whole{path.suffix}")
    try:
        write_log(log, beside, comment=comment)
        beside.replace(path)
        _partial(path).unlink(missing_ok=True)
    except OSError as error:
        beside.unlink(missing_ok=True)
        why = f"{str(path)!r} cannot be written: {error.strerror or error}"
        raise InputError(f"{why}; {kept}, see `recover`.") from error


def _log(names: Sequence[str], labels: Sequence[str], rows: Floats, name: str) -> RunLog:
    """The log of recorded columns: `names` with t and run, `rows` (n, len(names) - 1) without run."""
    column: Mapping[str, Floats] = dict(zip((name for name in names if name != "run"), rows.T, strict=True))

    def group(pattern: str | Sequence[str]) -> Floats:
        wanted = (
            pattern
            if not isinstance(pattern, str)
            else [name for name in names if re.fullmatch(pattern, name)]
        )
        return np.stack([column[name] for name in wanted], axis=1) if wanted else np.zeros((len(rows), 0))

    quaternion = group(_TIP_QUATERNION)
    force = group(_TIP_FORCE)
    payload = column["payload"]
    ext = group(r"ext_\d+")
    base = group(r"base_q[wxyz]")
    extra = {
        name: values
        for name, values in column.items()
        if not re.fullmatch(_KNOWN, name)
        or (re.fullmatch(r"(cmd_dl|tension)_\d+", name) and not np.isnan(values).all())
    }
    return RunLog(
        name=name,
        t=column["t"],
        run=np.array(labels, dtype=np.str_),
        dl=group(r"dl_\d+"),
        tip_position=group(_TIP),
        ext=ext if ext.shape[1] else None,
        tip_quaternion=None if np.isnan(quaternion).all() else _unit(quaternion),
        tip_force=force if (force != 0.0).any() else None,  # nan counts: a load that nobody knows is not none
        payload=payload if (payload != 0.0).any() else None,
        base_quaternion=None if np.isnan(base).all() else _unit(base),
        extra=extra,
    )


def _unit(quaternion: Floats) -> Floats:
    """(n, 4) of a norm that is 1 to the last bit: `read_log` scales by it, and must find what was
    recorded."""
    quaternion = quaternion / np.linalg.norm(quaternion, axis=1)[:, None]
    for ulps in _NUDGES:
        off = np.linalg.norm(quaternion, axis=1) != 1.0
        off &= np.isfinite(quaternion).all(axis=1)
        if not off.any():
            break
        for k in range(4):
            moved = quaternion[off]
            moved[:, k] += ulps * np.spacing(moved[:, k])
            better = np.linalg.norm(moved, axis=1) == 1.0
            rows = np.flatnonzero(off)[better]
            quaternion[rows], off[rows] = moved[better], False
    return quaternion


def _text(value: float) -> str:
    return "" if value != value else repr(value)


def _line(cells: Sequence[str]) -> str:
    made = io.StringIO()
    csv.writer(made, lineterminator="\n").writerow(cells)
    return made.getvalue()
