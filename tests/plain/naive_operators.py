"""The operators on tendon lengths once more, one tendon and one moment at a time: the whole path is known,
nothing is carried on."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicHermiteSpline


def play(x: np.ndarray, half_width: float, rounding: float = 0.0) -> np.ndarray:
    """The mean of three sharp ones."""
    return np.asarray(
        np.mean(
            [sharp_play(x, half_width * factor) for factor in (1.0 - rounding, 1.0, 1.0 + rounding)], axis=0
        )
    )


def sharp_play(x: np.ndarray, half_width: float) -> np.ndarray:
    p, out = x[0], []
    for here in x:
        if here - p > half_width:
            p = here - half_width
        if p - here > half_width:
            p = here + half_width
        out.append(p)
    return np.array(out)


def yielding(bend: np.ndarray, fraction: float, yield_at: float) -> np.ndarray:
    """(n_steps, 2): a dog on a leash of length `yield_at` that begins at the straight rod."""
    p, out = np.zeros(2), []
    for here in bend:
        leash = float(np.linalg.norm(here - p))
        if leash > yield_at:
            p = here - yield_at * (here - p) / leash
        out.append(here + fraction * p)
    return np.array(out)


def elastoplastic(
    x: np.ndarray, amplitude: float, radii: np.ndarray, growth: float, angle: np.ndarray
) -> np.ndarray:
    """A slider that sticks is a play: what it lags behind by, in its own radius, is its force."""
    force = np.mean(
        [(np.append(0.0, x - x[0]) - play(np.append(0.0, x - x[0]), r))[1:] / r for r in radii], axis=0
    )
    return np.asarray(x - amplitude * (1.0 + growth * angle) * force)


def exp(A: np.ndarray) -> np.ndarray:
    """Series of a thousandth of A, squared ten times; scipy's starts threads for it, which costs a hundred
    times as much."""
    part, term = np.eye(len(A)), np.eye(len(A))
    for k in range(1, 13):
        term = term @ A / (1024.0 * k)
        part = part + term
    for _ in range(10):
        part = part @ part
    return np.asarray(part)


def linear(A: np.ndarray, start: np.ndarray, x: np.ndarray, dt: np.ndarray) -> np.ndarray:
    """(n_steps, n) of z' = A (z - (x, 0 ...)), which rests at z = (x, 0 ...); x linear between samples."""
    n = len(A)
    z, out = start, [start]
    for before, here, h in zip(x, x[1:], dt[1:], strict=False):
        if h > 0.0:
            # z, x and the slope of x as one linear system
            whole = np.zeros((n + 2, n + 2))
            whole[:n, :n], whole[:n, n], whole[n, n + 1] = A, -A[:, 0], 1.0
            z = (exp(whole * h) @ np.concatenate([z, [before, (here - before) / h]]))[:n]
        out.append(z)
    return np.array(out)


def relaxation(x: np.ndarray, fraction: float, time_constant: float, dt: np.ndarray) -> np.ndarray:
    y = linear(np.array([[-1.0 / time_constant]]), np.array([x[0]]), x, dt)[:, 0]
    return np.asarray(x - fraction * (x - y))


def second_order(x: np.ndarray, period: float, damping: float, dt: np.ndarray) -> np.ndarray:
    if period == 0.0:
        return x
    A = np.array([[0.0, 1.0], [-1.0 / period**2, -2.0 * damping / period]])
    return linear(A, np.array([x[0], 0.0]), x, dt)[:, 0]


def delay(x: np.ndarray, lag: float, dt: np.ndarray, buffer: int) -> np.ndarray:
    """Each moment sees the last `buffer` samples, itself included, and interpolates among them."""
    t = np.cumsum(np.append(0.0, dt[1:]))
    out = [x[0]]
    for i in range(1, len(t)):
        first = max(i - buffer + 1, 0)
        wanted = max(t[i] - lag, t[first])
        earlier = [j for j in range(first, i) if t[j] <= wanted]
        if lag == 0.0 or not earlier:
            out.append(x[i])
            continue
        j = earlier[-1]
        ends, values = t[j : j + 2], x[j : j + 2]
        gaps = [
            t[j] - t[j - 1] if j > first else 0.0,
            t[j + 1] - t[j],
            t[j + 2] - t[j + 1] if j + 2 <= i else 0.0,
        ]
        if gaps[0] <= 0.0 or gaps[1] <= 0.0:
            out.append(np.interp(wanted, ends, values))
            continue
        secants = [(x[j] - x[j - 1]) / gaps[0], (x[j + 1] - x[j]) / gaps[1]]
        if gaps[2] > 0.0:
            secants.append((x[j + 2] - x[j + 1]) / gaps[2])
        else:  # nothing newer: the parabola through three goes on
            gaps[2] = gaps[0]
            secants.append(2.0 * secants[1] - secants[0])
        slopes = []
        for s, h in ((secants[:2], gaps[:2]), (secants[1:], gaps[1:])):
            parabola = (s[0] * h[1] + s[1] * h[0]) / (h[0] + h[1])
            most = 3.0 * np.abs(s).min()
            slopes.append(np.clip(parabola, -most, most) if s[0] * s[1] > 0.0 else 0.0)
        out.append(float(CubicHermiteSpline(ends, values, slopes)(wanted)))
    return np.array(out)
