"""The tracks: their checks can fail, fractions are counted right, what is held does not move, and the soft
robot can do it alone."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fastrod.control import FixedBase, SoftTip
from fastrod.hosts import BulletLink, MountedRod, connect
from fastrod.rotation import quaternion_from_vector
from fastrod.simulator import Simulator
from fastrod_scenes import load
from fastrod_scenes.scene import SceneError
from fastrod_scenes.ur5 import soft_ur5
from fastrod_scenes.ur5.soft_ur5 import OFFSET, SoftUR5, track_robot
from fastrod_scenes.ur5.tracking import (
    APPROACH,
    CENTER,
    LARGEST_ERROR,
    LEAST_FRACTION,
    TrackCircle,
    TrackingError,
    TrackingScene,
    fraction_of,
    record,
)


def follow(path, seconds, **options):
    stage = TrackingError(path, dt=TrackCircle.dt, **options)

    def times():
        for k in range(round(seconds / stage.dt)):
            stage.advance(k * stage.dt)
            yield (k + 1) * stage.dt

    return record(stage, times())


@pytest.mark.study
def test_check_fails_without_gain(monkeypatch):
    monkeypatch.setattr(TrackCircle, "duration", 3.0)
    monkeypatch.setattr(soft_ur5, "GAIN", 0.0)
    with pytest.raises(
        SceneError, match=r"^scene track_circle: the mean squared error after the approach is"
    ):
        load("track_circle").check()
    assert soft_ur5.GAIN == 0.0


@pytest.mark.study
def test_check_fails_without_feedforward(monkeypatch):
    monkeypatch.setattr(TrackCircle, "duration", 3.0)
    monkeypatch.setattr(TrackingError, "feedforward", lambda self, t: np.zeros(3))
    with pytest.raises(SceneError, match="the mean squared error after the approach is") as error:
        load("track_circle").check()
    # behind by v / gain: the error's square is (2 pi 0.2 / 20 / 10)^2, a third of it for each of x, y and z
    assert float(str(error.value).split(" is ")[1].split()[0]) == pytest.approx(
        (0.02 * np.pi / 10.0) ** 2 / 3.0, rel=0.1
    )


def test_check_fails_where_the_arm_does_it(monkeypatch):
    monkeypatch.setattr(TrackCircle, "duration", 3.0)
    monkeypatch.setattr(soft_ur5, "BEND_WEIGHT", 1.0)
    with pytest.raises(SceneError, match="of the tip's motion") as error:
        load("track_circle").check()
    assert float(str(error.value).split(" does ")[1].split()[0]) < 0.25


def test_fraction_of_a_known_split():
    angle = np.linspace(0.0, 2.0 * np.pi, 201)
    displacement = np.diff(np.stack([np.cos(angle), np.sin(angle), 0.1 * angle], axis=1), axis=0)
    across = np.cross(displacement, [0.0, 0.0, 1.0])
    assert fraction_of(0.3 * displacement, displacement) == pytest.approx(0.3)
    assert fraction_of(0.3 * displacement, displacement) + fraction_of(
        0.7 * displacement, displacement
    ) == pytest.approx(1.0)
    assert fraction_of(across, displacement) == pytest.approx(0.0, abs=1e-12)
    assert fraction_of(-0.5 * displacement, displacement) == pytest.approx(-0.5)


def test_components_add_up_to_the_displacement():
    run = follow(load("track_figure_eight").path(), 1.5)
    assert np.linalg.norm(run.displacement, axis=1).min() > 1e-3
    going = slice(5, None)  # the first steps set out from rest
    assert_allclose(
        (run.by_soft + run.by_arm)[going],
        run.displacement[going],
        atol=0.02 * np.linalg.norm(run.displacement, axis=1).max(),
    )
    assert run.soft_fraction(0.0) > LEAST_FRACTION


@pytest.mark.study
def test_soft_robot_alone_tracks_the_full_circle_and_the_held_arm_stays():
    run = follow(load("track_circle").path(), 8.0, movers="soft", depth=0.07)
    assert run.mean_square(APPROACH) < LARGEST_ERROR
    assert np.ptp(run.q[:, :6], axis=0).max() < 1e-6
    assert np.abs(run.by_arm[1:]).max() < 1e-7  # in the first step the motors take up the rod's weight
    assert np.abs(run.by_arm[0]).max() < 1e-5
    assert np.ptp(run.tip[run.t > APPROACH], axis=0)[:2].max() > 0.2


@pytest.mark.study
def test_arm_alone_leaves_the_soft_robot_straight():
    run = follow(load("track_square_helix").path(), 3.0, movers="arm")
    assert run.mean_square(APPROACH) < LARGEST_ERROR
    assert np.ptp(run.q[:, 6:], axis=0).max() == 0.0
    assert not run.by_soft.any()


@pytest.mark.study
def test_square_as_large_as_the_papers_is_beyond_the_soft_robot_alone():
    run = follow(load("track_square").path(), 5.4, movers="soft", depth=0.05)
    assert run.mean_square(2.0, 3.0) < LARGEST_ERROR  # the middle of a side
    assert run.mean_square(4.6, 5.4) > 100.0 * LARGEST_ERROR  # its corner


def test_begins_at_the_center_at_rest():
    robot = SoftUR5(dt=0.02, tip=CENTER)
    assert_allclose(robot.tip(), CENTER, atol=1e-6)
    assert_allclose(robot.rest(), CENTER, atol=1e-6)
    for _ in range(5):
        robot.advance(CENTER - robot.tip(), np.zeros(3))
    assert_allclose(robot.tip(), CENTER, atol=2e-5)  # the motors take up the rod's weight


@pytest.mark.parametrize("name", ["square", "circle", "figure_eight", "helix", "square_helix"])
def test_scaled_path_is_the_path_about_the_center(name):
    scene = load(f"track_{name}")
    assert isinstance(scene, TrackingScene)
    t = np.linspace(0.0, 20.0, 50)
    assert_allclose(
        scene.path(0.4).position(t) - CENTER, 0.4 * (scene.path().position(t) - CENTER), atol=1e-12
    )


def test_following_a_mounted_rod_equals_its_own_kinematics():
    world = connect(gravity=(0.0, 0.0, -9.81))
    rotation = quaternion_from_vector(np.array([2.0, 0.3, 0.0]))
    link = BulletLink(world, world.createMultiBody(0.0, -1, -1, [0.1, 0.2, 0.5]), quaternion=rotation)
    rod = MountedRod(track_robot(), link, capsules_per_segment=5, dynamics=False)
    pose = link.motion().pose
    followed = SoftTip(rod.simulator, FixedBase(pose))
    held = SoftTip(Simulator(track_robot(), dt=rod.dt, points_per_segment=10), FixedBase(pose))
    q = np.array([0.01, 0.5 * OFFSET, 0.2 * OFFSET, 0.02, -0.3 * OFFSET, 0.4 * OFFSET])
    state = rod.settle(**followed.actions.inputs(q))
    followed.follow(q, state, pose)
    held.place(q, settle=True)
    assert_allclose(followed.position, held.position, atol=1e-9)
    assert_allclose(followed.jacobian(rotation=True), held.jacobian(rotation=True), rtol=1e-6, atol=1e-6)
