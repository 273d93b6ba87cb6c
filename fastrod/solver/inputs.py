"""Inputs of a caller, checked and broadcast into `Ports`: shapes are refused at once, bad values row by
row."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, ParamSpec, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from fastrod.checks import checked_array
from fastrod.errors import InputError, Problem, ProblemSentence, nearest, refuse_masked, shown
from fastrod.kernels.batch import place_all
from fastrod.model.compile import DefaultInputs
from fastrod.threads import FEW, one_blas_thread
from fastrod.types import Flags, Floats, Layout, Params, Ports

_P = ParamSpec("_P")
_R = TypeVar("_R")
PointForces: TypeAlias = Sequence[tuple[ArrayLike, ArrayLike]]


_ELSEWHERE = {
    "dt": "the time step is given once: Simulator(robot, dt=...).",
    **dict.fromkeys(("rho", "modes"), "it is one of the solver: solver=fastrod.Modal(...)."),
    **dict.fromkeys(
        ("observer", "kept_jacobian_tolerance", "process_noise", "measurement_noise"),
        "it is one of the solver: solver=fastrod.Observer(...).",
    ),
}
"""Inputs that belong elsewhere, and where."""
_MOST = 1e12  # of any unit; products of a few such numbers still are floats


def named_inputs(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """The same method, with one thread of BLAS where there are so many robots that it would start more; a
    keyword that it lacks raises `InputError` with the nearest name."""
    parameters, of_many = inspect.signature(function).parameters, one_blas_thread(function)
    known = {name for name in parameters if name != "self"}
    positional = sum(p.kind is p.POSITIONAL_OR_KEYWORD for p in parameters.values()) - 1

    @functools.wraps(function)
    def checked(*args: _P.args, **inputs: _P.kwargs) -> _R:
        called = function.__name__ if function.__name__ != "__init__" else type(args[0]).__name__
        for name in inputs:
            if name not in known:
                why = _ELSEWHERE.get(name) or nearest(name, known)
                raise InputError(f"{called} has no input {name!r}; {why}")
        if len(args) - 1 > positional:
            raise InputError(
                f"{called} takes {positional} of its inputs without a name and was given {len(args) - 1}; "
                f"name the others, as in {list(parameters)[-1]}=..."
            )
        return (of_many if getattr(args[0], "n_robots", 0) > FEW else function)(*args, **inputs)

    return checked


def robot_mask(rows: ArrayLike, n_robots: int) -> Flags:
    """(n_robots,) of indices or a mask. Raises `InputError`."""
    mask = np.zeros(n_robots, bool)
    refuse_masked("rows", rows)
    try:
        which = np.asarray(rows)
        if which.ndim > 1 or (which.dtype.kind == "b" and which.shape != mask.shape):
            raise IndexError
        if which.size:
            mask[which] = True
    except (IndexError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"rows is {shown(rows)}; give indices of robots from 0 to {n_robots - 1}, or a mask."
        ) from error
    return mask


def arclengths(arclength: ArrayLike, n_robots: int) -> Floats:
    """(n_robots, n_queries) [m] of (n_queries,) for all or (n_robots, n_queries). Raises `InputError`."""
    refuse_masked("arclength", arclength)
    try:
        s = np.asarray(arclength, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"arclength is {shown(arclength)}; give numbers [m], (n_queries,) or (n_robots, n_queries)."
        ) from error
    s = np.atleast_2d(s)
    if s.ndim != 2 or len(s) not in (1, n_robots):
        raise InputError(
            f"arclength has shape {np.shape(arclength)}; it must be (n_queries,) or "
            f"({n_robots}, n_queries) [m]."
        )
    return np.broadcast_to(s, (n_robots, s.shape[1]))


def checked_mobility(name: str, given: ArrayLike, shapes: Sequence[tuple[int, ...]], says: str) -> Floats:
    """Mobility of a body, of one of these shapes (..., 6, 6): its motion, which `says` what that is, by a
    force and a moment at a point. Raises `InputError` for what is none."""
    found = checked_array(name, given, shapes, says)
    size, even = np.abs(found).max(), 0.5 * (found + np.swapaxes(found, -1, -2))
    if np.abs(found - even).max() > 1e-6 * size or np.linalg.eigvalsh(even).min() < -1e-6 * size:
        raise InputError(
            f"{name} is not symmetric with eigenvalues of 0 or more; for a free body of mass m and inertia J "
            "about its centre, which is that point, it is a multiple of diag(1/m, 1/m, 1/m, inv(J))."
        )
    return even


def free_body(
    obstacle: str, mobility: ArrayLike, center: ArrayLike, ahead: ArrayLike
) -> tuple[Floats, Floats, Floats]:
    """Mobility (6, 6) of an obstacle's body, its centre (3,), and how far it is ahead (6,), as
    `Simulator.set_free`. Raises `InputError`."""
    says, name = "displacement and rotation within a step by force and moment, world", f"of {obstacle!r}"
    return (
        checked_mobility(f"mobility {name}", mobility, [(6, 6)], says),
        checked_array(f"center {name}", center, [(3,)], "its place, world [m]"),
        checked_array(f"ahead {name}", ahead, [(6,)], "displacement [m] and rotation [rad], world"),
    )


class Inputs(NamedTuple):
    """Inputs that a caller may give at one step; shapes, units and frames as in `Simulator.step`."""

    tendon_length: ArrayLike | None = None
    tension: ArrayLike | None = None
    extension: ArrayLike | None = None
    tip_force: ArrayLike | None = None
    tip_moment: ArrayLike | None = None
    line_force: ArrayLike | None = None
    point_force: PointForces | None = None
    follower_tip_force: ArrayLike | None = None
    follower_line_force: ArrayLike | None = None
    base_pose: ArrayLike | None = None
    gravity: ArrayLike | None = None


class Reader:
    """Turns inputs into arrays with a robot axis of 1 or n_robots, and collects what is wrong with which
    robot."""

    def __init__(self, layout: Layout, params: Params, rest: DefaultInputs, n_robots: int) -> None:
        self.layout, self.params, self.rest, self.n_robots = layout, params, rest, n_robots
        # A tendon at distance d can differ from the backbone by d times the bend; more than a full turn per
        # segment is no shape.
        self._slack: Floats = 2.0 * np.pi * np.linalg.norm(params.offset, axis=-1).sum(1)
        self._ends: Floats = np.cumsum(params.length, axis=1)[:, layout.tendon_segment]  # not extended
        low, high = rest.extension_range[..., 0], rest.extension_range[..., 1]
        self._may_rest = bool(((low <= 1e-12) & (high >= -1e-12)).all())
        self.problems: dict[int, str] = {}
        self.loads: tuple[Floats, Floats] = (np.zeros((1, 0)), np.zeros((1, 0, 3)))
        """Point forces of the last ports: arclength (n, m) [m] and force (n, m, 3) world [N]."""
        self.gravity: Floats | None = None
        """(1 or n_robots, 3) of the last ports, world [m/s^2]; None is that of the robots."""
        self._weight = rest.weight

    def ports(self, given: Inputs) -> Ports:
        """The ports of one step; `problems` then names the robots whose inputs are not usable."""
        self.problems = {}
        layout, rest = self.layout, self.rest
        n_segments, n_tendons = len(layout.first_tendon), len(layout.tendon_segment)
        given_tension = np.ones(n_tendons, bool)
        given_tension[layout.row_tendon] = False  # those of tendon_tension segments remain
        stretch = self._optional("extension", given.extension, (n_segments,), "m")
        if given.extension is not None or not self._may_rest:
            self._check_extension(stretch)
        self.gravity, self._weight = None, rest.weight
        if given.gravity is not None:
            self.gravity = self._array("gravity", given.gravity, (3,), "m/s^2")
            self._weight = rest.line_density[:, :, None, None] * self.gravity[:, None, None, :]
        lengths = self._lengths(given.tendon_length, stretch)
        if given.tension is not None and not given_tension.any():
            raise InputError("tension was given, but no segment of this robot is in mode tendon_tension.")
        if given.follower_tip_force is not None and layout.paper:
            raise InputError(
                "follower_tip_force was given, but mode paper has dead loads only; give tip_force."
            )
        if given.tension is None and given_tension.any():
            raise InputError(
                "tension is missing; segments in mode tendon_tension need tension (n_robots, "
                f"{n_tendons}) [N]."
            )
        pull = self._optional("tension", given.tension, (n_tendons,), "N")
        grid, node_force = self.point_forces(given.point_force, stretch)
        return Ports(
            tendon_length=lengths,
            tension=np.where(given_tension, pull, 0.0),
            extension=stretch,
            stiffness=rest.stiffness,
            precurvature=rest.precurvature,
            tip_force=self._optional("tip_force", given.tip_force, (3,), "N"),
            tip_moment=self._optional("tip_moment", given.tip_moment, (3,), "N m"),
            follower_force=np.zeros((0, 3))
            if given.follower_tip_force is None
            else self._array("follower_tip_force", given.follower_tip_force, (3,), "N"),
            follower_line=np.zeros((0, n_segments, 1, 3))
            if given.follower_line_force is None
            else self._follower_line(given.follower_line_force, grid),
            line_force=self.line_force(given.line_force, grid),
            node_force=node_force,
            grid=grid,
            base_pose=rest.base_pose if given.base_pose is None else self._pose(given.base_pose),
        )

    def _array(self, name: str, value: ArrayLike, shape: tuple[int, ...], unit: str) -> Floats:
        """(1 or n_robots, *shape), finite but for rows that are noted as problems."""
        if type(value) is not np.ndarray:
            refuse_masked(name, value)
        try:
            a = np.asarray(value)
            if a.dtype.kind in "cmM":
                raise TypeError
            a = a.astype(np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(
                f"{name} is not an array of numbers; give (n_robots, {', '.join(map(str, shape))}) [{unit}]."
            ) from error
        if a.shape == shape:
            a = a[None]
        if a.shape[1:] != shape or a.shape[0] not in (1, self.n_robots):
            wanted = ", ".join(map(str, shape))
            raise InputError(
                f"{name} has shape {np.shape(value)}; it must be ({self.n_robots}, {wanted}) "
                f"or ({wanted},) [{unit}]."
            )
        # a copy: the caller may write into his own before the next step asks what has changed
        a = np.array(a, order="C")
        if not np.vdot(a, a) < _MOST**2:
            finite, small = (
                np.asarray(good.reshape(len(a), -1).all(1)) for good in (np.isfinite(a), np.abs(a) < _MOST)
            )
            self._note(
                ~finite, lambda i: f"{name} holds a value that is not finite: {_line(a[i].ravel()[:6])}."
            )
            self._note(
                ~small, lambda i: f"{name} holds a value beyond {_MOST:g} {unit}: {_line(a[i].ravel()[:6])}."
            )
            # these rows are left out; nan passes through without a warning, inf does not
            a[~(np.abs(a) < _MOST)] = np.nan
        return a

    def _optional(self, name: str, value: ArrayLike | None, shape: tuple[int, ...], unit: str) -> Floats:
        return np.zeros((1, *shape)) if value is None else self._array(name, value, shape, unit)

    def _note(self, bad: Any, sentence: Callable[[int], str]) -> None:
        """Note bad rows; where no row is good there is nothing to simulate, so say so at once."""
        rows = np.flatnonzero(bad)
        if not len(rows):
            return
        if len(rows) == len(bad):
            raise InputError(sentence(0))
        for i in rows:
            self.problems.setdefault(int(i), ProblemSentence(sentence(int(i)), Problem.BAD_INPUT))

    def _check_extension(self, stretch: Floats) -> None:
        low, high = self.rest.extension_range[..., 0], self.rest.extension_range[..., 1]
        bad = ((stretch < low - 1e-12) | (stretch > high + 1e-12)).any(1)
        if bad.any():

            def sentence(i: int) -> str:
                given, least, most = (_line(a[min(i, len(a) - 1)], 6) for a in (stretch, low, high))
                return f"extension {given} m lies outside the range of the segments, {least} to {most} m."

            self._note(bad, sentence)

    def _lengths(self, tendon_length: ArrayLike | None, stretch: Floats) -> Floats:
        layout, params = self.layout, self.params
        n_tendons = len(layout.tendon_segment)
        if tendon_length is None:
            if len(layout.row_tendon):
                raise InputError(
                    f"tendon_length is missing; give (n_robots, {n_tendons}) absolute lengths, base to "
                    "where each tendon ends [m]; "
                    "Robot.rest_tendon_length holds those of the straight robot."
                )
            return np.zeros((1, n_tendons))
        lengths = self._array("tendon_length", tendon_length, (n_tendons,), "m")
        ends = self._ends
        if stretch.any():
            ends = np.cumsum(params.length + stretch, axis=1)[:, layout.tendon_segment]
        slack, rows = self._slack, layout.row_tendon
        with np.errstate(invalid="ignore"):
            longer = lengths - ends
            if lengths.min(initial=np.inf) > 0.0 and (np.abs(longer) <= slack).all():
                return lengths
            # a tendon that can go slack may hang as loose as it likes
            long = (longer > slack) & ~params.unilateral
            bad = ((lengths <= 0.0) | (-longer > slack) | long | (lengths > 20.0 * ends))[:, rows].any(1)
        if bad.any():
            self._note(
                bad,
                lambda i: _length_sentence(
                    lengths[min(i, len(lengths) - 1)][rows], ends[min(i, len(ends) - 1)][rows]
                ),
            )
        return lengths

    def line_force(self, line_force: ArrayLike | None, grid: Floats) -> Floats:
        """`Ports.line_force`: self-weight plus what is given, uniform, or linear over each step with the true
        force and moment of that step. `grid` as in `Ports`."""
        weight = self._weight
        return weight if line_force is None else weight + self._line("line_force", line_force, grid)

    def _follower_line(self, value: ArrayLike, grid: Floats) -> Floats:
        line = self._line("follower_line_force", value, grid)
        shape = len(line), len(self.layout.first_tendon), *line.shape[2:]
        return np.array(np.broadcast_to(line, shape), order="C")  # a view would be read-only: another type

    def _line(self, name: str, value: ArrayLike, grid: Floats) -> Floats:
        """See `Ports` has it: (n, 1, 1, 3) of one force, (n, n_segments, 2 n_steps, 3) of samples."""
        n_segments, n_steps = len(self.layout.first_tendon), self.layout.n_steps
        try:
            axes = np.ndim(value)
        except ValueError:
            axes = 0
        if axes <= 2:
            return self._array(name, value, (3,), "N/m")[:, None, None, :]
        points = np.shape(value)[-2]
        sampled = self._array(name, value, (n_segments, points, 3), "N/m")
        if points < 2:
            raise InputError(
                f"{name} has {points} points a segment; give two or more, or one force (3,) for all."
            )
        nodes = (
            grid
            if len(grid)
            else np.broadcast_to(np.linspace(0.0, 1.0, n_steps + 1), (1, n_segments, n_steps + 1))
        )
        return np.ascontiguousarray(_per_step(sampled, nodes))

    def _pose(self, base_pose: ArrayLike) -> Floats:
        pose = self._array("base_pose", base_pose, (7,), "position m, quaternion w x y z")
        norm = np.sqrt(np.einsum("ij,ij->i", pose[:, 3:], pose[:, 3:]))
        bad = np.abs(norm - 1.0) > 1e-3
        if bad.any():
            self._note(
                bad,
                lambda i: (
                    "base_pose has a quaternion of norm "
                    f"{norm[min(i, len(norm) - 1)]:.4g}; it must be 1, as w x y z."
                ),
            )
        pose[:, 3:] /= np.where(bad, 1.0, norm)[:, None]
        return pose

    def point_forces(self, point_force: PointForces | None, stretch: Floats) -> tuple[Floats, Floats]:
        """`Ports.grid` with a node at each point force, and `Ports.node_force`; `stretch` (1 or n_robots,
        n_segments) is the extension [m]. Raises `InputError` where a segment has more point forces than nodes
        to put them on."""
        layout, params = self.layout, self.params
        n_segments, n_steps = len(layout.first_tendon), layout.n_steps
        self.loads = np.zeros((1, 0)), np.zeros((1, 0, 3))
        if point_force is None:
            return np.zeros((0, n_segments, n_steps + 1)), np.zeros((0, n_segments * n_steps + 1, 3))
        try:
            pairs = [(np.atleast_1d(np.asarray(s, float))[:, None], f) for s, f in point_force]
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(
                "point_force must be (arclength [m], force [N]) pairs, for example [(0.03, (0, 0.1, 0))]."
            ) from error
        if not pairs:
            return self.point_forces(None, stretch)
        for s, _ in point_force:
            refuse_masked("arclength of a point_force", s)
        at = [self._array("arclength of a point_force", s, (1,), "m")[:, 0] for s, _ in pairs]
        forces = [self._array("point_force", f, (3,), "N") for _, f in pairs]
        ends = np.cumsum(params.length + stretch, axis=1)
        n = max(len(ends), *(len(a) for a in at), *(len(f) for f in forces))
        starts = np.broadcast_to(np.column_stack([np.zeros(len(ends)), ends]), (n, n_segments + 1))
        s = np.stack([np.broadcast_to(a, n) for a in at], axis=1)
        total = starts[:, -1:]
        self._note(
            ((s < 0.0) | (s > total * (1.0 + 1e-9))).any(1),
            lambda i: (
                f"point_force at arclength {_line(s[i])} m; the rod runs from 0 to {total[i, 0]:.6g} m."
            ),
        )
        grid, node = np.empty((n, n_segments, n_steps + 1)), np.empty(s.shape, np.int64)
        if (
            crowded := place_all(np.array(s, order="C"), np.array(starts, order="C"), n_steps, grid, node)
        ) >= 0:
            raise InputError(
                f"the point forces on one segment of robot {crowded} are more than its {n_steps} steps have "
                "nodes for; "
                f"give Simulator more points_per_segment, up to {s.shape[1] + 1}."
            )
        force = np.stack([np.broadcast_to(f, (n, 3)) for f in forces], axis=1)
        self.loads = s, force
        node_force = np.zeros((n, n_segments * n_steps + 1, 3))
        for q in range(s.shape[1]):
            inside = np.flatnonzero(node[:, q] >= 0)
            node_force[inside, node[inside, q]] += force[inside, q]
        return grid, node_force

    def with_point_forces(self, ports: Ports, given: Inputs, more: PointForces) -> tuple[Ports, Inputs]:
        """`ports` with point forces beside those of `given`, and the inputs with them. Raises `InputError` as
        `point_forces` does."""
        given = given._replace(point_force=[*(given.point_force or ()), *more])
        grid, node_force = self.point_forces(given.point_force, ports.extension)
        line_force = ports.line_force
        if given.line_force is not None and np.ndim(given.line_force) > 2:  # samples, between other nodes now
            before, after = (self.line_force(given.line_force, nodes) for nodes in (ports.grid, grid))
            line_force = np.ascontiguousarray(line_force + (after - before))
        return ports._replace(grid=grid, node_force=node_force, line_force=line_force), given


def _per_step(sampled: Floats, nodes: Floats) -> Floats:
    """(n, n_segments, 2 n_steps, 3) line force at both ends of each step, from samples evenly spaced over
    each segment.

    The polyline through the samples may bend inside a step; the straight line put in its place has its
    integral and its first moment.
    """
    n_cells = sampled.shape[2] - 1
    n = max(len(sampled), len(nodes))
    f = np.broadcast_to(sampled, (n, *sampled.shape[1:]))
    t = np.broadcast_to(nodes, (n, *nodes.shape[1:])) * n_cells  # in cells
    cell = np.minimum(t.astype(int), n_cells - 1)
    fraction = (t - cell)[..., None]
    f0, f1 = (np.take_along_axis(f, (cell + k)[..., None], axis=2) for k in (0, 1))
    start = np.arange(n_cells)[:, None]
    # of whole cells, and their moment about the start of the segment
    force = 0.5 * (f[:, :, :-1] + f[:, :, 1:])
    moment = start * force + (f[:, :, :-1] + 2.0 * f[:, :, 1:]) / 6.0
    before_f, before_m = (
        np.concatenate([np.zeros_like(a[:, :, :1]), np.cumsum(a, axis=2)], axis=2) for a in (force, moment)
    )
    slope = f1 - f0
    own_f = fraction * f0 + 0.5 * fraction**2 * slope
    own_m = cell[..., None] * own_f + 0.5 * fraction**2 * f0 + fraction**3 * slope / 3.0
    F, M = (
        np.take_along_axis(a, cell[..., None], axis=2) + own
        for a, own in ((before_f, own_f), (before_m, own_m))
    )
    width = np.maximum(np.diff(t, axis=2), 1e-12)[..., None]
    middle = (0.5 * (t[:, :, 1:] + t[:, :, :-1]))[..., None]
    mean = np.diff(F, axis=2) / width
    rise = 12.0 * (np.diff(M, axis=2) - middle * np.diff(F, axis=2)) / width**2
    pairs = np.stack([mean - 0.5 * rise, mean + 0.5 * rise], axis=3)
    return np.asarray(pairs.reshape(n, f.shape[1], -1, 3))


def _line(a: Floats, precision: int | None = None) -> str:
    """Numbers of an error sentence, in one line however many they are."""
    return np.array2string(a, precision=precision, max_line_width=10**6)


def _length_sentence(lengths: Floats, ends: Floats) -> str:
    worst = int(np.argmax(np.where(np.isfinite(lengths), np.abs(lengths - ends), 0.0)))
    hint = ""
    if lengths[worst] > 20.0 * ends[worst]:
        hint = " Was it given in mm?"
    elif abs(lengths[worst]) < 0.5 * ends[worst]:
        hint = " Is it a change of length? Add Robot.rest_tendon_length."
    return (
        f"tendon_length {lengths[worst]:.6g} m is impossible for a tendon that ends at arclength "
        f"{ends[worst]:.6g} m.{hint}"
    )
