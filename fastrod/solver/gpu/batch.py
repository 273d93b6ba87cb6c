"""Launch of passes on a GPU: a thread takes one robot after the other, with the scratch of a pass in its
local memory.

Local memory is laid out by the machine so that the same field of neighbouring threads lies side by side, it
is written back through the first cache, and its addresses are constants: a strided scratch in global memory
has only the first.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

import numba
import numpy as np
from numba import cuda

from fastrod.kernels.rod.gather import Mode
from fastrod.solver.gpu.kernels.jit import SIMULATED, launched
from fastrod.types import Floats, Ints, Layout, Memory, Params, Ports, Response, RodShape

_cuda: Any = cuda
_config: Any = numba.config
# the same files as in fastrod.kernels.rod, for the other machine: no type checker would find them there
_chunk, _gather = (import_module(f"fastrod.solver.gpu.kernels.rod.{name}") for name in ("chunk", "gather"))
pass_chunk, predict, scratch_size = _chunk.pass_chunk, _gather.predict, _gather.scratch_size
Batch, Chunk, Output = _gather.Batch, _gather.Chunk, _gather.Output

BLOCK = 64
"""Threads of a block."""
BLOCKS = 2
"""Blocks that a multiprocessor is given: a warp for each of its four schedulers. A thread's scratch is 8 to
25 kB, and what more threads have does not fit into the caches."""
_SCRATCH = 256  # numbers by which the room for a pass grows: each size is a compilation


@cache
def pass_robots(size: int) -> Any:
    """The kernel of one forward pass (`pass_chunk`) of the robots `rows`, with room for `size` numbers a
    thread."""

    def run(
        rows: Ints,
        params: Params,
        ports: Ports,
        layout: Layout,
        memory: Memory,
        shape: RodShape,
        response: Response,
        mode: Mode,
    ) -> None:
        scratch = _cuda.local.array(size, np.float64)
        robots = _cuda.local.array(1, np.int64)
        batch, output = Batch(params, ports, layout, memory), Output(shape, response)
        for r in range(_cuda.grid(1), len(rows), _cuda.gridsize(1)):
            robots[0] = rows[r]
            pass_chunk(Chunk(robots, 1), batch, output, scratch, mode)

    return launched(run)


def _move(rows: Ints, ports: Ports, params: Params, memory: Memory, layout: Layout) -> None:
    """`predict` of these robots, without a pass."""
    robots = _cuda.local.array(1, np.int64)
    for r in range(_cuda.grid(1), len(rows), _cuda.gridsize(1)):
        robots[0] = rows[r]
        predict(robots, 1, ports, params, memory, layout)


def _all_finite(x: Floats, finite: Any) -> None:
    """Whether a robot's boundary is one."""
    for i in range(_cuda.grid(1), len(x), _cuda.gridsize(1)):
        total = 0.0
        for a in range(x.shape[1]):
            total += x[i, a]
        finite[i] = total - total == 0.0


def _put_rows(rows: Ints, new: Any, into: Any) -> None:
    """into[rows] = new, of arrays (n, m)."""
    for r in range(_cuda.grid(1), len(rows), _cuda.gridsize(1)):
        for a in range(new.shape[1]):
            into[rows[r], a] = new[r, a]


move_to_inputs = launched(_move)
all_finite = launched(_all_finite)
put_rows = launched(_put_rows)


def room(n_tendons: int, n_x: int, n_col: int, n_e: int) -> int:
    """Numbers of scratch that a thread is compiled for."""
    return _SCRATCH * -(-int(scratch_size(n_tendons, n_x, n_col, n_e)) // _SCRATCH)


def launch(kernel: Any, n: int, *arguments: Any) -> None:
    """Run `kernel` for n robots: at most `BLOCKS` blocks for each multiprocessor, whose threads come back for
    more."""
    if n == 0:
        return
    if SIMULATED:
        kernel[2, 2](*arguments)
        return
    most = BLOCKS * _cuda.get_current_device().MULTIPROCESSOR_COUNT
    before = _config.CUDA_LOW_OCCUPANCY_WARNINGS
    _config.CUDA_LOW_OCCUPANCY_WARNINGS = 0  # a small batch is no mistake
    try:
        configured = kernel[min(-(-n // BLOCK), most), BLOCK]
    finally:
        _config.CUDA_LOW_OCCUPANCY_WARNINGS = before
    configured(*arguments)
