"""Worlds and robots that the tests of hosts share."""

import numpy as np
from rods import rod

from fastrod.contact import ContactScene
from fastrod.hosts import BulletLink, connect
from fastrod.model.robot import Robot
from fastrod.simulator import Simulator

HALF = np.sqrt(0.5)
ROTATION = {"z": (1.0, 0.0, 0.0, 0.0), "x": (HALF, 0.0, HALF, 0.0), "-z": (0.0, 1.0, 0.0, 0.0)}
"""Rotation of the base with the rod along a world axis, w x y z."""


def soft_robot(n_segments=2, **segment):
    own = rod(length=0.1, body_radius=0.012, **segment).segments[0]
    return Robot(name="soft", segments=(own,) * n_segments)


def empty_world(dt=0.005, gravity=0.0):
    return connect(dt=dt, gravity=(0.0, 0.0, -gravity))


def kuka(world, seed):
    """A Kuka iiwa in motion, without friction or motors, and its joint angles and rates."""
    import pybullet_data

    arm = world.loadURDF(f"{pybullet_data.getDataPath()}/kuka_iiwa/model.urdf", useFixedBase=1)
    rng = np.random.default_rng(seed)
    n = world.getNumJoints(arm)
    q, rate = rng.uniform(-1.0, 1.0, n), 0.3 * rng.normal(size=n)
    world.changeDynamics(arm, -1, linearDamping=0.0, angularDamping=0.0)
    for j in range(n):
        world.resetJointState(arm, j, q[j], rate[j])
        world.setJointMotorControl2(arm, j, world.VELOCITY_CONTROL, force=0.0)
        world.changeDynamics(arm, j, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0)
    return arm, q, rate


def carrier(world, axis="z"):
    """A body without mass or shape that is moved by hand, and the base on it with the rod along this world
    axis."""
    return BulletLink(world, world.createMultiBody(0.0, -1, -1, [0.0] * 3), quaternion=ROTATION[axis])


def move(link, position, velocity):
    link.bullet.resetBasePositionAndOrientation(link.body, list(position), [0.0, 0.0, 0.0, 1.0])
    link.bullet.resetBaseVelocity(link.body, list(velocity), [0.0] * 3)


def cube(world, size, mass, position, friction=0.5):
    shape = world.createCollisionShape(world.GEOM_BOX, halfExtents=[size / 2] * 3)
    body = world.createMultiBody(mass, shape, -1, list(position))
    world.changeDynamics(body, -1, linearDamping=0.0, angularDamping=0.0, lateralFriction=friction)
    return body


def clearance_of(contact):
    """Return how far a thin rod beside a body of one shape is from it, and both ends of the rod (2, 3):
    the least distance of the whole rod is at most theirs."""
    robot, name = soft_robot(1), contact.names[0]
    scene = ContactScene(obstacles=[contact.shapes[0].obstacle], rod_radius=0.001, mounting=0.0)
    sim = Simulator(robot, contact=scene)
    where = {"base_pose": (0.15, 0.1, 0.12, 1, 0, 0, 0), "obstacle_pose": {name: contact.now()[name]}}
    state = sim.settle(robot.rest_tendon_length, **where)
    return sim.clearance()[0], state.position[0, [0, -1]]
