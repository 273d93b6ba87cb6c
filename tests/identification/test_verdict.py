"""Verdicts on numbers: which words they get, at both sides of every border."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fastrod.identification.report.result import Verdict
from fastrod.identification.report.verdict import (
    _EXPLAINED,
    _FOREIGN,
    _PARTLY,
    _UNCERTAIN,
    VerdictGrounds,
    choose_verdict,
    strained,
)
from fastrod.identification.search.alternatives import AlternativePattern
from fastrod.identification.search.model_selection import Candidate, SearchStep, equally_wrong
from fastrod.identification.search.residual_test import ResidualStructure
from fastrod.identification.search.solve import Estimate

BASE, FLOOR = 1.1, 0.1  # the error above the noise is 1
CLEAN = ResidualStructure(0.0, 0.0, 0.0, 0.0, 0.0)
KINDS = ("none", "static", "memory", "drift", "unknown")
JUMP = AlternativePattern("bump", "drift", "the tip jumps", np.zeros((1, 3, 3)), 1)
SWAY = AlternativePattern("sway", "exogenous", "a line", np.zeros((1, 3, 6)), 1)
RIPPLE = AlternativePattern("ripple", "static", "periodic", np.zeros((1, 3, 2)), 1)


def took(alternative: AlternativePattern | None, name: str = "backlash") -> SearchStep:
    """A stage that took an alternative pattern, or an effect."""
    taken = Candidate(alternative.name if alternative else name, None, 9.0, 99.0, 0.5, 1, "", alternative)
    return SearchStep(None, (), taken)


def grounds(**changed: Any) -> VerdictGrounds:
    errors = {"base": BASE, "library": BASE, "after": BASE, "floor": FLOOR, "left_out": 0.0}
    given = {"structure": CLEAN, "steps": [], "found": []}
    made = choose_verdict(**errors | given | changed)
    assert made.verdict in get_args(Verdict)
    assert made.kind in KINDS
    assert 0.0 <= made.left <= 1.0
    assert made.summary.endswith(".")
    assert "\n" not in made.summary
    return made


def found(left: float, **changed: Any) -> VerdictGrounds:
    """Backlash, with a static structure that carries `left` of the error above the noise."""
    structure = ResidualStructure(left / 0.5, 0.0, 0.0, 0.0, 5.0)
    return grounds(library=0.5, after=0.5, structure=structure, found=["backlash"], **changed)


def test_a_residual_of_noise_is_none() -> None:
    made = grounds(base=1.02 * FLOOR, library=1.02 * FLOOR, after=1.02 * FLOOR)
    assert (made.verdict, made.kind, made.left) == ("none", "none", 0.0)
    assert (made.patterns, made.drop_effects) == ((), False)


@pytest.mark.parametrize(
    ("structure", "kind"),
    [
        (ResidualStructure(0.07, 0.01, 0.0, 0.0, 5.0), "static"),
        (ResidualStructure(0.01, 0.07, 0.0, 0.0, 5.0), "memory"),
        (ResidualStructure(0.0, 0.01, 0.07, 0.0, 5.0), "drift"),
        (ResidualStructure(0.0, 0.0, 0.01, 0.07, 5.0), "unknown"),
    ],
)
def test_structure_that_nothing_explains_is_not_in_the_library(
    structure: ResidualStructure, kind: str
) -> None:
    made = grounds(structure=structure)
    assert (made.verdict, made.kind, made.patterns) == ("not_in_library", kind, ())
    assert_allclose(made.left, 0.08 * BASE)


def test_structure_below_six_percent_is_none() -> None:
    noise = {"base": 2.0 * FLOOR, "library": 2.0 * FLOOR, "after": 2.0 * FLOOR}
    below, above = (ResidualStructure(0.03, 0.02, drift, 0.0, 5.0) for drift in (0.009, 0.011))
    assert grounds(structure=below, **noise).verdict == "none"
    assert grounds(structure=above, **noise).verdict == "not_in_library"


def test_an_error_of_many_times_the_noise_is_not_none_however_white() -> None:
    """Steps of the measured trunk: 50 mm beside 9 um, and nothing in it that the audit tells."""
    made = grounds()
    assert (made.verdict, made.kind, made.left) == ("not_in_library", "unknown", 1.0)
    assert "is 3.32 times the noise" in made.summary


@pytest.mark.parametrize(("alternative", "kind"), [(JUMP, "drift"), (SWAY, "unknown"), (RIPPLE, "static")])
def test_a_foil_alone_is_not_in_the_library_and_gives_its_kind(
    alternative: AlternativePattern, kind: str
) -> None:
    made = grounds(after=FLOOR, steps=[took(alternative), SearchStep(None, (), None)])
    assert (made.verdict, made.kind, made.left) == ("not_in_library", kind, 1.0)
    assert made.patterns == (alternative.what,)
    assert alternative.what in made.summary


def test_the_kind_is_of_what_is_larger_the_foil_or_the_structure_behind_it() -> None:
    after = 0.8  # the alternative pattern has taken 0.3
    behind = (ResidualStructure(0.0, fraction / after, 0.0, 0.0, 5.0) for fraction in (0.29, 0.31))
    small, large = (grounds(after=after, steps=[took(JUMP)], structure=structure) for structure in behind)
    assert (small.kind, large.kind) == ("drift", "memory")


def test_borders_are_in_order() -> None:
    """The words in order: half of the squares left is not partly explained."""
    assert 0.01 <= _EXPLAINED <= 0.12
    assert 0.2 <= _PARTLY <= 0.5
    assert _EXPLAINED < _FOREIGN <= _PARTLY


@pytest.mark.parametrize(
    ("left", "verdict", "dropped"),
    [
        (0.0, "explained", False),
        (0.99 * _EXPLAINED, "explained", False),
        (1.01 * _EXPLAINED, "partly_explained", False),
        (0.2, "partly_explained", False),
        (0.99 * _PARTLY, "partly_explained", False),
        (1.01 * _PARTLY, "not_in_library", False),
        (0.44, "partly_explained", False),
        (0.48, "not_in_library", False),
    ],
)
def test_what_is_left_beside_an_effect_decides(left: float, verdict: str, dropped: bool) -> None:
    for made in (found(left), found(left, left_out=float("nan")), found(0.0, left_out=left)):
        assert (made.verdict, made.drop_effects) == (verdict, dropped)
        assert_allclose(made.left, left)
        assert "backlash" in made.summary
    assert found(left).kind == ("none" if left <= 0.02 else "static")


def test_held_out_error_counts() -> None:
    """A model that fits what it has seen and fails on what it has not has explained nothing."""
    assert found(0.01, left_out=0.2).verdict == "partly_explained"
    assert not found(0.01, left_out=0.99 * _UNCERTAIN).drop_effects
    assert found(0.01, left_out=1.01 * _UNCERTAIN).drop_effects
    worse = found(0.01, left_out=7.0)
    assert (worse.verdict, worse.left, worse.drop_effects) == ("not_in_library", 1.0, True)
    assert "backlash" not in worse.summary


@pytest.mark.parametrize(
    ("foreign", "verdict", "dropped"),
    [
        (0.9 * _EXPLAINED, "explained", False),
        (1.1 * _EXPLAINED, "partly_explained", False),
        (0.2, "partly_explained", False),
        (0.99 * _FOREIGN, "partly_explained", False),
        (1.01 * _FOREIGN, "not_in_library", False),
        (0.49, "not_in_library", False),
        (0.51, "not_in_library", True),
    ],
)
def test_a_foil_beside_an_effect_counts_by_what_it_takes(foreign: float, verdict: str, dropped: bool) -> None:
    library = 0.7
    steps = [took(None), took(JUMP)]
    made = grounds(library=library, after=library - foreign, steps=steps, found=["backlash"])
    patterns = () if verdict == "explained" else (JUMP.what,)  # at the noise none is named
    assert (made.verdict, made.drop_effects, made.patterns) == (verdict, dropped, patterns)
    assert (JUMP.what in made.summary) == bool(patterns)
    assert ("backlash" in made.summary) != dropped
    assert made.kind == "drift"


def test_the_headline_is_millimetres_of_the_held_out_error() -> None:
    made = grounds(
        library=0.69e-3**2, after=0.69e-3**2, floor=0.69e-3**2, found=["backlash"], held_out=(11.6e-3, 0.8e-3)
    )
    assert made.summary == "Adding backlash cuts the held-out error from 11.6 to 0.80 mm (noise 0.69)."
    without = found(0.01, left_out=float("nan")).summary
    assert without.startswith("Adding backlash cuts the training error from ")


@pytest.mark.parametrize(("at_floor", "verdict"), [(True, "explained"), (False, "partly_explained")])
def test_explained_is_about_the_noise_and_not_about_the_error_before(at_floor: bool, verdict: str) -> None:
    """1 % of a large error may be twice the noise, and a tenth of a small one within it."""
    for left in (0.01, 0.1):
        assert found(left, at_floor=at_floor).verdict == verdict
    # of a noise that is hardly known, what has no structure may be all
    loose = [found(left, at_floor=at_floor, like_noise=True).verdict for left in (0.01, 0.1)]
    assert loose == ["explained", verdict]
    # a pattern that takes more than little is something, however near the noise the rest is
    pattern = grounds(
        library=0.7, after=0.6, steps=[took(None), took(JUMP)], found=["backlash"], at_floor=at_floor
    )
    assert pattern.verdict == "partly_explained"


def test_several_effects_are_listed() -> None:
    made = grounds(library=FLOOR, after=FLOOR, found=["backlash", "creep", "gravity"])
    assert "Adding backlash, creep and gravity cuts" in made.summary


def test_a_log_at_its_floor_divides_by_no_zero() -> None:
    """The base model below the noise: the error above it is none, and what seems left stays a fraction."""
    half = ResidualStructure(0.5, 0.0, 0.0, 0.0, 5.0)
    for base in (0.5 * FLOOR, FLOOR):
        assert grounds(base=base, library=base, after=base).verdict == "none"
        assert grounds(base=base, library=base, after=base, structure=half).left == 1.0
    assert grounds(base=0.0, library=0.0, after=0.0, floor=0.0).verdict == "none"


def test_two_forms_that_are_as_wrong_are_rivals() -> None:
    """Friction and backlash left 0.777 and 0.775 mm of a noise of 0.69: 3 % of what is above it. At 0.80 mm
    one of them is the better form; at the noise any difference that blocks confirm is one."""
    assert equally_wrong(11.6**2, 0.775**2, 0.777**2, 0.69**2)
    assert not equally_wrong(11.6**2, 0.775**2, 0.800**2, 0.69**2)
    # five numbers more fit six times as much of what the form has wrong
    assert equally_wrong(11.6**2, 0.775**2, 0.785**2, 0.69**2, 5)
    assert not equally_wrong(11.6**2, 0.775**2, 0.785**2, 0.69**2, -5)
    assert not equally_wrong(11.6**2, 0.775**2, 0.800**2, 0.69**2, 5)
    assert not equally_wrong(11.6**2, 0.690**2, 0.691**2, 0.69**2)
    # 3 mm are left: of two that take little away, one takes twice as much
    assert not equally_wrong(3.10**2, 3.05**2, 3.075**2, 0.69**2)


def test_parameters_beyond_their_priors_are_said_with_all_that_is_known() -> None:
    def estimate(value: float, unit: str, mean: float, sd: float, distance: float) -> Estimate:
        return Estimate(
            value=value,
            stderr=1e-9,
            unit=unit,
            identifiable=True,
            prior_sd=sd,
            prior_mean=mean,
            prior_distance=distance,
        )

    length = estimate(0.075, "m", 0.07, 1e-3, 5.0)
    stiff = estimate(0.25, "x nominal", 1.0, 0.05, np.log(0.25) / 0.2)  # sd of the logarithm: 0.2
    near = estimate(0.071, "m", 0.07, 1e-3, 1.0)
    assert strained({"segment.2.length": near}) == []
    (one,) = strained({"segment.1.length": length, "segment.2.length": near})
    assert one == (
        "Evidence of missing physics: length, segment 1 comes out at 75.0 mm, 5.0 sd from its prior of "
        "70.0 ± 1.0 mm."
    )
    (both,) = strained({"segment.1.length": length, "segment.*.bending_stiffness": stiff})
    # the farthest first; a negative distance is one, too
    assert both.index("bending stiffness") < both.index("length, segment 1")
    assert "6.9 sd from its prior of 1.00 ± 0.20 × nominal" in both
    (many,) = strained({f"segment.{k}.length": length for k in range(1, 6)})
    assert many.endswith("; and 2 more.")
