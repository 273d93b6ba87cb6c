"""A log of a robot of two segments and six tendons, by constant curvature: numpy and scipy only, nothing
shared with the package.

Every tendon has play, the marker has noise, and the camera stands where it likes. `log(...)` is the measured
run, `TOML` the robot.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

LENGTHS, OFFSET = (0.12, 0.10), 0.009
"""Lengths of the two segments, and offset of every tendon from the backbone [m]."""
ANGLES = np.radians([0.0, 120.0, 240.0, 60.0, 180.0, 300.0])
"""Angles of the tendons; the last three end at the tip."""
PLAY, NOISE = 0.55e-3, 0.4e-3
"""Half width of the play, standard deviation of the noise on each axis [m]."""

TOML = "name = 'mine'\n" + "".join(
    f"[[segment]]\nlength = {length}\nbending_stiffness = [0.02, 0.02]\ntorsional_stiffness = "
    "0.015\ntendons = [\n"
    + "".join(f"  {{offset = {OFFSET}, angle = {float(angle)}}},\n" for angle in angles)
    + "]\n"
    for length, angles in zip(LENGTHS, (ANGLES[:3], ANGLES[3:]), strict=True)
)


class Run(NamedTuple):
    """A measured run."""

    t: np.ndarray
    """(n,) [s]."""
    dl: np.ndarray
    """(n, 6) commanded [m]."""
    tip: np.ndarray
    """(n, 3) as the camera sees it [m]."""
    turn: np.ndarray
    """(n, 3, 3) orientation of the tip as the camera sees it."""


def log(
    n: int = 1800,
    rate: float = 20.0,
    *,
    rotation: np.ndarray | None = None,
    shift: np.ndarray | None = None,
    seed: int = 7,
) -> Run:
    """A run of waves at several amplitudes with rests; the camera's frame is `rotation` (3, 3) p + `shift`
    (3,) [m] of the base's."""
    t = np.arange(n) / rate
    phase = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, (2, 2))
    slow = np.array([[0.55, 0.83], [0.71, 0.47]])
    ramp = np.clip(t - 3.0, 0.0, 4.0)[:, None, None] / 4.0
    hold = t - np.clip(t - 0.5 * t[-1], 0.0, 5.0)
    size = 0.45 + 0.3 * np.sin(0.21 * hold)[:, None, None]
    bends = ramp * size * np.sin(slow * hold[:, None, None] + phase)
    dl = bends.reshape(n, 4) @ _routing().T
    felt, at = np.empty_like(dl), dl[0]
    for i, wanted in enumerate(dl):
        felt[i] = at = np.clip(at, wanted - PLAY, wanted + PLAY)
    position, turn = _arcs((felt @ np.linalg.pinv(_routing()).T).reshape(n, 2, 2))
    rng = np.random.default_rng(seed + 1)
    position = position + NOISE * rng.normal(size=(n, 3))
    turn = Rotation.from_rotvec(2e-3 * rng.normal(size=(n, 3))).as_matrix() @ turn
    moved = np.eye(3) if rotation is None else rotation
    return Run(t, dl, position @ moved.T + (0.0 if shift is None else shift), moved @ turn)


def camera(angle: float, distance: float, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """A rotation by `angle` [rad] about a random axis, a shift by `distance` [m] in a random direction."""
    axis, way = np.random.default_rng(seed).normal(size=(2, 3))
    rotation = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    return rotation.as_matrix(), distance * way / np.linalg.norm(way)


def csv(run: Run) -> str:
    """The run as a run log's text."""
    header = ["t", *(f"dl_{k}" for k in range(1, 7)), "tip_x", "tip_y", "tip_z"]
    rows = np.column_stack([run.t, run.dl, run.tip])
    return "\n".join([",".join(header), *(",".join(map(repr, row)) for row in rows.tolist())]) + "\n"


def _routing() -> np.ndarray:
    """(6, 4) change of tendon length per bend about x and y of each segment: shorter on the inner side."""
    one = OFFSET * np.stack([np.sin(ANGLES), -np.cos(ANGLES)], axis=1)
    made = np.zeros((6, 4))
    made[:, :2], made[3:, 2:] = one, one[3:]
    return made


def _arcs(bends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tip (n, 3) and its orientation (n, 3, 3) of two arcs with bends (n, 2, 2) about x and y [rad]."""
    position, turn = np.zeros((len(bends), 3)), np.tile(np.eye(3), (len(bends), 1, 1))
    for bend, length in zip(np.moveaxis(bends, 1, 0), LENGTHS, strict=True):
        angle = np.maximum(np.linalg.norm(bend, axis=1), 1e-9)
        inward = np.stack([bend[:, 1], -bend[:, 0]], axis=1) / angle[:, None]
        side, along = (1.0 - np.cos(angle)) / angle, np.sin(angle) / angle
        local = length * np.column_stack([side[:, None] * inward, along])
        position = position + np.einsum("nij,nj->ni", turn, local)
        turn = turn @ Rotation.from_rotvec(np.column_stack([bend, np.zeros(len(bend))])).as_matrix()
    return position, turn
