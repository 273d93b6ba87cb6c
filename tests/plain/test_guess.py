"""Start of a cold solve: closed forms, and the kernel against its obvious twin. Small enough to run
without the compiler."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from plain.naive_guess import arms, guess
from rods import bend, rod

from fastrod import Robot, Segment, Simulator, Tendon, load_robot, robot_names
from fastrod.model.compile import compile_robots
from fastrod.solver.boundary import BoundarySolver
from fastrod.solver.inputs import Inputs, Reader
from fastrod.solver.settle import cold_start
from fastrod.types import Layout, Memory, Params, Ports

N_STEPS = 6  # not a divisor of the guess's eight samples
# The twin does the same sums in another order: some fifty loads, forty rotations and a pseudo-inverse whose
# condition is below 1e4
# here, each to 1e-16: 1e-13 is what is seen. A wrong term shows in the first digits.
CLOSE = 1e-10

Case = tuple[Layout, Params, Ports]


def case(robots: list[Robot], n: int, seed: int, *, skip: tuple[str, ...] = (), **given: Any) -> Case:
    """These robots, their ports filled with random inputs of every kind but those in `skip`."""
    rng = np.random.default_rng(seed)
    robot = robots[0]
    layout, params, rest = compile_robots(robots, N_STEPS)
    n_segments, n_tendons = robot.n_segments, robot.n_tendons
    force = robot.segments[0].bending_stiffness[0] / robot.length**2
    low, high = rest.extension_range[:1, :, 0], rest.extension_range[:1, :, 1]
    extension = rng.uniform(low, high, (n, n_segments))
    quaternion = rng.normal(size=(n, 4))
    inputs: dict[str, Any] = {
        "extension": extension,
        "tip_force": force * rng.normal(size=(n, 3)),
        "tip_moment": force * robot.length * rng.normal(size=(n, 3)),
        "line_force": force / robot.length * rng.normal(size=(n, n_segments, 5, 3)),
        "point_force": [(robot.length * part, force * rng.normal(size=3)) for part in (0.31, 0.77)],
        "base_pose": np.hstack(
            [rng.normal(size=(n, 3)), quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)]
        ),
    }
    if not layout.paper:
        inputs["follower_tip_force"] = force * rng.normal(size=(n, 3))
    if len(layout.row_tendon):
        ends = np.cumsum(params.length + extension, axis=1)[:, layout.tendon_segment]
        turn = rng.normal(size=(n, n_segments, 2)) / n_segments
        across = np.stack([params.offset[..., 1], -params.offset[..., 0]], axis=-1)
        inputs["tendon_length"] = (
            ends + (across * turn[:, :, None]).sum((1, 3)) + 1e-4 * rng.normal(size=(n, n_tendons))
        )
    if any(segment.mode == "tendon_tension" for segment in robot.segments):
        inputs["tension"] = rng.uniform(0.0, 1.0, (n, n_tendons))
    inputs = {name: value for name, value in (inputs | given).items() if name not in skip}
    return layout, params, Reader(layout, params, rest, n).ports(Inputs(**inputs))


def fill(case: Case, n: int, rows: list[int] | None = None) -> Memory:
    """The memory of n robots after a cold start of `rows`, all of them by default; it was full of something
    else before."""
    layout, params, ports = case
    passes = BoundarySolver(layout, params, n, threads=1, propagate=True)
    passes.remember(len(ports.follower_force) > 0, True, None)
    for a in passes.memory:
        a[:] = 7.0
    cold_start(np.arange(n) if rows is None else np.array(rows), layout, params, ports, passes.memory)
    return passes.memory


def off_the_twin(case: Case, n: int) -> float:
    """Largest difference of a number in its natural size, or in its own where that is larger."""
    layout, params, _ = case
    memory, largest = fill(case, n), 0.0
    n_base = 2 * len(layout.first_tendon) if layout.paper else 3
    n_free = len(layout.free_tendon)
    for i in range(n):
        x, u = guess(i, *case)
        s = min(i, len(params.rod_length) - 1)
        moment, tension = params.moment_scale[s], params.tension_scale[s]
        units = np.repeat(
            [moment, tension, moment / params.rod_length[s]], [n_base, n_free, len(x) - n_base - n_free]
        )
        assert memory.x.shape[1] == len(x)
        for got, wanted in (
            (memory.x[i] / units, x / units),
            (memory.curvature_guess[i] * params.rod_length[s], u * params.rod_length[s]),
        ):
            largest = max(largest, float((np.abs(got - wanted) / (1.0 + np.abs(wanted))).max(initial=0.0)))
    return largest


def in_mode(robot: Robot, mode: str) -> Robot:
    """The robot with all segments in this mode; one that ships without tendons gets three where it needs
    some."""

    def routed(of: Segment) -> tuple[Tendon, ...]:
        return () if mode == "passive" else of.tendons or rod(n_tendons=3).tendons

    return replace(
        robot,
        segments=tuple(replace(segment, mode=mode, tendons=routed(segment)) for segment in robot.segments),
    )


def varied(robot: Robot, rng: np.random.Generator) -> Robot:
    """Another robot of the same counts."""

    def segment(of: Segment) -> Segment:
        return replace(
            of,
            length=of.length * rng.uniform(0.9, 1.1),
            bending_stiffness=tuple(k * rng.uniform(0.8, 1.2) for k in of.bending_stiffness),
            precurvature=tuple(rng.normal(size=3) / of.length / 5.0),
            line_density=0.05,
            extension=(-0.1 * of.length, 0.2 * of.length),
            tendons=tuple(
                replace(t, pretension=rng.uniform(0.0, 0.5), unilateral=bool(rng.integers(2)))
                for t in of.tendons
            ),
        )

    return replace(robot, segments=tuple(segment(s) for s in robot.segments))


@pytest.mark.parametrize("name", robot_names())
@pytest.mark.parametrize("mode", ["tendon_length", "tendon_tension", "passive", "paper"])
def test_shipped_robots_in_every_mode(name: str, mode: str) -> None:
    rng = np.random.default_rng(3)
    robots = [varied(in_mode(load_robot(name), mode), rng) for _ in range(3)]
    assert off_the_twin(case(robots, 3, seed=4), 3) < CLOSE


def chain(n_segments: int, rng: np.random.Generator) -> Robot:
    """Modes and numbers of tendons by chance, each tendon in another place in every segment."""
    segments = []
    for k in range(n_segments):
        mode = str(rng.choice(["tendon_length", "tendon_length", "tendon_tension", "passive"]))
        pulling = tuple(
            Tendon(offset=tuple(rng.uniform(0.004, 0.009, k + 1)), angle=tuple(rng.uniform(-3.1, 3.1, k + 1)))
            for _ in range(0 if mode == "passive" else int(rng.integers(1, 6)))
        )
        stiffness = tuple(rng.uniform(0.001, 0.003, 2))
        segments.append(
            Segment(
                length=0.05,
                bending_stiffness=stiffness,
                torsional_stiffness=0.001,
                mode=mode,
                tendons=pulling,
            )
        )
    return varied(Robot(name="chain", segments=tuple(segments)), rng)


@pytest.mark.parametrize("seed", range(20))
def test_chains_by_chance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    robot = chain(1 + seed % 5, rng)
    layout, params, ports = case([robot], 2, seed)
    # an effect may give every robot its own offsets, and stiffness and precurvature at every half step
    offset = params.offset * rng.uniform(0.9, 1.1, (2, *params.offset.shape[1:]))
    many = np.linspace(1.0, 1.5, 2 * N_STEPS + 1)[:, None]
    ports = ports._replace(stiffness=ports.stiffness * many, precurvature=ports.precurvature * many)
    assert off_the_twin((layout, params._replace(offset=offset), ports), 2) < CLOSE


@pytest.mark.parametrize(
    "kind",
    ["tip_force", "tip_moment", "line_force", "point_force", "follower_tip_force", "base_pose", "extension"],
)
def test_each_kind_of_load_alone(kind: str) -> None:
    kinds = (
        "tip_force",
        "tip_moment",
        "line_force",
        "point_force",
        "follower_tip_force",
        "base_pose",
        "extension",
    )
    robot = varied(load_robot("tdcr_b"), np.random.default_rng(1))
    assert off_the_twin(case([robot], 2, seed=2, skip=tuple(k for k in kinds if k != kind)), 2) < CLOSE


def in_plane(angle: float, n: int) -> np.ndarray:
    return np.outer((-1.0) ** np.arange(n), [np.cos(angle), np.sin(angle)])


# without a tendon out of the plane, and without any arm at all, the smaller singular value, or both, count as
# none
FLAT: dict[str, Callable[[], np.ndarray]] = {
    "one tendon": lambda: in_plane(0.3, 1),
    "opposite tendons": lambda: in_plane(0.7, 2),
    "four in a plane": lambda: in_plane(-2.1, 4) * np.array([[1.0], [0.7], [0.4], [1.3]]),
    "twenty in a plane": lambda: in_plane(1.1, 20),
    "no arm": lambda: np.zeros((3, 2)),
    "three around": lambda: np.array([[np.cos(a), np.sin(a)] for a in 2.0 * np.pi / 3.0 * np.arange(3)]),
    "one with an arm": lambda: np.array([[0.0, 0.0], [0.6, 0.8]]),
}


@pytest.mark.parametrize("name", FLAT)
def test_tendons_that_leave_a_direction_free(name: str) -> None:
    offsets = 0.0075 * FLAT[name]()
    layout, params, ports = case([varied(rod(n_tendons=len(offsets)), np.random.default_rng(5))], 2, seed=6)
    assert off_the_twin((layout, params._replace(offset=np.array(offsets[None, None])), ports), 2) < CLOSE


@pytest.mark.parametrize("off", [0.0, 1e-12, 1e-9, 1e-6, 1e-3])
def test_tendons_nearly_in_a_plane_say_nothing_about_the_bend_across_it(off: float) -> None:
    """Opposite tendons, written with a few digits of pi, and lengths that do not quite agree."""
    robot = rod(n_tendons=2)
    first, last = robot.segments[0].tendons
    robot = replace(
        robot, segments=(replace(robot.segments[0], tendons=(first, replace(last, angle=np.pi - off))),)
    )
    lengths = robot.rest_tendon_length + np.array([0.003, -0.003]) + 1e-6
    state = Simulator(robot, points_per_segment=3).settle(lengths, tip_force=(0.05, 0.05, 0.0))
    assert state.ok.all()
    assert state.passes[0] <= 4
    layout, params, rest = compile_robots([robot], N_STEPS)
    bend_y = -0.003 / 0.0075 / 0.07
    memory = fill((layout, params, Reader(layout, params, rest, 1).ports(Inputs(lengths))), 1)
    assert_allclose(memory.curvature_guess[0], [0.0, bend_y, 0.0], atol=1e-3 * abs(bend_y))


@pytest.mark.parametrize("ratio", [2e-3, 1e-2, 0.1])
def test_tendons_nearly_in_a_plane_bend_and_pull_as_asked(ratio: float) -> None:
    """Curvature and tensions out of the plane are as large as rounding over the ratio of singular values
    makes them, in the twin too. What stands is what they are for: the curvature uses up the lengths, and the
    tensions give the moment."""
    offsets = 0.0075 * (
        in_plane(0.4, 4) + ratio * np.array([[0.4, -1.0], [-0.4, 1.0], [-0.4, 1.0], [0.4, -1.0]])
    )
    u_asked = np.array([3.0, -5.0])
    robot = rod()
    longer = 0.07 * arms(offsets) @ u_asked
    layout, params, ports = case(
        [robot],
        1,
        0,
        skip=("line_force", "point_force", "follower_tip_force", "extension", "base_pose"),
        tendon_length=robot.rest_tendon_length + longer,
        tip_force=(0.0, 0.0, 0.0),
        tip_moment=(0.01, 0.02, 0.0),
    )
    params = params._replace(offset=np.array(offsets[None, None]))
    memory = fill((layout, params, ports), 1)
    u, tension = memory.curvature_guess[0], memory.x[0, 3:]
    # a few roundings of the length itself, 0.07 m
    assert_allclose(0.07 * arms(offsets) @ u[:2], longer, rtol=0.0, atol=1e-15)
    x, _ = guess(0, layout, params, ports)
    largest = np.abs(arms(offsets).T * x[3:]).sum()  # the moments of the single tendons, which nearly cancel
    assert_allclose(arms(offsets).T @ tension, arms(offsets).T @ x[3:], rtol=0.0, atol=1e-13 * largest)


def test_an_arc_from_its_lengths() -> None:
    """Tendons at distance d differ from the backbone by d times the bend; four more tendons of another length
    only pull."""
    robot = rod()
    layout, params, rest = compile_robots([robot], N_STEPS)
    ports = Reader(layout, params, rest, 1).ports(Inputs(bend(robot, 0.5, -0.3)))
    memory = fill((layout, params, ports), 1)
    assert_allclose(memory.curvature_guess[0], [0.5 / 0.07, -0.3 / 0.07, 0.0], rtol=1e-13)
    assert_allclose(memory.x[0, :3], 0.0, atol=1e-18)
    # K u = -sum T (d_y, -d_x), shared by opposite tendons
    assert_allclose(
        memory.x[0, 3:],
        0.0022 / 0.07 / (2.0 * 0.0075) * np.array([-0.3, -0.5, 0.3, 0.5]),
        rtol=1e-12,
        atol=1e-15,
    )


def test_a_straight_rod_carries_the_moment_of_its_loads() -> None:
    robot = rod("passive", line_density=0.2)
    layout, params, rest = compile_robots([robot], N_STEPS)
    # d3 along world x, d1 along -z: the weight bends it about d2
    pose = (0.4, 100.0, -3.0, np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
    ports = Reader(layout, params, rest, 1).ports(
        Inputs(tip_force=(0.0, 0.3, 0.0), tip_moment=(0.0, 0.0, 0.01), base_pose=pose)
    )
    memory = fill((layout, params, ports), 1)
    weight = 0.2 * 9.81 * 0.07 * 0.035  # about world y, which is d2
    assert_allclose(memory.x[0], [-(0.07 * 0.3 + 0.01), weight, 0.0], atol=1e-16)


def test_a_batch_begins_as_its_robots_do_alone_bit_by_bit() -> None:
    rng = np.random.default_rng(8)
    robots = [varied(load_robot("five_segment_reacher"), rng) for _ in range(5)]
    layout, params, ports = case(robots, 5, seed=9)
    together = fill((layout, params, ports), 5)
    for i in range(5):
        mine = Params(*(a[i : i + 1].copy() for a in params))
        alone = fill((layout, mine, Ports(*(a[i : i + 1].copy() if len(a) > 1 else a for a in ports))), 1)
        assert_array_equal(alone.x[0], together.x[i])
        assert_array_equal(alone.curvature_guess[0], together.curvature_guess[i])
        # one set of numbers for all robots is the same set for each
        same = fill((layout, mine, Ports(*(a[i : i + 1].copy() if len(a) > 1 else a for a in ports))), 3)
        assert_array_equal(same.x, np.broadcast_to(together.x[i], same.x.shape))


@pytest.mark.parametrize("mode", ["tendon_length", "passive", "paper"])
def test_what_was_learned_is_forgotten_and_the_others_keep_theirs(mode: str) -> None:
    memory = fill(case([rod(mode)], 4, seed=1), 4, rows=[1, 3])
    for name in ("gain", "move", "defect", "covariance"):
        learned = getattr(memory, name)
        assert learned.size
        assert (learned[[1, 3]] == 0.0).all()
        assert (learned[[0, 2]] == 7.0).all()
    for a in (memory.x, memory.curvature_guess):
        assert (a[[0, 2]] == 7.0).all()
        assert (a[[1, 3]] != 7.0).all()
    assert (memory.length_before == 7.0).all()
    assert (memory.force_before == 7.0).all()
