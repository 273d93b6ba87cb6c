"""A beam that was let go, beside a rod in motion: frequency with nothing fitted, damping fitted on one repeat
and checked on another.

How it was let go is not known: the first swing is 0.6 of what an ideal release gives. So the model is let go,
at rest, where the beam turned back for the first time, under the force at the tip that holds it there.
Silicone creeps: its mean drop grows by 0.3 to 0.9 mm within the first second. Amplitudes are therefore half
the distance from one turning point to the next, which a slow drift leaves alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.signal import argrelextrema

from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Lump, Robot
from fastrod.simulator import Simulator
from fastrod.types import Floats

YOUNGS_MODULUS, POISSON, SIDE = 263_824.0, 0.499, 0.03
"""Constants of the ETH beam, published: Pa, -, m."""
SHEAR_COEFFICIENT = 5.0 / 6.0
WINDOW = 1.0
"""s of ringing that are compared."""
_STEP = 1e-3  # s: a hundredth of the shortest period, 0.13 s
_STARTED = 5e-4  # m: it moves
_LEAST = 2e-4  # m: a smaller swing is drift and noise


@dataclass(frozen=True)
class Ring:
    """Turning points of an oscillation."""

    time: Floats
    """(n,) since the first [s]."""
    place: Floats
    """(n,) [m]"""

    @property
    def amplitude(self) -> Floats:
        """(n - 1,) half the distance from each turning point to the next [m]."""
        return 0.5 * np.abs(np.diff(self.place))

    @property
    def start(self) -> float:
        """Displacement at the first turning point, of a swing that decays evenly [m]."""
        first, second = self.amplitude[:2].tolist()
        return 2.0 * first / (1.0 + second / first)

    @property
    def frequency(self) -> float:
        """Frequency of the straight line through the times of all turning points [Hz]."""
        return 0.5 / float(np.polyfit(np.arange(len(self.time)), self.time, 1)[0])

    def until(self, time: float) -> Ring:
        """The turning points up to `time` [s]."""
        inside = self.time <= time
        return Ring(self.time[inside], self.place[inside])


def ring_of(t: Floats, x: Floats, *, from_rest: bool = False) -> Ring:
    """The turning points of `x` (n,) at even times `t` (n,), each by a parabola through three samples;
    `from_rest` counts the first sample as one."""
    extremes = np.sort(np.concatenate([argrelextrema(x, f, order=3)[0] for f in (np.greater, np.less)]))
    swings = [0] if from_rest else [int(extremes[0])]
    for k in extremes.tolist():
        if k > swings[-1] and abs(x[k] - x[swings[-1]]) > 2.0 * _LEAST:
            swings.append(k)
    at = np.array(swings)
    inside = np.clip(at, 1, len(x) - 2)
    slope, bend = 0.5 * (x[inside + 1] - x[inside - 1]), x[inside + 1] - 2.0 * x[inside] + x[inside - 1]
    shift = np.where(at == inside, -slope / bend, 0.0)  # samples
    time = t[at] + shift * (t[1] - t[0])
    return Ring(time - time[0], x[at] + 0.5 * shift * slope)


def measured_ring(log: RunLog) -> Ring:
    """Return the ring of one run of the beam: the drop of its tip after the release, from the first time
    that it turned back (the second turning point)."""
    drop = log.tip_position[0, 0] - log.tip_position[:, 0]
    began = int(np.flatnonzero(np.abs(drop) > _STARTED)[0])
    every = ring_of(log.t[began:], drop[began:])
    return Ring(every.time[1:] - every.time[1], every.place[1:]).until(WINDOW)


def beam(robot: Robot, load: float, *, damping_time: float = 0.0, shear: bool = True) -> Robot:
    """The published beam with a `load` [N] at the centre of its tip, as a mass; `shear` lets it shear and
    stretch."""
    (segment,) = robot.segments
    area, shear_modulus = SIDE**2, YOUNGS_MODULUS / (2.0 * (1.0 + POISSON))
    soft = {
        "axial_stiffness": YOUNGS_MODULUS * area,
        "shear_stiffness": SHEAR_COEFFICIENT * shear_modulus * area,
    }
    lumps = (Lump(at=segment.length, mass=load / 9.81),) if load else ()
    segment = replace(segment, lumps=lumps, damping_time=damping_time, **(soft if shear else {}))
    return replace(robot, segments=(segment,))


def rest_drop(robot: Robot) -> float:
    """Return how far the tip hangs down at rest [m]."""
    return -float(Simulator(robot, solver="modal", points_per_segment=4).settle().tip_position[0, 0])


def rings(robots: Sequence[Robot], amplitude: float, duration: float = 1.2 * WINDOW) -> list[Ring]:
    """Each robot let go at rest, its tip `amplitude` [m] above where it comes to rest."""
    sim = Simulator(robots, dt=_STEP, points_per_segment=4, dynamics=True)
    rest = sim.settle().tip_position[:, 0]
    force = np.zeros(len(robots))
    for _ in range(4):  # Newton's method
        off = rest + amplitude - sim.settle(tip_force=_upward(force)).tip_position[:, 0]
        force += off / sim.compliance()[:, 0, 0]
    tips = [sim.settle(tip_force=_upward(force)).tip_position[:, 0]]
    tips += [sim.step().tip_position[:, 0] for _ in range(round(duration / _STEP))]
    t, drop = _STEP * np.arange(len(tips)), rest[:, None] - np.array(tips).T
    return [ring_of(t, one, from_rest=True).until(WINDOW) for one in drop]


def damping_of(ring: Ring, robot: Robot, load: float, shear: bool) -> float:
    """The damping time [s] whose ring has the amplitudes of `ring`, each beside the first, as nearly as
    can be."""
    low, high = 2e-4, 2e-2
    for _ in range(4):
        times = np.geomspace(low, high, 9)
        robots = [beam(robot, load, damping_time=float(tau), shear=shear) for tau in times]
        misfit = [decay_error(ring, model) for model in rings(robots, ring.start)]
        k = int(np.argmin([float((e**2).mean()) for e in misfit]))
        low, high = times[max(k - 1, 0)], times[min(k + 1, 8)]
    return float(times[k])


def decay_error(measured: Ring, model: Ring) -> Floats:
    """(n,) amplitude of the model at the times of the measured ones (log-linear between its own) less the
    measured, of the first measured one."""
    middle = [0.5 * (ring.time[1:] + ring.time[:-1]) for ring in (measured, model)]
    at = np.exp(np.interp(middle[0], middle[1], np.log(model.amplitude)))
    inside = middle[0] <= middle[1][-1]
    return np.asarray((at - measured.amplitude)[inside] / measured.amplitude[0])


def compared(log: RunLog, robot: Robot, fitted: str, checked: str, shear: bool) -> dict[str, Any]:
    """Two repeats of one load: frequency of the `checked` one with nothing fitted, its amplitude with the
    damping time that was fitted on the other."""
    run = log.only(checked)
    load = 0.0 if run.payload is None else 9.81 * float(run.payload[0])
    ring = measured_ring(run)
    (free,) = rings([beam(robot, load, shear=shear)], ring.start)
    damping_time = damping_of(measured_ring(log.only(fitted)), robot, load, shear)
    (model,) = rings([beam(robot, load, damping_time=damping_time, shear=shear)], ring.start)
    error = decay_error(ring, model)
    return {
        "run": checked,
        "model": "with shear and stretch" if shear else "bend alone",
        "drop_mm": 1e3 * rest_drop(beam(robot, load, shear=shear)),
        "measured_drop_mm": 1e3 * float(run.tip_position[0, 0] - run.tip_position[-50:, 0].mean()),
        "frequency_hz": free.frequency,
        "measured_hz": ring.frequency,
        "frequency_error": free.frequency / ring.frequency - 1.0,
        "damping_time_ms": 1e3 * damping_time,
        "amplitude_error": float(np.abs(error).max()),
        "last_amplitude_error": float(error[-1] * ring.amplitude[0] / ring.amplitude[len(error) - 1]),
    }


REPEATS = (("gravity_a", "gravity_b"), ("load52_a", "load52_b"))


def _upward(force: Floats) -> Floats:
    return np.stack([force, 0.0 * force, 0.0 * force], axis=1)
