"""`ContactScene`: what the rods may touch, and how."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike

from fastrod.checks import NOT_NEGATIVE, Bound, check, checked_array, checked_pose
from fastrod.contact.geometry import Obstacle
from fastrod.errors import InputError, UnknownNameError, nearest
from fastrod.model.robot import Robot
from fastrod.types import ContactRods, Floats, Ints, Layout

_BEYOND_TENDONS = 1.1  # a body radius of 0 stands for just beyond the outermost tendon (Segment.body_radius)


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactScene:
    """Obstacles, and how rods touch them, themselves and each other.

    >>> from fastrod.contact import ContactScene, plane
    >>> ContactScene(obstacles=[plane(point=(0.012, 0, 0), normal=(-1, 0, 0), name="wall")]).names
    ('wall',)
    """

    obstacles: Sequence[Obstacle] = ()
    """Meshes and simple shapes, each with a name of its own, a friction coefficient and a stiffness."""
    rod_radius: float | Sequence[float] | None = None
    """Radius of the rods, one or one for each segment [m]; None: body_radius of the robot file, and where
    that is 0 just beyond the outermost tendon. The tip is a half sphere."""
    mounting: Annotated[float | None, Bound(least=0.0, unit="m")] = None
    """Arclength from the base that belongs to the mounting and touches nothing [m]; None: 1.5 radii."""
    self_contact: bool = False
    """A rod touches itself too."""
    worlds: Sequence[int] | None = None
    """(n_robots,) number of the world that a robot is in; robots of one world touch each other. None: each
    has its own."""
    rod_friction: Annotated[float, NOT_NEGATIVE] = 0.0
    """Coulomb coefficient of rod on rod."""
    rod_stiffness: Annotated[float, Bound(above=0.0, unit="N/m", infinite=True)] = math.inf
    """Force per depth of rod on rod; inf is rigid [N/m]."""
    max_contacts: Annotated[int, Bound(least=1, most=64)] = 16
    """Contacts that a rod can have at once."""
    watch: Annotated[float, Bound(above=0.0, most=0.2)] = 0.01
    """Gap below which a contact is watched before it closes, as a fraction of the rod's length."""
    max_iterations: Annotated[int, Bound(least=20)] = 600
    """Iterations after which a step that cannot be solved is given up: fewer where many robots wait for one,
    as in training."""
    collision: Literal["bvh", "fcl", "auto"] = "auto"
    """Method that measures distances to meshes, with the same loads: "bvh", a compiled search for batches;
    "fcl", FCL, one query at a time; "auto" is the cheaper one, which is "bvh" from one robot on (`fastrod
    bench contact`)."""

    def __post_init__(self) -> None:
        obstacles = (self.obstacles,) if isinstance(self.obstacles, Obstacle) else tuple(self.obstacles)
        object.__setattr__(self, "obstacles", obstacles)
        for o in obstacles:
            if not isinstance(o, Obstacle):
                raise InputError(
                    f"ContactScene.obstacles holds {o!r}; give what fastrod.contact.mesh, box, "
                    "sphere, ... return."
                )
        names = [o.name for o in obstacles]
        if len(set(names)) < len(names):
            twice = next(n for n in names if names.count(n) > 1)
            raise InputError(
                f"two obstacles are called {twice!r}; give each a name of its own, mesh(..., name='left')."
            )
        check(self)
        object.__setattr__(self, "collision", "fcl" if self.collision == "fcl" else "bvh")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the obstacles, in order."""
        return tuple(o.name for o in self.obstacles)

    def index(self, name: str) -> int:
        """Index of an obstacle; `UnknownNameError` with the nearest name."""
        if name not in self.names:
            raise UnknownNameError(f"no obstacle {name!r}; {nearest(str(name), self.names)}")
        return self.names.index(name)

    def world_of(self, n_robots: int) -> Ints:
        """(n_robots,) world of each robot, numbered from 0 in the order of the robots."""
        if self.worlds is None:
            return np.arange(n_robots)
        worlds = np.asarray(self.worlds)
        if worlds.shape != (n_robots,):
            raise InputError(
                f"ContactScene.worlds has shape {worlds.shape}; give the world of each of the "
                f"{n_robots} robots."
            )
        return np.asarray(np.unique(worlds, return_inverse=True)[1], dtype=np.int64)

    def rods(self, robots: Sequence[Robot], n_robots: int, layout: Layout) -> ContactRods:
        """Return what contact needs to know of the robots of a simulator."""
        radius = np.array([self.radius_of(robot) for robot in robots])
        length = np.array([robot.length for robot in robots])
        first = 1.5 * radius[:, 0] if self.mounting is None else np.full(len(robots), self.mounting)
        if (first >= length).any():
            raise InputError(
                f"the mounting takes {first.max():.4g} m of a rod of {length.min():.4g} m; give "
                "ContactScene(mounting=...)."
            )
        spacing = np.array([min(s.length for s in robot.segments) for robot in robots]) / layout.n_steps

        def each(a: Floats) -> Floats:
            # writable, as a kernel would be compiled anew for a read-only one
            return np.array(np.broadcast_to(a, (n_robots, *a.shape[1:])), dtype=float, order="C")

        return ContactRods(
            each(radius),
            each(first),
            each(spacing),
            each(length),
            layout.n_steps,
            float(self.rod_friction),
            1.0 / self.rod_stiffness,
            int(self.self_contact),
        )

    def radius_of(self, robot: Robot) -> list[float]:
        """Return the radius of each segment of a robot in this scene [m]; `InputError` where `rod_radius`
        does not fit it."""
        if self.rod_radius is None:
            return [
                segment.body_radius
                or _BEYOND_TENDONS
                * max([np.hypot(*t.position(k + 1)[k]) for t in segment.tendons], default=0.0)
                for k, segment in enumerate(robot.segments)
            ]
        try:
            given = np.broadcast_to(np.asarray(self.rod_radius, float), (robot.n_segments,))
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(
                f"ContactScene.rod_radius is {self.rod_radius!r}; give one radius or {robot.n_segments}, "
                "one a segment [m]."
            ) from error
        if not ((given >= 0.0) & (given <= robot.length)).all():
            raise InputError(
                f"ContactScene.rod_radius is {self.rod_radius!r} m; it must be between 0 and the rod's "
                "length. Was it given in mm?"
            )
        return list(map(float, given))

    def rest_poses(self) -> Floats:
        """(1, n_obstacles, 7) position [m] and quaternion w x y z, world_from_obstacle."""
        return np.array([[*o.position, *o.quaternion] for o in self.obstacles], float).reshape(1, -1, 7)

    def moved(self, poses: Floats, given: Mapping[str, ArrayLike] | None, n_robots: int) -> Floats:
        """`poses` with those that were given, each (7,) or (n_robots, 7); names are checked, quaternions made
        unit."""
        for name, value in (given or {}).items():
            k = self.index(name)
            pose = np.atleast_2d(checked_pose(f"obstacle_pose[{name!r}]", value, n_robots, 1, off=1e-3))
            poses = np.repeat(poses, len(pose), axis=0) if len(poses) < len(pose) else poses.copy()
            poses[:, k] = pose
        return poses

    def velocities(self, given: Mapping[str, ArrayLike] | None, n_robots: int) -> dict[int, Floats]:
        """Obstacle index -> (1 or n_robots, 6) velocity of its origin [m/s] and angular velocity [rad/s],
        world."""
        says, shapes = "velocity [m/s] and angular velocity [rad/s], world", [(6,), (n_robots, 6), (1, 6)]
        found = {}
        for name, value in (given or {}).items():
            twist = checked_array(f"obstacle_velocity[{name!r}]", value, shapes, says)
            found[self.index(name)] = np.atleast_2d(twist)
        return found
