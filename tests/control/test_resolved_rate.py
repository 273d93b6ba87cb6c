"""Resolved rates against numpy's pseudo-inverse, and their limits."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refusals

from fastrod.control import ResolvedRate
from fastrod.errors import InputError

ZERO = np.zeros(3)


def case(seed: int, m: int = 3, n: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=n), rng.normal(size=(m, n)), rng.normal(size=m)


@pytest.mark.parametrize("seed", range(5))
def test_without_limits_it_is_the_solution_of_least_norm(seed: int) -> None:
    q, J, task = case(seed)
    rates = ResolvedRate(damping=0.0).rates(q, J, ZERO, task, 0.01)
    assert_allclose(rates, np.linalg.pinv(J) @ task, atol=1e-12)
    assert_allclose(J @ rates, task, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_weights_make_the_weighted_norm_least(seed: int) -> None:
    q, J, task = case(seed)
    weight = np.random.default_rng(100 + seed).uniform(0.1, 10.0, 12)
    rates = ResolvedRate(weight=weight).rates(q, J, ZERO, task, 0.01)
    inverse = np.diag(1.0 / weight)
    assert_allclose(rates, inverse @ J.T @ np.linalg.solve(J @ inverse @ J.T, task), atol=1e-12)
    null = np.linalg.svd(J)[2][3:]
    for other in rates + np.random.default_rng(seed).normal(size=(20, 9)) @ null:
        assert weight @ rates**2 <= weight @ other**2


def test_the_error_is_fed_back_and_shortened() -> None:
    q, J, error = case(7)
    loose, tight = ResolvedRate(gain=3.0), ResolvedRate(gain=3.0, error_limit=0.1)
    assert_allclose(J @ loose.rates(q, J, error, -error, 0.01), 2.0 * error, atol=1e-12)
    assert_allclose(J @ tight.rates(q, J, error, ZERO, 0.01), 0.3 * error / np.linalg.norm(error), atol=1e-12)
    assert_allclose(J @ tight.rates(q, J, 1e-3 * error, ZERO, 0.01), 3e-3 * error, atol=1e-12)


@pytest.mark.study
def test_the_posture_is_approached_in_the_null_space() -> None:
    q, J, task = case(8)
    posture = np.random.default_rng(9).normal(size=12)
    for weights in (None, np.random.default_rng(10).uniform(0.1, 10.0, 12)):
        control = ResolvedRate(posture=posture, posture_gain=2.0, weight=weights)
        with_posture = control.rates(q, J, ZERO, task, 0.01)
        without = ResolvedRate(weight=weights).rates(q, J, ZERO, task, 0.01)
        assert_allclose(J @ with_posture, task, atol=1e-12)
        assert np.linalg.norm(with_posture - without) > 0.1
        far = q.copy()
        for _ in range(4000):
            far += 0.01 * control.rates(far, J, ZERO, ZERO, 0.01)
        # the nearest point to the posture, counted in the weights, with the same task
        w = np.ones(12) if weights is None else weights
        expected = posture + (J.T / w[:, None]) @ np.linalg.solve((J / w) @ J.T, J @ (q - posture))
        assert_allclose(far, expected, atol=1e-9)


@pytest.mark.study(beyond=3)
@pytest.mark.parametrize("size", [0.1, 3.0, 30.0])
@pytest.mark.parametrize("with_posture", [False, True])
def test_no_limit_is_ever_left_and_the_direction_is_kept(size: float, with_posture: bool) -> None:
    scaled = met = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        q, J, task = rng.uniform(-1.0, 1.0, 12), rng.normal(size=(3, 12)), size * rng.normal(size=3)
        rate, low, high = rng.uniform(0.2, 2.0, 12), np.full(12, -1.0), np.full(12, 1.0)
        q[seed % 12] = rng.choice([-1.0, 1.0])  # one of them at its limit
        posture = rng.uniform(-2.0, 2.0, 12) if with_posture else None
        weight, limits = rng.uniform(0.5, 2.0, 12), {"lower": low, "upper": high, "rate": rate}
        control = ResolvedRate(damping=1e-3, posture=posture, posture_gain=5.0, weight=weight, **limits)
        rates = control.rates(q, J, ZERO, task, 0.05)
        assert (np.abs(rates) <= rate + 1e-12).all()
        assert (q + 0.05 * rates <= high + 1e-12).all()
        assert (q + 0.05 * rates >= low - 1e-12).all()
        done = J @ rates
        fraction = done @ task / (task @ task)
        assert_allclose(done, fraction * task, atol=1e-9 * max(size, 1.0))
        assert -1e-12 <= fraction <= 1.0 + 1e-9
        scaled, met = scaled + (fraction < 1.0 - 1e-9), met + (fraction > 1.0 - 1e-9)
    assert met > 150 if size < 1.0 else scaled > 0  # both are really tested
    assert scaled > 150 if size > 10.0 else met > 0


def test_the_others_take_over_from_a_coordinate_at_its_limit() -> None:
    J = np.array([[1.0, 1.0, 0.5]])
    control = ResolvedRate(upper=[0.0, 9.0, 9.0], rate=[1.0, 1.0, 1.0], damping=0.0)
    rates = control.rates([0.0, 0.0, 0.0], J, [0.0], [0.9], 0.01)
    assert_allclose(rates, [0.0, 0.72, 0.36], atol=1e-12)  # least norm of those that are left
    assert_allclose(control.rates([0.0, 0.0, 0.0], J, [0.0], [1.4], 0.01), [0.0, 1.0, 0.8], atol=1e-12)
    # all that can be had
    assert_allclose(control.rates([0.0, 0.0, 0.0], J, [0.0], [7.0], 0.01), [0.0, 1.0, 1.0], atol=1e-12)


def test_the_fraction_is_the_largest_possible() -> None:
    from scipy.optimize import linprog

    short = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        J, task = rng.normal(size=(2, 5)), 4.0 * rng.normal(size=2)
        rates = ResolvedRate(damping=0.0, rate=1.0).rates(np.zeros(5), J, np.zeros(2), task, 0.01)
        A, bounds = np.column_stack([J, -task]), [(-1.0, 1.0)] * 5 + [(0.0, 1.0)]
        best = linprog([0.0] * 5 + [-1.0], A_eq=A, b_eq=[0.0, 0.0], bounds=bounds)
        fraction = J @ rates @ task / (task @ task)
        assert fraction <= -best.fun + 1e-9
        short += fraction < -0.9 * best.fun
    assert short <= 4  # one coordinate after another is no linear program, but near it


def test_a_coordinate_outside_comes_back_as_fast_as_it_may() -> None:
    control = ResolvedRate(lower=[-1.0, -1.0], upper=[1.0, 1.0], rate=[2.0, 2.0])
    rates = control.rates([1.5, 0.0], [[1.0, 1.0]], [0.0], [0.0], 0.1)
    assert_allclose(rates, [-2.0, 2.0], atol=1e-12)  # and the task stays where it is
    assert_allclose(control.rates([1.01, 0.0], [[1.0, 1.0]], [0.0], [0.0], 0.1), [-0.1, 0.1], atol=1e-12)


def test_damping_bounds_the_rates_at_a_singularity_and_only_there() -> None:
    control = ResolvedRate(damping=0.05, threshold=0.1)
    most = []
    for s in np.geomspace(1e-14, 1.0, 100):
        J = np.array([[1.0, 0.0, 0.0], [0.0, s, 0.0]])
        rates = control.rates(ZERO, J, [0.0, 0.0], [0.0, 1.0], 0.01)
        most.append(np.abs(rates).max())
        if s >= 0.1:
            assert_allclose(rates, [0.0, 1.0 / s, 0.0], rtol=1e-12)
    # s / (s^2 + l^2) is at most 1 / (2 l), and l hardly less than the damping
    assert max(most) < 1.0 / (2.0 * 0.05) * 1.2
    assert most[0] < 1e-6
    assert_allclose(control.rates(ZERO, np.zeros((2, 3)), [0.0, 0.0], [1.0, 1.0], 0.01), 0.0)


def test_at_a_singularity_limits_are_kept_too() -> None:
    for seed in range(100):
        rng = np.random.default_rng(seed)
        J = rng.normal(size=(3, 1)) @ rng.normal(size=(1, 6))
        J = J + 10.0 ** rng.uniform(-12.0, -1.0) * rng.normal(size=(3, 6))
        rates = ResolvedRate(rate=0.3, damping=1e-2).rates(np.zeros(6), J, ZERO, rng.normal(size=3), 0.01)
        assert np.isfinite(rates).all()
        assert (np.abs(rates) <= 0.3).all()


def test_more_coordinates_than_tasks_or_fewer() -> None:
    q, J, task = case(3, m=6, n=4)
    rates = ResolvedRate(damping=0.0).rates(q, J, np.zeros(6), task, 0.01)
    assert_allclose(rates, np.linalg.lstsq(J, task, rcond=None)[0], atol=1e-12)
    assert (np.abs(ResolvedRate(rate=0.01).rates(q, J, np.zeros(6), task, 0.01)) <= 0.01).all()


@pytest.mark.parametrize("seed", range(5))
def test_constant_damping_is_damped_least_squares_and_nearest_keeps_to_it_within_limits(seed: int) -> None:
    q, J, task = case(seed)
    weight = np.random.default_rng(seed).uniform(0.1, 10.0, 12)
    W, small = np.diag(1.0 / weight), 1e-3 * J  # all of it within the damping
    damped = W @ small.T @ np.linalg.solve(small @ W @ small.T + 0.02**2 * np.eye(3), task)
    for given in ({"threshold": np.inf}, {"nearest": True}):
        control = ResolvedRate(damping=0.02, weight=weight, **given)  # type: ignore[arg-type]
        assert_allclose(control.rates(q, small, ZERO, task, 0.01), damped, rtol=1e-10)
    most = 0.5 * np.abs(damped).max()
    rates = ResolvedRate(damping=0.02, weight=weight, nearest=True, rate=most).rates(
        q, small, ZERO, task, 0.01
    )
    others = np.clip(rates + np.random.default_rng(seed).normal(0.0, 0.1 * most, (200, 12)), -most, most)
    cost = [((small @ r - task) ** 2).sum() + 0.02**2 * (weight @ r**2) for r in (rates, *others)]
    assert np.abs(rates).max() <= most
    assert min(cost) == cost[0]


def ask(**changed: Any) -> Callable[[], Any]:
    good = {"q": np.zeros(4), "jacobian": np.ones((3, 4)), "error": ZERO, "feedforward": ZERO, "dt": 0.01}
    return lambda: ResolvedRate(lower=[-1.0] * 4).rates(**(good | changed))


def made(**options: Any) -> Callable[[], Any]:
    return lambda: ResolvedRate(**options)


NAN, NOT_FINITE = np.nan, "holds a value that is not finite:"
REFUSED = {
    f"q {NOT_FINITE} [ 0. nan  0.  0.].": ask(q=np.array([0.0, NAN, 0.0, 0.0])),
    f"error {NOT_FINITE} [ 0. inf  0.].": ask(error=np.array([0.0, np.inf, 0.0])),
    f"feedforward {NOT_FINITE} [nan nan nan].": ask(feedforward=np.array([NAN] * 3)),
    f"jacobian {NOT_FINITE} [" + "nan " * 8 + "nan].": ask(jacobian=np.full((3, 4), NAN)),
    (
        "q (4,), jacobian (3, 4), error (2,) and feedforward (3,) do not fit together; they must be "
        "(n_q,), (m, n_q), (m,) and (m,)."
    ): ask(error=np.zeros(2)),
    "q has 5 coordinates; this ResolvedRate is made for 4.": ask(q=np.zeros(5), jacobian=np.ones((3, 5))),
    "dt is 0.0 s; it must be a number, positive and finite.": ask(dt=0.0),
    "ResolvedRate.gain is -1.0 1/s; it must be a number, zero or positive and finite.": made(gain=-1.0),
    "ResolvedRate has a posture, for which nearest leaves no room; give one.": made(
        nearest=True, posture=[0.0]
    ),
    "ResolvedRate.rate is [1.0, 0.0]; every number of it must be positive.": made(rate=[1.0, 0.0]),
    "ResolvedRate.weight is [1.0, inf]; every number of it must be finite.": made(weight=[1.0, np.inf]),
    "ResolvedRate.lower is [0.0, nan]; give (n_q,) numbers, none of them nan.": made(lower=[0.0, NAN]),
    "ResolvedRate.lower is 'low'; give (n_q,) numbers.": made(lower="low"),
    "ResolvedRate has lower of 1, upper of 2; they must have one length, n_q.": made(
        lower=[0.0], upper=[1.0, 2.0]
    ),
    "ResolvedRate.lower[1] is 3, above upper[1] 2.": made(lower=[0.0, 3.0], upper=[1.0, 2.0]),
}


@refusals({InputError: REFUSED})
def test_refusals(error: type[Exception], sentence: str, call: Callable[[], object]) -> None:
    with pytest.raises(error) as caught:
        call()
    assert str(caught.value) == sentence
