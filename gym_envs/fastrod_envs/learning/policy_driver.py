"""`PolicyDriver`: a policy that was trained on the task Track, at the commands of a real or an emulated
robot."""

from __future__ import annotations

import math
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.control import Trajectory, references
from fastrod.errors import InputError, UnknownNameError, nearest
from fastrod.model.robot import Robot
from fastrod.model.robotfile import load_robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.types import Floats
from fastrod_envs.learning.policies import Policy
from fastrod_envs.registration import name_of
from fastrod_envs.surface import ReachableSurface
from fastrod_envs.task import bounds
from fastrod_envs.tasks.track import DRIVEN, DT, LIMIT, PERIOD, RADIUS, RATE, TrackSight, coming, fields

_EARLY = 1e-6  # of a step: a clock that is this much short of it has reached it


@final
class PolicyDriver:
    """Commands for a robot whose tip is to follow a path, one step of `dt` seconds after the other, as the
    task Track has them.

    The policy is asked once a step, with the very observation of the task; between steps the command stays,
    and a call that comes late is one step. The first call begins at home, with straight tendons. A tip that
    is not measured (nan) is taken to be where it was last seen, for one step; after that the robot stays
    where it is until the tip is seen again.

    >>> from fastrod_envs.learning.policies import Policy, find
    >>> pilot = PolicyDriver(Policy(find("Track", "shipped")), "circle")
    >>> pilot.command([0.0, 0.0, 0.07], 0.0).shape
    (4,)
    """

    dt = DT
    """Time of a step [s]."""

    def __init__(
        self,
        policy: Policy,
        path: str | Trajectory,
        robot: Robot | None = None,
        *,
        phase: float = 0.0,
        sense: int = 1,
    ) -> None:
        """Follow `path`, of the task by its name or a trajectory in a plane across the robot, base frame:
        from `phase` [s] on it, forward (`sense` 1) or backward (-1). `robot`, by default the prototype, says
        what is in reach, as in `ReachableSurface`.

        Raises `InputError` for a policy of another task, or of other observations or actions than the task
        has by default; for a robot that is not one segment with two pairs of tendons; for a path out of a
        plane. Raises `UnknownNameError` for a name of no path.
        """
        trained_on = policy.options
        if (
            name_of(policy.plan.env) != "Track"
            or trained_on.get("observation", "state") != "state"
            or trained_on.get("action", "rate") != "rate"
        ):
            raise InputError(
                f"the policy was trained on {policy.plan.env} with {trained_on}; "
                "give one of Track that observes the state and tells rates."
            )
        if sense not in (1, -1) or not math.isfinite(phase):
            raise InputError(f"phase is {phase!r} s and sense {sense!r}; give a finite time, and 1 or -1.")
        self.robot = load_robot("prototype") if robot is None else robot
        """Whose tendons they are."""
        if self.robot.n_segments != 1:
            raise InputError(
                f"robot {self.robot.name!r} has {self.robot.n_segments} segments; a policy of "
                "Track drives one."
            )
        self._matrix: Floats = SegmentActions(self.robot).matrix[: self.robot.n_tendons, DRIVEN]
        known = references(self.robot.length, PERIOD)
        if isinstance(path, str) and path not in known:
            raise UnknownNameError(f"no path {path!r}; {nearest(path, known)}")
        if not isinstance(path, (str, Trajectory)):
            raise InputError(f"path is {path!r}; give a Trajectory or one of {', '.join(map(repr, known))}.")
        self._path = known[path] if isinstance(path, str) else path
        self._phase, self._sense = float(phase), float(sense)
        points = self._path.position(np.linspace(0.0, self._path.period, 721))
        if np.ptp(points[:, 2]) > 1e-9:
            raise InputError(
                f"path {self._path.name!r} rises by {np.ptp(points[:, 2]):g} m; a policy of "
                "Track follows one in a plane."
            )
        radius = max(RADIUS, float(np.hypot(points[:, 0], points[:, 1]).max()))
        self._surface = ReachableSurface(self.robot, height=float(points[0, 2]), radius=radius)
        self._policy = policy
        states = fields(self.robot)[1]
        self._least, self._largest = (a.astype(np.float32) for a in bounds(states))
        self._low, self._high = np.array(LIMIT).T
        self._sight = TrackSight(1)
        self._displacement: Floats = np.zeros((1, len(DRIVEN)))
        self._action: Floats | None = None
        self._tip: Floats | None = None
        self._began, self._step, self._unseen = 0.0, -1, 0

    @property
    def displacement(self) -> Floats:
        """(2,) of the robot as it is commanded, toward d1 and d2 [m]."""
        return np.array(self._displacement[0])

    def wanted(self, t: float) -> Floats:
        """(3,) the path at a time [s], base frame [m]."""
        return np.array(self._along(t)[0])

    def nearest(self, t: float) -> Floats:
        """(3,) the point in reach that is nearest to it, base frame [m]."""
        return np.array(self._surface.nearest(self._along(t))[0])

    def command(self, tip: ArrayLike, t: float) -> Floats:
        """(n_tendons,) change of each tendon's length [m] for a tip that is measured at `tip` (3,), base
        frame [m], nan where it is not, at the path's time `t` [s]. Raises `InputError` on a tip that is not
        one and on a time that runs back."""
        try:
            seen = np.array(tip, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(f"tip is {tip!r}; give three numbers, base frame [m].") from error
        if seen.shape != (3,) or np.isinf(seen).any():
            raise InputError(
                f"tip is {tip!r}; give three numbers, base frame [m], nan where it was not measured."
            )
        if not math.isfinite(t):
            raise InputError(f"t is {t!r} s; give a finite time.")
        if self._step < 0:
            self._began = float(t)
        step = math.floor((t - self._began) / DT + _EARLY)
        if step < self._step:
            raise InputError(
                f"t is {t:g} s, before the step at {self._began + self._step * DT:g} s; a "
                "pilot's time does not run back."
            )
        if step > self._step:
            self._step = step
            self._advance(seen, float(t))
        return np.asarray((self._matrix * self._displacement).sum(axis=1))

    def _advance(self, seen: Floats, t: float) -> None:
        """One step of the task."""
        self._unseen = 0 if np.isfinite(seen).all() else self._unseen + 1
        if self._unseen == 0:
            self._tip = seen
        if self._tip is None or self._unseen > 1:
            return
        tip, wanted = self._tip[None], self._surface.nearest(self._along(t))
        if self._action is None:
            self._sight.begin(np.array([0]), wanted, tip)
        else:
            self._sight.note(self._action, wanted, tip)
        posture = (2.0 * self._displacement - self._low - self._high) / (self._high - self._low)
        state = self._sight.state(coming(lambda ahead: self._along(t + ahead)), tip, posture)
        self._action = np.clip(
            self._policy.act(np.clip(state.astype(np.float32), self._least, self._largest)), -1.0, 1.0
        )
        self._displacement = np.clip(
            self._displacement + DT * np.array(RATE) * self._action, self._low, self._high
        )

    def _along(self, t: float) -> Floats:
        """(1, 3) the path at a time [s]."""
        return self._path.position(np.array([self._phase + self._sense * t]))
