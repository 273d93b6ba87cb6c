"""PyElastica on the rod that is pulled aside and let go."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np

import release
from appendix_j import Array, Peer, Rung, Solve
from release import BENDING, DENSITY, LENGTH, RADIUS, TIMES, TORSION

_STEP = 0.9  # of the stability limit
_MOVING = ("position_collection", "director_collection", "velocity_collection", "omega_collection")


@contextmanager
def _swing(n: int, stiff: float) -> Iterator[Solve]:
    """`n` elements, shear and stretch so many times as stiff as the round section is (4/3 G A with G = E/3).

    As in `peer_elastica` the rod begins half an element before the wall.
    """
    ea: Any = importlib.import_module("elastica")
    names = ea.BaseSystemCollection, ea.Constraints, ea.Forcing
    system: Any = type("System", names, {})()
    h, area, second = LENGTH / (n - 0.5), math.pi * RADIUS**2, 0.25 * math.pi * RADIUS**4
    young, density = BENDING / second, DENSITY / area
    start, along, normal = (
        np.array([0.0, 0.0, -0.5 * h]),
        np.array([0.0, 0.0, 1.0]),
        np.array([1.0, 0.0, 0.0]),
    )
    moduli = {"youngs_modulus": young, "shear_modulus": TORSION / (2.0 * second)}
    rod = ea.CosseratRod.straight_rod(n, start, along, normal, n * h, RADIUS, density, **moduli)
    axial = stiff * young * area
    shear = axial * 0.9 / 3.0
    rod.shear_matrix[...] = np.diag([shear, shear, axial])[:, :, None]
    # of shear, in which sections rotate and nodes slide, beside bending; and of stretch
    rotary = 0.25 * DENSITY * RADIUS**2
    fast = math.sqrt(shear * (1.0 / rotary + 4.0 / (DENSITY * h * h)) + 4.0 * BENDING / (rotary * h * h))
    fast = max(fast, math.sqrt(4.0 * axial / (DENSITY * h * h)))
    every = math.ceil(release.EVERY / (_STEP * 2.0 / fast))
    dt = np.float64(release.EVERY / every)

    class Pull(ea.NoForces):  # type: ignore[misc]
        """The tip force, over time."""

        most = 0.0

        def apply_forces(self, system: Any, time: Any = 0.0) -> None:
            system.external_forces[0, -1] += Pull.most * release.pull(time)

    system.append(rod)
    clamp = {"constrained_position_idx": (0,), "constrained_director_idx": (0,)}
    system.constrain(rod).using(ea.OneEndFixedBC, **clamp)
    system.add_forcing_to(rod).using(Pull)
    system.finalize()
    stepper, straight = ea.PositionVerlet(), [getattr(rod, name).copy() for name in _MOVING]

    def swing(force: float) -> Array:
        for name, before in zip(_MOVING, straight, strict=True):
            getattr(rod, name)[...] = before
        Pull.most, now, tips = force, np.float64(0.0), []
        for _ in TIMES:
            for _ in range(every):
                now = stepper.step(system, now, dt)
            tips.append(rod.position_collection[::2, -1].copy())
        return np.array(tips)

    yield lambda force: np.array([swing(most) for most in force.tolist()])


PEER = Peer(
    name="PyElastica",
    modules=("elastica",),
    same="its Cosserat rod begun half an element before the wall, without damping, position Verlet at 0.9 of "
    "the stable step; shear and stretch cannot be left out, so they are as stiff as the round section's, or "
    "some times stiffer.",
    also="shear and stretch, contact between rods, muscles, many rods joined.",
    rungs=[
        Rung(f"{n} elements, shear x {stiff:g}", partial(_swing, n, stiff))
        for n, stiff in ((5, 0.5), (8, 0.5), (12, 0.5), (12, 1.0), (16, 2.0), (24, 4.0))
    ],
)
