"""The tendon rod as equations on numpy arrays: what `shoot` and `solve_bvp` both integrate.

Rucker and Webster, IEEE T-RO 27(6), 2011, section III, in its inextensible, unshearable limit and solved for
the curvature. r position, R = [d1 d2 d3] rotation (world_from_material), u curvature, n and m internal force
and moment.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fastrod.model.robot import Robot

Array: TypeAlias = NDArray[np.float64]

E3: Array = np.array([0.0, 0.0, 1.0])
POSITION = slice(0, 3)
ROTATION = slice(3, 12)
CURVATURE = slice(12, 15)
PATH = slice(15, None)
"""Columns of a state (15 + n_tendons,): r, R row by row, u, and the path length of each tendon so far."""


@dataclass(frozen=True, kw_only=True)
class ReferenceShape:
    """One robot at rest, as a reference solver found it; SI units, world frame unless said otherwise.

    n_points = n_segments * points_per_segment + 1, base first, evenly spaced in each segment. Curvature jumps
    at a joint; the point there holds the value just before it.
    """

    position: Array
    """(n_points, 3) backbone [m]."""
    rotation: Array
    """(n_points, 3, 3) world_from_material."""
    curvature: Array
    """(n_points, 3) u, material frame [1/m]."""
    arclength: Array
    """(n_points,) along the backbone as it is, extension included [m]."""
    tension: Array
    """(n_tendons,) [N]; zero where mode `paper` leaves it out, nan where the method knows none."""
    tip_position: Array
    """(3,) [m]."""
    tip_rotation: Array
    """(3, 3) world_from_material."""
    tendon_length: Array
    """(n_tendons,) path length from the base to where each tendon ends [m]."""
    residual: float
    """Largest boundary residual [m]; moments times l^2/EI, forces times l^3/EI."""
    evaluations: int
    """Forward passes (`shoot`) or calls of the slope (`solve_bvp`)."""
    success: bool
    message: str


@dataclass(frozen=True, kw_only=True)
class Span:
    """A stretch of backbone where nothing jumps: one stiffness, one set of tendons, a line force linear in
    s."""

    segment: int
    start: float
    """Arclength [m]."""
    end: float
    """Arclength [m]."""
    stiffness: Array
    """(3,) EI_x, EI_y, GJ [N m^2]."""
    precurvature: Array
    """(3,) u*, material frame [1/m]."""
    tendon: NDArray[np.int64]
    """(n_crossing,) which tendons run through."""
    offset: Array
    """(n_crossing, 3) d_i, material frame [m]."""
    line_force: Array
    """(2, 3) at start and at end, world, self-weight included [N/m]."""
    force: Array
    """(3,) all known loads at and beyond the end, world [N]."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Boundary value problem of one robot: its spans from the base to the tip, its commands and its loads."""

    robot: Robot
    paper: bool
    spans: tuple[Span, ...]
    segment_end: Array
    """(n_segments,) arclength [m]."""
    tendon_length: Array
    """(n_tendons,) commanded [m]; read where `free`, and everywhere in mode `paper`."""
    tension: Array
    """(n_tendons,) [N] where it is given; zero where `free` or slack."""
    free: NDArray[np.bool_]
    """(n_tendons,) True where the tension is an unknown."""
    tip_moment: Array
    """(3,) world [N m]."""
    follower: Array
    """(3,) force that rotates with the tip, material frame [N]."""

    @property
    def length(self) -> float:
        """Arclength of the tip, extensions included [m]."""
        return float(self.segment_end[-1])

    @property
    def bending_stiffness(self) -> float:
        """EI of the last segment, which scales moments into metres [N m^2]."""
        return float(self.spans[-1].stiffness[0])

    @property
    def follows(self) -> bool:
        """True when a follower force makes the world force at the tip an unknown."""
        return bool(np.any(self.follower))

    @property
    def compliance(self) -> Array:
        """(n_tendons,) stretch per tension [m/N]."""
        return np.array([tendon.compliance for tendon in self.robot.tendons])

    @property
    def pretension(self) -> Array:
        """(n_tendons,) tension at which a tendon has its commanded length [N]."""
        return np.array([tendon.pretension for tendon in self.robot.tendons])

    def scaled(self, fraction: float) -> Problem:
        """Return this robot under a fraction of its loads."""
        spans = tuple(
            replace(s, line_force=fraction * s.line_force, force=fraction * s.force) for s in self.spans
        )
        return replace(
            self, spans=spans, tip_moment=fraction * self.tip_moment, follower=fraction * self.follower
        )


def hat(v: Array) -> Array:
    """[v]x of vectors (..., 3), as matrices (..., 3, 3)."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*v.shape, 3)


def rotation_of(angle: Array) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,) [rad], by Rodrigues' formula."""
    theta = float(np.linalg.norm(angle))
    k = hat(angle)
    # np.sinc keeps both coefficients exact through zero angle
    return np.asarray(
        np.eye(3) + np.sinc(theta / np.pi) * k + 0.5 * np.sinc(theta / (2.0 * np.pi)) ** 2 * (k @ k)
    )


def base_state(robot: Robot) -> Array:
    """(15 + n_tendons,) at the base, its curvature still zero."""
    w, v = robot.base_quaternion[0], np.array(robot.base_quaternion[1:])
    rotation = np.eye(3) + 2.0 * w * hat(v) + 2.0 * hat(v) @ hat(v)
    return np.concatenate([robot.base_position, rotation.ravel(), np.zeros(3 + robot.n_tendons)])


def moment_and_stiffness(span: Span, tension: Array, u: Array) -> tuple[Array, Array, Array]:
    """Moment of a cut, its derivative, and how fast the tendons' paths grow there.

    m = K (u - u*) + sum_i T_i d_i x t_i and A = dm/du = K - sum_i T_i/|q_i| [d_i]x (I - t_i t_i^T) [d_i]x,
    with q_i = e3 + u x d_i and t_i = q_i/|q_i|.

    `tension` (n_tendons,), `u` (p, 3); returns m (p, 3), A (p, 3, 3), |q_i| (p, n_crossing).
    """
    cross = hat(span.offset)  # (n, 3, 3)
    q = E3 - np.einsum("nij,pj->pni", cross, u)
    speed = np.sqrt(np.einsum("pni,pni->pn", q, q))
    t = q / speed[..., None]
    dt = np.einsum("nij,pnj->pni", cross, t)  # d_i x t_i
    pull = tension[span.tendon]
    m = span.stiffness * (u - span.precurvature) + np.einsum("n,pni->pi", pull, dt)
    # [d] (I - t t^T) [d] = [d][d] + (d x t)(d x t)^T, because t^T [d] = -(d x t)^T
    fan = cross @ cross + dt[..., :, None] * dt[..., None, :]
    stiffness = np.diag(span.stiffness) - np.einsum("n,pn,pnij->pij", pull, 1.0 / speed, fan)
    return m, stiffness, speed


def span_moment(span: Span, tension: Array, u: Array) -> Array:
    """(3,) total internal moment of one cut, material frame [N m]."""
    return np.asarray(moment_and_stiffness(span, tension, u[None])[0][0])


def internal_force(span: Span, s: Array, tip_force: Array) -> Array:
    """n(s) = F + integral_s^l f + the point forces beyond s, world (p, 3) [N]; eq. 1c is printed with
    integral_0^s.

    `tip_force` (3,) is the component that the tip's own rotation decides.
    """
    weight = ((s - span.start) / (span.end - span.start))[:, None]
    here = (1.0 - weight) * span.line_force[0] + weight * span.line_force[1]
    return np.asarray(span.force + tip_force + 0.5 * (span.end - s)[:, None] * (here + span.line_force[1]))


def slope(span: Span, tension: Array, tip_force: Array, s: Array, state: Array) -> Array:
    """d state / ds: r' = R e3, R' = R [u]x, A u' = -(u x m + e3 x R^T n), l_i' = |q_i|.

    `s` (p,), `state` (p, 15 + n_tendons).
    """
    rotation = state[:, ROTATION].reshape(-1, 3, 3)
    u = state[:, CURVATURE]
    m, stiffness, speed = moment_and_stiffness(span, tension, u)
    n = np.einsum("pji,pj->pi", rotation, internal_force(span, s, tip_force))
    turning = np.einsum("pij,pj->pi", hat(u), m)
    turning[:, 0] -= n[:, 1]
    turning[:, 1] += n[:, 0]
    out = np.zeros_like(state)
    out[:, POSITION] = rotation[:, :, 2]
    out[:, ROTATION] = (rotation @ hat(u)).reshape(-1, 9)
    out[:, CURVATURE] = -np.linalg.solve(stiffness, turning[..., None])[..., 0]
    out[:, PATH][:, span.tendon] = speed
    return out


def curvature_of_moment(span: Span, tension: Array, moment: Array, u: Array) -> Array:
    """u (3,) at which the cut of `span` carries `moment` (3,): Newton from `u`.

    For T >= 0 it is the minimum of a convex function, 1/2 (u-u*)^T K (u-u*) + sum T_i |q_i| - m u, so there
    is one.
    """
    for _ in range(50):
        m, stiffness, _ = moment_and_stiffness(span, tension, u[None])
        step = np.linalg.solve(stiffness[0], moment - m[0])
        # a long step leaves the region where |q_i| is nearly linear in u
        step *= min(1.0, 100.0 / max(float(np.abs(step).max()), 1e-300))
        u = u + step
        if np.abs(step).max() <= 1e-13 * (1.0 + np.abs(u).max()):
            break
    return u


def tip_residual(problem: Problem, tension: Array, tip_force: Array, tip: Array) -> Array:
    """Return the residual at the tip of a trial [m]: lengths of the free tendons, m(l) - R^T M, follower
    force.

    l_i = L_i + c_i (T_i - T0_i): a stretching tendon is what makes the tensions unique for any number of
    tendons.
    """
    scale = problem.length**2 / problem.bending_stiffness
    rotation = tip[ROTATION].reshape(3, 3)
    length = tip[PATH] - problem.tendon_length - problem.compliance * (tension - problem.pretension)
    moment = span_moment(problem.spans[-1], tension, tip[CURVATURE]) - rotation.T @ problem.tip_moment
    blocks = [length[problem.free], scale * moment]
    if problem.follows:
        blocks.append(scale * problem.length * (rotation @ problem.follower - tip_force))
    return np.concatenate(blocks)


def grid(problem: Problem, points_per_segment: int) -> Array:
    """(n_points,) arclength of the points of a `ReferenceShape` [m]."""
    ends = np.concatenate([[0.0], problem.segment_end])
    pieces = [np.linspace(a, b, points_per_segment + 1)[1:] for a, b in pairwise(ends)]
    return np.concatenate([[0.0], *pieces])


def shape_of(s: Array, states: Array, **found: object) -> ReferenceShape:
    """A `ReferenceShape` of the states (n_points, 15 + n_tendons) at `s`, and of what the solver has to
    say."""
    rotation = states[:, ROTATION].reshape(-1, 3, 3)
    return ReferenceShape(
        position=states[:, POSITION],
        rotation=rotation,
        curvature=states[:, CURVATURE],
        arclength=s,
        tip_position=states[-1, POSITION],
        tip_rotation=rotation[-1],
        tendon_length=states[-1, PATH],
        **found,  # type: ignore[arg-type]
    )
