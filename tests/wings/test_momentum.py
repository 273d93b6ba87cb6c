"""A rod on a body that gives way: momentum of the pair, in no engine, in PyBullet, in MuJoCo."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
from bullets import ROTATION, empty_world
from numpy.testing import assert_allclose
from pairs import GRAVITY, HOME, FreeBody, falling, heavy
from rods import rod as small
from scipy.special import ellipk

from fastrod import Modal, Rod, Simulator
from fastrod.errors import InputError
from fastrod.hosts import BulletLink, MountedRod, MujocoRod, add_capsules
from fastrod.rotation import displaced
from fastrod.types import Floats


@pytest.mark.study(beyond=4)
@pytest.mark.parametrize(
    ("ratio", "dt", "radius"),
    [(0.2, 1e-3, 0.5), (0.2, 1e-2, 0.5), (1.0, 5e-3, 0.5), (20.0, 1e-3, 0.5), (0.02, 1e-2, 0.05)],
)
@pytest.mark.parametrize("name", ["prototype", "five_segment_reacher"])
def test_a_body_and_its_bent_rod_that_is_let_go_keep_their_momentum(
    name: str, ratio: float, dt: float, radius: float
) -> None:
    robot = heavy(0.1, name)
    body, pull = FreeBody(robot, ratio, dt, (0.3, 0.0, 1.0), radius), np.zeros(len(robot.rest_tendon_length))
    pull[0] = 1e-3
    body.rod.settle(HOME, tendon_length=robot.rest_tendon_length - pull, gravity=(0.0, 0.0, 0.0))
    before, lost, size = np.zeros(6), [], []
    for k in range(30):
        body.step(tendon_length=robot.rest_tendon_length)
        both = body.momentum()
        before = both.sum(0) if k == 0 else before
        lost.append(np.abs(both.sum(0) - before))
        size.append(np.abs(both))
    most = np.maximum(np.max(size, axis=(0, 1)).reshape(2, 3).max(1), 1e-12)
    assert_allclose(np.max(lost, axis=0)[:3], 0.0, atol=1e-12 * most[0])
    assert_allclose(np.max(lost, axis=0)[3:], 0.0, atol=1e-4 * most[1])
    assert_allclose(body.rod.base[:3], body.pose[:3], atol=1e-4 * robot.length)  # and stay together


def test_it_falls_as_one_from_rest_and_from_a_fall() -> None:
    for start in (0.0, -2.0):
        body = FreeBody(heavy(0.5, "five_segment_reacher"), 0.2, 5e-3, (0.0, 0.0, 0.0))
        body.twist[2] = start
        for _ in range(40):
            body.step(GRAVITY)
        assert_allclose(body.twist[2] - start, -GRAVITY * 0.2, rtol=1e-9)
        assert np.abs(body.rod.wrench).max() < 1e-6


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("name", ["prototype", "five_segment_reacher", "tdcr_a"])
@pytest.mark.parametrize("dt", [1e-3, 1e-2])
def test_the_apparent_stiffness_is_the_slope_of_the_wrench(name: str, dt: float) -> None:
    robot = heavy(0.05, name)
    sim = Simulator(robot, dt=dt, points_per_segment=10, dynamics=True, threads=1)
    length = np.array(robot.rest_tendon_length)
    pull = np.zeros_like(length)
    pull[0] = 1e-3
    sim.settle(length - pull, base_pose=HOME)
    sim.step(length - 1.05 * pull, base_pose=displaced(HOME, np.full(6, 1e-3)))
    kept, given = sim.snapshot(), length - 1.1 * pull
    sim.step(given, base_pose=HOME, inverse_inertia=np.diag([2.0] * 3 + [300.0] * 3), passes=10)
    stiffness, pose = sim.apparent_stiffness()[0], sim._ports.base_pose[0]

    def wrench(by: Floats) -> Floats:
        sim.restore(kept)
        return sim.step(given, base_pose=displaced(pose, by), passes=10).base_wrench[0]

    # fourth order, with a step that the rod's inertia bears
    found = np.zeros((6, 6))
    for k, h in enumerate([2e-6] * 3 + [2e-5] * 3):
        far = {n: wrench(n * h * np.eye(6)[k]) for n in (-2, -1, 1, 2)}
        found[:, k] = -(8.0 * (far[1] - far[-1]) - (far[2] - far[-2])) / (12.0 * h)
    size = np.sqrt(np.outer(np.diag(found), np.diag(found)))
    assert_allclose(stiffness / size, found / size, rtol=0.0, atol=1e-6)


@pytest.mark.study
@pytest.mark.parametrize("rho", [0.0, 0.5])
def test_the_stiffness_of_the_mean_is_the_slope_of_what_the_body_feels(rho: float) -> None:
    robot = heavy(0.05)
    sim = Simulator(robot, dt=0.01, solver=Modal(dynamics=True, rho=rho), points_per_segment=10, threads=1)
    length, held = np.array(robot.rest_tendon_length), 1e-9 * np.diag([2.0] * 3 + [300.0] * 3)
    sim.settle(length, base_pose=HOME)
    for k in range(3):
        sim.step(length - 1e-4 * k * np.eye(len(length))[0], base_pose=HOME)
    kept = sim.snapshot()

    def wrench(by: Floats) -> Floats:
        sim.restore(kept)
        given = {"base_pose": displaced(HOME, by), "inverse_inertia": held}
        felt = sim.step(length, **given, passes=10).mean_wrench[0].copy()
        felt[3:] -= np.cross(by[:3], felt[:3])  # about where the base point is at the end
        return felt

    found = np.array([(wrench(-h) - wrench(h)) / 2e-6 for h in 1e-6 * np.eye(6)]).T
    wrench(np.zeros(6))
    stiffness = sim.apparent_stiffness(mean=True)[0]
    size = np.sqrt(np.outer(np.diag(found), np.diag(found)))
    assert_allclose(stiffness[:3] / size[:3], found[:3] / size[:3], rtol=0.0, atol=1e-6)
    # the arms of the moments are those at the end of the step
    assert_allclose(stiffness[3:] / size[3:], found[3:] / size[3:], rtol=0.0, atol=0.02)


@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
@pytest.mark.parametrize(
    ("mass", "dt", "contact"), [(0.05, 1e-2, False), (5.0, 1e-3, False), (5.0, 5e-3, True)]
)
def test_a_body_with_a_rod_falls_no_faster(engine: str, mass: float, dt: float, contact: bool) -> None:
    rod, speed = falling(engine, heavy(mass), dt, contact)
    for _ in range(20):
        rod.step()
    assert rod.simulator.dynamics
    assert_allclose(speed(), -GRAVITY * 20 * dt, rtol=1e-4)


NOTHING = '<inertia ixx="{0}" iyy="{0}" izz="{0}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
URDF = (
    f'<robot name="p"><link name="base"><inertial><mass value="0"/>{NOTHING.format(0)}<link name="bob">'
    f'<inertial><origin xyz="0 0 -0.3"/><mass value="0.5"/>{NOTHING.format(1e-5)}<joint name="j"'
    ' type="continuous"><parent link="base"/><child link="bob"/><axis xyz="0 1 0"/></joint></robot>'
)
MJCF = """<mujoco><option timestep="{dt}"/><worldbody><body name="bob" pos="0 0 1">
<joint name="j" type="hinge" axis="0 1 0"/><inertial pos="0 0 -.3" mass="0.5" diaginertia="1e-5 1e-5 1e-5"/>
</body></worldbody></mujoco>"""


@pytest.mark.study
@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
@pytest.mark.parametrize(("mass", "dt"), [(0.2, 1e-3), (0.5, 5e-3)])
def test_a_pendulum_swings_with_its_rod(engine: str, mass: float, dt: float, tmp_path: Any) -> None:
    """0.5 kg at 0.3 m and a stiff rod that hangs from it, let go at 0.2 rad: the first period."""
    length, radius, angle = 0.2, 0.012, 0.2
    robot = small("passive", length=length, line_density=mass / length, body_radius=radius)
    stiff = replace(robot.segments[0], bending_stiffness=(50.0, 50.0), torsional_stiffness=50.0)
    robot = replace(robot, segments=(stiff,))
    mount = {"position": (0.0, 0.0, -0.3), "quaternion": ROTATION["-z"]}
    if engine == "pybullet":
        world = empty_world(dt, GRAVITY)
        (tmp_path / "p.urdf").write_text(URDF)
        body = world.loadURDF(str(tmp_path / "p.urdf"), [0.0, 0.0, 1.0], useFixedBase=1)
        world.setJointMotorControl2(body, 0, world.VELOCITY_CONTROL, force=0.0)
        world.changeDynamics(body, 0, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0)
        world.resetJointState(body, 0, angle)
        rod: Any = MountedRod(robot, BulletLink(world, body, 0, **mount))
    else:
        spec = mujoco.MjSpec.from_string(MJCF.format(dt=dt))
        add_capsules(spec, robot, "bob")
        model = spec.compile()
        data = mujoco.MjData(model)
        data.qpos[0] = angle
        rod = MujocoRod(robot, model, data, "bob", **mount)
    swing = []
    for _ in range(round(1.6 / dt)):
        swing.append(world.getJointState(body, 0)[0] if engine == "pybullet" else data.qpos[0])
        rod.step()
    x = np.array(swing)
    down = np.flatnonzero((x[:-1] > 0.0) & (x[1:] <= 0.0))[:2]
    first, second = dt * (down + x[down] / (x[down] - x[down + 1]))
    arm = 0.3 + 0.5 * length
    inertia = 0.5 * 0.3**2 + 1e-5 + mass * (length**2 / 12.0 + 0.25 * radius**2 + arm**2)
    weight = GRAVITY * (0.5 * 0.3 + mass * arm)
    assert second - first == pytest.approx(
        4.0 * np.sqrt(inertia / weight) * ellipk(np.sin(0.5 * angle) ** 2), rel=1e-3
    )


def test_a_held_base_bears_the_weight_and_the_inertia() -> None:
    """Whatever the engine says of its inverse inertia: what is held is always elsewhere than it would be."""
    robot = heavy(0.4)
    rod = Rod(robot, dt=2e-3, dynamics=True)
    for _ in range(200):
        rod.advance(HOME, np.zeros(6), 2e-3, inverse_inertia=np.diag([20.0] * 3 + [5e3] * 3))
    assert_allclose(rod.wrench[:3], [0.0, 0.0, -0.4 * GRAVITY], atol=0.02)
    pushed = Rod(robot, dt=2e-3, dynamics=True)
    for k in range(50):  # 5 m/s^2 along z
        pose = displaced(HOME, 0.5 * 5.0 * 4e-6 * k * (k - 1) * np.eye(6)[2])
        twist = 5.0 * 2e-3 * k * np.eye(6)[2]
        pushed.advance(pose, twist, 2e-3, inverse_inertia=np.zeros((6, 6)))
    assert_allclose(pushed.wrench[2], -0.4 * (GRAVITY + 5.0), rtol=1e-3)


def test_rods_of_a_batch_give_way_each_by_itself() -> None:
    """A light body, one that is held, a heavy one; and back to a snapshot. The second is lost in the end: its
    engine, or its tendons, are not finite, which is nothing to the others."""
    robot, dt, n = heavy(0.2), 5e-3, 3
    mobility = np.stack(
        [np.diag([10.0] * 3 + [300.0] * 3), np.zeros((6, 6)), np.diag([2.0] * 3 + [50.0] * 3)]
    )
    every = Rod(robot, dt=dt, n_robots=n, dynamics=True)
    single = [Rod(robot, dt=dt, dynamics=True) for _ in range(n)]
    pose, twist = np.tile(HOME, (n, 1)), np.zeros((n, 6))
    for k in range(13):
        pull = 5e-4 * np.sin(0.3 * k) * np.eye(len(robot.rest_tendon_length))[0]
        length = np.tile(robot.rest_tendon_length - pull, (n, 1))
        free = twist - dt * GRAVITY * np.outer([1.0, 0.0, 1.0], np.eye(6)[2])
        kept = every.snapshot()
        lost = [a.copy() for a in (pose, twist, mobility, free, length)]
        if k >= 8:
            lost[k - 8][1] = np.nan
        for _ in range(2):
            every.restore(kept)
            given: Any = dict(zip(("inverse_inertia", "free_twist", "tendon_length"), lost[2:], strict=True))
            every.advance(*lost[:2], dt, **given)
        assert every.state.ok.tolist() == [True, k < 8, True]
        for i, one in list(enumerate(single))[:: 1 + (k >= 8)]:
            given = {"inverse_inertia": mobility[i], "free_twist": free[i], "tendon_length": length[i]}
            one.advance(pose[i], twist[i], dt, **given)
            assert_allclose(every.wrench[i], one.wrench, rtol=0.0, atol=1e-12)
            assert_allclose(every.base[i], one.base, rtol=0.0, atol=1e-14)
        twist = free + dt * np.einsum("nij,nj->ni", mobility, every.wrench)
        pose = displaced(pose, dt * twist)
        assert k != 7 or np.abs(every.wrench[1, 2] + 0.2 * GRAVITY) < 0.05
    given = {"inverse_inertia": mobility, "free_twist": 0.0 * free, "tendon_length": robot.rest_tendon_length}
    every.advance(HOME, np.zeros(6), dt, **given)  # one base for all
    assert every.state.ok.all()


def test_wrong_inverse_inertia_is_a_sentence() -> None:
    rod = Rod(heavy(0.1), dynamics=True)
    for given, sentence in {
        "x": r"^inverse_inertia is not an array of numbers; give \(6, 6\)",
        "skew": r"^inverse_inertia is not symmetric",
    }.items():
        matrix: Any = given if given == "x" else np.triu(np.ones((6, 6)))
        with pytest.raises(InputError, match=sentence):
            rod.advance(HOME, np.zeros(6), 0.01, inverse_inertia=matrix)
    with pytest.raises(InputError, match=r"^free_twist goes with inverse_inertia"):
        rod.advance(HOME, np.zeros(6), 0.01, free_twist=np.zeros(6))
    rod.advance(HOME, np.zeros(6), 0.01)
    with pytest.raises(InputError, match=r"^apparent_stiffness is of a step with inverse_inertia"):
        rod.simulator.apparent_stiffness()
    with pytest.raises(InputError, match=r"^stiffness is of a base that gave way; give inverse_inertia to"):
        _ = rod.stiffness
