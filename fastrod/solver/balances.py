"""Record of a simulator of modes, call by call, and of every balance that it solved as a linear map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fastrod.errors import InputError
from fastrod.kernels.rod.modal.derivatives import AFTER_JUMP, ModalDerivatives, scheme_table
from fastrod.kernels.rod.modal.motion import BDF1, GENERALIZED_ALPHA, REST, ModalMotion
from fastrod.solver.modal import ModalSolver, Step
from fastrod.solver.modal_response import full_newton, stiffness
from fastrod.solver.protocol import Acting
from fastrod.types import Floats, Ints, Ports


def copied_acting(modal: ModalSolver, acting: Acting) -> Acting:
    """All that acts now, in arrays of its own; the gravity that the robots have where none was given."""
    return acting._replace(
        ports=acting.ports._replace(**{k: np.array(a, order="C") for k, a in acting.ports._asdict().items()}),
        params=acting.params._replace(
            **{k: np.array(a, order="C") for k, a in acting.params._asdict().items()}
        ),
        gravity=np.array(modal.pieces.gravity),
        points=(np.array(acting.points[0]), np.array(acting.points[1])),
    )


class Event(NamedTuple):
    """Robots that were brought to rest, or moved on by one step."""

    rows: Ints
    jumped: bool
    """Their accelerations were measured first."""
    step: Step
    """Its scheme is REST where they were brought to rest."""
    acting: Acting
    before: ModalMotion
    """Snapshot of all robots, before it."""
    q: Floats
    """(n_robots, n_q) after it."""


class Balance(NamedTuple):
    """A solved balance g(q) = 0 of some robots, and what its solution does to their motion."""

    kind: int
    """REST, AFTER_JUMP or the scheme of a step."""
    rows: Ints
    how: Step
    jump: Floats
    """(n_robots,)"""
    motion: ModalMotion
    """Motion of all robots from which it counts."""
    q: Floats
    """(n_robots, n_q) its solution."""
    hessian: Floats
    """(n_rows, n_q, n_q) derivative of g."""
    change: Floats
    """(n_rows, n, n_q) of what has inertia, by q."""
    by_place: Floats
    """(n_rows, n) alpha times inertia: dg / dr~ = - change^T of it."""
    by_rate: Floats
    """(n_rows, n_q, n_q) - dg / dq~."""
    counted: Floats
    """(4,) as `scheme_table`, and the two that follow."""
    rate: Floats
    """(3,)"""
    moved: Floats
    """(4, 5)"""


def balances_of(modal: ModalSolver, event: Event, first: int) -> list[Balance]:
    """One, or two where inputs jumped. `first` is the scheme by which robots at rest begin to move. `modal`
    is left with what acts in the event. Raises `InputError` where Newton's method does not end."""
    modal.take(event.acting)
    if event.step.scheme == REST:
        return [_balance(modal, event, REST, event.before, event.q, first)]
    motion, balances = event.before, []
    if event.jumped:
        soon = _balance(modal, event, AFTER_JUMP, motion, motion.q + event.step.dt * motion.rate, first)
        balances.append(soon)
        motion = _accelerated(modal, event, soon)
    return [*balances, _balance(modal, event, event.step.scheme, motion, event.q, first)]


def _balance(
    modal: ModalSolver, event: Event, kind: int, motion: ModalMotion, start: Floats, first: int
) -> Balance:
    rows, ports = event.rows, event.acting.ports
    jump = np.full(modal.n_robots, float(event.jumped and kind != AFTER_JUMP))
    how = event.step._replace(scheme=kind)
    step = None if kind == REST else (motion, how, jump)
    wanted = ("hessian", "number") if kind == REST else ("hessian", "number", "damping")
    q, ended = full_newton(modal, rows, ports, start, wanted, step)
    if not ended.all():
        raise InputError("a step of this trajectory is not solved; take a smaller dt, or more passes.")
    found = modal.derive(rows, ports, q, wanted=wanted, step=step)
    alpha, counted, rate, moved = tables(kind, event, first)
    return Balance(
        kind,
        rows,
        how,
        jump,
        motion,
        q,
        stiffness(found)[rows],
        found.number_change[rows],
        alpha * found.inertia[rows],
        found.damping[rows] if kind != REST else np.zeros_like(found.hessian[rows]),
        counted,
        rate,
        moved,
    )


def tables(kind: int, event: Event, first: int) -> tuple[float, Floats, Floats, Floats]:
    """alpha, and the linear maps of a balance (`scheme_table`); `moved` also after a rest, and of
    accelerations."""
    counted, rate, moved, dt = np.zeros(4), np.zeros(3), np.zeros((4, 5)), event.step.dt
    if kind == REST:
        moved[0, 4], moved[2, 4] = 1.0, 0.0 if first == GENERALIZED_ALPHA else 1.0
        return 0.0, counted, rate, moved
    if kind == AFTER_JUMP:
        alpha = scheme_table(BDF1, dt, event.step.rho, counted, rate, moved)
        moved[:2] = np.eye(5)[:2]
        moved[2:] = np.array([-1.0, -dt, 0.0, 0.0, 1.0]) / dt**2
        return alpha, counted, rate, moved
    scheme = GENERALIZED_ALPHA if event.jumped else kind
    alpha = scheme_table(scheme, dt, event.step.rho, counted, rate, moved)
    if kind != GENERALIZED_ALPHA:
        moved[2:] = np.eye(5)[:2]
    return alpha, counted, rate, moved


def _accelerated(modal: ModalSolver, event: Event, soon: Balance) -> ModalMotion:
    """The motion with the accelerations after a jump."""
    motion, rows, dt = ModalMotion(*(a.copy() for a in event.before)), event.rows, event.step.dt
    number = at_solution(modal, soon, event.acting.ports).number
    gone = motion.place[rows] + dt * motion.velocity[rows]
    acceleration = (number[rows] - gone) / dt**2
    motion.place_other[rows], motion.velocity_other[rows] = acceleration, acceleration
    motion.q_other[rows] = (soon.q[rows] - motion.q[rows] - dt * motion.rate[rows]) / dt**2
    return motion


def at_solution(modal: ModalSolver, balance: Balance, ports: Ports) -> ModalDerivatives:
    """Gradient and numbers of a balance's robots at its solution, as these robots, under these ports."""
    step = None if balance.kind == REST else (balance.motion, balance.how, balance.jump)
    return modal.derive(balance.rows, ports, balance.q, wanted=("number",), step=step)
