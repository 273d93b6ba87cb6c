"""The operators against their obvious twin: two rows, three tendons, every tendon with numbers of its own, in
two calls."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from plain import naive_operators as naive

from fastrod.kernels import operators
from fastrod.kernels.operators import BUFFER, SLIDERS

N_STEPS = BUFFER + 40
rng = np.random.default_rng(12)
PATH = np.cumsum(rng.uniform(-0.4, 0.4, (2, N_STEPS, 3)), axis=1) + 0.3
# irregular, and some steps that take no time
DT = rng.uniform(0.001, 0.05, N_STEPS) * (rng.random(N_STEPS) > 0.1)
ANGLE = rng.uniform(0.0, 1.0, PATH.shape)
FRACTION = rng.uniform(0.0, 1.0, (2, 3))
WIDTH = rng.uniform(0.05, 0.6, (2, 3))
SPREAD = rng.uniform(0.0, 0.9, (2, 3))
WIDTH[0, 0] = FRACTION[1, 1] = 0.0
SLOW = WIDTH + 0.02
LAG = np.array([0.11, 1e3])
RADII = SLOW[..., None] * np.exp(SPREAD[..., None] * np.linspace(-1.0, 1.0, SLIDERS))

Case = tuple[int, Callable[..., Any], Callable[..., np.ndarray]]
CASES: dict[str, Case] = {
    "play": (
        9,
        lambda x, m, s: operators.play(x, m, WIDTH, SPREAD),
        lambda x, r, w: naive.play(x, WIDTH[r, w], SPREAD[r, w]),
    ),
    "sharp play": (
        9,
        lambda x, m, s: operators.play(x, m, WIDTH, np.zeros((2, 3))),
        lambda x, r, w: naive.sharp_play(x, WIDTH[r, w]),
    ),
    "elastoplastic": (
        3 * (1 + SLIDERS),
        lambda x, m, s: operators.elastoplastic(x, m, FRACTION, SLOW, SPREAD, WIDTH, ANGLE[:, s].copy()),
        lambda x, r, w: naive.elastoplastic(x, FRACTION[r, w], RADII[r, w], WIDTH[r, w], ANGLE[r, :, w]),
    ),
    "relaxation": (
        6,
        lambda x, m, s: operators.relaxation(x, m, FRACTION, SLOW, DT[s]),
        lambda x, r, w: naive.relaxation(x, FRACTION[r, w], SLOW[r, w], DT),
    ),
    "second_order": (
        9,
        lambda x, m, s: operators.second_order(x, m, WIDTH, SPREAD, DT[s]),
        lambda x, r, w: naive.second_order(x, WIDTH[r, w], SPREAD[r, w], DT),
    ),
    "delay": (
        1 + 4 * BUFFER,
        lambda x, m, s: operators.delay(x, m, LAG, DT[s]),
        lambda x, r, w: naive.delay(x, LAG[r], DT, BUFFER),
    ),
    "no delay": (
        1 + 4 * BUFFER,
        lambda x, m, s: operators.delay(x, m, np.zeros(2), DT[s]),
        lambda x, r, w: x,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_operator_is_its_twin(name: str) -> None:
    width, kernel, twin = CASES[name]
    memory, parts = np.full((2, width), np.nan), []
    for part in (slice(0, 50), slice(50, N_STEPS)):
        x = PATH[:, part].copy()
        kernel(x, memory, part)
        parts.append(x)
    found = np.concatenate(parts, axis=1)
    for r in range(2):
        for w in range(3):
            # rounding of some hundred steps, and of a matrix squared ten times
            assert_allclose(
                found[r, :, w], twin(PATH[r, :, w], r, w), atol=1e-11, err_msg=f"row {r}, tendon {w}"
            )
    assert np.isfinite(memory[:, : width if "delay" not in name else 1]).all()


def test_yielding_is_its_twin() -> None:
    """Bends in a plane: (rows, steps, segments, 2)."""
    path = np.cumsum(np.random.default_rng(13).uniform(-0.4, 0.4, (2, N_STEPS, 3, 2)), axis=1)
    memory, found = np.full((2, 6), np.nan), path.copy()
    for part in (slice(0, 50), slice(50, N_STEPS)):
        bend = path[:, part].copy()
        operators.yielding(bend, memory, FRACTION, WIDTH)
        found[:, part] = bend
    for r in range(2):
        for k in range(3):
            # rounding of some hundred steps
            assert_allclose(
                found[r, :, k], naive.yielding(path[r, :, k], FRACTION[r, k], WIDTH[r, k]), atol=1e-13
            )
    assert np.isfinite(memory).all()
