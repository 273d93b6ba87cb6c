"""`RobotBatch`: a batch of robots with its inputs, effects and last state, whichever way the rods are solved.

`Simulator` is this with options that are checked, the inputs' names, contact and queries.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from fastrod.effects.pipeline import EffectPipeline
from fastrod.errors import InputError, Problem, ProblemSentence, RobotError, shown
from fastrod.model.compile import compile_robots
from fastrod.model.robot import Robot
from fastrod.solver.boundary import check_size
from fastrod.solver.inputs import Inputs, Reader, robot_mask
from fastrod.solver.merge import (
    keep_lost,
    merge_arrays,
    merge_problems,
    merge_rows,
    merge_shape,
    replace_arrays,
    replace_rows,
    restore_contact,
)
from fastrod.solver.protocol import Acting, Last, Solved, Solver
from fastrod.solver.recovery import sentence_of
from fastrod.solver.state import MOVING, Snapshot, State, check_snapshot
from fastrod.types import Flags, Floats, Ints, Params, Ports, RodShape

if TYPE_CHECKING:
    from fastrod.contact.engine import Engine

_ALONG = (
    "position",
    "rotation",
    "curvature",
    "arclength",
    "moment",
    "force",
    "tension",
    "path_length",
    "base_wrench",
)
_BALANCE = 40  # rounds of `settle` in which a rod and a force that goes by its tip come to rest
_UNSTABLE = "the shape that balances its loads is an unstable one"


class RobotBatch:
    """Robots of one layout, from one call to the next."""

    _rods: Solver
    """Solver of the rods; set by `Simulator`."""

    def __init__(
        self,
        robots: tuple[Robot, ...],
        n_robots: int,
        dt: float,
        n_steps: int,
        outputs: Literal["full", "tip"],
    ) -> None:
        self.robots, self.n_robots, self.dt, self.outputs = robots, n_robots, dt, outputs
        self._layout, self._plain, rest = compile_robots(robots, n_steps)
        check_size(self._layout, n_robots, outputs)
        self._params = self._plain  # what the kernel reads; _plain is the robot before effects
        self._reader = Reader(self._layout, self._plain, rest, n_robots)
        self._chain = EffectPipeline(robots, n_robots)
        self._bare: Ports | None = None  # the last ports before effects
        self._all = np.arange(n_robots)
        self._warm = np.zeros(n_robots, bool)
        self._shaped = np.zeros(n_robots, bool)  # whose state holds a solved shape, of this very robot
        self._ports: Ports | None = None
        self._given = Inputs()
        self._state: State | None = None
        self._derived: Floats | None = None  # the Jacobian that came with the last step
        self._engine: Engine | None = None  # of the contact scene
        self._felt: Engine | None = None  # the engine, where contact bends the rods

    @property
    def n_points(self) -> int:
        """Nodes along the whole robot."""
        return len(self._layout.first_tendon) * self._layout.n_steps + 1

    @property
    def state(self) -> State:
        """The last state. Raises `InputError` before the first step."""
        return self._last("state")[0]

    @property
    def _before(self) -> Last:
        return Last(self._warm, self._ports, self._state)

    def _acting(self, ports: Ports) -> Acting:
        return Acting(self._given, ports, self._params, self._reader.gravity, self._reader.loads)

    def _settle(self, ports: Ports, rows: Ints, tolerance: float, only: Flags | None = None) -> State:
        return self._note(self._rods.settle(rows, self._acting(ports), self._before, tolerance), rows, only)

    def settle_ports(
        self,
        ports: Ports,
        params: Params,
        tolerance: float = 1e-9,
        rows: Ints | None = None,
        robot: Robot | None = None,
    ) -> State:
        """`settle` on what the kernel reads, with effects already in it: for those who carry effects over a
        whole log themselves. `params` may have a row for each robot; `robot` has the numbers of rods of modes
        that are not among them: mass, lumps, stretch and shear. With `tolerance` inf those take one Newton
        step, exact to first order. Robots that are not in `rows` are not solved, and not `ok`."""
        if robot is not None:
            self._rods.replace((robot,))
        self._reader.problems, self._derived = {}, None
        self._params, self._bare = params, None
        self._rods.remember(ports, False, Last(self._warm, None, None))
        return self._settle(ports, self._all if rows is None else rows, tolerance)

    def reset(self, rows: ArrayLike | None = None) -> None:
        """Forget the boundary of these robots (all by default): their next step begins from the cold guess,
        their effects at rest."""
        which = slice(None) if rows is None else robot_mask(rows, self.n_robots)
        self._warm[which], self._derived = False, None
        self._chain.reset(which)

    def snapshot(self) -> Snapshot:
        """A copy of everything that a later step depends on."""
        return Snapshot(
            self.robots,
            self._rods.snapshot(),
            self._warm.copy(),
            self._given,
            self._ports,
            self._state,
            self._params,
            self._bare,
            [link.memory.copy() for link in self._chain.links],
            self._chain.time.copy(),
            None if self._engine is None else self._engine.snapshot(),
        )

    def restore(self, snapshot: Snapshot, rows: ArrayLike | None = None) -> None:
        """Go back to a `snapshot` of this simulator, or only these robots: indices or a mask. Robots that
        were replaced since keep their numbers, and take over the shape alone; a whole simulator of which some
        were replaced is refused. Raises `InputError` then, and for a snapshot of another simulator."""
        if not isinstance(snapshot, Snapshot):
            raise InputError(f"the snapshot is {shown(snapshot)}; give what Simulator.snapshot() returned.")
        memories = [link.memory for link in self._chain.links]
        self._rods.check(snapshot.memory)
        check_snapshot(snapshot, memories, self._engine is not None)
        mask = None if rows is None else robot_mask(rows, self.n_robots)
        self._shaped[slice(None) if mask is None else mask] = True
        if mask is not None and self._state is not None and self._ports is not None:
            self._restore_rows(snapshot, mask, self._state, self._ports)
            return
        if len(snapshot.robots) != len(self.robots) or any(
            a is not b for a, b in zip(snapshot.robots, self.robots, strict=True)
        ):
            raise InputError("the snapshot is of other robots; some were replaced since.")
        self._derived = None
        self._warm, self._given, self._ports = snapshot.warm.copy(), snapshot.given, snapshot.ports
        self._state, self._params, self._bare = snapshot.state, snapshot.params, snapshot.bare
        self._rods.restore(snapshot.memory, None, None, self._before)
        self._chain.time = snapshot.time.copy()
        for memory, then in zip(memories, snapshot.effects, strict=True):
            memory[:] = then
        if self._engine is not None and snapshot.contact is not None:
            self._engine.restore(snapshot.contact)

    def _restore_rows(self, snapshot: Snapshot, rows: Flags, state: State, ports: Ports) -> None:
        if snapshot.state is None or snapshot.ports is None:
            self.reset(rows)
            return
        self._warm, self._derived = np.where(rows, snapshot.warm, self._warm), None
        self._ports = merge_arrays(ports, snapshot.ports, rows)
        if self._bare is not None and snapshot.bare is not None:
            self._bare = merge_arrays(self._bare, snapshot.bare, rows)
            self._params = merge_arrays(self._params, snapshot.params, rows)
        then = Last(snapshot.warm, snapshot.ports, snapshot.state)
        self._rods.restore(snapshot.memory, rows, self._acting(self._ports), then)
        for link, memory in zip(self._chain.links, snapshot.effects, strict=True):
            link.memory[rows] = memory[rows]
        self._chain.time[rows] = snapshot.time[rows]
        if self._engine is not None and snapshot.contact is not None:
            restore_contact(self._engine, snapshot.contact, rows)
        problems = merge_problems(state.problems, snapshot.state.problems, rows)
        ok = np.where(rows, snapshot.state.ok, state.ok)
        passes = np.where(rows, snapshot.state.passes, state.passes)
        moving = {name: getattr(state, name) for name in (*MOVING, "step_error", "mean_wrench")}
        moving |= _merged(moving, snapshot.state, rows)
        self._return_state(merge_shape(state.as_shape(), snapshot.state, rows), ok, passes, problems, moving)

    def replace(self, rows: ArrayLike, robots: Sequence[Robot]) -> None:
        """Other robots in these rows (indices, one robot each): their numbers and the values of their
        effects. They begin cold, their effects at rest. Raises `RobotError` where counts, modes or effects
        differ from those here, and with effects or a contact scene where segments or tendons are elsewhere;
        `InputError` where rows and robots do not match."""
        if not isinstance(robots, (list, tuple)) or not all(isinstance(robot, Robot) for robot in robots):
            raise RobotError(f"robots is {shown(robots)}; give a list of Robot, one for each row.")
        mask = robot_mask(rows, self.n_robots)
        which = np.asarray(rows)
        if which.ndim != 1 or which.dtype.kind == "b" or len(which) != len(robots):
            raise InputError(
                f"rows has shape {which.shape} for {len(robots)} robots; give the index of each."
            )
        if not len(which):
            return
        _, params, rest = compile_robots([self.robots[0], *robots], self._layout.n_steps)
        chain = EffectPipeline([self.robots[0], *robots], len(robots) + 1)
        if self._engine is not None and not np.array_equal(
            params.length[1:], np.broadcast_to(params.length[:1], params.length[1:].shape)
        ):
            raise RobotError("a robot has segments of another length; with a contact scene these must agree.")

        self._plain = self._params = replace_arrays(self._plain, params, which, self.n_robots)
        rest = replace_arrays(self._reader.rest, rest, which, self.n_robots)
        self._reader = Reader(self._layout, self._plain, rest, self.n_robots)
        self._chain.gravity = replace_rows(self._chain.gravity, chain.gravity[1:], which, self.n_robots)
        for link, new in zip(self._chain.links, chain.links, strict=True):
            link.values[which] = new.values[1:]
        every = list(self.robots * (self.n_robots if len(self.robots) == 1 else 1))
        for i, robot in zip(which, robots, strict=True):
            every[i] = robot
        self.robots = tuple(every)
        self._rods.replace(self.robots)
        self.reset(mask)
        self._shaped[which] = False

    def _read(self, given: Inputs, only: Flags | None = None, again: bool = False) -> tuple[Ports, Ints]:
        """The ports, and the robots whose inputs are good; of those in `only`, where it is given. `again`:
        the same inputs once more, the tip now elsewhere."""
        compliance = None
        if self._chain.feels_tip:
            compliance = self._tip_compliance(in_step=not again)
        self._derived = None
        ports = self._reader.ports(given)
        self._given = given
        out = np.zeros(self.n_robots, bool) if only is None else ~only
        out[list(self._reader.problems)] = True
        some_out = bool(out.any())
        rows = np.flatnonzero(~out) if some_out else self._all
        if self._chain.links:
            bare, params = self._bare, self._params
            self._bare = ports
            ports, self._params, points = self._chain.act(
                ports,
                self._plain,
                self._state,
                self.dt,
                self._layout.n_steps,
                out,
                self._reader.gravity,
                compliance,
                again,
            )
            if points:
                ports, self._given = self._reader.with_point_forces(ports, given, points)
                out[list(self._reader.problems)] = True
                some_out = bool(out.any())
                rows = np.flatnonzero(~out)
            if only is not None and bare is not None:
                self._bare = merge_arrays(self._bare, bare, ~only)
                self._params = merge_arrays(self._params, params, ~only)
        # who is left out stays where it was, as extended as its boundary is, and its force does not move
        if some_out:
            if (then := self._ports) is None:
                kept: dict[str, Any] = {
                    "extension": 0.0,
                    "tip_force": 0.0,
                    "base_pose": self._reader.rest.base_pose,
                }
            else:
                kept = {name: getattr(then, name) for name in ("extension", "tip_force", "base_pose")}
            merged = {
                name: np.where(out[:, None], value, getattr(ports, name)) for name, value in kept.items()
            }
            ports = ports._replace(**{name: np.ascontiguousarray(a) for name, a in merged.items()})
        self._rods.remember(ports, self._chain.pulls_tip, self._before)
        return ports, rows

    def _tip_compliance(self, *, in_step: bool) -> Floats | None:
        """(n_robots, 3, 3) how the tip gives to a force, world [m/N]; None before the first state."""
        if self._state is None or self._ports is None or not self._warm.any():
            return None
        return self._rods.tip_compliance(self._acting(self._ports), self._warm, in_step=in_step)

    def _balanced(self, given: Inputs, state: State, tolerance: float, only: Flags | None) -> State:
        """The same settled again until effects that follow the rod are those of where it is."""
        for _ in range(_BALANCE):
            ports, rows = self._read(given, only, again=True)
            off = np.zeros(self.n_robots)
            off[rows] = np.where(state.ok[rows], self._chain.tip_step[rows], 0.0)
            if not (off > tolerance).any():
                return state
            state = self._settle(ports, rows, tolerance, only)
        lost = ~(off <= tolerance)
        never = "settle found no balance of the rod with an effect that depends on its tip or its tension"
        problems = {int(i): ProblemSentence(f"{never}.", Problem.NOT_CONVERGED) for i in np.flatnonzero(lost)}
        self._state = replace(state, ok=state.ok & ~lost, problems=dict(state.problems) | problems)
        return self._state

    def _linear(self, ports: Ports) -> Any:
        """The linear response of the last state."""
        return self._rods.response(self._acting(ports), self._warm)

    def _relocated(self, extension: Floats) -> dict[str, Floats]:
        """The loads at other extensions: point forces stay at their arclength, so nodes and samples move over
        the material."""
        grid, node_force = self._reader.point_forces(self._given.point_force, extension)
        line_force = self._reader.line_force(self._given.line_force, grid)
        if self._bare is not None and self._ports is not None:  # and what effects have added to it
            bare = self._reader.line_force(self._given.line_force, self._ports.grid)
            line_force = line_force + (self._ports.line_force - bare)
        return {"grid": grid, "node_force": node_force, "line_force": line_force}

    def _move_obstacles(self, moved: tuple[Any, Any] | None) -> None:
        if self._engine is not None and moved is not None:
            if self._felt is None:
                self._engine.poses_before = self._engine.poses
            self._engine.move(*moved, self.dt)

    def _note(self, solved: Solved, rows: Ints, only: Flags | None = None) -> State:
        """Note who is not ok, so that nothing continues on NaN, and hand out the state. Robots that are lost
        keep the shape before: what a pass wrote of them is none of theirs."""
        shape, ok, ports, self._derived = solved.shape, solved.ok, solved.ports, solved.jacobian
        passes = solved.passes if only is None else np.where(only, solved.passes, 0)
        moving = dict(solved.moving)
        if moving and self._state is not None and not ok.all():
            moving |= _merged(moving, self._state, ~ok)
        for i, why in solved.problems.items():
            self._reader.problems.setdefault(i, why)
        problems = dict(self._reader.problems)
        lost = rows[~ok[rows]] if solved.lost is None else solved.lost
        acting = self._acting(ports)
        if len(fallen := self._rods.unstable(acting, shape, np.flatnonzero(ok))):
            ok, passes, self._derived = ok.copy(), np.array(passes), None
            ok[fallen], passes[fallen] = False, -1
            lost = np.union1d(lost, fallen)
            for i in map(int, fallen):
                problems[i] = sentence_of(_UNSTABLE, Problem.OVERLOADED, self._params, ports, shape, i)
        for i in map(int, np.flatnonzero(~ok)):
            if i not in problems:
                problems[i] = sentence_of(solved.reason, solved.kind, self._params, ports, shape, i)
        if len(lost):
            last = None if self._state is None or self._ports is None else (self._state, self._ports)
            shape, ports = keep_lost(shape, ports, np.isin(self._all, lost), self._shaped, last)
        self._shaped |= ok
        # no pass touched these: they keep the boundary they had
        if self._reader.problems or only is not None:
            unread = np.zeros(self.n_robots, bool) if only is None else ~only
            unread[list(self._reader.problems)] = True
            self._warm = np.where(unread, self._warm, ok)
        else:
            self._warm = ok.copy()
        before = self._state
        if only is not None and before is None:
            never = ProblemSentence("left out before its first step.", Problem.NEVER_SOLVED)
            problems |= {int(i): never for i in np.flatnonzero(~only)}
        elif only is not None and before is not None:
            problems = merge_problems(problems, before.problems, ~only)
            shape = merge_shape(shape, before, ~only)
            ok, passes = np.where(only, ok, before.ok), np.where(only, passes, before.passes)
            if self._ports is not None:
                ports = merge_arrays(ports, self._ports, ~only)
        self._ports = ports
        if solved.held is not None:  # they stand where they came to, and go on from there
            self._warm[solved.held] = True
        return self._return_state(shape, ok, passes, problems, moving)

    def _return_state(
        self, shape: RodShape, ok: Flags, passes: Ints, problems: dict[int, str], moving: Mapping[str, Any]
    ) -> State:
        contacts = None if self._felt is None else self._felt.contacts(shape, ok)
        if self._engine is not None and self._felt is None:
            self._engine.before = shape
        if self.outputs == "tip":  # contact needs the whole rod, the caller did not ask for it
            shape = shape._replace(**{name: getattr(shape, name)[:0] for name in _ALONG})
        self._state = State(
            **shape._asdict(), ok=ok, passes=passes, problems=problems, contacts=contacts, **moving
        )
        return self._state

    def _last(self, what: str) -> tuple[State, Ports]:
        if self._state is None or self._ports is None:
            raise InputError(f"{what} needs a state; call step or settle first.")
        return self._state, self._ports


def _merged(moving: Mapping[str, Any], then: State, rows: Flags) -> dict[str, Any]:
    """Fields of rods in motion, with `rows` as in another state."""
    if then.velocity is None:
        return {}
    pairs = {name: (moving[name], getattr(then, name)) for name in MOVING}
    return {name: b if a is None else merge_rows(a, b, rows) for name, (a, b) in pairs.items()}
