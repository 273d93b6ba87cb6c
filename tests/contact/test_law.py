"""The contact law against every choice of open and closed contacts, and, with friction, against its own
conditions."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from numba import njit
from numpy.testing import assert_allclose

from fastrod.kernels.contact.contact_law import ContactLaw, contact_forces

GOOD = 5e-9
"""m; the law is solved to 1e-10 m in its own measure, motions of some mm; conditions add up several of
these."""


@njit()
def _solve_all(W, b, friction, compliance, force, agreed):
    m = friction.shape[1]
    state, along, start = np.empty(m, np.int64), np.empty((m, 2)), np.empty(3 * m)
    system = np.empty((3 * m, 3 * m + 1))
    for i in range(len(W)):
        law = ContactLaw(W[i], b[i], friction[i], compliance[i], force[i], state, along, start, system)
        agreed[i] = 1 if contact_forces(m, law) else 0


def solve(W, b, friction=0.0, compliance=0.0, start=None):
    """Forces (n, 3 m) and which of the worlds W (n, 3 m, 3 m), b (n, 3 m) are said to obey the law."""
    n, m = len(W), b.shape[1] // 3
    force = np.zeros(b.shape) if start is None else start.copy()
    agreed = np.zeros(n, np.int64)
    friction, compliance = (
        np.array(np.broadcast_to(a, (n, m)), float, order="C") for a in (friction, compliance)
    )
    W, b = (np.array(a, float, order="C") for a in (W, b))
    _solve_all(W, b, friction, compliance, force, agreed)
    return force, agreed == 1


def worlds(rng, n, m, condition=100.0):
    """Symmetric positive W of about 0.1 to 10 m/N, and motions of some mm."""
    q = np.linalg.qr(rng.normal(size=(n, 3 * m, 3 * m)))[0]
    eigen = np.exp(rng.uniform(0.0, np.log(condition), (n, 1, 3 * m)))
    W = (q * eigen) @ np.swapaxes(q, 1, 2) * 10.0 ** rng.uniform(-1, 1, (n, 1, 1)) / condition**0.5
    return 0.5 * (W + np.swapaxes(W, 1, 2)), 3e-3 * rng.normal(size=(n, 3 * m))


def along_a_rod(rng, n, m, bunched):
    """W of contacts on a cantilever of 0.1 m that bends two ways and hardly stretches; nearly singular where
    they are `bunched`."""
    s = (
        rng.uniform(0.03, 0.1, (n, 1)) + rng.uniform(-1e-4, 1e-4, (n, m))
        if bunched
        else rng.uniform(0.02, 0.1, (n, m))
    )
    low, high = np.minimum(s[:, :, None], s[:, None]), np.maximum(s[:, :, None], s[:, None])
    bend = low**2 * (3.0 * high - low) / 6.0 / 0.0022
    # columns: x, y, z of the rod in the contact's own axes
    frame = np.linalg.qr(rng.normal(size=(n, m, 3, 3)))[0]
    W = np.einsum("ncik,ncd,ndjk,k->ncidj", frame, bend, frame, np.array([1.0, 1.0, 1e-3]))
    return W.reshape(n, 3 * m, 3 * m), 2e-3 * rng.normal(size=(n, 3 * m))


def by_choice(W, b, compliance):
    """Normal forces without friction: the one choice of closed contacts that obeys Signorini's law."""
    A, c = W[::3, ::3] + np.diag(compliance), b[::3]
    best, least = None, np.inf
    for closed in product((False, True), repeat=len(c)):
        on, force = np.array(closed), np.zeros(len(c))
        if on.any():
            force[on] = np.linalg.lstsq(A[np.ix_(on, on)], -c[on], rcond=None)[0]
        u = A @ force + c
        wrong = max((-force * np.diag(A)).max(), -u.min(), np.abs(u[on]).max(initial=0.0))
        if wrong < least:
            best, least = force, wrong
    return best, least


def violation(W, b, friction, compliance, force):
    """(n,) how far forces are from the law, as a motion [m]: gap, pull, both at once; cone; slip not against
    the force."""
    n, m = len(W), b.shape[1] // 3
    u = ((W @ force[:, :, None])[:, :, 0] + b).reshape(n, m, 3)
    f = force.reshape(n, m, 3)
    size = np.diagonal(W, axis1=1, axis2=2).reshape(n, m, 3)
    un, fn = u[:, :, 0] + compliance * f[:, :, 0], f[:, :, 0]
    normal = np.abs(np.minimum(un, fn * (size[:, :, 0] + compliance)))
    ft, slip, soft = (
        np.linalg.norm(f[:, :, 1:], axis=2),
        np.linalg.norm(u[:, :, 1:], axis=2),
        size[:, :, 1:].max(2),
    )
    cone = np.maximum(ft - friction * fn, 0.0) * soft
    inside = np.minimum(slip, np.maximum(friction * fn - ft, 0.0) * soft)  # what slips is on the cone
    against = np.linalg.norm(ft[:, :, None] * u[:, :, 1:] + slip[:, :, None] * f[:, :, 1:], axis=2) * soft
    opposed = np.minimum(slip, against / np.maximum(slip, ft * soft + 1e-300))
    return np.where(
        friction > 0.0,
        np.maximum(normal, np.maximum(cone, np.maximum(inside, opposed))),
        np.maximum(normal, ft * soft),
    ).max(1)


@pytest.mark.parametrize("m", [1, 2, 3, 5])
@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.study(beyond=4)
def test_without_friction_it_is_the_right_choice_of_contacts(m, soft):
    rng = np.random.default_rng(1)
    n = 120
    W, b = worlds(rng, n, m)
    compliance = rng.uniform(0.0, 1.0, (n, m)) * soft
    force, agreed = solve(W, b, 0.0, compliance)
    assert agreed.all()
    pressed = 0
    for i in range(n):
        expected, least = by_choice(W[i], b[i], compliance[i])
        assert least < 1e-12
        assert_allclose(force[i, ::3] * np.diag(W[i])[::3], expected * np.diag(W[i])[::3], rtol=0, atol=1e-9)
        pressed += (expected > 0.0).sum()
    assert 0.2 * n * m < pressed < 0.8 * n * m
    assert_allclose(force.reshape(n, m, 3)[:, :, 1:], 0.0, rtol=0, atol=1e-15)


@pytest.mark.parametrize("m", [2, 4])
def test_contacts_that_say_the_same_share_a_force(m):
    """The forces are not unique, the motion is."""
    rng = np.random.default_rng(2)
    n = 60
    W, b = worlds(rng, n, m)
    twice = np.concatenate([np.arange(3 * m), np.arange(3)])
    force, agreed = solve(W[:, twice][:, :, twice], b[:, twice])
    assert agreed.all()
    joined = force[:, : 3 * m].copy()
    joined[:, :3] += force[:, 3 * m :]
    for i in range(n):
        expected, _ = by_choice(W[i], b[i], np.zeros(m))
        assert_allclose(joined[i, ::3] * np.diag(W[i])[::3], expected * np.diag(W[i])[::3], rtol=0, atol=GOOD)
    assert (force.reshape(n, m + 1, 3)[:, :, 0] * 0.01 > -GOOD).all()


@pytest.mark.parametrize("mu", [0.1, 0.3, 0.6, 1.0])
@pytest.mark.parametrize("m", [1, 2, 3, 6])
def test_with_friction_the_law_holds(m, mu):
    rng = np.random.default_rng(3)
    W, b = worlds(rng, 300, m)
    compliance = np.where(rng.random((300, m)) < 0.3, rng.uniform(0.0, 0.5, (300, m)), 0.0)
    force, agreed = solve(W, b, mu, compliance)
    wrong = violation(W, b, np.full((300, m), mu), compliance, force)
    assert wrong[agreed].max() < GOOD
    assert agreed.mean() > 0.99
    f = force.reshape(300, m, 3)
    on_cone = np.abs(np.linalg.norm(f[:, :, 1:], axis=2) - mu * f[:, :, 0]) < 1e-9 * f[:, :, 0]
    pressed = f[:, :, 0] > 0.0
    assert (pressed & on_cone).sum() > 0.05 * pressed.sum()
    assert mu < 0.2 or (pressed & ~on_cone).any()  # some slip, and where the cone is wide some stick


@pytest.mark.parametrize("bunched", [False, True])
@pytest.mark.parametrize("mu", [0.0, 0.3, 0.8])
def test_the_law_on_a_rod_is_never_claimed_in_vain(mu, bunched):
    """Compliances of real rods, nearly singular: what is said to obey the law does."""
    rng = np.random.default_rng(4)
    shares = []
    for m in (1, 2, 3, 5):
        W, b = along_a_rod(rng, 200, m, bunched)
        force, agreed = solve(W, b, mu, 1e-3)
        wrong = violation(W, b, np.full((200, m), mu), np.full((200, m), 1e-3), force)
        assert wrong[agreed].max(initial=0.0) < GOOD, m
        shares.append(agreed.mean())
    assert shares[0] == 1.0
    assert np.mean(shares) > 0.8


def test_any_start_ends_at_the_same_forces():
    rng = np.random.default_rng(5)
    W, b = worlds(rng, 100, 3, condition=10.0)
    one, agreed = solve(W, b, 0.2)
    two, also = solve(W, b, 0.2, start=1e-2 * rng.normal(size=b.shape))
    assert agreed.all()
    assert also.all()
    size = np.diagonal(W, axis1=1, axis2=2)
    close = np.abs((one - two) * size).max(1) < GOOD
    assert close.mean() > 0.97  # little friction on a well-conditioned W: almost always unique
    kept, again = solve(W, b, 0.2, start=one)
    assert again.all()
    assert_allclose(kept * size, one * size, rtol=0, atol=GOOD)


WEDGE = (
    np.kron(np.array([[1.0, -1.0], [-1.0, 1.0]]), np.diag([1.0, 0.5, 0.5]))[None],
    np.array([[-1e-3, 0.0, 0.0, -1e-3, 0.0, 0.0]]),
)
"""Two walls that face each other on one point, each 1 mm too near."""


def test_a_wedge_of_soft_walls_shares_the_overlap():
    force, agreed = solve(*WEDGE, 0.0, 0.01)
    assert agreed.all()
    assert_allclose(force[0, ::3], 0.1, rtol=1e-6)


def test_a_wedge_of_rigid_walls_is_not_called_solved():
    _, agreed = solve(*WEDGE)
    assert not agreed.any()


@pytest.mark.parametrize("compliance", [0.0, np.nan])
def test_a_contact_that_cannot_move_is_not_called_solved(compliance):
    _, agreed = solve(np.full((1, 3, 3), compliance), np.array([[-1e-3, 0.0, 0.0]]))
    assert not agreed.any()
