"""Bodies of a PyBullet world as obstacles of a rod, pushed by it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple, final

import numpy as np

from fastrod.contact import Obstacle, box, capsule, cylinder, mesh, plane, sphere
from fastrod.errors import HostError
from fastrod.hosts.bullet import Bullet
from fastrod.hosts.host import Motion
from fastrod.hosts.link import exert, from_xyzw
from fastrod.rotation import matrix_from_quaternion, product
from fastrod.types import Floats

_LEFT = 0.8  # of an overlap after a step


class Part(NamedTuple):
    """One collision shape of a link."""

    obstacle: Obstacle
    position: Floats
    """(3,) in the frame of the link's centre of mass [m]."""
    quaternion: Floats
    """(4,) w x y z, com_from_obstacle."""


@final
class Touched:
    """A link (-1: the base) that a rod touches, and what the rod does to it.

    A step is implicit in the body's inertia: to the rod it is where it would be at the step's end without the rod, and gives way by
    F dt^2 / m and M dt^2 / I. A contact that lasts gives no more momentum than stops the body at the rod, at any time step.

    The rod answers a changing load with tau dF/dt more (Kelvin and Voigt): a rod without mass and damping would swing with what it
    pushes for ever. That is implicit too: dt^2 becomes dt^2 + tau dt, and the body is expected where tau dF of the last force has
    been taken off.
    """

    def __init__(self, bullet: Any, body: int, link: int = -1, *, dt: float, relaxation: float, friction: float) -> None:
        """`relaxation` tau [s]; `friction` of rod on the body. Raises `HostError` where the link has no shape to touch."""
        self.bullet = Bullet(bullet)
        self.bullet.check(body, link)
        self.body, self.link, self.dt, self.relaxation = body, link, dt, relaxation
        mass, _, inertia = self.bullet.getDynamicsInfo(body, link)[:3]
        shapes = list(_shapes(self.bullet, body, link))
        if not shapes:
            raise HostError(f"link {link} of body {body} has no collision shape, so nothing can touch it.")
        self.mass: float = mass
        """0: it does not move for the rod."""
        self._inertia: Floats = np.maximum(inertia, 1e-12)
        self.parts = [part._replace(obstacle=dataclasses.replace(part.obstacle, friction=friction)) for part in shapes]
        self.names = tuple(part.obstacle.name for part in self.parts)
        self.exerted: Floats = np.zeros(6)
        """Force [N] and moment about its centre of mass [N m] that the rod exerted on it in the last step, world."""
        self._before: Floats = np.zeros(6)

    def give(self) -> tuple[float, Floats, Floats]:
        """How far it moves per force [m/N] and turns per moment (3, 3) [rad/(N m)] in the next step, and its centre of mass (3,)."""
        pose = self._com().pose
        if self.mass == 0.0:
            return 0.0, np.zeros((3, 3)), pose[:3]
        turn, square = matrix_from_quaternion(pose[None, 3:])[0], self.dt**2 + self.relaxation * self.dt
        return square / self.mass, square * turn @ (turn.T / self._inertia[:, None]), pose[:3]

    def _com(self) -> Motion:
        return _com_motion(self.bullet, self.body, self.link)

    def _overlap(self, capsules: Sequence[int]) -> Floats:
        """(3,) the way out of what it overlaps most of these bodies, world [m]; zero where it overlaps none."""
        found = [p for own in capsules for p in self.bullet.getClosestPoints(own, self.body, 0.0, -1, self.link)]
        if not found:
            return np.zeros(3)
        deepest = min(found, key=lambda p: p[8])
        return np.asarray(min(deepest[8], 0.0) * np.array(deepest[7]))  # its normal points from the link to the capsule

    def expected(self, capsules: Sequence[int]) -> tuple[dict[str, Floats], dict[str, Floats]]:
        """Pose (7,) and velocity (6,) of each part at the end of the next step, were it not for the rod.

        What overlaps the rod's `capsules` already (a contact that was lost for a step) is expected most of the way outside: out at once
        it would leave at overlap / dt.
        """
        motion = self._com()
        if self.mass > 0.0:
            back = self.relaxation / (self.dt**2 + self.relaxation * self.dt)  # per step: tau dt of the force before, as a velocity
            by_force, by_moment, _ = self.give()
            change = np.concatenate([by_force * self._before[:3], by_moment @ self._before[3:]])
            motion = motion._replace(velocity=motion.velocity - back * change)
        pose = motion.after(self.dt)
        if self.mass > 0.0:
            pose[:3] += _LEFT * self._overlap(capsules)
        turn = matrix_from_quaternion(pose[None, 3:])[0]
        poses, velocities = {}, {}
        for part in self.parts:
            arm = turn @ part.position
            poses[part.obstacle.name] = np.concatenate([pose[:3] + arm, product(pose[3:], part.quaternion)])
            linear = motion.velocity[:3] + np.cross(motion.velocity[3:], arm)
            velocities[part.obstacle.name] = np.concatenate([linear, motion.velocity[3:]])
        return poses, velocities

    def push(self, points: Floats, forces: Floats) -> tuple[Floats, Floats]:
        """Exert the forces (n, 3) of the rod at world points (n, 3).

        Returns what was exerted beyond these forces, (6,) with its moment about a point, and that point (3,): the rod's host takes
        its opposite.
        """
        com = self._com().pose[:3]
        if self.mass == 0.0:
            return np.zeros(6), com
        wrench = np.concatenate([forces.sum(0), np.cross(points - com, forces).sum(0)])
        more = self.relaxation / self.dt * (wrench - self._before)
        along = wrench[:3] if wrench[:3].any() else self._before[:3]
        if (wrench + more)[:3] @ along <= 0.0:
            more = -wrench  # contact pushes, it does not hold
        self._before, self.exerted = wrench, wrench + more
        self._exert()
        return more, com

    def push_half(self) -> None:
        """Exert half of the last forces: for a step in which the rod's are not known."""
        self._before, self.exerted = 0.5 * self._before, 0.5 * self.exerted
        self._exert()

    def _exert(self) -> None:
        if self.exerted.any():
            exert(self.bullet, self.body, self.link, self.exerted, self._com().pose[:3])

    def forget(self) -> None:
        """The body was put somewhere else: no force carries over."""
        self._before, self.exerted = np.zeros(6), np.zeros(6)


def _com_motion(bullet: Bullet, body: int, link: int) -> Motion:
    if link < 0:
        position, quaternion = bullet.getBasePositionAndOrientation(body)
        linear, angular = bullet.getBaseVelocity(body)
    else:
        state = bullet.getLinkState(body, link, computeLinkVelocity=1, computeForwardKinematics=1)
        position, quaternion, linear, angular = state[0], state[1], state[6], state[7]
    return Motion(np.array([*position, *from_xyzw(quaternion)]), np.array([*linear, *angular]))


def _shapes(bullet: Bullet, body: int, link: int) -> list[Part]:
    """The collision shapes of a link."""
    found = []
    label = bullet.getBodyInfo(body)[1].decode() or "body"
    for i, (_, _, kind, size, _file, position, quaternion) in enumerate(bullet.getCollisionShapeData(body, link)):
        name = f"{label} {body}" + (f" link {link}" if link >= 0 else "") + (f" part {i}" if i else "")
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
            raise HostError(f"body {body} has a collision shape of PyBullet's kind {kind}, which a rod cannot touch; give it a mesh.")
        found.append(Part(made, np.asarray(position, float), from_xyzw(quaternion)))
    return found


def _hull(bullet: Bullet, body: int, link: int, name: str) -> Obstacle:
    """PyBullet takes the convex hull of a body's mesh, and so does the rod."""
    import trimesh

    _, vertices = bullet.getMeshData(body, link, flags=bullet.MESH_DATA_SIMULATION_MESH)
    return mesh(trimesh.convex.convex_hull(np.asarray(vertices, float)), name=name)
