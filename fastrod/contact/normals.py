"""Which side of a mesh a point is on: the normals of its faces, edges and vertices."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fastrod.types import Floats, Ints

FACE, EDGE_AB, EDGE_BC, EDGE_CA, VERTEX_A, VERTEX_B, VERTEX_C = range(7)
"""The features of a face, in the order of `pseudonormals`."""


def _unit(v: NDArray[Any], instead: NDArray[Any]) -> Floats:
    """(n, 3) rows of `v` at length 1; a row without a direction becomes that of `instead`."""
    size = np.linalg.norm(v, axis=1, keepdims=True)
    return np.where(size > 1e-12, v / np.where(size > 0.0, size, 1.0), instead)


def pseudonormals(vertices: Floats, faces: Ints) -> Floats:
    """(n_faces, 7, 3) outward unit normals of each face's features: the face, edges ab, bc, ca, vertices a,
    b, c.

    `vertices` is (n_vertices, 3) in any frame and unit, the result in the same frame; `faces` is (n_faces,
    3), counter-clockwise seen from outside, and faces that touch share their vertices (merge duplicates
    first). With q the closest point of a closed surface to p and n the normal of the feature that q lies on,
    p is outside where n . (p - q) > 0 (Baerentzen and Aanaes 2005):
    an edge has the sum of its faces' normals, a vertex their sum weighted by the angle of each face there. A
    sum of zero becomes the face's normal; a face without area takes the mean of its neighbours'.
    """
    n_vertices, n_faces = len(vertices), len(faces)
    corner = vertices[faces]
    edge = np.roll(corner, -1, axis=1) - corner  # ab, bc, ca
    area = np.cross(edge[:, 0], -edge[:, 2])
    longest = (edge**2).sum(-1).max(axis=1, keepdims=True)
    size = np.linalg.norm(area, axis=1, keepdims=True)
    flat = size <= 1e-14 * longest
    face = np.where(flat, 0.0, area / np.where(flat, 1.0, size))

    start, end = faces, np.roll(faces, -1, axis=1)
    key = np.minimum(start, end) * n_vertices + np.maximum(start, end)
    _, edge_of = np.unique(key.ravel(), return_inverse=True)
    n_edges = int(edge_of.max()) + 1 if n_faces else 0
    each = np.repeat(face, 3, axis=0)
    edge_sum = np.stack([np.bincount(edge_of, weights=w, minlength=n_edges) for w in each.T], axis=-1)[
        edge_of
    ]
    if flat.any():
        around = _unit(edge_sum.reshape(n_faces, 3, 3).sum(axis=1), np.array([[0.0, 0.0, 1.0]]))
        face = np.where(flat, around, face)

    back = np.roll(edge, 1, axis=1)  # ca, ab, bc: the edge that comes in
    sine = np.linalg.norm(np.cross(edge, back), axis=-1)
    angle = np.arctan2(sine, -(edge * back).sum(-1))
    weighted = (face[:, None, :] * angle[:, :, None]).reshape(-1, 3)
    vertex_sum = np.stack(
        [np.bincount(faces.ravel(), weights=w, minlength=n_vertices) for w in weighted.T], axis=-1
    )[faces.ravel()]

    each = np.repeat(face, 3, axis=0)
    normals: Floats = np.empty((n_faces, 7, 3))
    normals[:, FACE] = face
    normals[:, EDGE_AB:VERTEX_A] = _unit(edge_sum, each).reshape(n_faces, 3, 3)
    normals[:, VERTEX_A:] = _unit(vertex_sum, each).reshape(n_faces, 3, 3)
    return normals
