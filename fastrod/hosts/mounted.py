"""`MountedRod`: a rod on a link of a PyBullet body."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, final

import numpy as np

from fastrod.checks import NOT_NEGATIVE, check_number
from fastrod.contact import Obstacle, mesh, obstacle, plane
from fastrod.errors import HostError
from fastrod.hosts.bodies import RodBodies
from fastrod.hosts.body_contact import BodyContact, CollisionShape
from fastrod.hosts.bullet import Bullet
from fastrod.hosts.carried import CarriedRod, check_bodies, check_gravity, rod_of
from fastrod.hosts.host import Motion
from fastrod.hosts.link import BulletLink, com_motion, exert, from_xyzw
from fastrod.hosts.rod import check_robot
from fastrod.model.robot import Robot
from fastrod.types import Floats


@final
class BulletBodyContact(BodyContact):
    """Contact of a rod with a link (-1: the base) of a PyBullet body (`BodyContact`)."""

    def __init__(self, bullet: Any, body: int, link: int = -1, *, dt: float, friction: float) -> None:
        """`friction` of rod on the body. Raises `HostError` where the link has no shape
        to touch."""
        self.bullet = Bullet(bullet)
        self.bullet.check(body, link)
        self.body, self.link = body, link
        mass, _, inertia = self.bullet.getDynamicsInfo(body, link)[:3]
        shapes = _shapes(self.bullet, body, link)
        if not shapes:
            raise HostError(f"link {link} of body {body} has no collision shape, so nothing can touch it.")
        number = self.bullet.number, body, link
        super().__init__(number, shapes, mass, np.asarray(inertia), dt=dt, friction=friction)

    def com(self) -> Motion:
        """Motion of the centre of mass' frame, not of the link's URDF frame."""
        return com_motion(self.bullet, self.body, self.link)

    def apply(self, wrench: Floats) -> None:
        """(6,) force [N] and moment about the centre of mass [N m], world, for one `stepSimulation`: then
        PyBullet forgets it."""
        exert(self.bullet, self.body, self.link, wrench, self.com().pose[:3])


def _shapes(bullet: Bullet, body: int, link: int) -> list[CollisionShape]:
    """The collision shapes of a link."""
    found = []
    label = bullet.getBodyInfo(body)[1].decode() or "body"
    for i, (_, _, kind, size, _file, position, quaternion) in enumerate(
        bullet.getCollisionShapeData(body, link)
    ):
        name = f"{label} {body}" + (f" link {link}" if link >= 0 else "") + (f" shape {i}" if i else "")
        simple = {
            bullet.GEOM_BOX: ("box", size),
            bullet.GEOM_SPHERE: ("sphere", size[:1]),
            bullet.GEOM_CYLINDER: ("cylinder", size[1::-1]),
            bullet.GEOM_CAPSULE: ("capsule", size[1::-1]),
        }
        if kind in simple:
            made = obstacle(*simple[kind], name=name, widest=math.inf)
        elif kind == bullet.GEOM_PLANE:
            made = plane(point=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), name=name)
        elif kind == bullet.GEOM_MESH:
            made = _hull(bullet, body, link, name)
        else:
            raise HostError(
                f"body {body} has a collision shape of PyBullet's kind {kind}, which a rod "
                "cannot touch; give it a mesh."
            )
        found.append(CollisionShape(made, np.asarray(position, float), from_xyzw(quaternion)))
    return found


def _hull(bullet: Bullet, body: int, link: int, name: str) -> Obstacle:
    """PyBullet takes the convex hull of a body's mesh, and so does the rod."""
    import trimesh

    _, vertices = bullet.getMeshData(body, link, flags=bullet.MESH_DATA_SIMULATION_MESH)
    return mesh(trimesh.convex.convex_hull(np.asarray(vertices, float)), name=name, widest=math.inf)


@final
class MountedRod(CarriedRod):
    """One rod on a link of a PyBullet body (`CarriedRod`). Bodies that are not named in `contact_bodies` meet
    the rod's capsules, which push them at their speed and feel nothing.
    """

    def __init__(
        self,
        robot: Robot,
        host: BulletLink,
        *,
        contact_bodies: Sequence[int | tuple[int, int]] = (),
        friction: float = 0.3,
        points_per_segment: int = 10,
        capsules_per_segment: int = 10,
        max_contacts: int = 16,
        dynamics: bool = True,
        color: Sequence[float] = (0.5, 0.0, 0.6, 1.0),
        head_color: Sequence[float] | None = None,
    ) -> None:
        """`contact_bodies`: numbers of bodies, each its base alone, or (body, link); `friction` of the rod on
        them; `dynamics` as `CarriedRod` has it. The time step is the world's. Raises `HostError`,
        `InputError`, `RobotError`."""
        if not isinstance(host, BulletLink):
            raise HostError(
                f"host is {host!r}; give BulletLink(world, body, link), the link that carries the rod."
            )
        super().__init__(host, host.bullet.dt, id(host.bullet.connection))
        self.host, self.bullet = host, host.bullet
        check_robot(robot)
        check_gravity(robot, self._gravity(), "setGravity() in the world")
        check_number("friction", friction, NOT_NEGATIVE)
        check_bodies(contact_bodies)
        links = [_link_of(t) for t in contact_bodies]
        self.body_contacts = [
            BulletBodyContact(self.bullet, body, link, dt=self.dt, friction=friction) for body, link in links
        ]
        self.rod = rod_of(
            robot,
            self.body_contacts,
            dt=self.dt,
            max_contacts=max_contacts,
            points_per_segment=points_per_segment,
            capsules_per_segment=capsules_per_segment,
            dynamics=dynamics,
        )
        radii = self.rod.radius.tolist()
        each = np.array([segment.length for segment in robot.segments]) / capsules_per_segment
        lengths = np.repeat(each, capsules_per_segment)
        self.bodies = RodBodies(
            self.bullet, lengths.tolist(), radii, len(radii), color=color, head_color=head_color
        )
        for body in {host.body, *(body for body, _ in links)}:
            self.bodies.ignore(body)

    def remove(self) -> None:
        """Take the rod out of the world: its capsules, and its force on what it touched."""
        self.reset()
        self._leave()
        self.bodies.remove()

    def _look(self) -> None:
        if self.bullet.dt != self.dt:
            raise HostError(
                f"the world's time step is now {self.bullet.dt:g} s, and the rod was mounted for "
                f"{self.dt:g} s; remove() it and mount it anew."
            )

    def _gravity(self) -> Floats:
        return self.bullet.gravity

    def _place(self) -> None:
        self.bodies.stand(*self.rod.capsules[:2])

    def _head_for(self) -> None:
        self.bodies.move(self.rod.capsules.velocity)

    def _step_engine(self) -> None:
        self.bullet.stepSimulation()

    def _release(self) -> None:
        """PyBullet forgets its external forces by itself."""


def _link_of(body: object) -> tuple[int, int]:
    """Body and link."""
    pair = body if isinstance(body, (tuple, list)) else (body, -1)
    if len(pair) != 2 or not all(isinstance(i, (int, np.integer)) and not isinstance(i, bool) for i in pair):
        raise HostError(f"contact_bodies holds {body!r}; give the number of a body, or (body, link).")
    return int(pair[0]), int(pair[1])
