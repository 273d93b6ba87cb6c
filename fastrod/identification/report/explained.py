"""The effects that were found, on every sample of a log: fitted to all of them, predicted tips, errors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fastrod.identification.log.noise import keep
from fastrod.identification.log.samples import LogSamples
from fastrod.identification.log.split import SplitLog, thinned
from fastrod.identification.log.unknowns import known_model
from fastrod.identification.report.result import Error
from fastrod.identification.search.base import BaseFit, search_on
from fastrod.identification.search.model_selection import ModelState
from fastrod.identification.search.search import MOST_OF, Search, SearchOutcome, lost_with_it
from fastrod.types import Flags, Floats

ALL_AT_ONCE = 20000
"""Samples a batch when all are predicted."""
_CONFIRMS = 0.25  # of the gain on fitted data, on those held out: an effect of less is the noise's
_FAR = 0.3  # of the robot's length: an error beyond counts no more, as an outlier's
NEAR = 1.1
"""A held-out error within so many times the noise is explained."""


@dataclass(frozen=True, eq=False)
class Explained:
    """The found effects on every sample: fitted again to all training rows, of which the search saw a
    part."""

    search: Search
    start: ModelState
    """Without effects."""
    state: ModelState
    """With those that were found."""
    names: tuple[str, ...]
    """Names of these effects, largest displacement first."""
    outlier: Flags
    used: Flags
    test: Flags
    """(n,) each."""
    before: Floats
    bare: Floats
    after: Floats
    """(n, 3) predicted tip [m]: of the robot as it was given, of the base model, and with effects."""
    train_error: Error
    test_error: Error

    def refused(self, noise: float) -> str:
        """Why what was found is nothing, or an empty string: with it the rod finds no balance at samples, or
        the base model left no more than the `noise` [m] anywhere and data held out gain little of what the
        fitted ones do."""
        known, found = (np.asarray(np.isfinite(tip).all(1)) for tip in (self.bare, self.after))
        if lost := lost_with_it(known, found):
            return lost
        train, test = self.train_error, self.test_error
        gained, held_out = (1.0 - (error.after / error.before) ** 2 for error in (train, test))
        at_noise = max(train.before, test.before) <= NEAR * noise
        in_vain = bool(self.names) and at_noise and held_out < _CONFIRMS * gained
        return "data held out do not gain what the fitted ones do" if in_vain else ""


def explain(log: SplitLog, base: BaseFit, outcome: SearchOutcome, whole: bool = False) -> Explained:
    """The base model and what was found beside it, predicted on every sample of a log; in motion fitted to
    the `whole` of it, or as the search has left it."""
    search, state, names = outcome.search, outcome.state, outcome.names
    samples, rows = log.samples, thinned(log.rows, ALL_AT_ONCE)
    # each row of a rod of modes, or in motion, costs much more, and the search saw enough of them
    if search.rod.of_modes or search.in_motion:
        rows = log.rows if whole else search.samples.rows
    start = outcome.start
    seen_all = search.in_motion or not (names and _flags_moved(search, state, base))
    if len(rows) > len(search.samples.rows) or not seen_all:
        piece = samples.on(rows)
        search = search_on(piece, base, search.target.sigma, state)
        state = _nearer(state, search.again(state), piece, base)
        # with its own weights: what the base model does not explain must not push its parameters
        again = search_on(piece, base, base.search.target.sigma, state).again(start)
        start = _nearer(start, again, piece, base)
    names = _in_order(names, search, start, state, base.noise.sigma)
    bare = tips_of(start, samples, base)
    given = base.without
    before = tips_of(given.start, given.search.samples, given) if given else bare
    after = tips_of(state, samples, base) if names else bare
    measured, outlier = samples.log.measured, np.zeros(len(samples.log), bool)
    residual = np.asarray(samples.log.tip_position) - after
    seen = np.flatnonzero(measured & np.isfinite(residual).all(1))
    outlier[seen] = ~keep(samples.on(seen), residual[seen], base.noise)
    measured = measured & np.isfinite(before).all(1) & np.isfinite(after).all(1)
    used, test = measured & ~log.tested & ~outlier, measured & log.tested & ~outlier
    tested = measured & log.tested
    length = base.noise.model.length
    errors = (
        error_of(samples, before, after, which, every, length)
        for which, every in ((used, measured & ~log.tested), (test, tested))
    )
    return Explained(search, start, state, names, outlier, used, test, before, bare, after, *errors)


def _flags_moved(search: Search, state: ModelState, base: BaseFit) -> bool:
    """Whether other rows are outliers of what a state leaves than were of the base model's residual."""
    pose = base.search.predict(state.model, state.theta, search.samples)
    good = keep(search.samples, np.nan_to_num(search.target.tip - pose.position), base.noise) & pose.ok
    return bool((good != (search.target.weight > 0.0)).any())


def _nearer(one: ModelState, other: ModelState, piece: LogSamples, base: BaseFit) -> ModelState:
    """The state whose prediction is nearer at the rows: a fit that goes by slopes can leave the valley where
    a load makes the rod snap."""

    def off(state: ModelState) -> float:
        pose, far = base.search.predict(state.model, state.theta, piece), _FAR * base.robot.length
        error = np.linalg.norm(np.asarray(piece.log.tip_position)[piece.rows] - pose.position, axis=1)
        return float(np.mean(np.where(pose.ok, np.minimum(error, far), far) ** 2))

    return other if off(other) <= off(one) else one


def _in_order(
    names: tuple[str, ...], search: Search, start: ModelState, state: ModelState, noise: Floats
) -> tuple[str, ...]:
    """First the effect of `state` that moves the prediction most. Those that correct each other move it far,
    too: they come after all that alone take half of what the best takes from `start`."""
    if len(names) < 2:
        return names
    search, bare = search.weighed(start, noise)
    takes = {name: bare.fit.loss - search.beside(bare, name, state).fit.loss for name in names}
    least = MOST_OF * max(takes.values())
    return tuple(sorted(names, key=lambda name: (takes[name] < least, -_own(state, name))))


def _own(state: ModelState, name: str) -> float:
    """Return how far an effect by itself moves the prediction: squares over the samples, the other
    parameters as they are."""
    theta = state.theta.copy()
    for j, unknown in enumerate(state.model.unknowns):
        if unknown.place[:2] == ("effect", name) and not unknown.shape:
            theta[j] = unknown.mean
    with_it, without = (state.linearised.residual(state.model, at) for at in (state.theta, theta))
    return float(((with_it - without) ** 2).sum())


def shipped(base: BaseFit, used: Flags, test: Flags) -> tuple[float, float]:
    """Error of the robot file as it is, nothing fitted, on fitted and on held-out samples [m]."""
    given = base.without or base
    samples = given.search.samples
    start, nothing = given.start, replace(given.start.fit, theta=np.zeros(0))
    tip = tips_of(replace(start, model=known_model(given.robot), fit=nothing), samples, given)
    fitted, held_out = (error_of(samples, tip, tip, rows).before for rows in (used, test))
    return fitted, held_out


def tips_of(state: ModelState, samples: LogSamples, base: BaseFit) -> Floats:
    """(n, 3) predicted tip of every driven sample [m]; nan where the rod did not converge."""
    tip = np.full((len(samples.log), 3), np.nan)
    # in motion rows need those before them
    pieces = 1 if base.search.in_motion else -(-len(tip) // ALL_AT_ONCE)
    for rows in np.array_split(np.arange(len(tip)), pieces):
        pose = base.search.predict(state.model, state.theta, samples.on(rows))
        tip[rows] = np.where(pose.ok[:, None], pose.position, np.nan)
    return tip


def _distance(samples: LogSamples, predicted: Floats, which: Flags) -> Floats:
    squares = ((np.asarray(samples.log.tip_position) - predicted)[which] ** 2).sum(1)
    return np.asarray(squares[np.isfinite(squares)])


def error_of(
    samples: LogSamples,
    before: Floats,
    after: Floats,
    which: Flags,
    every: Flags | None = None,
    length: float = 1.0,
) -> Error:
    """Distance rms [m] at the samples of a mask, of tips (n, 3) predicted before and after; the mask `every`
    has those that were left out as outliers, too. One of `length` samples is independent."""
    if not which.any():
        return Error(before=float("nan"), after=float("nan"), interval=(float("nan"), float("nan")))
    values = [float(np.sqrt(_distance(samples, p, which).mean())) for p in (before, after)]
    interval = interval_of(samples, after, which, length)
    whole = values[1] if every is None else float(np.sqrt(_distance(samples, after, every).mean()))
    return Error(before=values[0], after=values[1], interval=interval, all_rows=whole)


def interval_of(
    samples: LogSamples, predicted: Floats, which: Flags, length: float = 1.0
) -> tuple[float, float]:
    """95 % interval of a distance rms, by resampling blocks of samples that are longer than the `length` of
    which one is independent."""
    squares = _distance(samples, predicted, which)
    if len(squares) < 20:
        return float("nan"), float("nan")
    blocks = max(4, min(20, len(squares) // 5, int(len(squares) / (2.0 * length))))
    means_of_blocks = [b.mean() for b in np.array_split(squares, blocks)]
    rng = np.random.default_rng(0)
    means = rng.choice(means_of_blocks, (2000, len(means_of_blocks))).mean(1)
    low, high = np.sqrt(np.quantile(means, [0.025, 0.975]))
    return float(low), float(high)
