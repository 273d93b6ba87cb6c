"""Base of the tasks with arms: a soft robot whose base is commanded where to be; how arms are drawn."""

from __future__ import annotations

from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.errors import HostError
from fastrod.hosts import Bullet, BulletArm
from fastrod.model.robot import Robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.simulator import Simulator
from fastrod.solver.state import State
from fastrod.types import Floats
from fastrod_envs.task import Tube
from fastrod_envs.tip import NOTHING, UNLOADED, Tip


@final
class SoftArm:
    """One soft robot, driven by the actions of `SegmentActions`, on a base that others move. What it feels is
    what its `head` meets."""

    def __init__(
        self,
        robot: Robot,
        *,
        dt: float,
        points_per_segment: int,
        largest_bend: float,
        bend_rate: float,
        extension_rate: float,
    ) -> None:
        """`dt` of a step [s]; `largest_bend` of a segment toward d1, and toward d2 [rad]; largest rates of
        bends [rad/s] and of extensions [m/s]."""
        self.actions = SegmentActions(robot)
        n = robot.n_segments
        self.dt, self._points = dt, points_per_segment
        self.simulator = self._made(robot)
        bend = largest_bend * self.actions.offset
        self.lower: Floats = np.ravel(
            [(robot.segments[k].extension[0], -bend[k], -bend[k]) for k in range(n)]
        )
        """(3 n_segments,) least action [m]."""
        self.upper: Floats = np.ravel([(robot.segments[k].extension[1], bend[k], bend[k]) for k in range(n)])
        """(3 n_segments,) largest action [m]."""
        self.rate: Floats = np.ravel(
            [(extension_rate, bend_rate * a, bend_rate * a) for a in self.actions.offset]
        )
        """(3 n_segments,) largest rate of an action [m/s]."""
        self.action: Floats = np.zeros(3 * n)
        """(3 n_segments,) where it is driven [m]."""
        self.base: Floats = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        """(7,) pose of its base: position [m] and quaternion w x y z, world."""
        self._new = self.simulator.snapshot()
        self.head: Tip | None = None
        """The spring of a body at its tip, if there is one."""
        self._state: State | None = None

    @property
    def nodes(self) -> Floats:
        """(n, 3) along the backbone, world [m]."""
        return np.asarray(self._now.position[0])

    @property
    def rotations(self) -> Floats:
        """(n, 3, 3) world_from_material of the nodes."""
        return np.asarray(self._now.rotation[0])

    @property
    def tip(self) -> Floats:
        """(3,) world [m]."""
        return np.asarray(self._now.tip_position[0])

    @property
    def aim(self) -> Floats:
        """(3,) where the tip would be without what its `head` meets, to first order, world [m]."""
        return self.tip if self.head is None else self.tip - self.head.deflection()[:3]

    @property
    def tip_rotation(self) -> Floats:
        """(3, 3) world_from_tip."""
        return np.asarray(self._now.tip_rotation[0])

    def begin(self, robot: Robot | None, base: ArrayLike, action: ArrayLike) -> None:
        """Settle from nothing, whatever went before, made anew where another `robot` is given. Raises
        `HostError` where it has no shape."""
        if robot is None:
            self.simulator.restore(self._new)
        else:
            self.simulator = self._made(robot)
        self.base, self.action = np.array(base, float), np.array(action, float)
        self.head = None
        self._keep(self.simulator.settle(base_pose=self.base, **self.actions.inputs(self.action), **UNLOADED))

    def _made(self, robot: Robot) -> Simulator:
        return Simulator(robot, dt=self.dt, points_per_segment=self._points, threads=1)

    def hold(self, bullet: Bullet, body: int, dt: float, load: Floats = NOTHING) -> Tip:
        """Rest under `load` (6,), and hold a body at the tip from now on in a world of steps of `dt` [s]
        (`Tip`)."""
        if load.any():
            given: dict[str, Any] = {"base_pose": self.base, **self.actions.inputs(self.action)}
            self._keep(self.simulator.settle(**given, tip_force=load[:3], tip_moment=load[3:]))
        self.head = Tip(self.simulator, dt, bullet, body, np.eye(3), load)
        return self.head

    def drive(self, action: Floats, base: Floats | None = None) -> None:
        """One step, at the end of which it is driven to an action, cut to its range, on a base. Raises
        `HostError` where it is lost."""
        self.action = np.clip(action, self.lower, self.upper)
        self.base = self.base if base is None else base
        given: dict[str, Any] = {"base_pose": self.base, **self.actions.inputs(self.action)}
        self._keep(self.simulator.step(**given) if self.head is None else self.head.solve(**given))

    def settle(self, action: Floats) -> None:
        """Come to rest where an action, cut to its range, has it. Raises `HostError` where it is lost."""
        self.action = np.clip(action, self.lower, self.upper)
        self._keep(
            self.simulator.settle(base_pose=self.base, **self.actions.inputs(self.action), tolerance=1e-7)
        )

    def posture(self) -> Floats:
        """(3 n_segments,) the action from -1, the least, to 1, the largest; 0 where it has no range."""
        return np.asarray(
            (2.0 * self.action - self.lower - self.upper) / np.maximum(self.upper - self.lower, 1e-12)
        )

    def jacobian(self) -> Floats:
        """(6, 3 n_segments) d(tip position [m], rotation vector [rad]) / d(action), world."""
        return np.asarray(np.nan_to_num(self.simulator.jacobian()[0] @ self.actions.matrix))

    @property
    def _now(self) -> State:
        assert self._state is not None
        return self._state

    def _keep(self, state: State) -> None:
        far = np.abs(state.tip_position[0] - self.base[:3]).max() if state.ok[0] else np.inf
        if not far < 2.0 * self.actions.robot.length + 1.0:
            raise HostError(
                f"the soft robot is lost: {state.problems.get(0, 'its tip is nowhere near its base')}"
            )
        self._state = state


def short(vector: Floats, longest: float) -> Floats:
    """A vector (3,) of at most this length, its direction kept."""
    return np.asarray(vector * (longest / max(float(np.linalg.norm(vector)), longest)))


def arm_tube(arm: BulletArm) -> Tube:
    """A serial arm as a tube along the origins of its links."""
    b, n = arm.bullet, arm.tip + 1
    base = b.getBasePositionAndOrientation(arm.body)[0]
    return Tube(
        np.array([base, *(s[4] for s in b.getLinkStates(arm.body, range(n), computeForwardKinematics=1))]),
        0.035,
        (0.6, 0.65, 0.7),
    )
