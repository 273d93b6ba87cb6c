"""One forward pass of the paper's rod: fastrod's fixed steps beside the ODE methods of scipy, at one
accuracy."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import partial

import numpy as np

import cases
from cases import Array, Case, Error
from fastrod import Simulator, State
from peers import Peer
from report import Column, Row, Section, best, note_progress

_METHODS = ("RK45", "RK23", "LSODA", "odeint", "Radau", "BDF")


@dataclass(frozen=True)
class Problem:
    """Forward passes from known base curvatures."""

    case: Case
    base: Array
    """(n, 2) u_x, u_y at the base [1/m]."""
    truth: State


def section(n_robots: int, quick: bool) -> Section:
    """Forward passes of the paper's rod from known base curvatures: the ODE choices of the paper's Figure
    11."""
    note_progress("integrators")
    pose, _ = cases.appendix_b()
    case = Case("paper", "", cases.appendix_b_robot(True), pose, pose, cases.LINE)
    _, truth = cases.fine_solution(case, pose, outputs="full")
    problem = Problem(case, truth.curvature[:, 0, :2], truth)
    points, error = _fewest_steps(problem)
    times = [_fastrod_time(problem, points, n) for n in (n_robots, 1)]
    rows = [
        _row(method, f"{points} steps", used, used / times[0], error.largest, error.median, 4.0 * points)
        for method, used in zip((f"fastrod, {n_robots} robots", "fastrod, one robot"), times, strict=True)
    ]
    sample, rounds = (4, 1) if quick else (20, 3)
    rows += [_scipy_row(problem, name, sample, rounds, times[0]) for name in _METHODS]
    columns = [
        Column("method", "method"),
        Column("how", "setting"),
        Column("us", "us / pass\n1 thread", ",.2f"),
        Column("error_max_m", "tip error\nmax [m]", ".1e"),
        Column("error_median_m", "tip error\nmedian [m]", ".1e"),
        Column("target", "max,\ntarget", ".0e"),
        Column("slopes", "slopes /\npass", ".0f"),
        Column("ratio", "ratio to\nfastrod", ",.0f"),
    ]
    notes = [
        "The paper's rod from a given base (Appendix B; the question of its Figure 11), with the fewest "
        "steps or the loosest tolerance "
        "whose largest tip error is within the target. fastrod: wall time, and its pass includes the "
        "sensitivities and the correction; "
        "scipy: CPU time, scalar Python slope, the integration alone. Ratio: time over that of fastrod's "
        "batch. Target of the ratio: none.",
        "LSODA begins with Adams and may change to BDF; odeint is the same code without Python between the "
        "steps. Radau and BDF are "
        "implicit and stand in for the Rosenbrock type, which scipy lacks; the slopes of their difference "
        "Jacobian are not counted.",
    ]
    return Section("integrators", "One forward pass: ODE methods at one accuracy", columns, rows, notes)


def _row(
    method: str, setting: str, used: float, ratio: float, largest: float, median: float, slopes: float
) -> Row:
    return {
        "method": method,
        "how": setting,
        "us": 1e6 * used,
        "error_max_m": largest,
        "error_median_m": median,
        "target": cases.TIP_ERROR,
        "slopes": slopes,
        "ratio": ratio,
    }


def _fewest_steps(problem: Problem) -> tuple[int, Error]:
    """Steps of a pass whose boundary is put in place, so that only the integration's error is left."""
    case, error = problem.case, Error(math.inf, math.inf, 0.0)
    stiffness = np.array(case.robot.segments[0].bending_stiffness)
    for points in range(2, 41):
        sim = Simulator(case.robot, len(problem.base), points_per_segment=points, outputs="tip", threads=1)
        sim.settle(**case.words(case.here))
        held = sim.snapshot()
        held.memory.x[:] = stiffness * problem.base
        sim.restore(held)
        error = cases.tip_error(sim.step(**case.words(case.here)), problem.truth)
        if error.largest <= cases.TIP_ERROR:
            return points, error
    return points, error


def _fastrod_time(problem: Problem, points: int, n_robots: int) -> float:
    """Wall time of a pass of one robot in a batch [s], 1 thread."""
    case = problem.case
    words = case.words(case.here.take(np.arange(n_robots) % len(problem.base)))
    sim = Simulator(case.robot, n_robots, points_per_segment=points, outputs="tip", threads=1)
    sim.settle(**words)
    return best(partial(sim.step, **words), 20 if n_robots > 1 else 200) / n_robots


def _scipy_row(problem: Problem, name: str, sample: int, rounds: int, fastrod: float) -> Row:
    """A method of scipy on the first `sample` cases, with the loosest tolerance that is good enough."""
    robot, line = problem.case.robot, problem.case.line_force
    truth = problem.truth.tip_position[:sample]
    loads = [(*force.tolist(), *line) for force in problem.case.here.tip_force[:sample]]

    def tips(peer: Peer) -> Array:
        return np.array([peer.tip(u / peer.unit, load) for u, load in zip(problem.base, loads, strict=False)])

    for exponent in range(4, 22):
        rtol = 10.0 ** (-0.5 * exponent)
        peer = Peer(robot, "scalars", integrator=name, rtol=rtol, atol=0.1 * rtol * robot.length)
        error = np.linalg.norm(tips(peer) - truth, axis=1)
        if error.max() <= cases.TIP_ERROR:
            break
    slopes, used = peer.slopes / sample, math.inf
    for _ in range(rounds):
        start = time.process_time()
        tips(peer)
        used = min(used, (time.process_time() - start) / sample)
    return _row(
        f"scipy {name}",
        f"rtol {rtol:.0e}",
        used,
        used / fastrod,
        float(error.max()),
        float(np.median(error)),
        slopes,
    )
