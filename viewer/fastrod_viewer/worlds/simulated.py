"""Worlds without a rigid host: `FreeWorld`, robots in empty space, and `SceneWorld`, a scene of rods and
obstacles."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from fastrod.contact import ContactScene, Obstacle
from fastrod.errors import InputError
from fastrod.model.robot import Robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.rotation import matrix_from_quaternion
from fastrod.simulator import Simulator
from fastrod.solver.state import State
from fastrod.types import Floats
from fastrod_scenes.scene import RodScene
from fastrod_viewer.picture.scene_graph import grid_places
from fastrod_viewer.worlds.ringing import Ringing, time_step
from fastrod_viewer.worlds.robots import Loads, about, actions_of, moved, radii, tendon_inputs
from fastrod_viewer.worlds.world import Body, DrawnRods, ManualCommand, World

PERIOD = 6.0
"""Period of the motion that shows what a free robot can do [s]."""
SWAY = 1.6
"""Largest bend of a free robot in that motion, all segments together [rad]."""
PUSH = 0.3
"""Slope of the tip under the force that sways a robot without tendons, about [rad]."""
_APART = 0.8  # of the robot's length, between robots that stand in a grid
_SQUARE = 1.5  # of the robot's length, edge of a plane
_GLASS = 0.35  # opacity of planes and of meshes, which may surround a robot
_COLORS = ((146, 154, 166), (176, 146, 110), (120, 150, 132), (160, 128, 146))


class SimulatedWorld(World):
    """Worlds of one simulator, without a host.

    A step that is not ok is settled, but for rods that have inertia; where that fails too, the simulator is
    as before the step. Where contact
    blocks them the robots stand as far as they came, and continue from there. Either way an `InputError` says
    why.
    """

    drivable = True
    scripted = True
    host = False
    base_moves = True
    loads = True
    endless: bool
    """The script ends as it began, and runs on without a jump."""

    def __init__(self, simulator: Simulator, contact: ContactScene | None, place: Floats) -> None:
        """`contact`: the scene of the simulator, where it has one; `place` (n_robots, 3) as in `DrawnRods`
        [m]."""
        self.simulator = simulator
        self.dt = simulator.dt
        self.robot: Robot = simulator.robots[0]
        self.actions = actions_of(self.robot)
        self._has_contact = contact is not None
        self._radius = radii(self.robot, contact)
        self._place = place
        self._home: Floats = np.array([[*r.base_position, *r.base_quaternion] for r in simulator.robots])
        self._loads = Loads(self.robot)
        self._start = simulator.snapshot()
        self._one: Simulator | None = None
        alone = contact is not None or simulator.dynamics or self.robot.effects
        if simulator.n_robots > 1 and not alone:
            self._one = Simulator(
                self.robot, 1, self.dt, (simulator.n_points - 1) // self.robot.n_segments, threads=1
            )
        self._given: dict[str, Any] = {}
        self._clock = self._t = 0.0

    @abstractmethod
    def inputs(self, t: float) -> dict[str, Any]:
        """Return the inputs of the script at time t [s]: keyword arguments of `Simulator.step`."""

    @property
    @final
    def t(self) -> float:
        """Simulated since the last reset [s]; a step that failed does not count."""
        return self._t

    @property
    @final
    def rods(self) -> tuple[DrawnRods, ...]:
        """All robots of the simulator."""
        return (DrawnRods(self.simulator.robots, self._state, self._place, self._radius),)

    @final
    def reset(self) -> None:
        """The simulator as it was at first, brought to the script's inputs of t = 0. Raises `InputError`."""
        self.simulator.restore(self._start)
        self._clock, self._t = 0.0, -self.dt
        self._advance(self.inputs(0.0))

    @final
    def play(self) -> None:
        """One step of the script, or from its end back to its beginning. Raises `InputError`; the script has
        then gone on all the same."""
        clock = self._clock + self.dt
        if clock > self.duration + 1e-9 and not self.endless:
            self.reset()
            return
        # beyond a step that fails the script continues
        self._clock = clock % self.duration if self.endless else clock
        self._advance(self.inputs(self._clock), partial=True)

    @final
    def drive(self, command: ManualCommand) -> None:
        """Do one step of a manual command. What the command does not set, obstacles and the base's own motion
        among it, stays as the script has it now. Among obstacles, robots that the script has bent differently
        are moved by the same change as the first one: no robot could jump to another's bends there."""
        held = self.held(self._clock)
        given = held | tendon_inputs(self.robot, command)
        if self._has_contact and np.ndim(own := held.get("tendon_length", 0.0)) == 2:
            given["tendon_length"] = np.asarray(own) + (command.tendon_length - np.asarray(own)[0])
        pose = np.asarray(given.get("base_pose", self._home), dtype=np.float64)
        given["base_pose"] = moved(pose, command.base)
        self._advance(self._loads.added(given, command))

    @final
    def jacobian(self) -> Floats:
        """(3, n_actions) of the first robot. Raises `InputError` where it is not driven by tendon lengths, or
        is not ok."""
        if self.actions is None:
            raise InputError(
                f"robot {self.robot.name!r} is not driven by tendon lengths, so no drag can move its tip."
            )
        simulator, state = self.simulator, self._state
        if self._one is not None:  # of many alike the first alone: a fraction of the time of all
            simulator, state = self._one, self._one.settle(**_first(self._given))
        jacobian = simulator.jacobian()[0, :3] @ self.actions.matrix
        if not np.isfinite(jacobian).all():
            raise InputError(f"there is no Jacobian here: {state.problems.get(0, 'the robot is not ok')}")
        return np.asarray(jacobian)

    @final
    def close(self) -> None:
        """All is in Python's memory."""

    @abstractmethod
    def held(self, t: float) -> dict[str, Any]:
        """Return the script's inputs at time t [s] that stay during manual commands."""

    @abstractmethod
    def arrived(self, given: dict[str, Any]) -> None:
        """These inputs have been simulated; after a reset they are the first."""

    @final
    def _advance(self, given: dict[str, Any], *, partial: bool = False) -> None:
        """Simulate these inputs. A step that cannot be done is undone, or with `partial`, among obstacles,
        done as far as possible: a script continues from there."""
        before = self.simulator.snapshot()
        state = self.simulator.step(**given)
        if not state.ok.all() and not self._has_contact and not self.simulator.dynamics:
            state = self.simulator.settle(**given)
        done = bool(state.ok.all()) and _finite(state)
        if done or (partial and self._has_contact and _finite(state)):
            self._state, self._given = state, given
            self._t = self._t + self.dt
        else:
            self.simulator.restore(before)
        if not done:
            robot, problem = next(iter(state.problems.items()), (0, "its shape is not finite."))
            raise InputError(f"robot {robot} cannot be brought there: {problem}")
        self.arrived(given)


@final
class FreeWorld(SimulatedWorld):
    """Robots without surroundings, all driven alike; more than one stand in a grid. With `dynamics` they
    have inertia, and ring."""

    endless = True
    duration = PERIOD

    def __init__(
        self,
        robot: Robot,
        n_robots: int = 1,
        dt: float | None = None,
        *,
        points_per_segment: int = 6,
        dynamics: bool = False,
    ) -> None:
        """Arguments of `Simulator`; dt is 1/30 s, or with `dynamics` that of `time_step`. Raises
        `InputError`, also where `dynamics` finds a segment without mass, and `RobotError`."""
        if dynamics:
            dt = time_step(robot, points_per_segment, sway(robot, actions_of(robot), 0.0), dt)
        simulator = Simulator(
            robot,
            n_robots,
            1.0 / 30.0 if dt is None else dt,
            points_per_segment,
            threads=1 if n_robots == 1 else None,
            dynamics=dynamics,
        )
        super().__init__(simulator, None, grid_places(n_robots, _APART * robot.length))
        self.name, self.about = robot.name + (" in motion" if dynamics else ""), about(robot)
        self.reset()
        if dynamics:
            self.ringing = Ringing(simulator)

    def inputs(self, t: float) -> dict[str, Any]:
        """A gentle motion, periodic: bends toward both sides of every segment, or what takes their place."""
        return sway(self.robot, self.actions, 2.0 * math.pi * t / PERIOD)

    def held(self, t: float) -> dict[str, Any]:  # noqa: ARG002
        """Do nothing."""
        return {}

    def arrived(self, given: dict[str, Any]) -> None:
        """There is nothing but the robots, which may ring."""
        if self.ringing is not None:
            self.ringing.note(self._state, given)

    @property
    def bodies(self) -> tuple[Body, ...]:
        """None."""
        return ()

    def poses(self) -> Floats:
        """(0, 7)."""
        return np.zeros((0, 7))


@final
class SceneWorld(SimulatedWorld):
    """A scene of rods and obstacles. Robots of separate worlds are drawn in one: obstacles that all of them
    have stand there once, each where it is for the first robot."""

    endless = False

    def __init__(self, scene: RodScene) -> None:
        simulator = scene.simulator()
        contact = simulator.contact
        super().__init__(simulator, contact, np.zeros((simulator.n_robots, 3)))
        self.scene = scene
        self.name, self.about, self.duration = scene.name, scene.about, scene.duration
        obstacles = () if contact is None else contact.obstacles
        self._rest = {o.name: np.array([*o.position, *o.quaternion]) for o in obstacles}
        self._poses = dict(self._rest)
        self._bodies = bodies_of(contact, self.robot)
        self.reset()

    def inputs(self, t: float) -> dict[str, Any]:
        """The scene's."""
        return self.scene.inputs(t)

    def held(self, t: float) -> dict[str, Any]:
        """Obstacles, bases and loads, but no speed: the obstacles stand still."""
        return {
            name: value
            for name, value in self.inputs(t).items()
            if name not in ("obstacle_velocity", "tension")
        }

    def arrived(self, given: dict[str, Any]) -> None:
        """Keep the poses of the obstacles."""
        if self._t == 0.0:
            self._poses = dict(self._rest)
        for name, pose in (given.get("obstacle_pose") or {}).items():
            self._poses[name] = np.atleast_2d(np.asarray(pose, dtype=np.float64))[0]

    @property
    def bodies(self) -> tuple[Body, ...]:
        """The obstacles."""
        return self._bodies

    def poses(self) -> Floats:
        """Return the poses (n_obstacles, 7) as last given, or as built."""
        return np.array(list(self._poses.values())).reshape(-1, 7)


def bodies_of(contact: ContactScene | None, robot: Robot) -> tuple[Body, ...]:
    """The obstacles of a contact scene about a robot, to be drawn."""
    obstacles = () if contact is None else contact.obstacles
    return tuple(_body(each, _COLORS[k % len(_COLORS)], robot) for k, each in enumerate(obstacles))


def sway(robot: Robot, actions: SegmentActions | None, angle: float) -> dict[str, Any]:
    """Inputs that show what a robot can do, of period 2 pi in `angle` [rad]; it is straight at 0, and
    segments follow one another as a wave."""
    if not robot.n_tendons:
        stiffness = float(np.mean([segment.bending_stiffness for segment in robot.segments]))
        side = (
            np.array([math.sin(angle), math.sin(2.0 * angle), 0.0]) * 2.0 * PUSH * stiffness / robot.length**2
        )
        return {"tip_force": matrix_from_quaternion(np.array([robot.base_quaternion]))[0] @ side}
    n = robot.n_segments
    behind = (math.pi / 3.0) * np.arange(n) / n
    home = 0.5 * (1.0 + math.cos(angle))  # so that it begins straight
    waves = [np.sin(k * (angle - behind)) + np.sin(k * behind) * home for k in (1.0, 2.0)]
    bends = SWAY / n * np.stack(waves, axis=1) / math.sqrt(2.0)
    low, high = np.array([segment.extension for segment in robot.segments]).T
    extension = 0.3 * np.where(high > 0.0, high, low) * (1.0 - math.cos(angle))
    if actions is not None:
        return dict(
            actions.inputs(
                np.concatenate([extension[:, None], actions.offset[:, None] * bends], axis=1).ravel()
            )
        )
    given: dict[str, Any] = {"extension": extension}
    longer = np.cumsum(extension)[robot.tendon_segment]
    shorter, tension = np.zeros(robot.n_tendons), np.zeros(robot.n_tendons)
    for i, (tendon, k) in enumerate(zip(robot.tendons, robot.tendon_segment.tolist(), strict=True)):
        places = np.array(tendon.position(k + 1))
        shorter[i] = (places * bends[: k + 1]).sum()
        segment = robot.segments[k]
        toward = places[-1] / np.linalg.norm(places[-1])
        most = (
            SWAY
            / n
            * float(np.mean(segment.bending_stiffness))
            / (segment.length * np.linalg.norm(places[-1]))
        )
        tension[i] = 0.5 * most * (1.0 + toward @ bends[k] * n / SWAY)
    modes = {segment.mode for segment in robot.segments}
    if modes & {"tendon_length", "paper"}:
        given["tendon_length"] = robot.rest_tendon_length + longer - shorter
    if "tendon_tension" in modes:
        given["tension"] = tension
    return given


def _first(given: dict[str, Any]) -> dict[str, Any]:
    """Inputs of the first robot."""
    shared = {"line_force": 3}  # axes of what has no robot axis, where these are not one
    arrays = {name: np.asarray(value, dtype=np.float64) for name, value in given.items()}
    return {name: a[0] if a.ndim > shared.get(name, 1) else a for name, a in arrays.items()}


def _finite(state: State) -> bool:
    return bool(np.isfinite(state.position).all())


def _body(obstacle: Obstacle, color: tuple[int, int, int], robot: Robot) -> Body:
    drawn = obstacle.as_trimesh()
    vertices: NDArray[np.float64] = np.asarray(drawn.vertices)
    if obstacle.shape == "plane":  # the region of it that is nearest to the robot
        base = matrix_from_quaternion(np.array([robot.base_quaternion]))[0]
        middle = np.array(robot.base_position) + 0.5 * robot.length * base[:, 2]
        orientation = matrix_from_quaternion(np.array([obstacle.quaternion]))[0]
        vertices = _SQUARE * robot.length * vertices + ((middle - obstacle.position) @ orientation) * [
            1.0,
            1.0,
            0.0,
        ]
    opacity = _GLASS if obstacle.shape in ("plane", "mesh") else 1.0
    return Body(
        obstacle.name, vertices.astype(np.float32), np.asarray(drawn.faces).astype(np.uint32), color, opacity
    )
