"""The rod of modes: gradient and Hessian of its kernels against differences of an energy in plain numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fastrod.kernels.jit import entry
from fastrod.kernels.rod.lanes import W
from fastrod.kernels.rod.modal import fields as ml
from fastrod.kernels.rod.modal.assembly import assemble
from fastrod.kernels.rod.modal.fields import ModalWork, modal_workspace
from fastrod.kernels.rod.modal.modes import ModalBasis, integral_row, modal_basis
from fastrod.kernels.rod.modal.newton import sweep

LENGTH, DENSITY, TAU, ALPHA, RATE = 0.08, 0.3, 0.01, 50.0**2, 50.0
PRETENSION, COMPLIANCE = 1.0, 1e-4
SPIN = (1e-6, 2e-6, 5e-7)  # kg m^2 of the directors of a node
SIZE = np.array([6.0, 6.0, 6.0, 0.3, 0.3, 0.1])  # of a mode of each kind: 1/m, strains
STEP = np.array([1e-3, 1e-3, 1e-3, 1e-5, 1e-5, 1e-5])


@entry
def evaluate(b: ModalBasis, first: Any, command: Any, work: Any) -> None:
    sweep(b, first, command, work, True)
    assemble(b, first, work)


def fields(a: np.ndarray) -> np.ndarray:
    """The buffer with its lanes as an axis of their own."""
    return a.reshape(*a.shape[:-1], -1, W)


class Rods:
    """W random robots: everything at once that the modes can carry."""

    def __init__(self, b: ModalBasis, n_pieces: int, n_tendons: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.b, self.n_modes = b, len(b.component)
        self.kind = np.tile(b.component, n_pieces)
        self.first = np.minimum(np.arange(n_pieces), n_tendons)
        self.work = work = ModalWork(*(a[0] for a in modal_workspace(1, n_pieces, n_tendons, 2, b)))
        piece = fields(work.piece)
        piece[:, ml.P_L] = LENGTH * rng.uniform(0.8, 1.2, (n_pieces, W))
        piece[:, ml.P_K : ml.P_K + 6] = np.array([2e-3, 3e-3, 1e-3, 40.0, 30.0, 90.0])[:, None]
        piece[:, ml.P_UNEVEN] = 1.0
        interval = fields(work.interval)
        interval[:, :, ml.I_STAR : ml.I_STAR + 6] = rng.normal(size=(n_pieces, len(b.width), 6, W))
        interval[:, :, ml.I_DK : ml.I_DK + 6] = 3e-4 * rng.normal(size=(n_pieces, len(b.width), 6, W))
        interval[:, :, ml.I_HISTORY : ml.I_HISTORY + 6] = rng.normal(size=(n_pieces, len(b.width), 6, W))
        piece[:, ml.P_TAU], piece[:, ml.P_RHO] = TAU, DENSITY
        station = fields(work.station)
        station[:, :, ml.S_MASS] = 0.02
        station[:, :, ml.S_HISTORY : ml.S_HISTORY + 6] = rng.normal(size=(n_pieces, 2, 6, W)) * 0.05
        for k, x in enumerate((0.37, 1.0)):
            station[:, k, ml.S_ROW :] = integral_row(x)[:, None]
        history = fields(work.history)
        history[:] = rng.normal(size=history.shape)
        history[:, :, :3] *= 0.05
        history[:, :, ml.H_MOMENT : ml.H_MOMENT + 3] = 0.0  # a moment has no energy
        history[:, :, ml.H_J : ml.H_J + 3] = np.array(SPIN)[:, None]
        fields(work.offset)[:] = rng.normal(size=(n_pieces, 2 * n_tendons, W)) * 0.006
        turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        fields(work.base)[:] = np.concatenate([(turned * np.linalg.det(turned)).ravel(), [0.1] * 3])[:, None]
        fields(work.scheme)[:] = np.array([[ALPHA], [RATE]])
        fields(work.outside)[:9] = (
            rng.normal(size=(9, W)) * np.array([0.3] * 3 + [0.0] * 3 + [5.0] * 3)[:, None]
        )
        fields(work.q_history)[:] = rng.normal(size=(len(self.kind), W)) * SIZE[self.kind][:, None]
        self.command = np.zeros((4, n_tendons * W))
        self.command[1:] = np.array([COMPLIANCE, PRETENSION, 0.0])[:, None]
        self.q = rng.normal(size=(len(self.kind), W)) * SIZE[self.kind][:, None]
        self.derivatives(self.q)
        self.command[0] = work.path_length + 2e-4 * rng.normal(size=n_tendons * W)

    def derivatives(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n_q, W) and (n_q, n_q, W) of the kernels."""
        fields(self.work.q)[:] = q
        evaluate(self.b, self.first, self.command, self.work)
        n = len(q)
        low = fields(self.work.hessian).reshape(n, n, W)
        full = np.where(np.tri(n, dtype=bool)[:, :, None], low, low.transpose(1, 0, 2))
        return fields(self.work.gradient).copy(), full

    def energy(self, q: np.ndarray) -> np.ndarray:
        """(W,) of the last shape's positions, whose gradient is the balance."""
        self.derivatives(q)
        work, b, total = self.work, self.b, np.zeros(W)
        node, history, piece = fields(work.node), fields(work.history), fields(work.piece)
        force, gravity = fields(work.outside)[:3], fields(work.outside)[6:9]
        for p in range(len(piece)):
            length = piece[p, ml.P_L]
            for j, weight in enumerate(b.integral[-1]):
                position = node[p, j, ml.N_POS : ml.N_POS + 3]
                moved = position - history[p, j, :3]
                total += 0.5 * DENSITY * weight * length * ALPHA * (moved**2).sum(0)
                total -= weight * length * (history[p, j, ml.H_LINE : ml.H_LINE + 3] * position).sum(0)
                rotation = node[p, j, :9].reshape(3, 3, W)
                for k, spin in enumerate(SPIN):
                    field = ml.H_D + 3 * k
                    turned = rotation[:, k] - history[p, j, field : field + 3]
                    total += 0.5 * spin * ALPHA * (turned**2).sum(0)
            interval = fields(work.interval)[p]
            strain = interval[:, ml.I_U : ml.I_U + 6] - interval[:, ml.I_STAR : ml.I_STAR + 6]
            damped = TAU * RATE * (strain - interval[:, ml.I_HISTORY : ml.I_HISTORY + 6]) ** 2
            k = b.width[:, None, None] * interval[:, ml.I_DK : ml.I_DK + 6]
            total += 0.25 * length * (k * (strain**2 + damped)).sum((0, 1))
            for station in fields(work.station)[p]:
                tangents = node[p, :, ml.N_T : ml.N_T + 3]
                place = node[p, 0, ml.N_POS : ml.N_POS + 3] + length * np.einsum(
                    "jw,jcw->cw", station[ml.S_ROW :], tangents
                )
                moved = place - station[ml.S_HISTORY : ml.S_HISTORY + 3]
                total += 0.5 * 0.02 * ALPHA * (moved**2).sum(0)
                total -= ((0.02 * gravity + station[ml.S_GIVEN : ml.S_GIVEN + 3]) * place).sum(0)
            for a, (c, m) in enumerate(zip(b.component, b.degree, strict=True)):
                k = piece[p, ml.P_K + c] * length / (2 * m + 1)
                i = p * self.n_modes + a
                rate = q[i] - fields(work.q_history)[i]
                total += 0.5 * k * (q[i] ** 2 + TAU * RATE * rate**2)
        longer = fields(work.path_length) - fields(self.command[0])
        total += (PRETENSION * longer + 0.5 * longer**2 / COMPLIANCE).sum(0)
        return total - (force * node[-1, -1, ml.N_POS : ml.N_POS + 3]).sum(0)


CASES = [
    ((4, 2), 1, 2),
    ((4, 2), 2, 3),
    ((6, 4), 3, 4),
    ((4, 2, 0, 2), 2, 3),
    ((4, 2, 2, 2), 2, 3),
    ((3, 1, 1, 1), 3, 0),
]


@pytest.mark.study(beyond=2)
@pytest.mark.parametrize(("modes", "n_pieces", "n_tendons"), CASES)
def test_gradient_and_hessian_are_those_of_the_energy(
    modes: tuple[int, ...], n_pieces: int, n_tendons: int
) -> None:
    rods = Rods(modal_basis(*modes), n_pieces, n_tendons)
    gradient, hessian = (a.copy() for a in rods.derivatives(rods.q))
    scale = np.sqrt(np.abs(np.einsum("iiw->iw", hessian)))
    for i in range(len(rods.q)):
        step = np.zeros_like(rods.q)
        step[i] = STEP[rods.kind[i]]
        ahead, behind = rods.energy(rods.q + step), rods.energy(rods.q - step)
        # the energy's fourth digit from its end is left by the difference
        by_energy = (ahead - behind) / (2.0 * step[i])
        assert_allclose(gradient[i], by_energy, rtol=0, atol=2e-7 * np.abs(gradient).max())
        up, down = rods.derivatives(rods.q + step)[0], rods.derivatives(rods.q - step)[0]
        by_gradient = (up - down) / (2.0 * step[i]) / (scale * scale[i])
        assert_allclose(hessian[:, i] / (scale * scale[i]), by_gradient, rtol=0, atol=2e-6)
