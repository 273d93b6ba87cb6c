"""Look of a PyBullet world: the triangles stand where PyBullet's own camera sees them."""

import numpy as np
import pytest
import trimesh
from bullets import empty_world
from numpy.testing import assert_allclose

from fastrod.errors import HostError
from fastrod.hosts import BulletArm, Visuals
from fastrod.rotation import matrix_from_quaternion
from fastrod_scenes.robots import ur5_path

WIDTH, HEIGHT, FOV = 240, 180, 40.0
ROTATION = [0.1, 0.2, -0.3, 0.927361849549570]  # x y z w


@pytest.fixture
def world():
    return empty_world()


def extent(points):
    return [points.min(axis=0), points.max(axis=0)]


def corners(visuals):
    """(n, 3) vertices of all shapes, world."""
    poses = visuals.poses()
    rotations = matrix_from_quaternion(poses[:, 3:])
    return np.concatenate(
        [s.vertices @ r.T + p[:3] for s, r, p in zip(visuals.shapes, rotations, poses, strict=True)]
    )


def picture_bounds(world, body, eye=(0.9, -1.1, 1.6), target=(0.1, 0.1, 1.0)):
    """Least and largest pixel (column, row) that shows the body, and what projects points to pixels."""
    view = np.reshape(world.computeViewMatrix(eye, target, (0, 0, 1)), (4, 4)).T
    projection = np.reshape(world.computeProjectionMatrixFOV(FOV, WIDTH / HEIGHT, 0.05, 10.0), (4, 4)).T
    matrices = view.T.ravel().tolist(), projection.T.ravel().tolist()
    mask = world.getCameraImage(WIDTH, HEIGHT, *matrices, renderer=world.ER_TINY_RENDERER)[4]
    rows, columns = np.nonzero(np.reshape(mask, (HEIGHT, WIDTH)) == body)

    def pixels(points):
        clip = np.column_stack([points, np.ones(len(points))]) @ (projection @ view).T
        return ([1.0, 1.0] + [1.0, -1.0] * clip[:, :2] / clip[:, 3:]) * [WIDTH / 2.0, HEIGHT / 2.0] - 0.5

    return np.array([[columns.min(), rows.min()], [columns.max(), rows.max()]]), pixels


KINDS = {
    "box": {"halfExtents": [0.05, 0.1, 0.15]},
    "sphere": {"radius": 0.12},
    "cylinder": {"radius": 0.05, "length": 0.4},
    "capsule": {"radius": 0.05, "length": 0.3},
    "mesh": {"meshScale": [0.001, 0.002, 0.001]},
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("link", [False, True])
def test_shape_stands_where_the_camera_sees_it(world, tmp_path, kind, link):
    points = [[0, 0, 0], [200, 0, 0], [0, 100, 0], [0, 0, 300]]
    faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
    wedge = tmp_path / "wedge.obj"
    wedge.write_text(trimesh.Trimesh(points, faces).export(file_type="obj"))
    shape = {"fileName": str(wedge)} if kind == "mesh" else {}
    shape |= {"visualFramePosition": [0.05, -0.03, 0.04], "visualFrameOrientation": ROTATION, **KINDS[kind]}
    seen = world.createVisualShape(getattr(world, f"GEOM_{kind.upper()}"), **shape)
    links = {
        "linkMasses": [1.0],
        "linkCollisionShapeIndices": [-1],
        "linkVisualShapeIndices": [seen if link else -1],
        "linkPositions": [[0.05, 0.0, 0.1]],
        "linkOrientations": [[0.0, 0.28, 0.0, 0.96]],
        "linkInertialFramePositions": [[0.1, 0.0, 0.2]],
        "linkInertialFrameOrientations": [[0.6, 0.0, 0.0, 0.8]],
        "linkParentIndices": [0],
        "linkJointTypes": [world.JOINT_REVOLUTE],
        "linkJointAxis": [[0.0, 0.0, 1.0]],
    }
    body = world.createMultiBody(
        1.0,
        -1,
        -1 if link else seen,
        [0.0, 0.1, 1.0],
        [0.0, 0.0, 0.6, 0.8],
        baseInertialFramePosition=[0.2, 0.1, 0.0],
        baseInertialFrameOrientation=[0.0, 0.6, 0.0, 0.8],
        **(links if link else {}),
    )
    if link:
        world.resetJointState(body, 0, 0.7)
    visuals = Visuals(world)
    assert len(visuals.shapes) == 1
    bounds, pixels = picture_bounds(world, body)
    points = pixels(corners(visuals))
    assert np.ptp(bounds, axis=0).min() > 10  # it fills a part of the picture
    # of 60: a pixel, and PyBullet draws round shapes with corners
    assert_allclose(extent(points), bounds, atol=3.5)


def test_arm_moves_with_its_joints(world):
    arm = BulletArm.load(world, ur5_path(), tip="tool0", position=(0.0, 0.0, 0.4))
    visuals = Visuals(world)
    for q in ([0.0, -1.2, 1.0, -0.5, -1.0, 0.3], [0.8, -1.9, 0.7, 0.5, 1.0, 2.0]):
        arm.place(q)
        bounds, pixels = picture_bounds(world, arm.body, eye=(1.5, -1.8, 1.5), target=(0.2, 0.0, 0.8))
        points = pixels(corners(visuals))
        assert_allclose(extent(points), bounds, atol=2.0)
    assert len({shape.name for shape in visuals.shapes}) == len(visuals.shapes)


def test_quadruped_encloses_what_touches(world):
    import pybullet_data

    body = world.loadURDF(f"{pybullet_data.getDataPath()}/a1/a1.urdf", [0.3, 0.2, 0.5], [0.0, 0.0, 0.6, 0.8])
    points = corners(Visuals(world))
    boxes = np.array([world.getAABB(body, link) for link in range(-1, world.getNumJoints(body))])
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    assert_allclose(0.5 * (points.min(axis=0) + points.max(axis=0)), 0.5 * (low + high), atol=0.05)
    assert_allclose(np.ptp(points, axis=0), high - low, atol=0.1)


def test_colours_and_what_is_left_out(world):
    colours = [(1.0, 0.0, 0.0, 0.5), (0.0, 0.0, 1.0, 1.0), (0.0, 1.0, 0.0, 0.0)]  # the last is not seen
    shapes = [world.createVisualShape(world.GEOM_SPHERE, radius=0.1, rgbaColor=colour) for colour in colours]
    red, blue, _ = (world.createMultiBody(0.0, -1, shape) for shape in shapes)
    assert [shape.rgba for shape in Visuals(world).shapes] == colours[:2]
    assert [shape.rgba for shape in Visuals(world, ignore=[red]).shapes] == colours[1:2]
    none = Visuals(world, ignore=[red, blue])
    assert none.shapes == ()
    assert none.poses().shape == (0, 7)


def test_ground_without_end_is_a_square(world):
    import pybullet_data

    world.loadURDF(f"{pybullet_data.getDataPath()}/plane.urdf")
    (shape,) = Visuals(world).shapes
    assert_allclose(np.ptp(shape.vertices, axis=0), [2.0, 2.0, 0.0], atol=1e-3)
    assert shape.vertices[:, 2].max() == 0.0


def test_mesh_that_cannot_be_read_is_a_box_around_what_touches(world):
    vertices = [[0.0, 0, 0], [0.3, 0, 0], [0, 0.2, 0], [0, 0, 0.1]]
    faces = [0, 2, 1, 0, 1, 3, 1, 2, 3, 0, 3, 2]
    seen = world.createVisualShape(world.GEOM_MESH, vertices=vertices, indices=faces)
    touched = world.createCollisionShape(world.GEOM_MESH, vertices=vertices)
    body = world.createMultiBody(
        1.0, touched, seen, [1.0, 2.0, 3.0], ROTATION, baseInertialFramePosition=[0.1, 0.0, 0.0]
    )
    points, box = corners(Visuals(world)), np.array(world.getAABB(body))
    assert_allclose(extent(points), box, atol=1e-6)


def test_body_that_is_gone_is_reported(world):
    body = world.createMultiBody(0.0, -1, world.createVisualShape(world.GEOM_SPHERE, radius=0.1))
    visuals = Visuals(world)
    world.removeBody(body)
    with pytest.raises(HostError, match="is the body still in the world"):
        visuals.poses()
    with pytest.raises(HostError, match="PyBullet has no world 999"):
        Visuals(999)
