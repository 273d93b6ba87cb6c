"""Report of the whole loop, for machines, for the eye and for the terminal: loop.json, tracking.png, a
table."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fastrod.identification.report import report
from fastrod_device.bench.experiment import TrackingRun
from fastrod_device.bench.loop import Loop

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


def figures(loop: Loop, sealed: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The loop as plain data, SI units; `sealed` is what was hidden in an emulator, opened after the
    verdict."""
    error = loop.result.test
    made: dict[str, Any] = {
        "verdict": loop.result.verdict,
        "effects": [found.name for found in loop.result.effects],
        "cannot_be_told_from": {found.name: list(found.cannot_be_told_from) for found in loop.result.effects},
        "noise_floor_m": loop.result.noise.floor,
        "held_out": {"before_rms_m": error.before, "after_rms_m": error.after},
        "base_parameters": {
            name: {
                "value": e.value,
                "stderr": e.stderr,
                "unit": e.unit,
                "identifiable": e.identifiable,
                "why": e.why,
            }
            for name, e in loop.result.base_parameters.items()
        },
        "tracking": {
            before.name: {"before": _figures(before), "after": _figures(after)}
            for before, after in zip(loop.before, loop.after, strict=True)
        },
    }
    return made if sealed is None else made | {"sealed": sealed}


def write(loop: Loop, out: Path, sealed: Mapping[str, Any] | None = None) -> list[Path]:
    """loop.json, tracking.png and the files of the identification's report in the folder `out`; which were
    written."""
    from matplotlib import pyplot as plt

    written = report.write(loop.result, out)
    path = out / "loop.json"
    path.write_text(json.dumps(figures(loop, sealed), indent=1, default=_plain) + "\n", encoding="utf-8")
    picture = out / "tracking.png"
    figure = draw(loop)
    figure.savefig(picture, dpi=150)
    plt.close(figure)
    return [*written, path, picture]


def show(loop: Loop, console: Console, sealed: Mapping[str, Any] | None = None) -> None:
    """Print the identification, what was sealed, and the tracking before and after."""
    console.print(report.table(loop.result))
    if sealed is not None:
        console.print(f"the seal, opened now: {_unsealed(sealed)}", highlight=False)
    rows = [
        (which, one)
        for pair in zip(loop.before, loop.after, strict=True)
        for which, one in zip(("before", "after"), pair, strict=True)
    ]
    console.print(tracking_table(rows))


def tracking_table(rows: Sequence[tuple[str, TrackingRun]]) -> Table:
    """A row for each run along a path, with what drove it, mm."""
    from rich import box
    from rich.table import Table

    made = Table(
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
        title="measured tip off the path, rms mm",
        title_justify="left",
    )
    for name in ("path", "driven by", "x", "y", "z", "from nearest in reach", "reach from path x", "y", "z"):
        made.add_column(name, justify="left" if name in ("path", "driven by") else "right")
    for which, one in rows:
        cells = [*one.rms, one.distance, *one.floor_rms]
        made.add_row(one.name, which, *(f"{1e3 * value:.2f}" for value in cells))
    return made


def _unsealed(sealed: Mapping[str, Any]) -> str:
    pieces = [
        f"{name} ({', '.join(f'{key} {value:.3g}' for key, value in numbers.items())})"
        for name, numbers in sealed.items()
    ]
    return "; ".join(pieces) or "no effect at all"


def draw(loop: Loop) -> Any:
    """The paths from above: wanted, in reach, measured before and after."""
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(
        1, len(loop.after), figsize=(4.2 * len(loop.after), 4.7), layout="constrained", squeeze=False
    )
    for panel, before, after in zip(panels[0], loop.before, loop.after, strict=True):
        panel.plot(*_flat(after.path), color="0.35", linewidth=1.0, linestyle=(0, (4, 2)), label="path")
        panel.plot(*_flat(after.nearest), color="0.6", linewidth=3.0, label="nearest in reach")
        panel.plot(
            *_flat(before.seen), color="#dc2626", linewidth=1.0, label="measured, planned by the model before"
        )
        panel.plot(
            *_flat(after.seen),
            color="#2563eb",
            linewidth=1.2,
            label="measured, planned by the identified model",
        )
        panel.set_title(
            f"{after.name}: {1e3 * before.distance:.2f} to {1e3 * after.distance:.2f} mm off reach, rms",
            fontsize=10,
        )
        panel.set_aspect("equal")
        panel.set_xlabel("x mm")
        panel.set_ylabel("y mm")
    figure.legend(
        *panels[0][0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=4,
        fontsize=9,
        frameon=False,
    )
    return figure


def _flat(points: Any) -> tuple[Any, Any]:
    return 1e3 * points[:, 0], 1e3 * points[:, 1]


def _figures(one: TrackingRun) -> dict[str, Any]:
    return {
        "rms_m": one.rms,
        "floor_rms_m": one.floor_rms,
        "distance_rms_m": one.distance,
        "model_error_rms_m": float(
            np.sqrt(np.nanmean(np.sum((one.log.tip_position - one.predicted) ** 2, axis=1)))
        ),
    }


def _plain(value: Any) -> Any:
    return value.tolist()
