"""Friction of the body, distinguished from friction of the tendons by what the solved rod remembers."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from identification.logs import log_of, one_sided
from scipy.spatial.transform import Rotation

from fastrod.effects.executor import link, stay_back
from fastrod.identification.attribution import identify
from fastrod.identification.log.base_model import base_model
from fastrod.identification.log.forward import PredictedRod, predict
from fastrod.identification.log.samples import sample
from fastrod.identification.report.result import Result
from fastrod.model.routing import route

NOISE, N = 1e-4, 400
TRUE = {"bend": 0.06, "width": 0.05}


@cache
def found() -> Result:
    """Return what identify says where the body rubs: swings of many sizes, with holds."""
    t = 0.1 * np.arange(N)
    size = 0.55 + 0.45 * np.cos(0.23 * t)
    held = np.where((t > 12.0) & (t < 15.0), 12.0, t)
    bend = size[:, None] * np.stack([np.sin(0.9 * held), 0.7 * np.sin(0.53 * held + 1.0)], axis=1)
    rubs = replace(one_sided(), effects=({"name": "body_friction"} | TRUE,))
    log = log_of(rubs, route(rubs).tendon_change(bend[:, None]), 0.1)
    model, samples = base_model(rubs), sample(log)
    pose = predict(model, model.start, samples, PredictedRod(samples, rubs))
    assert pose.ok.all()
    noise = NOISE * np.random.default_rng(0).normal(size=(N, 3))
    return identify(replace(log, tip_position=pose.position + noise), one_sided())


@pytest.mark.study
def test_friction_of_the_body_is_named_with_its_numbers() -> None:
    result = found()
    assert result.verdict == "explained"
    assert [found.name for found in result.effects] == ["body_friction"]
    assert result.test.before > 3.0 * result.test.after
    assert result.test.after < 1.1 * math.sqrt(3.0) * NOISE
    got = result.effects[0].parameters
    assert got["bend"].value == pytest.approx(TRUE["bend"], rel=0.05)
    assert got["width"].value == pytest.approx(TRUE["width"], rel=0.1)
    assert not {"friction", "backlash", "creep"} & set(result.effects[0].cannot_be_told_from)


@pytest.mark.parametrize("angle", [0.3, 1.1, 2.5])
def test_what_stays_back_has_no_favourite_direction(angle: float) -> None:
    wiring = route(one_sided())
    path = np.random.default_rng(3).normal(size=(60, 1, 2)).cumsum(0) * 0.03
    turned = path @ Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()[:2, :2].T
    values = np.array([[TRUE["bend"], TRUE["width"], 0.8]])
    back, other = (
        stay_back(link("body_hysteresis", values, wiring), bends, [slice(0, 60)]) for bends in (path, turned)
    )
    assert np.abs(back).max() > 0.5 * TRUE["bend"]
    assert np.abs(back @ Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()[:2, :2].T - other).max() < 1e-14
