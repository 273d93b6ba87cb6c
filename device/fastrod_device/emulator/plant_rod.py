"""The rod of the emulated robot: virtual work on Legendre curvatures, one robot at a time. numpy only,
nothing shared with the models.

One segment of LENGTH whose four tendons sit OFFSET from the backbone at 0, 90, 180 and 270 degrees and end at
the tip; they push and pull. r' = R e3, R' = R [u]x; the base is the origin, its frame the identity. The
energy, per arclength s,
    integral u' K u / 2 ds  +  energy of the tendons  -  integral N . R e3 ds,   N(s) the dead force beyond s,
is at rest over u(s) = sum_m P_m(s) a_m, with the tendons' tensions T as unknowns of their own: l_i(a) - L_i =
extension(T_i).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np
from numpy.polynomial import legendre

from fastrod.types import Floats
from fastrod_device.errors import DeviceError

LENGTH, EI, GJ, OFFSET, COMPLIANCE = 0.07, 2.2e-3, 1.0e-3, 0.0075, 1e-5
"""m, N m^2, N m^2, m; of each tendon m/N."""
_NODES, _MODES = 8, 5
_SIZE = 3 * _MODES
_PASSES = 12  # of Newton, before it counts as lost
_CUTS = (1, 4, 16, 64)  # in how many parts loads and tendons come on from the straight rod


def _tables() -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """Lobatto nodes (n,) on [0, 1], their weights (n,) [m], integrals from 0 to each node (n, n) [m], modes
    at the nodes (n, modes), and at both Gauss points of the steps between them (2 (n - 1), modes), and the
    steps (n - 1, 1) [m]."""
    n = _NODES
    x = np.concatenate([[-1.0], np.sort(legendre.legroots(legendre.legder(np.eye(n)[n - 1]))), [1.0]])
    whole = np.stack([legendre.legval(x, legendre.legint(row, lbnd=-1)) for row in np.eye(n)], axis=1)
    upto = 0.5 * LENGTH * whole @ np.linalg.inv(legendre.legvander(x, n - 1))
    middle, half = 0.5 * (x[:-1] + x[1:]), 0.5 * np.diff(x)
    gauss = np.concatenate([middle - half / math.sqrt(3.0), middle + half / math.sqrt(3.0)])
    modes = legendre.legvander(x, _MODES - 1)
    return (
        0.5 * (x + 1.0),
        upto[-1].copy(),
        upto,
        modes,
        legendre.legvander(gauss, _MODES - 1),
        (LENGTH * half)[:, None],
    )


_S, _WEIGHT, _UPTO, _MODE, _GAUSS, _STEP = _tables()
_WEIGHTED = np.ascontiguousarray((_WEIGHT[:, None] * _MODE).T)  # (modes, n)
# (modes^2, n)
_PRODUCTS = np.ascontiguousarray(
    (_WEIGHT[:, None, None] * _MODE[:, :, None] * _MODE[:, None, :]).reshape(_NODES, -1).T
)
_LATER = np.ascontiguousarray((_WEIGHT[:, None] * _UPTO).T)  # what later nodes lay upon an earlier one
_HAT = np.zeros((3, 9))
_HAT[0, [5, 7]], _HAT[1, [2, 6]], _HAT[2, [1, 3]] = (-1.0, 1.0), (1.0, -1.0), (-1.0, 1.0)
_EYE = np.eye(3)
# d|q|/du is (b y, -b x, d^2 u_z) / |q| for a tendon at (x, y), with q = e3 + u x d and b its component along
# the backbone
_LEVER = OFFSET * np.array(
    [[0.0, 1.0, 0.0, -1.0], [-1.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0]]
)  # (3, tendons)
_TWIST = np.zeros((3, 4))
_TWIST[2] = OFFSET**2
_LOCK = np.einsum("xi,yi->ixy", _LEVER, _LEVER).reshape(4, 9)
_LOCK[:, 8] = OFFSET**2


class PlantRest(NamedTuple):
    """Shape of the rod at rest, base frame."""

    position: Floats
    """(3,) of the tip [m]."""
    rotation: Floats
    """(3, 3) base_from_tip."""
    tension: Floats
    """(4,) of the tendons [N]; they push where it is negative."""
    slope: Floats
    """(4, 4) change of the tensions with the lengths of the tendons [N/m]."""
    modes: Floats
    """(modes, 3) of the curvature [1/m]."""
    dl: Floats
    """(4,) of the tendons [m]."""
    lever: Floats
    """(3 modes, 4) change of the modes with the lengths of the tendons."""


@final
@dataclass(frozen=True, kw_only=True, repr=False)
class PlantRod:
    """A rod and its tendons. The extension of a tendon by T is c ((1 - q) T + q T0 arcsinh(T / T0)): strands
    settle under load."""

    compliance: float = COMPLIANCE
    """c, of a tendon that is hardly pulled [m/N]."""
    settling: float = 0.0
    """q, the share of it that goes as the strands settle, 0 to 1."""
    knee: float = 1.0
    """T0 [N]."""
    weight: float = 0.0
    """Weight of the body, mean along it [N/m]."""
    slope: float = 0.0
    """The line weight is weight (1 + slope (1 - 2 x) + bulge (6 x (1 - x) - 1)), x from 0 at the base to
    1."""
    bulge: float = 0.0
    """See `slope`."""
    bending: float = EI
    """Stiffness [N m^2]."""
    torsion: float = GJ
    """Stiffness [N m^2]."""

    @property
    def _stiffness(self) -> Floats:
        return np.array([self.bending, self.bending, self.torsion])

    def rest(self, dl: Floats, tip_force: Floats, down: Floats, start: PlantRest | None = None) -> PlantRest:
        """The shape for tendons `dl` (4,) [m] under the dead load `tip_force` (3,) [N], with the unit vector
        `down` (3,), base frame.

        Quick from a `start` near by. Raises `DeviceError` where it finds none, as under a load that makes the
        robot snap.
        """
        line = self._beyond()[:, None] * down
        if start is not None:
            found = self._from(start, dl, tip_force, line)
            if found is not None:
                return found
        for cuts in _CUTS:
            at: PlantRest | None = PlantRest(
                np.zeros(3),
                _EYE,
                np.zeros(4),
                np.zeros((4, 4)),
                np.zeros((_MODES, 3)),
                np.zeros(4),
                np.zeros((_SIZE, 4)),
            )
            for k in range(cuts + 1):
                fraction = k / cuts
                at = (
                    None
                    if at is None
                    else self._from(at, fraction * dl, fraction * tip_force, fraction * line)
                )
            if at is not None:
                return at
        raise DeviceError(
            "the emulated robot finds no rest with these tendons and loads; load it less, and "
            "let no two tendons pull apart."
        )

    def _from(self, start: PlantRest, dl: Floats, tip_force: Floats, line: Floats) -> PlantRest | None:
        """Newton from a shape whose tendons are moved to first order."""
        moved = dl - start.dl
        modes = start.modes + (start.lever @ moved).reshape(_MODES, 3)
        return self._newton(dl, tip_force, line, modes, start.tension + start.slope @ moved)

    def _beyond(self) -> Floats:
        """(n,) weight beyond the nodes [N]."""
        x = 1.0 - _S
        # of what is left: 1 - s, then the integrals of both polynomials, which are zero over the whole
        return np.asarray(
            LENGTH * self.weight * (x - self.slope * _S * x + self.bulge * (2.0 * _S**3 - 3.0 * _S**2 + _S))
        )

    def _newton(
        self, dl: Floats, tip_force: Floats, line: Floats, modes: Floats, tension: Floats
    ) -> PlantRest | None:
        """Newton on modes and tensions together; None where it does not settle."""
        force, elastic = tip_force + line, self._stiffness  # (n, 3), (3,)
        system = np.empty((_SIZE + 4, _SIZE + 4))
        wrong = np.empty(_SIZE + 4)
        for _ in range(_PASSES):
            u = _MODE @ modes
            frame = _frames(modes)
            # tendons
            along = 1.0 + u @ _LEVER
            twist = u[:, 2:]
            length = np.sqrt(along * along + (OFFSET * twist) ** 2)
            curl = (along[:, None] * _LEVER + twist[:, None] * _TWIST) / length[:, None]  # (n, 3, tendons)
            pull = tension / length
            curving = (
                (pull @ _LOCK).reshape(_NODES, 3, 3)
                - (curl * pull[:, None]) @ curl.transpose(0, 2, 1)
                + np.diag(elastic)
            )
            slope = (_WEIGHTED @ curl.reshape(_NODES, 12)).reshape(_SIZE, 4)
            # loads: d(R e3) = dtheta x R e3, and dtheta is the integral of R du
            tangent = frame[:, :, 2]
            torque = _cross(tangent, force)
            laid = _LATER @ torque / _WEIGHT[:, None]
            moment = u * elastic - (laid[:, None] @ frame)[:, 0]
            rotated = (frame[:, :, None] * _MODE[:, None, :, None]).reshape(_NODES, 3, _SIZE)
            swept = (_UPTO @ rotated.reshape(_NODES, -1)).reshape(_NODES, 3, _SIZE)
            lock = (
                force[:, :, None] * tangent[:, None]
                - np.einsum("nx,nx->n", force, tangent)[:, None, None] * _EYE
            )
            # (laid x) as a matrix is the hat of laid; the turn nearer to the base is the outer one
            swing = lock @ swept - (laid @ _HAT).reshape(_NODES, 3, 3) @ rotated
            load = swept.reshape(-1, _SIZE).T @ (_WEIGHT[:, None, None] * swing).reshape(-1, _SIZE)
            bend = (
                (_PRODUCTS @ curving.reshape(_NODES, 9))
                .reshape(_MODES, _MODES, 3, 3)
                .transpose(0, 2, 1, 3)
                .reshape(_SIZE, _SIZE)
            )
            system[:_SIZE, :_SIZE] = bend - 0.5 * (load + load.T)
            system[:_SIZE, _SIZE:] = slope
            system[_SIZE:, :_SIZE] = slope.T
            ratio = tension / self.knee
            soft = self.compliance * (1.0 - self.settling + self.settling / np.sqrt(1.0 + ratio * ratio))
            system[_SIZE:, _SIZE:] = np.diag(-soft)
            wrong[:_SIZE] = (_WEIGHTED @ moment).ravel() + slope @ tension
            extension = self.compliance * (
                (1.0 - self.settling) * tension + self.settling * self.knee * np.arcsinh(ratio)
            )
            wrong[_SIZE:] = _WEIGHT @ length - LENGTH - dl - extension
            try:
                inverse = np.asarray(np.linalg.inv(system), dtype=np.float64)
            except np.linalg.LinAlgError:
                return None
            move = inverse @ wrong
            most = LENGTH * float(np.abs(move[:_SIZE]).sum())
            if not most < 30.0:
                return None
            fraction = min(1.0, 1.0 / max(most, 1e-12))  # a radian in one pass is far enough
            modes = modes - fraction * move[:_SIZE].reshape(_MODES, 3)
            tension = tension - fraction * move[_SIZE:]
            if most < 3e-4:  # the next step would be its square
                last = _frames(modes)
                gain = inverse[:, _SIZE:]
                return PlantRest(
                    _WEIGHT @ last[:, :, 2], last[-1], tension, gain[_SIZE:], modes, dl, gain[:_SIZE]
                )
        return None


def _frames(modes: Floats) -> Floats:
    """(n, 3, 3) base_from_material at the nodes, by a fourth order Magnus step from each to the next."""
    u = _GAUSS @ modes
    first, second = u[: _NODES - 1], u[_NODES - 1 :]
    w = 0.5 * _STEP * (first + second) + (math.sqrt(3.0) / 12.0) * _STEP**2 * _cross(first, second)
    hat = (w @ _HAT).reshape(-1, 3, 3)
    x = np.einsum("nx,nx->n", w, w)[:, None, None]
    # sin(a) / a and (1 - cos(a)) / a^2 in x = a^2, to 1e-9 where a step turns by half a radian
    one = 1.0 - x / 6.0 * (1.0 - x / 20.0 * (1.0 - x / 42.0 * (1.0 - x / 72.0)))
    two = 0.5 - x / 24.0 * (1.0 - x / 30.0 * (1.0 - x / 56.0 * (1.0 - x / 90.0)))
    step = _EYE + one * hat + two * (hat @ hat)
    frame = np.empty((_NODES, 3, 3))
    now = frame[0] = _EYE
    for k in range(_NODES - 1):
        now = frame[k + 1] = now @ step[k]
    return frame


def _cross(a: Floats, b: Floats) -> Floats:
    """Cross product of rows (n, 3), without np.cross' checks."""
    return (a[:, _NEXT] * b[:, _OVER]) - (a[:, _OVER] * b[:, _NEXT])


_NEXT, _OVER = np.array([1, 2, 0]), np.array([2, 0, 1])
