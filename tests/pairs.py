"""A rod on a body that gives way: in no engine, in PyBullet, in MuJoCo."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from bullets import empty_world

from fastrod import Robot, Rod, load_robot
from fastrod.hosts import BulletLink, MountedRod, MujocoRod, add_capsules
from fastrod.rotation import displaced
from fastrod.types import Floats

HOME = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
GRAVITY = 9.81


def heavy(mass: float, name: str = "prototype") -> Robot:
    robot = load_robot(name)
    density = mass / robot.length
    return replace(robot, segments=tuple(replace(s, line_density=density) for s in robot.segments))


class FreeBody:
    """A body whose centre is the base, stepped the way that rigid-body engines do; its radius of gyration is
    `radius` of the rod's length."""

    def __init__(
        self, robot: Robot, ratio: float, dt: float, spin: tuple[float, float, float], radius: float = 0.5
    ) -> None:
        self.rod, self.dt = Rod(robot, dt=dt, dynamics=True, points_per_segment=20), dt
        self.mass = ratio * sum(s.line_density * s.length for s in robot.segments)
        self.inertia = self.mass * (radius * robot.length) ** 2
        self.pose, self.twist = HOME.copy(), np.array([0.0, 0.0, 0.0, *spin])

    def step(self, gravity: float = 0.0, **inputs: Any) -> None:
        weight = np.array([0.0, 0.0, -gravity])
        free = self.twist + self.dt * np.array([*weight, 0.0, 0.0, 0.0])
        mobility = np.diag([1.0 / self.mass] * 3 + [1.0 / self.inertia] * 3)
        given = {"inverse_inertia": mobility, "free_twist": free, "gravity": weight} | inputs
        self.rod.advance(self.pose, self.twist, self.dt, **given)
        self.twist = free + self.dt * mobility @ self.rod.wrench
        self.pose = displaced(self.pose, self.dt * self.twist)

    def momentum(self) -> Floats:
        """(2, 6) of the body and of the rod, about the origin."""
        linear = self.mass * self.twist[:3]
        turning = np.cross(self.pose[:3], linear) + self.inertia * self.twist[3:]
        return np.stack([np.concatenate([linear, turning]), self.rod.simulator.momentum()[0]])


def falling(engine: str, robot: Robot, dt: float, contact: bool) -> tuple[Any, Any]:
    """A box of 1 kg with a rod on it, and a function that tells its speed."""
    half = 0.05
    if engine == "pybullet":
        world = empty_world(dt, GRAVITY)
        shape = world.createCollisionShape(world.GEOM_BOX, halfExtents=[half] * 3)
        bodies = [world.createMultiBody(1.0, shape, -1, [3.0 * k, 0.0, 5.0]) for k in range(2)]
        world.changeDynamics(bodies[0], -1, linearDamping=0.0, angularDamping=0.0)
        link = BulletLink(world, bodies[0], position=(0.0, 0.0, half))
        rod = MountedRod(robot, link, contact_bodies=bodies[1:] if contact else [])
        return rod, lambda: world.getBaseVelocity(bodies[0])[0][2]
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = dt, [0.0, 0.0, -GRAVITY]
    for k, name in enumerate(("box", "other")):
        body = spec.worldbody.add_body(name=name, pos=[3.0 * k, 0.0, 5.0])
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[half] * 3, mass=1.0)
    touched = ["other"] if contact else []
    add_capsules(spec, robot, "box", contact_bodies=touched)
    model = spec.compile()
    data = mujoco.MjData(model)
    rod = MujocoRod(robot, model, data, "box", position=(0.0, 0.0, half), contact_bodies=touched)
    return rod, lambda: data.qvel[2]
