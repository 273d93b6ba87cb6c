"""From the end of the search to a `Result`: predictions on every sample, errors, estimates, classes,
verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fastrod.effects.base import get_effect
from fastrod.identification.log import advice
from fastrod.identification.log.forward import LogSamples, PredictedRod, predict
from fastrod.identification.log.noise import keep
from fastrod.identification.log.unknowns import Model
from fastrod.identification.report.result import Error, Found, Result, SearchStage, Tried
from fastrod.identification.report.verdict import choose_verdict
from fastrod.identification.search.base import SEEN, BaseFit, rms
from fastrod.identification.search.model_selection import ModelState, SearchStep
from fastrod.identification.search.residual_test import residual_structure
from fastrod.identification.search.search import Search
from fastrod.identification.search.solve import Estimate, covariance
from fastrod.model.robot import Robot
from fastrod.types import Flags, Floats, Ints

ALL_AT_ONCE = 20000
"""Samples a batch when all are predicted."""
_SURE = 1.06  # the variance of the noise is known from rest to about 6 %
_FAR = 0.3  # of the robot's length: an error beyond counts no more, as an outlier's
# of the error above the noise: where so much is left, shear and inertia are worth a sentence
_SAY_LIMITS = 0.05
_SHEAR = 2.65  # (r / l)^2 times this is shear over bending at the tip: 3 EI / (k G A l^2), E = 3 G, circle
_WORTH_SAYING = 0.03
_SLOW = 10.0  # Hz; a rod that rings more slowly shows it


def assemble(
    *,
    samples: LogSamples,
    rows: Ints,
    tested: Flags,
    labels: Sequence[str],
    base: BaseFit,
    search: Search,
    start: ModelState,
    last: ModelState,
    last_sigma: Floats,
    state: ModelState,
    found: list[str],
    steps: list[SearchStep],
    fixed: dict[str, Estimate],
    threads: int | None,
) -> Result:
    """The result of a search: `start` without effects, `state` with those `found`, `last` with foils too.
    What was found is fitted again to the training `rows`, of which the search saw a part."""
    robot = base.robot
    inspected = residual_structure(search.samples, last.model.wiring, last.fit.residual, base.noise.lag1)
    squares = {"base": _square(start, base.weights[0]), "library": _square(state, base.target.sigma)}
    squares["after"] = min(squares["library"], _square(last, last_sigma))
    order = np.argsort([-_own(state, name) for name in found]) if len(found) > 1 else range(len(found))
    found = [found[int(i)] for i in order]
    if len(rows) > len(search.samples.rows):
        whole = base.on(samples.on(rows), start)
        search = Search(whole.samples, whole.rod, whole.target, whole.block, search.excluded)
        state = _nearer(state, search.again(state), samples, rows, robot, threads)
        # with its own weights: what the base model does not explain must not push its parameters
        rough = base.on(samples.on(rows), start)
        rough.weigh(base.weights[0])
        again = Search(rough.samples, rough.rod, rough.target, rough.block, search.excluded).again(start)
        start = _nearer(start, again, samples, rows, robot, threads)
    outlier = np.zeros(len(samples.log), bool)
    before = _everywhere(start.model, start.theta, samples, robot, threads)
    after = _everywhere(state.model, state.theta, samples, robot, threads) if found else before
    measured = samples.log.measured
    residual = np.asarray(samples.log.tip_position) - before
    seen = np.flatnonzero(measured & np.isfinite(residual).all(1))
    outlier[seen] = ~keep(samples.on(seen), residual[seen], base.noise)
    used = measured & ~tested & ~outlier
    test = measured & tested & ~outlier
    train_error = _error(samples, before, after, used)
    test_error = _error(samples, before, after, test)
    path = _path(start, state, found, samples, robot, used, test, search, threads)
    grounds = choose_verdict(
        **squares,
        left_out=max(0.0, test_error.after**2 - _SURE * base.noise.floor**2)
        / max(test_error.before**2 - base.noise.floor**2, 1e-30),
        floor=base.noise.floor**2,
        structure=inspected,
        steps=steps,
        found=found,
    )
    kept = [] if grounds.drop_effects else found
    final = state if kept else start
    if not kept:
        after = before
        train_error, test_error = (replace(e, after=e.before) for e in (train_error, test_error))
        test_error = replace(test_error, interval=_interval(samples, before, test))
        path = path[:1]
    estimates, correlation = _estimates(final)
    classes = _classes(steps, kept)
    effects = [_effect(name, estimates, classes, path, steps, base.noise.floor) for name in kept]
    wiring = state.model.wiring
    lacks = (
        advice.missing_excitation(search.samples, wiring.bend(np.asarray(samples.log.dl)))
        if wiring.n_tendons
        else []
    )
    recommended = [advice.look_at(pattern) for pattern in grounds.patterns]
    recommended += [advice.separating_run(e.name, other) for e in effects for other in e.cannot_be_told_from]
    base_estimates = {name: e for name, e in estimates.items() if name.partition(".")[0] not in kept} | fixed
    return Result(
        log=samples.log,
        robot=robot,
        identified=final.model.identified(final.theta),
        held_out=labels,
        noise=base.noise,
        measured=measured,
        used=used,
        tested=test,
        outlier=outlier,
        before=before,
        after=after,
        train=train_error,
        test=test_error,
        verdict="ambiguous"
        if grounds.verdict == "explained" and effects and effects[0].cannot_be_told_from
        else grounds.verdict,
        summary=" ".join(
            [
                grounds.summary,
                *(
                    _sentences(limits(robot, samples))
                    if grounds.left > _SAY_LIMITS or not robot.n_tendons
                    else []
                ),
            ]
        ),
        effects=effects,
        base_parameters=base_estimates,
        correlation=correlation,
        remaining=inspected,
        remaining_kind=grounds.kind,
        remaining_fraction=grounds.left,
        patterns=grounds.patterns,
        tried=_tried(steps[0], kept, base) if steps else [],
        path=path,
        bounds=search.bounds(final),
        advice=advice.unique([*recommended, *lacks]),
        notes=base.notes,
        solves=base.rod.runs,
    )


def _nearer(
    one: ModelState, other: ModelState, samples: LogSamples, rows: Ints, robot: Robot, threads: int | None
) -> ModelState:
    """The state whose prediction is nearer at the rows: a fit that goes by slopes can leave the valley where
    a load makes the rod snap."""
    piece = samples.on(rows)

    def off(state: ModelState) -> float:
        pose = predict(state.model, state.theta, piece, PredictedRod(piece, robot, threads=threads))
        error = np.linalg.norm(np.asarray(samples.log.tip_position)[rows] - pose.position, axis=1)
        return float(
            np.mean(np.where(pose.ok, np.minimum(error, _FAR * robot.length), _FAR * robot.length) ** 2)
        )

    return other if off(other) <= off(one) else one


def _square(state: ModelState, sigma: Floats) -> float:
    """Mean square distance that a state leaves at the samples of the search [m^2]."""
    counted = state.fit.residual[np.any(state.fit.residual != 0.0, axis=1), :3]
    return float(np.mean(((counted * sigma) ** 2).sum(1))) if len(counted) else 0.0


def _own(state: ModelState, name: str) -> float:
    """How far an effect by itself moves the prediction: squares over the samples, the other parameters as
    they are."""
    theta = state.theta.copy()
    for j, unknown in enumerate(state.model.unknowns):
        if unknown.place[:2] == ("effect", name) and not unknown.shape:
            theta[j] = unknown.mean
    with_it, without = (state.linearised.residual(state.model, at) for at in (state.theta, theta))
    return float(((with_it - without) ** 2).sum())


def _effect(
    name: str,
    estimates: dict[str, Estimate],
    classes: dict[str, list[str]],
    path: list[SearchStage],
    steps: list[SearchStep],
    floor: float,
) -> Found:
    parameters = {
        key.partition(".")[2]: value for key, value in estimates.items() if key.partition(".")[0] == name
    }
    taken = next((s.taken for s in steps if s.taken is not None and s.taken.name == name), None)
    evidence = {} if taken is None else {"z": taken.z, "bic": taken.bic_gain, "loss_share": taken.fraction}
    at = next(i for i, stage in enumerate(path) if stage.name == name)
    excess = max(path[0].held_out ** 2 - floor**2, 1e-18)
    gain = (path[at - 1].held_out ** 2 - path[at].held_out ** 2) / excess
    title = (type(get_effect(name)).__doc__ or name).strip().splitlines()[0]
    return Found(
        name=name,
        title=title,
        parameters=parameters,
        held_out_gain=gain,
        evidence=evidence,
        cannot_be_told_from=classes.get(name, []),
    )


def _classes(steps: list[SearchStep], found: list[str]) -> dict[str, list[str]]:
    """Effects that explained a stage as well as the one that was taken."""
    return {
        step.taken.name: [r for r in step.rivals if r not in found]
        for step in steps
        if step.taken is not None and step.taken.name in found
    }


def _tried(step: SearchStep, kept: list[str], base: BaseFit) -> list[Tried]:
    sigma = base.weights[0] if base.weights else base.target.sigma
    scale = rms(step.before.fit.residual[:, :3]) * float(np.sqrt((sigma**2).sum()))
    made = []
    for c in sorted(step.candidates, key=lambda c: (c.state is None, -c.bic_gain)):
        left = float("nan")
        if c.state is not None and step.before.losses.sum() > 0.0:
            left = float(np.sqrt(c.state.losses.sum() / step.before.losses.sum())) * scale
        made.append(
            Tried(
                name=c.name,
                held_out_rms=left,
                score=c.z,
                bic_gain=c.bic_gain,
                kept=c.name in kept,
                why="kept" if c.name in kept else c.why or "another explains more",
                kind=c.alternative.kind if c.alternative else "effect",
            )
        )
    return made


def _estimates(state: ModelState) -> tuple[dict[str, Estimate], tuple[list[str], Floats]]:
    n = len(state.model.unknowns)
    C = covariance(state.fit)[:n, :n]
    stderr = np.sqrt(np.maximum(np.diag(C), 0.0)) if n else np.zeros(0)
    _, sd = state.model.prior
    made = {}
    for u, number, error, prior, at in zip(
        state.model.unknowns, state.theta, stderr, sd, state.fit.at_bound, strict=False
    ):
        value = u.inside(float(number))
        seen = bool(error < SEEN * prior)
        made[u.name] = Estimate(
            value=value,
            stderr=float(error * value if u.log else error),
            unit=u.unit,
            identifiable=seen,
            why="" if seen else "the data narrow its prior by less than a third",
            at_bound=at,
            prior_sd=float(prior * value if u.log else prior),
        )
    spread = np.where(stderr > 0.0, stderr, 1.0)
    return made, ([u.name for u in state.model.unknowns], np.asarray(C / spread[:, None] / spread[None, :]))


def _everywhere(
    model: Model, theta: Floats, samples: LogSamples, robot: Robot, threads: int | None
) -> Floats:
    """(n, 3) predicted tip of every driven sample [m]; nan where the rod did not converge."""
    tip = np.full((len(samples.log), 3), np.nan)
    for start in range(0, len(tip), ALL_AT_ONCE):
        rows = np.arange(start, min(start + ALL_AT_ONCE, len(tip)))
        piece = samples.on(rows)
        pose = predict(model, theta, piece, PredictedRod(piece, robot, threads=threads))
        tip[rows] = np.where(pose.ok[:, None], pose.position, np.nan)
    return tip


def _distance(samples: LogSamples, predicted: Floats, which: Flags) -> Floats:
    squares = ((np.asarray(samples.log.tip_position) - predicted)[which] ** 2).sum(1)
    return np.asarray(squares[np.isfinite(squares)])


def _error(samples: LogSamples, before: Floats, after: Floats, which: Flags) -> Error:
    if not which.any():
        return Error(before=float("nan"), after=float("nan"), interval=(float("nan"), float("nan")))
    values = [float(np.sqrt(_distance(samples, p, which).mean())) for p in (before, after)]
    return Error(before=values[0], after=values[1], interval=_interval(samples, after, which))


def _interval(samples: LogSamples, predicted: Floats, which: Flags) -> tuple[float, float]:
    """95 % interval of a distance rms, by resampling blocks of samples."""
    squares = _distance(samples, predicted, which)
    if len(squares) < 20:
        return float("nan"), float("nan")
    means_of_blocks = [b.mean() for b in np.array_split(squares, min(20, len(squares) // 5))]
    rng = np.random.default_rng(0)
    means = rng.choice(means_of_blocks, (2000, len(means_of_blocks))).mean(1)
    low, high = np.sqrt(np.quantile(means, [0.025, 0.975]))
    return float(low), float(high)


def _path(
    start: ModelState,
    state: ModelState,
    found: list[str],
    samples: LogSamples,
    robot: Robot,
    used: Flags,
    test: Flags,
    search: Search,
    threads: int | None,
) -> list[SearchStage]:
    """Error after each effect, added in the order of what each brings."""

    def stage(name: str, at: ModelState) -> SearchStage:
        tip = _everywhere(at.model, at.theta, samples, robot, threads)
        errors = [
            float(np.sqrt(_distance(samples, tip, which).mean())) if which.any() else float("nan")
            for which in (used, test)
        ]
        return SearchStage(name=name, train=errors[0], held_out=errors[1])

    stages = [stage("base", start)]
    for i in range(1, len(found) + 1):
        piece = state
        for name in found[i:]:
            piece = search.without(piece, name)
        stages.append(stage(found[i - 1], piece))
    return stages


def limits(robot: Robot, samples: LogSamples) -> list[str]:
    """Sentences on shear and inertia, which the rod's state does not hold and no effect can carry, where this
    robot is thick or slow enough for them."""
    found = []
    thickest = max((s.body_radius / robot.length for s in robot.segments), default=0.0)
    if (fraction := _SHEAR * thickest**2) > _WORTH_SAYING:
        found.append(
            f"shear is not the rod's: {1.0 / (2.0 * thickest):.1f} times as long as thick, it is some "
            f"{100 * fraction:.0f} % of the deflection"
        )
    mass = sum(s.line_density * s.length for s in robot.segments)
    if mass > 0.0:
        soft = min(min(s.bending_stiffness) for s in robot.segments)
        frequency = 0.56 * math.sqrt(soft / (mass * robot.length**3))
        steps = sorted(samples.dt[samples.dt > 0.0].tolist())
        if frequency < _SLOW and steps and 2.0 * frequency * steps[len(steps) // 2] < 1.0:
            found.append(
                f"inertia and damping are not the rod's: it rings near {frequency:.1f} Hz, which a "
                "static model cannot follow"
            )
    return found


def _sentences(lines: Sequence[str]) -> list[str]:
    return [f"{line[0].upper()}{line[1:]}." for line in lines]
