"""Tendons and bends: the linear map between the bend of the segments and what drives the tendons, their
lengths or the forces on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fastrod.model.robot import Robot
from fastrod.types import Floats, Ints


@dataclass(frozen=True)
class Routing:
    """Routing of one robot's tendons; the same for every robot of a batch.

    Of a robot whose tendons are driven by force, "tendon length" is here the force, negative = pulled as a
    length is [N]: an effect of the drives, such as latency, then acts on either.
    """

    n_segments: int
    tendon_segment: Ints
    """(n_tendons,) segment at whose end the tendon ends."""
    arms: Floats
    """(n_tendons, 2 n_segments) d(tendon length)/d(bend x, bend y of each segment) [m/rad], bend about d1 and
    d2."""
    bend_from_tendons: Floats
    """(2 n_segments, n_tendons) least-squares inverse of `arms` [rad/m]."""
    drive: Ints
    """(n_tendons,) the drive of each tendon: opposite tendons of a segment are one antagonistic drive."""
    drive_sign: Floats
    """(n_tendons,) +1 for the first tendon of its drive, -1 for its antagonist."""
    tendon_offset: Floats
    """(n_tendons,) distance of the tendon from the backbone in its last segment [m]."""
    length: Floats
    """(n_segments,) of the robot [m]."""
    by_tension: bool = False
    """Whether forces drive the tendons."""

    @property
    def n_tendons(self) -> int:
        """Tendons of all segments."""
        return len(self.tendon_segment)

    @property
    def n_drives(self) -> int:
        """Drives that pull them; an antagonistic pair of tendons has one."""
        return int(self.drive.max()) + 1 if len(self.drive) else 0

    def count(self, per: str) -> int:
        """Columns of a parameter that is one per robot, segment or drive."""
        return {"robot": 1, "segment": self.n_segments, "drive": self.n_drives}[per]

    def by_tendon(self, per_drive: Floats) -> Floats:
        """(..., n_tendons) from (..., n_drives), unsigned."""
        return np.ascontiguousarray(per_drive[..., self.drive])

    def by_end(self, per_segment: Floats) -> Floats:
        """(..., n_tendons) from (..., n_segments): the value of the segment at whose end the tendon ends."""
        return np.ascontiguousarray(per_segment[..., self.tendon_segment])

    def bend(self, dl: Floats) -> Floats:
        """(..., n_segments, 2) bend about d1 and d2 [rad] that these tendon lengths (..., n_tendons) ask
        for."""
        return _times(dl, self.bend_from_tendons.T).reshape(*dl.shape[:-1], self.n_segments, 2)

    def of_sections(self, bend: Floats) -> Floats:
        """(..., n_sections, 2) bend of what lies between two ends of tendons [rad], from (..., n_segments,
        2): a segment that tapers is a chain of pieces."""
        ends = np.unique(self.tendon_segment)
        return np.diff(np.cumsum(bend, axis=-2)[..., ends, :], axis=-2, prepend=0.0)

    def tendon_change(self, bend: Floats) -> Floats:
        """(..., n_tendons) change of tendon length [m] that goes with a bend (..., n_segments, 2) [rad]."""
        return _times(bend.reshape(*bend.shape[:-2], 2 * self.n_segments), self.arms.T)


def _times(a: Floats, matrix: Floats) -> Floats:
    """a @ matrix, summed in one order: BLAS takes another one with the number of rows, and a batch must be
    its robots bit by bit. The rows are the last axis meanwhile, for there are many of them."""
    out = np.zeros((matrix.shape[1], *a.shape[-2::-1]))
    for column, row in zip(a.T, matrix, strict=True):
        out += row.reshape(-1, *[1] * column.ndim) * column
    return np.ascontiguousarray(out.T)


def route(robot: Robot) -> Routing:
    """The routing of a robot: l_i = l + sum_k (bend_x y_ik - bend_y x_ik), constant curvature in each
    segment. Where forces drive the tendons: the bend l M / EI of a straight rod under their moments."""
    ends = robot.tendon_segment
    positions = [tendon.position(int(end) + 1) for tendon, end in zip(robot.tendons, ends, strict=True)]
    arms = np.zeros((robot.n_tendons, 2 * robot.n_segments))
    for t, places in enumerate(positions):
        for k, (x, y) in enumerate(places):
            arms[t, 2 * k : 2 * k + 2] = y, -x
    drive, sign = np.full(robot.n_tendons, -1), np.ones(robot.n_tendons)
    count = 0
    for t in range(robot.n_tendons):
        if drive[t] >= 0:
            continue
        drive[t] = count
        size = float(np.abs(arms[t]).max())
        for other in range(t + 1, robot.n_tendons):
            if (
                drive[other] < 0
                and ends[other] == ends[t]
                and np.abs(arms[t] + arms[other]).max() < 1e-3 * size
            ):
                drive[other], sign[other] = count, -1.0
                break
        count += 1
    inverse = np.asarray(np.linalg.pinv(arms), dtype=np.float64) if robot.n_tendons else arms.T.copy()
    if robot.by_tension:
        softness = np.array([np.divide(s.length, s.bending_stiffness) for s in robot.segments]).ravel()
        inverse = softness[:, None] * arms.T
        arms = np.asarray(np.linalg.pinv(inverse), dtype=np.float64)
    return Routing(
        n_segments=robot.n_segments,
        tendon_segment=ends,
        arms=arms,
        bend_from_tendons=inverse,
        drive=drive.astype(np.int64),
        drive_sign=sign,
        tendon_offset=np.array([float(np.hypot(*places[-1])) for places in positions]),
        length=np.array([segment.length for segment in robot.segments]),
        by_tension=robot.by_tension,
    )
