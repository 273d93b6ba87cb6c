"""Rows that know of each other: what they are worth, and verdicts on logs to which nothing is missing."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bench_noise import autoregressive, cases, run
from fastrod.identification.log import autoregression
from fastrod.identification.search import correlation
from fastrod.identification.search.residual_test import _PIECES
from fastrod.identification.search.solve import covariance_of

N = 1500


def fades(rho: float) -> np.ndarray:
    return rho ** np.arange(int(np.log(1e-3) / np.log(rho)))


def test_the_correlation_of_an_autoregression_solves_its_equations() -> None:
    """rho_k = sum of a_j rho_(k - j), to rounding; partial correlations below one give one that fades."""
    a = autoregression.from_partial(np.array([0.8, -0.3, 0.2]))
    rho = autoregression.correlation_of(a, 40)
    for k in range(1, 40):
        assert_allclose(rho[k], sum(a[j] * rho[abs(k - 1 - j)] for j in range(3)), atol=1e-12)
    assert abs(rho[-1]) < 0.1
    assert autoregression.AutoRegression().length == 1.0
    assert_allclose(autoregression.AutoRegression((0.9,)).length, 19.0, rtol=2e-3)
    assert_allclose(autoregression.AutoRegression((0.9,)).every(2.0)[1], 0.81, rtol=1e-12)


def test_a_second_coefficient_is_found_where_there_is_one() -> None:
    """x_t = 1.2 x_(t-1) - 0.5 x_(t-2): a broad hump, no line."""
    rng = np.random.default_rng(3)
    x = rng.normal(size=(2500, 3))
    for i in range(2, len(x)):
        x[i] += 1.2 * x[i - 1] - 0.5 * x[i - 2]
    x = x[100:]
    spots = [(0, 300), (900, 1200), (1500, 1560), (1700, 1760)]
    rests = [autoregression.RestStretch(np.arange(a, b), x[a:b], moved=a > 0) for a, b in spots]
    found = autoregression.read_rest(rests, 15.0)
    assert found.model.order == 2
    assert np.isnan(found.line)
    assert_allclose(found.model.coefficients, (1.2, -0.5), atol=0.12)  # 3.5 / sqrt(3 x 720)
    assert_allclose(found.sigma, x.std(0), rtol=0.15)


def test_correlated_columns_are_those_of_the_matrix() -> None:
    rho = fades(0.8)
    x = np.random.default_rng(0).normal(size=(60, 2, 3))
    every = np.append(rho, np.zeros(60))
    C = every[np.abs(np.subtract.outer(np.arange(60), np.arange(60)))]
    assert_allclose(correlation.correlated(x, rho), np.einsum("ij,jkl->ikl", C, x), atol=1e-12)


@pytest.mark.parametrize("rho", [0.5, 0.9, 0.98])
def test_slow_columns_feel_slow_noise_and_fast_ones_do_not(rho: float) -> None:
    """A level: (1 + rho) / (1 - rho), less what the ends have; what alternates: 1."""
    fade = fades(rho)
    level = np.ones((N, 1, 1))
    expected = 1.0 + 2.0 * float(((N - np.arange(1, len(fade))) / N * fade[1:]).sum())
    assert_allclose(correlation.spread(level, fade), expected, rtol=1e-9)
    assert_allclose(correlation.length(fade), (1.0 + rho) / (1.0 - rho), rtol=3e-3)
    assert correlation.spread((level.ravel() * (-1.0) ** np.arange(N))[:, None, None], fade) == 1.0
    assert correlation.spread(level, np.ones(1)) == 1.0


@pytest.mark.parametrize("rho", [0.0, 0.6, 0.95])
def test_a_fit_among_coloured_rows_scatters_as_it_says(rho: float) -> None:
    """A level and a wave fitted to 400 draws: their scatter is known to 1 / sqrt(800)."""
    t = np.arange(N) / 15.0
    J = np.stack([np.ones(N), np.sin(2.0 * np.pi * 0.05 * t)], axis=1)[:, None, :]
    fade = fades(rho) if rho else np.ones(1)
    drawn = correlation.draws(fade, N, 400, seed=2) if rho else np.random.default_rng(2).normal(size=(N, 400))
    fitted = np.linalg.lstsq(J[:, 0], drawn, rcond=None)[0]
    stderr = np.sqrt(np.diag(covariance_of(J, np.full(2, 1e-12), fade)))
    assert_allclose(fitted.std(1), stderr, rtol=4.0 / np.sqrt(800.0))
    # and of one residual alone, from which the autocorrelation must be read
    read = correlation.residual_correlation(drawn[:, :3])
    assert_allclose(correlation.length(read), (1.0 + rho) / (1.0 - rho), rtol=0.5)


def test_drawn_noise_is_alike_as_it_should_be() -> None:
    x = correlation.draws(fades(0.9), N, 300)
    for lag in (1, 5, 20):
        # known to about the root of 10 over the 450,000 rows, which are worth a tenth
        assert_allclose((x[lag:] * x[:-lag]).mean(), 0.9**lag, atol=0.04)


def test_blocks_as_short_as_the_noise_is_slow_know_of_each_other() -> None:
    assert correlation.blocks_alike(np.ones(1), 75) == 1.0
    assert correlation.blocks_alike(fades(0.5), N // _PIECES) < 1.1
    assert correlation.blocks_alike(fades(0.98), N // _PIECES) > 1.3


@pytest.mark.study
@pytest.mark.parametrize("case", [c for c in cases(12) if c.rho >= 0.9 and c.robot == "prototype"])
def test_nothing_is_missing_on_a_clean_log_with_coloured_noise(case: object) -> None:
    """Sixty of these are `python perf/bench_noise.py`."""
    row = run(case)  # type: ignore[arg-type]
    assert row["verdict"] == "none", row["summary"]
    assert abs(row["floor_ratio"] - 1.0) < 0.2


def test_the_noise_of_the_bench_is_what_it_says() -> None:
    x = autoregressive(np.random.default_rng(0), 40000, 0.9)
    assert_allclose(x.std(0), 1.0, atol=0.06)  # 40,000 samples are worth 2100 of them
    assert_allclose((x[1:] * x[:-1]).mean(0), 0.9, atol=0.06)
