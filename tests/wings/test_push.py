"""A rod on a host pushes bodies of its world, and both feel it."""

import mujoco
import numpy as np
import pytest
from bullets import HALF, carrier, clearance_of, cube, empty_world, soft_robot

from fastrod.contact import ContactScene, plane
from fastrod.errors import HostError, InputError, UnknownNameError
from fastrod.hosts import MountedRod
from fastrod.hosts.mounted import BulletBodyContact
from fastrod.hosts.mujoco_body_contact import MujocoBodyContact
from fastrod.simulator import Simulator


def test_every_shape_of_pybullet_is_an_obstacle_where_it_is():
    world = empty_world()
    angle = world.getQuaternionFromEuler([0.3, -0.4, 0.5])
    hull = np.random.default_rng(8).normal(size=(40, 3)) * 0.03
    shapes = {
        "box": world.createCollisionShape(world.GEOM_BOX, halfExtents=[0.01, 0.02, 0.03]),
        "sphere": world.createCollisionShape(world.GEOM_SPHERE, radius=0.03),
        "cylinder": world.createCollisionShape(world.GEOM_CYLINDER, radius=0.02, height=0.05),
        "capsule": world.createCollisionShape(world.GEOM_CAPSULE, radius=0.02, height=0.05),
        "mesh": world.createCollisionShape(world.GEOM_MESH, vertices=hull.tolist()),
    }
    probe = world.createMultiBody(0.0, world.createCollisionShape(world.GEOM_SPHERE, radius=0.001))
    for name, shape in shapes.items():
        body = world.createMultiBody(
            1.0, shape, -1, [0.1, 0.2, 0.3], angle, baseInertialFramePosition=[0.01, 0.0, 0.0]
        )
        contact = BulletBodyContact(world, body, dt=0.005, friction=0.3)
        assert [shape.obstacle.shape for shape in contact.shapes] == [name]
        clearance, points = clearance_of(contact)
        ends = []
        for point in points:
            world.resetBasePositionAndOrientation(probe, point.tolist(), [0, 0, 0, 1])
            ends.append(min(p[8] for p in world.getClosestPoints(probe, body, 1.0)))
        assert min(ends) > 0.0
        assert clearance <= min(ends) + 1e-3  # PyBullet's cylinders and hulls have margins
        assert clearance > 0.0
        world.removeBody(body)


def test_what_cannot_be_touched_is_a_sentence():
    world = empty_world()
    ghost = world.createMultiBody(1.0, -1, -1, [0, 0, 0])
    sentence = r"link -1 of body 0 has no collision shape, so nothing can touch it\."
    with pytest.raises(HostError, match=sentence):
        BulletBodyContact(world, ghost, dt=0.005, friction=0.3)
    wall = plane(point=(1, 0, 0), normal=(-1, 0, 0), name="wall")
    sim = Simulator(soft_robot(), contact=ContactScene(obstacles=[wall]))
    with pytest.raises(InputError, match=r"mobility of 'wall' has shape \(3,\); it must be \(6, 6\)"):
        sim.set_free("wall", np.zeros(3), np.zeros(3))
    with pytest.raises(InputError, match=r"mobility of 'wall' is not symmetric with eigenvalues"):
        sim.set_free("wall", -np.eye(6), np.zeros(3))
    with pytest.raises(InputError, match=r"center of 'wall' has shape \(2,\); it must be \(3,\)"):
        sim.set_free("wall", np.eye(6), np.zeros(2))
    with pytest.raises(UnknownNameError, match=r"no obstacle 'wal'; did you mean 'wall'\?"):
        sim.set_free("wal", np.eye(6), np.zeros(3))


@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
def test_what_falls_is_expected_where_it_falls_and_what_lies_where_it_lies(engine):
    dt, gravity = 0.005, np.array([0.0, 0.0, -9.81])
    if engine == "pybullet":
        world = empty_world(dt, 9.81)
        world.createMultiBody(0.0, world.createCollisionShape(world.GEOM_PLANE))
        contact = BulletBodyContact(world, cube(world, 0.04, 0.1, [0.0, 0.0, 0.1]), dt=dt, friction=0.3)
        step = world.stepSimulation
    else:
        model = mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{dt}"/><worldbody><geom type="plane" size="1 1 1"/><body name="cube" '
            'pos="0 0 .1"><freejoint/><geom type="box" size=".02 .02 .02" mass=".1"/></body></worldbody>'
            "</mujoco>"
        )
        data = mujoco.MjData(model)
        contact = MujocoBodyContact(model, data, model.body("cube").id, dt=dt, friction=0.3)

        def step():
            mujoco.mj_step(model, data)
            mujoco.mj_forward(model, data)

        mujoco.mj_forward(model, data)
    missed, height = [], []
    for _ in range(200):
        expected = contact.expected(gravity, np.zeros((1, 3)))[0][contact.names[0]]
        step()
        contact.end()
        missed.append(abs(contact.com().pose - expected).max())
        height.append(contact.com().pose[2])
    assert height[20] > 0.03
    assert max(missed[1:20]) < 1e-9  # in the first step it is not known that it falls
    assert height[-1] == pytest.approx(0.02, abs=1e-3)
    assert max(missed[-50:]) < 1e-5


def test_cylinder_that_hangs_in_a_hook_lies_on_the_rod():
    # the engine's capsules are chords, which lie up to 0.16 mm nearer to it than the rod
    dt, bend, depth = 0.01, 2.6, []
    world, robot = empty_world(dt), soft_robot(line_density=0.05, damping_time=0.05)
    shape = world.createCollisionShape(world.GEOM_CYLINDER, radius=0.03, height=0.2)
    lowest = robot.length / bend
    place = [-lowest, 0.0, 0.03 + 0.014 - lowest]
    hung = world.createMultiBody(0.05, shape, -1, place, [HALF, 0.0, 0.0, HALF])
    rod = MountedRod(robot, carrier(world, "-z"), contact_bodies=[hung], friction=0.3)
    along = bend * (np.array(robot.tendon_segment) + 1) / robot.n_segments
    pull = [t.offset * np.cos(t.angle) * a for t, a in zip(robot.tendons, along, strict=True)]
    for k in range(round(0.6 / dt)):
        if k == 2:
            world.setGravity(0.0, 0.0, -9.81)
        rod.step(tendon_length=robot.rest_tendon_length + pull)
        depth.append(np.linalg.norm(rod.simulator.overlap(rod.body_contacts[0].now())))
    assert max(depth[round(0.3 / dt) :]) < 2e-5
    assert rod.body_contacts[0].exerted[2] == pytest.approx(0.05 * 9.81, rel=0.02)


def test_rod_can_be_taken_out_of_the_world():
    world = empty_world()
    rod = MountedRod(soft_robot(), carrier(world))
    assert world.getNumBodies() == 21
    rod.remove()
    assert world.getNumBodies() == 1


@pytest.mark.parametrize("contact_bodies", ["cube", (1, 2, 3), 1.5, True])
def test_contact_bodies_names_bodies(contact_bodies):
    sentence = r"^contact_bodies holds .*; give the number of a body, or \(body, link\)\.$"
    with pytest.raises(HostError, match=sentence):
        MountedRod(soft_robot(), carrier(empty_world()), contact_bodies=[contact_bodies])


def test_world_or_body_that_has_gone_is_a_sentence():
    world = empty_world()
    box = cube(world, 0.08, 0.1, [0.254, 0.0, 0.0])
    rod = MountedRod(soft_robot(), carrier(world), contact_bodies=[np.int64(box)])
    rod.step()
    world.removeBody(box)
    sentence = r"^PyBullet refused getBasePositionAndOrientation: .*; is the body still in the world\?$"
    with pytest.raises(HostError, match=sentence):
        rod.step()
    world.disconnect()
    with pytest.raises(HostError, match=r"^PyBullet's world \d+ has been disconnected\.$"):
        rod.step()
