"""`Scene`: robots, their surroundings, their inputs, and what physics expects of them; `load(name)` finds
one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, final

from fastrod.errors import FastrodError, UnknownNameError, nearest

if TYPE_CHECKING:
    from fastrod.hosts import Bullet, BulletArm, MountedRod, MujocoRod
    from fastrod.hosts.camera import Image
    from fastrod.model.robot import Robot
    from fastrod.simulator import Simulator
    from fastrod.solver.state import State

_SCENES: Mapping[str, str] = {
    "airway": "fastrod_scenes.contact.airway:Airway",
    "bar": "fastrod_scenes.contact.bar:Bar",
    "catch": "fastrod_scenes.contact.catch:CatchCube",
    "draped": "fastrod_scenes.contact.draped:Draped",
    "dual_arm": "fastrod_scenes.ur5.dual_arm:DualArms",
    "explore": "fastrod_scenes.ur5.explore:Explore",
    "grid": "fastrod_scenes.grid:Grid",
    "insertion": "fastrod_scenes.contact.insertion:Insertion",
    "neck_look": "fastrod_scenes.a1.look:NeckLook",
    "neck_push": "fastrod_scenes.a1.push:NeckPush",
    "pair": "fastrod_scenes.contact.pair:Pair",
    "pick_gripper": "fastrod_scenes.ur5.pick:PickGripper",
    "pick_suction": "fastrod_scenes.ur5.pick:PickSuction",
    "track_circle": "fastrod_scenes.ur5.tracking:TrackCircle",
    "track_figure_eight": "fastrod_scenes.ur5.tracking:TrackFigureEight",
    "track_helix": "fastrod_scenes.ur5.tracking:TrackHelix",
    "track_square": "fastrod_scenes.ur5.tracking:TrackSquare",
    "track_square_helix": "fastrod_scenes.ur5.tracking:TrackSquareHelix",
    "ur5_mujoco": "fastrod_scenes.ur5.pressing:UR5Mujoco",
    "whip": "fastrod_scenes.ur5.whip:UR5Whip",
    "wall": "fastrod_scenes.contact.wall:Wall",
}


class SceneError(FastrodError, AssertionError):
    """A scene did not do what physics expects of it."""


class Scene(ABC):
    """A simulation from the first input to the last, and the figures by which it is judged. It keeps nothing
    between runs.

    >>> load("wall").dt
    0.01
    """

    name: ClassVar[str]
    about: ClassVar[str]
    """One sentence."""
    dt: ClassVar[float]
    """Time step [s]."""
    duration: ClassVar[float]
    """Duration of a run [s]."""

    @abstractmethod
    def run(self) -> Iterator[tuple[float, State]]:
        """(t [s], state) of each step, from 0 to `duration`."""

    @abstractmethod
    def check(self) -> dict[str, float]:
        """Run, and return the figures measured (name with unit -> value); `SceneError` where one is not as it
        must be."""

    @final
    def progress(self, t: float) -> float:
        """Fraction of the run that is over at time t [s], from 0 to 1."""
        return min(max(t / self.duration, 0.0), 1.0)

    @final
    def expect(self, fulfilled: bool, sentence: str) -> None:
        """Raises `SceneError` with the sentence where an expectation is not fulfilled."""
        if not fulfilled:
            raise SceneError(f"scene {self.name}: {sentence}")


class RodScene(Scene):
    """Rods and obstacles, without a host."""

    @abstractmethod
    def simulator(self) -> Simulator:
        """A new simulator with this scene's robots and obstacles, before its first step."""

    @abstractmethod
    def inputs(self, t: float) -> dict[str, Any]:
        """Keyword arguments of `Simulator.step` at time t [s]."""

    @final
    def run(self) -> Iterator[tuple[float, State]]:
        """(t [s], state) of a new simulator's steps; the first has the inputs of t = 0, the last those of
        `duration`."""
        simulator = self.simulator()
        for k in range(round(self.duration / self.dt) + 1):
            yield k * self.dt, simulator.step(**self.inputs(k * self.dt))


class SoftBody(NamedTuple):
    """A soft robot of a stage as it is now."""

    robot: Robot
    state: State
    """State of this robot alone."""
    capsules: tuple[int, ...]
    """Numbers of the bodies that stand for it in the world: a drawing of the rod leaves them out."""


class Stage(ABC):
    """A world of its own with soft robots in it, as a scene has set it up."""

    @property
    @abstractmethod
    def soft_bodies(self) -> tuple[SoftBody, ...]:
        """All soft robots, after a step."""

    @property
    @final
    def state(self) -> State:
        """State of the first soft robot, after a step."""
        return self.soft_bodies[0].state

    @abstractmethod
    def advance(self, t: float) -> None:
        """Command and simulate the step that begins at time t [s]."""

    def picture(self) -> Image | None:
        """Return the present picture of the camera on the first soft robot, where there is one."""
        return None

    def close(self) -> None:  # noqa: B027
        """Let go of what is outside of Python's memory; once more does nothing."""


class HostedWorld(Stage):
    """A PyBullet world."""

    world: Bullet

    @final
    def close(self) -> None:
        """Disconnect the world; once more does nothing."""
        if self.world.isConnected():
            self.world.disconnect()


class SceneStage(HostedWorld):
    """A world with rods on hosts."""

    rods: tuple[MountedRod, ...]
    arm: BulletArm | None = None
    """The serial arm that carries the first rod, where there is one."""

    @property
    @final
    def soft_bodies(self) -> tuple[SoftBody, ...]:
        """All rods, in order."""
        return tuple(
            SoftBody(rod.simulator.robots[0], rod.state, tuple(rod.bodies.ids))
            for rod in self.rods
            if rod.state is not None
        )

    def follow_arm(self) -> None:
        """Move visuals that follow the arm to where the arm is now: `advance` does so itself; anything else
        that drives the arm calls it after each step of the world."""


class MujocoStage(Stage):
    """A MuJoCo model with a rod on one of its bodies."""

    model: Any
    data: Any
    rod: MujocoRod

    @property
    @final
    def soft_bodies(self) -> tuple[SoftBody, ...]:
        """The rod."""
        return (SoftBody(self.rod.rod.robot, self.rod.rod.state, tuple(self.rod.capsule_bodies)),)


class StagedScene(Scene):
    """Soft robots on rigid robots, in a world that a physics engine simulates."""

    @abstractmethod
    def stage(self) -> Stage:
        """A new world, before its first step."""

    @final
    def run(self) -> Iterator[tuple[float, State]]:
        """(t [s], state of the first soft robot) of each step."""
        stage = self.stage()
        for t in self.play(stage):
            yield t, stage.state

    @final
    def play(self, stage: Stage) -> Iterator[float]:
        """Advance to the end of the run, t [s] by t; the world is closed afterwards, whatever happens."""
        try:
            for k in range(round(self.duration / self.dt)):
                stage.advance(k * self.dt)
                yield (k + 1) * self.dt
        finally:
            stage.close()


class HostedScene(StagedScene):
    """Soft robots on the rigid robots of a PyBullet world (`pip install fastrod[hosts]`)."""

    @abstractmethod
    def stage(self) -> HostedWorld:
        """A new world, before its first step."""


class MujocoScene(StagedScene):
    """A rod on a rigid robot of a MuJoCo model (`pip install fastrod[mujoco]`)."""

    @abstractmethod
    def stage(self) -> MujocoStage:
        """A new model and its data, before their first step."""


def names() -> tuple[str, ...]:
    """The scenes that there are, in alphabetical order."""
    return tuple(sorted(_SCENES))


def load(name: str) -> Scene:
    """The scene of this name; `UnknownNameError` with the nearest one."""
    if name not in _SCENES:
        raise UnknownNameError(f"no scene {name!r}; {nearest(str(name), _SCENES)}")
    module, word = _SCENES[name].split(":")
    scene: Scene = getattr(import_module(module), word)()
    return scene
