"""`Exploration`: the world of the scene `explore`, and the operator who drives its robots by the clock."""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np

from fastrod.control import ResolvedRate, SoftTip
from fastrod.hosts import BulletArm, BulletLink, HostCamera, MountedRod, connect
from fastrod.hosts.camera import Image
from fastrod.model.segment_actions import SegmentActions
from fastrod.rotation import product, quaternion_from_vector
from fastrod.types import Floats
from fastrod_scenes.robots import ur5_path
from fastrod_scenes.scene import SceneStage
from fastrod_scenes.ur5.box import COLORS, CORNERS, Box
from fastrod_scenes.ur5.carried import OFFSET, RADIUS, Bracket, eased, soft_robot
from fastrod_scenes.ur5.look import aim_jacobian, miss

ADAPTER = 0.03
"""Length of the bracket between flange and soft robot [m]."""
INTO = (0.5, 0.5, 0.5, 0.5)
"""Orientation of the flange as the robot enters, w x y z: its x, y, z are y, z, x of the world."""
BEFORE = 0.05
"""Distance from the straight robot's tip to the entry, before it enters [m]."""
STANDOFF = 0.03
"""Distance from the soft robot's base to the front wall, while it looks around [m]."""
ELBOW_UP = ((-0.4, -1.9, 1.8, 0.1, 1.1, 0.0), (-0.4, -1.9, 2.2, 2.8, -1.1, 3.1))
"""Joints of the UR5 about its pose before the entry, wrist in both directions [rad]."""
ENTRY = (0.006, 0.008, 0.008, 0.7, 0.06, 0.06)
"""Tolerance of a flange about the middle of the entry: displacement [m], and rotation about x, y and z
[rad]."""
EXTENSION = 0.03
"""Extension of a segment, in either direction [m]."""
LARGEST_BEND = 1.7
"""Largest bend of a segment [rad]."""
FORWARD, BACKWARD = (0.0, 0.3, 0.3), (-0.2, 1.2, 1.4)
"""Bends of the segments toward a corner that roughly look at it, in the back and in the front of the box
[rad]."""
APPROACH, ENTER, BEND, AIM, STRAIGHTEN, LEAVE = 2.0, 3.0, 1.2, 0.8, 1.2, 2.5
"""Phases of a run; `BEND` and `AIM` for each corner [s]."""
INSIDE = APPROACH + ENTER
"""The UR5 stands still from here ... [s]"""
AROUND = INSIDE + (BEND + AIM) * len(CORNERS)
"""All corners have been looked at [s]."""
OUT = AROUND + STRAIGHTEN
"""... to here [s]."""
END = OUT + LEAVE
"""[s]"""


class Look(NamedTuple):
    """A picture from the tip, and where it was taken."""

    image: Image
    eye: Floats
    """(3,) world [m]."""
    rotation: Floats
    """(3, 3) world_from_camera: right, up, and back from what it looks at."""
    miss: float
    """Miss of the line of sight from the middle of the corner's cube [m]."""


@final
class Exploration(SceneStage):
    """UR5, soft robot and box, and an operator who drives by the clock; where the robots start follows from
    the seed."""

    arm: BulletArm

    def __init__(self, box: Box, seed: int, dt: float) -> None:
        rng = np.random.default_rng(seed)
        self.box, self.dt = box, dt
        robot = soft_robot("explorer", 3, extension=EXTENSION)
        self.actions = SegmentActions(robot)
        self.world = connect(dt=dt)
        self.walls, self.cubes = box.build(self.world)
        self.arm = BulletArm.load(self.world, ur5_path(), tip="tool0")
        self.off = np.concatenate(
            [rng.uniform([-0.12, -0.1, -0.1], [-0.02, 0.1, 0.1]), rng.uniform(-0.3, 0.3, 3)]
        )
        """(6,) of the flange at the start from where it is before the entry: [m] and rotation vector [rad],
        world."""
        self.entry = rng.uniform(-1.0, 1.0, 6) * ENTRY
        """(6,) of the flange inside from the middle of the entry, square to it: [m] and rotation vector
        [rad], world."""
        self.q: Floats = self.arm.solve(self.flange(0.0), ELBOW_UP[rng.integers(len(ELBOW_UP))])
        """(6,) joints that the UR5 is driven to [rad]."""
        self.frozen = False
        """The UR5 holds still; only the soft robot moves."""
        self.arm.place(self.q)
        tool = BulletLink(self.world, self.arm.body, self.arm.tip)
        self.bracket = Bracket(tool, [((0.0, 0.0, 0.0), (0.0, 0.0, ADAPTER))], RADIUS)
        link = BulletLink(self.world, self.arm.body, self.arm.tip, position=(0.0, 0.0, ADAPTER))
        self.rod = MountedRod(robot, link, head_color=(0.1, 0.1, 0.1, 1.0), dynamics=False)
        self.rods = (self.rod,)
        self.action: Floats = np.zeros(self.actions.n_actions)
        """(9,) of the soft robot: extension and two displacements a segment [m]."""
        self.action.reshape(3, 3)[:, 1:] = OFFSET * rng.uniform(-0.3, 0.3, (3, 2))
        self._from = self.action
        lower, upper = SoftTip(self.rod.simulator).limits(LARGEST_BEND)
        self._aim = ResolvedRate(
            gain=8.0, lower=lower, upper=upper, rate=np.tile([0.03, 2.0 * OFFSET, 2.0 * OFFSET], 3)
        )
        self.camera = HostCamera(width=160, height=120, fov=70.0, near=0.005, far=2.0)
        self.looks: dict[int, Look] = {}
        """Looks of each corner, by its number."""
        self.rod.settle(**self.actions.inputs(self.action))

    def flange(self, t: float) -> Floats:
        """(7,) pose at time t [s] that the operator wants, world."""
        start, into = eased(t / APPROACH), eased((t - APPROACH) / ENTER) - eased((t - OUT) / LEAVE)
        before = self.box.front - BEFORE - self.actions.robot.length - ADAPTER
        x = before + into * (self.box.front - STANDOFF - ADAPTER - before)
        off = (1.0 - start) * self.off + self.entry
        return np.concatenate(
            [
                np.array([x, 0.0, self.box.height]) + off[:3],
                product(quaternion_from_vector(off[3:]), np.array(INTO)),
            ]
        )

    def posture(self, corner: int) -> Floats:
        """(9,) action that bends the robot roughly toward a corner [m], without regard to its weight."""
        state = self.rod.state
        assert state is not None
        aside = (self.box.corner(corner) - state.position[0, 0]) @ state.rotation[0, 0, :, :2]
        backward = CORNERS[corner].startswith("front")
        posture = np.zeros((3, 3))
        posture[0, 0] = EXTENSION if backward else -EXTENSION
        posture[:, 1:] = OFFSET * np.outer(BACKWARD if backward else FORWARD, aside / np.linalg.norm(aside))
        return posture.ravel()

    def advance(self, t: float) -> None:
        """Act as the operator at time t [s]: approach, enter, bend toward and aim at each corner one after
        the other, straighten, leave. After each aim a picture of the corner goes into `looks`."""
        end = t + self.dt
        corner, over = divmod(round((t - INSIDE) / self.dt), round((BEND + AIM) / self.dt))
        looking = 0 <= corner < len(CORNERS)
        frozen = INSIDE - 1e-9 < t < OUT - 1e-9
        if not frozen:
            self.q = self.arm.solve(self.flange(end), self.q)
            self.arm.drive(self.q)
        elif not self.frozen:
            self.arm.freeze()
        self.frozen = frozen
        bent = over * self.dt + self.dt - BEND
        if looking and bent > 1e-9:
            self._aim_at(corner)
        elif looking:
            self._go(self.posture(corner), over == 0, 1.0 + bent / BEND)
        elif frozen:
            self._go(np.zeros(9), abs(t - AROUND) < 1e-9, (end - AROUND) / STRAIGHTEN)
        elif end < APPROACH + 1e-9:
            self._go(np.zeros(9), t == 0.0, end / APPROACH)
        self.rod.step(**self.actions.inputs(self.action))
        self.follow_arm()
        if looking and bent > AIM - 1e-9:
            self.looks[corner] = self.look(corner)

    def follow_arm(self) -> None:
        """Put the bracket where the flange is."""
        self.bracket.follow()

    def _go(self, to: Floats, begins: bool, fraction: float) -> None:
        """Be at a fraction, from 0 to 1, of the path to an action."""
        if begins:
            self._from = self.action
        self.action = self._from + eased(fraction) * (to - self._from)

    def _aim_at(self, corner: int) -> None:
        """One step of the line of sight toward the cube in a corner."""
        tip, rotation = self.tip()
        point = self.box.cube_at(corner)
        jacobian = aim_jacobian(tip, rotation, point, self.rod.simulator.jacobian()[0] @ self.actions.matrix)
        rates = self._aim.rates(self.action, jacobian, miss(tip, rotation, point), np.zeros(2), self.dt)
        self.action = self.action + self.dt * rates

    def tip(self) -> tuple[Floats, Floats]:
        """Position (3,) world [m] and rotation (3, 3) world_from_tip."""
        state = self.rod.state
        assert state is not None
        return state.tip_position[0], state.tip_rotation[0]

    def picture(self) -> Image:
        """Return the picture from before the tip's cap, along d3; d2 is up in it."""
        _, rotation = self.tip()
        eye = self._eye()
        return self.camera.look(self.world, eye, eye + 0.1 * rotation[:, 2], rotation[:, 1])

    def _eye(self) -> Floats:
        tip, rotation = self.tip()
        return tip + 1.2 * RADIUS * rotation[:, 2]

    def look(self, corner: int) -> Look:
        """A picture of a corner, and by how much the line of sight misses its cube."""
        tip, rotation = self.tip()
        d1, d2, d3 = rotation.T
        off = float(np.linalg.norm(miss(tip, rotation, self.box.cube_at(corner))))
        return Look(self.picture(), self._eye(), np.stack([-d1, d2, -d3], axis=1), off)

    def seen(self, corner: int) -> tuple[int, float]:
        """Pixels of the picture of a corner that show its cube in its colour, and the largest distance of
        what they show from the cube [m]: of each pixel's point, by its depth, from the cube's true
        surface."""
        image, look = self.looks[corner].image, self.looks[corner]
        if corner not in self.cubes:
            return 0, 0.0
        hue = image.rgb / np.maximum(np.linalg.norm(image.rgb, axis=2, keepdims=True), 1.0)
        known = np.array(COLORS) / np.linalg.norm(COLORS, axis=1, keepdims=True)
        rows, columns = np.nonzero(
            (image.segmentation == self.cubes[corner]) & ((hue @ known.T).argmax(axis=2) == corner)
        )
        if not len(rows):
            return 0, 0.0
        pixel = 2.0 * np.tan(0.5 * np.radians(self.camera.fov)) / self.camera.height
        x = pixel * (columns + 0.5 - 0.5 * self.camera.width)
        y = pixel * (0.5 * self.camera.height - rows - 0.5)
        rays = np.stack([x, y, -np.ones(len(x))], axis=1) @ look.rotation.T
        points = look.eye + image.depth[rows, columns][:, None] * rays
        return len(rows), float(self.box.off_cube(corner, points).max())

    def arm_in_contact(self) -> bool:
        """The UR5 touches the box."""
        return any(p[8] <= 0.0 for p in self.world.getContactPoints(self.arm.body, self.walls))

    def arm_distance(self, within: float = 0.3) -> float:
        """Distance of the UR5's links from the box, at most `within` [m]."""
        return min(
            (float(p[8]) for p in self.world.getClosestPoints(self.arm.body, self.walls, within)),
            default=within,
        )

    def soft_clearance(self, within: float = 0.1) -> float:
        """Clearance of the soft robot from the box, at most `within` [m]; negative inside a wall."""
        near = (self.world.getClosestPoints(own, self.walls, within) for own in self.rod.bodies.ids)
        return min((float(p[8]) for points in near for p in points), default=within)
