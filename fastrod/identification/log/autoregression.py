"""Noise whose samples know of each other: an autoregression that is read from stretches at rest.

The likelihood is exact and restricted: each stretch has a level of its own, which is integrated out, so that
a slow noise is not read as too small because its mean over a stretch was taken from it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import minimize

from fastrod.types import Floats

MOST = 4
"""Largest order."""
_LEAST = 8  # samples of a stretch
_RELAXING = 30  # samples of a stretch from which what relaxes is taken off
_MOST_SAMPLES = 6000  # in all, the longest stretches first
_SURE = 8.0  # -2 log likelihood beyond its penalty that more coefficients must bring
_SURE_LINE = 20.0  # the same of a line, whose frequency was looked for
_PERIODS = 2.0  # of a line within one stretch
_HIGH = 0.45  # per sample, of a line
_TAME = 2.0  # of log(1 - partial correlation), the prior's
_FAR = 0.999  # largest partial correlation
_UNSURE = 0.4  # largest relative standard error that is reported: beyond it the likelihood is flat
_STEPS = np.arange(1, 25) * 0.05  # of the inverse hyperbolic tangent of the first partial correlation
_LINES = 3  # peaks of the spectrum that are tried as lines
_MOST_LINES = 240  # frequencies of that spectrum


@dataclass(frozen=True, eq=False)
class AutoRegression:
    """x_t = sum of coefficient_j x_(t-j) + news; without coefficients, white noise."""

    coefficients: tuple[float, ...] = ()

    @property
    def order(self) -> int:
        """Number of coefficients; 0 is white noise."""
        return len(self.coefficients)

    def correlation(self, n: int) -> Floats:
        """(n,) autocorrelation at lags 0 to n - 1."""
        return correlation_of(self.coefficients, n)

    @cached_property
    def length(self) -> float:
        """Samples that one independent sample takes, as for a mean: 1 + 2 sum of the autocorrelation; 1 of
        white noise, and never less."""
        return max(1.0, 1.0 + 2.0 * float(self.correlation(_memory(self.coefficients))[1:].sum()))

    def every(self, step: float) -> Floats:
        """Autocorrelation from row to row where one sample in `step` is kept, until it has faded."""
        if not self.order:
            return np.ones(1)
        fine = self.correlation(_memory(self.coefficients))
        lags = np.arange(0.0, len(fine) - 1.0, max(step, 1.0))
        return np.asarray(np.interp(lags, np.arange(len(fine)), fine))


def correlation_of(coefficients: Sequence[float] | Floats, n: int) -> Floats:
    """(n,) autocorrelation of an autoregression at lags 0 to n - 1."""
    a, p = np.asarray(coefficients, float), len(coefficients)
    made = np.zeros(max(n, p + 1))
    made[0] = 1.0
    if p:
        # Yule and Walker's equations for the first p, whose others follow
        A = np.eye(p)
        for k in range(1, p + 1):
            for j in range(1, p + 1):
                if j != k:
                    A[k - 1, abs(k - j) - 1] -= a[j - 1]
        made[1 : p + 1] = np.linalg.solve(A, a)
        for k in range(p + 1, len(made)):
            made[k] = a @ made[k - 1 : k - p - 1 : -1]
    return made[:n]


def _memory(coefficients: Sequence[float] | Floats) -> int:
    """Lags after which the autocorrelation is below 1e-3."""
    if not len(coefficients):
        return 2
    radius = float(np.abs(np.roots([1.0, *(-c for c in coefficients)])).max())
    return int(min(np.log(1e-3) / np.log(min(max(radius, 1e-6), 0.9999)) + 2 + len(coefficients), 20000))


def from_partial(partial: Floats) -> Floats:
    """(p,) coefficients of these partial correlations, each below 1 in size (Levinson and Durbin)."""
    a = np.zeros(0)
    for k in partial:
        a = np.concatenate([a - k * a[::-1], [k]])
    return a


@dataclass(frozen=True, eq=False)
class RestStretch:
    """Samples at rest that follow each other."""

    time: Floats
    """(m,) in samples, whole numbers; some may be missing."""
    values: Floats
    """(m, 3)."""
    moved: bool = False
    """Whether a motion ended before: what relaxes then is no noise."""


@dataclass(frozen=True, eq=False)
class RestNoise:
    """Noise read from stretches at rest."""

    model: AutoRegression
    sigma: Floats
    """(3,) of the noise, without what drifts, relaxes or sways."""
    uncertainty: float
    """Relative standard error of the distance rms."""
    line: float
    """Frequency of what sways, per sample; nan where nothing does."""


def read_rest(stretches: Sequence[RestStretch], rate: float) -> RestNoise:
    """The noise of these stretches, sampled at `rate` [Hz]: the order by the Bayesian information criterion,
    pooled over stretches and axes. A line in the spectrum, of two periods in a stretch at least, is told from
    broad noise by the same criterion; it is no noise."""
    pieces = _pieces(stretches)
    if not pieces:
        return RestNoise(AutoRegression(), np.zeros(3), 0.0, float("nan"))
    rest = _Rest(pieces, rate)
    best = _broad(rest, None)
    if best.partial.size:
        for frequency in _peaks(rest):
            angle = 2.0 * np.pi * frequency * rest.time
            other = _broad(rest, np.stack([np.sin(angle), np.cos(angle)], axis=1))
            if other.score + _SURE_LINE < best.score:
                best = replace(other, line=frequency)
    model = AutoRegression(tuple(from_partial(best.partial).tolist()))
    pooled = float((best.sigma**4).sum() / (best.sigma**2).sum() ** 2)
    uncertainty = max(float(np.sqrt(0.5 * pooled * model.length / max(best.n, 1.0))), _slower(rest, best))
    return RestNoise(model, best.sigma, uncertainty, best.line)


@dataclass(frozen=True, eq=False)
class _Read:
    partial: Floats
    sigma: Floats
    score: float
    """-2 log likelihood and penalty; the less the better."""
    n: float
    """Samples less what was taken off."""
    line: float = float("nan")


def _pieces(stretches: Sequence[RestStretch]) -> list[RestStretch]:
    """The longest stretches, cut at samples that are missing, not more than enough."""
    made: list[RestStretch] = []
    for one in stretches:
        cuts = np.flatnonzero(np.diff(one.time) != 1) + 1
        for k, rows in enumerate(np.split(np.arange(len(one.time)), cuts)):
            if len(rows) >= _LEAST:
                made.append(RestStretch(one.time[rows], one.values[rows], one.moved and k == 0))
    made.sort(key=lambda s: -len(s.time))
    size = np.cumsum([len(p.time) for p in made])
    return [
        p
        for p, before in zip(made, size - [len(p.time) for p in made], strict=True)
        if before < _MOST_SAMPLES
    ]


class _Rest:
    """Stretches one after the other, with the columns that are each one's own, a level and what relaxes after
    a motion, and one of all, a slope."""

    def __init__(self, pieces: Sequence[RestStretch], rate: float) -> None:
        self.length = np.array([len(p.time) for p in pieces])
        self.start = np.concatenate([[0], np.cumsum(self.length)[:-1]])
        self.time = np.concatenate([p.time for p in pieces]).astype(float)
        self.values = np.concatenate([p.values for p in pieces])
        self.own = np.zeros((len(self.time), 3))
        self.n_own = np.zeros(len(pieces), int)
        for k, (begin, piece) in enumerate(zip(self.start, pieces, strict=True)):
            m = len(piece.time)
            t = piece.time - piece.time[0]
            columns = [np.ones(m)]
            if piece.moved and m >= _RELAXING:
                columns += [np.exp(-t / (tau * rate)) for tau in (1.0, 5.0)]
            q = np.linalg.qr(np.stack(columns, axis=1))[0]
            self.own[begin : begin + m, : q.shape[1]] = q
            self.n_own[k] = q.shape[1]
        self.slope = (self.time - self.time.mean())[:, None] / max(float(self.time.std()), 1.0)

    @cached_property
    def flat(self) -> Floats:
        """(n, 3) values without what their own columns take."""
        made = self.values.copy()
        for begin, m in zip(self.start, self.length, strict=True):
            q = self.own[begin : begin + m]
            made[begin : begin + m] -= q @ (q.T @ made[begin : begin + m])
        return made

    def whitened(self, partial: Floats, columns: Floats) -> tuple[float, Floats]:
        """log det of the correlation of all samples, and columns (n, k) whitened by its exact root."""
        a, p = from_partial(partial), len(partial)
        rho = correlation_of(a, p + 1)
        news = 1.0 - float(a @ rho[1:])
        white = columns.copy()
        for j in range(p):
            white[j + 1 :] -= a[j] * columns[: -j - 1]
        white /= np.sqrt(news)
        logs = float(np.log(news)) * float((self.length - p).sum())
        if p:
            root = np.linalg.cholesky(rho[np.abs(np.subtract.outer(np.arange(p), np.arange(p)))])
            first = self.start[:, None] + np.arange(p)
            white[first] = np.einsum("ij,sjk->sik", np.linalg.inv(root), columns[first])
            logs += 2.0 * float(np.log(np.diag(root)).sum()) * len(self.start)
        return logs, white

    def read(self, partial: Floats, line: Floats | None) -> _Read:
        """Scale by axis, and -2 log of the restricted likelihood with its penalty, of these partial
        correlations, beside a line (n, 2)."""
        shared = self.slope if line is None else np.concatenate([self.slope, line], axis=1)
        logs, white = self.whitened(partial, np.concatenate([self.own, shared, self.values], axis=1))
        own, rest = white[:, :3], white[:, 3:]
        gram = np.add.reduceat(own[:, :, None] * own[:, None, :], self.start, axis=0)
        gram += np.eye(3) * (np.arange(3) >= self.n_own[:, None])[:, None, :]
        cross = np.add.reduceat(own[:, :, None] * rest[:, None, :], self.start, axis=0)
        rest = rest - np.einsum(
            "ni,nij->nj", own, np.repeat(np.linalg.solve(gram, cross), self.length, axis=0)
        )
        logs += float(np.linalg.slogdet(gram)[1].sum())
        q, r = np.linalg.qr(rest[:, :-3])
        values = rest[:, -3:] - q @ (q.T @ rest[:, -3:])
        logs += 2.0 * float(np.log(np.maximum(np.abs(np.diag(r)), 1e-12)).sum())
        n, penalty = float((self.length - self.n_own).sum()) - shared.shape[1], float(len(partial))
        if line is not None:
            # as if the line's columns were of unit size, as the own are
            logs -= 2.0 * float(np.log(0.5 * len(values)))
            penalty += 7.0  # two amplitudes an axis, and the frequency
        variance = np.maximum((values**2).sum(0) / max(n, 1.0), 1e-14)
        score = n * float(np.log(variance).sum()) + 3.0 * logs + penalty * float(np.log(3.0 * n))
        # stretches as short as the noise is slow do not bound it: a random walk would do as well
        score -= _TAME * float(np.log1p(-np.abs(partial)).sum())
        return _Read(partial, np.sqrt(variance), score, n)


def _slower(rest: _Rest, best: _Read) -> float:
    """Return how much larger, relatively, the noise is where it is as slow as one standard error allows:
    stretches that are short beside it hardly bound it."""
    if not best.partial.size:
        return 0.0
    angle = 2.0 * np.pi * best.line * rest.time
    line = np.stack([np.sin(angle), np.cos(angle)], axis=1) if np.isfinite(best.line) else None
    first, size = np.arctanh(best.partial[0]), best.sigma
    least = best.score
    for step in _STEPS:
        partial = best.partial.copy()
        partial[0] = min(float(np.tanh(first + step)), _FAR)
        at = rest.read(partial, line)
        # the likelihood alone, without the prior that holds the noise back
        score = at.score + _TAME * float(np.log1p(-partial[0]) - np.log1p(-best.partial[0]))
        least = min(least, score)
        if score > least + 1.0:
            break
        size = at.sigma
    return min(float(np.linalg.norm(size) / np.linalg.norm(best.sigma) - 1.0), _UNSURE)


def _broad(rest: _Rest, line: Floats | None) -> _Read:
    """The best order without or with a line."""
    best = tried = rest.read(np.zeros(0), line)
    for order in range(1, MOST + 1):
        known = np.clip(tried.partial, -0.98, 0.98)
        first = np.arctanh(np.append(known, 0.2 if order == 1 else 0.0) / _FAR)
        simplex = np.concatenate([first[None], first + 0.3 * np.eye(order)])
        found = _least(lambda x: rest.read(_FAR * np.tanh(x), line).score, simplex)
        tried = rest.read(_FAR * np.tanh(found), line)
        if tried.score + _SURE < best.score:
            best = tried
        elif order > best.partial.size + 1:
            break
    return best


def _least(score: Callable[[Floats], float], simplex: Floats) -> Floats:
    """Return where a score is least, from a simplex (p + 1, p) on."""
    found = minimize(
        score,
        simplex[0],
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 0.01, "fatol": 0.05, "maxfev": 60 * len(simplex)},
    )
    return np.asarray(found.x)


def _peaks(rest: _Rest) -> list[float]:
    """Frequencies per sample of the highest peaks of the spectrum at rest."""
    span, whole = float(rest.length.max()), float(np.ptp(rest.time)) + 1.0
    low = _PERIODS / span
    if low >= _HIGH:
        return []

    def power(frequencies: Floats, start: int, stop: int) -> Floats:
        wave = np.exp(-2j * np.pi * frequencies[:, None] * rest.time[None, start:stop])
        return np.asarray((np.abs(wave @ rest.flat[start:stop]) ** 2).sum(1))

    # stretch by stretch where the power is, then finely: a line stays in phase over the whole log
    coarse = np.linspace(low, _HIGH, int(min(_MOST_LINES, 4 * span)))
    mean = np.sum([power(coarse, b, b + m) for b, m in zip(rest.start, rest.length, strict=True)], axis=0)
    top = float(coarse[int(np.argmax(mean))])
    step = max(0.25 / whole, 2.0 / span / _MOST_LINES)
    fine = np.arange(max(low, top - 1.0 / span), top + 1.0 / span, step)
    sharp = power(fine, 0, len(rest.time))
    found: list[float] = []
    for k in np.argsort(-sharp):
        if all(abs(fine[k] - f) > 2.0 * step for f in found):
            found.append(float(fine[k]))
        if len(found) == _LINES:
            break
    return found
