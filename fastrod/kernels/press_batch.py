"""Rods of modes that touch: what Python calls."""

from __future__ import annotations

import numpy as np

from fastrod.types import (
    WALL,
    ContactMotion,
    ContactRods,
    ContactRows,
    ContactSet,
    Flags,
    Floats,
    Ints,
    Records,
    Surfaces,
)

from .contact.bvh import STACK
from .contact.candidates import renew_contacts
from .contact.contact_set import violation
from .contact.press import end_contacts, press
from .contact.pressed_world import PressedWorld, Touching, gather_world
from .contact.rod_proximity import RodSearch, search_rods
from .contact.surface import MOST_PLANES
from .jit import entry
from .rod.gather import pick, scatter
from .vec import cross, scale


@entry
def renew_some(
    rows: Ints,
    rods: ContactRods,
    surfaces: Surfaces,
    motion: ContactMotion,
    contacts: ContactSet,
    found: Records,
    n_found: Ints,
    still: Flags,
) -> None:
    """The contacts of these robots for their next pass, from their candidates (`renew_contacts`)."""
    room = np.empty((contacts.contact.shape[1], 3)), np.empty(MOST_PLANES, WALL)
    stack = np.empty(2 * STACK)
    for r in range(len(rows)):
        i = rows[r]
        renew_contacts(i, n_found[r], found[r], rods, surfaces, motion, contacts, room, still[i], stack)


@entry
def violations(
    rows: ContactRows, search: RodSearch, surfaces: Surfaces, found: Records, n_found: Ints, worst: Floats
) -> None:
    """Write how far each robot's world is beyond what its contacts hold [m]."""
    for k in range(len(rows.start) - 1):
        first, last, deepest = rows.start[k], rows.start[k + 1], 0.0
        for r in range(first, last):
            i = rows.robot[r]
            used = search.contacts.used[i]
            contact = search.contacts.contact[i]
            spacing = search.rods.spacing[i]
            deep, _ = violation(max(n_found[r], 0), found[r], used, contact, spacing, surfaces)
            deepest = max(deepest, deep)
        if last - first > 1 or search.rods.own:
            deepest = max(deepest, search_rods(first, last, rows.robot, search, False))
        for r in range(first, last):
            worst[rows.robot[r]] = deepest


@entry
def press_some(
    start: Ints,
    robot: Ints,
    rods: ContactRods,
    surfaces: Surfaces,
    motion: ContactMotion,
    contacts: ContactSet,
    hessian: Floats,
    gradient: Floats,
    change: Floats,
    spin: Floats,
    first: int,
    yielding: float,
    soft: Floats,
    renew: Floats,
    still: Flags,
    step: Floats,
    changed: Flags,
) -> None:
    """Step (n_robots, n_q) and forces of these worlds (`press`), and whose slips were renewed."""
    n_q, most, n_rows = gradient.shape[1], contacts.contact.shape[1], 0
    for k in range(len(start) - 1):
        n_rows = max(n_rows, start[k + 1] - start[k])
    n, m = n_rows * n_q + 6 * len(surfaces.primitive), n_rows * most
    if not surfaces.mobility.any():
        n = n_rows * n_q
    pressing = PressedWorld(
        np.empty((n, n)),
        np.empty(n),
        np.empty((m, 4), np.int64),
        np.empty((m, 3, 3)),
        np.empty((m, 3, n)),
        np.empty((m, 3, n)),
        np.empty((m, 3)),
        np.empty((m, 5)),
        np.empty((m, 3, 3)),
        np.empty((m, 2, n)),
        np.empty((m, 3)),
        np.empty((n, n)),
        np.empty(n),
        np.empty((3, n)),
    )
    stack, wall = np.empty(2 * STACK), np.empty(MOST_PLANES, WALL)
    every = Touching(rods, surfaces, motion, contacts, hessian, gradient, change, spin, first, yielding, soft)
    for k in range(len(start) - 1):
        count, unknowns = gather_world(start[k], start[k + 1], robot, every, pressing, stack, wall)
        i, own = robot[start[k]], n_q * (start[k + 1] - start[k])
        renewed = press(count, unknowns, own, contacts, pressing, renew[i], still[i])
        for o in range(start[k + 1] - start[k]):
            i = robot[start[k] + o]
            changed[i] = renewed
            for a in range(n_q):
                step[i, a] = pressing.step[o * n_q + a]


@entry
def point_forces(
    arclength: Floats, given: Floats, contacts: ContactSet, at: Floats, force: Floats, moment: Floats
) -> None:
    """Point forces of every robot, at `at` (n_robots, n_points) [m], and their moments (n_robots, n_points,
    3): those that are `given` (1 or n_robots, n_given, 3), then its contacts, whose friction acts on the
    surface, as far as there is room."""
    n_given = arclength.shape[1]
    for i in range(len(at)):
        own = pick(i, len(arclength))
        for q in range(n_given):
            at[i, q] = arclength[own, q]
            scatter(force[i, q], (given[own, q, 0], given[own, q, 1], given[own, q, 2]))
        for c in range(min(contacts.used[i], at.shape[1] - n_given)):
            contact, q = contacts.contact[i, c], n_given + c
            f, n = contact["force"], contact["normal"]
            at[i, q] = contact["arclength"]
            scatter(force[i, q], (f[0], f[1], f[2]))
            arm = scale(contact["radius"], (f[0], f[1], f[2]))
            scatter(moment[i, q], cross(arm, (n[0], n[1], n[2])))


@entry
def end_some(rows: Ints, contacts: ContactSet, step_ends: bool) -> None:
    """The contacts of these robots at the end of a step, or of a part of one (`end_contacts`)."""
    for r in range(len(rows)):
        i = rows[r]
        contacts.used[i] = end_contacts(contacts.used[i], contacts.contact[i], step_ends)
