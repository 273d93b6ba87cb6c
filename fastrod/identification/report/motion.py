"""From a fit in motion to a `Result`: errors on data held out, estimates, what the residual still holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fastrod.identification.log.motion import LONGEST_STEP, MotionReplay
from fastrod.identification.log.split import SplitLog
from fastrod.identification.report.assemble import error_of, estimates_of, interval_of
from fastrod.identification.report.result import Result, SearchStage
from fastrod.identification.report.verdict import choose_verdict, strained
from fastrod.identification.search.motion import MotionFit, as_given
from fastrod.identification.search.residual_test import residual_structure
from fastrod.model.robot import Robot
from fastrod.types import Floats

NO_SEARCH = "in motion only the robot's own parameters are fitted, and no effect was tried"


def assemble_motion(log: SplitLog, robot: Robot, found: MotionFit, threads: int | None) -> Result:
    """All that the report says of a fit in motion. It has no effects: before and after are the same model,
    with its own parameters fitted; `as_given_rms` is that of the robot file."""
    samples, theta = log.samples, found.fit.theta
    identified = found.model.identified(theta)
    every = samples.on(np.arange(len(samples.log)))

    def tips(one: Robot, longest_step: float = LONGEST_STEP) -> Floats:
        (pose,) = MotionReplay(every, longest_step=longest_step, threads=threads).poses([one])
        return np.where(pose.ok[:, None], pose.position, np.nan)

    given, after = tips(as_given(robot)), tips(identified)
    shift = float(np.sqrt(np.nanmean(((tips(identified, 0.5 * LONGEST_STEP) - after) ** 2).sum(1))))
    outlier = np.zeros(len(samples.log), bool)
    outlier[log.rows[found.target.weight == 0.0]] = True
    measured = samples.log.measured
    used, test = measured & ~log.tested & ~outlier, measured & log.tested
    train_error, test_error = (error_of(samples, after, after, which) for which in (used, test))
    test_error = replace(test_error, interval=interval_of(samples, after, test))
    shipped = tuple(error_of(samples, given, given, which).before for which in (used, test))
    piece = samples.on(log.rows)
    structure = residual_structure(piece, found.model.wiring, found.fit.residual, noise_lag1=found.noise.lag1)
    floor, square = found.noise.floor**2, train_error.after**2
    left_out = max(0.0, test_error.after**2 - floor) / max(test_error.after**2, 1e-30)
    grounds = choose_verdict(
        base=square,
        library=square,
        after=square,
        floor=floor,
        left_out=left_out,
        structure=structure,
        steps=(),
        found=(),
    )
    none = grounds.verdict == "none"
    error, before, noise = (1e3 * x for x in (test_error.after, shipped[1], found.noise.floor))
    summary = "In motion t" if none else f"Structure remains in the residual; {NO_SEARCH}. T"
    summary = f"{summary}he robot with its own parameters fitted leaves {error:.3g} mm on data "
    summary += f"held out ({before:.3g} mm as given, noise {noise:.3g} mm)."
    estimates, correlation = estimates_of(found.model, found.fit)
    notes = [*found.notes, f"half the time step moves the tip by {1e3 * shift:.2g} mm rms"]
    return Result(
        log=samples.log,
        robot=robot,
        identified=identified,
        held_out=log.labels,
        noise=found.noise,
        measured=measured,
        used=used,
        tested=test,
        outlier=outlier,
        before=after,
        after=after,
        train=train_error,
        test=test_error,
        verdict=grounds.verdict,
        summary=" ".join([*strained(estimates), summary]),
        effects=[],
        base_parameters=estimates | found.fixed,
        correlation=correlation,
        remaining=structure,
        remaining_kind=grounds.kind,
        remaining_fraction=grounds.left,
        patterns=(),
        tried=[],
        path=[SearchStage(name="base", train=train_error.after, held_out=test_error.after)],
        bounds=[],
        advice=[],
        notes=notes,
        solves=found.solves,
        as_given_rms=(shipped[0], shipped[1]),
    )
