"""Test of whether a residual depends on anything that is known: inputs now, inputs before, or time; without
naming a cause.

Ridge regression on general features, judged on blocks that it has not seen. The shares are increments: static
features first, then those with memory, then time. What follows from none of them and is still not noise is a
signal from outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fastrod.identification.log.samples import LogSamples
from fastrod.identification.search.correlation import draws, length
from fastrod.identification.search.revisits import Revisits
from fastrod.identification.search.solve import paired
from fastrod.model.routing import Routing
from fastrod.types import Floats, Ints

_RANDOM = 60  # Fourier features
_PLAYS = (0.03, 0.1, 0.25, 0.5)  # of the largest bend
_LAGS = (0.3, 1.5, 6.0, 25.0)  # s
_PIECES = 60  # blocks that the folds take in turn
_RIDGES = (1.0, 30.0, 1000.0)
_LONG_ENOUGH = 200  # samples of a run, whose spectrum tells something
_BAND = 0.99  # of the commands' power
_DRAWS = 30  # of noise that is alike from row to row


@dataclass(frozen=True)
class ResidualStructure:
    """Shares of the residual's variance that held-out blocks confirm."""

    static: float
    memory: float
    drift: float
    exogenous: float
    """Autocorrelation that no input, memory or time explains, as a share of the variance."""
    z: float
    """Significance of any structure, over blocks."""

    def with_memory(self, again: Revisits | None) -> ResidualStructure:
        """The same, with what visits of one command say is memory: from outside comes the less."""
        if again is None or not np.isfinite(again.memory):
            return self
        more = min(max(again.memory - self.memory, 0.0), self.exogenous)
        return replace(self, memory=self.memory + more, exogenous=self.exogenous - more)

    @property
    def structured(self) -> float:
        """Share of the variance that is no noise."""
        return min(1.0, self.static + self.memory + self.drift + self.exogenous)

    @property
    def kind(self) -> str:
        """The largest share; `none` where there is no structure."""
        pieces = {
            "static": self.static,
            "memory": self.memory,
            "drift": self.drift,
            "unknown": self.exogenous,
        }
        name = max(pieces, key=lambda key: pieces[key])
        return name if self.structured > 0.0 and pieces[name] > 0.0 else "none"


def residual_structure(
    samples: LogSamples,
    wiring: Routing,
    residual: Floats,
    noise_lag1: float = 0.0,
    n_blocks: int = 10,
    *,
    correlation: Floats | None = None,
    doubt: float = 0.0,
) -> ResidualStructure:
    """Audit a residual (n_rows, n_out) in order of time, on `n_blocks` folds of short blocks. The noise is
    alike from row to row by `noise_lag1`, or by all of a `correlation` (k,) that fades: then a share counts
    by what it has beyond that of simulated noise. `doubt`: relative standard error of the noise."""
    alike = np.ones(1) if correlation is None else correlation
    if coloured := len(alike) > 1:
        noise_lag1 = float(alike[1])
    variance = float((residual**2).sum())
    block = np.arange(len(residual)) * _PIECES // max(len(residual), 1) % n_blocks
    if variance <= 0.0 or n_blocks < 3:
        return ResidualStructure(0.0, 0.0, 0.0, 0.0, 0.0)
    static, memory, drift = features(samples, wiring)
    losses: list[Floats] = [
        np.asarray(np.bincount(block, weights=(residual**2).sum(1), minlength=n_blocks), dtype=np.float64)
    ]
    columns = np.zeros((len(residual), 0))
    left = residual
    fractions = []
    null = _Null(alike, residual.shape[1], block, n_blocks) if coloured else None
    for more in (static, memory, drift):
        columns = np.concatenate([columns, more], axis=1)
        loss, rest = _ridge(columns, residual, block, n_blocks)
        gain = losses[-1] - loss
        by_noise = null.gain(columns) if null else 0.0
        fraction = float(gain.sum()) / variance - by_noise
        if fraction > 0.0 and paired(losses[-1], loss) > 2.5:
            fractions.append(fraction)
            losses.append(loss)
            left = rest
        else:
            fractions.append(0.0)
    order = np.diff(samples.rows) <= max(
        1.0, 1.5 * float(np.median(np.diff(samples.rows))) if len(samples.rows) > 1 else 1.0
    )
    pair = float((left[1:] * left[:-1])[order].sum()) / max(float((left**2).sum()), 1e-300)
    beyond = max(0.0, pair - max(noise_lag1, 0.0)) if len(left) > 50 else 0.0
    unsure = 4.0 / np.sqrt(max(left.size, 1)) + 0.02
    if coloured:  # the noise's own autocorrelation is known from rests only
        unsure += 3.0 * doubt * float(np.sqrt(2.0 * (1.0 - noise_lag1**2) / length(alike)))
    exogenous = beyond * float((left**2).sum()) / variance if beyond > unsure else 0.0
    z = paired(losses[0], losses[-1]) if len(losses) > 1 else 0.0
    return ResidualStructure(
        fractions[0], fractions[1], fractions[2], exogenous, float(max(z, beyond * np.sqrt(left.size)))
    )


def faster_than_commands(samples: LogSamples, residual: Floats) -> tuple[float, float]:
    """Share of the square of a residual (n, 3) of all samples above the band of the commands, and where that
    ends [Hz]: no law at rest is faster than its inputs. 0 and nan where no run is long and even enough to
    tell."""
    above = whole = ends = 0.0
    for span in samples.runs:
        left, t = residual[span], samples.time[span]
        good = np.isfinite(left).all(1)
        if good.sum() < _LONG_ENOUGH or not good.any():
            continue
        dt = float(np.median(np.diff(t)))
        even = np.arange(t[good][0], t[good][-1], dt)
        columns = np.column_stack([left, samples.log.commands[span]])
        values = np.stack([np.interp(even, t[good], column[good]) for column in columns.T], axis=1)
        window = np.hanning(len(even))[:, None]
        power = np.abs(np.fft.rfft((values - values.mean(0)) * window, axis=0)) ** 2
        commanded = power[:, 3:].sum(1).cumsum()
        if not commanded[-1] > 0.0:
            continue
        k = int(np.searchsorted(commanded, _BAND * commanded[-1]))
        above, whole = above + power[k + 1 :, :3].sum(), whole + power[:, :3].sum()
        ends = max(ends, k / (dt * len(even)))
    return (above / whole, ends) if whole > 0.0 else (0.0, float("nan"))


class _Null:
    """Distribution of the score of general features on noise that is alike from row to row: slow noise
    follows slow features from one block to the next."""

    def __init__(self, correlation: Floats, n_out: int, block: Ints, n_blocks: int) -> None:
        drawn = draws(correlation, len(block), n_out * _DRAWS)
        self._noise, self._n_out = drawn, n_out
        self._block, self._n_blocks = block, n_blocks
        self._left = self._by_draw((drawn**2).sum(0))
        self._power = self._left.copy()

    def _by_draw(self, squares: Floats) -> Floats:
        return np.asarray(squares.reshape(_DRAWS, self._n_out).sum(1))

    def gain(self, features: Floats) -> float:
        """Share of the variance that `features` take away beyond those asked for before, at most but for a
        rare draw."""
        left = np.full(_DRAWS, np.inf)
        for ridge in _RIDGES:
            _, rest = _ridge(features, self._noise, self._block, self._n_blocks, (ridge,))
            left = np.minimum(left, self._by_draw((rest**2).sum(0)))
        gain, self._left = (self._left - left) / self._power, left
        return max(0.0, float(gain.mean() + 3.0 * gain.std()))


def _ridge(
    features: Floats, residual: Floats, block: Ints, n_blocks: int, ridges: Sequence[float] = _RIDGES
) -> tuple[Floats, Floats]:
    """Held-out loss of each block, and the held-out rest, at the best of a few ridges."""
    X = np.column_stack([np.ones(len(features)), features])
    gram, moment = X.T @ X, X.T @ residual
    own = [(X[block == k], residual[block == k]) for k in range(n_blocks)]
    best: tuple[float, Floats, Floats] | None = None
    for ridge in ridges:
        losses, rest = np.zeros(n_blocks), residual.copy()
        for k, (x, r) in enumerate(own):
            if not len(x):
                continue
            weights = np.linalg.solve(gram - x.T @ x + ridge * np.eye(len(gram)), moment - x.T @ r)
            left = r - x @ weights
            losses[k] = float((left**2).sum())
            rest[block == k] = left
        if best is None or losses.sum() < best[0]:
            best = float(losses.sum()), losses, rest
    assert best is not None
    return best[1], best[2]


def features(samples: LogSamples, wiring: Routing) -> tuple[Floats, Floats, Floats]:
    """Static, memory and time features (n_rows, any), each of about unit size."""
    log, rows = samples.log, samples.rows
    bend = wiring.bend(log.pulls).reshape(len(log), -1) if wiring.n_tendons else np.zeros((len(log), 0))
    top = max(float(np.abs(bend).max(initial=0.0)), 1e-9)
    b = bend / top
    others = [
        np.asarray(a).reshape(len(log), -1)
        for a in (log.ext, log.tip_force, log.payload, log.base_quaternion)
        if a is not None
    ]
    more = np.concatenate(others, axis=1) if others else np.zeros((len(log), 0))
    more = (more - more.mean(0)) / np.maximum(more.std(0), 1e-9) * (np.ptp(more, axis=0) > 1e-9)
    more = more[:, np.ptp(more, axis=0) > 0.0]
    rng = np.random.default_rng(0)
    static = [b, more]
    now = np.concatenate([b, 0.5 * more], axis=1)
    for i in range(now.shape[1]):
        static += [now[:, i : i + 1] * now[:, i:]]
    static += [
        b[:, i : i + 1] * b[:, j : j + 1] * b[:, j:] for i in range(b.shape[1]) for j in range(i, b.shape[1])
    ]
    if now.shape[1]:
        for width in (1.5, 5.0):
            direction = width * rng.normal(size=(now.shape[1], _RANDOM // 2))
            static.append(np.cos(now @ direction + rng.uniform(0.0, 2.0 * np.pi, _RANDOM // 2)))
    memory = [_memory(b[span], samples.dt[span]) for span in samples.histories]
    t = np.cumsum(samples.dt)
    t = t / max(float(t[-1]), 1e-9)
    drift = np.stack([f(np.pi * k * t) for k in range(1, 7) for f in (np.sin, np.cos)] + [t, t**2], axis=1)
    return np.concatenate(static, axis=1)[rows], np.concatenate(memory)[rows], drift[rows]


def _memory(b: Floats, dt: Floats) -> Floats:
    """Plays of four widths, low-passes of four time constants, velocity, its sign, acceleration of bends (n,
    2 n_segments)."""
    from fastrod.kernels.operators import play, relaxation

    if not b.shape[1]:
        return np.zeros((len(b), 0))
    found = []
    for width in _PLAYS:
        x = b[None].copy()
        play(
            x,
            np.full((1, 3 * b.shape[1]), np.nan),
            np.full((1, b.shape[1]), width),
            np.zeros((1, b.shape[1])),
        )
        found.append((b - x[0]) / width)
    for lag in _LAGS:
        x = b[None].copy()
        relaxation(
            x,
            np.full((1, 2 * b.shape[1]), np.nan),
            np.ones((1, b.shape[1])),
            np.full((1, b.shape[1]), lag),
            dt,
        )
        found.append(2.0 * (b - x[0]))
    velocity = np.diff(b, axis=0, prepend=b[:1]) / np.maximum(dt, 1e-3)[:, None]
    found += [velocity, np.tanh(velocity / 0.05), np.diff(velocity, axis=0, prepend=velocity[:1])]
    return np.concatenate(found, axis=1)
