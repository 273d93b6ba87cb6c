"""Assembly of a `Result` from the end of the search: predictions on every sample, errors, estimates,
classes, verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fastrod.effects.base import get_effect
from fastrod.identification.log import advice
from fastrod.identification.log.registration import between, frame_of
from fastrod.identification.log.samples import LogSamples
from fastrod.identification.log.split import SplitLog
from fastrod.identification.log.unknowns import SEGMENT_UNITS, TENDON_UNITS, Model, nominal_of
from fastrod.identification.report.explained import NEAR, Explained, error_of, shipped, tips_of
from fastrod.identification.report.result import Error, Found, Result, SearchStage, Tried
from fastrod.identification.report.signature import signatures
from fastrod.identification.report.verdict import AT_A_PRICE, VerdictGrounds, choose_verdict, strained
from fastrod.identification.report.wording import amount, plain_name, words
from fastrod.identification.search.base import SEEN, BaseFit, Rival
from fastrod.identification.search.model_selection import (
    BIC_STRONG,
    Z_ACCEPT,
    ModelState,
    SearchStep,
    oversized,
)
from fastrod.identification.search.residual_test import ResidualStructure, faster_than_commands
from fastrod.identification.search.revisits import Visits
from fastrod.identification.search.search import SearchOutcome
from fastrod.identification.search.solve import BEYOND, Estimate, Fit, covariance, rms
from fastrod.identification.search.structure import NAME as ONE_SIDED
from fastrod.identification.search.structure import SLACK, OneSidedTendons
from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Robot
from fastrod.types import Floats

_MATTERS = 0.05  # of the held-out error above the noise: for an effect of less no run is proposed
_MOST_ADVICE = 5  # runs
# of the held-out error: in two blocks of OpenCR's log the friction of the body took 4 and 6 % off it
_FALLS = 0.97
_DRAWN = 3  # rivals of an effect
_MANY = 0.005  # of the rows: so many outliers are worth a note
_PULL = "pull it beyond its prior and hardly say how far"
_NARROW = "narrow its prior by less than a third"
_MOST_SPOKEN = 4  # other names of an effect
_DIFFERS = 1.02  # of the error without outliers: with them it is said, too
_SURE = 1.06  # the variance of the noise is known from rest to about 6 %
# of the error above the noise: where so much is left, shear and inertia are worth a sentence
_SAY_LIMITS = 0.05
_SHEAR = 2.65  # (r / l)^2 times this is shear over bending at the tip: 3 EI / (k G A l^2), E = 3 G, circle
_WORTH_SAYING = 0.03
_NUMBERS_OF_TENDONS = {"compliance", "pretension", "axial_stiffness"}
_RETURNS = 2.8  # of the noise: a command that comes back farther off does so by more than the noise
_FAST = 0.2  # of the residual's square, above the commands' band
_LAG = "second_order_lag"
_SLOW = 10.0  # Hz; a rod that rings more slowly shows it


def verdict_on(
    base: BaseFit, outcome: SearchOutcome, explained: Explained, remaining: ResidualStructure
) -> VerdictGrounds:
    """The verdict on what was found, and what remains."""
    library, given = _square(outcome.state), base.without or base
    floor, error = base.noise.floor, explained.test_error
    # each where it was found
    named = {
        s.taken.name: s.taken for s in reversed(outcome.steps) if s.taken and s.taken.name in explained.names
    }
    classes, (held_out, n_held_out) = _classes(outcome.steps, explained.names), _held_out(explained)
    return choose_verdict(
        base=_square(given.start),
        library=library,
        after=min(library, _square(outcome.last)),
        left_out=max(0.0, error.after**2 - _SURE * floor**2) / max(error.before**2 - floor**2, 1e-30),
        floor=floor**2,
        structure=remaining,
        steps=outcome.steps,
        found=[
            *([words(ONE_SIDED)] if base.without else []),
            *(_spoken(name, explained.state.model, classes) for name in explained.names),
        ],
        held_out=(error.before, error.after),
        at_floor=held_out <= NEAR * floor,
        like_noise=held_out <= max(NEAR * floor, base.noise.most(n_held_out)),
        evident=error.after < _FALLS * error.before
        and all(one.z > Z_ACCEPT and one.bic_gain > BIC_STRONG for one in named.values()),
    )


def _held_out(explained: Explained) -> tuple[float, int]:
    """The error on data held out, or on all where nothing was [m], and its samples."""
    train, test = explained.train_error.after, explained.test_error.after
    known = math.isfinite(test)
    return (test, int(explained.test.sum())) if known else (train, int(explained.used.sum()))


def assemble(
    log: SplitLog,
    base: BaseFit,
    outcome: SearchOutcome,
    explained: Explained,
    remaining: ResidualStructure,
    grounds: VerdictGrounds,
    again: Visits,
) -> Result:
    """All that the report says; `again` are the visits of one command at two times."""
    samples, robot, noise, steps = log.samples, base.robot, base.noise, outcome.steps
    kept = [] if grounds.drop_effects else [*explained.names]
    final = explained.state if kept else explained.start
    before, after, path = explained.before, explained.after, _path(explained, log, base)
    train_error, test_error = explained.train_error, explained.test_error
    if not kept:
        after, path, length = explained.bare, path[: 2 if base.without else 1], noise.model.length
        measured = samples.log.measured
        train_error = error_of(samples, before, after, explained.used, measured & ~log.tested, length)
        test_error = error_of(samples, before, after, explained.test, measured & log.tested, length)
    estimates, correlation = estimates_of(final.model, final.fit)
    classes = _classes(steps, kept)
    effects = [
        _effect(name, final, estimates, classes, path, steps, samples.log, noise.floor) for name in kept
    ]
    if base.without:
        effects = [_other_tendons(base, base.without, estimates, path, noise.floor), *effects]
        estimates = {name: e for name, e in estimates.items() if name not in effects[0].parameters}
    wiring = final.model.wiring
    lacks = list[str]()
    if wiring.n_tendons:
        bends = wiring.of_sections(wiring.bend(samples.log.pulls))
        lacks += advice.missing_excitation(explained.search.samples, bends)
    revisits = [again.compare(tip) for tip in (before, after)]
    if wiring.n_tendons and revisits[1] is None:
        lacks.append(
            "hardly a command comes twice: a static error cannot be distinguished from memory, by which the "
            "same command leads elsewhere"
        )
    recommended = [advice.look_at(pattern) for pattern in grounds.patterns]
    recommended += [
        advice.separating_run(e.name, other)
        for e in effects
        if e.held_out_gain > _MATTERS
        for other in e.cannot_be_told_from
    ]
    base_estimates = {name: e for name, e in estimates.items() if name.partition(".")[0] not in kept}
    ambiguous = grounds.verdict == "explained" and effects and effects[0].cannot_be_told_from
    at_rest = not base.search.in_motion
    say_limits = at_rest and (grounds.left > _SAY_LIMITS or not robot.n_tendons)
    strain = strained(base_estimates)
    other_sessions = dict(enumerate(final.model.sessions[1:], 1))
    # in motion all of a long log would take as long again
    looked = explained if at_rest else outcome
    said = [AT_A_PRICE if strain and grounds.verdict == "none" else grounds.summary]
    said += _sign_of(base.without) if base.without else []
    said += _stand_ins(kept, final)
    said += _within_a_row(kept, final, samples.step)
    said += _sentences(shears(robot)) if say_limits else []
    # a lag of second order rings, too
    said += _sentences(rings(robot, samples)) if say_limits or (at_rest and _LAG in kept) else []
    fast, band = faster_than_commands(samples, np.asarray(samples.log.tip_position) - after)
    if say_limits and fast > _FAST:
        said.append(
            f"{100 * fast:.0f} % of what is left is faster than the commands, above {band:.2g} Hz: motion, "
            "which no law at rest follows."
        )
    if at_rest and revisits[1] and revisits[1].elsewhere > _RETURNS * noise.floor:
        said += _sentences([revisits[1].sentence()])
    return Result(
        log=samples.log,
        robot=robot,
        identified=final.model.identified(final.theta),
        held_out=log.labels,
        noise=noise,
        measured=samples.log.measured,
        used=explained.used,
        tested=explained.test,
        outlier=explained.outlier,
        before=before,
        after=after,
        train=train_error,
        test=test_error,
        verdict="ambiguous" if ambiguous else grounds.verdict,
        summary=" ".join([*strain, *said]),
        effects=effects,
        base_parameters=base_estimates | base.fixed,
        correlation=correlation,
        remaining=remaining,
        remaining_kind=grounds.kind,
        remaining_fraction=grounds.left,
        patterns=grounds.patterns,
        tried=_tried(steps[0], kept, base) if steps else [],
        path=path,
        bounds=looked.search.bounds(looked.state if kept else looked.start),
        advice=advice.unique([*recommended, *lacks])[:_MOST_ADVICE],
        sessions={label: final.model.identified(final.theta, k) for k, label in other_sessions.items()},
        notes=[
            *log.notes,
            *base.notes,
            *outcome.notes,
            *(outcome.suspected if kept else ()),
            *_of_sessions(final),
            *_left_out(explained, test_error),
        ],
        solves=base.search.rod.work.batches,
        as_given_rms=shipped(base, explained.used, explained.test),
        revisits=(revisits[0], revisits[1]) if revisits[0] and revisits[1] else None,
    )


def _stand_ins(names: Sequence[str], state: ModelState) -> list[str]:
    """Laws of memory that are larger than any tendon or body, in sentences."""
    said = []
    for name in names:
        for u, value in oversized(state, name):
            size = f"{plain_name(u.name)} comes out at {amount(value, u.unit)}"
            usual = f"{abs(value) / u.scale:.0f} times what is usual"
            said.append(f"{size}, {usual}: {words(name)} stands in for something else.")
    return said


def _within_a_row(names: Sequence[str], state: ModelState, step: float) -> list[str]:
    """Delays no longer than the log's `step` [s], in sentences: so exactly it does not say when its commands
    came."""
    said, values = [], state.model.values(state.theta)
    for name in sorted({"latency", "second_order_lag"} & set(names)):
        if (delay := float(values[name][0])) < 1.05 * step:
            size = f"{words(name).capitalize()} of {1e3 * delay:.2g} ms"
            said.append(f"{size} is within a row of this log: commands held until the next row look so, too.")
    return said


def _of_sessions(state: ModelState) -> list[str]:
    """Return how far each other session is from the first, in sentences."""
    model, said, first = state.model, [], frame_of(state.model.identified(state.theta))
    for k, label in enumerate(model.sessions[1:], 1):
        here, now = model.identified(state.theta, k), model.values(state.theta, k)
        camera, was = frame_of(here), model.values(state.theta)
        off = 1e3 * np.linalg.norm(camera.shift - first.shift)
        rotated = np.degrees(between(model.identified(state.theta), here).angle)
        pieces = [
            f"session {label!r} has its camera {off:.2g} mm and {rotated:.2g} deg from where "
            f"{model.sessions[0]!r} has it"
        ]
        if (name := "encoder_offset") in now:
            pieces.append(f"zeros up to {1e3 * np.abs(now[name] - was[name]).max():.2g} mm off")
        if (name := "latency") in now:
            pieces.append(
                f"a delay of {1e3 * float(now[name][0]):.0f} ms and not {1e3 * float(was[name][0]):.0f}"
            )
        said.append(", ".join(pieces))
    return said


def _left_out(explained: Explained, error: Error) -> list[str]:
    """Return how many rows jump beside what was found, and what they do to the held-out error."""
    n, every = int(explained.outlier.sum()), int(explained.search.samples.log.measured.sum())
    said = [f"{n} of {every} rows are outliers of what is left and do not count"] * (n > _MANY * every)
    measured = explained.search.samples.log.measured
    if lost := int((measured & ~(explained.used | explained.test | explained.outlier)).sum()):
        said.append(
            f"at {lost} of {every} rows the rod finds no balance in the model before or after: they do not "
            "count in either error"
        )
    if error.all_rows > _DIFFERS * error.after:
        said.append(
            f"with the rows that jump the held-out error is {1e3 * error.all_rows:.3g} mm and not "
            f"{1e3 * error.after:.3g}"
        )
    return said


def _square(state: ModelState) -> float:
    """Mean square distance that a state leaves at the samples of the search [m^2]."""
    counted = state.fit.residual[np.any(state.fit.residual != 0.0, axis=1), :3]
    return float(np.mean(((counted * state.linearised.target.sigma) ** 2).sum(1))) if len(counted) else 0.0


def _other_tendons(
    base: BaseFit, given: BaseFit, estimates: dict[str, Estimate], path: list[SearchStage], floor: float
) -> Found:
    """The tendons of `base`, which the robot as it was `given` did not have, as what the model lacked; their
    numbers are those that its file does not fit."""
    kinds = _NUMBERS_OF_TENDONS - {target.rpartition(".")[2] for target in given.robot.fit}
    best = next(rival for rival in base.rivals if _is_taken(rival, base.robot))
    return Found(
        name=ONE_SIDED,
        title=(OneSidedTendons.__doc__ or "").strip().splitlines()[0],
        parameters={
            name: _in_its_unit(name, e, base.robot)
            for name, e in estimates.items()
            if name.rpartition(".")[2] in kinds
        },
        held_out_gain=(path[0].held_out ** 2 - path[1].held_out ** 2)
        / max(path[0].held_out ** 2 - floor**2, 1e-18),
        evidence={"z": best.z, "bic": best.bic_gain, "loss_share": best.fraction},
        cannot_be_told_from=[],
    )


def _in_its_unit(name: str, e: Estimate, robot: Robot) -> Estimate:
    """A number of other tendons in its own unit: what was nominal, no file says."""
    kind = name.rpartition(".")[2]
    if e.unit != "x nominal":
        return e
    unit, nominal = (SEGMENT_UNITS | TENDON_UNITS)[kind], nominal_of(robot, kind, 0)
    sizes = {key: nominal * getattr(e, key) for key in ("value", "stderr", "prior_sd", "prior_mean")}
    return replace(e, unit=unit, **sizes)


def _sign_of(given: BaseFit) -> list[str]:
    """The parameter that the file's own tendons pull furthest beyond its prior, in a sentence; none where
    none is."""
    estimates, _ = estimates_of(given.start.model, given.start.fit)
    far = max(estimates, key=lambda name: abs(estimates[name].prior_distance), default="")
    if not far or not estimates[far].beyond_prior:
        return []
    distance = abs(estimates[far].prior_distance)
    return [f"The sign of it: with push-pull tendons {plain_name(far)} is {distance:.1f} sd from its prior."]


def _is_taken(rival: Rival, robot: Robot) -> bool:
    """Whether a robot with other tendons is this one."""
    shortens = any(math.isfinite(s.axial_stiffness) for s in robot.segments)
    return rival.name == (ONE_SIDED if shortens else SLACK)


def _spoken(name: str, model: Model, classes: dict[str, list[str]]) -> str:
    """An effect in words, with the drive that has it and the others that it may be as well."""
    drive, others = model.drive_of(name), classes.get(name, [])
    said = name if drive is None else f"{name} of drive {drive + 1}"
    if len(others) > _MOST_SPOKEN:  # the list below the sentence has them all
        others = [*others[: _MOST_SPOKEN - 1], f"one of {len(others) - _MOST_SPOKEN + 1} more"]
    return f"{said} (or {' or '.join(others)}: this log cannot say)" if others else said


def _effect(
    name: str,
    state: ModelState,
    estimates: dict[str, Estimate],
    classes: dict[str, list[str]],
    path: list[SearchStage],
    steps: Sequence[SearchStep],
    log: RunLog,
    floor: float,
) -> Found:
    parameters = {
        key.partition(".")[2]: value for key, value in estimates.items() if key.partition(".")[0] == name
    }
    step = next((s for s in steps if s.taken is not None and s.taken.name == name), None)
    taken, others = (None, ()) if step is None else (step.taken, step.candidates)
    states = {c.name: c.state for c in others if c.state is not None and c.alternative is None}
    rivals = classes.get(name, [])
    evidence = {} if taken is None else {"z": taken.z, "bic": taken.bic_gain, "loss_share": taken.fraction}
    at = next(i for i, stage in enumerate(path) if stage.name == name)
    excess = max(path[0].held_out ** 2 - floor**2, 1e-18)
    gain = (path[at - 1].held_out ** 2 - path[at].held_out ** 2) / excess
    title = (type(get_effect(name)).__doc__ or name).strip().splitlines()[0]
    drive = state.model.drive_of(name)
    if drive is not None:
        title = f"{title} Only drive {drive + 1} has it."
    return Found(
        name=name,
        title=title,
        parameters=parameters,
        held_out_gain=gain,
        evidence=evidence,
        cannot_be_told_from=rivals,
        drive=None if drive is None else drive + 1,
        signatures=signatures(name, state, [(r, states[r]) for r in rivals[:_DRAWN] if r in states], log),
    )


def _classes(steps: Sequence[SearchStep], found: Sequence[str]) -> dict[str, list[str]]:
    """Effects that explained a stage as well as the one that was taken."""
    return {
        step.taken.name: [r for r in step.rivals if r not in found]
        for step in steps
        if step.taken is not None and step.taken.name in found
    }


def _tried(step: SearchStep, kept: list[str], base: BaseFit) -> list[Tried]:
    scale = rms(step.before.fit.residual[:, :3]) * float(np.sqrt((base.search.target.sigma**2).sum()))
    alike = dict.fromkeys(step.rivals, "explains as much: this log cannot tell them apart") if kept else {}
    rejected = "another explains more" if kept else "not certain beside what this test does not explain"
    made = [
        Tried(
            name=rival.name,
            held_out_rms=rival.left,
            score=rival.z,
            bic_gain=rival.bic_gain,
            kept=(taken := base.without is not None and _is_taken(rival, base.robot)),
            why=f"{'kept: ' if taken else ''}{rival.what}",
            kind="tendons",
        )
        for rival in base.rivals
    ]
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
                why="kept" if c.name in kept else c.why or alike.get(c.name, rejected),
                kind=c.alternative.kind if c.alternative else "effect",
            )
        )
    return made


def estimates_of(model: Model, fit: Fit) -> tuple[dict[str, Estimate], tuple[list[str], Floats]]:
    """The fitted numbers of a model with their standard errors, and their names and correlations."""
    n = len(model.unknowns)
    C = covariance(fit)[:n, :n]
    stderr = np.sqrt(np.maximum(np.diag(C), 0.0)) if n else np.zeros(0)
    made = {}
    for u, number, error, mean, prior, at in zip(
        model.unknowns, fit.theta[:n], stderr, *model.prior, fit.at_bound, strict=False
    ):
        value, distance = u.inside(float(number)), float((number - mean) / prior)
        seen = bool(error < SEEN * prior)
        made[u.name] = Estimate(
            value=value,
            stderr=float(error * value if u.log else error),
            unit=u.unit,
            identifiable=seen,
            why="" if seen else f"the data {_PULL if abs(distance) > BEYOND else _NARROW}",
            at_bound=at,
            prior_sd=float(prior * value if u.log else prior),
            prior_mean=u.inside(float(mean)),
            prior_distance=distance,
        )
    spread = np.where(stderr > 0.0, stderr, 1.0)
    return made, ([u.name for u in model.unknowns], np.asarray(C / spread[:, None] / spread[None, :]))


def _path(explained: Explained, log: SplitLog, base: BaseFit) -> list[SearchStage]:
    """Error after each effect, added in the order of what each brings."""

    def stage(name: str, at: ModelState) -> SearchStage:
        tip = tips_of(at, log.samples, base)
        train, test = (error_of(log.samples, tip, tip, own) for own in (explained.used, explained.test))
        return SearchStage(name=name, train=train.before, held_out=test.before)

    stages, noise = [stage("base", explained.start)], base.noise.sigma
    if base.without:
        train, test = explained.train_error.before, explained.test_error.before
        stages = [SearchStage(name="base", train=train, held_out=test), replace(stages[0], name=ONE_SIDED)]
    # as the search finds them: taken away from the whole model one by one, effects that correct each other
    # leave a fit that starts far from where it should end
    search, piece = explained.search.weighed(explained.start, noise)
    for name in explained.names[:-1]:
        added = search.refined(search.beside(piece, name, explained.state))
        search, piece = search.weighed(added, noise)
        stages.append(stage(name, piece))
    return [*stages, *(stage(name, explained.state) for name in explained.names[-1:])]


def shears(robot: Robot) -> list[str]:
    """Return what to try where this robot is thick enough for shear and its file leaves that out."""
    thickest = max((s.body_radius / robot.length for s in robot.segments), default=0.0)
    sheared = any(math.isfinite(s.shear_stiffness) for s in robot.segments)
    if sheared or (fraction := _SHEAR * thickest**2) <= _WORTH_SAYING:
        return []
    return [
        f"shear may be {100 * fraction:.0f} % of the deflection of a body {0.5 / thickest:.1f} times as "
        "long as thick: give its segments a shear_stiffness, and a [fit] of it"
    ]


def rings(robot: Robot, samples: LogSamples) -> list[str]:
    """Return what to try where this robot is heavy enough to ring as slowly as the log can show."""
    mass, base = 0.0, 0.0  # of an even rod that rings as slowly (Rayleigh, a cantilever bent at its end)
    for segment in robot.segments:
        mass += segment.line_density * segment.length
        for lump in segment.lumps:
            x = (base + lump.at) / robot.length
            mass += 140.0 / 33.0 * lump.mass * (0.5 * x**2 * (3.0 - x)) ** 2
        base += segment.length
    soft = min(min(s.bending_stiffness) for s in robot.segments)
    frequency = 0.56 * math.sqrt(soft / robot.length**3 / mass) if mass > 0.0 else math.inf
    if frequency >= _SLOW or not samples.step or 2.0 * frequency * samples.step >= 1.0:
        return []
    return [
        f"the robot rings near {frequency:.1f} Hz, which a model at rest cannot follow: identify it "
        "in motion, with --dynamics"
    ]


def _sentences(lines: Sequence[str]) -> list[str]:
    return [f"{line[0].upper()}{line[1:]}." for line in lines]
