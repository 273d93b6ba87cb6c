"""`CarriedRod`: a rod on a host, step by step with the host's engine, whichever that is."""

from __future__ import annotations

import functools
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, final

import numpy as np

from fastrod.contact import ContactScene
from fastrod.errors import HostError, InputError, RobotError, nearest
from fastrod.hosts.body_contact import BodyContact
from fastrod.hosts.host import Host
from fastrod.hosts.rod import INPUTS, Rod
from fastrod.model.robot import Robot
from fastrod.rotation import cross
from fastrod.simulator import Simulator
from fastrod.solver.state import State
from fastrod.types import Floats

_DAMPING = 0.1  # s, of a rod without mass: a choice, not a measurement


class CarriedRod(ABC):
    """One rod on one body of an engine, coupled in both directions: the body's motion moves the rod's base,
    the body feels the base's wrench.

    Bodies that the rod touches are its obstacles: contact bends the rod, its host feels the force, and the
    body is pushed with it. Any other body meets the rod's capsules. The rod's weight is that in the gravity
    of the world at each step.

    Rod and body move together within the step, at any ratio of their masses, with the rod's inertia. A rod
    without line_density has neither mass nor weight, and a line on stderr says so. Where such a one may touch
    bodies it creeps to its shape with its damping_time, 0.1 s if it states none: without mass and damping it
    would swing with what it pushes for ever. With `dynamics=False` a rod that touches nothing is at rest at
    every step, and its host feels its weight alone: for hosts that motors hold.

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
    def _release(self) -> None:
        """After the engine's step: remove the rod's forces that the engine still has."""

    @final
    @property
    def simulator(self) -> Simulator:
        """Simulator of the rod."""
        return self.rod.simulator

    @final
    def settle(self, **inputs: Any) -> State:
        """Settle the rod where its host is now; inputs as for `step`. The host feels nothing yet."""
        inputs = _checked(inputs)
        self.state = self.rod.settle(self._host.motion().pose, **self._scene(), **inputs)
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
        begins = self.state is None
        motion, given = self._host.motion(), self._scene() | inputs
        if self.rod.simulator.dynamics:
            freedom = self._host.freedom(self.dt)
            given |= {"inverse_inertia": freedom.inverse_inertia, "free_twist": freedom.twist}
        state = self.state = self.rod.advance(motion.pose, motion.velocity, self.dt, **given)
        if state.ok[0]:
            self.wrench = self.rod.wrench
            for contact in self.body_contacts:
                more, point = contact.push(state)
                self.wrench[:3] -= more[:3]
                self.wrench[3:] -= more[3:] + cross(point - motion.pose[:3], more[:3])
        else:
            self.wrench = 0.5 * self.wrench
            for contact in self.body_contacts:
                contact.push_half()
        self._host.exert(self.wrench)
        (self._place if begins else self._head_for)()
        return state

    @final
    def end(self) -> None:
        """After the world's step: the capsules stand where the rod is."""
        if self.state is None:
            raise HostError("end() comes after begin() and the world's step.")
        self._release()
        self._place()

    @final
    def reset(self) -> None:
        """Forget the rod's shape and its contacts, but not its inputs: after the host or a body was put
        somewhere else. The next step settles where the host then is."""
        self.rod.reset()
        self.state, self.wrench = None, np.zeros(6)
        self._release()
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
    dynamics: bool,
) -> Rod:
    """Build the rod of a `CarriedRod` that feels what it touches. Raises `InputError`, `RobotError`."""
    scene, weighs = None, any(s.line_density > 0.0 or s.lumps for s in robot.segments)
    moves = dynamics and bool(weighs or body_contacts)
    if not weighs:
        note_massless(robot.name)
    if body_contacts and not dynamics:
        raise InputError(
            "contact_bodies were given with dynamics=False; a rod that may touch bodies moves: leave "
            "dynamics out."
        )
    if moves:
        if any(segment.mode == "paper" for segment in robot.segments):
            raise RobotError(
                f"robot {robot.name!r} is of mode 'paper', which has no energy to move or to touch with; "
                "leave contact_bodies out and give dynamics=False."
            )
        segments = (
            segment
            if segment.line_density + segment.damping_time > 0.0
            else replace(segment, damping_time=_DAMPING)
            for segment in robot.segments
        )
        robot = replace(robot, segments=tuple(segments))
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
        dynamics=moves,
    )


@functools.cache
def note_massless(name: str) -> None:
    """Say so on stderr, once for each robot, unless `FASTROD_QUIET` is set."""
    if not os.environ.get("FASTROD_QUIET"):
        print(
            f"The robot {name!r} has no line_density: mounted, it has neither mass nor weight.",
            file=sys.stderr,
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


def check_bodies(contact_bodies: object) -> None:
    """Raises `HostError` for a name, which would be read letter by letter, and for what is no sequence."""
    if not isinstance(contact_bodies, (list, tuple, set, frozenset, range, np.ndarray)):
        raise HostError(
            f"contact_bodies is {contact_bodies!r}; give a list of bodies, as "
            f"contact_bodies=[{contact_bodies!r}]."
        )


def check_contact(friction: float) -> None:
    """Raises `InputError` for what is no friction coefficient."""
    if not isinstance(friction, (int, float, np.floating)) or not 0.0 <= friction < np.inf:
        raise InputError(f"friction is {friction!r}; it must be a number, zero or positive.")


def _checked(inputs: dict[str, Any]) -> dict[str, Any]:
    own = [name for name in INPUTS if name != "gravity"]
    for name in inputs:
        if name not in own:
            why = "the host gives it" if name in ("base_pose", "gravity") else nearest(name, own)
            raise InputError(f"a mounted rod has no input {name!r}; {why}")
    return inputs
