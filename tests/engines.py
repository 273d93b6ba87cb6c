"""The same world in PyBullet and in MuJoCo: a rod on a body that is moved by hand, cubes, a floor."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from bullets import ROTATION, carrier, cube, empty_world, move

from fastrod.hosts import MountedRod, MujocoRod, add_capsules

SPEED, RADIUS, SIZE, MASS = 0.1, 0.012, 0.08, 0.1
"""Constants of the base [m/s]; of the rod, of a cube that it pushes [m]; of that cube [kg]."""
BEYOND = 0.2 + RADIUS + 0.002 + SIZE / 2
"""x of a cube 2 mm beyond the tip [m]."""


class Cube(NamedTuple):
    size: float
    mass: float
    position: Sequence[float]
    friction: float = 0.5


class BulletStage:
    """`contact_bodies`: the cubes are obstacles of the rod; those without mass stand still."""

    hop, hop_aside = 1.05, 1.05
    """Largest speed of a cube that is pushed over the floor, along the rod and from its side, over that of
    the push."""

    def __init__(
        self, robot, *, dt=0.005, gravity=0.0, axis="x", cubes=(), floor=None, contact_bodies=True, **options
    ):
        self.world = empty_world(dt, gravity)
        self.dt = dt
        if floor is not None:
            shape = self.world.createCollisionShape(self.world.GEOM_BOX, halfExtents=[5.0, 5.0, 0.5])
            ground = self.world.createMultiBody(0.0, shape, -1, [0.0, 0.0, floor - 0.5])
            self.world.changeDynamics(ground, -1, lateralFriction=0.5)
        self.cubes = [cube(self.world, c.size, c.mass, c.position, friction=c.friction) for c in cubes]
        self.link, touched = carrier(self.world, axis), self.cubes if contact_bodies else []
        self.rod = MountedRod(robot, self.link, contact_bodies=touched, **options)

    def move(self, position, velocity):
        move(self.link, position, velocity)

    def velocity(self, k=0):
        """(6,) of a cube's centre of mass."""
        return np.concatenate(self.world.getBaseVelocity(self.cubes[k]))

    def position(self, k=0):
        return np.array(self.world.getBasePositionAndOrientation(self.cubes[k])[0])

    def put(self, k, position):
        self.world.resetBasePositionAndOrientation(self.cubes[k], list(position), [0, 0, 0, 1])
        self.world.resetBaseVelocity(self.cubes[k], [0.0] * 3, [0.0] * 3)

    def set_dt(self, dt):
        self.world.setTimeStep(dt)

    def set_gravity(self, gravity):
        self.world.setGravity(*gravity)


class MujocoStage:
    """See `BulletStage`."""

    # a body that slides lifts off at friction times its speed: MuJoCo's friction cone is convex in force and
    # velocity together
    hop, hop_aside = 1.35, 1.4

    def __init__(
        self, robot, *, dt=0.005, gravity=0.0, axis="x", cubes=(), floor=None, contact_bodies=True, **options
    ):
        import mujoco

        self.lib, self.dt = mujoco, dt
        spec = mujoco.MjSpec()
        spec.option.timestep, spec.option.gravity = dt, [0.0, 0.0, -gravity]
        # MuJoCo's default contact creeps under friction
        spec.option.impratio, spec.option.cone = 100.0, mujoco.mjtCone.mjCONE_ELLIPTIC
        box = mujoco.mjtGeom.mjGEOM_BOX
        if floor is not None:
            place = {"size": [5, 5, 0.5], "pos": [0, 0, floor - 0.5]}
            spec.worldbody.add_geom(type=box, friction=[0.25, 0.005, 0.0001], **place)
        self.names = [f"cube {k}" for k in range(len(cubes))]
        for name, c in zip(self.names, cubes, strict=True):
            body = spec.worldbody.add_body(name=name, pos=list(c.position))
            if c.mass > 0.0:
                body.add_freejoint()
            # MuJoCo takes the larger friction of a pair, PyBullet the product
            friction = [0.5 * c.friction, 0.005, 0.0001]
            body.add_geom(type=box, size=[c.size / 2] * 3, mass=c.mass, friction=friction)
        spec.worldbody.add_body(name="post", mocap=True)
        names = self.names if contact_bodies else []
        n = options.pop("capsules_per_segment", 10)
        add_capsules(spec, robot, "post", contact_bodies=names, capsules_per_segment=n)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        mount = {"quaternion": ROTATION[axis], "contact_bodies": names}
        self.rod = MujocoRod(robot, self.model, self.data, "post", **mount, **options)
        self.post = self.model.body("post").mocapid[0]

    def move(self, position, velocity):
        self.data.mocap_pos[self.post] = position
        self.rod.host.mocap_velocity[:3] = velocity

    def _joint(self, k):
        joint = self.model.joint(self.model.body(self.names[k]).jntadr[0])
        return joint.qposadr[0], joint.dofadr[0]

    def velocity(self, k=0):
        v = self._joint(k)[1]
        return self.data.qvel[v : v + 6].copy()

    def position(self, k=0):
        q = self._joint(k)[0]
        return self.data.qpos[q : q + 3].copy()

    def put(self, k, position):
        q, v = self._joint(k)
        self.data.qpos[q : q + 7] = [*position, 1, 0, 0, 0]
        self.data.qvel[v : v + 6] = 0.0

    def set_dt(self, dt):
        self.model.opt.timestep = dt

    def set_gravity(self, gravity):
        self.model.opt.gravity = gravity


ENGINES = {"pybullet": BulletStage, "mujoco": MujocoStage}
