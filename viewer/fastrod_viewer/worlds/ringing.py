"""`Ringing`: what a world adds whose rods have inertia: the spring of a drag, and whether they rest."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, final

import numpy as np

from fastrod.errors import InputError
from fastrod.model.robot import Robot
from fastrod.simulator import Simulator
from fastrod.solver.state import State
from fastrod.types import Floats

FARTHEST_PULL = 0.25
"""Fraction of the robot's length: the spring of a drag is as strong at every larger distance."""
_STIFFER = 10.0  # the spring of a drag, times the tip's stiffness in its softest direction, at most
_SLOW = 0.25  # of that stiffness, times the square of the first mode's angle in a step: more grows by itself
_FEWEST, _ENOUGH = 10.0, 20.0  # steps in a period: fewer are refused, or taken only where asked for
_DAMPED = 0.3  # of critical damping, of rod and spring together: a hand takes energy, too
_STILL = 1e-5  # of the robot's length: amplitude below which nobody sees a rod ring
_USUAL = 1e-3  # s of a step
_FEW = 5  # steps at least in which a rod is still


@final
class Ringing:
    """Natural frequency, a drag that pulls the tip by a spring, and whether the rods have come to rest.

    The force of a step is that of the state before it. A spring alone would add energy, as its force comes a
    step late; its damper takes that and somewhat more away.
    """

    def __init__(self, simulator: Simulator) -> None:
        """`simulator` stands at rest, with dynamics, all its robots alike."""
        self.frequency = float(simulator.frequencies(1)[0, 0])
        """Lowest of small motions about this rest, nothing pulled [Hz]."""
        compliance = simulator.compliance()[0, :3, :3]
        softest = 1.0 / float(np.linalg.eigvalsh(0.5 * (compliance + compliance.T))[-1])
        angle = 2.0 * math.pi * self.frequency * simulator.dt
        stiffer = min(_STIFFER, _SLOW / angle**2)
        self.stiffness = stiffer * softest
        """Stiffness of the drag's spring [N/m]."""
        together = 2.0 * math.pi * self.frequency * math.sqrt(1.0 + stiffer)
        self.damping = self.stiffness * (simulator.dt + 2.0 * _DAMPED / together)
        """Damping of its damper [N s/m]."""
        self._farthest = FARTHEST_PULL * simulator.robots[0].length
        self._dt = simulator.dt
        self._enough = max(0.5 / self.frequency, _FEW * simulator.dt)
        self._energy = 0.5 * softest * (_STILL * simulator.robots[0].length) ** 2
        self._still = 0.0
        self._given: Mapping[str, Any] = {}

    @property
    def rests(self) -> bool:
        """For half a period, in which a rod that rings is fast once, the kinetic energy was that of an
        amplitude below 1e-5 of the length, and no input has changed."""
        return self._still >= self._enough

    def pull(self, state: State, point: Floats) -> Floats:
        """(3,) force [N], world, on the first robot's tip, dragged toward a point (3,), world [m]."""
        if state.velocity is None:  # no rods of modes
            return np.zeros(3)
        away = point - state.tip_position[0]
        distance = float(np.linalg.norm(away))
        away *= min(1.0, self._farthest / max(distance, 1e-12))
        return np.asarray(self.stiffness * away - self.damping * state.velocity[0, -1])

    def note(self, state: State, given: Mapping[str, Any]) -> None:
        """These inputs of `Simulator.step` have brought the rods to this state."""
        before, self._given = self._given, given
        same = before.keys() == given.keys() and all(np.array_equal(before[k], given[k]) for k in given)
        moves = state.kinetic_energy is not None and not (state.kinetic_energy <= self._energy).all()
        self._still = 0.0 if moves or not same else self._still + self._dt


def time_step(robot: Robot, points_per_segment: int, rest: Mapping[str, Any], dt: float | None) -> float:
    """Return a time step [s] that resolves how a robot rings about its rest under these inputs: `dt` where it
    is given; 1 ms, or less where a period has not twenty of that.

    Raises `InputError` where a period has not ten of `dt`, and where a segment has no mass.
    """
    simulator = Simulator(
        robot, 1, _USUAL if dt is None else dt, points_per_segment, threads=1, dynamics=True
    )
    state = simulator.settle(**rest)
    if not state.ok.all():
        raise InputError(f"robot {robot.name!r} finds no rest to ring about: {state.problems[0]}")
    frequency = float(simulator.frequencies(1)[0, 0])
    if dt is None:
        return min(_USUAL, _rounded(1.0 / (_ENOUGH * frequency)))
    if frequency * dt * _FEWEST > 1.0:
        raise InputError(
            f"dt is {dt:g} s, and {robot.name!r} rings at {frequency:.3g} Hz; give "
            f"{_rounded(1.0 / (_ENOUGH * frequency)):g} s or less."
        )
    return dt


def _rounded(value: float) -> float:
    """A positive number down to its first digit."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(f"{math.floor(value / power * (1.0 + 1e-9)) * power:.6g}")
