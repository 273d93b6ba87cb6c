"""The run that separates effects: what it promises, part by part."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from identification.logs import one_segment, two_segments
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from fastrod import Robot, load_robot
from fastrod.identification.excite import REST, Excitation, excitation
from fastrod.logs.reader import read_log
from fastrod.logs.runlog import write_log
from fastrod.model.routing import route

ROBOTS = pytest.mark.parametrize(
    "robot", [one_segment(), two_segments(), load_robot("tdcr_b")], ids=lambda robot: robot.name
)
RATE, BEND, SPEED = 15.0, 0.8, 1.0


def made(robot: Robot, **changes: float) -> Excitation:
    return excitation(robot, **({"bend": BEND, "rate": RATE, "speed": SPEED, "payload": 0.03} | changes))


def bends(robot: Robot, run: Excitation) -> np.ndarray:
    """(n, n_segments, 2)."""
    return route(robot).bend(np.asarray(run.log.dl))


def rows(run: Excitation, start: float, end: float) -> slice:
    return slice(round(start * RATE), round(end * RATE))


@ROBOTS
def test_parts_cover_the_time_exactly(robot: Robot) -> None:
    run = made(robot)
    assert run.phases[0].start == 0.0
    for one, other in zip(run.phases, run.phases[1:], strict=False):
        assert_allclose(one.end, other.start, rtol=1e-12)
        assert_allclose(one.end * RATE, round(one.end * RATE), rtol=1e-12)  # whole samples
        assert one.end > one.start
    assert_allclose(run.phases[-1].end * RATE, len(run.log), rtol=1e-12)
    assert_allclose(run.log.t, np.arange(len(run.log)) / RATE, rtol=1e-15)
    assert all(phase.purpose and phase.name for phase in run.phases)
    for phase in run.phases:
        assert f"{phase.name}: {phase.purpose}" in run.comment


@ROBOTS
def test_every_wire_stays_within_the_largest_bend(robot: Robot) -> None:
    run = made(robot)
    size = np.linalg.norm(bends(robot, run), axis=-1)
    assert (size <= BEND * (1.0 + 1e-6)).all()  # the file rounds to a nanometre of wire
    assert_allclose(size.max(0), BEND, rtol=1e-6)  # and every segment goes there
    # no wire is asked for more than its segments' bends of that size, each in the worst direction for it
    arms = np.linalg.norm(route(robot).arms.reshape(robot.n_tendons, robot.n_segments, 2), axis=2)
    assert (np.abs(run.log.dl) <= BEND * arms.sum(1) + 1e-9).all()
    assert (np.abs(run.log.dl).max(0) > 0.5 * BEND * arms.max(1)).all()


@ROBOTS
def test_it_rests_where_it_says(robot: Robot) -> None:
    run = made(robot)
    rests = [phase for phase in run.phases if phase.name == "rest"]
    assert len(rests) == 2
    for phase in rests:
        assert_allclose(phase.end - phase.start, REST, atol=1.0 / RATE)
        assert (run.log.dl[rows(run, phase.start, phase.end)] == 0.0).all()
    assert rests[0].start == 0.0


HALF = float(np.sqrt(0.5))
MOUNTS = {
    "up": (1.0, 0.0, 0.0, 0.0),
    "down": (0.0, 1.0, 0.0, 0.0),
    "about x": (HALF, HALF, 0.0, 0.0),
    "about y": (HALF, 0.0, HALF, 0.0),
    "askew": (0.8, 0.36, 0.48, 0.0),
}


@pytest.mark.parametrize("mount", MOUNTS)
def test_base_orientations_are_a_b_b_a_with_the_load_off_and_on(mount: str) -> None:
    """However the robot is mounted, gravity comes from another side in B."""
    robot = one_segment(base_quaternion=MOUNTS[mount])
    run = made(robot)
    base, payload = run.log.base_quaternion, run.log.payload
    assert base is not None
    assert payload is not None
    for number, turned, load in ((1, False, 0.0), (2, True, 0.03), (3, True, 0.0), (4, False, 0.03)):
        phases = [phase for phase in run.phases if phase.name.startswith(f"block {number}")]
        assert f"base {'B' if turned else 'A'}" in phases[0].name
        assert ("load on" in phases[0].name) == (load > 0.0)
        block = rows(run, phases[0].start, phases[-1].end)
        assert_array_equal(payload[block], load)
        assert (base[block] == base[block][0]).all()
        turn = Rotation.from_quat(base[block][0], scalar_first=True)
        own = Rotation.from_quat(robot.base_quaternion, scalar_first=True)
        relative = own.inv() * turn
        assert_allclose(relative.magnitude(), np.pi / 2.0 if turned else 0.0, atol=1e-12)
        # gravity comes from another side of the robot, which a turn about the vertical would not do
        down = np.array(robot.gravity) / np.linalg.norm(robot.gravity)
        moved = np.linalg.norm(turn.inv().apply(down) - own.inv().apply(down))
        assert (moved > 0.5) == turned
    outside = np.ones(len(run.log), bool)
    blocks = [phase for phase in run.phases if phase.name.startswith("block")]
    outside[rows(run, blocks[0].start, blocks[-1].end)] = False
    assert (payload[outside] == 0.0).all()
    assert (base[outside] == base[0]).all()


@ROBOTS
def test_base_and_load_change_only_at_rest(robot: Robot) -> None:
    run = made(robot)
    base, payload = run.log.base_quaternion, run.log.payload
    assert base is not None
    assert payload is not None
    changes = np.flatnonzero((np.diff(payload) != 0.0) | (np.diff(base, axis=0) != 0.0).any(1))
    assert len(changes) >= 4
    assert_allclose(bends(robot, run)[changes], 0.0, atol=1e-6)
    assert_allclose(bends(robot, run)[changes + 1], 0.0, atol=1e-6)


@ROBOTS
@pytest.mark.parametrize("speed", [0.5, 1.0])
def test_nothing_jumps(robot: Robot, speed: float) -> None:
    """The fastest are steps, at three times the speed of the triangles, and the smooth noise: a sum of eight
    sines of up to 1 Hz, at most 0.6 bend / sqrt(8) each, in two directions."""
    run = made(robot, speed=speed)
    rate = np.linalg.norm(np.diff(bends(robot, run), axis=0), axis=-1) * RATE
    assert rate.max() <= max(3.0 * speed, 0.6 * BEND * np.sqrt(8.0) * 2.0 * np.pi * np.sqrt(2.0)) * 1.001
    for phase in run.phases:
        if "triangles" in phase.name:
            inside = rate[rows(run, phase.start, phase.end - 1.0 / RATE)]
            assert inside.max() <= speed * 1.001
            assert inside.max() > 0.8 * speed
        if "step and hold" in phase.name:
            assert rate[rows(run, phase.start, phase.end - 1.0 / RATE)].max() <= 3.0 * speed * 1.001
    assert_allclose(bends(robot, run)[[0, -1]], 0.0, atol=1e-6)


def test_each_block_has_triangles_of_each_segment_a_circle_holds_and_noise() -> None:
    robot = two_segments()
    run = made(robot)
    found = bends(robot, run)
    for number in range(1, 5):
        circle = "slow circle" if number % 2 else "fast circle"
        alone = (f"triangles of segment {k} alone" for k in (1, 2))
        holds = (f"step and hold {k}" for k in (1, 2, 3))
        block = [phase.name for phase in run.phases if phase.name.startswith(f"block {number}")]
        names = [name.partition(": ")[2] for name in block]
        assert names == ["pause", *alone, circle, *holds, "random"]
    for phase in run.phases:
        here = found[rows(run, phase.start, phase.end)]
        if "alone" in phase.name:
            other = 1 if "segment 1" in phase.name else 0
            assert_allclose(here[:, other], 0.0, atol=1e-6)
            own = here[:, 1 - other]
            along = own @ (own[np.argmax(np.linalg.norm(own, axis=1))] / BEND)
            top = along[1:-1][(np.diff(along)[:-1] * np.diff(along)[1:]) < 0.0]
            # decreasing, each to both sides
            assert_allclose(np.abs(top), BEND * np.repeat([1.0, 0.6, 0.28], 2), rtol=1e-5)
        if "hold" in phase.name:
            still = (np.linalg.norm(np.diff(here, axis=0), axis=(1, 2)) == 0.0).sum() / RATE
            assert still >= 3.9  # of four seconds
    repeat = next(phase for phase in run.phases if phase.name == "repeat")
    first = next(phase for phase in run.phases if "block 1" in phase.name and "triangles" in phase.name)
    n = round((repeat.end - repeat.start) * RATE)
    begin = round(first.start * RATE)
    assert_array_equal(run.log.dl[rows(run, repeat.start, repeat.end)], run.log.dl[begin : begin + n])
    assert repeat.start > 100.0  # late, for what is slow to show


def test_a_run_without_load_and_one_by_default() -> None:
    none = made(one_segment(), payload=0.0)
    assert none.log.payload is not None
    assert (none.log.payload == 0.0).all()
    assert not any("load on" in phase.name for phase in none.phases)
    robot = two_segments()
    usual = excitation(robot).log.payload
    assert usual is not None
    # F l^2 / EI = 1 of the softest, to the gram
    assert_allclose(usual.max(), 0.0015 / 0.13**2 / 9.81, atol=0.5e-3)


def test_the_seed_changes_only_what_is_random() -> None:
    one, again, other = (excitation(one_segment(), seed=seed) for seed in (1, 1, 2))
    assert_array_equal(one.log.dl, again.log.dl)
    for phase in one.phases:
        here = rows(one, phase.start, phase.end)
        assert ("random" in phase.name) == (not np.array_equal(one.log.dl[here], other.log.dl[here]))


def test_it_is_written_and_read_as_a_run_log(tmp_path: Path) -> None:
    robot = two_segments()
    run = made(robot)
    write_log(run.log, tmp_path / "run.csv", comment=run.comment)
    back = read_log(tmp_path / "run.csv", robot)
    assert_array_equal(back.dl, run.log.dl)
    assert_array_equal(back.payload, run.log.payload)
    assert back.driven.all()
    assert not back.measured.any()  # the tip is the user's to fill in
