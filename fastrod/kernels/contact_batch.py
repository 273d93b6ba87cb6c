"""A batch of rods and obstacles: what Python calls of contact."""

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
    PointLoads,
    Records,
    SearchWork,
    Surfaces,
)

from .contact.bvh import STACK
from .contact.iteration import ContactIteration, iterate_worlds, search_robots
from .contact.rod_proximity import RodSearch, search_rods
from .contact.surface import ray_hit
from .jit import OnThreads, call_at, entry, parallel_entry
from .rod.node_placement import place_nodes


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
def search_worlds(rows: ContactRows, search: RodSearch, add: bool) -> None:
    """Lower each robot's smallest gap to that between rods, and with `add` renew their contacts
    (`search_rods`)."""
    for k in range(len(rows.start) - 1):
        search_rods(rows.start[k], rows.start[k + 1], rows.robot, search, add)


iterate_contact = OnThreads(iterate_some, _iterate_on_threads)
search_gaps = OnThreads(search_some, _search_on_threads)
