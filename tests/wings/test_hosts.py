"""A PyBullet body carries a rod: where the base is, how it moves, and what the joints feel."""

import gc
from dataclasses import replace

import numpy as np
import pytest
from bullets import carrier, cube, empty_world, kuka, soft_robot
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals

from fastrod.errors import HostError, InputError
from fastrod.hosts import Bullet, BulletLink, MountedRod, RodBodies, connect
from fastrod.hosts.link import from_xyzw, link_motion, to_xyzw
from fastrod.rotation import matrix_from_quaternion, product, quaternion_from_matrix, quaternion_from_vector
from fastrod.simulator import Simulator

MOUNT = {"position": (0.02, 0.01, 0.05), "quaternion": (0.5, 0.5, -0.5, 0.5)}


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_joints_feel_the_wrench_through_the_transposed_jacobian(seed):
    # M dq'/dt with the rod, less that without it, is J^T F; PyBullet keeps poses in single precision, so 1e-7
    # is what it has
    world = empty_world(dt=0.001)
    arm, q, rate = kuka(world, seed)
    n = len(q)
    link = BulletLink(world, arm, n - 1, **MOUNT)
    robot = soft_robot(line_density=0.8)
    rod = MountedRod(robot, link, dynamics=False)
    rod.settle(tendon_length=robot.rest_tendon_length + np.array([-2, 1, 2, -1, 1, 0, -1, 0]) * 1e-3)
    mass, start = np.array(world.calculateMassMatrix(arm, q.tolist())), world.saveState()

    def rates():
        world.stepSimulation()
        return np.array([world.getJointState(arm, j)[1] for j in range(n)])

    free = rates()
    world.restoreState(start)
    point = link.motion().pose[:3]
    rod.begin(tip_force=(1.5, 0.6, -0.9), tip_moment=(0.01, 0.02, -0.01))
    felt = mass @ (rates() - free) / world.dt
    world.restoreState(start)
    _, _, _, _, frame, rotation = world.getLinkState(arm, n - 1, computeForwardKinematics=1)[:6]
    local, _ = world.multiplyTransforms(*world.invertTransform(frame, rotation), point.tolist(), [0, 0, 0, 1])
    by_rate = np.concatenate(world.calculateJacobian(arm, n - 1, local, q.tolist(), rate.tolist(), [0.0] * n))
    expected = by_rate.T @ rod.wrench
    assert np.abs(expected).max() > 0.1
    assert np.abs(felt - expected).max() < 1e-6 * np.abs(expected).max()


@pytest.mark.parametrize("inertial", [False, True])
def test_free_body_feels_force_and_moment(inertial):
    # a floating body whose mass may lie off its frame: m dv = F dt, I dw = (M + (base - com) x F) dt
    world = empty_world(dt=0.001)
    shape = world.createCollisionShape(world.GEOM_BOX, halfExtents=[0.05, 0.03, 0.02])
    off = [0.01, -0.02, 0.03] if inertial else [0.0, 0.0, 0.0]
    rotation = to_xyzw([0.5, 0.5, 0.5, -0.5]).tolist()
    body = world.createMultiBody(2.0, shape, -1, [0.1, 0.2, 0.3], rotation, off)
    world.changeDynamics(body, -1, linearDamping=0.0, angularDamping=0.0)
    link = BulletLink(world, body, **MOUNT)
    wrench = np.array([0.5, -0.3, 0.2, 0.02, 0.01, -0.03])
    com, rotation = world.getBasePositionAndOrientation(body)
    rotation = matrix_from_quaternion(from_xyzw(rotation)[None])[0]
    inertia = rotation @ np.diag(world.getDynamicsInfo(body, -1)[2]) @ rotation.T
    moment = wrench[3:] + np.cross(link.motion().pose[:3] - com, wrench[:3])
    link.exert(wrench)
    world.stepSimulation()
    linear, angular = world.getBaseVelocity(body)
    assert_allclose(linear, wrench[:3] / 2.0 * world.dt, rtol=1e-6)
    assert_allclose(angular, np.linalg.solve(inertia, moment) * world.dt, rtol=1e-5)


@pytest.mark.parametrize("seed", [3, 4])
def test_motion_of_the_base_is_the_derivative_of_its_pose(seed):
    world = empty_world()
    arm, q, rate = kuka(world, seed)
    link, h = BulletLink(world, arm, len(q) - 1, **MOUNT), 1e-3

    def pose(t):
        for j in range(len(q)):
            world.resetJointState(arm, j, q[j] + t * rate[j], rate[j])
        return link.motion().pose

    after, before, motion = pose(h), pose(-h), (pose(0.0), link.motion())[1]
    # poses in single precision: 1e-7 / h
    assert_allclose((after - before)[:3] / (2 * h), motion.velocity[:3], atol=2e-4)
    rotation = matrix_from_quaternion(after[None, 3:])[0] @ matrix_from_quaternion(before[None, 3:])[0].T
    spin = np.array([rotation[2, 1], rotation[0, 2], rotation[1, 0]]) / (2 * h)
    assert_allclose(spin, motion.velocity[3:], atol=5e-4)
    predicted = motion.after(h)
    assert_allclose(predicted[:3], after[:3], atol=1e-6)
    assert abs(predicted[3:] @ after[3:]) == pytest.approx(1.0, abs=1e-6)


def test_base_of_a_body_is_its_frame_and_not_its_centre_of_mass():
    world = empty_world()
    body = world.createMultiBody(1.0, -1, -1, [0.3, 0.0, 0.0], baseInertialFramePosition=[0.0, 0.1, 0.0])
    assert_allclose(link_motion(world, body, -1).pose[:3], [0.3, 0.0, 0.0], atol=1e-6)
    world.resetBaseVelocity(body, [0.0] * 3, [0.0, 0.0, 2.0])
    # the centre of mass rests, so the frame, 0.1 m below it in y, goes round it: w x (-0.1 e_y) = +0.2 e_x
    # single precision
    assert_allclose(link_motion(world, body, -1).velocity[:3], [0.2, 0.0, 0.0], atol=1e-6)


def test_rod_follows_a_host_that_moves_and_rotates():
    world, robot = empty_world(), soft_robot()
    link = carrier(world)
    rod = MountedRod(robot, link)
    pulled = robot.rest_tendon_length + np.array([-3, 0, 3, 0, -6, 2, 6, -2]) * 1e-3
    rest = rod.settle(tendon_length=pulled).tip_position[0]
    place, turned = np.array([0.3, -0.2, 0.1]), np.array([0.5, 0.5, -0.5, 0.5])
    world.resetBasePositionAndOrientation(link.body, place.tolist(), to_xyzw(turned).tolist())
    rod.step()
    rotation = matrix_from_quaternion(turned[None])[0]
    assert_allclose(rod.state.tip_position[0], place + rotation @ rest, atol=1e-6)


def test_a_base_that_motors_hold_is_where_its_link_is():
    # the rod expects its base by gravity and the motors of the last step
    world = empty_world(0.005, 9.81)
    arm, q, _ = kuka(world, 3)
    for j, angle in enumerate(q):
        world.resetJointState(arm, j, angle)
        world.setJointMotorControl2(arm, j, world.POSITION_CONTROL, angle, positionGain=0.3, force=300.0)
    link = BulletLink(world, arm, len(q) - 1, **MOUNT)
    robot = soft_robot(line_density=0.8, damping_time=0.05)
    rod = MountedRod(robot, link)
    for _ in range(300):
        rod.step()
    assert_allclose(rod.rod.base[:3], link.motion().pose[:3], atol=2e-6)
    assert_allclose(rod.wrench[:3], [0.0, 0.0, -0.8 * robot.length * 9.81], atol=1e-4)


def test_capsules_lie_along_the_backbone_and_rotate_with_it():
    world, robot = empty_world(), soft_robot()
    rod = MountedRod(robot, carrier(world), points_per_segment=10, capsules_per_segment=5)
    state = rod.settle(tendon_length=robot.rest_tendon_length + np.array([-8, 0, 8, 0, -8, -5, 8, 5]) * 1e-3)
    assert len(rod.bodies.ids) == 10
    nodes, frames = state.position[0, ::2], state.rotation[0, ::2]
    for k, body in enumerate(rod.bodies.ids):
        position, quaternion = world.getBasePositionAndOrientation(body)
        assert_allclose(position, 0.5 * (nodes[k] + nodes[k + 1]), atol=1e-7)
        own = matrix_from_quaternion(from_xyzw(quaternion)[None])[0]
        chord = nodes[k + 1] - nodes[k]
        assert_allclose(own[:, 2], chord / np.linalg.norm(chord), atol=1e-6)
        middle = frames[k][:, 0] + frames[k + 1][:, 0]
        assert own[:, 0] @ middle / np.linalg.norm(middle) > 0.99
        _, _, kind, size = world.getCollisionShapeData(body, -1)[0][:4]
        assert kind == world.GEOM_CAPSULE
        assert size[:2] == pytest.approx((0.02, 0.012))


def test_worlds_do_not_disturb_each_other():
    one, other = empty_world(), empty_world(dt=0.001)
    robot = soft_robot()
    rods = [MountedRod(robot, carrier(world)) for world in (one, other)]
    rods[0].settle(tendon_length=robot.rest_tendon_length)
    rods[1].settle(tendon_length=robot.rest_tendon_length - 0.001)
    assert one.number != other.number
    assert (one.dt, other.dt) == (0.005, 0.001)
    before = [other.getBasePositionAndOrientation(b) for b in rods[1].bodies.ids]
    for _ in range(5):
        rods[0].step()
    assert before == [other.getBasePositionAndOrientation(b) for b in rods[1].bodies.ids]
    n = other.getNumBodies()
    rods[0].bodies.remove()
    assert other.getNumBodies() == n
    assert one.getNumBodies() == 1


def test_two_rods_in_one_world_take_one_step():
    world, robot = empty_world(gravity=9.81), soft_robot(line_density=0.5)
    rods = [MountedRod(robot, carrier(world, axis)) for axis in ("z", "x")]
    falling = cube(world, 0.04, 0.1, [1.0, 1.0, 1.0])
    for _ in range(4):
        for rod in rods:
            rod.begin(tendon_length=robot.rest_tendon_length)
        world.stepSimulation()
        for rod in rods:
            rod.end()
    assert world.getBaseVelocity(falling)[0][2] == pytest.approx(-4 * 9.81 * world.dt, rel=1e-9)


def test_client_is_taken_as_users_have_it():
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

    world = connect()
    assert Bullet(world.number).number == world.number
    assert Bullet(world).number == world.number
    client = BulletClient(pybullet.DIRECT)
    client.setTimeStep(0.002)
    assert Bullet(client).dt == pytest.approx(0.002)
    assert Bullet(Bullet(client)).connection is Bullet(client._client).connection
    pybullet.disconnect(world.number)
    next_one = BulletClient(pybullet.DIRECT)  # of the same number
    assert (Bullet(next_one).isConnected(), world.isConnected()) == (1, 0)
    if pybullet.isConnected(0):
        assert Bullet(pybullet).number == 0


def test_world_that_nobody_refers_to_ends_and_its_number_is_another_worlds():
    import pybullet

    world = empty_world()
    arm, _, _ = kuka(world, 0)
    rod = MountedRod(soft_robot(line_density=0.1), BulletLink(world, arm, 6))
    number = world.number
    del world
    rod.step()
    rod.bullet.disconnect()
    other = empty_world()
    gone = MountedRod(rod.rod.robot, BulletLink(other, kuka(other, 0)[0], 6))
    gone.step()
    other.removeBody(arm)
    box = MountedRod(rod.rod.robot, BulletLink(other, cube(other, 0.05, 0.1, [0.0, 0.0, 0.0])))
    # a cube has no link 6, which PyBullet does not check
    assert (other.number, box.host.body) == (number, arm)
    for _ in range(3):
        assert box.step().ok[0]
    ended = rf"^PyBullet's world {number} has been disconnected\.$"
    linkless = f"^body {arm} has no link 6"
    for call, why in ((rod.step, ended), (rod.bullet.disconnect, ended), (gone.step, linkless)):
        with pytest.raises(HostError, match=why):
            call()
    del rod, gone, box, other, call
    gc.collect()
    assert not pybullet.isConnected(number)


def test_rods_that_were_removed_weigh_nothing():
    felt = []
    for others in (0, 1):
        world, robot = empty_world(0.01, 9.81), soft_robot(line_density=0.2, damping_time=0.05)
        world.createMultiBody(0.0, world.createCollisionShape(world.GEOM_PLANE))
        body = cube(world, 0.06, 0.1, [0.0, 0.0, 0.03])
        rod, *gone = (MountedRod(robot, BulletLink(world, body)) for _ in range(1 + others))
        for other in gone:
            other.remove()
        felt.append([rod.step() and rod.wrench for _ in range(30)])
    assert_allclose(*felt, atol=1e-12)


def test_gui_without_a_display_is_a_sentence(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    sentence = r"^PyBullet's GUI needs a display, and DISPLAY is not set; leave gui=False"
    with pytest.raises(HostError, match=sentence):
        connect(gui=True)


def on(link=0, **mount):
    """A base on a link of the Kuka."""
    return lambda w: BulletLink(w, kuka(w, 0)[0], link, **mount)


def mounted(**options):
    return lambda w: MountedRod(soft_robot(), carrier(w), **options)


NOT_THERE = {
    r"this PyBullet world has no body 7; it has \[0\]\.": lambda w: (kuka(w, 0), BulletLink(w, 7)),
    r"body 0 has no link 9; -1 is its base, links are numbered from 0 to 6\.": on(9),
    r"body 0 has no link 'lbr_iiwa_link_8'; did you mean 'lbr_iiwa_link_7'\?": on("lbr_iiwa_link_8"),
    r"body \d+ has no link 2; -1 is its base, it has no others\.": lambda w: BulletLink(
        w, carrier(w).body, 2
    ),
    r"give a physicsClientId, the pybullet module or a BulletClient": lambda w: Bullet("world"),
    r"PyBullet has no world 9999; connect first": lambda w: Bullet(9999),
    r"0 capsules for 0.2 m; give at least one": lambda w: RodBodies(w, 0.2, 0.01, 0),
    r"^host is 3; give BulletLink\(world, body, link\)": lambda w: MountedRod(soft_robot(), 3),
}
BAD_INPUT = {
    r"the mount has a quaternion of norm 1.41421; it must be 1": on(quaternion=(1, 1, 0, 0)),
    r"3 capsules for 10 points of a segment; give a divisor of the points\.": mounted(capsules_per_segment=3),
    r"friction is -1; it must be a number, zero or positive and finite\.": mounted(friction=-1),
    r"^gravity is 9.81; give three numbers": lambda w: connect(gravity=9.81),
    r"^dt is 0 s; it must be a number between 0 and 1 s": lambda w: connect(dt=0),
}


@pytest.mark.study(beyond=3)
@refusals({HostError: NOT_THERE, InputError: BAD_INPUT})
def test_what_is_not_there_is_a_sentence(error, sentence, call):
    with pytest.raises(error, match=sentence):
        call(empty_world())


def test_hosts_has_no_other_names():
    import fastrod.hosts

    with pytest.raises(AttributeError, match=r"no 'MountedRot'; did you mean 'MountedRod'\?"):
        _ = fastrod.hosts.MountedRot


def test_quaternions_of_matrices_and_vectors():
    q = np.random.default_rng(5).normal(size=(500, 4))
    q[:100] *= 10.0 ** np.random.default_rng(6).uniform(-9, 0, (100, 4))  # near half turns too
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    back = quaternion_from_matrix(matrix_from_quaternion(q))
    assert_allclose(np.abs(np.einsum("ij,ij->i", q, back)), 1.0, atol=1e-14)
    assert (back[:, 0] >= 0.0).all()
    v = np.random.default_rng(7).normal(size=(50, 3))
    half = quaternion_from_vector(0.5 * v)
    assert_allclose(product(half, half), quaternion_from_vector(v), atol=1e-14)
    assert_array_equal(quaternion_from_vector(np.zeros(3)), [1.0, 0.0, 0.0, 0.0])


def test_rod_bodies_stand_for_what_the_simulator_has():
    world, robot = empty_world(), soft_robot()
    state = Simulator(robot, points_per_segment=8).settle(robot.rest_tendon_length)
    bodies = RodBodies(world, robot.length, 0.012, 16, color=(1, 0, 0, 1), head_color=(0, 1, 0, 1))
    bodies.place(state.position[0], state.rotation[0])
    colours = [world.getVisualShapeData(b)[0][7] for b in bodies.ids]
    assert set(colours[:-1]) == {(1.0, 0.0, 0.0, 1.0)}
    assert colours[-1] == (0.0, 1.0, 0.0, 1.0)


def test_capsules_of_unequal_segments_have_their_own_length():
    world = empty_world(dt=0.005)
    robot = soft_robot()
    short, long = robot.segments
    robot = replace(robot, segments=(replace(short, length=0.06), replace(long, length=0.14)))
    rod = MountedRod(robot, carrier(world))
    rod.step(tip_force=(0.05, 0.0, 0.0))
    heights = [world.getCollisionShapeData(own, -1)[0][3][0] for own in rod.bodies.ids]
    assert_allclose(heights, [0.006] * 10 + [0.014] * 10)
    assert rod.wrench.any()
    rod.reset()
    assert not rod.wrench.any()
