"""Files from strangers by the thousand: each damaged, hostile or fine, and given to what reads it.

File number k is the same for the same seed (`tests/fuzz/fuzz_seeds.py` makes it). It is read right, or
refused in one sentence with exit code 2; anything else is counted in a column of its own and listed by
number, which `--only K` reads again. Exit code 1 where any file was neither.
"""

from __future__ import annotations

import math
import multiprocessing
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from report import ROOT, Row, Section, bench, note_progress, table

sys.path.append(str(ROOT / "tests" / "fuzz"))
from fuzz_read import FINE, WRONG, Outcome, try_file, warm
from fuzz_seeds import KINDS, Originals

_STUCK = 40.0  # seconds after which a worker is ended, on a machine that does other things too


def work(indices: Sequence[int], seed: int, ends: Connection) -> None:
    """Work as a worker process: an index before each file, its outcome after it."""
    with tempfile.TemporaryDirectory() as folder:
        originals = Originals()
        warm(Path(folder), originals)
        for index in indices:
            ends.send(index)
            ends.send(try_file(index, seed, Path(folder), originals))
    ends.close()


class Worker:
    """A process that tries files one after another, started anew after one that it did not survive."""

    def __init__(self, todo: list[int], seed: int) -> None:
        self.todo, self.seed = todo, seed
        self.start()

    def start(self) -> None:
        context = multiprocessing.get_context("spawn")  # numba's threads do not survive a fork
        self.ends, there = context.Pipe(duplex=False)
        self.process = context.Process(target=work, args=(list(self.todo), self.seed, there))
        self.process.start()
        there.close()
        self.at, self.since = -1, time.monotonic()

    def stuck(self) -> bool:
        return self.at >= 0 and time.monotonic() - self.since > _STUCK

    def receive(self) -> Iterator[Outcome]:
        """Return what it sends, or what is left of it."""
        try:
            got: Any = self.ends.recv()
        except EOFError:
            self.process.join()
            if self.todo:
                yield self.lost("died", f"exit code {self.process.exitcode}", 0.0)
            return
        self.at, self.since = -1 if isinstance(got, Outcome) else got, time.monotonic()
        if isinstance(got, Outcome):
            self.todo.remove(got.index)
            yield got

    def end(self) -> Outcome:
        self.process.kill()
        self.process.join()
        self.ends.close()
        return self.lost("over time", f"ended after {_STUCK:g} s", math.inf)

    def lost(self, verdict: str, said: str, seconds: float) -> Outcome:
        """The file that it was at, and a new process for the others."""
        index = self.at if self.at >= 0 else self.todo[0]
        self.todo.remove(index)
        if self.todo:
            self.start()
        head: Any = {"index": index, "kind": KINDS[index % len(KINDS)], "attack": "?", "memory": 0}
        return Outcome(**head, verdict=verdict, said=said, seconds=seconds)


def run(indices: Sequence[int], seed: int, workers: int) -> Iterator[Outcome]:
    """Outcomes as they come, from so many processes; one that is stuck or dies is counted and replaced."""
    every = [Worker(list(indices[k::workers]), seed) for k in range(workers) if indices[k::workers]]
    while live := {worker.ends: worker for worker in every if worker.todo}:
        for ready in wait(list(live), timeout=1.0):
            yield from live[ready].receive()
        for worker in live.values():
            if worker.todo and worker.stuck():
                yield worker.end()
    for worker in every:
        worker.process.join()


def figures(outcomes: Sequence[Outcome]) -> list[Row]:
    """Counts, longest time [s] and largest memory [GB] by kind, and of all."""
    rows = []
    for kind in (*KINDS, "all"):
        group = [o for o in outcomes if kind in (o.kind, "all")]
        counts = Counter(o.verdict for o in group)
        row: Row = {"kind": kind, "files": len(group), **{name: counts[name] for name in (*FINE, *WRONG)}}
        row["longest s"] = max((o.seconds for o in group), default=0.0)
        rows.append(row | {"largest GB": max((o.memory for o in group), default=0) / 1e9})
    return rows


def measure(options: Any) -> list[Section]:
    outcomes, count = [], 2 * len(KINDS) if options.quick else options.count
    for outcome in run(options.only or range(count), options.seed, options.workers):
        outcomes.append(outcome)
        note_progress(f"{len(outcomes)} files")
        if outcome.verdict not in FINE or options.only:
            words = f"file {outcome.index}, {outcome.kind}, {outcome.attack}: {outcome.verdict}: "
            print(words + outcome.said.strip()[-2000:], file=sys.stderr, flush=True)
    rows = figures(outcomes)
    seen = [name for name in (*FINE, *WRONG) if name in FINE or rows[-1][name]]
    keyed = [{name.replace(" ", "_"): value for name, value in row.items()} for row in rows]
    text = "kind | files:d | " + " | ".join(f"{name.replace(' ', '_')}:d {name}" for name in seen)
    text += " | longest_s:.2f longest~s | largest_GB:.2f largest~GB"
    failed = any(o.verdict not in FINE for o in outcomes)
    return [table("files", f"Files from strangers, seed {options.seed}", text, keyed, failed=failed)]


main = bench(
    __doc__,
    measure,
    ("--count", 2000, "files"),
    ("--seed", 1, "of all files"),
    ("--workers", 2, "processes"),
    ("--only", (int,), "these files alone, by number, each with what was said"),
)
