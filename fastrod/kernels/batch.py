"""A batch of robots: what Python calls, and the only `prange`."""

from __future__ import annotations

import numpy as np
from numba import prange

from fastrod.types import (
    ContactMotion,
    ContactProblem,
    ContactRods,
    ContactRows,
    ContactSet,
    Floats,
    Ints,
    Layout,
    Memory,
    Params,
    PointLoads,
    Ports,
    Records,
    Response,
    RodShape,
    SearchWork,
    Surfaces,
)

from .contact.bvh import STACK
from .contact.iteration import ContactIteration, iterate_worlds, search_robots
from .contact.node_placement import place_nodes
from .contact.rod_proximity import RodSearch, search_rods
from .contact.surface import ray_hit
from .jit import LANES, OnThreads, call_at, entry, parallel_entry, take_next
from .rod.chunk import Batch, Chunk, Mode, Output, pass_chunk
from .rod.gather import predict
from .rod.lanes import Lanes
from .rod.modal.chunk import ModalRun, pass_of_modes
from .rod.modal.derivatives import ModalDerivatives, derivatives_of_modes
from .rod.modal.fields import ModalWork
from .rod.modal.gather import ModalBatch
from .rod.modal.output import ModalOutput
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
    loads: PointLoads,
) -> None:
    """One forward pass of the robots of `run`, chunk by chunk, with the scratch of this task."""
    n = len(run.robots)
    batch, output = Batch(params, ports, layout, memory), Output(shape, response, loads)
    mode = Mode(run.n_col, run.predict, run.propagate, run.update, run.process, run.noise)
    lanes = np.empty(LANES, np.int64)
    start = LANES * take_next(taken)
    while start < n:
        count = min(LANES, n - start)
        for w in range(LANES):
            lanes[w] = run.robots[start + min(w, count - 1)]
        pass_chunk(Chunk(lanes, count, start), batch, output, run.scratch[task], mode)
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
    loads: PointLoads,
) -> None:
    for task in prange(n_tasks):
        call_at(address, task, taken, run, params, ports, layout, memory, shape, response, loads)


@entry
def iterate_some(
    task: int,
    taken: Ints,
    rows: ContactRows,
    rods: ContactRods,
    surfaces: Surfaces,
    motion: ContactMotion,
    contacts: ContactSet,
    loads: PointLoads,
    problem: ContactProblem,
    search: SearchWork,
) -> None:
    """One contact iteration of each world (`iterate_worlds`), in the workspace of this task."""
    batch = ContactIteration(rows, rods, surfaces, motion, contacts, loads, problem, search)
    iterate_worlds(task, taken, batch)


@parallel_entry
def _iterate_on_threads(
    address: int,
    n_tasks: int,
    taken: Ints,
    rows: ContactRows,
    rods: ContactRods,
    surfaces: Surfaces,
    motion: ContactMotion,
    contacts: ContactSet,
    loads: PointLoads,
    problem: ContactProblem,
    search: SearchWork,
) -> None:
    for task in prange(n_tasks):
        call_at(address, task, taken, rows, rods, surfaces, motion, contacts, loads, problem, search)


@entry
def place_all(s: Floats, starts: Floats, n_steps: int, grid: Floats, node: Ints) -> int:
    """`place_nodes` for every row of s (n, m); the first row that does not fit, or -1."""
    work, crowded = np.empty(s.shape[1]), -1
    for i in range(len(s)):
        if not place_nodes(s[i], starts[i], n_steps, grid[i], node[i], work) and crowded < 0:
            crowded = i
    return crowded


@entry
def arrange(
    rows: Ints,
    contacts: ContactSet,
    s_given: Floats,
    starts: Floats,
    n_steps: int,
    grid: Floats,
    node_given: Ints,
    loads: PointLoads,
) -> bool:
    """Put a node under every contact of these robots, and under the point forces that were given (arclengths
    `s_given` (n_robots, m)); fills the point loads of the contacts. False where a segment has more of them
    than nodes."""
    m, n_loads = s_given.shape[1], loads.node.shape[1]
    s, node, work = np.empty(m + n_loads), np.empty(m + n_loads, np.int64), np.empty(m + n_loads)
    fits = True
    for r in range(len(rows)):
        i = rows[r]
        used, contact = contacts.used[i], contacts.contact[i]
        for q in range(m):
            s[q] = s_given[i, q]
        for q in range(n_loads):
            s[m + q] = contact[q].arclength if q < used else np.nan
        fits = place_nodes(s, starts[i if len(starts) > 1 else 0], n_steps, grid[i], node, work) and fits
        for q in range(m):
            node_given[i, q] = node[q]
        for q in range(n_loads):
            loads.node[r, q] = node[m + q]
            for a in range(3):
                loads.force[r, q, a] = contact[q].force[a] if q < used else 0.0
                loads.arm[r, q, a] = -contact[q].arm * contact[q].normal[a] if q < used else 0.0
    return fits


@entry
def search_some(
    task: int,
    taken: Ints,
    rows: Ints,
    rods: ContactRods,
    surfaces: Surfaces,
    motion: ContactMotion,
    found: Records,
    n_found: Ints,
    work: SearchWork,
) -> None:
    """Smallest gap of each robot, and its candidates for contact (`search_robots`), in the workspace of this
    task."""
    search_robots(task, taken, rows, rods, surfaces, motion, found, n_found, work)


@parallel_entry
def _search_on_threads(
    address: int,
    n_tasks: int,
    taken: Ints,
    rows: Ints,
    rods: ContactRods,
    surfaces: Surfaces,
    motion: ContactMotion,
    found: Records,
    n_found: Ints,
    work: SearchWork,
) -> None:
    for task in prange(n_tasks):
        call_at(address, task, taken, rows, rods, surfaces, motion, found, n_found, work)


@entry
def cast_rays(
    origin: Floats,
    direction: Floats,
    longest: float,
    surfaces: Surfaces,
    frames: Floats,
    distance: Floats,
    obstacle: Ints,
    normal: Floats,
) -> None:
    """Nearest obstacle along the unit directions (n_robots, m, 3): `distance`, infinite where none is met up
    to `longest`, which obstacle, or -1, and the outward normal there."""
    stack = np.empty(2 * STACK)
    for i in range(origin.shape[0]):
        at = frames[i if len(frames) > 1 else 0]
        for q in range(origin.shape[1]):
            p = (origin[i, q, 0], origin[i, q, 1], origin[i, q, 2])
            v = (direction[i, q, 0], direction[i, q, 1], direction[i, q, 2])
            best = longest
            distance[i, q], obstacle[i, q] = np.inf, -1
            for k in range(len(at)):
                t, n = ray_hit(k, at[k], p, v, best, surfaces, stack)
                if t <= best:
                    best, distance[i, q], obstacle[i, q] = t, t, k
                    for a in range(3):
                        normal[i, q, a] = n[a]


@entry
def search_worlds(rows: ContactRows, search: RodSearch) -> None:
    """Lower each robot's smallest gap to that between rods (`search_rods`)."""
    for k in range(len(rows.start) - 1):
        search_rods(rows.start[k], rows.start[k + 1], rows.robot, search, False)


@entry
def pass_modes(run: ModalRun, batch: ModalBatch, output: ModalOutput, work: ModalWork) -> None:
    """The robots of `run` at rest or one time step further (`pass_of_modes`), in a workspace of one task. It
    holds no lock of Python, so that threads run it side by side: `prange` would compile it once more."""
    n = len(run.robots)
    lanes = np.empty(LANES, np.int64)
    for start in range(0, n, LANES):
        count = min(LANES, n - start)
        for w in range(LANES):
            lanes[w] = run.robots[start + min(w, count - 1)]
        pass_of_modes(lanes, count, 0, run, batch, output, work)


@entry
def derive_modes(
    run: ModalRun, batch: ModalBatch, unknowns: Floats, work: ModalWork, out: ModalDerivatives
) -> None:
    """Derivatives of the robots of `run` at these unknowns (`derivatives_of_modes`)."""
    n = len(run.robots)
    lanes = np.empty(LANES, np.int64)
    for start in range(0, n, LANES):
        count = min(LANES, n - start)
        for w in range(LANES):
            lanes[w] = run.robots[start + min(w, count - 1)]
        derivatives_of_modes(lanes, count, run, batch, unknowns, work, out)


pass_robots = OnThreads(pass_some, _pass_on_threads)
iterate_contact = OnThreads(iterate_some, _iterate_on_threads)
search_gaps = OnThreads(search_some, _search_on_threads)
