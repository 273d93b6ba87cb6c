"""A robot that rings, beside a model at rest: inertia and damping as what that lacks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fastrod.identification.log.split import SplitLog
from fastrod.identification.report.assemble import error_of, shipped, tips_of
from fastrod.identification.report.result import Found, Result, SearchStage
from fastrod.identification.report.wording import words
from fastrod.identification.search.base import BaseFit
from fastrod.identification.search.motion import DAMPING, INERTIA, Damping, Inertia, undamped

_EXPLAINED = 1.1  # of the noise


def named_inertia(result: Result, log: SplitLog, still: BaseFit, moving: BaseFit) -> Result:
    """The `result` of a fit in motion, `moving`, beside the fit at rest, `still`: inertia and damping are
    what the model lacked."""
    samples = log.samples
    at_rest = tips_of(still.start, samples, still)
    ringing = tips_of(undamped(moving.start), samples, moving)
    errors = [
        [error_of(samples, tip, result.after, rows) for rows in (result.used, result.tested)]
        for tip in (at_rest, ringing)
    ]
    (train, test), (_, lossless) = errors
    test = replace(test, interval=result.test.interval, all_rows=result.test.all_rows)
    floor, square = result.noise.floor, test.before**2
    excess = max(square - floor**2, 1e-18)
    damping = {name: e for name, e in result.base_parameters.items() if name.endswith("damping_time")}
    before = {INERTIA: square, DAMPING: lossless.before**2}
    effects = [
        Found(
            name=name,
            title=(law.__doc__ or "").strip().splitlines()[0],
            parameters=damping if name == DAMPING else {},
            held_out_gain=min(1.0, float((before[name] - test.after**2) / excess)),
            evidence={"held_out_rms_without_m": float(np.sqrt(before[name]))},
            cannot_be_told_from=[],
        )
        for name, law in ((INERTIA, Inertia), (DAMPING, Damping))
    ]
    explained = test.after <= _EXPLAINED * floor
    left = max(test.after**2 - floor**2, 0.0) / excess
    said = (
        f"The robot rings: adding {words(INERTIA)} and {words(DAMPING)} cuts the held-out error from "
        f"{1e3 * test.before:.3g} to {1e3 * test.after:.3g} mm (noise {1e3 * floor:.2g})."
    )
    more = "" if explained else f" {100 * left:.2g} % of the mean square is left."
    path = [
        SearchStage(name="base", train=train.before, held_out=test.before),
        SearchStage(name=f"{INERTIA} and {DAMPING}", train=train.after, held_out=test.after),
    ]
    others = {name: e for name, e in result.base_parameters.items() if name not in damping}
    return replace(
        result,
        before=at_rest,
        train=train,
        test=test,
        verdict="explained" if explained else "partly_explained",
        summary=f"{said}{more}",
        effects=[*effects, *result.effects],
        base_parameters=others,
        remaining_fraction=left,
        as_given_rms=shipped(still, result.used, result.tested),
        path=path,
    )
