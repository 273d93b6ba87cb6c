"""The figures of the report, as inline SVG: before orange, after blue, measured dark grey, noise green."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from fastrod.identification.report.result import Result
from fastrod.identification.report.signals import Signals, SignalView, bin_means
from fastrod.identification.report.signature import Signature
from fastrod.identification.report.wording import millimetres, words
from fastrod.types import Flags, Floats, Ints

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BEFORE, AFTER, MEASURED, NOISE = "#e07b1a", "#2166c4", "#374151", "#15803d"
_RIVALS = ("#8e44ad", "#0f766e", "#9a3412")
_INK, _FAINT, _HELD = "#4b5563", "#d5dae1", "#eef1f6"
_WIDE = 11.0  # in
_VECTOR = 500  # points of a scatter above which it is a picture inside the SVG
_MOST = 4000  # points of a scatter
_BINS = 420  # of a curve over time
_RUNS = 60  # starts of runs that are marked
_SLIM = 4.0  # a path that is so much longer than wide has axes of their own scale
_CLOSE_UP = 12.0  # s
_PIECES = 90  # of the mean residual over time
_LAG = 6.0  # s of autocorrelation
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "fastrod",
    "font.family": ["sans-serif"],
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#9ca3af",
    "axes.labelcolor": _INK,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e5e7eb",
    "grid.linewidth": 0.7,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "text.color": "#1f2937",
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "lines.linewidth": 1.4,
    "lines.solid_capstyle": "round",
}


def error_over_time(result: Result, signals: Signals) -> str:
    """Distance between measured and predicted tip over time, held-out stretches shaded."""
    with _figure("time", 3.0) as (figure, out):
        axes = figure.subplots()
        time, breaks = _timeline(result)
        for start, end in _stretches(result.tested):
            axes.axvspan(
                time[start],
                time[end],
                color=_HELD,
                lw=0.0,
                label="held out" if start == _stretches(result.tested)[0][0] else "",
            )
        at = time[signals.rows]
        pairs = [("before", BEFORE, signals.before), ("after", AFTER, signals.after)]
        for label, colour, residual in pairs if result.effects else [("base model", BEFORE, signals.before)]:
            axes.plot(*_rms_bins(at, residual), color=colour, label=label)
        axes.axhline(1e3 * result.noise.floor, color=NOISE, ls="--", lw=1.3, label="noise floor")
        for row in breaks[:_RUNS]:
            axes.axvline(time[row], color="#9ca3af", lw=0.7, ls=":")
        axes.set(
            xlabel=f"time{', runs one after the other' if len(breaks) else ''} [s]", ylabel="tip error [mm]"
        )
        axes.set_ylim(bottom=0.0)
        axes.margins(x=0.0)
        figure.legend(loc="outside upper right", ncols=4)
    return out()


def whole_paths(result: Result, signals: Signals) -> str:
    """Measured and predicted tip over the workspace, before and after; what was held out is dark."""
    panels = [("before", BEFORE, result.before), ("after", AFTER, result.after)]
    panels = panels if result.effects else [("base model", BEFORE, result.before)]
    rows = _thin(signals.rows)
    measured = 1e3 * np.asarray(result.log.tip_position)[rows]
    first = _widest(measured)
    planes = (
        [first] if result.effects else [first, (min(3 - sum(first), first[0]), max(3 - sum(first), first[0]))]
    )
    step, run = np.diff(rows), signals.run[np.searchsorted(signals.rows, rows)]
    gaps = np.flatnonzero((step > 3 * np.median(step)) | (np.diff(run) != 0)) + 1
    held = result.tested[rows]
    with _figure("paths", 4.8) as (figure, out):
        grid = np.atleast_1d(figure.subplots(1, 2, sharex=len(planes) == 1, sharey=len(planes) == 1))
        for axes, (title, colour, tip), (a, b) in zip(
            grid, panels * len(planes), planes * len(panels), strict=True
        ):
            seen = np.where(held[:, None], measured, np.nan)[:, (a, b)]
            said = np.where(held[:, None], 1e3 * tip[rows], np.nan)[:, (a, b)]
            _trail(axes, measured[:, (a, b)], gaps, "#dfe3e9", 1.6, "measured, fitted")
            _trail(axes, seen, gaps, MEASURED, 2.4, "measured, held out")
            _trail(axes, said, gaps, colour, 1.2, f"{title}, held out")
            wide, high = (float(np.ptp(measured[:, k])) for k in (a, b))
            if max(wide, high) < _SLIM * min(wide, high):
                axes.set_aspect("equal", adjustable="box")
            axes.set(
                xlabel=f"tip {'xyz'[a]} [mm]",
                ylabel=f"tip {'xyz'[b]} [mm]",
                title=f"{title}, {'xyz'[a]}{'xyz'[b]} plane",
            )
        named = {
            label: handle
            for axes in grid
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(list(named.values()), list(named), loc="outside upper right", ncols=4)
    return out()


def close_up(result: Result, signals: Signals) -> tuple[str, str]:
    """The held-out stretch in which the base model is worst: each axis over time, and both paths; and when it
    is."""
    rows = _worst_stretch(result, signals)
    time = signals.time[np.searchsorted(signals.rows, rows)]
    tips = [("before", BEFORE, result.before, 1.6), ("after", AFTER, result.after, 1.6)]
    tips = tips if result.effects else [("base model", BEFORE, result.before, 1.6)]
    measured = 1e3 * np.asarray(result.log.tip_position)[rows]
    with _figure("closeup", 4.4) as (figure, out):
        left, right = _halves(figure, (1.45, 1.0))
        panels = left.subplots(3, 1, sharex=True)
        for k, axes in enumerate(panels):
            axes.plot(time, measured[:, k], ".", color=MEASURED, ms=3.0, alpha=0.8, label="measured")
            for label, colour, tip, width in tips:
                axes.plot(time, 1e3 * tip[rows, k], color=colour, lw=width, label=label)
            axes.set_ylabel(f"{'xyz'[k]} [mm]")
        panels[-1].set_xlabel("time in its run [s]")
        a, b = _widest(measured)
        axes = right.subplots()
        axes.plot(measured[:, a], measured[:, b], ".", color=MEASURED, ms=3.5, alpha=0.8)
        for _, colour, tip, width in tips:
            axes.plot(1e3 * tip[rows, a], 1e3 * tip[rows, b], color=colour, lw=width)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel=f"tip {'xyz'[a]} [mm]", ylabel=f"tip {'xyz'[b]} [mm]")
        figure.legend(
            *panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=3, markerscale=2.0
        )
    run = str(result.log.run[rows[0]])
    return out(), f"{f'run {run}, ' if run else ''}{time[0]:.0f} to {time[-1]:.0f} s"


def against_signal(view: SignalView, result: Result, name: str, alone: Sequence[Signature] = ()) -> str:
    """A component of the residual, before and after, against what explains it; left of it what an effect and
    its rivals do `alone`."""
    held = result.tested[view.rows]
    panels = [("before", BEFORE, view.before), ("after", AFTER, view.after)]
    panels = panels if result.effects else [("base model", BEFORE, view.before)]
    limit = 1.08 * 1e3 * float(np.quantile(np.abs(view.before), 0.998)) or 1.0
    sigma = 1e3 * float(np.sqrt(np.mean(result.noise.sigma**2)))
    limit = max(limit, 3.5 * sigma)
    with _figure(name, 3.7) as (figure, out):
        right = figure
        if alone:
            left, right = _halves(figure, (1.0, 2.0))
            _alone(left.subplots(), alone)
        grid = np.atleast_1d(right.subplots(1, len(panels), sharex=True, sharey=True))
        for axes, (title, colour, values) in zip(grid, panels, strict=True):
            axes.axhspan(-2.0 * sigma, 2.0 * sigma, color=NOISE, alpha=0.10, lw=0)
            for level in (-2.0 * sigma, 2.0 * sigma):
                axes.axhline(level, color=NOISE, ls="--", lw=1.0)
            (_loops if view.connected else _cloud)(axes, view, 1e3 * values, held, colour)
            axes.axhline(0.0, color="#9ca3af", lw=0.7)
            axes.set(title=title, xlabel=view.signal_label, ylim=(-limit, limit))
        grid[0].set_ylabel(f"{view.residual_label} [mm]")
    return out()


def autocorrelation(result: Result, signals: Signals) -> str:
    """Return how alike a residual is to itself some time later; a perfect model leaves only the band."""
    steps = np.diff(result.log.t)
    step = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 1.0
    lags = np.unique(
        np.round(np.linspace(1, max(2, min(len(signals.rows) // 4, round(_LAG / step))), 90)).astype(int)
    )
    pairs = [("before", BEFORE, signals.before), ("after", AFTER, signals.after)]
    with _figure("autocorrelation", 2.9) as (figure, out):
        axes = figure.subplots()
        band = 1.96 / np.sqrt(max(3 * len(signals.rows), 1))
        axes.axhspan(-band, band, color=NOISE, alpha=0.16, lw=0, label="white noise, 95 %")
        for label, colour, residual in pairs if result.effects else [("base model", BEFORE, signals.before)]:
            values = [_alike(residual, signals, int(lag)) for lag in lags]
            axes.plot(lags * step, values, color=colour, marker="o", ms=2.6, label=label)
        axes.plot(
            [step],
            [result.noise.lag1],
            color=NOISE,
            marker="D",
            ms=6.0,
            ls="none",
            label="camera at rest, one sample later",
        )
        axes.axhline(0.0, color="#9ca3af", lw=0.7)
        axes.set(xlabel="lag [s]", ylabel="autocorrelation")
        axes.set_ylim(min(-0.1, axes.get_ylim()[0]), 1.02)
        axes.set_xlim(left=0.0)
        figure.legend(loc="outside upper right", ncols=4)
    return out()


def added(result: Result) -> str:
    """Error of training and held-out samples with each effect that was added."""
    stages, floor = result.path, result.noise.floor
    with _figure("path", 0.9 + 0.62 * len(stages)) as (figure, out):
        axes = figure.subplots()
        excess = stages[0].held_out ** 2 - floor**2
        widest = 1e3 * max((v for s in stages for v in (s.train, s.held_out) if np.isfinite(v)), default=1.0)
        for i, stage in enumerate(stages):
            colour = BEFORE if i == 0 else AFTER
            for offset, value, alpha, label in (
                (-0.19, stage.held_out, 1.0, "held out"),
                (0.19, stage.train, 0.4, "train"),
            ):
                axes.barh(
                    i + offset,
                    1e3 * np.nan_to_num(value),
                    height=0.34,
                    color=colour,
                    alpha=alpha,
                    label=label if i == 1 else "",
                )
            fraction = (stages[0].held_out ** 2 - stage.held_out**2) / excess if excess > 0.0 else 0.0
            text = f" {millimetres(stage.held_out)} mm" + (
                f",  {min(100.0, 100.0 * fraction):.0f} % explained" if i and excess > 0.0 else ""
            )
            axes.text(
                1e3 * max(np.nan_to_num(stage.held_out), floor) + 0.006 * widest,
                i - 0.19,
                text,
                va="center",
                fontsize=9.5,
            )
        axes.axvline(1e3 * floor, color=NOISE, ls="--", lw=1.4, label="noise floor")
        axes.set_yticks(range(len(stages)), ["base model", *(f"+ {words(s.name)}" for s in stages[1:])])
        axes.invert_yaxis()
        axes.grid(False, axis="y")
        axes.set(xlabel="tip error, rms [mm]", xlim=(0.0, 1.18 * widest))
        figure.legend(loc="outside upper right", ncols=3)
    return out()


def left_over_time(result: Result, signals: Signals) -> str:
    """Return what is left of each axis, mean over stretches of time."""
    time, breaks = _timeline(result)
    at, colour = time[signals.rows], AFTER if result.effects else BEFORE
    edges = np.linspace(at.min(), at.max(), _PIECES + 1)
    place = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, _PIECES - 1)
    count = np.bincount(place, minlength=_PIECES)
    sigma = 1e3 * result.noise.sigma
    with _figure("left", 3.3) as (figure, out):
        for k, axes in enumerate(figure.subplots(3, 1, sharex=True, sharey=True)):
            mean = (
                1e3
                * np.bincount(place, weights=signals.after[:, k], minlength=_PIECES)
                / np.where(count > 0, count, np.nan)
            )
            wide = 2.0 * sigma[k] / np.sqrt(max(float(np.median(count)), 1.0))
            axes.axhspan(-wide, wide, color=NOISE, alpha=0.16, lw=0)
            axes.axhline(0.0, color="#9ca3af", lw=0.7)
            axes.plot(0.5 * (edges[1:] + edges[:-1]), mean, color=colour, drawstyle="steps-mid")
            axes.set_ylabel(f"{'xyz'[k]} [mm]")
            for row in breaks[:_RUNS]:
                axes.axvline(time[row], color="#9ca3af", lw=0.7, ls=":")
            axes.margins(x=0.0)
        axes.set_xlabel(f"time{', runs one after the other' if len(breaks) else ''} [s]")
    return out()


def correlations(names: list[str], matrix: Floats) -> str:
    """`matrix` (p, p) of correlations of the fitted numbers, from -1 to 1."""
    from matplotlib.colors import LinearSegmentedColormap

    n = len(names)
    with _figure("correlation", 0.8 + 0.34 * n, min(_WIDE, 4.6 + 0.38 * n)) as (figure, out):
        axes = figure.subplots()
        colours = LinearSegmentedColormap.from_list("fastrod", [AFTER, "#ffffff", BEFORE])
        picture = axes.imshow(matrix, cmap=colours, vmin=-1.0, vmax=1.0, aspect="equal")
        axes.set_xticks(range(n), [str(k) for k in range(1, n + 1)])
        axes.set_yticks(range(n), [f"{name}  ({k})" for k, name in enumerate(names, 1)])
        axes.tick_params(length=0)
        axes.grid(False)
        axes.spines[:].set_visible(False)
        if n <= 14:
            for i in range(n):
                for j in range(n):
                    ink = "#ffffff" if abs(matrix[i, j]) > 0.75 else "#1f2937"
                    axes.text(
                        j,
                        i,
                        f"{matrix[i, j]:.2f}".replace("-", "−"),
                        ha="center",
                        va="center",
                        fontsize=7.5,
                        color=ink,
                    )
        figure.colorbar(picture, ax=axes, shrink=0.9, aspect=14, pad=0.02)
    return out()


@contextmanager
def _figure(name: str, height: float, width: float = _WIDE) -> Iterator[tuple[Figure, Callable[[], str]]]:
    """A figure of the report's style, and what turns it into SVG once it is drawn."""
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG  # no window, and no pyplot state to clean up
    from matplotlib.figure import Figure

    written: list[str] = []
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(width, height), layout="constrained", facecolor="none")
        FigureCanvasSVG(figure)
        yield figure, lambda: written[0]
        file = io.StringIO()
        figure.savefig(
            file, format="svg", dpi=150, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
        )
    written.append(_inline(file.getvalue(), name, width / _WIDE))


def _inline(svg: str, name: str, fraction: float) -> str:
    """An SVG file as an element of a page: no header, no addresses, its own ids."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' xmlns(:xlink)?="[^"]*"', "", svg)
    svg = re.sub(r'\bid="', f'id="{name}-', svg)
    svg = re.sub(r"url\(#", f"url(#{name}-", svg)
    svg = re.sub(r'href="#', f'href="#{name}-', svg)
    svg = re.sub(r'(?<=href="data:image/png;base64,)[^"]*', _small, svg)
    head = rf'<svg viewBox="\1" role="img" aria-label="{name}" style="--share:{fraction:.3f}">'
    return re.sub(r'<svg [^>]*?viewBox="([^"]*)"[^>]*>', head, svg, count=1)


def _small(png: re.Match[str]) -> str:
    """A PNG in base64 with few colours: a quarter of the size."""
    from PIL import Image  # matplotlib's own, which writes its pictures with it

    image = Image.open(io.BytesIO(base64.b64decode(png.group())))
    file = io.BytesIO()
    image.convert("RGBA").quantize(48, method=Image.Quantize.FASTOCTREE).save(
        file, format="png", optimize=True
    )
    return base64.b64encode(file.getvalue()).decode("ascii")


def _halves(figure: Figure, ratios: tuple[float, float]) -> tuple[Any, Any]:
    left, right = np.asarray(figure.subfigures(1, 2, width_ratios=ratios), dtype=object)
    return left, right


def _alone(axes: Axes, alone: Sequence[Signature]) -> None:
    """Draw what effects do by themselves to the tip, the one that was named first."""
    inks = zip(alone, (AFTER, *_RIVALS), ("-", "--", "-.", ":"), strict=False)
    for one, colour, dashes in inks:
        axes.plot(one.signal, 1e3 * one.shift, color=colour, ls=dashes, label=words(one.name))
    axes.axhline(0.0, color="#9ca3af", lw=0.7)
    axes.set(title="the law alone", xlabel=alone[0].signal_label, ylabel=f"{alone[0].shift_label} [mm]")
    if len(alone) > 1:
        axes.legend(loc="best")


def _cloud(axes: Axes, view: SignalView, values: Floats, held: Flags, colour: str) -> None:
    """Points, the held-out ones dark; and the mean over the signal."""
    rows = np.arange(len(values))[:: max(1, -(-len(values) // _MOST))]
    for which, alpha in ((~held[rows], 0.22), (held[rows], 0.75)):
        span = rows[which]
        axes.scatter(
            view.signal[span],
            values[span],
            s=6.0,
            c=colour,
            alpha=alpha,
            lw=0,
            rasterized=len(rows) > _VECTOR,
        )
    means = [
        (x, mean) for x, mean, count in bin_means(view.signal, values) if count >= min(8, len(values) // 50)
    ]
    axes.plot(*np.array(means).T, color="#111827", lw=1.6, marker="o", ms=3.0)


def _loops(axes: Axes, view: SignalView, values: Floats, held: Flags, colour: str) -> None:
    """Lines between consecutive rows, the held-out ones dark."""
    jump = np.flatnonzero(np.diff(view.rows) != 1) + 1
    for which, alpha, width in ((~held, 0.30, 0.8), (held, 0.95, 1.1)):
        x, y = (np.where(which, v, np.nan) for v in (view.signal, values))
        axes.plot(
            np.insert(x, jump, np.nan),
            np.insert(y, jump, np.nan),
            color=colour,
            alpha=alpha,
            lw=width,
            rasterized=len(x) > _VECTOR,
        )


def _trail(axes: Axes, points: Floats, gaps: Ints, colour: str, width: float, label: str) -> None:
    """A path (n, 2) with a break before each of the rows `gaps`."""
    x, y = (np.insert(points[:, k], gaps, np.nan) for k in (0, 1))
    axes.plot(
        x,
        y,
        color=colour,
        lw=width,
        marker=".",
        ms=1.5 * width,
        mew=0.0,
        solid_joinstyle="round",
        label=label,
        rasterized=len(x) > _VECTOR,
    )


def _rms_bins(time: Floats, residual: Floats) -> tuple[Floats, Floats]:
    """Time and rms distance [mm] in bins of equal time."""
    squares = (residual**2).sum(1)
    place = ((time - time.min()) / max(float(np.ptp(time)), 1e-9) * _BINS).astype(int)
    count = np.bincount(place, minlength=_BINS + 1).astype(float)
    with np.errstate(invalid="ignore", divide="ignore"):
        rms = 1e3 * np.sqrt(np.bincount(place, weights=squares, minlength=_BINS + 1) / count)
        centre = np.bincount(place, weights=time, minlength=_BINS + 1) / count
    filled = count > 0
    if len(time) < 3 * _BINS:  # sparse: no gaps between samples
        centre, rms = centre[filled], rms[filled]
        step = np.diff(centre)
        gaps = np.flatnonzero(step > 8.0 * np.median(step)) + 1 if len(step) else np.zeros(0, int)
        return np.insert(centre, gaps, np.nan), np.insert(rms, gaps, np.nan)
    return np.where(filled, centre, np.nan), np.where(filled, rms, np.nan)


def _timeline(result: Result) -> tuple[Floats, Ints]:
    """(n,) time with the runs laid one after the other [s], and the first row of each run but the first."""
    log = result.log
    breaks = np.flatnonzero(log.run[1:] != log.run[:-1]) + 1
    time = log.t.copy()
    for start in breaks:
        time[start:] += time[start - 1] - time[start]
    return time, breaks


def _stretches(flags: Flags) -> list[tuple[int, int]]:
    """First and last row of each stretch of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _worst_stretch(result: Result, signals: Signals) -> Ints:
    """Rows of some seconds of held-out samples in one run, where the base model is worst."""
    held = result.tested[signals.rows]
    if not held.any():
        held = np.ones(len(signals.rows), bool)
    squares = (signals.before**2).sum(1)
    best: tuple[float, Ints] | None = None
    for start, end in _stretches(held):
        for run in np.unique(signals.run[start : end + 1]):
            span = np.arange(start, end + 1)[signals.run[start : end + 1] == run]
            first = signals.time[span[0]]
            for k in np.unique(((signals.time[span] - first) // _CLOSE_UP).astype(int)):
                piece = span[((signals.time[span] - first) // _CLOSE_UP).astype(int) == k]
                score = float(squares[piece].mean()) * min(1.0, len(piece) / 20.0)
                if best is None or score > best[0]:
                    best = score, piece
    assert best is not None
    return np.asarray(signals.rows[best[1]])


def _widest(points: Floats) -> tuple[int, int]:
    """The two axes along which points move most."""
    a, b = sorted(np.argsort(np.ptp(points, axis=0))[-2:].tolist())
    return int(a), int(b)


def _thin(rows: Ints) -> Ints:
    return rows[:: max(1, -(-len(rows) // _MOST))]


def _alike(residual: Floats, signals: Signals, lag: int) -> float:
    """Autocorrelation of a residual about zero, of samples of one run that are `lag` rows apart."""
    pair = (signals.rows[lag:] - signals.rows[:-lag] == lag) & (signals.run[lag:] == signals.run[:-lag])
    total = float((residual**2).sum(1).mean())
    if not pair.any() or total <= 0.0:
        return float("nan")
    return float((residual[lag:] * residual[:-lag]).sum(1)[pair].mean()) / total
