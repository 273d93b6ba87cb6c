"""The rod solver's figures: `fastrod bench rod`, or this file as a script; `--json` for programs, `--quick` for a smoke run."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence

import report


def sections(quick: bool) -> list[report.Section]:
    """All tables, measured one after the other in this process (memory and start: in processes of their own)."""
    import cantilever
    import fresh
    import integrators
    import passes
    import solves

    n_robots = 256 if quick else 8192
    timed = passes.measure(n_robots, rounds=1 if quick else 3)
    paths = [solves.make_path(model) for model in ("paper", "full")]
    return [
        passes.time_section(timed, n_robots),
        passes.lag_section(timed),
        passes.arithmetic_section(timed, n_robots),
        solves.solve_section(paths, 512 if quick else n_robots, quick),
        solves.path_section(paths, 10 if quick else 60),
        integrators.section(512 if quick else n_robots, quick),
        cantilever.section(quick),
        fresh.memory_section(5_000 if quick else 100_000),
        fresh.start_section(quick),
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; the exit code."""
    parser = argparse.ArgumentParser(prog="bench_rod", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.add_argument("--quick", action="store_true", help="small batches, one round: does it run? Its figures mean little")
    options = parser.parse_args(argv)
    start, load = time.perf_counter(), os.getloadavg()[0]  # other work on the machine spoils the figures of two threads first
    measured = sections(options.quick)
    machine = {
        **report.machine(),
        "load_before": f"{load:.2f}",
        "load_after": f"{os.getloadavg()[0]:.2f}",
        "seconds": f"{time.perf_counter() - start:.0f}",
        "quick": str(options.quick).lower(),
    }
    if options.json:
        print(json.dumps({"machine": machine, "sections": {section.key: section.as_json() for section in measured}}))
    else:
        report.show(measured, ", ".join(f"{key} {value}" for key, value in machine.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
