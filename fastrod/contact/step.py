"""One step of robots that may touch something: free ones by their own pass, the others by passes and the
contact law in turn until at rest, cold ones from nothing.

Inputs that move a world too far for one linear model are followed by fractions, from the last step to this
one (load continuation): a world that does not come to rest, or a rod that would go through an obstacle, goes
half as far. A rod never continues beyond what it could solve: it stays where it came to, and says so.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from fastrod.contact.engine import Engine, starts_of
from fastrod.contact.frames import blended, longest_move
from fastrod.contact.trouble import NO_CONTACT_LEFT, NO_NODE_LEFT
from fastrod.kernels.contact.iteration import AT_REST, BACK, GOES_ON, INSIDE, LOST, MOVES, UNSOLVED
from fastrod.kernels.contact_batch import iterate_contact
from fastrod.types import ContactMotion, ContactRows, Flags, Floats, Ints, PointLoads, Ports, RodShape

_CLOSER = 0.8  # of the smallest distance to rest so far: what counts as closer
# The damping to begin with. Every second try begins with the most and eases more slowly: with it 49 of 248
# steps of perf/contact_scenes.py were left unsolved, 66 without (passes without forces refused in both).
_DAMPING = 1.5
_EASES = 0.7  # of the damping, after a pass that left the robot about as far from rest as the last
_STIFFENS = 2.5  # of the damping, after one that left it much farther
_GROWN = 1.6  # of the last distance: a little more than what easing alone brings, 1 / 0.7
_LEAST, _MOST = 1e-4, 6.0  # of the damping
_REFUSED = 4.0  # of the damping, after a pass that was taken back


class Progress:
    """Distance of robots from rest, iteration by iteration."""

    def __init__(self, n: int) -> None:
        self.nearest = np.full(n, np.inf)
        """(n_robots,) the least distance from rest so far [m]."""
        self.idle = np.zeros(n, np.int64)
        """(n_robots,) passes since a robot came closer."""

    def note(self, rows: Ints, far: Floats) -> None:
        """Note how `far` these robots are from rest now [m]."""
        closer = far < _CLOSER * self.nearest[rows]
        self.idle[rows] = np.where(closer, 0, self.idle[rows] + 1)
        self.nearest[rows] = np.where(closer, far, self.nearest[rows])


class Damping:
    """The damping of an iteration that goes downhill (after Levenberg 1944 and Marquardt 1963).

    It eases with every pass after which a robot is about as far from rest as before, or nearer, and stiffens
    with one after which it is much farther, or which has to be taken back.
    """

    def __init__(self, amount: Floats, rows: Ints, tries: Ints) -> None:
        """`amount` (n_robots,) is `ContactMotion.damping` and written to; `rows` begin; `tries` (n_robots,)
        counts from 1."""
        first = tries % 2 == 1
        self.amount, self.eases = amount, np.where(first, _EASES, np.sqrt(_EASES))
        self.refused = np.zeros(len(amount), np.int64)
        """(n_robots,) passes that were taken back."""
        self._last = np.full(len(amount), np.inf)
        amount[rows] = np.where(first[rows], _DAMPING, _MOST)

    def note(self, rows: Ints, far: Floats) -> None:
        """These robots went on, and are so `far` from rest now [m]."""
        eased = np.maximum(self.eases[rows] * self.amount[rows], _LEAST)
        stiffer = np.minimum(_STIFFENS * self.amount[rows], _MOST)
        self.amount[rows] = np.where(far < _GROWN * self._last[rows], eased, stiffer)
        self._last[rows] = far

    def refuse(self, rows: Ints) -> None:
        """The last pass of these robots was taken back."""
        self.amount[rows] *= _REFUSED
        self.refused[rows] += 1


COLD_ITERATIONS = 2000
"""Iterations of a robot that begins from nothing: its whole load, where a step brings a fraction."""
_BLOCK = 2048  # robots whose linear models are held at once: 40 MB with 16 contacts each
_MOST_ITERATIONS = 16  # and more for a robot that comes closer to rest
_NEARLY = 1e-4  # of the length
_LONGEST = 4  # times the usual number of iterations, and no more
_IDLE = 6  # iterations in a row that came no closer to rest: it goes in circles
_MOST_INSIDE = 8  # iterations in a row with the centreline inside of an obstacle: the step was too long
_SMALLEST_FRACTION = 1.0 / 64.0
# of the inputs: below it a failure is taken for the loss of the equilibrium, not for too long a step
_HARD = 1.0 / 4.0
# perf/contact_scenes.py, 28 robots that failed: 60 damped passes left 110 steps unsolved, 150 left 79, 400
# left 74 at 3.4 times the cost
_MOST_DAMPED, _DAMPED_TRIES = 150, 10
_MOST_REFUSED = 12  # damped passes that were taken back
_WANDERS = 1e-2  # of the length: a robot that moves by less goes around a place where it may come to rest
# iterations in a row without forces that obey the law: the hold is lost, and plain ones do not bring it back
_UNSOLVED = 6
_CURVE = ("position", "rotation", "curvature", "arclength")  # what contact reads of the shapes before


class ContactSolver(Protocol):
    """Interface of the rods' solver that contact needs; `fastrod.solver.contact_solver` is the one that
    there is."""

    @property
    def x(self) -> Floats:
        """(n_robots, n_x) boundary unknowns: contact changes them, and puts back what it does not keep."""
        ...

    @property
    def used(self) -> Ints:
        """(n_robots,) passes that each robot has taken in this step."""
        ...

    def run_free(self, rows: Ints, ports: Ports, into: RodShape, *, settle: bool = False) -> Flags:
        """A step without contact, or with `settle` from the cold guess until at rest; (n_robots,) which of
        these rows are well."""
        ...

    def run_loaded(self, rows: Ints, ports: Ports, into: RodShape, loads: PointLoads) -> None:
        """One pass with these point loads, and how contact points and unknowns move with them; the boundary
        stays as it is."""
        ...


@dataclass(frozen=True, kw_only=True)
class ContactStep:
    """Bring robots to the inputs `end`, in `shape`."""

    engine: Engine
    solver: ContactSolver
    shape: RodShape
    end: Ports
    tolerance: float
    """Tolerance of motion, residual and violation at rest [m]."""
    most: int
    """Passes of a warm robot, about: a step ends."""

    def run(self, rows: Ints, warm: Flags, start: Ports | None, unloaded: Ports) -> tuple[Flags, Floats]:
        """Bring `rows` from the inputs `start` of the last step; (n_robots,) which robots are well, and the
        fraction that each came.

        `unloaded` are the inputs of the straight robots: a cold robot that would overlap something begins
        there, if it is clear there; else it is pushed out of where it is. Without a last step there is no
        slip, and so no friction.
        """
        engine, solver, n = self.engine, self.solver, len(warm)
        cold = engine.whole_worlds(np.isin(np.arange(n), rows) & ~warm)
        engine.forget(cold)
        engine.place_at_once(cold)
        ok, done = np.zeros(n, bool), np.ones(n)
        pressed = engine.pressed()
        x = solver.x.copy()
        warm_free, cold_rows = rows[~cold[rows] & ~pressed[rows]], rows[cold[rows]]
        if len(warm_free):
            ok |= solver.run_free(warm_free, self.end, self.shape)
            done[warm_free[~ok[warm_free]]] = 0.0
        if len(cold_rows):
            ok |= solver.run_free(cold_rows, self.end, self.shape, settle=True)
        overlap = engine.overlap(rows[ok[rows]], self.shape)
        held = rows[(pressed[rows] | overlap[rows]) & ~cold[rows]]
        if len(held):
            solver.x[held] = x[held]
            ok[held] = False
            arrived, came = self._continue(held, start, self.most)
            ok |= arrived
            done[held] = came[held]
        new = cold_rows[overlap[cold_rows] | ~ok[cold_rows]]
        if len(new):
            ok[new] = False
            done[new] = self._begin(new, unloaded)[new]
            ok[new] = done[new] >= 1.0
        engine.slides[:], engine.continued[:] = True, False
        engine.continued[held], engine.continued[new] = True, True
        engine.accept(rows[ok[rows]], self.shape)
        engine.end_step(done)
        return ok, done

    def _begin(self, rows: Ints, unloaded: Ports) -> Floats:
        """Cold robots that would overlap something: continued from their straight shape, or pushed out; the
        fraction that each came."""
        engine, solver = self.engine, self.solver
        x = solver.x.copy()
        free_shape = RodShape(*(a.copy() for a in self.shape))
        straight = solver.run_free(rows, unloaded, self.shape, settle=True)
        clear = straight & ~engine.overlap(rows[straight[rows]], self.shape)
        engine.slides[rows] = False
        done = np.zeros(len(clear))
        if len(able := rows[clear[rows]]):
            engine.accept(able, self.shape, between_steps=True)
            done = self._continue(able, unloaded, COLD_ITERATIONS)[1]
        if len(stuck := rows[~clear[rows]]):
            solver.x[stuck] = x[stuck]
            for now, then in zip(self.shape, free_shape, strict=True):
                now[stuck] = then[stuck]
            done[stuck] = self._continue(stuck, None, COLD_ITERATIONS)[1][stuck]
        return done

    def _continue(self, rows: Ints, start: Ports | None, most: int) -> tuple[Flags, Floats]:
        """Lead the worlds of `rows` from the inputs `start`, where they are at rest, or settle them at the
        end at once, in about `most` passes.

        (n_robots,) which arrived, and the fraction that each came. Those that did not keep the last shape,
        boundary and contacts in which they were at rest.
        """
        engine, solver, n = self.engine, self.solver, len(self.engine.tracked)
        done, length, arrived = np.zeros(n), np.ones(n), np.zeros(n, bool)
        contacts = engine.contact_set
        x, used, contact = solver.x.copy(), contacts.used.copy(), contacts.contact.copy()
        left, begun, tries = rows, solver.used.copy(), np.zeros(n, np.int64)
        trouble = np.zeros_like(engine.trouble)  # of the last try that failed
        moved = np.broadcast_to(longest_move(engine.poses_before, engine.poses, engine.surfaces.sphere), n)
        aim = np.ones(n)
        while len(left):
            last, aim = aim, np.minimum(done + length, 1.0)
            # what was clear of the obstacles was so where they were in the try before
            elsewhere = left[(aim != last)[left]]
            engine.clearance.distance[elsewhere] -= moved[elsewhere, None]
            ports = self.end if start is None or (aim[left] >= 1.0).all() else blended(start, self.end, aim)
            motion = engine.motion(self.shape, self.tolerance, done, aim)
            rest, unheld = self._settle(left, ports, motion)
            wanders = (engine.trouble["cause"] == MOVES) & (
                engine.trouble["distance"] < _WANDERS * engine.rods.length
            )
            given_up = (length <= _HARD) | unheld | engine.whole_worlds(wanders)
            hard = left[(~rest & given_up & (tries < _DAMPED_TRIES))[left]]
            if len(hard):  # no equilibrium near: let it go to the next one, downhill
                tries[hard] += 1
                solver.x[hard], contacts.used[hard], contacts.contact[hard] = (
                    x[hard],
                    used[hard],
                    contact[hard],
                )
                damped = engine.motion(self.shape, self.tolerance, done, aim)
                rest |= self._descend(hard, ports, damped, tries)
            good, bad = left[rest[left]], left[~rest[left]]
            trouble[bad] = engine.trouble[bad]
            done[good] = aim[good]
            arrived[good] = done[good] >= 1.0
            if len(halfway := good[~arrived[good]]):
                engine.accept(halfway, self.shape, between_steps=True)
            x[good], used[good], contact[good] = solver.x[good], contacts.used[good], contacts.contact[good]
            solver.x[bad], contacts.used[bad], contacts.contact[bad] = x[bad], used[bad], contact[bad]
            length[good] *= 2.0
            length[bad] *= 0.5
            if start is None:
                break
            spent = solver.used[left] - begun[left]
            left = left[~arrived[left] & (length[left] >= _SMALLEST_FRACTION) & (spent < most)]
        engine.trouble[rows] = trouble[rows]
        short = rows[~arrived[rows]]
        engine.clearance.distance[short] -= moved[short, None]
        lost = rows[~arrived[rows] & engine.tracked[rows]]
        if len(lost) and engine.before is not None:
            for now, then in zip(self.shape, engine.before, strict=True):
                now[lost] = then[lost]
        return arrived, done

    def _settle(self, rows: Ints, ports: Ports, motion: ContactMotion) -> tuple[Flags, Flags]:
        """Pass and law in turn on these inputs; (n_robots,) which came to rest, and which were given up as no
        forces hold them."""
        engine, trouble, rods = self.engine, self.engine.trouble, self.engine.rods
        rest = np.zeros(len(trouble), bool)
        unsolved, inside = (np.zeros(len(rest), np.int64) for _ in range(2))
        progress, still = Progress(len(rest)), rows
        for count in range(_LONGEST * _MOST_ITERATIONS):
            status = self._iterate_all(still, ports, motion)
            rest[still[status == AT_REST]] = True
            unsolved[still] = np.where(trouble["cause"][still] == UNSOLVED, unsolved[still] + 1, 0)
            deep = engine.tracked[still] & (
                engine.clearance.gap[still] < -rods.radius[still].max(1) - _NEARLY * rods.length[still]
            )
            inside[still] = np.where(deep, inside[still] + 1, 0)
            hopeless = (inside >= _MOST_INSIDE) | (unsolved >= _UNSOLVED)
            progress.note(still, trouble["from_rest"][still])
            if count >= _MOST_ITERATIONS - 1:  # go on with what comes closer to rest
                hopeless |= progress.idle >= _IDLE
            still = still[(status != AT_REST) & (status != LOST) & ~engine.whole_worlds(hopeless)[still]]
            if not len(still):
                break
        self._count_contacts(rows[~rest[rows]], ports)
        return rest, unsolved >= _UNSOLVED

    def _descend(self, rows: Ints, ports: Ports, motion: ContactMotion, tries: Ints) -> Flags:
        """The same where no equilibrium is near, damped: down in energy to one, in iterations that go through
        nothing.

        (n_robots,) which came to rest. One that goes through something, or finds no forces, is taken back.
        `tries` (n_robots,) counts this one.
        """
        engine, solver, contacts = self.engine, self.solver, self.engine.contact_set
        trouble, n = engine.trouble, len(engine.tracked)
        rest, still = np.zeros(n, bool), rows
        progress, damping = Progress(n), Damping(motion.damping, rows, tries)
        frames = np.broadcast_to(motion.frames, (n, *motion.frames.shape[1:]))
        frames_before = _copy_of(rows, np.broadcast_to(motion.frames_before, frames.shape))
        before = {name: _copy_of(rows, getattr(motion, f"{name}_before")) for name in _CURVE}
        motion = motion._replace(
            frames_before=frames_before, **{f"{name}_before": a for name, a in before.items()}
        )
        x, used, contact = (_copy_of(rows, a) for a in (solver.x, contacts.used, contacts.contact))
        for count in range(_LONGEST * _MOST_DAMPED):
            here = solver.x[still].copy(), contacts.used[still].copy(), contacts.contact[still].copy()
            status = self._iterate_all(still, ports, motion)
            rest[still[status == AT_REST]] = True
            away, on = still[status == BACK], still[status != BACK]
            solver.x[away], contacts.used[away], contacts.contact[away] = x[away], used[away], contact[away]
            x[on], used[on], contact[on] = (a[status != BACK] for a in here)
            for name, last in before.items():
                last[on] = getattr(self.shape, name)[on]
            frames_before[on] = frames[on]
            progress.note(on, trouble["from_rest"][on])
            damping.note(on, trouble["from_rest"][on])
            damping.refuse(away)
            hopeless = damping.refused >= _MOST_REFUSED
            hopeless[away] |= used[away] == 0  # what touches nothing is not damped
            if count >= _MOST_DAMPED - 1:
                hopeless |= progress.idle >= 2 * _IDLE
            still = still[(status != AT_REST) & (status != LOST) & ~engine.whole_worlds(hopeless)[still]]
            if not len(still):
                break
        self._count_contacts(rows[~rest[rows]], ports)
        return rest

    def _iterate_all(self, rows: Ints, ports: Ports, motion: ContactMotion) -> Ints:
        """One pass and one round of the law for the worlds of `rows`; their status."""
        status = np.zeros(len(rows), np.int64)
        for block, n_loads in self._blocks(rows):
            status[block] = self._iterate(rows[block], n_loads, ports, motion)
        return status

    def _blocks(self, rows: Ints) -> Iterator[tuple[Ints, int]]:
        """Rows of worlds that are solved together, and the contacts that each has room for: worlds with as
        many contacts go together."""
        engine = self.engine
        most = np.zeros(engine.world.max() + 1, np.int64)
        np.maximum.at(most, engine.world[rows], engine.contact_set.used[rows])
        room = np.minimum(
            2 ** np.ceil(np.log2(np.maximum(most[engine.world[rows]], 1))).astype(np.int64),
            engine.scene.max_contacts,
        )
        if len(rows) <= _BLOCK and (room == room[0]).all():
            yield np.argsort(engine.world[rows], kind="stable"), int(room[0])
            return
        for n_loads in np.unique(room):
            members = np.flatnonzero(room == n_loads)
            members = members[np.argsort(engine.world[rows[members]], kind="stable")]
            starts = starts_of(engine.world[rows[members]])[:-1]
            cuts = np.unique(np.searchsorted(starts, np.arange(_BLOCK, len(members), _BLOCK)))
            for block in np.split(members, starts[cuts[cuts < len(starts)]]):
                yield block, int(n_loads)

    def _iterate(self, rows: Ints, n_loads: int, ports: Ports, motion: ContactMotion) -> Ints:
        """One pass and one round of the law for these rows, world by world; their status."""
        engine, n, n_x = self.engine, len(rows), self.solver.x.shape[1]
        loads = empty_loads(n, n_loads, n_x)
        self.solver.run_loaded(rows, engine.arranged(rows, ports, loads), self.shape, loads)
        start = starts_of(engine.world[rows])
        threads = engine.thread_count(len(start) - 1)
        contacts = engine.contact_set
        problem, search = engine.workspace(threads, int(np.diff(start).max()), n_loads, n_x)
        used, contact = contacts.used[rows], contacts.contact[rows, :n_loads]
        homeless = (loads.node < 0) & (np.arange(n_loads) < used[:, None])
        status = np.zeros(n, np.int64)
        each = ContactRows(start, rows, status, engine.trouble, self.solver.x)
        iterate_contact(threads, each, engine.rods, engine.surfaces, motion, contacts, loads, problem, search)
        for r in np.flatnonzero(homeless.any(1)):  # more contacts than nodes: one without has not been felt
            c = contact[r, homeless[r].argmax()]
            far = engine.trouble["from_rest"][rows[r]]
            engine.trouble[rows[r]] = NO_NODE_LEFT, c.obstacle, c.arclength, 0.0, far
            status[r] = LOST if status[r] == LOST else GOES_ON
        return status

    def _count_contacts(self, rows: Ints, ports: Ports) -> None:
        """Say of robots that stay inside of something whether they lack contacts, or nodes to put them on."""
        engine, contacts = self.engine, self.engine.contact_set
        for i in rows[engine.trouble["cause"][rows] == INSIDE]:
            ends = np.cumsum(
                engine.length[i if len(engine.length) > 1 else 0]
                + ports.extension[i if len(ports.extension) > 1 else 0]
            )
            used = contacts.contact["arclength"][i, : contacts.used[i]]
            here = np.searchsorted(ends[:-1], engine.trouble["arclength"][i], side="right")
            if (np.searchsorted(ends[:-1], used, side="right") == here).sum() >= engine.rods.n_steps - 1:
                engine.trouble["cause"][i] = NO_NODE_LEFT
            elif len(used) >= contacts.contact.shape[1]:
                engine.trouble["cause"][i] = NO_CONTACT_LEFT


def _copy_of(rows: Ints, a: Any) -> Any:
    """A C-ordered array like `a` that holds these rows of it; the others are never read, nor written."""
    copy = np.empty(a.shape, a.dtype)
    copy[rows] = a[rows]
    return copy


def empty_loads(n_rows: int, n_loads: int, n_x: int) -> PointLoads:
    """Room for the contact points of a pass."""
    n = 3 * n_loads
    return PointLoads(
        np.full((n_rows, n_loads), -1),
        np.zeros((n_rows, n_loads, 3)),
        np.zeros((n_rows, n_loads, 3)),
        np.zeros((n_rows, n, 1 + n)),
        np.zeros((n_rows, n_x, 1 + n)),
    )
