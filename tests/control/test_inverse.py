"""Plans by learning: the nearest points of the workspace, and with effects the tip still goes there."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import fastrod
from fastrod.control import circle, triangle
from fastrod.control.inverse import InversePlan, plan
from fastrod.errors import InputError, RobotError
from fastrod.model.robot import Robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.simulator import Simulator
from fastrod.types import Floats

RATE = 20.0
PROTOTYPE = fastrod.load_robot("prototype")
LAP = triangle(side=0.03, period=6.0, center=(0.0, 0.0, PROTOTYPE.length)).position(np.arange(120) / RATE)
EFFECTS: dict[str, dict[str, float]] = {
    "backlash": {"half_width": 3e-4},
    "friction": {"half_width": 3e-4, "growth": 0.4},
    "creep": {"share": 0.1, "time_constant": 2.0},
    "tendon_stretch": {"compliance": 5e-4},
    "gravity": {"line_density": 0.3},
    "latency": {"delay": 0.1},
}


def with_effects(*names: str) -> Robot:
    return replace(PROTOTYPE, effects=tuple({"name": name, **EFFECTS[name]} for name in names))


def with_segments(**change: Any) -> Robot:
    return replace(PROTOTYPE, segments=tuple(replace(one, **change) for one in PROTOTYPE.segments))


@cache
def made(*names: str) -> InversePlan:
    return plan(with_effects(*names), LAP, RATE)


def run(robot: Robot, given: InversePlan, lead: float = 0.0) -> Floats:
    """(n, 3) the tip as it is measured `lead` seconds after each row was sent."""
    simulator = Simulator(robot, dt=1.0 / RATE, points_per_segment=10)
    late = round(lead * RATE)
    seen = []
    for k, dl in enumerate(np.concatenate([given.dl, np.repeat(given.dl[-1:], late, axis=0)])):
        (simulator.step if k else simulator.settle)(robot.rest_tendon_length + dl)
        seen.append(simulator.measure().tip_position[0])
    return np.array(seen)[late:]


def rms(a: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(a**2, axis=1))))


def test_without_effects_the_tip_goes_to_the_nearest_points() -> None:
    given = made()
    path = slice(given.n_approach, None)
    assert given.rollouts == 1
    assert_allclose(given.predicted[path], given.nearest[path], atol=1e-5)
    assert_allclose(run(PROTOTYPE, given), given.predicted, atol=1e-5)
    assert_array_equal(given.target[path], LAP)


def test_the_nearest_points_are_nearest() -> None:
    given = made()
    near, goal = given.nearest[given.n_approach :], LAP
    # a single arc of length l that bends by b in the plane phi: the tip is l / b (1 - cos b) out and l / b
    # sin b up
    b, phi = np.meshgrid(np.linspace(1e-6, 2.0, 800), np.linspace(-np.pi, np.pi, 721), indexing="ij")
    out, up = PROTOTYPE.length / b * (1.0 - np.cos(b)), PROTOTYPE.length / b * np.sin(b)
    surface = np.stack([out * np.cos(phi), out * np.sin(phi), up], axis=-1).reshape(-1, 3)
    for k in range(0, len(goal), 7):
        least = np.linalg.norm(surface - goal[k], axis=1).min()
        # tendons stretch, and the grid is 0.2 mm wide
        assert np.linalg.norm(near[k] - goal[k]) == pytest.approx(least, abs=5e-6)
        assert np.linalg.norm(surface - near[k], axis=1).min() < 2e-4


def test_nearest_is_stationary() -> None:
    given = made("gravity")
    robot, actions = with_effects("gravity"), SegmentActions(PROTOTYPE)
    q = np.linalg.lstsq(actions.matrix[:4, 1:], given.dl[given.n_approach :].T, rcond=None)[0].T
    q = np.column_stack([np.zeros(len(q)), q])
    simulator = Simulator(robot, n_robots=len(q), points_per_segment=20)
    tip = simulator.settle(**actions.inputs(q)).tip_position
    slopes = simulator.jacobian()[:, :3] @ actions.matrix[:, 1:]
    left = np.einsum("nij,ni->nj", slopes, LAP - tip)
    # slopes of some 5, errors of some mm: the product is 1e-2 where it is not stationary
    assert np.abs(left).max() < 1e-5
    assert_allclose(tip, given.nearest[given.n_approach :], atol=1e-6)


@pytest.mark.study
@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_is_made_up_for(name: str) -> None:
    robot, given, bare = with_effects(name), made(name), made()
    path = slice(given.n_approach, None)
    seen = run(robot, given, given.lead)
    assert_allclose(seen, given.predicted, atol=2e-5)
    error = rms(seen[path] - given.nearest[path])
    without = rms(run(robot, bare)[path] - given.nearest[path])
    assert without > 1e-4
    assert error < 0.25 * without
    assert error == pytest.approx(given.rms_distance, abs=1e-5)


@pytest.mark.study
def test_all_at_once_and_a_camera_that_is_off() -> None:
    names = ("backlash", "friction", "creep", "gravity", "latency")
    seen_by = {"name": "frame_misalignment", "rotation_x": 0.03, "shift_x": 5e-4}
    robot = replace(with_effects(*names), effects=(*with_effects(*names).effects, seen_by))
    given = plan(robot, LAP, RATE)
    path = slice(given.n_approach, None)
    seen = run(robot, given, given.lead)
    assert rms(seen[path] - given.nearest[path]) < 0.1 * rms(run(robot, made())[path] - given.nearest[path])
    assert given.rms_nearest <= given.rms_predicted < 1.02 * given.rms_nearest
    assert given.lead == 0.1


def test_the_base_may_stand_anyhow() -> None:
    base = {"base_position": (0.3, -0.2, 0.1), "base_quaternion": (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)}
    given = plan(replace(with_effects("gravity"), **base), LAP, RATE)
    path = slice(given.n_approach, None)
    assert_allclose(given.predicted[path], given.nearest[path], atol=1e-5)
    # gravity points elsewhere in this frame
    assert rms(run(made("gravity").robot, given)[path] - given.nearest[path]) > 1e-4


def test_the_approach_is_smooth_and_begins_where_the_robot_stands() -> None:
    start = np.array([-0.002, 0.001, 0.002, -0.001])
    given = plan(PROTOTYPE, LAP, RATE, start=start, approach=1.5)
    n = given.n_approach
    assert n == 30
    assert_allclose(given.dl[0], start, atol=1e-12)
    assert np.isnan(given.target[:n]).all()
    assert np.isnan(given.nearest[:n]).all()
    assert np.isfinite(given.predicted).all()
    assert_allclose(given.t, np.arange(n + len(LAP)) / RATE)
    assert len(given) == n + len(LAP)
    steps = np.abs(np.diff(given.dl[: n + 1], axis=0)).max(axis=1)
    assert max(steps[0], steps[-1]) < 0.02 * steps.max()
    assert_array_equal(given.ext, np.zeros((len(given), 1)))
    at_once = plan(PROTOTYPE, LAP, RATE, approach=0.0)
    assert at_once.n_approach == 0
    assert_allclose(at_once.dl, given.dl[n:], atol=1e-12)


def test_a_limit_is_kept_and_the_rest_done() -> None:
    given = plan(PROTOTYPE, LAP, RATE, limit=0.003)
    q = np.linalg.lstsq(SegmentActions(PROTOTYPE).matrix[:4, 1:], given.dl.T, rcond=None)[0].T
    free = made().dl[made().n_approach :]
    assert np.abs(q).max() == pytest.approx(0.003)
    assert np.abs(free).max() > 0.003
    path = slice(given.n_approach, None)
    assert_allclose(given.predicted[path], given.nearest[path], atol=1e-5)
    inside = np.abs(free).max(axis=1) < 0.0029
    assert inside.any()
    assert_allclose(given.dl[path][inside], free[inside], atol=1e-6)
    assert given.rms_nearest > made().rms_nearest


def test_a_segment_that_extends_gets_to_the_path_itself() -> None:
    given = plan(with_segments(extension=(0.0, 0.02)), LAP, RATE)
    path = slice(given.n_approach, None)
    assert given.rms_nearest < 1e-6
    assert_allclose(given.predicted[path], LAP, atol=1e-5)
    assert given.ext.min() >= 0.0
    assert given.ext.max() > 1e-3


def test_two_segments_get_to_points_that_one_does_not() -> None:
    first = PROTOTYPE.segments[0]
    tendons = tuple(replace(tendon, angle=float(np.ravel(tendon.angle)[0]) + 0.5) for tendon in first.tendons)
    two = Robot(name="two", segments=(first, replace(first, tendons=tendons)))
    goal = circle(radius=0.02, period=4.0, center=(0.0, 0.0, 0.13)).position(np.arange(40) / 10.0)
    given = plan(two, goal, 10.0)
    assert given.dl.shape == (50, 8)
    assert given.rms_predicted < 1e-6


@pytest.mark.study
def test_it_is_the_same_again() -> None:
    one, other = (plan(with_effects("backlash", "latency"), LAP, RATE, rollouts=3) for _ in range(2))
    assert_array_equal(one.dl, other.dl)
    assert_array_equal(one.predicted, other.predicted)
    assert one.rollouts == other.rollouts == 3
    assert not one.dl.flags.writeable


@pytest.mark.study
def test_more_rollouts_are_never_worse() -> None:
    found = [plan(with_effects("backlash"), LAP, RATE, rollouts=n).rms_distance for n in (1, 2, 4)]
    assert found == sorted(found, reverse=True)
    assert found[2] < 0.5 * found[0]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"target": LAP[:, :2]}, r"target has shape \(120, 2\); it must be \(n, 3\)"),
        ({"target": LAP[:1]}, "two or more positions"),
        ({"target": "circle"}, "target is not an array of numbers"),
        ({"target": np.where(np.arange(120)[:, None] == 7, np.nan, LAP)}, "not finite"),
        ({"rate": 0.0}, "rate is 0.0 Hz; it must be a number, positive and finite"),
        ({"approach": -1.0}, "approach is -1.0 s; it must be a number, zero or positive and finite"),
        ({"limit": np.nan}, "limit is nan m"),
        ({"gain": "much"}, "gain is 'much'; it must be"),
        ({"rollouts": 0}, "rollouts is 0; it must be a whole number"),
        ({"start": [0.001, 0.0]}, r"start has shape \(2,\); it must be \(4,\), one change"),
        ({"start": [0.001, 0.0, 0.001, 0.0]}, "pull one tendon as far as its opposite gives"),
        ({"start": [-0.01, 0.0, 0.01, 0.0], "limit": 0.005}, "within the limits"),
        (
            {"rate_limit": 1e-3},
            r"tendon \d would move at 0.0\d+ m/s at .* s, beyond rate_limit 0.001 m/s; "
            r"give a slower path",
        ),
    ],
)
def test_what_cannot_be_planned_is_said(options: dict[str, Any], sentence: str) -> None:
    given: dict[str, Any] = {"target": LAP, "rate": RATE, **options}
    with pytest.raises(InputError, match=sentence):
        plan(PROTOTYPE, given.pop("target"), given.pop("rate"), **given)


def test_a_robot_without_displacements_is_refused() -> None:
    with pytest.raises(RobotError, match="an action needs tendons driven by length"):
        plan(with_segments(mode="tendon_tension"), LAP, RATE)
