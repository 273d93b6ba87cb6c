"""A branching airway made by code: a trachea that forks into two curved bronchi, as distances and as a
watertight mesh.

Frame: the entry lies at the origin, z runs into the trachea; lengths in metres. The lumen is the smooth union
of one tube for each bronchus; the trachea is common to both, which is wider by the smoothing. The wall is
what lies between the lumen and the same union with a larger radius, cut off at the entry and at the bronchi's
ends, where the lumen is open to the outside.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import pairwise, permutations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

TRACHEA = 0.03
"""Length of the straight section before the fork [m]."""
BEND = math.radians(60.0)
"""Angle by which a bronchus bends away from the trachea [rad]."""
BEND_RADIUS = 0.06
"""Radius of that bend [m]."""
OUTLET = 0.012
"""Length of the straight section after it [m]."""
BRANCHES = {"left": math.radians(160.0), "right": math.radians(20.0)}
"""Direction in which each bronchus bends, about z from x toward y [rad]."""
RADIUS = 0.006
"""Radius of the lumen of a bronchus [m]."""
WALL = 0.004
"""Thickness [m]."""
BLEND = 0.004
"""Distance over which the tubes melt into each other; the trachea's lumen is wider than a bronchus' by a
quarter of it [m]."""

_SPACING = 0.002  # m between the points of a tube's polyline: it cuts a bend's corner by 8 um
_CELL = 0.0018  # m
_SHORTEST = 0.05  # of an edge: a vertex keeps so far from the lattice points, for no face to be a sliver


def path_length() -> float:
    """Return the length from the entry to the end of either bronchus, along its middle [m]."""
    return TRACHEA + BEND_RADIUS * BEND + OUTLET


def heading(depth: float) -> float:
    """Angle between the trachea and a tube's middle at `depth` from the entry [rad]."""
    return min(max((depth - TRACHEA) / BEND_RADIUS, 0.0), BEND)


def middle(branch: str, depth: Floats) -> Floats:
    """(n, 3) points on the middle of the tube into `branch`, at depths (n,) along it; straight on before and
    beyond [m]."""
    angle = np.clip((depth - TRACHEA) / BEND_RADIUS, 0.0, BEND)
    beyond = np.maximum(depth - TRACHEA - BEND_RADIUS * BEND, 0.0)
    along = np.minimum(depth, TRACHEA) + BEND_RADIUS * np.sin(angle) + beyond * math.cos(BEND)
    aside = BEND_RADIUS * (1.0 - np.cos(angle)) + beyond * math.sin(BEND)
    toward = BRANCHES[branch]
    return np.stack([aside * math.cos(toward), aside * math.sin(toward), along], axis=-1)


def lumen_distance(points: Floats) -> Floats:
    """(n,) distance of points (n, 3) from the lumen's wall, negative inside; open ends do not count [m].

    Exact beside a single tube, a smooth bound around the fork.
    """
    return _union(points, before=0.05, beyond=0.05) - RADIUS


@lru_cache(maxsize=1)
def airway() -> tuple[Floats, Ints]:
    """(n_vertices, 3) [m] and (n_faces, 3) of the wall, watertight, counter-clockwise seen from outside; do
    not write to them.

    >>> vertices, faces = airway()
    >>> len(vertices) - len(faces) // 2  # two handles: the three ends of one wall are open
    -2
    """
    half_width = RADIUS + WALL + 2.0 * _CELL
    ends = np.concatenate([middle(branch, np.linspace(0.0, path_length(), 50)) for branch in BRANCHES])
    axes = [
        np.arange(low - half_width, high + half_width, _CELL)
        for low, high in zip(ends.min(axis=0), ends.max(axis=0), strict=True)
    ]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = _union(lattice, before=0.05, beyond=0.05)
    wall = np.maximum(distance - RADIUS - WALL, RADIUS - distance)
    wall = np.maximum(wall, -lattice[:, 2])
    for branch in BRANCHES:
        before, end = middle(branch, path_length() - np.array([_SPACING, 0.0]))
        direction = (end - before) / _SPACING
        wall = np.maximum(wall, (lattice - end) @ direction)
    vertices, faces = surface(wall.reshape([len(axis) for axis in axes]), _CELL)
    vertices += [axis[0] for axis in axes]
    vertices.flags.writeable = faces.flags.writeable = False
    return vertices, faces


def surface(values: Floats, cell: float) -> tuple[Floats, Ints]:
    """Zero level of `values` on a cubic lattice of edge `cell` [m] by marching tetrahedra: (n, 3) vertices,
    (m, 3) faces around the negative side, which must not meet the lattice's border. Each cube is six
    tetrahedra along its diagonal, so that neighbours share their edges and the surface is closed.
    """
    shape = np.array(values.shape)
    index_step = np.array([shape[1] * shape[2], shape[2], 1])
    flat = np.where(values.ravel() == 0.0, 1e-300, values.ravel())
    inside = values < 0.0
    mixed = np.zeros(shape - 1, int)
    for corner in np.ndindex(2, 2, 2):
        mixed += inside[tuple(slice(c, n - 1 + c) for c, n in zip(corner, shape, strict=True))]
    base = np.argwhere((mixed > 0) & (mixed < 8)) @ index_step
    sixth = []
    for order in permutations(range(3)):
        steps = np.cumsum([0, *(index_step[axis] for axis in order)])
        odd = order in ((0, 2, 1), (1, 0, 2), (2, 1, 0))
        sixth.append(base[:, None] + (steps[[0, 1, 3, 2]] if odd else steps))
    tetra = np.concatenate(sixth)
    below = flat[tetra] < 0.0
    edges = _crossed(tetra, below)
    _, first, names = np.unique(
        np.sort(edges, axis=-1).reshape(-1, 2) @ [len(flat), 1], return_index=True, return_inverse=True
    )
    start, end = np.sort(edges, axis=-1).reshape(-1, 2)[first].T
    fraction = np.clip(flat[start] / (flat[start] - flat[end]), _SHORTEST, 1.0 - _SHORTEST)[:, None]
    place = [np.stack(np.unravel_index(corner, tuple(shape)), axis=-1) * cell for corner in (start, end)]
    return place[0] + fraction * (place[1] - place[0]), names.reshape(-1, 3).astype(np.int64)


def _crossed(tetra: Ints, below: NDArray[np.bool_]) -> Ints:
    """(n_faces, 3, 2) lattice points at the ends of the edges on which each face has its corners; `tetra`
    right-handed."""
    faces = []
    even = [p for p in permutations(range(4)) if np.linalg.det(np.eye(4)[list(p)]) > 0.0]
    for one in range(4):
        a, b, c, d = next(p for p in even if p[0] == one)
        alone = below.sum(axis=1) == 1
        for rows, corners in (
            (alone & below[:, a], (b, c, d)),
            ((below.sum(axis=1) == 3) & ~below[:, a], (b, d, c)),
        ):
            faces.append(np.stack([tetra[rows][:, [a, k]] for k in corners], axis=1))
    for pair in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)):
        a, b, c, d = next(p for p in even if p[:2] == pair)
        t = tetra[(below.sum(axis=1) == 2) & below[:, a] & below[:, b]]
        halves = (((a, c), (a, d), (b, d)), ((a, c), (b, d), (b, c)))
        faces.extend(np.stack([t[:, list(edge)] for edge in half], axis=1) for half in halves)
    return np.concatenate(faces)


def _union(points: Floats, *, before: float, beyond: float) -> Floats:
    """Smooth minimum of the distances of points (n, 3) to the middles of the tubes, made longer at both ends
    [m]."""
    depth = np.arange(-before, path_length() + beyond + _SPACING, _SPACING)
    left, right = (_to_polyline(points, middle(branch, depth)) for branch in BRANCHES)
    mixed = np.maximum(BLEND - np.abs(left - right), 0.0)
    return np.asarray(np.minimum(left, right) - mixed**2 / (4.0 * BLEND))


def _to_polyline(points: Floats, line: Floats) -> Floats:
    """(n,) distance of points (n, 3) to a polyline (m, 3) [m]."""
    square = np.full(len(points), np.inf)
    for start, end in pairwise(line):
        along = end - start
        fraction = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
        away = points - start - fraction[:, None] * along
        square = np.minimum(square, np.einsum("ij,ij->i", away, away))
    return np.asarray(np.sqrt(square))
