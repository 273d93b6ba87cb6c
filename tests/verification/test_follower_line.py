"""Line forces that follow the rod: at rest against an integration from the free tip, in motion, derivatives.

In the material frame n' = -u x n - f and m' = -u x m - e3 x n hold with f given, and a free tip has
n = m = 0: an initial value problem from the tip to the base, without a boundary value to find (Antman 2005,
VIII).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from fastrod import Modal, Modes, Robot, Segment, Simulator, Tendon, Tips
from fastrod.errors import InputError

LENGTH, STIFFNESS = 0.2, np.array([0.02, 0.03, 0.015])
FINE = Modes(6, 4, pieces=2)


def rod(density: float = 0.0, **more: Any) -> Robot:
    """Its tendons are slack: they hang 1 cm loose."""
    tendon = Tendon(offset=0.008, angle=0.0, compliance=1e-3, unilateral=True)
    segment = Segment(
        length=LENGTH,
        bending_stiffness=(STIFFNESS[0], STIFFNESS[1]),
        torsional_stiffness=STIFFNESS[2],
        body_radius=0.01,
        line_density=density,
        tendons=tuple(replace(tendon, angle=a) for a in (0.0, 2.0, -2.0)),
        **more,
    )
    return Robot(name="followed", segments=(segment,), gravity=(0.0, 0.0, 0.0))


LOOSE = rod().rest_tendon_length + 0.01


def tip_of(force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tip, position and rotation, under `force` (points, 3) in the material frame, linear between."""

    def line(s: float) -> np.ndarray:
        at = s / LENGTH * (len(force) - 1)
        return np.array([np.interp(at, np.arange(len(force)), column) for column in force.T])

    def statics(s: float, y: np.ndarray) -> np.ndarray:
        u = y[3:] / STIFFNESS
        return np.concatenate(
            [-np.cross(u, y[:3]) - line(s), -np.cross(u, y[3:]) - np.cross((0.0, 0.0, 1.0), y[:3])]
        )

    def shape(s: float, y: np.ndarray) -> np.ndarray:
        x, y_, z = loads.sol(s)[3:] / STIFFNESS
        r = y[3:].reshape(3, 3)
        turning = np.array([[0.0, -z, y_], [z, 0.0, -x], [-y_, x, 0.0]])
        return np.concatenate([r[:, 2], (r @ turning).ravel()])

    how = {"rtol": 1e-12, "atol": 1e-13}
    loads = solve_ivp(statics, (LENGTH, 0.0), np.zeros(6), dense_output=True, **how)
    start = np.concatenate([np.zeros(3), np.eye(3).ravel()])
    end = solve_ivp(shape, (0.0, LENGTH), start, **how).y[:, -1]
    return end[:3], end[3:].reshape(3, 3)


@pytest.mark.study
@pytest.mark.parametrize(
    "force",
    [[(3.0, 0.0, 0.0)] * 2, [(4.0, 0.5, -1.0)] * 2, [(0.0, 0.0, -6.0), (3.0, -2.0, 1.0)]],
    ids=["across", "all", "rising"],
)
def test_a_cantilever_beside_an_integration_from_its_tip(force: list[tuple[float, float, float]]) -> None:
    """Bends of 0.1 to 0.3 of the length."""
    given = np.array(force)
    state = Simulator(rod(), solver=Modal(modes=FINE)).settle(LOOSE, follower_line_force=given[None])
    position, rotation = tip_of(given)
    assert state.ok.all()
    assert np.linalg.norm(position - (0.0, 0.0, LENGTH)) > 0.01
    assert_allclose(state.tip_position[0], position, atol=2e-7)
    assert_allclose(Rotation.from_matrix(state.tip_rotation[0].T @ rotation).magnitude(), 0.0, atol=5e-6)


def test_one_force_is_that_at_every_point() -> None:
    sim = Simulator(rod(), n_robots=2, solver=Modal(modes=FINE))
    force = np.array([[2.0, 0.0, 0.0], [0.0, 1.0, -1.0]])
    one = sim.settle(LOOSE, follower_line_force=force)
    each = sim.settle(LOOSE, follower_line_force=np.repeat(force[:, None, None], 5, axis=2))
    assert_allclose(each.tip_position, one.tip_position, atol=1e-11)
    assert np.ptp(one.tip_position, axis=0).max() > 0.01


def test_forces_and_moments_on_the_base_are_those_of_the_load() -> None:
    """Uniform f: the base carries the integral of R f, and of r x R f."""
    f = np.array([2.0, 1.0, -0.5])
    state = Simulator(rod(), solver=Modal(modes=FINE), points_per_segment=80).settle(
        LOOSE, follower_line_force=f
    )
    world = state.rotation[0] @ f
    force = np.trapezoid(world, state.arclength[0], axis=0)
    moment = np.trapezoid(np.cross(state.position[0], world), state.arclength[0], axis=0)
    assert_allclose(state.base_wrench[0], np.concatenate([force, moment]), rtol=2e-3, atol=1e-5)


def test_the_jacobian_has_the_rotation_of_the_load() -> None:
    """Taut tendons and a load that bends by 0.3 rad, against differences."""
    base, step = rod().rest_tendon_length - np.array([2e-3, 1e-3, 0.0]), 1e-6
    sim = Simulator(rod(), solver=Modal(modes=FINE))
    load = {"follower_line_force": (6.0, 2.0, -4.0)}
    sim.settle(base, **load)
    found = sim.jacobian()[0, :3, :3]
    for k in range(3):
        change = np.eye(3)[k] * step
        ends = [sim.settle(base + s * change, **load, tolerance=1e-12).tip_position[0] for s in (1, -1)]
        assert_allclose(found[:, k], (ends[0] - ends[1]) / (2.0 * step), rtol=1e-5, atol=1e-6)


@pytest.mark.study
def test_in_motion_it_comes_to_rest_where_it_rests() -> None:
    """A load that begins suddenly, much damping."""
    robot = rod(density=0.3, damping_time=0.05)
    sim = Simulator(robot, dt=2e-3, solver=Modal(dynamics=True, modes=FINE))
    sim.settle(LOOSE)
    load = {"follower_line_force": (2.0, 1.0, -1.0)}
    for _ in range(1500):
        state = sim.step(LOOSE, **load)
    still = Simulator(robot, solver=Modal(modes=FINE)).settle(LOOSE, **load)
    assert state.kinetic_energy[0] < 1e-12
    assert_allclose(state.tip_position, still.tip_position, atol=1e-7)


@pytest.mark.study
def test_a_step_has_second_order() -> None:
    """A load grows: by how much the tip moves as the step is halved, and halved again."""
    robot = rod(density=0.3, damping_time=0.01)
    tips = {}
    for n in (160, 320, 640, 1280):
        sim = Simulator(robot, dt=0.04 / n, solver=Modal(dynamics=True, modes=FINE))
        sim.settle(LOOSE, follower_line_force=(0.0, 0.0, 0.0))
        for k in range(n):
            force = np.array([3.0, 1.0, 0.0]) * ((k + 1) / n) ** 2
            state = sim.step(LOOSE, follower_line_force=force, passes=6)
        tips[n] = state.tip_position[0]
    changes = [np.linalg.norm(tips[n] - tips[2 * n]) for n in (160, 320, 640)]
    slopes = np.log2(np.array(changes[:-1]) / changes[1:])
    assert_allclose(slopes, 2.0, atol=0.1)


def test_the_adjoint_knows_the_rotation_of_the_load() -> None:
    robot = rod(density=0.3, damping_time=0.01)
    weight = np.array([0.3, -1.0, 0.7])

    def tip(load: np.ndarray, record: bool) -> tuple[float, Any]:
        sim = Simulator(robot, dynamics=True, dt=2e-3)
        if record:
            sim.record()
        sim.settle(LOOSE, follower_line_force=load)
        for k in range(5):
            state = sim.step(LOOSE, follower_line_force=load * (1.0 + 0.1 * k), passes=12)
        return float(state.tip_position[0] @ weight), sim

    load, step = np.array([4.0, 1.0, -2.0]), 1e-4
    _, sim = tip(load, True)

    def cost(tips: Tips) -> tuple[np.ndarray, Tips]:
        seed = np.zeros_like(tips.position)
        seed[-1] = weight
        return (tips.position * seed).sum((0, 2)), Tips(seed)

    found = sim.adjoint(cost, inputs=("follower_line_force",)).inputs["follower_line_force"][:, 0]
    scale = np.concatenate([[1.0], 1.0 + 0.1 * np.arange(5)])
    for k in range(3):
        change = step * np.eye(3)[k]
        slope = (tip(load + change, False)[0] - tip(load - change, False)[0]) / (2.0 * step)
        assert_allclose(scale @ found[:, k], slope, rtol=1e-5)


def test_what_is_wrong_is_one_sentence() -> None:
    with pytest.raises(InputError, match="the observer has line forces of the world only; take solver='mod"):
        Simulator(rod()).settle(LOOSE, follower_line_force=(1.0, 0.0, 0.0))
    sim = Simulator(rod(), solver="modal")
    with pytest.raises(InputError, match=r"follower_line_force has shape \(2,\); it must be"):
        sim.settle(LOOSE, follower_line_force=(1.0, 0.0))
    with pytest.raises(InputError, match="follower_line_force has 1 points a segment; give two or more"):
        sim.settle(LOOSE, follower_line_force=np.zeros((1, 1, 3)))
    with pytest.raises(InputError, match="follower_line_force holds a value that is not finite"):
        sim.settle(LOOSE, follower_line_force=(np.nan, 0.0, 0.0))
