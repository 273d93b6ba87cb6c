"""A batch of rods and obstacles: what Python calls of contact."""

from __future__ import annotations

import numpy as np
from numba import prange

from fastrod.types import ContactMotion, ContactRods, ContactRows, Floats, Ints, Records, SearchWork, Surfaces

from .contact.bvh import STACK
from .contact.candidates import search_robots
from .contact.rod_proximity import RodSearch, search_rods
from .contact.surface import ray_hit
from .jit import OnThreads, call_at, entry, parallel_entry


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


search_gaps = OnThreads(search_some, _search_on_threads)
