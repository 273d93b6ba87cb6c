"""The rod solver's figures: a pass, its arithmetic, rods of modes, full solves beside scipy, PyElastica,
memory, start."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import appendix_j
import cases
import flops
import peer_elastica
import peer_fastrod
import rod_modal
import rod_solves
from bench_peers import timed
from cases import Case, TipError
from fastrod import Simulator
from floor import divisions, fused_multiply_adds
from fresh import memory_section, start_section
from report import Measurement, Row, Section, bench, goal, note_progress, table, thread_counts

FORCE, WITHIN = 0.2, 1e-3
"""Tip force across the cantilever [N], and allowed tip error as a fraction of the tip's deflection."""
_STEPS = 10  # of a round, of which the best counts


@dataclass(frozen=True)
class Timed:
    """One row: a robot, and which of its inputs move."""

    case: Case
    forces: bool
    points: int
    seconds: list[float]  # of one step of the batch, on one thread and on several [s]
    settled: TipError
    moving: TipError
    travel: float  # median displacement of the tip in one step [m]

    @property
    def head(self) -> Row:
        return {"robot": self.case.key, "moving": "both" if self.forces else "lengths"}

    @property
    def columns(self) -> int:
        """Sensitivity columns: the boundary unknowns, and three for a moving tip force."""
        robot = self.case.robot
        paper = robot.segments[0].mode == "paper"
        return (2 * robot.n_segments if paper else 3 + robot.n_tendons) + 3 * self.forces


def passes(n_robots: int, rounds: int) -> list[Timed]:
    """Time `step` of the three robots, first with lengths alone that move, then with the tip force too."""
    rows = []
    for case in cases.cases(n_robots):
        note_progress(f"observer pass, {case.key}")
        fine, _ = cases.fine_solution(case, case.at(0, True))
        start = fine.snapshot()
        for forces in (False, True):
            fine.restore(start)
            rows.append(_timed(case, forces, fine, rounds))
    return rows


def _timed(case: Case, forces: bool, fine: Simulator, rounds: int) -> Timed:
    """`fine` is settled at step 0; every run starts there, from its boundary."""
    poses = [case.at(step, forces) for step in range(_STEPS + 1)]
    start = fine.snapshot()
    at_end = fine.settle(**case.inputs(poses[-1]), tolerance=1e-10)
    points, error = cases.fewest_points(case, poses[-1], fine, at_end)
    fine.restore(start)
    measured = [Measurement() for _ in thread_counts()]
    for _ in range(rounds):
        for threads, measurement in zip(thread_counts(), measured, strict=True):
            sim, _ = cases.settled(case, poses[0], points, fine, threads)
            # a force that begins to move has no columns for it yet: not timed
            last = sim.step(**case.inputs(poses[1]))
            for pose in poses[2:]:
                before, last = last, measurement.take(partial(sim.step, **case.inputs(pose)))
    travel = float(np.median(np.linalg.norm(last.tip_position - before.tip_position, axis=1)))
    times = [measurement.least for measurement in measured]
    return Timed(case, forces, points, times, error, cases.state_error(last, at_end), travel)


def time_section(rows: list[Timed], n_robots: int) -> Section:
    one, many = thread_counts()
    made = []
    for row in rows:
        us, n = [1e6 * t / n_robots for t in row.seconds], row.case.robot.n_segments
        line = row.head | {"points": row.points, "us_one": us[0], "us_many": us[1], "ratio": us[0] / us[1]}
        line |= {"us_segment_one": us[0] / n, "us_segment_many": us[1] / n}
        line |= {"error_max_m": row.settled.largest, "error_median_m": row.settled.median}
        made.append(line | goal(row.settled.largest, cases.TIP_ERROR))
    return table(
        "observer_pass",
        "One observer pass: time and accuracy",
        f"robot | moving | points:d points /~segment | us_one:.2f us / robot~{one} thread"
        f"| us_many:.2f us / robot~{many} threads | us_segment_one:.2f us / segment~{one} thread"
        f"| us_segment_many:.2f us / segment~{many} threads | ratio:.2f {one} thread /~{many} threads"
        "| error_max_m:.1e tip error~max [m] | error_median_m:.1e tip error~median [m]"
        "| target:.0e max,~target | met",
        made,
        *(f"{row.case.key}: {row.case.title}." for row in rows[::2]),
        f'Time: `step` of {n_robots} robots, f64, outputs="tip", warm, best of {_STEPS - 1} steps in each of '
        "several rounds, thread counts in alternation. Moving: tendon lengths, or lengths and tip force.",
        f"Tip error: against {cases.N_FINE} points a segment, both settled on the inputs of the last timed "
        "step; points / segment is the fewest within the target.",
    )


def lag_section(rows: list[Timed]) -> Section:
    return table(
        "lag",
        "The same passes: accuracy in motion",
        "robot | moving | travel_m:.1e tip moves a step~median [m] | error_max_m:.1e tip error of the "
        "pass~max [m]| error_median_m:.1e tip error of the pass~median [m] | settled_error_max_m:.1e "
        "settled, max [m]| compared:.2% robots ok",
        (
            row.head
            | {"travel_m": row.travel, "error_max_m": row.moving.largest, "error_median_m": row.moving.median}
            | {"settled_error_max_m": row.settled.largest, "compared": row.moving.compared}
            for row in rows
        ),
        "The tip that the last timed pass itself gave. The inputs swing by 5 % of the difference to other "
        "random inputs, 200 steps a cycle.",
    )


def arithmetic_section(rows: list[Timed], n_robots: int) -> Section:
    """Achieved arithmetic of the rows of `time_section`."""
    note_progress("arithmetic")
    one, many = thread_counts()
    fma, divide = fused_multiply_adds(), divisions()
    tallies = {
        forces: flops.count({row.case.key: row.points for row in rows if row.forces is forces}, forces)
        for forces in (False, True)
    }
    made = []
    for row in rows:
        tally = tallies[row.forces][row.case.key]
        slow = tally.divide + tally.root
        done = [n_robots / t for t in row.seconds]
        floor = (tally.instructions - slow) / fma + slow / divide
        line = row.head | {"columns": row.columns, "flops": tally.flops, "instructions": tally.instructions}
        line |= {"gflops_one": 1e-9 * tally.flops * done[0], "gflops_many": 1e-9 * tally.flops * done[1]}
        line |= {"slow": slow, "peak_one": tally.flops * done[0] / (2.0 * fma), "floor_us": 1e6 * floor}
        made.append(line | {"fraction_one": floor * done[0], "fraction_many": floor * done[1] / many})
    return table(
        "arithmetic",
        "The same passes: arithmetic",
        "robot | moving | columns:d | flops:,.0f flop~/ pass | instructions:,.0f operations~fused"
        f"| slow:,.0f of them~/ and sqrt | gflops_one:.1f GFLOP/s~{one} thread"
        f"| gflops_many:.1f GFLOP/s~{many} threads | peak_one:.0% of peak~{one} thread"
        f"| floor_us:.2f floor [us]~{one} thread | fraction_one:.0% floor / time~{one} thread"
        f"| fraction_many:.0% floor / time~{many} threads",
        made,
        f"Peak: {2e-9 * fma:.1f} GFLOP/s of fused multiply-adds in registers, measured here on {one} thread, "
        f"and as much for each thread. A division takes the time of {fma / divide:.1f} of them.",
        "Operations fused: a product and a sum that can fuse are one. Floor: these at the rate of "
        "multiply-adds, divisions and square roots at that of divisions.",
    )


def cantilever_section() -> Section:
    """PyElastica's dynamic relaxation and one `settle`; `fastrod bench peers` has error against time."""
    note_progress("cantilever")
    force, rows, notes = np.array([FORCE]), list[Row](), list[str]()
    deflection = float(np.linalg.norm(appendix_j.tips(force)[0] - [0.0, appendix_j.LENGTH]))
    for peer in (peer_fastrod.SETTLE, peer_elastica.PEER):
        if sentence := peer.missing():
            notes.append(sentence)
            continue
        for rung in peer.rungs:
            point = timed(peer, rung, force)
            if point.error <= WITHIN * deflection:
                break
        row: Row = {"solver": peer.name, "setting": rung.label, "ms": 1e3 * point.time}
        ratio = 1e3 * point.time / (rows[0] if rows else row)["ms"]
        rows.append(row | {"error_m": point.error, "ratio": ratio, **goal(point.error, WITHIN * deflection)})
    return table(
        "cantilever",
        "A passive cantilever (Appendix J) beside PyElastica",
        "solver | setting | ms:.2f CPU ms | error_m:.1e tip error~[m] | target:.1e | met | ratio:,.0f ratio "
        "to~fastrod",
        rows,
        f"Passive rod of 0.07 m, tip force {FORCE} N across it, from the straight rod, warm: each at its "
        f"coarsest setting whose tip is within {WITHIN:.1%} of the deflection.",
        *notes,
    )


def measure(options: Any) -> list[Section]:
    """All tables, one after the other in this process (memory and start: in processes of their own)."""
    quick = options.quick
    n_robots = 256 if quick else 8192
    rows = passes(n_robots, rounds=1 if quick else 3)
    paths = [rod_solves.make_path(model) for model in ("paper", "full")]
    return [
        time_section(rows, n_robots),
        lag_section(rows),
        arithmetic_section(rows, n_robots),
        rod_modal.step_section(min(n_robots, 1024), rounds=1 if quick else 3),
        rod_modal.real_time_section(64 if quick else 1024, steps=20 if quick else 200),
        rod_solves.solve_section(paths, 512 if quick else n_robots, quick),
        rod_solves.path_section(paths, 10 if quick else 60),
        cantilever_section(),
        memory_section(5_000 if quick else 100_000),
        start_section(quick),
    ]


main = bench(__doc__, measure)
