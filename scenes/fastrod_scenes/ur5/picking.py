"""`Picking`: a UR5 with a soft robot of the paper's class, a table, a cube and a spot to put it on, and the
script that does it."""

from __future__ import annotations

import math
from typing import NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.hosts import BulletArm, BulletLink, SoftManiSim, connect
from fastrod.hosts.link import from_xyzw, to_xyzw
from fastrod.hosts.paper import paper_robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.rotation import matrix_from_quaternion, product, quaternion_from_matrix
from fastrod.simulator import Simulator
from fastrod.types import Floats
from fastrod_scenes.robots import ur5_path
from fastrod_scenes.scene import HostedWorld, SoftBody
from fastrod_scenes.ur5.carried import Bracket, eased

SIDE = 0.03
"""Side of the cube [m]."""
TOP = 0.15
"""Height of the table [m]."""
SPOT = (0.5, 0.16)
"""Target of the cube, world [m]."""
HOME = (0.42, 0.0, TOP + 0.22)
"""Position of the tip at the start, world [m]."""
LIFT = 0.14
"""[m]"""
BEND = 1.0
"""Bend of the soft robot when it puts the cube down, base to tip [rad]; it is straight when it picks it
up."""
ADAPTER = 0.04
"""Size of the bracket between flange and soft robot [m]."""
RADIUS = 0.015
"""Radius of the soft robot's body [m]."""
WIDTH = 0.05
"""Between the open fingers [m]."""
_HEAD = RADIUS + 0.0025  # m, the head's radius
# m, onto the table before it lets go: PyBullet's boxes touch where they overlap, and what is above falls onto
# an edge
_PRESS = 1e-4
# m from the cube to the head that grasps it by suction, which needs contact, and by fingers
_ABOVE = 0.0005, 0.003
# world_from_tip; the robot bends toward its d1, world -y
_DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# flange_from_robot: the straight robot, its +y, points out of the flange
_MOUNT = np.sqrt(0.5) * np.array([1.0, 1.0, 0.0, 0.0])
_ORIGIN = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
_ELBOW_UP = (0.3, -1.5, 1.5, -1.5, -1.57, 0.3)  # rad


class Phase(NamedTuple):
    """A phase of the script: the tip's goal, in one motion that begins and ends at rest."""

    name: str
    duration: float
    """[s]"""
    tip: tuple[float, float, float]
    """World, at its end [m]."""
    bend: float
    """Bend of the soft robot, at its end [rad]."""


class Cube(NamedTuple):
    """Object that is picked up: a cube, parallel to the world's axes."""

    start: tuple[float, float] = (0.5, -0.14)
    """x and y of its middle, world [m]."""
    mass: float = 0.08
    """[kg]"""
    friction: float = 0.5
    """Coefficient, by which PyBullet multiplies that of what it touches: 0.5 of the table, 2 of the
    fingers."""


def script(cube: Cube, fingers: bool) -> tuple[Phase, ...]:
    """The phases, one after the other, from `HOME`."""
    x, y = cube.start
    low, high = TOP + SIDE + _ABOVE[fingers] + _HEAD, TOP + SIDE + _HEAD + LIFT
    wait = 0.6 if fingers else 0.1
    return (
        Phase("approach", 0.8, (x, y, high), 0.0),
        Phase("descend", 0.7, (x, y, low), 0.0),
        Phase("grasp", wait, (x, y, low), 0.0),
        Phase("lift", 0.7, (x, y, high), 0.0),
        Phase("carry", 1.4, (*SPOT, high), BEND),
        Phase("lower", 0.8, (*SPOT, low - _PRESS), BEND),
        Phase("release", wait, (*SPOT, low - _PRESS), BEND),
        Phase("retreat", 0.6, (*SPOT, high), BEND),
        Phase("rest", 0.2, (*SPOT, high), BEND),
    )


def duration(*, fingers: bool) -> float:
    """Duration of the script [s]."""
    return math.fsum(phase.duration for phase in script(Cube(), fingers))


@final
class Picking(HostedWorld):
    """The arm follows from the script: it brings the flange to where the tip is as scripted, with the bend
    that the soft robot has.

    The soft robot's base is where the flange will be at the end of the step, by its measured motion. The arm
    does not feel the soft robot, nor does the cube bend it: `SoftManiSim` has its own shape.
    """

    def __init__(self, cube: Cube, fingers: bool, dt: float) -> None:
        """`fingers` that hold by friction, or a head that holds by suction."""
        self.dt, self.fingers = dt, fingers
        self.world = b = connect(dt=dt)
        self.table = self._furnish()
        self.arm = BulletArm.load(b, ur5_path(), tip="tool0")
        flange = BulletLink(b, self.arm.body, self.arm.tip)
        self.mount = BulletLink(
            b, self.arm.body, self.arm.tip, position=(0.0, 0.0, ADAPTER), quaternion=_MOUNT
        )
        """The soft robot's base on the flange."""
        robot = paper_robot(2, RADIUS)
        self._actions, self._model = SegmentActions(robot), Simulator(robot, threads=1)
        self._planned: tuple[float, Floats] | None = None
        self.script = script(cube, fingers)
        self._ends = np.cumsum([phase.duration for phase in self.script])
        self._before = Phase("home", 0.0, HOME, 0.0)
        self.phase = self.script[0]
        """Phase of the last step."""
        self._bend = 0.0
        self._q = self._joints(np.array(HOME), 0.0, np.array(_ELBOW_UP))
        self.arm.place(self._q)
        self._bracket = Bracket(flange, [((0.0, 0.0, 0.0), (0.0, 0.0, ADAPTER))], 0.012)
        known = {b.getBodyUniqueId(i) for i in range(b.getNumBodies())}
        self.sim = SoftManiSim(
            b,
            body_sphere_radius=RADIUS,
            number_of_sphere=13,
            number_of_segment=2,
            robot=robot,
            max_grasp_width=WIDTH * fingers,
        )
        self.soft = [i for i in map(b.getBodyUniqueId, range(b.getNumBodies())) if i not in known]
        """Bodies of the soft robot, its gripper included."""
        self.cube = self.sim.add_a_cube(
            [*cube.start, TOP + 0.5 * SIDE], size=[SIDE] * 3, mass=cube.mass, color=(0.9, 0.45, 0.1, 1.0)
        )
        b.changeDynamics(self.cube, -1, lateralFriction=cube.friction)
        self._follow()

    @property
    def soft_bodies(self) -> tuple[SoftBody, ...]:
        """The one, settled where its base is; its gripper is none of its capsules."""
        pose, b = self._place.copy(), self.world
        # fastrod's frame of the base: d3 along the robot's +y
        pose[3:] = product(pose[3:], _MOUNT * [1.0, -1.0, -1.0, -1.0])
        state = self._model.settle(**self._actions.inputs(self._action(self._bend)), base_pose=pose)
        capsules = (
            i
            for i in self.soft
            if any(shape[2] == b.GEOM_CAPSULE for shape in b.getCollisionShapeData(i, -1))
        )
        return (SoftBody(self._model.robots[0], state, tuple(capsules)),)

    @property
    def tip(self) -> tuple[Floats, Floats]:
        """Position (3,) world [m] and rotation (3, 3) world_from_tip."""
        return self.points[-1, :3], matrix_from_quaternion(from_xyzw(self.points[-1:, 3:]))[0]

    @property
    def bend(self) -> float:
        """Angle between the tangents at base and tip [rad]."""
        ends = matrix_from_quaternion(from_xyzw(self.points[[0, -1], 3:]))[:, :, 2]
        return float(np.arctan2(np.linalg.norm(np.cross(*ends)), ends[0] @ ends[1]))

    def cube_pose(self) -> tuple[Floats, Floats]:
        """Pose of the cube: position (3,) world [m] and rotation (3, 3) world_from_cube."""
        position, quaternion = self.world.getBasePositionAndOrientation(self.cube)
        return np.array(position), matrix_from_quaternion(from_xyzw(quaternion)[None])[0]

    def cube_from_tip(self) -> Floats:
        """(3,) middle of the cube in the tip's frame [m]."""
        tip, rotation = self.tip
        return np.asarray(rotation.T @ (self.cube_pose()[0] - tip))

    def cube_speed(self) -> float:
        """[m/s]"""
        return float(np.linalg.norm(self.world.getBaseVelocity(self.cube)[0]))

    @property
    def mass(self) -> float:
        """Mass of the cube, as the world has it [kg]."""
        return float(self.world.getDynamicsInfo(self.cube, -1)[0])

    def off_flange(self) -> float:
        """Distance of the soft robot's base from its mount [m]."""
        return float(np.linalg.norm(self.mount.motion().pose[:3] - self.points[0, :3]))

    def clearance(self, bodies: list[int], other: int, within: float = 0.2) -> float:
        """Least distance of any of these bodies from another one [m], at most `within`; negative where they
        overlap."""
        near = (p[8] for body in bodies for p in self.world.getClosestPoints(body, other, within))
        return float(min(near, default=within))

    def advance(self, t: float) -> None:
        """Tip and bend go from one phase's end to the next one's, at rest at both; the head takes hold as
        `grasp` begins, and lets go as
        `release` does."""
        end = t + self.dt
        k = min(int(np.searchsorted(self._ends, end - 1e-9)), len(self.script) - 1)
        phase, before = self.script[k], self.script[k - 1] if k else self._before
        if phase is not self.phase:
            self.phase = phase
            self._operate_gripper(phase.name)
        if (phase.tip, phase.bend) == (before.tip, before.bend):
            self.sim.wait(self.dt)
            return
        fraction = eased(1.0 - (float(self._ends[k]) - end) / phase.duration)
        self._bend = before.bend + fraction * (phase.bend - before.bend)
        tip = np.array(before.tip) + fraction * np.subtract(phase.tip, before.tip)
        self._q = self._joints(tip, self._bend, self._q)
        self.arm.drive(self._q)
        self._follow()

    def _operate_gripper(self, phase: str) -> None:
        """Take hold, or let go, where this phase begins with it."""
        if phase not in ("grasp", "release"):
            return
        if self.fingers:
            self.sim.set_grasp_width(0.0 if phase == "grasp" else 1.0)
        else:
            self.sim.suction_grasp(phase == "grasp")

    def _follow(self) -> None:
        """One step of the world, at the end of which the soft robot is on the flange."""
        self._place = self.mount.motion().after(self.dt)
        action = self._action(self._bend)
        self.points, _ = self.sim.move_robot_ori(
            action, self._place[:3], to_xyzw(self._place[3:]), camera_marker=False
        )
        self._bracket.follow()

    def _joints(self, tip: Floats, bend: float, near: ArrayLike) -> Floats:
        """Return the joint positions (6,) that bring the tip of the soft robot of this bend to a point,
        looking down."""
        if self._planned is None or self._planned[0] != bend:
            state = self._model.settle(**self._actions.inputs(self._action(bend)), base_pose=_ORIGIN)
            self._planned = (
                bend,
                np.concatenate([state.tip_rotation[0], state.tip_position[0][:, None]], axis=1),
            )
        from_base = self._planned[1]
        orientation = _DOWN @ from_base[:, :3].T  # world_from_flange: the rod's axes are the flange's
        flange = tip - orientation @ (from_base[:, 3] + [0.0, 0.0, ADAPTER])
        return self.arm.solve(np.concatenate([flange, quaternion_from_matrix(orientation[None])[0]]), near)

    def _action(self, bend: float) -> Floats:
        """Return extensions and displacements (6,) [m] of both segments, which bend alike, toward d1."""
        return np.ravel([(0.0, 0.5 * bend * offset, 0.0) for offset in self._actions.offset])

    def _furnish(self) -> int:
        """Floor, spot, and the table, whose body this returns."""
        b = self.world
        half, middle = [0.2, 0.32, 0.01], [0.52, 0.0, TOP - 0.01]
        wood = b.createVisualShape(b.GEOM_BOX, halfExtents=half, rgbaColor=[0.80, 0.72, 0.60, 1.0])
        table: int = b.createMultiBody(
            0.0, b.createCollisionShape(b.GEOM_BOX, halfExtents=half), wood, middle
        )
        plinth = b.createVisualShape(
            b.GEOM_BOX, halfExtents=[0.12, 0.22, 0.5 * TOP - 0.01], rgbaColor=[0.45, 0.47, 0.50, 1.0]
        )
        floor = b.createVisualShape(
            b.GEOM_BOX, halfExtents=[1.0, 1.0, 0.01], rgbaColor=[0.85, 0.86, 0.88, 1.0]
        )
        spot = b.createVisualShape(
            b.GEOM_CYLINDER, radius=0.03, length=0.001, rgbaColor=[0.10, 0.55, 0.25, 1.0]
        )
        for seen, place in (
            (plinth, [*middle[:2], 0.5 * TOP - 0.01]),
            (floor, [0.0, 0.0, -0.011]),
            (spot, [*SPOT, TOP + 0.0002]),
        ):
            b.createMultiBody(0.0, -1, seen, place)
        return table
