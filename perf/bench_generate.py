"""What data sets cost: one worker, two, Ray tasks, start and dispatch; and from these what N machines would
give.

fastrod bench generate                     a million loaded five-segment shapes among them: some minutes on
two quiet cores python perf/bench_generate.py --quick      does it run?
python perf/bench_generate.py --cores 64   machines of so many cores in the table of N machines
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import fastrod
from fastrod.generation import Plan, Shapes, generate
from fastrod.generation.here import cores, one_thread
from fastrod.generation.plan import SHARDS
from fastrod.generation.settling import ChainSolver
from fastrod.generation.shapes import Draw
from fastrod.generation.shards import counted, found, write
from fastrod.generation.tasks import columns_of
from fastrod.model.robotfile import dumps
from fastrod.solver.inputs import Inputs
from report import Column, Row, Section, command, note_progress

DENSITY = 0.005  # kg/m: the weight bends the rod as much as a tip force of EI/l^2
MACHINES = (1, 2, 8, 32, 128)
TARGET = 60.0  # s for a million shapes on two cores


@dataclass(frozen=True)
class Costs:
    """What the table of N machines is computed from, all measured here."""

    task: float
    """Of one worker for one shard, written [s]."""
    start: float
    """Until the first worker begins, the cluster being there [s]."""
    dispatch: float
    """Of the driver for one task [s]."""
    check: float
    """Of the driver at the end, a row [s]."""
    bytes: float
    """Of a row on the disk."""


def loaded(**words: Any) -> Shapes:
    """The five-segment reacher with a weight, tip forces as by default."""
    robot = fastrod.load_robot("five_segment_reacher")
    robot = replace(
        robot, segments=tuple(replace(segment, line_density=DENSITY) for segment in robot.segments)
    )
    return Shapes(robot=dumps(robot), **words)


def measure(options: argparse.Namespace) -> list[Section]:
    """All sections."""
    quick = options.quick
    rows = 512 if quick else Plan(work=loaded(), count=1).shard_rows
    with tempfile.TemporaryDirectory(prefix="fastrod-bench-") as folder:
        place = Path(folder)
        note_progress("one worker")
        per_row, worker = one_worker(place / "one", rows, 1 if quick else 3)
        note_progress("runs")
        runs = whole_runs(place, rows, 4 if quick else 10, ray=find_spec("ray") is not None)
        note_progress("dispatch")
        dispatch, start, cheap = dispatch_costs(20 if quick else 400, ray=find_spec("ray") is not None)
        two = next(row for row in runs.rows if row["workers"] == 2)
        task = 2.0 * rows / float(two["between"] or math.nan)  # cores that all work are slower than one alone
        costs = Costs(task, start, dispatch, check_cost(place / "runs-0"), per_row)
        sections = [worker, runs, cheap, machines(costs, rows, options.cores)]
        if not quick:
            note_progress("a million shapes")
            sections.append(million(place / "million"))
        return sections


def one_worker(folder: Path, rows: int, repeats: int) -> tuple[float, Section]:
    """Bytes of a row, and the table of what a worker does in a second."""
    folder.mkdir()
    plan = Plan(work=loaded(), count=rows, shard_rows=rows)
    columns_of(Plan(work=plan.work, count=128, shard_rows=128), 0)  # kernels from the cache
    made, written, size = [], [], 0
    for _ in range(repeats):
        begin = time.perf_counter()
        columns = columns_of(plan, 0)
        middle = time.perf_counter()
        write(plan, folder, 0, columns)
        made.append(middle - begin)
        written.append(time.perf_counter() - middle)
        size = sum(path.stat().st_size for path in folder.iterdir())
    few = min(rows, 2048)
    lanes = max(rows // 64, 8)
    cold = Plan(work=loaded(chain=1), count=few, shard_rows=few)
    table: list[Row] = [
        {
            "what": "shapes along chains of 64, one thread",
            "rate": rows / min(made),
            "us": 1e6 * min(made) / rows,
        },
        {
            "what": "the same, written to Parquet",
            "rate": rows / (min(made) + min(written)),
            "us": 1e6 * (min(made) + min(written)) / rows,
        },
        {"what": "each row settled cold (chain 1), one thread", **rate(few, lambda: columns_of(cold, 0))},
        {"what": "one batch, solver alone, one thread", **rate(32 * lanes, lambda: solved(lanes, 1))},
    ]
    if cores() > 1:
        table.append(
            {"what": "one batch, solver alone, two threads", **rate(32 * lanes, lambda: solved(lanes, 2))}
        )
    note = (
        "A row: five bends, extension, tip force to 2 EI/l^2, self-weight; boundary within 1e-6 m, six "
        "steps a segment; no points."
    )
    columns_ = [
        Column("what", "one process"),
        Column("rate", "rows/s", ",.0f"),
        Column("us", "us a row", ".1f"),
    ]
    return size / rows, Section("worker", "One worker", columns_, table, [note])


def rate(rows: int, run: Callable[[], object]) -> Row:
    """Rows a second and microseconds a row of one call."""
    begin = time.perf_counter()
    run()
    took = time.perf_counter() - begin
    return {"rate": rows / took, "us": 1e6 * took / rows}


def solved(lanes: int, threads: int) -> None:
    """32 rows of each lane, nothing kept."""
    work = loaded()
    robot = fastrod.model.robotfile.loads(work.robot)
    draw, solver = (
        Draw(work, robot, lanes, np.random.default_rng(0)),
        ChainSolver(robot, lanes, work.points_per_segment, threads),
    )
    for step in range(32):
        drawn = draw.at(step)
        given = Inputs(
            tendon_length=robot.rest_tendon_length + drawn.dl,
            extension=drawn.extension,
            tip_force=drawn.force,
        )
        solver.settle(given, work.tolerance)


def whole_runs(place: Path, rows: int, shards: int, *, ray: bool) -> Section:
    """The same plan through each way of running, from the call to the checked end."""
    plan = Plan(work=loaded(), count=rows * shards, shard_rows=rows)
    ways: list[tuple[str, int, str | None]] = [("processes here", 1, None), ("processes here", 2, None)]
    ways += [("Ray, local cluster", n, "local") for n in (1, 2)] if ray else []
    table: list[Row] = []
    for number, (what, workers, address) in enumerate(ways):
        ticks: list[tuple[float, int]] = []
        begin = time.perf_counter()
        summary = generate(
            plan,
            place / f"runs-{number}",
            workers=workers,
            ray=address,
            progress=lambda _, done, __, ticks=ticks, begin=begin: ticks.append(
                (time.perf_counter() - begin, done)
            ),  # type: ignore[misc]
        )
        first, last = ticks[1], ticks[-1]
        between = (last[1] - first[1]) / (last[0] - first[0])
        table.append(
            {
                "what": what,
                "workers": workers,
                "rows": summary.rows,
                "seconds": summary.seconds,
                "rate": summary.rate,
                "between": between,
                "first": first[0],
                "after": summary.seconds - last[0],
            }
        )
    for row in table:
        alone = next(r for r in table if r["what"] == row["what"])
        row["gain"] = float(row["between"] or 0.0) / float(alone["between"] or 1.0)
    columns = [
        Column("what", "way"),
        Column("workers", "workers"),
        Column("rows", "rows", ",d"),
        Column("seconds", "s in all", ".1f"),
        Column("rate", "rows/s\nin all", ",.0f"),
        Column("between", "rows/s from first\nto last shard", ",.0f"),
        Column("gain", "of one\nworker", ".2f"),
        Column("first", "s to the\nfirst shard", ".1f"),
        Column("after", "s to close\nand check", ".2f"),
    ]
    return Section(
        "runs",
        f"{shards} shards of {rows:,} rows",
        columns,
        table,
        ["The first shard comes after start and one task."],
    )


def nothing(number: int) -> tuple[int, int, int, int]:
    """A task of no work that says as much as a real one."""
    return number, 0, 0, 0


def dispatch_costs(tasks: int, *, ray: bool) -> tuple[float, float, Section]:
    """Seconds a task and to start, of Ray where it is installed, otherwise of processes; and the table."""
    table: list[Row] = []
    begin = time.perf_counter()
    with one_thread(), ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        pool.submit(nothing, 0).result()
        started = time.perf_counter() - begin
        begin = time.perf_counter()
        assert len(list(pool.map(nothing, range(tasks)))) == tasks
        each = (time.perf_counter() - begin) / tasks
    table.append({"what": "process pool", "start": started, "dispatch": 1e3 * each})
    if ray:
        begin = time.perf_counter()
        started, each = _ray_costs(tasks)
        table.append(
            {"what": "Ray, first worker on a cluster that is there", "start": started, "dispatch": 1e3 * each}
        )
        table.append(
            {
                "what": "Ray, with a local cluster",
                "start": time.perf_counter() - begin - tasks * each,
                "dispatch": 1e3 * each,
            }
        )
    columns = [
        Column("what", "driver"),
        Column("start", "s to the first\nresult", ".2f"),
        Column("dispatch", "ms a task", ".3f"),
    ]
    return each, started, Section("dispatch", f"Start and dispatch, {tasks} tasks of no work", columns, table)


def _ray_costs(tasks: int) -> tuple[float, float]:
    """Seconds to the first result and of each task, one worker: submit, wait, get, as `fastrod generate` does
    it."""
    import ray

    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="error")
    try:
        remote = ray.remote(num_cpus=1)(nothing)
        begin = time.perf_counter()
        ray.get(remote.remote(0))
        started = time.perf_counter() - begin
        begin, under_way, number = time.perf_counter(), list[Any](), 0
        while number < tasks or under_way:
            while number < tasks and len(under_way) < 4:
                under_way.append(remote.remote(number))
                number += 1
            ended, under_way = ray.wait(under_way, num_returns=1)
            ray.get(ended)
        return started, (time.perf_counter() - begin) / tasks
    finally:
        ray.shutdown()


def check_cost(folder: Path) -> float:
    """Seconds a row of finding the shards and counting their rows."""
    from fastrod.generation import read_plan

    plan = read_plan(folder)
    assert plan is not None
    took = []
    for _ in range(3):
        begin = time.perf_counter()
        found(plan, folder / SHARDS)
        took.append((time.perf_counter() - begin) + 0.0)
        begin = time.perf_counter()
        counted(plan, folder / SHARDS)
        took[-1] += time.perf_counter() - begin
    return statistics.median(took) / plan.count


def machines(costs: Costs, rows: int, per_machine: int) -> Section:
    """Seconds by the model: start + max(rounds of tasks, dispatch of all) + check."""
    table: list[Row] = []
    for count in (10**6, 10**8, 10**10):
        alone = math.nan
        for n in MACHINES:
            tasks = -(-count // rows)
            working, handing = -(-tasks // (n * per_machine)) * costs.task, tasks * costs.dispatch
            seconds = costs.start + max(working, handing) + count * costs.check
            alone = seconds if n == MACHINES[0] else alone
            table.append(
                {
                    "count": f"{count:,}",
                    "machines": n,
                    "cores": n * per_machine,
                    "tasks": tasks,
                    "seconds": seconds,
                    "rate": count / seconds,
                    "efficiency": alone / seconds / n,
                    "written": 1e-6 * costs.bytes * count / seconds,
                    "bound": _bound(working, handing, count * costs.check),
                }
            )
    most = costs.task / costs.dispatch
    notes = [
        "Model: T = start + max(ceil(tasks / (N c)) task, tasks dispatch) + rows check; besides, only the "
        "folder is shared, at MB/s.",
        f"Measured here: task {costs.task:.2f} s of {rows:,} rows, two workers at work, start "
        f"{costs.start:.2f} s, "
        f"dispatch {1e3 * costs.dispatch:.2f} ms, check {1e9 * costs.check:.0f} ns a row, {costs.bytes:.0f} "
        "bytes a row.",
        f"The driver saturates at task / dispatch = {most:,.0f} cores; longer shards move that up in "
        "proportion.",
        "These are computed, not run: no network, no shared disk and no second machine was measured.",
    ]
    columns = [
        Column("count", "rows"),
        Column("machines", "machines"),
        Column("cores", "cores", ",d"),
        Column("tasks", "tasks", ",d"),
        Column("seconds", "s", ",.1f"),
        Column("rate", "rows/s", ",.0f"),
        Column("efficiency", "of N times one", ".2f"),
        Column("written", "MB/s written", ",.0f"),
        Column("bound", "most of it"),
    ]
    return Section("machines", f"N machines of {per_machine} cores, computed", columns, table, notes)


def _bound(working: float, handing: float, checking: float) -> str:
    longest = max(working, handing)
    return "check" if checking > longest else "dispatch" if handing > working else "work"


def million(folder: Path) -> Section:
    """The acceptance: a million loaded five-segment shapes on two cores."""
    summary = generate(Plan(work=loaded(), count=10**6), folder, workers=2)
    row: Row = {
        "rows": summary.rows,
        "failed": summary.failed,
        "seconds": summary.seconds,
        "rate": summary.rate,
        "mb": 1e-6 * summary.bytes,
        "target": TARGET,
        "met": summary.seconds <= TARGET,
    }
    columns = [
        Column("rows", "rows", ",d"),
        Column("failed", "not ok", ",d"),
        Column("seconds", "s", ".1f"),
        Column("rate", "rows/s", ",.0f"),
        Column("mb", "MB", ",.0f"),
        Column("target", "target s", ".0f"),
        Column("met", "met"),
    ]
    note = (
        "From the call to the end of the check, start of the processes included; each row index is there "
        "once."
    )
    return Section("million", "A million loaded five-segment shapes, two workers", columns, [row], [note])


def main(argv: Sequence[str] | None = None) -> int:
    """As a script and for `fastrod bench generate`."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--cores", type=int, default=16, help="of a machine, in the table of N machines (default: 16)"
    )
    return command(parser, argv, measure)


if __name__ == "__main__":
    sys.exit(main())
