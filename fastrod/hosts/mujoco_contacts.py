"""MuJoCo's own contacts of a rod's capsules, read back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from fastrod.hosts.mujoco_body import mujoco
from fastrod.types import Floats, Ints


class Felt(NamedTuple):
    """MuJoCo's contacts of the capsules in the last step, one row each; world frame."""

    capsule: Ints
    """(n,) from the base."""
    arclength: Floats
    """(n,) of the straight rod [m]."""
    body: Ints
    """(n,) of what touches."""
    point: Floats
    """(n, 3) [m]."""
    force: Floats
    """(n, 3) on the rod, friction included [N]."""
    depth: Floats
    """(n,) [m]."""


def read(model: Any, data: Any, capsule_of: Mapping[int, int], width: Floats) -> Felt:
    """`capsule_of`: geom -> number of the capsule; `width` (n_capsules,) arclength of each [m]."""
    lib = mujoco()
    rows: list[tuple[int, float, int]] = []
    points, forces, depths, inside = [], [], [], np.zeros(6)
    starts = np.concatenate([[0.0], np.cumsum(width)])
    for i in range(data.ncon):
        contact = data.contact[i]
        for own, other, sign in (
            (int(contact.geom1), int(contact.geom2), -1.0),
            (int(contact.geom2), int(contact.geom1), 1.0),
        ):
            if own in capsule_of:
                k = capsule_of[own]
                lib.mj_contactForce(model, data, i, inside)
                along = float((contact.pos - data.geom_xpos[own]) @ data.geom_xmat[own].reshape(3, 3)[:, 2])
                s = starts[k] + float(np.clip(0.5 * width[k] + along, 0.0, width[k]))
                rows.append((k, s, int(model.geom_bodyid[other])))
                points.append(np.array(contact.pos))
                # on geom2: its normal points there
                forces.append(sign * (inside[:3] @ contact.frame.reshape(3, 3)))
                depths.append(max(-float(contact.dist), 0.0))
    return Felt(
        np.array([row[0] for row in rows], np.int64),
        np.array([row[1] for row in rows]),
        np.array([row[2] for row in rows], np.int64),
        np.array(points).reshape(-1, 3),
        np.array(forces).reshape(-1, 3),
        np.array(depths),
    )
