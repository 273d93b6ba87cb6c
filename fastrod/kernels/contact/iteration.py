"""One contact iteration of one world (the robots that may touch each other): new forces by the law, new
contacts by the search.

The pass before has put every contact on a node of its own, and has written how the contact points move with
their forces and with the closing of the boundary (`PointLoads`). With the forces that the law asks for on
that linear model the boundary is closed. The search on the same shape says where the gap is violated next.
"""

from __future__ import annotations

import math
from typing import NamedTuple

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

from ..jit import inline, kernel, take_next
from ..rod.gather import pick
from ..vec import dot
from .bvh import Numbers, Record
from .centreline import curve_of, interval_of, point_at
from .contact_set import ContactRules, add_walls, choose, force_of, merge, pressed_only, stands, violation
from .problem import ContactWorld, damping_of, rod_search, task_problem
from .proximity import ProximityOptions, ProximitySearch, search_obstacles, task_search_work
from .rod_proximity import search_rods
from .solve import solve_contacts
from .tunnelling import face_entered_sides, moved_far, tunnelled

GOES_ON, AT_REST, LOST, BACK = 0, 1, 2, 3
"""State of a world after an iteration; BACK: a damped iteration went through something, or found no
forces, and is to go less far."""
NOTHING, MOVES, UNSOLVED, INSIDE, THROUGH, DIVERGED = 0, 1, 2, 3, 4, 5
"""Causes that keep a robot from rest: it still moves, its forces do not obey the law, the rod is inside of
something, it went through something, its numbers are no numbers."""
# of EI/l in the base moment, about radians of bend: farther the linear model does not hold
_LONGEST_ROTATION = 0.5
_LONGEST_MOVE = 0.05  # of the rod's length, of a contact point
# of the margin: a contact that opens less between two passes is kept, for it may close again with the next
_KEPT = 0.2
# of an integration step: candidates of one obstacle nearer than this are one
_SAME_PLACE = 0.05
_NO_FORCE = 1e-12  # of the largest: what rounding leaves of a force that is gone
_EVERYWHERE = 1.0  # a margin beyond the rod's length asks for the smallest gap, wherever it is


class ContactIteration(NamedTuple):
    """Arrays that one iteration of a batch reads and writes."""

    rows: ContactRows
    rods: ContactRods
    surfaces: Surfaces
    motion: ContactMotion
    contacts: ContactSet
    loads: PointLoads
    problem: ContactProblem
    search: SearchWork


@inline
def _search_of(
    i: int, rods: ContactRods, surfaces: Surfaces, motion: ContactMotion, work: SearchWork, found: Records
) -> ProximitySearch:
    """Robot i among the obstacles."""
    margin = motion.margin
    options = ProximityOptions(
        rods.radius[i],
        rods.n_steps,
        rods.first[i],
        margin * rods.length[i],
        _SAME_PLACE * rods.spacing[i],
        margin > _EVERYWHERE,
    )
    frames = motion.frames[pick(i, len(motion.frames))]
    return ProximitySearch(
        curve_of(motion, i), options, surfaces, frames, motion.distance[i], motion.measured_at[i], work, found
    )


@kernel
def search_robots(
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
    """Candidates of these robots, each for the task that takes it, and its smallest gap into `motion`; -1
    candidates where it has gone through an obstacle since the last step."""
    own = task_search_work(work, task)
    r = take_next(taken)
    while r < len(rows):
        i = rows[r]
        far = motion.tracked[i] and moved_far(i, motion)
        if far and tunnelled(i, motion, rods.first[i], surfaces, own.stack)[0] >= 0:
            n_found[r], motion.gap[i] = -1, 0.0
        else:
            n_found[r], motion.gap[i] = search_obstacles(_search_of(i, rods, surfaces, motion, own, found[r]))
        r = take_next(taken)


@kernel
def _limit_step(r: int, world: ContactWorld, problem: ContactProblem) -> tuple[float, float]:
    """Motion of row r under the proposed forces and the closing boundary [m], and the fraction of it that may
    be taken; the change of the unknowns goes to `problem.unknown`."""
    i, o, loads, rods = world.robot[r], r - world.first, world.loads, world.rods
    count, proposed, unknown = world.contacts.used[i], problem.proposed[o], problem.unknown[o]
    rotation, tension = 0.0, 0.0
    for a in range(loads.unknown.shape[1]):
        value = loads.unknown[r, a, 0]
        for p in range(count):
            for g in range(3):
                value += loads.unknown[r, a, 1 + 3 * p + g] * (proposed[p, g] - loads.force[r, p, g])
        unknown[a] = value
        if a < 3:
            rotation = max(rotation, abs(value) / rods.moment_scale[i])
        elif a < 3 + rods.n_free:
            tension = max(tension, abs(value) / rods.tension_scale[i])
    move, m = 0.0, loads.motion[r]
    for q in range(count):
        square = 0.0
        for a in range(3):
            v = m[3 * q + a, 0]
            for p in range(count):
                for g in range(3):
                    v += m[3 * q + a, 1 + 3 * p + g] * (proposed[p, g] - loads.force[r, p, g])
            square += v * v
        move = max(move, math.sqrt(square))
    fraction = min(
        1.0,
        min(
            _LONGEST_ROTATION / max(rotation, max(tension, 1e-300)),
            _LONGEST_MOVE * rods.length[i] / max(move, 1e-300),
        ),
    )
    return max(move, rotation * rods.length[i]), fraction


@kernel
def _indent(r: int, world: ContactWorld, proposed: Floats) -> float:
    """Return how much farther the proposed forces go into soft obstacles, or move free ones [m]; where a
    rod is pressed along its axis nothing else moves."""
    deepest, i, surfaces = 0.0, world.robot[r], world.surfaces
    for q in range(world.contacts.used[i]):
        k = world.contacts.contact[i, q].obstacle
        own = k < len(surfaces.primitive)
        soft = surfaces.compliance[k] + surfaces.mobility[k, 0] if own else world.rods.compliance
        for a in range(3):
            deepest = max(deepest, soft * abs(proposed[q, a] - world.loads.force[r, q, a]))
    return deepest


@kernel
def _apply_law(
    world: ContactWorld, stack: Numbers, problem: ContactProblem, trouble: Records
) -> tuple[bool, float, float]:
    """Solve the contact problem: whether the law could be solved, how far the farthest row moves or its
    boundary is open (nan where the numbers are none) [m], and the fraction of the motion that may be
    taken."""
    solved = solve_contacts(world, stack, problem)
    farthest, fraction = 0.0, 1.0
    for r in range(world.first, world.last):
        i = world.robot[r]
        move, most = _limit_step(r, world, problem)
        residual = world.motion.residual[i]
        if not (math.isfinite(move) and math.isfinite(residual)):
            return False, math.nan, 0.0
        move = max(move, _indent(r, world, problem.proposed[r - world.first]))
        farthest, fraction = max(farthest, max(move, residual)), min(fraction, most)
        contacts = world.contacts.contact[i]
        cause = MOVES if solved else UNSOLVED
        _name_hardest(trouble[i], cause, max(move, residual), world.contacts.used[i], contacts)
    return solved, farthest, fraction


@kernel
def _search_world(world: ContactWorld, problem: ContactProblem, work: SearchWork, trouble: Records) -> float:
    """Candidates of every row, and the largest violation [m]."""
    worst, gap = 0.0, world.motion.gap
    for r in range(world.first, world.last):
        i, o = world.robot[r], r - world.first
        found, spacing = problem.found[o], world.rods.spacing[i]
        search = _search_of(i, world.rods, world.surfaces, world.motion, work, found)
        count, gap[i] = search_obstacles(search)
        problem.n_found[o] = count
        used, contacts = world.contacts.used[i], world.contacts.contact[i]
        deep, where = violation(count, found, used, contacts, spacing, world.surfaces)
        worst = max(worst, deep)
        if deep > world.motion.tolerance:
            _write(trouble[i], INSIDE, found[where].obstacle, found[where].arclength, deep)
    return max(worst, search_rods(world.first, world.last, world.robot, rod_search(world), False))


@kernel
def _went_through(world: ContactWorld, stack: Numbers, trouble: Records) -> bool:
    """Whether a robot of the world went through an obstacle since the shape before; notes what."""
    through = False
    for r in range(world.first, world.last):
        i, k, s = world.robot[r], -1, 0.0
        if world.motion.tracked[i]:
            k, s = tunnelled(i, world.motion, world.rods.first[i], world.surfaces, stack)
        through = through or k >= 0
        if k >= 0:
            _write(trouble[i], THROUGH, k, s, 0.0)
    return through


@kernel
def _take_step(fraction: float, world: ContactWorld, problem: ContactProblem, x: Floats) -> None:
    """Move by this fraction to the proposed forces and the closed boundary."""
    for r in range(world.first, world.last):
        i, o, most = world.robot[r], r - world.first, 0.0
        for q in range(world.contacts.used[i]):
            force, applied = world.contacts.contact[i, q].force, world.loads.force[r, q]
            for a in range(3):
                force[a] = applied[a] + fraction * (problem.proposed[o, q, a] - applied[a])
                most = max(most, abs(force[a]))
        for q in range(world.contacts.used[i]):
            force = world.contacts.contact[i, q].force
            for a in range(3):
                if abs(force[a]) <= _NO_FORCE * most:
                    force[a] = 0.0
        for a in range(world.loads.unknown.shape[1]):
            x[i, a] += fraction * problem.unknown[o, a]


@kernel
def renew_contacts(
    i: int,
    n_found: int,
    found: Records,
    rods: ContactRods,
    surfaces: Surfaces,
    motion: ContactMotion,
    contacts: ContactSet,
    room: tuple[Floats, Records],
    still: bool,
    stack: Numbers,
) -> None:
    """The contacts of robot i for its next pass, from its candidates (`ContactRules.still`). `room` is for
    the centreline at each contact (max_contacts, 3) and the walls of a corner."""
    contact, frames, curve = (
        contacts.contact[i],
        motion.frames[pick(i, len(motion.frames))],
        curve_of(motion, i),
    )
    centre, wall = room
    margin = motion.margin * rods.length[i]
    face_entered_sides(i, n_found, found, motion, rods, surfaces, stack)
    rules = ContactRules(
        surfaces,
        len(frames),
        rods.radius[i],
        rods.n_steps,
        curve.arclength,
        rods.spacing[i],
        motion.tolerance,
        _KEPT * margin,
        still,
    )
    count = choose(n_found, found, contacts.used[i], contact, rules)
    count = merge(count, contact, rods.spacing[i])
    for c in range(count):
        j, fraction = interval_of(curve, contact[c].arclength, 0)
        centre[c, 0], centre[c, 1], centre[c, 2] = point_at(curve, j, fraction)
    contacts.used[i] = add_walls(count, contact, centre, frames, margin, surfaces, stack, wall)


@kernel
def _iterate_world(world: ContactWorld, rows: ContactRows, problem: ContactProblem, work: SearchWork) -> int:
    """One contact iteration: the smallest gap of each row and what keeps it from rest; a world that is not at
    rest gets its next forces, unknowns and contacts. Returns its status."""
    tolerance, used, contacts = world.motion.tolerance, world.contacts.used, world.contacts.contact
    solved, farthest, fraction = _apply_law(world, work.stack, problem, rows.trouble)
    if math.isnan(farthest):
        for r in range(world.first, world.last):
            _write(rows.trouble[world.robot[r]], DIVERGED, -1, 0.0, 0.0)
        return LOST
    worst = _search_world(world, problem, work, rows.trouble)
    if not solved and farthest <= tolerance:
        solved = True
        for r in range(world.first, world.last):
            i = world.robot[r]
            solved = solved and stands(used[i], contacts[i], tolerance)
    for r in range(world.first, world.last):
        rows.trouble[world.robot[r]].from_rest = max(farthest, worst)
    rest = solved and farthest <= tolerance and worst <= tolerance
    damped = damping_of(world) > 0.0
    through = (rest or damped) and _went_through(world, work.stack, rows.trouble)
    if rest:
        for r in range(world.first, world.last):
            i = world.robot[r]
            if rows.trouble[i].cause != THROUGH:
                _write(rows.trouble[i], NOTHING, -1, 0.0, 0.0)
            used[i] = pressed_only(used[i], contacts[i])
    if damped and (through or not solved):
        return BACK
    if rest:
        return LOST if through else AT_REST
    _take_step(fraction, world, problem, rows.x)
    for r in range(world.first, world.last):
        i, o = world.robot[r], r - world.first
        room = problem.centre, problem.wall
        n_found, found = problem.n_found[o], problem.found[o]
        renew_contacts(
            i,
            n_found,
            found,
            world.rods,
            world.surfaces,
            world.motion,
            world.contacts,
            room,
            False,
            work.stack,
        )
    search_rods(world.first, world.last, world.robot, rod_search(world), True)
    return GOES_ON


@kernel
def iterate_worlds(task: int, taken: Ints, batch: ContactIteration) -> None:
    """One contact iteration of the worlds, each for the task that takes it."""
    rows, problem = batch.rows, task_problem(batch.problem, task)
    work = task_search_work(batch.search, task)
    k = take_next(taken)
    while k < len(rows.start) - 1:
        world = ContactWorld(
            rows.start[k],
            rows.start[k + 1],
            rows.robot,
            batch.rods,
            batch.surfaces,
            batch.motion,
            batch.contacts,
            batch.loads,
        )
        status = _iterate_world(world, rows, problem, work)
        for r in range(world.first, world.last):
            rows.status[r] = status
        k = take_next(taken)


@inline
def _write(trouble: Record, cause: int, obstacle: int, s: float, distance: float) -> None:
    """Write what keeps a robot from rest."""
    trouble.cause, trouble.obstacle, trouble.arclength, trouble.distance = cause, obstacle, s, distance


@kernel
def _name_hardest(trouble: Record, cause: int, size: float, count: int, contacts: Records) -> None:
    """Write trouble of this size at the contact that presses hardest."""
    hardest, at = 0.0, -1
    for c in range(count):
        f = force_of(contacts[c])
        if dot(f, f) >= hardest:
            hardest, at = dot(f, f), c
    if at >= 0:
        _write(trouble, cause, contacts[at].obstacle, contacts[at].arclength, size)
    else:
        _write(trouble, cause, -1, 0.0, size)
