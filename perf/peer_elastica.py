"""PyElastica: a Cosserat rod brought to rest by damping (Appendix J), and one that is pulled aside and let
go."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np

import appendix_j
import release
from appendix_j import Array, Peer, Rung, Solve, one_by_one

# Shear and stretch stiffness an element squared [N]: as soft as the answer allows, because its waves limit
# the step. At this value its compliance takes off most of the elements' own error, which is as much in its
# favour as a stiffness can be: ten times stiffer, with steps a third as long, the error at 8 elements is four
# times as large.
_SHEAR = 7.0
_AT_REST, _IN_MOTION = 0.6, 0.9  # of the stability limit
_ALSO = "shear and stretch, contact between rods, muscles, many rods joined."
_MOVING = ("position_collection", "director_collection", "velocity_collection", "omega_collection")


def _clamped(system: Any, n: int, of: Any, radius: float, density: float) -> Any:
    """A rod of `n` elements with the length, EI and GJ of the module `of`, in a system of PyElastica.

    The clamp holds the first element's director, so the rod begins half an element before the wall: clamped
    where PyElastica's examples do it, at the first node, it would be half an element short, an error of 10 %
    with 14 elements.
    """
    ea: Any = importlib.import_module("elastica")
    h, second = of.LENGTH / (n - 0.5), 0.25 * math.pi * radius**4
    start = np.array([0.0, 0.0, -0.5 * h])
    along = np.array([0.0, 0.0, 1.0])
    normal = np.array([1.0, 0.0, 0.0])
    moduli = {"youngs_modulus": of.BENDING / second, "shear_modulus": of.TORSION / (2.0 * second)}
    rod = ea.CosseratRod.straight_rod(n, start, along, normal, n * h, radius, density, **moduli)
    system.append(rod)
    clamp = {"constrained_position_idx": (0,), "constrained_director_idx": (0,)}
    system.constrain(rod).using(ea.OneEndFixedBC, **clamp)
    return rod


def _restart(rod: Any) -> Callable[[], None]:
    """Return what puts the rod back to where it is now."""
    straight = [getattr(rod, name).copy() for name in _MOVING]

    def restart() -> None:
        for name, before in zip(_MOVING, straight, strict=True):
            getattr(rod, name)[...] = before

    return restart


@contextmanager
def _relax(n: int, patience: float) -> Iterator[Solve]:
    """`n` elements for `patience` over the first bending mode's frequency."""
    ea: Any = importlib.import_module("elastica")
    system: Any = type("System", (ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping), {})()
    radius, density, h = 4e-3, 1e3, appendix_j.LENGTH / (n - 0.5)  # they scale time, not the answer
    area, shear = math.pi * radius**2, _SHEAR * n * n
    mass = density * area * h
    omega = 3.516 / appendix_j.LENGTH**2 * math.sqrt(appendix_j.BENDING / (density * area))
    dt = np.float64(_AT_REST * math.sqrt(h * mass / shear))
    rod = _clamped(system, n, appendix_j, radius, density)
    eye = np.eye(3)[:, :, None]
    inertia = 0.25 * h * h * mass  # its waves are then as fast as those of shear
    rod.shear_matrix[...] = shear * eye
    rod.mass_second_moment_of_inertia[...] = inertia * eye
    rod.inv_mass_second_moment_of_inertia[...] = eye / inertia
    force = np.zeros(3)
    system.add_forcing_to(rod).using(ea.EndpointForces, np.zeros(3), force, ramp_up_time=1e-12)
    damping = {"uniform_damping_constant": 2.0 * omega, "time_step": dt}  # critical
    system.dampen(rod).using(ea.AnalyticalLinearDamper, **damping)
    system.finalize()
    stepper, restart = ea.PositionVerlet(), _restart(rod)

    def rest(across: float) -> Array:
        restart()
        force[:] = 0.0, across, 0.0
        now = np.float64(0.0)
        for _ in range(math.ceil(patience / (omega * dt))):
            now = stepper.step(system, now, dt)
        return np.array(rod.position_collection[1:, -1])

    yield one_by_one(rest)


@contextmanager
def _swing(n: int, stiff: float) -> Iterator[Solve]:
    """`n` elements, shear and stretch so many times as stiff as the round section is (4/3 G A, G = E/3)."""
    ea: Any = importlib.import_module("elastica")
    system: Any = type("System", (ea.BaseSystemCollection, ea.Constraints, ea.Forcing), {})()
    h, area = release.LENGTH / (n - 0.5), math.pi * release.RADIUS**2
    rod = _clamped(system, n, release, release.RADIUS, release.DENSITY / area)
    axial = stiff * release.BENDING / (0.25 * release.RADIUS**2)
    shear = axial * 0.9 / 3.0
    rod.shear_matrix[...] = np.diag([shear, shear, axial])[:, :, None]
    # of shear, in which sections rotate and nodes slide, beside bending; and of stretch
    rotary, lump = 0.25 * release.DENSITY * release.RADIUS**2, release.DENSITY * h * h
    fast = math.sqrt(shear * (1.0 / rotary + 4.0 / lump) + 4.0 * release.BENDING / (rotary * h * h))
    fast = max(fast, math.sqrt(4.0 * axial / lump))
    every = math.ceil(release.EVERY / (_IN_MOTION * 2.0 / fast))
    dt = np.float64(release.EVERY / every)

    class Pull(ea.NoForces):  # type: ignore[misc]
        """The tip force, over time."""

        most = 0.0

        def apply_forces(self, system: Any, time: Any = 0.0) -> None:
            system.external_forces[0, -1] += Pull.most * release.pull(time)

    system.add_forcing_to(rod).using(Pull)
    system.finalize()
    stepper, restart = ea.PositionVerlet(), _restart(rod)

    def swing(force: float) -> Array:
        restart()
        Pull.most, now, tips = force, np.float64(0.0), []
        for _ in release.TIMES:
            for _ in range(every):
                now = stepper.step(system, now, dt)
            tips.append(rod.position_collection[::2, -1].copy())
        return np.array(tips)

    yield lambda force: np.array([swing(most) for most in force.tolist()])


PEER = Peer(
    name="PyElastica",
    modules=("elastica",),
    same="its Cosserat rod begun half an element before the wall; shear and stretch cannot be left out, so "
    "they are made stiff, the more the finer, which takes off some of the elements' own error; rotary "
    "inertia for large stable steps, the first mode critically damped.",
    also=f"dynamics, {_ALSO}",
    rungs=[
        Rung(f"{n} elements, {patience:g} / omega", partial(_relax, n, patience))
        for n, patience in ((4, 8.0), (8, 11.0), (14, 13.0), (24, 15.0))
    ],
)
RELEASED = Peer(
    name="PyElastica",
    modules=("elastica",),
    same="its Cosserat rod begun half an element before the wall, without damping, position Verlet at 0.9 of "
    "the stable step; shear and stretch cannot be left out, so they are as stiff as the round section's, or "
    "some times stiffer.",
    also=_ALSO,
    rungs=[
        Rung(f"{n} elements, shear x {stiff:g}", partial(_swing, n, stiff))
        for n, stiff in ((5, 0.5), (8, 0.5), (12, 0.5), (12, 1.0), (16, 2.0), (24, 4.0))
    ],
)
