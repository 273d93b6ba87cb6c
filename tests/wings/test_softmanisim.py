"""The paper's class on fastrod's model: every method, without the faults of the paper's own code."""

import logging
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fastrod.hosts import Bullet, HostCamera, SoftManiSim, connect
from fastrod.hosts.camera import CameraView

pybullet = pytest.importorskip("pybullet", reason="pybullet is not installed: pip install 'fastrod[hosts]'")

OFFSET = 0.0075
DOWN = (-math.pi / 2.0, 0.0, 0.0)  # turns +y to -z
STEPS = [0.001, 0.002, 0.005, 0.01]


def about_z(angle: float) -> list[float]:
    """Quaternion x y z w."""
    return [0.0, 0.0, math.sin(angle / 2.0), math.cos(angle / 2.0)]


@pytest.fixture
def make() -> Callable[..., SoftManiSim]:
    """Robots in worlds of their own; `dt` or `gravity` opens a bare world for them."""

    def build(dt: float | None = None, gravity: float = 9.81, **options: Any) -> SoftManiSim:
        if dt is not None:
            options["bullet"] = connect(dt=dt, gravity=(0.0, 0.0, -gravity))
        return SoftManiSim(**options)

    return build


def poses(b: Bullet) -> dict[int, Any]:
    bodies = [b.getBodyUniqueId(i) for i in range(b.getNumBodies())]
    return {i: np.concatenate([*b.getBasePositionAndOrientation(i), *b.getBaseVelocity(i)]) for i in bodies}


def place_of(sim: SoftManiSim, body: int) -> np.ndarray[Any, Any]:
    return np.array(sim.bullet.getBasePositionAndOrientation(body)[0])


def speed_of(sim: SoftManiSim, body: int) -> np.ndarray[Any, Any]:
    return np.array(sim.bullet.getBaseVelocity(body)[0])


def tangents(quaternions: Any) -> np.ndarray[Any, Any]:
    """Third axes of quaternions x y z w."""
    return np.array([pybullet.getMatrixFromQuaternion(q)[2::3] for q in quaternions])


# shape


def test_the_straight_robot_points_along_y_and_bends_as_in_the_paper(make):
    sim = make(number_of_segment=1)
    world, own = sim.move_robot_ori()
    assert world.shape == own.shape == (30, 7)
    assert_allclose(world[:, :3], np.linspace(0, 0.1, 30)[:, None] * [0, 1, 0], atol=1e-9)
    theta = 0.003 / OFFSET
    across, along = 0.1 / theta * (1 - math.cos(theta)), 0.1 / theta * math.sin(theta)
    assert_allclose(sim.calc_tip_pos([0, 0.003, 0])[0], [across, along, 0], atol=1e-6)
    assert_allclose(sim.calc_tip_pos([0, 0, 0.003])[0], [0, along, across], atol=1e-6)
    assert_allclose(sim.calc_tip_pos([0.05, 0, 0])[0], [0, 0.15, 0], atol=1e-6)


@pytest.mark.study
def test_orientations_are_those_of_the_backbone(make):
    """z of each quaternion is the tangent, by central differences; the bend is displacement over offset."""
    sim = make(number_of_sphere=200)
    rng = np.random.default_rng(3)
    for _ in range(3):
        action = np.c_[rng.uniform(-0.02, 0.05, 3), rng.uniform(-0.006, 0.006, (3, 2))]
        world, _ = sim.move_robot_ori(action.ravel(), [0.1, 0.2, 0.3], rng.uniform(-2, 2, 3))
        s = np.linspace(0.0, 0.3 + action[:, 0].sum(), 200)
        slopes = (world[2:, :3] - world[:-2, :3]) / (s[2:] - s[:-2])[:, None]
        assert_allclose(tangents(world[1:-1, 3:]), slopes, atol=0.03)
        # the last points inside each segment: less than its bend by their share
        for k, end in enumerate(np.cumsum(0.1 + action[:, 0])):
            inside = (s >= end - 0.1 - action[k, 0]) & (s <= end)
            first, last = tangents(world[inside][[0, -1], 3:])
            fraction = np.ptp(s[inside]) / (0.1 + action[k, 0])
            bend = math.acos(np.clip(first @ last, -1, 1))
            assert bend == pytest.approx(fraction * np.hypot(*action[k, 1:]) / OFFSET, abs=1e-4)


def test_world_is_base_times_robot_and_the_base_rotates_it(make):
    sim = make()
    action, base, angles = [0.01, 0.003, -0.002] * 3, [0.3, -0.2, 0.5], [0.4, -0.7, 1.9]
    rotation = pybullet.getQuaternionFromEuler(angles)
    world, own = sim.move_robot_ori(action, base, angles)
    for w, r in zip(world, own, strict=True):
        position, quaternion = pybullet.multiplyTransforms(base, rotation, r[:3].tolist(), r[3:].tolist())
        assert_allclose(w[:3], position, atol=1e-6)  # PyBullet multiplies in single precision
        assert_allclose(w[3:] * np.sign(np.dot(w[3:], quaternion)), quaternion, atol=1e-6)
    still, _ = sim.move_robot_ori(action, base, rotation)  # the same base as a quaternion
    assert_allclose(still, world, atol=1e-12)
    assert_allclose(sim.move_robot_ori(action)[1], own, atol=1e-9)
    assert_allclose(sim.calc_tip_pos(None, (0, 0, 1), DOWN)[0], [0, 0, 0.7], atol=1e-9)


@pytest.mark.study
def test_calc_tip_pos_agrees_with_the_motion_and_moves_nothing(make):
    sim, twin = make(), make()
    cube = sim.add_a_cube([0, 0.8, 0.3])
    for s in (sim, twin):
        s.move_robot_ori([0, 0.001, 0] * 3, [0, 0, 0.3])
    before = poses(sim.bullet)
    action, base, rotation = [0.02, 0.008, -0.01] * 3, [0.1, 0, 0.4], [0.3, 0, 0]
    position, quaternion = sim.calc_tip_pos(action, base, rotation)
    assert_array_equal(list(poses(sim.bullet).values()), list(before.values()))
    assert cube in before
    world, _ = sim.move_robot_ori(action, base, rotation)
    assert_array_equal(world[-1], [*position, *quaternion])
    assert_array_equal(world, twin.move_robot_ori(action, base, rotation)[0])  # nor did it change later ones
    assert_array_equal(sim.calc_tip_pos(action, base, rotation)[0], position)


# bodies


def test_bodies_are_replaced_and_taken_away(make):
    sim = make(dt=0.005, number_of_sphere=10)
    count = sim.bullet.getNumBodies()
    assert count == 10  # nine capsules, and the head with its fingers
    for _ in range(3):
        sim.move_robot_ori()
        sim.create_robot()
        assert sim.bullet.getNumBodies() == count
    sim.close()
    assert sim.bullet.getNumBodies() == 0
    sim.close()
    assert sim.bullet.isConnected()  # the world was not its own


def test_a_world_of_its_own_ends_with_it() -> None:
    sim = SoftManiSim(number_of_sphere=5)
    assert sim.bullet.getBodyInfo(sim.plane_id)[1] == b"plane"
    assert sim.bullet.dt == pytest.approx(0.005)
    sim.close()
    assert not sim.bullet.isConnected()


@pytest.mark.study
def test_robots_and_worlds_do_not_disturb_each_other(make):
    alone, here, there = make(), make(), make()
    beside = SoftManiSim(here.bullet, number_of_segment=1)  # a second robot in the same world
    ends = []
    for sim in (alone, here, there):
        cube = sim.add_a_cube([0.05, 0.3, 0.03], size=[0.06] * 3)
        for k in range(30):
            sim.move_robot_ori([0, 3e-4 * k, 0] * 3, [0, 0, 0.03])
            if sim is here:
                there.bullet.stepSimulation()
                beside.move_robot_ori([0, 1e-4 * k, 0], [0.0, -1.0, 0.3])
        sim.wait(0.1)
        ends.append(place_of(sim, cube))
    assert np.linalg.norm(ends[0] - [0.05, 0.3, 0.03]) > 0.02  # it was pushed
    assert_array_equal(ends[2], ends[0])
    assert abs(ends[1][2] - 0.03) < 1e-3
    assert len(poses(here.bullet)) == len(poses(there.bullet)) + 31


def test_the_marker_is_only_seen(make):
    sim = make(dt=0.005)
    cube = sim.add_a_cube([0, 0.4, 1.0], size=[0.02] * 3, mass=0.0)
    known = set(poses(sim.bullet))
    sim.move_robot_ori(base_pos=[0, 0, 1.0])
    (marker,) = set(poses(sim.bullet)) - known
    assert_allclose(place_of(sim, marker), [0, 0.4, 1.0], atol=1e-9)
    assert not sim.bullet.getCollisionShapeData(marker, -1)
    assert not sim.bullet.getClosestPoints(marker, cube, 0.1)
    sim.move_robot_ori(base_pos=[0, 0, 1.0], camera_marker=False)
    assert set(poses(sim.bullet)) == known


# pushing


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("dt", STEPS)
def test_a_cube_takes_the_speed_of_what_pushes_it(make, dt):
    """The head may begin one step's way inside: the engine takes out a fifth of it a step, as speed."""
    sim = make(dt=dt, gravity=0.0, max_grasp_width=0.0)
    cube = sim.add_a_cube([0, 0.3 + 0.0225 + 0.02 + 0.01, 0], size=[0.04] * 3)
    seen = []
    for k in range(round(0.2 / dt)):
        sim.move_robot_ori(base_pos=[0, 0.3 * k * dt, 0])
        seen.append(speed_of(sim, cube))
    along = np.array(seen)[:, 1]
    assert 0.999 * 0.3 < along[-1] < 1.2 * 0.3
    assert along.max() < 1.2 * 0.3
    assert_allclose(np.array(seen)[:, [0, 2]], 0.0, atol=1e-9)


@pytest.mark.study
@pytest.mark.parametrize("dt", STEPS)
def test_a_swinging_head_pushes_at_its_speed(make, dt):
    sim = make(dt=dt, gravity=0.0, max_grasp_width=0.0)
    cube = sim.add_a_cube([0.06, 0.3, 0], size=[0.04] * 3)
    tips, cubes = [], []
    for k in range(round(0.3 / dt)):
        world, _ = sim.move_robot_ori([0, 0.004 * k * dt / 0.3, 0] * 3)
        tips.append(world[-1, :3])
        cubes.append(speed_of(sim, cube))
    speed = np.linalg.norm(np.diff(tips, axis=0), axis=1) / dt
    touched = np.linalg.norm(cubes, axis=1) > 0.01
    assert touched.any()
    assert np.linalg.norm(cubes, axis=1).max() == pytest.approx(speed.max(), rel=0.1)


@pytest.mark.study
@pytest.mark.parametrize("dt", STEPS)
def test_a_jump_of_the_action_launches_nothing(make, dt):
    sim = make(dt=dt, gravity=0.0, number_of_sphere=16)
    cube = sim.add_a_cube([0.09, 0.25, 0], size=[0.05] * 3)
    sim.move_robot_ori()
    world, _ = sim.move_robot_ori([0, 0.01, 0] * 3)
    speed = np.linalg.norm(speed_of(sim, cube))
    assert_allclose(world[-1, :3], sim.calc_tip_pos([0, 0.01, 0] * 3)[0])
    assert 0.1 < speed < 1.2 * 2.0  # hit, and not much faster than the fastest point of the robot
    sim.wait(0.05)
    assert np.linalg.norm(speed_of(sim, cube)) < 1.2 * 2.0


def test_the_first_placement_passes_through_nothing(make):
    sim = make(dt=0.005, gravity=0.0)
    cube = sim.add_a_cube([0, 0.2, 0], size=[0.05] * 3)  # where the robot stands before its first motion
    sim.wait(0.1)
    sim.move_robot_ori(base_pos=[0, 0, 5.0])
    sim.wait(0.1)
    assert_array_equal(place_of(sim, cube), [0, 0.2, 0])
    assert not sim.is_robot_in_contact(cube)


# contact


def test_contact_is_of_surfaces_not_of_boxes(make):
    sim = make(dt=0.005, gravity=0.0)
    # along x = y: the corners of its bounding box are empty
    sim.move_robot_ori(base_orin=[0, 0, -math.pi / 4])
    beside = sim.add_a_cube([0.18, 0.05, 0], size=[0.05] * 3)
    low, high = (np.array([sim.bullet.getAABB(i) for i in sim._capsules.ids])[:, k] for k in (0, 1))
    assert (low.min(axis=0) < [0.18, 0.05, 0]).all()
    assert (high.max(axis=0) > [0.18, 0.05, 0]).all()
    assert not sim.is_robot_in_contact(beside)
    # 45.8 mm aside: 0.8 mm clear
    on = sim.add_a_cube([0.1 + 0.0324, 0.1 - 0.0324, 0], ori=about_z(math.pi / 4), size=[0.05] * 3)
    assert sim.is_robot_in_contact(on)
    assert not sim.is_gripper_in_contact(on)
    assert not sim.is_tip_in_contact(on)


def test_a_tilted_cube_near_the_tip_makes_no_contact(make):
    sim = make(dt=0.005, gravity=0.0, max_grasp_width=0.0)
    sim.move_robot_ori()
    side, tilt = 0.1, math.pi / 4
    extent = 0.0225 + 0.5 * side
    for gap, touches in ((0.003, False), (0.0005, True)):
        at = np.array([0.0, 0.3, 0.0]) + (extent + gap) * np.array([math.cos(tilt), math.sin(tilt), 0.0])
        cube = sim.add_a_cube(at, ori=about_z(tilt), size=[side] * 3)
        box, head = sim.bullet.getAABB(cube), sim.bullet.getAABB(sim._gripper.body)
        assert (np.array(box[0]) < head[1]).all()  # their boxes overlap
        assert (np.array(head[0]) < box[1]).all()
        for given in (sim.is_robot_in_contact, sim.is_gripper_in_contact, sim.is_tip_in_contact):
            assert given(cube) is touches
        sim.bullet.removeBody(cube)


# grasping


@pytest.mark.study
def test_suction_carries_a_cube_as_it_stands_and_lets_it_fall(make, caplog):
    sim = make(max_grasp_width=0.0)
    cube = sim.add_a_cube([0.005, 0, 0.03], ori=about_z(0.3), size=[0.06] * 3, mass=0.5)
    sim.wait(0.1)
    sim.move_robot_ori(None, [0, 0, 0.5], DOWN)
    with caplog.at_level(logging.WARNING):
        assert sim.suction_grasp() == -1
    assert "no movable body touches" in caplog.text
    for z in np.linspace(0.5, 0.38295, 40):
        sim.move_robot_ori(None, [0, 0, z], DOWN)
    before = place_of(sim, cube)
    assert sim.suction_grasp() == [cube]
    sim.wait(0.2)
    assert_allclose(place_of(sim, cube), before, atol=1e-3)
    lag, fastest = 0.0, 0.0
    for k in range(1, 101):
        sim.move_robot_ori(None, [0.001 * k, 0, 0.38295 + 0.002 * k], DOWN)
        lag = max(lag, float(np.linalg.norm(place_of(sim, cube) - before - [0.001 * k, 0, 0.002 * k])))
        fastest = max(fastest, float(np.linalg.norm(speed_of(sim, cube))))
    assert lag < 1e-3
    assert fastest < 1.1 * math.hypot(0.001, 0.002) / 0.005
    sim.wait(0.1)
    held = place_of(sim, cube)[2]
    assert sim.suction_grasp(False) is None
    sim.wait(0.1)
    assert sim.bullet.getDynamicsInfo(cube, -1)[0] == 0.5
    assert speed_of(sim, cube)[2] == pytest.approx(-9.81 * 0.1, rel=1e-3)
    assert held - place_of(sim, cube)[2] == pytest.approx(9.81 * 0.005**2 * 20 * 21 / 2, rel=0.02)
    sim.wait(1.0)
    assert place_of(sim, cube)[2] == pytest.approx(0.03, abs=2e-3)
    for z in np.linspace(0.58, 0.36, 60):  # and the head meets it again
        sim.move_robot_ori(None, [place_of(sim, cube)[0], 0, z], DOWN)
        if sim.is_tip_in_contact(cube):
            break
    assert sim.is_tip_in_contact(cube)


@pytest.mark.study
@pytest.mark.parametrize("dt", STEPS)
def test_the_gripper_holds_what_it_closes_on(make, dt):
    """A cube of 3 cm and 100 g, not quite in the middle: lifted by 10 cm, held for a second, and dropped."""
    sim = make(dt=dt, number_of_sphere=8)
    sim.add_a_cube([0, 0, -0.05], size=[1, 1, 0.1], mass=0.0)  # the ground
    cube = sim.add_a_cube([0.004, 0, 0.015], size=[0.03] * 3)
    sim.move_robot_ori(None, [0, 0, 0.5], DOWN)
    for z in np.arange(0.5, 0.3555, -0.2 * dt):
        sim.move_robot_ori(None, [0, 0, z], DOWN)
    sim.set_grasp_width(0.0)
    sim.wait(0.6)
    assert sim.is_gripper_in_contact(cube)
    for k in range(round(0.5 / dt)):
        sim.move_robot_ori(None, [0, 0, z + 0.2 * k * dt], DOWN)
    assert place_of(sim, cube)[2] == pytest.approx(0.115, abs=5e-3)
    sim.wait(1.0)
    assert place_of(sim, cube)[2] == pytest.approx(0.115, abs=5e-3)
    assert sim._gripper.width == pytest.approx(0.03, abs=1e-3)
    sim.set_grasp_width(2.0)
    sim.wait(0.8)
    assert place_of(sim, cube)[2] == pytest.approx(0.015, abs=2e-3)
    assert sim._gripper.width == pytest.approx(0.05, abs=1e-3)


# cubes and time


def test_a_cube_stands_as_given_and_falls_without_damping(make):
    sim = make(dt=0.002)
    rotation = np.array([0.1, -0.4, 0.2, 0.8]) / np.linalg.norm([0.1, -0.4, 0.2, 0.8])
    cube = sim.add_a_cube([1, 2, 3], rotation, [0.02, 0.04, 0.06], 0.3, [0, 1, 0, 1])
    position, quaternion = sim.bullet.getBasePositionAndOrientation(cube)
    assert_allclose([*position, *quaternion], [1, 2, 3, *rotation], atol=1e-9)
    assert_allclose(sim.bullet.getCollisionShapeData(cube, -1)[0][3], [0.02, 0.04, 0.06])
    sim.bullet.resetBaseVelocity(cube, [1.0, 0, 0], [0, 0, 5.0])
    sim.wait(0.5)
    assert_allclose(speed_of(sim, cube), [1.0, 0, -9.81 * 0.5], atol=1e-6)
    assert sim.bullet.getDynamicsInfo(cube, -1)[0] == 0.3


# pictures


def test_pictures_have_true_colours_and_depth(make):
    sim = make(max_grasp_width=0.0)
    sim.camera = HostCamera(width=64, height=48)
    sim.in_hand_camera = HostCamera(width=64, height=48, near=0.005, far=3.0)
    red = sim.add_a_cube([0, 0.5, 0.3], size=[0.1] * 3, color=[1, 0, 0, 1], mass=0.0)
    sim.move_robot_ori(base_pos=[0, 0, 0.3])
    sim.view = CameraView((0.6, 0.5, 0.3), (0, 0.5, 0.3))
    # the one in the hand sees from the front of the head, 23.5 mm beyond the tip
    for look, distance in ((sim.in_hand_camera_capture_image, 0.15 - 0.0235), (sim.capture_image, 0.55)):
        rgb, depth = look()
        assert rgb[24, 32, 0] > 100
        assert rgb[24, 32, 1:].max() < 30
        assert depth[24, 32] == pytest.approx(distance, abs=1e-3)
    seen = sim.camera.look(sim.bullet, *sim.view).segmentation
    assert sim.plane_id in seen
    bare, far = sim.capture_image(removeBackground=True)
    gone = (seen < 0) | (seen == sim.plane_id) | (seen == sim._marker)
    assert (bare[gone] == 255).all()
    assert np.isinf(far[gone]).all()
    assert_array_equal(bare[seen == red], rgb[seen == red])
    assert (seen[~gone] != red).any()  # the robot stays in the picture
    assert_array_equal(far[~gone], depth[~gone])


def test_the_camera_in_the_head_rolls_with_the_robot(make):
    sim = make(max_grasp_width=0.0)
    sim.in_hand_camera = HostCamera(width=64, height=48, near=0.005, far=3.0)
    # up and right of the tip
    sim.add_a_cube([0.05, 0.45, 1.05], size=[0.03] * 3, color=[0, 0, 1, 1], mass=0.0)
    for roll, rows, columns in ((0.0, slice(0, 24), slice(32, 64)), (math.pi, slice(24, 48), slice(0, 32))):
        sim.create_robot()
        sim.move_robot_ori(base_pos=[0, 0, 1], base_orin=[0, roll, 0])
        rgb, _ = sim.in_hand_camera_capture_image()
        blue = (rgb[..., 2] > 100) & (rgb[..., 0] < 60)
        assert blue.any()
        assert blue[rows, columns].sum() == blue.sum()
