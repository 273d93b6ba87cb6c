"""`measure`: a world read as a robot is."""

from __future__ import annotations

import numpy as np

from fastrod.logs.link import Measurement
from fastrod.rotation import quaternion_from_matrix
from fastrod.types import Floats
from fastrod_viewer.world import ManualCommand, World


def measure(world: World, command: ManualCommand | None) -> Measurement:
    """Return what a perfect encoder and camera measure of the world's first robot now; t is the world's,
    frames those of a run log."""
    state = world.rods[0].state
    base, rotation = state.position[0, 0], state.rotation[0, 0]
    tip = rotation.T @ state.tip_rotation[0]
    if command is not None:
        change, extension = command.tendon_length - world.robot.rest_tendon_length, command.extension
    else:
        change = state.path_length[0] - _stretch(world) - world.robot.rest_tendon_length
        extension = np.diff(_ends(world), prepend=0.0) - [segment.length for segment in world.robot.segments]
    return Measurement(
        t=world.t,
        dl=change,
        ext=extension,
        tip_position=rotation.T @ (state.tip_position[0] - base),
        tip_quaternion=quaternion_from_matrix(tip[None])[0],
        tension=state.tension[0],
    )


def _stretch(world: World) -> Floats:
    """Return by how much each tendon (n_tendons,) is longer than commanded: compliance (T - pretension)
    [m]."""
    tendons = [tendon for segment in world.robot.segments for tendon in segment.tendons]
    compliance, pretension = (
        np.array([getattr(tendon, name) for tendon in tendons]) for name in ("compliance", "pretension")
    )
    return np.asarray(compliance * (world.rods[0].state.tension[0] - pretension), dtype=np.float64)


def _ends(world: World) -> Floats:
    """(n_segments,) arclength of each segment's end [m]."""
    arclength = world.rods[0].state.arclength[0]
    n = world.robot.n_segments
    return np.asarray(arclength[(len(arclength) - 1) // n :: (len(arclength) - 1) // n], dtype=np.float64)
