"""Robots of a batch held, put back, settled or replaced one by one: exact, and nothing to the others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from contact.robots import bent, prototype
from numpy.testing import assert_allclose, assert_array_equal
from rods import bend, rod

from fastrod import Observer, Robot, Simulator, State, load_robot
from fastrod.contact import ContactScene, plane
from fastrod.errors import InputError, RobotError
from fastrod.model.segment_actions import SegmentActions

N, ROWS, OTHERS = 5, np.array([1, 3]), np.array([0, 2, 4])
FIELDS = "position rotation curvature tip_position tip_rotation tension base_wrench residual ok passes"
MOTION = "velocity strain kinetic_energy strain_energy"
Inputs = dict[str, Any]
Step = Callable[[int], Inputs]


def reacher() -> tuple[Robot, Callable[[float], Inputs]]:
    """The five-segment reacher on a slow path of some 10 mm/s, as a function of time [s]."""
    robot = load_robot("five_segment_reacher")
    matrix = SegmentActions(robot).matrix

    def at(t: float) -> Inputs:
        q = 0.008 * np.sin(0.7 * t + np.arange(15)) * 0.5 * (1.0 - np.cos(0.5 * t))
        q[::3] = 0.0
        q[12] = 0.01 * (1.0 - np.cos(t))
        change = matrix @ q
        return {"tendon_length": robot.rest_tendon_length + change[:15], "extension": change[15:]}

    return robot, at


def keeping(robot: Robot, *tolerances: float) -> list[Simulator]:
    options = {"dt": 0.05, "points_per_segment": 2, "threads": 1}
    return [Simulator(robot, **options, solver=Observer(kept_jacobian_tolerance=h)) for h in tolerances]


def test_a_held_gain_follows_a_slow_robot_as_closely_as_a_fresh_one() -> None:
    robot, at = reacher()
    fresh, held, still = keeping(robot, 0.0, 5e-5, 0.0)
    fresh.settle(**at(0.0))
    held.settle(**at(0.0))
    errors, residuals = [], []
    for k in range(1, 80):
        now = at(0.05 * k)
        exact = still.settle(**now, tolerance=1e-12).tip_position[0]
        states = [sim.step(**now) for sim in (fresh, held)]
        errors.append([np.linalg.norm(state.tip_position[0] - exact) for state in states])
        residuals.append(states[1].residual[0])
    lag = np.max(errors, axis=0)
    assert lag[0] > 1e-6  # it moves: one pass a step lags
    assert lag[1] < 1.5 * lag[0]
    assert lag[1] < 1e-4 * robot.length
    assert max(residuals) < 5e-5  # so that it was held all the way


def test_held_steps_come_to_rest_where_settle_does() -> None:
    robot, at = reacher()
    sim, still = keeping(robot, 5e-5, 0.0)
    sim.settle(**at(0.0))
    for k in range(1, 60):
        sim.step(**at(0.05 * k))
    exact = still.settle(**at(3.0), tolerance=1e-12)
    errors = [float(np.abs(sim.step(**at(3.0)).tip_position - exact.tip_position).max()) for _ in range(10)]
    assert errors[-1] < 1e-9
    assert all(later < 0.5 * before for before, later in pairwise(errors[:5]))  # linearly, not at once


def test_a_gain_is_held_only_below_the_residual_that_is_allowed() -> None:
    robot, at = reacher()
    tips = []
    for sim in keeping(robot, 0.0, 1e-30, 1e-3):
        sim.settle(**at(0.0))
        tips.append([sim.step(**at(0.2 * k)).tip_position[0] for k in range(1, 20)])
    assert_array_equal(tips[1], tips[0])
    assert np.abs(np.array(tips[2]) - tips[0]).max() > 0.0


def backlash() -> Robot:
    heavy = rod(line_density=0.1, damping_time=1e-3)
    return replace(heavy, effects=({"name": "backlash", "half_width": 3e-4},))


def wiggled(robot: Robot, seed: int = 3) -> Step:
    """Tendon lengths (N, n_tendons) of a walk of its own for each of N robots."""
    walk = np.cumsum(0.06 * np.random.default_rng(seed).normal(size=(40, N, 2)), axis=0)
    return lambda k: {"tendon_length": np.array([bend(robot, *angles) for angles in walk[k]])}


def loaded(step: Step) -> Step:
    """With a tip force on every robot that begins to move at step 4."""
    push = [[0.0, 0.02, 0.01], [0.02, 0.0, 0.0], [0.01, 0.01, 0.0], [-0.02, 0.0, 0.01], [0.0, 0.0, 0.02]]
    return lambda k: {**step(k), "tip_force": np.multiply(push, max(k - 3, 0))}


def walled() -> Step:
    """Bends that press some robots on a wall at x = 12 mm, and leave others free."""
    toward = np.array([12.0, 14.0, -8.0, 13.0, 3.0])
    return lambda k: {"tendon_length": bent(toward * np.sin(0.2 * k), 2.0 * np.cos(0.3 * k) * np.ones(N))}


def carried() -> Step:
    """Bends, tip forces and bases that move, each robot's its own."""
    i = np.arange(N)

    def at(k: int) -> Inputs:
        t, angles = 0.002 * k, 0.5 * np.sin(np.outer((20.0, 33.0), np.full(N, 0.002 * k)) + i)
        base = [0.002 * np.sin(50.0 * t + i), 0.0 * i, 0.1 * i, 1.0 + 0.0 * i, *np.zeros((3, N))]
        force = 0.05 * np.sin(40.0 * t + i[:, None] + np.arange(3))
        lengths = np.array([bend(rod(), *a) for a in angles.T])
        return {"tendon_length": lengths, "tip_force": force, "base_pose": np.column_stack(base)}

    return at


WALL = ContactScene(
    obstacles=[plane(point=(0.012, 0, 0), normal=(-1, 0, 0), name="wall", friction=0.2)], rod_radius=0.0
)
MODAL: dict[str, Inputs] = {"in motion": {"dynamics": True, "dt": 2e-3}, "at rest": {"solver": "modal"}}
CASES: dict[str, tuple[Robot, Step, Inputs]] = {
    "plain": (rod(), wiggled(rod()), {}),
    "held": (rod(), wiggled(rod()), {"solver": Observer(kept_jacobian_tolerance=1e-3)}),
    "effect with memory": (backlash(), wiggled(rod()), {}),
    "contact": (prototype(1e-5), walled(), {"contact": WALL}),
    **{name: (backlash(), carried(), {"points_per_segment": 5} | how) for name, how in MODAL.items()},
}


def simulator(robot: Robot | list[Robot], **options: Any) -> Simulator:
    return Simulator(robot, N, **{"dt": 0.02, "points_per_segment": 8, "threads": 1} | options)


def made(case: str) -> tuple[Simulator, Inputs, Step]:
    """A simulator at home, its inputs there, and what it is commanded after."""
    robot, step, options = CASES[case]
    home = step(0) if case in MODAL else {"tendon_length": bend(robot, 0.1, -0.05)}
    sim = simulator(robot, **options)
    assert sim.settle(**home).ok.all()
    return sim, home, step


def same(one: State, other: State, rows: Any = slice(None)) -> bool:
    """Whether these robots agree to the last bit."""
    names = FIELDS if one.velocity is None else f"{FIELDS} {MOTION}"
    pairs = ((getattr(one, name)[rows], getattr(other, name)[rows]) for name in names.split())
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


@pytest.mark.study(beyond=3)
@pytest.mark.parametrize("case", CASES)
def test_robots_put_back_begin_anew_and_the_others_notice_nothing(case: str) -> None:
    (sim, _, step), (alone, _, _), (fresh, _, _) = made(case), made(case), made(case)
    snapshot, at_home = sim.snapshot(), sim.state
    for k in range(8):
        assert same(sim.step(**step(k)), alone.step(**step(k)))
    before = sim.state
    sim.restore(snapshot, ROWS)
    assert same(sim.state, at_home, ROWS)
    assert same(sim.state, before, OTHERS)
    assert not same(before, at_home, ROWS)
    for k in range(8, 18):
        state = sim.step(**step(k))
        assert same(state, alone.step(**step(k)), OTHERS)
        assert same(state, fresh.step(**step(k)), ROWS)
        assert state.ok.all()


@pytest.mark.parametrize("case", CASES)
def test_a_snapshot_restores_every_bit(case: str) -> None:
    sim, _, step = made(case)
    for k in range(3):
        sim.step(**step(k))
    kept, runs = sim.snapshot(), []
    for _ in range(2):
        runs.append([sim.step(**step(k)) for k in range(3, 9)])
        sim.restore(kept)
    assert all(same(*pair) for pair in zip(*runs, strict=True))


def test_contact_and_backlash_matter_in_these_cases() -> None:
    sim, _, step = made("contact")
    touched = np.array([sim.step(**step(k)).contacts.count for k in range(18)])
    assert (touched[:8] > 0).any(0)[ROWS].all()
    assert (touched[8:] > 0).any(0)[ROWS].all()
    lash, _, step = made("effect with memory")
    free = simulator(replace(backlash(), effects=()))
    for k in range(8):
        tips = lash.step(**step(k)).tip_position, free.step(**step(k)).tip_position
    assert np.abs(tips[0] - tips[1]).max() > 1e-4


def test_robots_put_back_from_before_a_tip_force_moved() -> None:
    (sim, _, plain), (alone, _, _), (fresh, _, _) = made("plain"), made("plain"), made("plain")
    step, snapshot = loaded(plain), sim.snapshot()
    for k in range(8):
        sim.step(**step(k))
        alone.step(**step(k))
    at = sim.state
    sim.restore(snapshot, ROWS)
    assert same(sim.state, at, OTHERS)
    for k in range(8, 18):
        state, expected = sim.step(**step(k)), fresh.step(**step(k))
        assert same(state, alone.step(**step(k)), OTHERS)
        # the fresh one takes a pass to learn its gain, those had it
        assert_array_equal(state.position[ROWS], expected.position[ROWS])
        assert_array_equal(state.residual[ROWS], expected.residual[ROWS])


@pytest.mark.parametrize("case", ["plain", "effect with memory"])
def test_jacobians_go_with_their_robots(case: str) -> None:
    (sim, _, step), (fresh, _, _) = made(case), made(case)
    snapshot, at_home = sim.snapshot(), fresh.jacobian()
    for k in range(6):
        sim.step(**step(k))
    there = sim.jacobian()
    elsewhere = step(30)
    elsewhere["tendon_length"][OTHERS] = np.nan
    sim.settle(**elsewhere, rows=ROWS)
    settled = sim.jacobian()
    assert_array_equal(settled[OTHERS], there[OTHERS])
    assert not np.array_equal(settled[ROWS], there[ROWS])
    sim.restore(snapshot, ROWS)
    assert_array_equal(sim.jacobian()[OTHERS], there[OTHERS])
    assert_array_equal(sim.jacobian()[ROWS], at_home[ROWS])


def test_a_mask_and_indices_name_the_same_robots() -> None:
    sims = [made("plain") for _ in range(2)]
    for (sim, _, step), rows in zip(sims, (ROWS, np.isin(np.arange(N), ROWS)), strict=True):
        snapshot = sim.snapshot()
        for k in range(4):
            sim.step(**step(k))
        sim.restore(snapshot, rows)
    assert same(sims[0][0].state, sims[1][0].state)
    assert same(sims[0][0].step(**step(5)), sims[1][0].step(**step(5)))


def test_all_rows_put_back_are_the_whole_snapshot() -> None:
    (sim, _, step), (whole, _, _) = made("effect with memory"), made("effect with memory")
    for s, rows in ((sim, np.arange(N)), (whole, None)):
        for k in range(3):
            s.step(**step(k))
        snapshot = s.snapshot()
        for k in range(3, 9):
            s.step(**step(k))
        s.restore(snapshot, rows)
    for k in range(3, 9):
        assert same(sim.step(**step(k)), whole.step(**step(k)))


@pytest.mark.parametrize("case", [case for case in CASES if case != "contact"])
def test_some_robots_settle_and_the_others_stay(case: str) -> None:
    (sim, _, step), (alone, _, _), (fresh, _, _) = made(case), made(case), made(case)
    for k in range(6):
        sim.step(**step(k))
        alone.step(**step(k))
    before, there = sim.state, step(20)
    there["tendon_length"][0] = np.nan  # of robot 0, which is left out: not read
    sim.settle(**there, rows=ROWS)
    assert same(sim.state, before, OTHERS)
    assert (sim.state.residual[ROWS] < 1e-9).all()
    assert sim.state.ok.all()
    if sim.state.velocity is not None:
        assert_allclose(sim.state.velocity[ROWS], 0.0, atol=1e-12)
    if not CASES[case][0].effects:  # where a robot settles depends on where its tendons were
        expected = fresh.settle(**step(20)).tip_position[ROWS]
        assert_allclose(sim.state.tip_position[ROWS], expected, rtol=0, atol=1e-8)
    for k in range(6, 14):
        assert same(sim.step(**step(k)), alone.step(**step(k)), OTHERS)


def stiffer(robot: Robot, factor: float) -> Robot:
    bending = tuple(factor * b for b in robot.segments[0].bending_stiffness)
    return replace(robot, segments=(replace(robot.segments[0], bending_stiffness=bending),))


@pytest.mark.parametrize("case", ["plain", "effect with memory", *MODAL])
def test_replaced_robots_are_those_of_a_simulator_built_from_them(case: str) -> None:
    robot, step, options = CASES[case]
    others = [stiffer(robot, 0.6), stiffer(robot, 1.7)]
    if robot.effects:
        others[1] = replace(others[1], effects=({"name": "backlash", "half_width": 1e-4},))
    listed = [robot, others[0], robot, others[1], robot]
    (sim, home, _), (alone, _, _), built = made(case), made(case), simulator(listed, **options)
    built.settle(**home)
    for k in range(6):
        sim.step(**step(k))
        alone.step(**step(k))
    sim.replace(ROWS, others)
    assert sim.robots == tuple(listed)
    sim.settle(**home, rows=ROWS)
    assert same(sim.state, built.state, ROWS)
    assert same(sim.state, alone.state, OTHERS)
    for k in range(6, 14):
        state = sim.step(**step(k))
        assert same(state, built.step(**step(k)), ROWS)
        assert same(state, alone.step(**step(k)), OTHERS)
    assert np.abs(state.tip_position - alone.state.tip_position)[ROWS].max() > 1e-6


def test_a_simulator_without_a_step_has_no_state() -> None:
    sim = Simulator(rod(), N)
    with pytest.raises(InputError, match="step or settle"):
        sim.state  # noqa: B018
    state = sim.settle(rod().rest_tendon_length, rows=ROWS)
    assert sim.state is state
    assert state.ok.tolist() == [False, True, False, True, False]
    assert set(state.problems) == set(OTHERS)
    assert sim.step(rod().rest_tendon_length).ok.all()


def test_rows_must_be_robots_of_the_simulator() -> None:
    sim, home, step = made("plain")
    snapshot, state = sim.snapshot(), sim.state
    calls: Sequence[Callable[[], object]] = (
        lambda: sim.restore(snapshot, [N]),
        lambda: sim.settle(**home, rows=[0, N]),
        lambda: sim.replace([N], [rod()]),
        lambda: sim.replace([0, 1], [rod()]),
        lambda: sim.replace(np.ones(N, bool), [rod()] * N),
        lambda: sim.restore(Simulator(rod(), N + 1).snapshot(), ROWS),
    )
    for call in calls:
        with pytest.raises(InputError):
            call()
    assert sim.state is state
    assert same(sim.step(**step(0)), made("plain")[0].step(**step(0)))


def test_what_does_not_go_with_contact_or_effects_is_refused() -> None:
    sim, home, _ = made("contact")
    with pytest.raises(InputError, match="contact scene"):
        sim.settle(**home, rows=ROWS)
    longer = replace(prototype(1e-5), segments=(replace(prototype(1e-5).segments[0], length=0.08),))
    with pytest.raises(RobotError, match="length"):
        sim.replace([1], [longer])
    with pytest.raises(RobotError, match="effect"):
        made("effect with memory")[0].replace([1], [rod(line_density=0.1)])
    with pytest.raises(RobotError):
        made("plain")[0].replace([1], [rod(n_tendons=3)])


def test_a_snapshot_of_other_robots_is_refused() -> None:
    robot = load_robot("prototype")
    sim = Simulator([robot, robot])
    sim.settle(robot.rest_tendon_length)
    snapshot = sim.snapshot()
    sim.restore(snapshot)
    softer = replace(robot, segments=tuple(replace(s, torsional_stiffness=5e-4) for s in robot.segments))
    sim.replace([1], [softer])
    with pytest.raises(InputError, match="of other robots; some were replaced"):
        sim.restore(snapshot)
