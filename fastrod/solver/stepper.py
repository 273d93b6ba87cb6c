"""`TimeStepper`: robots of modes brought to rest or moved on by dt, in shorter steps where one does not
end."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fastrod.contact.frames import blended
from fastrod.kernels.rod.modal.motion import BDF1, BDF2, GENERALIZED_ALPHA, REST, ModalMotion
from fastrod.kernels.rod.modal.output import MotionShape
from fastrod.rotation import displaced
from fastrod.solver.modal import ModalSolver, Step
from fastrod.solver.modal_response import full_newton
from fastrod.solver.settle import unloaded
from fastrod.types import Flags, Floats, Ints, Ports, RodShape

_JUMP = 2.0
"""A change of an input of more than so many times the one before is a jump: the acceleration after it is then
measured first. A corner counts as one too, which costs a step and some of the second order
(`Modal.jumps`)."""
_ROUNDING = 1e-12  # of a robot's input: it rests where it changes by so little
_MOVING = (
    "tendon_length",
    "tension",
    "extension",
    "tip_force",
    "tip_moment",
    "follower_force",
    "follower_line",
    "line_force",
    "node_force",
    "base_pose",
)
_RECORDED = 6  # Newton steps at least, of a step that is recorded
_HALVINGS = 5  # of a step whose Newton's method does not end
_FRACTIONS = np.linspace(0.125, 1.0, 8)  # of the load, where a robot does not come to rest at once


class PassShapes(NamedTuple):
    """Shapes that a pass writes."""

    shape: RodShape
    motion: MotionShape


Note = Callable[[Ints, Ports, Step, bool, ModalMotion], None]
"""Robots, their inputs, the step (REST: brought to rest), whether inputs had jumped, the motion before it."""


class TimeStepper:
    """Robots of modes in time. `time` is the step of dt; `change` (n_robots,) by how much each input changed
    at the last one, where they may have jumped (`sudden`)."""

    def __init__(self, modal: ModalSolver, time: Step, sudden: bool = True) -> None:
        self.modal, self.time, self.sudden = modal, time, sudden
        self.change: dict[str, Floats] = {}
        self.note: Note | None = None
        """Is called with what was solved; steps then go on until Newton's method ends."""
        self.divided = False
        """A step was taken in shorter ones."""
        self.begun = np.zeros(modal.n_robots, bool)
        """(n_robots,) who were set in motion since the last step: their accelerations are measured first."""

    def rest(self, rows: Ints, cold: Ints, ports: Ports, found: PassShapes, tolerance: float) -> Flags:
        """(n_rows,) who came to rest: from where they are, `cold` ones from straight, then under loads that
        grow from none to all."""
        modal, scheme = self.modal, self.time.scheme
        modal.start_straight(cold)
        ok = modal.settle(rows, ports, *found, tolerance, scheme)
        if len(lost := rows[~ok]):
            modal.start_straight(lost)
            straight, arrived = unloaded(ports, modal.layout, modal.params), np.ones(len(lost), bool)
            for fraction in _FRACTIONS:
                some = blended(straight, ports, np.full(modal.n_robots, fraction))
                arrived = modal.settle(lost, some, *found, tolerance, scheme)
                if len(ports.follower_line) and len(stray := lost[~arrived]):
                    q, ended = full_newton(modal, stray, some, modal.motion.q)
                    modal.motion.q[stray[ended]] = q[stray[ended]]
                    arrived[~arrived] = modal.settle(stray, some, *found, tolerance, scheme)
            ok[~ok] = arrived
        for name, last in self.change.items():  # who is brought to rest has no change to go on from
            self.change[name] = np.array(last)
            self.change[name][rows] = 0.0
        if self.note is not None:
            self.note(rows[ok], ports, self.time._replace(scheme=REST), False, modal.motion)
        return ok

    def advance(self, rows: Ints, inputs: tuple[Ports, Ports], jump: Floats, found: PassShapes) -> Flags:
        """(n_rows,) who moved on by dt: in one step, or where Newton's method does not end in shorter ones
        along which the inputs change evenly, from those before to those now. `jump` (n_robots,): `jumps`."""
        modal, how, note = self.modal, self.time, self.note
        jumped = rows[jump[rows] > 0.0]
        kept = _rows_of(modal.motion, jumped)
        if note is not None:
            how = how._replace(passes=max(how.passes, _RECORDED))
            start = copied(modal.motion)
        ok = modal.step(rows, inputs[1], *found, how, jump)
        if note is not None:
            for some, sudden in ((jump[rows] > 0.0, True), (jump[rows] <= 0.0, False)):
                note(rows[ok & some], inputs[1], how, sudden, start)
        self.divided = not ok.all()
        for halving in range(1, _HALVINGS + 1):
            if not len(lost := rows[~ok]):
                break
            for array, then in zip(modal.motion, kept, strict=True):
                again = np.isin(jumped, lost)
                array[jumped[again]] = then[again]
            ok[~ok] = self._advance_in(2**halving, lost, inputs, np.ones(modal.n_robots), found)
        return ok

    def _advance_in(
        self, n: int, rows: Ints, inputs: tuple[Ports, Ports], jump: Floats, found: PassShapes
    ) -> Flags:
        """(n_rows,) who moved on by dt in n steps, before the first of which inputs may `jump`; the others
        are as they were."""
        modal, scheme = self.modal, self.time.scheme
        start = copied(modal.motion)
        # BDF2 would need a step of the same length before
        one = GENERALIZED_ALPHA if scheme == BDF2 else scheme
        how, ok = self.time._replace(scheme=one, dt=self.time.dt / n), np.ones(len(rows), bool)
        host, mean = modal.host, np.zeros_like(modal.host.wrench)
        modal.host = body = host._replace(wrench=mean.copy(), moved=mean.copy())
        # displacement of the bases from where they would be alone, and how much of it one step adds
        aside, step = mean.copy(), mean.copy()
        before = modal.motion.place[:, :3].copy()
        for k in range(n):
            if not ok.any():
                break
            some = blended(*inputs, np.full(modal.n_robots, (k + 1) / n))
            if len(mean):  # a body goes on at the speed that the rod has given it
                aside += step
                some = some._replace(base_pose=displaced(some.base_pose, aside))
            arm = modal.motion.place[:, :3] - before
            ok[ok] = modal.step(rows[ok], some, *found, how, jump if k == 0 else np.zeros_like(jump))
            if len(mean):
                step += body.moved
                aside += body.moved
                mean += body.wrench / n
                mean[:, 3:] += np.cross(arm, body.wrench[:, :3]) / n
        modal.host = host
        if len(mean):
            host.wrench[rows[ok]], host.moved[rows[ok]] = mean[rows[ok]], aside[rows[ok]]
        put(modal.motion, start, rows[~ok])
        if scheme != GENERALIZED_ALPHA:
            came_from(modal.motion, start, rows[ok])
        return ok

    def errors(
        self,
        rows: Ints,
        inputs: tuple[Ports, Ports],
        jump: Floats,
        start: ModalMotion,
        tip: Floats,
        found: PassShapes,
    ) -> Floats:
        """(n_robots,) by how much the last step from `start`, which ended at `tip` (n_robots, 3), is off at
        the tip [m], from where two halves of it end (Hairer, Norsett and Wanner 1993, II.4); nan but for
        `rows`. `found` is room for a shape."""
        motion, scheme, answer = self.modal.motion, self.time.scheme, np.full(len(tip), np.nan)
        ended = copied(motion)
        put(motion, start, rows)
        ok = self._advance_in(2, rows, inputs, np.ones_like(jump) if scheme == BDF2 else jump, found)
        put(motion, ended, rows)
        apart = np.linalg.norm(tip[rows] - found.shape.tip_position[rows], axis=1)
        # two halves leave half the error of the first order, a quarter of that of the second
        left = {BDF1: 0.5, GENERALIZED_ALPHA: 0.25}.get(scheme, 0.0)
        answer[rows[ok]] = apart[ok] / (1.0 - left)
        return answer

    def jumps(self, before: Ports, ports: Ports) -> Floats:
        """(n_robots,) 1 where an input changes by more than its last change was leading to."""
        n = self.modal.n_robots
        jump, change = self.begun.astype(float), {}
        self.begun[:] = False
        for name in _MOVING if self.sudden else ():
            now, then = getattr(ports, name), getattr(before, name)
            if now is then or not (len(now) or len(then)):
                continue
            if name == "base_pose" and len(self.modal.host.inertia):
                continue  # a body that gives way moves as the rod has it
            if then.shape == now.shape and (then == now).all():
                continue
            if then.shape[1:] != now.shape[1:] or not len(now) or not len(then):
                jump[:] = 1.0
                continue
            step = np.abs(now - then).reshape(max(len(now), len(then)), -1).max(1, initial=0.0)
            step[step < _ROUNDING * np.abs(now).reshape(len(now), -1).max(1)] = 0.0
            change[name] = np.broadcast_to(step, n)
            last = self.change.get(name, np.zeros(n))
            jump[(change[name] > _JUMP * last) & (change[name] > 0.0)] = 1.0
        self.change = change
        return jump


def copied(motion: ModalMotion) -> ModalMotion:
    """The same numbers in arrays of their own."""
    return ModalMotion(*(a.copy() for a in motion))


def _rows_of(motion: ModalMotion, rows: Ints) -> ModalMotion:
    return ModalMotion(*(a[rows] for a in motion))


def put(motion: ModalMotion, then: ModalMotion, rows: Ints) -> None:
    """Give these robots the motion that they had then."""
    for array, old in zip(motion, then, strict=True):
        array[rows] = old[rows]


def came_from(motion: ModalMotion, start: ModalMotion, rows: Ints) -> None:
    """BDF2 is to go on from where the whole step began, which these robots took in shorter ones."""
    motion.q_other[rows], motion.place_other[rows] = start.q[rows], start.place[rows]
    motion.velocity_other[rows] = start.velocity[rows]
