"""`import fastrod` alone: names that a user guesses, pictures and tables of what comes back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from identification.logs import one_segment
from numpy.testing import assert_allclose
from refusals import refusals

import fastrod
from fastrod.errors import InputError, RobotError

STEEL = {"length": 0.1, "radius": 1e-3, "youngs_modulus": 200e9}


def test_every_name_is_there_and_another_one_is_answered_with_the_nearest() -> None:
    for name in fastrod.__all__:
        assert getattr(fastrod, name) is not None
    with pytest.raises(AttributeError, match="did you mean 'identify'"):
        _ = fastrod.identfy


def test_a_material_is_the_closed_form_of_a_round_rod() -> None:
    rod = fastrod.Segment.from_material(**STEEL, density=7850.0, poisson=0.25, mode="passive")
    area, second = math.pi * 1e-6, math.pi * 0.25e-12
    assert_allclose(rod.bending_stiffness, 200e9 * second)
    assert_allclose(rod.torsional_stiffness, 80e9 * 2.0 * second)
    assert_allclose(rod.axial_stiffness, 200e9 * area)
    assert_allclose(rod.shear_stiffness, 80e9 * area * 7.5 / 8.5)
    assert_allclose(rod.line_density, 7850.0 * area)
    tendon = fastrod.Tendon(offset=0.004, angle=0.0)
    assert fastrod.Segment.from_material(**STEEL, tendons=(tendon,)).body_radius == 0.004


@refusals(
    {
        RobotError: {
            "radius is -1 m; it must be a number from 1e-06 to 10 m.": lambda: fastrod.Segment.from_material(
                **(STEEL | {"radius": -1})
            ),
            "poisson is 0.7; it must be a number between -1 and 0.5.": lambda: fastrod.Segment.from_material(
                **STEEL, poisson=0.7
            ),
            "density is -1 kg/m": lambda: fastrod.Segment.from_material(**STEEL, density=-1),
        },
        InputError: {"view shows a Simulator; it was given Robot": lambda: fastrod.view(one_segment())},
    }
)
def test_wrong_input_is_one_sentence(error: type[Exception], sentence: str, call: object) -> None:
    with pytest.raises(error, match=sentence):
        call()  # type: ignore[operator]


def test_to_settle_without_lengths_is_to_rest() -> None:
    sim = fastrod.Simulator(one_segment(), n_robots=2)
    state = sim.settle()
    assert_allclose(state.tip_position, [[0.0, 0.0, one_segment().length]] * 2, atol=1e-12)


def test_a_state_shows_itself() -> None:
    from matplotlib import pyplot

    sim = fastrod.Simulator(one_segment(), n_robots=40)
    state = sim.settle()
    axes = state.plot()
    lines = [line for line in axes.get_lines() if len(line.get_data_3d()[0]) > 1]
    assert_allclose(np.max(lines[0].get_data_3d()[2]), 1e3 * one_segment().length)
    pyplot.close("all")
    html = state._repr_html_()
    assert "and 32 more" in html
    assert f"0.00, 0.00, {1e3 * one_segment().length:.2f}" in html
    tips = fastrod.Simulator(one_segment(), outputs="tip").settle()
    with pytest.raises(InputError, match="tips only"):
        tips.plot()
