"""The distance between measurement and model over time: arrays for a live plot, and an inline SVG for a
page."""

from __future__ import annotations

import io
import re
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fastrod.errors import InputError
from fastrod.types import Flags, Floats, Ints
from fastrod_viewer.replay.playback import Playback, PlayedTrack

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BEFORE, AFTER = "#8b94a3", "#2166c4"
"""Colours of the two models."""
MOST = 2000
"""Points of a live curve."""
_BINS = 450  # of the drawn curve: about two pixels each
_RUNS = 40  # starts of runs that are marked
_INK, _LINE, _HELD = "#4b5563", "#9ca3af", "#dbe7f8"
_WIDE, _HIGH = 9.0, 1.8  # in; 100 px each
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "path",
    "svg.hashsalt": "fastrod",
    "font.size": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": _LINE,
    "axes.labelcolor": _INK,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "text.color": _INK,
    "legend.frameon": False,
    "lines.solid_capstyle": "round",
    "lines.linewidth": 1.1,
    "path.simplify": True,
}


class Curves(NamedTuple):
    """Two curves over one clock; nan interrupts a curve."""

    time: Floats
    """(k,) non-decreasing, time of the playback [s]."""
    before: Floats
    """(k,) [mm]."""
    after: Floats | None
    """(k,) [mm]; None where there is one model."""


def curves(playback: Playback, most: int = MOST) -> Curves:
    """The residual of each model over time, in at most `most` points.

    A log with more rows is drawn as its envelope: each stretch of rows by its least residual at its first row
    and its greatest at its last, so that no peak is lost. Curves are interrupted where a run begins, unless
    there are so many that little else would be left.
    """
    if most < 20:
        raise InputError(f"most is {most!r}; a curve needs 20 points at least.")
    n = len(playback.time)
    cuts = playback.breaks if len(playback.breaks) <= most // 8 else playback.breaks[:0]
    if n + len(cuts) <= most:
        first = last = np.arange(n)
    else:
        edges = np.linspace(0, n, (most - 3 * len(cuts)) // 2 + 1).round().astype(np.int64)
        first = np.union1d(edges[:-1], cuts)
        last = np.append(first[1:], n) - 1
    whole = len(first) == n
    gaps = np.searchsorted(first, cuts) * (1 if whole else 2)
    time = (
        playback.time[first]
        if whole
        else np.stack([playback.time[first], playback.time[last]], axis=1).ravel()
    )
    made = [_thin(1e3 * track.residual, first, whole) for track in playback.tracks]
    lines = [np.insert(line, gaps, np.nan) for line in made]
    return Curves(
        np.insert(time, gaps, time[gaps] if len(gaps) else []), lines[0], lines[1] if len(lines) > 1 else None
    )


def svg(playback: Playback) -> str:
    """The residual of each model over time, about 900 x 180 px, as an SVG that stands inside a page: no
    reference leads out of it, and its text is drawn as paths. What no fit saw is shaded. The same playback
    gives the same text."""
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG  # no window, and no pyplot state to clean up
    from matplotlib.figure import Figure

    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(_WIDE, _HIGH), layout="constrained")
        FigureCanvasSVG(figure)
        axes = figure.subplots()
        axes.patch.set_visible(False)
        shaded = _shade(axes, playback)
        shown = curves(playback, 2 * _BINS)
        for track, line, colour in zip(
            playback.tracks, (shown.before, shown.after), (BEFORE, AFTER), strict=False
        ):
            assert line is not None
            axes.plot(shown.time, line, color=colour, label=_name(track), zorder=3)
            axes.axhline(1e3 * track.rms, color=colour, lw=1.0, ls=(0, (4, 3)), zorder=2)
        if len(starts := _starts(playback)) <= _RUNS:
            for row in starts:
                axes.axvline(playback.time[row], color=_LINE, lw=0.6, ls=":", zorder=1)
        closed = (
            ", runs one after the other"
            if len(starts)
            else ", long pauses left out"
            if len(playback.breaks)
            else ""
        )
        axes.set(xlabel=f"time{closed} [s]", ylabel="tip error [mm]")
        axes.set_xlim(0.0, playback.duration or 1.0)
        axes.set_ylim(bottom=0.0)
        figure.legend(loc="outside upper right", ncols=3 if shaded else 2)
        file = io.StringIO()
        figure.savefig(
            file,
            format="svg",
            transparent=True,
            metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")),
        )
    return _inline(file.getvalue())


def _name(track: PlayedTrack) -> str:
    return f"{track.label}: {1e3 * track.rms:.3g} mm rms"


def _thin(values: Floats, first: Ints, whole: bool) -> Floats:
    """Return the least and the greatest of each stretch that begins at `first`, alternating; nan where all of
    a stretch is."""
    if whole:
        return values
    return np.stack([np.fmin.reduceat(values, first), np.fmax.reduceat(values, first)], axis=1).ravel()


def _starts(playback: Playback) -> Ints:
    """Rows at which a run begins, but for the first."""
    return np.flatnonzero(playback.log.run[1:] != playback.log.run[:-1]) + 1


def _shade(axes: Axes, playback: Playback) -> bool:
    """Shade what no fit saw; whether there is any."""
    stretches = _stretches(playback.tested) if playback.tested is not None else []
    for k, (start, end) in enumerate(stretches):
        label = "seen by no fit" if k == 0 else ""
        axes.axvspan(
            playback.time[start], playback.time[end], color=_HELD, alpha=0.55, lw=0.0, zorder=0, label=label
        )
    return bool(stretches)


def _stretches(rows: Flags) -> list[tuple[int, int]]:
    """First and last row of each run of True."""
    edges = np.flatnonzero(np.diff(rows.astype(np.int8), prepend=0, append=0))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]


def _inline(text: str) -> str:
    """The <svg> alone, as wide as where it stands, with names that no other picture of a page has."""
    text = text[text.index("<svg") :].strip()
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r' xmlns(:xlink)?="[^"]*"', "", text)
    text = re.sub(r'\bid="', 'id="residual-', text)
    text = re.sub(r"url\(#", "url(#residual-", text)
    text = re.sub(r'href="#', 'href="#residual-', text)
    head = r'<svg viewBox="\1" role="img" aria-label="tip error over time">'
    return re.sub(r'<svg [^>]*?viewBox="([^"]*)"[^>]*>', head, text, count=1)
