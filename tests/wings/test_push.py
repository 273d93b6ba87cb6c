"""A rod on a host pushes bodies of its world, and both feel it."""

import numpy as np
import pytest
from bullets import carrier, clearance_of, cube, empty_world, soft_robot

from fastrod.contact import ContactScene, plane
from fastrod.errors import HostError, InputError, UnknownNameError
from fastrod.hosts import MountedRod
from fastrod.hosts.mounted import BulletBodyContact
from fastrod.simulator import Simulator


def test_every_shape_of_pybullet_is_an_obstacle_where_it_is():
    world = empty_world()
    angle = world.getQuaternionFromEuler([0.3, -0.4, 0.5])
    hull = np.random.default_rng(8).normal(size=(40, 3)) * 0.03
    shapes = {
        "box": world.createCollisionShape(world.GEOM_BOX, halfExtents=[0.01, 0.02, 0.03]),
        "sphere": world.createCollisionShape(world.GEOM_SPHERE, radius=0.03),
        "cylinder": world.createCollisionShape(world.GEOM_CYLINDER, radius=0.02, height=0.05),
        "capsule": world.createCollisionShape(world.GEOM_CAPSULE, radius=0.02, height=0.05),
        "mesh": world.createCollisionShape(world.GEOM_MESH, vertices=hull.tolist()),
    }
    probe = world.createMultiBody(0.0, world.createCollisionShape(world.GEOM_SPHERE, radius=0.001))
    for name, shape in shapes.items():
        body = world.createMultiBody(
            1.0, shape, -1, [0.1, 0.2, 0.3], angle, baseInertialFramePosition=[0.01, 0.0, 0.0]
        )
        contact = BulletBodyContact(world, body, dt=0.005, friction=0.3)
        assert [shape.obstacle.shape for shape in contact.shapes] == [name]
        clearance, points = clearance_of(contact)
        ends = []
        for point in points:
            world.resetBasePositionAndOrientation(probe, point.tolist(), [0, 0, 0, 1])
            ends.append(min(p[8] for p in world.getClosestPoints(probe, body, 1.0)))
        assert min(ends) > 0.0
        assert clearance <= min(ends) + 1e-3  # PyBullet's cylinders and hulls have margins
        assert clearance > 0.0
        world.removeBody(body)


def test_what_cannot_be_touched_is_a_sentence():
    world = empty_world()
    ghost = world.createMultiBody(1.0, -1, -1, [0, 0, 0])
    sentence = r"link -1 of body 0 has no collision shape, so nothing can touch it\."
    with pytest.raises(HostError, match=sentence):
        BulletBodyContact(world, ghost, dt=0.005, friction=0.3)
    wall = plane(point=(1, 0, 0), normal=(-1, 0, 0), name="wall")
    sim = Simulator(soft_robot(), contact=ContactScene(obstacles=[wall]))
    with pytest.raises(InputError, match=r"the mobility of 'wall' is .*; give \[m/N\], \(3, 3\)"):
        sim.set_free("wall", -1.0, np.eye(3), np.zeros(3))
    with pytest.raises(UnknownNameError, match=r"no obstacle 'wal'; did you mean 'wall'\?"):
        sim.set_free("wal", 1.0, np.eye(3), np.zeros(3))


def test_rod_can_be_taken_out_of_the_world():
    world = empty_world()
    rod = MountedRod(soft_robot(), carrier(world))
    assert world.getNumBodies() == 21
    rod.remove()
    assert world.getNumBodies() == 1


@pytest.mark.parametrize("contact_bodies", ["cube", (1, 2, 3), 1.5, True])
def test_contact_bodies_names_bodies(contact_bodies):
    sentence = r"^contact_bodies holds .*; give the number of a body, or \(body, link\)\.$"
    with pytest.raises(HostError, match=sentence):
        MountedRod(soft_robot(), carrier(empty_world()), contact_bodies=[contact_bodies])


def test_world_or_body_that_has_gone_is_a_sentence():
    world = empty_world()
    box = cube(world, 0.08, 0.1, [0.254, 0.0, 0.0])
    rod = MountedRod(soft_robot(), carrier(world), contact_bodies=[np.int64(box)])
    rod.step()
    world.removeBody(box)
    sentence = r"^PyBullet refused getBasePositionAndOrientation: .*; is the body still in the world\?$"
    with pytest.raises(HostError, match=sentence):
        rod.step()
    world.disconnect()
    with pytest.raises(HostError, match=r"^PyBullet's world \d+ has been disconnected\.$"):
        rod.step()
