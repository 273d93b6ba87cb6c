"""`TouchingRods`: rods of modes that feel obstacles, in motion and at rest.

A step of a rod that touches is one of BDF1, by Newton's method with its contacts as a convex potential
(`kernels.contact.press`): the contacts of the shape, the rod's Hessian there, their forces. Where that does
not end, four steps of a quarter are taken for that robot alone, and so on. A rest is the end of such steps
that are held up after each; rods that never move have a mass for them that is no one's.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fastrod.contact.engine import Engine
from fastrod.contact.frames import blended, longest_move
from fastrod.errors import InputError, Problem, ProblemSentence
from fastrod.kernels.contact.candidates import MOST_FOUND
from fastrod.kernels.contact.press import RENEWED
from fastrod.kernels.contact.pressed_world import SOFT
from fastrod.kernels.contact.proximity import search_work
from fastrod.kernels.contact.rod_proximity import RodSearch
from fastrod.kernels.contact_batch import search_gaps, search_worlds
from fastrod.kernels.press_batch import end_some, point_forces, press_some, renew_some, violations
from fastrod.kernels.rod.modal.motion import BDF1, BDF2, GENERALIZED_ALPHA
from fastrod.model.robot import Robot
from fastrod.rotation import displaced, displacement, quaternion_from_matrix
from fastrod.solver.inputs import Inputs
from fastrod.solver.merge import merge_arrays
from fastrod.solver.modal import Step, in_threads, no_hosts
from fastrod.solver.modal_response import ModalLinear
from fastrod.solver.motion import ModalRods
from fastrod.solver.options import Modal, Modes
from fastrod.solver.protocol import Acting, How, Last, Solved
from fastrod.solver.recovery import FOLDS, tendon_bend
from fastrod.solver.settle import unloaded
from fastrod.solver.stepper import PassShapes, came_from, copied, put
from fastrod.types import CANDIDATE, ContactMotion, ContactSet, Flags, Floats, Ints, Ports, RodShape

# passes at most; those in which contacts follow the places where the gap is least, and at most where each
# step is shorter than so much of the one before: of a step in motion, and of one to a rest
_IN_MOTION, _TO_REST, _FALLING = (8, 2, 2), (40, 4, 16), 0.7
_STAYS = 0.02  # of an integration step: a contact that moves by less is where it was
_SWINGS = 12  # steps back in which the steps must have become half as long
_BACK_AND_FORTH, _SHORTEST = 2, 0.2  # swings after which steps are shortened, and by how much at most
_FOLLOWING, _SETTLING = 8, 20  # first parts of a rest, or of `settle`, in which they do
# slips that a step uses are updated in so many passes, and in a rest after such a step [rad], to this [m]
_RENEWING, _NEAR, _EXACTLY = 2, 1e-3, 5e-8
_STILL = 1e-6  # rad: a Newton step below it is the last one
_FARTHEST = 1e3  # rad: after a Newton step that is longer there is no next one
_KNOT = 3.0  # rad, from node to node: a rod that bends by more is none
_SAME_GAP = 1e-10  # m
_INSIDE = 1e-5  # m: as deep as a rod may be in what it touches
_DIVISIONS = 4  # of a step into four
_AT_MOUNTING = 1.001  # of the length of the mounting: what is nearer to the base presses on that
_ROOM = 4  # contacts: room is made for a multiple
AT_REST, _CREEPS = 1e-7, 2e-9  # m: of motion within one step of a rest, and below the tolerance asked for
_MOST_STEPS, _GROWS, _FALLS = 100, 16.0, 1.0 / 16.0  # to a rest, and by how much they grow, or fall
_FIRST, _RESTS, _LONGEST, _GIVEN_UP = 1e-3, 10.0, 1e4, 1e-9  # s: their lengths
_LATE, _SAME_PLACE = 1e-5, 1e-7  # rad, m: by so little a rod may change after its contacts were placed
_SOFT = 1e-7  # of the flexibility L^3 / EI of a rod: R of its rigid contacts, where that is less than `SOFT`
_SLOW = 0.03  # s: a rod with a mass for its steps to rest alone rings at 3.5 / 2 pi over it


class TouchingRods(ModalRods):
    """Rods of modes in motion, bent by what they touch. Free ones take steps of BDF2 where generalized-alpha
    was asked for: it goes on from a step of BDF1."""

    def __init__(
        self, engine: Engine, options: Modal, robots: tuple[Robot, ...], *given: Any, **named: Any
    ) -> None:
        # a force between its ends makes a kink in the curvature of a segment
        usual = Modes(4, 2)
        if robots[0].n_segments == 1:
            usual = Modes(4, 2, pieces=2) if options.dynamics else Modes(6, 4, pieces=2)
        options = replace(options, modes=options.modes or usual)
        super().__init__(options, robots, *given, **{**named, "outputs": "full"})
        self.engine = engine
        self._weigh()
        time = self.stepper.time
        if time.scheme == GENERALIZED_ALPHA:
            self.stepper.time = time._replace(scheme=BDF2)
        self._passes = np.zeros(self.n_robots, np.int64)
        # by what they touch, before they begin; in the last try, who was to go through something, and whose
        # contacts were as many as there may be
        self._blocked, self._through, self._full = np.zeros((3, self.n_robots), bool)
        self._nearest: dict[int, tuple[int, float]] = {}  # obstacle, and arclength [m]
        self._late = np.zeros(self.n_robots)  # largest step since contacts stayed where they were [rad]
        self._deep = np.zeros(self.n_robots)  # in what they touch, at the end of the last try [m]
        self._resting = False  # steps lead to a rest

    def replace(self, robots: Sequence[Robot]) -> None:
        """Take other robots of the same layout; a recording ends."""
        super().replace(robots)
        self._weigh()

    def _weigh(self) -> None:
        """Note how soft contacts of these robots are; those that only rest get a mass for the steps to it,
        such that they would ring at some Hz."""
        stiffest = [max(max(s.bending_stiffness) for s in robot.segments) for robot in self.robots]
        flexible = np.array([robot.length**3 for robot in self.robots]) / stiffest
        self._soft = np.minimum(np.full(self.n_robots, SOFT), _SOFT * flexible)
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
        if how is not None and how.estimate_error:
            raise InputError(
                "estimate_error was given with a contact scene, which does not take it; leave it out."
            )
        super().accept(given, how)

    def step(self, rows: Ints, acting: Acting, last: Last, how: How) -> Solved:
        """Move these robots on by dt, or bring them to rest."""
        engine, stepper, before = self.engine, self.stepper, last.ports
        found, cold = self.begin(acting), engine.whole_worlds(self._mask(rows) & ~last.warm)
        ok = self._rest(rows[cold[rows] | (not self.dynamics)], cold, acting, last, found, AT_REST)
        warm = rows[~cold[rows]] if self.dynamics and before is not None else rows[:0]
        self.modal.host = no_hosts() if self._host is None else self._host
        if len(warm) and before is not None:
            start, inputs = copied(self.modal.motion), (before, acting.ports)
            jump, pressed = stepper.jumps(*inputs), engine.pressed()
            free = warm[~pressed[warm]]
            if len(free):
                ok[free] = stepper.advance(free, inputs, jump, found)
                self._passes[free] = np.abs(self.modal.iterations[free])
                pressed |= engine.overlap(free[ok[free]], found.shape)
            some = warm[pressed[warm]]
            put(self.modal.motion, start, some)
            ok[some] = self._advance_pressed(some, acting, inputs, (0.0, 1.0), found)[some]
        self.modal.host = no_hosts()
        engine.accept(rows[ok[rows]], found.shape)
        return self.end(rows, ok, found, acting, last)

    def settle(self, rows: Ints, acting: Acting, last: Last, tolerance: float) -> Solved:
        """Bring these robots to rest, to `tolerance` [m] in a step of a second."""
        found, cold = self.begin(acting), self.engine.whole_worlds(self._mask(rows) & ~last.warm)
        ok = self._rest(rows, cold, acting, last, found, tolerance)
        self._errors = self._host = None
        self.engine.accept(rows[ok[rows]], found.shape)
        return self.end(rows, ok, found, acting, last)

    def begin(self, acting: Acting) -> PassShapes:
        """Let all this act on the robots; room for their shapes."""
        self._take(acting)
        self._passes[:], self._blocked[:], self._nearest = 0, False, {}
        self.engine.yielded, self._resting = None, False
        return self._room(True)

    def end(self, rows: Ints, ok: Flags, found: PassShapes, acting: Acting, last: Last) -> Solved:
        """The state, with what has stopped those that are not ok; they go on from where they were."""
        self.engine.end_step(ok.astype(float))
        solved = self._solved(rows, found, ok, self._moved_bases(acting.ports, found))
        passes, problems = np.where(ok, np.maximum(self._passes, 1), solved.passes), {}
        lost = rows[~ok[rows]]
        last_shape, folds = self.engine.before, np.zeros(self.n_robots)
        if len(lost) and last_shape is not None:
            folds = tendon_bend(last_shape.curvature, self.modal.params, self.modal.layout)
        for i in map(int, lost):
            k, s = self._nearest.get(i, (-1, 0.0))
            names, contacts = self.engine.scene.names, self.engine.contact_set
            if k < 0 and contacts.used[i]:
                k, s = contacts.contact[i, 0][["obstacle", "arclength"]]
            where = f" with {names[k]!r} at arclength {s:.3g} m" if 0 <= k < len(names) else ""
            what = f"would be {self._deep[i]:.2g} m inside" if self._deep[i] > _INSIDE else "finds no balance"
            said = f"contact{where}: in {4**_DIVISIONS} parts of the step, too, the rod {what}"
            what = "come there in smaller steps"
            if folds[i] > FOLDS:
                what = f"its curvature times a tendon's offset is {folds[i]:.2g}; at 1 it folds: bend it less"
            said, kind = f"{said}; {what}.", Problem.CONTACT_STUCK
            if 0 <= k < len(names) and s <= _AT_MOUNTING * self.engine.rods.first[i]:
                said = f"contact{where}, where the rod is mounted and cannot yield: keep it clear of there."
            if self._through[i]:
                said = f"contact{where}: the rod would go through it; take smaller steps, or go around it."
                kind = Problem.CONTACT_TUNNELLED
            if self._full[i]:
                most = f"raise ContactScene.max_contacts above {self.engine.scene.max_contacts}"
                said = f"contact{where}: the rod has no contact left; {most}."
                kind = Problem.NO_CONTACT_LEFT
            if self._blocked[i]:
                said = "contact: neither the rod's rest nor its straight shape is clear; begin where it is."
                kind = Problem.CONTACT_INSIDE
            problems[i] = ProblemSentence(said, kind)
        held = self._mask(rows) & ~ok & last.warm
        return solved._replace(passes=passes, problems=problems, kind=Problem.CONTACT_STUCK, held=held)

    def _mask(self, rows: Ints) -> Flags:
        some = np.zeros(self.n_robots, bool)
        some[rows] = True
        return some

    def _rest(
        self, rows: Ints, cold: Flags, acting: Acting, last: Last, found: PassShapes, tolerance: float
    ) -> Flags:
        """(n_robots,) who came to rest: freely, or else as `rest_pressed`."""
        engine, motion, ok = self.engine, self.modal.motion, np.zeros(self.n_robots, bool)
        if not len(rows):
            return ok
        engine.begin_anew(cold)
        start, pressed = copied(motion), engine.pressed()
        free = rows[~pressed[rows]]
        ok[free] = self.stepper.rest(free, rows[cold[rows]], acting.ports, found, min(tolerance, AT_REST))
        meets = engine.whole_worlds(pressed | (self._mask(free) & ~ok))
        meets |= engine.overlap(free[~meets[free]], found.shape)
        put(motion, start, some := rows[meets[rows]])
        ok[some] = self.rest_pressed(some, cold, acting, last, found, tolerance)[some]
        return ok

    def rest_pressed(
        self, rows: Ints, cold: Flags, acting: Acting, last: Last, found: PassShapes, tolerance: float
    ) -> Flags:
        """(n_robots,) who came to rest in steps of BDF1 that are held up after each: from where they are,
        `cold` ones from straight. Where one does not end, the next is shorter, and leads less far to the
        inputs."""
        engine, modal, n, ports = self.engine, self.modal, self.n_robots, acting.ports
        start, straight = last.ports or ports, unloaded(ports, modal.layout, modal.params)
        if len(fresh := rows[cold[rows]]):
            start = merge_arrays(start, straight, self._mask(fresh))
            clear = self._mask(fresh[self.stepper.rest(fresh, fresh, straight, found, AT_REST)])
            clear &= ~engine.whole_worlds(engine.overlap(np.flatnonzero(clear), found.shape))
            engine.accept(np.flatnonzero(clear), found.shape, between_steps=True)
            self._blocked[fresh[~clear[fresh]]] = True
        engine.slides[rows] = ~cold[rows]  # who comes from nowhere has not slipped
        if engine.before is not None:  # over all the parts of a rest, slip is that of the step
            engine.slips_from = engine.before, engine.poses_before
        ok, done, fraction, left = np.zeros(n, bool), np.zeros(n), np.ones(n), rows
        size, there, grows = np.where(cold, _FIRST, _RESTS), np.zeros(n, np.int64), np.full(n, _GROWS)
        self._resting = True
        for _ in range(_MOST_STEPS if len(left) else 0):
            aim = np.minimum(done + fraction, 1.0)
            follow = there < (_FOLLOWING if tolerance >= AT_REST else _SETTLING)
            for each, follows in itertools.product(np.unique(size[left]), (False, True)):
                some = left[(size[left] == each) & (follow[left] == follows)]
                if not len(some):
                    continue
                inputs = ports if (aim[some] >= 1.0).all() else blended(start, ports, aim)
                self._hold_up(some)
                was, how = modal.motion.place.copy(), Step(BDF1, float(each))
                well = self._one(some, acting, inputs, how, (done.copy(), aim), found, follows)
                engine.accept(np.flatnonzero(well), found.shape, between_steps=True)
                done[well] = aim[well]
                arrived = well & (done >= 1.0)
                there += arrived
                engine.place_at_once(arrived)
                self._measure_anew(np.flatnonzero(well & ~arrived))
                moved = np.abs(modal.motion.place - was).max(1) >= max(tolerance, _CREEPS)
                if tolerance >= AT_REST and not self.dynamics:
                    # a millionth of that is left, and no contact would go elsewhere
                    moved &= (self._late > _LATE) | (self._deep > _SAME_PLACE)
                ok[some] = (arrived & ~engine.whole_worlds(moved))[some] & (each >= _RESTS)
                grows[some] = np.where(well[some], grows[some], np.maximum(0.25 * grows[some], 2.0))
                by = np.where(well[some], grows[some], _FALLS)
                size[some] = np.minimum(by * each, _LONGEST)
                fraction[some] *= np.sqrt(by)
            left = left[~ok[left] & (size[left] > _GIVEN_UP)]
            left = left[self._passes[left] < engine.scene.max_iterations]
            if not len(left):
                break
        engine.slides[rows], engine.slips_from, self._resting = True, None, False
        end_some(rows[ok[rows]], engine.contact_set, True)
        self._hold_up(rows)
        return ok

    def take_over(self, rows: Ints, shape: RodShape, ports: Ports, found: PassShapes) -> None:
        """Let these robots begin from a shape that other means have found on these inputs."""
        if len(rows):
            self.modal.bend_as(rows, shape, ports)
            self.modal.settle(rows, ports, *found, np.inf, self.stepper.time.scheme)

    @property
    def _is_rigid(self) -> bool:
        """Whether nothing that the rods touch gives way."""
        surfaces, rods = self.engine.surfaces, self.engine.rods
        return not (surfaces.compliance.any() or surfaces.mobility.any() or rods.compliance > 0.0)

    def _hold_up(self, rows: Ints) -> None:
        """Take the motion of these robots from them."""
        motion = self.modal.motion
        for name in ("rate", "velocity", "velocity_other"):
            getattr(motion, name)[rows] = 0.0
        motion.q_other[rows], motion.place_other[rows] = motion.q[rows], motion.place[rows]

    # ------------------------------------------------------------ a step in contact

    def _advance_pressed(
        self,
        rows: Ints,
        acting: Acting,
        inputs: tuple[Ports, Ports],
        span: tuple[float, float],
        found: PassShapes,
    ) -> Flags:
        """(n_robots,) who of these, in whole worlds, moved on over this fraction `span` of a step, along
        which the inputs change evenly from the first to the other; the others are as they were."""
        engine, motion, n = self.engine, self.modal.motion, self.n_robots
        (first, last), ok, one = span, np.zeros(n, bool), np.ones(n)
        if not len(rows):
            return ok
        start, contacts = copied(motion), ContactSet(*(a.copy() for a in engine.contact_set))
        how = Step(BDF1, (last - first) * self.stepper.time.dt)
        ok = self._one(rows, acting, inputs[1], how, (first * one, last * one), found, True)
        engine.end_section(last - first, found.shape, ok)
        left = lost = rows[~ok[rows]]
        if not len(lost) or last - first < 1.5 * 4.0**-_DIVISIONS:
            return ok
        if engine.yielded is None and engine.surfaces.mobility.any():
            engine.yielded = np.zeros((3, n, len(engine.surfaces.mobility), 6))
        kept = None if engine.yielded is None else engine.yielded.copy()
        before, host, place = engine.before, self.modal.host, motion.place[:, :3].copy()
        aside, step, mean = (np.zeros_like(host.moved) for _ in range(3))
        stages = [inputs[0], *(blended(*inputs, 0.25 * j * one) for j in (1, 2, 3)), inputs[1]]
        for k, ends in enumerate(map(list, itertools.pairwise(stages))):
            fraction = first + (last - first) * k / 4.0, first + (last - first) * (k + 1) / 4.0
            if hosts := len(aside):  # a body goes on at the speed that the rod has given it
                arm = motion.place[:, :3] - place
                ends[0] = ends[0]._replace(base_pose=displaced(ends[0].base_pose, aside))
                aside += step
                ends[1] = ends[1]._replace(base_pose=displaced(ends[1].base_pose, aside))
            left = left[self._advance_pressed(left, acting, (ends[0], ends[1]), fraction, found)[left]]
            if hosts:
                step += host.moved
                aside += host.moved
                mean += 0.25 * host.wrench
                mean[:, 3:] += 0.25 * np.cross(arm, host.wrench[:, :3])
            self._measure_anew(left)
            if k < 3:
                engine.accept(left, found.shape, between_steps=True)
        ok[left] = True
        if len(aside):
            host.moved[left], host.wrench[left] = aside[left], mean[left]
        back = lost[~ok[lost]]
        put(motion, start, back)
        self._go_back(back, contacts)
        if engine.yielded is not None and kept is not None:
            engine.yielded[:, back] = kept[:, back]
        if before is not None and engine.before is not None:
            for array, then in zip(engine.before, before, strict=True):
                array[lost] = then[lost]
        came_from(motion, start, left)
        return ok

    def _go_back(self, rows: Ints, then: ContactSet) -> None:
        for array, old in zip(self.engine.contact_set, then, strict=True):
            array[rows] = old[rows]
        self.engine.clearance.distance[rows] = -np.inf  # a try that failed has been anywhere

    def _measure_anew(self, rows: Ints) -> None:
        """Lower what is known of the distance of these robots: the obstacles are elsewhere on their way."""
        engine = self.engine
        moved = longest_move(engine.poses_before, engine.poses, engine.surfaces.sphere)
        engine.clearance.distance[rows] -= np.broadcast_to(moved, self.n_robots)[rows, None]

    def _one(
        self,
        rows: Ints,
        acting: Acting,
        ports: Ports,
        how: Step,
        span: tuple[Floats, Floats],
        found: PassShapes,
        follow: bool,
    ) -> Flags:
        """(n_robots,) who moved on in one step: those in whose world Newton's method has ended. With `follow`
        contacts go first where the gap is least."""
        engine, modal, n, motion = self.engine, self.modal, self.n_robots, self.modal.motion
        contacts, left, n_q = engine.contact_set, rows, motion.q.shape[1]
        start, q = (
            np.concatenate([motion.q + h * motion.rate, self._bases(ports, h)], axis=1) for h in (0.0, how.dt)
        )
        length = float(np.max(modal.params.rod_length))
        unit = np.concatenate([np.full(n_q, length), np.repeat([1.0 / length, 1.0], 3)])[: q.shape[1]]
        then = ContactSet(*(a.copy() for a in contacts))
        moves = self.dynamics and not self._resting
        most, moving, longest = _IN_MOTION if moves else _TO_REST
        # parts of a step lead a body that gives way elsewhere than its engine, which takes one
        most *= 2 if moves and len(modal.host.inertia) else 1
        if not follow:
            moving = longest = 0
        # last step, the least one that halved in time, and what the last leaves to be done [rad]
        size, least, over = np.full((3, n), np.inf)
        swings, taken, relaxed = np.zeros(n, np.int64), np.zeros_like(q), np.ones(n)
        deep, ok, gone = self._deep, np.zeros(n, bool), np.zeros(n, bool)
        changed, step = np.ones(n, bool), np.zeros_like(q)
        falls, still = np.zeros((2, n), bool)
        contacts.contact["slid"][rows] = 0.0
        frames = engine.frames(*span)
        for count in range(most + 1):
            worlds = engine.in_worlds(left)
            left = worlds.robot
            world, near, n_found = self._seen(left, ports, how, q, found, frames)
            through = self._mask(left[(n_found < 0) | self._knotted(left, found.shape)])
            if count == 0 and through.any():  # at that speed it would go through: from where it is
                q[through] = start[through]
                world, near, n_found = self._seen(left, ports, how, q, found, frames)
                through = self._mask(left[n_found < 0])
            search = RodSearch(world, engine.rods, contacts, world.frames.shape[1], world.margin, _SAME_GAP)
            violations(worlds, search, engine.surfaces, near, n_found, deep)
            if self._is_rigid:  # the whole rod, and not what its candidates show
                np.maximum(deep, -engine.clearance.gap, out=deep)
            if count and not moves:  # who asks for the rest tries a shorter step
                gone |= engine.whole_worlds(through)
                self._note_nearest(left[gone[left]], near[gone[left]], n_found[gone[left]])
                left, near, n_found = left[~gone[left]], near[~gone[left]], n_found[~gone[left]]
            busy = (over >= _STILL) | changed | (deep > _INSIDE) | through
            ok |= self._mask(left) & ~engine.whole_worlds(busy & self._mask(left))
            keep = ~ok[left]
            left, near, n_found = left[keep], near[keep], np.maximum(n_found[keep], 0)
            if not len(left) or count == most:
                self._note_nearest(left, near, n_found)
                break
            if count >= moving:
                still |= engine.whole_worlds(~falls) if count < longest else True
            seen = engine.rods, engine.surfaces, world, contacts
            before = contacts.used.copy(), contacts.contact["arclength"].copy()
            self._renew(left, seen, near, n_found, still)
            if engine.rods_meet:
                for some, closer in ((left[still[left]], 0.01 * _INSIDE), (left[~still[left]], _SAME_GAP)):
                    search_worlds(engine.in_worlds(some), search._replace(closer=closer), True)
            modal.place_points(self._points(left, acting), ports.extension)
            d = modal.derive(left, ports, q, wanted=("hessian", "point"), step=(motion, how, np.zeros(n)))
            self._note_stiffness(left, d.hessian, n_q, how)
            # a body gives way within one step of its engine, however long those to a rest are
            yielding = (how.dt / self.stepper.time.dt) ** 2 if moves else 1.0
            slopes = d.hessian, d.gradient, d.point_change, d.point_rotation
            # as do contacts: a blow's force goes by the inverse of the length, and its depth would, too
            model = (*slopes, acting.points[0].shape[1], yielding, yielding * self._soft)
            renew = np.full(n, RENEWED if count < _RENEWING else np.inf)
            renew[size < (0.0 if moves else _NEAR)] = _EXACTLY
            self._press(left, (*seen, *model, renew, still, step, changed))
            # steps that go back and forth, as where a normal swings with the rod: less of each, as the last
            # two say (Irons and Tuck 1969, after Aitken)
            change = step - taken
            aitken = -relaxed * (taken * change).sum(1) / np.maximum((change**2).sum(1), 1e-300)
            relaxed = np.where(swings >= _BACK_AND_FORTH, np.clip(aitken, _SHORTEST, 1.0), 1.0)
            q[left] += relaxed[left, None] * step[left]
            last, size[left] = size[left], np.abs(unit * step[left]).max(1)
            # contraction by the last two steps (Hairer and Wanner 1996, IV.8), of contacts that stay; of a
            # rest by short ones, for long ones may go away and back
            moved = np.abs(contacts.contact["arclength"] - before[1]).max(1)
            known = (contacts.used == before[0]) & (moved <= _STAYS * engine.rods.spacing)
            falls[left] = (size[left] < _FALLING * last) & known[left]
            short = last < (np.inf if moves else _NEAR)
            by = np.where(known[left] & short, np.minimum(size[left] / np.maximum(last, 1e-300), 0.5), 0.5)
            over[left] = by / (1.0 - by) * size[left]
            self._late[left] = np.where(still[left], np.maximum(size[left], self._late[left]), 0.0)
            self._passes[left] += 1
            swings += (step * taken).sum(1) < 0.0
            swings[size < np.maximum(0.5 * least, _STILL)] = 0
            least, taken = np.where(swings == 0, np.minimum(size, least), least), step.copy()
            lost = ~(size < _FARTHEST) | (swings > _SWINGS)
            lost = engine.whole_worlds(lost & self._mask(left))
            q[lost] = start[lost]
            self._note_nearest(left[lost[left]], near[lost[left]], n_found[lost[left]])
            left = left[~lost[left]]
        if len(arrived := np.flatnonzero(ok)):
            modal.place_points(self._points(arrived, acting), ports.extension)
            # at rest what is shown has none of the inertia of the way there
            ends = how if moves else how._replace(dt=_LONGEST)
            modal.hold(arrived, ports, *found, ends, q, True)
            end_some(arrived, contacts, engine.slips_from is None)
        failed = rows[~ok[rows]]
        self._through[failed] = gone[failed]
        self._full[failed] = contacts.used[failed] == contacts.contact.shape[1]
        self._go_back(failed, then)
        modal.place_points(acting.points, ports.extension)
        return ok

    def _bases(self, ports: Ports, h: float) -> Floats:
        """(n_robots, 6, none where no base gives way) from where the bases would be without the rods to where
        these have brought them in a time h."""
        motion, n = self.modal.motion, self.n_robots
        if not len(self.modal.host.inertia):
            return np.zeros((n, 0))
        now, rate = (a[:, :12].reshape(n, 4, 3) for a in (motion.place, motion.velocity))
        turned = quaternion_from_matrix(now[:, 1:].swapaxes(1, 2))
        went = h * np.concatenate([rate[:, 0], 0.5 * np.cross(now[:, 1:], rate[:, 1:]).sum(1)], axis=1)
        ends = displaced(np.concatenate([now[:, 0], turned], axis=1), went)
        return displacement(np.broadcast_to(ports.base_pose, (n, 7)), ends)

    def _note_stiffness(self, rows: Ints, hessian: Floats, n_q: int, how: Step) -> None:
        """By how much what these rods exert falls by the motion of a base that gives way: of `hessian`
        (n_robots, n_q + 6, n_q + 6), contacts held, modes eliminated, less the inertia of the base itself."""
        host = self.modal.host
        if not len(host.inertia):
            return
        modes, base = hessian[rows, :n_q], hessian[rows, n_q:, n_q:]
        eliminated = modes[:, :, n_q:].swapaxes(1, 2) @ np.linalg.solve(modes[:, :, :n_q], modes[:, :, n_q:])
        host.stiffness[rows] = base - eliminated - host.inertia[rows] / how.dt**2
        self._mean[rows] = 1.0  # BDF1

    def _knotted(self, rows: Ints, shape: RodShape) -> Flags:
        """(n,) whose curvature its nodes no longer resolve: Newton's method has left for nowhere, where sums
        overflow and steps look small."""
        bend = np.abs(shape.curvature[rows]).max((1, 2)) * self.engine.rods.spacing[rows]
        return np.asarray(~(bend < _KNOT))

    def _note_nearest(self, rows: Ints, near: Any, n_found: Ints) -> None:
        """Note what robots without a balance were nearest to, for their sentence."""
        for i, found, n in zip(map(int, rows), near, n_found, strict=True):
            if n:
                least = found[int(np.argmin(found["gap"][: abs(n)]))]
                self._nearest[i] = int(least["obstacle"]), float(least["arclength"])

    def _on_threads(self, n: int, work: Callable[[int, int, int], None]) -> None:
        """Do `work` of so many pieces on so many threads."""
        in_threads(n, -(-n // self.engine.thread_count(n)), work)

    def _renew(self, rows: Ints, seen: Any, near: Any, n_found: Ints, still: Flags) -> None:
        """`renew_some` on threads."""
        self._on_threads(
            len(rows), lambda _, a, b: renew_some(rows[a:b], *(*seen, near[a:b], n_found[a:b], still))
        )

    def _press(self, rows: Ints, given: Any) -> None:
        """`press_some` on threads."""
        start, robot = self.engine.in_worlds(rows)[:2]
        self._on_threads(len(start) - 1, lambda _, a, b: press_some(start[a : b + 1], robot, *given))

    def _seen(
        self, rows: Ints, ports: Ports, how: Step, q: Floats, found: PassShapes, frames: Any
    ) -> tuple[ContactMotion, Any, Ints]:
        """Rods at q among the obstacles in their `frames`, candidates of these, and how many; below 0 where
        one was gone through."""
        engine = self.engine
        self.modal.hold(rows, ports, *found, how, q, False)
        world = engine.motion(found.shape, _INSIDE, frames)
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
        self.modal.place_points(points, acting.ports.extension)
        return ModalLinear(self.modal, rows, acting.ports, points)

    def _points(self, rows: Ints, acting: Acting) -> tuple[Floats, Floats, Floats]:
        """Point forces: those that are given, then the contacts of these robots, whose friction acts on the
        surface; and their moments."""
        contacts, (arclength, given) = self.engine.contact_set, acting.points
        most = -(-int(contacts.used[rows].max(initial=0)) // _ROOM) * _ROOM
        at = np.zeros((self.n_robots, arclength.shape[1] + most))
        force, moment = np.zeros((2, *at.shape, 3))
        point_forces(arclength, given, contacts, at, force, moment)
        return at, force, moment
