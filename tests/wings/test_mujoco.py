"""A MuJoCo body carries a rod: what its joints feel, whose forces are whose, what the capsules meet."""

import dataclasses
import sys

import mujoco
import numpy as np
import pytest
from bullets import clearance_of, soft_robot
from numpy.testing import assert_allclose
from refusals import refusals
from scipy.spatial.transform import Rotation

import fastrod.hosts
from fastrod.errors import HostError, InputError, RobotError
from fastrod.hosts import MujocoBody, MujocoRod, add_capsules
from fastrod.hosts.mujoco_body import com_motion, refresh
from fastrod.hosts.mujoco_body_contact import MujocoBodyContact
from fastrod_scenes.ur5.mujoco_arm import JOINTS, MujocoArm, arm_spec

MOUNT = {"position": (0.02, 0.01, 0.05), "quaternion": (0.5, 0.5, -0.5, 0.5)}
BALL = '<body name="ball" pos="0.024 0 0.15"><freejoint/><geom type="sphere" size="0.02" mass="0.05"/></body>'
SLIDING = BALL.replace("0.024 0 0.15", "0.033 0 0.15").replace(
    "<freejoint/>", '<joint type="slide" axis="1 0 0"/>'
)
POST = (
    '<body name="post" pos="0 0 0"><geom type="box" size=".01 .01 .01" contype="0" conaffinity="0"/></body>'
)


def spec_of(inside, gravity=0.0, dt=0.005):
    return mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="{dt}" gravity="0 0 {-gravity}"/><worldbody>{inside}</worldbody></mujoco>'
    )


def moving_arm(seed, dt=0.001):
    """A UR5 without servos in motion, with capsules for a rod on its flange."""
    spec = arm_spec(dt)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION | mujoco.mjtDisableBit.mjDSBL_DAMPER
    robot = soft_robot(line_density=0.8)
    add_capsules(spec, robot, "tool0")
    model = spec.compile()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    data.qpos[:], data.qvel[:] = rng.uniform(-1.0, 1.0, 6), 0.3 * rng.normal(size=6)
    return robot, model, data


@pytest.mark.parametrize("seed", [0, 1])
def test_joints_feel_the_wrench_through_the_transposed_jacobian(seed):
    # M dq'/dt with the rod, less that without it, is J^T F about the base point
    robot, model, data = moving_arm(seed)
    free = mujoco.MjData(model)
    free.qpos[:], free.qvel[:] = data.qpos, data.qvel
    mujoco.mj_step(model, free)
    start = data.qvel.copy()
    rod = MujocoRod(robot, model, data, "tool0", **MOUNT)
    rod.settle(tendon_length=robot.rest_tendon_length + np.array([-2, 1, 2, -1, 1, 0, -1, 0]) * 1e-3)
    point = rod.host.motion().pose[:3]
    rod.begin(tip_force=(0.5, 0.2, -0.3), tip_moment=(0.01, 0.02, -0.01))
    mujoco.mj_forward(model, data)
    mass, by_point, by_angle = np.zeros((6, 6)), np.zeros((3, 6)), np.zeros((3, 6))
    mujoco.mj_fullM(model, data, mass)
    mujoco.mj_jac(model, data, by_point, by_angle, point, rod.host.body)
    mujoco.mj_step(model, data)
    felt = mass @ (data.qvel - free.qvel) / rod.dt
    expected = np.concatenate([by_point, by_angle]).T @ rod.wrench
    assert np.abs(data.qvel - start).max() > 0.0
    assert np.abs(expected).max() > 0.1
    assert_allclose(felt, expected, atol=1e-8 * np.abs(expected).max())


def test_motion_of_the_base_is_the_derivative_of_its_pose():
    _, model, data = moving_arm(3)
    link, h, q, rate = MujocoBody(model, data, "tool0", **MOUNT), 1e-5, data.qpos.copy(), data.qvel.copy()

    def pose(t):
        data.qpos[:] = q + t * rate
        return link.motion().pose

    after, before, now = pose(h), pose(-h), (pose(0.0), link.motion())[1]
    assert_allclose((after - before)[:3] / (2 * h), now.velocity[:3], atol=1e-8)
    end, start = (Rotation.from_quat(np.roll(pose[3:], -1)) for pose in (after, before))
    assert_allclose((end * start.inv()).as_rotvec() / (2 * h), now.velocity[3:], atol=1e-8)


def test_motion_is_that_of_the_joints_now_and_not_of_the_last_steps_start():
    spec = spec_of('<body name="cart"><joint type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/></body>')
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[0] = 2.0
    mujoco.mj_step(model, data)
    assert data.xpos[1, 0] == 0.0
    assert_allclose(MujocoBody(model, data, "cart").motion().pose[:3], [0.01, 0.0, 0.0])


def test_forces_of_others_stay_and_the_rods_own_go():
    spec = spec_of('<body name="cart"><freejoint/><geom size="0.1" mass="1"/></body>')
    robot = soft_robot()
    for name in ("left", "right"):
        add_capsules(spec, robot, "cart", name=name)
    model = spec.compile()
    data = mujoco.MjData(model)
    cart = model.body("cart").id
    others = np.array([0.3, -0.2, 0.1, 0.01, 0.02, -0.03])
    data.xfrc_applied[cart] = others
    rods = [MujocoRod(robot, model, data, "cart", name=name) for name in ("left", "right")]
    before, both = data.qvel[:3].copy(), others[:3] + np.array([1.0, 2.0, 0.0])
    for rod, force in zip(rods, ((1.0, 0.0, 0.0), (0.0, 2.0, 0.0)), strict=True):
        rod.begin(tip_force=force)
    assert_allclose(data.xfrc_applied[cart, :3], both, atol=1e-7)
    mujoco.mj_step(model, data)
    for rod in rods:
        rod.end()
    assert_allclose(data.qvel[:3] - before, 0.005 * both, atol=1e-9)
    assert_allclose(data.xfrc_applied[cart], others, atol=1e-15)
    rods[0].step()
    rods[0].step()
    assert_allclose(data.xfrc_applied[cart], others, atol=1e-15)
    rods[0].begin()
    data.xfrc_applied[:] = 0.0  # somebody clears everything
    rods[0].end()
    assert not data.xfrc_applied.any()


def test_every_geom_is_an_obstacle_where_it_is():
    hull = np.random.default_rng(8).normal(size=(40, 3)) * 0.03
    spec = spec_of('<body name="probe" mocap="true"><geom name="probe" size="0.001"/></body>')
    spec.add_mesh(name="hull", uservert=hull.ravel())
    kinds = mujoco.mjtGeom
    shapes = {
        "box": (kinds.mjGEOM_BOX, [0.01, 0.02, 0.03]),
        "sphere": (kinds.mjGEOM_SPHERE, [0.03, 0, 0]),
        "cylinder": (kinds.mjGEOM_CYLINDER, [0.02, 0.025, 0]),
        "capsule": (kinds.mjGEOM_CAPSULE, [0.02, 0.025, 0]),
        "ellipsoid": (kinds.mjGEOM_ELLIPSOID, [0.02, 0.01, 0.03]),
        "mesh": (kinds.mjGEOM_MESH, [0, 0, 0]),
    }
    for name, (kind, size) in shapes.items():
        body = spec.worldbody.add_body(name=name, pos=[0.1, 0.2, 0.3], quat=[0.9, 0.1, -0.3, 0.3])
        body.add_freejoint()
        # moves the centre of mass
        body.add_geom(size=[0.005, 0, 0], pos=[0.0, 0.03, 0.0], mass=0.3, contype=0, conaffinity=0)
        own = body.add_geom(
            name=name, type=kind, size=size, pos=[0.01, 0.0, 0.0], quat=[0.8, 0.6, 0.0, 0.0], mass=0.2
        )
        if name == "mesh":
            own.meshname = "hull"
    model = spec.compile()
    data = mujoco.MjData(model)
    refresh(model, data)
    for name in shapes:
        body, geoms = model.body(name).id, (model.geom("probe").id, model.geom(name).id)
        contact = MujocoBodyContact(model, data, body, dt=0.005, friction=0.3)
        assert [shape.obstacle.shape for shape in contact.shapes] == [name]
        clearance, points = clearance_of(contact)
        ends = []
        for point in points:
            data.mocap_pos[0] = point
            refresh(model, data)
            ends.append(mujoco.mj_geomDistance(model, data, *geoms, 1.0, None))
        assert min(ends) > 0.0
        assert 0.0 < clearance <= min(ends) + 1e-5
        assert_allclose(contact.com().pose[:3], com_motion(model, data, body).pose[:3])


def stand(ball=BALL, **options):
    """A straight rod on a post, and a ball that its capsules may meet."""
    spec, robot = spec_of(POST + ball), soft_robot()
    add_capsules(spec, robot, "post", contact_bodies=options.get("contact_bodies", ()))
    model = spec.compile()
    data = mujoco.MjData(model)
    return MujocoRod(robot, model, data, "post", **options), model, data


@pytest.mark.study
def test_contacts_of_the_capsules_are_read_back():
    rod, model, data = stand(SLIDING)
    data.xfrc_applied[model.body("ball").id, 0] = -0.05  # presses the ball on the rod
    for _ in range(600):
        rod.step()
    felt = rod.felt
    assert set(felt.body) == {model.body("ball").id}
    # the ball rests, so the rod bears what presses it; at the height of its middle, on the rod's surface
    assert_allclose(felt.force.sum(0), [-0.05, 0.0, 0.0], atol=1e-4)
    assert_allclose(rod.contact_force.sum(0), felt.force.sum(0))
    assert_allclose(felt.arclength, 0.15, atol=2e-3)
    assert_allclose(felt.point[:, 0], 0.012, atol=1e-3)
    assert (np.abs(rod.wrench) < 1e-9).all()  # the rod itself knows nothing of it


def test_capsules_of_another_robot_are_refused():
    spec, robot = spec_of(POST), soft_robot(1)
    add_capsules(spec, robot, "post")
    model = spec.compile()
    segments = tuple(dataclasses.replace(s, length=1.5 * s.length) for s in robot.segments)
    longer = dataclasses.replace(robot, segments=segments)
    sentence = (
        r"^capsule 0 of 'rod' has radius 0.012 m and half length 0.005 m, where this robot has 0.012 "
        r"m and 0.0075 m; they were added"
    )
    with pytest.raises(HostError, match=sentence):
        MujocoRod(longer, model, mujoco.MjData(model), "post")
    assert MujocoRod(robot, model, mujoco.MjData(model), "post").step().ok[0]


def test_rod_can_be_taken_out_of_the_model():
    rod, model, data = stand()
    rod.step()
    rod.remove()
    data.xfrc_applied[model.body("ball").id, 0] = -0.05
    for _ in range(200):
        mujoco.mj_step(model, data)
    assert data.body("ball").xpos[0] < -0.1


def test_rod_stands_on_the_world_too():
    spec, robot = spec_of("", gravity=9.81), soft_robot(line_density=0.5)
    add_capsules(spec, robot, "world")
    model = spec.compile()
    rod = MujocoRod(robot, model, mujoco.MjData(model), 0, position=(0.1, 0.2, 0.3))
    assert_allclose(rod.step().position[0, 0], [0.1, 0.2, 0.3])
    assert rod.wrench[2] == pytest.approx(-0.5 * 0.2 * 9.81)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY
    rod.step()
    assert rod.wrench[2] == pytest.approx(0.0, abs=1e-12)


def test_servos_hold_the_arm_where_it_is_commanded():
    spec = arm_spec(0.005)
    model = spec.compile()
    data = mujoco.MjData(model)
    arm, q = MujocoArm(model, data), np.array([0.1, -1.2, 1.4, -1.7, -1.5, 0.3])
    arm.place(q)
    for _ in range(50):
        mujoco.mj_step(model, data)
    assert_allclose(arm.position(), q, atol=1e-9)  # its weight is balanced
    assert np.abs(arm.torque()).max() < 1e-4
    with pytest.raises(
        InputError, match=rf"^q has shape \(2,\); it must be \(6,\), one angle for each of {JOINTS[0]}"
    ):
        arm.drive([0, 0])


def capsules(**options):
    return lambda spec: add_capsules(**{"spec": spec, "robot": soft_robot(1), "host": "post"} | options)


CAPSULE_INPUT = {
    r"^'a' capsules a segment; give at least one, a whole number\.$": capsules(capsules_per_segment="a"),
    r"^0 capsules a segment; give at least one, a whole number\.$": capsules(capsules_per_segment=0),
    r"^2.5 capsules a segment; give at least one": capsules(capsules_per_segment=2.5),
    r"^True capsules a segment; give at least one": capsules(capsules_per_segment=True),
    r"^color has shape \(2,\); it must be \(4,\), red, green, blue, opacity, from 0 to 1\.$": capsules(
        color=(1, 2)
    ),
    r"^head_color is not an array of numbers; give \(4,\), red, green": capsules(head_color="red"),
    r"^friction is nan; it must be a number, zero or positive and finite\.$": capsules(friction=np.nan),
    r"^friction is -1; it must be a number, zero or positive and finite\.$": capsules(friction=-1),
}
CAPSULE_HOSTS = {
    r"^contact_bodies is 'ball'; give a list of bodies, as contact_bodies=\['ball'\]\.$": capsules(
        contact_bodies="ball"
    ),
    r"^spec is a str; give a mujoco.MjSpec": capsules(spec="arm.xml"),
    r"^the spec has no body 'pst'; did you mean 'post'\?": capsules(host="pst"),
}
CAPSULE_ROBOTS = {
    r"^robot is 'prototype'; give one Robot, for example fastrod.load_robot\('prototype'\)\.$": capsules(
        robot="prototype"
    )
}


@refusals({InputError: CAPSULE_INPUT, HostError: CAPSULE_HOSTS, RobotError: CAPSULE_ROBOTS})
def test_capsules_that_no_model_can_have_are_a_sentence(error, sentence, call):
    spec = spec_of(POST + BALL)
    with pytest.raises(error, match=sentence):
        call(spec)
    assert len(spec.bodies) == 3  # world, post, ball: nothing was added


GHOST = '<body name="ghost"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>'


@pytest.fixture(scope="module")
def scene():
    """A spec with the capsules of a rod, its model, and its data."""
    spec = spec_of(POST + BALL + GHOST)
    add_capsules(spec, soft_robot(), "post")
    model = spec.compile()
    return spec, model, mujoco.MjData(model)


def mounted(**options):
    """A rod on the post of the scene, with other options."""

    def mount(spec, model, data):
        MujocoRod(**{"robot": soft_robot(), "model": model, "data": data, "body": "post"} | options)

    return mount


def felt(inside, body):
    """Bodies of a model that a rod may touch."""
    spec = spec_of(inside)
    spec.add_hfield(name="hill", nrow=2, ncol=2, size=[1, 1, 1, 1], userdata=[0, 0, 0, 1])
    hill = spec.worldbody.add_body(name="hill")
    hill.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="hill")
    model = spec.compile()
    data, number = mujoco.MjData(model), model.body(body).id
    MujocoBodyContact(model, data, number, dt=0.005, friction=0.3)


def without_capsules():
    model = spec_of(POST).compile()
    return {"model": model, "data": mujoco.MjData(model)}


NOT_THERE = {
    (
        r"^the model has no capsules of a rod 'rod'; "
        r"call add_capsules\(\.\.\., name='rod'\) on its spec"
    ): mounted(**without_capsules()),
    r"^the model has a body 'rod 0' already; give each rod a name of its own": lambda spec, *_: add_capsules(
        spec, soft_robot(), "post"
    ),
    r"^the model has no body 'pots'; did you mean 'post'\?": mounted(body="pots"),
    r"^body is 99; give the name of a body, or its number from 0 \(the world\) to 23\.$": mounted(body=99),
    (
        r"^the capsules of 'rod' collide with 'ball', .*; "
        r"name it in add_capsules\(\.\.\., contact_bodies=\[\.\.\.\]\) too\.$"
    ): mounted(contact_bodies=["ball"]),
    r"^contact_bodies is 'ball'; give a list of bodies": mounted(contact_bodies="ball"),
    r"^the 20 capsules of 'rod' do not fit 3 segments; they were added for another robot\.$": mounted(
        robot=soft_robot(3)
    ),
    r"^the data are of another model: 2 bodies, where this one has 24\.$": mounted(
        data=without_capsules()["data"]
    ),
    r"^model and data are str and MjData; give a mujoco.MjModel and its MjData\.$": mounted(model="model"),
    r"^body 'ghost' has no geom that collides, so nothing can touch it\.$": lambda *_: felt(GHOST, "ghost"),
    r"^geom 0 of 'hill' is of the kind hfield, which a rod cannot touch": lambda *_: felt("", "hill"),
}
BAD_INPUT = {"^the mount has a quaternion of norm 1.41421; it must be 1": mounted(quaternion=(1, 1, 0, 0))}
NO_ROBOT = {r"^robot is 'prototype'; give one Robot": mounted(robot="prototype")}


@refusals({HostError: NOT_THERE, InputError: BAD_INPUT, RobotError: NO_ROBOT})
def test_what_is_not_there_is_a_sentence(scene, error, sentence, call):
    with pytest.raises(error, match=sentence):
        call(*scene)


def test_a_rod_that_is_reset_pulls_no_more():
    rod, _, _ = stand()
    rod.step(tip_force=(0.1, 0.0, 0.0))
    assert rod.wrench.any()
    rod.reset()
    assert not rod.wrench.any()


def test_without_mujoco_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    sentence = r"^MuJoCo is not installed; pip install 'fastrod\[mujoco\]' brings it\.$"
    with pytest.raises(HostError, match=sentence):
        fastrod.hosts.add_capsules(None, soft_robot(), "post")
