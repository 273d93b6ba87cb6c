"""Measured orientations inform the base model, and what they cannot explain does not lead it astray."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fastrod import Robot, Simulator, load_robot
from fastrod.identification.attribution import identify
from fastrod.identification.excite import excitation
from fastrod.logs.runlog import RunLog
from fastrod.rotation import quaternion_from_matrix

NOISE, TURN, LATE = 1e-4, 3e-3, 2  # m, rad, samples


@pytest.fixture(scope="module")
def nominal() -> Robot:
    return load_robot("prototype")


def seen(robot: Robot, run: RunLog) -> tuple[np.ndarray, Rotation]:
    """Tips and orientations of a robot that is driven as in this run, from its base."""
    simulator = Simulator(robot, n_robots=len(run), points_per_segment=12)
    pose = np.column_stack([np.zeros((len(run), 3)), run.base_quaternion])
    weight = run.payload[:, None] * np.array(robot.gravity)
    state = simulator.settle(robot.rest_tendon_length + run.dl, tip_force=weight, base_pose=pose)
    assert state.ok.all()
    base = Rotation.from_quat(run.base_quaternion, scalar_first=True)
    return base.inv().apply(state.tip_position), base.inv() * Rotation.from_matrix(state.tip_rotation)


@pytest.fixture(scope="module")
def late(nominal: Robot) -> RunLog:
    """Return what a camera measures that is two samples late, of a robot a tenth stiffer than its file
    says."""
    run = excitation(nominal).log
    (segment,) = nominal.segments
    stiffer = tuple(1.1 * k for k in segment.bending_stiffness)
    tip, turn = seen(replace(nominal, segments=(replace(segment, bending_stiffness=stiffer),)), run)
    rng, then = np.random.default_rng(3), np.maximum(np.arange(len(run)) - LATE, 0)
    tip = tip[then] + NOISE * rng.normal(size=tip.shape)
    turn = Rotation.from_rotvec(TURN * rng.normal(size=tip.shape)) * turn[then]
    return replace(run, tip_position=tip, tip_quaternion=quaternion_from_matrix(turn.as_matrix()))


@pytest.mark.study
def test_the_base_fit_is_no_worse_than_the_model_as_it_was(late: RunLog, nominal: Robot) -> None:
    # no stiffness explains a delay: fitted, it must stay near the truth, and the error must not grow
    found = identify(late, nominal, max_effects=0)
    tip, _ = seen(nominal, late)
    off = np.linalg.norm(late.tip_position - tip, axis=1)[found.used]
    assert found.train.before <= np.sqrt(np.mean(off**2))
    assert found.base_parameters["segment.*.bending_stiffness"].value == pytest.approx(1.1, rel=0.1)


@pytest.mark.study
def test_with_the_delay_found_the_stiffness_is_right(late: RunLog, nominal: Robot) -> None:
    found = identify(late, nominal)
    assert [effect.name for effect in found.effects] == ["latency"]
    stiffness = found.base_parameters["segment.*.bending_stiffness"]
    assert stiffness.value == pytest.approx(1.1, rel=0.01)
    assert found.test.after < 1.15 * found.noise.floor
    assert found.test.before > 5.0 * found.test.after
