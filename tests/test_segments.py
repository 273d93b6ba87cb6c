"""Actions of segments: the bends they name are those that come; their matrix is the slope of the inputs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rods import behind_a_passive_one, rod

from fastrod import Robot, Segment, Simulator, Tendon, load_robot
from fastrod.errors import InputError
from fastrod.model.segment_actions import SegmentActions
from fastrod.reference import constant_curvature


def stiff_wires(n_segments: int = 2, n_tendons: int = 4, offset: float = 0.008) -> Robot:
    """Weightless, of tendons that hardly stretch; those of the second segment between those of the first."""
    stiffness: Any = {"bending_stiffness": (0.0022, 0.0022), "torsional_stiffness": 0.001}
    segments = []
    for k in range(n_segments):
        angles = 2.0 * np.pi * (np.arange(n_tendons) + 0.4 * k) / n_tendons
        tendons = tuple(Tendon(offset=offset - 0.001 * k, angle=float(a), compliance=1e-9) for a in angles)
        segments.append(Segment(length=0.1 - 0.02 * k, extension=(-0.01, 0.03), tendons=tendons, **stiffness))
    return Robot(name="stiff", segments=tuple(segments))


def arc(bend: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and end of an arc along e3 that bends toward d1 and d2 by bend: the closed form."""
    angle = float(np.hypot(*bend))
    if angle == 0.0:
        return np.eye(3), np.array([0.0, 0.0, length])
    toward = np.array([*bend, 0.0]) / angle
    e3 = np.array([0.0, 0.0, 1.0])
    axis = np.cross(e3, toward)
    hat = np.cross(np.eye(3), axis)
    turn = np.eye(3) + np.sin(angle) * hat + (1.0 - np.cos(angle)) * hat @ hat
    return turn, length / angle * ((1.0 - np.cos(angle)) * toward + np.sin(angle) * e3)


@pytest.mark.parametrize("n_tendons", [3, 4])
@pytest.mark.parametrize("seed", range(4))
def test_segments_are_arcs_of_displacement_over_offset(n_tendons: int, seed: int) -> None:
    robot = stiff_wires(n_tendons=n_tendons)
    actions = SegmentActions(robot)
    bends = np.random.default_rng(seed).uniform(-0.9, 0.9, (2, 2))
    stretch = np.random.default_rng(50 + seed).uniform(-0.01, 0.03, 2)
    action = np.column_stack([stretch, bends * actions.offset[:, None]]).ravel()
    inputs = actions.inputs(action)
    state = Simulator(robot, points_per_segment=20).settle(**inputs)
    assert state.ok[0]
    turn, end = np.eye(3), np.zeros(3)
    for k, segment in enumerate(robot.segments):
        by, chord = arc(bends[k], segment.length + stretch[k])
        end, turn = end + turn @ chord, turn @ by
        # fourth order: (0.9 / 20)^4 of 0.1 m, and 1e-9 m/N of stretch
        assert_allclose(state.position[0, 20 * (k + 1)], end, atol=2e-7)
        assert_allclose(state.rotation[0, 20 * (k + 1)], turn, atol=2e-6)
    shape = constant_curvature(robot, inputs["tendon_length"], inputs["extension"])
    assert_allclose(shape.tip_position, end, atol=1e-12)
    assert shape.residual < 1e-12


@pytest.mark.parametrize(("entry", "axis"), [(1, 0), (2, 1)])
def test_the_first_displacement_bends_toward_d1_and_the_second_toward_d2(entry: int, axis: int) -> None:
    robot = stiff_wires(1)
    inputs = SegmentActions(robot).inputs(0.5 * 0.008 * np.eye(3)[entry])
    tip = Simulator(robot, points_per_segment=10).settle(**inputs).tip_position[0]
    assert tip[axis] == pytest.approx(0.1 / 0.5 * (1.0 - np.cos(0.5)), abs=1e-6)
    assert abs(tip[1 - axis]) < 1e-9
    assert tip[2] == pytest.approx(0.1 / 0.5 * np.sin(0.5), abs=1e-6)


def test_a_passive_segment_takes_a_share_of_the_bend_of_the_tendons_that_cross_it() -> None:
    robot = behind_a_passive_one(stiff_wires(1))
    actions = SegmentActions(robot)
    assert actions.offset.tolist() == [0.0, 0.008]
    state = Simulator(robot).settle(**actions.inputs([0.0, 9.0, 9.0, 0.0, 0.3 * 0.008, 0.4 * 0.008]))
    assert state.tip_rotation[0, 2, 2] == pytest.approx(np.cos(0.5), abs=1e-6)
    assert state.position[0, 20, 0] / state.tip_position[0, 0] == pytest.approx(0.26, abs=0.01)


# the last of few digits, as a file may have them: by so little its tendons are off one plane
@pytest.mark.parametrize(("angle", "digits"), [(0.0, 9), (0.6, 9), (1.5, 9), (2.5, 9), (0.6, 3)])
def test_a_segment_of_tendons_in_one_plane_bends_in_it(angle: float, digits: int) -> None:
    one = stiff_wires(1, n_tendons=2).segments[0]
    flat = replace(one, tendons=tuple(replace(t, angle=round(t.angle + angle, digits)) for t in one.tendons))
    robot, along = Robot(name="flat", segments=(flat,)), np.array([np.cos(angle), np.sin(angle)])
    (number,) = np.flatnonzero((actions := SegmentActions(robot)).bends)
    assert number == 1 + np.argmax(np.abs(along))
    tip = Simulator(robot, points_per_segment=10).settle(**actions.inputs(0.5 * 0.008 * np.eye(3)[number]))
    expected = np.sign(along[number - 1]) * along * 0.1 / 0.5 * (1.0 - np.cos(0.5))
    assert_allclose(tip.tip_position[0, :2], expected, atol=1e-6 if digits == 9 else 5e-6)


def test_the_matrix_is_the_slope_of_the_inputs() -> None:
    for robot in (stiff_wires(3), load_robot("five_segment_reacher"), rod("paper", n_tendons=3)):
        actions = SegmentActions(robot)
        n = actions.n_actions
        assert n == 3 * robot.n_segments
        assert actions.matrix.shape == (robot.n_tendons + robot.n_segments, n)
        at = 1e-3 * np.random.default_rng(2).normal(size=n)
        ends = [actions.inputs(at + sign * 1e-3 * np.eye(n)) for sign in (1.0, -1.0)]
        matrix = np.split(actions.matrix, [robot.n_tendons])
        for name, rows in zip(("tendon_length", "extension"), matrix, strict=True):
            slope = (ends[0][name] - ends[1][name]) / 2e-3
            assert_allclose(slope.T, rows, atol=1e-12)  # linear: exact but for rounding


def test_no_action_is_the_rest_robot_and_actions_add_up_over_a_batch() -> None:
    robot = stiff_wires()
    actions = SegmentActions(robot)
    rest = actions.inputs(np.zeros(6))
    assert_array_equal(rest["tendon_length"], robot.rest_tendon_length)
    assert_array_equal(rest["extension"], 0.0)
    many = np.random.default_rng(3).uniform(-1e-3, 1e-3, (5, 6))
    got, alone = (actions.inputs(many)["tendon_length"], [actions.inputs(a)["tendon_length"] for a in many])
    assert got.shape == (5, 8)
    assert_allclose(got, np.stack(alone), atol=1e-15)


def test_an_offset_of_ones_own_scales_the_bends() -> None:
    robot = stiff_wires()
    own, other = SegmentActions(robot), SegmentActions(robot, offset=0.016)
    assert_allclose(own.offset, [0.008, 0.007], rtol=1e-12)
    assert_array_equal(other.offset, 0.016)
    there, here = (made.inputs(size * np.eye(6)[1]) for made, size in ((other, 0.016), (own, 0.008)))
    assert_allclose(there["tendon_length"], here["tendon_length"], atol=1e-15)


SIX = "it must be (..., 6): extension and two displacements for each of 2 segments, base first [m]."


@pytest.mark.parametrize(
    ("action", "sentence"),
    [
        ([0.0, 0.0], f"action has shape (2,); {SIX}"),
        (0.0, f"action has shape (); {SIX}"),
        (
            [0.0, np.nan, 0.0, 0.0, 0.0, 0.0],
            "action holds a value that is not finite: [ 0. nan  0.  0.  0.  0.].",
        ),
        ("bend", "action is 'bend'; give 6 numbers [m]."),
    ],
    ids=["too short", "a number", "not finite", "text"],
)
def test_what_is_no_action_is_refused(action: Any, sentence: str) -> None:
    actions = SegmentActions(stiff_wires())
    with pytest.raises(InputError) as caught:
        actions.inputs(action)
    assert str(caught.value) == sentence
