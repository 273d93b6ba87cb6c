"""A batch of rods: what Python calls, and the only `prange`."""

from __future__ import annotations

import numpy as np
from numba import prange

from fastrod.types import Floats, Ints, Layout, Memory, Params, Ports, Response, RodShape

from .jit import LANES, OnThreads, call_at, entry, kernel, parallel_entry, take_next
from .rod.chunk import Batch, Chunk, Mode, Output, pass_chunk
from .rod.gather import Run, predict
from .rod.lanes import Lanes

# The grid of a segment bends so that point loads act on nodes, where they cost no truncation error.
_END = 1e-9  # of a segment: a load nearer to its end than this is on it


@kernel
def place_nodes(s: Floats, starts: Floats, n_steps: int, grid: Floats, node: Ints, work: Floats) -> bool:
    """Move the nodes nearest to the arclengths s (m,) onto them: writes `grid` (n_segments, n_steps + 1),
    fractions of each segment, and the `node` of each s; -1 where s is nan. False where a segment has more of
    them than nodes.

    `starts` (n_segments + 1,) are the arclengths of the joints; `work` holds m numbers.
    """
    fits = True
    n_segments = len(grid)
    for q in range(len(s)):
        node[q] = -1
    for k in range(n_segments):
        low, length = starts[k], starts[k + 1] - starts[k]
        n = 0
        for q in range(len(s)):
            f = (s[q] - low) / length
            ours = (f >= 0.0 or k == 0) and (f < 1.0 or k == n_segments - 1)
            if not ours or f != f:
                continue
            if f < _END or f > 1.0 - _END:
                node[q] = k * n_steps + (0 if f < 0.5 else n_steps)
                continue
            at = n  # keep `work` sorted, without doubles
            while at > 0 and work[at - 1] >= f:
                at -= 1
            if at < n and work[at] == f:
                continue
            for i in range(n, at, -1):
                work[i] = work[i - 1]
            work[at] = f
            n += 1
        fits = fits and n <= n_steps - 1
        n = min(n, n_steps - 1)
        last, last_f = 0, 0.0
        for i in range(n + 1):
            f = work[i] if i < n else 1.0
            there = min(max(int(f * n_steps + 0.5), last + 1), n_steps - n + i) if i < n else n_steps
            for j in range(last, there + 1):
                grid[k, j] = last_f + (f - last_f) * (j - last) / (there - last)
            grid[k, there] = f
            for q in range(len(s)):
                if i < n and (s[q] - low) / length == f:
                    node[q] = k * n_steps + there
            last, last_f = there, f
    return fits


@entry
def move_to_inputs(robots: Lanes, ports: Ports, params: Params, memory: Memory, layout: Layout) -> None:
    """`predict` of these robots, without a pass."""
    predict(robots, len(robots), ports, params, memory, layout)


@entry
def pass_some(
    task: int,
    taken: Ints,
    run: Run,
    params: Params,
    ports: Ports,
    layout: Layout,
    memory: Memory,
    shape: RodShape,
    response: Response,
) -> None:
    """One forward pass of the robots of `run`, chunk by chunk, with the scratch of this task."""
    n = len(run.robots)
    batch, output = Batch(params, ports, layout, memory), Output(shape, response)
    mode = Mode(run.n_col, run.predict, run.propagate, run.update, run.process, run.noise)
    lanes = np.empty(LANES, np.int64)
    start = LANES * take_next(taken)
    while start < n:
        count = min(LANES, n - start)
        for w in range(LANES):
            lanes[w] = run.robots[start + min(w, count - 1)]
        pass_chunk(Chunk(lanes, count), batch, output, run.scratch[task], mode)
        start = LANES * take_next(taken)


@parallel_entry
def _pass_on_threads(
    address: int,
    n_tasks: int,
    taken: Ints,
    run: Run,
    params: Params,
    ports: Ports,
    layout: Layout,
    memory: Memory,
    shape: RodShape,
    response: Response,
) -> None:
    for task in prange(n_tasks):
        call_at(address, task, taken, run, params, ports, layout, memory, shape, response)


@entry
def place_all(s: Floats, starts: Floats, n_steps: int, grid: Floats, node: Ints) -> int:
    """`place_nodes` for every row of s (n, m); the first row that does not fit, or -1."""
    work, crowded = np.empty(s.shape[1]), -1
    for i in range(len(s)):
        if not place_nodes(s[i], starts[i], n_steps, grid[i], node[i], work) and crowded < 0:
            crowded = i
    return crowded


pass_robots = OnThreads(pass_some, _pass_on_threads)
