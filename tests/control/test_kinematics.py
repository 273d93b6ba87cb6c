"""The tip on a base: its Jacobian against differences of the settled tip, frames, closed loops, refusals."""

from typing import Any

import numpy as np
import pytest
from control.arms import DhArm
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals
from rods import rod
from scipy.spatial.transform import Rotation

import fastrod.solver.response
from fastrod import Robot, Simulator, load_robot
from fastrod.control import FixedBase, MovingBase, ResolvedRate, SoftTip
from fastrod.errors import InputError, RobotError

MOUNT = (0.01, -0.02, 0.03, np.cos(0.3), 0.0, np.sin(0.3), 0.0)
ROTATED = (0.3, 0.1, 0.5, 0.5, 0.5, -0.5, 0.5)
Q_ARM = [0.3, -1.2, 1.4, -0.9, -1.1, 0.4]
ACTION = [0.012, 0.004, -0.003, 0.02, -0.002, 0.005]
LOADS = {"tip_force": (0.05, -0.04, 0.06), "line_force": (0.1, 0.0, -0.1)}
BASES = [
    pytest.param(FixedBase(ROTATED), [], id="fixed"),
    pytest.param(MovingBase(ROTATED), [0.1, -0.2, 0.05], id="moving"),
    pytest.param(MovingBase(ROTATED, rotates=True), [0.1, -0.2, 0.05, 0.4, -0.8, 0.3], id="turning"),
    pytest.param(DhArm(), Q_ARM, id="arm"),
]


def two_segments(line_density: float = 0.15) -> Robot:
    segment = rod(length=0.1, extension=(0.0, 0.03), line_density=line_density).segments[0]
    return Robot(name="two", segments=(segment, segment))


def simulator(n_robots: int = 1, line_density: float = 0.15) -> Simulator:
    return Simulator(two_segments(line_density), n_robots=n_robots, points_per_segment=6, threads=1)


def soft_tip(base: Any, line_density: float = 0.15, **options: Any) -> SoftTip:
    return SoftTip(simulator(line_density=line_density), base, **options)


@pytest.mark.parametrize(("base", "q_base"), BASES)
def test_the_jacobian_is_that_of_the_settled_tip_under_weight_and_loads(base, q_base):
    tip = soft_tip(base, flange_from_base=MOUNT)
    q = np.array([*q_base, *ACTION])
    tip.place(q, settle=True, tolerance=1e-12, **LOADS)
    exact = tip.jacobian()
    # the error of central differences is of second order in the step: two of them take it off
    coarse, fine = (tip.finite_differences(q, step, tolerance=1e-13, **LOADS) for step in (2e-4, 1e-4))
    assert exact.shape == (3, tip.n_q)
    assert_allclose(exact, fine, atol=2e-3 * np.abs(fine).max())  # 1e-4 m bend a segment by 0.013
    assert_allclose(exact, (4.0 * fine - coarse) / 3.0, atol=1e-5 * np.abs(fine).max())


@pytest.mark.parametrize(("base", "q_base"), BASES[2:])
def test_without_loads_a_rotation_of_the_base_moves_the_tip_rigidly(base: Any, q_base: list[float]) -> None:
    tip = soft_tip(base, line_density=0.0)
    state = tip.place([*q_base, *ACTION], settle=True)
    J = tip.jacobian(rotation=True)[:, : len(q_base)]
    twist = base.jacobian(np.array(q_base))
    arm = state.tip_position[0] - base.frame(np.array(q_base))[:3]
    assert_allclose(J[:3], twist[:3] + np.cross(twist[3:].T, arm).T, atol=1e-8)  # J_v + J_w x (tip - base)
    assert_allclose(J[3:], twist[3:], atol=1e-7)


def test_rows_of_rotation_are_those_of_the_settled_tip() -> None:
    tip = soft_tip(MovingBase(ROTATED, rotates=True))
    q = np.array([0.1, -0.2, 0.05, 0.4, -0.8, 0.3, *ACTION])
    tip.place(q, settle=True, tolerance=1e-12)
    J = tip.jacobian(rotation=True)
    assert J.shape == (6, 12)
    for j in range(12):
        step = 1e-5 * np.eye(12)[j]
        states = [tip.place(end, settle=True, tolerance=1e-13) for end in (q + step, q - step)]
        end, start = (Rotation.from_matrix(state.tip_rotation[0]) for state in states)
        expected = (end * start.inv()).as_rotvec() / 2e-5
        assert_allclose(J[3:, j], expected, atol=1e-5 * np.abs(J[3:]).max())  # (1e-5 / 0.0075)^2 is 2e-6


def test_the_base_stands_where_frame_and_mount_say() -> None:
    tip = soft_tip(DhArm(), flange_from_base=MOUNT)
    state = tip.place([*Q_ARM, *ACTION])
    flange = DhArm().chain(np.array(Q_ARM))[-1]
    assert_allclose(state.position[0, 0], flange[:3, 3] + flange[:3, :3] @ MOUNT[:3], atol=1e-12)
    turned = Rotation.from_euler("y", 0.6).as_matrix()
    assert_allclose(state.rotation[0, 0], flange[:3, :3] @ turned, atol=1e-12)
    assert_array_equal(tip.position, state.tip_position[0])


def test_a_fixed_base_is_by_default_where_the_robot_says() -> None:
    tip = SoftTip(simulator(line_density=0.0))
    assert (tip.n_base, tip.n_q) == (0, 6)
    state = tip.place(ACTION, settle=True)
    alone = simulator(line_density=0.0).settle(**tip.actions.inputs(ACTION))
    assert_array_equal(state.tip_position, alone.tip_position)


def test_a_measured_base_is_used_in_the_place_of_its_frame() -> None:
    tip, other = soft_tip(DhArm(), flange_from_base=MOUNT), soft_tip(FixedBase(ROTATED))
    q = np.array([*Q_ARM, *ACTION])
    state = tip.place(q, base_pose=ROTATED, settle=True, **LOADS)
    expected = other.place(ACTION, settle=True, **LOADS)
    assert_array_equal(state.tip_position, expected.tip_position)
    assert_allclose(tip.jacobian()[:, 6:], other.jacobian(), atol=1e-9)
    assert tip.jacobian()[:, :6].shape == (3, 6)


def test_finite_differences_leave_the_simulator_as_it_was() -> None:
    tip, twin = (soft_tip(MovingBase(ROTATED)) for _ in range(2))
    q = np.array([0.0, 0.0, 0.0, *ACTION])
    for each in (tip, twin):
        each.place(q, settle=True)
        each.place(q + 1e-4)
    before = tip.position
    tip.finite_differences(q)
    assert_array_equal(tip.position, before)
    assert_array_equal(tip.place(q + 2e-4).tip_position, twin.place(q + 2e-4).tip_position)
    assert_array_equal(tip.jacobian(), twin.jacobian())


def test_limits_are_the_range_of_extension_and_the_largest_bend() -> None:
    lower, upper = soft_tip(FixedBase()).limits(0.8)
    assert_allclose(upper, [0.03, 0.006, 0.006, 0.03, 0.006, 0.006], rtol=1e-12)
    assert_allclose(lower, [0.0, -0.006, -0.006, 0.0, -0.006, -0.006], rtol=1e-12)
    tip = soft_tip(FixedBase(), line_density=0.0)
    state = tip.place([0.0, tip.limits(0.8)[1][1], 0.0, 0.0, 0.0, 0.0], settle=True)
    assert np.arccos(state.tip_rotation[0, 2, 2]) == pytest.approx(0.8, abs=1e-3)


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize(("base", "q_base"), BASES)
def test_the_loop_closes_on_a_point_that_can_be_reached(base: Any, q_base: list[float]) -> None:
    tip = soft_tip(base)
    low, high = tip.limits()
    n = len(q_base)
    load = {"tip_force": (0.03, 0.0, 0.0)}
    goal = tip.place(np.array([*q_base, *ACTION]) + 0.3e-2, settle=True, **load).tip_position[0]
    q = np.array([*q_base, 0.01, 0.002, 0.0, 0.01, -0.001, 0.001])
    tip.place(q, settle=True, **load)
    limits = {"lower": [-7.0] * n + low.tolist(), "upper": [7.0] * n + high.tolist(), "error_limit": 0.02}
    costs = {"weight": [1.0] * n + [25.0] * 6, "rate": [1.0] * n + [0.05] * 6}
    control = ResolvedRate(gain=5.0, damping=1e-3, **costs, **limits)
    for _ in range(400):
        q = q + 0.01 * control.rates(q, tip.jacobian(), goal - tip.position, np.zeros(3), 0.01)
        tip.place(q, **load)
        assert (q[n:] >= low - 1e-15).all()
        assert (q[n:] <= high + 1e-15).all()
    assert np.linalg.norm(goal - tip.position) < 1e-6
    assert np.linalg.norm(goal - tip.place(q, settle=True, **load).tip_position[0]) < 1e-6


def test_moving_in_the_null_space_leaves_the_tip() -> None:
    tip = soft_tip(DhArm())
    q = np.array([*Q_ARM, *ACTION])
    start = tip.place(q, settle=True).tip_position[0]
    away = 0.1 * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0, *[0.0] * 6])
    control = ResolvedRate(damping=0.0, posture=q + away)
    moved = []
    for step in (1e-2, 5e-3):
        rates = control.rates(q, tip.jacobian(), np.zeros(3), np.zeros(3), 1.0)
        moved.append(np.linalg.norm(tip.place(q + step * rates, settle=True).tip_position[0] - start))
        tip.place(q, settle=True)
    assert np.abs(rates[:6]).max() > 1e-2
    assert moved[0] < 1e-5  # of second order in the step
    assert moved[1] == pytest.approx(moved[0] / 4.0, rel=0.1)


BAD_INPUT = {
    r"^simulator is Simulator\(.*\); give a Simulator of one robot\.$": lambda: SoftTip(simulator(2)),
    r"^FixedBase\.pose has shape \(3,\); it must be \(7,\), position \[m\] and ": lambda: FixedBase(
        (0.0, 0.0, 0.0)
    ),
    r"^MovingBase\.pose has a quaternion of norm 2; it must be 1, as w x y z\.$": lambda: MovingBase(
        (0, 0, 0, 2, 0, 0, 0)
    ),
    r"^flange_from_base holds a value that is not finite: \[nan.*\]\.$": lambda: soft_tip(
        FixedBase(), flange_from_base=[np.nan] * 7
    ),
    (
        r"^q has shape \(6,\); it must be \(9,\), 3 of the base, then extension and "
        r"two displacements for each of 2 segments \[m\]\.$"
    ): lambda: soft_tip(MovingBase()).place([0.0] * 6),
    r"^q holds a value that is not finite: \[nan.*\]\.$": lambda: soft_tip(FixedBase()).place([np.nan] * 6),
    r"^q is not an array of numbers; give \(6,\), 0 of the base": lambda: soft_tip(FixedBase()).place("here"),
    r"^base_pose has shape \(1,\); it must be \(7,\), position": lambda: soft_tip(FixedBase()).place(
        ACTION, base_pose=[0.0]
    ),
    r"^position needs a placed robot; call place first\.$": lambda: soft_tip(FixedBase()).position,
    r"^jacobian needs a placed robot; call place first\.$": lambda: soft_tip(FixedBase()).jacobian(),
    r"^largest_bend is 0\.0 rad; it must be a number, positive and finite\.$": lambda: soft_tip(
        FixedBase()
    ).limits(0.0),
    r"^step is -1\.0; it must be a number, positive and finite\.$": lambda: soft_tip(
        FixedBase()
    ).finite_differences(ACTION, -1.0),
}
NO_ROBOT = {
    r"^segment 1 of robot .* is passive; an action needs tendons driven by length\.$": lambda: SoftTip(
        Simulator(rod("passive"))
    )
}


@refusals({InputError: BAD_INPUT, RobotError: NO_ROBOT})
def test_refusals(error: type[Exception], sentence: str, call: Any) -> None:
    with pytest.raises(error, match=sentence):
        call()


def test_a_robot_of_one_segment_has_three_coordinates() -> None:
    assert SoftTip(Simulator(load_robot("prototype"))).n_q == 3


def test_steps_that_extend_keep_up_with_the_rod() -> None:
    tip = soft_tip(FixedBase())
    q = np.array([0.0, 0.004, -0.003, 0.0, -0.002, 0.005])
    tip.place(q, settle=True)
    for _ in range(50):
        q[[0, 3]] += 5e-4
        state = tip.place(q)
        assert state.ok[0]
        # a moment counts as its length; pulling at every tendon loses the robot here
        assert state.residual[0] < 3e-3
    stepped = tip.place(q).tip_position[0]
    assert_allclose(stepped, tip.place(q, settle=True).tip_position[0], atol=2e-5)


@pytest.mark.parametrize("rows", [1024, 3], ids=["at once", "one input after another"])
@pytest.mark.parametrize("loaded", [False, True])
def test_many_robots_have_the_jacobians_of_one(rows, loaded, monkeypatch):
    monkeypatch.setattr(fastrod.solver.response, "_ROWS", rows)
    n, many, one = 9, simulator(9), simulator()
    change = np.random.default_rng(1).uniform(0.0, 3e-3, (n, 6))
    actions = SoftTip(one).actions.inputs(0.5 * np.array(ACTION) + change)
    force = np.random.default_rng(2).uniform(-0.1, 0.1, (n, 3))
    many.settle(**actions, tip_force=force, point_force=[(0.13, force)] if loaded else None)
    got = many.jacobian(turning=True)
    assert got.shape == (n, 6, 8 + 2 + 3)
    for i in range(n):
        load = {"point_force": [(0.13, force[i])]} if loaded else {}
        one.settle(**{name: a[i] for name, a in actions.items()}, tip_force=force[i], **load)
        assert_allclose(got[i], one.jacobian(turning=True)[0], atol=1e-7)
        assert_array_equal(many.jacobian()[i], got[i, :, :10])


def test_a_robot_that_was_never_solved_has_no_jacobian() -> None:
    sim = simulator(2)
    lengths = np.array([two_segments().rest_tendon_length] * 2)
    lengths[1, 0] = np.nan
    sim.settle(lengths)
    assert np.isfinite(sim.jacobian(turning=True)).all((1, 2)).tolist() == [True, False]


def test_who_misses_a_step_goes_on_from_the_extension_it_had() -> None:
    two, one = simulator(2), simulator()
    actions = SoftTip(one).actions
    for t in range(8):
        inputs = actions.inputs(np.array(ACTION) * [1.0 - 0.05 * t, 1.0, 1.0, 1.0, 1.0, 1.0])
        lengths = np.array([inputs["tendon_length"]] * 2)
        lengths[1, 0] = np.nan if t in (3, 4) else lengths[1, 0]
        got = two.step(lengths, extension=inputs["extension"])
        if t not in (3, 4):
            alone = one.step(**inputs)
            assert_array_equal(got.tip_position[1], alone.tip_position[0])
            assert got.ok.all()


def test_finite_differences_stay_within_the_range_of_an_extension():
    # the prototype cannot extend: no column to compare; a segment at the end of its range is differenced to
    # one side
    fixed = SoftTip(Simulator(load_robot("prototype"), points_per_segment=6), MovingBase())
    q = [0.0, 0.0, 0.0, 0.0, 0.002, -0.001]
    fixed.place(q, settle=True)
    columns = [0, 1, 2, 4, 5]
    differences = fixed.finite_differences(q)
    assert_allclose(differences[:, columns], fixed.jacobian()[:, columns], rtol=1e-3, atol=1e-4)
    assert_array_equal(differences[:, 3], 0.0)
    reacher = load_robot("five_segment_reacher")
    tip = SoftTip(Simulator(reacher, points_per_segment=6))
    q = np.zeros(tip.n_q)
    q[1::3] = 0.002
    tip.place(q, settle=True)
    last = tip.finite_differences(q, step=1e-5)[:, -3]
    assert_allclose(last, tip.jacobian()[:, -3], rtol=1e-3, atol=1e-3)
