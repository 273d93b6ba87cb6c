"""A batch of robots: the only `prange`, and its serial twin from one body."""

from __future__ import annotations

from collections.abc import Callable
from types import FunctionType

import numpy as np
from numba import prange

from fastrod.kernels.chunk import pass_chunk
from fastrod.kernels.gather import feed_forward
from fastrod.kernels.jit import LANES, entry, parallel_entry
from fastrod.kernels.shape import Lanes
from fastrod.types import Layout, Memory, Params, Ports, Response, Shape


@entry
def move_to_inputs(robots: Lanes, ports: Ports, params: Params, memory: Memory, layout: Layout) -> None:
    """`feed_forward` of these robots, without a pass."""
    feed_forward(robots, len(robots), ports, params, memory, layout)


def _pass(
    robots: Lanes,
    params: Params,
    ports: Ports,
    layout: Layout,
    memory: Memory,
    shape: Shape,
    response: Response,
    scratch: Lanes,
    n_col: int,
    feed: bool,
    carry: bool,
    update: bool,
    process: float,
    noise: float,
) -> None:
    """One forward pass of the robots with these indices, chunk by chunk, in as many parts as `scratch` has rows.

    `scratch` is (n_parts, scratch_size). Flags: `feed` moves x to first order to the new inputs before the pass; `carry`
    keeps the covariance between passes; `update` corrects x after it with P- = P + `process` and the residual variance
    `noise` [m^2]. Which part does a chunk changes no bit of it.
    """
    n, n_parts = len(robots), scratch.shape[0]
    for part in prange(n_parts):
        lanes = np.empty(LANES, np.int64)
        for start in range(part * LANES, n, n_parts * LANES):
            count = min(LANES, n - start)
            for w in range(LANES):
                lanes[w] = robots[start + min(w, count - 1)]
            pass_chunk(
                lanes, count, params, ports, layout, memory, shape, response, scratch[part], n_col, feed, carry, update, process, noise
            )


def _named(name: str) -> Callable[..., None]:
    """The body under a name of its own: numba's cache would hand the serial code to a parallel function of the same name."""
    twin = FunctionType(_pass.__code__, _pass.__globals__, name)
    twin.__qualname__ = name
    return twin


pass_serial = entry(_named("pass_serial"))
pass_parallel = parallel_entry(_named("pass_parallel"))
