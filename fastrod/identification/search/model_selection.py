"""Evidence for a candidate: the states that the search compares, and the rules by which one is taken, a
rival, or needless."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fastrod.effects.base import get_effect, has_memory, trait
from fastrod.identification.log.unknowns import Model, Unknown
from fastrod.identification.search.alternatives import AlternativePattern
from fastrod.identification.search.linearised import LinearisedModel
from fastrod.identification.search.solve import Fit, bic, covariance, effective_size, paired
from fastrod.types import Floats

Z_ACCEPT, BIC_ACCEPT, FRACTION_ACCEPT = 3.0, 10.0, 0.006
Z_STRONG, BIC_STRONG = 1.7, 60.0  # an effect that shows in a few blocks only, but there beyond doubt
# or one that block after block confirms, where a smooth residual is worth few samples
Z_BLOCKS, FRACTION_BLOCKS = 3.5, 0.03
Z_RIVAL, BIC_RIVAL = 2.0, 10.0
# of what the best leaves above the noise: friction and backlash on a log of another law of both left 0.777
# and 0.775 mm of a noise of 0.69
FRACTION_RIVAL = 0.05
# of what the best takes away: beside much that is left, all that take a little away would be alike
FRACTION_GAIN = 0.2
Z_KEEP, BIC_KEEP, FRACTION_KEEP = 2.0, 6.0, 0.015
# standard errors from a law that another one contains: nearer it is that law, further the richer one
NEAR_SUB_LAW, FAR_FROM_SUB_LAW = 2.0, 3.0
AT_NOISE = 1.1**2  # of a loss: what "explained" is, too
_BEYOND = 7.0  # times a typical size: no tendon's friction or play is so large
_MUCH = 300.0  # BIC by which a richer law is better, whatever its numbers: the contained one does not fit


@dataclass(frozen=True, eq=False)
class ModelState:
    """A model with its fit: what is accepted so far."""

    model: Model
    linearised: LinearisedModel
    fit: Fit
    """Fit of the unknowns, then of the accepted alternative patterns' amplitudes."""
    losses: Floats
    """(N_BLOCKS,) held out."""
    alternatives: tuple[AlternativePattern, ...] = ()

    @property
    def theta(self) -> Floats:
        """(p,) fitted numbers of the model's unknowns, without the alternative patterns' amplitudes."""
        return self.fit.theta[: len(self.model.unknowns)]

    def from_here(self, model: Model) -> Floats:
        """(p,) where a fit of another model of the same robot begins: its numbers of the same name and unit
        as they are here."""
        known = {(u.name, u.unit): number for u, number in zip(self.model.unknowns, self.theta, strict=True)}
        return np.array(
            [known.get((u.name, u.unit), start) for u, start in zip(model.unknowns, model.start, strict=True)]
        )

    @property
    def columns(self) -> Floats:
        """(n, n_out, k) of the accepted alternative patterns."""
        shape = (*self.fit.residual.shape, 0)
        return np.concatenate([np.zeros(shape), *(f.columns for f in self.alternatives)], axis=-1)


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect, or an alternative pattern, beside a state."""

    name: str
    state: ModelState | None
    """With the candidate accepted; None where it was not fitted."""
    z: float
    """z of the gain over held-out blocks."""
    bic_gain: float
    fraction: float
    """Fraction of the loss that it takes away."""
    n_parameters: int
    why: str
    """Why it is not the one, in a sentence."""
    alternative: AlternativePattern | None = None

    @property
    def passes(self) -> bool:
        """It was fitted, and nothing speaks against it."""
        return self.state is not None and not self.why


@dataclass(frozen=True, eq=False)
class SearchStep:
    """One stage of the search: who ran, who was taken."""

    before: ModelState
    candidates: tuple[Candidate, ...]
    taken: Candidate | None
    rivals: tuple[str, ...] = ()
    """Effects that explain this stage as well as the one that was taken."""


@dataclass(frozen=True, eq=False)
class DetectionLimit:
    """The size from which an effect would have shown."""

    name: str
    parameter: str
    unit: str
    value: float
    """nan: no size shows in this log."""


def unfitted(name: str, why: str, n_parameters: int = 0) -> Candidate:
    """A candidate that was not fitted, and why not."""
    return Candidate(name, None, 0.0, 0.0, 0.0, n_parameters, why)


def advantage(one: Candidate, other: Candidate) -> float:
    """BIC by which one candidate is better than the other, with the effective samples of the one that leaves
    less."""
    assert one.state is not None
    assert other.state is not None
    losses = one.state.fit.loss, other.state.fit.loss
    size = effective_size((one.state if losses[0] <= losses[1] else other.state).fit.residual)
    return bic(losses[1], other.n_parameters, size) - bic(losses[0], one.n_parameters, size)


def best_of(candidates: Sequence[Candidate]) -> Candidate | None:
    """The winner by `advantage`, compared one after the other; of equals the first, None of none. All must
    have been fitted."""
    best: Candidate | None = None
    for candidate in candidates:
        if best is None or advantage(candidate, best) > 0.0:
            best = candidate
    return best


def z_between(one: Candidate, other: Candidate) -> float:
    """z over held-out blocks of one candidate's gain on the other."""
    assert one.state is not None
    assert other.state is not None
    return paired(other.state.losses, one.state.losses)


def equally_wrong(before: float, best: float, other: float, noise: float, more: int = 0) -> bool:
    """Whether of two held-out losses, the `best` and another one, both are so far above that of the `noise`
    that they differ by less than their forms are wrong; and both take about as much off the loss `before`.
    Each of the numbers that the best has `more` fits some of that form."""
    wrong = FRACTION_RIVAL * (1 + max(more, 0)) * (best - noise)
    return other - best < min(wrong, FRACTION_GAIN * (before - best))


def from_sub_law(state: ModelState, name: str, where: Mapping[str, str | float]) -> float:
    """Return how far the estimate of an effect lies from a law that it contains (`Law.nests`), in standard
    errors; of several parameters the furthest."""
    theta, spread = state.theta, covariance(state.fit)
    labels = [u.name.removeprefix(f"{name}.") for u in state.model.unknowns]

    def number(parameter: str) -> tuple[float, Floats]:
        """Its value, and the slopes of that by the fitted numbers."""
        j = next(j for j, label in enumerate(labels) if label.startswith(parameter))
        slopes, unknown = np.zeros(len(spread)), state.model.unknowns[j]
        value = unknown.inside(float(theta[j]))
        slopes[j] = value if unknown.log else 1.0
        return value, slopes

    furthest = 0.0
    for parameter, there in where.items():
        value, slopes = number(parameter)
        at, by = number(there) if isinstance(there, str) else (there, np.zeros(len(spread)))
        stderr = float(np.sqrt((slopes - by) @ spread @ (slopes - by)))
        furthest = max(furthest, abs(value - at) / max(stderr, 1e-300) if value != at else 0.0)
    return furthest


def by_estimate(
    best: Candidate, rivals: list[Candidate], tried: Sequence[Candidate], noise: float
) -> list[Candidate]:
    """The best and its rivals, once laws that contain one another are told apart: near the law that it
    contains the richer one is not listed, far from it the contained one is not, and between they are
    rivals if the evidence cannot tell them apart. Where more is left than a held-out loss `noise` explains,
    the richer law's numbers stand for what is missing, too, and only the evidence counts against the other.
    """
    for rich in [best, *rivals]:
        for name, where in trait(get_effect(rich.name), "nests").items():
            sub = next((c for c in tried if c.name == name and c.passes), None)
            if sub is None or sub.state is None or rich.state is None:
                continue
            if sub.state.model.drive_of(name) != rich.state.model.drive_of(rich.name):
                continue
            far = from_sub_law(rich.state, rich.name, where)
            if far <= NEAR_SUB_LAW and advantage(rich, sub) < _MUCH:
                kept = sub
            elif far >= FAR_FROM_SUB_LAW and rich.passes and rich.state.losses.sum() < AT_NOISE * noise:
                kept = rich
            else:
                continue  # for the evidence to say
            others = [c for c in [best, *rivals] if c.name not in (rich.name, name)]
            first = best.name in (rich.name, name)
            best, *rivals = [kept, *others] if first else [*others, kept]
    return [best, *rivals]


def oversized(state: ModelState, name: str) -> list[tuple[Unknown, float]]:
    """Sizes of a law of memory that are larger than any tendon or body has, with what they come out at: it
    stands in for something else."""
    made = []
    for u, number in zip(state.model.unknowns, state.theta, strict=True):
        value = u.inside(float(number))
        own = u.place[:2] == ("effect", name) and u.unit in ("m", "") and has_memory(get_effect(name))
        made += [(u, value)] if own and abs(value) > _BEYOND * u.scale else []
    return made


def unphysical(state: ModelState, name: str) -> str:
    """Why an effect's parameters cannot be, or nothing."""
    sizes = []
    for unknown, number, at_bound in zip(
        state.model.unknowns, state.fit.theta, state.fit.at_bound, strict=False
    ):
        if unknown.place[:2] != ("effect", name) or unknown.shape:
            continue
        value = unknown.inside(float(number))
        sizes.append(abs(value - unknown.mean))
        if at_bound and value != unknown.mean:
            return (
                f"its {unknown.name.partition('.')[2]} would be {value:.3g} {unknown.unit}, at the bound "
                "of what is physical"
            )
    return "" if any(size > 0.0 for size in sizes) else "its best size is zero"
