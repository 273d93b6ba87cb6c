"""Bodies of a PyBullet world as obstacles of a rod, pushed by it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np

from fastrod.contact import Obstacle, box, capsule, cylinder, mesh, plane, sphere
from fastrod.errors import HostError
from fastrod.hosts.body_contact import BodyContact, CollisionShape
from fastrod.hosts.bullet import Bullet
from fastrod.hosts.host import Motion
from fastrod.hosts.link import com_motion, exert, from_xyzw
from fastrod.types import Floats


@final
class BulletBodyContact(BodyContact):
    """Contact of a rod with a link (-1: the base) of a PyBullet body (`BodyContact`)."""

    def __init__(
        self, bullet: Any, body: int, link: int = -1, *, dt: float, relaxation: float, friction: float
    ) -> None:
        """`relaxation` tau [s]; `friction` of rod on the body. Raises `HostError` where the link has no shape
        to touch."""
        self.bullet = Bullet(bullet)
        self.bullet.check(body, link)
        self.body, self.link = body, link
        mass, _, inertia = self.bullet.getDynamicsInfo(body, link)[:3]
        shapes = _shapes(self.bullet, body, link)
        if not shapes:
            raise HostError(f"link {link} of body {body} has no collision shape, so nothing can touch it.")
        super().__init__(shapes, mass, np.asarray(inertia), dt=dt, relaxation=relaxation, friction=friction)

    def com(self) -> Motion:
        """Motion of the centre of mass' frame, not of the link's URDF frame."""
        return com_motion(self.bullet, self.body, self.link)

    def overlap(self, capsules: Sequence[int]) -> Floats:
        """Return the link's displacement (3,) out of its deepest overlap with one of these bodies, world [m];
        its length is the depth."""
        found = [
            p for own in capsules for p in self.bullet.getClosestPoints(own, self.body, 0.0, -1, self.link)
        ]
        if not found:
            return np.zeros(3)
        deepest = min(found, key=lambda p: p[8])
        # its normal points from the link to the capsule
        return np.asarray(min(deepest[8], 0.0) * np.array(deepest[7]))

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
        if kind == bullet.GEOM_BOX:
            made = box(size, name=name)
        elif kind == bullet.GEOM_SPHERE:
            made = sphere(size[0], name=name)
        elif kind == bullet.GEOM_CYLINDER:
            made = cylinder(size[1], size[0], name=name)
        elif kind == bullet.GEOM_CAPSULE:
            made = capsule(size[1], size[0], name=name)
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
    return mesh(trimesh.convex.convex_hull(np.asarray(vertices, float)), name=name)
