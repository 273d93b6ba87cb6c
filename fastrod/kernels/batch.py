"""A batch of robots: the only `prange`, and its serial twin from one body."""

from __future__ import annotations

import numpy as np
from numba import prange

from fastrod.kernels.chunk import pass_chunk
from fastrod.kernels.jit import LANES, inline, kernel, parallel_kernel
from fastrod.kernels.shape import Lanes
from fastrod.types import Layout, Memory, Params, Ports, Response, Shape


@inline
def _share(
    part: int, n_parts: int, robots: Lanes, params: Params, ports: Ports, layout: Layout, memory: Memory, shape: Shape, response: Response,
    scratch: Lanes, n_col: int, feed: bool, carry: bool, update: bool, process: float, noise: float,
) -> None:
    """Every n_parts-th chunk: which thread does a chunk changes no bit of it."""
    n = len(robots)
    lanes = np.empty(LANES, np.int64)
    for start in range(part * LANES, n, n_parts * LANES):
        count = min(LANES, n - start)
        for w in range(LANES):
            lanes[w] = robots[start + min(w, count - 1)]
        pass_chunk(lanes, count, params, ports, layout, memory, shape, response, scratch[part], n_col, feed, carry, update, process, noise)


@kernel
def pass_serial(
    robots: Lanes, params: Params, ports: Ports, layout: Layout, memory: Memory, shape: Shape, response: Response,
    scratch: Lanes, n_col: int, feed: bool, carry: bool, update: bool, process: float, noise: float,
) -> None:
    """One forward pass of the robots with these indices, on the calling thread.

    `scratch` is (1, scratch_size). Flags: `feed` moves x to first order to the new inputs before the pass; `carry`
    keeps the covariance between passes; `update` corrects x after it with P- = P + `process` and the residual variance
    `noise` [m^2].
    """
    _share(0, 1, robots, params, ports, layout, memory, shape, response, scratch, n_col, feed, carry, update, process, noise)


@parallel_kernel
def pass_parallel(
    robots: Lanes, params: Params, ports: Ports, layout: Layout, memory: Memory, shape: Shape, response: Response,
    scratch: Lanes, n_col: int, feed: bool, carry: bool, update: bool, process: float, noise: float,
) -> None:
    """As `pass_serial`, spread over as many threads as `scratch` has rows."""
    for part in prange(scratch.shape[0]):
        _share(part, scratch.shape[0], robots, params, ports, layout, memory, shape, response, scratch, n_col, feed, carry, update, process, noise)
