"""A log through rods in motion: each run from rest at its first sample on, many robots side by side; a robot
that was let go, from where it turns back.

Time steps are even and no longer than `LONGEST_STEP`; between two samples the inputs go evenly from one to
the other. A payload is a mass at the tip here, with its inertia, and not only a weight.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from fastrod.errors import InputError, LogError
from fastrod.identification.log.forward import PredictedPose, Work
from fastrod.identification.log.inputs import inputs
from fastrod.identification.log.samples import LogSamples, sample
from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Lump, Robot
from fastrod.rotation import matrix_from_quaternion
from fastrod.types import Flags, Floats, Ints

LONGEST_STEP = 1e-3
"""s. Generalized-alpha is second order: of smooth commands up to 5 Hz it leaves some micrometres."""
_ON_STEP = 1e-3  # of a step: a sample so near to one needs no interpolation
_MOST_STEPS = 2_000_000  # of a run
_AT_ONCE = 256  # steps whose inputs are laid out together
_FEW = 20  # rows, of which no run is called let go
_SWINGS = 6.0  # times what the tip still moves at a run's end: a start that is as far away is no rest
_CROSSINGS = 2  # of the pose at rest, from which on a tip swings
_HELD = 0.1  # of the first displacement: a tip that has gone so far is no longer held
_HOLDS = 6  # Newton steps to the force that holds the tip
_STIFF = 0.02  # of the softest direction: along others nothing holds a tip
_BEGIN_S, _BEGIN_ROWS, _BEGIN_RUNS = 4.0, 100, 8  # of a long log: what is moved at first
_LONGER = 4  # times so much each time that it does not do


@dataclass(frozen=True, eq=False)
class MotionReplay:
    """Motion of rods that are driven as `samples` says, at its rows."""

    samples: LogSamples
    points: bool = False
    """The robot's `log_points` too."""
    longest_step: float = LONGEST_STEP
    threads: int | None = None
    """None: one. A batch of differences fills a few lanes."""
    work: Work = field(default_factory=Work)

    def poses(
        self, robots: Sequence[Sequence[Robot]], progress: Callable[[int, int], None] | None = None
    ) -> list[PredictedPose]:
        """Return what the camera sees of each of these robots, effects and all; each is given as it is in
        every session, or once. They must differ in numbers only.

        `ok` is False from where the rod is lost to the end of its run. Raises `InputError` for a robot
        without mass, `LogError` for a payload that changes within a run.
        """
        from fastrod.simulator import Simulator
        from fastrod.solver.options import Modal

        runs = self._compared()
        clock, masses = _clock(self.samples, runs, self.longest_step), self._payloads(runs)
        session = [int(self.samples.session[span.start]) for span in runs]
        rods = [
            _with_payload(each[k if len(each) > 1 else 0], mass)
            for each in robots
            for k, mass in zip(session, masses, strict=True)
        ]
        sim = Simulator(
            rods,
            dt=clock.dt,
            points_per_segment=4,
            outputs="full" if self.points or self.samples.log.without_tip or rods[0].effects else "tip",
            threads=self.threads or 1,
            solver=Modal(dynamics=True, jumps=False),
        )
        given = _prepared(self.samples, rods[0])
        alive, seen = np.ones(len(rods), bool), list[Floats]()
        held = np.tile(_beside_rest(self.samples, runs), (len(robots), 1))
        held = held @ matrix_from_quaternion(np.array([rods[0].base_quaternion]))[0].T
        kept = np.zeros((len(clock.wanted), len(rods)), bool)
        last = int(clock.wanted[-1])
        self.work.steps(last + 1, len(rods) * len(rods[0].segments))
        for step in range(last + 1):
            if step % _AT_ONCE == 0:
                ahead = clock.inputs(step, given, len(robots))
            now: dict[str, Any] = {name: a[step % _AT_ONCE] for name, a in ahead}
            state = sim.step(**now) if step else _held(sim, sim.settle(**now), held, now)
            alive &= state.ok
            if step == clock.wanted[len(seen)]:
                kept[len(seen)] = alive
                tip, rotation, points = sim.measure()
                if self.samples.log.without_tip:
                    tip, points = points[:, -1], points[:, :-1]
                flat = [np.reshape(a, (len(rods), -1)) for a in (tip, rotation, points)]
                seen.append(np.concatenate(flat, axis=1))
            if progress is not None and step % 100 == 0:
                progress(step, last)
        record = np.stack(seen)  # (n_wanted, n_rods, 12 + 3 k)
        each = [slice(i * len(runs), (i + 1) * len(runs)) for i in range(len(robots))]
        return [self._pose(clock, runs, record[:, own], kept[:, own]) for own in each]

    def _compared(self) -> list[slice]:
        """Samples of the runs in which any row is compared."""
        rows = self.samples.rows
        return [s for s in self.samples.runs if ((rows >= s.start) & (rows < s.stop)).any()]

    def _pose(self, clock: _Clock, runs: list[slice], record: Floats, alive: Flags) -> PredictedPose:
        """Return the pose of one robot at the rows."""
        rows = self.samples.rows
        found = np.full((len(rows), record.shape[2]), np.nan)
        ok = np.zeros(len(rows), bool)
        for k, span in enumerate(runs):
            mine = np.flatnonzero((rows >= span.start) & (rows < span.stop))
            at = self.samples.time[rows[mine]] / clock.dt
            if clock.even:
                place = np.searchsorted(clock.wanted, np.rint(at))
                found[mine], ok[mine] = record[place, k], alive[place, k]
            else:
                last = int(np.flatnonzero(alive[:, k])[-1]) if alive[:, k].any() else 0
                ok[mine] = at <= last + _ON_STEP if last >= 3 else False
                inside = mine[ok[mine]]
                if len(inside):
                    spline = CubicSpline(np.arange(last + 1), record[: last + 1, k])
                    found[inside] = spline(at[ok[mine]])
        found[~ok] = np.nan
        n = len(rows)
        return PredictedPose(
            found[:, :3], found[:, 3:12].reshape(n, 3, 3), found[:, 12:].reshape(n, -1, 3), ok
        )

    def _payloads(self, runs: list[slice]) -> list[float | None]:
        """The mass at the tip in each run [kg]; None where the log names none."""
        payload = self.samples.log.payload
        if payload is None or not payload.any():
            return [None] * len(runs)
        for span in runs:
            if np.ptp(payload[span]) > 0.0:
                label = str(self.samples.log.run[span.start]) or self.samples.log.name
                raise LogError(
                    f"the payload changes within run {label!r}; in motion it is a mass at the tip, the same "
                    "for a whole run: give each its own run."
                )
        return [float(payload[span.start]) for span in runs]


def beginnings(samples: LogSamples, rows: Ints) -> Iterator[Ints]:
    """Rows to fit in motion, where time goes by how long a run is moved: at first those of some seconds of
    some runs, from where their inputs begin to change; then more and more, at last all."""
    inputs, seconds, many = samples.log.inputs, max(_BEGIN_S, _BEGIN_ROWS * samples.step), _BEGIN_RUNS
    runs = [s for s in samples.runs if ((rows >= s.start) & (rows < s.stop)).any()]
    starts = [int(np.argmax(np.abs(inputs[s] - inputs[s.start]).any(1))) for s in runs]
    while True:
        inside = np.zeros(len(samples.log), bool)
        for k in np.unique(np.linspace(0, len(runs) - 1, min(many, len(runs))).round().astype(int)):
            time = samples.time[runs[k]]
            inside[runs[k]] = time <= time[starts[k]] + seconds
        if 2 * np.count_nonzero(inside[rows]) > len(rows):
            break
        yield rows[inside[rows]]
        seconds, many = _LONGER * seconds, _LONGER * many
    yield rows


def let_go(log: RunLog) -> RunLog:
    """The log without what comes before a robot swings that was pulled aside and let go: in runs whose inputs
    never change, up to where the tip turns back for the first time. How it was held and let go no log says;
    there it is at rest, and a force on the tip holds it."""
    t = log.t.copy()
    for label in log.runs:
        rows = np.flatnonzero((log.run == label) & log.measured)
        if (k := _turning_point(log, rows)) is not None:
            t[(log.run == label) & (np.arange(len(t)) < rows[k])] = np.nan
    return log if np.array_equal(t, log.t, equal_nan=True) else replace(log, t=t)


def _turning_point(log: RunLog, rows: Ints) -> int | None:
    """Which of the rows of a run that is let go is the first at which the tip turns back; None where it is
    driven, or does not come to rest."""
    if len(rows) < _FEW or not _is_still(log.rows(rows)):
        return None
    tip = np.asarray(log.tip_position)[rows]
    off = tip - np.median(tip[-len(tip) // 10 :], axis=0)
    _, _, axes = np.linalg.svd(off, full_matrices=False)
    x = off @ axes[0]
    far = np.abs(x) > _HELD * np.abs(x).max()
    begun = int(np.argmax(np.abs(x - x[0]) > _HELD * np.abs(x).max()))
    reversals = np.flatnonzero((np.diff(x)[:-1] * np.diff(x)[1:] <= 0.0) & far[1:-1])
    later = reversals[reversals >= begun] + 1
    crossings = int((np.diff(np.sign(x[begun:][far[begun:]])) != 0.0).sum())  # what creeps to rest has none
    swings = crossings >= _CROSSINGS and len(later) > 0 and _swings(tip[later[0] :]) is not None
    return int(later[0]) if swings else None


def _swings(tip: Floats) -> Floats | None:
    """(3,) where a tip (n, 3) begins beside where it comes to rest [m]; None where it does not, or rests."""
    if len(tip) < _FEW:
        return None
    end = tip[-len(tip) // 10 :]
    off = np.asarray(tip[0] - np.median(end, axis=0))
    return off if np.linalg.norm(off) > _SWINGS * np.linalg.norm(end.std(axis=0)) else None


def _is_still(log: RunLog) -> bool:
    """Whether no input changes."""
    return float(np.ptp(log.inputs, axis=0).max(initial=0.0)) < 1e-9


def _beside_rest(samples: LogSamples, runs: Sequence[slice]) -> Floats:
    """(n_runs, 3) where the tip is held at the start of each run beside where it ends, base frame [m]; 0 of
    runs that are driven."""
    found = np.zeros((len(runs), 3))
    for k, span in enumerate(runs):
        log = samples.log.rows(span)
        off = _swings(np.asarray(log.tip_position)[log.measured])
        found[k] = off if off is not None and _is_still(log) else 0.0
    return found


def _held(sim: Any, rest: Any, off: Floats, given: Mapping[str, Any]) -> Any:
    """The state at rest with each tip held `off` (n_rods, 3) from where it would be [m], by a force on it."""
    if not off.any():
        return rest
    aim, force, state = rest.tip_position + off, np.zeros_like(off), rest
    own = given.get("tip_force", 0.0)
    for _ in range(_HOLDS):
        soft = sim.compliance()[:, :3]
        force = force + np.einsum("nij,nj->ni", np.linalg.pinv(soft, rcond=_STIFF), aim - state.tip_position)
        state = sim.settle(**{**given, "tip_force": own + force})
    sim.set_in_motion(np.zeros(6), off.any(1))  # let go at once, not evenly through a step
    return state


def predict_motion(
    log: RunLog, robot: Robot, *, points: bool = False, progress: Callable[[int, int], None] | None = None
) -> tuple[Floats, Floats, Flags]:
    """Tip (n, 3) and the robot's `log_points` (n, k, 3) at every row of `log`, in its base frame [m], and
    which rows (n,) are found; k is 0 without `points`. Raises what `MotionReplay.poses` does."""
    samples = sample(let_go(log))
    rows = samples.origin[samples.given]
    every = samples.on(samples.given)
    (pose,) = MotionReplay(every, points=points).poses([[robot]], progress)
    tip, ok = np.full((len(log), 3), np.nan), np.zeros(len(log), bool)
    further = np.full((len(log), pose.points.shape[1], 3), np.nan)
    tip[rows], further[rows], ok[rows] = pose.position, pose.points, pose.ok
    return tip, further, ok


@dataclass(frozen=True, eq=False)
class _Clock:
    """Even steps that go through the samples of each run."""

    dt: float
    wanted: Ints
    """Steps whose pose is kept: those of the samples where they are `even`, or all."""
    even: bool
    left: Ints
    """(n_runs, n_steps) the sample before each step."""
    weight: Floats
    """(n_runs, n_steps) of the sample after it."""

    def inputs(self, first: int, given: Mapping[str, Floats], n_robots: int) -> list[tuple[str, Floats]]:
        """The inputs at the steps from this one on, (_AT_ONCE, n_robots * n_runs, ...) each."""
        left, weight = (a[:, first : first + _AT_ONCE].T for a in (self.left, self.weight))
        made = []
        for name, array in given.items():
            w = weight.reshape(*weight.shape, *[1] * (array.ndim - 1))
            value = (1.0 - w) * array[left] + w * array[np.minimum(left + 1, len(array) - 1)]
            if name == "base_pose":
                value[..., 3:] /= np.linalg.norm(value[..., 3:], axis=-1, keepdims=True)
            made.append((name, np.tile(value, (1, n_robots, *[1] * (array.ndim - 1)))))
        return made


def _clock(samples: LogSamples, runs: list[slice], longest: float) -> _Clock:
    middle = samples.step
    if not middle:
        raise LogError(
            f"log {samples.log.name!r} has no two samples at different times; nothing moves in it."
        )
    dt = middle / math.ceil(middle / longest - 1e-9)
    at = samples.time[samples.rows] / dt
    even = bool((np.abs(at - np.rint(at)) < _ON_STEP * np.maximum(1.0, np.rint(at) * 1e-3)).all())
    n = math.ceil(float(at.max()) - _ON_STEP) + 1
    if n > _MOST_STEPS:
        raise InputError(
            f"a run of log {samples.log.name!r} lasts {dt * n:.4g} s, {n} steps of {dt:.3g} s; "
            f"motion takes {_MOST_STEPS} at most: cut the log into runs."
        )
    left, weight = np.zeros((len(runs), n), np.int64), np.zeros((len(runs), n))
    t = dt * np.arange(n)
    for k, span in enumerate(runs):
        own = samples.time[span]
        i = np.clip(np.searchsorted(own, t + 1e-9 * dt, side="right") - 1, 0, max(len(own) - 2, 0))
        width = np.diff(own)[i] if len(own) > 1 else np.ones(n)
        left[k] = span.start + i
        weight[k] = np.clip((t - own[i]) / np.where(width > 0.0, width, 1.0), 0.0, 1.0)
    wanted = np.unique(np.rint(at).astype(np.int64)) if even else np.arange(n)
    return _Clock(dt, wanted, even, left, weight)


def _prepared(samples: LogSamples, robot: Robot) -> dict[str, Floats]:
    """Inputs of every sample; the payload is a mass of the robot's own."""
    given: dict[str, Any] = dict(inputs(replace(samples.log, payload=None), robot))
    if (pose := given.get("base_pose")) is not None:
        q = pose[:, 3:]
        same = np.where((q[1:] * q[:-1]).sum(1) < 0.0, -1.0, 1.0)  # q and -q are one orientation
        given["base_pose"] = np.column_stack([pose[:, :3], q * np.cumprod([1.0, *same])[:, None]])
    if not given:
        given["tip_force"] = np.zeros((len(samples.log), 3))
    return given


def _with_payload(robot: Robot, mass: float | None) -> Robot:
    if mass is None:
        return robot
    *before, last = robot.segments
    last = replace(last, lumps=(*last.lumps, Lump(at=last.length, mass=mass)))
    return replace(robot, segments=(*before, last))
