"""PyElastica on the rod of Appendix J: a Cosserat rod brought to rest by damping."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from appendix_j import BENDING, LENGTH, TORSION, Array, Peer, Rung, Solve, one_by_one

_RADIUS, _DENSITY = 4e-3, 1e3  # m, kg/m^3: they scale time, not the answer
_MOVING = ("position_collection", "director_collection", "velocity_collection", "omega_collection")


@dataclass(frozen=True)
class Relaxation:
    """How PyElastica is set."""

    elements: int
    shear: float
    """Shear and stretch stiffness [N]: as soft as the answer allows, because its waves limit the time
    step."""
    damping: float = 1.0
    """Of the first bending mode, as a fraction of the critical one."""
    step: float = 0.6
    """Time step as a fraction of the stability limit of the shear waves."""


class Stand:
    """The clamped rod in PyElastica.

    The clamp holds the first element's director, so the rod begins half an element before the wall:
    clamped where PyElastica's examples do it, at the first node, it would be half an element short, an
    error of 10 % with 14 elements.
    """

    def __init__(self, setting: Relaxation) -> None:
        ea: Any = importlib.import_module("elastica")
        system: Any = type("System", (ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping), {})
        n, h = setting.elements, LENGTH / (setting.elements - 0.5)
        area, second = math.pi * _RADIUS**2, 0.25 * math.pi * _RADIUS**4
        mass = _DENSITY * area * h
        self.omega = 3.516 / LENGTH**2 * math.sqrt(BENDING / (_DENSITY * area))
        """Of the first bending mode [rad/s]."""
        self.dt = np.float64(setting.step * math.sqrt(h * mass / setting.shear))
        start, along, normal = (
            np.array([0.0, 0.0, -0.5 * h]),
            np.array([0.0, 0.0, 1.0]),
            np.array([1.0, 0.0, 0.0]),
        )
        moduli = {"youngs_modulus": BENDING / second, "shear_modulus": TORSION / (2.0 * second)}
        straight_rod = ea.CosseratRod.straight_rod
        self.rod: Any = straight_rod(n, start, along, normal, n * h, _RADIUS, _DENSITY, **moduli)
        eye = np.eye(3)[:, :, None]
        inertia = 0.25 * h * h * mass  # its waves are then as fast as those of shear
        self.rod.shear_matrix[...] = setting.shear * eye
        self.rod.mass_second_moment_of_inertia[...] = inertia * eye
        self.rod.inv_mass_second_moment_of_inertia[...] = eye / inertia
        self._force = np.zeros(3)
        self._system = sim = system()
        sim.append(self.rod)
        clamp = {"constrained_position_idx": (0,), "constrained_director_idx": (0,)}
        sim.constrain(self.rod).using(ea.OneEndFixedBC, **clamp)
        sim.add_forcing_to(self.rod).using(ea.EndpointForces, np.zeros(3), self._force, ramp_up_time=1e-12)
        damping = {"uniform_damping_constant": 2.0 * setting.damping * self.omega, "time_step": self.dt}
        sim.dampen(self.rod).using(ea.AnalyticalLinearDamper, **damping)
        sim.finalize()
        self._stepper, self._now = ea.PositionVerlet(), np.float64(0.0)
        self._straight = [getattr(self.rod, name).copy() for name in _MOVING]

    def load(self, force: float) -> None:
        """Put the straight rod at rest under a tip force across it [N]."""
        for name, before in zip(_MOVING, self._straight, strict=True):
            getattr(self.rod, name)[...] = before
        self._force[:] = 0.0, force, 0.0
        self._now = np.float64(0.0)

    def run(self, steps: int) -> Array:
        """(2,) tip across and along after so many time steps [m]."""
        for _ in range(steps):
            self._now = self._stepper.step(self._system, self._now, self.dt)
        return np.array(self.rod.position_collection[1:, -1])


@contextmanager
def _relax(setting: Relaxation, patience: float) -> Iterator[Solve]:
    stand = Stand(setting)

    def rest(across: float) -> Array:
        stand.load(across)
        return stand.run(math.ceil(patience / (stand.omega * stand.dt)))

    yield one_by_one(rest)


PEER = Peer(
    name="PyElastica",
    modules=("elastica",),
    same="its Cosserat rod begun half an element before the wall; shear and stretch cannot be left out, so "
    "they are made stiff, the more the finer, which takes off some of the elements' own error; rotary "
    "inertia for large stable steps, the first mode critically damped.",
    also="dynamics, shear and stretch, contact between rods, muscles, many rods joined.",
    # Shear stiffer as the elements get finer. At 7 n^2 N its compliance takes off most of the elements' own
    # error, which is as much in its favour as a stiffness can be: ten times stiffer, with steps a third as
    # long, the error at 8 elements is four times as large.
    rungs=[
        Rung(f"{n} elements, {patience:g} / omega", partial(_relax, Relaxation(n, 7.0 * n * n), patience))
        for n, patience in ((4, 8.0), (8, 11.0), (14, 13.0), (24, 15.0))
    ],
)
