"""Signals against which a residual is drawn: for each effect the signal that its seam suggests, and the
direction in which it shows most."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fastrod.effects.base import Signal, get_effect, signal_of
from fastrod.identification.report.result import Found, Result
from fastrod.identification.report.wording import BASE_MODELS
from fastrod.identification.search.structure import NAME as ONE_SIDED
from fastrod.model.routing import route
from fastrod.rotation import matrix_from_quaternion
from fastrod.types import Flags, Floats, Ints

_BINS = 24
_TIME = "time since the start of the run [s]"
_ACROSS = 0.12  # of the largest bend: motion that counts as along one direction
_DIRECTIONS = 4
_LEAST_LOOP = 50  # rows
_NEAR_AXIS = 0.02  # of the robot's length: nearer to the axis no sideways direction is defined


@dataclass(frozen=True, eq=False)
class SignalView:
    """A residual before and after against a signal, at `rows`."""

    rows: Ints
    """(n,) of the log."""
    signal: Floats
    """(n,) in the unit that `signal_label` names."""
    before: Floats
    """(n,) component of the residual [m]."""
    after: Floats
    """(n,) [m]"""
    signal_label: str
    residual_label: str
    connected: bool = False
    """Draw it as loops: consecutive rows joined."""


class Signals:
    """The rows of a result that can be drawn, and the signals over them."""

    def __init__(self, result: Result) -> None:
        self.result = result
        counted = (
            result.measured
            & ~result.outlier
            & np.isfinite(result.before).all(1)
            & np.isfinite(result.after).all(1)
        )
        self.rows: Ints = np.flatnonzero(counted)
        log = result.log.rows(self.rows)
        self.log = log
        self.before = np.asarray(result.residual_before[self.rows])
        self.after = np.asarray(result.residual_after[self.rows])
        self.tip = np.asarray(result.before[self.rows])
        _, number = np.unique(result.log.run, return_inverse=True)
        self.run: Ints = number[self.rows]
        wiring = route(result.robot)
        n = wiring.n_segments if wiring.n_tendons else 0
        self.bend: Floats = wiring.bend(log.pulls) if n else np.zeros((len(self.rows), 0, 2))
        self.time = self._time()

    def _time(self) -> Floats:
        """(n,) since the start of its run [s]."""
        log = self.result.log
        first = {label: float(log.t[log.run == label].min()) for label in log.runs}
        return np.asarray(self.log.t - np.array([first[label] for label in self.log.run.tolist()]))

    def view(self, found: Found) -> SignalView:
        """The residual against what explains this effect."""
        if found.name in BASE_MODELS:
            rings = found.name != ONE_SIDED
            return self._best([(_TIME, self.time)], self._axes()) if rings else self._over_bend()
        signal = signal_of(get_effect(found.name))
        if signal is Signal.TIME:
            return self._best([(_TIME, self.time)], self._axes())
        if signal is Signal.MOTION:
            return self._along_motion()
        if signal is Signal.GRAVITY:
            return self._along_force(
                self._gravity(),
                "share of gravity that pulls across the robot",
                "residual the way gravity pulls",
            )
        if signal is Signal.FORCE:
            force = np.array(
                [found.parameters[axis].value if axis in found.parameters else 0.0 for axis in "xyz"]
            )
            return self._along_force(
                force, "share of the force that pulls across the robot", "residual the way the force pulls"
            )
        if signal is Signal.TIP or not self.bend.shape[1]:
            return self._over_tip()
        if signal is Signal.LAG:
            return self._behind(
                found.parameters["time_constant"].value if "time_constant" in found.parameters else 5.0
            )
        return (self.loops() if signal is Signal.LOOP else None) or self._over_bend()

    def loops(self) -> SignalView | None:
        """The residual along the bend against the commanded bend, where motion is in one direction; None
        without tendons."""
        best: tuple[float, Floats, Flags, int, float] | None = None
        for k in range(self.bend.shape[1]):
            size = float(np.abs(self.bend[:, k]).max(initial=0.0))
            for angle in np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS:
                along, across = _turned(self.bend[:, k], angle)
                keep = np.abs(across) <= _ACROSS * size
                travel = float(np.abs(np.diff(along))[keep[1:] & keep[:-1] & self._follows()[1:]].sum())
                if size > 0.0 and (best is None or travel > 1.05 * best[0]):
                    best = travel, along, keep, k, angle
        if best is None:
            return None
        _, along, keep, k, angle = best
        if keep.sum() < _LEAST_LOOP:
            keep = np.ones(len(along), bool)
        direction = self._tip_direction(along)
        segment = f" of segment {k + 1}" if self.bend.shape[1] > 1 else ""
        axis = {0: "about x", 1: "about the diagonal", 2: "about y", 3: "about the other diagonal"}[
            round(angle / np.pi * _DIRECTIONS)
        ]
        return SignalView(
            self.rows[keep],
            np.degrees(along[keep]),
            (self.before @ direction)[keep],
            (self.after @ direction)[keep],
            f"commanded bend{segment} {axis} [°]",
            "residual along the bend",
            connected=True,
        )

    def _best(self, signals: list[tuple[str, Floats]], components: list[tuple[str, Floats]]) -> SignalView:
        """The pair of a signal and a residual's direction that explains most of what was there before;
        directions (3,) or (n, 3)."""
        best: tuple[float, str, Floats, str, Floats] | None = None
        for label, signal in signals:
            for word, direction in components:
                before = (self.before * direction).sum(1)
                size = _explained(signal, before)
                if best is None or size > best[0]:
                    best = size, label, signal, word, direction
        assert best is not None
        _, label, signal, word, direction = best
        before, after = (self.before * direction).sum(1), (self.after * direction).sum(1)
        good = np.isfinite(signal) & np.isfinite(before)
        return SignalView(self.rows[good], signal[good], before[good], after[good], label, word)

    def _axes(self) -> list[tuple[str, Floats]]:
        return [(f"residual along {axis}", row) for axis, row in zip("xyz", np.eye(3), strict=True)]

    def _radial(self) -> list[tuple[str, Floats]]:
        """Away from the base's axis where the tip is, and around it."""
        side = self.tip[:, :2]
        radius = np.linalg.norm(side, axis=1)
        unit = np.full((len(side), 3), np.nan)
        away = radius > _NEAR_AXIS * self.result.robot.length
        unit[away] = np.column_stack([side[away] / radius[away, None], np.zeros(away.sum())])
        around = np.column_stack([-unit[:, 1], unit[:, 0], unit[:, 2]])
        return [("residual outward, along the bend", unit), ("residual across the bend", around)]

    def _over_tip(self) -> SignalView:
        tips = [(f"predicted tip {axis} [mm]", 1e3 * self.tip[:, k]) for k, axis in enumerate("xyz")]
        radius = (
            "predicted distance of the tip from the base's axis [mm]",
            1e3 * np.linalg.norm(self.tip[:, :2], axis=1),
        )
        return self._best([*tips, radius], [*self._axes(), *self._radial()])

    def _over_bend(self) -> SignalView:
        signals = []
        many = self.bend.shape[1] > 1
        for k in range(self.bend.shape[1]):
            segment = f" of segment {k + 1}" if many else ""
            for j, axis in enumerate("xy"):
                signals.append((f"commanded bend{segment} about {axis} [°]", np.degrees(self.bend[:, k, j])))
            signals.append(
                (f"commanded bend{segment} [°]", np.degrees(np.linalg.norm(self.bend[:, k], axis=1)))
            )
        return self._best(signals, [*self._axes(), *self._radial()])

    def _behind(self, time_constant: float) -> SignalView:
        """Return how far the bend is from where it was over the last while."""
        step = np.diff(self.time, prepend=self.time[:1])
        signals, components = [], []
        for k in range(self.bend.shape[1]):
            segment = f" of segment {k + 1}" if self.bend.shape[1] > 1 else ""
            slow = _low_pass(self.bend[:, k], step, self._follows(), max(time_constant, 0.05))
            for j, axis in enumerate("xy"):
                label = (
                    f"commanded bend{segment} about {axis} less its mean over the last "
                    f"{time_constant:.2g} s [°]"
                )
                signals.append((label, np.degrees(self.bend[:, k, j] - slow[:, j])))
                components.append(
                    (f"residual along the bend about {axis}", self._tip_direction(self.bend[:, k, j]))
                )
        return self._best(signals, components)

    def _along_motion(self) -> SignalView:
        """Along the predicted velocity of the tip, against its speed."""
        velocity = np.full_like(self.tip, np.nan)
        step = self.time[2:] - self.time[:-2]
        whole = self._follows()[2:] & self._follows()[1:-1] & (step > 0.0)
        velocity[1:-1][whole] = (self.tip[2:] - self.tip[:-2])[whole] / step[whole, None]
        speed = np.linalg.norm(velocity, axis=1)
        unit = velocity / np.where(speed > 1e-9, speed, np.nan)[:, None]
        return self._best(
            [("predicted speed of the tip [mm/s]", 1e3 * speed)], [("residual along the motion", unit)]
        )

    def _along_force(self, force: Floats, signal: str, residual: str) -> SignalView:
        """Along the part of a force, base frame, that pulls across the robot; against the share of it."""
        force = np.broadcast_to(force, self.tip.shape)
        size = np.linalg.norm(force, axis=1)[:, None]
        force = force / np.where(size > 0.0, size, np.nan)
        chord = self.tip / np.linalg.norm(self.tip, axis=1, keepdims=True)
        across = force - (force * chord).sum(1, keepdims=True) * chord
        fraction = np.linalg.norm(across, axis=1)
        unit = across / np.where(fraction > 0.02, fraction, np.nan)[:, None]
        return self._best([(signal, fraction)], [(residual, unit)])

    def _gravity(self) -> Floats:
        robot, quaternion_of_base = self.result.robot, self.log.base_quaternion
        quaternion = (
            np.array([robot.base_quaternion])
            if quaternion_of_base is None
            else np.asarray(quaternion_of_base)
        )
        return np.asarray(np.einsum("nji,j->ni", matrix_from_quaternion(quaternion), np.array(robot.gravity)))

    def _follows(self) -> Flags:
        """(n,) rows that come right after the row before, in the same run."""
        return np.concatenate([[False], (np.diff(self.rows) == 1) & (self.run[1:] == self.run[:-1])])

    def _tip_direction(self, along: Floats) -> Floats:
        """(3,) the way the predicted tip goes with a bend, sideways."""
        slope = np.append((self.tip - self.tip.mean(0))[:, :2].T @ along, 0.0)
        size = float(np.linalg.norm(slope))
        return slope / size if size > 0.0 else np.array([1.0, 0.0, 0.0])


def bin_means(signal: Floats, values: Floats, bins: int = _BINS) -> Iterator[tuple[float, float, int]]:
    """Centre and mean of `values` in bins of equal width of the signal, and how many there are."""
    low, high = (float(edge) for edge in np.quantile(signal, [0.002, 0.998]))
    if not high > low:
        yield low, float(values.mean()), len(values)
        return
    place = np.clip(((signal - low) / (high - low) * bins).astype(int), 0, bins - 1)
    for k in np.unique(place):
        inside = place == k
        yield float(signal[inside].mean()), float(values[inside].mean()), int(inside.sum())


def _explained(signal: Floats, values: Floats) -> float:
    """Sum of squares that the mean at each signal takes away."""
    good = np.isfinite(signal) & np.isfinite(values)
    if not good.any():
        return 0.0
    return sum(count * mean**2 for _, mean, count in bin_means(signal[good], values[good]))


def _turned(bend: Floats, angle: float) -> tuple[Floats, Floats]:
    """Components of a bend (n, 2) along a direction and across it."""
    c, s = np.cos(angle), np.sin(angle)
    return bend[:, 0] * c + bend[:, 1] * s, bend[:, 1] * c - bend[:, 0] * s


def _low_pass(values: Floats, step: Floats, follows: Flags, time_constant: float) -> Floats:
    """First-order lag of values (n, 2), begun anew where a row does not follow the one before."""
    out = values.copy()
    fraction = 1.0 - np.exp(-np.maximum(step, 0.0) / time_constant)
    for i in np.flatnonzero(follows):
        out[i] = out[i - 1] + fraction[i] * (values[i] - out[i - 1])
    return out
