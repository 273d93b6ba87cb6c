"""The one place where metres of tendon become counts of a motor, and its torque becomes newtons."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, final

import numpy as np

from fastrod.checks import Bound, check
from fastrod.errors import InputError
from fastrod.types import Floats, Ints
from fastrod_device.readings import DriveFeedback, Readings


@dataclass(frozen=True, kw_only=True)
class DriveSpec:
    """A motor that winds one tendon on a drum. The order of the drives is that of the robot file's tendons.

    >>> round(DriveSpec(node=1, drum_radius=0.008).metres_per_count * 1e9)  # nm
    584
    """

    node: Annotated[int, Bound(least=1, most=126)]
    """CANopen node id, 1 to 126."""
    drum_radius: Annotated[float, Bound(least=1e-4, most=0.1, unit="m", hint="Was it given in mm?")]
    """To the middle of the wound tendon [m]."""
    direction: Literal[1, -1] = 1
    """+1 where growing counts pull the tendon in, -1 where they let it out."""
    gear: Annotated[float, Bound(least=1e-3, most=1e6)] = 21.0
    """Turns of the motor in one turn of the drum."""
    counts_per_turn: Annotated[int, Bound(least=1, most=1e9)] = 4096
    """Counts per turn of the motor's encoder, edges of both channels counted."""
    torque_constant: Annotated[float, Bound(least=1e-6, most=1e3, unit="N m/A")] = 0.0251
    """Torque constant of the motor [N m/A]."""
    rated_torque: Annotated[float, Bound(least=1e-6, most=1e4, unit="N m")] = 0.054
    """Rated torque of the motor [N m]; CiA 402 counts torque in thousandths of it."""
    efficiency: Annotated[float, Bound(least=1e-3, most=1.0)] = 0.8
    """Efficiency of the gear, 0 to 1: what of the motor's torque reaches the drum."""

    def __post_init__(self) -> None:
        check(self)

    @property
    def metres_per_count(self) -> float:
        """Tendon wound by one count [m]."""
        return 2.0 * math.pi * self.drum_radius / (self.gear * self.counts_per_turn)

    @property
    def newtons_per_torque(self) -> float:
        """Tension of the tendon by torque of the motor [1/m]."""
        return self.gear * self.efficiency / self.drum_radius


@final
class Transmission:
    """Drives as tendons: changes of tendon length [m], negative = pulled, against the straight rest robot,
    where counts are `zero`."""

    def __init__(self, specs: Sequence[DriveSpec], zero: Ints | None = None) -> None:
        """`zero` (n_drives,) counts at which the robot is straight, 0 by default. Raises `InputError` where
        there is no drive, or two have one node id."""
        self.specs = tuple(specs)
        nodes = [spec.node for spec in self.specs]
        if not nodes or len(set(nodes)) != len(nodes):
            raise InputError(f"the drives have node ids {nodes}; there must be one or more, each once.")
        self.zero: Ints = (
            np.zeros(len(nodes), dtype=np.int64) if zero is None else np.asarray(zero, dtype=np.int64)
        )
        """(n_drives,) counts of the straight robot."""
        self._metres: Floats = np.array([-spec.direction * spec.metres_per_count for spec in specs])
        self._newtons: Floats = np.array([spec.direction * spec.newtons_per_torque for spec in specs])
        self._amperes: Floats = np.array([1.0 / spec.torque_constant for spec in specs])
        self._torque: Floats = np.array([1e-3 * spec.rated_torque for spec in specs])

    @property
    def n_drives(self) -> int:
        """Number of drives."""
        return len(self.specs)

    def counts(self, dl: Floats) -> Ints:
        """(n_drives,) nearest counts of changes of tendon length (n_drives,) [m]."""
        return np.asarray(np.rint(dl / self._metres), dtype=np.int64) + self.zero

    def dl(self, counts: Ints) -> Floats:
        """(..., n_drives) changes of tendon length [m] of counts."""
        return np.asarray((counts - self.zero) * self._metres, dtype=np.float64)

    def wound(self, counts: Ints) -> Floats:
        """(..., n_drives) lengths [m] of differences of counts: rates and errors, which have no zero;
        negative = pulled."""
        return np.asarray(counts * self._metres, dtype=np.float64)

    def tension(self, torque: Ints) -> Floats:
        """(..., n_drives) [N] of torques in thousandths of the rated one: gear losses by a constant
        efficiency, no other friction."""
        return np.asarray(torque * self._torque * self._newtons, dtype=np.float64)

    def torque(self, tension: Floats) -> Ints:
        """(..., n_drives) thousandths of the rated torque that hold a tension [N]."""
        return np.asarray(np.rint(tension / (self._torque * self._newtons)), dtype=np.int64)

    def current(self, torque: Ints) -> Floats:
        """(..., n_drives) motor currents [A] of torques in thousandths of the rated one."""
        return np.asarray(torque * self._torque * self._amperes, dtype=np.float64)

    def readings(self, feedback: DriveFeedback) -> Readings:
        """Return the drives' readings in SI units."""
        return Readings(
            t=feedback.t,
            dl=self.dl(feedback.position),
            rate=self.wound(feedback.velocity),
            tension=self.tension(feedback.torque),
            current=self.current(feedback.torque),
            following_error=self.wound(feedback.following_error),
            statusword=feedback.statusword,
            age=feedback.age,
            heartbeat_age=feedback.heartbeat_age,
            nmt=feedback.nmt,
            emergencies=feedback.emergencies,
            lost=feedback.lost,
            foreign_syncs=feedback.foreign_syncs,
        )
