"""`Statics`: a batch of robots with its boundary, inputs, effects and last state, and one step or `settle`
of it.

`Simulator` is this with options that are checked, the inputs' names, contact and queries.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from fastrod.contact.engine import Engine
from fastrod.contact.step import empty_loads
from fastrod.effects.pipeline import EffectPipeline
from fastrod.errors import InputError, Problem, ProblemSentence, RobotError, shown
from fastrod.model.compile import compile_robots
from fastrod.model.robot import Robot
from fastrod.solver.boundary import BoundarySolver, check_size
from fastrod.solver.gpu.device import Device
from fastrod.solver.guess import cold_start
from fastrod.solver.inputs import Inputs, Reader, robot_mask
from fastrod.solver.merge import (
    keep_lost,
    merge_arrays,
    merge_problems,
    merge_shape,
    replace_arrays,
    replace_rows,
    restore_contact,
)
from fastrod.solver.recovery import Boundary, overloaded, unstable, what_to_do
from fastrod.solver.response import Linear, stretch
from fastrod.solver.settle import LOST, Pass, frozen_pass, settle
from fastrod.solver.state import Observer, Snapshot, State, check_snapshot, copied
from fastrod.types import Flags, Floats, Ints, Params, Ports, RodShape

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
DIVERGED = "the observer diverged, and no shape was found on these inputs"
_BALANCE = 40  # rounds of `settle` in which a rod and a force that goes by its tip come to rest
_UNSTABLE = "the shape that balances its loads is an unstable one"


class Statics:
    """Robots of one layout, from one step to the next."""

    def __init__(
        self,
        robots: tuple[Robot, ...],
        n_robots: int,
        dt: float,
        n_steps: int,
        *,
        outputs: Literal["full", "tip"],
        observer: Observer | None,
        threads: int,
        device: Device,
        kept_jacobian_tolerance: float,
        recover: bool,
    ) -> None:
        self.robots, self.n_robots, self.dt, self.outputs = robots, n_robots, dt, outputs
        self.observer = observer or Observer()
        self.kept_jacobian_tolerance, self.recover = kept_jacobian_tolerance, recover
        self._layout, self._plain, rest = compile_robots(robots, n_steps)
        check_size(self._layout, n_robots, outputs)
        self._passes = BoundarySolver(
            self._layout, self._plain, n_robots, threads, propagate=observer is not None, device=device
        )
        self._reader = Reader(self._layout, self._plain, rest, n_robots)
        self._chain = EffectPipeline(robots, n_robots)
        # the last ports before effects; _plain is the robot before them
        self._bare: Ports | None = None
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
        return self._passes.n_points

    @property
    def state(self) -> State:
        """The last state. Raises `InputError` before the first step."""
        return self._last("state")[0]

    def _step(self, given: Inputs, moved: tuple[Any, Any] | None, derive: bool) -> State:
        """One observer pass on these inputs; `moved` are the obstacles that no rod feels."""
        tracked = self._passes.tracks_force
        ports, rows = self._read(given)
        self._move_obstacles(moved)
        boundary = Boundary(self._passes) if self.recover else None
        before = self._ports
        learns = before is not None and not tracked and self._passes.tracks_force
        if before is not None and learns and _alike(before, ports):
            self._learn_force(rows[self._warm[rows]], before)
        if before is not None:
            stretch(self._passes, rows, ports.extension - before.extension)
        if len(cold := rows[~self._warm[rows]]):
            cold_start(cold, self._layout, self._passes.params, ports, self._passes.memory)
        linear = Linear(self._passes, rows, ports)
        if derive and self._bare is None and len(rows) == self.n_robots and linear.fits(turning=True):
            relocate = self._relocated if given.point_force else None
            process, noise = self._noise
            shape, self._derived = linear.step(relocate, True, self.outputs, process=process, noise=noise)
        else:
            shape = self._passes.new_shape(self.outputs, len(rows) < self.n_robots)
            kept = self._keeps_jacobian(learns)[rows]
            if kept.any():
                self._passes.run(rows[kept], ports, shape, predict=True, n_col=0)
            if not kept.all():
                self._observe(rows[~kept], ports, shape, predict=True)
            self._passes.collect(shape)
        ok = self._passes.finite & (shape.residual < LOST * self._passes.params.rod_length)
        passes = np.broadcast_to(np.int64(1 + learns), self.n_robots)
        if len(rows) < self.n_robots:
            read = np.isin(self._all, rows)
            ok, passes = ok & read, np.where(read, passes, 0)
        if boundary is not None and not ok[rows].all():
            lost, self._derived = rows[~ok[rows]], None
            used = boundary.recover(lost, self._warm, ports, self._into(shape))
            self._passes.collect(shape)
            ok |= (used > 0) & (shape.residual < LOST * self._passes.params.rod_length)
            passes = np.where(used < 0, -1, passes + used)
        return self._finish(ports, shape, ok, passes, DIVERGED, Problem.DIVERGED, rows[~ok[rows]])

    @property
    def _noise(self) -> tuple[float, float]:
        """Process and measurement noise of one step."""
        return self.observer.process_noise * self.dt, self.observer.measurement_noise / self.dt

    def _observe(self, rows: Ints, ports: Ports, shape: RodShape, *, predict: bool) -> None:
        """A pass of the observer, with its own gains."""
        process, noise = self._noise
        propagate = self._passes.propagate
        self._passes.run(
            rows, ports, shape, predict=predict, propagate=propagate, process=process, noise=noise
        )

    def _learn_force(self, rows: Ints, ports: Ports) -> None:
        """A pass that changes nothing but the gain, which now knows a tip force."""
        self._observe(rows, ports, self._passes.new_shape("tip", True), predict=False)

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
        self._use_numbers(robot)
        self._reader.problems, self._derived = {}, None
        self._passes.params, self._bare = params, None
        self._passes.remember(False, False, None)
        return self._settle(ports, self._all if rows is None else rows, tolerance)

    def _use_numbers(self, robot: Robot | None) -> None:
        """Take what only rods of modes read."""

    def _settle(self, ports: Ports, rows: Ints, tolerance: float, only: Flags | None = None) -> State:
        shape = self._passes.new_shape(self.outputs, len(rows) < self.n_robots)

        passes = settle(rows, self._warm, self._passes, ports, tolerance, self._into(shape))
        self._passes.collect(shape)
        if self._passes.propagate:
            self._passes.memory.covariance[rows] = 0.0
        ok = np.zeros(self.n_robots, bool)
        ok[rows] = passes[rows] > 0
        reason = f"settle did not bring the boundary residual below {tolerance:g} m"
        if not ok[rows].all() and (shape.residual[rows[~ok[rows]]] <= tolerance).any():
            reason = f"settle found no boundary that rests with a residual below {tolerance:g} m"
        return self._finish(ports, shape, ok, passes, reason, Problem.NOT_CONVERGED, rows[~ok[rows]], only)

    def _into(self, shape: RodShape) -> Pass:
        """Passes on frozen inputs that write into `shape`."""
        return frozen_pass(self._passes, shape)

    def reset(self, rows: ArrayLike | None = None) -> None:
        """Forget the boundary of these robots (all by default): their next step begins from the cold guess,
        their effects at rest."""
        which = slice(None) if rows is None else robot_mask(rows, self.n_robots)
        self._warm[which], self._derived = False, None
        self._chain.reset(which)

    def snapshot(self) -> Snapshot:
        """A copy of everything that a later step depends on."""
        effects = [link.memory.copy() for link in self._chain.links]
        return Snapshot(
            self.robots,
            copied(self._passes.peek()),
            self._warm.copy(),
            self._given,
            self._ports,
            self._state,
            self._passes.params,
            self._bare,
            effects,
            self._chain.time.copy(),
            None if self._engine is None else self._engine.snapshot(),
        )

    def restore(self, snapshot: Snapshot, rows: ArrayLike | None = None) -> None:
        """Go back to a `snapshot` of this simulator, or only these robots: indices or a mask. Robots that
        were replaced since keep their numbers, and take over the boundary alone; a whole simulator of which
        some were replaced is refused. Raises `InputError` then, and for a snapshot of another simulator."""
        memories = [link.memory for link in self._chain.links]
        n_rows = len(self._layout.row_tendon)
        check_snapshot(snapshot, self.n_robots, n_rows, memories, self._engine is not None)
        mask = None if rows is None else robot_mask(rows, self.n_robots)
        self._shaped[slice(None) if mask is None else mask] = True
        if mask is not None and self._state is not None and self._ports is not None:
            self._restore_rows(snapshot, mask, self._state, self._ports)
            return
        if len(snapshot.robots) != len(self.robots) or any(
            a is not b for a, b in zip(snapshot.robots, self.robots, strict=True)
        ):
            raise InputError("the snapshot is of other robots; some were replaced since.")
        self._passes.memory = copied(snapshot.memory)
        self._derived = None
        self._warm, self._given, self._ports = snapshot.warm.copy(), snapshot.given, snapshot.ports
        self._state, self._passes.params, self._bare = snapshot.state, snapshot.params, snapshot.bare
        self._chain.time = snapshot.time.copy()
        for memory, then in zip(memories, snapshot.effects, strict=True):
            memory[:] = then
        if self._engine is not None and snapshot.contact is not None:
            self._engine.restore(snapshot.contact)

    def _restore_rows(self, snapshot: Snapshot, rows: Flags, state: State, ports: Ports) -> None:
        if snapshot.state is None or snapshot.ports is None:
            self.reset(rows)
            return
        then = self._passes.refit(snapshot.memory, len(ports.follower_force) > 0, snapshot.ports.tip_force)
        self._passes.put(np.flatnonzero(rows), then)
        self._warm, self._derived = np.where(rows, snapshot.warm, self._warm), None
        self._ports = merge_arrays(ports, snapshot.ports, rows)
        if self._bare is not None and snapshot.bare is not None:
            self._bare = merge_arrays(self._bare, snapshot.bare, rows)
            self._passes.params = merge_arrays(self._passes.params, snapshot.params, rows)
        tracked = self._passes.tracks_force and not len(snapshot.memory.force_before)
        if self._engine is None and tracked and _alike(ports, snapshot.ports):
            # their gain knows no tip force yet, which moves by now: learned as `step` does
            self._learn_force(np.flatnonzero(rows & snapshot.warm), self._ports)
        for link, memory in zip(self._chain.links, snapshot.effects, strict=True):
            link.memory[rows] = memory[rows]
        self._chain.time[rows] = snapshot.time[rows]
        if self._engine is not None and snapshot.contact is not None:
            restore_contact(self._engine, snapshot.contact, rows)
        problems = merge_problems(state.problems, snapshot.state.problems, rows)
        ok = np.where(rows, snapshot.state.ok, state.ok)
        passes = np.where(rows, snapshot.state.passes, state.passes)
        self._return_state(merge_shape(state.as_shape(), snapshot.state, rows), ok, passes, problems)

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

        self._plain = replace_arrays(self._plain, params, which, self.n_robots)
        self._passes.params = self._plain
        rest = replace_arrays(self._reader.rest, rest, which, self.n_robots)
        self._reader = Reader(self._layout, self._plain, rest, self.n_robots)
        self._chain.gravity = replace_rows(self._chain.gravity, chain.gravity[1:], which, self.n_robots)
        for link, new in zip(self._chain.links, chain.links, strict=True):
            link.values[which] = new.values[1:]
        every = list(self.robots * (self.n_robots if len(self.robots) == 1 else 1))
        for i, robot in zip(which, robots, strict=True):
            every[i] = robot
        self.robots = tuple(every)
        self.reset(mask)
        self._shaped[which] = False

    def _read(self, given: Inputs, only: Flags | None = None, again: bool = False) -> tuple[Ports, Ints]:
        """The ports, and the robots whose inputs are good; of those in `only`, where it is given. `again`:
        the same inputs once more, the tip now elsewhere."""
        compliance = None
        if self._chain.feels_tip:
            compliance = self._tip_compliance() if again else self._step_compliance()
        self._derived = None
        ports = self._reader.ports(given)
        self._given = given
        out = np.zeros(self.n_robots, bool) if only is None else ~only
        out[list(self._reader.problems)] = True
        some_out = bool(out.any())
        rows = np.flatnonzero(~out) if some_out else self._all
        if self._chain:
            bare, params = self._bare, self._passes.params
            self._bare = ports
            ports, self._passes.params, points = self._chain.act(
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
                self._passes.params = merge_arrays(self._passes.params, params, ~only)
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
        track_force = self._passes.tracks_force or self._chain.pulls_tip or self._force_moves(ports.tip_force)
        self._passes.remember(
            len(ports.follower_force) > 0, track_force, None if self._ports is None else self._ports.tip_force
        )
        return ports, rows

    def _step_compliance(self) -> Floats | None:
        """Return how the tip gives to a force within a step."""
        return self._tip_compliance()

    def _tip_compliance(self) -> Floats | None:
        """(n_robots, 3, 3) how the tip gives to a force, world [m/N]; None before the first state."""
        if self._state is None or self._ports is None or not self._warm.any():
            return None
        kept = copied(self._passes.peek())  # a step goes on as if nobody had looked
        by_force = np.asarray(self._linear(self._ports).by_force())[:, :3]
        self._passes.memory = kept
        return by_force

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

    def _keeps_jacobian(self, learns: bool) -> Flags:
        """(n_robots,) these correct the boundary by the gain that they have."""
        if not self.kept_jacobian_tolerance or learns or self._state is None or self._passes.propagate:
            return np.zeros(self.n_robots, bool)
        return np.asarray(self._warm & (self._state.residual < self.kept_jacobian_tolerance))

    def _force_moves(self, force: Floats) -> bool:
        """The tip force of a running robot changes: from now on the gain for it is worth its three
        columns."""
        if self._ports is None or not self._warm.any():
            return False
        before = self._ports.tip_force
        same = force.shape == before.shape and np.array_equal(force, before, equal_nan=True)
        return not same and bool(
            (force != before)[self._warm if max(len(force), len(before)) > 1 else slice(None)].any()
        )

    def _linear(self, ports: Ports) -> Any:
        """The linear response of the last state."""
        rows = np.flatnonzero(self._warm)
        if self._felt is None:
            return Linear(self._passes, rows, ports)
        most = int(self._felt.contact_set.used[rows].max(initial=0))
        loads = empty_loads(len(rows), most + 1, self._passes.n_x)
        return Linear(self._passes, rows, self._felt.held(rows, ports, loads), loads)

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
            self._engine.poses_before = self._engine.poses
            self._engine.move(*moved, self.dt)

    def _sentence(self, reason: str, kind: Problem, ports: Ports, shape: RodShape, i: int) -> ProblemSentence:
        if overloaded(self._passes, ports, i):
            kind = Problem.OVERLOADED
        text = f"{reason}; residual {shape.residual[i]:.3g} m; {what_to_do(self._passes, ports, i)}."
        return ProblemSentence(text, kind)

    def _finish(
        self,
        ports: Ports,
        shape: RodShape,
        ok: Flags,
        passes: Ints,
        reason: str,
        kind: Problem,
        lost: Ints,
        only: Flags | None = None,
    ) -> State:
        """Note who is not ok, so that nothing continues on NaN, and hand out the state. What a pass wrote of
        the robots `lost` is no shape of theirs: they keep the one before."""
        problems = dict(self._reader.problems)
        solved = (
            ok if self._felt is None else ok & ~self._felt.continued
        )  # what touches something is held by it
        if len(fallen := self._unstable(ports, shape, np.flatnonzero(solved))):
            ok, passes, self._derived = ok.copy(), np.array(passes), None
            ok[fallen], passes[fallen] = False, -1
            lost = np.union1d(lost, fallen)
            problems |= {
                int(i): self._sentence(_UNSTABLE, Problem.OVERLOADED, ports, shape, int(i)) for i in fallen
            }
        for i in np.flatnonzero(~ok):
            problems.setdefault(int(i), self._sentence(reason, kind, ports, shape, int(i)))
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
        return self._return_state(shape, ok, passes, problems)

    def _unstable(self, ports: Ports, shape: RodShape, rows: Ints) -> Ints:
        """Those of `rows` whose shape balances its loads, but would not stay."""
        return unstable(self._passes, ports, shape, rows)

    def _return_state(self, shape: RodShape, ok: Flags, passes: Ints, problems: dict[int, str]) -> State:
        contacts = None if self._felt is None else self._felt.contacts(shape, ok)
        if self._engine is not None and self._felt is None:
            self._engine.before = shape
        if self.outputs == "tip":  # contact needs the whole rod, the caller did not ask for it
            shape = shape._replace(**{name: getattr(shape, name)[:0] for name in _ALONG})
        self._state = State(**shape._asdict(), ok=ok, passes=passes, problems=problems, contacts=contacts)
        return self._state

    def _last(self, what: str) -> tuple[State, Ports]:
        if self._state is None or self._ports is None:
            raise InputError(f"{what} needs a state; call step or settle first.")
        return self._state, self._ports


def _alike(one: Ports, other: Ports) -> bool:
    """Both have a follower force, or neither has."""
    return bool(len(one.follower_force)) == bool(len(other.follower_force))
