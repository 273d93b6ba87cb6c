"""The audit of a residual: what is planted comes out under its kind, and of nothing comes nothing."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from identification.logs import bare_run, displacement_of, log_of, one_segment
from numpy.testing import assert_allclose
from rods import rod

from fastrod.identification.log.samples import LogSamples, sample
from fastrod.identification.search.residual_test import (
    ResidualStructure,
    faster_than_commands,
    residual_structure,
)
from fastrod.model.routing import route

RATE, SIZE = 8.0, 0.9


@cache
def samples() -> LogSamples:
    return bare_run(RATE)


N, DT = len(samples().log), 1.0 / RATE


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(N, 3))


def bends() -> np.ndarray:
    """(N, 2) of unit size."""
    return route(one_segment()).bend(np.asarray(samples().log.dl))[:, 0] / SIZE


def run(residual: np.ndarray, lag1: float = 0.0) -> ResidualStructure:
    return residual_structure(samples(), route(one_segment()), residual, lag1)


def planted(pattern: np.ndarray, fraction: float, seed: int) -> np.ndarray:
    """White noise with a pattern (N, 3) that carries this share of the variance."""
    pattern = pattern - pattern.mean(0)
    return noise(seed) + pattern * np.sqrt(fraction / (1.0 - fraction) * 3.0 / (pattern**2).sum(1).mean())


def patterns() -> dict[str, np.ndarray]:
    b, t = bends(), np.arange(N)[:, None] * DT
    lag = np.zeros_like(b)  # a low-pass of 3 s, which is none of the audit's own
    for i in range(1, N):
        lag[i] = lag[i - 1] + (b[i] - lag[i - 1]) * DT / 3.0
    turn = np.array([[1.0, 0.2, 0.3], [-0.3, 1.0, 0.1]])
    return {
        "static": (b**2 * np.sign(b)) @ turn + 0.5 * (b[:, :1] * b[:, 1:]) * np.array([0.3, -0.2, 1.0]),
        # what no multiple of the input is
        "memory": (b - lag) @ turn - ((b - lag) * b).mean(0) / (b**2).mean(0) * b @ turn,
        "drift": np.tanh(t / (N * DT) * 4.0 - 2.0) * np.array([1.0, -0.5, 0.2]),
    }


@pytest.mark.study(beyond=2)
@pytest.mark.parametrize("seed", range(3))
def test_white_noise_has_no_structure(seed: int) -> None:
    found = run(noise(seed))
    assert found.kind == "none"
    assert found.structured == 0.0
    # z of a best of two scores, and of an autocorrelation: the largest of three seeds
    assert found.z < 4.0


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("kind", ["static", "memory", "drift"])
def test_what_is_planted_comes_out_as_its_kind(kind: str) -> None:
    for seed, fraction in ((0, 0.1), (1, 0.5)):
        found = run(planted(patterns()[kind], fraction, seed))
        assert found.kind == kind
        # held-out features find most of it, and no more than the noise lets it look (0.05)
        assert 0.6 * fraction < getattr(found, kind) < fraction + 0.05
        assert found.structured < fraction + 0.08
        assert found.z > 3.0


def test_a_line_that_no_input_has_is_unknown() -> None:
    """0.9 Hz: no input moves with it, and the time features end at three periods of the whole run."""
    t = np.arange(N)[:, None] * DT
    found = run(planted(np.sin(2.0 * np.pi * 0.9 * t) * np.array([1.0, 0.5, 0.0]), 0.5, 1))
    assert found.kind == "unknown"
    # half of the variance, times its correlation from one sample to the next, cos(2 pi 0.9 / 15)
    assert_allclose(found.exogenous, 0.5 * np.cos(2.0 * np.pi * 0.9 * DT), atol=0.08)


def coloured(seed: int, rho: float = 0.5) -> np.ndarray:
    e = noise(seed)
    for i in range(1, N):
        e[i] = rho * e[i - 1] + np.sqrt(1.0 - rho**2) * e[i]
    return e


def test_noise_that_is_coloured_at_rest_too_is_noise() -> None:
    e = coloured(5)
    assert run(e).exogenous > 0.3  # where the rest noise is said to be white, it is something
    assert run(e, lag1=0.5).exogenous == 0.0


def test_shares_are_of_the_variance() -> None:
    """In whatever unit; and nothing has no share of anything."""
    residual = planted(patterns()["static"], 0.5, 0)
    one, other = run(residual), run(1e-4 * residual)
    for kind in ("static", "memory", "drift", "exogenous"):
        assert_allclose(getattr(other, kind), getattr(one, kind), atol=1e-9)
    nothing = run(np.zeros((N, 3)))
    assert (nothing.structured, nothing.kind, nothing.z) == (0.0, "none", 0.0)


def test_only_some_rows_and_a_robot_without_wires() -> None:
    few = samples().on(np.arange(0, N, 3))
    residual = planted(patterns()["static"], 0.5, 2)[::3]
    assert residual_structure(few, route(one_segment()), residual).kind == "static"
    passive = sample(log_of(rod("passive"), np.zeros((N, 0)), DT))
    assert residual_structure(passive, route(rod("passive")), noise(1)).kind == "none"
    drift = planted(patterns()["drift"], 0.5, 1)
    assert residual_structure(passive, route(rod("passive")), drift).kind == "drift"


@pytest.mark.parametrize("share", [0.0, 0.4, 0.9])
def test_what_is_faster_than_the_commands_is_told(share: float) -> None:
    """Commands end at 0.4 Hz, and so does the rest of the residual."""
    robot, dt, n = one_segment(), 0.05, 1200
    t = dt * np.arange(n)
    slow = np.sin(2.0 * np.pi * 0.2 * t) + np.cos(2.0 * np.pi * 0.4 * t)
    dl = displacement_of(robot, 0.3 * np.stack([slow, 0.0 * slow], axis=1)[:, None])
    swings = np.sqrt(2.0) * np.sin(2.0 * np.pi * 3.0 * t)
    residual = np.sqrt(share) * swings + np.sqrt(1.0 - share) * slow
    off = 1e-3 * residual[:, None] * [1.0, 0.5, 0.0]
    found, ends = faster_than_commands(sample(log_of(robot, dl, dt)), off)
    assert found == pytest.approx(share, abs=0.03)
    assert ends == pytest.approx(0.4, abs=0.05)
