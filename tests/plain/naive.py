"""The rod once more, one robot at a time in plain numpy: slow, obvious, and the same discrete equations as
the kernels."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fastrod import Robot


def solve_u(m: np.ndarray, K: np.ndarray, u_star: np.ndarray, d: np.ndarray, T: np.ndarray) -> np.ndarray:
    """K (u - u*) + sum T d x t = m by Newton with a difference quotient."""

    def excess(u: np.ndarray) -> np.ndarray:
        q = np.array([0.0, 0.0, 1.0]) + np.cross(u, d)
        t = q / np.linalg.norm(q, axis=1, keepdims=True)
        return np.asarray(K * (u - u_star) + (T[:, None] * np.cross(d, t)).sum(0) - m)

    u = u_star + m / K
    for _ in range(30):
        here = excess(u)
        slope = np.stack([(excess(u + 1e-4 * e) - excess(u - 1e-4 * e)) / 2e-4 for e in np.eye(3)], axis=1)
        u = u - np.linalg.solve(slope, here)
    return u


def march(
    robot: Robot,
    n_steps: int,
    m0: np.ndarray,
    tension: np.ndarray,
    tip_force: np.ndarray,
    line_force: np.ndarray,
) -> dict[str, np.ndarray]:
    """Tip, rotation, end moment and path lengths of the tendons from the base moment and all tensions (no
    other loads)."""
    e3 = np.array([0.0, 0.0, 1.0])
    R, r, m = np.eye(3), np.zeros(3), np.array(m0, float)
    ends = robot.tendon_segment
    lengths = np.zeros(robot.n_tendons)
    left = robot.length
    for k, segment in enumerate(robot.segments):
        K = np.array([*segment.bending_stiffness, segment.torsional_stiffness])
        crossing = np.flatnonzero(ends >= k)
        d = np.array([[*robot.tendons[t].position(int(ends[t]) + 1)[k], 0.0] for t in crossing]).reshape(
            -1, 3
        )
        T = tension[crossing]
        h = segment.length / n_steps
        for _ in range(n_steps):
            n = [R.T @ (tip_force + line_force * (left - c * h)) for c in (0.0, 0.5, 0.5, 1.0)]
            u, slope, twist = [], [], []
            for stage in range(4):
                if stage == 0:
                    C, M, mz = np.eye(3), m, m[2]
                elif stage == 1:
                    C, M, mz = exp(0.5 * h * u[0]), m + 0.5 * h * slope[0], m[2] + 0.5 * h * twist[0]
                elif stage == 2:
                    C = exp(0.5 * h * u[1] + 0.125 * h * h * np.cross(u[0], u[1]))
                    M, mz = m + 0.5 * h * slope[1], m[2] + 0.5 * h * twist[1]
                else:
                    C, M, mz = exp(h * u[2]), m + h * slope[2], m[2] + h * twist[2]
                here = C.T @ M
                here[2] = mz
                u.append(solve_u(here, K, np.array(segment.precurvature), d, T))
                slope.append(-np.cross(C @ e3, n[stage]))
                twist.append(-np.cross(u[-1], here)[2])
                weight = h / 6.0 * (1.0, 2.0, 2.0, 1.0)[stage]
                r = r + weight * (R @ C @ e3)
                lengths[crossing] += weight * np.linalg.norm(e3 + np.cross(u[-1], d), axis=1)
            C = exp(h / 6.0 * (u[0] + 2 * u[1] + 2 * u[2] + u[3]) + h * h / 12.0 * np.cross(u[0], u[3]))
            end = C.T @ (m + h / 6.0 * (slope[0] + 2 * slope[1] + 2 * slope[2] + slope[3]))
            end[2] = m[2] + h / 6.0 * (twist[0] + 2 * twist[1] + 2 * twist[2] + twist[3])
            R, m, left = R @ C, end, left - h
    return {"position": r, "rotation": R, "moment": m, "length": lengths}


def exp(vector: np.ndarray) -> np.ndarray:
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())
