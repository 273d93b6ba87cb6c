"""Several rods on one body, or on one arm: they move together, whatever the masses."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from bullets import cube, empty_world, kuka, soft_robot
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from fastrod.hosts import BulletLink, MountedRod, MujocoBody, MujocoRod, add_capsules
from fastrod.rotation import displacement

BOTH = ("pybullet", "mujoco")
TWIST = np.array([0.3, 0.1, 0.0, 0.0, 0.0, 1.0])
ROD = soft_robot(line_density=0.2)  # 0.04 kg
HOME = np.array(ROD.rest_tendon_length)
DOWN = (0.0, 1.0, 0.0, 0.0)  # of a rod, w x y z


def around(n):
    """(n, 4) quaternions w x y z of rods that stand out evenly in the x-y plane."""
    angles = 2.0 * np.pi * np.arange(n) / n
    axes = np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    turned = (Rotation.align_vectors([axis], [[0.0, 0.0, 1.0]])[0] for axis in axes)
    return [r.as_quat(scalar_first=True).tolist() for r in turned]


class Hand:
    """A free box that carries rods in PyBullet or in MuJoCo."""

    def __init__(self, engine, n, mass, dt):
        self.engine, self.dt, self.mass, half = engine, dt, mass, [0.03] * 3
        inertia = [6e-4 * mass] * 3
        if engine == "pybullet":
            self.world = world = empty_world(dt)
            self.body = world.createMultiBody(mass, world.createCollisionShape(3, halfExtents=half))
            still = {"linearDamping": 0.0, "angularDamping": 0.0}
            world.changeDynamics(self.body, -1, localInertiaDiagonal=inertia, **still)
            self.rods = [MountedRod(ROD, BulletLink(world, self.body, quaternion=q)) for q in around(n)]
        else:
            spec = mujoco.MjSpec()
            spec.option.timestep, spec.option.gravity = dt, [0.0] * 3
            body = spec.worldbody.add_body(name="hand", mass=mass, inertia=inertia, explicitinertial=True)
            body.add_freejoint()
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half)
            for k in range(n):
                add_capsules(spec, ROD, "hand", name=f"rod {k}")
            self.model = spec.compile()
            self.data = mujoco.MjData(self.model)
            on = (self.model, self.data, "hand")
            self.rods = [MujocoRod(ROD, *on, quaternion=q, name=f"rod {k}") for k, q in enumerate(around(n))]
        for rod in self.rods:
            rod.settle()
        if engine == "pybullet":
            self.world.resetBaseVelocity(self.body, TWIST[:3].tolist(), TWIST[3:].tolist())
        else:
            self.data.qvel[:] = TWIST

    def step(self, k, order=1):
        """Tendons pull to and fro, in turn."""
        pull = 0.004 * np.sin(4.0 * np.pi * k * self.dt) * np.eye(len(HOME))[0]
        each = list(zip(self.rods, np.resize([-1.0, 1.0], len(self.rods)), strict=True))
        ok = [rod.begin(tendon_length=HOME + sign * pull).ok[0] for rod, sign in each[::order]]
        self.world.stepSimulation() if self.engine == "pybullet" else mujoco.mj_step(self.model, self.data)
        for rod in self.rods:
            rod.end()
        return all(ok) and all(rod.state.ok[0] for rod in self.rods)

    @property
    def velocity(self):
        if self.engine == "pybullet":
            return np.concatenate(self.world.getBaseVelocity(self.body))
        turned = self.data.xmat[self.rods[0].host.body].reshape(3, 3)
        return np.concatenate([self.data.qvel[:3], turned @ self.data.qvel[3:]])

    @property
    def momentum(self):
        rods = sum(rod.simulator.momentum()[0, :3] for rod in self.rods)
        return self.mass * self.velocity[:3] + rods


@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
@pytest.mark.parametrize(("n", "mass"), [(2, 1.0), (2, 0.02), (4, 0.02)])
@pytest.mark.study(beyond=2)
def test_they_keep_their_momentum_on_a_hand_of_any_mass(engine, n, mass):
    hand, momentum, fastest = Hand(engine, n, mass, 0.01), [], 0.0
    for k in range(50):
        assert hand.step(k)
        momentum.append(hand.momentum)
        fastest = max(fastest, np.abs(hand.velocity).max())
    assert_allclose(momentum, np.tile(momentum[0], (50, 1)), atol=1e-9)
    assert_allclose(momentum[0][:2], (mass + 0.04 * n) * TWIST[:2], rtol=1e-3)
    assert fastest < 10.0


@pytest.mark.study
@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
@pytest.mark.parametrize("dt", [0.01, 0.005])
def test_a_body_stands_on_four_legs(engine, dt):
    # straight rods do not yield along their axes: a leg that is solved again with its base where the others
    # put it would press on the floor without end
    legs, mass, stiff = soft_robot(1, line_density=0.1, damping_time=0.05), 0.1, (0.01, 0.01)
    legs = replace(legs, segments=(replace(legs.segments[0], bending_stiffness=stiff),))
    corners, top, half = 0.04 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]), 0.114, [0.06, 0.06, 0.015]
    if engine == "pybullet":
        world = empty_world(dt, 9.81)
        floor = [world.createMultiBody(0.0, world.createCollisionShape(world.GEOM_PLANE))]
        shape = world.createCollisionShape(world.GEOM_BOX, halfExtents=half)
        body = world.createMultiBody(mass, shape, -1, [0.0, 0.0, top])
        links = [BulletLink(world, body, position=(*c, 0.0), quaternion=DOWN) for c in corners]
        rods = [MountedRod(legs, link, contact_bodies=floor, friction=0.6) for link in links]
    else:
        spec = mujoco.MjSpec()
        spec.option.timestep = dt
        spec.worldbody.add_body(name="floor").add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1])
        trunk = spec.worldbody.add_body(name="trunk", pos=[0, 0, top])
        trunk.add_freejoint()
        trunk.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, mass=mass)
        named = [(f"leg {k}", (*c, 0.0)) for k, c in enumerate(corners)]
        for name, _ in named:
            add_capsules(spec, legs, "trunk", name=name, contact_bodies=["floor"])
        model = spec.compile()
        data = mujoco.MjData(model)
        on = {"quaternion": DOWN, "contact_bodies": ["floor"], "friction": 0.6}
        rods = [MujocoRod(legs, model, data, "trunk", position=at, name=n, **on) for n, at in named]
    height, borne = [], []
    for _ in range(round(0.5 / dt)):
        for rod in rods:
            assert rod.begin().ok[0]
        world.stepSimulation() if engine == "pybullet" else mujoco.mj_step(model, data)
        for rod in rods:
            rod.end()
        height.append(rods[0].rod.base[2])
        borne.append(sum(rod.wrench[2] for rod in rods))
    assert_allclose(height[round(0.1 / dt) :], 0.112, atol=1e-4)
    assert np.mean(borne[round(0.3 / dt) :]) == pytest.approx(mass * 9.81, rel=0.01)


def test_a_rod_is_where_the_floor_holds_its_body():
    world, damped = empty_world(0.01, 9.81), soft_robot(line_density=0.2, damping_time=0.05)
    world.createMultiBody(0.0, world.createCollisionShape(world.GEOM_PLANE))
    rod = MountedRod(damped, BulletLink(world, cube(world, 0.06, 0.1, [0.0, 0.0, 0.03])))
    for _ in range(100):
        rod.step()
    off = displacement(rod.rod.base, rod.host.motion().pose)
    assert np.abs(off[:3]).max() < 1e-6  # 1 mm of a body that falls in each step


@pytest.mark.study
@pytest.mark.parametrize("tilt", [0.8, 1.2, 2.0])
def test_two_rods_are_thrown_on_the_floor_with_their_light_body(tilt):
    world = empty_world(0.01, 9.81)
    floor = [world.createMultiBody(0.0, world.createCollisionShape(world.GEOM_PLANE))]
    body = cube(world, 0.06, 0.04, [0.0, 0.0, 0.25])
    turned = [Rotation.from_rotvec([a, 0, 0]).as_quat(scalar_first=True) for a in (tilt, tilt + np.pi)]
    rods = [MountedRod(ROD, BulletLink(world, body, quaternion=q), contact_bodies=floor) for q in turned]
    world.resetBaseVelocity(body, [0.0, 0.0, -3.0], [1.0, 2.0, 3.0])
    for k in range(60):  # and begin straight, for they fall with it
        assert all(rod.begin().ok[0] and (k or rod.state.strain_energy[0] < 1e-6) for rod in rods)
        world.stepSimulation()
        for rod in rods:
            rod.end()


def test_a_rod_may_settle_again_after_it_has_begun():
    world = empty_world()
    body = cube(world, 0.06, 0.1, [0.0, 0.0, 0.0])
    one, other = (MountedRod(ROD, BulletLink(world, body, quaternion=q)) for q in around(2))
    one.begin()
    one.settle()
    assert other.begin().ok[0]


def test_rods_on_a_light_hinge_begin_at_rest():
    hub = '<body name="hub"><joint axis="1 0 0"/><geom size=".02" mass=".005"/></body>'
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{hub}</worldbody></mujoco>")
    for k in range(3):
        add_capsules(spec, ROD, "hub", name=f"rod {k}")
    on = (model := spec.compile(), mujoco.MjData(model), "hub")
    rods = [MujocoRod(ROD, *on, quaternion=q, name=f"rod {k}") for k, q in enumerate(around(3))]
    for rod in rods:
        rod.begin()
    energy = [rod.state.kinetic_energy[0] + rod.state.strain_energy[0] for rod in rods]
    assert_allclose(energy, energy[0], rtol=0.02)


@pytest.mark.study
def test_the_engines_agree(monkeypatch):
    monkeypatch.setattr("fastrod.hosts.carried._ALIKE", 0.0)  # what is just above it here may be below there
    hands = [Hand(engine, 3, 0.05, 0.005) for engine in ("pybullet", "mujoco")]
    for k in range(60):
        for hand in hands:
            assert hand.step(k)
        assert_allclose(hands[0].velocity, hands[1].velocity, atol=2e-5)


@pytest.mark.study
def test_it_does_not_matter_who_begins():
    hands, apart = [Hand("pybullet", 2, 0.1, 0.0025) for _ in range(2)], []
    for k in range(40):
        for hand, order in zip(hands, (1, -1), strict=True):
            assert hand.step(k, order)
        apart.append(np.abs(hands[0].velocity - hands[1].velocity).max())
    assert max(apart) < 0.01 * np.abs(hands[0].velocity).max()


@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
def test_a_wrench_on_one_link_of_an_arm_moves_the_base_on_another(engine):
    dt, wrench = 1e-3, 50.0 * np.array([1.0, -2.0, 0.5, 0.1, 0.2, -0.3])
    if engine == "pybullet":
        world = empty_world(dt)
        arm, _, _ = kuka(world, 2)
        one, other = (BulletLink(world, arm, link, position=(0.0, 0.02, 0.05)) for link in (6, 3))
        away, step = BulletLink(world, world.createMultiBody(1.0, -1, -1, [9.0] * 3)), world.stepSimulation
    else:
        links = "".join(
            f'<body name="{k}" pos="0 0 .2"><joint axis="{int(k % 2)} {int(k % 2 == 0)} 0"/>'
            '<geom type="capsule" size=".02" fromto="0 0 0 0 0 .2" mass="1"/>'
            for k in range(4)
        )
        model = mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{dt}" gravity="0 0 0"/><worldbody>{links}{"</body>" * 4}'
            '<body name="away" pos="1 0 0"><freejoint/><geom size=".1" mass="1"/></body></worldbody></mujoco>'
        )
        data = mujoco.MjData(model)
        data.qpos[:4], data.qvel[:4] = [0.3, -0.4, 0.5, 0.2], [0.2, 0.1, -0.3, 0.1]
        one, other = (MujocoBody(model, data, k, position=(0.0, 0.02, 0.05)) for k in ("3", "1"))
        away, step = MujocoBody(model, data, "away"), lambda: mujoco.mj_step(model, data)
    assert one.moves_with(other)
    assert other.moves_with(one)
    assert not one.moves_with(away)
    if engine == "mujoco":
        other.exert(wrench)
        expected = one.freedom(dt, [(other, wrench)])
    else:
        expected = one.freedom(dt, [(other, wrench)])
        other.exert(wrench)
    step()
    assert_allclose(expected.inverse_inertia, expected.inverse_inertia.T, atol=1e-9)
    moved = np.concatenate([base.motion().velocity for base in (one, other)])
    pushed = dt * expected.inverse_inertia[:, 6:] @ wrench
    assert np.abs(pushed[:6]).max() > 0.01
    assert_allclose(moved, expected.twist, atol=0.01 * np.abs(pushed[:6]).max())


@pytest.mark.parametrize("line_density", [0.0, 0.1])
@pytest.mark.study
def test_what_they_grasp_adds_nothing_to_the_momentum_of_their_hand(line_density):
    robot, mass, dt = soft_robot(line_density=line_density), 0.2, 0.01
    world, held = empty_world(dt), 0.1
    hand = world.createMultiBody(mass, world.createCollisionShape(3, halfExtents=[0.05, 0.02, 0.02]))
    world.changeDynamics(hand, -1, linearDamping=0.0, angularDamping=0.0)
    thing = cube(world, 0.04, held, [0.0, 0.0, -0.2], 1.0)
    links = [BulletLink(world, hand, position=(s, 0, -0.02), quaternion=DOWN) for s in (-0.045, 0.045)]
    rods = [MountedRod(robot, link, contact_bodies=[thing], friction=0.8) for link in links]
    for rod in rods:
        rod.settle()
    home, force, fastest = np.array(robot.rest_tendon_length), 0.0, 0.0
    for k in range(100):
        pull = 0.0012 * min(k * dt / 0.5, 1.0) * np.resize([-1.0, 0.0, 1.0, 0.0], len(home))
        ok = [rod.begin(tendon_length=home - s * pull).ok[0] for rod, s in zip(rods, (-1, 1), strict=True)]
        world.stepSimulation()
        for rod in rods:
            rod.end()
        both = mass * np.array(world.getBaseVelocity(hand)[0])
        both += held * np.array(world.getBaseVelocity(thing)[0])
        both += sum(rod.simulator.momentum()[0, :3] for rod in rods)
        assert all(ok)
        assert_allclose(both, 0.0, atol=1e-9)
        fastest = max(fastest, np.abs(world.getBaseVelocity(thing)[0]).max())
        force = max(force, min(np.linalg.norm(rod.body_contacts[0].exerted[:3]) for rod in rods))
    assert force > 0.05
    assert fastest < 0.05


class Grasp:
    """Two rods that hang from posts, and a cube of 60 mm between their tips."""

    def __init__(self, engine, dt, mass, **segment):
        robot, half = soft_robot(**segment), 0.03
        self.home, self.dt, ends = np.array(robot.rest_tendon_length), dt, [-half - 0.016, half + 0.016]
        if engine == "pybullet":
            self.world = world = empty_world(dt)
            thing = cube(world, 2.0 * half, mass, [0.0, 0.0, -0.215])
            posts = (world.createMultiBody(0.0, -1, -1, [x, 0, 0]) for x in ends)
            links = (BulletLink(world, post, quaternion=DOWN) for post in posts)
            self.rods = [MountedRod(robot, link, contact_bodies=[thing], friction=1.0) for link in links]
            self.step, self.fall = world.stepSimulation, lambda: world.setGravity(0.0, 0.0, -9.81)
            self.place = lambda: world.getBasePositionAndOrientation(thing)[0]
            return
        spec = mujoco.MjSpec()
        spec.option.timestep, spec.option.gravity = dt, [0.0] * 3
        thing = spec.worldbody.add_body(name="thing", pos=[0.0, 0.0, -0.215])
        thing.add_freejoint()
        thing.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[half] * 3, mass=mass)
        for x in ends:
            post = spec.worldbody.add_body(name=f"post {x}", pos=[x, 0.0, 0.0], quat=[0, 1, 0, 0])
            add_capsules(spec, robot, post.name, name=f"rod {x}", contact_bodies=["thing"])
        model = spec.compile()
        data = mujoco.MjData(model)
        touch = {"contact_bodies": ["thing"], "friction": 1.0}
        self.rods = [MujocoRod(robot, model, data, f"post {x}", name=f"rod {x}", **touch) for x in ends]
        self.step, self.place = lambda: mujoco.mj_step(model, data), lambda: data.body("thing").xpos.copy()
        self.fall = lambda: model.opt.gravity.__setitem__(2, -9.81)

    def go(self, seconds, pull):
        """Steps in which tendons go from one `pull` to another."""
        for x in np.linspace(*pull, round(seconds / self.dt)):
            change = x * np.resize([-1.0, 0.0, 1.0, 0.0], len(self.home))
            for rod, sign in zip(self.rods, (-1.0, 1.0), strict=True):
                assert rod.begin(tendon_length=self.home - sign * change).ok[0]
            self.step()
            for rod in self.rods:
                rod.end()

    @property
    def force(self):
        return np.array([rod.body_contacts[0].exerted[:3] for rod in self.rods])


@pytest.mark.parametrize("engine", BOTH)
@pytest.mark.parametrize("segment", [{}, {"line_density": 0.05, "damping_time": 0.02}])
@pytest.mark.study
def test_two_rods_hold_a_cube_between_them_in_steps_of_any_length(engine, segment):
    mass, forces = 0.05, []
    for dt in (0.01, 0.005, 0.0025):
        grasp = Grasp(engine, dt, mass, **segment)
        for rod in grasp.rods:
            rod.settle()
        grasp.go(0.4, (0.0, 0.0024))
        grasp.go(0.4, (0.0024, 0.0024))
        forces.append(grasp.force[:, 0])
        grasp.fall()
        began = grasp.place()
        grasp.go(0.4, (0.0024, 0.0024))
        assert_allclose(grasp.force.sum(0), [0.0, 0.0, 9.81 * mass], atol=0.01 * mass * 9.81)
        assert np.abs(np.subtract(grasp.place(), began)).max() < 0.2 * dt  # it falls within the first step
    assert_allclose(forces, np.tile(forces[-1], (3, 1)), rtol=2e-3)
    assert_allclose(forces[-1].sum(), 0.0, atol=1e-3 * forces[-1][0])
