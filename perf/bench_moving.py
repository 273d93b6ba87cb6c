"""Sealed logs in motion: a rod with inertia whose tendons have an effect that its file does not, and what
identify says of a run that no fit has seen. Plant and model share their code, and differ in step and
numbers."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from fastrod.identification.attribution import identify
from fastrod.identification.log.motion import MotionReplay
from fastrod.identification.log.samples import sample
from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Lump, Robot
from fastrod.model.robotfile import load_robot
from report import Row, Section, bench, note_progress, table

KINDS = ("backlash", "friction", "slack", "latency", "none")
NOISE, RATE = 1e-4, 100.0
FIT = {"segment.1.damping_time": {"sd": 0.005}, "segment.1.line_density": {"sd": 0.1}}


def robot(density: float, mass: float, damping: float, effects: tuple[dict[str, Any], ...] = ()) -> Robot:
    given = load_robot("prototype")
    (segment,) = given.segments
    lumps = (Lump(at=segment.length, mass=mass),)
    moved = replace(segment, line_density=density, damping_time=damping, lumps=lumps)
    return replace(given, segments=(moved,), effects=effects, fit=FIT, sensor={})


def sealed(seed: int, seconds: float) -> tuple[str, RunLog]:
    """Return what is sealed, and two runs of smooth commands up to 5 Hz with 0.1 mm of noise."""
    rng, kind = np.random.default_rng(seed), KINDS[seed % len(KINDS)]
    offset = float(np.mean(load_robot("prototype").segments[0].tendons[0].offset))
    size = float(rng.uniform(0.02, 0.06)) * offset
    laws: dict[str, dict[str, Any]] = {
        "friction": {
            "half_width": size,
            "presliding": size * rng.uniform(1.2, 2.0),
            "growth": rng.uniform(0.2, 0.6),
        },
        "latency": {"delay": rng.uniform(0.01, 0.04)},
        "none": {},
    }
    law = laws.get(kind, {"half_width": size})
    plant = robot(
        rng.uniform(0.25, 0.4),
        rng.uniform(0.015, 0.03),
        rng.uniform(0.003, 0.009),
        ({"name": kind, **law},) if law else (),
    )
    t = np.arange(0.0, seconds, 1.0 / RATE)
    runs = []
    for _ in range(2):
        w = 2.0 * np.pi * np.array([0.5, 1.3, 2.9, 5.1])[:, None, None]
        phase, high = rng.uniform(0.0, 6.0, (4, 1, 2)), 0.2 * offset * rng.uniform(-1.0, 1.0, (4, 1, 2))
        pull = (high * (np.sin(w * t[:, None] + phase) - np.sin(phase))).sum(0)
        runs.append(np.concatenate([pull, -pull], axis=1))
    dl, n = np.concatenate(runs), len(t)
    log = RunLog(
        name=f"sealed {seed}",
        t=np.tile(t, 2),
        run=np.repeat(["fitted", "other"], n),
        dl=dl,
        tip_position=np.zeros((2 * n, 3)),
    )
    (pose,) = MotionReplay(sample(log), longest_step=5e-4).poses([[plant]])
    return kind, replace(log, tip_position=pose.position + NOISE * rng.normal(size=pose.position.shape))


def measure(options: Any) -> list[Section]:
    rows: list[Row] = []
    for seed in range(options.first_seed, options.first_seed + (1 if options.quick else options.logs)):
        (kind, log), begun = sealed(seed, options.seconds), time.process_time()
        found = identify(log, robot(0.3, 0.02, 0.004), held_out=["other"], dynamics=True)
        names = [effect.name for effect in found.effects]
        right = names[:1] == [kind] if kind != "none" else found.verdict == "none"
        rows.append(
            {
                "seed": seed,
                "sealed": kind,
                "verdict": found.verdict,
                "found": ", ".join(names),
                "right": right,
                "before": 1e3 * found.test.before,
                "after": 1e3 * found.test.after,
                "over": found.test.after / found.noise.floor,
                "cpu": time.process_time() - begun,
            }
        )
        note_progress(str(rows[-1]))
    right = sum(bool(row["right"]) for row in rows)
    columns = (
        "seed:d | sealed | verdict | found | right | before:.2f held out~before [mm] | after:.2f after | "
    )
    return [
        table(
            "moving",
            "sealed logs in motion",
            columns + "over:.2f after /~noise | cpu:.0f CPU s",
            rows,
            f"right effect first, or none where there is none: {right} of {len(rows)}",
        )
    ]


main = bench(
    __doc__,
    measure,
    ("--logs", 10, "sealed logs"),
    ("--first-seed", 0, "of them"),
    ("--seconds", 1.5, "of each of their two runs"),
)
