"""The least-squares solver on certified answers, and the statistics on problems with exact ones."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import norm

from fastrod.identification.search.correlation import residual_correlation
from fastrod.identification.search.solve import (
    Fit,
    bic,
    covariance,
    covariance_of,
    effective_size,
    held_out_losses,
    least_squares,
    minimise,
    paired,
)

Model = Callable[[np.ndarray, np.ndarray], np.ndarray]

# NIST Statistical Reference Datasets, nonlinear regression
# (https://www.itl.nist.gov/div898/strd/nls/nls_main.shtml): Misra1a (lower difficulty, 2 parameters), Thurber
# (higher, 7) and MGH09 (higher, 4). Data, certified values, their standard deviations, residual sum of
# squares, and NIST's starts; of Thurber and MGH09 only the second, nearer one.


def misra1a(b: np.ndarray, x: np.ndarray) -> np.ndarray:
    return b[0] * (1.0 - np.exp(-b[1] * x))


def thurber(b: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.polyval(b[3::-1], x) / (1.0 + b[4] * x + b[5] * x**2 + b[6] * x**3)


def mgh09(b: np.ndarray, x: np.ndarray) -> np.ndarray:
    return b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3])


THURBER_X = """
-3.067 -2.981 -2.921 -2.912 -2.840 -2.797 -2.702 -2.699 -2.633 -2.481 -2.363 -2.322 -1.501 -1.460
-1.274 -1.212 -1.100 -1.046 -0.915 -0.714 -0.566 -0.545 -0.400 -0.309 -0.109 -0.103 0.010 0.119
0.377 0.790 0.963 1.006 1.115 1.572 1.841 2.047 2.200
"""
THURBER_Y = """
80.574 84.248 87.264 87.195 89.076 89.608 89.868 90.101 92.405 95.854 100.696 101.060 401.672
390.724 567.534 635.316 733.054 759.087 894.206 990.785 1090.109 1080.914 1122.643 1178.351
1260.531 1273.514 1288.339 1327.543 1353.863 1414.509 1425.208 1421.384 1442.962 1464.350 1468.705
1447.894 1457.628
"""
THURBER_B = """
1.2881396800e3 1.4910792535e3 5.8323836877e2 7.5416644291e1 9.6629502864e-1 3.9797285797e-1
4.9727297349e-2
"""
THURBER_SD = """
4.6647963344 3.9571156086e1 2.8698696102e1 5.5675370270 3.1333340687e-2 1.4984928198e-2
6.5842344623e-3
"""


def numbers(text: str) -> list[float]:
    return [float(word) for word in text.split()]


Numbers = list[float]
NIST: dict[str, tuple[Model, Numbers, Numbers, Numbers, Numbers, float, list[Numbers]]] = {
    "Misra1a": (
        misra1a,
        [77.6, 114.9, 141.1, 190.8, 239.9, 289.0, 332.8, 378.4, 434.8, 477.3, 536.8, 593.1, 689.1, 760.0],
        [10.07, 14.73, 17.94, 23.93, 29.61, 35.18, 40.02, 44.82, 50.76, 55.05, 61.01, 66.40, 75.47, 81.78],
        [2.3894212918e2, 5.5015643181e-4],
        [2.7070075241, 7.2668688436e-6],
        1.2455138894e-1,
        [[500.0, 1e-4], [250.0, 5e-4]],
    ),
    "Thurber": (
        thurber,
        numbers(THURBER_X),
        numbers(THURBER_Y),
        numbers(THURBER_B),
        numbers(THURBER_SD),
        5.6427082397e3,
        [[1300.0, 1500.0, 500.0, 75.0, 1.0, 0.4, 0.05]],
    ),
    "MGH09": (
        mgh09,
        [4.0, 2.0, 1.0, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625],
        [0.1957, 0.1947, 0.1735, 0.1600, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246],
        [1.9280693458e-1, 1.9128232873e-1, 1.2305650693e-1, 1.3606233068e-1],
        [1.1435312227e-2, 1.9633220911e-1, 8.0842031232e-2, 9.0025542308e-2],
        3.0750560385e-4,
        [[0.25, 0.39, 0.415, 0.39]],
    ),
}
CASES = [(name, start) for name, case in NIST.items() for start in range(len(case[-1]))]


def solve(name: str, start: list[float]) -> tuple[Fit, float]:
    """The fit with hardly any prior, residuals in the certified deviation, slopes by central differences."""
    model, x, y, certified, _, squares, _ = NIST[name]
    at, data = np.array(x), np.array(y)
    sigma = float(np.sqrt(squares / (len(x) - len(certified))))

    def residual(b: np.ndarray) -> np.ndarray:
        with np.errstate(over="ignore", invalid="ignore"):  # a step too far is the solver's to reject
            return ((data - model(b, at)) / sigma)[:, None]

    def slopes(b: np.ndarray, r: np.ndarray) -> np.ndarray:
        steps = 1e-6 * np.abs(b) + 1e-12
        columns = [(residual(b - h) - residual(b + h)) / (2.0 * h.sum()) for h in np.diag(steps)]
        return np.stack(columns, axis=-1)

    begin = np.array(start)
    limits = np.full(len(begin), -np.inf), np.full(len(begin), np.inf)
    return minimise(residual, slopes, begin, begin, 1e9 * np.abs(certified), limits, 200), sigma


@pytest.mark.parametrize(("name", "start"), CASES)
def test_certified_values_are_found(name: str, start: int) -> None:
    model, x, y, certified, deviations, squares, starts = NIST[name]
    # the data are typed in: they and the certified values belong together to NIST's ten digits
    assert_allclose(((np.array(y) - model(np.array(certified), np.array(x))) ** 2).sum(), squares, rtol=1e-9)
    fit, sigma = solve(name, starts[start])
    # the fit ends where a step is below 1e-3 of a standard error, or gains less than 1e-4 of the loss, after
    # which Gauss and Newton converge at once: some hundredths of a standard error
    assert_allclose((fit.theta - certified) / deviations, 0.0, atol=0.02)
    assert_allclose(fit.loss * sigma**2, squares, rtol=1e-4)
    assert_allclose(np.sqrt(np.diag(np.linalg.inv(fit.hessian))), deviations, rtol=0.02)
    # and `covariance` is that where the samples know nothing of each other, else more
    stderr = np.sqrt(np.diag(covariance(fit)))
    assert (stderr > 0.98 * np.array(deviations)).all()
    if len(residual_correlation(fit.residual)) == 1:
        assert_allclose(stderr, deviations, rtol=0.02)
    assert not any(fit.at_bound)


def line(n: int = 60, p: int = 4, seed: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A linear problem: slopes (n, 2, p), data (n, 2), prior mean and sd (p,)."""
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(n, 2, p))
    return J, J @ rng.normal(size=p) + rng.normal(size=(n, 2)), rng.normal(size=p), rng.uniform(0.05, 3.0, p)


def refit(J: np.ndarray, data: np.ndarray, mean: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Normal equations with the prior."""
    flat = J.reshape(-1, J.shape[-1])
    return np.linalg.solve(flat.T @ flat + np.diag(sd**-2.0), flat.T @ data.ravel() + mean / sd**2)


def test_a_linear_problem_with_priors_is_its_normal_equations() -> None:
    J, data, mean, sd = line()
    limits = np.full(4, -np.inf), np.full(4, np.inf)
    fit = minimise(lambda b: data - J @ b, lambda b, r: J, np.zeros(4), mean, sd, limits, 60)
    # steps below 1e-3 of a standard error are the last; the damping then is 1e-5 of the step before
    assert_allclose(fit.theta, refit(J, data, mean, sd), atol=1e-6)
    assert_array_equal(fit.residual, data - J @ fit.theta)


def test_the_block_jackknife_is_the_real_refits() -> None:
    """Exact for a linear problem with priors; uneven blocks, one of them empty."""
    J, data, mean, sd = line()
    theta = refit(J, data, mean, sd)
    block = np.repeat([0, 1, 2, 4], [5, 25, 20, 10])
    found = held_out_losses(data - J @ theta, J, sd**-2.0, block, 5)
    for k in range(5):
        rows = block == k
        other = refit(J[~rows], data[~rows], mean, sd)
        # but for a ridge of 1e-9 that keeps it solvable
        assert_allclose(found[k], ((data[rows] - J[rows] @ other) ** 2).sum(), rtol=1e-6)
    assert found[3] == 0.0
    assert found.sum() > ((data - J @ theta) ** 2).sum()  # unseen is worse than seen
    none = held_out_losses(data, np.zeros((60, 2, 0)), np.zeros(0), block, 5)
    assert_allclose(none, [(data[block == k] ** 2).sum() for k in range(5)])


@pytest.mark.parametrize("rho", [0.0, 0.6, 0.9])
def test_the_effective_size_of_an_ar1_is_that_of_its_mean(rho: float) -> None:
    rng = np.random.default_rng(4)
    n, copies = 4000, 400
    x = np.empty((n, copies))
    x[0] = rng.normal(size=copies) / np.sqrt(1.0 - rho**2)
    for i in range(1, n):
        x[i] = rho * x[i - 1] + rng.normal(size=copies)
    # two independent columns are worth two: the formula's N (1 - rho) / (1 + rho), rho itself estimated to
    # 1 / sqrt(8000); a negative one counts as zero
    size = effective_size(x[:, :2])
    rtol = 4.0 * 2.0 / (1.0 - rho**2) * np.sqrt((1.0 - rho**2) / (2 * n))
    assert_allclose(size, 2 * n * (1.0 - rho) / (1.0 + rho), rtol=rtol)
    assert size <= 2 * n
    # by definition: the variance of a mean; known from 400 copies to sqrt(2 / 400)
    assert_allclose(x.var() / x.mean(0).var(), size / 2.0, rtol=4.0 * np.sqrt(2.0 / copies))


def test_the_effective_size_of_little_or_nothing() -> None:
    assert effective_size(np.ones((2, 3))) == 6.0
    assert effective_size(np.zeros((50, 3))) == 150.0
    assert effective_size(np.ones((500, 1))) == 4.0  # a constant says little, but it is never less than four


def test_bic_is_the_likelihood_with_the_noise_fitted() -> None:
    """-2 log L + p log n, the constant dropped: differences are those of full likelihoods."""
    rng = np.random.default_rng(5)
    one, other = rng.normal(0.0, 1.3, 80), rng.normal(0.0, 1.0, 80)
    full = [
        -2.0 * norm.logpdf(r, scale=np.sqrt(np.mean(r**2))).sum() + p * np.log(80)
        for r, p in ((one, 2), (other, 5))
    ]
    found = [bic(float((r**2).sum()), p, 80.0) for r, p in ((one, 2), (other, 5))]
    assert_allclose(found[0] - found[1], full[0] - full[1], rtol=1e-10)


def test_bounds_hold_at_every_trial_and_are_named() -> None:
    J, data, mean, _ = line()
    free = refit(J, data, mean, 1e6 * np.ones(4))
    order = np.sort(free)
    # the least and the largest lie beyond them
    low, high = 0.5 * (order[0] + order[1]), 0.5 * (order[2] + order[3])
    tried: list[np.ndarray] = []

    def residual(b: np.ndarray) -> np.ndarray:
        tried.append(b.copy())
        return data - J @ b

    limits = np.full(4, low), np.full(4, high)
    fit = minimise(residual, lambda b, r: J, np.full(4, 100.0), np.zeros(4), np.full(4, 1e6), limits, 60)
    assert (np.array(tried) >= low).all()
    assert (np.array(tried) <= high).all()
    outside = (free < low) | (free > high)
    assert outside.sum() == 2
    assert_array_equal(fit.at_bound, outside)
    assert_array_equal(fit.theta[outside], np.where(free < low, low, high)[outside])
    # and the free ones are the least squares beside those held
    inside = J[:, :, ~outside]
    beside = data - J[:, :, outside] @ fit.theta[outside]
    assert_allclose(fit.theta[~outside], refit(inside, beside, np.zeros(2), np.full(2, 1e6)), atol=1e-4)


def test_a_step_to_nan_is_taken_back() -> None:
    """Beyond 1.5 there is no model; the first Gauss-Newton step would lead to 3.2."""

    def run(edge: float) -> tuple[Fit, list[float]]:
        tried: list[float] = []

        def residual(b: np.ndarray) -> np.ndarray:
            tried.append(float(b[0]))
            return np.array([[10.0 * (np.tanh(1.2) - np.tanh(b[0])) if b[0] < edge else np.nan]])

        def slopes(b: np.ndarray, r: np.ndarray) -> np.ndarray:
            return np.array([[[10.0 / np.cosh(b[0]) ** 2]]])

        free = np.array([-np.inf]), np.array([np.inf])
        return minimise(residual, slopes, np.array([-1.0]), np.zeros(1), np.full(1, 1e6), free, 50), tried

    for edge in (np.inf, 1.5):
        fit, tried = run(edge)
        assert max(tried) > 2.0
        assert np.isfinite(fit.residual).all()
        assert_allclose(fit.theta, 1.2, atol=1e-3)  # 10 sigma a unit: 1e-3 of a standard error is 3e-4 here


def test_without_unknowns_nothing_is_fitted() -> None:
    data = np.ones((5, 3))
    empty = np.zeros(0)
    fit = minimise(lambda b: data, lambda b, r: np.zeros((5, 3, 0)), empty, empty, empty, (empty, empty), 10)
    assert fit.loss == 15.0
    assert covariance(fit).shape == (0, 0)


def test_the_gain_over_blocks_is_a_t_statistic() -> None:
    before, after = np.array([5.0, 6.0, 4.0, 7.0]), np.array([4.0, 4.5, 3.5, 4.0])
    gain = before - after
    t = gain.mean() / (gain.std(ddof=1) / 2.0)
    ratio = np.log(before / after)
    assert_allclose(paired(before, after), max(t, ratio.mean() / (ratio.std(ddof=1) / 2.0)), rtol=1e-12)
    assert_allclose(paired(after, before), -t, rtol=1e-12)  # a loss is never made a gain by logarithms
    assert paired(before, before) == 0.0
    # one block that holds everything hides a gain in all others from the mean, not from the logarithms
    loud, quiet = np.full(10, 1.0), np.full(10, 0.8)
    loud[0], quiet[0] = 100.0, 70.0
    quiet[1:] += np.linspace(-0.02, 0.02, 9)
    mean_alone = (loud - quiet).mean() / ((loud - quiet).std(ddof=1) / np.sqrt(10.0))
    assert mean_alone < 1.1
    assert paired(loud, quiet) > 3.0


def test_a_standard_error_goes_with_its_unit() -> None:
    """An axial stiffness in newtons beside angles in radians: its column is smaller by 10 orders."""
    rng = np.random.default_rng(4)
    slopes, unit = rng.normal(size=(50, 3, 4)), np.array([1.0, 1e-10, 1e4, 1.0])
    plain = covariance_of(slopes, np.ones(4), np.ones(1))
    scaled = covariance_of(slopes * unit, unit**2, np.ones(1))
    assert_allclose(scaled * np.outer(unit, unit), plain, rtol=1e-9)
    gram = np.tensordot(slopes, slopes, ((0, 1), (0, 1)))
    b = rng.normal(size=4)
    found = least_squares(gram * np.outer(unit, unit), b * unit)
    assert_allclose(found * unit, np.linalg.solve(gram, b), rtol=1e-9)
