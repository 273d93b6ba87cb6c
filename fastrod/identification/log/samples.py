"""The rows of a log as samples in the order in which they happened: what a loss looks at, and what a memory
goes through."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, product

import numpy as np

from fastrod.identification.log.camera import earlier, pictures, unmeasured
from fastrod.logs.drives import moved
from fastrod.logs.runlog import RunLog
from fastrod.types import Floats, Ints

_SOON = 10.0  # s
_FEW = 2000  # rows, beside which memories may take long
_APART, _MOVED, _STRAIGHT = 0.02, 0.01, 1e-4  # s; of the largest command
_GAP = 3.0  # times the usual time between two rows of a run


@dataclass(frozen=True, eq=False)
class LogSamples:
    """The driven rows of a log in the order in which they happened, and which of them the loss looks at."""

    log: RunLog
    """Only driven rows that have a time."""
    origin: Ints
    """(n,) their rows in the log that was given; of the end of a gap that of the row before it. A row whose
    picture was taken before it is two: one at the time of the picture, and one that is not measured."""
    rows: Ints
    """(n_rows,) samples that are solved and compared."""
    runs: tuple[slice, ...]
    """Samples of each run."""
    time: Floats
    """(n,) since the start of its run [s]."""
    dt: Floats
    """(n,) since the sample before; 0 at the start of a run, unless it continues the run before [s]."""
    session: Ints
    """(n,) number of each sample's session."""
    sessions: tuple[str, ...]
    """Their labels, that of most samples first; ("",) of a log without."""
    step: float
    """Usual time from one row of the log to the next [s]; 0 where no two have times of their own."""

    @property
    def given(self) -> Ints:
        """Samples that stand for rows of the log, measured ones for their pictures; not the ends of gaps."""
        return np.flatnonzero(np.diff(self.origin, prepend=-1))

    @property
    def histories(self) -> tuple[slice, ...]:
        """Samples over which a memory goes on: of each run, with the runs that continue it."""
        starts = [span.start for span in self.runs if not self.dt[span.start]]
        return tuple(slice(*ends) for ends in pairwise([*starts, len(self.dt)]))

    def histories_of(self, session: int) -> list[slice]:
        """Those of one session, by its number."""
        return [span for span in self.histories if self.session[span.start] == session]

    def on(self, rows: Ints) -> LogSamples:
        """The same samples, compared at other rows."""
        return replace(self, rows=rows)

    @cached_property
    def short(self) -> LogSamples:
        """The same without samples that no memory misses, where few rows are compared: samples between two
        that are within 20 ms and 1 % of the largest command of each other, where commands go straight from
        one to the other. A log of 500 Hz is a quarter of itself so, or less; one of 50 Hz stays as it is."""
        dl, few = self.log.pulls, 0 < len(self.rows) < min(_FEW, len(self.time) // 2)
        if self.step >= _APART or not few or not dl.any():
            return self
        largest = np.abs(dl).max()
        path = np.cumsum(np.abs(np.diff(dl, axis=0, prepend=dl[:1])).max(1)) / largest
        every = np.floor(self.time / _APART) + np.floor(path / _MOVED)
        kept = np.diff(every, prepend=np.nan) != 0.0
        kept[self.rows] = True
        for span in self.runs:
            kept[[span.start, span.stop - 1]] = True
        while True:
            bent = np.zeros(len(kept), bool)
            for s, column in product(self.runs, dl.T):
                between = np.interp(self.time[s], self.time[s][kept[s]], column[s][kept[s]])
                bent[s] |= ~kept[s] & (np.abs(between - column[s]) > _STRAIGHT * largest)
            if not bent.any():
                break
            kept |= bent
        some = np.flatnonzero(kept)
        spans = (np.searchsorted(some, [span.start, span.stop]).tolist() for span in self.runs)
        return replace(
            self,
            log=self.log.rows(some),
            origin=self.origin[some],
            rows=np.searchsorted(some, self.rows),
            runs=tuple(slice(*ends) for ends in spans),
            time=self.time[some],
            dt=np.diff(np.cumsum(self.dt)[some], prepend=0.0),
            session=self.session[some],
        )


def sample(log: RunLog, rows: Ints | None = None) -> LogSamples:
    """The samples of a log, moved by its drives where these were measured; runs that are interleaved are put
    one after the other. A gap in time is a hold: its inputs stay as they were up to one step before it
    ends."""
    log, late = pictures(moved(log))
    used = np.flatnonzero(log.driven & np.isfinite(log.t))
    order = np.concatenate([used[log.run[used] == label] for label in log.runs]) if len(used) else used
    ordered, order = _held(log.rows(order), order)
    steps = np.diff(ordered.t)[ordered.run[1:] == ordered.run[:-1]]
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    ordered, order = _pictured(ordered, order, late)
    starts = np.flatnonzero(np.concatenate([[True], ordered.run[1:] != ordered.run[:-1]]))
    ends = [*starts[1:].tolist(), len(ordered)]
    runs = tuple(slice(int(a), b) for a, b in zip(starts, ends, strict=True))
    time, dt = np.empty(len(ordered)), np.zeros(len(ordered))
    t, dl = ordered.t, ordered.commands
    session = np.full(len(ordered), "") if ordered.session is None else ordered.session
    largest = max((np.abs(np.diff(dl[span], axis=0)).max(initial=0.0) for span in runs), default=0.0)
    for span in runs:
        first = span.start
        time[span] = t[span] - t[first]
        dt[first + 1 : span.stop] = np.diff(t[span])
        # a run goes on where the one before ends: soon after it, and the commands do not jump
        jump = np.abs(dl[first] - dl[first - 1]).max(initial=0.0)
        same = bool(first) and session[first] == session[first - 1]
        if same and 0.0 < t[first] - t[first - 1] <= _SOON and jump <= largest:
            dt[first] = t[first] - t[first - 1]
    measured = np.flatnonzero(ordered.measured) if rows is None else rows
    labels, number, count = np.unique(session, return_inverse=True, return_counts=True)
    largest_first = np.argsort(-count, kind="stable")
    return LogSamples(
        ordered,
        order,
        measured,
        runs,
        time,
        dt,
        np.argsort(largest_first)[number],
        tuple(labels[largest_first].tolist()),
        usual,
    )


def _pictured(log: RunLog, order: Ints, late: Floats) -> tuple[RunLog, Ints]:
    """The log with each picture that had waited for its row in one of its own, before that row, and the
    `order` (n,) likewise; `late` is of the rows of the log that was given."""
    late = np.where(log.measured, late[order], 0.0)
    rows = np.flatnonzero(late)
    if not len(rows):
        return log, order
    both = np.insert(np.arange(len(log)), rows, rows)
    pictures = rows + np.arange(len(rows))
    waits, own = np.zeros(len(both)), np.zeros(len(both), bool)
    waits[pictures], own[pictures + 1] = late[rows], True
    return unmeasured(earlier(log.rows(both), waits), own), order[both]


def _held(log: RunLog, order: Ints) -> tuple[RunLog, Ints]:
    """The log with one more row where each gap ends, as before it and not measured; and the `order` (n,)
    likewise."""
    dt = np.where(log.run[1:] == log.run[:-1], np.diff(log.t), 0.0)
    usual = {
        label: np.median(own) for label in log.runs if len(own := dt[(log.run[1:] == label) & (dt > 0.0)])
    }
    step = np.array([usual.get(label, np.inf) for label in log.run[1:]])
    before = np.flatnonzero(dt > _GAP * step)
    if not len(before):
        return log, order
    both = np.insert(np.arange(len(log)), before + 1, before)
    ends = before + 1 + np.arange(len(before))
    made = log.rows(both)
    t, tip = made.t.copy(), made.tip_position.copy()
    t[ends], tip[ends] = log.t[before + 1] - step[before], np.nan
    return replace(made, t=t, tip_position=tip), order[both]
