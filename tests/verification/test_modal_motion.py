"""Rods in motion: frequencies, order in time, energy, a base that moves."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from numpy.testing import assert_allclose
from scipy.linalg import eigh
from scipy.optimize import brentq

from fastrod import Modal, Modes, Robot, Segment, Simulator, load_robot
from fastrod.kernels.jit import LANES
from fastrod.model.robot import Lump

LENGTH, EI, GJ, DENSITY = 0.4, 0.02, 0.015, 0.05
BENDING = (1.8751040687, 4.6940911330, 7.8547574382)
"""beta l of a cantilever: cosh x cos x = -1 (Rao 2007, table 8.1)."""


def beam(*lumps: Lump, **more: Any) -> Robot:
    numbers = {"line_density": DENSITY, "body_radius": 1e-5, **more}
    segment = Segment(
        length=LENGTH,
        bending_stiffness=(EI, EI),
        torsional_stiffness=GJ,
        mode="passive",
        lumps=lumps,
        **numbers,
    )
    return Robot(name="beam", segments=(segment,), gravity=(0.0, 0.0, 0.0))


def moving(robot: Robot, dt: float = 1e-3, **options: Any) -> Simulator:
    """With these options of `Modal`."""
    return Simulator(robot, dt=dt, solver=Modal(dynamics=True, **options), points_per_segment=4)


def exact_frequencies(mass: float) -> np.ndarray:
    """Hz, of a cantilever with a mass on its tip: 1 + cos cosh = m x (sin cosh - cos sinh), m relative."""
    m = mass / (DENSITY * LENGTH)

    def off(x: float) -> float:
        beyond = m * x * (math.sin(x) * math.cosh(x) - math.cos(x) * math.sinh(x))
        return 1.0 + math.cos(x) * math.cosh(x) - beyond

    grid = np.linspace(0.1, 9.0, 2000)
    signs = np.sign([off(x) for x in grid])
    roots = [brentq(off, grid[k], grid[k + 1], xtol=1e-13) for k in np.flatnonzero(np.diff(signs))]
    x = np.array(roots[:3])
    return np.asarray(x**2 * math.sqrt(EI / (DENSITY * LENGTH**4)) / (2.0 * math.pi))


@pytest.mark.parametrize(("pieces", "third"), [(1, 1e-3), (2, 1e-4)])
@pytest.mark.parametrize("mass", [0.0, 0.02])
def test_it_rings_as_a_cantilever_does(mass: float, pieces: int, third: float) -> None:
    lumps = (Lump(at=LENGTH, mass=mass),) if mass else ()
    sim = moving(beam(*lumps), modes=Modes(6, 4, pieces=pieces))
    sim.settle()
    expected = np.repeat(exact_frequencies(mass), 2)  # both directions
    if not mass:
        assert_allclose(
            expected[::2], np.array(BENDING) ** 2 * math.sqrt(EI / DENSITY) / LENGTH**2 / (2.0 * math.pi)
        )
    found = sim.frequencies(16)[0]
    found = np.array([found[np.abs(found - f).argmin()] for f in expected])
    assert_allclose(found[:4], expected[:4], rtol=1e-4)
    assert_allclose(found[4:], expected[4:], rtol=third)


def test_torsion_rings_by_the_radius_of_gyration() -> None:
    """c / 4 l of a clamped rod, c^2 = GJ / (2 rho r^2); a body that is wider for contact rings alike."""
    radius, stiff, density, length = 0.01, 0.008, 0.05, 0.1
    wide = Segment(
        length=length,
        bending_stiffness=(0.5, 0.5),
        torsional_stiffness=stiff,
        line_density=density,
        body_radius=0.03,
        gyration_radius=radius,
        mode="passive",
    )
    robot = Robot(name="wide", segments=(wide,), gravity=(0.0, 0.0, 0.0))
    sim = Simulator(robot, solver=Modal(dynamics=True, modes=Modes(4, 5)))
    sim.settle()
    expected = np.sqrt(stiff / (2.0 * density)) / (4.0 * length * radius)
    assert_allclose(np.abs(sim.frequencies(8)[0] - expected).min(), 0.0, atol=1e-4 * expected)


def test_a_disk_slows_torsion_and_bend_as_its_inertia_says() -> None:
    """A light rod with a heavy disk: GJ / l against I_3; 4 EI / l and 12 EI / l^3 of a beam's end."""
    light = beam(Lump(at=LENGTH, mass=0.3, inertia=(2e-3, 3e-3, 4.5e-3)), line_density=1e-7)
    sim = moving(light, modes=Modes(4, 2))
    sim.settle()
    found = sim.frequencies(8)[0]
    torsion = math.sqrt(GJ / LENGTH / 4.5e-3) / (2.0 * math.pi)
    expected = [torsion]
    for inertia in (2e-3, 3e-3):
        k = EI / LENGTH**3 * np.array([[12.0, -6.0 * LENGTH], [-6.0 * LENGTH, 4.0 * LENGTH**2]])
        square = np.linalg.eigvals(np.linalg.inv(np.diag([0.3, inertia])) @ k)
        expected += list(np.sqrt(square) / (2.0 * math.pi))
    assert_allclose([found[np.abs(found - f).argmin()] for f in expected], expected, rtol=1e-4)


def release(sim: Simulator, n: int, force: float = 0.3) -> np.ndarray:
    """(n + 1, 3) tips after a force was let go."""
    states = [sim.settle(tip_force=(force, 0.0, 0.0)), *(sim.step() for _ in range(n))]
    return np.array([state.tip_position[0] for state in states])


def ramp(sim: Simulator, n: int, force: float = 0.3) -> np.ndarray:
    """(n + 1, 3) tips while a force grows smoothly, and after."""
    tips = [sim.settle().tip_position[0]]
    for k in range(n):
        x = min((k + 1) * sim.dt / 0.05, 1.0)
        state = sim.step(tip_force=(force * x * x * (3.0 - 2.0 * x), 0.0, 0.0))
        tips.append(state.tip_position[0])
    return np.array(tips)


def trapezoid(sim: Simulator, n: int, force: float = 0.3) -> np.ndarray:
    """(n + 1, 3) tips while a force grows evenly, and stays."""
    forces = force * np.minimum((np.arange(n) + 1.0) * sim.dt / 0.05, 1.0)
    states = [sim.settle(), *(sim.step(tip_force=(now, 0.0, 0.0)) for now in forces)]
    return np.array([state.tip_position[0] for state in states])


@pytest.mark.study
@pytest.mark.parametrize(
    ("story", "how"),
    [
        (release, {"scheme": "bdf2"}),
        (release, {}),
        (ramp, {"scheme": "bdf2"}),
        (ramp, {}),
        (trapezoid, {"jumps": False}),
    ],
)
def test_it_is_second_order_in_time_after_a_sudden_load_too(story: Any, how: dict[str, Any]) -> None:
    robot, end, most, errors = beam(), 0.1, 6400, []
    how = {"modes": Modes(2, 1)} | how
    fine = story(moving(robot, end / most, **how), most)
    for n in (400, 800):
        tips = story(moving(robot, end / n, **how), n)
        errors.append(np.sqrt(((tips - fine[:: most // n]) ** 2).sum(1).mean()))
    assert_allclose(np.log2(errors[0] / errors[1]), 2.0, atol=0.1)


def test_inputs_that_rest_but_for_rounding_have_not_jumped() -> None:
    """A step after a jump begins with another acceleration, which is felt in a rod that swings."""
    robot = load_robot("prototype")
    (segment,) = robot.segments
    robot = replace(robot, segments=(replace(segment, line_density=0.1, damping_time=2e-3),))
    rest, tips = robot.rest_tendon_length, []
    for last in (0.0, 1.0):
        sim = Simulator(robot, dt=4e-3, dynamics=True, points_per_segment=4, outputs="tip")
        sim.settle(rest + 2e-3 * np.array([1.0, 0.0, -1.0, 0.0]))
        for k in range(40):
            state = sim.step(rest + last * (k % 5 == 4) * np.spacing(rest))
        tips.append(state.tip_position[0])
    assert_allclose(tips[0], tips[1], atol=1e-12)


def first_mode(x: np.ndarray) -> np.ndarray:
    """First mode of a cantilever, at fractions of its length."""
    b = BENDING[0]
    sigma = (math.sinh(b) - math.sin(b)) / (math.cosh(b) + math.cos(b))
    return np.asarray(np.cosh(b * x) - np.cos(b * x) - sigma * (np.sinh(b * x) - np.sin(b * x)))


def energies(sim: Simulator, n: int) -> np.ndarray:
    """(n,) kinetic and strain energy after each step."""
    states = [sim.step() for _ in range(n)]
    return np.array([state.kinetic_energy[0] + state.strain_energy[0] for state in states])  # type: ignore[index]


def test_energy_is_kept_over_ten_periods() -> None:
    """At 100 steps a period, of the mode whose period it is; a load of its shape bends the rod into it."""
    period = 1.0 / exact_frequencies(0.0)[0]
    sim = moving(beam(), period / 100.0)
    load = first_mode(np.linspace(0.0, 1.0, 33))[:, None] * np.array([0.02, 0.0, 0.0])
    began = sim.settle(line_force=load[None]).strain_energy
    assert began is not None
    left = energies(sim, 1000) / began[0]
    assert left.max() < 1.0 + 1e-9
    assert left[-1] > 1.0 - 1e-3


def southwell(rate: float) -> float:
    """Hz, out of the plane of rotation [rad/s] of a cantilever from the axis on: Galerkin's method."""
    basis = [Polynomial([0.0] * (2 + k) + [1.0]) for k in range(8)]
    pull = Polynomial([0.5, 0.0, -0.5])
    n = len(basis)
    mass, bend, tight = np.zeros((3, n, n))
    for i, a in enumerate(basis):
        for j, b in enumerate(basis):
            mass[i, j] = (a * b).integ()(1.0)
            bend[i, j] = (a.deriv(2) * b.deriv(2)).integ()(1.0)
            tight[i, j] = (pull * a.deriv() * b.deriv()).integ()(1.0)
    stiffness = EI / (DENSITY * LENGTH**4) * bend + rate**2 * tight
    return float(np.sqrt(eigh(stiffness, mass, eigvals_only=True)[0]) / (2.0 * math.pi))


@pytest.mark.parametrize("scheme", ["bdf1", "bdf2", "generalized_alpha"])
def test_a_rod_with_damping_and_no_mass_creeps(scheme: Any) -> None:
    # tau y' + y = F l^3 / (3 EI): to first order in the step after a sudden load
    tau, force = 0.05, 1e-4
    segment = Segment(
        length=0.07,
        bending_stiffness=(0.0022, 0.0022),
        torsional_stiffness=0.001,
        mode="passive",
        damping_time=tau,
    )
    rest, off = force * 0.07**3 / (3.0 * 0.0022), []
    for dt in (5e-3, 2.5e-3):
        sim = Simulator(Robot(name="light", segments=(segment,)), dt=dt, dynamics=True, scheme=scheme)
        sim.settle()
        y = [sim.step(tip_force=(force, 0.0, 0.0)).tip_position[0, 0] for _ in range(round(0.2 / dt))]
        off.append(np.abs(np.array(y) / rest - 1.0 + np.exp(-dt * np.arange(1, len(y) + 1) / tau)).max())
        assert not sim.momentum().any()
    assert off[0] < 0.06
    assert math.log2(off[0] / off[1]) > 0.8


@pytest.mark.study
def test_a_turning_cantilever_is_stiffer() -> None:
    """It lies along x and turns about z, up to speed within six periods; a force along z then lets go."""
    f0 = southwell(0.0)
    assert_allclose(f0, exact_frequencies(0.0)[0], rtol=1e-6)
    rate, per, up = math.pi * f0, 200, 6
    dt = 1.0 / f0 / per
    sim = moving(beam(), dt, rho=0.9)

    def pose(angle: float) -> list[float]:
        c, s, h = math.cos(0.5 * angle), math.sin(0.5 * angle), math.sqrt(0.5)
        return [0.0, 0.0, 0.0, c * h, -s * h, c * h, s * h]

    sim.settle(base_pose=pose(0.0), tip_force=(0.0, 0.0, 1e-3))
    heights = []
    for k in range(1, per * (up + 8) + 1):
        x = min(k / (per * up), 1.0)
        angle = rate * dt * (per * up * (x**3 - 0.5 * x**4) + max(k - per * up, 0))
        force = (0.0, 0.0, 1e-3 if x < 1.0 else 0.0)
        state = sim.step(base_pose=pose(angle), tip_force=force)
        if x == 1.0:
            heights.append(state.tip_position[0, 2])
    z = np.array(heights)
    falls = np.flatnonzero((z[:-1] > 0.0) & (z[1:] <= 0.0))
    exact = falls + z[falls] / (z[falls] - z[falls + 1])
    found = (len(exact) - 1) / ((exact[-1] - exact[0]) * dt)
    assert southwell(rate) > 1.1 * f0
    assert_allclose(found, southwell(rate), rtol=1e-3)


def test_a_free_fall_of_the_base_is_weightless() -> None:
    robot = replace(beam(), gravity=(0.0, 0.0, -9.81))
    sim = moving(robot, 1e-3)
    sideways = [0.0, 0.0, 0.0, math.cos(math.pi / 4.0), 0.0, math.sin(math.pi / 4.0), 0.0]
    state = sim.settle(base_pose=sideways, gravity=(0.0, 0.0, 0.0))
    for k in range(1, 51):
        z = -0.5 * 9.81 * (k * 1e-3) ** 2
        state = sim.step(base_pose=[0.0, 0.0, z, *sideways[3:]], gravity=(0.0, 0.0, -9.81))
    assert_allclose(state.tip_position[0] - [0.0, 0.0, z], [LENGTH, 0.0, 0.0], atol=1e-7)
    assert state.velocity is not None
    assert_allclose(state.velocity[0, :, 2], -9.81 * 0.05, rtol=2e-3)


@pytest.mark.study
def test_two_threads_give_what_one_gives() -> None:
    """To the last bit, in a batch that does not divide evenly into chunks and threads."""
    n, robot = 6 * LANES + 3, replace(load_robot("prototype"), gravity=(0.0, 0.0, 0.0))
    robot = replace(robot, segments=tuple(replace(s, line_density=0.1) for s in robot.segments))
    pull = np.random.default_rng(5).uniform(-1e-3, 1e-3, (n, robot.n_tendons))
    tips = []
    for threads in (1, 2):
        sim = Simulator(robot, n, 1e-3, dynamics=True, threads=threads, outputs="tip")
        sim.settle(robot.rest_tendon_length)
        for k in range(1, 6):
            state = sim.step(robot.rest_tendon_length + 0.2 * k * pull)
            assert state.ok.all()
        tips.append(state.tip_position)
    assert len(np.unique(tips[0], axis=0)) == n
    np.testing.assert_array_equal(tips[0], tips[1])


# tendons hold this rod: its place is wrong by what the acceleration of BDF1 is, of the first order
@pytest.mark.study
@pytest.mark.parametrize(("scheme", "order"), [("bdf1", 1), ("bdf2", 3), ("generalized_alpha", 3)])
def test_the_error_of_a_step_is_reported(scheme: Any, order: int) -> None:
    robot = load_robot("prototype")
    robot = replace(robot, segments=(replace(robot.segments[0], line_density=0.1),))
    pull, end = np.array([-1.0, 0.0, 1.0, 0.0]), 0.064

    def run(dt: float, kind: Any, estimate: bool = True) -> tuple[Any, Any]:
        """Tip at the end, and the errors of all steps."""
        sim, errors = Simulator(robot, 1, dt=dt, dynamics=True, scheme=kind), []
        sim.settle(robot.rest_tendon_length)
        for k in range(round(end / dt)):
            swing = 2e-3 * (1.0 - math.cos(30.0 * (k + 1) * dt))
            lengths = robot.rest_tendon_length + swing * pull
            state = sim.step(lengths, passes=3, estimate_error=estimate)
            errors.append(state.step_error)
        return state.tip_position[0], errors

    exact, none = run(1.25e-4, "generalized_alpha", False)
    assert none == [None] * len(none)
    coarse, fine = run(2e-3, scheme), run(1e-3, scheme)
    np.testing.assert_array_equal(coarse[0], run(2e-3, scheme, False)[0])  # to look at it changes nothing
    slope = math.log2(np.median(coarse[1]) / np.median(fine[1]))
    assert abs(slope - order) < 0.3
    # errors of steps add up, and what swings keeps them
    assert 0.1 * np.sum(coarse[1]) < np.linalg.norm(coarse[0] - exact) < 3.0 * np.sum(coarse[1])
