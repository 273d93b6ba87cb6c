"""`RodBodies`: a rod as capsules in a PyBullet world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np

from fastrod.errors import HostError
from fastrod.hosts.bullet import Bullet
from fastrod.hosts.capsules import chords
from fastrod.hosts.link import to_xyzw
from fastrod.rotation import rotation_between
from fastrod.types import Floats


@final
class RodBodies:
    """Capsules along the backbone, their axes its chords and their cross-sections rotated with it; they have
    no mass, and move as commanded.

    A capsule pushes what it meets with the velocity at which it moves. It never touches its own kind, nor
    bodies given to `ignore`.
    """

    def __init__(
        self,
        bullet: Any,
        length: float | Sequence[float],
        radius: float | Sequence[float],
        n_capsules: int = 16,
        *,
        color: Sequence[float] = (0.5, 0.0, 0.6, 1.0),
        head_color: Sequence[float] | None = None,
        friction: float = 0.5,
    ) -> None:
        """`length` of the backbone, split evenly, or of each capsule [m]; `radius` one, or one for each
        capsule [m]; colours RGBA. Raises `HostError`."""
        fits = np.shape(length) in ((), (n_capsules,)) and np.all(np.asarray(length) > 0.0)
        if n_capsules < 1 or not fits:
            raise HostError(
                f"{n_capsules} capsules for {length} m; give at least one, and a positive length, of the "
                "whole or one for each."
            )
        self.bullet = b = Bullet(bullet)
        radii = np.broadcast_to(np.asarray(radius, float), n_capsules)
        if not (radii > 0.0).all():
            raise HostError(f"radius is {radius!r} m; it must be positive.")
        each = np.asarray(length, float) / (n_capsules if np.ndim(length) == 0 else 1)
        lengths = np.broadcast_to(each, n_capsules).tolist()
        self.ids: list[int] = []
        """Body of each capsule, base first."""
        for i, (r, own) in enumerate(zip(radii.tolist(), lengths, strict=True)):
            rgba = head_color if head_color is not None and i == n_capsules - 1 else color
            shape = b.createCollisionShape(b.GEOM_CAPSULE, radius=r, height=own)
            visual = b.createVisualShape(b.GEOM_CAPSULE, radius=r, length=own, rgbaColor=list(rgba))
            self.ids.append(b.createMultiBody(0.0, shape, visual))
            b.changeDynamics(self.ids[-1], -1, lateralFriction=friction, restitution=0.0)
        self._position = np.zeros((n_capsules, 3))
        self._quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (n_capsules, 1))

    def ignore(self, body: int) -> None:
        """Pass through a body, all its links."""
        for link in range(-1, self.bullet.getNumJoints(body)):
            for own in self.ids:
                self.bullet.setCollisionFilterPair(own, body, -1, link, 0)

    def place(self, position: Floats, rotation: Floats) -> None:
        """Stand at rest along the nodes: `position` (n_capsules + 1, 3) world [m], `rotation` (n_capsules +
        1, 3, 3)."""
        self.stand(*chords(position, rotation))

    def stand(self, center: Floats, quaternion: Floats) -> None:
        """Stand at rest with the middles there, (n_capsules, 3) world [m], rotated so, (n_capsules, 4)."""
        self._position, self._quaternion = center, quaternion
        for own, p, q in zip(self.ids, center.tolist(), to_xyzw(quaternion).tolist(), strict=True):
            self.bullet.resetBasePositionAndOrientation(own, p, q)
            self.bullet.resetBaseVelocity(own, [0.0] * 3, [0.0] * 3)

    def head_for(self, position: Floats, rotation: Floats, dt: float) -> None:
        """Move toward these nodes so that the next step of `dt` [s] ends there: what they meet feels the
        velocity. `place` them afterwards, or they keep moving."""
        to, orientation = chords(position, rotation)
        angular = rotation_between(self._quaternion, orientation)
        self.move(np.concatenate([to - self._position, angular], axis=1) / dt)

    def move(self, velocity: Floats) -> None:
        """Move at these velocities from now on, (n_capsules, 6) of the middles [m/s] and angular [rad/s],
        world."""
        for own, v in zip(self.ids, velocity.tolist(), strict=True):
            self.bullet.resetBaseVelocity(own, v[:3], v[3:])

    def remove(self) -> None:
        """Take the capsules out of the world."""
        while self.ids:
            self.bullet.removeBody(self.ids.pop())
