"""The closed loop on measured robots: error before and after, on data that no fit has seen.

fastrod bench measured             reads ../shared/data beside the checkout, or the folder in FASTROD_DATA
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fastrod.identification.attribution import identify
from fastrod.identification.log.forward import PredictedRod, predict, sample
from fastrod.identification.log.unknowns import base_model
from fastrod.identification.report.result import Result
from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Robot

sys.path.insert(0, str(Path(__file__).parents[1] / "scenes"))
from fastrod_scenes.measured import armlab_tdcr, asl_trunk, ethz_beam

DATA = Path(os.environ.get("FASTROD_DATA", Path(__file__).parents[2] / "shared" / "data"))
TRUNK_EFFECTS = 8


def row(name: str, result: Result) -> dict[str, Any]:
    return {
        "log": name,
        "held_out": list(result.held_out),
        "rows": int(result.measured.sum()),
        "verdict": result.verdict,
        "train_before_mm": 1e3 * result.train.before,
        "train_after_mm": 1e3 * result.train.after,
        "before_mm": 1e3 * result.test.before,
        "after_mm": 1e3 * result.test.after,
        "floor_mm": 1e3 * result.noise.floor,
        "summary": result.summary,
        "path": [(s.name, round(1e3 * s.train, 2), round(1e3 * s.held_out, 2)) for s in result.path],
        "effects": {
            e.name: {k: (float(f"{v.value:.3g}"), v.unit) for k, v in e.parameters.items()}
            for e in result.effects
        },
        "classes": {e.name: list(e.cannot_be_told_from) for e in result.effects},
        "remaining": result.remaining_kind,
    }


def trunk() -> list[dict[str, Any]]:
    """0 g: found on 90 s, held out 60 s. 100 g: the same robot, its stiffness the one parameter. Strokes and
    steps by themselves."""
    log, robot = asl_trunk(DATA / "asl_trunk.csv")
    log = replace(log, points=None)  # the tip is what is judged, so the tip alone is fitted
    light = identify(log.only("perlin_0g"), robot, held_out=["perlin_0g@90:"], max_effects=TRUNK_EFFECTS)
    rows = [row("trunk, 0 g", light)]
    rows.append(heavier(log.only("perlin_100g"), light.identified, light.test.after))
    return rows + [
        row(f"trunk, {run}", identify(log.only(run), robot, max_effects=3))
        for run in ("strokes_out_back", "step_motor2")
    ]


def stiffer(robot: Robot, factor: float) -> Robot:
    """The same robot stiffer, its wires as much: without loads nothing changes, under loads it gives way
    less."""
    segments = tuple(
        replace(
            s,
            bending_stiffness=tuple(factor * k for k in s.bending_stiffness),
            torsional_stiffness=factor * s.torsional_stiffness,
            tendons=tuple(replace(t, compliance=t.compliance / factor) for t in s.tendons),
        )
        for s in robot.segments
    )
    effects = tuple(
        {
            **e,
            "compliance": [c / factor for c in e["compliance"]]
            if isinstance(e["compliance"], list)
            else e["compliance"] / factor,
        }
        if e["name"] == "tendon_stretch"
        else e
        for e in robot.effects
    )
    return replace(robot, segments=segments, effects=effects)


def tip_rms(log: RunLog, robot: Robot, start: float, end: float) -> float:
    """Tip error [m] over a stretch of one run, nothing fitted."""
    samples = sample(log)
    inside = samples.rows[(samples.time[samples.rows] >= start) & (samples.time[samples.rows] < end)]
    part = samples.on(inside)
    model = replace(base_model(replace(robot, fit={}, sensor={})), unknowns=())
    pose = predict(model, np.zeros(0), part, PredictedRod(part, robot))
    error = ((samples.log.tip_position[inside] - pose.position) ** 2).sum(1)
    return float(np.sqrt(error[pose.ok].mean()))


def heavier(log: RunLog, robot: Robot, light: float) -> dict[str, Any]:
    """The payload of the log on the identified robot: stiffness found on 90 s, error on the last 60 s."""
    factors = np.geomspace(0.25, 64.0, 17)
    errors = [tip_rms(log, stiffer(robot, f), 0.0, 90.0) for f in factors]
    best = int(np.argmin(errors))
    fine = np.geomspace(factors[max(best - 1, 0)], factors[min(best + 1, len(factors) - 1)], 9)
    found = float(fine[int(np.argmin([tip_rms(log, stiffer(robot, f), 0.0, 90.0) for f in fine]))])
    unloaded = replace(log, payload=np.zeros(len(log)))
    return {
        "log": "trunk, 100 g",
        "stiffness_factor": found,
        "without_payload_mm": 1e3 * tip_rms(unloaded, robot, 90.0, 1e9),
        "after_mm": 1e3 * tip_rms(log, stiffer(robot, found), 90.0, 1e9),
        "light_mm": 1e3 * light,
        "ratio": tip_rms(log, stiffer(robot, found), 90.0, 1e9) / light,
    }


def armlab() -> list[dict[str, Any]]:
    """Every fifth cell of the cube of shortenings held out."""
    log, robot = armlab_tdcr(DATA / "armlab_tdcr.csv")
    cells = sorted(log.runs)
    return [row("ARM-Lab, held-out cells", identify(log, robot, held_out=cells[2::5], max_effects=6))]


def beam() -> list[dict[str, Any]]:
    log, robot = ethz_beam(DATA / "ethz_beam.csv")
    return [row("ETH beam, at rest", identify(log, robot, held_out=[r for r in log.runs if r.endswith("b")]))]


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--only", choices=("trunk", "armlab", "beam"))
    given = parser.parse_args(argv)
    if not DATA.is_dir():
        print(f"the measured sets are not at {DATA}; set FASTROD_DATA to their folder", file=sys.stderr)
        return 2
    rows: list[dict[str, Any]] = []
    for name, what in (("armlab", armlab), ("beam", beam), ("trunk", trunk)):
        if given.only in (None, name):
            clock = time.perf_counter()
            rows += what()
            rows[-1]["seconds"] = time.perf_counter() - clock
    if given.json:
        print(json.dumps(rows))
        return 0
    for line in rows:
        print(f"\n{line['log']}")
        for key, value in line.items():
            if key != "log":
                print(f"  {key}: {value:.3g}" if isinstance(value, float) else f"  {key}: {value}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
