"""Which samples no fit sees."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from fastrod.errors import LogError, UnknownNameError, nearest
from fastrod.identification.log.forward import LogSamples
from fastrod.logs.runlog import RunLog
from fastrod.types import Flags

_STRETCHES = 20  # of each run, of which every fourth is held out


def merged(logs: Sequence[RunLog]) -> RunLog:
    """Several logs of one robot as one, each run labelled by its log where there are several. Raises
    `LogError` where they differ."""
    if not logs:
        raise LogError("no log was given.")
    if len(logs) == 1:
        return logs[0]
    names = [log.name for log in logs]
    if len(set(names)) < len(names):
        raise LogError(
            f"two logs are named {next(n for n in names if names.count(n) > 1)!r}; rename one, so that "
            "their runs can be told apart."
        )
    if len({log.dl.shape[1] for log in logs}) > 1:
        raise LogError("the logs have different numbers of tendons; they must be of one robot.")
    if len({log.points.shape[1] for log in logs if log.points is not None}) > 1:
        raise LogError("the logs have different numbers of points; they must be of one robot.")
    optional = ("ext", "tip_quaternion", "points", "tip_force", "payload", "base_quaternion")
    columns: dict[str, Any] = {}
    for name in optional:
        pieces = [getattr(log, name) for log in logs]
        have = [span is not None for span in pieces]
        if all(have):
            columns[name] = np.concatenate(pieces)
        elif any(have) and name in ("payload", "tip_force"):
            width = () if name == "payload" else (3,)
            columns[name] = np.concatenate(
                [
                    np.zeros((len(log), *width)) if p is None else p
                    for p, log in zip(pieces, logs, strict=True)
                ]
            )
        elif any(have):
            has, lacks = (logs[have.index(flag)].name for flag in (True, False))
            raise LogError(
                f"log {has!r} has columns for {name}, log {lacks!r} has none; logs that share "
                "parameters need the same columns."
            )
    labels = [np.array([f"{log.name}:{label}" if label else log.name for label in log.run]) for log in logs]
    return RunLog(
        name=" + ".join(names),
        t=np.concatenate([log.t for log in logs]),
        run=np.concatenate(labels),
        dl=np.concatenate([log.dl for log in logs]),
        tip_position=np.concatenate([log.tip_position for log in logs]),
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
