"""PyBullet on the rod of Appendix J: a chain of rigid links with springs EI N/l in its hinges, in two
layouts.

*Equal links* is the beam of SoMo's documentation (Graule et al., SoMo, IROS 2021; "Calibration to Hardware"):
N links of l/N, each hinged at its near end, the first at the wall. *Half end links* is what SoMo's URDF
writer makes of a plane manipulator: half a link fixed to the wall, N - 1 whole ones, half a link.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from appendix_j import BENDING, LENGTH, Peer, Rung, Solve, one_by_one

_INERTIA = 1.0  # of a link about its end in m h^2: slows the fast modes, which limit the step


@contextmanager
def _chain(links: int, half_ends: bool, patience: float = 1.0) -> Iterator[Solve]:
    """Length in l, force in EI/l^2, the whole mass 1: Bullet is made for objects of about 1. SoMo scales its
    world too.

    `patience` multiplies the steps, which are as many as it takes for the rest to be below the layout's
    error.
    """
    from fastrod.hosts import connect

    h = 1.0 / links
    # of the first mode, slowed by the links' own inertia (Rayleigh's quotient)
    omega = 3.516 / math.sqrt(1.0 + 4.65 * _INERTIA * h * h)
    dt = 0.4 * math.sqrt(1.0 + _INERTIA) * h * h  # 0.8 of the stability limit of the fastest mode
    bullet: Any = connect(dt=dt, gravity=(0.0, 0.0, 0.0))
    # the first mode is critically damped
    steps = math.ceil(patience * (10.5 + 2.5 * math.log(links)) / (omega * dt))
    ends = [h] * (links - 1) + [0.5 * h] if half_ends else [h] * links  # each link's far end from its joint
    near = [0.5 * h if half_ends else 0.0, *ends[:-1]]
    joints, spring, upright = list(range(links)), float(links), [0, 0, 0, 1]
    chain = bullet.createMultiBody(
        0.0,
        linkMasses=ends,
        linkCollisionShapeIndices=[-1] * links,
        linkVisualShapeIndices=[-1] * links,
        linkPositions=[[x, 0, 0] for x in near],
        linkOrientations=[upright] * links,
        linkInertialFramePositions=[[x, 0, 0] for x in ends],
        linkInertialFrameOrientations=[upright] * links,
        linkParentIndices=joints,
        linkJointTypes=[bullet.JOINT_REVOLUTE] * links,
        linkJointAxis=[[0, 0, 1]] * links,
    )
    damping = {"linearDamping": 2.0 * omega, "angularDamping": 2.0 * omega, "jointDamping": 0.0}
    for j in joints:
        bullet.changeDynamics(chain, j, localInertiaDiagonal=[_INERTIA * h**3] * 3, **damping)
    bullet.setJointMotorControlArray(chain, joints, bullet.VELOCITY_CONTROL, forces=[0.0] * links)
    # looked up once: the client looks up its calls by name
    states, control, torque = bullet.getJointStates, bullet.setJointMotorControlArray, bullet.TORQUE_CONTROL
    apply, advance, here = bullet.applyExternalForce, bullet.stepSimulation, bullet.LINK_FRAME

    def rest(across: float) -> tuple[float, float]:
        force = across * LENGTH**2 / BENDING
        for j in joints:
            bullet.resetJointState(chain, j, 0.0, 0.0)
        for _ in range(steps):
            angle = [state[0] for state in states(chain, joints)]
            control(chain, joints, torque, forces=[-spring * q for q in angle])
            tilt = sum(angle)  # the load in the last link's frame: cheaper than to ask for its orientation
            push = [force * math.sin(tilt), force * math.cos(tilt), 0.0]
            apply(chain, links - 1, push, [0, 0, 0], here)
            advance()
        tip = bullet.getLinkState(chain, links - 1, computeForwardKinematics=1)[0]
        return LENGTH * tip[1], LENGTH * tip[0]

    try:
        yield one_by_one(rest)
    finally:
        bullet.disconnect()


def _peer(name: str, half_ends: bool, same: str) -> Peer:
    return Peer(
        name=f"PyBullet chain, {name}",
        modules=("pybullet",),
        same=same,
        also="dynamics, its own contact with friction between all bodies, any other robot in the same world.",
        rungs=[Rung(f"{n} links", partial(_chain, n, half_ends)) for n in (2, 4, 8, 16)],
    )


EQUAL = _peer(
    "equal links",
    False,
    "the layout of SoMo's documentation, springs EI N/l by torques; a plane chain in units of the rod's own, "
    "critically damped. The calibration there (the first link's chord) would make every spring twice as "
    "stiff for many links.",
)
HALVES = _peer(
    "half end links",
    True,
    "the same with half a link fixed to the wall and half a link at the tip, as SoMo's URDF writer has it "
    "for a plane manipulator.",
)
