"""The network on what is left: it finds what follows from the inputs, nothing in noise, and stands apart."""

from __future__ import annotations

import sys
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from identification.logs import bare_run, one_segment
from numpy.testing import assert_array_equal
from reportlog import backlash_log

from fastrod.errors import InputError
from fastrod.identification.attribution import identify
from fastrod.identification.learned.network import residual_network
from fastrod.identification.log.samples import LogSamples
from fastrod.identification.log.split import held_out_rows
from fastrod.model.robotfile import load_robot
from fastrod.model.routing import route

NOISE = 3e-4


@cache
def samples() -> LogSamples:
    return bare_run(8.0)


def left(residual: np.ndarray) -> tuple[float, float]:
    """Held-out rms of a residual, without the network and with it [m]."""
    tested, _ = held_out_rows(samples(), ())
    rows = {"used": ~tested, "tested": tested, "outlier": np.zeros_like(tested)}
    result = SimpleNamespace(residual_after=residual, **rows)
    reported = residual_network(samples(), route(one_segment()), result)
    assert reported["inputs"] > 4
    return float(np.sqrt((residual[tested] ** 2).sum(1).mean())), reported["held_out_rms_m"]


def noise() -> np.ndarray:
    return NOISE * np.random.default_rng(5).normal(size=(len(samples().log), 3))


@pytest.mark.study
def test_a_static_residual_is_predicted() -> None:
    """A corner of the workspace that is off by up to 3 mm: two thirds of it above the noise must go."""
    bend = route(one_segment()).bend(np.asarray(samples().log.dl))[:, 0]
    corner = 3e-3 * np.exp(-0.5 * ((bend - [0.5, 0.2]) ** 2).sum(1) / 0.35**2)
    before, after = left(corner[:, None] * np.array([1.0, -0.5, 0.3]) + noise())
    floor = np.sqrt(3.0) * NOISE
    assert after < 0.7 * before
    assert after**2 - floor**2 < (before**2 - floor**2) / 3.0


def test_noise_is_not_predicted() -> None:
    before, after = left(noise())
    assert 0.97 * before < after < 1.25 * before


@pytest.mark.study
def test_missing_rows_are_left_out() -> None:
    residual = noise()
    residual[::7] = np.nan
    assert np.isfinite(left(residual)[1])


def test_without_scikit_learn_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sklearn.neural_network", None)
    with pytest.raises(
        InputError, match=r"needs scikit-learn; install fastrod\[network\], or leave --network out"
    ):
        left(noise())


@pytest.mark.study
def test_it_is_reported_apart() -> None:
    """The same result, digit by digit, with a number beside it."""
    log, robot = backlash_log(), load_robot("prototype")
    without, with_it = (
        identify(log, robot, held_out=["two"], max_effects=0, network=on, threads=1) for on in (False, True)
    )
    assert without.network == {}
    assert 0.0 < with_it.network["held_out_rms_m"] < with_it.test.after
    assert_array_equal(with_it.after, without.after)
    for name in ("test", "verdict", "identified"):
        assert getattr(with_it, name) == getattr(without, name)
