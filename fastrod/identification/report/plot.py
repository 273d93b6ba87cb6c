"""Picture of a result, for a notebook: what is left over time, before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fastrod.identification.report.result import Result


def plot_result(result: Result) -> Figure:
    """Distance between measured and predicted tip [mm] over the samples of the log, before and after, and how
    it spreads on data held out; held-out stretches are shaded."""
    from matplotlib import pyplot

    figure, (over, spread) = pyplot.subplots(
        1, 2, figsize=(10.0, 3.2), width_ratios=(3.0, 1.0), layout="constrained", sharey=True
    )
    time = np.arange(len(result.log)) if len(result.log.runs) > 1 else result.log.t - result.log.t[0]
    each = (("before", result.residual_before, "#9ca3af"), ("after", result.residual_after, "#e4572e"))
    bins = None
    for label, residual, colour in each:
        size = 1e3 * np.linalg.norm(residual, axis=1)
        over.plot(time, size, color=colour, lw=0.7, label=label)
        held = size[result.tested & np.isfinite(size)]
        if held.size:
            bins = np.linspace(0.0, float(held.max()), 41) if bins is None else bins
            spread.hist(held, bins, color=colour, alpha=0.7, orientation="horizontal")
    over.fill_between(
        time,
        0.0,
        1.0,
        where=result.tested,
        transform=over.get_xaxis_transform(),
        color="#2a78b5",
        alpha=0.08,
        lw=0.0,
    )
    over.axhline(1e3 * result.noise.floor, color="black", lw=0.8, ls="--", label="noise")
    over.set(xlabel="row" if len(result.log.runs) > 1 else "t [s]", ylabel="tip error [mm]", ylim=(0.0, None))
    over.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False, fontsize=8)
    spread.set(xlabel="held-out rows")
    found = ", ".join(each.name.replace("_", " ") for each in result.effects) or result.verdict.replace(
        "_", " "
    )
    over.set_title(f"{result.log.name} on {result.robot.name}: {found}", loc="left", fontsize=10)
    return figure


def html_of(result: Result) -> str:
    """The summary and its tables, as the command prints them."""
    import io

    from rich.console import Console

    from fastrod.identification.report.report import table

    console = Console(record=True, file=io.StringIO(), width=100)
    console.print(table(result))
    return console.export_html(inline_styles=True, code_format="<pre style='line-height:1.2'>{code}</pre>")
