"""Verdict from errors and patterns, in words that say no more than the log shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fastrod.identification.report.result import Verdict
from fastrod.identification.report.wording import amount, plain_name, with_error
from fastrod.identification.search.model_selection import SearchStep
from fastrod.identification.search.residual_test import ResidualStructure
from fastrod.identification.search.solve import Estimate

CLEAN = 0.06
"""Largest fraction of the residual's variance: structure below it is none."""
# of the mean square above the noise: what may be left for these verdicts; 0.03 is 17 % of the rms
_EXPLAINED, _PARTLY = 0.03, 0.45
_UNCERTAIN = 0.75  # left beyond this: what was found may be a stand-in for what is missing
# of the error above the noise: patterns outside the library that carry this much are the finding
_FOREIGN = 0.3
_AT = 1.02  # of the noise: a held-out error within it is the noise's
_CARRIES = 0.5  # of the error above the noise, by one effect, where three are needed
_MIN_EXCESS = 0.03  # of the noise's variance
_NO_NOISE = 9.0  # of the noise's variance: so much is none, however white
_MOST_STRAINED = 3  # parameters beyond their priors that the summary names
AT_A_PRICE = "With that, the model explains this log down to its noise."
"""The summary where nothing is found, but a parameter is beyond its prior."""


@dataclass(frozen=True)
class VerdictGrounds:
    """A verdict and what goes with it."""

    verdict: Verdict
    summary: str
    kind: str
    """none | static | memory | drift | unknown."""
    left: float
    """Share of the error above the noise that no named effect explains."""
    patterns: tuple[str, ...]
    drop_effects: bool
    """The effects that were found are not certain: do not name them."""


def choose_verdict(
    *,
    base: float,
    library: float,
    after: float,
    floor: float,
    left_out: float,
    structure: ResidualStructure,
    steps: Sequence[SearchStep],
    found: Sequence[str],
    held_out: tuple[float, float] = (float("nan"), float("nan")),
    at_floor: bool | None = None,
    like_noise: bool = False,
    evident: bool = False,
) -> VerdictGrounds:
    """The verdict. Mean squares of the distance on the training data [m^2]: of the `base` model, with the
    `library` effects found,
    `after` those and alternative patterns, and the noise `floor`; `left_out`: share of the held-out error
    above the noise that is left; `held_out`: that error before and after, rms [m]; `at_floor`: whether it is
    the noise's (without it: by the share that is left); `like_noise`: whether noise that is no better known,
    on so few samples, may be as large; `evident`: whether each effect is so beyond doubt that it is named
    beside much that is left."""
    excess = max(base - floor, _MIN_EXCESS * floor, 1e-30)
    alternatives = [
        step.taken.alternative
        for step in steps
        if step.taken is not None and step.taken.alternative is not None
    ]
    # the strongest of each family
    patterns = tuple({alternative.name: alternative.what for alternative in reversed(alternatives)}.values())[
        ::-1
    ]
    foreign = max(library - after, 0.0) / excess if alternatives else 0.0
    structured = structure.structured * after / excess
    left = min(1.0, foreign + structured)
    kind = (
        {"exogenous": "unknown"}.get(alternatives[0].kind, alternatives[0].kind)
        if alternatives and foreign >= structured
        else structure.kind
    )
    if not found and not alternatives:
        white = structure.structured <= CLEAN or like_noise
        if white and not like_noise and base > _NO_NOISE * floor:
            times = float(np.sqrt(base / max(floor, 1e-30)))
            said = f"What the model leaves is {times:.3g} times the noise, in no pattern that the test tells."
            return VerdictGrounds("not_in_library", said, "unknown", 1.0, (), False)
        if white:
            said = (
                "The model explains this log down to its noise; nothing is missing that this log could show."
            )
            return VerdictGrounds("none", said, "none", 0.0, (), False)
        why = "Structure remains in the residual that no effect of the library explains"
        return VerdictGrounds("not_in_library", f"{why}; it is {_words(kind)}.", kind, left, (), False)
    if not found:
        return VerdictGrounds(
            "not_in_library",
            f"No effect of the library explains the residual: {patterns[0]}.",
            kind,
            1.0,
            patterns,
            False,
        )
    left = left if np.isnan(left_out) else max(left, min(left_out, 1.0))
    below = held_out[1] <= _AT * float(np.sqrt(floor))  # a pattern of the fit is none where nothing is left
    near = at_floor or (like_noise and structure.structured <= CLEAN)
    done = left <= _EXPLAINED if at_floor is None else near and (foreign <= _EXPLAINED or below)
    if done:
        said = f"{_cut(found, held_out, base, library, floor)}."
        # at the noise no pattern is named
        return VerdictGrounds("explained", said, kind if left > 0.02 else "none", left, (), False)
    what = f": {patterns[0]}" if patterns else f"; what is left is {_words(kind)}"
    if foreign > _FOREIGN or left > _PARTLY:
        names = _listed(found)
        certain = foreign < 0.5 and (left < _UNCERTAIN or evident)
        also = f" There {'is' if len(found) == 1 else 'are'} {names}, too." if certain else ""
        quantity = "Most" if max(foreign, left) > 0.5 else "A good part"
        return VerdictGrounds(
            "not_in_library",
            f"{quantity} of what is missing is not in the library{what}.{also}",
            kind,
            left,
            patterns,
            not certain,
        )
    said = f"{_cut(found, held_out, base, library, floor)}{what}."
    return VerdictGrounds("partly_explained", said, kind, left, patterns, False)


def strained(parameters: Mapping[str, Estimate]) -> list[str]:
    """A sentence on the robot's own parameters that the data pull beyond their priors, the farthest first; no
    sentence where there is none."""
    far = sorted(
        ((name, e) for name, e in parameters.items() if e.beyond_prior),
        key=lambda pair: -abs(pair[1].prior_distance),
    )
    if not far:
        return []
    said = []
    for name, e in far[:_MOST_STRAINED]:
        # what is fitted as a logarithm has its sd as a share of its value
        sd = e.prior_sd * e.prior_mean / e.value if e.unit == "x nominal" else e.prior_sd
        prior, value = with_error(e.prior_mean, sd, e.unit), amount(e.value, e.unit, 3)
        distance = f"{abs(e.prior_distance):.1f} sd from its prior of {prior}"
        said.append(f"{plain_name(name)} comes out at {value}, {distance}")
    more = len(far) - len(said)
    rest = f"; and {more} more" if more else ""
    return [f"Evidence of missing physics: {'; '.join(said)}{rest}."]


def _listed(found: Sequence[str]) -> str:
    spoken = [name.replace("_", " ") for name in found]
    return ", ".join(spoken[:-1]) + " and " + spoken[-1] if len(found) > 1 else spoken[0]


def _cut(
    found: Sequence[str], held_out: tuple[float, float], base: float, library: float, floor: float
) -> str:
    """Return what adding effects does to the error, in millimetres; to that of the training data where
    nothing was held out."""
    known = all(map(np.isfinite, held_out))
    before, after = held_out if known else (float(np.sqrt(base)), float(np.sqrt(library)))
    which = "held-out" if known else "training"
    return (
        f"Adding {_listed(found)} cuts the {which} error from {_mm(before)} to {_mm(after)} mm "
        f"(noise {_mm(float(np.sqrt(floor)))})"
    )


def _mm(metres: float) -> str:
    """Two digits from a tenth on, three from ten on: 0.69, 11.6."""
    number = 1e3 * metres
    return f"{number:.3g}" if number >= 10.0 else f"{number:.2f}" if number >= 0.095 else f"{number:.2g}"


def _words(kind: str) -> str:
    return {
        "static": "a function of the present inputs",
        "memory": "a function of the inputs before",
        "drift": "slow in time, whatever the inputs",
        "unknown": "not explained by this test",
        "none": "of no kind that this test can tell",
    }[kind]
