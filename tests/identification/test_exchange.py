"""Effects that were found early, judged again beside what came later."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from identification.logs import log_of, one_segment, wave
from numpy.testing import assert_allclose

from fastrod.identification.log.base_model import base_model
from fastrod.identification.log.forward import PredictedRod
from fastrod.identification.log.replay import replay
from fastrod.identification.log.samples import sample
from fastrod.identification.search.linearised import target_of
from fastrod.identification.search.model_selection import ModelState, SearchStep
from fastrod.identification.search.search import N_BLOCKS, Search

NOISE, ROWS = 2e-4, 400
TAPER = {"name": "stiffness_taper", "slope": -0.4}
SPRING = {"name": "tip_spring", "stiffness": 12.0, "x": 0.05, "y": -0.03, "z": 0.08}
CREEP = {"name": "creep", "share": 0.15, "time_constant": 3.0}


@cache
def searched(name: str) -> tuple[Search, ModelState, ModelState]:
    """Return a search in a log of creep and a spring or a taper, its base state, and that with a spring and
    creep."""
    other: dict[str, Any] = {"stiffness_taper": TAPER, "tip_spring": SPRING}[name]
    (segment,) = one_segment().segments
    tendons = tuple(replace(tendon, compliance=5e-4) for tendon in segment.tendons)
    robot = replace(one_segment(), segments=(replace(segment, tendons=tendons),))
    log = log_of(robot, wave(robot, ROWS, dt=0.1, size=0.9), 0.1)
    tip = replay(log, replace(robot, effects=(other, CREEP))).tip_position
    tip = tip + np.random.default_rng(3).normal(0.0, NOISE, tip.shape)
    samples, model = sample(replace(log, tip_position=tip)), base_model(robot)
    target = target_of(samples, np.full(3, NOISE), rotation_sigma=0.01, points=False)
    block = np.arange(ROWS) * N_BLOCKS // ROWS
    search = Search(samples, PredictedRod(samples, robot), target, block, noise=np.full(3, NOISE))
    state = base = search.start(model, model.start)
    for found in ("tip_spring", "creep"):
        added = search.candidate(state, found).state
        assert added is not None
        state = search.refined(added)
    return search, base, state


@pytest.mark.study
@pytest.mark.parametrize("sealed", ["stiffness_taper", "tip_spring"])
def test_fewer_numbers_that_predict_as_well_take_the_place(sealed: str) -> None:
    search, base, state = searched(sealed)
    found = ["tip_spring", "creep"]
    steps = [SearchStep(base, (), search.judged(base, state, name)) for name in found]
    after, names, (step,) = search.again_beside_all(state, found, steps)
    assert names[1:] == ["creep"]
    assert sealed == "tip_spring" or names[0] == sealed
    assert after.losses.sum() < 1.05 * state.losses.sum()
    assert step.taken is not None
    assert step.taken.name == names[0]
    if names != found:
        assert step.rivals[0] == "tip_spring"
        assert len(after.theta) < len(state.theta)
        # none of fewer numbers does as well as what is there now
        assert search.again_beside_all(after, names, [step])[1] == names


@pytest.mark.study
def test_a_rival_is_one_beside_all_that_was_found() -> None:
    """Backlash is no rival of a taper, though it was one where the taper was taken."""
    search, base, state = searched("stiffness_taper")
    found = ["tip_spring", "creep"]
    step = SearchStep(base, (), search.judged(base, state, "tip_spring"), ("backlash", "stiffness_taper"))
    _, _, (again,) = search.again_beside_all(state, found, [step])
    assert again.taken is not None
    assert "stiffness_taper" in (again.taken.name, *again.rivals)
    assert "backlash" not in again.rivals


@pytest.mark.study
def test_each_effect_is_laid_beside_the_base_model_from_where_it_was_found() -> None:
    """Alone each takes something away, whatever its own starts would lead to."""
    search, base, state = searched("stiffness_taper")
    for name in ("tip_spring", "creep"):
        assert search.beside(base, name, state).fit.loss < 0.99 * base.fit.loss


def test_the_weights_are_those_of_what_a_state_leaves() -> None:
    """Whatever weights the search has by now."""
    search, base, _ = searched("stiffness_taper")
    sigma = search.weighed(base, search.noise)[0].target.sigma
    tight = replace(search, target=search.target.weighed(0.2 * search.target.sigma, 0.1 * search.noise))
    assert_allclose(tight.weighed(base, search.noise)[0].target.sigma, sigma, rtol=1e-12)
    left = np.sqrt(np.mean((base.fit.residual * search.target.sigma) ** 2))
    assert_allclose(sigma, left, rtol=0.1)
