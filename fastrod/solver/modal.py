"""`ModalSolver`: robots as curvature modes, at rest or in motion."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib import import_module
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from fastrod.kernels.rod.modal.chunk import ModalRun
from fastrod.kernels.rod.modal.derivatives import ModalDerivatives
from fastrod.kernels.rod.modal.fields import ModalWork
from fastrod.kernels.rod.modal.gather import ModalBatch, ModalPieces, ModalPoints, place_points
from fastrod.kernels.rod.modal.host import ModalHost
from fastrod.kernels.rod.modal.modes import (
    N_INTERVALS,
    ModalBasis,
    gauss_points,
    hat_row,
    integral_row,
    interval_of,
    legendre_at,
    modal_basis,
    row_tables,
    rows_at,
)
from fastrod.kernels.rod.modal.motion import BDF1, BDF2, GENERALIZED_ALPHA, NODE_VECTORS, REST, ModalMotion
from fastrod.kernels.rod.modal.output import ModalOutput, ModalSamples, MotionShape
from fastrod.model.robot import Robot, Segment
from fastrod.solver.options import Modes, SchemeName
from fastrod.solver.protocol import Acting
from fastrod.types import Flags, Floats, Ints, Layout, Params, Ports, RodShape

SCHEMES: dict[str, int] = dict(zip(get_args(SchemeName), (BDF1, BDF2, GENERALIZED_ALPHA), strict=True))
_NOTHING = 1e-100
# chunks, and unknowns squared of all robots: for so few, to start threads costs more than it saves
_SMALL, _LIGHT = 4, 40_000
_FEW, _LARGE = 8, 64  # robots, and unknowns of one: for so few, or for more of them, lanes are few
_NEARLY = 0.05  # rad of one piece: a Newton step of this size leaves an error of its square
_MOST = 200


@cache
def _kernels_of(narrow: bool) -> Any:
    """`kernels.modal_batch`, of few lanes or of many; no type checker would find the former."""
    return import_module(f"fastrod.{'solver.narrow' if narrow else 'kernels'}.modal_batch")


@cache
def _pool(n_threads: int) -> ThreadPoolExecutor:
    """Threads that run one kernel, which holds no lock of Python: for `prange` it would be compiled twice."""
    return ThreadPoolExecutor(n_threads)


def in_threads(count: int, each: int, run: Callable[[int, int, int], None]) -> None:
    """Call `run` (task, first, last) for every `each` of so many things, side by side where there are
    several."""
    first = range(0, count, max(each, 1))
    last = [min(k + each, count) for k in first]
    if len(first) < 2:
        run(0, 0, count)
    else:
        list(_pool(len(first)).map(run, range(len(first)), first, last))


if hasattr(os, "register_at_fork"):  # a forked child has none of its parent's threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


class Step(NamedTuple):
    """One step in time."""

    scheme: int
    dt: float
    rho: float = 0.5
    """Spectral radius of generalized-alpha at infinite frequency."""
    passes: int = 1
    """Newton steps at least; more where the last one was large."""


def modal_samples(n_segments: int, n_steps: int, per_segment: int, n_degrees: int) -> ModalSamples:
    """Cross-sections at `n_steps` even places of each segment, and the tip."""
    s = np.arange(n_segments * n_steps + 1) / n_steps
    piece = np.minimum((s * per_segment + 1e-9).astype(np.int64), n_segments * per_segment - 1)
    x = s * per_segment - piece
    interval, width = interval_of(x)
    gauss = gauss_points(interval, width)
    row, lagrange = rows_at(x)
    inside = (piece % per_segment)[:, None] + np.concatenate([gauss, x[:, None]], axis=1)
    return ModalSamples(
        piece=piece,
        interval=interval,
        width=width,
        at_gauss=legendre_at(gauss, n_degrees),
        here=legendre_at(x, n_degrees),
        place=inside / per_segment,
        row=row,
        lagrange=lagrange,
    )


def basis_of(robots: Sequence[Robot], modes: Modes) -> ModalBasis:
    """Modes of bend and torsion; of stretch and shear where any segment has a stiffness for them."""
    segments = [segment for robot in robots for segment in robot.segments]
    shears, stretches = (
        any(np.isfinite(getattr(segment, f"{name}_stiffness")) for segment in segments)
        for name in ("shear", "axial")
    )
    return modal_basis(
        modes.bending, modes.torsion, modes.strain if shears else 0, modes.strain if stretches else 0
    )


_RIGID = 1e12  # N: of a segment that does not stretch or shear in a batch where others do


def cut(robots: Sequence[Robot], layout: Layout, per_segment: int) -> ModalPieces:
    """The segments of a batch in pieces of even length; a single robot stands for all."""
    n_segments = len(layout.first_tendon)
    segment = np.repeat(np.arange(n_segments), per_segment)
    start = np.tile(np.arange(per_segment) / per_segment, n_segments)
    rows = [[_inertia(s) for s in robot.segments] for robot in robots]
    axial = [
        [(s.shear_stiffness, s.shear_stiffness, s.axial_stiffness) for s in robot.segments]
        for robot in robots
    ]
    places = [(k, lump.at / s.length) for k, s in enumerate(robots[0].segments) for lump in s.lumps]
    lumps = [[lump.mass for s in robot.segments for lump in s.lumps] for robot in robots]
    piece = np.array([k * per_segment + min(int(x * per_segment), per_segment - 1) for k, x in places], int)
    station = np.array([int((piece[:i] == p).sum()) for i, p in enumerate(piece)], int)
    local = np.array(
        [
            [
                lump.at / s.length * per_segment - piece[i] % per_segment
                for i, (s, lump) in enumerate((s, lump) for s in robot.segments for lump in s.lumps)
            ]
            for robot in robots
        ]
    )
    return ModalPieces(
        segment=segment,
        first_tendon=layout.first_tendon[segment],
        bound=np.stack([start, start + 1.0 / per_segment], axis=1),
        density=np.array(rows),
        axial=np.minimum(np.array(axial, dtype=np.float64), _RIGID),
        damping_time=np.array([[s.damping_time for s in robot.segments] for robot in robots], float),
        lump=np.array(lumps, dtype=np.float64).reshape(len(robots), len(places)),
        lump_spin=_directors(robots).reshape(len(robots), len(places), 3),
        lump_weight=hat_row(local.reshape(len(robots), len(places))),
        lump_piece=piece.astype(np.int64),
        lump_station=station.astype(np.int64),
        lump_row=integral_row(local.reshape(len(robots), len(places))),
        gravity=np.array([robot.gravity for robot in robots], dtype=np.float64),
    )


def _directors(robots: Sequence[Robot]) -> Floats:
    """(n_robots, n_lumps, 3) masses at the ends of d1, d2 and d3 that have the inertia of each lump:
    I_1 = J_2 + J_3 and so on."""
    inertia = np.array([[lump.inertia for s in robot.segments for lump in s.lumps] for robot in robots])
    inertia = inertia.reshape(len(robots), -1, 3)
    return np.asarray(0.5 * inertia.sum(2, keepdims=True) - inertia)


def _inertia(segment: Segment) -> tuple[float, float, float]:
    """Mass per length, and its second moments of the cross-section about d2 and d1."""
    radius = segment.gyration_radius or 0.5 * segment.body_radius
    rotary = segment.line_density * radius * radius
    return segment.line_density, rotary, rotary


def no_points(n_robots: int) -> ModalPoints:
    """No point force."""
    n_nodes = N_INTERVALS + 1
    row, force = np.zeros((n_robots, 0, n_nodes)), np.zeros((n_robots, 0, 3))
    return ModalPoints(np.zeros((n_robots, 0), np.int64), row, row.copy(), force, force.copy())


_LEAK = 1e-9
"""Fraction of the largest mobility: what a body gives way along where its joints hold it, so that its
inertia is a number."""


def no_hosts() -> ModalHost:
    """The motion of every base is prescribed."""
    matrix, six = np.zeros((0, 6, 6)), np.zeros((0, 6))
    return ModalHost(matrix, matrix, six, six, matrix)


def mean_by_end(how: Step) -> float:
    """Mean of the acceleration over a step, by that at its end: kappa of `kernels.rod.modal.host`."""
    if how.scheme != GENERALIZED_ALPHA:
        return 1.0 if how.scheme == BDF1 else 2.0 / 3.0
    mass, force = (2.0 * how.rho - 1.0) / (how.rho + 1.0), how.rho / (how.rho + 1.0)
    return (0.5 + force - mass) * (1.0 - force) / (1.0 - mass)


def hosts_of(inverse_inertia: Floats, length: float) -> ModalHost:
    """Bodies that carry the bases, of inverse inertias (n_robots, 6, 6) about the base point, world; `length`
    [m] weighs turns against displacements."""
    unit = np.array([1.0, 1.0, 1.0, length, length, length])
    size, axes = np.linalg.eigh(inverse_inertia * unit * unit[:, None])
    largest = size[:, -1:]
    size = np.where(largest > 0.0, np.maximum(size, _LEAK * largest), 1.0)
    inertia = (axes / size[:, None]) @ np.swapaxes(axes, 1, 2)
    inertia = np.where(largest[:, :, None] > 0.0, inertia * unit * unit[:, None], 0.0)
    n, given = len(inertia), np.ascontiguousarray(inverse_inertia)
    return ModalHost(inertia, given, np.zeros((n, 6)), np.full((n, 6), np.nan), np.full((n, 6, 6), np.nan))


class ModalSolver:
    """Robots of one layout as modes. `params` is replaced where effects change a robot's numbers."""

    def __init__(
        self,
        robots: Sequence[Robot],
        layout: Layout,
        params: Params,
        n_robots: int,
        threads: int,
        modes: Modes,
    ) -> None:
        self.layout, self.params, self.n_robots, self.threads = layout, params, n_robots, threads
        self.basis, self.modes = basis_of(robots, modes), modes
        self.pieces = cut(robots, layout, modes.pieces)
        self.gravity = self.pieces.gravity  # of the robots, where none is given
        n_pieces, n = len(self.pieces.segment), len(self.basis.width)
        counts = np.bincount(self.pieces.lump_piece, minlength=n_pieces)
        self._sizes = n_pieces, len(layout.tendon_segment), int(counts.max(initial=0))
        self.samples = modal_samples(
            len(layout.first_tendon), layout.n_steps, modes.pieces, self.basis.at_node.shape[1]
        )
        n_q = n_pieces * len(self.basis.component)
        numbers = n_pieces * ((n + 1) * NODE_VECTORS + 3 * self._sizes[2])
        unknowns = (np.zeros((n_robots, n_q)) for _ in range(3))
        inert = (np.zeros((n_robots, numbers)) for _ in range(4))
        self.motion = ModalMotion._make([*unknowns, *inert, np.ones(n_robots)])
        self.iterations = np.zeros(n_robots, np.int64)
        self.points = no_points(n_robots)
        self.host = no_hosts()
        """Bodies that give way to the rods in the next step."""
        self._nearly = _NEARLY / math.sqrt(n_pieces)  # at the tip the errors of pieces add up
        self._narrow = n_robots <= _FEW or n_q > _LARGE
        self._work: dict[tuple[int, int], ModalWork] = {}  # by how many tasks, and stations

    @property
    def _kernels(self) -> Any:
        return _kernels_of(self._narrow)

    @property
    def n_points(self) -> int:
        """Cross-sections of a shape."""
        return len(self.samples.piece)

    def replace(self, robots: Sequence[Robot]) -> None:
        """These robots in place of the present ones, of the same layout."""
        self.pieces = cut(robots, self.layout, self.modes.pieces)
        self.gravity = self.pieces.gravity

    def take(self, acting: Acting) -> None:
        """Let all this act on the robots."""
        self.params = acting.params
        gravity = self.gravity if acting.gravity is None else acting.gravity
        self.pieces = self.pieces._replace(gravity=gravity)
        self.place_points(acting.points, acting.ports.extension)

    def bend_as(self, rows: Ints, shape: RodShape, ports: Ports) -> None:
        """Let the curvature of these robots be nearest to that of a shape, by least squares."""
        samples, basis, q = self.samples, self.basis, self.motion.q
        table, n_modes = ports.precurvature, len(basis.component)
        table = table[rows] if len(table) > 1 else np.broadcast_to(table, (len(rows), *table.shape[1:]))
        for p, segment in enumerate(self.pieces.segment):
            here = np.flatnonzero(samples.piece == p)
            place = samples.place[here, -1] * (table.shape[2] - 1)
            first = np.minimum(place.astype(np.int64), max(table.shape[2] - 2, 0))
            last, x = np.minimum(first + 1, table.shape[2] - 1), (place - first)[:, None]
            rest = (1.0 - x) * table[:, segment, first] + x * table[:, segment, last]
            bent = shape.curvature[rows[:, None], here] - rest
            for c in range(3):
                some = np.flatnonzero(basis.component == c)
                modes = samples.here[here][:, basis.degree[some]]
                q[rows[:, None], p * n_modes + some] = np.einsum(
                    "nm,am->na", bent[:, :, c], np.linalg.pinv(modes)
                )

    def start_straight(self, rows: Ints) -> None:
        """Let these robots begin from their shape without loads."""
        for array in self.motion:
            array[rows] = 0.0

    def settle(
        self, rows: Ints, ports: Ports, shape: RodShape, moving: MotionShape, tolerance: float, scheme: int
    ) -> Flags:
        """Bring these robots to rest from where they are; who arrived. `tolerance` [m] at the tip; with inf
        by one Newton step, which near a rest is exact to first order."""
        bend, least = tolerance / float(np.max(self.params.rod_length)), 1 if math.isinf(tolerance) else 2
        self._run(rows, ports, shape, moving, Step(REST, 1.0), None, (max(bend, 1e-13), least, _MOST), scheme)
        return np.asarray(self.iterations[rows] > 0)

    def step(
        self, rows: Ints, ports: Ports, shape: RodShape, moving: MotionShape, how: Step, jump: Floats
    ) -> Flags:
        """Move these robots on by dt; whose Newton's method ended. `jump` (n_robots,): 1 where the inputs
        are not those that the last motion was leading to."""
        # those side by side that take one step more, for a chunk takes as many as its slowest robot
        order = rows[np.argsort(-jump[rows], kind="stable")] if jump.any() else rows
        self._run(order, ports, shape, moving, how, jump, (self._nearly, how.passes, _MOST), how.scheme)
        return np.asarray(self.iterations[rows] > 0)

    def hold(
        self,
        rows: Ints,
        ports: Ports,
        shape: RodShape,
        moving: MotionShape,
        how: Step,
        unknowns: Floats,
        ends: bool,
    ) -> None:
        """Show these robots at `unknowns` (n_robots, n_q, six more where bases give way) a step further;
        where it `ends` there, they go on from it."""
        self._run(rows, ports, shape, moving, how, None, (self._nearly, 1, 1), how.scheme, unknowns, ends)

    def _run(
        self,
        rows: Ints,
        ports: Ports,
        shape: RodShape,
        moving: MotionShape,
        how: Step,
        jump: Floats | None,
        effort: tuple[float, int, int],
        remembers: int,
        given: Floats | None = None,
        ends: bool = True,
    ) -> None:
        batch = self._batch(ports, self.motion, self.host)
        output = ModalOutput(self.samples, shape, moving)

        def run_some(some: Ints, work: ModalWork) -> None:
            self._kernels.pass_modes(
                self._run_of(some, how, jump, effort, remembers, given, ends), batch, output, work
            )

        self._distribute(rows, run_some)
        if not ends:
            return
        # of what fades away each pass leaves less, in the end numbers below the normal ones: with these a
        # pass takes four times as long
        for array in self.motion[:3]:
            array[np.abs(array) < _NOTHING] = 0.0

    def _vectors(self, numbers: Floats) -> tuple[Floats, Floats]:
        """(n, n_nodes, 4, 3) positions and directors, and (n, n_lumps, 3) positions, of numbers that have
        inertia (`ModalMotion`)."""
        m = len(self.pieces.segment) * len(self.basis.node) * NODE_VECTORS
        nodes, lumps = numbers[:, :m], numbers[:, m:]
        return nodes.reshape(len(numbers), -1, NODE_VECTORS // 3, 3), lumps.reshape(len(numbers), -1, 3)

    def set_in_motion(self, rows: Ints, twist: Floats, scheme: int, dt: float) -> None:
        """Let robots at rest move with their bases as rigid bodies: twist (n_rows, 6) of the base point,
        world, as of the last `dt`."""
        motion, place = self.motion, self.motion.place[rows]
        linear, angular = twist[:, None, :3], twist[:, None, 3:]
        nodes, lumps = self._vectors(place)
        moved, base = np.cross(angular[:, :, None], nodes), nodes[:, :1, 0]
        moved[:, :, 0] = linear + np.cross(angular, nodes[:, :, 0] - base)
        carried = linear + np.cross(angular, lumps - base)
        velocity = np.concatenate([moved.reshape(len(rows), -1), carried.reshape(len(rows), -1)], axis=1)
        motion.velocity[rows] = velocity
        if scheme != GENERALIZED_ALPHA:  # which remembers accelerations, measured at its first step
            motion.place_other[rows], motion.velocity_other[rows] = place - dt * velocity, velocity

    def momentum(self, mass: Floats) -> Floats:
        """(n_robots, 6) linear and angular momentum about the origin, by what has inertia (n_robots, n)."""
        (nodes, lumps), (by_node, by_lump) = (
            self._vectors(a) for a in (self.motion.place, mass * self.motion.velocity)
        )
        linear = by_node[:, :, 0].sum(1) + by_lump.sum(1)
        turning = np.cross(nodes, by_node).sum((1, 2)) + np.cross(lumps, by_lump).sum(1)
        return np.concatenate([linear, turning], axis=1)

    def _batch(self, ports: Ports, motion: ModalMotion, host: ModalHost) -> ModalBatch:
        return ModalBatch(self.params, ports, self.layout, self.pieces, self.points, self.basis, motion, host)

    def _run_of(
        self,
        rows: Ints,
        how: Step,
        jump: Floats | None,
        effort: tuple[float, int, int],
        remembers: int,
        given: Floats | None = None,
        ends: bool = True,
    ) -> ModalRun:
        return ModalRun(
            rows,
            np.zeros(self.n_robots) if jump is None else jump,
            np.zeros((1, 4, self._sizes[1] * self._kernels.LANES)),
            np.zeros((1, 2, self._kernels.LANES)),
            self.iterations,
            how.scheme,
            float(how.dt),
            float(how.rho),
            *effort,
            remembers,
            self.motion.q[:0] if given is None else given,
            ends,
        )

    def derive(
        self,
        rows: Ints,
        ports: Ports,
        unknowns: Floats | None = None,
        *,
        wanted: Collection[str] = ("hessian", "mass"),
        step: tuple[ModalMotion, Step, Floats] | None = None,
    ) -> ModalDerivatives:
        """Derivatives of these robots at their unknowns or at `unknowns` (n_robots, n_q), zeros for the
        others: at rest, or in a `step` from a motion with its `jump` (`step`). `wanted` names the matrices:
        hessian, mass (at rest), damping (in a step), number for what has inertia, which comes along
        with the hessian under a line force that follows the rod, point for the point forces."""
        n, motion = self.n_robots, self.motion if step is None else step[0]
        q = motion.q if unknowns is None else unknowns
        host = no_hosts() if step is None else self.host
        n_q, m = q.shape[1], motion.place.shape[1]
        followed = len(ports.follower_line) > 0 and "hessian" in wanted
        n_nodes = len(self.pieces.segment) * len(self.basis.node) if followed else 0
        n_points = self.points.piece.shape[1]
        shapes = {
            "gradient": (n_q,),
            "hessian": (n_q, n_q),
            "mass": (n_q, n_q),
            "tip": (6, n_q),
            "position": (3,),
            "rotation": (3, 3),
            "force": (3,),
            "line": (n_nodes, 3),
            "damping": (n_q, n_q),
            "number": (m,),
            "number_change": (m, n_q),
            "inertia": (m,),
            "point": (n_points, 3),
            "point_change": (n_points, 3, n_q),
            "point_rotation": (n_points, 3, n_q),
        }
        left_out = {"hessian", "mass", "damping", "number", "point"} - set(wanted)
        left_out -= {"number"} if followed else set()
        if "number" in left_out:
            left_out |= {"number_change", "inertia"}
        if "point" in left_out:
            left_out |= {"point_change", "point_rotation"}
        found = ModalDerivatives(
            *(np.zeros((0 if name in left_out else n, *shape)) for name, shape in shapes.items())
        )
        how, jump = (Step(REST, 1.0), None) if step is None else step[1:]
        batch = self._batch(ports, motion, host)

        def derive_some(some: Ints, work: ModalWork) -> None:
            self._kernels.derive_modes(
                self._run_of(some, how, jump, (0.0, 1, 1), REST), batch, q, work, found
            )

        self._distribute(rows, derive_some)
        return found

    def _distribute(self, rows: Ints, run: Callable[[Ints, ModalWork], None]) -> None:
        """Call `run` with some of the rows and a workspace for these, on so many threads."""
        lanes = self._kernels.LANES
        chunks = -(-len(rows) // lanes)
        light = chunks <= _SMALL and len(rows) * self.motion.q.shape[1] ** 2 <= _LIGHT
        tasks = 1 if light else min(self.threads, chunks)
        room = self._workspace(tasks)

        def run_some(task: int, first: int, last: int) -> None:
            run(rows[first:last], ModalWork(*(a[task : task + 1] for a in room)) if tasks > 1 else room)

        in_threads(len(rows), lanes * -(-chunks // tasks), run_some)

    def _workspace(self, tasks: int) -> ModalWork:
        """Kept: to make one takes as long as a step of one robot."""
        n_pieces, n_tendons, n_lumps = self._sizes
        size = tasks, n_lumps + self.points.piece.shape[1]
        if size not in self._work:
            made = self._kernels.modal_workspace(tasks, n_pieces, n_tendons, size[1], self.basis)
            # numba takes the class of few lanes and that of many for one, and types each call anew
            self._work[size] = ModalWork(*made)
        return self._work[size]

    def place_points(self, points: tuple[Floats, ...], extension: Floats) -> None:
        """Arclengths (1 or n_robots, n_points) [m] of point forces (1 or n_robots, n_points, 3) [N], and of
        as many moments [N m], where these are given."""
        n, (arclength, force) = self.n_robots, points[:2]
        m = arclength.shape[1]
        if not m:
            self.points = no_points(n)
            return
        row, slope = np.empty((2, n, m, N_INTERVALS + 1))
        self.points = ModalPoints(
            np.empty((n, m), np.int64),
            row,
            slope,
            np.ascontiguousarray(force if len(force) == n else np.broadcast_to(force, (n, m, 3))),
            points[2] if len(points) > 2 else np.zeros((n, m, 3)),
        )
        ends = np.cumsum(self.params.length + extension, axis=1)
        place_points(ends, np.ascontiguousarray(arclength), self.modes.pieces, row_tables(), self.points)

    def new_motion_shape(self, outputs: Literal["full", "tip"]) -> MotionShape:
        """Room for what a pass writes of the motion."""
        n = self.n_robots
        along = np.full((n if outputs == "full" else 0, self.n_points, 3), np.nan)
        return MotionShape(along, along.copy(), np.full(n, np.nan), np.full(n, np.nan))
