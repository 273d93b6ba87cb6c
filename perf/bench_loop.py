"""The whole loop on sealed emulators: excite, identify, plan anew, track, and open the seal."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from fastrod_device.bench.loop import close_loop
from fastrod_device.bench.workbench import emulated
from fastrod_device.hardware import load_hardware
from report import Row, Section, bench, note_progress, table

FLOOR_TARGET, BEYOND_TARGET, FRACTION_TARGET = 1.3, 0.7, 0.5
"""Held-out error over noise; off the path's reachable points, rms [mm]; of the same controller's before."""
NOMINAL = {"bending_stiffness": 2.2e-3, "torsional_stiffness": 1.0e-3}


def _one(seed: int, effect: str | None, *, load: bool) -> Row:
    workbench = emulated(load_hardware(), seed=seed, effect=effect)
    with tempfile.TemporaryDirectory() as folder, workbench as bench:
        payload = None if load else 0.0
        loop = close_loop(bench.prototype, bench.assistant, Path(folder), payload=payload, turn=load)
        assert bench.emulator is not None
        sealed, stiffness = list(bench.emulator.seal.open()), bench.emulator.seal.stiffness()
    result = loop.result
    classes = {found.name: list(found.cannot_be_told_from) for found in result.effects}
    estimates = {name.rpartition(".")[2]: e for name, e in result.base_parameters.items() if e.identifiable}
    ratio = [
        estimates[name].value * nominal / true if name in estimates else None
        for (name, nominal), true in zip(NOMINAL.items(), stiffness, strict=True)
    ]
    tracked = {"track_before": loop.before, "track_after": loop.after}
    noise, test = result.noise.floor, result.test
    row: Row = {"seed": seed, "sealed": ", ".join(sealed) or "none", "verdict": result.verdict}
    row["found"] = ", ".join(name + (f" ({', '.join(c)})" if c else "") for name, c in classes.items())
    row |= {"right": _right(result.verdict, classes, sealed), "over": test.after / noise}
    row |= {"floor": 1e3 * noise, "before": 1e3 * test.before, "after": 1e3 * test.after}
    for name, runs in tracked.items():
        row[name] = 1e3 * float(np.sqrt(np.mean([one.distance**2 for one in runs])))
    row["axis"] = 1e3 * max(float(np.max(one.rms - one.floor_rms)) for one in loop.after)
    return row | {"E": ratio[0], "G": ratio[1]}


def _right(verdict: str, classes: dict[str, list[str]], sealed: list[str]) -> bool:
    """The sealed effect is the first that was named, or cannot be distinguished from it; outside the library,
    nothing certain was named."""
    if not sealed:
        return verdict == "none"
    if sealed[0] in ("ripple", "bump"):
        return verdict in ("not_in_library", "partly_explained")
    first = next(iter(classes.items()), None)
    return first is not None and sealed[0] in (first[0], *first[1])


def measure(options: Any) -> list[Section]:
    rows: list[Any] = []
    for seed in range(options.first_seed, options.first_seed + (1 if options.quick else options.seeds)):
        rows.append(_one(seed, options.effect, load=not options.no_load))
        note_progress(f"{len(rows)} done: {rows[-1]}")
    right = sum(row["right"] for row in rows)
    near = sum(row["over"] <= FLOOR_TARGET for row in rows)
    followed = sum(row["track_after"] <= BEYOND_TARGET for row in rows)
    halved = sum(row["track_after"] <= FRACTION_TARGET * row["track_before"] for row in rows)
    return [
        table(
            "loop",
            "sealed emulators",
            "seed:d | sealed | verdict | found found (or one of) | right | floor:.3f noise~[mm]"
            "| before:.2f held out~before | after:.3f | over:.2f after /~noise | track_before:.2f off "
            "path~before| track_after:.2f after~[mm] | axis:.2f worst axis~beyond floor | E:.3f E / plant's"
            "| G:.3f G / plant's",
            rows,
            f"right effect or its class: {right} of {len(rows)}; held-out error within {FLOOR_TARGET:g} of "
            f"the noise: {near}; tracking within {BEYOND_TARGET:g} mm of the path: {followed}; at most "
            f"{FRACTION_TARGET:g} of before: {halved}",
            "off path: rms distance of the measured tip from the nearest point of the path that the robot "
            "can come to, the three paths together. One robot, stepped time.",
        )
    ]


main = bench(
    __doc__,
    measure,
    ("--seeds", 20, "emulators"),
    ("--first-seed", 0, "of them"),
    ("--effect", str, "seal this one in all of them; none and outside too"),
    ("--no-load", False, "nothing known hangs on the tip, and the base stays upright"),
)
