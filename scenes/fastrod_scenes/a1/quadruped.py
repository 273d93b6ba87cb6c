"""A Unitree A1 (from pybullet_data) that stands, and a soft neck on the front of its trunk."""

from __future__ import annotations

import math

import numpy as np

from fastrod.hosts import Bullet, BulletLink, connect
from fastrod.model.robot import Robot, Segment, Tendon
from fastrod.rotation import quaternion_from_matrix

OFFSET = 0.012
"""Distance of the neck's tendons from its backbone [m]."""
RADIUS = 0.018
"""Radius of the neck [m]."""
MOUNT = (0.25, 0.0, 0.06)
"""Position of the neck on the head, trunk frame: x forward, z up [m]."""
_HEIGHT = 0.3
_STANCE = {"hip": 0.0, "upper": 0.8, "lower": -1.6}  # rad
_REST = 200  # steps until it stands still on its own


def neck(n_segments: int, stretch: float = 0.0) -> Robot:
    """Segments of 0.1 m that stretch by up to `stretch` [m], 0.4 kg/m, stiff enough to push 50 g over a
    floor."""
    tendons = tuple(Tendon(offset=OFFSET, angle=0.5 * math.pi * k, compliance=1e-6) for k in range(4))
    segment = Segment(
        length=0.1,
        extension=(0.0, stretch),
        bending_stiffness=(0.05, 0.05),
        torsional_stiffness=0.03,
        body_radius=RADIUS,
        line_density=0.4,
        tendons=tendons,
    )
    return Robot(name=f"neck of {n_segments}", segments=(segment,) * n_segments)


def floor(world: Bullet) -> int:
    """The body of a floor at z = 0, friction 0.5."""
    half = [5.0, 5.0, 0.5]
    shape = world.createCollisionShape(world.GEOM_BOX, halfExtents=half)
    picture = world.createVisualShape(world.GEOM_BOX, halfExtents=half, rgbaColor=[0.82, 0.82, 0.8, 1.0])
    body = int(world.createMultiBody(0.0, shape, picture, [0.0, 0.0, -0.5]))
    world.changeDynamics(body, -1, lateralFriction=0.5)
    return body


def standing(dt: float, pitch: float) -> tuple[Bullet, BulletLink]:
    """A world with an A1 that stands in it, and the mount of its neck, which points `pitch` above forward
    [rad]; its d1 is up from there, its d2 to the right."""
    world = connect(dt=dt)
    import pybullet_data  # comes with PyBullet, which `connect` requires in a sentence

    floor(world)
    body = world.loadURDF(f"{pybullet_data.getDataPath()}/a1/a1.urdf", [0.0, 0.0, _HEIGHT + 0.01])
    for j in range(world.getNumJoints(body)):
        name, kind = world.getJointInfo(body, j)[1:3]
        if kind != world.JOINT_REVOLUTE:
            continue
        angle = next(a for joint, a in _STANCE.items() if joint in name.decode())
        world.resetJointState(body, j, angle)
        world.setJointMotorControl2(
            body, j, world.POSITION_CONTROL, angle, force=33.5, positionGain=0.5, velocityGain=1.0
        )
    for _ in range(_REST):
        world.stepSimulation()
    c, s = math.cos(pitch), math.sin(pitch)
    # d1, d2, d3 in the trunk's frame, as columns
    axes = np.array([[-s, 0.0, c], [0.0, -1.0, 0.0], [c, 0.0, s]])
    return world, BulletLink(world, body, -1, position=MOUNT, quaternion=quaternion_from_matrix(axes))
