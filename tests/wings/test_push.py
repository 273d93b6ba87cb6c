"""A rod on a host pushes bodies of its world, and both feel it."""

from dataclasses import replace

import numpy as np
import pytest
from bullets import carrier, carry, cube, empty_world, soft_robot

from fastrod.contact import ContactScene, plane
from fastrod.errors import HostError, InputError, UnknownNameError
from fastrod.hosts import MountedRod
from fastrod.hosts.surroundings import Touched
from fastrod.simulator import Simulator

SPEED = 0.1
RADIUS, SIZE, MASS = 0.012, 0.08, 0.1
END = {"axial": [0.2 + RADIUS + 0.002 + SIZE / 2, 0.0, 0.0], "side": [0.18, RADIUS + 0.002 + SIZE / 2, 0.0]}
WAY = {"axial": np.array([1.0, 0.0, 0.0]), "side": np.array([0.0, 1.0, 0.0])}


def push(dt, direction, gravity, duration=0.8, mass=MASS, size=SIZE, place=None, floor_friction=0.5):
    """A rod along x is carried against a cube; velocity of the cube along the way, its momentum and the host's impulse."""
    world = empty_world(dt, gravity)
    if gravity:
        floor = world.createCollisionShape(world.GEOM_BOX, halfExtents=[5.0, 5.0, 0.5])
        world.changeDynamics(world.createMultiBody(0.0, floor, -1, [0.0, 0.0, -0.5 - size / 2]), -1, lateralFriction=floor_friction)
    box = cube(world, size, mass, place or END[direction], friction=1.0)
    link, robot = carrier(world, "x"), soft_robot()
    rod = MountedRod(robot, link, touch=[box])
    rod.settle(tendon_length=robot.rest_tendon_length)
    way, impulse, speeds, ok = WAY[direction], np.zeros(3), [], True
    for k in range(round(duration / dt)):
        carry(link, SPEED * k * dt * way, SPEED * way)
        state = rod.step()
        impulse += dt * rod.wrench[:3]
        speeds.append(np.array(world.getBaseVelocity(box)[0]) @ way)
        ok = ok and bool(state.ok[0])
    return np.array(speeds), mass * np.array(world.getBaseVelocity(box)[0]), impulse, ok


@pytest.mark.parametrize("direction", ["axial", "side"])
@pytest.mark.parametrize("dt", [0.001, 0.005, 0.01])
def test_momentum_of_a_free_cube_is_the_impulse_on_the_host(dt, direction):
    speeds, momentum, impulse, ok = push(dt, direction, gravity=0.0, duration=0.5)
    assert ok
    assert momentum @ WAY[direction] > 0.9 * MASS * SPEED
    np.testing.assert_allclose(momentum, -impulse, atol=1e-9)
    # an elastic rod without any loss would leave it at twice the speed; along its axis this one is stiff, and only stops it
    assert speeds.max() < (1.01 if direction == "axial" else 1.5) * SPEED


@pytest.mark.parametrize("direction", ["axial", "side"])
@pytest.mark.parametrize("dt", [0.001, 0.002, 0.005, 0.01])
def test_cube_on_the_floor_follows_the_tip(dt, direction):
    # from the side the rod bends by some 3 cm until 20 g slide; a cube of 100 g would bend it as far as it is long
    speeds, _, impulse, ok = push(dt, direction, gravity=9.81, duration=1.6, mass=MASS if direction == "axial" else 0.02)
    assert ok
    late = speeds[len(speeds) // 2 :]
    np.testing.assert_allclose(late, SPEED, rtol=0.02)
    assert speeds.max() < 1.05 * SPEED  # no launch
    assert -impulse @ WAY[direction] > 0.0


def test_push_against_friction_is_the_friction():
    # once it slides the host holds mu m g against the way
    _, _, first, _ = push(0.005, "axial", gravity=9.81, duration=1.0)
    _, _, later, _ = push(0.005, "axial", gravity=9.81, duration=2.0)
    assert (first - later)[0] == pytest.approx(0.5 * MASS * 9.81, rel=0.01)


@pytest.mark.parametrize("mass", [0.01, 1.0])
def test_light_and_heavy_cubes_are_not_launched(mass):
    speeds, momentum, impulse, ok = push(0.01, "axial", gravity=0.0, duration=0.4, mass=mass)
    assert ok
    assert speeds[-1] == pytest.approx(SPEED, rel=0.05)
    np.testing.assert_allclose(momentum, -impulse, atol=1e-9)


def test_cube_that_is_hit_off_its_middle_turns_and_is_not_launched():
    speeds, momentum, impulse, ok = push(0.005, "axial", gravity=0.0, duration=0.4, place=[END["axial"][0], 0.03, 0.02])
    assert ok
    assert speeds.max() < 1.5 * SPEED
    np.testing.assert_allclose(momentum, -impulse, atol=1e-9)


def test_still_wall_is_felt_by_the_host_as_the_simulator_has_it():
    world, robot = empty_world(), soft_robot()
    wall = world.createMultiBody(0.0, world.createCollisionShape(world.GEOM_BOX, halfExtents=[0.05, 0.5, 0.5]), -1, [0.12, 0.0, 0.1])
    rod = MountedRod(robot, carrier(world), touch=[wall], friction=0.0)
    rod.settle(tendon_length=robot.rest_tendon_length)
    alone = Simulator(
        robot, dt=world.dt, points_per_segment=10, contact=ContactScene(obstacles=[plane(point=(0.07, 0, 0), normal=(-1, 0, 0), name="w")])
    )
    for k in range(40):
        pull = robot.rest_tendon_length + 0.0002 * k * np.array([-1, 0, 1, 0, -2, 0, 2, 0])
        state, expected = rod.step(tendon_length=pull), alone.step(pull)
    assert state.ok[0]
    assert rod.wrench[0] < -0.1
    np.testing.assert_allclose(rod.wrench, expected.base_wrench[0], atol=1e-6)
    np.testing.assert_allclose(state.tip_position, expected.tip_position, atol=1e-6)
    assert len(world.getContactPoints(rod.bodies.ids[-1], wall)) == 0  # one contact, not two


def test_every_shape_of_pybullet_is_an_obstacle_where_it_is():
    world = empty_world()
    turn = world.getQuaternionFromEuler([0.3, -0.4, 0.5])
    hull = np.random.default_rng(8).normal(size=(40, 3)) * 0.03
    shapes = {
        "box": world.createCollisionShape(world.GEOM_BOX, halfExtents=[0.01, 0.02, 0.03]),
        "sphere": world.createCollisionShape(world.GEOM_SPHERE, radius=0.03),
        "cylinder": world.createCollisionShape(world.GEOM_CYLINDER, radius=0.02, height=0.05),
        "capsule": world.createCollisionShape(world.GEOM_CAPSULE, radius=0.02, height=0.05),
        "mesh": world.createCollisionShape(world.GEOM_MESH, vertices=hull.tolist()),
    }
    probe = world.createMultiBody(0.0, world.createCollisionShape(world.GEOM_SPHERE, radius=0.001), -1, [0.15, 0.1, 0.12])
    for name, shape in shapes.items():
        body = world.createMultiBody(1.0, shape, -1, [0.1, 0.2, 0.3], turn, baseInertialFramePosition=[0.01, 0.0, 0.0])
        touched = Touched(world, body, dt=0.005, relaxation=0.1, friction=0.3)
        assert [part.obstacle.shape for part in touched.parts] == [name]
        pose = touched.expected([])[0][touched.names[0]]
        robot = soft_robot(1)
        sim = Simulator(robot, contact=ContactScene(obstacles=[touched.parts[0].obstacle], rod_radius=0.001, mounting=0.0))
        # the rod's base is where the probe is, and its tip beside it: both must be as far from the body
        state = sim.settle(robot.rest_tendon_length, base_pose=(0.15, 0.1, 0.12, 1, 0, 0, 0), obstacle_pose={touched.names[0]: pose})
        ends = []
        for point in state.position[0, [0, -1]]:
            world.resetBasePositionAndOrientation(probe, point.tolist(), [0, 0, 0, 1])
            ends.append(min(p[8] for p in world.getClosestPoints(probe, body, 1.0)))
        assert min(ends) > 0.0
        assert sim.clearance()[0] <= min(ends) + 1e-3  # PyBullet's cylinders and hulls have margins
        assert sim.clearance()[0] > 0.0
        world.removeBody(body)


def test_touched_body_may_be_put_somewhere_else():
    world, robot = empty_world(), soft_robot()
    box = cube(world, SIZE, MASS, END["axial"])
    link = carrier(world, "x")
    rod = MountedRod(robot, link, touch=[box])
    rod.settle(tendon_length=robot.rest_tendon_length)
    for k in range(20):
        carry(link, [SPEED * k * world.dt, 0.0, 0.0], [SPEED, 0.0, 0.0])
        rod.step()
    assert np.linalg.norm(world.getBaseVelocity(box)[0]) > 0.9 * SPEED
    world.resetBasePositionAndOrientation(box, [2.0, 0.0, 0.0], [0, 0, 0, 1])
    world.resetBaseVelocity(box, [0.0] * 3, [0.0] * 3)
    rod.reset()
    rod.step()
    assert np.abs(rod.wrench).max() < 1e-9
    assert np.abs(world.getBaseVelocity(box)[0]).max() == 0.0


def test_what_cannot_be_touched_is_a_sentence():
    world = empty_world()
    ghost = world.createMultiBody(1.0, -1, -1, [0, 0, 0])
    with pytest.raises(HostError, match=r"link -1 of body 0 has no collision shape, so nothing can touch it\."):
        Touched(world, ghost, dt=0.005, relaxation=0.1, friction=0.3)
    sim = Simulator(soft_robot(), contact=ContactScene(obstacles=[plane(point=(1, 0, 0), normal=(-1, 0, 0), name="wall")]))
    with pytest.raises(InputError, match=r"the mobility of 'wall' is .*; give \[m/N\], \(3, 3\)"):
        sim.set_free("wall", -1.0, np.eye(3), np.zeros(3))
    with pytest.raises(UnknownNameError, match=r"no obstacle 'wal'; did you mean 'wall'\?"):
        sim.set_free("wal", 1.0, np.eye(3), np.zeros(3))


def test_step_that_cannot_be_solved_keeps_action_and_reaction(monkeypatch):
    world, robot = empty_world(), soft_robot()
    box = cube(world, SIZE, MASS, END["axial"])
    link = carrier(world, "x")
    rod = MountedRod(robot, link, touch=[box])
    rod.settle(tendon_length=robot.rest_tendon_length)
    impulse, solved = np.zeros(3), rod.simulator.step
    for k in range(30):
        carry(link, [SPEED * k * world.dt, 0.0, 0.0], [SPEED, 0.0, 0.0])
        if k == 8:  # while it presses
            monkeypatch.setattr(rod.simulator, "step", lambda *a, **b: replace(solved(*a, **b), ok=np.array([False])))
        elif k == 10:
            monkeypatch.undo()
        rod.step()
        impulse += world.dt * rod.wrench[:3]
    assert np.linalg.norm(impulse) > 0.5 * MASS * SPEED
    np.testing.assert_allclose(MASS * np.array(world.getBaseVelocity(box)[0]), -impulse, atol=1e-9)


def test_time_step_that_changes_is_a_sentence():
    world, robot = empty_world(), soft_robot()
    rod = MountedRod(robot, carrier(world))
    rod.step(tendon_length=robot.rest_tendon_length)
    world.setTimeStep(0.002)
    with pytest.raises(
        HostError, match=r"the world's time step is now 0.002 s, and the rod was mounted for 0.005 s; remove\(\) it and mount it anew\."
    ):
        rod.step()


@pytest.mark.parametrize(("mass", "place", "height"), [(0.02, 0.15, 0.1), (0.05, 0.25, 0.07), (0.1, 0.2, 0.1)])
@pytest.mark.parametrize("dt", [0.005, 0.01])
def test_cube_that_falls_on_a_long_soft_rod_gains_no_energy(dt, mass, place, height):
    import fastrod

    world = empty_world(dt, 9.81)
    box = cube(world, 0.06, mass, [place, 0.0, height])
    rod = MountedRod(fastrod.load_robot("five_segment_reacher"), carrier(world, "x"), touch=[box])
    inertia, energy = mass * 0.06**2 / 6.0, []
    for _ in range(round(0.6 / dt)):
        rod.step()
        position, (linear, angular) = world.getBasePositionAndOrientation(box)[0], world.getBaseVelocity(box)
        energy.append(mass * 9.81 * position[2] + 0.5 * mass * np.dot(linear, linear) + 0.5 * inertia * np.dot(angular, angular))
    assert max(energy) < mass * 9.81 * height * (1.0 + 1e-6)
    assert min(energy[-5:]) < 0.9 * max(energy)  # what it hit took some


def test_rod_that_stays_lost_is_told(monkeypatch):
    world, robot = empty_world(), soft_robot()
    rod = MountedRod(robot, carrier(world), touch=[cube(world, SIZE, MASS, [1.0, 0.0, 0.0])])
    lost = replace(rod.step(), ok=np.array([False]), problems={0: "contact: it stands."})
    for way in ("step", "settle"):
        monkeypatch.setattr(rod.simulator, way, lambda *a, **b: lost)
    for _ in range(25):
        assert not rod.step().ok[0]
    with pytest.raises(HostError, match=r"^26 steps in a row could not be solved, the last: contact: it stands\. Move .*call reset\(\)\.$"):
        rod.step()


def test_bad_input_is_not_kept():
    world = empty_world()
    rod = MountedRod(soft_robot(), carrier(world))
    rod.step(tip_force=(0.01, 0.0, 0.0))
    with pytest.raises(InputError, match="tip_force holds a value that is not finite"):
        rod.step(tip_force=(0.0, 0.0, float("nan")))
    with pytest.raises(InputError, match=r"^a mounted rod has no input 'base_pose'; the host gives it$"):
        rod.step(base_pose=(0, 0, 0, 1, 0, 0, 0))
    with pytest.raises(InputError, match=r"^a mounted rod has no input 'tendon_lenght'; did you mean 'tendon_length'\?$"):
        rod.step(tendon_lenght=0)
    rod.step()
    np.testing.assert_allclose(rod.wrench[:3], [0.01, 0.0, 0.0], atol=1e-9)


def test_rod_can_be_taken_out_of_the_world():
    world = empty_world()
    link = carrier(world)
    rod = MountedRod(soft_robot(), link)
    assert world.getNumBodies() == 21
    rod.remove()
    assert world.getNumBodies() == 1


@pytest.mark.parametrize("touch", ["cube", (1, 2, 3), 1.5, True])
def test_touch_names_bodies(touch):
    with pytest.raises(HostError, match=r"^touch holds .*; give the number of a body, or \(body, link\)\.$"):
        MountedRod(soft_robot(), carrier(empty_world()), touch=[touch])


def test_world_or_body_that_has_gone_is_a_sentence():
    world, robot = empty_world(), soft_robot()
    link = carrier(world)
    box = cube(world, SIZE, MASS, END["axial"])
    rod = MountedRod(robot, link, touch=[np.int64(box)])
    rod.step()
    world.removeBody(box)
    with pytest.raises(HostError, match=r"^PyBullet refused getBasePositionAndOrientation: .*; is the body still in the world\?$"):
        rod.step()
    world.disconnect()
    with pytest.raises(HostError, match=r"^PyBullet's world \d+ has been disconnected\.$"):
        rod.step()
