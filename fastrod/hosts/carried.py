"""`CarriedRod`: a rod on a host, step by step with the host's engine, whichever that is."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar, final

import numpy as np

from fastrod.contact import ContactScene
from fastrod.errors import HostError, InputError, nearest
from fastrod.hosts.body_contact import BodyContact
from fastrod.hosts.host import Host
from fastrod.hosts.rod import INPUTS, Rod
from fastrod.model.robot import Robot
from fastrod.simulator import Simulator
from fastrod.solver.state import State
from fastrod.types import Floats

P = ParamSpec("P")
T = TypeVar("T")


class CarriedRod(ABC):
    """One rod on one body of an engine, coupled in both directions: the body's motion moves the rod's base,
    the body feels the base's wrench.

    Bodies that the rod touches are its obstacles: contact bends the rod, its host feels the force, and the
    body is pushed with it. Any other body meets the rod's capsules. The rod's weight is that in the gravity
    of the world at each step.

    A step is `rod.step(...)`, or for several rods in one world `begin` each, one step of the engine, `end`
    each.
    """

    body_contacts: Sequence[BodyContact]
    rod: Rod
    """The rod itself, without the engine."""

    def __init__(self, host: Host, dt: float) -> None:
        self._host, self.dt = host, dt
        self.state: State | None = None
        """After the last step."""
        self.wrench: Floats = np.zeros(6)
        """Force [N] and moment about the base point [N m] that the host felt in the last step, world."""

    @abstractmethod
    def _look(self) -> None:
        """Before a step: `HostError` where the engine's time step is no longer `dt`."""

    @abstractmethod
    def _gravity(self) -> Floats:
        """(3,) of the engine's world as it is now [m/s^2]."""

    @abstractmethod
    def _shapes(self) -> Sequence[int]:
        """The engine's numbers of the capsules."""

    @abstractmethod
    def _place(self) -> None:
        """Capsules stand where the rod is."""

    @abstractmethod
    def _head_for(self) -> None:
        """Capsules are to be where the rod is at the end of the engine's step, as far as the engine lets
        them."""

    @abstractmethod
    def _step_engine(self) -> None:
        """One step of the engine."""

    @abstractmethod
    def _loads(self, inputs: dict[str, Any]) -> dict[str, Any]:
        """`inputs` with what the engine's own contacts add to them."""

    @abstractmethod
    def _accepted(self, inputs: dict[str, Any]) -> None:
        """`inputs` of a call that was not refused: from now on they are those that stay."""

    @abstractmethod
    def _arrived(self) -> None:
        """After the engine's step."""

    @abstractmethod
    def _forget(self) -> None:
        """Remove the rod's forces that the engine still has."""

    @final
    @property
    def simulator(self) -> Simulator:
        """Of the rod."""
        return self.rod.simulator

    @final
    def settle(self, **inputs: Any) -> State:
        """Settle the rod where its host is now; inputs as for `step`. The host feels nothing yet."""
        inputs = _checked(inputs)
        self.state = self.rod.settle(self._host.motion().pose, **self._scene(), **self._loads(inputs))
        self._accepted(inputs)
        self._place()
        return self.state

    @final
    def step(self, **inputs: Any) -> State:
        """Do one step of rod and world together.

        Inputs as for `Simulator.step`, but base and obstacles, which the world gives; what is not given stays
        as it was commanded last, and the tendons are those of the straight robot until then.
        """
        state = self.begin(**inputs)
        self._step_engine()
        self.end()
        return state

    @final
    def begin(self, **inputs: Any) -> State:
        """Compute the rod at the end of the next step; its wrench goes to the host, its pushes to what it
        touches.

        A step that cannot be solved (`state.ok` is false, and `state.problems` says why) leaves the rod where
        it stopped, with half the forces of the step before; after a few in a row the rod settles anew. Raises
        `InputError` as `Simulator.step`, `HostError` where the rod is lost, where 25 steps in a row cannot be
        solved, or where the world's time step has changed.
        """
        self._look()
        inputs = _checked(inputs)
        if self.state is None:
            self.settle(**inputs)
        motion = self._host.motion()
        state = self.state = self.rod.advance(
            motion.pose, motion.velocity, self.dt, **self._scene(), **self._loads(inputs)
        )
        self._accepted(inputs)
        if state.ok[0]:
            self.wrench = state.base_wrench[0].copy()
            for contact in self.body_contacts:
                more, point = contact.push(state)
                self.wrench[:3] -= more[:3]
                self.wrench[3:] -= more[3:] + np.cross(point - self.rod.base[:3], more[:3])
        else:
            self.wrench = 0.5 * self.wrench
            for contact in self.body_contacts:
                contact.push_half()
        self._host.exert(self.wrench)
        self._head_for()
        return state

    @final
    def end(self) -> None:
        """After the world's step: the capsules stand where the rod is."""
        if self.state is None:
            raise HostError("end() comes after begin() and the world's step.")
        self._arrived()
        self._place()

    @final
    def reset(self) -> None:
        """Forget the rod's shape and its contacts, but not its inputs: after the host or a body was put
        somewhere else. The next step settles where the host then is."""
        self.rod.reset()
        self.state, self.wrench = None, np.zeros(6)
        self._forget()
        for contact in self.body_contacts:
            contact.forget()

    def _scene(self) -> dict[str, Any]:
        """Return the rod's inputs from the world: gravity, and the bodies around."""
        world: dict[str, Any] = {"gravity": self._gravity()}
        if not self.body_contacts:
            return world
        poses: dict[str, Floats] = {}
        velocities: dict[str, Floats] = {}
        for k, contact in enumerate(self.body_contacts):
            p, v = contact.expected(self._shapes())
            for name in contact.names:
                self.simulator.set_free(name, *contact.mobility(), body=k)
            poses |= p
            velocities |= v
        return world | {"obstacle_pose": poses, "obstacle_velocity": velocities}


def rod_of(
    robot: Robot,
    body_contacts: Sequence[BodyContact],
    *,
    dt: float,
    max_contacts: int,
    points_per_segment: int,
    capsules_per_segment: int,
    dynamics: bool = False,
) -> Rod:
    """Build the rod of a `CarriedRod` that feels what it touches. Raises `InputError`, `RobotError`."""
    scene = None
    if body_contacts:
        scene = ContactScene(
            obstacles=[shape.obstacle for body in body_contacts for shape in body.shapes],
            max_contacts=max_contacts,
        )
    return Rod(
        robot,
        dt=dt,
        contact=scene,
        points_per_segment=points_per_segment,
        capsules_per_segment=capsules_per_segment,
        dynamics=dynamics,
    )


def check_gravity(robot: Robot, gravity: Floats, how: str) -> None:
    """Raises `HostError` where a robot with weight states another gravity than this (3,) of its host's world;
    `how` says how that is changed."""
    weighs = bool(robot.effects) or any(segment.line_density > 0.0 for segment in robot.segments)
    if robot.states_gravity and weighs and not np.allclose(robot.gravity, gravity, rtol=1e-6, atol=1e-6):
        own, there = [float(g) for g in robot.gravity], gravity.round(6).tolist()
        raise HostError(
            f"robot {robot.name!r} states gravity {own} m/s^2, and the world of its host has {there}; "
            f"a mounted rod feels its host's: leave [world] gravity out of the robot file, or {how}."
        )


def refuse_old_names(**now: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Make a function refuse keywords by their old names, with `HostError` and the name they have `now`."""

    def wrap(function: Callable[P, T]) -> Callable[P, T]:
        @functools.wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> T:
            for old in now.keys() & kwargs.keys():
                raise HostError(f"{old} is now {now[old]}; give {now[old]}=... instead.")
            return function(*args, **kwargs)

        return checked

    return wrap


def check_bodies(contact_bodies: object) -> None:
    """Raises `HostError` for a name, which would be read letter by letter, and for what is no sequence."""
    if not isinstance(contact_bodies, (list, tuple, set, frozenset, range, np.ndarray)):
        raise HostError(
            f"contact_bodies is {contact_bodies!r}; give a list of bodies, as "
            f"contact_bodies=[{contact_bodies!r}]."
        )


def check_contact(relaxation: float, friction: float) -> None:
    """Raises `InputError` for what is no relaxation [s], no friction coefficient."""
    for name, value, unit in (("relaxation", relaxation, " s"), ("friction", friction, "")):
        if not isinstance(value, (int, float, np.floating)) or not 0.0 <= value < np.inf:
            raise InputError(f"{name} is {value!r}{unit}; it must be a number, zero or positive.")


def _checked(inputs: dict[str, Any]) -> dict[str, Any]:
    own = [name for name in INPUTS if name != "gravity"]
    for name in inputs:
        if name not in own:
            why = "the host gives it" if name in ("base_pose", "gravity") else nearest(name, own)
            raise InputError(f"a mounted rod has no input {name!r}; {why}")
    return inputs
