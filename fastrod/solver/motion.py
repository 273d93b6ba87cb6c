"""`ModalRods`: rods of curvature modes, at rest or in motion, from one call to the next."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fastrod.checks import COUNT, Bound, check_number, checked_array
from fastrod.errors import InputError, Problem, shown
from fastrod.kernels.rod.modal.host import ModalHost
from fastrod.kernels.rod.modal.motion import ModalMotion
from fastrod.model.robot import Robot
from fastrod.rotation import displaced, matrix_from_quaternion, quaternion_from_vector
from fastrod.solver.boundary import new_shape
from fastrod.solver.inputs import Inputs, arclengths, checked_mobility
from fastrod.solver.modal import SCHEMES, ModalSolver, Step, hosts_of, mean_by_end, no_hosts
from fastrod.solver.modal_response import ModalLinear
from fastrod.solver.options import Modal, usual_modes
from fastrod.solver.protocol import Acting, How, Last, LinearResponse, Solved
from fastrod.solver.state import MOVING, Pose, State, check_on_robot
from fastrod.solver.stepper import PassShapes, TimeStepper, copied
from fastrod.solver.tape import Event, Tape, copied_acting
from fastrod.types import Flags, Floats, Ints, Layout, Params, Ports, RodShape

_TOLERANCE = 1e-9  # m: of the rest from which a motion starts
_PASSES = Bound(least=1, most=100)


class ModalMemory(NamedTuple):
    """Memory of rods of modes."""

    motion: ModalMotion
    change: dict[str, Floats]
    """(n_robots,) by how much each input changed at the last step."""
    scheme: int | None
    """That the motion is remembered for; None at rest."""


def checked_inertia(inverse_inertia: ArrayLike, n_robots: int) -> Floats:
    """(n_robots, 6, 6) inverse inertia of bodies at a point. Raises `InputError` for what is none."""
    says = "linear and angular acceleration of the base by force and moment, world"
    given = checked_mobility("inverse_inertia", inverse_inertia, [(6, 6), (n_robots, 6, 6)], says)
    return np.array(np.broadcast_to(given, (n_robots, 6, 6)))


class ModalRods:
    """Robots of one layout as rods of modes, and their motion (`Solver`)."""

    def __init__(
        self,
        options: Modal,
        robots: tuple[Robot, ...],
        layout: Layout,
        params: Params,
        n_robots: int,
        *,
        dt: float,
        outputs: Literal["full", "tip"],
        threads: int,
    ) -> None:
        """Raises `InputError` where a robot has neither mass nor damping for `dynamics`, or is of mode
        `paper`."""
        if layout.paper:
            raise InputError("mode 'paper' has no energy, and so no modes; take solver='observer'.")
        for robot in robots if options.dynamics else ():
            for k, segment in enumerate(robot.segments):
                if not segment.line_density + segment.damping_time > 0.0:
                    raise InputError(
                        f"segment {k + 1} of {robot.name!r} has line_density 0 kg/m, and dynamics=True "
                        "needs a mass; give it one, or a damping_time [s] to move without."
                    )
        self.options, self.robots, self.outputs, self.threads = options, robots, outputs, threads
        self.dynamics, self.n_robots = options.dynamics, n_robots
        modes = options.modes or usual_modes(robots, coarse=self.dynamics)
        self.modal = ModalSolver(robots, layout, params, n_robots, threads, modes)
        time = Step(SCHEMES[options.scheme], dt, float(options.rho))
        self.stepper = TimeStepper(self.modal, time, options.jumps)
        self.tape: Tape | None = None
        self._events: list[Event] = []  # of the call that is recorded
        self._acting: Acting | None = None
        self._errors: Floats | None = None  # of the last step, where they are asked for
        self._host: ModalHost | None = None  # of the last step, where bodies gave way
        self._mean = np.ones(n_robots)  # of the last step's acceleration at its end in its mean

    def accept(self, given: Inputs, how: How | None) -> None:
        """Take the time step and its Newton steps, and the bodies that carry the bases. Raises
        `InputError`."""
        if how is None:
            return
        if how.estimate_error and not self.dynamics:
            raise InputError("estimate_error is of steps in time; give Simulator(robot, dynamics=True).")
        check_number("passes", how.passes, _PASSES, whole=True)
        errors = np.full(self.n_robots, np.nan) if how.estimate_error else None
        host = None if how.inverse_inertia is None else self._freed(how.inverse_inertia, errors is not None)
        self._errors, self._host = errors, host
        self.stepper.time = self.stepper.time._replace(passes=int(how.passes), dt=how.dt)
        self._mean[:] = mean_by_end(self.stepper.time)

    def _freed(self, inverse_inertia: ArrayLike, estimates: bool) -> ModalHost:
        """Bodies of this inverse inertia that carry the bases in the next step."""
        if not self.dynamics:
            raise InputError("inverse_inertia needs rods with inertia; give Simulator(robot, dynamics=True).")
        if self.outputs != "full" or estimates or self.tape is not None:
            raise InputError(
                "inverse_inertia needs outputs='full', and goes neither with estimate_error nor with "
                "record()."
            )
        given = checked_inertia(inverse_inertia, self.n_robots)
        return hosts_of(given, float(np.max(self.modal.params.rod_length)))

    def new_shape(self, outputs: Literal["full", "tip"], holes: bool) -> RodShape:
        """Return room for a shape."""
        return new_shape(self.modal.layout, self.n_robots, outputs, holes)

    def remember(self, ports: Ports, pulled: bool, last: Last) -> None:
        """Modes remember the same whatever acts."""

    def _take(self, acting: Acting) -> None:
        self._acting = acting
        self.modal.take(acting)

    def _room(self, holes: bool) -> PassShapes:
        return PassShapes(self.new_shape(self.outputs, holes), self.modal.new_motion_shape(self.outputs))

    def step(self, rows: Ints, acting: Acting, last: Last, how: How) -> Solved:
        """Move these robots on by dt, or bring them to rest."""
        modal, stepper, before, ports = self.modal, self.stepper, last.ports, acting.ports
        self._take(acting)
        cold = rows[~last.warm[rows]] if self.dynamics else rows
        warm = rows[last.warm[rows]] if self.dynamics else rows[:0]
        found, ok = self._room(len(rows) < self.n_robots), np.zeros(self.n_robots, bool)
        if len(cold):
            ok[cold] = stepper.rest(cold, cold[~last.warm[cold]], ports, found, _TOLERANCE)
        modal.host = no_hosts() if self._host is None else self._host
        if len(warm) and before is not None:
            start = copied(modal.motion) if self._errors is not None else None
            inputs, jump = (before, ports), stepper.jumps(before, ports)
            ok[warm] = stepper.advance(warm, inputs, jump, found)
            if start is not None:
                tip, other = found.shape.tip_position, self._room(True)
                self._errors = stepper.errors(warm[ok[warm]], inputs, jump, start, tip, other)
        modal.host = no_hosts()
        return self._solved(rows, found, ok, self._moved_bases(ports, found))

    def settle(self, rows: Ints, acting: Acting, last: Last, tolerance: float) -> Solved:
        """Bring these robots to rest, to `tolerance` [m] at the tip."""
        self._take(acting)
        found, ok = self._room(len(rows) < self.n_robots), np.zeros(self.n_robots, bool)
        ok[rows] = self.stepper.rest(rows, rows[~last.warm[rows]], acting.ports, found, tolerance)
        self._errors = self._host = None
        return self._solved(rows, found, ok, acting.ports)

    def _solved(self, rows: Ints, found: PassShapes, ok: Flags, ports: Ports) -> Solved:
        if self.tape is not None:
            if self.stepper.divided:
                self.tape.broken = "a robot took shorter steps in this recording; give a smaller dt."
            self.tape.add(self._events, self.modal.motion)
            self._events = []
        reason = "Newton's method did not end" if self.dynamics else "Newton's method found no rest"
        mean = None if self._host is None else self._host.wrench.copy()
        moving = {name: getattr(found.motion, name) for name in MOVING}
        moving |= {"step_error": self._errors, "mean_wrench": mean}
        passes = np.zeros(self.n_robots, np.int64)
        passes[rows] = np.where(ok[rows], np.abs(self.modal.iterations[rows]), -1)
        return Solved(found.shape, ok, passes, ports, reason, Problem.NOT_CONVERGED, moving=moving)

    def _moved_bases(self, ports: Ports, found: PassShapes) -> Ports:
        """The ports with bases where the bodies have come to."""
        if (host := self._host) is None:
            return ports
        alone = np.isnan(host.wrench[:, 0])  # at rest, or in shorter steps
        host.wrench[alone] = found.shape.base_wrench[alone]
        pose = np.broadcast_to(ports.base_pose, (self.n_robots, 7))
        return ports._replace(base_pose=displaced(pose, host.moved))

    def response(self, acting: Acting, warm: Flags) -> LinearResponse:
        """Return the linear response of the last shape."""
        return self.linear(acting, warm)

    def linear(self, acting: Acting, warm: Flags) -> ModalLinear:
        """Return the linear response of the last shape, frequencies included."""
        self._take(acting)
        return ModalLinear(self.modal, np.flatnonzero(warm), acting.ports, acting.points)

    def tip_compliance(self, acting: Acting, warm: Flags, *, in_step: bool) -> Floats:
        """(n_robots, 3, 3) by how much the tip gives to a force [m/N]: in motion, where it was a step ago,
        nothing does within the step."""
        if self.dynamics and in_step:
            return np.zeros((self.n_robots, 3, 3))
        return np.asarray(self.linear(acting, warm).by_load())[:, :3, :3]

    def unstable(self, acting: Acting, shape: RodShape, rows: Ints) -> Ints:
        """None: what Newton's method finds on an energy is a minimum."""
        return rows[:0]

    def replace(self, robots: Sequence[Robot]) -> None:
        """Take other robots of the same layout; a recording ends."""
        self.robots = tuple(robots)
        self.modal.replace(self.robots)
        self._stop_recording()

    def snapshot(self) -> ModalMemory:
        """Return a copy of the memory."""
        return ModalMemory(copied(self.modal.motion), dict(self.stepper.change), self._remembered_for)

    @property
    def _remembered_for(self) -> int | None:
        return self.stepper.time.scheme if self.dynamics else None

    def check(self, kept: object) -> None:
        """Raise `InputError` where this is the memory of other rods."""
        if not isinstance(kept, ModalMemory):
            raise InputError(
                "the snapshot is of another simulator; its solver differs, or its contact scene."
            )
        if [a.shape for a in kept.motion] != [a.shape for a in self.modal.motion]:
            raise InputError("the snapshot is of another simulator; its modes or robots differ.")
        if kept.scheme != self._remembered_for:
            raise InputError("the snapshot is of another simulator; its scheme differs, or its dynamics.")

    def restore(self, kept: ModalMemory, rows: Flags | None, acting: Acting | None, then: Last) -> None:
        """Go back to a memory, or in these robots alone; a recording ends."""
        self._stop_recording()
        which: Any = slice(None) if rows is None else rows
        for array, old in zip(self.modal.motion, kept.motion, strict=True):
            array[which] = old[which]
        for name in {*self.stepper.change, *kept.change}:
            zeros = np.zeros(self.n_robots)
            change = np.array(self.stepper.change.get(name, zeros))
            change[which] = kept.change.get(name, zeros)[which]
            self.stepper.change[name] = change

    def set_in_motion(self, base_twist: ArrayLike, rows: Ints) -> None:
        """Let these robots, at rest, move on as `Simulator.set_in_motion` says."""
        says = "velocity [m/s] and angular velocity [rad/s], world"
        twist = checked_array("base_twist", base_twist, [(6,), (self.n_robots, 6)], says)
        self.stepper.begun[rows] = True
        every, time = np.broadcast_to(twist, (self.n_robots, 6)), self.stepper.time
        self.modal.set_in_motion(rows, every[rows], time.scheme, time.dt)

    def momentum(self, acting: Acting, warm: Flags) -> Floats:
        """(n_robots, 6) as `Simulator.momentum`."""
        mass = self.modal.derive(np.flatnonzero(warm), acting.ports, wanted=("number",)).inertia
        return self.modal.momentum(mass)

    def apparent_stiffness(self, state: State, mean: bool) -> Floats:
        """(n_robots, 6, 6) as `Simulator.apparent_stiffness`."""
        if self._host is None:
            raise InputError("apparent_stiffness is of a step with inverse_inertia; give it to step.")
        stiffness = self._host.stiffness.copy()
        stiffness[:, 3:, 3:] += 0.5 * np.cross(np.eye(3), state.base_wrench[:, None, 3:])
        return self._mean[:, None, None] * stiffness if mean else stiffness

    def frequencies(self, count: Any, acting: Acting, warm: Flags) -> Floats:
        """(n_robots, count) as `Simulator.frequencies`."""
        check_number("count", count, COUNT, whole=True)
        if count > (most := self.modal.motion.q.shape[1]):
            raise InputError(f"count is {shown(count)}; these rods have {most} unknowns: give more modes.")
        return np.asarray(self.linear(acting, warm).frequencies(int(count)))

    def record(self) -> Tape:
        """Record every call from now on."""
        modal = self.modal
        twin = ModalSolver(self.robots, modal.layout, modal.params, self.n_robots, 1, modal.modes)
        self.tape, self.stepper.note = Tape(self.robots, twin, self.stepper.time.scheme), self._note
        return self.tape

    def _stop_recording(self) -> None:
        self.tape, self.stepper.note = None, None

    def _note(self, rows: Ints, ports: Ports, how: Step, jumped: bool, before: ModalMotion) -> None:
        """Record what was solved for these robots."""
        if self._acting is not None and len(rows):
            acting = copied_acting(self.modal, self._acting._replace(ports=ports))
            self._events.append(
                Event(rows.copy(), jumped, how, acting, copied(before), self.modal.motion.q.copy())
            )


def pose_at(state: State, arclength: ArrayLike) -> Pose:
    """Pose and curvature of rods of modes at any arclength: between two nodes the curvature is linear, the
    backbone Hermite's cubic through both, fourth order in their distance."""
    s = arclengths(arclength, len(state.ok))
    check_on_robot(s, state)
    node = np.clip((s[:, :, None] >= state.arclength[:, None, 1:-1]).sum(2), 0, state.position.shape[1] - 2)
    robot = np.arange(len(state.ok))[:, None]
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
