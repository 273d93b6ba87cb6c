"""`SimulatedRobot`: a simulator as a `RobotLink`, to drive without a real robot."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.checks import checked_array
from fastrod.logs.link import Measurement
from fastrod.model.robot import Robot
from fastrod.rotation import quaternion_from_matrix
from fastrod.simulator import Simulator
from fastrod.types import Floats


@final
class SimulatedRobot:
    """A robot that moves at once to its command, effects of its file included, and measures without noise.

    >>> import fastrod
    >>> link = SimulatedRobot(fastrod.load_robot("prototype"))
    >>> link.command([-0.004, 0.0, 0.004, 0.0])
    >>> link.read().tip_position.round(4).tolist()
    [0.0182, 0.0, 0.0667]
    """

    def __init__(
        self,
        robot: Robot,
        *,
        dt: float = 1.0 / 30.0,
        real: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`dt` [s] between two readings, as effects with a memory count time; `real` has it treated like a
        robot that can do harm; `clock` gives its time [s]."""
        self._robot, self._real, self._clock = robot, real, clock
        self._simulator = Simulator(robot, dt=dt, points_per_segment=10, threads=1)
        self._lock = threading.Lock()
        self._began = clock()
        self._change: Floats = np.zeros(robot.n_tendons)
        self._extension: Floats = np.zeros(robot.n_segments)
        self._cold = True
        self.stopped = False
        """It ignores commands."""

    @property
    def robot(self) -> Robot:
        """Model that is simulated."""
        return self._robot

    @property
    def real(self) -> bool:
        """Value given at construction."""
        return self._real

    def command(self, dl: ArrayLike, ext: ArrayLike | None = None) -> None:
        """Move at once to these changes of length (`RobotLink.command`). Raises `InputError` on wrong shapes
        and on what is not finite."""
        robot = self._robot
        change = checked_array("dl", dl, [(robot.n_tendons,)], "one change of each tendon's length [m]")
        ext = np.zeros(robot.n_segments) if ext is None else ext
        extension = checked_array("ext", ext, [(robot.n_segments,)], "one extension of each segment [m]")
        with self._lock:
            if not self.stopped:
                self._change, self._extension = change, extension

    def read(self) -> Measurement:
        """One step of the simulator, which settles first, and what it then measures."""
        with self._lock:
            change, extension = self._change, self._extension
            lengths = self._robot.rest_tendon_length + change
            first, self._cold = self._cold, False
            state = None if first else self._simulator.step(lengths, extension=extension)
            if state is None or not state.ok[0]:
                state = self._simulator.settle(lengths, extension=extension)
        base, rotation = state.position[0, 0], state.rotation[0, 0]
        relative = rotation.T @ state.tip_rotation[0]
        return Measurement(
            t=self._clock() - self._began,
            dl=change,
            ext=extension,
            tip_position=rotation.T @ (state.tip_position[0] - base),
            tip_quaternion=quaternion_from_matrix(relative[None])[0],
            tension=state.tension[0],
            problem=state.problems.get(0, ""),
        )

    def stop(self) -> None:
        """Stay at the last command."""
        with self._lock:
            self.stopped = True

    def release(self) -> None:
        """Take commands again."""
        with self._lock:
            self.stopped = False

    def close(self) -> None:
        """Stop."""
        self.stop()
