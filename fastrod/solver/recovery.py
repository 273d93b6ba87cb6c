"""Robots whose observer pass diverged are settled on the same inputs; robots pressed beyond what a rod
carries are not ok, however they were solved; the others keep every bit."""

from __future__ import annotations

import numpy as np

from fastrod.errors import Problem, ProblemSentence
from fastrod.solver.boundary import BoundarySolver
from fastrod.solver.settle import Pass, load_parameter, settle
from fastrod.types import Flags, Floats, Ints, Layout, Params, Ports, RodShape

TOLERANCE = 1e-9  # m: that of `Simulator.settle`
# of F l^2/EI: on three shipped robots `settle` solves all of 180 random tip forces of 20, 8 to 100 % of those
# of 50, and at most 2 % of those of 200. It is also three times pi^2, at which a segment whose ends the
# tendons hold buckles: a straight rod under more is solved to rounding, but no rod stands like that.
HOPELESS = 30.0


class Boundary:
    """The boundary before a step, to which robots that diverged go back."""

    def __init__(self, passes: BoundarySolver, kept: tuple[Floats, Floats] | None) -> None:
        """`kept`: `BoundarySolver.kept` before the step."""
        self._passes, self._kept = passes, kept

    def put_back(self, rows: Ints, ports: Ports) -> None:
        """These robots stand where they stood before the step, on the inputs `ports`; what the pass learned
        is forgotten."""
        memory = self._passes.memory
        if self._kept is not None:
            memory.x[rows], memory.curvature_guess[rows] = self._kept[0][rows], self._kept[1][rows]
        memory.gain[rows] = 0.0
        if len(memory.covariance):
            memory.covariance[rows] = 0.0
        self._passes.arrive_at(rows, ports)

    def recover(self, lost: Ints, warm: Flags, ports: Ports, run: Pass) -> Ints:
        """`settle` these robots on `ports`: from where they stood, then from the cold guess, then by their
        loads.

        (n_robots,) passes that each took, -1 where none of these ended below `TOLERANCE`: they stand where
        they stood.
        """
        self.put_back(lost, ports)
        known = warm if self._kept is not None else np.zeros_like(warm)
        used = settle(lost, known, self._passes, ports, TOLERANCE, run)
        if len(failed := lost[used[lost] < 0]):
            self.put_back(failed, ports)
        if len(self._passes.memory.covariance):
            self._passes.memory.covariance[lost] = 0.0
        return used


def overloaded(params: Params, ports: Ports, row: int) -> float:
    """F l^2/EI of a robot's loads where that is beyond what a rod can hold, else 0."""
    size = float(load_parameter(np.array([row]), params, ports)[0])
    return size if size > HOPELESS else 0.0


def pressed(params: Params, ports: Ports, shape: RodShape, rows: Ints) -> Floats:
    """(n_rows,) compression of each robot's worst segment, P l^2/EI of that segment; zero where the rod is
    pulled.

    P is the internal force along the chord from base to tip, times chord / length, at that end where it
    presses less: all of the force where the rod is straight, little where it has buckled and stands in a
    stable shape.
    """

    def of(a: Floats) -> Floats:
        return a if len(a) == 1 else a[rows]

    length = of(params.length + ports.extension)
    force = of(ports.tip_force)
    if len(ports.follower_force):
        force = force + np.einsum("nij,nj->ni", shape.tip_rotation[rows], of(ports.follower_force))
    beyond = np.einsum("nk,nka->na", length, of(ports.line_force).mean(2))
    if len(ports.node_force):
        beyond = beyond + of(ports.node_force).sum(1)
    total = length.sum(1)[:, None]
    chord = (shape.tip_position[rows] - of(ports.base_pose)[:, :3]) / total
    along = np.minimum(-(force * chord).sum(1), -((force + beyond) * chord).sum(1))
    stiffness = of(ports.stiffness).max(2)[:, :, :2].min(2)
    return np.asarray(np.maximum(along, 0.0) * (length**2 / stiffness).max(1))


def unstable(params: Params, ports: Ports, shape: RodShape, rows: Ints) -> Ints:
    """Those of `rows` whose solved shape is an unstable balance, far beyond the load at which a segment
    buckles."""
    rows = rows[load_parameter(rows, params, ports) > HOPELESS]
    return rows[pressed(params, ports, shape, rows) > HOPELESS]


FOLDS = 0.9
"""Curvature times offset of a tendon, from which on its path on the inside of the bend is hardly longer than
nothing: where it is 1 the path's length has a kink, and Newton's method swings about it."""


def tendon_bend(curvature: Floats, params: Params, layout: Layout) -> Floats:
    """(n_robots,) largest curvature (n_robots, n_points, 3) [1/m] times the offset of a tendon on the inside:
    by so much is its path shorter than the rod there. nan without a shape."""
    most = np.full(len(curvature), -np.inf)
    for k, first in enumerate(layout.first_tendon):
        offset = params.offset[:, k, None, first:]
        last = k + 1 == len(layout.first_tendon)
        here = curvature[:, k * layout.n_steps : (k + 1) * layout.n_steps + last, None]
        inside = here[..., 1] * offset[..., 0] - here[..., 0] * offset[..., 1]
        most = np.maximum(most, inside.max((1, 2), initial=-np.inf))
    return most


def sentence_of(
    reason: str, kind: Problem, params: Params, ports: Ports, shape: RodShape, row: int
) -> ProblemSentence:
    """Return why a robot has no shape, how far off it is, and what to change."""
    what = "give inputs that a rod of this length can follow, or come there in smaller changes"
    if size := overloaded(params, ports, row):
        kind, force = (Problem.OVERLOADED, _of(params.moment_scale, row) / _of(params.rod_length, row))
        what = f"its loads are {size:.3g} times what bends it, EI/l^2 = {force:.3g} N: give less load"
    return ProblemSentence(f"{reason}; residual {shape.residual[row]:.3g} m; {what}.", kind)


def _of(a: Floats, row: int) -> float:
    return float(a[row if len(a) > 1 else 0])
