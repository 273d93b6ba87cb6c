"""Colours: of segments, of tendons, of things, and of numbers. All read well on white and for colour-blind
eyes."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fastrod.types import Floats

Color: TypeAlias = tuple[int, int, int]
"""Red, green, blue, 0 to 255."""
Colors: TypeAlias = NDArray[np.uint8]
"""(..., 3)"""

SEGMENTS: tuple[Color, ...] = (
    (51, 119, 187),
    (238, 119, 51),
    (0, 153, 136),
    (221, 170, 51),
    (153, 85, 170),
    (80, 190, 235),
    (225, 130, 160),
    (140, 145, 50),
    (60, 50, 130),
    (130, 95, 70),
)
BODY: Color = (214, 217, 222)
SPACER: Color = (226, 228, 232)
SEGMENT_END: Color = (164, 170, 180)
BASE: Color = (96, 102, 112)
PROBLEM: Color = (214, 39, 40)
TAUT: Color = (120, 62, 28)
SLACK: Color = (150, 200, 240)
PUSHING: Color = (148, 62, 200)
CONTACT: Color = (220, 38, 50)
LOAD: Color = (245, 140, 20)
GHOST: Color = (150, 156, 168)
"""For comparison only."""
MEASURED: Color = (20, 140, 90)
TRAIL: Color = (120, 90, 190)
ACCENT: Color = (255, 170, 20)
"""For what can be dragged."""
AXES: tuple[Color, Color, Color] = ((222, 48, 48), (40, 165, 70), (45, 90, 220))

_NICE = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)


def _table(*controls: Color) -> Colors:
    """(256, 3) straight between evenly spaced control colours."""
    at = np.linspace(0.0, 1.0, len(controls))
    channels = [np.interp(np.linspace(0.0, 1.0, 256), at, channel) for channel in np.array(controls, float).T]
    return np.stack(channels, axis=1).round().astype(np.uint8)


SEQUENTIAL: Colors = _table(
    (58, 22, 92),
    (58, 64, 140),
    (42, 108, 147),
    (30, 150, 138),
    (84, 192, 104),
    (172, 218, 68),
    (252, 232, 80),
)
"""(256, 3) from none, dark, to most, bright; it brightens all the way."""
DIVERGING: Colors = _table(
    (34, 60, 140),
    (70, 130, 200),
    (150, 185, 215),
    (196, 196, 196),
    (238, 176, 110),
    (214, 98, 36),
    (130, 24, 16),
)
"""(256, 3) from most negative over none to most positive."""


def segment_color(k: int) -> Color:
    """Colour of segment k, counted from 0; after the tenth they begin again."""
    return SEGMENTS[k % len(SEGMENTS)]


def sequential(values: Floats, top: float) -> Colors:
    """(..., 3) of values (...) from 0 to `top`; beyond, as at the end."""
    return np.asarray(SEQUENTIAL[np.clip(values * (255.0 / top), 0.0, 255.0).astype(np.intp)])


def diverging(values: Floats, top: float) -> Colors:
    """(..., 3) of values (...) from -top to `top`; beyond, as at the ends."""
    return np.asarray(DIVERGING[np.clip(127.5 + values * (127.5 / top), 0.0, 255.0).astype(np.intp)])


def blend(color: Colors | Color, other: Color, fraction: float | Floats) -> Colors:
    """Return colours (..., 3) with this fraction of another, one or (..., 1)."""
    color = np.asarray(color, np.float64)
    return np.asarray((color * (1.0 - fraction) + np.asarray(other) * fraction).round().astype(np.uint8))


def css(color: Color | Colors) -> str:
    """
    >>> css((51, 119, 187))
    '#3377bb'
    """
    return "#" + "".join(f"{int(c):02x}" for c in color)


def nice_above(value: float) -> float:
    """The next round number: ranges of colours end there, so that they seldom change.

    >>> nice_above(0.23), nice_above(11.0)
    (0.3, 15.0)
    """
    ten = 10.0 ** np.floor(np.log10(value))
    return float(f"{next(step for step in _NICE if value <= step * ten * (1.0 + 1e-9)) * ten:.3g}")


class Range:
    """End of a range of colours: a round number beyond what was seen, which never shrinks, so that colours do
    not flicker."""

    def __init__(self, least: float) -> None:
        """`least` [unit of the values]: it goes that far from the beginning."""
        self.least = least
        self.top = nice_above(least)

    def see(self, values: Floats) -> float:
        """The range with these values (...), finite, in it; what only one in fifty exceeds is left out."""
        if values.size:
            size = np.abs(values).ravel()
            last = int(np.ceil(0.98 * (len(size) - 1)))
            seen = float(np.partition(size, last)[last])
            if seen > self.top:
                self.top = nice_above(seen)
        return self.top

    def forget(self) -> None:
        """Back to the beginning."""
        self.top = nice_above(self.least)
