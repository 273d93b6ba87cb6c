"""`Expectation`: where the model has the tip, so that of a marker's two planar poses the right one is
taken."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, final

import numpy as np

from fastrod.model.robot import Robot
from fastrod.rotation import matrix_from_quaternion, quaternion_from_matrix
from fastrod.simulator import Simulator
from fastrod.types import Floats


@final
class Expectation:
    """A model of a robot without its effects, followed step by step; good to some degrees, which is all that
    is asked."""

    def __init__(self, robot: Robot) -> None:
        self._robot = replace(robot, effects=())
        self._simulator = Simulator(self._robot, dt=0.05, points_per_segment=8, threads=1, outputs="tip")
        self._cold = True

    def pose(
        self, dl: Floats, payload: float, base_quaternion: Floats | None
    ) -> tuple[Floats, Floats] | None:
        """(3,) [m] and (4,) base_from_tip for these tendons (n_tendons,) [m], a mass at the tip [kg] and
        world_from_base (4,); None where the tendons are not known or the model finds no rest."""
        if not np.isfinite(dl).all():
            return None
        base = np.array(self._robot.base_quaternion) if base_quaternion is None else base_quaternion
        lengths = self._robot.rest_tendon_length + dl
        inputs: dict[str, Any] = {
            "base_pose": np.concatenate([np.zeros(3), base]),
            "tip_force": payload * np.array(self._robot.gravity),
        }
        state = (
            self._simulator.settle(lengths, **inputs)
            if self._cold
            else self._simulator.step(lengths, **inputs)
        )
        self._cold = not bool(state.ok[0])
        if self._cold:
            return None
        base_from_world = matrix_from_quaternion(base).T
        return base_from_world @ state.tip_position[0], quaternion_from_matrix(
            (base_from_world @ state.tip_rotation[0])[None]
        )[0]
