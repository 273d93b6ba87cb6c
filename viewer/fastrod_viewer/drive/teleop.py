"""`Teleop`: goals from sliders, keys or a drag of the tip, as motion within limits."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from typing import Annotated, final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.checks import POSITIVE, check
from fastrod.control import ResolvedRate
from fastrod.errors import FastrodError, InputError
from fastrod.model.robot import Robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.types import Floats
from fastrod_viewer.drive.linked import TendonLimits
from fastrod_viewer.worlds.world import ManualCommand, World

LARGEST_BEND = math.pi / 2.0
"""Largest bend of a segment toward either side [rad]."""
LARGEST_TENSION = 20.0
"""Largest tension of a tendon that is driven by tension [N]."""
DRAG_GAIN = 8.0
"""1/s: the tip is where it is dragged to within an eighth of a second."""
FARTHEST = 0.25
"""Fraction of the robot's length: a tip that is dragged farther counts as this far."""
DRAG_DAMPING = 0.02
"""Fraction of the robot's length by 1 rad: where less than that moves the tip, the motion is given up
rather than the segments thrown about."""
JOINT_RATE = 0.4
"""Largest of a host's joint in a drag [rad/s]."""
JOINT_COST = 25.0
"""Weight of a joint's 1 rad, where that of a segment's bend by 1 rad is 1: the soft robot goes first."""
_INSIDE = 0.999  # of a limit: sums of floats must not be beyond it
_NOTHING = 1e-6  # m of a tendon, below which a robot is bent by its segments alone


@dataclass(frozen=True, kw_only=True)
class Speeds:
    """Largest rates, each positive. Raises `InputError`."""

    bend: Annotated[float, POSITIVE] = math.pi
    """Speed of a segment's bend [rad/s]; tendons move no faster than this bend needs."""
    extension: Annotated[float, POSITIVE] = 0.5
    """Speed of a segment's extension, in its own range a second [1/s]."""
    base: Annotated[float, POSITIVE] = 0.2
    """Speed of a base [m/s], and in rad/s five times that."""

    def __post_init__(self) -> None:
        check(self)

    def times(self, factor: float) -> Speeds:
        """All of them, so many times as large."""
        return Speeds(bend=self.bend * factor, extension=self.extension * factor, base=self.base * factor)


@dataclass(frozen=True, eq=False)
class Goals:
    """Values of a robot's controls: the goals, or the present ones on the path there."""

    action: Floats
    """(3 n_segments,) extension and two displacements of each segment [m]; empty where it is not driven
    so."""
    tendon_change: Floats
    """(n_tendons,) change of each tendon's length on top of what the actions take [m]."""
    tension: Floats
    """(n_tendons,) [N] of the segments that are driven by it."""
    base: Floats
    """(6,) displacement [m] and rotation vector [rad] from home, world."""

    @staticmethod
    def zero(n_actions: int, n_tendons: int) -> Goals:
        """The robot at rest and at home."""
        return Goals(np.zeros(n_actions), np.zeros(n_tendons), np.zeros(n_tendons), np.zeros(6))


@final
class Teleop:
    """Takes goals from any thread, and gives a world the command of each step toward them.

    >>> import fastrod
    >>> from fastrod_viewer.worlds.simulated import FreeWorld
    >>> teleop = Teleop(FreeWorld(fastrod.load_robot("prototype")))
    >>> teleop.bend(0, math.pi / 4, 0.0)
    >>> command = teleop.step(0.1)
    >>> bool((command.tendon_length != 0.07).any())
    True
    """

    def __init__(
        self, world: World, speeds: Speeds | None = None, *, limits: TendonLimits | None = None
    ) -> None:
        """`limits` of the tendons of the robot that is driven; they keep to its rate whatever the speeds
        are."""
        self.linked, self.limits = limits is not None, limits or TendonLimits()
        self.robot: Robot = world.robot
        self.actions: SegmentActions | None = world.actions
        self._world = world
        self._lock = threading.RLock()
        self._zero = Goals.zero(0 if self.actions is None else self.actions.n_actions, self.robot.n_tendons)
        self._speeds = speeds or Speeds()
        self._lower, self._upper = _limits(self.robot, self.actions, self.limits)
        self._offset = _arm(self.robot)
        self.reset()

    def reset(self) -> None:
        """Everything at rest, no loads, nothing dragged; the speeds stay."""
        with self._lock:
            self._goals, self._now, self._before = self._zero, self._zero, self._zero
            self._pull: Floats | None = None
            self._tip_force, self._payload, self._gravity = np.zeros(3), 0.0, 1.0
            self._freeze = False
            self.problem = ""

    @property
    def speeds(self) -> Speeds:
        """The limits of every motion."""
        return self._speeds

    @speeds.setter
    def speeds(self, speeds: Speeds) -> None:
        with self._lock:
            self._speeds = speeds

    @property
    def goals(self) -> Goals:
        """The goals of the controls."""
        with self._lock:
            return self._goals

    @property
    def now(self) -> Goals:
        """The last command, as goals."""
        with self._lock:
            return self._now

    @property
    def dragged_to(self) -> Floats | None:
        """(3,) world [m] where the tip is dragged, None where it is not."""
        with self._lock:
            return self._pull

    @property
    def arrived(self) -> bool:
        """Every goal is met."""
        with self._lock:
            pairs = zip(_arrays(self._goals), _arrays(self._now), strict=True)
            return self._pull is None and all(np.array_equal(goal, now) for goal, now in pairs)

    @property
    def change(self) -> Floats:
        """(n_tendons,) change of tendon length at the goal, negative = pulled [m]."""
        with self._lock:
            return self._change(self._goals)

    @property
    def driven(self) -> list[int]:
        """Segments that bends drive, from 0, base first."""
        return [k for k in range(self.robot.n_segments) if self.bends(k, 0) or self.bends(k, 1)]

    def bends(self, segment: int, axis: int) -> bool:
        """Whether a segment can be bent toward x or y of its base (0 or 1)."""
        return self.actions is not None and bool(self.actions.bends[3 * segment + 1 + axis])

    def bend(self, segment: int, toward_x: float, toward_y: float) -> None:
        """Bend a segment (from 0, base first) toward x and y of its base [rad], within `LARGEST_BEND`."""
        if self.actions is None:
            raise InputError(f"robot {self.robot.name!r} has no segments that bends drive; move its tendons.")
        self._act(segment, 1, float(toward_x) * self.actions.offset[segment])
        self._act(segment, 2, float(toward_y) * self.actions.offset[segment])

    def bent(self, segment: int) -> tuple[float, float]:
        """Bends of a segment at the goal, toward x and y of its base [rad]."""
        if self.actions is None or not self.actions.offset[segment]:
            return 0.0, 0.0
        x, y = self.goals.action[3 * segment + 1 : 3 * segment + 3] / self.actions.offset[segment]
        return float(x), float(y)

    def extend(self, segment: int, extension: float) -> None:
        """Lengthen a segment (from 0) [m], within its range."""
        self._act(segment, 0, float(extension))

    def change_tendon(self, tendon: int, change: float) -> None:
        """Change one tendon's length to `change` against the straight rest robot [m], negative = pulled; the
        bends keep theirs."""
        with self._lock:
            changed = self._goals.tendon_change.copy()
            changed[tendon] += float(change) - self._change(self._goals)[tendon]
            self._goals = _with(self._goals, tendon_change=changed)
            self._pull = None

    def pull_with(self, tendon: int, tension: float) -> None:
        """Pull a tendon of a segment that is driven by tension [N]."""
        with self._lock:
            forces = self._goals.tension.copy()
            forces[tendon] = min(max(float(tension), 0.0), LARGEST_TENSION)
            self._goals = _with(self._goals, tension=forces)

    def move_base(self, displacement: ArrayLike) -> None:
        """Move the base to (6,) displacement [m] and rotation vector [rad] from home, world."""
        with self._lock:
            self._goals = _with(self._goals, base=np.array(displacement, dtype=np.float64))

    def load(
        self,
        *,
        tip_force: ArrayLike | None = None,
        payload: float | None = None,
        gravity: float | None = None,
    ) -> None:
        """Loads: force on the tip (3,) world [N], mass at the tip [kg], times gravity. What is None stays."""
        with self._lock:
            if tip_force is not None:
                self._tip_force = np.array(tip_force, dtype=np.float64)
            if payload is not None:
                self._payload = float(payload)
            if gravity is not None:
                self._gravity = float(gravity)

    @property
    def loads(self) -> tuple[Floats, float, float]:
        """(3,) tip force [N], payload [kg], times gravity."""
        with self._lock:
            return self._tip_force, self._payload, self._gravity

    def freeze(self, frozen: bool) -> None:
        """Hold the rigid host still, or let it move."""
        with self._lock:
            self._freeze = bool(frozen)

    def drag(self, point: ArrayLike | None) -> None:
        """Pull the tip toward a point (3,) world [m]; None lets go, and the robot stays as it is. A robot
        that has inertia is pulled by a spring (`Ringing.pull`), its drives stay, and let go it rings."""
        with self._lock:
            self._pull = None if point is None else np.array(point, dtype=np.float64)
            if point is None and self._world.ringing is None:
                self.hold()

    def hold(self) -> None:
        """Stand still: every motion stops where it is."""
        with self._lock:
            self._goals, self._pull = self._now, None

    def retreat(self) -> None:
        """The last step could not be done: stand where it began, and want nothing more."""
        with self._lock:
            self._goals = self._now = self._before
            self._pull = None

    def adopt(self, change: Floats, extension: Floats) -> None:
        """Take over a robot as it stands: changes of tendon length (n_tendons,) and of segment length
        (n_segments,) [m]."""
        with self._lock:
            action, left = self._zero.action, np.array(change, dtype=np.float64)
            if self.actions is not None:
                taken = np.linalg.lstsq(self.actions.matrix, np.concatenate([change, extension]), rcond=None)[
                    0
                ]
                action = np.clip(taken, self._lower, self._upper)
                left -= self.actions.matrix[: len(left)] @ action
            left[np.abs(left) < _NOTHING] = 0.0
            self._goals = self._now = self._before = _with(self._now, action=action, tendon_change=left)
            self._pull = None

    def all_zero(self) -> None:
        """Straight and at home, at the speeds allowed; loads stay."""
        with self._lock:
            self._goals, self._pull = self._zero, None

    def step(self, dt: float) -> ManualCommand:
        """Return the command for the next `dt` [s]."""
        with self._lock:
            rate, force, ringing = None, self._tip_force, self._world.ringing
            if self._pull is not None and ringing is not None:
                force = force + ringing.pull(self._world.rods[0].state, self._pull)
            elif self._pull is not None:
                rate = self._follow_drag(dt)
            goals, now, speeds = self._goals, self._now, self._speeds
            if self.actions is not None:
                limit = self._action_rates(self.actions, speeds) * dt
                action = now.action + np.clip(goals.action - now.action, -limit, limit)
            else:
                action = now.action
            changed = _toward(now.tendon_change, goals.tendon_change, speeds.bend * self._offset * dt)
            tension = _toward(now.tension, goals.tension, LARGEST_TENSION * dt)
            base = np.concatenate(
                [
                    _toward(now.base[:3], goals.base[:3], speeds.base * dt),
                    _toward(now.base[3:], goals.base[3:], 5.0 * speeds.base * dt),
                ]
            )
            self._before, self._now = now, self._within_rate(now, Goals(action, changed, tension, base), dt)
            there = self._now
            extension = np.zeros(self.robot.n_segments) if self.actions is None else there.action[::3]
            return ManualCommand(
                tendon_length=self.robot.rest_tendon_length + self._change(there),
                extension=extension,
                tension=there.tension,
                base=there.base,
                base_rate=rate,
                tip_force=force,
                payload=self._payload,
                gravity=self._gravity,
                freeze=self._freeze,
            )

    def _within_rate(self, now: Goals, then: Goals, dt: float) -> Goals:
        """Return the goals from `now` toward `then`, on the straight path, at which no tendon exceeds its
        rate."""
        largest = float(np.abs(self._change(then) - self._change(now)).max(initial=0.0))
        if largest <= self.limits.rate * dt:
            return then
        fraction = self.limits.rate * dt / largest
        return Goals(*(a + fraction * (b - a) for a, b in zip(_arrays(now), _arrays(then), strict=True)))

    def _act(self, segment: int, which: int, value: float) -> None:
        with self._lock:
            k = 3 * segment + which
            if not 0 <= k < len(self._goals.action):
                raise InputError(
                    f"segment {segment + 1} cannot be driven; robot {self.robot.name!r} has "
                    f"{self.robot.n_segments} segments."
                )
            action = self._goals.action.copy()
            action[k] = min(max(value, self._lower[k]), self._upper[k])
            self._goals = _with(self._goals, action=action)
            self._pull = None

    def _change(self, goals: Goals) -> Floats:
        if self.actions is None:
            return goals.tendon_change
        return np.asarray(self.actions.matrix[: self.robot.n_tendons] @ goals.action + goals.tendon_change)

    def _action_rates(self, actions: SegmentActions, speeds: Speeds) -> Floats:
        """(3 n_segments,) [m/s]"""
        rates = speeds.bend * _per_bend(actions)
        rates[::3] = speeds.extension * np.maximum((self._upper - self._lower)[::3], 1e-9)
        return rates

    def _follow_drag(self, dt: float) -> Floats | None:
        """One step of the tip toward where it is dragged: the goals move; (n_joints,) rates of the host's
        joints [rad/s], or None."""
        if self.actions is None or self._pull is None:
            return None
        try:
            jacobian = self._world.jacobian()
            n = jacobian.shape[1] - self.actions.n_actions
            error = self._pull - self._world.rods[0].state.tip_position[0]
            q = np.concatenate([np.zeros(n), self._now.action])
            rates = self._drag_law(self.actions, n).rates(q, jacobian, error, np.zeros(3), dt)
        except FastrodError as error_of_world:
            self.problem = str(error_of_world)
            return None
        self.problem = ""
        action = np.clip(self._now.action + dt * rates[n:], self._lower, self._upper)
        self._goals = _with(self._goals, action=action)
        return rates[:n] if n else None

    def _drag_law(self, actions: SegmentActions, n_joints: int) -> ResolvedRate:
        """Drag law of the host's joints and the actions. A drag may pull anywhere: a robot at its limits
        follows partly."""
        width = self._upper - self._lower
        cost = np.concatenate([np.full(n_joints, JOINT_COST), 1.0 / _per_bend(actions) ** 2])
        cost[n_joints::3] = 1.0 / np.maximum(width[::3], 1e-3) ** 2
        free = np.full(n_joints, np.inf)
        return ResolvedRate(
            gain=DRAG_GAIN,
            damping=DRAG_DAMPING * self.robot.length,
            lower=np.concatenate([-free, self._lower]),
            upper=np.concatenate([free, self._upper]),
            rate=np.concatenate([np.full(n_joints, JOINT_RATE), self._action_rates(actions, self._speeds)]),
            weight=cost,
            error_limit=FARTHEST * self.robot.length,
            nearest=True,
        )


def _arrays(goals: Goals) -> tuple[Floats, ...]:
    return goals.action, goals.tendon_change, goals.tension, goals.base


def _with(goals: Goals, **changed: Floats) -> Goals:
    kept = {
        "action": goals.action,
        "tendon_change": goals.tendon_change,
        "tension": goals.tension,
        "base": goals.base,
    }
    return Goals(**(kept | changed))


def _toward(now: Floats, goal: Floats, step: float) -> Floats:
    return np.asarray(now + np.clip(goal - now, -step, step))


def _arm(robot: Robot) -> float:
    """Largest distance of a tendon from the backbone [m]; 0 without tendons."""
    return max(
        (math.hypot(*t.position(k + 1)[k]) for k, s in enumerate(robot.segments) for t in s.tendons),
        default=0.0,
    )


def _per_bend(actions: SegmentActions) -> Floats:
    """(3 n_segments,) displacement of a radian; the largest for a passive segment, which stays at 0 [m]."""
    return np.repeat(np.where(actions.offset > 0.0, actions.offset, actions.offset.max()), 3)


def _limits(robot: Robot, actions: SegmentActions | None, limits: TendonLimits) -> tuple[Floats, Floats]:
    """(3 n_segments,) least and largest action [m]."""
    if actions is None:
        return np.zeros(0), np.zeros(0)
    upper = np.repeat(np.minimum(LARGEST_BEND * actions.offset, _INSIDE * limits.displacement), 3)
    upper *= actions.bends
    lower = -upper
    lower[::3], upper[::3] = (np.array([segment.extension[i] for segment in robot.segments]) for i in (0, 1))
    return lower, upper
