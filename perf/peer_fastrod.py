"""fastrod on the rod of Appendix J: `settle` from the straight rod, and single passes from load to load."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np

import appendix_j
from appendix_j import Array, Peer, Rung, Solve, one_by_one
from fastrod import Simulator


def _simulator(points: int, n_robots: int) -> Simulator:
    return Simulator(appendix_j.robot(), n_robots, points_per_segment=points, outputs="tip", threads=1)


@contextmanager
def _settle(points: int, tolerance: float) -> Iterator[Solve]:
    """Each load from the cold guess."""
    sim = _simulator(points, 1)

    def rest(across: float) -> Array:
        sim.reset()
        return np.array(sim.settle(tip_force=(0.0, across, 0.0), tolerance=tolerance).tip_position[0, 1:])

    yield one_by_one(rest)


@contextmanager
def _together(points: int, tolerance: float) -> Iterator[Solve]:
    sims: dict[int, Simulator] = {}

    def solve(force: Array) -> Array:
        sim = sims.setdefault(len(force), _simulator(points, len(force)))
        sim.reset()
        forces = np.stack([0.0 * force, force, 0.0 * force], axis=-1)
        return np.array(sim.settle(tip_force=forces, tolerance=tolerance).tip_position[:, 1:])

    yield solve


@contextmanager
def _step(points: int, passes: int) -> Iterator[Solve]:
    """Go from load to load in `passes` equal parts, one pass each, so that the answer lags."""
    sim = _simulator(points, 1)

    def solve(force: Array) -> Array:
        sim.reset()
        tips = []
        for before, load in zip([0.0, *force[:-1]], force, strict=True):
            for k in range(1, passes + 1):
                state = sim.step(tip_force=(0.0, before + (load - before) * k / passes, 0.0))
            tips.append(state.tip_position[0, 1:].copy())
        return np.array(tips)

    yield solve


_FINE = ((40, 1e-10), (80, 1e-11), (160, 1e-12))
SETTLE = Peer(
    name="fastrod, settle",
    modules=("fastrod", "numba"),
    same="the rod in space, each load from the cold guess until every boundary residual is below the "
    "tolerance (1e-9 m is the default).",
    also="it is what the others are compared with.",
    rungs=[
        Rung(f"{n} points, to {to:.0e} m", partial(_settle, n, to), partial(_together, n, to))
        for n, to in (*((n, 1e-9) for n in (2, 3, 4, 6, 10, 20)), *_FINE)
    ],
)
STEP = Peer(
    name="fastrod, step",
    modules=("fastrod", "numba"),
    same="the same rod along the path of loads, 0.05 N between two: each begins where the one before ended, "
    "and its passes lag.",
    also="nothing that settle does not.",
    rungs=[
        Rung(f"{n} points, {m} a load", partial(_step, n, m))
        for n, m in ((2, 1), (4, 1), (5, 2), (8, 4), (16, 8))
    ],
)
