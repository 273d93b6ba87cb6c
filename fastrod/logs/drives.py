"""Positions of the drives beside their commands: logs that hold measured positions of the drives (`pos_k`)
beside the commands (`dl_k`)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fastrod.logs.runlog import RunLog
from fastrod.types import Flags, Floats

_LONGEST = 1.0  # s, of the lag that is looked for
_STEPS = 101
_FEW = (
    0.05  # of its command: a drive that does as much more or less, or stays as far away, is worth a sentence
)


def moved(log: RunLog) -> RunLog:
    """The log with the measured positions of its drives in place of the commands, in the runs that have them;
    rows that lack them are not driven there.

    Positions are read late, by a bus and a clock of their own, and by how much no log says. So each run's are
    laid on its commands: what all of its drives have in common of a lag is left out, and counts as the delay
    of the model (`latency`), as it does without measured positions.
    """
    if log.pos is None:
        return log
    dl = log.dl.copy()
    for _, rows in _runs(log):
        dl[rows] = _shifted(log, rows, _lag(log, rows))
    return replace(log, dl=dl, pos=None)


def sentences(log: RunLog) -> list[str]:
    """Return what the drives of each run did of their commands, where it is less or more than these."""
    said = []
    for label, rows in _runs(log):
        lag, dl = _lag(log, rows), log.dl[rows]
        gain, left = _lines(dl, _shifted(log, rows, lag))
        size = np.nanstd(dl, axis=0)
        # antagonists of one drive move alike
        drives = np.sort(np.unique(np.abs(np.nan_to_num(dl)), axis=1, return_index=True)[1])
        pieces = [
            f"tendon {k + 1} {gain[k]:.2f} of its command, {1e3 * left[k]:.2g} mm rms off that"
            for k in drives
            if size[k] > 0.0 and (abs(gain[k] - 1.0) > _FEW or left[k] > _FEW * size[k])
        ]
        name = f" of run {label!r}" if label and len(log.runs) > 1 else ""
        said.append(
            f"the drives' measured positions{name} move the model, {1e3 * lag:.0f} ms earlier than they were "
            f"read: {'; '.join(pieces) or 'as commanded'}"
        )
    return said


def _runs(log: RunLog) -> list[tuple[str, Flags]]:
    """Label and rows (n,) of each run that has positions."""
    assert log.pos is not None
    known = np.isfinite(log.pos).all(axis=1) & np.isfinite(log.t) & np.isfinite(log.dl).all(axis=1)
    each = [(label, log.run == label) for label in log.runs]
    return [(label, rows) for label, rows in each if (rows & known).any()]


def _shifted(log: RunLog, rows: Flags, lag: float) -> Floats:
    """(n_rows, n_tendons) positions that are read `lag` [s] after each of the rows; nan at rows without."""
    assert log.pos is not None
    t, pos = log.t[rows], log.pos[rows]
    known = np.isfinite(pos).all(axis=1) & np.isfinite(t)
    later = np.stack([np.interp(t + lag, t[known], column) for column in pos[known].T], axis=1)
    return np.where(known[:, None], later, np.nan)


def _lag(log: RunLog, rows: Flags) -> float:
    """By how much the positions of a run are behind its commands, all drives together [s]."""
    lags = np.linspace(0.0, _LONGEST, _STEPS)
    left = [(_lines(log.dl[rows], _shifted(log, rows, lag))[1] ** 2).sum() for lag in lags.tolist()]
    return float(lags[int(np.argmin(left))])


def _lines(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Slope of each column of `y` over that of `x` (n, k), least squares with an offset, and what it leaves,
    rms; 1 where `x` never changes."""
    known = np.isfinite(x).all(axis=1) & np.isfinite(y).all(axis=1)
    a, b = x[known] - x[known].mean(0), y[known] - y[known].mean(0)
    size = (a**2).sum(0)
    slope = np.where(size > 0.0, (a * b).sum(0) / np.where(size > 0.0, size, 1.0), 1.0)
    return slope, np.asarray(np.sqrt(((b - slope * a) ** 2).mean(0)))
