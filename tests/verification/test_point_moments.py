"""A moment at a point of a rod of modes, and a force on an arm that turns with the rod."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.testing import assert_allclose

from fastrod import Modal, Modes, Robot, Segment, Simulator

LENGTH, STEP = 0.1, 1e-4


def test_a_moment_works_on_the_rotation_of_its_cross_section() -> None:
    """By differences: gradient - M . th, and of that the Hessian of one order of unknowns. The rest of the
    second derivatives of a force f on an arm A, M = A x f, is what contact adds."""
    segment = Segment(
        length=LENGTH, bending_stiffness=(0.01, 0.01), torsional_stiffness=0.008, mode="passive"
    )
    sim = Simulator(Robot(name="rod", segments=(segment,)), solver=Modal(modes=Modes(4, 2, pieces=2)))
    sim.settle(tip_force=(0.05, 0.02, 0.0))
    rods: Any = sim._rods
    modal, ports, rows = rods.modal, sim._ports, np.array([0])
    rng = np.random.default_rng(0)
    q = modal.motion.q + 0.5 * rng.normal(size=modal.motion.q.shape)
    force, arm = 0.5 * rng.normal(size=(1, 2, 3)), 0.01 * rng.normal(size=(1, 2, 3))
    moment, s = np.cross(arm, force), np.array([[0.063, 0.02]])

    def at(q: Any, *loads: Any) -> Any:
        modal.place_points((s, *loads), ports.extension)
        return modal.derive(rows, ports, q, wanted=("hessian", "point"))

    def slopes(of: Any) -> Any:
        unit = STEP * np.eye(q.shape[1])
        return np.stack([(of(q + e) - of(q - e)) / (2.0 * STEP) for e in unit], axis=1)

    here, loaded = at(q, force), at(q, force, moment)
    turn = here.point_rotation[0]
    assert_allclose(
        loaded.gradient[0] - here.gradient[0], -np.einsum("kf,kfa->a", moment[0], turn), atol=1e-15
    )

    by_moment = slopes(lambda q: -np.einsum("kf,kfa->a", moment[0], at(q, force).point_rotation[0]))
    lower = np.tril(loaded.hessian[0] - here.hessian[0])
    assert_allclose(lower, np.tril(by_moment), atol=1e-6 * np.abs(by_moment).max())

    def gradient(q_new: Any) -> Any:
        """Gradient of the energy with forces on arms that have turned by the way, to second order."""
        found = at(q_new, force)
        by = np.einsum("kfa,a->kf", 0.5 * (found.point_rotation[0] + turn), (q_new - q)[0])
        now = arm[0] + np.cross(by, arm[0] + 0.5 * np.cross(by, arm[0]))
        return found.gradient[0] - np.einsum("kf,kfa->a", np.cross(now, force[0]), found.point_rotation[0])

    one, other = np.einsum("kf,kfa->ka", force[0], turn), np.einsum("kf,kfa->ka", arm[0], turn)
    more = -0.5 * (np.einsum("ka,kb->ab", one, other) + np.einsum("ka,kb->ab", other, one))
    more += np.einsum(
        "k,kfa,kfb->ab", (force * arm)[0].sum(1), turn, turn
    )  # none of friction, which is across
    across = 0.5 * np.einsum("kf,kfab->ab", moment[0], np.cross(turn[:, :, None], turn[..., None], axis=1))
    expected = loaded.hessian[0] + more + np.tril(across, -1) + np.tril(across, -1).T
    assert_allclose(slopes(gradient), expected, atol=1e-5 * np.abs(more).max())
