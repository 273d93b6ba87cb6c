"""Which column of a log moves which tendon: matched by how the tip answers to each.

The tip's answer to small changes of the lengths is linear, so a least-squares fit of the measured tip has a
column for each column of the log, and the model one for each tendon. The order that lays one on the other is
an assignment problem (Kuhn 1955).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from fastrod.identification.log.samples import LogSamples
from fastrod.model.robot import Robot
from fastrod.model.routing import route
from fastrod.types import Floats, Ints

_BEND = 0.2  # rad, by which the model is bent for its answers
_STARTS, _ROUNDS = 300, 5  # of the rotations of segments, drawn; of matching from each
_ALIKE, _EQUAL = 1.05, 1e-3  # times what the best signs leave, and beyond
_SEEN = 1e-3  # of the largest singular value: directions of the commands that are as small say nothing


@dataclass(frozen=True, kw_only=True, eq=False)
class ColumnOrder:
    """Columns of a log matched to the tendons of a robot."""

    order: Ints
    """(n_tendons,) number of the column that moves each tendon, from 0 on."""
    sign: Floats
    """(n_tendons,) -1 where that column has positive = pulled."""
    answer: Floats
    """(n_tendons, 3) how far the tip goes for each column of the log, per length pulled, base frame."""
    rotation: Floats
    """(n_segments,) by which the tendons of each segment are rotated about the axis against the robot file,
    to match [rad]."""
    left: float
    """Mismatch that remains, relative to the answers' size."""

    def of(self, dl: Floats) -> Floats:
        """(n, n_tendons) columns of a log in the order and with the signs of the tendons."""
        return dl[:, self.order] * self.sign


def column_order(samples: LogSamples, robot: Robot, sign: float = 0.0) -> ColumnOrder | None:
    """The columns of a log matched to the tendons, which stand where the robot file says; None where the log
    moves them in too few ways. With a `sign` of all columns, 1 or -1, the tendons of each segment may be
    rotated together about its axis: of a robot whose segments stand at unknown angles, seen by a camera that
    does."""
    log, rows = samples.log, samples.rows
    dl, tip = log.pulls[rows], np.asarray(log.tip_position)[rows]
    if dl.shape[1] != robot.n_tendons or robot.n_tendons < 2 or len(rows) < 3 * robot.n_tendons:
        return None
    measured, model = -_answer(dl, tip), -_answers(robot)
    if np.linalg.matrix_rank(dl - dl.mean(axis=0), rtol=_SEEN) < np.linalg.matrix_rank(model, rtol=_SEEN):
        return None
    segment = np.asarray(robot.tendon_segment)
    if not sign:
        still = np.zeros(robot.n_segments)
        free = _matched(measured, model, segment, still, free=True)
        each = [(one, _matched(one * measured, model, segment, still)) for one in (1.0, -1.0)]
        # two tendons across from each other answer alike with opposite signs: drives of both signs are rare
        alike = [
            replace(m, sign=one * m.sign, answer=measured)
            for one, m in each
            if m.left < _ALIKE * free.left + _EQUAL
        ]
        moved = [np.count_nonzero(m.order != np.arange(len(m.order))) - m.sign[0] for m in alike]
        return alike[int(np.argmin(moved))] if alike else free
    starts = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, (_STARTS, robot.n_segments))
    found = [_matched(sign * measured, model, segment, start, fit=True) for start in starts]
    best = min(found, key=lambda each: each.left)
    return replace(best, sign=sign * best.sign, answer=measured)


def _answer(dl: Floats, tip: Floats) -> Floats:
    """(n_tendons, 3) slopes of the tip by the columns, least squares; along what never changes they are 0.
    Rows far from rest, where the answer is not linear, count less."""
    moved, gone = dl - np.median(dl, axis=0), tip - np.median(tip, axis=0)
    size = np.linalg.norm(moved, axis=1)
    weight = 1.0 / (
        1.0 + (size / max(float(np.median(size[size > 0.0], axis=0)) if size.any() else 1.0, 1e-12))
    )
    A = np.column_stack([moved, np.ones(len(dl)) * float(np.abs(moved).max())]) * weight[:, None]
    slopes: Floats = np.linalg.lstsq(A, gone * weight[:, None], rcond=_SEEN)[0]
    return slopes[:-1]


def _answers(robot: Robot) -> Floats:
    """(n_tendons, 3) of the model at rest, by differences."""
    from fastrod.simulator import Simulator

    n = robot.n_tendons
    wiring = route(robot)
    step = _BEND / float(np.abs(wiring.bend_from_tendons).max())
    sim = Simulator(replace(robot, effects=()), n_robots=2 * n, points_per_segment=6)
    pulls = step * np.concatenate([np.eye(n), -np.eye(n)])
    state = (
        sim.settle(tension=-pulls)
        if wiring.by_tension
        else sim.settle(tendon_length=robot.rest_tendon_length + pulls)
    )
    tip = np.nan_to_num(state.tip_position)
    return np.asarray((tip[:n] - tip[n:]) / (2.0 * step))


def _matched(
    measured: Floats, model: Floats, segment: Ints, rotation: Floats, *, fit: bool = False, free: bool = False
) -> ColumnOrder:
    """The order that matches best near a `rotation` of each segment (n_segments,) [rad]; with `fit` that is
    fitted too, with `free` each column may have its own sign."""
    tendon = np.arange(len(model))
    for _ in range(_ROUNDS if fit else 1):
        c, s = np.cos(rotation[segment]), np.sin(rotation[segment])
        seen = np.stack(
            [c * model[:, 0] - s * model[:, 1], s * model[:, 0] + c * model[:, 1], model[:, 2]], 1
        )
        same, reverse = (((sign * measured[:, None] - seen) ** 2).sum(2) for sign in (1.0, -1.0))
        apart = np.minimum(same, reverse) if free else same
        order = linear_sum_assignment(apart.T)[1]
        if fit:
            flat = measured[order, :2]
            across = seen[:, 0] * flat[:, 1] - seen[:, 1] * flat[:, 0]
            along = (seen[:, :2] * flat).sum(1)
            size = len(rotation)
            rotation = rotation + np.arctan2(
                np.bincount(segment, across, size), np.bincount(segment, along, size)
            )
    sign = np.where(apart[order, tendon] == same[order, tendon], 1.0, -1.0)
    left = float(apart[order, tendon].sum() / (measured**2).sum())
    return ColumnOrder(order=order, sign=sign, answer=measured, rotation=rotation, left=left**0.5)
