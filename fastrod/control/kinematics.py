"""`SoftTip`: the tip of a soft robot on an arm, on a moving base or on a fixed one, by one vector of
coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol, cast, final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.checks import Bound, check_number, checked_array, checked_pose
from fastrod.errors import InputError
from fastrod.model.segment_actions import SegmentActions
from fastrod.rotation import matrix_from_quaternion, product, quaternion_from_vector
from fastrod.simulator import Simulator
from fastrod.solver.state import State
from fastrod.types import Floats

_STRAIGHT: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


class BaseKinematics(Protocol):
    """Carrier of a soft robot: a flange whose pose follows from coordinates of its own (`Arm` is the same by
    another name)."""

    @property
    def n_joints(self) -> int:
        """Coordinates q of the base."""

    def frame(self, q: Floats) -> Floats:
        """(7,) world_from_flange, position [m] and quaternion w x y z, at q (n_joints,)."""

    def jacobian(self, q: Floats) -> Floats:
        """(6, n_joints) d(position of the flange's origin [m], rotation vector [rad]) / dq, world."""


Arm = BaseKinematics


@final
@dataclass(frozen=True)
class FixedBase:
    """A flange that stays where it is. Raises `InputError` where `pose` is none."""

    pose: ArrayLike = _STRAIGHT
    """(7,) world_from_flange, position [m] and quaternion w x y z."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", tuple(checked_pose("FixedBase.pose", self.pose).tolist()))

    @property
    def n_joints(self) -> int:
        """None."""
        return 0

    def frame(self, q: Floats) -> Floats:  # noqa: ARG002
        """(7,) the pose."""
        return np.array(self.pose, dtype=np.float64)

    def jacobian(self, q: Floats) -> Floats:  # noqa: ARG002
        """(6, 0)."""
        return np.zeros((6, 0))


@final
@dataclass(frozen=True)
class MovingBase:
    """A flange that moves along the world's axes, and rotates about them where `rotates`. Raises `InputError`
    where `pose` is none.

    q is the displacement from `pose` (3,) [m], and then the rotation vector (3,) [rad], world, that rotates
    it from there.
    """

    pose: ArrayLike = _STRAIGHT
    """(7,) world_from_flange at q = 0, position [m] and quaternion w x y z."""
    rotates: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", tuple(checked_pose("MovingBase.pose", self.pose).tolist()))

    @property
    def n_joints(self) -> int:
        """3, or 6 where it rotates."""
        return 6 if self.rotates else 3

    def frame(self, q: Floats) -> Floats:
        """(7,) world_from_flange."""
        pose = np.array(self.pose, dtype=np.float64)
        pose[:3] += q[:3]
        if self.rotates:
            pose[3:] = product(quaternion_from_vector(np.asarray(q[3:6], dtype=np.float64)), pose[3:])
        return pose

    def jacobian(self, q: Floats) -> Floats:
        """(6, n_joints)."""
        jacobian = np.eye(6, self.n_joints)
        if self.rotates:
            jacobian[3:, 3:] = _rotation_jacobian(np.asarray(q[3:6], dtype=np.float64))
        return jacobian


@final
class SoftTip:
    """The tip of one simulated soft robot by q = (coordinates of its base, then three a segment:
    `SegmentActions`).

    >>> import fastrod
    >>> tip = SoftTip(fastrod.Simulator(fastrod.load_robot("prototype"), points_per_segment=6), MovingBase())
    >>> state = tip.place([0.1, 0.0, 0.0, 0.0, 0.0, 0.0], settle=True)
    >>> tip.position.round(6).tolist(), tip.jacobian().shape
    ([0.1, 0.0, 0.07], (3, 6))
    """

    def __init__(
        self,
        simulator: Simulator,
        base: BaseKinematics | None = None,
        *,
        flange_from_base: ArrayLike = _STRAIGHT,
        offset: float | None = None,
    ) -> None:
        """`simulator` of one robot; `base` carries it, by default fixed where the robot says;
        `flange_from_base` (7,) is its mount, position [m] and quaternion w x y z; `offset` as for
        `SegmentActions` [m]. Raises `InputError`, and `RobotError` as
        `SegmentActions`."""
        if not isinstance(simulator, Simulator) or simulator.n_robots != 1:
            raise InputError(f"simulator is {simulator!r}; give a Simulator of one robot.")
        robot = simulator.robots[0]
        self.simulator = simulator
        self.base: BaseKinematics = (
            FixedBase((*robot.base_position, *robot.base_quaternion)) if base is None else base
        )
        self.actions = SegmentActions(robot, offset)
        self.n_base = int(self.base.n_joints)
        """Coordinates of the base."""
        self.n_q = self.n_base + self.actions.n_actions
        """Coordinates of all."""
        self._rest = np.concatenate([robot.rest_tendon_length, np.zeros(robot.n_segments)])
        mount = checked_pose("flange_from_base", flange_from_base)
        self._mount = None if np.array_equal(mount, _STRAIGHT) else mount
        self._q: Floats | None = None
        self._base_pose: Floats = np.zeros(7)
        self._state: State | None = None

    def place(
        self, q: ArrayLike, *, base_pose: ArrayLike | None = None, settle: bool = False, **loads: Any
    ) -> State:
        """Step the simulator once to q (n_q,) (`settle`: until it rests) and return its state.

        `base_pose` (7,): the measured world_from_base, position [m] and quaternion w x y z, in the place of
        the one that follows from q. `loads` are those of `Simulator.step`: tip_force, line_force,
        obstacle_pose, ... Raises `InputError`.
        """
        q = self._read(q)
        pose = self._carried(q) if base_pose is None else checked_pose("base_pose", base_pose)
        state = self._move(q, pose, settle, loads)
        self._q, self._base_pose, self._state = q, pose, state
        return state

    def follow(self, q: ArrayLike, state: State, base_pose: ArrayLike) -> None:
        """Be where a step of the simulator that was taken elsewhere, as a host does, has left the robot:
        `state` is that of the simulator's last step, q (n_q,) the coordinates that it belongs to, `base_pose`
        (7,) as for `place`. Raises `InputError`."""
        q, pose = self._read(q), checked_pose("base_pose", base_pose)
        self._q, self._base_pose, self._state = q, pose, state

    @property
    def position(self) -> Floats:
        """Return the position of the tip (3,), world [m], at the last `place`. Raises `InputError` before the
        first `place`."""
        return np.asarray(self._with_state("position")[1].tip_position[0])

    def jacobian(self, *, rotation: bool = False) -> Floats:
        """Return the Jacobian (3, n_q) d(tip position [m]) / dq, world, at the last `place`; with `rotation`
        (6, n_q), rotation vector [rad] below.

        Columns of the base: its twist moved to the tip, J_v + J_w x (tip - base), and by how much the rod
        bends as its base rotates under loads that keep their direction in the world, its weight included.
        Those of the actions: `Simulator.jacobian` by tendons and extensions, times these by actions. Raises
        `InputError` before the first `place`.
        """
        q, state = self._with_state("jacobian")
        jacobian = np.empty((6, self.n_q))
        n_inputs = len(self.actions.matrix)
        twist = np.asarray(self.base.jacobian(q[: self.n_base]), dtype=np.float64)
        turning = bool(twist[3:].any())
        by_input = self.simulator.jacobian(turning=turning)[0]
        np.matmul(by_input[:, :n_inputs], self.actions.matrix, out=jacobian[:, self.n_base :])
        jacobian[:, : self.n_base] = 0.0
        jacobian[:3, : self.n_base] = twist[:3]
        if turning:
            w = twist[3:]
            jacobian[:, : self.n_base] += by_input[:, n_inputs:] @ w
            if self._mount is not None:
                jacobian[:3, : self.n_base] += _cross(w, self._arm())
        if not np.isfinite(jacobian).all():
            raise InputError(f"jacobian needs a robot that is ok; {state.problems.get(0, 'this one is not')}")
        return jacobian if rotation else jacobian[:3]

    def limits(self, largest_bend: float = math.pi / 2.0) -> tuple[Floats, Floats]:
        """Least and largest action (3 n_segments,) each [m]: each segment's range of extension, and
        displacements of both tendons that bend it by no more than `largest_bend` [rad]. Limits of the base
        stand before these in q. Raises `InputError`."""
        check_number("largest_bend", largest_bend, Bound(above=0.0, unit="rad"))
        low, high = (np.empty((len(self.actions.offset), 3)) for _ in range(2))
        for k, segment in enumerate(self.actions.robot.segments):
            low[k, 0], high[k, 0] = segment.extension
        high[:, 1:] = largest_bend * self.actions.offset[:, None] * self.actions.bends.reshape(-1, 3)[:, 1:]
        low[:, 1:] = -high[:, 1:]
        return low.ravel(), high.ravel()

    def finite_differences(self, q: ArrayLike, step: float = 1e-4, **loads: Any) -> Floats:
        """Return the same (3, n_q) by the paper's method (SoftManiSim, CoRL 2024): central differences of the
        settled tip, a column after the other, by `step` [m or rad]; one-sided at an end of an extension's
        range, zero where there is no range. The simulator is left as it was. Raises `InputError`, also where
        an end does not settle."""
        q = self._read(q)
        check_number("step", step)
        before = self.simulator.snapshot()
        jacobian = np.zeros((3, self.n_q))
        low, high = np.full(self.n_q, -np.inf), np.full(self.n_q, np.inf)
        for k, segment in enumerate(self.actions.robot.segments):
            low[self.n_base + 3 * k], high[self.n_base + 3 * k] = segment.extension
        try:
            for j in range(self.n_q):
                ends, at = [], np.clip([q[j] + step, q[j] - step], low[j], high[j])
                if at[0] == at[1]:
                    continue
                for value in at:
                    moved = q.copy()
                    moved[j] = value
                    state = self._move(moved, self._carried(moved), True, loads)
                    if not state.ok[0]:
                        raise InputError(f"q[{j}] moved to {value:g} does not settle: {state.problems[0]}")
                    ends.append(state.tip_position[0])
                jacobian[:, j] = (ends[0] - ends[1]) / (at[0] - at[1])
        finally:
            self.simulator.restore(before)
        return jacobian

    def _move(self, q: Floats, pose: Floats, settle: bool, loads: dict[str, Any]) -> State:
        # `SegmentActions.inputs`, of what is known to be good
        inputs = self.actions.matrix @ q[self.n_base :] + self._rest
        n = len(inputs) - len(self.actions.offset)
        if settle:
            return self.simulator.settle(inputs[:n], extension=inputs[n:], base_pose=pose, **loads)
        return self.simulator.step(inputs[:n], extension=inputs[n:], base_pose=pose, derive=True, **loads)

    def _carried(self, q: Floats) -> Floats:
        """(7,) world_from_base that follows from q."""
        flange = np.asarray(self.base.frame(q[: self.n_base]), dtype=np.float64)
        if self._mount is None:
            return flange
        pose = np.empty(7)
        pose[:3] = flange[:3] + matrix_from_quaternion(flange[None, 3:])[0] @ self._mount[:3]
        pose[3:] = product(flange[3:], self._mount[3:])
        return pose

    def _arm(self) -> Floats:
        """(3,) from the flange to the base, world [m]."""
        mount = cast(Floats, self._mount)
        base, flange = matrix_from_quaternion(np.stack([self._base_pose[3:], mount[3:]]))
        return np.asarray(base @ flange.T @ mount[:3])

    def _read(self, q: ArrayLike) -> Floats:
        n, segments = self.n_base, len(self.actions.offset)
        says = f"{n} of the base, then extension and two displacements for each of {segments} segments [m]"
        return checked_array("q", q, [(self.n_q,)], says)

    def _with_state(self, what: str) -> tuple[Floats, State]:
        if self._q is None or self._state is None:
            raise InputError(f"{what} needs a placed robot; call place first.")
        return self._q, self._state


def _cross(a: Floats, b: Floats) -> Floats:
    """(3, n) columns of a (3, n) cross b (3,)."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _rotation_jacobian(v: Floats) -> Floats:
    """(3, 3) world rotation by the change of a rotation vector: I + (1 - cos a) / a^2 [v] + (a - sin a) / a^3
    [v]^2, the left Jacobian of SO(3)."""
    a = float(np.linalg.norm(v))
    hat = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    one, two = (
        (0.5 - a * a / 24.0, 1.0 / 6.0 - a * a / 120.0)
        if a < 1e-3
        else ((1.0 - math.cos(a)) / a**2, (a - math.sin(a)) / a**3)
    )
    return np.asarray(np.eye(3) + one * hat + two * hat @ hat)
