"""Pictures of states: poses, sizes and colours of instances of a few unit meshes; independent of a browser.

The one door of `picture`, `fittings`, `arrows`, `legend`, `options` and `shapes`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from fastrod.rotation import matrix_from_quaternion
from fastrod.types import Floats
from fastrod_viewer.picture.arrows import Trail, arrows, ghost
from fastrod_viewer.picture.batches import Picture
from fastrod_viewer.picture.legend import Legend, legend
from fastrod_viewer.picture.options import BODIES, COLOR_BY, ViewOptions
from fastrod_viewer.picture.shapes import SHAPES, DrawnMesh, Instances, ball
from fastrod_viewer.worlds.world import Body, DrawnRods

__all__ = [
    "BODIES",
    "COLOR_BY",
    "SHAPES",
    "DrawnMesh",
    "Instances",
    "Legend",
    "Picture",
    "Trail",
    "ViewOptions",
    "arrows",
    "ball",
    "bounds",
    "ghost",
    "grid_places",
    "legend",
]


_LARGE = 1.2  # m: a body that is wider is a floor or a wall, and not what one came to see
_SWAY = 0.62  # of the longest robot: what it needs to both sides


def grid_places(n: int, spacing: float) -> Floats:
    """(n, 3) places of n robots on a square grid in the plane z = 0 around the origin, `spacing` [m] apart.

    >>> grid_places(2, 0.2)
    array([[-0.1,  0. ,  0. ],
           [ 0.1,  0. ,  0. ]])
    """
    columns = int(np.ceil(np.sqrt(n)))
    cells = np.stack([np.arange(n) % columns, np.arange(n) // columns, np.zeros(n)], axis=1)
    return np.asarray(spacing * (cells - 0.5 * cells.max(0, initial=0.0)))


def bounds(rods: DrawnRods, bodies: Sequence[Body] = (), poses: Floats | None = None) -> tuple[Floats, float]:
    """Centre (3,) and radius [m] of a sphere around the robots and the bodies at `poses` (n, 7), floors and
    other large things left out:
    what a first look should show."""
    state = rods.state
    n = len(state.ok)
    longest = max(robot.length for robot in rods.robots)
    base = np.broadcast_to([robot.base_position for robot in rods.robots], (n, 3))
    orientation = matrix_from_quaternion(np.array([robot.base_quaternion for robot in rods.robots]))
    length = np.array([robot.length for robot in rods.robots])
    straight = np.stack(
        [base, base + np.broadcast_to(length[:, None] * orientation[:, :, 2], (n, 3))], axis=1
    )
    whole = state.position.size and np.isfinite(state.position).all()
    points = [((state.position if whole else straight) + rods.place[:, None]).reshape(-1, 3)]
    for body, pose in zip(bodies, np.zeros((0, 7)) if poses is None else poses, strict=True):
        ends = np.stack([body.vertices.min(axis=0), body.vertices.max(axis=0)])
        if np.ptp(ends, axis=0).max() <= max(_LARGE, 3.0 * longest):
            corners = np.array(list(itertools.product(*ends.T)), dtype=np.float64)
            points.append(pose[:3] + corners @ matrix_from_quaternion(pose[None, 3:])[0].T)
    every = np.concatenate(points)
    centre = 0.5 * (every.min(axis=0) + every.max(axis=0))
    radius = float(np.linalg.norm(every - centre, axis=1).max()) + max(rods.radius, default=0.0)
    return centre, max(radius, _SWAY * longest)
