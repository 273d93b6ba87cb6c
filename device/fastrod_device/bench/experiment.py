"""Experiments with a prototype: the run that separates effects, and paths that its tip follows."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol, final

import numpy as np

from fastrod.control.inverse import InversePlan
from fastrod.errors import InputError
from fastrod.identification.excite import Excitation
from fastrod.logs.recording import Recorder
from fastrod.logs.runlog import RunLog
from fastrod.logs.table import numbers
from fastrod.types import Flags, Floats
from fastrod_device.prototype import Prototype

Progress = Callable[[str, int, int], None]
"""Callback of progress: the task, how many steps are done, how many there are."""
Law = Callable[[Floats, float], Floats]
"""(3,) measured tip [m], nan where it is not known, and seconds since the path began -> (n_tendons,) changes
of tendon length [m]."""
_SETTLE = 1.0  # s at rest before a path begins


class BenchAssistant(Protocol):
    """Interface of whoever hangs the load and rotates the bench: a person, or the emulator's own."""

    def hang(self, mass: float) -> None:
        """A known mass [kg] hangs on the tip when this returns; 0: none."""

    def rotate(self, quaternion: Floats) -> None:
        """The base stands at world_from_base (4,) when this returns."""


@final
class BenchPrompts:
    """A person at the terminal."""

    def hang(self, mass: float) -> None:
        """Ask for it, and wait for the Enter key."""
        what = f"hang {1e3 * mass:.0f} g on the tip" if mass else "take the load off the tip"
        input(f"Please {what}, then press Enter: ")

    def rotate(self, quaternion: Floats) -> None:
        """Ask for it, and wait for the Enter key."""
        input(
            f"Please turn the base to world_from_base w x y z = {np.round(quaternion, 3).tolist()}, then "
            "press Enter: "
        )


def excite(
    prototype: Prototype,
    run: Excitation,
    assistant: BenchAssistant,
    path: str | Path,
    *,
    progress: Progress | None = None,
) -> RunLog:
    """Drive `run`, hands doing what it asks, and record it to `path`: its inputs as the encoders had them,
    the known load, the base.

    Raises what `Prototype.follow` raises; what was recorded until then is on disk all the same.
    """
    log, report = run.log, progress or (lambda *_: None)
    assert log.payload is not None
    assert log.base_quaternion is not None
    known = np.column_stack([log.payload, log.base_quaternion])
    starts = [0, *(np.flatnonzero(np.any(np.diff(known, axis=0) != 0.0, axis=1)) + 1).tolist()]
    within(prototype, log.dl)
    recorder = prototype.recorder_for(path)
    recorder.start(prototype.elapsed)
    try:
        for number, (start, end) in enumerate(zip(starts, [*starts[1:], len(log)], strict=True)):
            report("excitation", start, len(log))
            load, base = float(log.payload[start]), log.base_quaternion[start]
            hang = load != (log.payload[start - 1] if number else 0.0)
            rotate = number > 0 and (base != log.base_quaternion[start - 1]).any()
            if hang or rotate:
                with prototype.resting():
                    if hang:
                        assistant.hang(load)
                    if rotate:
                        assistant.rotate(base)
            prototype.payload, prototype.base_quaternion = load, base
            prototype.record(recorder)
            t, dl = log.t[start : end + 1] - log.t[start], log.dl[start : end + 1]
            for piece in _pieces(t[-1] if end < len(log) else t[-1] + np.diff(log.t[-2:])[0]):
                prototype.follow(partial(_piece_of, t, dl, piece[0]), piece[1])
                report(
                    "excitation",
                    min(start + int((piece[0] + piece[1]) / t[-1] * (end - start)), end),
                    len(log),
                )
            prototype.record(None)
    except BaseException:
        _saved(prototype, recorder)
        raise
    prototype.record(None)
    return recorder.stop()


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackingRun:
    """Accuracy with which the measured tip followed a path, from the moment it was on it."""

    name: str
    log: RunLog
    path: Floats
    """(n, 3) where the tip should have been at the log's rows [m], nan before the path began."""
    nearest: Floats
    """(n, 3) the nearest points that the robot can reach [m]."""
    predicted: Floats
    """(n, 3) what the plan's model expected to be measured [m]."""

    @property
    def seen(self) -> Floats:
        """(n, 3) the measured tip while it should have been on the path, nan elsewhere [m]."""
        return np.asarray(np.where(self._rows[:, None], self.log.tip_position, np.nan))

    @property
    def rms(self) -> Floats:
        """(3,) off the path [m]."""
        return self._rms(self.path)

    @property
    def floor_rms(self) -> Floats:
        """(3,) of the nearest points in reach off the path [m]."""
        rows = self._rows
        return np.asarray(np.sqrt(np.mean((self.nearest - self.path)[rows] ** 2, axis=0)))

    @property
    def distance(self) -> float:
        """Root mean square distance from the nearest point in reach [m]."""
        return float(np.sqrt(np.sum(self._rms(self.nearest) ** 2)))

    @property
    def _rows(self) -> Flags:
        return np.asarray(self.log.measured & np.isfinite(self.path).all(axis=1))

    def _rms(self, wanted: Floats) -> Floats:
        rows = self._rows
        return np.asarray(np.sqrt(np.mean((self.log.tip_position - wanted)[rows] ** 2, axis=0)))


def within(prototype: Prototype, dl: Floats) -> None:
    """Raises `RefusedError` where a row of a run (n, n_tendons) [m] is beyond the robot's limits: before it
    moves, and not half way."""
    for row in dl:
        prototype.supervisor.within(row)


def drive_lag(log: RunLog) -> float:
    """[s] by which the drives of a recorded run followed their set-points; 0 where it has none."""
    from scipy.optimize import minimize_scalar

    names = [f"cmd_dl_{k}" for k in range(1, log.dl.shape[1] + 1)]
    if any(name not in log.extra for name in names):
        return 0.0
    commands = np.stack([numbers(dict(log.extra), name, log.name) for name in names], axis=1)
    good = np.isfinite(commands).all(axis=1) & np.isfinite(log.dl).all(axis=1)
    t, commands, done = log.t[good], commands[good], log.dl[good]
    found = minimize_scalar(
        lambda lag: float(np.mean((_between(t - lag, t, commands) - done) ** 2)),
        bounds=(0.0, 0.2),
        method="bounded",
    )
    return float(found.x)


def follow(
    prototype: Prototype,
    plan: InversePlan,
    path: str | Path,
    *,
    law: Law | None = None,
    dt: float = 0.05,
    lead: float = 0.0,
) -> RunLog:
    """Drive a plan, sent `lead` [s] early for drives that lag, or what `law` commands every `dt` [s] of the
    plan's time in its place, and record it to `path`; t = 0 is the plan's.

    Raises what `Prototype.follow` raises; what was recorded until then is on disk.
    """
    within(prototype, plan.dl)
    start = prototype.commanded
    prototype.follow(lambda s: start + min(s / _SETTLE, 1.0) * (plan.dl[0] - start), _SETTLE)
    recorder = prototype.recorder_for(path)
    recorder.start(prototype.elapsed)
    prototype.record(recorder)
    seconds = float(plan.t[-1])
    try:
        if law is None:
            prototype.follow(lambda s: _between(s + lead, plan.t, plan.dl), seconds)
        else:
            for step in range(round(seconds / dt)):
                prototype.glide(law(prototype.read().tip_position, step * dt), dt)
                prototype.wait(dt)
        prototype.wait(2.0 / prototype.hardware.camera.rate + prototype.hardware.camera.latency)
    except BaseException:
        _saved(prototype, recorder)
        raise
    prototype.record(None)
    return recorder.stop()


def _saved(prototype: Prototype, recorder: Recorder) -> None:
    """Write what was recorded until it broke off; nothing may hide why it did."""
    prototype.record(None)
    with contextlib.suppress(InputError):
        recorder.stop()


def tracking(name: str, log: RunLog, plan: InversePlan) -> TrackingRun:
    """A log of `follow` beside the path of its plan."""
    meant = log.t - plan.lead
    on = (meant >= plan.t[0]) & (meant <= plan.t[-1])
    path, nearest, predicted = (
        np.where(on[:, None], _between(meant, plan.t, points), np.nan)
        for points in (plan.target, plan.nearest, plan.predicted)
    )
    return TrackingRun(name=name, log=log, path=path, nearest=nearest, predicted=predicted)


def _pieces(seconds: float, most: float = 5.0) -> list[tuple[float, float]]:
    """(start, length) of the parts of a stretch, so that progress is seen."""
    n = max(1, round(seconds / most))
    return [(k * seconds / n, seconds / n) for k in range(n)]


def _piece_of(times: Floats, rows: Floats, began: float, t: float) -> Floats:
    """(n,) rows at `t` after `began`."""
    return _between(began + t, times, rows)


def _between(t: Floats | float, times: Floats, rows: Floats) -> Floats:
    """(..., n) rows at times in between, by straight lines."""
    at = np.clip(np.asarray(t, dtype=np.float64), times[0], times[-1])
    k = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    fraction = ((at - times[k]) / (times[k + 1] - times[k]))[..., None]
    return np.asarray(rows[k] + fraction * (rows[k + 1] - rows[k]))
