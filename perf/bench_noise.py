"""Verdicts on logs to which nothing is missing but a camera's slow noise, with and without an effect."""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import fastrod
from fastrod.identification.attribution import identify
from fastrod.identification.excite import excitation
from fastrod.identification.log.base_model import base_model
from fastrod.identification.log.forward import PredictedRod, predict
from fastrod.identification.log.samples import sample
from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Robot
from fastrod.model.routing import route
from fastrod.types import Floats
from report import Row, Section, bench, note_progress, table

RHO = (0.5, 0.7, 0.8, 0.9, 0.95, 0.98)
"""Correlation from one sample to the next."""
SHAPES = (("excite", 15.0, 0.0), ("excite", 30.0, 0.0), ("wander", 15.0, 150.0), ("wander", 30.0, 90.0))
"""Inputs, Hz, s: `fastrod excite`; or 12 s of rest, wandering, 13 s of rest."""
EFFECTS: dict[str, dict[str, float]] = {"backlash": {"half_width": 2e-4}, "creep": {}, "payload": {}}
FIRST_SEED = 100


class Case(NamedTuple):
    seed: int
    rho: float
    shape: tuple[str, float, float]
    robot: str
    noise: float
    """m an axis."""
    effect: str


def cases(count: int, first_seed: int = FIRST_SEED, effect: str = "") -> list[Case]:
    """Clean logs of every correlation, shape and robot in turn; their noise from 0.1 to 1 mm."""
    made = []
    for i in range(count):
        rng = np.random.default_rng(first_seed + i)
        noise = float(np.exp(rng.uniform(math.log(1e-4), math.log(1e-3))))
        shape = SHAPES[(i + i // len(RHO)) % len(SHAPES)]
        # two segments on every fifth: they take three times as long
        robot = "two" if i % 5 == 4 else "prototype"
        made.append(Case(first_seed + i, RHO[i % len(RHO)], shape, robot, noise, effect))
    return made


def robot_of(case: Case) -> Robot:
    """The prototype, or twice of it with the far tendons at 45 degrees."""
    one = fastrod.load_robot("prototype")
    if case.robot == "prototype":
        return one
    (near,) = one.segments
    rotated = tuple(replace(t, angle=float(t.angle) + math.pi / 4.0) for t in near.tendons)
    return Robot(name="two", segments=(near, replace(near, tendons=rotated)))


def inputs_of(case: Case, robot: Robot) -> RunLog:
    """The log's inputs, with tips still at the base."""
    kind, rate, seconds = case.shape
    if kind == "excite":
        log = excitation(robot, seed=case.seed, rate=rate).log
        return replace(log, tip_position=np.zeros((len(log), 3)))
    rng = np.random.default_rng([case.seed, 7])
    t = np.arange(round(seconds * rate)) / rate
    moving = np.clip(np.minimum(t - 12.0, seconds - 13.0 - t), 0.0, 1.0)
    frequency = rng.uniform(0.05, 0.6, (5, robot.n_segments, 2))
    phase = rng.uniform(0.0, 2.0 * np.pi, frequency.shape)
    bends = (np.sin(2.0 * np.pi * frequency * t[:, None, None, None] + phase)).sum(1) / 3.0
    dl = route(robot).tendon_change(0.7 * bends * moving[:, None, None])
    n = len(t)
    return RunLog(name="wander", t=t, run=np.full(n, ""), dl=np.round(dl, 9), tip_position=np.zeros((n, 3)))


def autoregressive(rng: np.random.Generator, n: int, rho: float) -> Floats:
    """(n, 3) of unit variance, each sample `rho` times the one before plus news."""
    news = np.sqrt(1.0 - rho**2) * rng.normal(size=(n, 3))
    news[0] /= np.sqrt(1.0 - rho**2)
    for i in range(1, n):
        news[i] += rho * news[i - 1]
    return news


def log_of(case: Case) -> tuple[RunLog, Robot]:
    """The log with the model's own tips and coloured noise, and the robot without the effect."""
    robot = robot_of(case)
    inputs = inputs_of(case, robot)
    model = base_model(robot)
    theta = model.start
    if case.effect:
        model = model.with_effect(case.effect)
        theta = np.concatenate([theta, sizes(model, case)])
    samples = sample(inputs)
    tip = predict(model, theta, samples, PredictedRod(samples, robot, threads=1)).position
    noise = case.noise * autoregressive(np.random.default_rng([case.seed, 1]), len(tip), case.rho)
    return replace(inputs, tip_position=tip + noise), robot


def sizes(model: Any, case: Case) -> Floats:
    """An effect's numbers: those of EFFECTS, else one scale from neutral."""
    made = []
    for u in model.unknowns:
        if u.place[:2] != ("effect", case.effect):
            continue
        given = EFFECTS.get(case.effect, {})
        value = given.get(u.name.partition(".")[2], u.start if u.shape else u.mean + u.scale)
        made.append(u.outside(float(np.clip(value, *u.bounds))))
    return np.array(made)


def run(case: Case) -> Row:
    """Simulate, identify, compare."""
    row: Row = {"seed": case.seed, "rho": case.rho, "inputs": f"{case.shape[0]} {case.shape[1]:g} Hz"}
    row |= {"robot": case.robot, "true": case.effect or "none"}
    clock = time.perf_counter()
    try:
        log, robot = log_of(case)
        result = identify(log, robot, threads=1)
    except Exception as error:  # a crash is a wrong answer, and must not stop the others
        return row | {"verdict": f"{type(error).__name__}: {error}", "wrong": True}
    floor = math.sqrt(3.0) * case.noise
    named = [found.name for found in result.effects]
    row |= {"verdict": str(result.verdict), "named": ", ".join(named), "rows": len(log)}
    row |= {"floor_ratio": result.noise.floor / floor, "after_mm": 1e3 * result.test.after}
    row |= {"before_mm": 1e3 * result.test.before, "floor_mm": 1e3 * floor, "how": result.noise.how}
    row["wrong"] = named[:1] != [case.effect] if case.effect else result.verdict != "none"
    row["summary"] = result.summary
    scores = []
    for name, e in result.base_parameters.items():
        if e.identifiable and e.stderr > 0.0 and math.isfinite(e.stderr) and "tiffness" in name:
            scores.append((e.value - 1.0) / e.stderr)
    row["scores"] = scores
    return row | {"seconds": time.perf_counter() - clock}


def sections(rows: list[Row]) -> list[Section]:
    whole = [r for r in rows if "floor_ratio" in r]
    lines: list[Row] = []
    for rho in (*RHO, None):
        own = [r for r in whole if rho is None or r["rho"] == rho]
        if not own:
            continue
        ratio = np.array([r["floor_ratio"] for r in own])
        scores = np.abs([s for r in own for s in r["scores"]])
        lines.append(
            {
                "rho": "all" if rho is None else f"{rho:g}",
                "logs": len(own),
                "wrong": sum(r["wrong"] for r in own),
                "lowest": float(ratio.min()),
                "median": float(np.median(ratio)),
                "highest": float(ratio.max()),
                "within": float(np.mean(np.abs(ratio - 1.0) <= 0.2)),
                "covered": float(np.mean(scores < 1.96)) if len(scores) else None,
                "seconds": float(np.median([r["seconds"] for r in own])),
            }
        )
    return [
        table(
            "noise",
            "Coloured noise on logs to which nothing is missing",
            "rho | logs:d | wrong:d | lowest:.2f floor / true~lowest | median:.2f median"
            "| highest:.2f highest | within:.0% within~20 % | covered:.0% truth in~95 %"
            "| seconds:.1f s a log",
            lines,
            "Noise 0.1 to 1 mm an axis: each sample is rho times the one before, and news; 25 s of rest.",
        ),
        table(
            "wrong",
            "Logs with a wrong verdict",
            "seed | rho | inputs | robot | true | verdict | named | before_mm:.2f before~[mm]"
            "| after_mm:.2f after~[mm] | floor_mm:.2f true floor~[mm] | floor_ratio:.2f floor /~true",
            [r for r in rows if r["wrong"]],
        ),
    ]


def measure(options: Any) -> list[Section]:
    os.environ |= {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    todo = cases(1 if options.quick else options.logs, options.first_seed, options.effect)
    rows: list[Row] = []
    with multiprocessing.get_context("spawn").Pool(options.processes) as pool:
        for row in pool.imap_unordered(run, todo):
            rows.append(row)
            note_progress(f"{len(rows)} of {len(todo)} logs")
            if options.rows:
                with options.rows.open("a") as file:
                    file.write(json.dumps(row) + "\n")
    return sections(rows)


main = bench(
    __doc__,
    measure,
    ("--logs", 60, "how many"),
    ("--effect", "", "one that the log has, of one scale; the verdict must name it"),
    ("--first-seed", FIRST_SEED, "of the logs"),
    ("--processes", os.cpu_count() or 1, "at a time"),
    ("--rows", Path, "write one JSON line a log there"),
)
