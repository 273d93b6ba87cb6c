"""No touch hides between two nodes: the search along a rod against a dense sampling, and steps against a
signed distance of their own."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from contact.robots import bent, prototype
from numba import njit

import fastrod
from fastrod.contact import ContactScene, box, mesh, plane, sphere
from fastrod.contact.frames import frames_of
from fastrod.contact.tree import pack
from fastrod.kernels.contact import proximity
from fastrod.kernels.contact.centreline import Curve, point_at
from fastrod.types import CANDIDATE, SearchWork


@njit()
def _search(curve, options, surfaces, frames, distance, position, work, found):
    return proximity.search_obstacles(
        proximity.ProximitySearch(curve, options, surfaces, frames, distance, position, work, found)
    )


@njit()
def _point(curve, j, fraction):
    return point_at(curve, j, fraction)


def _searched(curve, radius, nearest, surfaces, pose, found):
    """How many candidates of one rod and one obstacle there are, and the smallest gap."""
    n = len(curve.arclength)
    options = proximity.ProximityOptions(np.array([radius]), 2, 0.0, 1e-3, 1e-3, nearest)
    work = SearchWork(*(room[0] for room in proximity.search_work(1, n)))
    frames = frames_of(np.array([[pose]], float))[0]
    return _search(curve, options, surfaces, frames, np.full(n, -np.inf), np.zeros((n, 3)), work, found)


def _arc(bend, s):
    """Nodes of a rod that bends about x by so much [1/m]."""
    angle, nothing = bend * s, np.zeros_like(s)
    c, d, one = np.cos(angle), np.sin(angle), np.ones_like(s)
    rotation = np.stack([one, nothing, nothing, nothing, c, -d, nothing, d, c], axis=1).reshape(-1, 3, 3)
    position = np.stack([nothing, (c - 1.0) / max(bend, 1e-9), d / max(bend, 1e-9)], axis=1)
    return Curve(position, rotation, np.stack([bend * one, nothing, nothing], axis=1), s)


@pytest.mark.study
@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("radius", [0.0, 0.002, 0.012])
def test_every_dip_of_an_interval_is_found(scenes, radius, nearest):
    """Several balls of one mesh beside three nodes that are 30 mm apart: every ball that the rod enters has a
    candidate, and the smallest gap is the sampled one."""
    rng, dense = np.random.default_rng(11), np.linspace(0.0, 0.06, 24001)
    line = np.stack([0.0 * dense, 0.0 * dense, dense], axis=1)
    s = np.array([0.0, 0.03, 0.06])
    curve = Curve(np.stack([0.0 * s, 0.0 * s, s], axis=1), np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3)), s)
    hidden = 0
    for _ in range(20):
        at = 0.004 + 0.007 * np.flatnonzero(rng.random(8) < 0.6) + rng.uniform(-5e-4, 5e-4)
        at = at if len(at) else np.array([0.01, 0.02])
        depth = rng.uniform(-3e-4, 3e-4, len(at))
        balls = [trimesh.creation.icosphere(subdivisions=2, radius=0.002) for _ in at]
        for ball, z, d in zip(balls, at, depth, strict=True):
            ball.apply_translation([radius + 0.002 - d, 0.0, z])
        obstacle = mesh(trimesh.util.concatenate(balls))
        phi = scenes.distances(obstacle, np.array([0.0, 0, 0, 1, 0, 0, 0]), line)
        found = np.zeros(64, CANDIDATE)
        count, gap = _searched(curve, radius, nearest, pack([obstacle]), [0.0, 0, 0, 1, 0, 0, 0], found)
        assert gap <= phi.min() - radius + proximity.UNSEEN
        dips = 1 + np.flatnonzero(
            (phi[1:-1] < phi[:-2]) & (phi[1:-1] <= phi[2:]) & (phi[1:-1] < radius - proximity.UNSEEN)
        )
        for k in dips if not nearest else []:
            near = np.abs(found["arclength"][:count] - dense[k]) < 1e-3
            assert near.any(), (at, depth, dense[k])
            assert found["gap"][:count][near].min() <= phi[k] - radius + 1e-8
        hidden += len(dips)
    assert hidden > 20


@pytest.mark.study
def test_every_dip_beside_a_convex_obstacle_is_found(scenes):
    """Hulls of a few points, and boxes, at a bent rod, where slopes spare most samples: as above."""
    rng, dips_seen = np.random.default_rng(5), 0
    for k in range(120):
        bend, size = rng.uniform(0.0, 45.0), rng.uniform(0.004, 0.04, 3)
        s, dense = np.array([0.0, 0.015, 0.03]), np.linspace(0.0, 0.03, 6001)
        curve = _arc(bend, s)
        line = np.array([_point(curve, int(z >= 0.015), z / 0.015 - int(z >= 0.015)) for z in dense])
        hull = trimesh.convex.convex_hull(rng.normal(size=(int(rng.integers(5, 40)), 3)) * size)
        obstacle = box(2.0 * size) if k % 3 == 0 else mesh(hull)
        surfaces = pack([obstacle])
        assert surfaces.convex.all()
        radius, turn = rng.choice([0.001, 0.004]), rng.normal(size=4)
        pose = np.concatenate([np.zeros(3), turn / np.linalg.norm(turn)])
        beside = np.concatenate([rng.normal(size=2), [0.0]])
        pose[:3] = line[rng.integers(1000, 5001)] + beside / np.linalg.norm(beside) * size.max() * 2.0
        for _ in range(40):  # until it touches
            gap = scenes.distances(obstacle, pose, line).min() - radius + rng.uniform(-1e-4, 5e-4)
            pose[:3] -= gap * beside / np.linalg.norm(beside)
        phi = scenes.distances(obstacle, pose, line)
        for nearest in (False, True):
            found = np.zeros(64, CANDIDATE)
            count, gap = _searched(curve, radius, nearest, surfaces, pose, found)
            assert gap <= phi.min() - radius + proximity.UNSEEN
            for d in 1 + np.flatnonzero(
                (phi[1:-1] < phi[:-2]) & (phi[1:-1] <= phi[2:]) & (phi[1:-1] < radius - proximity.UNSEEN)
            ):
                near = np.abs(found["arclength"][:count] - dense[d]) < 1.1e-3
                assert nearest or (near.any() and found["gap"][:count][near].min() <= phi[d] - radius + 1e-8)
                dips_seen += 1
    assert dips_seen > 50


def test_what_is_convex():
    """Simple shapes and hulls; no hollow, no two bodies, nothing open, nothing seen from inside."""
    ball, two = trimesh.creation.icosphere(subdivisions=1), [trimesh.creation.box() for _ in range(2)]
    two[1].apply_translation([3.0, 0.0, 0.0])
    lid, inside = ball.faces[ball.triangles_center[:, 2] > 0.5], ball.copy()
    discs = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]])
    inside.invert()
    others = [
        mesh(trimesh.creation.torus(1.0, 0.2)),
        mesh(trimesh.creation.annulus(0.1, 0.2, 1.0)),
        mesh(trimesh.util.concatenate(two)),
        mesh((ball.vertices, lid), open_surface=True),
        mesh((discs, np.array([[0, 1, 2], [3, 4, 5]])), open_surface=True),
        mesh(inside, open_surface=True),
    ]
    same = [sphere(1.0), plane(), box((1.0, 2.0, 3.0)), mesh(ball), mesh(two[0])]
    assert pack(same).convex.all()
    assert not pack(others).convex.any()


def test_the_curve_of_contact_is_the_shape():
    """At 6 steps a segment the curve that contact searches and `shape` agree between the nodes, in contact
    too."""
    scene = ContactScene(
        obstacles=[sphere(0.02, name="ball", position=(0.035, 0.004, 0.05))], rod_radius=0.004
    )
    sim = fastrod.Simulator(prototype(1e-5), points_per_segment=6, contact=scene)
    for part in np.linspace(0.0, 1.0, 6):
        state = sim.step(bent(12.0 * part, 4.0 * part))
    assert state.ok.all()
    assert state.contacts.in_contact("ball").all()
    s, p, t = state.arclength[0], state.position[0], state.rotation[0, :, :, 2]
    x = np.linspace(0.0, 1.0, 33)[1:-1, None, None]
    h = np.diff(s)[:, None]
    hermite = (
        (1 + 2 * x) * (1 - x) ** 2 * p[:-1]
        + h * x * (1 - x) ** 2 * t[:-1]
        + x**2 * (3 - 2 * x) * p[1:]
        - h * x**2 * (1 - x) * t[1:]
    )
    at = (s[:-1] + x[:, :, 0] * np.diff(s)).reshape(1, -1)
    # both are of the fourth order
    assert np.linalg.norm(sim.shape(at).position[0] - hermite.reshape(-1, 3), axis=1).max() < 1e-5


@pytest.mark.parametrize(
    ("obstacle", "points", "words"),
    [
        (box((0.2, 0.2, 0.02), name="press", position=(0, 0, 0.2)), 20, "'press' at arclength 0.0"),
        (plane(point=(0, 0, 0.2), normal=(0, 0, -1), name="lid"), 6, "'lid' at arclength 0.0"),
    ],
)
def test_what_is_stuck_is_said(obstacle, points, words):
    """An obstacle comes down on the whole rod in one step: it is not gone through, and one sentence says
    what, where, and what to do."""
    scene = ContactScene(obstacles=[obstacle], rod_radius=0.004, max_iterations=60)
    sim = fastrod.Simulator(prototype(1e-5), points_per_segment=points, contact=scene)
    sim.step(bent(1.0))
    q = obstacle.quaternion
    state = sim.step(bent(1.0), obstacle_pose={obstacle.name: [0, 0, -0.05, *q]})
    assert not state.ok[0]
    (said,) = state.problems.values()
    assert words in said
    assert state.problem_kinds[0].value.startswith(("contact_", "no_"))
    assert "smaller steps" in said or "points_per_segment" in said or "max_" in said
    assert "100 %" not in said
    assert said.count("\n") == 0
    assert state.passes[0] == -1
