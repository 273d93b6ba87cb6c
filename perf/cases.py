"""Robots and inputs that the benchmarks run, and the points per segment that keep a promised tip error."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fastrod import Robot, Simulator, State, load_robot
from report import SHARED

Array = NDArray[np.float64]
TIP_ERROR = 3e-6  # tip error that every timed row keeps against a fine solution [m]
N_FINE = 40  # points per segment of the fine solution; at least four times those of any row
STEPS_PER_CASE = 5
LINE = (1.0, 1.0, 1.0)  # line force of Appendix B, world [N/m]


@dataclass(frozen=True)
class Pose:
    """Inputs of a batch at one moment."""

    tendon_length: Array  # (n_robots, n_tendons) [m]
    tip_force: Array  # (n_robots, 3) world [N]

    def mixed(self, other: Pose, fraction: Any, forces: bool = True) -> Pose:
        """This pose moved by a fraction of the difference to another; the forces too, or only the lengths."""
        force = self.tip_force + forces * fraction * (other.tip_force - self.tip_force)
        return Pose(self.tendon_length + fraction * (other.tendon_length - self.tendon_length), force)

    def take(self, rows: NDArray[np.int64]) -> Pose:
        return Pose(self.tendon_length[rows], self.tip_force[rows])


@dataclass(frozen=True)
class Case:
    """One robot, and inputs for a batch of it."""

    key: str
    title: str
    robot: Robot
    here: Pose
    there: Pose
    line_force: tuple[float, float, float] = (0.0, 0.0, 0.0)  # world [N/m]

    def at(self, step: int, forces: bool) -> Pose:
        """Inputs at a time step: a tenth of the difference from `here` to `there` and back in 200 steps."""
        return self.here.mixed(self.there, 0.05 - 0.05 * float(np.cos(np.pi * step / 100.0)), forces)

    def inputs(self, pose: Pose) -> dict[str, Any]:
        """Keyword arguments of `Simulator.step` and `settle`."""
        return {**vars(pose), "line_force": self.line_force}


def appendix_b_robot(paper: bool) -> Robot:
    """The prototype with its tendons at 0.01 m, as in Appendix B; paper mode or the full tendon model."""
    robot = load_robot("prototype")
    (segment,) = robot.segments
    tendons = tuple(replace(tendon, offset=0.01) for tendon in segment.tendons)
    mode = "paper" if paper else "tendon_length"
    return replace(robot, segments=(replace(segment, tendons=tendons, mode=mode),))


def appendix_b() -> tuple[Pose, str]:
    """100 cases of Appendix B (tip forces up to 2 N), and their source."""
    file = SHARED / "truth" / "appB_truth.csv"
    if file.exists():
        held = np.genfromtxt(file, delimiter=",", names=True)
        lengths, forces = (np.column_stack([held[name] for name in names.split()]) for names in _COLUMNS)
        return Pose(lengths, forces), "the cases of Appendix B"
    rng = np.random.default_rng(7)
    bend = rng.uniform(-0.9, 0.9, (100, 1, 2))
    pose = Pose(arc_lengths(appendix_b_robot(True), bend), ball(rng, 100, 2.0))
    return pose, "seeded cases in the ranges of Appendix B"


_COLUMNS = ("L1 L2 L3 L4", "Fx Fy Fz")


def path() -> Pose:
    """The 500 points of Appendix B: from case to case in `STEPS_PER_CASE` steps, the last to the first."""
    cases, _ = appendix_b()
    n = len(cases.tip_force)
    case, step = np.divmod(np.arange(n * STEPS_PER_CASE), STEPS_PER_CASE)
    return cases.take(case).mixed(cases.take((case + 1) % n), step[:, None] / STEPS_PER_CASE)


def arc_lengths(robot: Robot, bend: Array) -> Array:
    """(n, n_tendons) lengths of a chain of arcs with `bend` (n, n_segments, 2) about d1 and d2 [rad];
    exact for arcs."""
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

    def in_disc() -> Pose:
        angle, size = rng.uniform(0.0, 2.0 * np.pi, n), 1.4 * rng.random(n)
        bend = np.stack([size * np.cos(angle), size * np.sin(angle)], axis=-1)[:, None]
        return Pose(arc_lengths(prototype, bend), ball(rng, n, 0.3))

    def in_cube() -> Pose:
        bend = rng.uniform(-0.5, 0.5, (n, reacher.n_segments, 2))
        return Pose(arc_lengths(reacher, bend), ball(rng, n, 0.05))

    one = "prototype, full tendon model, bends to 1.4 rad, tip force to 0.3 N"
    five = "five_segment_reacher, full tendon model, bends to 0.5 rad a segment and axis, tip force to 0.05 N"
    return [
        paper,
        Case("prototype", one, prototype, in_disc(), in_disc()),
        Case("reacher", five, reacher, in_cube(), in_cube()),
    ]


class TipError(NamedTuple):
    """Tip errors of a batch [m]."""

    largest: float
    median: float
    compared: float  # fraction of the robots that were solved


def tip_error(tip: Array, truth: Array, ok: NDArray[np.bool_]) -> TipError:
    error = np.linalg.norm(tip - truth, axis=1)[ok]
    median = float(np.median(error)) if len(error) else float("nan")
    return TipError(float(error.max(initial=0.0)), median, float(ok.mean()))


def state_error(state: State, fine: State) -> TipError:
    """Against a fine solution of the same inputs, of the robots that both solved."""
    return tip_error(state.tip_position, fine.tip_position, state.ok & fine.ok)


def fine_solution(case: Case, pose: Pose, outputs: Any = "tip") -> tuple[Simulator, State]:
    """A simulator with `N_FINE` points per segment, settled on a pose to 1e-10 m."""
    sim = Simulator(case.robot, len(pose.tip_force), points_per_segment=N_FINE, outputs=outputs)
    return sim, sim.settle(**case.inputs(pose), tolerance=1e-10)


def settled(
    case: Case, pose: Pose, points: int, fine: Simulator, threads: int | None = None
) -> tuple[Simulator, State]:
    """A simulator with `points` per segment, settled from the boundary of a fine one: on its branch."""
    n = len(pose.tip_force)
    sim = Simulator(case.robot, n, points_per_segment=points, outputs="tip", threads=threads)
    sim.restore(fine.snapshot())
    return sim, sim.settle(**case.inputs(pose), tolerance=1e-10)


def fewest_points(case: Case, pose: Pose, fine: Simulator, at_fine: State) -> tuple[int, TipError]:
    """The fewest points per segment whose largest tip error on these inputs is within `TIP_ERROR`."""
    for points in range(2, 11):
        error = state_error(settled(case, pose, points, fine)[1], at_fine)
        if error.largest <= TIP_ERROR:
            break
    return points, error
