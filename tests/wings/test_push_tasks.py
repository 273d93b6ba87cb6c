"""Push and QuadrupedPush: mechanics of the bar and the cube, exact episodes, what the baseline reaches, wrong
input."""

import numpy as np
import pytest

pytest.importorskip("pybullet", reason="pybullet is not installed: pip install 'fastrod[hosts]'")

from fastrod.errors import InputError
from fastrod_envs.push_course import PushOptions
from fastrod_envs.pushing import _ON_FLOOR, SPEED, PushCell
from fastrod_envs.registration import make_task
from fastrod_envs.single import SingleEnv
from fastrod_envs.vector import BatchEnv

TASKS = ("Push", "QuadrupedPush")
MIDDLE = np.full(5, 0.5)  # goal, place and turn of the cube in the middle of their ranges


def begun(name, draws=MIDDLE, **options):
    """A task of one environment at the start of an episode, and its cell."""
    task = make_task(name, 1, options)
    task.begin(np.array([0]), np.array([draws]))
    cell = task.cells[0]
    assert isinstance(cell, PushCell)
    return task, cell


def rollout(env, actions, seed):
    """Observations of all environments of a batch."""
    seen = [env.reset(seed=seed)[0]]
    seen.extend(env.step(np.tile(action, (env.num_envs, 1)))[0] for action in actions)
    return np.array(seen)


def some_actions(n, seed=0):
    """Random, but forward for the most part, so that the cube is met."""
    forward = np.array([0.1, 0.5, 0.0])
    return np.clip(forward + np.random.default_rng(seed).uniform(-1.0, 1.0, (n, 3)), -1.0, 1.0)


@pytest.mark.parametrize("name", TASKS)
def test_the_bar_begins_behind_the_cube(name):
    task, cell = begun(name)
    course = cell.course
    behind = course.place[0] - course.size / 2 - course.thickness - course.gap
    np.testing.assert_allclose(cell.tip, [behind, course.place[1], course.height], atol=1e-3)
    assert 0.5 * course.size < course.height < course.size
    task.close()


@pytest.mark.parametrize("name", TASKS)
def test_the_cube_moves_as_far_as_the_bar_that_pushes_it(name):
    task, cell = begun(name, feels=False)
    while not cell.touched:
        task.act(task.baseline())
    tips, cubes = [], []
    for _ in range(8):
        task.act(task.baseline())
        tips.append(cell.tip[0])
        cubes.append(cell.result().position[0])
    assert cubes[-1] - cubes[0] == pytest.approx(tips[-1] - tips[0], abs=2e-3)
    assert cubes[-1] - cubes[0] > 0.5 * SPEED * 7 * task.dt
    task.close()


@pytest.mark.parametrize("name", TASKS)
def test_what_the_bar_feels_is_the_friction_of_the_floor(name):
    task, cell = begun(name, np.array([1.0, 0.5, 0.5, 0.5, 0.5]))  # a long way, straight ahead
    while not cell.touched:
        task.act(task.baseline())
    felt = []
    for _ in range(13):
        task.act(task.baseline())
        felt.append(cell.felt[:3])
    along, across, up = np.mean(felt[9:], axis=0)
    # Coulomb, against the way: the floor bears the cube's weight and what the bar presses down
    assert -along == pytest.approx(_ON_FLOOR * (cell.course.mass * 9.81 + up), rel=0.1)
    assert -along > 0.0
    assert abs(across) < 0.1 * abs(along)
    task.close()


def test_a_robot_that_feels_the_cube_is_bent_by_it():
    moved = {}
    for feels in (True, False):
        task, cell = begun("QuadrupedPush", feels=feels)
        for _ in range(8):
            task.act(np.array([[0.2, 0.4, 0.0]]))
        assert cell.touched
        # where the same displacements bring a robot without load
        free = cell.drive.inputs(cell.q)
        loaded = cell.tip
        moved[feels] = np.linalg.norm(cell.simulator.settle(**free).tip_position[0] - loaded)
        task.close()
    assert moved[False] < 1e-4
    assert 2e-4 < moved[True] < 1e-2


@pytest.mark.parametrize("name", TASKS)
def test_the_bar_does_not_enter_the_floor(name):
    task, cell = begun(name)
    lowest = []
    for _ in range(40):
        task.act(np.array([[1.0, 0.0, 0.0]]))  # longer and longer
        ends = np.array(cell.backdrop().tubes[1].points)
        lowest.append(ends[:, 2].min() - cell.course.thickness)
    assert min(lowest) > 0.0
    assert min(lowest) < 0.5 * cell.course.thickness
    task.close()


@pytest.mark.parametrize("name", TASKS)
def test_goals_fill_their_rectangle_and_gather_in_its_middle_when_it_is_easy(name):
    for draws, corner in ((np.zeros(5), "least"), (np.ones(5), "largest")):
        task, cell = begun(name, draws)
        np.testing.assert_allclose(cell.desired, getattr(cell.course, corner))
        task.set_difficulty(0.0)
        task.begin(np.array([0]), draws[None])
        np.testing.assert_allclose(cell.desired, 0.5 * (np.array(cell.course.least) + cell.course.largest))
        task.close()


@pytest.mark.parametrize(
    "options", [{}, {"action": "displacement"}, {"randomise": {"bending_stiffness": (0.8, 1.2)}}], ids=str
)
def test_an_episode_depends_on_nothing_but_its_seed(options):
    actions = some_actions(12)
    three, one = BatchEnv("QuadrupedPush", 3, **options), BatchEnv("QuadrupedPush", 1, **options)
    together = rollout(three, actions, seed=5)
    rollout(one, some_actions(20, seed=1), seed=99)  # another episode before
    alone = rollout(one, actions, seed=7)
    np.testing.assert_array_equal(together[:, 2], alone[:, 0])
    again = rollout(three, actions, seed=5)
    np.testing.assert_array_equal(together, again)
    assert not np.array_equal(together[:, 0], together[:, 1])
    three.close()
    one.close()


@pytest.mark.parametrize("name", TASKS)
def test_pictures_show_goal_and_cube_and_leave_the_world_as_it_is(name):
    actions = some_actions(10)
    seen = []
    for looked_at in (False, True):
        # the goal beside the cube, toward the camera
        task, _ = begun(name, np.array([1.0, 0.0, 0.5, 0.5, 0.5]))
        for action in actions:
            task.act(action[None])
            if looked_at:
                picture = task.picture(0, 160, 120)
        seen.append(task.state())
        if looked_at:
            assert picture.shape == (120, 160, 3)
            assert picture.dtype == np.uint8
            red, green, blue = picture.astype(int).transpose(2, 0, 1)
            assert ((red > 2 * blue) & (red > 2 * green)).any()
            assert ((blue > 1.5 * red) & (blue > green)).any()
        task.close()
    np.testing.assert_array_equal(seen[0], seen[1])


@pytest.mark.parametrize("name", TASKS)
def test_the_baseline_brings_the_cube_to_its_goal(name):
    env = BatchEnv(name, 1)
    ends, starts = [], []
    for seed in range(6):
        env.reset(seed=seed)
        starts.append(env.task.outcome().distance[0])
        done = False
        while not done:
            _, _, terminated, truncated, infos = env.step(env.baseline())
            done = terminated[0] or truncated[0]
        ends.append(infos["final_info"]["distance"][0])
    assert np.mean(ends) < env.task.accuracy
    assert np.mean(starts) > 5.0 * env.task.accuracy
    env.close()


def test_the_reward_is_its_formula():
    env = SingleEnv("QuadrupedPush")
    env.reset(seed=3)
    touched = []
    for _ in range(12):
        _, reward, _, _, info = env.step(env.baseline())
        d = np.hypot(*(info["position"] - info["desired"])[:2])
        assert info["distance"] == pytest.approx(d)
        assert reward == pytest.approx(np.exp(-300.0 * d**2) + 0.5 * info["touched"])
        touched.append(info["touched"])
    assert touched[0] == 0.0
    assert touched[-1] == 1.0
    env.close()


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("action", ["rate", "displacement"])
def test_random_actions_stay_within_the_bounds(name, action):
    env = BatchEnv(name, 1, action=action)
    low, high = env.single_observation_space.low, env.single_observation_space.high
    rng = np.random.default_rng(2)
    env.reset(seed=0)
    for _ in range(150):
        _, reward, terminated, _, _ = env.step(rng.uniform(-1.0, 1.0, (1, 3)))
        state = env.task.state()[0]
        assert np.isfinite(reward).all()
        assert (state >= low - 1e-6).all()
        assert (state <= high + 1e-6).all()
        assert not terminated[0]
    env.close()


def test_one_step_an_episode_and_goals_alone():
    env = SingleEnv("QuadrupedPush", n_steps=1, action="displacement", observation="goal")
    observation, _ = env.reset(seed=0)
    assert observation.shape == (2,)
    observation, reward, terminated, truncated, info = env.step(np.array([0.3, 0.3, 0.0]))
    assert truncated
    assert not terminated
    assert info["touched"] == 1.0
    assert np.isfinite(reward)
    env.close()


def test_effects_act_in_the_robot():
    ends = []
    for width in (0.0, 5e-4):
        task, cell = begun("Push", np.full(6, 0.5), randomise={"backlash.half_width": (width, width)})
        for _ in range(5):
            task.act(np.array([[0.0, 0.5, 0.2]]))
        ends.append(cell.tip)
        task.close()
    assert np.linalg.norm(ends[1] - ends[0]) > 1e-3


def test_wrong_input_is_refused():
    with pytest.raises(InputError, match="feels"):
        PushOptions(feels=1)
    with pytest.raises(InputError, match="feel"):
        make_task("Push", 1, {"feel": True})
    env = SingleEnv("Push")
    env.reset(seed=0)
    with pytest.raises(InputError, match="finite"):
        env.step([np.nan, 0.0, 0.0])
    env.close()
