"""First look at a log, before anything is fitted: does it fit the robot, and what can it reveal?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fastrod.errors import LogError
from fastrod.identification.log.advice import excitation
from fastrod.identification.log.camera import sentences
from fastrod.identification.log.clock import clock_offset, clock_sentence
from fastrod.identification.log.order import ColumnOrder, column_order
from fastrod.identification.log.questions import left_by, read
from fastrod.identification.log.samples import LogSamples, sample
from fastrod.loading import robot_of
from fastrod.logs.reader import log_of
from fastrod.logs.runlog import RunLog, on_one_clock
from fastrod.model.robot import Robot
from fastrod.model.routing import route
from fastrod.types import Floats

_OCTANTS = 8
_BENT = 0.3  # of the largest bend: directions of smaller ones do not count
_LEAST = 12  # rows; of fewer nothing can be said
_BETTER = 0.7  # of what the angles of the robot file leave: other ones are better
_FAR = 0.02  # rad: tendons that stand further from where the file says are worth another angle


@dataclass(frozen=True, kw_only=True, eq=False)
class LogCheck:
    """Report of a first look at a log."""

    facts: Mapping[str, str]
    """Facts about the log: rows, drives, bends, tip, and how far the model follows it."""
    refusal: str
    """Why nothing can be identified from it, in a sentence; empty where it can."""
    questions: tuple[str, ...]
    """Further questions to the user, a sentence each."""
    shows: tuple[str, ...]
    """Which effects the log can tell apart."""
    lacks: tuple[str, ...]
    """Which it cannot, and why."""
    columns: ColumnOrder | None
    """The columns matched to the tendons, where they do not fit as they are; None where they do."""
    robot: Robot
    """The robot with the order of its columns, their signs and the angles of its tendons as matched; as given
    where the columns fit."""


def check(log: RunLog | str | Path, robot: Robot | str | Path, *, threads: int | None = None) -> LogCheck:
    """Look at `log` of `robot`: units, signs, order of the columns, clock, frame and time, what it covers.

    Nothing is fitted; a few hundred rows are solved. Raises `LogError` for a log without a dozen measured
    rows.
    """
    robot = robot_of(robot)
    log = log_of(log, robot)
    samples = sample(log)
    if len(samples.rows) < _LEAST:
        raise LogError(
            f"log {log.name!r} has {len(samples.rows)} rows in which every input and the tip are there; a "
            f"check needs {_LEAST}."
        )
    clock = clock_offset(samples, robot, threads)
    if clock:
        samples = sample(on_one_clock(log, clock))
    reading = read(samples, robot, threads=threads)
    questions = [*sentences(log), *([clock_sentence(log, clock)] if clock else [])]
    if reading.registration is not None:
        questions.append(reading.registration.sentence())
    columns, found, left = None, robot, left_by(samples, robot, threads)
    if reading.questions and robot.n_tendons:
        columns, found, least = _matched(samples, robot, threads)
        if columns is not None and not least < left:
            columns, found = None, robot
    wiring = route(robot)
    bend = wiring.of_sections(wiring.bend(samples.log.pulls))
    said = excitation(samples, bend)
    return LogCheck(
        facts=_facts(log, samples, robot, bend, left),
        refusal=reading.refusal,
        questions=(*questions, *(each for each in reading.questions if each != reading.refusal)),
        shows=tuple(can for there, can, _ in said if there),
        lacks=tuple(cannot for there, _, cannot in said if not there),
        columns=columns,
        robot=found,
    )


def _matched(
    samples: LogSamples, robot: Robot, threads: int | None
) -> tuple[ColumnOrder | None, Robot, float]:
    """The columns matched to the tendons, the robot with them, and what it leaves [m]. Of both signs, with
    the tendons of each segment at any angle, the solved model says which; the angles of the robot file hold
    where they are about as good."""
    found = []
    for sign in (0.0, 1.0, -1.0):
        columns = column_order(samples, robot, sign)
        if columns is not None:
            rotated = _rotated(robot, columns.rotation)
            log = samples.log.with_pulls(columns.of(samples.log.pulls))
            left = left_by(replace(samples, log=log), rotated, threads)
            as_filed = sign == 0.0 and len(set(columns.sign.tolist())) == 1
            found.append((left * (_BETTER if as_filed else 1.0), left, columns, rotated))
    if not found:
        return None, robot, np.inf
    _, left, columns, rotated = min(found, key=lambda each: each[0])
    return columns, _with_columns(rotated, columns), left


def _rotated(robot: Robot, rotation: Floats) -> Robot:
    """The robot with the tendons of each segment rotated about the axis; as it is where that is next to
    nothing."""

    def moved(angle: float | tuple[float, ...], by: float) -> float | tuple[float, ...]:
        if isinstance(angle, tuple):
            return tuple(float(np.remainder(a + by + np.pi, 2.0 * np.pi) - np.pi) for a in angle)
        return float(np.remainder(angle + by + np.pi, 2.0 * np.pi) - np.pi)

    by = np.remainder(rotation + np.pi, 2.0 * np.pi) - np.pi
    if (np.abs(by) < _FAR).all():
        return robot
    segments = tuple(
        replace(segment, tendons=tuple(replace(t, angle=moved(t.angle, float(b))) for t in segment.tendons))
        for segment, b in zip(robot.segments, by, strict=True)
    )
    return replace(robot, segments=segments)


def _with_columns(robot: Robot, columns: ColumnOrder) -> Robot:
    """The robot with `[log]` for its columns in the order and with the signs that were found."""
    log, n = robot.log, robot.n_tendons
    kind = "tension" if robot.by_tension else "dl"
    names = [log.sources.get(f"{kind}_{k}", f"{kind}_{k}") for k in range(1, n + 1)]

    def each(value: object) -> list[float]:
        given = list(value) if isinstance(value, tuple) else [value] * n
        return [float(given[k]) for k in columns.order]

    sign = tuple(round(a * b) for a, b in zip(each(log.sign), columns.sign.tolist(), strict=True))
    kept = {key: value for key, value in log.columns.items() if key.partition("_")[0] not in (kind, "pos")}
    pos = {}
    if "pos_1" in log.sources:
        pos = {"pos": tuple(log.sources[f"pos_{k + 1}"] for k in columns.order)}
    made = replace(
        log,
        columns={**kept, kind: tuple(names[k] for k in columns.order), **pos},
        sign=log.sign if robot.by_tension else sign[0] if len(set(sign)) == 1 else sign,
        offset=tuple(each(log.offset)) if isinstance(log.offset, tuple) else log.offset,
        drum_radius=tuple(each(log.drum_radius)) if isinstance(log.drum_radius, tuple) else log.drum_radius,
    )
    return replace(robot, log=made)


def _facts(given: RunLog, samples: LogSamples, robot: Robot, bend: Floats, left: float) -> dict[str, str]:
    log, tip = samples.log, np.asarray(samples.log.tip_position)[samples.rows]
    gaps = int((samples.log.t > given.t[samples.origin]).sum())
    lasts = sum(float(samples.time[span.stop - 1]) for span in samples.runs)
    runs = f"{len(samples.runs)} run{'s' if len(samples.runs) > 1 else ''}"
    facts = {
        "rows": f"{len(samples.given)} in {runs}, {len(samples.rows)} of them measured; {lasts:.0f} s, one "
        f"every {samples.step:.3g} s"
        + (f"; {gaps} gap{'s' if gaps > 1 else ''} in time, read as holds" if gaps else "")
    }
    if robot.n_tendons:
        driven = 1e3 * log.commands if log.tension is None else log.commands
        ranges = zip(driven.min(axis=0), driven.max(axis=0), strict=True)
        unit = "mm" if log.tension is None else "N"
        facts["tendons"] = ", ".join(f"{a:.3g} to {b:.3g}" for a, b in ranges) + f" {unit}"
        size = np.linalg.norm(bend, axis=-1)
        octant = np.floor(_OCTANTS * (np.arctan2(bend[..., 1], bend[..., 0]) / (2.0 * np.pi) + 0.5))
        said = []
        for k, most in enumerate(size.max(axis=0)):
            covered = len(np.unique(octant[size[:, k] > _BENT * max(most, 1e-6), k] % _OCTANTS))
            said.append(
                f"segment {k + 1} to {np.degrees(most):.0f} deg in {covered} of {_OCTANTS} directions"
            )
        facts["bends"] = "; ".join(said)
    moves = float(np.sqrt(((tip - tip.mean(axis=0)) ** 2).sum(1).mean()))
    facts["tip"] = f"moves {1e3 * moves:.3g} mm about its mean, rms"
    facts["model"] = (
        f"robot {robot.name!r} as given follows it to {1e3 * left:.3g} mm, the camera registered"
        if np.isfinite(left)
        else f"robot {robot.name!r} as given cannot be solved for these inputs"
    )
    return facts
