"""Robots of a world: a sentence on one, its actions and radii, and the inputs of a manual command."""

from __future__ import annotations

from typing import Any, final

import numpy as np

from fastrod.contact import ContactScene
from fastrod.errors import InputError, RobotError
from fastrod.model.robot import Robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.rotation import product, quaternion_from_vector
from fastrod.types import Floats
from fastrod_viewer.worlds.world import ManualCommand

_DRIVES = {
    "tendon_length": "driven by the lengths of its tendons",
    "tendon_tension": "driven by the tensions of its tendons",
    "passive": "without tendons",
    "paper": "driven by the lengths of its tendons, by the paper's reduced model",
}


def about(robot: Robot) -> str:
    """One sentence on a robot.

    >>> import fastrod
    >>> about(fastrod.load_robot("prototype"))
    'One segment, 0.07 m, driven by the lengths of its tendons.'
    """
    n = robot.n_segments
    modes = [segment.mode for segment in robot.segments]
    passive = [str(k + 1) for k, mode in enumerate(modes) if mode == "passive"]
    how = " and ".join(
        _DRIVES[mode] for mode in dict.fromkeys(modes) if mode != "passive" or len(passive) == n
    )
    if 0 < len(passive) < n:
        how += f", of which segment {' and '.join(passive)} has none"
    return (
        f"{'One segment' if n == 1 else f'{n} segments'}, {robot.length:g} "
        f"m{' in all' if n > 1 else ''}, {how}."
    )


@final
class Loads:
    """Loads of a manual command: tip force, payload, more or less gravity."""

    def __init__(self, robot: Robot, *, hosted: bool = False) -> None:
        """A robot that is `hosted` has its host's gravity; more or less of it is then a load along the
        rod."""
        self._gravity, self._hosted = np.array(robot.gravity), hosted
        density = np.array([segment.line_density for segment in robot.segments])
        # (n_segments, 2, 3) [N/m]
        self._weight: Floats = np.repeat((density[:, None] * self._gravity)[:, None], 2, axis=1)

    def added(self, given: dict[str, Any], command: ManualCommand) -> dict[str, Any]:
        """`given` with these loads on top of its own, as `Simulator.step` takes them."""
        force = (
            np.asarray(command.tip_force, dtype=np.float64)
            + command.payload * command.gravity * self._gravity
        )
        more: dict[str, Any] = {"tip_force": force + np.asarray(given.get("tip_force", np.zeros(3)))}
        if command.gravity != 1.0 and not self._hosted:
            more["gravity"] = command.gravity * self._gravity
        elif command.gravity != 1.0 and self._weight.any():
            own = np.asarray(given.get("line_force", np.zeros(3)), dtype=np.float64)
            own = own[:, None, None] if own.ndim == 2 else own
            more["line_force"] = own + (command.gravity - 1.0) * self._weight
        return {**given, **more}


def actions_of(robot: Robot) -> SegmentActions | None:
    """Return the actions of its segments; None unless they are driven by tendon lengths."""
    try:
        return SegmentActions(robot)
    except RobotError:
        return None


def radii(robot: Robot, contact: ContactScene | None = None) -> tuple[float, ...]:
    """(n_segments,) of its body [m], as contact has them; a robot of which nobody knows is drawn slim."""
    return tuple(radius or 0.01 * robot.length for radius in (contact or ContactScene()).radius_of(robot))


def tendon_inputs(robot: Robot, command: ManualCommand) -> dict[str, Any]:
    """Return what a manual command says of tendons and segments, as `Simulator.step` takes it."""
    modes = {segment.mode for segment in robot.segments}
    given: dict[str, Any] = {"extension": command.extension}
    if modes & {"tendon_length", "paper"}:
        given["tendon_length"] = command.tendon_length
    if "tendon_tension" in modes:
        given["tension"] = np.zeros(robot.n_tendons) if command.tension is None else command.tension
    return given


def moved(pose: Floats, base: Floats) -> Floats:
    """Return poses (..., 7) displaced and rotated, each about its own origin, by `base` (6,) as in
    `ManualCommand`. Raises `InputError`."""
    by = np.asarray(base, dtype=np.float64)
    if by.shape != (6,) or not np.isfinite(by).all():
        raise InputError(
            f"ManualCommand.base is {base!r}; give six finite numbers, displacement [m] and rotation "
            "vector [rad], world."
        )
    orientation = np.broadcast_to(quaternion_from_vector(by[3:]), pose[..., 3:].shape)
    return np.concatenate([pose[..., :3] + by[:3], product(orientation, pose[..., 3:])], axis=-1)
