"""Paths for a tip to follow: squares, circles and helices of the paper's tracking experiment (SoftManiSim,
CoRL 2024)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from fastrod.checks import Bound, check_number, checked_array
from fastrod.errors import InputError, UnknownNameError, nearest
from fastrod.types import Floats

Path: TypeAlias = Callable[[Floats], tuple[Floats, Floats]]
"""Time (...,) [s] -> position about the center [m] and velocity [m/s], each (..., 3)."""


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """A point that moves along a path forever, world axes: the plane is x-y, z the axis of a helix.

    >>> circle(radius=0.2, period=20.0, center=(0.5, 0.0, 0.3)).position(0.0).tolist()
    [0.7, 0.0, 0.3]
    """

    name: str
    period: float
    """Time of one lap [s]; a path in the plane is then back where it began."""
    center: tuple[float, float, float]
    """World [m]."""
    path: Path
    """Position about the center, and velocity."""

    def __post_init__(self) -> None:
        check_number(f"period of {self.name}", self.period, Bound(above=0.0, unit="s"))
        center = checked_array(f"center of {self.name}", self.center, [(3,)], "world [m]")
        object.__setattr__(self, "center", tuple(center.tolist()))

    def position(self, t: ArrayLike) -> Floats:
        """(..., 3) world [m] at times (...,) [s]. Raises `InputError` where a time is not a finite number."""
        return np.asarray(self.path(_times(t))[0] + np.array(self.center))

    def velocity(self, t: ArrayLike) -> Floats:
        """(..., 3) world [m/s] at times (...,) [s]; at a corner that of the side that begins. Raises
        `InputError` as `position`."""
        return self.path(_times(t))[1]


def square(*, side: float = 0.4, period: float = 20.0, center: ArrayLike = (0.0, 0.0, 0.0)) -> Trajectory:
    """A square of this side [m] about the center, counterclockwise from the corner at (-x, -y), at constant
    speed: a quarter of the period [s] a side. Source: SoftManiSim, CoRL 2024, its tracking experiment. Raises
    `InputError`."""
    check_number("side of square", side, Bound(above=0.0, unit="m"))
    return Trajectory(
        name="square", period=period, center=_center(center), path=lambda t: _square(t, side, period)
    )


def triangle(*, side: float = 0.04, period: float = 20.0, center: ArrayLike = (0.0, 0.0, 0.0)) -> Trajectory:
    """An equilateral triangle of this side [m] about the center, counterclockwise from the corner at -y on
    the left, at constant speed:
    a third of the period [s] a side. Source: SoftManiSim, CoRL 2024, its experiment with the prototype.
    Raises `InputError`."""
    check_number("side of triangle", side, Bound(above=0.0, unit="m"))
    return Trajectory(
        name="triangle", period=period, center=_center(center), path=lambda t: _triangle(t, side, period)
    )


def circle(*, radius: float = 0.2, period: float = 20.0, center: ArrayLike = (0.0, 0.0, 0.0)) -> Trajectory:
    """A circle of this radius [m] about the center, counterclockwise from (+x, 0), one lap a period [s].
    Source: SoftManiSim, CoRL 2024, its tracking experiment. Raises `InputError`."""
    check_number("radius of circle", radius, Bound(above=0.0, unit="m"))
    return Trajectory(
        name="circle", period=period, center=_center(center), path=lambda t: _circle(t, radius, period)
    )


def figure_eight(
    *, size: float = 0.2, period: float = 20.0, center: ArrayLike = (0.0, 0.0, 0.0)
) -> Trajectory:
    """x = size sin(2 w t), y = size sin(w t) [m] with w = 2 pi / period; by default the paper's x = 0.2 sin(2
    pi t / 10), y = 0.2 sin(pi t / 10), which is back after 20 s. Source: SoftManiSim, CoRL 2024, its tracking
    experiment. Raises `InputError`."""
    check_number("size of figure_eight", size, Bound(above=0.0, unit="m"))

    def path(t: Floats) -> tuple[Floats, Floats]:
        w = 2.0 * math.pi / period
        zero = np.zeros_like(t)
        position = np.stack([size * np.sin(2.0 * w * t), size * np.sin(w * t), zero], axis=-1)
        return position, np.stack(
            [2.0 * w * size * np.cos(2.0 * w * t), w * size * np.cos(w * t), zero], axis=-1
        )

    return Trajectory(name="figure_eight", period=period, center=_center(center), path=path)


def helix(
    *,
    radius: float = 0.2,
    pitch: float = 0.1,
    downward: bool = True,
    period: float = 20.0,
    center: ArrayLike = (0.0, 0.0, 0.0),
) -> Trajectory:
    """The circle that sinks (or, `downward` False, rises) by `pitch` [m] a lap, from the height of the
    center; a lap takes one period [s]. Source: SoftManiSim, CoRL 2024, its tracking experiment. Raises
    `InputError`."""
    check_number("radius of helix", radius, Bound(above=0.0, unit="m"))
    rise = _rise("helix", pitch, downward, period)
    return Trajectory(
        name="helix",
        period=period,
        center=_center(center),
        path=lambda t: _lifted(_circle(t, radius, period), t, rise),
    )


def square_helix(
    *,
    side: float = 0.2,
    pitch: float = 0.02,
    downward: bool = True,
    period: float = 20.0,
    center: ArrayLike = (0.0, 0.0, 0.0),
) -> Trajectory:
    """The square that sinks (or, `downward` False, rises) evenly by `pitch` [m] a lap, from the height of the
    center; a lap takes one period [s]. Source: SoftManiSim, CoRL 2024, its tracking experiment. Raises
    `InputError`."""
    check_number("side of square_helix", side, Bound(above=0.0, unit="m"))
    rise = _rise("square_helix", pitch, downward, period)
    return Trajectory(
        name="square_helix",
        period=period,
        center=_center(center),
        path=lambda t: _lifted(_square(t, side, period), t, rise),
    )


_KNOWN: dict[str, tuple[Callable[..., Trajectory], tuple[str, ...]]] = {
    "square": (square, ("side", "period", "center")),
    "triangle": (triangle, ("side", "period", "center")),
    "circle": (circle, ("radius", "period", "center")),
    "figure_eight": (figure_eight, ("size", "period", "center")),
    "helix": (helix, ("radius", "pitch", "downward", "period", "center")),
    "square_helix": (square_helix, ("side", "pitch", "downward", "period", "center")),
}


def references(height: float, period: float = 9.0) -> dict[str, Trajectory]:
    """The references of the paper's real prototype (SoftManiSim, CoRL 2024, appendix H) by name: a triangle
    and a square of 40 and 25 mm and a circle of 20 mm radius, one lap in `period` [s], in the plane `height`
    [m] above the base. Raises `InputError`."""
    center = (0.0, 0.0, height)
    return {
        "triangle": triangle(side=0.04, period=period, center=center),
        "square": square(side=0.025, period=period, center=center),
        "circle": circle(radius=0.02, period=period, center=center),
    }


def names() -> tuple[str, ...]:
    """The names that `trajectory` knows."""
    return tuple(_KNOWN)


def trajectory(name: str, **options: Any) -> Trajectory:
    """The trajectory of this name; options as for the function of that name. Raises `UnknownNameError`,
    `InputError`.

    >>> trajectory("helix", pitch=0.05).position(20.0).round(6).tolist()
    [0.2, -0.0, -0.05]
    """
    if name not in _KNOWN:
        raise UnknownNameError(f"no trajectory {name!r}; {nearest(str(name), _KNOWN)}")
    make, known = _KNOWN[name]
    for option in options:
        if option not in known:
            raise UnknownNameError(f"{name} has no option {option!r}; {nearest(option, known)}")
    return make(**options)


def _square(t: Floats, side: float, period: float) -> tuple[Floats, Floats]:
    corners = side * np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
    return _polygon(
        t,
        corners,
        np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
        side,
        period,
    )


def _triangle(t: Floats, side: float, period: float) -> tuple[Floats, Floats]:
    high, low = side / math.sqrt(3.0), -0.5 * side / math.sqrt(3.0)
    corners = np.array([[-0.5 * side, low, 0.0], [0.5 * side, low, 0.0], [0.0, high, 0.0]])
    c, s = 0.5, math.sqrt(0.75)
    return _polygon(t, corners, np.array([[1.0, 0.0, 0.0], [-c, s, 0.0], [-c, -s, 0.0]]), side, period)


def _polygon(
    t: Floats, corners: Floats, directions: Floats, side: float, period: float
) -> tuple[Floats, Floats]:
    """Along equal sides from corner to corner."""
    n = len(corners)
    laps = n * t / period
    k = np.floor(laps)
    # a corner belongs to the side that begins, also where the division fell short of the whole number by its
    # rounding
    k += laps - k > 1.0 - 4.0 * np.spacing(np.maximum(np.abs(laps), 1.0))
    fraction = np.maximum(laps - k, 0.0)[..., None]
    which = k.astype(np.int64) % n
    along = directions[which]
    return corners[which] + side * fraction * along, n * side / period * along


def _circle(t: Floats, radius: float, period: float) -> tuple[Floats, Floats]:
    w = 2.0 * math.pi / period
    c, s, zero = np.cos(w * t), np.sin(w * t), np.zeros_like(t)
    return radius * np.stack([c, s, zero], axis=-1), radius * w * np.stack([-s, c, zero], axis=-1)


def _lifted(flat: tuple[Floats, Floats], t: Floats, rise: float) -> tuple[Floats, Floats]:
    position, velocity = flat
    position[..., 2] = rise * t
    velocity[..., 2] = rise
    return position, velocity


def _rise(name: str, pitch: float, downward: bool, period: float) -> float:
    """[m/s]."""
    check_number(f"pitch of {name}", pitch, Bound(above=0.0, unit="m"))
    check_number(f"period of {name}", period, Bound(above=0.0, unit="s"))
    return (-pitch if downward else pitch) / period


def _center(center: ArrayLike) -> Any:
    """`Trajectory` checks it."""
    return center


def _times(t: ArrayLike) -> Floats:
    try:
        times = np.asarray(t, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"t is {t!r}; give times [s], a number or an array of them.") from error
    if not np.isfinite(times).all():
        raise InputError("t holds a time that is not finite; give times [s].")
    return times
