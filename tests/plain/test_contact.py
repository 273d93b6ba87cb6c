"""The kernels of contact, without the compiler and with every index checked: what is touched holds the rod,
and the base feels it."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

from fastrod import Simulator, load_robot
from fastrod.contact import ContactScene, Obstacle, box, capsule, cylinder, ellipsoid, mesh, sphere

# without the compiler numpy warns where a ray or a flat triangle divides by zero, and the infinity is what is
# wanted
pytestmark = pytest.mark.filterwarnings("ignore:divide by zero", "ignore:invalid value", "ignore:overflow")
ACROSS = (0.5**0.5, 0.5**0.5, 0.0, 0.0)
THINGS: dict[str, Obstacle] = {
    "cylinder": cylinder(
        0.01, 0.2, name="thing", position=(0.018, 0.0, 0.05), quaternion=ACROSS, friction=0.3
    ),
    "capsule": capsule(0.01, 0.2, name="thing", position=(0.018, 0.0, 0.05), quaternion=ACROSS),
    "sphere": sphere(0.01, name="thing", position=(0.018, 0.0, 0.05)),
    "box": box((0.02, 0.1, 0.02), name="thing", position=(0.018, 0.0, 0.05), friction=0.2),
    "ellipsoid": ellipsoid((0.01, 0.02, 0.015), name="thing", position=(0.018, 0.0, 0.05), friction=0.2),
    "mesh": mesh(
        trimesh.creation.icosphere(subdivisions=1, radius=0.01), name="thing", position=(0.018, 0.0, 0.05)
    ),
}


@pytest.mark.parametrize("name", THINGS)
def test_what_is_touched_pushes_the_base_through_the_rod(name: str) -> None:
    robot = load_robot("prototype")
    sim = Simulator(
        robot,
        points_per_segment=5,
        contact=ContactScene(obstacles=[THINGS[name]], rod_radius=0.003, self_contact=True),
    )
    for pull in np.linspace(0.0, 0.006, 4):
        state = sim.step(robot.rest_tendon_length + np.array([-pull, 0.0, pull, 0.0]))
    assert state.ok[0], state.problems
    assert state.contacts is not None
    assert state.contacts.in_contact("thing").all()
    force = state.contacts.force[0][np.isfinite(state.contacts.force[0]).all(axis=1)].sum(axis=0)
    assert force[0] < -0.1  # back towards the straight rod
    assert_allclose(state.base_wrench[0, :3], force, atol=1e-6)
    assert sim.clearance().min() < 1e-4
    assert np.isfinite(sim.ray_cast(np.zeros((1, 3)), np.array([[1.0, 0.0, 2.5]])).distance).all()
