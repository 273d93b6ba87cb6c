"""Result of an identification, as data: every table and figure of the report is drawn from a `Result`."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from fastrod.identification.log.noise import Noise
from fastrod.identification.log.registration import CameraRegistration
from fastrod.identification.report.signature import Signature
from fastrod.identification.search.model_selection import DetectionLimit
from fastrod.identification.search.residual_test import ResidualStructure
from fastrod.identification.search.revisits import Revisits
from fastrod.identification.search.solve import Estimate
from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Robot
from fastrod.types import Flags, Floats

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHORT = 10.0
"""s; of a shorter log no shares are given: its held-out stretches are half a second each."""
Verdict = Literal["none", "explained", "partly_explained", "ambiguous", "not_in_library"]


@dataclass(frozen=True, kw_only=True)
class Found:
    """An effect that the model lacked."""

    name: str
    title: str
    parameters: Mapping[str, Estimate]
    held_out_gain: float
    """Share of the held-out error (mean square above the noise) that goes with it: what is lost when it is
    taken out again."""
    evidence: Mapping[str, float]
    """z over held-out blocks, BIC, share of the loss, when it was added."""
    cannot_be_told_from: Sequence[str]
    drive: int | None = None
    """The one drive that has it, from 1 on; None where it is not one drive's."""
    signatures: Sequence[Signature] = ()
    """Signatures: of the effect by itself, then of the effects that it cannot be distinguished from; empty
    without tendons."""


@dataclass(frozen=True, kw_only=True)
class Tried:
    """A candidate of the first stage."""

    name: str
    held_out_rms: float
    """Cross-validated on blocks of the training data, distance [m]; nan where it was not fitted."""
    score: float
    """z over those blocks."""
    bic_gain: float
    kept: bool
    why: str
    kind: str
    """`effect`, `tendons` for another base model, or the kind of an alternative pattern."""


@dataclass(frozen=True, kw_only=True)
class Error:
    """Distance between measured and predicted tip, root mean square [m]."""

    before: float
    after: float
    interval: tuple[float, float]
    """95 % interval of `after`, from blocks."""
    all_rows: float = float("nan")
    """`after` with the rows that were left out as outliers."""


@dataclass(frozen=True, kw_only=True)
class SearchStage:
    """One point of the path from before to after."""

    name: str
    """Name of the effect that was added; `base` for the first."""
    train: float
    held_out: float
    """Distance rms [m]."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Result:
    """Everything that `identify` found. Lengths in metres, base frame."""

    log: RunLog
    """The driven samples in order of time."""
    robot: Robot
    """Nominal."""
    identified: Robot
    """With the fitted parameters and the found effects."""
    held_out: Sequence[str]
    """Description of the held-out rows."""
    noise: Noise
    measured: Flags
    """(n,) samples with a measured tip."""
    used: Flags
    """(n,) samples that were fitted."""
    tested: Flags
    """(n,) samples that were held out."""
    outlier: Flags
    """(n,)."""
    before: Floats
    """(n, 3) tip of the base model with its own parameters fitted."""
    after: Floats
    """(n, 3) tip of the identified model."""
    train: Error
    test: Error
    verdict: Verdict
    summary: str
    """The verdict in a sentence or two."""
    effects: Sequence[Found]
    base_parameters: Mapping[str, Estimate]
    correlation: tuple[Sequence[str], Floats]
    """Names and (p, p) correlations of all fitted numbers."""
    remaining: ResidualStructure
    remaining_kind: str
    """none | static | memory | drift | unknown."""
    remaining_fraction: float
    """Fraction that remains of the mean square error above the noise that the base model left."""
    patterns: Sequence[str]
    """Patterns of the remaining structure, where a pattern outside the library fits it."""
    tried: Sequence[Tried]
    path: Sequence[SearchStage]
    bounds: Sequence[DetectionLimit]
    advice: Sequence[str]
    notes: Sequence[str]
    """Remarks on what is unusual in this log."""
    solves: int
    """Batches of the rod that the search took."""
    registration: CameraRegistration | None = None
    """Pose of the camera relative to the robot file, fitted; None where it stood near enough for the
    search."""
    clock: Estimate | None = None
    """Time by which commands stand later in the log than they acted [s]; None where both have one clock."""
    sessions: Mapping[str, Robot] = field(default_factory=dict)
    """The identified robot in each other session, by its label."""
    as_given_rms: tuple[float, float] | None = None
    """Error of the robot as it was given, rms on fitted and on held-out samples [m]; None where it was not
    asked for."""
    revisits: tuple[Revisits, Revisits] | None = None
    """The same command at other times, before and after; None where too few come again."""
    network: Mapping[str, float] = field(default_factory=dict)
    """Held-out rms with a network on what is left, where one was asked for."""

    def plot(self) -> Figure:
        """Draw what is left over time, before and after, runs one after the other, and on data held out; a
        figure of matplotlib."""

        t, step = self.log.t, np.diff(self.log.t, prepend=self.log.t[:1])
        step[np.flatnonzero(self.log.run[1:] != self.log.run[:-1]) + 1] = 0.0
        title = f"{self.log.name} on {self.robot.name}: {self._found.replace('_', ' ')}"
        errors = self.residual_before, self.residual_after
        return plot_errors(np.cumsum(step) if len(t) else t, *errors, self.tested, self.noise.floor, title)

    @property
    def _found(self) -> str:
        return ", ".join(each.name for each in self.effects) or self.verdict

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{each.name}</td><td>{name}</td>"
            f"<td>{e.value:.5g} &plusmn; {e.stderr:.2g} {e.unit}</td></tr>"
            for each in self.effects
            for name, e in each.parameters.items()
        )
        return f"<p><b>{self.verdict}</b> {html.escape(self.summary)}</p><table>{rows}</table>"

    def __repr__(self) -> str:
        errors = f"held out {1e3 * self.test.before:.3g} to {1e3 * self.test.after:.3g} mm"
        return f"Result({self.log.name!r} on {self.robot.name!r}: {self.verdict}, {self._found}, {errors})"

    @property
    def above_noise(self) -> float:
        """Share of the held-out mean square after that is above the noise; 0 where that is not sure."""
        if not self.test.after > self.noise.most(int(self.tested.sum())):
            return 0.0
        return 1.0 - (self.noise.floor / self.test.after) ** 2

    @property
    def knows_fractions(self) -> bool:
        """Whether the log is long enough to say which fraction of an error is gone or left."""
        return math.isfinite(self.test.interval[0]) and float(np.ptp(self.log.t)) >= SHORT

    @property
    def explained_fraction(self) -> float:
        """Share of the held-out error above the noise that is gone; nan where there was none."""
        floor = self.noise.floor**2
        excess = self.test.before**2 - floor
        if excess <= 0.03 * floor or not self.knows_fractions:
            return math.nan
        return min(1.0, (self.test.before**2 - self.test.after**2) / excess)

    @property
    def residual_before(self) -> Floats:
        """(n, 3) measured - predicted [m]; nan where nothing was measured."""
        return np.asarray(self.log.tip_position - self.before)

    @property
    def residual_after(self) -> Floats:
        """(n, 3) measured - predicted [m]."""
        return np.asarray(self.log.tip_position - self.after)


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
