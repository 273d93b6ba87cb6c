"""The plant against the energy minimum, and its effects against their own claims."""

from __future__ import annotations

from dataclasses import replace

import energy
import numpy as np
import plant
import plant_rod
import pytest
from numpy.testing import assert_allclose
from plant_rod import COMPLIANCE, EI, GJ, GRAVITY, LENGTH, OFFSET

SIDEWAYS = [np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]


def least_energy(
    bend: np.ndarray, payload: float, down: np.ndarray, compliance: float = COMPLIANCE, line: float = 0.0
) -> np.ndarray:
    """Tip [m] of bends (segments, 2) [rad] under a payload [kg] and a line weight [N/m]."""
    segments = len(bend)
    angle = plant_rod.angles(segments)
    offsets = np.repeat(OFFSET * np.stack([np.cos(angle), np.sin(angle)], axis=1)[None], segments, axis=0)
    for k in range(1, segments):
        offsets[k, : 4 * k] = np.nan
    lengths = plant.arc_lengths(bend[None])[0] + LENGTH * np.repeat(np.arange(1, segments + 1), 4)
    rod = np.full(segments, LENGTH), np.tile([EI, EI, GJ], (segments, 1)), offsets, lengths, compliance
    found = energy.minimise(*rod, payload * down, line / GRAVITY * down, elements=6, levels=3)
    assert found.error < 5e-6
    return found.tip_position


def still(bend: np.ndarray, payload: float) -> plant.Inputs:
    """Two samples of one pose, the base turned by 90 degrees."""
    t, dl = np.array([0.0, 1.0]), plant.arc_lengths(np.stack([bend, bend]))
    return plant.Inputs(t, dl, np.full(2, payload), np.tile(SIDEWAYS, (2, 1)))


@pytest.mark.parametrize(
    ("bend", "payload"),
    [([[0.0, 0.0]], 0.1), ([[0.8, -0.3]], 0.0), ([[0.5, 0.6]], 0.1), ([[0.4, -0.5], [-0.3, 0.7]], 0.02)],
)
def test_without_effect_it_is_the_rod_of_least_energy(bend: list[list[float]], payload: float) -> None:
    down = np.array([0.0, -GRAVITY, 0.0])  # -z of the world, seen from a base that is turned about x
    tip, _ = plant.pose(still(np.array(bend), payload), plant.draw(0, "none"))
    # both are discretised: the plant by modes, 0.5 um; the elements by their reported error, 5 um at most
    assert_allclose(tip[0], least_energy(np.array(bend), payload, down), rtol=0, atol=5e-6)


def test_weight_and_stretch_are_those_of_least_energy() -> None:
    bend, down = np.array([[0.5, -0.4]]), np.array([0.0, -GRAVITY, 0.0])
    seal = plant.Seal({"gravity": {"weight": 5.0, "slope": 0.0}, "tendon_stretch": {"gain_loss": 0.2}}, 0)
    compliance = 2.0 * OFFSET**2 * 0.25 * LENGTH / EI
    tip, _ = plant.pose(still(bend, 0.05), seal)
    assert_allclose(tip[0], least_energy(bend, 0.05, down, compliance, 5.0), rtol=0, atol=5e-6)


def test_stretch_loses_the_share_of_the_bend_that_it_claims() -> None:
    bend = np.array([[0.4, 0.0]])
    _, turn = plant.pose(still(bend, 0.0), plant.Seal({"tendon_stretch": {"gain_loss": 0.2}}, 0))
    # small bends: the tendons' own path, which the share leaves out, is of second order
    assert_allclose(np.arccos(turn[0, 2, 2]), 0.8 * 0.4, rtol=1e-2)


@pytest.fixture(scope="module")
def designed() -> plant.Inputs:
    """The designed log at 5 Hz, for speed."""
    log = plant.designed_inputs(np.random.default_rng(3))
    return plant.Inputs(log.t[::3], log.dl[::3], log.payload[::3], log.base_quaternion[::3])


@pytest.fixture(scope="module")
def bare(designed: plant.Inputs) -> np.ndarray:
    return plant.pose(designed, plant.draw(3, "none"))[0]


# 0.3 mm is the noise; the catalogue's lens reaches 1 % at the edge of a workspace of 30 mm
@pytest.mark.study(beyond=3)
@pytest.mark.parametrize("name", plant.library(1) + plant.OUTSIDE)
def test_every_effect_moves_the_tip_by_its_size(name: str, designed: plant.Inputs, bare: np.ndarray) -> None:
    moved = plant.pose(designed, plant.draw(3, name))[0] - bare
    assert (0.03e-3 if name == "lens" else 0.35e-3) < np.sqrt(np.mean(np.sum(moved**2, axis=1))) < 8e-3


def test_coupling_needs_two_segments() -> None:
    inputs = plant.operator_inputs(np.random.default_rng(0), segments=2, seconds=8.0)
    coupled, bare = (plant.pose(inputs, plant.draw(0, name, segments=2))[0] for name in ("coupling", "none"))
    assert np.abs(coupled - bare).max() > 1e-3
    assert "coupling" not in plant.library(1)


def test_friction_has_a_loop_that_speed_does_not_change() -> None:
    t = np.linspace(0.0, 10.0, 301)
    bend = np.zeros((len(t), 1, 2))
    bend[:, 0, 0] = np.interp(t, [0.0, 2.0, 6.0, 10.0], [0.0, 0.6, -0.6, 0.6])
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
    slow = plant.Inputs(t, plant.arc_lengths(bend), np.zeros(len(t)), upright)
    tip, _ = plant.pose(slow, plant.draw(1, "friction"))
    fast, _ = plant.pose(replace(slow, t=t / 4.0), plant.draw(1, "friction"))
    assert_allclose(fast, tip, rtol=0, atol=1e-12)
    down, up = tip[120], tip[240]  # bend zero on the way down and on the way up
    assert np.linalg.norm(up - down) > 1e-3
    creeping, quick = (plant.pose(replace(slow, t=t * k), plant.draw(1, "creep"))[0] for k in (1.0, 0.05))
    assert np.abs(creeping - quick).max() > 3e-4


def test_latency_is_the_past_of_the_motion() -> None:
    inputs = plant.operator_inputs(np.random.default_rng(5), seconds=20.0)
    bare, _ = plant.pose(inputs, plant.draw(0, "none"))
    late, _ = plant.pose(inputs, plant.Seal({"latency": {"delay": 2.0 / 15.0, "skew": 0.0}}, 0))
    assert_allclose(late[2:], bare[:-2], rtol=0, atol=1e-9)


def test_noise_has_its_sigma_and_the_seed_repeats_the_log(designed: plant.Inputs, bare: np.ndarray) -> None:
    seal = plant.draw(3, "none")
    seen = plant.measure(designed, seal, 3e-4)
    # 2250 numbers give sigma to 1.5 %: four of those
    assert abs(np.std(seen - bare) / 3e-4 - 1.0) < 0.06
    assert np.array_equal(seen, plant.measure(designed, plant.draw(3, "none"), 3e-4))
    wild = np.linalg.norm(plant.measure(designed, seal, 3e-4, outliers=0.02) - bare, axis=1) > 4e-3
    assert 0.005 < wild.mean() < 0.04


def test_draws_repeat_and_stay_in_their_kind() -> None:
    for seed in range(20):
        (name,) = plant.draw(seed).effects
        assert name in plant.library(1)
        pair = plant.draw_pair(seed, segments=2)
        assert len(pair.effects) == 2
        assert set(pair.effects) <= set(plant.LIBRARY)
        assert repr(plant.draw_pair(seed)) == repr(plant.draw_pair(seed))


@pytest.mark.study
def test_a_dominant_effect_dominates() -> None:
    inputs = plant.designed_inputs(np.random.default_rng(0))
    effects = plant.draw_many(1, inputs).effects
    assert len(effects) == 9
    assert set(effects) <= set(plant.LIBRARY)
    alone = ({name: effect} for name, effect in effects.items())
    bare, *tips = (plant.pose(inputs, plant.Seal(one, 1))[0] for one in ({}, *alone))
    moved = [np.sqrt(np.mean((tip - bare) ** 2)) for tip in tips]
    # 0.1 to 0.2 of the dominant one, were every effect in proportion to its size
    assert max(moved[1:]) < 0.4 * moved[0]


def test_draws_are_independent_of_what_else_is_drawn() -> None:
    alone, both = (plant.draw(4, names).effects for names in ("gravity", ["payload", "gravity"]))
    assert alone["gravity"] == both["gravity"]
    with pytest.raises(ValueError, match="no effect of a robot of 1 segment"):
        plant.draw(0, "coupling")
