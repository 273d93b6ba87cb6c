"""Newton's and Euler's laws for a rod in motion: what its base, its weight and its tip are given changes its
momentum, which is computed from `State.velocity` alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rods import rod
from scipy.integrate import simpson

from fastrod import Lump, Modal, Modes, Robot, Simulator, State
from fastrod.rotation import matrix_from_quaternion, quaternion_from_vector

DENSITY, LUMP, LENGTH = 0.1, Lump(at=0.035, mass=0.004), 0.07
GRAVITY, FORCE = np.array([0.0, 0.0, -9.81]), np.array([0.01, 0.03, -0.02])
END = 0.04  # s
Base = Callable[[float], tuple[float, ...]]


def robot() -> Robot:
    """With tendons and a disk; a body of no radius has no rotary inertia."""
    made = rod(line_density=DENSITY, lumps=(LUMP,), damping_time=1e-3)
    return replace(made, gravity=tuple(GRAVITY))


def shaken(t: float) -> tuple[float, ...]:
    return (4e-3 * math.sin(80.0 * t) ** 4, 0.0, 2e-3 * math.sin(60.0 * t) ** 4, 1.0, 0.0, 0.0, 0.0)


def spun(t: float) -> tuple[float, ...]:
    """About a skew axis through the base, from rest, on a circle of 5 cm."""
    angle = 12.0 * t**3 / (t**2 + 4e-4)
    q = quaternion_from_vector(angle * np.array([[0.48, 0.6, 0.64]]))
    arm = matrix_from_quaternion(q)[0] @ (0.05, 0.0, 0.0)
    return (*arm, *q[0])


def momenta(state: State) -> np.ndarray:
    """(6,) linear momentum, and angular momentum about the world's origin."""
    assert state.velocity is not None
    s, r, v = state.arclength[0], state.position[0], state.velocity[0]
    each = np.concatenate([v, np.cross(r, v)], axis=1)
    k = int(np.abs(s - LUMP.at).argmin())
    assert_allclose(s[k], LUMP.at)
    total = DENSITY * simpson(each, x=s, axis=0) + LUMP.mass * each[k]
    return np.asarray(total)


def given(state: State, base: np.ndarray) -> np.ndarray:
    """(6,) force on the rod, and moment about the world's origin: base, weight, tip."""
    s, r = state.arclength[0], state.position[0]
    weight = np.concatenate([np.tile(GRAVITY, (len(s), 1)), np.cross(r, GRAVITY)], axis=1)
    k = int(np.abs(s - LUMP.at).argmin())
    loads = DENSITY * simpson(weight, x=s, axis=0) + LUMP.mass * weight[k]
    tip = np.concatenate([FORCE, np.cross(r[-1], FORCE)])
    held = -state.base_wrench[0]
    held[3:] += np.cross(base, held[:3])
    return np.asarray(loads + tip + held)


def imbalance(base: Base, dt: float, scheme: str) -> np.ndarray:
    """(6,) root mean square of d/dt momentum less what is given, over the largest given, from 10 ms on."""
    how: dict[str, Any] = {"scheme": scheme, "modes": Modes(6, 4, pieces=2)}
    sim = Simulator(robot(), dt=dt, solver=Modal(dynamics=True, **how), points_per_segment=28)
    home = robot().rest_tendon_length
    pull = np.array([-2e-3, 1e-3, 2e-3, -1e-3])
    states = [sim.settle(home, tip_force=FORCE, base_pose=base(0.0))]
    for k in range(1, round(END / dt) + 1):
        x = min(k * dt / 0.02, 1.0)
        pulled = home + pull * x * x * (3.0 - 2.0 * x)
        states.append(sim.step(pulled, tip_force=FORCE, base_pose=base(k * dt)))
    p = np.array([momenta(state) for state in states])
    f = np.array([given(state, np.array(base(k * dt)[:3])) for k, state in enumerate(states)])
    change = (p[2:] - p[:-2]) / (2.0 * dt)
    first = round(0.01 / dt)
    off = np.sqrt(((change - f[1:-1])[first:] ** 2).mean(0))
    size = np.abs(f).max(0)
    return np.concatenate([off[:3] / size[:3].max(), off[3:] / size[3:].max()])


@pytest.mark.study
@pytest.mark.parametrize("scheme", ["bdf2", "generalized_alpha"])
@pytest.mark.parametrize("base", [shaken, spun])
def test_what_the_base_gives_is_the_change_of_momentum(base: Base, scheme: str) -> None:
    """The error falls with about the square of the step (the tendons ring at frequencies near 1/dt), so
    that no force and no inertia is missing."""
    coarse, fine = (imbalance(base, dt, scheme) for dt in (2e-4, 1e-4))
    assert_allclose(np.log2(np.linalg.norm(coarse) / np.linalg.norm(fine)), 2.0, atol=0.3)
    assert fine.max() < 2e-4


def test_a_base_in_free_fall_carries_nothing() -> None:
    """Dropped from a weightless rest: gravity acts, and the base moves as it says."""
    sim, home = Simulator(robot(), dt=1e-3, dynamics=True), robot().rest_tendon_length
    state = sim.settle(home, gravity=np.zeros(3), base_pose=(0.0, 0.0, 0.0, 0.8, 0.6, 0.0, 0.0))
    straight = state.position
    for k in range(1, 101):
        fall = 0.5 * GRAVITY * (k * sim.dt) ** 2
        state = sim.step(home, base_pose=(*fall, 0.8, 0.6, 0.0, 0.0), gravity=GRAVITY)
    weight = -9.81 * (DENSITY * LENGTH + LUMP.mass)
    assert_allclose(state.base_wrench[0], 0.0, atol=1e-6 * abs(weight))
    assert_allclose(state.position, straight + fall, atol=1e-8)
    hung = sim.settle(home, base_pose=(*fall, 0.8, 0.6, 0.0, 0.0), gravity=GRAVITY)
    assert_allclose(hung.base_wrench[0, :3], (0.0, 0.0, weight), atol=1e-12)
