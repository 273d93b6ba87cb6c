"""The surface queries of the kernels against the direct path, closed forms, brute force and differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from directscene import DirectScene
from numba import njit
from numpy.testing import assert_allclose

from fastrod.contact import Obstacle, box, capsule, cylinder, ellipsoid, mesh, plane, sphere
from fastrod.contact.frames import frames_of
from fastrod.contact.tree import pack
from fastrod.kernels.contact.bvh import FAR, LEAF_CODE, STACK
from fastrod.kernels.contact.surface import MOST_PLANES, ray_hit, signed_distance, surface_curvature, walls
from fastrod.types import WALL

SAME = 1e-9  # m; two paths in double precision on 0.1 m
SOLIDS = {
    "icosphere": lambda: trimesh.creation.icosphere(subdivisions=3, radius=0.02),
    "box": lambda: trimesh.creation.box(extents=(0.05, 0.03, 0.02)),
    "torus": lambda: trimesh.creation.torus(0.03, 0.01, major_sections=24, minor_sections=12),
    "tube": lambda: trimesh.creation.annulus(0.012, 0.02, 0.1, sections=48),
    "82k faces": lambda: trimesh.creation.icosphere(subdivisions=6, radius=0.1),
}
PRIMITIVES = {
    "sphere": lambda: sphere(0.02),
    "box": lambda: box((0.04, 0.06, 0.03)),
    "cylinder": lambda: cylinder(0.02, 0.05),
    "disc": lambda: cylinder(0.03, 0.01),
    "capsule": lambda: capsule(0.015, 0.04),
    "plane": lambda: plane(),
}
ELLIPSOIDS = {"egg": lambda: ellipsoid((0.02, 0.03, 0.045)), "lens": lambda: ellipsoid((0.03, 0.03, 0.01))}


@njit()
def _distances(k, frame, points, bound, surfaces, out):
    stack = np.empty(2 * STACK)
    for i in range(len(points)):
        d, n, near = signed_distance(
            k, frame, (points[i, 0], points[i, 1], points[i, 2]), bound[i], surfaces, stack
        )
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4] = d, n[0], n[1], n[2], 1.0 if near else 0.0


@njit()
def _rays(k, frame, points, directions, longest, surfaces, out):
    stack = np.empty(2 * STACK)
    for i in range(len(points)):
        p = (points[i, 0], points[i, 1], points[i, 2])
        along = (directions[i, 0], directions[i, 1], directions[i, 2])
        t, n = ray_hit(k, frame, p, along, longest, surfaces, stack)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = t, n[0], n[1], n[2]


@njit()
def _walls(k, frame, points, reach, surfaces, count, found):
    stack = np.empty(2 * STACK)
    for i in range(len(points)):
        p = (points[i, 0], points[i, 1], points[i, 2])
        nearest = signed_distance(k, frame, p, FAR, surfaces, stack)[0]
        count[i] = walls(k, frame, p, reach, nearest, surfaces, stack, found[i])


@njit()
def _curvatures(k, frame, points, surfaces, out):
    stack = np.empty(2 * STACK)
    for i in range(len(points)):
        first, second, along = surface_curvature(
            k, frame, (points[i, 0], points[i, 1], points[i, 2]), FAR, surfaces, stack
        )
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4] = first, second, along[0], along[1], along[2]


class Seen:
    """One obstacle at a pose, asked by the kernels; obstacle 1 of 3, so that offsets count."""

    def __init__(self, obstacle: Obstacle, pose=(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)) -> None:
        other = mesh(trimesh.creation.box(extents=(0.3, 0.4, 0.5)), name="before")
        self.surfaces = pack([other, obstacle, sphere(0.1, name="after")])
        self.frame = frames_of(np.array(pose, float).reshape(1, 1, 7))[0, 0]
        self.turn, self.at = self.frame[:9].reshape(3, 3), self.frame[9:]

    def distance(self, points, bound=FAR):
        """(n,) distance, (n, 3) normal, (n,) nearer than the bound."""
        out = np.empty((len(points), 5))
        _distances(
            1,
            self.frame,
            np.ascontiguousarray(points),
            np.broadcast_to(bound, len(points)).astype(float),
            self.surfaces,
            out,
        )
        return out[:, 0], out[:, 1:4], out[:, 4] == 1.0

    def ray(self, points, directions, longest=FAR):
        """(n,) length, inf where there is no hit, and (n, 3) normal."""
        out = np.empty((len(points), 4))
        _rays(
            1,
            self.frame,
            np.ascontiguousarray(points),
            np.ascontiguousarray(directions),
            longest,
            self.surfaces,
            out,
        )
        return np.where(out[:, 0] < FAR, out[:, 0], np.inf), out[:, 1:]

    def walls(self, points, reach):
        """For each point its walls, (distance, normal) by distance."""
        count, found = np.zeros(len(points), np.int64), np.empty((len(points), MOST_PLANES), WALL)
        _walls(1, self.frame, np.ascontiguousarray(points), reach, self.surfaces, count, found)
        return [
            sorted((wall.distance, *wall.normal) for wall in row[:n])
            for n, row in zip(count, found, strict=True)
        ]

    def second_derivative(self, points):
        """(n, 3, 3) of the distance, put together from what `surface_curvature` returns."""
        out = np.empty((len(points), 5))
        _curvatures(1, self.frame, np.ascontiguousarray(points), self.surfaces, out)
        n, along = self.distance(points)[1], out[:, 2:]
        tangent = np.eye(3) - n[:, :, None] * n[:, None]
        one = np.isclose(out[:, 0], out[:, 1])
        a = np.where(one[:, None], 0.0, along)
        return (
            out[:, 0, None, None] * (tangent - a[:, :, None] * a[:, None])
            + out[:, 1, None, None] * a[:, :, None] * a[:, None]
        )


def random_pose(rng):
    q = rng.normal(size=4)
    return np.concatenate([rng.uniform(-0.2, 0.2, 3), q / np.linalg.norm(q)])


def places(rng, solid, n):
    """(4 n, 3) around a mesh, and close to its faces, edges and vertices on both sides."""
    t = solid.triangles
    pick = t[rng.integers(len(t), size=3 * n)]
    weight = rng.dirichlet((1, 1, 1), size=3 * n)
    weight[n : 2 * n, 2] = 0.0
    weight[2 * n :, 1:] = 0.0
    weight /= weight.sum(axis=1, keepdims=True)
    away = rng.normal(size=(3 * n, 3)) * 10.0 ** rng.uniform(-6, -2, size=(3 * n, 1))
    return np.vstack(
        [rng.uniform(-0.8, 0.8, (n, 3)) * solid.extents, (pick * weight[..., None]).sum(axis=1) + away]
    )


def direct(obstacle, pose, points):
    scene = DirectScene([obstacle])
    scene.place(0, pose[:3], pose[3:])
    found = [scene.point(0, p) for p in points]
    return scene, np.array([f.distance for f in found]), np.array([f.normal for f in found])


@pytest.mark.study(beyond=4)
@pytest.mark.parametrize("name", SOLIDS)
def test_a_mesh_is_as_far_as_the_direct_path_says(name):
    rng = np.random.default_rng(1)
    solid, pose = SOLIDS[name](), random_pose(rng)
    obstacle = mesh(solid)
    seen = Seen(obstacle, pose)
    points = places(rng, solid, 10 if len(solid.faces) > 5000 else 100) @ seen.turn.T + seen.at
    scene, distance, normal = direct(obstacle, pose, points)
    d, n, near = seen.distance(points)
    assert near.all()
    assert (d < 0).any()
    assert (d > 0).any()
    assert_allclose(d, distance, rtol=0, atol=SAME)
    assert_allclose(np.linalg.norm(n, axis=1), 1.0, rtol=0, atol=1e-9)
    # also where two faces are as near, and the paths choose differently
    for p, di, ni in zip(points, d, n, strict=True):
        assert abs(scene.point(0, p - di * ni).distance) < 2e-9
    assert np.median(np.linalg.norm(n - normal, axis=1)) < 1e-9


@pytest.mark.parametrize("name", PRIMITIVES)
def test_a_primitive_is_as_far_as_the_direct_path_says(name):
    rng = np.random.default_rng(2)
    obstacle, pose = PRIMITIVES[name](), random_pose(rng)
    seen = Seen(obstacle, pose)
    local = np.vstack(
        [
            rng.uniform(-0.06, 0.06, (300, 3)),
            rng.uniform(-0.03, 0.03, (100, 1)) * np.eye(3)[rng.integers(3, size=100)],
        ]
    )
    points = local @ seen.turn.T + seen.at
    _, distance, normal = direct(obstacle, pose, points)
    d, n, near = seen.distance(points)
    assert near.all()
    assert_allclose(d, distance, rtol=0, atol=1e-12)
    # the rest is on an axis, or as near to two sides
    assert (np.linalg.norm(n - normal, axis=1) < 1e-9).mean() > 0.9
    unique = slice(0, 300)
    assert_allclose(n[unique], normal[unique], rtol=0, atol=1e-9)


def test_closed_forms():
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.1, 0.1, (500, 3))
    d, n, _ = Seen(sphere(0.04)).distance(points)
    r = np.linalg.norm(points, axis=1)
    assert_allclose(d, r - 0.04, rtol=0, atol=1e-15)
    assert_allclose(n, points / r[:, None], rtol=0, atol=1e-12)
    wall = plane((0.01, 0.02, 0.03), (1.0, 2.0, 2.0))
    d, n, _ = Seen(wall, (*wall.position, *wall.quaternion)).distance(points)
    assert_allclose(d, (points - (0.01, 0.02, 0.03)) @ np.array([1.0, 2.0, 2.0]) / 3.0, rtol=0, atol=1e-15)
    assert_allclose(n, np.broadcast_to(np.array([1.0, 2.0, 2.0]) / 3.0, n.shape), rtol=0, atol=1e-12)
    over = np.abs(points) - np.array([0.04, 0.06, 0.03]) / 2.0
    expected = np.linalg.norm(np.maximum(over, 0.0), axis=1) + np.minimum(over.max(axis=1), 0.0)
    assert_allclose(Seen(box((0.04, 0.06, 0.03))).distance(points)[0], expected, rtol=0, atol=1e-15)
    solid = trimesh.creation.box(extents=(0.04, 0.06, 0.03))
    assert_allclose(Seen(mesh(solid)).distance(points)[0], expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", ["icosphere", "torus"])
def test_beyond_its_bound_a_distance_is_a_lower_bound(name):
    """For points outside: nobody asks with a bound from inside, and a bound says nothing there."""
    rng = np.random.default_rng(4)
    solid = SOLIDS[name]()
    seen = Seen(mesh(solid))
    points = rng.uniform(-1.0, 1.0, (2000, 3)) * solid.extents
    full, normal, _ = seen.distance(points)
    points, full, normal = points[full > 0], full[full > 0], normal[full > 0]
    bound = full * 10.0 ** rng.uniform(-1.0, 1.0, len(full))
    d, n, near = seen.distance(points, bound)
    assert_allclose(near, full < bound)
    assert_allclose(d[near], full[near], rtol=0, atol=1e-15)
    assert_allclose(n[near], normal[near], rtol=0, atol=1e-12)
    assert (d[~near] <= full[~near] + 1e-15).all()
    assert (d[~near] >= bound[~near]).all()


def naive_ray(p, v, triangles):
    """Smallest t >= 0 at which p + t v meets a triangle, inf if none (Moeller and Trumbore 1997)."""
    a, ab, ac = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    h = np.cross(v, ac)
    det = (ab * h).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = ((p - a) * h).sum(1) / det
        q = np.cross(p - a, ab)
        w, t = (v * q).sum(1) / det, (ac * q).sum(1) / det
        hit = (u >= -1e-9) & (w >= -1e-9) & (u + w <= 1.0 + 1e-9) & (t >= 0.0)
    return t[hit].min(initial=np.inf)


@pytest.mark.parametrize("name", ["icosphere", "box", "torus", "tube"])
def test_a_ray_meets_the_triangle_that_brute_force_finds(name):
    rng = np.random.default_rng(5)
    solid, pose = SOLIDS[name](), random_pose(rng)
    obstacle = mesh(solid)
    seen, triangles = Seen(obstacle, pose), obstacle.vertices[obstacle.faces]
    p = rng.uniform(-0.8, 0.8, (400, 3)) * solid.extents
    aim = places(rng, solid, 100)
    v = np.where(rng.random((400, 1)) < 0.5, aim - p, rng.normal(size=(400, 3)))
    v[:40] = np.eye(3)[rng.integers(3, size=40)] * rng.choice([-1.0, 1.0], size=(40, 1))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    expected = np.array([naive_ray(a, b, triangles) for a, b in zip(p, v, strict=True)])
    still = Seen(obstacle).ray(p, v)[0]
    t, n = seen.ray(p @ seen.turn.T + seen.at, v @ seen.turn.T)
    assert 100 < np.isfinite(expected).sum() < 400
    assert_allclose(still, expected, rtol=0, atol=1e-12)
    assert_allclose(t[40:], expected[40:], rtol=0, atol=SAME)
    hit = np.isfinite(t)
    at = (p @ seen.turn.T + seen.at + np.where(hit, t, 0.0)[:, None] * (v @ seen.turn.T))[hit]
    assert np.abs(seen.distance(at)[0]).max() < SAME
    assert_allclose(np.linalg.norm(n[hit], axis=1), 1.0, rtol=0, atol=1e-12)
    short = 0.7 * np.median(expected[hit])
    assert_allclose(
        Seen(obstacle).ray(p, v, short)[0], np.where(expected <= short, expected, np.inf), rtol=0, atol=1e-12
    )


def exact_ray(obstacle, p, v):
    """Return where a ray from outside enters, or from inside leaves, inf if never; for a sphere, a plane,
    an ellipsoid and a box."""
    if obstacle.shape == "plane":
        t = np.array([-p[2] / v[2]])
    elif obstacle.shape == "sphere":
        b, c = p @ v, p @ p - obstacle.size[0] ** 2
        root = b * b - c
        t = np.array([]) if root < 0.0 else np.array([-b - math.sqrt(root), -b + math.sqrt(root)])
    elif obstacle.shape == "ellipsoid":
        q, w = p / obstacle.size, v / np.array(obstacle.size)
        a, b, c = w @ w, q @ w, q @ q - 1.0
        root = b * b - a * c
        t = np.array([]) if root < 0.0 else np.array([-b - math.sqrt(root), -b + math.sqrt(root)]) / a
    else:
        a, b = (-np.array(obstacle.size) / 2 - p) / v, (np.array(obstacle.size) / 2 - p) / v
        low, high = np.minimum(a, b).max(), np.maximum(a, b).min()
        t = np.array([low, high]) if low <= high else np.array([])
    return t[t >= 0.0].min(initial=np.inf)


def rays(seen, obstacle, rng, inside):
    """Random rays up to 1 m, what they meet, and how steeply."""
    p = rng.uniform(-1.0, 1.0, (4000, 3)) * (0.03 if inside else 0.08)
    p = p[(seen.distance(p)[0] < 0.0) == inside]
    v = rng.normal(size=p.shape)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    expected = np.array([exact_ray(obstacle, a, b) for a, b in zip(p, v, strict=True)])
    expected[expected > 1.0] = np.inf
    at = p + np.where(np.isfinite(expected), expected, 0.0)[:, None] * v
    steep = np.where(np.isfinite(expected), np.abs((seen.distance(at)[1] * v).sum(1)), 1.0)
    return seen.ray(p, v, 1.0)[0], expected, steep


@pytest.mark.parametrize("name", ["sphere", "plane", "box", *ELLIPSOIDS])
@pytest.mark.parametrize("inside", [False, True])
def test_a_ray_meets_a_primitive_where_the_closed_form_does(name, inside):
    obstacle = (PRIMITIVES | ELLIPSOIDS)[name]()
    t, expected, steep = rays(Seen(obstacle), obstacle, np.random.default_rng(6), inside)
    plain = steep > 0.1
    assert np.isfinite(expected[plain]).sum() > 50
    assert_allclose(t[plain], expected[plain], rtol=0, atol=2e-9)  # it stops within 1e-10 of the surface


@pytest.mark.parametrize("name", ["plane", "box"])
def test_a_ray_from_inside_that_runs_along_a_wall_comes_to_its_end(name):
    obstacle = PRIMITIVES[name]()
    direction = np.array([0.001, 0.0, 1.0])
    direction /= np.linalg.norm(direction)
    p = np.array([[0.0, 0.0, -1e-5]]) if name == "plane" else np.array([[0.02 - 1e-5, 0.001, -0.01]])
    v = direction[[2, 1, 0]] if name == "plane" else direction * (-1.0, 1.0, 1.0)
    t, _ = Seen(obstacle).ray(p, v[None], 1.0)
    assert t[0] == pytest.approx(exact_ray(obstacle, p[0], v + 1e-300), abs=1e-6)


def hole():
    """A closed block with a box-shaped cavity of 0.06 x 0.08 x 0.10 m inside."""
    cavity = trimesh.creation.box(extents=(0.06, 0.08, 0.10))
    cavity.invert()
    return mesh(trimesh.util.concatenate([trimesh.creation.box(extents=(0.1, 0.12, 0.14)), cavity]))


def test_the_walls_of_a_concave_corner():
    rng = np.random.default_rng(7)
    pose = random_pose(rng)
    seen, half = Seen(hole(), pose), np.array([0.03, 0.04, 0.05])
    reach, counts = 0.012, set()
    for _ in range(300):
        side, depth = rng.choice([-1.0, 1.0], 3), rng.uniform(0.001, 0.03, 3)
        (got,) = seen.walls((side * (half - depth)) @ seen.turn.T[None] + seen.at, reach)
        near = sorted(np.flatnonzero(depth < reach), key=lambda a: depth[a])
        counts.add(len(near))
        assert len(got) == len(near)
        for (d, *n), a in zip(got, near, strict=True):
            assert d == pytest.approx(depth[a], abs=1e-12)
            assert_allclose(n, -side[a] * seen.turn[:, a], rtol=0, atol=1e-12)
    assert counts == {0, 1, 2, 3}


def test_a_wall_is_seen_from_above_the_diagonal_of_its_two_triangles():
    wide = trimesh.creation.box(extents=(0.25, 0.25, 0.25))
    slim = trimesh.creation.box(extents=(0.0625, 0.125, 0.125))
    slim.invert()
    beside, above = Seen(mesh(trimesh.util.concatenate([wide, slim]))).walls(
        [[1e-6, 0.0, 0.0605], [0.0, 0.0, 0.0605]], 0.01
    )
    assert len(beside) == 1
    assert len(above) == 1


def test_the_outside_of_a_convex_body_has_one_wall():
    rng = np.random.default_rng(8)
    seen = Seen(mesh(SOLIDS["box"]()))
    points = rng.uniform(-0.05, 0.05, (200, 3))
    d, n, _ = seen.distance(points)
    over = (np.abs(points) > np.array([0.025, 0.015, 0.01])).sum(1)
    for p, di, ni, sides, got in zip(points, d, n, over, seen.walls(points, 0.06), strict=True):
        assert len(got) == (sides == 1), p  # beyond an edge or inside: none that it faces
        for dj, *nj in got:
            assert dj == pytest.approx(di, abs=1e-12)
            assert_allclose(nj, ni, rtol=0, atol=1e-9)


def difference(seen, points, h):
    """(n, 3, 3) central difference of the normal."""
    columns = [
        (seen.distance(points + e)[1] - seen.distance(points - e)[1]) / (2.0 * h) for e in h * np.eye(3)
    ]
    return np.stack(columns, axis=2)


@pytest.mark.parametrize("name", [*PRIMITIVES, *ELLIPSOIDS, "mesh"])
def test_the_normal_turns_as_the_curvature_says(name):
    rng = np.random.default_rng(9)
    solid = trimesh.creation.icosphere(subdivisions=1, radius=0.03)
    seen = Seen(mesh(solid) if name == "mesh" else (PRIMITIVES | ELLIPSOIDS)[name](), random_pose(rng))
    points = (
        places(rng, solid, 200) if name == "mesh" else rng.uniform(-0.06, 0.06, (600, 3))
    ) @ seen.turn.T + seen.at
    points = points[seen.distance(points)[0] > 3e-3]
    expected = seen.second_derivative(points)
    coarse, fine = difference(seen, points, 2e-6), difference(seen, points, 1e-6)
    # where a difference straddles two features it depends on its step
    smooth = np.abs(coarse - fine).max(axis=(1, 2)) < 1e-3
    assert smooth.mean() > 0.9
    # of up to 1 / 3 mm: error of order h^2 / d^3
    assert_allclose(fine[smooth], expected[smooth], rtol=0, atol=2e-3)
    if name == "mesh":  # faces, edges and vertices were all met
        rank = np.linalg.matrix_rank(expected, tol=1.0)
        assert set(rank) == {0, 1, 2}


@pytest.mark.study(beyond=4)
@pytest.mark.parametrize("name", [*SOLIDS, "tetrahedron"])
def test_every_triangle_is_in_one_leaf_and_every_box_holds_what_is_below(name):
    tetrahedron = trimesh.Trimesh(
        [(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1)], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    )
    obstacle = mesh(tetrahedron if name == "tetrahedron" else SOLIDS[name]())
    s = pack([mesh(SOLIDS["box"](), name="first"), sphere(0.1), obstacle])
    n = len(obstacle.faces)
    leaf = np.zeros(len(s.corner), int)
    everything = np.array([-np.inf] * 3 + [np.inf] * 3)
    stack, deepest = [(int(s.root[2]), everything, 0)], 0
    while stack:
        link, around, level = stack.pop()
        deepest = max(deepest, level)
        if link >= 0:
            for side in range(2):
                inside = s.box[link, 6 * side : 6 * side + 6]
                assert (inside[:3] >= around[:3]).all()
                assert (inside[3:] <= around[3:]).all()
                stack.append((int(s.link[link, side]), inside, level + 1))
            continue
        first, count = divmod(-1 - link, LEAF_CODE)
        assert 1 <= count < LEAF_CODE
        leaf[first : first + count] += 1
        corners = s.corner[first : first + count].reshape(-1, 3)
        assert (corners >= around[:3]).all()
        assert (corners <= around[3:]).all()
    assert leaf[: len(s.corner) - n].sum() == 0
    assert (leaf[len(s.corner) - n :] == 1).all()
    assert deepest < STACK
    assert deepest <= math.ceil(math.log2(max(n, 2)))
    mine = np.sort(s.corner[-n:].reshape(n, 9), axis=0)
    assert_allclose(mine, np.sort(obstacle.vertices[obstacle.faces].reshape(n, 9), axis=0), rtol=0, atol=0)
