"""report.html: one file that opens without a network, verdict first. Its words are in page.html."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined

from fastrod.effects.base import get_effect, trait
from fastrod.identification.report import figures, wording
from fastrod.identification.report.result import Found, Result
from fastrod.identification.report.signals import Signals
from fastrod.identification.search.model_selection import DetectionLimit
from fastrod.model.robotfile import robot_names

_FRACTIONS = {
    "static": ("follows from the present inputs", "#6d5bd0"),
    "memory": ("follows from the inputs before", "#2166c4"),
    "drift": ("slow in time", "#c2790a"),
    "exogenous": ("not explained by this test", "#b4235a"),
}
_SCORES = (
    ("z", "z over held-out blocks {:.1f}", 1.0),
    ("bic", "BIC gain {:.0f}", 1.0),
    ("loss_share", "{:.1f} % of the loss", 100.0),
)


def page(result: Result) -> str:
    """The report as HTML."""
    signals = Signals(result)
    floor = result.noise.floor
    kind = {"unknown": "exogenous"}.get(result.remaining_kind, result.remaining_kind)
    every = {
        "of the robot": result.base_parameters,
        **{f"of {wording.words(found.name)}": found.parameters for found in result.effects},
    }
    indistinct = [found for found in result.effects if found.cannot_be_told_from]
    seen = [bound for bound in result.bounds if math.isfinite(bound.value)]
    shown = {bound.name for bound in seen}
    text: str = _template().render(
        r=result,
        style=(files("fastrod.identification") / "page.css").read_text(encoding="utf-8"),
        summary=[*re.split(r"(?<=[.!?]) (?=[A-Z])", result.summary, maxsplit=1), ""][:2],
        tested=int((result.tested & result.measured).sum()),
        ratio=result.test.after / floor if floor > 0.0 else math.nan,
        bars=_bars(result),
        would_show=_would_show(seen),
        left_is=_FRACTIONS.get(kind, ("of no known kind", ""))[0],
        confusable=indistinct or not all(e.identifiable for e in result.base_parameters.values()),
        seen=seen,
        unseen=[*{bound.name: bound for bound in result.bounds if bound.name not in shown}.values()],
        shipped_robots=robot_names(),
        signals=signals,
        views={found.name: signals.view(found) for found in result.effects} if len(signals.rows) else {},
        parameters={title: estimates for title, estimates in every.items() if estimates},
        remains=_remains(result),
        fractions=_fractions(result),
    )
    return text


def _template() -> Any:
    environment = Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined
    )
    said = {name: each for name, each in vars(wording).items() if not name.startswith("_")}
    environment.globals.update(said, finite=math.isfinite, signed=_signed, scores=_scores, figures=figures)
    environment.filters.update({name: said[name] for name in ("bound_sentence", "plain_name", "words")})
    text = (files("fastrod.identification") / "page.html").read_text(encoding="utf-8")
    return environment.from_string(text)


def _would_show(seen: Sequence[DetectionLimit]) -> list[str]:
    """Sentences on the effects that robots often have, and that this one would have shown."""
    often = sorted(seen, key=lambda bound: not trait(get_effect(bound.name), "frequent"))
    return [wording.bound_sentence(bound) for bound in often[:6]]


def _bars(result: Result) -> list[dict[str, Any]]:
    """Errors as bars with the noise floor through them, in percent of the width."""
    test, train, floor = result.test, result.train, result.noise.floor
    rows: Sequence[tuple[str, str, float, Sequence[float]]] = [
        ("held out, before", "before", test.before, ()),
        ("held out, after", "after", test.after, test.interval),
        ("train, before", "before train", train.before, ()),
        ("train, after", "after train", train.after, ()),
    ]
    if not result.effects:
        rows = [
            ("held out", "before", test.before, test.interval),
            ("train", "before train", train.before, ()),
        ]
    ends = (end for _, _, value, interval in rows for end in (value, *interval) if math.isfinite(end))
    widest = max(ends, default=0.0)
    whole = max(widest, floor, 1e-12) / 86.0
    made = []
    for label, kind, value, interval in rows:
        width = right = value / whole if math.isfinite(value) else 0.0
        span = None
        if interval and all(map(math.isfinite, interval)):
            low, high = (end / whole for end in interval)
            span, right = (f"{low:.2f}", f"{high - low:.2f}"), max(width, high)
        if right > 0.8 * floor / whole:  # its figure stands behind the line of the floor
            right = max(right, floor / whole)
        figures_of = {"width": width, "floor": floor / whole, "right": right}
        bar = {name: f"{percentage:.2f}" for name, percentage in figures_of.items()}
        made.append(
            {**bar, "label": label, "kind": kind, "interval": span, "value": wording.millimetres(value)}
        )
    return made


def _scores(found: Found) -> str:
    return ", ".join(
        form.format(found.evidence[key] * factor)
        for key, form, factor in _SCORES
        if math.isfinite(found.evidence.get(key, math.nan))
    )


def _fractions(result: Result) -> list[tuple[str, float, str, str]]:
    """Name, size, meaning and colour of what the residual's variance consists of; noise last."""
    fractions = [(key, getattr(result.remaining, key), *about) for key, about in _FRACTIONS.items()]
    more = result.above_noise - sum(fraction for _, fraction, _, _ in fractions)
    # what the held-out error has above the noise is no noise, even where this test finds nothing in it
    if not result.patterns and more > 0.0:
        fractions.append(("above the noise", more, "not explained by this test", "#8a5a44"))
    rest = max(0.0, 1.0 - sum(fraction for _, fraction, _, _ in fractions))
    return [*fractions, ("noise", rest, "the remainder", "#e3e7ed")]


def _remains(result: Result) -> str:
    if not result.knows_fractions:
        return "This log is too short to say which share of the error above the noise remains."
    if result.remaining_fraction > 0.0:
        return (
            f"{wording.percent(result.remaining_fraction)} of the error above the noise remains unexplained."
        )
    if result.above_noise > 0.0:
        return f"{wording.percent(result.above_noise)} of the held-out mean square is above the noise."
    return "Nothing that held-out blocks confirm: what is left looks like noise."


def _signed(value: float, places: int) -> str:
    return f"{value:.{places}f}".replace("-", "−")
