"""Replay: the model beside a measurement, sample by sample, at rest or in motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fastrod.errors import LogError
from fastrod.identification.log.camera import earlier, pictures
from fastrod.identification.log.inputs import base_of, check_driven, inputs
from fastrod.loading import robot_of
from fastrod.logs.drives import moved
from fastrod.logs.reader import log_of
from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Robot
from fastrod.threads import one_blas_thread
from fastrod.types import Flags, Floats, Ints

Progress = Callable[[int, int], None]

CHUNK = 4096  # rows a batch: enough to fill every core, small enough for a steady progress bar


@dataclass(frozen=True, kw_only=True, eq=False)
class Replay:
    """A log and what the model says to the same inputs. Lengths in metres, base frame; residual = measured -
    predicted."""

    log: RunLog
    robot: Robot
    tip_position: Floats
    """(n, 3) predicted tip [m]; nan where the inputs are missing or the model did not converge."""
    converged: Flags
    """(n,) rows that the model solved."""
    points: Floats | None = None
    """(n, k, 3) predicted further points at the robot's `log_points` [m], where the log measured some."""
    dynamics: bool = False
    """In motion, and not at rest in each row."""
    questions: tuple[str, ...] = ()
    """Questions that the log raises about its units, signs, order, frame and time, a sentence each."""

    @property
    def compared(self) -> Flags:
        """(n,) rows that count: measured and converged."""
        return self.log.measured & self.converged

    @property
    def residual(self) -> Floats:
        """(n, 3) measured - predicted tip [m]; nan where either is missing."""
        return np.where(self.compared[:, None], self.log.tip_position - self.tip_position, np.nan)

    @property
    def points_residual(self) -> Floats | None:
        """(n, k, 3) measured - predicted further points [m]."""
        return None if self.points is None or self.log.points is None else self.log.points - self.points

    @property
    def axis_rms(self) -> Floats:
        """(3,) residual of the tip along x, y, z of the base frame, root mean square [m]."""
        return np.asarray(np.sqrt(np.mean(self.residual[self.compared] ** 2, axis=0)), dtype=np.float64)

    @property
    def rms(self) -> float:
        """Distance between measured and predicted tip, root mean square [m]."""
        return _rms(self.residual[self.compared])

    @property
    def max(self) -> float:
        """Largest distance between measured and predicted tip [m]."""
        return float(np.linalg.norm(self.residual[self.compared], axis=1).max(initial=0.0))

    @property
    def excursion_rms(self) -> float:
        """Return how far the measured tip moves: its distance from its own mean, root mean square [m]."""
        tip = self.log.tip_position[self.compared]
        return _rms(tip - tip.mean(axis=0))

    @property
    def baseline_rms(self) -> float:
        """Return what no model at all leaves: the measured tip's distance from the straight robot's tip,
        root mean square [m]."""
        return _rms(self.log.tip_position[self.compared] - (0.0, 0.0, self.robot.length))

    @property
    def run_rms(self) -> dict[str, float]:
        """`rms` of each run that has compared rows [m]."""
        return {label: piece.rms for label, piece in self.pieces() if piece.compared.any()}

    def pieces(self) -> Iterator[tuple[str, Replay]]:
        """Each run's label and its part of this replay."""
        for label in self.log.runs:
            yield label, self.rows(self.log.run == label)

    def rows(self, which: Flags) -> Replay:
        """The rows of the mask `which` (n,)."""
        points = None if self.points is None else self.points[which]
        tip, converged = self.tip_position[which], self.converged[which]
        return Replay(
            log=self.log.rows(which),
            robot=self.robot,
            tip_position=tip,
            converged=converged,
            points=points,
            dynamics=self.dynamics,
        )


@one_blas_thread
def replay(
    log: RunLog | str | Path,
    robot: Robot | str | Path,
    *,
    simulator: Callable[..., Any] | None = None,
    dynamics: bool = False,
    progress: Progress | None = None,
) -> Replay:
    """The model's answer to every row of `log`, each row one robot of a batch; at a row whose picture had
    waited for it, to the inputs that were when it was taken. Both may be given by their files, and a shipped
    robot by its name.

    Effects of the robot are carried over the whole log, memories, clocks and camera included; each run begins
    at rest. The measured frame is taken as the robot's base frame: nothing is registered and nothing is
    fitted. Where another reading of the log would follow far better, `questions` of the answer ask for it.
    With `dynamics` each run is one rod in motion, from rest at its first row, with inertia and damping; then
    `progress` counts time steps, and nothing is asked.
    `simulator` stands in for `fastrod.Simulator`, and leaves the questions out; `progress` is called with the
    rows done and the rows in all. Raises `LogError` where no row of the log can be compared, `InputError` for
    a robot that lengths do not drive.
    """
    robot = robot_of(robot)
    log = log_of(log, robot)
    check_driven(log, robot)
    if not log.measured.any():
        raise LogError(
            f"log {log.name!r} has no row in which every input and the tip are there; there is "
            "nothing to compare."
        )
    open_questions: tuple[str, ...] = ()
    n_points = 0 if log.points is None else log.points.shape[1]
    if dynamics:
        from fastrod.identification.log.motion import predict_motion  # it loads numba

        tip, points, converged = predict_motion(log, robot, points=log.points is not None, progress=progress)
    else:
        if simulator is None:
            # it loads numba, which no other command line word needs
            from fastrod.identification.log.questions import questions

            open_questions = questions(log, robot)
        tip, points, converged = _at_rest(log, robot, n_points, simulator, progress)
    tip[~converged], points[~converged] = np.nan, np.nan
    return Replay(
        log=pictures(log)[0],
        robot=robot,
        tip_position=tip,
        converged=converged,
        points=points if n_points else None,
        dynamics=dynamics,
        questions=open_questions,
    )


def _at_rest(
    log: RunLog, robot: Robot, n_points: int, simulator: Callable[..., Any] | None, progress: Progress | None
) -> tuple[Floats, Floats, Flags]:
    """Tip (n, 3) and further points (n, k, 3) of every row [m], and which rows converged, batch by batch."""
    log = moved(log)
    rows = np.flatnonzero(log.driven)
    tip, points = np.full((len(log), 3), np.nan), np.full((len(log), n_points, 3), np.nan)
    converged = np.zeros(len(log), dtype=np.bool_)
    solved: Callable[[Ints], tuple[Floats, Floats, Flags]] | None = None
    if simulator is None:
        from fastrod.simulator import Simulator

        simulator = Simulator
        if robot.effects:
            rows, solved = _with_effects(log, robot, log.points is not None)
    if solved is None:
        log = earlier(log, pictures(log)[1])
    for start in range(0, len(rows), CHUNK):
        chunk = rows[start : start + CHUNK]
        tip[chunk], points[chunk], converged[chunk] = (
            solved(np.arange(start, start + len(chunk)))
            if solved
            else _solve(log.rows(chunk), robot, simulator)
        )
        if progress is not None:
            progress(start + len(chunk), len(rows))
    return tip, points, converged


def _with_effects(
    log: RunLog, robot: Robot, with_points: bool
) -> tuple[Ints, Callable[[Ints], tuple[Floats, Floats, Flags]]]:
    """Rows of the log in the order of its runs, and what solves some of these."""
    from fastrod.identification.log.forward import PredictedRod, predict  # they load numba
    from fastrod.identification.log.samples import sample
    from fastrod.identification.log.unknowns import known_model

    samples, model = sample(log), known_model(robot)

    def solved(which: Ints) -> tuple[Floats, Floats, Flags]:
        piece = samples.on(samples.given[which])
        pose = predict(model, np.zeros(0), piece, PredictedRod(piece, robot, points=with_points))
        return pose.position, pose.points, pose.ok

    return samples.origin[samples.given], solved


def _solve(log: RunLog, robot: Robot, simulator: Callable[..., Any]) -> tuple[Floats, Floats, Flags]:
    """Tip (n, 3) and further points (n, k, 3) in the base frame [m], and which rows converged, of one
    batch."""
    sim = simulator(robot, n_robots=len(log))
    state = sim.settle(**inputs(log, robot))
    rotation, origin = base_of(log, robot)
    points, tip = np.zeros((len(log), 0, 3)), np.asarray(state.tip_position, dtype=np.float64)
    if log.points is not None and robot.log_points:
        points, _ = sim.markers()
    if log.without_tip:
        points, tip = points[:, :-1], points[:, -1]
    return (
        _into_base(tip[:, None] - origin, rotation)[:, 0],
        _into_base(points - origin, rotation),
        np.asarray(state.ok, dtype=np.bool_),
    )


def _into_base(world: Floats, rotation: Floats) -> Floats:
    """(n, k, 3) vectors of the world frame, in the base frame of each row; `rotation` (n, 3, 3) is
    world_from_base."""
    return np.asarray(np.einsum("nji,nkj->nki", rotation, world), dtype=np.float64)


def _rms(vectors: Floats) -> float:
    return math.sqrt(float(np.mean(np.sum(vectors**2, axis=-1)))) if len(vectors) else math.nan
