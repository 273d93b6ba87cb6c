"""Before any effect: are the tendons what the robot file says?

Most robot files have push-pull tendons on a body that cannot shorten. Most robots have tendons that can only
pull: pretensioned, a little elastic, on a body that gives way along its axis. That is no effect beside a
model but another base model, and it takes all of it at once: on measured robots slack alone, or shortening
alone, gained nothing where both together halved the error.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from fastrod.effects.pipeline import named_effects
from fastrod.identification.log.base_model import STIFFNESS_SD
from fastrod.identification.log.split import SplitLog, thinned
from fastrod.identification.log.unknowns import Model
from fastrod.identification.search.base import BaseFit, Rival, fit_base
from fastrod.identification.search.correlation import blocks_alike
from fastrod.identification.search.model_selection import BIC_ACCEPT, BIC_STRONG, Z_ACCEPT, Z_STRONG
from fastrod.identification.search.search import N_BLOCKS
from fastrod.identification.search.solve import bic, effective_size, paired
from fastrod.model.robot import Robot, Segment, Tendon
from fastrod.model.routing import route
from fastrod.types import Floats

NAME, SLACK = "one_sided_tendons", "slack_alone"
_ROWS = 300  # that the rivals are fitted to; the one that is taken, to as many as any robot of modes
_LEFT = 0.05  # of the motion: a push-pull model that leaves less is asked for no other tendons
_FLOORS = 3.0  # of the noise, the same
_COMMON = 0.02  # of the commands' squares
_ROUGHLY = 1.5  # times what a fit to a few rows may leave of what one to all is to leave
_FRACTION = 0.1  # of the loss that another base model must take away
# Nominal numbers where the file has none, from the bending stiffness: measured robots had a tendon 0.5 to 1
# times as elastic as a segment that it bends, and a body 5 to 60 times as stiff along its axis as in bending
_ELASTIC, _AXIAL, _PRETENSION = 0.3, 20.0, 0.1
_WIDE = 1.5  # relative sd of these
_STRAIGHT = 0.02  # rad
_LATENCY_SD = 0.15  # s
_DELAYED = 0.5  # of the loss: a delay that takes away more belongs to the base model
_PRETENSION_SD = 0.3  # of the tension that the largest bend takes


class OneSidedTendons:
    """Tendons can only pull: they go slack, have a pretension and stretch, and the body shortens.

    Equation: T = max(0, T0 + (l - l_commanded) / c), and the segment shortens by T l / EA
    Symbols: T tension, T0 pretension, c compliance, EA axial_stiffness, l the tendon's path in the body
    Source: Rucker and Webster 2011, Statics and dynamics of continuum robots with general tendon routing,
    with the tensions of one-sided tendons
    Residual signature: where tendons pay out the robot bends less than their lengths ask for, and by another
    amount where all are pulled
    """


def are_worth_trying(base: BaseFit, left: float) -> bool:
    """Whether push-pull tendons and effects leave so much, `left` [m], that other tendons are worth their
    time; the file says nothing of slack or shortening yet, and two tendons share a segment."""
    robot, tip = base.robot, base.search.target.tip
    motion = float(np.sqrt(((tip - tip.mean(0)) ** 2).sum(1).mean()))
    ends = np.bincount(np.asarray(robot.tendon_segment, dtype=int), minlength=1)
    known = (
        robot.by_tension
        or any(t.unilateral for t in robot.tendons)
        or any(math.isfinite(s.axial_stiffness) or s.extension != (0.0, 0.0) for s in robot.segments)
    )
    much = left > max(_LEFT * motion, _FLOORS * base.noise.floor)
    return bool(ends.max(initial=0) >= 2) and not known and much


def are_pulled(base: BaseFit) -> bool:
    """Whether the commands show that the tendons are not what they seem: they hold what no bend asks for, so
    that each has a drive of its own, or nothing pulls back what they pull."""
    wiring, samples = route(base.robot), base.search.samples
    dl = np.asarray(samples.log.dl)[samples.rows]
    common = dl - wiring.tendon_change(wiring.bend(dl))
    return float((common**2).sum()) > _COMMON * float((dl**2).sum()) or bool(_unopposed(base.robot))


def one_sided(
    log: SplitLog,
    base: BaseFit,
    most_rows: int,
    model_of: Callable[[Robot], Model],
    threads: int | None,
    below: float,
) -> tuple[SplitLog, BaseFit]:
    """The log and the base fit, of a robot with tendons that can only pull where that explains the log better
    than the file's own, and than shortening or stretch alone; else as they are, with what was tried.
    `model_of` makes the base model of a robot, `most_rows` are those of a fit; what leaves more than `below`
    [m] is not taken."""
    rows = thinned(log.rows, _ROWS)
    given = _timed(base.robot)
    own = fit_base(
        log.samples.on(rows), log.rows, model_of(given), given, base.search.excluded, threads, base
    )
    span = np.abs(np.asarray(log.samples.log.dl)).max()
    rivals, fits = list[Rival](), dict[str, tuple[Robot, SplitLog, BaseFit]]()
    for name, what, robot, columns in _variants(given, float(span)):
        moved = _commanded(log, columns)
        # slack alone begins where slack and shortening have ended
        like = fits[NAME][2] if name == SLACK else own
        fitted = fit_base(
            moved.samples.on(rows), log.rows, model_of(robot), robot, base.search.excluded, threads, like
        )
        rivals.append(_judged(name, what, own, fitted))
        fits[name] = robot, moved, fitted
        if name == NAME and not (_better(rivals[0]) and rivals[0].left < _ROUGHLY * below):
            break
    best = max(rivals, key=lambda rival: rival.bic_gain)
    if best.name not in (NAME, SLACK) or not _better(best):
        return log, replace(base, rivals=tuple(rivals))
    robot, moved, fitted = fits[best.name]
    samples = moved.samples.on(thinned(log.rows, most_rows))
    final = fit_base(samples, log.rows, model_of(robot), robot, base.search.excluded, threads, like=fitted)
    if given is not base.robot:  # a small delay is for the search to tell: it stands in for any memory
        without = final.search.refined(final.search.without(final.start, "latency"))
        if final.start.fit.loss > _DELAYED * without.fit.loss:
            robot = replace(robot, sensor=base.robot.sensor)
            model = model_of(robot)
            final = fit_base(samples, log.rows, model, robot, base.search.excluded, threads, like=final)
    if final.left > below:
        return log, replace(base, rivals=tuple(rivals))
    return moved, replace(final, without=base, rivals=tuple(rivals))


def _better(rival: Rival) -> bool:
    evident = (rival.z > Z_ACCEPT and rival.bic_gain > BIC_ACCEPT) or (
        rival.z > Z_STRONG and rival.bic_gain > BIC_STRONG
    )
    return evident and rival.fraction > _FRACTION


def _judged(name: str, what: str, own: BaseFit, other: BaseFit) -> Rival:
    """Losses in square metres, for each fit has weights of its own."""

    def squares(of: BaseFit) -> tuple[Floats, float]:
        scale = float((of.search.target.sigma**2).mean())
        return of.start.losses * scale, of.start.fit.loss * scale

    (was, before), (is_, after) = squares(own), squares(other)
    size = effective_size(other.start.fit.residual)
    more = len(other.start.fit.theta) - len(own.start.fit.theta)
    alike = blocks_alike(own.search.row_correlation, len(own.search.block) // N_BLOCKS)
    counted = max(int((other.search.target.weight > 0.0).sum()), 1)
    return Rival(
        name=name,
        what=what,
        left=float(np.sqrt(is_.sum() / counted)),
        z=paired(was, is_) / alike,
        bic_gain=bic(before, 0, size) - bic(after, more, size),
        fraction=1.0 - after / before,
    )


def _variants(robot: Robot, span: float) -> Iterator[tuple[str, str, Robot, Floats]]:
    """Robots that the file may have meant: name, words, robot, and (n_tendons, n_given) its commands from
    those given, of which the largest is `span` [m]."""
    pulled, columns = _with_antagonists(robot)
    one_sided = _pulling(pulled, span, paired=len(columns) > robot.n_tendons)
    elastic, same = _elastic(robot), np.eye(robot.n_tendons)
    yield NAME, "one-sided, pretensioned, elastic; a body that shortens", _shortening(one_sided), columns
    yield SLACK, "one-sided, pretensioned, elastic; a body that cannot shorten", one_sided, columns
    yield "shortening_alone", "push-pull, elastic; a body that shortens", _shortening(elastic), same
    yield "stretch_alone", "push-pull, elastic; a body that cannot shorten", elastic, same


def _timed(robot: Robot) -> Robot:
    """With a delay that is fitted: beside a large one no tendons would show what they are."""
    if "latency_sd" in robot.sensor or "latency" in named_effects(robot):
        return robot
    return replace(robot, sensor={**robot.sensor, "latency_sd": _LATENCY_SD})


def _commanded(log: SplitLog, columns: Floats) -> SplitLog:
    """The log with the commands of other tendons."""
    samples = log.samples
    dl = np.asarray(samples.log.dl) @ columns.T
    return replace(log, samples=replace(samples, log=replace(samples.log, dl=dl)))


def _places(robot: Robot) -> list[list[int]]:
    """Tendons that end at each segment."""
    ends = np.asarray(robot.tendon_segment, dtype=int)
    return [np.flatnonzero(ends == k).tolist() for k in range(robot.n_segments)]


def _direction(tendon: Tendon) -> float:
    """Return where it lies at its end [rad]."""
    return float(tendon.angle[-1] if isinstance(tendon.angle, tuple) else tendon.angle)


def _unopposed(robot: Robot) -> set[int]:
    """Tendons without an antagonist in a segment whose tendons pull to one side of it only: what bends it
    back is then a tendon that the file does not have, on the same drive."""
    found = set[int]()
    for tendons in _places(robot):
        at = np.array(sorted(_direction(robot.tendons[t]) % (2.0 * np.pi) for t in tendons))
        if len(at) and np.diff(at, append=at[0] + 2.0 * np.pi).max() > np.pi - _STRAIGHT:
            for t in tendons:
                turned = np.abs(np.angle(np.exp(1j * (at - _direction(robot.tendons[t]) - np.pi))))
                if turned.min() > _STRAIGHT:
                    found.add(t)
    return found


def _with_antagonists(robot: Robot) -> tuple[Robot, Floats]:
    """The robot with an antagonist for each tendon that lacks one, and (n_tendons, n_given) its commands from
    those given. What `[fit]` says of a tendon by its number it says of the tendon's new number."""
    lacks, numbers = _unopposed(robot), dict[int, int]()
    segments, rows = list[Segment](), list[Floats]()
    for segment, tendons in zip(robot.segments, _places(robot), strict=True):
        own = []
        for t in tendons:
            tendon, numbers[t] = robot.tendons[t], len(rows)
            own.append(tendon)
            rows.append(np.eye(robot.n_tendons)[t])
            if t in lacks:
                own.append(replace(tendon, angle=_turned(tendon.angle)))
                rows.append(-rows[-1])
        segments.append(replace(segment, tendons=tuple(own)))

    def renamed(target: str) -> str:
        return re.sub(r"(?<=tendon\.)\d+", lambda m: str(numbers[int(m[0]) - 1] + 1), target)

    fit = {renamed(target): prior for target, prior in robot.fit.items()}
    return replace(robot, segments=tuple(segments), fit=fit), np.array(rows)


def _turned(angle: float | tuple[float, ...]) -> float | tuple[float, ...]:
    if isinstance(angle, tuple):
        return tuple(math.remainder(a + math.pi, 2.0 * math.pi) for a in angle)
    return math.remainder(angle + math.pi, 2.0 * math.pi)


def _scales(robot: Robot) -> tuple[float, float, float]:
    """Offset [m], bending stiffness [N m^2] and length [m] of a segment with tendons, on the average."""
    ends = np.asarray(robot.tendon_segment, dtype=int)
    offset = float(route(robot).tendon_offset.mean())
    stiffness = float(np.mean([np.mean(robot.segments[k].bending_stiffness) for k in ends]))
    return offset, stiffness, float(np.mean([robot.segments[k].length for k in ends]))


def _elastic(robot: Robot) -> Robot:
    """With tendons that stretch, all by one number where the file does not say how they do."""
    if any(re.fullmatch(r"tendon\..*\.compliance", target) for target in robot.fit):
        return robot
    offset, stiffness, length = _scales(robot)
    compliance = _ELASTIC * offset**2 * length / stiffness
    fit = {"tendon.*.compliance": {"sd": _WIDE * compliance, "shared": True}}
    return _with_tendons(replace(robot, fit=dict(robot.fit) | fit), compliance=compliance)


def _pulling(robot: Robot, span: float, *, paired: bool) -> Robot:
    """With tendons that can only pull. Its zero and its pretension are one number of a tendon that stretches:
    where each has a drive of its own the pretension is fitted, and no zero; of those that are `paired` on a
    drive one pretension, and the drives' zeros."""
    offset, stiffness, length = _scales(robot)
    tension = stiffness * span / (offset**2 * length)  # of the largest bend that is commanded
    shared = {"sd": _WIDE * _PRETENSION * tension, "shared": True}
    fit = dict(robot.fit) | {"tendon.*.pretension": shared if paired else {"sd": _PRETENSION_SD * tension}}
    if not paired:
        fit = {target: prior for target, prior in fit.items() if not target.endswith(".zero")}
    pulled = _with_tendons(robot, unilateral=True, pretension=_PRETENSION * tension)
    return _elastic(_stiff_apart(replace(pulled, fit=fit)))


def _stiff_apart(robot: Robot) -> Robot:
    """With a bending stiffness of each segment, where there are several: the tensions of tendons that pass
    one segment bend the other by it."""
    if robot.n_segments < 2 or any(
        re.fullmatch(r"segment\.\d+\.bending_stiffness", target) for target in robot.fit
    ):
        return robot
    mean = float(np.mean([np.mean(s.bending_stiffness) for s in robot.segments]))
    fit = {"segment.*.bending_stiffness": {"sd": STIFFNESS_SD * mean}}
    return replace(robot, fit=dict(robot.fit) | fit)


def _shortening(robot: Robot) -> Robot:
    """With a body that gives way along its axis."""
    offset, _, _ = _scales(robot)
    segments = tuple(
        replace(s, axial_stiffness=_AXIAL * float(np.mean(s.bending_stiffness)) / offset**2)
        for s in robot.segments
    )
    mean = float(np.mean([s.axial_stiffness for s in segments]))
    fit = dict(robot.fit) | {"segment.*.axial_stiffness": {"sd": _WIDE * mean}}
    return replace(robot, segments=segments, fit=fit)


def _with_tendons(robot: Robot, **new: Any) -> Robot:
    segments = tuple(replace(s, tendons=tuple(replace(t, **new) for t in s.tendons)) for s in robot.segments)
    return replace(robot, segments=segments)
