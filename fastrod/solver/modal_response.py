"""Linear response of rods of modes: how the tip answers inputs and forces, and how they ring."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from fastrod.kernels.rod.modal.derivatives import ModalDerivatives
from fastrod.kernels.rod.modal.motion import NODE_VECTORS, ModalMotion
from fastrod.solver.modal import ModalSolver, Step
from fastrod.solver.response import ROTATIONS, Relocate, rotation_differences
from fastrod.types import Flags, Floats, Ints, Ports

_ENOUGH = 20  # Newton steps on a balance that is nearly solved
_LAST = 1e-10  # of the largest unknown: a Newton step below it leaves an error of its square
_STEP = 1e-4
"""Relative step of a length or a force, at fixed unknowns: the error of a central difference is of its
square, and of rounding over it, some 1e-9 both."""


@dataclass(frozen=True)
class ModalLinear:
    """Robots `rows` near their last shape, inertia aside. A robot whose shape is no rest answers as one that
    is held there."""

    modal: ModalSolver
    rows: Ints
    ports: Ports
    points: tuple[Floats, ...]
    """Point forces at their arclengths: (n_robots, m) [m] and (n_robots, m, 3) [N]."""

    def jacobian(self, relocate: Relocate | None = None, turning: bool = False) -> Floats:
        """(n_robots, 6, n_tendons + n_segments) change of the tip by tendons (length, or tension where that
        is the mode), then by extensions; with `turning` three columns more, by the rotation vector of the
        base, world. `relocate` returns what an extension moves besides itself."""
        layout, params = self.modal.layout, self.modal.params
        held = set(layout.free_tendon.tolist())
        length, force = float(np.max(params.rod_length)), float(np.max(params.tension_scale))
        inputs = [
            ("tendon_length", t, length) if t in held else ("tension", t, force)
            for t in range(len(layout.tendon_segment))
        ]
        inputs += [("extension", k, length) for k in range(len(layout.first_tendon))]
        columns = [self._by_port(name, k, _STEP * size, relocate) for name, k, size in inputs]
        columns += [self._by_rotation(k) for k in range(3 if turning else 0)]
        moved = (np.stack([column[k] for column in columns], 2) for k in range(2))
        return self._close(self.modal.derive(self.rows, self.ports), *moved)

    def by_load(self) -> Floats:
        """(n_robots, 6, 6) change of the tip per tip force and moment."""
        found = self.modal.derive(self.rows, self.ports)
        return self._close(found, np.zeros((len(found.tip), 6, 6)), -np.swapaxes(found.tip, 1, 2))

    def _close(self, found: ModalDerivatives, tip: Floats, gradient: Floats) -> Floats:
        """(n_robots, 6, m) of the changes (n_robots, 6, m) and (n_robots, n_q, m) at fixed unknowns."""
        answer = np.full(tip.shape, np.nan)
        some = self.rows
        moved = np.linalg.solve(stiffness(found, self.ports.tip_moment)[some], gradient[some])
        answer[some] = tip[some] - found.tip[some] @ moved
        return answer

    def _by_port(
        self, name: str, column: int, delta: float, relocate: Relocate | None
    ) -> tuple[Floats, Floats]:
        port = getattr(self.ports, name)
        sides = []
        for sign in (1.0, -1.0):
            moved = port.copy()
            moved[:, column] += sign * delta
            more: dict[str, Any] = {name: moved}
            if name == "extension":
                self.modal.place_points(self.points, moved)
                more |= {} if relocate is None else dict(relocate(moved))
            sides.append(self.modal.derive(self.rows, self.ports._replace(**more), wanted=()))
        if name == "extension":
            self.modal.place_points(self.points, self.ports.extension)
        return _difference(sides, delta)

    def _by_rotation(self, axis: int) -> tuple[Floats, Floats]:
        sides = []
        for rotation in ROTATIONS[2 * axis : 2 * axis + 2, 0]:
            pose = self.ports.base_pose.copy()
            pose[:, 3:] = pose[:, 3:] @ rotation.T / math.sqrt(1.0 + 0.25e-8)
            sides.append(self.modal.derive(self.rows, self.ports._replace(base_pose=pose), wanted=()))
        return _difference(sides, 1e-4)

    def frequencies(self, count: int) -> Floats:
        """(n_robots, count) lowest natural frequencies [Hz] of small motions about this shape, undamped; nan
        where a robot would leave it."""
        found = self.modal.derive(self.rows, self.ports)
        answer = np.full((len(found.mass), count), np.nan)
        for i in self.rows:
            try:
                lower = np.linalg.inv(np.linalg.cholesky(found.hessian[i]))
            except np.linalg.LinAlgError:
                continue
            # 1 / w^2: the mass may be next to nothing in some direction, the stiffness is not
            square = np.maximum(np.linalg.eigvalsh(lower @ found.mass[i] @ lower.T), 0.0)[::-1][:count]
            with np.errstate(divide="ignore"):
                answer[i, : len(square)] = 1.0 / (2.0 * math.pi * np.sqrt(square))
        return answer


def stiffness(found: ModalDerivatives, tip_moment: Floats) -> Floats:
    """(n_robots, n_q, n_q) derivative of the gradient, with the rotation of forces that follow the rod, and
    what makes that of a moment (n_robots or 1, 3) unsymmetric: dth_a/dq_b - dth_b/dq_a = th_a x th_b."""
    full, n_nodes = found.hessian, found.line.shape[1]
    if n_nodes:
        change = found.number_change[:, : NODE_VECTORS * n_nodes]
        change = change.reshape(len(full), n_nodes, NODE_VECTORS // 3, 3, -1)  # place, then the directors
        turned = np.einsum("njk,njkca->njca", found.line, change[:, :, 1:])
        full = full - np.einsum("njca,njcb->nab", change[:, :, 0], turned, optimize=True)
    if found.force.any():
        full = full + np.swapaxes(found.tip[:, :3], 1, 2) @ _across(found.force) @ found.tip[:, 3:]
    if tip_moment.any():  # the Hessian has its lower triangle twice
        full = full - np.triu(np.swapaxes(found.tip[:, 3:], 1, 2) @ _across(tip_moment) @ found.tip[:, 3:], 1)
    return np.asarray(full)


def _across(v: Floats) -> Floats:
    """(n, 3, 3) matrices of v x."""
    x, y, z = v.T
    o = np.zeros_like(x)
    return np.asarray(np.array([[o, -z, y], [z, o, -x], [-y, x, o]]).transpose(2, 0, 1))


def full_newton(
    modal: ModalSolver,
    rows: Ints,
    ports: Ports,
    start: Floats,
    wanted: Collection[str] = ("hessian",),
    step: tuple[ModalMotion, Step, Floats] | None = None,
) -> tuple[Floats, Flags]:
    """(n_robots, n_q) unknowns of a balance near `start`, and (n_rows,) who found it, by steps with all of
    the `stiffness`: slower than the solver's own, and quadratic also where a line force follows the rod.
    `step` as in `ModalSolver.derive`."""
    q, ended = start.copy(), np.zeros(len(rows), bool)
    for _ in range(_ENOUGH):
        if not len(some := rows[~ended]):
            break
        found = modal.derive(some, ports, q, wanted=wanted, step=step)
        matrix = stiffness(found, ports.tip_moment)[some]
        change = np.linalg.solve(matrix, found.gradient[some][:, :, None])[:, :, 0]
        largest = np.abs(change).max(axis=1, initial=0.0)
        q[some] -= change
        ended[~ended] = largest <= _LAST * np.maximum(1.0, np.abs(q[some]).max(axis=1, initial=0.0))
    return q, ended


def _difference(sides: list[ModalDerivatives], delta: float) -> tuple[Floats, Floats]:
    """(n_robots, 6) and (n_robots, n_q): change of tip and gradient, forward and back."""
    ahead, behind = sides
    turned = rotation_differences(ahead.rotation, behind.rotation)
    tip = np.concatenate([ahead.position - behind.position, turned], axis=1)
    return tip / (2.0 * delta), (ahead.gradient - behind.gradient) / (2.0 * delta)
