"""Memory of contact between steps, and its view of rods and obstacles in one pass."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from fastrod.contact.contacts import Contacts, contacts_of
from fastrod.contact.direct import BroadPhase
from fastrod.contact.frames import back_by, between, frames_of, longest_move
from fastrod.contact.scene import ContactScene
from fastrod.contact.tree import pack
from fastrod.kernels.contact.candidates import MOST_FOUND
from fastrod.kernels.contact.proximity import search_work
from fastrod.kernels.contact.rod_proximity import RodSearch
from fastrod.kernels.contact_batch import search_gaps, search_worlds
from fastrod.rotation import cross, displaced
from fastrod.types import (
    CANDIDATE,
    CONTACT,
    Clearance,
    ContactMotion,
    ContactRods,
    ContactRows,
    ContactSet,
    Flags,
    Floats,
    Ints,
    RodShape,
)

_FEW = 64  # robots below which starting threads costs more than it saves


class ContactSnapshot(NamedTuple):
    """Saved memory of an `Engine`."""

    contact_set: ContactSet
    clearance: Clearance
    before: RodShape | None
    """Shapes at the last step."""
    tracked: Flags
    """(n_robots,) `before` holds where the robot was."""
    poses: Floats
    """(1 or n_robots, n_obstacles, 7) world."""
    poses_before: Floats
    """The same at the last step."""
    at_last_step: tuple[RodShape | None, Floats]
    """Shapes and obstacles before the last step."""


class Engine:
    """Memory of contact between steps. Rows are robots' indices; arrays have the robot axis first."""

    def __init__(
        self, scene: ContactScene, rods: ContactRods, length: Floats, n_points: int, threads: int
    ) -> None:
        n = len(rods.length)
        self.scene, self.rods, self.length, self.threads = scene, rods, length, threads
        self.surfaces = pack(scene.obstacles, scene.collision == "fcl")
        self.world = scene.world_of(n)
        self.poses_before = self.poses = scene.rest_poses()
        self.velocities: dict[int, Floats] = {}
        self.dt = 0.0
        self.at_last_step: tuple[RodShape | None, Floats] = (None, self.poses)
        """Shape and obstacles before the last step."""
        self.contact_set = ContactSet(np.zeros(n, np.int64), np.zeros((n, scene.max_contacts), CONTACT))
        self.clearance = unknown_clearance(n, n_points)
        self.before: RodShape | None = None
        self.tracked, self.slides = np.zeros(n, bool), np.ones(n, bool)
        self.yielded: Floats | None = None
        """(3, n_robots, n_obstacles, 6) of free bodies, in a step that is taken in parts: how far they are
        from where they would be without the rods, displacement of the centre of mass and rotation, world [m,
        rad]; by how much that grows in a whole step; and the mean wrench on them, as `Contacts.wrench`."""
        self.slips_from: tuple[RodShape, Floats] | None = None
        """Shape and obstacles from which slip is counted, where that is not from `before`."""
        self._broad: BroadPhase | None = None  # of scenes by FCL

    def __getstate__(self) -> dict[str, Any]:
        """Return what `pickle` and `copy` take."""
        return {**self.__dict__, "_broad": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take up what `pickle` or `copy` made: compiled shapes stand elsewhere in another process."""
        self.__dict__.update(state)
        again = pack(self.scene.obstacles, self.scene.collision == "fcl")
        self.surfaces = self.surfaces._replace(primitive=again.primitive, size=again.size)

    def move(self, poses: Floats, velocities: dict[int, Floats], dt: float) -> None:
        """`poses` (1 or n_robots, n_obstacles, 7) of the obstacles in this step, world. Those with a
        velocity, by index (1 or n_robots, 6) [m/s, rad/s], slip by it, the others by how far their pose has
        moved."""
        self.at_last_step = (self.before, self.poses_before)
        self.poses, self.velocities, self.dt = poses, velocities, dt
        self.clearance.distance[:] -= longest_move(self.poses_before, poses, self.surfaces.sphere)[:, None]

    def place_at_once(self, rows: Flags) -> None:
        """For these robots the obstacles have not come from anywhere: they are where they are."""
        if rows.any() and self.poses is not self.poses_before:
            shape = (len(rows), *self.poses.shape[1:])
            both = (np.broadcast_to(poses, shape) for poses in (self.poses, self.poses_before))
            self.poses_before = np.where(rows[:, None, None], *both)

    def begin_anew(self, cold: Flags) -> None:
        """These robots have neither contacts nor a past."""
        self.forget(cold)
        self.place_at_once(cold)

    def forget(self, rows: Ints | Flags) -> None:
        """No contacts, no history."""
        self.contact_set.used[rows] = 0
        self.clearance.distance[rows] = -np.inf
        self.tracked[rows] = False

    def snapshot(self) -> ContactSnapshot:
        """A copy of everything that a later step depends on; shapes are handed out once and not written
        again."""
        return ContactSnapshot(
            ContactSet(*(a.copy() for a in self.contact_set)),
            Clearance(*(a.copy() for a in self.clearance)),
            self.before,
            self.tracked.copy(),
            self.poses,
            self.poses_before,
            self.at_last_step,
        )

    def restore(self, snapshot: ContactSnapshot) -> None:
        """Go back to a `snapshot` of this engine."""
        self.contact_set = ContactSet(*(a.copy() for a in snapshot.contact_set))
        self.clearance = Clearance(*(a.copy() for a in snapshot.clearance))
        self.before, self.tracked = snapshot.before, snapshot.tracked.copy()
        self.poses, self.poses_before = snapshot.poses, snapshot.poses_before
        self.at_last_step = snapshot.at_last_step

    def in_worlds(self, rows: Ints) -> ContactRows:
        """`rows` (n,) world by world."""
        ordered = rows[np.argsort(self.world[rows], kind="stable")]
        start = starts_of(self.world[ordered])
        return ContactRows(start, ordered)

    @property
    def rods_meet(self) -> bool:
        """A rod may touch itself or another."""
        return self.scene.self_contact or self.scene.worlds is not None

    def pressed(self) -> Flags:
        """(n_robots,) in a world where some contact carries a force."""
        used, contact = self.contact_set
        there = np.arange(contact.shape[1]) < used[:, None]
        return self.whole_worlds(((contact["force"] != 0.0).any(2) & there).any(1))

    def whole_worlds(self, some: Flags) -> Flags:
        """(n_robots,) all robots of the worlds of those that are marked."""
        if self.scene.worlds is None:
            return some
        worlds = np.zeros(self.world.max() + 1, bool)
        worlds[self.world[some]] = True
        return np.asarray(worlds[self.world])

    def overlap(self, rows: Ints, shape: RodShape) -> Flags:
        """(n_robots,) which of `rows`, free until now, overlap something in `shape` or have gone through it;
        with their worlds."""
        some = np.zeros(len(self.tracked), bool)
        if not len(rows):
            return some
        threads = self.thread_count(len(rows))
        found, n_found = np.empty((len(rows), MOST_FOUND), CANDIDATE), np.zeros(len(rows), np.int64)
        one = np.ones(1)
        motion = self.motion(shape, 1e-9, self.frames(0.0 * one, one))._replace(margin=0.0)
        work = search_work(threads, shape.arclength.shape[1])
        near = rows if self.scene.collision == "bvh" else self._near(rows, shape)
        if len(near):
            search_gaps(threads, near, self.rods, self.surfaces, motion, found, n_found, work)
        if self.rods_meet:
            self.lower_gaps(rows, motion)
        some[rows] = self.clearance.gap[rows] < 0.0
        some[near] |= n_found[: len(near)] < 0
        return self.whole_worlds(some)

    def _near(self, rows: Ints, shape: RodShape) -> Ints:
        """Those of `rows` that may touch an obstacle on their way to `shape`, by FCL's tree; the gap of the
        others is at least what is watched."""
        if self._broad is None:
            self._broad = BroadPhase(self.scene.obstacles, self.surfaces.sphere)
        watched = self.scene.watch * self.rods.length
        moved = np.broadcast_to(
            longest_move(self.poses_before, self.poses, self.surfaces.sphere), self.tracked.shape
        )
        before = shape if self.before is None else self.before
        both = np.concatenate([shape.position[rows], before.position[rows]], axis=1)
        around = (self.rods.radius.max(1) + watched + moved)[rows, None]
        poses = self.poses if len(self.poses) == 1 else self.poses[rows]
        known = np.isfinite(both).all((1, 2))
        near = ~known
        near[known] = self._broad.near(
            (both.min(1) - around)[known],
            (both.max(1) + around)[known],
            poses if len(poses) == 1 else poses[known],
        )
        far = rows[~near]
        self.clearance.gap[far] = watched[far]
        return np.asarray(rows[near])

    def lower_gaps(self, rows: Ints, motion: ContactMotion) -> None:
        """Lower the gaps of these robots in `motion` to those between rods."""
        search = RodSearch(motion, self.rods, self.contact_set, motion.frames.shape[1], 0.0, 0.0)
        search_worlds(self.in_worlds(rows), search, False)

    def accept(self, rows: Ints, shape: RodShape, between_steps: bool = False) -> None:
        """These robots are at rest in `shape`: from there they slip and move. `between_steps`: it will
        be written to again."""
        if len(rows) == len(self.tracked) and not between_steps:
            self.before = shape
        else:
            self.before = RodShape(*(np.array(a) for a in (shape if self.before is None else self.before)))
            for last, now in zip(self.before, shape, strict=True):
                last[rows] = now[rows]
        self.tracked[rows] = True

    def end_step(self, done: Floats) -> None:
        """The obstacles are at the end of their displacement; for a robot that came only the fraction `done`
        (n_robots,), where it met them."""
        come = (done >= 1.0).all()
        self.poses_before = self.poses if come else between(self.poses_before, self.poses, done)

    def contacts(self, shape: RodShape, ok: Flags) -> Contacts:
        """The contacts of a state."""
        thinnest = np.maximum(self.rods.radius.min(1), 1e-6)
        known = self.scene.names, self.contact_set, self.clearance, self.poses
        found = contacts_of(*known, shape, ok, thinnest)
        if self.yielded is None:
            return found
        mean = self.yielded[2]
        return replace(found, wrench=np.where(mean.any((1, 2), keepdims=True), mean, found.wrench))

    def thread_count(self, n: int) -> int:
        """Threads for n robots, or worlds."""
        return 1 if n <= _FEW else min(self.threads, n)

    def frames(self, done: Floats, aim: Floats) -> tuple[Floats, Floats, Floats]:
        """Frames of the obstacles at the fraction `aim` of their displacement, at `done`, which is behind,
        and where slip is counted from."""
        began = None if self.slips_from is None else self.slips_from[1]
        moves = self.velocities or self.yielded is not None or began is not None
        if self.poses is self.poses_before and not moves:
            still = frames_of(self.poses)
            return still, still, still
        poses, last = (between(self.poses_before, self.poses, fraction) for fraction in (aim, done))
        ago = last if began is None else began
        ago = ago.repeat(max(len(poses), 1) // max(len(ago), 1), axis=0) if self.velocities else ago
        for k, velocity in self.velocities.items():
            slid = back_by(poses[:, k], velocity, self.dt * (aim - done if began is None else aim))
            ago = ago.repeat(len(slid) // len(ago), axis=0)
            ago[:, k] = slid
        if self.yielded is not None:
            off, speed = self.yielded[:2]
            last, ago = self._aside(last, off), self._aside(ago, off)
            poses = self._aside(poses, off + (aim - done)[:, None, None] * speed)
        return frames_of(poses), frames_of(last), frames_of(ago)

    def _aside(self, poses: Floats, off: Floats) -> Floats:
        """Poses of bodies that are so far `off` (n_robots, n_obstacles, 6)."""
        arm = poses[..., :3] - self.surfaces.center
        by = np.concatenate([off[..., :3] + cross(off[..., 3:], arm), off[..., 3:]], axis=-1)
        return displaced(np.broadcast_to(poses, (*by.shape[:2], 7)), by)

    def end_section(self, fraction: float, shape: RodShape, rows: Flags) -> None:
        """Let free bodies feel the forces of these robots for this `fraction` of a step."""
        if (yielded := self.yielded) is None:
            return
        self.yielded, surfaces = None, self.surfaces
        wrench, self.yielded = self.contacts(shape, rows).wrench, yielded
        moment = wrench[..., 3:] + cross(self.poses[..., :3] - surfaces.center, wrench[..., :3])
        there = np.concatenate([wrench[..., :3], moment], axis=-1)
        each = np.einsum("kij,nkj->nki", surfaces.mobility, there)
        same = 1.0 * (surfaces.body[:, None] == surfaces.body)  # of all its obstacles
        gained = np.einsum("kl,nli->nki", same, each) - surfaces.ahead
        off, speed, mean = yielded
        speed[rows] += fraction * gained[rows]
        off[rows] += fraction * speed[rows]
        mean[rows] += fraction * wrench[rows]
        self.clearance.distance[rows] = -np.inf

    def motion(
        self, shape: RodShape, tolerance: float, frames: tuple[Floats, Floats, Floats]
    ) -> ContactMotion:
        """Rods in `shape` among the obstacles in their `frames`."""
        came = shape if self.before is None else self.before
        return motion_of(
            frames,
            (shape, came, came if self.slips_from is None else self.slips_from[0]),
            self.clearance,
            tracked=self.tracked,
            slides=self.tracked & self.slides,
            tolerance=tolerance,
            margin=self.scene.watch,
        )


def starts_of(world: Ints) -> Ints:
    """(n_worlds + 1,) where each world begins in `world` (n,), in which rows of the same one stand together;
    and n."""
    new = np.ones(len(world) + 1, bool)
    np.not_equal(world[1:], world[:-1], out=new[1:-1])
    return np.flatnonzero(new)


def motion_of(
    frames: tuple[Floats, Floats, Floats],
    shapes: tuple[RodShape, RodShape, RodShape],
    clearance: Clearance,
    *,
    tracked: Flags,
    slides: Flags,
    tolerance: float,
    margin: float,
) -> ContactMotion:
    """Put together what kernels read of one pass: `frames` and `shapes` now, before, and for slip."""
    now, came, origin = (_curves(shape) for shape in shapes)
    return ContactMotion(*frames, *now, *came, *origin, *clearance, tracked, slides, tolerance, margin)


def _curves(shape: RodShape) -> tuple[Floats, Floats, Floats, Floats]:
    return shape.position, shape.rotation, shape.curvature, shape.arclength


def unknown_clearance(n: int, n_points: int) -> Clearance:
    """Nothing is known about n robots."""
    return Clearance(np.full((n, n_points), -np.inf), np.zeros((n, n_points, 3)), np.full(n, np.inf))
