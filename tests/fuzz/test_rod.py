"""Any values at all as a rod's inputs, on a base anywhere: a state, or one sentence that changed nothing."""

from __future__ import annotations

from functools import cache

import numpy as np
from fuzz.strategies import odd_values, one_sentence, tried
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from rods import rod

from fastrod.errors import FastrodError
from fastrod.hosts import Rod
from fastrod.hosts.rod import INPUTS, RodSnapshot

HOME, STILL = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), (0.0,) * 6
FIELDS = ("position", "tip_position", "base_wrench", "ok", "passes")

some = st.one_of(odd_values, st.lists(st.one_of(st.floats(-0.1, 0.1), st.floats()), min_size=1, max_size=8))
"""A value for anything: mostly no vector, or one of a wrong length, or with a number that is none."""


@cache
def begun(n_robots: int | None) -> tuple[Rod, RodSnapshot]:
    """Rods on their way, and where they were."""
    body = Rod(rod(), dt=0.01, n_robots=n_robots, points_per_segment=10)
    for k in range(2):
        body.advance(HOME, STILL, 0.01, tip_force=(0.01 * k, 0.0, 0.0))
    return body, body.snapshot()


@given(
    n_robots=st.sampled_from([None, 2]),
    inputs=st.dictionaries(st.one_of(st.sampled_from(INPUTS), st.just("tip_fource")), some, max_size=2),
    base=st.one_of(st.just(HOME), some),
    twist=st.one_of(st.just(STILL), some),
    step=st.one_of(st.just(0.02), st.sampled_from([0.0, -1.0, np.nan, "dt", None, True])),
    settles=st.booleans(),
)
@tried(60)
def test_call_that_is_refused_changes_nothing(n_robots, inputs, base, twist, step, settles):
    body, then = begun(n_robots)
    body.restore(then)
    expected = body.advance(HOME, STILL, 0.02)
    wrench = body.wrench
    body.restore(then)
    refused = False
    try:
        with np.errstate(all="ignore"):
            state = body.settle(base, **inputs) if settles else body.advance(base, twist, step, **inputs)
    except FastrodError as error:
        refused = True
        one_sentence(error)
    if refused:
        assert body.time == then.time
        assert body.state is then.state
        assert_array_equal(body.base, then.base if n_robots else then.base[0])
        again = body.advance(HOME, STILL, 0.02)
        for name in FIELDS:
            assert_array_equal(getattr(again, name), getattr(expected, name))
        assert_array_equal(body.wrench, wrench)
    else:
        assert np.isfinite(state.position).all()
        assert np.isfinite(body.wrench).all()
        assert np.isfinite(body.capsules.velocity).all()
        assert set(np.flatnonzero(~state.ok)) == set(state.problems)
