"""`MujocoBody`: any body of any MuJoCo model as the host of a rod."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.errors import HostError, nearest
from fastrod.hosts.host import Freedom, Host, Motion
from fastrod.hosts.link import mount_pose
from fastrod.rotation import cross, product, quaternion_from_matrix
from fastrod.types import Floats


def mujoco() -> Any:
    """The module, imported on first use; `HostError` says how to get it."""
    try:
        import mujoco as module
    except ImportError as error:
        raise HostError("MuJoCo is not installed; pip install 'fastrod[mujoco]' brings it.") from error
    return module


def check_world(model: object, data: object) -> None:
    """`HostError` for what is no model, or data of another one."""
    lib = mujoco()
    if not isinstance(model, lib.MjModel) or not isinstance(data, lib.MjData):
        raise HostError(
            f"model and data are {type(model).__name__} and {type(data).__name__}; give a "
            "mujoco.MjModel and its MjData."
        )
    if data.xpos.shape[0] != model.nbody or data.qpos.shape[0] != model.nq:
        raise HostError(
            f"the data are of another model: {data.xpos.shape[0]} bodies, where this one has {model.nbody}."
        )


def body_number(model: Any, body: object) -> int:
    """Number of a body that is given by name or number; `HostError` with the nearest name."""
    lib = mujoco()
    if isinstance(body, str):
        number = int(lib.mj_name2id(model, lib.mjtObj.mjOBJ_BODY, body))
        if number < 0:
            names = [model.body(i).name for i in range(model.nbody)]
            raise HostError(f"the model has no body {body!r}; {nearest(body, [n for n in names if n])}")
        return number
    if isinstance(body, bool) or not isinstance(body, (int, np.integer)) or not 0 <= body < model.nbody:
        raise HostError(
            f"body is {body!r}; give the name of a body, or its number from 0 (the world) to "
            f"{model.nbody - 1}."
        )
    return int(body)


def refresh(model: Any, data: Any) -> None:
    """Poses and velocities of all bodies from the joints as they are now: mj_step leaves those of the step's
    start."""
    lib = mujoco()
    lib.mj_kinematics(model, data)
    lib.mj_comPos(model, data)
    lib.mj_comVel(model, data)


def velocity_of(model: Any, data: Any, body: int, *, com: bool) -> Floats:
    """(6,) linear [m/s], then angular velocity [rad/s], world, of a body's centre of mass or of its frame's
    origin."""
    lib = mujoco()
    found = np.zeros(6)
    lib.mj_objectVelocity(
        model, data, lib.mjtObj.mjOBJ_BODY if com else lib.mjtObj.mjOBJ_XBODY, body, found, 0
    )
    return np.concatenate([found[3:], found[:3]])  # MuJoCo has the angular one first


def com_motion(model: Any, data: Any, body: int) -> Motion:
    """Motion of the frame of a body's centre of mass, as `data` have it."""
    orientation = quaternion_from_matrix(data.ximat[body].reshape(1, 3, 3))[0]
    return Motion(np.concatenate([data.xipos[body], orientation]), velocity_of(model, data, body, com=True))


@final
class Applied:
    """One rod's forces in `data.xfrc_applied` for a body.

    MuJoCo keeps these forces until somebody clears them, and others may have put their own there: this adds
    its own, and removes just that again.
    """

    def __init__(self, data: Any, body: int) -> None:
        self._data, self._body = data, body
        self._before: Floats = np.zeros(6)
        self._left: Floats | None = None

    def add(self, wrench: Floats) -> None:
        """(6,) force [N] and moment about the centre of mass [N m], world, with what was added before."""
        there = self._data.xfrc_applied[self._body]
        if self._left is None:
            self._before = there.copy()
        there += wrench
        self._left = there.copy() if self._left is None else self._left + wrench

    def take(self) -> None:
        """Leave the forces as they were, and what others added since. Forces that somebody has cleared
        meanwhile stay cleared."""
        left, self._left = self._left, None
        there = self._data.xfrc_applied[self._body]
        if left is None or not there.any():
            return
        there[:] = self._before if np.array_equal(there, left) else there - (left - self._before)


@final
class MujocoBody:
    """A rod's base, fixed to a body (0: the world). `fastrod.hosts.Host` says what the methods do.

    The mount is given in the body's frame, the one of `data.xpos`, not in that of its centre of mass.
    """

    def __init__(
        self,
        model: Any,
        data: Any,
        body: int | str,
        *,
        position: ArrayLike = (0.0, 0.0, 0.0),
        quaternion: ArrayLike = (1.0, 0.0, 0.0, 0.0),
    ) -> None:
        """`body`: number or name; `position` (3,) [m] and `quaternion` (4,) w x y z, body_from_base. Raises
        `HostError`, `InputError`."""
        check_world(model, data)
        self.model, self.data = model, data
        self.body = body_number(model, body)
        self._position, self._quaternion = mount_pose(position, quaternion)
        self._applied = Applied(data, self.body)
        self.mocap_velocity: Floats = np.zeros(6)
        """Velocity of the body's frame, linear [m/s] and angular [rad/s], world: for a mocap body, which
        MuJoCo itself takes to be at rest."""

    def motion(self) -> Motion:
        """Motion of the rod's base, with the joints as they are now."""
        refresh(self.model, self.data)
        pose = self._base()
        velocity = velocity_of(self.model, self.data, self.body, com=False)
        velocity[:3] += cross(velocity[3:], pose[:3] - self.data.xpos[self.body])
        return Motion(pose, velocity + self._given_velocity(pose[:3]))

    def _base(self) -> Floats:
        arm = self.data.xmat[self.body].reshape(3, 3) @ self._position
        position = self.data.xpos[self.body] + arm
        return np.concatenate([position, product(self.data.xquat[self.body], self._quaternion)])

    def _given_velocity(self, point: Floats) -> Floats:
        """(6,) that a mocap body is given, at a point of it."""
        velocity = self.mocap_velocity.copy()
        velocity[:3] += cross(velocity[3:], point - self.data.xpos[self.body])
        return velocity

    def moves_with(self, other: Host) -> bool:
        """See `Host`: bodies of one kinematic tree."""
        tree = self.model.body_rootid
        if not isinstance(other, MujocoBody) or other.data is not self.data:
            return False
        return bool(tree[other.body] == tree[self.body])

    def freedom(self, dt: float, others: Sequence[tuple[Host, Floats]] = ()) -> Freedom:
        """By the accelerations that the model has without the rod: of joints, actuators, contacts, and of
        what others exert already."""
        lib, model, data = mujoco(), self.model, self.data
        lib.mj_forward(model, data)
        hosts = [self, *(host for host, _ in others if isinstance(host, MujocoBody))]
        slopes = np.zeros((len(hosts), 4, 3, model.nv))
        for host, slope in zip(hosts, slopes, strict=True):
            point = host._base()[:3]
            lib.mj_jac(model, data, slope[0], slope[1], point, host.body)
            lib.mj_jacDot(model, data, slope[2], slope[3], point, host.body)
        jacobian, change = (a.reshape(6 * len(hosts), model.nv) for a in (slopes[:, :2], slopes[:, 2:]))
        by_force = np.zeros_like(jacobian)
        if model.nv:
            lib.mj_solveM(model, data, by_force, jacobian)
        gained = jacobian @ data.qacc + 0.5 * change @ data.qvel  # the latter bends the base's path
        given = np.concatenate([host._given_velocity(host._base()[:3]) for host in hosts])
        return Freedom(jacobian @ by_force.T, jacobian @ data.qvel + given + dt * gained, True)

    def exert(self, wrench: Floats) -> None:
        """Force and moment about the base point, world, during the next mj_step, and until `release`."""
        arm = self.motion().pose[:3] - self.data.xipos[self.body]
        self._applied.add(np.concatenate([wrench[:3], wrench[3:] + cross(arm, wrench[:3])]))

    def release(self) -> None:
        """Feel no more of it."""
        self._applied.take()
