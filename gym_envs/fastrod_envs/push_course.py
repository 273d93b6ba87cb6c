"""Geometry of pushing a cube, and three numbers that drive the robot: for Push and QuadrupedPush."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from fastrod.errors import InputError
from fastrod.model.robot import Robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.simulator import Simulator
from fastrod.types import Floats


@dataclass(frozen=True, kw_only=True)
class Course:
    """Course of a push: robot, cube and goal."""

    robot: Robot
    """Carries the bar at its tip, along its d2."""
    place: tuple[float, float]
    """Middle of the cube at first, x and y, world [m]."""
    least: tuple[float, float]
    """Corner of the goals' rectangle, x and y, world [m]."""
    largest: tuple[float, float]
    """The other corner."""
    steepness: float
    """k of the reward exp(-k d^2) [1/m^2]."""
    width: float = 0.08
    """Width of the bar, without its round ends [m]."""
    thickness: float = 0.022
    """Radius of the bar, more than the robot's: the cube meets the bar [m]."""
    size: float = 0.08
    """Edge of the cube [m]."""
    mass: float = 0.05
    """Mass of the cube [kg]."""
    gap: float = 0.02
    """Between bar and cube at first [m]."""
    bend: float = 0.6
    """Largest of a segment [rad]."""

    @property
    def height(self) -> float:
        """At which the bar pushes: little above half the cube's, so that it clears the floor where it is
        tilted [m]."""
        return 0.5 * self.size + 0.005

    @property
    def behind(self) -> float:
        """Return the distance from the cube's middle to a tip whose bar touches it straight behind [m]."""
        return 0.5 * self.size + self.thickness


@final
class Drive:
    """Three numbers for all segments alike: extension, bends toward d1 and d2 as displacements [m]."""

    def __init__(self, robot: Robot, bend: float) -> None:
        """`bend`: the largest of a segment, each way [rad]."""
        self.actions = SegmentActions(robot)
        n, offset = robot.n_segments, self.actions.offset
        self.spread: Floats = np.zeros((3 * n, 3))
        """(3 n_segments, 3) displacements of the segments by these numbers."""
        for k in range(3):
            self.spread[k::3, k] = 1.0
        short, long = (f(segment.extension[i] for segment in robot.segments) for f, i in ((max, 0), (min, 1)))
        side = bend * float(offset.min())
        self.low: Floats = np.array([short, -side, -side])
        """(3,) [m]"""
        self.high: Floats = np.array([long, side, side])
        """(3,) [m]"""
        self.rate: Floats = np.array([0.06, 0.5 * float(offset.min()), 0.5 * float(offset.min())])
        """(3,) the largest rate [m/s]: half a radian a second in each segment."""

    def inputs(self, q: Floats) -> Any:
        """Inputs of the simulator for these numbers (3,)."""
        return self.actions.inputs(self.spread @ q)

    def jacobian(self, simulator: Simulator) -> Floats:
        """(3, 3) d(tip)/d(these numbers), world; zero where the rod's is not known."""
        return np.asarray(np.nan_to_num(simulator.jacobian()[0, :3] @ self.actions.matrix) @ self.spread)

    def posture(self, q: Floats) -> Floats:
        """(3,) from -1, the least, to 1, the largest."""
        return np.asarray((2.0 * q - self.low - self.high) / (self.high - self.low))

    def action_at(self, posture: Floats) -> Floats:
        """(3,) of a posture from -1 to 1."""
        return np.asarray(0.5 * (self.low + self.high) + 0.5 * (self.high - self.low) * posture)

    def posture_for(self, simulator: Simulator, tip: Floats) -> Floats:
        """(3,) with which the tip of a simulated robot is there, world [m], by Newton's method."""
        q = self.action_at(np.zeros(3))
        for _ in range(30):
            at = simulator.settle(**self.inputs(q)).tip_position[0]
            off = tip - at
            q = np.clip(
                q + np.linalg.solve(self.jacobian(simulator), np.clip(off, -0.05, 0.05)), self.low, self.high
            )
        if np.abs(off).max() > 1e-4:
            raise InputError(
                f"robot {simulator.robots[0].name!r} does not reach {tip.round(3).tolist()} m, "
                "where its tip is to begin."
            )
        return q


def longer(robot: Robot, length: float, extension: tuple[float, float]) -> Robot:
    """A robot whose segments have this length and extension [m]."""
    return replace(
        robot,
        segments=tuple(replace(segment, length=length, extension=extension) for segment in robot.segments),
    )
