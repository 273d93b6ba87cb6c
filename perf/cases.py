"""Robots and inputs that the benchmarks run, and the points per segment that keep a promised tip error."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypedDict

import numpy as np
from numpy.typing import NDArray

from fastrod import Robot, Simulator, State, load_robot

Array = NDArray[np.float64]
TRUTH = Path(__file__).resolve().parents[2] / "shared" / "truth"
TIP_ERROR = 3e-6
"""Tip error that every timed row keeps against a fine solution [m]."""
N_FINE = 40
"""Points per segment of the fine solution; at least four times those of any row."""
STEPS_PER_CASE = 5
LINE = (1.0, 1.0, 1.0)
"""Line force of Appendix B, world [N/m]."""
_LADDER = (2, 3, 4, 5, 6, 7, 8, 9, 10)


@dataclass(frozen=True)
class Pose:
    """Inputs of a batch at one moment."""

    tendon_length: Array
    """(n_robots, n_tendons) [m]."""
    tip_force: Array
    """(n_robots, 3) world [N]."""

    def mixed(self, other: Pose, part: float, forces: bool) -> Pose:
        """This pose moved by `part` of the way to another; the forces too, or only the lengths."""
        force = self.tip_force + part * (other.tip_force - self.tip_force) if forces else self.tip_force
        return Pose(self.tendon_length + part * (other.tendon_length - self.tendon_length), force)

    def take(self, rows: NDArray[np.int64]) -> Pose:
        return Pose(self.tendon_length[rows], self.tip_force[rows])


class Words(TypedDict):
    """Inputs by the names that `Simulator` gives them."""

    tendon_length: Array
    tip_force: Array
    line_force: tuple[float, float, float]


@dataclass(frozen=True)
class Case:
    """One robot, and inputs for a batch of it."""

    key: str
    title: str
    robot: Robot
    here: Pose
    there: Pose
    line_force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """World [N/m]."""

    def at(self, step: int, forces: bool) -> Pose:
        """Inputs at a time step: a tenth of the way from `here` to `there` and back, once in 200 steps."""
        return self.here.mixed(self.there, 0.05 - 0.05 * float(np.cos(np.pi * step / 100.0)), forces)

    def words(self, pose: Pose) -> Words:
        """Keyword arguments of `Simulator.step` and `settle`."""
        return {
            "tendon_length": pose.tendon_length,
            "tip_force": pose.tip_force,
            "line_force": self.line_force,
        }


def appendix_b_robot(paper: bool) -> Robot:
    """The prototype with its tendons at 0.01 m, as in Appendix B, in paper mode or with the full tendon
    model."""
    robot = load_robot("prototype")
    (segment,) = robot.segments
    tendons = tuple(replace(tendon, offset=0.01) for tendon in segment.tendons)
    return replace(
        robot, segments=(replace(segment, tendons=tendons, mode="paper" if paper else "tendon_length"),)
    )


def appendix_b() -> tuple[Pose, str]:
    """100 cases of Appendix B (tip forces up to 2 N), and where they come from."""
    file = TRUTH / "appB_truth.csv"
    if file.exists():
        table = np.genfromtxt(file, delimiter=",", names=True)
        lengths = np.column_stack([table[f"L{i}"] for i in range(1, 5)])
        return Pose(
            lengths, np.column_stack([table[name] for name in ("Fx", "Fy", "Fz")])
        ), "the cases of Appendix B"
    rng = np.random.default_rng(7)
    bend = rng.uniform(-0.9, 0.9, (100, 1, 2))
    return Pose(
        arc_lengths(appendix_b_robot(True), bend), ball(rng, 100, 2.0)
    ), "seeded cases in the ranges of Appendix B"


def path() -> Pose:
    """The 500 points of Appendix B: from each case to the next in `STEPS_PER_CASE` steps, and from the last
    to the first."""
    cases, _ = appendix_b()
    n = len(cases.tip_force)
    index = np.arange(n * STEPS_PER_CASE)
    case, part = index // STEPS_PER_CASE, (index % STEPS_PER_CASE / STEPS_PER_CASE)[:, None]
    here, there = cases.take(case), cases.take((case + 1) % n)
    return Pose(
        here.tendon_length + part * (there.tendon_length - here.tendon_length),
        here.tip_force + part * (there.tip_force - here.tip_force),
    )


def arc_lengths(robot: Robot, bend: Array) -> Array:
    """(n, n_tendons) lengths of a chain of arcs with `bend` (n, n_segments, 2) about d1 and d2 [rad]; exact
    for arcs."""
    lengths = np.zeros((len(bend), robot.n_tendons))
    for t, (tendon, last) in enumerate(zip(robot.tendons, robot.tendon_segment, strict=True)):
        for k, (x, y) in enumerate(tendon.position(int(last) + 1)):
            lengths[:, t] += robot.segments[k].length + bend[:, k, 0] * y - bend[:, k, 1] * x
    return lengths


def ball(rng: np.random.Generator, n: int, radius: float) -> Array:
    """(n, 3) vectors of any direction, their length uniform up to `radius`."""
    v = rng.normal(size=(n, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True) * radius * rng.random((n, 1)))


def cases(n: int) -> list[Case]:
    """The three robots of the observer rows, `n` robots each, seeded."""
    rng = np.random.default_rng(1)
    pool, source = appendix_b()
    here, there = (pool.take(rng.integers(0, len(pool.tip_force), n)) for _ in range(2))
    paper = Case("paper", f"prototype, paper mode, {source}", appendix_b_robot(True), here, there, LINE)
    prototype, reacher = load_robot("prototype"), load_robot("five_segment_reacher")

    def bent(robot: Robot, disc: bool, most: float, force: float) -> Pose:
        if disc:
            angle, size = rng.uniform(0.0, 2.0 * np.pi, n), most * rng.random(n)
            bend = np.stack([size * np.cos(angle), size * np.sin(angle)], axis=-1)[:, None]
        else:
            bend = rng.uniform(-most, most, (n, robot.n_segments, 2))
        return Pose(arc_lengths(robot, bend), ball(rng, n, force))

    return [
        paper,
        Case(
            "prototype",
            "prototype, full tendon model, bends to 1.4 rad, tip force to 0.3 N",
            prototype,
            bent(prototype, True, 1.4, 0.3),
            bent(prototype, True, 1.4, 0.3),
        ),
        Case(
            "reacher",
            "five_segment_reacher, full tendon model, bends to 0.5 rad a segment and axis, tip "
            "force to 0.05 N",
            reacher,
            bent(reacher, False, 0.5, 0.05),
            bent(reacher, False, 0.5, 0.05),
        ),
    ]


@dataclass(frozen=True)
class Error:
    """Tip errors of a batch against a fine solution of the same inputs [m]."""

    largest: float
    median: float
    compared: float
    """Share of the robots that both solved."""


def tip_error(state: State, fine: State) -> Error:
    ok = state.ok & fine.ok
    error = np.linalg.norm(state.tip_position - fine.tip_position, axis=1)[ok]
    return Error(
        float(error.max(initial=0.0)),
        float(np.median(error)) if len(error) else float("nan"),
        float(ok.mean()),
    )


def fine_solution(case: Case, pose: Pose, outputs: Literal["full", "tip"] = "tip") -> tuple[Simulator, State]:
    """A simulator with `N_FINE` points per segment, settled on a pose to 1e-10 m."""
    sim = Simulator(case.robot, len(pose.tip_force), points_per_segment=N_FINE, outputs=outputs)
    return sim, sim.settle(**case.words(pose), tolerance=1e-10)


def settled(
    case: Case, pose: Pose, points: int, fine: Simulator, threads: int | None = None
) -> tuple[Simulator, State]:
    """A simulator with `points` per segment, settled from the boundary of a fine one, so on the same
    branch."""
    sim = Simulator(
        case.robot, len(pose.tip_force), points_per_segment=points, outputs="tip", threads=threads
    )
    sim.restore(fine.snapshot())
    return sim, sim.settle(**case.words(pose), tolerance=1e-10)


def fewest_points(case: Case, pose: Pose, fine: Simulator, at_fine: State) -> tuple[int, Error]:
    """The fewest points per segment whose largest tip error on these inputs is within `TIP_ERROR`."""
    error = Error(float("inf"), float("inf"), 0.0)
    for points in _LADDER:
        _, state = settled(case, pose, points, fine)
        error = tip_error(state, at_fine)
        if error.largest <= TIP_ERROR:
            return points, error
    return _LADDER[-1], error
