"""Slopes of a log's prediction where tendons go slack: those of the rod as it is, and no trial that is no
robot."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from identification.logs import log_of, one_segment

from fastrod import Robot, Tendon
from fastrod.identification.log.base_model import base_model
from fastrod.identification.log.forward import PredictedRod, predict
from fastrod.identification.log.samples import LogSamples, sample
from fastrod.identification.search.linearised import ANGLE, LinearisedModel, target_of
from fastrod.identification.search.model_selection import ModelState
from fastrod.identification.search.search import Search
from fastrod.identification.search.solve import Fit
from fastrod.types import Floats


@cache
def robot() -> Robot:
    """Three tendons that can only pull, on a body that shortens."""
    (segment,) = one_segment().segments
    tendons = tuple(
        Tendon(offset=0.006, angle=math.radians(a), compliance=2e-4, pretension=0.6, unilateral=True)
        for a in (10.0, 130.0, 250.0)
    )
    fit = {
        "segment.1.length": {"sd": 0.005},
        "segment.1.axial_stiffness": {"sd": 40.0},
        "tendon.*.compliance": {"sd": 1e-4},
        "tendon.*.pretension": {"sd": 0.3},
        "tendon.*.zero": {"sd": 1e-3},
        "tendon.*.gain": {"sd": 0.2},
    }
    whole = replace(segment, tendons=tendons, axial_stiffness=80.0, extension=(0.0, 0.0))
    return replace(one_segment(), segments=(whole,), fit=fit, log_points=())


def at_the_limit() -> LogSamples:
    """Tendon 1 is pulled further and further, and tendon 2 paid out until it is just taut, or just slack."""
    pulled = np.linspace(0.5e-3, 3e-3, 6)
    low, high = np.full(6, -3e-3), np.full(6, 5e-3)

    def tension(paid: Floats) -> Floats:
        samples = sample(log_of(robot(), np.stack([-pulled, paid, 0.0 * paid], axis=1)))
        rod = PredictedRod(samples, robot())
        model = base_model(robot())
        assert predict(model, model.start, samples, rod).ok.all()
        return rod.answer.tension[:, 1]

    for _ in range(8):
        middle = 0.5 * (low + high)
        taut = tension(middle) > 0.0
        low, high = np.where(taut, middle, low), np.where(taut, high, middle)
    paid = np.concatenate([low, high])
    assert (tension(low) > 0.0).all()
    assert (tension(low) < 0.3).all()
    assert (tension(high) == 0.0).all()
    return sample(log_of(robot(), np.stack([-np.tile(pulled, 2), paid, 0.0 * paid], axis=1)))


def test_slopes_at_the_slack_limit_are_differences() -> None:
    samples, model = at_the_limit(), base_model(robot())
    theta, rod = model.start, PredictedRod(samples, robot())
    target = target_of(samples, np.full(3, 1e-3), rotation_sigma=ANGLE, points=False)
    near = LinearisedModel(model, theta, samples, rod, target)
    slopes = near.slopes(model, theta, near.residual(model, theta))[:, :3]
    fine = PredictedRod(samples, robot())
    for j, unknown in enumerate(model.unknowns):
        step = 1e-4 * unknown.scale
        ends = []
        for sign in (1.0, -1.0):
            moved = theta.copy()
            moved[j] += sign * step
            ends.append(predict(model, moved, samples, fine).position)
        expected = (ends[0] - ends[1]) / (2.0 * step) / 1e-3
        error = np.linalg.norm(slopes[..., j] - expected)
        assert error <= 1e-4 * np.linalg.norm(expected) + 1e-6, unknown.name


def test_a_trial_that_is_no_robot_is_a_worse_trial() -> None:
    """The measured tip lies at the base: a fit would shorten the segment to less than its tendons' offset."""
    fit = robot().fit | {"segment.1.length": {"sd": 0.05}}
    samples, model = sample(log_of(robot(), np.zeros((3, 3)))), base_model(replace(robot(), fit=fit))
    target = target_of(samples, np.full(3, 1e-3), rotation_sigma=ANGLE, points=False)
    near = LinearisedModel(model, model.start, samples, PredictedRod(samples, robot()), target)
    (j,) = (j for j, u in enumerate(model.unknowns) if u.name == "segment.1.length")
    tried = model.start
    tried[j] = model.limits[0][j]
    assert np.isinf(near.residual(model, tried)).all()
    found = near.fit(model, model.start, 10)
    assert found.loss < (near.residual(model, model.start) ** 2).sum()
    assert model.robot_at(found.theta).segments[0].length == pytest.approx(found.theta[j])


def test_a_step_that_leads_to_worse_is_halved() -> None:
    """A fit along slopes that has led far beyond them is solved nearer to where it was."""
    samples, model = at_the_limit(), base_model(robot())
    tip = predict(model, model.start, samples, PredictedRod(samples, robot())).position
    samples = replace(samples, log=replace(samples.log, tip_position=tip))
    target = target_of(samples, np.full(3, 1e-3), rotation_sigma=ANGLE, points=False)
    search = Search(samples, PredictedRod(samples, robot()), target, np.zeros(len(tip), int))
    near, far = model.start, model.start
    (j,) = (j for j, u in enumerate(model.unknowns) if u.name == "segment.1.axial_stiffness")
    near[j], far[j] = 84.0, 50.0
    last = LinearisedModel(model, near, samples, search.rod, target)
    before = last.residual(model, near)
    fit = Fit(far, before, last.slopes(model, near, before), np.zeros(len(near)), (False,) * len(near))
    solved, theta = search._solved(ModelState(model, last, fit, np.zeros(20)))
    assert theta[j] == pytest.approx(84.0 - 34.0 / 8.0)
    assert (solved.residual(model, theta) ** 2).sum() < (before**2).sum()
