"""`Rod`: any engine's base in, capsules and wrench out, on a clock of its own."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from bullets import soft_robot
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals

import fastrod
from fastrod.contact import ContactScene, box, plane
from fastrod.errors import HostError, InputError, RobotError
from fastrod.hosts import Motion, Rod
from fastrod.rotation import matrix_from_quaternion, product, quaternion_from_vector
from fastrod.simulator import Simulator

HOME, STILL = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), (0.0,) * 6
PULL = np.array([-3, 0, 3, 0, -6, 2, 6, -2]) * 1e-3
LAGGED = replace(soft_robot(1), effects=({"name": "second_order_lag", "period": 0.1, "damping": 0.7},))
"""Its tendons remember: a lag of second order."""


def beside_a_wall(walled):
    """A scene for `LAGGED`, or none."""
    wall = plane(point=(0.01, 0, 0), normal=(-1, 0, 0), name="wall")
    return ContactScene(obstacles=[wall]) if walled else None


def test_weight_and_moment_of_a_level_rod():
    robot, half = soft_robot(line_density=0.8), np.sqrt(0.5)
    rod = Rod(robot)
    state = rod.settle((0.1, 0.2, 0.3, half, 0.0, half, 0.0))
    # the force is the weight; its moment about the base is that of the mass where it hangs: integral of (x -
    # x0) rho g ds
    assert_allclose(rod.wrench[:3], [0, 0, -0.8 * robot.length * 9.81], atol=1e-9)
    lever = 0.8 * 9.81 * np.trapezoid(state.position[0, :, 0] - 0.1, state.arclength[0])
    assert rod.wrench[4] == pytest.approx(lever, rel=1e-4)  # trapezoid of 21 nodes: (h / L)^2
    assert_allclose(rod.base, [0.1, 0.2, 0.3, half, 0.0, half, 0.0])


def test_tip_force_is_felt_as_force_and_moment_about_the_base():
    rod = fastrod.Rod(soft_robot())
    force = np.array([0.02, -0.03, 0.01])
    for _ in range(4):
        state = rod.advance(HOME, STILL, 0.01, tip_force=force)
    assert_allclose(rod.wrench, [*force, *np.cross(state.tip_position[0], force)], atol=1e-8)


def test_point_force_by_arclength():
    rod, force = Rod(soft_robot()), np.array([0.05, 0.0, 0.0])
    state = rod.settle(HOME, point_force=[(0.13, force)])
    at = rod.simulator.shape(0.13).position[0, 0]
    assert_allclose(rod.wrench, [*force, *np.cross(at, force)], atol=1e-8)
    assert state.ok.all()


@pytest.mark.parametrize("step", [0.0007, 0.004, 0.01, 0.023, 0.1])
def test_clock_is_the_engines_whatever_its_step(step):
    rod = Rod(soft_robot(), dt=0.01)
    n = round(0.2 / step)
    for _ in range(n):
        rod.advance(HOME, STILL, step)
    assert rod.time == pytest.approx(n * step, rel=1e-12)


@pytest.mark.parametrize("step", [0.003, 0.01, 0.025, 0.06])
def test_rod_is_where_the_base_will_be_at_the_end_of_the_step(step):
    # a base on a circle, with its true pose and twist: the rod of the next step stands on the pose that a
    # constant twist leads to
    robot, rate, radius = soft_robot(), 2.0, 0.3
    rod = Rod(robot, dt=0.01)
    rest = rod.settle(HOME, tendon_length=robot.rest_tendon_length + PULL).tip_position[0]
    for k in range(round(0.3 / step)):
        angle = rate * k * step
        place = radius * np.array([np.cos(angle), np.sin(angle), 0.0])
        pose = np.array([*place, *quaternion_from_vector(np.array([0.0, 0.0, angle]))])
        twist = np.array([*(rate * np.array([-place[1], place[0], 0.0])), 0.0, 0.0, rate])
        state = rod.advance(pose, twist, step)
        end = Motion(pose, twist).after(step)
        assert_allclose(rod.base, end, atol=1e-12)
        orientation = matrix_from_quaternion(end[None, 3:])[0]
        # without loads it is carried as it is
        assert_allclose(state.tip_position[0], end[:3] + orientation @ rest, atol=1e-6)


def test_substeps_are_those_of_a_simulator_on_the_same_path():
    robot = soft_robot(line_density=0.3)
    rod, sim = Rod(robot, dt=0.01), Simulator(robot, dt=0.01, points_per_segment=10, threads=1)
    pose, twist = np.array(HOME), np.array([0.1, 0.0, 0.2, 0.0, 1.5, 0.3])
    rod.settle(pose)
    sim.settle(robot.rest_tendon_length, base_pose=pose)
    state = rod.advance(pose, twist, 0.04, tip_force=(0.01, 0.0, 0.0))
    for k in range(4):
        expected = sim.step(
            robot.rest_tendon_length,
            tip_force=(0.01, 0.0, 0.0),
            base_pose=Motion(pose, twist).after(0.01 * (k + 1)),
        )
    assert_array_equal(state.position, expected.position)
    assert_array_equal(rod.wrench, expected.base_wrench[0])


def test_weight_is_that_in_the_gravity_that_the_engine_gives():
    robot = soft_robot(line_density=0.3)
    for n, given in ((None, (0.1, 0.0, -1.62)), (2, [(0.1, 0.0, -1.62), (0.0, 0.0, 3.0)])):
        rod = Rod(robot, n_robots=n)
        rod.settle(HOME)
        assert_allclose(rod.wrench[..., 2], -9.81 * 0.3 * robot.length, rtol=1e-9)  # its own until then
        for more in ({"gravity": given}, {}):  # it stays as it was given
            rod.advance(HOME, STILL, 0.01, **more)
            assert_allclose(rod.wrench[..., :3], 0.3 * robot.length * np.array(given), atol=1e-9)
    with pytest.raises(InputError, match="gravity is a masked array"):
        rod.advance(HOME, STILL, 0.01, gravity=np.ma.array(given[0], mask=[1, 0, 0]))


def test_memory_of_the_tendons_runs_on_the_engines_clock():
    # what it has done after 60 ms is the same in steps of any length, to the order of the steps
    tips = []
    for step in (0.0025, 0.005, 0.03):
        rod = Rod(LAGGED, dt=0.005)
        rod.settle(HOME)
        for _ in range(round(0.06 / step)):
            state = rod.advance(HOME, STILL, step, tendon_length=LAGGED.rest_tendon_length + PULL[:4])
        tips.append(state.tip_position[0])
    assert_allclose(tips[2], tips[1], atol=1e-6)
    assert 0.0 < np.linalg.norm(tips[0] - tips[1]) < 2e-4  # half the step: of the first order, 4 % of the way


def test_capsules_follow_the_chords_and_their_velocity_leads_there():
    rod = Rod(soft_robot(), capsules_per_segment=5)
    state = rod.settle(HOME, tendon_length=rod.robot.rest_tendon_length + PULL)
    before, nodes = rod.capsules, state.position[0, ::2]
    assert_allclose(before.ends, np.stack([nodes[:-1], nodes[1:]], axis=1), atol=1e-12)
    assert_allclose(before.radius, 0.012)
    assert not before.velocity.any()
    twist = np.array([0.1, -0.2, 0.3, 1.0, 2.0, -1.0])
    rod.advance(HOME, twist, 0.003)
    after, velocity = rod.capsules, rod.capsules.velocity
    assert_allclose(before.center + 0.003 * velocity[:, :3], after.center, atol=1e-12)
    turned = product(quaternion_from_vector(0.003 * velocity[:, 3:]), before.quaternion)
    assert_allclose(np.abs((turned * after.quaternion).sum(1)), 1.0, atol=1e-12)
    # a rod that is carried as it is moves as a rigid body does, to the first order of the step
    assert_allclose(velocity[:, :3], twist[:3] + np.cross(twist[3:], before.center), atol=5e-3)
    assert_allclose(velocity[:, 3:], np.tile(twist[3:], (10, 1)), atol=1e-4)


def test_wall_bends_the_rod_as_in_the_simulator_and_comes_in_substeps():
    robot = soft_robot()
    scene = ContactScene(obstacles=[plane(point=(0, 0, 0), normal=(-1, 0, 0), name="wall")])
    rod, sim = (make(robot, dt=0.01, contact=scene, points_per_segment=10) for make in (Rod, Simulator))

    def wall(x):
        return {"wall": (x, 0.0, 0.0, np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0)}

    rod.settle(HOME, obstacle_pose=wall(0.03))
    sim.settle(robot.rest_tendon_length, obstacle_pose=wall(0.03))
    rod.advance(HOME, STILL, 0.05, obstacle_pose=wall(0.005))
    for k in range(5):
        expected = sim.step(robot.rest_tendon_length, obstacle_pose=wall(0.03 - 0.005 * (k + 1)))
    assert rod.state.contacts.count[0] > 0
    assert rod.wrench[0] < -0.01
    assert_allclose(rod.wrench, expected.base_wrench[0], atol=1e-9)


def test_many_rods_are_as_many_single_ones():
    robot = soft_robot(line_density=0.2)
    many = Rod(robot, n_robots=3, dt=0.01)
    turns = [quaternion_from_vector(np.array([0.0, 0.4 * k, 0.0])) for k in range(3)]
    poses = np.array([[0.1 * k, 0.0, 0.0, *q] for k, q in enumerate(turns)])
    twists = np.array([[0.0, 0.1 * k, 0.0, 0.0, 0.0, 0.3 * k] for k in range(3)])
    for _ in range(3):
        state = many.advance(poses, twists, 0.015, tip_force=[[0.01 * k, 0.0, 0.0] for k in range(3)])
    assert many.wrench.shape == (3, 6)
    assert many.base.shape == (3, 7)
    assert many.capsules.ends.shape == (3, 20, 2, 3)
    for k in range(3):
        one = Rod(robot, dt=0.01)
        for _ in range(3):
            one.advance(poses[k], twists[k], 0.015, tip_force=(0.01 * k, 0.0, 0.0))
        assert_allclose(state.position[k], one.state.position[0], atol=1e-12)
        assert_allclose(many.wrench[k], one.wrench, atol=1e-10)
        assert_allclose(many.capsules.velocity[k], one.capsules.velocity, atol=1e-9)


@pytest.mark.parametrize("walled", [False, True])
def test_rod_that_fails_leaves_its_neighbour_alone(monkeypatch, walled):
    # what the tendons of row 0 remember has moved once a step, as in a lone rod, whatever becomes of row 1
    scene = beside_a_wall(walled)
    pair, lone = Rod(LAGGED, n_robots=2, contact=scene), Rod(LAGGED, contact=scene)
    step, anew, settled = pair.simulator.step, pair.simulator.settle, []

    def fails(*a, **b):
        return replace(step(*a, **b), ok=np.array([True, False]), problems={1: "contact: it stands."})

    def counted(*a, **b):
        settled.append(1)
        return anew(*a, **b)

    for rod in (pair, lone):
        rod.settle(HOME)
    monkeypatch.setattr(pair.simulator, "step", fails)
    monkeypatch.setattr(pair.simulator, "settle", counted)
    tendons = LAGGED.rest_tendon_length + PULL[:4]
    for k in range(6):
        given = {"tendon_length": tendons, "tip_force": (0.02 * k, 0.0, 0.0)}
        both, one = (rod.advance(HOME, STILL, 0.01, **given) for rod in (pair, lone))
        assert_array_equal(both.position[0], one.position[0])
        assert_array_equal(pair.wrench[0], lone.wrench)
    assert settled
    assert not walled or one.contacts.count[0] > 0


@pytest.mark.parametrize("walled", [False, True])
def test_bad_input_of_one_rod_is_reported_and_the_others_continue(walled):
    scene = beside_a_wall(walled)
    pair, lone = Rod(LAGGED, n_robots=2, contact=scene), Rod(LAGGED, contact=scene)
    tendons, force = LAGGED.rest_tendon_length + PULL[:4], np.array([0.02, 0.01, 0.0])
    for rod in (pair, lone):
        for _ in range(3):
            rod.advance(HOME, STILL, 0.015, tendon_length=tendons, tip_force=force)
    shape, wrench, capsules = pair.state.position[1], pair.wrench[1], pair.capsules.center[1]
    for k in range(4):
        both = pair.advance(HOME, (0.1, 0, 0, 0, 0, 0), 0.015, tip_force=[force, [np.nan, 0.0, 0.0]])
        one = lone.advance(HOME, (0.1, 0, 0, 0, 0, 0), 0.015, tip_force=force)
        assert_array_equal(both.position[0], one.position[0])
        assert_array_equal(pair.wrench[0], lone.wrench)
        assert both.ok.tolist() == [True, False]
        assert "tip_force" in both.problems[1]
        assert_array_equal(both.position[1], shape)
        assert_array_equal(pair.capsules.center[1], capsules)
        assert_array_equal(pair.base[1], HOME)
        # a step of the engine halves it once, not each part
        assert_allclose(pair.wrench[1], 0.5 ** (k + 1) * wrench, rtol=1e-14)
    assert pair.failures.tolist() == [0, 8]
    assert pair.failed == 8
    assert pair.time == lone.time
    back = pair.advance(HOME, STILL, 0.015, tip_force=force)
    assert back.ok.all()
    assert pair.failures.tolist() == [0, 0]


def test_rod_that_is_reset_settles_and_the_others_go_on():
    pair, going, again = Rod(LAGGED, n_robots=2), Rod(LAGGED), Rod(LAGGED)
    for k in range(5):
        if k == 3:
            pair.reset(rows=[1])
            again.reset()
            assert not pair.wrench[1].any()
        tendons = LAGGED.rest_tendon_length + (PULL[:4] if k else 0.0)
        for rod in (pair, going, again):
            rod.advance(HOME, STILL, 0.01, tendon_length=tendons, tip_force=(0.0, 0.02, 0.0))
        assert_array_equal(pair.state.position[0], going.state.position[0])
        assert_allclose(pair.state.position[1], again.state.position[0], atol=1e-12)
        assert_allclose(pair.wrench, [going.wrench, again.wrench], atol=1e-10)
        assert_allclose(pair.capsules.velocity[1], again.capsules.velocity, atol=1e-9)
    with pytest.raises(InputError, match=r"^rows is \[5\]; give indices of robots from 0 to 1, or a mask\.$"):
        pair.reset(rows=[5])


def test_what_the_caller_writes_into_its_own_arrays_changes_nothing():
    robot = soft_robot()
    given = {
        "tendon_length": robot.rest_tendon_length + PULL,
        "tip_force": np.array([0.02, 0.0, 0.0]),
        "point_force": [(0.13, np.array([0.0, 0.05, 0.0]))],
    }
    rod, twin = Rod(robot), Rod(robot)
    twin.advance(HOME, STILL, 0.01, **deepcopy(given))
    rod.advance(HOME, STILL, 0.01, **given)
    then = rod.snapshot()
    given["tendon_length"][:], given["tip_force"][:], given["point_force"][0][1][:] = 0.0, 7.0, -3.0
    rod.capsules.center[:] = 0.0
    for _ in range(2):
        assert_array_equal(rod.advance(HOME, STILL, 0.01).position, twin.advance(HOME, STILL, 0.01).position)
        assert_array_equal(rod.capsules.velocity, twin.capsules.velocity)
    rod.restore(then)
    twin.restore(then)
    assert_array_equal(rod.advance(HOME, STILL, 0.01).position, twin.advance(HOME, STILL, 0.01).position)


def test_rod_that_is_lost_is_refused_and_nothing_has_moved(monkeypatch):
    rods = Rod(soft_robot(), n_robots=2)
    with pytest.raises(HostError, match=r"^rod 1 of 2 is lost: .*tip_force"):
        rods.advance(HOME, STILL, 0.01, tip_force=[[0, 0, 0], [np.nan, 0, 0]])
    good = rods.advance(HOME, STILL, 0.01)
    then, step, calls = rods.snapshot(), rods.simulator.step, []

    def lost_at_last(*a, **b):
        calls.append(1)
        return step(*a, **b) if len(calls) < 3 else replace(good, tip_position=np.full((2, 3), np.nan))

    with monkeypatch.context() as patch:
        patch.setattr(rods.simulator, "step", lost_at_last)
        with pytest.raises(HostError, match=r"^rod 0 of 2 is lost: its shape is not finite$"):
            rods.advance(HOME, (0.5, 0, 0, 0, 0, 0), 0.03, tip_force=(0.05, 0.0, 0.0))
    assert len(calls) == 3
    assert rods.state is good
    assert rods.time == 0.01
    after = rods.advance(HOME, STILL, 0.02)
    rods.restore(then)
    assert_array_equal(rods.advance(HOME, STILL, 0.02).position, after.position)


def test_snapshot_goes_back_and_reset_keeps_inputs_and_clock():
    robot = soft_robot()
    rod = Rod(robot)
    rod.advance(HOME, STILL, 0.01, tip_force=(0.02, 0.0, 0.0))
    then = rod.snapshot()

    def steps():
        return [rod.advance(HOME, (0.1, 0, 0, 0, 0, 1.0), 0.013).tip_position.copy() for _ in range(3)]

    first = steps()
    rod.advance(HOME, STILL, 0.5, tip_force=(0.0, 0.05, 0.0))
    rod.restore(then)
    assert rod.time == 0.01
    assert_array_equal(first, steps())
    rod.reset()
    assert not rod.wrench.any()
    assert rod.time == pytest.approx(0.049)
    rod.advance((1.0, 0, 0, 1, 0, 0, 0), STILL, 0.01)
    assert_allclose(rod.wrench[:3], [0.02, 0.0, 0.0], atol=1e-9)
    with pytest.raises(InputError, match=r"^the snapshot is a dict; give what Rod.snapshot\(\) returned\.$"):
        rod.restore({})


def moved(base=HOME, twist=STILL, step=0.01, **inputs):
    return lambda rod: rod.advance(base, twist, step, **inputs)


@pytest.fixture(scope="module")
def stepped():
    """A rod that has taken a step."""
    rod = Rod(soft_robot())
    rod.advance(HOME, STILL, 0.01)
    return rod


BAD_INPUT = {
    (
        r"^base_pose has shape \(3,\); it must be \(7,\), "
        r"position \[m\] and quaternion w x y z\.$"
    ): moved((0, 0, 0)),
    r"^base_twist has shape \(3,\); it must be \(6,\), velocity": moved(twist=(0, 0, 0)),
    r"^base_pose has a quaternion of norm 2; it must be 1, as w x y z\.$": moved((0, 0, 0, 2, 0, 0, 0)),
    r"^base_pose holds a value that is not finite": moved((np.nan, 0, 0, 1, 0, 0, 0)),
    r"^base_twist holds a value that is not finite": moved(twist=(np.inf, 0, 0, 0, 0, 0)),
    r"^base_pose is not an array of numbers; give \(7,\)": moved("here"),
    r"^time_step is -0.01 s; it must be a number, positive and finite\.$": moved(step=-0.01),
    r"^time_step is 'dt' s; it must be a number, positive and finite": moved(step="dt"),
    r"^time_step is 5000 s, 500000 of the rod's steps of 0.01 s; was it given in ms\?$": moved(step=5000.0),
    r"^a rod has no input 'tip_fource'; did you mean 'tip_force'\?$": moved(tip_fource=(0, 0, 0)),
    r"^a rod has no input 'obstacle_pose'; it needs a contact scene: Rod\(robot, contact=": moved(
        obstacle_pose={}
    ),
    r"^tip_force holds a value that is not finite": moved(tip_force=(0, np.nan, 0)),
}


@refusals({InputError: BAD_INPUT})
def test_bad_input_moves_nothing(stepped, error, sentence, call):
    before = stepped.snapshot()
    with pytest.raises(error, match=sentence):
        call(stepped)
    assert stepped.time == before.time
    assert_allclose(stepped.advance(HOME, STILL, 0.01).position, before.state.position, atol=1e-12)


def two_in_one_world():
    return ContactScene(obstacles=[box((1, 1, 1), name="b", position=(9, 0, 0))], worlds=[0, 0])


NO_ROD = {
    r"^the rod has no state yet; call advance or settle first\.$": lambda r: Rod(r).state,
    r"^the rod has no state yet": lambda r: Rod(r).capsules,
    r"^3 capsules for 10 points of a segment; give a divisor of the points\.$": lambda r: Rod(
        r, capsules_per_segment=3
    ),
    r"^contact is 'x'; give fastrod.contact.ContactScene\(obstacles=\[\.\.\.\]\) or None\.$": lambda r: Rod(
        r, contact="x"
    ),
    r"^n_robots is True; give how many rods there are, or None for one without a robot axis\.$": lambda r: (
        Rod(r, n_robots=True)
    ),
    r"^dt is 0 s; it must be a number, positive and finite\.$": lambda r: Rod(r, dt=0),
    r"^ContactScene.worlds puts several rods into one world": lambda r: Rod(
        r, n_robots=2, contact=two_in_one_world()
    ),
    r"^base_pose has shape \(4, 7\); it must be \(7,\) or \(2, 7\)": lambda r: Rod(r, n_robots=2).advance(
        np.tile(HOME, (4, 1)), STILL, 0.01
    ),
}
NO_ROBOT = {
    r"^robot is \[.*; give one Robot, for example fastrod.load_robot\('prototype'\)\.$": lambda r: Rod(
        [r, r], n_robots=2
    ),
    r"^robot is '.*; give one Robot, for example fastrod.load_robot\('prototype'\)\.$": lambda r: Rod(
        "prototype", n_robots=2
    ),
}


@refusals({InputError: NO_ROD, RobotError: NO_ROBOT})
def test_what_no_rod_can_be_is_a_sentence(error, sentence, call):
    with pytest.raises(error, match=sentence):
        call(soft_robot())


def test_rod_that_stays_lost_is_reported(monkeypatch):
    rod = Rod(soft_robot())
    good = rod.advance(HOME, STILL, 0.01, tip_force=(0.1, 0.0, 0.0))
    lost = replace(good, ok=np.array([False]), problems={0: "contact: it stands."})
    for path in ("step", "settle"):
        monkeypatch.setattr(rod.simulator, path, lambda *a, **b: lost)
    rod.advance(HOME, STILL, 0.01)
    assert_allclose(rod.wrench, 0.5 * good.base_wrench[0])
    assert rod.failed == 1
    for _ in range(24):
        rod.advance(HOME, STILL, 0.01)
    sentence = r"^26 steps in a row could not be solved, the last: contact: it stands\."
    with pytest.raises(HostError, match=sentence):
        rod.advance(HOME, STILL, 0.01)
    nothing = replace(good, tip_position=np.full((1, 3), np.nan), problems={})
    monkeypatch.setattr(rod.simulator, "settle", lambda *a, **b: nothing)
    with pytest.raises(HostError, match=r"^the rod is lost: its shape is not finite$"):
        rod.settle(HOME)
