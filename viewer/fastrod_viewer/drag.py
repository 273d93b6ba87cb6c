"""Inverse kinematics of a drag of the tip, step by step."""

from __future__ import annotations

import numpy as np

from fastrod.model.robot import Robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.types import Floats

GAIN = 8.0
"""1/s: the tip is where it is dragged to within an eighth of a second."""
FARTHEST = 0.25
"""Of the robot's length: a tip that is dragged farther counts as this far."""
DAMPING = 0.02
"""Of the robot's length by 1 rad: where less than that moves the tip, the motion is given up rather than the
segments thrown about."""
JOINT_RATE = 0.4
"""Largest of a host's joint in a drag [rad/s]."""
JOINT_COST = 25.0
"""Weight of a joint's 1 rad, where that of a segment's bend by 1 rad is 1: the soft robot goes first."""


def drag_rates(
    robot: Robot,
    actions: SegmentActions,
    action: Floats,
    jacobian: Floats,
    error: Floats,
    limits: tuple[Floats, Floats, Floats],
    dt: float,
) -> Floats:
    """Return the rates (n_joints + n_actions,) of a host's joints [rad/s] and of the segments' actions [m/s]
    for the next `dt` [s].

    `action` (n_actions,) now [m]; `jacobian` (3, n_joints + n_actions) of the tip; `error` (3,) from the tip
    to the drag point [m]; `limits`: least and largest action, and largest rates, (n_actions,) each.

    The rates x that minimise |J x - gain error|^2 + l^2 sum of weight x^2 within the limits: damped least
    squares (Wampler 1986, Nakamura and Hanafusa 1986) with bounds. `ResolvedRate` would keep the direction of
    the error, or stand still; a drag may pull anywhere, also where a robot at its limits can follow only
    partly.
    """
    from scipy.optimize import lsq_linear

    lower, upper, most = limits
    n = jacobian.shape[1] - actions.n_actions
    weight = np.concatenate([np.full(n, JOINT_COST), 1.0 / np.repeat(actions.offset, 3) ** 2])
    weight[n::3] = 1.0 / np.maximum((upper - lower)[::3], 1e-3) ** 2
    rate = np.concatenate([np.full(n, JOINT_RATE), most])
    least, largest = -rate, rate.copy()
    least[n:] = np.maximum(least[n:], (lower - action) / dt)
    largest[n:] = np.minimum(largest[n:], (upper - action) / dt)
    moves = largest - least > 1e-9 * rate
    size = float(np.linalg.norm(error))
    wanted = GAIN * error * min(1.0, FARTHEST * robot.length / max(size, 1e-12))
    scale = 1.0 / np.sqrt(weight[moves])  # unknowns of one size
    rows = np.concatenate([jacobian[:, moves] * scale, DAMPING * robot.length * np.eye(int(moves.sum()))])
    found = lsq_linear(
        rows,
        np.concatenate([wanted, np.zeros(int(moves.sum()))]),
        (least[moves] / scale, largest[moves] / scale),
        method="bvls",
    )
    rates = np.zeros(len(rate))
    rates[moves] = scale * found.x
    return rates
