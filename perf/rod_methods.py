"""One forward pass beside the ODE methods of scipy at one accuracy; a passive cantilever beside
PyElastica."""

from __future__ import annotations

import importlib.util
import math
import time
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import appendix_j
import cases
from cases import Array, Case, TipError
from fastrod import Robot, Simulator, State
from peer_elastica import Relaxation, Stand
from report import Measurement, Row, Section, best, note_progress, table
from scipy_rod import Shooter

_METHODS = ("RK45", "RK23", "LSODA", "odeint", "Radau", "BDF")
FORCE = 0.2
"""Tip force across the cantilever [N]."""
WITHIN = 1e-3
"""Allowed tip error as a fraction of the tip's deflection."""
_CHECK = 20  # time steps between two readings of the tip
_TRIED = [
    Relaxation(n, shear, damping)
    for n, shear in ((12, 1000.0), (14, 1500.0), (16, 2000.0))
    for damping in (0.8, 0.9, 1.0)
]


@dataclass(frozen=True)
class Problem:
    """Forward passes from known base curvatures."""

    case: Case
    base: Array
    """(n, 2) u_x, u_y at the base [1/m]."""
    truth: State


def _on_one_thread(robot: Robot, n: int, points: int) -> Simulator:
    return Simulator(robot, n, points_per_segment=points, outputs="tip", threads=1)


def _row(method: str, how: str, used: float, fastrod: float, error: TipError, slopes: float) -> Row:
    return {
        "method": method,
        "how": how,
        "us": 1e6 * used,
        "error_max_m": error.largest,
        "error_median_m": error.median,
        "target": cases.TIP_ERROR,
        "slopes": slopes,
        "ratio": used / fastrod,
    }


def integrator_section(n_robots: int, quick: bool) -> Section:
    """The ODE choices of the paper's Figure 11."""
    note_progress("integrators")
    pose, _ = cases.appendix_b()
    case = Case("paper", "", cases.appendix_b_robot(True), pose, pose, cases.LINE)
    _, truth = cases.fine_solution(case, pose, outputs="full")
    problem = Problem(case, truth.curvature[:, 0, :2], truth)
    points, error = _fewest_steps(problem)
    times = [_fastrod_time(problem, points, n) for n in (n_robots, 1)]
    rows = [
        _row(method, f"{points} steps", used, times[0], error, 4.0 * points)
        for method, used in zip((f"fastrod, {n_robots} robots", "fastrod, one robot"), times, strict=True)
    ]
    sample, rounds = (4, 1) if quick else (20, 3)
    rows += [_scipy_row(problem, name, sample, rounds, times[0]) for name in _METHODS]
    return table(
        "integrators",
        "One forward pass: ODE methods at one accuracy",
        "method | how setting | us:,.2f us / pass~1 thread | error_max_m:.1e tip error~max [m]"
        "| error_median_m:.1e tip error~median [m] | target:.0e max,~target | slopes:.0f slopes /~pass"
        "| ratio:,.0f ratio to~fastrod",
        rows,
        "The paper's rod from a given base (Appendix B; the question of its Figure 11), with the fewest "
        "steps or the loosest tolerance whose largest tip error is within the target. fastrod: wall time, "
        "and its pass includes the sensitivities and the correction; scipy: CPU time, scalar Python slope, "
        "the integration alone. Ratio: time over that of fastrod's batch.",
        "LSODA begins with Adams and may change to BDF; odeint is the same code without Python between the "
        "steps. Radau and BDF are implicit and stand in for the Rosenbrock type, which scipy lacks; the "
        "slopes of their difference Jacobian are not counted.",
    )


def _fewest_steps(problem: Problem) -> tuple[int, TipError]:
    """Steps of a pass whose boundary is put in place, so that only the integration's error is left."""
    case = problem.case
    stiffness = np.array(case.robot.segments[0].bending_stiffness)
    for points in range(2, 41):
        sim = _on_one_thread(case.robot, len(problem.base), points)
        sim.settle(**case.inputs(case.here))
        held = sim.snapshot()
        held.memory.x[:] = stiffness * problem.base
        sim.restore(held)
        error = cases.state_error(sim.step(**case.inputs(case.here)), problem.truth)
        if error.largest <= cases.TIP_ERROR:
            break
    return points, error


def _fastrod_time(problem: Problem, points: int, n_robots: int) -> float:
    """Wall time of a pass of one robot in a batch [s], 1 thread."""
    case = problem.case
    inputs = case.inputs(case.here.take(np.arange(n_robots) % len(problem.base)))
    sim = _on_one_thread(case.robot, n_robots, points)
    sim.settle(**inputs)
    return best(partial(sim.step, **inputs), 20 if n_robots > 1 else 200) / n_robots


def _scipy_row(problem: Problem, name: str, sample: int, rounds: int, fastrod: float) -> Row:
    """A method of scipy on the first `sample` cases, with the loosest tolerance that is good enough."""
    robot, force = problem.case.robot, problem.case.here.tip_force[:sample]
    loads = [(*f.tolist(), *problem.case.line_force) for f in force]

    def tips(peer: Shooter) -> Array:
        starts = problem.base[:sample] / peer.unit
        return np.array([peer.march(x, load)[:3] for x, load in zip(starts, loads, strict=True)])

    for exponent in range(4, 22):
        rtol = 10.0 ** (-0.5 * exponent)
        peer = Shooter(robot, "scalars", integrator=name, rtol=rtol, atol=0.1 * rtol * robot.length)
        error = cases.tip_error(tips(peer), problem.truth.tip_position[:sample], np.full(sample, True))
        if error.largest <= cases.TIP_ERROR:
            break
    slopes, used = peer.slopes / sample, Measurement(time.process_time)
    for _ in range(rounds):
        used.take(partial(tips, peer))
    return _row(f"scipy {name}", f"rtol {rtol:.0e}", used.least / sample, fastrod, error, slopes)


def relax(setting: Relaxation, target: Array, patience: float = 12.0) -> tuple[float, int, float]:
    """Wall time [s] and steps until the tip has come within `WITHIN` for good, and its error in the end [m].

    `patience` is the simulated time in units of the first mode's 1/omega; time is infinite if the tip does
    not stay.
    """
    stand = Stand(setting)
    stand.load(FORCE)
    within, error, steps = (math.inf, 0), math.inf, 0
    start = time.perf_counter()
    while steps * stand.dt * stand.omega < patience and not math.isnan(error):
        error = float(np.linalg.norm(stand.run(_CHECK) - target))
        steps += _CHECK
        if not error <= WITHIN * _deflection(target):
            within = (math.inf, 0)
        elif not within[1]:
            within = (time.perf_counter() - start, steps)
    return *within, error


def _deflection(target: Array) -> float:
    return float(np.linalg.norm(target - [0.0, appendix_j.LENGTH]))


def _settled(target: Array) -> Row:
    """One robot from the cold guess, with the fewest steps that `cases.TIP_ERROR` allows."""
    for points in range(2, 41):
        sim = _on_one_thread(appendix_j.robot(), 1, points)

        def cold(sim: Simulator = sim) -> State:
            sim.reset()
            return sim.settle(tip_force=(0.0, FORCE, 0.0))

        state = cold()
        error = float(np.linalg.norm(state.tip_position[0, 1:] - target))
        if error <= cases.TIP_ERROR:
            break
    setting = f"{points} points, settle to 1e-9 m from the cold guess"
    figures = {"ms": 1e3 * best(cold, 50), "steps": int(state.passes[0]), "error_m": error}
    return {"solver": "fastrod", "setting": setting, **figures}


def _relaxed(target: Array, quick: bool, own: Any) -> Row:
    relax(_TRIED[0], target, patience=0.1)  # compiles
    fastest = min(_TRIED[4:5] if quick else _TRIED, key=lambda setting: relax(setting, target)[0])
    used, steps, error = min(relax(fastest, target) for _ in range(1 if quick else 3))
    words = f"damping {fastest.damping:g} of critical, shear {fastest.shear:g} N"
    figures = {"ms": 1e3 * used, "steps": steps, "error_m": error, "ratio": 1e3 * used / own}
    return {"solver": "PyElastica", "setting": f"{fastest.elements} elements, {words}", **figures}


def cantilever_section(quick: bool) -> Section:
    """PyElastica's dynamic relaxation and one `settle`; `fastrod bench peers` has error against time."""
    note_progress("cantilever")
    target = appendix_j.tips(np.array([FORCE]))[0]
    rows = [_settled(target)]
    note = "PyElastica is not installed, so its row is left out: pip install fastrod[peers]."
    if importlib.util.find_spec("elastica") is not None:
        rows.append(_relaxed(target, quick, rows[0]["ms"]))
        note = (
            f"PyElastica: the fastest of {len(_TRIED)} settings (12 to 16 elements, damping 0.8 to 1 of "
            "critical), shear stiffness and rotary inertia chosen for large stable steps, and the rod begun "
            "half an element before the wall for second order."
        )
    return table(
        "cantilever",
        "A passive cantilever (Appendix J) beside PyElastica",
        "solver | setting | ms:.2f ms~1 thread | steps:d passes or~time steps"
        "| error_m:.1e tip error~in the end [m] | ratio:,.0f ratio to~fastrod",
        rows,
        f"Passive rod of 0.07 m, tip force {FORCE} N across it; until the tip is within {WITHIN:.1%} of its "
        f"deflection, {WITHIN * _deflection(target):.1e} m. One rod, 1 thread, wall time, warm (kernels "
        "compiled).",
        note,
    )
