"""Report of `identify`, for machines, for the browser and for the terminal: report.json, report.html,
identified.toml, a table."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fastrod.identification.log.registration import CameraRegistration
from fastrod.identification.report.page import page
from fastrod.identification.report.result import Error, Result
from fastrod.identification.report.wording import (
    VERDICTS,
    millimetres,
    percent,
    plain_name,
    with_error,
    words,
)
from fastrod.identification.search.revisits import Revisits
from fastrod.identification.search.solve import Estimate
from fastrod.logs.folder import make_folder
from fastrod.model.robotfile import save_robot

if TYPE_CHECKING:
    from rich.console import Group


def to_json(result: Result) -> dict[str, Any]:
    """The result as plain data, SI units; what is not a number is None."""
    structure = result.remaining
    names, matrix = result.correlation
    made: dict[str, Any] = {
        "log": result.log.name,
        "robot": result.robot.name,
        "n_samples": int(result.measured.sum()),
        "held_out": list(result.held_out),
        "noise_floor_m": result.noise.floor,
        "noise": {
            "sigma_m": result.noise.sigma,
            "lag1": result.noise.lag1,
            "how": result.noise.how,
            "coefficients": list(result.noise.model.coefficients),
            "uncertainty": result.noise.uncertainty,
            "sway_hz": result.noise.sway,
        },
        "error": {
            "train": _error(result.train),
            "held_out": {
                **_error(result.test),
                "interval_m": list(result.test.interval),
                "all_rows_rms_m": result.test.all_rows,
            },
        },
        "verdict": result.verdict,
        "summary": result.summary,
        "effects": [
            {
                "name": found.name,
                "title": found.title,
                "drive": found.drive,
                "parameters": _estimates(found.parameters),
                "held_out_gain": found.held_out_gain,
                "evidence": dict(found.evidence),
                "cannot_be_told_from": list(found.cannot_be_told_from),
            }
            for found in result.effects
        ],
        "base_parameters": _estimates(result.base_parameters),
        "registration": _registration(result.registration),
        "clock": None if result.clock is None else _estimates({"offset": result.clock})["offset"],
        "correlation": {"names": list(names), "matrix": matrix},
        "remaining": {
            "structured_fraction": result.remaining_fraction,
            "kind": result.remaining_kind,
            "patterns": list(result.patterns),
            "above_noise": result.above_noise,
            "shares": {key: getattr(structure, key) for key in ("static", "memory", "drift", "exogenous")},
        },
        "revisits": _revisits(result.revisits),
        "patterns": list(result.patterns),
        "path": [{"name": s.name, "train_rms_m": s.train, "held_out_rms_m": s.held_out} for s in result.path],
        "candidates": [
            {
                "name": t.name,
                "kind": t.kind,
                "held_out_rms_m": t.held_out_rms,
                "score": t.score,
                "bic_gain": t.bic_gain,
                "kept": t.kept,
                "why": t.why,
            }
            for t in result.tried
        ],
        "bounds": [
            {"name": b.name, "parameter": b.parameter, "unit": b.unit, "value": b.value}
            for b in result.bounds
        ],
        "advice": list(result.advice),
        "notes": list(result.notes),
        "solves": result.solves,
    }
    if result.as_given_rms is not None:
        for key, rms in zip(("train", "held_out"), result.as_given_rms, strict=True):
            made["error"][key]["shipped_rms_m"] = rms
    if result.network:
        made["network"] = dict(result.network)
    plain: dict[str, Any] = _plain(made)
    return plain


def text(result: Result) -> str:
    """report.json."""
    return json.dumps(to_json(result), indent=1, ensure_ascii=False, allow_nan=False)


def write(result: Result, out_dir: str | Path) -> list[Path]:
    """Write report.json, report.html and identified.toml into `out_dir`, each whole or not at all, and
    identified_SESSION.toml for each further session; the paths written."""
    out = make_folder(out_dir)
    written = []
    for name, make in (("report.json", text), ("report.html", page)):
        path = out / name
        partial = path.with_name(f"{name}.part")
        content = make(result) + "\n"
        try:
            partial.write_text(content, encoding="utf-8")
            partial.replace(path)
        except OSError:
            if partial.is_file():
                partial.unlink()
            raise
        written.append(path)
    robots = {"": result.identified, **result.sessions}
    for label, robot in robots.items():
        written.append(out / f"identified{re.sub(r'[^A-Za-z0-9.]+', '_', f'_{label}') if label else ''}.toml")
        save_robot(robot, written[-1])
    return written


def table(result: Result) -> Group:
    """Verdict, errors, effects and advice for the terminal, 80 columns wide at most."""
    from rich import box
    from rich.console import Group
    from rich.markup import escape
    from rich.table import Table
    from rich.text import Text

    colour = {"none": "green", "explained": "green", "not_in_library": "red"}.get(result.verdict, "yellow")
    title = Text.assemble(
        (f" {VERDICTS[result.verdict]} ", f"bold reverse {colour}"),
        f" {result.log.name} on {result.robot.name}",
    )
    errors = Table(
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 2, 0, 0),
        title=escape("tip error, rms [mm]"),
        title_justify="left",
    )
    for name in ("", "shipped", "base fit", "effects", "95 % interval", "noise floor"):
        errors.add_column(name, justify="right" if name else "left")
    floor = millimetres(result.noise.floor)
    low, high = (millimetres(v) for v in result.test.interval)
    shipped = [millimetres(v) for v in result.as_given_rms or (math.nan, math.nan)]
    for (name, error), given in zip(
        (("train", result.train), ("held out", result.test)), shipped, strict=True
    ):
        interval = f"{low} to {high}" if error is result.test else ""
        cells = given, millimetres(error.before), millimetres(error.after), interval, floor
        errors.add_row(name, *cells, style="bold" if interval else None)
    blocks: list[Any] = [title, Text(result.summary), Text(), errors]
    if result.effects:
        grid = Table(
            box=box.SIMPLE_HEAD,
            pad_edge=False,
            padding=(0, 2, 0, 0),
            title="what the model lacked",
            title_justify="left",
        )
        for name in ("effect", "parameter", "estimate", "note"):
            grid.add_column(name, overflow="fold")
        for found in result.effects:
            label = words(found.name)
            for name, e in found.parameters.items():
                note = " ".join(filter(None, ("at bound" if e.at_bound else "", e.why)))
                grid.add_row(
                    escape(label),
                    escape(words(name)),
                    escape(with_error(e.value, e.stderr, e.unit)),
                    escape(note),
                )
                label = ""
        fraction = result.explained_fraction
        if math.isfinite(fraction):
            grid.caption = f"{percent(max(fraction, 0.0))} of the held-out error above the noise is explained"
            grid.caption_justify = "left"
        blocks.append(grid)
    lines = [
        f"{words(f.name)} cannot be distinguished from {', '.join(map(words, f.cannot_be_told_from))} on "
        "this log"
        for f in result.effects
        if f.cannot_be_told_from
    ]
    wanted = [(n, e) for n, e in result.base_parameters.items() if e.identifiable and n in result.robot.fit]
    lines += [f"[fit] {plain_name(n)}: {with_error(e.value, e.stderr, e.unit)}" for n, e in wanted]
    lines += [
        f"not identifiable: {plain_name(name)}, {e.why}"
        for name, e in result.base_parameters.items()
        if not e.identifiable
    ]
    lines += [f"remains: {pattern}" for pattern in result.patterns if result.effects]
    lines += [f"note: {note}" for note in result.notes] + [f"run next: {line}" for line in result.advice]
    return Group(*blocks, *(Text(f"- {line}") for line in lines))


def _error(error: Error) -> dict[str, float]:
    return {"before_rms_m": error.before, "after_rms_m": error.after}


def _registration(camera: CameraRegistration | None) -> dict[str, Any] | None:
    """Return where a camera stands that was far from where the robot file says; None where it was not."""
    if camera is None:
        return None
    return {
        "angle_rad": camera.angle,
        "distance_m": camera.distance,
        "rotation": camera.rotation,
        "shift_m": camera.shift,
    }


def _revisits(pair: tuple[Revisits, Revisits] | None) -> dict[str, Any] | None:
    """The same command at other times; None where too few come again."""
    if pair is None:
        return None
    return {
        word: {
            "pairs": seen.n,
            "elsewhere_rms_m": seen.elsewhere,
            "floor_without_memory_m": seen.floor,
            "half_difference_bent_m": seen.bent,
            "memory": seen.memory,
            "static": seen.static,
        }
        for word, seen in zip(("before", "after"), pair, strict=True)
    }


def _estimates(every: Mapping[str, Estimate]) -> dict[str, Any]:
    return {
        name: {
            "value": e.value,
            "stderr": e.stderr,
            "unit": e.unit,
            "identifiable": e.identifiable,
            "why": e.why,
            "prior_sd": e.prior_sd,
            "prior_mean": e.prior_mean,
            "prior_distance_sd": e.prior_distance,
            "at_bound": e.at_bound,
        }
        for name, e in every.items()
    }


def _plain(value: Any) -> Any:
    """Dicts, lists, strings, numbers, and None for what is not finite."""
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(inner) for inner in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value
