"""`CarriedRod`: a rod on a host, step by step with the host's engine, whichever that is."""

from __future__ import annotations

import functools
import math
import os
import sys
import weakref
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, final

import numpy as np

from fastrod.contact import ContactScene
from fastrod.errors import HostError, InputError, RobotError, nearest
from fastrod.hosts.body_contact import BodyContact
from fastrod.hosts.host import Freedom, Host, Motion
from fastrod.hosts.rod import INPUTS, Rod, RodSnapshot
from fastrod.model.robot import Robot
from fastrod.rotation import cross, displacement
from fastrod.simulator import Simulator
from fastrod.solver.state import State
from fastrod.types import Floats

_DAMPING = 0.1  # s, of a rod without mass: a choice, not a measurement
# of what holds a body, in a step, where rods are as heavy as it is; and by how much of it such a one may
# accelerate all the same
_LEARNS, _HOLDS = 0.2, 0.5
_ROUNDS, _ALIKE = 3, 0.02  # in which rods on one body agree, and to how much of their wrenches
_RODS: defaultdict[int, weakref.WeakValueDictionary[int, CarriedRod]] = defaultdict(
    weakref.WeakValueDictionary
)
"""Rods of a world, by its identity: those on one body, and those that touch one, find each other here."""


class _Begun(NamedTuple):
    """A step that a rod has begun, until it ends."""

    before: RodSnapshot
    motion: Motion
    given: dict[str, Any]
    """Inputs of the rod, but those of its base."""


class _Support(NamedTuple):
    """Acceleration of a rod's base by what holds it and its host does not know of."""

    before: Floats
    """(6,) velocity of the base before the last step."""
    after: Floats
    """(6,) that it was expected to have after it."""
    held: Floats
    """(6,) acceleration that is taken to hold it [m/s^2, rad/s^2]."""


_UNKNOWN = _Support(np.full(6, np.nan), np.full(6, np.nan), np.zeros(6))


class CarriedRod(ABC):
    """One rod on one body of an engine, coupled in both directions: the body's motion moves the rod's base,
    the body feels the base's wrench.

    Bodies that the rod touches are its obstacles: contact bends the rod, its host feels the force, and the
    body is pushed with it. Any other body meets the rod's capsules. The rod's weight is that in the gravity
    of the world at each step.

    Rod and body move together within the step, at any ratio of their masses, with the rod's inertia; so do
    several rods on one body, or on one arm. A rod without line_density has neither mass nor weight, and a
    line on stderr says so. Where such a one may touch bodies it creeps to its shape with its damping_time,
    0.1 s if it states none: without mass and damping it would swing with what it pushes for ever. With
    `dynamics=False` a rod that touches nothing is at rest at every step, and its host feels its weight alone:
    for hosts that motors hold.

    A step is `rod.step(...)`, or for several rods in one world `begin` each, one step of the engine, `end`
    each. Of several rods on one body, each that begins moves those that have begun: read `state` after `end`.
    """

    body_contacts: Sequence[BodyContact]
    rod: Rod
    """The rod itself, without the engine."""

    def __init__(self, host: Host, dt: float, world: int) -> None:
        self._host, self.dt = host, dt
        self.state: State | None = None
        """After the last step."""
        self.wrench: Floats = np.zeros(6)
        """Force [N] and moment about the base point [N m] that the host felt in the last step, world."""
        self._begun: _Begun | None = None
        self._support = _UNKNOWN
        self.body_contacts = ()
        self._every = _RODS[world]
        self._every[id(self)] = self

    @abstractmethod
    def _look(self) -> None:
        """Before a step: `HostError` where the engine's time step is no longer `dt`."""

    @abstractmethod
    def _gravity(self) -> Floats:
        """(3,) of the engine's world as it is now [m/s^2]."""

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
        self._support = _UNKNOWN
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
        self._release()
        inputs, self._begun = _checked(inputs), None
        begins, motion, given = self.state is None, self._host.motion(), self._scene() | inputs
        if self.rod.simulator.dynamics:
            state = self._with_others(motion, given)
        else:
            state = self.state = self.rod.advance(motion.pose, motion.velocity, self.dt, **given)
            self._exert(state, motion.pose[:3])
        (self._place if begins else self._head_for)()
        return state

    @final
    def end(self) -> None:
        """After the world's step: the capsules stand where the rod is."""
        if self.state is None:
            raise HostError("end() comes after begin() and the world's step.")
        self._release()
        self._begun = None
        for contact in self.body_contacts:
            contact.end()
        self._place()

    @final
    def reset(self) -> None:
        """Forget the rod's shape and its contacts, but not its inputs: after the host or a body was put
        somewhere else. The next step settles where the host then is."""
        self.rod.reset()
        self.state, self._begun, self.wrench, self._support = None, None, np.zeros(6), _UNKNOWN
        self._release()
        for contact in self.body_contacts:
            contact.forget()

    def _leave(self) -> None:
        """No rod finds this one any more."""
        self._every.pop(id(self), None)

    def _exert(self, state: State, point: Floats) -> None:
        """Let the host, and what the rod touches, feel this `state`; the base was at `point` (3,)."""
        if state.ok[0]:
            self.wrench = self._push(state, point)
        else:
            self.wrench = 0.5 * self.wrench
            for contact in self.body_contacts:
                contact.push_half()
        self._host.exert(self.wrench)

    def _push(self, state: State, point: Floats, again: bool = False) -> Floats:
        """Push what the rod touches; wrench (6,) on the host, about the base `point` (3,) before the step."""
        wrench = self.rod.wrench
        for contact in self.body_contacts:
            more, at = contact.push(state, again)
            wrench[:3] -= more[:3]
            wrench[3:] -= more[3:] + cross(at - point, more[:3])
        return wrench

    def _with_others(self, motion: Motion, given: dict[str, Any]) -> State:
        """One step of a rod that moves, and of those on the same body that have begun theirs, in turn: each
        feels what the others exert, and these give way by their stiffness; until none is to change."""
        rods = [self, *(rod for rod in self._others() if rod._begun and self._host.moves_with(rod._host))]
        freedom = self._host.freedom(self.dt, [(rod._host, rod.wrench) for rod in rods[1:]])
        every, exerted = freedom.inverse_inertia, np.stack([np.zeros(6), *(rod.wrench for rod in rods[1:])])
        bare = freedom.twist - self.dt * every @ exerted.ravel()
        self.rod.start(motion, bare[:6], self.dt, **given)
        before, places = self.rod.snapshot(), np.arange(6 * len(rods)).reshape(-1, 6)
        if freedom.may_be_held:
            self._support = self._supported(motion, every[:6, :6])
            bare += self.dt * np.concatenate([rod._support.held for rod in rods])
        for count in range(_ROUNDS):
            agreed = True
            for k, rod in enumerate(rods):
                twist = (bare + self.dt * every @ exerted.ravel())[places[k]]
                if rod._begun and not rod._is_changed(twist):
                    continue
                order = np.roll(places, -k, axis=0).ravel()
                theirs = exerted * (np.arange(len(rods)) != k)[:, None]
                own = Freedom(every[np.ix_(order, order)], (bare + self.dt * every @ theirs.ravel())[order])
                own = _together(own, [other._stiffness() for other in (*rods[k + 1 :], *rods[:k])], self.dt)
                base = {"inverse_inertia": own.inverse_inertia, "free_twist": own.twist}
                if rod._begun is None:
                    self.state = self.rod.advance(motion.pose, motion.velocity, self.dt, **given, **base)
                    self._begun = _Begun(before, motion, given)
                    self._exert(self.state, motion.pose[:3])
                else:
                    rod._do_again(base)
                exerted[k], agreed = rod.wrench, agreed and count == k == 0
            if agreed:
                break
        for rod, twist in zip(rods, (bare + self.dt * every @ exerted.ravel()).reshape(-1, 6), strict=True):
            rod._support = rod._support._replace(after=twist)
        assert self.state is not None
        return self.state

    def _supported(self, motion: Motion, mobility: Floats) -> _Support:
        """Find what holds the base in the coming step: what moved it in the last one beyond what was expected
        there, if it hardly accelerated.

        On the inertia of their body, of this `mobility` (6, 6), which is a spring within a step, and on what
        holds it, which adds up over steps, rods stand as under a PI controller. Along each axis of the
        mobility it learns the more slowly the heavier they are there, or they would swing up.
        """
        before, after, held = self._support
        if not np.isfinite(after).all():
            return _Support(motion.velocity, after, held)
        rods = [self, *(rod for rod in self._others() if self._host.moves_with(rod._host))]
        mass = float(sum(s.length * s.line_density for rod in rods for s in rod.rod.robot.segments))
        unit = np.repeat([1.0, self.rod.robot.length / math.sqrt(3.0)], 3)  # that a straight rod gyrates by
        heavy, along = np.linalg.eigh(mass * unit[:, None] * mobility * unit)
        learns = along * np.minimum(1.0, _LEARNS / np.maximum(heavy, 1e-300)) @ along.T
        held, found = unit * held, unit * ((motion.velocity - after) / self.dt + held)
        alone = unit * (after - before) / self.dt - held
        if np.linalg.norm(alone + found) > _HOLDS * np.linalg.norm(found):
            found = np.zeros(6)  # as of an impact, which passes
        return _Support(motion.velocity, after, (held + learns @ (found - held)) / unit)

    def _others(self) -> list[CarriedRod]:
        """All other rods of this world."""
        return [rod for ref in self._every.valuerefs() if (rod := ref()) and rod is not self]

    def _stiffness(self) -> tuple[Floats, Floats]:
        """(6, 6) by how much the rod's wrench falls by more motion of its base in the step that it has begun,
        0 where none is known; and the twist (6,) at which that has gone."""
        begun, state, stiffness = self._begun, self.state, np.full((6, 6), np.nan)
        known = state is not None and state.ok[0] and state.mean_wrench is not None  # a rest has none
        if begun is not None and known:
            stiffness = self.rod.stiffness
        if begun is None or not np.isfinite(stiffness).all():  # of a step that could not be done again, too
            return np.zeros((6, 6)), np.full(6, np.nan)
        size, axes = np.linalg.eigh(stiffness)
        resists = (axes * np.maximum(size, 0.0)) @ axes.T  # a rod that buckles helps, which nobody counts on
        return resists, displacement(begun.motion.pose, self.rod.base) / self.dt

    def _is_changed(self, twist: Floats) -> bool:
        """Whether the rod is to exert something else than it has, with its base at this `twist` (6,)."""
        stiffness, went = self._stiffness()
        unit = np.repeat([1.0, 1.0 / self.rod.robot.length], 3)
        change = np.abs(unit * (self.dt * stiffness @ (twist - went))).max()
        return bool(change > _ALIKE * np.abs(unit * self.wrench).max())

    def _do_again(self, base: dict[str, Floats]) -> None:
        """Do the begun step again on a base that moves so: the host feels the difference. A step that cannot
        be solved there stays."""
        begun, after = self._begun, self.rod.snapshot()
        assert begun is not None
        self.rod.restore(begun.before)
        try:
            state = self.rod.advance(begun.motion.pose, begun.motion.velocity, self.dt, **begun.given, **base)
        except HostError:
            state = None
        if state is None or not state.ok[0]:
            self.rod.restore(after)
            return
        more = self._push(state, begun.motion.pose[:3], again=True) - self.wrench
        self.state, self.wrench = state, self.wrench + more
        self._host.exert(more)
        self._head_for()

    def _scene(self) -> dict[str, Any]:
        """Return the rod's inputs from the world: gravity, and the bodies around."""
        world: dict[str, Any] = {"gravity": self._gravity()}
        if not self.body_contacts:
            return world
        poses: dict[str, Floats] = {}
        velocities: dict[str, Floats] = {}
        theirs = [other for rod in self._others() for other in rod.body_contacts]
        now = {name: pose for contact in self.body_contacts for name, pose in contact.now().items()}
        overlap = np.zeros((len(now), 3)) if self.state is None else self.simulator.overlap(now)[0]
        of_each = np.split(overlap, np.cumsum([len(contact.names) for contact in self.body_contacts[:-1]]))
        for k, (contact, own) in enumerate(zip(self.body_contacts, of_each, strict=True)):
            others = [other for other in theirs if other.number == contact.number]
            p, v = contact.expected(world["gravity"], own, others)
            for name in contact.names:
                mobility, center, ahead = contact.mobility()
                self.simulator.set_free(name, mobility, center, k, ahead)
            poses |= p
            velocities |= v
        return world | {"obstacle_pose": poses, "obstacle_velocity": velocities}


def _together(freedom: Freedom, others: Sequence[tuple[Floats, Floats]], dt: float) -> Freedom:
    """`freedom` of the first of its bases, where on each of the others a rod resists by its stiffness (6, 6)
    what that does beyond where it went (6,).

    A wrench w moves the others by e = dt^2 (G_o1 w - G_oo K (e - r)) beyond where they are without it, of
    which they went r already, and the first by dt^2 (G_11 w - G_1o K (e - r)).
    """
    every, n = freedom.inverse_inertia, 6 * len(others)
    resists, ahead = np.zeros((n, n)), np.zeros(n)
    for k, (stiffness, went) in enumerate(others):
        here = slice(6 * k, 6 * k + 6)
        resists[here, here] = stiffness
        ahead[here] = np.nan_to_num(went - freedom.twist[6:][here])
    left = np.linalg.inv(np.eye(n) + dt**2 * every[6:, 6:] @ resists)
    back = dt**2 * every[:6, 6:] @ resists @ left
    mobility = every[:6, :6] - back @ every[6:, :6]
    return Freedom(0.5 * (mobility + mobility.T), freedom.twist[:6] + back @ ahead)


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


def _checked(inputs: dict[str, Any]) -> dict[str, Any]:
    own = [name for name in INPUTS if name != "gravity"]
    for name in inputs:
        if name not in own:
            why = "the host gives it" if name in ("base_pose", "gravity") else nearest(name, own)
            raise InputError(f"a mounted rod has no input {name!r}; {why}")
    return inputs
