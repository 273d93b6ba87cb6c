"""`BoundarySolver`: the boundary that robots remember, and one forward pass with it."""

from __future__ import annotations

import os
from copy import copy
from typing import TYPE_CHECKING, Any, Literal

import numba
import numpy as np

from fastrod.errors import InputError
from fastrod.kernels.batch import move_to_inputs, pass_robots
from fastrod.kernels.jit import LANES
from fastrod.kernels.rod.gather import Mode, Run, scratch_size
from fastrod.solver.gpu.device import Device
from fastrod.types import Flags, Floats, Ints, Layout, Memory, Params, Ports, Response, RodShape

if TYPE_CHECKING:
    from fastrod.solver.gpu.resident import Resident
    from fastrod.solver.gpu.runner import Runner

_config: Any = numba.config
_SMALL = 4 * LANES  # robots below which starting threads costs more than it saves


def check_size(layout: Layout, n_robots: int, outputs: Literal["full", "tip"]) -> None:
    """`InputError` where what the observer remembers of so many robots, and one shape, is more than this
    machine's memory."""
    n_tendons = len(layout.tendon_segment)
    n_x = max(3 + len(layout.free_tendon), 2 * len(layout.first_tendon))
    most_said = 10**100  # a float holds what is said of it
    points = min(len(layout.first_tendon) * layout.n_steps + 1, most_said)
    each = 4 * n_x * (len(layout.row_tendon) + 8) + 8 * (n_x + 3 * n_tendons + 24)
    each += 8 * 22 * points if outputs == "full" else 0
    n_robots = min(n_robots, most_said)
    if (needed := each * n_robots) > (most := _physical_memory()):
        less = "take fewer, or outputs='tip'" if outputs == "full" else "take fewer"
        raise InputError(
            f"n_robots {n_robots:.6g} with {points:.6g} points each would take {needed / 2**30:.3g} GiB, "
            f"and this machine has {most / 2**30:.3g} GiB; {less}."
        )


def _physical_memory() -> int:
    """Bytes; where the system does not say, more than any machine has that this runs on."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return 2**42


def new_shape(layout: Layout, n: int, outputs: Literal["full", "tip"], holes: bool) -> RodShape:
    """Room for what a pass writes of n robots; `holes`: nan where it will not write."""
    n_points, n_tendons = len(layout.first_tendon) * layout.n_steps + 1, len(layout.tendon_segment)

    def make(wanted: bool, *axes: int) -> Floats:
        if not wanted:
            return np.empty((0, *axes))
        return np.full((n, *axes), np.nan) if holes else np.empty((n, *axes))

    full = outputs == "full"
    return RodShape(
        make(full, n_points, 3),
        make(full, n_points, 3, 3),
        make(full, n_points, 3),
        make(full, n_points),
        make(full, n_points, 3),
        make(full, n_points, 3),
        make(True, 3),
        make(True, 3, 3),
        make(full, n_tendons),
        make(full, n_tendons),
        make(full, 6),
        make(True),
    )


class BoundarySolver:
    """Robots of one layout. `params` is replaced where effects change a robot's numbers, and never written
    into.

    On a GPU the memory stays there from pass to pass; `memory`, `x` and `peek` fetch it where the device has
    a newer one.
    """

    def __init__(
        self,
        layout: Layout,
        params: Params,
        n_robots: int,
        threads: int,
        propagate: bool,
        device: Device = "cpu",
    ) -> None:
        self.layout, self.params, self.n_robots, self.threads = layout, params, n_robots, threads
        self.propagate = propagate
        self.device: Device = device
        self._memory: Memory = self._new_memory(follower=False, track_force=False)
        self._resident: Resident | None = None
        self._runner: Runner | None = None
        if device == "cuda":
            from fastrod.solver.gpu.runner import Runner

            self._runner = Runner()
        self.memory = self._memory

    @property
    def memory(self) -> Memory:
        """Return what the observer carries on, to read and to write."""
        return self._memory if self._resident is None else self._resident.write()

    @memory.setter
    def memory(self, memory: Memory) -> None:
        self._memory = memory
        if self._runner is not None:
            from fastrod.solver.gpu.resident import Resident

            self._resident = Resident(memory)

    @property
    def x(self) -> Floats:
        """(n_robots, n_x) of the memory, to read and to write."""
        return self._memory.x if self._resident is None else self._resident.write(("x",)).x

    @property
    def kept(self) -> tuple[Floats, Floats] | None:
        """(n_robots, n_x) and (n_robots, 3) copies of x and of the guess of the curvature at the base,
        material [1/m], for robots that diverge. None on a GPU, from where they would have to come at every
        step: its robots begin from the cold guess."""
        return None if self.device == "cuda" else (self.x.copy(), self.memory.curvature_guess.copy())

    def peek(self) -> Memory:
        """The memory, to read only."""
        return self._memory if self._resident is None else self._resident.read()

    def put(self, rows: Ints, memory: Memory) -> None:
        """Take these robots' rows from another memory of the same shape."""
        if self._resident is not None:
            self._resident.put(rows, memory)
            return
        own: Any
        new: Any
        for own, new in zip(self._memory, memory, strict=True):
            if len(own):
                own[rows] = new[rows]

    def twin(self, n_robots: int, params: Params, memory: Memory) -> BoundarySolver:
        """Other robots of the same layout, on the same device."""
        twin = copy(self)
        twin.n_robots, twin.params = n_robots, params
        if self._runner is not None:
            twin._runner = type(self._runner)()
        twin.memory = memory
        return twin

    @property
    def tracks_force(self) -> bool:
        """The memory knows how x answers a tip force."""
        return len(self._memory.force_before) > 0

    @property
    def finite(self) -> Flags:
        """(n_robots,) the boundary is a number."""
        if self._runner is not None and self._resident is not None:
            return self._runner.finite(self._resident)
        return np.asarray(np.isfinite(self._memory.x.sum(1)))

    @property
    def n_x(self) -> int:
        """Boundary unknowns of a robot."""
        return int(self._memory.x.shape[1])

    def n_residuals(self, ports: Ports) -> int:
        """Boundary residuals of a robot."""
        return (
            len(self.layout.row_tendon)
            + (0 if self.layout.paper else 3)
            + (3 if len(ports.follower_force) else 0)
        )

    def n_columns(self, ports: Ports) -> int:
        """Columns of sensitivities that a pass carries."""
        return self.n_x + (3 if self.tracks_force and not len(ports.follower_force) else 0)

    def _fields(self, follower: bool, track_force: bool) -> list[tuple[int, ...]]:
        """Shapes of the memory's arrays."""
        layout, n = self.layout, self.n_robots
        n_rows = len(layout.row_tendon)
        n_e = n_rows + (0 if layout.paper else 3) + (3 if follower else 0)
        n_x = 2 * len(layout.first_tendon) if layout.paper else 3 + len(layout.free_tendon)
        n_x += 3 if follower else 0
        return [
            (n, n_x),
            (n if self.propagate else 0, n_x * (n_x + 1) // 2),
            (n, n_x, n_e + (3 if track_force else 0)),
            (n, n_x),
            (n, n_x),
            (n, n_rows),
            (n if track_force else 0, 3),
            (n, 3),
        ]

    def _new_memory(self, follower: bool, track_force: bool) -> Memory:
        single = ("covariance", "gain", "move", "defect")
        fields: dict[str, Any] = {
            name: np.zeros(shape, np.float32 if name in single else np.float64)
            for name, shape in zip(Memory._fields, self._fields(follower, track_force), strict=True)
        }
        return Memory(**fields)

    def remember(self, follower: bool, track_force: bool, force: Floats | None) -> None:
        """Widen or narrow the memory when a follower force or a moving tip force comes or goes; x of the rod
        itself is kept.
        `force` is the tip force that x belongs to."""
        if self._fields(follower, track_force) != [a.shape for a in self._memory]:
            self.memory = self._refitted(self.peek(), follower, track_force, force)

    def refit(self, memory: Memory, follower: bool, force: Floats | None) -> Memory:
        """Another memory of these robots, widened or narrowed to what is remembered now."""
        return self._refitted(memory, follower, self.tracks_force, force)

    def _refitted(self, old: Memory, follower: bool, track_force: bool, force: Floats | None) -> Memory:
        if self._fields(follower, track_force) == [a.shape for a in old]:
            return old
        new = self._new_memory(follower, track_force)
        kept = min(old.x.shape[1], new.x.shape[1])
        new.x[:, :kept] = old.x[:, :kept]
        tracked = len(old.force_before) > 0
        columns = min(old.gain.shape[2] - 3 * tracked, new.gain.shape[2] - 3 * track_force)
        new.gain[:, :kept, :columns] = old.gain[:, :kept, :columns]
        if tracked and track_force:
            new.gain[:, :kept, -3:] = old.gain[:, :kept, -3:]
        new.length_before[:] = old.length_before
        new.curvature_guess[:] = old.curvature_guess
        new.move[:, :kept], new.defect[:, :kept] = old.move[:, :kept], old.defect[:, :kept]
        new.covariance[:, : kept * (kept + 1) // 2] = old.covariance[:, : kept * (kept + 1) // 2]
        if track_force and force is not None:
            new.force_before[:] = force
        return new

    def stretch(self, rows: Ints, change: Floats) -> None:
        """These robots' extensions are about to change by this much (1 or n_robots, n_segments) [m]: the
        tendons that grow along with their segments are, for the boundary, as they were. The gain knows of
        tendons alone; it would pull at every one."""
        if not change.any():
            return
        grown = np.cumsum(change, axis=1)[:, self.layout.tendon_segment[self.layout.row_tendon]]
        if not np.isfinite(grown).all():
            grown = np.where(np.isfinite(grown), grown, 0.0)
        self.memory.length_before[rows] += grown if len(grown) == 1 else grown[rows]

    def arrive_at(self, rows: Ints, ports: Ports) -> None:
        """These robots were brought to these inputs by another way than a step: the next one moves from
        there."""
        rows_of = self.layout.row_tendon
        lengths = np.broadcast_to(ports.tendon_length, (self.n_robots, ports.tendon_length.shape[1]))
        memory = self.memory
        memory.length_before[rows] = lengths[rows][:, rows_of]
        if len(memory.force_before):
            memory.force_before[rows] = np.broadcast_to(ports.tip_force, (self.n_robots, 3))[rows]
        memory.move[rows], memory.defect[rows] = 0.0, 0.0

    def run(
        self,
        rows: Ints,
        ports: Ports,
        shape: RodShape,
        *,
        response: Response | None = None,
        predict: bool = False,
        propagate: bool = False,
        update: bool = True,
        process: float = 1.0,
        noise: float = 1.0,
        n_col: int | None = None,
    ) -> None:
        """One forward pass of these robots (`kernels.batch`). What it writes into the shape is there after
        `collect`."""
        if n_col is None:
            n_col = self.n_columns(ports)
        if response is None:
            response = Response(np.empty((0, 0, 0)), np.empty((0, 0, 0)), np.empty((0, 0)))
        mode = Mode(n_col, predict, propagate, update, float(process), float(noise))
        if self._runner is not None and self._resident is not None:
            self._runner.run(rows, self.params, ports, self.layout, self._resident, shape, response, mode)
            return
        tasks = 1 if len(rows) <= _SMALL else min(self.threads, -(-len(rows) // LANES))
        n_tendons, n_e = len(self.layout.tendon_segment), self.n_residuals(ports)
        scratch = np.empty((tasks, scratch_size(n_tendons, self.n_x, n_col, n_e)))
        run = Run(rows, scratch, *mode)
        pass_robots(tasks, run, self.params, ports, self.layout, self._memory, shape, response)

    def collect(self, shape: RodShape, only: str | None = None) -> RodShape:
        """The shape with what the passes wrote into it, or into one field: on a GPU that is still there."""
        if self._runner is not None:
            self._runner.collect(shape, only)
        return shape

    def move_to_inputs(self, rows: Ints, ports: Ports) -> None:
        """Move x to first order to these inputs, without a pass."""
        if self._runner is not None and self._resident is not None:
            self._runner.move_to_inputs(rows, self.params, ports, self.layout, self._resident)
        else:
            move_to_inputs(rows, ports, self.params, self._memory, self.layout)
