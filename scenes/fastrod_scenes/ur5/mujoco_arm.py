"""`MujocoArm`: the UR5 in a MuJoCo model, its joints held by position servos."""

from __future__ import annotations

from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.checks import checked_array
from fastrod.hosts.mujoco_body import mujoco
from fastrod.types import Floats
from fastrod_scenes.robots import ur5_path

JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
_STIFF, _DAMPED = 2e4, 4e2  # of a servo [N m/rad, N m s/rad]
_ARMATURE = 0.1  # rotor inertia seen through the gear [kg m^2]


def arm_spec(dt: float) -> Any:
    """A `mujoco.MjSpec` of the UR5 at the world's origin, with a servo on each joint and the tip link
    `tool0`; its own weight is balanced, so that the servos feel what it carries. More may be added before it
    is compiled."""
    lib = mujoco()
    spec = lib.MjSpec.from_file(ur5_path())
    spec.compiler.fusestatic = False  # or tool0 would be gone
    spec.option.timestep = dt
    spec.option.integrator = lib.mjtIntegrator.mjINT_IMPLICITFAST
    for body in spec.bodies:
        if body.name != "world":
            body.gravcomp = 1.0
        for geom in body.geoms:
            geom.conaffinity = 0  # links meet everything but each other: the shapes of neighbours overlap
    for name in JOINTS:
        spec.joint(name).armature = _ARMATURE
        spec.add_actuator(name=name, target=name, trntype=lib.mjtTrn.mjTRN_JOINT).set_to_position(
            kp=_STIFF, kv=_DAMPED
        )
    return spec


@final
class MujocoArm:
    """The arm of a compiled `arm_spec`."""

    def __init__(self, model: Any, data: Any) -> None:
        self.model, self.data = model, data
        self._q = np.array([model.joint(name).qposadr[0] for name in JOINTS])
        self._v = np.array([model.joint(name).dofadr[0] for name in JOINTS])
        self._u = np.array([model.actuator(name).id for name in JOINTS])

    def position(self) -> Floats:
        """(6,) joints [rad]."""
        return np.array(self.data.qpos[self._q])

    def place(self, q: ArrayLike) -> None:
        """Be at q (6,) [rad] at once, at rest, and stay. Raises `InputError`."""
        self.data.qpos[self._q], self.data.qvel[self._v] = _joints(q), 0.0
        self.drive(q)

    def drive(self, q: ArrayLike) -> None:
        """Let the servos go to q (6,) [rad]. Raises `InputError`."""
        self.data.ctrl[self._u] = _joints(q)

    def torque(self) -> Floats:
        """(6,) of the servos in the last step [N m]."""
        return np.array(self.data.actuator_force[self._u])


def _joints(q: ArrayLike) -> Floats:
    return checked_array("q", q, [(6,)], f"one angle for each of {', '.join(JOINTS)} [rad]")
