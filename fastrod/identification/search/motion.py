"""The fit of a robot's own parameters in motion: least squares with priors, and slopes by differences.

A difference is a robot of the batch: one that is as fitted so far, and one for each unknown.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fastrod.errors import LogError
from fastrod.identification.log import advice
from fastrod.identification.log.forward import LogSamples, PredictedPose
from fastrod.identification.log.motion import MotionReplay
from fastrod.identification.log.noise import Noise, keep, read_noise
from fastrod.identification.log.unknowns import Model, Unknown, known_model
from fastrod.identification.search.base import SEEN
from fastrod.identification.search.linearised import ANGLE, Target, target_of
from fastrod.identification.search.solve import Estimate, Fit, minimise, rms
from fastrod.model.robot import Robot
from fastrod.types import Flags, Floats

_STEP = 0.02
"""Of an unknown's typical size, for differences: a thousandth of the value for most. Below it the tolerance
of a step's Newton method would show, 1e-6 of the bend."""
HORIZONS = (0.06, 0.12, 0.25, 0.5, 1.0, 1.0)
"""Fractions of each run that are fitted one after the other: an oscillation that is off by half a period at
the end of a run pulls its frequency to a neighbour."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionFit:
    """A model fitted in motion at the rows of its samples."""

    model: Model
    """Its unknowns are those that the log can see."""
    fit: Fit
    target: Target
    noise: Noise
    fixed: dict[str, Estimate]
    """Those that it cannot; they stay nominal."""
    notes: tuple[str, ...]
    solves: int
    """Batches of rods in motion."""


@dataclass(eq=False)
class _Problem:
    """Residuals and slopes of one batch; both come from one batch."""

    replay: MotionReplay
    target: Target
    solves: int = 0

    def at(self, model: Model, theta: Floats) -> tuple[Floats, Floats]:
        """(n, n_out) residual and (n, n_out, p) slopes of the prediction; nan where the rod is lost."""
        steps = _steps(model, theta)
        thetas = [theta, *(theta + np.diag(steps))]
        poses = self.replay.poses([model.identified(each) for each in thetas])
        self.solves += 1
        every = [_residual(self.target, pose) for pose in poses]
        slopes = [(every[0] - other) / step for other, step in zip(every[1:], steps, strict=True)]
        return every[0], np.stack(slopes, axis=-1) if slopes else np.zeros((*every[0].shape, 0))

    def fit(self, model: Model, start: Floats, iterations: int) -> Fit:
        """The best parameters from `start` (p,) on, within limits and under priors."""
        last: dict[bytes, tuple[Floats, Floats]] = {}

        def residual(theta: Floats) -> Floats:
            last.clear()
            last[theta.tobytes()] = self.at(model, theta)
            return last[theta.tobytes()][0]

        def slopes(theta: Floats, _: Floats) -> Floats:
            return np.nan_to_num(last[theta.tobytes()][1])

        return minimise(residual, slopes, start, *model.prior, model.limits, iterations)


def fit_motion(
    samples: LogSamples,
    model: Model,
    robot: Robot,
    *,
    threads: int | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> MotionFit:
    """The unknowns of `model` fitted at the rows of `samples`, in motion; those that this log cannot see stay
    nominal, with the reason. Raises `LogError` where the robot as given is lost on the way."""
    points = samples.log.points is not None and bool(robot.log_points)
    report("motion as given")
    (pose,) = MotionReplay(samples, points=points, threads=threads).poses([model.identified(model.start)])
    if not pose.ok.all():
        k = int(samples.rows[np.flatnonzero(~pose.ok)[0]])
        run = str(samples.log.run[k]) or samples.log.name
        raise LogError(
            f"the robot as given is lost in motion in run {run!r}, {samples.time[k]:.3g} s after its start; "
            "is a mass, a stiffness or a damping_time far off?"
        )
    target = target_of(samples, np.full(3, 1e-3 * robot.length), rotation_sigma=ANGLE, points=points)
    left, solves = target.tip - pose.position, 1
    noise = _noise(samples, robot, left)
    theta, fixed, every = model.start, dict[str, Estimate](), model
    for k, horizon in enumerate(HORIZONS):
        report(f"fit in motion, {100 * horizon:.0f} % of each run")
        within = samples.on(samples.rows[_begun(samples, horizon)])
        good = keep(samples, left, noise)
        mine = np.isin(samples.rows, within.rows)
        own = target_of(within, target.sigma, rotation_sigma=ANGLE, points=points)
        own = replace(own, weight=good[mine].astype(float))
        problem = _Problem(MotionReplay(within, points=points, threads=threads), own)
        if k == len(HORIZONS) - 2:  # what the whole log shows
            problem.target = own.weighed(noise.sigma, noise.sigma)
            fixed = _unseen(problem, every, theta, within)
            seen = [u.name not in fixed for u in every.unknowns]
            model, theta = replace(every, unknowns=_those(every.unknowns, seen)), theta[seen]
        problem.target = _weighed(own, noise, left[mine][good[mine]])
        fit = problem.fit(model, theta, 10)
        theta, solves = fit.theta, solves + problem.solves
        (pose,) = MotionReplay(samples, points=points, threads=threads).poses([model.identified(theta)])
        solves += 1
        left = np.where(pose.ok[:, None], target.tip - pose.position, left)
        noise = _noise(samples, robot, left)
    out = int((problem.target.weight == 0.0).sum())
    notes = (f"{out} of {len(samples.rows)} rows are outliers and do not count",) if out else ()
    return MotionFit(
        model=model, fit=fit, target=problem.target, noise=noise, fixed=fixed, notes=notes, solves=solves
    )


def as_given(robot: Robot) -> Robot:
    """The robot with its own effects, nothing fitted."""
    return known_model(robot).identified(np.zeros(0))


def _steps(model: Model, theta: Floats) -> Floats:
    high = model.limits[1]
    steps = np.array([1e-3 if u.log else _STEP * u.scale for u in model.unknowns])
    return np.where(theta + steps > high, -steps, steps)


def _residual(target: Target, pose: PredictedPose) -> Floats:
    """(n, n_out) weighted; nan where a row that counts is lost."""
    found = target.residual(pose)
    return np.where(((target.weight > 0.0) & ~pose.ok)[:, None], np.nan, found)


def _weighed(target: Target, noise: Noise, left: Floats) -> Target:
    """Weights of the size of what is left (n, 3) [m], never below the noise."""
    size = max(1.0, rms(left / noise.sigma))
    return target.weighed(noise.sigma * size, noise.sigma)


def _noise(samples: LogSamples, robot: Robot, left: Floats) -> Noise:
    """Of the fast part of a residual (n, 3) [m]: inputs that rest are no rest of a rod that rings."""
    found = read_noise(samples, left, left)
    given = robot.sensor.get("noise", 0.0)
    declared = float(max(given) if isinstance(given, tuple) else given)
    if declared > 0.0:
        return Noise(np.full(3, declared), found.lag1, "the robot file's [sensor] noise")
    return found


def _begun(samples: LogSamples, fraction: float) -> Flags:
    """(n_rows,) rows in the first `fraction` of their run."""
    inside = np.zeros(len(samples.rows), bool)
    for span in samples.runs:
        end = fraction * samples.time[span.stop - 1]
        mine = (samples.rows >= span.start) & (samples.rows < span.stop)
        inside |= mine & (samples.time[samples.rows] <= end)
    return inside


def _those(unknowns: tuple[Unknown, ...], which: list[bool]) -> tuple[Unknown, ...]:
    return tuple(u for u, keep_it in zip(unknowns, which, strict=True) if keep_it)


def _unseen(problem: _Problem, model: Model, theta: Floats, samples: LogSamples) -> dict[str, Estimate]:
    """Unknowns whose prior this log does not narrow, at the noise."""
    if not model.unknowns:
        return {}
    J = np.nan_to_num(problem.at(model, theta)[1])
    flat, (_, sd) = J.reshape(-1, J.shape[-1]), model.prior
    spread = np.sqrt(np.maximum(np.diag(np.linalg.pinv(flat.T @ flat + np.diag(1.0 / sd**2))), 0.0))
    return {
        u.name: Estimate(
            value=u.start if u.place[0] == "robot" else u.mean,
            stderr=float(prior),
            unit=u.unit,
            identifiable=False,
            why=advice.why_unknown(u.name, samples, model.robot),
            prior_sd=float(prior),
        )
        for u, narrowed, prior in zip(model.unknowns, spread, sd, strict=True)
        if narrowed > SEEN * prior
    }
