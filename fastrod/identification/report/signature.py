"""Signature of an effect by itself: how far it moves the tip while one bend swings to and fro, less and
less."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fastrod.effects.base import Signal, get_effect, signal_of
from fastrod.identification.log.forward import PredictedRod, predict
from fastrod.identification.log.samples import LogSamples, sample
from fastrod.identification.search.model_selection import ModelState
from fastrod.logs.runlog import RunLog
from fastrod.types import Floats

_PEAKS = (0.0, 1.0, -1.0, 0.65, -0.65, 0.35, -0.35, 0.0)  # of the largest commanded bend
_ROWS = 200
_LEAST_SPEED = 0.02  # rad/s


@dataclass(frozen=True, eq=False)
class Signature:
    """An effect's shift of the tip over a signal, all else as it was fitted."""

    name: str
    signal: Floats
    """(n,) in the unit that `signal_label` names."""
    shift: Floats
    """(n,) [m]"""
    signal_label: str
    shift_label: str


def signatures(
    name: str, state: ModelState, rivals: list[tuple[str, ModelState]], log: RunLog
) -> list[Signature]:
    """An effect of a fitted model, then its rivals in models of their own, over the same commands: of the
    size and speed that `log` has, in the direction that moves the tip most. Without tendons none."""
    if not state.model.wiring.n_tendons:
        return []
    samples, signal, label = _commands(name, state, log)
    shift, tip = _shift(name, state, samples)
    if not np.isfinite(shift).all():
        return []
    if _of_time(name):
        directions = {f"along {axis}": row for axis, row in zip("xyz", np.eye(3), strict=True)}
    else:
        axis, side = np.array([0.0, 0.0, 1.0]), np.append(tip[:, :2].T @ signal, 0.0)
        side /= max(float(np.linalg.norm(side)), 1e-12)
        across = np.cross(axis, side)
        directions = {"along the bend": side, "across the bend": across, "along the base's axis": axis}
    direction = max(directions, key=lambda direction: float(np.abs(shift @ directions[direction]).max()))
    found = [(name, shift), *((other, _shift(other, its, samples)[0]) for other, its in rivals)]
    return [
        Signature(each, signal, moved @ directions[direction], label, f"tip moved {direction}")
        for each, moved in found
    ]


def _commands(name: str, state: ModelState, log: RunLog) -> tuple[LogSamples, Floats, str]:
    """Samples of one bend that swings, or of a straight robot over the log's time for an effect of time; with
    the signal to draw against."""
    wiring = state.model.wiring
    bend = wiring.bend(log.pulls)
    size = np.linalg.norm(bend, axis=-1).max(axis=0)
    k = int(np.argmax(size))
    direction = np.zeros(bend.shape[1:])
    direction[k, int(np.argmax(np.abs(bend[:, k]).max(axis=0)))] = size[k]
    if (drive := state.model.drive_of(name)) is not None:
        alone = wiring.bend(wiring.drive_sign * wiring.by_tendon(np.eye(wiring.n_drives)[drive]))
        direction = size.max() * alone / np.abs(alone).max()
    peaks = np.array(_PEAKS)
    path = np.append(0.0, np.cumsum(np.abs(np.diff(peaks))))
    swing = np.interp(np.linspace(0.0, path[-1], _ROWS), path, peaks)
    moving = np.abs(np.diff(bend, axis=0)).max((1, 2)) / np.maximum(np.diff(log.t), 1e-9)
    speed = max(
        float(np.median(moving[moving > _LEAST_SPEED])) if (moving > _LEAST_SPEED).any() else 0.0,
        _LEAST_SPEED,
    )
    t = np.linspace(0.0, path[-1] * float(np.abs(direction).max()) / speed, _ROWS)
    signal, label = np.degrees(swing * float(np.abs(direction).max())), "commanded bend [°]"
    if _of_time(name):
        t = np.linspace(0.0, float(np.ptp(log.t)), _ROWS)
        signal, label, swing = t, "time [s]", 0.0 * swing
    pulls = wiring.tendon_change(swing[:, None, None] * direction)
    blank = RunLog(
        name=name,
        t=t,
        run=np.full(_ROWS, ""),
        dl=np.zeros_like(pulls),
        tip_position=np.zeros((_ROWS, 3)),
        tension=None if log.tension is None else np.zeros_like(pulls),
    )
    return sample(blank.with_pulls(pulls)), signal, label


def _of_time(name: str) -> bool:
    return signal_of(get_effect(name)) is Signal.TIME


def _shift(name: str, state: ModelState, samples: LogSamples) -> tuple[Floats, Floats]:
    """(n, 3) by which the effect moves the tip, and where that is without it [m]."""
    model, robot = state.model, state.model.robot
    kept = [j for j, u in enumerate(model.unknowns) if u.place[:2] != ("effect", name)]
    with_it, without = (
        predict(m, theta, samples, PredictedRod(samples, robot)).position
        for m, theta in ((model, state.theta), (model.without(name), state.theta[kept]))
    )
    return with_it - without, without
