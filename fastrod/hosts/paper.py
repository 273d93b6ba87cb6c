"""The robot that the paper's simulation class moves: its actions, its frame, its shape."""

from __future__ import annotations

import math
from typing import NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.errors import InputError
from fastrod.hosts.bullet import pybullet
from fastrod.hosts.link import from_xyzw
from fastrod.model.robot import Robot, Segment, Tendon
from fastrod.model.segment_actions import SegmentActions
from fastrod.rotation import (
    matrix_from_quaternion,
    product,
    quaternion_from_matrix,
    quaternion_from_vector,
    rotation_between,
)
from fastrod.simulator import Simulator
from fastrod.types import Floats

_FROM_FASTROD = np.sqrt(0.5) * np.array([1.0, -1.0, 0.0, 0.0])  # w x y z: d1 to +x, d2 to -z, d3 to +y
_SIGNS = np.array([1.0, 1.0, -1.0])  # of an action's numbers: the second bend goes toward +z, against d2
_MOST_BEND = math.pi  # of a segment [rad]


class Command(NamedTuple):
    """Command of a user, checked."""

    action: Floats
    """(3 n_segments,) extension and two displacements of each segment, base first [m]."""
    base_position: Floats
    """(3,) world [m]."""
    base_quaternion: Floats
    """(4,) w x y z, world_from_robot."""


class PaperShape(NamedTuple):
    """Shape of the robot under a command: points evenly along the backbone, quaternions w x y z."""

    command: Command
    own: Floats
    """(n_points, 7) in the robot's frame: position [m] and quaternion, robot_from_material."""
    world: Floats
    """(n_points, 7) in the world."""
    rotation: Floats
    """(n_points, 3, 3) world_from_material."""


@final
class PaperShapes:
    """Commands to settled shapes, each as if it were the first."""

    def __init__(self, robot: Robot, n_points: int) -> None:
        """`n_points` along the whole robot. Raises `RobotError` where the robot cannot be driven by
        actions."""
        self.robot = robot
        self.n_points = n_points
        self._actions = SegmentActions(robot)
        self._simulator = Simulator(robot, 1, threads=1)

    def command(self, action: ArrayLike | None, base_pos: ArrayLike, base_orin: ArrayLike) -> Command:
        """A checked command; `action` None is the straight robot. Raises `InputError` on a wrong length, on
        what is not finite, and beyond the range of extension or a bend of 180 degrees."""
        given = (
            np.zeros(self._actions.n_actions)
            if action is None
            else numbers("action", action, self._actions.n_actions)
        )
        for k, (extension, *bends) in enumerate(given.reshape(-1, 3).tolist()):
            low, high = self.robot.segments[k].extension
            if not low - 1e-12 <= extension <= high + 1e-12:
                raise InputError(
                    f"the extension of segment {k + 1} is {extension:g} m; its range is from "
                    f"{low:g} to {high:g} m."
                )
            if math.hypot(*bends) > (most := _MOST_BEND * float(self._actions.offset[k])) * (1.0 + 1e-9):
                raise InputError(
                    f"the displacements of segment {k + 1} are {bends} m; together at most "
                    f"{most:.4g} m, a bend of 180 degrees."
                )
        return Command(given, numbers("base_pos", base_pos, 3), orientation_of("base_orin", base_orin))

    def at(self, command: Command) -> PaperShape:
        """The robot at rest under its own weight, without contact. Raises `InputError` where there is no such
        shape."""
        base = np.concatenate([command.base_position, product(command.base_quaternion, _FROM_FASTROD)])
        self._simulator.reset()  # a cold start, so that the answer does not depend on earlier commands
        signed = (command.action.reshape(-1, 3) * _SIGNS).ravel()
        state = self._simulator.settle(**self._actions.inputs(signed), base_pose=base)
        if not state.ok[0]:
            raise InputError(f"action {command.action.tolist()} has no shape: {state.problems[0]}.")
        pose = self._simulator.shape(np.linspace(0.0, state.arclength[0, -1], self.n_points))
        orientation = matrix_from_quaternion(command.base_quaternion[None])[0]
        back = command.base_quaternion * [1.0, -1.0, -1.0, -1.0]
        own_q = product(np.broadcast_to(back, (self.n_points, 4)), quaternion_from_matrix(pose.rotation[0]))
        own = np.concatenate([(pose.position[0] - command.base_position) @ orientation, own_q], axis=1)
        world_q = product(np.broadcast_to(command.base_quaternion, (self.n_points, 4)), own_q)
        world = np.concatenate([own[:, :3] @ orientation.T + command.base_position, world_q], axis=1)
        return PaperShape(command, own, world, pose.rotation[0])


def between(a: Command, b: Command, fraction: float) -> Command:
    """Interpolate from one command to the other."""
    orientation = quaternion_from_vector(
        fraction * rotation_between(a.base_quaternion[None], b.base_quaternion[None])[0]
    )
    action, position = (
        (1.0 - fraction) * x + fraction * y
        for x, y in ((a.action, b.action), (a.base_position, b.base_position))
    )
    return Command(action, position, product(orientation, a.base_quaternion))


def paper_robot(n: int, radius: float) -> Robot:
    """The paper's prototype in `n` extensible segments of 0.1 m, of body `radius` [m]; the tendons are so
    stiff that a bend is what its displacement says to 1e-4 rad, and the offset of 7.5 mm is not the paper's,
    which gives none."""
    tendons = tuple(Tendon(offset=0.0075, angle=k * math.pi / 2.0, compliance=1e-8) for k in range(4))
    segment = Segment(
        length=0.1,
        bending_stiffness=(0.0022, 0.0022),
        torsional_stiffness=0.001,
        extension=(-0.05, 0.1),
        body_radius=max(radius, 0.0075),
        tendons=tendons,
    )
    return Robot(name=f"softmanisim_{n}", segments=(segment,) * n, gravity=(0.0, 0.0, 0.0))


def orientation_of(name: str, orientation: ArrayLike) -> Floats:
    """(4,) w x y z of three Euler angles as for getQuaternionFromEuler [rad], or of a quaternion x y z w.
    Raises `InputError`."""
    q = numbers(name, orientation, 3, 4)
    if len(q) == 3:
        return from_xyzw(pybullet().getQuaternionFromEuler(q.tolist()))
    if abs((norm := float(np.linalg.norm(q))) - 1.0) > 1e-3:
        raise InputError(
            f"{name} is {q.tolist()}, a quaternion of norm {norm:.6g}; it must be 1, as x y z w."
        )
    return from_xyzw(q / norm)


def numbers(name: str, value: ArrayLike, *lengths: int) -> Floats:
    """(n,) finite numbers, n one of `lengths`; columns and rows are taken too. Raises `InputError` that calls
    it `name`."""
    try:
        v = np.atleast_1d(np.squeeze(np.array(value, dtype=float)))
    except (TypeError, ValueError):
        v = np.empty(0)
    if v.ndim != 1 or len(v) not in lengths:
        raise InputError(f"{name} is {value!r}; it must be {' or '.join(map(str, lengths))} numbers.")
    if not np.isfinite(v).all():
        raise InputError(f"{name} is {v.tolist()}; every number must be finite.")
    return v
