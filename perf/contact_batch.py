"""Robots beside, along and against a mesh: inputs and times of the contact benchmark, and FCL's answer."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from cases import Array, arc_lengths
from fastrod import Simulator, State, load_robot
from fastrod.contact import ContactScene, mesh
from fastrod.contact.geometry import Obstacle
from report import Measurement, best

ROBOT = "five_segment_reacher"
POINTS = 6  # intervals of a segment: 30 of a robot, each one sample of contact
RADIUS = 0.12  # m, of the ball that the meshes approximate
N_CYCLE = 12  # steps in which the tendons swing once around; the timed steps are one cycle
SWING = 1.5e-3  # rad of bend that each segment gains and loses in a cycle: the tip goes about 1 mm a step
FAR, GRAZING, PRESSED = 0.4, 2e-3, -3e-3
"""Smallest gap between mesh and free rod over a cycle; negative: the overlap that the mesh prevents [m]."""
_APPROACH, _AWAY = 8, 0.03  # steps in which the mesh comes to its place, m that it begins farther off
_WARM = 1  # steps before the timed ones


@dataclass(frozen=True)
class Batch:
    """Robots that move, and a place for a mesh beside each."""

    tendon_length: Array  # (N_CYCLE, n_robots, n_tendons) of each step of a cycle [m]
    node: Array  # (N_CYCLE, n_robots, n_points, 3) of the free robots [m]
    beside: Array  # (n_robots, 3) point on the rod that the mesh comes nearest to [m]
    out: Array  # (n_robots, 3) unit, from there toward the centre of the mesh
    rod_radius: float

    @property
    def travel(self) -> float:
        """Median displacement of a free robot's tip in a step [m]."""
        tip = self.node[:, :, -1]
        return float(np.median(np.linalg.norm(np.roll(tip, -1, axis=0) - tip, axis=-1)))


def make_batch(n: int) -> Batch:
    """`n` reachers, each bent differently, swinging their tips in a circle; seeded."""
    robot, rng = load_robot(ROBOT), np.random.default_rng(3)
    rest = rng.uniform(-0.25, 0.25, (n, robot.n_segments, 2))
    phase = rng.uniform(0.0, 2.0 * np.pi, n)
    sim = Simulator(robot, n, points_per_segment=POINTS)
    lengths, nodes = [], []
    for k in range(N_CYCLE):
        angle = phase + 2.0 * np.pi * k / N_CYCLE
        swing = SWING * np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None]
        lengths.append(arc_lengths(robot, rest + swing))
        state = sim.settle(lengths[-1]) if k == 0 else sim.step(lengths[-1])
        nodes.append(state.position)
    # the end of the fourth segment
    beside, tangent = state.position[:, 4 * POINTS], state.rotation[:, 4 * POINTS, :, 2]
    out = np.cross(tangent, rng.normal(size=(n, 3)))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    return Batch(np.stack(lengths), np.stack(nodes), beside, out, robot.segments[0].body_radius)


def make_mesh(subdivisions: int) -> Obstacle:
    """A ball of 20 x 4^subdivisions faces."""
    import trimesh

    solid = trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS)
    return mesh((solid.vertices, solid.faces), name="ball")


def places(batch: Batch, gap: float) -> Array:
    """(n_robots, 7) poses of the mesh whose ball leaves `gap` to the free rods of a cycle; by bisection."""
    near, far = np.full(len(batch.out), -0.1), np.full(len(batch.out), 0.5 + gap)
    wanted = gap + batch.rod_radius + RADIUS
    for _ in range(50):
        middle = 0.5 * (near + far)
        centre = batch.beside + (RADIUS + middle)[:, None] * batch.out
        clear = np.linalg.norm(batch.node - centre[:, None], axis=-1).min(axis=(0, 2)) > wanted
        near, far = np.where(clear, near, middle), np.where(clear, middle, far)
    at = batch.beside + (RADIUS + far)[:, None] * batch.out
    return np.column_stack([at, np.broadcast_to((1.0, 0.0, 0.0, 0.0), (len(at), 4))])


@dataclass
class Timed:
    """One batch in one state."""

    n_faces: int
    step_s: float  # mean of the timed steps, each the best of its rounds
    touching: float  # fraction of robot-steps in contact
    contacts: float  # mean of a robot-step
    passes: float
    most_passes: int
    gap: float  # m, median over robots of the smallest after the last step; a lower bound far off
    not_ok: int  # robot-steps, the approach included
    sim: Simulator
    last: State
    earlier: tuple[Any, ...]  # shape and clearance that the last step began from


def run(
    batch: Batch, obstacle: Obstacle | None, gap: float, threads: int, budget: float, by: Any = "bvh"
) -> Timed:
    """Bring the mesh to the robots, let them swing a little, then time steps: one cycle after the other
    while the `budget` of seconds lasts, three steps at least."""
    n, length = batch.tendon_length.shape[1], batch.tendon_length
    scene = None if obstacle is None else ContactScene(obstacles=[obstacle], collision=by)
    sim = Simulator(load_robot(ROBOT), n, points_per_segment=POINTS, threads=threads, contact=scene)
    if obstacle is None:
        states = [sim.settle(length[0])]
    else:
        pose = places(batch, gap)
        away = np.zeros_like(pose)
        away[:, :3] = _AWAY * batch.out
        states = [sim.settle(length[0], obstacle_pose={"ball": pose + away})]
        for k in range(1, _APPROACH + 1):
            states.append(sim.step(length[0], obstacle_pose={"ball": pose + (1.0 - k / _APPROACH) * away}))
    states += [sim.step(length[k]) for k in range(1, _WARM + 1)]
    not_ok = sum(int((~state.ok).sum()) for state in states)
    taken, passes = [Measurement() for _ in range(N_CYCLE)], []
    touching, contacts, k, earlier = [], [], _WARM, ()
    while sum(sum(each.times) for each in taken) < budget or k < _WARM + 3:
        k += 1
        engine = sim._engine
        earlier = () if engine is None else (engine.before, _copied(engine.clearance))
        state = taken[k % N_CYCLE].take(partial(sim.step, length[k % N_CYCLE]))
        not_ok += int((~state.ok).sum())
        passes.append(state.passes[state.ok])
        if state.contacts is not None:
            touching.append(state.contacts.in_contact().mean())
            contacts.append(state.contacts.count.mean())
    each = np.concatenate(passes)
    return Timed(
        n_faces=0 if obstacle is None else len(obstacle.faces),
        step_s=float(np.nanmean([one.least for one in taken])),
        touching=float(np.mean(touching or 0.0)),
        contacts=float(np.mean(contacts or 0.0)),
        passes=float(each.mean()),
        most_passes=int(each.max()),
        gap=math.nan if state.contacts is None else float(np.nanmedian(state.contacts.clearance)),
        not_ok=not_ok,
        sim=sim,
        last=state,
        earlier=earlier,
    )


def query(timed: Timed, repeats: int) -> list[float]:
    """Seconds of one search of all robots against their meshes: with nothing known, and from what the step
    before knew."""
    engine: Any = timed.sim._engine
    before, clearance = timed.earlier
    rows, kept, found = np.arange(timed.sim.n_robots), engine.snapshot(), []
    engine.before, shape = before, timed.last.as_shape()
    for cold in (True, False):
        searched = Measurement()
        for _ in range(repeats):
            engine.clearance = _copied(clearance)
            if cold:
                engine.clearance.distance[:] = -np.inf
            engine.tracked[:] = not cold  # what has no past has gone through nothing
            searched.take(partial(engine.overlap, rows, shape))
        found.append(searched.least)
    engine.restore(kept)
    return found


def _copied(clearance: Any) -> Any:
    return type(clearance)(*(a.copy() for a in clearance))


def questions(timed: Timed, obstacle: Obstacle, pose: Array, rows: Iterable[int]) -> list[tuple[Any, ...]]:
    """Queries of FCL for these robots: the mesh, a capsule of radius 1e-6 m on each chord between nodes,
    request and result."""
    import fcl

    model = fcl.BVHModel()
    model.beginModel(len(obstacle.vertices), len(obstacle.faces))
    model.addSubModel(obstacle.vertices, obstacle.faces)
    model.endModel()
    found: list[tuple[Any, ...]] = []
    for i in rows:
        ball = fcl.CollisionObject(model, fcl.Transform(pose[i, 3:], pose[i, :3]))
        for a, b in pairwise(timed.last.position[i]):
            length = float(np.linalg.norm(b - a))
            z = (b - a) / length  # a capsule's axis in its own frame
            x = np.cross(z, (1.0, 0.0, 0.0) if abs(z[0]) < 0.6 else (0.0, 1.0, 0.0))
            x /= np.linalg.norm(x)
            place = fcl.Transform(np.column_stack([x, np.cross(z, x), z]), 0.5 * (a + b))
            capsule = fcl.CollisionObject(fcl.Capsule(1e-6, length), place)
            found.append(
                (ball, capsule, fcl.DistanceRequest(enable_nearest_points=True), fcl.DistanceResult())
            )
    return found


def ask_fcl(queries: Sequence[tuple[Any, ...]]) -> float:
    """The smallest distance, one call each [m]."""
    import fcl

    return float(min(fcl.distance(*question) for question in queries))


def fcl_seconds(timed: Timed, obstacle: Obstacle, pose: Array, n_robots: int) -> tuple[float, int]:
    """Seconds that FCL's calls take for one robot's intervals, and the number of robots queried."""
    rows = np.unique(np.linspace(0, len(pose) - 1, min(n_robots, len(pose))).astype(int))
    queries = questions(timed, obstacle, pose, rows)
    ask_fcl(queries)
    return best(partial(ask_fcl, queries), 2) / len(rows), len(rows)
