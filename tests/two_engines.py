"""One rod on one UR5 in PyBullet and in MuJoCo: its tip and the wrench on the flange."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

DT = 0.005
CASES = ("hanging", "pulled by 0.3 N", "on a fixed block", "on a sprung block")
JOINTS = (0.0, -1.2, 1.4, -1.77, -1.57, 0.0)
"""Joint angles of the arm: the flange looks down [rad]."""
ADAPTER, BEND, SPRING, DAMPER, MASS = 0.03, 0.8, 10.0, 4.0, 0.2
HALF = (0.06, 0.01, 0.06)
"""Half size of the block [m]."""
OFFSETS = np.array([0.0, 0.06, 0.03])
"""Offsets of the block's middle from the straight rod's tip [m]."""


class Result(NamedTuple):
    tip: Any
    """(3,) world [m]."""
    wrench: Any
    """(6,) on the flange, world [N, N m]."""
    step: Callable[[], Any]


def carried() -> tuple[Any, dict[str, Any]]:
    """The rod, and its tendons as they bend it toward the block."""
    from fastrod.model.segment_actions import SegmentActions
    from fastrod_scenes.ur5.carried import OFFSET, soft_robot

    robot = soft_robot("carried", 2)
    robot = replace(robot, segments=tuple(replace(s, damping_time=0.05) for s in robot.segments))
    return robot, dict(SegmentActions(robot).inputs(np.array([0.0, -OFFSET * BEND / 2.0, 0.0] * 2)))


def inputs(case: str) -> dict[str, Any]:
    """Inputs of the rod in a case."""
    return carried()[1] | ({"tip_force": (0.2, 0.2, -0.1)} if case == CASES[1] else {})


def flange() -> Any:
    """(7,) of the arm at JOINTS, by PyBullet's own numbers."""
    from fastrod.hosts import BulletArm, connect
    from fastrod_scenes.robots import ur5_path

    return BulletArm.load(connect(dt=DT), ur5_path(), tip="tool0").frame(JOINTS)


def block_at() -> Any:
    """(3,) middle of the block, world [m]."""
    return flange()[:3] - [0.0, 0.0, ADAPTER + 0.2] + OFFSETS


def in_pybullet(case: str) -> tuple[Any, Callable[[], Any]]:
    """The mounted rod, and one step of the world."""
    from fastrod.hosts import BulletArm, BulletLink, MountedRod, connect
    from fastrod_scenes.robots import ur5_path

    world = connect(dt=DT)
    arm = BulletArm.load(world, ur5_path(), tip="tool0")
    arm.place(JOINTS)
    contact_bodies: list[Any] = []
    if case in CASES[2:]:
        shape = world.createCollisionShape(world.GEOM_BOX, halfExtents=list(HALF))
        sprung = case == CASES[3]
        zero, level = [[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0, 1.0]]
        link = {"linkPositions": zero, "linkInertialFramePositions": zero}
        link |= {"linkOrientations": level, "linkInertialFrameOrientations": level}
        link |= {"linkMasses": [MASS if sprung else 0.0], "linkParentIndices": [0]}
        link |= {"linkCollisionShapeIndices": [shape], "linkVisualShapeIndices": [-1]}
        link |= {"linkJointTypes": [world.JOINT_PRISMATIC if sprung else world.JOINT_FIXED]}
        link |= {"linkJointAxis": [[0, 1, 0]]}
        block = world.createMultiBody(0.0, -1, -1, block_at().tolist(), **link)
        contact_bodies = [(block, 0)]
    base = BulletLink(world, arm.body, arm.tip, position=(0.0, 0.0, ADAPTER))
    rod = MountedRod(carried()[0], base, contact_bodies=contact_bodies, friction=0.0)
    given = inputs(case)
    if case == CASES[3]:
        world.setJointMotorControl2(block, 0, world.VELOCITY_CONTROL, force=0.0)
        world.changeDynamics(block, 0, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0)

    def step() -> Any:
        if case == CASES[3]:
            q, v = world.getJointState(block, 0)[:2]
            world.setJointMotorControl2(block, 0, world.TORQUE_CONTROL, force=-SPRING * q - DAMPER * v)
        return rod.step(**given)

    return rod, step


def in_mujoco(case: str) -> tuple[Any, Callable[[], Any]]:
    """See `in_pybullet`."""
    import mujoco

    from fastrod.hosts import MujocoRod, add_capsules
    from fastrod_scenes.ur5.mujoco_arm import MujocoArm, arm_spec

    spec = arm_spec(DT)
    contact_bodies: list[str] = []
    if case in CASES[2:]:
        block = spec.worldbody.add_body(name="block", pos=block_at().tolist(), gravcomp=1.0)
        if case == CASES[3]:
            slide = mujoco.mjtJoint.mjJNT_SLIDE
            block.add_joint(type=slide, axis=[0, 1, 0], stiffness=SPRING, damping=DAMPER)
        block.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=list(HALF), mass=MASS)
        contact_bodies = ["block"]
    robot = carried()[0]
    add_capsules(spec, robot, "tool0", contact_bodies=contact_bodies)
    model = spec.compile()
    data = mujoco.MjData(model)
    MujocoArm(model, data).place(JOINTS)
    mount = {"position": (0.0, 0.0, ADAPTER), "contact_bodies": contact_bodies, "friction": 0.0}
    rod = MujocoRod(robot, model, data, "tool0", **mount)
    given = inputs(case)
    return rod, lambda: rod.step(**given)


ENGINES = {"PyBullet": in_pybullet, "MuJoCo": in_mujoco}


def at_rest(engine: str, case: str, steps: int = 300) -> Result:
    """After so many steps."""
    rod, step = ENGINES[engine](case)
    for _ in range(steps):
        state = step()
    return Result(state.tip_position[0], rod.wrench.copy(), step)


def apart(a: Result, b: Result) -> dict[str, float]:
    """Return how far two engines are apart: tips by the rod's length, forces and moments by the larger."""
    robot = carried()[0]

    def relative(u: Any, v: Any) -> float:
        return float(np.linalg.norm(u - v) / max(np.linalg.norm(u), np.linalg.norm(v)))

    return {
        "tip": float(np.linalg.norm(a.tip - b.tip)) / robot.length,
        "force": relative(a.wrench[:3], b.wrench[:3]),
        "moment": relative(a.wrench[3:], b.wrench[3:]),
    }
