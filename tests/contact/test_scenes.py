"""Whole scenes of `perf/contact_scenes.py`: a robot, an obstacle, ten steps."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.mark.study
@pytest.mark.parametrize(
    ("seed", "index", "rows"),
    [
        (1, 7, [4]),  # a noisy sphere at 10 steps a segment: 0.21 mm between the nodes
        (1, 102, [1, 7]),  # another at 6 steps: 0.06 and 0.09 mm
        (1, 38, [5]),  # five segments, 10 steps: 0.06 mm
        (1, 81, [2]),  # a thin plate, from which Newton's method left for 1e24 m
        (1, 0, None),
        (1, 1, None),
        (1, 3, None),
        (1, 8, None),
    ],
)
def test_no_scene_is_deeper_than_it_says(scenes, seed, index, rows):
    """A slice of `perf/contact_scenes.py`: whoever is ok is outside, and whoever is not says what is
    stuck."""
    batch = scenes.make_batch(seed, index)
    played = scenes.play(batch, rows, max_iterations=40)
    assert played.touching.any() or played.sentences
    assert (
        np.nanmax(np.where(played.ok, played.depth, np.nan)) < 3e-5
    )  # UNSEEN, the rest's 1e-6 m and the sampling's error
    for said in played.sentences:
        assert repr(batch.obstacle.name) in said
        assert "arclength" in said
        assert "100 %" not in said
    assert len(played.sentences) == (~played.ok).sum()


@pytest.mark.study
@pytest.mark.parametrize("index", [44, 60, 99, 116])  # rings, a thin plate, a noisy sphere
@pytest.mark.parametrize("dt", [2e-3, 1.5e-2])
def test_no_scene_in_motion_is_deeper_than_it_says(scenes, index, dt):
    played = scenes.play(scenes.make_batch(5, index), dt=dt)
    assert played.touching.any()
    assert np.nanmax(np.where(played.ok, played.depth, np.nan)) < 3e-5
    assert played.ok.mean() > 0.9
    assert all(said.startswith("contact") for said in played.sentences)
    assert len(played.sentences) == (~played.ok).sum()


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize(
    ("index", "row"),
    [
        (110, 0),  # slides over the rim of a cylinder and snaps to its side
        (107, 1),  # along a bar
        (116, 0),  # off the edge of a block
        (128, 5),  # over a torus
        (208, 1),  # over a faceted ball
    ],
)
def test_a_rod_that_slides_off_comes_to_rest(scenes, index, row):
    """Beside the place where it is there is no equilibrium: the rod goes down in energy to the next one, and
    through nothing."""
    batch = scenes.make_batch(1, index)
    played = scenes.play(batch, [row])
    assert played.touching.any()
    assert played.ok.all(), played.sentences
    assert np.nanmax(played.depth) < 3e-5
    assert played.passes.max() < 600
