"""Sentences on what kept a rod from rest."""

from __future__ import annotations

import numpy as np

from fastrod.contact.scene import ContactScene
from fastrod.errors import Problem, ProblemSentence
from fastrod.kernels.contact.bvh import Record
from fastrod.kernels.contact.iteration import DIVERGED, INSIDE, MOVES, THROUGH, UNSOLVED
from fastrod.types import Floats

NO_NODE_LEFT, NO_CONTACT_LEFT = 10, 11
"""A segment has as many contacts as nodes; the rod has as many as it may have. Beside the causes of
`kernels.contact.iteration`."""

_KINDS = {
    MOVES: Problem.CONTACT_STUCK,
    UNSOLVED: Problem.CONTACT_STUCK,
    INSIDE: Problem.CONTACT_INSIDE,
    THROUGH: Problem.CONTACT_TUNNELLED,
    DIVERGED: Problem.CONTACT_DIVERGED,
    NO_NODE_LEFT: Problem.NO_NODE_LEFT,
    NO_CONTACT_LEFT: Problem.NO_CONTACT_LEFT,
}


def sentence(
    trouble: Record, scene: ContactScene, n_steps: int, length: Floats, done: float
) -> ProblemSentence:
    """Say what is stuck, where, by how much, and what to do; `length` (n_segments,) [m], `done` is the
    fraction of the step that was solved."""
    k, s, size = int(trouble.obstacle), trouble.arclength, trouble.distance
    name = (
        repr(scene.names[k])
        if 0 <= k < len(scene.names)
        else f"rod {k - len(scene.names)}"
        if k >= 0
        else "an obstacle"
    )
    at = f"{name} at arclength {s:.4g} m"
    segment = int(np.searchsorted(np.cumsum(length)[:-1], s, side="right")) + 1
    words = {
        MOVES: f"the rod still moves by {size:.2g} m a pass on {at}; take smaller steps, or raise "
        f"ContactScene.max_iterations above {scene.max_iterations}",
        UNSOLVED: f"no forces were found that hold the rod on {at}, it moves by {size:.2g} m; take smaller "
        "steps",
        INSIDE: f"no forces were found that push the rod out of {at}, {size:.2g} m deep; take smaller "
        "steps, or more "
        f"than {n_steps} points_per_segment",
        THROUGH: f"the rod would go through {at}; take smaller steps, or go around it",
        DIVERGED: f"the rod's shape diverged, last held by {at}; take smaller steps",
        NO_NODE_LEFT: f"segment {segment} has no node left for a contact with {at}; take more than "
        f"{n_steps} points_per_segment",
        NO_CONTACT_LEFT: f"the rod is {size:.2g} m inside {at} and has no contact left; raise "
        "ContactScene.max_contacts above "
        f"{scene.max_contacts}",
    }[int(trouble.cause)]
    when = f"after {100.0 * done:.0f} % of this step " if 0.005 < done < 0.995 else ""
    return ProblemSentence(f"contact: {when}{words}.", _KINDS[int(trouble.cause)])
