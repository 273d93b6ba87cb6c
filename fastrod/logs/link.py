"""`RobotLink`: a robot that is driven by its tendons and reports its pose; a simulated one, an emulated one
and a prototype all are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from fastrod.errors import InputError
from fastrod.model.robot import Robot
from fastrod.types import Floats


@dataclass(frozen=True, kw_only=True, eq=False)
class Measurement:
    """One reading of a robot, in the units, signs and frames of a `RunLog` row. What a robot cannot report is
    nan.

    Raises `InputError` where a length, a position or a quaternion has the wrong shape.
    """

    t: float
    """Time of the reading by the robot's own clock [s]."""
    dl: Floats
    """(n_tendons,) change of each tendon's length against the straight rest robot, as the motors report it
    [m]; negative = pulled."""
    ext: Floats
    """(n_segments,) change of each segment's backbone length [m]."""
    tip_position: Floats
    """(3,) base frame [m]."""
    tip_quaternion: Floats
    """(4,) base_from_tip, w x y z."""
    tension: Floats
    """(n_tendons,) [N]."""
    problem: str = ""
    """Fault of the robot, one sentence; empty where there is none."""

    def __post_init__(self) -> None:
        sizes = {"tip_position": 3, "tip_quaternion": 4}
        for name in ("dl", "ext", "tip_position", "tip_quaternion", "tension"):
            value = np.array(getattr(self, name), dtype=np.float64)
            if value.ndim != 1 or value.size != sizes.get(name, value.size):
                raise InputError(
                    f"Measurement.{name} has shape {value.shape}; it must be ({sizes.get(name, 'n')},)."
                )
            value.setflags(write=False)
            object.__setattr__(self, name, value)


@runtime_checkable
class RobotLink(Protocol):
    """Robot that teleop drives and a recorder records. Commands and readings may come from different threads;
    none of them waits for motion."""

    @property
    def robot(self) -> Robot:
        """Model of the robot at the other end."""

    @property
    def real(self) -> bool:
        """Motion may do harm: it stops when nobody watches."""

    def command(self, dl: ArrayLike, ext: ArrayLike | None = None) -> None:
        """Go to these changes of tendon length (n_tendons,) [m], negative = pulled, and of segment length
        (n_segments,) [m]. A link that is stopped ignores it. Raises `InputError` for a command that no robot
        of this kind can follow."""

    def read(self) -> Measurement:
        """The newest reading."""

    def stop(self) -> None:
        """Stand still where it is, now; commands are ignored until `release`. Never raises."""

    def release(self) -> None:
        """Take commands again."""

    def close(self) -> None:
        """Stop, and let go of the robot."""
