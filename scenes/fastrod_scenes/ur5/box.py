"""`Box`: a closed box with one narrow entry and a coloured cube in each of its inner corners, in a PyBullet
world."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fastrod.errors import RobotError
from fastrod.hosts import Bullet
from fastrod.types import Floats

CORNERS = tuple(
    f"{depth} {side} {height}"
    for depth, side, height in (
        ("back", "left", "top"),
        ("back", "left", "bottom"),
        ("back", "right", "bottom"),
        ("back", "right", "top"),
        ("front", "right", "top"),
        ("front", "right", "bottom"),
        ("front", "left", "bottom"),
        ("front", "left", "top"),
    )
)
"""In the order seen through the entry, each beside the one before it."""
COLORS = (
    (0.90, 0.10, 0.10),
    (0.10, 0.70, 0.15),
    (0.10, 0.25, 0.95),
    (0.95, 0.85, 0.05),
    (0.85, 0.10, 0.80),
    (0.05, 0.80, 0.85),
    (1.00, 0.50, 0.00),
    (0.45, 0.20, 0.60),
)
"""Red, green, blue of the corners' cubes."""
_WOOD, _PLINTH = (0.80, 0.72, 0.60, 1.0), (0.45, 0.47, 0.50, 1.0)


class BoxPiece(NamedTuple):
    """A plate: a box of its own, rotated about x."""

    middle: tuple[float, float, float]
    """World [m]."""
    half: tuple[float, float, float]
    """Half of its size along its own axes [m]."""
    angle: float = 0.0
    """About x [rad]."""
    color: tuple[float, float, float, float] = _WOOD
    """RGBA."""


@dataclass(frozen=True, kw_only=True)
class Box:
    """A box of thin walls on a plinth; the entry, an octagon, is in the middle of its front wall, which faces
    -x.

    >>> Box().corner(0).round(3).tolist()
    [1.054, 0.2, 0.625]
    """

    front: float = 0.70
    """x of the front wall's outer face, world [m]."""
    height: float = 0.45
    """z of the entry's middle, world [m]; its y is 0."""
    inner: tuple[float, float, float] = (0.35, 0.40, 0.35)
    """Depth, width and height inside [m]."""
    wall: float = 0.004
    """Thickness [m]."""
    entry: float = 0.05
    """Half of the entry's width, between opposite sides of the octagon [m]; 0: no entry."""
    cube: float = 0.035
    """Side of a corner's cube [m]."""
    marked: tuple[int, ...] = tuple(range(8))
    """Numbers of the corners, in `CORNERS`, that have a cube."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.entry < 0.5 * min(self.inner[1:]) or not self.wall > 0.0:
            raise RobotError(
                f"a box with an entry of half width {self.entry!r} m and walls of "
                f"{self.wall!r} m cannot be built."
            )

    def corner(self, k: int) -> Floats:
        """(3,) inner corner, world [m]."""
        depth, side, height = CORNERS[k].split()
        _, width, tall = self.inner
        x = self.front + self.wall + (self.inner[0] if depth == "back" else 0.0)
        y = 0.5 * width if side == "left" else -0.5 * width
        return np.array([x, y, self.height + (0.5 * tall if height == "top" else -0.5 * tall)])

    def cube_at(self, k: int) -> Floats:
        """(3,) middle of the cube in a corner, world [m]."""
        middle = np.array([self.front + self.wall + 0.5 * self.inner[0], 0.0, self.height])
        return np.asarray(self.corner(k) + 0.5 * self.cube * np.sign(middle - self.corner(k)))

    def off_cube(self, k: int, points: Floats) -> Floats:
        """(n,) distance of world points (n, 3) from the surface of the cube in a corner [m]."""
        beyond = np.abs(points - self.cube_at(k)) - 0.5 * self.cube
        return np.asarray(
            np.abs(np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0))
        )

    def pieces(self) -> list[BoxPiece]:
        """Walls, and the plinth below them."""
        x, (a, b, c), t, z = self.front + self.wall, self.inner, self.wall, self.height
        low = z - 0.5 * c - t
        middle, whole = (x + 0.5 * a, 0.0, z), 0.5 * c + t
        pieces = [BoxPiece((x + a + 0.5 * t, 0.0, z), (0.5 * t, 0.5 * b + t, whole))]
        for sign in (-1.0, 1.0):
            pieces.append(BoxPiece((middle[0], sign * 0.5 * (b + t), z), (0.5 * a, 0.5 * t, whole)))
            pieces.append(BoxPiece((middle[0], 0.0, z + sign * 0.5 * (c + t)), (0.5 * a, 0.5 * b, 0.5 * t)))
        pieces.append(BoxPiece((middle[0], 0.0, 0.5 * low), (0.35 * a, 0.35 * b, 0.5 * low), color=_PLINTH))
        return pieces + self._front()

    def _front(self) -> list[BoxPiece]:
        x, (_, b, c), t, e = self.front + 0.5 * self.wall, self.inner, 0.5 * self.wall, self.entry
        wide, tall = 0.5 * b + self.wall, 0.5 * c + self.wall
        if e == 0.0:
            return [BoxPiece((x, 0.0, self.height), (t, wide, tall))]
        pieces = []
        for sign in (-1.0, 1.0):
            pieces.append(BoxPiece((x, sign * 0.5 * (wide + e), self.height), (t, 0.5 * (wide - e), tall)))
            pieces.append(BoxPiece((x, 0.0, self.height + sign * 0.5 * (tall + e)), (t, e, 0.5 * (tall - e))))
        side = e * math.tan(math.pi / 8.0)  # half of one; the square's corner is as far beyond it
        for k in range(4):
            angle = math.pi / 4.0 + k * math.pi / 2.0
            y, z = (e + 0.5 * side) * math.cos(angle), (e + 0.5 * side) * math.sin(angle)
            pieces.append(BoxPiece((x, y, self.height + z), (t, 0.5 * side, side), angle))
        return pieces

    def build(self, world: Bullet) -> tuple[int, dict[int, int]]:
        """Body of the walls, and bodies of the cubes by the numbers of their corners; the cubes touch
        nothing."""
        pieces = self.pieces()
        half, places = [piece.half for piece in pieces], [piece.middle for piece in pieces]
        quaternions = [
            (math.sin(0.5 * piece.angle), 0.0, 0.0, math.cos(0.5 * piece.angle)) for piece in pieces
        ]
        kinds = [world.GEOM_BOX] * len(pieces)
        solid = world.createCollisionShapeArray(
            shapeTypes=kinds,
            halfExtents=half,
            collisionFramePositions=places,
            collisionFrameOrientations=quaternions,
        )
        seen = world.createVisualShapeArray(
            shapeTypes=kinds,
            halfExtents=half,
            visualFramePositions=places,
            visualFrameOrientations=quaternions,
            rgbaColors=[piece.color for piece in pieces],
        )
        walls: int = world.createMultiBody(0.0, solid, seen)
        cubes = {}
        for k in self.marked:
            shape = world.createVisualShape(
                world.GEOM_BOX, halfExtents=[0.5 * self.cube] * 3, rgbaColor=[*COLORS[k], 1.0]
            )
            cubes[k] = world.createMultiBody(0.0, -1, shape, self.cube_at(k).tolist())
        return walls, cubes
