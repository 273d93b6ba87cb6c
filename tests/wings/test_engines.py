"""The same rod, host and cubes in PyBullet and in MuJoCo keep to the same physics."""

from dataclasses import replace

import numpy as np
import pytest
from bullets import soft_robot
from engines import BEYOND, ENGINES, MASS, RADIUS, SIZE, SPEED, Cube
from numpy.testing import assert_allclose

import fastrod
from fastrod.contact import ContactScene, plane
from fastrod.errors import HostError, InputError
from fastrod.model.robotfile import dumps, loads
from fastrod.rotation import matrix_from_quaternion
from fastrod.simulator import Simulator

pytestmark = pytest.mark.parametrize("stage", list(ENGINES.values()), ids=list(ENGINES))


def test_hanging_rod_weighs_on_its_base(stage):
    robot = soft_robot(line_density=0.8)
    down = stage(robot, axis="-z", gravity=9.81)
    down.rod.step()
    assert_allclose(down.rod.wrench, [0, 0, -0.8 * robot.length * 9.81, 0, 0, 0], atol=1e-9)
    sideways = stage(robot, axis="x", gravity=9.81)
    sideways.rod.settle()
    state = sideways.rod.step()
    # the moment of the weight is that of the mass where it hangs: integral of x rho g ds
    lever = 0.8 * 9.81 * np.trapezoid(state.position[0, :, 0], state.arclength[0])
    # trapezoid of 21 nodes on a curve: (h / L)^2
    assert sideways.rod.wrench[4] == pytest.approx(lever, rel=1e-4)


def test_weight_is_that_of_the_world_as_it_is_now(stage):
    robot = soft_robot(line_density=0.8)
    mass = 0.8 * robot.length
    s = stage(robot, axis="-z", dynamics=False)
    s.rod.step()
    assert_allclose(s.rod.wrench, 0.0, atol=1e-12)  # the robot's own is for robots that stand free
    for gravity in ((0.0, 0.0, -1.62), (0.3, -0.2, -9.81), (0.0, 0.0, 0.0)):
        s.set_gravity(gravity)
        s.rod.step()
        assert_allclose(s.rod.wrench[:3], mass * np.array(gravity), atol=1e-9)
    with pytest.raises(InputError, match=r"^a mounted rod has no input 'gravity'; the host gives it$"):
        s.rod.step(gravity=(0.0, 0.0, -9.81))


def stating(gravity, line_density=0.8):
    """A robot whose file states its gravity."""
    text = dumps(soft_robot(line_density=line_density))
    return loads(f"{text}\n[world]\ngravity = {list(gravity)}\n")


@pytest.mark.parametrize("gravity", [(0.0, 0.0, -9.81), (0.0, -3.0, 0.0)])
def test_a_robot_that_states_another_gravity_is_not_mounted(stage, gravity):
    with pytest.raises(HostError) as caught:
        stage(stating(gravity), gravity=1.62)
    said = str(caught.value).replace("-0.0", "0.0")
    assert f"'soft' states gravity {list(gravity)} m/s^2" in said
    assert "the world of its host has [0.0, 0.0, -1.62]" in said
    assert "leave [world] gravity out of the robot file, or set" in said
    assert stage(stating(gravity, line_density=0.0), gravity=1.62).rod.step().ok[0]  # it weighs nothing
    assert stage(stating((0.0, 0.0, -1.62)), gravity=1.62).rod.step().ok[0]


@pytest.mark.study(beyond=1)
def test_a_load_that_no_rod_holds_leaves_the_shape(stage):
    robot = fastrod.load_robot("five_segment_reacher")
    s = stage(robot, axis="x")
    rest = s.rod.step()
    for _ in range(4):
        state = s.rod.step(tip_force=(0.0, 0.0, -500.0))
        assert not state.ok[0]
        assert "give less load" in state.problems[0]
        assert (state.path_length < 1.01 * robot.length).all()
        assert_allclose(state.position, rest.position, atol=1e-6)
    assert_allclose(s.rod.wrench, 0.0, atol=1e-6)
    assert s.rod.step(tip_force=(0.0, 0.0, 0.0)).ok[0]


def test_rod_follows_a_host_that_moves(stage):
    # a base that moves at a constant velocity is where the rod expects it: the shape is that at rest, carried
    # along
    robot = soft_robot()
    s = stage(robot)
    pulled = robot.rest_tendon_length + np.array([-3, 0, 3, 0, -6, 2, 6, -2]) * 1e-3
    rest = s.rod.settle(tendon_length=pulled).tip_position[0]
    for k in range(20):
        s.move([0.2 * k * s.dt, 0.0, 0.1 * k * s.dt], [0.2, 0.0, 0.1])
        state = s.rod.step()
    assert_allclose(state.tip_position[0], rest + 20 * s.dt * np.array([0.2, 0.0, 0.1]), atol=1e-6)


@pytest.mark.study(beyond=1)
def test_still_wall_is_felt_by_the_host_as_the_simulator_has_it(stage):
    robot = soft_robot(damping_time=0.02)
    s = stage(robot, axis="z", cubes=[Cube(0.4, 0.0, [0.07 + 0.2, 0.0, 0.1])], friction=0.0)
    s.rod.settle()
    scene = ContactScene(obstacles=[plane(point=(0.07, 0, 0), normal=(-1, 0, 0), name="w")])
    alone = Simulator(robot, dt=s.dt, points_per_segment=10, contact=scene)
    for k in range(110):  # it creeps there
        pull = robot.rest_tendon_length + 0.0002 * min(k, 40) * np.array([-1, 0, 1, 0, -2, 0, 2, 0])
        state, expected = s.rod.step(tendon_length=pull), alone.step(pull)
    assert state.ok[0]
    assert s.rod.wrench[0] < -0.1
    assert_allclose(s.rod.wrench, expected.base_wrench[0], atol=1e-6)
    assert_allclose(state.tip_position, expected.tip_position, atol=1e-6)
    if stage is ENGINES["pybullet"]:
        assert len(s.world.getContactPoints(s.rod.bodies.ids[-1], s.cubes[0])) == 0  # one contact, not two


def test_body_that_overlaps_the_mounting_is_felt_where_it_is(stage):
    mounting = 1.5 * RADIUS
    world = stage(soft_robot(), cubes=[Cube(SIZE, MASS, (mounting - RADIUS - 0.002 - SIZE / 2, 0.0, 0.0))])
    for _ in range(2):  # in the first step the capsules are not there yet
        state = world.rod.step()
        assert state.contacts.clearance[0] == pytest.approx(0.002, abs=1e-9)
    assert not world.velocity().any()


@pytest.mark.study(beyond=1)
def test_body_on_a_floor_is_pressed_as_one_that_is_fixed(stage):
    # what the floor does to it the rod only knows from the step before
    robot, lowest = soft_robot(line_density=0.05, damping_time=0.05), -(0.2 + RADIUS + 0.002 + SIZE)
    bent = robot.rest_tendon_length + 0.0015 * np.resize([1.0, 0.0, -1.0, 0.0], robot.n_tendons)
    cubes = [Cube(SIZE, MASS, (0, 0, lowest + SIZE / 2))]
    s = stage(robot, dt=0.01, axis="-z", gravity=9.81, cubes=cubes, floor=lowest, friction=0.0)
    for k in range(60):
        s.move([0, 0, -2e-4 * min(k, 30)], [0, 0, -0.02 * (k < 30)])
        s.rod.step(tendon_length=bent)
    pressed = s.rod.body_contacts[0]
    still = Simulator(robot, contact=ContactScene(obstacles=[pressed.shapes[0].obstacle])).settle(
        bent, base_pose=s.rod.rod.base, gravity=(0, 0, -9.81), obstacle_pose=pressed.now()
    )
    assert pressed.exerted[2] < -0.4
    assert_allclose(pressed.exerted[:3], still.contacts.wrench[0, 0, :3], rtol=0.002, atol=1e-4)


def test_touched_body_may_be_put_somewhere_else(stage):
    s = stage(soft_robot(), cubes=[Cube(SIZE, MASS, [BEYOND, 0.0, 0.0])])
    s.rod.settle()
    for k in range(20):
        s.move([SPEED * k * s.dt, 0.0, 0.0], [SPEED, 0.0, 0.0])
        s.rod.step()
    assert np.linalg.norm(s.velocity()[:3]) > 0.9 * SPEED
    s.put(0, [2.0, 0.0, 0.0])
    s.rod.reset()
    s.rod.step()
    assert np.abs(s.rod.wrench).max() < 1e-9
    assert np.abs(s.velocity()).max() == 0.0


def test_step_that_cannot_be_solved_keeps_action_and_reaction(stage, monkeypatch):
    s = stage(soft_robot(), cubes=[Cube(SIZE, MASS, [BEYOND, 0.0, 0.0])])
    s.rod.settle()
    impulse, solved, failed = np.zeros(3), s.rod.simulator.step, {"ok": np.array([False])}
    for k in range(30):
        s.move([SPEED * k * s.dt, 0.0, 0.0], [SPEED, 0.0, 0.0])
        if k == 8:  # while it presses
            monkeypatch.setattr(s.rod.simulator, "step", lambda *a, **b: replace(solved(*a, **b), **failed))
        elif k == 10:
            monkeypatch.undo()
        s.rod.step()
        impulse += s.dt * s.rod.wrench[:3]
    assert np.linalg.norm(impulse) > 0.5 * MASS * SPEED
    assert_allclose(MASS * s.velocity()[:3], -impulse, atol=1e-9)


def test_capsules_push_what_the_rod_has_no_contact_with_and_nothing_twice(stage):
    gap = Cube(SIZE, MASS, [BEYOND - 0.01, 0.0, 0.0])  # 8 mm in the capsules, and nobody moves
    alone, touched = stage(soft_robot(), cubes=[gap], contact_bodies=False), stage(soft_robot(), cubes=[gap])
    pushed = np.zeros(3)
    for _ in range(3):
        alone.rod.step()
        touched.rod.step()
        pushed += touched.dt * touched.rod.wrench[:3]
    assert alone.velocity()[0] > 0.0
    assert np.abs(alone.rod.wrench).max() < 1e-9
    assert_allclose(MASS * touched.velocity()[:3], -pushed, atol=1e-9)
    # out of it in one step, though the force is beyond what buckles the rod
    assert touched.velocity()[0] == pytest.approx(0.008 / touched.dt, rel=1e-3)


def test_time_step_that_changes_is_a_sentence(stage):
    s = stage(soft_robot())
    s.rod.step()
    s.set_dt(0.002)
    sentence = r"time step is now 0.002 s, and the rod was mounted for 0.005 s; .*mount it anew\."
    with pytest.raises(HostError, match=sentence):
        s.rod.step()


def test_bad_input_is_not_kept(stage):
    s = stage(soft_robot())
    s.rod.step(tip_force=(0.01, 0.0, 0.0))
    for sentence, bad in {
        "tip_force holds a value that is not finite": {"tip_force": (0.0, 0.0, float("nan"))},
        "^a mounted rod has no input 'base_pose'; the host gives it$": {"base_pose": (0, 0, 0, 1, 0, 0, 0)},
        r"^a mounted rod has no input 'tendon_lenght'; did you mean 'tendon_length'\?$": {"tendon_lenght": 0},
    }.items():
        with pytest.raises(InputError, match=sentence):
            s.rod.step(**bad)
    s.rod.step()
    assert_allclose(s.rod.wrench[:3], [0.01, 0.0, 0.0], atol=1e-9)


def test_rod_that_stays_lost_is_reported(stage, monkeypatch):
    s = stage(soft_robot(), cubes=[Cube(SIZE, MASS, [1.0, 0.0, 0.0])])
    lost = replace(s.rod.step(), ok=np.array([False]), problems={0: "contact: it stands."})
    for direction in ("step", "settle"):
        monkeypatch.setattr(s.rod.simulator, direction, lambda *a, **b: lost)
    for _ in range(25):
        assert not s.rod.step().ok[0]
    sentence = (
        r"^26 steps in a row could not be solved, the last: contact: it stands\. Move .*call reset\(\)\.$"
    )
    with pytest.raises(HostError, match=sentence):
        s.rod.step()


@pytest.mark.parametrize("option", [{"friction": -1}, {"friction": float("nan")}])
def test_contact_options_are_checked(stage, option):
    with pytest.raises(InputError, match=r"it must be a number, zero or positive and finite\."):
        stage(soft_robot(), **option)


def test_end_before_begin_is_a_sentence(stage):
    with pytest.raises(HostError, match=r"^end\(\) comes after begin\(\)"):
        stage(soft_robot()).rod.end()


def test_capsules_lie_along_the_backbone(stage):
    robot = soft_robot()
    s = stage(robot, axis="z", capsules_per_segment=5)
    s.rod.settle(tendon_length=robot.rest_tendon_length + np.array([-8, 0, 8, 0, -8, -5, 8, 5]) * 1e-3)
    capsules, nodes = s.rod.rod.capsules, s.rod.state.position[0, ::2]
    assert_allclose(capsules.ends, np.stack([nodes[:-1], nodes[1:]], axis=1), atol=1e-12)
    if s.__class__ is ENGINES["mujoco"]:
        pose = s.data.mocap_pos[s.rod._mocap], s.data.mocap_quat[s.rod._mocap]
    else:
        found = [s.world.getBasePositionAndOrientation(body) for body in s.rod.bodies.ids]
        pose = np.array([p for p, _ in found]), np.roll([q for _, q in found], 1, axis=1)
    assert_allclose(pose[0], capsules.center, atol=1e-7)
    assert_allclose(matrix_from_quaternion(pose[1]), matrix_from_quaternion(capsules.quaternion), atol=1e-6)
