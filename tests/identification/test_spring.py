"""A spring that pulls the tip to a point, under seal: named, with its point and stiffness."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from identification.logs import log_of, one_segment, two_segments, wave

from fastrod import Robot
from fastrod.identification.attribution import identify
from fastrod.identification.log.base_model import base_model
from fastrod.identification.log.forward import PredictedRod, predict
from fastrod.identification.log.replay import replay
from fastrod.identification.log.samples import sample
from fastrod.identification.report.result import Result
from fastrod.identification.search.linearised import LinearisedModel, target_of
from fastrod.identification.search.search import N_BLOCKS, Search

NOISE = 2e-4
SPRING = {"name": "tip_spring", "stiffness": 12.0, "x": 0.05, "y": -0.03, "z": 0.08}
FORCE = {"name": "tip_force", "x": 0.3, "y": -0.2, "z": 0.1}


def soft(robot: Robot) -> Robot:
    """The robot with tendons that stretch: a tip between stiff ones hardly gives."""
    return replace(
        robot,
        segments=tuple(
            replace(s, tendons=tuple(replace(t, compliance=5e-4) for t in s.tendons)) for s in robot.segments
        ),
    )


@cache
def found(name: str) -> Result:
    """Return what is found in a run of 50 s to all sides."""
    sealed: dict[str, Any] = {"tip_spring": SPRING, "tip_force": FORCE}[name]
    robot = soft(one_segment())
    log = log_of(robot, wave(robot, 500, dt=0.1, size=0.9), 0.1)
    tip = replay(log, replace(robot, effects=(sealed,))).tip_position
    tip = tip + np.random.default_rng(3).normal(0.0, NOISE, tip.shape)
    return identify(replace(log, tip_position=tip), robot, threads=1)


def test_an_effect_with_which_the_rod_is_lost_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """However little it leaves: samples at which the rod finds no balance do not count."""
    robot, n = one_segment(), 60
    log = log_of(robot, wave(robot, n, dt=0.1, size=0.9), 0.1)
    tip = replay(log, replace(robot, effects=(SPRING,))).tip_position
    samples, model = sample(replace(log, tip_position=tip)), base_model(robot)
    target = target_of(samples, np.full(3, NOISE), rotation_sigma=0.01, points=False)
    search = Search(samples, PredictedRod(samples, robot), target, np.arange(n) * N_BLOCKS // n)
    state = search.start(model, model.start)
    candidate = search.candidate(state, "tip_spring")
    assert candidate.state is not None
    fit = candidate.state.fit
    far = np.clip(fit.theta, *candidate.state.model.limits)
    far[-4:] = candidate.state.model.limits[1][-4:]  # as stiff, and to a point as far off, as can be
    lost = replace(candidate, state=replace(candidate.state, fit=replace(fit, theta=far)))
    monkeypatch.setattr(Search, "_left", lambda *_: 0.0)  # it would come back from there
    refused = search._exact(state, lost)
    assert refused.state is None
    assert refused.why.startswith("with it the rod finds no balance at ")


def test_an_effect_is_whole_beside_however_much_is_left() -> None:
    """What moves nothing beyond the noise is left out; what is left before it is found is none."""
    robot, n, left = one_segment(), 60, np.full(3, 0.05)
    log = log_of(robot, wave(robot, n, dt=0.1))
    samples, model = sample(replace(log, tip_position=replay(log, robot).tip_position)), base_model(robot)
    target, block = target_of(samples, left, rotation_sigma=0.01, points=False), np.arange(n) * N_BLOCKS // n
    search = Search(samples, PredictedRod(samples, robot), target, block, noise=np.full(3, NOISE))
    state, more = search.start(model, model.start), model.with_effect("frame_misalignment")
    assert search._unseen(state, more) == []
    assert "rotation_z" in replace(search, noise=left)._unseen(state, more)


@pytest.mark.study
def test_a_spring_is_named_with_its_point() -> None:
    result = found("tip_spring")
    assert [effect.name for effect in result.effects] == ["tip_spring"]
    assert result.verdict == "explained"
    assert result.test.before > 2.0 * result.noise.floor
    assert result.test.after < 1.1 * result.noise.floor
    for name in ("stiffness", "x", "y", "z"):
        estimate = result.effects[0].parameters[name]
        assert estimate.value == pytest.approx(SPRING[name], abs=4.0 * estimate.stderr)
        assert estimate.stderr < 0.2 * abs(estimate.value)
    shown = replay(result.log, result.identified).tip_position
    assert np.abs(shown - result.after).max() < 1e-5


@pytest.mark.study
def test_a_constant_force_stays_one() -> None:
    result = found("tip_force")
    assert [effect.name for effect in result.effects] == ["tip_force"]
    assert result.test.after < 1.1 * result.noise.floor


@pytest.mark.parametrize("there", [0.0, 3.0], ids=["none at the reference", "one at the reference"])
def test_the_linearised_model_has_the_spring_in_balance(there: float) -> None:
    """The error is the square of the distance from its reference."""
    robot = soft(two_segments())
    log = log_of(robot, wave(robot, 40))
    samples = sample(log)
    model = base_model(replace(robot, fit={"tendon.*.zero": {"sd": 2e-4}})).with_effect("tip_spring")
    names = [u.name for u in model.unknowns]

    def at_reference() -> np.ndarray:
        theta = model.start
        given = {
            "tip_spring.stiffness": there,
            "tip_spring.x": 0.05,
            "tip_spring.y": 0.02,
            "tip_spring.z": 0.15,
        }
        for name, value in given.items():
            theta[names.index(name)] = value
        return theta

    reference, way = at_reference(), np.zeros(len(names))
    way[names.index("tip_spring.stiffness")] = 0.1
    way[names.index("tip_spring.x")] = 0.003
    way[[j for j, name in enumerate(names) if "zero" in name]] = 2e-5
    rod = PredictedRod(samples, robot)
    target = target_of(samples, np.full(3, 1e-3), rotation_sigma=0.01, points=False)
    linearised = LinearisedModel(model, reference, samples, rod, target)
    off, moved = [], []
    for size in (1.0, 0.5):
        there_to = reference + size * way
        change = linearised.driven(model, there_to) + linearised.solved(model, there_to)
        said = linearised.pose.position + linearised.closed(model, there_to, change)[:, :3]
        exact = predict(model, there_to, samples, PredictedRod(samples, robot)).position
        off.append(np.abs(said - exact).max())
        moved.append(np.abs(exact - linearised.pose.position).max())
    assert moved[0] > 3e-4
    assert off[0] < 0.2 * moved[0]
    assert off[0] / off[1] == pytest.approx(4.0, rel=0.15)
