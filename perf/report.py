"""What a benchmark prints: tables for people, the same rows as JSON for programs; and how time is taken."""

from __future__ import annotations

import argparse
import gc
import json
import math
import os
import platform
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

Value = float | int | str | bool | None
Result = TypeVar("Result")
Row = dict[str, Value]
_WIDTH = 166  # characters of the widest table; a narrower terminal wraps its lines but loses nothing


@dataclass(frozen=True)
class Column:
    """One column of a table: its key in a row, its heading, and the format of its values."""

    key: str
    head: str
    form: str = ""


@dataclass
class Section:
    """One table: what was measured, and what must be known to read it."""

    key: str
    title: str
    columns: Sequence[Column]
    rows: list[Row]
    notes: list[str] = field(default_factory=list)

    def as_json(self) -> Mapping[str, object]:
        meaning = {column.key: column.head.replace("\n", " ") for column in self.columns}
        rows = [{key: _plain(value) for key, value in row.items()} for row in self.rows]
        return {"title": self.title, "columns": meaning, "rows": rows, "notes": self.notes}


def _plain(value: Value) -> Value:
    """JSON knows neither nan nor infinity."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def show(sections: Sequence[Section], head: str) -> None:
    """Print the tables."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    console.width = max(console.width, _WIDTH)
    console.print(head, highlight=False)
    for section in sections:
        table = Table(title=section.title, title_justify="left", title_style="bold")
        for i, column in enumerate(section.columns):
            table.add_column(Text(column.head), justify="left" if i == 0 else "right", no_wrap=True)
        for row in section.rows:
            table.add_row(*(Text(_text(row.get(column.key), column.form)) for column in section.columns))
        console.print()
        console.print(table)
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
    """What the figures were measured on."""
    import numba
    import numpy
    import scipy

    model = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as lines:  # noqa: PTH123
            model = next(
                (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), model
            )
    except OSError:
        pass
    versions = (
        f"Python {platform.python_version()}, numpy {numpy.__version__}, numba {numba.__version__}, "
        f"scipy {scipy.__version__}"
    )
    return {"cpu": model, "cores": str(numba.config.NUMBA_NUM_THREADS), "versions": versions}


def thread_counts() -> tuple[int, int]:
    """One thread, and two where the machine has them."""
    import numba

    config: object = numba.config
    return 1, min(2, int(getattr(config, "NUMBA_NUM_THREADS", 1)))


def seconds(
    run: Callable[[], Result], clock: Callable[[], float] = time.perf_counter
) -> tuple[float, Result]:
    """Time of one call by `clock` [s], wall time by default, without the collector of garbage, and what it
    returned."""
    gc.disable()
    try:
        start = clock()
        result = run()
        return clock() - start, result
    finally:
        gc.enable()


def best(run: Callable[[], object], repeats: int) -> float:
    """Least wall time of several calls [s]: what the machine can do when nothing else wants it."""
    return min((seconds(run)[0] for _ in range(repeats)), default=math.nan)


def command(
    parser: argparse.ArgumentParser,
    argv: Sequence[str] | None,
    measure: Callable[[argparse.Namespace], Sequence[Section]],
) -> int:
    """A benchmark's command line: `--json`, `--quick` and what `parser` has besides; measure, print, and the
    exit code."""
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.add_argument(
        "--quick", action="store_true", help="little of everything: does it run? Its figures mean little"
    )
    options = parser.parse_args(argv)
    # other work on the machine spoils figures, of two threads first
    start, load = time.perf_counter(), os.getloadavg()[0]
    measured = measure(options)
    head = {
        **machine(),
        "load_before": f"{load:.2f}",
        "load_after": f"{os.getloadavg()[0]:.2f}",
        "seconds": f"{time.perf_counter() - start:.0f}",
        "quick": str(options.quick).lower(),
    }
    if options.json:
        print(
            json.dumps(
                {"machine": head, "sections": {section.key: section.as_json() for section in measured}}
            )
        )
    else:
        show(measured, ", ".join(f"{key} {value}" for key, value in head.items()))
    return 0
