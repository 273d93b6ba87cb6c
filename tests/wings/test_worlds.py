"""The worlds that the viewer shows play and obey commands, and a command does what physics says."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rods import rod

from fastrod import Lump, load_robot, robot_names, save_robot
from fastrod.errors import HostError, InputError, RobotError, UnknownNameError
from fastrod.rotation import matrix_from_quaternion, quaternion_from_vector
from fastrod_scenes import load, names
from fastrod_viewer.worlds.catalogue import (
    HOSTED_SCENES,
    MUJOCO_SCENES,
    ROD_SCENES,
    about,
    catalogue,
    open_world,
)
from fastrod_viewer.worlds.hosted import HostedView
from fastrod_viewer.worlds.simulated import FreeWorld, SceneWorld, sway
from fastrod_viewer.worlds.world import ManualCommand

HOSTED = ["dual_arm", "explore", "neck_look", "neck_push", "pick_suction", "track_circle"]


def still(world, **options):
    """A command that keeps the straight robot."""
    return ManualCommand(world.robot.rest_tendon_length, np.zeros(world.robot.n_segments), **options)


def heavy(mode="tendon_length"):
    """A level, heavy robot of one segment."""
    level = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
    material = {"bending_stiffness": (0.01, 0.01), "torsional_stiffness": 0.008, "line_density": 0.3}
    return replace(rod(mode, length=0.2, **material), name=f"heavy, {mode}", base_quaternion=level)


@pytest.fixture
def shown(opened):
    """Opens a world by its name."""
    return lambda name: opened(open_world(name))


def action_of(world, *action):
    """The command with these displacements [m]."""
    given = world.actions.inputs(action)
    return ManualCommand(given["tendon_length"], given["extension"])


def along(*base):
    """A displacement of the base."""
    return np.array([*base, 0.0, 0.0, 0.0])


def tip(world):
    return world.rods[0].state.tip_position[0].copy()


def rest(world, command, steps=8):
    for _ in range(steps):
        world.drive(command)
    return tip(world)


@pytest.mark.study(beyond=5)
@pytest.mark.parametrize("name", [*robot_names(), *ROD_SCENES, *HOSTED, *MUJOCO_SCENES])
def test_world_plays_and_obeys(name, shown):
    world = shown(name)
    start, drive = world.t, [lambda: world.drive(still(world))] * world.drivable
    for move in [world.play] * 5 + drive * 5 + [world.reset]:
        move()
        poses = world.poses()
        assert poses.shape == (len(world.bodies), 7)
        assert np.isfinite(poses).all()
        for rods in world.rods:
            assert np.isfinite(rods.state.position).all()
            assert rods.place.shape == (len(rods.state.ok), 3)
            assert len(rods.radius) == rods.robots[0].n_segments
            assert min(rods.radius) > 0.0
    assert start == world.t == 0.0
    assert len({body.name for body in world.bodies}) == len(world.bodies)
    assert all(body.faces.max() < len(body.vertices) for body in world.bodies)


def test_scene_in_mujoco_is_played_and_nobody_drives_it():
    world, scene = open_world("ur5_mujoco"), load("ur5_mujoco")
    for t, state in zip(range(5), scene.run(), strict=False):
        world.play()
        assert world.t == pytest.approx((t + 1) * scene.dt)
        assert_allclose(tip(world), state[1].tip_position[0], atol=1e-12)
    assert not world.drivable
    for refused in (lambda: world.drive(still(world)), world.jacobian):
        sentence = r"^scene 'ur5_mujoco' has a script that moves its robots; they cannot be driven by hand\.$"
        with pytest.raises(InputError, match=sentence):
            refused()
    world.reset()
    assert world.t == 0.0


def test_scene_is_played_as_it_runs():
    world, scene = open_world("wall"), load("wall")
    for k, (t, state) in zip(range(80), scene.run(), strict=False):
        if k:
            world.play()
        assert world.t == pytest.approx(t)
        assert_allclose(tip(world), state.tip_position[0], atol=1e-12)


def test_script_begins_again_after_its_end():
    world = SceneWorld(load("wall"))
    first = tip(world)
    for _ in range(round(world.duration / world.dt)):
        world.play()
    assert world.t == pytest.approx(world.duration)
    assert np.linalg.norm(tip(world) - first) > 0.001
    world.play()
    assert world.t == 0.0
    assert_allclose(tip(world), first, atol=1e-12)


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize(
    "robot",
    [*map(load_robot, robot_names()), *map(heavy, ("tendon_length", "passive", "tendon_tension"))],
    ids=lambda r: r.name,
)
def test_free_robot_shows_itself_without_a_jump(robot):
    world = FreeWorld(robot)
    tips = [tip(world)]
    for _ in range(round(2.0 * world.duration / world.dt)):
        world.play()
        tips.append(tip(world))
    tips = np.array(tips)
    n = round(world.duration / world.dt)
    assert np.linalg.norm(np.ptp(tips, axis=0)) > 0.1 * robot.length
    assert np.linalg.norm(np.diff(tips, axis=0), axis=1).max() < 0.1 * robot.length
    assert_allclose(tips[-1], tips[n], atol=1e-3 * robot.length)


@pytest.mark.study
@pytest.mark.parametrize("name", ["five_segment_reacher", "ethz_beam", "wall", "airway"])
def test_base_moves_the_tip_along(name):
    world = open_world(name)
    before = rest(world, still(world))
    by = np.array([-0.004, 0.002, -0.003])
    moved = rest(world, still(world, base=along(*by)))
    assert_allclose(moved - before, by, atol=1e-8)


def test_base_rotates_about_its_origin():
    world = FreeWorld(load_robot("prototype"))
    before, angle = rest(world, still(world)), np.array([0.3, -0.2, 0.1])
    rotated = rest(world, still(world, base=np.array([0.0, 0.0, 0.0, *angle])))
    rotation = matrix_from_quaternion(quaternion_from_vector(angle)[None])[0]
    assert_allclose(rotated, rotation @ before, atol=1e-8)


def test_payload_is_the_force_of_its_weight():
    robot = load_robot("tdcr_a")
    robot = replace(robot, gravity=(3.0, -2.0, -9.0))
    carries, feels = FreeWorld(robot), FreeWorld(robot)
    by_mass = rest(carries, still(carries, payload=0.02))
    by_force = rest(feels, still(feels, tip_force=0.02 * np.array(robot.gravity)))
    assert_allclose(by_mass, by_force, atol=1e-12)
    assert np.linalg.norm(by_mass - [0.0, 0.0, robot.length]) > 1e-3


def test_gravity_off_takes_the_sag_away():
    world = FreeWorld(heavy("passive"))
    sag = rest(world, still(world))
    weightless = rest(world, still(world, gravity=0.0))
    assert sag[2] < -0.02
    assert_allclose(weightless, [0.2, 0.0, 0.0], atol=1e-8)
    double = FreeWorld(replace(heavy("passive"), gravity=(0.0, 0.0, -2.0 * 9.81)))
    twice = rest(world, still(world, gravity=2.0, payload=0.01))
    assert_allclose(twice, rest(double, still(double, payload=0.01)), atol=1e-7)


def test_gravity_acts_on_lumps_too():
    robot = heavy("passive")
    lumps = (Lump(at=0.2, mass=0.05),)
    robot = replace(robot, segments=(replace(robot.segments[0], lumps=lumps),))
    world, double = FreeWorld(robot), FreeWorld(replace(robot, gravity=(0.0, 0.0, -2.0 * 9.81)))
    assert_allclose(rest(world, still(world, gravity=0.0)), [0.2, 0.0, 0.0], atol=1e-8)
    assert_allclose(rest(world, still(world, gravity=2.0)), rest(double, still(double)), atol=1e-7)


def test_command_sets_the_tension():
    world = FreeWorld(heavy("tendon_tension"))
    pulled = rest(world, replace(still(world), tension=np.array([0.0, 2.0, 0.0, 0.0])))
    assert_allclose(world.rods[0].state.tension[0], [0.0, 2.0, 0.0, 0.0])
    assert abs(pulled[1]) > 0.01


@pytest.mark.parametrize(("name", "n_robots"), [("five_segment_reacher", 1), ("tdcr_b", 3)])
def test_jacobian_of_a_free_robot(name, n_robots):
    world = FreeWorld(load_robot(name), n_robots)
    actions = world.actions
    at = np.tile([0.0, 0.3, -0.2], world.robot.n_segments) * np.repeat(actions.offset, 3)
    at[-3] = 0.5 * world.robot.segments[-1].extension[1]

    def tip_at(action):
        return rest(world, replace(action_of(world, *action), tip_force=np.array([0.02, 0.0, 0.01])))

    n, extension = actions.n_actions, [segment.extension[1] for segment in world.robot.segments]
    columns = [j for j in range(n) if j % 3 or extension[j // 3]]
    steps = 1e-5 * np.eye(n)[columns]
    differences = [(tip_at(at + e) - tip_at(at - e)) / 2e-5 for e in steps]
    tip_at(at)
    jacobian = world.jacobian()
    assert jacobian.shape == (3, actions.n_actions)
    assert_allclose(jacobian[:, columns], np.transpose(differences), atol=2e-4 * np.abs(jacobian).max())


def test_robots_in_a_grid_are_driven_alike():
    world = FreeWorld(load_robot("prototype"), 7)
    world.drive(still(world, tip_force=np.array([0.05, 0.0, 0.0])))
    rods = world.rods[0]
    assert_allclose(rods.state.tip_position, np.tile(rods.state.tip_position[:1], (7, 1)), atol=1e-12)
    gaps = np.linalg.norm(rods.place[:, None] - rods.place[None], axis=2)[~np.eye(7, dtype=bool)]
    assert gaps.min() == pytest.approx(0.8 * 0.07)


def test_obstacle_follows_the_script_and_waits_for_commands():
    world = SceneWorld(load("draped"))
    low = world.poses()[0, 2]
    for _ in range(60):
        world.play()
    risen = world.poses()[0, 2]
    assert risen - low > 0.02
    for _ in range(5):
        world.drive(still(world))
    assert world.poses()[0, 2] == risen
    world.play()
    assert risen < world.poses()[0, 2] < risen + 0.002
    world.reset()
    assert world.poses()[0, 2] == low


def test_plane_is_a_square_beside_the_robot():
    (wall,) = SceneWorld(load("wall")).bodies
    pose = SceneWorld(load("wall")).poses()[0]
    corners = wall.vertices @ matrix_from_quaternion(pose[None, 3:])[0].T + pose[:3]
    assert_allclose(corners[:, 0], 0.02, atol=1e-7)
    assert_allclose(corners.mean(axis=0)[1:], [0.0, 0.035], atol=1e-7)
    assert_allclose(np.ptp(corners, axis=0)[1:], 1.5 * 0.07, rtol=1e-5)
    assert wall.opacity < 0.5


def test_world_goes_on_after_what_cannot_be_done():
    world = FreeWorld(load_robot("five_segment_reacher"))
    before, t = tip(world), world.t
    for wrong, sentence in (
        (replace(still(world), extension=np.full(5, 0.4)), "extension .* lies outside"),
        (replace(still(world), tendon_length=np.full(15, 0.9)), "tendon_length"),
        (still(world, base=np.full(6, np.nan)), "ManualCommand.base is"),
        (still(world, base=np.zeros(3)), "ManualCommand.base is"),
    ):
        with pytest.raises(InputError, match=sentence):
            world.drive(wrong)
        assert world.t == t
        assert_allclose(tip(world), before)
    jump = world.actions.inputs(np.tile([0.0, 0.01, -0.01], 5))
    force = np.array([0.3, 0.2, -0.2])
    world.drive(replace(still(world, tip_force=force), tendon_length=jump["tendon_length"]))
    assert np.isfinite(tip(world)).all()
    assert world.t > t
    with pytest.raises(InputError, match="not driven by tendon lengths"):
        FreeWorld(load_robot("ethz_beam")).jacobian()


def test_tracking_jacobian_against_the_model(shown):
    world = shown("track_circle")
    action = [0.015, 0.004, 0.002, 0.015, -0.003, 0.003]
    command = action_of(world, *action)
    rest(world, command, 40)
    jacobian = world.jacobian()
    assert jacobian.shape == (3, 6 + 6)
    arm, kinematics = world._stage.arm, world._stage.robot.kinematics
    q = np.concatenate([arm.position(), action])
    assert_allclose(jacobian, kinematics.finite_differences(q, 1e-5), atol=2e-3 * np.abs(jacobian).max())
    world.drive(replace(command, freeze=True))
    held = arm.position()
    rest(world, replace(command, freeze=True, base=along(0.1, 0.0, 0.0)), 10)
    assert_allclose(arm.position(), held, atol=1e-4)
    assert not world.jacobian()[:, :6].any()
    assert_allclose(world.jacobian()[:, 6:], jacobian[:, 6:], atol=1e-2 * np.abs(jacobian).max())


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("name", ["track_circle", "explore", "dual_arm"])
def test_command_moves_the_flange(name, shown):
    world = shown(name)
    stage = world._stage
    command = still(world)
    before = rest(world, command, 60)
    flange = stage.arm.frame(stage.arm.position())
    by = np.array([0.01, -0.02, 0.015])
    rest(world, replace(command, base=along(*by)), 60)
    assert_allclose(stage.arm.frame(stage.arm.position())[:3] - flange[:3], by, atol=2e-4)
    assert_allclose(tip(world) - before, by, atol=5e-4)
    bracket = (stage.robot if name == "track_circle" else stage).bracket
    place = world.poses()[[body.name for body in world.bodies].index(f"body {bracket.body}")]
    # it has come along
    assert_allclose(place[:3], stage.arm.frame(stage.arm.position())[:3], atol=1e-4)


def test_arm_stays_where_it_cannot_go_and_the_soft_robot_goes_on(shown):
    world = shown("track_circle")
    command = still(world)
    rest(world, command, 30)
    before = world._stage.arm.position()
    far = replace(action_of(world, 0.01, 0.0, 0.0, 0.01, 0.0, 0.0), base=along(3.0, 0.0, 0.0))
    t = world.t
    with pytest.raises(HostError, match=r"flange|no joint positions"):
        world.drive(far)
    assert world.t == pytest.approx(t + world.dt)
    assert world.rods[0].state.arclength[0, -1] == pytest.approx(0.22)
    assert_allclose(world._stage.arm.position(), before, atol=1e-4)
    rate = np.array([0.3, 0.0, 0.0, 0.0, 0.0, -0.5])
    rest(world, replace(command, base_rate=rate), 50)
    assert_allclose(world._stage.arm.position() - before, 50 * world.dt * rate, atol=2e-3)
    after = world._stage.arm.position()
    # from where a drag has brought the arm, the commanded base continues
    rest(world, replace(command, base=far.base), 5)
    assert_allclose(world._stage.arm.position(), after, atol=2e-3)
    with pytest.raises(InputError, match="extension"):
        world.drive(replace(command, extension=np.array([0.5, 0.0])))
    world.play()
    assert world.t == 0.0  # the script begins anew


def test_other_rods_keep_their_inputs(shown):
    world = shown("dual_arm")
    second = world.rods[1].state.path_length.copy()
    rest(world, action_of(world, 0.0, 0.004, 0.0, 0.0, 0.0, 0.004), 30)
    assert_allclose(world.rods[1].state.path_length, second, atol=1e-4)
    assert np.abs(world.rods[0].state.path_length - second).max() > 1e-3


def test_pictures_and_scripts_without_a_command(shown):
    explore, pick = shown("explore"), shown("pick_suction")
    picture = explore.picture()
    assert picture.shape == (120, 160, 3)
    assert picture.dtype == np.uint8
    assert np.ptp(picture) > 0
    assert pick.picture() is None
    assert (pick.drivable, pick.host, pick.base_moves, pick.loads) == (False,) * 4
    assert not any("Capsule" in body.name for body in pick.bodies)
    with pytest.raises(InputError, match="cannot be driven by hand"):
        pick.drive(still(pick))
    with pytest.raises(InputError, match="no Jacobian"):
        pick.jacobian()


@pytest.mark.study
def test_rods_capsules_are_no_bodies(shown):
    world = shown("neck_push")
    numbers = {int(body.name.split()[1]) for body in world.bodies}
    assert not numbers & set(world._stage.rod.bodies.ids)
    assert world._stage.cube in numbers
    assert not world.host
    assert world.drivable


def test_close_disconnects():
    world = open_world("track_circle")
    number = world._stage.world.number
    world.reset()
    bullet = world._stage.world
    assert bullet.number == number  # it was free again
    assert bullet.isConnected()
    world.close()
    world.close()
    assert not bullet.isConnected()
    with pytest.raises(HostError, match="disconnected"):
        world.drive(still(world))
    world.close()


def test_catalogue_says_what_the_scenes_say():
    listed = catalogue()
    assert set(listed) == {*names(), *robot_names()}
    assert list(listed)[: len(robot_names())] == robot_names()
    assert all(load(name).about == listed[name] for name in names())
    assert all(sentence.endswith(".") for sentence in listed.values())
    assert not set(ROD_SCENES) & set(HOSTED_SCENES)


def test_world_of_a_robot_a_path_and_a_wrong_name(tmp_path):
    robot = replace(load_robot("prototype"), name="mine")
    save_robot(robot, tmp_path / "mine.toml")
    assert open_world(str(tmp_path / "mine.toml")).robot == robot
    assert open_world(robot).name == "mine"
    assert about(robot) == "One segment, 0.07 m, driven by the lengths of its tendons."
    for name, nearest in (
        ("explor", "no scene and no robot 'explor'; did you mean 'explore'"),
        ("tdrc_a", "did you mean 'tdcr_a'"),
    ):
        with pytest.raises(UnknownNameError, match=nearest):
            open_world(name)
    with pytest.raises(RobotError, match="cannot be read"):
        open_world(tmp_path / "none.toml")


def test_without_pybullet_a_hosted_scene_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(HostError, match=r"pip install 'fastrod\[hosts\]'"):
        open_world("track_circle")
    assert isinstance(open_world("wall"), SceneWorld)


def test_sway_of_a_passive_robot_is_periodic():
    beam = load_robot("ethz_beam")
    first, last = sway(beam, None, 0.3)["tip_force"], sway(beam, None, 0.3 + 2.0 * np.pi)["tip_force"]
    assert_allclose(first, last, atol=1e-12)
    assert np.linalg.norm(first) > 0.0


def test_grid_of_robots_is_drawn_where_it_stands():
    world = SceneWorld(load("grid"))
    bases = world.rods[0].state.position[:, 0]
    assert len(np.unique(bases.round(6), axis=0)) == 64
    assert not world.rods[0].place.any()
    world.drive(still(world, base=along(0.1, 0.0, 0.0)))
    assert_allclose(world.rods[0].state.position[:, 0] - bases, np.tile([0.1, 0.0, 0.0], (64, 1)), atol=1e-12)
    assert world.jacobian().shape == (3, 15)


@pytest.mark.study
def test_hosted_view_resets_where_its_script_ends(shown):
    world = shown("neck_push")
    assert isinstance(world, HostedView)
    first = tip(world)
    world._steps = round(world.duration / world.dt)
    world.play()
    assert world.t == 0.0
    assert_allclose(tip(world), first, atol=1e-6)
