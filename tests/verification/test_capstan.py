"""Friction by the capstan: tension falls by e^(mu phi) along a tendon, and what it stretches by shows it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from identification.logs import log_of, wave
from numpy.testing import assert_allclose
from rods import bend, rod

from fastrod import Robot, Simulator
from fastrod.errors import EffectError
from fastrod.identification.log.replay import replay
from fastrod.model.routing import route

MU, COMPLIANCE = 0.4, 3e-4


def stretching() -> Robot:
    """One segment whose tendons stretch under a pretension."""
    (segment,) = rod().segments
    tendons = tuple(replace(t, compliance=COMPLIANCE, pretension=4.0) for t in segment.tendons)
    return replace(rod(), segments=(replace(segment, tendons=tendons),))


def rubbing(robot: Robot, mu: float = MU) -> Robot:
    """The robot whose tendons rub, after 20 um of sliding altogether."""
    return replace(
        robot, effects=({"name": "capstan_friction", "mu": mu, "presliding": 4e-5, "spread": 0.0},)
    )


def along(sim: Simulator, robot: Robot, ends: tuple[float, ...]) -> Any:
    """The last state on the way through bends of these sizes [rad]."""
    way = np.concatenate([np.linspace(a, b, 30) for a, b in pairwise(ends)])
    for size in way:
        state = sim.settle(bend(robot, 0.8 * size, 0.6 * size), tolerance=1e-11)
        assert state.ok.all()
    return state


@pytest.mark.parametrize("ends", [(0.0, 0.9), (0.0, 1.2, 0.6)])
def test_a_sliding_tendon_has_more_tension_at_its_drive_by_the_capstan(ends: tuple[float, ...]) -> None:
    """Every slider slides: a tendon pulled has T e^(mu phi) at the drive, one released T e^(-mu phi), and its
    length is by c (T_drive - T) off; phi is the bend that is commanded."""
    robot = stretching()
    wiring = route(robot)
    state = along(Simulator(rubbing(robot), points_per_segment=8), robot, ends)
    lengths = bend(robot, 0.8 * ends[-1], 0.6 * ends[-1])
    pulled = np.sign((lengths - robot.rest_tendon_length) * np.sign(ends[-1] - ends[-2]))
    tension = state.tension[0]
    assert (tension > 0.0).all()
    longer = COMPLIANCE * tension * (np.exp(-MU * ends[-1] * pulled) - 1.0)
    felt = lengths + wiring.tendon_change(wiring.bend(longer))  # the part that bends
    expected = Simulator(robot, points_per_segment=8).settle(felt, tolerance=1e-12)
    assert_allclose(state.tip_position, expected.tip_position, atol=2e-9)
    free = Simulator(robot, points_per_segment=8).settle(lengths)
    assert np.abs(free.tip_position - state.tip_position).max() > 2e-4


@pytest.mark.study
def test_a_loop_is_wider_under_a_load_that_tightens_the_tendons() -> None:
    robot = stretching()
    tighter = replace(
        robot,
        segments=tuple(
            replace(s, tendons=tuple(replace(t, pretension=12.0) for t in s.tendons)) for s in robot.segments
        ),
    )
    widths = []
    for one in (robot, tighter):
        tips = [
            along(Simulator(rubbing(one), points_per_segment=6), one, ends).tip_position[0]
            for ends in ((0.0, 0.6), (0.0, 1.0, 0.6))
        ]
        widths.append(np.linalg.norm(tips[1] - tips[0]))
    assert widths[0] > 1e-4
    # three times the tension at rest, beside what bends the rod
    assert 2.0 < widths[1] / widths[0] < 3.0


def test_settling_twice_is_settling_once() -> None:
    robot = rubbing(stretching())
    sim = Simulator(robot, points_per_segment=6)
    first = sim.settle(bend(robot, 0.5, 0.3), tolerance=1e-11)
    again = sim.settle(bend(robot, 0.5, 0.3), tolerance=1e-11)
    assert_allclose(again.tip_position, first.tip_position, atol=1e-10)


def test_a_log_is_a_simulator_settled_at_every_row() -> None:
    nominal = stretching()
    log = log_of(nominal, wave(nominal, 40))
    shown = replay(log, rubbing(nominal))
    assert shown.converged.all()
    sim = Simulator(rubbing(nominal), points_per_segment=6)
    for i in range(len(log)):
        tip = sim.settle(nominal.rest_tendon_length + log.dl[i], tolerance=1e-11).tip_position[0]
        assert_allclose(shown.tip_position[i], tip, atol=1e-8)


def test_a_simulator_without_tensions_refuses_it() -> None:
    robot = rubbing(stretching())
    sim = Simulator(robot, outputs="tip")
    sim.step(bend(robot, 0.5, 0.3))
    with pytest.raises(EffectError, match="outputs='full'"):
        sim.step(bend(robot, 0.5, 0.3))
