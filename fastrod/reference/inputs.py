"""Make a `RodProblem` of a robot and its inputs, with a sentence for everything that cannot be one."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fastrod.checks import checked_array
from fastrod.errors import InputError
from fastrod.model.robot import Robot
from fastrod.reference.rod import Array, RodProblem, Span

PointForce: TypeAlias = Sequence[tuple[float, ArrayLike]]
"""Pairs of arclength along the backbone as it is [m] and force (3,), world [N]."""

_LONGEST = 10.0  # m; a longer tendon was given in mm


def make_problem(
    robot: Robot,
    tendon_length: ArrayLike | None,
    tension: ArrayLike | None,
    extension: ArrayLike | None,
    tip_force: ArrayLike | None,
    tip_moment: ArrayLike | None,
    line_force: ArrayLike | None,
    point_force: PointForce | None,
    follower_tip_force: ArrayLike | None,
) -> RodProblem:
    """Inputs of one robot, checked; shapes and units as in `shoot`. Raises `InputError`."""
    paper = robot.segments[0].mode == "paper"
    mode = np.array([robot.segments[k].mode for k in robot.tendon_segment], dtype=str)
    free = mode == "tendon_length"
    given = mode == "tendon_tension"
    length = _per_tendon("tendon_length", tendon_length, free | paper, "m")
    if np.any(length[free | paper] <= 0.0) or np.any(length > _LONGEST):
        raise InputError(
            f"tendon_length is {length.tolist()!r} m; lengths are absolute, base to end, "
            f"between 0 and {_LONGEST:g} m. In mm?"
        )
    pull = np.where(given, _per_tendon("tension", tension, given, "N"), 0.0)
    unilateral = np.array([tendon.unilateral for tendon in robot.tendons], dtype=bool)
    if np.any(pull[unilateral] < 0.0):
        raise InputError(
            f"tension is {pull.tolist()!r} N; a unilateral tendon cannot push, so it must not be negative."
        )
    segment_end = np.cumsum(segment_length(robot, extension))
    force = _vector("tip_force", tip_force, "N")
    return RodProblem(
        robot=robot,
        paper=paper,
        spans=_spans(
            robot,
            segment_end,
            _line_force(robot, line_force),
            _point_force(point_force or (), segment_end[-1]),
            force,
        ),
        segment_end=segment_end,
        tendon_length=length,
        tension=pull,
        free=free,
        tip_moment=_vector("tip_moment", tip_moment, "N m"),
        follower=_vector("follower_tip_force", follower_tip_force, "N"),
    )


def segment_length(robot: Robot, extension: ArrayLike | None) -> Array:
    """(n_segments,) backbone length with extension [m]."""
    rest = np.array([segment.length for segment in robot.segments])
    if extension is None:
        return rest
    change = checked_array("extension", extension, [rest.shape], "one change of length a segment [m]")
    for k, (segment, value) in enumerate(zip(robot.segments, change, strict=True), 1):
        low, high = segment.extension
        if not low <= value <= high:
            raise InputError(
                f"extension of segment {k} is {value:.6g} m; its range is {low:g} to {high:g} m."
            )
    return np.asarray(rest + change)


def tendon_offset(robot: Robot, segment: int) -> tuple[NDArray[np.int64], Array]:
    """Return the tendons that cross a segment (n_crossing,), and their positions (n_crossing, 3) d_i,
    material frame [m]."""
    ends = robot.tendon_segment
    crossing = np.flatnonzero(ends >= segment)
    offset = [(*robot.tendons[i].position(int(ends[i]) + 1)[segment], 0.0) for i in crossing]
    return crossing, np.array(offset, dtype=np.float64).reshape(-1, 3)


def _spans(
    robot: Robot, segment_end: Array, line: list[Array], points: list[tuple[float, Array]], tip_force: Array
) -> tuple[Span, ...]:
    """Base first; cut wherever a load jumps or bends, so that an integrator never has to find the place."""
    near = 1e-12 * segment_end[-1]
    spans: list[Span] = []
    force = tip_force
    # from the tip, because a cut carries what lies beyond it
    for k in reversed(range(robot.n_segments)):
        segment = robot.segments[k]
        low, high = (0.0 if k == 0 else segment_end[k - 1]), segment_end[k]
        knot = np.linspace(low, high, len(line[k]))
        cut = [
            low,
            *sorted(s for s in {*knot, *(s for s, _ in points)} if low + near < s < high - near),
            high,
        ]
        tendon, offset = tendon_offset(robot, k)
        for start, end in reversed(list(pairwise(cut))):
            f = np.array([[np.interp(s, knot, line[k][:, axis]) for axis in range(3)] for s in (start, end)])
            force = force + sum((point for s, point in points if abs(s - end) <= near), np.zeros(3))
            spans.append(
                Span(
                    segment=k,
                    start=float(start),
                    end=float(end),
                    stiffness=np.array([*segment.bending_stiffness, segment.torsional_stiffness]),
                    precurvature=np.array(segment.precurvature),
                    tendon=tendon,
                    offset=offset,
                    line_force=f,
                    force=force,
                )
            )
            force = force + 0.5 * (end - start) * (f[0] + f[1])
    return tuple(reversed(spans))


def _line_force(robot: Robot, value: ArrayLike | None) -> list[Array]:
    """Per segment (points, 3) at evenly spaced points, self-weight included, world [N/m]."""
    n = robot.n_segments
    given = np.zeros(3) if value is None else _array("line_force", value)
    if given.shape == (3,):
        given = np.broadcast_to(given, (n, 2, 3))
    if given.ndim != 3 or given.shape[0] != n or given.shape[1] < 2 or given.shape[2] != 3:
        raise InputError(
            f"line_force has shape {given.shape}; it must be (3,) or ({n}, points, 3) with two "
            "points or more [N/m]."
        )
    return [
        given[k] + segment.line_density * np.array(robot.gravity) for k, segment in enumerate(robot.segments)
    ]


def _point_force(pairs: PointForce, length: float) -> list[tuple[float, Array]]:
    checked = []
    for pair in pairs:
        if len(pair) != 2 or np.ndim(pair[0]) != 0:
            raise InputError(
                f"point_force holds {pair!r}; each entry must be a pair of arclength [m] and force (3,) [N]."
            )
        s = float(pair[0])
        if not 0.0 <= s <= length * (1.0 + 1e-12):
            raise InputError(f"point_force stands at {s:.6g} m; the backbone runs from 0 to {length:.6g} m.")
        checked.append((s, _vector("the force of point_force", pair[1], "N")))
    return checked


def _array(name: str, value: ArrayLike, needed: NDArray[np.bool_] | None = None) -> Array:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is {value!r}; it must be numbers.") from error
    counts = array if needed is None or needed.shape != array.shape else array[needed]
    if not np.all(np.isfinite(counts)):
        raise InputError(f"{name} is {array.tolist()!r}; it must be finite.")
    return array


def _vector(name: str, value: ArrayLike | None, unit: str) -> Array:
    return np.zeros(3) if value is None else checked_array(name, value, [(3,)], f"a vector [{unit}]")


def _per_tendon(name: str, value: ArrayLike | None, needed: NDArray[np.bool_], unit: str) -> Array:
    """(n_tendons,); what is not needed may be anything, nan too."""
    if value is None:
        if needed.any():
            raise InputError(
                f"{name} is missing; the modes of this robot need it: ({len(needed)},) [{unit}]."
            )
        return np.zeros(len(needed))
    array = _array(name, value, needed)
    if array.shape != needed.shape:
        raise InputError(
            f"{name} has shape {array.shape}; it must be ({len(needed)},), one value a tendon [{unit}]."
        )
    return np.where(needed, array, 0.0)
