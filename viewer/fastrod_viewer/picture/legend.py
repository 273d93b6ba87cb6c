"""Legend of the colours of a picture, for a page."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import NamedTuple

import numpy as np

from fastrod_viewer.picture import palette
from fastrod_viewer.picture.batches import Picture
from fastrod_viewer.picture.options import ViewOptions
from fastrod_viewer.picture.palette import Color
from fastrod_viewer.worlds.world import DrawnRods


class Entry(NamedTuple):
    """One colour with a name."""

    name: str
    color: Color


class Tick(NamedTuple):
    """One number on a bar of colours."""

    value: float
    color: Color


_TITLES = {
    "segment": ("Segments", ""),
    "curvature": ("Curvature", "1/m"),
    "strain": ("Bending strain at the surface", "%"),
    "tension": ("Tendon tension", "N"),
}


@dataclass(frozen=True)
class Legend:
    """Named colours, or a bar of colours with numbers."""

    title: str
    unit: str
    """Unit of the ticks; empty where there are none."""
    entries: tuple[Entry, ...] = ()
    ticks: tuple[Tick, ...] = ()
    """Evenly spaced from the left end of the bar to the right."""
    bar: tuple[Color, ...] = ()
    """Evenly spaced colours of the bar, more than there are ticks."""
    tendons: tuple[Entry, ...] = ()
    tips: tuple[Entry, ...] = ()
    """And their trails."""

    def html(self) -> str:
        """A snippet that needs nothing but itself, for a white background."""
        unit = f' <span style="color:#667;font-weight:400">[{escape(self.unit)}]</span>' if self.unit else ""
        html = [f'<div style="font-weight:600;margin-bottom:4px">{escape(self.title)}{unit}</div>']
        if self.entries:
            html.append(_swatches(self.entries, "12px"))
        if self.bar:
            stops = ",".join(palette.css(color) for color in self.bar)
            labels = "".join(f"<span>{_number(tick.value)}</span>" for tick in self.ticks)
            html.append(
                '<div style="height:10px;border-radius:5px;background:linear-gradient(to '
                f'right,{stops})"></div>'
                "<div "
                f'style="display:flex;justify-content:space-between;color:#445;margin-top:2px">{labels}</div>'
            )
        if self.tendons:
            html.append(
                '<div style="font-weight:600;margin:6px 0 4px">Tendons</div>' + _swatches(self.tendons, "4px")
            )
        if self.tips:
            html.append(
                '<div style="font-weight:600;margin:6px 0 4px">Tip, and its trail</div>'
                + _swatches(self.tips, "4px")
            )
        return (
            '<div style="font:12px/1.4 system-ui,sans-serif;color:#223;padding:4px '
            f'2px">{"".join(html)}</div>'
        )


def _swatches(entries: tuple[Entry, ...], height: str) -> str:
    items = "".join(
        '<span style="display:inline-flex;align-items:center;margin:0 10px 2px 0;white-space:nowrap">'
        "<span "
        f'style="width:14px;height:{height};border-radius:3px;margin-right:5px;'
        f'background:{palette.css(entry.color)}"></span>'
        f"{escape(entry.name)}</span>"
        for entry in entries
    )
    return f'<div style="display:flex;flex-wrap:wrap">{items}</div>'


def _number(value: float) -> str:
    return f"{value:.3g}".replace("-", "−")


def legend(rods: DrawnRods, options: ViewOptions, picture: Picture) -> Legend:
    """Legend of a picture of `rods` with these options, with its ranges as they are now."""
    title, unit = _TITLES[options.color_by]
    robot = rods.robots[0]
    problem = () if bool(rods.state.ok.all()) else (Entry("not solved", palette.PROBLEM),)
    if options.color_by == "tension" and not picture.tendons_drawn:
        why = "its tendons are not drawn" if robot.n_tendons else "it has no tendons"
        return Legend(title, "", (Entry(why, palette.BODY), *problem))
    if picture.range is None:
        names = tuple(Entry(f"Segment {k + 1}", palette.segment_color(k)) for k in range(robot.n_segments))
        return Legend(title, unit, names + problem, tendons=_tendons(rods, picture))
    low = -picture.range.top if options.color_by == "tension" else 0.0
    values = np.linspace(low, picture.range.top, 5)
    table = palette.DIVERGING if options.color_by == "tension" else palette.SEQUENTIAL
    at = np.linspace(0, 255, 5).round().astype(int)
    stops = np.linspace(0, 255, 13).round().astype(int)
    return Legend(
        title,
        unit,
        problem,
        tuple(Tick(float(value), _color(table[i])) for value, i in zip(values, at, strict=True)),
        tuple(_color(table[i]) for i in stops),
        () if options.color_by == "tension" else _tendons(rods, picture),
    )


def _color(row: palette.Colors) -> Color:
    r, g, b = (int(c) for c in row)
    return r, g, b


def _tendons(rods: DrawnRods, picture: Picture) -> tuple[Entry, ...]:
    """The colours that the tendons of these robots can have."""
    if not picture.tendons_drawn:
        return ()
    unilateral = [tendon.unilateral for robot in rods.robots for tendon in robot.tendons]
    found = [Entry("taut", palette.TAUT)]
    if any(unilateral):
        found.append(Entry("slack", palette.SLACK))
    if not all(unilateral):
        found.append(Entry("pushing", palette.PUSHING))
    return tuple(found)
