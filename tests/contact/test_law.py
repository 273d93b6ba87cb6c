"""The contact law: the step of a world is where its potential is least, and its forces are in their cones."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from numpy.testing import assert_allclose

from fastrod.kernels.contact.press import press
from fastrod.kernels.contact.pressed_world import SOFT, PressedWorld
from fastrod.types import CONTACT, ContactSet


@njit()
def _press(m, n, own, contacts, pressing):
    return press(m, n, own, contacts, pressing, np.inf, True)


def world(rng, m, n, mu):
    """Random rods of n unknowns with m contacts, of stiffnesses and motions as they have."""
    q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    hessian = (q * np.exp(rng.uniform(0.0, 5.0, n))) @ q.T
    law = np.zeros((m, 5))
    law[:, 0], law[:, 1] = mu, SOFT
    law[:, 2:4], law[:, 4] = rng.uniform(-0.1, 0.1, (m, 2)), rng.uniform(0.0, 1e-4, m)
    side = np.stack([np.zeros(m, int), np.arange(m), np.full(m, -1), np.full(m, -1)], axis=1)
    return PressedWorld(
        hessian,
        rng.normal(size=n),
        side,
        np.tile(np.eye(3), (m, 1, 1)),
        rng.normal(size=(m, 3, n)),
        np.zeros((m, 3, n)),
        1e-3 * rng.normal(size=(m, 3)),
        law,
        np.zeros((m, 3, 3)),
        np.zeros((m, 2, n)),
        np.zeros((m, 3)),
        np.empty((n, n)),
        np.empty(n),
        np.empty((5, n)),
    )


def nearest_in_cone(y, mu):
    """By search over the surface of the cone, where y is outside of it."""
    size = np.linalg.norm(y[1:])
    if size <= mu * y[0]:
        return y
    along = y[1:] / size if size else np.zeros(2)
    edge = np.array([1.0, *(mu * along)])
    return max(y @ edge, 0.0) / (edge @ edge) * edge


@pytest.mark.parametrize("mu", [0.0, 0.3, 0.8])
@pytest.mark.parametrize(("m", "n"), [(1, 5), (4, 12), (12, 20)])
def test_forces_obey_the_law_and_balance_the_rod(m, n, mu):
    rng = np.random.default_rng(m)
    for _ in range(20):
        pressing, contacts = world(rng, m, n, mu), ContactSet(np.array([m]), np.zeros((1, m), CONTACT))
        _press(m, n, n, contacts, pressing)
        force, step = contacts.contact["force"][0], pressing.step
        u = pressing.free + pressing.along @ step
        law = pressing.law
        y = np.column_stack([-(u[:, 0] + mu * law[:, 4]) / SOFT, law[:, 2:4] - u[:, 1:] / SOFT])
        asked = np.array([nearest_in_cone(one, mu) for one in y])
        # y is rounded by the unknowns' digits over R
        assert_allclose(force, asked, rtol=1e-6, atol=1e-5)
        balance = pressing.hessian @ step + pressing.gradient - np.einsum("mk,mkn->n", force, pressing.along)
        assert_allclose(balance, 0.0, atol=1e-4)
        assert (force[:, 0] >= 0.0).all()
        assert (np.linalg.norm(force[:, 1:], axis=1) <= mu * force[:, 0] * (1.0 + 1e-9) + 1e-12).all()
        if mu == 0.0:
            assert (u[:, 0][force[:, 0] > 0.0] < 1e-6).all()


def test_a_model_without_a_minimum_is_damped_until_it_has_one():
    rng = np.random.default_rng(0)
    pressing = world(rng, 2, 6, 0.2)
    pressing.hessian[:] -= 1.5 * np.diag(pressing.hessian.diagonal())
    assert np.linalg.eigvalsh(pressing.hessian)[0] < 0.0
    _press(2, 6, 6, ContactSet(np.array([2]), np.zeros((1, 2), CONTACT)), pressing)
    assert np.isfinite(pressing.step).all()
    assert np.abs(pressing.step).max() < 1e3


def test_a_body_moves_by_its_mobility_though_the_rods_hessian_is_damped():
    # P d = J^T lambda: by the forces alone, whatever it takes to make the rods' part definite
    rng, m, own, n = np.random.default_rng(1), 3, 6, 9
    pressing, contacts = world(rng, m, n, 0.2), ContactSet(np.array([m]), np.zeros((1, m), CONTACT))
    pressing.hessian[own:], pressing.hessian[:, own:], pressing.gradient[own:] = 0.0, 0.0, 0.0
    pressing.hessian[:own, :own] -= 1.5 * np.diag(pressing.hessian.diagonal()[:own])
    body = np.array([4e3, 2e3, 50.0])
    pressing.hessian[own:, own:] = np.diag(body)
    pressing.free[:, 0] = -0.01
    assert np.linalg.eigvalsh(pressing.hessian)[0] < 0.0
    _press(m, n, own, contacts, pressing)
    force = contacts.contact["force"][0]  # the axes are the world's
    assert (force[:, 0] > 0.1).any()
    assert_allclose(
        pressing.step[own:] * body, np.einsum("mra,mr->a", pressing.along[..., own:], force), rtol=1e-6
    )
