"""scipy as a peer of fastrod: one segment with four tendons, solved by shooting, as lean as scipy lets it be.

The slope of the rod comes in three kinds: written with numpy, as most people would; in plain scalar
Python, which is several times as fast; and that function compiled by numba, which leaves scipy's own time.
"""

from __future__ import annotations

import contextlib
import functools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from cases import Array
from fastrod import Robot
from report import Measurement

Tendons: TypeAlias = tuple[tuple[float, float, float], ...]  # position d_x, d_y [m] and tension [N] of each
Points: TypeAlias = Sequence[tuple[Array, Sequence[float], Array]]
"""Tendon lengths (4,) [m], tip force and line force (6) [N, N/m], true tip (3,) [m]."""
N_TENDONS = 4
N_STATE = 15 + N_TENDONS  # position, rotation row by row, curvature, path length of each tendon


def rod_slope(s: float, y: Any, load: Any, rod: Any, tendons: Any, out: Any) -> Any:
    """d state / ds of one cross-section (Rucker and Webster 2011); with tensions of zero it is the paper's
    reduced model.

    `load` tip force [N] and uniform line force [N/m], world (6); `rod` length [m], EI_x, EI_y, GJ [N m^2];
    `tendons` (4, 3) position d_x, d_y [m] and tension [N].
    """
    length, kx, ky, kz = rod
    left = length - s
    nx, ny, nz = load[0] + left * load[3], load[1] + left * load[4], load[2] + left * load[5]
    r11, r12, r13, r21, r22, r23, r31, r32, r33 = y[3], y[4], y[5], y[6], y[7], y[8], y[9], y[10], y[11]
    ux, uy, uz = y[12], y[13], y[14]
    mx, my, mz = kx * ux, ky * uy, kz * uz
    axx, axy, axz, ayy, ayz, azz = kx, 0.0, 0.0, ky, 0.0, kz
    i = 15
    for dx, dy, tension in tendons:
        b = dx * dx + dy * dy
        p = 1.0 + ux * dy - uy * dx
        q = math.sqrt(p * p + b * uz * uz)
        out[i] = q
        i += 1
        # c = d|q|/du, and T/|q| (|d|^2 I - d d^T - c c^T) is the tendon's part of the stiffness
        if tension != 0.0:
            cx, cy, cz = dy * p / q, -dx * p / q, b * uz / q
            k = tension / q
            mx, my, mz = mx + tension * cx, my + tension * cy, mz + tension * cz
            axx, axy, axz = axx + k * (dy * dy - cx * cx), axy - k * (dx * dy + cx * cy), axz - k * cx * cz
            ayy, ayz, azz = ayy + k * (dx * dx - cy * cy), ayz - k * cy * cz, azz + k * (b - cz * cz)
    gx = uz * my - uy * mz + r12 * nx + r22 * ny + r32 * nz  # -(u x m + e3 x R^T n)
    gy = ux * mz - uz * mx - (r11 * nx + r21 * ny + r31 * nz)
    gz = uy * mx - ux * my
    bxx, bxy, bxz = ayy * azz - ayz * ayz, axz * ayz - axy * azz, axy * ayz - axz * ayy
    d = 1.0 / (axx * bxx + axy * bxy + axz * bxz)
    out[0], out[1], out[2] = r13, r23, r33
    out[3], out[4], out[5] = r12 * uz - r13 * uy, r13 * ux - r11 * uz, r11 * uy - r12 * ux
    out[6], out[7], out[8] = r22 * uz - r23 * uy, r23 * ux - r21 * uz, r21 * uy - r22 * ux
    out[9], out[10], out[11] = r32 * uz - r33 * uy, r33 * ux - r31 * uz, r31 * uy - r32 * ux
    out[12] = d * (bxx * gx + bxy * gy + bxz * gz)
    out[13] = d * (bxy * gx + (axx * azz - axz * axz) * gy + (axy * axz - axx * ayz) * gz)
    out[14] = d * (bxz * gx + (axy * axz - axx * ayz) * gy + (axx * ayy - axy * axy) * gz)
    return out


def array_slope(s: float, y: Array, load: Array, rod: Array, tendons: Array) -> Array:
    """The same slope as one writes it with numpy; `load` (6), `rod` (4), `tendons` (4, 3) as there."""
    rotation, u, n = y[3:12].reshape(3, 3), y[12:15], load[:3] + (rod[0] - s) * load[3:]
    hat = np.array([[0.0, -u[2], u[1]], [u[2], 0.0, -u[0]], [-u[1], u[0], 0.0]])
    dx, dy, tension = tendons.T
    square = dx * dx + dy * dy
    p = 1.0 + u[0] * dy - u[1] * dx
    q = np.sqrt(p * p + square * u[2] ** 2)
    m, stiffness = rod[1:] * u, np.diag(rod[1:])
    if tension.any():
        k = tension / q
        c = np.stack([dy * p, -dx * p, square * u[2]]) / q
        d = np.stack([dx, dy, np.zeros(N_TENDONS)])
        m = m + c @ tension
        stiffness = stiffness + (k * square).sum() * np.eye(3) - (d * k) @ d.T - (c * k) @ c.T
    moment, load_here = hat @ m, rotation.T @ n
    moment[0] -= load_here[1]
    moment[1] += load_here[0]
    change = -np.linalg.solve(stiffness, moment)
    return np.concatenate([rotation[:, 2], (rotation @ hat).ravel(), change, q])


@functools.cache
def compiled_slope() -> Callable[..., Any]:
    """`rod_slope` as machine code, compiled once in this process."""
    import numba

    made: Callable[..., Any] = numba.njit(error_model="numpy")(rod_slope)
    return made


@dataclass
class Shooter:
    """One robot of one segment and four tendons, shooting with scipy; warm after the first solve."""

    robot: Robot
    slope: Literal["arrays", "scalars", "compiled"]
    integrator: str = "RK23"
    rtol: float = 1e-3
    atol: float = 1e-6
    """Absolute tolerance of lengths [m]; of the rotation's entries this over the length, of curvature over
    its square."""
    ftol: float = 1e-8  # where the search ends, ftol and xtol of least_squares
    stop: float = 0.0
    """Largest boundary residual at which the search ends at once [m]; 0: where least_squares ends."""

    def __post_init__(self) -> None:
        (segment,) = self.robot.segments
        self.paper = segment.mode == "paper"
        self.rod = (segment.length, *segment.bending_stiffness, segment.torsional_stiffness)
        self.places = [tendon.position(1)[0] for tendon in segment.tendons]
        self.compliance = np.array([tendon.compliance for tendon in segment.tendons])
        length, stiffness = self.rod[:2]
        tension = stiffness / (length * math.hypot(*self.places[0]))
        full = np.array([stiffness / length] * 3 + [tension] * N_TENDONS)
        self.unit = np.full(2, 1.0 / length) if self.paper else full
        self.tolerance = self.atol / length ** np.repeat([0, 1, 2, 0], [3, 9, 3, N_TENDONS])
        self.x = np.zeros(len(self.unit))
        self.passes = 0

    def slope_of(self, load: Sequence[float], tendons: Tendons) -> Callable[[float, Array], Any]:
        """f(s, y) as `solve_ivp` wants it."""
        rod = self.rod
        if self.slope == "arrays":
            arrays = np.array(load), np.array(rod), np.array(tendons)
            return lambda s, y: array_slope(s, y, *arrays)
        if self.slope == "compiled":
            slope = compiled_slope()
            return lambda s, y: slope(s, y, load, rod, tendons, np.empty(N_STATE))
        out = [0.0] * N_STATE
        return lambda s, y: rod_slope(s, y.tolist(), load, rod, tendons, out)

    def start(self, x: Array) -> tuple[Array, Tendons]:
        """State at the base and tendons with their tensions, for the unknowns `x`, each in its unit."""
        value = x * self.unit
        tension = [0.0] * N_TENDONS if self.paper else value[3:].tolist()
        tendons = tuple((dx, dy, t) for (dx, dy), t in zip(self.places, tension, strict=True))
        state = np.zeros(N_STATE)
        state[[3, 7, 11]] = 1.0
        state[12:15] = [*value, 0.0] if self.paper else self.curvature(value[:3], tendons)
        return state, tendons

    def march(self, x: Array, load: Sequence[float]) -> Array:
        """State at the tip for the unknowns `x`: one forward pass."""
        from scipy.integrate import solve_ivp

        self.passes += 1
        state, tendons = self.start(x)
        slope, tolerances = self.slope_of(load, tendons), {"rtol": self.rtol, "atol": self.tolerance}
        found: Any = solve_ivp(slope, (0.0, self.rod[0]), state, method=self.integrator, **tolerances)
        return np.asarray(found.y[:, -1])

    def moment(self, u: Sequence[float], tendons: Tendons) -> tuple[Array, Array]:
        """m = K u + sum T c of a cut (3,) [N m], and dm/du."""
        m, a = np.array(self.rod[1:]) * u, np.diag(self.rod[1:])
        for dx, dy, tension in tendons:
            b, p = dx * dx + dy * dy, 1.0 + u[0] * dy - u[1] * dx
            q = math.sqrt(p * p + b * u[2] * u[2])
            d, c = np.array([dx, dy, 0.0]), np.array([dy * p, -dx * p, b * u[2]]) / q
            m, a = m + tension * c, a + tension / q * (b * np.eye(3) - np.outer(d, d) - np.outer(c, c))
        return m, a

    def curvature(self, m: Array, tendons: Tendons) -> Array:
        """u (3,) of a cut that carries the moment `m` (3,) [N m]: three Newton steps get to rounding."""
        u = m / self.rod[1:]
        for _ in range(3):
            at, stiffness = self.moment(u.tolist(), tendons)
            u = u - np.linalg.solve(stiffness, at - m)
        return u

    def residual(self, x: Array, tip: Array, length: Array) -> Array:
        """All boundary residuals [m]: lengths as they are, moments times l^2/EI."""
        if self.paper:
            return np.asarray(tip[15:] - length)
        stretch = self.compliance * x[3:] * self.unit[3:]
        moment, _ = self.moment(tip[12:15].tolist(), self.start(x)[1])
        return np.concatenate([tip[15:] - length - stretch, self.rod[0] ** 2 / self.rod[1] * moment])

    def solve(self, length: Array, load: Sequence[float]) -> tuple[Array, float]:
        """Tip position (3,) [m] and the largest residual [m], from the solution before."""
        from scipy.optimize import least_squares

        best: dict[str, Any] = {}

        def fun(x: Array) -> Array:
            tip = self.march(x, load)
            e = self.residual(x, tip, length)
            largest = float(np.abs(e).max())
            if largest < best.get("largest", math.inf):
                best.update(x=x.copy(), tip=tip, largest=largest)
                if largest < self.stop:
                    raise _EnoughError
            return e / self.rod[0]

        ends = {"ftol": self.ftol, "xtol": self.ftol, "gtol": 1e-12}
        with contextlib.suppress(_EnoughError):
            # the difference step lies well above the integrator's own noise
            least_squares(fun, self.x, method="lm", diff_step=[1e-4], **ends)
        self.x = best["x"]
        return best["tip"][:3], best["largest"]


class _EnoughError(Exception):
    """The residual is small enough."""


class Run(NamedTuple):
    """Time of a shooter over stretches of points."""

    cpu_s: float  # CPU time of one solve, mean over the points, best of the rounds [s]
    passes: float
    error_m: Array


def follow(peer: Shooter, stretches: Sequence[tuple[Array, Points]], rounds: int) -> Run:
    """Solve the points of each stretch in turn, warm from its first unknowns, `rounds` times over."""
    n_points = sum(len(points) for _, points in stretches)
    means = []
    for _ in range(rounds):
        used, errors, peer.passes = Measurement(time.process_time), [], 0
        for first, points in stretches:
            peer.x = first.copy()
            for length, load, truth in points:
                tip, _ = used.take(functools.partial(peer.solve, length, load))
                errors.append(float(np.linalg.norm(tip - truth)))
        means.append(sum(used.times) / n_points)
    return Run(min(means), peer.passes / n_points, np.array(errors))
