"""A serial arm that shares no code with the package: chain of homogeneous matrices."""

import numpy as np
from scipy.spatial.transform import Rotation

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
            rows = [c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s]
            frames.append(frames[-1] @ np.array([*rows, [0.0, sa, ca, d], [0.0, 0.0, 0.0, 1.0]]))
        return frames

    def frame(self, q: np.ndarray) -> np.ndarray:
        end = self.chain(q)[-1]
        x, y, z, w = Rotation.from_matrix(end[:3, :3]).as_quat()
        return np.array([*end[:3, 3], w, x, y, z])

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        frames = self.chain(q)
        axes = np.array([f[:3, 2] for f in frames[:-1]])
        arms = frames[-1][:3, 3] - np.array([f[:3, 3] for f in frames[:-1]])
        return np.concatenate([np.cross(axes, arms).T, axes.T])
