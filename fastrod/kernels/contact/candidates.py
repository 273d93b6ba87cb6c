"""Places where a rod may touch: candidates of each robot, and its contacts for the next pass."""

from __future__ import annotations

from fastrod.types import ContactMotion, ContactRods, ContactSet, Floats, Ints, Records, SearchWork, Surfaces

from ..jit import inline, kernel, take_next
from ..rod.gather import pick
from .bvh import FAR, Numbers
from .centreline import curve_of, interval_of, point_at
from .contact_set import ContactRules, add_walls, choose, measure, merge, presses_beside
from .proximity import ProximityOptions, ProximitySearch, search_obstacles, task_search_work
from .tunnelling import face_entered_sides, moved_far, tunnelled

MOST_FOUND = 64
"""Candidates of one robot that a search notes: the most contacts that a robot can have."""
# of the margin: a contact that opens less between two passes is kept, for it may close again with the next
_KEPT = 0.2
# of an integration step: candidates of one obstacle nearer than this are one
_SAME_PLACE = 0.05
_EVERYWHERE = 1.0  # a margin beyond the rod's length asks for the smallest gap, wherever it is


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
    """Candidates of these robots, each for the task that takes it, and its smallest gap into `motion`; -1 of
    them where it has gone through an obstacle since the last step, which the first one names."""
    own = task_search_work(work, task)
    r = take_next(taken)
    while r < len(rows):
        i = rows[r]
        through, s = -1, 0.0
        if motion.tracked[i] and moved_far(i, motion, rods.first[i]):
            through, s = tunnelled(i, motion, rods.first[i], surfaces, own.stack)
        if through >= 0:
            n_found[r], motion.gap[i] = -1, 0.0
            found[r, 0].obstacle, found[r, 0].arclength, found[r, 0].gap = through, s, 0.0
        else:
            n_found[r], motion.gap[i] = search_obstacles(_search_of(i, rods, surfaces, motion, own, found[r]))
        r = take_next(taken)


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
    contact = contacts.contact[i]
    frames = motion.frames[pick(i, len(motion.frames))]
    curve = curve_of(motion, i)
    centre, wall = room
    margin = motion.margin * rods.length[i]
    face_entered_sides(i, n_found, found, motion, rods, surfaces, stack)
    # with friction a contact that compares the present gap with its own of a pass before leaves its place too
    # late, and so does one alone; without it, one that always follows swings between its neighbours
    for c in range(contacts.used[i]):
        k = contact[c].obstacle
        alone = not presses_beside(c, contacts.used[i], contact, FAR)
        if k < len(frames) and (surfaces.friction[k] > 0.0 or alone):
            j, fraction = interval_of(curve, contact[c].arclength, 0)
            measure(contact[c], frames[k], point_at(curve, j, fraction), margin, surfaces, stack, wall)
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
