"""The contact problem of one world (the robots that may touch each other): what its kernels read, and their
workspace."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fastrod.types import (
    CANDIDATE,
    WALL,
    ContactMotion,
    ContactProblem,
    ContactRods,
    ContactSet,
    Floats,
    Ints,
    PointLoads,
    Surfaces,
)

from ..jit import inline, kernel
from ..vec import Vec
from .rod_proximity import RodSearch
from .surface import MOST_PLANES

MOST_FOUND = 64
"""Candidates of one robot that a search notes: the most contacts that a robot can have."""


class ContactWorld(NamedTuple):
    """One world in one pass."""

    first: int
    last: int
    """Its rows run from `first` to `last`."""
    robot: Ints
    """(n_rows,) index of the robot of each row."""
    rods: ContactRods
    surfaces: Surfaces
    motion: ContactMotion
    contacts: ContactSet
    loads: PointLoads


def contact_problem(n_threads: int, n_rows: int, n_loads: int, n_x: int, max_contacts: int) -> ContactProblem:
    """Room for the largest world of `n_rows` rows with `n_loads` contacts each in this pass and
    `max_contacts` in the next, once for each of `n_threads` threads."""
    m = n_rows * n_loads

    def floats(*shape: int) -> Floats:
        return np.empty((n_threads, *shape))

    def ints(*shape: int) -> Ints:
        return np.empty((n_threads, *shape), np.int64)

    return ContactProblem(
        first_point=ints(n_rows),
        point=ints(m, 2),
        obstacle=ints(m),
        place=floats(m, 3),
        axes=floats(m, 3, 3),
        friction=floats(m),
        compliance=floats(m),
        free=floats(3 * m),
        delassus=floats(3 * m, 3 * m),
        force=floats(3 * m),
        turned=floats(m, 3, 3),
        stiffness=floats(m),
        applied=floats(3 * m),
        change=floats(3 * m),
        model=floats(3 * m, 3 * m + 1),
        system=floats(3 * m, 6 * m + 1),
        start=floats(3 * m),
        state=ints(m),
        along=floats(m, 2),
        proposed=floats(n_rows, n_loads, 3),
        unknown=floats(n_rows, n_x),
        n_found=ints(n_rows),
        found=np.empty((n_threads, n_rows, MOST_FOUND), CANDIDATE),
        centre=floats(max_contacts, 3),
        wall=np.empty((n_threads, MOST_PLANES), WALL),
    )


@inline
def task_problem(problem: ContactProblem, i: int) -> ContactProblem:
    """The room of one thread."""
    return ContactProblem(
        problem.first_point[i],
        problem.point[i],
        problem.obstacle[i],
        problem.place[i],
        problem.axes[i],
        problem.friction[i],
        problem.compliance[i],
        problem.free[i],
        problem.delassus[i],
        problem.force[i],
        problem.turned[i],
        problem.stiffness[i],
        problem.applied[i],
        problem.change[i],
        problem.model[i],
        problem.system[i],
        problem.start[i],
        problem.state[i],
        problem.along[i],
        problem.proposed[i],
        problem.unknown[i],
        problem.n_found[i],
        problem.found[i],
        problem.centre[i],
        problem.wall[i],
    )


@inline
def rod_search(world: ContactWorld) -> RodSearch:
    """Return what the search between rods needs of a world."""
    return RodSearch(
        world.motion, world.rods, world.contacts, len(world.surfaces.primitive), world.motion.margin
    )


@inline
def node_position(world: ContactWorld, i: int, node: int) -> Vec:
    """Return the position of a node of robot i, world [m]."""
    row = world.motion.position[i, node]
    return row[0], row[1], row[2]


@inline
def damping_of(world: ContactWorld) -> float:
    """The largest of the world's robots."""
    most = 0.0
    for r in range(world.first, world.last):
        most = max(most, world.motion.damping[world.robot[r]])
    return most


@kernel
def row_of_robot(robot: int, world: ContactWorld) -> int:
    """The row that holds this robot; -1 if none does."""
    for r in range(world.first, world.last):
        if world.robot[r] == robot:
            return r
    return -1
