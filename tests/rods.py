"""Small robots that many tests bend, and a reader of truth files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fastrod import Robot, Segment, Tendon


class Table:
    """A truth file: columns by name as arrays."""

    def __init__(self, rows: list[dict[str, str]]) -> None:
        self.rows = rows

    def __call__(self, *names: str) -> np.ndarray:
        """(n_rows, n_names), or (n_rows,) for one name."""
        columns = np.array([[float(row[name]) for name in names] for row in self.rows])
        return columns[:, 0] if len(names) == 1 else columns

    def where(self, name: str, value: str) -> Table:
        return Table([row for row in self.rows if row[name] == value])


def rod(
    mode: str = "tendon_length",
    n_tendons: int = 4,
    *,
    offset: float = 0.0075,
    compliance: float = 1e-5,
    **segment: object,
) -> Robot:
    """One segment like the paper's robot, with what a test wants different."""
    angles = () if mode == "passive" else (2.0 * np.pi * i / n_tendons for i in range(n_tendons))
    tendons = tuple(Tendon(offset=offset, angle=angle, compliance=compliance) for angle in angles)
    given = {"length": 0.07, "bending_stiffness": (0.0022, 0.0022), "torsional_stiffness": 0.001} | segment
    return Robot(name=mode, segments=(Segment(mode=mode, tendons=tendons, **given),))


def behind_a_passive_one(robot: Robot) -> Robot:
    """The robot behind a passive segment, as at the end of a catheter."""
    free = replace(robot.segments[0], mode="passive", tendons=())
    return replace(robot, name="catheter", segments=(free, *robot.segments))


def bend(robot: Robot, angle_x: float, angle_y: float, segment: int = 0) -> np.ndarray:
    """(n_tendons,) tendon lengths that bend one segment by these angles about d1 and d2 [rad]."""
    lengths = robot.rest_tendon_length.copy()
    for t, tendon in enumerate(robot.tendons):
        end = int(robot.tendon_segment[t])
        if end >= segment:
            dx, dy = tendon.position(end + 1)[segment]
            lengths[t] += angle_x * dy - angle_y * dx
    return lengths
