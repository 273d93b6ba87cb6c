"""Two laws of one cause: the plain one where a log cannot tell them apart, the other where it can."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from identification.logs import log_of, one_segment, wave

from fastrod.identification.attribution import identify
from fastrod.identification.log.replay import replay
from fastrod.identification.report.result import Result

NOISE = 2e-4
RUBS = {"presliding": 6e-4, "spread": 0.5}
FRICTION = {"name": "friction", "half_width": 3e-4, **RUBS}
CAPSTAN = {"name": "capstan_friction", "mu": 0.35, **RUBS}
LINEAR = {"name": "time_drift", "x": 1.5e-5, "y": -2e-5, "z": 1e-5}
SETTLING = {"name": "settling_drift", "x": 2e-3, "y": -3e-3, "z": 1e-3, "time_constant": 30.0}
ROTATING = {"name": "rotation_drift", "x": 1e-4, "y": -2e-4, "z": 3e-4}


@cache
def found(name: str) -> Result:
    """Return what is found in a run of 150 s whose camera drifts."""
    sealed: dict[str, Any] = {each["name"]: each for each in (LINEAR, SETTLING, ROTATING)}[name]
    robot = one_segment()
    log = log_of(robot, wave(robot, 500, dt=0.3), 0.3)
    tip = replay(log, replace(robot, effects=(sealed,))).tip_position
    tip = tip + np.random.default_rng(3).normal(0.0, NOISE, tip.shape)
    return identify(replace(log, tip_position=tip), robot, threads=1)


@pytest.mark.study
@pytest.mark.parametrize("sealed", [SETTLING, ROTATING], ids=lambda sealed: sealed["name"])
def test_a_drift_of_another_form_is_told_from_one_that_goes_on(sealed: dict[str, Any]) -> None:
    result = found(sealed["name"])
    (effect,) = result.effects
    assert effect.name == sealed["name"]
    assert "time_drift" not in effect.cannot_be_told_from
    assert result.verdict == "explained"
    assert result.test.before > 2.0 * result.noise.floor
    assert result.test.after < 1.1 * result.noise.floor
    for name, estimate in effect.parameters.items():
        assert estimate.value == pytest.approx(sealed[name], abs=4.0 * estimate.stderr)
        assert estimate.stderr < 0.2 * abs(estimate.value)


@pytest.mark.study
def test_a_steady_drift_stays_one() -> None:
    result = found("time_drift")
    assert [effect.name for effect in result.effects] == ["time_drift"]
    assert result.test.after < 1.1 * result.noise.floor


@cache
def rubbing(name: str) -> Result:
    """Return what is found in a run of 60 s with tendons that stretch and rub, a mass on the tip on and
    off."""
    sealed: dict[str, Any] = {"friction": FRICTION, "capstan_friction": CAPSTAN}[name]
    (segment,) = one_segment().segments
    slack = tuple(replace(tendon, compliance=5e-4, pretension=3.0) for tendon in segment.tendons)
    robot = replace(one_segment(), segments=(replace(segment, tendons=slack),))
    log = log_of(robot, wave(robot, 600, dt=0.1, size=0.9), 0.1)
    log = replace(log, payload=np.where(np.arange(600) // 75 % 2 == 0, 0.0, 0.05))
    tip = replay(log, replace(robot, effects=(sealed,))).tip_position
    tip = tip + np.random.default_rng(3).normal(0.0, 1e-4, tip.shape)
    return identify(replace(log, tip_position=tip), robot, threads=1)


@pytest.mark.study
def test_friction_by_the_capstan_is_told_from_friction_that_knows_no_tension() -> None:
    result = rubbing("capstan_friction")
    (effect,) = result.effects
    assert effect.name == "capstan_friction"
    assert "friction" not in effect.cannot_be_told_from
    assert result.test.before > 2.0 * result.noise.floor
    assert result.test.after < 1.1 * result.noise.floor
    mu = effect.parameters["mu"]
    assert mu.value == pytest.approx(CAPSTAN["mu"], abs=4.0 * mu.stderr)
    assert mu.stderr < 0.1


@pytest.mark.study
def test_friction_that_knows_no_tension_stays_so() -> None:
    result = rubbing("friction")
    assert [effect.name for effect in result.effects] == ["friction"]
    assert result.test.after < 1.1 * result.noise.floor
