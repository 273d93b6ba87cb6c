"""`BulletArm` and the UR5 that ships: kinematics against the published table, statics against PyBullet,
motors against the clock."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals

from fastrod.errors import HostError, InputError
from fastrod.hosts import Bullet, connect
from fastrod.hosts.arm import BulletArm
from fastrod.rotation import matrix_from_quaternion, product
from fastrod.types import Floats
from fastrod_scenes.robots import ur5_path

# Universal Robots, "DH parameters for calculations of kinematics and dynamics": d [m], a [m], alpha [rad];
# mass [kg] and centre of
# mass [m] in the frame after the joint.
DH = (
    (0.089159, 0.0, np.pi / 2),
    (0.0, -0.425, 0.0),
    (0.0, -0.39225, 0.0),
    (0.10915, 0.0, np.pi / 2),
    (0.09465, 0.0, -np.pi / 2),
    (0.0823, 0.0, 0.0),
)
MASS = (3.7, 8.393, 2.275, 1.219, 1.219, 0.1879)
CENTRE = (
    (0, -0.02561, 0.00193),
    (0.2125, 0, 0.11336),
    (0.15, 0, 0.0265),
    (0, -0.0018, 0.01634),
    (0, 0.0018, 0.01634),
    (0, 0, -0.001159),
)
POSES = {
    "ready": (0.0, -1.57, 1.57, -1.57, -1.57, 0.0),
    "low": (0.6, -1.2, 1.4, -1.8, -1.57, 0.4),
    "upright": (0.0, -1.57, 0.0, -1.57, 0.0, 0.0),
    "stretched": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "elbow down": (-0.8, -0.6, -1.4, 0.5, 1.57, 1.0),
}


def dh_frames(q: Floats) -> list[Floats]:
    """World frames (4, 4) after each joint; the first factor is ROS's turn from base_link to the controller's
    base."""
    frames, frame = [], np.diag([-1.0, -1.0, 1.0, 1.0])
    for angle, (d, a, alpha) in zip(q, DH, strict=True):
        c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
        turned = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s]]
        frame = frame @ np.array([*turned, [0, sa, ca, d], [0, 0, 0, 1]])
        frames.append(frame)
    return frames


def apart(a: Floats, b: Floats) -> float:
    """Largest difference of two poses (7,), as position [m] and rotation matrix."""
    rotations = matrix_from_quaternion(np.stack([a[3:], b[3:]]))
    return float(max(abs(a[:3] - b[:3]).max(), abs(rotations[0] - rotations[1]).max()))


@pytest.fixture
def world() -> Bullet:
    return connect()


@pytest.fixture
def arm(world: Bullet) -> BulletArm:
    return BulletArm.load(world, ur5_path(), tip="tool0")


def link_pose(world: Bullet, body: int, link: int) -> Floats:
    state = world.getLinkState(body, link, computeForwardKinematics=1)
    x, y, z, w = np.array(state[5]) / np.linalg.norm(state[5])
    return np.array([*state[4], w, x, y, z])


def test_kinematics_are_those_of_the_published_table(arm: BulletArm) -> None:
    rng = np.random.default_rng(20)
    for q in rng.uniform(arm.lower, arm.upper, (50, 6)):
        pose, true = arm.frame(q), dh_frames(q)[-1]
        assert_allclose(pose[:3], true[:3, 3], atol=1e-9)
        assert_allclose(matrix_from_quaternion(pose[None, 3:])[0], true[:3, :3], atol=1e-9)


def test_names_and_limits(arm: BulletArm) -> None:
    joints = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    assert arm.names == tuple(f"{j}_joint" for j in joints)
    assert_allclose(arm.upper, np.pi * np.array([2, 2, 1, 2, 2, 2]))
    assert_allclose(arm.lower, -arm.upper)
    assert_allclose(arm.velocity_limit, np.pi)
    assert_array_equal(arm.effort, [150, 150, 150, 28, 28, 28])


def test_jacobian_is_the_slope_of_the_frame(world: Bullet) -> None:
    arm = BulletArm.load(
        world, ur5_path(), tip="tool0", position=(0.2, -0.1, 0.5), quaternion=(0.5, -0.5, 0.5, 0.5)
    )
    h = 1e-5  # central differences: h^2 from the series, 1e-16 / h from rounding
    for q in np.random.default_rng(21).uniform(-3.0, 3.0, (20, 6)):
        slopes = []
        for d in h * np.eye(6):
            after, before = arm.frame(q + d), arm.frame(q - d)
            rotation = product(after[3:], before[3:] * [1.0, -1.0, -1.0, -1.0])
            turned = 2.0 * np.sign(rotation[0]) * rotation[1:]
            slopes.append(np.concatenate([after[:3] - before[:3], turned]) / (2.0 * h))
        assert_allclose(arm.jacobian(q), np.transpose(slopes), atol=1e-9)


def test_frame_is_where_pybullet_puts_the_link(world: Bullet) -> None:
    arm = BulletArm.load(
        world, ur5_path(), tip="tool0", position=(0.2, -0.1, 0.5), quaternion=(0.8, 0.0, 0.6, 0.0)
    )
    for q in np.random.default_rng(22).uniform(-3.0, 3.0, (20, 6)):
        arm.place(q)
        # PyBullet's own answer is the rough one: where ours agrees with the table to 1e-15, it is off by up
        # to 4e-7
        assert apart(arm.frame(q), link_pose(world, arm.body, arm.tip)) < 2e-6
        assert_array_equal(arm.position(), q)


CRANKED = """<robot name="cranked">
  <link name="foot"><inertial><origin xyz="0.1 0.2 0.3" rpy="0.3 0.2 0.1"/><mass value="1"/>
    <inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="post"><inertial><origin xyz="-0.1 0.1 0" rpy="0.7 -0.2 0.4"/><mass value="1"/>
    <inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="slide"><inertial><origin xyz="0 0.1 0.2" rpy="-0.5 0.9 1"/><mass value="1"/>
    <inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="plate"><inertial><origin xyz="0 0 0.1" rpy="1 1 1"/><mass value="1"/>
    <inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="hand"><inertial><origin xyz="0.1 0 0" rpy="0 0.3 0"/><mass value="1"/>
    <inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="turn" type="continuous"><parent link="foot"/><child link="post"/>
    <origin xyz="0.1 0 0.2" rpy="0.1 0.2 0.3"/><axis xyz="0.6 0 0.8"/></joint>
  <joint name="push" type="prismatic"><parent link="post"/><child link="slide"/>
    <origin xyz="0 0.1 0" rpy="0.5 0 -0.3"/><axis xyz="0 0.8 -0.6"/>
    <limit lower="-0.1" upper="0.4" effort="50" velocity="1"/></joint>
  <joint name="bolt" type="fixed"><parent link="slide"/><child link="plate"/>
    <origin xyz="0.1 0.2 0" rpy="1 0 0.2"/></joint>
  <joint name="nod" type="revolute"><parent link="plate"/><child link="hand"/>
    <origin xyz="0 0 0.3" rpy="0 0.4 0"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="50" velocity="2"/></joint>
</robot>"""


@pytest.fixture
def cranked(tmp_path: Path) -> str:
    path = tmp_path / "cranked.urdf"
    path.write_text(CRANKED)
    return str(path)


def test_a_body_of_any_shape(world: Bullet, cranked: str) -> None:
    """Tilted frames of mass, axes of any direction, a slide, a fixed joint, a joint without limits."""
    arm = BulletArm.load(
        world, cranked, tip="hand", position=(1.0, 2.0, 3.0), quaternion=(0.8, 0.0, 0.6, 0.0)
    )
    assert arm.names == ("turn", "push", "nod")
    assert arm.lower[0] == -np.inf
    assert arm.effort[0] == np.inf
    for q in np.random.default_rng(23).uniform([-3, -0.1, -2], [3, 0.4, 2], (20, 3)):
        arm.place(q)
        # PyBullet's roughness, as above
        assert apart(arm.frame(q), link_pose(world, arm.body, arm.tip)) < 2e-6
        slope = [(arm.frame(q + d) - arm.frame(q - d))[:3] / 2e-5 for d in 1e-5 * np.eye(3)]
        assert_allclose(arm.jacobian(q)[:3], np.transpose(slope), atol=1e-9)
    near = q + np.array([0.01, 0.001, 0.0])
    arm.drive(near)
    for _ in range(20):
        world.stepSimulation()
    assert_allclose(arm.position(), near, atol=1e-6)


def test_an_arm_of_some_joints(world: Bullet, cranked: str) -> None:
    whole = BulletArm.load(world, cranked, tip="hand")
    some = BulletArm(world, whole.body, whole.tip, ("nod", "turn"))
    whole.place([0.3, 0.2, -0.5])
    assert_allclose(some.frame([1.0, -0.7]), whole.frame([-0.7, 0.2, 1.0]), atol=1e-15)
    assert_allclose(some.jacobian([1.0, -0.7]), whole.jacobian([-0.7, 0.2, 1.0])[:, [2, 0]], atol=1e-15)
    assert_array_equal(some.position(), [-0.5, 0.3])


def test_masses_are_the_published_ones(world: Bullet, arm: BulletArm) -> None:
    masses = [world.getDynamicsInfo(arm.body, j)[0] for j in range(world.getNumJoints(arm.body))]
    assert sum(masses) == pytest.approx(16.9939)
    assert_allclose(masses, [*MASS, 0.0])


@pytest.mark.parametrize("pose", POSES)
def test_weight_on_the_joints(world: Bullet, arm: BulletArm, pose: str) -> None:
    """tau = d/dq of sum m g z, by the table's centres of mass; central differences of h 1e-6 of an energy of
    some 100 J: 1e-8 N m."""

    def energy(q: Floats) -> float:
        frames = dh_frames(q)
        return sum(9.81 * m * float((f @ [*c, 1.0])[2]) for m, f, c in zip(MASS, frames, CENTRE, strict=True))

    q = np.array(POSES[pose])
    slope = [(energy(q + d) - energy(q - d)) / 2e-6 for d in 1e-6 * np.eye(6)]
    tau = world.calculateInverseDynamics(arm.body, q.tolist(), [0.0] * 6, [0.0] * 6)
    assert_allclose(tau, slope, atol=1e-5)  # PyBullet's frames are off by 1e-7 here
    assert abs(np.array(tau)).max() < 150.0


def nearest_links(world: Bullet, body: int) -> float:
    """Smallest gap of links that are not neighbours [m], up to 1."""
    n = world.getNumJoints(body) - 1
    pairs = [(a, b) for a in range(-1, n) for b in range(a + 2, n)]
    return min([1.0, *(p[8] for a, b in pairs for p in world.getClosestPoints(body, body, 1.0, a, b))])


@pytest.mark.parametrize("pose", POSES)
def test_links_are_apart(world: Bullet, arm: BulletArm, pose: str) -> None:
    arm.place(POSES[pose])
    assert 0.0 < nearest_links(world, arm.body) < 1.0


def test_a_folded_arm_meets_itself(world: Bullet, arm: BulletArm) -> None:
    arm.place([0.0, -1.57, 3.1, 0.0, 0.0, 0.0])
    assert nearest_links(world, arm.body) < 0.0


def test_asking_moves_nothing(world: Bullet, arm: BulletArm) -> None:
    arm.place(POSES["ready"])

    def seen() -> Any:
        joints, there = world.getJointStates(arm.body, range(6)), link_pose(world, arm.body, arm.tip)
        return joints, world.getNumBodies(), there.tolist()

    before = seen()
    arm.frame(np.ones(6))
    arm.jacobian(np.ones(6))
    arm.solve(arm.frame(np.ones(6)), np.full(6, 0.9))
    assert seen() == before


def test_the_base_may_move(world: Bullet, arm: BulletArm) -> None:
    before = arm.frame(POSES["low"])
    x, y, z = world.getBasePositionAndOrientation(arm.body)[0]
    world.resetBasePositionAndOrientation(arm.body, [x + 1.0, y, z], [0.0, 0.0, 0.0, 1.0])
    assert_allclose(arm.frame(POSES["low"]) - before, [1, 0, 0, 0, 0, 0, 0], atol=1e-15)


@pytest.mark.study
@pytest.mark.parametrize("forward", [False, True])
def test_motors_follow_a_circle(world: Bullet, arm: BulletArm, forward: bool) -> None:
    """Radius 0.2 m in 20 s, of which a quarter, a switching load of 20 N on the flange: 0.9 um off without
    and 1.2 um with feedforward, which ends a step at q + dt q_dot and so is behind by dt^2 / 2 of the
    acceleration: 0.3 um. Allowed is three times what was measured.
    """
    dt, n = world.dt, 1000
    centre = arm.frame(POSES["ready"])
    angle = 2.0 * np.pi * np.arange(n + 2) * dt / 20.0
    poses = np.tile(centre, (n + 2, 1))
    poses[:, :2] += 0.2 * np.stack([-np.cos(angle), np.sin(angle)], axis=-1)
    path = [arm.solve(poses[0], POSES["ready"])]
    for pose in poses[1:]:
        path.append(arm.solve(pose, path[-1]))
    rates = np.gradient(path, dt, axis=0)
    arm.place(path[0], rates[0])
    off = []
    for k in range(n):
        arm.drive(*((path[k], rates[k]) if forward else (path[k + 1],)))
        push = [0.0, 20.0 if k // 100 % 2 else -20.0, -20.0]
        world.applyExternalForce(arm.body, 5, push, arm.frame(path[k])[:3].tolist(), world.WORLD_FRAME)
        world.stepSimulation()
        off.append(np.linalg.norm(arm.frame(arm.position())[:3] - poses[k + 1, :3]))
    assert 0.0 < max(off) < 3.6e-6


def test_motors_keep_their_limits(world: Bullet, arm: BulletArm) -> None:
    arm.place(POSES["ready"])
    arm.drive(np.add(POSES["ready"], [1.0, 0, 0, 0, 0, 1.0]))
    fastest, strongest = np.zeros(6), np.zeros(6)
    for _ in range(200):
        world.stepSimulation()
        fastest = np.maximum(fastest, abs(arm.velocity()))
        strongest = np.maximum(strongest, [abs(s[3]) for s in world.getJointStates(arm.body, range(6))])
    assert (fastest < 1.01 * np.pi).all()  # PyBullet's solver holds a motor's speed to its own tolerance
    assert fastest[0] > 0.9 * np.pi
    assert (strongest <= arm.effort + 1e-9).all()
    assert_allclose(arm.position(), np.add(POSES["ready"], [1.0, 0, 0, 0, 0, 1.0]), atol=1e-5)


def test_freeze_and_place_hold(world: Bullet, arm: BulletArm) -> None:
    arm.place(POSES["ready"], np.full(6, 0.2))
    assert_array_equal(arm.velocity(), np.full(6, 0.2))
    arm.drive(np.zeros(6))
    for _ in range(20):
        world.stepSimulation()
    arm.freeze()
    q = arm.position()
    for _ in range(200):
        world.stepSimulation()
    assert_allclose(arm.position(), q, atol=1e-5)
    arm.place(POSES["low"])
    for _ in range(200):
        world.stepSimulation()
    assert_allclose(arm.position(), POSES["low"], atol=1e-5)


def test_solve_finds_the_pose(arm: BulletArm) -> None:
    rng = np.random.default_rng(24)
    for q in rng.uniform(-2.0, 2.0, (30, 6)):
        target = arm.frame(q)
        found = arm.solve(target, q + rng.normal(scale=0.2, size=6))
        assert apart(arm.frame(found), target) < 5e-9  # 1e-9 m and rad, in the entries of a rotation matrix
        assert (np.clip(found, arm.lower, arm.upper) == found).all()
        point = arm.solve(target[:3], np.zeros(6))  # from a singular position
        assert_allclose(arm.frame(point)[:3], target[:3], atol=1e-9)


def test_solve_stays_within_limits(world: Bullet, cranked: str) -> None:
    arm = BulletArm.load(world, cranked, tip="hand")
    target = arm.frame([1.0, 0.4, 0.5])  # the slide at its end
    assert_allclose(arm.solve(target, [0.8, 0.1, 0.2]), [1.0, 0.4, 0.5], atol=1e-7)
    with pytest.raises(HostError, match="no joint positions within the limits"):
        arm.solve(arm.frame([1.0, 0.6, 0.5]), [0.8, 0.1, 0.2])


def on(tip: int | str, *joints: Sequence[str]) -> Callable[[BulletArm], object]:
    """Another arm of the same body."""
    return lambda a: BulletArm(a.bullet, a.body, tip, *joints)


NOT_THERE = {
    "no link 'tool'; did you mean 'tool0'": on("tool"),
    "has no link 9": on(9),
    "has no body 7": lambda a: BulletArm(a.bullet, 7, "tool0"),
    "no joint that moves": on(-1),
    "did you mean 'elbow_joint'": on("tool0", ("elbow",)),
    "each once": on("tool0", ("elbow_joint", "elbow_joint")),
    "at least one": on("tool0", ()),
    "cannot load 'none.urdf'": lambda a: BulletArm.load(a.bullet, "none.urdf", tip=0),
    "no joint positions within the limits .* is 1.05 m off": lambda a: a.solve((2.0, 0.0, 0.0), np.zeros(6)),
}
BAD_INPUT = {
    r"position has shape \(2,\); it must be \(3,\), of the arm's": lambda a: BulletArm.load(
        a.bullet, ur5_path(), tip=0, position=(0.0, 1.0)
    ),
    "the arm's base has a quaternion of norm 2": lambda a: BulletArm.load(
        a.bullet, ur5_path(), tip=0, quaternion=(0, 0, 0, 2)
    ),
    r"q has shape \(5,\); it must be \(6,\), a number for each of sh": lambda a: a.frame(np.zeros(5)),
    r"q is not an array of numbers; give \(6,\)": lambda a: a.frame("home"),
    r"q holds a value that is not finite: \[nan": lambda a: a.jacobian(np.full(6, np.nan)),
    "q of elbow_joint is 4; its limits": lambda a: a.drive([0, 0, 4.0, 0, 0, 0]),
    ".*q of elbow_joint is 4; its limits": lambda a: a.place([0, 0, 4.0, 0, 0, 0]),
    "q_dot has shape": lambda a: a.drive(np.zeros(6), np.zeros(2)),
    ".*q_dot has shape": lambda a: a.place(np.zeros(6), np.zeros(2)),
    r"target has shape \(4,\); it must be \(3,\) or \(7,\)": lambda a: a.solve(np.zeros(4), np.zeros(6)),
    "quaternion of norm 2": lambda a: a.solve((0.3, 0.2, 0.3, 2, 0, 0, 0), np.zeros(6)),
}


@refusals({HostError: NOT_THERE, InputError: BAD_INPUT})
def test_bad_input(arm, error, sentence, call):
    with pytest.raises(error, match=sentence):
        call(arm)


def test_load_that_fails_leaves_nothing_in_the_world():
    world = connect()
    with pytest.raises(HostError, match="has no link 'tol0'; did you mean 'tool0'"):
        BulletArm.load(world, ur5_path(), tip="tol0")
    assert world.getNumBodies() == 0
