"""`Rod`: rods for any physics engine: the base's motion in, capsules and the wrench on the base out. It knows
no engine."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.checks import Bound, check_number, checked_array, checked_pose
from fastrod.contact import ContactScene
from fastrod.contact.frames import between
from fastrod.errors import HostError, InputError, RobotError, nearest, refuse_masked, shown
from fastrod.hosts.capsules import Capsules, along, moved
from fastrod.hosts.host import Freedom, Motion
from fastrod.model.robot import Robot
from fastrod.rotation import quaternion_from_matrix
from fastrod.simulator import Simulator
from fastrod.solver.inputs import Inputs
from fastrod.solver.merge import merge_shape
from fastrod.solver.motion import checked_inertia
from fastrod.solver.options import Modal, Modes
from fastrod.solver.state import Snapshot, State
from fastrod.types import Flags, Floats, Ints

INPUTS = tuple(name for name in Inputs._fields if name != "base_pose")
"""Inputs of a rod beside its base: keyword arguments of `Simulator.step`."""
OBSTACLES = ("obstacle_pose", "obstacle_velocity")
"""Inputs of rods with a contact scene."""
Given = dict[str, Any]  # inputs by name
_PATIENCE = 2  # steps that fail before a rod in contact settles anew
_MOST_FAILED = 25
_MOST_SUBSTEPS = 100_000
# pose, velocity, inverse inertia and free velocity of a base whose own are of no use
_STANDS = (np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), np.zeros(6), np.zeros((6, 6)), np.zeros(6))


class RodSnapshot(NamedTuple):
    """State of a rod: everything that a later `Rod.advance` depends on."""

    simulator: Snapshot
    time: float
    state: State | None
    wrench: Floats
    """(n_robots, 6) on the base, world [N, N m]."""
    base: Floats
    """(n_robots, 7) pose of the base, world."""
    inputs: Given
    obstacles: dict[str, Floats]
    """Name -> (1 or n_robots, 7) pose as it was given last, world."""
    capsules: Capsules | None
    failed: Ints
    """(n_robots,) the rod's own steps in a row that could not be solved."""
    fresh: Flags
    """(n_robots,) robots that settle before the next step."""
    still: Flags
    """(n_robots,) robots that came to rest: they begin with their base's motion."""


@final
class Rod:
    """A robot on a base that another engine moves, or several on a base each.

    The rod's weight is that in the `gravity` (3,) that the engine gives, world [m/s^2]; in the robot's own
    until then.

    With `n_robots` every array has a robot axis first; without it there is one rod and no such axis, but in
    `state`, which always has one. Inputs that are not given stay as they were given last; the tendons are
    those of the straight robot until then.

    >>> import fastrod
    >>> rod = fastrod.Rod(fastrod.load_robot("prototype"), dt=0.01)
    >>> state = rod.advance((0, 0, 0, 1, 0, 0, 0), (0, 0, 0, 0, 0, 0), 0.004, tip_force=(0.0, 0.1, 0.0))
    >>> rod.time, rod.wrench.round(6).tolist()[:3]
    (0.004, [0.0, 0.1, 0.0])
    """

    def __init__(
        self,
        robot: Robot,
        *,
        dt: float = 0.01,
        n_robots: int | None = None,
        contact: ContactScene | None = None,
        points_per_segment: int = 10,
        capsules_per_segment: int = 10,
        threads: int | None = 1,
        dynamics: bool = False,
        rho: float = 0.0,
        modes: Modes | None = None,
    ) -> None:
        """`dt`: the rod's longest step [s]; an engine's longer step is done in equal substeps. `contact`:
        what the rod feels. Capsules are as thick as contact has the rod. With `dynamics` the rod has its
        inertia (`Simulator`), in the wrench as well; after `settle` it is at rest on its base, and begins
        with its motion. Its scheme is generalized-alpha, which takes steps of any length. Raises
        `InputError`, `RobotError`."""
        check_robot(robot)
        if isinstance(n_robots, bool):
            raise InputError(
                f"n_robots is {n_robots}; give how many rods there are, or None for one without a robot axis."
            )
        if contact is not None and not isinstance(contact, ContactScene):
            raise InputError(
                f"contact is {shown(contact)}; give fastrod.contact.ContactScene(obstacles=[...]) or None."
            )
        if (
            not isinstance(capsules_per_segment, (int, np.integer))
            or capsules_per_segment < 1
            or (
                isinstance(points_per_segment, (int, np.integer))
                and points_per_segment % capsules_per_segment
            )
        ):
            raise InputError(
                f"{capsules_per_segment} capsules for {points_per_segment} points of a "
                "segment; give a divisor of the points."
            )
        if contact is not None and contact.worlds is not None:
            raise InputError(
                "ContactScene.worlds puts several rods into one world; a Rod is alone in its "
                "own: leave worlds out."
            )
        self.simulator = Simulator(
            robot,
            1 if n_robots is None else n_robots,
            dt,
            points_per_segment,
            threads=threads,
            contact=contact,
            solver=_modal(dynamics, rho, modes),
        )
        """Its `jacobian`, `compliance`, `shape` are those of the last state."""
        self.dt = self.simulator.dt
        """Longest step of the rod [s]."""
        self.robot = self.simulator.robots[0]
        self.n_robots = n_robots
        self._weighs = any(s.line_density > 0.0 or s.lumps for s in robot.segments)
        self._nodes_per_capsule = points_per_segment // capsules_per_segment
        radius = (contact or ContactScene()).radius_of(robot)
        self.radius: Floats = np.repeat(radius, capsules_per_segment)
        """(n_capsules,) [m]."""
        self.time = 0.0
        """The rod's clock: the sum of the engine's steps [s]."""
        by_length = any(segment.mode in ("tendon_length", "paper") for segment in robot.segments)
        self._inputs: Given = {"tendon_length": np.array(robot.rest_tendon_length)} if by_length else {}
        self._home: Floats = np.array([*robot.base_position, *robot.base_quaternion], float)
        self._obstacles: dict[str, Floats] = {}
        self._state: State | None = None
        self._capsules: Capsules | None = None
        self._wrench: Floats = np.zeros((self.simulator.n_robots, 6))
        self._base: Floats = np.tile(self._home, (self.simulator.n_robots, 1))
        self._failed: Ints = np.zeros(self.simulator.n_robots, np.int64)
        self._fresh: Flags = np.zeros(self.simulator.n_robots, bool)
        self._still: Flags = np.ones(self.simulator.n_robots, bool)

    @property
    def state(self) -> State:
        """After the last step. Raises `InputError` before the first."""
        found: State = self._there(self._state)
        return found

    @property
    def capsules(self) -> Capsules:
        """The body after the last step. Raises `InputError` before the first."""
        found: Capsules = self._there(self._capsules)
        return Capsules(*(self._one(a) for a in found))

    @property
    def wrench(self) -> Floats:
        """(6,) force [N], then moment about the base point [N m], that the rod exerts on its base, world;
        zero before the first step. Where the base gives way (`inverse_inertia`) it is the mean over the
        step, about where the base point was before it."""
        return self._one(self._wrench)

    @property
    def stiffness(self) -> Floats:
        """(6, 6) by how much `wrench` falls by displacement [m] and rotation [rad] of a base that gave way in
        the last step: more of its motion within that step. Raises `InputError` for one that did not."""
        if self.state.mean_wrench is None:
            raise InputError("stiffness is of a base that gave way; give inverse_inertia to advance().")
        found = self.simulator.apparent_stiffness(mean=True)
        return self._one(0.5 * (found + found.swapaxes(1, 2)))

    @property
    def base(self) -> Floats:
        """(7,) pose of the base that the shape belongs to: where the engine's step is expected to end."""
        return self._one(self._base)

    @property
    def failed(self) -> int:
        """The rod's own steps in a row that could not be solved; 0 after one that could. Of several rods the
        most."""
        return int(self._failed.max())

    @property
    def failures(self) -> Ints:
        """(n_robots,) `failed` of each rod, n_robots 1 where there is one."""
        return self._failed.copy()

    def settle(self, base_pose: ArrayLike | None = None, **inputs: Any) -> State:
        """At rest on a base at rest, (7,) position [m] and quaternion w x y z, world; the robot file's own if
        left out. Inputs as for
        `advance`; the clock stands still. Raises `InputError`, and `HostError` where nothing finite is found;
        then nothing has changed."""
        given, around = self._sorted(inputs)
        base = self._home if base_pose is None else self._poses(base_pose)
        before = self.snapshot()
        try:
            return self._settled(base, given, around)
        except Exception:
            self.restore(before)
            raise

    def advance(
        self,
        base_pose: ArrayLike,
        base_twist: ArrayLike,
        time_step: float,
        *,
        inverse_inertia: ArrayLike | None = None,
        free_twist: ArrayLike | None = None,
        **inputs: Any,
    ) -> State:
        """Return the rod at the end of the engine's next step of `time_step` [s].

        `base_pose` (7,) where the base is before the step, position [m] and quaternion w x y z, world;
        `base_twist` (6,) velocity of its origin [m/s] and angular velocity [rad/s], world, at which it is
        taken to continue. Inputs as for `Simulator.step`: `INPUTS`, and `obstacle_pose` and
        `obstacle_velocity` at the end of the step where there is a contact scene. Base and obstacles move
        there in the rod's own steps.

        A base that gives way: `inverse_inertia` (6, 6), J M^-1 J^T of the engine at the base point, its
        linear and angular acceleration by force and moment, world; `free_twist` (6,) its velocity at the
        step's end if there were no rod, `base_twist` if left out. The rod and its base then move together,
        stably at any ratio of masses, the rod in one step of `time_step`; one with mass needs `dynamics`.
        The engine is to feel `wrench` in this step, about the base point where it is before it.

        A step that cannot be solved (`state.ok` is false, and `state.problems` says why) leaves the rod where
        it stopped, with half the wrench of the engine's step before; after a few in a row the rod settles
        anew. Of several rods, each fails alone: one whose input cannot be used, or that is lost, keeps shape,
        capsules and base as well. Raises `InputError` for unusable input, `HostError` where all rods are
        lost, one was lost before it had a shape, or 25 steps in a row could not be solved of any rod; then
        nothing has moved.
        """
        n = self._substeps(time_step)
        motion, freedom = self._bases(base_pose, base_twist, inverse_inertia, free_twist)
        n = n if freedom is None else 1
        given, around = self._sorted(inputs)
        start, dt = self.snapshot(), self.simulator.dt
        try:
            return self._advanced(motion, given, around, time_step, n, freedom)
        except Exception:
            self.restore(start)
            self.simulator.dt = dt
            raise

    def _advanced(
        self, motion: Motion, given: Given, around: Given, time_step: float, n: int, freedom: Freedom | None
    ) -> State:
        wrench, free = self._wrench, motion if freedom is None else motion._replace(velocity=freedom.twist)
        h = time_step / n
        self._begin(motion, free, given, around, time_step, h)
        mobility = None if freedom is None or not self.simulator.dynamics else freedom.inverse_inertia
        for k in range(n):
            obstacles = self._obstacles_after(around, n - k) if n > 1 else around
            self._solved(free.after((k + 1) * h), given, obstacles, 0.5 * wrench, mobility)
        before, self._capsules = self._capsules, self._along(self.state)
        if before is not None:
            self._capsules = moved(before, self._capsules, time_step)
        self.time += time_step
        return self.state

    def start(self, motion: Motion, free_twist: Floats, time_step: float, **inputs: Any) -> None:
        """Let rods that have no shape yet, or were reset, begin on bases of this `motion`, which would have
        `free_twist` (6,) after the next step, of `time_step` [s], if there were no rod. Inputs as for
        `advance`, which does this by itself: this is for several rods on one body, which fall with it as if
        it had none of them. Raises as `advance`."""
        given, around = self._sorted(inputs)
        bases, before = Motion(np.atleast_2d(motion.pose), np.atleast_2d(motion.velocity)), self.snapshot()
        free = bases._replace(velocity=np.atleast_2d(free_twist))
        try:
            self._begin(bases, free, given, around, time_step, time_step)
        except Exception:
            self.restore(before)
            raise

    def _begin(
        self, motion: Motion, free: Motion, given: Given, around: Given, time_step: float, h: float
    ) -> None:
        """Rods that have no shape, or were reset, come to rest on their bases and move with them, in steps of
        `h` [s]."""
        moves = self.simulator.dynamics
        if self._state is None or self._fresh.any():
            begins = given
            if moves:  # at rest on its base, which may fall
                gravity, fall = self._fall(motion, free, given, time_step)
                weight = gravity - fall
                begins = given | {"gravity": weight if self.n_robots else weight[0]}
            settle = self._settled if self._state is None else self._settled_again
            settle(motion.pose, begins, around)
        self.simulator.dt = h
        if self._still.any() and moves:
            middle = np.array(np.broadcast_to(motion.velocity, self._wrench.shape))
            # an engine's velocity is that of the middle of its last step
            middle[:, :3] += 0.5 * time_step * self._fall(motion, free, given, time_step)[1]
            self.simulator.set_in_motion(middle, self._still)
        self._still[:] = False

    def reset(self, rows: ArrayLike | None = None) -> None:
        """Forget the rod's shape and its contacts, but not its inputs nor its clock: after the base was put
        somewhere else. The next step settles where the base then is. `rows`: indices or a mask of the rods
        that are reset, all without it; the others continue, and shapes and capsules of these are shown as
        they were until then. Raises `InputError` for what is no rows."""
        which = np.ones(self.simulator.n_robots, bool)
        self.simulator.reset(rows)
        if rows is not None:
            index, which = np.asarray(rows), ~which
            if index.size:
                which[index] = True
        if which.all():
            self._state = self._capsules = None
        self._fresh = self._fresh | which
        self._wrench = np.where(which[:, None], 0.0, self._wrench)
        self._failed = np.where(which, 0, self._failed)

    def snapshot(self) -> RodSnapshot:
        """A copy of everything that a later step depends on."""
        return RodSnapshot(
            self.simulator.snapshot(),
            self.time,
            self._state,
            self._wrench.copy(),
            self._base.copy(),
            dict(self._inputs),
            dict(self._obstacles),
            self._capsules,
            self._failed.copy(),
            self._fresh.copy(),
            self._still.copy(),
        )

    def restore(self, snapshot: RodSnapshot) -> None:
        """Go back to a `snapshot` of this rod. Raises `InputError` for that of another."""
        if not isinstance(snapshot, RodSnapshot):
            raise InputError(
                f"the snapshot is a {type(snapshot).__name__}; give what Rod.snapshot() returned."
            )
        self.simulator.restore(snapshot.simulator)
        self.time, self._state, self._capsules = snapshot.time, snapshot.state, snapshot.capsules
        self._failed, self._fresh = snapshot.failed.copy(), snapshot.fresh.copy()
        self._wrench, self._base = snapshot.wrench.copy(), snapshot.base.copy()
        self._still = snapshot.still.copy()
        self._inputs, self._obstacles = dict(snapshot.inputs), dict(snapshot.obstacles)

    def _settled(self, base: Floats, given: Given, around: Given) -> State:
        self._keep(
            self.simulator.settle(base_pose=base, **around, **given), given, around, base, 0.5 * self._wrench
        )
        self._fresh[:], self._still[:] = False, True
        self._capsules = self._along(self.state)
        return self.state

    def _settled_again(self, base: Floats, given: Given, around: Given) -> None:
        """Settle rods that were reset, while the others continue."""
        rows, going = self._fresh, self._wrench
        self._keep(self._anew(rows, base, given, around), given, around, base, going)
        self._wrench = np.where(rows[:, None], self._wrench, going)
        now = self._along(self.state)
        before = now if self._capsules is None else self._capsules
        self._capsules = Capsules(
            *(np.where(rows.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(now, before, strict=True))
        )
        self._fresh, self._still = rows & ~self.state.ok, self._still | rows

    def _solved(
        self, base: Floats, given: Given, around: Given, half: Floats, mobility: Floats | None
    ) -> None:
        """One step of the rod itself; `half` (n_robots, 6) the wrench of those that fail."""
        mobility = mobility if mobility is not None and mobility.any() else None
        state = self.simulator.step(base_pose=base, inverse_inertia=mobility, **around, **given)
        if mobility is not None:
            turned = quaternion_from_matrix(state.rotation[:, 0])
            base = np.concatenate([state.position[:, 0], turned], axis=1)
        again = ~state.ok & (state.passes != 0) & (self._failed >= _PATIENCE)
        felt = state.base_wrench if state.mean_wrench is None else state.mean_wrench
        if again.any():
            state = self._anew(again, base, given, around)
        self._keep(state, given, around, base, half)
        if again.any():  # the others felt what they did in their step
            self._wrench = np.where((state.ok & ~again)[:, None], felt, self._wrench)
        self._failed = np.where(state.ok, 0, self._failed + 1)
        if (self._failed > _MOST_FAILED).all():
            why = next(iter(state.problems.values()), "no reason is known.")
            raise HostError(
                f"{self._failed.min()} steps in a row could not be solved, the last: {why} "
                "Move host, bodies and inputs by less in a step, or after a jump call reset()."
            )

    def _anew(self, rows: Flags, base: Floats, given: Given, around: Given) -> State:
        """These rods at rest, from the straight rod; the others, memories and clocks of their effects too,
        stay as they are."""
        sim = self.simulator
        if sim.contact is None:
            sim.reset(rows)
            return sim.settle(base_pose=base, rows=rows, **around, **given)
        before = sim.snapshot()
        sim.reset(rows)
        state = sim.settle(base_pose=base, **around, **given)
        if rows.all():
            return state
        sim.restore(before, ~rows)
        return sim.state

    def _keep(
        self, state: State, given: Given, around: Mapping[str, Any], base: Floats, half: Floats
    ) -> None:
        """Take a state over. Rods that are lost in it stay as they were; those that are not ok have the
        wrench `half` (n_robots, 6)."""
        found = [
            np.isfinite(a).reshape(len(a), -1).all(axis=1)
            for a in (state.position, state.tip_position, state.base_wrench)
        ]
        lost: Flags = ~np.logical_and.reduce(found)
        if lost.any():
            i, before = int(lost.argmax()), self._state
            if lost.all() or before is None:
                which = "the rod" if len(lost) == 1 else f"rod {i} of {len(lost)}"
                raise HostError(f"{which} is lost: {state.problems.get(i, 'its shape is not finite')}")
            unknown = {int(i): "its shape is not finite." for i in np.flatnonzero(lost)}
            shape = merge_shape(state.as_shape(), before, lost)
            state = replace(
                state, **shape._asdict(), ok=state.ok & ~lost, problems=unknown | dict(state.problems)
            )
        self._state, self._inputs = state, given
        self._obstacles |= {
            name: np.array(np.atleast_2d(pose), float)
            for name, pose in (around.get("obstacle_pose") or {}).items()
        }
        wrench = state.base_wrench if state.mean_wrench is None else state.mean_wrench
        self._wrench = np.where(state.ok[:, None], wrench, half)
        self._base = np.where(lost[:, None], self._base, np.broadcast_to(base, self._base.shape))

    def _sorted(self, inputs: Given) -> tuple[Given, Given]:
        """Inputs of the rod with those it has already, and what is around it."""
        known = INPUTS if self.simulator.contact is None else (*INPUTS, *OBSTACLES)
        for name in inputs:
            if name not in known:
                why = (
                    "it needs a contact scene: Rod(robot, contact=...)."
                    if name in OBSTACLES
                    else nearest(name, known)
                )
                raise InputError(f"a rod has no input {name!r}; {why}")
        for name, value in inputs.items():
            refuse_masked(name, value)
        inputs = {name: _copied(value) for name, value in inputs.items()}
        around = {name: inputs[name] for name in OBSTACLES if name in inputs}
        return self._inputs | {name: value for name, value in inputs.items() if name not in OBSTACLES}, around

    def _obstacles_after(self, around: Given, steps: int) -> Given:
        """Return the obstacles after the first of the `steps` that lead to their given poses."""
        scene = self.simulator.contact
        if scene is None or not around.get("obstacle_pose"):
            return around
        rest = scene.rest_poses()
        end = scene.moved(rest, around["obstacle_pose"], self.simulator.n_robots)  # refuses what is no pose
        poses = {}
        for name in around["obstacle_pose"]:
            k = scene.index(name)
            poses[name] = between(self._obstacles.get(name, rest[:, k]), end[:, k], np.array([1.0 / steps]))
        return around | {"obstacle_pose": poses}

    def _along(self, state: State) -> Capsules:
        return along(
            state.position[:, :: self._nodes_per_capsule],
            state.rotation[:, :: self._nodes_per_capsule],
            self.radius,
        )

    def _fall(self, motion: Motion, free: Motion, given: Given, time_step: float) -> tuple[Floats, Floats]:
        """Gravity, (3,) or (n_robots, 3), and the acceleration (n, 3) [m/s^2] with which a base of this
        `motion` falls, `free` of the rod, world: along gravity and no faster, for what other forces do to a
        base is no fall."""
        gravity = np.array(given.get("gravity", self.robot.gravity), float)
        along = ((free.velocity - motion.velocity)[:, :3] * gravity).sum(1, keepdims=True) / time_step
        return gravity, gravity * np.clip(along / max((gravity**2).sum(-1).max(), 1e-30), 0.0, 1.0)

    def _substeps(self, time_step: float) -> int:
        check_number("time_step", time_step, Bound(above=0.0, unit="s"))
        n = max(1, math.ceil(time_step / self.dt - 1e-9))
        if n > _MOST_SUBSTEPS:
            raise InputError(
                f"time_step is {time_step:g} s, {n} of the rod's steps of {self.dt:g} s; was it given in ms?"
            )
        return n

    def _bases(self, *given: Any) -> tuple[Motion, Freedom | None]:
        """Motion of the bases, and how they give way. The pose of one of several that an engine lost is nan:
        its step says so."""
        lost = np.zeros(self.simulator.n_robots, bool)
        usable = [_usable(*pair, lost) for pair in zip(given, _STANDS, strict=True)]
        pose, twist, inertia, free_twist = given if lost.all() else usable
        motion = self._motion(pose, twist)
        freedom = self._freedom(inertia, free_twist, motion)
        known = np.where(lost[:, None], np.nan, motion.pose) if lost.any() else motion.pose
        return motion._replace(pose=known), freedom

    def _motion(self, base_pose: ArrayLike, base_twist: ArrayLike) -> Motion:
        """(n_robots, 7 and 6)"""
        n, pose, twist = self.simulator.n_robots, self._poses(base_pose), self._twists(base_twist)
        return Motion(np.broadcast_to(pose, (n, 7)), np.broadcast_to(twist, (n, 6)))

    def _freedom(
        self, inverse_inertia: ArrayLike | None, free_twist: ArrayLike | None, motion: Motion
    ) -> Freedom | None:
        if inverse_inertia is None:
            if free_twist is not None:
                raise InputError(
                    "free_twist goes with inverse_inertia; without it the base's motion is prescribed."
                )
            return None
        twist = motion.velocity if free_twist is None else self._twists(free_twist)
        given = checked_inertia(inverse_inertia, self.simulator.n_robots)
        if self._weighs and not self.simulator.dynamics:
            raise InputError(
                "inverse_inertia was given, and this rod has a mass, which its base must feel; give "
                "Rod(robot, dynamics=True)."
            )
        return Freedom(given, np.broadcast_to(twist, motion.velocity.shape))

    def _poses(self, base_pose: ArrayLike) -> Floats:
        rows = [] if self.n_robots is None else [self.n_robots]
        return checked_pose("base_pose", base_pose, *rows, off=1e-3)

    def _twists(self, base_twist: ArrayLike) -> Floats:
        shapes = [(6,)] if self.n_robots is None else [(6,), (self.n_robots, 6)]
        says = "velocity [m/s] and angular velocity [rad/s], world"
        return checked_array("base_twist", base_twist, shapes, says)

    def _one(self, a: Floats) -> Floats:
        return a.copy() if self.n_robots is not None else a[0].copy()

    def _there(self, what: Any) -> Any:
        if what is None:
            raise InputError("the rod has no state yet; call advance or settle first.")
        return what


def _usable(value: Any, instead: Floats, lost: Flags) -> Any:
    """Rows (n, ...) with something `instead` of those that are not finite, which are noted as `lost` (n,);
    anything else as it is."""
    if type(value) is not np.ndarray or value.shape != (len(lost), *instead.shape) or value.dtype.kind != "f":
        return value
    axes = tuple(range(1, value.ndim))
    bad = ~np.isfinite(value).all(axis=axes)
    lost |= bad
    return np.where(np.expand_dims(bad, axes), instead, value) if bad.any() else value


def _copied(value: Any) -> Any:
    """Copy a value, since the caller may write into its own; what cannot be copied is refused where it is
    read."""
    try:
        return np.array(value) if isinstance(value, np.ndarray) else copy.deepcopy(value)
    except Exception:
        return value


def check_robot(robot: object) -> None:
    """Raises `RobotError` for what is not one robot."""
    if not isinstance(robot, Robot):
        raise RobotError(
            f"robot is {shown(robot)}; give one Robot, for example fastrod.load_robot('prototype')."
        )


def _modal(dynamics: bool, rho: float, modes: Modes | None) -> Modal | None:
    """Rods of modes where a rod has inertia or modes of its own."""
    if dynamics:
        return Modal(dynamics=dynamics, rho=rho, modes=modes)
    return None if modes is None else Modal(modes=modes)
