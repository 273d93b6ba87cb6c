"""One observer pass of a batch: its time, and how near that is to the machine's arithmetic."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

import cases
import flops
from cases import Case, Error
from fastrod import Simulator
from floor import divisions, fused_multiply_adds
from report import Column, Row, Section, note_progress, seconds, thread_counts

_STEPS = 10  # timed in a row, of which the best counts
_ROUNDS = 3


@dataclass(frozen=True)
class Timed:
    """One row: a robot, and which of its inputs move."""

    case: Case
    forces: bool
    points: int
    seconds: tuple[float, float]
    """Of one step of the batch, on one and on several threads [s]."""
    settled: Error
    moving: Error
    travel: float
    """Median way of the tip in one step [m]."""


def measure(n_robots: int, rounds: int = _ROUNDS) -> list[Timed]:
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
    at_end = fine.settle(**case.words(poses[-1]), tolerance=1e-10)
    points, error = cases.fewest_points(case, poses[-1], fine, at_end)
    fine.restore(start)
    taken = [math.inf, math.inf]
    for _ in range(rounds):
        for i, threads in enumerate(thread_counts()):
            sim, _ = cases.settled(case, poses[0], points, fine, threads)
            # a force that begins to move has no columns for it yet: not timed
            last = sim.step(**case.words(poses[1]))
            for pose in poses[2:]:
                before = last
                used, last = seconds(partial(sim.step, **case.words(pose)))
                taken[i] = min(taken[i], used)
    travel = float(np.median(np.linalg.norm(last.tip_position - before.tip_position, axis=1)))
    return Timed(case, forces, points, (taken[0], taken[1]), error, cases.tip_error(last, at_end), travel)


def time_section(rows: list[Timed], n_robots: int) -> Section:
    one, many = thread_counts()
    table: list[Row] = []
    for row in rows:
        n_segments = row.case.robot.n_segments
        us = [1e6 * t / n_robots for t in row.seconds]
        table.append(
            {
                "robot": row.case.key,
                "moving": _moving(row),
                "points": row.points,
                "us_one": us[0],
                "us_many": us[1],
                "us_segment_one": us[0] / n_segments,
                "us_segment_many": us[1] / n_segments,
                "ratio": us[0] / us[1],
                "error_max_m": row.settled.largest,
                "error_median_m": row.settled.median,
                "target": cases.TIP_ERROR,
                "met": row.settled.largest <= cases.TIP_ERROR,
            }
        )
    columns = [
        Column("robot", "robot"),
        Column("moving", "moving"),
        Column("points", "points /\nsegment", "d"),
        Column("us_one", f"us / robot\n{one} thread", ".2f"),
        Column("us_many", f"us / robot\n{many} threads", ".2f"),
        Column("us_segment_one", f"us / segment\n{one} thread", ".2f"),
        Column("us_segment_many", f"us / segment\n{many} threads", ".2f"),
        Column("ratio", f"{one} thread /\n{many} threads", ".2f"),
        Column("error_max_m", "tip error\nmax [m]", ".1e"),
        Column("error_median_m", "tip error\nmedian [m]", ".1e"),
        Column("target", "max,\ntarget", ".0e"),
        Column("met", "met"),
    ]
    notes = [f"{row.case.key}: {row.case.title}." for row in rows[::2]]
    notes += [
        f'Time: `step` of {n_robots} robots, f64, outputs="tip", warm, best of {_STEPS - 1} steps in each '
        "of several rounds. "
        "Target of the times: none. Moving: tendon lengths, or lengths and tip force.",
        f"Tip error: against {cases.N_FINE} points a segment, both settled on the inputs of the last timed "
        "step; points / segment is the "
        "fewest within the target.",
    ]
    return Section("observer_pass", "One observer pass: time and accuracy", columns, table, notes)


def lag_section(rows: list[Timed]) -> Section:
    """How good the tip of one pass is while the inputs move, beside that of the settled robot."""
    table: list[Row] = [
        {
            "robot": row.case.key,
            "moving": _moving(row),
            "travel_m": row.travel,
            "error_max_m": row.moving.largest,
            "error_median_m": row.moving.median,
            "settled_error_max_m": row.settled.largest,
            "compared": row.moving.compared,
        }
        for row in rows
    ]
    columns = [
        Column("robot", "robot"),
        Column("moving", "moving"),
        Column("travel_m", "tip moves a step\nmedian [m]", ".1e"),
        Column("error_max_m", "tip error of the pass\nmax [m]", ".1e"),
        Column("error_median_m", "tip error of the pass\nmedian [m]", ".1e"),
        Column("settled_error_max_m", "settled, max [m]", ".1e"),
        Column("compared", "robots ok", ".2%"),
    ]
    notes = [
        "The tip that the last timed pass itself gave, whose boundary was predicted before the pass; any "
        "number of threads gives the same. "
        "The inputs swing by 5 % of the way to other random inputs, 200 steps a cycle. Target: none."
    ]
    return Section("lag", "The same passes: accuracy in motion", columns, table, notes)


def arithmetic_section(rows: list[Timed], n_robots: int) -> Section:
    """Achieved arithmetic of the rows of `time_section`."""
    note_progress("arithmetic")
    one, many = thread_counts()
    fma, divide = fused_multiply_adds(), divisions()
    tallies = {}
    for forces in (False, True):
        counted = flops.count({row.case.key: row.points for row in rows if row.forces is forces}, forces)
        tallies.update({(key, forces): sum(parts.values(), flops.Tally()) for key, parts in counted.items()})
    table: list[Row] = []
    for row in rows:
        tally = tallies[row.case.key, row.forces]
        slow = tally.divide + tally.root
        done = [n_robots / t for t in row.seconds]
        floor = (tally.instructions - slow) / fma + slow / divide
        table.append(
            {
                "robot": row.case.key,
                "moving": _moving(row),
                "columns": _columns(row),
                "flops": tally.flops,
                "instructions": tally.instructions,
                "slow": slow,
                "gflops_one": 1e-9 * tally.flops * done[0],
                "gflops_many": 1e-9 * tally.flops * done[1],
                "peak_one": tally.flops * done[0] / (2.0 * fma),
                "floor_us": 1e6 * floor,
                "share_one": floor * done[0],
                "share_many": floor * done[1] / many,
            }
        )
    columns = [
        Column("robot", "robot"),
        Column("moving", "moving"),
        Column("columns", "columns", "d"),
        Column("flops", "flop\n/ pass", ",.0f"),
        Column("instructions", "operations\nfused", ",.0f"),
        Column("slow", "of them\n/ and sqrt", ",.0f"),
        Column("gflops_one", f"GFLOP/s\n{one} thread", ".1f"),
        Column("gflops_many", f"GFLOP/s\n{many} threads", ".1f"),
        Column("peak_one", f"of peak\n{one} thread", ".0%"),
        Column("floor_us", f"floor [us]\n{one} thread", ".2f"),
        Column("share_one", f"floor / time\n{one} thread", ".0%"),
        Column("share_many", f"floor / time\n{many} threads", ".0%"),
    ]
    notes = [
        f"Peak: {2e-9 * fma:.1f} GFLOP/s of fused multiply-adds in registers, measured here on {one} "
        "thread, and so much for each thread. "
        f"A division takes the time of {fma / divide:.1f} of them. Target: none.",
        "Operations fused: a product and a sum that can fuse are one. Floor: these at the rate of "
        "multiply-adds, divisions and square "
        "roots at that of divisions: the time a robot if nothing was loaded, stored or waited for, and "
        "Python took none.",
    ]
    return Section("arithmetic", "The same passes: arithmetic", columns, table, notes)


def _columns(row: Timed) -> int:
    """Sensitivity columns: the boundary unknowns, and three for a moving tip force."""
    robot = row.case.robot
    paper = robot.segments[0].mode == "paper"
    return (2 * robot.n_segments if paper else 3 + robot.n_tendons) + (3 if row.forces else 0)


def _moving(row: Timed) -> str:
    return "both" if row.forces else "lengths"
