"""A trained policy at the commands of a robot does what it does in its environment."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

pytest.importorskip("gymnasium", reason="gymnasium is not installed: pip install 'fastrod[envs]'")

import fastrod
from fastrod.control import Trajectory, circle, helix
from fastrod.errors import InputError, UnknownNameError
from fastrod.logs.simulated import SimulatedRobot
from fastrod.model.robot import Robot
from fastrod.simulator import Simulator
from fastrod.solver.options import Observer
from fastrod.types import Floats
from fastrod_envs.learning.policies import Policy, find
from fastrod_envs.learning.policy_driver import PolicyDriver
from fastrod_envs.randomisation import Randomisation
from fastrod_envs.single import SingleEnv
from fastrod_envs.tasks.track import APPROACH, DT, Track

PROTOTYPE = fastrod.load_robot("prototype")
WORN = replace(
    PROTOTYPE,
    effects=(
        {"name": "backlash", "half_width": 2e-4},
        {"name": "creep", "share": 0.08, "time_constant": 2.0},
        {"name": "camera_scale", "scale": 0.02},
    ),
)
SHAPES = ("triangle", "square", "circle")


@cache
def policy() -> Policy:
    return Policy(find("Track", "shipped"))


def episode(path: str, seed: int, robot: Robot, n_steps: int = 120) -> dict[str, Any]:
    """An episode of the environment: where it began, what was commanded, what came of it."""
    options: dict[str, Any] = {} if robot is PROTOTYPE else {"randomise": Randomisation(robot=robot)}
    env = SingleEnv("Track", path=path, n_steps=n_steps, **options)
    observation, _ = env.reset(seed=seed)
    task = env.task
    assert isinstance(task, Track)
    found: dict[str, Any] = {"phase": task._phase[0], "sense": int(task._sense[0]), "dl": [], "tip": []}
    for _ in range(n_steps):
        observation, _, _, _, info = env.step(policy().act(observation[None])[0])
        found["dl"].append(task._inputs()["tendon_length"][0] - robot.rest_tendon_length)
        found["tip"].append(task.measured()[0])
    found["distance"] = info["distance"]
    return found


def follow(pilot: PolicyDriver, robot: Robot, n_steps: int = 120) -> dict[str, Any]:
    """The same with a simulator like the environment's."""
    simulator = Simulator(
        robot,
        dt=DT,
        points_per_segment=Track.points_per_segment,
        outputs="tip",
        solver=Observer(kept_jacobian_tolerance=Track.kept_jacobian_tolerance),
    )
    simulator.settle(robot.rest_tendon_length)
    found: dict[str, Any] = {"dl": [], "tip": []}
    t, off = 0.0, []
    for _ in range(n_steps):
        dl = pilot.command(simulator.measure().tip_position[0], t)
        simulator.step(robot.rest_tendon_length + dl)
        t += DT
        found["dl"].append(dl)
        found["tip"].append(simulator.measure().tip_position[0])
        if t > APPROACH:
            off.append(np.linalg.norm(found["tip"][-1] - pilot.nearest(t)))
    found["distance"] = np.mean(off)
    return found


@pytest.mark.study
@pytest.mark.parametrize("robot", [PROTOTYPE, WORN], ids=["bare", "worn"])
@pytest.mark.parametrize(("path", "seed"), [("triangle", 1), ("square", 2), ("circle", 4)])
def test_it_does_what_the_environment_does(path: Any, seed: int, robot: Robot) -> None:
    there = episode(path, seed, robot)
    here = follow(PolicyDriver(policy(), path, robot, phase=there["phase"], sense=there["sense"]), robot)
    assert np.ptp(there["dl"], axis=0).min() > 1e-3
    # lengths minus rest lengths round at 1e-17
    assert_allclose(here["dl"], there["dl"], rtol=0.0, atol=1e-9)
    assert_allclose(here["tip"], there["tip"], rtol=0.0, atol=1e-9)
    assert here["distance"] == pytest.approx(there["distance"], abs=1e-9)
    assert here["distance"] < 1e-3


@pytest.mark.study
def test_both_ways_round_were_seen() -> None:
    senses = {
        episode(path, seed, PROTOTYPE, n_steps=1)["sense"]
        for path, seed in (("triangle", 1), ("square", 2), ("circle", 4))
    }
    assert senses == {-1, 1}


@pytest.mark.study
def test_a_simulated_robot_is_led_along_the_path() -> None:
    now = [0.0]
    link = SimulatedRobot(PROTOTYPE, dt=DT, clock=lambda: now[0])
    pilot = PolicyDriver(policy(), "circle")
    off = []
    for k in range(200):
        now[0] = DT * k
        tip = link.read().tip_position
        if now[0] > APPROACH:
            off.append(np.linalg.norm(tip - pilot.nearest(now[0])))
        link.command(pilot.command(tip, now[0]))
    assert np.mean(off) == pytest.approx(
        follow(PolicyDriver(policy(), "circle"), PROTOTYPE, 199)["distance"], abs=2e-5
    )
    assert np.mean(off) < 5e-4


@pytest.mark.study
def test_a_path_of_ones_own_is_the_tasks_where_it_is_the_same() -> None:
    own = circle(radius=0.02, period=9.0, center=(0.0, 0.0, PROTOTYPE.length))
    one, other = (follow(PolicyDriver(policy(), path), PROTOTYPE, 20) for path in ("circle", own))
    assert_array_equal(one["dl"], other["dl"])
    wide = circle(radius=0.035, period=20.0, center=(0.0, 0.0, PROTOTYPE.length - 0.005))
    far = PolicyDriver(policy(), wide)
    assert_array_equal(far.wanted(5.0), wide.position(5.0))
    assert np.linalg.norm(far.nearest(0.0)[:2]) > 0.03
    assert np.linalg.norm(far.nearest(0.0) - far.wanted(0.0)) < 0.012


@pytest.mark.study
def test_between_steps_the_command_stays() -> None:
    coarse, fine = PolicyDriver(policy(), "square"), PolicyDriver(policy(), "square")
    tips = PROTOTYPE.length * np.array([0.0, 0.0, 1.0]) + np.random.default_rng(2).normal(
        scale=1e-3, size=(40, 3)
    )
    for k, tip in enumerate(tips):
        wanted = coarse.command(tip, DT * k)
        assert_array_equal(fine.command(tip, DT * k), wanted)
        for later in (0.2, 0.5, 0.99):
            assert_array_equal(fine.command(tips[0], DT * (k + later)), wanted)
    assert np.abs(wanted).max() > 1e-4


@pytest.mark.study
def test_a_dropout_is_the_last_known_tip_for_one_step_and_then_a_halt() -> None:
    known = np.array([0.002, -0.001, 0.069])
    lost = np.full(3, np.nan)

    def reported(*tips: Floats) -> list[Floats]:
        pilot = PolicyDriver(policy(), "circle")
        return [pilot.command(tip, DT * k) for k, tip in enumerate(tips)]

    held = reported(known, known, known)
    seen = reported(known, known, lost, lost, lost, known)
    assert_array_equal(seen[:3], held)
    assert np.abs(seen[2] - seen[1]).max() > 0.0
    assert_array_equal(seen[3], seen[2])
    assert_array_equal(seen[4], seen[2])
    assert np.abs(seen[5] - seen[4]).max() > 0.0
    assert_array_equal(reported(known, np.array([0.002, np.nan, 0.069]))[1], held[1])
    late = reported(lost, lost, known, known)
    assert_array_equal(late[:2], np.zeros((2, 4)))
    assert np.abs(late[2]).max() > 0.0


def test_commands_stay_within_the_tasks_limits() -> None:
    pilot = PolicyDriver(policy(), "circle")
    stuck = np.array([0.0, 0.0, PROTOTYPE.length])
    dl = np.array([pilot.command(stuck, DT * k) for k in range(400)])
    # the angles of the tendons have twelve digits
    assert np.abs(dl).max() == pytest.approx(0.008, abs=1e-13)
    assert np.abs(np.diff(dl, axis=0)).max() <= 0.01 * DT + 1e-13
    assert_allclose(np.abs(pilot.displacement), np.abs(dl[-1, :2]), atol=1e-13)


def pilot_of(
    path: Any = "circle", robot: Robot | None = None, name: str = "Track", **options: Any
) -> PolicyDriver:
    return PolicyDriver(Policy(find(name, "shipped")), path, robot, **options)


@pytest.mark.parametrize(
    ("make", "error", "sentence"),
    [
        (lambda: pilot_of("cirle"), UnknownNameError, r"no path 'cirle'; did you mean 'circle'\?"),
        (lambda: pilot_of(name="Reach"), InputError, "was trained on fastrod/Reach-v0 .* give one of Track"),
        (
            lambda: pilot_of(sense=0),
            InputError,
            "phase is 0.0 s and sense 0; give a finite time, and 1 or -1",
        ),
        (lambda: pilot_of(phase=np.nan), InputError, "phase is nan s"),
        (lambda: pilot_of(helix(radius=0.02, pitch=0.01)), InputError, r"path 'helix' rises by 0.01 m"),
        (
            lambda: pilot_of(robot=fastrod.load_robot("five_segment_reacher")),
            InputError,
            "has 5 segments; a policy of Track drives one",
        ),
        (
            lambda: pilot_of(3.0),
            InputError,
            "path is 3.0; give a Trajectory or one of 'triangle', 'square', 'circle'",
        ),
    ],
)
def test_what_cannot_be_piloted_is_said(make: Any, error: type[Exception], sentence: str) -> None:
    with pytest.raises(error, match=sentence):
        make()


@pytest.mark.study
@pytest.mark.parametrize(
    ("tip", "t", "sentence"),
    [
        ([0.0, 0.07], 0.1, r"tip is \[0.0, 0.07\]; give three numbers"),
        ("tip", 0.1, "tip is 'tip'; give three numbers"),
        ([0.0, 0.0, np.inf], 0.1, "nan where it was not measured"),
        ([0.0, 0.0, 0.07], np.nan, "t is nan s; give a finite time"),
        ([0.0, 0.0, 0.07], 0.0, r"t is 0 s, before the step at 0.1 s; a pilot's time does not run back"),
    ],
)
def test_a_bad_reading_is_refused_and_changes_nothing(tip: Any, t: float, sentence: str) -> None:
    pilot = pilot_of()
    before = [pilot.command([0.0, 0.0, 0.07], DT * k) for k in range(3)]
    with pytest.raises(InputError, match=sentence):
        pilot.command(tip, t)
    twin = pilot_of()
    assert_array_equal([twin.command([0.0, 0.0, 0.07], DT * k) for k in range(3)], before)
    assert_array_equal(pilot.command([0.0, 0.0, 0.07], 3 * DT), twin.command([0.0, 0.0, 0.07], 3 * DT))


def test_a_policy_with_other_options_is_refused(tmp_path: Path) -> None:
    given = policy()
    goal = Policy(find("Track", "shipped"))
    goal.plan = replace(given.plan, options={**given.plan.options, "observation": "goal"})
    with pytest.raises(
        InputError,
        match=r"with \{'observation': 'goal'\}; give one of Track that observes "
        r"the state",
    ):
        PolicyDriver(goal, "circle")


def test_a_point_may_be_a_path() -> None:
    def still(t: Floats) -> tuple[Floats, Floats]:
        return np.zeros((*t.shape, 3)), np.zeros((*t.shape, 3))

    pilot = PolicyDriver(
        policy(), Trajectory(name="still", period=1.0, center=(0.0, 0.01, 0.069), path=still)
    )
    found = follow(pilot, PROTOTYPE, 80)
    assert_array_equal(pilot.wanted(3.0), [0.0, 0.01, 0.069])
    assert np.linalg.norm(found["tip"][-1] - pilot.nearest(3.0)) < 5e-4
