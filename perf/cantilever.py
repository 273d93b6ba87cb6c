"""A passive cantilever (the paper's Appendix J) by PyElastica's dynamic relaxation, beside one `settle` of
fastrod.

`fastrod bench peers` has the other peers, and error against time.
"""

from __future__ import annotations

import importlib.util
import math
import time
from functools import partial

import numpy as np

import appendix_j
import cases
from appendix_j import Array
from fastrod import Simulator
from peer_elastica import Relaxation, Stand
from report import Column, Row, Section, best, note_progress

FORCE = 0.2
"""Tip force across the rod [N]."""
WITHIN = 1e-3
"""Allowed tip error as a part of the tip's deflection."""
_CHECK = 20  # steps between two looks at the tip
_TRIED = [
    Relaxation(n, shear, damping)
    for n, shear in ((12, 1000.0), (14, 1500.0), (16, 2000.0))
    for damping in (0.8, 0.9, 1.0)
]


def relax(setting: Relaxation, goal: Array, patience: float = 12.0) -> tuple[float, int, float]:
    """Wall time [s] and steps until the tip has come within `WITHIN` for good, and its error in the end [m].

    `patience` is the simulated time in units of the first mode's 1/omega; time is infinite if the tip does
    not stay.
    """
    stand = Stand(setting)
    stand.load(FORCE)
    allowed = WITHIN * _deflection(goal)
    reached, error, steps = (math.inf, 0), math.inf, 0
    start = time.perf_counter()
    while steps * stand.dt * stand.omega < patience and not math.isnan(error):
        error = float(np.linalg.norm(stand.run(_CHECK) - goal))
        steps += _CHECK
        if not error <= allowed:
            reached = (math.inf, 0)
        elif not reached[1]:
            reached = (time.perf_counter() - start, steps)
    return *reached, error


def _deflection(goal: Array) -> float:
    return float(np.linalg.norm(goal - [0.0, appendix_j.length()]))


def _fastrod(goal: Array) -> Row:
    """One robot from the cold guess: with the fewest steps that `cases.TIP_ERROR` allows."""
    tip = np.array([0.0, *goal])
    for points in range(2, 41):
        sim = Simulator(appendix_j.robot(), 1, points_per_segment=points, outputs="tip", threads=1)
        run = partial(sim.settle, tip_force=(0.0, FORCE, 0.0))
        error = float(np.linalg.norm(run().tip_position[0] - tip))
        if error <= cases.TIP_ERROR:
            break

    def cold() -> None:
        sim.reset()
        run()

    used = best(cold, 50)
    sim.reset()
    passes = int(run().passes[0])
    return {
        "solver": "fastrod",
        "setting": f"{points} points, settle to 1e-9 m from the cold guess",
        "ms": 1e3 * used,
        "steps": passes,
        "error_m": error,
    }


def section(quick: bool) -> Section:
    note_progress("cantilever")
    goal = appendix_j.tips(np.array([FORCE]))[0]
    rows = [_fastrod(goal)]
    notes = [
        f"Passive rod of 0.07 m, tip force {FORCE} N across it; until the tip is within {WITHIN:.1%} of its "
        "deflection, "
        f"{WITHIN * _deflection(goal):.1e} m. One rod, 1 thread, wall time, warm (PyElastica's kernels "
        "compiled). Target: none."
    ]
    if importlib.util.find_spec("elastica") is None:
        notes.append("PyElastica is not installed, so its row is left out: pip install fastrod[peers].")
    else:
        rows.append(_elastica(goal, quick, rows[0]))
        notes.append(
            f"PyElastica: the fastest of {len(_TRIED)} settings (12 to 16 elements, damping 0.8 to 1 of "
            "critical), shear stiffness and "
            "rotary inertia chosen for large stable steps, and the rod begun half an element before the "
            "wall for second order."
        )
    columns = [
        Column("solver", "solver"),
        Column("setting", "setting"),
        Column("ms", "ms\n1 thread", ".2f"),
        Column("steps", "passes or\ntime steps", "d"),
        Column("error_m", "tip error\nin the end [m]", ".1e"),
        Column("ratio", "ratio to\nfastrod", ",.0f"),
    ]
    return Section("cantilever", "A passive cantilever (Appendix J) beside PyElastica", columns, rows, notes)


def _elastica(goal: Array, quick: bool, fastrod: Row) -> Row:
    relax(_TRIED[0], goal, patience=0.1)  # compiles
    tried = _TRIED[4:5] if quick else _TRIED
    runs = [(relax(setting, goal), setting) for setting in tried]
    fastest = min(runs, key=lambda run: run[0][0])[1]
    runs += [(relax(fastest, goal), fastest) for _ in range(1 if quick else 3)]
    (used, steps, error), setting = min((run for run in runs if run[1] is fastest), key=lambda run: run[0][0])
    own = fastrod["ms"]
    assert isinstance(own, float)
    text = f"{setting.elements} elements, damping {setting.damping:g} of critical, shear {setting.shear:g} N"
    return {
        "solver": "PyElastica",
        "setting": text,
        "ms": 1e3 * used,
        "steps": steps,
        "error_m": error,
        "ratio": 1e3 * used / own,
    }
