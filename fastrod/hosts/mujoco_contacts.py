"""MuJoCo's own contacts of a rod's capsules, read back, and as loads of the rod."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from fastrod.hosts.mujoco_body import mujoco
from fastrod.simulator import Simulator
from fastrod.types import Floats, Ints

# factor by which the relaxation grows in a step: one that is larger without contact than with it would take
# over too little on average
_SLOWLY = 1.01
_SHALLOW = 1e-5  # m: less is not taken for the depth that a force belongs to


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


class ContactFeedback:
    """MuJoCo's contact forces as a line force of the rod, relaxed against its compliance.

    A contact of stiffness k at a point of compliance C, taken over at once, diverges where k C exceeds 1: the
    rod moves away, the force is gone, the rod is back. A fraction 1 / (1 + sum k C) of the change is what an
    implicit step would take; C falls with the cube of the arclength.
    """

    def __init__(self, n_segments: int, per_segment: int, width: Floats) -> None:
        """`width` (n_capsules,) arclength of each capsule [m]."""
        self._n, self._per, self._width = n_segments, per_segment, width
        self.force: Floats = np.zeros((n_segments * per_segment, 2, 3))
        """(n_capsules, 2, 3) on both ends of each capsule, world [N]."""
        self._relaxation = 1.0

    def take(self, felt: Felt, simulator: Simulator) -> None:
        """Go toward the forces of the last step; stay where the rod could not be solved, whose compliance
        nobody knows."""
        if not simulator.state.ok[0]:
            return
        wanted = np.zeros_like(self.force)
        if len(felt.capsule):
            starts = np.concatenate([[0.0], np.cumsum(self._width)])
            fraction = (felt.arclength - starts[felt.capsule]) / self._width[felt.capsule]
            np.add.at(wanted[:, 0], felt.capsule, (1.0 - fraction)[:, None] * felt.force)
            np.add.at(wanted[:, 1], felt.capsule, fraction[:, None] * felt.force)
            stiffness = np.linalg.norm(felt.force, axis=1) / np.maximum(felt.depth, _SHALLOW)
            compliance = np.linalg.norm(simulator.compliance()[0, :3], 2) * (felt.arclength / starts[-1]) ** 3
            self._relaxation = min(_SLOWLY * self._relaxation, 1.0 / (1.0 + float(stiffness @ compliance)))
        self.force += self._relaxation * (wanted - self.force)

    def line_force(self) -> Floats:
        """(n_segments, capsules of one + 1, 3) [N/m]: linear between the capsules' ends, with the sum of the
        forces."""
        ends = np.zeros((self._n, self._per + 1, 3))
        each = self.force.reshape(self._n, self._per, 2, 3)
        ends[:, :-1] += each[:, :, 0]
        ends[:, 1:] += each[:, :, 1]
        width = self._width.reshape(self._n, self._per)
        hat = np.zeros((self._n, self._per + 1))
        hat[:, :-1] += 0.5 * width
        hat[:, 1:] += 0.5 * width
        return np.asarray(ends / hat[..., None])

    def forget(self) -> None:
        """No force carries over."""
        self.force[:] = 0.0
        self._relaxation = 1.0
