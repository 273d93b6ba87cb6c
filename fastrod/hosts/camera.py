"""`HostCamera`: pictures of a PyBullet world, with metric depth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fastrod.checks import Bound, check, checked_array
from fastrod.errors import InputError
from fastrod.hosts.bullet import Bullet
from fastrod.types import Floats


class Image(NamedTuple):
    """Picture of a camera; rows from the top, columns from the left."""

    rgb: NDArray[np.uint8]
    """(height, width, 3) red, green, blue."""
    depth: Floats
    """(height, width) distance along the optical axis [m]; inf where nothing is nearer than
    `HostCamera.far`."""
    segmentation: NDArray[np.int64]
    """(height, width) body in each pixel, as PyBullet numbers it; -1 where there is none."""


class CameraView(NamedTuple):
    """Position and target of a camera, world."""

    eye: ArrayLike
    """(3,) optical centre [m]."""
    target: ArrayLike
    """(3,) point in the middle of the picture [m]."""
    up: ArrayLike = (0.0, 0.0, 1.0)
    """(3,) what is up in the picture; any length, not along the line of sight."""


@dataclass(frozen=True, kw_only=True)
class HostCamera:
    """A pinhole camera. It draws on the CPU (PyBullet's TinyRenderer), so it needs neither a display nor a
    graphics card.

    >>> HostCamera(width=64, height=48).fov
    60.0
    """

    width: Annotated[int, Bound(least=1)] = 640
    """Pixels of a row."""
    height: Annotated[int, Bound(least=1)] = 480
    """Pixels of a column."""
    fov: Annotated[float, Bound(above=0.0, below=180.0, unit="deg")] = 60.0
    """Vertical angle of view [deg]."""
    near: float = 0.01
    """Nearest distance along the optical axis that is drawn [m]."""
    far: float = 5.0
    """Farthest distance along the optical axis that is drawn [m]."""

    def __post_init__(self) -> None:
        check(self, "Camera.")
        if not 0.0 < self.near < self.far < math.inf:
            raise InputError(
                f"Camera.near is {self.near!r} m and Camera.far is {self.far!r} m; it must be 0 < near < far."
            )

    def look(self, bullet: Any, eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Image:
        """A picture of the world `bullet` from `eye` toward `target`, with `up` upward in it: each (3,),
        world [m].

        Raises `HostError` where there is no such world, `InputError` where the three give no view.
        """
        b = Bullet(bullet)
        view = b.computeViewMatrix(*_checked(eye, target, up))
        projection = b.computeProjectionMatrixFOV(self.fov, self.width / self.height, self.near, self.far)
        _, _, rgba, z, mask = b.getCameraImage(
            self.width, self.height, view, projection, renderer=b.ER_TINY_RENDERER
        )
        size = (self.height, self.width)
        body = np.reshape(mask, size).astype(np.int64)
        # the z-buffer holds 0 at the near plane and 1 at the far one, linear in 1 / depth
        depth = self.far * self.near / (self.far - (self.far - self.near) * np.reshape(z, size).astype(float))
        return Image(
            np.reshape(rgba, (*size, 4))[..., :3].astype(np.uint8), np.where(body < 0, np.inf, depth), body
        )


def _checked(*given: ArrayLike) -> list[list[float]]:
    """Eye, target and up as PyBullet takes them."""
    eye, target, up = vectors = [
        checked_array(f"the camera's {name}", value, [(3,)], "world [m]")
        for name, value in zip(("eye", "target", "up"), given, strict=True)
    ]
    sight = target - eye
    if not np.linalg.norm(np.cross(sight, up)) > 1e-9 * np.linalg.norm(sight) * np.linalg.norm(up):
        raise InputError(
            f"the camera looks along {sight.tolist()} with {up.tolist()} upward; the two must be vectors in "
            "different directions."
        )
    return [v.tolist() for v in vectors]
