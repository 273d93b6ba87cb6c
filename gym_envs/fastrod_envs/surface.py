"""`ReachableSurface`: what a single segment without extension can reach, and the nearest point of it to
points of a plane."""

from __future__ import annotations

from dataclasses import replace
from typing import final

import numpy as np

from fastrod.effects.base import Seam, get_effect
from fastrod.effects.pipeline import named_effects
from fastrod.model.robot import Robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.simulator import Simulator
from fastrod.types import Floats

_RINGS, _SPOKES = 25, 48
# Gauss-Newton; each takes a tenth of what the last left, as the surface is far flatter than it is away
_PASSES = 12


@final
class ReachableSurface:
    """The surface as a camera on the base measures it, in the base frame, for points up to `radius` [m] from
    the axis at one `height` [m].

    Effects between motor and tendon change how a point is reached, and not which points; they are left out.
    Those of load, material and sensing are in.
    """

    def __init__(self, robot: Robot, *, height: float, radius: float) -> None:
        tables = named_effects(robot)
        kept = tuple(
            {"name": name, **table}
            for name, table in tables.items()
            if get_effect(name).seam is not Seam.ACTUATION
        )
        plain = replace(robot, effects=kept, base_position=(0.0, 0.0, 0.0))
        self._height, self._radius = height, radius
        rho, phi = np.meshgrid(
            np.linspace(0.0, radius, _RINGS), np.arange(_SPOKES) * 2.0 * np.pi / _SPOKES, indexing="ij"
        )
        goal = np.stack([rho * np.cos(phi), rho * np.sin(phi), np.full_like(rho, height)], axis=-1).reshape(
            -1, 3
        )
        actions = SegmentActions(plain)
        simulator = Simulator(plain, n_robots=len(goal), points_per_segment=10, outputs="tip")
        q = goal[:, :2] * 2.0 * actions.offset[0] / plain.segments[0].length
        for _ in range(_PASSES):
            full = np.zeros((len(goal), 3))
            full[:, 1:] = q
            simulator.settle(**actions.inputs(full))
            seen = simulator.measure().tip_position
            jacobian = simulator.jacobian()[:, :3] @ actions.matrix[:, 1:]
            q = q + np.einsum("nij,nj->ni", np.linalg.pinv(jacobian), goal - seen)
        full[:, 1:] = q
        simulator.settle(**actions.inputs(full))
        self._offset = (simulator.measure().tip_position - goal).reshape(_RINGS, _SPOKES, 3)

    def nearest(self, points: Floats) -> Floats:
        """(n, 3) points in reach that are nearest to `points` (n, 3) of the plane, base frame [m]."""
        rho = np.clip(np.sqrt(points[:, 0] ** 2 + points[:, 1] ** 2) / self._radius, 0.0, 1.0) * (_RINGS - 1)
        phi = np.mod(np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi), 1.0) * _SPOKES
        i, j = np.minimum(rho.astype(np.int64), _RINGS - 2), phi.astype(np.int64) % _SPOKES
        a, b = (rho - i)[:, None], (phi - np.floor(phi))[:, None]
        k = (j + 1) % _SPOKES
        low = (1.0 - b) * self._offset[i, j] + b * self._offset[i, k]
        high = (1.0 - b) * self._offset[i + 1, j] + b * self._offset[i + 1, k]
        return np.asarray(points + (1.0 - a) * low + a * high)
