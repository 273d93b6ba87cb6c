"""Pieces of HTML that the parts of the report share."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from fastrod.identification.search.solve import Estimate

FRACTIONS = {
    "static": ("follows from the present inputs", "#6d5bd0"),
    "memory": ("follows from the inputs before", "#2166c4"),
    "drift": ("slow in time", "#c2790a"),
    "exogenous": ("not explained by this test", "#b4235a"),
}


def section(title: str, lead: str, *blocks: str) -> str:
    """A part of the page under a heading; `title` is escaped here, `lead` and `blocks` are HTML already."""
    return f'<section><h2>{escape(title)}</h2><p class="lead">{lead}</p>{"".join(blocks)}</section>'


def figure(svg: str, caption: str) -> str:
    """A picture that scrolls sideways where it is too wide, and what it shows; both are HTML already."""
    return f'<figure><div class="scroll">{svg}</div><figcaption>{caption}</figcaption></figure>'


def listed(lines: Iterable[str]) -> str:
    """A bulleted list of plain text, escaped here."""
    return f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in lines)}</ul>"


def mark(e: Estimate, always: bool = False) -> str:
    """HTML beside an estimate: at its bound, beyond its prior, not identifiable and why, or what to note;
    only with `always` also that it is identifiable."""
    marks = []
    if e.at_bound:
        marks.append('<span class="chip">at bound</span>')
    if e.beyond_prior:
        marks.append(f'<span class="chip bad">{abs(e.prior_distance):.1f} sd from its prior</span>')
    if not e.identifiable:
        marks.append(f'<span class="chip bad">not identifiable</span> {escape(e.why)}')
    elif e.why:
        marks.append(escape(e.why))
    elif always and not e.at_bound and not e.beyond_prior:
        marks.append('<span class="chip good">identifiable</span>')
    return " ".join(marks)
