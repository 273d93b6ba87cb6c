"""Rods of modes at rest: beside the observer, and closed forms of stretch and shear."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_bvp

from fastrod import Modal, Modes, Observer, Robot, Segment, Simulator, load_robot

FINE = Modes(6, 4, strain=3)
PULLED = np.array([[-0.002, 0.0, 0.002, 0.0], [-0.001, 0.001, 0.001, -0.001], [0.0, 0.0, 0.0, 0.0]])
PULLED_TWO = np.zeros((3, 6))
PULLED_TWO[0] = [-0.001, 0.0005, 0.0005, -0.0015, 0.001, 0.0005]
PULLED_TWO[1, 3:] = [0.001, -0.001, 0.0]
LINE = np.linspace(0.0, 2.0, 5)[:, None] * np.array([1.0, 0.0, 0.0]) * np.ones((3, 2, 1, 1))


def one() -> Robot:
    return load_robot("prototype")


def two() -> Robot:
    """The prototype's segment twice, with a weight."""
    segment = replace(one().segments[0], line_density=0.1)
    angles = [2.0 * np.pi / 3.0 * i for i in range(3)]
    tendon = segment.tendons[0]
    first = tuple(replace(tendon, angle=a) for a in angles)
    second = tuple(replace(tendon, offset=(0.0075, 0.0075), angle=(a + 0.3, a + 0.3)) for a in angles)
    segments = replace(segment, tendons=first), replace(segment, tendons=second)
    return replace(one(), name="two", segments=segments)


def longer() -> Robot:
    return replace(one(), segments=(replace(one().segments[0], extension=(-0.01, 0.02)),))


def with_effect(name: str, **values: float) -> Robot:
    return replace(one(), effects=({"name": name, **values},))


def pulled_by_force() -> Robot:
    segment = replace(one().segments[0], mode="tendon_tension")
    return replace(one(), segments=(segment,))


POINTS = ((0.1, (0.1, 0.0, 0.0)), (0.05, (0.0, 0.2, 0.0)))
CASES: dict[str, tuple[Robot, Modes, dict[str, Any], float]] = {
    "bend": (one(), FINE, {}, 1e-8),
    "tip force": (one(), FINE, {"tip_force": (0.3, 0.1, -0.1)}, 1e-7),
    "tip moment": (one(), FINE, {"tip_moment": (0.003, 0.001, -0.001)}, 1e-7),
    "follower": (one(), FINE, {"follower_tip_force": (0.3, 0.1, -0.2)}, 1e-7),
    "tension": (pulled_by_force(), FINE, {"tip_force": (0.1, 0.0, 0.0)}, 1e-7),
    "two segments": (two(), FINE, {"tip_force": (0.05, 0.0, 0.0)}, 1e-7),
    "base": (two(), FINE, {"base_pose": (0.1, 0.2, 0.3, np.cos(0.5), np.sin(0.5), 0.0, 0.0)}, 1e-7),
    "line force": (two(), FINE, {"line_force": LINE}, 1e-7),
    "point forces": (two(), FINE, {"point_force": POINTS}, 5e-7),
    "point forces on a joint of pieces": (two(), Modes(6, 4, pieces=7), {"point_force": POINTS}, 2e-8),
    "line and point force": (two(), FINE, {"line_force": LINE, "point_force": POINTS[:1]}, 5e-7),
    "longer": (longer(), FINE, {"extension": (0.01,)}, 1e-7),
    "stiffer beyond": (with_effect("stiffness_taper", slope=0.5), FINE, {"tip_force": (0.2, 0.0, 0.0)}, 1e-6),
    "bent at rest": (with_effect("precurvature", bow_x=3.0, uniform_y=1.0), FINE, {}, 1e-7),
}


def inputs_of(robot: Robot, given: dict[str, Any]) -> dict[str, Any]:
    if robot.segments[0].mode == "tendon_tension":
        return {"tension": 100.0 * (PULLED + 0.002), **given}
    more = 0.01 if "extension" in given else 0.0
    pulled = PULLED if robot.n_tendons == 4 else PULLED_TWO
    return {"tendon_length": robot.rest_tendon_length + pulled + more, **given}


@pytest.mark.parametrize("name", CASES)
def test_modes_and_observer_come_to_the_same_rest(name: str) -> None:
    robot, modes, given, tolerance = CASES[name]
    states, tips = [], []
    for kind in (Observer(), Modal(modes=modes)):
        sim = Simulator(robot, 3, points_per_segment=40, solver=kind)
        states.append(sim.settle(**inputs_of(robot, given)))
        assert states[-1].ok.all(), states[-1].problems
        tips.append(sim.shape(np.array([0.02, 0.035, 0.061])))
    observer, modal = states
    assert_allclose(modal.tip_position, observer.tip_position, rtol=0, atol=tolerance)
    assert_allclose(modal.tip_rotation, observer.tip_rotation, rtol=0, atol=100.0 * tolerance)
    assert_allclose(modal.tension, observer.tension, rtol=0, atol=2e-4)
    assert_allclose(modal.path_length, observer.path_length, rtol=0, atol=2e-9)
    assert_allclose(modal.base_wrench, observer.base_wrench, rtol=0, atol=2e-7)
    assert_allclose(tips[1].position, tips[0].position, rtol=0, atol=2e-6)
    if "point_force" not in given:  # the observer's nodes then stand under them
        assert_allclose(modal.position, observer.position, rtol=0, atol=1e-6)
        assert_allclose(modal.force, observer.force, rtol=0, atol=1e-6)
        assert_allclose(modal.arclength, observer.arclength, rtol=0, atol=1e-12)


ANSWERS = ["tip force", "tip moment", "follower", "two segments", "point forces", "longer", "tension"]
ANSWERS += ["bent at rest"]


@pytest.mark.parametrize("name", ANSWERS)
def test_modes_and_observer_answer_alike(name: str) -> None:
    robot, _, given, _ = CASES[name]
    found = []
    for kind in (Observer(), Modal(modes=Modes(6, 4, pieces=3))):
        sim = Simulator(robot, 3, points_per_segment=40, solver=kind)
        sim.settle(**inputs_of(robot, given))
        compliance = sim.compliance(moments=True)
        found.append((sim.jacobian(turning=True), compliance[..., :3], compliance[..., 3:]))
    for modal, observer in zip(found[1], found[0], strict=True):
        assert_allclose(modal, observer, rtol=0, atol=3e-6 * np.abs(observer).max())


LENGTH, EI, GJ, EA, GA = 0.2, 0.01, 0.008, 500.0, 200.0


def beam(**stiffness: float) -> Robot:
    segment = Segment(
        length=LENGTH, bending_stiffness=(EI, EI), torsional_stiffness=GJ, mode="passive", **stiffness
    )
    return Robot(name="beam", segments=(segment,))


def test_a_rod_stretches_by_force_over_stiffness() -> None:
    force = 3.0
    sim = Simulator(beam(axial_stiffness=EA), solver=Modal(modes=Modes(4, 2, strain=1)))
    state = sim.settle(tip_force=(0.0, 0.0, force))
    assert_allclose(state.tip_position[0], [0.0, 0.0, LENGTH * (1.0 + force / EA)], atol=1e-12)
    assert state.strain is not None
    assert_allclose(state.strain[0], np.tile([0.0, 0.0, force / EA], (sim.n_points, 1)), atol=1e-12)


def test_a_rod_deflects_as_timoshenko_says() -> None:
    """A small force: F l^3 / 3 EI by bend, F l / GA by shear."""
    force = 1e-4
    tips = [
        Simulator(beam(**more), solver=Modal(modes=Modes(4, 2)))
        .settle(tip_force=(force, 0.0, 0.0))
        .tip_position[0, 0]
        for more in ({}, {"shear_stiffness": GA})
    ]
    assert_allclose(tips[0], force * LENGTH**3 / (3.0 * EI), rtol=1e-6)
    assert_allclose(tips[1] - tips[0], force * LENGTH / GA, rtol=1e-5)


def test_a_rod_that_shears_and_stretches_bends_as_reissners() -> None:
    """theta' = M / EI, M' = -(1 + e) Q + g N, with the axial and shear force N and Q of a dead force."""
    fx, fz = 1.2, -0.4

    def strains(theta: Any) -> tuple[Any, Any, Any, Any]:
        normal, shear = fx * np.sin(theta) + fz * np.cos(theta), fx * np.cos(theta) - fz * np.sin(theta)
        return normal, shear, normal / EA, shear / GA

    def slopes(_: Any, y: Any) -> Any:
        theta, moment = y[2], y[3]
        normal, shear, stretch, slide = strains(theta)
        along = 1.0 + stretch
        x = along * np.sin(theta) + slide * np.cos(theta)
        z = along * np.cos(theta) - slide * np.sin(theta)
        return np.stack([x, z, moment / EI, -along * shear + slide * normal])

    s = np.linspace(0.0, LENGTH, 41)
    guess = np.stack([0.0 * s, s, 4.0 * s, fx * (LENGTH - s)])
    exact = solve_bvp(
        slopes, lambda a, b: np.array([a[0], a[1], a[2], b[3]]), s, guess, tol=1e-11, max_nodes=100000
    )
    assert exact.success
    assert exact.y[2, -1] > 1.4  # rad: a large bend
    fine = Modal(modes=Modes(4, 2, strain=3, pieces=4))
    sim = Simulator(beam(axial_stiffness=EA, shear_stiffness=GA), solver=fine)
    state = sim.settle(tip_force=(fx, 0.0, fz))
    assert_allclose(state.tip_position[0, [0, 2]], exact.y[:2, -1], rtol=0, atol=2e-8)


def test_the_faster_solver_is_chosen_and_a_wrong_one_refused() -> None:
    assert Simulator(one()).solver == "observer"
    assert Simulator(beam(axial_stiffness=EA)).solver == "modal"
