"""`Tape`: how the tip's motion changes with inputs and with the robots' numbers, forward and adjoint.

Every balance g(q, r~, q~, input) = 0 that the simulator solved gives, linearised at its solution,
dq = - H^-1 (dg/dr~ dr~ + dg/dq~ dq~ + dg/dinput dinput), and the scheme the motion after it (`balances_of`).
Forward columns follow the steps in order; the adjoint goes through them backward (Cao, Li, Petzold and Serban
2003, for steps instead of a differential equation). Derivatives of g by inputs and numbers at fixed
unknowns are central differences, of which the error is that of rounding for all that enters linearly.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from fastrod.errors import InputError, RobotError, nearest
from fastrod.kernels.rod.modal.derivatives import AFTER_JUMP, ModalDerivatives, scheme_table
from fastrod.kernels.rod.modal.motion import BDF1, GENERALIZED_ALPHA, NODE_VECTORS, REST, ModalMotion
from fastrod.model.compile import compile_robots
from fastrod.model.robot import Robot
from fastrod.solver.inputs import Reader
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
        stiffness(found, ports.tip_moment)[rows],
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


_STEP = 2e-5  # of a length, a force or a number, for central differences


class Tips(NamedTuple):
    """Motion of the tip after every call, or what changes with it."""

    position: Floats
    """(n_calls, n_robots, 3) world [m]."""
    rotation: Floats | None = None
    """(n_calls, n_robots, 3, 3) world_from_material."""
    velocity: Floats | None = None
    """(n_calls, n_robots, 3) world [m/s]."""


Cost: TypeAlias = Callable[[Tips], tuple[ArrayLike, Tips]]
"""Tips -> the cost of every robot (n_robots,), and its derivatives by the tips' numbers, in arrays of their
shapes; None where it does not depend on them."""


class Gradient(NamedTuple):
    """Derivatives of every robot's cost."""

    value: Floats
    """(n_robots,)"""
    inputs: dict[str, Floats]
    """By each input of each call: (n_calls, n_robots, ...)."""
    parameters: dict[str, Floats]
    """(n_robots,) by each number of the robot."""


class Tape:
    """Calls of a simulator of modes, and how their outcome changes.

    With effects, inputs are those behind them: what the rod receives.
    """

    def __init__(self, robots: Sequence[Robot], modal: ModalSolver, first: int) -> None:
        """`robots` one or n_robots; `first` is the scheme by which robots at rest begin to move."""
        self.robots, self._modal, self._first = tuple(robots), modal, first
        self._calls: list[list[Event]] = []
        self._place: list[Floats] = []
        self._velocity: list[Floats] = []
        self.broken: str | None = None
        """Why there are no derivatives."""
        last = NODE_VECTORS * len(modal.pieces.segment) * len(modal.basis.node)
        self._tip = slice(last - NODE_VECTORS, last)

    def add(self, events: list[Event], motion: ModalMotion) -> None:
        """A call, and the motion after it."""
        self._calls.append(events)
        self._place.append(motion.place[:, self._tip].copy())
        self._velocity.append(motion.velocity[:, self._tip].copy())

    def tips(self) -> Tips:
        """Return what the simulator found. Raises `InputError` before the first call."""
        self._check()
        return _as_tips(np.stack(self._place), np.stack(self._velocity))

    def forward(self, parameters: Sequence[str] = (), **directions: ArrayLike) -> Tips:
        """Derivatives of the tips, with one axis more at their end: by each of these numbers of the robots
        ("segment.1.line_density"), then along each direction, by how much an input of every call changes:
        (n_calls, n_robots or 1, ...) as `step` takes it. Raises `InputError` for a name that there is not, a
        wrong shape, and before the first call."""
        self._check()
        n, n_calls, m = self._modal.n_robots, len(self._calls), len(parameters) + len(directions)
        inputs = [Input(self._modal, name) for name in directions]
        along = [one.along(given, n_calls, n) for one, given in zip(inputs, directions.values(), strict=True)]
        twins = [Twin(self.robots, self._modal, name) for name in parameters]
        q = np.zeros((3, *self._modal.motion.q.shape, m))
        place = np.zeros((4, *self._modal.motion.place.shape, m))
        found = []
        for k, events in enumerate(self._calls):
            for event in events:
                for balance in balances_of(self._modal, event, self._first):
                    changes = [twin.change(event, balance) for twin in twins]
                    changes += [
                        one.change(self._modal, event, balance, steps[k])
                        for one, steps in zip(inputs, along, strict=True)
                    ]
                    _propagate(balance, q, place, changes)
            found.append(place[:2, :, self._tip].copy())
        moved = np.stack(found)
        return _as_tips(moved[:, 0], moved[:, 1])

    def adjoint(self, cost: Cost, parameters: Sequence[str] = (), inputs: Sequence[str] = ()) -> Gradient:
        """Derivatives of a cost of the tips' motion by these inputs of every call, and by these numbers of
        the robots ("segment.1.line_density"), from one walk back through the calls. Raises `InputError` for a
        name that there is not, derivatives of a wrong shape, and before the first call."""
        modal, n = self._modal, self._modal.n_robots
        value, by_place, by_velocity = self._cost(cost)
        ports = [Input(modal, name) for name in inputs]
        twins = [Twin(self.robots, modal, name) for name in parameters]
        by_input = {one.name: np.zeros((len(self._calls), n, one.size)) for one in ports}
        by_number = {name: np.zeros(n) for name in parameters}
        q, place = np.zeros((3, *modal.motion.q.shape)), np.zeros((4, *modal.motion.place.shape))
        for k in reversed(range(len(self._calls))):
            place[0, :, self._tip] += by_place[k]
            place[1, :, self._tip] += by_velocity[k]
            for event in reversed(self._calls[k]):
                for balance in reversed(balances_of(modal, event, self._first)):
                    work, moved = _propagate_back(balance, q, place)
                    for one in ports:
                        for c, step in enumerate(np.eye(one.size)):
                            by = one.change(modal, event, balance, np.broadcast_to(step, (n, one.size)))
                            by_input[one.name][k, balance.rows, c] += _worked(by, work, moved)
                    for twin in twins:
                        by_number[twin.name][balance.rows] += _worked(
                            twin.change(event, balance), work, moved
                        )
        return Gradient(value, by_input, by_number)

    def _cost(self, cost: Cost) -> tuple[Floats, Floats, Floats]:
        """The value, and its derivatives by what has inertia at the tip and by its velocity."""
        tips = self.tips()
        given, by = cost(tips)
        value = np.asarray(given, dtype=np.float64)
        if value.shape != (self._modal.n_robots,):
            raise InputError(
                f"cost returned a value of shape {value.shape}; give one number a robot, "
                f"({self._modal.n_robots},)."
            )
        found = []
        for name, known in tips._asdict().items():
            array = np.zeros(known.shape) if getattr(by, name) is None else np.asarray(getattr(by, name))
            if array.shape != known.shape:
                raise InputError(
                    f"cost returned derivatives by {name} of shape {array.shape}; give {known.shape}."
                )
            if not np.isfinite(array).all():
                raise InputError(f"cost returned derivatives by {name} that are no numbers.")
            found.append(array)
        position, rotation, velocity = found
        directors = np.swapaxes(rotation, 2, 3).reshape(*rotation.shape[:2], 9)
        rest = np.zeros((*velocity.shape[:2], NODE_VECTORS - 3))
        return value, np.concatenate([position, directors], 2), np.concatenate([velocity, rest], 2)

    def _check(self) -> None:
        if self.broken is not None:
            raise InputError(self.broken)
        if not self._calls:
            raise InputError("nothing is recorded; call settle or step after record().")


class Input:
    """An input of every call, as the port that it is of the kernels."""

    ports: ClassVar[dict[str, str]] = {
        "tendon_length": "tendon_length",
        "tension": "tension",
        "tip_force": "tip_force",
        "tip_moment": "tip_moment",
        "follower_tip_force": "follower_force",
        "line_force": "line_force",
        "follower_line_force": "follower_line",
    }

    def __init__(self, modal: ModalSolver, name: str) -> None:
        """Raises `InputError` for an input by which there are no derivatives."""
        if name not in self.ports:
            raise InputError(f"there is no derivative by an input {name!r}; {nearest(name, self.ports)}")
        length = float(np.max(modal.params.rod_length))
        force, moment = float(np.max(modal.params.tension_scale)), float(np.max(modal.params.moment_scale))
        units = {"tendon_length": length, "tip_moment": moment, "line_force": force / length}
        units["follower_line_force"] = force / length
        self.name, self._delta = name, _STEP * units.get(name, force)
        self.size = len(modal.layout.tendon_segment) if name.startswith("ten") else 3

    def along(self, given: ArrayLike, n_calls: int, n_robots: int) -> Floats:
        """(n_calls, n_robots, size) of a direction. Raises `InputError` for a wrong shape."""
        array = np.asarray(given, dtype=np.float64)
        shape = (n_calls, n_robots, self.size)
        if array.ndim != 3 or array.shape not in (shape, (n_calls, 1, self.size)):
            raise InputError(f"the direction {self.name} has shape {array.shape}; give {shape}.")
        return np.broadcast_to(array, shape)

    def change(self, modal: ModalSolver, event: Event, balance: Balance, step: Floats) -> Change:
        """Change of the balance g and of the inertial states per change of this input, (n_robots, size)."""
        port = self.ports[self.name]
        now = getattr(event.acting.ports, port)
        if not len(now):
            raise InputError(f"{self.name} was not given; give it, zero if need be, to derive by it.")
        if not step.any():
            return None
        add = self._delta * (step[:, None, None, :] if "line" in port else step)
        sides = [
            at_solution(modal, balance, event.acting.ports._replace(**{port: now + sign * add}))
            for sign in (1.0, -1.0)
        ]
        return _difference(sides, balance.rows, 2.0 * self._delta)


class Twin:
    """The robots with another value of one number, larger and smaller."""

    def __init__(self, robots: Sequence[Robot], modal: ModalSolver, name: str) -> None:
        """Raises `InputError` where the robots have no such number."""
        if any(robot.effects for robot in robots):
            raise InputError(
                "derivatives by a robot's numbers are of robots without effects; leave the effects out."
            )
        self.name, self._sides, self._delta = name, [], 0.0
        largest = max(abs(number(robot, name)) for robot in robots)
        delta = _STEP * (largest or 1.0)
        ends = [delta, -delta]
        try:
            for robot in robots:
                with_number(robot, name, number(robot, name) - delta)
        except RobotError:  # it may not become smaller
            ends[1] = 0.0
        self._delta = ends[0] - ends[1]
        for end in ends:
            moved = [with_number(robot, name, number(robot, name) + end) for robot in robots]
            layout, params, rest = compile_robots(moved, modal.layout.n_steps)
            reader = Reader(layout, params, rest, modal.n_robots)
            solver = ModalSolver(moved, layout, params, modal.n_robots, 1, modal.modes)
            self._sides.append((reader, solver))

    def change(self, event: Event, balance: Balance) -> Change:
        """Change of the balance g and of the inertial states per change of the number."""
        found = []
        for reader, modal in self._sides:
            ports = reader.ports(event.acting.given)
            modal.place_points(reader.loads, ports.extension)
            gravity = modal.gravity if reader.gravity is None else reader.gravity
            modal.pieces = modal.pieces._replace(gravity=gravity)
            found.append(at_solution(modal, balance, ports))
        return _difference(found, balance.rows, self._delta)


Change: TypeAlias = "tuple[Floats, Floats] | None"
"""(n_rows, n_q) of g and (n_rows, n) of what has inertia, both at fixed unknowns; None for none."""


def _difference(sides: list[ModalDerivatives], rows: Ints, apart: float) -> Change:
    ahead, behind = sides
    by_q: Floats = (ahead.gradient[rows] - behind.gradient[rows]) / np.float64(apart)
    moved: Floats = (ahead.number[rows] - behind.number[rows]) / np.float64(apart)
    return by_q, moved


def _propagate(balance: Balance, q: Floats, place: Floats, changes: list[Change]) -> None:
    """Columns q (3, n_robots, n_q, m) and place (4, n_robots, n, m) through a balance; inputs change it by
    `changes`."""
    rows = balance.rows
    before, was = q[:, rows], place[:, rows]
    counted = balance.by_place[:, :, None] * np.tensordot(balance.counted, was, 1)
    rate = np.tensordot(balance.rate, before, 1)
    right = -np.swapaxes(balance.change, 1, 2) @ counted - balance.by_rate @ rate
    shift = np.zeros_like(counted)
    for j, change in enumerate(changes):
        if change is not None:
            right[:, :, j] += change[0]
            shift[:, :, j] = change[1]
    new = -np.linalg.solve(balance.hessian, right)
    moved = balance.change @ new + shift
    m = balance.moved
    place[:, rows] = np.tensordot(m[:, :4], was, 1) + m[:, 4, None, None, None] * moved
    q[:, rows] = np.tensordot(m[:3, :3], before, 1) + m[:3, 4, None, None, None] * new


def _propagate_back(balance: Balance, q: Floats, place: Floats) -> tuple[Floats, Floats]:
    """Derivatives of the cost by q (3, n_robots, n_q) and place (4, n_robots, n), from after a balance to
    before it; those by g (n_rows, n_q), and by what has inertia (n_rows, n) at fixed unknowns."""
    rows, m = balance.rows, balance.moved
    after, was = q[:, rows], place[:, rows]
    moved: Floats = np.tensordot(m[:, 4], was, 1)
    by_q = np.tensordot(m[:3, 4], after, 1) + (moved[:, None] @ balance.change)[:, 0]
    work: Floats = np.asarray(
        np.linalg.solve(np.swapaxes(balance.hessian, 1, 2), by_q[:, :, None]), dtype=np.float64
    )
    by_place = balance.by_place * (balance.change @ work)[:, :, 0]
    by_rate = (np.swapaxes(balance.by_rate, 1, 2) @ work)[:, :, 0]
    place[:, rows] = np.tensordot(m[:, :4].T, was, 1) + balance.counted[:, None, None] * by_place
    q[:, rows] = np.tensordot(m[:3, :3].T, after, 1) + balance.rate[:, None, None] * by_rate
    return -work[:, :, 0], moved


def _worked(change: Change, work: Floats, moved: Floats) -> Floats:
    """(n_rows,) derivative of the cost by what changes g and what has inertia so."""
    if change is None:
        return np.zeros(len(work))
    return np.asarray((change[0] * work).sum(1) + (change[1] * moved).sum(1))


def _as_tips(place: Floats, velocity: Floats) -> Tips:
    """Return the numbers of the last node (n_calls, n_robots, 12, ...) as tips."""
    directors = place[:, :, 3:].reshape(*place.shape[:2], 3, 3, *place.shape[3:])
    return Tips(place[:, :, :3], np.swapaxes(directors, 2, 3), velocity[:, :, :3])


_LISTS = {"segment": "segments", "lump": "lumps"}


def number(robot: Robot, name: str) -> float:
    """The value. Raises `InputError` where this is no number of the robot."""
    at: Any = robot
    for step, _ in _steps(robot, name):
        at = at[step] if isinstance(step, int) else getattr(at, step)
    return float(at)


def with_number(robot: Robot, name: str, value: float) -> Robot:
    """The robot with another value there. Raises `InputError` as `number`, `RobotError` where the value
    cannot be."""
    return _replaced(robot, [step for step, _ in _steps(robot, name)], value)  # type: ignore[no-any-return]


def _replaced(at: Any, steps: list[Any], value: float) -> Any:
    if not steps:
        return value
    first, *rest = steps
    if isinstance(first, int):
        return (*at[:first], _replaced(at[first], rest, value), *at[first + 1 :])
    return dataclasses.replace(at, **{first: _replaced(getattr(at, first), rest, value)})


def _steps(robot: Robot, name: str) -> list[tuple[Any, Any]]:
    """Attributes and indices that lead to the number, each with what stands there."""
    words, found = name.split("."), []
    at: Any = robot
    if words[0] == "tendon" and len(words) > 1:
        k = _index(words[1], robot.n_tendons, "tendon", name)
        for s, segment in enumerate(robot.segments):
            if k < len(segment.tendons):
                words = ["segment", str(s + 1), "tendons", str(k + 1), *words[2:]]
                break
            k -= len(segment.tendons)
    for word in words:
        if isinstance(at, tuple):
            step: Any = _index(word, len(at), "entry", name)
            at = at[step]
        else:
            step = _LISTS.get(word, word)
            known = [field.name for field in dataclasses.fields(at)] if dataclasses.is_dataclass(at) else []
            if step not in known:
                raise InputError(f"the robot has no number {name!r}: {word!r}; {nearest(word, known)}")
            at = getattr(at, step)
        found.append((step, at))
    if isinstance(at, bool) or not isinstance(at, (int, float)):
        more = f"; name one of its entries, {name}.1" if isinstance(at, tuple) and at else ""
        raise InputError(f"{name!r} is no number of the robot{more}.")
    return found


def _index(word: str, count: int, what: str, name: str) -> int:
    if not word.isdigit() or not 1 <= int(word) <= count:
        raise InputError(f"{name!r}: {word!r} is no {what} of {count}; they are counted from 1.")
    return int(word) - 1
