"""`Rod` with inertia, on a base of prescribed motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rods import rod as small

from fastrod import Modal, Robot, Rod, Simulator
from fastrod.errors import InputError
from fastrod.hosts.host import Motion

HOME = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
DENSITY, LENGTH = 0.1, 0.2


def beam() -> Robot:
    robot = small("passive", line_density=DENSITY, length=LENGTH, damping_time=1e-3)
    return replace(robot, gravity=(0.0, 0.0, 0.0))


def test_a_shaken_rod_gives_the_simulators_wrench() -> None:
    """In substeps, along a twist that changes from one of the host's steps to the next."""
    rod = Rod(beam(), dt=1e-3, dynamics=True)
    sim = Simulator(beam(), dt=1e-3, solver=Modal(dynamics=True, rho=0.0), points_per_segment=10, threads=1)
    base = np.array(HOME)
    rod.settle(base)
    sim.settle(base_pose=base)
    for k in range(20):
        twist = np.array([0.2 * np.sin(0.9 * k), 0.1, 0.0, 0.0, 2.0 * np.cos(0.7 * k), 1.0])
        if k == 0:
            sim.set_in_motion(twist)
        state = rod.advance(base, twist, 0.004)
        for i in range(1, 5):
            expected = sim.step(base_pose=Motion(base, twist).after(0.001 * i))
        assert_allclose(state.velocity, expected.velocity, rtol=1e-9, atol=1e-12)
        assert_allclose(rod.wrench, expected.base_wrench[0], rtol=1e-9, atol=1e-11)
        base = rod.base
    still = Rod(beam(), dt=1e-3)
    still.settle(base)
    assert np.abs(rod.wrench[:3]).max() > 0.01
    assert_allclose(still.wrench, 0.0, atol=1e-12)


def test_it_goes_back_to_a_snapshot_and_continues_after_a_reset() -> None:
    rod = Rod(beam(), dt=1e-3, dynamics=True)
    rod.settle(HOME, tip_force=(0.2, 0.0, 0.0))
    kept = rod.snapshot()
    runs = []
    for _ in range(2):
        runs.append([rod.advance(HOME, np.zeros(6), 0.002, tip_force=np.zeros(3)).position for _ in range(5)])
        rod.restore(kept)
    assert_array_equal(*runs)
    rod.reset()
    state = rod.advance(HOME, np.zeros(6), 0.002, tip_force=np.zeros(3))
    assert state.velocity is not None
    assert_allclose(state.velocity, 0.0, atol=1e-9)


def test_what_it_cannot_do_is_a_sentence() -> None:
    with pytest.raises(InputError, match="needs a mass"):
        Rod(small("passive"), dynamics=True)
    with pytest.raises(InputError, match=r"^rho is 1\.0; it must be a number from 0"):
        Rod(beam(), dynamics=True, rho=1.0)
