"""Obstacles: what is refused and in which words, what is fixed, what is left alone."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal

from fastrod.contact import Obstacle, box, capsule, cylinder, mesh, plane, sphere
from fastrod.contact.normals import pseudonormals
from fastrod.errors import InputError

CUBE = trimesh.creation.box(extents=(0.02, 0.03, 0.04))
V, F = np.array(CUBE.vertices), np.array(CUBE.faces)


def shell(outer=0.02, inner=0.01, offset=0.0):
    cavity = trimesh.creation.icosphere(subdivisions=2, radius=inner)
    cavity.invert()
    cavity.apply_translation((offset, 0.0, 0.0))
    return trimesh.util.concatenate([trimesh.creation.icosphere(subdivisions=2, radius=outer), cavity])


def spoilt(row, value):
    vertices = V.copy()
    vertices[row] = value
    return vertices


BROKEN = {
    "nothing": (([], []), {}, "mesh 'mesh' is empty: it has 0 faces"),
    "no area": (
        (V[[0, 1, 0]], [[0, 1, 2]]),
        {},
        "mesh 'mesh' is empty: it has 1 faces and none with an area",
    ),
    "on a line": (([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], [[0, 1, 2]]), {"open_surface": True}, "empty"),
    "nan": (
        (spoilt(3, math.nan), F),
        {},
        r"vertex 3 of mesh 'mesh' is \[nan, nan, nan\]; all must be "
        r"finite \(1 of 8 are not\)",
    ),
    "inf": ((spoilt(5, math.inf), F), {}, "vertex 5 .* finite"),
    "index high": (
        (V, np.where(F == 7, 8, F)),
        {},
        r"face \d+ of mesh 'mesh' is .*8.*; its numbers must be "
        r"between 0 and 7",
    ),
    "index low": ((V, np.where(F == 7, -1, F)), {}, "-1.* must be between 0 and 7"),
    "quads": ((V, [[0, 1, 2, 3]]), {}, r"faces of shape \(1, 4\).*triangles only"),
    "float faces": ((V, F + 0.5), {}, "type float64; they must be .* integers"),
    "flat vertices": ((V[:, :2], F), {}, r"vertices of shape \(8, 2\)"),
    "words": (([["a", "b", "c"]], F), {}, "no table of numbers"),
    "open": (
        (V, F[:-1]),
        {},
        "mesh 'mesh' is not watertight: it has 3 open edges; "
        ".*open_surface=True.*solid lies behind its normals",
    ),
    "inverted": (
        (V, F[:, ::-1]),
        {"name": "cup"},
        r"mesh 'cup' is inverted: it has a negative "
        r"volume.*inwards.*mesh\.invert\(\)",
    ),
    "one of two inverted": (shell(inner=0.005, offset=0.08), {}, "inverted: 1 of its 2 bodies have"),
    "winding": (
        (V, np.vstack([F[:-1], F[-1:, ::-1]])),
        {},
        r"3 edges whose two faces wind in opposite "
        r"ways; .*fix_winding",
    ),
    "no volume": ((V[[0, 1, 2]], [[0, 1, 2], [0, 2, 1]]), {}, "encloses no volume.*open_surface=True"),
    "touching": (
        trimesh.util.concatenate([CUBE, CUBE.copy().apply_translation((0.02, 0.03, 0))]),
        {},
        "1 edges with more than two faces",
    ),
    "millimetres": ((1000.0 * V, F), {}, r"40 m wide; more than 10 m\. Was it given in mm\? scale=0\.001"),
    "tiny": ((V, F), {"scale": 1e-3}, "4e-05 m wide; tiny"),
    "scale zero": ((V, F), {"scale": 0.0}, r"scale of mesh 'mesh' is 0\.0; it must be positive and finite"),
    "scale inf": ((V, F), {"scale": math.inf}, "scale .* positive and finite"),
    "number": (3.0, {}, "mesh source is a float; give a file, a trimesh.Trimesh, or"),
    "three arrays": ((V, F, F), {}, "mesh source is a tuple"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_mesh_that_cannot_be_is_refused_in_one_sentence(case):
    source, options, words = BROKEN[case]
    with pytest.raises(InputError, match=words) as caught:
        mesh(source, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda: sphere(0.0),
            r"size of sphere 'sphere' is \[0\.0, 0\.0, 0\.0\] m; a sphere needs 1 "
            r"positive and 2 zero numbers",
        ),
        (lambda: box((0.1, -0.1, 0.1)), "a box needs 3 positive numbers"),
        (lambda: box((0.1, 0.1)), "must be 3 finite numbers"),
        (lambda: cylinder(0.01, math.nan), "size of cylinder .* must be 2 finite numbers"),
        (lambda: capsule(0.01, 20.0), r"20\.02 m wide; more than 10 m\. Was it given in mm\?"),
        (lambda: sphere(1e-6), "tiny"),
        (
            lambda: sphere(0.1, position=(0.0, 0.0)),
            r"position of sphere 'sphere' is \(0\.0, 0\.0\); it must "
            r"be 3 finite numbers \[m\]",
        ),
        (lambda: sphere(0.1, quaternion=(1.0, 1.0, 0.0, 0.0)), r"norm 1\.41421; it must be 1"),
        (lambda: sphere(0.1, friction=-0.1), r"friction of sphere 'sphere' is -0\.1; .* between 0 and 10"),
        (lambda: sphere(0.1, friction=10.5), "friction .* between 0 and 10"),
        (lambda: sphere(0.1, friction=math.nan), "friction"),
        (lambda: sphere(0.1, friction="low"), "friction .* 'low'; it must be a number"),
        (
            lambda: sphere(0.1, stiffness=0.0),
            r"stiffness of sphere 'sphere' is 0\.0 N/m; it must be "
            r"positive, or inf",
        ),
        (lambda: sphere(0.1, stiffness=math.nan), "stiffness"),
        (lambda: sphere(0.1, stifness=3.0), "no option 'stifness'; did you mean 'stiffness'"),
        (lambda: plane(normal=(0.0, 0.0, 0.0)), "plane normal .* must have a direction"),
        (lambda: plane(point=(0.0, math.inf, 0.0)), "plane point"),
        (lambda: mesh((V, F), friction=-1.0), "friction of mesh 'mesh'"),
        (lambda: mesh((V, F), quaternion=(0.0, 0.0, 0.0, 0.0)), "quaternion of mesh 'mesh'"),
        (lambda: _made(shape="spere"), "Obstacle.shape is 'spere'; did you mean 'sphere'"),
        (lambda: _made(shape="mesh", size=(0.0, 0.0, 0.0)), "has 0 faces; a mesh needs some"),
    ],
)
def test_a_number_out_of_range_is_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()


def _made(**changed):
    given = {
        "name": "x",
        "shape": "sphere",
        "size": (0.1, 0.0, 0.0),
        "position": (0, 0, 0),
        "quaternion": (1, 0, 0, 0),
        "friction": 0,
    }
    none, nothing = np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)
    return Obstacle(
        **given | {"vertices": none, "faces": nothing, "stiffness": math.inf, "closed": True} | changed
    )


def test_a_friction_above_five_is_called_unusual():
    with pytest.warns(UserWarning, match="unusual"):
        sphere(0.1, friction=6.0)


def test_files_that_cannot_be_read_say_which_and_what_is_near(tmp_path):
    CUBE.export(tmp_path / "cube.stl")
    (tmp_path / "cube.stll").write_text("solid")
    (tmp_path / "broken.ply").write_text("ply\nformat ascii 1.0\nelement vertex x\n")
    with pytest.raises(InputError, match=r"no mesh file '.*cub\.stl'; did you mean 'cube\.stl'"):
        mesh(tmp_path / "cub.stl")
    with pytest.raises(InputError, match="no mesh file"):
        mesh(tmp_path / "nowhere" / "cube.stl")
    with pytest.raises(InputError, match=r"'cube\.stll' has the unknown suffix '\.stll'; did you mean 'stl'"):
        mesh(str(tmp_path / "cube.stll"))
    with pytest.raises(InputError, match=r"'broken\.ply' cannot be read as ply: "):
        mesh(tmp_path / "broken.ply")


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off", "glb"])
def test_a_file_gives_the_mesh_that_was_written(tmp_path, suffix):
    CUBE.export(tmp_path / f"cup.{suffix}")
    loaded = mesh(str(tmp_path / f"cup.{suffix}"), position=[0, 0, 1], friction=0.2)
    assert (loaded.name, loaded.shape, loaded.closed, loaded.position) == (
        "cup",
        "mesh",
        True,
        (0.0, 0.0, 1.0),
    )
    # merged
    assert (loaded.vertices.shape, loaded.faces.shape, loaded.faces.dtype) == ((8, 3), (12, 3), np.int64)
    assert_allclose(loaded.as_trimesh().volume, 0.02 * 0.03 * 0.04, rtol=1e-6)  # float32


def test_bodies_of_a_scene_keep_their_transforms_and_millimetres_scale(tmp_path):
    scene = trimesh.Scene()
    for x in (0.0, 50.0):
        scene.add_geometry(
            CUBE.copy().apply_scale(1000.0),
            transform=trimesh.transformations.translation_matrix((x, 0.0, 0.0)),
        )
    scene.export(tmp_path / "two.glb")
    two = mesh(Path(tmp_path / "two.glb"), scale=0.001)
    assert_allclose(np.ptp(two.vertices, axis=0), (0.07, 0.03, 0.04), rtol=1e-6)
    assert two.faces.shape == (24, 3)


def test_a_users_mesh_is_left_untouched():
    given = trimesh.Trimesh(vertices=V[F].reshape(-1, 3), faces=np.arange(36).reshape(-1, 3), process=False)
    vertices, faces = given.vertices.copy(), given.faces.copy()
    made = mesh(given, scale=2.0)
    made.vertices[:] = 7.0
    made.faces[:] = 0
    assert_array_equal(given.vertices, vertices)
    assert_array_equal(given.faces, faces)
    array = V.copy()
    mesh((array, F)).vertices[:] = 7.0
    assert_array_equal(array, V)


def test_degenerate_faces_and_unused_vertices_go():
    vertices = np.vstack([V, V[:1] + 1e-14, [[9.0, 9.0, 9.0]]])
    made = mesh((vertices, np.vstack([F, [[0, 8, 3], [2, 2, 5]]])))
    assert made.vertices.shape == (8, 3)
    assert_array_equal(np.sort(made.vertices.ravel()), np.sort(V.ravel()))
    assert len(made.faces) == 12


def test_a_sliver_is_joined_to_its_neighbour_and_the_surface_stays_closed():
    a, b, c = F[0]
    longest = max(((a, b, c), (b, c, a), (c, a, b)), key=lambda e: np.linalg.norm(V[e[0]] - V[e[1]]))
    p, q, r = longest
    # new vertex on one side of the edge only: a face without area fills the gap
    middle = 0.4 * V[p] + 0.6 * V[q]
    faces = np.vstack([F[1:], [[p, 8, r], [8, q, r], [p, q, 8]]])
    made = mesh((np.vstack([V, middle]), faces))
    solid = made.as_trimesh()
    assert made.closed
    assert solid.is_watertight
    assert solid.area_faces.min() > 1e-5
    assert_allclose(solid.volume, CUBE.volume, rtol=1e-12)
    assert len(made.faces) == 14


def test_cavities_and_open_surfaces():
    hollow = mesh(shell())
    assert hollow.closed
    assert mesh(trimesh.creation.annulus(0.018, 0.02, 0.1)).closed
    assert not mesh((V, F[:-1]), open_surface=True).closed
    lumen = mesh((V, F[:, ::-1]), open_surface=True)
    assert lumen.closed
    assert lumen.as_trimesh().volume < 0.0


def test_primitives_say_their_size_and_draw_themselves():
    made = [sphere(0.1), box([0.1, 0.2, 0.3], name="b"), cylinder(0.1, 0.3), capsule(0.1, 0.3), plane()]
    assert [o.name for o in made] == ["sphere", "b", "cylinder", "capsule", "plane"]
    assert [o.size for o in made] == [(0.1, 0, 0), (0.1, 0.2, 0.3), (0.1, 0.3, 0), (0.1, 0.3, 0), (0, 0, 0)]
    widths = [(0.2, 0.2, 0.2), (0.1, 0.2, 0.3), (0.2, 0.2, 0.3), (0.2, 0.2, 0.5), (1.0, 1.0, 0.0)]
    for obstacle, width in zip(made, widths, strict=True):
        drawn = obstacle.as_trimesh()
        assert_allclose(np.ptp(drawn.vertices, axis=0), width, atol=2e-3)
        assert_allclose(drawn.vertices.max(axis=0), np.array(width) / 2.0, atol=2e-3)
    assert_allclose(made[4].as_trimesh().face_normals, [(0.0, 0.0, 1.0)] * 2)


@pytest.mark.parametrize(
    "normal", [(0.0, 0.0, 3.0), (1.0, 2.0, -0.5), (0.0, 0.0, -1.0), (1e-9, 0.0, -1.0), (0.0, -1.0, 0.0)]
)
def test_a_plane_turns_its_z_to_the_normal(normal):
    w, x, y, z = plane(normal=normal).quaternion
    third = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    assert_allclose(third, np.array(normal) / np.linalg.norm(normal), atol=2e-9)


def test_pseudonormals_of_a_cube_are_its_diagonals():
    normals = pseudonormals(V, F)
    size = np.array([0.02, 0.03, 0.04])
    assert_allclose(np.linalg.norm(normals, axis=-1), 1.0)
    # however the corner is cut, by the angle weights
    assert_allclose(normals[:, 4:], np.sign(V[F]) / math.sqrt(3.0), atol=1e-12)
    assert_allclose(normals[:, 0], CUBE.face_normals, atol=1e-12)
    middle = 0.5 * (V[F] + V[np.roll(F, -1, axis=1)]) / (0.5 * size)
    out = np.where(np.abs(middle) > 0.99, np.sign(middle), 0.0)
    assert_allclose(normals[:, 1:4], out / np.linalg.norm(out, axis=-1, keepdims=True), atol=1e-12)


def test_a_face_without_area_has_the_normal_of_its_neighbours():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.4, 0, 0]])
    normals = pseudonormals(vertices, np.array([[0, 1, 2], [1, 0, 3]]))
    assert_allclose(normals, np.broadcast_to((0.0, 0.0, 1.0), (2, 7, 3)), atol=1e-12)
