"""`Gripper`: a head with two fingers that squeeze with a limited force, and suction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np

from fastrod.errors import HostError
from fastrod.hosts.bullet import Bullet
from fastrod.hosts.link import to_xyzw
from fastrod.rotation import rotation_between
from fastrod.types import Floats

CONTACT_DISTANCE = 1e-3
"""Surfaces nearer than this touch [m]: the engine's contacts stand open by some tenths of a millimetre."""
_FINGER = (0.006, 0.02, 0.025)  # m: thickness, width, and how far it stands out before the head
_FINGER_MASS = 0.02  # kg
_SPEED = 0.05  # m/s at which a finger opens and closes
_FINGER_FORCE = 10.0  # N, the most that a finger pushes with
_SUCTION = 200.0  # N
# head, fingers; PyBullet multiplies it with the other body's, 0.5 by default: rubber on anything is 1
_FRICTION = 0.5, 2.0
_GAIN = 0.3  # of a finger's error that its motor removes in a step
# m/s, times the step: how far a finger is commanded beyond what stops it, so that its motor pushes in full
_SQUEEZE = 0.2


@final
class Gripper:
    """A sphere at the rod's tip, which moves as commanded, and two box fingers that slide on it along the
    tip's d1, driven by motors.

    The fingers are bodies with mass: what is between them is held by friction alone, with at most 10 N a
    finger, and stops them. Both get the same command, so that what is held stays in the middle.
    """

    def __init__(
        self, bullet: Any, radius: float, max_width: float, color: Sequence[float], mass: float = 0.0
    ) -> None:
        """`radius` of the head [m]; `max_width` between the inner faces of the open fingers [m], 0 for a head
        without fingers; `mass` of the head [kg], where forces move it. Stands at the origin, fingers open.
        Raises `HostError`."""
        self.bullet = b = Bullet(bullet)
        if not 0.0 <= max_width < 1.0:
            raise HostError(
                f"max_grasp_width is {max_width!r} m; it must be from 0 (no fingers) to below 1 m."
            )
        head = b.createCollisionShape(b.GEOM_SPHERE, radius=radius)
        seen = b.createVisualShape(b.GEOM_SPHERE, radius=radius, rgbaColor=list(color))
        n, long = 2 * (max_width > 0.0), radius + _FINGER[2]
        half = [0.5 * _FINGER[0], 0.5 * _FINGER[1], 0.5 * long]
        shape, visual = -1, -1
        if n:
            shape = b.createCollisionShape(b.GEOM_BOX, halfExtents=half)
            visual = b.createVisualShape(b.GEOM_BOX, halfExtents=half, rgbaColor=[0.25, 0.25, 0.28, 1.0])
        self.body: int = b.createMultiBody(
            mass,
            head,
            seen,
            linkMasses=[_FINGER_MASS] * n,
            linkCollisionShapeIndices=[shape] * n,
            linkVisualShapeIndices=[visual] * n,
            linkPositions=[[0.0, 0.0, 0.5 * long]] * n,
            linkOrientations=[[0.0, 0.0, 0.0, 1.0]] * n,
            linkInertialFramePositions=[[0.0] * 3] * n,
            linkInertialFrameOrientations=[[0.0, 0.0, 0.0, 1.0]] * n,
            linkParentIndices=[0] * n,
            linkJointTypes=[b.JOINT_PRISMATIC] * n,
            linkJointAxis=[[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]][:n],
        )
        """The head is its base, the fingers are its links 0 and 1."""
        self.links = range(-1, n)
        self.fingers = range(n)
        self.length = long
        """Distance from the tip to the fingers' ends [m]."""
        undamped = dict.fromkeys(("restitution", "linearDamping", "angularDamping", "jointDamping"), 0.0)
        for link in self.links:
            b.changeDynamics(self.body, link, lateralFriction=_FRICTION[link >= 0], **undamped)
        for finger in self.fingers:
            # without it what is held creeps down, 5 mm/s with steps of 10 ms
            b.changeDynamics(self.body, finger, frictionAnchor=1)
        self._max, self._wanted, self._commanded = max_width, max_width, max_width
        self._held = False
        for finger in self.fingers:
            b.resetJointState(self.body, finger, 0.5 * (max_width + _FINGER[0]))
        self._command_fingers()
        self._position, self._quaternion = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
        self._suction: tuple[int, int, list[tuple[int, int]]] | None = None

    @property
    def width(self) -> float:
        """Between the inner faces of the fingers [m]; 0 without fingers."""
        middles = [float(self.bullet.getJointState(self.body, f)[0]) for f in self.fingers]
        return sum(middles) - 0.5 * _FINGER[0] * len(middles)

    def open_to(self, fraction: float) -> None:
        """Command the fingers to this fraction of the largest width; they move there at 5 cm/s, as time
        passes."""
        self._wanted, self._held = fraction * self._max, False

    def place(self, position: Floats, quaternion: Floats) -> None:
        """Stand at rest at `position` (3,) world [m], rotated by `quaternion` (4,) w x y z."""
        self._position, self._quaternion = position.copy(), quaternion.copy()
        self.bullet.resetBasePositionAndOrientation(
            self.body, position.tolist(), to_xyzw(quaternion).tolist()
        )
        self.bullet.resetBaseVelocity(self.body, [0.0] * 3, [0.0] * 3)

    def head_for(self, position: Floats, quaternion: Floats, dt: float) -> None:
        """Move so that the next step of `dt` [s] ends at this pose; `place` it there afterwards."""
        linear = (position - self._position) / dt
        angular = rotation_between(self._quaternion[None], quaternion[None])[0] / dt
        self.bullet.resetBaseVelocity(self.body, linear.tolist(), angular.tolist())

    def drive(self, dt: float) -> None:
        """Command the fingers' motion in the next step; call it before each."""
        if self._held and not self._touching():
            self._held = False  # what was held has gone
        if self._held or self._commanded == self._wanted:
            return
        step, beyond = _SPEED * dt, max(_SQUEEZE * dt, 5e-4)
        if (
            self._wanted < self._commanded
            and self.width - self._commanded > 2.0 * (beyond + step / _GAIN)
            and self._touching()
        ):
            self._held = True
            self._commanded = self.width - 2.0 * beyond
        else:
            self._commanded += float(np.clip(self._wanted - self._commanded, -2.0 * step, 2.0 * step))
        self._command_fingers()

    def attach(self, others: Sequence[int]) -> int | None:
        """Fix to the head the nearest movable body that it touches, as it stands; `others` of the robot that
        are near pass through it while it is held. Return the body, or None where there is none."""
        self.release()
        b = self.bullet
        own = {self.body, *others}
        known = [b.getBodyUniqueId(i) for i in range(b.getNumBodies())]
        near = (b.getClosestPoints(self.body, other, CONTACT_DISTANCE) for other in known if other not in own)
        points = [p for found in near for p in found if b.getDynamicsInfo(p[2], p[4])[0] > 0.0]
        if not points:
            return None
        nearest = min(points, key=lambda p: float(p[8]))
        body, link = int(nearest[2]), int(nearest[4])
        pose = (
            b.getBasePositionAndOrientation(body)
            if link < 0
            else b.getLinkState(body, link, computeForwardKinematics=1)[:2]
        )
        back = b.invertTransform(*b.getBasePositionAndOrientation(self.body))
        position, orientation = b.multiplyTransforms(*back, *pose)
        frames = [0.0] * 3, position, [0.0] * 3, orientation, [0.0, 0.0, 0.0, 1.0]
        hold = b.createConstraint(self.body, -1, body, link, b.JOINT_FIXED, *frames)
        b.changeConstraint(hold, maxForce=_SUCTION)
        pairs = [(self.body, own_link) for own_link in self.links]
        pairs += [(other, -1) for other in others if b.getClosestPoints(other, body, self.length)]
        self._suction = hold, body, pairs
        self._filter(0)
        return body

    def release(self) -> None:
        """Let go of what is attached, if anything is."""
        if self._suction is not None:
            hold, body, _ = self._suction
            # nobody removed it meanwhile
            if any(self.bullet.getBodyUniqueId(i) == body for i in range(self.bullet.getNumBodies())):
                self.bullet.removeConstraint(hold)
                self._filter(1)
            self._suction = None

    def remove(self) -> None:
        """Let go, and leave the world."""
        self.release()
        self.bullet.removeBody(self.body)

    def _touching(self) -> bool:
        """Return whether both fingers had contact in the last step."""
        return all(
            self.bullet.getContactPoints(bodyA=self.body, linkIndexA=finger) for finger in self.fingers
        )

    def _command_fingers(self) -> None:
        for finger in self.fingers:
            self.bullet.setJointMotorControl2(
                self.body,
                finger,
                self.bullet.POSITION_CONTROL,
                targetPosition=0.5 * (self._commanded + _FINGER[0]),
                force=_FINGER_FORCE,
                positionGain=_GAIN,
                velocityGain=1.0,
                maxVelocity=1.0,
            )

    def _filter(self, collide: int) -> None:
        assert self._suction is not None
        _, body, pairs = self._suction
        for own, own_link in pairs:
            for link in range(-1, self.bullet.getNumJoints(body)):
                self.bullet.setCollisionFilterPair(own, body, own_link, link, collide)
