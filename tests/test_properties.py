"""Laws that hold for any robot and any load."""

from __future__ import annotations

from functools import cache

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from rods import bend, rod

from fastrod import Simulator

angle = st.floats(-1.2, 1.2)
force = st.tuples(*[st.floats(-0.4, 0.4)] * 3)
same_every_time = settings(derandomize=True, max_examples=40, deadline=None)


@cache
def simulator(mode: str) -> Simulator:
    return Simulator(rod(mode), points_per_segment=10)


def settled(mode: str, x: float, y: float, load: tuple[float, ...]) -> tuple[Simulator, np.ndarray]:
    sim = simulator(mode)
    lengths = bend(sim.robots[0], x, y)
    assert sim.settle(lengths, tip_force=load, tolerance=1e-11).ok.all()
    return sim, lengths


@same_every_time
@given(angle, angle, force)
def test_frames_are_rotations_and_nodes_a_step_apart(x: float, y: float, load: tuple[float, ...]) -> None:
    sim, lengths = settled("tendon_length", x, y, load)
    state = sim.settle(lengths, tip_force=load)
    R = state.rotation[0]
    assert_allclose(np.swapaxes(R, 1, 2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-13)
    chord = np.linalg.norm(np.diff(state.position[0], axis=0), axis=1)
    # the backbone does not stretch: a chord is never longer than its arc
    assert (chord <= 0.007 * (1 + 1e-6)).all()


@same_every_time
@given(angle, angle, force)
def test_the_base_carries_the_tip_force_and_its_moment(x: float, y: float, load: tuple[float, ...]) -> None:
    for mode in ("tendon_length", "paper"):
        sim, lengths = settled(mode, x, y, load)
        state = sim.settle(lengths, tip_force=load, tolerance=1e-11)
        assert_allclose(state.base_wrench[0, :3], load, atol=1e-14)
        # at ten steps the discrete moment closes to the order of the method
        assert_allclose(state.base_wrench[0, 3:], np.cross(state.tip_position[0], load), atol=2e-7)


@same_every_time
@given(angle, angle, force)
def test_a_mirror_image_bends_into_the_mirror_image(x: float, y: float, load: tuple[float, ...]) -> None:
    """In the plane x = 0: forces change their x, bends about d2 their sign, the x tendons their places."""
    sim, lengths = settled("tendon_length", x, y, load)
    one = sim.settle(lengths, tip_force=load, tolerance=1e-11)
    two = sim.settle(lengths[[2, 1, 0, 3]], tip_force=np.multiply(load, (-1, 1, 1)), tolerance=1e-11)
    assert_allclose(two.tip_position[0], one.tip_position[0] * (-1, 1, 1), atol=1e-8)
    assert_allclose(two.tension[0], one.tension[0][[2, 1, 0, 3]], atol=1e-5)


@same_every_time
@given(angle, angle, force)
def test_compliance_is_symmetric(x: float, y: float, load: tuple[float, ...]) -> None:
    """Maxwell and Betti: with dead loads and held tendons the tip gives as much to one force as another."""
    sim, lengths = settled("tendon_length", x, y, load)
    sim.settle(lengths, tip_force=load, tolerance=1e-11)
    compliance = sim.compliance()[0, :3]
    assert_allclose(compliance, compliance.T, atol=1e-4 * np.abs(compliance).max())
