"""Rows that know of each other: how much less than their number they are worth, and for which question."""

from __future__ import annotations

import numpy as np
from scipy.signal import fftconvolve

from fastrod.identification.log.autoregression import correlation_of, from_partial
from fastrod.types import Floats

_MOST = 8  # largest order that is read from a residual
_FADED = 1e-3


def residual_correlation(residual: Floats) -> Floats:
    """(k,) autocorrelation from row to row of a residual (n, n_out) in order, of the autoregression that the
    Bayesian information criterion takes from Yule and Walker's equations, until it has faded."""
    n = residual.size
    most = min(_MOST, len(residual) // 10)
    power = float((residual**2).sum())
    if power <= 0.0 or most < 1:
        return np.ones(1)
    lags = [1.0] + [float((residual[k:] * residual[:-k]).sum()) / power for k in range(1, most + 1)]
    partial: list[float] = []
    best, taken, news = 0.0, np.zeros(0), 1.0
    for k in range(1, most + 1):
        a = from_partial(np.array(partial))
        new = (lags[k] - float(a @ np.array(lags[k - 1 : 0 : -1]))) / max(news, 1e-12) if k > 1 else lags[1]
        if not abs(new) < 1.0:
            break
        partial.append(new)
        news *= 1.0 - new**2
        score = n * float(np.log(news)) + k * float(np.log(n))
        if score < best - 2.0:
            best, taken = score, from_partial(np.array(partial))
    if not len(taken):
        return np.ones(1)
    every = correlation_of(taken, min(len(residual), 5000))
    loud = np.flatnonzero(np.abs(every) > _FADED)
    return every[: int(loud[-1]) + 1]


def correlated(columns: Floats, correlation: Floats) -> Floats:
    """Columns (n, ...) times the correlation of their rows, of the form that fades with distance (k,)."""
    if len(correlation) < 2:
        return columns
    both = np.concatenate([correlation[:0:-1], correlation])
    kernel = both.reshape(-1, *(1,) * (columns.ndim - 1))
    full = fftconvolve(columns, kernel, axes=0)
    return np.asarray(full[len(correlation) - 1 : len(correlation) - 1 + len(columns)])


def spread(columns: Floats, correlation: Floats) -> float:
    """Return how much more variance correlated rows leave along columns (n, n_out, k) than independent
    ones would: the mean over the directions that the columns span; 1 for white rows, never less."""
    if len(correlation) < 2 or not columns.shape[-1]:
        return 1.0
    flat = columns.reshape(-1, columns.shape[-1])
    u, size, _ = np.linalg.svd(flat, full_matrices=False)
    u = u[:, size > 1e-6 * max(float(size.max(initial=0.0)), 1e-300)]
    if not u.shape[1]:
        return 1.0
    q = u.reshape(*columns.shape[:-1], u.shape[1])
    power = float(np.sum(q * correlated(q, correlation)))
    return max(1.0, power / float(u.shape[1]))


def length(correlation: Floats) -> float:
    """Rows that one independent row takes, as for a mean."""
    return max(1.0, 1.0 + 2.0 * float(correlation[1:].sum()))


def blocks_alike(correlation: Floats, rows: int) -> float:
    """Return how much too large z over blocks of so many rows is, as each knows of the next; 1 for white
    rows."""
    if len(correlation) < 2 or rows < 1:
        return 1.0

    def variance(m: int) -> float:
        k = np.arange(1, min(m, len(correlation)))
        return float(m + 2.0 * ((m - k) * correlation[1 : len(k) + 1]).sum())

    one = variance(rows)
    alike = (0.5 * variance(2 * rows) - one) / max(one, 1e-12)
    return float(np.sqrt(max(1.0, 1.0 + 2.0 * alike)))


def draws(correlation: Floats, n: int, count: int, seed: int = 0) -> Floats:
    """(n, count) normal rows of unit variance with this autocorrelation, by circulant embedding."""
    m = 1 << int(np.ceil(np.log2(2 * max(n, len(correlation)))))
    ring = np.zeros(m)
    ring[: len(correlation)] = correlation
    ring[-len(correlation) + 1 :] += correlation[:0:-1]
    power = np.sqrt(np.maximum(np.fft.rfft(ring).real, 0.0))
    white = np.random.default_rng(seed).normal(size=(m, count))
    return np.asarray(np.fft.irfft(power[:, None] * np.fft.rfft(white, axis=0), n=m, axis=0)[:n])
