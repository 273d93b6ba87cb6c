"""The one runner of the benchmarks: takes times, prints tables for people and the same rows as JSON.

A benchmark is a file `bench_NAME.py` with `main = report.bench(__doc__, measure, ...)`; `measure` returns
tables.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared"
sys.path += [str(ROOT / "tests"), str(ROOT / "tests" / "truth")]  # what benchmarks and checks share

Value = float | int | str | bool | None
Row = dict[str, Value]
# characters of the widest table, whose words wrap; a narrower terminal wraps its lines but loses nothing
_WIDTH = 166


class Column(NamedTuple):
    """One column of a table: its key in a row, its heading, and the format of its values."""

    key: str
    head: str
    form: str = ""


def columns(text: str) -> list[Column]:
    """Columns written as `key:format heading` between bars; `~` breaks a heading's line."""
    found = []
    for one in text.split("|"):
        name, _, head = one.strip().partition(" ")
        key, _, form = name.partition(":")
        found.append(Column(key, head.strip().replace("~", "\n") or key, form))
    return found


@dataclass
class Section:
    """One table: what was measured, and what must be known to read it."""

    key: str
    title: str
    columns: Sequence[Column]
    rows: list[Row]
    notes: list[str] = field(default_factory=list)
    failed: bool = False  # a check in which something is not as it must be: the exit code is then 1

    def as_json(self) -> dict[str, object]:
        """Return the section as JSON knows it, which knows neither nan nor infinity."""
        meaning = {column.key: column.head.replace("\n", " ") for column in self.columns}
        rows = [
            {key: None if isinstance(x, float) and not math.isfinite(x) else x for key, x in row.items()}
            for row in self.rows
        ]
        return {"title": self.title, "columns": meaning, "rows": rows, "notes": self.notes}


def table(key: str, title: str, text: str, rows: Iterable[Row], *notes: str, failed: bool = False) -> Section:
    """A table whose columns are written as in `columns`; numbers of numpy become Python's."""
    plain = [{name: x.item() if hasattr(x, "item") else x for name, x in row.items()} for row in rows]
    return Section(key, title, columns(text), plain, list(notes), failed)


def goal(value: float, target: float, *, least: bool = False, name: str = "") -> Row:
    """A target beside its figure, and whether it is met: at most `target`, or at `least` that much."""
    met = value >= target if least else value <= target
    return {f"{name}target": target, f"{name}met": bool(met)}


def show(sections: Sequence[Section], head: str) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    console.width = max(console.width, _WIDTH)
    console.print(head, highlight=False)
    for section in sections:
        made = Table()
        for i, column in enumerate(section.columns):
            number = not any(isinstance(row.get(column.key), str) for row in section.rows)
            made.add_column(Text(column.head), justify="left" if i == 0 else "right", no_wrap=number)
        for row in section.rows:
            made.add_row(*(Text(_text(row.get(column.key), column.form)) for column in section.columns))
        console.print(Text(f"\n{section.title}"), style="bold", highlight=False)
        console.print(made)
        for note in section.notes:
            console.print(Text(note), style="dim", highlight=False)


def _text(value: Value, form: str) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return value if isinstance(value, str) else format(value, form)


def note_progress(what: str) -> None:
    """Say on stderr what is being measured, where somebody looks on."""
    if sys.stderr.isatty():
        print(f"measuring: {what}", file=sys.stderr, flush=True)


def machine() -> dict[str, str]:
    """Return what the figures were measured on."""
    import numba
    import numpy
    import scipy

    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.exists() else []
    model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
    libraries = ", ".join(f"{one.__name__} {one.__version__}" for one in (numpy, numba, scipy))
    return {
        "cpu": model or platform.processor() or platform.machine(),
        "cores": str(numba.config.NUMBA_NUM_THREADS),
        "versions": f"Python {platform.python_version()}, {libraries}",
    }


def thread_counts() -> tuple[int, int]:
    """One thread, and two where the machine has them."""
    import numba

    return 1, min(2, int(numba.config.NUMBA_NUM_THREADS))


class Measurement:
    """Times of one thing by `clock` [s], wall time by default."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.clock, self.times = clock, list[float]()

    def take(self, run: Callable[[], Any]) -> Any:
        """Return what one call returns, timed without the collector of garbage."""
        gc.disable()
        try:
            start = self.clock()
            result = run()
            self.times.append(self.clock() - start)
            return result
        finally:
            gc.enable()

    @property
    def least(self) -> float:
        return min(self.times, default=math.nan)

    @property
    def median(self) -> float:
        return statistics.median(self.times)

    def quantile(self, q: float) -> float:
        import numpy

        return float(numpy.quantile(self.times, q))


def alternate(runs: Sequence[Callable[[], Any]], rounds: int) -> list[Measurement]:
    """Call all of `runs` once a round, so that what else the machine does meets each of them alike."""
    found = [Measurement() for _ in runs]
    for _ in range(rounds):
        for measurement, run in zip(found, runs, strict=True):
            measurement.take(run)
    return found


def seconds(run: Callable[[], Any]) -> tuple[float, Any]:
    """Wall time of one call [s], and what it returned."""
    taken = Measurement()
    result = taken.take(run)
    return taken.least, result


def best(run: Callable[[], object], repeats: int) -> float:
    """Least wall time of several calls [s]."""
    return alternate([run], repeats)[0].least


def in_fresh_process(file: str, given: Any, **environment: str) -> Any:
    """Return what a script prints as JSON, given this as JSON on its standard input."""
    env, words = {**os.environ, **environment}, json.dumps(given)
    done = subprocess.run(
        [sys.executable, file], input=words, stdout=subprocess.PIPE, text=True, check=True, env=env
    )
    return json.loads(done.stdout)


Option = tuple[str, Any, str]
"""`--name`, its default (or a type, where there is none; False for a switch; a list of choices), and its
help."""


def bench(
    doc: str | None, measure: Callable[[argparse.Namespace], Sequence[Section]], *options: Option
) -> Callable[[Sequence[str] | None], int]:
    """The `main` of a benchmark, with `--json`, `--quick` and these options; where `measure` is of the script
    that runs, its exit."""

    def main(argv: Sequence[str] | None = None) -> int:
        form = argparse.RawDescriptionHelpFormatter
        parser = argparse.ArgumentParser(description=doc, formatter_class=form)
        common = ("--json", False, "print one JSON object and nothing else"), ("--quick", False, _QUICK)
        for name, default, words in (*options, *common):
            if default is False:
                parser.add_argument(name, action="store_true", help=words)
            elif isinstance(default, list):
                parser.add_argument(name, choices=default, help=words)
            elif isinstance(default, tuple):
                parser.add_argument(name, nargs="+", type=default[0], help=words)
            elif isinstance(default, type):
                parser.add_argument(name, type=default, metavar=name[2:].upper(), help=words)
            else:
                words += " (default: %(default)s)"
                parser.add_argument(name, type=type(default), default=default, help=words)
        return _run(measure, parser.parse_args(argv))

    if measure.__module__ == "__main__":
        sys.exit(main())
    return main


_QUICK = "little of everything: figures mean little"


def _run(measure: Callable[[argparse.Namespace], Sequence[Section]], options: argparse.Namespace) -> int:
    """Measure and print; the exit code."""
    from fastrod.errors import FastrodError

    # other work on the machine spoils figures, of two threads first
    start, load = time.perf_counter(), os.getloadavg()[0]
    try:
        measured = measure(options)
    except FastrodError as error:
        print(error, file=sys.stderr)
        return 2
    head = {**machine(), "load_before": f"{load:.2f}", "load_after": f"{os.getloadavg()[0]:.2f}"}
    head |= {"seconds": f"{time.perf_counter() - start:.0f}", "quick": str(options.quick).lower()}
    if options.json:
        made = {section.key: section.as_json() for section in measured}
        print(json.dumps({"machine": head, "sections": made}))
    else:
        show(measured, ", ".join(f"{key} {value}" for key, value in head.items()))
    return int(any(section.failed for section in measured))
