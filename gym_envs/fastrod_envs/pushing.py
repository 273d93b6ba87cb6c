"""A soft robot pushes a cube over a floor: what Push and QuadrupedPush share."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ClassVar, final

import numpy as np

from fastrod.control import scaled_rates
from fastrod.errors import HostError
from fastrod.hosts.bodies import RodBodies
from fastrod.hosts.bullet import Bullet, connect
from fastrod.hosts.camera import HostCamera
from fastrod.hosts.link import from_xyzw
from fastrod.model.robot import Robot
from fastrod.rotation import matrix_from_quaternion
from fastrod.simulator import Simulator
from fastrod.solver.state import State
from fastrod.types import Floats
from fastrod_envs.hosted import Cell, HostedResult, HostedTask
from fastrod_envs.options import EnvOptions
from fastrod_envs.push_course import Course, Drive
from fastrod_envs.task import Backdrop, Ball, Field, Tube, solid_box
from fastrod_envs.tip import UNLOADED, Tip, moving_mass

ACCURACY = 0.02
"""Accuracy of the cube's place [m]."""
SPEED = 0.15
"""Speed of the baseline's tip, the largest [m/s]."""
TIME = 0.2
"""In which it covers what is left [s]."""
_STEP = 0.05  # s, the longest of the rod
_WITHIN = 5  # steps of the world in one of the rod
_ON_BAR, _ON_FLOOR = 1.0, 0.25  # friction of the cube
_POINTS = 4  # of a segment
_CAPSULES = 2
_EVERY = _POINTS // _CAPSULES
_NEAR = 0.1  # m, the longest vector to the goal in an observation
_AROUND = 0.15  # m, the longest vector to the cube
_AWAY = 0.6  # m, no cube is pushed farther
_SHIFT, _SKEW = 0.01, 0.1  # m and rad, the most by which the cube begins elsewhere
_AT_REST = 1e-5  # m, residual of a robot that counts as at rest
_CLEAR = 0.002  # m, of the bar above the floor
_BAR_MASS = 0.02  # kg
_SEAT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # the bar, along the tip's d2
_FASTEST = 0.3  # m/s, no tip moves faster
_ROD, _BAR, _CUBE, _GOAL = (0.9, 0.55, 0.15), (0.35, 0.35, 0.38), (0.2, 0.45, 0.8), (0.85, 0.2, 0.15)


@final
class PushCell(Cell):
    """A cube on a floor, a soft robot with a bar at its tip on a base that stands still, and a goal. The
    world is built anew for every episode: nothing is left of the one before."""

    def __init__(
        self,
        course: Course,
        robot: Robot,
        options: EnvOptions,
        duration: float,
        picture_world: Callable[[], Bullet] | None,
    ) -> None:
        """`robot` before it is randomised; `duration` of an environment step [s]; `picture_world` makes a
        world for pictures, without robot and cube, where there is more to see than the backdrop."""
        self.course, self.options, self._picture_world = course, options, picture_world
        self._n = max(1, math.ceil(duration / _STEP - 1e-9))
        self._dt = duration / self._n
        self.drive = Drive(robot, course.bend)
        self._own = self.simulator = self._simulator(robot)
        self.home = self.drive.posture_for(
            self._own,
            np.array([course.place[0] - course.behind - course.gap, course.place[1], course.height]),
        )
        """(3,) of `Drive` at the start of an episode."""
        self._own.reset()
        self._own.settle(**self.drive.inputs(self.home), **UNLOADED, tolerance=_AT_REST)
        self._rest = self._own.snapshot()
        self.world = connect(dt=self._dt / _WITHIN)
        self._studio: Bullet | None = None
        self._tube: RodBodies
        self._bar = -1
        self._cube_body = -1
        self.q: Floats = self.home
        """(3,) of `Drive`."""
        self.desired: Floats = np.zeros(2)
        """(2,) goal of the cube, world [m]."""
        self.touched = False
        """The robot met the cube in this episode."""

    def begin(self, draws: Floats, difficulty: float, robot: Robot | None) -> None:
        """`draws` (5,): the goal's x and y, the cube's shift in x and y, its turn. With `difficulty` 0 the
        goal is in the middle of the course's rectangle. Raises `HostError` where a randomised robot does not
        come to rest."""
        course = self.course
        least, largest = np.array(course.least), np.array(course.largest)
        self.desired = 0.5 * (least + largest) + difficulty * (draws[:2] - 0.5) * (largest - least)
        self.q, self.touched = self.home.copy(), False
        if robot is None:
            self.simulator = self._own
            self.simulator.restore(self._rest)
        else:
            self.simulator = self._simulator(robot)
            _sound(self.simulator.settle(**self.drive.inputs(self.q), **UNLOADED, tolerance=_AT_REST))
        self._build(
            np.array(course.place) + _SHIFT * (2.0 * draws[2:4] - 1.0), _SKEW * (2.0 * draws[4] - 1.0)
        )

    def act(self, action: Floats, duration: float) -> None:
        """Move the numbers of `Drive` by their rates, or toward their places no faster than these, within
        their ranges and with the bar off the floor. Raises `HostError` where the rod is lost."""
        drive = self.drive
        if self.options.action == "rate":
            there = self.q + duration * drive.rate * action
        else:
            there = self.q + np.clip(
                drive.action_at(action) - self.q, -duration * drive.rate, duration * drive.rate
            )
        there = np.clip(there, drive.low, drive.high)
        for left in range(self._n, 0, -1):
            self.q = self._clear(self.q + (there - self.q) / left)
            self._move(_sound(self.tip_body.solve(**self.drive.inputs(self.q))))

    def result(self) -> HostedResult:
        """`distance` is from the cube's middle to its goal in the plane [m]; terms exp(-k d^2), and 0.5 once
        the cube was touched."""
        position = self._cube()[0]
        desired = np.array([*self.desired, 0.5 * self.course.size])
        d = float(np.hypot(*(position - desired)[:2]))
        terms = {"reach": math.exp(-self.course.steepness * d**2), "touch": 0.5 * self.touched}
        return HostedResult(terms, d, d < ACCURACY, position, desired, facts={"touched": float(self.touched)})

    def state(self) -> Floats:
        """(17,) in the order of `PushTask.states`."""
        position, rotation = self._cube()
        angle = 4.0 * math.atan2(rotation[1, 0], rotation[0, 0])
        cube, tip = position[:2], self.tip
        to_goal, to_cube = _at_most(self.desired - cube, _NEAR), _at_most(cube - tip[:2], _AROUND)
        return np.array(
            [
                *self.desired,
                *cube,
                math.cos(angle),
                math.sin(angle),
                *tip,
                *to_goal,
                *to_cube,
                *self.drive.posture(self.q),
                self.touched,
            ]
        )

    def goal(self) -> Floats:
        """(2,) where the cube's middle is to be, x and y, world [m]."""
        return self.desired

    def baseline(self) -> Floats:
        """(3,) straight to the cube, then along the way that it has to go, slower when near; the cube stays
        on the bar, which keeps its height."""
        drive, cube = self.drive, self._cube()[0][:2]
        ahead = self.desired - cube
        d = float(np.hypot(*ahead))
        push = ahead * min(SPEED / max(d, 1e-9), 1.0 / TIME)
        if not self.touched:
            push = np.array([0.5 * SPEED, (cube[1] - self.tip[1]) / TIME])
        velocity = np.array([*push, (self.course.height - self.tip[2]) / TIME])
        jacobian = drive.jacobian(self.simulator) * drive.rate
        rates = scaled_rates(jacobian[None], velocity[None], np.zeros((1, 3)))[0]
        if self.options.action == "rate":
            return np.asarray(rates)
        return drive.posture(self.q + self._n * self._dt * drive.rate * rates)

    def backdrop(self) -> Backdrop:
        """Rod and bar as tubes, the cube, and its goal as a ball; seen from the course's right."""
        position, rotation = self._cube()
        points = self.simulator.state.position[0]
        neck = Tube(points, self._own.robots[0].segments[0].body_radius or self.course.thickness, _ROD)
        bar = Tube(_bar_nodes(self.course, self.simulator.state)[0], self.course.thickness, _BAR)
        goal = np.array([*self.desired, 0.5 * self.course.size])
        eye, target = self._view()
        return Backdrop(
            tubes=(neck, bar),
            solids=(solid_box(position, [0.5 * self.course.size] * 3, _CUBE, rotation),),
            balls=(Ball(goal, 0.012, _GOAL),),
            eye=eye,
            target=target,
        )

    def picture(self, width: int, height: int) -> np.ndarray:
        """(height, width, 3) uint8, from the course's right: of a second world that is made for pictures when
        the first is asked for, or of the backdrop."""
        if self._picture_world is None:
            return super().picture(width, height)
        course = self.course
        if self._studio is None:
            self._studio = self._picture_world()
        studio, (position, _) = self._studio, self._cube()
        tube = _capsules(studio, course, self._own.robots[0])
        bar = RodBodies(studio, course.width, course.thickness, 1, color=(*_BAR, 1.0))
        state = self.simulator.state
        tube.place(state.position[0, ::_EVERY], state.rotation[0, ::_EVERY])
        bar.place(*_bar_nodes(course, state))
        angle = self.world.getBasePositionAndOrientation(self._cube_body)[1]
        box = studio.createVisualShape(
            studio.GEOM_BOX, halfExtents=[0.5 * course.size] * 3, rgbaColor=[*_CUBE, 1.0]
        )
        disc = studio.createVisualShape(
            studio.GEOM_CYLINDER, radius=0.02, length=0.002, rgbaColor=[*_GOAL, 1.0]
        )
        shown = [
            studio.createMultiBody(0.0, -1, box, position.tolist(), angle),
            studio.createMultiBody(0.0, -1, disc, [*self.desired, 0.001]),
        ]
        eye, target = self._view()
        picture = HostCamera(width=width, height=height, fov=45.0).look(studio, eye, target).rgb
        tube.remove()
        bar.remove()
        for body in shown:
            studio.removeBody(body)
        return picture

    def close(self) -> None:
        """Disconnect both worlds; once more does nothing."""
        for world in (self.world, self._studio):
            if world is not None and world.isConnected():
                world.disconnect()

    @property
    def tip(self) -> Floats:
        """(3,) world [m]."""
        return np.asarray(self.simulator.state.tip_position[0])

    def _cube(self) -> tuple[Floats, Floats]:
        """Middle (3,) and rotation (3, 3) of the cube."""
        position, quaternion = self.world.getBasePositionAndOrientation(self._cube_body)
        return np.array(position), matrix_from_quaternion(from_xyzw(quaternion)[None])[0]

    def _view(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        x, y = 0.5 * (np.array(self.course.place) + np.array(self.course.largest))
        return (x + 0.35, y - 0.85, 0.55), (x - 0.15, 0.0, 0.2)

    def _simulator(self, robot: Robot) -> Simulator:
        return Simulator(robot, dt=self._dt, points_per_segment=_POINTS, threads=1)

    def _build(self, place: Floats, angle: float) -> None:
        """The world with the cube there [m], turned about z [rad], and the robot as it is."""
        world, course = self.world, self.course
        world.resetSimulation()
        world.setGravity(0.0, 0.0, -9.81)
        world.setTimeStep(self._dt / _WITHIN)
        world.setPhysicsEngineParameter(deterministicOverlappingPairs=1)
        half = [0.5 * course.size] * 3
        ground = world.createMultiBody(
            0.0, world.createCollisionShape(world.GEOM_BOX, halfExtents=[5.0, 5.0, 0.5]), -1, [0.0, 0.0, -0.5]
        )
        box = world.createCollisionShape(world.GEOM_BOX, halfExtents=half)
        skewed = [0.0, 0.0, math.sin(0.5 * angle), math.cos(0.5 * angle)]
        self._cube_body = int(world.createMultiBody(course.mass, box, -1, [*place, half[0]], skewed))
        neck = self._own.robots[0]
        self._tube = _capsules(world, course, neck)
        mass = _BAR_MASS + moving_mass(neck)
        capsule = world.createCollisionShape(world.GEOM_CAPSULE, radius=course.thickness, height=course.width)
        self._bar = int(world.createMultiBody(mass, capsule))
        undamped = {"linearDamping": 0.0, "angularDamping": 0.0}
        world.changeDynamics(self._cube_body, -1, lateralFriction=1.0, **undamped)
        world.changeDynamics(ground, -1, lateralFriction=_ON_FLOOR)  # PyBullet multiplies the two
        world.changeDynamics(self._bar, -1, lateralFriction=_ON_BAR, **undamped)
        for body in self._tube.ids:
            world.changeDynamics(body, -1, lateralFriction=_ON_BAR)
            world.setCollisionFilterPair(self._bar, body, -1, -1, 0)
        state = self.simulator.state
        self._tube.place(state.position[0, ::_EVERY], state.rotation[0, ::_EVERY])
        self.tip_body = Tip(self.simulator, self._dt / _WITHIN, world, self._bar, _SEAT)

    def _move(self, state: State) -> None:
        """Bring capsules and bar there within a step of the rod."""
        nodes = state.position[0, ::_EVERY], state.rotation[0, ::_EVERY]
        self._tube.head_for(*nodes, self._dt)
        self.tip_body.follow(_WITHIN)
        for _ in range(_WITHIN):
            self.tip_body.pull()
            self.world.stepSimulation()
            points = self.world.getContactPoints(self._cube_body)
            met = {body for point in points if point[9] > 0.0 for body in point[1:3]}
            self.touched = self.touched or not met.isdisjoint([self._bar, *self._tube.ids])
        self._tube.place(*nodes)

    def _clear(self, q: Floats) -> Floats:
        """Numbers near these with which the bar does not enter the floor."""
        lowest = (
            self.course.thickness
            + 0.5 * self.course.width * abs(float(self.simulator.state.tip_rotation[0, 2, 1]))
            + _CLEAR
        )
        if self.tip[2] > lowest + _FASTEST * self._dt:
            return q
        rise = self.drive.jacobian(self.simulator)[2]
        lacks = lowest - self.tip[2] - float(rise @ (q - self.q))
        if lacks <= 0.0:
            return q
        by = self.drive.rate**2 * rise
        return np.asarray(
            np.clip(q + lacks / max(float(rise @ by), 1e-12) * by, self.drive.low, self.drive.high)
        )


class PushTask(HostedTask):
    """Base of Push and QuadrupedPush: three numbers move the tip, the cube goes where it is pushed."""

    n_steps: ClassVar[int] = 40
    n_draws: ClassVar[int] = 5
    accuracy: float = ACCURACY
    duration: ClassVar[float] = 4.0
    picture_world: Callable[[], Bullet] | None = None
    """See `PushCell`."""

    def __init__(self, n_envs: int, options: EnvOptions, course: Course) -> None:
        self.course = course
        drive = Drive(course.robot, course.bend)
        low, high, what = (
            (-drive.rate, drive.rate, "rate of the")
            if options.action == "rate"
            else (drive.low, drive.high, "")
        )
        unit = "m/s" if options.action == "rate" else "m"
        names = "extension, displacements toward d1 and d2 of every segment alike"
        actions = (Field("displacement", unit, tuple(low), tuple(high), f"{what} {names}".strip()),)
        base = np.array(course.robot.base_position)
        far = 1.5 * course.robot.length
        place = np.array(course.place)
        goal = Field("goal", "m", course.least, course.largest, "where the cube is to be, x and y, world")
        states = (
            goal,
            Field("cube", "m", tuple(place - _AWAY), tuple(place + _AWAY), "its middle, x and y, world"),
            Field(
                "turn", "", (-1.0,) * 2, (1.0,) * 2, "cosine and sine of four times the cube's angle about z"
            ),
            Field("tip", "m", tuple(base - far), tuple(base + far), "of the robot, world"),
            Field(
                "error",
                "m",
                (-_NEAR,) * 2,
                (_NEAR,) * 2,
                f"from cube to goal, x and y, at most {_NEAR:g} m of it",
            ),
            Field(
                "way",
                "m",
                (-_AROUND,) * 2,
                (_AROUND,) * 2,
                f"from tip to cube, x and y, at most {_AROUND:g} m of it",
            ),
            Field("posture", "", (-1.0,) * 3, (1.0,) * 3, "displacements, from their least to their largest"),
            Field("touched", "", (0.0,), (1.0,), "the robot has touched the cube in this episode"),
        )
        super().__init__(n_envs, options, course.robot, actions, states, (goal,))

    def cell(self) -> Cell:
        """A `PushCell` with this course, these options, and the robot as it is before it is randomised."""
        return PushCell(self.course, self.base_robot, self.options, self.dt, self.picture_world)


def _sound(state: State) -> State:
    if not state.ok[0] or not np.isfinite(state.position).all():
        raise HostError(f"the rod is lost: {state.problems.get(0, 'its shape is not finite')}")
    return state


def _capsules(world: Bullet, course: Course, robot: Robot) -> RodBodies:
    """Return the robot's, without its bar."""
    radii = [segment.body_radius or course.thickness for segment in robot.segments for _ in range(_CAPSULES)]
    return RodBodies(world, robot.length, radii, len(radii), color=(*_ROD, 1.0))


def _bar_nodes(course: Course, state: State) -> tuple[Floats, Floats]:
    """Ends (2, 3) of the bar and the tip's rotation at both (2, 3, 3)."""
    tip, rotation = state.tip_position[0], state.tip_rotation[0]
    return tip + 0.5 * course.width * np.array([-rotation[:, 1], rotation[:, 1]]), np.array(
        [rotation, rotation]
    )


def _at_most(vector: Floats, longest: float) -> Floats:
    return np.asarray(vector * (longest / max(float(np.hypot(*vector)), longest)))
