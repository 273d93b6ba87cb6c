"""Arguments of a pass by name: its robots, what it shall do, and the buffers that it works in."""

from __future__ import annotations

from typing import NamedTuple

from fastrod.types import Layout, Memory, Params, Ports, Response, RodShape

from ..jit import LANES, inline
from . import columns as col
from . import shape as sh
from .lanes import BLOCK, LaneMatrix, Lanes, clear, take


class Batch(NamedTuple):
    """The robots of a batch: what they are, what acts on them, and what they remember."""

    params: Params
    ports: Ports
    layout: Layout
    memory: Memory


class Chunk(NamedTuple):
    """The robots of one pass of the lanes."""

    robots: Lanes
    """(LANES,) index of each lane's robot; the lanes beyond the last robot repeat it."""
    n_robots: int
    """At most LANES."""


class Output(NamedTuple):
    """Output of a pass; arrays of length 0 are not wanted."""

    shape: RodShape
    response: Response


class Mode(NamedTuple):
    """Mode of a pass."""

    n_col: int
    """Columns of sensitivities. Without columns the update is by the gain that the robot has."""
    predict: bool
    """Move x to first order to the new inputs before the pass."""
    propagate: bool
    """Keep the covariance between passes."""
    update: bool
    """Correct x after the pass, with P- = P + `process` and the residual variance `noise` [m^2]."""
    process: float
    noise: float


class Run(NamedTuple):
    """Robots, scratch and mode of one call, flat: numba hands no tuple of tuples to threads."""

    robots: Lanes
    """(n_rows,) indices."""
    scratch: Lanes
    """(n_tasks, scratch_size): so many tasks share the chunks. Which of them does a chunk changes no bit of
    it."""
    n_col: int
    predict: bool
    propagate: bool
    update: bool
    process: float
    noise: float


class Size(NamedTuple):
    """Counts of a pass."""

    tendons: int
    x: int
    """Unknowns."""
    e: int
    """Residuals."""
    col: int
    """Columns."""
    p: int
    """Unknowns, rounded up to whole blocks."""


class RodLanes(NamedTuple):
    """State of the march (the offsets of `shape` name the fields)."""

    node: Lanes
    stages: Lanes
    tendon: Lanes
    paths: Lanes


class Sensitivities(NamedTuple):
    """Sensitivities that are integrated along with the rod, for every column."""

    n_col: int
    columns: Lanes
    """(n_col, COLUMN) fields (`columns`)."""
    change: LaneMatrix
    """(n_col, n_tendons + GROUP) change of the tendons' lengths."""


class PassWorkspace(NamedTuple):
    """The buffers of a pass."""

    size: Size
    rod: RodLanes
    sens: Sensitivities
    length: Lanes
    """(n_tendons + GROUP,) of the tendons' paths so far."""
    x: Lanes
    error: Lanes
    """(n_e,) residuals."""
    wrench: Lanes
    """(6,) at the base."""
    s: Lanes
    """(1,) arclength."""
    gamma: LaneMatrix
    """(n_e, n_col) derivatives of the residuals."""
    covariance: LaneMatrix
    """(n_p, n_p) P of the scaled unknowns."""
    gain: LaneMatrix
    """(n_e, n_p) G, transposed."""
    scaled: LaneMatrix
    """(n_e, n_p) gamma of the scaled unknowns."""
    units: Lanes
    """(n_x,) natural size of each unknown."""
    vector: Lanes
    """(n_p + 2,) for `boundary.gain`."""


@inline
def padded(n: int, block: int) -> int:
    """n rounded up to a multiple of `block`."""
    return block * ((n + block - 1) // block)


def scratch_size(n_tendons: int, n_x: int, n_col: int, n_e: int) -> int:
    """Numbers of scratch that `pass_chunk` needs."""
    n_t, n_p = n_tendons + sh.GROUP, BLOCK * -(-n_x // BLOCK)
    march = sh.NODE + 5 * sh.STAGE + n_t * (sh.TENDON + sh.PATHS + 1) + n_col * (col.COLUMN + n_t)
    return LANES * (march + 7 + n_e + n_e * n_col + n_p * n_p + 2 * n_e * n_p + n_p + 2 + 2 * n_x)


@inline
def sizes(batch: Batch, n_col: int) -> Size:
    """Counts of this pass."""
    layout, n_x = batch.layout, batch.memory.x.shape[1]
    n_e = len(layout.row_tendon) + (0 if layout.paper else 3)
    n_e += 3 if len(batch.ports.follower_force) > 0 else 0
    return Size(len(layout.tendon_segment), n_x, n_e, n_col, padded(n_x, BLOCK))


@inline
def carve(scratch: Lanes, size: Size) -> PassWorkspace:
    """The buffers, one after the other in `scratch`; those that sums or unused tendons are read from are
    cleared."""
    n_t, n_p, n_e, n_col = size.tendons + sh.GROUP, size.p, size.e, size.col
    node, o = take(scratch, 0, sh.NODE)
    stages, o = take(scratch, o, 5 * sh.STAGE)
    tendon, o = take(scratch, o, n_t * sh.TENDON)
    paths, o = take(scratch, o, n_t * sh.PATHS)
    length, o = take(scratch, o, n_t)
    columns, o = take(scratch, o, n_col * col.COLUMN)
    change, o = take(scratch, o, n_col * n_t)
    x, o = take(scratch, o, size.x)
    error, o = take(scratch, o, n_e)
    wrench, o = take(scratch, o, 6)
    s, o = take(scratch, o, 1)
    gamma, o = take(scratch, o, n_e * n_col)
    covariance, o = take(scratch, o, n_p * n_p)
    gain, o = take(scratch, o, n_e * n_p)
    scaled, o = take(scratch, o, n_e * n_p)
    vector, o = take(scratch, o, n_p + 2)
    units, o = take(scratch, o, size.x)
    clear(length)
    clear(columns)
    clear(change)
    clear(paths)
    clear(tendon)
    return PassWorkspace(
        size,
        RodLanes(node, stages, tendon, paths),
        Sensitivities(n_col, columns, LaneMatrix(change, n_t)),
        length,
        x,
        error,
        wrench,
        s,
        LaneMatrix(gamma, n_col),
        LaneMatrix(covariance, n_p),
        LaneMatrix(gain, n_p),
        LaneMatrix(scaled, n_p),
        units,
        vector,
    )
