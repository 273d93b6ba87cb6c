"""The slow twins against the truth files, against each other and against closed forms."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rods import rod
from truthfiles import numbers, rows

from fastrod.errors import InputError
from fastrod.model.robot import Mode, Robot, Segment
from fastrod.model.robotfile import load_robot
from fastrod.reference import constant_curvature, shoot, solve_bvp

EI, LENGTH = 0.0022, 0.07
LOADS: dict[str, Any] = {
    "tip_force": (0.1, 0.2, -0.1),
    "point_force": [(0.03, (0.3, 0.0, 0.0))],
    "follower_tip_force": (0.1, 0.0, 0.2),
}

# The truth files hold 1e-12 m; the integrator's rtol of 1e-9 over a rod of 0.1 to 0.4 m leaves 1e-11 m of
# each.
TIP = 1e-9


def rotation(row: dict[str, str], letter: str) -> np.ndarray:
    return numbers(row, *[f"{letter}{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]).reshape(3, 3)


def one_segment(row: dict[str, str]) -> tuple[Robot, dict[str, Any]]:
    """Robot and inputs of a row of tendon_length_truth.csv."""
    n, length, stiffness = int(row["n"]), float(row["l"]), (float(row["EI"]),) * 2
    tendons = {"n_tendons": n, "offset": float(row["offset"]), "compliance": float(row["c"])}
    material = {"bending_stiffness": stiffness, "torsional_stiffness": float(row["GJ"])}
    inputs = {
        "tendon_length": numbers(row, *[f"L{i + 1}" for i in range(n)]),
        "tip_force": numbers(row, "Fx", "Fy", "Fz"),
        "line_force": numbers(row, "fx", "fy", "fz"),
    }
    return rod(length=length, **tendons, **material), inputs


def in_mode(robot: Robot, mode: Mode) -> Robot:
    return replace(robot, segments=tuple(replace(segment, mode=mode) for segment in robot.segments))


def with_tendons(robot: Robot, **change: Any) -> Robot:
    tendons = [tuple(replace(tendon, **change) for tendon in one.tendons) for one in robot.segments]
    segments = [replace(one, tendons=own) for one, own in zip(robot.segments, tendons, strict=True)]
    return replace(robot, segments=tuple(segments))


def cantilever(**change: Any) -> Robot:
    return replace(rod("passive", **change), gravity=(0.0, 0.0, -9.81))


def prototype(*pulled: float) -> tuple[Robot, np.ndarray]:
    robot = load_robot("prototype")
    return robot, robot.rest_tendon_length + np.array(pulled or (-0.004, -0.002, 0.004, 0.002))


@pytest.mark.study
@pytest.mark.parametrize("case", [0, 1, 3, 11, 12, 16, 22, 28])
def test_shoot_is_the_truth_in_tendon_length(case: int) -> None:
    row = rows("tendon_length_truth.csv")[case]
    robot, inputs = one_segment(row)
    shape = shoot(robot, **inputs)
    assert shape.success, shape.message
    assert_allclose(shape.tip_position, numbers(row, "tip_x", "tip_y", "tip_z"), rtol=0, atol=TIP)
    assert_allclose(shape.tip_rotation, rotation(row, "R"), rtol=0, atol=TIP / LENGTH)
    # curvature is a rotation over a length, tension a moment over an offset
    assert_allclose(shape.curvature[0], numbers(row, "u0x", "u0y", "u0z"), rtol=0, atol=1e-7)
    tension = numbers(row, *[f"T{i + 1}" for i in range(robot.n_tendons)])
    assert_allclose(shape.tension, tension, rtol=0, atol=1e-7)


@pytest.mark.study(beyond=2)
@pytest.mark.parametrize("case", ["A01", "A07", "A09", "A15", "A23", "B25", "B29", "B33", "B35"])
@pytest.mark.parametrize("mode", ["tendon_tension", "tendon_length"])
def test_shoot_is_the_truth_on_a_chain(case: str, mode: Mode) -> None:
    row = next(row for row in rows("tdcr_cases.csv") if row["case"] == case)
    robot = in_mode(load_robot(f"tdcr_{row['robot'].lower()}"), mode)
    tension, length = (numbers(row, *[f"{name}{i}" for i in range(1, 7)]) for name in ("q", "kir_len"))
    compliance = np.array([tendon.compliance for tendon in robot.tendons])
    loads = {"tip_force": numbers(row, "fx", "fy", "fz"), "tip_moment": numbers(row, "mx", "my", "mz")}
    pulled, set_to = {"tension": tension}, {"tendon_length": length - compliance * tension}
    shape = shoot(robot, **(pulled if mode == "tendon_tension" else set_to), **loads)
    assert shape.success, shape.message
    assert_allclose(shape.tip_position, numbers(row, "kir_px", "kir_py", "kir_pz"), rtol=0, atol=TIP)
    assert_allclose(shape.tip_rotation, rotation(row, "kir_r"), rtol=0, atol=1e-8)
    assert_allclose(shape.curvature[0], numbers(row, "kir_u0x", "kir_u0y", "kir_u0z"), rtol=0, atol=1e-8)
    assert_allclose(shape.tendon_length, length, rtol=0, atol=TIP)
    assert_allclose(shape.tension, tension, rtol=0, atol=TIP / compliance.min())


@pytest.mark.study
def test_shoot_is_the_truth_in_passive_mode() -> None:
    for row in rows("appJ_truth.csv")[::4]:
        shape = shoot(cantilever(), tip_force=(0.0, float(row["Fy_N"]), 0.0))
        assert_allclose(shape.tip_position[1:], numbers(row, "tip_y_m", "tip_z_m"), rtol=0, atol=TIP)
        assert shape.curvature[0, 0] == pytest.approx(float(row["u0x_1_per_m"]), abs=1e-8)


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("case", [0, 36, 72])
@pytest.mark.parametrize("method", ["lm", "slsqp", "trust-constr"])
def test_shoot_is_the_truth_in_paper_mode(case: int, method: Any) -> None:
    row = rows("appB_truth.csv")[case]
    robot = in_mode(with_tendons(load_robot("prototype"), offset=0.01), "paper")
    loads = {"tip_force": numbers(row, "Fx", "Fy", "Fz"), "line_force": numbers(row, "fx", "fy", "fz")}
    shape = shoot(robot, numbers(row, "L1", "L2", "L3", "L4"), **loads, method=method)
    assert_allclose(shape.tip_position, numbers(row, "tip_x", "tip_y", "tip_z"), rtol=0, atol=TIP)
    assert_allclose(shape.curvature[0], numbers(row, "u0x", "u0y", "u0z"), rtol=0, atol=1e-7)
    assert_allclose(shape.curvature[-1], numbers(row, "uLx", "uLy", "uLz"), rtol=0, atol=1e-7)
    assert_allclose(shape.tension, 0.0, rtol=0, atol=0)


# w/L of a cantilever under P L^2 / EI, elliptic integrals
@pytest.mark.study(beyond=1)
@pytest.mark.parametrize(
    ("load", "deflection"),
    [(1.0, 0.301720773800), (2.0, 0.493457480397), (5.0, 0.713791523612), (10.0, 0.810609024880)],
)
@pytest.mark.parametrize("method", ["lm", "slsqp", "trust-constr"])
def test_elastica(load: float, deflection: float, method: Any) -> None:
    shape = shoot(cantilever(), tip_force=(load * EI / LENGTH**2, 0.0, 0.0), method=method)
    assert shape.success, shape.message
    assert shape.tip_position[0] / LENGTH == pytest.approx(deflection, abs=1e-8)


@pytest.mark.study
def test_methods_and_integrators_agree() -> None:
    robot, length = prototype()
    best = shoot(robot, length, **LOADS)
    for name, others, tolerance in (
        ("method", ("slsqp", "trust-constr"), 3e-9),  # each stops below 1e-9 m at the boundary
        ("integrator", ("RK45", "LSODA"), 1e-8),  # lower orders at the same rtol: more local errors add up
    ):
        for value in others:
            other = shoot(robot, length, **LOADS, **{name: value})
            assert other.success, other.message
            assert_allclose(other.position, best.position, rtol=0, atol=tolerance)


@pytest.mark.study
def test_collocation_agrees_with_shooting() -> None:
    robot, length = prototype()
    line = [[(0.0, 0.0, 0.0), (0.0, 2.0, 0.0), (1.0, 0.0, 0.0)]]
    loads = LOADS | {"tip_moment": (0.001, 0.0, 0.0005), "line_force": line}
    one, two = shoot(robot, length, **loads), solve_bvp(robot, length, **loads)
    assert one.success
    assert two.success, two.message
    # slopes to 1e-8 relative, over 0.07 m
    assert_allclose(two.position, one.position, rtol=0, atol=1e-9)
    assert_allclose(two.curvature, one.curvature, rtol=0, atol=1e-6)
    assert_allclose(two.tension, one.tension, rtol=0, atol=1e-6)


@pytest.mark.study
def test_collocation_agrees_with_shooting_on_a_chain() -> None:
    row = next(row for row in rows("tdcr_cases.csv") if row["case"] == "B33")
    robot = load_robot("tdcr_b")
    path, tension = (numbers(row, *[f"{name}{i}" for i in range(1, 7)]) for name in ("kir_len", "q"))
    shape = solve_bvp(robot, path - 1e-5 * tension, tip_force=numbers(row, "fx", "fy", "fz"))
    assert shape.success, shape.message
    assert_allclose(shape.tip_position, numbers(row, "kir_px", "kir_py", "kir_pz"), rtol=0, atol=1e-8)
    passive, shot = (solve(cantilever(), tip_force=(0.7, 0.0, 0.0)) for solve in (solve_bvp, shoot))
    assert_allclose(passive.position, shot.position, rtol=0, atol=1e-9)


def test_constant_curvature_is_an_arc() -> None:
    """An arc of angle a toward d1: l_i = l - a offset cos b_i; tip at l/a (1 - cos a, 0, sin a)."""
    angle = 1.2
    robot, length = prototype(*(-angle * 0.0075 * np.cos(np.arange(4) * np.pi / 2.0)))
    shape = constant_curvature(robot, length)
    # angles in the robot file are rounded to 1e-12 rad
    tip = LENGTH / angle * np.array([1.0 - np.cos(angle), 0.0, np.sin(angle)])
    assert_allclose(shape.tip_position, tip, rtol=0, atol=1e-12)
    assert_allclose(shape.tendon_length, length, rtol=0, atol=1e-13)
    assert shape.residual < 1e-12
    assert np.isnan(shape.tension).all()
    # without loads and stretch the mechanics have nothing to add: 1e-10 m/N under 2 N over an offset of
    # 0.0075 m
    rod = shoot(with_tendons(robot, compliance=1e-10), length)
    assert_allclose(shape.position, rod.position, rtol=0, atol=1e-8)


def test_constant_curvature_takes_off_what_distal_tendons_use() -> None:
    robot = load_robot("tdcr_b")
    first, second = np.array([4.0, -2.0]), np.array([-3.0, 5.0])
    length = robot.rest_tendon_length.copy()
    for t, (tendon, k) in enumerate(zip(robot.tendons, robot.tendon_segment, strict=True)):
        for (x, y), u in zip(tendon.position(k + 1), (first, second), strict=False):
            length[t] += 0.1 * (np.array([y, -x]) @ u)
    shape = constant_curvature(robot, length)
    assert_allclose(shape.curvature[5, :2], first, rtol=0, atol=1e-9)
    assert_allclose(shape.curvature[-1, :2], second, rtol=0, atol=1e-9)


@pytest.mark.study
def test_the_base_pose_carries_the_whole_robot_along() -> None:
    robot, length = prototype()
    half = np.sqrt(0.5)
    rotated = replace(robot, base_position=(0.1, 0.2, 0.3), base_quaternion=(half, half, 0.0, 0.0))
    x_rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    force = np.array([0.1, 0.2, -0.1])
    here, there = shoot(robot, length, tip_force=force), shoot(rotated, length, tip_force=x_rotation @ force)
    assert_allclose(there.position, here.position @ x_rotation.T + [0.1, 0.2, 0.3], rtol=0, atol=TIP)
    assert_allclose(there.tip_rotation, x_rotation @ here.tip_rotation, rtol=0, atol=1e-8)


def test_self_weight_is_a_line_force() -> None:
    heavy, light = cantilever(line_density=0.05), cantilever()
    tilted = {"base_quaternion": (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)}
    weight = shoot(replace(heavy, **tilted))
    force = shoot(replace(light, **tilted), line_force=(0.0, 0.0, -0.05 * 9.81))
    assert_allclose(weight.position, force.position, rtol=0, atol=1e-14)


@pytest.mark.study
def test_many_point_forces_are_a_line_force() -> None:
    n = 40
    points = [((k + 0.5) * LENGTH / n, np.array([0.0, 2.0, 0.0]) * LENGTH / n) for k in range(n)]
    lumped, spread = shoot(cantilever(), point_force=points), shoot(cantilever(), line_force=(0.0, 2.0, 0.0))
    # the midpoint rule's (1/n)^2 / 24 of a 1e-2 rad bend, on 0.07 m
    assert_allclose(lumped.position, spread.position, rtol=0, atol=1e-6)


@pytest.mark.study
def test_a_follower_force_rotates_with_the_tip() -> None:
    follower = np.array([0.2, 0.1, -0.1])
    robot, length = prototype()
    shape = shoot(robot, length, follower_tip_force=follower)
    dead = shoot(robot, length, tip_force=shape.tip_rotation @ follower)
    assert_allclose(shape.position, dead.position, rtol=0, atol=1e-8)


@pytest.mark.study
def test_extension_is_a_longer_segment() -> None:
    robot = cantilever(extension=(0.0, 0.02))
    shape = shoot(robot, extension=[0.01], tip_force=(0.3, 0.0, 0.0))
    longer = shoot(cantilever(length=0.08), tip_force=(0.3, 0.0, 0.0))
    assert_allclose(shape.position, longer.position, rtol=0, atol=1e-14)


@pytest.mark.study
def test_a_slack_tendon_pulls_no_more() -> None:
    robot = with_tendons(load_robot("prototype"), unilateral=True)
    length = robot.rest_tendon_length + np.array([-0.004, 0.0, 0.006, 0.0])
    shape = shoot(robot, length, tip_force=(0.0, 0.05, 0.0))
    assert shape.success, shape.message
    slack = shape.tension == 0.0
    assert slack[2]
    assert not slack[0]
    assert (shape.tension >= 0.0).all()
    # a slack tendon is longer than its path; a taut one is stretched by its tension
    assert (shape.tendon_length[slack] <= length[slack]).all()
    assert_allclose((shape.tendon_length - length - 1e-5 * shape.tension)[~slack], 0.0, rtol=0, atol=TIP)


@pytest.mark.study
def test_a_mixed_chain_with_a_passive_end() -> None:
    first = load_robot("prototype").segments[0]
    tail = Segment(length=0.05, bending_stiffness=(EI, EI), torsional_stiffness=0.001, mode="passive")
    robot = Robot(name="mixed", segments=(first, replace(first, mode="tendon_tension"), tail))
    length, tension = np.full(8, np.nan), np.full(8, np.nan)
    length[:4], tension[4:] = [0.067, 0.071, 0.073, 0.069], [0.4, 0.1, 0.0, 0.2]
    inputs: dict[str, Any] = {"tendon_length": length, "tension": tension, "tip_force": (0.02, 0.05, -0.03)}
    one, two = shoot(robot, **inputs), solve_bvp(robot, **inputs)
    assert one.success
    assert two.success, two.message
    assert_allclose(one.tension[4:], tension[4:], rtol=0, atol=0)
    assert_allclose(two.position, one.position, rtol=0, atol=1e-8)
    # the end is free of moments, so the last curvature is the rod's own
    assert_allclose(one.curvature[-1], 0.0, rtol=0, atol=1e-6)


@pytest.mark.study
def test_a_guess_saves_passes() -> None:
    robot, length = prototype()
    cold = shoot(robot, length, tip_force=(0.1, 0.2, -0.1))
    warm = shoot(robot, length, tip_force=(0.1, 0.2, -0.11), guess=cold)
    assert warm.success
    assert warm.evaluations < cold.evaluations


LENGTHS = {"tendon_length": [0.07] * 4}


@pytest.mark.parametrize(
    ("inputs", "sentence"),
    [
        ({}, "tendon_length is missing"),
        ({"tendon_length": [0.07] * 3}, "tendon_length has shape"),
        ({"tendon_length": [70.0] * 4}, "In mm"),
        ({"tendon_length": [0.07, 0.07, 0.07, np.nan]}, "finite"),
        (LENGTHS | {"tip_force": [0.0, 1.0]}, "tip_force has shape"),
        (LENGTHS | {"line_force": np.zeros((2, 5, 3))}, "line_force has shape"),
        (LENGTHS | {"point_force": [(0.2, (0.0, 0.0, 1.0))]}, "backbone runs from"),
        (LENGTHS | {"point_force": [(0.02, (0.0, 1.0))]}, "point_force has shape"),
        (LENGTHS | {"extension": [0.01]}, "its range is"),
        (LENGTHS | {"extension": [0.0, 0.0]}, "extension has shape"),
        (LENGTHS | {"method": "slsp"}, "did you mean 'slsqp'"),
        (LENGTHS | {"integrator": "RK54"}, "did you mean 'RK45'"),
        (LENGTHS | {"tip_force": "up"}, "tip_force is not an array of numbers"),
    ],
)
def test_wrong_inputs_are_reported(inputs: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        shoot(load_robot("prototype"), **inputs)


def test_collocation_refuses_paper_mode() -> None:
    with pytest.raises(InputError, match="use shoot"):
        solve_bvp(in_mode(load_robot("prototype"), "paper"), [0.07] * 4)
