"""Rods against obstacles through the simulator: published figures, statics, friction, and what may never
happen."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from contact.robots import bent, passive, prototype
from numpy.testing import assert_allclose, assert_array_equal

import fastrod
from fastrod import Modal, Modes
from fastrod.contact import ContactScene, box, cylinder, mesh, plane, sphere
from fastrod.errors import FastrodError

ON_SIDE = (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)  # turns the axis of a cylinder to y


def wall(stiffness: float = np.inf, friction: float = 0.0) -> ContactScene:
    return ContactScene(
        obstacles=[
            plane(point=(0.012, 0, 0), normal=(-1, 0, 0), name="wall", stiffness=stiffness, friction=friction)
        ],
        rod_radius=0.0,
    )


def bar(friction: float = 0.0, **options) -> ContactScene:
    return ContactScene(
        obstacles=[
            cylinder(0.01, 0.2, name="bar", position=(0.018, 0, 0.05), quaternion=ON_SIDE, friction=friction)
        ],
        rod_radius=0.003,
        **options,
    )


# tip force [N] and tip z [m] of a rod whose tendons do not stretch
@pytest.mark.parametrize(
    ("curvature", "force", "z"), [(8.0, 0.576, 0.067955), (12.0, 1.323, 0.066458), (16.0, 2.071, 0.064271)]
)
def test_tip_pressed_on_a_wall(curvature, force, z):
    state = fastrod.Simulator(prototype(), contact=wall()).settle(bent(curvature))
    assert state.ok.all()
    # a contact is 1e-8 m deep under a newton
    assert state.tip_position[0, 0] == pytest.approx(0.012 + 1e-8 * force, abs=1e-9)
    assert state.tip_position[0, 2] == pytest.approx(z, abs=1e-5)
    assert_allclose(state.contacts.force[0, 0], [-force, 0, 0], rtol=0, atol=0.01 * force)
    assert state.contacts.in_contact("wall").all()
    assert state.contacts.tip_in_contact.all()


def test_soft_walls_approach_the_rigid_one():
    rigid = fastrod.Simulator(prototype(), contact=wall()).settle(bent(12.0))
    depth, force = [], []
    for stiffness in (10.0, 100.0, 1e3, 1e4, 1e5):
        sim = fastrod.Simulator(prototype(), dt=0.05, contact=wall(stiffness))
        settled = sim.settle(bent(12.0))
        sim.reset()
        for _ in range(3):
            stepped = sim.step(bent(12.0))
        assert settled.ok.all()
        assert stepped.ok.all()
        assert_allclose(stepped.tip_position, settled.tip_position, rtol=0, atol=1e-7)
        depth.append(settled.tip_position[0, 0] - 0.012)
        force.append(-settled.contacts.force[0, 0, 0])
        assert depth[-1] == pytest.approx(force[-1] * (1.0 / stiffness + 1e-8), abs=1e-9)
    assert (np.diff(depth) < 0.0).all()
    assert (np.diff(force) > 0.0).all()
    assert depth[-1] > 0.0
    assert force[-1] < -rigid.contacts.force[0, 0, 0]
    assert force[-1] == pytest.approx(-rigid.contacts.force[0, 0, 0], rel=1e-2)


@pytest.mark.parametrize("stiffness", [4.0, 100.0])
def test_rod_that_lies_on_a_soft_floor_needs_no_contact_at_every_place(stiffness):
    """A contact more is a spring more: there are no more of them than hold the rod, however many it might
    have."""
    robot, press, half = passive(0.2, 0.0022, 0.0), [], np.sqrt(0.5)
    for most in (16, 32):
        floor = plane(point=(0, 0, -0.005), normal=(0, 0, 1), name="floor", stiffness=stiffness)
        sim = fastrod.Simulator(
            robot, contact=ContactScene(obstacles=[floor], rod_radius=0.012, max_contacts=most)
        )
        state = sim.settle(base_pose=[0.0, 0.0, 0.006, half, 0.0, half, 0.0])
        assert state.ok.all(), state.problems
        press.append(state.contacts.total_force[0, 2])
        assert state.contacts.count[0] < 16
    assert press[0] == pytest.approx(press[1], rel=1e-9)
    assert press[0] > 0.5e-3 * stiffness  # the rod is clamped 1 mm inside, and its first contact hardly moves


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("dt", [1e-3, 5e-2])
@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_at_rest_nothing_chatters(dt, friction):
    sim = fastrod.Simulator(prototype(1e-5), dt=dt, contact=bar(friction))
    n = 20
    for i in range(n + 1):
        state = sim.step(bent(14.0 * i / n, 2.0 * i / n))
        assert state.ok.all(), state.problems
        assert state.contacts.clearance[0] > -1e-4
    tips = []
    for _ in range(200):
        state = sim.step(bent(14.0, 2.0))
        tips.append(state.tip_position[0])
    assert state.contacts.count[0] >= 1
    assert np.ptp(tips, axis=0).max() < 1e-6
    assert state.contacts.clearance[0] > -1e-6


def test_forces_and_moments_balance():
    half = np.sqrt(0.5)
    base = [0.01, -0.02, 0.03, half, 0.0, half, 0.0]
    obstacle = sphere(0.03, name="ball", position=(0.06, -0.01, -0.012), friction=0.4)
    sim = fastrod.Simulator(prototype(1e-5), contact=ContactScene(obstacles=[obstacle], rod_radius=0.004))
    load, line = np.array([0.05, -0.1, -0.2]), np.array([0.0, 0.0, -1.0])
    for i in range(11):
        state = sim.settle(bent(0.5 * i, 0.4 * i), tip_force=load, line_force=line, base_pose=base)
        assert state.ok.all(), state.problems
    contacts = state.contacts
    assert contacts.count[0] >= 1
    force = contacts.total_force[0] + load + 0.07 * line
    assert_allclose(state.base_wrench[0, :3], force, rtol=0, atol=1e-6)
    arm = state.position[0] - base[:3]
    weight = np.trapezoid(np.cross(arm, line), state.arclength[0], axis=0)
    moment = weight + np.cross(arm[-1], load)
    for point, f in zip(contacts.point[0], contacts.force[0], strict=True):
        moment += np.cross(point - base[:3], f)
    assert_allclose(state.base_wrench[0, 3:], moment, rtol=0, atol=1e-6)
    assert_allclose(contacts.wrench[0, 0, :3], -contacts.total_force[0], rtol=0, atol=1e-12)


def test_friction_holds_then_slides_and_takes_energy():
    """The tip is dragged along a wall: within the cone it sticks, beyond it slides against the force on
    it."""
    friction, sim = 0.4, fastrod.Simulator(prototype(1e-5), contact=wall(friction=0.4))
    state = sim.settle(bent(12.0))
    state = sim.settle(bent(12.0))
    states = [state]
    for i in range(1, 41):
        states.append(sim.step(bent(12.0, 0.25 * i)))
        assert states[-1].ok.all(), states[-1].problems
    stuck, slid, work = 0, 0, 0.0
    for before, after in itertools.pairwise(states):
        f = after.contacts.force[0, 0]
        across, pressed = f.copy(), -f[0]
        across[0] = 0.0
        slip = after.tip_position[0] - before.tip_position[0]
        slip[0] = 0.0
        assert pressed > 0.0
        assert np.linalg.norm(across) <= friction * pressed * (1.0 + 1e-6)
        work += across @ slip
        # friction never adds energy: what sticks may still creep by the 1e-6 m to which a step is at rest,
        # what slides loses some
        assert across @ slip <= 1e-6 * np.linalg.norm(across)
        if np.linalg.norm(across) < friction * pressed * (1.0 - 1e-4):
            assert np.linalg.norm(slip) < 2e-6  # a step is at rest to 1e-6 m
            stuck += 1
        else:
            assert across @ slip < 0.0
            slid += 1
    assert work < 0.0
    assert stuck > 3
    assert slid > 3


def test_a_moving_belt_drags_the_tip():
    """Velocity without a change of pose: the surface slips under the rod, which leans after it within the
    cone."""
    sim = fastrod.Simulator(prototype(1e-5), contact=wall(friction=0.3))
    sim.settle(bent(10.0))
    for _ in range(30):
        state = sim.step(bent(10.0), obstacle_velocity={"wall": [0, 0.05, 0, 0, 0, 0]})
    f = state.contacts.force[0, 0]
    assert f[1] == pytest.approx(0.3 * -f[0], rel=1e-3)
    assert state.tip_position[0, 1] > 1e-4


def test_a_rising_bar_lifts_a_heavy_rod():
    robot = passive()
    scene = ContactScene(obstacles=[cylinder(0.03, 0.2, name="bar", quaternion=ON_SIDE)], rod_radius=0.004)
    sim = fastrod.Simulator(robot, contact=scene)
    low, high = -0.08, -0.03
    for height in np.linspace(low, high, 11):
        state = sim.settle(obstacle_pose={"bar": [0.15, 0, height, *ON_SIDE]})
        assert state.ok.all(), state.problems
    weight = 0.3 * 9.81 * robot.length
    assert state.contacts.wrench[0, 0, 2] + state.base_wrench[0, 2] == pytest.approx(-weight, abs=1e-6)
    assert state.contacts.wrench[0, 0, 2] < -0.2 * weight
    pressed = np.linalg.norm(state.contacts.force[0], axis=1).max()
    assert state.contacts.clearance[0] > -1e-8 * pressed - 1e-9  # 1e-8 m under a newton


def test_thousands_of_small_steps_end_where_settle_does():
    swept = fastrod.Simulator(prototype(1e-5), contact=bar())
    for i in range(101):
        state = swept.step(bent(0.12 * i, 0.01 * i))
    at_once = fastrod.Simulator(prototype(1e-5), contact=bar()).settle(bent(12.0, 1.0))
    assert_allclose(state.tip_position, at_once.tip_position, rtol=0, atol=2e-6)
    assert_allclose(state.contacts.total_force, at_once.contacts.total_force, rtol=1e-3)


def test_batch_equals_robots_alone():
    curvature = np.linspace(4.0, 14.0, 24)
    scene = bar(friction=0.2)
    together = fastrod.Simulator(prototype(1e-5), n_robots=24, contact=scene)
    path = np.linspace(0.0, 1.0, 8)
    for part in path:
        batch = together.step(bent(part * curvature, 2.0 * part))
    for i in (0, 11, 23):
        alone = fastrod.Simulator(prototype(1e-5), contact=scene)
        for part in path:
            one = alone.step(bent(part * curvature[i], 2.0 * part))
        assert_allclose(batch.tip_position[i], one.tip_position[0], rtol=0, atol=1e-12)
        assert_allclose(batch.contacts.total_force[i], one.contacts.total_force[0], rtol=0, atol=1e-9)


@pytest.mark.study
def test_adversarial_starts_and_jumps_end_outside_or_flagged():
    """Random balls and boxes, robots cold in the middle of them, then random jumps."""
    rng = np.random.default_rng(7)
    n = 150
    obstacles = [sphere(0.02, name="ball"), box((0.03, 0.05, 0.02), name="block")]
    scene = ContactScene(obstacles=obstacles, rod_radius=0.002)
    sim = fastrod.Simulator(prototype(1e-5), n_robots=n, points_per_segment=12, contact=scene)
    turn = rng.normal(size=(2, n, 4))
    turn /= np.linalg.norm(turn, axis=-1, keepdims=True)
    place = rng.uniform([-0.05, -0.05, 0.0], [0.05, 0.05, 0.09], size=(2, n, 3))
    poses = {name: np.concatenate([place[k], turn[k]], axis=1) for k, name in enumerate(scene.names)}
    well = 0
    for _ in range(3):
        state = sim.step(bent(rng.uniform(-14, 14, n), rng.uniform(-14, 14, n)), obstacle_pose=poses)
        good = state.ok
        well += good.sum()
        assert np.isfinite(state.position[good]).all()
        assert np.isfinite(state.contacts.total_force).all()
        assert (sim.clearance()[good] > -1e-4).all()  # rest is outside, or it is not called rest
        assert set(state.problems) == set(np.flatnonzero(~good))
        assert all(len(sentence) > 20 for sentence in state.problems.values())
    assert well > 1.5 * n


def test_a_thin_wall_is_not_jumped():
    """In one step the inputs ask for the other side of a sheet of 1 mm: the rod stays on its own."""
    sheet = box((0.001, 0.2, 0.2), position=(0.012, 0, 0.05), name="sheet")
    sim = fastrod.Simulator(prototype(1e-5), contact=ContactScene(obstacles=[sheet], rod_radius=0.0))
    sim.settle(bent(0.0))
    state = sim.step(bent(25.0))
    assert state.tip_position[0, 0] <= 0.0115 + 1e-6
    assert state.ok.all()
    assert state.contacts.in_contact("sheet").all()


def test_a_mesh_bears_as_its_shape_does():
    import trimesh

    exact = fastrod.Simulator(prototype(1e-5), contact=bar()).settle(bent(12.0, 1.0))
    tessellated = mesh(
        trimesh.creation.cylinder(0.01, 0.2, sections=720),
        name="bar",
        position=(0.018, 0, 0.05),
        quaternion=ON_SIDE,
    )
    state = fastrod.Simulator(
        prototype(1e-5), contact=ContactScene(obstacles=[tessellated], rod_radius=0.003)
    ).settle(bent(12.0, 1.0))
    assert state.ok.all(), state.problems
    assert_allclose(state.tip_position, exact.tip_position, rtol=0, atol=2e-6)
    assert_allclose(state.contacts.total_force, exact.contacts.total_force, rtol=0, atol=0.02)


def test_two_rods_press_each_other():
    base = np.array([[0, 0, 0, 1, 0, 0, 0], [0.03, 0.004, 0, 1, 0, 0, 0]], dtype=float)
    sim = fastrod.Simulator(
        prototype(1e-5), n_robots=2, contact=ContactScene(worlds=[0, 0], rod_radius=0.004)
    )
    for i in range(1, 9):
        state = sim.settle(bent([1.0 * i, -1.2 * i], [0.2 * i, -0.3 * i]), base_pose=base)
        assert state.ok.all(), state.problems
    assert state.contacts.in_contact("rod 1")[0]
    assert state.contacts.in_contact("rod 0")[1]
    assert_allclose(state.contacts.total_force[0], -state.contacts.total_force[1], rtol=0, atol=1e-9)
    assert_allclose(state.base_wrench[:, :3], state.contacts.total_force, rtol=0, atol=1e-9)
    assert abs(sim.clearance()).max() < 1e-7


def test_queries():
    sim = fastrod.Simulator(prototype(1e-5), contact=wall())
    state = sim.settle(bent(0.0))
    assert sim.clearance("wall") == pytest.approx(0.012, abs=1e-9)
    assert not state.contacts.in_contact().any()
    hits = sim.ray_cast([[0, 0, 0.03], [0, 0, 0.03]], [[2, 0, 0], [-1, 0, 0]])
    assert hits.distance[0, 0] == pytest.approx(0.012)
    assert hits.obstacle.tolist() == [[0, -1]]
    assert_allclose(hits.normal[0, 0], [-1, 0, 0], rtol=0, atol=1e-12)
    free = fastrod.Simulator(
        prototype(1e-5),
        contact=ContactScene(obstacles=[sphere(0.005, position=(0, 0.02, 0.066))], rod_radius=0.0),
    )
    free.settle(bent(0.0, -6.0))
    free.step(bent(0.0, 3.0))
    ends = free.clearance()
    assert free.swept_clearance()[0] <= ends[0] + 1e-12


def test_overlap_is_the_way_out():
    scene = ContactScene(obstacles=[sphere(0.01, name="ball"), cylinder(0.01, 0.2, name="bar")])
    sim = fastrod.Simulator(prototype(), n_robots=2, contact=scene, feel_contact=False)
    sim.settle(bent([3.0, 9.0]))
    poses = {
        "ball": np.array([0.01, 0.006, 0.05, 1.0, 0.0, 0.0, 0.0]),
        "bar": np.array([0.02, 0.0, 0.04, 0.0, 0.0, 0.6, 0.8]),
    }
    out = sim.overlap(poses)
    assert (np.linalg.norm(out, axis=2) > 1e-4).any(0).all()
    for k, (name, pose) in enumerate(poses.items()):
        there = np.tile(pose, (2, 1))
        there[:, :3] += out[:, k]
        sim.step(bent([3.0, 9.0]), obstacle_pose={name: there})
        inside = out[:, k].any(1)
        assert_allclose(sim.clearance(name)[inside], 0.0, rtol=0, atol=1e-9)
        assert (sim.clearance(name)[~inside] > 0.0).all()
        assert not sim.overlap({})[~inside, k].any()


def test_obstacles_that_are_seen_and_not_felt():
    sim = fastrod.Simulator(prototype(1e-5), n_robots=2, contact=wall(), feel_contact=False)
    twin = fastrod.Simulator(prototype(1e-5), n_robots=2)
    felt = fastrod.Simulator(prototype(1e-5), contact=wall())
    for curvature in (0.0, 4.0, 12.0):
        free = twin.step(bent(curvature))
        state = sim.step(bent(curvature))
        assert_array_equal(state.position, free.position)
        assert state.contacts is None
    felt.settle(bent(0.0))
    sim.settle(bent(0.0))
    assert sim.clearance()[0] == felt.clearance()[0]
    sim.settle(bent(12.0))
    assert sim.clearance()[0] < -0.01
    swept = sim.swept_clearance(rows=[1])
    assert np.isnan(swept[0])
    assert swept[1] <= sim.clearance()[1] + 1e-12
    moved = sim.step(bent(12.0), obstacle_pose={"wall": [0, 0, -1.0, 1, 0, 0, 0]})  # its normal is now z
    assert moved.ok.all()
    assert sim.clearance()[0] == pytest.approx(1.0)


def test_compliance_and_jacobian_hold_the_contact_forces():
    """With the contact forces held, a small change of a tendon moves the tip as the same rod with those
    forces as loads."""
    sim = fastrod.Simulator(prototype(1e-5), contact=bar())
    state = sim.settle(bent(12.0, 1.0))
    free = fastrod.Simulator(prototype(1e-5), solver=Modal(modes=Modes(6, 4, pieces=2)))
    loads = list(zip(state.contacts.arclength[0], state.contacts.force[0], strict=True))
    free.settle(bent(12.0, 1.0), point_force=loads)
    assert_allclose(sim.jacobian()[:, :, :4], free.jacobian()[:, :, :4], rtol=1e-4, atol=1e-6)
    assert_allclose(sim.compliance(), free.compliance(), rtol=1e-4, atol=1e-6)


def test_a_snapshot_holds_the_contacts():
    sim = fastrod.Simulator(prototype(1e-5), contact=bar(friction=0.3))
    for part in np.linspace(0.0, 1.0, 8):
        sim.step(bent(12.0 * part, 2.0 * part))
    snapshot = sim.snapshot()
    first = sim.step(bent(12.0, 4.0))
    sim.step(bent(0.0, -5.0))
    sim.restore(snapshot)
    again = sim.step(bent(12.0, 4.0))
    assert first.contacts.count[0] > 0
    assert_allclose(again.tip_position, first.tip_position, rtol=0, atol=0)
    assert_allclose(again.contacts.force, first.contacts.force, rtol=0, atol=0)
    with pytest.raises(FastrodError, match="contact scene"):
        fastrod.Simulator(prototype(1e-5)).restore(snapshot)


def test_tip_outputs_touch_as_full_ones_do():
    full, tip = (
        fastrod.Simulator(prototype(1e-5), contact=bar(), outputs=outputs) for outputs in ("full", "tip")
    )
    for part in np.linspace(0.0, 1.0, 6):
        whole, short = (sim.step(bent(12.0 * part, 1.0)) for sim in (full, tip))
    assert short.position.size == 0
    assert_allclose(short.tip_position, whole.tip_position, rtol=0, atol=0)
    assert_allclose(short.contacts.force, whole.contacts.force, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: ContactScene(obstacles=["wall"]), "fastrod.contact.mesh"),
        (lambda: ContactScene(obstacles=[sphere(0.1), sphere(0.2)]), "name of its own"),
        (lambda: ContactScene(rod_stiffness=0.0), "positive"),
        (lambda: fastrod.Simulator(prototype(), contact=sphere(0.1)), "ContactScene"),
        (lambda: fastrod.Simulator(prototype(), contact=ContactScene(rod_radius=5.0)), "mm"),
        (lambda: fastrod.Simulator(prototype(), contact=ContactScene(mounting=0.2)), "mounting"),
        (lambda: fastrod.Simulator(prototype(), 2, contact=ContactScene(worlds=[0])), "world of each"),
        (
            lambda: fastrod.Simulator(prototype()).step(bent(0.0), obstacle_pose={"wall": [0] * 7}),
            "contact scene",
        ),
        (
            lambda: fastrod.Simulator(prototype(), contact=wall()).step(
                bent(0.0), obstacle_pose={"wal": [0] * 7}
            ),
            "did you mean 'wall'",
        ),
        (
            lambda: fastrod.Simulator(prototype(), contact=wall()).step(
                bent(0.0), obstacle_pose={"wall": [0] * 6}
            ),
            "shape",
        ),
        (
            lambda: fastrod.Simulator(prototype(), contact=wall()).step(
                bent(0.0), obstacle_pose={"wall": [0, 0, 0, 2, 0, 0, 0]}
            ),
            "norm",
        ),
        (lambda: fastrod.Simulator(prototype()).clearance(), "contact scene"),
        (lambda: fastrod.Simulator(prototype(), contact=wall()).clearance(), "step or settle"),
    ],
)
def test_bad_input_is_one_sentence(call, words):
    with pytest.raises(FastrodError, match=words) as caught:
        call()
    assert str(caught.value).count("\n") == 0
