"""`Simulator`: many robots, one observer pass a step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from sys import float_info
from typing import Any, Literal

import numba
import numpy as np
from numpy.typing import ArrayLike

from fastrod.contact import queries
from fastrod.contact.engine import Engine
from fastrod.contact.frames import blended
from fastrod.contact.scene import ContactScene
from fastrod.contact.step import COLD_ITERATIONS, ContactStep, empty_loads
from fastrod.effects.pipeline import EffectPipeline, SensedPoses
from fastrod.errors import InputError, RobotError, refuse_masked, shown
from fastrod.kernels.rod.dense import between_nodes
from fastrod.model.compile import compile_robots
from fastrod.model.robot import Robot
from fastrod.rotation import matrix_from_quaternion
from fastrod.solver.boundary import BoundarySolver, check_size
from fastrod.solver.contact_solver import LOST, RodSolver, frozen_pass
from fastrod.solver.gpu import device as devices
from fastrod.solver.guess import cold_start
from fastrod.solver.inputs import Inputs, PointForces, Reader, named_inputs
from fastrod.solver.merge import restore_contact, taken_each, taken_shape
from fastrod.solver.recovery import Boundary, overloaded, what_to_do
from fastrod.solver.response import Linear, stretch
from fastrod.solver.settle import Pass, settle
from fastrod.solver.state import Observer, Pose, Snapshot, State
from fastrod.types import Flags, Floats, Ints, Memory, Params, Ports, RodShape

_config: Any = numba.config
_AT_REST = 1e-6  # m: contact and boundary of a step, where `settle` has a tolerance of its own
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
_DIVERGED = "the observer diverged, and no shape was found on these inputs"


class Simulator:
    """Many tendon-driven continuum robots at once.

    >>> import fastrod
    >>> robot = fastrod.load_robot("prototype")
    >>> sim = fastrod.Simulator(robot, n_robots=2)
    >>> state = sim.settle(robot.rest_tendon_length, tip_force=[[0, 0, 0], [0, 0.1, 0]])
    >>> state.ok
    array([ True,  True])
    """

    def __init__(
        self,
        robot: Robot | Sequence[Robot],
        n_robots: int | None = None,
        dt: float = 0.01,
        points_per_segment: int = 20,
        *,
        outputs: Literal["full", "tip"] = "full",
        observer: Observer | None = None,
        threads: int | None = None,
        contact: ContactScene | None = None,
        hold_gain: float = 0.0,
        feel_contact: bool = True,
        device: devices.Device = "cpu",
        recover: bool = True,
    ) -> None:
        """Compile `robot` (one for all, or a list with one each) for `n_robots` and a time step `dt` [s].

        `points_per_segment` is the number of integration steps of a segment; the shape has n_segments times
        as many nodes and one more. `outputs="tip"` keeps only tip pose, residual and ok: some 2 kB a
        five-segment robot.
        `threads` defaults to numba's; 1 is the serial twin. `contact` is what the rods may touch; without it
        they pass through everything. Without `feel_contact` they do so all the same, and the scene is for
        `clearance`, `swept_clearance` and
        `ray_cast` alone. While a robot's last residual is below `hold_gain` [m] (and it feels no contact) a
        step corrects the boundary by the gain that it has, without new sensitivities: a third of the time,
        and the observer lags by about so much. Without `recover` a robot whose pass diverges in a step is
        lost at once: a step then ends after its one pass, where the search for a shape that does not exist
        takes some thousand.

        With `device="cuda"` the passes run on an NVIDIA GPU, one thread a robot, from the same source:
        numbers agree to rounding. The memory of the observer stays there; a step sends the inputs that
        changed and brings back what `outputs` asks for, so for large batches ask for "tip". Everything else
        is done on the CPU, as are the Newton steps of `settle`. Rods that feel contact need the CPU. Raises
        `InputError` (also where there is no GPU), `RobotError`, `UnknownNameError`.
        """
        robots = (
            [robot] if isinstance(robot, Robot) else list(robot) if isinstance(robot, (list, tuple)) else []
        )
        if not robots or not all(isinstance(r, Robot) for r in robots):
            raise RobotError(
                f"robot is {shown(robot)}; give a Robot, for example "
                "fastrod.load_robot('prototype'), or a list of them."
            )
        if n_robots is None:
            n_robots = len(robots)
        if not isinstance(n_robots, (int, np.integer)) or n_robots < 1:
            raise InputError(f"n_robots is {n_robots!r}; it must be a whole number, at least 1.")
        if len(robots) not in (1, n_robots):
            raise InputError(
                f"{len(robots)} robots for n_robots {n_robots}; give one for all, or a list of n_robots."
            )
        if not isinstance(points_per_segment, (int, np.integer)) or points_per_segment < 2:
            raise InputError(
                f"points_per_segment is {points_per_segment!r}; it must be a whole number, at least 2."
            )
        _check_positive("dt", dt, "s")
        if outputs not in ("full", "tip"):
            raise InputError(f"outputs is {outputs!r}; it must be 'full' or 'tip'.")
        if observer is not None and not isinstance(observer, Observer):
            raise InputError(f"observer is {observer!r}; give fastrod.Observer(...) or None.")
        if threads is not None and (
            not isinstance(threads, int) or not 1 <= threads <= _config.NUMBA_NUM_THREADS
        ):
            raise InputError(
                f"threads is {threads!r}; it must be a whole number from 1 to "
                f"{_config.NUMBA_NUM_THREADS} here."
            )
        if not isinstance(hold_gain, (int, float, np.floating)) or not 0.0 <= hold_gain <= float_info.max:
            raise InputError(f"hold_gain is {hold_gain!r} m; it must be a number, zero or positive.")
        self.device = devices.checked(device)
        """Where the passes run."""
        if self.device == "cuda" and contact is not None and feel_contact:
            raise InputError(
                "contact was given with device 'cuda', where rods feel none; take "
                "device='cpu', or feel_contact=False."
            )
        self.hold_gain = float(hold_gain)
        self.recover = bool(recover)
        self.robots = tuple(robots)
        self.n_robots = int(n_robots)
        self.dt = float(dt)
        self.observer = observer or Observer()
        self.outputs = outputs
        self._layout, self._plain, rest = compile_robots(self.robots, int(points_per_segment))
        check_size(self._layout, int(n_robots), outputs)
        threads = threads or numba.get_num_threads()
        self._passes = BoundarySolver(
            self._layout, self._plain, self.n_robots, threads, carry=observer is not None, device=self.device
        )
        self._reader = Reader(self._layout, self._plain, rest, self.n_robots)
        self._chain = EffectPipeline(self.robots, self.n_robots)
        # the last ports before effects; _plain is the robot before them
        self._bare: Ports | None = None
        self._all = np.arange(self.n_robots)
        self._warm = np.zeros(self.n_robots, bool)
        self._shaped = np.zeros(self.n_robots, bool)  # whose state holds a solved shape, of this very robot
        self._ports: Ports | None = None
        self._given = Inputs()
        self._state: State | None = None
        self._derived: Floats | None = None  # the Jacobian that came with the last step
        if contact is not None and not isinstance(contact, ContactScene):
            raise InputError(
                f"contact is {contact!r}; give fastrod.contact.ContactScene(obstacles=[...]) or None."
            )
        self.contact: ContactScene | None = contact
        """What the rods may touch."""
        self._engine: Engine | None = None
        if contact is not None:
            rods = contact.rods(self.robots, self.n_robots, self._layout, self._plain)
            self._engine = Engine(contact, rods, self._plain.length, self.n_points, threads)
        self._felt = self._engine if feel_contact else None  # the engine, where contact bends the rods

    def __repr__(self) -> str:
        touched = "" if self.contact is None else ", ".join(self.contact.names) or "rods alone"
        contact = f", contact with {touched}" if touched else ""
        device = "" if self.device == "cpu" else f", device={self.device!r}"
        others = " and others" if any(robot is not self.robots[0] for robot in self.robots) else ""
        numbers = f"n_robots={self.n_robots}, dt={self.dt:g} s, n_points={self.n_points}"
        return f"Simulator({self.robots[0].name!r}{others}, {numbers}{contact}{device})"

    @property
    def n_points(self) -> int:
        """Nodes along the whole robot."""
        return self._passes.n_points

    @property
    def state(self) -> State:
        """The last state. Raises `InputError` before the first step."""
        return self._last("state")[0]

    @named_inputs
    def step(
        self,
        tendon_length: ArrayLike | None = None,
        *,
        tension: ArrayLike | None = None,
        extension: ArrayLike | None = None,
        tip_force: ArrayLike | None = None,
        tip_moment: ArrayLike | None = None,
        line_force: ArrayLike | None = None,
        point_force: PointForces | None = None,
        follower_tip_force: ArrayLike | None = None,
        base_pose: ArrayLike | None = None,
        gravity: ArrayLike | None = None,
        obstacle_pose: Mapping[str, ArrayLike] | None = None,
        obstacle_velocity: Mapping[str, ArrayLike] | None = None,
        derive: bool = False,
    ) -> State:
        """One observer pass: one forward integration per robot.

        Every input has shape (n_robots, ...), or without the robot axis for all. What is not given is zero,
        or the robot's own. `tendon_length` (n_tendons,) absolute, base to where the tendon ends [m];
        `tension` (n_tendons,) of tendon_tension segments [N]; `extension` (n_segments,) [m]; `tip_force` [N],
        `tip_moment` [N m], `line_force` [N/m], each (3,) world, the last also (n_segments, points, 3), linear
        between evenly spaced points, on top of the self-weight; `point_force` (arclength [m], force (3,)
        world [N]) pairs; `follower_tip_force` (3,) material frame of the tip [N]; `base_pose` (7,) position
        [m] and quaternion w x y z; `gravity` (3,) world [m/s^2], where that is another at this step than the
        robot's own.

        The state belongs to the boundary that the last pass predicts for these tendon lengths and tip forces;
        what other inputs change is corrected with the next pass, and shows as `residual`; wires that only
        grow along with an extension count as unchanged. Robots whose pass diverges are settled on these
        inputs, from where they stood, then from nothing (on a GPU from nothing at once), and `passes` counts
        what that took; the others keep every bit. When the tip force of running robots first moves, one pass
        more learns the gain for it (`passes` is 2). Raises `InputError` on a wrong shape, or where no robot's
        input is usable; a single bad row only clears that robot's `ok`.

        With a contact scene: `obstacle_pose` name -> (7,) or (n_robots, 7) position and quaternion, world;
        what is not given stays where it was. `obstacle_velocity` name -> (6,) or (n_robots, 6) linear [m/s]
        and angular [rad/s] velocity of the obstacle's origin: slip is then counted by it, and not by how the
        pose has changed. Robots that touch something take as many passes as bring contact and boundary to
        rest; `state.contacts` tells.

        `derive` says that `jacobian(turning=True)` will be asked for: a robot or two without contact and
        effects then get it from the same pass, at the shape of the state, at little cost.
        """
        given = Inputs(
            tendon_length,
            tension,
            extension,
            tip_force,
            tip_moment,
            line_force,
            point_force,
            follower_tip_force,
            base_pose,
            gravity,
        )
        if self._felt is not None:
            return self._contact_step(self._felt, given, obstacle_pose, obstacle_velocity, None)
        moved = self._moved_obstacles(obstacle_pose, obstacle_velocity)
        tracked = self._passes.tracks_force
        ports, rows = self._read(given)
        self._move_obstacles(moved)
        boundary = Boundary(self._passes) if self.recover else None
        process, noise = self.observer.process_noise * self.dt, self.observer.measurement_noise / self.dt
        before = self._ports
        learns = before is not None and not tracked and self._passes.tracks_force
        if (
            before is not None
            and learns
            and bool(len(before.follower_force)) == bool(len(ports.follower_force))
        ):
            self._passes.run(
                rows[self._warm[rows]],
                before,
                self._passes.new_shape("tip", True),
                carry=self._passes.carry,
                process=process,
                noise=noise,
            )
        if before is not None:
            stretch(self._passes, rows, ports.extension - before.extension)
        if len(cold := rows[~self._warm[rows]]):
            cold_start(cold, self._layout, self._passes.params, ports, self._passes.memory)
        linear = Linear(self._passes, rows, ports)
        if derive and self._bare is None and len(rows) == self.n_robots and linear.fits(turning=True):
            relocate = self._relocated if given.point_force else None
            shape, self._derived = linear.step(relocate, True, self.outputs, process, noise)
        else:
            shape = self._passes.new_shape(self.outputs, len(rows) < self.n_robots)
            held = self._held(learns)[rows]
            if held.any():
                self._passes.run(rows[held], ports, shape, feed=True, n_col=0)
            if not held.all():
                self._passes.run(
                    rows[~held],
                    ports,
                    shape,
                    feed=True,
                    carry=self._passes.carry,
                    process=process,
                    noise=noise,
                )
            self._passes.collect(shape)
        ok = self._passes.finite & (shape.residual < LOST * self._passes.params.reach)
        passes = np.broadcast_to(np.int64(1 + learns), self.n_robots)
        if len(rows) < self.n_robots:
            read = np.isin(self._all, rows)
            ok, passes = ok & read, np.where(read, passes, 0)
        if boundary is not None and not ok[rows].all():
            lost, self._derived = rows[~ok[rows]], None
            used = boundary.recover(lost, self._warm, ports, self._into(shape))
            self._passes.collect(shape)
            ok |= (used > 0) & (shape.residual < LOST * self._passes.params.reach)
            passes = np.where(used < 0, -1, passes + used)
        return self._finish(ports, shape, ok, passes, _DIVERGED, rows[~ok[rows]])

    @named_inputs
    def settle(
        self,
        tendon_length: ArrayLike | None = None,
        *,
        tension: ArrayLike | None = None,
        extension: ArrayLike | None = None,
        tip_force: ArrayLike | None = None,
        tip_moment: ArrayLike | None = None,
        line_force: ArrayLike | None = None,
        point_force: PointForces | None = None,
        follower_tip_force: ArrayLike | None = None,
        base_pose: ArrayLike | None = None,
        gravity: ArrayLike | None = None,
        obstacle_pose: Mapping[str, ArrayLike] | None = None,
        obstacle_velocity: Mapping[str, ArrayLike] | None = None,
        tolerance: float = 1e-9,
        rows: ArrayLike | None = None,
    ) -> State:
        """Repeat the pass on frozen inputs until every boundary residual is below `tolerance` [m]; inputs as
        for `step`.

        Where Newton's method would diverge the loads are brought on step by step. Robots that still do not
        converge have `ok` False and `passes` -1. In paper mode four wires may contradict each other; then the
        least-squares boundary has converged, and `residual` says by how much they do.

        `rows` are indices of robots, or a mask: the others stay as they are, in the state as well; their
        inputs are not read. Not with a contact scene.
        """
        _check_positive("tolerance", tolerance, "m")
        given = Inputs(
            tendon_length,
            tension,
            extension,
            tip_force,
            tip_moment,
            line_force,
            point_force,
            follower_tip_force,
            base_pose,
            gravity,
        )
        if self._felt is not None:
            if rows is not None:
                raise InputError(
                    "settle with rows is for simulators without a contact scene; settle all, "
                    "or restore a snapshot's rows."
                )
            return self._contact_step(self._felt, given, obstacle_pose, obstacle_velocity, tolerance)
        moved = self._moved_obstacles(obstacle_pose, obstacle_velocity)
        only = None if rows is None else self._mask(rows)
        ports, read = self._read(given, only)
        self._move_obstacles(moved)
        return self._settle(ports, read, tolerance, only)

    def _contact_step(
        self,
        engine: Engine,
        given: Inputs,
        pose: Mapping[str, ArrayLike] | None,
        velocity: Mapping[str, ArrayLike] | None,
        tolerance: float | None,
    ) -> State:
        """A step (`tolerance` None), or `settle`, with a contact scene."""
        poses = engine.scene.moved(engine.poses, pose, self.n_robots)
        velocities = engine.scene.velocities(velocity, self.n_robots)
        start = self._ports
        ports, rows = self._read(given)
        if start is not None:
            stretch(self._passes, rows, ports.extension - start.extension)
        engine.given_arclength, engine.given_force = self._reader.loads
        engine.move(poses, velocities, self.dt)
        solver = RodSolver(
            boundary=self._passes,
            warm=self._warm,
            tolerance=tolerance,
            recovery=Boundary(self._passes) if self.recover else None,
            process=self.observer.process_noise * self.dt,
            noise=self.observer.measurement_noise / self.dt,
            used=np.zeros(self.n_robots, np.int64),
        )
        shape, passes = self._passes.new_shape("full", True), solver.used
        ok, done = ContactStep(
            engine=engine,
            solver=solver,
            shape=shape,
            end=ports,
            tolerance=tolerance or _AT_REST,
            most=engine.scene.max_iterations if tolerance is None else COLD_ITERATIONS,
        ).run(rows, self._warm, start, self._unloaded(ports))
        for i in rows[~ok[rows]]:
            if engine.continued[i] and not overloaded(self._passes, ports, int(i)):
                why = engine.why(int(i), float(done[i]))
            else:
                why = self._sentence(_DIVERGED, ports, shape, int(i))
            self._reader.problems.setdefault(int(i), why)
        # a cold robot has no last inputs to go on from: it begins anew
        gone = np.isin(self._all, rows) & ~ok
        held = gone & (engine.continued | self.recover) & engine.tracked & ~engine.whole_worlds(~self._warm)
        if held.any() and start is not None:
            ports = blended(start, ports, done)
        self._passes.arrive_at(np.flatnonzero(held | (ok & engine.continued)), ports)
        lost = np.flatnonzero(gone & ~(held & engine.continued))
        state = self._finish(ports, shape, ok, np.where(ok, passes, -1), "contact", lost)
        self._warm[held] = True  # it stands where it came to, and goes on from there
        return state

    def _unloaded(self, ports: Ports) -> Ports:
        """The straight robot on the same base, without loads."""
        ends = np.cumsum(self._passes.params.length + ports.extension, axis=1)[:, self._layout.tendon_segment]
        zeros: dict[str, Any] = {
            name: 0.0 * getattr(ports, name)
            for name in ("tension", "tip_force", "tip_moment", "follower_force", "line_force", "node_force")
        }
        return ports._replace(tendon_length=np.ascontiguousarray(ends), **zeros)

    def settle_ports(
        self, ports: Ports, params: Params, tolerance: float = 1e-9, rows: Ints | None = None
    ) -> State:
        """`settle` on what the kernel reads, with effects already in it: for those who carry effects over a
        whole log themselves. `params` may have a row for each robot. Robots that are not in `rows` are not
        solved, and not `ok`."""
        self._reader.problems, self._derived = {}, None
        self._passes.params, self._bare = params, None
        self._passes.remember(False, False, None)
        return self._settle(ports, self._all if rows is None else rows, tolerance)

    def _settle(self, ports: Ports, rows: Ints, tolerance: float, only: Flags | None = None) -> State:
        shape = self._passes.new_shape(self.outputs, len(rows) < self.n_robots)

        passes = settle(rows, self._warm, self._passes, ports, tolerance, self._into(shape))
        self._passes.collect(shape)
        if self._passes.carry:
            self._passes.memory.covariance[rows] = 0.0
        ok = np.zeros(self.n_robots, bool)
        ok[rows] = passes[rows] > 0
        reason = f"settle did not bring the boundary residual below {tolerance:g} m"
        return self._finish(ports, shape, ok, passes, reason, rows[~ok[rows]], only)

    def _into(self, shape: RodShape) -> Pass:
        """Passes on frozen inputs that write into `shape`."""

        return frozen_pass(self._passes, shape)

    def shape(self, arclength: ArrayLike) -> Pose:
        """Pose and curvature of the last state at any arclength [m]: (n_queries,), or (n_robots, n_queries).

        Between nodes the rod is integrated from the node before, so the answer has the integrator's order
        everywhere.
        """
        state, ports = self._full("shape"), self._last("shape")[1]
        refuse_masked("arclength", arclength)
        try:
            s = np.asarray(arclength, dtype=np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(
                f"arclength is {shown(arclength)}; give numbers [m], (n_queries,) or (n_robots, n_queries)."
            ) from error
        s = np.broadcast_to(s, (self.n_robots, s.shape[1])) if s.ndim == 2 and len(s) == 1 else s
        s = (
            np.broadcast_to(np.atleast_1d(s), (self.n_robots, s.shape[-1] if s.ndim else 1))
            if s.ndim <= 1
            else s
        )
        if s.ndim != 2 or len(s) != self.n_robots:
            raise InputError(
                f"arclength has shape {np.shape(arclength)}; it must be (n_queries,) or "
                f"({self.n_robots}, n_queries) [m]."
            )
        end = state.arclength[:, -1:]
        if (bad := ~((s >= 0.0) & (s <= end * (1.0 + 1e-9))) & state.ok[:, None]).any():
            i, j = np.argwhere(bad)[0]
            raise InputError(f"arclength {s[i, j]:.6g} m; robot {i} runs from 0 to {end[i, 0]:.6g} m.")
        found = Pose(
            np.full((*s.shape, 3), np.nan), np.full((*s.shape, 3, 3), np.nan), np.full((*s.shape, 3), np.nan)
        )
        whole = np.isfinite(end[:, 0])
        robot, query = np.nonzero(np.broadcast_to(whole[:, None], s.shape))
        between_nodes(
            robot,
            query,
            np.array(s, order="C"),
            self._passes.params,
            ports,
            self._layout,
            _as_shape(state),
            found,
        )
        return found

    def jacobian(self, *, turning: bool = False) -> Floats:
        """(n_robots, 6, n_tendons + n_segments) d(tip position [m], rotation vector [rad]) / d(input [m or
        N]), world frame.

        Inputs: the tendons (length, or tension where that is the mode), then the segments' extensions, the
        other inputs held: a point force at its arclength. With effects, the inputs are those commanded, and
        the effects stay where they are in their loops; what only follows in time (latency, dynamics) answers
        nothing at once: its columns are zero. A slack wire's column is zero, a robot's that is not ok nan.
        Columns of lengths come from the sensitivities of the pass; those of tensions and extensions from
        central differences of the pass, closed by the same sensitivities. Contact forces are held as they
        are.

        With `turning`, three columns more: by the rotation vector of the base about its origin, world [rad].
        World loads keep their direction, so the rod bends under them as it turns.
        """
        _, ports = self._last("jacobian")
        if self._derived is not None:
            return self._derived[:, :, : None if turning else -3]
        follows = self._felt is None and bool(self._given.point_force)
        jacobian = self._linear(ports).jacobian(self._relocated if follows else None, turning)
        if self._bare is None:
            return jacobian
        slopes = self._chain.slopes(self._bare, self._plain, self._state, self.dt, self._layout.n_steps)
        n = slopes.shape[1]
        return np.concatenate([jacobian[:, :, :n] @ slopes, jacobian[:, :, n:]], axis=2)

    def compliance(self) -> Floats:
        """(n_robots, 6, 3) d(tip position [m], rotation vector [rad]) / d(tip force [N]), world; actuation
        and contact forces held."""
        return self._linear(self._last("compliance")[1]).by_force()

    def _linear(self, ports: Ports) -> Linear:
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
        return {
            "grid": grid,
            "node_force": node_force,
            "line_force": self._reader.line_force(self._given.line_force, grid),
        }

    def set_free(
        self,
        obstacle: str,
        translation: float,
        rotation: ArrayLike,
        center: ArrayLike,
        body: int | None = None,
    ) -> None:
        """From the next step on this obstacle gives way to the rods: what it is told by `obstacle_pose` is
        where it would be without them. `translation` [m/N] under a force at its `center` (3,) of mass,
        `rotation` (3, 3) [rad/(N m)] under a moment, both world and within one step: dt^2 / m and dt^2 I^-1
        for a body in free flight. Obstacles of one rigid body have the same number
        `body`. Raises `InputError` without a contact scene or where these are not numbers,
        `UnknownNameError`.
        """
        engine = self._contact("set_free")
        k = engine.scene.index(obstacle)
        for name, given in (("translation", translation), ("rotation", rotation), ("center", center)):
            refuse_masked(name, given)
        try:
            numbers = np.concatenate([np.ravel(translation), np.ravel(rotation), np.ravel(center)]).astype(
                float
            )
        except (TypeError, ValueError, OverflowError):
            numbers = np.full(0, np.nan)
        if numbers.shape != (13,) or not np.isfinite(numbers).all() or not numbers[0] >= 0.0:
            raise InputError(
                f"the mobility of {obstacle!r} is {numbers.tolist()}; give [m/N], (3, 3) [rad/(N m)] and "
                "(3,) [m], finite, none negative."
            )
        engine.surfaces.mobility[k] = numbers
        engine.surfaces.body[k] = k if body is None else len(engine.surfaces.body) + body

    def clearance(self, obstacle: str | None = None) -> Floats:
        """(n_robots,) smallest gap between the robot's surface and the obstacle of this name, or anything
        that it may touch [m] (`contact.queries.clearance`). Raises `InputError` without a contact scene or a
        state, `UnknownNameError`."""
        return queries.clearance(self._contact("clearance"), _as_shape(self._full("clearance")), obstacle)

    def swept_clearance(self, tolerance: float = 1e-5, rows: ArrayLike | None = None) -> Floats:
        """(n_robots,) smallest gap on the straight way from the state before to the last one, to `tolerance`
        [m]; after the first state, its clearance. nan but for `rows`, indices or a mask, where they are
        given. Raises `InputError` as `clearance`."""
        engine = self._contact("swept_clearance")
        _check_positive("tolerance", tolerance, "m")
        now = _as_shape(self._full("swept_clearance"))
        before, poses = engine.at_last_step
        some = None if rows is None else self._mask(rows)
        return queries.swept_clearance(engine, now if before is None else before, poses, now, tolerance, some)

    def ray_cast(self, origin: ArrayLike, direction: ArrayLike, longest: float = np.inf) -> queries.Hits:
        """What distance sensors see: rays (n_rays, 3) or (n_robots, n_rays, 3), world, against the obstacles
        where they are now, up to `longest` [m]. Raises `InputError` without a contact scene, on a wrong shape
        or a direction of length 0."""
        return queries.ray_cast(self._contact("ray_cast"), origin, direction, longest)

    def _moved_obstacles(
        self, pose: Mapping[str, ArrayLike] | None, velocity: Mapping[str, ArrayLike] | None
    ) -> tuple[Any, Any] | None:
        """Where obstacles that no rod feels will be, and their velocities, checked; they move once all other
        inputs are, too."""
        if self._engine is None:
            if pose or velocity:
                raise InputError(
                    "obstacles were given to a simulator without a contact scene; give it one: "
                    "Simulator(robot, contact=...)."
                )
            return None
        scene = self._engine.scene
        return scene.moved(self._engine.poses, pose, self.n_robots), scene.velocities(velocity, self.n_robots)

    def _move_obstacles(self, moved: tuple[Any, Any] | None) -> None:
        if self._engine is not None and moved is not None:
            self._engine.poses_before = self._engine.poses
            self._engine.move(*moved, self.dt)

    def _contact(self, what: str) -> Engine:
        if self._engine is None:
            raise InputError(
                f"{what} needs a contact scene; give Simulator(robot, "
                "contact=fastrod.contact.ContactScene(...))."
            )
        return self._engine

    def _full(self, what: str) -> State:
        state, _ = self._last(what)
        if self.outputs != "full":
            raise InputError(f"{what} needs Simulator(..., outputs='full'); this one keeps the tip only.")
        return state

    def measure(self) -> SensedPoses:
        """What a camera on the base sees of the last state: tip (and `log_points`, with outputs="full") in
        the base frame, effects of sensing included. Effects before the rod show in the state itself. Raises
        `InputError` before the first step."""
        state, ports = self._last("measure")
        pose = np.broadcast_to(ports.base_pose, (self.n_robots, 7))
        turn = matrix_from_quaternion(pose[:, 3:])
        points = np.zeros((self.n_robots, 0, 3))
        if self.outputs == "full" and self.robots[0].log_points:
            points = self.shape(np.array(self.robots[0].log_points)).position - pose[:, None, :3]
        seen = SensedPoses(
            np.einsum("nji,nj->ni", turn, state.tip_position - pose[:, :3]),
            np.swapaxes(turn, 1, 2) @ state.tip_rotation,
            np.einsum("nji,nkj->nki", turn, points),
        )
        return self._chain.sense(seen, ports, self._plain, self.dt, self._layout.n_steps)

    def reset(self, rows: ArrayLike | None = None) -> None:
        """Forget the boundary of these robots (all by default): their next step begins from the cold guess,
        their effects at rest."""
        which = slice(None) if rows is None else self._mask(rows)
        self._warm[which], self._derived = False, None
        self._chain.reset(which)

    def snapshot(self) -> Snapshot:
        """A copy of everything that a later step depends on."""
        effects = [link.memory.copy() for link in self._chain.links]
        return Snapshot(
            self.robots,
            _copied(self._passes.peek()),
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
        if not isinstance(snapshot, Snapshot):
            raise InputError(f"the snapshot is {shown(snapshot)}; give what Simulator.snapshot() returned.")
        if snapshot.memory.x.shape[0] != self.n_robots or snapshot.memory.length_before.shape[1] != len(
            self._layout.row_tendon
        ):
            raise InputError(
                "the snapshot is of another simulator; its robots, tendons or their number differ."
            )
        if [memory.shape for memory in snapshot.effects] != [link.memory.shape for link in self._chain.links]:
            raise InputError("the snapshot is of another simulator; its effects differ.")
        if (snapshot.contact is None) != (self._engine is None):
            raise InputError("the snapshot is of another simulator; only one of them has a contact scene.")
        self._shaped[slice(None) if rows is None else self._mask(rows)] = True
        if rows is not None and self._state is not None and self._ports is not None:
            self._restore_rows(snapshot, self._mask(rows), self._state, self._ports)
            return
        if len(snapshot.robots) != len(self.robots) or any(
            a is not b for a, b in zip(snapshot.robots, self.robots, strict=True)
        ):
            raise InputError("the snapshot is of other robots; some were replaced since.")
        self._passes.memory = _copied(snapshot.memory)
        self._derived = None
        self._warm, self._given, self._ports, self._state = (
            snapshot.warm.copy(),
            snapshot.given,
            snapshot.ports,
            snapshot.state,
        )
        self._passes.params, self._bare, self._chain.time = (
            snapshot.params,
            snapshot.bare,
            snapshot.time.copy(),
        )
        for link, memory in zip(self._chain.links, snapshot.effects, strict=True):
            link.memory[:] = memory
        if self._engine is not None and snapshot.contact is not None:
            self._engine.restore(snapshot.contact)

    def _restore_rows(self, snapshot: Snapshot, rows: Flags, state: State, ports: Ports) -> None:
        if snapshot.state is None or snapshot.ports is None:
            self.reset(rows)
            return
        then = self._passes.refit(snapshot.memory, len(ports.follower_force) > 0, snapshot.ports.tip_force)
        self._passes.put(np.flatnonzero(rows), then)
        self._warm, self._derived = np.where(rows, snapshot.warm, self._warm), None
        self._ports = taken_each(ports, snapshot.ports, rows)
        if self._bare is not None and snapshot.bare is not None:
            self._bare = taken_each(self._bare, snapshot.bare, rows)
            self._passes.params = taken_each(self._passes.params, snapshot.params, rows)
        alike = bool(len(ports.follower_force)) == bool(len(snapshot.ports.follower_force))
        if (
            self._engine is None
            and alike
            and self._passes.tracks_force
            and not len(snapshot.memory.force_before)
        ):
            # their gain knows no tip force yet, which moves by now: learned as `step` does
            process, noise = self.observer.process_noise * self.dt, self.observer.measurement_noise / self.dt
            learning, apart = np.flatnonzero(rows & snapshot.warm), self._passes.new_shape("tip", True)
            self._passes.run(
                learning, self._ports, apart, carry=self._passes.carry, process=process, noise=noise
            )
        for link, memory in zip(self._chain.links, snapshot.effects, strict=True):
            link.memory[rows] = memory[rows]
        self._chain.time[rows] = snapshot.time[rows]
        if self._engine is not None and snapshot.contact is not None:
            restore_contact(self._engine, snapshot.contact, rows)
        problems = {i: sentence for i, sentence in state.problems.items() if not rows[i]}
        problems |= {i: sentence for i, sentence in snapshot.state.problems.items() if rows[i]}
        ok, passes = (
            np.where(rows, snapshot.state.ok, state.ok),
            np.where(rows, snapshot.state.passes, state.passes),
        )
        self._hand_out(taken_shape(_as_shape(state), snapshot.state, rows), ok, passes, problems)

    def replace(self, rows: ArrayLike, robots: Sequence[Robot]) -> None:
        """Other robots in these rows (indices, one robot each): their numbers and the values of their
        effects. They begin cold, their effects at rest. Raises `RobotError` where counts, modes or effects
        differ from those here, and with effects or a contact scene where segments or wires are elsewhere;
        `InputError` where rows and robots do not match."""
        if not isinstance(robots, (list, tuple)) or not all(isinstance(robot, Robot) for robot in robots):
            raise RobotError(f"robots is {shown(robots)}; give a list of Robot, one for each row.")
        mask = self._mask(rows)
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

        def put(now: Any, new: Any) -> Any:
            full = np.array(np.broadcast_to(now, (self.n_robots, *now.shape[1:])), order="C")
            full[which] = new[1:]
            return full

        plain: tuple[Any, ...] = self._plain
        self._plain = Params(*(put(a, b) for a, b in zip(plain, params, strict=True)))
        self._passes.params = self._plain
        rest = type(rest)(*(put(a, b) for a, b in zip(self._reader.rest, rest, strict=True)))
        self._reader = Reader(self._layout, self._plain, rest, self.n_robots)
        self._chain.gravity = put(self._chain.gravity, chain.gravity)
        for link, new in zip(self._chain.links, chain.links, strict=True):
            link.values[which] = new.values[1:]
        every = list(self.robots * (self.n_robots if len(self.robots) == 1 else 1))
        for i, robot in zip(which, robots, strict=True):
            every[i] = robot
        self.robots = tuple(every)
        self.reset(mask)
        self._shaped[which] = False

    def _mask(self, rows: ArrayLike) -> Flags:
        """(n_robots,) of indices or a mask."""
        mask = np.zeros(self.n_robots, bool)
        refuse_masked("rows", rows)
        try:
            which = np.asarray(rows)
            if which.ndim > 1 or (which.dtype.kind == "b" and which.shape != mask.shape):
                raise IndexError
            if which.size:
                mask[which] = True
        except (IndexError, TypeError, ValueError, OverflowError) as error:
            raise InputError(
                f"rows is {shown(rows)}; give indices of robots from 0 to {self.n_robots - 1}, or a mask."
            ) from error
        return mask

    def _read(self, given: Inputs, only: Flags | None = None) -> tuple[Ports, Ints]:
        """The ports, and the robots whose inputs are good; of those in `only`, where it is given."""
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
            ports, self._passes.params = self._chain.act(
                ports, self._plain, self._state, self.dt, self._layout.n_steps, out, self._reader.gravity
            )
            if only is not None and bare is not None:
                self._bare = taken_each(self._bare, bare, ~only)
                self._passes.params = taken_each(self._passes.params, params, ~only)
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
        track_force = self._passes.tracks_force or self._force_moves(ports.tip_force)
        self._passes.remember(
            len(ports.follower_force) > 0, track_force, None if self._ports is None else self._ports.tip_force
        )
        return ports, rows

    def _held(self, learns: bool) -> Flags:
        """(n_robots,) who corrects by the gain that it has."""
        if not self.hold_gain or learns or self._state is None or self._passes.carry:
            return np.zeros(self.n_robots, bool)
        return np.asarray(self._warm & (self._state.residual < self.hold_gain))

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

    def _sentence(self, reason: str, ports: Ports, shape: RodShape, i: int) -> str:
        return f"{reason}; residual {shape.residual[i]:.3g} m; {what_to_do(self._passes, ports, i)}."

    def _finish(
        self,
        ports: Ports,
        shape: RodShape,
        ok: Flags,
        passes: Ints,
        reason: str,
        lost: Ints,
        only: Flags | None = None,
    ) -> State:
        """Note who is not ok, so that nothing continues on NaN, and hand out the state. What a pass wrote of
        the robots `lost` is no shape of theirs: they keep the one before."""
        problems = dict(self._reader.problems)
        for i in np.flatnonzero(~ok):
            problems.setdefault(int(i), self._sentence(reason, ports, shape, int(i)))
        if len(lost):
            shape, ports = self._kept(shape, ports, np.isin(self._all, lost))
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
            problems |= {int(i): "left out before its first step." for i in np.flatnonzero(~only)}
        elif only is not None and before is not None:
            problems = {i: sentence for i, sentence in problems.items() if only[i]} | {
                i: sentence for i, sentence in before.problems.items() if not only[i]
            }
            shape, ok, passes = (
                taken_shape(shape, before, ~only),
                np.where(only, ok, before.ok),
                np.where(only, passes, before.passes),
            )
            if self._ports is not None:
                ports = taken_each(ports, self._ports, ~only)
        self._ports = ports
        return self._hand_out(shape, ok, passes, problems)

    def _kept(self, shape: RodShape, ports: Ports, lost: Flags) -> tuple[RodShape, Ports]:
        """`lost` robots as in the state before, nan where that holds no shape of theirs; `residual` is of
        what was tried."""
        kept = RodShape(*(np.array(a) for a in shape))
        for a in kept:
            a[lost if len(a) else slice(0)] = np.nan
        if (have := lost & self._shaped).any() and self._state is not None and self._ports is not None:
            kept, ports = taken_shape(kept, self._state, have), taken_each(ports, self._ports, have)
        return kept._replace(residual=shape.residual), ports

    def _hand_out(self, shape: RodShape, ok: Flags, passes: Ints, problems: dict[int, str]) -> State:
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


def _check_positive(name: str, value: float, unit: str) -> None:
    if not isinstance(value, (int, float, np.floating, np.integer)) or not 0.0 < value <= float_info.max:
        raise InputError(f"{name} is {shown(value)} {unit}; it must be a number, positive and finite.")


def _as_shape(state: State) -> RodShape:
    return RodShape(*(getattr(state, name) for name in RodShape._fields))


def _copied(memory: Memory) -> Memory:
    fields: dict[str, Any] = {name: a.copy() for name, a in memory._asdict().items()}
    return Memory(**fields)
