"""`Contacts`: the contacts of a state, as it hands them out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fastrod.errors import UnknownNameError, nearest
from fastrod.rotation import cross
from fastrod.types import Clearance, ContactSet, Flags, Floats, Ints, RodShape

CLOSED = 1e-9
"""A gap below it is contact, also where no force is needed to keep it [m]."""


@dataclass(frozen=True)
class Contacts:
    """The contacts of a state, robot axis first, world frame. Rows are filled from the left; what is beyond
    `count` is nan, or -1 in `obstacle`. One touch may be held by several neighbouring contacts that share its
    force."""

    names: tuple[str, ...]
    """Names of the obstacles; then come the rods of the robots, `rod 0`, `rod 1`, ..."""
    count: Ints
    """(n_robots,)"""
    obstacle: Ints
    """(n_robots, n) index of what is touched: an obstacle, or n_obstacles + i for the rod of robot i."""
    point: Floats
    """(n_robots, n, 3) on the rod's surface [m]."""
    normal: Floats
    """(n_robots, n, 3) unit, from the obstacle to the rod."""
    gap: Floats
    """(n_robots, n) [m]; negative by the depth in a soft obstacle, and by how far a body that gives way
    (`Simulator.set_free`) was pushed from the pose it was given."""
    force: Floats
    """(n_robots, n, 3) on the rod, friction included [N]."""
    arclength: Floats
    """(n_robots, n) of the rod [m]."""
    wrench: Floats
    """(n_robots, n_obstacles, 6) on each obstacle by each robot: force [N], moment about the obstacle's
    origin [N m], world; of a body that gives way the mean over the step."""
    clearance: Floats
    """(n_robots,) smallest gap to anything, as `gap`; a lower bound where nothing is near [m]."""
    deep: Flags
    """(n_robots,) the centreline lies inside an obstacle: its surface was entered by more than the rod's
    radius."""
    tip_arclength: Floats
    """(n_robots,) [m]."""

    def in_contact(self, name: str | None = None) -> Flags:
        """(n_robots,) which robots touch the obstacle (or `rod 3`) of this name; None: anything. Raises
        `UnknownNameError`."""
        if name is None:
            return self.count > 0
        if name in self.names:
            k = self.names.index(name)
        elif name.startswith("rod ") and name[4:].isdigit() and int(name[4:]) < len(self.count):
            k = len(self.names) + int(name[4:])
        else:
            raise UnknownNameError(f"no obstacle {name!r}; {nearest(name, self.names)}")
        return np.asarray((self.obstacle == k).any(1))

    @property
    def tip_in_contact(self) -> Flags:
        """(n_robots,) which robots touch something with the half sphere of their tip."""
        with np.errstate(invalid="ignore"):
            return np.asarray((self.arclength >= self.tip_arclength[:, None] * (1.0 - 1e-9)).any(1))

    @property
    def total_force(self) -> Floats:
        """(n_robots, 3) of all contacts on each rod, world [N]."""
        return np.asarray(np.nansum(self.force, axis=1))


def contacts_of(
    names: tuple[str, ...],
    contact_set: ContactSet,
    clearance: Clearance,
    poses: Floats,
    shape: RodShape,
    ok: Flags,
    thinnest: Floats,
) -> Contacts:
    """The contacts of the robots that are `ok`, in `shape`, with obstacles of these names at `poses` (1 or
    n_robots, n_obstacles, 7); `thinnest` (n_robots,) is the least radius of each [m]."""
    n, n_obstacles = len(ok), len(names)
    contact = contact_set.contact
    live = (np.arange(contact.shape[1]) < contact_set.used[:, None]) & ok[:, None]
    live &= (contact["force"] != 0.0).any(2) | (contact["gap"] < CLOSED)
    count = np.asarray(live.sum(1))
    width = int(count.max(initial=0))
    order = np.argsort(~live, axis=1, kind="stable")[:, :width]
    kept = np.take_along_axis(contact, order, axis=1)
    beyond = np.arange(width) >= count[:, None]

    def field(name: str) -> Floats:
        return np.where(beyond.reshape(*beyond.shape, *[1] * (kept[name].ndim - 2)), np.nan, kept[name])

    normal, force, s = field("normal"), field("force"), field("arclength")
    centre = _centreline(shape, np.where(beyond, 0.0, kept["arclength"]))
    point = centre - field("radius")[:, :, None] * normal
    index = np.where(beyond, -1, kept["obstacle"])
    wrench = np.zeros((n, n_obstacles, 6))
    origin = np.broadcast_to(poses[:, :, :3], (n, n_obstacles, 3))
    for k in range(n_obstacles):
        on = np.where((index == k)[:, :, None], -force, 0.0)
        wrench[:, k, :3] = on.sum(1)
        arm = np.where((index == k)[:, :, None], point - origin[:, None, k], 0.0)
        wrench[:, k, 3:] = cross(arm, on).sum(1)
    return Contacts(
        names=names,
        count=count,
        obstacle=index,
        point=point,
        normal=normal,
        gap=field("gap"),
        force=force,
        arclength=s,
        wrench=wrench,
        clearance=np.where(ok, clearance.gap, np.nan),
        deep=ok & (clearance.gap < -thinnest),
        tip_arclength=shape.arclength[:, -1],
    )


def _centreline(shape: RodShape, s: Floats) -> Floats:
    """(n, m, 3) of the centreline at arclengths (n, m), between the nodes by Hermite's cubic."""
    robot = np.arange(len(s))[:, None]
    node = np.clip((s[:, :, None] >= shape.arclength[:, None, 1:-1]).sum(2), 0, shape.arclength.shape[1] - 2)
    first, last = (shape.arclength[robot, node + k] for k in range(2))
    h = (last - first)[..., None]
    t = (s - first)[..., None] / h
    p0, p1 = (shape.position[robot, node + k] for k in range(2))
    t0, t1 = (h * shape.rotation[robot, node + k][..., 2] for k in range(2))
    return np.asarray(p0 + t * t * (3.0 - 2.0 * t) * (p1 - p0) + t * (1.0 - t) * ((1.0 - t) * t0 - t * t1))
