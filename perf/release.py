"""A clamped rod that is pulled aside and let go, nothing jumping; and fastrod on it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, partial

import numpy as np

from appendix_j import Peer, Rung, Solve
from cases import Array
from fastrod import Modal, Modes, Robot, Segment, Simulator

LENGTH, BENDING, DENSITY, RADIUS = 0.1, 0.0022, 0.1, 2e-3
"""m, EI in N m^2, kg/m, and the radius of the round section [m], which gives the rotary inertia."""
TORSION = 0.8 * BENDING  # GJ: not loaded
FORCE = 0.68  # N across the tip, at its most: some 62 mm of deflection
PULL, END = 0.2, 0.5  # s: the force is FORCE sin^2(pi t / PULL), then zero; the rod swings on
EVERY = 5e-3  # s between two tips that are compared
TIMES: Array = EVERY * np.arange(1, round(END / EVERY) + 1)


def pull(t: float) -> float:
    """The tip force as a fraction of its most: it and its slope begin and end at zero."""
    return math.sin(math.pi * t / PULL) ** 2 if t < PULL else 0.0


def robot() -> Robot:
    """Inextensible, unshearable, without damping and weight."""
    segment = Segment(
        length=LENGTH,
        bending_stiffness=(BENDING, BENDING),
        torsional_stiffness=TORSION,
        body_radius=RADIUS,
        line_density=DENSITY,
        mode="passive",
    )
    return Robot(name="release", segments=(segment,), gravity=(0.0, 0.0, 0.0))


@contextmanager
def _step(modes: Modes, dt: float) -> Iterator[Solve]:
    """One Newton step a time step, generalized-alpha; any number of rods in one call."""
    every, sims = round(EVERY / dt), dict[int, tuple[Simulator, object]]()

    def solve(force: Array) -> Array:
        n = len(force)
        if n not in sims:
            how = Modal(dynamics=True, rho=0.9, modes=modes)
            options = {"solver": how, "outputs": "tip", "threads": 1}
            sim = Simulator(robot(), n, EVERY / every, 2, **options)  # type: ignore[arg-type]
            sim.settle()
            sims[n] = sim, sim.snapshot()
        sim, rest = sims[n]
        sim.restore(rest)  # type: ignore[arg-type]
        across, tips = np.zeros((n, 3)), np.empty((n, len(TIMES), 2))
        for k in range(1, every * len(TIMES) + 1):
            across[:, 0] = force * pull(k * sim.dt)
            state = sim.step(tip_force=across)
            if k % every == 0:
                tips[:, k // every - 1] = state.tip_position[:, ::2]
        return tips

    yield solve


@cache
def reference(forces: tuple[float, ...], dt: float = 5e-5) -> Array:
    """(n, n_times, 2) tips across and along [m]: many modes, small steps, extrapolated."""
    found = []
    for step in (2.0 * dt, dt):
        with _step(Modes(7, 1), step) as solve:
            found.append(solve(np.array(forces)))
    return found[1] + (found[1] - found[0]) / 3.0


_SETTINGS = ((3, 5.0), (3, 2.5), (3, 1.0), (4, 0.5), (4, 0.25), (5, 0.1))  # modes, and dt in ms
PEER = Peer(
    name="fastrod, in motion",
    modules=("fastrod", "numba"),
    same="the rod in space by modes of curvature, generalized-alpha (rho 0.9), one Newton step a time step.",
    also="it is what the others are compared with.",
    rungs=[
        Rung(f"{n} modes, dt {ms:g} ms", *2 * (partial(_step, Modes(n, 1), 1e-3 * ms),))
        for n, ms in _SETTINGS
    ],
)
