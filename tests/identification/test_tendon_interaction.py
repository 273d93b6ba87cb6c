"""A robot whose tendons act on each other, under seal: the effect is found by its name, and only then."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from identification.logs import log_of
from rods import rod

from fastrod import Robot
from fastrod.identification.attribution import identify
from fastrod.identification.log.replay import replay
from fastrod.identification.report.result import Result

NOISE = 1e-4
SEALED = {
    "name": "tendon_interaction",
    "slope": [60.0, -20.0, 30.0],
    "curvature": [-5e3, 0.0, -2e3],
    "pair": [30.0, -10.0, 20.0],
    "next": [1500.0, 0.0, -1000.0],
    "previous": [0.0, 2000.0, 500.0],
}
STIFFENING = {"name": "stiffening", "cubic": 0.15}


def three() -> Robot:
    return rod(n_tendons=3)


@cache
def found(*names: str) -> Result:
    """Return what is found in a run of 50 s that pulls every tendon alone and every two together."""
    robot, t = three(), 0.1 * np.arange(500)
    phase = 2.0 * np.pi * np.arange(3) / 3.0
    size = 0.004 * (1.0 + 0.7 * np.sin(0.9 * t))[:, None]
    pull = size * np.clip(
        np.sin(0.31 * t[:, None] + phase) + 0.4 * np.sin(1.7 * t[:, None] + 2.0 * phase), 0.0, 2.0
    )
    pull[:30] = 0.0
    sealed = replace(
        robot, effects=tuple({"tendon_interaction": SEALED, "stiffening": STIFFENING}[n] for n in names)
    )
    log = log_of(robot, -pull, 0.1)
    tip = replay(log, sealed).tip_position + np.random.default_rng(4).normal(0.0, NOISE, (500, 3))
    return identify(replace(log, tip_position=tip), robot, threads=1)


@pytest.mark.study
def test_tendons_that_interact_are_named() -> None:
    result = found("tendon_interaction")
    assert [effect.name for effect in result.effects] == ["tendon_interaction"]
    assert result.verdict == "explained"
    assert result.test.before > 3.0 * result.noise.floor
    assert result.test.after < 1.15 * result.noise.floor
    weights = result.effects[0].parameters
    for k, slope in enumerate(SEALED["slope"], 1):
        assert weights[f"slope_{k}"].value == pytest.approx(slope, abs=4.0 * weights[f"slope_{k}"].stderr)


@pytest.mark.study
@pytest.mark.parametrize("sealed", [(), ("stiffening",)])
def test_it_is_not_named_where_there_is_none_or_another_cause(sealed: tuple[str, ...]) -> None:
    result = found(*sealed)
    assert [effect.name for effect in result.effects] == [*sealed]
    assert result.test.after < 1.15 * result.noise.floor
