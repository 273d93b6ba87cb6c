"""`Simulator`: many robots, one observer pass a step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from fastrod.checks import Bound, check_number
from fastrod.effects.executor import SensedPoses, from_base
from fastrod.errors import InputError
from fastrod.model.robot import Robot
from fastrod.solver import options
from fastrod.solver.gpu import device as devices
from fastrod.solver.inputs import Inputs, PointForces, arclengths, free_body, named_inputs, robot_mask
from fastrod.solver.observer import ObserverSolver
from fastrod.solver.options import Modal, Observer, SchemeName, SolverName
from fastrod.solver.protocol import How, Solver
from fastrod.solver.robots import RobotBatch
from fastrod.solver.state import Pose, State, check_on_robot
from fastrod.types import Floats, Ports

if TYPE_CHECKING:
    from fastrod.contact.engine import Engine
    from fastrod.contact.queries import Hits
    from fastrod.contact.scene import ContactScene
    from fastrod.solver.motion import ModalRods
    from fastrod.solver.tape import Cost, Gradient, Tape


class Simulator(RobotBatch):
    """Many tendon-driven continuum robots at once.

    >>> import fastrod
    >>> robot = fastrod.load_robot("prototype")
    >>> sim = fastrod.Simulator(robot, n_robots=2)
    >>> state = sim.settle(robot.rest_tendon_length, tip_force=[[0, 0, 0], [0, 0.1, 0]])
    >>> state.ok
    array([ True,  True])
    """

    @named_inputs
    def __init__(
        self,
        robot: Robot | Sequence[Robot],
        n_robots: int | None = None,
        dt: float = 0.01,
        points_per_segment: int = 20,
        *,
        outputs: Literal["full", "tip"] = "full",
        solver: SolverName | Observer | Modal | None = None,
        dynamics: bool = False,
        scheme: SchemeName = Modal.scheme,
        contact: ContactScene | None = None,
        feel_contact: bool = True,
        recover: bool = True,
        threads: int | None = None,
        device: devices.Device = "cpu",
    ) -> None:
        """Compile `robot` (one for all, or a list with one each) for `n_robots` and a time step `dt` [s].

        `points_per_segment` is the number of integration steps of a segment; the shape has n_segments times
        as many nodes and one more. `outputs="tip"` keeps only tip pose, residual and ok: some 2 kB a
        five-segment robot.

        `solver` is a `fastrod.Observer`, one forward integration a step (the default), or a `fastrod.Modal`:
        rods of curvature modes, which robots with axial or shear stiffness or with inertia take, and those
        heavy for their stiffness; "observer" and "modal" stand for both as they are. `dynamics=True` and a
        `scheme` stand for `Modal(dynamics=True, scheme=...)`: a step moves a robot on by `dt`, and every
        segment needs a line_density, or without mass a damping_time. Without `recover` a robot whose pass
        diverges in a step is lost at once: a step then ends after its one pass, where the search for a shape
        that does not exist takes some thousand.

        `contact` is what the rods may touch; without it they pass through everything. Without `feel_contact`
        they do so all the same, and the scene is for `clearance`, `swept_clearance` and `ray_cast` alone. The
        observer's robots are rods of modes for as long as they touch something.

        `threads` defaults to numba's. With `device="cuda"` the observer's passes run on an NVIDIA GPU, one
        thread a robot, from the same source: numbers agree to rounding. The memory of the observer stays
        there; a step sends the inputs that changed and brings back what `outputs` asks for, so for large
        batches ask for "tip". Everything else is done on the CPU, as are the Newton steps of `settle`.

        Raises `InputError` (also where there is no GPU), `RobotError`, `UnknownNameError`.
        """
        robots, n_robots = options.checked_robots(robot, n_robots)
        options.check_options(points_per_segment, dt, outputs)
        how = options.solver_of(robots, solver, dynamics, scheme)
        self.device = devices.checked(device)
        """Device on which the passes run."""
        options.check_fellows(how, contact, feel_contact, device)
        super().__init__(robots, n_robots, float(dt), int(points_per_segment), outputs)
        self.contact: ContactScene | None = contact
        """Scene that the rods may touch."""
        self.dynamics = isinstance(how, Modal) and how.dynamics
        """Whether the rods have inertia: a step moves them on by `dt`."""
        shared: Any = {"dt": self.dt, "outputs": outputs, "threads": options.checked_threads(threads)}
        if contact is not None:
            from fastrod.contact.engine import Engine

            rods = contact.rods(self.robots, self.n_robots, self._layout)
            self._engine = Engine(contact, rods, self._plain.length, self.n_points, shared["threads"])
            self._felt = self._engine if feel_contact else None
        self.solver: SolverName = "modal" if isinstance(how, Modal) else "observer"
        """Kind of the solver; among obstacles "observer" has rods of modes where they touch."""
        self._rods = self._solver_of(how, shared, recover)

    def _solver_of(self, how: Observer | Modal, shared: Any, recover: bool) -> Solver:
        """The rods, solved as `how` says; modules of modes and of contact are imported for those who use
        them."""
        if isinstance(how, Modal):
            from fastrod.solver.motion import ModalRods

            robots = how, self.robots, self._layout, self._plain, self.n_robots
            if self._felt is None:
                return ModalRods(*robots, **shared)
            from fastrod.solver.touching import TouchingRods

            return TouchingRods(self._felt, *robots, **shared)
        shared |= {"device": self.device, "recover": bool(recover)}
        given = self._layout, self._plain, self.n_robots
        if self._felt is None:
            return ObserverSolver(how, *given, **shared)
        from fastrod.solver.resting import RestingRods

        return RestingRods(self._felt, how, self.robots, *given, **shared)

    def __repr__(self) -> str:
        touched = "" if self.contact is None else ", ".join(self.contact.names) or "rods alone"
        by = " by fcl" if self.contact is not None and self.contact.collision == "fcl" else ""
        contact = f", contact with {touched}{by}" if touched else ""
        device = "" if self.device == "cpu" else f", device={self.device!r}"
        others = " and others" if any(robot is not self.robots[0] for robot in self.robots) else ""
        numbers = f"n_robots={self.n_robots}, dt={self.dt:g} s, n_points={self.n_points}"
        return f"Simulator({self.robots[0].name!r}{others}, {numbers}{contact}{device})"

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
        follower_line_force: ArrayLike | None = None,
        base_pose: ArrayLike | None = None,
        gravity: ArrayLike | None = None,
        obstacle_pose: Mapping[str, ArrayLike] | None = None,
        obstacle_velocity: Mapping[str, ArrayLike] | None = None,
        derive: bool = False,
        passes: int = 1,
        estimate_error: bool = False,
        inverse_inertia: ArrayLike | None = None,
    ) -> State:
        """One observer pass: one forward integration per robot. With rods of modes: the rest on these inputs,
        or with `dynamics` one step of `dt`, whose inputs are those at its end, by at least so many `passes`
        of Newton's method; `estimate_error` repeats it as two steps of dt / 2, and `state.step_error` says
        how far apart they end.

        Every input has shape (n_robots, ...), or without the robot axis for all. What is not given is zero,
        or the robot's own. `tendon_length` (n_tendons,) absolute, base to where the tendon ends [m];
        `tension` (n_tendons,) of tendon_tension segments [N]; `extension` (n_segments,) [m]; `tip_force` [N],
        `tip_moment` [N m], `line_force` [N/m], each (3,) world, the last also (n_segments, points, 3), linear
        between evenly spaced points, on top of the self-weight; `point_force` (arclength [m], force (3,)
        world [N]) pairs; `follower_tip_force` (3,) material frame of the tip [N]; with rods of modes
        `follower_line_force` [N/m], shaped as `line_force`, in the material frame where it acts; `base_pose`
        (7,) position [m] and quaternion w x y z; `gravity` (3,) world [m/s^2], where that is another at this
        step than the robot's own.

        The state belongs to the boundary that the last pass predicts for these tendon lengths and tip forces;
        what other inputs change is corrected with the next pass, and shows as `residual`; tendons that
        only grow along with an extension count as unchanged. Robots whose pass diverges are settled on these
        inputs, from where they stood, then from nothing (on a GPU from nothing at once), and `passes` counts
        what that took; the others keep every bit. When the tip force of running robots first moves, one pass
        more learns the gain for it (`passes` is 2). Raises `InputError` on a wrong shape, or where no robot's
        input is usable; a single bad row only clears that robot's `ok`.

        With a contact scene: `obstacle_pose` name -> (7,) or (n_robots, 7) position and quaternion, world;
        what is not given stays where it was, and what is not finite is refused for all robots, who may share
        it. `obstacle_velocity` name -> (6,) or (n_robots, 6) linear [m/s] and angular [rad/s] velocity of the
        obstacle's origin: slip is then counted by it, and not by how the pose has changed. Robots that touch
        something take as many passes as bring contact and boundary to rest; `state.contacts` reports them.

        `inverse_inertia` (6, 6) or (n_robots, 6, 6), with `dynamics`: of the free body that carries the base,
        its linear and angular acceleration by force and moment about the base point, world (J M^-1 J^T; 0 of
        one that is held). `base_pose` is then where the body would be without the rod: it gives way within
        the step, stably whatever the ratio of the masses, and what it felt is `state.mean_wrench`.

        `derive` says that `jacobian(turning=True)` will be asked for: a robot or two without contact and
        effects then get it from the same pass, at the shape of the state, at little cost.
        """
        more = line_force, point_force, follower_tip_force, follower_line_force
        given = Inputs(tendon_length, tension, extension, tip_force, tip_moment, *more, base_pose, gravity)
        how = How(self.dt, passes, estimate_error, inverse_inertia, derive)
        self._rods.accept(given, how)
        moved, before = self._moved_obstacles(obstacle_pose, obstacle_velocity), self._before
        ports, rows = self._read(given)
        self._move_obstacles(moved)
        how = how._replace(
            derive=derive and self._bare is None, relocate=self._relocated if given.point_force else None
        )
        return self._note(self._rods.step(rows, self._acting(ports), before, how), rows)

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
        follower_line_force: ArrayLike | None = None,
        base_pose: ArrayLike | None = None,
        gravity: ArrayLike | None = None,
        obstacle_pose: Mapping[str, ArrayLike] | None = None,
        obstacle_velocity: Mapping[str, ArrayLike] | None = None,
        tolerance: float = 1e-9,
        rows: ArrayLike | None = None,
    ) -> State:
        """Repeat the pass on frozen inputs until every boundary residual is below `tolerance` [m]; inputs as
        for `step`. Without lengths or tensions the tendons are as at rest.

        Where Newton's method would diverge, the loads grow from none to all (load continuation). Robots that
        still do not converge have `ok` False and `passes` -1. In paper mode four tendons may contradict each
        other; then the least-squares boundary has converged, and `residual` says by how much they do.

        `rows` are indices of robots, or a mask: the others stay as they are, in the state as well; their
        inputs are not read. Not with a contact scene.
        """
        check_number("tolerance", tolerance, Bound(above=0.0, unit="m"))
        if tendon_length is None and tension is None:
            tendon_length, tension = self._at_rest()
        more = line_force, point_force, follower_tip_force, follower_line_force
        given = Inputs(tendon_length, tension, extension, tip_force, tip_moment, *more, base_pose, gravity)
        self._rods.accept(given, None)
        if self._felt is not None and rows is not None:
            raise InputError(
                "settle with rows is for simulators without a contact scene; settle all, "
                "or restore a snapshot's rows."
            )
        moved = self._moved_obstacles(obstacle_pose, obstacle_velocity)
        only = None if rows is None else robot_mask(rows, self.n_robots)
        ports, read = self._read(given, only)
        self._move_obstacles(moved)
        state = self._settle(ports, read, tolerance, only)
        follows = self._chain.follows and self._felt is None
        return self._balanced(given, state, tolerance, only) if follows else state

    def _at_rest(self) -> tuple[Floats | None, Floats | None]:
        """Lengths of tendons at rest (n_robots or 1, n_tendons) [m], or no tension, as the robots are driven;
        None of what does not drive them, and where it is mixed."""
        modes = {segment.mode for robot in self.robots for segment in robot.segments} - {"passive"}
        if modes == {"tendon_tension"}:
            return None, np.zeros((1, self.robots[0].n_tendons))
        if modes and "tendon_tension" not in modes:
            return np.stack([robot.rest_tendon_length for robot in self.robots]), None
        return None, None

    def _full(self, what: str) -> State:
        state, _ = self._last(what)
        if self.outputs != "full":
            raise InputError(f"{what} needs Simulator(..., outputs='full'); this one keeps the tip only.")
        return state

    def _modal(self, what: str) -> ModalRods:
        from fastrod.solver.motion import ModalRods

        if not isinstance(self._rods, ModalRods):
            raise InputError(f"{what} needs rods of modes; give Simulator(robot, solver='modal').")
        return self._rods

    def _in_motion(self, what: str) -> ModalRods:
        """Rods that have inertia, after their first step."""
        self._last(what)
        if not self.dynamics:
            needs = "inertia" if what == "frequencies" else "rods with inertia"
            raise InputError(f"{what} needs {needs}; give Simulator(robot, dynamics=True).")
        return self._modal(what)

    def set_in_motion(self, base_twist: ArrayLike, rows: ArrayLike | None = None) -> None:
        """Let robots that were brought to rest move on with their bases as rigid bodies, at `base_twist` (6,)
        or (n_robots, 6): velocity of the base point [m/s] and angular velocity [rad/s], world. `rows`:
        indices or a mask, all without it. Raises `InputError` without `dynamics`, and before the first
        state."""
        rods = self._in_motion("set_in_motion")
        some = self._all if rows is None else np.flatnonzero(robot_mask(rows, self.n_robots))
        rods.set_in_motion(base_twist, some[self._warm[some]])

    def momentum(self) -> Floats:
        """(n_robots, 6) linear [kg m/s], then angular momentum about the origin [kg m^2/s], of rods in
        motion, world. Raises `InputError` without `dynamics`, and before the first state."""
        rods = self._in_motion("momentum")
        return rods.momentum(self._acting(self._last("momentum")[1]), self._warm)

    def apparent_stiffness(self, *, mean: bool = False) -> Floats:
        """(n_robots, 6, 6) by how much force and moment about the base point, which the rod exerts on its
        base at the end of the last step, fall per displacement [m] and rotation [rad] of the base there,
        world: H_bb - H_bq H_qq^-1 H_qb, inertia and all, and half the moment's own rotation, by which it is
        not symmetric. It is that of the shape before the last Newton step: to rounding with more `passes`.
        With `mean` it is that of `state.mean_wrench` where nothing but inertia resists: of its force, and of
        its moment with the rod where it is at the end of the step.
        Raises `InputError` but after a step with `inverse_inertia`; nan for robots that took none."""
        state, _ = self._last("apparent_stiffness")
        if not self.dynamics:
            raise InputError("apparent_stiffness is of a step with inverse_inertia; give it to step.")
        return self._modal("apparent_stiffness").apparent_stiffness(state, mean)

    def frequencies(self, count: int = 3) -> Floats:
        """(n_robots, count) lowest natural frequencies [Hz] of small motions about the last state's shape,
        which should be a rest, undamped. Raises `InputError` without rods of modes or a mass, and before the
        first step."""
        rods = self._in_motion("frequencies")
        return rods.frequencies(count, self._acting(self._last("frequencies")[1]), self._warm)

    def record(self) -> Tape:
        """Record every call from now on, for its derivatives: `Tape.forward` and `adjoint`. A recorded
        step ends when Newton's method does, and takes some times as long. `restore` and `replace` end the
        recording. Raises `InputError` without rods of modes."""
        return self._modal("record").record()

    def adjoint(self, cost: Cost, parameters: Sequence[str] = (), inputs: Sequence[str] = ()) -> Gradient:
        """Derivatives of `cost` of the tips' motion since `record()`, by the inputs of every call (without
        names by `tendon_length`) and by numbers of the robots such as "segment.1.line_density"
        (`Tape.adjoint`). Raises `InputError` where nothing is recorded, and for names that there are
        not."""
        tape = self._modal("adjoint").tape
        if tape is None:
            raise InputError("adjoint needs a recording; call record() before the first call of it.")
        return tape.adjoint(cost, parameters, inputs or ("tendon_length",))

    def shape(self, arclength: ArrayLike) -> Pose:
        """Pose and curvature of the last state at any arclength [m]: (n_queries,), or (n_robots, n_queries).

        Between nodes the rod is integrated from the node before, so the answer has the integrator's order
        everywhere.
        """
        if self.solver == "modal" or self._felt is not None:
            from fastrod.solver.motion import pose_at

            return pose_at(self._full("shape"), arclength)
        from fastrod.kernels.rod.dense import between_nodes

        state, ports = self._full("shape"), self._last("shape")[1]
        s = arclengths(arclength, self.n_robots)
        check_on_robot(s, state)
        end = state.arclength[:, -1:]
        found = Pose(*(np.full((*s.shape, *axes), np.nan) for axes in ((3,), (3, 3), (3,))))
        robot, query = np.nonzero(np.broadcast_to(np.isfinite(end), s.shape))
        between_nodes(
            robot, query, np.array(s, order="C"), self._params, ports, self._layout, state.as_shape(), found
        )
        return found

    @named_inputs
    def jacobian(self, *, turning: bool = False) -> Floats:
        """(n_robots, 6, n_tendons + n_segments) d(tip position [m], rotation vector [rad]) / d(input [m or
        N]), world frame.

        Inputs: the tendons (length, or tension where that is the mode), then the segments' extensions, the
        other inputs held: a point force at its arclength. With effects, the inputs are those commanded, and
        the effects stay where they are in their loops; what only follows in time (latency, second-order lag)
        answers nothing at once: its columns are zero. A slack tendon's column is zero, a robot's that is not
        ok nan. Columns of lengths come from the sensitivities of the pass; those of tensions and extensions
        from central differences of the pass, closed by the same sensitivities. Contact forces are held as
        they are.

        With `turning`, three columns more: by the rotation vector of the base about its origin, world [rad].
        World loads keep their direction, so the rod bends under them as it rotates.
        """
        _, ports = self._last("jacobian")
        if self._derived is not None:
            return self._derived[:, :, : None if turning else -3]
        follows = self._felt is None and bool(self._given.point_force)
        jacobian: Floats = self._linear(ports).jacobian(self._relocated if follows else None, turning)
        if self._bare is None:
            return jacobian
        slopes = self._chain.slopes(self._bare, self._plain, self._state, self.dt, self._layout.n_steps)
        n = slopes.shape[1]
        jacobian = np.concatenate([jacobian[:, :, :n] @ slopes, jacobian[:, :, n:]], axis=2)
        return self._with_feedback(jacobian, ports, turning) if self._chain.feels_tip else jacobian

    def _with_feedback(self, jacobian: Floats, ports: Ports, turning: bool) -> Floats:
        """A Jacobian at which the forces of effects that feel the tip were held, with them: they go by the
        tip, and with the base where it rotates."""
        state, bare = self._state, self._bare
        assert state is not None
        assert bare is not None
        by_force = np.asarray(self._linear(ports).by_load())[..., :3]
        force, slopes = self._chain.tip_feedback(bare, self._plain, state, self._layout.n_steps)
        moved = np.zeros((len(force), 3, jacobian.shape[2]))
        if turning:
            arm = state.tip_position - ports.base_pose[:, :3]
            for j, axis in enumerate(np.eye(3)):
                rotated = slopes @ np.cross(axis, arm)[..., None]
                moved[:, :, j - 3] = np.cross(axis, force) - rotated[..., 0]
        inverse = np.linalg.inv(np.eye(3) - slopes @ by_force[:, :3])
        change: Floats = jacobian + by_force @ inverse @ (slopes @ jacobian[:, :3] + moved)
        return change

    @named_inputs
    def compliance(self, *, moments: bool = False) -> Floats:
        """(n_robots, 6, 3) d(tip position [m], rotation vector [rad]) / d(tip force [N]), world; actuation
        and contact forces held. With `moments` (n_robots, 6, 6): three columns more, by the tip's moment
        [N m]."""
        ports = self._last("compliance")[1]
        by_load = np.asarray(self._linear(ports).by_load())[..., : 6 if moments else 3]
        return self._with_feedback(by_load, ports, False) if self._chain.feels_tip else by_load

    def set_free(
        self,
        obstacle: str,
        mobility: ArrayLike,
        center: ArrayLike,
        body: int | None = None,
        ahead: ArrayLike = (0.0,) * 6,
    ) -> None:
        """Let this obstacle give way to the rods from the next step on.

        `mobility` (6, 6): displacement [m] and rotation [rad] within one step by a force [N] at the `center`
        (3,) [m] and a moment [N m]; dt^2 diag(1/m, 1/m, 1/m, I^-1) at its centre of mass for a body in free
        flight, 0 for one that is held. Obstacles of one rigid body have the same number `body`. What it is
        given by `obstacle_pose` is where it would be without the rods, or `ahead` (6,) of that by a
        displacement and a rotation, as by their last forces: the nearer to where it comes, the more precise.
        All in world axes. Raises `InputError` without a contact scene or where these are not such numbers,
        `UnknownNameError`.
        """
        engine = self._contact("set_free")
        surfaces, k = engine.surfaces, engine.scene.index(obstacle)
        given = free_body(obstacle, mobility, center, ahead)
        surfaces.mobility[k], surfaces.center[k], surfaces.ahead[k] = given
        surfaces.body[k] = k if body is None else len(surfaces.body) + body

    def clearance(self, obstacle: str | None = None) -> Floats:
        """(n_robots,) smallest gap between the robot's surface and the obstacle of this name, or anything
        that it may touch [m] (`contact.queries.clearance`). Raises `InputError` without a contact scene or a
        state, `UnknownNameError`."""
        from fastrod.contact import queries

        return queries.clearance(self._contact("clearance"), self._full("clearance").as_shape(), obstacle)

    def overlap(self, obstacle_pose: Mapping[str, ArrayLike]) -> Floats:
        """(n_robots, n_obstacles, 3) shortest displacement of each obstacle out of each robot, mounting
        excepted, world [m]: 0 where they are apart. Obstacles are at `obstacle_pose` (as for `step`), or else
        where they are. Raises `InputError` as `clearance` and for poses that are none, `UnknownNameError`."""
        from fastrod.contact import queries

        engine, shape = self._contact("overlap"), self._full("overlap").as_shape()
        poses = engine.scene.moved(engine.poses, obstacle_pose, self.n_robots)
        return queries.overlap(engine, shape, poses)

    def tendon_bend(self) -> Floats:
        """(n_robots,) largest curvature of the rod times the offset of a tendon on the inside of the bend.
        Beyond 0.9 the robot is not to be trusted: where it is 1 a tendon's path has length 0, and a real one
        lies elsewhere. Raises `InputError` without a state."""
        from fastrod.solver.recovery import tendon_bend

        return tendon_bend(self._full("tendon_bend").curvature, self._params, self._layout)

    def swept_clearance(self, tolerance: float = 1e-5, rows: ArrayLike | None = None) -> Floats:
        """(n_robots,) smallest gap on the straight way from the state before to the last one, to `tolerance`
        [m]; after the first state, its clearance. nan but for `rows`, indices or a mask, where they are
        given. Raises `InputError` as `clearance`."""
        engine = self._contact("swept_clearance")
        check_number("tolerance", tolerance, Bound(above=0.0, unit="m"))
        from fastrod.contact import queries

        now = self._full("swept_clearance").as_shape()
        before, poses = engine.at_last_step
        some = None if rows is None else robot_mask(rows, self.n_robots)
        return queries.swept_clearance(engine, now if before is None else before, poses, now, tolerance, some)

    def ray_cast(self, origin: ArrayLike, direction: ArrayLike, longest: float = np.inf) -> Hits:
        """Return what distance sensors see: rays (n_rays, 3) or (n_robots, n_rays, 3), world, against the
        obstacles where they are now, up to `longest` [m]. Raises `InputError` without a contact scene, on
        a wrong shape or a direction of length 0."""
        from fastrod.contact import queries

        return queries.ray_cast(self._contact("ray_cast"), origin, direction, longest)

    def _moved_obstacles(
        self, pose: Mapping[str, ArrayLike] | None, velocity: Mapping[str, ArrayLike] | None
    ) -> tuple[Any, Any] | None:
        """Return where obstacles that no rod feels will be, and their velocities, checked; they move once
        all other inputs are, too."""
        if self._engine is None:
            if pose or velocity:
                raise InputError(
                    "obstacles were given to a simulator without a contact scene; give it one: "
                    "Simulator(robot, contact=...)."
                )
            return None
        scene = self._engine.scene
        return scene.moved(self._engine.poses, pose, self.n_robots), scene.velocities(velocity, self.n_robots)

    def _contact(self, what: str) -> Engine:
        if self._engine is None:
            raise InputError(
                f"{what} needs a contact scene; give Simulator(robot, "
                "contact=fastrod.contact.ContactScene(...))."
            )
        return self._engine

    @named_inputs
    def markers(self) -> tuple[Floats, Floats]:
        """The first robot's `log_points` of the last state, with their offsets from the backbone: world
        (n_robots, k, 3) [m], and world_from_material (n_robots, k, 3, 3) of their cross-sections. On a robot
        that is shortened below a point's arclength, that point is at its tip."""
        robot, ends = self.robots[0], self._full("markers").arclength[:, -1]
        end = np.min(ends[np.isfinite(ends)], initial=np.inf)
        found = self.shape(np.minimum(np.array(robot.log_points), end))
        offset = np.array(robot.log_offsets or [(0.0, 0.0)] * len(robot.log_points))
        return found.position + np.einsum("nkij,kj->nki", found.rotation[..., :2], offset), found.rotation

    def measure(self) -> SensedPoses:
        """Return what a camera on the base sees of the last state: tip (and `log_points`, with
        outputs="full") in the base frame, effects of sensing included. Effects before the rod show in the
        state itself. Raises `InputError` before the first step."""
        state, ports = self._last("measure")
        points = np.zeros((self.n_robots, 0, 3))
        if self.outputs == "full" and self.robots[0].log_points:
            points = self.markers()[0] - ports.base_pose[:, None, :3]
        seen = from_base(ports.base_pose, state.tip_position, state.tip_rotation, points)
        return self._chain.sense(seen, ports, self._plain, self.dt, self._layout.n_steps)
