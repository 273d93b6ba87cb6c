"""The same command at another time says what of a residual is a function of the command."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identification.logs import displacement_of, log_of, one_segment

from fastrod.identification.attribution import identify
from fastrod.identification.log.replay import replay
from fastrod.identification.log.samples import sample
from fastrod.identification.log.unknowns import known_model
from fastrod.identification.search.residual_test import ResidualStructure
from fastrod.identification.search.revisits import Visits, visits

N, DT = 800, 0.1


def swinging() -> np.ndarray:
    t = DT * np.arange(N)
    return np.asarray(0.8 * np.sin(0.8 * t) * (0.7 + 0.3 * np.cos(0.19 * t)))


def lengths(bend: np.ndarray, across: float = 0.0) -> np.ndarray:
    return displacement_of(one_segment(), np.stack([bend, across * bend**2], axis=1)[:, None])


def swings() -> tuple[Visits, np.ndarray, np.ndarray]:
    """Visits of a robot that swings to and fro in one plane at many amplitudes; its bend and way (n,)."""
    robot, bend = one_segment(), swinging()
    found = visits(sample(log_of(robot, lengths(bend), DT)), known_model(robot), np.zeros(0))
    return found, bend, np.sign(np.gradient(bend))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    "parts", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 1.0, 0.0), (1.0, 1.0, 1.0), (0.0, 0.0, 1.0)]
)
def test_static_error_memory_and_what_does_not_repeat_are_told_apart(
    parts: tuple[float, float, float], seed: int
) -> None:
    found, bend, way = swings()
    rng = np.random.default_rng(seed)
    slow = np.repeat(rng.normal(size=(N // 40, 3)), 40, axis=0)  # each swing its own
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    static = np.stack([np.cos(1.5 * bend), np.sin(1.5 * bend)], axis=1) @ rng.normal(size=(2, 3))
    pieces = (static / np.sqrt((static**2).sum(1).mean()), way[:, None] * direction, slow / np.sqrt(3.0))
    residual = sum(1e-3 * size * piece for size, piece in zip(parts, pieces, strict=True))
    seen = found.compare(-residual)  # the tip was measured at 0
    assert seen is not None
    assert seen.n > 500
    s, m, outside = np.square(parts) / np.square(parts).sum()
    if m > 0.3:
        assert seen.memory == pytest.approx(m, abs=0.15)
        assert seen.static == pytest.approx(s, abs=0.15)
    elif outside < 1.0:
        assert np.isnan(seen.memory) or seen.memory < 0.1
    differs = 1e-3 * np.sqrt(parts[1] ** 2 + parts[2] ** 2)  # of any one visit from the mean over visits
    assert seen.floor == pytest.approx(differs, abs=2e-4)


def test_a_robot_that_never_comes_again_says_nothing() -> None:
    robot = one_segment()
    log = log_of(robot, lengths(np.linspace(-0.8, 0.8, N), 1.0), DT)
    found = visits(sample(log), known_model(robot), np.zeros(0))
    assert found.compare(np.zeros((N, 3))) is None


def test_what_is_memory_is_not_from_outside() -> None:
    found, _, way = swings()
    seen = found.compare(1e-3 * way[:, None] * [1.0, 0.0, 0.0])
    assert seen is not None
    test = ResidualStructure(static=0.0, memory=0.1, drift=0.0, exogenous=0.8, z=9.0)
    assert test.with_memory(seen).kind == "memory"
    assert test.with_memory(seen).structured == pytest.approx(0.9)
    assert test.with_memory(None) is test


@pytest.mark.study
def test_the_floor_of_models_without_memory_is_told_and_gone_with_the_memory() -> None:
    worn, robot = one_segment(effects=({"name": "backlash", "half_width": 5e-4},)), one_segment()
    log = log_of(worn, lengths(swinging(), 0.3), DT)
    tip = replay(log, worn).tip_position + 1e-4 * np.random.default_rng(0).normal(size=(N, 3))
    log = replace(log, tip_position=tip)
    without = identify(log, robot, exclude=["backlash"], max_effects=0)
    assert "no model without memory leaves less than" in without.summary
    result = identify(log, robot)
    assert result.revisits is not None
    before, after = result.revisits
    assert before.floor > 0.8 * without.test.after
    assert after.floor < 1.1 * result.noise.floor
    assert "no model without memory" not in result.summary
