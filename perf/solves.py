"""Full solves beside scipy's, the observer along a path, and one forward pass beside scipy's integrators."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import cases
from cases import Array, Case, Error
from fastrod import Simulator, State
from peers import Peer, Points, Run, follow
from report import Column, Row, Section, note_progress, seconds, thread_counts

GOAL = 1e-4
"""A full solve is one to this: a boundary residual [m], or more strictly the tip error [m]."""
TARGET_RATIO = {"paper": 5000.0, "full": 1500.0}
RESIDUAL_TARGET = 5e-5


@dataclass(frozen=True)
class Path:
    """The 500 points for one model, with their fine solution."""

    model: str
    case: Case
    fine: Simulator
    truth: State
    points: int
    """The fewest points per segment that keep `cases.TIP_ERROR` at every point."""
    error: Error


def make_path(model: str) -> Path:
    pose = cases.path()
    case = Case(model, "", cases.appendix_b_robot(model == "paper"), pose, pose, cases.LINE)
    fine, truth = cases.fine_solution(case, pose, outputs="full")
    return Path(model, case, fine, truth, *cases.fewest_points(case, pose, fine, truth))


@dataclass(frozen=True)
class Solved:
    """Warm solves of a batch whose robots stand at all points of the path."""

    tolerance: float
    seconds: tuple[float, float]
    """Of one solve of the whole batch, on one and on several threads [s]."""
    passes: float
    error: Error


def batch(path: Path, n_robots: int, tolerance: float, steps: int) -> Solved:
    """Every robot goes `steps` points along the path, from a phase of its own; the best step counts."""
    phase = np.arange(n_robots) * len(path.case.here.tip_force) // n_robots
    taken, errors, passes = [math.inf, math.inf], [], []
    for _ in range(2):
        for i, threads in enumerate(thread_counts()):
            sim = Simulator(
                path.case.robot, n_robots, points_per_segment=path.points, outputs="tip", threads=threads
            )
            for step in range(steps + 1):
                at = (phase + step) % len(path.case.here.tip_force)
                words = path.case.words(path.case.here.take(at))
                used, state = seconds(partial(sim.settle, **words, tolerance=tolerance))
                if step:  # the first one is cold
                    taken[i] = min(taken[i], used)
                    errors.append(_error(state, path.truth.tip_position[at]))
                    passes.append(float(state.passes[state.ok].mean()))
    worst = Error(
        max(e.largest for e in errors),
        float(np.median([e.median for e in errors])),
        min(e.compared for e in errors),
    )
    return Solved(tolerance, (taken[0], taken[1]), float(np.mean(passes)), worst)


def _error(state: State, tip: Array) -> Error:
    error = np.linalg.norm(state.tip_position - tip, axis=1)[state.ok]
    return Error(float(error.max()), float(np.median(error)), float(state.ok.mean()))


def batches(path: Path, n_robots: int, steps: int) -> list[Solved]:
    """With a residual tolerance of `GOAL`, and where that leaves the tip further off, the loosest that brings
    it within."""
    found = [batch(path, n_robots, GOAL, steps)]
    for part in (0.5, 0.2, 0.1, 0.05):
        if found[-1].error.largest <= GOAL:
            break
        found[1:] = [batch(path, n_robots, part * GOAL, steps)]
    return found


def stretches(path: Path, count: int) -> list[tuple[Array, Points]]:
    """`count` runs of one case each, evenly over the path, that begin from the fine solution of the point
    before."""
    unit = Peer(path.case.robot, "scalars").unit
    unknowns = (
        path.truth.curvature[:, 0, :2]
        if path.model == "paper"
        else np.hstack([path.truth.moment[:, 0], path.truth.tension])
    )
    pose = path.case.here
    made: list[tuple[Array, Points]] = []
    for first in np.linspace(0, len(pose.tip_force), count, endpoint=False).astype(int):
        at = range(first, first + cases.STEPS_PER_CASE)
        points = [
            (pose.tendon_length[j], (*pose.tip_force[j].tolist(), *cases.LINE), path.truth.tip_position[j])
            for j in at
        ]
        made.append((unknowns[first - 1] / unit, points))
    return made


def tuned(path: Path, slope: Any, where: Sequence[tuple[Array, Points]]) -> tuple[Peer, Run]:
    """The loosest tolerances, of those tried, with which every tip comes within `GOAL`."""
    tried = [(1e-3, 1e-5, 0.2), (1e-3, 1e-6, 0.2), (1e-3, 1e-6, 0.1), (1e-4, 1e-6, 0.1), (1e-4, 1e-6, 0.02)]
    for rtol, atol, part in tried:
        peer = Peer(path.case.robot, slope, rtol=rtol, atol=atol, ftol=1e-2, stop=part * GOAL)
        run = follow(peer, where, 1)
        if run.error_m.max() <= GOAL:
            break
    return peer, follow(peer, where, 2)


def solve_section(paths: Sequence[Path], n_robots: int, quick: bool) -> Section:
    one, many = thread_counts()
    table: list[Row] = []
    for path in paths:
        note_progress(f"full solve, {path.model}")
        solved = batches(path, n_robots, 3 if quick else 8)
        table += [_fastrod_row(path, one_of, n_robots) for one_of in solved]
        fastrod = [t / n_robots for t in solved[-1].seconds]
        table += [
            _peer_row(path, peer, run, fastrod)
            for peer, run in _peers(path, stretches(path, 2 if quick else 8))
        ]
    columns = [
        Column("model", "model"),
        Column("solver", "solver"),
        Column("how", "residual, or\nrtol atol stop"),
        Column("points", "points /\nsegment", "d"),
        Column("us_one", f"us / solve\n{one} thread", ",.2f"),
        Column("us_many", f"us / solve\n{many} threads", ",.2f"),
        Column("passes", "passes\n/ solve", ".1f"),
        Column("error_max_m", "tip error\nmax [m]", ".1e"),
        Column("error_median_m", "tip error\nmedian [m]", ".1e"),
        Column("ratio_one", f"ratio to\n{one} thread", ",.0f"),
        Column("ratio_many", f"ratio to\n{many} threads", ",.0f"),
        Column("target", "target\nratio", ",.0f"),
        Column("met", "met by\nthem"),
    ]
    notes = [
        f'fastrod: `settle` of {n_robots} robots, warm, f64, outputs="tip", wall time, best step; the '
        "robots stand at all of the "
        f"{_n_points(paths)} points of a path through Appendix B, {cases.STEPS_PER_CASE} steps a case, "
        "lengths and force both moving. "
        f"Its points a segment keep the integration's own tip error within {cases.TIP_ERROR:g} m.",
        "scipy: least_squares(method='lm') over solve_ivp('RK23'), warm from the point before, CPU time, 1 "
        "thread. arrays: the slope as "
        "one writes it with numpy, scipy's default tolerances. scalars, compiled: the slope in plain "
        "scalars, and that compiled by numba; "
        "the loosest of several tolerances that bring every tip within 1e-4 m, and the search ends at the "
        "residual `stop`.",
        "Ratio: scipy's time over fastrod's in the last fastrod row of the model, both with every tip "
        "within 1e-4 m. The targets were set "
        "with a scipy solve of about 25 ms in mind.",
    ]
    return Section("full_solve", "Full solve to 1e-4 m from the solution before", columns, table, notes)


def _peers(path: Path, where: Sequence[tuple[Array, Points]]) -> list[tuple[Peer, Run]]:
    """scipy on some stretches of the path: as usually written, lean, and compiled."""
    usual = Peer(path.case.robot, "arrays")
    follow(Peer(path.case.robot, "compiled"), [(where[0][0], where[0][1][:1])], 1)  # compiles
    return [(usual, follow(usual, where, 1)), tuned(path, "scalars", where), tuned(path, "compiled", where)]


def _n_points(paths: Sequence[Path]) -> int:
    return len(paths[0].case.here.tip_force)


def _fastrod_row(path: Path, solved: Solved, n_robots: int) -> Row:
    us = [1e6 * t / n_robots for t in solved.seconds]
    return {
        "model": path.model,
        "solver": "fastrod",
        "how": f"{solved.tolerance:.0e}",
        "points": path.points,
        "us_one": us[0],
        "us_many": us[1],
        "passes": solved.passes,
        "error_max_m": solved.error.largest,
        "error_median_m": solved.error.median,
        "ok": solved.error.compared,
        "integration_error_max_m": path.error.largest,
    }


def _peer_row(path: Path, peer: Peer, run: Run, fastrod: Sequence[float]) -> Row:
    stop = f" {peer.stop:.0e}" if peer.stop else ""
    ratios, target = [run.cpu_s / t for t in fastrod], TARGET_RATIO[path.model]
    return {
        "model": path.model,
        "solver": f"scipy, {peer.slope}",
        "how": f"{peer.rtol:.0e} {peer.atol:.0e}{stop}",
        "us_one": 1e6 * run.cpu_s,
        "passes": run.passes,
        "error_max_m": float(run.error_m.max()),
        "error_median_m": float(np.median(run.error_m)),
        "ratio_one": ratios[0],
        "ratio_many": ratios[1],
        "target": target,
        "met": " / ".join("yes" if ratio >= target else "no" for ratio in ratios),
    }


def path_section(paths: Sequence[Path], steps: int) -> Section:
    """One pass a step, one robot at every point of the path, so `steps` visits of each."""
    table: list[Row] = []
    for path in paths:
        note_progress(f"path, {path.model}")
        n = _n_points(paths)
        sim, _ = cases.settled(path.case, path.case.here, path.points, path.fine)
        residuals, errors, lost = [], [], 0
        for step in range(1, steps + 6):
            at = (np.arange(n) + step) % n
            state = sim.step(**path.case.words(path.case.here.take(at)))
            if step > 5:  # by then nothing of the settled start is left
                residuals.append(state.residual[state.ok])
                errors.append(
                    np.linalg.norm(state.tip_position - path.truth.tip_position[at], axis=1)[state.ok]
                )
                lost += int((~state.ok).sum())
        residual, error = np.concatenate(residuals), np.concatenate(errors)
        table.append(
            {
                "model": path.model,
                "points": path.points,
                "residual_median_m": float(np.median(residual)),
                "target": RESIDUAL_TARGET,
                "met": bool(np.median(residual) <= RESIDUAL_TARGET),
                "residual_99_m": float(np.quantile(residual, 0.99)),
                "residual_max_m": float(residual.max()),
                "error_median_m": float(np.median(error)),
                "error_max_m": float(error.max()),
                "lost": lost / (lost + len(residual)),
            }
        )
    columns = [
        Column("model", "model"),
        Column("points", "points /\nsegment", "d"),
        Column("residual_median_m", "residual\nmedian [m]", ".1e"),
        Column("target", "median,\ntarget", ".0e"),
        Column("met", "met"),
        Column("residual_99_m", "residual\n99 % [m]", ".1e"),
        Column("residual_max_m", "residual\nmax [m]", ".1e"),
        Column("error_median_m", "tip error\nmedian [m]", ".1e"),
        Column("error_max_m", "tip error\nmax [m]", ".1e"),
        Column("lost", "steps not\nok", ".2%"),
    ]
    notes = [
        "One `step` a point, lengths and tip force both moving; residual: of the boundary that the step "
        "predicted, before it corrects "
        "it. The paper reports 5e-4 m. Any number of threads gives the same numbers."
    ]
    return Section("path", "The 500 points with one pass a step", columns, table, notes)
