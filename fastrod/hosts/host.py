"""`Host`: what carries a rod's base, how it moves, and how it gives way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from fastrod.rotation import displaced, matrix_from_quaternion
from fastrod.types import Floats


class Motion(NamedTuple):
    """Motion of a frame, world; several frames have an axis before."""

    pose: Floats
    """(7,) position [m] and quaternion w x y z, world_from_frame."""
    velocity: Floats
    """(6,) of the frame's origin [m/s], then angular velocity [rad/s]."""

    def after(self, time: float) -> Floats:
        """(7,) pose after this time [s] at constant velocity."""
        return displaced(self.pose, time * self.velocity)


def inverse_inertia(mass: float, inertia: Floats, pose: Floats) -> Floats:
    """(6, 6) linear and angular acceleration of a free body by force at its centre of mass and moment, world,
    of its `inertia` (3,) about the axes of that frame (7,) [kg m^2]; 0 of a `mass` 0 [kg], which stands."""
    found = np.zeros((6, 6))
    if mass > 0.0:
        rotation = matrix_from_quaternion(pose[None, 3:])[0]
        found[:3, :3] = np.eye(3) / mass
        found[3:, 3:] = rotation @ (rotation.T / np.maximum(inertia, 1e-12)[:, None])
    return found


class Freedom(NamedTuple):
    """Compliance of a body to a rod within a step; several bodies have an axis before. Of `m` bases that move
    together both arrays are as long as all of them, one base after the other."""

    inverse_inertia: Floats
    """(6, 6) J M^-1 J^T: linear and angular acceleration of the base by force and moment there, world; 0 of
    what is held."""
    twist: Floats
    """(6,) of the base at the end of the step if there were no rod, by which it also goes there, world:
    engines step velocities first."""
    may_be_held: bool = False
    """Whether the twist leaves out what holds the body against its rods, as a floor does."""


class Host(Protocol):
    """A rigid body that a rod stands on: its motion goes into the rod, the rod's wrench goes into it."""

    def motion(self) -> Motion:
        """Motion of the rod's base: origin at the first node, z along the rod."""

    def moves_with(self, other: Host) -> bool:
        """Whether a force there may move this base within a step, and the other way round."""

    def freedom(self, dt: float, others: Sequence[tuple[Host, Floats]] = ()) -> Freedom:
        """In the host's next step, of `dt` [s]. `others` that move with it, with the wrench (6,) that each
        feels in this step already: then of all these bases, this one first."""

    def exert(self, wrench: Floats) -> None:
        """Feel (6,) force [N] and moment about the base point [N m], world, during the host's next step, with
        what was exerted for that before."""
