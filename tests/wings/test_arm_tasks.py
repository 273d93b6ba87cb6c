"""Tasks with arms in PyBullet worlds: episodes that depend on their draws alone, baselines that solve them,
geometry against PyBullet's."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fastrod.errors import InputError

pytest.importorskip("pybullet", reason="pybullet is not installed: pip install 'fastrod[hosts]'")
pytest.importorskip("gymnasium", reason="gymnasium is not installed: pip install 'fastrod[envs]'")

from environments import to_the_end

from fastrod_envs.single import SingleEnv
from fastrod_envs.task import size
from fastrod_envs.vector import BatchEnv

NAMES = ("BoxExplore", "PickPlace", "DualArm")


def rollout(env: SingleEnv, seed: int, n_steps: int = 25, *, scripted: bool = True) -> np.ndarray:
    """Observations of an episode's first steps, with the baseline's actions or with random ones."""
    rng = np.random.default_rng(seed)
    seen = [env.reset(seed=seed)[0]]
    for _ in range(n_steps):
        action = env.baseline() if scripted else rng.uniform(-1.0, 1.0, env.action_space.shape)
        observation, _, terminated, truncated, _ = env.step(action)
        seen.append(observation)
        if terminated or truncated:
            break
    return np.array(seen)


@pytest.fixture
def single(opened):
    """Makes one environment on one thread."""
    return lambda name, **options: opened(SingleEnv(name, threads=1, **options))


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "randomise", [None, {"bending_stiffness": (0.9, 1.1), "backlash.half_width": (0.0, 1e-5)}]
)
def test_an_environment_of_a_batch_is_the_single_one_of_its_seed(name, randomise, single, opened):
    batch = opened(BatchEnv(name, num_envs=3, threads=1, randomise=randomise))
    env = single(name, randomise=randomise)
    seen, _ = batch.reset(seed=7)
    alone, _ = env.reset(seed=9)
    assert_array_equal(seen[2], alone)
    for _ in range(15):
        actions = batch.baseline()
        assert_array_equal(actions[2], env.baseline())
        seen, rewards, _, _, _ = batch.step(actions)
        alone, reward, terminated, _, _ = env.step(actions[2])
        assert_array_equal(seen[2], alone)
        assert rewards[2] == reward
        if terminated:
            break


@pytest.mark.study(beyond=2)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_baseline_solves_the_task(name, seed, single):
    env = single(name)
    env.reset(seed=seed)
    info = to_the_end(env)[4]
    assert info["success"]
    assert not info["contact"]
    assert not info["lost"]


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("action", ["rate", "displacement"])
def test_random_actions_leave_numbers_finite_and_within_their_bounds(name, action, single):
    env = single(name, action=action)
    rng = np.random.default_rng(3)
    low, high = env.observation_space.low, env.observation_space.high
    env.reset(seed=0)
    n_lost = 0
    for _ in range(150):
        _, reward, terminated, truncated, info = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
        raw = env.task.state()[0]
        assert np.isfinite(raw).all()
        assert np.isfinite(reward)
        assert ((raw >= low - 1e-6) & (raw <= high + 1e-6)).all(), np.flatnonzero((raw < low) | (raw > high))
        assert sum(info["reward_terms"].values()) == pytest.approx(reward)
        n_lost += info["lost"]
        if terminated or truncated:
            env.reset()
    assert n_lost == 0


@pytest.mark.study(beyond=2)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "options", [{"n_steps": 1}, {"n_steps": 1, "action": "displacement"}, {"observation": "goal"}]
)
def test_options_of_every_task(name, options, single):
    env = single(name, **options)
    parts = env.task.goals if options.get("observation") == "goal" else env.task.states
    observation, _ = env.reset(seed=0)
    assert observation.shape == (size(parts),)
    assert env.observation_space.contains(observation)
    _, _, terminated, truncated, _ = env.step(env.baseline())
    assert (terminated or truncated) == ("n_steps" in options)


@pytest.mark.parametrize("name", NAMES)
def test_a_stiffer_robot_moves_otherwise(name, single):
    plain, soft = single(name), single(name, randomise={"bending_stiffness": (0.8, 0.8)})
    a, b = rollout(plain, seed=0, n_steps=5), rollout(soft, seed=0, n_steps=5)
    assert a.shape == b.shape
    assert (a[-1] != b[-1]).any()


@pytest.mark.parametrize(
    ("name", "options", "sentence"),
    [
        *((name, {"randomise": {"colour": (0.9, 1.1)}}, "no parameter") for name in NAMES),
        ("BoxExplore", {"camera": 3}, "camera"),
        ("PickPlace", {"grip": "magnet"}, "grip"),
    ],
)
def test_options_that_a_task_does_not_have_are_refused(name, options, sentence):
    with pytest.raises(InputError, match=sentence):
        SingleEnv(name, **options)


@pytest.mark.parametrize("name", NAMES)
def test_it_is_drawn_and_taken_apart(name, single):
    env = single(name)
    env.reset(seed=0)
    picture = env.task.picture(0, 64, 48)
    backdrop = env.task.backdrop(0)
    assert picture is not None
    assert picture.shape == (48, 64, 3)
    assert picture.dtype == np.uint8
    assert np.ptp(picture) > 50, "the picture is of one colour"
    assert backdrop.tubes
    assert backdrop.balls
    assert backdrop.solids
    for solid in backdrop.solids:
        assert solid.faces.max() < len(solid.vertices)


def test_clearance_in_the_box_is_pybullets(single):
    env = single("BoxExplore")
    found, expected = [], []
    for seed in range(4):
        rollout(env, seed, n_steps=20, scripted=seed % 2 == 0)
        cell: Any = env.task.cells[0]
        cell._pose()
        found.append(cell._clearance())
        expected.append(
            min(p[8] for own in cell.bodies.ids for p in cell.world.getClosestPoints(own, cell.walls, 0.2))
        )
    # the capsules' axes are chords: with nodes every 1 cm and bends of 1.7 rad in 0.1 m they sag by less than
    # 0.01^2 * 17 / 8 m
    assert_allclose(found, expected, atol=3e-4)


def test_the_camera_finds_the_cube_where_the_line_of_sight_ends(single):
    env = single("BoxExplore", camera=True)
    seen = rollout(env, seed=0, n_steps=40)
    assert np.abs(seen[-1, -3:-1]).max() < 0.15
    assert seen[-1, -1] > 0.0


def test_touching_a_wall_ends_the_episode(single):
    env = single("BoxExplore")
    env.reset(seed=0)
    action = np.tile([1.0, 1.0, 0.0], 3)
    for _ in range(40):
        _, _, terminated, _, info = env.step(action)
        if terminated:
            break
    assert terminated
    assert info["contact"]
    assert info["clearance"] < 0.0
    assert info["reward_terms"]["contact"] == -1.0


@pytest.mark.parametrize("grip", ["suction", "gripper"])
def test_the_cube_is_lifted_carried_and_left_at_rest(grip, single):
    env = single("PickPlace", grip=grip)
    env.reset(seed=1)
    heights, held = [], []
    for _ in range(60):
        _, _, _, _, info = env.step(env.baseline())
        heights.append(info["position"][2])
        held.append(info["held"])
    assert max(heights) > min(heights) + 0.04
    assert max(held) == 1.0
    assert held[-1] == 0.0
    assert info["success"]
    assert info["distance"] == pytest.approx(float(np.linalg.norm(info["position"] - info["desired"])))
    assert info["speed"] < 0.001


@pytest.mark.parametrize("grip", ["suction", "gripper"])
def test_a_cube_that_is_let_go_in_the_air_falls_freely(grip, single):
    env = single("PickPlace", grip=grip)
    env.reset(seed=1)
    cell: Any = env.task.cells[0]
    while cell.place[2] < cell.spot[2] + 0.05:
        env.step(env.baseline())
    before = cell.place[2]
    env.step(np.array([0.0, 0.0, 0.0, 0.0, -1.0]))
    fallen = before - cell.place[2]
    # 0.1 s of free fall are 49 mm; the fingers let go after the first millimetres of their way, at 5 cm/s
    assert fallen > (0.03 if grip == "suction" else 0.005)
    assert not cell.held


def test_the_arm_moves_the_tip_as_told_while_the_soft_robot_bends(single):
    env = single("PickPlace")
    env.reset(seed=0)
    cell: Any = env.task.cells[0]
    before = cell.soft.tip.copy()
    for _ in range(4):
        env.step(np.array([0.4, 0.0, 0.0, 1.0, -1.0]))
    moved = cell.soft.tip - before
    # bent by 0.4 rad more the robot sags more; 0.2 m of 0.03 kg/m weigh 0.06 N: w L^4 / (8 E I) = 12 mm where
    # it is horizontal
    assert_allclose(moved, [0.4 * 0.25 * 0.4, 0.0, 0.0], atol=0.012 * np.sin(0.7))
    assert cell.bend == pytest.approx(0.4, abs=0.31)


def test_the_ball_passes_from_one_robot_to_the_other(single):
    env = single("DualArm")
    env.reset(seed=2)
    holders = []
    for _ in range(40):
        _, _, _, _, info = env.step(env.baseline())
        holders.append((info["first_holds"], info["second_holds"]))
    assert holders[0] == (1.0, 0.0)
    assert holders[-1] == (0.0, 1.0)
    assert (0.0, 0.0) not in holders, "nobody held it for a while"
    assert info["success"]
    assert info["distance"] < 0.01


def test_a_ball_that_is_let_go_falls_and_ends_the_episode(single):
    env = single("DualArm")
    env.reset(seed=0)
    start = env.task.outcome().position[0, 2]
    action = np.array([0.0] * 6 + [-1.0, -1.0])
    env.step(action)
    info = env.step(action)[4]
    # the world's steps of h = 10 ms fall g t (t + h) / 2 in t = 0.2 s, if nothing is damped
    assert start - info["position"][2] == pytest.approx(0.5 * 9.81 * 0.2 * 0.21, rel=1e-3)
    assert info["reward_terms"]["failure"] == -1.0


def test_a_head_that_is_pulled_too_far_lets_go(single):
    env = single("DualArm")
    env.reset(seed=2)
    cell: Any = env.task.cells[0]
    while not cell.held[1]:
        action = env.baseline()
        env.step(action)
    both = np.array([-1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0])  # apart, both commanded to hold
    for _ in range(10):
        env.step(both)
    assert sum(cell.held) == 1
    assert cell.softs[1].tip[0] - cell.softs[0].tip[0] > 0.1


def test_tips_move_as_told(single):
    env = single("DualArm")
    env.reset(seed=0)
    cell: Any = env.task.cells[0]
    before = np.stack([soft.tip for soft in cell.softs])
    velocity = np.array([[0.2, 0.3, 0.0], [0.2, 0.0, -0.3]])
    for _ in range(3):
        env.step(np.array([*velocity.ravel(), 1.0, -1.0]))
    moved = np.stack([soft.tip for soft in cell.softs]) - before
    # 12 mm of way; damping and the curvature of the tips' paths take some of it
    assert_allclose(moved, 0.3 * 0.1 * velocity, atol=0.0015)


@pytest.mark.parametrize(
    ("name", "middle"),
    [("BoxExplore", None), ("PickPlace", (0.5, 0.04, 0.165)), ("DualArm", (0.06, 0.0, 0.3))],
)
def test_difficulty_goes_from_the_easiest_goals_to_all(name, middle, single):
    task = single(name).task
    draws = np.random.default_rng(0).random((12, task.n_draws))
    goals = []
    for level in (0.0, 1.0):
        task.set_difficulty(level)
        for row in draws:
            task.begin(np.array([0]), row[None])
            goals.append(task.goal()[0])
    easy, every = np.array(goals[:12]), np.array(goals[12:])
    if middle is not None:
        assert_allclose(easy, np.tile(middle, (12, 1)), atol=1e-12)
    else:
        assert np.ptp(easy[:, 0]) == 0.0, "a corner in the front is not easy"
    assert (np.ptp(every, axis=0)[:2] > 0.03).all()
    assert np.ptp(every, axis=0).sum() > np.ptp(easy, axis=0).sum()


@pytest.mark.parametrize("name", NAMES)
def test_every_draw_has_a_beginning(name, single):
    task = single(name).task
    corners = np.random.default_rng(1).integers(0, 2, (25, task.n_draws)).astype(float)
    for row in corners:
        task.begin(np.array([0]), np.minimum(row, 1.0 - 1e-9)[None])
        outcome = task.outcome()
        assert not outcome.contact[0]
        assert not outcome.lost[0]
        assert not outcome.terminated[0]
        assert not outcome.success[0]
