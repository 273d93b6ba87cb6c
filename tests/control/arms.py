"""A serial arm that shares no code with the package: chain of homogeneous matrices, numpy alone."""

from __future__ import annotations

import numpy as np

UR5 = [
    (0.0, 0.089159, np.pi / 2),
    (-0.425, 0.0, 0.0),
    (-0.39225, 0.0, 0.0),
    (0.0, 0.10915, np.pi / 2),
    (0.0, 0.09465, -np.pi / 2),
    (0.0, 0.0823, 0.0),
]
"""a [m], d [m], alpha [rad] of each joint (Denavit and Hartenberg), as the maker prints them."""


class DhArm:
    n_joints = 6

    def chain(self, q: np.ndarray) -> list[np.ndarray]:
        """World from each joint's frame, base first."""
        frames = [np.eye(4)]
        for angle, (a, d, alpha) in zip(q, UR5, strict=True):
            c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
            link = np.array(
                [
                    [c, -s * ca, s * sa, a * c],
                    [s, c * ca, -c * sa, a * s],
                    [0.0, sa, ca, d],
                    [0.0, 0.0, 0.0, 1.0],
                ]
            )
            frames.append(frames[-1] @ link)
        return frames

    def frame(self, q: np.ndarray) -> np.ndarray:
        end = self.chain(q)[-1]
        r = end[:3, :3]
        # the eigenvector of Bar-Itzhack's matrix
        m = np.array(
            [
                [r[0, 0] - r[1, 1] - r[2, 2], 0.0, 0.0, 0.0],
                [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], 0.0, 0.0],
                [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], 0.0],
                [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)],
            ]
        )
        x, y, z, w = np.linalg.eigh(m)[1][:, -1]
        return np.array([*end[:3, 3], w, x, y, z])

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        frames = self.chain(q)
        axes = np.array([f[:3, 2] for f in frames[:-1]])
        arms = frames[-1][:3, 3] - np.array([f[:3, 3] for f in frames[:-1]])
        return np.concatenate([np.cross(axes, arms).T, axes.T])
