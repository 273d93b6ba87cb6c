"""`TouchingRods`: rods of modes that feel obstacles, in motion and at rest.

A step of a rod that touches is one of BDF1, by Newton's method with its contacts as a convex potential
(`kernels.contact.press`): the contacts of the shape, the rod's Hessian there, their forces. Where that does
not end, four steps of a quarter are taken for that robot alone, and so on. A rest is the end of such steps
that are held up after each; rods that never move have a mass for them that is no one's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fastrod.contact.engine import Engine
from fastrod.contact.frames import blended, longest_move
from fastrod.errors import InputError, Problem
from fastrod.kernels.contact.problem import MOST_FOUND
from fastrod.kernels.contact.proximity import search_work
from fastrod.kernels.contact_batch import search_gaps
from fastrod.kernels.press_batch import end_some, press_some, renew_some
from fastrod.kernels.rod.modal.motion import BDF1, BDF2, GENERALIZED_ALPHA, ModalMotion
from fastrod.model.robot import Robot
from fastrod.solver.inputs import Inputs
from fastrod.solver.modal import Step, in_threads
from fastrod.solver.modal_response import ModalLinear
from fastrod.solver.motion import ModalRods
from fastrod.solver.options import Modal, Modes
from fastrod.solver.protocol import Acting, How, Last, Solved
from fastrod.solver.settle import unloaded
from fastrod.solver.stepper import PassShapes, copied
from fastrod.types import CANDIDATE, ContactMotion, Flags, Floats, Ints, Ports

_PASSES = 8
_MOVING = 2  # passes in which contacts follow the places where the gap is least
_RENEWING = 2  # passes after which the slips that a step is led by are told anew
_STILL = 1e-6  # rad: a Newton step below it is the last one
_INSIDE = 1e-5  # m: as deep as a rod may be in what it touches
_SHORTEST = 4.0**-4  # of a step
_ROOM = 4  # contacts: room is made for a multiple
_AT_REST, _CREEPS = 1e-7, 2e-9  # m: of motion within one step of a rest, and below the tolerance asked for
_MOST_STEPS, _GROWS, _LONGEST = 400, 2.0, 1.0  # steps to a rest, and their length [s]
_SLOW = 0.03  # s: a rod with a mass for its steps to rest alone rings at 3.5 / 2 pi over it


class TouchingRods(ModalRods):
    """Rods of modes in motion, bent by what they touch. Free ones take steps of BDF2 where generalized-alpha
    was asked for: it goes on from a step of BDF1."""

    def __init__(
        self, engine: Engine, options: Modal, robots: tuple[Robot, ...], *given: Any, **named: Any
    ) -> None:
        # a force between its ends makes a kink in the curvature of a segment
        pieces = 2 if robots[0].n_segments == 1 else 1
        usual = Modes(4, 2, pieces=pieces) if options.dynamics else Modes(6, 4, pieces=pieces)
        options = replace(options, modes=options.modes or usual)
        super().__init__(options, robots, *given, **{**named, "outputs": "full"})
        self.engine = engine
        self._weigh()
        time = self.stepper.time
        if time.scheme == GENERALIZED_ALPHA:
            self.stepper.time = time._replace(scheme=BDF2)
        self._passes = np.zeros(self.n_robots, np.int64)

    def replace(self, robots: Sequence[Robot]) -> None:
        """Take other robots of the same layout; a recording ends."""
        super().replace(robots)
        self._weigh()

    def _weigh(self) -> None:
        """Give robots that only rest a mass for the steps to it, such that they would ring at some Hz."""
        if self.dynamics:
            return
        pieces = self.modal.pieces
        mass = [
            _SLOW**2 * min(min(s.bending_stiffness) for s in robot.segments) / robot.length**4
            for robot in self.robots
        ]
        rotary = [[0.25 * s.body_radius**2 for s in robot.segments] for robot in self.robots]
        each = np.stack([np.ones_like(rotary), rotary, rotary], axis=-1)
        self.modal.pieces = pieces._replace(density=np.array(mass)[:, None, None] * each)

    def accept(self, given: Inputs, how: How | None) -> None:
        """Take how the next step is to be. Raises `InputError` for what rods that touch do not take."""
        if how is not None and (how.inverse_inertia is not None or how.estimate_error):
            what = "inverse_inertia" if how.inverse_inertia is not None else "estimate_error"
            raise InputError(f"{what} was given with a contact scene, which does not take it; leave it out.")
        if self.engine.surfaces.mobility.any():
            raise InputError("rods in motion feel no free bodies yet; give obstacle_pose.")
        super().accept(given, how)

    def step(self, rows: Ints, acting: Acting, last: Last, how: How) -> Solved:
        """Move these robots on by dt, or bring them to rest."""
        self._take(acting)
        engine, stepper, before, ports = self.engine, self.stepper, last.ports, acting.ports
        cold, warm = rows[~last.warm[rows]], rows[last.warm[rows]]
        found, ok = self._room(True), np.zeros(self.n_robots, bool)
        self._passes[:] = 0
        if not self.dynamics:
            ok[rows] = self._rest(rows, cold, acting, found, _AT_REST)
        elif len(cold):
            ok[cold] = self._rest(cold, cold, acting, found, _AT_REST)
        if self.dynamics and len(warm) and before is not None:
            start, inputs = copied(self.modal.motion), (before, ports)
            jump, pressed = stepper.jumps(before, ports), engine.pressed()
            free = warm[~pressed[warm]]
            ok[free] = stepper.advance(free, inputs, jump, found)
            self._passes[free] = np.abs(self.modal.iterations[free])
            touch = pressed | engine.overlap(free[ok[free]], found.shape)
            some = warm[touch[warm]]
            _put(self.modal.motion, start, some)
            ok[some] = self._touch(some, acting, inputs, (0.0, 1.0), found)
        engine.accept(rows[ok[rows]], found.shape)
        engine.end_step(ok.astype(float))
        return self._found(found, ok, ports)

    def settle(self, rows: Ints, acting: Acting, last: Last, tolerance: float) -> Solved:
        """Bring these robots to rest, to `tolerance` [m] in a step of a second."""
        self._take(acting)
        found, ok = self._room(True), np.zeros(self.n_robots, bool)
        self._passes[:] = 0
        ok[rows] = self._rest(rows, rows[~last.warm[rows]], acting, found, tolerance)
        self.engine.accept(rows[ok[rows]], found.shape)
        self.engine.end_step(ok.astype(float))
        return self._found(found, ok, acting.ports)

    def _found(self, found: PassShapes, ok: Flags, ports: Ports) -> Solved:
        """The state, with what has stopped those that are not ok."""
        solved = self._solved(found, ok, ports)
        passes = np.where(ok, np.maximum(self._passes, 1), -1)
        reason = "contact in motion" if self.dynamics else "contact"
        return solved._replace(passes=passes, reason=reason, kind=Problem.CONTACT_STUCK)

    def _rest(self, rows: Ints, cold: Ints, acting: Acting, found: PassShapes, tolerance: float) -> Flags:
        """(n_rows,) who came to rest: freely, or else in steps of BDF1 that are held up after each, from
        where they are; cold ones from straight."""
        engine, modal, ports = self.engine, self.modal, acting.ports
        mask = np.isin(np.arange(self.n_robots), cold)
        engine.forget(mask)
        engine.place_at_once(mask)
        start, pressed = copied(modal.motion), engine.pressed()
        ok, free = np.zeros(self.n_robots, bool), rows[~pressed[rows]]
        ok[free] = self.stepper.rest(free, cold, ports, found, min(tolerance, _AT_REST))
        touch = rows[(pressed | ~ok | engine.overlap(free[ok[free]], found.shape))[rows]]
        if not len(touch):
            return ok[rows]
        _put(modal.motion, start, touch)
        ok[touch] = False
        fresh = touch[mask[touch]]
        if len(fresh):  # from straight, where that is clear
            straight = unloaded(ports, modal.layout, modal.params)
            ok[fresh] = self.stepper.rest(fresh, fresh, straight, found, _AT_REST)
            ok[fresh] &= ~engine.overlap(fresh[ok[fresh]], found.shape)[fresh]
            engine.accept(fresh[ok[fresh]], found.shape, between_steps=True)
            touch = touch[ok[touch] | ~mask[touch]]
            ok[fresh] = False
        dt, still, longest = np.where(mask | self.dynamics, self.stepper.time.dt, _LONGEST), touch, _LONGEST
        for _ in range(_MOST_STEPS):
            if not len(still):
                break
            for size in np.unique(dt[still]):
                some = still[dt[still] == size]
                self._hold_up(some)
                was = modal.motion.place[some].copy()
                well = self._touch(some, acting, (ports, ports), (0.0, 1.0), found, float(size))
                engine.accept(some[well], found.shape, between_steps=True)
                engine.place_at_once(np.isin(np.arange(self.n_robots), some[well]))
                moved = np.abs(modal.motion.place[some] - was).max(1)
                ok[some] = well & (moved < max(tolerance, _CREEPS)) & (size >= longest)
                dt[some] = np.where(well, np.minimum(_GROWS * size, longest), 0.25 * size)
            still = still[~ok[still] & (dt[still] > 1e-9)]
        self._hold_up(touch)
        return ok[rows]

    def _hold_up(self, rows: Ints) -> None:
        """Take the motion of these robots from them."""
        motion = self.modal.motion
        for name in ("rate", "velocity", "velocity_other"):
            getattr(motion, name)[rows] = 0.0
        motion.q_other[rows], motion.place_other[rows] = motion.q[rows], motion.place[rows]

    # ------------------------------------------------------------ a step in contact

    def _touch(
        self,
        rows: Ints,
        acting: Acting,
        inputs: tuple[Ports, Ports],
        span: tuple[float, float],
        found: PassShapes,
        length: float | None = None,
    ) -> Flags:
        """(n_rows,) who moved on over this fraction `span` of a step of `length` [s] (dt), along which the
        inputs change evenly; the others are as they were."""
        if not len(rows):
            return np.zeros(0, bool)
        engine, motion, n = self.engine, self.modal.motion, self.n_robots
        first, last = span
        whole = self.stepper.time.dt if length is None else length
        ports = inputs[1] if last >= 1.0 else blended(*inputs, np.full(n, last))
        start, contacts = _rows_of(motion, rows), _contacts_of(engine, rows)
        ok = self._one(rows, acting, ports, Step(BDF1, (last - first) * whole), span, found)
        lost = rows[~ok]
        _put_contacts(engine, contacts, rows, lost)
        self._measure_anew(lost)
        if not len(lost) or last - first < 1.5 * _SHORTEST:
            return ok
        before, left = engine.before, lost
        for k in range(4):
            part = first + (last - first) * k / 4.0, first + (last - first) * (k + 1) / 4.0
            well = self._touch(left, acting, inputs, part, found, length)
            left = left[well]
            self._measure_anew(left)
            if k < 3:
                engine.accept(left, found.shape, between_steps=True)
        back = lost[~np.isin(lost, left)]
        _put_rows(motion, start, rows, back)
        _put_contacts(engine, contacts, rows, back)
        if before is not None and engine.before is not None:
            for array, then in zip(engine.before, before, strict=True):
                array[lost] = then[lost]
        for name, array in zip(ModalMotion._fields, motion, strict=True):
            if name.endswith("_other"):  # BDF2 goes on from where the whole step began
                then = getattr(start, name.removesuffix("_other"))
                array[left] = then[np.searchsorted(rows, left)]
        ok[np.isin(rows, left)] = True
        return ok

    def _measure_anew(self, rows: Ints) -> None:
        """What is known of the distance of these robots holds for obstacles elsewhere on their way."""
        engine = self.engine
        moved = longest_move(engine.poses_before, engine.poses, engine.surfaces.sphere)
        engine.clearance.distance[rows] -= np.broadcast_to(moved, self.n_robots)[rows, None]

    def _one(
        self,
        rows: Ints,
        acting: Acting,
        ports: Ports,
        how: Step,
        span: tuple[float, float],
        found: PassShapes,
    ) -> Flags:
        """(n_rows,) whose Newton's method ended in one step; they are moved on."""
        engine, modal, n = self.engine, self.modal, self.n_robots
        motion, contacts = modal.motion, engine.contact_set
        q = motion.q + how.dt * motion.rate
        done, left = (np.full(n, fraction) for fraction in span)
        aim, left = left, rows
        size, changed, good = np.full(n, np.inf), np.ones(n, bool), np.zeros(n, bool)
        contacts.contact["slid"][rows] = 0.0
        for count in range(_PASSES + 1):
            world, near, n_found = self._seen(left, ports, how, q, found, done, aim)
            if count == 0 and (n_found < 0).any():  # at that speed it would go through: from where it is
                q[left[n_found < 0]] = motion.q[left[n_found < 0]]
                world, near, n_found = self._seen(left, ports, how, q, found, done, aim)
            rest = (size < _STILL) & ~changed & (engine.clearance.gap > -_INSIDE)
            good[left[rest[left] & (n_found >= 0)]] = True
            keep = ~good[left]
            left, near, n_found = left[keep], near[keep], np.maximum(n_found[keep], 0)
            if not len(left) or count == _PASSES:
                break
            renew_some(left, engine.rods, engine.surfaces, world, contacts, near, n_found, count >= _MOVING)
            modal.place_points(*self._points(left, acting), ports.extension)
            zero = np.zeros(n)
            d = modal.derive(left, ports, q, wanted=("hessian", "point"), step=(motion, how, zero))
            step = np.zeros_like(q)
            model = d.hessian, d.gradient, d.point_change, acting.points[0].shape[1], count < _RENEWING
            self._press(left, world, model, (step, changed))
            q[left] += step[left]
            size[left] = np.abs(step[left]).max(1) * float(np.max(modal.params.rod_length))
            self._passes[left] += 1
            lost = ~np.isfinite(q[left]).all(1)
            q[left[lost]] = motion.q[left[lost]]
            left = left[~lost]
        arrived = rows[good[rows]]
        if len(arrived):
            modal.place_points(*self._points(arrived, acting), ports.extension)
            modal.hold(arrived, ports, *found, how, q, True)
            end_some(arrived, contacts)
        modal.place_points(*acting.points, ports.extension)
        return good[rows]

    def _press(self, rows: Ints, world: ContactMotion, model: Any, out: Any) -> None:
        """`press_some` on so many threads."""
        engine = self.engine
        shares = np.array_split(rows, engine.thread_count(len(rows)))
        given: Any = (engine.rods, engine.surfaces, world, engine.contact_set, *model, *out)
        in_threads(len(shares), lambda task: press_some(shares[task], *given))

    def _seen(
        self, rows: Ints, ports: Ports, how: Step, q: Floats, found: PassShapes, done: Floats, aim: Floats
    ) -> tuple[Any, Any, Ints]:
        """Rods at q among the obstacles, candidates of these, and how many; below 0 where one was gone
        through."""
        engine = self.engine
        self.modal.hold(rows, ports, *found, how, q, False)
        world = engine.motion(found.shape, _INSIDE, done, aim)
        near, n_found = np.empty((len(rows), MOST_FOUND), CANDIDATE), np.zeros(len(rows), np.int64)
        threads = engine.thread_count(len(rows))
        work = search_work(threads, found.shape.arclength.shape[1])
        search_gaps(threads, rows, engine.rods, engine.surfaces, world, near, n_found, work)
        return world, near, n_found

    def linear(self, acting: Acting, warm: Flags) -> ModalLinear:
        """Return the linear response of the last shape, contact forces held."""
        self._take(acting)
        rows = np.flatnonzero(warm)
        points = self._points(rows, acting)
        self.modal.place_points(*points, acting.ports.extension)
        return ModalLinear(self.modal, rows, acting.ports, points)

    def _points(self, rows: Ints, acting: Acting) -> tuple[Floats, Floats]:
        """Point forces: those that are given, then the contacts of these robots."""
        contacts = self.engine.contact_set
        arclength, force = acting.points
        most = -(-int(contacts.used[rows].max(initial=0)) // _ROOM) * _ROOM
        there = np.arange(most) < contacts.used[:, None]
        every = contacts.contact[:, :most]
        s = np.where(there, every["arclength"], 0.0)
        f = np.where(there[:, :, None], every["force"], 0.0)
        given = arclength.shape[1]
        if given:
            s = np.concatenate([np.broadcast_to(arclength, (self.n_robots, given)), s], axis=1)
            f = np.concatenate([np.broadcast_to(force, (self.n_robots, given, 3)), f], axis=1)
        return s, f


def _rows_of(motion: ModalMotion, rows: Ints) -> ModalMotion:
    return ModalMotion(*(a[rows] for a in motion))


def _put(motion: ModalMotion, then: ModalMotion, rows: Ints) -> None:
    for array, old in zip(motion, then, strict=True):
        array[rows] = old[rows]


def _put_rows(motion: ModalMotion, then: ModalMotion, every: Ints, rows: Ints) -> None:
    """`then` holds the robots `every`, of which `rows` go back to it."""
    for array, old in zip(motion, then, strict=True):
        array[rows] = old[np.isin(every, rows)]


def _contacts_of(engine: Engine, rows: Ints) -> tuple[Ints, Any]:
    return engine.contact_set.used[rows].copy(), engine.contact_set.contact[rows].copy()


def _put_contacts(engine: Engine, then: tuple[Ints, Any], every: Ints, rows: Ints) -> None:
    some = np.isin(every, rows)
    engine.contact_set.used[rows], engine.contact_set.contact[rows] = then[0][some], then[1][some]
