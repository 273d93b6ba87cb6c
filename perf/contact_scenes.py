"""Random contact scenes beside a dense sampling: `python perf/contact_scenes.py --count 10000 --seed 1`.

Shipped robots with 6 to 40 integration steps a segment, tendons that move in small and in coarse steps, and
obstacles beside them or pushed into them. After every step the whole rod is sampled (`Simulator.shape`) and
compared with a signed distance that shares no code with fastrod: closed forms, or every triangle of a mesh. A
step that says ok and is deeper than 0.1 mm is silent.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numba import njit

import report
from cases import Array, arc_lengths
from fastrod import Robot, Simulator, load_robot, robot_names
from fastrod.contact import ContactScene, Obstacle, box, capsule, cylinder, mesh, sphere
from report import Column, Row, Section

SILENT = 1e-4
"""Depth beyond which a step must not say ok [m]."""
TOGETHER = 8
"""Scenes of one batch: one robot, one geometry, each its own poses and motion."""
N_STEPS = 10
_SAMPLE = 5e-4
"""Distance of the samples along a rod [m]; between two the depth changes by less than 0.02 mm on a rod of 2
mm radius."""
_POINTS = (6, 8, 10, 12, 16, 20, 30, 40)


@njit()
def _mesh_distances(points, corners, out):  # type: ignore[no-untyped-def]
    """Unsigned distance of each point to the nearest triangle: its plane where the point is above it, else
    its three edges."""
    for i in range(len(points)):
        best = 1e300
        for t in range(len(corners)):
            inside, plane = True, 0.0
            a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
            nx = (b[1] - a[1]) * (c[2] - a[2]) - (b[2] - a[2]) * (c[1] - a[1])
            ny = (b[2] - a[2]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[2] - a[2])
            nz = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
            area = nx * nx + ny * ny + nz * nz
            plane = nx * (points[i, 0] - a[0]) + ny * (points[i, 1] - a[1]) + nz * (points[i, 2] - a[2])
            if plane * plane / area >= best:
                continue
            for e in range(3):
                p, q = corners[t, e], corners[t, (e + 1) % 3]
                ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
                vx, vy, vz = points[i, 0] - p[0], points[i, 1] - p[1], points[i, 2] - p[2]
                side = (ny * uz - nz * uy) * vx + (nz * ux - nx * uz) * vy + (nx * uy - ny * ux) * vz
                inside = inside and side >= 0.0
                f = min(max((ux * vx + uy * vy + uz * vz) / (ux * ux + uy * uy + uz * uz), 0.0), 1.0)
                best = min(best, (vx - f * ux) ** 2 + (vy - f * uy) ** 2 + (vz - f * uz) ** 2)
            if inside:
                best = min(best, plane * plane / area)
        out[i] = np.sqrt(best)


def _encloses(point: Array, corners: Array) -> bool:
    """Whether a closed mesh holds the point, by the solid angle of its triangles (Van Oosterom and Strackee
    1983)."""
    a, b, c = (corners[:, k] - point for k in range(3))
    x, y, z = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    dots = (a * b).sum(1) * z + (b * c).sum(1) * x + (c * a).sum(1) * y
    angle = 2.0 * np.arctan2((a * np.cross(b, c)).sum(1), x * y * z + dots)
    return bool(angle.sum() > 2.0 * np.pi)


def turned(quaternion: Array) -> Array:
    """(..., 3, 3) world_from_body of (..., 4) w x y z."""
    w, x, y, z = np.moveaxis(quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def distances(obstacle: Obstacle, pose: Array, points: Array) -> Array:
    """(n,) signed distance of world points (n, 3) to an obstacle at a pose (7,): negative inside [m]."""
    p = (points - pose[:3]) @ turned(pose[3:])
    a, b, c = obstacle.size
    if obstacle.shape == "sphere":
        return np.asarray(np.linalg.norm(p, axis=1) - a)
    if obstacle.shape == "capsule":
        p[:, 2] -= np.clip(p[:, 2], -0.5 * b, 0.5 * b)
        return np.asarray(np.linalg.norm(p, axis=1) - a)
    if obstacle.shape in ("box", "cylinder"):
        over = np.abs(p) - 0.5 * np.array([a, b, c])
        if obstacle.shape == "cylinder":
            over = np.stack([np.hypot(p[:, 0], p[:, 1]) - a, np.abs(p[:, 2]) - 0.5 * b], axis=1)
        return np.asarray(np.linalg.norm(np.maximum(over, 0.0), axis=1) + np.minimum(over.max(1), 0.0))
    corners, d = np.ascontiguousarray(obstacle.vertices[obstacle.faces]), np.empty(len(p))
    _mesh_distances(np.ascontiguousarray(p), corners, d)
    # the sign changes only where the distance passes through zero: one point of each stretch that keeps away
    # from it decides
    apart = np.flatnonzero((d[1:] + d[:-1]) < 1.01 * np.linalg.norm(np.diff(p, axis=0), axis=1)) + 1
    for first, last in zip([0, *apart], [*apart, len(d)], strict=True):
        if _encloses(p[first + d[first:last].argmax()], corners):
            d[first:last] *= -1.0
    return d


def _noisy(rng: np.random.Generator, size: float) -> Any:
    import trimesh

    solid = trimesh.creation.icosphere(subdivisions=2, radius=size)
    solid.vertices *= 1.0 + 0.06 * rng.uniform(-1.0, 1.0, (len(solid.vertices), 1))
    return solid


def _made(kind: str, rng: np.random.Generator, size: float) -> Any:
    """A mesh of trimesh.creation, about `size` [m] wide."""
    import trimesh

    make, r = trimesh.creation, rng.uniform
    if kind == "ball":
        return make.icosphere(subdivisions=int(rng.integers(1, 4)), radius=0.5 * size)
    if kind == "block":
        return make.box(extents=size * r(0.3, 1.0, 3))
    if kind == "bar":
        return make.cylinder(
            radius=size * r(0.1, 0.4), height=size * r(0.5, 2.0), sections=int(rng.integers(8, 48))
        )
    if kind == "pill":
        return make.capsule(radius=size * r(0.15, 0.4), height=size * r(0.3, 1.0), count=[12, 12])
    if kind == "annulus":
        inner = size * r(0.2, 0.4)
        return make.annulus(
            inner, inner + size * r(0.05, 0.3), size * r(0.2, 0.8), sections=int(rng.integers(12, 40))
        )
    if kind == "torus":
        return make.torus(size * r(0.3, 0.5), size * r(0.08, 0.2), major_sections=20, minor_sections=10)
    if kind == "cone":
        return make.cone(radius=size * r(0.3, 0.6), height=size * r(0.4, 1.2), sections=16)
    if kind == "noisy sphere":
        return _noisy(rng, 0.5 * size)
    return make.box(extents=size * np.array([r(0.02, 0.06), r(0.8, 2.0), r(0.8, 2.0)]))  # thin plate


MESHES = ("ball", "block", "bar", "pill", "annulus", "torus", "cone", "noisy sphere", "thin plate")
PRIMITIVES: dict[str, Callable[[np.random.Generator, float], Obstacle]] = {
    "sphere": lambda rng, size: sphere(size * rng.uniform(0.2, 0.6), name="sphere"),
    "box": lambda rng, size: box(size * rng.uniform(0.2, 1.0, 3), name="box"),
    "cylinder": lambda rng, size: cylinder(
        size * rng.uniform(0.1, 0.4), size * rng.uniform(0.3, 2.0), name="cylinder"
    ),
    "capsule": lambda rng, size: capsule(
        size * rng.uniform(0.1, 0.4), size * rng.uniform(0.3, 1.5), name="capsule"
    ),
    "thin box": lambda rng, size: box(
        size * rng.uniform((0.01, 0.8, 0.8), (0.05, 2.0, 2.0)), name="thin box"
    ),
}
KINDS = (*MESHES, *PRIMITIVES)


@dataclass(frozen=True)
class Batch:
    """Scenes that are stepped together."""

    robot: Robot
    points: int
    kind: str
    obstacle: Obstacle
    rod_radius: float
    tendon_length: Array
    """(N_STEPS + 1, n, n_tendons) [m]."""
    pose: Array
    """(N_STEPS + 1, n, 7) world."""

    def scene(self, **options: Any) -> ContactScene:
        return ContactScene(obstacles=[self.obstacle], rod_radius=self.rod_radius, **options)

    def sample(self, sim: Simulator) -> tuple[Array, Array]:
        """Arclengths (n, m) of the samples from where contact begins, and their points (n, m, 3)."""
        end = sim.state.arclength[:, -1]
        share = np.linspace(0.0, 1.0, int(np.nanmax(end) / _SAMPLE) + 2)
        first = 1.5 * self.rod_radius
        s = first + (np.where(np.isfinite(end), end, 1.0)[:, None] - first) * share
        return s, sim.shape(np.where(np.isfinite(end)[:, None], np.minimum(s, end[:, None]), 0.0)).position


def make_batch(seed: int, index: int, n: int = TOGETHER) -> Batch:
    """Batch `index` of a seed: a robot and an obstacle drawn at random; each scene has its poses and its
    motion."""
    rng = np.random.default_rng((seed, index))
    robot = load_robot(robot_names()[int(rng.integers(len(robot_names())))])
    points, kind = int(rng.choice(_POINTS)), KINDS[int(rng.integers(len(KINDS)))]
    radius = float(rng.choice([0.002, 0.004, 0.012]))
    size = float(rng.uniform(0.02, 0.12)) if kind != "annulus" else float(rng.uniform(5.0, 12.0)) * radius
    solid = PRIMITIVES[kind](rng, size) if kind in PRIMITIVES else mesh(_made(kind, rng, size), name=kind)
    n_moves = int(rng.choice([3, N_STEPS]))  # coarse steps, then rest; or small ones
    most = 1.0 if robot.n_segments == 1 else 0.6 if robot.n_segments == 2 else 0.35
    bend = rng.uniform(-most, most, (2, n, robot.n_segments, 2))
    there = np.minimum(np.arange(N_STEPS + 1) / n_moves, 1.0)
    bends = bend[0] + there[:, None, None, None] * (bend[1] - bend[0])
    lengths = np.stack([arc_lengths(robot, b) for b in bends])
    pose = _poses(robot, solid, radius, lengths[[0, -1]], there, rng)
    return Batch(robot, points, kind, solid, radius, lengths, pose)


def _poses(
    robot: Robot, solid: Obstacle, radius: float, lengths: Array, there: Array, rng: np.random.Generator
) -> Array:
    """Where the obstacle is at each step: clear of the free rod at first, in its way at last; half of them
    stand still. None comes near the mounting, where nothing can give way."""
    n, free = lengths.shape[1], []
    sim = Simulator(robot, n, points_per_segment=20)
    for length in lengths:
        state = sim.settle(length)
        free.append((state.position, state.rotation, state.arclength))
    pose = np.zeros((len(there), n, 7))
    for i in range(n):
        first, last = free[0][0][i], free[1][0][i]
        fixed = free[0][2][i] < 1.5 * radius + 0.15 * robot.length
        moves = bool(rng.random() < 0.5) or robot.n_tendons == 0
        for _ in range(40):
            at = int(rng.integers(int(0.4 * len(last)), len(last)))
            out = np.cross(free[1][1][i, at, :, 2], rng.normal(size=3))
            out /= np.linalg.norm(out)
            turn = rng.normal(size=4)
            turn /= np.linalg.norm(turn)
            inside = solid.name == "annulus" and rng.random() < 0.5  # the rod runs through it
            if inside:
                turn = _along(free[0][1][i, at, :, 2])
            deep = rng.uniform(0.0, 0.08) * robot.length
            centre = (first if inside else last)[at]
            start, end = 0.0, deep if moves else 0.0
            if not inside:
                start, end = (
                    _away(solid, centre, out, turn, nodes, radius + gap)
                    for nodes, gap in ((first, 2e-3), (last, -deep))
                )
                start, end = (start, end) if moves else (max(start, end),) * 2
            way = centre + (start + there[:, None] * (end - start)) * out
            ends = [np.concatenate([c, turn]) for c in (way[0], way[-1])]
            clear = distances(solid, ends[0], first).min() > radius + 1e-3
            mounted = (
                min(
                    distances(solid, e, nodes[fixed]).min()
                    for e, nodes in zip(ends, (first, last), strict=True)
                )
                > radius + 2e-3
            )
            if clear and mounted:
                break
        else:
            way = way + 10.0  # no place was found: this one stays free
        pose[:, i, :3], pose[:, i, 3:] = way, turn
    return pose


def _along(z: Array) -> Array:
    """Quaternion that turns the z axis to a unit vector."""
    q = np.array([1.0 + z[2], -z[1], z[0], 0.0])
    return np.asarray(q / np.linalg.norm(q)) if z[2] > -0.999 else np.array([0.0, 1.0, 0.0, 0.0])


def _away(solid: Obstacle, centre: Array, out: Array, turn: Array, nodes: Array, wanted: float) -> float:
    """How far from `centre` along `out` the obstacle is `wanted` away from these nodes, coming from
    outside."""

    def clear(way: float) -> bool:
        return bool(distances(solid, np.concatenate([centre + way * out, turn]), nodes).min() > wanted)

    near = far = 0.4
    while near > 0.0 and clear(near):
        far, near = near, near - 0.004
    for _ in range(20):
        middle = 0.5 * (near + far)
        near, far = (near, middle) if clear(middle) else (middle, far)
    return far


@dataclass
class Played:
    """What became of a batch."""

    kind: str
    ok: Any
    """(N_STEPS + 1, n)"""
    touching: Any
    """(N_STEPS + 1, n)"""
    depth: Array
    """(N_STEPS + 1, n) of the sampled rod in the obstacle, negative where it is clear [m]; nan where there is
    no shape."""
    seconds: Array
    """(N_STEPS + 1,) of the processor, one call."""
    passes: Any
    sentences: list[str] = field(default_factory=list)


def play(batch: Batch, rows: list[int] | None = None, **options: Any) -> Played:
    """Step a batch, or some of its scenes, and sample every rod after every step."""
    some = list(range(batch.pose.shape[1])) if rows is None else rows
    n, name = len(some), batch.obstacle.name
    sim = Simulator(
        batch.robot, n, points_per_segment=batch.points, threads=1, contact=batch.scene(**options)
    )
    ok, touching, passes = (np.zeros((N_STEPS + 1, n), kind) for kind in (bool, bool, int))
    played = Played(
        batch.kind, ok, touching, np.full((N_STEPS + 1, n), np.nan), np.zeros(N_STEPS + 1), passes
    )
    for k in range(N_STEPS + 1):
        begin = time.process_time()
        state = sim.step(batch.tendon_length[k][some], obstacle_pose={name: batch.pose[k][some]})
        played.seconds[k] = time.process_time() - begin
        assert state.contacts is not None
        played.ok[k], played.touching[k], played.passes[k] = (
            state.ok,
            state.contacts.in_contact(),
            state.passes,
        )
        played.sentences += list(state.problems.values())
        _, points = batch.sample(sim)
        for i in range(n):
            if np.isfinite(points[i]).all():
                played.depth[k, i] = (
                    batch.rod_radius - distances(batch.obstacle, batch.pose[k][some[i]], points[i]).min()
                )
    return played


def measure(
    count: int, seed: int, first: int = 0, minutes: float = np.inf
) -> Iterator[tuple[int, Batch, Played]]:
    """Batches from index `first` on, until `count` scenes are played or the time is over."""
    end = time.monotonic() + 60.0 * minutes
    for index in range(first, first + -(-count // TOGETHER)):
        if time.monotonic() > end:
            return
        report.note_progress(f"batch {index}")
        batch = make_batch(seed, index)
        yield index, batch, play(batch)


def sections(count: int, seed: int, first: int, minutes: float) -> list[Section]:
    """The table by kind, and the sentences."""
    play(make_batch(seed, first))  # compiled, and not timed
    found: dict[str, list[Played]] = {kind: [] for kind in KINDS}
    said: Counter[str] = Counter()
    silent: list[str] = []
    slowest, where = 0.0, ""
    taken: list[float] = []
    for index, batch, played in measure(count, seed, first, minutes):
        found[batch.kind].append(played)
        said.update(re.sub(r"-?\d[\d.e+-]*", "#", sentence) for sentence in played.sentences)
        for k, i in np.argwhere(played.ok & (played.depth > SILENT)):
            silent.append(
                f"seed {seed} batch {index} scene {i} step {k}: {1e3 * played.depth[k, i]:.3f} "
                f"mm, {batch.robot.name}, "
                f"{batch.points} steps a segment, {batch.kind}"
            )
        each = played.seconds[1:]
        taken += list(each)
        if each.max() > slowest:
            slowest, where = (
                float(each.max()),
                (f"batch {index}, {batch.robot.name}, {batch.points} steps a segment, {batch.kind}"),
            )
        if not played.ok.all() and sys.stderr.isatty():
            print(f"batch {index}: not ok {np.argwhere(~played.ok).tolist()}", file=sys.stderr)
    rows: list[Row] = []
    every = [p for played in found.values() for p in played]
    for kind, some in [*found.items(), ("all", every)]:
        if not some:
            continue
        ok, depth = (np.concatenate([getattr(p, name).ravel() for p in some]) for name in ("ok", "depth"))
        touching = np.concatenate([p.touching.ravel() for p in some])
        rows.append(
            {
                "kind": kind,
                "scenes": sum(p.ok.shape[1] for p in some),
                "steps": len(ok),
                "touching": int(touching.sum()),
                "silent": int((ok & (depth > SILENT)).sum()),
                "deepest": 1e3 * float(np.nanmax(np.where(ok, depth, np.nan), initial=-1e3)),
                "not_ok": int((~ok).sum()),
                "share": float((~ok).mean()),
            }
        )
    columns = [
        Column("kind", "obstacle"),
        Column("scenes", "scenes", ",d"),
        Column("steps", "robot-\nsteps", ",d"),
        Column("touching", "in\ncontact", ",d"),
        Column("silent", "silent", "d"),
        Column("deepest", "deepest with\nok [mm]", ".4f"),
        Column("not_ok", "not ok", "d"),
        Column("share", "not ok", ".2%"),
    ]
    notes = [
        f"A step of {TOGETHER} robots takes {1e3 * float(np.median(taken)):.2f} ms of the processor at the "
        "median and "
        f"{slowest:.2f} s at most ({where}).",
        *(f"{times} x {words}" for words, times in said.most_common(8)),
        *silent,
    ]
    return [Section("contact_scenes", f"Random contact scenes, seed {seed}", columns, rows, notes)]


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10_000, help="scenes")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="batch to begin with")
    parser.add_argument("--minutes", type=float, default=np.inf, help="stop after so long")
    return report.command(
        parser, argv, lambda o: sections(TOGETHER if o.quick else o.count, o.seed, o.first, o.minutes)
    )


if __name__ == "__main__":
    raise SystemExit(main())
