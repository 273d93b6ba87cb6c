"""Least squares with priors, and what may be said of it: standard errors, held-out blocks without refits,
evidence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg import cho_factor, cho_solve

from fastrod.identification.search.correlation import correlated, residual_correlation
from fastrod.types import Floats, Ints

Residual = Callable[[Floats], Floats]
"""theta (p,) -> weighted residual (n, n_out), measured - predicted over sigma."""
Slopes = Callable[[Floats, Floats], Floats]
"""theta (p,), residual there -> d(predicted)/d(theta) over sigma, (n, n_out, p)."""

BEYOND = 3.0
"""Standard deviations of its prior: a parameter beyond is evidence of what the model lacks."""
_SMALL_STEP = 1e-3  # of a standard error: below it a fit has arrived
_LEAST = 1e-4  # of the loss: a step that gains less is the last
_TOGETHER = 3  # tries after the first


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A fitted number."""

    value: float
    stderr: float
    unit: str
    identifiable: bool
    """Whether this log says more about it than its prior."""
    why: str = ""
    """Why not, or what to note."""
    prior_sd: float = float("nan")
    """nan: none."""
    at_bound: bool = False
    prior_mean: float = float("nan")
    """nan: none, or not said."""
    prior_distance: float = 0.0
    """Distance from the prior's mean, in its sd; of what is fitted as a logarithm, that of the logarithms."""

    @property
    def beyond_prior(self) -> bool:
        """Whether the data pull it so far from its prior that something else must be wrong."""
        return abs(self.prior_distance) > BEYOND


@dataclass(frozen=True, eq=False)
class Fit:
    """A minimum of the loss."""

    theta: Floats
    """(p,)."""
    residual: Floats
    """(n, n_out) weighted."""
    slopes: Floats
    """(n, n_out, p) weighted."""
    precision: Floats
    """(p,) of the priors, 1 / sd^2."""
    at_bound: tuple[bool, ...]
    """(p,)."""

    @property
    def loss(self) -> float:
        """Sum of squares of the data."""
        return float((self.residual**2).sum())

    @property
    def hessian(self) -> Floats:
        """(p, p) Gauss-Newton, priors included."""
        flat = self.slopes.reshape(self.residual.size, self.slopes.shape[-1])
        return np.asarray(flat.T @ flat + np.diag(self.precision))


def minimise(
    residual: Residual,
    slopes: Slopes,
    start: Floats,
    mean: Floats,
    sd: Floats,
    limits: tuple[Floats, Floats],
    iterations: int,
    tries: int = 6,
    ahead: Callable[[Sequence[Floats]], None] | None = None,
) -> Fit:
    """Levenberg-Marquardt inside `limits`, with normal priors; a step is shortened so many `tries` times at
    most. One that leads to nan counts as worse. `ahead` is called with the places that are tried next, where
    they are had together in the time of one; a step that promised less than the last one must gain is then
    not shortened."""
    low, high = limits
    precision = 1.0 / sd**2
    theta = np.clip(start, low, high)
    r = residual(theta)
    J = slopes(theta, r)

    def cost(at: Floats, of: Floats) -> float:
        total = float((of**2).sum() + (precision * (at - mean) ** 2).sum())
        return total if np.isfinite(total) else np.inf

    best, damping = cost(theta, r), 1e-4
    for _ in range(iterations):
        if not len(theta):
            break
        flat = J.reshape(-1, J.shape[-1])
        gradient = flat.T @ r.ravel() - precision * (theta - mean)
        H = flat.T @ flat + np.diag(precision)
        held = ((theta <= low) & (gradient < 0.0)) | ((theta >= high) & (gradient > 0.0))
        free = ~held
        moved = False
        dampings = [damping, *(max(damping, 1e-3) * 10.0**k for k in range(1, tries))]
        trials = list[Floats]()
        for more in dampings:
            step = np.zeros_like(theta)
            step[free] = _solve(H[np.ix_(free, free)] + more * np.diag(np.diag(H)[free]), gradient[free])
            trials.append(np.clip(theta + step, low, high))
        for k, tried in enumerate(trials):
            damping = dampings[k]
            if ahead is not None and (k == 0 or k % _TOGETHER == 1):
                ahead(trials[k : k + _TOGETHER] if k else trials[:1])
            r_tried = residual(tried)
            now = cost(tried, r_tried)
            if now < best:
                moved = True
                break
            step = tried - theta
            if ahead is not None and 0.0 <= step @ (2.0 * gradient - H @ step) < _LEAST * best:
                break
        if not moved:
            break
        gain = best - now
        step = tried - theta
        theta, r, best, damping = tried, r_tried, now, max(0.1 * damping, 1e-9)
        J = slopes(theta, r)
        if gain < _LEAST * best or np.abs(step * np.sqrt(np.diag(H))).max() < _SMALL_STEP:
            break
    edge = 1e-6 * (np.where(np.isfinite(high - low), high - low, 1.0))
    at = tuple(bool(b) for b in (theta <= low + edge) | (theta >= high - edge))
    return Fit(theta, r, J, precision, at)


def _solve(A: Floats, b: Floats) -> Floats:
    try:
        return np.asarray(cho_solve(cho_factor(A, check_finite=False), b, check_finite=False))
    except LinAlgError:
        return np.asarray(np.linalg.lstsq(A, b, rcond=None)[0])


def least_squares(A: Floats, b: Floats) -> Floats:
    """The least x of a positive semidefinite A x = b, its unknowns measured by their own sizes."""
    size = np.sqrt(np.maximum(np.diag(A), 1e-300))
    scaled = b / (size[:, None] if b.ndim > 1 else size)
    x = np.linalg.lstsq(A / np.outer(size, size), scaled, rcond=1e-12)[0]
    return np.asarray(x / (size[:, None] if b.ndim > 1 else size))


def covariance(fit: Fit) -> Floats:
    """(p, p) of the fitted numbers: priors and data. The data's variance and how its rows know of each other
    are those of the residual, so that what is left counts as the slow noise that it looks like. Whether the
    model has the right form is not in it."""
    if not len(fit.theta):
        return np.zeros((0, 0))
    variance = max(1.0, fit.loss / max(fit.residual.size - len(fit.theta), 1))
    return covariance_of(fit.slopes, fit.precision, residual_correlation(fit.residual), variance)


def covariance_of(slopes: Floats, precision: Floats, correlation: Floats, variance: float = 1.0) -> Floats:
    """(p, p) of a least-squares fit with `slopes` (n, n_out, p) and priors' `precision` (p,), whose rows have
    this `variance` and this autocorrelation (k,); never less than that of independent rows."""
    flat = slopes.reshape(-1, slopes.shape[-1])
    gram = flat.T @ flat
    information = gram / variance + np.diag(precision)
    size = np.sqrt(
        np.maximum(np.diag(information), 1e-300)
    )  # newtons and metres differ by more than rounding
    plain = np.asarray(np.linalg.pinv(information / np.outer(size, size)) / np.outer(size, size))
    if len(correlation) < 2:
        return plain
    middle = flat.T @ correlated(slopes, correlation).reshape(flat.shape) / variance
    found = plain @ (0.5 * (middle + middle.T) + np.diag(precision)) @ plain
    more = np.sqrt(np.maximum(np.diag(plain) / np.maximum(np.diag(found), 1e-300), 1.0))
    return np.asarray(found * more[:, None] * more[None, :])


def effective_size(residual: Floats) -> float:
    """Samples that a residual (n, n_out) in order of time is worth, N (1 - rho) / (1 + rho)."""
    if len(residual) < 3:
        return float(residual.size)
    power = float((residual**2).sum())
    rho = float((residual[1:] * residual[:-1]).sum()) / power if power > 0.0 else 0.0
    rho = min(max(rho, 0.0), 0.999)
    return max(residual.size * (1.0 - rho) / (1.0 + rho), 4.0)


def rms(residual: Floats) -> float:
    """Root mean square of a residual (n, n_out), rows that do not count left out."""
    counted = residual[np.any(residual != 0.0, axis=1)]
    return float(np.sqrt(np.mean(counted**2))) if counted.size else 0.0


def bic(loss: float, n_parameters: int, size: float) -> float:
    """Bayesian information criterion with the error's size unknown, for `size` effective samples."""
    return size * float(np.log(max(loss, 1e-300))) + n_parameters * float(np.log(size))


def held_out_losses(
    residual: Floats, slopes: Floats, precision: Floats, block: Ints, n_blocks: int
) -> Floats:
    """(n_blocks,) loss of each block predicted from the others, by `left_out` parameters and slopes."""
    p = slopes.shape[2]
    losses = np.zeros(n_blocks)
    if not p:
        return np.asarray(
            np.bincount(block, weights=(residual**2).sum(1), minlength=n_blocks), dtype=np.float64
        )
    for k, step in enumerate(left_out(residual, slopes, precision, block, n_blocks)):
        rows = block == k
        losses[k] = float(((residual[rows].ravel() + slopes[rows].reshape(-1, p) @ step) ** 2).sum())
    return losses


def left_out(residual: Floats, slopes: Floats, precision: Floats, block: Ints, n_blocks: int) -> Floats:
    """(n_blocks, p) what each block takes off the parameters: without it they are less by this, by one Newton
    step from the fit to all, theta_-k = theta - (H - H_k)^-1 J_k^T r_k."""
    p = slopes.shape[2]
    flat, steps = slopes.reshape(-1, p), np.zeros((n_blocks, p))
    H = flat.T @ flat + np.diag(precision)
    for k in range(n_blocks):
        rows = block == k
        r, J = residual[rows].ravel(), slopes[rows].reshape(-1, p)
        if len(r):
            steps[k] = _solve(H - J.T @ J + 1e-9 * np.diag(np.diag(H)), J.T @ r)
    return steps


def paired(before: Floats, after: Floats) -> float:
    """z of the gain from losses `before` to those `after`, both (n_blocks,): of its mean, or of the mean
    logarithm of the ratio where a few blocks hold most of the loss."""
    scores = []
    for gain in (before - after, np.log(np.maximum(before, 1e-12)) - np.log(np.maximum(after, 1e-12))):
        spread = float(gain.std(ddof=1)) if len(gain) > 1 else 0.0
        scores.append(float(gain.mean()) / spread * np.sqrt(len(gain)) if spread > 0.0 else 0.0)
    return float(max(scores)) if scores[0] > 0.0 else float(scores[0])
