"""Rods of modes as users of the simulator meet them, at rest and in motion: batches, memory, effects."""

from __future__ import annotations

from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rods import bend, rod
from test_effects import NAMES, at_neutral, at_typical, having
from test_simulator_rows import FIELDS, MOTION, ROWS, N, carried, stiffer

from fastrod import Lump, Modal, Modes, Robot, Simulator, State
from fastrod.errors import InputError, RobotError
from fastrod.model.routing import route

MOVING = {"dynamics": True, "dt": 2e-3}
STILL = {"solver": "modal"}
BOTH = pytest.mark.parametrize("options", [MOVING, STILL], ids=["in motion", "at rest"])
ALL, inputs = f"{FIELDS} {MOTION}".split(), carried()
SPREAD = {
    "stiffness_taper",
    "precurvature",
}  # their material changes along the rod: interpolated, to rounding


def heavy(**more: Any) -> Robot:
    return rod(**{"line_density": 0.1, "damping_time": 1e-3} | more)


def simulator(
    robot: Robot | list[Robot], options: dict[str, Any], n_robots: int = N, **more: Any
) -> Simulator:
    return Simulator(robot, n_robots, threads=1, **{"points_per_segment": 5} | options | more)


def begun(options: dict[str, Any], robot: Robot, n: int = 4) -> Simulator:
    """At rest, then n steps."""
    sim = simulator(robot, options)
    assert sim.settle(**inputs(0)).ok.all()
    for k in range(1, n):
        assert sim.step(**inputs(k)).ok.all()
    return sim


def assert_same(one: State, two: State, rows: Any = slice(None), rows_two: Any = None) -> None:
    for name in ALL:
        a, b = (getattr(state, name) for state in (one, two))
        assert_array_equal(a[rows], b[rows if rows_two is None else rows_two], err_msg=name)


@BOTH
def test_a_batch_of_different_robots_is_as_many_single_ones(options: dict[str, Any]) -> None:
    robots = [stiffer(heavy(line_density=0.05 + 0.02 * i), 1.0 + i) for i in range(N)]
    together = simulator(robots, options)
    single = [simulator(robot, options, 1) for robot in robots]
    for k in range(6):
        given = inputs(k)
        state = (together.settle if k == 0 else together.step)(**given)
        assert state.ok.all()
        for i, sim in enumerate(single):
            own = {name: a[i] for name, a in given.items()}
            assert_same(state, (sim.settle if k == 0 else sim.step)(**own), i, 0)


@BOTH
def test_many_lanes_answer_as_few_do(options: dict[str, Any]) -> None:
    robot = heavy()
    few, many = simulator(robot, options), simulator(robot, options, 3 * N)
    assert few._rods.modal._kernels is not many._rods.modal._kernels  # type: ignore[attr-defined]
    for k in range(6):
        given = inputs(k)
        thrice = {name: np.concatenate([a] * 3) for name, a in given.items()}
        one, three = (
            (sim.settle if k == 0 else sim.step)(**each) for sim, each in ((few, given), (many, thrice))
        )
        for name in ALL:
            a, b = (getattr(state, name) for state in (one, three))
            assert_allclose(b, np.concatenate([a] * 3), rtol=1e-12, atol=1e-12, err_msg=name)


def test_kernels_of_few_and_of_many_lanes_do_not_type_their_calls_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Numba looks a call up by the fields of its tuples, not by their class: of two classes with the same
    fields it takes one for the other, and finds the kernel only after it has typed each array again."""
    few, many = simulator(heavy(), MOVING), simulator(heavy(), MOVING, 3 * N)

    def kernel_of(sim: Simulator) -> Any:
        return sim._rods.modal._kernels.pass_modes  # type: ignore[attr-defined]

    def go(k: int) -> None:
        for sim, n in ((few, 1), (many, 3)):
            given = {name: np.concatenate([a] * n) for name, a in inputs(k).items()}
            (sim.settle if k == 0 else sim.step)(**given)

    go(0)
    go(1)
    anew = [Mock(wraps=kernel._compile_for_args) for kernel in map(kernel_of, (few, many))]
    for sim, typed in zip((few, many), anew, strict=True):
        monkeypatch.setattr(kernel_of(sim), "_compile_for_args", typed)
    go(2)
    assert [typed.call_count for typed in anew] == [0, 0]


def test_a_batch_of_different_lumps_is_as_many_single_ones_to_rounding() -> None:
    robots = [heavy(lumps=(Lump(at=0.01 + 0.01 * i, mass=1e-3 * i),)) for i in range(N)]
    together, single = simulator(robots, MOVING), [simulator(robot, MOVING, 1) for robot in robots]
    for k in range(6):
        given = inputs(k)
        state = (together.settle if k == 0 else together.step)(**given)
        for i, sim in enumerate(single):
            alone = (sim.settle if k == 0 else sim.step)(**{name: a[i] for name, a in given.items()})
            assert_allclose(state.position[i], alone.position[0], rtol=0, atol=1e-14)
            assert_allclose(state.velocity[i], alone.velocity[0], rtol=0, atol=1e-11)


def test_a_robot_that_is_hard_to_solve_leaves_its_neighbours_alone() -> None:
    """A blow of 20 N takes many Newton steps; the robots beside it take, and report, their own few."""
    robot = heavy()
    sim, clean = begun(MOVING, robot), begun(MOVING, robot)
    rest = np.setdiff1d(np.arange(N), [1])
    for k in range(4, 8):
        given = inputs(k)
        hard = given | {"tip_force": given["tip_force"].copy()}
        hard["tip_force"][1] = 20.0 * np.array([(-1.0) ** k, 0.3, -1.0])
        state, other = sim.step(**hard), clean.step(**given)
        assert state.passes[1] > other.passes[1]
        assert_same(state, other, rest)


def test_lengths_with_noise_take_one_newton_step_as_smooth_ones_do() -> None:
    robot, rng, pulled = heavy(), np.random.default_rng(0), bend(heavy(), 0.2, 0.1)
    loose, tight = (simulator(robot, MOVING, 64) for _ in range(2))
    rest = np.tile(pulled, (64, 1))
    for sim in (loose, tight):
        assert sim.settle(tendon_length=rest).ok.all()
    taken, off = [], []
    for _ in range(20):
        now = rest + 5e-5 * rng.normal(size=rest.shape)
        state, exact = loose.step(tendon_length=now), tight.step(tendon_length=now, passes=3)
        off.append(np.linalg.norm(state.tip_position - exact.tip_position, axis=1))
        taken.append(state.passes)
    assert np.mean(taken) < 1.1
    assert np.sqrt(np.mean(np.square(off))) < 1e-4 * robot.length


def test_one_bad_row_leaves_its_neighbours_alone() -> None:
    sim, clean = begun(MOVING, heavy()), begun(MOVING, heavy())
    given = inputs(4)
    given["tip_force"][1] = np.nan
    before = sim.state
    state = sim.step(**given)
    assert set(state.problems) == {1}
    assert "not finite" in state.problems[1]
    rest = np.setdiff1d(np.arange(N), [1])
    assert_same(state, clean.step(**inputs(4)), rest)
    assert_array_equal(state.velocity[1], before.velocity[1])  # type: ignore[index]
    for k in range(5, 8):
        state = sim.step(**inputs(k))
        assert state.ok.all()
        assert_same(state, clean.step(**inputs(k)), rest)


@pytest.mark.study(beyond=14)
@BOTH
@pytest.mark.parametrize("name", NAMES)
def test_a_neutral_effect_is_the_base_model_bit_for_bit(name: str, options: dict[str, Any]) -> None:
    plain, neutral = (
        begun(options, robot, 6) for robot in (heavy(), having(heavy(), at_neutral(name, heavy())))
    )
    if name in SPREAD:
        assert_allclose(neutral.state.position, plain.state.position, rtol=0, atol=1e-15)
        # a velocity is a difference of places, over dt (2 / dt of generalized-alpha)
        assert_allclose(neutral.state.velocity, plain.state.velocity, rtol=0, atol=2e-15 / plain.dt)
        return
    assert_same(plain.state, neutral.state)
    for a, b in zip(plain.measure(), neutral.measure(), strict=True):
        assert_array_equal(a, b)


@pytest.mark.study
@pytest.mark.parametrize("name", ["backlash", "friction", "creep", "tendon_stretch", "gravity"])
def test_effects_of_slow_motion_are_those_of_the_rod_at_rest(name: str) -> None:
    """Their memories see the same tendons: to the inertia of a bend there and back within 4 s."""
    robot = having(heavy(), at_typical(name, heavy(), 2.0))
    makes = [(robot, {}), (robot, STILL), (robot, {"dynamics": True}), (heavy(), {})]
    sims = [Simulator(made, dt=0.02, points_per_segment=10, **how) for made, how in makes]
    for sim in sims:
        sim.settle(robot.rest_tendon_length)
    tips = []
    for x in 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(1, 201) / 200):
        lengths = bend(robot, 0.8 * x, -0.3 * x)
        tips.append([sim.step(lengths).tip_position[0] for sim in sims])
    path = np.array(tips)
    still, moving, effect = np.linalg.norm(path[:, 1:] - path[:, :1], axis=2).max(0)
    assert still < 1e-4 * effect
    assert moving < 0.02 * effect


def test_tighter_tendons_shorten_a_body_by_their_own_springs() -> None:
    """Tension n T over EA / l shortens it, and each tendon's compliance c takes the rest of T0 (1 + f)."""
    EA, T0, c, f = 400.0, 3.0, 1e-3, 0.5
    robot = rod(axial_stiffness=EA)
    (segment,) = robot.segments
    tendons = tuple(replace(t, unilateral=True, pretension=T0, compliance=c) for t in segment.tendons)
    robot = replace(robot, segments=(replace(segment, tendons=tendons),))
    n, length = len(tendons), segment.length
    for fraction in (0.0, f):
        state = Simulator(having(robot, {"name": "tightening", "fraction": fraction})).settle(
            robot.rest_tendon_length
        )
        tension = T0 * (1.0 + fraction) / (1.0 + n * length / (EA * c))
        assert_allclose(state.tension[0], tension, rtol=1e-6)
        assert_allclose(length - state.tip_position[0, 2], n * tension * length / EA, rtol=1e-6)


@BOTH
def test_shape_jacobian_and_compliance_are_those_of_the_observer(options: dict[str, Any]) -> None:
    fine = Modal(dynamics=options == MOVING, modes=Modes(6, 4))
    how: list[dict[str, Any]] = [{"solver": fine}, {}]
    modal, observer = (simulator(heavy(), more, points_per_segment=20) for more in how)
    for sim in (modal, observer):
        sim.settle(**inputs(3))
    s = np.linspace(0.0, heavy().length, 9)
    assert_allclose(modal.shape(s).position, observer.shape(s).position, atol=1e-6)
    assert_allclose(modal.shape(s).rotation, observer.shape(s).rotation, atol=1e-4)
    for name in ("jacobian", "compliance"):
        a, b = (getattr(sim, name)() for sim in (modal, observer))
        assert_allclose(a, b, atol=1e-3 * np.abs(b).max())


def test_only_the_tip_is_kept_where_no_more_is_asked_for() -> None:
    sim, full = simulator(heavy(), MOVING, outputs="tip"), simulator(heavy(), MOVING)
    for s in (sim, full):
        s.settle(**inputs(0))
        s.step(**inputs(1))
    assert sim.state.velocity.shape == (0, 6, 3)  # type: ignore[union-attr]
    for name in ("tip_position", "kinetic_energy", "strain_energy", "residual", "ok"):
        assert_array_equal(getattr(sim.state, name), getattr(full.state, name))


def test_snapshots_of_another_solver_or_scheme_are_refused() -> None:
    robot = heavy()
    coarse_ones = {"solver": Modal(modes=Modes(4, 2))}
    options: list[dict[str, Any]] = [MOVING, STILL, coarse_ones, MOVING | {"scheme": "bdf2"}, {}]
    moving, still, coarse, bdf2, observer = sims = [simulator(robot, how) for how in options]
    for sim in sims:
        sim.settle(robot.rest_tendon_length)
    pairs = (moving, still), (moving, coarse), (moving, bdf2), (moving, observer), (observer, moving)
    for sim, other in pairs:
        with pytest.raises(InputError, match="another simulator"):
            sim.restore(other.snapshot())
        with pytest.raises(InputError, match="another simulator"):
            sim.restore(other.snapshot(), ROWS)


def test_lumps_of_a_batch_agree_in_number() -> None:
    lump = Lump(at=0.03, mass=0.01)
    with pytest.raises(RobotError, match="robot 1 of the batch has lumps on other segments"):
        Simulator([heavy(lumps=(lump,)), heavy()], dynamics=True)
    sim = Simulator([heavy(lumps=(lump,)), heavy(lumps=(replace(lump, mass=0.0),))], dynamics=True)
    sim.settle(heavy().rest_tendon_length)
    alone = Simulator(heavy(), dynamics=True)
    alone.settle(heavy().rest_tendon_length)
    assert_allclose(sim.frequencies()[1], alone.frequencies()[0], rtol=1e-12)


@BOTH
def test_gravity_that_is_given_once_is_given_once(options: dict[str, Any]) -> None:
    """Gravity acts on the rod and on its lumps."""
    robot = heavy(lumps=(Lump(at=0.03, mass=0.01),))
    sim = simulator(robot, options, 1)
    forces = [
        sim.settle(robot.rest_tendon_length, **given).base_wrench[0, :3]
        for given in ({"gravity": (1.0, 0.0, 0.0)}, {})
    ]
    weight = 0.1 * 0.07 + 0.01
    assert_allclose(forces, [[weight, 0.0, 0.0], [0.0, 0.0, -9.81 * weight]], atol=1e-12)


@pytest.mark.parametrize("gravity", [(0.0, 0.0, 9.81), (9.81, 0.0, 0.0), (0.0, 0.0, -9.81)])
def test_robots_heavy_for_their_stiffness_are_of_as_many_modes_as_they_need(gravity: Any) -> None:
    robot = Robot(name="heavy", segments=rod(length=0.15, line_density=0.45).segments * 2, gravity=gravity)
    sims = Simulator(robot, 8), Simulator(robot, 8, solver=Modal(modes=Modes(6, 4, pieces=6)))
    bends = np.random.default_rng(3).uniform(-0.6, 0.6, (8, 2, 2))
    rests = [sim.settle(robot.rest_tendon_length + route(robot).tendon_change(bends)) for sim in sims]
    assert sims[0].solver == "modal"
    assert rests[0].ok.all()
    assert_allclose(*(rest.tip_position for rest in rests), atol=1e-4 * robot.length)


@pytest.mark.parametrize("weight", [7.8, 7.9, 20.0, 200.0])
def test_an_upright_rod_falls_to_a_side_beyond_what_it_bears(weight: float) -> None:
    # 7.837 EI/L^2 (Greenhill 1881)
    robot = rod("passive", length=0.4, line_density=weight * 0.0022 / 0.4**3 / 9.81)
    rest, pushed = (Simulator(robot, solver="modal") for _ in range(2))
    pushed.settle(tip_force=(1e-3 * weight, 0.0, 0.0))
    heights = [sim.settle().tip_position[0, 2] for sim in (rest, pushed)]
    assert_allclose(*heights, atol=1e-5)
    assert (heights[0] < 0.4 - 1e-4) == (weight > 7.837)


@pytest.mark.parametrize(("n_tendons", "weight"), [(3, 20.0), (3, 60.0), (4, 20.0), (4, 60.0)])
def test_an_upright_rod_that_hardly_anything_holds_comes_to_rest(n_tendons: int, weight: float) -> None:
    # round the vertical it is held by its tendons alone, or hardly
    given = {"length": 0.4, "line_density": weight * 0.0022 / 0.4**3 / 9.81}
    alone, tip = (rod(n_tendons=n_tendons, **some).segments for some in (given, {}))
    for segments in (alone, rod("passive", **given).segments + tip):
        robot = Robot(name="upright", segments=segments)
        assert Simulator(robot, solver="modal").settle(robot.rest_tendon_length).ok.all()
