"""Triangles of simple bodies, for pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fastrod.types import Floats, Ints

_FACES = np.array(
    [
        [0, 2, 1],
        [1, 2, 3],
        [4, 5, 6],
        [5, 7, 6],
        [0, 1, 4],
        [1, 5, 4],
        [2, 6, 3],
        [3, 6, 7],
        [0, 4, 2],
        [2, 4, 6],
        [1, 3, 5],
        [3, 7, 5],
    ]
)


def box_mesh(
    size: Sequence[float], position: Sequence[float], rotation: Floats | None = None
) -> tuple[Floats, Ints]:
    """Vertices (8, 3) world [m] and faces (12, 3) of a box with these edges [m], its middle at `position`
    [m], turned by `rotation` (3, 3)."""
    corners = 0.5 * np.array(size) * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return np.array(position) + (corners if rotation is None else corners @ np.asarray(rotation).T), _FACES
