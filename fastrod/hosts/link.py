"""`BulletLink`: any link of any PyBullet body as the host of a rod."""

from __future__ import annotations

from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.errors import HostError
from fastrod.hosts.bullet import Bullet
from fastrod.hosts.host import Freedom, Motion
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
        `HostError`."""
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

    def freedom(self, dt: float) -> Freedom:
        """By the masses alone, whatever motors and contacts hold: a base that gives way more than it does is
        the stable side, and one that is held feels the rod all the same. Of accelerations PyBullet tells
        none. A body that flies has gravity's, joints those by gravity and what their motors exerted in the
        last step; others, and joints without motors, are taken to go on as they move."""
        bullet, motion = self.bullet, self.motion()
        point, velocity = motion.pose[:3], motion.velocity.copy()
        n = bullet.getNumJoints(self.body)
        joints = [j for j in range(n) if bullet.getJointInfo(self.body, j)[2] != bullet.JOINT_FIXED]
        heavy = bullet.getDynamicsInfo(self.body, -1)[0] > 0.0
        if not heavy and joints and self.link >= 0:
            mobility, gained = self._by_joints(joints)
            return Freedom(mobility, velocity + dt * gained)
        if not heavy:
            return Freedom(np.zeros((6, 6)), velocity)
        if not joints:
            velocity[:3] += dt * bullet.gravity
        return Freedom(self._alone(point), velocity)

    def _by_joints(self, joints: list[int]) -> tuple[Floats, Floats]:
        """J M^-1 J^T of a body that stands, and the acceleration (6,) by its motors."""
        bullet, zeros = self.bullet, [0.0] * len(joints)
        q, rate, _, exerted = map(list, zip(*bullet.getJointStates(self.body, joints), strict=True))
        # its point is in the link's URDF frame, though PyBullet's guide has that of the centre of mass
        slopes = bullet.calculateJacobian(self.body, self.link, self._position.tolist(), q, zeros, zeros)
        jacobian, unbalanced = np.concatenate(slopes), np.array(exerted)
        if unbalanced.any():
            unbalanced -= bullet.calculateInverseDynamics(self.body, q, rate, zeros)
        each = np.column_stack([jacobian.T, unbalanced])
        gained = jacobian @ np.linalg.solve(np.array(bullet.calculateMassMatrix(self.body, q)), each)
        return gained[:, :6], gained[:, 6]

    def _alone(self, point: Floats) -> Floats:
        """Mobility of the link, or of the nearest before it that has a mass, as if nothing were joined to
        it."""
        bullet, link = self.bullet, self.link
        while link >= 0 and bullet.getDynamicsInfo(self.body, link)[0] == 0.0:
            link = bullet.getJointInfo(self.body, link)[16]
        mass, _, inertia = bullet.getDynamicsInfo(self.body, link)[:3]
        pose = com_motion(bullet, self.body, link).pose
        rotation = matrix_from_quaternion(pose[None, 3:])[0]
        rotary = rotation @ (rotation.T / np.maximum(inertia, 1e-12)[:, None])
        across = np.cross(np.eye(3), point - pose[:3])  # [arm]x
        by_force = np.eye(3) / mass - across @ rotary @ across
        return np.block([[by_force, -across @ rotary], [rotary @ across, rotary]])

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
        position, quaternion, linear, angular = state[0], state[1], state[6], state[7]
    return Motion(np.array([*position, *from_xyzw(quaternion)]), np.array([*linear, *angular]))


def exert(bullet: Bullet, body: int, link: int, wrench: Floats, point: Floats) -> None:
    """A wrench (6,) about a world point on a link, world frame, during the next stepSimulation."""
    bullet.applyExternalForce(body, link, wrench[:3].tolist(), point.tolist(), bullet.WORLD_FRAME)
    bullet.applyExternalTorque(body, link, wrench[3:].tolist(), bullet.WORLD_FRAME)


def mount_pose(position: ArrayLike, quaternion: ArrayLike) -> tuple[Floats, Floats]:
    """Position (3,) [m] and quaternion (4,) w x y z of a mount; `HostError` for what is none."""
    p, q = np.asarray(position, float), np.asarray(quaternion, float)
    if p.shape != (3,) or q.shape != (4,) or not np.isfinite([*p, *q]).all():
        raise HostError(
            f"the mount is {position!r}, {quaternion!r}; give a position (3,) [m] and a "
            "quaternion (4,) w x y z."
        )
    if abs((norm := float(np.linalg.norm(q))) - 1.0) > 1e-6:
        raise HostError(
            f"the mount's quaternion {list(map(float, q))!r} has norm {norm:.6g}; it must be 1, as w x y z."
        )
    return p, q
