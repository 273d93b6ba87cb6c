"""Solution of the contact problem of one world: the forces that the contact law asks for on the linear model
of how its contact points move."""

from __future__ import annotations

from fastrod.types import ContactProblem

from ..jit import kernel
from ..vec import axpy
from .assemble import assemble_delassus, assemble_model, measure
from .bvh import Numbers
from .contact_law import ContactLaw, contact_forces
from .geometric_stiffness import add_turned_forces, geometric_stiffness, keep_damping, stiffen_model
from .mobility import axis_of
from .problem import ContactWorld, damping_of, row_of_robot
from .rod_proximity import partner_of


@kernel
def _measure_all(world: ContactWorld, stack: Numbers, problem: ContactProblem) -> int:
    """Write every contact of the world into the problem, with its geometric stiffness; returns how many there
    are."""
    n_obstacles, m = len(world.surfaces.primitive), 0
    for r in range(world.first, world.last):
        i = world.robot[r]
        for q in range(world.contacts.used[i]):
            k, other, q_other = world.contacts.contact[i, q].obstacle, -1, -1
            if k >= n_obstacles:
                other = row_of_robot(k - n_obstacles, world)
                q_other = partner_of(world.contacts, n_obstacles, i, q)
                if other < r or (other == r and q_other < q):
                    continue  # counted from its other side
            measure(r, q, other, q_other, world, stack, problem, m)
            problem.stiffness[m] = geometric_stiffness(r, q, other, q_other, world, stack, problem, m)
            m += 1
    return m


@kernel
def _propose(world: ContactWorld, problem: ContactProblem) -> None:
    """Forces of all contacts, applied and changed, into `problem.proposed`."""
    for r in range(world.first, world.last):
        base = problem.first_point[r - world.first]
        for q in range(world.contacts.used[world.robot[r]]):
            for a in range(3):
                g = 3 * (base + q) + a
                problem.proposed[r - world.first, q, a] = problem.applied[g] + problem.change[g]


@kernel
def solve_contacts(world: ContactWorld, stack: Numbers, problem: ContactProblem) -> bool:
    """Forces that the law asks for on the linear model, into `problem.proposed`; whether it could be
    solved."""
    damping = damping_of(world)
    n = assemble_model(world, problem)
    m = _measure_all(world, stack, problem)
    if m == 0:  # no contacts, or such as have lost their other side
        _propose(world, problem)
        return True
    stiffened = damping > 0.0
    for c in range(m):
        stiffened = stiffened or problem.stiffness[c] > 0.0
    if damping > 0.0:
        keep_damping(m, world, problem)
    if stiffened:
        stiffen_model(n, m, damping, problem)
    assemble_delassus(m, n, world, problem)
    law = ContactLaw(
        problem.delassus,
        problem.free,
        problem.friction,
        problem.compliance,
        problem.force,
        problem.state,
        problem.along,
        problem.start,
        problem.system,
    )
    solved = contact_forces(m, law)
    for c in range(m):
        f = (0.0, 0.0, 0.0)
        for a in range(3):
            f = axpy(problem.force[3 * c + a], axis_of(problem.axes[c], a), f)
        for side in range(2):
            g = problem.point[c, side]
            for a in range(3 if g >= 0 else 0):
                problem.change[3 * g + a] += (1.0 if side == 0 else -1.0) * f[a]
    if stiffened:
        add_turned_forces(n, m, damping, problem)
    _propose(world, problem)
    return solved
