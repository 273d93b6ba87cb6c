"""BoxExplore: a soft robot inside a box looks at the cube in one of its corners."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, final

import numpy as np

from fastrod.control import ResolvedRate
from fastrod.hosts import BulletArm, BulletLink, HostCamera, connect
from fastrod.hosts.bodies import RodBodies
from fastrod.hosts.camera import Image
from fastrod.model.robot import Robot
from fastrod.rotation import matrix_from_quaternion, product, quaternion_from_vector
from fastrod.types import Floats
from fastrod_envs.arms import SoftArm, arm_tube
from fastrod_envs.hosted import Cell, HostedResult, HostedTask
from fastrod_envs.options import EnvOptions
from fastrod_envs.task import Backdrop, Ball, DrawnLine, Field, Tube, solid_box
from fastrod_scenes.robots import ur5_path
from fastrod_scenes.ur5.box import COLORS, CORNERS, Box
from fastrod_scenes.ur5.carried import OFFSET, RADIUS, Bracket, soft_robot
from fastrod_scenes.ur5.exploration import (
    ADAPTER,
    BACKWARD,
    ELBOW_UP,
    ENTRY,
    EXTENSION,
    FORWARD,
    INTO,
    LARGEST_BEND,
    STANDOFF,
)
from fastrod_scenes.ur5.look import aim_jacobian, miss

STEP = 0.05
"""Longest time that one step of the soft robot takes [s]."""
START_BEND = 0.1
"""Largest bend of each segment at the start, either way [rad]."""
EXTENSION_RATE, BEND_RATE = 0.04, 2.0
"""Largest [m/s], [rad/s]."""
LEAST_PIXELS = 20
"""Least number of pixels of the cube in the tip's picture, for its corner to be seen (as the scene
`explore` has it)."""
FAR, FINE = 0.2, 0.03
"""The miss is observed twice, up to these lengths [m]."""
NEAR_WALL = 0.05
"""Clearance is observed up to this [m]."""
_EYE = HostCamera(width=160, height=120, fov=70.0, near=0.005, far=2.0)
_SMALL = HostCamera(width=48, height=36, fov=70.0, near=0.005, far=2.0)
_GREY = (0.35, 0.36, 0.38)
_HUES = np.array(COLORS) / np.linalg.norm(COLORS, axis=1, keepdims=True)
_ALIKE = 0.99  # cosine between a pixel's colour and the cube's
_POINTS = 10


@dataclass(frozen=True, kw_only=True)
class BoxExploreOptions(EnvOptions):
    """Options of BoxExplore."""

    camera: bool = False
    """Observe also where in the tip's picture the cube's colour is seen; a picture of 48 x 36 pixels is drawn
    in each step."""


@final
class BoxExplore(HostedTask):
    """Look at the cube in a corner of a box, into which a UR5 has put a soft robot, and touch no wall.

    The UR5 stands still; where its flange is (8 mm and 3 degrees around the middle of the entry), how the
    robot is bent at the start and which of the eight corners is the goal differ from episode to episode. Nine
    numbers drive the three segments: extension (0.04 m/s) and two bends (2 rad/s) each. The distance is what
    the line of sight, d3 of the tip, misses the middle of the cube by, along an arc about the tip [m].
    Success: it is below 10 mm, and the cube shows in 20 pixels or more of the tip's picture of 160 x 120, in
    its colour. Reward: exp(-m / 0.1 m) + exp(-m / 0.01 m), m the miss, and -1 at contact. Contact, less than
    the body's radius between backbone and a wall, ends the episode; otherwise it has 40 steps of 50 ms.
    `difficulty`: 0 has the four corners in the back, 1 all. Baseline: resolved rates of the line of sight,
    the rest of the motion toward the bends of the scene `explore`.
    """

    name = "BoxExplore"
    n_steps: ClassVar[int] = 40
    n_draws: ClassVar[int] = 14
    accuracy: float = 0.01
    duration: ClassVar[float] = 2.0
    options_class: ClassVar[type[EnvOptions]] = BoxExploreOptions

    def __init__(self, n_envs: int, options: EnvOptions) -> None:
        self.camera = isinstance(options, BoxExploreOptions) and options.camera
        robot = soft_robot("explorer", 3, extension=EXTENSION)
        low, high = _ranges()
        rate = np.tile([EXTENSION_RATE, BEND_RATE * OFFSET, BEND_RATE * OFFSET], 3)
        fast = options.action == "rate"
        unit, least, most = ("m/s", -rate, rate) if fast else ("m", low, high)
        about = f"{'rate of ' if fast else ''}extension and displacements toward d1, d2 of each segment"
        actions = (Field("displacement", unit, tuple(least), tuple(most), about),)
        box = Box()
        inside = tuple(box.corner(5) - [0.5, 0.2, 0.2]), tuple(box.corner(0) + 0.2)
        ones = ((-1.0,) * 3, (1.0,) * 3)
        goals = (
            Field(
                "cube",
                "m",
                tuple(box.cube_at(5)),
                tuple(box.cube_at(0)),
                "middle of the cube to look at, world",
            ),
        )
        states: tuple[Field, ...] = (
            *goals,
            Field("tip", "m", *inside, "world"),
            Field("right", "", *ones, "d1 of the tip, world"),
            Field("sight", "", *ones, "d3 of the tip, along which it looks, world"),
            Field(
                "miss",
                "m",
                (-FAR,) * 2,
                (FAR,) * 2,
                f"of the line of sight from the cube toward d1 and d2 of the tip, at most {FAR:g} m of it",
            ),
            Field("fine", "m", (-FINE,) * 2, (FINE,) * 2, f"the same, at most {FINE:g} m of it"),
            Field("far", "m", (0.0,), (1.0,), "from tip to cube"),
            Field("base", "m", *inside, "of the soft robot, world"),
            Field("base_right", "", *ones, "d1 of the base, world"),
            Field("base_sight", "", *ones, "d3 of the base, world"),
            Field(
                "clearance",
                "m",
                (-NEAR_WALL,),
                (NEAR_WALL,),
                f"least of the body from a wall, at most {NEAR_WALL:g} m either way",
            ),
            Field("posture", "", (-1.0,) * 9, (1.0,) * 9, "displacements, from their least to their largest"),
        )
        if self.camera:
            about = (
                "where the cube's colour is in the tip's picture, right and up from its middle, and its "
                "part of the picture; 0 0 0: nowhere"
            )
            states += (Field("seen", "", (-1.0, -1.0, 0.0), (1.0, 1.0, 1.0), about),)
        super().__init__(n_envs, options, robot, actions, states, goals)

    def cell(self) -> Cell:
        return _Inside(self)


class _Inside(Cell):
    """UR5, box and soft robot; the world holds them to be looked at, and is never stepped."""

    def __init__(self, task: BoxExplore) -> None:
        self.box, self.camera, self.at_once = Box(), task.camera, task.options.action == "displacement"
        self.accuracy, self.dt = task.accuracy, task.dt
        self.n_substeps = max(1, math.ceil(task.dt / STEP - 1e-9))
        self.world = connect()
        self.walls, self.cubes = self.box.build(self.world)
        self.arm = BulletArm.load(self.world, ur5_path(), tip="tool0")
        self.link = BulletLink(self.world, self.arm.body, self.arm.tip, position=(0.0, 0.0, ADAPTER))
        tool = BulletLink(self.world, self.arm.body, self.arm.tip)
        self.bracket = Bracket(tool, [((0.0, 0.0, 0.0), (0.0, 0.0, ADAPTER))], RADIUS)
        robot = task.base_robot
        self.soft = SoftArm(
            robot,
            dt=task.dt / self.n_substeps,
            points_per_segment=_POINTS,
            largest_bend=LARGEST_BEND,
            bend_rate=BEND_RATE,
            extension_rate=EXTENSION_RATE,
        )
        n = 3 * _POINTS
        self.bodies = RodBodies(
            self.world, robot.length, RADIUS, n, color=(*_GREY, 1.0), head_color=(0.1, 0.1, 0.1, 1.0)
        )
        self.corner = 0

    def begin(self, draws: Floats, difficulty: float, robot: Robot | None) -> None:
        self.corner = min(int(draws[0] * (4.0 + 4.0 * difficulty)), 7)
        entry = (2.0 * draws[1:7] - 1.0) * ENTRY
        at = np.array([self.box.front - STANDOFF - ADAPTER, 0.0, self.box.height]) + entry[:3]
        flange = np.concatenate([at, product(quaternion_from_vector(entry[3:]), np.array(INTO))])
        self.arm.place(self.arm.solve(flange, ELBOW_UP[int(draws[13] >= 0.5)]))
        start = np.zeros((3, 3))
        start[:, 1:] = (
            START_BEND * (2.0 * draws[7:13].reshape(3, 2) - 1.0) * self.soft.actions.offset[:, None]
        )
        self.soft.begin(robot, self.link.motion().pose, start.ravel())
        self._base_rotation = matrix_from_quaternion(self.soft.base[None, 3:])[0]
        self._goal = self.box.cube_at(self.corner)
        self._posture = self._toward_corner()
        self._notice(self._clearance())

    def act(self, action: Floats, duration: float) -> None:
        soft = self.soft
        gap = math.inf
        if self.at_once:
            soft.settle(0.5 * (soft.lower + soft.upper) + 0.5 * (soft.upper - soft.lower) * action)
            gap = self._clearance()
        for _ in range(0 if self.at_once else self.n_substeps):
            soft.drive(soft.action + duration / self.n_substeps * soft.rate * action)
            gap = min(gap, self._clearance())
            if gap < 0.0:
                break
        self._notice(gap)

    def result(self) -> HostedResult:
        seen = self._pixels() if self._off < self.accuracy else 0
        contact = self._gap < 0.0
        tip, far = self.soft.tip, float(np.linalg.norm(self._goal - self.soft.tip))
        return HostedResult(
            terms={
                "aim": math.exp(-self._off / 0.1),
                "precise": math.exp(-self._off / 0.01),
                "contact": -1.0 if contact else 0.0,
            },
            distance=self._off,
            success=self._off < self.accuracy and seen >= LEAST_PIXELS and not contact,
            position=tip + far * self.soft.tip_rotation[:, 2],
            desired=self._goal.copy(),
            terminated=contact,
            contact=contact,
            facts={"clearance": self._gap, "pixels": float(seen)},
        )

    def state(self) -> Floats:
        soft, rotation, base = self.soft, self.soft.tip_rotation, self._base_rotation
        shown, fine = (self._miss * (most / max(self._off, most)) for most in (FAR, FINE))
        far = np.linalg.norm(self._goal - soft.tip)
        blocks = [
            self._goal,
            soft.tip,
            rotation[:, 0],
            rotation[:, 2],
            shown,
            fine,
            [far],
            soft.base[:3],
            base[:, 0],
            base[:, 2],
            [min(max(self._gap, -NEAR_WALL), NEAR_WALL)],
            soft.posture(),
        ]
        if self.camera:
            blocks.append(self._where())
        return np.concatenate(blocks)

    def goal(self) -> Floats:
        return self._goal

    def baseline(self) -> Floats:
        soft = self.soft
        jacobian = aim_jacobian(soft.tip, soft.tip_rotation, self._goal, soft.jacobian())
        control = ResolvedRate(
            gain=6.0,
            lower=soft.lower,
            upper=soft.upper,
            rate=soft.rate,
            weight=soft.rate**-2.0,
            error_limit=0.1,
            damping=1e-3,
            posture=self._posture,
            posture_gain=4.0,
        )
        rates = control.rates(soft.action, jacobian, self._miss, np.zeros(2), STEP)
        if not self.at_once:
            return np.asarray(rates / soft.rate)
        to = soft.action + STEP * rates
        return np.asarray((2.0 * to - soft.lower - soft.upper) / np.maximum(soft.upper - soft.lower, 1e-12))

    def backdrop(self) -> Backdrop:
        solids = []
        for piece in self.box.pieces():
            c, s = math.cos(piece.angle), math.sin(piece.angle)
            rotation = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
            solids.append(solid_box(piece.middle, piece.half, piece.color[:3], rotation, 0.2))
        solids += [solid_box(self.box.cube_at(k), [0.5 * self.box.cube] * 3, COLORS[k]) for k in self.cubes]
        far = np.linalg.norm(self._goal - self.soft.tip)
        sight = np.stack([self.soft.tip, self.soft.tip + far * self.soft.tip_rotation[:, 2]])
        return Backdrop(
            tubes=(Tube(self.soft.nodes, RADIUS, _GREY), arm_tube(self.arm)),
            balls=(Ball(self._goal, 0.022, COLORS[self.corner]),),
            solids=tuple(solids),
            lines=(DrawnLine(sight, (0.9, 0.1, 0.1)),),
            eye=(0.5, -1.1, 0.9),
            target=(0.8, 0.0, 0.45),
        )

    def picture(self, width: int, height: int) -> np.ndarray:
        """Return a picture from the side, its wall cut away, and in a corner what the tip sees."""
        self._pose()
        side = HostCamera(width=width, height=height, fov=36.0, near=0.8005, far=4.0)
        rgb = side.look(self.world, (0.78, -1.0, 0.45), (0.78, 0.0, 0.45)).rgb
        small = self._look(
            HostCamera(width=max(width // 4, 1), height=max(height // 4, 1), fov=70.0, near=0.005, far=2.0)
        ).rgb
        rgb[: small.shape[0], : small.shape[1]] = small
        return rgb

    def close(self) -> None:
        self.world.disconnect()

    def _notice(self, gap: float) -> None:
        """Update what observation and reward need."""
        self._gap = gap
        self._miss = miss(self.soft.tip, self.soft.tip_rotation, self._goal)
        self._off = float(math.hypot(*self._miss))

    def _toward_corner(self) -> Floats:
        """(9,) action that roughly looks at the corner [m], as the operator of the scene bends it."""
        aside = (self.box.corner(self.corner) - self.soft.base[:3]) @ self._base_rotation[:, :2]
        backward = CORNERS[self.corner].startswith("front")
        posture = np.zeros((3, 3))
        posture[0, 0] = self.soft.upper[0] if backward else self.soft.lower[0]
        bends = self.soft.actions.offset * (BACKWARD if backward else FORWARD)
        posture[:, 1:] = np.outer(bends, aside / np.linalg.norm(aside))
        return posture.ravel()

    def _clearance(self) -> float:
        """Least of the body from walls and entry [m], negative inside one."""
        box, (x, y, z) = self.box, self.soft.nodes.T
        depth, width, tall = box.inner
        y, z = np.abs(y), np.abs(z - box.height)
        walls = np.minimum(np.minimum(0.5 * width - y, 0.5 * tall - z), box.front + box.wall + depth - x)
        # from the sides of the octagon, inward
        open_by = box.entry - np.maximum(np.maximum(y, z), math.sqrt(0.5) * (y + z))
        before = np.maximum(np.maximum(box.front - x, x - box.front - box.wall), 0.0)
        entry = np.where(open_by > 0.0, np.hypot(open_by, before), np.where(before > 0.0, before, open_by))
        return float(np.where(x > box.front + box.wall, np.minimum(walls, entry), entry).min()) - RADIUS

    def _pose(self) -> None:
        """The world as the soft robot is, for pictures."""
        self.bodies.place(self.soft.nodes, self.soft.rotations)
        self.bracket.follow()

    def _look(self, camera: HostCamera) -> Image:
        """Take a picture from before the tip's cap, along d3; d2 is up in it."""
        rotation = self.soft.tip_rotation
        eye = self.soft.tip + 1.2 * RADIUS * rotation[:, 2]
        return camera.look(self.world, eye, eye + 0.1 * rotation[:, 2], rotation[:, 1])

    def _pixels(self) -> int:
        """Return the number of pixels of the cube, in its colour, in the tip's picture."""
        self._pose()
        image = self._look(_EYE)
        hue = image.rgb / np.maximum(np.linalg.norm(image.rgb, axis=2, keepdims=True), 1.0)
        return int(
            (
                (image.segmentation == self.cubes[self.corner])
                & ((hue @ _HUES.T).argmax(axis=2) == self.corner)
            ).sum()
        )

    def _where(self) -> Floats:
        """(3,) where the cube's colour is in a small picture."""
        self._pose()
        rgb = self._look(_SMALL).rgb
        hue = rgb / np.maximum(np.linalg.norm(rgb, axis=2, keepdims=True), 1.0)
        rows, columns = np.nonzero(hue @ _HUES[self.corner] > _ALIKE)
        if not len(rows):
            return np.zeros(3)
        right = (columns.mean() + 0.5) / (0.5 * _SMALL.width) - 1.0
        up = 1.0 - (rows.mean() + 0.5) / (0.5 * _SMALL.height)
        return np.array([right, up, len(rows) / rgb[..., 0].size])


def _ranges() -> tuple[Floats, Floats]:
    """Least and largest action (9,) [m]."""
    high = np.tile([EXTENSION, LARGEST_BEND * OFFSET, LARGEST_BEND * OFFSET], 3)
    return -high, high
