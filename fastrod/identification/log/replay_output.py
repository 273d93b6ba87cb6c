"""Output of a replay: a table of residuals, its rows as a file, and a figure."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fastrod.identification.log.replay import Replay
from fastrod.logs.folder import make_folder
from fastrod.logs.runlog import RunLog
from fastrod.types import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from rich.table import Table

DENSE = 3000  # rows above which a picture of every row is a blot
_BINS = 400  # of an envelope: about two pixels of a panel each
_NONE = "–"
_MEANING = "residual = measured - predicted"
_STATIC = "the model is quasi-static: fast motion shows as residual"
_MOVING = "the model is in motion, each run from rest at its first row"
_MOST_RUNS = 20  # lines of the table; a log with more runs is read in residuals.csv
_MEASURED, _PREDICTED, _RESIDUAL, _INK = "#1f2937", "#e4572e", "#2a78b5", "#4b5563"


def write(result: Replay, out_dir: str | Path) -> list[Path]:
    """Write residuals.csv and replay.png into `out_dir`, each whole or not at all; the paths written."""
    out = make_folder(out_dir)
    residuals, picture = out / "residuals.csv", out / "replay.png"
    piece = residuals.with_name("residuals.csv.part")
    _write_residuals(result, piece)
    piece.replace(residuals)
    piece = picture.with_name("replay.png.part")
    draw(result).savefig(piece, format="png", dpi=130)
    piece.replace(picture)
    return [residuals, picture]


def table(result: Replay) -> Table:
    """The residual of each run and of all, in mm, as a rich table 80 columns wide at most."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    title = f"{result.log.name} on {result.robot.name}: tip residual [mm], base frame"
    grid = Table(
        title=escape(title),
        title_justify="left",
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    for name in ("run", "rms x", "rms y", "rms z", "rms", "max", "excursion", "converged"):
        grid.add_column(name, justify="left" if name == "run" else "right")
    pieces = list(result.pieces())
    for label, piece in pieces[:_MOST_RUNS] if len(pieces) > 1 else []:
        grid.add_row(escape(label or "-"), *_cells(piece))
    if len(pieces) > _MOST_RUNS:
        grid.add_row(f"... {len(pieces) - _MOST_RUNS} more runs")
    grid.add_row("all", *_cells(result), style="bold")
    grid.caption = (
        f"{_MEANING}; rms, max of its length\nexcursion: measured tip from its own mean; {_NONE} "
        f"if below the rms\n{_MOVING if result.dynamics else _STATIC}"
    )
    return grid


def draw(result: Replay) -> Figure:
    """Measured and predicted x, y, z and their distance over time, the two paths seen along y and along z,
    and how the distance spreads.

    Only rows that were measured are drawn. Above `DENSE` rows the curves over time are envelopes and the
    paths points.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # no window, and no pyplot state to clean up
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 8.0), layout="constrained")
    FigureCanvasAgg(figure)
    halves: Any = figure.subfigures(1, 2, width_ratios=(2.0, 1.0))
    left, right = halves
    shown = result.rows(result.log.measured)
    panels = left.subplots(4, 1, sharex=True)
    _over_time(list(panels), shown)
    places = right.subplots(3, 1, height_ratios=(3.0, 3.0, 2.0))
    _path(places[0], shown, (0, 2))
    _path(places[1], shown, (0, 1))
    _spread(places[2], shown)
    right.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=2, frameon=False)
    fraction = f", {1e2 * result.rms / result.excursion_rms:.0f} % of the excursion" if _moves(result) else ""
    figure.suptitle(
        f"{result.log.name} on {result.robot.name}: tip error {1e3 * result.rms:.3g} mm rms{fraction}",
        x=0.01,
        ha="left",
        fontweight="bold",
    )
    rows = f"{int(result.compared.sum())} of {len(result.log)} rows compared; only measured rows are drawn"
    rows += (
        f"; a band spans the least to the greatest of {_every(shown.log, _BINS)} rows"
        if len(shown.log) > DENSE
        else ""
    )
    how = _MOVING if result.dynamics else _STATIC
    left.supxlabel(f"{_MEANING}; {how}\n{rows}", x=0.01, ha="left", fontsize=8, color=_INK)
    return figure


def _cells(piece: Replay) -> list[str]:
    converged = f"{int(piece.compared.sum())}/{int(piece.log.measured.sum())}"
    if not piece.compared.any():
        return ["-"] * 6 + [converged]
    excursion = f"{1e3 * piece.excursion_rms:.2f}" if _moves(piece) else _NONE
    return [
        *(f"{1e3 * length:.2f}" for length in (*piece.axis_rms, piece.rms, piece.max)),
        excursion,
        converged,
    ]


def _moves(piece: Replay) -> bool:
    """Whether the measured tip moves by at least the rms of its residual; otherwise a share of the excursion
    says nothing."""
    return piece.excursion_rms > 0.0 and piece.excursion_rms >= piece.rms


def _write_residuals(result: Replay, path: Path) -> None:
    log, residual = result.log, result.residual
    names = [f"{what}_{axis}" for what in ("measured", "predicted", "residual") for axis in "xyz"]
    values = np.concatenate(
        [log.tip_position, result.tip_position, residual, np.linalg.norm(residual, axis=1)[:, None]], axis=1
    )
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["t", "run", *names, "residual_norm", "converged"])
        for t, run, row, ok in zip(
            log.t.tolist(), log.run.tolist(), values.tolist(), result.converged.tolist(), strict=True
        ):
            writer.writerow([_text(t), run, *map(_text, row), int(ok)])


def _text(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.9g}"


def _timeline(log: RunLog) -> tuple[Floats, NDArray[np.int64]]:
    """(n,) time with the runs laid one after the other from 0 [s], and the first row of each run but the
    first.

    A log of one run keeps its own time. Every row has a time.
    """
    breaks = np.flatnonzero(log.run[1:] != log.run[:-1]) + 1
    time = log.t - log.t[0] if len(breaks) else log.t.copy()
    for start in breaks:
        time[start:] += time[start - 1] - time[start]
    return time, breaks


def _broken(x: Floats, y: Floats, gaps: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """A curve with a gap before each of the rows `gaps`."""
    return np.insert(x, gaps, np.nan), np.insert(y, gaps, np.nan)


def _gaps(time: Floats, breaks: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows before which a curve is interrupted: where a run starts, or where the log skips far more time than
    it usually does."""
    skip = np.diff(time)
    usual = float(np.nanmedian(skip)) if np.isfinite(skip).any() else 0.0
    long = np.flatnonzero(skip > 30.0 * usual) + 1 if usual > 0.0 else breaks
    return np.union1d(breaks, long)


def _over_time(panels: list[Axes], shown: Replay) -> None:
    """x, y, z of both tips and their distance [mm] over time [s], one panel each."""
    time, breaks = _timeline(shown.log)
    gaps = _gaps(time, breaks)
    curve = partial(_band, every=_every(shown.log, _BINS)) if len(time) > DENSE else _line
    for k, axis in enumerate("xyz"):
        curve(
            panels[k],
            time,
            1e3 * shown.tip_position[:, k],
            gaps,
            colour=_PREDICTED,
            width=2.2,
            label="predicted",
        )
        curve(
            panels[k],
            time,
            1e3 * shown.log.tip_position[:, k],
            gaps,
            colour=_MEASURED,
            width=0.9,
            label="measured",
        )
        panels[k].set_ylabel(f"tip {axis} [mm]")
    curve(panels[3], time, _norm(shown), gaps, colour=_RESIDUAL, width=0.9, label="")
    _rms_line(panels[3].axhline, shown)
    panels[3].set_ylim(0.0, 1.3e3 * shown.max or None)
    panels[3].set_ylabel("distance [mm]")
    panels[3].legend(loc="upper right", fontsize=8, frameon=False)
    panels[3].set_xlabel("time, runs one after the other [s]" if len(breaks) else "time [s]")
    _name_runs(panels, shown.log.run[[0, *breaks]].tolist(), time, breaks)


def _line(
    axes: Axes,
    time: Floats,
    values: Floats,
    gaps: NDArray[np.int64],
    *,
    colour: str,
    width: float,
    label: str,
) -> None:
    axes.plot(*_broken(time, values, gaps), color=colour, lw=width, alpha=0.85, label=label)


def _band(
    axes: Axes,
    time: Floats,
    values: Floats,
    gaps: NDArray[np.int64],
    *,
    colour: str,
    width: float,
    label: str,
    every: int,
) -> None:
    """The least and the greatest of each `every` rows, none across a gap, filled between; edges half as wide
    as a line's `width`."""
    starts = np.union1d(np.arange(0, len(time), every), gaps)
    breaks = np.searchsorted(starts, gaps)
    ends = np.append(starts[1:], len(time)) - 1
    x = np.stack([time[starts], time[ends]], axis=1).ravel()
    low, high = (np.repeat(extreme.reduceat(values, starts), 2) for extreme in (np.fmin, np.fmax))
    across, bottom = _broken(x, low, 2 * breaks)
    top = _broken(x, high, 2 * breaks)[1]
    axes.fill_between(
        across,
        bottom,
        top,
        facecolor=(colour, 0.3),
        edgecolor=(colour, 0.9),
        lw=0.5 * min(width, 1.6),
        label=label,
    )


def _every(log: RunLog, pieces: int) -> int:
    """Rows of each of at most `pieces` equal parts of the log."""
    return math.ceil(len(log) / pieces)


def _path(axes: Axes, shown: Replay, plane: tuple[int, int]) -> None:
    """Both tips in a plane of the base [mm]: predicted below measured, or points of both in turns where there
    are many."""
    a, b = plane
    tips = [1e3 * shown.tip_position[:, plane], 1e3 * shown.log.tip_position[:, plane]]
    if len(shown.log) > DENSE:
        step = _every(shown.log, DENSE)
        points = np.stack([tip[::step] for tip in tips], axis=1).reshape(-1, 2)
        colours = np.tile(np.array([_PREDICTED, _MEASURED]), len(points) // 2)
        axes.scatter(points[:, 0], points[:, 1], c=colours.tolist(), s=1.6, lw=0.0, alpha=0.8)
    else:
        gaps = _gaps(*_timeline(shown.log))
        for tip, colour, width, size in zip(
            tips, (_PREDICTED, _MEASURED), (1.6, 0.6), (4.5, 2.5), strict=True
        ):
            axes.plot(
                *_broken(tip[:, 0], tip[:, 1], gaps),
                color=colour,
                lw=width,
                marker=".",
                ms=size,
                mew=0.0,
                alpha=0.7,
            )
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"{'xyz'[a]} [mm]")
    axes.set_ylabel(f"{'xyz'[b]} [mm]")
    axes.set_title(f"tip path, {'xyz'[a]}{'xyz'[b]} plane of the base", fontsize=10)
    axes.grid(alpha=0.25)


def _spread(axes: Axes, shown: Replay) -> None:
    """Draw how many rows have which residual distance [mm]."""
    norm = _norm(shown)
    axes.hist(
        norm[np.isfinite(norm)], bins=40, range=(0.0, 1e3 * shown.max or 1.0), color=_RESIDUAL, alpha=0.8
    )
    _rms_line(axes.axvline, shown)
    axes.set_xlabel("distance [mm]")
    axes.set_ylabel("rows")
    axes.grid(alpha=0.25)


def _norm(shown: Replay) -> Floats:
    """(n,) residual distance [mm]; nan where nothing is compared."""
    return np.asarray(1e3 * np.linalg.norm(shown.residual, axis=1), dtype=np.float64)


def _rms_line(across: Callable[..., Any], shown: Replay) -> None:
    across(1e3 * shown.rms, color=_INK, lw=0.8, ls="--", label=f"rms {1e3 * shown.rms:.3g} mm")


def _name_runs(panels: list[Axes], labels: list[str], time: Floats, breaks: NDArray[np.int64]) -> None:
    for axes in panels:
        axes.grid(alpha=0.25)
        axes.margins(x=0.01)
        for start in breaks:
            axes.axvline(time[start], color=_INK, lw=0.7, ls=":")
    if len(breaks) and len(breaks) < 8:
        for start, label in zip((0, *breaks), labels, strict=True):
            panels[0].text(
                time[start], 1.02, f" {label}", transform=panels[0].get_xaxis_transform(), fontsize=8
            )
