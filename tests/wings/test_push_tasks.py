"""Push and QuadrupedPush: mechanics of bar and cube, what the baseline reaches, wrong input."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

pytest.importorskip("pybullet", reason="pybullet is not installed: pip install 'fastrod[hosts]'")

from environments import to_the_end

from fastrod.errors import InputError
from fastrod_envs.pushing import _ON_FLOOR, SPEED, PushCell
from fastrod_envs.registration import make_task
from fastrod_envs.single import SingleEnv
from fastrod_envs.tip import UNLOADED
from fastrod_envs.vector import BatchEnv

TASKS = ("Push", "QuadrupedPush")
MIDDLE = np.full(5, 0.5)  # goal, place and turn of the cube in the middle of their ranges


@pytest.fixture
def begun(opened):
    """Makes a task of one environment at the start of an episode, and its cell."""

    def make(name, draws=MIDDLE, **options):
        task = opened(make_task(name, 1, options))
        task.begin(np.array([0]), np.array([draws]))
        cell = task.cells[0]
        assert isinstance(cell, PushCell)
        return task, cell

    return make


def some_actions(n, seed=0):
    """Random, but forward for the most part, so that the cube is met."""
    forward = np.array([0.1, 0.5, 0.0])
    return np.clip(forward + np.random.default_rng(seed).uniform(-1.0, 1.0, (n, 3)), -1.0, 1.0)


@pytest.mark.parametrize("name", TASKS)
def test_the_bar_begins_behind_the_cube(name, begun):
    _, cell = begun(name)
    course = cell.course
    behind = course.place[0] - course.size / 2 - course.thickness - course.gap
    assert_allclose(cell.tip, [behind, course.place[1], course.height], atol=1e-3)
    assert 0.5 * course.size < course.height < course.size


@pytest.mark.parametrize("name", TASKS)
def test_the_cube_moves_as_far_as_the_bar_that_pushes_it(name, begun):
    task, cell = begun(name)
    while not cell.touched:
        task.act(task.baseline())
    tips, cubes = [], []
    for _ in range(8):
        task.act(task.baseline())
        tips.append(cell.tip[0])
        cubes.append(cell.result().position[0])
    assert cubes[-1] - cubes[0] == pytest.approx(tips[-1] - tips[0], abs=2e-3)
    assert cubes[-1] - cubes[0] > 0.5 * SPEED * 7 * task.dt


@pytest.mark.parametrize("name", TASKS)
def test_what_the_bar_feels_is_the_friction_of_the_floor(name, begun):
    task, cell = begun(name, np.array([1.0, 0.5, 0.5, 0.5, 0.5]))  # a long way, straight ahead
    while not cell.touched:
        task.act(task.baseline())
    felt = []
    for _ in range(13):
        task.act(task.baseline())
        felt.append(cell.tip_body.wrench[:3])
    along, across, up = np.mean(felt[9:], axis=0)
    # Coulomb, against the way: the floor bears the cube's weight and what the bar presses down
    assert -along == pytest.approx(_ON_FLOOR * (cell.course.mass * 9.81 + up), rel=0.1)
    assert -along > 0.0
    assert abs(across) < 0.1 * abs(along)


@pytest.mark.parametrize("name", TASKS)
def test_a_robot_that_meets_the_cube_is_bent_by_it_at_once(name, begun):
    task, cell = begun(name)
    while not cell.touched:
        before = np.abs(cell.tip_body.wrench).max()
        task.act(task.baseline())
    task.act(task.baseline())
    assert before < 0.05
    assert cell.tip_body.wrench[0] < -0.05
    # where the same displacements bring a robot without load
    loaded, free = cell.tip, cell.drive.inputs(cell.q) | UNLOADED
    assert 5e-4 < np.linalg.norm(cell.simulator.settle(**free).tip_position[0] - loaded) < 1e-2


@pytest.mark.parametrize("name", TASKS)
def test_the_bar_does_not_enter_the_floor(name, begun):
    task, cell = begun(name)
    lowest = []
    for _ in range(40):
        task.act(np.array([[1.0, 0.0, 0.0]]))  # longer and longer
        ends = np.array(cell.backdrop().tubes[1].points)
        lowest.append(ends[:, 2].min() - cell.course.thickness)
    assert min(lowest) > 0.0
    assert min(lowest) < 0.5 * cell.course.thickness


@pytest.mark.parametrize("name", TASKS)
def test_goals_fill_their_rectangle_and_gather_in_its_middle_when_it_is_easy(name, begun):
    for draws, corner in ((np.zeros(5), "least"), (np.ones(5), "largest")):
        task, cell = begun(name, draws)
        assert_allclose(cell.desired, getattr(cell.course, corner))
        task.set_difficulty(0.0)
        task.begin(np.array([0]), draws[None])
        assert_allclose(cell.desired, 0.5 * (np.array(cell.course.least) + cell.course.largest))


@pytest.mark.study
@pytest.mark.parametrize("name", TASKS)
def test_pictures_show_goal_and_cube_and_leave_the_world_as_it_is(name, begun):
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
    assert_array_equal(seen[0], seen[1])


@pytest.mark.study
@pytest.mark.parametrize("name", TASKS)
def test_the_baseline_brings_the_cube_to_its_goal(name, opened):
    env = opened(BatchEnv(name, 1))
    ends, starts = [], []
    for seed in range(6):
        env.reset(seed=seed)
        starts.append(env.task.outcome().distance[0])
        ends.append(to_the_end(env)[4]["final_info"]["distance"][0])
    assert np.mean(ends) < env.task.accuracy
    assert np.mean(starts) > 5.0 * env.task.accuracy


def test_the_reward_is_its_formula(opened):
    env = opened(SingleEnv("QuadrupedPush"))
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


def test_one_step_an_episode_and_goals_alone(opened):
    env = opened(SingleEnv("QuadrupedPush", n_steps=1, action="displacement", observation="goal"))
    observation, _ = env.reset(seed=0)
    assert observation.shape == (2,)
    observation, reward, terminated, truncated, info = env.step(np.array([0.3, 0.3, 0.0]))
    assert truncated
    assert not terminated
    assert info["touched"] == 1.0
    assert np.isfinite(reward)


@pytest.mark.study
def test_effects_act_in_the_robot(begun):
    ends = []
    for width in (0.0, 5e-4):
        task, cell = begun("Push", np.full(6, 0.5), randomise={"backlash.half_width": (width, width)})
        for _ in range(5):
            task.act(np.array([[0.0, 0.5, 0.2]]))
        ends.append(cell.tip)
    assert np.linalg.norm(ends[1] - ends[0]) > 1e-3


def test_wrong_input_is_refused(opened):
    with pytest.raises(InputError, match="feels"):
        make_task("Push", 1, {"feels": True})
    env = opened(SingleEnv("Push"))
    env.reset(seed=0)
    with pytest.raises(InputError, match="finite"):
        env.step([np.nan, 0.0, 0.0])
