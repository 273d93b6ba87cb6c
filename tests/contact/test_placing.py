"""Nodes under point loads: where they come to lie, and when there are too few of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fastrod.kernels.batch import place_all

ENDS = np.array([[0.0, 0.03, 0.1, 0.12]])  # joints of three segments [m]


def placed(s, n_steps, starts=ENDS):
    """Arclengths of the nodes (n, n_points), the node of each load, and the first row that is too full."""
    s = np.atleast_2d(np.asarray(s, float))
    grid, node = np.full((len(s), starts.shape[1] - 1, n_steps + 1), np.nan), np.full(s.shape, -7)
    starts = np.broadcast_to(starts, (len(s), starts.shape[1])).copy()
    crowded = place_all(s, starts, n_steps, grid, node)
    assert_array_equal(grid[:, :, 0], 0.0)
    assert_array_equal(grid[:, :, -1], 1.0)
    assert (np.diff(grid, axis=2) > 0.0).all()  # every step goes forward
    at = starts[:, :-1, None] + grid[:, :, :-1] * np.diff(starts, axis=1)[:, :, None]
    return np.column_stack([at.reshape(len(s), -1), starts[:, -1]]), node, crowded


@pytest.mark.parametrize("n_steps", [3, 6, 20])
def test_every_load_lies_on_a_node(n_steps):
    rng = np.random.default_rng(1)
    s = rng.uniform(0.0, 0.12, (2000, 4))
    s[rng.random(s.shape) < 0.2] = np.nan
    at, node, crowded = placed(s, n_steps)
    k = np.searchsorted(ENDS[0], s, side="right") - 1
    most = np.array([max((row == j).sum() for j in range(3)) for row in np.where(np.isnan(s), -1, k)])
    full = most > n_steps - 1
    assert crowded == (np.flatnonzero(full)[0] if full.any() else -1)
    assert full.any() == (n_steps == 3)
    asked = np.isfinite(s) & ~full[:, None]
    assert (node[np.isnan(s)] == -1).all()
    assert (node[asked] >= 0).all()
    found = np.take_along_axis(at, np.maximum(node, 0), axis=1)
    assert_allclose(found[asked], s[asked], rtol=0, atol=1e-16)
    assert (node[asked] // n_steps == k[asked]).all()


def test_the_nearest_node_moves_and_the_rest_spread_evenly():
    rng = np.random.default_rng(2)
    n_steps = 10
    for f in rng.uniform(0.001, 0.999, 100):
        at, node, _ = placed([0.03 + 0.07 * f], n_steps)
        j = min(max(math.floor(f * n_steps + 0.5), 1), n_steps - 1)
        assert node[0, 0] == n_steps + j
        middle = at[0, n_steps : 2 * n_steps + 1]
        assert_allclose(np.diff(middle[: j + 1]), 0.07 * f / j, rtol=1e-9)
        assert_allclose(np.diff(middle[j:]), 0.07 * (1.0 - f) / (n_steps - j), rtol=1e-9)
        assert_allclose(np.diff(at[0, : n_steps + 1]), 0.003, rtol=1e-9)
        assert_allclose(np.diff(at[0, 2 * n_steps :]), 0.002, rtol=1e-9)


def test_ends_and_joints_have_nodes_already():
    at, node, crowded = placed([0.0, 0.03, 0.1, 0.12, 0.03 + 1e-13, 0.1 - 1e-13], 5)
    assert crowded == -1
    assert_array_equal(node[0], [0, 5, 10, 15, 5, 10])
    assert_allclose(np.diff(at[0]), np.repeat([0.006, 0.014, 0.004], 5), rtol=1e-9)


def test_the_same_place_twice_is_one_node_and_order_does_not_matter():
    at, node, crowded = placed([[0.05, 0.02, 0.05, 0.05, 0.07], [0.07, 0.05, 0.05, 0.02, 0.05]], 4)
    assert crowded == -1
    assert_array_equal(at[0], at[1])
    assert_array_equal(node[0], node[1][[1, 3, 2, 4, 0]])
    assert len(set(node[0])) == 3


def test_crowds_fit_as_long_as_there_are_nodes():
    """n - 1 loads in one segment take all of its inner nodes, wherever they are; one more does not fit."""
    rng = np.random.default_rng(3)
    n_steps = 6
    s = 0.03 + 0.07 * np.sort(
        np.where(rng.random((300, 1)) < 0.5, 0.999, 0.001) + 1e-4 * rng.uniform(-1, 1, (300, n_steps - 1)),
        axis=1,
    )
    at, node, crowded = placed(s, n_steps)
    assert crowded == -1
    assert_array_equal(node, np.broadcast_to(n_steps + np.arange(1, n_steps), node.shape))
    assert_allclose(np.take_along_axis(at, node, axis=1), s, rtol=0, atol=1e-16)
    more = np.column_stack([s, np.full(300, 0.06)])
    _, node, crowded = placed(more, n_steps)
    assert crowded == 0
    assert ((node == -1).sum(1) == 1).all()
    _, _, crowded = placed(np.vstack([np.where(np.arange(6) == 5, np.nan, more[:7]), more[7:]]), n_steps)
    assert crowded == 7


def test_robots_of_different_lengths():
    starts = np.array([[0.0, 0.1, 0.2], [0.0, 0.05, 0.15]])
    at, node, crowded = placed([[0.07], [0.07]], 4, starts)
    assert crowded == -1
    assert_array_equal(node[:, 0], [3, 5])
    assert_allclose(at[[0, 1], node[:, 0]], 0.07, rtol=0, atol=1e-16)


def test_nothing_to_place_leaves_an_even_grid():
    at, node, crowded = placed([np.nan, np.nan], 5)
    assert crowded == -1
    assert_array_equal(node, -1)
    assert_allclose(np.diff(at[0]), np.repeat([0.006, 0.014, 0.004], 5), rtol=1e-9)
