"""`[Robot] -> Layout, Params, Rest`: robots as arrays, robot axis first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fastrod.errors import RobotError
from fastrod.model.robot import Robot
from fastrod.types import Floats, Layout, Params

_INEXTENSIBLE = 1e-9  # m/N; below it the tensions of three tendons that lock the twist grow without bound


class DefaultInputs(NamedTuple):
    """Default values of the ports; robot axis 1 or n_robots."""

    stiffness: Floats
    """(n_robots, n_segments, 1, 3) diag K [N m^2]."""
    precurvature: Floats
    """(n_robots, n_segments, 1, 3) [1/m]."""
    weight: Floats
    """(n_robots, n_segments, 1, 3) self-weight as line force, world [N/m]."""
    line_density: Floats
    """(n_robots, n_segments) [kg/m]."""
    base_pose: Floats
    """(n_robots, 7) [m], w x y z."""
    extension_range: Floats
    """(n_robots, n_segments, 2) smallest and largest change of length [m]."""


def compile_robots(robots: Sequence[Robot], n_steps: int) -> tuple[Layout, Params, DefaultInputs]:
    """Arrays of the robots of one batch; a single robot stands for all.

    Robots may differ in every number, but not in their counts, modes or routing: `RobotError` names the one
    that does.
    """
    first = robots[0]
    for i, robot in enumerate(robots):
        for what in ("n_segments", "n_tendons"):
            if getattr(robot, what) != getattr(first, what):
                here, there = getattr(robot, what), getattr(first, what)
                raise RobotError(
                    f"robot {i} of the batch has {what} {here}, robot 0 has {there}; counts must agree."
                )
        if [s.mode for s in robot.segments] != [s.mode for s in first.segments] or list(
            robot.tendon_segment
        ) != list(first.tendon_segment):
            raise RobotError(
                f"robot {i} of the batch has other segment modes or tendon ends than robot 0; "
                "they must agree."
            )
        if [len(s.lumps) for s in robot.segments] != [len(s.lumps) for s in first.segments]:
            raise RobotError(
                f"robot {i} of the batch has lumps on other segments than robot 0, or more or fewer; their "
                "counts must agree: a lump of mass 0 stands for none."
            )
    return _layout(first, n_steps), _params(robots), _rest(robots)


def _layout(robot: Robot, n_steps: int) -> Layout:
    ends = robot.tendon_segment
    paper = robot.segments[0].mode == "paper"
    free = [t for t in range(robot.n_tendons) if robot.segments[ends[t]].mode == "tendon_length"]
    return Layout(
        first_tendon=np.searchsorted(ends, np.arange(robot.n_segments)).astype(np.int64),
        tendon_segment=ends,
        free_tendon=np.array(free, np.int64),
        row_tendon=np.arange(robot.n_tendons, dtype=np.int64) if paper else np.array(free, np.int64),
        paper=int(paper),
        n_steps=n_steps,
    )


def _params(robots: Sequence[Robot]) -> Params:
    tendons = [robot.tendons for robot in robots]
    offset = np.zeros((len(robots), robots[0].n_segments, robots[0].n_tendons, 2))
    for i, robot in enumerate(robots):
        for t, (tendon, end) in enumerate(zip(robot.tendons, robot.tendon_segment, strict=True)):
            offset[i, : end + 1, t] = tendon.position(int(end) + 1)
    length = np.array([robot.length for robot in robots])
    softest = np.array([min(min(s.bending_stiffness) for s in robot.segments) for robot in robots])
    distance = np.linalg.norm(offset, axis=-1)
    mean_offset = (
        distance.sum((1, 2)) / np.maximum((distance > 0.0).sum((1, 2)), 1) if robots[0].n_tendons else length
    )
    return Params(
        length=np.array([[s.length for s in robot.segments] for robot in robots]),
        offset=offset,
        compliance=np.array([[max(t.compliance, _INEXTENSIBLE) for t in row] for row in tendons]).reshape(
            len(robots), -1
        ),
        pretension=np.array([[t.pretension for t in row] for row in tendons]).reshape(len(robots), -1),
        unilateral=np.array([[t.unilateral for t in row] for row in tendons], dtype=bool).reshape(
            len(robots), -1
        ),
        moment_scale=softest / length,
        tension_scale=softest / (mean_offset * length),
        rod_length=length,
    )


def _rest(robots: Sequence[Robot]) -> DefaultInputs:
    stiffness = np.array(
        [[(*s.bending_stiffness, s.torsional_stiffness) for s in robot.segments] for robot in robots]
    )
    precurvature = np.array([[s.precurvature for s in robot.segments] for robot in robots])
    weight = np.array(
        [[np.multiply(s.line_density, robot.gravity) for s in robot.segments] for robot in robots]
    )
    return DefaultInputs(
        stiffness=stiffness[:, :, None, :],
        precurvature=precurvature[:, :, None, :].astype(float),
        weight=weight[:, :, None, :].astype(float),
        line_density=np.array([[s.line_density for s in robot.segments] for robot in robots], dtype=float),
        base_pose=np.array([(*robot.base_position, *robot.base_quaternion) for robot in robots], dtype=float),
        extension_range=np.array([[s.extension for s in robot.segments] for robot in robots], dtype=float),
    )
