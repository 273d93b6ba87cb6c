"""PickPlace: a UR5 with a soft robot picks a cube from a table and puts it on a spot, by suction or with two
fingers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal, final

import numpy as np

from fastrod.control import ResolvedRate
from fastrod.hosts import Bullet, BulletArm, BulletLink, HostCamera, connect
from fastrod.hosts.bodies import RodBodies
from fastrod.hosts.gripper import Gripper
from fastrod.hosts.link import from_xyzw, to_xyzw
from fastrod.model.robot import Robot
from fastrod.rotation import matrix_from_quaternion, quaternion_from_matrix, rotation_between
from fastrod.types import Floats
from fastrod_envs.arms import SoftArm, arm_tube, short
from fastrod_envs.hosted import Cell, HostedResult, HostedTask
from fastrod_envs.options import EnvOptions
from fastrod_envs.task import Backdrop, Ball, Field, Tube, solid_box
from fastrod_scenes.robots import ur5_path
from fastrod_scenes.ur5.carried import RADIUS, Bracket, soft_robot
from fastrod_scenes.ur5.picking import ADAPTER, SIDE, TOP, WIDTH

Grip = Literal["suction", "gripper"]
HOME = (0.5, 0.0, TOP + SIDE + 0.11)
"""Position of the tip at the start without its weight, world [m]."""
CUBE, SPOT = (0.5, -0.12), (0.5, 0.12)
"""Middle of where the cube starts, and of where it is to go, world [m]."""
SPREAD = (0.08, 0.07)
"""Largest distance of either from there, in x and in y [m]."""
NEAREST = 0.04
"""Least distance of cube and spot from y = 0 at difficulty 0 [m]."""
SPEED, BEND_RATE = 0.25, 1.0
"""Largest of the tip along x, y and z [m/s], and of the bend [rad/s]."""
BEND, START_BEND = 0.8, 0.3
"""Largest of the soft robot, base to tip, either way; at the start [rad]."""
REST = 0.02
"""Largest speed of a cube that rests [m/s]."""
LIFT, PRESS = 0.06, 0.006
"""Heights of the baseline [m]: how high it lifts the cube, and how far below a place it aims, so that it
gets there [m]."""
NEAR = 0.05
"""Errors are observed up to this length [m]."""
_HEAD = RADIUS + 0.0025  # m
_ABOVE = {"suction": 0.0, "gripper": 0.003}  # m, least from the head to the top of a cube on the table
_HIGH = 0.16  # m, of the tip's range above that
_RANGE = ((0.36, 0.64), (-0.26, 0.26))  # m, of the tip in x and y
_SUBSTEP, _DT = 0.05, 0.01  # s, longest step of arm and soft robot, of the world
_HEAD_MASS = 0.05  # kg
_CALM = 0.625  # of the baseline's pace, across with the cube, which swings
_MASS, _TABLE = 0.05, ((0.5, 0.0, TOP - 0.01), (0.2, 0.32, 0.01))  # kg; middle and half size
# world_from_tip without weight; it bends toward d1, world -y
_DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_ELBOW_UP = (0.3, -1.5, 1.5, -1.5, -1.57, 0.3)  # rad
_ORANGE, _WOOD, _GREEN, _BODY = (0.9, 0.45, 0.1), (0.8, 0.72, 0.6), (0.1, 0.55, 0.25), (0.5, 0.0, 0.6)
_POINTS = 5


@dataclass(frozen=True, kw_only=True)
class PickPlaceOptions(EnvOptions):
    """Options of PickPlace."""

    grip: Grip = "suction"
    """`suction`: the head holds what it touches; `gripper`: two fingers hold by friction."""


@final
class PickPlace(HostedTask):
    """Pick a cube from a table and put it on a spot, with a soft robot on a UR5.

    An action is what an operator gives: velocity of the tip along x, y, z (up to 0.25 m/s), rate of the
    soft robot's bend (up to 1 rad/s), and the grip, on above 0. The UR5's joints follow by resolved
    rates, so that the tip moves as commanded while the soft robot bends and looks down; the robot's own
    weight, which arm and operator do not reckon with, moves it aside by some millimetres. The tip stays
    above a cube that lies on the table. Cube and spot differ from episode to episode by 8 cm in x and 7
    cm in y each way, and the bend at the start by 0.3 rad; with `difficulty` from 1 to 0 both come to the
    middle, 8 cm apart.

    Distance: of the cube's middle from where it is to lie [m]. Success: below 20 mm, released, slower than
    0.02 m/s. Reward, each step: 0.2 exp(-g / 0.05 m), g from the tip to where it grasps the cube, or 0.2 once
    the cube is held or lies on the spot; 0.3 while it is held or lies there; 0.5 exp(-d / 0.1 m) - 0.5
    exp(-d0 / 0.1 m), d the distance, d0 that at the start; 1 for success; -1 where the cube falls from the
    table, which ends the episode. Otherwise it has 60 steps of 0.1 s. The cube bends the soft robot, and
    swings on it.
    Baseline: down where it is above the cube, up, across, down where the cube is above the spot, off.
    """

    name = "PickPlace"
    n_steps: ClassVar[int] = 60
    n_draws: ClassVar[int] = 5
    accuracy: float = 0.02
    duration: ClassVar[float] = 6.0
    options_class: ClassVar[type[EnvOptions]] = PickPlaceOptions

    def __init__(self, n_envs: int, options: EnvOptions) -> None:
        self.grip: Grip = options.grip if isinstance(options, PickPlaceOptions) else "suction"
        low, high = tip_range(self.grip)
        grip = Field("grip", "", (-1.0,), (1.0,), "on above 0")
        if options.action == "rate":
            actions = (
                Field("velocity", "m/s", (-SPEED,) * 3, (SPEED,) * 3, "of the tip, world"),
                Field("bend_rate", "rad/s", (-BEND_RATE,), (BEND_RATE,), "of the soft robot"),
                grip,
            )
        else:
            actions = (
                Field(
                    "tip", "m", tuple(low), tuple(high), f"where it goes, at most with {SPEED:g} m/s, world"
                ),
                Field(
                    "bend", "rad", (-BEND,), (BEND,), f"of the soft robot, at most with {BEND_RATE:g} rad/s"
                ),
                grip,
            )
        corners = (SPOT[0] - SPREAD[0], NEAREST, TOP), (SPOT[0] + SPREAD[0], SPOT[1] + SPREAD[1], TOP + SIDE)
        near, ones = ((-NEAR,) * 3, (NEAR,) * 3), ((-1.0,) * 3, (1.0,) * 3)
        goals = (Field("spot", "m", *corners, "where the cube's middle is to be, world"),)
        states = (
            *goals,
            Field("cube", "m", *_cube_range(), "its middle, world"),
            Field("tip", "m", tuple(low - 0.1), tuple(high + 0.1), "world"),
            Field("direction", "", *ones, "of the tip's tangent, world"),
            Field(
                "to_cube", "m", *near, f"from the tip to where it grasps the cube, at most {NEAR:g} m of it"
            ),
            Field("to_spot", "m", *near, f"from the cube to the spot, at most {NEAR:g} m of it"),
            Field("bend", "rad", (-BEND,), (BEND,), "as driven"),
            Field(
                "grip",
                "",
                (0.0, 0.0, 0.0),
                (1.0, 1.0, 1.0),
                "commanded to hold; opening of the fingers, 0 closed; the cube is held",
            ),
        )
        super().__init__(n_envs, options, soft_robot("picker", 2, line_density=0.03), actions, states, goals)

    def cell(self) -> Cell:
        return _Table(self)


def tip_range(grip: Grip) -> tuple[Floats, Floats]:
    """(3,) least and largest place of the tip, world [m]."""
    least = TOP + SIDE + _HEAD + _ABOVE[grip]
    return np.array([_RANGE[0][0], _RANGE[1][0], least]), np.array(
        [_RANGE[0][1], _RANGE[1][1], least + _HIGH]
    )


def _cube_range() -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    (x, y, _), (a, b, _) = _TABLE
    return (x - a - 0.1, y - b - 0.1, 0.0), (x + a + 0.1, y + b + 0.1, TOP + 0.4)


class _Table(Cell):
    """Two worlds: one of table, cube and gripper, made anew for every episode, and one with the arm, for its
    kinematics and pictures."""

    def __init__(self, task: PickPlace) -> None:
        self.grip = task.grip
        self.at_once = task.options.action == "displacement"
        self.accuracy = task.accuracy
        self.n_substeps = max(1, math.ceil(task.dt / _SUBSTEP - 1e-9))
        self.n_steps = max(1, math.ceil(task.dt / self.n_substeps / _DT - 1e-9))
        self.step = task.dt / (self.n_substeps * self.n_steps)
        self.low, self.high = tip_range(task.grip)
        self.above = np.array([0.0, 0.0, 0.5 * SIDE + _HEAD + _ABOVE[task.grip]])
        self.width = WIDTH if task.grip == "gripper" else 0.0
        self.world = connect(dt=self.step)
        self.shown = connect()
        self.arm = BulletArm.load(self.shown, ur5_path(), tip="tool0")
        self.home = self.arm.solve(_flange(np.array(HOME), 0.0, task.base_robot.length), _ELBOW_UP)
        self.bracket = Bracket(
            BulletLink(self.shown, self.arm.body, self.arm.tip),
            [((0.0, 0.0, 0.0), (0.0, 0.0, ADAPTER))],
            RADIUS,
        )
        robot = task.base_robot
        self.soft = SoftArm(
            robot,
            dt=task.dt / self.n_substeps,
            points_per_segment=_POINTS,
            largest_bend=0.5 * BEND,
            bend_rate=BEND_RATE,
            extension_rate=0.01,
        )
        self._joints = ResolvedRate(
            gain=1.0 / self.soft.dt,
            damping=1e-3,
            threshold=math.inf,
            lower=self.arm.lower,
            upper=self.arm.upper,
            rate=self.arm.velocity_limit,
        )
        self.bodies = RodBodies(self.shown, robot.length, RADIUS, 2 * _POINTS, color=(*_BODY, 1.0))
        self.shown_cube, self.shown_spot, self.shown_gripper = _furnish(self.shown, self.width)

    def begin(self, draws: Floats, difficulty: float, robot: Robot | None) -> None:
        off = difficulty * (2.0 * draws[:4].reshape(2, 2) - 1.0) * SPREAD
        side = np.array(
            [
                [CUBE[0], -NEAREST + difficulty * (CUBE[1] + NEAREST)],
                [SPOT[0], NEAREST + difficulty * (SPOT[1] - NEAREST)],
            ]
        )
        (start, spot), z = side + off, TOP + 0.5 * SIDE
        self.spot = np.array([*spot, z])
        self.bend = START_BEND * difficulty * (2.0 * float(draws[4]) - 1.0)
        self.flange = _flange(np.array(HOME), self.bend, self.soft.actions.robot.length)
        self.q = self.arm.solve(self.flange, self.home)
        self.soft.begin(robot, self._base(), self._action())
        b = self.world
        b.resetSimulation()
        b.setGravity(0.0, 0.0, -9.81)
        b.setTimeStep(self.step)
        self.cube, _, self.gripper = _furnish(b, self.width)
        b.resetBasePositionAndOrientation(self.cube, [*start, z], [0.0, 0.0, 0.0, 1.0])
        self.commanded = self.held = False
        self.spring = self.soft.hold(b, self.gripper.body, self.step)
        self._look()
        self._first = float(np.linalg.norm(self.place - self.spot))

    def act(self, action: Floats, duration: float) -> None:
        velocity = SPEED * action[:3]
        bend_rate = BEND_RATE * float(action[3])
        substep = duration / self.n_substeps
        to = 0.5 * (self.low + self.high) + 0.5 * (self.high - self.low) * action[:3]
        bend = BEND * float(action[3])
        self._command(bool(action[4] > 0.0))
        for _ in range(self.n_substeps):
            if self.at_once:
                velocity = np.clip((to - self.soft.aim) / substep, -SPEED, SPEED)
                bend_rate = min(max((bend - self.bend) / substep, -BEND_RATE), BEND_RATE)
            self._move(velocity, bend_rate, substep)
        self._look()

    def result(self) -> HostedResult:
        distance = float(np.linalg.norm(self.place - self.spot))
        there, fell = distance < self.accuracy, bool(self.place[2] < TOP - 0.02)
        grasp = float(np.linalg.norm(self.place + self.above - self.soft.tip))
        success = there and not self.held and not self.commanded and self.speed < REST
        return HostedResult(
            terms={
                "reach": 0.2 if self.held or there else 0.2 * math.exp(-grasp / 0.05),
                "hold": 0.3 if self.held or there else 0.0,
                "place": 0.5 * (math.exp(-distance / 0.1) - math.exp(-self._first / 0.1)),
                "success": 1.0 if success else 0.0,
                "fall": -1.0 if fell else 0.0,
            },
            distance=distance,
            success=success,
            position=self.place.copy(),
            desired=self.spot.copy(),
            terminated=fell,
            facts={"held": float(self.held), "speed": self.speed},
        )

    def state(self) -> Floats:
        soft = self.soft
        low, high = _cube_range()
        opening = (
            min(max(self.gripper.width / self.width, 0.0), 1.0) if self.width else float(not self.commanded)
        )
        return np.concatenate(
            [
                self.spot,
                np.clip(self.place, low, high),
                np.clip(soft.tip, self.low - 0.1, self.high + 0.1),
                soft.tip_rotation[:, 2],
                short(self.place + self.above - soft.tip, NEAR),
                short(self.spot - self.place, NEAR),
                [self.bend, self.commanded, opening, self.held],
            ]
        )

    def goal(self) -> Floats:
        return self.spot

    def baseline(self) -> Floats:
        left = self.spot - self.place
        aside = float(np.hypot(left[0], left[1]))
        displacement = self.place + self.above - self.soft.tip
        if self.held:  # up, across, and down within a funnel around the spot
            low = -float(left[2])
            want = min(LIFT, 3.0 * max(0.0, aside - 0.006))
            gate = min(1.0, max(0.0, low) / (0.5 * want + 1e-3))
            velocity = np.array([*(_CALM * gate * left[:2]), want - PRESS - low])
            grip = max((aside - 0.01) / 0.004, (low - 0.004) / 0.003)
        elif aside < 0.015:
            velocity, grip = np.array([0.0, 0.0, LIFT]), -1.0
        else:
            off, high = float(np.hypot(displacement[0], displacement[1])), -float(displacement[2])
            want = min(LIFT, 3.0 * max(0.0, off - 0.004))
            velocity = np.array([displacement[0], displacement[1], want - PRESS - high])
            grip = (
                min(0.006 - off, 0.004 - high) / 0.002 if self.width else min(0.03 - off, 0.04 - high) / 0.01
            )
        grip = min(max(grip, -1.0), 1.0)
        velocity = np.clip(4.0 * velocity, -SPEED, SPEED)
        bend_rate = min(max(-2.0 * self.bend, -BEND_RATE), BEND_RATE)
        if not self.at_once:
            return np.array([*velocity / SPEED, bend_rate / BEND_RATE, grip])
        to = 2.0 * (self.soft.aim + 0.1 * velocity - self.low) / (self.high - self.low) - 1.0
        return np.array([*to, (self.bend + 0.1 * bend_rate) / BEND, grip])

    def backdrop(self) -> Backdrop:
        self._pose()
        orientation = matrix_from_quaternion(self._orientation[None])[0]
        solids = [solid_box(*_TABLE, _WOOD), solid_box(self.place, [0.5 * SIDE] * 3, _ORANGE, orientation)]
        rotation = self.soft.tip_rotation
        for finger in self.gripper.fingers:
            side = self.world.getJointState(self.gripper.body, finger)[0] * (1.0 if finger == 0 else -1.0)
            half = np.array([0.003, 0.01, 0.5 * self.gripper.length])
            solids.append(
                solid_box(self.soft.tip + rotation @ [side, 0.0, half[2]], half, (0.25, 0.25, 0.28), rotation)
            )
        return Backdrop(
            tubes=(Tube(self.soft.nodes, RADIUS, _BODY), arm_tube(self.arm)),
            balls=(Ball(self.spot, 0.01, _GREEN), Ball(self.soft.tip, _HEAD, (0.0, 0.0, 0.75))),
            solids=tuple(solids),
            eye=(1.3, -0.7, 0.75),
            target=(0.4, 0.0, 0.25),
        )

    def picture(self, width: int, height: int) -> np.ndarray:
        self._pose()
        return (
            HostCamera(width=width, height=height, fov=38.0)
            .look(self.shown, (1.25, -0.65, 0.7), (0.42, 0.0, 0.27))
            .rgb
        )

    def close(self) -> None:
        self.world.disconnect()
        self.shown.disconnect()

    def _move(self, velocity: Floats, bend_rate: float, duration: float) -> None:
        """One step of arm and soft robot, and those of the world meanwhile."""
        tip = self.soft.aim
        displacement = np.clip(tip + duration * velocity, self.low, self.high) - tip
        length = self.soft.actions.robot.length
        before = _flange(np.zeros(3), self.bend, length)[:3]
        self.bend = min(max(self.bend + duration * bend_rate, -BEND), BEND)
        wanted = _flange(np.zeros(3), self.bend, length)
        at = (
            self.flange[:3] + np.clip(displacement, -SPEED * duration, SPEED * duration) + wanted[:3] - before
        )
        self.flange = np.concatenate([at, wanted[3:]])
        self._follow()
        self.soft.drive(self._action(), self._base())
        self.spring.follow(self.n_steps)
        for _ in range(self.n_steps):
            self.gripper.drive(self.step)
            self.spring.pull()
            self.world.stepSimulation()
            if self.commanded and not self.held and not self.width:
                self.held = self.gripper.attach(()) is not None

    def _follow(self) -> None:
        """The joints, by resolved rates toward the flange's pose."""
        now = self.arm.frame(self.q)
        error = np.concatenate(
            [self.flange[:3] - now[:3], rotation_between(now[None, 3:], self.flange[None, 3:])[0]]
        )
        rates = self._joints.rates(self.q, self.arm.jacobian(self.q), error, np.zeros(6), self.soft.dt)
        self.q = self.q + self.soft.dt * rates

    def _base(self) -> Floats:
        """(7,) of the soft robot, on the flange."""
        pose = self.arm.frame(self.q)
        pose[:3] += ADAPTER * matrix_from_quaternion(pose[None, 3:])[0][:, 2]
        return pose

    def _action(self) -> Floats:
        """(6,) of the soft robot: both segments share the bend [m]."""
        return np.ravel([(0.0, 0.5 * self.bend * offset, 0.0) for offset in self.soft.actions.offset])

    def _command(self, on: bool) -> None:
        if on == self.commanded:
            return
        self.commanded = on
        if self.width:
            self.gripper.open_to(0.0 if on else 1.0)
        elif not on:
            self.gripper.release()
            self.held = False

    def _look(self) -> None:
        """Update the cube's position and speed, and whether the fingers hold it."""
        b = self.world
        place, orientation = b.getBasePositionAndOrientation(self.cube)
        self.place, self._orientation = np.array(place), from_xyzw(orientation)
        self.speed = float(np.linalg.norm(b.getBaseVelocity(self.cube)[0]))
        if self.width:
            fingers = self.gripper.fingers
            self.held = self.commanded and all(
                b.getContactPoints(self.gripper.body, self.cube, finger, -1) for finger in fingers
            )

    def _pose(self) -> None:
        """The world of pictures as the other one is."""
        b = self.shown
        self.arm.place(self.q)
        self.bracket.follow()
        self.bodies.place(self.soft.nodes, self.soft.rotations)
        b.resetBasePositionAndOrientation(
            self.shown_cube, self.place.tolist(), to_xyzw(self._orientation).tolist()
        )
        b.resetBasePositionAndOrientation(
            self.shown_spot, [*self.spot[:2], TOP + 0.0002], [0.0, 0.0, 0.0, 1.0]
        )
        self.shown_gripper.place(self.soft.tip, quaternion_from_matrix(self.soft.tip_rotation))
        for finger in self.gripper.fingers:
            b.resetJointState(
                self.shown_gripper.body, finger, self.world.getJointState(self.gripper.body, finger)[0]
            )


def _flange(tip: Floats, bend: float, length: float) -> Floats:
    """(7,) pose of the flange that has the tip of the weightless soft robot of this bend and length at a
    point, looking down."""
    c, s = math.cos(bend), math.sin(bend)
    # an arc: (1 - cos b) / b and sin b / b of its length
    x, z = (
        (length * (1.0 - c) / bend, length * s / bend) if abs(bend) > 1e-4 else (0.5 * length * bend, length)
    )
    # world_from_flange: the rod's axes are the flange's
    orientation = _DOWN @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]).T
    return np.concatenate(
        [tip - orientation @ [x, 0.0, z + ADAPTER], quaternion_from_matrix(orientation[None])[0]]
    )


def _furnish(b: Bullet, width: float) -> tuple[int, int, Gripper]:
    """Table; the cube, the spot and the gripper that this returns."""
    middle, half = _TABLE
    shape = b.createCollisionShape(b.GEOM_BOX, halfExtents=half)
    seen = b.createVisualShape(b.GEOM_BOX, halfExtents=half, rgbaColor=[*_WOOD, 1.0])
    b.createMultiBody(0.0, shape, seen, middle)
    plinth = b.createVisualShape(
        b.GEOM_BOX, halfExtents=[0.12, 0.22, 0.5 * TOP - 0.01], rgbaColor=[0.45, 0.47, 0.50, 1.0]
    )
    b.createMultiBody(0.0, -1, plinth, [*middle[:2], 0.5 * TOP - 0.01])
    edge = [0.5 * SIDE] * 3
    shape = b.createCollisionShape(b.GEOM_BOX, halfExtents=edge)
    seen = b.createVisualShape(b.GEOM_BOX, halfExtents=edge, rgbaColor=[*_ORANGE, 1.0])
    cube: int = b.createMultiBody(_MASS, shape, seen, [0.5, 0.0, TOP + 0.5 * SIDE])
    b.changeDynamics(cube, -1, linearDamping=0.0, angularDamping=0.0)
    disc = b.createVisualShape(b.GEOM_CYLINDER, radius=0.03, length=0.001, rgbaColor=[*_GREEN, 1.0])
    spot: int = b.createMultiBody(0.0, -1, disc, [0.5, 0.0, TOP + 0.0002])
    return cube, spot, Gripper(b, _HEAD, width, (0.0, 0.0, 0.75, 1.0), _HEAD_MASS)
