"""`BodyContact`: a body of another engine as an obstacle of a rod, pushed by it."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple, final

import numpy as np

from fastrod.contact import Obstacle
from fastrod.hosts.host import Motion, inverse_inertia
from fastrod.rotation import cross, matrix_from_quaternion, product
from fastrod.solver.state import State
from fastrod.types import Floats

# of an overlap the rod does not see: it would have the body out at once, at overlap / dt. Of a small one it
# sees a little more than what passes for none, so that none stays [m]
_LEFT, _SEEN = 0.8, 1.1e-5
# Newmark's rule, beta 0.3025, gamma 0.6, which takes a tenth of the energy that an implicit Euler step takes:
# weights of the force at the end of a step, of the one a step before, and of the one before that
_COMING, _LAST, _EARLIER = 0.3025, 0.495, 0.2025
# of the last force has been felt when the rule begins: the engine's speed is that of half a step before
_FELT = 0.4
# of the push of rods at least is what holds a body against them (by 0.2, cubes that MuJoCo's friction lifts
# are pushed at 1.4 times the rod's speed), and of the speed that this gives a body in a step it has at most
_HELD, _STILL = 0.5, 0.2
_ALIKE = 0.5  # by less of it a force differs from the one before where a contact lasts


class CollisionShape(NamedTuple):
    """One collision shape of a body."""

    obstacle: Obstacle
    position: Floats
    """(3,) in the frame of the body's centre of mass [m]."""
    quaternion: Floats
    """(4,) w x y z, com_from_obstacle."""


class BodyContact(ABC):
    """Contact of a rod with a body of another engine: its obstacles, and the rod's push on it.

    A step is implicit in the body's inertia: to the rod it is where it would be at the step's end without the
    rod, and moves away by F dt^2 / m and M dt^2 / I. A contact that lasts gives no more momentum than stops
    the body at the rod, at any time step. That is a step of implicit Euler, which takes energy from what
    swings: where a contact lasts the body feels a mean of the last three forces instead (Newmark 1959), of
    which the coming one is a third.

    Of several rods that push one body each has it under the forces of all, and moves it on from there: so
    they hold it between them. Something else may hold the body against them, as a floor, a joint or a spring
    does. No engine is asked for it: it is taken to do so as in the last step. What is held feels the coming
    force alone: a mean of what sticks, which is rigid, rings.

    After a step in which the rod's forces are not known it only stops the body, until that takes all it has.
    """

    def __init__(
        self,
        body: tuple[int, ...],
        shapes: Sequence[CollisionShape],
        mass: float,
        inertia: Floats,
        *,
        dt: float,
        friction: float,
    ) -> None:
        """`body`: number of its world, and its own; `inertia` (3,) about the axes of the centre of mass'
        frame [kg m^2]; `friction` of rod on the body."""
        self.number, self.dt = body, dt
        self.mass = mass
        """0: it does not move for the rod [kg]."""
        self._inertia = inertia
        self.shapes = [
            shape._replace(obstacle=dataclasses.replace(shape.obstacle, friction=friction))
            for shape in shapes
        ]
        self.names = tuple(shape.obstacle.name for shape in self.shapes)
        self.exerted: Floats = np.zeros(6)
        """Force [N] and moment about its centre of mass [N m] that the rod exerted on it in the last step,
        world."""
        self._begun = False  # the rod has pushed since the engine's step
        self._felt: Floats = np.zeros(6)  # what it exerted in that
        self._speed: Floats = np.full(6, np.nan)  # of the body before that
        self._poses: dict[str, Floats] = {}  # of its obstacles, as the step expects them
        self._before: Floats = np.zeros(6)
        self._lost = False  # the rod's forces of the last step were not known
        self._alone = True  # no other rod pushes it
        self._even = False  # the last force was like the one before it
        self._weight, self._past = 1.0, np.zeros(6)  # of the coming force, and of those before it
        self._then: dict[str, Any] = {}  # all this before the last push

    @abstractmethod
    def com(self) -> Motion:
        """Motion of the centre of mass' frame now."""

    @abstractmethod
    def apply(self, wrench: Floats) -> None:
        """Feel (6,) force [N] and moment about the centre of mass [N m], world, during the engine's next
        step, with what was applied for that before."""

    @final
    def mobility(self) -> tuple[Floats, Floats, Floats]:
        """Return its mobility (6, 6) in the next step: displacement [m] and rotation [rad] by a force [N] at
        its centre of mass and a moment [N m], world; that centre (3,), where it is now; and how far (6,)
        `expected` has the rod push it."""
        pose = self.com().pose
        mobility = self._weight * self.dt**2 * inverse_inertia(self.mass, self._inertia, pose)
        return mobility, pose[:3], mobility @ (np.zeros(6) if self._alone else self._before)

    @final
    def now(self) -> dict[str, Floats]:
        """Return the pose (7,) of each shape."""
        return self._at(self.com().pose)

    def _at(self, pose: Floats) -> dict[str, Floats]:
        """Poses (7,) of the shapes where the centre of mass' frame has this one."""
        rotation = matrix_from_quaternion(pose[None, 3:])[0]
        return {
            shape.obstacle.name: np.concatenate(
                [pose[:3] + rotation @ shape.position, product(pose[3:], shape.quaternion)]
            )
            for shape in self.shapes
        }

    @final
    def expected(
        self, gravity: Floats, overlap: Floats, others: Sequence[BodyContact] = ()
    ) -> tuple[dict[str, Floats], dict[str, Floats]]:
        """Return pose (7,) and velocity (6,) of each shape at the end of the next step, were it not for the
        rod. What fell by `gravity` (3,) in the last one falls on, and what was held in it is held. If
        `others` push the body, it is pushed as they have begun to, or else as in the last one, and by the rod
        as in that.

        What overlaps the rod already, as where a contact was lost for a step, is expected mostly outside:
        `overlap` (n_shapes, 3) is `Simulator.overlap` of each shape where it is now.
        """
        motion = self.com()
        if self.mass > 0.0:
            theirs = sum((other._coming for other in others), np.zeros(6))
            by_force = inverse_inertia(self.mass, self._inertia, motion.pose)
            felt = sum((other._felt for other in others), self._felt)
            besides = (motion.velocity - self._speed) / self.dt - by_force @ felt
            falls = np.linalg.norm(besides[:3] - gravity) < 0.5 * np.linalg.norm(gravity)
            held = np.zeros(6) if falls else _support(besides, felt, by_force, motion.velocity, self.dt)
            self._alone = not (theirs.any() or held.any())
            coming = theirs + (self._past if self._alone else self._coming)
            self._speed = motion.velocity
            velocity = motion.velocity + self.dt * (by_force @ coming + held)
            velocity[:3] += self.dt * gravity * falls
            motion = motion._replace(velocity=velocity)
        pose = motion.after(self.dt)
        if self.mass > 0.0:
            depth = np.linalg.norm(overlap, axis=1)
            most = int(depth.argmax())
            out = min(_LEFT * depth[most], max(depth[most] - _SEEN, 0.0))
            pose[:3] += out / max(depth[most], _SEEN) * overlap[most]
        self._poses, velocities = self._at(pose), {}
        for name, place in self._poses.items():
            linear = motion.velocity[:3] + cross(motion.velocity[3:], place[:3] - pose[:3])
            velocities[name] = np.concatenate([linear, motion.velocity[3:]])
        return self._poses, velocities

    @property
    def _coming(self) -> Floats:
        """(6,) what the rod exerts in this step, or would if it pushed as in the last one."""
        return self.exerted if self._begun else self._weight * self._before + self._past

    @final
    def end(self) -> None:
        """After the engine's step: it has felt what was exerted."""
        self._begun, self._felt = False, self.exerted

    @final
    def push(self, state: State, again: bool = False) -> tuple[Floats, Floats]:
        """Exert the forces of the rod in its contacts with this body; `again` in place of the last ones.

        Returns what was exerted beyond these forces, (6,) with its moment about a point, and that point (3,):
        the rod's host takes its opposite.
        """
        com, wrench, there = self.com().pose[:3], np.zeros(6), self.exerted if again else np.zeros(6)
        self._begun = True
        if self.mass == 0.0:
            return np.zeros(6), com
        if again:
            vars(self).update(self._then)
        self._then = {name: vars(self)[name] for name in ("_before", "_lost", "_even", "_weight", "_past")}
        if (contacts := state.contacts) is not None:
            for name in self.names:
                found: Floats = contacts.wrench[0, contacts.names.index(name)]
                wrench += found
                wrench[3:] += cross(self._poses[name][:3] - com, found[:3])
        more = self._past - (1.0 - self._weight) * wrench
        if not wrench.any():
            more = np.zeros(6)
        along = wrench[:3] if wrench[:3].any() else self._before[:3]
        if (wrench + more)[:3] @ along <= 0.0:
            more = -wrench  # contact pushes, it does not hold
        fraction = self._stopping(wrench + more) if self._lost else 1.0
        more += (fraction - 1.0) * (wrench + more)
        self._lost = fraction < 1.0 and bool(wrench.any())
        even = bool(np.linalg.norm(wrench - self._before) < _ALIKE * np.linalg.norm(wrench))
        if even and self._even and self._alone:
            felt = _FELT if self._weight == 1.0 else 0.0
            self._weight, self._past = _COMING, (_LAST - felt) * wrench + _EARLIER * self._before
        else:
            self._begin_anew(even)
        self._before, self.exerted = wrench, wrench + more
        self._exert(self.exerted - there)
        return more, com

    @final
    def push_half(self) -> None:
        """Exert half of the last forces, as far as they stop the body: for a step in which the rod's are not
        known."""
        half = self._stopping(0.5 * self.exerted) * 0.5 * self.exerted
        self._before, self.exerted, self._lost, self._begun = 0.5 * self._before, half, True, True
        self._begin_anew()
        self._exert(half)

    @final
    def forget(self) -> None:
        """The body was put somewhere else: no force carries over."""
        self._before, self.exerted, self._lost = np.zeros(6), np.zeros(6), False
        self._begun, self._felt, self._speed = False, np.zeros(6), np.full(6, np.nan)
        self._begin_anew()

    def _stopping(self, wrench: Floats) -> float:
        """Fraction of a wrench that stops the body, at most all: while its rod was lost it went into it,
        against no force, and what the rod would give it is nobody's energy."""
        motion = self.com()
        gained: Floats = inverse_inertia(self.mass, self._inertia, motion.pose) @ wrench
        against, power = -float(wrench @ motion.velocity), float(wrench @ gained)
        return min(1.0, max(against, 0.0) / max(self.dt * power, 1e-300))

    def _begin_anew(self, even: bool = False) -> None:
        """Let the body feel the coming force alone; the last one was like the one before it, if `even`."""
        self._even, self._weight, self._past = even, 1.0, np.zeros(6)

    def _exert(self, wrench: Floats) -> None:
        if wrench.any():
            self.apply(wrench)


def _support(besides: Floats, felt: Floats, by_force: Floats, velocity: Floats, dt: float) -> Floats:
    """Return the acceleration (6,) by what holds a body against rods, 0 where nothing does: of what it had
    `besides` that by their wrench (6,), which it has `felt`, as much as that was, and across its motion;
    along it that is friction, which ends with the motion."""
    pushed, inertia = felt @ by_force @ felt, np.linalg.inv(by_force)
    if not pushed > 0.0:
        return np.zeros(6)
    along = inertia @ velocity
    across: Floats = besides - velocity * (along @ besides) / (along @ velocity + (_STILL * dt) ** 2 * pushed)
    if not -(across @ felt) > _HELD * pushed:
        return np.zeros(6)
    return across * min(1.0, float(np.sqrt(pushed / (across @ inertia @ across))))
