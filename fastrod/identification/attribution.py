"""The closed loop: from logs and a robot to what the model lacks, with the error before and after on data
held out.

One path, each step a function of those before: the log, split; the base fit; candidates for its residual,
found effect by effect; those that are needed, on every sample; what still remains; verdict and report.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fastrod.checks import NOT_NEGATIVE, check_number
from fastrod.effects.base import effect_names, get_effect
from fastrod.effects.executor import acts_on_commands, feels_tip
from fastrod.effects.pipeline import named_effects
from fastrod.errors import InputError, LogError
from fastrod.identification.learned.network import check_network, residual_network
from fastrod.identification.log.base_model import base_model
from fastrod.identification.log.clock import MARGIN, clock_offset
from fastrod.identification.log.motion import beginnings
from fastrod.identification.log.questions import read, time_question
from fastrod.identification.log.registration import between
from fastrod.identification.log.split import SplitLog, split, thinned
from fastrod.identification.log.unknowns import Model
from fastrod.identification.report.assemble import assemble, verdict_on
from fastrod.identification.report.explained import explain
from fastrod.identification.report.motion import named
from fastrod.identification.report.result import Result
from fastrod.identification.report.wording import with_error
from fastrod.identification.search.base import BaseFit, check_motion, fit_base
from fastrod.identification.search.model_selection import Candidate, ModelState, SearchStep
from fastrod.identification.search.motion import DAMPING, INERTIA, damped, fit_motion
from fastrod.identification.search.residual_test import residual_structure
from fastrod.identification.search.revisits import visits
from fastrod.identification.search.search import MOST_PASSES, Search, SearchOutcome
from fastrod.identification.search.solve import rms
from fastrod.identification.search.structure import are_pulled, are_worth_trying, one_sided
from fastrod.loading import robot_of
from fastrod.logs.reader import log_of
from fastrod.logs.runlog import RunLog, on_one_clock
from fastrod.model.robot import Robot
from fastrod.model.routing import route
from fastrod.solver.options import Observer, solver_of
from fastrod.threads import one_blas_thread
from fastrod.types import Ints

MAX_EFFECTS = 4
# samples that the search looks at; the operators run over all, and what is found is fitted to all. Few are
# enough where the noise is no limit, and where a row costs more, as of a rod of modes: a robot has tens of
# unknowns, not hundreds
_SEARCH_ROWS, _FEW_ROWS = 1500, 500
_FAR = 10.0  # of the noise: where the base model leaves more, few rows are enough
_MIN_GAIN = (
    0.02  # of the error above the noise: an effect beside a dominant one that brings less is not named
)
# effects beyond max_effects that the search may hold: among many small ones the dominant one may come late
_SPARE = 2
# of what the best single effect leaves, and of what is left where none is certain or all were found: a robot
# of other tendons that leaves less is the one to go on with
_MUCH_LESS, _LESS = 0.8, 0.9
_ALIKE = 1.2  # what is left of a long log: so many times what is left at its beginning
MOST_WORK = 2e7
"""Passes of a segment (`Work`) in a search: it begins no further stage that would end later if it took as
many as the last one. Most logs take a tenth; all of it is one to three CPU minutes."""
_MORE_STAGES = 3  # beyond max_effects: alternative patterns take stages too


@one_blas_thread
def identify(
    logs: RunLog | str | Path | Sequence[RunLog | str | Path],
    robot: Robot | str | Path,
    *,
    held_out: Sequence[str] = (),
    max_effects: int = MAX_EFFECTS,
    free_camera: bool = False,
    exclude: Sequence[str] = (),
    network: bool = False,
    dynamics: bool = False,
    only_session: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
    threads: int | None = None,
) -> Result:
    """Find what the model of `robot` lacks to explain `logs`, and say how much it brings on data held out.

    Logs and robot may be given by their files, and a shipped robot by its name. `held_out`: labels of runs,
    or `RUN@START:END` [s], that no fit sees; where none is given, every fourth stretch of each run.
    `max_effects` at most are named. `exclude` takes effects out of the library.
    With `max_effects` 0 nothing is looked for: the base model is fitted, and that is the result.
    `free_camera` leaves registration, marker offset and latency to the fit. `network` trains a small network
    on what is left and reports it apart. `progress` is called with what is done, and how far of how much.
    `dynamics` replays the log in motion, with inertia and damping; the camera's place is not registered
    there, and `free_camera` frees its priors only.
    Zeros of the drives, registration and delay are of a session, where the log names several, and all else is
    shared. With `only_session` they alone are fitted: a robot that was identified before, on another day; no
    effect is tried.
    Deterministic. A search that takes too long stops by work that is counted (`MOST_WORK`), as a note says.
    Raises `LogError` for a log that cannot tell anything, `RobotError` for a wrong `[fit]`.
    """
    check_number("max_effects", max_effects, NOT_NEGATIVE, whole=True)
    if network and dynamics:
        raise InputError("network=True is for a log at rest; leave it out with dynamics=True.")
    if only_session and dynamics:
        raise InputError("only_session=True is for a log at rest; leave it out with dynamics=True.")
    max_effects = 0 if only_session else max_effects
    if network:
        check_network()
    progressed, most = progress or (lambda *_: None), max_effects + _SPARE + 2
    robot = robot_of(robot)
    given = [logs] if isinstance(logs, (RunLog, str, Path)) or not isinstance(logs, Sequence) else logs
    every = [log_of(one, robot) for one in given]
    log = split(every, robot, held_out)
    excluded = frozenset(exclude) | _not_of(robot, log.samples.log, dynamics)
    # refuses a wrong [fit] before anything is solved
    model = base_model(
        robot,
        free_camera=free_camera,
        dynamics=dynamics,
        sessions=log.samples.sessions if dynamics else ("",),
    )
    if dynamics:
        return _in_motion(log, robot, model, free_camera, excluded, max_effects, progressed, threads)
    if max_effects and (found := _rings(log, robot, progressed, threads)):
        return found
    progressed("registration", 0, most)
    if clock := clock_offset(log.samples, robot, threads):
        log = split([on_one_clock(one, clock + MARGIN) for one in every], robot, held_out)
    some = log.samples.on(thinned(log.rows, _FEW_ROWS))
    reading = read(some, robot, threads=threads)
    if reading.refusal:
        raise LogError(reading.refusal)
    moved = reading.registration is not None

    def model_of(robot: Robot) -> Model:
        seen = robot if reading.registration is None else reading.registration.on(robot)
        return base_model(
            seen,
            free_camera=free_camera,
            registered=moved,
            margin=MARGIN if clock else 0.0,
            sessions=log.samples.sessions,
            only_session=only_session,
            loaded=_is_loaded(log.samples.log),
        )

    progressed("base fit", 0, most)
    base = fit_base(some, log.rows, model_of(robot), robot, excluded, threads)
    if base.left < _FAR * base.noise.floor and isinstance(solver_of([robot]), Observer):
        some = log.samples.on(thinned(log.rows, _SEARCH_ROWS))
        base = fit_base(some, log.rows, model_of(robot), robot, excluded, threads, base)
    progressed(base.sentence, 0, most)

    log, base, outcome = _found(log, base, reading.guess, max_effects, model_of, progressed, threads)
    progressed("prediction on all samples", most - 1, most)
    result = _concluded(log, base, outcome)
    # what was asked of a robot with other tendons is answered
    questions = reading.questions if base.without is None else filter(None, [time_question(some)])
    result = replace(result, notes=[*questions, *result.notes])
    if moved:
        at = between(robot, result.identified)
        sentence = f"{at.sentence().capitalize()}; all errors are given with it registered there."
        result = replace(result, registration=at, summary=f"{result.summary} {sentence}")
    if clock:
        result = _on_one_clock(result, robot, clock)
    return (
        replace(result, network=residual_network(log.samples, base.start.model.wiring, result))
        if network
        else result
    )


def _not_of(robot: Robot, log: RunLog, dynamics: bool) -> frozenset[str]:
    """Effects that are none of such a robot: of tendon lengths where forces drive the tendons, of a tip that
    was not measured, and of a load that no log names, or that is a mass in motion."""
    names = {name for name in effect_names() if not acts_on_commands(get_effect(name), route(robot))}
    if log.without_tip:
        names |= {"marker_offset", *(name for name in effect_names() if feels_tip(get_effect(name)))}
    return frozenset(names if _is_loaded(log) and not dynamics else names | {"load_offset"})


def _is_loaded(log: RunLog) -> bool:
    """Whether a log names a load at the tip."""
    return any(load is not None and bool(np.nan_to_num(load).any()) for load in (log.payload, log.tip_force))


def _on_one_clock(result: Result, robot: Robot, laid: float) -> Result:
    """The result of a log of `robot` whose commands were laid on the camera's clock `laid` + `MARGIN` [s]
    earlier: what is left of that is the delay that was fitted, which is no delay of the robot."""
    own = named_effects(robot).get("latency")
    delay = result.base_parameters["latency.delay"]
    known = 0.0 if own is None else float(own["delay"])
    offset = replace(delay, value=laid + MARGIN + known - delay.value)
    sentence = (
        f"The commands stand {with_error(offset.value, offset.stderr, 's')} later in the log than they "
        "acted: two clocks; all errors are given with both on one."
    )

    def clocked(found: Robot) -> Robot:
        others = tuple(effect for effect in found.effects if effect["name"] != "latency")
        late = () if own is None else ({"name": "latency", **own},)
        clock = robot.log.clock + offset.value
        return replace(found, log=replace(robot.log, clock=clock), effects=(*late, *others))

    return replace(
        result,
        clock=offset,
        identified=clocked(result.identified),
        sessions={label: clocked(each) for label, each in result.sessions.items()},
        summary=f"{result.summary} {sentence}",
    )


def _concluded(log: SplitLog, base: BaseFit, outcome: SearchOutcome, whole: bool = False) -> Result:
    """All that follows from what a search has found, and data held out confirm; `whole` as in `explain`."""
    explained = explain(log, base, outcome, whole)
    if why := explained.refused(base.noise.floor):
        outcome = _nothing_found(base, outcome, why)
        explained = explain(log, base, outcome, whole)
    remaining = residual_structure(
        base.search.samples,
        base.start.model.wiring,
        outcome.last.fit.residual,
        noise_lag1=base.noise.lag1,
        correlation=base.search.row_correlation,
        doubt=base.noise.uncertainty,
    )
    base = replace(base, noise=base.noise.below(explained.train_error.after))
    again = visits(log.samples, explained.start.model, explained.start.theta)
    remaining = remaining.with_memory(again.compare(explained.after))
    grounds = verdict_on(base, outcome, explained, remaining)
    return assemble(log, base, outcome, explained, remaining, grounds, again)


def _rings(
    log: SplitLog, robot: Robot, progressed: Callable[[str, int, int], None], threads: int | None
) -> Result | None:
    """Return what the model at rest lacks of a robot with a mass that was let go: inertia and damping;
    None where it was not, or where these do not explain much."""
    if log.swings is None:
        return None
    log = log.swings
    progressed("base fit", 0, 1)
    some = log.samples.on(thinned(log.rows, _SEARCH_ROWS))
    still = fit_base(
        some, log.rows, base_model(robot, sessions=log.samples.sessions), robot, frozenset(), threads
    )
    progressed("inertia and damping", 0, 1)
    moved = damped(robot)
    model = base_model(moved, dynamics=True, sessions=log.samples.sessions)
    moving = fit_motion(log.samples.on(log.rows), model, moved, threads=threads)
    if moving.left > _LESS * still.left:
        return None
    result = _concluded(log, moving, _searched(moving, 0, progressed))
    return named(result, log, still, moving, (INERTIA, DAMPING))


def _in_motion(
    log: SplitLog,
    robot: Robot,
    model: Model,
    free_camera: bool,
    excluded: frozenset[str],
    max_effects: int,
    progressed: Callable[[str, int, int], None],
    threads: int | None,
) -> Result:
    """Return what the model of `robot` in motion lacks: damping, where its file has none, then effects. Of a
    long log it is found in a beginning, where that does for the rest."""
    most, log = max_effects + _SPARE + 2, log.swings or log

    def fitted(rows: Ints, model: Model, robot: Robot) -> BaseFit:
        def report(what: str) -> None:
            progressed(what, 0, most)

        return fit_motion(log.samples.on(rows), model, robot, excluded, threads=threads, report=report)

    for rows in beginnings(log.samples, log.rows):
        base, without = fitted(rows, model, robot), None
        if max_effects and not any(s.damping_time for s in robot.segments):
            moved = damped(robot)
            other = fitted(
                rows,
                base_model(moved, free_camera=free_camera, dynamics=True, sessions=model.sessions),
                moved,
            )
            if other.left < _LESS * base.left:
                base, without = other, base
        progressed(base.sentence, 0, most)
        outcome = _searched(base, max_effects, progressed)
        for whole in (False, True):  # what was found, fitted to all where a beginning does not do
            progressed("fit to all samples" if whole else "prediction on all samples", most - 1, most)
            result = _concluded(log, base, outcome, whole)
            result = named(result, log, without, base, (DAMPING,)) if without else result
            if len(rows) == len(log.rows):
                return result
            here, later = _left_later(result, rows)
            if later <= _ALIKE * max(here, result.noise.floor):
                said = (
                    f"The search in motion looked at {len(rows)} of {len(log.rows)} rows, the beginnings of "
                    f"runs{', and the fit at all' if whole else ''}; those leave {1e3 * here:.2g} mm, the "
                    f"others {1e3 * later:.2g} mm."
                )
                return replace(result, notes=[*result.notes, said])
    return result


def _left_later(result: Result, rows: Ints) -> tuple[float, float]:
    """Distance rms [m] that a result leaves at the rows that were fitted, and at the others that might have
    been; infinite where the rod is lost."""
    off = np.linalg.norm(np.asarray(result.log.tip_position) - result.after, axis=1)
    lost, fitted = result.measured & ~np.isfinite(off), np.isin(np.arange(len(off)), rows)
    if lost.any():
        return 0.0, np.inf
    here, later = (rms(off[result.used & which, None]) for which in (fitted, ~fitted))
    return here, later


def _found(
    log: SplitLog,
    base: BaseFit,
    guess: str,
    max_effects: int,
    model_of: Callable[[Robot], Model],
    progressed: Callable[[str, int, int], None],
    threads: int | None,
) -> tuple[SplitLog, BaseFit, SearchOutcome]:
    """Return what the search finds, with log and base fit of the tendons that it goes on with. Raises
    `LogError` where the model does not follow the log, as the sentence `guess` may say."""
    most = max_effects + _SPARE + 2

    def other_tendons(base: BaseFit, below: float) -> tuple[SplitLog, BaseFit]:
        progressed("tendons that can only pull", 0, most)
        found = one_sided(log, base, _FEW_ROWS, model_of, threads, below)
        if found[1].without is not None:
            progressed(f"tendons that can only pull: {found[1].sentence}", 0, most)
        return found

    try:
        check_motion(base, guess)
    except LogError:  # of tendons that the file has otherwise, it may be
        if max_effects and are_worth_trying(base, base.left) and are_pulled(base):
            log, base = other_tendons(base, _MUCH_LESS * base.left)
        if base.without is None:
            raise
    begun = base.search.rod.work.passes
    # beside the best single effect, which may be all; then beside all that were found
    first = _first(base, progressed, most) if max_effects and base.without is None else None
    if first and are_worth_trying(base, left := _left(base, first)) and are_pulled(base):
        log, base = other_tendons(base, (_MUCH_LESS if left < base.left else _LESS) * left)
    known = None if base.without or first is None else (first, begun)
    outcome = _searched(base, max_effects, progressed, known)
    left = replace(base, start=outcome.state).left
    in_vain = max_effects and base.without is None and not base.rivals and not outcome.search.spent
    if in_vain and are_worth_trying(base, left):
        log, base = other_tendons(base, _LESS * left)
        if base.without:
            outcome = _searched(base, max_effects, progressed)
    return log, base, outcome


def _first(base: BaseFit, progressed: Callable[[str, int, int], None], most: int) -> SearchStep:
    """The first stage of the search."""
    return replace(base.search, report=lambda name: progressed(name, 1, most)).stage(base.start)


def _left(base: BaseFit, step: SearchStep) -> float:
    """Distance that the best single effect leaves, rms [m]; that of the base model where none passes."""
    taken = step.taken
    found = taken is not None and taken.state is not None and taken.alternative is None
    return replace(base, start=taken.state).left if found and taken and taken.state else base.left


def _searched(
    base: BaseFit,
    max_effects: int,
    progressed: Callable[[str, int, int], None],
    first: tuple[SearchStep, float] | None = None,
) -> SearchOutcome:
    """Return what the search finds beside a base model, and needs."""
    return _needed(base, _candidates(base, max_effects, progressed, first), max_effects)


def _candidates(
    base: BaseFit,
    max_effects: int,
    progressed: Callable[[str, int, int], None],
    first: tuple[SearchStep, float] | None = None,
) -> SearchOutcome:
    """Effects and alternative patterns that explain the residual of the base model, in the order in which
    they were found; the `first` stage may be known, the work done before it."""
    most = max_effects + _SPARE
    search, state, known = base.search, base.start, base.start.model.effects
    names, steps, notes, last = list[str](), list[SearchStep](), list[str](), 0.0
    step, begun = first or (None, search.rod.work.passes)
    for stage in range(most + _MORE_STAGES if max_effects else 0):
        taken = search.rod.work.passes - begun
        if stage and taken + (taken - last) > MOST_WORK:
            said = "what comes beside what it found was not tried"
            notes.append(f"the search took too long and stopped after stage {stage}: {said}")
            break
        last = taken if stage else 0.0

        def report(name: str, done: int = stage + 1) -> None:
            progressed(name, min(done, most), most + 2)

        search = replace(search, report=report)
        step = step if step and stage == 0 else search.stage(state)
        if step.taken is None and stage == 0:
            step = _pair(search, state, step, begun) or step
        steps.append(step)
        if step.taken is None or step.taken.state is None:
            break
        if step.taken.alternative is None and len(names) == most:
            break
        search, state = search.weighed(step.taken.state, base.noise.sigma)
        if step.taken.alternative is None:
            names += [name for name in state.model.effects if name not in names and name not in known]
    return SearchOutcome(
        search=search,
        start=base.start,
        last=state,
        state=state,
        names=tuple(names),
        steps=tuple(steps),
        notes=tuple(notes),
    )


def _nothing_found(base: BaseFit, outcome: SearchOutcome, why: str) -> SearchOutcome:
    """The outcome without what was found, and why."""
    first = outcome.steps[0]
    tried = tuple(replace(c, why=why) if c.name in outcome.names else c for c in first.candidates)
    none = replace(first, candidates=tried, taken=None, rivals=())
    start = outcome.start
    return replace(outcome, search=base.search, last=start, state=start, names=(), steps=(none,))


def _needed(base: BaseFit, all_found: SearchOutcome, max_effects: int) -> SearchOutcome:
    """The effects that are needed once alternative patterns are gone, with their state."""
    search, state, found, steps = all_found.search, all_found.last, [*all_found.names], [*all_found.steps]
    alone, suspected, begun = base.start, list[str](), search.rod.work.passes
    if found:
        alone = search.bare(state) if state.alternatives else state
        noise = base.start.fit.residual.size * float((base.noise.sigma**2).mean())
        while (
            state.alternatives
            and len(found) < max_effects
            and search.rod.work.passes - begun < 0.5 * MOST_WORK
            and alone.fit.loss * float((search.target.sigma**2).mean()) > 2.0 * noise
        ):
            step = search.stage(alone, with_alternatives=False)
            if step.taken is None or step.taken.state is None:
                break
            steps.append(step)
            found = [*found, step.taken.name]
            search, alone = search.weighed(step.taken.state, base.noise.sigma)
        if len(found) > 1:
            excess = base.start.fit.loss * float((base.search.target.sigma**2).mean()) - noise
            least = _MIN_GAIN * max(excess, 0.0)
            alone, found, suspected = search.eliminated(alone, found, least, noise)
            alone, kept, again = search.again_beside_all(alone, found, steps)
            steps += again
            if kept != found:
                alone, found, more = search.eliminated(alone, kept, least, noise)
                suspected += more
        while len(found) > max_effects:
            fewer = {name: search.without(alone, name) for name in found}
            weakest = min(fewer, key=lambda name: fewer[name].fit.loss)
            alone, found = fewer[weakest], [name for name in found if name != weakest]
        search, alone = search.weighed(alone, base.noise.sigma)
    stopped = (
        f"the search stopped early: the model hardly converges, and has taken {MOST_PASSES:.0f} passes "
        "for each row; more effects may be missing"
    )
    # with its own weights: bounds and squares of a residual under another's would be of no model
    return replace(
        all_found,
        search=search,
        start=base.start,
        state=alone if found else base.start,
        names=tuple(found),
        steps=tuple(steps),
        suspected=tuple(suspected),
        notes=(*all_found.notes, *([stopped] if search.spent else [])),
    )


def _pair(search: Search, state: ModelState, step: SearchStep, begun: float) -> SearchStep | None:
    """Two effects at once, where none passes alone: of the five that come nearest, and as many pairs as a
    search may try that has `begun` after so much work."""
    near = sorted(
        (c for c in step.candidates if c.state is not None and c.alternative is None and c.fraction > 0.01),
        key=lambda c: -c.fraction,
    )[:5]
    best: Candidate | None = None
    for i, one in enumerate(near):
        for other in near[i + 1 :]:
            assert one.state is not None
            if search.rod.work.passes - begun > MOST_WORK:
                break
            both = search.candidate(one.state, other.name)
            if both.state is None:
                continue
            solved = search.refined(both.state, borrow=search.rod.of_modes)
            judged = search.judged(state, solved, other.name)
            if judged.passes and (best is None or judged.bic_gain > best.bic_gain):
                best = judged
    return None if best is None else replace(step, taken=best)
