"""report.html: one file that opens without a network, verdict first."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files

from fastrod.identification.report import figures
from fastrod.identification.report.headline import header, hero
from fastrod.identification.report.markup import FRACTIONS, figure, listed, mark, section
from fastrod.identification.report.result import Found, Result
from fastrod.identification.report.signals import Signals, SignalView
from fastrod.identification.report.wording import (
    NOTHING,
    VERDICTS,
    bound_sentence,
    estimate,
    friendly,
    law,
    millimetres,
    percent,
    plain_name,
    rounded,
    words,
)
from fastrod.identification.search.solve import Estimate

_NOT_FOUND = 6  # rows of the table of candidates that are open


def page(result: Result) -> str:
    """The report as HTML."""
    signals = Signals(result)
    style = (files("fastrod.identification") / "page.css").read_text(encoding="utf-8")
    body = [header(result), "<main>", hero(result)]
    if len(signals.rows):
        views = {found.name: signals.view(found) for found in result.effects}
        body += [
            _fit(result, signals),
            *(_effect(result, found, views[found.name]) for found in result.effects),
        ]
        body += [_memory(result, signals, list(views.values()))]
    body += [
        _parameters(result),
        _remaining(result, signals),
        _bounds(result),
        _candidates(result),
        "</main>",
        _footer(result),
    ]
    title = f"{VERDICTS[result.verdict]}: {result.log.name} on {result.robot.name}"
    head = (
        '<meta charset="utf-8">\n<meta name="viewport" content="width=device-width, '
        f'initial-scale=1">\n<title>{escape(title)}</title>'
    )
    inside = "\n".join(block for block in body if block)
    return (
        "<!DOCTYPE html>\n<html "
        f'lang="en">\n<head>\n{head}\n<style>\n{style}</style>\n</head>\n<body>\n{inside}\n</body>\n</html>\n'
    )


def _fit(result: Result, signals: Signals) -> str:
    stretch, when = figures.close_up(result, signals)
    blue = (
        "Blue should lie on the noise floor, and on the dark points."
        if result.effects
        else "Orange should lie on the noise floor."
    )
    blocks = [
        figure(
            figures.error_over_time(result, signals),
            f"Distance between measured and predicted tip, rms over short bins. {blue} Shaded: held out, "
            "seen by no fit.",
        ),
        figure(
            stretch,
            f"The held-out stretch on which the base model is worst ({escape(when)}), axis by "
            "axis and as a path.",
        ),
        figure(
            figures.whole_paths(result, signals),
            "The whole path in grey; dark what was held out, and in colour what the model says of it.",
        ),
    ]
    if len(result.path) > 1:
        blocks.append(
            figure(
                figures.added(result),
                "Effects in the order of what they bring. An effect that helps "
                "only in training is no physics.",
            )
        )
    if result.effects:
        return section(
            "Before and after",
            "The base model with its own parameters fitted, against the model with what was found.",
            *blocks,
        )
    return section("Measured and predicted", "The base model with its own parameters fitted.", *blocks)


def _effect(result: Result, found: Found, view: SignalView) -> str:
    forms = (
        ("z", "z over held-out blocks {:.1f}", 1.0),
        ("bic", "BIC gain {:.0f}", 1.0),
        ("loss_share", "{:.1f} % of the loss", 100.0),
    )
    evidence = ", ".join(
        form.format(found.evidence[key] * factor)
        for key, form, factor in forms
        if math.isfinite(found.evidence.get(key, math.nan))
    )
    proof = f'<p class="law"><b>Evidence</b> {evidence}</p>' if evidence else ""
    laws = "".join(
        f'<p class="law"><b>{key}</b> {_coded(key, text)}</p>' for key, text in law(found.name).items()
    )
    what = "Loops should close to a line" if view.connected else "The trend (black: mean) should become flat"
    caption = (
        f"{what} inside the green band of two noise sigmas. "
        f"{'Strong' if view.connected else 'Dark'}: held out. Before: base model; after: with all that was "
        "found."
    )
    if found.signatures:
        others = ", and those that it cannot be distinguished from," if len(found.signatures) > 1 else ""
        caption = (
            f"Left: what the law{others} does to the tip by itself, with the numbers below, while one bend "
            f"swings to and fro, less and less. Right: {caption[0].lower()}{caption[1:]}"
        )
    picture = figures.against_signal(view, result, f"effect-{found.name}", found.signatures)
    return section(words(found.name).capitalize(), escape(found.title), figure(picture, caption), laws, proof)


def _memory(result: Result, signals: Signals, drawn: Sequence[SignalView]) -> str:
    blocks = []
    if not any(view.connected for view in drawn) and (loops := signals.loops()) is not None:
        caption = (
            "Residual along the bend against the commanded bend. Open loops: memory, such as friction or "
            "backlash. "
            "A line that is not flat: something static."
        )
        blocks.append(figure(figures.against_signal(loops, result, "loops"), caption))
    caption = (
        "How alike the residual is to itself some time later. Above the band: something is left that a "
        "model could explain. "
        f"The camera at rest has {_signed(result.noise.lag1)} from one sample to the next."
    )
    blocks.append(figure(figures.autocorrelation(result, signals), caption))
    return section("Hysteresis and memory", "Does the residual know where the robot came from?", *blocks)


def _parameters(result: Result) -> str:
    groups = {
        "of the robot": result.base_parameters,
        **{f"of {words(found.name)}": found.parameters for found in result.effects},
    }
    blocks = [_estimates(groups)]
    names, matrix = result.correlation
    if len(names) > 1:
        caption = "Correlations of the fitted numbers. Near ±1: this log knows only their sum or difference."
        plain = [plain_name(name) for name in names]
        blocks.append(figure(figures.correlations(plain, matrix), caption))
    lead = (
        "Estimate and standard error, samples that know of each other counted less; model form is not in it. "
        "The prior that the fit began with; what this log says nothing about."
    )
    return section("Parameters", lead, *blocks)


def _estimates(groups: Mapping[str, Mapping[str, Estimate]]) -> str:
    rows = []
    for title, every in groups.items():
        rows += [f'<tr class="group"><td colspan="6">{escape(title)}</td></tr>'] if every else []
        for name, e in every.items():
            number, error, unit = estimate(e.value, e.stderr, e.unit)
            factor = friendly(e.unit, e.value or e.stderr)[0]
            prior = f"± {rounded(e.prior_sd * factor, 2)}" if math.isfinite(e.prior_sd) else "none"
            rows.append(
                f'<tr><td>{escape(plain_name(name))}</td><td class="n">{number}</td>'
                f'<td class="n">{error if e.identifiable else NOTHING}</td>'
                f'<td class="u">{escape(unit)}</td><td class="n">{prior}</td><td>{mark(e, True)}</td></tr>'
            )
    if not rows:
        return "<p>Nothing was fitted: the robot file takes all of the robot as known.</p>"
    head = _head("parameter", "#estimate", "#std. error", "unit", "#prior sd", "this log")
    return f'<div class="scroll"><table>{head}{"".join(rows)}</table></div>'


def _remaining(result: Result, signals: Signals) -> str:
    structure = result.remaining
    blocks = []
    if result.patterns:
        blocks.append(f"<p>Outside the library, but found as a pattern:</p>{listed(result.patterns)}")
    fractions = [(key, getattr(structure, key), *FRACTIONS[key]) for key in FRACTIONS]
    known = sum(fraction for _, fraction, _, _ in fractions)
    # what the held-out error has above the noise is no noise, even where this test finds nothing in it
    if not result.patterns and (more := result.above_noise - known) > 0.0:
        fractions.append(("above the noise", more, "not explained by this test", "#8a5a44"))
    rest = max(0.0, 1.0 - sum(fraction for _, fraction, _, _ in fractions))
    bars = "".join(
        f'<div style="width:{100 * fraction:.2f}%;background:{colour}"></div>'
        for _, fraction, _, colour in fractions
    )
    fractions.append(("noise", rest, "the remainder", "#e3e7ed"))
    legend = "".join(
        f'<span style="--c:{colour}">{key}: {percent(fraction)} <em class="soft">({text})</em></span>'
        for key, fraction, text, colour in fractions
    )
    taken_off = " once the pattern above is taken off" if result.patterns else ""
    if result.knows_fractions:
        blocks.append(f"<h3>The residual's variance{taken_off}</h3>")
        blocks.append(f'<div class="shares">{bars}</div><div class="legend">{legend}</div>')
    if len(signals.rows):
        caption = (
            "What is left of each axis, mean over stretches of time, and the band in which noise would "
            "leave it. "
            "A step, a slope or a wave is no noise."
        )
        blocks.append(figure(figures.left_over_time(result, signals), caption))
    if result.network:
        with_it = result.network["held_out_rms_m"]
        blocks.append(
            f"<p>A network on what is left brings the held-out error from {millimetres(result.test.after)} "
            f"to {millimetres(with_it)} mm; "
            "it names nothing and is no part of <em>after</em>.</p>"
        )
    lead = f"{percent(result.remaining_fraction)} of the error above the noise remains unexplained."
    if not result.knows_fractions:
        lead = "This log is too short to say which share of the error above the noise remains."
    elif result.remaining_fraction == 0.0 and result.above_noise > 0.0:
        lead = f"{percent(result.above_noise)} of the held-out mean square is above the noise."
    elif result.remaining_fraction == 0.0:
        lead = "Nothing that held-out blocks confirm: what is left looks like noise."
    notes = f"<h3 style='margin-top:16px'>About this log</h3>{listed(result.notes)}" if result.notes else ""
    return section("What remains", lead, *blocks, notes)


def _bounds(result: Result) -> str:
    if not result.bounds:
        return ""
    seen = [bound_sentence(b) for b in result.bounds if math.isfinite(b.value)]
    blind = [bound_sentence(b) for b in result.bounds if not math.isfinite(b.value)]
    first = f'<ul class="bounds">{"".join(f"<li>{escape(s)}</li>" for s in seen)}</ul>' if seen else ""
    second = f"<h3>Out of this log's sight</h3>{listed(blind)}" if blind else ""
    lead = "Effects that were not found, and the size from which each would have shown on this log."
    return section("What could have been seen", lead, first, second)


def _candidates(result: Result) -> str:
    if not result.tried:
        return ""
    rows = [
        f"<tr{' class=kept' if t.kept else ''}><td>{escape(words(t.name))}</td><td>{_kind(t.kind)}</td>"
        f'<td class="n">{millimetres(t.held_out_rms)}</td><td '
        f'class="n">{_score(t.score, t.held_out_rms)}</td>'
        f'<td class="n">{_score(t.bic_gain, t.held_out_rms, 0)}</td><td>{escape(t.why)}</td></tr>'
        for t in result.tried
    ]
    head = _head("candidate", "", "#held-out rms [mm]", "#z", "#BIC gain", "why")
    more = ""
    if len(rows) > _NOT_FOUND + 2:
        rest = f'<div class="scroll"><table>{head}{"".join(rows[_NOT_FOUND:])}</table></div>'
        more = f"<details><summary>{len(rows) - _NOT_FOUND} more</summary>{rest}</details>"
        rows = rows[:_NOT_FOUND]
    lead = (
        "Each was fitted beside the base model and judged on blocks of the training data that its fit had "
        "not seen; "
        f"{result.solves} batches of the rod in all."
    )
    return section(
        "Candidates", lead, f'<div class="scroll"><table>{head}{"".join(rows)}</table></div>{more}'
    )


def _footer(result: Result) -> str:
    after = "with the effects named above" if result.effects else "the same, since no effect is named"
    return (
        "<footer>Error: distance between measured and predicted tip, root mean square. "
        f"Before: the base model with its own parameters fitted. After: {after}. "
        "All numbers are in report.json beside this page, in SI units.</footer>"
    )


def _head(*names: str) -> str:
    """The head of a table; a column of numbers has a # before its name."""
    cells = (
        f'<th class="n">{escape(name[1:])}</th>' if name[:1] == "#" else f"<th>{escape(name)}</th>"
        for name in names
    )
    return f"<tr>{''.join(cells)}</tr>"


def _coded(key: str, text: str) -> str:
    return f"<code>{escape(text)}</code>" if key == "Equation" else escape(text)


def _kind(kind: str) -> str:
    if kind == "tendons":
        return '<span class="chip plain">base model</span>'
    return "" if kind == "effect" else f'<span class="chip plain">pattern: {escape(kind)}</span>'


def _signed(value: float) -> str:
    return f"{value:.2f}".replace("-", "−")


def _score(value: float, rms: float, places: int = 1) -> str:
    return f"{value:.{places}f}".replace("-", "−") if math.isfinite(rms) else NOTHING
