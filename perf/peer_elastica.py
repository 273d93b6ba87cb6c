"""PyElastica on the rod of Appendix J: a Cosserat rod brought to rest by damping."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np

from appendix_j import BENDING, LENGTH, TORSION, Array, Peer, Rung, Solve, one_by_one

_RADIUS, _DENSITY = 4e-3, 1e3  # m, kg/m^3: they scale time, not the answer
# Shear and stretch stiffness an element squared [N]: as soft as the answer allows, because its waves limit
# the step. At this value its compliance takes off most of the elements' own error, which is as much in its
# favour as a stiffness can be: ten times stiffer, with steps a third as long, the error at 8 elements is four
# times as large.
_SHEAR = 7.0
_STEP = 0.6  # of the stability limit of the shear waves
_MOVING = ("position_collection", "director_collection", "velocity_collection", "omega_collection")


@contextmanager
def _relax(n: int, patience: float) -> Iterator[Solve]:
    """`n` elements for `patience` over the first bending mode's frequency.

    The clamp holds the first element's director, so the rod begins half an element before the wall: clamped
    where PyElastica's examples do it, at the first node, it would be half an element short, an error of 10 %
    with 14 elements.
    """
    ea: Any = importlib.import_module("elastica")
    system: Any = type("System", (ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping), {})()
    h, shear, area, second = (
        LENGTH / (n - 0.5),
        _SHEAR * n * n,
        math.pi * _RADIUS**2,
        0.25 * math.pi * _RADIUS**4,
    )
    mass = _DENSITY * area * h
    omega = 3.516 / LENGTH**2 * math.sqrt(BENDING / (_DENSITY * area))
    dt = np.float64(_STEP * math.sqrt(h * mass / shear))
    start, along, normal = (
        np.array([0.0, 0.0, -0.5 * h]),
        np.array([0.0, 0.0, 1.0]),
        np.array([1.0, 0.0, 0.0]),
    )
    moduli = {"youngs_modulus": BENDING / second, "shear_modulus": TORSION / (2.0 * second)}
    rod = ea.CosseratRod.straight_rod(n, start, along, normal, n * h, _RADIUS, _DENSITY, **moduli)
    eye = np.eye(3)[:, :, None]
    inertia = 0.25 * h * h * mass  # its waves are then as fast as those of shear
    rod.shear_matrix[...] = shear * eye
    rod.mass_second_moment_of_inertia[...] = inertia * eye
    rod.inv_mass_second_moment_of_inertia[...] = eye / inertia
    force = np.zeros(3)
    system.append(rod)
    clamp = {"constrained_position_idx": (0,), "constrained_director_idx": (0,)}
    system.constrain(rod).using(ea.OneEndFixedBC, **clamp)
    system.add_forcing_to(rod).using(ea.EndpointForces, np.zeros(3), force, ramp_up_time=1e-12)
    damping = {"uniform_damping_constant": 2.0 * omega, "time_step": dt}  # critical
    system.dampen(rod).using(ea.AnalyticalLinearDamper, **damping)
    system.finalize()
    stepper, straight = ea.PositionVerlet(), [getattr(rod, name).copy() for name in _MOVING]

    def rest(across: float) -> Array:
        for name, before in zip(_MOVING, straight, strict=True):
            getattr(rod, name)[...] = before
        force[:] = 0.0, across, 0.0
        now = np.float64(0.0)
        for _ in range(math.ceil(patience / (omega * dt))):
            now = stepper.step(system, now, dt)
        return np.array(rod.position_collection[1:, -1])

    yield one_by_one(rest)


PEER = Peer(
    name="PyElastica",
    modules=("elastica",),
    same="its Cosserat rod begun half an element before the wall; shear and stretch cannot be left out, so "
    "they are made stiff, the more the finer, which takes off some of the elements' own error; rotary "
    "inertia for large stable steps, the first mode critically damped.",
    also="dynamics, shear and stretch, contact between rods, muscles, many rods joined.",
    rungs=[
        Rung(f"{n} elements, {patience:g} / omega", partial(_relax, n, patience))
        for n, patience in ((4, 8.0), (8, 11.0), (14, 13.0), (24, 15.0))
    ],
)
