"""Random contact scenes beside a dense sampling: `python perf/contact_scenes.py --count 10000 --seed 1`.

Shipped robots with 6 to 40 integration steps a segment, tendons that move in small and in coarse steps, and
obstacles beside them or pushed into them. After every step the whole rod is sampled (`Simulator.shape`) and
compared with a signed distance that shares no code with fastrod: closed forms, or every triangle of a mesh. A
step that says ok and is deeper than 0.1 mm is silent.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numba import njit
from scipy.spatial.transform import Rotation

from cases import Array, arc_lengths
from fastrod import Robot, Simulator, load_robot, robot_names
from fastrod.contact import ContactScene, Obstacle, box, capsule, cylinder, mesh, sphere
from report import Row, Section, bench, note_progress, table

SILENT = 1e-4  # m, depth beyond which a step must not say ok
TOGETHER = 8  # scenes of one batch: one robot, one geometry, each its own poses and motion
N_STEPS = 10
# m between samples along a rod: between two the depth changes by less than 0.02 mm on a rod of 2 mm radius
_SAMPLE = 5e-4
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
    """Whether a closed mesh holds the point: solid angle of its triangles (Van Oosterom, Strackee 1983)."""
    a, b, c = (corners[:, k] - point for k in range(3))
    x, y, z = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    dots = (a * b).sum(1) * z + (b * c).sum(1) * x + (c * a).sum(1) * y
    angle = 2.0 * np.arctan2((a * np.cross(b, c)).sum(1), x * y * z + dots)
    return bool(angle.sum() > 2.0 * np.pi)


def distances(obstacle: Obstacle, pose: Array, points: Array) -> Array:
    """(n,) signed distance of world points (n, 3) to an obstacle at a pose (7,): negative inside [m]."""
    p = Rotation.from_quat(pose[[4, 5, 6, 3]]).inv().apply(points - pose[:3])
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


def _made(kind: str, rng: np.random.Generator, size: float) -> Any:
    """A mesh of trimesh.creation, about `size` [m] wide."""
    import trimesh

    make, r, n = trimesh.creation, rng.uniform, rng.integers
    if kind == "ball":
        return make.icosphere(subdivisions=int(n(1, 4)), radius=0.5 * size)
    if kind == "block":
        return make.box(extents=size * r(0.3, 1.0, 3))
    if kind == "bar":
        return make.cylinder(size * r(0.1, 0.4), size * r(0.5, 2.0), sections=int(n(8, 48)))
    if kind == "pill":
        return make.capsule(radius=size * r(0.15, 0.4), height=size * r(0.3, 1.0), count=[12, 12])
    if kind == "annulus":
        inner = size * r(0.2, 0.4)
        return make.annulus(inner, inner + size * r(0.05, 0.3), size * r(0.2, 0.8), sections=int(n(12, 40)))
    if kind == "torus":
        return make.torus(size * r(0.3, 0.5), size * r(0.08, 0.2), major_sections=20, minor_sections=10)
    if kind == "cone":
        return make.cone(radius=size * r(0.3, 0.6), height=size * r(0.4, 1.2), sections=16)
    if kind == "noisy sphere":
        solid = make.icosphere(subdivisions=2, radius=0.5 * size)
        solid.vertices *= 1.0 + 0.06 * r(-1.0, 1.0, (len(solid.vertices), 1))
        return solid
    return make.box(extents=size * np.array([r(0.02, 0.06), r(0.8, 2.0), r(0.8, 2.0)]))  # thin plate


MESHES = ("ball", "block", "bar", "pill", "annulus", "torus", "cone", "noisy sphere", "thin plate")
PRIMITIVES: dict[str, Callable[[Any, float], Obstacle]] = {
    "sphere": lambda r, size: sphere(size * r(0.2, 0.6), name="sphere"),
    "box": lambda r, size: box(size * r(0.2, 1.0, 3), name="box"),
    "cylinder": lambda r, size: cylinder(size * r(0.1, 0.4), size * r(0.3, 2.0), name="cylinder"),
    "capsule": lambda r, size: capsule(size * r(0.1, 0.4), size * r(0.3, 1.5), name="capsule"),
    "thin box": lambda r, size: box(size * r((0.01, 0.8, 0.8), (0.05, 2.0, 2.0)), name="thin box"),
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
    tendon_length: Array  # (N_STEPS + 1, n, n_tendons) [m]
    pose: Array  # (N_STEPS + 1, n, 7) world

    def sample(self, sim: Simulator) -> Array:
        """Points (n, m, 3) of each rod from where contact begins to its tip."""
        end, first = sim.state.arclength[:, -1], 1.5 * self.rod_radius
        known = np.isfinite(end)[:, None]
        fraction = np.linspace(0.0, 1.0, int(np.nanmax(end) / _SAMPLE) + 2)
        s = first + (np.where(known, end[:, None], 1.0) - first) * fraction
        return sim.shape(np.where(known, np.minimum(s, end[:, None]), 0.0)).position


def make_batch(seed: int, index: int, n: int = TOGETHER) -> Batch:
    """Batch `index` of a seed: a random robot and obstacle; each scene has its poses and its motion."""
    rng = np.random.default_rng((seed, index))
    robot = load_robot(robot_names()[int(rng.integers(len(robot_names())))])
    points, kind = int(rng.choice(_POINTS)), KINDS[int(rng.integers(len(KINDS)))]
    radius = float(rng.choice([0.002, 0.004, 0.012]))
    size = float(rng.uniform(0.02, 0.12)) if kind != "annulus" else float(rng.uniform(5.0, 12.0)) * radius
    solid = (
        PRIMITIVES[kind](rng.uniform, size) if kind in PRIMITIVES else mesh(_made(kind, rng, size), name=kind)
    )
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
    """Return where the obstacle is at each step: clear of the free rod at first, in its way at last; half
    of them stand still. None comes near the mounting, where nothing can give way."""
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
            rotation = rng.normal(size=4)
            rotation /= np.linalg.norm(rotation)
            inside = solid.name == "annulus" and rng.random() < 0.5  # the rod runs through it
            if inside:
                rotation = _along(free[0][1][i, at, :, 2])
            deep = rng.uniform(0.0, 0.08) * robot.length
            centre = (first if inside else last)[at]
            start, end = 0.0, deep if moves else 0.0
            if not inside:
                start, end = (
                    _away(solid, centre, out, rotation, nodes, radius + gap)
                    for nodes, gap in ((first, 2e-3), (last, -deep))
                )
                start, end = (start, end) if moves else (max(start, end),) * 2
            path = centre + (start + there[:, None] * (end - start)) * out
            ends = [np.concatenate([c, rotation]) for c in (path[0], path[-1])]
            clear = distances(solid, ends[0], first).min() > radius + 1e-3
            near = min(distances(solid, e, x[fixed]).min() for e, x in zip(ends, (first, last), strict=True))
            if clear and near > radius + 2e-3:
                break
        else:
            path = path + 10.0  # no place was found: this one stays free
        pose[:, i, :3], pose[:, i, 3:] = path, rotation
    return pose


def _along(z: Array) -> Array:
    """Quaternion that rotates the z axis to a unit vector."""
    q = np.array([1.0 + z[2], -z[1], z[0], 0.0])
    return np.asarray(q / np.linalg.norm(q)) if z[2] > -0.999 else np.array([0.0, 1.0, 0.0, 0.0])


def _away(solid: Obstacle, centre: Array, out: Array, rotation: Array, nodes: Array, wanted: float) -> float:
    """Distance along `out` at which the obstacle is `wanted` away from the nodes, coming from outside."""

    def clear(away: float) -> bool:
        return bool(distances(solid, np.concatenate([centre + away * out, rotation]), nodes).min() > wanted)

    near = far = 0.4
    while near > 0.0 and clear(near):
        far, near = near, near - 0.004
    for _ in range(20):
        middle = 0.5 * (near + far)
        near, far = (near, middle) if clear(middle) else (middle, far)
    return far


@dataclass
class Played:
    """Record of a batch; arrays (N_STEPS + 1, n) but for the time."""

    kind: str
    ok: Any
    touching: Any
    depth: Array  # of the sampled rod in the obstacle, negative where it is clear [m]; nan without a shape
    seconds: Array  # (N_STEPS + 1,) of the processor, one call
    passes: Any
    sentences: list[str] = field(default_factory=list)


def with_mass(robot: Robot) -> Robot:
    """A robot that can move: what has no mass gets one, no weight, and some damping; it begins where the
    scene is clear of it."""
    light = any(s.line_density == 0.0 for s in robot.segments)
    segments = (
        replace(s, line_density=s.line_density or 0.05, damping_time=s.damping_time or 5e-3)
        for s in robot.segments
    )
    return replace(robot, segments=tuple(segments), gravity=(0.0, 0.0, 0.0) if light else robot.gravity)


def play(batch: Batch, rows: list[int] | None = None, *, dt: float = 0.0, **options: Any) -> Played:
    """Step a batch, or some of its scenes, and sample every rod after every step; with `dt` [s] in
    motion."""
    some = list(range(batch.pose.shape[1])) if rows is None else rows
    n, name = len(some), batch.obstacle.name
    scene = ContactScene(obstacles=[batch.obstacle], rod_radius=batch.rod_radius, **options)
    robot, more = (with_mass(batch.robot), {"dt": dt, "dynamics": True}) if dt else (batch.robot, {})
    sim = Simulator(robot, n, points_per_segment=batch.points, threads=1, contact=scene, **more)
    ok, touching, passes, depth = (np.zeros((N_STEPS + 1, n), kind) for kind in (bool, bool, int, float))
    played = Played(batch.kind, ok, touching, depth * np.nan, np.zeros(N_STEPS + 1), passes)
    for k in range(N_STEPS + 1):
        begin = time.process_time()
        state = sim.step(batch.tendon_length[k][some], obstacle_pose={name: batch.pose[k][some]})
        played.seconds[k] = time.process_time() - begin
        assert state.contacts is not None
        ok[k], touching[k], passes[k] = state.ok, state.contacts.in_contact(), state.passes
        played.sentences += list(state.problems.values())
        for i, points in enumerate(batch.sample(sim)):
            if np.isfinite(points).all():
                near = distances(batch.obstacle, batch.pose[k][some[i]], points).min()
                played.depth[k, i] = batch.rod_radius - near
    return played


def row(kind: str, some: list[Played]) -> Row:
    ok, depth, touching = (
        np.concatenate([getattr(p, name).ravel() for p in some]) for name in ("ok", "depth", "touching")
    )
    return {
        "kind": kind,
        "scenes": sum(p.ok.shape[1] for p in some),
        "steps": len(ok),
        "touching": int(touching.sum()),
        "silent": int((ok & (depth > SILENT)).sum()),
        "deepest": 1e3 * float(np.nanmax(np.where(ok, depth, np.nan), initial=-1e3)),
        "not_ok": int((~ok).sum()),
        "share": float((~ok).mean()),
    }


def _dt(options: Any, index: int) -> float:
    """0 at rest; in motion 1 to 20 ms, another for each batch."""
    return (
        float(1e-3 * 20.0 ** np.random.default_rng((options.seed, index)).random()) if options.moving else 0.0
    )


def measure(options: Any) -> list[Section]:
    """The table by kind, and the sentences."""
    seed, count = options.seed, TOGETHER if options.quick else options.count
    play(make_batch(seed, options.first), dt=_dt(options, 0))  # compiled, and not timed
    every = list[Played]()
    said = Counter[str]()
    silent = list[str]()
    end = time.monotonic() + 60.0 * options.minutes
    taken, slowest, where = list[float](), 0.0, ""
    for index in range(options.first, options.first - (-count // TOGETHER)):
        if time.monotonic() > end:
            break
        note_progress(f"batch {index}")
        batch = make_batch(seed, index)
        played = play(batch, dt=_dt(options, index))
        every.append(played)
        said.update(re.sub(r"-?\d[\d.e+-]*", "#", sentence) for sentence in played.sentences)
        words = f"{batch.robot.name}, {batch.points} steps a segment, {batch.kind}"
        silent += [
            f"seed {seed} batch {index} scene {i} step {k}: {1e3 * played.depth[k, i]:.3f} mm, {words}"
            for k, i in np.argwhere(played.ok & (played.depth > SILENT))
        ]
        taken += list(played.seconds[1:])
        if taken and max(taken) > slowest:
            slowest, where = float(max(taken)), f"batch {index}, {words}"
        if not played.ok.all():
            note_progress(f"batch {index}: not ok {np.argwhere(~played.ok).tolist()}")
    kinds = {kind: [played for played in every if played.kind == kind] for kind in KINDS}
    return [
        table(
            "contact_scenes",
            f"Random contact scenes, seed {seed}",
            "kind obstacle | scenes:,d | steps:,d robot-~steps | touching:,d in~contact | silent:d"
            "| deepest:.4f deepest with~ok [mm] | not_ok:d not ok | share:.2% not ok",
            [row(kind, some) for kind, some in (*kinds.items(), ("all", every)) if some],
            f"A step of {TOGETHER} robots takes {1e3 * float(np.median(taken)):.2f} ms of the processor at "
            f"the median and {slowest:.2f} s at most ({where}).",
            *(f"{times} x {words}" for words, times in said.most_common(8)),
            *silent,
        )
    ]


main = bench(
    __doc__,
    measure,
    ("--count", 10_000, "scenes"),
    ("--moving", False, "rods with mass, in steps of 1 to 20 ms"),
    ("--seed", 1, "of all scenes"),
    ("--first", 0, "batch to begin with"),
    ("--minutes", np.inf, "stop after so long"),
)
