"""Contact with a mesh: `fastrod bench contact`, or this file as a script; `--json` for programs, `--quick`
for a smoke run."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import report
from report import Column, Row, Section, note_progress, thread_counts

FREE_TARGET, TOUCHING_TARGET, FCL_TARGET = 20_000.0, 5_000.0, 50.0
"""Robot-steps a second on two threads, free or grazing and in contact; how many times as fast as FCL, capsule
by capsule."""


@dataclass
class Case:
    """One state with one mesh, on one thread and on two."""

    state: str
    one: Any
    many: Any
    queries: tuple[float, float, float, float]
    """Seconds of a search of all robots: cold and warm on one thread, cold and warm on two."""
    fcl_s: float
    """Seconds of FCL for one robot."""
    asked: int
    """Robots that FCL was asked about."""


def measure(
    n_robots: int, subdivisions: Sequence[int], budget: float, sample: int
) -> tuple[Any, list[Case], tuple[Any, Any]]:
    """The batch, every state with every mesh, and the same robots without a scene."""
    import touching as t

    batch, (one, many) = t.make_batch(n_robots), thread_counts()
    bare = t.run(batch, None, 0.0, one, budget), t.run(batch, None, 0.0, many, budget)
    cases = []
    for state, gap in (("free", t.FAR), ("grazing", t.GRAZING), ("in contact", t.PRESSED)):
        for level in subdivisions:
            obstacle = t.make_mesh(level)
            note_progress(f"{state}, {len(obstacle.faces)} faces")
            timed = [t.run(batch, obstacle, gap, threads, budget) for threads in (one, many)]
            queries = [s for run in timed for s in t.query(run, 3)]
            fcl_s, asked = t.fcl_seconds(timed[0], obstacle, t.places(batch, gap), sample)
            for run in timed:
                run.sim = run.last = run.earlier = None  # arrays of every robot
            cases.append(Case(state, *timed, tuple(queries), fcl_s, asked))
    return batch, cases, bare


def step_section(batch: Any, cases: list[Case], bare: tuple[Any, Any]) -> Section:
    """Robot-steps a second, and what contact adds to a step."""
    one, many = thread_counts()
    n = batch.tendon_length.shape[1]
    table: list[Row] = []
    for state, *timed in [("no scene", *bare), *((case.state, case.one, case.many) for case in cases)]:
        us = [1e6 * run.step_s / n for run in timed]
        alone = [1e6 * run.step_s / n for run in bare]
        target = None if state == "no scene" else TOUCHING_TARGET if state == "in contact" else FREE_TARGET
        table.append(
            {
                "state": state,
                "faces": timed[0].n_faces,
                "rate_one": 1e6 / us[0],
                "rate_many": 1e6 / us[1],
                "added_one": None if target is None else us[0] - alone[0],
                "added_many": None if target is None else us[1] - alone[1],
                "touching": timed[0].touching,
                "contacts": timed[0].contacts,
                "passes": timed[0].passes,
                "most_passes": max(run.most_passes for run in timed),
                "gap_m": timed[0].gap,
                "not_ok": sum(run.not_ok for run in timed),
                "target": target,
                "met": None if target is None else 1e6 / us[1] >= target,
            }
        )
    columns = [
        Column("state", "state"),
        Column("faces", "faces", ",d"),
        Column("rate_one", f"steps/s\n{one} thread", ",.0f"),
        Column("rate_many", f"steps/s\n{many} threads", ",.0f"),
        Column("added_one", f"contact, us\n{one} thread", ".1f"),
        Column("added_many", f"contact, us\n{many} threads", ".1f"),
        Column("touching", "in\ncontact", ".0%"),
        Column("contacts", "contacts\n/ step", ".2f"),
        Column("passes", "passes\n/ step", ".2f"),
        Column("most_passes", "most\npasses", "d"),
        Column("gap_m", "gap [m]\nmedian", ".1e"),
        Column("not_ok", "not ok", "d"),
        Column("target", f"target,\n{many} threads", ",.0f"),
        Column("met", "met"),
    ]
    notes = [
        f"{n} five-segment robots of 30 intervals, each bent its own way, its mesh in a place of its own; "
        "the free tip goes "
        f"{1e3 * batch.travel:.2f} mm a step. Mean over the steps of a swing, each the best of its rounds "
        "where time allowed several.",
        "Grazing: the ball around the mesh leaves 2 mm to the free rod. In contact: it is 3 mm too near. In "
        "contact is the share of "
        "robot-steps; not ok counts robot-steps of both runs, the mesh's approach included.",
        "Steps/s: robot-steps a second. Contact: what a step takes more than that of the same robots "
        "without a scene.",
    ]
    return Section("contact_steps", "One step with a mesh beside every robot", columns, table, notes)


def query_section(n: int, cases: list[Case]) -> Section:
    """The search alone and the whole step against FCL, asked capsule by capsule."""
    one, many = thread_counts()
    table: list[Row] = []
    for case in cases:
        cold_one, warm_one, cold_many, warm_many = (s / n for s in case.queries)
        table.append(
            {
                "state": case.state,
                "faces": case.one.n_faces,
                "fcl_us": 1e6 * case.fcl_s,
                "cold_us": 1e6 * cold_one,
                "warm_us": 1e6 * warm_one,
                "cold_ratio": case.fcl_s / cold_one,
                "warm_ratio": case.fcl_s / warm_one,
                "cold_ratio_many": case.fcl_s / cold_many,
                "warm_ratio_many": case.fcl_s / warm_many,
                "step_ratio": case.fcl_s * n / case.one.step_s,
                "step_ratio_many": case.fcl_s * n / case.many.step_s,
                "target": FCL_TARGET,
                "met": case.fcl_s / warm_one >= FCL_TARGET,
            }
        )
    columns = [
        Column("state", "state"),
        Column("faces", "faces", ",d"),
        Column("fcl_us", "FCL\nus / robot", ",.0f"),
        Column("cold_us", f"cold, us\n{one} thread", ".1f"),
        Column("warm_us", f"warm, us\n{one} thread", ".1f"),
        Column("cold_ratio", f"FCL/cold\n{one} thread", ".0f"),
        Column("warm_ratio", f"FCL/warm\n{one} thread", ".0f"),
        Column("cold_ratio_many", f"FCL/cold\n{many} threads", ".0f"),
        Column("warm_ratio_many", f"FCL/warm\n{many} threads", ".0f"),
        Column("step_ratio", f"FCL/step\n{one} thread", ".1f"),
        Column("step_ratio_many", f"FCL/step\n{many} threads", ".1f"),
        Column("target", "FCL/warm\ntarget", ".0f"),
        Column("met", "met"),
    ]
    notes = [
        "FCL: one fcl.distance(mesh, capsule of radius 1e-6 m) from Python for each of a robot's 30 "
        f"intervals, {cases[0].asked} robots, "
        "on one thread: it holds the interpreter's lock. Capsules and poses are made beforehand; the calls "
        "alone are timed.",
        "Search: candidates and smallest gap of every robot, tessellation and minima along the curve "
        "included. Cold: nothing is known; "
        "warm: from the step before. Met: the warm search, one thread against one.",
        "Step: FCL's queries alone against the whole step, its passes and forces included. A step with FCL "
        "would ask once a pass.",
    ]
    return Section("contact_query", "The search against FCL, capsule by capsule", columns, table, notes)


def growth_section(counts: Sequence[int], subdivisions: int, budget: float) -> Section:
    """How a free step grows with the number of robots."""
    import touching as t

    _, many = thread_counts()
    obstacle, table = t.make_mesh(subdivisions), []
    for n in counts:
        note_progress(f"{n} robots")
        batch = t.make_batch(n)
        timed, bare = t.run(batch, obstacle, t.FAR, many, budget), t.run(batch, None, 0.0, many, budget)
        row: Row = {
            "robots": n,
            "rate": n / timed.step_s,
            "us": 1e6 * timed.step_s / n,
            "bare_us": 1e6 * bare.step_s / n,
        }
        table.append(
            {
                **row,
                "ratio": timed.step_s / bare.step_s,
                "not_ok": timed.not_ok + bare.not_ok,
                "target": FREE_TARGET,
                "met": n / timed.step_s >= FREE_TARGET,
            }
        )
    columns = [
        Column("robots", "robots", ",d"),
        Column("rate", f"robot-steps/s\n{many} threads", ",.0f"),
        Column("us", f"us / step\n{many} threads", ".1f"),
        Column("bare_us", "without\nscene", ".1f"),
        Column("ratio", "ratio", ".2f"),
        Column("not_ok", "not ok", "d"),
        Column("target", "target", ",.0f"),
        Column("met", "met"),
    ]
    return Section("contact_growth", f"Free robots beside {len(obstacle.faces):,d} faces", columns, table, [])


def sections(options: argparse.Namespace) -> list[Section]:
    """All of it."""
    n_robots, budget = options.robots or (8 if options.quick else 128), 0.0 if options.quick else 0.6
    batch, cases, bare = measure(
        n_robots, (2, 3) if options.quick else (3, 5, 6), budget, 2 if options.quick else 24
    )
    return [
        step_section(batch, cases, bare),
        query_section(n_robots, cases),
        growth_section(
            (4, n_robots) if options.quick else (64, 1024, 8192), 2 if options.quick else 5, budget
        ),
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; the exit code."""
    parser = argparse.ArgumentParser(prog="bench_contact", description=__doc__)
    parser.add_argument("--robots", type=int, help="robots of a batch (default 128, with --quick 8)")
    return report.command(parser, argv, sections)


if __name__ == "__main__":
    sys.exit(main())
