"""`Passes`: the boundary that robots remember, and one forward pass with it."""

from __future__ import annotations

from typing import Any, Literal

import numba
import numpy as np

from fastrod.kernels.batch import pass_parallel, pass_serial
from fastrod.kernels.chunk import scratch_size
from fastrod.kernels.jit import LANES
from fastrod.types import Floats, Ints, Layout, Memory, Params, Ports, Probes, Response, Shape

_config: Any = numba.config
_SMALL = 4 * LANES  # robots below which starting threads costs more than it saves
NO_PROBES = Probes(np.empty((0, 0), np.int64), np.empty((0, 0, 3)), np.empty((0, 0, 3)), np.empty((0, 0, 0)), np.empty((0, 0, 0)))


class Passes:
    """Robots of one layout. `params` is replaced where effects change a robot's numbers."""

    def __init__(self, layout: Layout, params: Params, n_robots: int, threads: int, carry: bool) -> None:
        self.layout, self.params, self.n_robots, self.threads, self.carry = layout, params, n_robots, threads, carry
        self.memory = self._new_memory(follower=False, track_force=False)

    @property
    def n_points(self) -> int:
        """Nodes along the whole robot."""
        return len(self.layout.first_tendon) * self.layout.n_steps + 1

    @property
    def n_x(self) -> int:
        """Boundary unknowns of a robot."""
        return int(self.memory.x.shape[1])

    def n_residuals(self, ports: Ports) -> int:
        """Boundary residuals of a robot."""
        return len(self.layout.row_tendon) + (0 if self.layout.paper else 3) + (3 if len(ports.follower_force) else 0)

    def n_columns(self, ports: Ports) -> int:
        """Columns of sensitivities that a pass carries without contact."""
        return self.n_x + (3 if len(self.memory.force_before) and not len(ports.follower_force) else 0)

    def _new_memory(self, follower: bool, track_force: bool) -> Memory:
        layout, n = self.layout, self.n_robots
        n_rows = len(layout.row_tendon)
        n_e = n_rows + (0 if layout.paper else 3) + (3 if follower else 0)
        n_x = 2 * len(layout.first_tendon) if layout.paper else 3 + len(layout.free_tendon)
        n_x += 3 if follower else 0
        return Memory(
            x=np.zeros((n, n_x)),
            covariance=np.zeros((n if self.carry else 0, n_x * (n_x + 1) // 2), np.float32),
            gain=np.zeros((n, n_x, n_e + (3 if track_force else 0)), np.float32),
            move=np.zeros((n, n_x), np.float32),
            defect=np.zeros((n, n_x), np.float32),
            length_before=np.zeros((n, n_rows)),
            force_before=np.zeros((n if track_force else 0, 3)),
            curvature_guess=np.zeros((n, 3)),
        )

    def remember(self, follower: bool, track_force: bool, force: Floats | None) -> None:
        """Widen or narrow the memory when a follower force or a moving tip force comes or goes; x of the rod itself is kept.
        `force` is the tip force that x belongs to."""
        self.memory = self._refitted(self.memory, follower, track_force, force)

    def refit(self, memory: Memory, follower: bool, force: Floats | None) -> Memory:
        """Another memory of these robots, widened or narrowed to what is remembered now."""
        return self._refitted(memory, follower, len(self.memory.force_before) > 0, force)

    def _refitted(self, old: Memory, follower: bool, track_force: bool, force: Floats | None) -> Memory:
        new = self._new_memory(follower, track_force)
        if [a.shape for a in new] == [a.shape for a in old]:
            return old
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

    def arrive_at(self, rows: Ints, ports: Ports) -> None:
        """These robots were brought to these inputs by another way than a step: the next one moves from there."""
        rows_of = self.layout.row_tendon
        lengths = np.broadcast_to(ports.tendon_length, (self.n_robots, ports.tendon_length.shape[1]))
        self.memory.length_before[rows] = lengths[rows][:, rows_of]
        if len(self.memory.force_before):
            self.memory.force_before[rows] = np.broadcast_to(ports.tip_force, (self.n_robots, 3))[rows]
        self.memory.move[rows], self.memory.defect[rows] = 0.0, 0.0

    def new_shape(self, outputs: Literal["full", "tip"], holes: bool) -> Shape:
        """Room for what a pass writes; `holes`: nan where it will not write."""
        n, n_points, n_tendons = self.n_robots, self.n_points, len(self.layout.tendon_segment)

        def make(wanted: bool, *axes: int) -> Floats:
            return (np.full((n, *axes), np.nan) if holes else np.empty((n, *axes))) if wanted else np.empty((0, *axes))

        full = outputs == "full"
        return Shape(
            make(full, n_points, 3), make(full, n_points, 3, 3), make(full, n_points, 3), make(full, n_points),
            make(full, n_points, 3), make(full, n_points, 3), make(True, 3), make(True, 3, 3), make(full, n_tendons),
            make(full, n_tendons), make(full, 6), make(True),
        )  # fmt: skip

    def run(
        self,
        rows: Ints,
        ports: Ports,
        shape: Shape,
        *,
        response: Response | None = None,
        feed: bool = False,
        carry: bool = False,
        update: bool = True,
        process: float = 1.0,
        noise: float = 1.0,
        n_col: int | None = None,
        probes: Probes = NO_PROBES,
    ) -> None:
        """One forward pass of these robots (`kernels.batch`)."""
        n_probes = probes.node.shape[1]
        if n_col is None:
            n_col = self.n_x + 3 * n_probes if n_probes else self.n_columns(ports)
        parts = 1 if len(rows) <= _SMALL else min(self.threads, -(-len(rows) // LANES))
        size = scratch_size(len(self.layout.tendon_segment), self.n_x, n_col, self.n_residuals(ports), n_probes)
        scratch = np.empty((parts, size))
        if response is None:
            response = Response(np.empty((0, 0, 0)), np.empty((0, 0, 0)), np.empty((0, 0)))
        body = pass_serial if parts == 1 else pass_parallel
        body(
            rows, self.params, ports, self.layout, self.memory, shape, response, probes, scratch,
            n_col, feed, carry, update, process, noise,
        )  # fmt: skip
