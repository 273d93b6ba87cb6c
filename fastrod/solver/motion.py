"""`Motions`: what `Statics` does, with rods of modes where that is the solver: at rest or in motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fastrod.errors import InputError, Problem, nearest, shown
from fastrod.kernels.rod.modal.host import ModalHost
from fastrod.kernels.rod.modal.motion import ModalMotion
from fastrod.kernels.rod.modal.output import MotionShape
from fastrod.model.robot import Robot
from fastrod.rotation import matrix_from_quaternion, product, quaternion_from_vector
from fastrod.solver.balances import Acting, Event
from fastrod.solver.inputs import Inputs, arclengths, robot_mask
from fastrod.solver.merge import merge_rows
from fastrod.solver.modal import ModalSolver, Modes, Step, hosts_of, no_hosts, scheme_of
from fastrod.solver.modal_response import ModalLinear
from fastrod.solver.state import Pose, Snapshot, State, check_on_robot
from fastrod.solver.statics import Statics
from fastrod.solver.stepper import PassShapes, TimeStepper, copied
from fastrod.solver.tape import Cost, Gradient, Tape
from fastrod.types import Flags, Floats, Ints, Ports, RodShape

_TOLERANCE = 1e-9  # m: of the rest from which a motion starts


class Moving(NamedTuple):
    """Memory of rods of modes."""

    motion: ModalMotion
    change: dict[str, Floats]
    """(n_robots,) by how much each input changed at the last step."""
    scheme: int | None
    """That the motion is remembered for; None at rest."""


def checked_mobility(inverse_inertia: ArrayLike, n_robots: int) -> Floats:
    """(n_robots, 6, 6) inverse inertia of bodies at a point. Raises `InputError` for what is none."""
    try:
        given = np.array(inverse_inertia, dtype=float)
    except (TypeError, ValueError):
        given = np.empty(0)
    if given.shape not in ((6, 6), (n_robots, 6, 6)) or not np.isfinite(given).all():
        raise InputError(
            f"inverse_inertia has shape {given.shape}; give (6, 6) or ({n_robots}, 6, 6) finite numbers: "
            "linear and angular acceleration of the base by force and moment, world."
        )
    size, even = np.abs(given).max(), 0.5 * (given + np.swapaxes(given, -1, -2))
    if np.abs(given - even).max() > 1e-6 * size or np.linalg.eigvalsh(even).min() < -1e-6 * size:
        raise InputError(
            "inverse_inertia is not symmetric with eigenvalues of 0 or more; for a free body of mass m and "
            "inertia J about its centre at the base it is diag(1/m, 1/m, 1/m, inv(J))."
        )
    return np.array(np.broadcast_to(even, (n_robots, 6, 6)))


class Motions(Statics):
    """Robots of one layout, from one step to the next, by the solver that was chosen."""

    _modal: ModalSolver | None = None
    dynamics = False
    """The rods have inertia: a step moves them on by `dt`."""
    _stepper: TimeStepper
    _moved: MotionShape | None = None  # what the last pass wrote beside the shape
    _tape: Tape | None = None
    _events: list[Event]  # of the call that is recorded
    _errors: Floats | None = None  # of the last step, where they are asked for
    _host: ModalHost | None = None  # of the last step, where bodies gave way

    def _use_modes(self, dynamics: bool, scheme: str, rho: float, modes: Modes | None) -> None:
        """Take rods of modes. Raises `InputError` for a scheme that there is not, and where a robot has no
        mass for `dynamics`."""
        if self._layout.paper:
            raise InputError("mode 'paper' has no energy, and so no modes; take solver='observer'.")
        self.dynamics = bool(dynamics)
        if self.dynamics:
            for robot in self.robots:
                for k, segment in enumerate(robot.segments):
                    if not segment.line_density > 0.0:
                        raise InputError(
                            f"segment {k + 1} of {robot.name!r} has line_density 0 kg/m, and dynamics=True "
                            "needs a mass; give it one."
                        )
        self.modes = modes or (Modes(4, 2) if self.dynamics else Modes(6, 4))
        self._events = []
        self._modal = ModalSolver(
            self.robots, self._layout, self._plain, self.n_robots, self._passes.threads, self.modes
        )
        self._stepper = TimeStepper(self._modal, Step(scheme_of(scheme, rho), self.dt, float(rho)))

    def _spend(self, passes: object, error: bool) -> None:
        """Take so many Newton steps in every step, and with `error` measure how far off it is. Raises
        `InputError`."""
        if error and not self.dynamics:
            raise InputError("estimate_error is of steps in time; give Simulator(robot, dynamics=True).")
        self._errors = np.full(self.n_robots, np.nan) if error else None
        if not isinstance(passes, (int, np.integer)) or not 1 <= passes <= 100:
            raise InputError(f"passes is {shown(passes)}; give a whole number from 1 to 100.")
        if self._modal is not None:
            time = self._stepper.time
            self._stepper.time = time._replace(passes=int(passes), dt=self.dt)  # a host may change dt
        elif passes != 1:
            raise InputError(f"passes is {passes!r}; the observer takes one a step, as settle takes many.")

    def _free_bases(self, inverse_inertia: ArrayLike | None) -> None:
        """In the next step bodies of this inverse inertia carry the bases. Raises `InputError`."""
        self._host = None
        if inverse_inertia is None:
            return
        if self._modal is None or not self.dynamics:
            raise InputError("inverse_inertia needs rods with inertia; give Simulator(robot, dynamics=True).")
        if self.outputs != "full" or self._errors is not None or self._tape is not None:
            raise InputError(
                "inverse_inertia needs outputs='full', and goes neither with estimate_error nor with "
                "record()."
            )
        given = checked_mobility(inverse_inertia, self.n_robots)
        self._host = hosts_of(given, float(np.max(self._passes.params.rod_length)))

    def set_in_motion(self, base_twist: ArrayLike, rows: ArrayLike | None = None) -> None:
        """Let robots that were brought to rest move on with their bases as rigid bodies, at `base_twist` (6,)
        or (n_robots, 6): velocity of the base point [m/s] and angular velocity [rad/s], world. `rows`:
        indices or a mask, all without it. Raises `InputError` without `dynamics`, and before the first
        state."""
        self._last("set_in_motion")
        if (modal := self._modal) is None or not self.dynamics:
            raise InputError("set_in_motion needs rods with inertia; give Simulator(robot, dynamics=True).")
        twist = np.asarray(base_twist, float)
        if twist.shape not in ((6,), (self.n_robots, 6)) or not np.isfinite(twist).all():
            raise InputError(
                f"base_twist has shape {twist.shape}; give (6,) or ({self.n_robots}, 6) finite numbers: "
                "velocity [m/s] and angular velocity [rad/s], world."
            )
        some = self._all if rows is None else np.flatnonzero(robot_mask(rows, self.n_robots))
        some = some[self._warm[some]]
        self._stepper.begun[some] = True
        modal.set_in_motion(
            some, np.broadcast_to(twist, (self.n_robots, 6))[some], self._stepper.time.scheme, self.dt
        )

    def momentum(self) -> Floats:
        """(n_robots, 6) linear [kg m/s], then angular momentum about the origin [kg m^2/s], of rods in
        motion, world. Raises `InputError` without `dynamics`, and before the first state."""
        _, ports = self._last("momentum")
        if (modal := self._modal) is None or not self.dynamics:
            raise InputError("momentum needs rods with inertia; give Simulator(robot, dynamics=True).")
        mass = modal.derive(np.flatnonzero(self._warm), ports, wanted=("number",)).inertia
        return modal.momentum(mass)

    def apparent_stiffness(self) -> Floats:
        """(n_robots, 6, 6) by how much force and moment about the base point, which the rod exerts on its
        base at the end of the last step, fall per displacement [m] and rotation [rad] of the base there,
        world: H_bb - H_bq H_qq^-1 H_qb, inertia and all, and half the moment's own rotation, by which it is
        not symmetric. It is that of the shape before the last Newton step: to rounding with more `passes`.
        Raises `InputError` but after a step with `inverse_inertia`; nan for robots that took none."""
        state, _ = self._last("apparent_stiffness")
        if self._host is None:
            raise InputError("apparent_stiffness is of a step with inverse_inertia; give it to step.")
        stiffness = self._host.stiffness.copy()
        stiffness[:, 3:, 3:] += 0.5 * np.cross(np.eye(3), state.base_wrench[:, None, 3:])
        return stiffness

    def _moved_bases(self, ports: Ports, found: PassShapes) -> Ports:
        """The ports with bases where the bodies have come to."""
        if (host := self._host) is None:
            return ports
        alone = np.isnan(host.wrench[:, 0])  # at rest, or in shorter steps
        host.wrench[alone] = found.shape.base_wrench[alone]
        pose = np.array(np.broadcast_to(ports.base_pose, (self.n_robots, 7)))
        pose[:, :3] += host.moved[:, :3]
        pose[:, 3:] = product(quaternion_from_vector(host.moved[:, 3:]), pose[:, 3:])
        return ports._replace(base_pose=pose)

    def _step(self, given: Inputs, moved: tuple[Any, Any] | None, derive: bool) -> State:
        if (modal := self._modal) is None:
            return super()._step(given, moved, derive)
        before = self._ports
        ports, rows = self._read(given)
        self._move_obstacles(moved)
        self._prepare(modal, ports)
        cold = rows if not self.dynamics else rows[~self._warm[rows]]
        warm = rows[self._warm[rows]] if self.dynamics else rows[:0]
        found, ok = self._new_shapes(modal, len(rows) < self.n_robots), np.zeros(self.n_robots, bool)
        if len(cold):
            ok[cold] = self._stepper.rest(cold, cold[~self._warm[cold]], ports, found, _TOLERANCE)
        modal.host = no_hosts() if self._host is None else self._host
        if len(warm) and before is not None:
            start = copied(modal.motion) if self._errors is not None else None
            inputs, jump = (before, ports), self._stepper.jumps(before, ports)
            ok[warm] = self._stepper.advance(warm, inputs, jump, found)
            if start is not None:
                tip, other = found.shape.tip_position, self._new_shapes(modal, True)
                self._errors = self._stepper.errors(warm[ok[warm]], inputs, jump, start, tip, other)
        modal.host = no_hosts()
        self._note_call(modal)
        return self._finish_modes(modal, self._moved_bases(ports, found), found, ok, rows, None)

    def _settle(self, ports: Ports, rows: Ints, tolerance: float, only: Flags | None = None) -> State:
        if (modal := self._modal) is None:
            return super()._settle(ports, rows, tolerance, only)
        self._prepare(modal, ports)
        found, ok = self._new_shapes(modal, len(rows) < self.n_robots), np.zeros(self.n_robots, bool)
        ok[rows] = self._stepper.rest(rows, rows[~self._warm[rows]], ports, found, tolerance)
        self._errors = self._host = None
        self._note_call(modal)
        return self._finish_modes(modal, ports, found, ok, rows, only)

    def _step_compliance(self) -> Floats | None:
        """In motion the tip is where it was a step ago: nothing gives to a force within the step."""
        if self.dynamics and self._warm.any():
            return np.zeros((self.n_robots, 3, 3))
        return super()._step_compliance()

    def _use_numbers(self, robot: Robot | None) -> None:
        if self._modal is not None and robot is not None:
            self._modal.replace((robot,))

    def _prepare(self, modal: ModalSolver, ports: Ports) -> None:
        """Prepare what a pass reads beside the ports."""
        modal.params = self._passes.params
        gravity = modal.gravity if self._reader.gravity is None else self._reader.gravity
        modal.pieces = modal.pieces._replace(gravity=gravity)
        modal.place_points(*self._reader.loads, ports.extension)

    def _new_shapes(self, modal: ModalSolver, holes: bool) -> PassShapes:
        return PassShapes(self._passes.new_shape(self.outputs, holes), modal.new_motion_shape(self.outputs))

    def record(self) -> Tape:
        """Record every call from now on, for its derivatives: `Tape.forward` and `adjoint`. A recorded
        step ends when Newton's method does, and takes some times as long. `restore` and `replace` end the
        recording. Raises `InputError` without rods of modes."""
        if (modal := self._modal) is None:
            raise InputError("record needs rods of modes; give Simulator(robot, solver='modal').")
        twin = ModalSolver(self.robots, self._layout, self._plain, self.n_robots, 1, modal.modes)
        self._tape, self._stepper.note = Tape(self.robots, twin, self._stepper.time.scheme), self._note
        return self._tape

    def adjoint(self, cost: Cost, parameters: Sequence[str] = (), inputs: Sequence[str] = ()) -> Gradient:
        """Derivatives of `cost` of the tips' motion since `record()`, by the inputs of every call (without
        names by `tendon_length`) and by numbers of the robots such as "segment.1.line_density"
        (`Tape.adjoint`). Raises `InputError` where nothing is recorded, and for names that there are
        not."""
        if self._tape is None:
            raise InputError("adjoint needs a recording; call record() before the first call of it.")
        return self._tape.adjoint(cost, parameters, inputs or ("tendon_length",))

    def _note(self, rows: Ints, ports: Ports, how: Step, jumped: bool, before: ModalMotion) -> None:
        """Record what was solved for these robots."""
        if (modal := self._modal) is not None and len(rows):
            acting = Acting.of(modal, self._given, ports, self._reader.loads)
            self._events.append(
                Event(rows.copy(), jumped, how, acting, copied(before), modal.motion.q.copy())
            )

    def _note_call(self, modal: ModalSolver) -> None:
        if self._tape is not None:
            if self._stepper.divided:
                self._tape.broken = "a robot took shorter steps in this recording; give a smaller dt."
            self._tape.add(self._events, modal.motion)
            self._events = []

    def _stop_recording(self) -> None:
        self._tape, self._stepper.note = None, None

    def _finish_modes(
        self, modal: ModalSolver, ports: Ports, found: PassShapes, ok: Flags, rows: Ints, only: Flags | None
    ) -> State:
        """The state, with what moves; lost robots and those that are left out keep what they had."""
        iterations = np.where(ok, np.abs(modal.iterations), -1)
        if only is not None:
            iterations[~only] = 0
        before, keeps, (shape, motion) = self._state, ~ok, found
        if before is not None and before.velocity is not None and keeps.any():
            motion = MotionShape(
                *(merge_rows(a, getattr(before, name), keeps) for name, a in motion._asdict().items())
            )
        self._moved = motion
        reason = "Newton's method found no rest" if not self.dynamics else "Newton's method did not end"
        return self._finish(
            ports, shape, ok, iterations, reason, Problem.NOT_CONVERGED, rows[~ok[rows]], only
        )

    def _return_state(self, shape: RodShape, ok: Flags, passes: Ints, problems: dict[int, str]) -> State:
        state = super()._return_state(shape, ok, passes, problems)
        if self._moved is not None:
            mean = None if self._host is None else self._host.wrench.copy()
            moved = self._moved._asdict() | {"step_error": self._errors, "mean_wrench": mean}
            self._state = state = replace(state, **moved)
        return state

    def _unstable(self, ports: Ports, shape: RodShape, rows: Ints) -> Ints:
        # what Newton's method finds on an energy is a minimum
        return super()._unstable(ports, shape, rows) if self._modal is None else rows[:0]

    def snapshot(self) -> Snapshot:
        """A copy of everything that a later step depends on."""
        found = super().snapshot()
        if self._modal is None:
            return found
        scheme = self._stepper.time.scheme if self.dynamics else None
        return found._replace(moving=Moving(copied(self._modal.motion), dict(self._stepper.change), scheme))

    def restore(self, snapshot: Snapshot, rows: ArrayLike | None = None) -> None:
        """Go back to a `snapshot` of this simulator, or only these robots: indices or a mask. Robots that
        were replaced since keep their numbers, and take over the shape alone; a whole simulator of which some
        were replaced is refused. Raises `InputError` then, and for a snapshot of another simulator."""
        modal, moving = self._modal, getattr(snapshot, "moving", None)
        if isinstance(snapshot, Snapshot) and (modal is None) != (moving is None):
            raise InputError("the snapshot is of another simulator; its solver differs.")
        if modal is None or moving is None:
            super().restore(snapshot, rows)
            return
        if [a.shape for a in moving.motion] != [a.shape for a in modal.motion]:
            raise InputError("the snapshot is of another simulator; its modes or robots differ.")
        if moving.scheme != (self._stepper.time.scheme if self.dynamics else None):
            raise InputError("the snapshot is of another simulator; its scheme differs, or its dynamics.")
        if snapshot.state is not None and snapshot.state.velocity is not None:
            mask = np.ones(self.n_robots, bool) if rows is None else robot_mask(rows, self.n_robots)
            then = MotionShape(*(getattr(snapshot.state, name) for name in MotionShape._fields))
            now = then if self._moved is None else self._moved
            self._moved = MotionShape(*(merge_rows(a, b, mask) for a, b in zip(now, then, strict=True)))
        super().restore(snapshot, rows)
        self._stop_recording()
        which: Any = slice(None) if rows is None else robot_mask(rows, self.n_robots)
        for array, kept in zip(modal.motion, moving.motion, strict=True):
            array[which] = kept[which]
        for name in {*self._stepper.change, *moving.change}:
            zeros = np.zeros(self.n_robots)
            change = np.array(self._stepper.change.get(name, zeros))
            change[which] = moving.change.get(name, zeros)[which]
            self._stepper.change[name] = change

    def replace(self, rows: ArrayLike, robots: Sequence[Robot]) -> None:
        """Other robots in these rows (indices, one robot each): their numbers and the values of their
        effects. They begin cold, their effects at rest. Raises `RobotError` where counts, modes or effects
        differ from those here, and with effects or a contact scene where segments or tendons are elsewhere;
        `InputError` where rows and robots do not match."""
        super().replace(rows, robots)
        if self._modal is not None:
            self._modal.replace(self.robots)
            self._stop_recording()

    def _linear(self, ports: Ports) -> Any:
        if (modal := self._modal) is None:
            return super()._linear(ports)
        self._prepare(modal, ports)
        return ModalLinear(modal, np.flatnonzero(self._warm), ports, self._reader.loads)

    def frequencies(self, count: int = 3) -> Floats:
        """(n_robots, count) lowest natural frequencies [Hz] of small motions about the last state's shape,
        which should be a rest, undamped. Raises `InputError` without rods of modes or a mass, and before the
        first step."""
        _, ports = self._last("frequencies")
        if self._modal is None or not self.dynamics:
            raise InputError("frequencies needs inertia; give Simulator(robot, dynamics=True).")
        if not isinstance(count, (int, np.integer)) or count < 1:
            raise InputError(f"count is {shown(count)}; give a whole number, at least 1.")
        if count > (most := self._modal.motion.q.shape[1]):
            raise InputError(f"count is {shown(count)}; these rods have {most} unknowns: give more modes.")
        return np.asarray(self._linear(ports).frequencies(int(count)))

    def _full(self, what: str) -> State:
        state, _ = self._last(what)
        if self.outputs != "full":
            raise InputError(f"{what} needs Simulator(..., outputs='full'); this one keeps the tip only.")
        return state

    def _modal_shape(self, state: State, arclength: ArrayLike) -> Pose:
        """Pose and curvature at any arclength: between two nodes the curvature is linear, the backbone
        Hermite's cubic through both, fourth order in their distance."""
        s = arclengths(arclength, self.n_robots)
        check_on_robot(s, state)
        node = np.clip((s[:, :, None] >= state.arclength[:, None, 1:-1]).sum(2), 0, self.n_points - 2)
        robot = self._all[:, None]
        first, last = (state.arclength[robot, node + k] for k in range(2))
        h = last - first
        t = ((s - first) / h)[..., None]
        u0, u1 = (state.curvature[robot, node + k] for k in range(2))
        middle = u0 + 0.5 * t * (u1 - u0)
        turned = quaternion_from_vector((t * h[..., None] * middle).reshape(-1, 3))
        beyond = matrix_from_quaternion(turned).reshape(*s.shape, 3, 3)
        rotation = state.rotation[robot, node] @ beyond
        tangent = state.rotation[..., 2]
        if state.strain is not None:
            tangent = tangent + np.einsum("...ij,...j->...i", state.rotation, state.strain)
        t0, t1 = (h[..., None] * tangent[robot, node + k] for k in range(2))
        p0, p1 = (state.position[robot, node + k] for k in range(2))
        a, b = t * t * (3.0 - 2.0 * t), t * (1.0 - t)
        position = p0 + a * (p1 - p0) + b * ((1.0 - t) * t0 - t * t1)
        return Pose(position, rotation, u0 + t * (u1 - u0))


def refuse_with_modes(**given: bool) -> None:
    """Raise `InputError` for the first option that is given and that rods of modes do not take."""
    for name, some in given.items():
        if some:
            raise InputError(f"{name} was given with rods of modes, which do not take it; leave it out.")


def solver_of(
    robots: Sequence[Robot], solver: Literal["observer", "modal"] | None, dynamics: bool
) -> Literal["observer", "modal"]:
    """The solver of these robots: the observer, the faster one at rest, unless they need modes. Raises
    `InputError` for one that there is not, or that cannot do what is asked."""
    if solver not in (None, "observer", "modal"):
        why = nearest(str(solver), ("observer", "modal"))
        raise InputError(f"solver is {shown(solver)}; {why}")
    soft = next(
        (
            name
            for robot in robots
            for segment in robot.segments
            for name in ("axial_stiffness", "shear_stiffness", "lumps")
            if (segment.lumps if name == "lumps" else np.isfinite(getattr(segment, name)))
        ),
        None,
    )
    if solver == "observer" and (dynamics or soft):
        what = "dynamics=True" if dynamics else f"a robot with {soft}"
        raise InputError(f"solver is 'observer' with {what}, which needs solver='modal'.")
    return "modal" if dynamics or soft or solver == "modal" else "observer"
