"""The first screen of the report: verdict, error, what was missing, what cannot be distinguished, what to do
next."""

from __future__ import annotations

import math
import re
from html import escape

from fastrod.effects.base import get_effect, trait
from fastrod.identification.report.markup import FRACTIONS, listed, mark
from fastrod.identification.report.result import Result
from fastrod.identification.report.wording import (
    NOTHING,
    VERDICTS,
    bound_sentence,
    millimetres,
    percent,
    plain_name,
    rounded,
    with_error,
    words,
)
from fastrod.model.robotfile import robot_names


def explained(result: Result) -> float:
    """Share of the held-out error above the noise that is gone; nan where there was none."""
    floor = result.noise.floor**2
    excess = result.test.before**2 - floor
    return (
        min(1.0, (result.test.before**2 - result.test.after**2) / excess)
        if excess > 0.03 * floor and result.knows_fractions
        else math.nan
    )


def header(result: Result) -> str:
    """Log, robot and sample counts, in a line."""
    log = result.log
    used = f"{int(result.used.sum())} samples fitted, {int((result.tested & result.measured).sum())} held out"
    return (
        f"<header><b>fastrod identify</b><span>log <b>{escape(log.name)}</b></span><span>robot "
        f"<b>{escape(result.robot.name)}</b></span>"
        f"<span>{used} ({escape(', '.join(result.held_out))})</span></header>"
    )


def hero(result: Result) -> str:
    """The first screen: verdict, error before and after, effects, what cannot be distinguished, what to
    do."""
    error = f"<h3>Tip error on samples that no fit has seen</h3>{_numbers(result)}{_bars(result)}"
    left, right = [("a", error), ("c", _distinguished(result))], [("b", _found(result))]
    (left if len(result.effects) > 1 else right).append(("d", _next(result)))
    grid = ""
    for blocks in (left, right):
        grid += (
            "<div "
            f'class="col">{"".join(f"<div class={place}>{block}</div>" for place, block in blocks)}</div>'
        )
    first, *rest = re.split(r"(?<=[.!?]) (?=[A-Z])", result.summary, maxsplit=1)
    more = f'<p class="more">{escape(rest[0])}</p>' if rest else ""
    top = f'<span class="badge">{VERDICTS[result.verdict]}</span><h1>{escape(first)}</h1>{more}'
    return f'<div class="hero {result.verdict}">{top}<div class="grid">{grid}</div></div>'


def _numbers(result: Result) -> str:
    test, floor = result.test, result.noise.floor
    ratio = test.after / floor if floor > 0.0 else math.nan
    low, high = (millimetres(v) for v in test.interval)
    interval = f"rms, 95 % interval {low} to {high}" if low != NOTHING else "rms"
    if result.as_given_rms is not None:
        interval += f"; {millimetres(result.as_given_rms[1])} as shipped"
    if result.effects:
        old, new = millimetres(test.before), millimetres(test.after)
        error = f'<em class="was">{old}</em> <em class="to">→</em> <em class="is">{new}</em> mm'
        what = _number(error, f"before → after, {interval}")
    else:
        what = _number(f'<em class="was">{millimetres(test.before)}</em> mm', f"base model, {interval}")
    fraction = explained(result)
    gone = (
        _number(percent(max(fraction, 0.0)), "of the error above the noise explained")
        if result.effects and math.isfinite(fraction)
        else ""
    )
    times = _number(f"{rounded(ratio, 3)} ×" if math.isfinite(ratio) else NOTHING, "the noise floor")
    return f'<div class="numbers">{what}{gone}{times}</div>'


def _number(big: str, small: str) -> str:
    return f'<div class="number"><b>{big}</b><span>{small}</span></div>'


def _bars(result: Result) -> str:
    """Errors as bars with the noise floor through them."""
    rows = [
        ("held out, before", "before", result.test.before, None),
        ("held out, after", "after", result.test.after, result.test.interval),
    ]
    rows += [
        ("train, before", "before train", result.train.before, None),
        ("train, after", "after train", result.train.after, None),
    ]
    if not result.effects:
        rows = [
            ("held out", "before", result.test.before, result.test.interval),
            ("train", "before train", result.train.before, None),
        ]
    widest = max((v for _, _, v, _ in rows if math.isfinite(v)), default=0.0)
    whole = max(widest, result.noise.floor, 1e-12) / 0.86
    made = []
    for label, kind, value, interval in rows:
        width = 100.0 * (value if math.isfinite(value) else 0.0) / whole
        marks = (
            '<div class="floor bar" '
            f'style="left:{100.0 * result.noise.floor / whole:.2f}%;min-width:0"></div>'
        )
        right = width
        if interval is not None and all(map(math.isfinite, interval)):
            low, high = (100.0 * v / whole for v in interval)
            marks += (
                '<div class="interval bar" '
                f'style="left:{low:.2f}%;width:{high - low:.2f}%;border-radius:0"></div>'
            )
            right = max(width, high)
        right = (
            max(right, 100.0 * result.noise.floor / whole)
            if right > 80.0 * result.noise.floor / whole
            else right
        )
        text = f'<i style="left:{right:.2f}%">{millimetres(value)}</i>'
        bar = f'<div class="bar {kind}" style="width:{width:.2f}%"></div>'
        made.append(f'<span class="label">{label}</span><div class="track">{bar}{marks}{text}</div>')
    key = (
        f"┆ noise floor {millimetres(result.noise.floor)} mm, from {escape(result.noise.how)} · whisker: "
        "95 % interval"
    )
    if (left_out := int(result.outlier.sum())) and math.isfinite(result.test.all_rows):
        jumps = "row that jumps" if left_out == 1 else "rows that jump"
        key += f" · without {left_out} {jumps}; with them {millimetres(result.test.all_rows)} mm held out"
    return f'<div class="bars">{"".join(made)}</div><p class="key">{key}</p>'


def _found(result: Result) -> str:
    """Return what was missing, with its numbers; where nothing was named, what would have shown."""
    if result.effects:
        cards = []
        for found in result.effects:
            rows = "".join(
                f"<tr><td>{escape(plain_name(name))}</td><td "
                f'class="n">{with_error(e.value, e.stderr, e.unit)}</td><td>{mark(e)}</td></tr>'
                for name, e in found.parameters.items()
            )
            fraction = "this log is too short to say which share of the error it is"
            if result.knows_fractions:
                fraction = f"{_of_all(found.held_out_gain)} of the held-out error above the noise"
            cards.append(
                f'<div class="card effect"><h2>{escape(words(found.name))} <small>{fraction}</small></h2>'
                f'<div class="soft">{escape(found.title)}</div><table>{rows}</table></div>'
            )
        return f"<h3>What the model lacked</h3>{''.join(cards)}"
    if result.patterns:
        return f'<h3>What it looks like</h3><div class="card">{listed(result.patterns)}</div>'
    if result.verdict == "none":
        seen = [b for b in result.bounds if math.isfinite(b.value)]
        first = sorted(seen, key=lambda b: not trait(get_effect(b.name), "frequent"))[:6]
        return (
            "<h3>What would have shown</h3><div "
            f'class="card">{listed(bound_sentence(b) for b in first)}</div>'
        )
    kind = FRACTIONS.get(
        {"unknown": "exogenous"}.get(result.remaining_kind, result.remaining_kind), ("of no known kind", "")
    )[0]
    return (
        f'<h3>What is left</h3><div class="card">'
        f"{percent(result.remaining_fraction) if result.knows_fractions else 'A share'} of the error above "
        f"the noise: {kind}.</div>"
    )


def _of_all(fraction: float) -> str:
    return "all" if fraction >= 0.995 else percent(max(fraction, 0.0))


def _distinguished(result: Result) -> str:
    lines = [
        f"<b>{escape(words(f.name))}</b>: this log cannot tell it from "
        + ", ".join(f'<span class="chip">{escape(words(other))}</span>' for other in f.cannot_be_told_from)
        for f in result.effects
        if f.cannot_be_told_from
    ]
    lines += [
        f"<b>{escape(plain_name(name))}</b>: not identifiable, {escape(e.why)}"
        for name, e in result.base_parameters.items()
        if not e.identifiable
    ]
    if not lines and result.effects:
        lines = ["Nothing: no other effect of the library explains this log as well."]
    if not lines:
        unseen = [words(b.name) for b in result.bounds if not math.isfinite(b.value)]
        lines = (
            [f"This log cannot show {escape(', '.join(unseen))}."]
            if unseen
            else ["Nothing that the library knows."]
        )
    return f"<h3>What cannot be distinguished</h3><ul>{''.join(f'<li>{line}</li>' for line in lines)}</ul>"


def _next(result: Result) -> str:
    use = (
        "<pre><code>robot = fastrod.load_robot(&quot;identified.toml&quot;)\nsim = "
        "fastrod.Simulator(robot)</code></pre>"
    )
    lines = [escape(line) for line in result.advice]
    if lines:
        if result.robot.n_tendons:
            name = result.robot.name if result.robot.name in robot_names() else "R"
            lines.append(
                f"<code>fastrod excite --robot {escape(name)}</code> writes a run that separates "
                "most effects."
            )
        return f"<h3>What to run next</h3><ul>{''.join(f'<li>{line}</li>' for line in lines)}</ul>"
    if result.effects:
        return f"<h3>What to do next</h3>Use the corrected model, which lies beside this page:{use}"
    if result.verdict == "not_in_library":
        return (
            "<h3>What to do next</h3>Look at the robot and the camera for what is named here. "
            "An effect of your own joins the library by <code>@fastrod.effects.base.effect</code>."
        )
    return (
        "<h3>What to do next</h3>Use the model as it is; <code>identified.toml</code> holds its fitted "
        "parameters."
    )
