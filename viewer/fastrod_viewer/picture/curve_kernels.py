"""Compiled kernels for curves: cross-sections between nodes, and straight pieces between cross-sections.

A picture has a thousand of them, thirty times a second. All are in one file, by which numba keys its cache.
"""

from __future__ import annotations

import math

import numpy as np

from fastrod.kernels.jit import entry
from fastrod.types import Floats, Ints


@entry
def quaternions(rotation: Floats, found: Floats) -> None:
    """Fill `found` (n, p, 4), w x y z, of rotation matrices (n, p, 3, 3), by the largest component (Shepperd
    1978); the sign does not jump from one point of a rod to the next."""
    for i in range(len(rotation)):
        for j in range(rotation.shape[1]):
            r, q = rotation[i, j], found[i, j]
            trace = r[0, 0] + r[1, 1] + r[2, 2]
            if trace > max(r[0, 0], r[1, 1], r[2, 2]):
                q[0], q[1], q[2], q[3] = 1.0 + trace, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
            elif r[0, 0] >= max(r[1, 1], r[2, 2]):
                q[0] = r[2, 1] - r[1, 2]
                q[1] = 1.0 + 2.0 * r[0, 0] - trace
                q[2] = r[0, 1] + r[1, 0]
                q[3] = r[0, 2] + r[2, 0]
            elif r[1, 1] >= r[2, 2]:
                q[0] = r[0, 2] - r[2, 0]
                q[1] = r[0, 1] + r[1, 0]
                q[2] = 1.0 + 2.0 * r[1, 1] - trace
                q[3] = r[1, 2] + r[2, 1]
            else:
                q[0] = r[1, 0] - r[0, 1]
                q[1] = r[0, 2] + r[2, 0]
                q[2] = r[1, 2] + r[2, 1]
                q[3] = 1.0 + 2.0 * r[2, 2] - trace
            size = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
            if j > 0:
                before = found[i, j - 1]
                if q[0] * before[0] + q[1] * before[1] + q[2] * before[2] + q[3] * before[3] < 0.0:
                    size = -size
            for c in range(4):
                q[c] /= size


@entry
def sample(
    position: Floats,
    tangent: Floats,
    quaternion: Floats,
    arclength: Floats,
    n_steps: int,
    segment: Ints,
    fraction: Floats,
    at: Floats,
    orientation: Floats,
    interval: Ints,
    interval_fraction: Floats,
) -> None:
    """Fill `at` (n, m, 3), `orientation` (n, m, 4), `interval` (n, m) and `interval_fraction` (n, m) at
    `fraction` (m,) of `segment` (m,).

    Positions by cubic Hermite polynomials of position (n, p, 3) and tangent (n, p, 3), rotations by
    normalised lerp of quaternion (n, p, 4); nodes need not be even: where forces act on points, nodes stand
    at them.
    """
    for i in range(len(position)):
        s = arclength[i]
        for j in range(len(segment)):
            first, last = segment[j] * n_steps, (segment[j] + 1) * n_steps
            wanted = s[first] + fraction[j] * (s[last] - s[first])
            k = first
            while k < last - 1 and s[k + 1] <= wanted:
                k += 1
            h = max(s[k + 1] - s[k], 1e-12)
            t = min(max((wanted - s[k]) / h, 0.0), 1.0)
            r = 1.0 - t
            weight = t * t * (3.0 - 2.0 * t)
            for c in range(3):
                p0, p1 = position[i, k, c], position[i, k + 1, c]
                at[i, j, c] = (
                    p0 + weight * (p1 - p0) + t * r * h * (r * tangent[i, k, c] - t * tangent[i, k + 1, c])
                )
            size = 0.0
            for c in range(4):
                orientation[i, j, c] = quaternion[i, k, c] + t * (
                    quaternion[i, k + 1, c] - quaternion[i, k, c]
                )
                size += orientation[i, j, c] ** 2
            size = math.sqrt(size)
            for c in range(4):
                orientation[i, j, c] /= size
            interval[i, j], interval_fraction[i, j] = k, t


@entry
def offset_pieces(
    at: Floats,
    orientation: Floats,
    source: Ints,
    offset: Floats,
    n_pieces: int,
    centre: Floats,
    along: Floats,
    length: Floats,
    bend: Floats,
) -> None:
    """Compute straight pieces of lines that run parallel to rods, each through one segment.

    Cross-sections `at` (n, q, n_pieces + 1, 3) and `orientation` (n, q, n_pieces + 1, 4); line c runs through
    those of `source[c]`, at `offset` (1 or n, m, 2) along d1 and d2. Fill `centre` (n, m, n_pieces, 3),
    `along` (n, m, n_pieces, 4), whose z is along the piece, `length` and `bend` (n, m, n_pieces), the change
    of the rod's tangent over the piece. In the middle of an arc the tangent is parallel to the chord, so that
    a line in the middle of the rod takes the rod's own rotation.
    """
    point, q = np.empty((2, 3)), np.empty(4)
    d = np.empty((2, 3, 3))  # at both ends of a piece: d1, d2, d3
    for i in range(len(at)):
        row = min(i, len(offset) - 1)
        for c in range(len(source)):
            k = source[c]
            x, y = offset[row, c, 0], offset[row, c, 1]
            for j in range(n_pieces + 1):
                a = orientation[i, k, j, 0]
                b = orientation[i, k, j, 1]
                u = orientation[i, k, j, 2]
                v = orientation[i, k, j, 3]
                d[0], point[0] = d[1], point[1]
                d[1, 0, 0] = 1.0 - 2.0 * (u * u + v * v)
                d[1, 0, 1] = 2.0 * (b * u + a * v)
                d[1, 0, 2] = 2.0 * (b * v - a * u)
                d[1, 1, 0] = 2.0 * (b * u - a * v)
                d[1, 1, 1] = 1.0 - 2.0 * (b * b + v * v)
                d[1, 1, 2] = 2.0 * (u * v + a * b)
                d[1, 2, 0] = 2.0 * (b * v + a * u)
                d[1, 2, 1] = 2.0 * (u * v - a * b)
                d[1, 2, 2] = 1.0 - 2.0 * (b * b + u * u)
                for e in range(3):
                    point[1, e] = at[i, k, j, e] + x * d[1, 0, e] + y * d[1, 1, e]
                if j == 0:
                    continue
                size = change = norm = 0.0
                for e in range(4):
                    q[e] = orientation[i, k, j - 1, e] + orientation[i, k, j, e]
                    norm += q[e] ** 2
                for e in range(3):
                    size += (point[1, e] - point[0, e]) ** 2
                    change += (d[1, 2, e] - d[0, 2, e]) ** 2
                    centre[i, c, j - 1, e] = 0.5 * (point[0, e] + point[1, e])
                q /= math.sqrt(norm)
                size = math.sqrt(size)
                length[i, c, j - 1], bend[i, c, j - 1] = size, math.sqrt(change)
                if (x == 0.0 and y == 0.0) or size < 1e-30:
                    along[i, c, j - 1] = q
                    continue
                # the shortest rotation from the rod's middle tangent to the chord, then the rod's: r q
                mx = 2.0 * (q[1] * q[3] + q[0] * q[2])
                my = 2.0 * (q[2] * q[3] - q[0] * q[1])
                mz = 1.0 - 2.0 * (q[1] ** 2 + q[2] ** 2)
                cx = (point[1, 0] - point[0, 0]) / size
                cy = (point[1, 1] - point[0, 1]) / size
                cz = (point[1, 2] - point[0, 2]) / size
                w = 1.0 + mx * cx + my * cy + mz * cz
                rx = my * cz - mz * cy
                ry = mz * cx - mx * cz
                rz = mx * cy - my * cx
                norm = math.sqrt(w * w + rx * rx + ry * ry + rz * rz)
                w, rx, ry, rz = w / norm, rx / norm, ry / norm, rz / norm
                along[i, c, j - 1, 0] = w * q[0] - rx * q[1] - ry * q[2] - rz * q[3]
                along[i, c, j - 1, 1] = w * q[1] + rx * q[0] + ry * q[3] - rz * q[2]
                along[i, c, j - 1, 2] = w * q[2] - rx * q[3] + ry * q[0] + rz * q[1]
                along[i, c, j - 1, 3] = w * q[3] + rx * q[2] - ry * q[1] + rz * q[0]
