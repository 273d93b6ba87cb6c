"""The closed loop: from logs and a robot to what the model lacks, with the error before and after on data
held out.

Stages: noise and coverage of the log; which base parameters it can see at all; base fit; outliers; then,
effect by effect,
`search`; backward elimination; audit of what remains; verdict, bounds and advice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from fastrod.errors import InputError, LogError
from fastrod.identification.learned.network import check_network, residual_network
from fastrod.identification.log.forward import sample
from fastrod.identification.log.questions import read
from fastrod.identification.log.registration import between
from fastrod.identification.log.split import held_out_rows, merged
from fastrod.identification.log.unknowns import base_model
from fastrod.identification.report.assemble import ALL_AT_ONCE, assemble
from fastrod.identification.report.result import Result
from fastrod.identification.search.base import LEAST_ROWS, BaseFit, check_log, check_motion
from fastrod.identification.search.model_selection import Candidate, ModelState, SearchStep
from fastrod.identification.search.search import MOST_PASSES, Search
from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Robot
from fastrod.types import Ints

MAX_EFFECTS = 4
# samples that the search looks at; the operators run over all, and what is found is fitted to all
_SEARCH_ROWS = 1500
_MIN_GAIN = (
    0.02  # of the error above the noise: an effect beside a dominant one that brings less is not named
)
# effects beyond max_effects that the search may hold: among many small ones the dominant one may come late
_SPARE = 2
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

    `held_out`: labels of runs, or `RUN@START:END` [s], that no fit sees; where none is given, every fourth
    stretch of each run. `max_effects` at most are named. `exclude` takes effects out of the library.
    `free_camera` leaves registration, marker offset and latency to the fit. `network` trains a small network
    on what is left and reports it apart. `progress` is called with what is done, and how far of how much.
    Deterministic. Raises `LogError` for a log that cannot tell anything, `RobotError` for a wrong `[fit]`.
    """
    if isinstance(max_effects, bool) or not isinstance(max_effects, int) or max_effects < 0:
        raise InputError(f"max_effects is {max_effects!r}; it must be a whole number, 0 or more.")
    if network:
        check_network()
    log = merged([logs] if isinstance(logs, RunLog) else list(logs))
    if not log.driven.any():
        raise LogError(
            f"log {log.name!r} has no row in which every input is there; there is nothing to "
            "drive the model with."
        )
    samples = sample(log)
    check_log(samples, robot)
    progressed = progress or (lambda *_: None)
    tested, labels = held_out_rows(samples, held_out)
    train = samples.rows[~tested[samples.rows]]
    if len(train) < LEAST_ROWS:
        raise LogError(
            f"log {log.name!r} leaves {len(train)} rows to fit once {', '.join(labels)} are held "
            f"out; it needs {LEAST_ROWS}."
        )
    base_model(robot, free_camera=free_camera)  # refuses a wrong [fit] before anything is solved
    chosen = _thinned(train, _SEARCH_ROWS)
    progressed("registration", 0, max_effects + _SPARE + 2)
    reading = read(samples.on(chosen), robot, threads=threads)
    if reading.refusal:
        raise LogError(reading.refusal)
    registered_robot = robot if reading.registration is None else reading.registration.on(robot)
    model = base_model(registered_robot, free_camera=free_camera, registered=registered_robot is not robot)
    progressed("base fit", 0, max_effects + _SPARE + 2)
    base = BaseFit(samples.on(chosen), train, model, robot, threads)
    base.notes += reading.questions
    search = Search(base.samples, base.rod, base.target, base.block, frozenset(exclude))
    start, fixed = base.fit(search)
    check_motion(base, start, reading.guess)
    found, last, steps = _found(search, base, start, max_effects + _SPARE if max_effects else 0, progressed)
    last_sigma = base.weights[-1]
    state, found = _library(search, base, start, last, found, max_effects, steps) if found else (start, found)
    if search.spent:
        base.notes.append(
            f"the search stopped early: the model hardly converges, and has taken {MOST_PASSES:.0f} passes "
            "for each row; "
            "more effects may be missing"
        )
    progressed("prediction on all samples", max_effects + _SPARE + 1, max_effects + _SPARE + 2)
    result = assemble(
        samples=samples,
        rows=_thinned(train, ALL_AT_ONCE),
        tested=tested,
        labels=labels,
        base=base,
        search=search,
        start=start,
        last=last,
        last_sigma=last_sigma,
        state=state,
        found=found,
        steps=steps,
        fixed=fixed,
        threads=threads,
    )
    if registered_robot is not robot:
        at = between(robot, result.identified)
        sentence = f"{at.sentence().capitalize()}; all errors are given with it registered there."
        result = replace(result, registration=at, summary=f"{result.summary} {sentence}")
    return replace(result, network=residual_network(samples, model.wiring, result)) if network else result


def _report_stage(
    progressed: Callable[[str, int, int], None], stage: int, max_effects: int, name: str
) -> None:
    progressed(name, min(stage + 1, max_effects), max_effects + 2)


def _found(
    search: Search,
    base: BaseFit,
    start: ModelState,
    max_effects: int,
    progressed: Callable[[str, int, int], None],
) -> tuple[list[str], ModelState, list[SearchStep]]:
    """Effects in the order in which they were found, the state with them (and with foils), the steps."""
    state, steps = start, list[SearchStep]()
    found: list[str] = []
    for stage in range(max_effects + _MORE_STAGES):
        search.report = partial(_report_stage, progressed, stage, max_effects)
        step = search.stage(state)
        if step.taken is None and stage == 0:
            pair = _pair(search, state, step)
            step = pair or step
        steps.append(step)
        if step.taken is None or step.taken.state is None:
            break
        if step.taken.alternative is None and len(found) == max_effects:
            break
        state = base.weighed(search, step.taken.state)
        if step.taken.alternative is None:
            found += [
                name for name in state.model.effects if name not in found and name not in start.model.effects
            ]
    return found, state, steps


def _library(
    search: Search,
    base: BaseFit,
    start: ModelState,
    state: ModelState,
    found: list[str],
    max_effects: int,
    steps: list[SearchStep],
) -> tuple[ModelState, list[str]]:
    """The effects that are needed once foils are gone, with their state."""
    alone = search.bare(state) if state.alternatives else state
    noise = start.fit.residual.size * float((base.noise.sigma**2).mean())
    while (
        state.alternatives
        and len(found) < max_effects
        and alone.fit.loss * float((base.target.sigma**2).mean()) > 2.0 * noise
    ):
        step = search.stage(alone, with_alternatives=False)
        if step.taken is None or step.taken.state is None:
            break
        steps.append(step)
        found = [*found, step.taken.name]
        alone = base.weighed(search, step.taken.state)
    if len(found) > 1:
        excess = start.fit.loss * float((base.weights[0] ** 2).mean()) - noise
        alone, found = search.eliminated(alone, found, _MIN_GAIN * max(excess, 0.0), noise)
    while len(found) > max_effects:
        fewer = {name: search.without(alone, name) for name in found}
        least = min(fewer, key=lambda name: fewer[name].fit.loss)
        alone, found = fewer[least], [name for name in found if name != least]
    return base.weighed(search, alone), found


def _pair(search: Search, state: ModelState, step: SearchStep) -> SearchStep | None:
    """Two effects at once, where none passes alone: of the five that come nearest."""
    near = sorted(
        (c for c in step.candidates if c.state is not None and c.alternative is None and c.fraction > 0.01),
        key=lambda c: -c.fraction,
    )[:5]
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


def _thinned(rows: Ints, most: int) -> Ints:
    """At most so many of the rows, evenly."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).round().astype(int)]
