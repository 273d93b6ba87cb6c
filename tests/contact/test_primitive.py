"""A shape as one record: the ellipsoid against closed forms, and a stranger's from a package of its own."""

from __future__ import annotations

import math
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from contact.robots import bent, prototype
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import minimize

import fastrod
from fastrod.contact import ContactScene, Obstacle, Primitive, ellipsoid, mesh, obstacle, primitive, register
from fastrod.contact.primitive import primitive_of
from fastrod.contact.tree import pack
from fastrod.errors import InputError

ELLIPSOID = primitive_of("ellipsoid")
RADII = [(0.02, 0.03, 0.045), (0.03, 0.03, 0.01), (0.05, 0.004, 0.005), (0.002, 0.03, 0.03)]


def distances(size, points) -> tuple[np.ndarray, np.ndarray]:
    found = [ELLIPSOID.plain(size, tuple(map(float, p))) for p in points]
    return np.array([d for d, _ in found]), np.array([n for _, n in found])


def on_surface(size, angles) -> np.ndarray:
    theta, phi = np.moveaxis(np.asarray(angles), -1, 0)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1) * size


def smallest_distance(size, p) -> float:
    """Return the smallest distance from a grid of angles, its best places refined by a general minimiser."""
    grid = np.stack(np.meshgrid(np.linspace(0, np.pi, 61), np.linspace(0, 2 * np.pi, 121)), -1).reshape(-1, 2)
    order = np.argsort(((on_surface(size, grid) - p) ** 2).sum(-1))[:3]
    scale = max(size) ** 2

    def square(angles) -> float:
        return float(((on_surface(size, angles) - p) ** 2).sum()) / scale

    options = {"xatol": 1e-7, "fatol": 1e-15}
    found = [minimize(square, grid[k], method="Nelder-Mead", options=options).fun for k in order]
    return math.sqrt(min(found) * scale)


def test_an_ellipsoid_of_equal_radii_is_a_sphere():
    rng, ball = np.random.default_rng(1), primitive_of("sphere")
    points = rng.uniform(-0.06, 0.06, (300, 3))
    for p in (*map(tuple, points.tolist()), (0.0, 0.0, 0.05), (0.0, -0.01, 0.0)):
        d, n = ELLIPSOID.plain((0.02, 0.02, 0.02), p)
        expected, normal = ball.plain((0.02, 0.0, 0.0), p)
        assert d == pytest.approx(expected, abs=1e-15)
        assert_allclose(n, normal, rtol=0, atol=1e-12)
        if d > 0.0:
            first, second, _ = ELLIPSOID.curvature((0.02, 0.02, 0.02), p)
            assert_allclose([first, second], 1.0 / math.hypot(*p), rtol=1e-12)


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("size", RADII, ids=str)
def test_the_closest_point_is_where_a_minimiser_finds_it(size):
    rng = np.random.default_rng(2)
    points = np.array(size) * rng.normal(size=(24, 3)) * rng.choice([0.3, 0.6, 1.5], (24, 1))
    inside = ((points / size) ** 2).sum(1) < 1.0
    assert 4 <= inside.sum() <= 20
    d, n = distances(size, points)
    assert_array_equal(d < 0.0, inside)
    # a minimiser of squares finds the distance to the root of a float's precision
    assert_allclose(np.abs(d), [smallest_distance(size, p) for p in points], rtol=0, atol=1e-8)
    closest = (points - d[:, None] * n) / size
    assert_allclose((closest**2).sum(1), 1.0, rtol=0, atol=1e-12)
    gradient = closest / size
    assert_allclose(n, gradient / np.linalg.norm(gradient, axis=1)[:, None], rtol=0, atol=1e-9)


@pytest.mark.parametrize("size", RADII, ids=str)
def test_the_normal_is_the_slope_of_the_distance(size):
    rng = np.random.default_rng(3)
    points = np.array(size) * rng.normal(size=(200, 3))
    normal, h = distances(size, points)[1], 1e-7
    slope = np.stack(
        [
            (distances(size, points + e)[0] - distances(size, points - e)[0]) / (2.0 * h)
            for e in h * np.eye(3)
        ],
        axis=1,
    )
    # but where a difference straddles the inner surface from which two sides are as near
    smooth = np.abs(np.linalg.norm(slope, axis=1) - 1.0) < 1e-3
    assert smooth.mean() > 0.95
    assert_allclose(normal[smooth], slope[smooth], rtol=0, atol=1e-5)


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("size", RADII, ids=str)
def test_points_on_the_planes_of_symmetry_have_their_distance(size):
    a = np.array(size)
    for axis in np.eye(3):
        for far in (0.0, 0.5, 0.99, 1.0, 1.01, 30.0):
            p = far * a * axis
            d = distances(size, [p])[0][0]
            assert abs(d) == pytest.approx(smallest_distance(size, p), abs=1e-8)
            assert (d < 0.0) == (far < 1.0) or far == 1.0
    assert distances(size, [np.zeros(3)])[0][0] == pytest.approx(-min(size), rel=1e-12)


def resting(touched: Obstacle, pull: float = 12.0) -> fastrod.Simulator:
    sim = fastrod.Simulator(prototype(), contact=ContactScene(obstacles=[touched], rod_radius=0.003))
    sim.settle(bent(pull))
    return sim


def settled(touched: Obstacle, pull: float = 12.0) -> fastrod.State:
    state = resting(touched, pull).state
    assert state.ok.all(), state.problems
    assert state.contacts.in_contact().all()
    return state


@pytest.mark.study
def test_a_rod_on_an_ellipsoid_rests_as_on_its_fine_mesh():
    radii, place = (0.008, 0.02, 0.012), {"position": (0.018, 0.0, 0.05)}
    ball = trimesh.creation.icosphere(subdivisions=6, radius=1.0)
    solid = mesh((ball.vertices * radii, ball.faces), **place)
    smooth, faceted = settled(ellipsoid(radii, **place)), settled(solid)
    # facets of 0.2 mm lie up to 1e-6 m below what they stand for
    even = np.linspace(0.0, prototype().length, 61)
    shapes = [resting(one).shape(even).position for one in (ellipsoid(radii, **place), solid)]
    assert_allclose(*shapes, rtol=0, atol=5e-6)
    forces = [np.nansum(s.contacts.force[0], axis=0) for s in (smooth, faceted)]
    assert np.linalg.norm(forces[0]) > 0.1
    assert_allclose(forces[0], forces[1], rtol=0, atol=0.01 * np.linalg.norm(forces[0]))


def flat(size, p):
    return p[2], (0.0, 0.0, 1.0)


def straight(size, p):
    return 0.0, 0.0, (1.0, 0.0, 0.0)


def ring(size, p):
    round_ = math.hypot(p[0], p[1])
    across = round_ - 0.7 * size[0]
    length = math.hypot(across, p[2])
    return length - 0.3 * size[0], (
        across / length * p[0] / round_,
        across / length * p[1] / round_,
        p[2] / length,
    )


def record(**changed) -> Primitive:
    given = {"name": "tried", "n_sizes": 1, "distance": flat, "curvature": straight}
    return Primitive(**given | {"radius": max, "width": max, "drawing": lambda lib, size: None} | changed)


@pytest.fixture
def emptied(monkeypatch):
    """Remove what a test registers after it."""
    monkeypatch.setattr(primitive, "_REGISTRY", dict(primitive._REGISTRY))


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"name": "a b"}, r"Primitive\.name is 'a b'; give one word of letters, not 'mesh'"),
        ({"name": "mesh"}, "give one word of letters, not 'mesh'"),
        ({"n_sizes": 4}, "primitive 'tried' has n_sizes 4; give 0, 1, 2 or 3"),
        ({"curvature": 3.0}, r"curvature of primitive 'tried' is 3\.0; give a function"),
        ({"distance": max}, "distance of primitive 'tried' is <built-in function max>; give a function"),
        ({"name": "sphere"}, r"'sphere' is already registered by fastrod\.contact\.shapes\.sphere"),
        ({}, r"of size \(0\.1, 0, 0\) m has the distance -0\.11 m and the normal \(0, 0, 1\) at"),
        ({"distance": lambda size, p: (2.0 * p[2], (0.0, 0.0, 1.0))}, "one distance back along it"),
        ({"distance": lambda size, p: (math.nan, p)}, "has the distance nan m"),
        ({"distance": ring}, "is not convex: .* is outside, between two points of its surface"),
        (
            {"distance": lambda size, p: (p[0], "x")},
            "distance of primitive 'tried' cannot be compiled by numba:",
        ),
    ],
)
def test_a_record_that_is_none_is_refused_in_one_sentence(emptied, changed, words):
    with pytest.raises(InputError, match=words) as caught:
        pack([obstacle(register(record(**changed)).name, (0.1,))])
    assert "\n" not in str(caught.value)


def test_what_is_no_record_is_refused(emptied):
    with pytest.raises(InputError, match=r"the primitive is 3; give a fastrod\.contact\.Primitive"):
        register(3)
    with pytest.raises(InputError, match=r"Obstacle\.shape is 'elipsoid'; did you mean 'ellipsoid'"):
        obstacle("elipsoid", (1.0, 1.0, 1.0))
    with pytest.raises(InputError, match="must be 3 finite numbers"):
        ellipsoid((0.1, 0.1))
    with pytest.raises(InputError, match=r"20 m wide; more than 10 m.* If it is so large, widest=20.2 lets"):
        ellipsoid((0.1, 10.0, 0.1))
    assert ellipsoid((0.1, 10.0, 0.1), widest=20.2).size[1] == 10.0
    assert register(record(name="again")) is not register(record(name="again"))


PACKAGE = '''"""A plate with round edges: length and width of its flat faces, radius of the edges."""
import math

from fastrod.contact import Primitive, register
from fastrod.kernels.jit import inline
from fastrod.kernels.vec import unit


@inline
def _beyond(size, p):
    half_x, half_y = 0.5 * size[0], 0.5 * size[1]
    return p[0] - min(max(p[0], -half_x), half_x), p[1] - min(max(p[1], -half_y), half_y), p[2]


def _distance(size, p):
    length, n = unit(_beyond(size, p), (0.0, 0.0, 1.0))
    return length - SCALE * size[2], n


def _curvature(size, p):
    x, y, z = _beyond(size, p)
    curved = 1.0 / math.sqrt(x * x + y * y + z * z)
    if x == 0.0 and y == 0.0:
        return 0.0, 0.0, (1.0, 0.0, 0.0)
    if x == 0.0:
        return curved, 0.0, (1.0, 0.0, 0.0)
    return curved, curved if y != 0.0 else 0.0, (0.0, 1.0, 0.0)


SCALE = 1.0
register(
    Primitive(
        name="plate",
        n_sizes=3,
        distance=_distance,
        curvature=_curvature,
        radius=lambda size: 0.5 * math.hypot(size[0], size[1]) + size[2],
        width=lambda size: max(size[0], size[1]) + 2.0 * size[2],
        drawing=lambda trimesh, size: trimesh.creation.box(extents=(size[0], size[1], 2.0 * size[2])),
    )
)
'''
PLATE = "obstacle('plate', (0.4, 0.4, 0.01), position=(0.022, 0, 0), quaternion=(0.5**0.5, 0, 0.5**0.5, 0))"
STEPS = """
import numpy as np
import fastrod
from fastrod.contact import ContactScene, obstacle, plane

body = BODY
scene = ContactScene(obstacles=[body], rod_radius=0.003)
robot = fastrod.load_robot("prototype")
sim = fastrod.Simulator(robot, points_per_segment=5, contact=scene)
for pull in np.linspace(0.0, 0.006, 20):
    state = sim.step(robot.rest_tendon_length + np.array([-pull, 0.0, pull, 0.0]))
assert state.ok.all(), state.problems
assert state.contacts.in_contact().all()
print(*state.tip_position[0], *np.nansum(state.contacts.force[0], axis=0), body.as_trimesh().extents.max())
"""


def run(script: str, *arguments: str, folder: Path | None = None) -> str:
    path = os.pathsep.join(p for p in (str(folder or ""), *sys.path) if p)
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments],
        env=os.environ | {"PYTHONPATH": path, "FASTROD_QUIET": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@pytest.mark.study
def test_a_stranger_brings_a_shape_in_a_package_of_its_own(tmp_path, capsys):
    """A package of its own, as it lies once it is installed: one file, and its entry point. The kernels of
    contact are not compiled for it, and an edit of it is not missed."""
    (tmp_path / "platelab.py").write_text(PACKAGE)
    (tmp_path / "platelab-1.0.dist-info").mkdir()
    (tmp_path / "platelab-1.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: platelab\nVersion: 1.0\n"
    )
    (tmp_path / "platelab-1.0.dist-info" / "entry_points.txt").write_text(
        "[fastrod.primitives]\nplate = platelab\n"
    )
    for edited, wall in (("SCALE = 1.0", 0.012), ("SCALE = 1.1", 0.011)):
        exec(STEPS.replace("BODY", f"plane(point=({wall}, 0, 0), normal=(-1, 0, 0))"), {})
        expected = capsys.readouterr().out
        (tmp_path / "platelab.py").write_text(PACKAGE.replace("SCALE = 1.0", edited))
        found = run(STEPS.replace("BODY", PLATE), folder=tmp_path)
        plate, flat_wall = (np.array(line.split(), float) for line in (found, expected))
        assert np.linalg.norm(plate[3:6]) > 0.1
        assert_allclose(plate[:6], flat_wall[:6], rtol=0, atol=1e-6)
        assert plate[6] == pytest.approx(0.4)


@pytest.mark.study
def test_a_simulator_goes_on_in_another_process(tmp_path):
    """Compiled shapes stand elsewhere there."""
    scene = ContactScene(
        obstacles=[ellipsoid((0.008, 0.02, 0.012), position=(0.018, 0, 0.05))], rod_radius=0.003
    )
    sim = fastrod.Simulator(prototype(), contact=scene)
    sim.settle(bent(10.0))
    (tmp_path / "sim.pickle").write_bytes(pickle.dumps(sim))
    script = (
        "import pickle, sys, pathlib; sim = pickle.loads(pathlib.Path(sys.argv[1]).read_bytes()); "
        "from contact.robots import bent; state = sim.settle(bent(12.0)); "
        "assert state.contacts.in_contact().all(); print(state.tip_position[0].tobytes().hex())"
    )
    there = run(script, str(tmp_path / "sim.pickle")).strip()
    assert there == sim.settle(bent(12.0)).tip_position[0].tobytes().hex()
