"""The box that a soft robot explores, and the fork that carries two: what the scenes' checks leave open."""

from itertools import combinations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fastrod.errors import RobotError
from fastrod.hosts import BulletLink, connect
from fastrod.rotation import matrix_from_quaternion, quaternion_from_vector
from fastrod_scenes.scene import SceneError
from fastrod_scenes.ur5.box import COLORS, CORNERS, Box
from fastrod_scenes.ur5.carried import Bracket, eased
from fastrod_scenes.ur5.dual_arm import PERIOD, DualArmScene, opposite
from fastrod_scenes.ur5.exploration import APPROACH, INSIDE, OUT, Exploration
from fastrod_scenes.ur5.explore import CLEARANCE, STILL, Explore
from fastrod_scenes.ur5.look import aim_jacobian, miss


def test_corners_are_eight_and_their_cubes_lie_in_them() -> None:
    box = Box()
    corners = np.array([box.corner(k) for k in range(8)])
    assert_allclose(np.ptp(corners, axis=0), box.inner)
    assert len({tuple(c) for c in corners.round(9)}) == len(set(CORNERS)) == len(set(COLORS)) == 8
    for k, corner in enumerate(corners):
        assert_allclose(np.abs(box.cube_at(k) - corner), 0.5 * box.cube)
        points = np.array([corner, box.cube_at(k), corner + np.array([0.0, 0.0, 0.01])])
        assert_allclose(box.off_cube(k, points)[:2], [0.0, 0.5 * box.cube], atol=1e-15)


def test_walls_leave_the_entry_open_and_nothing_else() -> None:
    """Rays along x at the front wall pass within the octagon alone; a box without an entry stops all."""
    at = np.random.default_rng(30).uniform(-0.09, 0.09, (400, 2))
    turned = np.abs(np.concatenate([at, (at @ [[1.0, 1.0], [-1.0, 1.0]]) / np.sqrt(2.0)], axis=1)).max(axis=1)
    for box in (Box(), Box(entry=0.0)):
        world = connect()
        walls, _ = box.build(world)
        start = np.column_stack([np.full(400, box.front - 0.1), at[:, 0], box.height + at[:, 1]])
        hits = world.rayTestBatch(start.tolist(), (start + np.array([0.2, 0.0, 0.0])).tolist())
        stopped = np.array([hit[0] == walls for hit in hits])
        away = np.abs(turned - box.entry) > 2e-3  # PyBullet's rays feel an edge a millimetre early
        assert (stopped == (turned > box.entry))[away].all()
        assert stopped.all() == (box.entry == 0.0)


def test_box_that_cannot_be_is_a_sentence() -> None:
    with pytest.raises(RobotError, match=r"an entry of half width 0.2 m"):
        Box(entry=0.2)


def test_aim_jacobian_is_the_slope_of_the_miss_where_it_is_zero() -> None:
    rng = np.random.default_rng(31)
    for _ in range(10):
        tip, vector, jacobian = rng.normal(size=3), rng.normal(size=3), rng.normal(size=(6, 4))
        rotation = matrix_from_quaternion(quaternion_from_vector(vector)[None])[0]
        point = tip + 0.3 * rotation[:, 2]
        slopes = []
        h = 1e-6
        for column in jacobian.T:
            ends = []
            for s in (h, -h):
                angle = matrix_from_quaternion(quaternion_from_vector(s * column[3:])[None])[0]
                ends.append(miss(tip + s * column[:3], angle @ rotation, point))
            slopes.append((ends[0] - ends[1]) / (2.0 * h))
        # the point comes nearer by as much as the line's end moves; central differences: h^2, and 1e-16 / h
        # from rounding
        assert_allclose(-aim_jacobian(tip, rotation, point, jacobian), np.transpose(slopes), atol=1e-8)


def test_miss_is_an_arc_and_behind_is_180_degrees() -> None:
    still = np.zeros(3), np.eye(3)
    assert_allclose(miss(*still, np.array([0.2, 0.0, 0.0])), [0.1 * np.pi, 0.0])
    assert_allclose(miss(*still, np.array([0.0, 0.0, 0.3])), [0.0, 0.0])
    assert_allclose(miss(*still, np.array([0.0, 0.0, -0.3])), [0.3 * np.pi, 0.0])


def test_eased_rests_at_both_ends() -> None:
    assert eased(-1.0) == eased(0.0) == 0.0
    assert eased(2.0) == eased(1.0) == 1.0
    assert eased(0.5) == pytest.approx(0.5)
    assert eased(1e-3) < 1e-8


def test_bracket_is_where_its_link_is_and_has_no_contact() -> None:
    world, zero, top = connect(), (0.0, 0.0, 0.0), (0.0, 0.0, 0.1)
    host = BulletLink(world, world.createMultiBody(1.0, -1, -1, [0.1, 0.2, 0.3]))
    bars = [(zero, top), (top, (0.0, 0.0, 0.05)), (zero, (0.1, 0.0, 0.0))]
    bracket = Bracket(host, bars, 0.01)
    world.resetBasePositionAndOrientation(host.body, [0.4, 0.5, 0.6], [0.0, 0.0, 1.0, 0.0])
    bracket.follow()
    position, quaternion = world.getBasePositionAndOrientation(bracket.body)
    assert_allclose(position, [0.4, 0.5, 0.6])
    assert_allclose(quaternion, [0.0, 0.0, 1.0, 0.0], atol=1e-12)
    assert not world.getCollisionShapeData(bracket.body, -1)
    assert len(world.getVisualShapeData(bracket.body)) == 3


@pytest.mark.study(beyond=4)
@pytest.mark.parametrize("seed", range(10))
def test_planned_path_of_the_ur5_is_clear_of_the_box_from_every_start(seed, opened):
    stage = opened(Exploration(Box(), seed, Explore.dt))
    q, step = stage.q, 0.0
    times = np.linspace(0.0, INSIDE, 51)
    for t in times:
        q, before = stage.arm.solve(stage.flange(t), q), q
        step = max(step, float(np.abs(q - before).max()))
        stage.arm.place(q)
        assert stage.arm_distance() > CLEARANCE
    assert step < 2.0 * np.diff(times)[0]  # no jump from one solution to another: 2 rad/s
    assert_allclose(stage.flange(OUT), stage.flange(INSIDE))
    base = stage.flange(APPROACH)
    assert np.hypot(*(base[1:3] - [0.0, stage.box.height])) < 0.02


def test_starts_differ(opened):
    stages = [opened(Exploration(Box(), seed, Explore.dt)) for seed in range(4)]
    starts = [np.concatenate([stage.q, stage.action, stage.entry]) for stage in stages]
    assert min(np.abs(a - b).max() for a, b in combinations(starts, 2)) > 0.05


@pytest.mark.study
def test_held_joints_stay_while_the_soft_robot_looks_around(opened):
    stage = opened(Exploration(Box(), 3, Explore.dt))
    stage.q = stage.arm.solve(stage.flange(INSIDE), stage.q)
    stage.arm.place(stage.q)
    stage.action = np.zeros(9)
    stage.rod.settle(**stage.actions.inputs(stage.action))
    joints, tips = [], []
    for k in range(round(INSIDE / stage.dt), round(INSIDE / stage.dt) + 210):
        stage.advance(k * stage.dt)
        assert stage.frozen
        joints.append(stage.arm.position())
        tips.append(stage.tip()[0])
    assert np.ptp(joints, axis=0).max() < STILL
    assert np.linalg.norm(np.ptp(tips, axis=0)) > 0.05
    assert stage.seen(0)[0] > 100


@pytest.mark.study
@pytest.mark.parametrize(
    ("box", "sentence"),
    [
        (Box(entry=0.0), r"^scene explore: at .* s the soft robot is .* m from a wall"),
        (Box(marked=(1, 2, 3, 4, 5, 6, 7)), r"^scene explore: the corner back left top shows in 0 pixels"),
    ],
    ids=["a blocked entry", "a corner without a cube"],
)
def test_check_fails(box: Box, sentence: str) -> None:
    with pytest.raises(SceneError, match=sentence):
        Explore(box=box).check()


def test_actions_mirror_each_other_half_a_period_later() -> None:
    for t in (0.0, 0.3, 1.1):
        first, second = opposite(t + 0.5 * PERIOD)[0].reshape(2, 3), opposite(t)[1].reshape(2, 3)
        assert_allclose(second * [1.0, -1.0, 1.0], first, atol=1e-15)


def test_ur5_feels_both_soft_robots_wherever_they_are(opened):
    stage = opened(DualArmScene(0.005))
    for k in range(60):
        stage.advance(k * stage.dt)
        if k % 20 == 19:
            felt, expected = stage.felt(k * stage.dt + stage.dt)
            alone = stage.arm.jacobian(stage.arm.position()).T @ stage.rods[0].wrench
            assert np.abs(expected).max() > 0.05
            assert np.abs(felt - expected).max() < 1e-6 * np.abs(expected).max()
            # the figure tells one robot from two
            assert np.abs(felt - alone).max() > 0.1 * np.abs(expected).max()
            stage.arm.drive(stage.q)
    assert stage.bases().max() < 1e-6
