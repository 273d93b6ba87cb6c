"""The energy minimum against the truth files: two ways to the same shape that share no line of code."""

from __future__ import annotations

import energy
import numpy as np
import pytest
from numpy.testing import assert_allclose
from truthfiles import numbers, rows

K = [0.0022, 0.0022, 0.001]


def ring(n: int, offset: float) -> np.ndarray:
    angle = 2.0 * np.pi * np.arange(n) / n
    return offset * np.stack([np.cos(angle), np.sin(angle)], axis=1)


# three and four tendons, compliances from 1.3e-6 to 1e-3 m/N
@pytest.mark.study(beyond=2)
@pytest.mark.parametrize("case", [0, 1, 3, 7, 11, 16, 24, 28])
def test_least_energy_is_the_truth(case: int) -> None:
    row = rows("tendon_length_truth.csv")[case]
    n = int(row["n"])
    found = energy.minimise(
        float(row["l"]),
        numbers(row, "EI", "EI", "GJ"),
        ring(n, float(row["offset"])),
        numbers(row, *[f"L{i + 1}" for i in range(n)]),
        float(row["c"]),
        numbers(row, "Fx", "Fy", "Fz"),
        numbers(row, "fx", "fy", "fz"),
    )
    rotation = numbers(row, *[f"R{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]).reshape(3, 3)
    # the coarsest grid misses by 1e-4 m and three extrapolations take off h^2, h^4 and h^6: 1e-11 m is left
    assert found.error < 1e-9
    assert_allclose(found.tip_position, numbers(row, "tip_x", "tip_y", "tip_z"), rtol=0, atol=1e-9)
    assert_allclose(found.tip_rotation, rotation, rtol=0, atol=1e-8)
    # a tension is a length over a compliance: 1e-15 m / 1e-6 m/N, and what the extrapolation leaves
    assert_allclose(found.tension, numbers(row, *[f"T{i + 1}" for i in range(n)]), rtol=0, atol=1e-7)


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("case", ["A07", "A15", "A21", "B29", "B33"])
def test_least_energy_of_a_chain_is_the_truth(case: str) -> None:
    """Two segments; distal tendons keep their own offset through the proximal one (10, 10 mm and 8, 6 mm)."""
    row = next(row for row in rows("tdcr_cases.csv") if row["case"] == case)
    first, second, length, stiffness = {
        # the stiffness is E pi ro^4 / 4 and 2 G I with G = E / 2.6
        "A": (0.010, 0.010, 0.2, 54e9 * np.pi * 0.7e-3**4 / 4.0),
        "B": (0.008, 0.006, 0.1, 60e9 * np.pi * 0.5e-3**4 / 4.0),
    }[row["robot"]]
    # angles 90, -30, 210 deg
    place = np.array([[0.0, 1.0], [np.cos(np.pi / 6.0), -0.5], [-np.cos(np.pi / 6.0), -0.5]])
    away = np.full((3, 2), np.nan)
    offsets = np.stack([np.concatenate([near, second * place]) for near in (first * place, away)])
    tension = numbers(row, *[f"q{i}" for i in range(1, 7)])
    path = numbers(row, *[f"kir_len{i}" for i in range(1, 7)])
    c = 1e-5
    K, force = stiffness * np.array([1.0, 1.0, 2.0 / 2.6]), numbers(row, "fx", "fy", "fz")
    found = energy.minimise([length, length], K, offsets, path - c * tension, c, force)
    # the file's own answers are good to some 1e-11 m; the extrapolation's error estimate bounds ours
    assert found.error < 1e-8
    assert_allclose(found.tip_position, numbers(row, "kir_px", "kir_py", "kir_pz"), rtol=0, atol=1e-8)
    assert_allclose(found.tension, tension, rtol=0, atol=1e-5)
    assert_allclose(found.tendon_length, path, rtol=0, atol=1e-10)


def test_error_falls_with_the_square_of_the_element() -> None:
    def tip(**options: int) -> np.ndarray:
        lengths, force = [0.066, 0.069, 0.074, 0.071], [0.2, 0.1, -0.1]
        return energy.minimise(0.07, K, ring(4, 0.0075), lengths, 1e-5, force, **options).tip_position

    exact, n = tip(), np.array([4, 8, 16])
    error = [np.abs(tip(elements=k, levels=2) - exact).max() for k in n]
    slope = np.polyfit(np.log(n), np.log(error), 1)[0]
    # one extrapolation leaves the fourth power; that it does is what the others rest on
    assert slope == pytest.approx(-4.0, abs=0.3)


def test_a_slack_wire_does_nothing() -> None:
    lengths, force = np.array([0.066, 0.080, 0.080]), [0.0, 0.1, 0.0]
    found = energy.minimise(0.07, K, ring(3, 0.0075), lengths, 1e-5, force, unilateral=True)
    alone = energy.minimise(0.07, K, ring(3, 0.0075)[:1], lengths[:1], 1e-5, force)
    assert found.tension[0] > 0.0
    assert_allclose(found.tension[1:], 0.0, rtol=0, atol=0)
    # both are the same finite sums, so only rounding differs
    assert_allclose(found.tip_position, alone.tip_position, rtol=0, atol=1e-12)
