"""A passive cantilever (the paper's Appendix J) by PyElastica's dynamic relaxation, beside one `settle` of fastrod."""

from __future__ import annotations

import importlib.util
import math
import time
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import cases
from fastrod import Robot, Simulator, load_robot
from report import Column, Row, Section, best, note_progress

FORCE = 0.2
"""Tip force across the rod [N]."""
WITHIN = 1e-3
"""Allowed tip error as a part of the tip's deflection."""
_RADIUS, _DENSITY = 4e-3, 1e3  # m, kg/m^3: they scale time, not the answer
_CHECK = 20  # steps between two looks at the tip


@dataclass(frozen=True)
class Relaxation:
    """How PyElastica is set."""

    elements: int
    shear: float
    """Shear and stretch stiffness [N]: as soft as the answer allows, because its waves limit the time step."""
    damping: float
    """Of the first bending mode, as a part of the critical one."""
    step: float = 0.6
    """Time step as a part of the stability limit of the shear waves."""


_TRIED = [Relaxation(n, shear, damping) for n, shear in ((12, 1000.0), (14, 1500.0), (16, 2000.0)) for damping in (0.8, 0.9, 1.0)]


def cantilever() -> Robot:
    """The prototype's rod without tendons."""
    robot = load_robot("prototype")
    return replace(robot, segments=(replace(robot.segments[0], tendons=(), mode="passive"),))


def answer() -> NDArray[np.float64]:
    """(2,) tip across and along the straight rod under `FORCE` [m]: the truth file, or the elastica."""
    file = cases.TRUTH / "appJ_truth.csv"
    if file.exists():
        table = np.genfromtxt(file, delimiter=",", names=True)
        row = table[np.argmin(np.abs(table["Fy_N"] - FORCE))]
        return np.array([row["tip_y_m"], row["tip_z_m"]])
    from scipy.integrate import solve_ivp
    from scipy.optimize import brentq

    (segment,) = cantilever().segments
    stiffness, length = segment.bending_stiffness[0], segment.length

    def tip(moment: float) -> NDArray[np.float64]:
        """Angle, its slope, across, along at the tip, for a base moment [N m]: EI angle'' = -F cos angle."""
        found: Any = solve_ivp(
            lambda s, y: (y[1], -FORCE / stiffness * math.cos(y[0]), math.sin(y[0]), math.cos(y[0])),  # noqa: ARG005
            (0.0, length),
            (0.0, moment / stiffness, 0.0, 0.0),
            rtol=1e-11,
            atol=1e-13,
        )
        return np.asarray(found.y[:, -1])

    base: Any = brentq(lambda moment: float(tip(moment)[1]), 0.0, 1.1 * FORCE * length, xtol=1e-14)
    return tip(float(base))[2:]


def relax(setting: Relaxation, goal: NDArray[np.float64], patience: float = 12.0) -> tuple[float, int, float]:
    """Wall time [s] and steps until the tip has come within `WITHIN` for good, and its error in the end [m].

    The clamp of PyElastica holds the first element's director, so the rod begins half an element before the wall: clamped
    where its examples do it, at the first node, it would be half an element short, an error of 10 % with 14 elements.
    `patience` is the simulated time in units of the first mode's 1/omega; time is infinite if the tip does not stay.
    """
    ea: Any = importlib.import_module("elastica")
    bench: Any = type("Bench", (ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping), {})
    (segment,) = cantilever().segments
    bending, torsion = segment.bending_stiffness[0], segment.torsional_stiffness
    n, h = setting.elements, segment.length / (setting.elements - 0.5)
    area, second = math.pi * _RADIUS**2, 0.25 * math.pi * _RADIUS**4
    mass = _DENSITY * area * h
    omega = 3.516 / segment.length**2 * math.sqrt(bending / (_DENSITY * area))
    dt = np.float64(setting.step * math.sqrt(h * mass / setting.shear))
    sim = bench()
    rod: Any = ea.CosseratRod.straight_rod(
        n, np.array([0.0, 0.0, -0.5 * h]), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), n * h, _RADIUS, _DENSITY,
        youngs_modulus=bending / second, shear_modulus=torsion / (2.0 * second),
    )  # fmt: skip
    eye = np.eye(3)[:, :, None]
    inertia = 0.25 * h * h * mass  # its waves are then as fast as those of shear
    rod.shear_matrix[...] = setting.shear * eye
    rod.mass_second_moment_of_inertia[...] = inertia * eye
    rod.inv_mass_second_moment_of_inertia[...] = eye / inertia
    sim.append(rod)
    sim.constrain(rod).using(ea.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,))
    sim.add_forcing_to(rod).using(ea.EndpointForces, np.zeros(3), np.array([0.0, FORCE, 0.0]), ramp_up_time=1e-12)
    sim.dampen(rod).using(ea.AnalyticalLinearDamper, uniform_damping_constant=2.0 * setting.damping * omega, time_step=dt)
    sim.finalize()

    stepper, now, steps = ea.PositionVerlet(), np.float64(0.0), 0
    allowed = WITHIN * _deflection(goal)
    reached, error = (math.inf, 0), math.inf
    start = time.perf_counter()
    while now * omega < patience and not math.isnan(error):
        for _ in range(_CHECK):
            now = stepper.step(sim, now, dt)
        steps += _CHECK
        error = float(np.linalg.norm(rod.position_collection[1:, -1] - goal))
        if not error <= allowed:
            reached = (math.inf, 0)
        elif not reached[1]:
            reached = (time.perf_counter() - start, steps)
    return *reached, error


def _deflection(goal: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(goal - [0.0, cantilever().length]))


def _fastrod(goal: NDArray[np.float64]) -> Row:
    """One robot from the cold guess: with the fewest steps that `cases.TIP_ERROR` allows."""
    tip = np.array([0.0, *goal])
    for points in range(2, 41):
        sim = Simulator(cantilever(), 1, points_per_segment=points, outputs="tip", threads=1)
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
    goal = answer()
    rows = [_fastrod(goal)]
    notes = [
        f"Passive rod of 0.07 m, tip force {FORCE} N across it; until the tip is within {WITHIN:.1%} of its deflection, "
        f"{WITHIN * _deflection(goal):.1e} m. One rod, 1 thread, wall time, warm (PyElastica's kernels compiled). Target: none.",
    ]
    if importlib.util.find_spec("elastica") is None:
        notes.append("PyElastica is not installed, so its row is left out: pip install fastrod[peers].")
    else:
        rows.append(_elastica(goal, quick, rows[0]))
        notes.append(
            f"PyElastica: the fastest of {len(_TRIED)} settings (12 to 16 elements, damping 0.8 to 1 of critical), shear stiffness and "
            "rotary inertia chosen for large stable steps, and the rod begun half an element before the wall for second order."
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


def _elastica(goal: NDArray[np.float64], quick: bool, fastrod: Row) -> Row:
    relax(_TRIED[0], goal, patience=0.1)  # compiles
    tried = _TRIED[4:5] if quick else _TRIED
    runs = [(relax(setting, goal), setting) for setting in tried]
    fastest = min(runs, key=lambda run: run[0][0])[1]
    runs += [(relax(fastest, goal), fastest) for _ in range(1 if quick else 3)]
    (used, steps, error), setting = min((run for run in runs if run[1] is fastest), key=lambda run: run[0][0])
    own = fastrod["ms"]
    assert isinstance(own, float)
    text = f"{setting.elements} elements, damping {setting.damping:g} of critical, shear {setting.shear:g} N"
    return {"solver": "PyElastica", "setting": text, "ms": 1e3 * used, "steps": steps, "error_m": error, "ratio": 1e3 * used / own}
