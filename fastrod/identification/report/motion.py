"""A robot that rings, beside a model at rest: inertia and damping as what that lacks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fastrod.identification.log.split import SplitLog
from fastrod.identification.report.explained import error_of, shipped, tips_of
from fastrod.identification.report.result import Found, Result, SearchStage
from fastrod.identification.report.wording import BASE_MODELS, words
from fastrod.identification.search.base import BaseFit
from fastrod.identification.search.motion import DAMPING, INERTIA, undamped

_EXPLAINED = 1.1  # of the noise


def named(result: Result, log: SplitLog, without: BaseFit, moving: BaseFit, laws: Sequence[str]) -> Result:
    """The `result` of a search beside `moving`, a fit in motion, with what that has beyond the fit `without`
    it as what the model lacked: `laws`, inertia and damping or damping alone."""
    samples = log.samples
    plain = tips_of(without.start, samples, without)
    ringing = tips_of(undamped(moving.start), samples, moving) if INERTIA in laws else plain
    errors = [
        [error_of(samples, tip, result.after, rows) for rows in (result.used, result.tested)]
        for tip in (plain, ringing)
    ]
    (train, test), (_, lossless) = errors
    test = replace(test, interval=result.test.interval, all_rows=result.test.all_rows)
    floor, square = result.noise.floor, test.before**2
    excess = max(square - floor**2, 1e-18)
    damping = {name: e for name, e in result.base_parameters.items() if name.endswith("damping_time")}
    before = {INERTIA: square, DAMPING: lossless.before**2}
    beyond = result.test.before**2 if result.effects else test.after**2  # of these, without further effects
    found = [
        Found(
            name=name,
            title=(BASE_MODELS[name].__doc__ or "").strip().splitlines()[0],
            parameters=damping if name == DAMPING else {},
            held_out_gain=min(1.0, float((before[name] - beyond) / excess)),
            evidence={"held_out_rms_without_m": float(np.sqrt(before[name]))},
            cannot_be_told_from=[],
        )
        for name in laws
    ]
    effects = [*found, *result.effects]
    explained = test.after <= _EXPLAINED * floor
    left = max(test.after**2 - floor**2, 0.0) / excess
    names = ", ".join(words(each.name) for each in effects)
    said = (
        f"The robot rings: adding {names} cuts the held-out error from {1e3 * test.before:.3g} to "
        f"{1e3 * test.after:.3g} mm (noise {1e3 * floor:.2g})."
    )
    more = "" if explained else f" {100 * left:.2g} % of the mean square is left."
    with_them = replace(result.path[0], name=" and ".join(laws))
    path = [SearchStage(name="base", train=train.before, held_out=test.before), with_them, *result.path[1:]]
    others = {name: e for name, e in result.base_parameters.items() if name not in damping}
    return replace(
        result,
        before=plain,
        train=train,
        test=test,
        verdict="explained" if explained else "partly_explained",
        summary=f"{said}{more}",
        effects=effects,
        base_parameters=others,
        remaining_fraction=left,
        as_given_rms=shipped(without, result.used, result.tested),
        path=path,
    )
