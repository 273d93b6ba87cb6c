"""Noise of a measurement: the camera at rest, and the samples that are outliers whatever the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fastrod.identification.log.autoregression import AutoRegression, RestNoise, RestStretch, read_rest
from fastrod.identification.log.camera import resolution
from fastrod.identification.log.samples import LogSamples
from fastrod.types import Flags, Floats, Ints

_STILL = 2e-4  # of an input's range; less is no motion
_SETTLE = 1.0  # s after a motion that do not count as rest
_LEAST = 8  # samples of a stretch at rest
ENOUGH = 30  # samples at rest from which a noise is believed
_WINDOW = 7  # samples either side, of the Hampel filter
_OUTLIER = 5.0  # sigma
_LONG_SETTLE = 3.0  # s, where what is seen at rest is slow: creep and ringing are no noise
_LONG_ENOUGH = 90  # samples that must be left then
_TO_SIGMA = 1.4826  # of a median absolute deviation
_FAST_NEAR, _OF_NEAR = 2.5, 0.9546  # sigma, within which so much of a normal distribution's sigma is left
_OF_FAST = 0.71  # relative standard error of their floor, times the root of their number; by simulation
_KNOWN = 0.05  # a noise that rests tell to this is looked for nowhere else
_OVERFITTED = 0.05  # of white noise, which a model may leave less by
_WITHIN = 2.0  # standard errors of the noise at rest
WHITE = AutoRegression()
"""Samples that know nothing of each other."""


@dataclass(frozen=True)
class Noise:
    """Noise of the tip."""

    sigma: Floats
    """(3,) per axis [m]."""
    lag1: float
    """Autocorrelation from one sample to the next."""
    how: str
    """Source of this estimate."""
    model: AutoRegression = WHITE
    """Correlation of the samples."""
    uncertainty: float = 0.0
    """Relative standard error of `floor`; 0: not known."""
    period: float = 1.0
    """Time from one sample to the next [s]."""
    sway: float = float("nan")
    """A line in the spectrum at rest [Hz], which is no noise; nan: none."""

    @property
    def floor(self) -> float:
        """Distance rms that a perfect model would leave [m]."""
        return float(np.sqrt(np.sum(self.sigma**2)))

    def most(self, n_rows: int) -> float:
        """Distance rms [m] that noise alone exceeds on so many rows once in forty times: two standard errors,
        of the floor and of a mean over as many independent rows as these are worth."""
        rows = max(n_rows / self.model.length, 1.0)
        return self.floor * (1.0 + 2.0 * float(np.hypot(self.uncertainty, 1.0 / np.sqrt(6.0 * rows))))

    def below(self, error: float) -> Noise:
        """Noise no larger than the `error` [m] that a model leaves. Rests bound slow noise but loosely; of
        white noise they say too much only where the robot still moves in them, as with a lag."""
        sure = 1.0 if self.model.order else 1.0 - max(_OVERFITTED, _WITHIN * self.uncertainty)
        if not 0.0 < error < sure * self.floor:
            return self
        return replace(self, sigma=self.sigma * (error / self.floor))

    def row_correlation(self, samples: LogSamples) -> Floats:
        """Autocorrelation of the noise from row to row of `samples`, of which rows may be left out, until it
        has faded; (1,) of white noise."""
        step = np.diff(samples.time[samples.rows])
        step = step[step > 0.0]
        return self.model.every(float(np.median(step)) / self.period if len(step) else 1.0)


def at_rest(samples: LogSamples, settle: float = _SETTLE) -> list[Ints]:
    """Stretches of rows at which no input has moved for `settle` [s]: arrays of indices into
    `samples.rows`."""
    log = samples.log
    every = log.inputs
    span = np.maximum(np.ptp(every, axis=0), 1e-12)
    moved = (np.abs(np.diff(every, axis=0)) > _STILL * span).any(1)
    moved = np.concatenate([[True], moved | (samples.dt[1:] <= 0.0)])
    # time since the last motion
    last = np.maximum.accumulate(np.where(moved, np.arange(len(moved)), 0))
    since = samples.time - samples.time[last]
    quiet = (since >= settle)[samples.rows]
    label = last[samples.rows]
    return [
        rows
        for key in np.unique(label[quiet])
        if len(rows := np.flatnonzero(quiet & (label == key))) >= _LEAST
    ]


def read_noise(samples: LogSamples, tip: Floats, residual: Floats) -> Noise:
    """Noise of the measured `tip` (n_rows, 3) [m] from stretches at rest, or from the fastest part of a
    `residual` where the robot never rests; no less than what its digits leave out."""
    found, step = _read_noise(samples, tip, residual), resolution(np.asarray(samples.log.tip_position))
    coarse = step > found.sigma
    if not coarse.any():
        return found
    # values that are mostly equal say nothing of what rounding did: they may be anywhere in their step
    spread = np.random.default_rng(0).uniform(-0.5, 0.5, tip.shape) * np.where(coarse, step, 0.0)
    found = _read_noise(samples, tip + spread, residual + spread)
    return replace(found, how=f"{found.how}; the tip is rounded to {1e3 * step.max():.3g} mm")


def _read_noise(samples: LogSamples, tip: Floats, residual: Floats) -> Noise:
    pieces = at_rest(samples)
    if sum(len(p) for p in pieces) < ENOUGH:
        how = "third differences of the residual; the robot never rests, so slow noise cannot be seen"
        third = np.diff(residual, n=3, axis=0)
        return Noise(_fast(third), 0.0, how, uncertainty=_OF_FAST / max(len(third), 1) ** 0.5)
    n = sum(len(p) for p in pieces)
    period = samples.step or 1.0
    found = _read(samples, tip, pieces, period)
    how = f"{n} samples at rest"
    if found.model.order:
        late = at_rest(samples, _LONG_SETTLE)
        if sum(len(p) for p in late) >= _LONG_ENOUGH:
            found = _read(samples, tip, late, period)
            how = f"{sum(len(p) for p in late)} samples at rest"
    sway = found.line / period
    if np.isfinite(sway):
        how += f", less a line at {sway:.3g} Hz"
    if not found.model.order and not np.isfinite(sway):
        sigma, lag1 = _white(tip, pieces)
        return Noise(sigma, lag1, how, uncertainty=found.uncertainty, period=period)
    lag1 = float(found.model.correlation(2)[1])
    if found.model.order:
        how += f", coloured: one of {found.model.length:.3g} is independent"
    return Noise(
        np.maximum(found.sigma, 1e-7), lag1, how, found.model, found.uncertainty, period, float(sway)
    )


def read_everywhere(samples: LogSamples, residual: Floats, noise: Noise) -> Noise:
    """Coloured noise that rests are too short to know, from all of a `residual` (n_rows, 3) [m] where this is
    no larger than the `noise` at rest may be; never more than what the residual is. White noise of a robot
    that never rests, no more than this residual jumps."""
    if not noise.model.order:
        if sum(len(rows) for rows in at_rest(samples)) >= ENOUGH:
            return noise
        return replace(noise, sigma=np.minimum(noise.sigma, _fast(np.diff(residual, n=3, axis=0))))
    size = np.sqrt(np.mean(residual[keep(samples, residual, noise)] ** 2, axis=0))
    if noise.uncertainty > _KNOWN and np.sqrt((size**2).sum()) < noise.floor * (
        1.0 + _WITHIN * noise.uncertainty
    ):
        cuts = np.flatnonzero(np.diff(samples.time[samples.rows]) > 1.5 * noise.period) + 1
        ends = np.flatnonzero(np.diff(samples.time[samples.rows]) <= 0.0) + 1
        pieces = np.split(np.arange(len(residual)), np.unique(np.concatenate([cuts, ends])))
        found = _read(samples, residual, [p for p in pieces if len(p) >= _LEAST], noise.period, settled=True)
        if found.model.order and found.uncertainty < noise.uncertainty:
            lag1 = float(found.model.correlation(2)[1])
            how = f"{noise.how}; the residual is as at rest everywhere, so all of it was read"
            sigma = np.minimum(found.sigma, size)
            return replace(
                noise, sigma=sigma, lag1=lag1, how=how, model=found.model, uncertainty=found.uncertainty
            )
    return replace(noise, sigma=np.minimum(noise.sigma, size))


def _read(
    samples: LogSamples, values: Floats, pieces: Sequence[Ints], period: float, *, settled: bool = False
) -> RestNoise:
    """The noise in these rows of `values` (n_rows, 3), outliers left out."""
    first = {span.start for span in samples.runs}
    stretches = []
    for rows in pieces:
        middle = values[rows] - np.median(values[rows], axis=0)
        spread = _TO_SIGMA * np.median(np.abs(middle), axis=0)
        rough = _fast(np.diff(values[rows], n=3, axis=0))
        # what jumps beyond its neighbours, and beyond all that a slow noise does
        near = np.abs(middle) <= 4.0 * np.maximum(spread, rough)
        step = np.diff(middle, axis=0, prepend=middle[:1], append=middle[-1:])
        lonely = (np.minimum(np.abs(step[1:]), np.abs(step[:-1])) > 6.0 * rough) & (
            step[1:] * step[:-1] < 0.0
        )
        good = near.all(1) & ~lonely.any(1)
        at = rows[good]
        if len(at) < _LEAST:
            continue
        time = np.round(samples.time[samples.rows[at]] / period).astype(float)
        # runs have clocks of their own; set them one after the other
        run = int(np.searchsorted(sorted(first), samples.rows[at[0]], side="right"))
        begun = samples.time[samples.rows[rows[0]]] < 1.5 * period + _LONG_SETTLE
        time = time + run * 10 * len(samples.log)
        stretches.append(RestStretch(time, values[at], moved=not settled and not begun))
    return read_rest(stretches, 1.0 / period)


def _white(tip: Floats, pieces: Sequence[Ints]) -> tuple[Floats, float]:
    """(3,) sigma [m] of a tip (n_rows, 3) [m] at rest, a drift of each stretch taken off, and its
    autocorrelation from one sample to the next; both robustly."""
    flat = []
    pairs = np.zeros(2)
    for rows in pieces:
        line = np.linspace(-1.0, 1.0, len(rows))[:, None]
        middle = tip[rows] - np.median(tip[rows], axis=0)
        for _ in range(2):  # the drift, of samples that are no outliers
            near = np.abs(middle) <= 4.0 * _TO_SIGMA * np.median(np.abs(middle), axis=0)
            middle = middle - line * (near * line * middle).sum(0) / np.maximum(
                (near * line**2).sum(0), 1e-12
            )
        flat.append(middle * np.sqrt(len(rows) / (len(rows) - 2.0)))
        inside = np.clip(
            middle, *(side * 4.0 * _TO_SIGMA * np.median(np.abs(middle), axis=0) for side in (-1.0, 1.0))
        )
        pairs += [(inside[1:] * inside[:-1]).sum(), (inside**2).sum()]
    every = np.concatenate(flat)
    rough = _TO_SIGMA * np.median(np.abs(every), axis=0)
    good = np.abs(every) <= 4.0 * rough + 1e-12
    sigma = np.sqrt(np.array([np.mean(every[good[:, k], k] ** 2) for k in range(3)]))
    return np.maximum(sigma, 1e-7), float(pairs[0] / max(pairs[1], 1e-30))


def _fast(third: Floats) -> Floats:
    """(3,) sigma of white noise with these third differences (n, 3), robustly: of those that are near."""
    if not len(third):
        return np.full(3, 1e-4)
    size = _TO_SIGMA * np.median(np.abs(third), axis=0)
    for _ in range(2):
        near = np.abs(third) <= _FAST_NEAR * size
        size = np.sqrt((near * third**2).sum(0) / np.maximum(near.sum(0), 1)) / _OF_NEAR
    return np.asarray(np.maximum(size / np.sqrt(20.0), 1e-7))


def keep(samples: LogSamples, residual: Floats, noise: Noise) -> Flags:
    """(n_rows,) rows that are no outliers: Hampel's filter on a residual (n_rows, 3), the same mask for every
    model."""
    good = np.ones(len(residual), bool)
    run = np.searchsorted([span.start for span in samples.runs], samples.rows, side="right")
    for label in np.unique(run):
        rows = np.flatnonzero(run == label)
        if len(rows) < 2 * _WINDOW + 1:
            continue
        padded = np.pad(residual[rows], ((_WINDOW, _WINDOW), (0, 0)), mode="reflect")
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _WINDOW + 1, axis=0)
        middle = np.median(windows, axis=-1)
        spread = _TO_SIGMA * np.median(np.abs(windows - middle[..., None]), axis=-1)
        far = np.abs(residual[rows] - middle) > _OUTLIER * np.maximum(spread, noise.sigma)
        good[rows] = ~far.any(1)
    return good
