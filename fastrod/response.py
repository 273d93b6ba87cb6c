"""Linear response of robots at rest: how the tip answers inputs and forces, contact forces held."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fastrod.passes import NO_PROBES, Passes
from fastrod.types import Floats, Ints, Ports, Probes, Response, Shape


class Linear:
    """Passes that change nothing, at the present boundary of `rows`, with their linear response.

    `probes` are the contact forces that act on each row of `rows`. The last one is at the tip and carries none: its columns
    are those of a tip force.
    """

    def __init__(self, passes: Passes, rows: Ints, ports: Ports, probes: Probes = NO_PROBES) -> None:
        self.passes, self.rows, self.ports, self.probes = passes, rows, ports, probes

    def respond(self, ports: Ports | None = None, columns: bool = True) -> tuple[Response, Shape]:
        """Residuals, tip and their derivatives by the unknowns and, last, by a tip force; rows that are not asked are nan."""
        passes, ports = self.passes, ports or self.ports
        n, n_e, n_probes = passes.n_robots, passes.n_residuals(ports), self.probes.node.shape[1]
        extra = 3 * n_probes if n_probes else 0 if len(ports.follower_force) else 3
        n_col = passes.n_x + extra if columns or n_probes else 0
        response = Response(np.full((n, n_e, n_col), np.nan), np.full((n, 6, n_col), np.nan), np.full((n, n_e), np.nan))
        shape = passes.new_shape("tip", True)
        passes.run(self.rows, ports, shape, response=response, update=False, noise=1e-20, n_col=n_col, probes=self.probes)
        return response, shape

    def by_lengths(self) -> tuple[Floats, Floats]:
        """(n, 6, n_rows) change of the tip per residual closed: the columns of tendon lengths first."""
        response, _ = self.respond()
        n_x = self.passes.n_x
        by_residual = response.tip[:, :, :n_x] @ inverse(response.residual[:, :, :n_x])
        return by_residual, response.residual

    def by_force(self) -> Floats:
        """(n, 6, 3) change of the tip per tip force."""
        response, _ = self.respond()
        n_x, params = self.passes.n_x, self.passes.params
        free, load = response.residual[:, :, :n_x], response.residual[:, :, -3:]
        if len(self.ports.follower_force) and not self.probes.node.shape[1]:
            # the follower force is an unknown; a dead force enters as its column, but not its own row
            load = load.copy()
            load[:, -3:] -= (params.reach**2 / params.moment_scale)[:, None, None] * np.eye(3)
        return np.asarray(response.tip[:, :, -3:] - response.tip[:, :, :n_x] @ (inverse(free) @ load))

    def difference(self, moved: Callable[[float], Ports], delta: Floats) -> tuple[Floats, Floats]:
        """Central difference of tip pose (n, 6) and residuals (n, n_e) at fixed unknowns, by the input that `moved(+-1)` moves."""
        ends = []
        for sign in (1.0, -1.0):
            response, shape = self.respond(moved(sign), columns=False)
            ends.append((shape.tip_position, shape.tip_rotation, response.error))
        (p1, r1, e1), (p0, r0, e0) = ends
        turn = r1 @ np.swapaxes(r0, 1, 2)
        skew = 0.5 * np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], axis=1)
        return np.concatenate([p1 - p0, skew], axis=1) / (2.0 * delta), (e1 - e0) / (2.0 * delta)


def inverse(a: Floats) -> Floats:
    """Least-squares inverse of the matrices without nan, and nan for the others."""
    found = np.full((len(a), a.shape[2], a.shape[1]), np.nan)
    good = np.isfinite(a).all((1, 2))
    found[good] = np.linalg.pinv(a[good])
    return found
