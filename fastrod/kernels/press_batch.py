"""Rods of modes that touch obstacles: what Python calls."""

from __future__ import annotations

import numpy as np

from fastrod.types import WALL, ContactMotion, ContactRods, ContactSet, Flags, Floats, Ints, Records, Surfaces

from .contact.bvh import STACK
from .contact.iteration import renew_contacts
from .contact.press import Pressing, end_contacts, measure_contact, press
from .contact.surface import MOST_PLANES
from .jit import entry


@entry
def renew_some(
    rows: Ints,
    rods: ContactRods,
    surfaces: Surfaces,
    motion: ContactMotion,
    contacts: ContactSet,
    found: Records,
    n_found: Ints,
    still: bool,
) -> None:
    """The contacts of these robots for their next pass, from their candidates (`renew_contacts`)."""
    room = np.empty((contacts.contact.shape[1], 3)), np.empty(MOST_PLANES, WALL)
    stack = np.empty(2 * STACK)
    for r in range(len(rows)):
        renew_contacts(rows[r], n_found[r], found[r], rods, surfaces, motion, contacts, room, still, stack)


@entry
def press_some(
    rows: Ints,
    rods: ContactRods,
    surfaces: Surfaces,
    motion: ContactMotion,
    contacts: ContactSet,
    hessian: Floats,
    gradient: Floats,
    change: Floats,
    first: int,
    renew: bool,
    step: Floats,
    changed: Flags,
) -> None:
    """Step (n_robots, n_q) and forces of these robots (`press`), and whose slips were told anew. `change`
    (n_robots, n_points, 3, n_q): motion of points, their contacts from the `first` on."""
    n_q, most = gradient.shape[1], contacts.contact.shape[1]
    axes, along = np.empty((most, 3, 3)), np.empty((most, 3, n_q))
    free, law = np.empty((most, 3)), np.empty((most, 5))
    curved, matrix, room = np.empty((most, 3, 3)), np.empty((n_q, n_q)), np.empty((3, n_q))
    stack, wall = np.empty(2 * STACK), np.empty(MOST_PLANES, WALL)
    for r in range(len(rows)):
        i = rows[r]
        n, contact = contacts.used[i], contacts.contact[i]
        for c in range(n):
            margin = motion.margin * rods.length[i]
            room_of_it = axes[c], free[c], law[c], curved[c]
            measure_contact(i, contact[c], motion, surfaces, margin, stack, wall, room_of_it)
        pressing = Pressing(
            hessian[i], gradient[i], change[i, first:], axes, along, free, law, curved, matrix, step[i], room
        )
        _, changed[i] = press(n, contact, pressing, renew)


@entry
def end_some(rows: Ints, contacts: ContactSet) -> None:
    """The contacts of these robots at the end of a step (`end_contacts`)."""
    for r in range(len(rows)):
        i = rows[r]
        contacts.used[i] = end_contacts(contacts.used[i], contacts.contact[i])
