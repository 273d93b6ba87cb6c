"""Reports are held against the noise: bounds of one fit, outliers of what is left, short logs."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from truth import plant

from fastrod.identification.attribution import _candidates, _needed, identify
from fastrod.identification.excite import excitation
from fastrod.identification.log.base_model import base_model
from fastrod.identification.log.forward import PredictedRod, predict
from fastrod.identification.log.samples import sample
from fastrod.identification.log.split import split, thinned
from fastrod.identification.report import report
from fastrod.identification.report.explained import Explained
from fastrod.identification.report.page import page
from fastrod.identification.report.result import Error, Result
from fastrod.identification.search import search
from fastrod.identification.search.base import fit_base
from fastrod.logs.runlog import RunLog
from fastrod.model.robotfile import load_robot

SEED, RATE = 1000, 10.0


@cache
def sealed(effect: str, seed: int = SEED) -> RunLog:
    log = excitation(load_robot("prototype"), seed=seed, rate=RATE).log
    assert log.payload is not None
    assert log.base_quaternion is not None
    inputs = plant.Inputs(log.t, log.dl, log.payload, log.base_quaternion)
    return replace(log, tip_position=plant.measure(inputs, plant.draw(seed, effect)))


@cache
def found(effect: str) -> Result:
    return identify(sealed(effect), load_robot("prototype"), threads=1)


@pytest.mark.study
def test_the_base_model_that_bounds_are_made_of_has_one_weight() -> None:
    """A bump is found and no effect: residual, slopes and weights are those of one fit, whatever weights the
    search had when the bump was taken off."""
    robot = load_robot("prototype")
    log = split([sealed("bump")], robot, ())
    some = log.samples.on(thinned(log.rows, 600))
    base = fit_base(some, log.rows, base_model(robot), robot, frozenset(), 1)
    all_found = _candidates(base, 1, lambda *_: None)
    assert all_found.last.alternatives
    outcome = _needed(base, all_found, 0)
    start = outcome.start
    assert (outcome.search.target.sigma < 0.9 * start.linearised.target.sigma).all()
    assert_allclose(start.linearised.residual(start.model, start.theta), start.fit.residual, atol=1e-6)
    # the size that would have shown grows with what is left: the bump is not in the model
    clean = {(b.name, b.parameter): b.value for b in found("none").bounds}
    ratio = [
        b.value / clean[b.name, b.parameter] for b in found("bump").bounds if (b.name, b.parameter) in clean
    ]
    assert np.nanmedian(ratio) > 1.5


@pytest.mark.study
def test_the_share_above_the_noise_is_that_of_what_is_left() -> None:
    result = found("bump")
    assert result.verdict == "not_in_library"
    assert_allclose(result.above_noise, 1.0 - (result.noise.floor / result.test.after) ** 2)
    assert found("none").above_noise == 0.0
    assert report.to_json(result)["remaining"]["above_noise"] == result.above_noise


@pytest.mark.study
@pytest.mark.parametrize("seed", [1000, 1009])
def test_what_data_held_out_do_not_gain_from_is_no_finding(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a log of noise alone, by a search that takes nearly anything."""
    for name, least in {"Z_ACCEPT": 0.5, "BIC_ACCEPT": -30.0, "FRACTION_ACCEPT": 1e-4}.items():
        monkeypatch.setattr(search, name, least)
    result = identify(sealed("none", seed), load_robot("prototype"), threads=1)
    assert result.verdict == "none"
    assert not result.effects
    assert result.test.after == result.test.before
    assert [t.name for t in result.tried if t.why.startswith("data held out do not gain")]


@pytest.mark.parametrize(
    ("lost", "fitted", "held_out", "why"),
    [
        (0.05, (3.0, 1.0), (3.0, 1.0), "with it the rod finds no balance at 5 % of the samples"),
        (0.005, (3.0, 1.0), (3.0, 1.0), ""),
        (0.0, (1.0, 0.98), (0.9, 0.92), "data held out do not gain what the fitted ones do"),
        (0.0, (1.0, 0.98), (1.0, 0.98), ""),
        (0.0, (3.0, 1.0), (3.0, 3.1), ""),  # there is much to be found: the verdict says how much is left
    ],
)
def test_what_is_found_holds_on_all_samples_and_on_those_held_out(
    lost: float, fitted: tuple[float, float], held_out: tuple[float, float], why: str
) -> None:
    """Errors before and after, in noises."""
    tip, every = np.zeros((1000, 3)), np.ones(1000, bool)
    after = np.where(np.arange(1000)[:, None] < 1000 * lost, np.nan, tip)
    errors = (Error(before=b, after=a, interval=(a, a)) for b, a in (fitted, held_out))
    state: Any = None
    explained = Explained(state, state, state, ("friction",), ~every, every, every, tip, tip, after, *errors)
    assert explained.refused(1.0) == why


@pytest.mark.study
def test_nothing_is_rejected_for_another_where_no_other_is_kept() -> None:
    result = found("bump")
    assert not result.effects
    assert not any("another explains more" in t.why for t in result.tried)


@pytest.mark.study
def test_the_headline_says_what_effects_do_in_millimetres() -> None:
    result = found("gravity")
    before, after, noise = (1e3 * x for x in (result.test.before, result.test.after, result.noise.floor))
    start = f"from {before:.2f} to {after:.2f} mm (noise {noise:.2f})."
    assert result.summary.startswith(f"Adding gravity cuts the held-out error {start}")


@pytest.mark.study
def test_errors_with_and_without_outliers_are_both_there() -> None:
    """Ten held-out rows a centimetre off: the error without them is as before, and a note has the other."""
    log = sealed("gravity")
    tip = np.array(log.tip_position)
    held = np.flatnonzero(found("gravity").tested)
    tip[held[5 :: len(held) // 10]] += 0.01
    result = identify(replace(log, tip_position=tip), load_robot("prototype"), threads=1)
    assert_allclose(result.test.after, found("gravity").test.after, rtol=0.05)
    assert result.test.all_rows > 1.5 * result.test.after
    assert any("outliers of what is left" in note for note in result.notes)
    assert f"that jump; with them {1e3 * result.test.all_rows:.3g} mm held out" in page(result)
    assert not any("outliers of what is left" in note for note in found("gravity").notes)


@pytest.mark.study
@pytest.mark.parametrize("seconds", [5.0, 60.0])
def test_a_short_log_claims_no_shares(seconds: float) -> None:
    log = found("gravity").log
    result = replace(found("gravity"), log=replace(log, t=log.t * seconds / np.ptp(log.t)))
    assert result.knows_fractions == (seconds > 10.0)
    assert math.isfinite(result.explained_fraction) == (seconds > 10.0)
    said = page(result)
    assert ("The residual's variance" in said) == (seconds > 10.0)
    assert ("too short to say which share" in said) == (seconds < 10.0)


@pytest.mark.study
@pytest.mark.parametrize("longer", [0.0, 0.05])
def test_a_parameter_beyond_its_prior_is_the_first_thing_said(longer: float) -> None:
    """Noise of 0.1 mm on the model's own tips, of a segment that is 5 % longer than a prior of 0.5 % says."""
    robot = load_robot("prototype")
    (segment,) = robot.segments
    length = float(segment.length)
    robot = replace(robot, fit={**robot.fit, "segment.1.length": {"sd": 0.005 * length}})
    log = excitation(robot, seed=SEED, rate=RATE).log
    log = replace(log, tip_position=np.zeros((len(log), 3)))
    true = replace(robot, segments=(replace(segment, length=(1.0 + longer) * length),))
    model, samples = base_model(true), sample(log)
    tip = predict(model, model.start, samples, PredictedRod(samples, true, threads=1)).position
    tip = tip + 1e-4 * np.random.default_rng(0).normal(size=tip.shape)
    result = identify(replace(log, tip_position=tip), robot, threads=1)
    e = result.base_parameters["segment.1.length"]
    assert e.beyond_prior == (longer > 0.0)
    assert_allclose(e.prior_mean, length)
    made = report.to_json(result)["base_parameters"]["segment.1.length"]
    assert made["prior_distance_sd"] == e.prior_distance
    said = "Evidence of missing physics: length, segment 1 comes out at "
    assert result.summary.startswith(said) == (longer > 0.0)
    assert (" sd from its prior" in page(result)) == (longer > 0.0)
    assert not (longer and "nothing is missing" in result.summary)
