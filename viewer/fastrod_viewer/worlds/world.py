"""`World`: robots that the viewer shows and a person drives; free in space, in a scene, or on a rigid
host."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fastrod.logs.link import Measurement
from fastrod.model.robot import Robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.rotation import quaternion_from_matrix
from fastrod.solver.state import State
from fastrod.types import Floats

if TYPE_CHECKING:
    from fastrod_viewer.worlds.ringing import Ringing


class Body(NamedTuple):
    """A rigid thing that is drawn: a link of a host, an obstacle, a floor."""

    name: str
    """Unique in its world."""
    vertices: NDArray[np.float32]
    """(n, 3) own frame [m]."""
    faces: NDArray[np.uint32]
    """(m, 3)"""
    color: tuple[int, int, int]
    """Red, green, blue, 0 to 255."""
    opacity: float = 1.0


class DrawnRods(NamedTuple):
    """Robots of one simulator."""

    robots: tuple[Robot, ...]
    """One for all, or one each."""
    state: State
    """After the last step."""
    place: Floats
    """(n_robots, 3) where each is drawn, added to world coordinates [m]: many robots stand in a grid."""
    radius: tuple[float, ...]
    """(n_segments,) of the body [m]."""


@dataclass(frozen=True, eq=False)
class ManualCommand:
    """Manual command to a world for one step."""

    tendon_length: Floats
    """(n_tendons,) absolute [m]; for robots that are driven by tension, not used."""
    extension: Floats
    """(n_segments,) [m]."""
    tension: Floats | None = None
    """(n_tendons,) [N], where a segment is driven by it."""
    base: Floats = field(default_factory=lambda: np.zeros(6))
    """(6,) of base or flange from its home: displacement [m] and rotation vector [rad], world."""
    base_rate: Floats | None = None
    """(n_joints,) of the joints of the host, in the place of `base`, where a drag moves them [rad/s]."""
    tip_force: Floats = field(default_factory=lambda: np.zeros(3))
    """(3,) world [N]; the payload's weight comes on top."""
    payload: float = 0.0
    """At the tip [kg]."""
    gravity: float = 1.0
    """Times the robot's own gravity, for robot and payload."""
    freeze: bool = False
    """The rigid host holds still."""


class World(ABC):
    """Robots and their surroundings, advanced step by step, by a script or by hand."""

    name: str
    about: str
    """One sentence."""
    dt: float
    """[s] of a step."""
    robot: Robot
    """The robot that is driven by hand; of many, all are driven alike."""
    actions: SegmentActions | None
    """Its segments as one drives them; None where they are not driven by tendon lengths."""
    drivable: bool
    """It can be driven by hand; otherwise only its script moves it."""
    scripted: bool
    """It has a script."""
    duration: float
    """Duration of the script [s]; the script begins again after it."""
    host: bool
    """A rigid host carries the robot, and can be frozen."""
    base_moves: bool
    """`ManualCommand.base` is heeded."""
    loads: bool
    """`ManualCommand.tip_force`, `payload` and `gravity` are heeded."""
    ringing: Ringing | None = None
    """Ringing of rods that have inertia: a drag is a spring on the tip, and they go on moving by
    themselves."""

    @property
    @abstractmethod
    def t(self) -> float:
        """Time since the last reset [s]."""

    @property
    @abstractmethod
    def rods(self) -> tuple[DrawnRods, ...]:
        """All soft robots; the first robot of the first is the one that is driven."""

    @property
    @abstractmethod
    def bodies(self) -> tuple[Body, ...]:
        """Rigid things, the same from reset to reset."""

    @abstractmethod
    def poses(self) -> Floats:
        """(n_bodies, 7) position [m] and quaternion w x y z, world, after the last step."""

    @abstractmethod
    def play(self) -> None:
        """One step of the script. Raises `FastrodError` where it cannot be done."""

    @abstractmethod
    def drive(self, command: ManualCommand) -> None:
        """Do one step of a manual command. Raises `FastrodError` where it cannot be done; the world is then
        as after its last good step, or reset."""

    @abstractmethod
    def reset(self) -> None:
        """Back to the beginning."""

    @abstractmethod
    def jacobian(self) -> Floats:
        """(3, n_joints + n_actions) d(tip position, world [m]) / d(joints of the host, action) at the last
        state; n_joints is 0 where no host can be moved by a drag. Raises `FastrodError` where there is
        none."""

    def picture(self) -> NDArray[np.uint8] | None:
        """Return the picture (height, width, 3) of the tip camera now, where there is one."""
        return None

    @abstractmethod
    def close(self) -> None:
        """Let go of everything outside of Python's memory."""


def measure(world: World, command: ManualCommand | None) -> Measurement:
    """Return what a perfect encoder and camera measure of the world's first robot now; t is the world's,
    frames those of a run log."""
    state = world.rods[0].state
    base, rotation = state.position[0, 0], state.rotation[0, 0]
    tip = rotation.T @ state.tip_rotation[0]
    if command is not None:
        change, extension = command.tendon_length - world.robot.rest_tendon_length, command.extension
    else:
        change = state.path_length[0] - _stretch(world) - world.robot.rest_tendon_length
        extension = np.diff(_ends(world), prepend=0.0) - [segment.length for segment in world.robot.segments]
    return Measurement(
        t=world.t,
        dl=change,
        ext=extension,
        tip_position=rotation.T @ (state.tip_position[0] - base),
        tip_quaternion=quaternion_from_matrix(tip[None])[0],
        tension=state.tension[0],
    )


def _stretch(world: World) -> Floats:
    """Return by how much each tendon (n_tendons,) is longer than commanded: compliance (T - pretension)
    [m]."""
    tendons = [tendon for segment in world.robot.segments for tendon in segment.tendons]
    compliance, pretension = (
        np.array([getattr(tendon, name) for tendon in tendons]) for name in ("compliance", "pretension")
    )
    return np.asarray(compliance * (world.rods[0].state.tension[0] - pretension), dtype=np.float64)


def _ends(world: World) -> Floats:
    """(n_segments,) arclength of each segment's end [m]."""
    arclength = world.rods[0].state.arclength[0]
    n = world.robot.n_segments
    return np.asarray(arclength[(len(arclength) - 1) // n :: (len(arclength) - 1) // n], dtype=np.float64)
