"""Pictures of a camera that is slower than the log: rows that repeat them, and when they were taken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fastrod.logs.runlog import RunLog, with_commands_at
from fastrod.types import Flags, Floats, Ints

_FINEST = 1e-9  # m; less between two values is rounding
_WHOLE = 0.01  # of a step of the resolution, by which values may be off it
_CLEAR = 3.0  # steps of the resolution: less is no jump
_FEW = 10  # jumps, and values of a column
_SOME = 0.005  # of the rows: less is not worth a sentence
_CAUGHT_UP = 0.75  # of how far the tip usually goes with the commands
_FAR = 20.0  # steps of the resolution: far more than rounding
_LINES = 0.2  # of the rows in which the tip moves: none, of one that nobody interpolated
_EVEN = 0.2  # of the usual step, by which rows come early or late
_SURE = 40  # pictures: fewer may come evenly by chance
_WAITS = 0.01, 0.4  # steps, rms, of pictures that come evenly: 0.29, and some are late themselves
_CLOCK = 0.23  # of the time between two pictures, rms; any times are off a clock by 0.29 of it


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


def pictures(log: RunLog) -> tuple[RunLog, Floats]:
    """The log with what its camera saw in the rows alone to which a picture came, nan in others; and (n,) for
    how long each picture had waited for its row [s].

    A camera that takes pictures evenly, out of step with rows that are even, too, gives each to the next row:
    the waits are what the rows' times have beyond an even clock. They are 0 where there is no such clock; of
    all alike nothing is known. Between pictures a tip may repeat, or be interpolated; lines between those
    say when they were taken.
    """
    old, late, tip = np.zeros(len(log), bool), np.zeros(len(log)), log.tip_position
    kinds = ("tip_position", "tip_quaternion", "points")
    made = {name: values.copy() for name in kinds if (values := getattr(log, name)) is not None}
    measured, commands, inputs = log.measured, log.commands, log.inputs
    used = log.driven & np.isfinite(log.t)
    for label in log.runs:
        rows = np.flatnonzero(used & (log.run == label))
        mine = np.flatnonzero(measured[rows])
        seen = rows[mine]
        new = _new(tip[seen])
        going = np.diff(commands[seen], axis=0, prepend=commands[seen[:1]]).any(axis=1)
        # no robot stands still by the clock, unless its commands do
        even = (going & ~new).sum() >= _FEW and _waits(log.t[seen], np.flatnonzero(new)).any()
        came = new if even else ~repeated(tip[seen], commands[seen], inputs[seen])
        waits = np.zeros(len(seen))
        if came.all():
            came, waits = _between_lines(log.t[seen], tip[seen])
            for values in made.values():
                values[seen] = _met(log.t[seen], values[seen], waits)
        if not waits.any():
            waits[came] = _waits(log.t[rows], mine[came])
        step = np.diff(log.t[rows], prepend=log.t[rows[:1]])[mine]
        old[seen], late[seen] = ~came, np.minimum(waits, 0.98 * step)
    if (q := made.get("tip_quaternion")) is not None:
        q /= np.linalg.norm(q, axis=1, keepdims=True)
    return (unmeasured(replace(log, **made), old) if old.any() else log), late


def unmeasured(log: RunLog, rows: Flags) -> RunLog:
    """The log as if its camera had seen nothing in these `rows` (n,)."""

    def without(seen: Floats) -> Floats:
        return np.where(rows.reshape(-1, *[1] * (seen.ndim - 1)), np.nan, seen)

    return replace(
        log,
        tip_position=without(log.tip_position),
        tip_quaternion=None if log.tip_quaternion is None else without(log.tip_quaternion),
        points=None if log.points is None else without(log.points),
    )


def _met(t: Floats, values: Floats, waits: Floats) -> Floats:
    """(n, ...) values of the rows at `t` (n,) [s]; where a picture had waited (`waits` (n,) [s]) those at the
    end of the line that leads through the two rows before."""
    k, made = np.flatnonzero(waits), values.copy()
    since = (t[k] - waits[k] - t[k - 1]) / (t[k - 1] - t[k - 2])
    before = values[k - 1]
    made[k] = before + since.reshape(-1, *[1] * (values.ndim - 1)) * (before - values[k - 2])
    return made


def _waits(t: Floats, seen: Ints) -> Floats:
    """(k,) how long the pictures in the rows `seen` (k,) of those at `t` (n,) had waited [s]."""
    none, steps, at = np.zeros(len(seen)), np.diff(t), t[seen]
    usual = float(np.median(steps)) if len(steps) else 0.0
    if len(seen) < _SURE or usual <= 0.0 or at[-1] - at[0] < (len(seen) - 1 + _FEW) * usual:
        return none
    if np.quantile(np.abs(steps - usual), 0.9) > _EVEN * usual:
        return none
    for number in (np.arange(len(at)), _numbers(at, usual)):
        each, first = np.polyfit(number, at, 1)
        off = at - each * number - first
        most = min(_WAITS[1] * usual, _CLOCK * each if number[-1] >= len(at) else np.inf)
        if _WAITS[0] * usual < off.std() < most:
            return np.asarray(np.maximum(off + 0.5 * usual, 0.0), dtype=np.float64)
    return none


def _numbers(at: Floats, least: float) -> Ints:
    """(k,) numbers of the pictures that came `at` these times, `least` apart [s]; some never came."""
    apart, n = np.diff(at), _SURE
    period = max(least, apart[apart <= 1.5 * np.median(apart)].mean())
    number = np.cumsum(np.append(0.0, np.maximum(np.round(apart / period), 1.0)))
    while n < 2 * len(at):  # the clock of those before tells the next
        each, first = np.polyfit(number[:n], at[:n], 1)
        number[: 2 * n] = np.round((at[: 2 * n] - first) / each)
        n *= 2
    return number.astype(np.int64)


def earlier(log: RunLog, late: Floats) -> RunLog:
    """The log with its rows by `late` (n,) earlier [s], each picture at its time and under the commands of
    that time."""
    t = log.t - late
    return replace(with_commands_at(log, t), t=t) if late.any() else log


def _between_lines(t: Floats, tip: Floats) -> tuple[Flags, Floats]:
    """(n,) rows of those at `t` (n,) [s] to which a picture came, where the `tip` (n, 3) [m] between pictures
    is on straight lines, and how long those had waited that are where two lines meet between two rows (n,)
    [s]. All, where it is not."""
    every, step, waits = np.ones(len(t), bool), np.diff(t), np.zeros(len(t))
    if len(t) < _SURE or not step.min() > 0.0:
        return every, waits
    rate = np.diff(tip, axis=0) / step[:, None]
    bend = np.zeros(len(t))
    bend[1:-1] = np.linalg.norm(np.diff(rate, axis=0), axis=1) * step[1:]
    fine = 4.0 * float(np.linalg.norm(resolution(tip))) + _FINEST
    fast = np.append(np.linalg.norm(rate, axis=1) * step > _FAR * fine, False)
    on, off = fast & (bend <= fine), fast & (bend > fine)
    on[[0, -1]] = False
    if not on.sum() > _LINES * fast.sum() or not off.any() or np.median(bend[off]) < _FAR * fine:
        return every, waits
    came = ~every
    came[1:-1] = on[:-2] & ~on[1:-1] & on[2:]
    i = np.flatnonzero(on[:-3] & ~on[1:-2] & ~on[2:-1] & on[3:]) + 1
    change = rate[i + 1] - rate[i - 1]
    since = ((rate[i + 1] - rate[i]) * change).sum(1) / (change**2).sum(1) * step[i]
    since = np.clip(since, _WAITS[0] * step[i], step[i])
    came[i + 1], waits[i + 1] = True, step[i] - since
    return came, waits


def sentences(log: RunLog) -> list[str]:
    """Return how many rows no picture came to, if that are some, and whether pictures are out of step."""
    every, (seen, late) = int(log.measured.sum()), pictures(log)
    old = log.measured & ~seen.measured
    n, said = int(old.sum()), list[str]()
    if (old & _new(log.tip_position)).sum() > _SOME * every:
        said.append(
            f"{n} of {every} rows have a tip that was interpolated, on lines from picture to picture: they "
            "do not count; the pictures do, found where two lines meet"
        )
    elif n > _SOME * every:
        said.append(
            f"{n} of {every} rows repeat the measured tip of the row before, whatever the commands do: the "
            "camera is slower than the log, and they do not count; a row for each picture, at its time, says "
            "more"
        )
    if late.any():
        said.append(
            "the camera's pictures are out of step with the rows: each counts for when it was taken, up to "
            f"{1e3 * late.max():.3g} ms before its row"
        )
    return said


def _new(tip: Floats) -> Flags:
    """(n,) rows whose `tip` (n, 3) is another than that of the row before."""
    new = np.ones(len(tip), dtype=np.bool_)
    new[1:] = (tip[1:] != tip[:-1]).any(axis=1)
    return new


def repeated(tip: Floats, commands: Floats, inputs: Floats) -> Flags:
    """(n,) rows of a run in which the measured `tip` (n, 3) [m] is that of the row before, for the camera has
    seen nothing since. Of a tip that is rounded, those alone in which any of the `inputs` (n, k) has moved
    since, of which the `commands` (n, m) are some.

    What such a camera sees next is as far away as the commands have gone since it saw something. That of a
    robot that stands still by friction or backlash is not, and that of one whose tip is rounded is next to
    it.
    """
    rows, new = np.arange(len(tip)), _new(tip)
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
