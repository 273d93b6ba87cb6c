"""Each effect against a closed form, a law, or a robot that is built the way the effect says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import count, pairwise
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rods import bend, rod
from scipy.integrate import quad, solve_ivp
from scipy.spatial.transform import Rotation

from fastrod import Robot, Segment, Simulator, Tendon, load_robot
from fastrod.effects.base import get_effect, read_values
from fastrod.effects.executor import SensedPoses
from fastrod.effects.pipeline import EffectPipeline
from fastrod.kernels.operators import (
    BUFFER,
    SLIDERS,
    delay,
    elastoplastic,
    play,
    relaxation,
    second_order,
    yielding,
)
from fastrod.model.compile import compile_robots
from fastrod.model.routing import route
from fastrod.solver.inputs import Inputs, Reader
from fastrod.solver.state import State

ROUNDING = 1e-13  # of numbers of size one, after some hundred operations
Law = Callable[[np.ndarray], np.ndarray]


def through(law: Any, path: np.ndarray, width: int, *given: Any) -> np.ndarray:
    """A path (n,) or (n, 2) after an operator with `width` numbers of memory; its numbers become (1, 1)."""
    x = path[None, :, None].copy()
    law(x, np.full((1, width), np.nan), *(v if isinstance(v, np.ndarray) else np.array([[v]]) for v in given))
    return np.asarray(x[0, :, 0])


def played(path: np.ndarray, half_width: float = 0.1, rounding: float = 0.0) -> np.ndarray:
    return through(play, path, 3, half_width, rounding)


def rounded(path: np.ndarray) -> np.ndarray:
    return played(path, rounding=0.3)


def rubbed(path: np.ndarray, growth: float = 0.0) -> np.ndarray:
    wrapped = np.abs(path)[None, :, None].copy()
    return through(elastoplastic, path, 1 + SLIDERS, 0.3, 0.2, 0.4, growth, wrapped)


def delayed(path: np.ndarray, lag: float, dt: np.ndarray) -> np.ndarray:
    return through(delay, path, 1 + BUFFER * 2, np.array([lag]), dt)


def yielded_in_plane(path: np.ndarray) -> np.ndarray:
    """Yielded in plane of bends (n, 2): a share of 0.2 beyond 0.5."""
    return through(yielding, path, 2, 0.2, 0.5)


def yielded(path: np.ndarray) -> np.ndarray:
    """Yielded of a bend that keeps its plane."""
    plane = np.array([0.6, -0.8])
    found = yielded_in_plane(path[:, None] * plane)
    assert_allclose(found @ [0.8, 0.6], 0.0, atol=ROUNDING)
    return np.asarray(found @ plane)


def along(corners: list[float], n: int) -> np.ndarray:
    """A path through these corners, n steps from each to the next."""
    parts = [np.linspace(a, b, n, endpoint=False) for a, b in pairwise(corners)]
    return np.append(np.concatenate(parts), corners[-1])


# Loops without rates


LOOPS = pytest.mark.parametrize("law", [played, rounded, rubbed, yielded])


@LOOPS
def test_a_loop_does_not_know_how_finely_its_path_is_sampled(law: Law) -> None:
    corners = [0.0, 1.0, -0.4, 0.7, 0.1, 0.2, -1.0]
    coarse, fine = law(along(corners, 1)), law(along(corners, 97))
    assert_allclose(fine[::97], coarse, atol=ROUNDING)


@LOOPS
def test_a_loop_within_a_loop_is_wiped_out(law: Law) -> None:
    """Return-point memory: back where a small loop left the large one, as if it had not been."""
    plain = law(along([0.0, 1.0, -0.8, 0.5, 0.9], 50))
    looped = law(along([0.0, 1.0, -0.8, 0.5, -0.1, 0.3, 0.05, 0.5, 0.9], 50))
    assert_allclose(looped[-51:], plain[-51:], atol=ROUNDING)


@pytest.mark.parametrize("amplitude", [0.15, 0.5, 3.0])
def test_play_rests_for_twice_its_half_width_after_every_reversal(amplitude: float) -> None:
    x = along([0.0, amplitude, -amplitude, amplitude], 3000)
    p = played(x)
    for turn, side in ((3000, 1.0), (6000, -1.0)):
        leg_x, leg_p = x[turn : turn + 3001], p[turn : turn + 3001]
        still = np.abs(leg_p - leg_p[0]) < ROUNDING
        # two samples are where the flat spot may end; the step is 2 A / 3000
        assert_allclose(abs(leg_x[still][-1] - leg_x[0]), 0.2, atol=2.0 * amplitude / 3000)
        moving = ~still
        assert_allclose(leg_p[moving], leg_x[moving] + side * 0.1, atol=ROUNDING)
    assert (np.abs(p - x) <= 0.1 + ROUNDING).all()


def test_rounded_play_turns_in_three_steps_about_the_same_gap() -> None:
    """It rests for 2 w (1 - c) after a reversal, moves at a third and two thirds of the input's speed until 2
    w and 2 w (1 + c), and then follows at the same distance w as the sharp one."""
    w, c, n = 0.1, 0.3, 3000
    x = along([0.0, 1.0, -1.0], n)
    travel = 1.0 - x[n:]
    expected = sum(np.maximum(travel - 2.0 * w * factor, 0.0) for factor in (1.0 - c, 1.0, 1.0 + c)) / 3.0
    assert_allclose((1.0 - w) - rounded(x)[n:], expected, atol=ROUNDING)
    assert_allclose(rounded(x)[-1], played(x)[-1], atol=ROUNDING)
    still = round(2.0 * w * (1.0 - c) / (2.0 / n))
    assert_array_equal(rounded(x)[n : n + still], rounded(x)[n])
    assert np.abs(rounded(x) - played(x)).max() > 0.3 * w * c / 3.0  # and it is not the sharp one


def test_friction_saturates_at_its_half_width() -> None:
    r, s = 0.2, 0.4
    x = along([0.0, 2.0, -2.0], 400)
    lost = x - rubbed(x)
    assert_allclose(lost[(x > r * np.exp(s)) & (np.arange(801) < 401)], 0.3, atol=ROUNDING)
    back = np.arange(801) > 400
    assert_allclose(lost[back & (x < 2.0 - 2.0 * r * np.exp(s))], -0.3, atol=ROUNDING)
    assert np.abs(lost).max() <= 0.3 + ROUNDING
    # and before any slider slips the tendon sticks: the loss is linear with slope a mean(1 / r_j)
    radii = r * np.exp(s * np.linspace(-1.0, 1.0, SLIDERS))
    sticks = (x < r * np.exp(-s)) & ~back
    assert_allclose(lost[sticks], 0.3 * np.mean(1.0 / radii) * x[sticks], atol=ROUNDING)


def test_the_area_of_a_friction_loop() -> None:
    # one slider's loop is a parallelogram, 2 a high and 2 (A - r_j) wide: 4 a mean max(A - r_j, 0) in all
    radii = 0.2 * np.exp(0.4 * np.linspace(-1.0, 1.0, SLIDERS))
    areas = []
    for amplitude in (0.05, 0.2, 0.5, 1.0):
        x = along([0.0, amplitude, -amplitude, amplitude], 4000)
        y = rubbed(x)
        assert_allclose(y[-1], y[4000], atol=ROUNDING)  # closed
        areas.append(abs(np.trapezoid(y[4000:], x[4000:])))
        # corners of the loop lie between samples: an error of the second order in 2 A / 4000
        assert_allclose(areas[-1], 4.0 * 0.3 * np.maximum(amplitude - radii, 0.0).mean(), atol=1e-5)
    assert areas[0] < ROUNDING
    assert np.all(np.diff(areas) > 0.0)


def test_friction_grows_with_the_angle_that_a_tendon_wraps() -> None:
    x = along([0.0, 2.0], 10)
    assert_allclose((x - rubbed(x, growth=0.5))[-1], 0.3 * (1.0 + 0.5 * 2.0), atol=ROUNDING)
    robot = rod()
    # a bend of one radian in the end
    dl = np.linspace(0.0, 1.0, 50)[:, None] * (bend(robot, 0.8, 0.6) - robot.rest_tendon_length)
    table = {"half_width": 2e-4, "presliding": 1e-4, "growth": 0.7, "spread": 0.0}
    values = read_values("friction", table, route(robot), "test")[None]
    what: Any = get_effect("friction")
    lost = dl - what.sweep(values, what.memory(1, 4), dl[None], np.full(50, 0.1), route(robot))[0]
    assert_allclose(np.abs(lost[-1]), 2e-4 * 1.7, rtol=1e-12)


def test_nothing_yields_below_the_yield_and_a_set_stays() -> None:
    below = along([0.0, 0.5, -0.5, 0.3], 20)
    circle = 0.5 * np.stack([np.cos(below), np.sin(below)], axis=1) * (1.0 - 1e-12)
    assert_array_equal(yielded_in_plane(circle), circle)
    assert_allclose(yielded(below), below, atol=ROUNDING)
    x = along([0.0, 0.9, 0.0, 0.5, 0.0], 90)
    y = yielded(x)
    assert_allclose(y[180], 0.2 * (0.9 - 0.5), atol=ROUNDING)  # what was beyond the yield, times the share
    assert_allclose(y[180:] - x[180:], y[180], atol=ROUNDING)
    # a large set shrinks on the way back
    assert_allclose(yielded(along([0.0, 2.0, -2.0, 2.0, 0.0], 40))[-1], 0.2 * 0.5, atol=ROUNDING)


def test_a_bend_that_leaves_its_plane_drags_the_set_along_a_tractrix() -> None:
    """A leash y pulled square to itself by s: the set is y tanh(s / y) behind and y sech(s / y) aside."""
    y = 0.5
    errors = []
    for n in (2000, 4000):
        s = np.linspace(0.0, 1.5, n + 1)
        path = np.stack([s, np.full(n + 1, y)], axis=1)  # from (0, y), which only just does not yield
        p = (yielded_in_plane(path) - path) / 0.2
        errors.append(np.abs(p - np.stack([s - y * np.tanh(s / y), y - y / np.cosh(s / y)], axis=1)).max())
        # the leash is never longer than y
        assert (np.linalg.norm(path - p, axis=1) <= y + ROUNDING).all()
    assert errors[1] < 1.5 / 4000  # less than a step
    assert 1.8 < errors[0] / errors[1] < 2.2  # of the first order in it


def test_yielding_has_no_favourite_direction() -> None:
    path = np.cumsum(np.random.default_rng(9).uniform(-0.2, 0.2, (300, 2)), axis=0)
    turn = Rotation.from_rotvec([0.0, 0.0, 0.7]).as_matrix()[:2, :2]
    assert_allclose(yielded_in_plane(path @ turn.T), yielded_in_plane(path) @ turn.T, atol=10.0 * ROUNDING)
    assert np.abs(yielded_in_plane(path) - path).max() > 0.01


# Laws in time


@pytest.mark.parametrize("spread", [0.0, 1.2])
def test_a_body_with_friction_stays_where_it_comes_from(spread: float) -> None:
    """A rod without tendons under a moment: l M / EI less what the elements hold back, each up to a / n."""
    bare, a, w = rod("passive"), 0.05, 0.04
    name, more = ("body_hysteresis", {"spread": spread}) if spread else ("body_friction", {})
    sim = Simulator(replace(bare, effects=({"name": name, "bend": a, "width": w} | more,)))
    (segment,) = bare.segments
    free = segment.length / segment.bending_stiffness[1]
    widths = w * np.exp(np.linspace(-spread, spread, SLIDERS if spread else 1))
    dragged, before, found, expected = np.zeros(len(widths)), 0.0, [], []
    for moment in 1.2 / free * np.sin(np.linspace(0.0, 9.0, 40)):
        state = sim.settle(tip_moment=(0.0, moment, 0.0), tolerance=1e-11 * bare.length)
        assert state.ok.all()
        turned = Rotation.from_matrix(state.tip_rotation[0]).as_rotvec()[1]
        dragged = np.clip(dragged + (turned - before) / widths, -1.0, 1.0)
        before = turned
        found.append(turned)
        expected.append(free * moment - a * dragged.mean())
    assert_allclose(found, expected, rtol=0, atol=1e-7)
    assert np.ptp(np.array(found) - free * (1.2 / free * np.sin(np.linspace(0.0, 9.0, 40)))) > 1.9 * a


def test_a_body_gets_longer_with_the_square_of_its_bend() -> None:
    """A rod without tendons under a moment: u = M / EI over a length that the bend itself makes."""
    bare, a = rod("passive"), 0.01
    sim = Simulator(replace(bare, effects=({"name": "bend_extension", "extension": a},)))
    (segment,) = bare.segments
    for moment in (0.01, 0.02):
        state = sim.settle(tip_moment=(0.0, moment, 0.0), tolerance=1e-11 * bare.length)
        assert state.ok.all()
        length = float(state.arclength[0, -1])
        turned = moment / segment.bending_stiffness[1] * length
        assert_allclose(length, segment.length + a * turned**2, rtol=0, atol=1e-9)


def test_a_load_beside_the_axis_bends_a_rod_that_it_pulls() -> None:
    """Beam under tension F with the end moment F o: the tip moves by o (1 - 1/cosh(l sqrt(F / EI)))."""
    bare, o, force = rod("passive"), 1e-5, 0.7
    (segment,) = bare.segments
    wave_number = np.sqrt(force / np.array(segment.bending_stiffness))
    expected = -o * (1.0 - 1.0 / np.cosh(wave_number * segment.length))
    for axis in (0, 1):
        sim = Simulator(replace(bare, effects=({"name": "load_offset", "xyz"[axis]: o},)))
        state = sim.settle(tip_force=(0.0, 0.0, force), tolerance=1e-11 * bare.length)
        assert_allclose(state.tip_position[0, axis], expected[1 - axis], rtol=1e-3)


def test_relaxation_after_a_step() -> None:
    # c (1 - exp(-t / tau)) of it comes late: out = 1 - c exp(-t / tau); the step takes no time
    dt = np.concatenate([[0.1, 0.0], np.random.default_rng(5).uniform(0.001, 2.0, 40)])
    found = through(relaxation, np.array([0.0] + 41 * [1.0]), 2, 0.15, 3.0, dt)
    assert_allclose(found[1:], 1.0 - 0.15 * np.exp(-np.cumsum(dt[1:]) / 3.0), atol=ROUNDING)


def test_relaxation_behind_a_ramp_and_its_loop_depends_on_speed() -> None:
    # of x = v t, once the start is forgotten, x - y is v tau
    dt = np.full(400, 0.1)
    ramp = 0.5 * np.cumsum(dt)
    late = ramp - through(relaxation, ramp, 2, 0.15, 2.0, dt)
    assert_allclose(late[-1], 0.15 * 0.5 * 2.0, atol=1e-8)  # exp(-40 s / 2 s)
    # the loop of x = sin wt is widest at w tau = 1: area pi c w tau / (1 + (w tau)^2)
    for rate in (0.1, 0.5, 3.0):
        t = np.linspace(0.0, 24.0 * np.pi / rate, 24001)
        path = np.sin(rate * t)
        y = through(relaxation, path, 2, 0.15, 2.0, np.diff(t, prepend=0.0))
        area = np.trapezoid(y[22000:], path[22000:])
        # linear in between, at 2000 samples a turn: 1e-6; the start is forgotten to exp(-22 pi / w tau)
        assert_allclose(abs(area), np.pi * 0.15 * rate * 2.0 / (1.0 + (rate * 2.0) ** 2), rtol=1e-4)


@pytest.mark.parametrize("damping", [0.02, 0.3, 0.98])
def test_second_order_after_a_step_rings_as_the_textbook_says_and_loses_energy(damping: float) -> None:
    T = 0.3
    dt = np.concatenate([[0.1, 0.0], np.random.default_rng(6).uniform(0.001, 0.1, 80)])
    x = np.ones((1, 82, 1))
    x[0, 0] = 0.0
    memory, energy = np.full((1, 3), np.nan), []
    for i in range(82):
        second_order(x[:, i : i + 1], memory, np.array([[T]]), np.array([[damping]]), dt[i : i + 1])
        energy.append(0.5 * (memory[0, 1] - memory[0, 0]) ** 2 + 0.5 * (T * memory[0, 2]) ** 2)
    t, w = np.cumsum(dt[1:]), np.sqrt(1.0 - damping**2) / T
    expected = 1.0 - np.exp(-damping * t / T) * (np.cos(w * t) + damping / (T * w) * np.sin(w * t))
    assert_allclose(x[0, 1:, 0], expected, atol=ROUNDING * 10)
    assert (np.diff(energy[1:]) < 0.0).all()


def test_second_order_against_an_integrator() -> None:
    rng = np.random.default_rng(7)
    t = np.cumsum(rng.uniform(0.01, 0.2, 40))
    path = np.cumsum(rng.uniform(-0.3, 0.3, 40))
    x = through(second_order, path, 3, 0.25, 0.4, np.diff(t, prepend=0.0))

    def slope(now: float, y: np.ndarray) -> list[float]:
        return [y[1], (np.interp(now, t, path) - y[0] - 2.0 * 0.4 * 0.25 * y[1]) / 0.25**2]

    y, found = np.array([path[0], 0.0]), [path[0]]
    for a, b in pairwise(t):  # piece by piece: the integrator does not like corners
        y = solve_ivp(slope, (a, b), y, rtol=1e-10, atol=1e-12).y[:, -1]
        found.append(y[0])
    assert_allclose(x, found, atol=1e-8)


def test_second_order_trails_a_ramp_by_twice_damping_times_period() -> None:
    dt = np.full(300, 0.05)
    ramp = np.cumsum(dt)
    late = ramp - through(second_order, ramp, 3, 0.2, 0.5, dt)
    assert_allclose(late[-1], 2.0 * 0.5 * 0.2, atol=1e-12)  # exp(-0.5 * 15 / 0.2)


def test_a_delayed_ramp_is_the_ramp_of_a_moment_ago() -> None:
    dt = np.random.default_rng(8).uniform(0.005, 0.05, 500)
    t = np.cumsum(dt)
    for lag in (0.0, 0.003, 0.1, 0.7):  # times up to 14 s
        expected = np.maximum(2.0 * (t - lag), 2.0 * t[0])
        assert_allclose(delayed(2.0 * t, lag, dt), expected, atol=ROUNDING * 20)
    # a delay beyond the buffer is cut to the oldest step that is kept
    oldest = delayed(2.0 * t, 1e3, dt)
    assert_allclose(oldest[BUFFER - 1 :], 2.0 * t[: 500 - BUFFER + 1], atol=ROUNDING * 20)
    assert_array_equal(oldest[: BUFFER - 1], 2.0 * t[0])


def test_a_delayed_parabola_is_exact_from_the_third_sample_on() -> None:
    """A cubic with the slopes of parabolas is the parabola itself; a line would be off by h^2 / 4."""
    dt = np.random.default_rng(10).uniform(0.01, 0.03, 100)
    t = np.cumsum(dt)
    for lag in (0.005, 0.061, 0.25):  # between the last two samples, and further back
        found, past = delayed(t**2, lag, dt), t - lag
        inside = past > t[3]
        assert_allclose(found[inside], past[inside] ** 2, atol=ROUNDING)
        assert np.abs(np.interp(past, t, t**2) - past**2)[inside].max() > 1e-5


def test_a_delayed_wave_converges_faster_than_with_lines() -> None:
    """Halved steps: errors of lines fall by 4, of cubics by 8, but for the turns, where they are lines'."""
    errors = []
    for n in (200, 400):
        t = np.linspace(0.0, 10.0, n + 1)
        dt = np.diff(t, prepend=0.0)
        lag = 7.3 * 10.0 / n  # at the same place between two samples: there the errors' slopes do not cancel
        found, past = delayed(np.sin(t), lag, dt), t - lag
        steep = (past > 0.5) & (np.abs(np.cos(past)) > 0.3)
        line, cubic = (np.abs(y - np.sin(past)) for y in (np.interp(past, t, np.sin(t)), found))
        assert cubic[past > 0.5].max() < line[past > 0.5].max()
        assert cubic[steep].max() < 0.1 * line[steep].max()
        errors.append(cubic[steep].max())
    assert errors[0] / errors[1] > 7.0


@pytest.mark.parametrize("seed", range(5))
def test_a_delay_overshoots_nowhere(seed: int) -> None:
    """At reversals, stops and irregular times: what comes out lies between the two samples around it."""
    rng = np.random.default_rng(seed)
    dt = rng.uniform(0.001, 0.05, 120)
    t = np.cumsum(dt)
    x = np.cumsum(rng.uniform(-1.0, 1.0, 120) * (rng.random(120) > 0.3) * 10.0 ** rng.uniform(-2.0, 0.0, 120))
    for lag in (0.03, 0.1, 0.2):
        found, past = delayed(x, lag, dt), t - lag
        inside = past >= t[0]
        j = np.clip(np.searchsorted(t, past, side="right") - 1, 0, 118)[inside]
        low, high = np.minimum(x[j], x[j + 1]), np.maximum(x[j], x[j + 1])
        assert (found[inside] >= low - ROUNDING).all()
        assert (found[inside] <= high + ROUNDING).all()
    triangle = along([0.0, 1.0, -1.0, 0.5], 20)
    assert np.abs(delayed(triangle, 0.13, np.full(61, 0.1))).max() <= 1.0
    ramp_and_rest = np.minimum(np.arange(40) * 0.1, 1.0)
    assert_array_equal(delayed(ramp_and_rest, 0.25, np.full(40, 0.1))[14:], ramp_and_rest[-1])


# Effects against robots that are built so


def having(robot: Robot, name: str, **values: Any) -> Robot:
    return replace(robot, effects=({"name": name, **values},))


def settled(robot: Robot, lengths: Any = None, loads: Any = MappingProxyType({})) -> State:
    state = Simulator(robot, points_per_segment=8).settle(lengths, tolerance=1e-12, **loads)
    assert state.ok.all(), state.problems
    return state


def seen(robot: Robot, lengths: Any = None, **inputs: Any) -> SensedPoses:
    sim = Simulator(robot, points_per_segment=8)
    sim.settle(lengths, tolerance=1e-12, **inputs)
    return sim.measure()


def apart(one: State, two: State) -> float:
    """The largest difference as a fraction of what two settled states may differ by: 1e-12 m, 1e-10 of a
    rotation, 1e-5 N, and 1e-7 of the number."""
    allowed = {"position": 1e-12, "rotation": 1e-10, "tension": 1e-5}
    pairs = [(getattr(one, name), getattr(two, name), most) for name, most in allowed.items()]
    return float(np.max([np.max(np.abs(a - b) / (most + 1e-7 * np.abs(b))) for a, b, most in pairs]))


LOADS: dict[str, Any] = {
    "tip_force": (0.05, 0.1, -0.1),
    "line_force": (0.1, 0.0, 0.2),
    "base_pose": (0.1, 0.2, 0.3, *Rotation.from_rotvec([0.4, -0.9, 0.3]).as_quat(scalar_first=True)),
}


def with_segments(robot: Robot, **fields: Callable[[Segment, int], Any]) -> Robot:
    """The robot with fields of its segments changed: (segment, its number) -> value."""
    segments = [
        replace(segment, **{name: change(segment, k) for name, change in fields.items()})
        for k, segment in enumerate(robot.segments)
    ]
    return replace(robot, segments=tuple(segments))


def with_tendons(robot: Robot, **fields: Callable[[Tendon, int], Any]) -> Robot:
    """The robot with fields of its tendons changed: (tendon, its number) -> value."""
    number = count()

    def changed(tendon: Tendon, t: int) -> Tendon:
        return replace(tendon, **{name: change(tendon, t) for name, change in fields.items()})

    return with_segments(
        robot, tendons=lambda s, k: tuple(changed(tendon, next(number)) for tendon in s.tendons)
    )


ROD, LONGER, THREE = rod(), rod(extension=(-0.02, 0.02)), rod(n_tendons=3)
BENT, REST = bend(ROD, 0.5, 0.3), ROD.rest_tendon_length
ROUND = bend(ROD, 0.6, 0.8)  # a bend of one radian
CHAIN = with_segments(
    load_robot("tdcr_b"),
    length=lambda s, k: (s.length, 0.08)[k],
    bending_stiffness=lambda s, k: (s.bending_stiffness, (0.002, 0.003))[k],
)
LONGER_CHAIN = with_segments(CHAIN, extension=lambda s, k: (-0.02, 0.02))
HEAVY = with_segments(CHAIN, line_density=lambda s, k: (0.2, 0.4)[k])
TILTED = replace(CHAIN, gravity=(0.0, 3.0, -9.0))
NEAR, FAR = np.array([0.5, -0.3]), np.array([-0.2, 0.4])
SAMPLED = LOADS | {"line_force": np.full((2, 5, 3), 0.1) * np.arange(5)[:, None]}
TURNS = (0.1, -0.2, 0.05, 0.0, 0.3, -0.1)
SHORTER = np.array([-0.05 * 0.1 * np.hypot(0.5, 0.3), -0.1 * 0.08 * np.hypot(0.2, 0.4)])


def pulled(near: np.ndarray = NEAR, far: np.ndarray = FAR) -> np.ndarray:
    """Lengths that bend the segments of the chain so."""
    return bend(CHAIN, *near) + bend(CHAIN, *far, 1) - CHAIN.rest_tendon_length


def stiffness_of_two_axes(segment: Segment, k: int) -> tuple[float, float]:
    x, y = segment.bending_stiffness
    return x * (1.2, 0.7)[k], y * (0.8, 1.3)[k]


PULLED = pulled()
TWINS: dict[str, tuple[tuple[Any, ...], tuple[Any, ...]]] = {
    "gravity: the weight of the body": (
        (having(CHAIN, "gravity", line_density=[0.2, 0.4]), PULLED, LOADS),
        (HEAVY, PULLED, LOADS),
    ),
    "gravity: beside a sampled load": (
        (having(CHAIN, "gravity", line_density=[0.2, 0.4]), PULLED, SAMPLED),
        (HEAVY, PULLED, SAMPLED),
    ),
    "payload: a tip force along gravity": (
        (having(TILTED, "payload", mass=0.02), PULLED, LOADS),
        (TILTED, PULLED, LOADS | {"tip_force": np.add(LOADS["tip_force"], [0.0, 0.02 * 3.0, -0.02 * 9.0])}),
    ),
    "tip_force": (
        (having(CHAIN, "tip_force", x=0.1, y=-0.05, z=0.2), PULLED),
        (CHAIN, PULLED, {"tip_force": (0.1, -0.05, 0.2)}),
    ),
    "tendon_stretch: compliance": (
        (having(CHAIN, "tendon_stretch", compliance=[1e-4, 3e-4]), PULLED, LOADS),
        (
            with_tendons(CHAIN, compliance=lambda tendon, t: tendon.compliance + (1e-4, 3e-4)[t // 3]),
            PULLED,
            LOADS,
        ),
    ),
    "routing_angle: three tendons a segment, each a drive": (
        (having(CHAIN, "routing_angle", angle=[*TURNS]), PULLED, LOADS),
        (with_tendons(CHAIN, angle=lambda tendon, t: tendon.angle + TURNS[t]), PULLED, LOADS),
    ),
    "routing_angle: two pairs": (
        (having(ROD, "routing_angle", angle=[0.1, -0.2]), BENT),
        (with_tendons(ROD, angle=lambda tendon, t: tendon.angle + TURNS[t % 2]), BENT),
    ),
    "encoder_offset: antagonists opposite": (
        (having(ROD, "encoder_offset", offset=[3e-4, -2e-4]), BENT),
        (ROD, BENT + np.array([3e-4, -2e-4, -3e-4, 2e-4])),
    ),
    "drum_gain: scales the pull": (
        (having(ROD, "drum_gain", gain=[0.2, -0.1]), BENT),
        (ROD, BENT + (BENT - REST) * [0.2, -0.1, 0.2, -0.1]),
    ),
    # it is the backbone's to take, not the gain's: it would be tension between stiff parts
    "drum_gain: not a pull that all tendons share": (
        (having(ROD, "drum_gain", gain=0.5), REST - 1e-5),
        (ROD, REST - 1e-5),
    ),
    "coupling: another bend": (
        (having(CHAIN, "coupling", from_distal=0.2, from_proximal=-0.1), PULLED),
        (CHAIN, pulled(NEAR + 0.2 * FAR, FAR - 0.1 * NEAR)),
    ),
    "stiffening: another bend": (
        (having(CHAIN, "stiffening", cubic=[0.3, -0.2]), PULLED),
        (CHAIN, pulled(NEAR * (1.0 - 0.3 * (NEAR @ NEAR)), FAR * (1.0 + 0.2 * (FAR @ FAR)))),
    ),
    "slack: another bend": (  # of 3.75 mm and of 0.75 mm
        (having(ROD, "slack", half_width=1e-3), bend(ROD, 0.5, 0.1)),
        (ROD, bend(ROD, 0.5 - 1e-3 / 0.0075, 0.0)),
    ),
    "compression_softening: nothing without a common pull": (
        (having(ROD, "compression_softening", gain=40.0), bend(ROD, 0.5, -0.3)),
        (ROD, bend(ROD, 0.5, -0.3)),
    ),
    "compression_softening: by the gain times the common pull": (
        (having(ROD, "compression_softening", gain=40.0), bend(ROD, 0.5, -0.3) - 1e-3),
        (ROD, bend(ROD, 0.5 * 1.04, -0.3 * 1.04) - 1e-3),
    ),
    "axial_compression: an extension that the tendons follow": (
        (having(LONGER, "axial_compression", per_bend=0.05), ROUND),
        (LONGER, ROUND - 0.05 * 0.07, {"extension": [-0.05 * 0.07]}),
    ),
    "axial_compression: a common pull shortens a body that does not resist": (
        (having(LONGER, "axial_compression", common_share=1.0), ROUND - 0.002),
        (LONGER, ROUND - 0.002, {"extension": [-0.002]}),
    ),
    "axial_compression: of each segment": (
        (having(LONGER_CHAIN, "axial_compression", per_bend=[0.05, 0.1]), PULLED),
        (LONGER_CHAIN, PULLED + np.cumsum(SHORTER)[CHAIN.tendon_segment], {"extension": SHORTER}),
    ),
    "stiffness_anisotropy: of each axis": (
        (having(CHAIN, "stiffness_anisotropy", ratio=[0.2, -0.3]), PULLED, LOADS),
        (with_segments(CHAIN, bending_stiffness=stiffness_of_two_axes), PULLED, LOADS),
    ),
    "precurvature: the segments' own": (
        (having(CHAIN, "precurvature", uniform_x=[1.0, 2.0], uniform_y=-2.0), PULLED, LOADS),
        (with_segments(CHAIN, precurvature=lambda s, k: (k + 1.0, -2.0, 0.0)), PULLED, LOADS),
    ),
}
"""A robot that has the effect, and one that is built or driven so: robot, lengths, loads."""


@pytest.mark.parametrize("case", TWINS)
def test_an_effect_is_a_robot_that_is_built_or_driven_so(case: str) -> None:
    one, other = TWINS[case]
    assert apart(settled(*one), settled(*other)) <= 1.0


def interacting(pulls: Any, **weights: Any) -> np.ndarray:
    """(n, 2) bend [rad] that pulls (n, 3) [m] of three tendons ask for beside `tendon_interaction`."""
    pulls = np.atleast_2d(pulls)
    robot = having(THREE, "tendon_interaction", **weights)
    layout, params, guess = compile_robots((THREE,), 4)
    rest = THREE.rest_tendon_length
    given = Reader(layout, params, guess, len(pulls)).ports(Inputs(tendon_length=rest - pulls))
    still = np.zeros(len(pulls), dtype=bool)
    felt, _, _ = EffectPipeline([robot], len(pulls)).act(given, params, None, 0.1, 4, still)
    return np.asarray(route(robot).bend(felt.tendon_length - rest)[:, 0])


def test_pulls_that_interact_have_the_slope_of_the_equation() -> None:
    """Every weight has its place: against scipy's quadrature of the printed law."""
    a, b, w = (60.0, -80.0, 20.0), (-4e3, 6e3, 1e3), (30.0, -20.0, 50.0)
    c, d = (2e3, -1e3, 3e3), (-2e3, 1.5e3, 1e3)
    p = np.array([0.004, 0.007, 0.002])

    def pulled_to(i: int) -> float:
        n, m = p[(i + 1) % 3], p[i - 1]
        others = w[i] * n + w[i - 1] * m + c[i] * n * n + d[i] * m * m
        law = lambda s: np.exp(2.0 * np.tanh(0.5 * (a[i] * s + b[i] * s * s + others)))  # noqa: E731
        return float(quad(law, 0.0, p[i], epsabs=1e-14)[0])

    expected = interacting([pulled_to(i) for i in range(3)])
    found = interacting(p, slope=[*a], curvature=[*b], pair=[*w], next=[*c], previous=[*d])
    # five nodes of Gauss: the exponent varies by 0.6 over a pull
    assert_allclose(found, expected, rtol=1e-6)
    assert np.abs(found - interacting(p)).max() > 0.05


def test_equal_tendons_interact_alike_from_every_side() -> None:
    """A robot that looks the same after a third of a turn bends the same after it."""
    weights = {"slope": 60.0, "curvature": -4e3, "pair": 30.0, "next": 2e3, "previous": -1e3}
    pulls = np.array([0.005, 0.002, 0.0])
    one, other = (interacting(np.roll(pulls, k), **weights)[0] for k in (0, 1))
    third = 2.0 * np.pi / 3.0
    turn = np.array([[np.cos(third), -np.sin(third)], [np.sin(third), np.cos(third)]])
    assert_allclose(other, turn @ one, atol=1e-14)


def test_no_pull_bends_back_at_any_weights() -> None:
    """Along a tendon's own pull the bend toward it grows, for weights to their bounds."""
    parameters = [p.on(route(THREE)) for p in get_effect("tendon_interaction").parameters]
    rng, toward = np.random.default_rng(5), route(THREE).arms[0] / np.linalg.norm(route(THREE).arms[0])
    for _ in range(20):
        weights = {
            p.name: rng.uniform(*p.bounds, 3).tolist() for p in parameters if p.name in ("slope", "curvature")
        }
        pulls = np.zeros((200, 3))
        pulls[:, 0] = np.linspace(0.0, 0.01, 200)
        along = interacting(pulls, **weights) @ toward
        assert (np.diff(along) < 0.0).all()  # arms are d(length): a pull shortens


def test_two_pairs_of_tendons_interact_once() -> None:
    """Antagonists are one drive, and of two drives each is the other's only neighbour."""
    idle = having(ROD, "tendon_interaction", pair=[0.0, 50.0], previous=[5e3, 5e3])
    assert apart(settled(idle, BENT), settled(ROD, BENT)) == 0.0
    felt, pulls = BENT - REST, (REST - BENT)[:2]
    factor = np.exp(2.0 * np.tanh(0.5 * 50.0 * pulls[::-1]))
    one = settled(having(ROD, "tendon_interaction", pair=[50.0, 0.0]), BENT)
    assert apart(one, settled(ROD, REST + felt * np.tile(factor, 2))) <= 1.0


def test_the_effect_tip_force_turns_with_the_base() -> None:
    robot = having(CHAIN, "tip_force", x=0.1, y=-0.05, z=0.2)
    turned, still = (seen(robot, PULLED, **given) for given in ({"base_pose": LOADS["base_pose"]}, {}))
    assert_allclose(turned.tip_position, still.tip_position, atol=1e-11)


def test_temperature_scales_the_pull_as_it_warms() -> None:
    sim = Simulator(having(ROD, "temperature", gain=0.1, time_constant=40.0), dt=10.0, points_per_segment=8)
    for k in range(4):  # the first input is at time zero
        warm = 0.1 * (1.0 - np.exp(-10.0 * k / 40.0))
        assert apart(sim.settle(BENT, tolerance=1e-12), settled(ROD, BENT + warm * (BENT - REST))) <= 1.0


def test_axial_compression_shortens_a_body_without_tension() -> None:
    short = settled(having(LONGER, "axial_compression", per_bend=0.05), ROUND)
    assert_allclose(short.arclength[0, -1], 0.07 * 0.95, rtol=1e-12)
    common = settled(having(LONGER, "axial_compression", common_share=1.0), ROUND - 0.002)
    assert_allclose(common.tension.sum(), settled(LONGER, ROUND).tension.sum(), atol=1e-4)


def test_taper_is_a_chain_of_ever_softer_pieces() -> None:
    passive = rod("passive")
    pieces = [
        replace(
            passive.segments[0],
            length=0.07 / 40,
            bending_stiffness=(0.0022 * k, 0.0022 * k),
            torsional_stiffness=0.001 * k,
        )
        for k in 1.0 + 0.5 * (1.0 - 2.0 * (np.arange(40) + 0.5) / 40)
    ]
    loads = {"tip_force": (0.1, 0.3, -0.1), "tip_moment": (1e-3, 0.0, 2e-3)}
    tapered = settled(having(passive, "stiffness_taper", slope=0.5), None, loads)
    built = settled(Robot(name="pieces", segments=tuple(pieces)), None, loads)
    # steps of K at the middles: second order in 1 / 40
    assert_allclose(tapered.tip_position, built.tip_position, atol=2e-4 * np.abs(built.tip_position).max())
    assert np.abs(tapered.tip_position - settled(passive, None, loads).tip_position).max() > 1e-3


def test_a_bow_moves_the_tip_and_does_not_turn_it() -> None:
    # theta(s) = b (s - s^2 / l): nothing at the tip, its integral is b l^2 / 6; beyond it 1e-5 here
    state = settled(having(rod("passive"), "precurvature", bow_x=0.3, bow_y=-0.2))
    assert_allclose(state.tip_rotation[0], np.eye(3), atol=1e-5)
    assert_allclose(state.tip_position[0, :2], np.array([-0.2, -0.3]) * 0.07**2 / 6.0, rtol=1e-4)
    stiff = settled(having(ROD, "precurvature", uniform_x=2.0), REST)
    # tendons that hardly stretch straighten a uniform one, but not a bow
    assert np.abs(stiff.tip_position[0, :2]).max() < 5e-5
    bowed = settled(having(ROD, "precurvature", bow_x=2.0), REST)
    assert_allclose(bowed.tip_position[0, 1], -2.0 * 0.07**2 / 6.0, rtol=2e-2)


# What the camera sees


def test_what_the_camera_makes_of_the_tip() -> None:
    robot = replace(rod(), log_points=(0.03, 0.05))
    lengths, given = bend(robot, 0.6, 0.4), {"base_pose": LOADS["base_pose"]}
    plain = seen(robot, lengths, **given)
    r, R, points = plain.tip_position[0], plain.tip_rotation[0], plain.points[0]

    def look(name: str, **values: float) -> SensedPoses:
        return seen(having(robot, name, **values), lengths, **given)

    turn, shift = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), np.array([0.01, -0.02, 0.005])
    rotated = {"rotation_x": 0.3, "rotation_y": -0.2, "rotation_z": 0.5}
    frame = look("frame_misalignment", **rotated, shift_x=0.01, shift_y=-0.02, shift_z=0.005)
    assert_allclose(frame.tip_position[0], turn @ r + shift, atol=1e-15)
    assert_allclose(frame.points[0], points @ turn.T + shift, atol=1e-15)
    assert_allclose(frame.tip_rotation[0], turn @ R, atol=1e-14)

    marker = look("marker_offset", x=0.003, y=-0.002, z=0.01)
    assert_allclose(marker.tip_position[0], r + R @ [0.003, -0.002, 0.01], atol=1e-15)
    assert_array_equal(marker.points, plain.points)  # it is the tip's marker
    assert_array_equal(marker.tip_rotation, plain.tip_rotation)

    scale = look("camera_scale", scale=0.05)
    assert_allclose(scale.tip_position[0], 1.05 * r, rtol=1e-14)
    assert_allclose(scale.points[0], 1.05 * points, rtol=1e-14)

    lens = look("lens", radial=0.2)
    for found, true in ((lens.tip_position[0], r), (lens.points[0, 1], points[1])):
        assert_allclose(found[:2], true[:2] * (1.0 + 0.2 * (true[:2] @ true[:2]) / 0.07**2), rtol=1e-14)
        assert found[2] == true[2]

    settling = {"x": 2e-3, "y": 0.0, "z": -1e-3, "time_constant": 2.5}
    drifting = Simulator(having(robot, "settling_drift", **settling), dt=0.5, points_per_segment=8)
    for k in range(4):  # of the whole way, 1 - 1/e after one time constant
        drifting.settle(lengths, tolerance=1e-12, **given)
        way = 1.0 - np.exp(-0.5 * k / 2.5)
        assert_allclose(drifting.measure().tip_position[0], r + way * np.array([2e-3, 0.0, -1e-3]), atol=1e-9)
    drifting = Simulator(having(robot, "time_drift", x=1e-5, y=0.0, z=-2e-5), dt=0.5, points_per_segment=8)
    for k in range(3):
        drifting.settle(lengths, tolerance=1e-12, **given)
        moved = 0.5 * k * np.array([1e-5, 0.0, -2e-5])
        for _ in range(2):  # looking twice is not a step
            now = drifting.measure()
            assert_allclose(now.tip_position[0], r + moved, atol=1e-12)
            assert_allclose(now.points[0], points + moved, atol=1e-12)


def test_effects_of_the_camera_act_from_the_marker_on() -> None:
    drift, scale = {"name": "time_drift", "x": 1e-3}, {"name": "camera_scale", "scale": 0.1}
    sim = Simulator(replace(ROD, effects=(drift, scale, {"name": "marker_offset", "z": 0.01})), dt=1.0)
    for _ in range(2):
        sim.settle(REST)
    # drift after scale after marker
    assert_allclose(sim.measure().tip_position[0], [1e-3, 0.0, 1.1 * 0.08], atol=1e-9)


@pytest.mark.parametrize(
    ("name", "values"),
    [("latency", {"delay": 0.12}), ("second_order_lag", {"period": 0.2}), ("creep", {"share": 0.2})],
)
def test_an_effect_on_the_tendons_is_its_operator_on_what_bends(name: str, values: dict[str, float]) -> None:
    """Step by step, an operator is the base model on tendons that went through it."""
    robot = rod()
    path = np.stack([bend(robot, 0.8 * np.sin(0.4 * k), 0.5 * np.cos(0.3 * k)) for k in range(12)])
    what: Any = get_effect(name)
    row = read_values(name, values, route(robot), "test")[None]
    dl = path - robot.rest_tendon_length
    moved = what.sweep(row, what.memory(1, 4), dl[None], np.full(12, 0.05), route(robot))[0]
    sim, base = Simulator(having(robot, name, **values), dt=0.05), Simulator(robot, dt=0.05)
    for there, here in zip(path, moved + robot.rest_tendon_length, strict=True):
        assert_allclose(sim.step(there).tip_position, base.step(here).tip_position, atol=1e-11)
