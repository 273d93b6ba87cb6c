"""The direct path against brute force over all faces, and against closed forms worked out another way."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from directscene import DirectScene
from numpy.testing import assert_allclose

from fastrod.contact import box, capsule, cylinder, ellipsoid, mesh, plane, sphere
from fastrod.rotation import matrix_from_quaternion

EXACT = 1e-12  # m: the face is FCL's, the rest a closed form in double precision on 0.1 m
SOLIDS = {
    "icosphere": lambda: trimesh.creation.icosphere(subdivisions=3, radius=0.02),
    "box": lambda: trimesh.creation.box(extents=(0.05, 0.03, 0.02)),
    "torus": lambda: trimesh.creation.torus(0.03, 0.01, major_sections=24, minor_sections=12),
    "tube": lambda: trimesh.creation.annulus(0.018, 0.02, 0.1, sections=48),
    "blade": lambda: trimesh.Trimesh(BLADE, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]),
}
BLADE = [(0.05, 0.0, 0.0), (-0.02, 0.03, 0.0), (-0.02, -0.03, 0.0), (-0.015, 0.0, 0.006)]
"""Edges so sharp that one face's normal alone tells the wrong side."""


def dot(a, b):
    return (a * b).sum(axis=-1)


def naive_point(p, triangles):
    """(n,) distance from p to each triangle: the plane where p projects inside, else the edges."""
    corner, edge = triangles, np.roll(triangles, -1, axis=1) - triangles
    normal = np.cross(edge[:, 0], edge[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    inside = (dot(np.cross(edge, p - corner), normal[:, None]) >= 0.0).all(axis=1)
    t = np.clip(dot(p - corner, edge) / dot(edge, edge), 0.0, 1.0)
    to_edges = np.linalg.norm(corner + t[..., None] * edge - p, axis=-1).min(axis=1)
    return np.where(inside, np.abs(dot(p - corner[:, 0], normal)), to_edges)


def naive_segment(p, q, triangles):
    """(n,) distance from the segment p-q to each triangle: 0 where it crosses, else the least over edges and
    ends."""
    corner, edge, d = triangles, np.roll(triangles, -1, axis=1) - triangles, q - p
    normal = np.cross(edge[:, 0], edge[:, 1])
    hp, hq = dot(normal, p - corner[:, 0]), dot(normal, q - corner[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        x = p + (hp / (hp - hq))[:, None] * d
        crosses = (hp * hq <= 0.0) & (dot(np.cross(edge, x[:, None] - corner), normal[:, None]) >= 0.0).all(
            axis=1
        )
    best = np.minimum(naive_point(p, triangles), naive_point(q, triangles))
    w, dd, de, ee = p - corner, dot(d, d), dot(edge, d), dot(edge, edge)
    det = dd * ee - de**2
    with np.errstate(divide="ignore", invalid="ignore"):
        s, t = (de * dot(edge, w) - ee * dot(w, d)) / det, (dd * dot(edge, w) - de * dot(w, d)) / det
    free = (det > 1e-12 * dd * ee) & (s > 0) & (s < 1) & (t > 0) & (t < 1)
    s, t = np.where(free, s, 0.0), np.where(free, t, 0.0)
    between = np.linalg.norm(w + s[..., None] * d - t[..., None] * edge, axis=-1)
    u = np.clip(dot(corner - p, d) / dd, 0.0, 1.0) if dd > 0.0 else np.zeros(w.shape[:2])
    to_corner = np.linalg.norm(p + u[..., None] * d - corner, axis=-1)
    best = np.minimum(best, np.minimum(np.where(free, between, np.inf), to_corner).min(axis=1))
    return np.where(crosses, 0.0, best)


def naive_inside(p, triangles):
    """The solid angle of the surface seen from p is 4 pi inside (van Oosterom and Strackee 1983)."""
    a, b, c = np.moveaxis(triangles - p, 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    above = dot(a, np.cross(b, c))
    return np.arctan2(above, la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb).sum() > math.pi


def places(rng, solid, n):
    """Points around, and close to faces, edges and vertices on both sides."""
    t, size = solid.triangles, solid.extents
    pick = t[rng.integers(len(t), size=3 * n)]
    weight = rng.dirichlet((1, 1, 1), size=3 * n)
    weight[n : 2 * n, 2] = 0.0
    weight[2 * n :, 1:] = 0.0
    weight /= weight.sum(axis=1, keepdims=True)
    away = rng.normal(size=(3 * n, 3)) * 10.0 ** rng.uniform(-6, -2, size=(3 * n, 1))
    return np.vstack([rng.uniform(-0.7, 0.7, (n, 3)) * size, (pick * weight[..., None]).sum(axis=1) + away])


@pytest.mark.study
@pytest.mark.parametrize("name", SOLIDS)
def test_point_agrees_with_brute_force(name):
    rng = np.random.default_rng(1)
    solid = SOLIDS[name]()
    obstacle = mesh(solid)
    scene = DirectScene([obstacle])
    triangles = obstacle.vertices[obstacle.faces]
    signs = set()
    for p in places(rng, solid, 80):
        found = scene.point(0, p)
        each = naive_point(p, triangles)
        inside = naive_inside(p, triangles)
        signs.add(inside)
        assert found.distance == pytest.approx(-each.min() if inside else each.min(), abs=EXACT)
        assert each[found.face] == pytest.approx(each.min(), abs=EXACT)
        assert_allclose(found.point + found.distance * found.normal, p, atol=2e-9)
        assert naive_point(found.point, triangles[[found.face]])[0] < EXACT
        assert np.linalg.norm(found.normal) == pytest.approx(1.0, abs=1e-9)
    assert signs == {True, False}


def test_a_cavity_and_the_lumen_of_a_tube_are_outside():
    cavity = trimesh.creation.icosphere(subdivisions=2, radius=0.01)
    cavity.invert()
    shell = trimesh.util.concatenate([trimesh.creation.icosphere(subdivisions=2, radius=0.02), cavity])
    scene = DirectScene([mesh(shell), mesh(SOLIDS["tube"]())])
    assert scene.point(0, (0.0, 0.0, 0.0)).distance > 0.009
    assert scene.point(0, (0.0, 0.015, 0.0)).distance < -0.004
    assert scene.point(0, (0.03, 0.0, 0.0)).distance > 0.009
    lumen = scene.point(1, (0.017, 0.0, 0.01))
    assert 0.0 < lumen.distance < 0.0011
    assert lumen.normal[0] < -0.99  # back into the lumen
    assert scene.point(1, (0.019, 0.0, 0.01)).distance < -0.0009


def test_on_the_surface_the_normal_is_the_features():
    scene = DirectScene([mesh(SOLIDS["box"]())])
    corner = scene.point(0, (0.025, 0.015, 0.01))
    assert abs(corner.distance) < 1e-15
    assert_allclose(corner.normal, np.ones(3) / math.sqrt(3.0), atol=1e-12)
    edge = scene.point(0, (0.025, 0.015, 0.001))
    assert_allclose(edge.normal, (math.sqrt(0.5), math.sqrt(0.5), 0.0), atol=1e-12)
    assert_allclose(scene.point(0, (0.003, 0.002, 0.01)).normal, (0.0, 0.0, 1.0), atol=1e-12)


def test_an_open_surface_is_solid_behind_its_normals():
    sheet = ([[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, 0.1, 0.0]], [[0, 1, 2], [0, 2, 3]])
    scene = DirectScene([mesh(sheet, open_surface=True)])
    assert scene.point(0, (0.02, 0.01, 0.03)).distance == pytest.approx(0.03)
    behind = scene.point(0, (0.02, 0.01, -0.03))
    assert behind.distance == pytest.approx(-0.03)
    assert_allclose(behind.normal, (0.0, 0.0, 1.0), atol=1e-12)


def segments(rng, solid, n):
    """Around, short and long, and exactly or nearly parallel to edges: where closest points are not
    unique."""
    t, size = solid.triangles, solid.extents.max()
    start = np.vstack(
        [rng.uniform(-0.7, 0.7, (n, 3)) * solid.extents, t[rng.integers(len(t), size=3 * n)].mean(axis=1)]
    )
    start[n:] += 0.1 * size * rng.normal(size=(3 * n, 3)) * rng.choice([0.01, 0.3, 1.0], size=(3 * n, 1))
    edges = t[:, 1] - t[:, 0]
    along = np.vstack(
        [rng.normal(size=(2 * n, 3)), np.eye(3)[rng.integers(3, size=n)], edges[rng.integers(len(t), size=n)]]
    )
    along[2 * n :] += (
        rng.choice([0.0, 1e-15, 1e-12, 1e-8], size=(2 * n, 1)) * rng.normal(size=(2 * n, 3)) * size
    )
    return start, start + along / np.linalg.norm(along, axis=1, keepdims=True) * size * 10.0 ** rng.uniform(
        -4, 0.2, (4 * n, 1)
    )


@pytest.mark.study
@pytest.mark.parametrize("name", SOLIDS)
def test_segment_agrees_with_brute_force(name):
    rng = np.random.default_rng(2)
    solid = SOLIDS[name]()
    obstacle = mesh(solid)
    scene = DirectScene([obstacle])
    triangles = obstacle.vertices[obstacle.faces]
    crossings = 0
    for a, b in zip(*segments(rng, solid, 100), strict=True):
        found = scene.segment(0, a, b)
        each = naive_segment(a, b, triangles)
        crossings += each.min() == 0.0
        assert found.distance == pytest.approx(each.min(), abs=1e-10)  # FCL's own rounding, near parallel
        assert math.dist(found.point, found.on_segment) == pytest.approx(found.distance, abs=EXACT)
        assert_allclose(found.on_segment, a + found.fraction * (b - a), atol=EXACT)
        assert 0.0 <= found.fraction <= 1.0
        assert naive_point(found.point, triangles[[found.face]])[0] < EXACT
    assert crossings > 20


@pytest.mark.study
def test_a_segment_parallel_to_a_face_is_not_missed():
    """Asked once, FCL misses one of these in a hundred or in a few thousand, by up to 6 mm."""
    rng = np.random.default_rng(8)
    obstacle = mesh(SOLIDS["box"]())
    scene = DirectScene([obstacle])
    triangles = obstacle.vertices[obstacle.faces]
    start = rng.uniform(-0.03, 0.03, (800, 3))
    ends = start + np.eye(3)[rng.integers(3, size=800)] * 0.05 * 10.0 ** rng.uniform(-2, 0, (800, 1))
    found = [  # and two that it does miss, whichever comes first
        ((-0.02232473, 0.0214217, 0.00934293), (5.71351734e-05, 0.0214217, 0.00934293)),
        ((-0.01069241, -0.01419146, 0.0102913), (0.01301461, -0.01419146, 0.0102913)),
    ]
    for a, b in [*zip(start, ends, strict=True), *np.array(found)]:
        assert scene.segment(0, a, b).distance == pytest.approx(
            naive_segment(a, b, triangles).min(), abs=EXACT
        )


def test_a_segment_that_crosses_has_no_distance_and_one_of_no_length_is_a_point():
    scene = DirectScene([mesh(SOLIDS["box"]())])
    through = scene.segment(0, (0.001, 0.002, -0.05), (0.001, 0.002, 0.05))
    assert through.distance == pytest.approx(0.0, abs=EXACT)
    assert abs(through.point[2]) == pytest.approx(0.01)
    assert scene.segment(0, (0.001, 0.002, 0.0), (0.001, 0.002, 0.05)).fraction == pytest.approx(0.2)
    # inside: to the wall
    assert scene.segment(0, (0.001, 0.002, -0.002), (0.001, 0.002, 0.004)).distance == pytest.approx(0.006)
    for p in np.random.default_rng(3).uniform(-0.04, 0.04, (40, 3)):
        assert scene.segment(0, p, p).distance == pytest.approx(abs(scene.point(0, p).distance), abs=EXACT)


@pytest.mark.study
def test_faces_far_below_a_millimetre_are_not_lost():
    """Without a scale of its own FCL drops the inside of such faces: 2e-5 m off for segments."""
    rng = np.random.default_rng(4)
    solid = trimesh.creation.icosphere(subdivisions=4, radius=0.001)
    obstacle = mesh(solid)
    scene = DirectScene([obstacle])
    triangles = obstacle.vertices[obstacle.faces]
    for a, b in zip(*segments(rng, solid, 12), strict=True):
        assert scene.segment(0, a, b).distance == pytest.approx(
            naive_segment(a, b, triangles).min(), abs=EXACT
        )
        assert abs(scene.point(0, a).distance) == pytest.approx(naive_point(a, triangles).min(), abs=EXACT)


def test_a_moved_mesh_is_the_mesh_moved():
    rng = np.random.default_rng(5)
    obstacle = mesh(SOLIDS["torus"](), position=(0.1, 0.0, 0.2))
    triangles = obstacle.vertices[obstacle.faces]
    scene = DirectScene([sphere(0.01), obstacle])
    still = DirectScene([mesh(SOLIDS["torus"]())])
    # at rest
    assert scene.point(1, (0.1, 0.0, 0.2)).distance == pytest.approx(
        still.point(0, (0, 0, 0)).distance, abs=EXACT
    )
    for _ in range(30):
        q = rng.normal(size=4)
        q /= np.linalg.norm(q)
        at, turn = rng.uniform(-0.3, 0.3, 3), matrix_from_quaternion(q[None])[0]
        scene.place(1, at, q)
        a, b = rng.uniform(-0.05, 0.05, (2, 3))
        here, there = still.point(0, a), scene.point(1, turn @ a + at)
        assert there.distance == pytest.approx(here.distance, abs=EXACT)
        # a point on an edge is on both its faces, and the last bit says which is named
        assert max(naive_point(here.point, triangles[[here.face, there.face]])) < EXACT
        assert_allclose(there.point, turn @ here.point + at, atol=EXACT)
        assert_allclose(there.normal, turn @ here.normal, atol=1e-9)
        line, moved = still.segment(0, a, b), scene.segment(1, turn @ a + at, turn @ b + at)
        assert moved.distance == pytest.approx(line.distance, abs=EXACT)
        if line.distance > 0.0:
            assert_allclose(moved.point, turn @ line.point + at, atol=1e-9)


def test_the_tree_of_a_mesh_is_built_once():
    obstacle = mesh(SOLIDS["box"]())
    first, second = DirectScene([obstacle]), DirectScene([obstacle, obstacle])
    first.place(0, (0.1, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    second.place(1, (0.2, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    distances = [
        first.point(0, (0, 0, 0.05)).distance,
        *(second.point(k, (0, 0, 0.05)).distance for k in (0, 1)),
    ]
    # poses are each scene's own
    assert_allclose(distances, [math.hypot(0.075, 0.04), 0.04, math.hypot(0.175, 0.04)])
    assert len({id(m) for m in (*first._meshes, *second._meshes)}) == 1


def surface(obstacle, n):
    """(about 6 n^2, 3) points of a primitive's surface, from its parametrisation."""
    u, v = (g.ravel() for g in np.meshgrid(np.linspace(0.0, 1.0, n), np.linspace(0.0, 1.0, n)))
    a, b, c = obstacle.size
    round_ = np.stack([np.cos(2 * math.pi * u), np.sin(2 * math.pi * u)], axis=-1)
    if obstacle.shape == "box":
        square = np.stack([u - 0.5, v - 0.5, np.full(u.shape, 0.5)], axis=-1)
        return np.vstack([np.roll(side * square, k, axis=1) for k in range(3) for side in (1.0, -1.0)]) * (
            a,
            b,
            c,
        )
    if obstacle.shape == "cylinder":
        wall = np.column_stack([a * round_, b * (v - 0.5)])
        return np.vstack(
            [
                wall,
                *(np.column_stack([a * v[:, None] * round_, np.full(u.shape, z)]) for z in (-b / 2, b / 2)),
            ]
        )
    if obstacle.shape == "ellipsoid":
        return np.column_stack([np.sin(math.pi * v)[:, None] * round_, np.cos(math.pi * v)]) * (a, b, c)
    ball = a * np.column_stack([np.sin(math.pi * v)[:, None] * round_, np.cos(math.pi * v)])
    if obstacle.shape == "sphere":
        return ball
    ends = ball + np.where(ball[:, 2:] >= 0.0, 1.0, -1.0) * (0.0, 0.0, b / 2)
    return np.vstack([ends, np.column_stack([a * round_, b * (v - 0.5)])])


PRIMITIVES = [
    sphere(0.02),
    box((0.04, 0.06, 0.03)),
    cylinder(0.02, 0.05),
    cylinder(0.03, 0.01),
    capsule(0.015, 0.04),
    ellipsoid((0.02, 0.012, 0.015)),
]


def holds(obstacle, p):
    (a, b, c), (x, y, z) = obstacle.size, p
    if obstacle.shape == "box":
        return abs(x) < a / 2 and abs(y) < b / 2 and abs(z) < c / 2
    if obstacle.shape == "cylinder":
        return math.hypot(x, y) < a and abs(z) < b / 2
    if obstacle.shape == "ellipsoid":
        return math.hypot(x / a, y / b, z / c) < 1.0
    return math.dist(p, (0.0, 0.0, min(max(z, -b / 2), b / 2))) < a


@pytest.mark.study(beyond=2)
@pytest.mark.parametrize("obstacle", PRIMITIVES, ids=lambda o: o.name)
def test_primitives_know_their_nearest_surface_point(obstacle):
    rng = np.random.default_rng(6)
    scene, samples = DirectScene([obstacle]), surface(obstacle, 201)
    for p in rng.uniform(-0.04, 0.04, (60, 3)):
        found = scene.point(0, p)
        nearest = np.linalg.norm(samples - p, axis=1).min()
        # samples lie on the surface, the nearest within a step of the grid
        assert -1e-12 <= nearest - abs(found.distance) < 4e-4
        assert (found.distance < 0.0) == holds(obstacle, p)
        assert abs(scene.point(0, found.point).distance) < EXACT
        assert_allclose(found.point + found.distance * found.normal, p, atol=EXACT)
        step = 1e-7 * np.eye(3)
        slope = [(scene.point(0, p + e).distance - scene.point(0, p - e).distance) / 2e-7 for e in step]
        assert_allclose(found.normal, slope, atol=1e-4)  # central difference, curvature up to 1 / 0.5 mm
        assert found.face == -1


def test_closed_forms_by_hand():
    scene = DirectScene(
        [
            box((0.2, 0.4, 0.6)),
            cylinder(0.1, 0.4),
            capsule(0.1, 0.4),
            plane((0, 0, 0.1), (0, 1, 0)),
            sphere(0.1),
        ]
    )
    cases = [
        (0, (0.2, 0.0, 0.0), 0.1),
        (0, (0.13, 0.24, 0.0), 0.05),
        (0, (0.0, 0.18, 0.0), -0.02),
        (0, (0.102, 0.203, 0.306), 0.007),
        (1, (0.0, 0.0, 0.19), -0.01),
        (1, (0.13, 0.0, 0.24), 0.05),
        (1, (0.0, 0.0, 0.0), -0.1),
        (1, (0.0, 0.05, 0.3), 0.1),
        (2, (0.0, 0.0, 0.35), 0.05),
        (2, (0.0, 0.05, -0.1), -0.05),
        (2, (0.0, 0.0, 0.0), -0.1),
        (3, (5.0, 0.03, -7.0), 0.03),
        (3, (0.0, -2.0, 0.0), -2.0),
        (4, (0.0, 0.0, 0.0), -0.1),
        (4, (0.3, 0.0, 0.4), 0.4),
    ]
    for k, p, distance in cases:
        assert scene.point(k, p).distance == pytest.approx(distance, abs=1e-14)
    assert_allclose(scene.point(3, (5.0, 0.03, -7.0)).normal, (0.0, 1.0, 0.0), atol=1e-15)
    assert_allclose(scene.point(3, (5.0, 0.03, -7.0)).point, (5.0, 0.0, -7.0), atol=1e-14)


@pytest.mark.parametrize("obstacle", [*PRIMITIVES, plane((0, 0, 0.01), (1, 2, 3))], ids=lambda o: o.name)
def test_segment_of_a_primitive_is_its_lowest_point(obstacle):
    rng = np.random.default_rng(7)
    scene = DirectScene([obstacle])
    scene.place(0, (0.01, 0.0, -0.02), (0.5, -0.5, 0.5, 0.5))
    for k, (a, b) in enumerate(rng.uniform(-0.06, 0.06, (25, 2, 3))):
        b = a + np.array((0.0, 0.0, 0.05)) if k % 5 == 0 else b
        found = scene.segment(0, a, b)
        along = [scene.point(0, a + t * (b - a)).distance for t in np.linspace(0.0, 1.0, 101)]
        assert found.distance <= min(along) + EXACT
        # a distance changes no faster than the point moves
        assert found.distance >= min(along) - 0.005 * math.dist(a, b)
        assert scene.point(0, found.on_segment).distance == pytest.approx(found.distance, abs=EXACT)
        assert math.dist(found.point, found.on_segment) == pytest.approx(abs(found.distance), abs=EXACT)
