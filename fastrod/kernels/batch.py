"""A batch of rods: what Python calls, and the only `prange`."""

from __future__ import annotations

import numpy as np
from numba import prange

from fastrod.types import Floats, Ints, Layout, Memory, Params, Ports, Response, RodShape

from .jit import LANES, OnThreads, call_at, entry, parallel_entry, take_next
from .rod.chunk import Batch, Chunk, Mode, Output, pass_chunk
from .rod.gather import predict
from .rod.lanes import Lanes
from .rod.node_placement import place_nodes
from .rod.workspace import Run


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
