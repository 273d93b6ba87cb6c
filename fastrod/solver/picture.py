"""Picture and table of a state, for a notebook."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from fastrod.errors import InputError
from fastrod.types import Flags, Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST = 30  # robots that are drawn, the first ones
_LISTED = 8  # robots of the table


def plot_rods(position: Floats, axes: Axes | None = None) -> Axes:
    """Backbones (n_robots, n_points, 3) [m] of the first robots, in mm, on 3D axes; new ones where none are
    given."""
    from matplotlib import pyplot

    if position.size == 0:
        raise InputError("this state has tips only; make the simulator with outputs='full' to plot it.")
    if axes is None:
        axes = pyplot.figure(figsize=(5.0, 5.0)).add_subplot(projection="3d")
    rods = 1e3 * position[:_MOST]
    for rod in rods:
        axes.plot(*rod.T, lw=2.0)
        axes.plot(*rod[-1:].T, "o", color="black", ms=3.0)
    known = rods[np.isfinite(rods).all(axis=(1, 2))].reshape(-1, 3)
    if len(known):
        middle, half = 0.5 * (known.max(0) + known.min(0)), 0.55 * float(np.ptp(known, axis=0).max())
        for name, at in zip("xyz", middle, strict=True):
            getattr(axes, f"set_{name}lim")(at - half, at + half)
            getattr(axes, f"set_{name}label")(f"{name} [mm]")
        axes.set_box_aspect((1.0, 1.0, 1.0))  # type: ignore[arg-type]
    return axes


def html_of(tip_position: Floats, tensions: Floats, ok: Flags, problems: Mapping[int, str]) -> str:
    """Tips and tensions of the first robots as an HTML table."""
    rows = []
    for i in range(min(_LISTED, len(ok))):
        tip = ", ".join(f"{1e3 * x:.2f}" for x in np.round(tip_position[i], 5) + 0.0)
        tension = ", ".join(f"{x:.3g}" for x in np.round(tensions[i], 6) + 0.0)
        said = "ok" if ok[i] else problems.get(i, "not ok")
        rows.append(f"<tr><td>{i}</td><td>{tip}</td><td>{tension}</td><td>{said}</td></tr>")
    more = len(ok) - len(rows)
    head = "".join(f"<th>{name}</th>" for name in ("robot", "tip [mm]", "tension [N]", ""))
    rest = f"<tr><td colspan=4>and {more} more</td></tr>" if more else ""
    return f"<table><tr>{head}</tr>{''.join(rows)}{rest}</table>"
