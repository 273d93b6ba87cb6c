"""A step whose pass diverges finds the robot again; a robot without a shape is never handed out with one."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rods import bend, rod

from fastrod import Observer, Problem, Robot, Simulator, State, load_robot
from fastrod.contact import ContactScene, plane
from fastrod.errors import ProblemSentence
from fastrod.solver.recovery import pressed

N, ROWS, OTHERS = 4, np.array([1, 3]), np.array([0, 2])
REACHER = load_robot("five_segment_reacher")
LASH = {"name": "backlash", "half_width": 3e-4}, {"name": "gravity", "line_density": 0.02}
FAR = ContactScene(obstacles=[plane(point=(0, 0, -5.0), normal=(0, 0, 1), name="floor")], rod_radius=0.005)
FIELDS = ("position", "rotation", "tip_position", "tension", "base_wrench", "residual", "ok", "passes")


def jump(k: int) -> dict[str, Any]:
    """Small moves of all, until at the fourth step some robots bend in all segments and are pulled aside."""
    lengths = np.tile(REACHER.rest_tendon_length, (N, 1))
    force = np.zeros((N, 3))
    for i in range(N):
        angle = 0.02 * (k + 1) if k < 3 or i not in ROWS else (1.2 if i == 1 else -0.9)
        for s in range(5):
            lengths[i] += bend(REACHER, angle, 0.4 * angle, segment=s) - REACHER.rest_tendon_length
        force[i, 1] = 0.002 * k if k < 3 or i not in ROWS else 0.05
    return {"tendon_length": lengths, "tip_force": force}


CASES: dict[str, tuple[Robot, dict[str, Any]]] = {
    "plain": (REACHER, {}),
    "held gain": (REACHER, {"solver": Observer(kept_jacobian_tolerance=1e-4)}),
    "own observer": (REACHER, {"solver": Observer(process_noise=1e4)}),
    "tip only": (REACHER, {"outputs": "tip"}),
    "effects with memory": (replace(REACHER, effects=LASH), {}),
    "contact scene": (REACHER, {"contact": FAR}),
    "threads": (REACHER, {"threads": min(2, numba.config.NUMBA_NUM_THREADS)}),
}


def made(case: str, **more: Any) -> tuple[Simulator, Callable[[int], dict[str, Any]]]:
    """A simulator at home, and its inputs step by step; in a contact scene, which learns no gain of a tip
    force, only those that are to diverge get one."""
    robot, options = CASES[case]
    sim = Simulator(robot, N, dt=0.02, points_per_segment=6, **{"threads": 1, **options, **more})
    sim.settle(robot.rest_tendon_length)

    def inputs(k: int) -> dict[str, Any]:
        now = jump(k)
        return {**now, "tip_force": np.where(np.abs(now["tip_force"]) > 0.01, now["tip_force"], 0.0)}

    return sim, inputs if "contact" in options else jump


def driven(case: str, **more: Any) -> tuple[Simulator, State]:
    """A simulator at the step at which some passes diverge."""
    sim, inputs = made(case, **more)
    for k in range(4):
        state = sim.step(**inputs(k))
    return sim, state


@pytest.mark.study
@pytest.mark.parametrize("case", CASES)
def test_a_step_settles_the_robots_whose_pass_diverged_and_no_others(case: str) -> None:
    (sim, state), (bare, lost) = driven(case), driven(case, recover=False)
    assert_array_equal(np.flatnonzero(~lost.ok), ROWS)  # what one pass makes of it
    assert state.ok.all()
    assert not state.problems
    assert (state.residual[ROWS] <= 1e-9).all()
    assert (state.passes[ROWS] > lost.passes[OTHERS]).all()
    for name in FIELDS:
        if len(getattr(state, name)):
            assert_array_equal(getattr(state, name)[OTHERS], getattr(lost, name)[OTHERS])
    for one, other in zip(sim._chain.links, bare._chain.links, strict=True):
        assert_array_equal(one.memory, other.memory)  # a step of the effects, not two
    inputs = made(case)[1]
    if not sim._chain.links:
        fresh = Simulator(REACHER, N, points_per_segment=6, threads=1)
        assert_allclose(state.tip_position[ROWS], fresh.settle(**inputs(3)).tip_position[ROWS], atol=1e-7)
    after = sim.step(**inputs(3))
    assert after.ok.all()
    assert_allclose(after.tip_position[ROWS], state.tip_position[ROWS], atol=1e-6)  # it goes on from there


@pytest.mark.parametrize("case", ["plain", "effects with memory", "contact scene"])
def test_a_step_that_recovers_can_be_taken_back(case: str) -> None:
    sim, inputs = made(case)
    sim.step(**inputs(0))
    kept = sim.snapshot()
    once = [sim.step(**inputs(k)) for k in (3, 4)]
    sim.restore(kept)
    again = [sim.step(**inputs(k)) for k in (3, 4)]
    assert (once[0].passes[ROWS] > once[0].passes[OTHERS].max()).all()
    for one, other in zip(once, again, strict=True):
        for name in FIELDS:
            assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("derive", [False, True])
def test_the_jacobian_is_that_of_the_recovered_shape(derive: bool) -> None:
    sims = [Simulator(REACHER, points_per_segment=6, threads=1) for _ in range(2)]
    far = {name: a[1] for name, a in jump(3).items()}
    sims[0].settle(REACHER.rest_tendon_length)
    assert sims[0].step(**far, derive=derive).passes[0] > 2
    sims[1].settle(**far)
    assert_allclose(sims[0].jacobian(turning=True), sims[1].jacobian(turning=True), atol=1e-5)


def near(angle: float) -> dict[str, Any]:
    return {"tendon_length": bend(REACHER, angle, 0.0)}


@pytest.mark.parametrize("load", [(0.0, 3.0, -500.0), (0.0, -500.0, 0.0)])
@pytest.mark.parametrize("contact", [None, FAR], ids=["free", "contact scene"])
@pytest.mark.parametrize("call", ["step", "settle"])
def test_a_robot_without_a_shape_keeps_the_last_one(call: str, contact: Any, load: Any) -> None:
    sim = Simulator(REACHER, 2, points_per_segment=6, threads=1, contact=contact)
    before = sim.settle(**near(0.3))
    force = np.array([(0.0, 0.0, 0.0), load])
    state = getattr(sim, call)(**near(0.3), tip_force=force)
    assert state.ok.tolist() == [True, False]
    assert state.passes[1] == -1
    assert not state.residual[1] <= 1e-9
    assert (state.path_length < REACHER.length + 0.05).all()
    for name in ("position", "tip_position", "path_length", "base_wrench"):
        assert_array_equal(getattr(state, name)[1], getattr(before, name)[1])
    assert "give less load" in state.problems[1]
    assert "100 %" not in state.problems[1]
    after = [sim.step(**near(0.3)) for _ in range(3)][-1]
    assert after.ok.all()
    assert_allclose(after.tip_position[1], before.tip_position[1], atol=1e-6)


def test_a_robot_that_never_had_a_shape_has_none() -> None:
    sim = Simulator(REACHER, 2, points_per_segment=6, threads=1)
    force = np.array([(0.0, 0.0, 0.0), (0.0, -500.0, 0.0)])
    state = sim.step(**near(0.3), tip_force=force)
    assert np.isnan(state.position[1]).all()
    assert np.isfinite(state.position[0]).all()
    sim.settle(**near(0.3))
    stiffer = tuple(replace(s, torsional_stiffness=1e-3) for s in REACHER.segments)
    sim.replace([1], [replace(REACHER, segments=stiffer)])
    state = sim.settle(**near(0.3), tip_force=force, rows=[1])
    assert np.isnan(state.position[1]).all()  # the shape before was another robot's


def test_gravity_of_a_step_is_that_of_the_weight_and_the_payload() -> None:
    hung = {"name": "payload", "mass": 0.02}, {"name": "gravity", "line_density": 0.1}
    heavy = replace(rod(line_density=0.3), effects=hung)
    moon = (0.0, 1.62, 0.0)
    for robot in (heavy, replace(heavy, effects=())):
        given, own = Simulator(robot, 2), Simulator(replace(robot, gravity=moon), 2)
        lengths = bend(robot, 0.4, 0.1)
        samples = np.zeros((1, 5, 3)) + np.linspace(0.0, 0.1, 5)[:, None]
        for more in ({}, {"line_force": samples}, {"point_force": [(0.031, (0.0, 0.1, 0.0))]}):
            one, other = given.settle(lengths, gravity=moon, **more), own.settle(lengths, **more)
            assert_array_equal(one.position, other.position)
            assert_array_equal(given.jacobian(), own.jacobian())
        each = given.settle(lengths, gravity=[moon, (0.0, 0.0, -9.81)])
        earth = Simulator(robot, 2).settle(lengths).position
        assert_allclose(each.position, [own.settle(lengths).position[0], earth[1]], atol=1e-9)
        assert_allclose(given.settle(lengths).position, earth, atol=1e-9)  # its own again
        assert np.abs(each.position[0] - earth[0]).max() > 1e-5


def test_an_unmasked_masked_array_is_an_array() -> None:
    sim = Simulator(REACHER)
    assert sim.settle(np.ma.array(REACHER.rest_tendon_length)).ok.all()


def test_reprs_are_one_short_line() -> None:
    sim = Simulator(REACHER, 2, contact=FAR)
    state = sim.settle(REACHER.rest_tendon_length)
    said = "'five_segment_reacher', n_robots=2, dt=0.01 s, n_points=101, contact with floor"
    assert repr(sim) == f"Simulator({said})"
    assert repr(state).startswith("State(n_robots=2, n_points=101, ok=2 of 2, residual<=")
    tip = Simulator(REACHER, 2, outputs="tip")
    bad = tip.step(np.array([REACHER.rest_tendon_length, np.full(15, np.nan)]))
    assert len(repr(bad)) < 300
    assert "ok=1 of 2" in repr(bad)
    assert "robot 1" in repr(bad)


def pushed(load: float, call: str, contact: Any = None, **options: Any) -> tuple[Simulator, State]:
    """The prototype under a growing force along its axis [EI/l^2], by steps, or settled under all of it."""
    robot = load_robot("prototype")
    sim = Simulator(robot, contact=contact, threads=1, **options)
    force = np.array([0.0, 0.0, load * 0.0022 / 0.07**2])
    if call == "settle":
        return sim, sim.settle(robot.rest_tendon_length, tip_force=force)
    for k in range(1, 21):
        state = sim.step(robot.rest_tendon_length, tip_force=force * k / 20, derive=k == 20)
    return sim, state


@pytest.mark.study(beyond=3)
@pytest.mark.parametrize("load", [-100.0, -1111.0])
@pytest.mark.parametrize("options", [{}, {"outputs": "tip"}, {"recover": False}, {"contact": FAR}], ids=str)
@pytest.mark.parametrize("call", ["step", "settle"])
def test_a_straight_rod_pressed_beyond_buckling_is_not_ok(
    call: str, options: dict[str, Any], load: float
) -> None:
    sim, state = pushed(load, call, **options)
    assert not state.ok.any()
    assert state.passes[0] == -1
    assert "unstable" in state.problems[0]
    assert f"{abs(load):.3g} times what bends it" in state.problems[0]
    assert "give less load" in state.problems[0]
    assert "did not bring" not in state.problems[0]  # its residual is one of rounding
    assert state.problem_kinds == {0: Problem.OVERLOADED}
    assert np.isnan(sim.jacobian()).all()
    assert sim.step(sim.robots[0].rest_tendon_length).ok.all()


@pytest.mark.parametrize("load", [-20.0, 20.0, 100.0])
def test_steps_and_settle_agree_on_loads_along_the_axis(load: float) -> None:
    (_, stepped), (_, settled) = (pushed(load, call) for call in ("step", "settle"))
    assert stepped.ok.all()
    assert settled.ok.all()
    assert_allclose(stepped.tip_position, settled.tip_position, atol=1e-9)


def test_a_press_counts_as_far_as_the_rod_stands_straight() -> None:
    """The same force on the same robot: along the rod all of it, across it none, pulling none; what has
    buckled and lies folded beside its base is not pressed."""
    robot = load_robot("prototype")
    sim = Simulator(robot, threads=1)
    for k in range(1, 11):
        state = sim.step(robot.rest_tendon_length, tip_force=[0.0, 0.0, -2.0 * k / 10])
    ports, shape, rows = sim._ports, state.as_shape(), np.array([0])
    assert ports is not None
    straight = pressed(sim._params, ports, shape, rows)[0]
    assert straight == pytest.approx(2.0 * 0.07**2 / 0.0022, rel=1e-9)
    for force in ([2.0, 0.0, 0.0], [0.0, 0.0, 2.0]):
        assert pressed(sim._params, ports._replace(tip_force=np.array([force])), shape, rows)[0] < 1e-6
    folded = shape._replace(tip_position=np.array([[0.03, 0.0, 0.002]]))
    assert pressed(sim._params, ports, folded, rows)[0] < 0.05 * straight


def test_each_problem_has_a_kind() -> None:
    robot = load_robot("prototype")
    rest = robot.rest_tendon_length
    sim = Simulator(robot, 3, threads=1)
    state = sim.settle(rest, rows=[0])
    assert state.problem_kinds == {1: Problem.NEVER_SOLVED, 2: Problem.NEVER_SOLVED}
    force = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, -500.0, 0.0]])
    state = sim.settle(np.array([rest, np.full(4, np.nan), rest]), tip_force=force)
    assert state.problem_kinds == {1: Problem.BAD_INPUT, 2: Problem.OVERLOADED}
    assert all(isinstance(said, ProblemSentence) and len(said) > 20 for said in state.problems.values())
    kept = pickle.loads(pickle.dumps(dict(state.problems)))
    assert kept == state.problems
    assert {i: said.kind for i, said in kept.items()} == state.problem_kinds
    snapshot = sim.snapshot()
    assert sim.settle(rest).problem_kinds == {}
    sim.restore(snapshot, [1])
    assert sim.state.problem_kinds == {1: Problem.BAD_INPUT}


@pytest.mark.parametrize(
    "force", [(0.0, 3.0, -50.0), (0.0, -500.0, 0.0), (0.0, 0.0, 500.0), (0.0, 40.0, 0.0)]
)
def test_the_residual_of_a_lost_robot_is_that_of_its_whole_load(force: tuple[float, ...]) -> None:
    robot = load_robot("prototype")
    state = Simulator(robot, threads=1).settle(robot.rest_tendon_length, tip_force=force)
    assert not state.ok.any()
    below = "did not bring the boundary residual below" in state.problems[0]
    assert below == (not state.residual[0] <= 1e-9)
    assert f"residual {state.residual[0]:.3g} m" in state.problems[0]
