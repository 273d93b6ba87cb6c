"""A law that contains another never fits worse: which of the two it is, is for its estimate to say."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from identification.logs import log_of, one_segment
from numpy.testing import assert_allclose

from fastrod.effects.base import BodyOperator, effect_names, get_effect, read_values, trait
from fastrod.identification.attribution import identify
from fastrod.identification.log.base_model import base_model
from fastrod.identification.log.replay import replay
from fastrod.identification.search.model_selection import Candidate, ModelState, by_estimate, from_sub_law
from fastrod.identification.search.solve import Fit
from fastrod.model.routing import route
from fastrod.types import Floats

STDERR = 1e-2
"""Standard errors of every fitted number of `fitted`."""


def fitted(name: str, **numbers: float) -> ModelState:
    """A state with an effect at these numbers."""
    model: Any = base_model(one_segment()).with_effect(name)
    labels = [u.name.partition(".")[2] if u.name.startswith(f"{name}.") else "" for u in model.unknowns]
    theta = model.start.copy()
    for label, value in numbers.items():
        theta[labels.index(label)] = model.unknowns[labels.index(label)].outside(value)
    p = len(theta)
    slopes = np.eye(p).reshape(p, 1, p) / STDERR
    fit = Fit(theta, np.zeros((p, 1)), slopes, np.full(p, 1e-9), (False,) * p)
    return ModelState(model, None, fit, np.ones(1))  # type: ignore[arg-type]


def candidate(name: str, state: ModelState, why: str = "") -> Candidate:
    return Candidate(name, state, 9.0, 99.0, 0.5, 1, why)


@pytest.mark.parametrize("name", [n for n in effect_names() if trait(get_effect(n), "nests")])
def test_a_law_is_the_one_that_it_contains_where_it_says(name: str) -> None:
    robot = one_segment()
    wiring, t = route(robot), 0.05 * np.arange(200)
    bends = np.stack([np.sin(t) * np.cos(0.31 * t), np.sin(1.3 * t)], axis=-1)[:, None]
    dl, dt = wiring.tendon_change(bends), np.full(200, 0.05)
    what: Any = get_effect(name)
    for inner, where in what.nests.items():
        sub: Any = get_effect(inner)
        if isinstance(what, BodyOperator):
            both = [
                law.sweep(read_values(label, table, wiring, "test")[None], law.memory(1, 2), bends[None])
                for law, label, table in (
                    (sub, inner, {"bend": 0.1, "width": 0.05}),
                    (what, name, {"bend": 0.1, "width": 0.05, **where}),
                )
            ]
            assert np.abs(both[0]).max() > 0.09
            assert_allclose(*both, rtol=0, atol=1e-14)
            continue
        size = 0.05 * float(wiring.tendon_offset.mean())
        plain = {"rounding": 0.0} if inner == "backlash" else {}
        one = {"half_width": size, "start": [0.5, -1.0], **plain}
        rich = {key: one[value] if isinstance(value, str) else value for key, value in where.items()}
        rich |= {key: one[key] for key in ("half_width", "start")} | {"spread": 0.0}
        swept: list[Floats] = []
        for law, label, table in ((sub, inner, one), (what, name, rich)):
            values = read_values(label, table, wiring, "test")[None]
            swept.append(law.sweep(values, law.memory(1, robot.n_tendons), dl[None], dt, wiring))
        assert_allclose(swept[0], swept[1], atol=1e-12)
        assert np.abs(swept[0] - dl).max() > 0.9 * size


def test_the_distance_is_in_standard_errors_of_the_difference() -> None:
    where = get_effect("friction").nests["backlash"]  # type: ignore[attr-defined]
    exact = fitted("friction", presliding=3e-4, half_width=3e-4, growth=0.0)
    assert from_sub_law(exact, "friction", where) == pytest.approx(0.0, abs=1e-12)
    off = fitted("friction", presliding=3e-4, half_width=3e-4, growth=0.025)
    assert from_sub_law(off, "friction", where) == pytest.approx(2.5, rel=1e-3)
    wide = fitted("friction", presliding=0.5, half_width=0.44, growth=0.0)
    # the logarithm of `presliding` is fitted
    expected = 0.06 / np.hypot(0.5 * STDERR, STDERR)
    assert from_sub_law(wide, "friction", where) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("growth", "first", "names"),
    [
        (0.01, "friction", ["backlash"]),
        (0.01, "backlash", ["backlash"]),
        (0.05, "friction", ["friction"]),
        (0.05, "backlash", ["friction"]),
        (0.025, "friction", ["friction", "backlash"]),
        (0.025, "backlash", ["backlash", "friction"]),
    ],
)
def test_the_estimate_decides(growth: float, first: str, names: list[str]) -> None:
    both = {
        "friction": candidate(
            "friction", fitted("friction", presliding=3e-4, half_width=3e-4, growth=growth)
        ),
        "backlash": candidate("backlash", fitted("backlash")),
    }
    others = [candidate("creep", fitted("creep"))]
    best = both.pop(first)
    (second,) = both.values()
    kept = by_estimate(best, [*others, second], [best, second, *others], noise=1.0)
    assert [c.name for c in kept if c.name != "creep"] == names
    assert kept[0].name == names[0]
    assert "creep" in [c.name for c in kept]
    # much is left above the noise: the richer law is far for what is missing, and the evidence decides
    kept = by_estimate(best, [*others, second], [best, second, *others], noise=1.0 / 1.3)
    assert [c.name for c in kept if c.name != "creep"] == (names if growth == 0.01 else [first, second.name])


@pytest.mark.study
@pytest.mark.parametrize(
    ("sealed", "numbers"),
    [
        ("backlash", {"half_width": 4e-4, "start": [1.0, -1.0]}),
        ("friction", {"half_width": 4e-4, "presliding": 8e-4, "growth": 0.5}),
    ],
)
def test_the_law_that_was_sealed_is_named_alone(sealed: str, numbers: dict[str, Any]) -> None:
    robot, t = one_segment(), 0.1 * np.arange(400)
    held = np.where((t > 15.0) & (t < 22.0), 15.0, np.minimum(t, 33.0))
    size = 0.45 + 0.3 * np.sin(0.23 * held)
    bends = np.stack([size * np.sin(1.1 * held), size * np.sin(0.83 * held + 0.5)], axis=-1)[:, None]
    log = log_of(robot, route(robot).tendon_change(bends), 0.1)
    tip = replay(log, replace(robot, effects=({"name": sealed, **numbers},))).tip_position
    noise = np.random.default_rng(5).normal(0.0, 2e-4, (400, 3))
    result = identify(replace(log, tip_position=tip + noise), robot, threads=1)
    assert [effect.name for effect in result.effects] == [sealed]
    assert {"friction", "backlash"}.isdisjoint(result.effects[0].cannot_be_told_from)
    assert result.verdict in ("explained", "ambiguous")
    assert result.test.after < 1.1 * result.noise.floor
