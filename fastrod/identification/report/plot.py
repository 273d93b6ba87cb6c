"""Picture of what a result leaves, for a notebook."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fastrod.types import Flags, Floats

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_errors(
    time: Floats, before: Floats, after: Floats, held_out: Flags, noise: float, title: str
) -> Figure:
    """Distance between measured and predicted tip [mm] over `time` (n,), from the residuals `before` and
    `after` (n, 3) [m], and how it spreads over the rows that are `held_out` (n,), which are shaded."""
    from matplotlib import pyplot

    figure, (over, spread) = pyplot.subplots(
        1, 2, figsize=(10.0, 3.2), width_ratios=(3.0, 1.0), layout="constrained", sharey=True
    )
    sizes = [1e3 * np.linalg.norm(residual, axis=1) for residual in (before, after)]
    bins = np.linspace(0.0, float(np.nanmax(sizes[0], initial=1e-3)), 41)
    for size, label, colour in zip(sizes, ("before", "after"), ("#9ca3af", "#e4572e"), strict=True):
        over.plot(time, size, color=colour, lw=0.7, label=label)
        spread.hist(
            size[held_out & np.isfinite(size)], bins, color=colour, alpha=0.7, orientation="horizontal"
        )
    shade = {"transform": over.get_xaxis_transform(), "color": "#2a78b5", "alpha": 0.08, "lw": 0.0}
    over.fill_between(time, 0.0, 1.0, where=held_out, **shade)
    over.axhline(1e3 * noise, color="black", lw=0.8, ls="--", label="noise")
    over.set(xlabel="t [s]", ylabel="tip error [mm]", ylim=(0.0, None))
    over.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False, fontsize=8)
    spread.set(xlabel="held-out rows")
    over.set_title(title, loc="left", fontsize=10)
    return figure
