"""What of a measurement is noise: the camera at rest, and the samples that are outliers whatever the
model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fastrod.identification.log.forward import LogSamples
from fastrod.types import Flags, Floats, Ints

_STILL = 2e-4  # of an input's range; less is no motion
_SETTLE = 1.0  # s after a motion that do not count as rest
_LEAST = 8  # samples of a stretch at rest
ENOUGH = 30  # samples at rest from which a noise is believed
_WINDOW = 7  # samples either side, of the Hampel filter
_OUTLIER = 5.0  # sigma
_MOVES = 0.3  # autocorrelation at rest beyond which more than noise is seen
_TO_SIGMA = 1.4826  # of a median absolute deviation


@dataclass(frozen=True)
class Noise:
    """Noise of the tip."""

    sigma: Floats
    """(3,) per axis [m]."""
    lag1: float
    """Autocorrelation from one sample to the next."""
    how: str
    """What it was read from."""

    @property
    def floor(self) -> float:
        """Distance rms that a perfect model would leave [m]."""
        return float(np.sqrt(np.sum(self.sigma**2)))


def at_rest(samples: LogSamples) -> list[Ints]:
    """Stretches of rows at which no input has moved for a while: arrays of indices into `samples.rows`."""
    log = samples.log
    drives = [log.dl] + [
        a.reshape(len(log), -1)
        for a in (log.ext, log.tip_force, log.payload, log.base_quaternion)
        if a is not None
    ]
    every = np.concatenate(drives, axis=1)
    span = np.maximum(np.ptp(every, axis=0), 1e-12)
    moved = (np.abs(np.diff(every, axis=0)) > _STILL * span).any(1)
    moved = np.concatenate([[True], moved | (samples.dt[1:] <= 0.0)])
    # time since the last motion
    last = np.maximum.accumulate(np.where(moved, np.arange(len(moved)), 0))
    since = samples.time - samples.time[last]
    quiet = (since >= _SETTLE)[samples.rows]
    label = last[samples.rows]
    return [
        rows
        for key in np.unique(label[quiet])
        if len(rows := np.flatnonzero(quiet & (label == key))) >= _LEAST
    ]


def read_noise(samples: LogSamples, tip: Floats, residual: Floats) -> Noise:
    """Noise of the measured `tip` (n_rows, 3) [m] from stretches at rest, or from the fastest part of a
    `residual` where the robot never rests."""
    pieces = at_rest(samples)
    if sum(len(p) for p in pieces) >= ENOUGH:
        flat = []
        pairs = np.zeros(2)
        weight = 0.0
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
            weight += len(rows)
        every = np.concatenate(flat)
        rough = _TO_SIGMA * np.median(np.abs(every), axis=0)
        good = np.abs(every) <= 4.0 * rough + 1e-12
        sigma = np.sqrt(np.array([np.mean(every[good[:, k], k] ** 2) for k in range(3)]))
        lag1 = float(pairs[0] / max(pairs[1], 1e-30))
        if lag1 > _MOVES:  # what moves at rest is no noise: a base that sways
            return Noise(
                _fast(np.concatenate([np.diff(tip[rows], n=3, axis=0) for rows in pieces])),
                lag1,
                f"{len(every)} samples at rest, fast part",
            )
        return Noise(np.maximum(sigma, 1e-7), lag1, f"{len(every)} samples at rest")
    return Noise(
        _fast(np.diff(residual, n=3, axis=0)),
        0.0,
        "third differences of the residual; the robot never rests in this log",
    )


def _fast(third: Floats) -> Floats:
    """(3,) sigma of white noise with these third differences (n, 3), robustly."""
    return np.asarray(
        np.maximum(_TO_SIGMA * np.median(np.abs(third), axis=0) / np.sqrt(20.0), 1e-7)
        if len(third)
        else np.full(3, 1e-4)
    )


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
