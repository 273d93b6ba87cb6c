"""Latency of a camera: the delay at which what was measured follows best from what was moved."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fastrod.checks import Bound, check_number
from fastrod.errors import InputError
from fastrod.model.routing import route
from fastrod.types import Floats
from fastrod_device.errors import CalibrationError
from fastrod_device.hardware import Hardware
from fastrod_device.prototype import Prototype

# a camera may also be said to be later than it is: searched before zero, as a part of `longest`
_EARLY = 0.25
_STEP = 0.004  # of the coarse search [s]
_LEAST_ROWS = 30
_LEAST_EXPLAINED = 0.5  # of the positions' variance
_LARGEST_ERROR = 0.1  # standard error, as a part of `longest`
_SWEEP, _RAMP = 15.0, 1.5  # s that the robot moves, and in which the motion grows and fades
_BEND, _WAVES = 0.6, (0.45, 0.31)  # rad at most, and Hz to either side: never the same twice
_MARGIN = 0.5  # of what the limits allow
_PLAYS = (0.05, 0.15)  # half widths of lost motion, as parts of the largest motion


@dataclass(frozen=True, kw_only=True)
class LoopLatency:
    """A delay, and how well it is known."""

    delay: float
    """Delay of the camera's positions behind the motion [s]; negative where their time stamps are early."""
    stderr: float
    """Standard error of it [s]."""


def estimate_latency(
    t_motion: Floats, motion: Floats, t_camera: Floats, position: Floats, *, longest: float = 0.4
) -> LoopLatency:
    """Delay of positions (n, 3) [m] at times t_camera (n,) behind a motion (m, k) at rising times t_motion
    (m,) [s].

    What the motion is does not matter (tendon lengths, encoder counts, a predicted tip): positions are fitted
    by least squares with the delayed motion, its products, and a constant; the delay is the one that leaves
    least, searched from -longest/4 to longest. The standard error allows for residuals that are alike from
    frame to frame. Rows with nan are dropped. Raises `CalibrationError` where too little moved to tell,
    `InputError` for wrong shapes.
    """
    t_motion, motion, t_camera, position = (
        np.asarray(a, dtype=np.float64) for a in (t_motion, motion, t_camera, position)
    )
    if (
        t_motion.ndim != 1
        or motion.ndim != 2
        or motion.shape[0] != t_motion.size
        or position.shape != (*t_camera.shape, 3)
        or t_camera.ndim != 1
    ):
        shapes = f"{t_motion.shape}, {motion.shape}, {t_camera.shape} and {position.shape}"
        raise InputError(
            f"t_motion, motion, t_camera and position have shapes {shapes}; (m,), (m, k), (n,) "
            "and (n, 3) would be right."
        )
    check_number("longest", longest, Bound(above=0.0, unit="s", infinite=True))
    good = np.isfinite(t_motion) & np.isfinite(motion).all(1)
    t_motion, motion = t_motion[good], motion[good]
    if t_motion.size < 2 or (np.diff(t_motion) <= 0.0).any():
        raise InputError("t_motion must rise from row to row, and have two rows or more.")
    low, high = -_EARLY * longest, longest
    good = (
        np.isfinite(t_camera)
        & np.isfinite(position).all(1)
        & (t_camera - high >= t_motion[0])
        & (t_camera - low <= t_motion[-1])
    )
    t, seen = t_camera[good], position[good]
    if t.size < _LEAST_ROWS:
        raise CalibrationError(
            f"{t.size} positions fall within the motion, less {longest:g} s; "
            f"{_LEAST_ROWS} or more are needed."
        )
    order = np.argsort(t)
    t, seen = t[order], seen[order] - seen[order].mean(0)
    moved = _directions(motion)
    if moved.shape[1] == 0 or not (seen * seen).sum() > 0.0:
        raise CalibrationError(
            "nothing moved; move the tip to and fro, by some of its reach, for some seconds."
        )

    def rest(delay: float) -> Floats:
        """(n, 3) what a delay leaves."""
        shifted = np.stack([np.interp(t - delay, t_motion, column) for column in moved.T], axis=1)
        pairs = np.triu_indices(shifted.shape[1])
        features = np.column_stack([np.ones(t.size), shifted, shifted[:, pairs[0]] * shifted[:, pairs[1]]])
        basis, scale, _ = np.linalg.svd(features, full_matrices=False)
        basis = basis[:, scale > 1e-9 * scale[0]]
        return np.asarray(seen - basis @ (basis.T @ seen))

    def loss(delay: float) -> float:
        return float((rest(delay) ** 2).sum())

    grid = np.linspace(low, high, max(math.ceil((high - low) / _STEP), 20) + 1)
    losses = np.array([loss(delay) for delay in grid])
    best = int(np.argmin(losses))
    explained = 1.0 - losses[best] / float((seen * seen).sum())
    if explained < _LEAST_EXPLAINED:
        raise CalibrationError(
            f"the motion explains {100 * explained:.0f} % of the positions at any delay; move the tip "
            "farther, to and fro."
        )
    if best in (0, len(grid) - 1):
        raise CalibrationError(
            f"no delay from {low:g} to {high:g} s fits best; search longer than "
            f"{longest:g} s, or move less regularly."
        )
    delay = _least(loss, float(grid[best]), float(grid[1] - grid[0]))
    stderr = _stderr(rest, delay, float(grid[1] - grid[0]))
    if not stderr < _LARGEST_ERROR * longest:
        raise CalibrationError(
            f"the delay is uncertain by {1e3 * stderr:.0f} ms; move the tip farther and faster, to and fro."
        )
    return LoopLatency(delay=delay, stderr=stderr)


def measure_latency(prototype: Prototype) -> LoopLatency:
    """Move the robot to and fro for some seconds, within half of its limits, and compare encoders with
    sightings.

    The delay is beyond `Camera.latency` of its hardware: sightings are stamped by that. Friction and backlash
    make the tip late, too, the more the slower it moves; so the tip is fitted with the tendons and with what
    a play of two widths would leave of them, and the sweep has two frequencies. A sixth of what they would
    count for may remain. It ends where it began. Raises what a stopped prototype raises, and
    `CalibrationError` where the sightings do not tell."""
    start, began = prototype.commanded, prototype.clock.now()
    dt = 1.0 / prototype.hardware.rate
    motion: list[tuple[float, Floats]] = []
    seen: list[tuple[float, Floats]] = []
    while (t := prototype.clock.now() - began) < _SWEEP:
        prototype.command(start + sweep(prototype.hardware, np.array([t]))[0])
        prototype.wait(dt)
        readings, sighting = prototype.readings, prototype.sighting
        if readings is not None and (not motion or readings.t > motion[-1][0]):
            motion.append((readings.t, readings.dl))
        if (
            sighting is not None
            and sighting.ok
            and sighting.t >= began
            and (not seen or sighting.t > seen[-1][0])
        ):
            seen.append((sighting.t, sighting.position))
    if not motion or not seen:
        raise CalibrationError(
            f"the camera saw the marker {len(seen)} times in {_SWEEP:g} s; {_LEAST_ROWS} "
            "times or more are needed."
        )
    (t_motion, dl), (t_camera, position) = (
        (np.array([t for t, _ in rows]), np.stack([row for _, row in rows])) for rows in (motion, seen)
    )
    largest = float(np.abs(dl - dl[0]).max())
    return estimate_latency(
        t_motion,
        np.concatenate([dl, *(play(dl, fraction * largest) for fraction in _PLAYS)], axis=1),
        t_camera,
        position,
    )


def play(motion: Floats, half_width: float) -> Floats:
    """(m, k) what follows a motion (m, k) through a gap: it stays until the motion is `half_width` away, and
    is dragged then."""
    at, followed = motion[0], np.empty_like(motion)
    for k, row in enumerate(motion):
        at = np.clip(at, row - half_width, row + half_width)
        followed[k] = at
    return followed


def sweep(hardware: Hardware, t: Floats) -> Floats:
    """(n, n_tendons) changes of tendon length [m] at times (n,) [s] of `measure_latency`'s motion: all
    segments bend alike, to and fro."""
    routing, limits = route(hardware.robot), hardware.limits
    whole = np.arange(0.0, _SWEEP, 1.0 / hardware.rate)

    def lengths_at(times: Floats) -> Floats:
        grown = np.clip(np.minimum(times, _SWEEP - times) / _RAMP, 0.0, 1.0)
        bend = _BEND / routing.n_segments * grown[:, None] * np.sin(2.0 * np.pi * np.outer(times, _WAVES))
        return routing.tendon_change(np.repeat(bend[:, None], routing.n_segments, axis=1))

    path = lengths_at(whole)
    bends = _BEND * math.sqrt(2.0) / routing.n_segments
    needed = (
        float(np.abs(np.diff(path, axis=0)).max()) * hardware.rate / limits.rate,
        float(np.abs(path).max()) / limits.displacement,
        bends / float(routing.length.min()) / limits.curvature,
    )
    return lengths_at(t) * min(1.0, _MARGIN / max(needed))


def _directions(motion: Floats) -> Floats:
    """(m, r) motion along its principal directions, each of unit spread; those that hardly move are left
    out."""
    centred = motion - motion.mean(0)
    left, scale, _ = np.linalg.svd(centred, full_matrices=False)
    kept = (
        scale > 1e-3 * scale[0]
        if scale[0] > 1e-12 * max(1.0, float(np.abs(motion).max())) * math.sqrt(len(motion))
        else scale > np.inf
    )
    return np.asarray(left[:, kept] * math.sqrt(len(motion)))


def _least(loss: Callable[[float], float], start: float, width: float) -> float:
    """Bottom of the loss near `start`: parabolas through three points, ever closer."""
    at = start
    for _ in range(3):
        a, b, c = loss(at - width), loss(at), loss(at + width)
        bend = a - 2.0 * b + c
        if bend > 0.0:
            at += min(max(0.5 * width * (a - c) / bend, -width), width)
        width *= 0.5
    return at


def _stderr(rest: Callable[[float], Floats], delay: float, step: float) -> float:
    """Standard error of the delay, by the loss's curvature; scores that are alike from frame to frame are
    counted as Newey and West (1987) do."""
    r = rest(delay)
    slope = (rest(delay + step) - rest(delay - step)) / (2.0 * step)
    curvature = float((slope * slope).sum())
    if curvature <= 0.0:
        return math.inf
    score = (slope * r).sum(1)
    lags = min(int(4.0 * (len(score) / 100.0) ** (2.0 / 9.0)) + 4, len(score) // 4)
    spread = float(score @ score)
    spread += sum(
        2.0 * (1.0 - lag / (lags + 1.0)) * float(score[lag:] @ score[:-lag]) for lag in range(1, lags + 1)
    )
    white = float((r * r).sum()) / r.size * curvature
    return math.sqrt(max(spread, white)) / curvature
