"""Checks of every scene with contact, as figures: balance of forces and moments, and depth of anything in a
wall."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fastrod.contact import Contacts
from fastrod.solver.state import State
from fastrod_scenes.scene import Scene

FORCE = 1e-6
"""Largest error of a balance [N]; of a moment, the same number in N m."""
DEPTH = 1e-7
"""Largest overlap with anything rigid, that to which a step brings contact to rest [m]."""


class Worst(NamedTuple):
    """Largest over a run."""

    force: float
    """[N]"""
    moment: float
    """[N m]"""
    depth: float
    """[m]"""
    passes: int
    """Iterations of one step of one robot."""
    contacts: int
    """On one robot at once."""


def contacts_of(state: State) -> Contacts:
    """The contacts of a simulator that has a contact scene."""
    assert state.contacts is not None
    return state.contacts


def force_error(state: State, loads: ArrayLike = (0.0, 0.0, 0.0)) -> float:
    """Largest component of base force - contact forces - loads, `loads` (3,) or (n_robots, 3) world, on a rod
    [N]."""
    return float(np.abs(state.base_wrench[:, :3] - contacts_of(state).total_force - np.asarray(loads)).max())


def moment_error(state: State) -> float:
    """Largest component of base moment - sum of r x F of the contacts, about the base points, where nothing
    else loads [N m]."""
    contacts = contacts_of(state)
    arm = contacts.point - state.position[:, :1]
    return float(np.abs(state.base_wrench[:, 3:] - np.nansum(np.cross(arm, contacts.force), axis=1)).max())


def rises(values: list[float]) -> bool:
    """Each is larger than the one before."""
    return all(a < b for a, b in pairwise(values))


def watch(
    scene: Scene, run: Iterable[tuple[float, State]], figures: list[Worst]
) -> Iterator[tuple[float, State]]:
    """The run as it is, with the balance of weightless robots kept in `figures`; `SceneError` where a robot
    or a balance fails."""
    for t, state in run:
        scene.expect(
            bool(state.ok.all()), f"at {t:.3g} s robot {int(np.argmin(state.ok))} is lost: {state.problems}"
        )
        contacts = contacts_of(state)
        scene.expect(not contacts.deep.any(), f"at {t:.3g} s a centreline lies inside an obstacle.")
        now = Worst(
            force_error(state),
            moment_error(state),
            float(-contacts.clearance.min()),
            int(state.passes.max()),
            int(contacts.count.max()),
        )
        figures.append(now)
        scene.expect(
            now.depth <= DEPTH,
            f"at {t:.3g} s a rod lies {now.depth:.3g} m deep in something rigid, more than {DEPTH:g} m.",
        )
        yield t, state


def worst(figures: list[Worst]) -> Worst:
    """The largest of each."""
    return Worst(*(max(column) for column in zip(*figures, strict=True)))
