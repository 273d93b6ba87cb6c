"""The whole loop on sealed emulators: `fastrod bench loop`, or this file as a script; `--json` for programs,
`--quick` for one of them.

Each seed seals another effect of another size into an emulator; the loop excites it, identifies it, plans
anew and tracks. The seal is opened when the verdict is in.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fastrod_device.hardware import load_hardware
from fastrod_device.loop import Loop, close_loop
from fastrod_device.workbench import emulated
from report import Column, Row, Section, command, note_progress

FLOOR_TARGET, BEYOND_TARGET, SHARE_TARGET, STIFFNESS_TARGET = 1.3, 7e-4, 0.5, 0.03
"""Held-out error over noise; beyond reach, rms [m]; of the same controller's before; of E and G."""
COLUMNS = (
    Column("seed", "seed", "d"),
    Column("sealed", "sealed"),
    Column("verdict", "verdict"),
    Column("found", "found (no telling from)"),
    Column("right", "right"),
    Column("floor", "noise\n[mm]", ".3f"),
    Column("before", "held out\nbefore", ".2f"),
    Column("after", "after", ".3f"),
    Column("over", "after /\nnoise", ".2f"),
    Column("track_before", "off reach\nbefore", ".2f"),
    Column("track_after", "after\n[mm]", ".2f"),
    Column("axis", "worst axis\nbeyond floor", ".2f"),
    Column("E", "E / plant's", ".3f"),
    Column("G", "G / plant's", ".3f"),
)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20, help="emulators (default: 20)")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--effect", help="seal this one in all of them; none and outside too")
    parser.add_argument(
        "--no-load", action="store_true", help="nothing known hangs on the tip, and the base stays upright"
    )
    return command(parser, argv, _measure)


def _measure(options: argparse.Namespace) -> list[Section]:
    seeds = range(options.first_seed, options.first_seed + (1 if options.quick else options.seeds))
    rows = []
    for k, seed in enumerate(seeds):
        rows.append(_one(seed, options.effect, load=not options.no_load))
        note_progress(f"{k + 1} of {len(seeds)}: {rows[-1]}")
    right = sum(row["right"] is True for row in rows)
    near = sum(_number(row, "over") <= FLOOR_TARGET for row in rows)
    followed = sum(_number(row, "track_after") <= 1e3 * BEYOND_TARGET for row in rows)
    halved = sum(_number(row, "track_after") <= SHARE_TARGET * _number(row, "track_before") for row in rows)
    notes = [
        f"right effect or its class: {right} of {len(rows)}; held-out error within {FLOOR_TARGET:g} of the "
        f"noise: {near}",
        f"tracking within {1e3 * BEYOND_TARGET:g} mm of reach: {followed}; at most {SHARE_TARGET:g} of "
        f"before: {halved}",
        "off reach: rms distance of the measured tip from the nearest point in reach, the three paths "
        "together. One robot, stepped time.",
    ]
    return [Section("loop", "sealed emulators", COLUMNS, rows, notes)]


def _number(row: Row, key: str) -> float:
    value = row[key]
    assert isinstance(value, float)
    return value


def _one(seed: int, effect: str | None, *, load: bool) -> Row:
    with (
        tempfile.TemporaryDirectory() as folder,
        emulated(load_hardware(), seed=seed, effect=effect) as bench,
    ):
        loop = close_loop(
            bench.prototype, bench.hands, Path(folder), payload=None if load else 0.0, turn=load
        )
        assert bench.emulator is not None
        sealed, stiffness = bench.emulator.seal.open(), bench.emulator.seal.stiffness()
    result = loop.result
    names = [found.name for found in result.effects]
    classes = {found.name: list(found.cannot_be_told_from) for found in result.effects}
    said = ", ".join(name + (f" ({', '.join(classes[name])})" if classes[name] else "") for name in names)
    fitted = {
        name.rpartition(".")[2]: e.value for name, e in result.base_parameters.items() if e.identifiable
    }
    nominal = {"bending_stiffness": 2.2e-3, "torsional_stiffness": 1.0e-3}
    ratio = [
        fitted[name] * nominal[name] / true if name in fitted else None
        for name, true in zip(nominal, stiffness, strict=True)
    ]
    before, after = _off(loop, "before"), _off(loop, "after")
    worst = max(float(np.max(one.rms - one.floor_rms)) for one in loop.after)
    return {
        "seed": seed,
        "sealed": ", ".join(sealed) or "none",
        "verdict": result.verdict,
        "found": said,
        "right": _right(result.verdict, names, classes, list(sealed)),
        "floor": 1e3 * result.noise.floor,
        "before": 1e3 * result.test.before,
        "after": 1e3 * result.test.after,
        "over": result.test.after / result.noise.floor,
        "track_before": 1e3 * before,
        "track_after": 1e3 * after,
        "axis": 1e3 * worst,
        "E": ratio[0],
        "G": ratio[1],
    }


def _right(verdict: str, names: list[str], classes: dict[str, list[str]], sealed: list[str]) -> bool:
    """The sealed effect is the first that was named, or cannot be told from it; outside the library, that
    nothing certain was named."""
    if not sealed:
        return verdict == "none"
    if sealed[0] in ("ripple", "bump"):
        return verdict in ("not_in_library", "partly_explained")
    return bool(names) and (sealed[0] == names[0] or sealed[0] in classes[names[0]])


def _off(loop: Loop, which: str) -> float:
    return float(np.sqrt(np.mean([one.distance**2 for one in getattr(loop, which)])))


if __name__ == "__main__":
    sys.exit(main())
