"""Rows of a log that no sensor measured: those of a camera that is slower than the log repeat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fastrod.logs.runlog import RunLog
from fastrod.types import Flags, Floats

_FINEST = 1e-9  # m; less between two values is rounding
_WHOLE = 0.01  # of a step of the resolution, by which values may be off it
_CLEAR = 3.0  # steps of the resolution: less is no jump
_FEW = 10  # jumps, and values of a column
_SOME = 0.005  # of the rows: less is not worth a sentence
_CAUGHT_UP = 0.75  # of how far the tip usually goes with the commands


def resolution(values: Floats) -> Floats:
    """(k,) step to which the columns of `values` (n, k) [m] are rounded; 0 where to none."""
    steps = np.zeros(values.shape[1])
    for k, column in enumerate(values.T):
        apart = np.diff(np.unique(column[np.isfinite(column)]))
        apart = apart[apart > _FINEST]
        if len(apart) >= _FEW:
            many = apart / apart.min()
            steps[k] = apart.min() if np.abs(many - np.round(many)).max() < _WHOLE else 0.0
    return steps


def fresh(log: RunLog) -> RunLog:
    """The log without what its camera repeats: tip, points and orientation are nan there."""
    old, measured, commands, inputs = np.zeros(len(log), bool), log.measured, log.commands, log.inputs
    for label in log.runs:
        rows = np.flatnonzero(measured & (log.run == label))
        old[rows] = repeated(log.tip_position[rows], commands[rows], inputs[rows])
    if not old.any():
        return log

    def without(seen: Floats) -> Floats:
        return np.where(old.reshape(-1, *[1] * (seen.ndim - 1)), np.nan, seen)

    return replace(
        log,
        tip_position=without(log.tip_position),
        tip_quaternion=None if log.tip_quaternion is None else without(log.tip_quaternion),
        points=None if log.points is None else without(log.points),
    )


def sentences(log: RunLog) -> list[str]:
    """Return how many rows of its camera repeat, if that are some."""
    every = int(log.measured.sum())
    n = every - int(fresh(log).measured.sum())
    said = (
        f"{n} of {every} rows repeat the measured tip of the row before, whatever the commands do: the "
        "camera is slower than the log, and they do not count; a row for each picture, at its time, says more"
    )
    return [said] * (n > _SOME * every)


def repeated(tip: Floats, commands: Floats, inputs: Floats) -> Flags:
    """(n,) rows of a run in which the measured `tip` (n, 3) [m] is that of the row before, for the camera has
    seen nothing since. Of a tip that is rounded, those alone in which any of the `inputs` (n, k) has moved
    since, of which the `commands` (n, m) are some.

    What such a camera sees next is as far away as the commands have gone since it saw something. That of a
    robot that stands still by friction or backlash is not, and that of one whose tip is rounded is next to
    it.
    """
    rows, new = np.arange(len(tip)), np.ones(len(tip), dtype=np.bool_)
    new[1:] = (tip[1:] != tip[:-1]).any(axis=1)
    seen = np.maximum.accumulate(np.where(new, rows, 0))  # the row that each one shows
    ends = np.flatnonzero(new)[1:]
    before = seen[ends - 1]
    jump = np.linalg.norm(tip[ends] - tip[before], axis=1)
    went = np.linalg.norm(commands[ends] - commands[before], axis=1)
    step = float(np.linalg.norm(resolution(tip)))
    clear = jump > _CLEAR * step
    held = clear & (ends - before > 1)
    going, moved = (np.cumsum(np.diff(a, axis=0, prepend=a[:1]).any(axis=1)) for a in (commands, inputs))
    # after a rest a robot that is late repeats, too
    sure = held & (went > 0.0) & (going[ends] - going[before] == ends - before)
    once = clear & (went > 0.0) & ~held
    late, usual = jump[sure] / went[sure], jump[once] / went[once]
    # a tip that is rounded may be the same by chance, once or twice
    few = not len(late) or len(late) + len(usual) * (not step) < _FEW
    if few or (len(usual) > len(late) and np.median(late) < _CAUGHT_UP * np.median(usual)):
        return np.zeros(len(tip), dtype=np.bool_)
    if not step:  # no two measurements are the same, at rest neither
        return ~new
    slow = np.isin(seen, [*before[held].tolist(), seen[-1]])  # what the last one would be is not known
    return np.asarray(slow & (moved > moved[seen]))
