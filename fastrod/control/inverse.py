"""Inverse by iterative learning: the tendon lengths with which the tip, as measured through all effects of a
robot, follows a path."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.checks import COUNT, Bound, check_number, checked_array
from fastrod.effects.base import Seam, get_effect
from fastrod.effects.pipeline import named_effects
from fastrod.errors import InputError
from fastrod.model.robot import Robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.rotation import matrix_from_quaternion
from fastrod.simulator import Simulator
from fastrod.types import Flags, Floats

_NODES = 8  # integration steps of a segment: the tip to a micrometre
# rad of bend from one sample to the next: beyond it, one pass leaves more than some nanometres, and the rod
# settles
_STEP = 0.05
_SETTLED, _EXACT = 1e-8, 1e-10  # m, boundary residual of a rollout and of nearest points
# steps toward the nearest points; each leaves about the distance from the path over the radius of the surface
_NEWTON = 60
_LARGEST = 0.4  # rad of bend in one of them
_DIFFERENCE = 5e-3  # rad of bend, of the slopes: settling leaves 1e-5 of them, the difference as much
_MOST = np.pi  # rad of bend, where no limit is given
_SMOOTHEST = 8  # averages over neighbours; a correction that makes it worse is made again with twice as many


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class InversePlan:
    """Commands of a robot, sample after sample, and the predicted motion. The first `n_approach` rows lead to
    the path."""

    robot: Robot
    """Name of the robot that the plan is for."""
    t: Floats
    """(n,) when to send each row, from 0 [s]."""
    dl: Floats
    """(n, n_tendons) change of each tendon's length against the straight rest robot [m], negative =
    pulled."""
    ext: Floats
    """(n, n_segments) change of each segment's length [m]."""
    target: Floats
    """(n, 3) the path, base frame [m]; nan in the approach."""
    predicted: Floats
    """(n, 3) the tip as it is measured at t + lead, base frame [m]."""
    nearest: Floats
    """(n, 3) points of the workspace that are nearest to the path, base frame [m]; nan in the approach."""
    lead: float
    """So much earlier than the path each row is sent: the robot's latency [s]."""
    n_approach: int
    """Rows before the path."""
    rms_predicted: float
    """Root mean square distance of the predicted tip from the path [m]."""
    rms_nearest: float
    """That of the nearest points of the workspace [m]: no plan is better."""
    rms_distance: float
    """That of the predicted tip from the nearest points of the workspace [m]."""
    rollouts: int
    """Simulations of the whole sequence that were spent."""

    def __len__(self) -> int:
        """Rows."""
        return len(self.t)


def plan(
    robot: Robot,
    target: ArrayLike,
    rate: float,
    *,
    start: ArrayLike | None = None,
    approach: float = 1.0,
    limit: float | None = None,
    rate_limit: float | None = None,
    gain: float = 1.0,
    rollouts: int = 15,
    tolerance: float = 1e-6,
) -> InversePlan:
    """Return the plan for a tip that is to be measured at `target` (n, 3), base frame [m], one row each 1 /
    `rate` [Hz].

    Effects of the robot's file are all in: sensing decides where the tip is measured, memory (backlash,
    friction, creep ...) how the tendons move it there; the robot begins at rest. A latency is compensated by
    sending earlier (`InversePlan.lead`). A robot with two coordinates reaches a surface only; the tip then
    goes to the points of it that are nearest to the path.

    `start` (n_tendons,) tendon lengths where the robot stands [m], None for straight; from there it takes
    `approach` seconds to the first row of the path, at rest at both ends; with 0 s it begins on the path.
    `limit` [m] is the largest displacement (`SegmentActions`), None for a bend of 180 degrees; extensions
    stay within each segment's range.
    Method: the whole sequence is simulated; then every displacement is
    corrected by `gain` times what, on the robot without effects of actuation, leads from the measured tip to
    the path, and so on, until no correction is above `tolerance` [m], for at most `rollouts` simulations. A
    correction that made it worse (one that rings) is taken back, and made smoother in time; the best is kept.
    What rings slowly (a lag of many samples) is corrected only partly. Source: iterative learning
    control (Arimoto, Kawamura and Miyazaki 1984), here on the model. Raises `InputError` on what is
    not such a path or number, where the robot's shape is not found, and where a tendon would move faster than
    `rate_limit` [m/s]; `RobotError` where the robot is not one for `SegmentActions`.
    """
    path = _path(target)
    for name, value, unit in (("rate", rate, "Hz"), ("gain", gain, ""), ("tolerance", tolerance, "m")):
        check_number(name, value, Bound(above=0.0, unit=unit))
    for name, optional in (("limit", limit), ("rate_limit", rate_limit)):
        if optional is not None:
            check_number(name, optional, Bound(above=0.0, unit="m" if name == "limit" else "m/s"))
    check_number("approach", approach, Bound(least=0.0, unit="s"))
    check_number("rollouts", rollouts, COUNT, whole=True)
    drive = _Drive(robot, limit)
    began = drive.coordinates(start)
    nearest, q, jacobian = _nearest(drive, path)
    n_approach = int(np.ceil(approach * rate))
    ease = _ease(n_approach)

    tables = named_effects(robot)
    lead = float(tables.get("latency", {}).get("delay", 0.0))
    at_once = _with_effects(robot, [name for name in tables if name != "latency"])
    simulator = Simulator(at_once, dt=1.0 / rate, points_per_segment=_NODES, outputs="tip", threads=1)
    inverse = _inverse(jacobian)
    best, spent, passes = np.inf, 0, 0
    kept = (began[None], q, path)  # whole sequence, wanted corrections, measured tip
    while spent < rollouts and passes <= _SMOOTHEST:
        whole = np.concatenate([began + ease[:, None] * (q[0] - began), q])
        seen = _rollout(simulator, drive, whole)
        spent += 1
        wanted = _held(drive, q, jacobian, inverse, path - seen[n_approach:])
        off = _rms((jacobian @ wanted[:, :, None])[:, :, 0])
        if off < best:
            best, kept = off, (whole, wanted, seen)
        else:
            passes = max(1, 2 * passes)
        whole, wanted, seen = kept
        if np.abs(wanted).max() <= tolerance:
            break
        q = np.clip(whole[n_approach:] + gain * _smoothed(wanted, passes), drive.low, drive.high)
    whole, _, seen = kept
    inputs = drive.inputs(whole)
    dl = inputs[:, : robot.n_tendons]
    if rate_limit is not None:
        _check_speed(dl, rate, rate_limit)
    lost = np.full((n_approach, 3), np.nan)
    return InversePlan(
        robot=robot,
        t=_frozen(np.arange(len(whole)) / rate),
        dl=_frozen(dl),
        ext=_frozen(inputs[:, robot.n_tendons :]),
        target=_frozen(np.concatenate([lost, path])),
        predicted=_frozen(seen),
        nearest=_frozen(np.concatenate([lost, nearest])),
        lead=lead,
        n_approach=n_approach,
        rms_predicted=_rms(seen[n_approach:] - path),
        rms_nearest=_rms(nearest - path),
        rms_distance=_rms(seen[n_approach:] - nearest),
        rollouts=spent,
    )


@final
class _Drive:
    """The coordinates of a robot that are free: two displacements of each segment that is driven, and the
    extension of those that extend."""

    def __init__(self, robot: Robot, limit: float | None) -> None:
        self.robot = robot
        actions = SegmentActions(robot)
        ranges: list[tuple[float, float]] = []
        bend: list[float] = []
        for segment, offset, bends in zip(
            robot.segments, actions.offset, actions.bends.reshape(-1, 3), strict=True
        ):
            most = _MOST * float(offset) if limit is None else float(limit)
            ranges += [segment.extension, *((-most * some, most * some) for some in bends[1:])]
            bend += [float(offset)] * 3
        self._limit = np.array(ranges)
        free = self._limit[:, 0] < self._limit[:, 1]
        self.low, self.high = self._limit[free].T
        self.unit: Floats = np.array(bend)[free]
        """(n_q,) displacement of one radian [m]."""
        self.matrix: Floats = actions.matrix[:, free]
        """(n_tendons + n_segments, n_q) d(tendon length, extension)/d(q)."""

    def inputs(self, q: Floats) -> Floats:
        """(n, n_tendons + n_segments) changes of tendon length and of segment length of coordinates (n, n_q)
        [m]."""
        return np.asarray(q @ self.matrix.T)

    def coordinates(self, start: ArrayLike | None) -> Floats:
        """(n_q,) of tendon lengths (n_tendons,). Raises `InputError` where they are of no displacement."""
        n = self.robot.n_tendons
        if start is None:
            return np.zeros(len(self.low))
        dl = checked_array("start", start, [(n,)], "one change of each tendon's length [m]")
        q: Floats = np.asarray(np.linalg.lstsq(self.matrix[:n], dl, rcond=None)[0], dtype=np.float64)
        left = np.abs(self.matrix[:n] @ q - dl).max()
        if left > 1e-5:
            raise InputError(
                f"start moves the tendons by {left:g} m that no bend gives; pull one tendon as far "
                "as its opposite gives."
            )
        if ((q < self.low - 1e-9) | (q > self.high + 1e-9)).any():
            raise InputError(
                f"start is a displacement of {np.abs(q).max():g} m; it must be within the limits."
            )
        return q


def _nearest(drive: _Drive, path: Floats) -> tuple[Floats, Floats, Floats]:
    """(n, 3) points of the workspace that are nearest to `path`, (n, n_q) coordinates there of the robot
    without effects of actuation, and (n, 3, n_q) slopes of the measured tip by them: Gauss-Newton steps,
    halved where they lead away."""
    tables = named_effects(drive.robot)
    plain = _with_effects(
        drive.robot, [name for name in tables if get_effect(name).seam is not Seam.ACTUATION]
    )
    simulator = Simulator(plain, n_robots=len(path), points_per_segment=_NODES, outputs="tip")

    def measured(q: Floats) -> Floats:
        return _at(simulator, drive, q)

    def slopes(q: Floats) -> Floats:
        found = np.empty((len(q), 3, q.shape[1]))
        for k in range(q.shape[1]):
            h = np.zeros(q.shape[1])
            h[k] = _DIFFERENCE * drive.unit[k]
            more, less = np.minimum(q + h, drive.high), np.maximum(q - h, drive.low)
            found[:, :, k] = (measured(more) - measured(less)) / (more - less)[:, k, None]
        return found

    q = np.clip(np.zeros((len(path), len(drive.low))), drive.low, drive.high)
    seen = measured(q)
    fraction = np.ones(len(path))
    jacobian = slopes(q)
    for _ in range(_NEWTON):
        step = _held(drive, q, jacobian, _inverse(jacobian), path - seen)
        longest = np.abs(step / drive.unit).max(axis=1)
        moved = np.clip(
            q + (fraction * np.minimum(1.0, _LARGEST / np.maximum(longest, _LARGEST)))[:, None] * step,
            drive.low,
            drive.high,
        )
        there = measured(moved)
        closer = _norm(path - there) <= _norm(path - seen) + 1e-12
        fraction = np.where(closer, np.minimum(1.0, 2.0 * fraction), 0.5 * fraction)
        q, seen = np.where(closer[:, None], moved, q), np.where(closer[:, None], there, seen)
        if longest.max() < 1e-7 or not (closer | (longest > 1e-6)).any():
            break
        jacobian = slopes(q)
    return measured(q), q, jacobian


def _inverse(jacobian: Floats) -> Floats:
    """(n, n_q, 3) pseudo-inverses of (n, 3, n_q)."""
    return np.asarray(np.linalg.pinv(jacobian), dtype=np.float64)


def _held(drive: _Drive, q: Floats, jacobian: Floats, inverse: Floats, error: Floats) -> Floats:
    """(n, n_q) least-squares steps toward an error (n, 3) of the tip; coordinates at a limit that would leave
    it stay."""
    step = (inverse @ error[:, :, None])[:, :, 0]
    stays = _leaves(drive, q, step)
    rows = stays.any(axis=1)
    if rows.any():
        left = np.where(stays[rows][:, None, :], 0.0, jacobian[rows])
        step[rows] = (_inverse(left) @ error[rows][:, :, None])[:, :, 0]
    return np.asarray(np.clip(q + step, drive.low, drive.high) - q) if rows.any() else np.asarray(step)


def _leaves(drive: _Drive, q: Floats, step: Floats) -> Flags:
    return np.asarray(((q >= drive.high) & (step > 0.0)) | ((q <= drive.low) & (step < 0.0)))


def _smoothed(a: Floats, passes: int) -> Floats:
    """(n, m) averaged over neighbours as (1, 2, 1) / 4, so many times."""
    for _ in range(passes):
        padded = np.concatenate([a[:1], a, a[-1:]])
        a = 0.25 * (padded[:-2] + 2.0 * padded[1:-1] + padded[2:])
    return a


def _rollout(simulator: Simulator, drive: _Drive, q: Floats) -> Floats:
    """(n, 3) measured tip along a sequence of coordinates (n, n_q), from rest; base frame [m]."""
    simulator.reset()
    far = np.abs(np.diff(q, axis=0, prepend=np.inf) / drive.unit).max(axis=1) > _STEP
    sensed = any(get_effect(name).seam is Seam.SENSING for name in named_effects(drive.robot))
    seen = np.empty((len(q), 3))
    for k, row in enumerate(drive.inputs(q)):
        _move(simulator, drive, row, _SETTLED if far[k] else None)
        seen[k] = simulator.measure().tip_position[0] if sensed else simulator.state.tip_position[0]
    if sensed:
        return seen
    rotation = matrix_from_quaternion(np.array([drive.robot.base_quaternion]))[0]
    return np.asarray((seen - drive.robot.base_position) @ rotation)


def _at(simulator: Simulator, drive: _Drive, q: Floats) -> Floats:
    """(n_robots, 3) measured tip at rest at coordinates (n_robots, n_q); base frame [m]."""
    _move(simulator, drive, drive.inputs(q), _EXACT)
    return simulator.measure().tip_position


def _move(simulator: Simulator, drive: _Drive, inputs: Floats, tolerance: float | None) -> None:
    """A step, or settling to a tolerance [m]. Raises `InputError` where the shape is not found."""
    n = drive.robot.n_tendons
    length, extension = drive.robot.rest_tendon_length + inputs[..., :n], inputs[..., n:]
    if tolerance is None:
        state = simulator.step(length, extension=extension)
    else:
        state = simulator.settle(length, extension=extension, tolerance=tolerance)
    if not state.ok.all():
        problem = state.problems[int(np.argmin(state.ok))]
        raise InputError(f"the path leads robot {drive.robot.name!r} where its shape is not found: {problem}")


def _with_effects(robot: Robot, kept: list[str]) -> Robot:
    tables = named_effects(robot)
    return replace(robot, effects=tuple({"name": name, **tables[name]} for name in kept))


def _ease(n: int) -> Floats:
    """(n,) from 0 toward 1, at rest at both ends."""
    s = np.arange(n) / max(n, 1)
    return np.asarray(s**3 * (10.0 + s * (6.0 * s - 15.0)))


def _path(target: ArrayLike) -> Floats:
    try:
        path = np.array(target, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(
            "target is not an array of numbers; give (n, 3) positions, base frame [m]."
        ) from error
    if path.ndim != 2 or path.shape[1] != 3 or len(path) < 2:
        raise InputError(
            f"target has shape {path.shape}; it must be (n, 3), two or more positions in the base frame [m]."
        )
    if not np.isfinite(path).all():
        raise InputError("target holds a position that is not finite; give all of the path.")
    return path


def _check_speed(dl: Floats, rate: float, rate_limit: float) -> None:
    speed = np.abs(np.diff(dl, axis=0)) * rate
    if speed.max() > rate_limit:
        k, tendon = np.unravel_index(int(np.argmax(speed)), speed.shape)
        raise InputError(
            f"tendon {tendon + 1} would move at {speed.max():.3g} m/s at {k / rate:.3g} s, beyond rate_limit "
            f"{rate_limit:g} m/s; "
            "give a slower path, or a longer approach."
        )


def _norm(vectors: Floats) -> Floats:
    return np.asarray(np.linalg.norm(vectors, axis=1))


def _rms(vectors: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def _frozen(a: Floats) -> Floats:
    a = np.ascontiguousarray(a)
    a.setflags(write=False)
    return a
