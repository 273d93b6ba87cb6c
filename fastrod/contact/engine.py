"""Contact in the step loop: free robots by their own pass, touching ones by passes and the contact law in turn until at rest.

Inputs that lead a world too far for one linear model are followed in parts, from the last step to this one: a world that
does not come to rest, or a rod that would go through an obstacle, goes half as far. A rod never continues beyond what it
could solve: it stays where it came to, and says so.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fastrod.contact.contacts import TOUCHES, Contacts
from fastrod.contact.frames import back_by, between, blended, frames_of, longest_move
from fastrod.contact.progress import Damping, Progress
from fastrod.contact.scene import ContactScene
from fastrod.contact.tree import pack
from fastrod.contact.trouble import NO_CONTACT_LEFT, NO_NODE_LEFT, sentence
from fastrod.kernels.batch import arrange, iterate_parallel, iterate_serial, look_at_rods, look_parallel, look_serial
from fastrod.kernels.bvh import STACK
from fastrod.kernels.forces import Scenery
from fastrod.kernels.search import CANDIDATE
from fastrod.kernels.slots import SLOT, T_FORCE, T_GAP, T_N, T_OBSTACLE, T_RADIUS, T_S
from fastrod.kernels.touch import AT_REST, BACK, GOES_ON, INSIDE, LOST, MOVES, NOTHING, TROUBLE, UNSOLVED, world_size
from fastrod.types import Clearance, Flags, Floats, Ints, Memory, Ports, Probes, Rods, Shape, Touching

Pass = Callable[[Ints, Ports, Shape, Probes], None]
"""(robots, ports, shape, probes): one forward pass into `shape` that leaves the boundary as it is."""

MOST_FOUND = 64
"""Candidates of one robot that a look notes."""
_BLOCK = 2048  # robots whose linear models are held at once
_MOST_PASSES = 16  # and more for a robot that comes closer to rest
_NEARLY = 1e-4  # of the length
_LONGEST = 4  # times the usual number of passes, and no more
_IDLE = 6  # passes in a row that came no closer to rest: the iteration goes in circles
_MOST_INSIDE = 8  # passes in a row with the centreline inside of an obstacle: the step led too far
_SMALLEST_PART = 1.0 / 64.0
_HARD = 1.0 / 4.0  # part of the way below which a failure is taken for the loss of the equilibrium, not for too long a step
# perf/contact_scenes.py, 28 robots that failed: 60 damped passes left 110 steps unsolved, 150 left 79, 400 left 74 at 3.4 times the cost
_MOST_DAMPED, _DAMPED_TRIES = 150, 10
_MOST_REFUSED = 12  # damped passes that were taken back
_WANDERS = 1e-2  # of the length: a robot that moves by less goes around a place where it may come to rest
_UNSOLVED = 6  # passes in a row without forces that obey the law: the hold is lost, and plain passes do not bring it back
_CURVE = ("position", "rotation", "curvature", "arclength")  # what contact reads of the shapes before
_FEW = 64  # robots below which starting threads costs more than it saves


class Snapshot(NamedTuple):
    """What an `Engine` remembers."""

    touching: Touching
    clearance: Clearance
    before: Shape | None
    """Shapes at the last step."""
    tracked: Flags
    """(n_robots,) `before` holds where the robot was."""
    gap: Floats
    """(n_robots,) smallest to anything [m]."""
    poses: Floats
    """(1 or n_robots, n_obstacles, 7) world."""
    poses_before: Floats
    """The same at the last step."""
    at_last_step: tuple[Shape | None, Floats]
    """Shapes and obstacles before the last step."""


class Engine:
    """What contact remembers between steps, and how a step is done. Rows are robots' indices; arrays have the robot axis first."""

    def __init__(self, scene: ContactScene, rods: Rods, length: Floats, n_points: int, threads: int) -> None:
        n = len(rods.reach)
        self.scene, self.rods, self.length, self.threads = scene, rods, length, threads
        self.surfaces = pack(scene.obstacles)
        self.world = scene.world_of(n)
        self.poses_before = self.poses = scene.rest_poses()
        self.velocities: dict[int, Floats] = {}
        self.dt = 0.0
        self.at_last_step: tuple[Shape | None, Floats] = (None, self.poses)
        """Shape and obstacles before the last step."""
        self.touching = Touching(np.zeros(n, np.int64), np.zeros((n, scene.max_contacts, SLOT)))
        self.clearance = Clearance(np.full((n, n_points), -np.inf), np.zeros((n, n_points, 3)))
        self.before: Shape | None = None
        self.tracked, self.slides = np.zeros(n, bool), np.ones(n, bool)
        self.gap = np.full(n, np.inf)
        self.trouble = np.zeros((n, TROUBLE))
        """What kept each robot from rest in its last pass (kernels.touch)."""
        self.led = np.zeros(n, bool)
        """Robots that contact brought to the inputs of the last step."""
        self.given_arclength, self.given_force = np.zeros((1, 0)), np.zeros((1, 0, 3))
        """Point forces that the caller gave: (n_robots, m) [m] and (n_robots, m, 3) world [N]."""

    def move(self, poses: Floats, velocities: dict[int, Floats], dt: float) -> None:
        """`poses` (1 or n_robots, n_obstacles, 7) of the obstacles in this step, world. Those with a velocity, by index (1 or n_robots, 6)
        [m/s, rad/s], slip by it, the others by how far their pose has moved."""
        self.at_last_step = (self.before, self.poses_before)
        self.poses, self.velocities, self.dt = poses, velocities, dt
        self.clearance.distance[:] -= longest_move(self.poses_before, poses, self.surfaces.sphere)[:, None]

    def place_at_once(self, rows: Flags) -> None:
        """For these robots the obstacles have not come from anywhere: they are where they are."""
        if rows.any() and self.poses is not self.poses_before:
            shape = (len(rows), *self.poses.shape[1:])
            self.poses_before = np.where(rows[:, None, None], np.broadcast_to(self.poses, shape), np.broadcast_to(self.poses_before, shape))

    def forget(self, rows: Ints | Flags) -> None:
        """No contacts, no history."""
        self.touching.used[rows] = 0
        self.clearance.distance[rows] = -np.inf
        self.tracked[rows] = False

    def snapshot(self) -> Snapshot:
        """A copy of everything that a later step depends on; shapes are handed out once and not written again."""
        touching = Touching(self.touching.used.copy(), self.touching.slot.copy())
        clearance = Clearance(self.clearance.distance.copy(), self.clearance.position.copy())
        poses = self.poses, self.poses_before, self.at_last_step
        return Snapshot(touching, clearance, self.before, self.tracked.copy(), self.gap.copy(), *poses)

    def restore(self, snapshot: Snapshot) -> None:
        """Go back to a `snapshot` of this engine."""
        self.touching = Touching(snapshot.touching.used.copy(), snapshot.touching.slot.copy())
        self.clearance = Clearance(snapshot.clearance.distance.copy(), snapshot.clearance.position.copy())
        self.before, self.tracked, self.gap = snapshot.before, snapshot.tracked.copy(), snapshot.gap.copy()
        self.poses, self.poses_before, self.at_last_step = snapshot.poses, snapshot.poses_before, snapshot.at_last_step

    def in_worlds(self, rows: Ints) -> tuple[Ints, Ints]:
        """`rows` (n,) world by world, and (n_worlds + 1,) where in them each world begins, with the end at last."""
        ordered = rows[np.argsort(self.world[rows], kind="stable")]
        return ordered, np.append(np.flatnonzero(np.diff(self.world[ordered], prepend=-1)), len(ordered))

    @property
    def rods_touch(self) -> bool:
        """A rod may touch itself or another."""
        return self.scene.self_contact or self.scene.worlds is not None

    def pressed(self) -> Flags:
        """(n_robots,) in a world where some contact carries a force."""
        slots = np.arange(self.touching.slot.shape[1])
        force = (self.touching.slot[:, :, T_FORCE : T_FORCE + 3] != 0.0).any(2) & (slots < self.touching.used[:, None])
        return self.whole_worlds(force.any(1))

    def whole_worlds(self, some: Flags) -> Flags:
        """(n_robots,) all robots of the worlds of those that are marked."""
        if self.scene.worlds is None:
            return some
        worlds = np.zeros(self.world.max() + 1, bool)
        worlds[self.world[some]] = True
        return np.asarray(worlds[self.world])

    def touches(self, rows: Ints, shape: Shape) -> Flags:
        """(n_robots,) which of `rows`, free until now, overlap something in `shape` or have gone through it; with their worlds."""
        some = np.zeros(len(self.gap), bool)
        if not len(rows):
            return some
        parts = self._parts(len(rows))
        found, n_found = np.empty((len(rows), MOST_FOUND, CANDIDATE)), np.zeros(len(rows), np.int64)
        scratch = np.empty((parts, 4 * shape.arclength.shape[1] + 4 * STACK))
        body = look_serial if parts == 1 else look_parallel
        one = np.ones(1)
        scenery = self._scenery(shape, 1e-9, 0.0 * one, one)._replace(margin=0.0)
        body(rows, *scenery, self.clearance, self.gap, found, n_found, scratch)
        if self.rods_touch:
            ordered, worlds = self.in_worlds(rows)
            look_at_rods(worlds, ordered, scenery, self.touching, self.gap)
        some[rows] = (self.gap[rows] < 0.0) | (n_found < 0)
        return self.whole_worlds(some)

    def follow(
        self,
        rows: Ints,
        start: Ports | None,
        end: Ports,
        memory: Memory,
        shape: Shape,
        run: Pass,
        tolerance: float,
        passes: Ints,
        most: int,
    ) -> tuple[Flags, Floats]:
        """Lead the worlds of `rows` from the inputs `start`, where they are at rest, to `end`, or settle them there at once, in about
        `most` passes.

        (n_robots,) which arrived, and the part of the way that each came. Those that did not keep the last shape, boundary and
        contacts in which they were at rest.
        """
        n = len(self.gap)
        done, stride, arrived = np.zeros(n), np.ones(n), np.zeros(n, bool)
        x, count, slot = memory.x.copy(), self.touching.used.copy(), self.touching.slot.copy()
        way, begun, tries = rows, passes.copy(), np.zeros(n, np.int64)
        trouble = np.zeros_like(self.trouble)  # of the last try that failed
        moved = np.broadcast_to(longest_move(self.poses_before, self.poses, self.surfaces.sphere), n)
        aim = np.ones(n)
        while len(way):
            last, aim = aim, np.minimum(done + stride, 1.0)
            elsewhere = way[(aim != last)[way]]  # what was clear of the obstacles was so where they were in the try before
            self.clearance.distance[elsewhere] -= moved[elsewhere, None]
            ports = end if start is None or (aim[way] >= 1.0).all() else blended(start, end, aim)
            rest, unheld = self._settle(way, ports, memory, shape, run, self._scenery(shape, tolerance, done, aim), passes)
            wanders = (self.trouble[:, 0] == MOVES) & (self.trouble[:, 3] < _WANDERS * self.rods.reach)
            given_up = (stride <= _HARD) | unheld | self.whole_worlds(wanders)
            hard = way[(~rest & given_up & (tries < _DAMPED_TRIES))[way]]
            if len(hard):  # no equilibrium near: let it go to the next one, downhill
                tries[hard] += 1
                memory.x[hard], self.touching.used[hard], self.touching.slot[hard] = x[hard], count[hard], slot[hard]
                rest |= self._descend(hard, ports, memory, shape, run, self._scenery(shape, tolerance, done, aim), passes, tries)
            good, bad = way[rest[way]], way[~rest[way]]
            trouble[bad] = self.trouble[bad]
            done[good] = aim[good]
            arrived[good] = done[good] >= 1.0
            between_steps = good[~arrived[good]]
            if len(between_steps):
                self.accept(between_steps, shape, on_the_way=True)
            x[good], count[good], slot[good] = memory.x[good], self.touching.used[good], self.touching.slot[good]
            memory.x[bad], self.touching.used[bad], self.touching.slot[bad] = x[bad], count[bad], slot[bad]
            stride[good] *= 2.0
            stride[bad] *= 0.5
            if start is None:
                break
            way = way[~arrived[way] & (stride[way] >= _SMALLEST_PART) & (passes[way] - begun[way] < most)]
        self.trouble[rows] = trouble[rows]
        short = rows[~arrived[rows]]
        self.clearance.distance[short] -= moved[short, None]
        lost = rows[~arrived[rows] & self.tracked[rows]]
        if len(lost) and self.before is not None:
            for now, last in zip(shape, self.before, strict=True):
                now[lost] = last[lost]
        return arrived, done

    def accept(self, rows: Ints, shape: Shape, on_the_way: bool = False) -> None:
        """These robots are at rest in `shape`: from there they slip and move. `on_the_way`: it will be written to again."""
        if len(rows) == len(self.gap) and not on_the_way:
            self.before = shape
        else:
            self.before = Shape(*(np.array(a) for a in (shape if self.before is None else self.before)))
            for last, now in zip(self.before, shape, strict=True):
                last[rows] = now[rows]
        self.tracked[rows] = True

    def end_step(self, done: Floats) -> None:
        """The obstacles are where they were to go; for a robot that came only the part `done` (n_robots,) of the way, where it met them."""
        self.poses_before = self.poses if (done >= 1.0).all() else between(self.poses_before, self.poses, done)

    def held(self, rows: Ints, ports: Ports, n_x: int) -> tuple[Ports, Probes]:
        """The present contacts of these robots as loads of a pass, and a probe at the tip that carries none."""
        most = int(self.touching.used[rows].max(initial=0))
        probes = empty_probes(len(rows), most + 1, n_x)
        ports = self._arranged(rows, ports, probes)
        probes.node[:, -1], probes.force[:, -1], probes.arm[:, -1] = self.clearance.distance.shape[1] - 1, 0.0, 0.0
        return ports, probes

    def why(self, i: int, done: float) -> str:
        """What stopped robot i, which came the part `done` of its step."""
        if self.trouble[i, 0] == NOTHING:
            if self.gap[i] < 0.0:
                return f"contact: the rod overlaps an obstacle by {-self.gap[i]:.3g} m, and no way out of it was found."
            return "contact: neither the rod's rest shape nor these inputs could be solved."
        return sentence(self.trouble[i], self.scene, self.rods.n_steps, self.length[i if len(self.length) > 1 else 0], done)

    def contacts(self, shape: Shape, ok: Flags) -> Contacts:
        """What touches what now."""
        n, n_obstacles = len(self.gap), len(self.surfaces.kind)
        slot = self.touching.slot
        live = (np.arange(slot.shape[1]) < self.touching.used[:, None]) & ok[:, None]
        live &= (slot[:, :, T_FORCE : T_FORCE + 3] != 0.0).any(2) | (slot[:, :, T_GAP] < TOUCHES)
        count = np.asarray(live.sum(1))
        width = int(count.max(initial=0))
        order = np.argsort(~live, axis=1, kind="stable")[:, :width]
        kept = np.take_along_axis(slot, order[:, :, None], axis=1)
        kept[np.arange(width) >= count[:, None]] = np.nan
        obstacle, normal, force, s = kept[:, :, T_OBSTACLE], kept[:, :, T_N : T_N + 3], kept[:, :, T_FORCE : T_FORCE + 3], kept[:, :, T_S]
        nodes = np.abs(np.where(np.isfinite(s), s, 0.0)[:, :, None] - shape.arclength[:, None, :])
        at = np.where(np.isfinite(nodes), nodes, np.inf).argmin(2)  # every contact has a node of its own
        point = np.take_along_axis(shape.position, at[:, :, None], axis=1) - kept[:, :, T_RADIUS, None] * normal
        index = np.where(np.isfinite(obstacle), obstacle, -1).astype(np.int64)
        wrench = np.zeros((n, n_obstacles, 6))
        origin = np.broadcast_to(self.poses[:, :, :3], (n, n_obstacles, 3))
        for k in range(n_obstacles):
            on = np.where((index == k)[:, :, None], -force, 0.0)
            wrench[:, k, :3] = on.sum(1)
            wrench[:, k, 3:] = np.cross(np.where((index == k)[:, :, None], point - origin[:, None, k], 0.0), on).sum(1)
        gap = np.where(ok, self.gap, np.nan)
        return Contacts(
            names=self.scene.names, count=count, obstacle=index, point=point, normal=normal, gap=kept[:, :, T_GAP], force=force,
            arclength=s,
            wrench=wrench, clearance=gap, deep=ok & (self.gap < -np.maximum(self.rods.radius.min(1), 1e-6)),
            tip_arclength=shape.arclength[:, -1],
        )  # fmt: skip

    def _settle(
        self, rows: Ints, ports: Ports, memory: Memory, shape: Shape, run: Pass, scenery: Scenery, passes: Ints
    ) -> tuple[Flags, Flags]:
        """Pass and law in turn on these inputs; (n_robots,) which came to rest, and which were given up as no forces hold them."""
        rest = np.zeros(len(self.gap), bool)
        unsolved, inside = (np.zeros(len(rest), np.int64) for _ in range(2))
        progress, still = Progress(len(rest)), rows
        for count in range(_LONGEST * _MOST_PASSES):
            status = self._iterate(still, ports, memory, shape, run, scenery)
            passes[still] += 1
            rest[still[status == AT_REST]] = True
            unsolved[still] = np.where(self.trouble[still, 0] == UNSOLVED, unsolved[still] + 1, 0)
            deep = self.tracked[still] & (self.gap[still] < -self.rods.radius[still].max(1) - _NEARLY * self.rods.reach[still])
            inside[still] = np.where(deep, inside[still] + 1, 0)
            hopeless = (inside >= _MOST_INSIDE) | (unsolved >= _UNSOLVED)
            progress.note(still, self.trouble[still, 4])
            if count >= _MOST_PASSES - 1:  # go on with what comes closer to rest
                hopeless |= progress.idle >= _IDLE
            still = still[(status != AT_REST) & (status != LOST) & ~self.whole_worlds(hopeless)[still]]
            if not len(still):
                break
        self._count_contacts(rows[~rest[rows]], ports)
        return rest, unsolved >= _UNSOLVED

    def _descend(
        self, rows: Ints, ports: Ports, memory: Memory, shape: Shape, run: Pass, scenery: Scenery, passes: Ints, tries: Ints
    ) -> Flags:
        """The same where no equilibrium is near, damped: down in energy to one, in passes that go through nothing.

        (n_robots,) which came to rest. A pass that goes through something, or finds no forces, is taken back. `tries`
        (n_robots,) counts this one.
        """
        n = len(self.gap)
        rest, still = np.zeros(n, bool), rows
        progress, damping = Progress(n), Damping(scenery.damping, rows, tries)
        frames = np.broadcast_to(scenery.frames, (n, *scenery.frames.shape[1:]))
        frames_before = _copy_of(rows, np.broadcast_to(scenery.frames_before, frames.shape))
        before = scenery.before._replace(**{name: _copy_of(rows, getattr(scenery.before, name)) for name in _CURVE})
        scenery = scenery._replace(before=before, frames_before=frames_before)
        x, used, slot = (_copy_of(rows, a) for a in (memory.x, *self.touching))
        for count in range(_LONGEST * _MOST_DAMPED):
            here = memory.x[still].copy(), self.touching.used[still].copy(), self.touching.slot[still].copy()
            status = self._iterate(still, ports, memory, shape, run, scenery)
            passes[still] += 1
            rest[still[status == AT_REST]] = True
            away, on = still[status == BACK], still[status != BACK]
            memory.x[away], self.touching.used[away], self.touching.slot[away] = x[away], used[away], slot[away]
            x[on], used[on], slot[on] = (a[status != BACK] for a in here)
            for name in _CURVE:
                getattr(before, name)[on] = getattr(shape, name)[on]
            frames_before[on] = frames[on]
            progress.note(on, self.trouble[on, 4])
            damping.note(on, self.trouble[on, 4])
            damping.refuse(away)
            hopeless = damping.refused >= _MOST_REFUSED
            hopeless[away] |= used[away] == 0  # what touches nothing is not damped
            if count >= _MOST_DAMPED - 1:
                hopeless |= progress.idle >= 2 * _IDLE
            still = still[(status != AT_REST) & (status != LOST) & ~self.whole_worlds(hopeless)[still]]
            if not len(still):
                break
        self._count_contacts(rows[~rest[rows]], ports)
        return rest

    def _count_contacts(self, rows: Ints, ports: Ports) -> None:
        """Say of robots that stay inside of something whether they lack contacts, or nodes to put them on."""
        for i in rows[self.trouble[rows, 0] == INSIDE]:
            ends = np.cumsum(self.length[i if len(self.length) > 1 else 0] + ports.extension[i if len(ports.extension) > 1 else 0])
            used = self.touching.slot[i, : self.touching.used[i], T_S]
            here = np.searchsorted(ends[:-1], self.trouble[i, 2], side="right")
            if (np.searchsorted(ends[:-1], used, side="right") == here).sum() >= self.rods.n_steps - 1:
                self.trouble[i, 0] = NO_NODE_LEFT
            elif len(used) >= self.touching.slot.shape[1]:
                self.trouble[i, 0] = NO_CONTACT_LEFT

    def _iterate(self, rows: Ints, ports: Ports, memory: Memory, shape: Shape, run: Pass, scenery: Scenery) -> Ints:
        """One pass and one round of the law for the worlds of `rows`; their status. Worlds with as many contacts go together."""
        status = np.zeros(len(rows), np.int64)
        most = np.zeros(self.world.max() + 1, np.int64)
        np.maximum.at(most, self.world[rows], self.touching.used[rows])
        slots = np.minimum(2 ** np.ceil(np.log2(np.maximum(most[self.world[rows]], 1))).astype(np.int64), self.scene.max_contacts)
        for n_slots in np.unique(slots):
            members = np.flatnonzero(slots == n_slots)
            members = members[np.argsort(self.world[rows[members]], kind="stable")]
            starts = np.flatnonzero(np.diff(self.world[rows[members]], prepend=-1))
            cuts = np.unique(np.searchsorted(starts, np.arange(_BLOCK, len(members), _BLOCK)))
            for block in np.split(members, starts[cuts[cuts < len(starts)]]):
                status[block] = self._iterate_block(rows[block], int(n_slots), ports, memory, shape, run, scenery)
        return status

    def _iterate_block(self, rows: Ints, n_slots: int, ports: Ports, memory: Memory, shape: Shape, run: Pass, scenery: Scenery) -> Ints:
        n, n_x = len(rows), memory.x.shape[1]
        probes = empty_probes(n, n_slots, n_x)
        ports = self._arranged(rows, ports, probes)
        run(rows, ports, shape, probes)
        worlds = np.append(np.flatnonzero(np.diff(self.world[rows], prepend=-1)), n)
        status = np.zeros(n, np.int64)
        parts = self._parts(len(worlds) - 1)
        scratch = np.empty((parts, world_size(int(np.diff(worlds).max()), n_slots, self.touching.slot.shape[1], shape.arclength.shape[1])))
        body = iterate_serial if parts == 1 else iterate_parallel
        proposed, unknown = np.zeros((n, n_slots, 3)), np.zeros((n, n_x))
        used, slot = self.touching.used[rows], self.touching.slot[rows, :n_slots]
        homeless = (probes.node < 0) & (np.arange(n_slots) < used[:, None])
        held = self.touching, self.clearance, probes, memory, proposed, unknown
        body(worlds, rows, *scenery, *held, self.gap, self.trouble, status, scratch)
        if homeless.any():  # more contacts than nodes: what has no node has not been felt
            for r in np.flatnonzero(homeless.any(1)):
                q = homeless[r].argmax()
                self.trouble[rows[r], :4] = NO_NODE_LEFT, slot[r, q, T_OBSTACLE], slot[r, q, T_S], 0.0
                status[r] = LOST if status[r] == LOST else GOES_ON
        return status

    def _arranged(self, rows: Ints, ports: Ports, probes: Probes) -> Ports:
        """The ports with a node under every contact; fills the loads of the probes."""
        n_robots, n_steps = len(self.gap), self.rods.n_steps
        n_segments = self.rods.radius.shape[1]
        ends = np.cumsum(self.length + ports.extension, axis=1)
        starts = np.concatenate([np.zeros((len(ends), 1)), ends], axis=1)
        grid = np.empty((n_robots, n_segments, n_steps + 1))
        m = self.given_arclength.shape[1]
        node = np.zeros((n_robots, m), np.int64)
        given = np.broadcast_to(self.given_arclength, (n_robots, m))
        arrange(rows, self.touching, np.ascontiguousarray(given), starts, n_steps, grid, node, probes)
        if not m:
            return ports._replace(grid=grid)
        node_force = np.zeros((n_robots, n_segments * n_steps + 1, 3))
        force = np.broadcast_to(self.given_force, (n_robots, m, 3))
        for q in range(m):
            np.add.at(node_force, (rows, node[rows, q]), force[rows, q])
        return ports._replace(grid=grid, node_force=node_force)

    def _parts(self, n: int) -> int:
        return 1 if n <= _FEW else min(self.threads, n)

    def _scenery(self, shape: Shape, tolerance: float, done: Floats, aim: Floats) -> Scenery:
        """The obstacles at the part `aim` of their way, and at the part `done` that is behind."""
        if self.poses is self.poses_before and not self.velocities:
            frames = before = slip = frames_of(self.poses)
        else:
            poses, last = (between(self.poses_before, self.poses, part) for part in (aim, done))
            ago = last.repeat(max(len(poses), 1) // max(len(last), 1), axis=0) if self.velocities else last
            for k, velocity in self.velocities.items():
                slid = back_by(poses[:, k], velocity, self.dt * (aim - done))
                ago = ago.repeat(len(slid) // len(ago), axis=0)
                ago[:, k] = slid
            frames, before, slip = frames_of(poses), frames_of(last), frames_of(ago)
        history = shape if self.before is None else self.before
        return Scenery(
            self.rods,
            self.surfaces,
            frames,
            before,
            slip,
            shape,
            history,
            history,
            self.tracked,
            self.tracked & self.slides,
            tolerance,
            self.scene.watch,
            np.zeros(len(self.gap)),
        )


def _copy_of(rows: Ints, a: Any) -> Any:
    """A C-ordered array like `a` that holds these rows of it; the others are never read, nor written."""
    copy = np.empty(a.shape, a.dtype)
    copy[rows] = a[rows]
    return copy


def empty_probes(n_rows: int, n_probes: int, n_x: int) -> Probes:
    """Room for the contact points of a pass."""
    n_f = 3 * n_probes
    loads = np.zeros((n_rows, n_probes, 3)), np.zeros((n_rows, n_probes, 3))
    return Probes(np.full((n_rows, n_probes), -1), *loads, np.zeros((n_rows, n_f, 1 + n_f)), np.zeros((n_rows, n_x, 1 + n_f)))
