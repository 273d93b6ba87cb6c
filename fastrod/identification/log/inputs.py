"""A run log as inputs of the simulator."""

from __future__ import annotations

import numpy as np

from fastrod.errors import InputError
from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Robot
from fastrod.rotation import matrix_from_quaternion
from fastrod.types import Floats


def tendon_length(log: RunLog, robot: Robot) -> Floats | None:
    """(n, n_tendons) absolute tendon lengths [m]; None without tendons.

    `dl` is counted from the straight rest robot, extension and all: a robot that grows straight pays out its
    tendons.
    """
    return np.asarray(robot.rest_tendon_length + log.dl, dtype=np.float64) if robot.n_tendons else None


def inputs(log: RunLog, robot: Robot) -> dict[str, Floats]:
    """Keyword inputs of `Simulator.settle` for the rows of `log`: world frame, SI, robot axis first."""
    given: dict[str, Floats] = {}
    if log.tension is not None:
        given["tension"] = log.tension
    elif (lengths := tendon_length(log, robot)) is not None:
        given["tendon_length"] = lengths
    if log.ext is not None:
        given["extension"] = log.ext
    if log.base_quaternion is not None:
        position = np.broadcast_to(np.array(robot.base_position), (len(log), 3))
        given["base_pose"] = np.concatenate([position, log.base_quaternion], axis=1)
    if log.tip_force is not None or log.payload is not None:
        given["tip_force"] = _tip_force(log, robot)
    return given


def check_driven(log: RunLog, robot: Robot) -> None:
    """Raises `InputError` for a robot that is driven by lengths and by forces, or by what the log lacks."""
    modes = {segment.mode for segment in robot.segments if segment.tendons}
    if "tendon_tension" in modes and len(modes) > 1:
        raise InputError(
            f"robot {robot.name!r} has segments in mode 'tendon_tension' and others; a run log gives the "
            "lengths of all tendons, or the forces on all."
        )
    if robot.by_tension != (log.tension is not None):
        driven, given = ("forces", "lengths") if robot.by_tension else ("lengths", "forces")
        raise InputError(
            f"robot {robot.name!r} is driven by tendon {driven}, and log {log.name!r} gives {given}; mode of "
            f"its segments would be 'tendon_{'length' if robot.by_tension else 'tension'}'."
        )


def base_of(log: RunLog, robot: Robot) -> tuple[Floats, Floats]:
    """world_from_base (n, 3, 3) of each row, and the base's position in the world [m]."""
    quaternion = (
        log.base_quaternion
        if log.base_quaternion is not None
        else np.tile(robot.base_quaternion, (len(log), 1))
    )
    return matrix_from_quaternion(quaternion), np.array(robot.base_position)


def _tip_force(log: RunLog, robot: Robot) -> Floats:
    """(n, 3) force on the tip, world [N]: the log's, turned with the base, and the weight of the payload."""
    force = np.zeros((len(log), 3))
    if log.tip_force is not None:
        force += np.einsum("nij,nj->ni", base_of(log, robot)[0], log.tip_force)
    if log.payload is not None:
        force += log.payload[:, None] * np.array(robot.gravity)
    return force
