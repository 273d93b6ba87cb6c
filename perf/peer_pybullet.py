"""PyBullet on the rod of Appendix J: a chain of rigid links with springs in its hinges, in two layouts.

*Equal links* is the beam of SoMo's documentation (Graule et al., SoMo, IROS 2021; "Calibration to Hardware"):
N links of l/N, each hinged at its near end, the first at the wall. *Half end links* is what SoMo's URDF
writer makes of a plane manipulator: half a link fixed to the wall, N - 1 whole ones, half a link. The spring
is EI/(l/N) in both.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np

import appendix_j
from appendix_j import Array
from peer import Peer, Rung, Solve

_TURNING = 1.0  # inertia of a link about its end in m h^2: slows the fast modes, which limit the step


@contextmanager
def _chain(links: int, half_ends: bool, patience: float = 1.0) -> Iterator[Solve]:
    """Length in l, force in EI/l^2, the whole mass 1: Bullet is made for objects of about 1. SoMo scales its
    world too.

    `patience` multiplies the steps, which are as many as it takes for what is left to be below the layout's
    error.
    """
    import pybullet

    h = 1.0 / links
    # of the first mode, slowed by the links' own inertia (Rayleigh's quotient)
    omega = 3.516 / math.sqrt(1.0 + 4.65 * _TURNING * h * h)
    dt = 0.4 * math.sqrt(1.0 + _TURNING) * h * h  # 0.8 of the stability limit of the fastest mode
    # the first mode is critically damped
    steps = math.ceil(patience * (10.5 + 2.5 * math.log(links)) / (omega * dt))
    ends = [h] * (links - 1) + [0.5 * h] if half_ends else [h] * links  # each link's far end from its joint
    joints, spring = list(range(links)), float(links)
    client = pybullet.connect(pybullet.DIRECT)
    near = [0.5 * h if half_ends else 0.0, *ends[:-1]]
    chain = pybullet.createMultiBody(
        0.0,
        -1,
        -1,
        [0, 0, 0],
        [0, 0, 0, 1],
        linkMasses=ends,
        linkCollisionShapeIndices=[-1] * links,
        linkVisualShapeIndices=[-1] * links,
        linkPositions=[[x, 0, 0] for x in near],
        linkOrientations=[[0, 0, 0, 1]] * links,
        linkInertialFramePositions=[[x, 0, 0] for x in ends],
        linkInertialFrameOrientations=[[0, 0, 0, 1]] * links,
        linkParentIndices=joints,
        linkJointTypes=[pybullet.JOINT_REVOLUTE] * links,
        linkJointAxis=[[0, 0, 1]] * links,
        physicsClientId=client,
    )
    pybullet.setTimeStep(dt, physicsClientId=client)
    for j in joints:
        pybullet.changeDynamics(
            chain,
            j,
            linearDamping=2.0 * omega,
            angularDamping=2.0 * omega,
            jointDamping=0.0,
            localInertiaDiagonal=[_TURNING * h**3] * 3,
            physicsClientId=client,
        )
    pybullet.setJointMotorControlArray(
        chain, joints, pybullet.VELOCITY_CONTROL, forces=[0.0] * links, physicsClientId=client
    )
    unit = appendix_j.bending() / appendix_j.length() ** 2

    def rest(force: float) -> tuple[float, float]:
        """Tip across and along."""
        for j in joints:
            pybullet.resetJointState(chain, j, 0.0, 0.0, physicsClientId=client)
        for _ in range(steps):
            angle = [state[0] for state in pybullet.getJointStates(chain, joints, physicsClientId=client)]
            pybullet.setJointMotorControlArray(
                chain,
                joints,
                pybullet.TORQUE_CONTROL,
                forces=[-spring * q for q in angle],
                physicsClientId=client,
            )
            turned = sum(angle)  # the load in the last link's frame: cheaper than to ask where that is
            push = [force * math.sin(turned), force * math.cos(turned), 0.0]
            pybullet.applyExternalForce(
                chain, links - 1, push, [0, 0, 0], pybullet.LINK_FRAME, physicsClientId=client
            )
            pybullet.stepSimulation(physicsClientId=client)
        tip = pybullet.getLinkState(chain, links - 1, computeForwardKinematics=1, physicsClientId=client)[0]
        return tip[1], tip[0]

    def solve(force: Array) -> Array:
        return appendix_j.length() * np.array([rest(float(across) / unit) for across in force])

    try:
        yield solve
    finally:
        pybullet.disconnect(client)


def _rungs(half_ends: bool) -> Sequence[Rung]:
    return [Rung(f"{n} links", partial(_chain, n, half_ends)) for n in (2, 4, 8, 16)]


_ALSO = "dynamics, its own contact with friction between all bodies, any other robot in the same world."
EQUAL = Peer(
    name="PyBullet chain, equal links",
    modules=("pybullet",),
    packages=("pybullet",),
    same="the layout of SoMo's documentation, springs EI N/l by torques; a plane chain in units of the "
    "rod's own, critically damped. "
    "The calibration there (the first link's chord) would make every spring twice as stiff for many links.",
    also=_ALSO,
    rungs=partial(_rungs, False),
    family="PyBullet",
)
HALVES = Peer(
    name="PyBullet chain, half end links",
    modules=("pybullet",),
    packages=("pybullet",),
    same="the same with half a link fixed to the wall and half a link at the tip, as SoMo's URDF writer has "
    "it for a plane manipulator.",
    also=_ALSO,
    rungs=partial(_rungs, True),
    family="PyBullet",
)
