"""The pulls of a segment's tendons act on each other, for a cause that is not known."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.model.routing import Routing
from fastrod.types import Floats

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS
_MOST = 2.0  # of the logarithm of a slope, 1/7 to 7


@effect
class TendonInteraction(Static):
    """The pulls of a segment's tendons act on each other, for a cause that is not known.

    How far a pull bends the segment depends on how far its tendon is pulled already, and on how far its
    neighbours around the backbone are. To lowest orders the bend is quadratic and cubic in the pulls, with
    cross terms. The slope along each tendon's own pull is an exponential and keeps its sign at any weights:
    no tendon bends back while it is pulled. Its name says what is seen; tendons that rub and soft bodies that
    flatten or buckle all look so at rest.

    Equation: p_i -> integral from 0 to p_i of exp(2 tanh(L_i(s) / 2)) ds, L_i(s) = a_i s + b_i s^2 + w_i p_n
    + w_m p_m + c_i p_n^2 + d_i p_m^2, for the pull p_i = -dl of a drive, n the next drive of the segment
    counter-clockwise and m the one before (w_i: of the pair i and n). Of two drives n and m are the same:
    w_1, c_1, c_2 alone act. Only the part that bends
    Symbols: a slope, b curvature, w pair, c next, d previous
    Source: definition: the logarithm of the gain, expanded to second order in the pulls
    Residual signature: static, a polynomial of the pulls with their products; none of it for a small pull
    alone
    """

    seam = Seam.ACTUATION
    order = 62.0
    parameters = (
        Parameter("slope", "1/m", bounds=(-3.0, 3.0), typical=0.1, per="drive", of="1/offset"),
        Parameter("curvature", "1/m^2", bounds=(-3.0, 3.0), typical=0.1, per="drive", of="1/offset^2"),
        Parameter("pair", "1/m", bounds=(-3.0, 3.0), typical=0.1, per="drive", of="1/offset"),
        Parameter("next", "1/m^2", bounds=(-3.0, 3.0), typical=0.05, per="drive", of="1/offset^2"),
        Parameter("previous", "1/m^2", bounds=(-3.0, 3.0), typical=0.05, per="drive", of="1/offset^2"),
    )
    excited_by = "each tendon pulled alone, then every two together, over a grid of both pulls"
    confounded_with = ("stiffening", "compression_softening", "drum_gain")
    last_resort = True
    separated_by: ClassVar[Mapping[str, str]] = {
        "stiffening": "each tendon pulled alone, then every two together",
        "drum_gain": "pulls of many amplitudes",
    }

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        routing, n = ports.routing, ports.routing.n_drives
        if not n:
            return
        slope, curvature, pair, onward, back = (values[:, k * n : (k + 1) * n] for k in range(5))
        pull, change = _pulls(ports.dl, routing), np.zeros((len(ports), n))
        following, before = _neighbours(routing)
        for i in range(n):
            own = pull[:, i]
            at_rest = np.zeros(len(ports))
            if (j := following[i]) >= 0:
                own_pair = pair[:, i] if before[i] >= 0 or i < j else pair[:, j]
                at_rest = at_rest + (own_pair + onward[:, i] * pull[:, j]) * pull[:, j]
            if (j := before[i]) >= 0:
                at_rest = at_rest + (pair[:, j] + back[:, i] * pull[:, j]) * pull[:, j]
            for node, weight in zip(_NODES, _WEIGHTS, strict=True):
                s = node * own
                gain = at_rest + (slope[:, i] + curvature[:, i] * s) * s
                change[:, i] += weight * own * np.expm1(_MOST * np.tanh(gain / _MOST))
        ports.shift_tendons(-routing.drive_sign * routing.by_tendon(change))


def _pulls(dl: Floats, routing: Routing) -> Floats:
    """(n, n_drives) how far each drive pulls the first of its tendons [m]."""
    pulls = np.zeros((len(dl), routing.n_drives))
    for t, drive in enumerate(routing.drive):
        pulls[:, drive] -= routing.drive_sign[t] * dl[:, t]
    return np.asarray(pulls / np.bincount(routing.drive))


def _neighbours(routing: Routing) -> tuple[list[int], list[int]]:
    """Return for each drive the next one of its segment counter-clockwise, and the one before; -1 where
    there is none. Of two drives neither has one before, for it would be the next one again."""
    n = routing.n_drives
    following, before = [-1] * n, [-1] * n
    first = [int(np.flatnonzero(routing.drive == d)[0]) for d in range(n)]
    for k in range(routing.n_segments):
        own = [d for d in range(n) if routing.tendon_segment[first[d]] == k]
        y, minus_x = routing.arms[[first[d] for d in own], 2 * k : 2 * k + 2].T
        around = [own[j] for j in np.argsort(np.arctan2(y, -minus_x), kind="stable")]
        for here, other in zip(around, around[1:] + around[:1], strict=True):
            if here != other:
                following[here] = other
                before[other] = here if len(around) > 2 else -1
    return following, before
