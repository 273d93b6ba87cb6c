"""Load of a UR5: soft robots of segments that bend and extend, and the bracket between flange and robots, for
the eye alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.hosts import BulletLink
from fastrod.hosts.link import to_xyzw
from fastrod.model.robot import Robot, Segment, Tendon
from fastrod.types import Floats

OFFSET = 0.0075
"""Offset of the tendons from the backbone [m]."""
RADIUS = 0.012
"""Radius of the body [m]."""


def soft_robot(name: str, n_segments: int, *, extension: float = 0.03, line_density: float = 0.1) -> Robot:
    """Segments of 0.1 m with four tendons each; `extension` in either direction [m], `line_density` [kg/m].

    The backbone is twice as stiff as the prototype's and four times in torsion: bent sideways, such a robot
    rotates a softer one by more than a radian with its weight.
    """
    tendons = tuple(Tendon(offset=OFFSET, angle=k * math.pi / 2.0) for k in range(4))
    segment = Segment(
        length=0.1,
        bending_stiffness=(0.005, 0.005),
        torsional_stiffness=0.004,
        body_radius=RADIUS,
        line_density=line_density,
        extension=(-extension, extension),
        tendons=tendons,
    )
    return Robot(name=name, segments=(segment,) * n_segments)


@final
class Bracket:
    """Cylinders in the frame of a link; nothing can touch them, and they weigh nothing."""

    def __init__(self, host: BulletLink, bars: Sequence[tuple[ArrayLike, ArrayLike]], radius: float) -> None:
        """`bars`: both ends of each, (3,) in the frame of `host` [m]; `radius` of all [m]."""
        self.host, b = host, host.bullet
        ends = np.asarray(bars, float)
        along = ends[:, 1] - ends[:, 0]
        places = 0.5 * (ends[:, 0] + ends[:, 1])
        quaternions = [_from_z(d / np.linalg.norm(d)) for d in along]
        n = len(ends)
        shape = b.createVisualShapeArray(
            shapeTypes=[b.GEOM_CYLINDER] * n,
            radii=[radius] * n,
            lengths=np.linalg.norm(along, axis=1).tolist(),
            visualFramePositions=places.tolist(),
            visualFrameOrientations=[to_xyzw(q).tolist() for q in quaternions],
            rgbaColors=[[0.25, 0.26, 0.28, 1.0]] * n,
        )
        self.body: int = b.createMultiBody(0.0, -1, shape)
        self.follow()

    def follow(self) -> None:
        """Be where the host is now."""
        pose = self.host.motion().pose
        self.host.bullet.resetBasePositionAndOrientation(
            self.body, pose[:3].tolist(), to_xyzw(pose[3:]).tolist()
        )


def _from_z(direction: Floats) -> Floats:
    """Return the quaternion w x y z (4,) of the shortest rotation of z to a unit vector."""
    if direction[2] < -1.0 + 1e-12:
        return np.array([0.0, 1.0, 0.0, 0.0])
    q = np.array([1.0 + direction[2], -direction[1], direction[0], 0.0])
    return np.asarray(q / np.linalg.norm(q))


def eased(fraction: float) -> float:
    """Return a smooth step from 0 at 0 to 1 at 1, at rest at both ends."""
    fraction = min(max(fraction, 0.0), 1.0)
    return fraction * fraction * fraction * (10.0 + fraction * (6.0 * fraction - 15.0))
