"""Rods on obstacles beside closed forms: a strut that buckles and comes back, a rope around a bar."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

from fastrod import Modal, Modes, Robot, Segment, Simulator
from fastrod.contact import ContactScene, cylinder, plane


def strut(length: float, stiffness: float, radius: float, **more: float) -> Robot:
    """A rod without tendons and weight."""
    segment = Segment(
        length=length,
        bending_stiffness=(stiffness, stiffness),
        torsional_stiffness=stiffness,
        body_radius=radius,
        mode="passive",
        **more,
    )
    return Robot(name="strut", segments=(segment,), gravity=(0.0, 0.0, 0.0))


def test_a_strut_buckles_under_a_wall_and_comes_back_by_the_same_forces() -> None:
    """Clamped below, the tip free to slide: Euler's pi^2 EI / (4 l^2), then the elastica, l^2 P / EI = K(m)^2
    and shortening 2 - 2 E(m) / K(m) of the length. A force of 1e-4 N aside says where to."""
    length, stiffness, radius = 0.1, 2e-3, 1e-4
    wall = plane(point=(0.0, 0.0, length + radius), normal=(0.0, 0.0, -1.0), name="wall")
    sim = Simulator(
        strut(length, stiffness, radius), contact=ContactScene(obstacles=[wall], rod_radius=radius)
    )
    sim.settle(tip_force=(1e-4, 0.0, 0.0))
    there = np.linspace(0.02, 0.2, 5)
    for shorter in [*there, *there[::-1], 0.0]:
        pose = (0.0, 0.0, (1.0 - shorter) * length + radius, 0.0, 1.0, 0.0, 0.0)
        state = sim.step(tip_force=(1e-4, 0.0, 0.0), obstacle_pose={"wall": pose})
        assert state.ok.all(), state.problems
        force = -state.contacts.total_force[0, 2]
        if shorter == 0.0:
            assert force == 0.0
            continue
        m = brentq(lambda m, by=shorter: 2.0 - 2.0 * ellipe(m) / ellipk(m) - by, 1e-9, 0.9)
        assert_allclose(force, stiffness * ellipk(m) ** 2 / length**2, rtol=1e-3)


@pytest.mark.study
def test_a_rope_that_is_drawn_around_a_bar() -> None:
    """Euler and Eytelwein, of a rope that is thick: its friction acts on the bar's surface, at R, its tension
    at R + r, so that the tension grows by exp(mu phi R / (R + r)). A rod that bends under it in 7 mm touches
    at eight places or so; as it moves from one to the next single steps are off by up to 13 %."""
    radius, bar_radius, mu, pull = 0.002, 0.03, 0.3, 2.0
    bar = cylinder(
        bar_radius,
        0.4,
        name="bar",
        position=(bar_radius + radius, 0.0, 0.25),
        quaternion=(math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0),
        friction=mu,
    )
    sim = Simulator(
        strut(0.5, 1e-4, radius, line_density=0.02, damping_time=0.02),
        dt=2e-3,
        solver=Modal(dynamics=True, modes=Modes(4, 2, pieces=10)),
        contact=ContactScene(obstacles=[bar], rod_radius=radius, max_contacts=48),
        points_per_segment=100,
    )
    sim.settle(tip_force=(0.0, 0.0, pull))
    ratio = []
    for k in range(400):
        angle, back = math.pi * min(1.0, k / 200.0), 1e-4 * max(k - 220, 0)
        state = sim.step(
            tip_force=(pull * math.sin(angle), 0.0, pull * math.cos(angle)),
            base_pose=(0.0, 0.0, -back, 1.0, 0.0, 0.0, 0.0),
        )
        assert state.ok.all(), state.problems
        if k >= 250:
            ratio.append(np.linalg.norm(state.base_wrench[0, :3]) / pull)
    exponent = np.log(ratio) / (mu * math.pi * bar_radius / (bar_radius + radius))
    assert_allclose(exponent.mean(), 1.0, atol=0.015)
    assert_allclose(exponent, 1.0, atol=0.2)
