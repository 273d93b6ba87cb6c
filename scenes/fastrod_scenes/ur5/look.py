"""Looking at a point with the tip of a soft robot: by how much the line of sight misses it, and how that
changes with the actions."""

from __future__ import annotations

import math

import numpy as np

from fastrod.types import Floats


def miss(tip: Floats, rotation: Floats, point: Floats) -> Floats:
    """(2,) what the line of sight, d3 of the tip, is off the point: toward d1 and d2 of the tip, along an arc
    about the tip [m].

    `tip` (3,) world [m]; `rotation` (3, 3) world_from_tip; `point` (3,) world [m].
    """
    x, y, z = rotation.T @ (point - tip)
    aside, far = math.hypot(x, y), math.hypot(x, y, z)
    if aside < 1e-12 * far:
        return np.array([0.0 if z > 0.0 else math.pi * far, 0.0])  # behind it, either direction is as good
    return far * math.atan2(aside, z) / aside * np.array([x, y])


def aim_jacobian(tip: Floats, rotation: Floats, point: Floats, jacobian: Floats) -> Floats:
    """(2, n) motion of the point where the line of sight ends, as far away as `point`, toward d1 and d2, per
    motion of the coordinates.

    `jacobian` (6, n) of the tip: position [m], then rotation vector [rad], world. Where it is this long, the
    line of sight rotates with the tip, and moves with it.
    """
    sight = np.linalg.norm(point - tip) * rotation[:, 2]
    moved = jacobian[:3] + np.cross(jacobian[3:].T, sight).T
    return np.asarray(rotation[:, :2].T @ moved)
