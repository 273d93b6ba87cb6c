"""Two soft robots on one UR5, in opposite phase; the UR5 carries them, and feels both."""

from __future__ import annotations

import math
from typing import final

import numpy as np

from fastrod.hosts import BulletArm, BulletLink, MountedRod, connect
from fastrod.model.segment_actions import SegmentActions
from fastrod.rotation import matrix_from_quaternion, product, quaternion_from_vector
from fastrod.types import Floats
from fastrod_scenes.robots import ur5_path
from fastrod_scenes.scene import HostedScene, SceneStage
from fastrod_scenes.ur5.carried import OFFSET, RADIUS, Bracket, eased, soft_robot

APART, DEEP, PRONG = 0.06, 0.04, 0.02
"""Sizes of the fork: either prong from the flange's axis, the crossbar before the flange, length of a
prong [m]."""
TILT = math.radians(20.0)
"""Tilt of either prong, outward [rad]."""
FLANGE = (0.45, 0.10, 0.60, 0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0)
"""Pose in which the UR5 holds still: position [m] and quaternion w x y z, world; the flange looks down, the
fork is along y."""
DISPLACEMENT = (0.0, -0.09, 0.04)
"""Displacement from there, as the UR5 moves [m]: so slowly that a base, positioned by its mount's speed, lags
by less than `POSE_ERROR`."""
ROTATION = 0.15
"""About the vertical, meanwhile [rad]."""
ELBOW_UP = (0.0, -1.5, 1.6, -1.7, -1.57, 0.0)
"""Joints of the UR5 near that pose [rad]."""
PERIOD, STILL, MOVE = 2.0, 3.0, 6.0
"""Times of the soft robots' motion and of the UR5's [s]; of the UR5: at first it holds still, then it
moves [s]."""
BENDS = (0.35, 0.7)
"""Bends of the segments, base first [rad]."""
EXTENSION = 0.02
"""Extension of the outer segment, in either direction [m]."""
POSE_ERROR = 1e-6
"""Largest of a base from its mount [m], and of its axes."""
FORCE_ERROR = 1e-5
"""Largest of the mean sum of both forces from the weight [N]: their inertia evens out."""
WRENCH_ERROR = 1e-6
"""Largest of what the joints feel, of the largest torque among them."""
MIRROR_ERROR = 1e-6
"""Largest of one tip from the other's mirror image [m]."""
CLEARANCE = 0.02
"""Least between the soft robots, and from them to the UR5 [m]."""
_TAKE_UP = 10  # steps at rest, in which the motors take up the weight
_EVERY = 10  # steps between two looks at the clearance


def opposite(t: float) -> tuple[Floats, Floats]:
    """Actions (6,) of both soft robots at time t [s]: [m]. Each goes round; the second mirrors what the first
    does half a period later."""
    actions = []
    for side, phase in ((1.0, 2.0 * math.pi * t / PERIOD), (-1.0, 2.0 * math.pi * t / PERIOD + math.pi)):
        round_about = OFFSET * np.outer(BENDS, [side * math.cos(phase), math.sin(phase)])
        extension = np.array([[0.0], [EXTENSION * math.sin(phase)]])
        actions.append(np.concatenate([extension, round_about], axis=1).ravel())
    return actions[0], actions[1]


@final
class DualArmScene(SceneStage):
    """A UR5 with a fork at its flange, and a soft robot of two segments on either prong."""

    arm: BulletArm

    def __init__(self, dt: float) -> None:
        self.world = connect(dt=dt)
        # the motors' rates to the last digit
        self.world.setPhysicsEngineParameter(numSolverIterations=200, solverResidualThreshold=0.0)
        self.dt = dt
        self.arm = BulletArm.load(self.world, ur5_path(), tip="tool0")
        self.q: Floats = self.arm.solve(FLANGE, ELBOW_UP)
        """(6,) joints that the UR5 is driven to [rad]."""
        self.arm.place(self.q)
        for link in range(-1, self.world.getNumJoints(self.arm.body)):  # PyBullet's own, nothing of a UR5
            self.world.changeDynamics(
                self.arm.body, link, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0
            )
        robot = soft_robot("arm", 2, extension=EXTENSION)
        self.actions = SegmentActions(robot)
        self.mounts = [self._mount(side) for side in (1.0, -1.0)]
        """Position (3,) [m] and quaternion (4,) w x y z of both bases, flange_from_base."""
        links = [
            BulletLink(self.world, self.arm.body, self.arm.tip, position=m[:3], quaternion=m[3:])
            for m in self.mounts
        ]
        first, second = (
            MountedRod(robot, link, color=color, dynamics=False)  # their kinematics are what is shown
            for link, color in zip(links, ((0.5, 0.0, 0.6, 1.0), (0.0, 0.45, 0.5, 1.0)), strict=True)
        )
        self.rods = (first, second)
        middle = np.array([0.0, 0.0, DEEP])
        prongs = [
            (np.array([m[0] - math.copysign(PRONG * math.sin(TILT), m[0]), 0.0, DEEP]), m[:3])
            for m in self.mounts
        ]
        bars = [(np.zeros(3), middle), (prongs[0][0], prongs[1][0]), *prongs]
        self.bracket = Bracket(BulletLink(self.world, self.arm.body, self.arm.tip), bars, RADIUS)
        for rod, action in zip(self.rods, opposite(0.0), strict=True):
            rod.settle(**self.actions.inputs(action))
        for _ in range(_TAKE_UP):
            self._step(0.0)

    @staticmethod
    def _mount(side: float) -> Floats:
        x, z = APART + PRONG * math.sin(TILT), DEEP + PRONG * math.cos(TILT)
        return np.concatenate([[side * x, 0.0, z], quaternion_from_vector(np.array([0.0, side * TILT, 0.0]))])

    def flange(self, t: float) -> Floats:
        """(7,) pose at time t [s] that the UR5 is driven to, world."""
        fraction = eased((t - STILL) / MOVE)
        orientation = quaternion_from_vector(np.array([0.0, 0.0, fraction * ROTATION]))
        return np.concatenate(
            [
                np.array(FLANGE[:3]) + fraction * np.array(DISPLACEMENT),
                product(orientation, np.array(FLANGE[3:])),
            ]
        )

    def advance(self, t: float) -> None:
        """The soft robots go to `opposite` at the step's end; the UR5, from `STILL` on, to `flange` there."""
        end = t + self.dt
        if end > STILL:
            self.q = self.arm.solve(self.flange(end), self.q)
            self.arm.drive(self.q)
        self._step(end)

    def _step(self, t: float) -> None:
        self.begin(t)
        self.world.stepSimulation()
        for rod in self.rods:
            rod.end()
        self.follow_arm()

    def follow_arm(self) -> None:
        """Put the fork where the flange is."""
        self.bracket.follow()

    def begin(self, t: float) -> None:
        """Both soft robots, toward where they are at time t [s]; their wrenches act in the next step of the
        world."""
        for rod, action in zip(self.rods, opposite(t), strict=True):
            rod.begin(**self.actions.inputs(action))

    def bases(self) -> Floats:
        """(2,) how far either base is from its mount on the flange, as the measured joints have it: the
        larger of the position's error [m] and of any axis's."""
        flange = self.arm.frame(self.arm.position())
        orientation = matrix_from_quaternion(flange[None, 3:])[0]
        off = np.empty(2)
        for k, (rod, mount) in enumerate(zip(self.rods, self.mounts, strict=True)):
            assert rod.state is not None
            position, rotation = rod.state.position[0, 0], rod.state.rotation[0, 0]
            axes = orientation @ matrix_from_quaternion(mount[None, 3:])[0]
            off[k] = max(
                np.abs(position - flange[:3] - orientation @ mount[:3]).max(), np.abs(rotation - axes).max()
            )
        return off

    def tips(self) -> Floats:
        """(2, 3) of the soft robots, in the flange's frame [m]."""
        flange = self.arm.frame(self.arm.position())
        tips = np.stack([rod.state.tip_position[0] for rod in self.rods if rod.state is not None])
        return np.asarray((tips - flange[:3]) @ matrix_from_quaternion(flange[None, 3:])[0])

    def weight(self) -> float:
        """Weight of both soft robots, as long as they are now [N]: their mass per length stays as they
        extend."""
        density = self.actions.robot.segments[0].line_density
        return (
            9.81
            * density
            * sum(float(rod.state.arclength[0, -1]) for rod in self.rods if rod.state is not None)
        )

    def force(self) -> Floats:
        """(3,) sum that the UR5 felt in the last step, world [N]."""
        return self.rods[0].wrench[:3] + self.rods[1].wrench[:3]

    def clearance(self, within: float = 0.2) -> tuple[float, float]:
        """Between the soft robots, and from them to the UR5's links, at most `within` [m]."""
        first, second = (rod.bodies.ids for rod in self.rods)
        return self._gap(first, second, within), self._gap(first + second, [self.arm.body], within)

    def _gap(self, some: list[int], others: list[int], within: float) -> float:
        found = (self.world.getClosestPoints(a, b, within) for a in some for b in others)
        return min((float(p[8]) for points in found for p in points), default=within)

    def felt(self, t: float) -> tuple[Floats, Floats]:
        """Torques (6,) that the UR5's joints feel in a step to time t [s], and those of the sum of both
        wrenches, J^T F [N m].

        Felt is mass matrix times change of the joints' rates in one step, with the soft robots less without,
        motors off. Afterwards the world is as before; the soft robots are where they are at time t, and the
        motors off.
        """
        b, arm = self.world, self.arm
        joints = [
            b.getJointInfo(arm.body, j)[0]
            for j in range(b.getNumJoints(arm.body))
            if b.getJointInfo(arm.body, j)[3] > -1
        ]
        b.setJointMotorControlArray(arm.body, joints, b.VELOCITY_CONTROL, forces=[0.0] * len(joints))
        q = arm.position()
        mass = np.array(b.calculateMassMatrix(arm.body, q.tolist()))
        start = b.saveState()
        b.stepSimulation()
        free = arm.velocity()
        b.restoreState(start)
        points = [rod.host.motion().pose[:3] for rod in self.rods]
        self.begin(t)
        b.stepSimulation()
        felt = mass @ (arm.velocity() - free) / self.dt
        b.restoreState(start)
        b.removeState(start)
        total, tip = np.zeros(6), arm.frame(q)[:3]
        for rod, point in zip(self.rods, points, strict=True):
            total[:3] += rod.wrench[:3]
            total[3:] += rod.wrench[3:] + np.cross(point - tip, rod.wrench[:3])
        return felt, arm.jacobian(q).T @ total


@final
class DualArms(HostedScene):
    """The UR5 holds still for a while, then it moves and rotates; the soft robots never rest."""

    name = "dual_arm"
    about = "A UR5 carries two soft robots that move in opposite phase, and feels the sum of both."
    dt = 0.005
    duration = STILL + MOVE

    def stage(self) -> DualArmScene:
        """A new world, the soft robots settled and carried by the motors."""
        return DualArmScene(self.dt)

    def check(self) -> dict[str, float]:
        """Bases must be on their mounts, the UR5 must feel the weight of both robots and J^T F of their
        wrenches, the tips' paths must be mirror images, and nothing may come near anything else."""
        stage = self.stage()
        tips: list[Floats] = []
        off = torque = error = 0.0
        weight = np.zeros(3)
        gap = rigid = math.inf
        n, half = round(self.duration / self.dt), round(0.5 * PERIOD / self.dt)
        for k, t in enumerate(self.play(stage), 1):
            off = max(off, float(stage.bases().max()))
            weight = weight + (stage.force() + np.array([0.0, 0.0, stage.weight()])) / n
            if k % _EVERY == 0:
                gap, rigid = np.minimum((gap, rigid), stage.clearance()).tolist()
                self.expect(
                    gap > CLEARANCE,
                    f"at {t:.3g} s the soft robots are {gap:.3g} m apart; it must be {CLEARANCE:g} m.",
                )
                self.expect(
                    rigid > CLEARANCE,
                    f"at {t:.3g} s a soft robot is {rigid:.3g} m from the UR5; it must be {CLEARANCE:g} m.",
                )
            if t <= STILL + 1e-9:
                tips.append(stage.tips())
            if k == n:
                felt, expected = stage.felt(t + self.dt)
                torque = float(np.abs(expected).max())
                error = float(np.abs(felt - expected).max()) / torque
        path = np.array(tips)[half:]  # the first half period starts from rest
        mirror = float(np.abs(path[half:, 0] * [-1.0, 1.0, 1.0] - path[:-half, 1]).max())
        displacement = float(np.linalg.norm(np.ptp(path[:, 0], axis=0)))
        self.expect(off < POSE_ERROR, f"a base is {off:.3g} (m, or of its axes) off its mount on the flange.")
        self.expect(
            bool((np.abs(weight) < FORCE_ERROR).all()),
            f"the sum of both forces differs by {weight} N in the mean from the weight of both soft robots.",
        )
        self.expect(
            error < WRENCH_ERROR,
            f"what the joints feel differs by {error:.3g} from the torques of the sum of both wrenches.",
        )
        self.expect(displacement > 0.1, f"a tip's displacement is {displacement:.3g} m; it must go round.")
        self.expect(mirror < MIRROR_ERROR, f"the paths of the tips are {mirror:.3g} m off mirror images.")
        return {
            "base from its mount, m": off,
            "sum of forces from the weight, N": float(np.abs(weight).max()),
            "torque of the wrenches, N m": torque,
            "error of the torques": error,
            "tips from mirror images, m": mirror,
            "displacement of a tip, m": displacement,
            "clearance between the soft robots, m": gap,
            "clearance from the UR5, m": rigid,
        }
