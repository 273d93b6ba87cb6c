"""fastrod on the rod of Appendix J: `settle` from the straight rod, and single passes along a path of
loads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np

import appendix_j
from appendix_j import Array
from fastrod import Simulator
from peer import Peer, Rung, Solve


def _forces(across: Array) -> Array:
    """(n, 3) world [N]."""
    return np.stack([np.zeros_like(across), across, np.zeros_like(across)], axis=-1)


def _simulator(points: int, n_robots: int) -> Simulator:
    return Simulator(appendix_j.robot(), n_robots, points_per_segment=points, outputs="tip", threads=1)


@contextmanager
def _settle(points: int, tolerance: float) -> Iterator[Solve]:
    """Each load from the cold guess."""
    sim = _simulator(points, 1)

    def solve(force: Array) -> Array:
        tips = np.empty((len(force), 2))
        for i, load in enumerate(_forces(force)):
            sim.reset()
            tips[i] = sim.settle(tip_force=load, tolerance=tolerance).tip_position[0, 1:]
        return tips

    yield solve


@contextmanager
def _together(points: int, tolerance: float) -> Iterator[Solve]:
    sims: dict[int, Simulator] = {}

    def solve(force: Array) -> Array:
        sim = sims.setdefault(len(force), _simulator(points, len(force)))
        sim.reset()
        return np.array(sim.settle(tip_force=_forces(force), tolerance=tolerance).tip_position[:, 1:])

    yield solve


@contextmanager
def _step(points: int, passes: int) -> Iterator[Solve]:
    """From load to load in `passes` equal parts, one pass each, so that the answer lags."""
    sim = _simulator(points, 1)

    def solve(force: Array) -> Array:
        sim.reset()
        tips, before = np.empty((len(force), 2)), 0.0
        for i, load in enumerate(force):
            for part in range(1, passes + 1):
                now = before + (load - before) * part / passes
                state = sim.step(tip_force=(0.0, now, 0.0))
            tips[i], before = state.tip_position[0, 1:], load
        return tips

    yield solve


def _settle_rungs() -> Sequence[Rung]:
    settings = (
        (2, 1e-9),
        (3, 1e-9),
        (4, 1e-9),
        (6, 1e-9),
        (10, 1e-9),
        (20, 1e-9),
        (40, 1e-10),
        (80, 1e-11),
        (160, 1e-12),
    )
    return [
        Rung(f"{n} points, to {to:.0e} m", partial(_settle, n, to), partial(_together, n, to))
        for n, to in settings
    ]


def _step_rungs() -> Sequence[Rung]:
    settings = ((2, 1), (4, 1), (5, 2), (8, 4), (16, 8))
    return [Rung(f"{n} points, {m} a load", partial(_step, n, m)) for n, m in settings]


SETTLE = Peer(
    name="fastrod, settle",
    modules=("fastrod",),
    packages=("fastrod", "numba"),
    same="the rod in space, each load from the cold guess until every boundary residual is below the "
    "tolerance (1e-9 m is the default).",
    also="it is what the others are compared with.",
    rungs=_settle_rungs,
    family="fastrod",
)
STEP = Peer(
    name="fastrod, step",
    modules=("fastrod",),
    packages=("fastrod", "numba"),
    same="the same rod along the path of loads, 0.05 N between two: each begins where the one before ended, "
    "and its passes lag.",
    also="nothing that settle does not.",
    rungs=_step_rungs,
    family="fastrod",
)
