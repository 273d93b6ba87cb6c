"""The search for what the model lacks: fit every candidate beside what is known, judge it on blocks it has
not seen, keep the best, ask again.

Every candidate starts from the same reference, weights and outlier mask. Alternative patterns
(`alternatives`) compete on the same terms.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from types import MappingProxyType
from typing import ClassVar, TypeVar

import numpy as np

from fastrod.effects.base import BodyOperator, effect_names, get_effect, has_memory, trait
from fastrod.errors import RobotError
from fastrod.identification.log.forward import PredictedPose, PredictedRod, predict
from fastrod.identification.log.samples import LogSamples
from fastrod.identification.log.unknowns import Model, Unknown
from fastrod.identification.search.alternatives import AlternativePattern, alternatives
from fastrod.identification.search.correlation import blocks_alike, length, residual_correlation, spread
from fastrod.identification.search.linearised import LinearisedModel, Target
from fastrod.identification.search.model_selection import (
    AT_NOISE,
    BIC_ACCEPT,
    BIC_KEEP,
    BIC_RIVAL,
    BIC_STRONG,
    FRACTION_ACCEPT,
    FRACTION_BLOCKS,
    FRACTION_KEEP,
    Z_ACCEPT,
    Z_BLOCKS,
    Z_KEEP,
    Z_RIVAL,
    Z_STRONG,
    Candidate,
    DetectionLimit,
    ModelState,
    SearchStep,
    advantage,
    best_of,
    by_estimate,
    equally_wrong,
    oversized,
    unfitted,
    unphysical,
    z_between,
)
from fastrod.identification.search.solve import (
    BEYOND,
    Fit,
    bic,
    effective_size,
    held_out_losses,
    least_squares,
    left_out,
    minimise,
    paired,
    rms,
)
from fastrod.model.robot import Robot
from fastrod.types import Flags, Floats, Ints

N_BLOCKS = 20
MOST_PASSES = 4000.0
"""Iterations of each row, on the average, after which nothing new is tried. A log with two effects took
390."""
_T = TypeVar("_T")
_STARTS = 8
_SCREEN = 0.003  # of the loss: a candidate whose slopes promise less is not fitted
_STIFF = 0.01  # of a segment's own stiffness, over that of a tendon
_LOST = 5.0  # times the own loss of a block that others predict
_FEW_LOST = 0.01  # of the samples
MOST_OF = 0.5  # of what the best takes away: an effect that takes less is no rival by its blocks alone
_AS_WELL = 1.05  # of a held-out loss
_FEW, _MANY = 3, 12  # iterations of a start, and of the best of them
_BACK = 4  # times that a step is halved which has led to where the solved rod fits worse
_REFINED = 6  # candidates that are solved exactly at each stage
_NEAR = 3.0  # times what the best leaves, or less than it takes: others are not worth an exact solution
_SLOPES = 0.25**2  # of the loss: slopes may be off by a quarter of what an effect moves
_ALONE = 3.0  # of what noise leaves: one effect that is said to leave less may explain a log
_ROUNDS = 5  # solutions of a candidate after the first
_CONVERGED = 0.9  # of the loss where it was solved: less than slopes promise there
_CLOSE = 200.0  # BIC to the best within which a candidate is solved once more
# of an alternative pattern's amplitude, in units of its own columns' size that would explain all
_ALTERNATIVE_SD = 30.0


def blocks_of(n_rows: int) -> Ints:
    """(n_rows,) number of each row's block, 0 to N_BLOCKS - 1."""
    return np.asarray(np.minimum(np.arange(n_rows) * N_BLOCKS // n_rows, N_BLOCKS - 1))


@dataclass(frozen=True, eq=False)
class Search:
    """Samples, weights and blocks that all candidates share."""

    samples: LogSamples
    rod: PredictedRod
    """Stays warm from solve to solve, and counts them; all else is fixed."""
    target: Target
    block: Ints
    """(n,) number of each row's block, 0 to N_BLOCKS - 1; one block at a time is held out."""
    excluded: frozenset[str] = frozenset()
    noise: Floats = field(default_factory=lambda: np.full(3, np.nan))
    """(3,) of the tip [m]."""
    row_correlation: Floats = field(default_factory=lambda: np.ones(1))
    """(k,) autocorrelation of the noise from row to row, until it has faded; (1,) of white noise."""
    report: Callable[[str], None] = field(default=lambda _: None)
    in_motion: ClassVar[bool] = False
    drawn: ClassVar[float] = BEYOND
    """sd from its prior, from which on a number of the robot may stand in for an effect."""

    def predict(self, model: Model, theta: Floats, samples: LogSamples) -> PredictedPose:
        """Return what the camera sees at the rows of `samples`, solved exactly."""
        return predict(model, theta, samples, PredictedRod(samples, model.robot, threads=self.rod.threads))

    def at(self, samples: LogSamples, robot: Robot) -> Search:
        """The same at other samples of the robot, weighed as here; its target stays that of these."""
        rod = PredictedRod(samples, robot, points=self.rod.points, threads=self.rod.threads)
        return replace(self, samples=samples, rod=rod, block=blocks_of(len(samples.rows)))

    def start(self, model: Model, theta: Floats, iterations: int = 6) -> ModelState:
        """The state of a model without anything found, linearised twice: at `theta` (p,), and where the fit
        from there ends."""
        first = self._fitted(model, theta, np.zeros(0), (), iterations)
        return self.refined(first, borrow=self.rod.of_modes)

    def refined(self, state: ModelState, iterations: int = 4, *, borrow: bool = False) -> ModelState:
        """The same with the rod solved at the state's own parameters; with `borrow` its slopes are those of
        the last solution. A rod of modes is solved once more where the fit ends: no slope says where tendons
        go slack on the way."""
        linearised, theta = self._solved(state)
        if borrow:
            linearised = linearised.borrowing(state.linearised)
        fit = self._fit(
            linearised, state.model, theta, state.fit.theta[len(theta) :], state.alternatives, iterations
        )
        if not np.isfinite(fit.loss):
            return state
        made = self._state(state.model, linearised, fit, state.alternatives)
        return self.refined(made, 0, borrow=True) if self.rod.of_modes and iterations else self._checked(made)

    def _checked(self, state: ModelState) -> ModelState:
        """The state with the rod solved for blocks whose parameters the others hardly determine: so far away
        no slope holds."""
        fit, losses, n = state.fit, state.losses.copy(), len(state.theta)
        own = np.bincount(self.block, weights=(fit.residual**2).sum(1), minlength=N_BLOCKS)
        far = np.flatnonzero(losses > _LOST * own)
        if not len(far) or not self.rod.of_modes:
            return state
        steps, kept = left_out(fit.residual, fit.slopes, fit.precision, self.block, N_BLOCKS), self.rod.keep()
        for k in far[own[far] > 0.0]:
            without = fit.theta - steps[k]
            rows = self.block == k
            try:
                theta = np.clip(without[:n], *state.model.limits)
                pose = predict(
                    state.model, theta, self.samples, self.rod, state.linearised.prepared, rough=True
                )
            except RobotError:
                continue
            left = self.target.residual(pose) - state.columns @ without[n:]
            losses[k] = float((left[rows] ** 2).sum())
            self.rod.back(kept)  # the next solve begins near, not from so far away
        return replace(state, losses=losses)

    def _solved(self, state: ModelState) -> tuple[LinearisedModel, Floats]:
        """The model solved at a state's parameters, and these. Of a rod of modes, whose tendons go slack
        where no slope says so, at parameters that are nearer to those of the last solution, where it fitted
        better."""
        model, theta, last = state.model, state.theta, state.linearised

        def cost(of: LinearisedModel, at: Floats) -> float:
            mean, sd = model.prior
            return float((of.residual(model, at) ** 2).sum() + (((at - mean) / sd) ** 2).sum())

        linearised = LinearisedModel(model, theta, self.samples, self.rod, self.target, last)
        if self.rod.of_modes:
            known = {u.name: number for u, number in zip(last.model.unknowns, last.theta, strict=True)}
            there = np.array([known.get(u.name, u.outside(u.mean)) for u in model.unknowns])
            before = cost(last.under(self.target), there)
            for _ in range(_BACK):
                if cost(linearised, theta) <= before:
                    break
                theta = 0.5 * (theta + there)
                linearised = LinearisedModel(model, theta, self.samples, self.rod, self.target, last)
        return linearised, theta

    def weighed(self, state: ModelState, noise: Floats) -> tuple[Search, ModelState]:
        """The state fitted again with weights of the size of its own residual, never below the `noise` (3,)
        [m], and the search with these: what a model does not explain yet must not push its parameters beyond
        their priors."""
        sigma = state.linearised.target.sigma
        size = max(rms(state.fit.residual), float((noise / sigma).max()))
        search = replace(self, target=self.target.weighed(sigma * size, noise))
        return search, search.refined(search.refined(state), borrow=self.rod.of_modes)

    def again(self, state: ModelState) -> ModelState:
        """A state of other samples, fitted to these; alternative patterns, which belong to their samples, are
        left behind."""
        return self.refined(self._fitted(state.model, state.theta, np.zeros(0), (), 6))

    def _fitted(
        self,
        model: Model,
        theta: Floats,
        amplitudes: Floats,
        found: tuple[AlternativePattern, ...],
        iterations: int,
    ) -> ModelState:
        """The state at the best parameters near `theta` (p,), where the rod is solved."""
        linearised = self._near(model, theta)
        fit = self._fit(linearised, model, theta, amplitudes, found, iterations)
        return self._state(model, linearised, fit, found)

    def _near(self, model: Model, theta: Floats) -> LinearisedModel:
        return LinearisedModel(model, theta, self.samples, self.rod, self.target)

    def _state(
        self, model: Model, linearised: LinearisedModel, fit: Fit, found: tuple[AlternativePattern, ...]
    ) -> ModelState:
        losses = held_out_losses(fit.residual, fit.slopes, fit.precision, self.block, N_BLOCKS)
        return ModelState(model, linearised, fit, losses, found)

    def _fit(
        self,
        linearised: LinearisedModel,
        model: Model,
        theta: Floats,
        amplitudes: Floats,
        found: Sequence[AlternativePattern],
        iterations: int,
        known: Floats | None = None,
    ) -> Fit:
        """The best parameters near `linearised`, with the amplitudes of alternative patterns as further
        linear unknowns; slopes by the first unknowns may be `known`."""
        n = len(model.unknowns)
        mean, sd = model.prior
        low, high = model.limits
        if not found:
            return linearised.fit(model, theta, iterations, known)
        columns = np.concatenate([f.columns for f in found], axis=-1)
        size = np.sqrt((columns**2).sum((0, 1)))
        wide = _ALTERNATIVE_SD * np.sqrt(linearised.residual(model, theta).size) / np.maximum(size, 1e-12)
        k = columns.shape[-1]
        free = np.full(k, np.inf)

        def residual(both: Floats) -> Floats:
            return linearised.residual(model, both[:n]) - columns @ both[n:]

        def slopes(both: Floats, at: Floats) -> Floats:
            own = linearised.slopes(model, both[:n], at + columns @ both[n:], known)
            return np.concatenate([own, columns], axis=-1)

        return minimise(
            residual,
            slopes,
            np.concatenate([theta, amplitudes]),
            np.concatenate([mean, np.zeros(k)]),
            np.concatenate([sd, wide]),
            (np.concatenate([low, -free]), np.concatenate([high, free])),
            iterations,
        )

    @property
    def spent(self) -> bool:
        """Whether the rod was solved so often that nothing new is to be tried."""
        return self.rod.work.of_row > MOST_PASSES

    # ------------------------------------------------------------ candidates

    def candidate(self, state: ModelState, name: str) -> Candidate:
        """An effect fitted beside a state, from each of its starts; not fitted once the search has `spent`
        its passes. Where this log shows that it is one drive's, of that drive alone; where it shows another
        law of the same cause, that law."""
        if self.spent:
            return unfitted(name, "not tried: the model hardly converges on this log")
        if trait(get_effect(name), "by_pattern"):
            found = [
                c for c in self.pattern_effects(state, self.alternative_candidates(state)) if c.name == name
            ]
            return found[0] if found else unfitted(name, "no pattern of it fits")
        best = self._candidate(state, name)
        laws = [name, *(other for other in effect_names() if trait(get_effect(other), "refines") == name)]
        variants: list[tuple[str, int | None]] = [(law, None) for law in laws[1:] if law not in self.excluded]
        for law in laws:
            drive = self._drive(state, law)
            variants += [] if drive is None else [(law, drive)]
        for law, drive in variants:
            other = self._candidate(state, law, drive)
            best = other if other.passes and distinct(other, best) else best
        return best

    def _drive(self, state: ModelState, name: str) -> int | None:
        """The drive by which alone an effect promises most; None where drives do not differ by it."""
        count = state.model.wiring.n_drives
        if count < 2 or self.in_motion or not any(p.shared for p in get_effect(name).parameters):
            return None
        promises = []
        for drive in range(count):
            model = state.model.with_effect(name, drive=drive)
            every = starts_of(state, model, name)
            promises.append(max(self._promise(state, model, theta) for theta in every))
        best = int(np.argmax(promises))
        return best if promises[best] >= _SCREEN * state.fit.loss else None

    def _candidate(self, state: ModelState, name: str, drive: int | None = None) -> Candidate:
        whole = state.model.with_effect(name, drive=drive)
        drop = self._unseen(state, whole)
        added = whole.unknowns[len(state.model.unknowns) :]
        if all(u.name.partition(".")[2] in drop for u in added if not u.shape):
            shown_by = trait(get_effect(name), "excited_by") or "no response"
            return unfitted(name, f"this log does not excite it: {shown_by}")
        model = state.model.with_effect(name, drop=drop, drive=drive)
        fits = self._from_starts(state, model, name)
        if fits is None:
            n_more = len(model.unknowns) - len(state.model.unknowns)
            return unfitted(name, "its slopes promise nothing", n_more)
        return self.judged(state, self._state(model, state.linearised, fits, state.alternatives), name)

    def _unseen(self, state: ModelState, model: Model) -> list[str]:
        """Size parameters of the effect that a model has more that move nothing in this log beyond its noise:
        left at neutral. Beside what is left before it is found they may be small, and yet be its
        direction."""
        sizes, (neutral, *larger) = grown(state, model)
        base = state.linearised.residual(model, neutral)
        of_noise = max(1.0, float(np.mean((self.target.sigma / self.noise) ** 2)))
        moved = [float(((state.linearised.residual(model, at) - base) ** 2).sum()) for at in larger]
        unseen = [j for j, by in zip(sizes, moved, strict=True) if of_noise * by < 4.0]
        return [model.unknowns[j].name.partition(".")[2] for j in unseen]

    def _from_starts(self, state: ModelState, model: Model, name: str) -> Fit | None:
        linearised, n = state.linearised, len(state.model.unknowns)
        amplitudes = state.fit.theta[n:]
        promising = [(self._promise(state, model, theta), theta) for theta in starts_of(state, model, name)]
        promising.sort(key=lambda pair: -pair[0])
        if promising[0][0] < _SCREEN * state.fit.loss:
            return None
        # an effect hardly changes how the model answers to what it had before
        known, patterns = state.fit.slopes[..., :n], state.alternatives
        near = partial(self._fit, linearised, model)
        fits = self._each(
            state, [partial(near, at, amplitudes, patterns, _FEW, known) for _, at in promising[:3]]
        )
        best, amplitudes = np.split(min(fits, key=lambda fit: fit.loss).theta, [len(model.unknowns)])
        return near(best, amplitudes, patterns, _MANY, known)

    def _ahead(self, state: ModelState, _: Sequence[tuple[Model, Floats]]) -> LinearisedModel:
        """Return what answers for all these models near a state."""
        return state.linearised

    def _each(self, state: ModelState, jobs: Sequence[Callable[[], _T]]) -> list[_T]:  # noqa: ARG002
        """Return what each of the jobs beside a state does, which do not depend on each other."""
        return [job() for job in jobs]

    def _promise(self, state: ModelState, model: Model, theta: Floats, settled: bool = True) -> float:
        """Loss that the response to the new parameters could take away at best, beside what the others can
        absorb, which are at their minimum if `settled`."""
        n = len(state.model.unknowns)
        patterns = state.columns @ state.fit.theta[n:] if state.alternatives else 0.0
        at = state.linearised.residual(model, theta) - patterns
        # the response at the start itself: operators have no slope at neutral
        shift = (state.fit.residual - at).reshape(-1, 1)
        base = state.fit.slopes.reshape(shift.shape[0], state.fit.slopes.shape[-1])
        J = np.concatenate([base, shift], axis=1)
        sizes = [j for j, u in enumerate(model.unknowns) if j >= n and not u.shape]
        if len(sizes) > 1:
            neutral = theta.copy()
            columns = []
            for j in sizes:
                moved = neutral.copy()
                moved[j] = model.unknowns[j].mean
                columns.append((state.linearised.residual(model, moved) - patterns - at).ravel())
            J = np.concatenate([J, np.stack(columns, axis=1)], axis=1)
        r = state.fit.residual.ravel()
        gram = J.T @ J + np.diag(
            np.concatenate([state.fit.precision, np.full(J.shape[1] - base.shape[1], 1e-9)])
        )
        b = J.T @ r
        if settled:  # no slope is left, priors and all
            b[: base.shape[1]] = 0.0
        return float(b @ least_squares(gram, b))

    def judged(
        self, state: ModelState, with_it: ModelState, name: str, alternative: AlternativePattern | None = None
    ) -> Candidate:
        """A candidate's evidence against the state without it."""
        k = len(with_it.fit.theta) - len(state.fit.theta) + (alternative.n_hidden if alternative else 0)
        size = self._worth(with_it)
        gain = bic(state.fit.loss, 0, size) - bic(with_it.fit.loss, k, size)
        gain -= 2.0 * float(np.log(alternative.n_tried)) if alternative else 0.0
        z = paired(state.losses, with_it.losses) / blocks_alike(
            self.row_correlation, len(self.block) // N_BLOCKS
        )
        fraction = 1.0 - with_it.fit.loss / state.fit.loss
        why = "" if alternative else unphysical(with_it, name)
        evident = (
            (z > Z_ACCEPT and gain > BIC_ACCEPT)
            or (z > Z_STRONG and gain > BIC_STRONG)
            or (z > Z_BLOCKS and fraction > FRACTION_BLOCKS)
        )
        evident = evident and self._beyond_noise(state, with_it) > k * np.log(size) + BIC_ACCEPT
        if not why and not (fraction > FRACTION_ACCEPT and evident):
            why = (
                f"no gain on held-out blocks (z {z:.1f}, BIC {gain:.0f}, {100 * fraction:.1f} % of the loss)"
            )
        return Candidate(name, with_it, z, gain, fraction, k, why, alternative)

    def _exact(self, state: ModelState, candidate: Candidate, *, thorough: bool = False) -> Candidate:
        """A fitted candidate with the rod solved at its parameters; solved again where `thorough`, or where
        the first solution promises half of what the slopes did. In one size for all drives where that does as
        well."""
        assert candidate.state is not None
        name, slow = candidate.name, self.in_motion or self.rod.of_modes
        with_it = self.refined(candidate.state, borrow=self.rod.of_modes)
        if not slow and (thorough or with_it.fit.loss < 0.5 * candidate.state.fit.loss):
            with_it = self._converged(with_it, thorough=thorough)
        found = self._balanced(state, with_it, name)
        if slow or not found.passes or not _differs(name) or with_it.model.alike(name):
            return found
        model = state.model.with_effect(name, alike=True)
        values, added = with_it.model.values(with_it.theta)[name], model.unknowns[len(state.theta) :]
        begin = [u.outside(float(np.mean(values[[int(c) for c in u.place[2:]]]))) for u in added]
        theta, amplitudes = np.split(with_it.fit.theta, [len(with_it.theta)])
        theta = np.concatenate([theta[: len(state.theta)], begin])
        alike = self._fitted(model, theta, amplitudes, state.alternatives, _FEW)
        one = self._balanced(state, alike, name)
        return one if one.passes and _as_good(one, found) else found

    def _balanced(self, state: ModelState, with_it: ModelState, name: str) -> Candidate:
        """The candidate of a state at which the rod was solved. Samples at which it then finds no balance do
        not count, and the worse an effect is the fewer would: with many it is none."""
        poses = state.linearised.pose, with_it.linearised.pose
        if not self.in_motion and (why := lost_with_it(*(pose.ok for pose in poses))):
            return unfitted(name, why, len(with_it.fit.theta) - len(state.fit.theta))
        return self.judged(state, with_it, name)

    def _converged(self, state: ModelState, *, thorough: bool) -> ModelState:
        """The state with the rod solved again as long as slopes promise more and, unless `thorough`, what is
        left halves; as it was where that does not end near the noise."""
        here = state
        for _ in range(_ROUNDS):
            left = self._left(here)
            if here.fit.loss > _CONVERGED * left:
                break
            there = self.refined(here)
            if not thorough and self._left(there) > 0.5 * left:
                break
            here = there
        return here if here.fit.loss < _ALONE * self._noise_loss(here) else state

    def _left(self, state: ModelState) -> float:
        """Loss where the rod was solved, before the state's last fit."""
        linearised, n = state.linearised, len(state.theta)
        there = linearised.residual(linearised.model, linearised.theta) - state.columns @ state.fit.theta[n:]
        return float((there**2).sum())

    def _worth(self, state: ModelState) -> float:
        """Samples that a state's residual is worth, of which coloured noise leaves fewer."""
        residual = state.fit.residual
        return min(effective_size(residual), max(residual.size / length(self.row_correlation), 4.0))

    def _beyond_noise(self, state: ModelState, with_it: ModelState) -> float:
        """-2 log likelihood that is gained against coloured noise, along the change that the candidate makes:
        slow noise is large along slow changes. Infinite where the noise is white: there the residual says as
        much."""
        if len(self.row_correlation) < 2:
            return np.inf
        change = state.fit.residual - with_it.fit.residual
        size = float(np.mean((with_it.linearised.target.sigma / self.noise) ** 2))
        left = with_it.fit.loss / max(with_it.fit.residual.size, 1)
        gain = (state.fit.loss - with_it.fit.loss) * min(size, 1.0 / max(left, 1e-12))
        return gain / spread(change[..., None], self.row_correlation)

    def alternative_candidates(self, state: ModelState) -> list[Candidate]:
        """The best alternative pattern of each family beside a state, linear in everything."""
        made: list[Candidate] = []
        if self.in_motion:  # they take slopes by the rod's inputs
            return made
        for alternative in alternatives(state.linearised, state.fit.slopes, state.fit.residual):
            # a row without a shape tells nothing
            columns = np.where(np.isfinite(alternative.columns), alternative.columns, 0.0)
            slopes = np.concatenate([state.fit.slopes, columns], axis=-1)
            flat = slopes.reshape(-1, slopes.shape[-1])
            precision = np.concatenate([state.fit.precision, np.full(alternative.columns.shape[-1], 1e-9)])
            H = flat.T @ flat + np.diag(precision)
            b = flat.T @ state.fit.residual.ravel()
            b[: len(state.fit.theta)] = 0.0
            step = least_squares(H, b)
            residual = state.fit.residual - slopes @ step
            low, high = state.model.limits
            own = np.clip(
                state.theta + step[: len(low)], low, high
            )  # a line leads beyond what a robot can be
            theta = np.concatenate([own, state.fit.theta[len(low) :], np.zeros(columns.shape[-1])])
            theta[len(low) :] += step[len(low) :]
            fit = Fit(
                theta,
                residual,
                slopes,
                precision,
                (*state.fit.at_bound, *(False,) * alternative.columns.shape[-1]),
            )
            with_it = ModelState(
                state.model,
                state.linearised,
                fit,
                held_out_losses(residual, slopes, precision, self.block, N_BLOCKS),
                (*state.alternatives, alternative),
            )
            made.append(self.judged(state, with_it, alternative.name, alternative))
        return made

    def pattern_effects(self, state: ModelState, patterns: Sequence[Candidate]) -> list[Candidate]:
        """The effects that stand for some of these patterns, each fitted from where its scan has found it."""
        made = []
        for candidate in patterns:
            pattern = candidate.alternative
            if pattern is None or pattern.start is None:
                continue
            name = pattern.name
            if name in state.model.effects or name in self.excluded:
                continue
            model = state.model.with_effect(name, pattern.start, drive=pattern.drive)
            n = len(state.model.unknowns)
            theta = np.concatenate([state.theta, model.start[n:]])
            fit = self._fit(state.linearised, model, theta, state.fit.theta[n:], state.alternatives, _MANY)
            with_it = self._state(model, state.linearised, fit, state.alternatives)
            made.append(self.judged(state, with_it, name))
        return made

    # ------------------------------------------------------------ stages

    def names(self, state: ModelState) -> list[str]:
        """Effects that may be tried."""
        n_segments, driven = state.model.wiring.n_segments, state.model.wiring.n_tendons > 0
        refined = {trait(get_effect(name), "refines") for name in state.model.effects}
        held = not _yields(state.model.robot)
        return [
            name
            for name in effect_names()
            if name not in state.model.effects
            and name not in refined
            and not trait(get_effect(name), "refines")
            and not trait(get_effect(name), "by_pattern")
            and name not in self.excluded
            and trait(get_effect(name), "least_segments") <= n_segments
            and not (held and isinstance(get_effect(name), BodyOperator))
            and (driven or get_effect(name).seam.name != "ACTUATION")
        ]

    def stage(self, state: ModelState, *, with_alternatives: bool = True) -> SearchStep:
        """Try everything beside `state`; take the best, if any passes. Effects of last resort are tried where
        no other passes: they could stand in for several."""
        names = self.names(state)
        last = [name for name in names if trait(get_effect(name), "last_resort")]
        tried = self._tried(state, [name for name in names if name not in last])
        step = self.choose(state, tried, with_alternatives=with_alternatives)
        if not last or (step.taken is not None and step.taken.alternative is None):
            return step
        more = self.choose(state, self._tried(state, last), with_alternatives=False)
        every = (*step.candidates, *more.candidates)
        if more.taken is None or (step.taken is not None and _clearly_better(step.taken, more.taken)):
            return replace(step, candidates=every)
        return replace(more, candidates=every)

    def _tried(self, state: ModelState, names: Sequence[str]) -> list[Candidate]:
        tried, nominal = [], self._nominal(state)
        for name in names:
            self.report(name)
            one = self.candidate(state, name)
            if nominal is not None and not self.spent:
                other = self._anew(state, nominal, name)
                one = other if other.passes and distinct(other, one) else one
            tried.append(one)
        return tried

    def _nominal(self, state: ModelState) -> LinearisedModel | None:
        """The model at the robot that its file says, where a fit has drawn a number far from there: that may
        stand in for the effect that is missing, and no slope leads back. Rods of modes have no time for
        it."""
        mean, sd = state.model.prior
        own = np.array([u.place[0] != "effect" for u in state.model.unknowns], bool)
        if self.rod.of_modes or not (np.abs(state.theta - mean) > self.drawn * sd)[own].any():
            return None
        return self._near(state.model, np.where(own, mean, state.theta))

    def _anew(self, state: ModelState, nominal: LinearisedModel, name: str) -> Candidate:
        """An effect fitted beside a state from another place, the model `nominal`."""
        model = state.model.with_effect(name)
        amplitudes, found, n = state.fit.theta[len(state.theta) :], state.alternatives, len(state.theta)
        starts = [np.concatenate([nominal.theta, at[n:]]) for at in starts_of(state, model, name)[:3]]
        fits = [self._fit(nominal, model, at, amplitudes, found, _FEW) for at in starts]
        best, amplitudes = np.split(min(fits, key=lambda fit: fit.loss).theta, [len(model.unknowns)])
        fit = self._fit(nominal, model, best, amplitudes, found, _MANY)
        return self.judged(state, self._state(model, nominal, fit, found), name)

    def choose(self, state: ModelState, tried: list[Candidate], *, with_alternatives: bool) -> SearchStep:
        """Solve the promising ones exactly, then take the best by evidence; alternative patterns only where
        they beat it clearly."""
        others = self.alternative_candidates(state) if with_alternatives else []
        effects = self.pattern_effects(state, others)
        tried = [*tried, *effects]
        others = [c for c in others if not any(c.name == one.name and one.passes for one in effects)]
        fitted = sorted(
            (c for c in tried if c.state is not None and c.z > 1.0 and c.fraction > FRACTION_ACCEPT),
            key=lambda c: -c.fraction,
        )
        most = fitted[0].fraction if fitted else 0.0
        # where one may explain the log alone, slopes do not say which
        alone = (1.0 - most) * state.fit.loss < _ALONE * self._noise_loss(state)
        thorough = alone and not (self.in_motion or self.rod.of_modes)
        least = 1.0 - _NEAR * (1.0 - most) - (_SLOPES if thorough else 0.0)
        near = [c for c in fitted if c.fraction > least and c.fraction > most / _NEAR][:_REFINED]
        # of these even the fit so far is linear
        heavy = [c for c in fitted if not state.linearised.is_light(c.name) and c.fraction > 0.6 * most]
        some = list(dict.fromkeys([*near, *heavy]))
        solved = self._each(state, [partial(self._exact, state, c, thorough=thorough) for c in some])
        exact = {c.name: found for c, found in zip(some, solved, strict=True)}
        best = best_of([c for c in exact.values() if c.state is not None and c.fraction > FRACTION_ACCEPT])
        for name, candidate in exact.items():
            if best is not None and candidate.state is not None and advantage(best, candidate) < _CLOSE:
                exact[name] = self._exact(state, candidate, thorough=thorough)
        tried = [exact.get(c.name, c) for c in tried]
        passing = [c for c in tried if c.passes]
        passing = [c for c in passing if not self._stands_in(c)] or passing
        best = best_of(passing)
        tried += others
        alternative = best_of([c for c in others if c.passes])
        if alternative is not None and (best is None or _clearly_better(alternative, best)):
            return SearchStep(state, tuple(tried), alternative)
        if best is None:
            return SearchStep(state, tuple(tried), None)
        sure = [
            c
            for c in passing
            if c is not best and c.fraction > best.fraction and z_between(c, best) > Z_ACCEPT
        ]
        # blocks that no fit has seen overrule the count of parameters
        best = max(sure, key=lambda c: c.fraction) if sure else best
        best, *rivals = self._with_rivals(state, best, tried)
        return SearchStep(state, tuple(tried), best, tuple(c.name for c in rivals))

    def _with_rivals(self, state: ModelState, best: Candidate, tried: Sequence[Candidate]) -> list[Candidate]:
        """The best, then its rivals. One with fewer numbers that does as well comes first; of laws that
        contain one another the estimates decide."""
        rivals = [
            c for c in tried if c.alternative is None and c.name != best.name and self._rival(state, best, c)
        ]
        fewer = best_of([c for c in rivals if c.passes and _as_good(c, best)])
        if fewer is not None:
            rivals = [best, *(c for c in rivals if c is not fewer)]
            best = fewer
        return by_estimate(best, rivals, tried, self._noise_loss(state))

    def _rival(self, state: ModelState, best: Candidate, other: Candidate) -> bool:
        if other.state is None or other.fraction < FRACTION_ACCEPT or unphysical(other.state, other.name):
            return False
        if advantage(best, other) < BIC_RIVAL:
            return True
        if z_between(best, other) < Z_RIVAL and other.fraction > MOST_OF * best.fraction:
            return True
        assert best.state is not None
        before, least, more = (float(s.losses.sum()) for s in (state, best.state, other.state))
        fewer = best.n_parameters - other.n_parameters
        return equally_wrong(before, least, more, self._noise_loss(state), fewer)

    def _stands_in(self, candidate: Candidate) -> bool:
        """Whether it is a force that goes by where the tip is, and leaves more than noise, or a memory larger
        than any: with their numbers they bend to many a compound of other effects, which is then not
        found."""
        assert candidate.state is not None
        if oversized(candidate.state, candidate.name):
            return True
        left, noise = float(candidate.state.losses.sum()), self._noise_loss(candidate.state)
        return bool(trait(get_effect(candidate.name), "feels_tip")) and left > AT_NOISE * noise

    def _noise_loss(self, state: ModelState) -> float:
        """Return what noise alone leaves of a state's loss."""
        sigma = state.linearised.target.sigma
        return state.fit.residual.size * float(np.mean((self.noise / sigma) ** 2))

    def beside(self, state: ModelState, name: str, found: ModelState) -> ModelState:
        """`state` with an effect of the state `found`, fitted from the numbers that it has there, beside the
        robot's of either."""
        drive, alike = found.model.drive_of(name), found.model.alike(name)
        model = state.model.with_effect(name, drive=drive, alike=alike)
        there, n = found.from_here(model), len(state.theta)
        starts = np.concatenate([state.theta, there[n:]]), there
        fits = [self._fit(state.linearised, model, at, np.zeros(0), (), _MANY) for at in starts]
        return self._state(model, state.linearised, min(fits, key=lambda fit: fit.loss), ())

    def bare(self, state: ModelState) -> ModelState:
        """`state` without its alternative patterns, fitted again: what the library alone explains."""
        return self._fitted(state.model, state.theta, np.zeros(0), (), 8)

    def without(self, state: ModelState, name: str) -> ModelState:
        """`state` without one of its effects, fitted again."""
        model = state.model.without(name)
        kept = [j for j, u in enumerate(state.model.unknowns) if u.place[:2] != ("effect", name)]
        amplitudes = state.fit.theta[len(state.model.unknowns) :]
        return self._fitted(model, state.theta[kept], amplitudes, state.alternatives, 8)

    def eliminated(
        self, state: ModelState, found: Sequence[str], least: float, noise: float
    ) -> tuple[ModelState, list[str], list[str]]:
        """Drop effects that what came later has made needless, and those that bring less than `least` where
        what is left is of the size of the `noise` [both m^2 summed over the residual] and they do not explain
        it: beside a dominant effect they may only correct its form. The state, who is left, and a sentence on
        each that was needed and dropped."""
        left, said = list(found), list[str]()
        while len(left) > 1:
            weakest: tuple[float, str, ModelState, str] | None = None
            for name in left:
                fewer = self.without(state, name)
                verdict = self.judged(fewer, state, name)
                needed = verdict.z > Z_KEEP and (
                    verdict.bic_gain > BIC_KEEP or verdict.fraction > FRACTION_KEEP
                )
                needless = not needed and not (verdict.z > Z_STRONG and verdict.bic_gain > BIC_STRONG)
                variance = float((self.target.sigma**2).mean())
                before, after = (one.fit.loss * variance for one in (fewer, state))
                explains = after < AT_NOISE * noise <= before  # the log is explained with it, and not without
                small = before - after < least and before < 2.0 * noise and not explains
                if (needless or small) and (weakest is None or verdict.bic_gain < weakest[0]):
                    ratios = (float(np.sqrt(size / noise)) for size in (after, before))
                    why = "" if needless else _suspicion(name, verdict.z, *ratios)
                    weakest = verdict.bic_gain, name, fewer, why
            if weakest is None:
                break
            _, dropped, state, why = weakest
            left, said = [name for name in left if name != dropped], [*said, *([why] if why else [])]
        return state, left, said

    def again_beside_all(
        self, state: ModelState, found: Sequence[str], steps: Sequence[SearchStep]
    ) -> tuple[ModelState, list[str], list[SearchStep]]:
        """Judge what was found early, and its rivals, beside all that came later: an effect with fewer
        numbers that does as well takes the place. The state, who is in it, and a step for each that was
        judged. A rod of modes or in motion has no time for it."""
        left, made = list(found), list[SearchStep]()
        rivals = {step.taken.name: step.rivals for step in steps if step.taken is not None}
        early = [] if self.in_motion or self.rod.of_modes else left[:-1]  # the last was judged beside all
        for name in early:
            fewer = self.without(state, name)
            kept = self.judged(fewer, state, name)
            others = [
                other
                for other in self.names(fewer)
                if other != name
                and (other in rivals.get(name, ()) or _numbers(fewer.model, other) < kept.n_parameters)
            ]
            tried = self.choose(fewer, self._tried(fewer, others), with_alternatives=False).candidates
            best, *alike = self._with_rivals(fewer, kept, tried)
            if best is not kept and best.state is not None:
                state, left = best.state, [best.name if one == name else one for one in left]
            made.append(SearchStep(fewer, (kept, *tried), best, tuple(c.name for c in alike)))
        return state, left, made

    def bounds(self, state: ModelState) -> list[DetectionLimit]:
        """For every effect that is not in the model, the size from which it would have shown: three standard
        errors beyond its estimate, at the typical shape. What `state` leaves counts as noise."""
        # of what is left, which counts as noise; what was found and is not named is in it
        variance = max(1.0, state.fit.loss / state.fit.residual.size)
        correlation = residual_correlation(state.fit.residual)
        flat = state.fit.slopes.reshape(state.fit.residual.size, state.fit.slopes.shape[-1])
        base = flat.T @ flat + np.diag(state.fit.precision)
        models = {name: state.model.with_effect(name) for name in self.names(state)}
        size, made = dict[str, float](), list[DetectionLimit]()
        # by the response to what is usual, then to the geometric mean of that and of what would just show:
        # right for a response that goes by the size, and for one that goes by its square
        for _ in range(2):
            trials = {name: grown(state, model, size) for name, model in models.items()}
            near = self._ahead(state, [(models[name], at) for name in models for at in trials[name][1]])
            made = []
            for name, (sizes, (neutral, *larger)) in trials.items():
                worst, at = dict[str, tuple[float, str]](), near.residual(models[name], neutral)
                for j, theta in zip(sizes, larger, strict=True):
                    u = models[name].unknowns[j]
                    column = (at - near.residual(models[name], theta)).ravel() / (theta[j] - neutral[j])
                    column = np.nan_to_num(column, posinf=0.0, neginf=0.0)  # where the rod was lost
                    cross = flat.T @ column
                    absorbed = least_squares(base, cross)
                    power = float(column @ column - cross @ absorbed)
                    here = np.inf
                    if power > 1e-6 * float(column @ column) and power * u.scale**2 >= 1e-2:
                        estimate = float(column @ state.fit.residual.ravel()) / power
                        own = (column - flat @ absorbed).reshape(*state.fit.residual.shape, 1)
                        stderr = np.sqrt(variance * spread(own, correlation) / power)
                        here = float(abs(estimate) + 3.0 * stderr)
                        size[u.name] = float(np.sqrt(here * u.scale))
                    key = _kind_of(name, u)
                    worst[key] = max(worst.get(key, (0.0, u.unit)), (here, u.unit))
                made += [
                    DetectionLimit(name, key or "size", unit, value if np.isfinite(value) else float("nan"))
                    for key, (value, unit) in worst.items()
                ]
        return made


def _kind_of(name: str, u: Unknown) -> str:
    """The parameter that a number of an effect is of: x, y, z of one kind, and drives, are one size."""
    parameters = get_effect(name).parameters
    kind = next(p.name for p in parameters if u.name.partition(".")[2].startswith(p.name))
    return kind[:-1].rstrip("_") if kind in ("x", "y", "z") or kind[-2:] in ("_x", "_y", "_z") else kind


def _suspicion(name: str, z: float, with_it: float, without: float) -> str:
    """The sentence on an effect that is there, or corrects the form of a larger one; of the noise it leaves
    `with_it`, and the others alone `without`."""
    return (
        f"{name.replace('_', ' ')} may be there, too: with it the model leaves {with_it:.2f} of the noise, "
        f"without it {without:.2f} (z {z:.1f}). So small an effect may also be an error in the form of a "
        "larger one's law, and is not named"
    )


def _differs(name: str) -> bool:
    """Whether a law has a size of its own for each drive, which may be one for all."""
    own = any(p.per == "drive" and not (p.shared or p.shape) for p in get_effect(name).parameters)
    return own and not trait(get_effect(name), "last_resort")


def _numbers(model: Model, name: str) -> int:
    """Numbers that an effect adds to a model."""
    return len(model.with_effect(name).unknowns) - len(model.unknowns)


def _yields(robot: Robot) -> bool:
    """Whether the tendons let the body bend otherwise than they say: they go slack, or stretch by some of
    what a segment's own stiffness asks for. Else nothing shows what the body holds back."""
    ends = zip(robot.tendons, robot.tendon_segment, strict=True)
    return any(
        t.unilateral
        or t.compliance * float(np.mean(robot.segments[k].bending_stiffness))
        > _STIFF * float(np.mean(t.offset)) ** 2 * robot.segments[k].length
        for t, k in ends
    )


def grown(
    state: ModelState, model: Model, size: Mapping[str, float] = MappingProxyType({})
) -> tuple[list[int], list[Floats]]:
    """Which numbers of `model` are sizes of the effect that it has and `state` has not; all its numbers (p,)
    where that does nothing, then with one size at a time as large as is usual, or as `size` says if that is
    less."""
    n = len(state.model.unknowns)
    sizes = [j for j, u in enumerate(model.unknowns) if j >= n and not u.shape]
    made = [np.concatenate([state.theta, model.start[n:]])]
    made[0][sizes] = [model.unknowns[j].mean for j in sizes]
    for j in sizes:
        u = model.unknowns[j]
        step = min(size.get(u.name, u.scale), u.scale)
        made.append(made[0].copy())
        made[-1][j] += step if u.mean + step <= u.bounds[1] else -step
    return sizes, made


def starts_of(state: ModelState, model: Model, name: str) -> list[Floats]:
    """Return where fits of `model` begin, which has an effect more than `state`: its parameters' starts."""
    added = model.unknowns[len(state.model.unknowns) :]
    starts = {p.name: p.on(model.wiring).starts for p in get_effect(name).parameters}
    # per-segment and per-drive columns share their parameter's starts
    own = [
        starts[
            next(
                key
                for key in sorted(starts, key=len, reverse=True)
                if u.name.partition(".")[2].startswith(key)
            )
        ]
        for u in added
    ]
    grouped = list(dict.fromkeys(tuple(s) for s in own))
    combos = list(product(*grouped))[: 2 * _STARTS]
    combos = combos if len(combos) <= _STARTS else combos[:: -(-len(combos) // _STARTS)]
    made = []
    for combo in combos:
        pick = dict(zip(grouped, combo, strict=True))
        begin = [
            u.outside(float(np.clip(pick[tuple(s)], *u.bounds))) for u, s in zip(added, own, strict=True)
        ]
        made.append(np.concatenate([state.theta, begin]))
    # a delay that was fitted before may have stood in for this memory
    late = [j for j, u in enumerate(state.model.unknowns) if u.name == "latency.delay"]
    if late and has_memory(get_effect(name)):
        for start in made[:]:
            start = start.copy()
            start[late] = state.model.unknowns[late[0]].mean
            made.append(start)
    return made


def distinct(one: Candidate, other: Candidate) -> bool:
    """Whether blocks and evidence say that an effect is one drive's and not every drive's, or of this law, or
    at these numbers."""
    return other.state is None or _clearly_better(one, other)


def lost_with_it(before: Flags, after: Flags) -> str:
    """That too many samples (n,) have a balance before an effect and none after it, or nothing."""
    lost = float((before & ~after).mean())
    said = f"with it the rod finds no balance at {100.0 * lost:.0f} % of the samples"
    return said if lost > _FEW_LOST else ""


def _as_good(one: Candidate, other: Candidate) -> bool:
    """Whether a candidate with fewer numbers explains as much as the other, and predicts blocks, each held
    out, as well."""
    assert one.state is not None
    assert other.state is not None
    few, alike = one.n_parameters < other.n_parameters, advantage(other, one) < BIC_RIVAL
    return bool(few and alike and one.state.losses.sum() < _AS_WELL * other.state.losses.sum())


def _clearly_better(one: Candidate, other: Candidate) -> bool:
    return advantage(one, other) > BIC_RIVAL and z_between(one, other) > Z_RIVAL


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchOutcome:
    """Outcome of a search in the residual of the base model."""

    search: Search
    """With the weights of the last fit."""
    start: ModelState
    """Without any of it, with its own weights."""
    last: ModelState
    """With alternative patterns."""
    state: ModelState
    """With the effects alone."""
    names: tuple[str, ...]
    """Names of these effects."""
    steps: tuple[SearchStep, ...]
    notes: tuple[str, ...] = ()
    suspected: tuple[str, ...] = ()
    """A sentence on each effect that is too small beside these to be named."""
