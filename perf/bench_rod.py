"""The rod solver's figures: `fastrod bench rod`, or this file as a script; `--json` for programs, `--quick`
for a smoke run."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import report


def sections(quick: bool) -> list[report.Section]:
    """All tables, measured one after the other in this process (memory and start: in processes of their
    own)."""
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
    return report.command(
        argparse.ArgumentParser(prog="bench_rod", description=__doc__),
        argv,
        lambda options: sections(options.quick),
    )


if __name__ == "__main__":
    sys.exit(main())
