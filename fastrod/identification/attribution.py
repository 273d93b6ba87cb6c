"""The closed loop: from logs and a robot to what the model lacks, with the error before and after on data held out.

Stages: noise and coverage of the log; which base parameters it can see at all; base fit; outliers; then, effect by effect,
`search`; backward elimination; audit of what remains; verdict, bounds and advice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from fastrod.effect import get_effect
from fastrod.errors import InputError, LogError
from fastrod.identification import advice
from fastrod.identification.audit import audit
from fastrod.identification.forward import Rod, Samples, predict, sample
from fastrod.identification.limits import limits
from fastrod.identification.local import Local, Target
from fastrod.identification.network import residual_network
from fastrod.identification.noise import Noise, keep, read_noise
from fastrod.identification.result import Error, Estimate, Found, Result, Stage, Tried
from fastrod.identification.search import N_BLOCKS, Candidate, Search, State, Step
from fastrod.identification.solve import covariance
from fastrod.identification.split import held_out_rows, merged
from fastrod.identification.unknowns import Model, base_model
from fastrod.identification.verdict import judge
from fastrod.robot import Robot
from fastrod.runlog import RunLog
from fastrod.types import Flags, Floats, Ints

MAX_EFFECTS = 4
LEAST_ROWS = 40
_LOCAL_ROWS = 3000  # samples that the search looks at; the operators run over all
_ALL_AT_ONCE = 20000  # samples a batch when all are predicted
_SEEN = 0.7  # of the prior's sd: a parameter whose data say less is not identifiable
_MENDS = 0.02  # of the error above the noise: an effect beside a dominant one that brings less is not named
_SURE = 1.06  # the variance of the noise is known from rest to about 6 %
_SAY_LIMITS = 0.05  # of the error above the noise: where so much is left, shear and inertia are worth a sentence
_RESTLESS = 0.25  # of the motion: noise beyond it is no noise
_MORE_STAGES = 3  # beyond max_effects: foils take stages too


def identify(
    logs: RunLog | Sequence[RunLog],
    robot: Robot,
    *,
    held_out: Sequence[str] = (),
    max_effects: int = MAX_EFFECTS,
    free_camera: bool = False,
    exclude: Sequence[str] = (),
    network: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
    threads: int | None = None,
) -> Result:
    """Find what the model of `robot` lacks to explain `logs`, and say how much it brings on data held out.

    `held_out`: labels of runs, or `RUN@START:END` [s], that no fit sees; where none is given, every fourth stretch of each
    run. `max_effects` at most are named. `exclude` takes effects out of the library. `free_camera` leaves registration,
    marker offset and latency to the fit. `network` trains a small network on what is left and reports it apart. `progress`
    is called with what is done, and how far of how much.
    Deterministic. Raises `LogError` for a log that cannot tell anything, `RobotError` for a wrong `[fit]`.
    """
    if isinstance(max_effects, bool) or not isinstance(max_effects, int) or max_effects < 0:
        raise InputError(f"max_effects is {max_effects!r}; it must be a whole number, 0 or more.")
    log = merged([logs] if isinstance(logs, RunLog) else list(logs))
    samples = sample(log)
    _check(samples, robot)
    tell = progress or (lambda *_: None)
    tested, labels = held_out_rows(samples, held_out)
    train = samples.rows[~tested[samples.rows]]
    if len(train) < LEAST_ROWS:
        raise LogError(f"log {log.name!r} leaves {len(train)} rows to fit once {', '.join(labels)} are held out; it needs {LEAST_ROWS}.")
    model = base_model(robot, free_camera=free_camera)
    chosen = _thinned(train)
    tell("base fit", 0, max_effects + 2)
    base = _Base(samples.on(chosen), model, robot, threads)
    search = Search(base.samples, base.rod, base.target, base.block, frozenset(exclude))
    start, base_parameters = base.fit(search)
    _check_motion(base, start)
    found, state, steps, reference = _found(search, base, start, max_effects, tell)
    result = _result(
        samples, tested, labels, robot, base, search, reference, state, found, steps, base_parameters, tell, max_effects, threads
    )
    return replace(result, network=residual_network(samples, state.model.wiring, result)) if network else result


class _Base:
    """The train samples, their noise and weights, and the base model."""

    def __init__(self, samples: Samples, model: Model, robot: Robot, threads: int | None) -> None:
        self.samples, self.model, self.robot = samples, model, robot
        self.rod = Rod(samples, robot, points=samples.log.points is not None, threads=threads)
        self.target = Target(samples, np.full(3, 1e-3 * robot.length), rotation_sigma=0.01, points=samples.log.points is not None)
        n = len(samples.rows)
        self.block: Ints = np.minimum(np.arange(n) * N_BLOCKS // n, N_BLOCKS - 1)
        self.noise = Noise(np.full(3, 1e-3), 0.0, "")
        self.notes: list[str] = []
        self.weights: list[Floats] = []
        """Sigma of each stage."""

    def fit(self, search: Search) -> tuple[State, dict[str, Estimate]]:
        """The base model with its own parameters fitted; those that this log cannot see stay nominal, with the reason."""
        model, target = self.model, self.target
        local = Local(model, model.start, self.samples, self.rod, target)
        if not local.pose.ok.all():
            lost = int((~local.pose.ok).sum())
            self.notes.append(f"the model did not converge on {lost} of {len(local.pose.ok)} rows; they do not count")
        raw = target.tip - local.pose.position
        self.noise = read_noise(self.samples, target.tip, np.nan_to_num(raw))
        given = self.robot.sensor.get("noise", 0.0)
        declared = float(max(given) if isinstance(given, tuple) else given)
        if declared > 0.0:
            self.noise = Noise(np.full(3, declared), self.noise.lag1, "the robot file's [sensor] noise")
        target.weight = (keep(self.samples, np.nan_to_num(raw), self.noise) & local.pose.ok).astype(float)
        out = int((target.weight == 0.0).sum())
        if out > 0.005 * len(raw):
            self.notes.append(f"{out} of {len(raw)} rows are outliers and do not count")
        target.sigma = self.noise.sigma.copy()
        fixed = self._unseen(local)
        model = Model(model.robot, model.wiring, model.effects, tuple(u for u in model.unknowns if u.name not in fixed))
        self.model = model
        target.sigma = self.noise.sigma * max(1.0, _rms(target.residual(local.pose)))
        state = search.start(model, model.start)
        for _ in range(2):
            state = self.weighed(search, state)
        self.weights = self.weights[-1:]
        return state, fixed

    def weighed(self, search: Search, state: State) -> State:
        """The state fitted again with weights of the size of its own residual, never below the noise: what a model does not
        explain yet must not push its parameters beyond their priors."""
        self.target.sigma = self.target.sigma * max(_rms(state.fit.residual), float((self.noise.sigma / self.target.sigma).max()))
        self.weights.append(self.target.sigma.copy())
        return search.refined(search.refined(state))

    def _unseen(self, local: Local) -> dict[str, Estimate]:
        """Base parameters whose prior this log does not narrow: Fisher information at the noise, others free."""
        model = self.model
        r = local.residual(model, model.start)
        J = local.slopes(model, model.start, r)
        flat = J.reshape(r.size, J.shape[-1])
        _, sd = model.prior
        H = flat.T @ flat + np.diag(1.0 / sd**2)
        fixed = {}
        posterior = np.sqrt(np.diag(np.linalg.pinv(H))) if len(sd) else sd
        for u, narrowed, prior in zip(model.unknowns, posterior, sd, strict=True):
            if narrowed > _SEEN * prior:
                fixed[u.name] = Estimate(
                    value=u.start,
                    stderr=float(prior),
                    unit=u.unit,
                    identifiable=False,
                    why=advice.why_unknown(u.name, self.samples),
                    prior_sd=float(prior),
                )
        return fixed


def _found(
    search: Search, base: _Base, start: State, max_effects: int, tell: Callable[[str, int, int], None]
) -> tuple[list[str], State, list[Step], State]:
    """Effects in the order in which they were found, the state with them (and with foils), the steps, the base state."""
    state, steps = start, list[Step]()
    found: list[str] = []
    for stage in range(max_effects + _MORE_STAGES):
        search.report = lambda name, stage=stage: tell(name, min(stage + 1, max_effects + 1), max_effects + 2)  # type: ignore[misc]
        step = search.stage(state)
        if step.taken is None and stage == 0:
            pair = _pair(search, state, step)
            step = pair or step
        steps.append(step)
        if step.taken is None or step.taken.state is None:
            break
        if step.taken.foil is None and len(found) == max_effects:
            break
        state = base.weighed(search, step.taken.state)
        if step.taken.foil is None:
            found += [name for name in state.model.effects if name not in found and name not in start.model.effects]
    return found, state, steps, start


def _library(
    search: Search, base: _Base, start: State, state: State, found: list[str], max_effects: int, steps: list[Step]
) -> tuple[State, list[str]]:
    """The effects that are needed once foils are gone, with their state."""
    alone = search.bare(state) if state.foils else state
    noise = start.fit.residual.size * float((base.noise.sigma**2).mean())
    while state.foils and len(found) < max_effects and alone.fit.loss * float((base.target.sigma**2).mean()) > 2.0 * noise:
        step = search.stage(alone, with_foils=False)
        if step.taken is None or step.taken.state is None:
            break
        steps.append(step)
        found = [*found, step.taken.name]
        alone = base.weighed(search, step.taken.state)
    if len(found) > 1:
        excess = start.fit.loss * float((base.weights[0] ** 2).mean()) - noise
        alone, found = search.eliminated(alone, found, _MENDS * max(excess, 0.0), noise)
    return base.weighed(search, alone), found


def _pair(search: Search, state: State, step: Step) -> Step | None:
    """Two effects at once, where none passes alone: of the five that come nearest."""
    near = sorted((c for c in step.candidates if c.state is not None and c.foil is None and c.share > 0.01), key=lambda c: -c.share)[:5]
    best: Candidate | None = None
    for i, one in enumerate(near):
        for other in near[i + 1 :]:
            assert one.state is not None
            both = search.candidate(one.state, other.name)
            if both.state is None:
                continue
            judged = search.judged(state, search.refined(both.state), other.name)
            if judged.passes and (best is None or judged.bic_gain > best.bic_gain):
                best = judged
    return None if best is None else replace(step, taken=best)


def _result(
    samples: Samples, tested: Flags, labels: Sequence[str], robot: Robot, base: _Base, search: Search, start: State, state: State,
    found: list[str], steps: list[Step], fixed: dict[str, Estimate], tell: Callable[[str, int, int], None], max_effects: int,
    threads: int | None,
) -> Result:  # fmt: skip
    tell("prediction on all samples", max_effects + 1, max_effects + 2)
    last, last_weight = state, base.weights[-1]
    if found:
        state, found = _library(search, base, start, state, found, max_effects, steps)
    order = np.argsort([-_gain(search, state, name) for name in found]) if len(found) > 1 else range(len(found))
    found = [found[int(i)] for i in order]
    outlier = np.zeros(len(samples.log), bool)
    before = _everywhere(start.model, start.theta, samples, robot, threads)
    after = _everywhere(state.model, state.theta, samples, robot, threads) if found else before
    measured = samples.log.measured
    residual = np.asarray(samples.log.tip_position) - before
    rows = np.flatnonzero(measured & np.isfinite(residual).all(1))
    outlier[rows] = ~keep(samples.on(rows), residual[rows], base.noise)
    used = measured & ~tested & ~outlier
    test = measured & tested & ~outlier
    train_error = _error(samples, before, after, used)
    test_error = _error(samples, before, after, test)
    path = _path(start, state, found, samples, robot, used, test, search, threads)
    inspected = audit(search.samples, last.model.wiring, last.fit.residual, base.noise.lag1)
    library = _square(state, base.target.sigma)
    opinion = judge(
        left_out=max(0.0, test_error.after**2 - _SURE * base.noise.floor**2) / max(test_error.before**2 - base.noise.floor**2, 1e-30),
        base=_square(start, base.weights[0]), library=library, after=min(library, _square(last, last_weight)),
        floor=base.noise.floor**2, audit=inspected, steps=steps, found=found,
    )  # fmt: skip
    kept = [] if opinion.drop_effects else found
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
    lacks = advice.missing_excitation(search.samples, wiring.bend(np.asarray(samples.log.dl))) if wiring.n_tendons else []
    recommended = [advice.look_at(pattern) for pattern in opinion.patterns]
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
        verdict="ambiguous" if opinion.verdict == "explained" and effects and effects[0].cannot_be_told_from else opinion.verdict,
        summary=" ".join(
            [opinion.summary, *(_sentences(limits(robot, samples)) if opinion.left > _SAY_LIMITS or not robot.n_tendons else [])]
        ),
        effects=effects,
        base_parameters=base_estimates,
        correlation=correlation,
        remaining=inspected,
        remaining_kind=opinion.kind,
        remaining_share=opinion.left,
        patterns=opinion.patterns,
        tried=_tried(steps[0], kept, base) if steps else [],
        path=path,
        bounds=search.bounds(state),
        advice=advice.unique([*recommended, *lacks]),
        notes=base.notes,
        solves=base.rod.runs,
    )


def _square(state: State, sigma: Floats) -> float:
    """Mean square distance that a state leaves at the samples of the search [m^2]."""
    counted = state.fit.residual[np.any(state.fit.residual != 0.0, axis=1), :3]
    return float(np.mean(((counted * sigma) ** 2).sum(1))) if len(counted) else 0.0


def _gain(search: Search, state: State, name: str) -> float:
    """Loss that comes back when an effect is taken out."""
    return search.without(state, name).fit.loss - state.fit.loss


def _effect(
    name: str,
    estimates: dict[str, Estimate],
    classes: dict[str, list[str]],
    path: list[Stage],
    steps: list[Step],
    floor: float,
) -> Found:
    parameters = {key.partition(".")[2]: value for key, value in estimates.items() if key.partition(".")[0] == name}
    taken = next((s.taken for s in steps if s.taken is not None and s.taken.name == name), None)
    evidence = {} if taken is None else {"z": taken.z, "bic": taken.bic_gain, "loss_share": taken.share}
    at = next(i for i, stage in enumerate(path) if stage.name == name)
    excess = max(path[0].held_out ** 2 - floor**2, 1e-18)
    gain = (path[at - 1].held_out ** 2 - path[at].held_out ** 2) / excess
    title = (type(get_effect(name)).__doc__ or name).strip().splitlines()[0]
    return Found(
        name=name, title=title, parameters=parameters, held_out_gain=gain, evidence=evidence, cannot_be_told_from=classes.get(name, [])
    )


def _classes(steps: list[Step], found: list[str]) -> dict[str, list[str]]:
    """Effects that explained a stage as well as the one that was taken."""
    return {
        step.taken.name: [r for r in step.rivals if r not in found] for step in steps if step.taken is not None and step.taken.name in found
    }


def _tried(step: Step, kept: list[str], base: _Base) -> list[Tried]:
    sigma = base.weights[0] if base.weights else base.target.sigma
    scale = _rms(step.before.fit.residual[:, :3]) * float(np.sqrt((sigma**2).sum()))
    made = []
    for c in sorted(step.candidates, key=lambda c: (c.state is None, -c.bic_gain)):
        rms = float("nan")
        if c.state is not None and step.before.losses.sum() > 0.0:
            rms = float(np.sqrt(c.state.losses.sum() / step.before.losses.sum())) * scale
        made.append(
            Tried(
                name=c.name, held_out_rms=rms, score=c.z, bic_gain=c.bic_gain, kept=c.name in kept,
                why="kept" if c.name in kept else c.why or "another explains more", kind=c.foil.kind if c.foil else "effect",
            )
        )  # fmt: skip
    return made


def _estimates(state: State) -> tuple[dict[str, Estimate], tuple[list[str], Floats]]:
    n = len(state.model.unknowns)
    C = covariance(state.fit)[:n, :n]
    stderr = np.sqrt(np.maximum(np.diag(C), 0.0)) if n else np.zeros(0)
    _, sd = state.model.prior
    made = {}
    for u, number, error, prior, at in zip(state.model.unknowns, state.theta, stderr, sd, state.fit.at_bound, strict=False):
        value = u.inside(float(number))
        seen = bool(error < _SEEN * prior)
        made[u.name] = Estimate(
            value=value, stderr=float(error * value if u.log else error), unit=u.unit, identifiable=seen,
            why="" if seen else "the data narrow its prior by less than a third", at_bound=at,
            prior_sd=float(prior * value if u.log else prior),
        )  # fmt: skip
    spread = np.where(stderr > 0.0, stderr, 1.0)
    return made, ([u.name for u in state.model.unknowns], np.asarray(C / spread[:, None] / spread[None, :]))


def _everywhere(model: Model, theta: Floats, samples: Samples, robot: Robot, threads: int | None) -> Floats:
    """(n, 3) predicted tip of every driven sample [m]; nan where the rod did not converge."""
    tip = np.full((len(samples.log), 3), np.nan)
    for start in range(0, len(tip), _ALL_AT_ONCE):
        rows = np.arange(start, min(start + _ALL_AT_ONCE, len(tip)))
        part = samples.on(rows)
        pose = predict(model, theta, part, Rod(part, robot, threads=threads))
        tip[rows] = np.where(pose.ok[:, None], pose.position, np.nan)
    return tip


def _distance(samples: Samples, predicted: Floats, which: Flags) -> Floats:
    squares = ((np.asarray(samples.log.tip_position) - predicted)[which] ** 2).sum(1)
    return np.asarray(squares[np.isfinite(squares)])


def _error(samples: Samples, before: Floats, after: Floats, which: Flags) -> Error:
    if not which.any():
        return Error(before=float("nan"), after=float("nan"), interval=(float("nan"), float("nan")))
    values = [float(np.sqrt(_distance(samples, p, which).mean())) for p in (before, after)]
    return Error(before=values[0], after=values[1], interval=_interval(samples, after, which))


def _interval(samples: Samples, predicted: Floats, which: Flags) -> tuple[float, float]:
    """95 % interval of a distance rms, by resampling blocks of samples."""
    squares = _distance(samples, predicted, which)
    if len(squares) < 20:
        return float("nan"), float("nan")
    parts = [b.mean() for b in np.array_split(squares, min(20, len(squares) // 5))]
    rng = np.random.default_rng(0)
    means = rng.choice(parts, (2000, len(parts))).mean(1)
    low, high = np.sqrt(np.quantile(means, [0.025, 0.975]))
    return float(low), float(high)


def _path(
    start: State,
    state: State,
    found: list[str],
    samples: Samples,
    robot: Robot,
    used: Flags,
    test: Flags,
    search: Search,
    threads: int | None,
) -> list[Stage]:
    """Error after each effect, added in the order of what each brings."""

    def stage(name: str, at: State) -> Stage:
        tip = _everywhere(at.model, at.theta, samples, robot, threads)
        errors = [float(np.sqrt(_distance(samples, tip, which).mean())) if which.any() else float("nan") for which in (used, test)]
        return Stage(name=name, train=errors[0], held_out=errors[1])

    stages = [stage("base", start)]
    for i in range(1, len(found) + 1):
        part = state
        for name in found[i:]:
            part = search.without(part, name)
        stages.append(stage(found[i - 1], part))
    return stages


def _sentences(lines: Sequence[str]) -> list[str]:
    return [f"{line[0].upper()}{line[1:]}." for line in lines]


def _check_motion(base: _Base, state: State) -> None:
    """A model that follows the measurement worse than a robot that stands still is of another robot, or in other units."""
    good = (base.target.weight > 0.0) & state.local.pose.ok
    measured, predicted = (
        base.target.tip[good],
        state.local.seen(state.model, state.theta, state.local.solved(state.model, state.theta)).position[good],
    )
    measured, predicted = measured - measured.mean(0), predicted - predicted.mean(0)
    moves = float((measured**2).sum())
    name, robot = base.samples.log.name, base.robot.name
    if base.noise.floor > _RESTLESS * np.sqrt(moves / max(len(measured), 1)) and base.noise.floor > 0.01 * base.robot.length:
        raise LogError(
            f"in log {name!r} the measured tip jumps by {1e3 * base.noise.floor:.3g} mm from sample to sample while the inputs rest, "
            f"{100 * base.noise.floor / np.sqrt(moves / len(measured)):.0f} % of its motion; are two robots or two markers mixed?"
        )
    if float(((measured - predicted) ** 2).sum()) > moves:
        scale = float((measured * predicted).sum() / max((predicted**2).sum(), 1e-30))
        raise LogError(
            f"log {name!r} is further from robot {robot!r} than from a robot that stands still: it moves {scale:.2g} times as predicted. "
            "Are the units, the signs (negative = pulled) and the order of the dl_ columns right, and is it this robot?"
        )


def _check(samples: Samples, robot: Robot) -> None:
    """A log that cannot tell anything is refused in a sentence."""
    log = samples.log
    measured = int(log.measured.sum())
    if measured == 0:
        raise LogError(f"log {log.name!r} has no row in which every input and the tip are there; there is nothing to explain.")
    if measured < LEAST_ROWS:
        raise LogError(f"log {log.name!r} has {measured} measured rows; identification needs {LEAST_ROWS} at least, better two thousand.")
    inputs = [log.dl, *(a.reshape(len(log), -1) for a in (log.ext, log.tip_force, log.payload, log.base_quaternion) if a is not None)]
    moves = np.concatenate([np.ptp(a, axis=0) for a in inputs]) if inputs else np.zeros(0)
    if not (moves > 1e-9).any():
        raise LogError(f"in log {log.name!r} no input ever changes; nothing can be told from it. fastrod excite writes a run that does.")
    if float(np.ptp(np.asarray(log.tip_position)[log.measured], axis=0).max()) < 1e-7 * robot.length:
        raise LogError(f"in log {log.name!r} the measured tip never moves; is the camera's column filled?")
    for mode, number in ((s.mode, k) for k, s in enumerate(robot.segments, 1)):
        if mode == "tendon_tension":
            raise InputError(f"segment {number} of robot {robot.name!r} is in mode 'tendon_tension', but a run log gives tendon lengths.")


def _thinned(rows: Ints) -> Ints:
    """At most `_LOCAL_ROWS` of the rows, evenly."""
    return rows if len(rows) <= _LOCAL_ROWS else rows[np.linspace(0, len(rows) - 1, _LOCAL_ROWS).round().astype(int)]


def _rms(residual: Floats) -> float:
    counted = residual[np.any(residual != 0.0, axis=1)]
    return float(np.sqrt(np.mean(counted**2))) if counted.size else 0.0
