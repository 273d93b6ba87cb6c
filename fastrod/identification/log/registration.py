"""Registration of the camera: the rigid motion that lays predicted points on measured ones, roughly,
before anything is fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from fastrod.effects.base import canonical_name
from fastrod.effects.pipeline import named_effects
from fastrod.model.robot import Robot
from fastrod.types import Floats

EFFECT = "frame_misalignment"
_ROTATION = ("rotation_x", "rotation_y", "rotation_z")
_SHIFT = ("shift_x", "shift_y", "shift_z")
_LARGE_ROTATION = 0.25  # rad; a smaller one is left to the search, as the effect that it is
_LARGE_SHIFT = 0.3  # robot lengths
# of the cloud's largest spread: a rotation that moves the points by less stays as the robot file has it
_PULL = 1e-3
_ROUNDS = 20  # of reweighting
_COUNTED = 0.85  # of the rows: the farther ones may be outliers


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraRegistration:
    """A camera's frame: measured = `rotation` predicted + `shift`."""

    rotation: Floats
    """(3, 3) camera_from_base."""
    shift: Floats
    """(3,) place of the base in the camera's frame [m]."""
    left: float
    """Distance that it leaves, root mean square without the farthest rows [m]."""

    @property
    def angle(self) -> float:
        """Angle of the rotation [rad]."""
        return float(Rotation.from_matrix(self.rotation).magnitude())

    @property
    def distance(self) -> float:
        """Distance of the shift [m]."""
        return float(np.linalg.norm(self.shift))

    def is_large(self, length: float) -> bool:
        """Whether it is farther off than a search by slopes finds its way, on a robot of this `length`
        [m]."""
        return self.angle > _LARGE_ROTATION or self.distance > _LARGE_SHIFT * length

    def sentence(self) -> str:
        """Say it to a user."""
        return (
            f"the camera stands {np.degrees(self.angle):.1f} deg and {self.distance:.2g} m from where "
            "the robot file says"
        )

    def on(self, robot: Robot) -> Robot:
        """`robot` seen by this camera: with the effect `frame_misalignment`, after what its file has of it
        already."""
        before = frame_of(robot)
        rotation, shift = self.rotation @ before.rotation, self.rotation @ before.shift + self.shift
        vector = Rotation.from_matrix(rotation).as_rotvec()
        table = {
            "name": EFFECT,
            **dict(zip((*_ROTATION, *_SHIFT), (*vector.tolist(), *shift.tolist()), strict=True)),
        }
        others = tuple(effect for effect in robot.effects if canonical_name(str(effect["name"])) != EFFECT)
        return replace(robot, effects=(*others, table))


def frame_of(robot: Robot) -> CameraRegistration:
    """The camera's frame as the effects of `robot` have it."""
    table = named_effects(robot).get(EFFECT, {})
    vector, shift = (
        np.array([float(table.get(name, 0.0)) for name in names]) for names in (_ROTATION, _SHIFT)
    )
    return CameraRegistration(
        rotation=Rotation.from_rotvec(vector).as_matrix(), shift=shift, left=float("nan")
    )


def between(file: Robot, found: Robot) -> CameraRegistration:
    """Return where the camera of `found` stands from where `file` says."""
    one, two = frame_of(file), frame_of(found)
    rotation = two.rotation @ one.rotation.T
    return CameraRegistration(rotation=rotation, shift=two.shift - rotation @ one.shift, left=float("nan"))


def align(
    measured: Floats,
    predicted: Floats,
    *,
    rotations: Floats | None = None,
    lever: float = 0.0,
    mirrored: bool = False,
) -> CameraRegistration:
    """The rigid motion from `predicted` to `measured` points (n, 3) [m], robustly (Kabsch 1976, Cauchy
    weights by distance).

    `rotations` (m, 3, 3) are measured rotations times the transposes of predicted ones; each counts as points
    at `lever` [m]. What the points do not determine, as the rotation about a line of them, stays zero.
    `mirrored`: the best improper rotation instead.
    """
    weight = np.ones(len(measured))
    rotation, shift = np.eye(3), np.zeros(3)
    for _ in range(_ROUNDS):
        fraction = weight / weight.sum()
        middle, aim = fraction @ predicted, fraction @ measured
        spread = np.einsum("n,ni,nj->ij", fraction, measured - aim, predicted - middle)
        if rotations is not None and len(rotations):
            spread = spread + lever**2 * rotations.mean(0)
        if not mirrored:
            spread = spread + _PULL * float(np.linalg.norm(spread, 2)) * np.eye(3)
        U, _, V = np.linalg.svd(spread)
        sign = float(np.sign(np.linalg.det(U @ V)) or 1.0) * (-1.0 if mirrored else 1.0)
        rotation = U @ np.diag([1.0, 1.0, sign]) @ V
        shift = aim - rotation @ middle
        off = np.linalg.norm(measured - predicted @ rotation.T - shift, axis=1)
        weight = 1.0 / (1.0 + (off / max(2.0 * float(np.median(off)), 1e-12)) ** 2)
    return CameraRegistration(
        rotation=rotation, shift=shift, left=size(measured - predicted @ rotation.T - shift)
    )


def size(vectors: Floats) -> float:
    """Root mean square length of (n, 3) without the longest, which may be outliers."""
    squares = np.sort((vectors**2).sum(1))
    return float(np.sqrt(squares[: max(1, int(_COUNTED * len(squares)))].mean()))
