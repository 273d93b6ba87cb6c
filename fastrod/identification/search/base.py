"""Before the search: what is the noise of a log, which base parameters does it show, how do they fit."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from fastrod.errors import LogError
from fastrod.identification.log import advice
from fastrod.identification.log.forward import PredictedRod, predict
from fastrod.identification.log.noise import ENOUGH, Noise, at_rest, keep, read_everywhere, read_noise
from fastrod.identification.log.questions import further_than_still
from fastrod.identification.log.samples import LogSamples
from fastrod.identification.log.unknowns import Model
from fastrod.identification.search.linearised import ANGLE, LinearisedModel, target_of
from fastrod.identification.search.model_selection import ModelState
from fastrod.identification.search.search import Search, blocks_of
from fastrod.identification.search.solve import Estimate, covariance_of, rms
from fastrod.model.robot import Robot
from fastrod.types import Floats, Ints

SEEN = 0.7
"""Fraction of the prior's sd: a parameter whose data say less is not identifiable."""
_FOR_NOISE = 20000  # samples
_RESTLESS = 0.25  # of the motion: noise beyond it is no noise


@dataclass(frozen=True, kw_only=True, eq=False)
class Rival:
    """Another base model, fitted to the same rows."""

    name: str
    what: str
    """In words."""
    left: float
    """Distance rms that it leaves on held-out blocks [m]."""
    z: float
    """z of what it gains on them."""
    bic_gain: float
    fraction: float
    """Fraction of the loss of the base model as it was given that it takes away."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BaseFit:
    """The base model, fitted to what the search looks at: what every candidate stands beside."""

    robot: Robot
    """The robot as it was given."""
    search: Search
    """Its samples, with the weights of this fit."""
    noise: Noise
    start: ModelState
    fixed: dict[str, Estimate]
    """Parameters that this log cannot see; they stay nominal."""
    notes: tuple[str, ...]
    without: BaseFit | None = None
    """The base fit of the robot as it was given, where this is one of other tendons (`structure`)."""
    rivals: tuple[Rival, ...] = ()
    """Base models of other tendons that were tried."""

    @property
    def left(self) -> float:
        """Distance of the tip that the base model leaves, once its own parameters are fitted, rms [m]."""
        off = self.start.fit.residual[:, :3] * self.start.linearised.target.sigma
        counted = off[np.any(off != 0.0, axis=1)]
        return float(np.sqrt((counted**2).sum(1).mean())) if len(counted) else 0.0

    @property
    def sentence(self) -> str:
        """That in words."""
        return f"base fit: {1e3 * self.left:.3g} mm left of a noise of {1e3 * self.noise.floor:.2g} mm"


def fit_base(
    samples: LogSamples,
    rows: Ints,
    model: Model,
    robot: Robot,
    excluded: frozenset[str],
    threads: int | None,
    like: BaseFit | None = None,
) -> BaseFit:
    """The base model with its own parameters fitted at the rows of `samples`; those that this log cannot see
    stay nominal, with the reason. `rows` are all that may be fitted; effects `excluded` are for the search to
    leave out. With the base model `like`, of the same log, the fit begins where that one ended; at the same
    rows noise and outliers are that one's."""
    search = _search(samples, robot, excluded, threads)
    target, notes = search.target, list[str]()
    theta = like.start.from_here(model) if like else model.start
    linearised = LinearisedModel(model, theta, samples, search.rod, target)
    if not linearised.pose.ok.all():
        lost = int((~linearised.pose.ok).sum())
        notes.append(
            f"the model did not converge on {lost} of {len(linearised.pose.ok)} rows; they do not count"
        )
    raw = target.tip - linearised.pose.position
    rival = like is not None and np.array_equal(like.search.samples.rows, samples.rows)
    noise = like.noise if like and rival else _noise(samples.on(rows[:_FOR_NOISE]), model, robot, threads)
    given = robot.sensor.get("noise", 0.0)
    declared = float(max(given) if isinstance(given, tuple) else given)
    if declared > 0.0:
        noise = replace(
            noise, sigma=np.full(3, declared), how="the robot file's [sensor] noise", uncertainty=0.0
        )
    good = keep(samples, np.nan_to_num(raw), noise) & linearised.pose.ok
    if like and rival:
        good = (like.search.target.weight > 0.0) & linearised.pose.ok
    target = replace(target, weight=good.astype(float)).weighed(noise.sigma, noise.sigma)
    fixed = _unseen(linearised.under(target), noise.row_correlation(samples))
    seen = [u.name not in fixed for u in model.unknowns]
    model, theta = replace(model, unknowns=tuple(compress(model.unknowns, seen))), theta[seen]
    size = max(1.0, rms(target.residual(linearised.pose)))
    search = replace(search, target=target.weighed(noise.sigma * size, noise.sigma))
    state = search.start(model, theta)
    if not declared > 0.0 and not rival:
        every = samples.on(rows[:_FOR_NOISE])
        pose = predict(state.model, state.theta, every, PredictedRod(every, robot, threads=threads))
        left = np.asarray(every.log.tip_position)[every.rows] - pose.position
        noise = read_everywhere(every.on(every.rows[pose.ok]), left[pose.ok], noise)
    search = replace(search, noise=noise.sigma, row_correlation=noise.row_correlation(samples))
    for _ in range(2):
        search, state = search.weighed(state, noise.sigma)
    return BaseFit(robot=robot, search=search, noise=noise, start=state, fixed=fixed, notes=tuple(notes))


def _search(samples: LogSamples, robot: Robot, excluded: frozenset[str], threads: int | None) -> Search:
    """Samples, rod and blocks, all rows weighed by a thousandth of the robot's length."""
    points = samples.log.points is not None
    return Search(
        samples,
        PredictedRod(samples, robot, points=points, threads=threads),
        target_of(samples, np.full(3, 1e-3 * robot.length), rotation_sigma=ANGLE, points=points),
        blocks_of(len(samples.rows)),
        excluded,
    )


def search_on(samples: LogSamples, base: BaseFit, sigma: Floats, state: ModelState) -> Search:
    """The search at other samples of the same robot, weighed by `sigma` (3,) [m]; outliers by the residual
    that `state` leaves: an abrupt effect is none once it is in the model."""
    search, at = base.search.at(samples, base.robot), (state.model, state.theta, samples)
    target = target_of(samples, sigma, rotation_sigma=ANGLE, points=search.rod.points)
    pose = search.predict(*at) if search.in_motion else predict(*at, search.rod)
    good = keep(samples, np.nan_to_num(target.tip - pose.position), base.noise) & pose.ok
    target = replace(target, weight=good.astype(float)).weighed(sigma, base.noise.sigma)
    correlation = search.row_correlation if search.in_motion else base.noise.row_correlation(samples)
    return replace(search, target=target, noise=base.noise.sigma, row_correlation=correlation)


def _noise(every: LogSamples, model: Model, robot: Robot, threads: int | None) -> Noise:
    """Noise from samples one after the other, whatever part of them the search looks at."""
    tip = np.asarray(every.log.tip_position)[every.rows]
    if sum(len(rows) for rows in at_rest(every)) >= ENOUGH:
        return read_noise(every, tip, tip)
    pose = predict(model, model.start, every, PredictedRod(every, robot, threads=threads))
    return read_noise(every, tip, np.nan_to_num(tip - pose.position))


def _unseen(linearised: LinearisedModel, correlation: Floats) -> dict[str, Estimate]:
    """Base parameters whose prior this log does not narrow: Fisher information at the noise, others free.
    And stiffnesses that nobody put into `[fit]`, where no load is known: what the tendons' stretch would show
    of them, any gain of the drives shows as well."""
    model, samples = linearised.model, linearised.samples
    r = linearised.residual(model, linearised.theta)
    J = linearised.slopes(model, linearised.theta, r)
    _, sd = model.prior
    fixed, requested = {}, set(model.robot.fit)
    spread = covariance_of(J, 1.0 / sd**2, correlation) if len(sd) else np.zeros((0, 0))
    posterior = np.sqrt(np.maximum(np.diag(spread), 0.0))
    for u, narrowed, prior in zip(model.unknowns, posterior, sd, strict=True):
        blind = (
            "stiffness" in u.name
            and not requested & {u.name, re.sub(r"segment\.\d+", "segment.*", u.name)}
            and not advice.loaded(samples, model.robot)
        )
        if blind or narrowed > SEEN * prior:
            fixed[u.name] = Estimate(
                value=u.start if u.place[0] == "robot" else u.mean,
                stderr=float(prior),
                unit=u.unit,
                identifiable=False,
                why=advice.why_unknown(u.name, samples, model.robot),
                prior_sd=float(prior),
            )
    return fixed


def check_motion(base: BaseFit, guess: str) -> None:
    """Refuse a log that the fitted model follows worse than a robot that stands still: it is of another
    robot, or in other units, as the sentence `guess` may say. Raises `LogError`."""
    state, samples, target = base.start, base.search.samples, base.search.target
    good = (target.weight > 0.0) & state.linearised.pose.ok
    measured = target.tip[good]
    predicted = state.linearised.seen(
        state.model, state.theta, state.linearised.solved(state.model, state.theta)
    ).position[good]
    if 2 * state.linearised.pose.ok.sum() < state.linearised.pose.ok.size or not np.isfinite(predicted).all():
        raise LogError(further_than_still(samples, base.robot, np.nan, guess))
    measured, predicted = measured - measured.mean(0), predicted - predicted.mean(0)
    moves = float((measured**2).sum())
    name = samples.log.name
    if float(((measured - predicted) ** 2).sum()) > moves:
        scale = float((measured * predicted).sum() / max((predicted**2).sum(), 1e-30))
        raise LogError(further_than_still(samples, base.robot, scale, guess))
    if (
        base.noise.floor > _RESTLESS * np.sqrt(moves / max(len(measured), 1))
        and base.noise.floor > 0.01 * base.robot.length
    ):
        raise LogError(
            f"in log {name!r} the measured tip jumps by {1e3 * base.noise.floor:.3g} mm from sample to "
            "sample while the inputs rest, "
            f"{100 * base.noise.floor / np.sqrt(moves / len(measured)):.0f} % of its motion; are two robots "
            "or two markers mixed?"
        )
