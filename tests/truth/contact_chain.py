"""A row of exact arcs, its energy with tendons that stretch, and two derivatives of both: numpy only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from contact_shapes import outer
from numpy.typing import NDArray

Floats = NDArray[np.float64]
E3 = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Rod:
    """Steps base first, n of them; e elements of one or more steps with one curvature; m tendons."""

    step: Floats  # (n,)
    stiffness: Floats  # (n, 3)
    precurvature: Floats  # (n, 3)
    crossing: Floats  # (n, m) 1 where the tendon runs through
    offset: Floats  # (n, m, 3)
    free_length: Floats  # (m,) of the tendon without tension
    compliance: Floats  # (m,)
    unilateral: bool
    node_force: Floats  # (n, 3) dead load at the end of each step
    base_position: Floats  # (3,)
    base_rotation: Floats  # (3, 3)
    rho: float
    owner: NDArray[np.intp]  # (n,) the element of each step

    def fine(self, x: Floats) -> Floats:
        """(n, 3) curvatures of the steps from (3 e,) of the elements."""
        return x.reshape(-1, 3)[self.owner]

    def coarse(self, a: Floats) -> Floats:
        """Transpose of `fine` on the last axes (..., n, 3) -> (..., 3 e)."""
        summed = np.add.reduceat(a, self.first, axis=-2)
        return np.asarray(summed.reshape(*a.shape[:-2], 3 * len(self.first)))

    @property
    def first(self) -> NDArray[np.intp]:
        """(e,) first step of each element."""
        return np.flatnonzero(np.diff(self.owner, prepend=-1))


class Chain(NamedTuple):
    """The steps in the world, and what follows from theta = h u of each, material frame (last index)."""

    start: Floats  # (n, 3, 3) frame at the start of each step
    node: Floats  # (n, 3) position at its end
    tip: Floats  # (3, 3)
    spin: Floats  # (n, 3, 3) world rotation of all that follows
    shift: Floats  # (n, 3, 3) world displacement of the step's own end


def energy_of(rod: Rod, u: Floats, chain: Chain) -> float:
    """V [J] less its value with all nodes at the origin."""
    strain = u - rod.precurvature
    stretch = stretch_of(rod, u)[0]
    elastic = 0.5 * np.sum(rod.step[:, None] * rod.stiffness * strain**2)
    return float(elastic + 0.5 * np.sum(stretch**2 / rod.compliance) - np.sum(rod.node_force * chain.node))


def slope_of(rod: Rod, u: Floats, chain: Chain) -> Floats:
    """dV/dx (3 e,)."""
    stretch, direction = stretch_of(rod, u)
    h = rod.step[:, None]
    out = h * rod.stiffness * (u - rod.precurvature)
    # d|q|/du = d x t
    arms = np.cross(rod.offset, direction)
    out = out + h * np.einsum("i,ji,jix->jx", stretch / rod.compliance, rod.crossing, arms)
    beyond, lever = _carried(chain, rod.node_force)
    work = np.einsum("jxa,jx->ja", chain.spin, _axial(lever)) + np.einsum("jxa,jx->ja", chain.shift, beyond)
    return rod.coarse(out - h * work)


def hessian_of(rod: Rod, u: Floats, chain: Chain, node_force: Floats) -> Floats:
    """(3 e, 3 e) second derivative of V with these forces on the nodes, dead."""
    n, h = len(u), rod.step
    beyond, lever = _carried(chain, node_force)
    # a distal step's motion is carried round by a proximal spin w: (w x dr) . G = w . (dr x G), summed
    trace = np.trace(lever, axis1=1, axis2=2)[:, None, None]
    torque = np.cross(chain.shift, beyond[:, :, None], axis=1) + lever @ chain.spin - trace * chain.spin
    sides = chain.spin * h[:, None, None], torque * h[:, None, None]
    pairs = -np.einsum("ixa,jxb->iajb", *sides, optimize=True)
    later = np.arange(n)[:, None] < np.arange(n)
    pairs *= later[:, None, :, None]
    pairs = pairs + pairs.transpose(2, 3, 0, 1)
    own = -(h**2)[:, None, None] * _own(rod, u, chain, beyond, lever)
    stretch, direction = stretch_of(rod, u)
    q = E3 + np.cross(u[:, None], rod.offset)
    speed = np.linalg.norm(q, axis=-1)
    arm = _hat(rod.offset)  # dq/du = -[d]x
    flat = np.eye(3) - direction[..., :, None] * direction[..., None, :]
    weight = (stretch / rod.compliance) * rod.crossing * h[:, None] / speed
    own = own + np.einsum("ji,jiyx,jiyz,jizw->jxw", weight, arm, flat, arm, optimize=True)
    own[:, range(3), range(3)] += h[:, None] * rod.stiffness
    pairs[np.arange(n), :, np.arange(n), :] += own
    total = np.add.reduceat(np.add.reduceat(pairs, rod.first, axis=0), rod.first, axis=2)
    total = total.reshape(3 * len(rod.first), -1)
    lengthening = rod.coarse(np.einsum("j,ji,jix->ijx", h, rod.crossing, np.cross(rod.offset, direction)))
    taut = (stretch != 0.0) / rod.compliance
    total = total + lengthening.T @ (taut[:, None] * lengthening)
    return 0.5 * (total + total.T)


def _own(rod: Rod, u: Floats, chain: Chain, beyond: Floats, lever: Floats) -> Floats:
    """(n, 3, 3) second derivative of the work beyond a step by its own theta: an imaginary step."""
    theta = rod.step[:, None] * u
    there = np.swapaxes(chain.start, 1, 2)
    # sum of r G^T about the step's end, in its start frame and before its own turn
    before = np.swapaxes(rotation_of(theta), 1, 2) @ there @ lever @ chain.start
    pull = rod.step[:, None] * np.einsum("jxy,jx->jy", chain.start, beyond)
    tiny = 1e-30
    columns = []
    for b in range(3):
        side = theta + 1j * tiny * np.eye(3)[b]
        moment = _axial(rotation_of(side) @ before)
        slope = np.einsum("jya,jy->ja", turning_of(side), moment)
        slope = slope + np.einsum("jya,jy->ja", _bending(side), pull)
        columns.append(slope.imag / tiny)
    return np.stack(columns, axis=-1)


def _axial(a: NDArray[Any]) -> NDArray[Any]:
    """(n, 3) of a - a^T, (n, 3, 3)."""
    return np.stack([a[:, 1, 2] - a[:, 2, 1], a[:, 2, 0] - a[:, 0, 2], a[:, 0, 1] - a[:, 1, 0]], axis=1)


def _carried(chain: Chain, node_force: Floats) -> tuple[Floats, Floats]:
    """At the end of each step: force at and beyond it (n, 3), sum of (r - r_end) G^T there (n, 3, 3)."""

    def to_tip(a: Floats) -> Floats:
        return np.flip(np.cumsum(np.flip(a, 0), axis=0), 0)

    beyond = to_tip(node_force)
    return beyond, to_tip(outer(chain.node, node_force)) - outer(chain.node, beyond)


def chain_of(rod: Rod, u: Floats) -> Chain:
    theta = rod.step[:, None] * u
    turn, turning = rotation_of(theta), turning_of(theta)
    start = np.empty((len(u), 3, 3))
    frame = rod.base_rotation
    for j in range(len(u)):
        start[j] = frame
        frame = frame @ turn[j]
    # the chord of an arc is the same series as the derivative of its turn
    chords = rod.step[:, None] * np.einsum("jxy,jy->jx", start, turning[:, :, 2])
    node = rod.base_position + np.cumsum(chords, axis=0)
    return Chain(start, node, frame, start @ turning, rod.step[:, None, None] * (start @ _bending(theta)))


def jacobian_of(rod: Rod, chain: Chain) -> Floats:
    """(n, 3, 3 e): how each node moves with the curvatures."""
    n = len(chain.node)
    arm = chain.node[:, None] - chain.node[None]
    moved = np.cross(chain.spin[None], arm[..., None], axis=2) + chain.shift[None]
    moved *= (rod.step * (np.arange(n)[:, None] >= np.arange(n)))[..., None, None]
    return rod.coarse(moved.transpose(0, 2, 1, 3))


def path_of(rod: Rod, u: Floats) -> tuple[Floats, Floats]:
    """Tendon paths (m,) and unit directions (n, m, 3)."""
    q = E3 + np.cross(u[:, None], rod.offset)
    speed = np.linalg.norm(q, axis=-1)
    return np.einsum("j,ji,ji->i", rod.step, rod.crossing, speed), q / speed[..., None]


def stretch_of(rod: Rod, u: Floats) -> tuple[Floats, Floats]:
    """Stretch of the tendons (m,) [m], zero where slack, and their directions (n, m, 3)."""
    path, direction = path_of(rod, u)
    stretch = path - rod.free_length
    return np.maximum(stretch, 0.0) if rod.unilateral else stretch, direction


def _hat(w: NDArray[Any]) -> NDArray[Any]:
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*w.shape, 3)


def _series(square: NDArray[Any], first: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """sum_k (-square)^k / (first + 2 k)! and its derivative by `square`, analytic at zero."""
    coefficient = 1.0 / float(np.prod(np.arange(1, first + 1)))
    total, slope, power = np.full_like(square, coefficient), np.zeros_like(square), np.ones_like(square)
    for k in range(1, 9):
        coefficient /= -float((first + 2 * k - 1) * (first + 2 * k))
        slope = slope + k * coefficient * power
        power = power * square
        total = total + coefficient * power
    return total, slope


def _square(w: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(np.sum(w * w, axis=-1)[..., None, None])


def rotation_of(w: NDArray[Any]) -> NDArray[Any]:
    """exp [w]x."""
    k, square = _hat(w), _square(w)
    return np.asarray(np.eye(3) + _series(square, 1)[0] * k + _series(square, 2)[0] * (k @ k))


def turning_of(w: NDArray[Any]) -> NDArray[Any]:
    """Left Jacobian of SO(3), the integral of exp [s w]x over s in (0, 1), in the frame it starts from."""
    k, square = _hat(w), _square(w)
    return np.asarray(np.eye(3) + _series(square, 2)[0] * k + _series(square, 3)[0] * (k @ k))


def _bending(w: NDArray[Any]) -> NDArray[Any]:
    """Derivative of the chord turning_of(w) e3 by w, (..., 3, 3)."""
    b, b_slope = _series(_square(w), 2)
    c, c_slope = _series(_square(w), 3)
    k, once = _hat(w), np.cross(w, E3)
    twice = np.cross(w, once)
    side = np.broadcast_to(_hat(E3), k.shape)
    along = b_slope * once[..., :, None] + c_slope * twice[..., :, None]
    return np.asarray(-b * side - c * (_hat(once) + k @ side) + 2.0 * along * w[..., None, :])
