"""`[Obstacle] -> Surfaces`: every mesh's triangles in a bounding-volume hierarchy, every simple shape as its
numbers."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from fastrod.contact import direct
from fastrod.contact.geometry import Obstacle
from fastrod.contact.normals import pseudonormals
from fastrod.contact.primitive import primitive_of
from fastrod.kernels.contact.bvh import LEAF_CODE
from fastrod.types import Floats, Ints, Surfaces

_LEAF = LEAF_CODE - 1  # triangles at most
_EVEN = 1e-8  # of a mesh's size: a neighbour that rises less above a face does not


def pack(obstacles: Sequence[Obstacle], by_fcl: bool = False) -> Surfaces:
    """The arrays that the kernels read; obstacle k of the list is row k. With `by_fcl` FCL measures the
    distances of meshes."""
    boxes = [np.zeros((0, 12))]
    links = [np.zeros((0, 2), np.int64)]
    corners = [np.zeros((0, 9))]
    normals = [np.zeros((0, 7, 3))]
    roots = []
    n_nodes = n_faces = 0
    for obstacle in obstacles:
        if obstacle.shape != "mesh":
            roots.append(0)
            continue
        box, link, root, corner, normal = _hierarchy(obstacle)
        leaf = link < 0
        links.append(np.where(leaf, link - LEAF_CODE * n_faces, link + n_nodes))
        roots.append(root - LEAF_CODE * n_faces if root < 0 else root + n_nodes)
        boxes.append(box)
        corners.append(corner)
        normals.append(normal)
        n_nodes, n_faces = n_nodes + len(box), n_faces + len(corner)
    return Surfaces(
        primitive=addresses(obstacles, by_fcl),
        size=np.array([_size(o, by_fcl) for o in obstacles], float).reshape(-1, 3),
        sphere=np.array([_ball(o) for o in obstacles], float).reshape(-1, 4),
        convex=np.array([_is_convex(o) for o in obstacles], bool),
        friction=np.array([o.friction for o in obstacles], float),
        compliance=np.array([1.0 / o.stiffness for o in obstacles], float),
        body=np.arange(len(obstacles)),
        mobility=np.zeros((len(obstacles), 6, 6)),
        center=np.zeros((len(obstacles), 3)),
        ahead=np.zeros((len(obstacles), 6)),
        root=np.array(roots, np.int64),
        box=np.concatenate(boxes),
        link=np.concatenate(links),
        corner=np.concatenate(corners),
        normal=np.concatenate(normals),
    )


def addresses(obstacles: Sequence[Obstacle], by_fcl: bool = False) -> Ints:
    """(n_obstacles, 3) `Surfaces.primitive` in this process. Raises `InputError` where a shape is none."""
    found = np.zeros((len(obstacles), 3), np.int64)
    for row, o in zip(found, obstacles, strict=True):
        if o.shape != "mesh":
            primitive = primitive_of(o.shape)
            primitive.check(o.size)
            row[:2] = primitive.addresses
        elif by_fcl:
            row[2] = direct.address()
    return found


def _size(o: Obstacle, by_fcl: bool) -> tuple[float, float, float]:
    return (float(direct.number_of(o)), 0.0, 0.0) if by_fcl and o.shape == "mesh" else o.size


def _ball(o: Obstacle) -> tuple[float, float, float, float]:
    """Centre and radius of a ball that holds the obstacle."""
    if o.shape == "mesh":
        low, high = o.vertices.min(0), o.vertices.max(0)
        centre = 0.5 * (low + high)
        return (*centre.tolist(), float(np.linalg.norm(o.vertices - centre, axis=1).max()))
    return 0.0, 0.0, 0.0, primitive_of(o.shape).radius(o.size)


@lru_cache(maxsize=64)
def _is_convex(o: Obstacle) -> bool:
    """A simple shape is. A mesh is where it is closed, no face's neighbour rises above it, and its surface is
    one sphere (Euler: corners - edges + faces = 2)."""
    if o.shape != "mesh":
        return True
    import trimesh

    mesh = trimesh.Trimesh(o.vertices, o.faces, process=False)
    rises = mesh.face_adjacency_projections.max(initial=0.0)
    return bool(o.closed and mesh.euler_number == 2 and rises < _EVEN * mesh.scale)


@lru_cache(maxsize=64)
def _hierarchy(obstacle: Obstacle) -> tuple[Floats, Ints, int, Floats, Floats]:
    """Boxes, links, root, corners and pseudonormals of one mesh, built once for each Obstacle.

    Split at the median of the triangles' centres along the longest side of their box, level by level.
    """
    corner = obstacle.vertices[obstacle.faces]
    low, high, centre = corner.min(1), corner.max(1), corner.mean(1)
    order = np.arange(len(corner))
    starts, ends = np.array([0]), np.array([len(corner)])
    box: list[Floats] = []
    link: list[Ints] = []
    n_nodes = 0
    root = _leaf_link(starts, ends)[0] if ends[0] <= _LEAF else 0
    while (inner := ends - starts > _LEAF).any():
        starts, ends = starts[inner], ends[inner]
        sizes = ends - starts
        owner = np.repeat(np.arange(len(starts)), sizes)
        where = np.concatenate([np.arange(a, b) for a, b in zip(starts, ends, strict=True)])
        c = centre[order[where]]
        first = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        extent = np.maximum.reduceat(c, first) - np.minimum.reduceat(c, first)
        key = c[np.arange(len(c)), extent.argmax(1)[owner]]
        order[where] = order[where][np.lexsort((key, owner))]
        middle = (starts + ends) // 2
        children = np.stack([starts, middle, middle, ends], axis=1).reshape(-1, 2)  # left and right of each
        begin, end = children[:, 0], children[:, 1]
        box.append(
            np.concatenate(
                [_reduce(np.minimum, low[order], begin, end), _reduce(np.maximum, high[order], begin, end)],
                axis=1,
            )
        )
        deeper = end - begin > _LEAF
        below = n_nodes + len(starts) + np.cumsum(deeper) - 1
        link.append(np.where(deeper, below, _leaf_link(begin, end)))
        n_nodes += len(starts)
        starts, ends = begin, end
    boxes = np.concatenate(box).reshape(-1, 12) if box else np.zeros((0, 12))
    links = np.concatenate(link).reshape(-1, 2) if link else np.zeros((0, 2), np.int64)
    normal = pseudonormals(obstacle.vertices, obstacle.faces)[order]
    return (
        boxes,
        links,
        int(root),
        np.ascontiguousarray(corner[order].reshape(-1, 9)),
        np.ascontiguousarray(normal),
    )


def _leaf_link(begin: Ints, end: Ints) -> Ints:
    return np.asarray(-1 - (LEAF_CODE * begin + (end - begin)))


def _reduce(how: np.ufunc, a: Floats, begin: Ints, end: Ints) -> Floats:
    """(n_ranges, 3) smallest or largest over adjacent pairs of ranges."""
    edges = np.stack([begin, end], axis=1).ravel()
    padded = np.concatenate([a, a[-1:]])
    return np.asarray(how.reduceat(padded, edges)[::2])
