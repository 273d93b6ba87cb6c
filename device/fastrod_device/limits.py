"""`Limits`: what a robot on the bench must keep within, and the step that keeps a tendon's rate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from fastrod.checks import Bound, check
from fastrod.errors import InputError
from fastrod.types import Floats

Length = Annotated[float, Bound(least=1e-9, most=0.5, unit="m", hint="Was it given in mm?")]
Speed = Annotated[float, Bound(least=1e-9, most=1.0, unit="m/s", hint="Was it given in mm/s?")]
Age = Annotated[float, Bound(least=1e-9, most=60.0, unit="s", hint="Was it given in ms?")]
Force = Annotated[float, Bound(least=1e-9, most=1e9, unit="N")]
Curvature = Annotated[float, Bound(least=1e-9, most=1e9, unit="1/m")]


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits on commands, on the robot, and on the age of feedback; by default those of the 70 mm prototype.
    Raises `InputError`.

    >>> Limits(displacement=0.006).displacement
    0.006
    """

    displacement: Length = 0.008
    """Largest change of a tendon's length, either way [m]."""
    rate: Speed = 0.03
    """Largest rate of a tendon [m/s]: the set-points keep to it."""
    curvature: Curvature = 20.0
    """Largest of any segment [1/m], by the constant curvature that the tendons ask for."""
    tension: Force = 15.0
    """Largest of any tendon, from the motor's torque, either way [N]."""
    slack: Force | None = None
    """Least tension of any tendon while the drives are enabled [N]; None: a tendon may hang."""
    command_age: Age = 0.5
    """A command that was meant longer ago is refused, and one must be renewed this often while the robot
    moves [s]."""
    feedback_age: Age = 0.03
    """Largest age of a drive's process data [s]."""
    heartbeat_age: Age = 0.15
    """Largest age of a drive's heartbeat [s]."""
    sighting_age: Age | None = 0.5
    """Largest age of the newest good sighting of the marker [s]; None: the camera stops nothing."""
    cycle: Age = 0.05
    """Longest gap between two control cycles [s]."""
    following_error: Length = 0.001
    """Largest difference of where a drive was commanded to be and where it is, as tendon [m]."""
    encoder_jump: Length = 0.0005
    """Largest change of a tendon's length between two samples beyond what `rate` explains [m]."""
    clock_jump: Age = 0.2
    """Largest disagreement of the wall clock with the monotonic one over a control cycle [s]."""

    def __post_init__(self) -> None:
        check(self)
        if self.slack is not None and self.slack >= self.tension:
            raise InputError(
                f"Limits.slack is {self.slack!r} N and tension {self.tension!r} N; the least "
                "must be below the largest."
            )


def limited(previous: Floats, wanted: Floats, rate: float, dt: float) -> Floats:
    """Tendon lengths (n_tendons,) [m] after `dt` [s], from `previous` straight toward `wanted`, no tendon
    faster than `rate` [m/s].

    All tendons are scaled alike, so that the robot goes straight to where it was commanded, and a way between
    two shapes within the limits stays within them. Raises `InputError` for figures that are not finite or run
    back.

    >>> limited(np.zeros(2), np.array([0.004, -0.002]), 0.03, 0.1)
    array([ 0.003 , -0.0015])
    """
    if not (math.isfinite(rate) and rate > 0.0 and math.isfinite(dt) and dt >= 0.0):
        raise InputError(
            f"rate is {rate!r} m/s and dt {dt!r} s; the rate must be positive and dt not negative."
        )
    if not (np.isfinite(previous).all() and np.isfinite(wanted).all()):
        raise InputError(
            f"the way from {previous.tolist()} to {wanted.tolist()} m is not finite; both ends must be."
        )
    step = wanted - previous
    largest = float(np.abs(step).max(initial=0.0))
    if largest <= rate * dt:
        return wanted.copy()
    return np.asarray(previous + step * (rate * dt / largest), dtype=np.float64)
