"""How often the missing effect is named: sealed logs of a plant that shares no code with the model, opened
after the verdict.

fastrod bench attribution                      all cases, about half an hour on two cores
python perf/bench_attribution.py --share 0.1   a tenth of them; --only single,none
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "truth"))

NOISE = 3e-4  # m
FIRST_SEED = 1000  # rules were set while looking at these; other seeds are a fairer test
COUNTS = {
    "single": 200,
    "none": 100,
    "outside": 60,
    "two": 60,
    "dominant": 40,
    "deleted": 60,
    "operator": 50,
    "noise": 24,
    "segments": 26,
}
GOALS = {
    "single": ">= 95 % right effect first; held-out <= 1.15 x floor",
    "none": ">= 98 % verdict none",
    "outside": ">= 90 % not_in_library",
    "two": ">= 90 % both named, up to class",
    "dominant": ">= 88 % dominant first, up to class",
    "deleted": "<= 15 % a sibling called the explanation that leaves > 15 % of the error",
    "operator": "<= 3 % a confident wrong name",
    "noise": "0.1 and 1 mm of noise",
    "segments": "two segments",
}


@dataclass(frozen=True)
class Case:
    kind: str
    seed: int
    what: str


def cases(share: float, only: Iterable[str], first_seed: int = FIRST_SEED) -> list[Case]:
    """The list of sealed logs; a case draws its parameters from its seed alone."""
    import plant

    made = []
    for kind, count in COUNTS.items():
        if only and kind not in only:
            continue
        names = {
            "outside": plant.OUTSIDE,
            "none": ("none",),
            "two": ("two",),
            "dominant": ("dominant",),
            "segments": plant.library(2),
        }.get(kind, plant.library(1))
        made += [
            Case(kind, first_seed + i, names[i % len(names)]) for i in range(max(1, round(share * count)))
        ]
    return sorted(made, key=lambda case: (case.seed, case.kind))  # a run that is stopped has some of each


def run(case: Case) -> dict[str, Any]:
    """Simulate, identify, and only then open the seal."""
    import plant

    import fastrod
    from fastrod.identification.attribution import identify
    from fastrod.identification.excite import excitation
    from fastrod.logs.runlog import RunLog

    segments = 2 if case.kind == "segments" else 1
    robot = fastrod.load_robot("prototype") if segments == 1 else two_segments()
    if case.kind == "operator":
        import numpy as np

        inputs = plant.operator_inputs(np.random.default_rng(case.seed), segments)
        n = len(inputs.t)
        log = RunLog(
            name="operator", t=inputs.t, run=np.full(n, ""), dl=inputs.dl, tip_position=np.zeros((n, 3))
        )
    else:
        log = excitation(robot, seed=case.seed).log
        inputs = plant.Inputs(log.t, log.dl, log.payload, log.base_quaternion)
    if case.kind == "two":
        seal = plant.draw_pair(case.seed)
    elif case.kind == "dominant":
        seal = plant.draw_many(case.seed, inputs)
    else:
        seal = plant.draw(case.seed, case.what, segments=segments)
    noise = NOISE if case.kind != "noise" else (1e-4, 1e-3)[case.seed % 2]
    log = replace(log, tip_position=plant.measure(inputs, seal, noise=noise))
    exclude = list(seal.effects) if case.kind == "deleted" else []
    clock = time.perf_counter()
    result = identify(log, robot, exclude=exclude, free_camera=case.kind == "operator", threads=1)
    return {
        "case": case.kind,
        "seed": case.seed,
        "true": list(seal.effects),
        "verdict": result.verdict,
        "kind": result.remaining_kind,
        "named": [e.name for e in result.effects],
        "classes": [list(e.cannot_be_told_from) for e in result.effects],
        "before": result.test.before,
        "after": result.test.after,
        "floor": result.noise.floor,
        "bounds": len(result.bounds),
        "left": result.remaining_share,
        "seconds": time.perf_counter() - clock,
        "rows": len(log),
    }


def two_segments() -> Any:
    """The plant's longer robot: the prototype twice, the distal wires at 45 degrees."""
    import math

    import fastrod

    first = fastrod.load_robot("prototype").segments[0]
    turned = tuple(replace(t, angle=float(t.angle) + math.pi / 4.0) for t in first.tendons)
    return fastrod.Robot(name="two_segments", segments=(first, replace(first, tendons=turned)))


def _safely(case: Case) -> dict[str, Any]:
    try:
        return run(case)
    except Exception as error:  # a crash is a wrong answer, and must not stop the others
        return {
            "case": case.kind,
            "seed": case.seed,
            "true": [case.what],
            "error": f"{type(error).__name__}: {error}",
        }


def first_right(row: dict[str, Any]) -> bool:
    return bool(row["named"]) and row["named"][0] == row["true"][0]


def up_to_class(row: dict[str, Any], name: str) -> bool:
    return any(name == n or name in c for n, c in zip(row["named"], row["classes"], strict=True))


def leaves(row: dict[str, Any]) -> float:
    """Share of the held-out error above the noise that is left."""
    return float((row["after"] - row["floor"]) / max(row["before"] - row["floor"], 1e-9))


def score(kind: str, row: dict[str, Any]) -> bool:
    """Whether a row is as the goal wants it."""
    if "error" in row:
        return False
    true = row["true"]
    if kind == "none":
        return bool(row["verdict"] == "none")
    if kind == "outside":
        return bool(row["verdict"] == "not_in_library")
    if kind == "two":
        return all(up_to_class(row, name) for name in true)
    if kind == "dominant":
        return bool(row["named"]) and (row["named"][0] == true[0] or true[0] in row["classes"][0])
    if kind == "deleted":
        return not (row["named"] and row["verdict"] in ("explained", "ambiguous") and leaves(row) > 0.15)
    if kind == "operator":
        return not (row["verdict"] == "explained" and row["named"][0] != true[0])
    return first_right(row)


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    import numpy as np

    table = []
    for kind in COUNTS:
        own = [r for r in rows if r["case"] == kind]
        if not own:
            continue
        whole = [r for r in own if "error" not in r]
        ratio = [r["after"] / r["floor"] for r in whole if r["named"]]
        table.append(
            {
                "case": kind,
                "logs": len(own),
                "as_wanted": sum(score(kind, r) for r in own) / len(own),
                "goal": GOALS[kind],
                "crashed": len(own) - len(whole),
                "verdicts": dict(Counter(r["verdict"] for r in whole)),
                "after_over_floor_median": float(np.median(ratio)) if ratio else None,
                "after_within_1.15": float(np.mean(np.array(ratio) <= 1.15)) if ratio else None,
                "before_mm_median": float(np.median([1e3 * r["before"] for r in whole])) if whole else None,
                "after_mm_median": float(np.median([1e3 * r["after"] for r in whole])) if whole else None,
                "seconds_median": float(np.median([r["seconds"] for r in whole])) if whole else None,
            }
        )
    return table


def confusion(rows: list[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """True effect -> what was named first (or the verdict where nothing was) -> logs, of the single, noise
    and outside cases."""
    table: dict[str, Counter[str]] = {}
    for row in rows:
        if row["case"] in ("single", "outside", "none", "noise") and "error" not in row:
            true = row["true"][0] if row["true"] else "none"
            table.setdefault(true, Counter())[row["named"][0] if row["named"] else row["verdict"]] += 1
    return {name: dict(counts) for name, counts in table.items()}


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--share", type=float, default=1.0, help="of each case's count")
    parser.add_argument("--only", default="", help="cases, separated by commas")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--rows", type=Path, help="write one JSON line a log there")
    given = parser.parse_args(argv)
    os.environ |= {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    todo = cases(given.share, [k for k in given.only.split(",") if k], given.first_seed)
    rows: list[dict[str, Any]] = []
    with multiprocessing.get_context("spawn").Pool(given.processes) as pool:
        for row in pool.imap_unordered(_safely, todo):
            rows.append(row)
            if sys.stderr.isatty():
                print(f"\r{len(rows)} of {len(todo)} logs", end="", file=sys.stderr)
            if given.rows:
                with given.rows.open("a") as file:
                    file.write(json.dumps(row) + "\n")
    table = summary(rows)
    if given.json:
        print(json.dumps({"processes": given.processes, "cases": table, "confusion": confusion(rows)}))
        return 0
    show(rows, table, given.processes)
    return 0


def show(rows: list[dict[str, Any]], table: list[dict[str, Any]], processes: int) -> None:
    print(f"sealed logs, noise {1e3 * NOISE:g} mm unless said, {processes} processes of one thread")
    for line in table:
        ratio = line["after_over_floor_median"]
        more = (
            ""
            if ratio is None
            else (f"; after/floor median {ratio:.2f}, within 1.15: {100 * line['after_within_1.15']:.0f} %")
        )
        print(
            f"\n{line['case']}: {100 * line['as_wanted']:.1f} % of {line['logs']} as wanted ({line['goal']})"
        )
        print(
            f"  held-out {line['before_mm_median']:.2f} -> {line['after_mm_median']:.2f} mm{more}; "
            f"{line['seconds_median']:.1f} s a log"
        )
        print(f"  verdicts {line['verdicts']}" + (f", crashed {line['crashed']}" if line["crashed"] else ""))
        for row in [r for r in rows if r["case"] == line["case"] and not score(line["case"], r)][:40]:
            what = (
                row.get("error")
                or f"{row['verdict']} {row['named']} {row['classes']} {1e3 * row['before']:.2f} -> "
                f"{1e3 * row['after']:.2f} mm"
            )
            print(f"    {row['seed']} {'+'.join(row['true'][:2]) or 'none'}: {what}")
    print("\nconfusion (true: named first x logs)")
    for true, counts in sorted(confusion(rows).items()):
        print(
            f"  {true:22s} "
            + ", ".join(f"{name} x {n}" for name, n in sorted(counts.items(), key=lambda kv: -kv[1]))
        )


if __name__ == "__main__":
    sys.exit(main())
