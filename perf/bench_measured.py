"""The closed loop on measured robots: error before and after, on data that no fit has seen."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fastrod.errors import InputError
from fastrod.identification.attribution import identify
from fastrod.identification.log.base_model import base_model
from fastrod.identification.log.forward import PredictedRod, predict
from fastrod.identification.log.samples import sample
from fastrod.identification.report.result import Result
from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Robot
from report import ROOT, SHARED, Row, Section, bench, note_progress, table
from ring_down import REPEATS, WINDOW, compared, ring_of

sys.path.append(str(ROOT / "scenes"))
from fastrod_scenes.measured import armlab_tdcr, asl_trunk, ethz_beam, opencr_ftv4

DATA = Path(os.environ.get("FASTROD_DATA", SHARED / "data"))
Found = tuple[Row, list[str]]  # a row, and its notes


def row(name: str, result: Result) -> Found:
    """One log's errors; its notes tell the path of the search and what was identified."""
    steps = (f"{s.name} {1e3 * s.train:.2f} / {1e3 * s.held_out:.2f}" for s in result.path)
    made: Row = {"log": name, "held_out": ", ".join(result.held_out), "rows": int(result.measured.sum())}
    errors = {"before": result.test.before, "after": result.test.after, "floor": result.noise.floor}
    errors |= {"train_before": result.train.before, "train_after": result.train.after}
    made |= {f"{key}_mm": 1e3 * value for key, value in errors.items()}
    notes = [f"{name}: {result.summary}", f"  fitted / held out [mm]: {', '.join(steps)}"]
    for e in result.effects:
        values = ", ".join(f"{k} {v.value:.3g} {v.unit}" for k, v in e.parameters.items())
        others = ", ".join(e.cannot_be_told_from) or "nothing"
        notes.append(f"  {e.name}: {values}; cannot be distinguished from {others}")
    return made | {"verdict": result.verdict, "remaining": result.remaining_kind}, notes


def trunk() -> list[Found]:
    """0 g: fitted on 90 s, held out 60 s, moved by commands and by what its drives did of them. 100 g: the
    same robot with that mass, nothing fitted; then both fitted together. Other sessions: zeros, tightness,
    registration and delay alone, and where the mass hangs. Strokes and steps by themselves. The base model
    alone; then a search, and one from a file that has six push-pull tendons on a body that cannot
    shorten."""
    given, robot = asl_trunk(DATA / "asl_trunk.csv")
    given = replace(given, points=None)  # the tip is what is judged, so the tip alone is fitted
    log = replace(given, pos=None)
    light = identify(log.only("perlin_0g"), robot, held_out=["perlin_0g@90:"], max_effects=0)
    found = [row("trunk, 0 g", light), heavier(log.only("perlin_100g"), light.identified, light.test.after)]
    found[0][1].append(f"  from the measured state: {segments(light)}")
    moved = identify(given.only("perlin_0g"), robot, held_out=["perlin_0g@90:"])
    found.append(row("trunk, 0 g, measured drives", moved))
    found[-1][1].append(f"  from the measured state: {segments(moved)}")
    others, _ = asl_trunk(DATA / "asl_trunk_sessions.csv")
    others = replace(others, points=None, pos=None)
    for all_runs, run, tested in (
        (others, "perlin_2_a", []),
        (others, "hops_june_a", []),
        (log, "perlin_100g", ["perlin_100g@90:"]),
    ):
        fitted = identify(all_runs.only(run), light.identified, only_session=True, held_out=tested)
        found.append(row(f"trunk, {run} as another session", fitted))
    runs = ("perlin_0g", "perlin_100g")
    both = identify(log.only(*runs), robot, held_out=[f"{run}@90:" for run in runs], max_effects=0)
    each = [f"{run} {tip_rms(log.only(run), both.identified, 90.0, 1e9):.2f} mm" for run in runs]
    made, notes = row("trunk, 0 and 100 g", both)
    found.append((made, [*notes, f"  held out: {', '.join(each)}"]))
    found += [
        row(f"trunk, {run}", identify(log.only(run), robot, max_effects=0))
        for run in ("strokes_out_back", "step_motor2")
    ]
    found.append(
        row("trunk, 0 g, searched", identify(log.only("perlin_0g"), robot, held_out=["perlin_0g@90:"]))
    )
    first = replace(log.only("perlin_0g"), dl=log.only("perlin_0g").dl[:, ::2])
    six = identify(first, push_pull(robot, every=2), held_out=["perlin_0g@90:"])
    return [*found, row("trunk, six push-pull tendons", six)]


def tip_rms(log: RunLog, robot: Robot, start: float, end: float) -> float:
    """Tip error [mm] over a stretch of one run, nothing fitted."""
    samples = sample(log)
    inside = samples.rows[(samples.time[samples.rows] >= start) & (samples.time[samples.rows] < end)]
    stretch = samples.on(inside)
    model = replace(base_model(replace(robot, fit={}, sensor={})), unknowns=())
    pose = predict(model, np.zeros(0), stretch, PredictedRod(stretch, robot))
    error = ((samples.log.tip_position[inside] - pose.position) ** 2).sum(1)
    return 1e3 * float(np.sqrt(error[pose.ok].mean()))


def segments(result: Result, n: int = 150) -> str:
    """Tip error over random stretches of the held-out time that start from the measured state: the residual
    there is known, and fades as it did in the training data."""
    off, t = result.residual_after, result.log.t
    trained, tested = (off[rows & np.isfinite(off).all(1)] for rows in (result.used, result.tested))
    dt = float(np.median(np.diff(t)))
    rng, said = np.random.default_rng(0), list[str]()
    for seconds in (0.5, 1.0, 2.0):
        k = round(seconds / dt)
        power = (trained**2).sum()
        fades = np.array([(trained[i:] * trained[: len(trained) - i]).sum() / power for i in range(1, k + 1)])
        starts = rng.integers(0, len(tested) - k, n)
        left = [tested[i + 1 : i + k + 1] - fades[:, None] * tested[i] for i in starts]
        said.append(f"{1e3 * np.sqrt(np.mean(np.square(left).sum(-1))):.2f} mm over {seconds:g} s")
    return f"{', '.join(said)} ({n} stretches)"


def heavier(log: RunLog, robot: Robot, light: float) -> Found:
    """The last 60 s of a log with a payload by the robot that was identified without it."""
    before = tip_rms(replace(log, payload=np.zeros(len(log))), robot, 90.0, 1e9)
    after = tip_rms(log, robot, 90.0, 1e9)
    made: Row = {"log": "trunk, 100 g", "before_mm": before, "after_mm": after}
    words = f"before is without the mass; {1e-3 * after / light:.3g} of the error at 0 g"
    return made | {"ratio": 1e-3 * after / light}, [f"trunk, 100 g: {words}"]


def opencr() -> list[Found]:
    """Every fourth stretch held out: as it is built, the base model alone; and from a file that has push-pull
    tendons on a body that cannot shorten, as a stranger writes it."""
    log, robot = opencr_ftv4(DATA / "opencr_ftv4_train.csv")
    built = identify(log, robot, max_effects=0)
    found = identify(log, push_pull(robot))
    return [row("OpenCR v4, as built", built), row("OpenCR v4, push-pull file", found)]


def push_pull(robot: Robot, every: int = 1) -> Robot:
    """The robot as if its tendons, or `every` second of them, could push and its body could not shorten; its
    delay is not known."""
    plain = {"compliance": 1e-5, "pretension": 0.0, "unilateral": False}
    segments = tuple(
        replace(s, axial_stiffness=math.inf, tendons=tuple(replace(t, **plain) for t in s.tendons[::every]))
        for s in robot.segments
    )
    kept = ("tendon.*.gain", "tendon.*.angle", "segment.*.length")
    fit = {target: prior for target, prior in robot.fit.items() if target in kept}
    zero = robot.fit.get("tendon.*.zero", {"sd": 0.001})
    sensor = {key: value for key, value in robot.sensor.items() if key != "latency_sd"}
    return replace(robot, segments=segments, fit=fit | {"tendon.*.zero": zero}, sensor=sensor)


def armlab() -> list[Found]:
    """Every fifth cell of the cube of shortenings held out."""
    log, robot = armlab_tdcr(DATA / "armlab_tdcr.csv")
    found = identify(log, robot, held_out=sorted(log.runs)[2::5])
    return [row("ARM-Lab, held-out cells", found)]


def beam() -> list[Found]:
    held_out = ["gravity_b", "load52_b"]
    rows = [row("ETH beam, at rest", identify(*ethz_beam(DATA / "ethz_beam.csv"), held_out=held_out))]
    for loads in (("gravity",), ("load52",), ("gravity", "load52")):
        log, robot = ethz_beam(DATA / "ethz_beam.csv", settled=None)
        swinging = log.only(*(f"{load}_{repeat}" for load in loads for repeat in "ab"))
        found = identify(swinging, robot, held_out=[f"{load}_b" for load in loads])
        rows.append(row(f"ETH beam let go, {' and '.join(loads)}", found))
        rows[-1][1].extend(ringing(found, f"{load}_b") for load in loads)
    return rows


def ringing(result: Result, run: str) -> str:
    """Return how a run that no fit has seen rings, beside the model: frequency, and the decay of the
    amplitude over the swings that both have within a second."""
    rows = result.log.run == run
    seen, made = (
        ring_of(result.log.t[rows], tip[0, 0] - tip[:, 0], from_rest=True).until(WINDOW)
        for tip in (result.log.tip_position[rows], result.after[rows])
    )
    n = min(len(seen.amplitude), len(made.amplitude)) - 1
    lost = [float(np.log(ring.amplitude[0] / ring.amplitude[n])) for ring in (seen, made)]
    return (
        f"  {run}: rings at {made.frequency:.2f} Hz, measured {seen.frequency:.2f} "
        f"({made.frequency / seen.frequency - 1.0:+.1%}); decay {lost[1]:.2f}, measured {lost[0]:.2f} "
        f"({lost[1] / lost[0] - 1.0:+.1%})"
    )


def ring_down() -> Section:
    """The beam let go, in motion: nothing fitted, then its damping on the other repeat."""
    log, robot = ethz_beam(DATA / "ethz_beam.csv", settled=None)
    rows = [
        compared(log, robot, *pair, shear)
        for repeats in REPEATS
        for pair in (repeats, repeats[::-1])
        for shear in (False, True)
    ]
    return table(
        "ring_down",
        "ETH beam let go",
        "run | model | drop_mm:.2f at rest [mm] | measured_drop_mm:.2f measured | "
        "frequency_hz:.3f nothing~fitted [Hz] | measured_hz:.3f measured | frequency_error:+.1% off by | "
        "damping_time_ms:.2f fitted on the~other repeat [ms] | "
        "amplitude_error:.1% amplitude over 1 s,~of the first | last_amplitude_error:+.1% the last~amplitude",
        rows,
        "The published modulus was fitted to a solid of finite elements; with shear the rod is too soft.",
    )


SETS: dict[str, Callable[[], list[Found]]] = {
    "armlab": armlab,
    "beam": beam,
    "trunk": trunk,
    "opencr": opencr,
}


def measure(options: Any) -> list[Section]:
    if not DATA.is_dir():
        raise InputError(f"the measured sets are not at {str(DATA)!r}; set FASTROD_DATA to their folder.")
    found: list[Found] = []
    for name, rows in SETS.items():
        if name in (options.only or ("beam" if options.quick else SETS)):
            note_progress(name)
            found += rows()
    sections = [ring_down()] if "ring" in (options.only or (() if options.quick else ["ring"])) else []
    if options.only == "ring":
        return sections
    return [
        table(
            "measured",
            "Measured robots",
            "log | rows:d | before_mm:.2f held out~before [mm] | after_mm:.2f after~[mm] | floor_mm:.3f "
            "noise~[mm]| train_before_mm:.2f fitted on~before [mm] | train_after_mm:.2f after~[mm] | verdict"
            "| remaining what is~left",
            [one for one, _ in found],
            *(note for _, notes in found for note in notes),
        ),
        *sections,
    ]


main = bench(__doc__, measure, ("--only", [*SETS, "ring"], "this set alone"))
