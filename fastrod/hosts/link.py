"""`BulletLink`: any link of any PyBullet body as the host of a rod."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.checks import checked_array, checked_pose
from fastrod.hosts.bullet import Bullet
from fastrod.hosts.host import Freedom, Host, Motion, inverse_inertia
from fastrod.rotation import cross, matrix_from_quaternion, product
from fastrod.types import Floats


def from_xyzw(quaternion: ArrayLike) -> Floats:
    """(..., 4) quaternion w x y z of PyBullet's x y z w (..., 4)."""
    return np.asarray(quaternion, float).take((3, 0, 1, 2), -1)


def to_xyzw(quaternion: ArrayLike) -> Floats:
    """(..., 4) PyBullet's x y z w of a quaternion w x y z (..., 4)."""
    return np.asarray(quaternion, float).take((1, 2, 3, 0), -1)


@final
class BulletLink:
    """A rod's base, fixed to a link (-1: the body's base).

    The mount is given in the link's URDF frame, the one that a URDF's joints and meshes are drawn in, not in
    the frame of its centre of mass. `fastrod.hosts.Host` says what the methods do.
    """

    def __init__(
        self,
        bullet: Any,
        body: int,
        link: int | str = -1,
        *,
        position: ArrayLike = (0.0, 0.0, 0.0),
        quaternion: ArrayLike = (1.0, 0.0, 0.0, 0.0),
    ) -> None:
        """`link`: number or name; `position` (3,) [m] and `quaternion` (4,) w x y z, link_from_base. Raises
        `HostError`, `InputError`."""
        self.bullet = Bullet(bullet)
        self.body = body
        self.link = self.bullet.link_named(body, link) if isinstance(link, str) else int(link)
        self.bullet.check(body, self.link)
        self._position, self._quaternion = mount_pose(position, quaternion)

    def motion(self) -> Motion:
        """Motion of the rod's base."""
        pose, velocity = link_motion(self.bullet, self.body, self.link)
        arm = matrix_from_quaternion(pose[None, 3:])[0] @ self._position
        velocity[:3] += cross(velocity[3:], arm)
        return Motion(np.concatenate([pose[:3] + arm, product(pose[3:], self._quaternion)]), velocity)

    def moves_with(self, other: Host) -> bool:
        """See `Host`: links of one body that joints hold to the world, or bases on one link of another."""
        if not isinstance(other, BulletLink) or other.bullet.connection is not self.bullet.connection:
            return False
        # the number of a body that was removed is given again, and PyBullet asks its memory for any link
        there = other.body == self.body and other.link < self.bullet.getNumJoints(self.body)
        carrier = self._carrier() if there else None
        return carrier is not None and carrier == other._carrier()

    def _carrier(self) -> int | None:
        """Link with a mass that carries the base; of a body that stands -2 where its joints may move the
        base, else None."""
        bullet, link = self.bullet, self.link
        if bullet.getDynamicsInfo(self.body, -1)[0] == 0.0:
            return -2 if link >= 0 and self._joints() else None
        while link >= 0 and bullet.getDynamicsInfo(self.body, link)[0] == 0.0:
            link = bullet.getJointInfo(self.body, link)[16]
        return link

    def _joints(self) -> list[int]:
        bullet = self.bullet
        every = range(bullet.getNumJoints(self.body))
        return [j for j in every if bullet.getJointInfo(self.body, j)[2] != bullet.JOINT_FIXED]

    def freedom(self, dt: float, others: Sequence[tuple[Host, Floats]] = ()) -> Freedom:
        """By the masses alone, whatever motors and contacts hold: a base that gives way more than it does is
        the stable side, and one that is held feels the rod all the same. Of accelerations PyBullet tells
        none. A body that flies has gravity's, joints those by gravity and what their motors exerted in the
        last step; others, and joints without motors, are taken to go on as they move."""
        bullet, carrier = self.bullet, self._carrier()
        hosts = [self, *(host for host, _ in others if isinstance(host, BulletLink))]
        motions = [host.motion() for host in hosts]
        twist = np.concatenate([motion.velocity for motion in motions])
        if carrier == -2:
            mobility, gained = self._by_joints(hosts)
            twist += dt * gained
        elif carrier is None:
            mobility = np.zeros((len(twist), len(twist)))
        else:
            if not self._joints():
                twist.reshape(-1, 6)[:, :3] += dt * bullet.gravity
            mobility = self._alone(carrier, [motion.pose[:3] for motion in motions])
        for k, (_, wrench) in enumerate(others, 1):
            twist += dt * mobility[:, 6 * k : 6 * k + 6] @ wrench
        return Freedom(mobility, twist, carrier not in (None, -2) and not self._joints())

    def _by_joints(self, hosts: Sequence[BulletLink]) -> tuple[Floats, Floats]:
        """J M^-1 J^T of a body that stands, and the accelerations by its motors."""
        bullet, joints = self.bullet, self._joints()
        zeros = [0.0] * len(joints)
        q, rate, _, exerted = map(list, zip(*bullet.getJointStates(self.body, joints), strict=True))
        # its point is in the link's URDF frame, though PyBullet's guide has that of the centre of mass
        slopes = [
            bullet.calculateJacobian(self.body, host.link, host._position.tolist(), q, zeros, zeros)
            for host in hosts
        ]
        jacobian, unbalanced = np.concatenate(slopes, axis=None).reshape(-1, len(joints)), np.array(exerted)
        if unbalanced.any():
            unbalanced -= bullet.calculateInverseDynamics(self.body, q, rate, zeros)
        each = np.column_stack([jacobian.T, unbalanced])
        gained = jacobian @ np.linalg.solve(np.array(bullet.calculateMassMatrix(self.body, q)), each)
        return gained[:, :-1], gained[:, -1]

    def _alone(self, link: int, points: Sequence[Floats]) -> Floats:
        """Mobility at these points (3,) of a link, as if nothing were joined to it."""
        bullet = self.bullet
        mass, _, inertia = bullet.getDynamicsInfo(self.body, link)[:3]
        pose = com_motion(bullet, self.body, link).pose
        by_wrench = inverse_inertia(mass, np.array(inertia), pose)
        slopes = np.tile(np.eye(6), (len(points), 1, 1))
        slopes[:, :3, 3:] = [np.cross(point - pose[:3], np.eye(3)) for point in points]  # -[arm]x
        jacobian = slopes.reshape(-1, 6)
        return np.asarray(jacobian @ by_wrench @ jacobian.T)

    def exert(self, wrench: Floats) -> None:
        """(6,) force [N] and moment about the base point [N m], world, during the next stepSimulation."""
        point = self.motion().pose[:3]
        exert(self.bullet, self.body, self.link, wrench, point)


def link_motion(bullet: Bullet, body: int, link: int) -> Motion:
    """Motion of a link's URDF frame."""
    pose, velocity = com_motion(bullet, body, link)
    inertial = bullet.getDynamicsInfo(body, link)
    # com_from_frame, for bodies whose mass is off their origin
    back = bullet.invertTransform(inertial[3], inertial[4])
    position, quaternion = bullet.multiplyTransforms(pose[:3].tolist(), to_xyzw(pose[3:]).tolist(), *back)
    velocity[:3] += cross(velocity[3:], np.subtract(position, pose[:3]))
    return Motion(np.array([*position, *from_xyzw(quaternion)]), velocity)


def com_motion(bullet: Bullet, body: int, link: int) -> Motion:
    """Motion of the frame of a link's centre of mass."""
    if link < 0:
        position, quaternion = bullet.getBasePositionAndOrientation(body)
        linear, angular = bullet.getBaseVelocity(body)
    else:
        state = bullet.getLinkState(body, link, computeLinkVelocity=1, computeForwardKinematics=1)
        if state is None:
            bullet.check(body, link)
        position, quaternion, linear, angular = state[0], state[1], state[6], state[7]
    return Motion(np.array([*position, *from_xyzw(quaternion)]), np.array([*linear, *angular]))


def exert(bullet: Bullet, body: int, link: int, wrench: Floats, point: Floats) -> None:
    """A wrench (6,) about a world point on a link, world frame, during the next stepSimulation."""
    bullet.applyExternalForce(body, link, wrench[:3].tolist(), point.tolist(), bullet.WORLD_FRAME)
    bullet.applyExternalTorque(body, link, wrench[3:].tolist(), bullet.WORLD_FRAME)


def mount_pose(position: ArrayLike, quaternion: ArrayLike) -> tuple[Floats, Floats]:
    """Position (3,) [m] and quaternion (4,) w x y z of a mount; `InputError` for what is none."""
    place = checked_array("position", position, [(3,)], "of the mount [m]")
    turned = checked_array("quaternion", quaternion, [(4,)], "of the mount, w x y z")
    return place, checked_pose("the mount", np.concatenate([place, turned]))[3:]
