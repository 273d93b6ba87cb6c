"""A step of rods of modes, at rest and in motion, beside the observer's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

import cases
from cases import Array, Case, Pose
from fastrod import Modal, Modes, Simulator, State
from report import Measurement, Row, Section, note_progress, table, thread_counts

COST = {"prototype": 1.1, "reacher": 0.7}
"""Goals: time of a step of rods of (4, 2) modes over that of the observer's."""
GAIN = 1.8  # goal: time on one thread over that on two
LINE_DENSITY = 0.1  # kg/m, in motion; nothing weighs, so that the observer's rods are those of its own table
DT = 1e-3  # s
_STEPS = 10  # of a round, of which the best counts
_FOUR, _SIX = Modes(4, 2), Modes(6, 4)


@dataclass(frozen=True)
class Kind:
    """One solver at one setting."""

    name: str
    options: dict[str, Any]
    has_goal: bool = False
    points: int | None = None  # a segment; None: as few as the observer needs

    def simulator(self, case: Case, points: int, threads: int) -> Simulator:
        n = len(case.here.tip_force)
        options: dict[str, Any] = {
            "points_per_segment": self.points or points,
            "outputs": "tip",
            "threads": threads,
        }
        return Simulator(case.robot, n, DT, **options, **self.options)


OBSERVER = Kind("observer, one pass", {"solver": "observer"})
DEFAULT = replace(OBSERVER, points=20)
KINDS: Sequence[Kind] = (
    OBSERVER,
    DEFAULT,
    Kind("modal, at rest, (6, 4)", {"solver": Modal(modes=_SIX)}),
    Kind("modal, at rest, (4, 2)", {"solver": Modal(modes=_FOUR)}, has_goal=True),
    Kind("modal, in motion, (4, 2)", {"solver": Modal(dynamics=True, modes=_FOUR)}, has_goal=True),
)


def weightless(case: Case) -> Case:
    """The same robot with a mass that gravity does not pull."""
    segments = tuple(replace(segment, line_density=LINE_DENSITY) for segment in case.robot.segments)
    return replace(case, robot=replace(case.robot, segments=segments, gravity=(0.0, 0.0, 0.0)))


class Run:
    """Simulators of one kind, one for each number of threads, and what their steps took."""

    def __init__(self, kind: Kind, case: Case, points: int) -> None:
        self.kind, self.case = kind, case
        self.sims = [kind.simulator(case, points, threads) for threads in thread_counts()]
        self.measured = [Measurement() for _ in self.sims]
        self.starts: list[Any] = []
        self.passes: list[float] = []
        self.ok: list[float] = []
        self.last: State | None = None

    def start(self, pose: Pose, fine: Simulator) -> None:
        """All at rest, on the branch of the fine solution where that is an observer's."""
        for sim in self.sims:
            if self.kind is OBSERVER:
                sim.restore(fine.snapshot())
            sim.settle(**self.case.inputs(pose), tolerance=1e-10)
            self.starts.append(sim.snapshot())

    def take(self, poses: Sequence[Pose]) -> None:
        """One round: the steps from the start on, threads in alternation."""
        for sim, start, measurement in zip(self.sims, self.starts, self.measured, strict=True):
            sim.restore(start)
            # a force that begins to move, and an input that begins to change, cost a pass more: not timed
            for pose in poses[1:3]:
                sim.step(**self.case.inputs(pose))
            for pose in poses[3:]:
                self.last = measurement.take(partial(sim.step, **self.case.inputs(pose)))
                self.passes.append(float(self.last.passes[self.last.ok].mean()))
                self.ok.append(float(self.last.ok.mean()))

    @property
    def seconds(self) -> list[float]:
        return [one.least for one in self.measured]


def _compared(case: Case, forces: bool, rounds: int) -> tuple[list[Run], int, State]:
    """All kinds with the same inputs, in alternation; the points a segment, and the rest at the end."""
    poses = [case.at(step, forces) for step in range(_STEPS + 3)]
    fine, _ = cases.fine_solution(case, poses[-1])
    at_end = fine.settle(**case.inputs(poses[-1]), tolerance=1e-10)
    points, _ = cases.fewest_points(case, poses[-1], fine, at_end)
    fine.settle(**case.inputs(poses[0]), tolerance=1e-10)
    runs = [Run(kind, case, points) for kind in KINDS]
    for run in runs:
        run.start(poses[0], fine)
    for _ in range(rounds):
        for run in runs:
            run.take(poses)
    return runs, points, at_end


def step_section(n_robots: int, rounds: int) -> Section:
    """The observer and modes side by side."""
    one, many = thread_counts()
    rows: list[Row] = []
    for case in map(weightless, cases.cases(n_robots)[1:]):
        for forces in (False, True):
            note_progress(f"observer and modes, {case.key}")
            runs, points, at_end = _compared(case, forces, rounds)
            rows += [_row(run, runs[:2], points, at_end, forces) for run in runs]
    return table(
        "modal_step",
        "One step: the observer and rods of modes",
        "robot | moving | solver | points:d points /~segment | passes:.2f passes~/ step"
        f"| us_one:.2f us / robot~{one} thread | us_many:.2f us / robot~{many} threads"
        "| ratio:.2f time / the~observer's | ratio_default:.2f time / its at~20 points | target:.1f target"
        f"| met met by~them | gain:.2f {one} thread /~{many} threads | gain_met >= {GAIN:g}"
        "| error_max_m:.1e tip error~max [m] | error_median_m:.1e tip error~median [m] | ok:.1% robots~ok",
        rows,
        f'Time: `step` of {n_robots} robots, f64, outputs="tip", warm, solvers and thread counts in '
        f"alternation, best of {_STEPS} steps in each of several rounds. Inputs are those of the observer's "
        f"own table; rods have {LINE_DENSITY:g} kg/m and no gravity; in motion dt is {DT * 1e3:g} ms, "
        "generalized-alpha, passes=1.",
        "Ratios are of one thread: to the observer with the fewest points whose tip is within "
        f"{cases.TIP_ERROR:g} m, and to that of {DEFAULT.points} points, a simulator's default.",
        "Observer: one pass that lags. Modal, at rest: Newton's method to 1e-9 m at the tip in every step, "
        "at least two passes. Modal, in motion: at least one, more where the first one was large. Tip error: "
        f"against the rest of {cases.N_FINE} points a segment on the last inputs; in motion there is none, "
        "for the rod is not at rest there.",
    )


def _row(run: Run, observers: Sequence[Run], points: int, at_end: State, forces: bool) -> Row:
    us = [1e6 * t / len(run.case.here.tip_force) for t in run.seconds]
    row: Row = {"robot": run.case.key, "moving": "both" if forces else "lengths", "solver": run.kind.name}
    row |= {"points": run.kind.points or points, "passes": float(np.mean(run.passes)), "ok": min(run.ok)}
    row |= {"us_one": us[0], "us_many": us[1], "gain": us[0] / us[1], "gain_met": us[0] / us[1] >= GAIN}
    if run not in observers:
        ratios, target = [run.seconds[0] / one.seconds[0] for one in observers], COST[run.case.key]
        row |= {"ratio": ratios[0], "ratio_default": ratios[1]}
        if run.kind.has_goal:
            row |= {"target": target, "met": " / ".join("yes" if r <= target else "no" for r in ratios)}
    if not run.sims[0].dynamics and run.last is not None:
        error = cases.state_error(run.last, at_end)
        row |= {"error_max_m": error.largest, "error_median_m": error.median}
    return row


def real_time_section(n_robots: int, steps: int) -> Section:
    """Five-segment robots at 1 kHz: how much of a second is computed in a second."""
    note_progress(f"{n_robots} five-segment robots in motion")
    case = weightless(cases.cases(n_robots)[2])
    rows: list[Row] = []
    sims = [KINDS[-1].simulator(case, 4, threads) for threads in thread_counts()]
    times: list[list[float]] = [[] for _ in sims]
    passes: list[Array] = []
    lost = 0
    for sim in sims:
        sim.settle(**case.inputs(case.at(0, True)))
    for step in range(1, steps + 1):
        for sim, taken in zip(sims, times, strict=True):
            measurement = Measurement()
            state = measurement.take(partial(sim.step, **case.inputs(case.at(step, True))))
            taken.append(measurement.least)
            passes.append(state.passes[state.ok])
            lost += int((~state.ok).sum())
    for threads, taken in zip(thread_counts(), times, strict=True):
        mean = float(np.mean(taken))
        row: Row = {"threads": threads, "ms": 1e3 * mean, "ms_99": 1e3 * float(np.quantile(taken, 0.99))}
        row |= {"factor": DT / mean, "robots": n_robots * DT / mean, "gain": float(np.mean(times[0])) / mean}
        rows.append(row | {"passes": float(np.concatenate(passes).mean()), "lost": lost})
    return table(
        "real_time",
        f"{n_robots:,} five-segment robots in motion at {1.0 / DT:,.0f} Hz",
        "threads:d | ms:.2f ms a step~mean | ms_99:.2f ms a step~99 % | factor:.3f real-time~factor"
        "| robots:,.0f robots in~real time | gain:.2f gain~by threads | passes:.3f passes~/ step "
        "| lost:d steps~not ok",
        rows,
        f"five_segment_reacher, 15 tendons, {LINE_DENSITY:g} kg/m, (4, 2) modes, dt {DT * 1e3:g} ms, {steps} "
        "steps one after the other, the thread counts in alternation; lengths and tip force move as in the "
        "table above. Real-time factor: seconds of motion in a second of the clock.",
    )
