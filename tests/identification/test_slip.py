"""A drive whose zero jumps, under seal: the pattern that wins is added as an effect."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from identification.logs import log_of, one_segment, two_segments, wave
from numpy.testing import assert_allclose
from rods import bend

from fastrod import Simulator
from fastrod.identification.attribution import identify
from fastrod.identification.log.replay import replay
from fastrod.identification.report.result import Result

NOISE = 2e-4
SLIP = {"name": "slip", "step": [0.0, 6e-4], "at": 23.45}
LASH = {"name": "backlash", "half_width": 3e-4}


def test_a_slip_is_a_zero_that_is_off_from_its_time_on() -> None:
    robot = one_segment()
    lengths = bend(robot, 0.4, -0.3)
    slipped = replace(robot, effects=({"name": "slip", "step": [0.0, 6e-4], "at": 0.25},))
    off = replace(robot, effects=({"name": "encoder_offset", "offset": [0.0, 6e-4]},))
    sims = [Simulator(one, dt=0.1, points_per_segment=6) for one in (slipped, robot, off)]
    for k in range(6):
        tips = [sim.settle(lengths, tolerance=1e-12).tip_position for sim in sims]
        assert_allclose(tips[0], tips[2 if 0.1 * k >= 0.25 else 1], atol=1e-10)
    assert np.abs(tips[2] - tips[1]).max() > 1e-3


@cache
def found(*names: str) -> Result:
    """Return what is found in a run of 50 s."""
    robot = one_segment()
    log = log_of(robot, wave(robot, 500, dt=0.1), 0.1)
    sealed = tuple({"slip": SLIP, "backlash": LASH}[name] for name in names)
    tip = replay(log, replace(robot, effects=sealed)).tip_position
    tip = tip + np.random.default_rng(3).normal(0.0, NOISE, tip.shape)
    return identify(replace(log, tip_position=tip), robot, threads=1)


@pytest.mark.study
@pytest.mark.parametrize("names", [("slip",), ("slip", "backlash")])
def test_a_slip_is_named_and_is_part_of_what_is_identified(names: tuple[str, ...]) -> None:
    result = found(*names)
    assert {effect.name for effect in result.effects} == {*names}
    (slip,) = (effect for effect in result.effects if effect.name == "slip")
    assert slip.drive == 2
    assert "slip of drive 2" in result.summary
    if len(names) == 1:  # of two, others explain what the first one found leaves
        assert result.verdict == "explained"
        assert not slip.cannot_be_told_from
    assert not result.patterns
    assert result.test.before > 2.0 * result.noise.floor
    assert result.test.after < 1.1 * result.noise.floor
    step = slip.parameters["step_2"]
    assert step.value == pytest.approx(6e-4, abs=4.0 * step.stderr)
    assert slip.parameters["at"].value == pytest.approx(23.45, abs=0.15)  # rows are 0.1 s apart
    shown = replay(result.log, result.identified).tip_position
    assert np.abs(shown - result.after).max() < 1e-5


@pytest.mark.study
def test_no_slip_is_named_where_none_was() -> None:
    assert [effect.name for effect in found("backlash").effects] == ["backlash"]


@pytest.mark.study
def test_runs_keep_their_own_time() -> None:
    """The time since the start is ambiguous for two runs: the pattern stays one."""
    robot = two_segments()
    log = log_of(robot, wave(robot, 500, dt=0.1), 0.1)
    slipped = replace(robot, effects=({"name": "slip", "step": [0.0, 6e-4, 0.0, 0.0], "at": 0.0},))
    run = np.where(np.arange(500) < 250, "a", "b")
    t = np.where(run == "a", log.t, log.t - 25.0)
    log = replace(log, run=run, t=t)
    tips = [replay(log, one).tip_position for one in (robot, slipped)]
    tip = np.where((run == "b")[:, None], tips[1], tips[0])
    tip = tip + np.random.default_rng(3).normal(0.0, NOISE, tip.shape)
    result = identify(replace(log, tip_position=tip), robot, threads=1)
    assert "slip" not in [effect.name for effect in result.effects]
    assert any("drive 2 jumps" in pattern for pattern in result.patterns)
