"""Trajectories of rods in motion: derivatives forward and adjoint, against differences and each other."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fastrod import Robot, Segment, Simulator, Tendon
from fastrod.errors import InputError
from fastrod.model.robot import Lump
from fastrod.solver.tape import Tape, Tips, number, with_number

DT = 1e-3
MOMENT = (1e-3, -5e-4, 5e-4)  # N m


def rod(**changes: Any) -> Robot:
    tendons = tuple(
        Tendon(offset=0.006, angle=k * np.pi / 2, compliance=2e-4, pretension=0.5) for k in range(3)
    )
    known: dict[str, Any] = {
        "length": 0.12,
        "bending_stiffness": (2e-3, 2.5e-3),
        "torsional_stiffness": 1e-3,
        "line_density": 0.08,
        "damping_time": 2e-3,
        "body_radius": 0.008,
        "tendons": tendons,
        "lumps": (Lump(at=0.09, mass=0.004, inertia=(1e-7, 1e-7, 2e-7)),),
    }
    return Robot(name="rod", segments=(Segment(**known | changes),))


def two() -> Robot:
    second = rod(length=0.08, tendons=(Tendon(offset=0.005, angle=0.4, compliance=2e-4),), lumps=())
    return Robot(name="two", segments=(*rod().segments, *second.segments))


def lengths(robot: Robot, n_calls: int, seed: int = 0) -> np.ndarray:
    """(n_calls, n_tendons) smooth, from the rest."""
    rng = np.random.default_rng(seed)
    t = np.arange(n_calls)[:, None] * DT
    waves = rng.uniform(0.5, 1.0, robot.n_tendons) * 2e-3 * (1.0 - np.cos(60.0 * t))
    return np.asarray(robot.rest_tendon_length - waves)


def run(
    robot: Robot, tendon: np.ndarray, force: np.ndarray | None = None, **options: Any
) -> tuple[Simulator, Tape]:
    sim = Simulator(robot, 1, dt=DT, dynamics=True, outputs="tip", **options)
    trajectory = sim.record()
    force = np.zeros((len(tendon), 3)) if force is None else force
    sim.settle(tendon[0], tip_force=force[0], tip_moment=MOMENT, tolerance=1e-12)
    for length, load in zip(tendon[1:], force[1:], strict=True):
        sim.step(length, tip_force=load)
    return sim, trajectory


def cost(tips: Tips) -> tuple[np.ndarray, Tips]:
    """Something of everything."""
    assert tips.rotation is not None
    assert tips.velocity is not None
    aim = np.array([0.01, -0.02, 0.1])
    away, lean = tips.position - aim, tips.rotation[..., 0, 2]
    value = 50.0 * (away**2).sum((0, 2)) + 0.02 * (tips.velocity**2).sum((0, 2)) + 0.1 * (lean**2).sum(0)
    rotation = np.zeros_like(tips.rotation)
    rotation[..., 0, 2] = 0.2 * lean
    return value, Tips(100.0 * away, rotation, 0.04 * tips.velocity)


def difference(change: Any, step: float, **options: Any) -> float:
    """Difference of the cost, to the fourth order: `change` returns robot, tendons and forces at a signed
    step."""

    def slope(h: float) -> float:
        up, down = (float(cost(run(*change(end), **options)[1].tips())[0][0]) for end in (h, -h))
        return (up - down) / (2.0 * h)

    return (4.0 * slope(step) - slope(2.0 * step)) / 3.0


PARAMETERS = (
    "segment.1.line_density",
    "segment.1.damping_time",
    "segment.1.bending_stiffness.1",
    "segment.1.length",
    "tendon.1.compliance",
    "tendon.2.pretension",
    "gravity.1",
)


@pytest.mark.study
@pytest.mark.parametrize("scheme", ["bdf1", "bdf2", "generalized_alpha"])
def test_numbers_of_the_robot(scheme: str) -> None:
    robot = with_number(rod(), "gravity.1", 2.0)
    tendon = lengths(robot, 200)
    sim, trajectory = run(robot, tendon, scheme=scheme)
    back = sim.adjoint(cost, parameters=PARAMETERS)
    ahead = trajectory.forward(PARAMETERS)
    by = cost(trajectory.tips())[1]
    for j, name in enumerate(PARAMETERS):
        along = sum(float((a[..., j] * b).sum()) for a, b in zip(ahead, by, strict=True))
        here = number(robot, name)

        def change(d: float, name: str = name, here: float = here) -> tuple[Robot, np.ndarray]:
            return with_number(robot, name, here + d), tendon

        apart = difference(change, 2e-3 * here, scheme=scheme)
        assert_allclose(back.parameters[name][0], along, rtol=1e-8)
        assert_allclose(along, apart, rtol=1e-6)


@pytest.mark.study
@pytest.mark.parametrize("robot", [rod(), two()], ids=["one segment", "two segments"])
def test_inputs_of_every_call(robot: Robot) -> None:
    n_calls, rng = 60, np.random.default_rng(2)
    tendon, force = lengths(robot, n_calls), np.zeros((n_calls, 3))
    force[20:] = (0.1, -0.05, 0.02)  # a jump
    sim, trajectory = run(robot, tendon, force)
    back = sim.adjoint(cost, inputs=("tendon_length", "tip_force"))
    # as smooth as the inputs: noise would be a jump, and a step after a jump is another step
    smooth = np.sin(np.outer(np.arange(n_calls) * DT, rng.uniform(20.0, 60.0, robot.n_tendons))) ** 2
    along = smooth[:, None], np.where(np.arange(n_calls) >= 20, 1.0, 0.0)[:, None, None] * rng.normal(size=3)
    ahead = trajectory.forward(tendon_length=along[0], tip_force=along[1])
    by = cost(trajectory.tips())[1]
    for j, (name, direction, size) in enumerate(zip(back.inputs, along, (2e-6, 2e-3), strict=True)):
        forward = sum(float((a[..., j] * b).sum()) for a, b in zip(ahead, by, strict=True))

        def change(d: float, j: int = j) -> tuple[Robot, np.ndarray, np.ndarray]:
            return robot, tendon + (j == 0) * d * along[0][:, 0], force + (j == 1) * d * along[1][:, 0]

        assert_allclose(float((back.inputs[name] * direction).sum()), forward, rtol=1e-8)
        assert_allclose(forward, difference(change, size), rtol=1e-6)


def test_a_follower_force_and_robots_side_by_side() -> None:
    robots = [rod(), rod(line_density=0.1, length=0.11)]
    found = []
    for some in (robots, robots[:1], robots[1:]):
        sim = Simulator(some, dt=DT, dynamics=True)
        sim.record()
        lengths_now = np.array([robot.rest_tendon_length for robot in some])
        sim.settle(lengths_now, follower_tip_force=(0.05, 0.0, 0.0))
        for k in range(20):
            sim.step(lengths_now, follower_tip_force=(0.05, 0.02 * np.sin(0.1 * k), 0.0))
        found.append(sim.adjoint(cost, inputs=("follower_tip_force",)).inputs["follower_tip_force"])
    assert_allclose(found[0], np.concatenate(found[1:], axis=1), rtol=1e-9, atol=1e-12)
    assert np.abs(found[0]).max() > 1e-3


def test_at_rest_the_derivative_is_the_jacobian() -> None:
    robot = two()
    sim = Simulator(robot, 1, solver="modal")
    trajectory = sim.record()
    sim.settle(robot.rest_tendon_length - np.array([0.004, 0.0, 0.001, 0.002]), tolerance=1e-12)
    columns = [
        trajectory.forward(tendon_length=np.eye(4)[k].reshape(1, 1, 4)).position[0, 0, :, 0] for k in range(4)
    ]
    assert_allclose(np.stack(columns, 1), sim.jacobian()[0, :3, :4], atol=1e-7)


def zero(tips: Tips) -> tuple[np.ndarray, Tips]:
    return np.zeros(1), Tips(np.zeros_like(tips.position))


def test_what_cannot_be_derived() -> None:
    robot = rod()
    rest = robot.rest_tendon_length
    with pytest.raises(InputError, match="record needs rods of modes"):
        Simulator(rod(lumps=())).record()
    sim = Simulator(robot, dt=DT, dynamics=True)
    with pytest.raises(InputError, match="call record\\(\\) before"):
        sim.adjoint(zero)
    trajectory = sim.record()
    with pytest.raises(InputError, match="nothing is recorded"):
        sim.adjoint(zero)
    sim.settle(rest)
    with pytest.raises(InputError, match=r"no derivative by.*'tendon_lenght'; did you mean 'tendon_length'"):
        sim.adjoint(zero, inputs=("tendon_lenght",))
    with pytest.raises(InputError, match=r"no number 'segment\.1\.lenght'.*did you mean 'length'"):
        sim.adjoint(zero, parameters=("segment.1.lenght",))
    with pytest.raises(InputError, match=r"value of shape \(3,\); give one number a robot, \(1,\)"):
        sim.adjoint(lambda tips: (np.zeros(3), Tips(tips.position)))
    with pytest.raises(InputError, match=r"derivatives by position of shape \(2,\); give \(1, 1, 3\)"):
        sim.adjoint(lambda _: (np.zeros(1), Tips(np.zeros(2))))
    with pytest.raises(InputError, match="derivatives by position that are no numbers"):
        sim.adjoint(lambda tips: (np.zeros(1), Tips(tips.position * np.nan)))
    with pytest.raises(InputError, match=r"direction tip_force has shape \(1, 3\); give \(1, 1, 3\)"):
        trajectory.forward(tip_force=np.zeros((1, 3)))
    with pytest.raises(InputError, match="follower_tip_force was not given"):
        sim.adjoint(zero, inputs=("follower_tip_force",))
    sim.restore(sim.snapshot())
    with pytest.raises(InputError, match="call record\\(\\) before"):
        sim.adjoint(zero)
