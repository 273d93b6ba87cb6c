"""The rod of the plant: virtual work on Legendre curvatures, many samples at once. numpy only, nothing shared
with the package under test.

Equal segments with four tendons each; tendon i sits at OFFSET (cos a_i, sin a_i) in the material frame and
runs from the base to the end of its segment. r' = R e3, R' = R [u]x; the base is the origin, its frame the
identity. Energy, per arclength s,
    integral (u - u*)' K (u - u*) / 2 ds  +  sum_i (l_i - L_i)^2 / (2 c)  -  work of dead loads,   l_i =
    integral |e3 + u x d_i| ds,
is least over u(s) = sum_m P_m(s) a_m in every segment, by Newton steps with the whole second derivative.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

Array = NDArray[np.float64]
Field = Callable[[Array], tuple[Array, Array]]
"""Field of tip positions (n, 3) [m]: force (n, 3) [N] and its change with the position (n, 3, 3) [N/m]."""

LENGTH, EI, GJ, OFFSET, COMPLIANCE, GRAVITY = 0.07, 2.2e-3, 1.0e-3, 0.0075, 1e-5, 9.81
"""Constants of each segment: m, N m^2, N m^2, m; of each tendon m/N; m/s^2 along -z of the world."""
_NODES, _MODES = 8, 5


def angles(segments: int) -> Array:
    """Return the angles of the tendons (tendons,) [rad]: each segment's four are 45 degrees on from those
    of the one before."""
    return np.concatenate([0.25 * np.pi * k + 0.5 * np.pi * np.arange(4) for k in range(segments)])


def routing(segments: int) -> Array:
    """(2 segments, 2 segments) pair lengths [m] of bends [rad]; a distal pair feels the segments before."""
    angle = angles(segments).reshape(segments, 4)[:, :2].reshape(-1)
    row = OFFSET * np.stack([np.sin(angle), -np.cos(angle)], axis=1)
    crosses = np.arange(segments)[None] <= (np.arange(2 * segments) // 2)[:, None]
    return np.asarray((crosses[:, :, None] * row[:, None]).reshape(2 * segments, -1))


def pairs(dl: Array) -> Array:
    """Half the difference of opposite tendons (n, 2 segments) [m]."""
    tendon = dl.reshape(len(dl), -1, 2, 2)
    return 0.5 * (tendon[:, :, 0] - tendon[:, :, 1]).reshape(len(dl), -1)


def tendons(pair: Array) -> Array:
    """Both tendons of each pair (n, tendons) [m] from the pairs (n, 2 segments)."""
    first = pair.reshape(len(pair), -1, 1, 2)
    return np.concatenate([first, -first], axis=2).reshape(len(pair), -1)


def _lobatto() -> tuple[Array, Array, Array, Array]:
    """On [0, 1]: nodes (n,), integral of a function from each node to 1 (n, n), Legendre modes there (n,
    modes) and at both Gauss points of the steps between them (2, n - 1, modes)."""
    n = _NODES
    x = np.concatenate([[-1.0], np.sort(legendre.legroots(legendre.legder(np.eye(n)[n - 1]))), [1.0]])
    primitive = [legendre.legint(row) for row in np.eye(n)]
    beyond = np.stack([legendre.legval(1.0, p) - legendre.legval(x, p) for p in primitive], axis=1)
    gauss = 0.5 * (x[:-1] + x[1:]) + 0.5 * np.diff(x) * np.array([[-1.0], [1.0]]) / np.sqrt(3.0)
    inverse = np.linalg.inv(legendre.legvander(x, n - 1))
    modes = (legendre.legvander(at, _MODES - 1) for at in (x, gauss))
    return 0.5 * (x + 1.0), 0.5 * beyond @ inverse, *modes


NODES, _BEYOND, _MODE, _MODE_GAUSS = _lobatto()
"""NODES: where a segment's numbers are given, as shares of its length."""


@cache
def _chain(segments: int) -> tuple[Array, Array]:
    """Integral from each node to the tip (nodes, nodes) [m], modes at the nodes (nodes, modes)."""
    later = np.triu(np.ones((segments, segments)), 1)
    beyond = np.kron(np.eye(segments), _BEYOND) + np.kron(later, np.tile(_BEYOND[0], (len(NODES), 1)))
    return LENGTH * beyond, np.kron(np.eye(segments), _MODE)


@dataclass(frozen=True)
class Rod:
    """A chain of equal segments; nodes means all of them, (segments * len(NODES))."""

    segments: int = 1
    compliance: float = COMPLIANCE
    """Compliance of each tendon [m/N]."""
    angle: Array | None = None
    """Angles of the tendons (tendons,) [rad]; None: where they belong."""
    stiffness: Array | None = None
    """(nodes, 3, 3) [N m^2]; None: uniform."""
    precurvature: Array | float = 0.0
    """(nodes, 3) [1/m]."""
    density: Array | float = 0.0
    """(nodes,) [kg/m]."""

    def rest(
        self,
        dl: Array,
        tip_force: Array,
        down: Array,
        *,
        payload: Array | float = 0.0,
        lever: float = 0.0,
        field: Field | None = None,
    ) -> tuple[Array, Array]:
        """Return where the energy is least: chords of the segments (n, segments, 3) [m] and rotations of the
        tip (n, 3, 3).

        - `dl` (n, tendons) [m]; `tip_force` (n, 3) [N] and `down` (n, 3) [m/s^2], the acceleration of
          gravity, in the base frame.
        - `payload` (n, 1) [kg], with its centre `lever` [m] beyond the tip. `field` pulls the tip by what it
          gives there.
        """
        n = len(dl)
        modes = np.zeros((n, self.segments, _MODES, 3))
        modes[:, :, 0, :2] = (pairs(dl) @ np.linalg.inv(routing(self.segments)).T).reshape(n, -1, 2) / LENGTH
        modes, tension, todo = modes.reshape(n, -1, 3), np.zeros_like(dl), np.arange(n)
        weight = payload * down
        for k in range(120):
            given = (a[todo] for a in (modes, tension, dl, tip_force, down, weight))
            move, pull = self._newton(*given, lever, field, k > 11)
            most = LENGTH * np.abs(move).sum(axis=(1, 2))
            # a radian in one pass is far enough, and less where it does not settle
            part = np.minimum(1.0, (1.0 if k < 12 else 0.3) / np.maximum(most, 1e-12))[:, None]
            modes[todo] += part[..., None] * move
            tension[todo] += part * (pull - tension[todo])
            todo = todo[most > 1e-5]  # the next step would be its square
            if not len(todo):
                chords, frame = self._shape(modes)
                return chords, frame[:, -1]
        raise ArithmeticError(f"{len(todo)} of {n} samples have no rest within 120 passes")

    def _shape(self, modes: Array) -> tuple[Array, Array]:
        """Chords (n, segments, 3) [m] and frames at the nodes (n, nodes, 3, 3)."""
        given = modes.reshape(len(modes), self.segments, _MODES, 3)
        one, two = np.einsum("gjm,nsmx->gnsjx", _MODE_GAUSS, given, optimize=True)
        h = LENGTH * np.diff(NODES)[:, None]
        # fourth order Magnus
        step = _exponential(0.5 * h * (one + two) + (np.sqrt(3.0) / 12.0) * h**2 * _cross(one, two))
        frame = np.empty((len(modes), self.segments, len(NODES), 3, 3))
        now = np.broadcast_to(np.eye(3), (len(modes), 3, 3))
        for s in range(self.segments):
            frame[:, s, 0] = now
            for j in range(len(NODES) - 1):
                now = now @ step[:, s, j]
                frame[:, s, j + 1] = now
        chords = LENGTH * np.einsum("j,nsjx->nsx", _BEYOND[0], frame[..., 2])
        return chords, frame.reshape(len(modes), -1, 3, 3)

    def _newton(
        self,
        modes: Array,
        tension: Array,
        dl: Array,
        tip_force: Array,
        down: Array,
        weight: Array,
        lever: float,
        field: Field | None,
        cautious: bool,
    ) -> tuple[Array, Array]:
        """A step of the modes (n, segments * modes, 3) and the tensions (n, tendons) [N] after it.

        Tensions are unknowns of their own: what a stiff tendon would pull in a shape that is not yet the
        right one is absurd.
        """
        n, size = len(modes), 3 * modes.shape[1]
        beyond, mode = _chain(self.segments)
        nodes, step = len(mode), beyond[0]
        weighted = step[:, None] * mode
        _, frame = self._shape(modes)
        u = mode @ modes
        uniform = np.tile(np.diag([EI, EI, GJ]), (nodes, 1, 1))
        stiffness = uniform if self.stiffness is None else self.stiffness
        moment = np.einsum("jxy,njy->njx", stiffness, u - self.precurvature)
        # tendons
        angle = angles(self.segments) if self.angle is None else self.angle
        place = OFFSET * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
        last = np.repeat(np.arange(self.segments), 4)
        # (nodes, tendons)
        crosses = (np.repeat(np.arange(self.segments), len(NODES))[:, None] <= last).astype(float)
        q = _cross(u[:, :, None], place) + np.array([0.0, 0.0, 1.0])
        speed = np.sqrt(np.sum(q * q, axis=-1))
        path = np.einsum("j,nji,ji->ni", step, speed, crosses)
        taut = (path - dl - LENGTH * (last + 1.0)) / self.compliance
        turn = _cross(place, q) * (crosses / speed)[..., None]  # d|q|/du
        slope = (weighted.T @ turn.reshape(n, nodes, -1)).reshape(n, len(mode.T), -1, 3)
        slope = slope.swapaxes(1, 2).reshape(n, -1, size)
        moment = moment + np.einsum("ni,njix->njx", taut, turn)
        # d2|q|/du2 = ([d]x'[d]x - turn turn') / |q|
        pull = tension[:, None] * crosses / speed
        lock = np.sum(place**2, axis=1)[:, None, None] * np.eye(3) - place[:, :, None] * place[:, None]
        curving = stiffness + (pull @ lock.reshape(-1, 9)).reshape(n, nodes, 3, 3)
        curving = curving - np.swapaxes(pull[..., None] * turn, 2, 3) @ turn
        products = (weighted[:, :, None] * mode[:, None]).reshape(nodes, -1)
        hessian = np.swapaxes(curving.reshape(n, nodes, 9), 1, 2) @ products
        hessian = hessian.reshape(n, 3, 3, len(mode.T), -1).transpose(0, 3, 1, 4, 2).reshape(n, size, size)
        hessian = hessian + np.swapaxes(slope, 1, 2) @ slope / self.compliance
        # loads: dt = dtheta x t turns all that is beyond; two turns, the nearer to the base outermost, give t
        # N' - (t.N) 1
        if field is not None:
            arm = beyond @ frame[..., 2]
            pull_tip, change = field(arm[:, 0])
            tip_force = tip_force + pull_tip
            # d tip = integral of dtheta x arm
            moved = _cross(np.swapaxes(frame, 2, 3), arm[:, :, None])
            moved = (weighted.T @ moved.reshape(n, nodes, 9)).reshape(n, size, 3)
            hessian = hessian - moved @ change @ np.swapaxes(moved, 1, 2)
        mass = (beyond @ np.broadcast_to(self.density, nodes))[:, None]
        force = (tip_force + weight)[:, None] + mass * down[:, None]
        spread = _outer(frame[..., 2], force)
        work = (beyond @ spread.reshape(n, nodes, 9)).reshape(n, nodes, 3, 3)
        work = work + lever * _outer(frame[:, -1, :, 2], weight)[:, None]
        lift = np.stack([work[..., j, k] - work[..., k, j] for j, k in ((1, 2), (2, 0), (0, 1))], axis=-1)
        moment = moment - (lift[:, :, None] @ frame)[:, :, 0]
        twice = (work - np.trace(work, axis1=2, axis2=3)[..., None, None] * np.eye(3)) @ frame
        # what each mode has turned before a node: integral of P_m R', then both orders of the two turns
        turned = (beyond[0] - beyond) @ (mode[:, :, None, None] * frame[:, :, None]).reshape(n, nodes, -1)
        turned = turned.reshape(n, nodes, -1, 3, 3).transpose(0, 2, 4, 1, 3).reshape(n, size, -1)
        half = turned @ (weighted[:, None, :, None] * twice[:, :, :, None]).reshape(n, 3 * nodes, size)
        gradient = (weighted.T @ moment).reshape(n, size, 1)
        hessian = hessian - half - np.swapaxes(half, 1, 2)
        move = -np.linalg.solve(hessian, gradient)
        # where the energy is no bowl (a heavy load twists the robot), down along every axis
        saddle = np.linalg.slogdet(hessian)[0] < 0.0
        if cautious or saddle.any():
            which = slice(None) if cautious else saddle
            value, axis = np.linalg.eigh(hessian[which])
            value = np.maximum(np.abs(value), 1e-6 * EI * LENGTH)[..., None]
            move[which] = -axis @ ((np.swapaxes(axis, 1, 2) @ gradient[which]) / value)
        return move.reshape(modes.shape), taut + (slope @ move)[..., 0] / self.compliance


def _outer(a: Array, b: Array) -> Array:
    return a[..., :, None] * b[..., None, :]


def _cross(a: Array, b: Array) -> Array:
    """np.cross without its checks."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def _exponential(w: Array) -> Array:
    """exp [w]x (..., 3, 3) by Rodrigues."""
    angle = np.sqrt(np.sum(w * w, axis=-1))[..., None, None]
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    o = np.zeros_like(x)
    hat = np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*w.shape, 3)
    return np.eye(3) + np.sinc(angle / np.pi) * hat + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * (hat @ hat)
