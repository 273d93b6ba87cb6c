"""Worlds and robots that the tests of hosts share."""

import numpy as np

from fastrod.hosts import BulletLink, connect
from fastrod.model.robot import Robot, Segment, Tendon


def soft_robot(n_segments=2, line_density=0.0, extension=(0.0, 0.0)):
    tendons = tuple(Tendon(offset=0.0075, angle=k * np.pi / 2) for k in range(4))
    segment = Segment(
        length=0.1,
        bending_stiffness=(0.0022, 0.0022),
        torsional_stiffness=0.001,
        body_radius=0.012,
        line_density=line_density,
        extension=extension,
        tendons=tendons,
    )
    return Robot(name="soft", segments=(segment,) * n_segments)


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
    """A body without mass or shape that is moved by hand, its rod along this world axis."""
    half = np.sqrt(0.5)
    angle = {"z": (1.0, 0.0, 0.0, 0.0), "x": (half, 0.0, half, 0.0), "-z": (0.0, 1.0, 0.0, 0.0)}[axis]
    return BulletLink(world, world.createMultiBody(0.0, -1, -1, [0.0] * 3), quaternion=angle)


def move(link, position, velocity):
    link.bullet.resetBasePositionAndOrientation(link.body, list(position), [0.0, 0.0, 0.0, 1.0])
    link.bullet.resetBaseVelocity(link.body, list(velocity), [0.0] * 3)


def cube(world, size, mass, position, friction=0.5):
    shape = world.createCollisionShape(world.GEOM_BOX, halfExtents=[size / 2] * 3)
    body = world.createMultiBody(mass, shape, -1, list(position))
    world.changeDynamics(body, -1, linearDamping=0.0, angularDamping=0.0, lateralFriction=friction)
    return body
