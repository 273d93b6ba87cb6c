"""`Host`: what carries a rod's base."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from fastrod.rotation import product, quaternion_from_vector
from fastrod.types import Floats


class Motion(NamedTuple):
    """Motion of a frame, world; several frames have an axis before."""

    pose: Floats
    """(7,) position [m] and quaternion w x y z, world_from_frame."""
    velocity: Floats
    """(6,) of the frame's origin [m/s], then angular velocity [rad/s]."""

    def after(self, time: float) -> Floats:
        """(7,) pose after this time [s] at constant velocity."""
        pose = self.pose.copy()
        pose[..., :3] += time * self.velocity[..., :3]
        pose[..., 3:] = product(quaternion_from_vector(time * self.velocity[..., 3:]), pose[..., 3:])
        return pose


class Host(Protocol):
    """A rigid body that a rod stands on: its motion goes into the rod, the rod's wrench goes into it."""

    def motion(self) -> Motion:
        """Of the rod's base: origin at the first node, z along the rod."""

    def exert(self, wrench: Floats) -> None:
        """Feel (6,) force [N] and moment about the base point [N m], world, during the host's next step."""
