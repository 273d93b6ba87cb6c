"""Constant-curvature arcs: the shape that follows from tendon lengths alone, and the first guess of the
solvers."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from fastrod.checks import checked_array
from fastrod.model.robot import Robot
from fastrod.reference.inputs import segment_length, tendon_offset
from fastrod.reference.rod import (
    CURVATURE,
    E3,
    PATH,
    POSITION,
    ROTATION,
    Array,
    ReferenceShape,
    RodProblem,
    Span,
    base_state,
    curvature_of_moment,
    hat,
    internal_force,
    rotation_of,
    shape_of,
    span_moment,
)

_ROUNDS = 20  # of the guess, at most


def constant_curvature(
    robot: Robot,
    tendon_length: ArrayLike,
    extension: ArrayLike | None = None,
    *,
    points_per_segment: int = 20,
) -> ReferenceShape:
    """Return the shape of a chain of constant-curvature arcs from the tendon lengths alone: no stiffness, no
    loads.

    Per segment the least-squares (u_x, u_y) with u_z = 0, after a distal tendon's path through the segments
    before it, at its own offsets there, is taken off its length. A segment without tendons keeps its
    precurvature. Without loads, with lengths that fit together and tendons that do not stretch this is the
    rod's own shape, whatever its stiffness.

    `tendon_length` (n_tendons,) [m], absolute, base to where the tendon ends; `extension` (n_segments,) [m].
    `residual` is the largest length that the arcs miss [m]; `tension` is nan. Source: Kasaei et al., CoRL
    2024, eq. 2b (curvature of the segment base from the tendon lengths), one arc a segment. Raises
    `InputError` on wrong shapes and ranges.
    """
    length = checked_array("tendon_length", tendon_length, [(robot.n_tendons,)], "one length a tendon [m]")
    backbone = segment_length(robot, extension)
    u = curvature_of_length(
        robot, backbone, length, np.array([segment.precurvature for segment in robot.segments])
    )
    fraction = np.arange(1, points_per_segment + 1) / points_per_segment
    states = arc_states(robot, backbone, u, fraction)
    s = np.concatenate(
        [
            [0.0],
            *(end - step * (1.0 - fraction) for end, step in zip(np.cumsum(backbone), backbone, strict=True)),
        ]
    )
    missed = float(np.abs(states[-1, PATH] - length).max(initial=0.0))
    return shape_of(
        s,
        states,
        tension=np.full(robot.n_tendons, np.nan),
        residual=missed,
        evaluations=1,
        success=True,
        message="constant-curvature arcs",
    )


def curvature_of_length(robot: Robot, backbone: Array, tendon_length: Array, unheld: Array) -> Array:
    """(n_segments, 3) least-squares arc curvature; `unheld` (n_segments, 3) where a segment's own lengths are
    not known.

    A length is known where `tendon_length` is positive.
    """
    u = unheld.copy()
    used = np.zeros(robot.n_tendons)
    for k, step in enumerate(backbone):
        crossing, offset = tendon_offset(robot, k)
        own = (robot.tendon_segment[crossing] == k) & (tendon_length[crossing] > 0.0)
        if own.any():
            # with u_z = 0 the path grows by 1 + u_x d_y - u_y d_x: linear, so one lstsq is the answer
            rows = np.stack([offset[own, 1], -offset[own, 0]], axis=1)
            stretch = (tendon_length - used)[crossing[own]] / step - 1.0
            u[k] = [*np.linalg.lstsq(rows, stretch, rcond=1e-9)[0], 0.0]
        used[crossing] += step * _growth(offset, u[k])
    return u


def arc_states(robot: Robot, backbone: Array, u: Array, fraction: Array) -> Array:
    """(1 + n_segments * n_fractions, 15 + n_tendons) along the arcs, at these fractions of each segment."""
    states = [base_state(robot)]
    states[0][CURVATURE] = u[0]
    for k, step in enumerate(backbone):
        crossing, offset = tendon_offset(robot, k)
        start = states[-1]
        rotation = start[ROTATION].reshape(3, 3)
        for s in step * fraction:
            state = start.copy()
            state[POSITION] += rotation @ _chord(u[k], s)
            state[ROTATION] = (rotation @ rotation_of(s * u[k])).ravel()
            state[CURVATURE] = u[k]
            state[PATH][crossing] += s * _growth(offset, u[k])
            states.append(state)
    return np.array(states)


def first_guess(problem: RodProblem) -> tuple[Array, Array, Array, Array]:
    """Return the first guess of the solvers: arc curvature (n_segments, 3), tension (n_tendons,), base moment
    (3,), follower force (3,).

    The cantilever is statically determinate: on the arc that the lengths prescribe, the loads give every
    moment, and the least-norm tensions follow. A guess of zero instead diverges.
    """
    robot = problem.robot
    backbone = np.diff(problem.segment_end, prepend=0.0)
    first = [next(span for span in problem.spans if span.segment == k) for k in range(robot.n_segments)]
    u = np.array([segment.precurvature for segment in robot.segments])
    tension = problem.tension.copy()
    for _ in range(_ROUNDS):
        before = u
        u = curvature_of_length(robot, backbone, problem.tendon_length, before)
        moment, base_moment, follower = _load_moment(problem, backbone, u)
        for k in reversed(range(robot.n_segments)):
            own = (robot.tendon_segment == k) & problem.free
            tension[own] = 0.0
            if own.any():
                unit = np.eye(robot.n_tendons)[own]
                still = span_moment(first[k], np.zeros(robot.n_tendons), u[k])
                columns = np.array([span_moment(first[k], one, u[k]) - still for one in unit]).T
                rest = moment[k] - span_moment(first[k], tension, u[k])
                tension[own] = np.linalg.lstsq(columns, rest, rcond=1e-9)[0]
            elif not problem.paper:
                # a full step would swing from side to side, the further the larger the load's bend of the
                # whole robot
                bend = problem.length * float(np.linalg.norm(base_moment)) / problem.bending_stiffness
                u[k] += (curvature_of_moment(first[k], tension, moment[k], u[k]) - u[k]) / (1.0 + 0.5 * bend)
        if np.abs(u - before).max() * problem.length < 0.01:
            break
    return u, tension, base_moment, follower


def _load_moment(problem: RodProblem, backbone: Array, u: Array) -> tuple[Array, Array, Array]:
    """Moment of the loads on the arcs, material frame: mid-segment (n_segments, 3), base (3,); follower force
    (3,), world."""
    n = 10
    states = arc_states(problem.robot, backbone, u, np.arange(1, 2 * n + 1) / (2 * n))
    rotation = states[:, ROTATION].reshape(-1, 3, 3)
    follower = rotation[-1] @ problem.follower
    s = np.concatenate([[0.0], *(a + (b - a) * np.arange(1, 2 * n + 1) / (2 * n) for a, b in _ends(problem))])
    force = np.array([internal_force(_span_at(problem, x), np.array([x]), follower)[0] for x in s])
    turning = np.einsum("pij,pj->pi", hat(rotation[:, :, 2]), force)
    pieces = 0.5 * np.diff(s)[:, None] * (turning[1:] + turning[:-1])
    world = problem.tip_moment + np.concatenate([np.cumsum(pieces[::-1], axis=0)[::-1], np.zeros((1, 3))])
    material = np.einsum("pji,pj->pi", rotation, world)
    return material[n :: 2 * n], material[0], follower


def _ends(problem: RodProblem) -> list[tuple[float, float]]:
    ends = [0.0, *problem.segment_end.tolist()]
    return list(pairwise(ends))


def _span_at(problem: RodProblem, s: float) -> Span:
    return next((span for span in problem.spans if s <= span.end), problem.spans[-1])


def _growth(offset: Array, u: Array) -> Array:
    """(n_crossing,) path of each tendon per length of backbone, |e3 + u x d_i|."""
    return np.asarray(np.linalg.norm(E3 + np.cross(u, offset), axis=1))


def _chord(u: Array, s: float) -> Array:
    """(3,) end of an arc of length s from the origin along e3: integral of exp(s [u]x) e3."""
    theta = s * float(np.linalg.norm(u))
    k = hat(s * u)
    cubic = (theta - np.sin(theta)) / theta**3 if theta > 1e-4 else 1.0 / 6.0 - theta**2 / 120.0
    half = 0.5 * np.sinc(theta / (2.0 * np.pi)) ** 2
    return np.asarray(s * (E3 + half * (k @ E3) + cubic * (k @ (k @ E3))))
