"""Logs of one robot as one, and which of its samples a fit may see."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fastrod.errors import LogError, UnknownNameError, nearest
from fastrod.identification.log import camera
from fastrod.identification.log.inputs import check_driven
from fastrod.identification.log.motion import let_go
from fastrod.identification.log.samples import LogSamples, sample
from fastrod.logs import drives
from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Robot
from fastrod.types import Flags, Ints

_LEAST_ROWS = 40
_STRETCHES = 20  # of each run, of which every fourth is held out
_MISSING: dict[str, Callable[[RunLog], Any]] = {  # of a log that lacks it beside others that do not
    "session": lambda log: np.full(len(log), log.name),
    "pos": lambda log: np.full(log.dl.shape, np.nan),
    "tip_force": lambda log: np.zeros((len(log), 3)),
    "payload": lambda log: np.zeros(len(log)),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class SplitLog:
    """The samples of a log, those for fits and those for tests."""

    samples: LogSamples
    """Compared at every measured row."""
    rows: Ints
    """Samples that may be fitted."""
    tested: Flags
    """(n,) samples that no fit sees."""
    labels: Sequence[str]
    """Names of these rows, in words."""
    notes: Sequence[str] = ()
    """Differences between the drives' positions and their commands, where they were measured, and rows that
    repeat, in sentences."""
    swings: SplitLog | None = None
    """The same of runs that were let go from where they turn back, for a fit in motion; None where none was,
    or where the robot has no mass."""


def split(logs: Sequence[RunLog], robot: Robot, held_out: Sequence[str]) -> SplitLog:
    """The samples of `logs` of `robot`; `held_out` as for `held_out_rows`. Raises `LogError` where they
    cannot tell anything, `InputError` for a robot that is driven by lengths and by forces."""
    log = merged(logs)
    check_driven(log, robot)
    for label in log.runs if log.session is not None else []:
        named = np.unique(np.asarray(log.session)[log.run == label]).tolist()
        if len(named) > 1:
            raise LogError(
                f"run {label!r} of log {log.name!r} is of sessions {named[0]!r} and {named[1]!r}; a run is "
                "of one session."
            )
    if not log.driven.any():
        raise LogError(
            f"log {log.name!r} has no row in which every input is there; there is nothing to "
            "drive the model with."
        )
    cut = let_go(log)
    swings = cut is not log and all(s.line_density > 0.0 for s in robot.segments)
    whole = _cut(log, robot, held_out, swings)
    return replace(whole, swings=_cut(cut, robot, held_out, swings)) if swings else whole


def _cut(log: RunLog, robot: Robot, held_out: Sequence[str], swings: bool) -> SplitLog:
    samples = sample(log)
    check_log(samples, robot, swings)
    tested, labels = held_out_rows(samples, held_out)
    rows = samples.rows[~tested[samples.rows]]
    if len(rows) < _LEAST_ROWS:
        raise LogError(
            f"log {log.name!r} leaves {len(rows)} rows to fit once {', '.join(labels)} are held "
            f"out; it needs {_LEAST_ROWS}."
        )
    said = [*camera.sentences(log), *([] if log.pos is None else drives.sentences(log))]
    return SplitLog(samples=samples, rows=rows, tested=tested, labels=labels, notes=said)


def thinned(rows: Ints, most: int) -> Ints:
    """At most so many of the rows, evenly."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).round().astype(int)]


def merged(logs: Sequence[RunLog]) -> RunLog:
    """Several logs of one robot as one, each run labelled by its log where there are several. Raises
    `LogError` where they differ."""
    if not logs:
        raise LogError("no log was given.")
    if len(logs) == 1:
        return logs[0]
    names = [log.name for log in logs]
    own = [(log.name, run) for log in logs for run in log.runs]
    if twice := [name for i, (name, run) in enumerate(own) if (name, run) in own[:i]]:
        raise LogError(
            f"two logs are named {twice[0]!r}; rename one, so that their runs can be distinguished."
        )
    if len({log.dl.shape[1] for log in logs}) > 1:
        raise LogError("the logs have different numbers of tendons; they must be of one robot.")
    if len({log.points.shape[1] for log in logs if log.points is not None}) > 1:
        raise LogError("the logs have different numbers of points; they must be of one robot.")
    if len({log.without_tip for log in logs}) > 1:
        raise LogError(
            "some logs have a measured tip and others have none; give those with the same columns."
        )
    columns: dict[str, Any] = {}
    for name in (*_MISSING, "tension", "ext", "tip_quaternion", "points", "base_quaternion"):
        pieces = [getattr(log, name) for log in logs]
        have = [span is not None for span in pieces]
        if any(have) and not all(have) and name not in _MISSING:
            has, lacks = (logs[have.index(flag)].name for flag in (True, False))
            raise LogError(
                f"log {has!r} has columns for {name}, log {lacks!r} has none; logs that share "
                "parameters need the same columns."
            )
        if any(have):
            columns[name] = np.concatenate(
                [_MISSING[name](log) if p is None else p for p, log in zip(pieces, logs, strict=True)]
            )
    labels = [np.array([f"{log.name}:{label}" if label else log.name for label in log.run]) for log in logs]
    return RunLog(
        name=" + ".join(dict.fromkeys(names)),
        t=np.concatenate([log.t for log in logs]),
        run=np.concatenate(labels),
        dl=np.concatenate([log.dl for log in logs]),
        tip_position=np.concatenate([log.tip_position for log in logs]),
        without_tip=logs[0].without_tip,
        **columns,
    )


def held_out_rows(samples: LogSamples, held_out: Sequence[str]) -> tuple[Flags, list[str]]:
    """(n,) samples that are held out, and what they are in words.

    Each of `held_out` is the label of a run, or `RUN@START:END` in seconds of the run's own time (`@60:` is
    from 60 s on; the run may be left out where there is one). Without any: every fourth of twenty stretches
    of each run.
    """
    log = samples.log
    mask = np.zeros(len(log), bool)
    if not held_out:
        for span in samples.runs:
            n = span.stop - span.start
            mask[span] = (np.arange(n) * _STRETCHES // n) % 4 == 2
        return mask, [f"every fourth of {_STRETCHES} stretches of each run"]
    for text in map(str, held_out):  # numpy's words quote as np.str_(...)
        label, _, window = text.partition("@")
        if label and label not in log.runs:
            named = [run for run in log.runs if run]
            if not named:
                raise UnknownNameError(
                    f"no run {label!r} to hold out; log {log.name!r} names no runs: give "
                    "a time, as in '@60:'."
                )
            raise UnknownNameError(
                f"no run {label!r} to hold out in log {log.name!r}; {nearest(label, named)}"
            )
        rows = (log.run == label) if label else np.ones(len(log), bool)
        if window:
            match = re.fullmatch(r"(\d*\.?\d+|\d+\.|):(\d*\.?\d+|\d+\.|)", window)
            if match is None:
                raise LogError(
                    f"held-out {text!r} is no stretch of time; write RUN@START:END in seconds, "
                    f"for example {label}@90:150."
                )
            start, end = (
                float(span) if span else edge
                for span, edge in zip(match.groups(), (-np.inf, np.inf), strict=True)
            )
            rows = rows & (samples.time >= start) & (samples.time < end)
        if not rows.any():
            raise LogError(
                f"held-out {text!r} has no samples; the log's runs last to {samples.time.max():g} s."
            )
        mask |= rows
    if mask[samples.rows].all():
        raise LogError(f"everything in log {log.name!r} is held out; leave something to fit.")
    return mask, list(map(str, held_out))


def check_log(samples: LogSamples, robot: Robot, swings: bool = False) -> None:
    """A log that cannot tell anything is refused in a sentence; one of a robot that `swings` tells something
    without inputs."""
    log = samples.log
    measured = int(log.measured.sum())
    if measured == 0:
        raise LogError(
            f"log {log.name!r} has no row in which every input and the tip are there; there is "
            "nothing to explain."
        )
    if measured < _LEAST_ROWS:
        raise LogError(
            f"log {log.name!r} has {measured} measured rows; identification needs {_LEAST_ROWS} "
            "at least, better two thousand."
        )
    if not (np.ptp(log.inputs, axis=0) > 1e-9).any() and not swings:
        raise LogError(
            f"in log {log.name!r} no input ever changes; nothing can be learnt from it. fastrod "
            "excite writes a run that does."
        )
    if float(np.ptp(np.asarray(log.tip_position)[log.measured], axis=0).max()) < 1e-7 * robot.length:
        raise LogError(f"in log {log.name!r} the measured tip never moves; is the camera's column filled?")
