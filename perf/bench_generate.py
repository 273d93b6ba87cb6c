"""Data sets: one worker, two, Ray tasks, start and dispatch; and from these the rate of N machines."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import fastrod
from fastrod.generation import Plan, Shapes, generate, read_plan
from fastrod.generation.here import cores, one_thread
from fastrod.generation.plan import SHARDS
from fastrod.generation.shapes import ChainSolver, Draw
from fastrod.generation.shards import counted, found, write
from fastrod.generation.tasks import columns_of
from fastrod.model.robotfile import dumps
from fastrod.solver.inputs import Inputs
from report import Measurement, Row, Section, bench, goal, note_progress, seconds, table

DENSITY = 0.005  # kg/m: the weight bends the rod as much as a tip force of EI/l^2
MACHINES = (1, 2, 8, 32, 128)
TARGET = 60.0  # s for a million shapes on two cores


class Costs(NamedTuple):
    """Measured costs from which the table of N machines is computed."""

    task: float  # of one worker for one shard, written [s]
    start: float  # until the first worker begins, the cluster being there [s]
    dispatch: float  # of the driver for one task [s]
    check: float  # of the driver at the end, a row [s]
    bytes: float  # of a row on the disk


def loaded(**options: Any) -> Shapes:
    """The five-segment reacher with a weight, tip forces as by default."""
    robot = fastrod.load_robot("five_segment_reacher")
    segments = tuple(replace(segment, line_density=DENSITY) for segment in robot.segments)
    return Shapes(robot=dumps(replace(robot, segments=segments)), **options)


def measure(options: Any) -> list[Section]:
    quick, ray = options.quick, find_spec("ray") is not None
    rows = 512 if quick else Plan(work=loaded(), count=1).shard_rows
    with tempfile.TemporaryDirectory(prefix="fastrod-bench-") as folder:
        place = Path(folder)
        note_progress("one worker")
        per_row, worker = one_worker(place / "one", rows, 1 if quick else 3)
        note_progress("runs")
        runs = whole_runs(place, rows, 4 if quick else 10, ray=ray)
        note_progress("dispatch")
        dispatch, start, cheap = dispatch_costs(20 if quick else 400, ray=ray)
        two = next(row for row in runs.rows if row["workers"] == 2)
        task = 2.0 * rows / two["between"]  # cores that all work are slower than one alone
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
    made, written = Measurement(), Measurement()
    for _ in range(repeats):
        columns = made.take(partial(columns_of, plan, 0))
        written.take(partial(write, plan, folder, 0, columns))
    size = sum(path.stat().st_size for path in folder.iterdir())
    few, lanes = min(rows, 2048), max(rows // 64, 8)
    cold = Plan(work=loaded(chain=1), count=few, shard_rows=few)
    times = {
        "shapes along chains of 64, one thread": (rows, made.least),
        "the same, written to Parquet": (rows, made.least + written.least),
        "each row settled cold (chain 1), one thread": (few, seconds(lambda: columns_of(cold, 0))[0]),
        "one batch, solver alone, one thread": (32 * lanes, seconds(lambda: solved(lanes, 1))[0]),
    }
    if cores() > 1:
        times["one batch, solver alone, two threads"] = 32 * lanes, seconds(lambda: solved(lanes, 2))[0]
    return size / rows, table(
        "worker",
        "One worker",
        "what one process | rate:,.0f rows/s | us:.1f us a row",
        ({"what": what, "rate": n / took, "us": 1e6 * took / n} for what, (n, took) in times.items()),
        "A row: five bends, extension, tip force to 2 EI/l^2, self-weight; boundary within 1e-6 m, six steps "
        "a segment; no points.",
    )


def solved(lanes: int, threads: int) -> None:
    """32 rows of each lane, nothing kept."""
    work = loaded()
    robot = fastrod.model.robotfile.loads(work.robot)
    draw = Draw(work, robot, lanes, np.random.default_rng(0))
    solver = ChainSolver(robot, lanes, work.points_per_segment, threads)
    for step in range(32):
        drawn = draw.at(step)
        length = robot.rest_tendon_length + drawn.dl
        given = Inputs(tendon_length=length, extension=drawn.extension, tip_force=drawn.force)
        solver.settle(given, work.tolerance)


def whole_runs(place: Path, rows: int, shards: int, *, ray: bool) -> Section:
    """The same plan on processes and on Ray, from the call to the checked end."""
    plan = Plan(work=loaded(), count=rows * shards, shard_rows=rows)
    kinds = [("processes here", None), ("Ray, local cluster", "local")][: 2 if ray else 1]
    made, alone = list[Row](), math.nan
    for number, ((what, address), workers) in enumerate(product(kinds, (1, 2))):
        ticks: list[tuple[float, int]] = []
        begin = time.perf_counter()

        def tick(_: Any, done: int, __: Any, ticks: Any = ticks, begin: float = begin) -> None:
            ticks.append((time.perf_counter() - begin, done))

        summary = generate(plan, place / f"runs-{number}", workers=workers, ray=address, progress=tick)
        first, last = ticks[1], ticks[-1]
        between = (last[1] - first[1]) / (last[0] - first[0])
        alone = between if workers == 1 else alone
        row: Row = {"what": what, "workers": workers, "rows": summary.rows, "seconds": summary.seconds}
        row |= {"rate": summary.rate, "between": between, "gain": between / alone, "first": first[0]}
        made.append(row | {"after": summary.seconds - last[0]})
    return table(
        "runs",
        f"{shards} shards of {rows:,} rows",
        "what run on | workers | rows:,d | seconds:.1f s in all | rate:,.0f rows/s~in all"
        "| between:,.0f rows/s from first~to last shard | gain:.2f of one~worker | first:.1f s to the~first "
        "shard| after:.2f s to close~and check",
        made,
        "The first shard comes after start and one task.",
    )


def nothing(number: int) -> tuple[int, int, int, int]:
    return number, 0, 0, 0  # as much as a real task returns


@contextmanager
def _processes() -> Iterator[Any]:
    with one_thread(), ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        yield lambda tasks: list(pool.map(nothing, range(tasks)))


@contextmanager
def _ray() -> Iterator[Any]:
    """One worker: submit, wait, get, as `fastrod generate` does it."""
    import ray

    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="error")
    remote = ray.remote(num_cpus=1)(lambda number: (number, 0, 0, 0))  # no name that a worker would import

    def run(tasks: int) -> None:
        pending, number = list[Any](), 0
        while number < tasks or pending:
            while number < tasks and len(pending) < 4:
                pending.append(remote.remote(number))
                number += 1
            ended, pending = ray.wait(pending, num_returns=1)
            ray.get(ended)

    try:
        yield run
    finally:
        ray.shutdown()


def dispatch_costs(tasks: int, *, ray: bool) -> tuple[float, float, Section]:
    """Seconds a task and to start, of Ray where it is installed, otherwise of processes; and the table."""
    made: list[Row] = []
    for what, opened in (("process pool", _processes), ("Ray", _ray))[: 2 if ray else 1]:
        begin = time.perf_counter()
        with opened() as run:
            cluster = time.perf_counter() - begin
            first, _ = seconds(partial(run, 1))
            each = seconds(partial(run, tasks))[0] / tasks
        starts = {f"{what}{', with a local cluster' * (what == 'Ray')}": cluster + first}
        if what == "Ray":
            starts = {"Ray, first worker on a cluster that is there": first, **starts}
        made += [{"what": name, "start": start, "dispatch": 1e3 * each} for name, start in starts.items()]
        started = next(iter(starts.values()))
    text = "what driver | start:.2f s to the first~result | dispatch:.3f ms a task"
    return each, started, table("dispatch", f"Start and dispatch, {tasks} tasks of no work", text, made)


def check_cost(folder: Path) -> float:
    """Seconds a row of finding the shards and counting their rows."""
    plan = read_plan(folder)
    assert plan is not None
    shards, took = folder / SHARDS, Measurement()
    for _ in range(3):
        took.take(lambda: (found(plan, shards), counted(plan, shards)))
    return took.median / plan.count


def machines(costs: Costs, rows: int, per_machine: int) -> Section:
    """Seconds by the model: start + max(rounds of tasks, dispatch of all) + check."""
    made: list[Row] = []
    for count in (10**6, 10**8, 10**10):
        alone = math.nan
        for n in MACHINES:
            tasks, checking = -(-count // rows), count * costs.check
            working, handing = -(-tasks // (n * per_machine)) * costs.task, tasks * costs.dispatch
            took = costs.start + max(working, handing) + checking
            alone = took if n == MACHINES[0] else alone
            row: Row = {"count": f"{count:,}", "machines": n, "cores": n * per_machine, "tasks": tasks}
            row |= {"seconds": took, "rate": count / took, "efficiency": alone / took / n}
            bounds = {"work": working, "dispatch": handing, "check": checking}
            row |= {"written": 1e-6 * costs.bytes * count / took}
            made.append(row | {"bound": max(bounds, key=bounds.__getitem__)})
    return table(
        "machines",
        f"N machines of {per_machine} cores, computed",
        "count rows | machines | cores:,d | tasks:,d | seconds:,.1f s | rate:,.0f rows/s"
        "| efficiency:.2f of N times one | written:,.0f MB/s written | bound most of it",
        made,
        "Model: T = start + max(ceil(tasks / (N c)) task, tasks dispatch) + rows check; besides, only the "
        "folder is common, at MB/s.",
        f"Measured here: task {costs.task:.2f} s of {rows:,} rows, two workers at work, start "
        f"{costs.start:.2f} s, dispatch {1e3 * costs.dispatch:.2f} ms, check {1e9 * costs.check:.0f} ns a "
        f"row, {costs.bytes:.0f} bytes a row.",
        f"The driver saturates at task / dispatch = {costs.task / costs.dispatch:,.0f} cores; longer shards "
        "move that up in proportion. These are computed, not run: no network, no common disk and no second "
        "machine was measured.",
    )


def million(folder: Path) -> Section:
    summary = generate(Plan(work=loaded(), count=10**6), folder, workers=2)
    row: Row = {name: getattr(summary, name) for name in ("rows", "failed", "seconds", "rate")}
    return table(
        "million",
        "A million loaded five-segment shapes, two workers",
        "rows:,d | failed:,d not ok | seconds:.1f s | rate:,.0f rows/s | mb:,.0f MB | target:.0f target s | "
        "met",
        [{**row, "mb": 1e-6 * summary.bytes, **goal(summary.seconds, TARGET)}],
        "From the call to the end of the check, start of the processes included; each row index is there "
        "once.",
    )


main = bench(__doc__, measure, ("--cores", 16, "of a machine, in the table of N machines"))
