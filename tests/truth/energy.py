"""A tendon rod as the minimum of an energy: numpy and scipy only, nothing shared with the package under test.

The rod is a row of elements of constant curvature u_j, each turning its frame by exp(h [u_j]x). At rest
    V(u) = sum_j h/2 (u_j - u*)^T K (u_j - u*)  +  sum_i (l_i - L_i + c_i T0_i)^2 / (2 c_i)  -  sum_k F_k .
    r_k
is least, with l_i = sum_j h |e3 + u_j x d_ij| and the loads at the nodes. No boundary value problem, no
moment balance and no integrator: what the two ways share is the physics alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

E3 = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Minimum:
    """The rod at rest, Richardson-extrapolated; base at the origin, material frame = world frame there."""

    tip_position: NDArray[np.float64]
    """(3,) [m]."""
    tip_rotation: NDArray[np.float64]
    """(3, 3) world_from_material."""
    tension: NDArray[np.float64]
    """(n,) [N]."""
    tendon_length: NDArray[np.float64]
    """(n,) path length [m]."""
    error: float
    """Difference between the last two extrapolations of the tip [m]."""


@dataclass(frozen=True)
class _Rod:
    """Elements base first; e elements, n tendons."""

    step: NDArray[np.float64]  # (e,)
    stiffness: NDArray[np.float64]  # (e, 3)
    precurvature: NDArray[np.float64]  # (e, 3)
    crossing: NDArray[np.float64]  # (e, n) 1 where the tendon runs through
    offset: NDArray[np.float64]  # (e, n, 3)
    free_length: NDArray[np.float64]  # (n,) of the tendon without tension
    compliance: NDArray[np.float64]  # (n,)
    unilateral: bool
    node_force: NDArray[np.float64]  # (e, 3) at the end of each element


def minimise(
    length: ArrayLike,
    K: ArrayLike,
    offsets: ArrayLike,
    tendon_length: ArrayLike,
    compliance: ArrayLike,
    tip_force: ArrayLike = (0.0, 0.0, 0.0),
    line_force: ArrayLike = (0.0, 0.0, 0.0),
    precurvature: ArrayLike = 0.0,
    *,
    pretension: ArrayLike = 0.0,
    unilateral: bool = False,
    elements: int = 8,
    levels: int = 4,
) -> Minimum:
    """Least energy of a chain of rods under dead loads.

    - `length` [m]: one number, or (n_segments,) for a chain. `K` (3,) or (n_segments, 3): EI_x, EI_y, GJ [N
      m^2].
    - `offsets` [m]: (n, 2), or (n_segments, n, 2) with nan where a tendon does not run. `tendon_length` (n,)
      [m], base to end.
    - `compliance` [m/N] and `pretension` [N]: one or (n,); compliance must be positive, for the energy to
      exist.
    - `tip_force` (3,) [N], `line_force` (3,) [N/m], world. `precurvature`: 0, (3,) or (n_segments, 3) [1/m].
    - `elements` a segment on the coarsest of `levels` grids, each twice as fine as the one before.
    """
    lengths = np.atleast_1d(np.asarray(length, dtype=float))
    tendons = np.atleast_1d(np.asarray(tendon_length, dtype=float))
    n_segments, n = len(lengths), len(tendons)
    places = np.broadcast_to(np.asarray(offsets, dtype=float), (n_segments, n, 2))
    compliances = np.broadcast_to(np.asarray(compliance, dtype=float), (n,))
    answers, u = [], None
    for level in range(levels):
        per_segment = elements * 2**level
        step = np.repeat(lengths / per_segment, per_segment)
        place = np.repeat(places, per_segment, axis=0)
        crossing = ~np.isnan(place[..., 0])
        flat = np.concatenate([np.nan_to_num(place), np.zeros((*place.shape[:2], 1))], axis=2)
        # half of an element's line force on each of its ends; the base's share does no work
        half = 0.5 * step[:, None] * np.asarray(line_force, dtype=float)
        node_force = half + np.concatenate([half[1:], np.asarray(tip_force, dtype=float)[None]])
        bending, bent = (
            np.repeat(np.broadcast_to(np.asarray(a, dtype=float), (n_segments, 3)), per_segment, axis=0)
            for a in (K, precurvature)
        )
        rod = _Rod(
            step=step,
            stiffness=bending,
            precurvature=bent,
            crossing=crossing.astype(float),
            offset=flat,
            free_length=tendons - compliances * np.asarray(pretension, dtype=float),
            compliance=compliances,
            unilateral=unilateral,
            node_force=node_force,
        )
        u = _bottom(rod, rod.precurvature.copy() if u is None else np.repeat(u, 2, axis=0))
        answers.append(_answer(rod, u))
    best, before = _richardson(answers), _richardson(answers[:-1])
    tip, rotation, tension, path = np.split(best, [3, 12, 12 + n])
    return Minimum(tip, rotation.reshape(3, 3), tension, path, float(np.abs(tip - before[:3]).max()))


def energy(rod: _Rod, u: NDArray[Any]) -> NDArray[Any]:
    """V [J] of curvatures (batch, e, 3): (batch,)."""
    strain = u - rod.precurvature
    elastic = 0.5 * np.einsum("j,jx,bjx,bjx->b", rod.step, rod.stiffness, strain, strain)
    stretch = _path(rod, u)[0] - rod.free_length
    if rod.unilateral:
        stretch = np.maximum(stretch, 0.0)
    tendons = np.einsum("bi,bi,i->b", stretch, stretch, 0.5 / rod.compliance)
    _, tangent, _ = _frames(rod, u)
    # the force beyond an element moves with every tangent before it: sum_k F_k . r_k = sum_j h t_j . N_j
    return np.asarray(
        elastic + tendons - np.einsum("j,bjx,jx->b", rod.step, tangent, _beyond(rod.node_force))
    )


def gradient(rod: _Rod, u: NDArray[Any]) -> NDArray[Any]:
    """dV/du of (batch, e, 3), exact; analytic in u, so that an imaginary step gives its derivative."""
    start, tangent, _ = _frames(rod, u)
    out = rod.step[:, None] * rod.stiffness * (u - rod.precurvature)
    path, direction = _path(rod, u)
    tension = (path - rod.free_length) / rod.compliance
    if rod.unilateral:
        tension = np.where(tension.real > 0.0, tension, 0.0)
    # d|q|/du = d x t
    arms = np.cross(rod.offset[None], direction)
    out = out + np.einsum("bi,j,ji,bjix->bjx", tension, rod.step, rod.crossing, arms)
    lever = np.cross(tangent, rod.step[:, None] * _beyond(rod.node_force))
    later = np.flip(np.cumsum(np.flip(lever, 1), axis=1), 1) - lever
    turned = np.einsum("bjyx,bjy->bjx", start, later)
    half = np.einsum("bjyx,bjy->bjx", start, lever)
    h = rod.step[:, None, None]
    work = h * np.einsum("bjyx,bjy->bjx", _turning(h[..., 0] * u), turned)[..., None]
    work = work + 0.5 * h * np.einsum("bjyx,bjy->bjx", _turning(0.5 * h[..., 0] * u), half)[..., None]
    return np.asarray(out - work[..., 0])


def _bottom(rod: _Rod, u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Newton with the exact Hessian, shifted until it points downhill; stops where rounding does."""
    size = u.size
    bending = float((rod.step[:, None] * rod.stiffness).max())
    reach = 1.0
    for _ in range(500):
        slope = gradient(rod, u[None])[0].ravel()
        hessian = _hessian(rod, u)
        lowest = float(np.linalg.eigvalsh(hessian)[0])
        shift = 0.0 if lowest > 0.0 else 1e-6 * bending - lowest
        move = -np.linalg.solve(hessian + shift * np.eye(size), slope).reshape(u.shape)
        # an element may turn by this much in one step: beyond it the energy is far from its parabola
        move *= min(1.0, reach / float(np.abs(rod.step[:, None] * move).sum()))
        here = energy(rod, u[None])[0]
        most = here + 1e-13 * (abs(here) + bending)
        while energy(rod, (u + move)[None])[0] > most and np.abs(move).max() > 1e-14:
            move = 0.5 * move
        u = u + move
        if np.abs(move).max() < 1e-11 * (1.0 + np.abs(u).max()):
            return u
    raise ArithmeticError("the energy has no bottom within 500 steps")


def _hessian(rod: _Rod, u: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3e, 3e) by an imaginary step, which has no cancellation: exact to rounding."""
    tiny = 1e-30
    sides = u[None] + 1j * tiny * np.eye(u.size).reshape(u.size, *u.shape)
    hessian = gradient(rod, sides).imag.reshape(u.size, u.size) / tiny
    return 0.5 * (hessian + hessian.T)


def _answer(rod: _Rod, u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Tip position (3), rotation (9), tensions (n), paths (n) in one vector."""
    _, tangent, end = _frames(rod, u[None])
    path = _path(rod, u[None])[0][0]
    tension = (path - rod.free_length) / rod.compliance
    if rod.unilateral:
        tension = np.maximum(tension, 0.0)
    tip = np.einsum("j,jx->x", rod.step, tangent[0])
    return np.concatenate([tip, end[0].ravel(), tension, path])


def _richardson(answers: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """The elements' error runs in even powers of h: every rule is symmetric about an element's middle."""
    table = list(answers)
    for power in range(1, len(table)):
        table = [(4.0**power * fine - coarse) / (4.0**power - 1.0) for coarse, fine in pairwise(table)]
    return table[-1]


def _path(rod: _Rod, u: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Tendon paths (batch, n) and unit directions (batch, e, n, 3)."""
    q = E3 + np.cross(u[:, :, None], rod.offset[None])
    # not np.linalg.norm, which would take the modulus of an imaginary step
    speed = np.sqrt(np.sum(q * q, axis=-1))
    return np.einsum("j,ji,bji->bi", rod.step, rod.crossing, speed), q / speed[..., None]


def _frames(rod: _Rod, u: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Frame at each start (batch, e, 3, 3), tangent at each middle (batch, e, 3), frame at the tip."""
    h = rod.step[:, None]
    whole, half = _rotation(h * u), _rotation(0.5 * h * u)
    frame = np.broadcast_to(np.eye(3, dtype=u.dtype), (len(u), 3, 3))
    starts = []
    for j in range(u.shape[1]):
        starts.append(frame)
        frame = frame @ whole[:, j]
    start = np.stack(starts, axis=1)
    return start, np.einsum("bjxy,bjy->bjx", start, half[..., 2]), frame


def _beyond(node_force: NDArray[np.float64]) -> NDArray[np.float64]:
    """(e, 3) force on the nodes from each element's end to the tip."""
    return np.flip(np.cumsum(np.flip(node_force, 0), axis=0), 0)


def _hat(w: NDArray[Any]) -> NDArray[Any]:
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*w.shape, 3)


def _series(square: NDArray[Any], first: int) -> NDArray[Any]:
    """sum_k (-theta^2)^k / (first + 2 k)!, analytic where sin(theta)/theta is not; angles below one."""
    term = np.ones_like(square) / float(np.prod(np.arange(1, first + 1)))
    total = term
    for k in range(1, 14):
        term = -term * square / ((first + 2 * k - 1) * (first + 2 * k))
        total = total + term
    return total


def _rotation(w: NDArray[Any]) -> NDArray[Any]:
    """exp [w]x."""
    k, square = _hat(w), np.sum(w * w, axis=-1)[..., None, None]
    return np.asarray(np.eye(3) + _series(square, 1) * k + _series(square, 2) * (k @ k))


def _turning(w: NDArray[Any]) -> NDArray[Any]:
    """Return how exp [w]x turns, in the frame it starts from, when w changes: the left Jacobian of SO(3)."""
    k, square = _hat(w), np.sum(w * w, axis=-1)[..., None, None]
    return np.asarray(np.eye(3) + _series(square, 2) * k + _series(square, 3) * (k @ k))
