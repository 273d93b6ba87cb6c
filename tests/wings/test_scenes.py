"""Every scene runs and keeps to its physics; the airway's mesh is what it says."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fastrod.contact import mesh
from fastrod.errors import UnknownNameError
from fastrod_scenes import Scene, load, names
from fastrod_scenes.contact import airway_mesh
from fastrod_scenes.contact.wall import Wall
from fastrod_scenes.scene import RodScene, SceneError


@pytest.mark.study
@pytest.mark.parametrize("name", names())
def test_scene_keeps_to_its_physics(name):
    figures = load(name).check()
    assert figures
    assert all(np.isfinite(value) for value in figures.values())


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("name", names())
def test_scene_says_what_it_is(name):
    scene = load(name)
    assert isinstance(scene, Scene)
    assert scene.name == name
    assert scene.about.endswith(".")
    assert scene.about.count(".") == 1
    assert scene.dt > 0.0
    if isinstance(scene, RodScene):
        assert scene.simulator().dt == scene.dt


@pytest.mark.study
@pytest.mark.parametrize("name", ["draped", "pair", "wall"])
def test_run_is_ok_from_the_first_input_to_the_last(name):
    scene = load(name)
    times, states = zip(*scene.run(), strict=True)
    assert times[0] == 0.0
    assert times[-1] == pytest.approx(scene.duration)
    assert_allclose(np.diff(times), scene.dt)
    assert all(state.ok.all() for state in states)
    assert states[-1].contacts.count.all()
    assert not states[0].contacts.count.any()


@pytest.mark.study
def test_runs_of_one_scene_are_the_same():
    scene = load("draped")
    (*_, (_, first)), (*_, (_, second)) = scene.run(), scene.run()
    assert_array_equal(first.position, second.position)


def test_unknown_scene_answers_with_the_nearest():
    with pytest.raises(UnknownNameError, match=r"no scene 'airwey'; did you mean 'airway'\?"):
        load("airwey")


def test_failed_expectation_is_one_sentence(monkeypatch):
    rest = load("wall").inputs(0.0)
    monkeypatch.setattr(Wall, "inputs", lambda self, t: rest)
    with pytest.raises(SceneError, match=r"^scene wall: the tip is on the wall in 0 steps"):
        load("wall").check()


def test_airway_is_a_watertight_wall_with_two_handles():
    vertices, faces = airway_mesh.airway()
    assert 10_000 < len(faces) < 50_000
    directed = np.stack([faces.ravel(), np.roll(faces, -1, axis=1).ravel()], axis=1)
    assert len(np.unique(directed, axis=0)) == len(directed)  # no edge twice in one direction ...
    assert {tuple(e) for e in directed} == {tuple(e) for e in directed[:, ::-1]}  # ... and each in both
    assert len(np.unique(faces)) == len(vertices)
    # one body of genus 2, or Euler's number would differ
    assert len(vertices) - len(directed) // 2 + len(faces) == 2 - 2 * 2
    corner = vertices[faces]
    volume = np.einsum("ij,ij->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6.0
    ring = np.pi * ((airway_mesh.RADIUS + airway_mesh.WALL) ** 2 - airway_mesh.RADIUS**2)
    long = 2.0 * airway_mesh.path_length() - airway_mesh.TRACHEA
    # where the tubes melt the wall is a little more, or less
    assert volume == pytest.approx(ring * long, rel=0.15)
    assert mesh((vertices, faces)).closed


def test_airway_stands_where_the_distance_says():
    vertices, _ = airway_mesh.airway()
    depth = np.array([airway_mesh.path_length()])
    ends = [airway_mesh.middle(branch, depth) for branch in airway_mesh.BRANCHES]
    apart = np.min([np.linalg.norm(vertices - end, axis=1) for end in ends], axis=0)
    cut = apart < 2.0 * (airway_mesh.RADIUS + airway_mesh.WALL)
    distance = airway_mesh.lumen_distance(vertices[~cut & (vertices[:, 2] > 0.004)])
    inner = distance < airway_mesh.WALL / 2.0
    assert inner.sum() > 1000
    # marching tetrahedra cut a corner of cell^2 / 8 r = 0.07 mm, and an edge's end is moved by up to 5 % of
    # its 1.8 to 3.1 mm
    assert np.abs(distance[inner]).max() < 3.5e-4
    assert np.abs(distance[~inner] - airway_mesh.WALL).max() < 3.5e-4


def test_airway_is_open_at_its_three_ends():
    depth = np.linspace(-0.02, airway_mesh.path_length() + 0.02, 60)
    for branch in airway_mesh.BRANCHES:
        distance = airway_mesh.lumen_distance(airway_mesh.middle(branch, depth))
        assert (distance < -0.9 * airway_mesh.RADIUS).all()


def test_middle_of_the_airway_is_as_long_as_its_depth_and_bends_as_it_heads():
    depth = np.linspace(0.0, airway_mesh.path_length(), 4001)
    for branch, toward in airway_mesh.BRANCHES.items():
        step = np.diff(airway_mesh.middle(branch, depth), axis=0)
        assert_allclose(np.linalg.norm(step, axis=1), np.diff(depth), rtol=1e-6)
        for k in (500, 2000, 3900):
            angle = airway_mesh.heading(0.5 * (depth[k] + depth[k + 1]))
            direction = [np.sin(angle) * np.cos(toward), np.sin(angle) * np.sin(toward), np.cos(angle)]
            assert_allclose(step[k] / np.diff(depth)[k], direction, atol=1e-5)


def test_surface_of_a_ball():
    axis = np.arange(-1.2, 1.21, 0.1)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    vertices, faces = airway_mesh.surface(np.sqrt(x**2 + y**2 + z**2) - 1.0, 0.1)
    vertices = vertices + axis[0]
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    assert (np.einsum("ij,ij->i", normal, corner.mean(axis=1)) > 0.0).all()
    assert len(vertices) - len(faces) // 2 == 2
    assert np.linalg.norm(normal, axis=1).sum() / 2.0 == pytest.approx(4.0 * np.pi, rel=0.01)
